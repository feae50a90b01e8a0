"""Poses in the plane and in space, and their algebra (S01).

A pose is (x, y, yaw) in metres and radians, yaw counter-clockwise from x, which points forward (REP-103). Names
cancel: `world_from_base @ base_from_laser` is `world_from_laser`. Frames (REP-105): map, odom, base, one per sensor.

Covariances are (3, 3) over (x, y, yaw) and belong to a pose a_from_b as an error *in frame a*: the true pose is
(x + dx, y + dy, yaw + dyaw). They are carried to first order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]

_SMALL_ANGLE = 1e-6


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
        moved = np.empty(p.shape)  # stack() would take longer than the sums for few points
        moved[..., 0] = self.x_m + c * p[..., 0] - s * p[..., 1]
        moved[..., 1] = self.y_m + s * p[..., 0] + c * p[..., 1]
        return moved

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


def exp_se2(twist: ArrayLike) -> Pose2:
    """The motion along a constant twist (vx, vy, w) for unit time: an arc. Inverse of log_se2 for |w| < pi."""
    vx, vy, w = np.asarray(twist, dtype=np.float64).tolist()
    a, b = _arc_coefficients(w)
    return Pose2(a * vx - b * vy, b * vx + a * vy, wrap_angle(w))


def log_se2(pose: Pose2) -> F64:
    """The twist (3,) whose motion in unit time is `pose`; yaw taken in [-pi, pi)."""
    w = wrap_angle(pose.yaw_rad)
    a, b = _arc_coefficients(w)
    n = a * a + b * b
    return np.array([(a * pose.x_m + b * pose.y_m) / n, (a * pose.y_m - b * pose.x_m) / n, w])


def _arc_coefficients(w: float) -> tuple[float, float]:
    """sin(w)/w and (1 - cos(w))/w, by series near 0."""
    if abs(w) < _SMALL_ANGLE:
        return 1.0 - w * w / 6.0, w / 2.0
    return math.sin(w) / w, (1.0 - math.cos(w)) / w


def interpolate(start: Pose2, end: Pose2, share: float) -> Pose2:
    """The pose at `share` of the way along the arc from start (0) to end (1): constant twist between them.

    ValueError outside [0, 1]: nothing is extrapolated.
    """
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"a share of the way lies between 0 and 1, got {share}")
    return start @ exp_se2(share * log_se2(start.inverse() @ end))


def compose_covariance(first: Pose2, first_cov: ArrayLike, second: Pose2, second_cov: ArrayLike) -> F64:
    """Covariance (3, 3) of first @ second, their errors independent."""
    c, s = math.cos(first.yaw_rad), math.sin(first.yaw_rad)
    by_first = np.array(
        [
            [1.0, 0.0, -s * second.x_m - c * second.y_m],
            [0.0, 1.0, c * second.x_m - s * second.y_m],
            [0.0, 0.0, 1.0],
        ]
    )
    by_second = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    a, b = np.asarray(first_cov, dtype=np.float64), np.asarray(second_cov, dtype=np.float64)
    return np.asarray(by_first @ a @ by_first.T + by_second @ b @ by_second.T)


def inverse_covariance(pose: Pose2, covariance: ArrayLike) -> F64:
    """Covariance (3, 3) of pose.inverse(), given that of pose. (Not the inverse matrix of a covariance.)"""
    c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    back = pose.inverse()
    jacobian = np.array([[-c, -s, back.y_m], [s, -c, -back.x_m], [0.0, 0.0, -1.0]])
    return np.asarray(jacobian @ np.asarray(covariance, dtype=np.float64) @ jacobian.T)


@dataclass(frozen=True, slots=True)
class Pose3:
    """A rigid motion of space, SE(3), for sensors mounted at an angle: translation and roll, pitch, yaw (REP-103).

    Rotation is Rz(yaw) Ry(pitch) Rx(roll): fixed axes x, then y, then z.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0

    def rotation(self) -> F64:
        """The (3, 3) rotation matrix."""
        cr, sr = math.cos(self.roll_rad), math.sin(self.roll_rad)
        cp, sp = math.cos(self.pitch_rad), math.sin(self.pitch_rad)
        cy, sy = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )

    def matrix(self) -> F64:
        """The (4, 4) homogeneous matrix."""
        m = np.eye(4)
        m[:3, :3] = self.rotation()
        m[:3, 3] = (self.x_m, self.y_m, self.z_m)
        return m

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Pose3:
        """The pose of a (4, 4) homogeneous matrix. Roll is 0 at pitch +-90 degrees. ValueError on other shapes."""
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape != (4, 4):
            raise ValueError(f"a spatial pose's matrix is (4, 4), got {m.shape}")
        pitch = math.atan2(-m[2, 0], math.hypot(m[0, 0], m[1, 0]))
        if math.hypot(m[0, 0], m[1, 0]) > 1e-9:
            roll, yaw = math.atan2(m[2, 1], m[2, 2]), math.atan2(m[1, 0], m[0, 0])
        else:
            roll, yaw = 0.0, math.atan2(-m[0, 1], m[1, 1])
        return Pose3(float(m[0, 3]), float(m[1, 3]), float(m[2, 3]), roll, pitch, yaw)

    def __matmul__(self, other: Pose3) -> Pose3:
        """Composition: a_from_b @ b_from_c is a_from_c."""
        return Pose3.from_matrix(self.matrix() @ other.matrix())

    def inverse(self) -> Pose3:
        """b_from_a of a_from_b."""
        m = np.eye(4)
        r = self.rotation().T
        m[:3, :3] = r
        m[:3, 3] = -r @ np.array([self.x_m, self.y_m, self.z_m])
        return Pose3.from_matrix(m)

    def apply(self, points: ArrayLike) -> F64:
        """(N, 3) or (3,) points of frame b in frame a; same shape."""
        p = np.asarray(points, dtype=np.float64)
        return np.asarray(p @ self.rotation().T + np.array([self.x_m, self.y_m, self.z_m]))

    def in_plane(self) -> Pose2:
        """The motion seen from above: x, y and yaw."""
        return Pose2(self.x_m, self.y_m, wrap_angle(self.yaw_rad))

    @staticmethod
    def from_plane(pose: Pose2, z_m: float = 0.0) -> Pose3:
        """A motion in the plane at height z_m."""
        return Pose3(pose.x_m, pose.y_m, z_m, 0.0, 0.0, pose.yaw_rad)
