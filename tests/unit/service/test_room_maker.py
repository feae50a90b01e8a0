"""Rooms of a grid as the daemon tells them, plans and names through the calls, and what the store keeps."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from service import assemble, assemble_makers
from service.config import Config
from service.map_makers import MapView, Rect
from service.outputs import DocumentOut
from service.room_maker import RoomMaker
from service.routes import route_answer
from service.rpc import CallRefused

SCHEMA = json.loads((Path(__file__).parents[3] / "docs" / "schemas" / "rooms.v1.json").read_text())
PLAN_SCHEMA = json.loads((Path(__file__).parents[3] / "docs" / "schemas" / "plan.v1.json").read_text())
CELL_M = 0.1
ROW0, COL0 = -30, 200


def house(*, door: bool = True) -> GridPatch:
    """Two rooms of 5 m x 5 m with a door of 1 m, unknown around; a table in the first."""
    cells = np.full((60, 112), -1, dtype=np.int8)
    cells[4:56, 3:109] = 100
    cells[5:55, 4:54] = cells[5:55, 56:106] = 0
    cells[20:25, 20:25] = 100
    if door:
        cells[25:35, 54:56] = 0
    return GridPatch(CELL_M, ROW0, COL0, cells)


def told(maker: RoomMaker, grid: GridPatch | None, pose: Pose2 | None = None) -> dict[str, Any] | None:
    """The document after a change of the grid, checked against its schema; None if nothing was said."""
    changed = () if grid is None else (Rect(grid.row0, grid.col0, *grid.cells.shape),)
    outputs = maker.make(MapView(7, grid, changed, pose))
    if not outputs:
        return None
    (output,) = outputs
    assert isinstance(output, DocumentOut)
    document = {"schema": "umfeld.rooms.v1", "stamp": {"sec": 0, "nanosec": 7}, **output.fields}
    jsonschema.validate(document, SCHEMA)
    return document


def at(row: int, col: int) -> list[float]:
    return [(col + COL0 + 0.5) * CELL_M, (row + ROW0 + 0.5) * CELL_M]


def standing_at(row: int, col: int) -> Pose2:
    x_m, y_m = at(row, col)
    return Pose2(x_m, y_m, 0.0)


def test_rooms_and_their_door_are_told_once() -> None:
    maker = RoomMaker(settle_turns=1)
    assert told(maker, None) is None
    document = told(maker, house())
    assert document is not None
    first, second = document["rooms"]
    assert (first["id"], second["id"]) == (1, 2)
    assert first["area_m2"] == pytest.approx(25.0, abs=0.7)
    xs, ys = zip(*first["outline"])
    assert (min(xs), min(ys)) == pytest.approx((20.4, -2.5), abs=0.11)
    (door,) = document["doors"]
    assert door["rooms"] == [1, 2]
    assert door["width_m"] == pytest.approx(1.1, abs=0.1)
    assert told(maker, house()) is None
    closed = told(maker, house(door=False))
    assert closed is not None
    assert [room["id"] for room in closed["rooms"]] == [1, 2]
    assert (closed["doors"], closed["version"]) == ([], 2)


def test_a_plan_leads_through_the_door_by_position_id_or_name() -> None:
    maker = RoomMaker(clearance_m=0.2, settle_turns=1)
    with pytest.raises(CallRefused, match="no grid"):
        maker.plan({"goal": 2})
    x_m, y_m = at(10, 10)
    told(maker, house(), Pose2(x_m, y_m, 0.0))
    maker.name_room({"id": 2, "name": "kitchen"})
    answer = maker.plan({"goal": "kitchen"})
    assert answer["rooms"] == [1, 2]
    assert answer["poses"][0][:2] == pytest.approx(at(10, 10), abs=0.001)
    assert answer["least_clearance_m"] >= 0.2
    assert len(answer["clearance_m"]) == len(answer["poses"])
    assert maker.plan({"start": at(10, 10), "goal": 2}) == answer
    assert maker.plan({"start": 2, "goal": at(10, 10)})["rooms"] == [2, 1]
    json.dumps(answer, allow_nan=False)
    told(maker, house(door=False))
    with pytest.raises(CallRefused, match="no way"):
        maker.plan({"start": at(10, 10), "goal": 2})


def test_a_plan_is_published_once_and_a_refusal_is_not() -> None:
    maker = RoomMaker(clearance_m=0.2, settle_turns=1)
    told(maker, house())
    answer = maker.plan({"start": at(10, 10), "goal": 2})
    output = maker.planned()
    assert isinstance(output, DocumentOut)
    document = {"schema": "umfeld.plan.v1", "stamp": {"sec": 0, "nanosec": 7}, **output.fields}
    jsonschema.validate(document, PLAN_SCHEMA)
    assert document["goal"] == 2
    assert document["poses"] == answer["poses"]
    assert maker.planned() is None
    with pytest.raises(CallRefused):
        maker.plan({"start": at(10, 10), "goal": 3})
    assert maker.planned() is None


def test_a_room_is_gone_to_where_no_furniture_stands() -> None:
    """Tables stand where both rooms are widest but for them."""
    grid = house()
    grid.cells[20:25, 20:25] = 0
    for left in (25, 77):
        grid.cells[26:34, left : left + 8] = 100
    maker = RoomMaker(clearance_m=0.2, settle_turns=1)
    document = told(maker, grid)
    assert document is not None
    assert len(document["rooms"]) == 2
    for room in document["rooms"]:
        col, row = (int(np.floor(v / CELL_M)) - first for v, first in zip(room["position"], (COL0, ROW0)))
        assert grid.cells[row, col] == 0
        answer = maker.plan({"start": at(10, 10), "goal": room["id"]})
        assert answer["poses"][-1][:2] == room["position"]
        assert answer["rooms"][-1] == room["id"]


def test_a_robot_that_stands_close_to_a_wall_may_leave_it_but_others_keep_their_clearance() -> None:
    maker = RoomMaker(clearance_m=0.3, settle_turns=1)
    told(maker, house(), standing_at(6, 30))  # two cells from the wall's: 0.06 m
    answer = maker.plan({"goal": 2})
    assert answer["poses"][0][:2] == pytest.approx(at(6, 30), abs=0.001)
    assert answer["least_clearance_m"] == answer["clearance_m"][0] == pytest.approx(0.2 - 0.1 * 2**0.5, abs=0.001)
    assert min(answer["clearance_m"][1:]) >= 0.3
    steps = np.diff(np.array(answer["poses"])[:, :2], axis=0)
    assert answer["length_m"] == pytest.approx(np.hypot(*steps.T).sum(), abs=0.01)
    with pytest.raises(CallRefused, match="clearance"):
        maker.plan({"start": at(6, 30), "goal": 2})


def test_a_name_stays_good_for_plans_while_its_room_is_swallowed() -> None:
    maker = RoomMaker(clearance_m=0.2, settle_turns=1)
    told(maker, house())
    maker.name_room({"id": 2, "name": "kitchen"})
    open_plan = house()
    open_plan.cells[5:55, 54:56] = 0
    document = told(maker, open_plan)
    assert document is not None
    assert [room["id"] for room in document["rooms"]] == [1]
    answer = maker.plan({"start": at(10, 10), "goal": " kitchen"})
    assert answer["poses"][-1][0] > at(0, 56)[0]


def test_a_beam_through_a_crack_makes_no_room_and_a_closed_door_takes_none() -> None:
    grid = house()
    free = GridPatch(CELL_M, ROW0, COL0, np.full((160, 112), -1, dtype=np.int8))
    free.cells[:60] = grid.cells
    free.cells[55:60, 30:32] = 0  # through the wall
    free.cells[60:150, 20:42] = 0  # 20 square metres of nothing
    maker = RoomMaker(settle_turns=1)
    document = told(maker, free, standing_at(10, 10))
    assert document is not None
    assert [room["id"] for room in document["rooms"]] == [1, 2]
    assert [door["rooms"] for door in document["doors"]] == [[1, 2]]
    free.cells[25:35, 54:56] = 100
    document = told(maker, free, standing_at(10, 10))
    assert document is not None
    assert [room["id"] for room in document["rooms"]] == [1, 2]
    assert document["doors"] == []


def test_a_room_waits_for_its_id_unless_the_robot_is_in_it() -> None:
    maker, pose = RoomMaker(), standing_at(10, 10)
    ids = []
    for _ in range(4):
        document = told(maker, house(), pose)
        ids.append(None if document is None else [room["id"] for room in document["rooms"]])
    assert ids == [[1], None, [1, 2], None]


def test_what_stands_in_a_room_for_a_while_does_not_make_it_two() -> None:
    """A bug: where a person had walked a room was cut in two for a turn, once a lap, and the half got an id."""
    maker, pose = RoomMaker(), standing_at(10, 10)
    for _ in range(5):
        told(maker, house(), pose)
    cut = house()
    cut.cells[30:32, 4:44] = 100
    for grid in (cut, cut, house(), cut, cut):
        told(maker, grid, pose)
        found = maker.found_rooms()
        assert found is not None
        assert found.rooms == [1, 2]
        assert all(np.any(found.labels == number) for number in found.numbers)
    document = told(maker, cut, pose)
    assert document is not None
    assert [room["id"] for room in document["rooms"]] == [1, 2, 3]


def test_what_stands_in_a_room_after_a_restart_does_not_make_it_two_either() -> None:
    maker, pose = RoomMaker(), standing_at(10, 10)
    for _ in range(5):
        told(maker, house(), pose)
    again, cut = RoomMaker(), house()
    again.restore(maker.changed_tiles())
    cut.cells[30:32, 4:44] = 100
    document = told(again, cut, standing_at(50, 10))
    assert document is not None
    assert [room["id"] for room in document["rooms"]] == [1, 2]


def test_unknown_cells_are_not_planned_through() -> None:
    maker, grid = RoomMaker(clearance_m=0.0, settle_turns=1), house()
    grid.cells[25:35, 54:56] = -1
    told(maker, grid)
    with pytest.raises(CallRefused, match="no way"):
        maker.plan({"start": at(10, 10), "goal": at(10, 100)})
    with pytest.raises(CallRefused, match="not known to be free"):
        maker.plan({"start": at(10, 10), "goal": at(0, 0)})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"goal": 9}, "no room 9 is known"),
        ({"goal": True}, "position"),
        ({"goal": [1.0]}, "position"),
        ({"goal": [float("nan"), 0.0]}, "position"),
        ({}, "position"),
        ({"goal": 2, "clearance_m": -1}, "clearance_m"),
        ({"goal": 2, "alternatives": 1.5}, "alternatives"),
        ({"goal": 2, "speed": 1}, "unknown argument"),
        ({"goal": 2}, "where the robot is"),
    ],
)
def test_bad_plans_are_refused_in_words(arguments: dict[str, object], words: str) -> None:
    maker = RoomMaker(settle_turns=1)
    told(maker, house())
    with pytest.raises(CallRefused, match=words):
        maker.plan({"start": at(10, 10), **arguments} if words != "where the robot is" else arguments)


def test_names_are_told_kept_and_belong_to_one_room() -> None:
    maker = RoomMaker(settle_turns=1)
    told(maker, house())
    assert maker.name_room({"id": 1, "name": " Küche "}) == {"id": 1, "name": "Küche"}
    (news,) = maker.news()
    assert isinstance(news, DocumentOut)
    assert json.loads(json.dumps(news.fields))["rooms"][0]["name"] == "Küche"
    with pytest.raises(CallRefused, match="room 1 is called 'Küche' already"):
        maker.name_room({"id": 2, "name": "Küche"})
    for arguments in ({"id": 9, "name": "x"}, {"id": 1}, {"id": 1, "name": "x" * 65}, {"id": True, "name": "x"}):
        with pytest.raises(CallRefused):
            maker.name_room(arguments)
    tiles = maker.changed_tiles()
    assert maker.changed_tiles() == []
    again = RoomMaker(settle_turns=1)
    again.restore(tiles)
    document = told(again, house())
    assert document is not None
    assert [(room["id"], room["name"]) for room in document["rooms"]] == [(1, "Küche"), (2, None)]
    again.restore(())
    assert again.changed_tiles() == []
    with pytest.raises(ValueError, match="damaged"):
        again.restore([(0, 0, b"{")])
    with pytest.raises(ValueError, match="territory"):
        again.restore([(0, 0, b'{"next": 2, "names": {}}'), (1, 0, b"rubbish")])


def test_routes_lead_from_room_to_room_by_id_name_or_position() -> None:
    maker = RoomMaker(settle_turns=1)
    with pytest.raises(CallRefused, match="no rooms"):
        maker.ways()
    told(maker, house())
    maker.name_room({"id": 2, "name": "kitchen"})
    answer = route_answer(maker.ways(), {"from": at(10, 10), "to": "kitchen"})
    assert (answer["kind"], answer["nodes"], answer["stops"]) == ("rooms", [1, 2], 0)
    assert answer["length_m"] == pytest.approx(5.2, abs=1.5)
    assert [(each["edge"], each["nodes"], each["cut_off"]) for each in answer["alternatives"]] == [([1, 2], None, [2])]
    with pytest.raises(CallRefused, match="no room within 1 m"):
        route_answer(maker.ways(), {"from": [0.0, 0.0], "to": 1})
    told(maker, house(door=False))
    with pytest.raises(CallRefused, match="no way from 1 to 2"):
        route_answer(maker.ways(), {"from": 1, "to": 2})


def test_a_robot_whose_grid_a_laser_draws_has_rooms_without_being_told() -> None:
    laser = {"driver": "hokuyo", "port": "/dev/none"}
    here = {"lasers": {"front": laser}}
    other = {"lasers": {"front": laser}, "localise": {"mode": "map", "map": "house.yaml"}}
    off = {"lasers": {"front": laser}, "rooms": {"enabled": False}}
    for given, has_rooms in ((here, True), (other, False), (off, False)):
        config = Config.model_validate(given)
        makers = assemble_makers.map_makers(config, assemble.sensors(config))
        assert any(isinstance(maker, RoomMaker) for maker in makers) is has_rooms


def test_large_maps_are_looked_at_less_often() -> None:
    """A turn costs some 0.2 us a cell: at most 2 % of the time."""
    maker = RoomMaker()
    told(maker, house())
    assert maker.period_ns == 5_000_000_000
    wide = GridPatch(CELL_M, 0, 0, np.zeros((1000, 1000), dtype=np.int8))
    told(maker, wide)
    assert maker.period_ns == 10_000_000_000


def test_outlines_of_rooms_that_stayed_are_those_worked_out_anew() -> None:
    kept, grid = RoomMaker(settle_turns=1), house()
    told(kept, grid)
    grid.cells[5:30, 100:106] = 100
    document, anew = told(kept, grid), told(RoomMaker(settle_turns=1), grid)
    assert document is not None
    assert anew is not None
    assert [each["outline"] for each in document["rooms"]] == [each["outline"] for each in anew["rooms"]]


def test_it_is_built_from_the_configuration() -> None:
    assert not any(isinstance(maker, RoomMaker) for maker in assemble_makers.map_makers(Config(), {}))
    config = Config.model_validate({"rooms": {"enabled": True, "period_s": 2.0}})
    (maker,) = (m for m in assemble_makers.map_makers(config, {}) if isinstance(m, RoomMaker))
    assert maker.period_ns == 2_000_000_000


@pytest.mark.parametrize("huge", [1e308, -1e300, 10**400, -(10**400)])
def test_numbers_beyond_all_measure_are_refused_in_words(huge: float) -> None:
    """They were answered with an internal error: no float holds the int, no int the float over the size of a cell."""
    maker = RoomMaker(settle_turns=1)
    told(maker, house(), standing_at(10, 10))
    for arguments in ({"goal": [huge, 1.0]}, {"goal": [20.0, 1.0], "start": [20.0, huge]}):
        with pytest.raises(CallRefused, match="is a position"):
            maker.plan(arguments)
    with pytest.raises(CallRefused, match="is a length"):
        maker.plan({"goal": at(40, 80), "clearance_m": huge})


def test_warming_up_leaves_nothing_to_compile() -> None:
    """In a process of its own: no map of none, one or many rooms and doors brings kernels new kinds of arguments."""
    code = """
