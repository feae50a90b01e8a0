"""`umfeld extract features`: a scan whose room is known, and logs that have none."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from service.commands.extract import app
from service.errors import WrongUsage
from service.feature_files import features_of_log, json_bytes, png_bytes


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A CARMEN log: a laser amid the front of a room 6 m wide and 4 m deep, then one that sees nothing."""
    bearing = np.radians(np.arange(-90.0, 90.0, 0.5))
    c, s = np.cos(bearing), np.sin(bearing)
    ranges = np.minimum(4.0 / np.maximum(c, 1e-9), 3.0 / np.maximum(np.abs(s), 1e-9))
    lines = []
    for k, row in enumerate((ranges, np.full(360, 81.9))):
        text = " ".join(f"{v:.4f}" for v in row)
        lines.append(f"FLASER 360 {text} {0.1 * k} 0 0 {0.1 * k} 0 0 {k}.5 host {k}.5")
    path = tmp_path / "room.log"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_room_is_told_as_it_is(log: Path) -> None:
    found = features_of_log(log)
    document = json.loads(json_bytes(found.document))
    corners = [(each["x_m"], each["y_m"]) for each in document["anchors"] if each["kind"] == "corner"]
    assert len(corners) == 2
    for truth in ((4.0, 3.0), (4.0, -3.0)):
        assert min(math.dist(truth, corner) for corner in corners) < 0.01
    assert document["orientation"]["angle_rad"] == pytest.approx(0.0, abs=0.01)
    assert document["orientation"]["y_walls_m"] == pytest.approx([-3.0, 3.0], abs=0.02)
    assert document["orientation"]["x_walls_m"] == pytest.approx([4.0], abs=0.02)
    # By arc length: 6 m at x = 4, twice 4 m with their middle at x = 2.
    assert document["centre_of_gravity_m"] == pytest.approx([(6 * 4 + 8 * 2) / 14, 0.0], abs=0.05)
    assert document["segments"] == 1
    assert document["box"] is None
    assert document["graph"]["longest_m"] == pytest.approx(6.0, abs=0.01)
    assert Image.open(io.BytesIO(png_bytes(found))).size[1] > 100


def test_the_command_writes_both_files(log: Path, tmp_path: Path) -> None:
    out, png = tmp_path / "f.json", tmp_path / "f.png"
    result = CliRunner().invoke(app, ["features", str(log), "--out", str(out), "--png", str(png)])
    assert result.exit_code == 0, result.output
    assert json.loads(out.read_text())["scan"] == 0
    assert png.stat().st_size > 500
    shown = CliRunner().invoke(app, ["features", str(log), "--scan", "-2"])
    assert json.loads(shown.output) == json.loads(out.read_text())


def test_a_scan_that_saw_nothing_has_no_features(log: Path) -> None:
    found = features_of_log(log, scan=1)
    assert found.document["points"] == 0
    assert found.document["anchors"] == []
    assert found.document["centre_of_gravity_m"] is None
    assert found.document["orientation"] is None
    json_bytes(found.document)
    png_bytes(found)


def test_what_cannot_be_done_is_said(log: Path, tmp_path: Path) -> None:
    with pytest.raises(WrongUsage, match="scans 0 to 1"):
        features_of_log(log, scan=2)
    with pytest.raises(WrongUsage):
        features_of_log(tmp_path / "none.log")
    assert isinstance(CliRunner().invoke(app, ["features", str(log), "--out", "x.txt"]).exception, WrongUsage)
