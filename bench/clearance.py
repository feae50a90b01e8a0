"""Exact distances of 4 million cells: from scratch beside scipy and OpenCV, and kept up to date after scans.

    python bench/clearance.py [--rounds N] [--opencv PYTHON] [--json FILE]

The map: 2000 x 2000 cells of 5 cm with the office or the hall of bench/grid_insert.py in its middle. Scans go into an
occupancy grid; after each the cells whose state changed are handed to the distance field. Four passes over the same
places, metres apart, with new noise: the first explores by leaps, the others are what a robot does all day. And one
drive along the corridor, and through the hall, with a scan every 10 cm: exploring at the pace of a robot. Once with
every distance and once with those up to 2 m, which is how far the daemon's costs reach. --opencv: a Python with cv2,
whose distanceTransform (L2, precise) gets the same map. Milliseconds, medians (10 % to 90 %).
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.grid_insert import BEARING_RAD, CELL_M, NOISE_M, RANGE_MAX_M, cast, drive, hall, office
from mapping.frames import Pose2
from mapping.grids.clearance import DistanceField
from mapping.grids.occupancy import OccupancyGrid

SIDE = 2000
PASSES = 4
REACH_CELLS = 40
STEP_M = 0.1
UPDATE_GOAL_MS, SCRATCH_GOAL_MS = 2.0, 60.0
OPENCV = """
import sys, time, numpy, cv2
free = numpy.load(sys.argv[1])
for _ in range(int(sys.argv[2])):
    before = time.perf_counter()
    cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    print(1e3 * (time.perf_counter() - before))
"""


def step_by_step(place: str) -> list[tuple[Pose2, NDArray[np.float64]]]:
    """(pose, ranges) every 10 cm of a drive along the middle of one of the two places."""
    rng = np.random.default_rng(32)
    walls = (office if place == "office" else hall)(np.random.default_rng(20 if place == "office" else 21))[0]
    scans = []
    for x_m in np.arange(-16.0, 16.0, STEP_M) if place == "office" else np.arange(-21.0, 21.0, STEP_M):
        pose = Pose2(float(x_m), 0.3 * math.sin(x_m / 3.0), 0.2 * math.sin(x_m / 2.0))
        ranges = cast(walls, pose.x_m, pose.y_m, BEARING_RAD + pose.yaw_rad)
        scans.append((pose, ranges + rng.normal(0.0, NOISE_M, ranges.size)))
    return scans


def updates(place: str, reach_cells: int | None) -> tuple[list[dict[str, Any]], NDArray[np.bool_]]:
    """Figures of each pass and of the drive, and the obstacles after the passes."""
    rng = np.random.default_rng(30)
    grid, field = empty(reach_cells)
    rows = []
    for number in range(PASSES):
        noisy = [(pose, ranges + rng.normal(0.0, 0.01, ranges.size)) for pose, ranges in drive(place)]
        rows.append({"place": place, "reach_cells": reach_cells, "pass": number, **figures(noisy, grid, field)})
    obstacle = field.obstacle.copy()
    drove = figures(step_by_step(place), *empty(reach_cells))
    rows.append({"place": place, "reach_cells": reach_cells, "pass": "a scan every 10 cm", **drove})
    return rows, obstacle


def empty(reach_cells: int | None) -> tuple[OccupancyGrid, DistanceField]:
    """A grid and a field of which nothing is known."""
    nothing = np.zeros((SIDE, SIDE), dtype=np.bool_)
    return OccupancyGrid(resolution_m=CELL_M), DistanceField(nothing, reach_cells=reach_cells)


def figures(
    scans: Iterable[tuple[Pose2, NDArray[np.float64]]], grid: OccupancyGrid, field: DistanceField
) -> dict[str, float]:
    """How long the field took after each of the scans, and how much changed, medians."""
    times, cells, area = [], [], []
    for pose, ranges in scans:
        grid.insert_scan(pose, BEARING_RAD, ranges, range_max_m=RANGE_MAX_M)
        added, removed = changes(grid, field)
        before = time.perf_counter()
        spans = field.update(added, removed)
        times.append(1e3 * (time.perf_counter() - before))
        cells.append(len(added) + len(removed))
        area.append(int(np.maximum(spans[:, 1] - spans[:, 0], 0).sum()))
    low, middle, high = (float(v) for v in np.percentile(times, [10, 50, 90]))
    return {
        "median_ms": round(middle, 2),
        "p10_ms": round(low, 2),
        "p90_ms": round(high, 2),
        "cells_changed": int(np.median(cells)),
        "distances_looked_at": int(np.median(area)),
    }


def changes(grid: OccupancyGrid, field: DistanceField) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cells of the field that became obstacles, and that are none any more."""
    added, removed = [np.zeros((0, 2), dtype=np.int64)], [np.zeros((0, 2), dtype=np.int64)]
    for patch in grid.take_changes():
        row, col = patch.row0 + SIDE // 2, patch.col0 + SIDE // 2
        now = patch.cells >= 65
        was = field.obstacle[row : row + now.shape[0], col : col + now.shape[1]]
        added.append(np.argwhere(now & ~was) + (row, col))
        removed.append(np.argwhere(was & ~now) + (row, col))
    return np.concatenate(added), np.concatenate(removed)


