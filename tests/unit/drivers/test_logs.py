"""Readers of recorded logs: lines written here by hand, damaged ones, and the recorded logs' own published counts."""

from __future__ import annotations

import gzip
import math
import os
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.logs import LogError, PoseKind, read_log
from drivers.logs.carmen import field_of_beams, read_carmen
from drivers.logs.log import compose, dead_reckoning, in_order, made_up_stamps, no_echo_threshold, relative

DATA = Path(os.environ.get("UMFELD_DATA", "/nonexistent"))
needs_data = pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")


def flaser(ranges: list[float], stamp: float, *, laser: str = "1.1 2.0 0.0", robot: str = "1.0 2.0 0.0") -> str:
    return f"FLASER {len(ranges)} {' '.join(f'{r:.2f}' for r in ranges)} {laser} {robot} {stamp:.6f} host {stamp:.6f}"


def written(tmp_path: Path, *lines: str, name: str = "some.log", packed: bool = False) -> Path:
    path = tmp_path / name
    data = ("\n".join(lines) + "\n").encode()
    path.write_bytes(gzip.compress(data) if packed else data)
    return path


@pytest.mark.parametrize("packed", [False, True])
def test_carmen_lines(tmp_path: Path, packed: bool) -> None:
    path = written(
        tmp_path,
        "# CARMEN Logfile",
        "PARAM robot_use_laser on nohost 0",
        "ODOM 1.0 2.0 0.5 0.1 0.2 0.0 9.9 host 9.9",
        flaser([1.0] * 179 + [81.91], 10.0, laser="1.0 2.1 1.57", robot="1.0 2.0 1.57"),
        packed=packed,
    )
    log = read_log(path)
    assert len(log.scans) == 1
    scan = log.scans[0]
    assert scan.stamp_text == "10.000000"
    assert scan.bearing_rad[0] == pytest.approx(-math.pi / 2)
    assert scan.bearing_rad[-1] == pytest.approx(math.radians(89.0))
    assert scan.range_m[0] == 1.0
    assert scan.range_m[-1] == math.inf
    assert scan.laser_pose == (1.0, 2.1, 1.57)
    assert scan.robot_pose == (1.0, 2.0, 1.57)
    assert log.robot_from_laser == pytest.approx((0.1, 0.0, 0.0), abs=1e-4)
    assert log.poses is PoseKind.ODOMETRY
    assert log.provenance.comments == ("CARMEN Logfile",)
    assert log.skipped == {"param": 1}


def rawlaser(ranges: list[float], stamp: float) -> str:
    told = " ".join(f"{r:.2f}" for r in ranges)
    return f"RAWLASER1 0 -1.570796 3.141593 0.017453 81.9 0.01 0 {len(ranges)} {told} 0 {stamp:.6f} host 0"


def odom(x: float, yaw: float, stamp: float) -> str:
    return f"ODOM {x} 2.0 {yaw} 0 0 0 {stamp:.6f} host 0"


def test_scans_without_poses_lie_where_odometry_is(tmp_path: Path) -> None:
    lines = [line for k in range(5) for line in (odom(0.5 * k, 3.1 + 0.1 * k, k), rawlaser([2.0] * 181, k + 0.5))]
    log = read_log(written(tmp_path, *lines, odom(2.5, 3.6, 5.0)))
    found = np.array([scan.robot_pose for scan in log.scans])
    np.testing.assert_allclose(found[:, 0], 0.25 + 0.5 * np.arange(5))
    turned = 3.15 + 0.1 * np.arange(5)
    np.testing.assert_allclose(found[:, 2], np.where(turned > math.pi, turned - 2.0 * math.pi, turned), atol=1e-12)
    assert log.robot_from_laser == (0.0, 0.0, 0.0)
    assert np.isfinite(log.scans[0].range_m).all()


def test_poses_that_never_move_are_replaced_by_odometry(tmp_path: Path) -> None:
    still = [flaser([2.0] * 180, k, laser="0.2 0.0 0.0", robot="0.0 0.0 0.0") for k in range(4)]
    log = read_log(written(tmp_path, *still, *(odom(0.5 * k, 0.0, k) for k in range(4))))
    np.testing.assert_allclose([scan.robot_pose[0] for scan in log.scans], [0.0, 0.5, 1.0, 1.5])
    assert log.robot_from_laser == (0.2, 0.0, 0.0)


