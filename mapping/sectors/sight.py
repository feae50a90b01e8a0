"""What a range sensor has seen: obstacles, and the area it looked through.

Every beam stands for a thin sector around it: half-way to its neighbours where they are no farther than 1.5 times the
usual spacing, half a spacing elsewhere. The area seen is the union of these thin sectors, each as long as its range;
that is a star about the sensor. A cone is a fan of such sectors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.kernels import sectors as kernels

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

GAP_MAX_SPACINGS = 1.5
TURN = 2.0 * math.pi
_SAME_PLACE_M = 1e-9
_CONE_STEP_RAD = math.radians(2.0)
_ARC_STEP_RAD = math.radians(0.5)
_FRONT_RAD = math.radians(100.0)  # a little more than half the front, so that a flush bumper leaves no seam
LEAST_RANGE_M = 1e-6  # an obstacle at range zero still has a bearing


@dataclass(frozen=True, slots=True)
class Star:
    """What a sensor has seen, in its own frame, and which way it looked at all.

    lo_rad, hi_rad, length_m: (M,) thin sectors with a length, ascending, apart, within one turn.
    looked_lo_rad, looked_hi_rad: (K,) the same for every valid beam, also those too close to measure.
    """

    lo_rad: F64
    hi_rad: F64
    length_m: F64
    looked_lo_rad: F64
    looked_hi_rad: F64


@dataclass(frozen=True, slots=True)
class Sight:
    """A star, and where its sensor stands: virtual_from_sensor."""

    virtual_from_sensor: Pose2
    star: Star

    @property
    def from_origin(self) -> bool:
        """Whether the sensor stands on the virtual origin."""
        return math.hypot(self.virtual_from_sensor.x_m, self.virtual_from_sensor.y_m) < _SAME_PLACE_M

    def border(self) -> F64:
        """(M, 2) corners of the star, virtual sensor frame, closed, counter-clockwise; chords stand for its arcs."""
        star, pose = self.star, self.virtual_from_sensor
        if len(star.lo_rad) == 0:
            return np.empty((0, 2))
        border: F64 = kernels.star_border(star.lo_rad, star.hi_rad, star.length_m, pose.x_m, pose.y_m, pose.yaw_rad)
        return border

    def contains(self, points: F64) -> Bool:
        """(N,) which (N, 2) points, virtual sensor frame, were seen to be free."""
        return self._in_star(points, self.star.lo_rad, self.star.hi_rad, anywhere=False)

    def looked_at(self, points: F64) -> Bool:
        """(N,) in which directions of (N, 2) points a valid beam looked, whatever it saw there."""
        return self._in_star(points, self.star.looked_lo_rad, self.star.looked_hi_rad, anywhere=True)

    def _in_star(self, points: F64, lo_rad: F64, hi_rad: F64, *, anywhere: bool) -> Bool:
        pose = self.virtual_from_sensor
        inside: Bool = kernels.in_star(
            np.ascontiguousarray(points), pose.x_m, pose.y_m, pose.yaw_rad, lo_rad, hi_rad, self.star.length_m, anywhere
        )
        return inside


def median_spacing(bearing_rad: F64) -> float | None:
    """The usual angle between neighbouring beams; None for fewer than eight, too few to tell."""
    if len(bearing_rad) < 8:
        return None
    gaps = kernels.gaps_between(bearing_rad)
    middle = len(gaps) // 2
    if len(gaps) % 2:
        return float(np.partition(gaps, middle)[middle])
    lower, upper = np.partition(gaps, [middle - 1, middle])[middle - 1 : middle + 1].tolist()
    return float(0.5 * (lower + upper))


def star_of_beams(bearing_rad: F64, range_m: F64, *, range_max_m: float, spacing_rad: float) -> Star:
    """What a fan of beams has seen. bearing_rad, range_m: (N,) in any order; see mapping.scan for inf and NaN.

    A finite range beyond range_max_m is an obstacle where it says, but frees nothing.
    """
    if len(bearing_rad) == 0:
        empty = np.empty(0)
        return Star(empty, empty, empty, empty, empty)
    ordered, distance = bearing_rad, range_m
    if not kernels.are_ascending(bearing_rad):
        along = (bearing_rad - bearing_rad[0]) % TURN
        order = np.argsort(along, kind="stable")
        ordered, distance = bearing_rad[0] + along[order], range_m[order]
    gap_max_rad = GAP_MAX_SPACINGS * spacing_rad * (1.0 + 1e-6)
    return Star(*kernels.thin_sectors(ordered, distance, range_max_m, gap_max_rad, spacing_rad))


def sight_of_cone(*, cone_rad: float, free_m: float, near_m: float, virtual_from_transducer: Pose2) -> Sight:
    """What a sonar has seen: its cone up to free_m, and near_m all around its front.

    An object nearer than near_m, the least range it can measure, is heard from all directions ahead: the sound is a
    wave of the transducer's size there, not yet a cone.
    """
    half = 0.5 * cone_rad
    (lo, hi, ahead), near_m = cone_pieces(cone_rad, near_m)
    length = np.where(ahead, max(free_m, near_m), near_m)
    sees = (length > 0.0) & np.isfinite(length)
    return Sight(virtual_from_transducer, Star(lo[sees], hi[sees], length[sees], np.array([-half]), np.array([half])))


def cone_pieces(cone_rad: float, near_m: float) -> tuple[tuple[F64, F64, Bool], float]:
    """Thin sectors (M,) of a cone and, with near_m above 0, of everything ahead: lo, hi, which of them are the cone's.
    And near_m, 0 where the cone is as wide as all that.
    """
    with_front = near_m > 0.0 and 0.5 * cone_rad < _FRONT_RAD
    return _cone_pieces(cone_rad, with_front), near_m if with_front else 0.0


@lru_cache(64)
def _cone_pieces(cone_rad: float, with_front: bool) -> tuple[F64, F64, Bool]:
    """Thin sectors of a cone, or of everything ahead, and which of them are the cone's."""
    half = 0.5 * cone_rad
    cuts = np.linspace(-half, half, max(1, math.ceil(cone_rad / _CONE_STEP_RAD)) + 1)
    lo, hi = cuts[:-1], cuts[1:]
    sides = 0
    if with_front:
        side = np.linspace(half, _FRONT_RAD, max(1, math.ceil((_FRONT_RAD - half) / _CONE_STEP_RAD)) + 1)
        lo = np.concatenate((-side[:0:-1], lo, side[:-1]))
        hi = np.concatenate((-side[-2::-1], hi, side[1:]))
        sides = len(side) - 1
    ahead = np.zeros(len(lo), dtype=bool)
    ahead[sides : len(lo) - sides] = True
    return lo, hi, ahead


