"""Heights of the ground from clouds: the document, what is forgotten, and what sectors are told of it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.grids.height import Ground
from mapping.sectors.ground import SectorGround
from mapping.sectors.snapshot import PolarSnapshot
from service import assemble, assemble_makers
from service.config import Config
from service.elevation_maker import ElevationMaker
from service.map_makers import MapMakers
from service.outputs import CloudOut, DocumentOut, Output, PolarOut, PoseOut
from service.payloads import Encoder, document_message
from service.sector_ground import SectorGroundTeller

F64 = NDArray[np.float64]
SCHEMAS = Path(__file__).parents[3] / "docs" / "schemas"
SECOND = 1_000_000_000
FOOTPRINT = ((0.25, 0.2), (-0.25, 0.2), (-0.25, -0.2), (0.25, -0.2))
EDGES = np.radians(np.arange(-90.0, 91.0, 30.0))


def ground_points(*, box: bool = False, ahead_m: float = 3.0, spacing_m: float = 0.02) -> F64:
    """Level ground of 6 m x 6 m around the vehicle but where it stands itself; with a box of 20 cm on the left."""
    side = np.arange(-3.0 + spacing_m / 2.0, 3.0, spacing_m)
    x, y = (each.reshape(-1) for each in np.meshgrid(side, side))
    there = (np.hypot(x, y) > 0.4) & (x < ahead_m)
    x, y = x[there], y[there]
    z = np.where((np.abs(x) < 0.3) & (y > 0.7) & (y < 1.2), 0.2, 0.0) if box else np.zeros_like(x)
    return np.column_stack((x, y, z))


def cloud(stamp_ns: int, points: F64, map_from_base: Pose2 | None = IDENTITY) -> CloudOut:
    return CloudOut("mast", stamp_ns, points.astype(np.float32), map_from_base, (0.0, 0.0, 1.0))


def told(maker: ElevationMaker, *clouds: CloudOut) -> dict[str, Any] | None:
    """The document after clouds, through the thread's own turn, and held against its schema."""
    outputs: list[Output] = []
    makers = MapMakers([maker], outputs.append, now_ns=lambda: 0)
    for each in clouds:
        makers.take_output(each)
    makers.turn(0)
    assert makers.counters()["makers.errors"] == 0
    if not outputs:
        return None
    (output,) = outputs
    assert isinstance(output, DocumentOut)
    payload = document_message(output, 0).payload
    assert len(payload) < 300_000
    document: dict[str, Any] = json.loads(payload)
    jsonschema.validate(document, json.loads((SCHEMAS / "elevation.v1.json").read_text()))
    return document


def cell(document: dict[str, Any], layer: str, x_m: float, y_m: float) -> Any:
    """What a layer says at a place of the map; None outside."""
    r, origin = document["resolution_m"], document["origin"]
    row, col = math.floor((y_m - origin["y_m"]) / r), math.floor((x_m - origin["x_m"]) / r)
    if not (0 <= row < document["rows"] and 0 <= col < document["columns"]):
        return None
    return document[layer][row][col]


def test_heights_lie_in_the_map_where_the_vehicle_saw_them() -> None:
    document = told(ElevationMaker(), cloud(5, ground_points(box=True), Pose2(10.0, 5.0, math.pi / 2.0)))
    assert document is not None
    assert document["stamp"] == {"sec": 0, "nanosec": 5}
    assert all(len(document[name]) == document["rows"] for name in ("height_m", "ground"))
    assert all(len(row) == document["columns"] for row in document["step_m"])
    assert cell(document, "height_m", 9.05, 5.05) == pytest.approx(0.2)  # the box, left of a vehicle that faces +y
    assert cell(document, "ground", 10.05, 6.55) == Ground.TRAVERSABLE
    assert cell(document, "slope_rad", 10.05, 6.55) == pytest.approx(0.0)
    assert cell(document, "ground", 9.35, 5.05) == Ground.STEP  # at the foot of the box
    assert cell(document, "step_m", 9.35, 5.05) == pytest.approx(0.2, abs=0.002)
    assert cell(document, "ground", 10.05, 5.05) == Ground.UNKNOWN
    kinds = np.bincount(np.array(document["ground"]).reshape(-1) + 1, minlength=5)
    assert [document["cells"][kind.name.lower()] for kind in Ground] == kinds.tolist()


def test_a_slope_is_as_steep_as_it_is() -> None:
    points = ground_points()
    points[:, 2] = math.tan(math.radians(12.0)) * points[:, 0]
    document = told(ElevationMaker(), cloud(0, points))
    assert document is not None
    assert cell(document, "slope_rad", 1.05, 1.05) == pytest.approx(math.radians(12.0), abs=0.002)
    assert cell(document, "ground", 1.05, 1.05) == Ground.TRAVERSABLE


