"""Features of one scan of a recorded log as JSON and as a picture (`umfeld extract features`)."""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.logs import LogError
from mapping.features.anchors import AnchorFinder, AnchorKind, Anchors
from mapping.features.graph import anchor_graph
from mapping.features.histograms import SquareScene, box_feature, square_scene, virtual_edges
from mapping.features.moments import arc_weights, inertia, smoothed_inertia
from mapping.features.range_image import segment_ranges
from mapping.features.scenes import SCENE_FEATURES, scene_vector
from service.errors import WrongUsage
from service.recording_log import read_any_log

F64 = NDArray[np.float64]

JUMP_M = 0.3
JUMP_BEAMS = 6.0


@dataclass(frozen=True, slots=True)
class ScanFeatures:
    """document: everything found, in the frame of the laser.  points (N, 2), anchors, scene: what a picture shows."""

    document: dict[str, Any]
    points: F64
    anchors: Anchors
    scene: SquareScene | None


def features_of_log(path: Path, *, scan: int = 0) -> ScanFeatures:
    """Features S14 to S24 of one scan (from 0; negative from the end).  WrongUsage if the log has no such scan."""
    try:
        log = read_any_log(path)
    except (LogError, OSError) as error:
        raise WrongUsage(str(error)) from error
    count = len(log.scans)
    if not -count <= scan < count:
        raise WrongUsage(f"{path}: has scans 0 to {count - 1}, not {scan}")
    chosen = log.scans[scan]
    r, bearing = chosen.range_m, chosen.bearing_rad
    hit = np.isfinite(r) & (r > 0.0) & (r <= log.range_max_m)
    points = r[hit, None] * np.stack((np.cos(bearing[hit]), np.sin(bearing[hit])), axis=-1)
    spacing = float(np.median(np.abs(np.diff(bearing)))) if len(bearing) > 1 else 0.0
    segments = segment_ranges(np.where(hit, r, np.nan), JUMP_M, jump_per_m=JUMP_BEAMS * spacing)
    anchors = AnchorFinder(bearing, range_max_m=log.range_max_m).find(r)
    scene = square_scene(points)
    virtual = None if scene is None else virtual_edges(scene)
    graph = anchor_graph(anchors, virtual)
    shown = anchors if virtual is None else Anchors(np.concatenate((anchors.rows, virtual.rows)))
    document = {
        "log": log.provenance.path,
        "scan": scan % count,
        "stamp": chosen.stamp_text,
        "frame": "laser",
        "points": len(points),
        "segments": segments.count,
        **_weighed(points),
        "orientation": None if scene is None else _orientation(scene),
        "box": None if scene is None else _box(scene),
        "anchors": [_anchor(row) for row in shown.rows],
        "graph": {"vertices": len(graph), "edges": len(graph.edges), "longest_m": _longest(graph.length_m)},
        "vector": _vector(points),
    }
    return ScanFeatures(document, points, shown, scene)


def json_bytes(document: dict[str, Any]) -> bytes:
    """For a file or the screen."""
    return (json.dumps(document, indent=2, allow_nan=False) + "\n").encode()


def _rounded(value: float, digits: int = 4) -> float:
    return round(float(value), digits) + 0.0


def _weighed(points: F64) -> dict[str, Any]:
    if not len(points):
        return {"centre_of_gravity_m": None, "inertia": None, "smoothed_axis_ratio": None}
    weight = arc_weights(points)
    weight = weight if weight.sum() > 0.0 else np.ones(len(points))
    found = inertia(points, weight=weight)
    return {
        "centre_of_gravity_m": [_rounded(v) for v in found.centre],
        "inertia": {
            "least_m2": _rounded(found.least),
            "most_m2": _rounded(found.most),
            "axis_ratio": _rounded(found.axis_ratio),
            "direction_rad": _rounded(found.direction_rad, 6),
        },
        "smoothed_axis_ratio": _rounded(smoothed_inertia(points, weight=weight).axis_ratio),
    }


def _orientation(scene: SquareScene) -> dict[str, Any]:
    return {
        "angle_rad": _rounded(-scene.scene_from_sensor.yaw_rad, 6),
        "share": _rounded(scene.share),
        "x_walls_m": [_rounded(v) for v in scene.x_walls.position_m],
        "y_walls_m": [_rounded(v) for v in scene.y_walls.position_m],
    }


def _box(scene: SquareScene) -> dict[str, Any] | None:
    box = box_feature(scene)
    if box is None:
        return None
    return {
        "centre_m": [_rounded(v) for v in box.centre_m],
        "size_m": [_rounded(v) for v in box.size_m],
        "angle_rad": _rounded(box.angle_rad, 6),
    }


def _anchor(row: F64) -> dict[str, Any]:
    x, y, kind, before, after, length, beam = (float(v) for v in row)
    return {
        "kind": AnchorKind(int(kind)).name.lower(),
        "x_m": _rounded(x),
        "y_m": _rounded(y),
        "walls_rad": [None if math.isnan(v) else _rounded(v, 6) for v in (before, after)],
        "length_m": _rounded(length),
        "beam": int(beam),
    }


def _longest(length_m: F64) -> float | None:
    return _rounded(length_m[0]) if len(length_m) else None


def _vector(points: F64) -> dict[str, float]:
    return {feature.name: _rounded(v) for feature, v in zip(SCENE_FEATURES.features, scene_vector(points))}


_COLOURS = {
    AnchorKind.FALSE_EDGE: (150, 150, 150),
    AnchorKind.WALL_END: (30, 90, 220),
    AnchorKind.CORNER: (210, 30, 30),
    AnchorKind.JUMP_EDGE: (20, 140, 50),
    AnchorKind.VIRTUAL: (180, 60, 200),
}


def png_bytes(found: ScanFeatures, *, longest_px: int = 1000) -> bytes:
    """The scan, its box and anchors: false edge grey, wall end blue, corner red, jump edge green, virtual violet."""
    from PIL import Image, ImageDraw

    box = None if found.scene is None else box_feature(found.scene)
    everything = np.concatenate(
        (found.points, found.anchors.points, [[0.0, 0.0]], np.empty((0, 2)) if box is None else box.corners())
    )
    low, high = everything.min(axis=0) - 0.5, everything.max(axis=0) + 0.5
    scale = longest_px / float((high - low).max())
    size = np.maximum(1, np.ceil((high - low) * scale)).astype(int)
    image = Image.new("RGB", (int(size[0]), int(size[1])), (255, 255, 255))
    pen = ImageDraw.Draw(image)

    def at(point: F64) -> tuple[float, float]:
        return (float((point[0] - low[0]) * scale), float((high[1] - point[1]) * scale))

    if box is not None:
        pen.polygon([at(corner) for corner in box.corners()], outline=(240, 160, 60))
    for point in found.points:
        x, y = at(point)
        pen.rectangle([x - 1, y - 1, x + 1, y + 1], fill=(90, 90, 90))
    x, y = at(np.zeros(2))
    pen.polygon([(x + 8, y), (x - 6, y - 6), (x - 6, y + 6)], outline=(0, 0, 0))
    for point, kind in zip(found.anchors.points, found.anchors.kinds):
        x, y = at(point)
        pen.ellipse([x - 6, y - 6, x + 6, y + 6], outline=_COLOURS[AnchorKind(int(kind))], width=2)
    out = io.BytesIO()
    image.save(out, "PNG")
    return out.getvalue()
