"""Along a corridor the ends of walls tell where a view is; where there are none, nothing does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.scan_match import match_view, weakest_information
from mapping.localise.slide import slid, worst_direction
from mapping.localise.views import View, ViewStore, table_for, view_of
from mapping.scan import Scan
from sim_devices.floor_plan import FloorPlan, Point, Wall
from sim_devices.world import World

F64 = NDArray[np.float64]
BEARING = np.radians(np.arange(-90.0, 90.0))
TABLE = table_for(BEARING)
KEYS = tuple(Pose2(x, 0.1 * math.sin(x), 0.02 * x) for x in np.arange(-2.0, 2.5, 0.5))


def corridor(*, doors: bool) -> World:
    """30 m of walls 2.4 m apart, with a niche 0.12 m deep and 1 m wide every 3.7 m."""
    walls = []
    for side in (-1.2, 1.2):
        points: list[Point] = [(-15.0, side)]
        for x in np.arange(-13.0 - side, 13.0, 3.7).tolist() if doors else ():
            deep = side * 1.1
            points += [(x, side), (x, deep), (x + 1.0, deep), (x + 1.0, side)]
        walls.append(Wall((*points, (15.0, side)), 0.0))
    return World.from_plan(FloorPlan(walls=tuple(walls)))


def seen(world: World, pose: Pose2, seed: int) -> View:
    origin = np.repeat([[pose.x_m, pose.y_m]], len(BEARING), axis=0)
    true = world.beam_distances(origin, pose.yaw_rad + BEARING, np.zeros(len(BEARING)), z_m=0.3, range_max_m=10.0)
    told = np.round(true + np.random.default_rng(seed).normal(0.0, 0.01, len(true)), 2)
    return view_of(Scan(0, 0.0, BEARING, told, 0.05, 10.0), TABLE, farthest_m=10.0, grazed=True)


def store_of(world: World) -> tuple[ViewStore, F64]:
    store = ViewStore()
    for k, pose in enumerate(KEYS):
        store.add(seen(world, pose, 10 + k))
    return store, np.array([(p.x_m, p.y_m, p.yaw_rad) for p in KEYS])


@pytest.mark.parametrize("off_m", [-0.4, -0.2, 0.0, 0.3])
@pytest.mark.parametrize("yaw_rad", [math.pi, 3.1, 0.03])
def test_doors_tell_how_far_along_also_from_the_other_end(yaw_rad: float, off_m: float) -> None:
    world = corridor(doors=True)
    store, poses = store_of(world)
    truth = Pose2(0.3, -0.15, yaw_rad)
    view, rows = seen(world, truth, 1), np.arange(len(KEYS))
    guess = Pose2(truth.x_m + off_m, truth.y_m + 0.05, truth.yaw_rad + 0.02)
    match = match_view(view, store.kept(), rows, poses, guess)
    assert match is not None
    found = slid(view, store.kept(), rows, poses, match, prominence=0.04)
    assert found is not None
    assert found.pose.x_m == pytest.approx(truth.x_m, abs=0.09)  # three deviations of what it promises
    assert found.pose.y_m == pytest.approx(truth.y_m, abs=0.02)
    assert math.sqrt(1.0 / weakest_information(found.information())) <= 0.031


@pytest.mark.parametrize("yaw_rad", [math.pi, 0.0])
def test_bare_walls_tell_nothing_along_themselves(yaw_rad: float) -> None:
    world = corridor(doors=False)
    store, poses = store_of(world)
    view, rows = seen(world, Pose2(0.3, -0.15, yaw_rad), 1), np.arange(len(KEYS))
    match = match_view(view, store.kept(), rows, poses, Pose2(0.4, -0.1, yaw_rad))
    assert match is not None
    assert slid(view, store.kept(), rows, poses, match, prominence=0.04) is None


def test_the_worst_direction_is_that_of_the_corridor() -> None:
    c, s = math.cos(0.4), math.sin(0.4)
    turn = np.array([[c, -s], [s, c]])
    information = np.diag([0.0, 0.0, 1e6])
    information[:2, :2] = turn @ np.diag([10.0, 1e4]) @ turn.T
    along = worst_direction(information)
    assert abs(float(along @ np.array([c, s]))) == pytest.approx(1.0)
    assert abs(float(worst_direction(np.diag([1e4, 10.0, 1e6]))[1])) == pytest.approx(1.0)
