"""A given grid as something to localise in: its walls as surfaces, its free space as a witness, and where a scan fits.

    known = known_map(patch)
    places = find_places(known, points)              # anywhere in the map, best first, without a hint
    fits = lay(known, points, poses)                 # laid on the walls, robustly, each from its guess
    verdicts = hold(known, points, poses)            # what each beam says about the pose: also the space it crossed

The grid is read, never written. Search: correlative matching by branch and bound over pooled likelihoods (Olson 2009;
Hess et al. 2016 for the bound by pooling), keeping the best of every piece of floor and sector of headings instead of
one winner: a building repeats itself, and the first scan rarely tells its corridors apart.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle, wrap_angles
from mapping.grids.clearance import DistanceField, squared_cell_distances
from mapping.grids.patch import GridPatch
from mapping.kernels import localise_known as kernels
from mapping.kernels import localise_known_search as search
from mapping.kernels.localise_known_search import BLOCK
from mapping.kernels.localise_search import pool

Bools = NDArray[np.bool_]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U64 = NDArray[np.uint64]
Scalar = TypeVar("Scalar", np.float32, np.bool_)

WALL_FROM_PERCENT = 65
FREE_BELOW_PERCENT = 30
REACH_M = 0.8  # surfaces farther from a point are none of its partners
SURFACE_M = 0.2  # cells this near make a wall cell's line
SEARCH_RESOLUTION_M = 0.1
SEARCH_SIGMA_M = 0.15
FARTHEST_M = 20.0
SEARCH_MARGIN_M = 26.0  # points of joined scans that lie farther from the robot are not searched by
BEAMS = 90  # of a sweep are used: more say little more, and cost
MOST_CELLS = 40_000_000

LAY_REACH_M = (0.6, 0.4, 0.2)
LAY_SCALE_M = (0.2, 0.1, 0.05)
NEAR_M = 0.3
APART_M: F64 = np.array([0.05, 0.1, 0.25, 0.4, 0.8])
LOG_APART: F64 = np.array([-0.35, -0.9, -1.05, -2.8, -3.1])
LOG_ELSE: F64 = np.array([-1.3, -2.2, -3.4, -2.5])
"""Log likelihood of a beam that ends so far from a wall; of one that ends behind a wall, went through one, met
something in free space far from every wall, ended far out in the unknown.

