"""The Voronoi diagram of a grid against its literal definition, and after changes against a new start."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from mapping.hybrid.voronoi import VoronoiGrid
from mapping.kernels.clearance import FAR

Bools = NDArray[np.bool_]


@st.composite
def grids(draw: st.DrawFn) -> Bools:
    """Free cells of small grids, from nearly empty to nearly full."""
    rows, cols = draw(st.integers(3, 18)), draw(st.integers(3, 18))
    share = draw(st.sampled_from((0.0, 0.03, 0.2, 0.6, 1.0)))
    return np.random.default_rng(draw(st.integers(0, 2**20))).random((rows, cols)) >= share


def literal_axis(grid: VoronoiGrid) -> Bools:
    """A cell is on the diagram if, for a neighbour whose base point is more than the gap from its own, the point
    midway is no nearer to its own base point than to the neighbour's."""
    free, site = grid.free, grid.field.site
    rows, cols = free.shape
    axis = np.zeros(free.shape, dtype=np.bool_)
    for r, c in np.argwhere(free):
        own = np.array([site[r, c] >> 16, site[r, c] & 0xFFFF])
        for rr, cc in ((r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)):
            if not (0 <= rr < rows and 0 <= cc < cols and free[rr, cc]):
                continue
            other = np.array([site[rr, cc] >> 16, site[rr, cc] & 0xFFFF])
            midway = np.array([r + rr, c + cc]) / 2
            if np.hypot(*(own - other)) > grid.gap_cells and np.hypot(*(midway - own)) >= np.hypot(*(midway - other)):
                axis[r, c] = True
    return axis


@settings(max_examples=60, deadline=None)
@given(free=grids(), gap_cells=st.sampled_from((0.0, 1.0, 3.0)))
def test_distances_base_points_and_diagram_are_those_of_the_definition(free: Bools, gap_cells: float) -> None:
    grid = VoronoiGrid(free, gap_cells=gap_cells)
    inside = np.zeros(free.shape, dtype=np.bool_)
    inside[1:-1, 1:-1] = free[1:-1, 1:-1]
    assert np.array_equal(grid.free, inside)
    expected = ndimage.distance_transform_edt(inside)
    assert np.array_equal(grid.field.squared, np.rint(expected * expected))
    assert (grid.field.squared < FAR).all()
    assert np.array_equal(grid.axis, literal_axis(grid))


@settings(max_examples=60, deadline=None)
@given(free=grids(), seed=st.integers(0, 2**20))
def test_after_changes_it_is_what_a_new_start_gives(free: Bools, seed: int) -> None:
    random = np.random.default_rng(seed)
    grid = VoronoiGrid(free, gap_cells=2.0)
    for _ in range(4):
        free = np.where(
            random.random(free.shape) < random.choice((0.02, 0.2, 1.0)), random.random(free.shape) < 0.7, free
        )
        grid.update(free)
        anew = VoronoiGrid(free, gap_cells=2.0)
        assert np.array_equal(grid.field.squared, anew.field.squared)
        assert np.array_equal(grid.field.site, anew.field.site)
        assert np.array_equal(grid.axis, anew.axis)


def test_a_change_is_looked_at_only_nearby() -> None:
    free = np.ones((200, 200), dtype=np.bool_)
    free[::20], free[:, ::20] = False, False
    grid = VoronoiGrid(free)
    looked = grid.set_cells([[110, 110]], [])
    assert 0 < looked < 1000
    assert not grid.free[110, 110]


def test_the_border_stays_an_obstacle() -> None:
    grid = VoronoiGrid(np.ones((9, 9), dtype=np.bool_))
    assert grid.set_cells([], [[0, 4], [8, 8], [4, 0]]) == 0
    assert grid.field.squared[4, 4] == 16


def test_bad_grids_are_refused() -> None:
    with pytest.raises(ValueError, match="sides of 3"):
        VoronoiGrid(np.ones((2, 9), dtype=np.bool_))
    with pytest.raises(ValueError, match="gap_cells"):
        VoronoiGrid(np.ones((9, 9), dtype=np.bool_), gap_cells=-1.0)
    with pytest.raises(ValueError, match="shape"):
        VoronoiGrid(np.ones((9, 9), dtype=np.bool_)).update(np.ones((9, 8), dtype=np.bool_))
