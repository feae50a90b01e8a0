"""Places and hallways in the daemon: the flat with its glass door, people walking, wheels that err, SLAM beside."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from drivers.readings import ScanReading
from mapping.scan import Scan
from service.map_makers import MapMakers, MapView
from service.outputs import DocumentOut, Output
from service.place_maker import PlaceMaker
from service.routes import route_answer
from sim_devices.floor_plan import load_floor_plan
from sim_devices.robot import follow
from sim_devices.world import World
from tests.world.test_live_agreement import still
from tests.world.test_live_rooms import ROOMS, room_at
from tests.world.test_live_slam_worlds import BEARING, MOUNT, RANGE_MAX_M, Drive, robot, said

MARGIN_M = 0.35


@dataclass
class Told:
    maker: PlaceMaker
    makers: MapMakers
    driving: Drive
    documents: list[DocumentOut] = field(default_factory=list)

    def rooms(self) -> dict[int, set[str]]:
        """By area, the true rooms in which the robot was when it was told to be there, but for doorways."""
        found: dict[int, set[str]] = {}
        for each in self.documents:
            where: Any = each.fields["where"]
            truth = self.driving.truth(each.stamp_ns)
            near = [(dx, dy) for dx in (-MARGIN_M, MARGIN_M) for dy in (-MARGIN_M, MARGIN_M)]
            around = {room_at(truth.x_m + dx, truth.y_m + dy) for dx, dy in near}
            if where is not None and not where["in_opening"] and len(around) == 1:
                found.setdefault(where["area"], set()).update(around)
        return found


@lru_cache(maxsize=2)
def driven(name: str) -> Told:
    """name: flat as it is, or still: glass painted, nobody walking."""
    plan = load_floor_plan("flat") if name == "flat" else still()
    assert plan.route is not None
    world, motion = World.from_plan(plan), follow(plan.route)
    driving = Drive(world, motion, said(lambda _stamp_s: world, motion, 2.0 * motion.lap_s))
    maker = PlaceMaker("front", MOUNT)
    documents: list[DocumentOut] = []

    def offer(output: Output) -> None:
        assert isinstance(output, DocumentOut)
        documents.append(output)

    makers = MapMakers([maker], offer, now_ns=lambda: 0)
    robot(driving.truth(0), makers=makers).play(driving.items)
    assert makers.counters()["makers.errors"] == 0
    return Told(maker, makers, driving, documents)


WORLDS = ["still", "flat"]
OPEN_PLAN = {"kitchen", "living room"}
"""Joined by an opening of 1.6 m, which is no door: one place."""


@pytest.mark.parametrize("name", WORLDS)
def test_areas_are_rooms_and_none_is_taken_for_another(name: str) -> None:
    rooms = driven(name).rooms()
    assert all(len(each) == 1 or each == OPEN_PLAN for each in rooms.values()), rooms
    assert sorted(room for each in rooms.values() for room in each) == sorted(ROOMS)
    (last,) = driven(name).documents[-1:]
    nodes: Any = last.fields["nodes"]
    assert {node["id"] for node in nodes} == set(rooms)
    for node in nodes:
        assert node["what"] == ("hallway" if rooms[node["id"]] == {"corridor"} else "place")
        if node["what"] == "hallway":
            assert [c["at"][0] for c in node["corners"]] == sorted(c["at"][0] for c in node["corners"])


@pytest.mark.parametrize("name", WORLDS)
def test_the_level_of_localisation_is_told_as_it_switches(name: str) -> None:
    told = driven(name)
    rooms = told.rooms()
    for each in told.documents:
        where: Any = each.fields["where"]
        if where is not None:
            in_hallway = rooms.get(where["area"]) == {"corridor"}
            assert where["level"] == ("along" if in_hallway else "metric")
            assert ("way_m" in where) is in_hallway
    assert told.makers.counters()["places.switched"] >= 14  # seven rooms entered and left, at least
    assert told.maker.hybrid.revisits >= 7  # the whole second lap


@pytest.mark.parametrize("name", WORLDS)
def test_edges_lie_in_the_doors_of_the_flat(name: str) -> None:
    edges: Any = driven(name).documents[-1].fields["edges"]
    doors = [(2.5, 3.4), (5.0, 3.4), (8.0, 3.4), (2.5, 4.8), (8.0, 4.8)]
    middles = [tuple((a + b) / 2 for a, b in zip(*edge["ends"])) for edge in edges]
    assert all(min(math.dist(middle, door) for middle in middles) < 0.15 for door in doors), middles
    assert len(middles) == len(doors)


def test_a_route_leads_along_the_hallway() -> None:
    told = driven("flat")
    number = {next(iter(rooms)): area for area, rooms in told.rooms().items() if len(rooms) == 1}
    answer = route_answer(told.maker.ways(), {"from": f"place {number['bedroom']}", "to": f"place {number['study']}"})
    assert answer["kind"] == "areas"
    assert all(node.startswith(f"node {number['corridor']}.") for node in answer["nodes"][1:-1])
    assert answer["length_m"] == pytest.approx(5.5 + 3.5, abs=1.5)
    assert "positions" not in answer


def test_a_kept_map_goes_on_and_the_robot_finds_itself_or_is_lost() -> None:
    told = driven("flat")
    again = PlaceMaker("front", MOUNT)
    told.maker._is_kept = False
    tiles = told.maker.changed_tiles()
    again.restore(tiles)
    assert again.hybrid.state() == told.maker.hybrid.state()
    assert again.changed_tiles() == []
    (document,) = again.make(MapView(0, None, (), None))
    assert isinstance(document, DocumentOut)
    assert document.fields["where"] is None
    nodes: Any = document.fields["nodes"]
    now: Any = told.maker._fields()["nodes"]
    for kept, made in zip(nodes, now, strict=True):
        for key in ("id", "what", "name", "visits", "area_frame"):
            assert kept[key] == made[key]
        assert (len(kept["walls"]), len(kept["openings"])) == (len(made["walls"]), len(made["openings"]))
    rooms, right = told.rooms(), 0
    scans = [reading for _, reading in told.driving.items if isinstance(reading, ScanReading)]
    for reading in scans[:450:30]:
        again.restore(tiles)
        truth = told.driving.truth(reading.stamp_ns) @ MOUNT
        pose = np.array([[truth.x_m, truth.y_m, truth.yaw_rad]])
        scan = Scan(reading.stamp_ns, 0.0, BEARING, reading.range_m, 0.05, RANGE_MAX_M)
        again.take_sweep("front", scan, pose)
        where = again.hybrid.where()
        if where.area is not None:
            assert room_at(truth.x_m, truth.y_m) in rooms[where.area] or where.leaving
            right += 1
    assert right >= 5


def test_damaged_tiles_are_refused() -> None:
    maker = PlaceMaker("front", MOUNT)
    for payload in (b"", b"rubbish", zlib.compress(b"{}"), zlib.compress(b'{"map": {}, "frames": {}}')):
        with pytest.raises(ValueError, match=r"places are damaged|hierarchical|JSON|Expecting"):
            maker.restore([(0, 0, payload)])
