"""The relation error against figures that others computed, closed forms, and files that are not in order."""

from __future__ import annotations

import gzip
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from drivers.logs import read_log
from service.commands.evaluate import app
from service.errors import Trouble
from service.evaluate import Relations, Trajectory, read_relations, read_trajectory, relation_error

DATA = Path(os.environ.get("UMFELD_DATA", "/nonexistent")) / "carmen_logs"
needs_data = pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")

poses = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-math.pi, math.pi))


def matrix(pose: tuple[float, float, float]) -> np.ndarray:
    """An independent SE(2): homogeneous matrices."""
    x, y, a = pose
    return np.array([[math.cos(a), -math.sin(a), x], [math.sin(a), math.cos(a), y], [0, 0, 1]])


def trajectory_of(*rows: tuple[float, float, float], start: float = 0.0) -> Trajectory:
    stamps = [start + k for k in range(len(rows))]
    return Trajectory(tuple(f"{s:.6f}" for s in stamps), np.array(stamps), np.array(rows).reshape(-1, 3))


@given(poses, poses, poses)
def test_error_is_that_of_the_matrices(
    a: tuple[float, float, float], b: tuple[float, float, float], d: tuple[float, float, float]
) -> None:
    relations = Relations(("0.000000",), ("1.000000",), np.array([d]))
    found = relation_error(trajectory_of(a, b), relations)
    off = np.linalg.inv(matrix(d)) @ np.linalg.inv(matrix(a)) @ matrix(b)
    assert found.translation_m.mean == pytest.approx(math.hypot(off[0, 2], off[1, 2]), abs=1e-9)
    assert found.rotation_deg.mean == pytest.approx(abs(math.degrees(math.atan2(off[1, 0], off[0, 0]))), abs=1e-6)


@given(poses, st.lists(poses, min_size=2, max_size=6))
def test_moving_the_whole_trajectory_changes_nothing(
    shift: tuple[float, float, float], rows: list[tuple[float, float, float]]
) -> None:
    moved = []
    for row in rows:
        m = matrix(shift) @ matrix(row)
        moved.append((m[0, 2], m[1, 2], math.atan2(m[1, 0], m[0, 0])))
    relations = Relations(
        tuple(f"{k}.000000" for k in range(len(rows) - 1)),
        tuple(f"{k + 1}.000000" for k in range(len(rows) - 1)),
        np.tile([0.3, -0.2, 0.1], (len(rows) - 1, 1)),
    )
    before = relation_error(trajectory_of(*rows), relations)
    after = relation_error(trajectory_of(*moved), relations)
    assert after.translation_m.mean == pytest.approx(before.translation_m.mean, abs=1e-7)
    assert after.rotation_deg.largest == pytest.approx(before.rotation_deg.largest, abs=1e-5)


def test_spread_is_over_all_relations_and_of_squares() -> None:
    relations = Relations(("0.000000", "0.000000"), ("1.000000", "2.000000"), np.array([[1.0, 0, 0], [2.0, 0, 0]]))
    found = relation_error(trajectory_of((0, 0, 0), (1.0, 3.0, 0), (2.0, 5.0, 0)), relations)
    assert found.translation_m.mean == pytest.approx(4.0)
    assert found.translation_m.std == pytest.approx(1.0)
    assert found.translation_m.mean_of_squares == pytest.approx(17.0)
    assert found.translation_m.std_of_squares == pytest.approx(8.0)
    assert found.translation_m.largest == pytest.approx(5.0)


def test_missing_stamps_are_counted_and_named() -> None:
    relations = Relations(("0.000000", "7.5"), ("1.000000", "1.000000"), np.zeros((2, 3)))
    found = relation_error(trajectory_of((0, 0, 0), (0, 0, 0)), relations)
    assert (found.relations, found.not_evaluated, found.missing) == (2, 1, ("7.5",))
    assert found.translation_m.mean == 0.0


@pytest.mark.parametrize(("offset", "missing"), [(0.00009, 0), (-0.00009, 0), (0.00011, 1), (-0.00011, 1)])
def test_nearest_stamp_within_a_tenth_of_a_millisecond(offset: float, missing: int) -> None:
    relations = Relations((f"{5.0 + offset:.6f}",), ("6.000000",), np.zeros((1, 3)))
    assert relation_error(trajectory_of((0, 0, 0), (0, 0, 0), start=5.0), relations).not_evaluated == missing


