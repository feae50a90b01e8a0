"""Walls of finished maps: what is counted, what explains it, and what becomes of the cells."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label

from mapping.frames import Pose2
from mapping.grids import walls
from mapping.grids.evidence import Model
from mapping.grids.occupancy import FREE, OCCUPIED, PARTLY_FREE, UNKNOWN, OccupancyGrid
from mapping.grids.walls import BeamCounts, EndTiles, WallRules
from mapping.kernels import walls as kernels

F64 = NDArray[np.float64]

BEARING = np.radians(np.arange(-90.0, 90.5, 1.0))
WALL_Y_M = 2.03
MAX_M = 30.0


def to_wall(pose: Pose2, y_m: float = WALL_Y_M) -> F64:
    """Ranges (181,) to an endless wall along x at y_m; +inf where a beam goes away from it or meets it beyond 12 m."""
    sine = np.sin(BEARING + pose.yaw_rad)
    with np.errstate(divide="ignore"):
        range_m = (y_m - pose.y_m) / sine
    return np.where((range_m > 0.0) & (range_m < 12.0), range_m, np.inf)


def drive(scatter_m: float, seed: int, places: int = 80) -> list[tuple[Pose2, F64]]:
    """Scans along the wall and where they are said to be from, off across the wall and in heading."""
    rng = np.random.default_rng(seed)
    scans = []
    for x in np.linspace(0.0, 8.0, places):
        true = Pose2(float(x), 0.0, math.radians(rng.uniform(20.0, 160.0)))
        off_m, off_rad = rng.normal(0.0, scatter_m), rng.normal(0.0, scatter_m / 20.0)
        scans.append((Pose2(true.x_m, true.y_m + off_m, true.yaw_rad + off_rad), to_wall(true)))
    return scans


def grid_of(scans: list[tuple[Pose2, F64]], model: Model = "log-odds") -> OccupancyGrid:
    grid = OccupancyGrid(model=model)
    for pose, ranges in scans:
        grid.insert_scan(pose, BEARING, ranges, range_max_m=MAX_M, clear_no_return=False)
    return grid


def counts_of(grid: OccupancyGrid, scans: list[tuple[Pose2, F64]]) -> BeamCounts:
    counts = BeamCounts(grid)
    for pose, ranges in scans:
        counts.add(pose, BEARING, ranges, range_max_m=MAX_M)
    return counts


def held_back(grid: OccupancyGrid, scans: list[tuple[Pose2, F64]]) -> tuple[float, float]:
    """Share of ends within 10 cm of an occupied cell, share of beams that meet one 20 cm before; by small steps."""
    patch = grid.patch()
    row, col = np.nonzero(patch.cells >= 65)
    middles = (np.stack((col + patch.col0, row + patch.row0), axis=-1) + 0.5) * 0.05
    near, early = [], []
    for pose, ranges in scans:
        for bearing, range_m in zip(BEARING + pose.yaw_rad, ranges):
            if math.isfinite(range_m):
                way = np.array([math.cos(bearing), math.sin(bearing)])
                end = np.array([pose.x_m, pose.y_m]) + range_m * way
                to_square = np.maximum(np.abs(middles - end) - 0.025, 0.0)
                near.append(np.hypot(*to_square.T).min() < 0.1)
                steps = np.arange(0.0, max(range_m - 0.2, 0.0), 0.01)
                on_way = np.array([pose.x_m, pose.y_m]) + steps[:, None] * way
                early.append(bool(np.any(grid.state_at(on_way) == OCCUPIED)))
    return float(np.mean(near)), float(np.mean(early))


def test_a_smeared_wall_becomes_a_thin_one_that_beams_end_at_and_do_not_cross() -> None:
    scans, others = drive(0.04, seed=1), drive(0.04, seed=2, places=15)
    grid = grid_of(scans)
    near_before, early_before = held_back(grid, others)
    grid.call_occupied(counts_of(grid, scans).walls())
    near, early = held_back(grid, others)
    assert early_before > 0.02  # else there is nothing to mend
    assert early < early_before / 2.0
    assert near > near_before - 0.06


@pytest.mark.parametrize("yaw_deg", [0.0, 7.0, 23.0, 45.0])
def test_a_sharp_wall_has_no_gaps_and_stays_where_it_is(yaw_deg: float) -> None:
    """However it lies in its cells: straight ways across it, 1 cm apart, meet an occupied cell near the surface."""
    turn = Pose2(0.0, 0.0, math.radians(yaw_deg))
    scans = [(turn @ pose, ranges) for pose, ranges in drive(0.0, seed=3)]
    grid = grid_of(scans)
    grid.call_occupied(counts_of(grid, scans).walls())
    across = WALL_Y_M + np.arange(-0.15, 0.15, 0.0005)
    blocked = []
    for x in np.arange(1.0, 7.0, 0.01):
        way = np.stack((np.full_like(across, x), across), axis=-1) @ turn.matrix()[:2, :2].T
        blocked.append(bool(np.any(grid.state_at(way) == OCCUPIED)))
    assert np.mean(blocked) > 0.99  # at 45 degrees such steps may slip through where two cells touch at a corner
    patch = grid.patch()
    row, col = np.nonzero(patch.cells >= 65)
    middles = (np.stack((col + patch.col0, row + patch.row0), axis=-1) + 0.5) * 0.05 @ turn.matrix()[:2, :2]
    inner = (middles[:, 0] > 1.0) & (middles[:, 0] < 7.0)
    off = middles[inner, 1] - WALL_Y_M
    assert -0.05 < off.min() <= off.max() < 0.08
    assert abs(off.mean()) < 0.025


@pytest.mark.parametrize("model", ["log-odds", "counters"])
def test_what_stood_there_for_one_scan_is_neither_wall_nor_free(model: Model) -> None:
    """A person 1 m in front of the wall, seen in the last scan of many: occupied by the newest hits, looked through."""
    scans = drive(0.0, seed=4)
    pose, ranges = scans[-1]
    before_it = np.abs(BEARING + pose.yaw_rad - math.pi / 2.0) < math.radians(6.0)
    scans = scans[:-1] + [(pose, np.where(before_it, 1.0, ranges))]
    grid = OccupancyGrid(model=model)
    for each, seen in scans[-1:] + scans[:-1] + scans[-1:] * 5:
        grid.insert_scan(each, BEARING, seen, range_max_m=MAX_M, clear_no_return=False)
    there = [[pose.x_m, pose.y_m + 0.99]]
    was = grid.state_at(there)[0]
    grid.call_occupied(counts_of(grid, scans).walls())
    assert grid.state_at(there)[0] == (PARTLY_FREE if was == OCCUPIED else was)
    assert was == OCCUPIED or model == "counters"


def test_counts_that_are_full_keep_their_ratio() -> None:
    """A robot that stands for hours: two of three beams end in a cell, the third passes it."""
    grid = OccupancyGrid()
    grid.insert_scan(Pose2(0.01, 0.01), np.zeros(1), np.array([3.0]), range_max_m=MAX_M)
    counts = BeamCounts(grid)
    counts.add(Pose2(0.01, 0.01), np.zeros(300_000), np.tile([2.0, 2.0, 3.0], 100_000), range_max_m=MAX_M)
    cell = np.array([[0, 40]])
    ended, passed = counts._at(counts._ends, cell)[0], counts._at(counts._passes, cell)[0]
    assert 16_000 < passed < 65_536
    assert ended / passed == pytest.approx(2.0, rel=0.01)


def test_walls_are_found_piece_by_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    scans = drive(0.04, 3)
    counts = counts_of(grid_of(scans), scans)
    whole = counts.walls()
    assert len(whole) > 100
    monkeypatch.setattr(walls, "PIECE", 7)
    np.testing.assert_array_equal(counts.walls(), whole)


def test_tiles_without_ends_need_not_be_counted_in() -> None:
    """A yard: most beams end far off, at the edges of tiles too."""
    rng = np.random.default_rng(4)
    scans = []
    for x in np.linspace(-30.0, 30.0, 40):
        ranges = rng.choice([5.0, 12.0, 25.0], len(BEARING)) + rng.normal(0.0, 0.1, len(BEARING))
        scans.append((Pose2(float(x), 0.3, float(rng.uniform(-3.0, 3.0))), np.where(BEARING < 0.2, ranges, 25.6)))
    grid = grid_of(scans)
    ends = EndTiles(grid)
    for pose, ranges in scans:
        ends.add(pose, BEARING, ranges, range_max_m=MAX_M)
    few = BeamCounts(grid, ends.places())
    for pose, ranges in scans:
        few.add(pose, BEARING, ranges, range_max_m=MAX_M)
    np.testing.assert_array_equal(few.walls(), counts_of(grid, scans).walls())


def test_tiles_within_reach_of_an_end_are_marked_and_no_others() -> None:
    grid = OccupancyGrid(resolution_m=0.1)
    grid.insert_cells([(row, col) for row in (-5, 5) for col in (-5, 5, 140)], [])
    for col, expected in ((3, 1), (1, 2), (126, 2), (64, 1)):
        ends = EndTiles(grid)
        ends.add(Pose2(0.05, 6.05), np.zeros(1), np.array([0.1 * col]), range_max_m=MAX_M)
        found = {tuple(place) for place in ends.places().tolist()}
        assert (0, 0) in found
        assert len(found) == expected, (col, found)


def test_ends_and_passes_are_counted_where_they_are() -> None:
    grid = OccupancyGrid(resolution_m=0.1)
    grid.insert_cells([(0, 0), (5, -5)], [])
    counts = BeamCounts(grid)
    bearings = np.array([0.0, math.pi / 2.0, math.pi, 0.1, 0.2, 0.3, 0.4])
    ranges = np.array([0.5, 0.3, 0.4, np.nan, np.inf, -np.inf, 9.0])
    counts.add(Pose2(0.05, 0.05), bearings, ranges, range_max_m=5.0)
    cells = np.array([(0, col) for col in range(-5, 7)] + [(row, 0) for row in range(1, 5)])
    assert counts._at(counts._ends, cells).tolist() == [0, 1] + [0] * 8 + [1, 0] + [0, 0, 1, 0]
    assert counts._at(counts._passes, cells).tolist() == [0, 0, 1, 1, 1, 3, 1, 1, 1, 1, 0, 0] + [1, 1, 0, 0]
    assert counts._passes.sum() == 3 + 7 + 2
    assert counts._ends.sum() == 3


def test_what_lies_in_no_tile_is_not_counted() -> None:
    grid = OccupancyGrid(resolution_m=0.1)
    assert BeamCounts(grid).walls().shape == (0, 2)
    BeamCounts(grid).add(Pose2(), np.zeros(1), np.ones(1), range_max_m=5.0)
    grid.insert_cells([(0, 0)], [])
    counts = BeamCounts(grid)
    counts.add(Pose2(0.05, 0.05), np.array([0.0, math.pi]), np.array([20.0, 20.0]), range_max_m=50.0)
    assert counts._ends.sum() == 0
    assert counts._passes.sum() == 129  # of the 400 cells on the way; both beams pass the first


def test_a_wall_across_the_border_of_tiles_is_found_as_elsewhere() -> None:
    """Moved by whole cells, so that a border of tiles runs through it, a wall is the same cells, moved."""
    found = []
    for shift in (0, 64):
        moved = Pose2(shift * 0.05, shift * 0.05, 0.0)
        scans = [(moved @ pose, ranges) for pose, ranges in drive(0.03, seed=5, places=20)]
        grid = grid_of(scans)
        found.append({tuple(cell) for cell in (counts_of(grid, scans).walls() - shift).tolist()})
    assert len(found[0]) > 100
    assert len(found[0] ^ found[1]) < 0.02 * len(found[0])  # ends on a cell's border may round to either side


def test_the_lazy_cover_chooses_as_the_plain_one_does() -> None:
    """The plain one works out every cell's worth anew before each choice."""
    rng = np.random.default_rng(6)
    for _ in range(30):
        n = int(rng.integers(1, 40))
        near = np.concatenate((np.arange(n)[:, None], rng.integers(-1, n, (n, 3))), axis=1)
        for row in near:  # each at most once
            row[1:][[k in row[:j] for j, k in enumerate(row[1:].tolist(), 1)]] = -1
        ends, cost = rng.integers(0, 9, n).astype(float), rng.integers(1, 9, n) + 0.5
        chosen = np.zeros(n, dtype=np.bool_)
        kernels.cover(near.astype(np.int32), ends, cost, 0.4, chosen)
        plain, left = np.zeros(n, dtype=np.bool_), ends.copy()
        while True:
            worth = np.array([left[row[row >= 0]].sum() for row in near]) / cost
            best = int(np.argmax(worth))
            if worth[best] < 0.4:
                break
            plain[best] = True
            left[near[best][near[best] >= 0]] = 0.0
        assert np.array_equal(chosen, plain)


