"""Lines as files, read back by others' readers, and `umfeld extract lines` from the outside."""

from __future__ import annotations

import io
import json
import math
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import shapely
from PIL import Image

from mapping.geo import Anchor
from mapping.lines.line_map import rows_of_ends
from mapping.lines.lines import Lines, no_lines
from service.__main__ import main
from service.errors import Trouble
from service.line_files import dxf_bytes, geojson_bytes, lines_of_geojson, png_bytes, svg_bytes, write_lines

DATA = os.environ.get("UMFELD_DATA", "")


@pytest.fixture
def walls() -> Lines:
    ends = np.array([[0.0, 0.0, 4.0, 0.0], [4.0, 0.0, 4.0, -3.00004], [-1e-9, 2.0, 0.0, 0.5]])
    n = np.array([50.0, 60.0, 7.0])
    rows = rows_of_ends(ends[:, :2], ends[:, 2:], n, np.array([3.0, 4.0, 1.0]), np.full(3, 0.012))
    return Lines(rows, np.full((3, 2), -1, dtype=np.int64))


def test_geojson_is_what_shapely_reads(walls: Lines) -> None:
    data = geojson_bytes(walls)
    shapes = shapely.get_parts(shapely.from_geojson(data.decode()))
    np.testing.assert_allclose(np.asarray(shapely.length(shapes), dtype=np.float64), walls.length_m, atol=2e-4)
    document = json.loads(data)
    assert (document["frame"], document["unit"]) == ("map", "m")
    first = document["features"][0]["properties"]
    assert (first["points"], first["scans"], first["length_m"]) == (50, 3, 4.0)
    assert first["angle_rad"] == pytest.approx(math.pi / 2) or first["distance_m"] == 0.0
    assert b"-0.0," not in data
    assert b"NaN" not in data


def test_geojson_comes_back(walls: Lines) -> None:
    again = lines_of_geojson(geojson_bytes(walls))
    np.testing.assert_allclose(again.rows[:, :4], walls.rows[:, :4], atol=5.1e-5)
    np.testing.assert_array_equal(again.count, walls.count)
    np.testing.assert_array_equal(again.seen, walls.seen)
    np.testing.assert_allclose(again.rms_m, walls.rms_m, atol=1e-5)
    assert len(lines_of_geojson(geojson_bytes(no_lines()))) == 0


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"{}",
        b'{"unit": "m", "features": [{}]}',
        b'{"unit": "m", "features": 3}',
        b'{"unit": "m", "features": [{"geometry": {"coordinates": [[0, 0], [1, NaN]]}, '
        b'"properties": {"points": 1, "scans": 1, "rms_m": 0}}]}',
        b"\xff\xfe",
    ],
)
def test_what_is_no_line_map_is_refused(data: bytes) -> None:
    with pytest.raises(Trouble, match="line map"):
        lines_of_geojson(data)


def test_anchored_geojson_is_longitude_and_latitude(walls: Lines) -> None:
    """4 m east at 49.45 degrees north are 4 / (6,391 km cos 49.45) degrees; WGS 84's radius there, to 1 per mille."""
    document = json.loads(geojson_bytes(walls, anchor=Anchor(49.45, 7.75)))
    assert "unit" not in document
    (lon0, lat0), (lon1, lat1) = document["features"][0]["geometry"]["coordinates"]
    assert (lon0, lat0) == pytest.approx((7.75, 49.45))
    assert lat1 == pytest.approx(lat0, abs=1e-8)
    prime_vertical_m = 6378137.0 / math.sqrt(1.0 - 0.00669438 * math.sin(math.radians(49.45)) ** 2)
    east_deg = math.degrees(4.0 / (prime_vertical_m * math.cos(math.radians(49.45))))
    assert lon1 - lon0 == pytest.approx(east_deg, rel=1e-3)


def test_svg_is_in_metres_and_upright(walls: Lines) -> None:
    root = ElementTree.fromstring(svg_bytes(walls))
    x, y, width, height = map(float, root.attrib["viewBox"].split())
    strokes = list(root.iter("{http://www.w3.org/2000/svg}line"))
    assert len(strokes) == 3
    for stroke in strokes:
        for k in "12":
            assert x <= float(stroke.attrib[f"x{k}"]) <= x + width
            assert y <= -float(stroke.attrib[f"y{k}"]) <= y + height  # the group turns y up
    assert "scale(1,-1)" in svg_bytes(walls).decode()


