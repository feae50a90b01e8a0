"""How the cost of the metric maps grows: 1, 4 and 16 times the beams, the points, the cells.

    python bench/growth.py [--rounds N] [--json FILE]

Beams: one drive through the office of bench/grid_insert.py, seen by lasers of 271, 1081 and 4321 beams.  Points: the
furnished room of bench/planes.py with 23,000, 92,000 and 368,000.  Cells: the same maps at a half and a quarter of the
cell, or squares of 500, 1000 and 2000 cells.  Medians of the rounds; by how much a step of four times makes them
dearer stands beside them: 4 is as the work, below is less.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.grid_insert import BEARING_RAD, NOISE_M, RANGE_MAX_M, cast, drive, office
from bench.planes import furnished_room
from mapping.features.scenes import sight_of
from mapping.frames import Pose2
from mapping.grids.clearance import DistanceField
from mapping.grids.height import ElevationMap
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.octree import Octree
from mapping.grids.patch import GridPatch
from mapping.grids.quadtree import Quadtree
from mapping.lines.extract import LineExtractor
from mapping.planes.extract import extract_planes
from mapping.scan import Scan

F64 = NDArray[np.float64]
Work = Callable[[], object]
TIMES = (1, 4, 16)


def median_ms(work: Work, rounds: int) -> float:
    """Of so many rounds after one that warms up."""
    work()
    spent = []
    for _ in range(rounds):
        before = time.perf_counter()
        work()
        spent.append(1e3 * (time.perf_counter() - before))
    return float(np.median(spent))


def by_beams() -> dict[str, list[Work]]:
    """A scan into a grid, lines, an anchor graph; six scans each, so figures are of six."""
    walls = office(np.random.default_rng(20))[0]
    random = np.random.default_rng(5)
    found: dict[str, list[Work]] = {"grid": [], "lines": [], "sight": []}
    for beams in (271, 1081, 4321):
        bearing = np.linspace(float(BEARING_RAD[0]), float(BEARING_RAD[-1]), beams)
        scans = [
            (pose, cast(walls, pose.x_m, pose.y_m, bearing + pose.yaw_rad) + random.normal(0.0, NOISE_M, beams))
            for pose, _ in drive("office")[:6]
        ]
        grid = OccupancyGrid(resolution_m=0.05)
        extractor = LineExtractor(bearing, range_max_m=RANGE_MAX_M)

        def into_grid(
            grid: OccupancyGrid = grid, scans: list[tuple[Pose2, F64]] = scans, bearing: F64 = bearing
        ) -> None:
            for pose, ranges in scans:
                grid.insert_scan(pose, bearing, ranges, range_max_m=RANGE_MAX_M)

        def to_lines(extractor: LineExtractor = extractor, scans: list[tuple[Pose2, F64]] = scans) -> None:
            for _, ranges in scans:
                extractor.extract(ranges)

        def to_sights(scans: list[tuple[Pose2, F64]] = scans, bearing: F64 = bearing) -> None:
            for _, ranges in scans:
                sight_of(Scan(0, 0.0, bearing, ranges, 0.05, RANGE_MAX_M))

        found["grid"].append(into_grid)
        found["lines"].append(to_lines)
        found["sight"].append(to_sights)
    return {f"{name}, six scans, by beams": works for name, works in found.items()}


def by_points() -> dict[str, list[Work]]:
    """Planes, octree and heights of one cloud."""
    clouds = [furnished_room(23_000 * times).points for times in TIMES]
    return {
        "planes, one core, by points": [lambda cloud=cloud: extract_planes(cloud) for cloud in clouds],  # type: ignore[misc]
        "octree, 5 cm, by points": [
            lambda cloud=cloud: Octree(resolution_m=0.05).insert((0.0, 0.0, 0.0), cloud)  # type: ignore[misc]
            for cloud in clouds
        ],
        "heights and ground, 10 cm, by points": [lambda cloud=cloud: _heights(cloud) for cloud in clouds],  # type: ignore[misc]
    }


def _heights(cloud: F64) -> None:
    heights = ElevationMap(resolution_m=0.1)
    heights.insert(cloud)
    heights.elevation()


def by_cells() -> dict[str, list[Work]]:
    """Distances from scratch and after a change, quadtrees, and one drive into finer and finer grids."""
    found: dict[str, list[Work]] = {
        "grid, six scans, by cells of an area": [],
        "distances from scratch, by cells": [],
        "distances after a wall of 40 cells, by cells": [],
        "the same with a reach of 40 cells": [],
        "quadtree, by cells": [],
    }
    for side, cell_m in ((500, 0.1), (1000, 0.05), (2000, 0.025)):
        grid = OccupancyGrid(resolution_m=cell_m)
        scans = drive("office")[:6]

        def into_grid(grid: OccupancyGrid = grid, scans: list[tuple[Pose2, F64]] = scans) -> None:
            for pose, ranges in scans:
                grid.insert_scan(pose, BEARING_RAD, ranges, range_max_m=RANGE_MAX_M)

        into_grid()
        cells = np.full((side, side), -1, dtype=np.int8)
        part = grid.patch().cells[:side, :side]
        cells[: part.shape[0], : part.shape[1]] = part
        obstacle = cells >= 65
        found["grid, six scans, by cells of an area"].append(into_grid)
        found["distances from scratch, by cells"].append(lambda mask=obstacle: DistanceField(mask))  # type: ignore[misc]
        wall = [(side // 2, side // 2 + k) for k in range(40)]
        for name, reach in (
            ("distances after a wall of 40 cells, by cells", None),
            ("the same with a reach of 40 cells", 40),
        ):
            field = DistanceField(obstacle, reach_cells=reach)
            found[name].append(lambda field=field, wall=wall: _there_and_back(field, wall))  # type: ignore[misc]
        patch = GridPatch(cell_m, 0, 0, cells)
        found["quadtree, by cells"].append(lambda patch=patch: Quadtree.of_patch(patch))  # type: ignore[misc]
    return found


def _there_and_back(field: DistanceField, wall: list[tuple[int, int]]) -> None:
    field.update(wall, [])
    field.update([], wall)


def main() -> None:
    """All figures."""
    parser = argparse.ArgumentParser(description="How costs grow.")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    options = parser.parse_args()
    report = {}
    for name, works in {**by_beams(), **by_points(), **by_cells()}.items():
        figures = [median_ms(work, options.rounds) for work in works]
        report[name] = [round(figure, 3) for figure in figures]
        steps = ", ".join(f"{after / before:.1f}" for before, after in pairwise(figures))
        print(f"{name:48}" + "".join(f"{figure:10.2f} ms" for figure in figures) + f"   x {steps}")
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
