"""Exact distances, inflated maps, and the cell size of a safety distance (S30)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from mapping.grids.clearance import (
    DistanceField,
    cell_size_for_clearance,
    clearance_layer,
    clearance_of_cell_size,
    inflated,
    squared_cell_distances,
)
from mapping.grids.patch import GridPatch
from mapping.kernels.clearance import FAR

Mask = NDArray[np.bool_]


@st.composite
def masks(draw: st.DrawFn) -> Mask:
    rows, cols = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return np.asarray(rng.random((rows, cols)) < draw(st.sampled_from([0.0, 0.003, 0.05, 0.5, 1.0])))


@settings(max_examples=150, deadline=None)
@given(masks())
def test_squared_distances_are_those_of_all_pairs(mask: Mask) -> None:
    found = squared_cell_distances(mask)
    obstacles = np.argwhere(mask)
    if obstacles.size == 0:
        assert np.all(found == FAR)
        return
    cells = np.argwhere(np.ones_like(mask))
    away = ((cells[:, None] - obstacles[None]) ** 2).sum(axis=2).min(axis=1)
    assert np.array_equal(found.ravel(), away)


def test_large_maps_agree_with_scipy() -> None:
    rng = np.random.default_rng(1)
    mask = np.zeros((700, 900), dtype=np.bool_)
    for _ in range(40):
        row, col = rng.integers(0, 700), rng.integers(0, 900)
        mask[row : row + rng.integers(1, 100), col : col + rng.integers(1, 4)] = True
    mask[:, 300:420] = False
    assert np.array_equal(squared_cell_distances(mask), np.rint(distance_transform_edt(~mask) ** 2))


def test_a_long_thin_map_with_one_obstacle() -> None:
    mask = np.zeros((2, 15_000), dtype=np.bool_)
    mask[1, 14_999] = True
    found = squared_cell_distances(mask)
    assert found[0, 0] == 14_999**2 + 1
    assert found[1, 14_999] == 0


@settings(max_examples=100, deadline=None)
@given(masks(), st.integers(0, 2**32 - 1))
def test_the_nearest_obstacle_is_named_and_ties_have_one_answer(mask: Mask, seed: int) -> None:
    field = DistanceField(mask)
    obstacles = np.argwhere(mask)
    if obstacles.size == 0:
        assert np.all(field.site == -1)
        return
    rng = np.random.default_rng(seed)
    for row, col in rng.integers((0, 0), mask.shape, (20, 2)):
        away = ((obstacles - (row, col)) ** 2).sum(axis=1)
        row_of, col_of = min((c, r) for r, c in obstacles[away == away.min()])[::-1]
        assert field.site[row, col] == row_of << 16 | col_of


def change_of(field: DistanceField, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Some obstacles more, some or all of those there are gone; some of both lists say what is so already."""
    added = rng.integers((0, 0), field.shape, (rng.integers(0, 12), 2))
    if rng.random() < 0.3:  # a wall
        row, col = rng.integers(0, field.shape[0]), rng.integers(0, field.shape[1])
        added = np.array([(row, c) for c in range(col, min(col + 20, field.shape[1]))])
    there = np.argwhere(field.obstacle)
    lost = there[rng.random(len(there)) < rng.choice([0.0, 0.1, 0.6, 1.0])]
    return added, np.concatenate((lost, rng.integers((0, 0), field.shape, (3, 2))))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(masks(), st.integers(0, 2**32 - 1), st.booleans())
def test_an_updated_field_is_the_field_made_anew(mask: Mask, seed: int, tall: bool) -> None:
    """Distances, nearest obstacles and the spans said to have changed, over six changes."""
    rng = np.random.default_rng(seed)
    field = DistanceField(np.repeat(mask, 4, axis=0) if tall else mask)  # rows beyond one word of bits
    for _ in range(6):
        before, obstacle = field.site.copy(), field.obstacle.copy()
        added, removed = change_of(field, rng)
        spans = field.update(added, removed)
        obstacle[tuple(removed.T)] = False
        if len(added):
            obstacle[tuple(added.T)] = True
        anew = DistanceField(obstacle)
        assert np.array_equal(field.obstacle, obstacle)
        assert np.array_equal(field.squared, anew.squared)
        assert np.array_equal(field.site, anew.site)
        cols = np.arange(field.shape[1])
        inside = (cols >= spans[:, :1]) & (cols < spans[:, 1:])
        assert not np.any((before != field.site) & ~inside)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(masks(), st.integers(0, 2**32 - 1), st.booleans(), st.integers(0, 30))
