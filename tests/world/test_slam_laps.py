"""A robot that drives the same room for long: what SLAM keeps of key scans is bounded by the ground, not by the way."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mapping.frames import Pose2
from mapping.localise.slam import Slam, run_here
from mapping.scan import Scan
from service.background import at_once
from service.redraw import Redrawer
from service.slam_store import Stored, stored_of, tiles_of

BEARING = np.radians(np.arange(-90.0, 91.0, 2.0))
LAP, LAPS = 60, 50
RADIUS_M = 1.5


def sweep(step: int, rng: np.random.Generator) -> tuple[Pose2, Scan]:
    """On a circle in a room of 8 by 6 m."""
    angle = 2.0 * math.pi * step / LAP
    pose = Pose2(RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle), angle + 0.5 * math.pi)
    c, s = np.cos(pose.yaw_rad + BEARING), np.sin(pose.yaw_rad + BEARING)
    with np.errstate(divide="ignore"):
        to_x = (np.where(c > 0.0, 4.0, -4.0) - pose.x_m) / c
        to_y = (np.where(s > 0.0, 3.0, -3.0) - pose.y_m) / s
    reach = np.minimum(to_x, to_y)
    return pose, Scan(step * 200_000_000, 0.0, BEARING, reach + rng.normal(0.0, 0.01, len(reach)), 0.05, 20.0)


@pytest.mark.slow
def test_fifty_laps_of_a_room_keep_the_views_of_some() -> None:
    slam, pending, held = Slam(keep_scans=False), None, []
    rng = np.random.default_rng(3)
    odometry, before = sweep(0, rng)[0], None
    off = []
    for step in range(LAPS * LAP):
        pose, scan = sweep(step, rng)
        if before is not None:  # wheels that turn 0.1 degrees too far each step
            odometry = odometry @ (before.inverse() @ pose) @ Pose2(0.0, 0.0, 0.002)
        before = pose
        pending = run_here(slam, scan.stamp_ns, pending)
        at = slam.add_scan(scan, odom_from_base=odometry).map_from_base
        work = slam.take_work()
        pending = work.run() if work is not None else pending
        off.append(math.hypot(at.x_m - pose.x_m, at.y_m - pose.y_m))
        if step % LAP == LAP - 1:
            held.append(slam.memory_bytes)
    assert slam.keys > 1000
    assert max(held[25:]) <= 1.25 * max(held[:25])  # flat; arrays grow by a quarter
    assert int(slam.state().views.is_there().sum()) < 800
    assert max(off) < 0.05
    assert len(slam.closures) > 100
    slam.finish()
    there = slam.state().views.is_there()
    redrawer = Redrawer([], None, {}, submit=at_once)
    stored = stored_of(tiles_of(Stored(slam.state(), redrawer.state())))
    assert stored is not None
    np.testing.assert_array_equal(stored.slam.views.is_there(), there)
    newest = np.flatnonzero(there)[-1]
    np.testing.assert_allclose(stored.slam.views.view(newest).x, slam.state().views.view(newest).x, atol=6e-4)
    again = Slam(keep_scans=False)
    again.resume(stored.slam)
    pose, scan = sweep(7, rng)
    assert again.join(scan, pose) is not None