def judged(ends: NDArray[np.int64], passes: NDArray[np.int64], rules: WallRules) -> NDArray[np.bool_]:
    """Walls of counts (R, C) alone."""
    wall = np.zeros(ends.shape, dtype=np.bool_)
    kernels.judge_window(
        ends, passes, walls.blur_weights(rules), walls.NEAR, walls.rule_row(rules), walls.HALF_A_BEAM, wall
    )
    return wall


@pytest.mark.parametrize("seed", range(8))
def test_making_walls_thin_opens_no_gap_and_tears_none(seed: int) -> None:
    """Any counts: walls that hung together do so still, or are gone, and no two free places are joined."""
    rng = np.random.default_rng(seed)
    ends = gaussian_filter(rng.random((60, 70)), rng.uniform(0.5, 2.0)) > rng.uniform(0.45, 0.52)
    ends = np.pad(ends, 3) * rng.integers(1, 9, (66, 76))
    passes = rng.integers(0, 4, ends.shape)
    number = np.full(ends.shape, -1, dtype=np.int32)
    number[1:-1, 1:-1] = np.arange(64 * 74).reshape(64, 74)
    at = np.argwhere(number >= 0)
    near = np.full((len(at), len(walls.NEAR)), -1, dtype=np.int32)
    for j, offset in enumerate(walls.NEAR):
        near[:, j] = np.pad(number, 2, constant_values=-1)[tuple((at + offset + 2).T)]
    thick = ends[1:-1, 1:-1] > passes[1:-1, 1:-1]
    wall = thick.ravel().copy()
    cost = passes[1:-1, 1:-1].ravel() + 0.5
    kernels.make_thin(
        near, ends[1:-1, 1:-1].ravel().astype(np.float64), cost, 1.0, rng.random(wall.size) < 0.2, wall
    )  # fmt: skip
    thin = wall.reshape(64, 74)
    assert thick.sum() > thin.sum() > 50
    assert not np.any(thin & ~thick)
    parts, count = label(thick, np.ones((3, 3)))
    for part in range(1, count + 1):
        assert label(thin & (parts == part), np.ones((3, 3)))[1] <= 1
    free, count = label(~thin)
    for piece in range(1, count + 1):
        before = label(~thick)[0][(free == piece) & ~thick]
        assert len(np.unique(before)) <= 1


