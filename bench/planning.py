"""Voronoi diagram, planner and grid A* on plans of 2,000 x 2,000 cells, in one run.

    python bench/planning.py [--pairs N] [--plan NAME] [--maps FOLDER] [--json FILE]

The plans are in plans.py; with --maps the PNG maps in a folder are taken instead (white is free, pixels of 5 cm). Times
are of the processor. Figures; those of the diagram are of the first plan:
scratch     distances, base points and diagram of the whole grid; scikit-image's medial axis beside it, if installed
update      after one scan has changed some hundreds of cells up to 10 m around a place
graph       thinning the diagram and following its lines: makes a planner warm
corners     what is made once for a clearance, on the graph
plan        from a free place to another anywhere on the plan, with 0.3 m of clearance; longest and median
A*          on the grid with the same cells allowed, eight neighbours, octile distance as bound, ended where the goal
            is taken from the heap; compiled, with work arrays kept from call to call
in turn     a plan and an A* of each pair in turn, each with the caches full of what the other has read; otherwise all
            pairs are planned one after the other, then all are searched, three times over, and medians are taken of
            each pair
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.plans import CELL_M, PLANS, SIDE, Bools, hall_of_boxes
from mapping.hybrid.planner import HALF_CELLS, NoWayError, Planner, graph_of
from mapping.hybrid.voronoi import VoronoiGrid
from mapping.kernels.paths import pop, push

CLEARANCE_M = 0.3
ROUNDS = 3


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
        started = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - started))
    return float(np.median(times))


def each_ms(
    work: Callable[[tuple[int, int], tuple[int, int]], float], ends: list[tuple[tuple[int, int], tuple[int, int]]]
) -> list[float]:
    """Milliseconds of each pair, one after the other."""
    times = []
    for start, goal in ends:
        started = time.process_time()
        work(start, goal)
        times.append(1e3 * (time.process_time() - started))
    return times


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
        started = time.process_time()
        grid.set_cells(cells[blocked], cells[~blocked])
        times.append(1e3 * (time.process_time() - started))
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
    started = time.process_time()
    planner.ready_for(CLEARANCE_M)
    corners_ms = 1e3 * (time.process_time() - started)
    random = np.random.default_rng(2)
    room = np.argwhere(grid.field.squared >= math.ceil((CLEARANCE_M / CELL_M + HALF_CELLS) ** 2))
    ends: list[tuple[tuple[int, int], tuple[int, int]]] = []
    lengths: list[tuple[float, float]] = []
    in_turn: list[tuple[float, float]] = []
    missed = 0

    def plan(start: tuple[int, int], goal: tuple[int, int]) -> float:
        places = [((c + 0.5) * CELL_M, (r + 0.5) * CELL_M) for r, c in (start, goal)]
        try:
            return planner.plan(places[0], places[1], clearance_m=CLEARANCE_M, alternatives=0).way.length_m
        except NoWayError:
            return math.inf

    while len(ends) < pairs:
        start, goal = ((int(room[i, 0]), int(room[i, 1])) for i in random.integers(len(room), size=2))
        started = time.process_time()
        length = plan(start, goal)
        middle = time.process_time()
        reference = a_star.length(start, goal)
        ended = time.process_time()
        missed += math.isinf(length) != math.isinf(reference)
        if math.isfinite(length) and math.isfinite(reference):
            ends.append((start, goal))
            lengths.append((length, reference))
            in_turn.append((1e3 * (middle - started), 1e3 * (ended - middle)))
    alone = np.array([[each_ms(work, ends) for work in (plan, a_star.length)] for _ in range(ROUNDS)])
    table = np.concatenate((np.median(alone, axis=0).T, lengths), axis=1)
    turns = np.array(in_turn[3:])
    ratio = table[:, 2] / np.maximum(table[:, 3], CELL_M)
    return {
        "corners_ms": corners_ms,
        "in_turn_plan_ms": float(np.median(turns[:, 0])), "in_turn_a_star_ms": float(np.median(turns[:, 1])),
        "in_turn_times_faster": float(np.median(turns[:, 1] / turns[:, 0])),
        "in_turn_times_faster_in_all": float(turns[:, 1].sum() / turns[:, 0].sum()),
        "plan_ms": float(np.median(table[:, 0])), "plan_most_ms": float(table[:, 0].max()),
        "a_star_ms": float(np.median(table[:, 1])), "times_faster": float(np.median(table[:, 1] / table[:, 0])),
        "times_faster_in_all": float(table[:, 1].sum() / table[:, 0].sum()), "longer_mean": float(ratio.mean() - 1.0),
        "longer_99": float(np.percentile(ratio, 99) - 1.0), "longer_most": float(ratio.max() - 1.0),
        "share_above_3_percent": float(np.mean(ratio > 1.03)),
        "length_m": float(np.median(table[:, 3])), "found_by_one_only": float(missed),
    }  # fmt: skip


def maps_in(folder: Path) -> dict[str, Callable[[], Bools]]:
    """By name, those of a folder but for pictures of rooms."""

    def reader(path: Path) -> Callable[[], Bools]:
        return lambda: np.asarray(np.asarray(Image.open(path).convert("L")) >= 250)

    return {p.stem: reader(p) for p in sorted(folder.glob("*.png")) if not p.stem.endswith(".rooms")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--plan", help="this one only")
    parser.add_argument("--maps", type=Path, help="a folder of PNG maps instead")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    warm = Planner(VoronoiGrid(hall_of_boxes(side=400, boxes=100)), CELL_M)  # compiles
    warm.plan((2.0, 2.0), (18.0, 18.0), alternatives=0)
    wall = np.pad(np.ones((98, 98), dtype=np.bool_), 1)
    wall[49, 1:90] = False
    Planner(VoronoiGrid(wall), CELL_M).plan((0.5, 2.0), (0.5, 3.0), alternatives=2)  # also what near ends need
    figures: dict[str, dict[str, float]] = {}
    plans = PLANS if arguments.maps is None else maps_in(arguments.maps)
    for name in [arguments.plan] if arguments.plan else list(plans):
        free = plans[name]()
        figures[name] = {
            **(diagram_figures(free) if name == next(iter(PLANS)) else {}),
            **planning_figures(free, arguments.pairs),
        }
        print(name)
        for what, value in figures[name].items():
            print(f"  {what:24} {value:.4g}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
