"""Poses in the plane and their algebra (S01).

A pose is (x, y, yaw) in metres and radians, yaw counter-clockwise from x, which points forward (REP-103). Names
cancel: `world_from_base @ base_from_laser` is `world_from_laser`. Frames (REP-105): map, odom, base, one per sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]


def wrap_angle(angle_rad: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def wrap_angles(angle_rad: ArrayLike) -> F64:
    """The same angles in [-pi, pi); any shape."""
    return (np.asarray(angle_rad, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


@dataclass(frozen=True, slots=True)
class Pose2:
    """A rigid motion of the plane, SE(2). `a_from_b` maps coordinates in frame b to coordinates in frame a."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0

    def __matmul__(self, other: Pose2) -> Pose2:
        """Composition: a_from_b @ b_from_c is a_from_c; yaw wrapped to [-pi, pi)."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Pose2(
            self.x_m + c * other.x_m - s * other.y_m,
            self.y_m + s * other.x_m + c * other.y_m,
            wrap_angle(self.yaw_rad + other.yaw_rad),
        )

    def inverse(self) -> Pose2:
        """b_from_a of a_from_b."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Pose2(-c * self.x_m - s * self.y_m, s * self.x_m - c * self.y_m, wrap_angle(-self.yaw_rad))

    def apply(self, points: ArrayLike) -> F64:
        """(N, 2) or (2,) points of frame b in frame a; same shape."""
        p = np.asarray(points, dtype=np.float64)
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.stack((self.x_m + c * p[..., 0] - s * p[..., 1], self.y_m + s * p[..., 0] + c * p[..., 1]), axis=-1)

    def matrix(self) -> F64:
        """The (3, 3) homogeneous matrix."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array([[c, -s, self.x_m], [s, c, self.y_m], [0.0, 0.0, 1.0]])

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Pose2:
        """The pose of a (3, 3) homogeneous matrix; ValueError if the shape differs."""
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape != (3, 3):
            raise ValueError(f"a pose's matrix is (3, 3), got {m.shape}")
        return Pose2(float(m[0, 2]), float(m[1, 2]), math.atan2(m[1, 0], m[0, 0]))


IDENTITY = Pose2()
