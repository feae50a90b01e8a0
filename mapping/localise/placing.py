"""Where in a map of key scans is this scan? First where the robot was left, then anywhere; it may be several places.

A pure function of a snapshot, so that a thread may do it. Places that look alike are all told; asked again with them
after the robot has moved on, it tells which of them still fit. One that is left is where the robot is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.fitting import fitting_match, nearest_keys
from mapping.localise.scan_match import agreement
from mapping.localise.search import find_view, raster_of
from mapping.localise.views import KeptViews, View, table_for, view_of
from mapping.scan import Scan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

LEFT_M = 0.15  # a robot that nobody moved stands where it stood; one that was moved, elsewhere or turned otherwise
LEFT_RAD = math.radians(4.0)
LEFT_QUALITY = 0.75
APART_M = 3.0  # between places that are looked at
WINDOW_M = 2.0
TURNS = (0.0, math.pi)  # each with a quarter turn to both sides
AROUND_M = 6.0
KEYS = 16
SCORE = 0.5
ALIKE = 0.8  # of the best place's quality, that another has to be told as well
MOST_ALIKE = 24
SAME_M = 1.0
SAME_RAD = math.radians(12.0)


@dataclass(frozen=True, slots=True)
class Place:
    """A sensor pose in the map where the scan fits. quality: share of its points that are explained, and how well."""

    pose: Pose2
    quality: float


@dataclass(frozen=True, slots=True)
class Placing:
    """A scan to be found among key scans, poses (K, 3) of the sensor.

    among: places to choose from, empty for anywhere.  may_be: whether the sensor can be at a pose; None: anywhere.
    near: the middle and the radius of a circle that it is in, None: no bound.  guesses: where to look as well.
    least: quality below which a place is none; new ground looks a little like much that is known.
    """

    views: KeptViews
    poses: F64
    scan: Scan
    among: tuple[Pose2, ...] = ()
    farthest_m: float = 30.0
    may_be: Callable[[Pose2], bool] | None = None
    near: tuple[float, float, float] | None = None
    guesses: tuple[Pose2, ...] = ()
    least: float = 0.0

    @property
    def cost(self) -> int:
        """How many places are looked at."""
        return len(self.among) or len(self._spread()) + len(self.guesses)

    def left_at(self, pose: Pose2) -> Place | None:
        """Where the sensor was left, if the scan fits there, and there exactly; quick."""
        view = view_of(self.scan, table_for(self.scan.bearing_rad), farthest_m=self.farthest_m)
        left = self._fitting(view, pose)
        stayed = left is not None and left.quality >= LEFT_QUALITY and _is_same(left.pose, pose, LEFT_M, LEFT_RAD)
        return left if stayed else None

    def run(self) -> tuple[Place, ...]:
        """Where the sensor may be, the best first; one place if that is clear, none if it fits nowhere."""
        view = view_of(self.scan, table_for(self.scan.bearing_rad), farthest_m=self.farthest_m)
        if self.among:
            return self._alike([self._fitting(view, pose) for pose in self.among])
        found: list[Place | None] = []
        for key in self._spread().tolist():
            x, y, yaw = self.poses[key].tolist()
            found += [self._searched(view, Pose2(x, y, yaw + turn), WINDOW_M, math.pi / 2.0) for turn in TURNS]
        found += [self._searched(view, pose, WINDOW_M, math.pi / 2.0) for pose in self.guesses]
        return self._alike(found)

    def _alike(self, found: list[Place | None]) -> tuple[Place, ...]:
        """Of those that can be: a rival where the robot cannot have come to is none."""
        there = [each for each in found if each is not None and each.quality >= self.least]
        return _alike([each for each in there if self.may_be is None or self.may_be(each.pose)])

    def _searched(self, view: View, near: Pose2, window_m: float, turn_rad: float) -> Place | None:
        """The best place around, if the scan really fits there."""
        rows = nearest_keys(self.poses, near, AROUND_M, KEYS, self.views.is_there())
        raster = raster_of(self.views, rows, self.poses[rows], window_m=window_m)
        spot = find_view(view, raster, near, window_m=window_m, turn_rad=turn_rad)
        return None if spot is None or spot.score < SCORE else self._fitting(view, spot.pose)

    def _fitting(self, view: View, pose: Pose2) -> Place | None:
        rows = nearest_keys(self.poses, pose, AROUND_M, 8, self.views.is_there())
        match = fitting_match(view, self.views, rows, self.poses[rows], pose)
        if match is None:
            return None
        explained = agreement(view, self.views, rows, self.poses[rows], match.pose).explained
        return Place(match.pose, explained * (1.0 - match.mean_cost))

    def _spread(self) -> I64:
        """Key scans that lie apart and are near to all others."""
        chosen: list[int] = []
        for key in range(len(self.poses)):
            if self.near is not None:
                x_m, y_m, radius_m = self.near
                if math.hypot(self.poses[key, 0] - x_m, self.poses[key, 1] - y_m) > radius_m + APART_M:
                    continue
            off = self.poses[chosen, :2] - self.poses[key, :2]
            if not chosen or float(np.hypot(off[:, 0], off[:, 1]).min()) > APART_M:
                chosen.append(key)
        return np.array(chosen, dtype=np.int64)


def _alike(found: list[Place]) -> tuple[Place, ...]:
    """The best place and those that fit nearly as well, each once."""
    alike: list[Place] = []
    for place in sorted(found, key=lambda each: -each.quality):
        if alike and place.quality < ALIKE * alike[0].quality:
            break
        if not any(_is_same(place.pose, other.pose) for other in alike):
            alike.append(place)
    return tuple(alike[:MOST_ALIKE])


def _is_same(a: Pose2, b: Pose2, within_m: float = SAME_M, within_rad: float = SAME_RAD) -> bool:
    off = a.inverse() @ b
    return math.hypot(off.x_m, off.y_m) < within_m and abs(off.yaw_rad) < within_rad
