"""A recorded log in a known map: written here of rooms whose walls are known, and Wean Hall's."""

from __future__ import annotations

import hashlib
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.grids.patch import GridPatch
from service.__main__ import main
from service.errors import WrongUsage
from service.export import MapImage, image_of, save_pgm_yaml
from service.localise_log import localise_log, report_of, rows_of, trajectory_text
from service.map_localiser import read_map

DATA = os.environ.get("UMFELD_DATA", "")
needs_data = pytest.mark.skipif(not DATA, reason="needs UMFELD_DATA")
WALLS = [
    (0.0, 0.0, 8.0, 0.0), (8.0, 0.0, 8.0, 5.0), (8.0, 5.0, 0.0, 5.0), (0.0, 5.0, 0.0, 0.0),
    (3.0, 0.0, 3.0, 2.0), (3.0, 3.4, 3.0, 5.0), (5.5, 5.0, 5.5, 3.6), (6.5, 0.0, 6.5, 1.2), (6.5, 1.2, 8.0, 1.2),
]  # fmt: skip


def plan(resolution_m: float = 0.05) -> MapImage:
    cells = np.zeros((round(5.0 / resolution_m) + 1, round(8.0 / resolution_m) + 1), dtype=np.int8)
    for x0, y0, x1, y1 in WALLS:
        at = np.linspace(0.0, 1.0, 2000)
        cells[
            ((y0 + at * (y1 - y0)) / resolution_m).astype(int), ((x0 + at * (x1 - x0)) / resolution_m).astype(int)
        ] = 100
    return image_of(GridPatch(resolution_m, 0, 0, cells))


def reach(x: float, y: float, angle: float) -> float:
    c, s = math.cos(angle), math.sin(angle)
    found = [80.0]
    for x0, y0, x1, y1 in WALLS:
        ex, ey = x1 - x0, y1 - y0
        cross = c * ey - s * ex
        if abs(cross) > 1e-12:
            t = ((x0 - x) * ey - (y0 - y) * ex) / cross
            u = ((x0 - x) * s - (y0 - y) * c) / cross
            if t > 0.0 and 0.0 <= u <= 1.0:
                found.append(t)
    return min(found)


def way() -> list[Pose2]:
    return [Pose2(1.0 + 0.06 * k, 2.7 + 0.2 * math.sin(0.1 * k), 0.15 * math.sin(0.2 * k)) for k in range(90)]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Odometry begins at its own zero, as robots' do."""
    path = tmp_path_factory.mktemp("log") / "rooms.clf"
    lines, start = [], way()[0]
    for k, pose in enumerate(way()):
        beams = " ".join(f"{reach(pose.x_m, pose.y_m, pose.yaw_rad + math.radians(b)):.3f}" for b in range(-90, 91))
        odom = start.inverse() @ pose
        at = f"{odom.x_m:.6f} {odom.y_m:.6f} {odom.yaw_rad:.6f}"
        lines.append(f"FLASER 181 {beams} {at} {at} {100.0 + 0.2 * k:.6f} host {0.2 * k:.6f}\n")
    path.write_text("".join(lines))
    return path


def errors(log: Path, map_path: Path, map_from_plan: Pose2 = IDENTITY) -> NDArray[np.float64]:
    run = localise_log(log, map_path)
    off = []
    for located, pose in list(zip(run.located, way()))[50:]:
        truth = map_from_plan @ pose
        assert located.map_from_base is not None
        off.append(math.hypot(located.map_from_base.x_m - truth.x_m, located.map_from_base.y_m - truth.y_m))
    return np.array(off)


def test_the_robot_is_found_in_the_map_and_the_map_is_as_it_was(log: Path, tmp_path: Path) -> None:
    save_pgm_yaml(plan(), tmp_path / "plan.yaml")
    files = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in tmp_path.iterdir()}
    assert errors(log, tmp_path / "plan.yaml").max() < 0.1
    assert {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in tmp_path.iterdir()} == files


