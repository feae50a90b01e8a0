"""Maps as files of other programs: read back by other means than ours, turned, on the earth, by the command."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

from mapping.frames import Pose2
from mapping.geo import Anchor
from mapping.grids.borders import occupied_borders
from mapping.grids.occupancy import OccupancyGrid
from mapping.lines.extract import extract_from_points
from mapping.lines.line_map import LineMap
from service.commands.map import app
from service.export import MapFileTrouble, MapImage
from service.line_files import lines_of_geojson
from service.line_maker import lines_fields
from service.map_export import LINES, borders_of, geotiff_bytes, lines_layer, lines_of_document, ply_bytes, save_map
from service.map_import import write_grid_map

TURNED = Pose2(3.0, -2.0, math.radians(30.0))


def image(origin: Pose2 = TURNED) -> MapImage:
    cells = np.full((4, 6), -1, dtype=np.int8)
    cells[1, 1:5] = 100
    cells[2, 2] = 20
    return MapImage(cells, 0.05, origin)


@given(arrays(np.bool_, st.tuples(st.integers(0, 7), st.integers(0, 7))))
def test_borders_are_the_edges_between_occupied_cells_and_others(occupied: NDArray[np.bool_]) -> None:
    expected = set()
    rows, columns = occupied.shape
    for r, c in zip(*np.nonzero(occupied)):
        beside = {(r - 1, c): ((c, r), (c + 1, r)), (r + 1, c): ((c + 1, r + 1), (c, r + 1)),
                  (r, c - 1): ((c, r + 1), (c, r)), (r, c + 1): ((c + 1, r), (c + 1, r + 1))}  # fmt: skip
        for (y, x), edge in beside.items():
            if not (0 <= y < rows and 0 <= x < columns and occupied[y, x]):
                expected.add(edge)
    found = []
    for x0, y0, x1, y1 in occupied_borders(occupied).astype(int):
        steps = max(abs(x1 - x0), abs(y1 - y0))
        dx, dy = np.sign(x1 - x0), np.sign(y1 - y0)
        found += [((x0 + k * dx, y0 + k * dy), (x0 + (k + 1) * dx, y0 + (k + 1) * dy)) for k in range(steps)]
    assert len(found) == len(set(found))
    assert set(found) == expected


def test_borders_of_no_grid() -> None:
    with pytest.raises(ValueError, match="rows and columns"):
        occupied_borders(np.zeros(3, dtype=np.bool_))


def test_a_turned_map_without_lines_gives_its_borders_in_the_map_frame() -> None:
    borders = borders_of(image())
    assert len(borders) == 4
    corners = TURNED.apply(np.array([[0.05, 0.05], [0.25, 0.05], [0.25, 0.10], [0.05, 0.10]]))
    ends = np.concatenate((borders.start_m, borders.end_m))
    for corner in corners:
        assert np.sum(np.hypot(*(ends - corner).T) < 1e-9) == 2
    assert borders.length_m.sum() == pytest.approx(0.5)


def test_points_are_the_middles_of_occupied_cells() -> None:
    head, _, body = ply_bytes(image()).partition(b"end_header\n")
    assert b"element vertex 4\n" in head
    points = np.frombuffer(body, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("occupancy", "u1")])
    middles = TURNED.apply(np.array([[0.075 + 0.05 * k, 0.075] for k in range(4)]))
    np.testing.assert_allclose(np.stack((points["x"], points["y"]), axis=-1), middles, atol=1e-6)
    assert set(points["occupancy"].tolist()) == {100}


def _place_of(tiff: Image.Image, column: float, line: float) -> NDArray[np.float64]:
    """Where a corner of a pixel lies, by the file's own transformation."""
    matrix = np.array(tiff.tag_v2[34264]).reshape(4, 4)  # type: ignore[attr-defined]
    return np.asarray((matrix @ (column, line, 0.0, 1.0))[:2])


def test_geotiff_in_the_map_frame() -> None:
    tiff = Image.open(io.BytesIO(geotiff_bytes(image())))
    values = np.asarray(tiff)
    assert values[2].tolist() == [255, 100, 100, 100, 100, 255]  # the uppermost line first
    assert values[1, 2] == 20
    np.testing.assert_allclose(_place_of(tiff, 0, 4), TURNED.apply(np.array([[0.0, 0.0]]))[0], atol=1e-9)
    np.testing.assert_allclose(_place_of(tiff, 5, 2), TURNED.apply(np.array([[0.25, 0.10]]))[0], atol=1e-9)


@pytest.mark.parametrize(
    ("latitude", "longitude", "epsg"), [(49.42, 7.75, 32632), (-33.9, 151.2, 32756), (60, 4, 32631)]
)
def test_geotiff_on_the_earth(latitude: float, longitude: float, epsg: int) -> None:
    pyproj = pytest.importorskip("pyproj")
    anchor = Anchor(latitude, longitude, yaw_rad=0.3)
    tiff = Image.open(io.BytesIO(geotiff_bytes(image(), anchor)))
    assert epsg in tiff.tag_v2[34735]  # type: ignore[attr-defined]
    expected = anchor.geodetic_from_map(TURNED.apply(np.array([[0.25, 0.10]])))[0]
    zone = pyproj.Proj(f"EPSG:{epsg}")
    np.testing.assert_allclose(_place_of(tiff, 5, 2), zone(expected[1], expected[0]), atol=1e-4)


def wall() -> LineMap:
    points = np.stack((np.linspace(2.0, -2.0, 40), np.full(40, 3.0)), axis=-1)[::-1]
    line_map = LineMap()
    for x_m in (0.0, 0.3):
        line_map.insert(extract_from_points(points - (x_m, 0.0), spacing_rad=0.05), Pose2(x_m, 0.0, 0.0))
    return line_map


def test_the_command_writes_lines_where_there_are_some_and_borders_otherwise(tmp_path: Path) -> None:
    grid = OccupancyGrid(resolution_m=0.05)
    grid.insert_cells([(10, column) for column in range(8)], [(5, 5)])
    grid.insert_cells([(10, column) for column in range(8)], [(5, 5)])
    write_grid_map(grid, tmp_path / "with.umfeld", source="test", layers={LINES: lines_layer(wall())})
    write_grid_map(grid, tmp_path / "without.umfeld", source="test")
    for name, count, length_m in (("with", 1, 4.0), ("without", 4, 0.9)):
        out = tmp_path / f"{name}.geojson"
        ran = CliRunner().invoke(app, ["export", str(out), "--store", str(tmp_path / f"{name}.umfeld"), "--json"])
        assert ran.exit_code == 0, ran.output
        assert json.loads(ran.output)["files"][0]["path"] == str(out)
        lines = lines_of_geojson(out.read_bytes())
        assert len(lines) == count
        assert lines.length_m.sum() == pytest.approx(length_m, abs=0.01)


def test_a_document_of_lines_is_read_back() -> None:
    lines = wall().lines()
    again = lines_of_document(json.loads(json.dumps(lines_fields(lines, version=1))))
    assert again is not None
    np.testing.assert_allclose(again.start_m, lines.start_m, atol=1e-4)
    np.testing.assert_allclose(again.end_m, lines.end_m, atol=1e-4)
    assert again.seen.tolist() == lines.seen.tolist()
    assert lines_of_document({"lines": []}) is None


def test_every_ending_gives_a_file_and_another_one_is_named(tmp_path: Path) -> None:
    for ending in (".yaml", ".png", ".npy", ".json", ".tif", ".ply", ".geojson", ".svg"):
        (receipt, *_) = save_map(image(Pose2()), None, tmp_path / f"map{ending}")
        assert receipt.path.stat().st_size > 0
    with pytest.raises(MapFileTrouble, match=r"unknown ending '.xyz'.*\.tif"):
        save_map(image(), None, tmp_path / "map.xyz")


@pytest.mark.parametrize("text", ["49", "a,b", "95,7", "1,2,3,4,x"])
def test_an_anchor_that_is_none(text: str, tmp_path: Path) -> None:
    ran = CliRunner().invoke(app, ["export", str(tmp_path / "m.tif"), "--store", "x.umfeld", "--anchor", text])
    assert ran.exit_code != 0
    assert "--anchor" in str(ran.exception)


def test_a_map_carries_its_anchor_into_exports(tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    save_map(image(Pose2()), None, tmp_path / "floor.yaml")
    floor, source = str(tmp_path / "floor.umfeld"), str(tmp_path / "floor.yaml")
    made = CliRunner().invoke(app, ["import", source, floor, "--anchor", "49.42,7.75,30"])
    assert made.exit_code == 0, made.output

    def corner(*options: str) -> list[float]:
        out = tmp_path / "out.geojson"
        ran = CliRunner().invoke(app, ["export", str(out), "--store", floor, *options])
        assert ran.exit_code == 0, ran.output
        found: list[float] = json.loads(out.read_bytes())["features"][0]["geometry"]["coordinates"][0]
        return found

    assert corner() == pytest.approx([7.75, 49.42], abs=1e-5)
    assert corner("--anchor", "-33.9,151.2") == pytest.approx([151.2, -33.9], abs=1e-5)
    assert max(map(abs, corner("--anchor", "none"))) < 1.0
