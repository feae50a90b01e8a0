"""Rooms of a furnished flat while the daemon's own fusion draws it: they settle, and every room can be gone to.

No time passes: grids are taken as they are published, the maker has its turn every five seconds of the readings' time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

from mapping.frames import Pose2
from service.map_makers import MapMakers
from service.outputs import DocumentOut, Output
from service.room_maker import RoomMaker
from tests.world.test_live_slam_worlds import drive, robot

ROOMS = {
    "bedroom": (0.0, 4.0, 0.0, 3.4),
    "bath": (4.0, 6.2, 0.0, 3.4),
    "study": (6.2, 10.0, 0.0, 3.4),
    "corridor": (0.0, 10.0, 3.4, 4.8),
    "living room": (0.0, 6.2, 4.8, 8.0),
    "kitchen": (6.2, 10.0, 4.8, 8.0),
}
"""x from, to, y from, to between the walls of the floor plan: what counts as a room is what has a name there."""

DOORS = [
    {"bath", "corridor"},
    {"bedroom", "corridor"},
    {"corridor", "kitchen"},
    {"corridor", "living room"},
    {"corridor", "study"},
    {"kitchen", "living room"},
]
CLEARANCE_M = 0.2


def room_at(x_m: float, y_m: float) -> str:
    """ "outside" if it is none."""
    inside = (name for name, (x0, x1, y0, y1) in ROOMS.items() if x0 <= x_m <= x1 and y0 <= y_m <= y1)
    return next(inside, "outside")


@dataclass
class Told:
    """All documents of a run, and the maker at its end."""

    maker: RoomMaker
    documents: list[DocumentOut] = field(default_factory=list)
    end: Pose2 | None = None

    def rooms(self, k: int) -> dict[int, str]:
        """What each id of a document is called in the floor plan."""
        rooms = self.documents[k].fields["rooms"]
        assert isinstance(rooms, list)
        return {room["id"]: room_at(*room["position"]) for room in rooms}


@lru_cache(maxsize=1)
def two_laps() -> Told:
    driving = drive("flat", 2.0)
    told = Told(RoomMaker(clearance_m=CLEARANCE_M))

    def offer(output: Output) -> None:
        assert isinstance(output, DocumentOut)
        told.documents.append(output)

    makers = MapMakers([told.maker], offer, now_ns=lambda: 0)
    made = robot(driving.truth(0), makers=makers)
    made.play(driving.items)
    assert makers.counters()["makers.errors"] == 0
    told.end = made.poses[-1].map_from_base
    return told


def test_after_two_laps_the_rooms_are_those_of_the_flat() -> None:
    told = two_laps()
    assert sorted(told.rooms(-1).values()) == sorted(ROOMS)
    rooms, doors = (told.documents[-1].fields[each] for each in ("rooms", "doors"))
    assert isinstance(rooms, list)
    assert isinstance(doors, list)
    of_id = told.rooms(-1)
    led = sorted(sorted(of_id[each] for each in door["rooms"]) for door in doors)
    assert led == sorted(sorted(each) for each in DOORS)
    assert all(door["width_m"] > 0.7 for door in doors)
    for room in rooms:
        x0, x1, y0, y1 = ROOMS[of_id[room["id"]]]
        whole_m2 = (x1 - x0) * (y1 - y0)
        assert 0.45 * whole_m2 < room["area_m2"] < whole_m2  # furniture at the walls is not in it


def test_no_id_ever_changes_its_room_and_none_is_wasted() -> None:
    told = two_laps()
    assert len(told.documents) > 10
    meant: dict[int, str] = {}
    for k in range(len(told.documents)):
        for room_id, name in told.rooms(k).items():
            assert meant.setdefault(room_id, name) == name, f"document {k}: id {room_id}"
    assert sorted(meant.values()) == sorted(ROOMS)
    first_whole = next(k for k in range(len(told.documents)) if len(told.rooms(k)) == len(ROOMS))
    assert all(told.rooms(k) == meant for k in range(first_whole, len(told.documents)))
    assert told.documents[first_whole].stamp_ns < 60e9  # in the second lap at the latest


def test_every_room_can_be_planned_to_by_id_and_by_name() -> None:
    told = two_laps()
    for room_id, name in told.rooms(-1).items():
        told.maker.name_room({"id": room_id, "name": name})
        answer = told.maker.plan({"goal": name})
        assert answer == told.maker.plan({"goal": room_id})
        x_m, y_m, _ = answer["poses"][-1]
        assert room_at(x_m, y_m) == name
        assert answer["least_clearance_m"] >= CLEARANCE_M
        assert told.end is not None
        assert math.dist(answer["poses"][0][:2], (told.end.x_m, told.end.y_m)) < 0.02
        back = told.maker.plan({"start": name, "goal": [told.end.x_m, told.end.y_m]})
        assert back["rooms"][0] == room_id
