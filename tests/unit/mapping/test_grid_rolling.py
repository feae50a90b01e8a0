"""The robot-centred grid: same cells as the map-fixed one, as long as they stay in the window (S26, S27)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.rolling import RollingGrid
from mapping.grids.tiles import Window

BEARING = np.radians(np.arange(-135.0, 135.1, 1.0))
D = 0.1
STEP = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-3.0, 3.0), st.integers(0, 1000))


def scan_of(seed: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.3, 6.0, BEARING.size)
    strange = rng.choice([np.inf, np.nan, -np.inf], BEARING.size)
    return np.asarray(np.where(rng.random(BEARING.size) < 0.1, strange, ranges), dtype=np.float64)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(STEP, min_size=1, max_size=8), st.sampled_from([0.7, 3.0, 12.8, 15.0]))
def test_cells_that_never_left_the_window_are_those_of_an_unbounded_grid(
    steps: list[tuple[float, float, float, int]], side_m: float
) -> None:
    """A literal window: forget outside after each move, by the window's rectangle, cell by cell."""
    rolling = RollingGrid(side_m=side_m, resolution_m=D)
    cells: dict[tuple[int, int], list[int]] = {}
    x = y = 0.0
    for dx, dy, yaw, seed in steps:
        x, y = x + dx, y + dy
        rolling.centre_on(x, y)
        window = rolling.window
        cells = {k: v for k, v in cells.items() if inside(k, window)}
        pose = Pose2(x, y, yaw)
        alone = OccupancyGrid(resolution_m=D)
        alone.insert_scan(pose, BEARING, scan_of(seed), range_max_m=6.0)
        patch = alone.patch()
        for row, col in np.argwhere(patch.cells >= 0):
            key = (int(row) + patch.row0, int(col) + patch.col0)
            if inside(key, window):
                count = cells.setdefault(key, [0, 0])
                count[0 if patch.cells[row, col] == 100 else 1] += 1
        rolling.insert_scan(pose, BEARING, scan_of(seed), range_max_m=6.0)
        expected = np.full((window.row1 - window.row0, window.col1 - window.col0), -1.0)
        for (row, col), (hits, misses) in cells.items():
            expected[row - window.row0, col - window.col0] = np.rint(100.0 * hits / (hits + misses))
        seen = rolling.patch()
        assert (seen.row0, seen.col0) == (window.row0, window.col0)
        assert np.array_equal(seen.cells, expected)
        assert rolling.refused_tiles == 0


def inside(cell: tuple[int, int], window: Window) -> bool:
    return window.row0 <= cell[0] < window.row1 and window.col0 <= cell[1] < window.col1


@given(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5), st.sampled_from([0.1, 1.0, 9.9, 10.0]))
@settings(max_examples=40, deadline=None)
def test_the_window_is_around_its_centre_and_keeps_its_size(x: float, y: float, side_m: float) -> None:
    grid = RollingGrid(side_m=side_m)
    shape = grid.patch().cells.shape
    grid.centre_on(x, y)
    window = grid.window
    row, col = grid.cell_at(x, y)
    assert window.row0 <= row < window.row1
    assert window.col0 <= col < window.col1
    assert abs((window.row0 + window.row1) / 2 - row) <= 1
    assert grid.patch().cells.shape == shape == (round(side_m / 0.05), round(side_m / 0.05))


def test_memory_does_not_grow_and_scans_outside_write_nothing() -> None:
    grid = RollingGrid(side_m=5.0)
    full = np.full(BEARING.size, 10.0)
    for k in range(200):
        grid.centre_on(0.37 * k, -0.21 * k)
        grid.insert_scan(Pose2(0.37 * k, -0.21 * k, 0.1 * k), BEARING, full, range_max_m=30.0)
    assert grid.refused_tiles == 0
    before = grid.patch().cells
    grid.insert_scan(Pose2(-500.0, 0.0), BEARING, full, range_max_m=30.0)
    grid.insert_cells([(10_000, 10_000)], [(-10_000, 0)])
    assert np.array_equal(grid.patch().cells, before)
    assert grid.refused_insertions == 0


def test_sonar_cones_are_forgotten_with_the_window() -> None:
    grid = RollingGrid(side_m=4.0)
    grid.insert_cone(Pose2(), 1.0, cone_rad=0.5, range_max_m=3.0)
    assert np.any(grid.patch().cells >= 0)
    grid.centre_on(0.0, 2.5)
    grid.centre_on(0.0, 0.0)
    assert np.all(grid.patch().cells[:70] == -1)
    grid.centre_on(100.0, 0.0)
    grid.centre_on(0.0, 0.0)
    assert np.all(grid.patch().cells == -1)


@pytest.mark.parametrize("side_m", [0.0, -1.0, math.nan, 1e6])
def test_windows_without_a_size_are_refused(side_m: float) -> None:
    with pytest.raises(ValueError, match="side_m"):
        RollingGrid(side_m=side_m)


def test_a_place_that_is_none_is_refused() -> None:
    grid = RollingGrid()
    with pytest.raises(ValueError, match="position"):
        grid.centre_on(math.nan, 0.0)
