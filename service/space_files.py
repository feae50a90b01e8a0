"""Quadtrees, octrees and elevation maps of files: made, drawn and written, for `umfeld extract`."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.grids.evidence import FREE, OCCUPIED, PARTLY_FREE, UNKNOWN
from mapping.grids.height import Elevation, ElevationMap, Ground, GroundRules
from mapping.grids.octree import HALF, Octree
from mapping.grids.quadtree import Quadtree
from service.cloud_files import CloudTrouble, read_cloud
from service.elevation_maker import elevation_fields, known_part, rows_of
from service.export import load_map, patch_of
from service.files import FileTrouble, Receipt, write_whole

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

QUADTREE_ENDING, OCTREE_ENDING = ".uqdt", ".uoct"
_LONGEST_PX = 1600
_WHITE, _GREY, _BLACK = (255, 255, 255), (190, 190, 190), (0, 0, 0)
_GROUND_COLOURS = {
    Ground.UNKNOWN: _GREY,
    Ground.TRAVERSABLE: (120, 200, 120),
    Ground.ROUGH: (240, 200, 80),
    Ground.STEEP: (240, 140, 60),
    Ground.STEP: (200, 50, 50),
}


@dataclass(frozen=True, slots=True)
class Extracted:
    """What came out: facts for the report, the bytes of its own form, and how to draw it (PNG)."""

    report: dict[str, object]
    data: bytes
    ending: str
    picture: Callable[[], bytes]


def quadtree_of_file(file: Path, *, resolution_m: float | None = None) -> Extracted:
    """The quadtree of a grid map. Raises MapFileTrouble."""
    patch = patch_of(load_map(file, resolution_m=resolution_m))
    tree = Quadtree.of_patch(patch)
    data = tree.to_bytes()
    report: dict[str, object] = {
        "file": str(file),
        "resolution_m": patch.resolution_m,
        "cells": patch.cells.size,
        "nodes": tree.node_count,
        "divided": tree.division_count,
        "leaves": tree.leaf_count,
        "entries": tree.entry_count,
        "bytes": len(data),
        "cells_per_entry": round(patch.cells.size / tree.entry_count, 1),
        "cells_per_node": round(patch.cells.size / tree.node_count, 1),
        "cells_per_divided": round(patch.cells.size / max(tree.division_count, 1), 1),
    }
    return Extracted(report, data, QUADTREE_ENDING, lambda: draw_quadtree(tree, patch.cells.shape))


def octree_of_file(
    file: Path,
    *,
    camera: Path | None = None,
    resolution_m: float = 0.05,
    sensor_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    range_max_m: float = math.inf,
    height_m: float | None = None,
) -> Extracted:
    """The octree of one point cloud seen from sensor_m. height_m: where the picture's slice lies; None: the sensor's.

    Raises CloudTrouble, also for a cloud that does not fit.
    """
    points = _points_of(file, camera)
    tree = Octree(resolution_m=resolution_m)
    tree.insert(sensor_m, points, range_max_m=range_max_m)
    data = tree.to_bytes()
    known = tree.count_in((-HALF,) * 3, (HALF,) * 3)
    report: dict[str, object] = {
        "file": str(file),
        "resolution_m": resolution_m,
        "points": len(points),
        "rejected_points": tree.rejected_points,
        "refused_rays": tree.refused_rays,
        "occupied_voxels": known.occupied,
        "free_voxels": known.free,
        "leaves": tree.leaf_count(),
        "memory_bytes": tree.memory_bytes,
        "bytes": len(data),
    }
    at = sensor_m[2] if height_m is None else height_m
    return Extracted(report, data, OCTREE_ENDING, lambda: draw_slice(tree, points, at))


def elevation_of_file(
    file: Path,
    *,
    camera: Path | None = None,
    resolution_m: float = 0.1,
    rules: GroundRules | None = None,
    height_max_m: float = math.inf,
) -> Extracted:
    """The elevation map of one point cloud whose z points up. Raises CloudTrouble."""
    points = _points_of(file, camera)
    heights = ElevationMap(resolution_m=resolution_m, rules=rules, height_max_m=height_max_m)
    try:
        heights.insert(points)
    except ValueError as error:
        raise CloudTrouble(f"{file}: {error}") from error
    elevation = heights.elevation()
    counts = {f"{kind.name.lower()}_cells": int(np.count_nonzero(elevation.ground == kind)) for kind in Ground}
    report: dict[str, object] = {
        "file": str(file),
        "resolution_m": resolution_m,
        "points": len(points),
        "rejected_points": heights.rejected_points,
        **counts,
    }
    return Extracted(report, elevation_bytes(elevation), ".json", lambda: draw_elevation(elevation))


def write_extracted(found: Extracted, path: Path) -> Receipt:
    """Its own form, or a picture (.png); FileTrouble for another ending."""
    match path.suffix.lower():
        case ".png":
            return write_whole(path, found.picture())
        case found.ending:
            return write_whole(path, found.data)
    raise FileTrouble(f"{path}: unknown ending {path.suffix!r}; there are {found.ending} and .png")


def elevation_bytes(elevation: Elevation) -> bytes:
    """The document umfeld.elevation.v1, as `map/elevation` has it, with more layers: points, min_m, max_m, variance_m2.

    frame: "cloud", that of the file; a file has no stamp.
    """
    part = known_part(elevation)
    document = {
        "schema": "umfeld.elevation.v1",
        "stamp": {"sec": 0, "nanosec": 0},
        **elevation_fields(elevation, version=0, frame="cloud"),
        "points": elevation.count[part].tolist(),
        **{name: rows_of(getattr(elevation, name)[part]) for name in ("min_m", "max_m")},
        "variance_m2": [[None if math.isnan(v) else v for v in row] for row in elevation.variance_m2[part].tolist()],
    }
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


def _points_of(file: Path, camera: Path | None) -> F64:
    points = read_cloud(file, camera=camera).points_m
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise CloudTrouble(f"{file}: has no point with a reading")
    return points


# ------------------------------------------------------------------------------------------------------------ pictures


def draw_quadtree(tree: Quadtree, shape: tuple[int, ...]) -> bytes:
    """Leaves with their outlines: white free, black occupied, grey unknown; +y up."""
    from PIL import Image, ImageDraw

    scale = max(1, _LONGEST_PX // max(*shape, 1))
    leaves = tree.leaves()
    known = leaves[leaves[:, 3] != UNKNOWN]
    low, high = _bounds(known[:, :2], known[:, :2] + known[:, 2:3])
    size = ((high[1] - low[1]) * scale + 1, (high[0] - low[0]) * scale + 1)
    image = Image.new("RGB", size, _GREY)
    pen = ImageDraw.Draw(image)
    colours = {int(UNKNOWN): _GREY, int(FREE): _WHITE, int(OCCUPIED): _BLACK}
    for row, col, side, state in leaves.tolist():
        x, y = (col - low[1]) * scale, size[1] - 1 - (row + side - low[0]) * scale
        outline = (120, 150, 200) if side * scale > 3 and state != OCCUPIED else None
        pen.rectangle((x, y, x + side * scale, y + side * scale), fill=colours[state], outline=outline)
    return _png(np.asarray(image))


def draw_slice(tree: Octree, points_m: F64, height_m: float) -> bytes:
    """The layer of voxels at a height, as a grid map is drawn; around the middle 98 % of the points."""
    d = tree.resolution_m
    ends = np.percentile(points_m, [1.0, 99.0], axis=0)
    x0, y0, _ = (math.floor(v / d) - 4 for v in ends[0])
    x1, y1, _ = (math.floor(v / d) + 5 for v in ends[1])
    z = math.floor(height_m / d)
    states = tree.states_in((x0, y0, z), (min(x1, x0 + 4000), min(y1, y0 + 4000), z + 1))[0]
    colours = np.full((*states.shape, 3), _GREY, dtype=np.uint8)
    colours[states == FREE] = _WHITE
    colours[states == PARTLY_FREE] = (225, 225, 225)
    colours[states == OCCUPIED] = _BLACK
    return _png(_enlarged(colours[::-1]))


def draw_elevation(elevation: Elevation) -> bytes:
    """Two pictures side by side: mean heights from dark (low) to light, and the ground by what it is; +y up.

    Around the middle 96 % of what is known: single far points make no picture small.
    """
    known = ~np.isnan(elevation.mean_m)
    part = _middle_part(known)
    known, mean, kinds = known[part], elevation.mean_m[part], elevation.ground[part]
    shape = kinds.shape
    low, high = np.percentile(mean[known], [2.0, 98.0]) if known.any() else (0.0, 1.0)
    level = np.clip((np.nan_to_num(mean) - low) / max(high - low, 1e-6), 0.0, 1.0)
    heights = np.full((*shape, 3), 255, dtype=np.uint8)
    heights[known] = (np.stack((40 + 200 * level, 60 + 170 * level, 110 + 60 * level), axis=-1)[known]).astype(np.uint8)
    ground = np.zeros((*shape, 3), dtype=np.uint8)
    for kind, colour in _GROUND_COLOURS.items():
        ground[kinds == kind] = colour
    gap = np.full((shape[0], max(2, shape[1] // 40), 3), 255, dtype=np.uint8)
    return _png(_enlarged(np.concatenate((heights, gap, ground), axis=1)[::-1]))


def _middle_part(known: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns between the 2nd and the 98th of a hundred of what is known, and some around."""
    rows, cols = np.nonzero(known)
    if not len(rows):
        return np.s_[:], np.s_[:]
    (row0, row1), (col0, col1) = (np.percentile(each, [2.0, 98.0]).astype(int) for each in (rows, cols))
    return np.s_[max(row0 - 5, 0) : row1 + 6], np.s_[max(col0 - 5, 0) : col1 + 6]


def _bounds(low: NDArray[np.int64], high: NDArray[np.int64]) -> tuple[list[int], list[int]]:
    if not len(low):
        return [0, 0], [1, 1]
    return [int(v) for v in low.min(axis=0)], [int(v) for v in high.max(axis=0)]


def _enlarged(pixels: U8) -> U8:
    """Each cell as a square of pixels, as large as still fits."""
    scale = max(1, min(_LONGEST_PX // max(pixels.shape[0], pixels.shape[1], 1), 12))
    return np.ascontiguousarray(pixels.repeat(scale, axis=0).repeat(scale, axis=1))


def _png(pixels: U8) -> bytes:
    import io

    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).quantize(64).save(out, format="PNG", optimize=True)
    return out.getvalue()
