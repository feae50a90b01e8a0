"""Grids as files other programs know: PGM + YAML of the ROS map server, PNG, NPY, JSON; and back again.

In arrays row 0 lies lowest (smallest y); in pictures the first line is the uppermost. The flip happens here and
nowhere else. Pixels: 254 free, 205 unknown, 0 occupied.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.grids.patch import GridPatch
from service import topics
from service.files import FileTrouble, Receipt, write_whole

I8 = NDArray[np.int8]
U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

GRID_FORMATS = ("png", "pgm", "npy", "json")
OCCUPIED_THRESHOLD = 0.65
FREE_THRESHOLD = 0.196
_BAND = 128  # lines of a picture made at once
_FREE_PIXEL, _UNKNOWN_PIXEL, _OCCUPIED_PIXEL = 254, 205, 0
_SIDE_MAX = 65_535
_CELLS_MAX = 400_000_000


class MapFileTrouble(FileTrouble):
    """A map file is not what it should be; names the file, the line or value, and the repair."""


@dataclass(frozen=True, slots=True)
class MapImage:
    """A grid as map files hold it. cells: (R, C) int8, -1 unknown, 0 to 100; origin: pose of its lower left corner in
    the map frame, which need not lie on a cell border and may be turned."""

    cells: I8
    resolution_m: float
    origin: Pose2


def image_of(patch: GridPatch) -> MapImage:
    """A patch as a map image: its origin lies on a cell border, unturned."""
    return MapImage(patch.cells, patch.resolution_m, grid_origin(patch))


def patch_of(image: MapImage, resolution_m: float | None = None) -> GridPatch:
    """A map image on our own lattice of cells (borders at whole multiples of the resolution, axes along the map's).

    An unturned image of the same resolution is moved to the nearest cell border, by half a cell at most, and keeps its
    shape. Otherwise each of our cells takes the image cell under its centre, and every occupied image cell also marks
    the cell its centre lies in: turning a map loses no thin wall. Outside the image all is unknown.
    """
    r = image.resolution_m if resolution_m is None else resolution_m
    if image.origin.yaw_rad == 0.0 and r == image.resolution_m:
        return GridPatch(r, round(image.origin.y_m / r), round(image.origin.x_m / r), image.cells)
    rows, columns = image.cells.shape
    size = image.resolution_m
    corners = image.origin.apply(np.array([(0, 0), (columns, 0), (0, rows), (columns, rows)]) * size) / r
    col0, row0 = (math.floor(value + 1e-6) for value in corners.min(axis=0))
    col1, row1 = (math.ceil(value - 1e-6) for value in corners.max(axis=0))
    _check_size(row1 - row0, col1 - col0, "the turned map")
    cells = np.full((row1 - row0, col1 - col0), -1, dtype=np.int8)
    image_from_map = image.origin.inverse()
    x = (np.arange(col0, col1) + 0.5) * r
    for row in range(row1 - row0):  # a line at a time: the memory stays small
        centres = np.stack((x, np.full_like(x, (row0 + row + 0.5) * r)), axis=-1)
        at = np.floor(image_from_map.apply(centres) / size).astype(np.int64)
        inside = (at[:, 0] >= 0) & (at[:, 0] < columns) & (at[:, 1] >= 0) & (at[:, 1] < rows)
        cells[row, inside] = image.cells[at[inside, 1], at[inside, 0]]
    threshold = 100 * OCCUPIED_THRESHOLD
    hits = np.argwhere(image.cells >= threshold)
    marks = np.floor(image.origin.apply((hits[:, ::-1] + 0.5) * size) / r).astype(np.int64)
    mark_rows, mark_columns = marks[:, 1] - row0, marks[:, 0] - col0
    values = image.cells[hits[:, 0], hits[:, 1]]
    np.maximum.at(cells, (mark_rows, mark_columns), values)
    return GridPatch(r, row0, col0, cells)


def pixels_of(cells: I8) -> U8:
    """Cells as picture lines: 0 occupied from 65 %, 254 free below 19.6 %, 205 otherwise; uppermost line first."""
    pixels = np.full(cells.shape, _UNKNOWN_PIXEL, dtype=np.uint8)
    upside_down = cells[::-1]
    for first in range(0, len(cells), _BAND):  # a map may have a hundred million cells
        band, out = upside_down[first : first + _BAND], pixels[first : first + _BAND]
        out[(band >= 0) & (band < 100 * FREE_THRESHOLD)] = _FREE_PIXEL
        out[band >= 100 * OCCUPIED_THRESHOLD] = _OCCUPIED_PIXEL
    return pixels


def pgm_bytes(cells: I8) -> bytes:
    """A binary PGM (P5) picture."""
    rows, columns = cells.shape
    return b"".join((b"P5\n%d %d\n255\n" % (columns, rows), pixels_of(cells).reshape(-1).data))


def png_bytes(cells: I8) -> bytes:
    """An 8-bit grey PNG picture."""
    from PIL import Image

    if cells.size == 0:
        raise MapFileTrouble("the map is empty: a PNG needs at least one cell; drive a little, then save")
    out = io.BytesIO()
    Image.fromarray(pixels_of(cells)).save(out, format="PNG", compress_level=1)
    return out.getvalue()


def npy_bytes(cells: I8) -> bytes:
    """A NumPy file: int8 (R, C), row 0 lowest, -1 unknown, 0 to 100."""
    out = io.BytesIO()
    np.save(out, cells, allow_pickle=False)
    return out.getvalue()


def grid_origin(patch: GridPatch, frame_from_grid: Pose2 = IDENTITY) -> Pose2:
    """The lower left corner of a patch's first cell, in the frame that frame_from_grid leads to."""
    r = patch.resolution_m
    return frame_from_grid @ Pose2(patch.col0 * r, patch.row0 * r, 0.0)


def grid_properties(
    patch: GridPatch, stamp_ns: int, *, frame: str = "map", frame_from_grid: Pose2 = IDENTITY
) -> dict[str, object]:
    """What a picture of a grid does not say: where it lies and how large its cells are."""
    seconds, nanos = divmod(stamp_ns, 1_000_000_000)
    origin = grid_origin(patch, frame_from_grid)
    return {
        "stamp": {"sec": seconds, "nanosec": nanos},
        "frame": frame,
        "resolution_m": patch.resolution_m,
        "rows": patch.cells.shape[0],
        "columns": patch.cells.shape[1],
        "origin": {"x_m": round(origin.x_m, 9), "y_m": round(origin.y_m, 9), "yaw_rad": origin.yaw_rad},
    }


def json_bytes(patch: GridPatch, properties: Mapping[str, object]) -> bytes:
    """umfeld.grid.v1: the properties, and rows of cells, the lowest row first."""
    document = {"schema": "umfeld.grid.v1", **properties, "cells": patch.cells.tolist()}
    return json.dumps(document, separators=(",", ":")).encode()


def render_grid(patch: GridPatch, form: str, properties: Mapping[str, object]) -> tuple[bytes, str]:
    """A grid in one of GRID_FORMATS, and the Zenoh encoding of that; ValueError for another."""
    match form:
        case "png":
            return png_bytes(patch.cells), "image/png"
        case "pgm":
            return pgm_bytes(patch.cells), "image/x-portable-graymap"
        case "npy":
            return npy_bytes(patch.cells), "application/x-npy"
        case "json":
            return json_bytes(patch, properties), topics.JSON_GRID
    raise ValueError(f"format {form!r}: there are {', '.join(GRID_FORMATS)}")


def yaml_text(image_name: str, image: MapImage) -> str:
    """The sidecar the ROS map server reads."""
    o = image.origin
    return (
        f"image: {_yaml_string(image_name)}\n"
        "mode: trinary\n"
        f"resolution: {image.resolution_m!r}\n"
        f"origin: [{o.x_m!r}, {o.y_m!r}, {o.yaw_rad!r}]\n"
        "negate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESHOLD}\n"
        f"free_thresh: {FREE_THRESHOLD}\n"
    )


def _yaml_string(text: str) -> str:
    plain = text.isascii() and all(c.isalnum() or c in "._-/" for c in text) and text[0].isalpha()
    return text if plain else json.dumps(text, ensure_ascii=False)


def save_pgm_yaml(image: MapImage, yaml_path: Path) -> list[Receipt]:
    """Write NAME.pgm and NAME.yaml; the picture first, so that a sidecar never names a picture that is not there."""
    pgm_path = yaml_path.with_suffix(".pgm")
    return [
        write_whole(pgm_path, pgm_bytes(image.cells)),
        write_whole(yaml_path, yaml_text(pgm_path.name, image).encode()),
    ]


def save_grid(image: MapImage, path: Path, *, stamp_ns: int = 0) -> list[Receipt]:
    """Write a grid in the form that the file's ending names: .yaml or .pgm (both are written), .png, .npy, .json."""
    match path.suffix.lower():
        case ".yaml" | ".pgm":
            return save_pgm_yaml(image, path.with_suffix(".yaml"))
        case ".png":
            return [write_whole(path, png_bytes(image.cells))]
        case ".npy":
            return [write_whole(path, npy_bytes(image.cells))]
        case ".json":
            patch = patch_of(image)
            return [write_whole(path, json_bytes(patch, grid_properties(patch, stamp_ns)))]
    raise MapFileTrouble(f"{path}: unknown ending {path.suffix!r}; there are .yaml (with .pgm), .png, .npy, .json")


def load_pgm_yaml(yaml_path: Path) -> MapImage:
    """Read a map server's pair, in the modes trinary, scale and raw. MapFileTrouble says what is wrong with it."""
    try:
        text = yaml_path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise MapFileTrouble(f"{yaml_path}: cannot be read: {error}") from error
    values = parse_flat_yaml(text)
    where = str(yaml_path)
    image_name = values.get("image")
    if not isinstance(image_name, str) or not image_name:
        raise MapFileTrouble(f"{where}: has no `image: NAME.pgm`; is it the sidecar of a map?")
    resolution_m = _yaml_number(values, "resolution", where)
    if not (math.isfinite(resolution_m) and 1e-4 <= resolution_m <= 100.0):
        raise MapFileTrouble(f"{where}: resolution {resolution_m}: metres a pixel, such as 0.05")
    origin = values.get("origin", [0.0, 0.0, 0.0])
    if not isinstance(origin, list) or len(origin) not in (2, 3):
        raise MapFileTrouble(f"{where}: origin {origin!r}: must be [x, y, yaw]")
    x, y, yaw = (_as_number(value, "origin", where) for value in (*origin, 0.0)[:3])
    pixels, opaque = read_pixels(yaml_path.parent / image_name)
    cells = interpret_pixels(
        pixels,
        opaque,
        mode=str(values.get("mode", "trinary")).lower(),
        negate=bool(_yaml_number(values, "negate", where, 0.0)),
        occupied_threshold=_yaml_number(values, "occupied_thresh", where, OCCUPIED_THRESHOLD),
        free_threshold=_yaml_number(values, "free_thresh", where, FREE_THRESHOLD),
        where=where,
    )
    return MapImage(cells, resolution_m, Pose2(x, y, yaw))


def load_map(path: Path, *, resolution_m: float | None = None) -> MapImage:
    """A grid map from a sidecar (.yaml), or from a picture: by the sidecar beside it, or with resolution_m at (0, 0).

    A picture without sidecar is read as the map server does with the usual thresholds. MapFileTrouble tells what fails.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        return load_pgm_yaml(path)
    sidecar = path.with_suffix(".yaml")
    if resolution_m is None and sidecar.exists():
        return load_pgm_yaml(sidecar)
    if resolution_m is None or not (math.isfinite(resolution_m) and 1e-4 <= resolution_m <= 100.0):
        raise MapFileTrouble(f"{path}: has no {sidecar.name} beside it; say metres a pixel with --resolution-m 0.05")
    pixels, opaque = read_pixels(path)
    cells = interpret_pixels(
        pixels,
        opaque,
        mode="trinary",
        negate=False,
        occupied_threshold=OCCUPIED_THRESHOLD,
        free_threshold=FREE_THRESHOLD,
        where=str(path),
    )
    return MapImage(cells, resolution_m, IDENTITY)


def interpret_pixels(
    pixels: F64,
    opaque: NDArray[np.bool_],
    *,
    mode: str,
    negate: bool,
    occupied_threshold: float,
    free_threshold: float,
    where: str = "map",
) -> I8:
    """Picture lines (uppermost first, brightness 0 to 1) as cells (row 0 lowest), as the map server does.

    trinary: occupied, free or unknown by the thresholds; grey 205 is unknown whatever free_thresh says, because common
    map savers write unknown as 205 beside free_thresh 0.25, which would read it back as free.
    scale: between the thresholds proportionally, transparent pixels unknown.
    raw: the pixel value itself, above 100 unknown.
    """
    lines = pixels[::-1]
    if mode == "raw":
        values = np.rint(lines * 255.0)
        return np.where(values <= 100, values, -1).astype(np.int8)
    if not 0.0 <= free_threshold < occupied_threshold <= 1.0:
        raise MapFileTrouble(f"{where}: needs 0 <= free_thresh < occupied_thresh <= 1")
    occupied = lines if negate else 1.0 - lines
    if mode == "trinary":
        between = np.full(lines.shape, -1.0)
    elif mode == "scale":
        between = np.rint(1.0 + 98.0 * (occupied - free_threshold) / (occupied_threshold - free_threshold))
    else:
        raise MapFileTrouble(f"{where}: mode {mode!r}: there are trinary, scale, raw")
    cells = np.where(occupied > occupied_threshold, 100.0, np.where(occupied < free_threshold, 0.0, between))
    if mode == "trinary" and not negate:
        cells[np.rint(lines * 255.0) == _UNKNOWN_PIXEL] = -1.0
    cells[~opaque[::-1]] = -1.0
    return cells.astype(np.int8)


def read_pixels(path: Path) -> tuple[F64, NDArray[np.bool_]]:
    """Brightness (0 to 1) and opacity of a picture of any usual kind."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            _check_size(picture.height, picture.width, str(path))
            picture.load()
            alpha = np.asarray(picture.getchannel("A")) > 127 if "A" in picture.getbands() else None
            deep = picture.mode.startswith("I") or picture.mode == "F"
            values = np.asarray(picture if deep else picture.convert("L"), dtype=np.float64)
    except UnidentifiedImageError as error:
        raise MapFileTrouble(f"{path}: is not a picture; a map's picture is a .pgm or .png") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise MapFileTrouble(f"{path}: cannot be read: {error}") from error
    opaque = np.ones(values.shape, dtype=np.bool_) if alpha is None else alpha
    return values / (65535.0 if deep else 255.0), opaque


def _check_size(rows: int, columns: int, where: str) -> None:
    if max(rows, columns) > _SIDE_MAX or rows * columns > _CELLS_MAX:
        raise MapFileTrouble(f"{where}: {columns} x {rows} cells are too many; cut the map or use a coarser resolution")


def parse_flat_yaml(text: str) -> dict[str, Any]:
    """The part of YAML that map sidecars use: `key: value`, `[a, b]`, lists of `- a` lines, quotes and comments."""
    values: dict[str, Any] = {}
    key = ""
    for line in text.splitlines():
        content = _without_comment(line).rstrip()
        stripped = content.strip()
        if not stripped or stripped in ("---", "..."):
            continue
        if stripped.startswith("- ") and isinstance(values.get(key), list):
            values[key].append(_scalar(stripped[2:]))
            continue
        name, colon, rest = stripped.partition(":")
        if not colon:
            continue
        key, rest = name.strip().strip("'\""), rest.strip()
        if not rest:
            values[key] = []
        elif rest.startswith("[") and rest.endswith("]"):
            values[key] = [_scalar(part) for part in rest[1:-1].split(",") if part.strip()]
        else:
            values[key] = _scalar(rest)
    return values


def _without_comment(line: str) -> str:
    quote = ""
    for at, character in enumerate(line):
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        elif character == "#" and (at == 0 or line[at - 1] in " \t"):
            return line[:at]
    return line


def _scalar(text: str) -> Any:
    text = text.strip()
    if len(text) >= 2 and text[0] == text[-1] == '"':
        try:
            return json.loads(text)
        except ValueError:
            return text[1:-1]
    if len(text) >= 2 and text[0] == text[-1] == "'":
        return text[1:-1].replace("''", "'")
    if text.lower() in ("true", "yes", "on"):
        return 1.0
    if text.lower() in ("false", "no", "off"):
        return 0.0
    try:
        return float(text)
    except ValueError:
        return text


def _yaml_number(values: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    if key not in values and default is not None:
        return default
    if key not in values:
        raise MapFileTrouble(f"{where}: has no `{key}`")
    return _as_number(values[key], key, where)


def _as_number(value: Any, key: str, where: str) -> float:
    if not isinstance(value, float) or not math.isfinite(value):
        raise MapFileTrouble(f"{where}: {key} {value!r} is not a number")
    return value