def test_what_is_high_the_vehicle_itself_and_what_lies_far_is_left_out() -> None:
    high = np.array([(1.0 + 0.01 * k, 1.0, 2.5) for k in range(20)])
    own = np.array([(0.1, 0.1, 0.3), (-0.1, 0.0, 0.4), (0.0, 0.0, 0.2), (0.01, 0.0, 0.2)] * 5)
    far = np.array([(40.0, 0.0, 0.0), (np.nan, 0.0, 0.0), (np.inf, 1.0, 0.0), (1e30, 0.0, 0.0)] * 5)
    points = np.concatenate((ground_points(), high, own, far))
    document = told(ElevationMaker(footprint=FOOTPRINT, size_m=4.0), cloud(0, points))
    assert document is not None
    assert document["rows"] <= 41
    assert max(v for row in document["height_m"] for v in row if v is not None) == pytest.approx(0.0)
    assert cell(document, "height_m", 0.05, 0.05) is None


def test_what_has_gone_is_forgotten_with_its_cloud() -> None:
    maker = ElevationMaker(clouds=2)
    document = told(maker, cloud(0, ground_points(box=True)))
    assert document is not None
    assert cell(document, "ground", 0.05, 0.65) == Ground.STEP
    document = told(maker, cloud(SECOND, ground_points()))
    assert document is not None
    assert cell(document, "ground", 0.05, 0.95) == Ground.STEP, "one of two clouds still has it"
    document = told(maker, cloud(2 * SECOND, ground_points()))
    assert document is not None
    assert cell(document, "ground", 0.05, 0.95) == Ground.TRAVERSABLE


def test_without_a_place_nothing_is_told_and_nothing_twice() -> None:
    maker = ElevationMaker()
    assert told(maker, cloud(0, ground_points(), None)) is None
    assert told(maker, cloud(0, np.full((10, 3), np.nan))) is not None, "a cloud of nothing is an empty map"
    assert told(maker) is None
    assert maker.changed_tiles() == []


def test_the_same_clouds_give_the_same_bytes() -> None:
    clouds = [cloud(k, ground_points(box=k == 1), Pose2(0.1 * k, 0.0, 0.05 * k)) for k in range(3)]
    assert told(ElevationMaker(), *clouds) == told(ElevationMaker(), *clouds)


# --------------------------------------------------------------------------------------------------------- the sectors


def snapshot(stamp_ns: int, base_from_sensor: Pose2 = IDENTITY) -> PolarSnapshot:
    count = len(EDGES) - 1
    nothing, none = np.full(count, np.nan), np.full(count, -1)
    return PolarSnapshot(
        stamp_ns, base_from_sensor, EDGES, np.full(count, 2, dtype=np.int8), nothing, nothing, nothing,
        none.astype(np.int64), none.astype(np.int16), ("front",),
    )  # fmt: skip


def pose(stamp_ns: int, map_from_base: Pose2 = IDENTITY, map_from_odom: Pose2 = IDENTITY) -> PoseOut:
    return PoseOut(stamp_ns, map_from_base, map_from_odom, np.zeros((3, 3)))


def teller(maker: ElevationMaker, hidden_m: float | None = 0.55) -> SectorGroundTeller:
    return SectorGroundTeller(maker, footprint=FOOTPRINT, reach_m=1.0, stale_ns=5 * SECOND, hidden_m=hidden_m)


def sectors(teller: SectorGroundTeller, stamp_ns: int, base_from_sensor: Pose2 = IDENTITY) -> list[dict[str, Any]]:
    """The sectors of the document as it is sent, held against its schema."""
    output = teller.with_ground(PolarOut("around", snapshot(stamp_ns, base_from_sensor)))
    document = json.loads(Encoder().encode(output, 0)[0].payload)
    jsonschema.validate(document, json.loads((SCHEMAS / "sectors.v1.json").read_text()))
    found: list[dict[str, Any]] = document["sectors"]
    return found


