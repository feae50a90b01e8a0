"""What a laser's beams prove about the cells they pass (S28).

A beam is a narrow cone. Its end cell is evidence for an obstacle, the way there is evidence for free space:

- Between two neighbouring beams that both returned, the wedge is free up to the shorter of the two, and only as far
  as the beams are no farther apart than `fill_gap_m`. So a straight wall between two hits is never crossed, whatever
  the angle at which it is seen, and a beam that is missing (NaN) leaves its surroundings unknown. Beams are
  neighbours when no more than 1.5 times the device's spacing lies between them.
- A beam that looks farther than its wedges (a lone beam, a gap between chair legs, beams far apart) frees the cells
  its own line passes, no more.
- A wedge frees the cells whose centre it contains, a line the cells it passes. A cell counts once per scan, and a
  cell with a hit in it is not cleared by that scan.
- +inf (nothing seen) is free as far as the echoes beside it bear it out (`mapping.no_echo`), if the device can be
  trusted to say so (`clear_no_return`). -inf (too close) frees nothing and puts an obstacle at range_min_m, if one is
  given. NaN proves nothing, and neither does a number below 0 or beyond range_max_m: no measurement can be there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.kernels import grids as kernels
from mapping.kernels import motion
from mapping.kernels.no_echo import MAX_WEDGE_RAD, NEIGHBOUR_FACTOR
from mapping.scan import Scan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class BeamTable:
    """Directions of a device's beams by ascending bearing, made once per set of bearings.

    order: (N,) beam at each place of the table, None if they come in order.
    turned_rad: (N,) ascending, from the first that was given.  gap_max_rad: neighbours are no farther apart.
    dir_x, dir_y: (N,) unit vectors.  wedge_m: (N,) how far the wedge to the next entry (the last: to the first) may be
    called looked through; 0 if they are not neighbours.
    """

    order: I64 | None
    turned_rad: F64
    gap_max_rad: float
    dir_x: F64
    dir_y: F64
    wedge_m: F64


def beam_table(bearing_rad: F64, fill_gap_m: float) -> BeamTable:
    """The table of a device. bearing_rad: (N,) finite, any order and direction; they may overlap by a full turn.

    Raises ValueError if a bearing is not finite.
    """
    bearing = np.array(bearing_rad, dtype=np.float64)
    if bearing.ndim != 1 or not np.all(np.isfinite(bearing)):
        raise ValueError("bearing_rad is one row of finite angles")
    turned = np.mod(bearing - bearing[0], 2.0 * np.pi) if bearing.size else bearing
    order: I64 | None = None
    if np.any(np.diff(turned) < 0.0):
        order = np.argsort(turned, kind="stable")
        turned = turned[order]
    sorted_bearing = bearing if order is None else bearing[order]
    gap = np.append(np.diff(turned), 2.0 * np.pi - turned[-1:] + turned[:1])
    gap_max = _widest(gap[:-1][gap[:-1] > 0.0])
    return BeamTable(
        order=order,
        turned_rad=turned,
        gap_max_rad=gap_max,
        dir_x=np.cos(sorted_bearing),
        dir_y=np.sin(sorted_bearing),
        wedge_m=np.where(gap <= gap_max, fill_gap_m / np.maximum(gap, 1e-9), 0.0),
    )


def _widest(step_rad: F64) -> float:
    """How far apart two beams may be and still be neighbours."""
    return min(NEIGHBOUR_FACTOR * float(np.median(step_rad)), MAX_WEDGE_RAD) if step_rad.size else 0.0


@dataclass(frozen=True, slots=True)
class Beams:
    """Beams in a common frame, each from its own place: what de-skewing makes of a scan.

    origin_m, end_m: (N, 2), in the order of measurement, neighbours next to each other.  free: (N,) nothing stands
    between them.  hit: (N,) an obstacle stands at end_m.  A beam that proves nothing is neither; its end may be NaN.
    """

    origin_m: F64
    end_m: F64
    free: Bools
    hit: Bools


def beams_of_scan(
    scan: Scan, map_from_sensor: ArrayLike, *, clear_no_return: bool = True, use_max_m: float = np.inf
) -> Beams:
    """A scan whose sensor moved: each beam from the pose it was measured at.

    map_from_sensor: (N, 3) x, y, yaw per beam (or (3,) for all); a beam whose pose is NaN proves nothing.
    Raises ValueError for other shapes.
    """
    n = scan.range_m.size
    pose = np.asarray(map_from_sensor, dtype=np.float64)
    if pose.shape not in ((n, 3), (3,)):
        raise ValueError(f"poses are (N, 3) with N = {n} beams, or (3,), got {pose.shape}")
    origin, end, free, hit = motion.beam_lines(
        np.ascontiguousarray(np.broadcast_to(pose, (n, 3))), scan.bearing_rad, scan.range_m,
        float(scan.range_min_m), float(scan.range_max_m), float(min(scan.range_max_m, use_max_m)), clear_no_return,
    )  # fmt: skip
    return Beams(origin_m=origin, end_m=end, free=free, hit=hit)


@dataclass(frozen=True, slots=True)
class Fan:
    """Beams as seen from one place, by ascending bearing; lengths in metres, negative where nothing is known."""

    dir_x: F64
    dir_y: F64
    wedge_m: F64
    free_m: F64
    hit_m: F64


def fan_of_beams(beams: Beams, origin_m: F64, spread_m: float, fill_gap_m: float) -> Fan:
    """Beams with nearly the same origin, drawn from origin_m; at least one proves something, and all are finite.

    spread_m: how far origins are from origin_m: free lengths without a hit at their end are cut by it.
    """
    n = beams.free.size
    dir_x, dir_y, gap, free_m, hit_m = np.empty((5, n))
    adjacent = np.zeros(n, dtype=np.bool_)
    count = kernels.fan_of_lines(
        float(origin_m[0]), float(origin_m[1]), spread_m, beams.end_m, beams.free, beams.hit, dir_x, dir_y, gap,
        adjacent, free_m, hit_m,
    )  # fmt: skip
    if count == 0:
        return _sorted_fan(beams, origin_m, spread_m, fill_gap_m)
    wedge = _wedges_between(gap[:count], adjacent[:count], fill_gap_m)
    return Fan(dir_x[:count], dir_y[:count], wedge, free_m[:count], hit_m[:count])


def _sorted_fan(beams: Beams, origin_m: F64, spread_m: float, fill_gap_m: float) -> Fan:
    """fan_of_beams for beams in any order; neighbours are those measured one after the other."""
    some = np.flatnonzero(beams.free | beams.hit)
    way = beams.end_m[some] - origin_m
    length = np.hypot(way[:, 0], way[:, 1])
    direction = np.where(length[:, None] > 0.0, way / np.maximum(length, 1e-300)[:, None], [1.0, 0.0])
    bearing = np.arctan2(direction[:, 1], direction[:, 0])
    turned = np.mod(bearing - bearing[0], 2.0 * np.pi)
    order = np.argsort(turned, kind="stable")
    gap = np.append(np.diff(turned[order]), 2.0 * np.pi - turned[order[-1]])
    steps = np.abs(np.diff(some[order], append=some[order[:1]]))
    adjacent = (steps == 1) | (steps == beams.free.size - 1)
    hit, free = beams.hit[some], beams.free[some]
    free_m = np.where(free, np.where(hit, length, np.maximum(length - spread_m, 0.0)), -1.0)
    return Fan(
        dir_x=np.ascontiguousarray(direction[order, 0]),
        dir_y=np.ascontiguousarray(direction[order, 1]),
        wedge_m=_wedges_between(gap, adjacent, fill_gap_m),
        free_m=free_m[order],
        hit_m=np.where(hit, length, -1.0)[order],
    )


def _wedges_between(gap_rad: F64, adjacent: Bools, fill_gap_m: float) -> F64:
    """As in a BeamTable, where beams are neighbours only if they also were measured one after the other."""
    between = gap_rad[adjacent]
    if between.size == 0:
        return np.zeros(gap_rad.size)
    middle = between.size // 2
    nominal = float(np.partition(between, middle)[middle])
    neighbours = adjacent & (gap_rad <= min(NEIGHBOUR_FACTOR * nominal, MAX_WEDGE_RAD))
    return np.where(neighbours, fill_gap_m / np.maximum(gap_rad, 1e-9), 0.0)
