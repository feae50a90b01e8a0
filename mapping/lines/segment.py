"""Clusters of neighbouring scan points (S03, algorithm 5.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.kernels import lines as kernels
from mapping.lines.lines import as_points

I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Segmentation:
    """Indices into the points. clusters: in order, each counter-clockwise like the points; over the seam of a full turn
    indices run on from the last point to the first.  auxiliary: stray points and clusters that are too small."""

    clusters: tuple[I64, ...]
    auxiliary: I64


def segment_points(
    points: ArrayLike, gap_m: float, *, gap_per_m: float = 0.0, smallest: int = 0, full_turn: bool = False
) -> Segmentation:
    """Group neighbours that are closer than d, over single stray points, and set small groups aside.

    points: (N, 2) in order of bearing, sensor at the origin.  gap_m: the book's fixed d.  gap_per_m: if above 0, d is
    max(gap_m, gap_per_m * the nearer point's range), as beams spread: some times the angle between them.
    smallest: clusters of at most so many points are auxiliary (c).  full_turn: the last point is followed by the first.
    A stray point P_{i+1} with |P_{i+2} - P_i| < d is auxiliary and does not end its cluster. No points, no clusters.
    Raises ValueError if points are not (N, 2) and finite, gap_m is not above 0, or a limit is negative.
    Source: S03, algorithm 5.1; branches two and four advance by two, and the last pair is compared too.
    """
    p = as_points(points)
    if not (math.isfinite(gap_m) and gap_m > 0.0):
        raise ValueError(f"gap_m must be above 0, got {gap_m}")
    if not (math.isfinite(gap_per_m) and gap_per_m >= 0.0):
        raise ValueError(f"gap_per_m must be >= 0, got {gap_per_m}")
    if smallest < 0:
        raise ValueError(f"smallest must be >= 0, got {smallest}")
    n = len(p)
    if n == 0:
        return Segmentation((), np.empty(0, dtype=np.int64))
    x, y, order = p[:, 0].copy(), p[:, 1].copy(), np.arange(n)
    if full_turn:
        first, _ring = kernels.seam(x, y, n, gap_m, gap_per_m)
        order = np.roll(order, -int(first))
        x, y = x[order], y[order]
    label = np.empty(n, dtype=np.int64)
    count = kernels.segment(x, y, n, gap_m, gap_per_m, smallest, label)
    return Segmentation(tuple(order[label == k] for k in range(count)), np.sort(order[label < 0]))