def test_a_wall_two_cells_thick_keeps_the_row_in_which_more_end_than_pass() -> None:
    ends, passes = np.zeros((2, 20, 40), dtype=np.int64)
    ends[10, 5:35], passes[10, 5:35] = 6, 5
    ends[11, 5:35], passes[11, 5:35] = 5, 1
    wall = judged(ends, passes, WallRules())
    assert not wall[10, 7:33].any()
    assert wall[11, 5:35].all()


def test_the_end_of_a_row_in_which_most_beams_ended_stays() -> None:
    """A jamb: no door becomes wider than it was seen to be."""
    ends, passes = np.zeros((2, 20, 40), dtype=np.int64)
    ends[10, 5:20] = 5
    ends[10, 24:35], passes[10, 24:35] = 5, 4
    wall = judged(ends, passes, WallRules())
    assert wall[10, 5:20].all()
    assert wall[10, 26:33].all()


@pytest.mark.parametrize("model", ["log-odds", "counters"])
def test_calling_cells_occupied_frees_none(model: Model) -> None:
    rng = np.random.default_rng(7)
    grid = OccupancyGrid(model=model)
    for _ in range(12):
        grid.insert_cells(rng.integers(-40, 160, (2000, 2)), rng.integers(-40, 160, (4000, 2)))
    every = np.stack(np.meshgrid(np.arange(-40, 160), np.arange(-40, 160), indexing="ij"), axis=-1).reshape(-1, 2)
    middles = (every[:, ::-1] + 0.5) * grid.resolution_m
    before = grid.state_at(middles)
    named = rng.random(len(every)) < 0.1
    grid.take_changes()
    added, lowered = grid.call_occupied(np.concatenate((every[named], [(90000, 0)])))
    after = grid.state_at(middles)
    assert {int(k) for k in before} == {int(k) for k in (UNKNOWN, FREE, PARTLY_FREE, OCCUPIED)}
    assert np.array_equal(after == OCCUPIED, named)
    assert added == np.count_nonzero(named & (before != OCCUPIED))
    assert lowered == np.count_nonzero(~named & (before == OCCUPIED))
    assert np.all(before[after == FREE] == FREE)
    assert np.all(after[~named & (before == OCCUPIED)] == PARTLY_FREE)
    unchanged = ~named & (before != OCCUPIED)
    assert np.array_equal(after[unchanged], before[unchanged])
    assert sum(patch.cells.size for patch in grid.take_changes()) > 0


def test_calling_no_cell_occupied_leaves_none() -> None:
    grid = grid_of(drive(0.0, seed=8, places=3))
    grid.call_occupied(np.zeros((0, 2), dtype=np.int64))
    assert not np.any(grid.patch().cells >= 65)
    assert OccupancyGrid().call_occupied([]) == (0, 0)


@pytest.mark.parametrize("rules", [{"ends_per_pass": 0.0}, {"wall_per_pass": math.inf}, {"blur_cells": 0.6}])
def test_impossible_rules_are_refused(rules: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(rules))):
        WallRules(**rules)
