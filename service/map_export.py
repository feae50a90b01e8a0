"""Maps as files for other programs: the grid as pictures, GeoTIFF and points, its walls as GeoJSON, SVG and DXF.

Walls are the line map's, where there is one (a daemon's, `umfeld map build`'s); else the borders of the occupied cells.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mapping.frames import Pose2
from mapping.grids.borders import occupied_borders
from mapping.lines.line_map import LineMap, rows_of_ends
from mapping.lines.lines import Lines
from service.errors import Trouble
from service.export import OCCUPIED_THRESHOLD, MapFileTrouble, MapImage, save_grid
from service.files import Receipt, write_whole
from service.line_files import write_lines

if TYPE_CHECKING:
    from mapping.geo import Anchor
    from service.store import MapStore

LINES = "lines"
WALL_ENDINGS = (".geojson", ".svg", ".dxf")
GRID_ENDINGS = (".yaml", ".pgm", ".png", ".npy", ".json", ".tif", ".tiff", ".ply")
_UNKNOWN_VALUE = 255
_MIN_SEEN = 2


def save_map(image: MapImage, walls: Lines | None, out: Path, *, anchor: Anchor | None = None) -> list[Receipt]:
    """Write a map in the form that the file's ending names; FileTrouble for an unknown one.

    walls: None if there is no line map.  anchor: where the map lies on the earth, for GeoJSON and GeoTIFF.
    """
    ending = out.suffix.lower()
    if ending in WALL_ENDINGS:
        return [write_lines(borders_of(image) if walls is None else walls, out, anchor=anchor)]
    if ending in (".tif", ".tiff"):
        return [write_whole(out, geotiff_bytes(image, anchor))]
    if ending == ".ply":
        return [write_whole(out, ply_bytes(image))]
    if ending not in GRID_ENDINGS:
        known = ", ".join((".yaml (with .pgm)", *GRID_ENDINGS[2:], *WALL_ENDINGS))
        raise MapFileTrouble(f"{out}: unknown ending {out.suffix!r}; there are {known}")
    return save_grid(image, out)


def lines_of_store(store: MapStore) -> Lines | None:
    """The line map in a map file, None without one; Trouble if it is damaged."""
    tiles = list(store.load_tiles(LINES))
    if not tiles:
        return None
    try:
        return LineMap.from_bytes(tiles[0][2]).lines()
    except ValueError as error:
        raise Trouble(f"{store.path}: its line map is damaged: {error}") from error


def lines_of_document(document: Mapping[str, Any]) -> Lines | None:
    """The lines of an umfeld.lines.v1; None if there are none in it."""
    entries = document["lines"]
    if not entries:
        return None
    start, end = (np.array([each[name] for each in entries], dtype=np.float64) for name in ("start", "end"))
    points = np.array([each["points"] for each in entries], dtype=np.float64)
    seen = np.array([each["scans"] for each in entries], dtype=np.float64)
    variance = np.array([each["covariance"][2] for each in entries], dtype=np.float64)  # rms^2 / points
    rows = rows_of_ends(start, end, points, seen, np.maximum(np.sqrt(np.maximum(variance, 0.0) * points), 1e-4))
    return Lines(rows, np.full((len(rows), 2), -1, dtype=np.int64))


def lines_layer(line_map: LineMap) -> list[tuple[int, int, bytes]]:
    """The layer LINES of a map file: the lines that more than one scan saw."""
    return [(0, 0, line_map.to_bytes(min_seen=_MIN_SEEN))]


def borders_of(image: MapImage) -> Lines:
    """The borders of occupied cells as lines, free space to the right; a cell's side of scatter."""
    r = image.resolution_m
    ends = occupied_borders(image.cells >= 100 * OCCUPIED_THRESHOLD) * r
    start, end = image.origin.apply(ends[:, :2]), image.origin.apply(ends[:, 2:])
    cells = np.maximum(np.hypot(*(end - start).T) / r, 1.0)
    rows = rows_of_ends(start, end, cells, np.ones(len(ends)), np.full(len(ends), r / math.sqrt(12.0)))
    return Lines(rows, np.full((len(rows), 2), -1, dtype=np.int64))


