"""Regions in the daemon: only what is free, the document, routes as a call."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from numpy.typing import NDArray

from mapping.grids.patch import GridPatch
from service import assemble_makers
from service.config import Config
from service.map_makers import MapView, Rect
from service.outputs import DocumentOut
from service.payloads import Encoder
from service.routes import route_answer
from service.rpc import CallRefused
from service.topo_maker import TopoMaker, free_polygons, regions_of_grid, ways_of

SCHEMA = json.loads((Path(__file__).parents[3] / "docs" / "schemas" / "topo.v1.json").read_text())
I8 = NDArray[np.int8]


def house(row0: int = 0, col0: int = 0) -> GridPatch:
    """Two rooms of 4 x 4 m and a corridor above, walls 0.2 m, doors 1 m; 5 cm cells; unknown outside."""
    cells: I8 = np.full((180, 180), -1, dtype=np.int8)

    def fill(x0: float, y0: float, x1: float, y1: float, value: int) -> None:
        cells[round(y0 * 20) : round(y1 * 20), round(x0 * 20) : round(x1 * 20)] = value

    fill(0.2, 0.2, 8.8, 6.8, 100)
    for room in (
        (0.4, 0.4, 4.4, 4.4),
        (4.6, 0.4, 8.6, 4.4),
        (0.4, 4.6, 8.6, 6.6),
        (2.0, 4.4, 3.0, 4.6),
        (6.0, 4.4, 7.0, 4.6),
    ):
        fill(*room, 0)
    return GridPatch(0.05, row0, col0, cells)


def view(grid: GridPatch | None) -> MapView:
    return MapView(5, grid, () if grid is None else (Rect(0, 0, 1, 1),), None)


def told(maker: TopoMaker, grid: GridPatch | None) -> dict[str, Any] | None:
    outputs = maker.make(view(grid))
    if not outputs:
        return None
    assert isinstance(outputs[0], DocumentOut)
    document: dict[str, Any] = json.loads(Encoder().encode(outputs[0], 0)[0].payload)
    Draft202012Validator(SCHEMA).validate(document)
    return document


def test_house_is_two_rooms_and_a_corridor() -> None:
    document = told(TopoMaker(smooth_m=0.1, door_m=1.2), house())
    assert document is not None
    rooms = {node["room"] for node in document["nodes"]}
    areas = {room: sum(n["area_m2"] for n in document["nodes"] if n["room"] == room) for room in rooms}
    assert sum(area > 10.0 for area in areas.values()) == 3
    assert document["version"] == 1
    assert {edge["is_door"] for edge in document["edges"]} == {True}
    for edge in document["edges"]:
        assert math.dist(*edge["ends"]) == pytest.approx(edge["width_m"], abs=2e-3)


def test_told_only_when_it_changed() -> None:
    maker = TopoMaker()
    assert told(maker, None) is None
    assert told(maker, house()) is not None
    assert told(maker, house()) is None
    shut = house()
    shut.cells[88:92, 40:60] = 100
    again = told(maker, shut)
    assert again is not None
    assert again["version"] == 2
    maker.restore(())
    assert maker.changed_tiles() == []
    with pytest.raises(CallRefused, match="no regions"):
        maker.ways()
    assert told(maker, shut) is not None


def test_empty_and_unknown_grids_have_no_regions() -> None:
    for value in (-1, 50, 100):
        cells: I8 = np.full((40, 40), value, dtype=np.int8)
        assert regions_of_grid(GridPatch(0.05, 0, 0, cells), smooth_m=0.1).regions == ()
    assert free_polygons(GridPatch(0.05, 3, 3, np.zeros((1, 1), dtype=np.int8))).is_empty


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(-50, 50), st.integers(-50, 50), st.sampled_from([0.05, 0.1, 0.03]))
def test_no_region_holds_a_cell_that_is_not_free(seed: int, row0: int, col0: int, resolution: float) -> None:
    """Whatever stands about, the smoothing never reaches it."""
    random = np.random.default_rng(seed)
    cells: I8 = np.zeros((70, 90), dtype=np.int8)
    for _ in range(int(random.integers(0, 25))):
        r, c, h, w = random.integers(0, [66, 86, 9, 9])
        cells[r : r + h + 1, c : c + w + 1] = random.choice([-1, 40, 100])
    grid = GridPatch(resolution, row0, col0, cells)
    found = regions_of_grid(grid, smooth_m=2.0 * resolution)
    space = shapely.union_all([shapely.Polygon(region.corners_m) for region in found.regions])
    rows, cols = np.nonzero((cells < 0) | (cells >= 35))
    x, y = (cols + col0 + 0.5) * resolution, (rows + row0 + 0.5) * resolution
    assert not shapely.contains_xy(space, x, y).any()
    inside = space.bounds
    if len(found.regions):
        assert inside[0] >= col0 * resolution - 1e-9
        assert inside[3] <= (row0 + 70) * resolution + 1e-9


def test_route_through_the_corridor() -> None:
    regions = ways_of(regions_of_grid(house(), smooth_m=0.1))
    answer = route_answer(regions, {"from": [2.0, 1.0], "to": [7.0, 1.0]})
    assert answer["stops"] == len(answer["nodes"]) - 2
    assert 8.0 < answer["length_m"] < 16.0
    assert any(y > 4.6 for _, y in answer["positions"])
    assert all(entry["nodes"] is None and entry["cut_off"] for entry in answer["alternatives"])
    lengths = sum(math.dist(a, b) for a, b in zip(answer["positions"], answer["positions"][1:]))
    assert lengths == pytest.approx(answer["length_m"], abs=0.05)
    there = route_answer(regions, {"from": answer["nodes"][0], "to": answer["nodes"][0], "via": [[7.0, 1.0]]})
    assert there["length_m"] == pytest.approx(2.0 * answer["length_m"], abs=0.01)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"from": 0}, '"to" is where the route ends'),
        ({"from": 0, "to": 999}, "no node 999"),
        ({"from": 0, "to": [50.0, 50.0]}, "no region within 1 m"),
        ({"from": 0, "to": [math.nan, 0.0]}, '"to" is a node'),
        ({"from": True, "to": 1}, '"from" is a node'),
        ({"from": 0, "to": 1, "over": 3}, "unknown argument 'over'"),
        ({"from": 0, "to": 1, "via": 3}, '"via" is a list'),
        ({"from": 0, "to": 1, "avoid": ["a"]}, '"avoid": no node a'),
        ({"from": 0, "to": 1, "avoid_edges": [[0]]}, "pairs of nodes"),
        ({"from": 0, "to": 1, "avoid_edges": [[0, 0]]}, "no edge 0 - 0"),
    ],
)
def test_calls_that_make_no_sense_say_why(arguments: dict[str, Any], why: str) -> None:
    maker = TopoMaker()
    maker.make(view(house()))
    with pytest.raises(CallRefused, match=why):
        route_answer(maker.ways(), arguments)


def test_no_way_says_so() -> None:
    regions = ways_of(regions_of_grid(house(), smooth_m=0.1))
    answer = route_answer(regions, {"from": [2.0, 1.0], "to": [7.0, 1.0]})
    with pytest.raises(CallRefused, match="no way from"):
        route_answer(regions, {"from": [2.0, 1.0], "to": [7.0, 1.0], "avoid": answer["nodes"][1:-1]})


def test_it_is_made_if_configured() -> None:
    assert not any(isinstance(maker, TopoMaker) for maker in assemble_makers.map_makers(Config(), {}))
    config = Config.model_validate({"topo": {"enabled": True, "period_s": 2.0}})
    (maker,) = (m for m in assemble_makers.map_makers(config, {}) if isinstance(m, TopoMaker))
    assert maker.period_ns == 2_000_000_000
