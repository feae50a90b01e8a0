"""De-skewed scans of a moving sensor in a square room lie on the room's walls; skewed ones do not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping.deskew import beam_stamps, deskew
from mapping.frames import Pose2, exp_se2
from mapping.pose_buffer import GoneError, NotYetError, PoseBuffer
from mapping.scan import Scan

SWEEP_NS = 100_000_000
HALF_ROOM_M = 4.0
MOUNT = Pose2(0.2, -0.1, 0.4)


def pose_at(stamp_ns: float, speed: float, turn: float) -> Pose2:
    seconds = stamp_ns * 1e-9
    return Pose2(-0.5, 0.3, 0.2) @ exp_se2((speed * seconds, 0.0, turn * seconds))


def track(speed: float, turn: float, until_ns: int = 2 * SWEEP_NS) -> PoseBuffer:
    buffer = PoseBuffer()
    for stamp in range(-SWEEP_NS, until_ns + 1, 10_000_000):
        buffer.add(stamp, pose_at(stamp, speed, turn))
    return buffer


def wall_distance(pose: Pose2, bearing: float) -> float:
    """From inside the square of half side HALF_ROOM_M to its wall."""
    a = pose.yaw_rad + bearing
    ways = [(math.copysign(HALF_ROOM_M, d) - p) / d for p, d in ((pose.x_m, math.cos(a)), (pose.y_m, math.sin(a))) if d]
    return min(ways)


def sweep(speed: float, turn: float, beams: int = 271) -> Scan:
    bearing = np.radians(np.linspace(-135.0, 135.0, beams))
    period = SWEEP_NS / beams
    ranges = [wall_distance(pose_at(i * period, speed, turn) @ MOUNT, b) for i, b in enumerate(bearing)]
    return Scan(0, period, bearing, np.array(ranges), 0.1, 30.0)


def off_the_walls(odom_from_sensor: Pose2, scan: Scan) -> float:
    points = odom_from_sensor.apply(scan.points())
    return float(np.abs(np.abs(points).max(axis=1) - HALF_ROOM_M).max())


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_every_point_lies_on_a_wall(speed: float, turn: float) -> None:
    result = deskew(sweep(speed, turn), track(speed, turn), MOUNT)
    assert off_the_walls(result.odom_from_sensor, result.scan) < 1e-6


def test_the_skewed_scan_did_not() -> None:
    scan = sweep(1.5, 1.5)
    assert off_the_walls(pose_at(SWEEP_NS / 2, 1.5, 1.5) @ MOUNT, scan) > 0.2


def test_beams_without_echo_are_turned_and_stay_what_they_are() -> None:
    scan = sweep(0.0, 1.0)
    ranges = scan.range_m.copy()
    ranges[0], ranges[1], ranges[2] = math.inf, -math.inf, math.nan
    result = deskew(Scan(0, scan.beam_period_ns, scan.bearing_rad, ranges, 0.1, 30.0), track(0.0, 1.0), Pose2())
    assert math.isinf(result.scan.range_m[0])
    assert result.scan.range_m[1] == -math.inf
    assert math.isnan(result.scan.range_m[2])
    reference = beam_stamps(scan)[len(ranges) // 2] * 1e-9
    assert result.scan.bearing_rad[0] == pytest.approx(scan.bearing_rad[0] - reference, abs=1e-9)


def test_it_says_not_yet_until_odometry_reaches_the_last_beam() -> None:
    with pytest.raises(NotYetError):
        deskew(sweep(1.0, 0.0), track(1.0, 0.0, until_ns=SWEEP_NS - 20_000_000), MOUNT)


def test_it_says_gone_when_odometry_begins_after_the_first_beam() -> None:
    buffer = PoseBuffer()
    buffer.add(10, Pose2())
    buffer.add(10 * SWEEP_NS, Pose2())
    with pytest.raises(GoneError):
        deskew(sweep(1.0, 0.0), buffer, MOUNT)


def test_a_scan_taken_at_once_only_gets_its_pose() -> None:
    scan = Scan(5_000_000, 0.0, np.array([0.0, 0.1]), np.array([1.0, math.inf]), 0.1, 10.0)
    result = deskew(scan, track(1.0, 0.0), MOUNT)
    assert np.array_equal(result.scan.range_m, scan.range_m)
    assert not result.origin_m.any()


def test_an_empty_scan_stays_empty() -> None:
    scan = Scan(0, 1000.0, np.zeros(0), np.zeros(0), 0.1, 10.0)
    assert len(deskew(scan, track(1.0, 0.0), MOUNT).scan.range_m) == 0


def test_the_spread_of_origins_is_the_way_driven() -> None:
    result = deskew(sweep(2.0, 0.0), track(2.0, 0.0), Pose2())
    assert np.hypot(*result.origin_m.T).max() == pytest.approx(0.1, abs=0.002)  # 0.1 s at 2 m/s, seen from the middle
