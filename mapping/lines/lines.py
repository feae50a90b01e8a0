"""What a line is: its ends, its angle and distance with their covariance, and the moments of its points (S05).

A line is the set of points p with <n, p> = d, n = (cos angle, sin angle), d >= 0: the perpendicular from the origin,
its angle and its length, as filters take it. Its ends give it a direction: free space is to the right (S08).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2, wrap_angles
from mapping.kernels import lines as kernels

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Lines:
    """K lines in one frame. rows: (K, 12) as described in mapping/kernels/lines.py, read-only by custom.

    beams: (K, 2) beam (or point) of the first and the last supporting point; of a map's lines -1.
    """

    rows: F64
    beams: I64

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def start_m(self) -> F64:
        """(K, 2); walking from start to end, free space is to the right."""
        return self.rows[:, kernels.START_X : kernels.END_X]

    @property
    def end_m(self) -> F64:
        """(K, 2)."""
        return self.rows[:, kernels.END_X : kernels.WEIGHT]

    @property
    def length_m(self) -> F64:
        """(K,)."""
        way = self.end_m - self.start_m
        return np.hypot(way[:, 0], way[:, 1])

    @property
    def count(self) -> I64:
        """(K,) supporting points."""
        return self.rows[:, kernels.COUNT].astype(np.int64)

    @property
    def seen(self) -> I64:
        """(K,) scans that saw the line."""
        return self.rows[:, kernels.SEEN].astype(np.int64)

    @property
    def rms_m(self) -> F64:
        """(K,) root mean square distance of the supporting points, weighted as the fit was."""
        return np.sqrt(self._eigenvalues()[0] / self.rows[:, kernels.WEIGHT])

    def parameters(self) -> tuple[F64, F64, F64]:
        """angle_rad (K,) in [-pi, pi) and distance_m (K,) >= 0 of the perpendiculars, and their covariance (K, 2, 2).

        With weights 1/sigma^2, t along the line and W the sum of weights, the direction has variance 1/sum(w t^2), the
        offset at the centre of gravity 1/W, independently; d = <n, c> then varies with the angle by -<u, c>.
        Where points lie farther off than their sigmas say, the covariance is scaled by chi^2/(N - 2). Source: S05.
        """
        centre = self.rows[:, kernels.CX : kernels.SXX]
        gamma = self._direction_rad()
        normal = np.stack((-np.sin(gamma), np.cos(gamma)), axis=-1)
        distance = np.sum(normal * centre, axis=1)
        side = np.where(distance < 0.0, -1.0, 1.0)
        normal, distance = normal * side[:, None], distance * side
        along = normal[:, 1] * centre[:, 0] - normal[:, 0] * centre[:, 1]
        across, largest = self._eigenvalues()
        scale = np.maximum(1.0, across / np.maximum(self.rows[:, kernels.COUNT] - 2.0, 1.0))
        angle_var = scale / np.maximum(largest, 1e-12)
        covariance = np.empty((len(self), 2, 2))
        covariance[:, 0, 0] = angle_var
        covariance[:, 0, 1] = covariance[:, 1, 0] = -along * angle_var
        covariance[:, 1, 1] = scale / self.rows[:, kernels.WEIGHT] + along * along * angle_var
        return wrap_angles(np.arctan2(normal[:, 1], normal[:, 0])), distance, covariance

    def transformed(self, a_from_b: Pose2) -> Lines:
        """These lines, given in frame b, in frame a. The pose's own uncertainty is not added."""
        rows = self.rows.copy()
        for x in (kernels.START_X, kernels.END_X, kernels.CX):
            rows[:, x : x + 2] = a_from_b.apply(rows[:, x : x + 2])
        c, s = math.cos(a_from_b.yaw_rad), math.sin(a_from_b.yaw_rad)
        xx, xy, yy = self.rows[:, kernels.SXX], self.rows[:, kernels.SXY], self.rows[:, kernels.SYY]
        rows[:, kernels.SXX] = c * c * xx - 2.0 * c * s * xy + s * s * yy
        rows[:, kernels.SXY] = c * s * (xx - yy) + (c * c - s * s) * xy
        rows[:, kernels.SYY] = s * s * xx + 2.0 * c * s * xy + c * c * yy
        return Lines(rows, self.beams)

    def chosen(self, which: ArrayLike) -> Lines:
        """Some of them, by a mask or by indices."""
        index = np.asarray(which)
        return Lines(self.rows[index], self.beams[index])

    def distance_to(self, points: ArrayLike) -> F64:
        """(N, K) distance of every point (N, 2) to every line between its ends."""
        return segment_distance(points, self.start_m, self.end_m)

    def _direction_rad(self) -> F64:
        """(K,) angle of the regression line: 1/2 atan2(2a, b), the minimum and never singular (eq. 5.14, S05)."""
        xx, xy, yy = self.rows[:, kernels.SXX], self.rows[:, kernels.SXY], self.rows[:, kernels.SYY]
        return 0.5 * np.arctan2(2.0 * xy, xx - yy)

    def _eigenvalues(self) -> tuple[F64, F64]:
        """(K,) scatter across and along."""
        xx, xy, yy = self.rows[:, kernels.SXX], self.rows[:, kernels.SXY], self.rows[:, kernels.SYY]
        root = np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)
        return np.maximum(0.0, 0.5 * (xx + yy - root)), 0.5 * (xx + yy + root)


def no_lines() -> Lines:
    """None."""
    return Lines(np.empty((0, kernels.ROW)), np.empty((0, 2), dtype=np.int64))


def segment_distance(points: ArrayLike, start_m: F64, end_m: F64) -> F64:
    """(N, K) distance of points (N, 2) to segments between start_m and end_m, each (K, 2)."""
    p = as_points(points)[:, None, :]
    way = end_m - start_m
    length2 = np.maximum(np.sum(way * way, axis=1), 1e-300)
    share = np.clip(np.sum((p - start_m) * way, axis=2) / length2, 0.0, 1.0)
    foot = start_m + share[..., None] * way
    return np.asarray(np.hypot(*np.moveaxis(p - foot, 2, 0)))


def as_points(points: ArrayLike) -> F64:
    """(N, 2) finite float64 points, contiguous. ValueError for another shape or numbers that are not finite."""
    p = np.ascontiguousarray(points, dtype=np.float64)
    if p.size == 0 and p.ndim <= 2:
        return np.empty((0, 2))
    if p.ndim != 2 or p.shape[1] != 2:
        raise ValueError(f"points are (N, 2), got {p.shape}")
    if not np.all(np.isfinite(p)):
        raise ValueError("points must be finite: leave out what was not measured")
    return p
