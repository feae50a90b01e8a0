"""People who leave, edges that mix and the robot's own body, from simulated readings through fusion into the grid.

The test owns the clock: readings are made for the moments that it names.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.readings import ScanReading
from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from service import assemble
from service.config import Config
from service.fusion import Fusion, OdometryOnly
from sim_devices.floor_plan import Box, FloorPlan, WalkerPlan, Wall
from sim_devices.world import World

F64 = NDArray[np.float64]

SECOND = 1_000_000_000
PERIOD_S = 0.1
D = 0.05
MAX_M = 20.0
BEARING = np.radians(np.arange(-135.0, 135.01, 0.5))
LASER_Z_M = 0.3
HALF_WIDTH_M = 1.2
OPENING = (2.5, 3.5)  # where people come in on one side of the corridor and leave on the other
CORRIDOR = tuple(
    Wall(points=((start, side), (end, side)))
    for side in (-HALF_WIDTH_M, HALF_WIDTH_M)
    for start, end in ((-3.0, OPENING[0]), (OPENING[1], 8.0))
)


class Robot:
    """A daemon's fusion and building grid, standing at the origin."""

    def __init__(self, **grid: object) -> None:
        lasers, stands = {"front": {"driver": "hokuyo", "port": "/dev/none"}}, {"laser_odometry": False}
        config = Config.model_validate({"lasers": lasers, "drive": stands, "grid": grid})
        sensors = assemble.sensors(config)
        maps = assemble.maps(config, sensors)
        assert maps.building is not None
        self.grid: OccupancyGrid = maps.building.grid
        self.fusion = Fusion(assemble.parts(config, sensors, maps, OdometryOnly()))

    def see(self, ranges: F64, time_s: float) -> None:
        stamp_ns = round((1.0 + time_s) * SECOND)
        self.fusion.on_item("front", ScanReading(stamp_ns, 0.0, SECOND // 10, BEARING, ranges, 0.1, MAX_M), stamp_ns)
        self.fusion.settle(stamp_ns)

    def obstacles(self) -> F64:
        """(N, 2) centres of occupied cells."""
        patch = self.grid.patch()
        rows, cols = np.nonzero(patch.cells >= 65)
        return np.stack(((cols + patch.col0 + 0.5) * D, (rows + patch.row0 + 0.5) * D), axis=-1)


def seen(world: World, time_s: float) -> F64:
    count = BEARING.size
    return world.beam_distances(np.zeros((count, 2)), BEARING, np.full(count, time_s), z_m=LASER_Z_M, range_max_m=MAX_M)


def in_the_way(points: F64) -> F64:
    """Those of some points that lie in the corridor, off its walls."""
    return points[np.abs(points[:, 1]) < HALF_WIDTH_M - 0.1]


@pytest.mark.parametrize(("pause_s", "gone_s"), [(0.0, 10.0), (20.0, 15.0)])
def test_a_person_leaves_no_obstacle_in_a_corridor_without_an_end(pause_s: float, gone_s: float) -> None:
    """Behind the person nothing answers. Once crossing, once standing in the middle until the map believes it."""
    walker = WalkerPlan(points=((3.0, -12.0), (3.0, 0.0), (3.0, 12.0)), pause_s=pause_s)
    world = World.from_plan(FloorPlan(walls=CORRIDOR, walkers=(walker,)), seed=5)
    robot = Robot()
    last_seen_s, hits, believed, looked = 0.0, 0, 0, 0
    for step in range(1800):
        now_s = step * PERIOD_S
        robot.see(seen(world, now_s), now_s)
        _, y_m = world.walkers[0].place_now(now_s)
        if abs(y_m) < 2.0:
            last_seen_s = now_s
            hits = max(hits, int(robot.grid.counts_at([(2.85, y_m), (2.9, y_m), (3.0, y_m)])[0].max()))
            believed = max(believed, len(in_the_way(robot.obstacles())))
        elif now_s - last_seen_s >= gone_s and step % 10 == 0:
            looked += 1
            assert in_the_way(robot.obstacles()).tolist() == []
    assert looked > 10
    assert hits > 0
    assert (believed > 0) == (pause_s > 0.0)
    assert len(robot.obstacles()) > 100  # the walls are there


def test_a_device_that_cannot_tell_nothing_from_not_known_needs_forgetting() -> None:
    """Where the person stood nothing is ever measured again; only what is forgotten goes."""
    bearing_0 = np.abs(BEARING) < 0.05
    stands, gone = np.where(bearing_0, 3.0, np.nan), np.full(BEARING.size, np.nan)
    keeps, forgets = Robot(), Robot(halve_every_s=5.0)
    for robot in (keeps, forgets):
        for step in range(200):
            robot.see(stands, step * PERIOD_S)
        assert len(robot.obstacles()) > 0
        for step in range(200, 800):
            robot.see(gone, step * PERIOD_S)
    assert len(keeps.obstacles()) > 0
    assert len(forgets.obstacles()) == 0
    assert (forgets.grid.patch().cells >= 0).sum() == 0  # unknown, not free


def test_mixed_pixels_draw_nothing() -> None:
    """Beside a box, half of the beams at its edges read something between it and the wall behind."""
    boxes = (Box(center=(2.0, 0.3), size_m=(0.4, 0.4)),)
    end = Wall(points=((6.0, -HALF_WIDTH_M), (6.0, HALF_WIDTH_M)))
    sides = tuple(Wall(points=((-3.0, side), (6.0, side))) for side in (-HALF_WIDTH_M, HALF_WIDTH_M))
    world = World.from_plan(FloorPlan(walls=(*sides, end), boxes=boxes))
    random = np.random.default_rng(2)
    robot, plain = Robot(), OccupancyGrid()
    truth = seen(world, 0.0)
    steps = np.diff(truth)
    for step in range(60):
        ranges = truth + random.normal(0.0, 0.005, truth.size)
        edges = np.flatnonzero((np.abs(steps) > 1.0) & (random.random(steps.size) < 0.5))
        ranges[edges] += random.uniform(0.2, 0.8, edges.size) * steps[edges]
        robot.see(ranges, step * PERIOD_S)
        plain.insert_scan(Pose2(), BEARING, ranges, range_max_m=MAX_M)
    assert robot.fusion.counters()["fusion.mixed_pixels"] > 20

    def between(grid: OccupancyGrid) -> int:
        """Hits behind the box and before the end, off the walls."""
        x, y = np.meshgrid(np.arange(2.35, 5.7, D), np.arange(-0.95, 0.95, D))
        return int(grid.counts_at(np.stack((x.ravel(), y.ravel()), axis=-1))[0].sum())

    assert between(plain) > 20
    assert between(robot.grid) == 0


def test_the_robot_does_not_draw_itself() -> None:
    """A mast stands in the view of the laser; one part of it is too close to be measured."""
    robot = Robot()
    ranges = np.full(BEARING.size, 4.0)
    ranges[100:120], ranges[120:130] = 0.15, -math.inf
    for step in range(20):
        robot.see(ranges, step * PERIOD_S)
    assert robot.fusion.counters()["fusion.beams_on_robot"] == 20 * 30
    assert np.hypot(*robot.obstacles().T).min() > 3.5
    shadow = 2.0 * np.stack((np.cos(BEARING[103:127]), np.sin(BEARING[103:127])), axis=-1)
    assert np.isnan(robot.grid.probability_at(shadow)).all()