def test_text_comes_before_nearest_and_order_does_not_matter() -> None:
    trajectory = Trajectory(
        ("2.000000", "1.000000", "1.00000"),
        np.array([2.0, 1.0, 1.0]),
        np.array([[5.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0]]),
    )
    relations = Relations(("1.00000",), ("2.000000",), np.array([[-4.0, 0, 0]]))
    assert relation_error(trajectory, relations).translation_m.mean == pytest.approx(0.0)


def test_files_plain_packed_tum_and_planar(tmp_path: Path) -> None:
    half = math.pi / 8
    tum = tmp_path / "t.tum"
    tum.write_text(
        f"# stamp x y z qx qy qz qw\n\n1.5 1 2 0 0 0 {math.sin(half) * 3} {math.cos(half) * 3}\n2.5 1 2 9 0 0 0 1\n"
    )
    planar = tmp_path / "t.txt.gz"
    planar.write_bytes(gzip.compress(b"1.5 1 2 0.7853981633974483\n2.5 1 2 0\n"))
    one, two = read_trajectory(tum), read_trajectory(planar)
    assert one.text == two.text == ("1.5", "2.5")
    np.testing.assert_allclose(one.pose, two.pose, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 2 3\n", "line 1 has 3 numbers"),
        ("# only this\n", "no row"),
        ("1 2 3 4\n1 2 x 4\n", "line 2 is not all numbers"),
        ("1 2 nan 4\n", "not finite"),
    ],
)
def test_bad_files_name_file_line_and_form(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(text)
    with pytest.raises(Trouble) as caught:
        read_trajectory(path)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)


def test_damaged_gzip_is_told(tmp_path: Path) -> None:
    path = tmp_path / "r.gz"
    path.write_bytes(gzip.compress(b"1 2 0 0 0 0 0 0\n" * 100)[:40])
    with pytest.raises(Trouble, match="damaged gzip"):
        read_relations(path)


def test_command_prints_json_and_fails_if_nothing_was_evaluated(tmp_path: Path) -> None:
    trajectory, relations = tmp_path / "t.tum", tmp_path / "r"
    trajectory.write_text("1 0 0 0\n2 1 0 0\n")
    relations.write_text("1 2 1 0 0 0 0 0.5\n")
    good = CliRunner().invoke(app, [str(trajectory), str(relations), "--json"])
    assert good.exit_code == 0
    report = json.loads(good.stdout)
    assert report["relations"] == 1
    assert report["rotation_deg"]["mean"] == pytest.approx(math.degrees(0.5))
    relations.write_text("8 9 1 0 0 0 0 0.5\n")
    bad = CliRunner().invoke(app, [str(trajectory), str(relations), "--json"])
    assert bad.exit_code == 1
    assert json.loads(bad.stdout)["translation_m"]["mean"] is None


@pytest.mark.data
@needs_data
@pytest.mark.parametrize(
    ("log", "count", "metres", "degrees"),
    [("intel", 2984, (7.370, 14.349), (39.17, 53.79)), ("fr079", 1685, (6.504, 13.664), (30.29, 45.52))],
)
def test_raw_odometry_gives_the_published_figures(
    log: str, count: int, metres: tuple[float, float], degrees: tuple[float, float]
) -> None:
    scans = read_log(DATA / f"{log}.clf.gz").scans
    odometry = Trajectory(
        tuple(s.stamp_text for s in scans),
        np.array([s.stamp_s for s in scans]),
        np.array([s.robot_pose for s in scans]),
    )
    found = relation_error(odometry, read_relations(DATA / f"{log}.relations.gz"))
    assert (found.relations, found.not_evaluated) == (count, 0)
    assert (found.translation_m.mean, found.translation_m.std) == pytest.approx(metres, abs=6e-4)
    assert (found.rotation_deg.mean, found.rotation_deg.std) == pytest.approx(degrees, abs=6e-3)


@pytest.mark.data
@needs_data
def test_others_corrected_path_gives_the_published_figures() -> None:
    found = relation_error(read_trajectory(DATA / "intel.graph.txt.gz"), read_relations(DATA / "intel.relations.gz"))
    assert found.relations - found.not_evaluated == 301
    assert (found.translation_m.mean, found.translation_m.std) == pytest.approx((0.0287, 0.0192), abs=6e-5)
    assert (found.rotation_deg.mean, found.rotation_deg.std) == pytest.approx((0.388, 0.340), abs=6e-4)
