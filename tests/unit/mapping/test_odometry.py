"""Wheel odometry against closed forms, against sampling, and against two recorded vehicles."""

from __future__ import annotations

import csv
import gzip
import math
import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping.frames import Pose2, wrap_angle
from mapping.odometry import DifferentialOdometry, DriveGeometry

SECOND = 1_000_000_000
DATA = os.environ.get("UMFELD_DATA", "")
needs_data = pytest.mark.skipif(not DATA, reason="needs UMFELD_DATA")
METRE_WHEELS = DriveGeometry(1.0 / (2.0 * math.pi), 1.0 / (2.0 * math.pi), 0.5, 1000.0, -1000.0)


def test_straight_ahead() -> None:
    odometry = DifferentialOdometry(METRE_WHEELS)
    odometry.update(0, 10, 10)
    state = odometry.update(SECOND, 2010, -1990)
    assert state.odom_from_base.x_m == pytest.approx(2.0)
    assert state.odom_from_base.y_m == pytest.approx(0.0)
    assert state.forward_m_s == pytest.approx(2.0)
    assert state.yaw_rad_s == pytest.approx(0.0)


def test_turn_on_the_spot() -> None:
    odometry = DifferentialOdometry(METRE_WHEELS)
    odometry.update(0, 0, 0)
    quarter = round(1000.0 * 0.5 * math.pi / 4.0)  # each wheel rolls track / 2 * pi / 2
    state = odometry.update(SECOND, -quarter, -quarter)
    assert state.odom_from_base.yaw_rad == pytest.approx(math.pi / 2.0, abs=2e-3)
    assert math.hypot(state.odom_from_base.x_m, state.odom_from_base.y_m) < 1e-12


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.integers(1, 40))
def test_an_arc_does_not_depend_on_how_finely_it_is_counted(left_m: float, right_m: float, parts: int) -> None:
    whole, fine = (DifferentialOdometry(METRE_WHEELS) for _ in range(2))
    left, right = round(left_m * 1000) * parts, round(right_m * 1000) * parts
    whole.update(0, 0, 0)
    expected = whole.update(SECOND, left, right).odom_from_base
    fine.update(0, 0, 0)
    for k in range(1, parts + 1):
        state = fine.update(k, k * left // parts, k * right // parts)
    assert math.hypot(state.odom_from_base.x_m - expected.x_m, state.odom_from_base.y_m - expected.y_m) < 1e-6
    assert abs(wrap_angle(state.odom_from_base.yaw_rad - expected.yaw_rad)) < 1e-6


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_driving_back_the_same_way_returns(left_m: float, right_m: float) -> None:
    odometry = DifferentialOdometry(METRE_WHEELS, start=Pose2(1.0, 2.0, 3.0))
    left, right = round(left_m * 1000), round(right_m * 1000)
    odometry.update(0, 0, 0)
    odometry.update(1, left, right)
    pose = odometry.update(2, 0, 0).odom_from_base
    assert (pose.x_m, pose.y_m) == pytest.approx((1.0, 2.0), abs=1e-9)


def test_the_covariance_agrees_with_noisy_runs() -> None:
    noise = 0.02
    geometry = DriveGeometry(0.1, 0.1, 0.4, 100_000.0, 100_000.0, travel_noise_m_per_sqrt_m=noise)
    per_metre = 100_000.0 / (2.0 * math.pi * 0.1)
    steps = [(0.10, 0.12)] * 30 + [(0.11, 0.09)] * 30

    def run(rng: np.random.Generator | None) -> tuple[Pose2, np.ndarray]:
        odometry, left, right = DifferentialOdometry(geometry), 0.0, 0.0
        state = odometry.update(0, 0, 0)
        for k, (dl, dr) in enumerate(steps, 1):
            if rng is not None:
                dl += rng.normal(0.0, noise * math.sqrt(dl))
                dr += rng.normal(0.0, noise * math.sqrt(dr))
            left, right = left + dl, right + dr
            state = odometry.update(k, round(left * per_metre), round(right * per_metre))
        return state.odom_from_base, state.covariance

    mean, predicted = run(None)
    rng = np.random.default_rng(11)
    ends = [run(rng)[0] for _ in range(1500)]
    errors = np.array([(p.x_m - mean.x_m, p.y_m - mean.y_m, wrap_angle(p.yaw_rad - mean.yaw_rad)) for p in ends])
    measured = errors.T @ errors / len(errors)
    # 1,500 runs know a variance to 3.7 %; four standard errors
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert np.abs((measured - predicted) / scale).max() < 0.15


def test_a_break_keeps_the_pose_and_widens_what_is_not_known() -> None:
    odometry = DifferentialOdometry(METRE_WHEELS)
    odometry.update(0, 0, 0)
    before = odometry.update(SECOND, 1000, -1000)
    after = odometry.update(3 * SECOND, 5, 7, continuous=False)
    assert after.broken
    assert after.odom_from_base == before.odom_from_base
    assert after.covariance[0, 0] >= before.covariance[0, 0] + (METRE_WHEELS.unknown_speed_m_s * 2.0) ** 2 - 1e-12
    later = odometry.update(4 * SECOND, 1005, -993)
    assert later.odom_from_base.x_m == pytest.approx(2.0)
    assert not later.broken


@pytest.mark.parametrize("stamp", [SECOND, SECOND - 1, -5])
def test_a_stamp_that_does_not_rise_is_refused_and_changes_nothing(stamp: int) -> None:
    odometry = DifferentialOdometry(METRE_WHEELS)
    odometry.update(0, 0, 0)
    odometry.update(SECOND, 1000, -1000)
    with pytest.raises(ValueError, match="rise"):
        odometry.update(stamp, 9000, 9000)
    assert odometry.update(2 * SECOND, 2000, -2000).odom_from_base.x_m == pytest.approx(2.0)


@pytest.mark.parametrize(
    "bad", [{"track_width_m": 0.0}, {"wheel_radius_left_m": math.nan}, {"ticks_per_turn_right": 0}]
)
def test_an_impossible_drive_is_refused(bad: dict[str, float]) -> None:
    fine = {
        "wheel_radius_left_m": 0.1,
        "wheel_radius_right_m": 0.1,
        "track_width_m": 0.5,
        "ticks_per_turn_left": 100.0,
        "ticks_per_turn_right": 100.0,
    }
    with pytest.raises(ValueError, match=r"positive|tick"):
        DriveGeometry(**(fine | bad))


@pytest.mark.data
@needs_data
def test_the_electric_car_drives_as_its_own_odometry_says() -> None:
    """The vehicle's own odometry, another program, judges ours over 90 s of recorded ticks."""
    with gzip.open(Path(DATA) / "encoder_laser" / "ual_car.encoders.csv.gz", "rt") as file:
        rows = list(csv.DictReader(file))
    turn = 1.0 / 0.00012910  # 1 m of travel is one "turn" of a wheel of 1 m circumference
    wheel = 1.0 / (2.0 * math.pi)
    odometry = DifferentialOdometry(DriveGeometry(wheel, wheel, 1.266, turn, -turn))
    left = right = 0
    ours, theirs = [], []
    for row in rows:
        left += int(row["left_ticks_increment"])
        right += int(row["right_ticks_increment"])
        state = odometry.update(round(float(row["time_s"]) * 1e9), left, right)
        ours.append(state.odom_from_base)
        theirs.append(Pose2(float(row["odo_x_m"]), float(row["odo_y_m"]), float(row["odo_phi_rad"])))
    our_steps, our_turns = steps_and_turns(ours)
    their_steps, their_turns = steps_and_turns(theirs)
    assert our_steps.sum() == pytest.approx(258.6, rel=0.001)
    assert np.corrcoef(our_steps, their_steps)[0, 1] > 0.9999
    assert np.corrcoef(our_turns, their_turns)[0, 1] > 0.998
    # The car's heading has another source as well: it leaves the wheels' by 1 degree in 1.25 m at most, never by a jump
    assert np.abs(our_turns - their_turns).max() < 0.005


def steps_and_turns(poses: list[Pose2]) -> tuple[np.ndarray, np.ndarray]:
    pairs = list(pairwise(poses))
    steps = np.array([math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in pairs])
    return steps, np.array([wrap_angle(b.yaw_rad - a.yaw_rad) for a, b in pairs])


@pytest.mark.data
@needs_data
@pytest.mark.parametrize("name", ["exp1", "exp2", "test_lab2"])
def test_the_small_robot_moves_at_walking_pace(name: str) -> None:
    """Ticks of a robot with a Hokuyo: 2,000 a turn, wheels of 77 mm, half axle 165 mm; no jump between scans."""
    with gzip.open(Path(DATA) / "encoder_laser" / f"{name}.dat.gz", "rt") as file:
        rows = [line.split() for line in file]
    odometry = DifferentialOdometry(DriveGeometry(0.077, 0.077, 0.330, 2000.0, 2000.0))
    speeds = [
        abs(odometry.update(int(row[0]) * 1000, int(row[2]), int(row[3])).forward_m_s) for row in rows if len(row) > 700
    ]
    assert len(speeds) > 300
    assert max(speeds) < 3.5  # its top speed; a lost or doubled count would show as tens of metres a second
    assert np.median(speeds) > 0.05
