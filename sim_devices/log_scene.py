"""A recorded log as the truth that emulated devices measure: the laser says its scans, the wheels its poses.

A log knows the robot's pose only at its scans, and an emulated laser turns at its own pace. So that every scan meets
exactly its own pose, the robot is played stop and go: it stands at the pose of a scan while whole sweeps are
reported, then hurries to the next pose. Sweeps that do not lie wholly within a stand say "nothing known", never a
mixture of two scans. Ranges are the log's, beam by beam; no echo is +inf.

The log's own times are kept as long as they leave room for stand and way; where scans come faster, or the play is
faster than real time, the play takes the time it needs and catches up later. Devices always run at their own pace.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.logs import Log, LogError, LogScan, PlanarPose, PoseKind
from drivers.logs.log import relative
from sim_devices.device import Mount
from sim_devices.laser_hokuyo import URG_04LX, USB_RATE_BPS, LaserProfile
from sim_devices.robot import Piece, Trajectory, WheelErrors, Wheels, twist

F64 = NDArray[np.float64]

HURRY_M_S = 3.0  # of a wheel, on the way from scan to scan
WIDEST_MARGIN_S = 0.08
TOLERANCE_M = {PoseKind.CORRECTED: 0.001, PoseKind.ODOMETRY: 0.005}
LARGEST_STEP_ERROR_RAD = 1e-4


@dataclass(frozen=True, slots=True)
class Pace:
    """How quickly a log may be played.

    sweep_s: turn of the emulated laser.  sample_s: time between two questions to the wheels.  speed: times real time.
    """

    sweep_s: float = 0.025
    sample_s: float = 0.010
    speed: float = 1.0

    @property
    def margin_s(self) -> float:
        """Between a stand's ends and the sweeps in it: wheels asked on both sides of a sweep are then at rest.

        Faster than real time there is no other slack: some questions may be late or lost on a busy machine.
        """
        return (4.0 if self.speed > 1.0 else 1.5) * self.sample_s

    @property
    def rest_s(self) -> float:
        """Pause between turning and driving, so that no two samples in a row have both between them."""
        return 4.0 * self.sample_s

    @property
    def shortest_stand_s(self) -> float:
        """Time in which at least one whole sweep fits, wherever it begins."""
        return 2.0 * self.sweep_s + 2.0 * self.margin_s


class LogScene:
    """See the module's text; a `device.Scene`. The play begins with `begin_motion`; until then scan 0 is seen.

    Sonars hear nothing: a log of a laser knows nothing about them (NaN).
    """

    def __init__(self, log: Log, *, pace: Pace | None = None, track_width_m: float = 0.5, origin_ns: int = 0) -> None:
        if not log.scans:
            raise LogError(f"{log.provenance.path}: no scan to play")
        self.log = log
        self.pace = pace or Pace()
        self.motion_ns: int | None = None
        self.origin_ns = origin_ns
        self.mount = laser_mount(log)
        builder = _Timetable(log, self.pace, track_width_m)
        self.motion = builder.trajectory()
        self.stands_s = builder.stands()  # (M, 2) begin and end of each scan's stand
        margin = np.clip((self.stands_s[:, 1] - self.stands_s[:, 0] - 2.0 * self.pace.sweep_s) / 4.0, 0.0, None)
        margin = np.clip(margin, self.pace.margin_s, max(WIDEST_MARGIN_S, self.pace.margin_s))
        self._valid_s = self.stands_s + np.stack((margin, -margin), axis=-1)
        self._valid_s[0, 0] = -np.inf
        self._valid_s[-1, 1] = np.inf
        self._wheels = Wheels(self.motion, track_width_m=track_width_m, errors=WheelErrors())

    @property
    def duration_s(self) -> float:
        """How long the play takes."""
        return float(self.stands_s[-1, 1])

    def begin_motion(self, now_ns: int) -> None:
        """Play from now on; a second call changes nothing."""
        if self.motion_ns is None:
            self.motion_ns = now_ns

    def has_ended(self, now_ns: int) -> bool:
        """Whether the last scan was played."""
        return self.motion_ns is not None and float(self._since_s(now_ns)) >= self.duration_s

    def pose_at(self, stamp_ns: ArrayLike) -> F64:
        """Poses (N, 3) of the robot by the log at times (N,); yaw not wrapped."""
        return self.motion.pose_at(self._since_s(stamp_ns))

    def scan_at(self, stamp_ns: ArrayLike) -> LogScan | None:
        """The scan that is seen at all these times, or None if they are not within one stand."""
        since = self._since_s(stamp_ns)
        k = int(np.searchsorted(self.stands_s[:, 0], since.max(), side="right")) - 1
        k = max(0, k)
        first, last = self._valid_s[k]
        return self.log.scans[k] if first <= since.min() and since.max() <= last else None

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        """See `device.Scene`; the log's readings for the beams that it has, NaN for others and while under way."""
        bearing = mount.turned(np.asarray(bearing_rad, dtype=np.float64)) - self.log.robot_from_laser[2]
        scan = self.scan_at(np.broadcast_to(np.asarray(stamp_ns, dtype=np.float64), bearing.shape))
        if scan is None or not len(bearing):
            return np.full(len(bearing), np.nan)
        step = _step_of(scan)
        position = (bearing - scan.bearing_rad[0]) / step
        index = np.rint(position).astype(np.int64)
        there = (index >= 0) & (index < len(scan.range_m)) & (np.abs(position - index) < 0.25)
        ranges = np.where(there, scan.range_m[np.clip(index, 0, len(scan.range_m) - 1)], np.nan)
        return np.where(ranges > range_max_m, np.inf, ranges)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        """See `device.Scene`: nothing known."""
        return math.nan

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        """See `device.Scene`: what rolls the robot from logged pose to logged pose."""
        left, right = self._wheels.travel_at(np.atleast_1d(self._since_s(now_ns)))[0]
        return float(left), float(right)

    def _since_s(self, stamp_ns: ArrayLike) -> F64:
        stamps = np.asarray(stamp_ns, dtype=np.float64)
        return np.zeros_like(stamps) if self.motion_ns is None else (stamps - self.motion_ns) * 1e-9


