"""Ranges between a near edge and what is behind it, where nothing stands: a laser's spot that falls on both (S28).

Such a range lies between those of its two neighbours, and both chords to them run along the beam, as a surface seen at
less than GRAZING would. What else looks like that is a wall seen so flat; then the next two beams to one side end on
the same straight line, and the range is kept. What is dropped becomes NaN: it is no obstacle, frees nothing, and no
wedge beside it is filled. So the filter can take evidence away, for obstacles as well as for free space, and adds none.

Two neighbouring mixed pixels at about the same range look like a thing and are kept. A real thing that a single beam
meets, near in the picture of an edge and farther than it, is not drawn from there, nor is its place called free.

Source: the shadow filter of the ROS package laser_filters has the angle; the neighbours' lines are ours.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mapping.kernels import beams as kernels

F64 = NDArray[np.float64]

GRAZING_RAD: Final = math.radians(10.0)
_COT_GRAZING: Final = 1.0 / math.tan(GRAZING_RAD)
STEP_M: Final = 0.10  # edges nearer to what is behind them are left alone
OFF_M: Final = 0.03  # how far off a straight wall each of its beams may end
WIDEST_RAD: Final = 0.05  # between neighbours; farther apart, beams know nothing of each other


def without_mixed_pixels(bearing_rad: F64, range_m: F64) -> tuple[F64, int]:
    """(N,) ranges in which those of mixed pixels are NaN, and how many these are.

    bearing_rad, range_m: (N,) as in mapping.scan.Scan, in order of bearing, either way round, up to a full turn.
    Raises ValueError if the shapes differ.
    """
    bearing = np.ascontiguousarray(bearing_rad, dtype=np.float64)
    ranges = np.ascontiguousarray(range_m, dtype=np.float64)
    if bearing.ndim != 1 or bearing.shape != ranges.shape:
        raise ValueError(f"bearings and ranges must be (N,) alike, got {bearing.shape} and {ranges.shape}")
    kept = np.empty_like(ranges)
    dropped = kernels.drop_mixed(bearing, ranges, _COT_GRAZING, STEP_M, OFF_M, WIDEST_RAD, kept)
    return kept, int(dropped)
