"""The elevation map: heights of a 3D cloud by cell, and where a vehicle can drive on them (S33).

A cell keeps how many points fell into it, their least and greatest height, and their first two moments, so clouds add
up in any order. From a cell and its eight neighbours follow the slope (least squares plane through their mean
heights), the roughness (rms distance from that plane along z) and the step (greatest difference of height within the
cell, or from its mean to a neighbour's). What was not seen, or has too few neighbours to tell, is unknown, and unknown
is never traversable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.grids.geometry import cells_of, check_resolution

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I8 = NDArray[np.int8]

MAX_CELLS: Final = 1 << 24
_AROUND: Final = tuple((row, col) for row in (-1, 0, 1) for col in (-1, 0, 1))


class Ground(IntEnum):
    """What a cell is to a vehicle."""

    UNKNOWN = -1
    TRAVERSABLE = 0
    ROUGH = 1
    STEEP = 2
    STEP = 3


@dataclass(frozen=True, slots=True)
class GroundRules:
    """What a vehicle can do. points_min: fewer points leave a cell unknown.  neighbours_min: known ones of eight."""

    slope_max_rad: float = math.radians(20.0)
    step_max_m: float = 0.08
    roughness_max_m: float = 0.03
    points_min: int = 3
    neighbours_min: int = 4

    def __post_init__(self) -> None:
        if not (0.0 < self.slope_max_rad < math.pi / 2.0 and self.step_max_m > 0.0 and self.roughness_max_m > 0.0):
            raise ValueError("slope_max_rad is above 0 and below a right angle, step and roughness are above 0")
        if self.points_min < 1 or not 2 <= self.neighbours_min <= 8:
            raise ValueError("points_min is at least 1, neighbours_min 2 to 8")


@dataclass(frozen=True, slots=True)
class Elevation:
    """An elevation map at one instant; (R, C) each, cells[0, 0] is (row0, col0), NaN where nothing is known.

    min_m, max_m, mean_m, variance_m2: of the heights in the cell.  slope_rad, step_m, roughness_m: see above; NaN
    with fewer than neighbours_min known neighbours, or if those lie in a line.  ground: Ground.
    """

    resolution_m: float
    row0: int
    col0: int
    count: I64
    min_m: F64
    max_m: F64
    mean_m: F64
    variance_m2: F64
    slope_rad: F64
    step_m: F64
    roughness_m: F64
    ground: I8


class ElevationMap:
    """Heights of clouds in the map frame, z up; grows with them up to 16.8 million cells.

    height_max_m: points above are left out: ceilings, and what the vehicle passes under. Raises ValueError if a cloud
    would make it larger; points that are not finite are counted in rejected_points.
    """

    def __init__(
        self, *, resolution_m: float = 0.1, rules: GroundRules | None = None, height_max_m: float = math.inf
    ) -> None:
        self.resolution_m = check_resolution(resolution_m)
        self.rules = rules if rules is not None else GroundRules()
        self.height_max_m = height_max_m
        self.rejected_points = 0
        self._row0 = self._col0 = 0
        self._take(np.zeros((0, 0)))

    def _take(self, like: F64) -> None:
        self._count: I64 = np.zeros(like.shape, dtype=np.int64)
        self._low, self._high = np.full(like.shape, np.inf), np.full(like.shape, -np.inf)
        self._sum, self._square = np.zeros(like.shape), np.zeros(like.shape)

    def insert(self, points_m: ArrayLike) -> None:
        """Add a cloud: (N, 3) in the map frame. ValueError for other shapes, or points absurdly far apart."""
        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points are (N, 3), got {points.shape}")
        sound = np.all(np.isfinite(points), axis=1)
        rejected = int(np.count_nonzero(~sound))
        points = points[sound & (points[:, 2] <= self.height_max_m)]
        if len(points):
            cells = cells_of(points[:, :2], self.resolution_m)
            self._cover(cells.min(axis=0), cells.max(axis=0) + 1)
            at = (cells[:, 0] - self._row0) * self._count.shape[1] + cells[:, 1] - self._col0
            height, size = points[:, 2], self._count.size
            self._count += np.bincount(at, minlength=size).reshape(self._count.shape)
            self._sum += np.bincount(at, height, size).reshape(self._sum.shape)
            self._square += np.bincount(at, height * height, size).reshape(self._square.shape)
            np.minimum.at(self._low.reshape(-1), at, height)
            np.maximum.at(self._high.reshape(-1), at, height)
        self.rejected_points += rejected

    def _cover(self, low: I64, end: I64) -> None:
        rows, cols = self._count.shape
        if self._count.size:
            low = np.minimum(low, (self._row0, self._col0))
            end = np.maximum(end, (self._row0 + rows, self._col0 + cols))
        sides = end - low
        if int(sides[0]) * int(sides[1]) > MAX_CELLS:
            raise ValueError(f"{sides[0]} x {sides[1]} cells are too many: at most {MAX_CELLS}; use larger cells")
        if tuple(sides) == (rows, cols):
            return
        old = (self._count, self._low, self._high, self._sum, self._square)
        place = np.s_[
            self._row0 - low[0] : self._row0 - low[0] + rows, self._col0 - low[1] : self._col0 - low[1] + cols
        ]
        self._take(np.empty(tuple(sides)))
        if rows:
            for new, before in zip((self._count, self._low, self._high, self._sum, self._square), old):
                new[place] = before
        self._row0, self._col0 = int(low[0]), int(low[1])

    def elevation(self) -> Elevation:
        """The map as it is now. Time grows as the cells."""
        known = self._count >= self.rules.points_min
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.where(known, self._sum / self._count, np.nan)
            variance = np.where(known, np.maximum(self._square / self._count - mean * mean, 0.0), np.nan)
        low, high = np.where(known, self._low, np.nan), np.where(known, self._high, np.nan)
        slope, roughness, step = _surface(mean, self.resolution_m, self.rules.neighbours_min)
        step = np.fmax(step, np.where(np.isnan(step), np.nan, high - low))
        ground = _classes(slope, roughness, step, high - low, self.rules)
        return Elevation(
            self.resolution_m, self._row0, self._col0, self._count.copy(), low, high, mean, variance, slope, step,
            roughness, ground,
        )  # fmt: skip


def _surface(mean: F64, d: float, neighbours_min: int) -> tuple[F64, F64, F64]:
    """Slope, roughness and step of each cell from its neighbours' heights; NaN where they do not tell."""
    rows, cols = mean.shape
    wide = np.full((rows + 2, cols + 2), np.nan)
    wide[1:-1, 1:-1] = mean
    n, sx, sy, sz, sxx, sxy, syy, sxz, syz, szz = np.zeros((10, rows, cols))
    step = np.zeros((rows, cols))
    for row, col in _AROUND:
        # Heights above the cell's own: their squares keep their digits, however high the map lies.
        z = wide[1 + row : 1 + row + rows, 1 + col : 1 + col + cols] - mean
        there = ~np.isnan(z)
        z = np.where(there, z, 0.0)
        x, y = col * d * there, row * d * there
        n, sx, sy, sz = n + there, sx + x, sy + y, sz + z
        sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
        sxz, syz, szz = sxz + x * z, syz + y * z, szz + z * z
        step = np.maximum(step, np.abs(z))
    with np.errstate(invalid="ignore", divide="ignore"):
        cxx, cxy, cyy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
        cxz, cyz, czz = sxz - sx * sz / n, syz - sy * sz / n, szz - sz * sz / n
        area = cxx * cyy - cxy * cxy
        a, b = (cxz * cyy - cyz * cxy) / area, (cyz * cxx - cxz * cxy) / area
        tells = ~np.isnan(mean) & (n > neighbours_min) & (area > 1e-6 * d**4)
        rest = np.sqrt(np.maximum(czz - a * cxz - b * cyz, 0.0) / n)
        slope = np.arctan(np.hypot(a, b))
    return np.where(tells, slope, np.nan), np.where(tells, rest, np.nan), np.where(tells, step, np.nan)


def _classes(slope: F64, roughness: F64, step: F64, span: F64, rules: GroundRules) -> I8:
    """What is surely too high is a step even where the neighbours are unknown."""
    ground = np.full(slope.shape, Ground.UNKNOWN, dtype=np.int8)
    ground[~np.isnan(slope)] = Ground.TRAVERSABLE
    ground[roughness > rules.roughness_max_m] = Ground.ROUGH
    ground[slope > rules.slope_max_rad] = Ground.STEEP
    ground[(step > rules.step_max_m) | (span > rules.step_max_m)] = Ground.STEP
    return ground
