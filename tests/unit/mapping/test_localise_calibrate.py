"""Calibration against drives whose truth is written down: exact motions, noise, outliers, drives that tell too little.

The truth comes from arcs in closed form, not from the code that is tested.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2, exp_se2
from mapping.localise.calibrate import NAMES, Calibration, RobotModel, WheelTicks, calibrate, turns_as_believed
from mapping.localise.relative_motions import RelativeMotions, spread_out
from mapping.localise.umbmark import square_end, umbmark

F64 = NDArray[np.float64]

TRUE = RobotModel(2.04e-5, -1.98e-5, 0.41, 0.22, -0.03, 0.05, 0.02)
START = RobotModel(2e-5, -2e-5, 0.40, 0.2)
STEP_S = 0.5
WITHIN = np.array([1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-4])  # shares, metres, radians, seconds; ticks are whole


def drive(
    speeds: F64, *, true: RobotModel = TRUE, noise_m: float = 0.0, noise_rad: float = 0.0, seed: int = 0
) -> tuple[WheelTicks, RelativeMotions]:
    """Arcs of 0.5 s; speeds: (N, 2) forward and turn. A sweep 0.1 s into each arc, the wheels at 50 Hz."""
    rng = np.random.default_rng(seed)
    mount = Pose2(true.laser_x_m, true.laser_y_m, true.laser_yaw_rad)
    corner, left, right = Pose2(0.0, 0.0, 0.0), 0.0, 0.0
    stamps, counts, times, lasers = [], [], [], []
    for k, (forward, turn) in enumerate(speeds.tolist()):
        for j in range(25):
            since = j * 0.02
            stamps.append(k * STEP_S + since)
            counts.append((left + (forward - turn * true.track_width_m / 2) * since,
                           right + (forward + turn * true.track_width_m / 2) * since))  # fmt: skip
        times.append(k * STEP_S + 0.1)
        lasers.append(corner @ exp_se2((0.1 * forward, 0.0, 0.1 * turn)) @ mount)
        corner = corner @ exp_se2((STEP_S * forward, 0.0, STEP_S * turn))
        left += (forward - turn * true.track_width_m / 2) * STEP_S
        right += (forward + turn * true.track_width_m / 2) * STEP_S
    travel = np.array(counts)
    ticks = WheelTicks(np.array(stamps), travel[:, 0] / true.left_m_per_tick, travel[:, 1] / true.right_m_per_tick)
    moved = [a.inverse() @ b for a, b in itertools.pairwise(lasers)]
    motion = np.array([(p.x_m, p.y_m, p.yaw_rad) for p in moved])
    motion += rng.normal(size=motion.shape) * [noise_m, noise_m, noise_rad]
    sigma = np.array([max(noise_m, 0.001), max(noise_m, 0.001), max(noise_rad, 0.001)])
    clock = np.array(times) - true.time_offset_s
    return ticks, RelativeMotions(clock[:-1], clock[1:], motion, np.repeat([np.diag(sigma**2)], len(motion), axis=0))


def about(count: int = 200, seed: int = 3) -> F64:
    """Straights, curves both ways and turns on the spot, at changing speeds."""
    rng = np.random.default_rng(seed)
    forward = rng.choice([0.0, 0.4, 0.8, 1.0], count)
    return np.stack((forward, rng.choice([-1.2, -0.4, 0.0, 0.3, 1.0], count)), axis=-1)


def errors(found: Calibration, true: RobotModel = TRUE) -> F64:
    """(7,) gains and track as shares, the others as they are."""
    off = found.best - true.row()
    off[:3] /= true.row()[:3]
    return off


@pytest.mark.parametrize("factor", [1.0, 0.5, 1.7])
def test_exact_motions_give_the_truth_whatever_was_believed_before(factor: float) -> None:
    start = RobotModel(2e-5 * factor, -2e-5 / factor, 0.4 * factor, -0.5, 0.5, 0.6, 0.0)
    found = calibrate(*drive(about()), start)
    assert found.observable.all()
    # What was believed weighs a little where nothing else errs; its share falls with the motions.
    assert np.all(np.abs(errors(found)) < 20.0 * WITHIN)


@pytest.mark.parametrize("yaw_deg", [90.0, 179.0, -120.0])
def test_a_laser_mounted_any_way_round(yaw_deg: float) -> None:
    true = replace(TRUE, laser_yaw_rad=math.radians(yaw_deg))
    found = calibrate(*drive(about(), true=true), START)
    assert math.remainder(found.best[5] - true.laser_yaw_rad, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-3)


def test_the_deviations_are_what_the_errors_scatter_by() -> None:
    """Over 20 noisy drives: squared errors over variances average to one, in all seven, and no bias is left."""
    normal = []
    for seed in range(20):
        found = calibrate(*drive(about(100, seed), noise_m=0.004, noise_rad=0.003, seed=seed), START)
        unit = np.append(TRUE.row()[:3], np.ones(4))
        normal.append(errors(found) / (found.deviation / np.abs(unit)))
    table = np.array(normal)
    mean_square = np.mean(table**2, axis=0)
    assert np.all(mean_square < 2.27)  # 20 squares of a normal number average to more than that once in 1000
    assert np.all(mean_square > 0.3)  # the larger of two estimates is cautious, but not out of all proportion
    assert np.all(np.abs(table.mean(axis=0)) < 3.5 / math.sqrt(20.0))


def test_slips_and_wrong_matches_are_left_out() -> None:
    ticks, motions = drive(about(300), noise_m=0.002, noise_rad=0.001)
    rng = np.random.default_rng(1)
    wrong = rng.choice(len(motions), 40, replace=False)
    motion = motions.motion.copy()
    motion[wrong] += rng.normal(size=(40, 3)) * [0.3, 0.3, 0.3]
    found = calibrate(ticks, replace(motions, motion=motion), START)
    clean = calibrate(ticks, motions, START)
    assert 35 <= found.trimmed <= 50
    assert np.all(
        np.abs(errors(found)) < np.abs(errors(clean)) + 3.0 * clean.deviation / np.append(2e-5 * np.ones(2), np.ones(5))
    )


def test_straight_driving_tells_no_track_and_no_place() -> None:
    speeds = np.stack((np.resize([0.3, 0.6, 1.0, 0.5], 200), np.zeros(200)), axis=-1)
    found = calibrate(*drive(speeds, noise_m=0.002, noise_rad=0.001), START)
    told = {name for name in NAMES if found.value(name) is not None}
    assert told == {"left_m_per_tick", "right_m_per_tick", "laser_yaw_rad", "time_offset_s"}
    assert found.value("left_m_per_tick") == pytest.approx(TRUE.left_m_per_tick, rel=0.005)
    assert found.value("track_width_m") is None


def test_a_constant_speed_tells_no_time_offset() -> None:
    found = calibrate(*drive(np.full((200, 2), [0.6, 0.0]), noise_m=0.002, noise_rad=0.001), START)
    assert found.value("time_offset_s") is None


def test_turning_on_the_spot_tells_no_single_gain_and_no_yaw() -> None:
    speeds = np.stack((np.zeros(200), np.resize([0.5, -0.3, 0.9], 200)), axis=-1)
    found = calibrate(*drive(speeds, noise_m=0.002, noise_rad=0.001), START)
    for name in ("left_m_per_tick", "right_m_per_tick", "track_width_m", "laser_yaw_rad"):
        assert found.value(name) is None, name


@pytest.mark.parametrize("count", [0, 1, 15])
def test_too_short_a_drive_says_nothing(count: int) -> None:
    ticks, motions = drive(about(40))
    few = RelativeMotions(
        motions.start_s[:count], motions.end_s[:count], motions.motion[:count], motions.covariance[:count]
    )
    found = calibrate(ticks, few, START)
    assert not found.observable.any()
    assert all(found.value(name) is None for name in NAMES)


def test_standing_says_nothing() -> None:
    found = calibrate(*drive(np.zeros((60, 2)), noise_m=0.002, noise_rad=0.001), START)
    assert not found.observable.any()


@settings(max_examples=6)
@given(scale=st.floats(0.2, 5.0))
def test_a_larger_robot_in_a_larger_world_is_the_same_robot(scale: float) -> None:
    """All lengths times s: gains, track and place times s, angle and time as before."""
    ticks, motions = drive(about(100), noise_m=0.001, noise_rad=0.001)
    plain = calibrate(ticks, motions, START)
    stretch = np.array([scale, scale, 1.0])
    larger = replace(
        motions, motion=motions.motion * stretch, covariance=motions.covariance * np.outer(stretch, stretch)
    )
    start = RobotModel(2e-5 * scale, -2e-5 * scale, 0.4 * scale, 0.2 * scale)
    found = calibrate(ticks, larger, start)
    expected = plain.best * np.array([scale, scale, scale, scale, scale, 1.0, 1.0])
    near = np.array([1e-4, 1e-4, 1e-4, 1e-3 * scale, 1e-3 * scale, 1e-4, 1e-4])
    near[:3] *= np.abs(expected[:3])
    assert np.all(np.abs(found.best - expected) < near)


@settings(max_examples=6)
@given(x=st.floats(-50.0, 50.0), y=st.floats(-50.0, 50.0), shift_s=st.floats(-1e6, 1e6))
def test_where_and_when_the_drive_was_makes_no_difference(x: float, y: float, shift_s: float) -> None:
    poses = np.cumsum(np.full((50, 3), [0.2, 0.1, 0.05]), axis=0)
    assert np.array_equal(spread_out(poses), spread_out(poses + [x, y, 0.0]))
    ticks, motions = drive(about(60), noise_m=0.001, noise_rad=0.001)
    moved = calibrate(
        replace(ticks, stamp_s=ticks.stamp_s + shift_s),
        replace(motions, start_s=motions.start_s + shift_s, end_s=motions.end_s + shift_s),
        START,
    )
    plain = calibrate(ticks, motions, START)
    assert np.all(np.abs(errors(moved) - errors(plain)) < 1e-5)


def test_bad_tables_are_refused() -> None:
    with pytest.raises(ValueError, match="rise"):
        WheelTicks(np.array([0.0, 0.0]), np.zeros(2), np.zeros(2))
    with pytest.raises(ValueError, match="length"):
        WheelTicks(np.zeros(3), np.zeros(2), np.zeros(3))
    with pytest.raises(ValueError, match="belong together"):
        RelativeMotions(np.zeros(2), np.zeros(2), np.zeros((2, 2)), np.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match="gains"):
        RobotModel(0.0, 1.0, 0.4)


# --- UMBmark ---------------------------------------------------------------------------------------------------------


@given(left=st.floats(0.998, 1.002), right=st.floats(0.998, 1.002), track=st.floats(0.99, 1.01))
def test_squares_tell_the_ratio_of_the_wheels_and_the_track(left: float, right: float, track: float) -> None:
    """First order, as in the paper: what is left is a few per cent of the errors, and products of them."""
    nominal, actual = (1.0, 1.0, 0.4), (left, right, 0.4 * track)
    found = umbmark(square_end(actual, nominal, way=-1), square_end(actual, nominal, way=1), track_width_m=0.4)
    assert found.wheel_ratio == pytest.approx(right / left, abs=3e-4)
    # Turning on the spot goes by the mean of both gains over the track: that is what squares see.
    assert found.track_factor == pytest.approx(2.0 * track / (left + right), abs=3e-3)


def test_a_right_robot_comes_home_and_the_worse_way_round_counts() -> None:
    same = (1e-4, -1e-4, 0.5)
    assert np.allclose(square_end(same, same, way=1), 0.0, atol=1e-12)
    found = umbmark(
        np.array([[0.1, 0.0], [0.3, 0.0]]), np.array([[0.0, 0.5], [0.0, 0.5]]), track_width_m=0.5, side_m=4.0
    )
    assert found.worst_m == pytest.approx(0.5)
    assert found.clockwise.tolist() == pytest.approx([0.2, 0.0])
    with pytest.raises(ValueError, match="both"):
        umbmark(np.zeros((0, 2)), np.zeros((1, 2)), track_width_m=0.5)


def test_signs_that_no_fit_puts_right_are_found() -> None:
    ticks, motions = drive(about(), noise_m=0.003, noise_rad=0.003)
    assert turns_as_believed(ticks, motions, START) == (True, True)
    mirrored = replace(motions, motion=motions.motion * [1.0, -1.0, -1.0])  # a laser that hangs head down
    assert turns_as_believed(ticks, mirrored, START) == (False, False)
    exchanged = WheelTicks(ticks.stamp_s, -ticks.right, -ticks.left)  # each with the other's sign
    assert turns_as_believed(exchanged, motions, START) == (False, False)
    assert turns_as_believed(WheelTicks(ticks.stamp_s, -ticks.left, ticks.right), motions, START) == (False, True)
    assert turns_as_believed(WheelTicks(ticks.stamp_s, ticks.left, -ticks.right), motions, START) == (True, False)


def test_signs_are_not_told_of_a_drive_that_does_not_show_them() -> None:
    straight = np.stack((np.full(40, 0.8), np.zeros(40)), axis=-1)
    assert turns_as_believed(*drive(straight, noise_m=0.003, noise_rad=0.003), START) is None
    ticks, motions = drive(about(3))
    assert turns_as_believed(ticks, motions, START) is None
    assert turns_as_believed(WheelTicks(np.zeros(0), np.zeros(0), np.zeros(0)), drive(about())[1], START) is None