def ply_bytes(image: MapImage) -> bytes:
    """The occupied cells as points of a binary PLY: x, y, z (0) in metres of the map frame, occupancy in percent."""
    rows, columns = np.nonzero(image.cells >= 100 * OCCUPIED_THRESHOLD)
    middle = image.origin.apply((np.stack((columns, rows), axis=-1) + 0.5) * image.resolution_m)
    points = np.zeros(len(rows), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("occupancy", "u1")])
    points["x"], points["y"] = middle[:, 0], middle[:, 1]
    points["occupancy"] = image.cells[rows, columns]
    head = (
        f"ply\nformat binary_little_endian 1.0\ncomment umfeld map, frame map, cells of {image.resolution_m!r} m\n"
        f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar occupancy\nend_header\n"
    )
    return head.encode() + points.tobytes()


# --- GeoTIFF (OGC 19-008r4) -------------------------------------------------------------------------------------------

_TRANSFORMATION, _GEO_KEYS, _GEO_ASCII, _NO_DATA = 34264, 34735, 34737, 42113
_MODEL_TYPE, _RASTER_TYPE, _CITATION = 1024, 1025, 1026
_PROJECTED_CRS, _LINEAR_UNITS = 3072, 3076
_PROJECTED, _PIXEL_IS_AREA, _METRE, _USER_DEFINED = 1, 1, 9001, 32767


def geotiff_bytes(image: MapImage, anchor: Anchor | None = None) -> bytes:
    """Occupancy in percent, 255 (no data) where nothing is known; the first line is the uppermost.

    Without an anchor coordinates are metres of the map frame; with one they are those of its UTM zone (WGS 84), turned
    by the meridian's convergence and stretched by the zone's scale there.
    """
    from PIL import Image, TiffImagePlugin

    if image.cells.size == 0:
        raise MapFileTrouble("the map is empty: a picture needs at least one cell; drive a little, then export")
    values = np.where(image.cells < 0, _UNKNOWN_VALUE, image.cells).astype(np.uint8)[::-1]
    crs_from_map, scale, epsg = (Pose2(), 1.0, _USER_DEFINED) if anchor is None else _utm(anchor)
    corner = image.origin.apply(np.array([[0.0, len(values) * image.resolution_m]]))  # of the uppermost line
    x_m, y_m = (crs_from_map.apply(corner * scale))[0]
    yaw = crs_from_map.yaw_rad + image.origin.yaw_rad
    right, up = image.resolution_m * scale * math.cos(yaw), image.resolution_m * scale * math.sin(yaw)
    citation = "umfeld map frame, metres|" if anchor is None else f"WGS 84 / UTM, EPSG {epsg}|"
    keys = [
        (_MODEL_TYPE, 0, 1, _PROJECTED), (_RASTER_TYPE, 0, 1, _PIXEL_IS_AREA),
        (_CITATION, _GEO_ASCII, len(citation), 0), (_PROJECTED_CRS, 0, 1, epsg), (_LINEAR_UNITS, 0, 1, _METRE),
    ]  # fmt: skip
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[_TRANSFORMATION] = (right, up, 0.0, x_m, up, -right, 0.0, y_m, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    tags.tagtype[_TRANSFORMATION] = 12  # doubles
    tags[_GEO_KEYS] = (1, 1, 0, len(keys), *(number for key in keys for number in key))
    tags.tagtype[_GEO_KEYS] = 3  # shorts
    for tag, text in ((_GEO_ASCII, citation), (_NO_DATA, str(_UNKNOWN_VALUE))):
        tags[tag] = text
        tags.tagtype[tag] = 2
    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(values)).save(out, format="TIFF", tiffinfo=tags)
    return out.getvalue()


def _utm(anchor: Anchor) -> tuple[Pose2, float, int]:
    """Pose of the map in its UTM zone, the zone's scale there, and the zone's EPSG number."""
    try:
        from pyproj import Proj
    except ImportError as error:
        raise Trouble("GeoTIFF with --anchor needs the package pyproj: pip install 'umfeld[geo]'") from error
    longitude = (anchor.longitude_deg + 180.0) % 360.0 - 180.0
    zone = min(int((longitude + 180.0) // 6.0) + 1, 60)
    south = anchor.latitude_deg < 0.0
    epsg = (32700 if south else 32600) + zone
    projection = Proj(f"EPSG:{epsg}")
    easting, northing = projection(longitude, anchor.latitude_deg)
    factors = projection.get_factors(longitude, anchor.latitude_deg)
    # The map's yaw counts from true east; PROJ tells the turn, counter-clockwise, from there to the zone's east.
    yaw = anchor.yaw_rad + math.radians(factors.meridian_convergence)
    return Pose2(easting, northing, yaw), float(factors.meridional_scale), epsg
