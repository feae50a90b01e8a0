"""Grid, lines and rooms of the daemon's own makers against each other, in a flat in which a door is shut on the way."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import Any

from mapping.frames import Pose2
from mapping.lines.line_map import LineMap
from service.agreement_maker import KINDS, AgreementMaker
from service.line_maker import LineMaker
from service.map_makers import MapMakers
from service.outputs import DocumentOut, Output
from service.room_maker import RoomMaker
from service.topo_maker import TopoMaker
from sim_devices.floor_plan import FloorPlan, Route, load_floor_plan
from sim_devices.robot import follow
from sim_devices.world import World
from tests.world.test_live_slam_worlds import Drive, robot, said

SHUT_S = 34.0
STUDY = 2  # of the doors in the floor plan


def still() -> FloorPlan:
    """The flat with glass painted over and nobody walking: what one view sees the others can see."""
    plan = load_floor_plan("flat")
    walls = tuple(dataclasses.replace(each, material="wall") for each in plan.walls)
    doors = tuple(dataclasses.replace(each, material="wall") for each in plan.doors)
    boxes = tuple(dataclasses.replace(each, material="wall") for each in plan.boxes)
    return dataclasses.replace(plan, walls=walls, doors=doors, boxes=boxes, walkers=())


@lru_cache(maxsize=2)
def documents(shut: bool) -> list[dict[str, Any]]:
    """Fields of all that was told, in order, with key and stamp_s."""
    plan = still()
    door = dataclasses.replace(plan.doors[STUDY], open_deg=0.0)
    changed = dataclasses.replace(plan, doors=(*plan.doors[:STUDY], door, *plan.doors[STUDY + 1 :]))
    before, after = World.from_plan(plan), World.from_plan(changed if shut else plan)
    points = [(1.0, 4.1), (8.0, 4.1), (8.0, 2.1), (8.0, 4.1), (1.0, 4.1), (8.6, 4.1), (1.0, 4.1)]
    motion = follow(Route(tuple(points), speed_m_s=1.0, corner_radius_m=0.5, pause_s=1.0))
    items = said(lambda stamp_s: before if stamp_s < SHUT_S else after, motion, 62.0)
    driving = Drive(before, motion, items)
    told: list[dict[str, Any]] = []

    def offer(output: Output) -> None:
        assert isinstance(output, DocumentOut)
        told.append({"key": output.key, "stamp_s": output.stamp_ns * 1e-9, **output.fields})

    lines, rooms = LineMaker(LineMap(), ["front"]), RoomMaker(clearance_m=0.2, period_ns=12_000_000_000)
    topo = TopoMaker(period_ns=12_000_000_000)
    checking = AgreementMaker(lines=lines, rooms=rooms, topo=topo, sources=["front"])
    makers = MapMakers([lines, rooms, topo, checking], offer, now_ns=lambda: 0)
    start = driving.truth(0)
    robot(Pose2(start.x_m, start.y_m, start.yaw_rad), makers=makers).play(items)
    assert makers.counters()["makers.errors"] == 0
    assert {f"agreement.{kind}" for kind in KINDS} <= set(makers.counters())
    return told


def of_kind(document: dict[str, Any], kind: str) -> dict[str, int]:
    return next((each for each in document["kinds"] if each["kind"] == kind), {"agree": 0, "disagree": 0, "began": 0})


def test_maps_of_one_still_flat_agree_all_the_way() -> None:
    told = [each for each in documents(False) if each["key"] == "map/agreement"]
    assert [each["where"] for each in told if each["disagreements"]] == []
    agreed = {each["kind"]: each["agree"] for each in told[-1]["kinds"]}
    assert agreed.keys() == KINDS.keys()
    assert agreed["door_is_blocked"] == agreed["room_is_occupied"] == 6  # all doors and rooms of the flat
    assert agreed["door_is_walled"] >= 4  # beside the others the line map has no wall at both jambs
    assert min(agreed[kind] for kind in ("wall_is_free", "place_is_occupied", "way_is_blocked", "way_is_walled")) > 20


def test_a_door_that_is_shut_is_told_until_the_rooms_know() -> None:
    """The line map has its leaf at once, the grid some seconds later; rooms come every twelve."""
    told = [each for each in documents(True) if each["key"] == "map/agreement"]
    assert not any(each["disagreements"] for each in told if each["stamp_s"] < SHUT_S)
    kinds = ("door_is_walled", "door_is_blocked", "way_is_walled", "way_is_blocked")
    for kind, what in zip(kinds, ("door", "door", "passage", "passage")):
        found = [each for each in told if of_kind(each, kind)["disagree"]]
        assert found, kind
        (where,) = (each for each in found[0]["where"] if each["kind"] == kind)
        assert where["what"].startswith(what)
        assert abs(where["position"][0] - 8.0) < 0.3
        assert abs(where["position"][1] - 3.4) < 0.2
        assert found[-1]["stamp_s"] - found[0]["stamp_s"] < 15.0
        last = of_kind(told[-1], kind)
        assert (last["disagree"], last["began"], last["ended"]) == (0, 1, 1)
