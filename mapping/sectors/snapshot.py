"""Sector maps as they leave the mapping package: immutable arrays in bearing order."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I16 = NDArray[np.int16]
I8 = NDArray[np.int8]


class SectorState(IntEnum):
    """What is known about a sector. Unknown is not free; stale is not free."""

    OBSTACLE = 0
    FREE = 1
    UNKNOWN = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class PolarSnapshot:
    """A polar sector map at one instant (S34, S35); N sectors, counter-clockwise from edges_rad[0].

    base_from_sensor: the virtual sensor's pose.  edges_rad: (N + 1,) ascending, virtual sensor frame.
    state: (N,) SectorState.  distance_m: (N,) from the virtual origin: to the nearest obstacle when OBSTACLE (and
    when STALE and last an obstacle), up to which the whole sector was seen free when FREE, else NaN.
    bearing_rad: (N,) of the nearest obstacle, NaN if none.  clearance_m: (N,) distance_m less the stretch inside the
    vehicle's outline along that bearing, or its largest in a FREE sector (NaN where distance_m is).
    age_ns: (N,) since the evidence that decided the state, -1 none.
    source: (N,) index into sources, -1 none.
    """

    stamp_ns: int
    base_from_sensor: Pose2
    edges_rad: F64
    state: I8
    distance_m: F64
    bearing_rad: F64
    clearance_m: F64
    age_ns: I64
    source: I16
    sources: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RectSnapshot:
    """A rectangular sector map (S36): R x C sectors, row along y, column along x, both ascending.

    x_edges_m: (C + 1,), y_edges_m: (R + 1,), virtual sensor frame.  state, x_m, y_m, age_ns, source: (R, C);
    x_m, y_m: the obstacle nearest to the virtual sensor's origin in that sector, NaN if none.
    """

    stamp_ns: int
    base_from_sensor: Pose2
    x_edges_m: F64
    y_edges_m: F64
    state: I8
    x_m: F64
    y_m: F64
    age_ns: I64
    source: I16
    sources: tuple[str, ...]
