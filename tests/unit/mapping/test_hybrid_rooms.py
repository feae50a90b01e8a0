"""Rooms of plans whose rooms are known, and the loops behind them against slow references."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from mapping.grids.clearance import DistanceField
from mapping.hybrid.rooms import RoomMap, RoomRules, find_rooms
from mapping.kernels import rooms as kernels

Bools = NDArray[np.bool_]
I32 = NDArray[np.int32]

CELL_M = 0.05


def plan() -> tuple[Bools, I32]:
    """A corridor of 1.6 m, three rooms above it with doors of 1 m, one below; the rooms as drawn."""
    truth = np.zeros((200, 300), dtype=np.int32)
    for number, (top, bottom, left, right) in enumerate(
        ((10, 90, 10, 90), (10, 90, 95, 190), (10, 90, 195, 290), (95, 127, 10, 290), (132, 190, 60, 240)), start=1
    ):
        truth[top:bottom, left:right] = number
    free = truth > 0
    for left in (40, 140, 230):
        free[90:95, left : left + 20] = True
    free[127:132, 100:120] = True
    return free, truth


def furnished() -> Bools:
    free, _ = plan()
    random = np.random.default_rng(3)
    for _ in range(40):
        row, col = random.integers(15, 80), random.integers(15, 280)
        free[row : row + random.integers(1, 8), col : col + random.integers(1, 8)] &= not 95 > col > 80
    free[10:20, 20:50] = False  # a cupboard at the wall
    return free


def numbers_in(found: RoomMap, truth: I32) -> list[int]:
    """The found room that covers most of each drawn one."""
    return [int(np.bincount(found.labels[truth == k]).argmax()) for k in range(1, truth.max() + 1)]


def test_a_plan_falls_into_its_rooms_at_its_doors() -> None:
    free, truth = plan()
    found = find_rooms(free, CELL_M)
    numbers = numbers_in(found, truth)
    assert sorted(numbers) == [1, 2, 3, 4, 5] == [room.number for room in found.rooms]
    for k, number in enumerate(numbers, start=1):
        drawn, cells = truth == k, found.labels == number
        assert (cells & drawn).sum() > 0.98 * max(drawn.sum(), cells.sum())
        assert found.rooms[number - 1].area_m2 == pytest.approx(cells.sum() * CELL_M**2)
    corridor = numbers[3]
    beyond = sorted(door.a + door.b - corridor for door in found.doors)
    assert beyond == sorted(set(numbers) - {corridor})
    for door in found.doors:
        assert corridor in (door.a, door.b)
        assert door.a < door.b
        assert door.width_m == pytest.approx(1.0, abs=0.1)
        assert 88 <= door.centre[0] <= 133
        assert free[door.centre]
        assert not free[door.ends[0]]
        assert not free[door.ends[1]]


def test_furniture_changes_no_room_and_belongs_to_the_one_it_stands_in() -> None:
    _, truth = plan()
    found = find_rooms(furnished(), CELL_M)
    numbers = numbers_in(found, truth)
    assert sorted(numbers) == [1, 2, 3, 4, 5]
    assert len(found.rooms) == 5
    second = truth == 2
    assert (found.labels[second] == numbers[1]).mean() > 0.97


def test_the_anchor_is_the_widest_place_of_its_room() -> None:
    free, _ = plan()
    found = find_rooms(free, CELL_M)
    distance = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
    for room in found.rooms:
        assert found.labels[room.anchor] == room.number
        assert room.clearance_m == pytest.approx(CELL_M * distance[found.labels == room.number].max())


def test_what_is_not_free_or_too_small_is_no_room() -> None:
    assert find_rooms(np.zeros((30, 40), dtype=np.bool_), CELL_M).rooms == ()
    free = np.zeros((100, 100), dtype=np.bool_)
    free[40:60, 40:60] = True  # one square metre
    found = find_rooms(free, CELL_M)
    assert found.rooms == ()
    assert not found.labels.any()
    whole = find_rooms(np.ones((60, 60), dtype=np.bool_), CELL_M)
    assert len(whole.rooms) == 1
    assert (whole.labels == 1).all()


def test_the_same_grid_gives_the_same_rooms_and_bad_ones_are_refused() -> None:
    free = furnished()
    first, second = find_rooms(free, CELL_M), find_rooms(free.copy(), CELL_M)
    assert np.array_equal(first.labels, second.labels)
    assert (first.rooms, first.doors) == (second.rooms, second.doors)
    with pytest.raises(ValueError, match="free cells"):
        find_rooms(np.ones(5, dtype=np.bool_), CELL_M)
    with pytest.raises(ValueError, match="resolution"):
        find_rooms(free, 0.0)


def test_rules_say_what_is_furniture_and_what_a_room() -> None:
    free, _ = plan()
    free[40:61, 130:151] = False  # more than a metre across
    assert (find_rooms(free, CELL_M).labels[40:61, 130:151] == 0).any()
    assert (find_rooms(free, CELL_M, RoomRules(clutter_m=1.05)).labels[40:61, 130:151] > 0).all()
    assert len(find_rooms(free, CELL_M, RoomRules(room_min_m2=30.0)).rooms) < 5


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("diagonal", [False, True])
def test_components_are_those_of_scipy(seed: int, diagonal: bool) -> None:
    random = np.random.default_rng(seed)
    mask = random.random((random.integers(1, 40), random.integers(1, 40))) < 0.5
    label = np.empty(mask.shape, dtype=np.int32)
    count = kernels.connected(mask, diagonal, label)
    expected, n = ndimage.label(mask, np.ones((3, 3)) if diagonal else None)
    assert count == n
    assert np.array_equal(label, expected - 1)


def literal_flood(
    squared: I32, keep: float, slack: float, less: float
) -> tuple[list[set[tuple[int, int]]], set[tuple[int, int]]]:
    """Basins by sets of cells instead of union-find, and the cells where two met and stayed apart."""
    cells = sorted(((-int(v), r, c) for (r, c), v in np.ndenumerate(squared) if v > 0))
    basins: list[set[tuple[int, int]]] = []
    met = set()
    for negative, r, c in cells:
        clearance = math.sqrt(-negative) - less
        near = [
            (rr, cc) for rr in range(r - 1, r + 2) for cc in range(c - 1, c + 2) if any((rr, cc) in b for b in basins)
        ]
        if not near:
            basins.append({(r, c)})
            continue
        uphill = max(near, key=lambda n: (2 * squared[n] - (n[0] - r) ** 2 - (n[1] - c) ** 2, -n[0], -n[1]))
        next(b for b in basins if uphill in b).add((r, c))
        here = next(b for b in basins if near[0] in b)
        for n in near[1:]:
            other = next(b for b in basins if n in b)
            if other is here:
                continue
            peak = min(max(math.sqrt(squared[k]) - less for k in b) for b in (here, other))
            if clearance >= keep * peak - slack:
                here |= other
                basins.remove(other)
            else:
                met.add((r, c))
    return basins, met


@pytest.mark.parametrize("less", [0.0, 0.25, -0.5])
@pytest.mark.parametrize("seed", range(6))
def test_basins_are_those_of_the_slow_flood(seed: int, less: float) -> None:
    random = np.random.default_rng(seed)
    free = np.pad(random.random((26, 34)) > 0.04, 1)
    squared = DistanceField(~free).squared
    basin = np.empty(free.shape, dtype=np.int32)
    count = kernels.flood(squared, kernels.widest_first(squared, 0), 0.8, 0.25, less, basin)
    expected, met = literal_flood(squared, 0.8, 0.25, less)
    assert count == len(expected) > 2
    assert met
    for cells in expected:
        numbers = {int(basin[cell]) for cell in cells}
        assert len(numbers) == 1
        assert (basin == numbers.pop()).sum() == len(cells)
    assert (basin[~free] == -1).all()


def test_sharpness_tells_a_wall_from_a_corner_from_the_end_of_a_wall() -> None:
    free = np.zeros((121, 121), dtype=np.bool_)
    free[20:101, 20:101] = True
    free[60, :55] = free[60, 67:] = False  # a thin wall with an opening of twelve cells
    field = DistanceField(~free)
    ruled = np.zeros(free.shape, dtype=np.int32)
    kernels.count_ruled(field.site, field.squared, ruled)
    assert ruled.sum() == free.sum()
    points = np.array([[60, 60], [60, 61], [40, 60]], dtype=np.int32)
    sharpness, no_doors = np.empty((2, 3)), np.empty((0, 4), dtype=np.int64)
    first = np.array([0, 2, 3])
    kernels.jambs(field.site, field.squared, ruled, points, first, 2, 2.5, 0.0, no_doors, 11.0, 24.0, 4.0, sharpness)
    line = kernels.critical_line(field.site, field.squared, 60, 60, 2)
    assert sorted(np.array(line).reshape(2, 2).tolist()) == [[60, 54], [60, 67]]
    assert sharpness[0, 0] > 1.6  # both are ends of walls
    assert sharpness[1, 0] < 0.5  # midway between straight walls
    assert not sharpness[:, 2].any()


@pytest.mark.parametrize("turned_by", [0.0, 90.0, 180.0, 13.0, 30.0, 45.0])
@pytest.mark.parametrize("mirrored", [False, True])
def test_rooms_do_not_hang_on_how_a_plan_lies(turned_by: float, mirrored: bool) -> None:
    free, truth = plan()
    if mirrored:
        free, truth = free[:, ::-1], truth[:, ::-1]
    free = ndimage.rotate(free.astype(np.float64), turned_by, order=1) > 0.5
    truth = ndimage.rotate(truth, turned_by, order=0)
    check_rooms(find_rooms(free, CELL_M), truth)


def check_rooms(found: RoomMap, truth: I32) -> None:
    numbers = numbers_in(found, truth)
    assert sorted(numbers) == [1, 2, 3, 4, 5] == [room.number for room in found.rooms]
    for k, number in enumerate(numbers, start=1):
        drawn, cells = truth == k, found.labels == number
        assert (cells & drawn).sum() > 0.95 * max(drawn.sum(), cells.sum())


@pytest.mark.parametrize("cell_m", [0.025, 0.1])
def test_rooms_do_not_hang_on_the_cells(cell_m: float) -> None:
    free, truth = plan()
    if cell_m < CELL_M:
        free, truth = free.repeat(2, axis=0).repeat(2, axis=1), truth.repeat(2, axis=0).repeat(2, axis=1)
    else:
        free, truth = free[::2, ::2], truth[::2, ::2]
    check_rooms(find_rooms(free, cell_m), truth)


def cubicles(*, stub: int) -> tuple[Bools, I32]:
    """A corridor of 2.5 m and along it cells of 2.9 m by 2 m, open to it but for `stub` cells of wall on the right."""
    truth = np.zeros((120, 365), dtype=np.int32)
    truth[60:110, 10:355] = 1
    for k in range(5):
        truth[17:57, 30 + 61 * k : 88 + 61 * k] = k + 2
    free = truth > 0
    for k in range(5):
        free[57:60, 30 + 61 * k : 88 + 61 * k - stub] = True
    return free, truth


@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("mirrored", [False, True])
def test_cells_with_a_wall_in_front_are_rooms_and_bays_are_not(quarters: int, mirrored: bool) -> None:
    """A bug: cells as deep as their opening is wide were taken for bays of the corridor."""
    for stub, rooms in ((17, 6), (12, 6), (0, 1)):
        free, truth = cubicles(stub=stub)
        if mirrored:
            free, truth = free[:, ::-1], truth[:, ::-1]
        found = find_rooms(np.rot90(free, quarters), CELL_M)
        assert len(found.rooms) == rooms
        if stub:
            assert sorted(numbers_in(found, np.rot90(truth, quarters))) == [1, 2, 3, 4, 5, 6]


def test_a_cut_that_ends_at_a_wall_tells_how_far_it_is_free_on_both_sides() -> None:
    free = np.zeros((80, 100), dtype=np.bool_)
    free[10:38, 10:50] = True  # the room, 14 cells beyond the opening on its left, none on its right
    free[42:70, 10:90] = True
    free[38:42, 24:50] = True
    basin = np.where(free, 1, -1).astype(np.int32)
    basin[:40][free[:40]] = 0
    cells = np.array([[39, c, 100] for c in (36, *range(24, 36), *range(37, 50))], dtype=np.int32)
    owner, first, beside = np.arange(2, dtype=np.int32), np.array([0, len(cells)]), np.array([4.0, 12.0, 20.0])
    for most, pieces, expected in ((40.0, [0, 1], 14.0), (8.0, [0, 1], 8.0), (40.0, [0, 0], 14.0)):
        owner[:] = pieces
        length = np.empty(1)
        kernels.stubs(basin, owner, cells, first, beside, np.zeros(1), most, 4.0, length)
        assert length[0] == pytest.approx(expected, abs=1.0)
    free[42:70, :24] = False  # below, the wall goes on to the opening
    basin[~free] = -1
    kernels.stubs(basin, owner, cells, first, beside, np.zeros(1), 40.0, 4.0, length)
    assert length[0] < 1.0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("around", [0, 1, 3, 50])
def test_cells_are_taken_by_clearance_then_by_what_is_around_them_then_in_reading_order(seed: int, around: int) -> None:
    random = np.random.default_rng(seed)
    squared = DistanceField(np.pad(random.random((20, 31)) > 0.1, 1) == 0).squared
    size = 2 * around + 1
    sums = ndimage.convolve(squared.astype(np.int64), np.ones((size, size), dtype=np.int64), mode="constant")
    assert np.array_equal(kernels.sums_around(squared, around), sums)
    expected = sorted(((-int(squared[r, c]), -int(sums[r, c]), r, c) for r, c in zip(*np.nonzero(squared))))
    assert kernels.widest_first(squared, around).tolist() == [r * squared.shape[1] + c for _, _, r, c in expected]


def living_room(*, opening: bool, open_deg: float = 90.0) -> Bools:
    """6 x 3 m above a corridor, a cupboard of 1.7 x 0.9 m in its upper left corner, a wall or leaf of 0.9 m that stands
    2.9 m from the left, and beside it, to the left, a door to the corridor or none."""
    free = np.zeros((130, 150), dtype=np.bool_)
    free[20:80, 15:135] = True
    free[20:38, 15:49] = False
    free[84:112, 15:135] = True
    if opening:
        free[80:84, 55:73] = True
    turn = math.radians(open_deg)
    for length in np.arange(0.0, 18.0, 0.25):
        row, col = 79.5 - length * math.sin(turn), 73.5 - length * math.cos(turn)
        free[round(row), round(col)] = free[round(row), round(col) + 1] = False
    return free


@pytest.mark.parametrize("turned_by", [0.0, 90.0, 25.0])
@pytest.mark.parametrize("open_deg", [75.0, 90.0, 100.0])
def test_the_leaf_of_an_open_door_parts_no_room(turned_by: float, open_deg: float) -> None:
    """A bug: between a cupboard and a leaf that stands in the room it was two rooms."""
    free = ndimage.rotate(living_room(opening=True, open_deg=open_deg).astype(np.float64), turned_by, order=1) > 0.5
    found = find_rooms(free, CELL_M)
    assert len(found.rooms) == 2
    assert len(found.doors) == 1
    assert found.doors[0].width_m == pytest.approx(0.95, abs=0.2)


def test_a_wall_as_long_as_a_leaf_parts_a_room_where_no_door_is() -> None:
    assert len(find_rooms(living_room(opening=False), CELL_M).rooms) == 3


def study(open_deg: float) -> Bools:
    """4 x 3.4 m below a corridor, a shelf of 0.4 x 2.2 m at its left wall; the leaf of its door, 0.9 m, hangs at the
    jamb on the left and leaves 0.7 m between its tip and the shelf."""
    free = np.zeros((130, 150), dtype=np.bool_)
    free[20:48, 10:140] = True
    free[50:118, 40:120] = True
    free[48:50, 66:84] = True
    free[68:112, 40:48] = False
    turn = math.radians(open_deg)
    for length in np.arange(0.0, 18.5, 0.25):
        row, col = 49.5 + length * math.sin(turn), 65.5 + length * math.cos(turn)
        free[round(row), round(col)] = free[round(row), round(col) + 1] = False
    return free


@pytest.mark.parametrize("turned_by", [0.0, 90.0, 25.0, -40.0])
@pytest.mark.parametrize("open_deg", [90.0, 95.0, 100.0, 105.0])
def test_the_jamb_that_a_leaf_hangs_at_is_not_its_tip(turned_by: float, open_deg: float) -> None:
    """A bug: an opening between a leaf and furniture behind it made a tip of the jamb, and the door was none."""
    free = ndimage.rotate(study(open_deg).astype(np.float64), turned_by, order=1) > 0.5
    found = find_rooms(free, CELL_M)
    assert len(found.rooms) == 2
    assert len(found.doors) == 1
    assert found.doors[0].width_m == pytest.approx(0.95, abs=0.2)


def literal_cracks(free: Bools, wide: int, deep: int, thick: int) -> Bools:
    """Cells of cracks along columns, looked for cell by cell."""
    rows, cols = free.shape
    mark = np.zeros_like(free)
    for r, c in np.argwhere(free):
        left, right = int(c), int(c)
        while left > 0 and free[r, left - 1]:
            left -= 1
        while right < cols - 1 and free[r, right + 1]:
            right += 1
        walls = free[r, max(left - deep, 0) : left], free[r, right + 1 : right + 1 + deep]
        mark[r, c] = right - left < wide and all(len(each) == deep and not each.any() for each in walls)
    crack = np.zeros_like(free)
    for r, c in np.argwhere(mark):
        top, bottom = int(r), int(r)
        while top > 0 and mark[top - 1, c]:
            top -= 1
        while bottom < rows - 1 and mark[bottom + 1, c]:
            bottom += 1
        crack[r, c] = bottom - top < thick
    return crack


@pytest.mark.parametrize("seed", range(8))
def test_cracks_are_those_found_cell_by_cell(seed: int) -> None:
    random = np.random.default_rng(seed)
    free = random.random((30, 40)) < (0.1, 0.3)[seed % 2]
    free[random.integers(30)] = free[:, random.integers(40)] = True
    out, expected = free.copy(), literal_cracks(free, 2, 3, 2)
    assert expected.any()
    kernels.close_cracks(free, 2, 3, 2, out)
    assert np.array_equal(out, free & ~expected)


@pytest.mark.parametrize("transposed", [False, True])
def test_a_cell_left_out_of_a_wall_changes_no_room(transposed: bool) -> None:
    """A bug: a wall cut into pieces below a metre was taken for furniture."""
    free, truth = cubicles(stub=17)
    whole = find_rooms(free, CELL_M)
    cracked = free.copy()
    for k in range(5):
        cracked[57:60, 84 + 61 * k] = True
    if transposed:
        cracked, truth = np.ascontiguousarray(cracked.T), truth.T
    found = find_rooms(cracked, CELL_M)
    assert len(found.rooms) == len(whole.rooms) == 6
    assert sorted(numbers_in(found, truth)) == [1, 2, 3, 4, 5, 6]
