"""Buildings of the simulator for bench/localise.py: corridors that look alike, mapped one day, driven another.

The map is drawn from a drive with known poses, bent by up to BENT_M as maps by SLAM are, in cells of 0.05 or 0.10 m,
with stretches of the drive left out. When the robot comes back, bins and benches stand elsewhere, some doors that were
shut are open and some that were open are shut, and people have left boxes. It drives the same corridors, mostly the
other way round, with odometry that errs as bench/slam_large.py makes it. Truth is exact.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from bench.slam_large import ALIKE, COURTS, HALLS, MOUNT, Wheels
from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.localise.known_map import BEAMS, FARTHEST_M, KnownMap, Points, known_map, points_of
from sim_devices.big_building import NICHE_M, BigBuilding
from sim_devices.floor_plan import Box, Circle, FloorPlan, Point
from sim_devices.robot import follow
from sim_devices.world import World

F64 = NDArray[np.float64]

BENT_M = 0.12
BENT_EVERY_M = 45.0
OPENED, SHUT, MOVED, NEW_EVERY_M = 0.12, 0.3, 0.5, 12.0  # shares of doors and things; new boxes along the way
LEFT_OUT = 0.15  # of the drive, in stretches
STRETCH_S = 12.0
HERTZ = 5.0
BEARINGS: F64 = np.radians(np.arange(-90.0, 90.0))


@dataclass(frozen=True, slots=True)
class Visit:
    """A building that is mapped and visited again. range_m: the laser's reach.  back: the visit drives the tour from
    its end to its start."""

    building: BigBuilding
    seed: int
    cell_m: float
    range_m: float
    back: bool


WORLDS: dict[str, Visit] = {
    "courts": Visit(COURTS, 31, 0.05, 30.0, True),
    "courts8": Visit(COURTS, 32, 0.10, 8.0, False),
    "alike": Visit(ALIKE, 33, 0.05, 30.0, True),
    "halls": Visit(HALLS, 34, 0.10, 20.0, True),
}


def bent(places: F64, phase: F64) -> F64:
    """Where places (N, 2 or more) lie in a map that is bent: shifted slowly to and fro, nowhere turned by much."""
    out = places.copy()
    k = 2.0 * math.pi / BENT_EVERY_M
    out[:, 0] += BENT_M * np.sin(k * places[:, 1] + phase[0]) + BENT_M * np.sin(0.7 * k * places[:, 0] + phase[1])
    out[:, 1] += BENT_M * np.sin(k * places[:, 0] + phase[2]) + BENT_M * np.sin(0.7 * k * places[:, 1] + phase[3])
    return out


def another_day(plan: FloorPlan, rng: np.random.Generator) -> FloorPlan:
    """The same building with other doors open and other things about."""
    walls = []
    for wall in plan.walls:
        niche, room = len(wall.points) == 4, len(wall.points) == 8
        if niche and rng.random() < OPENED:
            wall = replace(wall, points=_room_behind(wall.points, float(rng.uniform(2.0, 5.0))))
        elif room and rng.random() < SHUT:
            wall = replace(wall, points=(wall.points[0], wall.points[-1]))
        walls.append(wall)
    boxes = [box for box in plan.boxes if rng.random() > MOVED]
    circles = [circle for circle in plan.circles if rng.random() > MOVED]
    assert plan.route is not None
    way = np.array(plan.route.points)
    for a, b in itertools.pairwise(way):
        length = float(np.hypot(*(b - a)))
        across = np.array([-(b - a)[1], (b - a)[0]]) / max(length, 1e-6)
        for _ in range(rng.poisson(length / NEW_EVERY_M)):
            at = a + rng.uniform(0.1, 0.9) * (b - a) + rng.choice([-1.0, 1.0]) * 0.95 * across
            if rng.random() < 0.5:
                circles.append(Circle((float(at[0]), float(at[1])), 0.2))
            else:
                boxes.append(Box((float(at[0]), float(at[1])), (0.5, 0.4)))
    return replace(plan, walls=tuple(walls), boxes=tuple(boxes), circles=tuple(circles))


def _room_behind(niche: Sequence[Point], depth_m: float) -> tuple[Point, ...]:
    """The outline of a room behind a door that was a niche: a, a deep, b deep, b."""
    a, a_in, b_in, b = (np.array(p) for p in niche)
    inward, along = (a_in - a) / NICHE_M, (b - a) / np.hypot(*(b - a))
    corners = (
        a, a_in, a_in - 0.5 * along, a_in - 0.5 * along + depth_m * inward,
        b_in + 0.5 * along + depth_m * inward, b_in + 0.5 * along, b_in, b,
    )  # fmt: skip
    return tuple((float(p[0]), float(p[1])) for p in corners)


def _looked(plan: FloorPlan, seed: int, time_s: F64, poses: F64, range_m: float) -> list[F64]:
    """(180,) ranges at each pose (N, 3), the laser erring by 1.5 cm and telling whole centimetres."""
    world, rng, out = World.from_plan(plan, seed), np.random.default_rng(seed + 1), []
    for now_s, at in zip(time_s, poses):
        sensor = Pose2(*at.tolist()) @ MOUNT
        origin = np.repeat([[sensor.x_m, sensor.y_m]], len(BEARINGS), axis=0)
        reach = world.beam_distances(
            origin, sensor.yaw_rad + BEARINGS, np.full(len(BEARINGS), now_s), z_m=0.3, range_max_m=range_m
        )
        out.append(np.round((reach + rng.normal(0.0, 0.015, len(reach))) * 100.0) / 100.0)
    return out


def map_of(name: str) -> KnownMap:
    """The map of the first day."""
    visit = WORLDS[name]
    plan = visit.building.plan(visit.seed)
    assert plan.route is not None
    motion, rng = follow(plan.route), np.random.default_rng(crc32(name.encode()))
    time_s = np.arange(0.0, motion.lap_s, 1.0 / HERTZ)
    poses = motion.pose_at(time_s)
    stretch = (time_s // STRETCH_S).astype(int)
    kept = (rng.random(stretch.max() + 1) >= LEFT_OUT)[stretch]
    drawn = bent(poses, phases(name))
    grid = OccupancyGrid(model="log-odds", resolution_m=visit.cell_m)
    for pose, reach in zip(drawn[kept], _looked(plan, visit.seed, time_s[kept], poses[kept], visit.range_m)):
        sensor = Pose2(*pose.tolist()) @ MOUNT
        grid.insert_scan(sensor, BEARINGS, reach, range_max_m=visit.range_m, clear_no_return=False)
    return known_map(grid.patch())


def phases(name: str) -> F64:
    """(4,) of the bends."""
    return np.random.default_rng(crc32(name.encode()) + 1).uniform(0.0, 2.0 * math.pi, 4)


def driven_again(name: str) -> tuple[F64, F64, list[Points], F64]:
    """Another day's drive: stamps (N,), odometry (N, 3), points of each scan, true poses in the map (N, 3)."""
    visit = WORLDS[name]
    plan = visit.building.plan(visit.seed)
    assert plan.route is not None
    route = replace(plan.route, points=plan.route.points[::-1]) if visit.back else plan.route
    motion, rng = follow(route), np.random.default_rng(crc32(name.encode()) + 2)
    time_s = np.arange(0.0, motion.lap_s, 1.0 / HERTZ)
    poses = motion.pose_at(time_s)
    today = another_day(plan, rng)
    points = [
        points_of(BEARINGS, np.where(reach < visit.range_m, reach, np.inf), MOUNT,
                  nearest_m=0.05, farthest_m=FARTHEST_M, most=BEAMS)
        for reach in _looked(today, visit.seed + 1000, time_s, poses, visit.range_m)
    ]  # fmt: skip
    return time_s, Wheels().odometry(poses, rng), points, bent(poses, phases(name))
