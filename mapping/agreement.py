"""One truth, several views: where the grid, the line map and the topological maps contradict each other.

    verdict = walls_in(grid, start_m, end_m)        # one for each wall: AGREES, UNKNOWN or DISAGREES

Nothing is changed by a comparison: each map is right about what it saw last, and which of two is out of date is not
told here. What one of them does not know is UNKNOWN, never a disagreement. Coordinates are those of the map, metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.grids.patch import GridPatch

F64 = NDArray[np.float64]
I8 = NDArray[np.int8]
I32 = NDArray[np.int32]
Bools = NDArray[np.bool_]

AGREES, UNKNOWN, DISAGREES = range(3)
_PASSED_SHARE: Final = 0.5  # the middle part of a passage, between a quarter and three quarters of it
_BARRED_SHARE: Final = 0.6  # across a way
_ROWS, _COLS = range(2)


@dataclass(frozen=True, slots=True)
class AgreementRules:
    """When two views contradict each other.

    free_below, occupied_from: per cent, as published.  blocked_from: of a passage or room that was free, which takes
    time to fill up: more likely occupied than not.  slack_m: a wall may lie so far beside its occupied cells.
    depth_m: a passage is blocked by what stands so near its line, in front or behind.  across_m: a way by what reaches
    so far to both sides.  least_m2: of a room has to be
    occupied that was free when the room was found; a person's legs are less.  share: of what is known has to say so.
    """

    free_below: int = 35
    occupied_from: int = 65
    blocked_from: int = 51
    slack_m: float = 0.1
    depth_m: float = 0.1
    across_m: float = 0.2
    least_m2: float = 0.1
    share: float = 0.5
    looked_m: float = 1.0


def walls_in(grid: GridPatch, start_m: ArrayLike, end_m: ArrayLike, rules: AgreementRules | None = None) -> I8:
    """(N,) verdicts: a wall of a line map is occupied in the grid.

    start_m, end_m: (N, 2).  A sample of a wall agrees where a cell within slack_m is occupied, and disagrees where the
    cell is free and none of those is occupied. A wall is unknown if less than the share of its samples is either.
    """
    rules = rules or AgreementRules()
    owner, at = _along(as_ends(start_m), as_ends(end_m), grid.resolution_m)
    reach = math.ceil(rules.slack_m / grid.resolution_m)
    offset = np.arange(-reach, reach + 1)
    around = np.stack(np.meshgrid(offset, offset, indexing="ij"), axis=-1).reshape(-1, 2)
    cell = _cells(grid, at)
    occupied: Bools = np.any(_values(grid, cell[:, None, :] + around[None, :, :]) >= rules.occupied_from, axis=1)
    own = _values(grid, cell)
    free = (own >= 0) & (own < rules.free_below) & ~occupied
    return _verdicts(len(as_ends(start_m)), owner, against=free, for_it=occupied, share=rules.share)


def passages_in(grid: GridPatch, ends_m: ArrayLike, rules: AgreementRules | None = None) -> I8:
    """(N,) verdicts: a passage of a graph is free in the grid, in the middle half of it.

    ends_m: (N, 2, 2) its two ends.  A sample of that half is blocked if a cell within depth_m across is
    more likely occupied than not.
    """
    rules = rules or AgreementRules()
    ends = np.asarray(ends_m, dtype=np.float64).reshape(-1, 2, 2)
    middle, way = ends.mean(axis=1), ends[:, 1] - ends[:, 0]
    half = 0.5 * _PASSED_SHARE * way
    owner, at = _along(middle - half, middle + half, 0.5 * grid.resolution_m)
    strip = at[:, None, :] + _offsets(rules.depth_m, grid.resolution_m)[:, None] * _across(way)[owner][:, None]
    blocked: Bools = np.any(_values(grid, _cells(grid, strip)) >= rules.blocked_from, axis=1)
    own = _values(grid, _cells(grid, at))
    free = (own >= 0) & (own < rules.free_below) & ~blocked
    return _verdicts(len(ends), owner, against=blocked, for_it=free, share=rules.share)


def ways_in(grid: GridPatch, ways_m: ArrayLike, rules: AgreementRules | None = None) -> I8:
    """(N,) verdicts: a way of a graph is free in the grid.

    ways_m: (N, K, 2), each from point to point, straight on. One is blocked by what is more likely occupied than not on
    six tenths of the strip across it, across_m to both sides, within depth_m along it: a door's leaf is, legs are
    not. It is unknown if less than the share of its samples is free.
    """
    rules = rules or AgreementRules()
    ways = np.asarray(ways_m, dtype=np.float64)
    if not ways.size:
        return np.zeros(0, dtype=np.int8)
    start, end = ways[:, :-1].reshape(-1, 2), ways[:, 1:].reshape(-1, 2)
    segment, at = _along(start, end, 0.5 * grid.resolution_m)
    own = _values(grid, _cells(grid, at))
    strip = (
        at[:, None, :] + _offsets(rules.across_m, grid.resolution_m)[:, None] * _across(end - start)[segment][:, None]
    )
    occupied = _values(grid, _cells(grid, strip)) >= rules.blocked_from
    near = occupied.copy()
    for away in range(1, math.ceil(2.0 * rules.depth_m / grid.resolution_m) + 1):
        same = (segment[away:] == segment[:-away])[:, None]
        near[away:] |= occupied[:-away] & same
        near[:-away] |= occupied[away:] & same
    blocked = near.mean(axis=1) >= _BARRED_SHARE
    free = (own >= 0) & (own < rules.free_below)
    owner = segment // (ways.shape[1] - 1)
    samples, is_free = (np.bincount(owner, weights=each, minlength=len(ways)) for each in (np.ones(len(owner)), free))
    verdict = np.where(is_free >= rules.share * samples, AGREES, UNKNOWN).astype(np.int8)
    verdict[np.unique(owner[blocked])] = DISAGREES
    return verdict


def walled_passages(ends_m: ArrayLike, start_m: ArrayLike, end_m: ArrayLike, rules: AgreementRules | None = None) -> I8:
    """(N,) verdicts: no wall of a line map stands across a passage of a graph, along the middle half of it.

    ends_m: (N, 2, 2).  start_m, end_m: (M, 2) of walls. One bars a passage if it covers half of that part, at most
    slack_m and depth_m off. A line map that has nothing there may not have looked: it AGREES where it has walls so near
    to both ends of a passage, and none across.
    """
    rules = rules or AgreementRules()
    ends = np.asarray(ends_m, dtype=np.float64).reshape(-1, 2, 2)
    start, end = as_ends(start_m), as_ends(end_m)
    verdict = np.full(len(ends), UNKNOWN, dtype=np.int8)
    way, near_m = end - start, rules.slack_m + rules.depth_m
    squared = np.maximum((way * way).sum(axis=1), 1e-12)
    for k, (a, b) in enumerate(ends):
        at = a + np.linspace(0.25, 0.75, 11)[:, None] * (b - a)
        barred = (_from_walls(at, start, way, squared) <= near_m).mean(axis=0) if len(start) else np.zeros(0)
        level = np.abs(way @ (b - a)) >= math.cos(math.radians(20.0)) * np.sqrt(squared) * math.dist(a, b)
        if (level & (barred > rules.share)).any():
            verdict[k] = DISAGREES
        elif len(start) and (_from_walls(ends[k], start, way, squared).min(axis=1) <= near_m).all():
            verdict[k] = AGREES
    return verdict


def crossed_ways(ways_m: ArrayLike, start_m: ArrayLike, end_m: ArrayLike, rules: AgreementRules | None = None) -> I8:
    """(N,) verdicts: no wall of a line map crosses a way of a graph.

    ways_m: (N, K, 2), each from point to point, straight on.  start_m, end_m: (M, 2) of walls, of which slack_m at
    either end does not count. Where no wall is within looked_m of any of its points, UNKNOWN: nobody looked.
    """
    rules = rules or AgreementRules()
    ways = np.asarray(ways_m, dtype=np.float64)
    start, end = as_ends(start_m), as_ends(end_m)
    verdict = np.full(len(ways), UNKNOWN, dtype=np.int8)
    if not len(start) or not ways.size:
        return verdict
    way = end - start
    squared = np.maximum((way * way).sum(axis=1), 1e-12)
    cut = rules.slack_m * way / np.sqrt(squared)[:, None]
    first, last = start + cut, end - cut
    long = squared > (2.0 * rules.slack_m) ** 2
    for k, points in enumerate(ways):
        if _from_walls(points, start, way, squared).min() <= rules.looked_m:
            verdict[k] = AGREES
        for a, b in pairwise(points):
            sides = _side(a, b, first) * _side(a, b, last), _side(first, last, a) * _side(first, last, b)
            if (long & (sides[0] < 0.0) & (sides[1] <= 0.0)).any():
                verdict[k] = DISAGREES
    return verdict


def _side(a: F64, b: F64, of: F64) -> F64:
    """On which side of a line from a to b points lie: (M,) signs, of (2,) and (M, 2) that fit each other."""
    along, to = b - a, of - a
    return np.asarray(np.sign(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0]))


def _from_walls(points: F64, start: F64, way: F64, squared: F64) -> F64:
    """(N, M) distances of points (N, 2) from walls (M, 2): start, way, squared length of it."""
    along = np.clip(((points[:, None] - start) * way).sum(axis=-1) / squared, 0.0, 1.0)
    return np.asarray(np.hypot(*(points[:, None] - start - along[..., None] * way).transpose(2, 0, 1)))


def rooms_in(
    grid: GridPatch, labels: I32, was_free: Bools, row0: int, col0: int, count: int, rules: AgreementRules | None = None
) -> I8:
    """(count,) verdicts for rooms 1 to count: what was free of a room when it was found is not occupied.

    labels: (R, C) numbers of rooms, 0 for none.  was_free: (R, C) cells of the grid then.  row0, col0: their place.
    A room agrees if the share of what was free is known now.
    """
    rules = rules or AgreementRules()
    top, left = row0 - grid.row0, col0 - grid.col0
    height, width = grid.cells.shape
    now = np.full(labels.shape, -1, dtype=np.int8)
    into = (
        slice(max(-top, 0), max(min(height - top, labels.shape[_ROWS]), 0)),
        slice(max(-left, 0), max(min(width - left, labels.shape[_COLS]), 0)),
    )
    if into[0].start < into[0].stop and into[1].start < into[1].stop:
        now[into] = grid.cells[into[0].start + top : into[0].stop + top, into[1].start + left : into[1].stop + left]
    counted = np.where(was_free, labels, 0).ravel()
    occupied = np.bincount(counted, weights=(now >= rules.blocked_from).ravel(), minlength=count + 1)[1 : count + 1]
    known = np.bincount(counted, weights=(now >= 0).ravel(), minlength=count + 1)[1 : count + 1]
    whole = np.bincount(counted, minlength=count + 1)[1 : count + 1]
    verdict = np.where((known > 0) & (known >= rules.share * whole), AGREES, UNKNOWN).astype(np.int8)
    verdict[occupied * grid.resolution_m**2 >= rules.least_m2] = DISAGREES
    return verdict


def points_in(grid: GridPatch, points_m: ArrayLike, rules: AgreementRules | None = None) -> I8:
    """(N,) verdicts: a place of a topological map, (N, 2), lies in free space."""
    rules = rules or AgreementRules()
    value = _values(grid, _cells(grid, np.asarray(points_m, dtype=np.float64).reshape(-1, 2)))
    verdict = np.full(len(value), UNKNOWN, dtype=np.int8)
    verdict[(value >= 0) & (value < rules.free_below)] = AGREES
    verdict[value >= rules.occupied_from] = DISAGREES
    return verdict


def as_ends(points: ArrayLike) -> F64:
    """(N, 2) float64; ValueError if it is not that or not finite."""
    given = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    if not np.all(np.isfinite(given)):
        raise ValueError("points must be finite")
    return given


def _across(way: F64) -> F64:
    """(N, 2) of length 1, at right angles to the left."""
    return np.asarray(np.stack((-way[:, 1], way[:, 0]), axis=-1) / np.maximum(np.hypot(*way.T), 1e-9)[:, None])


def _offsets(reach_m: float, step_m: float) -> F64:
    """From -reach_m to reach_m, 0 among them, about step_m apart."""
    return np.linspace(-reach_m, reach_m, 2 * (math.ceil(2.0 * reach_m / step_m) // 2) + 1)


def _along(start: F64, end: F64, step_m: float) -> tuple[NDArray[np.int64], F64]:
    """Points about step_m apart on segments: (K,) which segment, (K, 2)."""
    length = np.hypot(*(end - start).T)
    count = np.maximum(np.ceil(length / step_m).astype(np.int64), 1)
    owner = np.repeat(np.arange(len(start)), count)
    first = np.repeat(np.cumsum(count) - count, count)
    share = (np.arange(len(owner)) - first + 0.5) / count[owner]
    return owner, start[owner] + share[:, None] * (end - start)[owner]


def _cells(grid: GridPatch, points_m: F64) -> NDArray[np.int64]:
    """[row, col] in the patch; they may lie outside."""
    whole = np.floor(points_m[..., ::-1] / grid.resolution_m).astype(np.int64)
    return np.asarray(whole - (grid.row0, grid.col0))


def _values(grid: GridPatch, cells: NDArray[np.int64]) -> I8:
    """What the grid says of cells (..., 2); -1 outside."""
    rows, cols = cells[..., _ROWS], cells[..., _COLS]
    height, width = grid.cells.shape
    inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
    found = (
        grid.cells[np.where(inside, rows, 0), np.where(inside, cols, 0)] if grid.cells.size else np.zeros(rows.shape)
    )
    return np.where(inside, found, -1).astype(np.int8)


def _verdicts(count: int, owner: NDArray[np.int64], *, against: Bools, for_it: Bools, share: float) -> I8:
    samples = np.bincount(owner, minlength=count)
    no, yes = (np.bincount(owner, weights=each, minlength=count) for each in (against, for_it))
    verdict = np.full(count, UNKNOWN, dtype=np.int8)
    judged = (samples > 0) & (no + yes >= share * samples)
    verdict[judged] = np.where(no[judged] > share * (no + yes)[judged], DISAGREES, AGREES)
    return verdict
