"""The quadtree against plain arrays and a literal algorithm 5.4 (S31)."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.grids.evidence import FREE, OCCUPIED, UNKNOWN
from mapping.grids.patch import GridPatch
from mapping.grids.quadtree import BASE, HEADER, MAGIC, VERSION, Quadtree
from mapping.grids.tiles import Window

I8 = NDArray[np.int8]
D = 0.05
PERCENT: dict[int, int] = {UNKNOWN: -1, FREE: 0, OCCUPIED: 100}
EVERYWHERE = Window(-200, 200, -200, 200)


def patch_of(seed: int, *, speckle: float = 0.02) -> GridPatch:
    """Rooms with walls, an unknown outside, and single cells of other kinds; anywhere around the origin."""
    rng = np.random.default_rng(seed)
    rows, cols = rng.integers(1, 90, 2)
    cells = np.full((rows, cols), -1, dtype=np.int8)
    for _ in range(rng.integers(0, 5)):
        row, col = rng.integers(0, rows), rng.integers(0, cols)
        high, wide = rng.integers(1, 40, 2)
        cells[row : row + high, col : col + wide] = 100
        cells[row + 1 : row + high - 1, col + 1 : col + wide - 1] = 0
    mask = rng.random((rows, cols)) < speckle
    cells[mask] = rng.choice([-1, 0, 24, 25, 64, 65, 100], np.count_nonzero(mask))
    return GridPatch(D, int(rng.integers(-95, 100)), int(rng.integers(-95, 100)), cells)


def three_kinds(cells: I8) -> I8:
    """What is left of percentages: -1, 0, 100."""
    return np.where(cells >= 65, 100, np.where((cells >= 0) & (cells < 25), 0, -1)).astype(np.int8)


class Plain:
    """The same as one array."""

    def __init__(self) -> None:
        self.cells = np.full((400, 400), -1, dtype=np.int8)

    def write(self, patch: GridPatch) -> None:
        row, col = patch.row0 + 200, patch.col0 + 200
        self.cells[row : row + patch.cells.shape[0], col : col + patch.cells.shape[1]] = three_kinds(patch.cells)


def nodes_of(cells: I8) -> int:
    """Algorithm 5.4, literally: a square of one kind is a node; another is one, and four squares."""
    if np.all(cells == cells[0, 0]):
        return 1
    half = cells.shape[0] // 2
    parts = (cells[:half, :half], cells[:half, half:], cells[half:, :half], cells[half:, half:])
    return 1 + sum(nodes_of(part) for part in parts)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 2**32 - 1), max_size=5))
def test_written_cells_are_read_and_the_tree_is_that_of_the_algorithm(seeds: list[int]) -> None:
    """However often squares were divided and joined on the way."""
    tree, plain = Quadtree(resolution_m=D), Plain()
    for seed in seeds:
        tree.write(patch_of(seed))
        plain.write(patch_of(seed))
    assert np.array_equal(tree.cells_in(EVERYWHERE), plain.cells)
    assert tree.node_count == nodes_of(tree.cells_in(tree.window))
    again = Quadtree(resolution_m=D)
    again.write(GridPatch(D, tree.window.row0, tree.window.col0, tree.cells_in(tree.window)))
    assert again.to_bytes() == tree.to_bytes()


def entries_of(cells: I8) -> int:
    """The same where squares of 4 x 4 cells are not divided."""
    if len(cells) == 4 or np.all(cells == cells[0, 0]):
        return 1
    half = len(cells) // 2
    parts = (cells[:half, :half], cells[:half, half:], cells[half:, :half], cells[half:, half:])
    return 1 + sum(entries_of(part) for part in parts)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=4))
def test_what_is_kept_ends_with_squares_of_four_cells(seeds: list[int]) -> None:
    tree = Quadtree(resolution_m=D)
    for seed in seeds:
        tree.write(patch_of(seed, speckle=0.2))
    assert tree.entry_count == entries_of(tree.cells_in(tree.window))
    assert tree.record_count == (tree.entry_count - 1) / 4


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_a_pattern_that_repeats_is_no_square_of_one_kind(high: int, wide: int, seed: int) -> None:
    """Squares beside each other that are mixed alike, as tiles of a floor are."""
    rng = np.random.default_rng(seed)
    cells = np.tile(rng.choice(np.array([-1, 0, 100], dtype=np.int8), (high, wide)), (9, 9))
    patch, plain = GridPatch(D, int(rng.integers(-60, 60)), 3, cells), Plain()
    plain.write(patch)
    tree = Quadtree.of_patch(patch)
    assert np.array_equal(tree.cells_in(EVERYWHERE), plain.cells)
    assert tree.node_count == nodes_of(tree.cells_in(tree.window))
    assert tree.entry_count == entries_of(tree.cells_in(tree.window))
    again = Quadtree(resolution_m=D)
    again.merge(tree)
    assert np.array_equal(again.cells_in(EVERYWHERE), plain.cells)
    assert np.array_equal(Quadtree.from_bytes(tree.to_bytes()).cells_in(EVERYWHERE), plain.cells)


@pytest.mark.parametrize("kinds", [np.array([[1]]), np.array([[2]]), np.array([[0, 1], [2, 1]]), np.full((2, 2), 2)])
def test_roots_of_one_and_of_four_cells_were_stored_once_and_are_read(kinds: NDArray[np.int64]) -> None:
    levels, kind = len(kinds) - 1, int(kinds[0, 0])
    body = b""
    if np.any(kinds != kind):
        kind, body = 3, bytes([int((kinds.ravel() << np.arange(0, 8, 2)).sum())])
    corner = -BASE % (1 << levels) - 4
    fields = (MAGIC, VERSION, D, levels, corner, corner, kind, len(body))
    crc = zlib.crc32(body, zlib.crc32(HEADER.pack(*fields, 0)))
    tree = Quadtree.from_bytes(HEADER.pack(*fields, crc) + zlib.compress(body))
    side = len(kinds)
    found = tree.cells_in(Window(corner, corner + side, corner, corner + side))
    assert np.array_equal(found, np.array([-1, 0, 100])[kinds])
    assert tree.count_in(EVERYWHERE).unknown == 160_000 - np.count_nonzero(kinds)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_leaves_cover_the_root_once_and_are_of_one_kind(seed: int) -> None:
    tree = Quadtree.of_patch(patch_of(seed))
    covered = np.zeros((tree.side, tree.side), dtype=np.int64)
    for row, col, size, state in tree.leaves():
        square = Window(int(row), int(row + size), int(col), int(col + size))
        covered[row - tree.window.row0 :, col - tree.window.col0 :][:size, :size] += 1
        assert set(np.unique(tree.cells_in(square)).tolist()) == {PERCENT[int(state)]}
    assert np.all(covered == 1)
    assert tree.leaf_count == len(tree.leaves())


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_points_and_rectangles_say_what_the_cells_say(seed: int) -> None:
    tree, plain = Quadtree.of_patch(patch_of(seed)), Plain()
    plain.write(patch_of(seed))
    rng = np.random.default_rng(seed)
    points = rng.uniform(-9.9, 9.9, (50, 2))
    cells = np.floor(points / D).astype(int)
    values = plain.cells[cells[:, 1] + 200, cells[:, 0] + 200]
    wanted = np.select([values == 0, values == 100], [FREE, OCCUPIED], UNKNOWN)
    assert np.array_equal(tree.state_at(points), wanted)
    found = tree.leaf_of(cells[:, ::-1])
    inside = found[:, 2] > 0
    assert np.array_equal(found[:, 3], wanted)
    assert np.all(found[inside, :2] <= cells[inside, ::-1])
    assert np.all(cells[inside, ::-1] < found[inside, :2] + found[inside, 2:3])
    low, high = np.sort(rng.integers(-200, 200, (2, 2)), axis=0)
    window = Window(int(low[0]), int(high[0]), int(low[1]), int(high[1]))
    part = plain.cells[low[0] + 200 : high[0] + 200, low[1] + 200 : high[1] + 200]
    count = tree.count_in(window)
    counts = [count.unknown, count.free, count.occupied]
    assert counts == [int(np.count_nonzero(part == v)) for v in (-1, 0, 100)]
    assert np.array_equal(tree.cells_in(window), part)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_merging_lets_occupied_win_over_free_and_both_over_unknown(seed: int, other_seed: int) -> None:
    one, other = Quadtree.of_patch(patch_of(seed)), Quadtree.of_patch(patch_of(other_seed))
    a, b, kept = one.cells_in(EVERYWHERE), other.cells_in(EVERYWHERE), other.to_bytes()
    one.merge(other)
    assert np.array_equal(one.cells_in(EVERYWHERE), np.maximum(a, b))
    assert one.node_count == nodes_of(one.cells_in(one.window))
    assert other.to_bytes() == kept
    twin = Quadtree.of_patch(patch_of(other_seed))
    twin.merge(Quadtree.of_patch(patch_of(seed)))
    assert np.array_equal(twin.cells_in(EVERYWHERE), np.maximum(a, b))
    one.merge(one)
    assert np.array_equal(one.cells_in(EVERYWHERE), np.maximum(a, b))


def test_an_empty_tree_and_what_lies_outside_are_unknown() -> None:
    tree = Quadtree(resolution_m=D)
    assert tree.node_count == 1
    assert tree.count_in(Window(-5, 5, -5, 5)).unknown == 100
    assert tree.state_at([(0.0, 0.0), (np.nan, 0.0), (np.inf, 0.0), (1e300, 0.0)]).tolist() == [UNKNOWN] * 4
    assert tree.leaf_of(np.zeros((0, 2), dtype=np.int64)).shape == (0, 4)
    assert Quadtree.from_bytes(tree.to_bytes()).node_count == 1
    tree.write(GridPatch(D, 0, 0, np.zeros((0, 5), dtype=np.int8)))
    assert tree.count_in(Window(5, 0, 0, 5)).unknown == 0


def test_a_map_of_one_kind_is_one_leaf_where_it_fills_a_square() -> None:
    tree = Quadtree.of_patch(GridPatch(D, 0, 0, np.zeros((64, 64), dtype=np.int8)))
    assert tree.leaves().tolist() == [[0, 0, 64, FREE]]
    sides = [
        Quadtree.of_patch(GridPatch(D, -n, -n, np.zeros((2 * n, 2 * n), dtype=np.int8))).side for n in (8, 64, 512)
    ]
    assert all(side <= max(16 * n, 2048) for side, n in zip(sides, (8, 64, 512)))  # straddling the origin costs little


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.data())
def test_bytes_and_back_and_damaged(seed: int, data: st.DataObject) -> None:
    tree = Quadtree.of_patch(patch_of(seed))
    good = tree.to_bytes()
    again = Quadtree.from_bytes(good)
    assert again.to_bytes() == good
    assert np.array_equal(again.cells_in(EVERYWHERE), tree.cells_in(EVERYWHERE))
    at = data.draw(st.integers(0, len(good) - 1))
    plain = bytearray(zlib.decompress(good[HEADER.size :]))
    if plain and data.draw(st.booleans()):
        plain[at % len(plain)] = data.draw(st.integers(0, 255))
        crc = zlib.crc32(plain, zlib.crc32(good[: HEADER.size - 4] + bytes(4)))
        bad = good[: HEADER.size - 4] + crc.to_bytes(4, "little") + zlib.compress(plain)
    else:
        bad = good[:at] + bytes([good[at] ^ 1 << data.draw(st.integers(0, 7))]) + good[at + 1 :]
    for torn in (bad, good[:at]):
        try:
            tree = Quadtree.from_bytes(torn)
        except ValueError:
            continue
        tree.write(GridPatch(tree.resolution_m, 0, 0, patch_of(seed).cells))
        assert tree.count_in(EVERYWHERE).unknown <= 160_000


@pytest.mark.parametrize(
    ("row0", "cells", "resolution_m"),
    [(0, np.zeros(3), D), (0, np.zeros((2, 2)), 0.1), (1 << 41, np.zeros((1, 1)), D), (0, np.zeros((1, 2, 3)), D)],
)
def test_bad_patches_are_refused(row0: int, cells: I8, resolution_m: float) -> None:
    tree = Quadtree.of_patch(patch_of(1))
    before = tree.to_bytes()
    with pytest.raises(ValueError):
        tree.write(GridPatch(resolution_m, row0, 0, cells))
    assert tree.to_bytes() == before


def test_bad_questions_are_refused() -> None:
    tree = Quadtree.of_patch(patch_of(1))
    with pytest.raises(ValueError, match="rectangle"):
        tree.cells_in(Window(0, 1 << 20, 0, 1 << 20))
    for cells in ([(0.5, 1.0)], [1, 2], [(1, 2, 3)]):
        with pytest.raises(ValueError, match="cells"):
            tree.leaf_of(cells)
    with pytest.raises(ValueError, match="points"):
        tree.state_at([(1.0, 2.0, 3.0)])
    with pytest.raises(ValueError):
        tree.merge(Quadtree(resolution_m=0.1))
    with pytest.raises(ValueError):
        Quadtree(resolution_m=D, free_below=70)
    far = Quadtree.of_patch(GridPatch(D, 0, 0, np.zeros((1, 1), dtype=np.int8)))
    with pytest.raises(ValueError, match="edge"):
        far.write(GridPatch(D, 1 << 30, 0, np.zeros((1, 1), dtype=np.int8)))
