"""`umfeld extract planes` and what it writes."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mapping.planes.extract import PlaneRules, RangeNoise
from service.cloud_files import read_cloud
from service.commands.extract import app
from service.files import FileTrouble
from service.plane_files import planes_of_file, write_planes

DATA = os.environ.get("UMFELD_DATA", "")
needs_data = pytest.mark.skipif(not DATA, reason="UMFELD_DATA is not set")


@pytest.fixture
def corner(tmp_path: Path) -> Path:
    """A floor 0.5 m below and a wall 2 m ahead, with 3 mm of noise."""
    random = np.random.default_rng(1)
    u, v = random.uniform(-1.0, 1.0, (2, 6000))
    floor = np.column_stack((1.0 + u, v, np.full(6000, -0.5)))
    wall = np.column_stack((np.full(6000, 2.0), v, 0.5 + u))
    points = np.concatenate((floor, wall)) + random.normal(0.0, 0.003, (12000, 3))
    path = tmp_path / "corner.xyz"
    path.write_text("\n".join(f"{x:.5f} {y:.5f} {z:.5f}" for x, y, z in points))
    return path


def test_json_ply_and_png(corner: Path, tmp_path: Path) -> None:
    found = planes_of_file(corner)
    for name in ("a.json", "a.ply", "a.png"):
        assert write_planes(found, tmp_path / name).size > 1000
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["schema"] == "umfeld.planes.v1"
    assert len(document["planes"]) == 2
    for plane in document["planes"]:
        wall = plane["normal"][0] > 0.5
        np.testing.assert_allclose(plane["normal"], (1, 0, 0) if wall else (0, 0, -1), atol=0.005)
        assert plane["distance_m"] == pytest.approx(2.0 if wall else 0.5, abs=0.002)
        off = np.array(plane["polygon_m"]) @ plane["normal"] - plane["distance_m"]
        np.testing.assert_allclose(off, 0.0, atol=1e-3)
    again = read_cloud(tmp_path / "a.ply")
    assert again.label is not None
    assert np.unique(again.label).tolist() in ([0, 1], [-1, 0, 1])
    with pytest.raises(FileTrouble, match="unknown ending"):
        write_planes(found, tmp_path / "a.stl")


def test_the_command(corner: Path, tmp_path: Path) -> None:
    out = tmp_path / "planes.json"
    run = CliRunner().invoke(app, ["planes", str(corner), "--out", str(out), "--json", "--noise-m", "0.003"])
    assert run.exit_code == 0, run.output
    report = json.loads(run.stdout)
    assert report["planes"] == 2
    assert report["points"] == 12000
    assert report["files"][0]["bytes"] == out.stat().st_size
    printed = CliRunner().invoke(app, ["planes", str(corner), "--book"])
    assert len(json.loads(printed.stdout)["planes"]) == 2


def test_far_cells_are_warned_of(corner: Path, tmp_path: Path) -> None:
    run = CliRunner().invoke(
        app, ["planes", str(corner), "--book", "--out", str(tmp_path / "a.json"), "--beam-deg", "10"]
    )
    assert run.exit_code == 0
    assert "use larger cells or finer beams" in run.stderr


@pytest.mark.parametrize(
    "arguments", [["--json"], ["--cell-m", "0"], ["--min-points", "1"], ["--noise-m", "-1"], ["--png", "a.jpg"]]
)
def test_wrong_usage(corner: Path, arguments: list[str]) -> None:
    run = CliRunner().invoke(app, ["planes", str(corner), *arguments])
    assert run.exit_code != 0


@pytest.mark.data
@needs_data
def test_labelled_planes_are_matched() -> None:
    """Planes of a hundredth of the points and more share over 80 % with one of ours, both ways; tables do, too."""
    folder = Path(DATA) / "point_clouds"
    for name, least in (("synpeb_100x100", 10), ("table_learn13", 1), ("table_test16", 1)):
        found = planes_of_file(folder / f"{name}.pcd.gz")
        assert found.cloud.label is not None
        read = np.isfinite(found.cloud.points_m).all(axis=1)
        truth = np.where((found.cloud.label > 0) & (found.cloud.label < 20) | (least > 1), found.cloud.label, -1)[read]
        label = found.planes.label[read]
        matched = 0
        for number in np.unique(truth[truth >= 0]):
            mine = truth == number
            if mine.sum() < 0.01 * len(truth):
                continue
            shared = np.bincount(label[mine & (label >= 0)], minlength=len(found.planes))
            matched += bool(np.any((shared > 0.8 * mine.sum()) & (shared > 0.8 * found.planes.count)))
        assert matched >= least


@pytest.mark.data
@needs_data
@pytest.mark.parametrize(
    "rules", [PlaneRules.book(), PlaneRules(), PlaneRules(noise=RangeNoise(0.012))], ids=["book", "refined", "told"]
)
def test_the_corridor_is_2_40_m_high(rules: PlaneRules) -> None:
    """Its ceiling waves by 5 cm and is still one plane. Above 2.40 m at the scanner, by another's RANSAC."""
    found = planes_of_file(Path(DATA) / "point_clouds" / "rotating_sick_scan000.3d.gz", rules=rules).planes
    floor = np.flatnonzero(found.normal[:, 2] < -0.95)[0]
    ceiling = np.flatnonzero(found.normal[:, 2] > 0.95)[0]
    assert found.distance_m[floor] + found.distance_m[ceiling] == pytest.approx(2.40, abs=0.02)