def laser_mount(log: Log) -> Mount:
    """Where the log's laser sits, turned by what its first beam is off a whole step, so that beams fall on steps."""
    x, y, yaw = log.robot_from_laser
    return Mount(x, y, 0.25, yaw + _off_step(log))


def _off_step(log: Log) -> float:
    first, step = log.scans[0].bearing_rad[0], _step_of(log.scans[0])
    off = float(first - round(first / step) * step)
    return 0.0 if abs(off) < 1e-6 else off


def _step_of(scan: LogScan) -> float:
    return float(scan.bearing_rad[1] - scan.bearing_rad[0]) if len(scan.bearing_rad) > 1 else math.radians(1.0)


def laser_profile(log: Log, *, sweep_s: float = 0.025) -> LaserProfile:
    """A laser whose steps are the log's beams and whose range covers the log's.

    Raises LogError if the beams are not evenly spaced by a whole part of a turn.
    """
    widest = max(log.scans, key=lambda s: len(s.bearing_rad))
    step = _step_of(widest)
    steps_per_turn = round(2.0 * math.pi / step)
    drift = np.abs(widest.bearing_rad - widest.bearing_rad[0] - step * np.arange(len(widest.bearing_rad)))
    error = abs(2.0 * math.pi / steps_per_turn - step) * len(widest.bearing_rad) if steps_per_turn > 0 else math.inf
    if step <= 0.0 or error > LARGEST_STEP_ERROR_RAD or drift.max() > LARGEST_STEP_ERROR_RAD:
        raise LogError(f"{log.provenance.path}: beams {math.degrees(step):.4f} degrees apart fit no laser's steps")
    front = steps_per_turn // 2
    first = front + round((widest.bearing_rad[0] - _off_step(log)) / step)
    last = first + len(widest.bearing_rad) - 1
    return replace(
        URG_04LX,
        model="URG-LOG",  # its family tells hosts what codes below the least distance mean
        vendor="umfeld",
        product="SOKUIKI Sensor URG-LOG, a recorded log",
        firmware="1.0.0",
        serial="L" + log.provenance.sha256[:7],
        dmin_mm=20,
        dmax_mm=math.ceil(log.range_max_m * 1000.0),
        steps_per_turn=steps_per_turn,
        first_step=first,
        last_step=last,
        front_step=front,
        last_accepted_step=last,
        rpm=round(60.0 / sweep_s),
        link="usb",
        wire_rate_bps=USB_RATE_BPS,
        noise_floor_m=0.0,
        noise_per_range=0.0,
        has_motor_speed=False,
        speaks_scip1=False,
    )


