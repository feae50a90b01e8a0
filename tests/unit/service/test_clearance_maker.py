"""The clearance layer of the live grid: against scipy, kept up to date, never too far."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from mapping.grids.patch import GridPatch
from service import assemble_makers
from service.clearance_maker import ClearanceMaker
from service.config import Config
from service.map_makers import MapView, Rect
from service.outputs import GridOut
from service.payloads import Encoder

CELL_M, REACH_M = 0.05, 2.0
Cells = NDArray[np.int8]


def random_cells(seed: int, shape: tuple[int, int] = (60, 90)) -> Cells:
    rng = np.random.default_rng(seed)
    return rng.choice(
        np.array([-1, 0, 30, 63, 64, 100], dtype=np.int8), size=shape, p=[0.3, 0.6, 0.08, 0.01, 0.005, 0.005]
    )


def grid(cells: Cells, row0: int = -7, col0: int = 11) -> GridPatch:
    return GridPatch(CELL_M, row0, col0, cells)


def everything(patch: GridPatch) -> Rect:
    return Rect(patch.row0, patch.col0, *patch.cells.shape)


def told(maker: ClearanceMaker, patch: GridPatch, *changed: Rect) -> GridOut:
    (output,) = maker.make(MapView(3, patch, changed or (everything(patch),), None))
    assert isinstance(output, GridOut)
    assert (output.name, output.frame) == ("clearance", "map")
    return output


def expected(patch: GridPatch, *, unknown_is_obstacle: bool = False) -> Cells:
    """Literally: the distance to the nearest obstacle, as a share of the reach."""
    wide = np.pad(patch.cells, 1, constant_values=-1)
    obstacle = (wide >= 64) | ((wide < 0) & unknown_is_obstacle)
    distance_m = CELL_M * distance_transform_edt(~obstacle)[1:-1, 1:-1]
    cost = np.ceil(np.round(100.0 * (1.0 - distance_m / REACH_M), 9)).clip(0, 100)
    return np.where(patch.cells < 0, -1, cost).astype(np.int8)


def in_frame(output: GridOut, patch: GridPatch) -> Cells:
    """The told cells laid into the grid's rectangle."""
    whole = np.full(patch.cells.shape, -1, dtype=np.int8)
    row, col = output.patch.row0 - patch.row0, output.patch.col0 - patch.col0
    rows, cols = output.patch.cells.shape
    whole[row : row + rows, col : col + cols] = output.patch.cells
    return whole


@pytest.mark.parametrize("unknown_is_obstacle", [False, True])
def test_costs_are_those_of_the_exact_distances(unknown_is_obstacle: bool) -> None:
    patch = grid(random_cells(1))
    patch.cells[10:40, 10:60] = np.where(patch.cells[10:40, 10:60] >= 64, 100, 0)
    maker = ClearanceMaker(reach_m=REACH_M, unknown_is_obstacle=unknown_is_obstacle)
    want = expected(patch, unknown_is_obstacle=unknown_is_obstacle)
    np.testing.assert_array_equal(in_frame(told(maker, patch), patch), want)


def test_a_distance_taken_back_from_its_cost_is_never_too_far_and_hardly_too_near() -> None:
    patch = grid(random_cells(2))
    obstacle = patch.cells >= 64
    distance_m = CELL_M * distance_transform_edt(~obstacle)
    cost = in_frame(told(ClearanceMaker(reach_m=REACH_M), patch), patch)
    back_m = (1.0 - cost / 100.0) * REACH_M
    known = patch.cells >= 0
    assert (back_m[known] <= distance_m[known] + 1e-9).all()
    near = known & (distance_m < REACH_M)
    assert (back_m[near] > distance_m[near] - REACH_M / 100.0 - 1e-9).all()