Fitted so that the right place comes first among those that searches find (conditional logit over 120 starts of three
logs, bench/localise.py). The plateau from 0.1 to 0.25 m is that of maps that have their walls only roughly."""


@dataclass(frozen=True, slots=True)
class KnownMap:
    """What localisation needs of a grid; nothing in it is ever written.

    (x0_m, y0_m): the lower left corner in the map frame, resolution_m the cell's side.  kind: (R, C) uint8 unknown,
    free, wall.  room_m: (R, C) distance to what is not free.  nearest: (R, C) which surface is nearest, -1 none within
    REACH_M.  surface: (W, 5) as kernels.surfaces makes it.  fine: likelihoods for the search, in cells of search_m from
    (search_x0_m, search_y0_m) on, (H, V) laid out by in_words; coarse: their maxima over blocks, laid out by in_phases.
    allowed: (H, V) where a robot may stand.  blocks: (B, 2).  digest: sha256 of the grid it was made from.
    """

    resolution_m: float
    x0_m: float
    y0_m: float
    kind: U8
    room_m: F32
    nearest: I32
    surface: F32
    search_m: float
    search_x0_m: float
    search_y0_m: float
    fine: U64
    coarse: U8
    allowed: Bools
    blocks: I64
    digest: str

    @property
    def floor_m2(self) -> float:
        """Free floor, which is where a robot can be."""
        return float(np.count_nonzero(self.kind == kernels.FREE)) * self.resolution_m**2


def digest_of(patch: GridPatch) -> str:
    """sha256 of a grid: its cells and where they lie."""
    head = f"{patch.resolution_m!r} {patch.row0} {patch.col0} {patch.cells.shape}".encode()
    return hashlib.sha256(head + np.ascontiguousarray(patch.cells).tobytes()).hexdigest()


def known_map(patch: GridPatch) -> KnownMap:
    """Prepare a grid; it is copied. Takes about 0.3 s for a million cells.

    Raises ValueError if it has no wall, no free cell or more than MOST_CELLS cells.
    """
    cells = np.pad(patch.cells, 1, constant_values=-1)
    if cells.size > MOST_CELLS:
        raise ValueError(f"a map of {patch.cells.shape} cells is too large to localise in: use a coarser one")
    r = patch.resolution_m
    wall = cells >= WALL_FROM_PERCENT
    free = (cells >= 0) & (cells < FREE_BELOW_PERCENT)
    if not wall.any() or not free.any():
        raise ValueError("a map to localise in needs walls and free space; this one lacks one of them")
    kind = np.where(wall, kernels.WALL, np.where(free, kernels.FREE, kernels.UNKNOWN)).astype(np.uint8)
    room = np.sqrt(squared_cell_distances(~free).astype(np.float32)) * np.float32(r)
    squared, nearest = _nearest_walls(wall, REACH_M / r)
    surface = np.empty((int(wall.sum()), 5), dtype=np.float32)
    kernels.surfaces(np.where(wall, cells, 0).astype(np.uint8), wall, max(1, round(SURFACE_M / r)), r, surface)
    x0, y0 = (patch.col0 - 1) * r, (patch.row0 - 1) * r
    step = max(1, round(SEARCH_RESOLUTION_M / r))
    margin = BLOCK * math.ceil(SEARCH_MARGIN_M / (BLOCK * step * r))
    fine, allowed = _search_rasters(squared, free, r, step, margin)
    return KnownMap(
        r, x0, y0, kind, room, nearest, surface,
        step * r, x0 - margin * step * r, y0 - margin * step * r,
        search.in_words(fine), search.in_phases(pool(fine, BLOCK, 1)), allowed, _blocks_with(allowed), digest_of(patch),
    )  # fmt: skip


def _nearest_walls(wall: Bools, reach_cells: float) -> tuple[I32, I32]:
    """(R, C) exact squared distance to the nearest wall cell, and its number, wall cells counted by row; -1 beyond."""
    field = DistanceField(wall)
    number = (np.cumsum(wall).reshape(wall.shape) - 1).astype(np.int32)
    nearest = number[field.site >> 16, field.site & 0xFFFF]
    nearest[field.squared > reach_cells * reach_cells] = -1
    return field.squared, nearest


def _search_rasters(squared: I32, free: Bools, resolution_m: float, step: int, margin: int) -> tuple[U8, Bools]:
    """Likelihoods and standing room in cells of step x step, with so many cells around that no point lies outside, and
    to whole blocks."""
    likely = np.exp(-0.5 * squared.astype(np.float32) * np.float32((resolution_m / SEARCH_SIGMA_M) ** 2))
    fine = np.asarray(255.0 * _coarser(likely, step), dtype=np.uint8)
    allowed = _coarser(free, step)
    around = [(margin, margin + BLOCK + -n % BLOCK) for n in fine.shape]
    return np.pad(fine, around), np.pad(allowed, around)


def _coarser(values: NDArray[Scalar], step: int) -> NDArray[Scalar]:
    """The largest of each step x step cells."""
    rows, cols = (math.ceil(n / step) for n in values.shape)
    padded = np.zeros((rows * step, cols * step), dtype=values.dtype)
    padded[: values.shape[0], : values.shape[1]] = values
    return np.asarray(padded.reshape(rows, step, cols, step).max(axis=(1, 3)))


def _blocks_with(allowed: Bools) -> I64:
    """(B, 2) blocks in which a robot may stand somewhere."""
    rows, cols = (n // BLOCK for n in allowed.shape)
    cut = allowed[: rows * BLOCK, : cols * BLOCK].reshape(rows, BLOCK, cols, BLOCK)
    return np.argwhere(cut.any(axis=(1, 3))).astype(np.int64)


# --- points -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Points:
    """Beams that hit something, in the base frame: where they end, x_m, y_m (N,), and start, from_x_m, from_y_m."""

    x_m: F64
    y_m: F64
    from_x_m: F64
    from_y_m: F64

    def __len__(self) -> int:
        return len(self.x_m)


def points_of(
    bearing_rad: F64, range_m: F64, base_from_sensor: Pose2, *, nearest_m: float, farthest_m: float, most: int
) -> Points:
    """At most `most` end points of a sweep (N,), evenly by the way along its outline: beams of a near wall lie close
    together and would outvote the rest of the room."""
    hit = np.isfinite(range_m) & (range_m >= nearest_m) & (range_m <= farthest_m)
    local = np.stack((range_m[hit] * np.cos(bearing_rad[hit]), range_m[hit] * np.sin(bearing_rad[hit])), axis=-1)
    if len(local) > most:
        way = np.minimum(np.hypot(*np.diff(local, axis=0).T), 0.3) + 1e-9 if len(local) > 1 else np.zeros(0)
        along = np.concatenate(([0.0], np.cumsum(way)))
        chosen = np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], most)).clip(0, len(local) - 1))
        local = local[chosen]
    x, y = base_from_sensor.apply(local).T
    return Points(
        np.ascontiguousarray(x), np.ascontiguousarray(y),
        np.full(len(x), base_from_sensor.x_m), np.full(len(x), base_from_sensor.y_m),
    )  # fmt: skip


def thinned(points: F64, *, cell_m: float, most: int) -> F64:
    """(M, 2) of points (N, 2): the first in each square of cell_m, and of those evenly at most `most`."""
    squares = np.floor(points / cell_m).astype(np.int64)
    _, first = np.unique(squares, axis=0, return_index=True)
    kept = np.sort(first)
    if len(kept) > most:
        kept = kept[np.linspace(0, len(kept) - 1, most).astype(np.int64)]
    return points[kept]


# --- laying and holding -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Fits:
    """Poses after laying. poses: (K, 3) map_from_base.  hessian: (K, 3, 3), in points per square metre and radian.
    mean_cost: (K,) of the partners, 0 all fit, 1 none.  share: (K,) of points that have a partner.  solved: (K,)."""

    poses: F64
    hessian: F64
    mean_cost: F64
    share: F64
    solved: Bools


def lay(
    known: KnownMap, points: Points, guesses: F64, *, priors: F64 | None = None, stride: int = 1, steps: int = 12
) -> Fits:
    """Lay points on the map's walls from guesses (K, 3), each by itself.

    priors: (K, 3, 3) weight of each guess, in points [1/m^2, 1/rad^2]; None is free.  stride: use every n-th point.
    """
    k = len(guesses)
    local = np.ascontiguousarray(guesses - np.array([known.x0_m, known.y0_m, 0.0]))
    held = np.zeros((k, 3, 3)) if priors is None else np.ascontiguousarray(priors)
    out = np.zeros((k, kernels.MATCH_LENGTH))
    kernels.match_many(
        points.x_m, points.y_m, stride, known.nearest, known.surface, known.resolution_m,
        local, held, np.array(LAY_REACH_M), np.array(LAY_SCALE_M), steps, out,
    )  # fmt: skip
    poses = out[:, :3] + np.array([known.x0_m, known.y0_m, 0.0])
    poses[:, 2] = wrap_angles(poses[:, 2])
    hessian = out[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(k, 3, 3)
    partners = np.maximum(out[:, 10], 1.0)
    used = max(1, math.ceil(len(points) / stride))
    solved = (out[:, 11] > 0.0) & (out[:, 10] >= 3.0) & np.isfinite(out).all(axis=1)
    poses[~solved] = guesses[~solved]
    return Fits(poses, hessian, out[:, 9] / partners, out[:, 10] / used, solved)


@dataclass(frozen=True, slots=True)
class Verdicts:
    """What beams say of poses (K,). log: joint log likelihood, as if beams were independent; shares of all beams:
    explained by a wall, through a wall, unexpected in free space, unseen."""

    log: F64
    explained: F64
    through: F64
    unexpected: F64
    unseen: F64
    beams: int


def hold(known: KnownMap, points: Points, poses: F64, *, stride: int = 1) -> Verdicts:
    """Hold beams against the map at poses (K, 3): their ends, and the space they crossed."""
    k = len(poses)
    local = np.ascontiguousarray(poses - np.array([known.x0_m, known.y0_m, 0.0]))
    votes, logs = np.zeros((k, 4)), np.zeros(k)
    kernels.judge_many(
        points.from_x_m, points.from_y_m, points.x_m, points.y_m, stride,
        known.kind, known.room_m, known.nearest, known.surface, known.resolution_m,
        local, NEAR_M, APART_M, LOG_APART, LOG_ELSE, votes, logs,
    )  # fmt: skip
    beams = max(1, math.ceil(len(points) / stride))
    shares = votes / beams
    return Verdicts(logs, shares[:, 0], shares[:, 1], shares[:, 2], shares[:, 3], beams)


# --- search -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Places:
    """Where points may lie, best first: poses (K, 3), score (K,) mean likelihood of a point's end, 0 to 1."""

    poses: F64
    score: F64


