"""Sector maps as they leave the mapping package: immutable arrays in bearing order."""

from __future__ import annotations

from collections.abc import Callable
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
    free_m: (N,) up to which all of the sector was seen free by one source, also before an OBSTACLE; 0 nowhere, and
    where the state is UNKNOWN or STALE. None: not told.
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
    free_m: F64 | None = None


@dataclass(frozen=True, slots=True)
class Squares:
    """(R, C) arrays of a RectSnapshot."""

    state: I8
    x_m: F64
    y_m: F64
    age_ns: I64
    source: I16


class RectSnapshot:
    """A rectangular sector map (S36): R x C sectors, row along y, column along x, both ascending.

    x_edges_m: (C + 1,), y_edges_m: (R + 1,), virtual sensor frame.  state, x_m, y_m, age_ns, source: (R, C);
    x_m, y_m: the obstacle nearest to the virtual sensor's origin in that sector, NaN if none. They are worked out when
    they are first asked for, by any thread, and are as of stamp_ns all the same.
    """

    __slots__ = ("_make", "_squares", "base_from_sensor", "sources", "stamp_ns", "x_edges_m", "y_edges_m")

    def __init__(
        self,
        stamp_ns: int,
        base_from_sensor: Pose2,
        x_edges_m: F64,
        y_edges_m: F64,
        sources: tuple[str, ...],
        make: Callable[[], Squares],
    ) -> None:
        """make: from values that stay as they are."""
        self.stamp_ns, self.base_from_sensor, self.sources = stamp_ns, base_from_sensor, sources
        self.x_edges_m, self.y_edges_m = x_edges_m, y_edges_m
        self._make: Callable[[], Squares] | None = make
        self._squares: Squares | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """R and C, without working anything out."""
        return len(self.y_edges_m) - 1, len(self.x_edges_m) - 1

    @property
    def squares(self) -> Squares:
        """All that is known. Two threads that ask at once make the same."""
        make, squares = self._make, self._squares
        if squares is None:
            assert make is not None
            squares = self._squares = make()
            self._make = None  # what it was made of is not kept
        return squares

    @property
    def state(self) -> I8:
        return self.squares.state

    @property
    def x_m(self) -> F64:
        return self.squares.x_m

    @property
    def y_m(self) -> F64:
        return self.squares.y_m

    @property
    def age_ns(self) -> I64:
        return self.squares.age_ns

    @property
    def source(self) -> I16:
        return self.squares.source