def test_dxf_is_what_ezdxf_reads(walls: Lines) -> None:
    ezdxf = pytest.importorskip("ezdxf")
    drawing = ezdxf.read(io.StringIO(dxf_bytes(walls).decode()))
    assert not drawing.audit().has_errors
    entities = list(drawing.modelspace().query("LINE"))
    assert drawing.units == 6  # metres
    np.testing.assert_allclose([list(e.dxf.start)[:2] for e in entities], walls.start_m, atol=1e-4)
    np.testing.assert_allclose([list(e.dxf.end)[:2] for e in entities], walls.end_m, atol=1e-4)


def test_picture_has_its_walls_where_they_are(walls: Lines) -> None:
    image = np.asarray(Image.open(io.BytesIO(png_bytes(walls, longest_px=600))))
    scale = 600 / 6.00004  # 3.00004 + 2 + twice 0.5 m high
    column, row = round((2.0 + 0.5) * scale), round((2.0 + 0.5) * scale)
    assert image[row - 2 : row + 3, column].min() < 100
    assert image[row - 40, column] == 255
    assert np.asarray(Image.open(io.BytesIO(png_bytes(no_lines())))).shape == (1200, 1200)


def test_unknown_endings_name_the_known(tmp_path: Path, walls: Lines) -> None:
    with pytest.raises(Trouble, match=r"\.geojson, \.json, \.svg, \.dxf, \.png"):
        write_lines(walls, tmp_path / "walls.shp")
    assert list(tmp_path.iterdir()) == []


def carmen_log(path: Path) -> Path:
    """A robot that creeps along a corridor of 3 m, 181 beams, in CARMEN's words."""
    bearing = np.radians(np.arange(-90.0, 91.0))
    words = []
    for k in range(12):
        with np.errstate(divide="ignore"):
            side = np.where(np.sin(bearing) > 0.0, 1.0, 2.0) / np.maximum(np.abs(np.sin(bearing)), 1e-9)
        ranges = np.minimum(side, (9.0 - 0.1 * k) / np.maximum(np.cos(bearing), 1e-9))
        text = " ".join(f"{r:.3f}" for r in ranges)
        words.append(f"FLASER 181 {text} {0.1 * k:.2f} 0 0 {0.1 * k:.2f} 0 0 {k}.0 host {k}.0")
    path.write_text("\n".join(words) + "\n")
    return path


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(["extract", "lines", *arguments])
    return int(end.value.code or 0)


def test_a_log_becomes_walls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = carmen_log(tmp_path / "corridor.log")
    out, png = tmp_path / "walls.geojson", tmp_path / "walls.png"
    assert run(str(log), "--out", str(out), "--png", str(png), "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["scans"] == 12
    assert report["lines"] == 3
    assert [Path(file["path"]).name for file in report["files"]] == ["walls.geojson", "walls.png"]
    lines = lines_of_geojson(out.read_bytes())
    distances = sorted(f["properties"]["distance_m"] for f in json.loads(out.read_bytes())["features"])
    assert distances == pytest.approx([1.0, 2.0, 9.0], abs=0.01)
    assert lines.seen.max() == 12


def test_one_scan_is_printed_in_the_lasers_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = carmen_log(tmp_path / "corridor.log")
    assert run(str(log), "--scan", "-1") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["frame"] == "laser"
    assert sorted(f["properties"]["distance_m"] for f in document["features"])[-1] == pytest.approx(7.9, abs=0.01)


def test_mistakes_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = carmen_log(tmp_path / "corridor.log")
    for arguments, said in (
        ([str(log), "--scan", "12"], "scans 0 to 11"),
        ([str(tmp_path / "no.log")], "no.log"),
        ([str(log), "--json"], "--out"),
        ([str(log), "--png", str(tmp_path / "a.jpg")], ".png"),
    ):
        assert run(*arguments) == 2
        assert said in capsys.readouterr().err
    assert run(str(log), "--out", str(tmp_path / "walls.xyz")) == 1
    assert ".geojson" in capsys.readouterr().err


def test_help_is_light() -> None:
    code = "import sys, service.commands.extract; print({'numba', 'scipy', 'shapely', 'PIL'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"


@pytest.mark.data
@pytest.mark.skipif(not DATA, reason="needs UMFELD_DATA")
@pytest.mark.parametrize("name", ["seattle", "belgioioso", "acapulco"])
def test_recorded_logs_are_50_times_smaller(name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    log = Path(DATA) / "known_pose_logs" / f"{name}-corrected.log.gz"
    assert run(str(log), "--out", str(tmp_path / "walls.geojson"), "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["times_smaller"] >= 50.0
    assert report["poses"] == "corrected"