def find_places(
    known: KnownMap,
    points: F64,
    *,
    most: int = 100,
    share: float = 0.75,
    turn_step_rad: float = math.radians(2.0),
    near: tuple[Pose2, float] | None = None,
    most_blocks: int = 60_000,
) -> Places:
    """Poses of the base at which points (N, 2) of its frame fall on walls; all that reach `share` of the best score.

    near: look only within so many metres of a pose.  most_blocks: pieces of 0.8 m looked into at most.
    Two places are 0.6 m or 12 degrees apart at least.
    """
    turns = max(1, round(2.0 * math.pi / turn_step_rad))
    step = 2.0 * math.pi / turns
    sector = max(1, round(math.radians(12.0) / step))
    blocks = known.blocks if near is None else _blocks_near(known, *near)
    points = points[np.hypot(points[:, 0], points[:, 1]) <= SEARCH_MARGIN_M - known.search_m]
    if len(points) > search.MOST_POINTS:
        points = points[np.linspace(0, len(points) - 1, search.MOST_POINTS).astype(np.int64)]
    if not len(blocks) or not len(points):
        return Places(np.zeros((0, 3)), np.zeros(0))
    px, py = (np.ascontiguousarray(v) for v in points.T)
    cx, cy = np.empty((turns, len(px)), dtype=np.int32), np.empty((turns, len(px)), dtype=np.int32)
    search.turned_cells(px, py, known.search_m, step, cx, cy)
    bounds = np.empty((turns, len(blocks)), dtype=np.uint16)
    search.block_bounds(known.coarse, blocks, cx, cy, bounds)
    flat = bounds.ravel()
    likely = np.flatnonzero(flat >= share * 0.5 * flat.max())
    order = likely[np.argsort(flat.max() - flat[likely], kind="stable")]
    best = np.zeros((math.ceil(turns / sector), len(blocks)), dtype=np.int32)
    where = np.zeros((*best.shape, 3), dtype=np.int32)
    top, _ = search.best_in_blocks(
        known.fine, known.allowed, blocks, cx, cy, bounds, order, share, sector, most_blocks, best, where
    )
    ranked = np.flatnonzero(best.ravel() >= max(1.0, share * top))
    ranked = ranked[np.argsort(-best.ravel()[ranked], kind="stable")]
    at = where.reshape(-1, 3)[ranked]
    poses = np.stack(
        (
            known.search_x0_m + (at[:, 2] + 0.5) * known.search_m,
            known.search_y0_m + (at[:, 1] + 0.5) * known.search_m,
            wrap_angles(at[:, 0] * step),
        ),
        axis=-1,
    )
    kept = apart(poses, metres=0.6, radians=math.radians(12.0), most=most)
    return Places(poses[kept], best.ravel()[ranked][kept] / (255.0 * len(points)))


def _blocks_near(known: KnownMap, pose: Pose2, radius_m: float) -> I64:
    side = BLOCK * known.search_m
    x = known.search_x0_m + (known.blocks[:, 1] + 0.5) * side - pose.x_m
    y = known.search_y0_m + (known.blocks[:, 0] + 0.5) * side - pose.y_m
    return np.asarray(known.blocks[np.hypot(x, y) <= radius_m + 0.75 * side])


def apart(poses: F64, *, metres: float, radians: float, most: int) -> I64:
    """Rows of poses (K, 3), best first, that lie so far from every better one; at most `most`."""
    kept = np.empty(min(most, len(poses)), dtype=np.int64)
    return kept[: kernels.apart(np.ascontiguousarray(poses), metres, radians, kept)]


def pose_of(row: F64) -> Pose2:
    """A row (3,) as a pose."""
    return Pose2(float(row[0]), float(row[1]), wrap_angle(float(row[2])))
