"""From sweeps of a 2D laser on a nodding or rotating mount to a cloud of points in the base frame (S11)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.deskew import beam_stamps
from mapping.frames import Pose2, Pose3
from mapping.pose_buffer import GoneError, NotYetError, PoseBuffer
from mapping.scan import Scan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Axle = Literal["pitch", "roll", "yaw"]

_HALF_TURN: Final = np.pi
_HERE: Final = Pose3()


class AngleBuffer:
    """The last `capacity` angles of a mount and when they were read; asked for between, never beyond.

    Angles count on through full turns; nothing is interpolated over more than max_gap_ns, nor over half a turn or more
    between two readings, which may have been any way round.
    """

    def __init__(self, *, capacity: int = 4096, max_gap_ns: int = 200_000_000) -> None:
        if capacity < 2 or max_gap_ns <= 0:
            raise ValueError("an angle buffer keeps at least two angles, and a gap is above 0 ns")
        self._capacity, self._max_gap_ns = capacity, max_gap_ns
        self._stamp: I64 = np.zeros(2 * capacity, dtype=np.int64)
        self._angle: F64 = np.zeros(2 * capacity)
        self._begin = self._end = 0

    def __len__(self) -> int:
        return self._end - self._begin

    def add(self, stamp_ns: int, angle_rad: float) -> bool:
        """A newer angle; False if it is not newer than the last, or not finite, and was dropped."""
        if not np.isfinite(angle_rad) or (len(self) and stamp_ns <= self._stamp[self._end - 1]):
            return False
        if self._end == len(self._stamp):
            count = self._capacity - 1
            self._stamp[:count] = self._stamp[self._end - count : self._end]
            self._angle[:count] = self._angle[self._end - count : self._end]
            self._begin, self._end = 0, count
        self._stamp[self._end], self._angle[self._end] = stamp_ns, angle_rad
        self._end += 1
        self._begin = max(self._begin, self._end - self._capacity)
        return True

    def clear(self) -> None:
        """Forget all: the angle is unknown from here on, as after the encoder was away."""
        self._begin = self._end = 0

    def at(self, stamp_ns: I64) -> F64:
        """Angles (N,) at times (N,). Raises NotYetError beyond the newest, GoneError before the oldest or in a gap."""
        stamp, angle = self._stamp[self._begin : self._end], self._angle[self._begin : self._end]
        if not len(stamp_ns):
            return np.empty(0)
        if not len(stamp) or int(stamp_ns.max()) > stamp[-1]:
            raise NotYetError("the mount's angle is not known yet")
        if int(stamp_ns.min()) < stamp[0]:
            raise GoneError("the mount's angle at that time is not kept")
        after = np.clip(np.searchsorted(stamp, stamp_ns, side="left"), 1, max(len(stamp) - 1, 1))
        if len(stamp) == 1:
            return np.full(len(stamp_ns), angle[0])
        gap, turn = stamp[after] - stamp[after - 1], angle[after] - angle[after - 1]
        share = (stamp_ns - stamp[after - 1]) / gap
        between = (share > 0.0) & (share < 1.0)
        if np.any(between & ((gap > self._max_gap_ns) | (np.abs(turn) >= _HALF_TURN))):
            raise GoneError("the mount's angle was not read for too long there, or turned half a turn between readings")
        return np.asarray(angle[after - 1] + share * turn)


@dataclass(frozen=True, slots=True)
class TiltMount:
    """Where a mount is, and where the laser is on it.

    base_from_axle: its pose, x forward.  axle: what it turns about at its own origin: "pitch" nods (a positive angle
    looks down), "roll" turns about the direction it looks in, "yaw" about the vertical.  axle_from_laser: of the laser,
    at angle 0: how long its arm is, and how it is turned (a laser on its side has a roll of 90 degrees).
    """

    base_from_axle: Pose3 = _HERE
    axle: Axle = "pitch"
    axle_from_laser: Pose3 = _HERE

    def __post_init__(self) -> None:
        if self.axle not in ("pitch", "roll", "yaw"):
            raise ValueError(f"axle is pitch, roll or yaw, not {self.axle!r}")

    def rays(self, bearing_rad: ArrayLike, angle_rad: ArrayLike) -> tuple[F64, F64]:
        """Origins and unit directions (N, 3) of beams in the base frame: bearings (N,), each at its own angle (N,)."""
        bearing, angle = np.asarray(bearing_rad, dtype=np.float64), np.asarray(angle_rad, dtype=np.float64)
        own = np.stack((np.cos(bearing), np.sin(bearing), np.zeros(bearing.shape)), axis=-1)
        level = own @ self.axle_from_laser.rotation().T
        arm = np.broadcast_to((self.axle_from_laser.x_m, self.axle_from_laser.y_m, self.axle_from_laser.z_m), own.shape)
        base = self.base_from_axle
        direction = _turned(level, self.axle, angle) @ base.rotation().T
        return base.apply(_turned(arm, self.axle, angle)), direction


@dataclass(frozen=True, slots=True)
class SweepPoints:
    """Points of one sweep of the laser.

    points_m: (M, 3) of the beams that met something, in the base frame at stamp_ns.  origin_m: (M, 3) where each beam
    started.  stamp_ns: the middle beam.  first_rad, last_rad: the mount's angle at the first and the last beam.
    """

    points_m: F64
    origin_m: F64
    stamp_ns: int
    first_rad: float
    last_rad: float


def points_of_sweep(
    scan: Scan, angles: AngleBuffer, mount: TiltMount, odom_from_base: PoseBuffer | None = None
) -> SweepPoints:
    """The points that a sweep of a tilting laser met, each beam at the mount's angle and the vehicle's pose of its own
    moment, in the base frame at the time of the middle beam.

    odom_from_base: the vehicle's motion; None: it stands.  Raises NotYetError while angles or poses have not reached
    the last beam, GoneError where they do not reach back or have a gap: nothing is extrapolated.
    Source: S11.
    """
    stamps = beam_stamps(scan)
    middle_ns = int(stamps[len(stamps) // 2]) if len(stamps) else scan.stamp_ns
    angle = angles.at(stamps)
    poses = odom_from_base.at_many(stamps) if odom_from_base is not None and len(stamps) else None
    hit = np.isfinite(scan.range_m)
    origin, direction = mount.rays(scan.bearing_rad[hit], angle[hit])
    points = origin + scan.range_m[hit, None] * direction
    if poses is not None and odom_from_base is not None:
        reference = odom_from_base.at(middle_ns)
        points, origin = _moved(points, poses[hit], reference), _moved(origin, poses[hit], reference)
    first, last = (float(angle[0]), float(angle[-1])) if len(angle) else (0.0, 0.0)
    return SweepPoints(points, origin, middle_ns, first, last)


class SweepGatherer:
    """Gathers sweeps of a laser into clouds: one for each nod from turning point to turning point, or each full turn.

    Points are kept in the odom frame and given in the base frame of the last of them.
    """

    def __init__(self, *, turning: bool, most_points: int = 400_000, least_swing_rad: float = 0.1) -> None:
        """turning: a cloud is a full turn; else it ends where the angle turns back by least_swing_rad / 4.

        A cloud that most_points are not enough for ends early.
        """
        self._turning, self._most, self._least = turning, most_points, least_swing_rad
        self._start()

    def _start(self) -> None:
        self._parts: list[tuple[F64, Pose2]] = []
        self._count = 0
        self._from: float | None = None
        self._low, self._high = np.inf, -np.inf

    def add(self, sweep: SweepPoints, odom_from_base: Pose2) -> F64 | None:
        """One more sweep, and where the base was at its stamp; if it ends a cloud: that (M, 3), in that base frame."""
        self._parts.append((sweep.points_m, odom_from_base))
        self._count += len(sweep.points_m)
        if self._from is None:
            self._from = sweep.first_rad
        self._low = min(self._low, sweep.first_rad, sweep.last_rad)
        self._high = max(self._high, sweep.first_rad, sweep.last_rad)
        if not self._is_whole(sweep.last_rad) and self._count < self._most:
            return None
        base_from_odom = Pose3.from_plane(odom_from_base).inverse()
        cloud = [base_from_odom.apply(Pose3.from_plane(pose).apply(points)) for points, pose in self._parts]
        self._start()
        return np.concatenate(cloud)

    def _is_whole(self, angle_rad: float) -> bool:
        if self._turning:
            return self._from is not None and abs(angle_rad - self._from) >= 2.0 * np.pi
        back = self._least / 4.0
        away = min(self._high - angle_rad, angle_rad - self._low) >= back  # from both ends: it has turned
        return away and self._high - self._low >= self._least


def _moved(points: F64, odom_from_base: F64, reference: Pose2) -> F64:
    """Points (M, 3) of base frames (M, 3: x, y, yaw), in that of reference."""
    c, s = np.cos(odom_from_base[:, 2]), np.sin(odom_from_base[:, 2])
    x = odom_from_base[:, 0] + c * points[:, 0] - s * points[:, 1]
    y = odom_from_base[:, 1] + s * points[:, 0] + c * points[:, 1]
    moved = reference.inverse().apply(np.stack((x, y), axis=-1))
    return np.column_stack((moved, points[:, 2]))


def _turned(vector: F64, axle: Axle, angle_rad: F64) -> F64:
    """Vectors (N, 3) turned by angles (N,) about the forward axis (roll), the left one (pitch), the vertical (yaw)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y, z = vector[:, 0], vector[:, 1], vector[:, 2]
    if axle == "roll":
        return np.stack((x, c * y - s * z, s * y + c * z), axis=-1)
    if axle == "pitch":
        return np.stack((c * x + s * z, y, c * z - s * x), axis=-1)
    return np.stack((c * x - s * y, s * x + c * y, z), axis=-1)