def test_of_one_laser_told_twice_the_lines_with_poses_are_read(tmp_path: Path) -> None:
    posed = (
        "ROBOTLASER1 0 -1.570796 3.141593 0.017453 81.9 0.01 0 3 1.5 2.0 2.5 0 "
        "5.2 1.0 0.0 5.0 1.0 0.0 0 0 0 0 0 {} host 0.1"
    )
    lines = [line for k in range(3) for line in (rawlaser([1.5, 2.0, 2.5], k), posed.format(k))]
    log = read_log(written(tmp_path, *lines, rawlaser([1.5, 2.0, 2.5], 3)))
    assert len(log.scans) == 3
    assert log.robot_from_laser == (0.2, 0.0, 0.0)
    assert log.skipped == {"other_laser_rawlaser1": 4}


def test_robotlaser_says_its_field_offset_and_limit(tmp_path: Path) -> None:
    line = (
        "ROBOTLASER1 0 -1.570796 3.141593 0.017453 20.0 0.01 0 3 1.5 20.0 20.5 2 7 8 "
        "5.2 1.0 0.0 5.0 1.0 0.0 0 0 0 0 0 123.5 host 0.1"
    )
    log = read_log(written(tmp_path, line))
    scan = log.scans[0]
    np.testing.assert_allclose(scan.bearing_rad, np.radians([-90.0, -89.0, -88.0]), atol=1e-12)
    np.testing.assert_array_equal(scan.range_m, [1.5, np.inf, np.inf])
    assert scan.stamp_s == 123.5
    assert log.robot_from_laser == (0.2, 0.0, 0.0)


@pytest.mark.parametrize(
    ("beams", "first", "last"),
    [
        (180, -90, 89),
        (181, -90, 90),
        (360, -90, 89.5),
        (361, -90, 90),
        (401, -50, 50),
        (541, -135, 135),
        (1081, -135, 135),
        (682, -119.53125, 119.8828125),
    ],
)
def test_fields_of_view(beams: int, first: float, last: float) -> None:
    bearings = field_of_beams(beams)
    assert len(bearings) == beams
    assert np.degrees(bearings[[0, -1]]) == pytest.approx([first, last])
    with pytest.raises(ValueError, match="read-only"):
        bearings[0] = 0.0


@pytest.mark.parametrize(
    "bad",
    [
        "FLASER 5 1 2 3 0 0 0 0 0 0 1.0 host 1.0",
        "FLASER -3 1 2 3 0 0 0 0 0 0 1.0 host 1.0",
        "FLASER 999999999 1 2 3 0 0 0 0 0 0 1.0 host 1.0",
        "FLASER 2 1 2 0 0 nan 0 0 0 1.0 host 1.0",
        "FLASER 2 1 2 0 0 0 0 0 0 inf host 1.0",
        "FLASER 2 1 x 0 0 0 0 0 0 1.0 host 1.0",
        "FLASER",
        "ROBOTLASER1 0 -1.5 3 0.0 20.0 0.01 0 2 1 2 0 0 0 0 0 0 0 0 0 0 0 0 1.0 host 1",
        "ROBOTLASER1 0 -1.5 3 0.1 20.0 0.01 0 2 1 2 -4 0 0 0 0 0 0 0 0 0 0 0 1.0 host 1",
        "ODOM 1 2",
        "ODOM 1 2 3 4 5 6 x host 7",
    ],
)
def test_damaged_lines_are_counted_and_skipped(tmp_path: Path, bad: str) -> None:
    log = read_log(written(tmp_path, flaser([1.0, 2.0], 1.0), bad, flaser([1.0, 2.0], 2.0)))
    assert len(log.scans) == 2
    assert sum(n for reason, n in log.skipped.items() if reason.startswith("bad_")) == 1


