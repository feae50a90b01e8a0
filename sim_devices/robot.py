"""The robot in the simulated world: where it truly is at any moment, and what its wheels say about that.

A motion is a row of pieces, each an arc of constant curvature driven with constant acceleration, or a turn on the spot.
Pose and way of any moment, past or future, follow in closed form, so devices may ask in any order. Wheels roll what
the motion makes them roll, times a systematic error (a radius that is not as told), plus random slip that grows with
the root of the way: odometry drifts, mildly and always in the same manner for the same seed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_devices.device import Mount
from sim_devices.floor_plan import Point, Route, WorldError
from sim_devices.wheel import Side
from sim_devices.world import World

F64 = NDArray[np.float64]

SHARPEST_ROUNDED_RAD = math.radians(100.0)
SMALLEST_RADIUS_M = 0.15
SIDEWAYS_ACCELERATION_M_S2 = 0.8
SLIP_STEP_S = 0.05
SLIPS_A_BLOCK = 1200
COMMAND_HOLDS_S = 0.5
UNTIL_TOLD_S = 1e6  # a motor turns until it is told otherwise


@dataclass(frozen=True, slots=True)
class Piece:
    """Part of a motion: speed_m_s + acceleration * t along an arc, and turn_rad_s + turn_acceleration * t besides.

    Either the arc or the turn on the spot is zero, or the arc is a point: then the place is exact.
    """

    duration_s: float
    speed_m_s: float = 0.0
    acceleration_m_s2: float = 0.0
    curvature: float = 0.0
    turn_rad_s: float = 0.0
    turn_acceleration_rad_s2: float = 0.0


def twist(forward_m_s: float, turn_rad_s: float, duration_s: float) -> Piece:
    """A piece of constant velocities."""
    if forward_m_s == 0.0:
        return Piece(duration_s, turn_rad_s=turn_rad_s)
    return Piece(duration_s, speed_m_s=forward_m_s, curvature=turn_rad_s / forward_m_s)


class Motion(Protocol):
    """Where a robot is and how far it went, at any time since it started; before that it stands at its start."""

    def pose_at(self, time_s: F64) -> F64:
        """(N, 3) x, y, yaw (not wrapped) at times (N,)."""

    def way_at(self, time_s: F64) -> tuple[F64, F64]:
        """Way driven (N,), forward positive, and angle turned (N,), since the start."""


class Trajectory:
    """A motion known from end to end; repeated for ever if it is closed, else the robot stands at its end."""

    def __init__(self, start: tuple[float, float, float], pieces: Sequence[Piece], *, closed: bool = False) -> None:
        pieces = [p for p in pieces if p.duration_s > 0.0] or [Piece(1.0)]
        self._table = np.array(
            [(p.speed_m_s, p.acceleration_m_s2, p.curvature, p.turn_rad_s, p.turn_acceleration_rad_s2) for p in pieces]
        )
        self._begin = np.concatenate(([0.0], np.cumsum([p.duration_s for p in pieces])))
        self.lap_s = float(self._begin[-1])
        self.closed = closed
        self._pose = np.zeros((len(pieces) + 1, 3))
        self._way = np.zeros(len(pieces) + 1)
        self._chain(np.array(start, dtype=np.float64))

    def _chain(self, start: F64) -> None:
        """Pose and way at the begin of every piece: ways and turns add up, then chords along the headings."""
        moved, turned, _, _ = _moved(self._table, np.diff(self._begin), np.zeros((len(self._table), 3)))
        yaw = start[2] + np.concatenate(([0.0], np.cumsum(turned)))
        chord = moved * np.sinc(turned / (2.0 * np.pi))
        heading = yaw[:-1] + 0.5 * turned
        self._way[1:] = np.cumsum(moved)
        self._pose[:, 0] = start[0] + np.concatenate(([0.0], np.cumsum(chord * np.cos(heading))))
        self._pose[:, 1] = start[1] + np.concatenate(([0.0], np.cumsum(chord * np.sin(heading))))
        self._pose[:, 2] = yaw

    def pose_at(self, time_s: F64) -> F64:
        """See Motion."""
        lap, k, since = self._locate(time_s)
        _, turned, x, y = _moved(self._table[k], since, self._pose[k])
        return np.stack((x, y, self._pose[k, 2] + turned + lap * self._lap_turn), axis=-1)

    def way_at(self, time_s: F64) -> tuple[F64, F64]:
        """See Motion."""
        lap, k, since = self._locate(time_s)
        moved, turned, _, _ = _moved(self._table[k], since, self._pose[k])
        angle = self._pose[k, 2] - self._pose[0, 2] + turned + lap * self._lap_turn
        return self._way[k] + moved + lap * self._way[-1], angle

    @property
    def length_m(self) -> float:
        """Way of one lap."""
        return float(self._way[-1])

    @property
    def _lap_turn(self) -> float:
        return float(self._pose[-1, 2] - self._pose[0, 2])

    def _locate(self, time_s: F64) -> tuple[F64, NDArray[np.intp], F64]:
        """Lap (N,), piece (N,) and time since that piece's begin (N,)."""
        t = np.maximum(0.0, np.asarray(time_s, dtype=np.float64))
        lap = np.floor(t / self.lap_s) if self.closed else np.zeros_like(t)
        t = np.minimum(t - lap * self.lap_s, self.lap_s)
        k = np.clip(np.searchsorted(self._begin, t, side="right") - 1, 0, len(self._table) - 1)
        return lap, k, t - self._begin[k]


