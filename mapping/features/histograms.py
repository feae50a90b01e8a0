"""Main orientation, walls from histograms, virtual edges and the box (S20, S14)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.features.anchors import Anchors
from mapping.features.moments import arc_weights, checked_points
from mapping.features.range_image import surface_angles
from mapping.frames import Pose2
from mapping.kernels import features as kernels

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_QUARTER: Final = 0.5 * math.pi
_SURFACE_M: Final = 0.25  # points this far off tell how a surface runs
_SQUARE_RAD: Final = math.radians(20.0)
_MOST_BINS: Final = 100_000  # of an axis histogram: scenes that are wider are no scenes


@dataclass(frozen=True, slots=True)
class Orientation:
    """angle_rad: of the main direction, in [-pi/4, pi/4), as walls stand square to each other.

    share: of the length of all surfaces, what lies within 5 degrees of it (mod 90), in [0, 1].
    """

    angle_rad: float
    share: float


def main_orientation(
    points: ArrayLike, *, span_m: float = 0.25, gap_m: float = 0.5, bin_deg: float = 2.0
) -> Orientation | None:
    """The direction, modulo 90 degrees, in which most of the surfaces run: the peak of the angle histogram (S20).

    points: (N, 2) in order of bearing.  span_m: angles are those of chords from each point to the first that is so far
    off (0: to the next point, as in the book; noise then drowns what is near).  gap_m: chords do not reach over gaps
    wider than this.  Each chord counts by its length; the peak is refined by the mean of chords within 5 degrees.
    None if no two points are on one surface.  ValueError for other shapes or limits.
    """
    p = checked_points(points)
    if not (span_m >= 0.0 and math.isfinite(span_m)) or not gap_m > 0.0 or not 0.0 < bin_deg <= 45.0:
        raise ValueError(f"span_m >= 0, gap_m > 0 and 0 < bin_deg <= 45, got {span_m}, {gap_m}, {bin_deg}")
    chord = _chords(p, span_m, gap_m)
    length = np.hypot(chord[:, 0], chord[:, 1])
    chord, length = chord[length > 0.0], length[length > 0.0]
    if not len(chord):
        return None
    angle = np.mod(np.arctan2(chord[:, 1], chord[:, 0]), _QUARTER)
    bins = max(2, round(90.0 / bin_deg))
    histogram = np.bincount(np.minimum((angle / _QUARTER * bins).astype(np.int64), bins - 1), length, bins)
    smooth = histogram + 0.5 * (np.roll(histogram, 1) + np.roll(histogram, -1))
    peak = (int(np.argmax(smooth)) + 0.5) * _QUARTER / bins
    for _ in range(2):  # the mean about the peak, then about that mean
        off = np.mod(angle - peak + 0.5 * _QUARTER, _QUARTER) - 0.5 * _QUARTER
        near = np.abs(off) <= math.radians(5.0)
        if not near.any():
            break
        peak += float(np.sum(length[near] * off[near]) / np.sum(length[near]))
    off = np.mod(angle - peak + 0.5 * _QUARTER, _QUARTER) - 0.5 * _QUARTER
    share = float(np.sum(length[np.abs(off) <= math.radians(5.0)]) / np.sum(length))
    return Orientation((peak + 0.25 * math.pi) % _QUARTER - 0.25 * math.pi, share)


def _chords(p: F64, span_m: float, gap_m: float) -> F64:
    """(M, 2) chords of connected points: from each to the first at least span_m away."""
    if len(p) < 2:
        return np.empty((0, 2))
    if span_m == 0.0:
        step = np.diff(p, axis=0)
        return np.asarray(step[np.hypot(step[:, 0], step[:, 1]) <= gap_m])
    chord = np.empty((len(p), 2))
    count = kernels.chords(p, span_m, gap_m, chord)
    return chord[:count]


@dataclass(frozen=True, slots=True)
class AxisWalls:
    """Walls across one axis: significant peaks of the histogram of that coordinate, by rising position.

    position_m: (K,).  length_m: (K,) of surface in the peak.  low_m, high_m: (K,) its reach along the other axis.
    """

    position_m: F64
    length_m: F64
    low_m: F64
    high_m: F64

    def __len__(self) -> int:
        return len(self.position_m)


def axis_walls(
    across_m: ArrayLike, along_m: ArrayLike, weight: ArrayLike, *, bin_m: float = 0.1, least_m: float = 0.6
) -> AxisWalls:
    """Peaks of a histogram: bins that, with both neighbours, hold at least least_m of surface and are not topped.

    across_m: (N,) the coordinate, along_m: (N,) the other one, weight: (N,) length of surface each point stands for.
    A peak's position is the mean
    of its three bins.  No points, no walls.  ValueError for other shapes, or extents of more than 100,000 bins.
    """
    x, y, w = (np.asarray(v, dtype=np.float64) for v in (across_m, along_m, weight))
    if not (x.ndim == 1 and x.shape == y.shape == w.shape):
        raise ValueError(f"coordinates and weights are rows of one length, got {x.shape}, {y.shape}, {w.shape}")
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y)) and np.all(np.isfinite(w)) and np.all(w >= 0.0)):
        raise ValueError("coordinates are finite, weights finite and >= 0")
    if not (bin_m > 0.0 and least_m > 0.0):
        raise ValueError(f"bin_m and least_m must be above 0, got {bin_m}, {least_m}")
    nothing = np.empty(0)
    if not len(x):
        return AxisWalls(nothing, nothing, nothing, nothing)
    low = float(x.min())
    bins = (float(x.max()) - low) / bin_m + 1.0
    if not bins <= _MOST_BINS:
        raise ValueError(f"points reach over {bins:.3g} bins of {bin_m} m; there may be {_MOST_BINS}")
    at = ((x - low) / bin_m).astype(np.int64)
    histogram = np.concatenate(([0.0], np.bincount(at, w), [0.0]))
    three = histogram[:-2] + histogram[1:-1] + histogram[2:]
    before, after = np.concatenate(([0.0], three[:-1])), np.concatenate((three[1:], [0.0]))
    # A plateau of three bins around one full bin has one peak: its fullest, else its first.
    peaks = [
        k
        for k in np.flatnonzero((three >= least_m) & (three >= before) & (three >= after))
        if _is_top(three, histogram[1:-1], int(k))
    ]
    rows = []
    for k in peaks:
        own = (np.abs(at - k) <= 1) & (w > 0.0)
        total = float(np.sum(w[own]))
        rows.append((float(np.sum(w[own] * x[own]) / total), total, float(y[own].min()), float(y[own].max())))
    table = np.array(rows).reshape(-1, 4)
    return AxisWalls(table[:, 0], table[:, 1], table[:, 2], table[:, 3])


def _is_top(three: F64, own: F64, k: int) -> bool:
    """Whether bin k stands for its peak: no bin within two has more, and of equals the fuller, then the first."""
    for other in range(max(0, k - 2), min(len(three), k + 3)):
        if (three[other], own[other], -other) > (three[k], own[k], -k):
            return False
    return True


@dataclass(frozen=True, slots=True)
class SquareScene:
    """A scan seen in its main orientation.

    scene_from_sensor: the turn that makes walls parallel to the axes.  x_walls: walls at an x, running along y;
    y_walls: walls at a y.  points: (N, 2) turned.
    """

    scene_from_sensor: Pose2
    share: float
    x_walls: AxisWalls
    y_walls: AxisWalls
    points: F64


def square_scene(
    points: ArrayLike, *, bin_m: float = 0.1, least_m: float = 0.6, gap_m: float = 0.5, full_turn: bool = False
) -> SquareScene | None:
    """Main orientation, then histograms over x and y (S20).  points: (N, 2) in order of bearing, sensor frame.

    Into the histogram of x go points whose surface runs along y, within 20 degrees, and the other way round: else long
    walls along an axis lift all of its histogram.  The orientation is known modulo 90 degrees: the same place seen
    after a turn may have x and y exchanged.
    None if there is no orientation.  ValueError as of main_orientation and axis_walls.
    """
    p = checked_points(points)
    found = main_orientation(p, gap_m=gap_m)
    if found is None:
        return None
    turn = Pose2(0.0, 0.0, -found.angle_rad)
    turned = turn.apply(p)
    weight = arc_weights(p, gap_m=gap_m, full_turn=full_turn)
    surface = np.concatenate(([0], np.cumsum(np.hypot(*np.diff(turned, axis=0).T) > gap_m)))
    along = np.abs(surface_angles(turned, surface, half_m=_SURFACE_M))
    upright, level = along >= _QUARTER - _SQUARE_RAD, along <= _SQUARE_RAD  # NaN is neither
    x_walls = axis_walls(turned[:, 0], turned[:, 1], weight * upright, bin_m=bin_m, least_m=least_m)
    y_walls = axis_walls(turned[:, 1], turned[:, 0], weight * level, bin_m=bin_m, least_m=least_m)
    return SquareScene(turn, found.share, x_walls, y_walls, turned)


def virtual_edges(scene: SquareScene, *, near_m: float = 0.2, reach_m: float = 2.0) -> Anchors:
    """Where walls would meet but no beam hit: intersections without a point within near_m, as anchors in the sensor's
    frame (S20, figure 5.19).

    reach_m: both walls must come so near to it; +inf takes every intersection, as in the book.
    ValueError if a limit is not above 0.
    """
    if not (near_m > 0.0 and reach_m > 0.0):
        raise ValueError(f"near_m and reach_m must be above 0, got {near_m}, {reach_m}")
    sensor_from_scene = scene.scene_from_sensor.inverse()
    rows = []
    for k, x in enumerate(scene.x_walls.position_m):
        for j, y in enumerate(scene.y_walls.position_m):
            short_x = max(scene.x_walls.low_m[k] - y, y - scene.x_walls.high_m[k])
            short_y = max(scene.y_walls.low_m[j] - x, x - scene.y_walls.high_m[j])
            if max(short_x, short_y) > reach_m:
                continue
            if np.min(np.hypot(scene.points[:, 0] - x, scene.points[:, 1] - y)) <= near_m:
                continue
            px, py = sensor_from_scene.apply(np.array([x, y]))
            length = max(scene.x_walls.length_m[k], scene.y_walls.length_m[j])
            rows.append([px, py, kernels.VIRTUAL, math.nan, math.nan, length, -1.0])
    return Anchors(np.array(rows, dtype=np.float64).reshape(-1, kernels.ROW))


@dataclass(frozen=True, slots=True)
class Box:
    """The box that a room's outermost walls make, in the scene's frame.

    centre_m: of the box in the sensor's frame.  size_m: longer side, shorter side; neither changes when the robot moves
    or turns.  angle_rad: of the longer side in the sensor's frame, in [-pi/2, pi/2).
    """

    centre_m: tuple[float, float]
    size_m: tuple[float, float]
    angle_rad: float

    def corners(self) -> F64:
        """(4, 2) counter-clockwise, sensor frame."""
        a, b = 0.5 * self.size_m[0], 0.5 * self.size_m[1]
        pose = Pose2(*self.centre_m, self.angle_rad)
        return pose.apply(np.array([[a, b], [-a, b], [-a, -b], [a, -b]]))


def box_feature(scene: SquareScene) -> Box | None:
    """The box given by the outermost significant peaks in x and y (S14); None unless both axes have two walls."""
    x, y = scene.x_walls.position_m, scene.y_walls.position_m
    if len(x) < 2 or len(y) < 2:
        return None
    width, height = float(x[-1] - x[0]), float(y[-1] - y[0])
    back = scene.scene_from_sensor.inverse()
    cx, cy = back.apply(np.array([0.5 * (x[0] + x[-1]), 0.5 * (y[0] + y[-1])]))
    angle = back.yaw_rad if width >= height else back.yaw_rad + 0.5 * math.pi
    angle = (angle + 0.5 * math.pi) % math.pi - 0.5 * math.pi
    return Box((float(cx), float(cy)), (max(width, height), min(width, height)), angle)
