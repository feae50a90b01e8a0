"""A grid seen through walls, any walls and cells: nothing is freer, nothing is lost, and subscribers agree (S27)."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.evidence import Model
from mapping.grids.occupancy import BY_A_WALL_CELLS, WALL_FROM_PERCENT, OccupancyGrid
from mapping.grids.patch import GridPatch
from mapping.grids.tiles import TILE
from service.live_map import occupancy_of
from service.store import occupancy_tiles

Cells = NDArray[np.int8]
OCCUPIED, FREE = 65, 25


@st.composite
def drawn(draw: st.DrawFn) -> tuple[OccupancyGrid, np.random.Generator]:
    """A grid with any evidence of lasers and sonars about tile (0, 0) and its neighbours."""
    model: Model = draw(st.sampled_from(["counters", "log-odds"]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    grid = OccupancyGrid(model=model)
    more(grid, rng)
    if draw(st.booleans()):
        for _ in range(20):
            pose = Pose2(float(rng.uniform(0.0, 6.0)), float(rng.uniform(0.0, 6.0)), float(rng.uniform(-3.0, 3.0)))
            grid.insert_cone(pose, float(rng.uniform(0.2, 2.0)), cone_rad=math.radians(30.0), range_max_m=3.0)
    return grid, rng


def more(grid: OccupancyGrid, rng: np.random.Generator) -> None:
    for _ in range(int(rng.integers(1, 12))):
        hits, misses = (rng.integers(-10, TILE + 10, (int(rng.integers(0, 300)), 2)) // 2 * 2 for _ in range(2))
        grid.insert_cells(hits, misses)


def walls_at(rng: np.random.Generator) -> NDArray[np.uint8]:
    return np.asarray(rng.random((TILE, TILE)) < rng.choice([0.0, 0.02, 0.3, 1.0]), dtype=np.uint8)


def tile_of(patch: GridPatch) -> Cells:
    """Cells of tile (0, 0) in a patch of whole tiles."""
    return patch.cells[-patch.row0 : TILE - patch.row0, -patch.col0 : TILE - patch.col0]


@settings(max_examples=60, deadline=None)
@given(drawn())
def test_nothing_is_shown_freer_and_no_obstacle_goes_without_one_beside_it(
    grid_rng: tuple[OccupancyGrid, np.random.Generator],
) -> None:
    grid, rng = grid_rng
    if (0, 0) not in grid.places():
        return
    counted = grid.patch(whole_tiles=True)
    walls = walls_at(rng)
    grid.show_walls(0, 0, walls)
    patch = grid.patch(whole_tiles=True)
    around = patch.cells != counted.cells
    tile_of(GridPatch(0.05, patch.row0, patch.col0, around.view(np.int8)))[:] = 0
    assert not around.any()  # other tiles are as counted
    before, after = tile_of(counted), tile_of(patch)
    np.testing.assert_array_equal(after < 0, before < 0)
    lowered, raised = after < before, after > before
    assert np.all(before[lowered] >= OCCUPIED)
    assert np.all(after[lowered] == OCCUPIED - 1)
    assert np.all(before[raised] >= WALL_FROM_PERCENT)
    assert np.all(after[raised] == OCCUPIED)
    assert np.all(walls[raised] == 1)
    assert np.all(walls[lowered] == 0)
    for row, col in np.argwhere(lowered):
        part = (slice(max(0, k - BY_A_WALL_CELLS), k + BY_A_WALL_CELLS + 1) for k in (row, col))
        assert np.any(after[tuple(part)] >= OCCUPIED)


@settings(max_examples=40, deadline=None)
@given(drawn())
def test_whole_grids_and_updates_and_what_is_stored_agree(
    grid_rng: tuple[OccupancyGrid, np.random.Generator],
) -> None:
    grid, rng = grid_rng
    mirror = np.full((4 * TILE, 4 * TILE), -1, dtype=np.int8)
    for _ in range(4):
        if rng.random() < 0.7:
            grid.show_walls(int(rng.integers(-1, 2)), int(rng.integers(-1, 2)), walls_at(rng))
        if rng.random() < 0.7:
            more(grid, rng)
        for change in grid.take_changes():
            row, col = change.row0 + 2 * TILE, change.col0 + 2 * TILE
            rows, cols = change.cells.shape
            mirror[row : row + rows, col : col + cols] = change.cells
        patch = grid.patch(whole_tiles=True)
        row, col = patch.row0 + 2 * TILE, patch.col0 + 2 * TILE
        rows, cols = patch.cells.shape
        np.testing.assert_array_equal(mirror[row : row + rows, col : col + cols], patch.cells)
    stored = occupancy_of(grid.changed_tiles())
    shown = {(r, c): payload for r, c, payload in occupancy_tiles(grid.patch(whole_tiles=True), TILE)}
    assert {(r, c): payload for r, c, payload in stored if (r, c) in shown} == shown


@settings(max_examples=30, deadline=None)
@given(drawn())
def test_walls_last_until_the_tile_is_another(grid_rng: tuple[OccupancyGrid, np.random.Generator]) -> None:
    grid, rng = grid_rng
    counted = grid.patch(whole_tiles=True)
    tiles = list(grid.tiles())
    for way in ("none", "load", "take"):
        for place in grid.places():
            grid.show_walls(*place, walls_at(rng))
        if way == "none":
            for place in grid.places():
                grid.show_walls(*place, None)
        elif way == "load":
            for row, col, payload in tiles:
                grid.load_tile(row, col, payload)
        else:
            other = grid.empty_copy()
            for row, col, payload in tiles:
                other.load_tile(row, col, payload)
            grid.take_tiles(other, other.places())
        np.testing.assert_array_equal(grid.patch(whole_tiles=True).cells, counted.cells)
    for forget in (grid.clear, grid.start_anew):
        grid.insert_cells([(0, 0)], np.zeros((0, 2), dtype=np.int64))
        for place in grid.places():
            grid.show_walls(*place, np.eye(TILE, dtype=np.uint8))
        forget()
        grid.insert_cells([(0, 1)], np.zeros((0, 2), dtype=np.int64))
        assert grid.patch(whole_tiles=True).cells.max() >= OCCUPIED  # (0, 0) would be a wall beside it
