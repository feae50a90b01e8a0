"""Position and cell on exact borders, in our convention and in the book's (S26)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping.grids.geometry import (
    MAX_CELL,
    book_tile_of,
    cell_of,
    cells_of,
    centre_of,
    centres_of,
    shift_to_book_frame,
)

RESOLUTIONS = st.sampled_from([0.05, 0.1, 0.025, 1.0, 0.0625, 0.03, 1 / 3, 7.0])
INDICES = st.integers(-(10**7), 10**7)


@given(INDICES, RESOLUTIONS)
def test_a_border_belongs_to_the_upper_cell_and_the_double_below_it_to_the_lower(i: int, d: float) -> None:
    border = i * d
    assert cell_of(border, d) == i
    assert cell_of(math.nextafter(border, -math.inf), d) == i - 1
    assert cell_of(math.nextafter(border, math.inf), d) == i


@given(st.floats(-1e6, 1e6), RESOLUTIONS)
def test_every_position_is_in_its_cell(x: float, d: float) -> None:
    i = int(cell_of(x, d))
    assert i * d <= x < (i + 1) * d


@given(INDICES, RESOLUTIONS)
def test_a_centre_is_in_its_cell(i: int, d: float) -> None:
    assert cell_of(centre_of(i, d), d) == i


@given(INDICES, RESOLUTIONS)
def test_book_tiles_own_their_upper_border_not_their_lower(i: int, d: float) -> None:
    """x_i - d/2 < x <= x_i + d/2 (eq. 5.44)."""
    assert book_tile_of(i * d, d) == i
    upper = i * d + d / 2
    assert book_tile_of(upper, d) == i
    assert book_tile_of(math.nextafter(upper, math.inf), d) == i + 1
    assert book_tile_of(math.nextafter(upper, -math.inf), d) == i


@given(st.floats(-1e5, 1e5), RESOLUTIONS)
def test_every_position_is_in_its_book_tile(x: float, d: float) -> None:
    i = int(book_tile_of(x, d))
    assert (i - 1) * d + d / 2 < x <= i * d + d / 2


@given(st.floats(-1e4, 1e4), RESOLUTIONS)
def test_the_conversion_between_the_conventions_holds_off_the_borders(x: float, d: float) -> None:
    if abs(x / d - round(x / d)) > 1e-6:
        assert book_tile_of(shift_to_book_frame(x, d), d) == cell_of(x, d)


def test_the_conventions_differ_on_a_border() -> None:
    assert cell_of(3.0, 1.0) == 3
    assert book_tile_of(shift_to_book_frame(3.0, 1.0), 1.0) == 2
    assert book_tile_of([-0.5, 0.5, 0.5000001], 1.0).tolist() == [-1, 0, 1]


def test_zero_has_no_sign() -> None:
    assert cell_of([0.0, -0.0, -5e-324, 5e-324], 0.05).tolist() == [0, 0, -1, 0]


def test_cells_are_row_then_column() -> None:
    assert cells_of([[0.12, -0.01]], 0.05).tolist() == [[-1, 2]]
    assert centres_of([[-1, 2]], 0.05) == pytest.approx(np.array([[0.125, -0.025]]))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, MAX_CELL * 2.0])
def test_positions_without_a_cell_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="position"):
        cell_of(bad, 1.0)


@pytest.mark.parametrize("bad", [0.0, -0.05, np.nan, np.inf])
def test_resolutions_that_are_no_length_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="resolution"):
        cell_of(1.0, bad)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="points"):
        cells_of([1.0, 2.0], 0.05)
    with pytest.raises(ValueError, match="cells"):
        centres_of([[1, 2, 3]], 0.05)
