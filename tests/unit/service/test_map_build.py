"""A log becomes a map: a log written here of a room whose walls are known, and recorded ones."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from drivers.logs import Log, LogScan
from mapping.grids.occupancy import FREE, OCCUPIED
from mapping.grids.patch import GridPatch
from service.errors import WrongUsage
from service.export import load_pgm_yaml
from service.line_files import lines_of_geojson
from service.map_build import Built, HoldOut, PoseSource, build, judge, write

DATA = os.environ.get("UMFELD_DATA", "")
needs_data = pytest.mark.skipif(not DATA, reason="needs UMFELD_DATA")
HALF_M = 3.0
MAX_M = 81.83


def flaser(x: float, y: float, yaw: float, stamp: float) -> str:
    """A CARMEN line: 181 beams from the right to the left of a laser in a square room with a gap to the east."""
    ranges = []
    for k in range(181):
        angle = yaw + math.radians(k - 90.0)
        c, s = math.cos(angle), math.sin(angle)
        ways = [((math.copysign(HALF_M, d) - p) / d, axis) for axis, (p, d) in enumerate(((x, c), (y, s))) if d]
        reach, axis = min(ways)
        out = axis == 0 and c > 0 and abs(y + reach * s) < 0.5
        ranges.append(MAX_M if out else reach)
    beams = " ".join(f"{r:.3f}" for r in ranges)
    return f"FLASER 181 {beams} {x} {y} {yaw} {x} {y} {yaw} {stamp:.6f} host {stamp:.6f}\n"


@pytest.fixture
def room(tmp_path: Path) -> Path:
    path = tmp_path / "room.clf"
    way = [(-1.0 + 0.05 * k, 0.3 * math.sin(0.2 * k), 0.3 * k) for k in range(60)]
    path.write_text("# a log\n" + "".join(flaser(*pose, 100.0 + 0.2 * k) for k, pose in enumerate(way)))
    return path


def test_the_walls_are_where_they_are_and_every_file_is_written(room: Path, tmp_path: Path) -> None:
    built = build(room, poses=PoseSource.LOG, hold_out=10)
    report = write(built, tmp_path / "out", source=PoseSource.LOG)
    image = load_pgm_yaml(tmp_path / "out" / "map.yaml")
    rows, cols = np.nonzero(image.cells == 100)
    x, y = image.origin.x_m + (cols + 0.5) * 0.05, image.origin.y_m + (rows + 0.5) * 0.05
    off = np.abs(np.maximum(np.abs(x), np.abs(y)) - HALF_M)
    assert off.max() < 0.08  # a cell's half diagonal, and the millimetres of the log
    assert len(off) > 350  # four walls of 120 cells, less what the gap and the corners cost
    for name in ("trajectory.tum", "map.pgm", "map.yaml", "map.png", "map.umfeld", "report.json"):
        assert (tmp_path / "out" / name).stat().st_size > 0
    walls = lines_of_geojson((tmp_path / "out" / "lines.geojson").read_bytes())
    assert report["lines"] == len(walls) >= 5  # the gap parts the eastern one
    ends = np.concatenate((walls.start_m, walls.end_m))
    assert np.abs(np.abs(ends).max(axis=1) - HALF_M).max() < 0.02
    assert 4 * 2 * HALF_M - 1.6 < walls.length_m.sum() < 4 * 2 * HALF_M
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == json.loads(json.dumps(report))
    assert built.hold_out is not None
    assert built.hold_out.near_occupied > 0.99
    assert built.hold_out.crossing_early < 0.01
    assert report["inserted"] == 54


def test_walls_found_in_all_scans_free_no_cell(room: Path) -> None:
    crisp, counted = (build(room, poses=PoseSource.LOG, crisp=each).grid for each in (True, False))
    side = np.arange(-3.5, 3.5, 0.05) + 0.025
    points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    after, before = crisp.state_at(points), counted.state_at(points)
    assert np.all(before[after == FREE] == FREE)
    assert np.any((after == OCCUPIED) != (before == OCCUPIED))


def test_no_echo_frees_nothing_behind_the_gap(room: Path) -> None:
    built = build(room, poses=PoseSource.LOG)
    assert built.grid.state_at([[HALF_M + 1.0, 0.0]])[0] == -1


def test_the_trajectory_has_a_line_a_scan_in_the_form_of_tum(room: Path, tmp_path: Path) -> None:
    built = build(room, poses=PoseSource.ODOMETRY, every=2)
    write(built, tmp_path, source=PoseSource.ODOMETRY)
    rows = np.loadtxt(tmp_path / "trajectory.tum")
    assert rows.shape == (30, 8)
    assert np.allclose(rows[:, 0], 100.0 + 0.4 * np.arange(30))
    assert np.allclose(np.hypot(rows[:, 6], rows[:, 7]), 1.0)
    assert np.allclose(2.0 * np.arctan2(rows[3, 6], rows[3, 7]), 0.3 * 6)


def test_the_same_log_gives_the_same_files(room: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        write(build(room, poses=PoseSource.LOG), tmp_path / name, source=PoseSource.LOG)
    for name in ("trajectory.tum", "map.pgm", "map.yaml", "map.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.parametrize("content", ["", "no log at all\n", "PARAM robot_x 1 nohost 0\n", "\x00\x01\x02" * 50])
def test_what_is_no_log_is_said_so(content: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.clf"
    path.write_text(content)
    with pytest.raises(WrongUsage, match=r"bad\.clf"):
        build(path, poses=PoseSource.LOG)


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(WrongUsage, match="nowhere"):
        build(tmp_path / "nowhere.clf", poses=PoseSource.LOG)


def judged_beam(end: tuple[float, float], occupied: tuple[int, int]) -> HoldOut:
    """One beam along x from (0.01, 0.025), or to an end anywhere, against one occupied cell [row, col] of 5 cm."""
    cells = np.full((40, 80), 0, dtype=np.int8)
    cells[occupied] = 100
    range_m, bearing = math.hypot(end[0] - 0.01, end[1] - 0.025), math.atan2(end[1] - 0.025, end[0] - 0.01)
    scan = SimpleNamespace(range_m=np.array([range_m, np.inf]), bearing_rad=np.array([bearing, 0.0]))
    log = SimpleNamespace(robot_from_laser=(0.0, 0.0, 0.0))
    return judge(GridPatch(0.05, 0, 0, cells), cast(Log, log), [cast(LogScan, scan)], np.array([[0.01, 0.025, 0.0]]))


@pytest.mark.parametrize(
    ("end", "near", "middle"),
    [
        ((2.02, 1.03), True, True),  # in the cell [20, 40] itself
        ((1.901, 1.02), True, True),  # 9.9 cm before its border, two cells off
        ((1.899, 1.02), False, False),  # 10.1 cm, three cells off
        ((2.149, 1.01), True, True),
        ((2.12, 1.12), True, False),  # (7, 7) cm from its corner
        ((2.123, 1.123), False, False),  # (7.3, 7.3) cm
        ((2.06, 1.141), True, False),  # (1, 9.1) cm
    ],
)
def test_an_end_is_near_an_occupied_cell_by_the_distance_to_its_square(
    end: tuple[float, float], near: bool, middle: bool
) -> None:
    found = judged_beam(end, (20, 40))
    assert (found.end_points, found.near_occupied, found.near_middle) == (1, near, middle)


@pytest.mark.parametrize(("end_x", "early"), [(2.199, False), (2.201, True), (2.3, True), (1.9, False)])
def test_a_beam_crosses_early_where_it_is_in_an_occupied_cell_20_cm_before_its_end(end_x: float, early: bool) -> None:
    """The cell begins at 2.0 m."""
    assert judged_beam((end_x, 0.025), (0, 40)).crossing_early == early


def test_nothing_is_near_or_crosses_beside_the_grid() -> None:
    found = judged_beam((9.0, 0.025), (20, 40))
    assert (found.near_occupied, found.near_middle, found.crossing_early) == (0.0, 0.0, 0.0)


def recorded(name: str) -> Built:
    return build(Path(DATA) / "known_pose_logs" / f"{name}-corrected.log.gz", poses=PoseSource.LOG, hold_out=10)


@pytest.mark.data
@needs_data
@pytest.mark.parametrize(
    ("name", "near", "early"), [("belgioioso", 0.96, 0.02), ("seattle", 0.99, 0.017), ("acapulco", 0.85, 0.043)]
)
def test_scans_that_were_held_back_fit_a_grid_of_corrected_poses(name: str, near: float, early: float) -> None:
    """The poses of these logs scatter, acapulco's by up to 20 cm between two visits: docs/algorithms/grids.md."""
    judged = recorded(name).hold_out
    assert judged is not None
    assert judged.near_occupied >= near
    assert judged.crossing_early <= early


@pytest.mark.data
@needs_data
def test_corrected_poses_are_not_sold_as_odometry() -> None:
    path = Path(DATA) / "known_pose_logs" / "seattle-corrected.log.gz"
    with pytest.raises(WrongUsage, match="--poses log"):
        build(path, poses=PoseSource.ODOMETRY)