class _Timetable:
    """Stands and ways of the play: pieces of motion, and when each scan's stand begins and ends."""

    def __init__(self, log: Log, pace: Pace, track_width_m: float) -> None:
        self._pace = pace
        self._half_track_m = 0.5 * track_width_m
        self._tolerance_m = TOLERANCE_M[log.poses]
        self._start = log.scans[0].robot_pose
        self._pieces: list[Piece] = []
        self._stands: list[tuple[float, float]] = []
        self._now_s = 0.0
        self._here: PlanarPose = self._start
        first_s = log.scans[0].stamp_s
        for k, scan in enumerate(log.scans):
            ways = self._ways_to(scan.robot_pose) if k else []
            wanted_s = (scan.stamp_s - first_s) / pace.speed - 0.5 * pace.shortest_stand_s
            way_s = sum(p.duration_s for p in ways)
            if self._stands:
                leave_s = max(self._stands[-1][0] + pace.shortest_stand_s, wanted_s - way_s)
                self._pieces.append(Piece(leave_s - self._now_s))
                self._stands[-1] = (self._stands[-1][0], leave_s)
                self._pieces += ways
                self._now_s = leave_s + way_s
            self._stands.append((self._now_s, self._now_s))
        self._stands[-1] = (self._now_s, self._now_s + pace.shortest_stand_s)
        self._pieces.append(Piece(pace.shortest_stand_s))

    def trajectory(self) -> Trajectory:
        return Trajectory(self._start, self._pieces)

    def stands(self) -> F64:
        return np.array(self._stands)

    def _ways_to(self, target: PlanarPose) -> list[Piece]:
        """From where the robot stands to a pose: one arc if that misses by little, else turn, drive, turn.

        What an arc misses is made up for on the next way: targets are absolute.
        """
        ahead, aside, turn = (float(v) for v in relative(self._here, target)[0])
        off_arc = aside * math.cos(0.5 * turn) - ahead * math.sin(0.5 * turn)
        if abs(off_arc) <= self._tolerance_m:
            chord = ahead * math.cos(0.5 * turn) + aside * math.sin(0.5 * turn)
            pieces = self._arc(chord, turn)
        else:
            bearing = math.atan2(aside, ahead)
            backwards = abs(bearing) > 0.5 * math.pi
            first = _wrapped(bearing + math.pi) if backwards else bearing
            way = -math.hypot(ahead, aside) if backwards else math.hypot(ahead, aside)
            rest = [Piece(self._pace.rest_s)]
            pieces = self._arc(0.0, first) + rest + self._arc(way, 0.0) + rest
            pieces += self._arc(0.0, _wrapped(turn - first))
        self._here = _after(self._here, pieces)
        return pieces

    def _arc(self, chord_m: float, turn_rad: float) -> list[Piece]:
        """One arc with this chord and turn, at the speed that the faster wheel allows."""
        way = chord_m / float(np.sinc(turn_rad / (2.0 * math.pi)))
        wheel = abs(way) + self._half_track_m * abs(turn_rad)
        if wheel < 1e-9:
            return []
        duration = wheel / HURRY_M_S
        return [twist(way / duration if abs(way) > 1e-12 else 0.0, turn_rad / duration, duration)]


def _after(pose: PlanarPose, pieces: list[Piece]) -> PlanarPose:
    x, y, yaw = pose
    for piece in pieces:
        way = piece.speed_m_s * piece.duration_s
        turn = piece.curvature * way + piece.turn_rad_s * piece.duration_s
        chord = way * float(np.sinc(turn / (2.0 * math.pi)))
        x += chord * math.cos(yaw + 0.5 * turn)
        y += chord * math.sin(yaw + 0.5 * turn)
        yaw += turn
    return (x, y, yaw)


def _wrapped(angle_rad: float) -> float:
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi
