"""Map files: the map server's pair in every mode, turned origins, odd shapes, files of other programs, safe writing."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from typer.testing import CliRunner

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from service import export
from service.commands.map import app
from service.export import MapFileTrouble, MapImage, image_of, load_pgm_yaml, patch_of, save_grid
from service.files import FileTrouble, write_whole

DATA = Path(os.environ.get("UMFELD_DATA", "/nonexistent")) / "grid_maps"


def random_cells(rows: int, columns: int, seed: int = 0) -> export.I8:
    return np.random.default_rng(seed).choice(np.array([-1, 0, 100], np.int8), (rows, columns))


def write_pair(folder: Path, pixels: Any, text: str, name: str = "map.pgm") -> Path:
    Image.fromarray(np.asarray(pixels, np.uint8)).save(folder / name)
    path = folder / "map.yaml"
    path.write_text(text)
    return path


HEAD = (
    "image: map.pgm\nresolution: 0.05\norigin: [0.0, 0.0, 0.0]\noccupied_thresh: 0.65\nfree_thresh: 0.196\nnegate: 0\n"
)


@settings(max_examples=40)
@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.floats(0.001, 5),
    st.floats(-1e4, 1e4),
    st.floats(-1e4, 1e4),
    st.floats(-math.pi, math.pi),
)
def test_pair_round_trip(
    tmp_path_factory: pytest.TempPathFactory, rows: int, columns: int, resolution: float, x: float, y: float, yaw: float
) -> None:
    image = MapImage(random_cells(rows, columns, rows * 41 + columns), resolution, Pose2(x, y, yaw))
    path = tmp_path_factory.mktemp("pair") / "odd name-1.yaml"
    export.save_pgm_yaml(image, path)
    again = load_pgm_yaml(path)
    np.testing.assert_array_equal(again.cells, image.cells)
    assert (again.resolution_m, again.origin) == (resolution, Pose2(x, y, yaw))


def test_pixels_are_the_usual_ones_with_y_upwards() -> None:
    cells = np.array([[-1, 0, 19], [20, 64, 65], [100, 100, 0]], np.int8)
    assert export.pixels_of(cells).tolist() == [[0, 0, 254], [205, 205, 0], [205, 254, 254]]
    assert export.pgm_bytes(cells) == b"P5\n3 3\n255\n" + bytes([0, 0, 254, 205, 205, 0, 205, 254, 254])
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(export.png_bytes(cells)))), export.pixels_of(cells))


def test_trinary_thresholds(tmp_path: Path) -> None:
    pixels = [[0, 88, 90, 204], [206, 254, 255, 128]]
    image = load_pgm_yaml(write_pair(tmp_path, pixels, HEAD))
    assert image.cells.tolist() == [[0, 0, 0, -1], [100, 100, -1, -1]]


def test_grey_205_stays_unknown_whatever_the_threshold_says(tmp_path: Path) -> None:
    text = HEAD.replace("free_thresh: 0.196", "free_thresh: 0.25")
    assert load_pgm_yaml(write_pair(tmp_path, [[205, 206, 200]], text)).cells.tolist() == [[-1, 0, 0]]


def test_negated_scale_and_raw(tmp_path: Path) -> None:
    pixels = [[0, 100, 127, 255]]
    negated = load_pgm_yaml(write_pair(tmp_path, pixels, HEAD.replace("negate: 0", "negate: 1")))
    assert negated.cells.tolist() == [[0, -1, -1, 100]]
    scale = load_pgm_yaml(write_pair(tmp_path, pixels, HEAD + "mode: scale\n")).cells[0]
    assert (scale[0], scale[3]) == (100, 0)
    assert 0 < scale[2] < scale[1] < 100
    raw = load_pgm_yaml(write_pair(tmp_path, [[0, 55, 100, 101, 255]], HEAD + "mode: raw\n"))
    assert raw.cells.tolist() == [[0, 55, 100, -1, -1]]


def test_transparent_pixels_are_unknown(tmp_path: Path) -> None:
    pixels = np.array([[[255, 255, 255, 255], [255, 255, 255, 0], [0, 0, 0, 255]]], np.uint8)
    text = HEAD.replace("map.pgm", "map.png")
    assert load_pgm_yaml(write_pair(tmp_path, pixels, text, "map.png")).cells.tolist() == [[0, -1, 100]]


def test_pgm_of_other_programs(tmp_path: Path) -> None:
    """Comments in the header, text form, and 16 bits are all within the format."""
    (tmp_path / "map.yaml").write_text(HEAD)
    expected = [[100, 0, -1]]
    for raw in (
        b"P5\n# CREATOR: somebody 0.050 m/pix\n3 1\n255\n" + bytes([0, 254, 205]),
        b"P2\n3 1\n255\n0 254 205\n",
        b"P5\n3 1\n65535\n" + bytes([0, 0, 255, 255, 0x80, 0]),
    ):
        (tmp_path / "map.pgm").write_bytes(raw)
        assert load_pgm_yaml(tmp_path / "map.yaml").cells.tolist() == expected


@pytest.mark.parametrize(
    "text",
    [
        "image: map.pgm\nresolution: 0.1\norigin:\n- -1.5\n- 2.0\n- 0.5\nnegate: 0\nfree_thresh: 0.2\n",
        "---\nimage: 'map.pgm'   # the picture\nresolution: 1e-1\norigin: [ -1.5, 2, 0.5 ]  # pose\nnegate: false\n",
        'image: "map.pgm"\r\nresolution: 0.1\r\norigin: [-1.5, 2.0, 0.5]\r\n',
        "\ufeffimage: map.pgm\nresolution: 0.1\norigin:\n  - -1.5\n  - 2.0\n  - 0.5\nmode: Trinary\n",
    ],
)
def test_sidecars_as_others_write_them(tmp_path: Path, text: str) -> None:
    image = load_pgm_yaml(write_pair(tmp_path, [[0]], text))
    assert (image.resolution_m, image.origin) == (0.1, Pose2(-1.5, 2.0, 0.5))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "no `image"),
        ("image: map.pgm\n", "no `resolution`"),
        (HEAD.replace("0.05", "0"), "resolution"),
        (HEAD.replace("0.05", "nan"), "resolution"),
        (HEAD.replace("0.05", "five"), "resolution 'five' is not a number"),
        (HEAD.replace("[0.0, 0.0, 0.0]", "[0.0]"), "origin"),
        (HEAD.replace("[0.0, 0.0, 0.0]", "[0, inf, 0]"), "origin"),
        (HEAD.replace("free_thresh: 0.196", "free_thresh: 0.9"), "free_thresh < occupied_thresh"),
        (HEAD + "mode: colourful\n", "trinary, scale, raw"),
        (HEAD.replace("map.pgm", "absent.pgm"), "absent.pgm"),
        (HEAD.replace("map.pgm", "map.yaml"), "not a picture"),
    ],
)
def test_faults_are_named(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(MapFileTrouble, match=complaint):
        load_pgm_yaml(write_pair(tmp_path, [[0]], text))


@given(st.binary(max_size=200))
def test_any_sidecar_is_refused_or_read(tmp_path_factory: pytest.TempPathFactory, raw: bytes) -> None:
    path = tmp_path_factory.mktemp("noise") / "map.yaml"
    path.write_bytes(raw)
    with pytest.raises(MapFileTrouble):
        load_pgm_yaml(path)


def test_a_cut_picture_is_refused(tmp_path: Path) -> None:
    path = write_pair(tmp_path, np.zeros((50, 50)), HEAD)
    (tmp_path / "map.pgm").write_bytes((tmp_path / "map.pgm").read_bytes()[:-100])
    with pytest.raises(MapFileTrouble):
        load_pgm_yaml(path)


def test_a_patch_on_our_lattice_is_the_image_itself() -> None:
    patch = GridPatch(0.05, -7, 3, random_cells(4, 9))
    again = patch_of(image_of(patch))
    assert (again.row0, again.col0, again.resolution_m) == (-7, 3, 0.05)
    np.testing.assert_array_equal(again.cells, patch.cells)


def test_an_origin_between_cells_moves_by_half_a_cell_at_most_and_keeps_the_shape() -> None:
    cells = random_cells(5, 6)
    patch = patch_of(MapImage(cells, 0.05, Pose2(-8.325, 0.06, 0.0)))
    np.testing.assert_array_equal(patch.cells, cells)
    assert abs(patch.col0 * 0.05 + 8.325) <= 0.025 + 1e-9
    assert abs(patch.row0 * 0.05 - 0.06) <= 0.025 + 1e-9


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_quarter_turns_are_exact(quarters: int) -> None:
    cells = random_cells(3, 5)
    yaw = quarters * math.pi / 2
    patch = patch_of(MapImage(cells, 0.1, Pose2(0.0, 0.0, yaw)))
    turned = np.rot90(cells[::-1], quarters)[::-1]  # rot90 turns pictures, whose first line is uppermost
    np.testing.assert_array_equal(patch.cells, turned)


@settings(max_examples=60)
@given(
    st.floats(-math.pi, math.pi),
    st.floats(-3, 3),
    st.floats(-3, 3),
    st.integers(1, 25),
    st.integers(1, 25),
    st.sampled_from([None, 0.05, 0.13, 0.4]),
    st.integers(0, 99),
)
def test_turning_loses_no_wall_and_invents_no_free_space(
    yaw: float, x: float, y: float, rows: int, columns: int, resolution: float | None, seed: int
) -> None:
    image = MapImage(random_cells(rows, columns, seed), 0.1, Pose2(x, y, yaw))
    patch = patch_of(image, resolution)
    r = patch.resolution_m
    for row, column in np.argwhere(image.cells == 100):
        px, py = image.origin.apply(np.array([column + 0.5, row + 0.5]) * 0.1)
        at = math.floor(py / r) - patch.row0, math.floor(px / r) - patch.col0
        near = patch.cells[max(0, at[0] - 1) : at[0] + 2, max(0, at[1] - 1) : at[1] + 2]
        assert (near == 100).any()
    for row, column in np.argwhere(patch.cells == 0):
        centre = np.array([patch.col0 + column + 0.5, patch.row0 + row + 0.5]) * r
        ix, iy = image.origin.inverse().apply(centre) / 0.1
        reach = 0.5  # an unturned image may move by half a cell
        near = image.cells[
            max(0, math.floor(iy - reach)) : math.floor(iy + reach) + 1,
            max(0, math.floor(ix - reach)) : math.floor(ix + reach) + 1,
        ]
        assert (near == 0).any()


def test_too_large_a_turn_is_refused() -> None:
    image = MapImage(np.zeros((3000, 3000), np.int8), 10.0, Pose2(0, 0, 0.5))
    with pytest.raises(MapFileTrouble, match="too many"):
        patch_of(image, 0.001)


@pytest.mark.parametrize("ending", [".png", ".npy", ".json", ".yaml", ".pgm"])
def test_receipts_are_true(tmp_path: Path, ending: str) -> None:
    receipts = save_grid(image_of(GridPatch(0.1, 1, 2, random_cells(3, 4))), tmp_path / f"m{ending}")
    assert len(receipts) == (2 if ending in (".yaml", ".pgm") else 1)
    for receipt in receipts:
        raw = receipt.path.read_bytes()
        assert receipt.size == len(raw)
        assert receipt.sha256 == hashlib.sha256(raw).hexdigest()
        assert receipt.saved_at.endswith("+00:00")
    assert {path.name for path in tmp_path.iterdir()} == {receipt.path.name for receipt in receipts}


def test_json_and_npy_hold_the_cells(tmp_path: Path) -> None:
    patch = GridPatch(0.1, 1, -2, random_cells(3, 4))
    save_grid(image_of(patch), tmp_path / "m.json")
    document = json.loads((tmp_path / "m.json").read_text())
    assert document["cells"] == patch.cells.tolist()
    assert document["origin"] == {"x_m": -0.2, "y_m": 0.1, "yaw_rad": 0.0}
    save_grid(image_of(patch), tmp_path / "m.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "m.npy"), patch.cells)


def test_unknown_endings_and_empty_maps_are_named(tmp_path: Path) -> None:
    with pytest.raises(MapFileTrouble, match=r"\.yaml"):
        save_grid(image_of(GridPatch(0.1, 0, 0, random_cells(2, 2))), tmp_path / "m.bmp")
    with pytest.raises(MapFileTrouble, match="empty"):
        export.png_bytes(np.zeros((0, 0), np.int8))


def test_write_whole_replaces_or_leaves(tmp_path: Path) -> None:
    path = tmp_path / "f"
    assert write_whole(path, b"one").size == 3
    assert write_whole(path, b"two!").sha256 == hashlib.sha256(b"two!").hexdigest()
    with pytest.raises(FileTrouble, match="make the folder"):
        write_whole(tmp_path / "absent" / "f", b"x")
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(FileTrouble, match="cannot be written"):
        write_whole(folder, b"x")
    assert {p.name for p in tmp_path.iterdir()} == {"f", "folder"}


def test_an_inflated_map_keeps_a_round_vehicle_clear(tmp_path: Path) -> None:
    """`umfeld map export --inflate`: what is free stays so only where no obstacle comes as near as that; turned or
    not, the file's origin and size stay."""
    cells = np.zeros((40, 50), np.int8)
    cells[20, 25], cells[:, 48:] = 100, -1
    source = MapImage(cells, 0.1, Pose2(1.23, -4.0, 0.3))
    save_grid(source, tmp_path / "plain.yaml")
    result = CliRunner().invoke(
        app, ["export", str(tmp_path / "wide.yaml"), "--store", str(tmp_path / "plain.yaml"), "--inflate", "0.5"]
    )
    assert result.exit_code == 0, result.output
    wide = load_pgm_yaml(tmp_path / "wide.yaml")
    assert (wide.origin, wide.resolution_m, wide.cells.shape) == (source.origin, 0.1, cells.shape)
    row, col = np.mgrid[:40, :50]
    between = np.hypot(np.maximum(abs(row - 20) - 1, 0), np.maximum(abs(col - 25) - 1, 0)) * 0.1  # of nearest points
    assert (wide.cells[between < 0.5] == 100).all()
    assert (wide.cells[(between > 0.7) & (cells == 0)] == 0).all()
    assert (wide.cells[:, 48:] == -1).all()


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
@pytest.mark.parametrize("name", ["aaf_winter", "apartment_movecare", "apartment_uma236", "depot", "tb3_sandbox"])
def test_maps_of_other_programs_round_trip_to_the_pixel(name: str, tmp_path: Path) -> None:
    source = load_pgm_yaml(DATA / f"{name}.yaml")
    export.save_pgm_yaml(source, tmp_path / "again.yaml")
    again = load_pgm_yaml(tmp_path / "again.yaml")
    np.testing.assert_array_equal(again.cells, source.cells)
    assert (again.origin, again.resolution_m) == (source.origin, source.resolution_m)
    theirs, ours = (np.asarray(Image.open(path)) for path in (DATA / f"{name}.pgm", tmp_path / "again.pgm"))
    np.testing.assert_array_equal(ours, theirs)  # these files hold 0, 205 and 254 only


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
@pytest.mark.parametrize("name", ["freiburg", "thickwean"])
def test_grey_maps_of_other_programs_read(name: str) -> None:
    image = load_pgm_yaml(DATA / f"{name}.yaml")
    pixels = np.asarray(Image.open(DATA / f"{name}.pgm"))[::-1]
    assert image.cells.shape == pixels.shape
    assert (image.cells[pixels < 80] == 100).all()
    assert (image.cells[pixels > 210] == 0).all()
    assert (image.cells[pixels == 205] == -1).all()