def test_a_field_with_a_reach_is_the_whole_one_cut_off(mask: Mask, seed: int, tall: bool, reach: int) -> None:
    """Made and over six changes; what changed is told."""
    rng = np.random.default_rng(seed)
    mask = np.repeat(mask, 4, axis=0) if tall else mask
    field, whole = DistanceField(mask, reach_cells=reach), DistanceField(mask)
    for _ in range(7):
        far = whole.squared > reach * reach
        assert np.array_equal(field.squared, np.where(far, FAR, whole.squared))
        assert np.array_equal(field.site, np.where(far, -1, whole.site))
        before, change = field.site.copy(), change_of(whole, rng)
        spans = field.update(*change)
        whole.update(*change)
        assert np.array_equal(field.obstacle, whole.obstacle)
        cols = np.arange(field.shape[1])
        inside = (cols >= spans[:, :1]) & (cols < spans[:, 1:])
        assert not np.any((before != field.site) & ~inside)


def scanned_room(rng: np.random.Generator) -> Mask:
    """A room as beams leave it in a grid: walls a cell or two thick, met here and there, with stray cells before them;
    one wall without a gap, and one that slants."""
    mask = np.zeros((180, 220), dtype=np.bool_)
    for along in range(20, 200):
        for row in (30, 140):
            if rng.random() < 0.4:
                mask[row + rng.integers(-1, 2), along] = True
    for row in range(30, 140):
        if rng.random() < 0.3:
            mask[row, 20 + rng.integers(-1, 2)] = True
        mask[row, 170 - row // 2] |= rng.random() < 0.5
    mask[30:140, 199] = rng.random() < 0.8
    mask[tuple(rng.integers((0, 0), mask.shape, (10, 2)).T)] = True
    return mask


@pytest.mark.parametrize("reach", [1, 5, 17, 40])
def test_scans_of_a_room_one_after_the_other_agree_with_scipy(reach: int) -> None:
    """Each scan has some cells of the walls elsewhere; kept up to date by them, cut off at the reach."""
    rng = np.random.default_rng(7)
    field = DistanceField(np.zeros((180, 220), dtype=np.bool_), reach_cells=reach)
    for ends in (120, 220, 60, 220, 180, 10):
        mask, seen = scanned_room(rng), np.zeros(field.shape, dtype=np.bool_)
        seen[:, :ends] = True  # the rest stays as it was
        field.update(np.argwhere(mask & ~field.obstacle & seen), np.argwhere(~mask & field.obstacle & seen))
        squared = np.rint(distance_transform_edt(~field.obstacle) ** 2)
        assert np.array_equal(field.squared, np.where(squared > reach * reach, FAR, squared))


def test_a_cell_that_comes_and_goes_at_once_stays() -> None:
    """In both lists, twice, of what was there and what was not: an obstacle in the end, and the others are left."""
    for reach in (None, 3):
        field = DistanceField(np.eye(5, 6, dtype=np.bool_), reach_cells=reach)
        field.update([(1, 1), (0, 3), (0, 3)], [(1, 1), (1, 1), (0, 3), (2, 2), (4, 0)])
        mask = np.eye(5, 6, dtype=np.bool_)
        mask[2, 2], mask[0, 3] = False, True
        assert np.array_equal(field.obstacle, mask)
        assert np.array_equal(field.site, DistanceField(mask, reach_cells=reach).site)


def test_anything_but_nothing_is_an_obstacle() -> None:
    given = [[0.0, 0.0, 7.0], [0.0, 0.0, 0.0], [0.0, math.nan, 0.0]]
    mask = np.array(given) != 0.0
    for reach in (None, 5):
        field = DistanceField(given, reach_cells=reach)
        assert np.array_equal(field.obstacle, mask)
        field.update([(0, 0)], [(0, 2)])
        assert field.squared.tolist() == [[0, 1, 4], [1, 1, 2], [1, 0, 1]]
    assert squared_cell_distances(given)[0].tolist() == [4, 1, 0]


def test_a_reach_below_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="reach"):
        DistanceField(np.eye(3, dtype=np.bool_), reach_cells=-1)