@given(st.binary(max_size=400))
def test_noise_after_a_good_line_does_no_harm(noise: bytes) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "noise.log"
        path.write_bytes(flaser([1.0, 2.0], 1.0).encode() + b"\n" + noise + b"\n" + flaser([1.0, 2.0], 2.0).encode())
        assert len(read_log(path).scans) >= 2


def test_two_lasers_the_busier_one_is_read(tmp_path: Path) -> None:
    rear = flaser([3.0, 3.0], 1.5).replace("FLASER", "RLASER")
    log = read_log(written(tmp_path, flaser([1.0, 2.0], 1.0), rear, flaser([1.0, 2.0], 2.0)))
    assert [s.range_m[0] for s in log.scans] == [1.0, 1.0]
    assert log.skipped["other_laser_rlaser"] == 1


def test_a_corrected_log_is_known_and_its_odometry_lines_are_left_alone(tmp_path: Path) -> None:
    lines = ["ODOM 99 99 0 0 0 0 1.5 h 1.5", *(flaser([1.0, 2.0], float(k)) for k in range(3)), "NEFF 0.5"]
    log = read_log(written(tmp_path, *lines))
    assert log.poses is PoseKind.CORRECTED
    assert log.odometry.pose[:, 0].max() == 1.0
    assert read_log(written(tmp_path, *lines), poses=PoseKind.ODOMETRY).odometry.pose[:, 0].max() == 1.0
    assert read_log(written(tmp_path, flaser([1.0], 1.0), name="x-corrected.log")).poses is PoseKind.CORRECTED


def test_a_stamp_without_leading_zeros_is_repaired_and_keeps_its_name(tmp_path: Path) -> None:
    stamps = [4.8, 4.9, 5.4, 5.1, 5.2, 5.3, 5.5, 5.6]  # 5.04 s, written as 5.4
    log = read_log(written(tmp_path, *(flaser([1.0, 2.0], s) for s in stamps)))
    assert log.stamps_repaired == 1
    assert [s.stamp_text for s in log.scans] == [f"{s:.6f}" for s in stamps]
    assert [s.line for s in log.scans] == list(range(1, 9))
    assert 4.9 < log.scans[2].stamp_s < 5.1


@given(st.lists(st.floats(0, 1000), max_size=60))
def test_order_never_falls_and_loses_nothing(stamps: list[float]) -> None:
    order, repaired, count = in_order(stamps)
    assert sorted(order.tolist()) == list(range(len(stamps)))
    assert np.all(np.diff(repaired) >= 0)
    assert sum(repaired[k] != stamps[i] for k, i in enumerate(order)) <= count


@given(st.lists(st.floats(0, 1000), min_size=2, max_size=40), st.randoms())
def test_shuffled_rows_with_good_stamps_are_sorted(stamps: list[float], random: object) -> None:
    backwards = sorted(stamps, reverse=True)
    if len(set(stamps)) < 5:
        return
    order, found, count = in_order(backwards)
    assert count == 0
    np.testing.assert_array_equal(found, sorted(stamps))
    np.testing.assert_array_equal(np.array(backwards)[order], found)


def test_useless_stamps_are_made_up_from_the_way(tmp_path: Path) -> None:
    lines = [flaser([1.0, 2.0], 1.01893e9, laser=f"{k * 0.6} 0 0", robot=f"{k * 0.6} 0 0") for k in range(5)]
    log = read_log(written(tmp_path, *lines))
    assert log.stamps_made_up
    np.testing.assert_allclose([s.stamp_s for s in log.scans], [0.0, 2.0, 4.0, 6.0, 8.0], atol=1e-6)
    assert [float(s.stamp_text) for s in log.scans] == [s.stamp_s for s in log.scans]


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-7, 7)), min_size=1, max_size=20))
def test_made_up_stamps_rise(poses: list[tuple[float, float, float]]) -> None:
    assert np.all(np.diff(made_up_stamps(poses)) >= 0.1 - 1e-9)