def timed(work: Callable[[], object]) -> float:
    before = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - before)


def scratch(obstacle: NDArray[np.bool_], rounds: int, opencv: str | None) -> dict[str, float]:
    """Medians, contenders in turn."""
    times: dict[str, list[float]] = {"ours": [], "scipy": []}
    for number in range(rounds + 1):
        ours = timed(lambda: DistanceField(obstacle))
        scipy = timed(lambda: distance_transform_edt(~obstacle))
        if number > 0:
            times["ours"].append(ours)
            times["scipy"].append(scipy)
    if opencv is not None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "free.npy"
            np.save(file, (~obstacle).astype(np.uint8))
            said = subprocess.run(
                [opencv, "-c", OPENCV, str(file), str(rounds + 1)], check=True, capture_output=True, text=True
            )
            times["opencv"] = [float(line) for line in said.stdout.split()][1:]
    return {name: round(float(np.median(values)), 1) for name, values in times.items()}


def growth(rounds: int) -> list[dict[str, float]]:
    """From scratch for 1, 4 and 16 times the cells, a hundredth of them obstacles."""
    rng = np.random.default_rng(31)
    rows = []
    for side in (500, 1000, 2000):
        mask = rng.random((side, side)) < 0.01
        best = min(timed(lambda mask=mask: DistanceField(mask)) for _ in range(rounds + 1))  # type: ignore[misc]
        rows.append({"cells": float(side * side), "ms": round(best, 1)})
    return rows


def main() -> int:
    """Run, print, and say with the exit code whether the goals were met."""
    parser = argparse.ArgumentParser(description="Exact distances beside their peers.")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--opencv", help="a Python that has cv2")
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    options = parser.parse_args()
    rows, masks = [], {}
    for reach in (None, REACH_CELLS):
        warm = DistanceField(np.eye(8, dtype=np.bool_), reach_cells=reach)
        warm.update([(0, 1)], [(0, 0), (1, 1)])
        for place in ("office", "hall"):
            more, masks[place] = updates(place, reach)
            rows += more
    from_scratch = {place: scratch(mask, options.rounds, options.opencv) for place, mask in masks.items()}
    grown = growth(options.rounds)
    for row in rows:
        print(
            f"{row['place']:7} up to {row['reach_cells'] or 'any'} cells, pass {row['pass']}: "
            f"update {row['median_ms']} ms ({row['p10_ms']} to {row['p90_ms']}),"
            f" {row['cells_changed']} cells changed, {row['distances_looked_at']} distances"
        )
    for place, contenders in from_scratch.items():
        print(f"{place:7} from scratch: " + ", ".join(f"{name} {ms} ms" for name, ms in contenders.items()))
    print("from scratch, 1 % obstacles: " + ", ".join(f"{g['cells'] / 1e6:g} M cells {g['ms']} ms" for g in grown))
    if options.json is not None:
        options.json.write_text(
            json.dumps({"updates": rows, "scratch": from_scratch, "growth": grown}, indent=2) + "\n"
        )
    kept = all(row["median_ms"] <= UPDATE_GOAL_MS for row in rows)
    return 0 if kept and all(found["ours"] <= SCRATCH_GOAL_MS for found in from_scratch.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
