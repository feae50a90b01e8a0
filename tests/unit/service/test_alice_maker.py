"""ALICE in the daemon: from her bytes to map/topo, and back from the store."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from drivers.alice import AliceConversation
from mapping.topology.alice import AliceMap
from service import assemble_makers, assemble_wires
from service.alice_maker import AliceMaker
from service.config import Config
from service.errors import WrongUsage
from service.map_makers import MapMakers
from service.outputs import DocumentOut, LookOut, Output
from service.payloads import Encoder
from service.sensors import Ring

SCHEMA = json.loads((Path(__file__).parents[3] / "docs" / "schemas" / "topo.v1.json").read_text())
CONFIG: dict[str, Any] = {"rings": {"body": {"driver": "alice", "port": "/dev/ttyUSB0"}}, "grid": {"enabled": False}}


def looks(count: int, *, seed: int = 1) -> list[LookOut]:
    """Round and round past twelve places, each with a light of its own."""
    random = np.random.default_rng(seed)
    places = [random.random(24) * 0.8 for _ in range(12)]
    return [
        LookOut(
            "body",
            1_000_000_000 + 250_000_000 * k,
            np.clip(places[k % 12] + random.normal(0.0, 0.005, 24), 0.0, 1.0),
            np.zeros(24),
            (0.3 * np.sin(k % 12 / 12 * 2 * np.pi), 0.3 * np.cos(k % 12 / 12 * 2 * np.pi)),
            k > 0,
        )
        for k in range(count)
    ]


def document(outputs: list[Output]) -> dict[str, Any]:
    (out,) = outputs
    assert isinstance(out, DocumentOut)
    told: dict[str, Any] = json.loads(Encoder().encode(out, 0)[0].payload)
    Draft202012Validator(SCHEMA).validate(told)
    return told


def test_looks_become_a_ring_of_places() -> None:
    told: list[Output] = []
    maker = AliceMaker()
    makers = MapMakers([maker], told.append, now_ns=lambda: 0)
    for k, look in enumerate(looks(60)):
        makers.take_output(look)
        makers.turn(k)
    makers.turn(10_000_000_000)
    graph = document([told[-1]])
    assert (graph["kind"], len(graph["nodes"]), len(graph["edges"])) == ("places", 12, 12)
    assert all(edge["driven"] >= 4 for edge in graph["edges"])
    assert graph["stamp"]["sec"] == 15
    assert makers.counts["makers.looks_lost"] == 0


def test_it_comes_back_from_the_store() -> None:
    first, second = AliceMaker(), AliceMaker()
    run = looks(80)
    for look in run[:50]:
        first.take_look(look)
    tiles = first.changed_tiles()
    assert first.changed_tiles() == []
    second.restore(tiles)
    for look in run[50:]:
        first.take_look(look)
        second.take_look(look if look is not run[50] else LookOut(*_with_continuity(look)))
    a, b = first.topo.graph(), second.topo.graph()
    assert [(n.number, n.looks) for n in a.nodes] == [(n.number, n.looks) for n in b.nodes]
    assert a.edges == b.edges
    second.restore(())
    assert len(second.topo) == 0


def _with_continuity(look: LookOut) -> tuple[Any, ...]:
    return look.sensor, look.stamp_ns, look.light, look.touch, look.way_m, False


@pytest.mark.parametrize("number", [0, 1, 2, 3, 4, 6, 7, 8, 9])  # 5: an edge less is a map, too
def test_damaged_tiles_are_refused(number: int) -> None:
    maker = AliceMaker()
    for look in looks(30):
        maker.take_look(look)
    arrays = maker.topo.arrays()
    arrays[number] = arrays[number][:-1]
    with pytest.raises(ValueError):
        AliceMap.from_arrays(arrays)
    with pytest.raises(ValueError):
        AliceMap.from_arrays(maker.topo.arrays()[:-1])


def test_bytes_that_are_no_array_are_refused() -> None:
    with pytest.raises(ValueError, match="not an array"):
        AliceMaker().restore([(0, 1, b"nonsense")])


def test_edges_of_a_damaged_map_stay_in_it() -> None:
    maker = AliceMaker()
    for look in looks(30):
        maker.take_look(look)
    for column, value in ((0, -1.0), (1, 999.0), (2, np.nan)):
        arrays = maker.topo.arrays()
        arrays[5][0, column] = value
        with pytest.raises(ValueError):
            AliceMap.from_arrays(arrays)


def test_gap_is_no_way() -> None:
    maker = AliceMaker()
    for k, (way, continuous) in enumerate([(0.0, False), (0.5, True), (9.0, False), (9.1, True)]):
        maker.take_look(LookOut("body", k, np.linspace(0.0, 1.0, 24), np.zeros(24), (way, 0.0), continuous))
    assert maker.topo.pose.x_m == pytest.approx(0.6, abs=0.02)


def test_configured_robot_is_put_together() -> None:
    config = Config.model_validate(CONFIG)
    assert isinstance(assemble_wires.conversation_of(config.rings["body"]), AliceConversation)
    assert [maker.name for maker in assemble_makers.map_makers(config, {"body": Ring("body")})] == ["alice"]


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"topo": {"enabled": True}}, "leave \\[topo\\] out"),
        ({"rings": {"a": CONFIG["rings"]["body"], "b": {"driver": "alice", "port": "/dev/ttyUSB1"}}}, "one ring"),
    ],
)
def test_one_map_of_places(more: dict[str, Any], why: str, tmp_path: Path) -> None:
    from service.config import check
    from service.config_files import read_layers

    path = tmp_path / "umfeld.toml"
    document = {**CONFIG, **more}
    text = "".join(f"[rings.{n}]\ndriver = 'alice'\nport = '{t['port']}'\n" for n, t in document["rings"].items())
    path.write_text(text + ("[topo]\nenabled = true\n" if "topo" in more else ""))
    with pytest.raises(WrongUsage, match=why):
        check(read_layers(path))


def test_preset_is_a_configuration_that_holds(tmp_path: Path) -> None:
    """As `umfeld sim --preset alice` prints it."""
    from service.config import check
    from service.config_files import read_layers

    code = "from sim_devices.presets import preset, to_toml; print(to_toml(preset('alice')))"
    text = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    path = tmp_path / "umfeld.toml"
    path.write_text(text)
    config = check(read_layers(path))
    assert list(config.rings) == ["body"]
