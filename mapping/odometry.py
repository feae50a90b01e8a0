"""Motion of a differential drive from the counts of its wheels, with its uncertainty (S01).

Between two counts both wheels are taken to roll at constant speed, so the vehicle moves on an arc; that is exact for
any length of step. Errors grow with the way rolled: each wheel's travel has a variance proportional to its length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2, exp_se2
from mapping.kernels import motion as kernels

F64 = NDArray[np.float64]
_POSE_SLACK_M = 0.02  # estimators correct themselves by so much between two poses
_REFUSED_IN_A_ROW = 5  # then the new place is believed, and what lay between is unknown


@dataclass(frozen=True, slots=True)
class DriveGeometry:
    """A differential drive.

    ticks_per_turn: counts a wheel turn, gear included; negative where the count falls when rolling forward.
    travel_noise_m_per_sqrt_m: standard deviation of a wheel's travel after one metre; grows with the square root.
    unknown_speed_m_s, unknown_turn_rad_s: how fast it may have moved where counts are missing.
    """

    wheel_radius_left_m: float
    wheel_radius_right_m: float
    track_width_m: float
    ticks_per_turn_left: float
    ticks_per_turn_right: float
    travel_noise_m_per_sqrt_m: float = 0.01
    unknown_speed_m_s: float = 1.0
    unknown_turn_rad_s: float = 1.0

    def __post_init__(self) -> None:
        positive = (self.wheel_radius_left_m, self.wheel_radius_right_m, self.track_width_m)
        if not all(math.isfinite(value) and value > 0.0 for value in positive):
            raise ValueError("wheel radii and track width are positive lengths in metres")
        if not self.ticks_per_turn_left or not self.ticks_per_turn_right:
            raise ValueError("a wheel turn has at least one tick")

    @property
    def left_m_per_tick(self) -> float:
        """Signed travel of the left wheel a tick."""
        return 2.0 * math.pi * self.wheel_radius_left_m / self.ticks_per_turn_left

    @property
    def right_m_per_tick(self) -> float:
        """Signed travel of the right wheel a tick."""
        return 2.0 * math.pi * self.wheel_radius_right_m / self.ticks_per_turn_right


@dataclass(frozen=True, slots=True)
class OdometryState:
    """Where the base is in the odom frame.

    covariance: (3, 3) of x, y, yaw in the odom frame, since the start.  forward_m_s, yaw_rad_s: over the last step.
    broken: the motion just before this state is unknown; the pose was kept and the covariance widened.
    """

    stamp_ns: int
    odom_from_base: Pose2
    covariance: F64
    forward_m_s: float
    yaw_rad_s: float
    broken: bool


class DifferentialOdometry:
    """Integrates wheel counts. The odom frame is where it started."""

    def __init__(self, geometry: DriveGeometry, *, start: Pose2 = IDENTITY) -> None:
        self._geometry = geometry
        self._pose = start
        self._covariance: F64 = np.zeros((3, 3))
        self._last: tuple[int, int, int] | None = None

    def update(self, stamp_ns: int, left_ticks: int, right_ticks: int, *, continuous: bool = True) -> OdometryState:
        """Take running counts of both wheels at one instant.

        continuous=False: what happened since the last counts is not known.  ValueError if the stamp does not rise; the
        state is then as before, and the counts may be given again later.
        """
        last = self._last
        if last is not None and stamp_ns <= last[0]:
            raise ValueError(f"stamps must rise: {stamp_ns} after {last[0]}")
        self._last = (stamp_ns, left_ticks, right_ticks)
        if last is None:
            return self._state(stamp_ns, 0.0, 0.0, broken=False)
        seconds = (stamp_ns - last[0]) * 1e-9
        if not continuous:
            self._widen(seconds)
            return self._state(stamp_ns, 0.0, 0.0, broken=True)
        left_m = (left_ticks - last[1]) * self._geometry.left_m_per_tick
        right_m = (right_ticks - last[2]) * self._geometry.right_m_per_tick
        forward_m, turn_rad = self._roll(left_m, right_m)
        return self._state(stamp_ns, forward_m / seconds, turn_rad / seconds, broken=False)

    def _roll(self, left_m: float, right_m: float) -> tuple[float, float]:
        """Move along the arc of both travels; returns its length and turn."""
        track = self._geometry.track_width_m
        forward, turn = (left_m + right_m) / 2.0, (right_m - left_m) / track
        step = exp_se2((forward, 0.0, turn))
        noise = self._geometry.travel_noise_m_per_sqrt_m**2
        self._covariance = kernels.rolled_covariance(
            self._covariance, self._pose.yaw_rad, forward, turn, track, noise * abs(left_m), noise * abs(right_m)
        )
        self._pose = self._pose @ step
        return forward, turn

    def _widen(self, seconds: float) -> None:
        way = (self._geometry.unknown_speed_m_s * seconds) ** 2
        turn = min((self._geometry.unknown_turn_rad_s * seconds) ** 2, math.pi**2)
        self._covariance = self._covariance + np.diag([way, way, turn])

    def _state(self, stamp_ns: int, forward_m_s: float, yaw_rad_s: float, *, broken: bool) -> OdometryState:
        return OdometryState(stamp_ns, self._pose, self._covariance.copy(), forward_m_s, yaw_rad_s, broken)


class FollowedPoses:
    """Another estimator's poses as odometry: its steps are followed, its jumps are not.

    The odom frame is where it was first heard, so that an estimator that begins anew elsewhere moves nothing. Its
    errors are not told, so they are taken to grow with the way, as a wheel's do.
    max_speed_m_s: a faster step is no motion.  noise_m_per_sqrt_m, noise_rad_per_sqrt_m: deviation after one metre.
    """

    def __init__(
        self, *, max_speed_m_s: float, noise_m_per_sqrt_m: float = 0.02, noise_rad_per_sqrt_m: float = 0.02
    ) -> None:
        self._max_speed_m_s = max_speed_m_s
        self._noise = (noise_m_per_sqrt_m, noise_rad_per_sqrt_m)
        self._pose = IDENTITY
        self._covariance: F64 = np.zeros((3, 3))
        self._last: tuple[int, Pose2] | None = None
        self._refused = 0

    def update(self, stamp_ns: int, pose: Pose2, *, continuous: bool = True) -> OdometryState | None:
        """Take a pose in the estimator's own frame; None if no robot moves like that.

        continuous=False: it began anew, so the motion since its last pose is not known. ValueError if the stamp does
        not rise.
        """
        last = self._last
        if last is not None and stamp_ns <= last[0]:
            raise ValueError(f"stamps must rise: {stamp_ns} after {last[0]}")
        if last is None:
            self._last = (stamp_ns, pose)
            return OdometryState(stamp_ns, self._pose, self._covariance.copy(), 0.0, 0.0, False)
        seconds = (stamp_ns - last[0]) * 1e-9
        step = last[1].inverse() @ pose
        way_m = math.hypot(step.x_m, step.y_m)
        if continuous and way_m > self._max_speed_m_s * seconds + _POSE_SLACK_M:
            self._refused += 1
            if self._refused <= _REFUSED_IN_A_ROW:
                return None
            continuous = False  # it stays there: a jump of the estimator
        self._refused = 0
        self._last = (stamp_ns, pose)
        if not continuous:
            reach = (self._max_speed_m_s * seconds) ** 2
            self._covariance = self._covariance + np.diag([reach, reach, min(seconds**2, math.pi**2)])
            return OdometryState(stamp_ns, self._pose, self._covariance.copy(), 0.0, 0.0, True)
        turn = math.remainder(step.yaw_rad, 2.0 * math.pi)
        c, s = math.cos(self._pose.yaw_rad), math.sin(self._pose.yaw_rad)
        across, along = c * step.y_m + s * step.x_m, c * step.x_m - s * step.y_m
        by_pose = np.array([[1.0, 0.0, -across], [0.0, 1.0, along], [0.0, 0.0, 1.0]])
        noise_m, noise_rad = self._noise
        way = way_m + 0.1 * abs(turn)
        noise = np.diag([noise_m**2 * way, noise_m**2 * way, noise_rad**2 * way])
        self._covariance = by_pose @ self._covariance @ by_pose.T + noise
        self._pose = self._pose @ step
        return OdometryState(stamp_ns, self._pose, self._covariance.copy(), step.x_m / seconds, turn / seconds, False)
