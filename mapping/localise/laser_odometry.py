"""Odometry of a robot without wheels that tell: the motion of one laser, from its sweeps alone.

Each sweep is laid on the last key scans, as SLAM's front end does. A sweep lasts as long as the robot takes to turn by
some degrees, so it must be de-skewed before it is laid anywhere, by the very motion that is looked for: first by the
motion so far, then by what came out, until both agree. What is told is the pose at the middle beam of each sweep (at
the last one of a short sweep); what lies between two of them is interpolated by whoever asks, with what was measured on
both sides. It drifts slowly, and never jumps but where it says that it lost track.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapping.deskew import Deskewed, beam_stamps, deskew
from mapping.frames import IDENTITY, Pose2, compose_covariance, exp_se2, log_se2
from mapping.localise.closure_records import floored_covariance, turned_information
from mapping.localise.scan_match import Match
from mapping.localise.slam_records import SlamSettings
from mapping.localise.tracker import References, Tracker
from mapping.localise.views import View, ViewStore
from mapping.odometry import OdometryState
from mapping.pose_buffer import PoseBuffer
from mapping.scan import Scan

F64 = NDArray[np.float64]

NAME = "laser"
VELOCITY_OVER_S = 0.01
PASSES = 3
AGREED_M = 0.003  # motion of a sweep's ends: a pass more would change nothing
AGREED_RAD = math.radians(0.1)
LEAST_NS = 45_000_000  # between sweeps that are looked at: every second one of a 40 Hz laser
STILL_M = 0.003  # and
STILL_RAD = math.radians(0.1)  # from where it was told last, and
STILL_M_S = 0.03  # so slow:
STILL_RAD_S = math.radians(2.0)  # it stands, and what is told does not tremble
SHORT_NS = 20_000_000  # half of a sweep in which motion hardly changes: what it says holds for its last beam, too
LOST_NS = 600_000_000  # without a sweep that fits, or three periods: then where it has come to is not known
MOST_LOST_NS = 3_000_000_000
UNKNOWN_M_S = 1.0
UNKNOWN_RAD_S = 1.0
FLOOR_M = 0.004
FLOOR_RAD = math.radians(0.08)


class LaserOdometry:
    """See the module's docstring. The odom frame is where the base was at the first sweep.

    events: how often what happened, by name.
    """

    def __init__(self, settings: SlamSettings | None = None) -> None:
        self._settings = settings if settings is not None else SlamSettings()
        self.events: Counter[str] = Counter()
        self._tracker = Tracker(self._settings, self.events, velocity_over_s=VELOCITY_OVER_S)
        self._views = ViewStore()
        self._keys: list[tuple[int, Pose2]] = []  # number of the view, odom_from_sensor; the newest last
        self._key_covariance: F64 = np.zeros((3, 3))
        self._told_pose = IDENTITY
        self._heard_ns: int | None = None
        self._period_ns = MOST_LOST_NS  # between the last two sweeps
        self._twist: F64 = np.zeros(3)  # of the base, from the middle of the last sweep but one to that of the last

    def take(self, scan: Scan, base_from_sensor: Pose2) -> OdometryState | None:
        """Where the base was midway in a sweep as it was measured, or at its end; None where that cannot be told yet.

        Sweeps in order of stamps. After LOST_NS without one that fits, the state is `broken`.
        """
        stamps = beam_stamps(scan)
        last = self._tracker.last
        if not len(stamps):
            return None
        middle_ns = int(stamps[len(stamps) // 2])
        if last is not None and middle_ns <= last[0]:
            self.events["scan_not_later"] += 1
            return None
        if last is not None and middle_ns - last[0] < LEAST_NS:
            return None
        limit_ns = max(LOST_NS, min(3 * self._period_ns, MOST_LOST_NS))
        if self._heard_ns is not None:
            self._period_ns = middle_ns - self._heard_ns
        self._heard_ns = middle_ns
        if last is None or middle_ns - last[0] > limit_ns:
            return self._begun(scan, base_from_sensor, middle_ns)
        seconds = (middle_ns - last[0]) * 1e-9
        twist, found = self._twist, None
        for _ in range(PASSES):
            view = self._tracker.view(_glided(scan, stamps, middle_ns, twist, base_from_sensor).scan, NAME)
            found = None if view is None else self._laid(view, middle_ns, base_from_sensor)
            if view is None or found is None:
                return None
            moved = log_se2(last[1].inverse() @ found.pose @ base_from_sensor.inverse()) / seconds
            off = 0.5e-9 * float(stamps[-1] - stamps[0]) * (moved - twist)
            twist = moved
            if math.hypot(off[0], off[1]) < AGREED_M and abs(off[2]) < AGREED_RAD:
                break
        assert view is not None
        assert found is not None
        self._twist = moved
        state = self._told(view, found, middle_ns, base_from_sensor, moved)
        left_ns = int(stamps[-1]) - middle_ns
        if 0 < left_ns <= SHORT_NS:
            ahead = state.odom_from_base @ exp_se2(moved * (left_ns * 1e-9))
            state = replace(state, stamp_ns=int(stamps[-1]), odom_from_base=ahead)
        if self._stands(state):
            return replace(state, odom_from_base=self._told_pose, forward_m_s=0.0, yaw_rad_s=0.0)
        self._told_pose = state.odom_from_base
        return state

    def _stands(self, state: OdometryState) -> bool:
        off = self._told_pose.inverse() @ state.odom_from_base
        is_slow = abs(state.forward_m_s) < STILL_M_S and abs(state.yaw_rad_s) < STILL_RAD_S
        return is_slow and math.hypot(off.x_m, off.y_m) < STILL_M and abs(off.yaw_rad) < STILL_RAD

    @property
    def lost_scans(self) -> int:
        """How many sweeps in a row fitted nothing."""
        return self._tracker.lost_scans

    def counters(self) -> dict[str, int]:
        """Sweeps that fitted nothing, and how often it began anew."""
        return {
            "laser_odometry.not_matched": self.events["not_matched"],
            "laser_odometry.begun_anew": self.events["begun_anew"],
        }

    def _laid(self, view: View, middle_ns: int, base_from_sensor: Pose2) -> Match | None:
        guess = self._tracker.predicted(middle_ns, base_from_sensor, None)
        return self._tracker.matched(view, self._references(guess.map_from_sensor), guess)

    def _references(self, near: Pose2) -> References:
        close = [
            (number, pose)
            for number, pose in self._keys
            if math.hypot(pose.x_m - near.x_m, pose.y_m - near.y_m) < self._settings.near_m
        ] or self._keys[-1:]
        rows = np.array([number for number, _ in close], dtype=np.int64)
        return References(self._views.kept(), rows, np.array([_row(pose) for _, pose in close]))

    def _told(self, view: View, match: Match, middle_ns: int, base_from_sensor: Pose2, moved: F64) -> OdometryState:
        """The state at a sweep that was laid on others; the sweep is kept if it saw new ground."""
        pose = match.pose @ base_from_sensor.inverse()
        _, before = self._keys[-1]
        step = before.inverse() @ match.pose
        seen = floored_covariance(turned_information(match.information(), -before.yaw_rad), FLOOR_M, FLOOR_RAD)
        covariance = compose_covariance(before, self._key_covariance, step, seen)
        s = self._settings
        if math.hypot(step.x_m, step.y_m) > s.key_m or abs(step.yaw_rad) > s.key_rad:
            self._keep(view, match.pose)
            self._key_covariance = covariance
        self._tracker.told(middle_ns, pose, None, matched=True)
        return OdometryState(middle_ns, pose, covariance, float(moved[0]), float(moved[2]), False)

    def _keep(self, view: View, odom_from_sensor: Pose2) -> None:
        self._keys.append((self._views.add(view), odom_from_sensor))
        gone, self._keys = self._keys[: -self._settings.references], self._keys[-self._settings.references :]
        self._views.give_up([number for number, _ in gone])

    def _begun(self, scan: Scan, base_from_sensor: Pose2, middle_ns: int) -> OdometryState | None:
        """The first sweep, from a robot that is taken to stand; or the first after it lost track, where it lost it."""
        view = self._tracker.view(scan, NAME)
        if view is None:
            return None
        last, pose = self._tracker.last, IDENTITY
        if last is not None:
            pose = last[1]
            self.events["begun_anew"] += 1
            seconds = (middle_ns - last[0]) * 1e-9
            way, turn = (UNKNOWN_M_S * seconds) ** 2, min((UNKNOWN_RAD_S * seconds) ** 2, math.pi**2)
            self._key_covariance = self._key_covariance + np.diag([way, way, turn])
            self._views.give_up([number for number, _ in self._keys])
            self._keys, self._twist = [], np.zeros(3)
            self._tracker.lost_scans = 0
        self._keep(view, pose @ base_from_sensor)
        self._tracker.told(middle_ns, pose, None, matched=True)
        self._told_pose = pose
        return OdometryState(middle_ns, pose, self._key_covariance.copy(), 0.0, 0.0, last is not None)


def _glided(scan: Scan, stamps: NDArray[np.int64], middle_ns: int, twist: F64, base_from_sensor: Pose2) -> Deskewed:
    """The sweep as from its middle, by a robot that moves evenly."""
    if stamps[0] == stamps[-1]:
        return Deskewed(scan, base_from_sensor, np.zeros((len(stamps), 2)))
    way = PoseBuffer(capacity=3)
    for stamp_ns in sorted({int(stamps[0]), middle_ns, int(stamps[-1])}):
        way.add(stamp_ns, exp_se2(twist * ((stamp_ns - middle_ns) * 1e-9)))
    return deskew(scan, way, base_from_sensor)


def _row(pose: Pose2) -> F64:
    return np.array([pose.x_m, pose.y_m, pose.yaw_rad])
