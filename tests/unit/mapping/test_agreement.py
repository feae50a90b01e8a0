"""Where maps contradict each other: by hand, and that the unknown never does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapping.agreement import (
    AGREES,
    DISAGREES,
    UNKNOWN,
    crossed_ways,
    passages_in,
    points_in,
    rooms_in,
    walled_passages,
    walls_in,
    ways_in,
)
from mapping.grids.patch import GridPatch

D = 0.05


def house() -> GridPatch:
    """Two rooms of 2 x 2 m side by side, wall 0.1 m between them with a door of 1 m at y 0.5 to 1.5; from (-1, 0)."""
    cells = np.full((42, 86), 100, dtype=np.int8)
    cells[1:41, 1:41] = cells[1:41, 43:83] = cells[11:31, 40:44] = 0
    cells[:, 84:] = -1
    return GridPatch(D, -1, -20, cells)


DOOR = [[[1.08, 0.5], [1.08, 1.5]]]


def shut(grid: GridPatch) -> GridPatch:
    grid.cells[11:31, 41:43] = 100
    return grid


def test_a_wall_is_occupied_and_one_that_was_taken_away_is_free() -> None:
    start, end = (
        [[-0.97, 0.1], [0.5, 0.2], [3.6, 0.0], [0.5, -0.06]],
        [[-0.97, 1.9], [0.5, 1.8], [3.6, 2.0], [0.9, -0.06]],
    )
    assert walls_in(house(), start, end).tolist() == [AGREES, DISAGREES, UNKNOWN, AGREES]
    assert walls_in(house(), np.zeros((0, 2)), np.zeros((0, 2))).tolist() == []
    with pytest.raises(ValueError, match="finite"):
        walls_in(house(), [[np.nan, 0.0]], [[0.0, 0.0]])


def test_a_door_is_free_until_it_is_shut() -> None:
    assert passages_in(house(), DOOR).tolist() == [AGREES]
    assert passages_in(shut(house()), DOOR).tolist() == [DISAGREES]
    ajar = house()
    ajar.cells[11:16, 41:43] = 100  # a leaf in a quarter of it
    assert passages_in(ajar, DOOR).tolist() == [AGREES]
    dark = house()
    dark.cells[5:35, 38:46] = -1
    assert passages_in(dark, DOOR).tolist() == [UNKNOWN]


def test_a_wall_across_a_door_is_seen_and_one_beside_it_is_not() -> None:
    assert walled_passages(DOOR, [[1.1, 0.5]], [[1.1, 1.5]]).tolist() == [DISAGREES]
    for start, end in (([1.1, 0.0], [1.1, 0.5]), ([0.5, 1.0], [1.7, 1.0]), ([1.5, 0.5], [1.5, 1.5])):
        assert walled_passages(DOOR, [start], [end]).tolist() == [UNKNOWN]
    jambs = [[1.1, 0.0], [1.1, 1.55]], [[1.1, 0.45], [1.1, 2.0]]
    assert walled_passages(DOOR, *jambs).tolist() == [AGREES]
    assert walled_passages(DOOR, jambs[0][1:], jambs[1][1:]).tolist() == [UNKNOWN]
    assert walled_passages(DOOR, [*jambs[0], [1.1, 0.6]], [*jambs[1], [1.1, 1.4]]).tolist() == [DISAGREES]
    assert walled_passages(DOOR, np.zeros((0, 2)), np.zeros((0, 2))).tolist() == [UNKNOWN]


def test_a_way_is_free_until_something_stands_all_across_it() -> None:
    way = [[[0.0, 1.0], [1.08, 1.0], [2.0, 1.0]]]
    assert ways_in(house(), way).tolist() == [AGREES]
    assert ways_in(shut(house()), way).tolist() == [DISAGREES]
    leg = house()
    leg.cells[20:23, 30:33] = 100
    assert ways_in(leg, way).tolist() == [AGREES]
    dark = house()
    dark.cells[:, 10:55] = -1
    assert ways_in(dark, way).tolist() == [UNKNOWN]
    assert ways_in(house(), np.zeros((0, 3, 2))).tolist() == []


def test_a_way_does_not_cross_a_wall() -> None:
    way = [[[0.0, 1.0], [1.08, 1.0], [2.0, 1.0]]]
    assert crossed_ways(way, [[1.1, 0.5]], [[1.1, 1.5]]).tolist() == [DISAGREES]
    for start, end in (
        ([1.1, 0.0], [1.1, 0.5]),
        ([1.1, 0.5], [1.1, 1.05]),
        ([0.5, 0.9], [1.7, 0.9]),
        ([1.1, 0.95], [1.1, 1.1]),
    ):
        assert crossed_ways(way, [start], [end]).tolist() == [AGREES]  # beside it, or no more than a rough end across
    assert crossed_ways(way, [[1.08, 0.5]], [[1.08, 1.5]]).tolist() == [DISAGREES]  # where it bends
    assert crossed_ways(way, [[1.1, 2.1]], [[1.1, 3.0]]).tolist() == [UNKNOWN]
    assert crossed_ways(way, np.zeros((0, 2)), np.zeros((0, 2))).tolist() == [UNKNOWN]
    assert crossed_ways(np.zeros((0, 3, 2)), [[1.1, 0.5]], [[1.1, 1.5]]).tolist() == []


def test_a_room_may_be_crossed_by_legs_but_not_filled_by_a_cupboard() -> None:
    grid = house()
    labels = np.zeros(grid.cells.shape, dtype=np.int32)
    labels[1:41, 1:41], labels[1:41, 43:83] = 1, 2
    free = grid.cells == 0
    assert rooms_in(grid, labels, free, -1, -20, 2).tolist() == [AGREES, AGREES]
    grid.cells[10:12, 10:14] = 100
    assert rooms_in(grid, labels, free, -1, -20, 2).tolist() == [AGREES, AGREES]
    grid.cells[20:28, 50:58] = 100
    assert rooms_in(grid, labels, free, -1, -20, 2).tolist() == [AGREES, DISAGREES]
    partly = GridPatch(D, -1, -20, grid.cells[:, :20])  # less than half of the first, nothing of the second
    assert rooms_in(partly, labels, free, -1, -20, 2).tolist() == [UNKNOWN, UNKNOWN]
    partly = GridPatch(D, -1, -20, grid.cells[:, :25])
    assert rooms_in(partly, labels, free, -1, -20, 2).tolist() == [AGREES, UNKNOWN]
    elsewhere = GridPatch(D, 500, 500, grid.cells)
    assert rooms_in(elsewhere, labels, free, -1, -20, 2).tolist() == [UNKNOWN, UNKNOWN]


def test_a_place_in_a_wall() -> None:
    assert points_in(house(), [[0.0, 1.0], [1.08, 0.2], [3.3, 1.0], [99.0, 0.0]]).tolist() == [
        AGREES, DISAGREES, UNKNOWN, UNKNOWN,
    ]  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([-1, 50]))
def test_what_is_not_known_never_disagrees(seed: int, nothing: int) -> None:
    rng = np.random.default_rng(seed)
    grid = GridPatch(D, -20, -20, np.full((40, 40), nothing, dtype=np.int8))
    a, b = rng.uniform(-2.0, 2.0, (2, 6, 2))
    assert not (walls_in(grid, a, b) == DISAGREES).any()
    assert not (passages_in(grid, np.stack((a, b), axis=1)) == DISAGREES).any()
    assert not (points_in(grid, a) == DISAGREES).any()
    assert not (ways_in(grid, np.stack((a, b), axis=1)) == DISAGREES).any()
    labels = rng.integers(0, 3, (30, 30)).astype(np.int32)
    assert not (rooms_in(grid, labels, labels > 0, -10, -15, 2) == DISAGREES).any()
