"""Which laser the places are made from, and what is kept apart; the map itself: tests/world/test_live_places.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapping.frames import Pose2
from mapping.scan import Scan
from service import assemble, assemble_makers
from service.config import Config, check
from service.config_files import read_layers
from service.errors import WrongUsage
from service.map_makers import MapMakers, MapView
from service.outputs import DocumentOut
from service.place_maker import PlaceMaker
from service.rpc import CallRefused

LASER = {"driver": "hokuyo", "port": "/dev/none"}
BEARING = np.radians(np.arange(-180.0, 180.0, 1.0))


def room(stamp_ns: int) -> Scan:
    """From the middle of a room of 4 x 6 m."""
    reach = np.minimum(2.0 / np.maximum(np.abs(np.cos(BEARING)), 1e-9), 3.0 / np.maximum(np.abs(np.sin(BEARING)), 1e-9))
    return Scan(stamp_ns, 0.0, BEARING, reach, 0.05, 10.0)


def test_it_is_built_from_the_configuration() -> None:
    assert not any(maker.name == "places" for maker in assemble_makers.map_makers(Config(), {}))
    lasers = {"back": LASER, "front": {**LASER, "port": "/dev/other"}}
    for given, source in (({"enabled": True}, "back"), ({"enabled": True, "source": "front"}, "front")):
        config = Config.model_validate({"lasers": lasers, "places": given})
        (maker,) = (
            m for m in assemble_makers.map_makers(config, assemble.sensors(config)) if isinstance(m, PlaceMaker)
        )
        assert maker.sources == {source}


def test_one_room_is_one_place_and_standing_adds_nothing() -> None:
    maker = PlaceMaker("front", Pose2())
    with pytest.raises(CallRefused, match="no places"):
        maker.ways()
    told = []
    for k in range(5):
        maker.take_sweep("front", room(k * 300_000_000), np.zeros((1, 3)))
        told += maker.make(MapView(k, None, (), None))
    (document,) = told
    assert isinstance(document, DocumentOut)
    assert document.fields["where"] == {"area": 0, "level": "metric", "pose": [0.0, 0.0, 0.0], "in_opening": False}
    maker.take_sweep("front", room(3_000_000_000), np.full((1, 3), np.nan))
    assert maker.make(MapView(9, None, (), None)) == []


def test_a_jump_is_no_motion_and_a_correction_is_doubted() -> None:
    maker = PlaceMaker("front", Pose2())
    makers = MapMakers([maker], lambda _output: None, now_ns=lambda: 0)
    maker.take_sweep("front", room(0), np.zeros((1, 3)))
    sure = maker._noise(Pose2())
    makers.redraw([])
    makers.turn(1)
    assert (np.diag(maker._noise(Pose2())) > 100.0 * np.diag(sure))[:2].all()
    maker.take_sweep("front", room(1_000_000_000), np.array([[5.0, 0.0, 0.0]]))
    assert maker.counts["places.lost"] == 1
    assert len(maker.hybrid.areas) == 1  # it was not driven anywhere
    assert makers.counters()["places.lost"] == 1


@pytest.mark.parametrize(
    "other", ["[topo]\nenabled = true\n", "[rings.body]\ndriver = 'alice'\nport = '/dev/ttyUSB1'\n"]
)
def test_map_topo_is_one_map(other: str, tmp_path: Path) -> None:
    path = tmp_path / "umfeld.toml"
    path.write_text("[places]\nenabled = true\n" + other)
    with pytest.raises(WrongUsage, match="map/topo is one map"):
        check(read_layers(path))