def _moved(table: F64, since_s: F64, pose: F64) -> tuple[F64, F64, F64, F64]:
    """Way, angle, and place after a time in pieces: table (N, 5), since_s (N,), pose at their begin (N, 3)."""
    speed, acceleration, curvature, turn, turn_acceleration = table.T
    moved = (speed + 0.5 * acceleration * since_s) * since_s
    turned = curvature * moved + (turn + 0.5 * turn_acceleration * since_s) * since_s
    chord = moved * np.sinc(turned / (2.0 * np.pi))  # of an arc: sin(a / 2) / (a / 2)
    heading = pose[:, 2] + 0.5 * turned
    return moved, turned, pose[:, 0] + chord * np.cos(heading), pose[:, 1] + chord * np.sin(heading)


@dataclass(slots=True)
class CommandedMotion:
    """A motion that drive commands make while it lasts: each holds until the next, or until its own time is over.

    Commands come in order of time; what lies before the newest is fixed.
    """

    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _commands: list[tuple[float, float, float, float]] = field(default_factory=list)
    _built: Trajectory | None = None

    def command(self, time_s: float, forward_m_s: float, turn_rad_s: float, *, hold_s: float = COMMAND_HOLDS_S) -> None:
        """Drive so from this time on. Raises ValueError if it is before the command before."""
        if self._commands and time_s < self._commands[-1][0]:
            raise ValueError("drive commands must come in order of time")
        self._commands.append((max(0.0, time_s), forward_m_s, turn_rad_s, hold_s))
        self._built = None

    def pose_at(self, time_s: F64) -> F64:
        """See Motion."""
        return self._trajectory().pose_at(time_s)

    def way_at(self, time_s: F64) -> tuple[F64, F64]:
        """See Motion."""
        return self._trajectory().way_at(time_s)

    def _trajectory(self) -> Trajectory:
        if self._built is None:
            pieces, now = [], 0.0
            ends = [c[0] for c in self._commands[1:]] + [math.inf]
            for (begin, forward, turn, hold), end in zip(self._commands, ends):
                held = min(end - begin, hold)
                pieces += [Piece(begin - now), twist(forward, turn, held)]
                now = begin + held
            self._built = Trajectory(self.start, pieces)
        return self._built


# --- along a route --------------------------------------------------------------------------------------------------