def test_the_order_of_a_change_does_not_matter() -> None:
    mask = np.zeros((60, 70), dtype=np.bool_)
    mask[10, 5:50] = True
    cells = np.array([(30, c) for c in range(5, 60)])
    fields = [DistanceField(mask) for _ in range(2)]
    fields[0].update(cells, [(10, 5), (10, 6)])
    fields[1].update(cells[::-1].repeat(2, axis=0), [(10, 6), (10, 5)])
    assert np.array_equal(fields[0].site, fields[1].site)


@pytest.mark.parametrize("cells", [[(0, 5)], [(4, 0)], [(-1, 0)], [(0.0, 1.0)], [(1, 2, 3)], [1, 2], [(0, 2**40)]])
def test_changes_that_are_no_cells_are_refused_and_change_nothing(cells: list[tuple[int, int]]) -> None:
    field = DistanceField(np.eye(4, 5, dtype=np.bool_))
    before = field.site.copy()
    for added, removed in ((cells, ()), ((), cells), ([(0, 1)], cells)):
        with pytest.raises(ValueError, match="cell"):
            field.update(added, removed)
    assert np.array_equal(field.site, before)


def test_empty_and_wrong_shapes() -> None:
    assert squared_cell_distances(np.zeros((0, 5), dtype=np.bool_)).shape == (0, 5)
    assert squared_cell_distances(np.zeros((5, 0), dtype=np.bool_)).shape == (5, 0)
    with pytest.raises(ValueError, match="obstacles"):
        squared_cell_distances(np.zeros(5, dtype=np.bool_))
    with pytest.raises(ValueError, match="sides"):
        squared_cell_distances(np.zeros((1, 20_001), dtype=np.bool_))


def patch_of(cells: list[list[int]], resolution_m: float = 0.1) -> GridPatch:
    return GridPatch(resolution_m, -2, 5, np.array(cells, dtype=np.int8))


def test_the_clearance_layer_is_in_metres_and_knows_no_obstacle_as_inf() -> None:
    layer = clearance_layer(patch_of([[100, 0, -1], [0, 0, 64]]))
    assert layer == pytest.approx(0.1 * np.array([[0.0, 1.0, 2.0], [1.0, math.sqrt(2.0), math.sqrt(5.0)]]))
    assert np.all(np.isinf(clearance_layer(patch_of([[0, -1]]))))
    assert clearance_layer(patch_of([[0, -1]]), unknown_is_obstacle=True) == pytest.approx(np.array([[0.1, 0.0]]))
    assert clearance_layer(patch_of([[0, 64]]), occupied_percent=60)[0, 0] == pytest.approx(0.1)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(masks(), st.floats(0.0, 0.8), st.integers(0, 2**32 - 1))
def test_a_disc_in_a_cell_left_free_touches_no_obstacle(mask: Mask, radius_m: float, seed: int) -> None:
    d = 0.1
    rng = np.random.default_rng(seed)
    cells = np.where(mask, 100, rng.choice([-1, 0, 50], mask.shape)).astype(np.int8)
    grown = inflated(GridPatch(d, 0, 0, cells), radius_m)
    kept = grown.cells != 100
    assert np.array_equal(grown.cells[kept], cells[kept])
    assert np.all(grown.cells[mask] == 100)
    obstacles = np.argwhere(mask)
    if obstacles.size == 0:
        return
    for row, col in np.argwhere(kept)[:50]:
        place = (np.array([row, col]) + rng.random(2)) * d
        nearest = np.clip(place, obstacles * d, (obstacles + 1) * d)
        assert np.hypot(*(nearest - place).T).min() >= radius_m - 1e-9 or radius_m == 0.0


@pytest.mark.parametrize("radius_m", [-0.1, math.nan, math.inf])
def test_radii_that_are_no_length_are_refused(radius_m: float) -> None:
    with pytest.raises(ValueError, match="radius"):
        inflated(patch_of([[100]]), radius_m)


def test_the_cell_size_of_the_book() -> None:
    """n = 7 cm gives cells of 5 cm, 400 of them a square metre."""
    assert cell_size_for_clearance(0.07) == pytest.approx(0.05, abs=1e-3)
    assert clearance_of_cell_size(cell_size_for_clearance(0.3)) == pytest.approx(0.3)
    with pytest.raises(ValueError, match="positive"):
        cell_size_for_clearance(0.0)
