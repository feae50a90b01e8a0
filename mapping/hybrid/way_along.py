"""How far along a hallway: wheels predict, known corners and openings correct, walls tell the heading (S45)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.hybrid.places import Area, Corner, HybridRules, Opening
from mapping.lines.lines import Lines

F64 = NDArray[np.float64]

_LANDMARK_SIGMA_M = 0.05
_HEADING_SIGMA_RAD = 0.02
_ALIGNED_RAD = math.radians(10.0)
_GATE = 9.21  # squared Mahalanobis distance, two degrees of freedom: 1 % of true landmarks are refused
_LEAST_HEADING_WALL_M = 0.6
_WEIGHT_MOST = 20


class WayAlong:
    """A pose (x along the hallway, y across, yaw), its covariance: a filter with landmarks that are not its state."""

    def __init__(self, pose: Pose2, covariance: F64, rules: HybridRules) -> None:
        self.pose = pose
        self.covariance: F64 = covariance.copy()
        self._rules = rules

    def predict(self, step: Pose2, covariance: F64) -> None:
        """The base moved by `step`, in its own frame before; covariance (3, 3) of it there."""
        c, s = math.cos(self.pose.yaw_rad), math.sin(self.pose.yaw_rad)
        moved = self.pose @ step
        by_pose = np.array([[1.0, 0.0, -(moved.y_m - self.pose.y_m)], [0.0, 1.0, moved.x_m - self.pose.x_m], [0, 0, 1]])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self.covariance = by_pose @ self.covariance @ by_pose.T + turn @ covariance @ turn.T
        self.pose = moved

    def correct(self, lines: Lines, corners: Sequence[Corner], openings: Sequence[Opening], area: Area) -> int:
        """Take what one scan shows, base frame; returns how many known landmarks were matched."""
        self._by_walls(lines)
        known = [(c.point_m, c.convex) for c in area.corners if c.seen > 1]
        matched = 0
        for corner in corners:
            matched += self._by_landmark(corner.point_m, [point for point, convex in known if convex is corner.convex])
        ends = [o.centre for o in area.openings if o.seen > 2 and not o.dismissed]
        for opening in openings:
            matched += self._by_landmark(opening.centre, ends)
        return matched

    def learn(self, corners: Sequence[Corner], area: Area) -> None:
        """Corners of the scan, base frame, into the list of the hallway."""
        for corner in corners:
            x, y = (float(v) for v in self.pose.apply(np.array(corner.point_m)))
            same = [c for c in area.corners if c.convex is corner.convex and math.dist(c.point_m, (x, y)) < 0.25]
            if not same:
                area.corners.append(Corner((x, y), corner.convex))
                continue
            known = min(same, key=lambda c: math.dist(c.point_m, (x, y)))
            share = 1.0 / min(known.seen + 1, _WEIGHT_MOST)
            known.point_m = (
                known.point_m[0] + share * (x - known.point_m[0]),
                known.point_m[1] + share * (y - known.point_m[1]),
            )
            known.seen += 1

    def _by_walls(self, lines: Lines) -> None:
        """Walls run along the hallway or across it."""
        way = (lines.end_m - lines.start_m)[lines.length_m >= _LEAST_HEADING_WALL_M]
        if not len(way):
            return
        off = np.arctan2(way[:, 1], way[:, 0]) + self.pose.yaw_rad
        off = (off + 0.25 * math.pi) % (0.5 * math.pi) - 0.25 * math.pi
        weight = np.hypot(way[:, 0], way[:, 1]) * (np.abs(off) < _ALIGNED_RAD)
        if not float(weight.sum()) > 0.0:
            return
        heading = -float(weight @ off / weight.sum())
        self._update(np.array([[0.0, 0.0, 1.0]]), np.array([heading]), np.array([[_HEADING_SIGMA_RAD**2]]))

    def _by_landmark(self, seen: tuple[float, float], known: Sequence[tuple[float, float]]) -> bool:
        if not known:
            return False
        at = self.pose.apply(np.array(seen))
        nearest = min(known, key=lambda point: math.dist(point, at))
        if math.dist(nearest, at) > self._rules.landmark_m:
            return False
        h = np.array([[1.0, 0.0, -(at[1] - self.pose.y_m)], [0.0, 1.0, at[0] - self.pose.x_m]])
        noise = np.eye(2) * _LANDMARK_SIGMA_M**2
        innovation = np.array(nearest) - at
        total = h @ self.covariance @ h.T + noise
        if float(innovation @ np.linalg.solve(total, innovation)) > _GATE:
            return False
        self._update(h, innovation, noise)
        return True

    def _update(self, h: F64, innovation: F64, noise: F64) -> None:
        total = h @ self.covariance @ h.T + noise
        gain = np.linalg.solve(total, h @ self.covariance).T
        x, y, yaw = gain @ innovation
        pose = self.pose
        self.pose = Pose2(pose.x_m + float(x), pose.y_m + float(y), wrap_angle(pose.yaw_rad + float(yaw)))
        left = np.eye(3) - gain @ h
        self.covariance = left @ self.covariance @ left.T + gain @ noise @ gain.T
