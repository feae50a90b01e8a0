"""`umfeld extract regions`: plans in, GeoJSON and pictures out."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from PIL import Image
from typer.testing import CliRunner

from service.commands.extract import app
from service.files import FileTrouble
from service.region_files import free_space_of, geojson_bytes, png_bytes, regions_of_file, write_regions

RUN = CliRunner()


def ring(x0: float, y0: float, x1: float, y1: float) -> list[list[float]]:
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]


def feature(kind: str, *rings: list[list[float]]) -> dict[str, Any]:
    return {
        "type": "Feature",
        "geometry": {"type": "Polygon", "coordinates": list(rings)},
        "properties": {"kind": kind},
    }


PLAN = {
    "type": "FeatureCollection",
    "features": [
        feature("room", ring(0, 0, 4, 4), ring(1, 1, 2, 2)),
        feature("room", ring(5, 0, 9, 4)),
        feature("room", ring(4, 1.5, 5, 2.4)),
        feature("obstacle", ring(7, 3, 9, 5)),
    ],
}


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    path = tmp_path / "plan.geojson"
    path.write_text(json.dumps(PLAN))
    return path


def test_plan_comes_out_as_regions_and_passages(plan: Path) -> None:
    found = regions_of_file(plan, simplify_m=0.0, door_m=0.95)
    assert found.free.area == pytest.approx(16 - 1 + 16 + 0.9 - 2)
    assert found.rooms.number_of_nodes() == 3
    document = json.loads(geojson_bytes(found))
    kinds = [entry["properties"]["kind"] for entry in document["features"]]
    assert kinds.count("region") == found.report["regions"]
    assert kinds.count("passage") == found.report["passages"]
    area = sum(
        shapely.geometry.shape(f["geometry"]).area for f in document["features"] if f["geometry"]["type"] == "Polygon"
    )
    assert area == pytest.approx(found.free.area, abs=1e-3)
    doors = [f for f in document["features"] if len(set(f["properties"].get("rooms", [0]))) == 2]
    assert [f["properties"]["width_m"] for f in doors] == pytest.approx([0.9, 0.9])


def test_what_was_written_is_a_plan_again(plan: Path, tmp_path: Path) -> None:
    found = regions_of_file(plan, simplify_m=0.0, door_m=1.3)
    again = {
        "type": "FeatureCollection",
        "features": [f for f in json.loads(geojson_bytes(found))["features"] if f["geometry"]["type"] == "Polygon"],
    }
    assert free_space_of(json.dumps(again).encode()).area == pytest.approx(found.free.area, abs=1e-3)


def test_picture_shows_rooms_in_their_colours(plan: Path) -> None:
    image = Image.open(io.BytesIO(png_bytes(regions_of_file(plan, simplify_m=0.0, door_m=0.95), longest_px=500)))
    assert max(image.size) == 500
    colours = image.convert("RGB").getcolors(100_000)
    assert colours is not None
    shares = {colour: count / (image.width * image.height) for count, colour in colours}
    assert shares[(166, 206, 227)] > 0.1  # two rooms
    assert shares[(178, 223, 138)] > 0.1
    assert (200, 30, 30) in shares  # doors


def test_line_map_is_a_plan(tmp_path: Path) -> None:
    from mapping.lines.line_map import rows_of_ends
    from mapping.lines.lines import Lines
    from service.line_files import geojson_bytes as lines_bytes

    corners = np.array([(0.0, 0.0), (0.0, 3.0), (6.0, 3.0), (6.0, 0.0)])  # clockwise: a room
    block = np.array([(2.0, 1.0), (3.0, 1.0), (3.0, 2.0), (2.0, 2.0)])  # counter-clockwise: an obstacle
    start = np.concatenate((corners, block))
    end = np.concatenate((np.roll(corners, -1, axis=0), np.roll(block, -1, axis=0)))
    ones = np.ones(len(start))
    lines = Lines(rows_of_ends(start, end, 50 * ones, 3 * ones, 0.005 * ones), np.full((len(start), 2), -1))
    path = tmp_path / "walls.geojson"
    path.write_bytes(lines_bytes(lines))
    found = regions_of_file(path, simplify_m=0.0, door_m=0.0)
    assert found.free.area == pytest.approx(17.0, abs=0.01)
    assert found.report["regions"] == 4


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("{", "not GeoJSON"),
        ("[1]", "not GeoJSON"),
        ('{"type": "Point", "coordinates": [0, 0]}', "a Point is no part"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1]]]}', "pairs of numbers"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 1]]]}', "at least 3"),
        ('{"type": "FeatureCollection", "features": []}', "no polygon"),
        (json.dumps(feature("obstacle", ring(0, 0, 1, 1))), "no polygon"),
    ],
)
def test_what_is_no_plan_says_why(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "plan.geojson"
    path.write_text(text)
    with pytest.raises(FileTrouble, match=why):
        regions_of_file(path, simplify_m=0.0, door_m=1.0)


def test_files_that_are_not_there_or_have_a_wrong_ending(plan: Path, tmp_path: Path) -> None:
    with pytest.raises(FileTrouble, match="No such file"):
        regions_of_file(tmp_path / "none.geojson", simplify_m=0.0, door_m=1.0)
    with pytest.raises(FileTrouble, match="unknown ending"):
        write_regions(regions_of_file(plan, simplify_m=0.0, door_m=1.0), tmp_path / "x.dxf")


def test_command(plan: Path, tmp_path: Path) -> None:
    out, png = tmp_path / "r.geojson", tmp_path / "r.png"
    told = RUN.invoke(app, ["regions", str(plan), "--out", str(out), "--png", str(png), "--json", "--door-m", "0.95"])
    assert told.exit_code == 0, told.output
    report = json.loads(told.stdout)
    assert (report["rooms"], report["doors"]) == (3, 2)
    assert [Path(f["path"]).name for f in report["files"]] == ["r.geojson", "r.png"]
    printed = RUN.invoke(app, ["regions", str(plan)])
    assert json.loads(printed.stdout)["type"] == "FeatureCollection"
    assert RUN.invoke(app, ["regions", str(plan), "--json"]).exit_code != 0