@lru_cache(64)
def arc_directions(cone_rad: float) -> tuple[F64, F64, F64]:
    """(M,) angles off the axis along an arc, their cosines and sines."""
    half_steps = max(1, math.ceil(0.5 * cone_rad / _ARC_STEP_RAD))
    off = np.linspace(-0.5 * cone_rad, 0.5 * cone_rad, 2 * half_steps + 1)
    return np.abs(off), np.cos(off), np.sin(off)


def end_points(bearing_rad: F64, range_m: F64, *, range_min_m: float, virtual_from_sensor: Pose2) -> F64:
    """(M, 2) obstacles of a fan of beams, virtual sensor frame; what is too close stands at range_min_m."""
    pose = virtual_from_sensor
    points: F64 = kernels.beam_ends(bearing_rad, range_m, range_min_m, LEAST_RANGE_M, pose.x_m, pose.y_m, pose.yaw_rad)
    return points


def arc_of_cone(*, cone_rad: float, range_m: float, virtual_from_transducer: Pose2) -> tuple[F64, F64]:
    """(M, 2) points along the arc an echo may have come from, and (M,) how far each is off the axis, in radians."""
    off_axis, c, s = arc_directions(cone_rad)
    r = max(range_m, LEAST_RANGE_M)
    points = np.empty((len(off_axis), 2))
    points[:, 0], points[:, 1] = r * c, r * s
    return virtual_from_transducer.apply(points), off_axis