def follow(route: Route) -> Trajectory:
    """The motion of a robot along a route: corners rounded as far as the legs allow, sharp ones turned on the spot.

    Speed rises and falls at the route's acceleration and keeps to its limits on straights, in curves and in turns.
    A closed route ends with a turn into the heading of its begin. Raises WorldError if two points are one.
    """
    points = [*route.points, route.points[0]] if route.closed else list(route.points)
    legs = np.diff(np.array(points), axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    if np.any(lengths < 1e-6):
        raise WorldError("route.points: two points in a row are the same")
    headings = np.arctan2(legs[:, 1], legs[:, 0])
    turns = [_wrapped(b - a) for a, b in itertools.pairwise(headings)]
    pieces: list[Piece] = [Piece(route.pause_s)]
    run: list[tuple[float, float]] = []  # lengths and curvatures since the last stand
    used = 0.0
    for k, turn in enumerate(turns):
        rounding = _rounding(route, turn, float(lengths[k]), float(lengths[k + 1]))
        if rounding is None:
            run.append((lengths[k] - used, 0.0))
            pieces += _drive(run, route) + _turn_on_spot(turn, route)
            run, used = [], 0.0
        else:
            radius, tangent = rounding
            run.append((lengths[k] - used - tangent, 0.0))
            if turn:
                run.append((radius * abs(turn), math.copysign(1.0 / radius, turn)))
            used = tangent
    run.append((lengths[-1] - used, 0.0))
    pieces += _drive(run, route)
    if route.closed:
        pieces += _turn_on_spot(_wrapped(headings[0] - headings[-1]), route)
    start = (points[0][0], points[0][1], float(headings[0]))
    return Trajectory(start, pieces, closed=route.closed)


def _wrapped(angle_rad: float) -> float:
    return float((angle_rad + math.pi) % (2.0 * math.pi) - math.pi)


def _rounding(route: Route, turn_rad: float, before_m: float, after_m: float) -> tuple[float, float] | None:
    """Radius of a corner and the way that it takes off both legs; None if the robot must stop and turn."""
    if abs(turn_rad) < 1e-9:
        return (1.0, 0.0)
    if abs(turn_rad) > SHARPEST_ROUNDED_RAD:
        return None
    half_tangent = math.tan(abs(turn_rad) / 2.0)
    tangent = min(route.corner_radius_m * half_tangent, 0.48 * min(before_m, after_m))
    radius = tangent / half_tangent
    return (radius, tangent) if radius >= SMALLEST_RADIUS_M else None


def _drive(run: Sequence[tuple[float, float]], route: Route) -> list[Piece]:
    """Pieces from stand to stand along straights and arcs given by length and curvature."""
    run = [(length, curvature) for length, curvature in run if length > 1e-9]
    limits = [_speed_limit(curvature, route) for _, curvature in run]
    gain = 2.0 * route.acceleration_m_s2
    speed = [0.0] + [min(a, b) for a, b in itertools.pairwise(limits)] + [0.0]  # at the joints
    for k, (length, _) in enumerate(run):
        speed[k + 1] = min(speed[k + 1], math.sqrt(speed[k] ** 2 + gain * length))
    for k in range(len(run) - 1, -1, -1):
        speed[k] = min(speed[k], math.sqrt(speed[k + 1] ** 2 + gain * run[k][0]))
    pieces: list[Piece] = []
    for k, (length, curvature) in enumerate(run):
        pieces += _ramp(length, curvature, speed[k], speed[k + 1], limits[k], route.acceleration_m_s2)
    return pieces


def _speed_limit(curvature: float, route: Route) -> float:
    if curvature == 0.0:
        return route.speed_m_s
    radius = 1.0 / abs(curvature)
    return min(route.speed_m_s, route.turn_rad_s * radius, math.sqrt(SIDEWAYS_ACCELERATION_M_S2 * radius))


def _ramp(length: float, curvature: float, v_in: float, v_out: float, limit: float, acceleration: float) -> list[Piece]:
    """Speed up, keep, slow down, within one straight or arc."""
    peak = min(limit, math.sqrt(acceleration * length + 0.5 * (v_in**2 + v_out**2)))
    peak = max(peak, v_in, v_out)
    up, down = (peak**2 - v_in**2) / (2.0 * acceleration), (peak**2 - v_out**2) / (2.0 * acceleration)
    keep = max(0.0, length - up - down)
    return [
        Piece((peak - v_in) / acceleration, v_in, acceleration, curvature),
        Piece(keep / peak, peak, 0.0, curvature),
        Piece((peak - v_out) / acceleration, peak, -acceleration, curvature),
    ]


def _turn_on_spot(angle_rad: float, route: Route) -> list[Piece]:
    if abs(angle_rad) < 1e-9:
        return []
    acceleration = route.turn_acceleration_rad_s2
    peak = min(route.turn_rad_s, math.sqrt(acceleration * abs(angle_rad)))
    ramp_s = peak / acceleration
    keep_s = (abs(angle_rad) - peak * ramp_s) / peak
    sign = math.copysign(1.0, angle_rad)
    return [
        Piece(ramp_s, turn_acceleration_rad_s2=sign * acceleration),
        Piece(keep_s, turn_rad_s=sign * peak),
        Piece(ramp_s, turn_rad_s=sign * peak, turn_acceleration_rad_s2=-sign * acceleration),
    ]


# --- what the wheels say ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class WheelErrors:
    """How wheels differ from what the motion makes them roll.

    left_scale, right_scale: systematic, 0.01 rolls 1 % farther than told.  slip_m_per_sqrt_m: standard deviation of
    a wheel's random slip after one metre, growing with the root of the way.
    """

    left_scale: float = 0.0
    right_scale: float = 0.0
    slip_m_per_sqrt_m: float = 0.0
    seed: int = 0


class Wheels:
    """Ways rolled by the left and the right wheel of a differential drive on its motion."""

    def __init__(self, motion: Motion, *, track_width_m: float, errors: WheelErrors) -> None:
        self._motion = motion
        self._half_track_m = 0.5 * track_width_m
        self._errors = errors
        self._slips: list[F64] = [np.zeros((1, 2))]  # from 1: for each block of steps the sums at its borders

    def travel_at(self, time_s: F64) -> F64:
        """(N, 2) left and right, forward positive, since the start, slip included."""
        travel = self._rolled(np.asarray(time_s, dtype=np.float64))
        travel = travel * (1.0 + np.array([self._errors.left_scale, self._errors.right_scale]))
        if self._errors.slip_m_per_sqrt_m:
            travel = travel + self._slip(np.asarray(time_s, dtype=np.float64))
        return travel

    def _rolled(self, time_s: F64) -> F64:
        way, angle = self._motion.way_at(time_s)
        return np.stack((way - self._half_track_m * angle, way + self._half_track_m * angle), axis=-1)

    def _slip(self, time_s: F64) -> F64:
        """Sums of random steps, one a SLIP_STEP_S, each as large as the root of what was rolled in it."""
        steps = np.maximum(0.0, time_s) / SLIP_STEP_S
        index = np.floor(steps).astype(np.int64)
        return np.stack([self._slip_at(int(i), float(s - i)) for i, s in zip(index, steps)])

    def _slip_at(self, index: int, part: float) -> F64:
        block, offset = divmod(index, SLIPS_A_BLOCK)
        while len(self._slips) <= block + 1:
            self._slips.append(self._next_block())
        sums = self._slips[block + 1]
        return np.asarray(sums[offset] + part * (sums[offset + 1] - sums[offset]))

    def _next_block(self) -> F64:
        """(SLIPS_A_BLOCK + 1, 2) sums of slip at the step borders of the next block."""
        block = len(self._slips) - 1
        first = block * SLIPS_A_BLOCK
        borders = (first + np.arange(SLIPS_A_BLOCK + 1, dtype=np.float64)) * SLIP_STEP_S
        rolled = np.abs(np.diff(self._rolled(borders), axis=0))
        random = np.random.default_rng((self._errors.seed, block))
        steps = self._errors.slip_m_per_sqrt_m * np.sqrt(rolled) * random.standard_normal(rolled.shape)
        return np.asarray(self._slips[-1][-1] + np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0))))


