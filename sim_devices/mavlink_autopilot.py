"""An autopilot on MAVLink 2: tells what its vehicle does, and judges the obstacle messages it is sent.

Sources: MAVLink common.xml; ArduPilot AP_Proximity_MAV.cpp, PX4 CollisionPrevention.cpp.

What this emulator does that a naive one would not:
- HEARTBEAT, SYS_STATUS and GPS_RAW_INT (no satellites indoors) once a second; attitude, odometry, wheel distances and
  rangefinders at rates of their own, which SET_MESSAGE_INTERVAL changes (0: as before, -1: off), and on ArduPilot
  REQUEST_DATA_STREAM for whole groups. Nothing is sent before it has started.
- Odometry is dead reckoning of its own wheels, forward-right-down: y and yaw grow to the right.
- A rangefinder that hears nothing says one more than its maximum; one that something is too near for says its minimum
  less one.
- Its clock counts from its start and may drift; TIMESYNC and PING are answered.
- Ground tools find what they ask for first: AUTOPILOT_VERSION when requested, a short list of parameters (ArduPilot
  tells whole numbers as floats of their value, PX4 as floats of their bits), an empty mission.
- OBSTACLE_DISTANCE is taken as the autopilot at hand takes it. ArduPilot: any frame as the body's, values from minimum
  to maximum only, increment_f unless it is nearly 0, at most a full circle. PX4: frames 0, 1 and 12 only, the first two
  turned by the yaw; 65535 leaves a bin as it was, values from the maximum on are clear; increment_f only above 0.
  Either forgets after half a second.
- Obstacle messages are taken from any system; a heartbeat under its own system id is its companion's.
- At another line rate the host reads noise and is not heard. On UDP there is no line rate.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from sim_devices.device import F64, Mount, Scene
from sim_devices.ranging import garbled
from sim_devices.sonar_faults import SonarTroubles
from sim_devices.wheel import Undo
from sim_devices.wire import BITS_PER_BYTE, SECOND_NS, PacedWire

TX_BUFFER = 512  # bytes
BINS = 72
BIN_DEG = 360.0 / BINS
FORGET_NS = SECOND_NS // 2
UNKNOWN_CM = 65535
FRAMES_OF_PX4 = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)
ORIENTATION_DEG = 45.0
NOT_KNOWN = math.nan
MAX_HZ = 1000.0

# Groups of REQUEST_DATA_STREAM; 0 is all of them.
GROUPS: dict[int, tuple[int, ...]] = {
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: (mavlink.MAVLINK_MSG_ID_SYS_STATUS, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT),
    mavlink.MAV_DATA_STREAM_POSITION: (mavlink.MAVLINK_MSG_ID_ODOMETRY,),
    mavlink.MAV_DATA_STREAM_EXTRA1: (mavlink.MAVLINK_MSG_ID_ATTITUDE,),
    mavlink.MAV_DATA_STREAM_EXTRA3: (
        mavlink.MAVLINK_MSG_ID_WHEEL_DISTANCE,
        mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR,
    ),
}

INT32, REAL32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32
Parameter = tuple[str, int, float]  # name, type, value

Kind = Literal["ardupilot", "px4"]
KINDS: tuple[Kind, ...] = ("ardupilot", "px4")


@dataclass(frozen=True, slots=True)
class Rangefinder:
    """A sonar at the autopilot. number: its id."""

    number: int
    mount: Mount
    min_cm: int = 20
    max_cm: int = 400
    half_angle_rad: float = math.radians(15.0)
    kind: int = mavlink.MAV_DISTANCE_SENSOR_ULTRASOUND

    @property
    def orientation(self) -> int:
        """The nearest of 8 directions, clockwise from ahead."""
        return round(-math.degrees(self.mount.yaw_rad) / ORIENTATION_DEG) % 8


@dataclass(slots=True)
class _Stream:
    """One message that is sent again and again."""

    message_id: int
    usual_hz: float
    build: Callable[[int], Sequence[Any]]
    interval_ns: int = 0
    next_ns: int = 0

    def set_rate(self, hz: float, now_ns: int) -> None:
        """0: never."""
        self.interval_ns = round(SECOND_NS / hz) if hz > 0.0 else 0
        self.next_ns = now_ns + self.interval_ns


class MavlinkAutopilot:
    """One autopilot on a serial line or on UDP. See the module's text for its habits.

    kind: whose judgement it has.  system, component: its ids.  line_rate_bps: of its serial line; None on UDP.
    rangefinders: its own, told in DISTANCE_SENSOR.  wheels: places of the left and the right one in WHEEL_DISTANCE.
    track_width_m: between them.  boot_s: from power-on to the first message.  clock_drift_ppm: how much too fast its
    clock runs.  The first step is power-on.

    For tests: `seen(now)` is what it believes of the obstacles, `refused` and `accepted` count their messages,
    `complaint` says what was wrong with the last refused one, `companion_ns` is when a companion's heartbeat came last.
    """

    fault_family = "sonar"

    def __init__(
        self,
        scene: Scene,
        *,
        kind: Kind = "ardupilot",
        system: int = 1,
        component: int = mavlink.MAV_COMP_ID_AUTOPILOT1,
        line_rate_bps: int | None = 57600,
        rangefinders: Sequence[Rangefinder] = (),
        wheels: tuple[int, int] = (0, 1),
        track_width_m: float = 0.5,
        boot_s: float = 0.5,
        clock_drift_ppm: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.kind = kind
        self.system = system
        self.rangefinders = list(rangefinders)
        self.sonar_troubles = SonarTroubles()
        self.fault_families = ("sonar",) if self.rangefinders else ()
        self.clock_drift_ppm = clock_drift_ppm
        self.accepted = self.refused = 0
        self.complaint = ""
        self.companion_ns: int | None = None
        self._scene = scene
        self._wheels = wheels
        self._line_rate_bps = line_rate_bps
        self._track_width_m = track_width_m
        self._boot_ns = round(boot_s * SECOND_NS)
        self._random = np.random.default_rng(seed)
        self._codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._codec.robust_parsing = True
        self._parameters = _usual_parameters(kind, system)
        self._start(0)
        self._powered = False  # until the first step tells the time

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns what it sends. baud: the host's line speed, if known."""
        if not self._powered:
            self.power_on(now_ns)
        if now_ns < self._zero_ns:
            return b""
        fits = baud is None or self._line_rate_bps is None or baud == self._line_rate_bps
        if received and fits:
            for message in self._codec.parse_buffer(received) or ():
                self._hear(message, now_ns)
        self._send_due(now_ns)
        if self._wire is None:
            said, self._out[:] = bytes(self._out), b""
            return said
        out = self._wire.leave_by(now_ns)
        return out if fits else garbled(out, self._random)

    @property
    def next_ns(self) -> int | None:
        """When something is due next."""
        if not self._powered:
            return None
        due = [max(stream.next_ns, self._zero_ns) for stream in self._streams if stream.interval_ns]
        if self._wire is not None and (leaving_ns := self._wire.next_ns) is not None:
            due.append(leaving_ns)
        return min(due, default=None)

    def power_on(self, now_ns: int) -> None:
        """Start as after the supply came back: all rates are the usual ones, nothing is known of obstacles."""
        self._start(now_ns)
        self._powered = True

    def _start(self, now_ns: int) -> None:
        self._zero_ns = now_ns + self._boot_ns
        self._clock_zero_ns, self._clock_offset_us = now_ns, 0
        self._wire = None if self._line_rate_bps is None else PacedWire(self._line_rate_bps, now_ns)
        self._out: bytearray = bytearray()
        self._reckoned = np.zeros(3)  # x, y, yaw in metres and radians, counter-clockwise
        self._speed = (0.0, 0.0)
        self._travel_m: tuple[float, float] | None = None
        self._travel_ns = now_ns
        self._bins = np.full(BINS, NOT_KNOWN)
        self._bin_ns = np.full(BINS, -FORGET_NS, dtype=np.int64)
        self._streams = [
            _Stream(mavlink.MAVLINK_MSG_ID_HEARTBEAT, 1.0, self._heartbeat),
            _Stream(mavlink.MAVLINK_MSG_ID_SYS_STATUS, 1.0, self._sys_status),
            _Stream(mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 1.0, self._gps),
            _Stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 10.0, self._attitude),
            _Stream(mavlink.MAVLINK_MSG_ID_ODOMETRY, 10.0, self._odometry),
            _Stream(mavlink.MAVLINK_MSG_ID_WHEEL_DISTANCE, 10.0, self._wheel_distance),
            _Stream(mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR, 10.0 if self.rangefinders else 0.0, self._distances),
        ]
        for stream in self._streams:
            stream.set_rate(stream.usual_hz, self._zero_ns)
            stream.next_ns = self._zero_ns

    def inflict(self, kind: str, value: float, arguments: Mapping[str, float], now_ns: int) -> Undo | None:
        """See wheel.Faulty. Channels of its rangefinders are their ids plus one."""
        return self.sonar_troubles.inflict(kind, value, arguments)

    def set_clock_drift(self, ppm: float, now_ns: int) -> None:
        """Let the clock run so much too fast from now on; it does not jump."""
        self._clock_offset_us = self.clock_us(now_ns)
        self._clock_zero_ns = now_ns
        self.clock_drift_ppm = ppm

    def clock_us(self, now_ns: int) -> int:
        """The device's own clock: microseconds since it started."""
        elapsed_ns = now_ns - self._clock_zero_ns
        return self._clock_offset_us + round(elapsed_ns * (1.0 + self.clock_drift_ppm * 1e-6)) // 1000

    # -- what it says -------------------------------------------------------------------------------------------------

    def _say(self, message: Any, now_ns: int) -> None:
        data = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        if self._wire is None:
            self._out += data
        else:
            self._wire.send(data, now_ns)

    def _send_due(self, now_ns: int) -> None:
        """All messages whose time has come, in the order of their times; what was slept over is left out."""
        due = sorted((s for s in self._streams if s.interval_ns and s.next_ns <= now_ns), key=lambda s: s.next_ns)
        for stream in due:
            for message in () if self._is_line_full(now_ns) else stream.build(now_ns):
                self._say(message, now_ns)
            missed = (now_ns - stream.next_ns) // stream.interval_ns
            stream.next_ns += (missed + 1) * stream.interval_ns

    def _is_line_full(self, now_ns: int) -> bool:
        """An autopilot sends nothing that its transmit buffer has no room for."""
        if self._wire is None:
            return False
        return self._wire.free_ns - now_ns > TX_BUFFER * BITS_PER_BYTE * SECOND_NS // self._wire.rate_bps

    def _heartbeat(self, now_ns: int) -> list[Any]:
        autopilot = mavlink.MAV_AUTOPILOT_PX4 if self.kind == "px4" else mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
        mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        state = mavlink.MAV_STATE_STANDBY
        return [self._codec.heartbeat_encode(mavlink.MAV_TYPE_GROUND_ROVER, autopilot, mode, 0, state, 3)]

    def _sys_status(self, now_ns: int) -> list[Any]:
        """Its health bit says whether obstacle data arrive."""
        bit = mavlink.MAV_SYS_STATUS_SENSOR_PROXIMITY
        if self.kind == "px4":
            bit = mavlink.MAV_SYS_STATUS_OBSTACLE_AVOIDANCE
        healthy = bit if np.isfinite(self._fresh(now_ns)).any() or self._hears_obstacles(now_ns) else 0
        return [self._codec.sys_status_encode(bit, bit, healthy, 100, 12600, -1, 90, 0, 0, 0, 0, 0, 0)]

    def _gps(self, now_ns: int) -> list[Any]:
        no_fix, unknown = mavlink.GPS_FIX_TYPE_NO_FIX, 65535
        stamp_us = self.clock_us(now_ns)
        return [self._codec.gps_raw_int_encode(stamp_us, no_fix, 0, 0, 0, unknown, unknown, unknown, unknown, 0)]

    def _attitude(self, now_ns: int) -> list[Any]:
        self._reckon(now_ns)
        yaw, turn_rad_s = -float(self._reckoned[2]), -self._speed[1]
        wrapped = math.remainder(yaw, 2.0 * math.pi)
        return [self._codec.attitude_encode(self._boot_ms(now_ns), 0.0, 0.0, wrapped, 0.0, 0.0, turn_rad_s)]

    def _odometry(self, now_ns: int) -> list[Any]:
        self._reckon(now_ns)
        x, y, yaw = (float(v) for v in self._reckoned)
        half = -0.5 * yaw
        unknown = [NOT_KNOWN] + [0.0] * 20
        return [
            self._codec.odometry_encode(
                self.clock_us(now_ns), mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD,
                x, -y, 0.0, [math.cos(half), 0.0, 0.0, math.sin(half)],
                self._speed[0], 0.0, 0.0, 0.0, 0.0, -self._speed[1],
                unknown, unknown, 0, mavlink.MAV_ESTIMATOR_TYPE_NAIVE, 0,
            )
        ]  # fmt: skip

    def _wheel_distance(self, now_ns: int) -> list[Any]:
        ways_m = [0.0] * 16
        for place, way_m in zip(self._wheels, self._scene.wheel_travel_m(now_ns)):
            ways_m[place] = way_m
        return [self._codec.wheel_distance_encode(self.clock_us(now_ns), max(self._wheels) + 1, ways_m)]

    def _distances(self, now_ns: int) -> list[Any]:
        out = []
        places = {sensor.number + 1: sensor for sensor in self.rangefinders}
        for sensor in self.rangefinders:

            def measure(channel: int, sensor: Rangefinder = sensor) -> float:
                there = places.get(channel, sensor)
                return self._scene.cone_range(there.mount, there.half_angle_rad, now_ns, sensor.max_cm * 0.01)

            told_m = self.sonar_troubles.told_m(sensor.number + 1, measure, self._random, sensor.max_cm * 0.01)
            if told_m is None:
                continue
            range_m = told_m
            heard = math.isfinite(range_m) and range_m * 100.0 <= sensor.max_cm
            cm = max(sensor.min_cm - 1, round(range_m * 100.0)) if heard else sensor.max_cm + 1
            cone_rad = 2.0 * sensor.half_angle_rad
            out.append(
                self._codec.distance_sensor_encode(
                    self._boot_ms(now_ns), sensor.min_cm, sensor.max_cm, cm, sensor.kind, sensor.number,
                    sensor.orientation,
                    255, cone_rad, cone_rad, [0.0] * 4, 100 if heard else 0,
                )
            )  # fmt: skip
        return out

    def _version(self) -> Any:
        as_value = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
        as_bits = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        can = mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | (as_bits if self.kind == "px4" else as_value)
        release = 4 << 24 | 5 << 16 | mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL
        if self.kind == "px4":
            release = 1 << 24 | 14 << 16 | mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL
        own = [0] * 8
        return self._codec.autopilot_version_encode(can, release, 0, 0, 0, own, own, own, 0, 0, 0x5EED)

    def _parameter(self, place: int) -> Any:
        name, kind, value = self._parameters[place]
        if kind == INT32 and self.kind == "px4":
            value = struct.unpack("<f", struct.pack("<i", round(value)))[0]
        return self._codec.param_value_encode(name.encode("ascii"), value, kind, len(self._parameters), place)

    def _boot_ms(self, now_ns: int) -> int:
        return self.clock_us(now_ns) // 1000 & 0xFFFFFFFF

    def _reckon(self, now_ns: int) -> None:
        """Dead reckoning since the last call."""
        travel_m = self._scene.wheel_travel_m(now_ns)
        if self._travel_m is not None and now_ns > self._travel_ns:
            left_m, right_m = travel_m[0] - self._travel_m[0], travel_m[1] - self._travel_m[1]
            way_m, turn = 0.5 * (left_m + right_m), (right_m - left_m) / self._track_width_m
            heading = self._reckoned[2] + 0.5 * turn
            self._reckoned += np.array((way_m * math.cos(heading), way_m * math.sin(heading), turn))
            elapsed_s = (now_ns - self._travel_ns) / SECOND_NS
            self._speed = (way_m / elapsed_s, turn / elapsed_s)
        self._travel_m, self._travel_ns = travel_m, now_ns

    # -- what it hears ------------------------------------------------------------------------------------------------

    def _hear(self, message: Any, now_ns: int) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.get_srcSystem() == self.system:
            self.companion_ns = now_ns
        if kind == "OBSTACLE_DISTANCE":
            self._judge(message, now_ns)
        if kind == "TIMESYNC" and message.tc1 == 0:
            self._say(self._codec.timesync_encode(self.clock_us(now_ns) * 1000, message.ts1), now_ns)
        if kind == "PING" and message.target_system == 0:
            sender = message.get_srcSystem(), message.get_srcComponent()
            self._say(self._codec.ping_encode(message.time_usec, message.seq, *sender), now_ns)
        if getattr(message, "target_system", None) in (0, self.system):
            self._answer(kind, message, now_ns)
        if kind == "COMMAND_LONG" and message.target_system in (0, self.system):
            self._command(message, now_ns)

    def _answer(self, kind: str, message: Any, now_ns: int) -> None:
        """What ground tools ask for before they show anything."""
        sender = message.get_srcSystem(), message.get_srcComponent()
        if kind == "MISSION_REQUEST_LIST":
            self._say(self._codec.mission_count_encode(*sender, 0, message.mission_type), now_ns)
        if kind == "REQUEST_DATA_STREAM" and self.kind == "ardupilot":
            self._set_group(message, now_ns)
        if kind == "PARAM_REQUEST_LIST":
            for place in range(len(self._parameters)):
                self._say(self._parameter(place), now_ns)
        if kind in ("PARAM_REQUEST_READ", "PARAM_SET"):
            names = [name for name, _, _ in self._parameters]
            place = getattr(message, "param_index", -1)
            if place < 0 and message.param_id in names:
                place = names.index(message.param_id)
            if not 0 <= place < len(names):
                return
            if kind == "PARAM_SET":
                self._set_parameter(place, message.param_value)
            self._say(self._parameter(place), now_ns)

    def _set_group(self, message: Any, now_ns: int) -> None:
        """The old way to ask for rates. A sensor that is not there stays silent."""
        every = tuple(member for group in GROUPS.values() for member in group)
        members = every if message.req_stream_id == 0 else GROUPS.get(message.req_stream_id, ())
        hz = float(message.req_message_rate) if message.start_stop else 0.0
        for stream in self._streams:
            if stream.message_id in members and stream.usual_hz:
                stream.set_rate(min(MAX_HZ, hz), now_ns)

    def _set_parameter(self, place: int, told: float) -> None:
        name, kind, _ = self._parameters[place]
        if kind == INT32 and self.kind == "px4":
            told = struct.unpack("<i", struct.pack("<f", told))[0]
        self._parameters[place] = (name, kind, told)

    def _command(self, message: Any, now_ns: int) -> None:
        """SET_MESSAGE_INTERVAL for what is sent at all, REQUEST_MESSAGE for that and the version; else unsupported."""
        stream = next((s for s in self._streams if s.message_id == message.param1), None)
        asks_version = message.command == mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES or (
            message.command == mavlink.MAV_CMD_REQUEST_MESSAGE
            and message.param1 == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
        )
        result = mavlink.MAV_RESULT_UNSUPPORTED
        if message.command in (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE):
            result = mavlink.MAV_RESULT_DENIED if stream is None else mavlink.MAV_RESULT_ACCEPTED
        if asks_version:
            result = mavlink.MAV_RESULT_ACCEPTED
        sender = message.get_srcSystem(), message.get_srcComponent()
        self._say(self._codec.command_ack_encode(message.command, result, 0, 0, *sender), now_ns)
        if asks_version:
            self._say(self._version(), now_ns)
        elif stream is None or result != mavlink.MAV_RESULT_ACCEPTED:
            return
        elif message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            for answer in stream.build(now_ns):
                self._say(answer, now_ns)
        elif message.param2 == 0.0:
            stream.set_rate(stream.usual_hz, now_ns)
        else:
            stream.set_rate(min(MAX_HZ, 1e6 / message.param2) if message.param2 > 0.0 else 0.0, now_ns)

    # -- obstacles ----------------------------------------------------------------------------------------------------

    def seen(self, now_ns: int) -> F64:
        """What it believes now: (72,) metres in 5 degree bins, clockwise from ahead; +inf clear, NaN not known."""
        return self._fresh(now_ns)

    def _fresh(self, now_ns: int) -> F64:
        bins: F64 = np.where(now_ns - self._bin_ns < FORGET_NS, self._bins, NOT_KNOWN)
        return bins

    def _hears_obstacles(self, now_ns: int) -> bool:
        return bool((now_ns - self._bin_ns < FORGET_NS).any())

    def _judge(self, message: Any, now_ns: int) -> None:
        fault = _fault_of(message, self.kind)
        if fault:
            self.refused += 1
            self.complaint = fault
            return
        self.accepted += 1
        if self.kind == "ardupilot":
            self._take_as_ardupilot(message, now_ns)
        else:
            self._take_as_px4(message, now_ns)

    def _take_as_ardupilot(self, message: Any, now_ns: int) -> None:
        """Each message is the whole truth: what it does not tell is not known any more."""
        increment_deg = message.increment_f if abs(message.increment_f) > 1e-6 else float(message.increment)
        count = min(round(360.0 / abs(increment_deg)), BINS)
        self._bins[:] = NOT_KNOWN
        self._bin_ns[:] = now_ns
        for k, cm in enumerate(message.distances[:count]):
            if message.min_distance <= cm <= message.max_distance and cm != 0:
                place = _bin(k * increment_deg + message.angle_offset)
                self._bins[place] = np.fmin(self._bins[place], cm * 0.01)

    def _take_as_px4(self, message: Any, now_ns: int) -> None:
        """Every bin remembers by itself; a bin is told by the value whose sector covers it."""
        increment_deg = message.increment_f if message.increment_f > 0.0 else float(message.increment)
        turned_deg = 0.0
        if message.frame != mavlink.MAV_FRAME_BODY_FRD:  # element 0 looks north
            self._reckon(now_ns)
            turned_deg = math.degrees(self._reckoned[2])
        count = min(BINS, math.floor(360.0 / increment_deg + 0.5))
        for place in range(BINS):
            k = round((place * BIN_DEG - turned_deg - message.angle_offset) / increment_deg)
            k %= max(1, round(360.0 / increment_deg))
            cm = message.distances[k] if k < count else UNKNOWN_CM
            if cm != UNKNOWN_CM:
                self._bins[place] = math.inf if cm >= message.max_distance else cm * 0.01
                self._bin_ns[place] = now_ns


