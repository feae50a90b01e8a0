"""Lasers that nod or turn, as fusion sees them: sweeps and angles in, clouds of points out (S11).

A sweep waits until angles and odometry reach its last beam, in order of stamps, for a bounded time and in bounded
number. Nothing is extrapolated; what is dropped is counted under the mount's name:
    angle_late, angle_gone    a sweep whose angles did not come in time, or were lost while it was measured
    odometry_late, odometry_gone    the same of the vehicle's poses
    waiting_full    too many wait
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.readings import AngleReading
from mapping.deskew import beam_stamps
from mapping.frames import IDENTITY, Pose2
from mapping.planes.cloud import AngleBuffer, SweepGatherer, TiltMount, points_of_sweep
from mapping.pose_buffer import GoneError, NotYetError, PoseBuffer
from mapping.scan import Scan
from service.outputs import CloudOut

F64 = NDArray[np.float64]

_WAITING_MAX = 64


@dataclass(frozen=True, slots=True)
class MountSettings:
    """name: of the mount, in keys and counters.  laser: the source of its sweeps.  rad_per_tick, zero_rad: angle =
    zero_rad + ticks * rad_per_tick.  turning: it turns on for ever instead of nodding.  wait_ns: longest that a sweep
    waits.  delay_ns: angles were measured so long before they came.
    """

    name: str
    laser: str
    mount: TiltMount
    rad_per_tick: float
    zero_rad: float = 0.0
    turning: bool = False
    delay_ns: int = 0
    wait_ns: int = 500_000_000


class TiltingLaser:
    """One mount and its laser. drops: by reason."""

    def __init__(self, settings: MountSettings) -> None:
        self.settings = settings
        self.drops: Counter[str] = Counter()
        self._angles = AngleBuffer()
        self._waiting: deque[tuple[Scan, int]] = deque()
        self._gatherer = SweepGatherer(turning=settings.turning)

    def take_angle(self, reading: AngleReading) -> None:
        """Where the axle is."""
        if not reading.continuous:
            self._angles.clear()  # from here on it is known again, what lay between is not
        measured_ns = reading.stamp_ns - self.settings.delay_ns
        self._angles.add(measured_ns, self.settings.zero_rad + reading.ticks * self.settings.rad_per_tick)

    def take_scan(self, scan: Scan, now_ns: int) -> None:
        """A sweep of its laser."""
        self._waiting.append((scan, now_ns))
        if len(self._waiting) > _WAITING_MAX:
            self._waiting.popleft()
            self.drops["waiting_full"] += 1

    def lose(self) -> None:
        """The encoder is gone, or starts anew."""
        self._angles.clear()

    def clouds(
        self, poses: PoseBuffer | None, map_from_base_at: Callable[[int], Pose2 | None], now_ns: int
    ) -> list[CloudOut]:
        """Work off the sweeps that are covered by now; the clouds that they complete.

        poses: the vehicle's odometry; None: it stands.  map_from_base_at: its pose in the map at a time.
        """
        made: list[CloudOut] = []
        while self._waiting:
            scan, since_ns = self._waiting[0]
            lacks = self._lacks(scan, poses)
            if lacks.endswith("_late") and now_ns - since_ns <= self.settings.wait_ns:
                break
            self._waiting.popleft()
            if lacks:
                self.drops[lacks] += 1
                continue
            sweep = points_of_sweep(scan, self._angles, self.settings.mount, poses)
            odom_from_base = IDENTITY if poses is None else poses.at(sweep.stamp_ns)
            cloud = self._gatherer.add(sweep, odom_from_base)
            if cloud is not None and len(cloud):
                map_from_base = map_from_base_at(sweep.stamp_ns)
                made.append(
                    CloudOut(
                        self.settings.name, sweep.stamp_ns, cloud.astype(np.float32), map_from_base, self._sensor_m()
                    )
                )
        return made

    def _sensor_m(self) -> tuple[float, float, float]:
        """About where the laser measures from, in the base frame."""
        base = self.settings.mount.base_from_axle
        return (base.x_m, base.y_m, base.z_m)

    def _lacks(self, scan: Scan, poses: PoseBuffer | None) -> str:
        """Why a sweep cannot be placed: a reason of the module's docstring, empty if it can."""
        stamps = beam_stamps(scan)
        known = (
            [("angle", self._angles.at)] if poses is None else [("angle", self._angles.at), ("odometry", poses.at_many)]
        )
        for what, at in known:
            try:
                at(stamps)
            except NotYetError:
                return f"{what}_late"
            except GoneError:
                return f"{what}_gone"
        return ""
