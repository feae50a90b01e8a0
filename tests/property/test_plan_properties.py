"""What holds for a plan on any grid: only free cells with the clearance are crossed, and there is a way if and only if
the grid joins the ends."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from mapping.hybrid.planner import HALF_CELLS, NoWayError, Planner, Way
from mapping.hybrid.voronoi import VoronoiGrid

CELL_M = 0.05
UNKNOWN, FREE, OCCUPIED = range(3)


def drawn(seed: int) -> NDArray[np.int64]:
    """A grid of free, occupied and unknown cells: boxes, walls with gaps, blots that nobody has seen."""
    random = np.random.default_rng(seed)
    rows, cols = (int(v) for v in random.integers(20, 90, size=2))
    grid = np.full((rows, cols), FREE)
    for kind, count in ((OCCUPIED, random.integers(0, 14)), (UNKNOWN, random.integers(0, 6))):
        for _ in range(int(count)):
            r, c = random.integers(0, rows), random.integers(0, cols)
            height, width = random.integers(1, 4 if random.random() < 0.5 else 20, size=2)
            grid[r : r + height, c : c + width] = kind
    if random.random() < 0.6:
        wall = int(random.integers(5, cols - 5))
        grid[:, wall] = OCCUPIED
        if random.random() < 0.7:
            gap = int(random.integers(1, rows - 12))
            grid[gap : gap + int(random.integers(1, 12)), wall] = FREE
    return grid


def check(way: Way, grid: NDArray[np.int64], clearance_m: float) -> None:
    """Points every tenth of a cell along the way, against the squares of cells that are not free."""
    blocked = np.argwhere(np.pad(grid, 1, constant_values=UNKNOWN) != FREE) - 1
    points = [way.poses[:1, :2]]
    for a, b in zip(way.poses[:-1, :2], way.poses[1:, :2]):
        steps = 1 + math.ceil(10.0 * math.dist(a, b) / CELL_M)
        points.append(a + np.linspace(0.0, 1.0, steps + 1)[1:, None] * (b - a))
    at = np.concatenate(points)[:, None, ::-1] / CELL_M - 0.5
    beyond = np.maximum(np.abs(at - blocked) - 0.5, 0.0)
    assert CELL_M * np.hypot(beyond[..., 0], beyond[..., 1]).min() >= max(clearance_m, way.least_clearance_m) - 1e-9


@given(st.integers(0, 2**32), st.sampled_from([0.0, 0.03, 0.1, 0.2, 0.35]), st.integers(0, 2), st.booleans())
@settings(max_examples=150, deadline=None)
def test_plans_cross_only_what_is_free_enough(seed: int, clearance_m: float, others: int, on_borders: bool) -> None:
    grid = drawn(seed)
    voronoi = VoronoiGrid(grid == FREE)
    planner = Planner(voronoi, CELL_M)
    planner.ready_for(clearance_m)
    open_ = voronoi.field.squared >= (clearance_m / CELL_M + HALF_CELLS) ** 2
    part, _ = ndimage.label(open_, np.ones((3, 3)))
    random = np.random.default_rng(seed)
    for _ in range(6):
        # Ends anywhere, some of them in walls; on the borders of cells, too, as round numbers are.
        ends = random.uniform(0.0, 1.0, (2, 2)) * grid.shape
        ends = np.floor(ends) if on_borders else ends
        places = [(float(c) * CELL_M, float(r) * CELL_M) for r, c in ends]
        cells = [tuple(np.minimum(np.floor(np.array(p[::-1]) / CELL_M + 1e-12), np.array(grid.shape) - 1).astype(int))
                 for p in places]  # fmt: skip
        try:
            plan = planner.plan(places[0], places[1], clearance_m=clearance_m, alternatives=others)
        except NoWayError as refused:
            if "no way" in str(refused):
                assert part[cells[0]] != part[cells[1]]
            continue
        assert len(plan.alternatives) <= others
        for way in (plan.way, *plan.alternatives):
            check(way, grid, clearance_m)
            assert way.poses[0, :2] == pytest.approx(places[0])
            assert way.poses[-1, :2] == pytest.approx(places[1])
            assert way.length_m >= math.dist(*places) - 1e-9


@given(st.integers(0, 2**32), st.sampled_from([0.0, 0.1, 0.3]))
@settings(max_examples=40, deadline=None)
def test_nothing_leads_through_a_wall_or_where_nobody_has_seen(seed: int, clearance_m: float) -> None:
    random = np.random.default_rng(seed)
    free = np.ones((60, 80), dtype=np.bool_)
    free[:, int(random.integers(25, 50))] = False  # a cell wide, occupied or unknown
    planner = Planner(VoronoiGrid(free), CELL_M)
    for others in (0, 2):
        with pytest.raises(NoWayError, match="no way"):
            planner.plan((0.6, 1.0), (3.4, 2.0), clearance_m=clearance_m, alternatives=others)