def test_a_needle_at_the_far_end_is_no_echo_and_a_wall_is_not() -> None:
    random = np.random.default_rng(3)
    room = [np.clip(random.normal(5.0, 0.02, 180), 0, None) for _ in range(40)]
    assert no_echo_threshold(room) == math.inf
    with_misses = [np.where(random.random(180) < 0.02, 29.99, r) for r in room]
    assert no_echo_threshold(with_misses) == pytest.approx(29.985)
    assert no_echo_threshold([np.array([1.0, 81.9])]) < 81.9
    assert no_echo_threshold([np.full(180, 1.5)] * 5) == math.inf, "close by all round is not nothing all round"
    assert no_echo_threshold([np.full(180, 9.5)] * 50) == math.inf
    standing = [np.append(np.linspace(1.0, 9.0, 179), 9.5)] * 500
    assert no_echo_threshold(standing) == math.inf, "one beam that meets a far wall again and again"
    assert no_echo_threshold([np.array([1.0, 7.0])], declared_max_m=7.0) < 7.0
    assert no_echo_threshold([]) == math.inf


def test_a_beam_that_never_changes_does_not_measure(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    lines = [flaser([*random.uniform(1, 49, 30), 50.0], float(k)) for k in range(60)]
    scans = read_log(written(tmp_path, *lines)).scans
    assert all(math.isnan(s.range_m[-1]) for s in scans)
    assert all(np.isfinite(s.range_m[:-1]).all() for s in scans)


def test_zero_negative_and_nan_ranges_are_nothing_known(tmp_path: Path) -> None:
    scan = read_log(written(tmp_path, "FLASER 4 0 -1 nan 2.5 0 0 0 0 0 0 1.0 h 1.0")).scans[0]
    assert np.isnan(scan.range_m).tolist() == [True, True, True, False]


def test_no_echo_can_be_given(tmp_path: Path) -> None:
    scan = read_log(written(tmp_path, flaser([4.0, 5.0, 6.0], 1.0)), no_echo_m=5.0).scans[0]
    assert np.isinf(scan.range_m).tolist() == [False, True, True]


@pytest.mark.parametrize("text", ["", "hello\nworld\n", "1 2 3\n", "PARAM x y\nODOM 0 0 0 0 0 0 1 h 1\n"])
def test_what_is_no_log_is_told(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(LogError) as caught:
        read_log(path)
    assert str(path) in str(caught.value)


def test_missing_and_damaged_files_are_told(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="No such file"):
        read_log(tmp_path / "none.log")
    cut = tmp_path / "cut.log.gz"
    cut.write_bytes(gzip.compress(flaser([1.0] * 50, 1.0).encode())[:-20])
    with pytest.raises(LogError, match="damaged gzip"):
        read_log(cut)


def test_damage_beyond_the_head_is_told(tmp_path: Path) -> None:
    """The dialect is known from the first lines; the rest is unpacked as it is read."""
    rng = np.random.default_rng(0)
    text = "\n".join(flaser(rng.uniform(1.0, 8.0, 180).tolist(), float(k)) for k in range(400))
    cut = tmp_path / "cut.log.gz"
    cut.write_bytes(gzip.compress(text.encode())[:-1000])
    with pytest.raises(LogError, match="damaged gzip"):
        read_log(cut)


@pytest.mark.parametrize("packed", [False, True])
def test_reading_takes_little_more_memory_than_what_is_kept(tmp_path: Path, packed: bool) -> None:
    """The text of Intel's 45 minutes, unpacked, split into lines and decoded, took four times what it says."""
    rng = np.random.default_rng(0)
    lines = [flaser(rng.uniform(1.0, 8.0, 180).tolist(), float(k)) for k in range(3000)]
    path = written(tmp_path, *lines, packed=packed)
    tracemalloc.start()
    try:
        log = read_log(path)
        kept, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(log.scans) == 3000
    assert peak < 3.0 * kept + path.stat().st_size


def test_wean_lines_are_centimetres(tmp_path: Path) -> None:
    ranges = " ".join(["150"] * 179 + ["8183"])
    log = read_log(
        written(tmp_path, "L 100 200 0 125 200 0 " + ranges + " 0.5", "O 100 200 0 0.6", "O 110 200 0 0.7", "O 1 2")
    )
    scan = log.scans[0]
    assert (scan.range_m[0], scan.range_m[-1], scan.stamp_s) == (1.5, math.inf, 0.5)
    assert log.robot_from_laser == (0.25, 0.0, 0.0)
    assert log.skipped == {"other": 1}


def test_tinyslam_rows_codes_wrap_and_short_last_row(tmp_path: Path) -> None:
    def row(microseconds: int, left: int, right: int) -> str:
        values = [microseconds, 0, left, right] + [0] * 20 + [19, 20, 5600] + [6] * 679
        return " ".join(map(str, values))

    first = row(2**32 - 50_000, 1000, 1000)
    second = row(50_000, 1000 + 2000, 1000 + 2000)
    log = read_log(written(tmp_path, first, second, "1 2 3", name="x.dat"))
    assert [round(s.stamp_s - log.scans[0].stamp_s, 6) for s in log.scans] == [0.0, 0.1]
    np.testing.assert_array_equal(log.scans[0].range_m[:3], [np.nan, 0.02, 5.6])
    assert log.scans[1].robot_pose == pytest.approx((2 * math.pi * 0.077, 0.0, 0.0))
    assert log.scans[1].laser_pose[0] == pytest.approx(2 * math.pi * 0.077 + 0.145)
    assert log.skipped == {"short_row": 1}
    assert log.ticks is not None
    assert log.ticks.left.tolist() == [1000, 3000]


def test_ual_pair_is_found_from_either_side_and_missed_aloud(tmp_path: Path) -> None:
    encoders = tmp_path / "car.encoders.csv"
    encoders.write_text(
        "time_s,odo_x_m,odo_y_m,odo_phi_rad,left_ticks_increment,right_ticks_increment,speed_m_s,turn_rate_rad_s\n"
        "1.0,0,0,0,10,-10,1,0\n2.0,2,0,0.2,10,-12,1,0\nx\n"
    )
    with pytest.raises(LogError, match=r"car\.scans\.csv"):
        read_log(encoders)
    scans = tmp_path / "car.scans.csv.gz"
    scans.write_bytes(gzip.compress(b"time_s,range_0_m..range_2_m (0 = flagged invalid)\n1.5,0,3.5,4\n1.6,1\n"))
    for path in (encoders, scans):
        log = read_log(path)
        assert log.scans[0].robot_pose == pytest.approx((1.0, 0.0, 0.1))
        np.testing.assert_array_equal(log.scans[0].range_m, [np.nan, 3.5, 4.0])
        assert log.ticks is not None
        assert (log.ticks.left[-1], log.ticks.right[-1]) == (20, -22)
        assert log.skipped == {"bad_encoder_row": 1, "bad_scan_row": 1}


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_relative_undoes_compose(ax: float, ay: float, aa: float, bx: float, by: float, ba: float) -> None:
    a, b = (ax, ay, aa), (bx, by, ba)
    np.testing.assert_allclose(relative(a, compose(a, b))[0], b, atol=1e-9)


def test_dead_reckoning_round_a_circle() -> None:
    radius, track = 2.0, 0.5
    angle = np.linspace(0.0, 2 * np.pi, 11)
    pose = dead_reckoning(angle * (radius - track / 2), angle * (radius + track / 2), track)
    np.testing.assert_allclose(pose[:, 0], radius * np.sin(angle), atol=1e-12)
    np.testing.assert_allclose(pose[:, 1], radius * (1 - np.cos(angle)), atol=1e-12)


# --- the recorded logs, against the counts that stand beside them -----------------------------------------------------


@pytest.mark.data
@needs_data
@pytest.mark.parametrize(
    ("name", "scans", "beams", "seconds", "way_m", "no_echo", "offset"),
    [
        ("carmen_logs/intel.clf.gz", 13631, {180}, 2691, 508, 0.028, (0.0, 0.0)),
        ("carmen_logs/fr079.clf.gz", 4934, {360}, 1061, 392, 0.021, (-0.04, 0.0)),
        ("carmen_logs/fr-clinic.clf.gz", 6917, {180, 181}, 4820, 1402, 0.126, (0.22, 0.0)),
        ("known_pose_logs/acapulco-corrected.log.gz", 861, {181}, None, 812, 0.080, (0.0, 0.0)),
        ("known_pose_logs/belgioioso-corrected.log.gz", 395, {361}, None, 219, 0.005, (0.0, 0.0)),
        ("known_pose_logs/seattle-corrected.log.gz", 241, {361}, None, 190, 0.008, (0.0, 0.0)),
        ("wean_localisation/robotdata1.log.gz", 713, {180}, 135, 41, 0.0054, (0.25, 0.0)),
        ("wean_localisation/robotdata3.log.gz", 1241, {180}, 132, 43, 0.0164, (0.25, 0.0)),
        ("encoder_laser/exp1.dat.gz", 756, {682}, 74.6, None, 0.0, (0.145, 0.0)),
        ("encoder_laser/test_lab2.dat.gz", 404, {682}, 39.4, None, 0.0, (0.145, 0.0)),
        ("encoder_laser/ual_car.scans.csv.gz", 1665, {361}, 90, 258.6, 0.0, (0.0, 0.0)),
    ],
)
def test_recorded_logs(
    name: str,
    scans: int,
    beams: set[int],
    seconds: float | None,
    way_m: float | None,
    no_echo: float,
    offset: tuple[float, float],
) -> None:
    log = read_log(DATA / name)
    assert len(log.scans) == scans
    assert {len(s.range_m) for s in log.scans} == beams
    assert seconds is None or log.duration_s == pytest.approx(seconds, abs=1.0)
    steps = np.diff(log.odometry.pose[:, :2], axis=0)
    assert way_m is None or float(np.hypot(*steps.T).sum()) == pytest.approx(way_m, abs=1.2)
    ranges = np.concatenate([s.range_m for s in log.scans])
    assert np.isinf(ranges).mean() == pytest.approx(no_echo, abs=0.001)
    assert log.robot_from_laser[:2] == pytest.approx(offset, abs=1e-3)
    assert np.all(np.diff([s.stamp_s for s in log.scans]) >= 0)
    assert (log.poses is PoseKind.CORRECTED) == name.startswith("known")
    assert log.stamps_made_up == ("belgioioso" in name)


@pytest.mark.data
@needs_data
def test_car_ticks_are_its_odometry() -> None:
    log = read_log(DATA / "encoder_laser/ual_car.encoders.csv.gz")
    assert log.ticks is not None
    assert log.wheels is not None
    pose = dead_reckoning(
        log.ticks.left * log.wheels.left_m_per_tick,
        log.ticks.right * log.wheels.right_m_per_tick,
        log.wheels.track_width_m,
    )
    ours, theirs = (np.hypot(*np.diff(p[:, :2], axis=0).T) for p in (pose, log.odometry.pose))
    assert ours.sum() == pytest.approx(theirs.sum(), rel=0.01)
    assert np.corrcoef(ours, theirs)[0, 1] > 0.99


@pytest.mark.data
@needs_data
def test_a_long_log_is_read_quickly() -> None:
    begin = time.process_time()
    read_log(DATA / "carmen_logs/intel.clf.gz")
    assert time.process_time() - begin < 5.0  # measured: 0.8 s


def test_a_long_log_is_held_twice_at_most_while_it_is_read(tmp_path: Path) -> None:
    """Each step of reading copies all ranges, and none of the copies was let go before the last was made."""
    scans, beams = 1500, 360
    path = tmp_path / "long.log"
    readings = " ".join(f"{2.0 + beam / 100:.2f}" for beam in range(beams))
    with path.open("w") as file:
        for number in range(scans):
            pose = f"{number / 10:.1f} 0.0 0.0"
            file.write(f"FLASER {beams} {readings} {pose} {pose} {number / 5:.1f} host {number / 5:.1f}\n")
    tracemalloc.start()
    log = read_carmen(path)
    _now, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(log.scans) == scans
    ranges_bytes = sum(scan.range_m.nbytes for scan in log.scans)
    assert peak - path.stat().st_size < 2.7 * ranges_bytes