def test_sectors_say_where_the_ground_can_be_driven_on() -> None:
    maker = ElevationMaker()
    told(maker, cloud(0, ground_points(box=True, ahead_m=1.2)))
    found = sectors(teller(maker), SECOND)
    right, left = found[0], found[-1]
    assert (right["traversable"], right["slope_rad"]) == (True, 0.0)
    assert right["traversable_m"] == pytest.approx(1.55)
    assert left["traversable"] is False, "the box"
    assert left["traversable_m"] < 0.75
    ahead = found[len(found) // 2]
    assert ahead["traversable"] is None, "the ground ends at 1.2 m: what comes then was not seen"
    assert 0.9 < ahead["traversable_m"] < 1.2
    hidden = sectors(teller(maker, None), SECOND)[0]
    assert (hidden["traversable"], hidden["traversable_m"]) == (None, 0.0), "what lies before the outline is not known"


def test_what_is_known_to_be_in_the_way_counts_where_nothing_is_asked_too() -> None:
    maker = ElevationMaker()
    told(maker, cloud(0, ground_points(box=True)))
    left = sectors(teller(maker, 1.4), SECOND)[-1]
    assert (left["traversable"], left["traversable_m"]) == (False, 0.0)


def test_the_ground_turns_with_the_vehicle() -> None:
    maker = ElevationMaker()
    told(maker, cloud(0, ground_points(box=True)))
    at = teller(maker)
    at.with_ground(pose(SECOND, Pose2(0.0, 0.0, math.pi)))
    found = sectors(at, SECOND)
    assert (found[0]["traversable"], found[-1]["traversable"]) == (False, True)
    at.with_ground(pose(SECOND + 1, Pose2(0.0, 0.0, math.pi + 0.001)))
    assert sectors(at, SECOND + 1) == found, "hardly moved: not looked up again"
    at.with_ground(pose(SECOND + 2))
    assert sectors(at, SECOND + 2)[-1]["traversable"] is False


def is_all_unknown(found: list[dict[str, Any]]) -> bool:
    return all((s["traversable"], s["slope_rad"], s["traversable_m"]) == (None, None, 0.0) for s in found)


def test_what_is_not_known_is_never_said_to_be_traversable() -> None:
    maker = ElevationMaker()
    at = teller(maker)
    assert is_all_unknown(sectors(at, 0)), "no cloud yet"
    told(maker, cloud(0, ground_points()))
    assert not is_all_unknown(sectors(at, SECOND))
    assert is_all_unknown(sectors(at, 6 * SECOND)), "the clouds have stopped"
    at.with_ground(pose(0))
    assert is_all_unknown(sectors(at, SECOND)), "the pose is old"
    at.with_ground(pose(SECOND, Pose2(50.0, 0.0, 0.0)))
    assert is_all_unknown(sectors(at, SECOND)), "nobody has been there"
    at.with_ground(pose(SECOND + 1))
    assert not is_all_unknown(sectors(at, SECOND + 1))


def test_after_a_correction_older_clouds_say_nothing() -> None:
    maker = ElevationMaker()
    at = teller(maker)
    at.with_ground(pose(0))
    told(maker, cloud(0, ground_points()))
    assert not is_all_unknown(sectors(at, 1))
    moved = Pose2(0.3, 0.0, 0.0)
    at.with_ground(pose(10, moved, moved))
    assert is_all_unknown(sectors(at, 11))
    assert told(maker, cloud(9, ground_points())) is None, "a cloud from before that was on its way"
    assert is_all_unknown(sectors(at, 12))
    assert told(maker, cloud(20, ground_points(), moved)) is not None
    assert not is_all_unknown(sectors(at, 21))
    at.with_ground(pose(30, moved, Pose2(0.31, 0.0, 0.0)))
    assert not is_all_unknown(sectors(at, 31)), "the small corrections of every scan change nothing"


def test_a_virtual_sensor_beside_the_vehicle_looks_at_all_of_its_ground() -> None:
    maker = ElevationMaker()
    told(maker, cloud(0, ground_points()))
    assert all(s["traversable"] for s in sectors(teller(maker), 1, Pose2(1.5, 0.0, 0.0)))
    assert is_all_unknown(sectors(teller(maker), 1, Pose2(9.0, 0.0, 0.0)))


def test_without_an_elevation_map_documents_are_as_they_were() -> None:
    plain = json.loads(Encoder().encode(PolarOut("around", snapshot(0)), 0)[0].payload)
    assert "traversable" not in plain["sectors"][0]
    count = len(EDGES) - 1
    for kind, says in (
        (Ground.TRAVERSABLE, True),
        (Ground.UNKNOWN, None),
        (Ground.ROUGH, False),
        (Ground.STEEP, False),
    ):
        ground = SectorGround(np.ones(count), np.full(count, kind, dtype=np.int8), np.full(count, 0.1))
        sent = json.loads(Encoder().encode(PolarOut("around", snapshot(0), ground), 0)[0].payload)
        assert sent["sectors"][0] == {
            **plain["sectors"][0], "slope_rad": 0.1, "traversable": says, "traversable_m": 1.0,
        }  # fmt: skip


def test_it_is_there_with_a_mount_and_only_then() -> None:
    mount = {"driver": "cia406", "can": "main", "laser": "tilt", "counts_per_turn": 3600.0}
    lasers = {"tilt": {"driver": "hokuyo", "port": "/dev/a"}}
    data: dict[str, Any] = {"can": {"main": {"interface": "virtual"}}, "lasers": lasers}
    for more, is_there in (({}, False), ({"mounts": {"mast": mount}}, True)):
        config = Config.model_validate({**data, **more})
        makers = assemble_makers.map_makers(config, assemble.sensors(config))
        assert ("elevation" in {maker.name for maker in makers}) is is_there
        assert (assemble_makers.sector_ground(config, makers) is not None) is is_there
    off = Config.model_validate({**data, "mounts": {"mast": mount}, "elevation": {"enabled": False}})
    assert assemble_makers.sector_ground(off, assemble_makers.map_makers(off, assemble.sensors(off))) is None
    with pytest.raises(ValueError, match="150 x 150"):
        Config.model_validate({"elevation": {"size_m": 50.0}})