# --- the scene -------------------------------------------------------------------------------------------------------


class SimScene:
    """The truth that emulated devices measure: a robot on its motion through a world (a `device.Scene`).

    origin_ns: the moment at which the world's time is 0.  People walk from then on; the robot drives once
    `begin_motion` was called (at once if begin_at_origin).  speed: seconds of the world's time for each of the devices'
    time: robot and people hurry, the devices keep their pace.
    """

    def __init__(
        self,
        world: World,
        motion: Motion,
        *,
        track_width_m: float = 0.5,
        errors: WheelErrors | None = None,
        origin_ns: int = 0,
        begin_at_origin: bool = True,
        speed: float = 1.0,
    ) -> None:
        self.world = world
        self.speed = speed
        self.motion = motion
        self.origin_ns = origin_ns
        self.motion_ns: int | None = origin_ns if begin_at_origin else None
        self._track_width_m = track_width_m
        self._wheel_m_s: dict[Side, float] = {"left": 0.0, "right": 0.0}
        self._wheels = Wheels(motion, track_width_m=track_width_m, errors=errors or WheelErrors())
        self._newest_pose: tuple[int, F64] | None = None
        self._newest_travel: tuple[int, tuple[float, float]] | None = None

    def begin_motion(self, now_ns: int) -> None:
        """Let the robot drive from now on; a second call changes nothing."""
        if self.motion_ns is None:
            self.motion_ns = now_ns
            self._newest_pose = self._newest_travel = None

    def pose_at(self, stamp_ns: ArrayLike) -> F64:
        """True poses (N, 3) of the robot's base in the world at times (N,) in nanoseconds; yaw not wrapped."""
        return self.motion.pose_at(self.motion_s(np.asarray(stamp_ns, dtype=np.float64)))

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        """See `device.Scene`: each beam from where the robot is when it is fired."""
        stamps = np.broadcast_to(np.asarray(stamp_ns, dtype=np.float64), np.shape(bearing_rad))
        pose = self.pose_at(stamps)
        origin = _mounted(pose, mount)
        heading = pose[:, 2] + mount.turned(np.asarray(bearing_rad, dtype=np.float64))
        world_s = (stamps - self.origin_ns) * (1e-9 * self.speed)
        return self.world.beam_distances(origin, heading, world_s, z_m=mount.z_m, range_max_m=range_max_m)

    def is_beam_by_beam(self, first_ns: int, last_ns: int) -> bool:
        """See `ranging.ManyAtOnce`."""
        return True

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        """See `device.Scene`."""
        pose = self._pose_now(now_ns)
        x, y = _mounted(pose, mount)[0]
        here: Point = (float(x), float(y))
        heading = float(pose[0, 2]) + mount.yaw_rad
        world_s = (now_ns - self.origin_ns) * (1e-9 * self.speed)
        return self.world.cone_distance(here, heading, half_angle_rad, world_s, z_m=mount.z_m, range_max_m=range_max_m)

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        """See `device.Scene`."""
        if self._newest_travel is None or self._newest_travel[0] != now_ns:  # both encoders ask at the same SYNC
            left, right = self._wheels.travel_at(self.motion_s(np.array([float(now_ns)])))[0]
            self._newest_travel = (now_ns, (float(left), float(right)))
        return self._newest_travel[1]

    def ray_ranges(self, origin_m: F64, direction: F64, stamp_ns: F64, range_max_m: float) -> F64:
        """See `mount_nodding.SolidScene`: each beam from where the robot is when it is fired."""
        stamps = np.broadcast_to(np.asarray(stamp_ns, dtype=np.float64), (len(direction),))
        pose = self.pose_at(stamps)
        world_s = (stamps - self.origin_ns) * (1e-9 * self.speed)
        origin = np.column_stack((_turned(origin_m, pose[:, 2])[:, :2] + pose[:, :2], origin_m[:, 2]))
        return self.world.ray_distances(origin, _turned(direction, pose[:, 2]), world_s, range_max_m=range_max_m)

    def floor_m(self, mount: Mount, now_ns: int) -> float:
        """See `contact.GroundScene`."""
        x, y = _mounted(self._pose_now(now_ns), mount)[0]
        return self.world.floor_m((float(x), float(y)))

    def drive_wheel(self, now_ns: int, side: Side, speed_m_s: float) -> None:
        """See `wheel.DrivenScene`: motors drive a robot that is driven by commands; one on a route goes its way."""
        self._wheel_m_s[side] = speed_m_s
        if isinstance(self.motion, CommandedMotion):
            self.begin_motion(now_ns)
            left, right = self._wheel_m_s["left"], self._wheel_m_s["right"]
            when_s = float(self.motion_s(np.array([float(now_ns)]))[0])
            turn = (right - left) / self._track_width_m
            self.motion.command(when_s, 0.5 * (left + right), turn, hold_s=UNTIL_TOLD_S)
            self._newest_pose = self._newest_travel = None

    def _pose_now(self, now_ns: int) -> F64:
        """(1, 3); transducers that fire together share it."""
        if self._newest_pose is None or self._newest_pose[0] != now_ns:
            self._newest_pose = (now_ns, self.pose_at([now_ns]))
        return self._newest_pose[1]

    def motion_s(self, stamp_ns: F64) -> F64:
        """Time on the motion (N,) at moments (N,)."""
        if self.motion_ns is None:
            return np.zeros_like(stamp_ns)
        return (stamp_ns - self.motion_ns) * (1e-9 * self.speed)


def _turned(vector: F64, yaw_rad: F64) -> F64:
    """(N, 3) vectors turned about the vertical."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y, z = vector.T
    return np.stack((c * x - s * y, s * x + c * y, z), axis=-1)


def _mounted(pose: F64, mount: Mount) -> F64:
    """(N, 2) places in the world of something mounted on the robot at poses (N, 3)."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return np.stack((pose[:, 0] + c * mount.x_m - s * mount.y_m, pose[:, 1] + s * mount.x_m + c * mount.y_m), axis=-1)