import contextlib, importlib, pkgutil
import numpy as np
from numba.core.registry import CPUDispatcher
import mapping.kernels
from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from service.map_makers import MapView, Rect
from service.room_maker import RoomMaker, warm_up
from service.rpc import CallRefused

modules = [importlib.import_module(f"mapping.kernels.{m.name}") for m in pkgutil.iter_modules(mapping.kernels.__path__)]

def compiled():
    return {
        f"{m.__name__}.{name}": len(kernel.signatures)
        for m in modules for name, kernel in vars(m).items() if isinstance(kernel, CPUDispatcher)
    }

warm_up()
before = compiled()
one_door = np.full((60, 110), -1, np.int8)
one_door[1:41, 1:41] = 100
one_door[2:40, 2:40] = one_door[15:23, 40] = one_door[2:40, 41:80] = 0
many = np.full((160, 200), 100, np.int8)
for row in range(2):
    for col in range(3):
        many[5 + 75 * row : 75 + 75 * row, 5 + 65 * col : 65 + 65 * col] = 0
many[75:80, 20:29] = many[75:80, 85:94] = many[75:80, 150:158] = many[30:39, 65:70] = many[110:118, 130:135] = 0
many[60:75, 20] = many[100:104, 30:40] = many[20:24, 90:100] = 100
for cells in (np.full((20, 20), -1, np.int8), np.zeros((20, 20), np.int8), one_door, many):
    maker = RoomMaker(settle_turns=1)
    for turn in range(3):
        cells[10 + turn, 10] = 100
        changed = Rect(0, 0, *cells.shape) if turn == 0 else Rect(8, 8, 8, 8)
        maker.make(MapView(turn, GridPatch(0.1, 0, 0, cells), (changed,), Pose2(1.5, 1.5, 0.0)))
    far = {"start": [1.0, 2.5], "goal": [17.0, 8.5], "alternatives": 3, "clearance_m": 0.2}
    for wanted in ({"goal": [6.0, 2.5]}, far):
        with contextlib.suppress(CallRefused):
            maker.plan(wanted)
new = {name: count for name, count in compiled().items() if count != before[name]}
assert not new, new
"""
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=Path(__file__).parents[3]).returncode == 0
