"""Pictures of the line maps for docs/algorithms/lines.md, from the simulated office of bench/grid_insert.py.

python bench/lines_pictures.py [--out docs/pictures]
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.collections import LineCollection
from matplotlib.patches import Ellipse

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.grid_insert import BEARING_RAD, RANGE_MAX_M, box, cast
from bench.lines import RULES, scans_of, walls_of
from mapping.frames import Pose2
from mapping.lines.extract import LineExtractor
from mapping.lines.free_space import FreeSpace
from mapping.lines.fuse import fuse
from mapping.lines.line_map import LineMap
from mapping.lines.lines import Lines
from mapping.lines.outlines import OutlineKind, outlines
from mapping.lines.segment import segment_points

F64 = NDArray[np.float64]
EXTRACTOR = LineExtractor(BEARING_RAD, RULES, range_max_m=RANGE_MAX_M)


def one_scan(folder: Path) -> None:
    """S03 to S06: clusters, lines, what is sure about them."""
    _, ranges = scans_of("office", BEARING_RAD, 0.008)[4]
    points = np.stack((ranges * np.cos(BEARING_RAD), ranges * np.sin(BEARING_RAD)), axis=-1)[np.isfinite(ranges)]
    figure, axes = plt.subplots(1, 3, figsize=(15, 5.2))
    found = segment_points(points, 0.12, gap_per_m=6.0 * math.radians(0.25), smallest=2)
    for number, cluster in enumerate(found.clusters):
        axes[0].plot(*points[cluster].T, ".", ms=2.5, color=f"C{number % 10}")
    axes[0].plot(*points[found.auxiliary].T, "kx", ms=4)
    axes[0].set_title(f"S03: {len(found.clusters)} clusters, {found.auxiliary.size} auxiliary points (x)")
    lines = EXTRACTOR.extract(ranges)
    axes[1].plot(*points.T, ".", ms=2, color="0.7")
    draw(axes[1], lines, "C3", width=1.6)
    arrows(axes[1], lines)
    axes[1].set_title(f"S04 to S06, S08: {len(lines)} lines, arrows into free space")
    _, _, covariance = lines.parameters()
    for c in covariance:
        values, vectors = np.linalg.eigh(c * np.outer([180.0 / math.pi, 1e3], [180.0 / math.pi, 1e3]))
        turn = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
        axes[2].add_patch(Ellipse((0.0, 0.0), *(4.0 * np.sqrt(values[::-1])), angle=turn, fill=False, color="C0"))
    axes[2].set_xlim(-1.5, 1.5)
    axes[2].set_ylim(-60, 60)
    axes[2].set_xlabel("angle, degrees")
    axes[2].set_ylabel("distance, mm")
    axes[2].set_title("S05: 2-sigma ellipses of angle and distance")
    for each in axes[:2]:
        finish(each, 0.0, 0.0)
    save(figure, folder / "lines_scan.png")


def fusion(folder: Path) -> None:
    """S07: the lines of two scans, before and after."""
    scans = scans_of("office", BEARING_RAD, 0.008)
    first, second = (EXTRACTOR.extract(r).transformed(p) for p, r in (scans[1], scans[3]))
    figure, axes = plt.subplots(1, 2, figsize=(13, 5))
    draw(axes[0], first, "C0", width=3.5)
    draw(axes[0], second, "C1", width=1.4)
    axes[0].set_title(f"S07: lines of two scans, {len(first)} and {len(second)}")
    both = fuse(first, second)
    draw(axes[1], both, "C2", width=1.6)
    axes[1].plot(*np.concatenate((both.start_m, both.end_m)).T, "k|", ms=5)
    axes[1].set_title(f"fused: {len(both)}")
    for each in axes:
        finish(each)
    save(figure, folder / "lines_fusion.png")


def run(folder: Path) -> None:
    """S08, S10: the map of the drive and its closed outlines."""
    line_map, walls = LineMap(), walls_of("office")
    for pose, ranges in scans_of("office", BEARING_RAD, 0.008):
        line_map.insert(EXTRACTOR.extract(ranges), pose)
    lines = line_map.lines()
    figure, axes = plt.subplots(2, 1, figsize=(12, 11))
    axes[0].add_collection(LineCollection(list(walls.reshape(-1, 2, 2)), colors="0.85", linewidths=4))
    draw(axes[0], lines, "C3", width=1.2)
    axes[0].set_title(f"S10: {len(lines)} lines of 24 scans; grey: the truth")
    for outline in outlines(house_lines(), join_m=0.4):
        closed = np.concatenate((outline.points_m, outline.points_m[:1]))
        match outline.kind:
            case OutlineKind.OBSTACLE:
                axes[1].fill(*closed.T, color="C0", alpha=0.6)
            case OutlineKind.ROOM:
                axes[1].fill(*closed.T, color="C2", alpha=0.3)
            case OutlineKind.OPEN:
                axes[1].plot(*outline.points_m.T, "-", color="0.5", lw=1)
    axes[1].set_title("S08: outlines elsewhere; blue: obstacles (counter-clockwise), green: rooms (clockwise)")
    for each in axes:
        finish(each)
    save(figure, folder / "lines_map.png")


def house_lines() -> Lines:
    """The lines of a room with three boxes, seen from all sides."""
    bearing = np.radians(np.arange(-180.0, 180.0, 0.5))
    walls = np.array(
        [*box(0.0, 0.0, 12.0, 6.0), *box(2.0, 2.0, 3.2, 3.4), *box(5.5, 3.0, 6.5, 4.0), *box(9.0, 1.5, 9.6, 4.0)]
    )
    extractor, line_map, random = LineExtractor(bearing, RULES), LineMap(), np.random.default_rng(4)
    for x, y in [(x, y) for y in (0.8, 5.2) for x in np.arange(0.8, 11.5, 0.9)] + [(4.4, 3.0), (7.8, 3.0), (11.0, 3.0)]:
        ranges = cast(walls, x, y, bearing) + random.normal(0.0, 0.008, bearing.size)
        line_map.insert(extractor.extract(ranges), Pose2(x, y, 0.0))
    return line_map.lines(min_seen=2)


def free_space(folder: Path) -> None:
    """S09: one look, and the drive."""
    scans = scans_of("office", BEARING_RAD, 0.008)
    figure, axes = plt.subplots(2, 1, figsize=(12, 11))
    for axis, count in ((axes[0], 1), (axes[1], len(scans))):
        free = FreeSpace()
        for pose, ranges in scans[:count]:
            free.insert(pose, BEARING_RAD, ranges, range_max_m=RANGE_MAX_M)
            axis.plot(pose.x_m, pose.y_m, "k+", ms=7)
        for part in free.polygon.geoms:
            axis.fill(*np.asarray(part.exterior.coords).T, color="C2", alpha=0.35, lw=0)
            for hole in part.interiors:
                axis.fill(*np.asarray(hole.coords).T, color="white", lw=0)
        for edge in free.frontiers(min_length_m=0.5):
            axis.plot(*edge.T, "C1", lw=2)
        axis.set_title(f"S09: free after {count} scan{'s' * (count > 1)}: {free.area_m2:.0f} m²; orange: frontiers")
        finish(axis)
    save(figure, folder / "lines_free_space.png")


def draw(axis: Any, lines: Lines, color: str, *, width: float) -> None:
    """Lines from end to end."""
    axis.add_collection(LineCollection(list(lines.rows[:, :4].reshape(-1, 2, 2)), colors=color, linewidths=width))


def arrows(axis: Any, lines: Lines) -> None:
    """From the middle of each line to its right."""
    middle, way = 0.5 * (lines.start_m + lines.end_m), lines.end_m - lines.start_m
    right = np.stack((way[:, 1], -way[:, 0]), axis=-1) / lines.length_m[:, None] * 0.3
    axis.quiver(*middle.T, *right.T, angles="xy", scale_units="xy", scale=1, width=0.004, color="C0")


def finish(axis: Any, *sensor: float) -> None:
    """Metres, upright, the sensor if it is in the picture."""
    axis.set_aspect("equal")
    axis.autoscale_view()
    axis.grid(alpha=0.3)
    if sensor:
        axis.plot(*sensor, "k+", ms=10)


def save(figure: Any, path: Path) -> None:
    """Write a picture and say so."""
    figure.tight_layout()
    figure.savefig(path, dpi=75)
    plt.close(figure)
    print(path)


def main() -> int:
    """All pictures."""
    parser = argparse.ArgumentParser(description="Pictures of the line maps.")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs" / "pictures")
    folder: Path = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    for make in (one_scan, fusion, run, free_space):
        make(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