def test_a_turned_origin_is_honoured(log: Path, tmp_path: Path) -> None:
    turned = Pose2(-7.0, 3.0, 0.6)
    image = plan()
    save_pgm_yaml(MapImage(image.cells, image.resolution_m, turned @ image.origin), tmp_path / "turned.yaml")
    assert errors(log, tmp_path / "turned.yaml", turned).max() < 0.15  # walls redrawn at a slant are rougher


def test_a_map_file_of_ours_is_read_too(log: Path, tmp_path: Path) -> None:
    save_pgm_yaml(plan(), tmp_path / "plan.yaml")
    with pytest.raises(SystemExit) as ended:
        main(["map", "import", str(tmp_path / "plan.yaml"), str(tmp_path / "plan.umfeld"), "--json"])
    assert ended.value.code == 0
    original = read_map(tmp_path / "plan.yaml")
    ours = read_map(tmp_path / "plan.umfeld")
    assert np.count_nonzero(ours.cells >= 65) == np.count_nonzero(original.cells >= 65)
    assert errors(log, tmp_path / "plan.umfeld").max() < 0.1


def test_the_command_reports_and_writes(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_pgm_yaml(plan(), tmp_path / "plan.yaml")
    json_path, png_path = tmp_path / "way.json", tmp_path / "way.png"
    files = ["--out", str(json_path), "--png", str(png_path)]
    with pytest.raises(SystemExit) as ended:
        main(["localise", str(log), "--map", str(tmp_path / "plan.yaml"), "--json", *files])
    assert ended.value.code == 0
    report = json.loads(capsys.readouterr().out)
    assert report["map"]["unchanged"] is True
    assert report["first_sure_s"] < 10.0
    document = json.loads(json_path.read_text())
    assert len(document["trajectory"]) == 90
    assert document["trajectory"][-1]["state"] == "sure"
    assert document["trajectory"][-1]["pose"]["x_m"] == pytest.approx(way()[-1].x_m, abs=0.1)
    assert png_path.stat().st_size > 500


def test_rows_and_trajectory_are_those_of_the_scans(log: Path, tmp_path: Path) -> None:
    save_pgm_yaml(plan(), tmp_path / "plan.yaml")
    run = localise_log(log, tmp_path / "plan.yaml", every=2)
    rows = rows_of(run)
    assert [row["stamp"] for row in rows] == [scan.stamp_text for scan in run.scans]
    sure = sum(row["state"] == "sure" for row in rows)
    assert len(trajectory_text(run).splitlines()) == sure > 20
    shares = report_of(run)["share_by_state"]
    assert isinstance(shares, dict)
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    "arguments",
    [["--map", "nothing.yaml"], ["--map", "plan.yaml", "--start", "1,2"], ["--map", "plan.yaml", "--out", "way.txt"]],
)
def test_wrong_usage_names_what_is_wrong(
    log: Path, tmp_path: Path, arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save_pgm_yaml(plan(), tmp_path / "plan.yaml")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["localise", str(log), *arguments])
    assert ended.value.code in (1, 2)
    assert capsys.readouterr().err.startswith("umfeld: ")


def test_a_map_without_walls_cannot_be_localised_in(log: Path, tmp_path: Path) -> None:
    save_pgm_yaml(image_of(GridPatch(0.05, 0, 0, np.zeros((20, 20), dtype=np.int8))), tmp_path / "empty.yaml")
    with pytest.raises(WrongUsage, match="walls"):
        localise_log(log, tmp_path / "empty.yaml")


@needs_data
@pytest.mark.data
def test_wean_hall_is_found_in_its_map() -> None:
    folder = Path(DATA) / "wean_localisation"
    run = localise_log(folder / "robotdata3.log.gz", folder / "wean5300.yaml")
    report = report_of(run)
    assert isinstance(first := report["first_sure_s"], float)
    assert first < 20.0
    end = run.located[-1].map_from_base
    assert end is not None
    assert math.hypot(end.x_m - 44.7, end.y_m - 13.95) < 0.3  # where the robot comes back to
