"""Maps held against each other in the daemon: what is told, counted, and when."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np

from mapping.frames import IDENTITY
from mapping.grids.patch import GridPatch
from mapping.lines.line_map import LineMap, rows_of_ends
from mapping.lines.lines import Lines
from service import assemble, assemble_makers
from service.agreement_maker import KINDS, AgreementMaker
from service.commands.status import agreement_text
from service.config import Config
from service.line_maker import LineMaker
from service.map_makers import MapView, Rect
from service.outputs import DocumentOut
from service.room_maker import RoomMaker
from service.topo_maker import TopoMaker

SCHEMA = json.loads((Path(__file__).parents[3] / "docs" / "schemas" / "agreement.v1.json").read_text())


def house(*, door: bool = True) -> GridPatch:
    """Two rooms of 5 m x 5 m with a door of 1 m; cells of 0.1 m."""
    cells = np.full((60, 112), -1, dtype=np.int8)
    cells[4:56, 3:109] = 100
    cells[5:55, 4:54] = cells[5:55, 56:106] = 0
    if door:
        cells[25:35, 54:56] = 0
    return GridPatch(0.1, 0, 0, cells)


def view(grid: GridPatch | None, *, changed: bool = True) -> MapView:
    rects = () if grid is None or not changed else (Rect(grid.row0, grid.col0, *grid.cells.shape),)
    return MapView(7, grid, rects, None)


def told(maker: AgreementMaker, seen: MapView) -> dict[str, Any] | None:
    outputs = maker.make(seen)
    if not outputs:
        return None
    (output,) = outputs
    assert isinstance(output, DocumentOut)
    document = {"schema": "umfeld.agreement.v1", "stamp": {"sec": 0, "nanosec": 7}, **output.fields}
    jsonschema.validate(document, SCHEMA)
    return document


def kinds(document: dict[str, Any] | None) -> dict[str, tuple[int, int, int]]:
    assert document is not None
    return {each["kind"]: (each["disagree"], each["began"], each["ended"]) for each in document["kinds"]}


def test_a_shut_door_counts_once_and_heals_when_rooms_and_regions_catch_up() -> None:
    rooms, topo = RoomMaker(settle_turns=1), TopoMaker(smooth_m=0.2)
    maker = AgreementMaker(rooms=rooms, topo=topo)
    assert told(maker, view(None)) is None
    rooms.make(view(house()))
    topo.make(view(house()))
    first = told(maker, view(house()))
    assert first is not None
    assert first["disagreements"] == 0
    assert told(maker, view(house(), changed=False)) is None
    shut = told(maker, view(house(door=False)))
    assert shut is not None
    assert kinds(shut)["door_is_blocked"] == (1, 1, 0)
    assert kinds(shut)["place_is_occupied"] == (1, 1, 0)  # the region in the doorway
    assert kinds(shut)["room_is_occupied"] == (2, 2, 0)  # each has a part of the doorway
    assert kinds(shut)["way_is_blocked"] == (2, 2, 0)  # into that region and out of it
    assert {each["what"] for each in shut["where"]} >= {"door 1 - 2"}
    assert "door 1 - 2" in agreement_text(shut)
    assert told(maker, view(house(door=False))) is None  # nothing new
    assert maker.counts["agreement.door_is_blocked"] == 1
    rooms.make(view(house(door=False)))
    topo.make(view(house(door=False)))
    healed = told(maker, view(house(door=False), changed=False))
    assert healed is not None
    assert healed["disagreements"] == 0
    assert kinds(healed)["door_is_blocked"] == (0, 1, 1)
    assert agreement_text(healed).startswith("agree")
    maker.restore(())
    assert maker.changed_tiles() == []


def test_every_kind_can_disagree_and_all_agree_on_one_house() -> None:
    """A check that can only say yes, or never says anything, is none."""
    rooms, topo, lines = RoomMaker(settle_turns=1), TopoMaker(smooth_m=0.2), LineMaker(LineMap(), ["front"])
    maker = AgreementMaker(lines=lines, rooms=rooms, topo=topo)
    rooms.make(view(house()))
    topo.make(view(house()))
    jambs = [[5.5, 0.6, 5.5, 2.5], [5.5, 3.5, 5.5, 5.4]]
    with_lines(lines, jambs)
    agreed = told(maker, view(house()))
    assert agreed is not None
    assert agreed["disagreements"] == 0
    assert {each["kind"] for each in agreed["kinds"] if each["agree"]} == set(KINDS)
    with_lines(lines, [*jambs, [5.5, 2.5, 5.5, 3.5], [2.0, 1.0, 2.0, 4.0]])
    walled = told(maker, view(house(), changed=False))
    blocked = told(maker, view(house(door=False)))
    seen = {each["kind"] for document in (walled, blocked) if document for each in document["where"]}
    assert seen == set(KINDS)
    assert {kind for kind, (now, _, _) in kinds(walled).items() if now} == {
        "wall_is_free", "door_is_walled", "way_is_walled",
    }  # fmt: skip


def with_lines(maker: LineMaker, ends_m: list[list[float]]) -> None:
    """Put these walls (x, y, x, y) into its map, as if they had been seen often."""
    ends, often = np.array(ends_m), np.full(len(ends_m), 50.0)
    rows = rows_of_ends(ends[:, :2], ends[:, 2:], often, often, np.full(len(ends), 0.01))
    line_map = LineMap()
    line_map.insert(Lines(rows, np.full((len(rows), 2), -1, dtype=np.int64)), IDENTITY)
    maker.restore([(0, 0, line_map.to_bytes())])


def test_large_maps_are_compared_less_often() -> None:
    maker = AgreementMaker(period_ns=2_000_000_000)
    maker._samples = 100_000
    assert maker.period_ns == 15_000_000_000


def test_all_that_is_compared_is_counted_as_work() -> None:
    rooms, topo, lines = RoomMaker(settle_turns=1), TopoMaker(smooth_m=0.2), LineMaker(LineMap(), ["front"])
    rooms.make(view(house()))
    topo.make(view(house()))
    with_lines(lines, [[5.5, 0.6, 5.5, 2.5], [5.5, 3.5, 5.5, 5.4]])
    work = []
    for some in ({"lines": lines}, {"topo": topo}, {"lines": lines, "rooms": rooms}, {"lines": lines, "topo": topo}):
        maker = AgreementMaker(**some)
        maker.make(view(house()))
        work.append(maker._samples)
    assert work[0] > 0
    assert work[1] > 0
    assert work[2] > work[0]
    assert work[3] > work[0] + work[1]


def test_it_is_built_after_the_maps_it_compares() -> None:
    config = Config.model_validate({"lasers": {"front": {"driver": "hokuyo", "port": "/dev/none"}}})
    names = [maker.name for maker in assemble_makers.map_makers(config, assemble.sensors(config))]
    assert names[-1] == "agreement"
    assert {"lines", "rooms"} <= set(names)
    off = config.model_copy(update={"agreement": config.agreement.model_copy(update={"enabled": False})})
    assert "agreement" not in {maker.name for maker in assemble_makers.map_makers(off, assemble.sensors(off))}
    assert "agreement" not in {maker.name for maker in assemble_makers.map_makers(Config(), {})}
    schema_kinds = SCHEMA["properties"]["kinds"]["items"]["properties"]["kind"]["enum"]
    assert sorted(schema_kinds) == sorted(KINDS)
