"""Anchors of the way here: what the sweeps of the last metres saw, joined by odometry, as one graph (S21, S25).

One sweep of a plain corridor shows an anchor or two, too few to say where it is; on two metres there may be a door.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from mapping.features.anchors import Anchors, no_anchors
from mapping.features.graph import AnchorGraph, anchor_graph
from mapping.features.scenes import Sight, sight_of
from mapping.frames import Pose2, wrap_angle, wrap_angles
from mapping.kernels import features as kernels
from mapping.scan import Scan

LENGTH_M: Final = 2.0
STEP_M: Final = 0.25
STEP_RAD: Final = math.radians(15.0)
MOST: Final = 10
SAME_M: Final = 0.25
SAME_RAD: Final = math.radians(12.0)


@dataclass(slots=True)
class _Kept:
    """A sweep, how far the drive was then, from where it was seen, and, once asked for, what it shows."""

    scan: Scan
    way_m: float
    pose: Pose2
    sight: Sight | None = None

    def seen(self) -> Sight:
        if self.sight is None:
            self.sight = sight_of(self.scan)
        return self.sight


class Stretch:
    """The newest sweep of one laser and some of those of the last LENGTH_M before it, at most MOST."""

    def __init__(self, *, jump_m: float = 1.0, jump_rad: float = math.radians(60.0)) -> None:
        """jump_m, jump_rad: a pose farther than that from the one before was corrected in between, and what came before
        it does not count; infinite for odometry, which never jumps."""
        self._jump_m, self._jump_rad = jump_m, jump_rad
        self._newest: _Kept | None = None
        self._kept: deque[_Kept] = deque(maxlen=MOST)

    def would_keep(self, pose: Pose2) -> bool:
        """Whether a sweep from there would be kept beyond the next one: others need not be taken to know the way."""
        return not self._kept or _moved(self._kept[-1].pose, pose)

    def take(self, scan: Scan, pose: Pose2) -> None:
        """The next sweep. pose: the sensor's by odometry, or in any frame that moves as evenly."""
        last = self._newest
        way_m = 0.0
        if last is not None:
            step_m = math.hypot(pose.x_m - last.pose.x_m, pose.y_m - last.pose.y_m)
            if step_m > self._jump_m or abs(wrap_angle(pose.yaw_rad - last.pose.yaw_rad)) > self._jump_rad:
                self._kept.clear()
            way_m = last.way_m + step_m
        self._newest = _Kept(scan, way_m, pose)
        if self.would_keep(pose):
            self._kept.append(self._newest)

    def begin_anew(self) -> None:
        """What came before the newest sweep no longer counts: poses have been corrected since."""
        self._kept.clear()

    def sight(self) -> Sight | None:
        """What the newest sweep shows, None before the first."""
        return None if self._newest is None else self._newest.seen()

    def graph(self) -> AnchorGraph:
        """Anchors of all these sweeps, each once, in the newest one's sensor frame.

        ValueError if bearings of a sweep neither rise nor fall throughout.
        """
        newest = self._newest
        if newest is None:
            return anchor_graph(no_anchors())
        parts = [newest.seen().graph.anchors]
        newest_from_world = newest.pose.inverse()
        for kept in reversed(self._kept):
            if kept is not newest and newest.way_m - kept.way_m <= LENGTH_M:
                parts.append(kept.seen().graph.anchors.transformed(newest_from_world @ kept.pose))
        return anchor_graph(merged(parts))


def merged(parts: list[Anchors]) -> Anchors:
    """Anchors of several sweeps in one frame: of those within SAME_M that have a wall in the same direction, the one of
    the earliest part. No beam belongs to those of later parts."""
    found = parts[0].rows if parts else no_anchors().rows
    for part in parts[1:]:
        rows = part.rows.copy()
        rows[:, kernels.BEAM] = -1
        apart = np.hypot(*(rows[:, None, :2] - found[None, :, :2]).transpose(2, 0, 1))
        walls, others = rows[:, kernels.BEFORE : kernels.LENGTH], found[:, kernels.BEFORE : kernels.LENGTH]
        turn = np.abs(wrap_angles(walls[:, None, :, None] - others[None, :, None, :]))
        same_wall = np.any(turn < SAME_RAD, axis=(2, 3))  # false for NaN, which is no wall
        is_new = ~np.any((apart < SAME_M) & same_wall, axis=1)
        found = np.concatenate((found, rows[is_new]))
    return Anchors(found)


def _moved(a: Pose2, b: Pose2) -> bool:
    way_m = math.hypot(b.x_m - a.x_m, b.y_m - a.y_m)
    return way_m >= STEP_M or abs(wrap_angle(b.yaw_rad - a.yaw_rad)) >= STEP_RAD
