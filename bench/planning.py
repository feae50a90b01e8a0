"""Voronoi diagram, planner and grid A* on a plan of 2,000 x 2,000 cells, in one run.

    python bench/planning.py [--pairs N] [--json FILE]

The plan is an office of corridors and furnished rooms, 100 m square in cells of 5 cm (made here, seed 7). Figures:
scratch     distances, base points and diagram of the whole grid; scikit-image's medial axis beside it, if installed
update      after one scan has changed some hundreds of cells up to 10 m around a place
graph       thinning the diagram and following its lines: makes a planner warm
plan        from a free place to another anywhere on the plan, with 0.3 m of clearance; longest and median
A*          on the grid with the same cells allowed, eight neighbours, straight distance as bound; compiled, with
            work arrays kept from call to call
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.hybrid.planner import HALF_CELLS, NoWayError, Planner, graph_of
from mapping.hybrid.voronoi import VoronoiGrid
from mapping.kernels.paths import pop, push

CELL_M = 0.05
SIDE = 2000
CLEARANCE_M = 0.3

Bools = NDArray[np.bool_]
F64 = NDArray[np.float64]


def office(seed: int = 7, side: int = SIDE) -> Bools:
    """Free cells: corridors 2.5 m wide every 17.5 m both ways, between them rooms with doors and furniture."""
    random = np.random.default_rng(seed)
    free = np.zeros((side, side), dtype=np.bool_)
    pitch, wide = 350, 50
    starts = range(10, side - wide, pitch)
    for at in starts:
        free[at : at + wide, 10 : side - 10] = True
        free[10 : side - 10, at : at + wide] = True
    for top in (at + wide + 4 for at in starts):
        for left in (at + wide + 4 for at in starts):
            bottom, right = min(top + pitch - wide - 8, side - 10), min(left + pitch - wide - 8, side - 10)
            _block(free, random, top, left, bottom, right)
    return free


def _block(free: Bools, random: np.random.Generator, top: int, left: int, bottom: int, right: int) -> None:
    """Four to nine rooms in a rectangle, doors of a metre to the corridors and to each other."""
    rows = np.linspace(top, bottom, int(random.integers(3, 5))).astype(int)
    cols = np.linspace(left, right, int(random.integers(3, 5))).astype(int)
    for r0, r1 in pairwise(rows):
        for c0, c1 in pairwise(cols):
            if r1 - r0 < 40 or c1 - c0 < 40:
                continue
            free[r0 + 2 : r1 - 2, c0 + 2 : c1 - 2] = True
            for _ in range(int((r1 - r0) * (c1 - c0) / 1500)):
                r, c = random.integers(r0 + 25, r1 - 25), random.integers(c0 + 25, c1 - 25)
                free[r : r + random.integers(1, 9), c : c + random.integers(1, 9)] = False
            for _ in range(2):
                if random.random() < 0.5:
                    at, edge = random.integers(c0 + 4, c1 - 26), (r0, r1)[random.integers(2)]
                    free[max(edge - 6, 10) : edge + 6, at : at + 20] = True
                else:
                    at, edge = random.integers(r0 + 4, r1 - 26), (c0, c1)[random.integers(2)]
                    free[at : at + 20, max(edge - 6, 10) : edge + 6] = True


@njit(cache=True, nogil=True)
def grid_a_star(
    squared: Any, need2: int, start: int, goal: int, best: Any, state: Any, stamp: int, heap: Any, key: Any
) -> float:
    """Length in cells of the shortest way of steps to the eight neighbours; inf if there is none.

    best (R, C) float64, state (R, C) int32, heap, key: work, kept from call to call, so that none pays for fresh
    memory; states of this search are stamp and stamp + 1, all others less.
    """
    rows, cols = squared.shape
    met, done = stamp, stamp + 1
    size = np.zeros(1, dtype=np.int64)
    gr, gc = goal // cols, goal % cols
    best[start // cols, start % cols] = 0.0
    state[start // cols, start % cols] = met
    push(heap, key, size, 0.0, start)
    while size[0] > 0:
        cell = pop(heap, key, size)
        r, c = cell // cols, cell % cols
        if cell == goal:
            return float(best[r, c])
        if state[r, c] == done:
            continue
        state[r, c] = done
        here = best[r, c]
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                rr, cc = r + dr, c + dc
                if (dr == 0 and dc == 0) or rr < 0 or rr >= rows or cc < 0 or cc >= cols:
                    continue
                if squared[rr, cc] < need2 or state[rr, cc] == done:
                    continue
                reached = here + (1.4142135623730951 if dr != 0 and dc != 0 else 1.0)
                if state[rr, cc] != met or reached < best[rr, cc] - 1e-9:
                    best[rr, cc] = reached
                    state[rr, cc] = met
                    straight, across = abs(rr - gr), abs(cc - gc)
                    bound = max(straight, across) + 0.4142135623730951 * min(straight, across)
                    push(heap, key, size, reached + bound, rr * cols + cc)
    return math.inf


class GridAStar:
    """Ways on the grid over the cells that a Planner may use."""

    def __init__(self, grid: VoronoiGrid, clearance_m: float) -> None:
        self._grid, self._need2 = grid, math.ceil((clearance_m / CELL_M + HALF_CELLS) ** 2)
        self._best, self._state = np.zeros(grid.shape), np.zeros(grid.shape, dtype=np.int32)
        most = 2 * self._best.size
        self._heap, self._key = np.zeros(most, dtype=np.int32), np.zeros(most)
        self._stamp = 1

    def length(self, start: tuple[int, int], goal: tuple[int, int]) -> float:
        """Metres."""
        cols = self._grid.shape[1]
        self._stamp += 2
        return CELL_M * float(
            grid_a_star(
                self._grid.field.squared, self._need2, start[0] * cols + start[1], goal[0] * cols + goal[1],
                self._best, self._state, self._stamp, self._heap, self._key,
            )
        )  # fmt: skip


def timed(work: Any, rounds: int = 5) -> float:
    """Median milliseconds."""
    times = []
    for _ in range(rounds):
        started = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - started))
    return float(np.median(times))


def diagram_figures(free: Bools) -> dict[str, float]:
    """Times of the diagram."""
    grid = VoronoiGrid(free)
    figures = {"scratch_ms": timed(lambda: VoronoiGrid(free)), "graph_ms": timed(lambda: graph_of(grid))}
    random, times = np.random.default_rng(1), []
    places = np.argwhere(free)
    for _ in range(60):
        row, col = places[random.integers(len(places))]
        angle, reach = random.uniform(0.0, 2.0 * math.pi, 600), random.uniform(20, 200, 600)
        cells = np.stack((row + reach * np.sin(angle), col + reach * np.cos(angle)), axis=-1).astype(np.int64)
        cells = np.clip(cells, 1, SIDE - 2)
        blocked = random.random(600) < 0.5
        started = time.perf_counter()
        grid.set_cells(cells[blocked], cells[~blocked])
        times.append(1e3 * (time.perf_counter() - started))
    figures |= {"update_ms": float(np.median(times[5:])), "update_most_ms": max(times[5:])}
    try:
        medial_axis = importlib.import_module("skimage.morphology").medial_axis
    except ImportError:
        return figures
    return {**figures, "skimage_medial_axis_ms": timed(lambda: medial_axis(free, return_distance=True), 3)}


def planning_figures(free: Bools, pairs: int) -> dict[str, float]:
    """Planner against A*, over random pairs of places."""
    grid = VoronoiGrid(free)
    planner, a_star = Planner(grid, CELL_M), GridAStar(grid, CLEARANCE_M)
    random = np.random.default_rng(2)
    room = np.argwhere(grid.field.squared >= math.ceil((CLEARANCE_M / CELL_M + HALF_CELLS) ** 2))
    rows: list[tuple[float, float, float, float]] = []
    missed = tried = 0
    while len(rows) < pairs:
        start, goal = ((int(room[i, 0]), int(room[i, 1])) for i in random.integers(len(room), size=2))
        places = [((c + 0.5) * CELL_M, (r + 0.5) * CELL_M) for r, c in (start, goal)]
        tried += 1
        started = time.perf_counter()
        try:
            length = planner.plan(places[0], places[1], clearance_m=CLEARANCE_M, alternatives=0).way.length_m
        except NoWayError:
            length = math.inf
        middle = time.perf_counter()
        reference = a_star.length(start, goal)
        ended = time.perf_counter()
        if math.isinf(length) != math.isinf(reference):
            missed += 1
        if math.isfinite(length) and math.isfinite(reference) and tried > 3:
            rows.append((1e3 * (middle - started), 1e3 * (ended - middle), length, reference))
    table = np.array(rows)
    ratio = table[:, 2] / np.maximum(table[:, 3], CELL_M)
    return {
        "plan_ms": float(np.median(table[:, 0])), "plan_most_ms": float(table[:, 0].max()),
        "a_star_ms": float(np.median(table[:, 1])), "times_faster": float(np.median(table[:, 1] / table[:, 0])),
        "times_faster_in_all": float(table[:, 1].sum() / table[:, 0].sum()), "longer_mean": float(ratio.mean() - 1.0),
        "longer_99": float(np.percentile(ratio, 99) - 1.0), "longer_most": float(ratio.max() - 1.0),
        "share_above_3_percent": float(np.mean(ratio > 1.03)),
        "length_m": float(np.median(table[:, 3])), "found_by_one_only": float(missed),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    free = office()
    figures = {**diagram_figures(free), **planning_figures(free, arguments.pairs)}
    for name, value in figures.items():
        print(f"{name:24} {value:.4g}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
