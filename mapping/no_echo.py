"""How far a beam that saw nothing may be called free (S28).

Silence is open space beyond the sensor's reach, or a surface that sends nothing back: black, polished and at a slant,
glass. The beam alone does not tell which; what its neighbours met bounds how much such a surface can hide. Of beams in
a row that saw nothing:

- Between two echoes they are free up to the straight line from the end of one to the end of the other. What is silent
  before a wall, or in it, frees nothing behind the wall; a door into a hall is free up to its sill, a corridor up to
  where its walls were last seen.
- At the end of the view, or beside a beam that was not measured (NaN, too close, missing), they free nothing: what was
  not seen there may be as near as it likes. So losing beams never frees anything.
- A third of a turn of silence is believed up to WIDE_M in any case, half a turn, which no straight surface fills, up to
  OPEN_M: a yard, a hall, a doorway that the sensor stands in.

Never farther than the sensor's range_max_m. What gives no echo before that line is not seen itself: it stays free.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mapping.kernels import no_echo as kernels

F64 = NDArray[np.float64]

WIDE_M: Final = kernels.WIDE_M
OPEN_M: Final = kernels.OPEN_M


def reach_without_echo(bearing_rad: F64, range_m: F64, range_max_m: float) -> F64:
    """(N,) how far each beam is free that is +inf; the ranges of the others as they are.

    bearing_rad, range_m: (N,) as in mapping.scan.Scan, in order of bearing, either way round, up to a full turn.
    Raises ValueError if the shapes differ.
    """
    if bearing_rad.ndim != 1 or bearing_rad.shape != range_m.shape:
        raise ValueError(f"bearings and ranges must be (N,) alike, got {bearing_rad.shape} and {range_m.shape}")
    if not np.isposinf(range_m).any():
        return range_m
    reach = np.array(range_m, dtype=np.float64)
    bearing, ranges = (np.ascontiguousarray(each, dtype=np.float64) for each in (bearing_rad, range_m))
    kernels.reach_without_echo(bearing, ranges, float(range_max_m), kernels.widest_gap(bearing), reach)
    return reach
