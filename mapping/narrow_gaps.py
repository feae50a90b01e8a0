"""Beams that saw nothing between two surfaces that stand close together: they free nothing (S28).

Nothing came back from there: open space, or a surface that is too dark, too flat to the beam, or glass. Through a gap
that no robot fits through nothing is gained by believing the first; believing it wrongly draws free space beyond walls.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mapping.kernels import beams as kernels

F64 = NDArray[np.float64]

NARROW_M: Final = 0.6  # narrower than doors


def without_narrow_gaps(bearing_rad: F64, range_m: F64) -> tuple[F64, int]:
    """(N,) ranges in which +inf is NaN between two ends less than NARROW_M apart, and how many beams these are.

    bearing_rad, range_m: (N,) as in mapping.scan.Scan, in order of bearing, either way round, up to a full turn. A gap
    is what lies between the two nearest beams with a range to either side, NaN passed over; at the end of the field of
    view, and beside a surface that is too close to measure, a gap stays open. Without +inf the ranges are returned as
    they are. Raises ValueError if the shapes differ.
    """
    if bearing_rad.ndim != 1 or bearing_rad.shape != range_m.shape:
        raise ValueError(f"bearings and ranges must be (N,) alike, got {bearing_rad.shape} and {range_m.shape}")
    if not np.isposinf(range_m).any():
        return range_m, 0
    kept = np.array(range_m, dtype=np.float64)
    dropped = kernels.close_narrow_gaps(np.array(bearing_rad, dtype=np.float64), NARROW_M, kept)
    return kept, int(dropped)
