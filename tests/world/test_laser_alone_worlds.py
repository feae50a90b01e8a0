"""A turning laser and nothing else, as somebody carries it through a building: no wheels, sweeps of a seventh second.

No time passes: sweeps are handed over in the order of their stamps. Judged is what is published, against the world.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.readings import Reading, ScanReading
from service.config import Config
from sim_devices.floor_plan import load_floor_plan
from sim_devices.robot import follow
from sim_devices.world import World
from tests.world.test_live_slam_worlds import HEIGHT_M, MOUNT, Drive, Robot, pose_errors_m, robot, wall_errors_m

F64 = NDArray[np.float64]

HZ = 7.0
BEAMS = 570
BEARING = math.pi - np.linspace(0.0, 2.0 * math.pi, BEAMS, endpoint=False)  # clockwise
REACH_M = 12.0
FIRST_S = 0.1
CONFIG = Config.model_validate(
    {
        "lasers": {
            "front": {
                "driver": "rplidar",
                "port": "/dev/none",
                "mount": {"x_m": MOUNT.x_m, "y_m": MOUNT.y_m, "yaw_deg": math.degrees(MOUNT.yaw_rad), "z_m": HEIGHT_M},
            }
        }
    }
)


def carried(name: str, laps: float, *, unseen_s: Sequence[tuple[float, float]] = ()) -> Drive:
    """What the laser says on `laps` of a world's route (1 m/s, corners at 1.8 rad/s); nothing in the spans unseen_s."""
    plan = load_floor_plan(name)
    assert plan.route is not None
    world, way = World.from_plan(plan, 0), follow(plan.route)
    rng, period_s = np.random.default_rng(0), 1.0 / HZ
    items: list[tuple[str, Reading]] = []
    for sweep_s in np.arange(FIRST_S, laps * way.lap_s - 0.3, period_s).tolist():
        if any(first <= sweep_s < last for first, last in unseen_s):
            continue
        beams_s = sweep_s + np.arange(BEAMS) * (period_s / BEAMS)
        bases = way.pose_at(beams_s)
        c, s = np.cos(bases[:, 2]), np.sin(bases[:, 2])
        origin = bases[:, :2] + np.stack((c * MOUNT.x_m - s * MOUNT.y_m, s * MOUNT.x_m + c * MOUNT.y_m), axis=-1)
        heading = bases[:, 2] + MOUNT.yaw_rad + BEARING
        reach = world.beam_distances(origin, heading, beams_s, z_m=HEIGHT_M, range_max_m=REACH_M)
        reach = reach + rng.normal(0.0, 0.01, BEAMS)
        stamp_ns, period_ns = round(sweep_s * 1e9), round(period_s * 1e9)
        items.append(("front", ScanReading(stamp_ns, period_ns / BEAMS, period_ns, BEARING, reach, 0.15, REACH_M)))
    return Drive(world, way, tuple(items))


def mapped(way: Drive) -> Robot:
    """The map begins where the laser was midway in its first sweep."""
    made = robot(way.truth(round((FIRST_S + 0.5 / HZ) * 1e9)), config=CONFIG)
    made.play(way.items)
    return made


@pytest.mark.parametrize(("name", "laps"), [("flat", 1.2), ("office", 0.8), ("walkers", 0.8)])
def test_a_laser_that_is_carried_around_maps_a_building(name: str, laps: float) -> None:
    way = carried(name, laps)
    made = mapped(way)
    walls, off = wall_errors_m(way, made.grid.patch()), pose_errors_m(way, made.poses)
    assert len(made.poses) == len(way.items)
    assert np.median(walls) <= 0.03
    assert np.quantile(walls, 0.95) <= 0.08
    assert np.quantile(off, 0.95) < 0.03
    assert off.max() < 0.12
    assert made.fusion.troubles(0) == []
    counters = made.fusion.counters()
    assert counters["laser_odometry.not_matched"] == counters["laser_odometry.begun_anew"] == 0


@pytest.mark.parametrize("unseen_s", [((20.0, 20.3),), ((14.0, 14.8),), ((14.0, 18.0),), ((20.0, 24.0), (40.0, 44.0))])
def test_a_laser_that_saw_nothing_while_it_was_carried_on_is_looked_for_before_anything_is_drawn(
    unseen_s: tuple[tuple[float, float], ...],
) -> None:
    way = carried("flat", 1.2, unseen_s=unseen_s)
    made = mapped(way)
    walls = wall_errors_m(way, made.grid.patch())
    assert np.median(walls) <= 0.03
    assert np.quantile(walls, 0.95) <= 0.08
    assert pose_errors_m(way, made.poses[-20:]).max() < 0.1
    long = sum(last - first > 0.5 for first, last in unseen_s)
    assert made.fusion.counters()["laser_odometry.begun_anew"] == long
    surely = [pose for pose in made.poses if pose.covariance[0, 0] < 1.0]
    assert np.quantile(pose_errors_m(way, surely), 0.99) < 0.1
    assert len(surely) > 0.8 * len(made.poses)
