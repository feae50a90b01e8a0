"""From one scan to its lines, with covariance, in one compiled call (S03 to S06, S08).

    extractor = LineExtractor(bearing_rad)
    lines = extractor.extract(range_m)            # sensor frame
    angle_rad, distance_m, covariance = lines.parameters()

Segmentation with a gap that grows with range, iterative end point fit, neighbours that noise cut apart joined again,
ends that are off the line left out, weighted total least squares, ends shifted onto the line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.kernels import lines as kernels
from mapping.lines.lines import Lines, as_points, no_lines

F64 = NDArray[np.float64]

FARTHEST_M: Final = 1e4  # a "range" beyond is no measurement; squares of it still keep micrometres
_SEAM_FACTOR: Final = 1.5  # the first beam follows the last if the gap between them is no wider than so many steps


@dataclass(frozen=True, slots=True)
class LineRules:
    """What makes a line.

    gap_m: points closer than this belong together (the book's d).  gap_beams: so do points closer than so many times
    the spacing of beams at their range (1/gap_beams is about the sine of the flattest angle at which a wall is
    followed); 0 leaves the book's fixed form.
    split_m, split_sigmas: a run bends where a point is farther from its chord than the larger of split_m and so many
    sigmas.  flat_m: how flat walls are taken to be.  merge_chi2: what joining two runs may cost, in variances (13.8:
    chance exceeds it once in 1000).
    smallest: clusters of at most so many points are auxiliary (the book's c).  min_points, min_length_m: of a line.
    sigma_m, sigma_per_m, bearing_sigma_rad: range noise sigma_m + sigma_per_m * r, and bearing noise.
    """

    gap_m: float = 0.12
    gap_beams: float = 6.0
    split_m: float = 0.04
    split_sigmas: float = 4.0
    flat_m: float = 0.003
    merge_chi2: float = 13.8
    smallest: int = 2
    min_points: int = 5
    min_length_m: float = 0.25
    sigma_m: float = 0.01
    sigma_per_m: float = 0.0
    bearing_sigma_rad: float = 0.001

    def __post_init__(self) -> None:
        for field in fields(self):
            value = float(getattr(self, field.name))
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{field.name} must be a number >= 0, got {value}")
        if self.gap_m == 0.0 and self.gap_beams == 0.0:
            raise ValueError("gap_m or gap_beams must be above 0: else no two points belong together")
        if self.sigma_m == 0.0:
            raise ValueError("sigma_m must be above 0: weights are 1/sigma^2")
        if self.min_points < 2:
            raise ValueError(f"a line has at least 2 points, got min_points {self.min_points}")

    def vector(self) -> F64:
        """As kernels take it, in the order of their column names."""
        return np.array([float(getattr(self, field.name)) for field in fields(self)])


class LineExtractor:
    """Lines of the scans of one device; keeps the beams' directions."""

    def __init__(
        self,
        bearing_rad: ArrayLike,
        rules: LineRules | None = None,
        *,
        range_min_m: float = 0.0,
        range_max_m: float = FARTHEST_M,
    ) -> None:
        """bearing_rad: (N,) strictly rising or strictly falling, less than a full turn in all.

        range_max_m: what is beyond is no measurement.  ValueError if the bearings are not as said.
        """
        bearing = np.array(bearing_rad, dtype=np.float64)
        if bearing.ndim != 1 or not np.all(np.isfinite(bearing)):
            raise ValueError("bearing_rad is one row of finite angles")
        if not are_in_order(bearing):
            raise ValueError("bearing_rad must rise or fall throughout, by no more than a full turn")
        self._falling = bool(bearing.size > 1 and bearing[0] > bearing[-1])
        step = np.abs(np.diff(bearing))
        if math.isnan(range_min_m) or math.isnan(range_max_m) or range_max_m <= max(range_min_m, 0.0):
            raise ValueError(f"range_max_m must be above range_min_m and 0, got {range_min_m} to {range_max_m}")
        self.rules = rules or LineRules()
        self._vector = self.rules.vector()
        self._cosine, self._sine = np.cos(bearing), np.sin(bearing)
        if self._falling:
            self._cosine, self._sine = self._cosine[::-1].copy(), self._sine[::-1].copy()
        self._near_m, self._far_m = max(range_min_m, 0.0), min(range_max_m, FARTHEST_M)
        spacing = float(np.median(step)) if step.size else 0.0
        self._spacing = self.rules.gap_beams * spacing
        self._full_turn = bool(step.size and 2.0 * math.pi - np.sum(step) <= _SEAM_FACTOR * spacing)
        room = max(1, bearing.size // max(1, self.rules.min_points - 1) + 1)
        self._rows, self._beams = np.empty((room, kernels.ROW)), np.empty((room, 2), dtype=np.int64)

    def extract(self, range_m: ArrayLike) -> Lines:
        """Lines of one scan in the sensor's frame, counter-clockwise.

        range_m: (N,); +inf, -inf, NaN, 0 and what is outside the device's limits are no points. None gives no lines.
        Raises ValueError for another shape.
        """
        ranges = np.ascontiguousarray(range_m, dtype=np.float64)
        if ranges.shape != self._cosine.shape:
            raise ValueError(f"range_m is ({self._cosine.size},) like the bearings, got {ranges.shape}")
        if self._falling:
            ranges = ranges[::-1].copy()
        count = kernels.lines_of_beams(
            self._cosine, self._sine, ranges, self._near_m, self._far_m, self._full_turn, self._spacing, self._vector,
            self._rows, self._beams,
        )  # fmt: skip
        beams = self._beams[:count].copy()
        if self._falling:
            beams = ranges.size - 1 - beams
        return Lines(self._rows[:count].copy(), beams)


def extract_lines(
    bearing_rad: ArrayLike,
    range_m: ArrayLike,
    rules: LineRules | None = None,
    *,
    range_min_m: float = 0.0,
    range_max_m: float = FARTHEST_M,
) -> Lines:
    """Lines of a single scan; for many of one device keep a LineExtractor."""
    return LineExtractor(bearing_rad, rules, range_min_m=range_min_m, range_max_m=range_max_m).extract(range_m)


def are_in_order(bearing_rad: F64) -> bool:
    """Whether bearings (N,) rise or fall throughout, by no more than a full turn; those of a trembling head may not."""
    step = np.diff(bearing_rad)
    return bool((np.all(step > 0.0) or np.all(step < 0.0)) and np.abs(step).sum() < 2.0 * math.pi + 1e-9)


def extract_from_points(
    points: ArrayLike, rules: LineRules | None = None, *, spacing_rad: float = 0.0, full_turn: bool = False
) -> Lines:
    """Lines of points (N, 2) in counter-clockwise order around a sensor at the origin, as de-skewing leaves them.

    spacing_rad: angle between beams, for gaps that grow with range; 0: only gap_m counts.  full_turn: the first point
    follows the last.  Raises ValueError for another shape, or points that are not finite or beyond FARTHEST_M.
    """
    p = as_points(points)
    if p.size and float(np.abs(p).max()) > FARTHEST_M:
        raise ValueError(f"points lie within {FARTHEST_M:g} m of the sensor")
    if not (math.isfinite(spacing_rad) and spacing_rad >= 0.0):
        raise ValueError(f"spacing_rad must be >= 0, got {spacing_rad}")
    if len(p) < 2:
        return no_lines()
    chosen = rules or LineRules()
    room = len(p) // max(1, chosen.min_points - 1) + 1
    rows, beams = np.empty((room, kernels.ROW)), np.empty((room, 2), dtype=np.int64)
    count = kernels.lines_of_points(
        p[:, 0].copy(), p[:, 1].copy(), np.arange(len(p)), len(p), full_turn, chosen.gap_beams * spacing_rad,
        chosen.vector(), rows, beams,
    )  # fmt: skip
    return Lines(rows[:count].copy(), beams[:count].copy())
