"""Segments of a scan, told from its ranges alone (S18, algorithm 5.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.kernels import features as kernels

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class Mark(IntEnum):
    """What a beam is to its neighbours."""

    INSIDE = kernels.INSIDE
    STRAY = kernels.STRAY
    """A single point off a surface that goes on behind it."""
    EDGE = kernels.EDGE
    """The last of its segment: the range jumps after it."""
    FALSE_EDGE = kernels.FALSE
    """A single point between two jumps."""


@dataclass(frozen=True, slots=True)
class RangeSegments:
    """label: (N,) segment of each beam, from 0 in order of beams; -1: none.  mark: (N,) numbers of Mark."""

    label: I64
    mark: I64
    count: int

    def segments(self) -> list[I64]:
        """Beams of each segment, in order."""
        return [np.flatnonzero(self.label == k) for k in range(self.count)]


def segment_ranges(range_m: ArrayLike, jump_m: float = 0.3, *, jump_per_m: float = 0.0) -> RangeSegments:
    """Cut a scan where its range jumps, with dr_i = r_{i+1} - r_i and limit s:

    |dr_i| <= s: i + 1 is in i's segment.  Else |r_{i+2} - r_i| <= s: i + 1 is a stray, i + 2 goes on.  Else
    |dr_{i+1}| <= s: edge at i, a new segment begins at i + 1.  Else i + 1 belongs to neither, a false edge, and a new
    segment begins at i + 2.
    range_m: (N,) in order of bearing; +inf, -inf and NaN belong to no segment and end the one before.
    jump_m: the book's fixed s.  jump_per_m: if above 0, s is max(jump_m, jump_per_m * the smaller range): on a wall
    seen at the angle a, neighbouring ranges differ by r dphi / tan a.  No beams, no segments.
    Corrections to the print: the second branch adds point i + 2, which the first adds again; "|dr_i| > s" of the
    fourth is |dr_{i+1}| > s.  ValueError if range_m is not one row, or a limit is not a number >= 0.
    """
    ranges = np.ascontiguousarray(range_m, dtype=np.float64)
    if ranges.ndim != 1:
        raise ValueError(f"range_m is one row of ranges, got shape {ranges.shape}")
    for name, value in (("jump_m", jump_m), ("jump_per_m", jump_per_m)):
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"{name} must be a number >= 0, got {value}")
    label, mark = np.empty(ranges.size, dtype=np.int64), np.empty(ranges.size, dtype=np.int64)
    count = kernels.range_image_segments(ranges, jump_m, jump_per_m, label, mark)
    return RangeSegments(label, mark, int(count))


def surface_angles(points: ArrayLike, label: ArrayLike, *, half_m: float = 0.3) -> F64:
    """Direction of the surface at each point, alpha(phi): (N,) in [-pi/2, pi/2), NaN where fewer than 3 points tell.

    points: (N, 2) in order of bearing, label: (N,) their segments, -1 for none.  By regression over the points of its
    segment within half_m.  Where it is level there is a wall, where it climbs something round; from level to level is
    an edge between two walls (S19).  ValueError for other shapes, or points of a segment that are not finite.
    """
    p, segment = np.asarray(points, dtype=np.float64), np.asarray(label, dtype=np.int64)
    if p.ndim != 2 or p.shape[1] != 2 or segment.shape != (len(p),):
        raise ValueError(f"points are (N, 2) and label (N,), got {p.shape} and {segment.shape}")
    if not (math.isfinite(half_m) and half_m > 0.0):
        raise ValueError(f"half_m must be above 0, got {half_m}")
    if not np.all(np.isfinite(p[segment >= 0])):
        raise ValueError("points of a segment must be finite")
    angle = np.empty(len(p))
    kernels.surface_angles(p[:, 0].copy(), p[:, 1].copy(), segment, half_m, angle)
    return angle