def test_changes_give_what_a_new_map_gives() -> None:
    rng = np.random.default_rng(4)
    patch = grid(random_cells(3))
    maker = ClearanceMaker(reach_m=REACH_M)
    told(maker, patch)
    for number in range(20):
        row, col = int(rng.integers(0, 50)), int(rng.integers(0, 80))
        part = np.s_[row : row + 8, col : col + 10]
        patch.cells[part] = random_cells(10 + number)[part]
        rows, cols = patch.cells[part].shape
        output = told(maker, patch, Rect(patch.row0 + row, patch.col0 + col, rows, cols))
        np.testing.assert_array_equal(in_frame(output, patch), expected(patch))
    grown = grid(np.pad(patch.cells, 5, constant_values=0), patch.row0 - 5, patch.col0 - 5)
    np.testing.assert_array_equal(in_frame(told(maker, grown), grown), expected(grown))
    np.testing.assert_array_equal(in_frame(told(maker, patch), patch), expected(patch))


@pytest.mark.parametrize("unknown_is_obstacle", [False, True])
def test_parts_that_reach_out_of_the_grid_or_lie_over_each_other(unknown_is_obstacle: bool) -> None:
    """What changed may be told of in any rectangles that cover it."""
    rng = np.random.default_rng(6)
    patch = grid(random_cells(7))
    maker = ClearanceMaker(reach_m=REACH_M, unknown_is_obstacle=unknown_is_obstacle)
    told(maker, patch)
    for number in range(20):
        part = np.s_[0 : int(rng.integers(1, 60)), int(rng.integers(0, 90)) :]
        patch.cells[part] = random_cells(40 + number)[part]
        rows, cols = patch.cells[part].shape
        end = patch.col0 + 90
        changed = [Rect(patch.row0 - 9, end - cols, rows + 9, cols + 5), Rect(patch.row0, end - cols, rows, cols)]
        changed += [Rect(patch.row0 - 20, patch.col0, 9, 9), Rect(patch.row0, patch.col0 - 30, 9, 9)]
        changed += [Rect(patch.row0 + 70, patch.col0, 9, 9), Rect(patch.row0, end + 3, 9, 9)]
        output = told(maker, patch, *changed)
        want = expected(patch, unknown_is_obstacle=unknown_is_obstacle)
        np.testing.assert_array_equal(in_frame(output, patch), want)


def test_it_is_cut_to_what_is_known_and_nothing_is_told_without_a_change() -> None:
    cells = np.full((128, 128), -1, dtype=np.int8)
    cells[40:60, 30:90] = 0
    patch = grid(cells)
    maker = ClearanceMaker()
    output = told(maker, patch)
    assert output.patch.cells.shape == (20, 60)
    assert (output.patch.row0, output.patch.col0) == (33, 41)
    assert not output.patch.cells.any(), "no obstacle anywhere: as far as it goes"
    assert maker.make(MapView(4, patch, (), None)) == []
    assert maker.make(MapView(4, None, (), None)) == []
    cells[...] = -1
    assert (told(maker, patch).patch.cells == -1).all()


def test_it_travels_as_an_occupancy_grid() -> None:
    (message,) = Encoder().encode(told(ClearanceMaker(), grid(random_cells(5))), 0)
    assert (message.suffix, message.topic.payload) == ("map/clearance", "nav_msgs/msg/OccupancyGrid")


def test_a_large_map_is_told_less_often() -> None:
    maker = ClearanceMaker()
    assert maker.period_ns == 1_000_000_000
    told(maker, grid(np.zeros((1500, 1500), dtype=np.int8)))
    assert maker.period_ns > 2_000_000_000


def test_it_is_there_if_configured_and_if_there_is_a_grid() -> None:
    for data, is_there in (
        ({}, False),
        ({"clearance": {"enabled": True}}, True),
        ({"clearance": {"enabled": True}, "grid": {"enabled": False}}, False),
    ):
        config = Config.model_validate(data)
        assert ("clearance" in {maker.name for maker in assemble_makers.map_makers(config, {})}) is is_there
    with pytest.raises(ValueError, match="length above 0"):
        ClearanceMaker(reach_m=0.0)