def _usual_parameters(kind: Kind, system: int) -> list[Parameter]:
    if kind == "px4":
        return [("MAV_SYS_ID", INT32, system), ("SYS_AUTOSTART", INT32, 50000), ("CP_DIST", REAL32, -1.0)]
    return [
        ("SYSID_THISMAV", INT32, system),
        ("FRAME_CLASS", INT32, 1),
        ("PRX1_TYPE", INT32, 2),
        ("AVOID_MARGIN", REAL32, 2.0),
    ]


def _bin(clockwise_deg: float) -> int:
    return round(clockwise_deg / BIN_DEG) % BINS


def _fault_of(message: Any, kind: Kind) -> str:
    """Why an autopilot cannot use an obstacle message; empty if it can."""
    increment = message.increment_f if abs(message.increment_f) > 1e-6 else message.increment
    if kind == "px4":
        increment = message.increment_f if message.increment_f > 0.0 else message.increment
        if message.frame not in FRAMES_OF_PX4:
            return f"frame {message.frame} is none of {FRAMES_OF_PX4}"
    if not math.isfinite(increment) or not math.isfinite(message.angle_offset):
        return "increment or offset is no number"
    if increment == 0:
        return "increment is 0"
    if message.max_distance <= message.min_distance:
        return f"maximum {message.max_distance} cm is not above minimum {message.min_distance} cm"
    return ""
