"""The motion of a laser from its sweeps: in a room whose walls are known, at speeds that bend a sweep by 10 degrees."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.deskew import beam_stamps
from mapping.frames import IDENTITY, Pose2, exp_se2, wrap_angle
from mapping.localise.laser_odometry import LaserOdometry
from mapping.odometry import OdometryState
from mapping.scan import Scan

F64 = NDArray[np.float64]

PERIOD_NS = 143_000_000
BEAMS = 400
BEARING = math.pi - np.linspace(0.0, 2.0 * math.pi, BEAMS, endpoint=False)  # clockwise
MOUNT = Pose2(0.1, -0.05, 0.3)
CORNERS = np.array([[-3.0, -2.0], [4.0, -2.0], [4.0, 0.5], [5.0, 0.5], [5.0, 3.0], [-3.0, 3.0]])


def seen_m(origin: F64, heading: F64) -> F64:
    """Distances (N,) to the walls of a room with a bay, from (N, 2) in directions (N,)."""
    nearest = np.full(len(heading), np.inf)
    along = np.stack((np.cos(heading), np.sin(heading)), axis=-1)
    for a, b in zip(CORNERS, np.roll(CORNERS, -1, axis=0)):
        wall, off = b - a, a - origin
        cross = along[:, 0] * wall[1] - along[:, 1] * wall[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            r = (off[:, 0] * wall[1] - off[:, 1] * wall[0]) / cross
            share = (off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]) / cross
        nearest = np.where((r > 0.0) & (share >= 0.0) & (share <= 1.0), np.minimum(nearest, r), nearest)
    return nearest


def sweep(base_at: Callable[[float], Pose2], stamp_ns: int, seed: int = 0) -> Scan:
    """As the laser on its mount says it on the way."""
    beams_s = (stamp_ns + np.arange(BEAMS) * (PERIOD_NS / BEAMS)) * 1e-9
    poses = [base_at(float(t)) @ MOUNT for t in beams_s]
    origin = np.array([[pose.x_m, pose.y_m] for pose in poses])
    reach = seen_m(origin, BEARING + np.array([pose.yaw_rad for pose in poses]))
    reach = reach + np.random.default_rng(seed + stamp_ns).normal(0.0, 0.005, BEAMS)
    return Scan(stamp_ns, PERIOD_NS / BEAMS, BEARING, reach, 0.1, 12.0)


def middle_s(scan: Scan) -> float:
    return (scan.stamp_ns + round(BEAMS // 2 * scan.beam_period_ns)) * 1e-9


def off(state: OdometryState, base_at: Callable[[float], Pose2], first_s: float) -> tuple[float, float]:
    """How far a state is off the truth [m, rad]; the odom frame is where the base was at first_s."""
    true = base_at(first_s).inverse() @ base_at(state.stamp_ns * 1e-9)
    error = true.inverse() @ state.odom_from_base
    return math.hypot(error.x_m, error.y_m), abs(wrap_angle(error.yaw_rad))


def test_a_laser_that_stands_neither_drifts_nor_trembles() -> None:
    odometry = LaserOdometry()
    states = [odometry.take(sweep(lambda _: IDENTITY, k * PERIOD_NS), MOUNT) for k in range(1, 200)]
    told = [(s.odom_from_base, s.forward_m_s, s.yaw_rad_s, s.broken) for s in states if s is not None]
    assert len(told) == len(states)
    assert set(told) == {(IDENTITY, 0.0, 0.0, False)}


def test_a_creeping_robot_is_followed() -> None:
    def base_at(t: float) -> Pose2:
        return Pose2(0.004 * t, 0.0, 0.0)

    odometry = LaserOdometry()
    first = sweep(base_at, PERIOD_NS)
    odometry.take(first, MOUNT)
    for k in range(2, 300):
        state = odometry.take(sweep(base_at, k * PERIOD_NS), MOUNT)
        assert state is not None
        assert off(state, base_at, middle_s(first))[0] < 0.008


def test_every_second_sweep_of_a_quick_laser_is_looked_at() -> None:
    odometry = LaserOdometry()
    stamps = [k * 25_000_000 for k in range(1, 41)]
    quick = [replace(sweep(lambda _: IDENTITY, stamp), beam_period_ns=18e6 / BEAMS) for stamp in stamps]
    told = [odometry.take(scan, MOUNT) is not None for scan in quick]
    assert told == [k % 2 == 0 for k in range(40)]


@settings(max_examples=20)
@given(st.floats(-1.0, 1.0), st.floats(-1.5, 1.5))
def test_even_motion_is_told_to_a_centimetre_though_each_sweep_is_bent_by_it(forward: float, turn: float) -> None:
    """From standing, up to a metre and one and a half radians a second: ten degrees and more within a sweep."""

    def base_at(t: float) -> Pose2:
        return exp_se2(np.array([forward, 0.0, turn]) * max(0.0, t - 1.0))

    odometry, first_s = LaserOdometry(), 0.0
    for k in range(1, 22):
        scan = sweep(base_at, k * PERIOD_NS)
        state = odometry.take(scan, MOUNT)
        assert state is not None
        first_s = first_s or middle_s(scan)
        if k > 12:
            assert off(state, base_at, first_s)[0] < 0.03
            assert off(state, base_at, first_s)[1] < math.radians(1.2)
            assert state.forward_m_s == pytest.approx(forward, abs=0.08)
            assert state.yaw_rad_s == pytest.approx(turn, abs=0.08)
    assert odometry.counters() == {"laser_odometry.not_matched": 0, "laser_odometry.begun_anew": 0}


def test_of_a_short_sweep_the_end_is_told_so_that_nothing_waits_for_the_next() -> None:
    """A laser on a slow line: sweeps of 25 ms, 0.83 s apart, one of them lost."""
    odometry, period_ns = LaserOdometry(), 830_000_000
    for k in (1, 2, 3, 4, 6, 7, 8):
        at = Pose2(0.1 * k, 0.0, 0.05 * k)
        scan = replace(sweep(lambda _, at=at: at, k * period_ns), beam_period_ns=25e6 / BEAMS)  # type: ignore[misc]
        state = odometry.take(scan, MOUNT)
        assert state is not None
        assert not state.broken
        assert state.stamp_ns == int(beam_stamps(scan)[BEAMS // 2 if k == 1 else -1])
        assert state.odom_from_base.x_m == pytest.approx(0.1 * (k - 1), abs=0.02)


def test_what_it_says_of_its_own_error_grows_with_the_way_and_holds() -> None:
    def base_at(t: float) -> Pose2:
        return Pose2(1.5 * math.sin(0.4 * t), 0.4 * math.sin(0.9 * t), 0.5 * math.sin(0.7 * t))

    odometry, first_s, states = LaserOdometry(), 0.0, list[OdometryState]()
    for k in range(1, 250):
        scan = sweep(base_at, k * PERIOD_NS)
        first_s = first_s or middle_s(scan)
        state = odometry.take(scan, MOUNT)
        assert state is not None
        states.append(state)
    sigma_m = math.sqrt(states[-1].covariance[0, 0] + states[-1].covariance[1, 1])
    assert off(states[-1], base_at, first_s)[0] < 3.0 * sigma_m
    assert 0.005 < sigma_m < 0.3
    assert np.trace(states[-1].covariance) > np.trace(states[20].covariance) > 0.0


def test_after_some_time_unseen_it_says_that_it_lost_track_and_goes_on() -> None:
    odometry = LaserOdometry()
    for k in range(1, 10):
        odometry.take(sweep(lambda _: IDENTITY, k * PERIOD_NS), MOUNT)
    elsewhere = Pose2(1.5, 0.4, 1.0)
    again = sweep(lambda _: elsewhere, 40 * PERIOD_NS)
    state = odometry.take(again, MOUNT)
    assert state is not None
    assert state.broken
    assert max(abs(v) for v in (state.odom_from_base.x_m, state.odom_from_base.y_m)) < 0.01, "it never jumps"
    assert state.covariance[0, 0] > 1.0
    after = odometry.take(sweep(lambda _: elsewhere, 41 * PERIOD_NS), MOUNT)
    assert after is not None
    assert not after.broken
    assert odometry.counters()["laser_odometry.begun_anew"] == 1


def test_sweeps_that_fit_nothing_tell_nothing_until_they_fit_again() -> None:
    odometry = LaserOdometry()
    for k in range(1, 10):
        odometry.take(sweep(lambda _: IDENTITY, k * PERIOD_NS), MOUNT)
    rng = np.random.default_rng(0)
    for k in range(10, 13):
        crowd = Scan(k * PERIOD_NS, PERIOD_NS / BEAMS, BEARING, rng.uniform(0.3, 1.0, BEAMS), 0.1, 12.0)
        assert odometry.take(crowd, MOUNT) is None
    assert odometry.lost_scans == 3
    state = odometry.take(sweep(lambda _: IDENTITY, 13 * PERIOD_NS), MOUNT)
    assert state is not None
    assert not state.broken
    assert max(off(state, lambda _: IDENTITY, 0.0)) < 0.02
    assert odometry.lost_scans == 0


@pytest.mark.parametrize(
    "reach", [np.zeros(0), np.full(BEAMS, np.inf), np.full(BEAMS, np.nan), np.full(BEAMS, -np.inf)]
)
def test_a_sweep_without_anything_in_it_tells_nothing(reach: F64) -> None:
    odometry = LaserOdometry()
    empty = Scan(PERIOD_NS, PERIOD_NS / BEAMS, BEARING[: len(reach)], reach, 0.1, 12.0)
    assert odometry.take(empty, MOUNT) is None
    assert odometry.take(sweep(lambda _: IDENTITY, 2 * PERIOD_NS), MOUNT) is not None
    later = Scan(3 * PERIOD_NS, PERIOD_NS / BEAMS, BEARING[: len(reach)], reach, 0.1, 12.0)
    assert odometry.take(later, MOUNT) is None
    assert odometry.take(sweep(lambda _: IDENTITY, 4 * PERIOD_NS), MOUNT) is not None


def test_a_sweep_that_is_not_later_is_left_out() -> None:
    odometry = LaserOdometry()
    assert odometry.take(sweep(lambda _: IDENTITY, PERIOD_NS), MOUNT) is not None
    assert odometry.take(sweep(lambda _: IDENTITY, PERIOD_NS), MOUNT) is None
    assert odometry.events["scan_not_later"] == 1


def test_the_same_sweeps_give_the_same_motion() -> None:
    def base_at(t: float) -> Pose2:
        return Pose2(0.5 * t, 0.0, 0.3 * math.sin(t))

    def run() -> list[bytes]:
        odometry = LaserOdometry()
        states = [odometry.take(sweep(base_at, k * PERIOD_NS), MOUNT) for k in range(1, 25)]
        return [np.array([s.odom_from_base.x_m, s.odom_from_base.yaw_rad]).tobytes() for s in states if s is not None]

    assert run() == run()
