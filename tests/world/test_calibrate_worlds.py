"""Calibration from a drive in the simulator's worlds, whose robot is known: 300 s, a laser that errs by 1 cm a beam."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.calibrate import RobotModel, WheelTicks, calibrate, dead_reckoned
from mapping.localise.pose_graph import composed_poses
from mapping.localise.relative_motions import RelativeMotions, relative_motions, spread_out
from mapping.scan import Scan
from sim_devices.floor_plan import load_floor_plan
from sim_devices.robot import follow
from sim_devices.world import World

F64 = NDArray[np.float64]

BEARING = np.radians(np.arange(-135.0, 135.25, 0.5))
RANGE_MAX_M = 20.0
NOISE_M = 0.01
DRIVE_S = 300.0
TRUE = RobotModel(2.04e-5, 1.98e-5, 0.41, 0.22, -0.03, math.radians(3.0), 0.03)
BELIEVED = RobotModel(2e-5, 2e-5, 0.40, 0.2)


def driven(name: str, seed: int = 0) -> tuple[WheelTicks, RelativeMotions]:
    """Along the world's route: whole ticks at 50 Hz, sweeps at once, predicted by what is believed of the robot."""
    plan = load_floor_plan(name)
    assert plan.route is not None
    world, motion, rng = World.from_plan(plan, seed), follow(plan.route), np.random.default_rng(seed)
    wheel_s = np.arange(0.0, DRIVE_S, 0.02)
    way, angle = motion.way_at(wheel_s)
    half = 0.5 * TRUE.track_width_m * angle
    ticks = WheelTicks(
        wheel_s, np.round((way - half) / TRUE.left_m_per_tick), np.round((way + half) / TRUE.right_m_per_tick)
    )
    laser_s = np.arange(1.0, DRIVE_S - 1.0, 0.2)
    guess = composed_poses(dead_reckoned(ticks, BELIEVED.row(), laser_s), np.tile([0.2, 0.0, 0.0], (len(laser_s), 1)))
    rows = spread_out(guess)
    mount = Pose2(TRUE.laser_x_m, TRUE.laser_y_m, TRUE.laser_yaw_rad)
    scans = []
    for now_s, base in zip(laser_s[rows], motion.pose_at(laser_s[rows] + TRUE.time_offset_s)):
        at = Pose2(*base.tolist()) @ mount
        origin = np.tile([at.x_m, at.y_m], (len(BEARING), 1))
        stamps = np.full(len(BEARING), now_s)
        reach = world.beam_distances(origin, at.yaw_rad + BEARING, stamps, z_m=0.3, range_max_m=RANGE_MAX_M)
        reach = reach + rng.normal(0.0, NOISE_M, len(reach))
        scans.append(Scan(round(now_s * 1e9), 0.0, BEARING, reach, 0.05, RANGE_MAX_M))
    return ticks, relative_motions(scans, guess[rows])


@pytest.mark.parametrize("name", ["flat", "loop", "walkers"])
def test_five_minutes_of_driving_tell_the_robot(name: str) -> None:
    found = calibrate(*driven(name), BELIEVED)
    off = found.best - TRUE.row()
    assert found.observable.all()
    assert np.all(np.abs(off[:3]) < 0.003 * TRUE.row()[:3])
    assert np.all(np.abs(off[3:5]) < 0.005)
    assert abs(off[5]) < math.radians(0.2)
    assert abs(off[6]) < 0.005
    assert np.all(np.abs(off) < 3.0 * found.deviation)
