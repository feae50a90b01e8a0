"""Ids of rooms over many laps: furniture moved, a door shut and opened, a wing found; the truth is the simulator's.

The grid is the daemon's own layer, published and put together again as in the daemon; poses err as SLAM's do. As many
laps as UMFELD_LAPS says (30 if not said; `make soak` drives 200).
"""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from mapping.frames import IDENTITY, Pose2
from mapping.scan import Scan
from service import assemble
from service.fusion import carry
from service.map_makers import MapMakers
from service.outputs import DocumentOut, Output, PoseOut
from service.room_maker import RoomMaker
from sim_devices.floor_plan import Box, FloorPlan, Point, Route
from sim_devices.robot import follow
from sim_devices.world import World
from tests.world.test_live_agreement import STUDY, still
from tests.world.test_live_rooms import ROOMS, room_at
from tests.world.test_live_slam_worlds import BEARING, CONFIG, MOUNT, RANGE_MAX_M, seen_m

LAPS = int(os.environ.get("UMFELD_LAPS", "30"))
WING_SHUT_UNTIL = 0.3  # shares of all laps
STUDY_SHUT = (0.5, 0.7)
MOVED_EVERY = 0.1
SCAN_S = 0.5
BEDROOM = 0  # of the doors in the floor plan
PLACES: tuple[Point, ...] = ((3.8, 7.3), (1.3, 6.3), (3.8, 5.5), (5.5, 7.4), (9.0, 2.6), (7.0, 2.9), (1.0, 2.6))
"""Where a box of half a metre is put down, beside the robot's way: in the living room, the study, the bedroom."""


@dataclass
class Lap:
    """What is true on one lap, and what was told."""

    wing: bool
    study: bool
    documents: list[dict[int, str]] = field(default_factory=list)
    doors: list[set[frozenset[str]]] = field(default_factory=list)


def world_of(plan: FloorPlan, *, wing: bool, study: bool, box_at: Point) -> World:
    doors = list(plan.doors)
    for number, is_open in ((BEDROOM, wing), (STUDY, study)):
        if not is_open:
            doors[number] = dataclasses.replace(doors[number], open_deg=0.0)
    box = Box(center=box_at, size_m=(0.5, 0.5))
    return World.from_plan(dataclasses.replace(plan, doors=tuple(doors), boxes=(*plan.boxes, box)))


def way(*, wing: bool, study: bool) -> Route:
    south = [(2.5, 2.1)] if wing else []
    east = [(8.0, 2.1)] if study else []
    points = [(1.0, 4.1), (8.0, 4.1), *east, (8.0, 6.35), (2.5, 6.35), *south, (2.5, 4.1), (5.0, 4.1), (5.0, 2.4)]
    return Route((*points, (5.0, 4.1)), closed=True, speed_m_s=1.0, corner_radius_m=0.5)


@lru_cache(maxsize=1)
def laps() -> list[Lap]:
    rng, plan, found = np.random.default_rng(5), still(), assemble.sensors(CONFIG)
    layer = assemble.maps(CONFIG, found).building
    assert layer is not None
    driven: list[Lap] = []

    def offer(output: Output) -> None:
        assert isinstance(output, DocumentOut)
        rooms, doors = output.fields["rooms"], output.fields["doors"]
        assert isinstance(rooms, list)
        assert isinstance(doors, list)
        names = {room["id"]: room_at(*room["position"]) for room in rooms}
        driven[-1].documents.append(names)
        driven[-1].doors.append({frozenset(names[each] for each in door["rooms"]) for door in doors})

    makers = MapMakers([RoomMaker(clearance_m=0.2, width_m=0.5)], offer, now_ns=lambda: 0)
    begun_s, box_at = 0.0, PLACES[0]
    for k in range(LAPS):
        share = k / LAPS
        lap = Lap(share >= WING_SHUT_UNTIL, not STUDY_SHUT[0] <= share < STUDY_SHUT[1])
        driven.append(lap)
        if k % max(round(MOVED_EVERY * LAPS), 1) == 0:
            box_at = PLACES[int(rng.integers(len(PLACES)))]
        world = world_of(plan, wing=lap.wing, study=lap.study, box_at=box_at)
        motion = follow(way(wing=lap.wing, study=lap.study))
        for at_s in np.arange(0.0, motion.lap_s, SCAN_S).tolist():
            now_ns = round((begun_s + at_s) * 1e9)
            base = motion.pose_at(np.array([at_s]))[0]
            reach = seen_m(world, np.repeat(base[None], len(BEARING), axis=0), np.full(len(BEARING), at_s))
            scan = Scan(now_ns, 0.0, BEARING, reach + rng.normal(0.0, 0.01, len(reach)), 0.05, RANGE_MAX_M)
            believed = base + rng.normal(0.0, (0.01, 0.01, math.radians(0.2)))
            layer.take_sweep("front", scan, carry(believed[None], MOUNT))
            here = Pose2(*believed.tolist())
            for output in (PoseOut(now_ns, here, IDENTITY, np.eye(3)), *layer.outputs(here, now_ns, now_ns)):
                makers.take_output(output)
            makers.turn(now_ns)
        begun_s += motion.lap_s
    assert makers.counters()["makers.errors"] == 0
    return driven


def test_no_id_changes_its_room_and_each_room_is_one() -> None:
    """A bug: between the sofa and the leaf of the glass door the living room was two."""
    meant: dict[int, str] = {}
    for k, lap in enumerate(laps()):
        for document in lap.documents:
            assert len(document) == len(set(document.values())), f"lap {k}: {document}"
            for room_id, name in document.items():
                assert meant.setdefault(room_id, name) == name, f"lap {k}: id {room_id} was {meant[room_id]}, is {name}"
    assert sorted(meant.values()) == sorted(ROOMS)


def test_a_wing_gets_an_id_when_its_door_opens_and_all_others_keep_theirs() -> None:
    told = [lap for lap in laps() if lap.documents]
    before = [lap.documents[-1] for lap in told if not lap.wing]
    after = told[-1].documents[-1]
    assert before
    assert all("bedroom" not in document.values() for document in before)
    assert set(after.values()) == set(ROOMS)
    assert before[-1].items() <= after.items()


def test_a_room_behind_a_shut_door_keeps_its_id() -> None:
    """Shut, it is a room without a door, or sleeps; open again it is the same."""
    told = [lap for lap in laps() if lap.documents]
    first = next(k for k, lap in enumerate(told) if not lap.study)
    again = next(k for k in range(first, len(told)) if told[k].study)
    ids = [{name: room_id for room_id, name in told[k].documents[-1].items()} for k in (first - 1, -1)]
    assert ids[0]["study"] == ids[1]["study"]
    door = frozenset(("corridor", "study"))
    assert [door in told[k].doors[-1] for k in (first - 1, again - 1, -1)] == [True, False, True]


def test_furniture_was_moved_and_seen() -> None:
    """Else the rest would prove little: rooms are told anew on most laps."""
    assert sum(len(lap.documents) for lap in laps()) > LAPS
