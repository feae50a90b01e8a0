"""A log played as truth: every scan once whole, at its own pose as sampled wheels tell it, exact to the millimetre."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.conversation import SetBaudRate
from drivers.laser_hokuyo import HokuyoConversation
from drivers.logs import Log, LogError, LogScan, PoseKind, read_log
from drivers.logs.log import Odometry, PlanarPose, Provenance, dead_reckoning
from drivers.readings import ScanReading
from sim_devices.laser_hokuyo import HokuyoLaser
from sim_devices.log_scene import LogScene, Pace, laser_mount, laser_profile

DATA = Path(os.environ.get("UMFELD_DATA", "/nonexistent"))
needs_data = pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
TRACK_M = 0.5


def log_of(
    poses: list[PlanarPose],
    stamps: list[float],
    *,
    kind: PoseKind = PoseKind.CORRECTED,
    beams: int = 181,
    laser: PlanarPose = (0.0, 0.0, 0.0),
    first_deg: float = -90.0,
    step_deg: float | None = None,
) -> Log:
    step = 180.0 / (beams - 1) if step_deg is None else step_deg
    bearings = np.radians(first_deg + np.arange(beams) * step)
    random = np.random.default_rng(len(poses))
    scans: list[LogScan] = []
    for pose, stamp in zip(poses, stamps):
        ranges = np.round(random.uniform(0.1, 81.0, beams), 2)
        ranges[random.random(beams) < 0.1] = np.inf
        ranges[random.random(beams) < 0.05] = np.nan
        scans.append(LogScan(stamp, str(stamp), bearings, ranges, pose, pose, len(scans) + 1))
    odometry = Odometry(np.array(stamps), np.array(poses).reshape(-1, 3))
    return Log(
        tuple(scans), odometry, kind, laser, 81.9, 81.83, 0, False, Provenance("x.log", "carmen", 1, "abcdef123")
    )


walks = st.lists(
    st.tuples(st.floats(-1, 1), st.floats(-0.3, 0.3), st.floats(-1.5, 1.5), st.floats(0.0, 1.5)),
    min_size=1,
    max_size=12,
)


def walked(steps: list[tuple[float, float, float, float]]) -> tuple[list[PlanarPose], list[float]]:
    poses: list[PlanarPose] = [(1.0, 2.0, 0.4)]
    stamps = [100.0]
    for ahead, aside, turn, wait in steps:
        x, y, yaw = poses[-1]
        c, s = math.cos(yaw), math.sin(yaw)
        poses.append((x + c * ahead - s * aside, y + s * ahead + c * aside, yaw + turn))
        stamps.append(stamps[-1] + wait)
    return poses, stamps


@settings(max_examples=60, deadline=None)
@given(walks, st.sampled_from(list(PoseKind)), st.floats(0.0, 0.01), st.floats(0.0, 0.025))
def test_sampled_wheels_and_whole_sweeps_meet_every_scan_at_its_pose(
    steps: list[tuple[float, float, float, float]], kind: PoseKind, sample_phase: float, sweep_phase: float
) -> None:
    poses, stamps = walked(steps)
    log = log_of(poses, stamps, kind=kind)
    pace = Pace()
    scene = LogScene(log, pace=pace, track_width_m=TRACK_M)
    scene.begin_motion(0)
    samples = sample_phase + np.arange(0.0, scene.duration_s + 0.1, pace.sample_s)
    travel = np.array([scene.wheel_travel_m(round(t * 1e9)) for t in samples])
    start = scene.wheel_travel_m(0)
    told = dead_reckoning(travel[:, 0] - start[0], travel[:, 1] - start[1], TRACK_M)
    x, y, yaw = poses[0]
    c, s = math.cos(yaw), math.sin(yaw)
    profile = laser_profile(log)
    bearings = (
        (np.arange(profile.first_step, profile.last_step + 1) - profile.front_step) * 2 * np.pi / profile.steps_per_turn
    )
    seen = []
    for sweep in range(int(scene.duration_s / pace.sweep_s) + 1):
        begin = sweep_phase + sweep * pace.sweep_s
        fired = (
            begin + np.arange(profile.first_step, profile.last_step + 1) * pace.sweep_s / profile.steps_per_turn
        ) * 1e9
        ranges = scene.beam_ranges(scene.mount, bearings, fired, 81.9)
        scan = scene.scan_at(fired)
        if scan is None:
            assert np.isnan(ranges).all()
            continue
        np.testing.assert_array_equal(ranges, scan.range_m)
        k = scan.line - 1
        seen.append(k)
        truth = log.scans[k].robot_pose
        for moment in fired[[0, -1]] * 1e-9:
            after = int(np.searchsorted(samples, moment))
            if not 0 < after < len(samples):
                continue
            between = told[after - 1] + (moment - samples[after - 1]) / pace.sample_s * (told[after] - told[after - 1])
            where = (x + c * between[0] - s * between[1], y + s * between[0] + c * between[1])
            assert (
                math.dist(where, truth[:2]) < (0.002 if kind is PoseKind.CORRECTED else 0.006) * (k + 1) ** 0.5 + 0.002
            )
            if after > 1 and abs(told[after - 1][2] - told[after][2]) < 1.0:
                assert abs(math.remainder(yaw + between[2] - truth[2], 2 * math.pi)) < 1e-6
    assert sorted(set(seen)) == list(range(len(poses))), "each scan is seen whole at least once, in order"
    assert seen == sorted(seen)


def test_the_logs_own_times_are_kept_where_there_is_room() -> None:
    poses, stamps = walked([(0.3, 0.0, 0.0, 1.0)] * 20)
    scene = LogScene(log_of(poses, stamps))
    middle = scene.stands_s[:, 0] + 0.5 * scene.pace.shortest_stand_s
    np.testing.assert_allclose(middle[1:], np.arange(1.0, 21.0), atol=0.05)
    assert LogScene(log_of(poses, stamps), pace=Pace(speed=2.0)).duration_s == pytest.approx(10.0, abs=0.2)


def test_a_burst_of_scans_takes_its_time_and_is_caught_up() -> None:
    poses, stamps = walked([(0.0, 0.0, 0.1, 0.001)] * 10 + [(0.0, 0.0, 0.0, 1.0)] * 5)
    scene = LogScene(log_of(poses, stamps))
    assert np.all(np.diff(scene.stands_s, axis=1) >= scene.pace.shortest_stand_s - 1e-9)
    assert scene.duration_s == pytest.approx(5.01, abs=0.2)


def test_wheels_are_never_faster_than_told() -> None:
    poses, stamps = walked([(5.0, 1.0, 2.0, 0.1), (-4.0, 0.2, -3.0, 0.1)])
    scene = LogScene(log_of(poses, stamps), track_width_m=TRACK_M)
    scene.begin_motion(0)
    times = np.arange(0.0, scene.duration_s, 0.005)
    travel = np.array([scene.wheel_travel_m(round(t * 1e9)) for t in times])
    assert np.abs(np.diff(travel, axis=0)).max() / 0.005 <= 3.0 + 1e-6


def test_before_it_begins_the_first_scan_is_seen_from_a_standing_robot() -> None:
    poses, stamps = walked([(1.0, 0.0, 0.0, 1.0)])
    scene = LogScene(log_of(poses, stamps))
    assert scene.scan_at(np.array([0.0, 9e12])) is scene.log.scans[0]
    assert scene.wheel_travel_m(10**15) == (0.0, 0.0)
    scene.begin_motion(10**15)
    scene.begin_motion(2 * 10**15)
    assert not scene.has_ended(10**15)
    assert scene.has_ended(10**15 + 10**10)
    assert scene.scan_at(np.array([3e15])) is scene.log.scans[1]
    assert math.isnan(scene.cone_range(scene.mount, 0.2, 0, 4.0))


def test_beams_that_the_log_lacks_are_unknown() -> None:
    log = log_of([(0.0, 0.0, 0.0)], [0.0])
    scene = LogScene(log)
    ranges = scene.beam_ranges(scene.mount, np.radians([-91.0, -90.0, 0.4, 0.0, 91.0]), np.zeros(5), 81.9)
    expected = log.scans[0].range_m[[0, 90]]
    np.testing.assert_array_equal(ranges, [np.nan, expected[0], np.nan, expected[1], np.nan])


@pytest.mark.parametrize(("beams", "steps"), [(181, 360), (361, 720)])
def test_profile_of_common_logs(beams: int, steps: int) -> None:
    profile = laser_profile(log_of([(0, 0, 0)], [0.0], beams=beams, laser=(0.2, 0.0, 0.0)))
    assert (profile.steps_per_turn, profile.last_step - profile.first_step + 1) == (steps, beams)
    assert (profile.first_step - profile.front_step) * 360 / steps == -90.0
    assert profile.dmax_mm >= 81900


def test_beams_between_whole_steps_turn_the_mount() -> None:
    log = log_of([(0, 0, 0)], [0.0], first_deg=-89.6)
    mount = laser_mount(log)
    assert math.degrees(mount.yaw_rad) == pytest.approx(0.4)
    scene = LogScene(log)
    ranges = scene.beam_ranges(mount, np.radians([-90.0, -89.0]), np.zeros(2), 81.9)
    np.testing.assert_array_equal(ranges, log.scans[0].range_m[:2])


def test_beams_that_fit_no_turn_are_refused() -> None:
    log = log_of([(0, 0, 0)], [0.0], step_deg=0.7)
    with pytest.raises(LogError, match="degrees apart"):
        laser_profile(log)


def read_through_wire(log: Log, seconds: float) -> list[ScanReading]:
    """The log's scans as the driver reads them from the emulator's bytes, in simulated time."""
    scene = LogScene(log)
    laser = HokuyoLaser(scene, scene.mount, profile=laser_profile(log), link="usb", noise_scale=0.0)
    driver = HokuyoConversation()
    now = 1_000_000_000
    driver.connected(now)
    found: list[ScanReading] = []
    to_device = b""
    while now < seconds * 1e9:
        now += 2_000_000
        sent = laser.step(now, to_device)
        to_device = b""
        if sent:
            found += [r for r in driver.receive(sent, now) if isinstance(r, ScanReading)]
        for item in driver.requests(now):
            to_device += b"" if isinstance(item, SetBaudRate) else item
        if found:
            scene.begin_motion(now)
    return found


def test_every_scan_of_a_log_comes_out_of_the_driver_to_the_millimetre() -> None:
    poses, stamps = walked([(0.2, 0.01, 0.1, 0.3)] * 12)
    log = log_of(poses, stamps)
    found = read_through_wire(log, 12.0)
    whole = [r for r in found if not np.isnan(r.range_m).all()]
    kinds: list[int] = []
    for reading in whole:
        k = next(k for k, s in enumerate(log.scans) if same_ranges(s.range_m, reading.range_m))
        if not kinds or kinds[-1] != k:
            kinds.append(k)
        np.testing.assert_allclose(reading.bearing_rad, log.scans[k].bearing_rad, atol=1e-9)
    assert kinds == list(range(13))


def same_ranges(said: np.ndarray, read: np.ndarray) -> bool:
    return (
        said.shape == read.shape
        and bool(np.array_equal(np.isnan(said), np.isnan(read)))
        and bool(np.array_equal(np.isposinf(said), np.isposinf(read)))
        and bool(np.allclose(said[np.isfinite(said)], read[np.isfinite(said)], atol=1e-9))
    )


@pytest.mark.data
@needs_data
@pytest.mark.parametrize(
    "name", ["carmen_logs/intel.clf.gz", "known_pose_logs/seattle-corrected.log.gz", "encoder_laser/exp1.dat.gz"]
)
def test_recorded_logs_play_whole(name: str) -> None:
    log = read_log(DATA / name)
    scene = LogScene(log)
    scene.begin_motion(0)
    middle = scene.stands_s.mean(axis=1) * 1e9
    truth = np.array([s.robot_pose for s in log.scans])
    pose = scene.pose_at(middle)
    limit = 0.0011 if log.poses is PoseKind.CORRECTED else 0.0051
    assert np.hypot(*(pose[:, :2] - truth[:, :2]).T).max() <= limit
    assert scene.duration_s == pytest.approx(log.duration_s, rel=0.05)
