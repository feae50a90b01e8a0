"""What holds for every scan: no input hurts, a laser mounted otherwise or turning otherwise tells the same."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.localise.slam import Slam
from mapping.localise.views import table_for, view_of
from mapping.scan import Scan

F64 = NDArray[np.float64]
BEARING = np.radians(np.arange(-135.0, 135.5, 1.0))
ranges = arrays(
    np.float64,
    len(BEARING),
    elements=st.one_of(st.floats(0.0, 40.0), st.sampled_from([math.nan, math.inf, -math.inf, -1.0, 0.0, 1e300])),
)


def room(pose: Pose2, bearing: F64 = BEARING) -> Scan:
    """A room of 6 x 4 m with a pillar, seen from inside."""
    heading = pose.yaw_rad + bearing
    c, s = np.cos(heading), np.sin(heading)
    with np.errstate(divide="ignore"):
        reach = np.minimum((np.copysign(3.0, c) - pose.x_m) / c, (np.copysign(2.0, s) - pose.y_m) / s)
    along, across = (1.5 - pose.x_m) * c + (1.0 - pose.y_m) * s, (1.0 - pose.y_m) * c - (1.5 - pose.x_m) * s
    root = 0.3**2 - across**2
    pillar = np.where((root > 0.0) & (along > 0.0), along - np.sqrt(np.maximum(root, 0.0)), np.inf)
    return Scan(0, 0.0, bearing, np.minimum(reach, pillar), 0.05, 30.0)


@given(st.lists(ranges, min_size=1, max_size=6), st.booleans())
@settings(max_examples=40, deadline=None)
def test_no_scan_hurts(sweeps: list[F64], with_odometry: bool) -> None:
    slam = Slam()
    for k, sweep in enumerate(sweeps):
        update = slam.add_scan(
            Scan(k * 100_000_000, 0.0, BEARING, sweep, 0.05, 30.0),
            Pose2(0.1, 0.0, 0.0),
            Pose2(0.1 * k, 0.0, 0.0) if with_odometry else None,
        )
        assert all(
            map(math.isfinite, (update.map_from_base.x_m, update.map_from_base.y_m, update.map_from_base.yaw_rad))
        )
        assert np.all(np.isfinite(update.covariance))
        assert np.all(np.linalg.eigvalsh(update.covariance) >= -1e-12)
    slam.finish()
    assert np.all(np.isfinite(slam.trajectory()[1]))


@given(st.floats(-math.pi, math.pi), st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.booleans())
@settings(max_examples=25, deadline=None)
def test_the_base_moves_the_same_however_the_laser_is_mounted(yaw: float, x: float, y: float, clockwise: bool) -> None:
    mount = Pose2(x, y, yaw)
    bearing = np.radians(np.arange(0.0, 360.0, 1.0)) * (-1.0 if clockwise else 1.0)
    truth = [Pose2(-1.0 + 0.05 * k, 0.2 * math.sin(0.3 * k), 0.04 * k) for k in range(20)]
    slam = Slam(start=truth[0])
    for k, pose in enumerate(truth):
        seen = room(pose @ mount, bearing)
        update = slam.add_scan(Scan(k * 100_000_000, 0.0, seen.bearing_rad, seen.range_m, 0.05, 30.0), mount, None)
        off = pose.inverse() @ update.map_from_base
        assert math.hypot(off.x_m, off.y_m) < 0.02
        assert abs(off.yaw_rad) < math.radians(0.7)


@given(st.integers(0, 2**31), st.floats(0.0, 0.3))
@settings(max_examples=25, deadline=None)
def test_beams_that_come_and_go_change_little(seed: int, dropped: float) -> None:
    rng = np.random.default_rng(seed)
    truth = [Pose2(-1.0 + 0.06 * k, 0.0, 0.05 * k) for k in range(12)]
    slam = Slam(start=truth[0])
    for k, pose in enumerate(truth):
        kept = rng.random(len(BEARING)) >= dropped  # another number of beams in every sweep
        seen = room(pose, BEARING[kept] + rng.normal(0.0, 1e-3))
        update = slam.add_scan(Scan(k * 100_000_000, 0.0, seen.bearing_rad, seen.range_m, 0.05, 30.0), Pose2(), None)
        assert math.hypot(update.map_from_base.x_m - pose.x_m, update.map_from_base.y_m - pose.y_m) < 0.03
        assert abs(wrap_angle(update.map_from_base.yaw_rad - pose.yaw_rad)) < math.radians(0.8)


@given(ranges, st.permutations(range(len(BEARING))))
@settings(max_examples=50, deadline=None)
def test_a_view_does_not_depend_on_the_order_of_beams(sweep: F64, permuted: list[int]) -> None:
    order = np.array(permuted)
    table = table_for(BEARING)
    a = view_of(Scan(0, 0.0, BEARING, sweep, 0.05, 30.0), table, farthest_m=30.0)
    b = view_of(Scan(0, 0.0, BEARING[order], sweep[order], 0.05, 30.0), table, farthest_m=30.0)
    assert np.array_equal(a.x, b.x)
    assert np.array_equal(a.nx, b.nx)
    assert np.array_equal(a.quality, b.quality)


def test_two_lasers_that_see_nothing_in_common_share_one_path() -> None:
    half = np.radians(np.arange(-80.0, 81.0, 1.0))
    front, rear = Pose2(0.2, 0.0, 0.0), Pose2(-0.2, 0.0, math.pi)
    truth = [Pose2(-1.5 + 0.05 * k, 0.1 * math.sin(0.2 * k), 0.03 * k) for k in range(60)]
    slam = Slam(start=truth[0])
    for k, pose in enumerate(truth):
        for name, mount in (("front", front), ("rear", rear)):
            seen = room(pose @ mount, half)
            update = slam.add_scan(Scan(k * 100_000_000, 0.0, half, seen.range_m, 0.05, 30.0), mount, pose, sensor=name)
            off = pose.inverse() @ update.map_from_base
            assert math.hypot(off.x_m, off.y_m) < 0.03
            assert abs(off.yaw_rad) < math.radians(1.0)
            if slam.take_work() is not None:
                slam.finish()
    assert slam.keys > 10
