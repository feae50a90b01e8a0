"""The calibration of the daemon: which sweeps are compared, when it fits anew, what it says, what breaks a pair."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2, exp_se2
from mapping.localise.calibrate import NAMES, Calibration, RobotModel, base_motions, rolled_back
from mapping.localise.relative_motions import MotionMeter, RelativeMotions
from mapping.odometry import DifferentialOdometry, DriveGeometry
from mapping.scan import Scan
from service.calibration_maker import CalibrationMaker, _Way
from service.calibration_report import advice_of
from service.commands.status import advice_text
from service.map_makers import MapMakers, MapView
from service.outputs import OdomOut
from tests.unit.mapping.test_features_scenes import flat, scan_at

F64 = NDArray[np.float64]
S = 1_000_000_000
DRIVE = DriveGeometry(0.1, 0.1, 0.4, 2000.0, -2000.0)
MOUNT = Pose2(0.2, 0.0, 0.0)


def maker(**lasers: Pose2) -> CalibrationMaker:
    mounts = lasers or {"front": MOUNT}
    return CalibrationMaker(DRIVE, mounts, {name: f"lasers.{name}" for name in mounts})


def odom(stamp_ns: int, pose: Pose2) -> OdomOut:
    return OdomOut(stamp_ns, pose, np.eye(3), 0.0, 0.0)


def row(pose: Pose2) -> F64:
    return np.array([pose.x_m, pose.y_m, pose.yaw_rad])


def seen(pose: Pose2, stamp_ns: int) -> Scan:
    scan = scan_at(flat(), pose, seed=stamp_ns // S)
    return Scan(stamp_ns, 0.0, scan.bearing_rad, scan.range_m, scan.range_min_m, scan.range_max_m)


def turning(count: int, yaw_rad: float = 0.6) -> list[Pose2]:
    return [Pose2(2.0 + 0.02 * k, 2.0, yaw_rad * k) for k in range(count)]


def test_sweeps_are_compared_once_the_walls_are_known_and_the_robot_has_moved() -> None:
    made = maker()
    for k in range(30):
        made.take_sweep("front", seen(Pose2(2.0, 2.0, 0.0), k * S), row(Pose2(2.0, 2.0, 0.0)))
    assert len(made._lasers["front"].motions) == 0
    for k, pose in enumerate(turning(5)):
        made.take_sweep("front", seen(pose, (100 + k) * S), row(pose))
    motions = made._lasers["front"].motions
    assert len(motions) == 4  # the stand's sweep lies where the first of these does
    assert motions[-1].motion[2] == pytest.approx(0.6, abs=0.01)
    assert (motions[-1].start_s, motions[-1].end_s) == (103.0, 104.0)


def test_a_map_that_moved_breaks_the_pair() -> None:
    made = maker()
    poses = turning(24)
    for k, pose in enumerate(poses[:22]):
        made.take_sweep("front", seen(pose, k * S), row(pose))
    before = len(made._lasers["front"].motions)
    made.map_moved()
    made.take_sweep("front", seen(poses[22], 22 * S), row(Pose2(50.0, 0.0, 0.0)))
    assert len(made._lasers["front"].motions) == before
    made.take_sweep("front", seen(poses[23], 23 * S), row(Pose2(50.02, 0.0, 0.6)))
    assert len(made._lasers["front"].motions) == before + 1


def test_sweeps_without_a_pose_or_without_beams_are_left_out() -> None:
    made = maker()
    scan = seen(Pose2(2.0, 2.0, 0.0), 0)
    made.take_sweep("front", scan, np.full(3, math.nan))
    made.take_sweep("front", Scan(0, 0.0, np.zeros(0), np.zeros(0), 0.1, 5.0), np.zeros(3))
    dark = Scan(0, 0.0, scan.bearing_rad, np.full(len(scan.bearing_rad), math.inf), 0.1, 5.0)
    for k, pose in enumerate(turning(30)):
        made.take_sweep("front", Scan(k * S, 0.0, dark.bearing_rad, dark.range_m, 0.1, 5.0), row(pose))
    assert len(made._lasers["front"].motions) == 0
    assert made._lasers["front"].meter.rejected > 0


def test_it_is_told_only_when_it_was_fitted_anew() -> None:
    made = maker()
    view, told = MapView(5, None, (), None), list[int]()
    for k, pose in enumerate(turning(64)):
        made.take_odometry(odom(k * S, pose))
        made.take_sweep("front", seen(pose, k * S), row(pose))
        if made.make(view):
            told.append(len(made._lasers["front"].motions))
    assert told == [20, 40]
    assert made.make(view) == []
    assert made.changed_tiles() == []


def test_makers_hand_it_every_odometry_and_count_what_is_too_much() -> None:
    made = maker()
    makers = MapMakers([made], lambda _output: None, now_ns=lambda: 0)
    for k in range(10):
        makers.take_output(odom(k * S, Pose2(0.1 * k, 0.0, 0.0)))
    makers.turn(0)
    np.testing.assert_allclose(made._way.rows()[1][:, 0], 0.1 * np.arange(10))
    for k in range(5000):
        makers.take_output(odom((k + 10) * S, Pose2(0.1 * k, 0.0, 0.0)))
    assert makers.counters()["makers.odometry_lost"] == 5000 - 4096


@given(
    st.lists(st.tuples(st.floats(0.001, 0.2), st.floats(-0.05, 0.05), st.floats(-0.3, 0.3)), min_size=2, max_size=80)
)
def test_what_is_kept_of_the_way_is_on_it(steps: list[tuple[float, float, float]]) -> None:
    """Steps of seconds, metres, radians; now and then the robot stands."""
    way, pose, stamp_ns = _Way(), Pose2(0.0, 0.0, 0.0), 0
    given_rows = []
    for seconds, forward, turn in steps:
        stamp_ns += round(seconds * 1e9)
        pose = pose @ exp_se2((forward, 0.0, turn if abs(turn) > 0.1 else 0.0))
        way.add(stamp_ns, pose)
        given_rows.append((stamp_ns * 1e-9, pose.x_m, pose.y_m, pose.yaw_rad))
    stamps, poses = way.rows()
    kept = {(float(s), *p.tolist()) for s, p in zip(stamps, poses)}
    assert kept <= set(given_rows)
    assert given_rows[0] in kept
    assert given_rows[-1] in kept
    assert np.all(np.diff(stamps) > 0.0)


def test_the_way_is_bounded_and_keeps_the_newest() -> None:
    way = _Way()
    for k in range(100_000):
        way.add(k * 50_000_000, Pose2(0.01 * k, 0.0, 0.0))
    stamps, poses = way.rows()
    assert 30_000 < len(stamps) <= 45_000
    assert poses[-1, 0] == pytest.approx(999.99)
    assert np.all(np.diff(stamps) == pytest.approx(0.05))


@given(st.integers(0, 2**32 - 1))
def test_wheels_worked_back_roll_as_odometry_did(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ticks = np.cumsum(rng.integers(-40, 60, (50, 2)), axis=0) * [1, -1]
    odometry = DifferentialOdometry(DRIVE)
    states = [odometry.update(k * S // 10 + 1, int(left), int(right)) for k, (left, right) in enumerate(ticks)]
    stamps = np.array([state.stamp_ns * 1e-9 for state in states])
    poses = np.array([row(state.odom_from_base) for state in states])
    model = RobotModel(DRIVE.left_m_per_tick, DRIVE.right_m_per_tick, DRIVE.track_width_m)
    found = rolled_back(stamps, poses, model)
    np.testing.assert_allclose(found.left, ticks[:, 0] - ticks[0, 0], atol=1e-6)
    np.testing.assert_allclose(found.right, ticks[:, 1] - ticks[0, 1], atol=1e-6)
    whole = RelativeMotions(stamps[:1], stamps[-1:], np.zeros((1, 3)), np.eye(3)[None])
    moved = base_motions(found, whole, model.row())[0]
    ends = states[0].odom_from_base.inverse() @ states[-1].odom_from_base
    np.testing.assert_allclose(moved[:2], (ends.x_m, ends.y_m), atol=1e-6)


@pytest.mark.parametrize("count", [0, 1])
def test_without_odometry_there_is_nothing_to_tell(count: int) -> None:
    made = maker()
    for k in range(count):
        made.take_odometry(odom(k * S, Pose2()))
    for k, pose in enumerate(turning(60)):
        made.take_sweep("front", seen(pose, k * S), row(pose))
    assert len(made.make(MapView(5, None, (), None))) == 1
    found = made._lasers["front"].found
    assert found is not None
    assert not found.observable.any()


def test_a_meter_without_a_sweep_before_says_nothing() -> None:
    meter = MotionMeter()
    scan = seen(Pose2(2.0, 2.0, 0.0), 0)
    assert meter.take(scan, Pose2(0.0, 0.0, 0.0)) is None
    assert meter.rejected == 0
    assert meter.take(scan, Pose2(0.0, 0.0, 0.0)) is not None
    meter.begin_anew()
    assert meter.take(scan, Pose2(0.0, 0.0, 0.0)) is None


def told(off: dict[str, float], observable: bool = True) -> tuple[Calibration, RobotModel]:
    """A fit that differs by some values; deviations are 1 mm, 0.001 rad and 0.1 %."""
    believed = RobotModel(DRIVE.left_m_per_tick, DRIVE.right_m_per_tick, DRIVE.track_width_m, 0.2)
    best = believed.row()
    for name, value in off.items():
        best[NAMES.index(name)] += value
    deviation = np.concatenate((1e-3 * np.abs(believed.row()[:3]), np.full(4, 1e-3)))
    return Calibration(best, deviation, np.eye(7), np.full(7, observable), 50, 0, 1.0, 0.0, 0.0, 30.0, 9.0), believed


def advised(found: tuple[Calibration, RobotModel]) -> dict[object, object]:
    advice = advice_of(*found, laser="lasers.front", ticks_per_turn=(2000.0, -2000.0))
    return {each["setting"]: each["value"] for each in advice}


def test_only_what_is_surely_and_clearly_off_is_advised() -> None:
    assert advised(told({})) == {}
    assert advised(told({"laser_x_m": 0.004, "laser_y_m": -0.01, "track_width_m": 0.01})) == {
        "lasers.front.mount.y_m": -0.01,
        "drive.track_width_m": 0.41,
    }
    assert advised(told({"laser_y_m": -0.01, "laser_yaw_rad": 0.1}, observable=False)) == {}
    gain = DRIVE.right_m_per_tick * 0.02  # its ticks fall rolling forward: a radius is positive all the same
    assert advised(told({"right_m_per_tick": gain})) == {"drive.wheel_radius_right_m": 0.102}
    assert advised(told({"laser_yaw_rad": 0.02, "time_offset_s": 0.5})) == {"lasers.front.mount.yaw_deg": 1.15}
    turn = 2.0 * math.pi  # a laser that looks back: 180 degrees are -180
    assert advised(told({"laser_yaw_rad": turn})) == {}
    assert advised(told({"laser_yaw_rad": 0.02 - turn})) == {"lasers.front.mount.yaw_deg": 1.15}


def test_a_new_finding_is_one_line_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    made = maker()
    made._lasers["front"].found = told({"track_width_m": 0.02})[0]
    with caplog.at_level(logging.INFO):
        made._fields()
        made._fields()
    assert [record.message for record in caplog.records] == [
        "calibration by front: the drive so far says drive.track_width_m = 0.42 ± 0.0004 instead of 0.4"
    ]


@pytest.mark.parametrize(
    ("as_believed", "words"),
    [
        ((False, False), "lasers.front.mount.upside_down wrong"),
        ((False, True), "the left wheel counts backwards: drive.ticks_per_turn_left = -2000"),
        ((True, False), "the right wheel counts backwards: drive.ticks_per_turn_right = 2000"),
    ],
)
def test_a_sign_that_is_wrong_is_told_once_and_no_number_with_it(
    as_believed: tuple[bool, bool], words: str, caplog: pytest.LogCaptureFixture
) -> None:
    made = maker()
    made._lasers["front"].found = told({"track_width_m": 0.02})[0]
    made._lasers["front"].turns_as_believed = as_believed
    with caplog.at_level(logging.INFO):
        fields = made._fields()
        assert made._fields() == fields
    (record,) = caplog.records
    assert words in record.message
    (report,) = fields["lasers"].values()  # type: ignore[attr-defined]
    assert words in report["contradiction"]
    assert report["advice"] == []
    assert words in advice_text(fields)


def test_status_says_each_setting_once() -> None:
    advice = [{"setting": "drive.track_width_m", "value": 0.41, "deviation": 0.001, "instead_of": 0.4}]
    assert advice_text({"lasers": {"front": {"advice": []}}}) == ""
    assert advice_text({"lasers": {"front": {"advice": advice}, "back": {"advice": advice}}}) == (
        "to look at: drive.track_width_m = 0.41 ± 0.001, not 0.4 (umfeld calibrate)"
    )
