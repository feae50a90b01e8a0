"""Planes of a cloud in a file, and as files: JSON, PLY, and a picture (`umfeld extract planes`)."""

from __future__ import annotations

import io
import json
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.planes.extract import PlaneRules, Planes, extract_planes, range_warning
from service.cloud_files import Cloud, read_cloud
from service.errors import Trouble, WrongUsage
from service.files import FileTrouble, Receipt, write_whole
from service.plane_maker import plane_entries

F64 = NDArray[np.float64]

ENDINGS = (".json", ".ply", ".png")
SCHEMA = "umfeld.planes.v1"
THREADS = 2
_COLORS = 20
_PICTURE_POINTS = 60_000


@dataclass(frozen=True, slots=True)
class FilePlanes:
    """The planes of a file's cloud. report: for people and programs."""

    cloud: Cloud
    planes: Planes
    report: dict[str, object]


def planes_of_file(
    path: Path, *, rules: PlaneRules | None = None, camera: Path | None = None, range_max_m: float = math.inf
) -> FilePlanes:
    """Read a cloud and find its planes. range_max_m: farther points are no echo. Raises CloudTrouble."""
    cloud = read_cloud(path, camera=camera)
    points = cloud.points_m
    if math.isfinite(range_max_m):
        far = np.linalg.norm(points, axis=1) > range_max_m
        points = np.where(far[:, None], np.nan, points)
    with ThreadPoolExecutor(THREADS) as pool:
        started = time.monotonic()
        planes = extract_planes(points, rules, run=pool.map)
        seconds = time.monotonic() - started
    read = int(np.isfinite(points).all(axis=1).sum())
    report: dict[str, object] = {
        "cloud": str(path),
        "points": read,
        "planes": len(planes),
        "points_in_planes": int(planes.count.sum()),
        "noise_sigma_m": round(planes.noise.sigma_m, 6),
        "noise_sigma_per_m2": round(planes.noise.sigma_per_m2, 7),
        "seconds": round(seconds, 3),
    }
    return FilePlanes(cloud, planes, report)


def range_warning_of(found: FilePlanes, rules: PlaneRules, beam_deg: float) -> str | None:
    """What S13 says of a cloud whose beams are so far apart; None if all of it is near enough."""
    if not 0.0 < beam_deg < 90.0:
        raise WrongUsage(f"--beam-deg {beam_deg}: an angle between beams lies between 0 and 90")
    points = found.cloud.points_m[np.isfinite(found.cloud.points_m).all(axis=1)]
    if not len(points):
        return None
    usual_far_m = float(np.quantile(np.linalg.norm(points, axis=1), 0.95))
    return range_warning(rules, math.radians(beam_deg), usual_far_m)


def json_bytes(planes: Planes, *, frame: str) -> bytes:
    """A document with a plane a line."""
    body = ",\n".join(json.dumps(each, allow_nan=False) for each in plane_entries(planes))
    return f'{{"schema": "{SCHEMA}", "frame": {json.dumps(frame)}, "planes": [\n{body}\n]}}\n'.encode()


def ply_bytes(points_m: F64, planes: Planes) -> bytes:
    """The cloud as PLY, each point with its plane: x y z, red green blue, label (-1 none)."""
    there = np.isfinite(points_m).all(axis=1)
    axes, colors = [(axis, "<f4") for axis in "xyz"], [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(int(there.sum()), dtype=[*axes, *colors, ("label", "<i4")])
    label = planes.label[there]
    for k, axis in enumerate("xyz"):
        vertices[axis] = points_m[there, k]
    palette = np.array([*_palette(), (128, 128, 128)], dtype=np.uint8)
    shade = palette[np.where(label >= 0, label % _COLORS, _COLORS)]
    for k, (name, _) in enumerate(colors):
        vertices[name] = shade[:, k]
    vertices["label"] = label
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    properties += "".join(f"property uchar {name}\n" for name, _ in colors) + "property int label\n"
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}end_header\n"
    return head.encode() + vertices.tobytes()


def png_bytes(points_m: F64, planes: Planes) -> bytes:
    """Points in the colours of their planes, and the planes' outlines. Trouble if matplotlib is not installed."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError as error:
        raise Trouble("--png needs the package matplotlib: pip install 'umfeld[plots]'") from error
    figure = pyplot.figure(figsize=(9, 7))
    draw_planes(figure.add_subplot(projection="3d"), points_m, planes)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=90)
    pyplot.close(figure)
    return out.getvalue()


def draw_planes(axes: Any, points_m: F64, planes: Planes, *, size: float = 0.4) -> None:
    """On matplotlib's 3D axes."""
    there = np.flatnonzero(np.isfinite(points_m).all(axis=1))
    there = there[:: max(1, len(there) // _PICTURE_POINTS)]
    label = planes.label[there]
    palette = np.array([*_palette(), (190, 190, 190)]) / 255.0
    shade = palette[np.where(label >= 0, label % _COLORS, _COLORS)]
    axes.scatter(*points_m[there].T, s=size, c=shade, linewidths=0)
    for number, corners in enumerate(planes.polygon):
        closed = np.concatenate((corners, corners[:1]))
        axes.plot(*closed.T, color=palette[number % _COLORS] * 0.6, linewidth=0.8)
    axes.set_box_aspect(np.maximum(np.ptp(points_m[there], axis=0), 1e-3) if len(there) else (1, 1, 1), zoom=1.2)
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.set_zlabel("z, m")


def write_planes(found: FilePlanes, path: Path, *, frame: str = "sensor") -> Receipt:
    """Write a file in the form that its ending names; whole or not at all. FileTrouble for an unknown ending."""
    match path.suffix.lower():
        case ".json":
            return write_whole(path, json_bytes(found.planes, frame=frame))
        case ".ply":
            return write_whole(path, ply_bytes(found.cloud.points_m, found.planes))
        case ".png":
            return write_whole(path, png_bytes(found.cloud.points_m, found.planes))
    raise FileTrouble(f"{path}: unknown ending {path.suffix!r} for planes; there are {', '.join(ENDINGS)}")


def _palette() -> list[tuple[int, int, int]]:
    """_COLORS colours, neighbours far apart in hue."""
    colors = []
    for k in range(_COLORS):
        hue = (k * 0.618034) % 1.0 * 6.0
        rise = [abs(hue - 3.0) - 1.0, 2.0 - abs(hue - 2.0), 2.0 - abs(hue - 4.0)]
        level = 0.95 - 0.25 * (k % 3)
        red, green, blue = (round(255 * level * (0.25 + 0.75 * min(max(v, 0.0), 1.0))) for v in rise)
        colors.append((red, green, blue))
    return colors
