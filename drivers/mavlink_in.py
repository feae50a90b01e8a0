"""An autopilot on MAVLink as a source: distances, wheel ways, odometry and attitude. Serial line or UDP.

    message          becomes          notes
    DISTANCE_SENSOR  ChainReading     channel = id + 1; place and cone are the configuration's
    WHEEL_DISTANCE   WheelReading     a tick is a micrometre; two of the up to 16 wheels
    ODOMETRY         PoseReading      frames of x forward, y right, z down are turned over: y and yaw change sign
    ATTITUDE         AttitudeReading  pitch and yaw change sign

We send HEARTBEAT each second and, once an autopilot's heartbeat was heard, SET_MESSAGE_INTERVAL for what is wanted:
once, for an autopilot has rates of its own, and again for what does not come. Stamps are those of arrival, the frame's
time on the wire taken off.

Source: MAVLink common.xml; conventions in docs/devices/mavlink_in.md.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence

from drivers.conversation import MOST_SILENCE_NS, SetBaudRate, silence_limit
from drivers.mavlink_frames import (
    ATTITUDE,
    COMMAND_LONG,
    DISTANCE_SENSOR,
    HEARTBEAT,
    ODOMETRY,
    WHEEL_DISTANCE,
    Frames,
    Message,
    encode_v2,
)
from drivers.readings import (
    AttitudeReading,
    ChainReading,
    ClockFit,
    Identity,
    LinkState,
    PoseReading,
    RangeReading,
    RangeStatus,
    Reading,
    SourceCounters,
    WheelReading,
)
from drivers.wheel_counts import WheelCounts

TICKS_PER_M = 1_000_000
_MS = 1_000_000
_SECOND_NS = 1_000 * _MS
_REQUEST_PERIOD_NS = 2 * _SECOND_NS
_OVERDUE_NS = 2 * _SECOND_NS
_LONG_AGO = -(1 << 62)
_COMPONENT = 196  # MAV_COMP_ID_OBSTACLE_AVOIDANCE
_TYPE_ONBOARD, _TYPE_GCS, _AUTOPILOT_INVALID, _STATE_ACTIVE, _VERSION = 18, 6, 8, 4, 3
_SET_MESSAGE_INTERVAL = 511
_LOCAL_NED, _LOCAL_ENU, _BODY_NED, _BODY_FRD, _BODY_FLU, _LOCAL_FRD, _LOCAL_FLU = 1, 4, 8, 12, 13, 20, 21
_VISION_NED, _ESTIM_NED = 16, 18  # of older autopilots and of MAVSDK; reserved today
_DOWN_FRAMES = {
    (frame, child) for frame in (_LOCAL_NED, _LOCAL_FRD, _VISION_NED, _ESTIM_NED) for child in (_BODY_FRD, _BODY_NED)
}
_UP_FRAMES = {(frame, _BODY_FLU) for frame in (_LOCAL_FLU, _LOCAL_ENU)}
_QUALITY_INVALID = 1  # of DISTANCE_SENSOR: 0 not told, 1 no valid signal, 100 perfect
_AUTOPILOTS = {3: "ArduPilot", 12: "PX4"}

_MESSAGES: dict[type[Reading], int] = {
    ChainReading: DISTANCE_SENSOR,
    WheelReading: WHEEL_DISTANCE,
    PoseReading: ODOMETRY,
    AttitudeReading: ATTITUDE,
}
_NAMES = {
    DISTANCE_SENSOR: "DISTANCE_SENSOR",
    WHEEL_DISTANCE: "WHEEL_DISTANCE",
    ODOMETRY: "ODOMETRY",
    ATTITUDE: "ATTITUDE",
}


class MavlinkConversation:
    """What one MAVLink system says of itself.

    kinds: the readings wanted.  system: its id; None: of the first that sends any of them.  rate_hz: asked for.
    wheels: indices of the left and right wheel.  max_wheel_speed_m_s: tells resets from motion.  baud_bps: of a serial
    line, for the time a frame takes on it; 0 on UDP.
    """

    def __init__(
        self,
        kinds: Collection[type[Reading]] = tuple(_MESSAGES),
        *,
        system: int | None = None,
        rate_hz: float = 20.0,
        wheels: tuple[int, int] = (0, 1),
        max_wheel_speed_m_s: float = 20.0,
        baud_bps: int = 0,
    ) -> None:
        if not kinds or not set(kinds) <= set(_MESSAGES):
            raise ValueError("kinds: ChainReading, WheelReading, PoseReading or AttitudeReading")
        if wheels[0] == wheels[1] or not all(0 <= wheel <= 15 for wheel in wheels):
            raise ValueError(f"wheels {wheels}: two different ones, 0 to 15")
        if not 0.0 < rate_hz <= 200.0:
            raise ValueError(f"rate_hz {rate_hz}: above 0, up to 200")
        self._wanted = {_MESSAGES[kind] for kind in kinds}
        self._system_wanted = system
        self._period_ns = round(1e9 / rate_hz)
        self._wheels = wheels
        self._byte_ns = 10 * _SECOND_NS // baud_bps if baud_bps else 0
        self._counters = SourceCounters()
        self._frames = Frames(self._counters)
        self._counts = WheelCounts(
            self._counters, max_ticks_per_s=max_wheel_speed_m_s * TICKS_PER_M, range_ticks=1 << 62
        )
        self._sequence = 0
        self._stamps: dict[type[Reading], int] = {}
        self._restart(0)

    # ---- what a conversation shows

    @property
    def state(self) -> LinkState:
        if self._running:
            return LinkState.RUNNING
        return LinkState.STARTING if self._system is not None else LinkState.SILENT

    @property
    def trouble(self) -> str | None:
        if self._system is None:
            hint = "no MAVLink heard: check the cable, the line speed or UDP port, and that the port speaks MAVLink"
            return hint if self._now_ns - self._connected_ns > _OVERDUE_NS else None
        return "; ".join(filter(None, map(self.trouble_of, _MESSAGES))) or None

    def trouble_of(self, kind: type[Reading]) -> str | None:
        """What is wrong with one kind of reading."""
        message = _MESSAGES[kind]
        if message not in self._wanted or self._system is None:
            return None
        since_ns = max(self._heard_ns.get(message, _LONG_AGO), self._connected_ns)
        if self._now_ns - since_ns <= _OVERDUE_NS:
            return None
        return f"system {self._system} does not send {_NAMES[message]}: set up its stream on this port"

    @property
    def identity(self) -> Identity | None:
        if self._system is None:
            return None
        return Identity(vendor=self._vendor, model=f"MAVLink system {self._system}")

    @property
    def clock_fit(self) -> ClockFit | None:
        """Its messages carry several clocks; arrival is used."""
        return None

    @property
    def counters(self) -> SourceCounters:
        return self._counters

    @property
    def silence_limit_ns(self) -> int:
        return silence_limit(self._period_ns)

    def silence_limit_of(self, kind: type[Reading]) -> int:
        """Three periods: as asked for, or as sensors of distance were heard to take, which may be slow by nature."""
        if kind is not ChainReading:
            return self.silence_limit_ns
        slowest_ns = max(self._intervals_ns.values(), default=MOST_SILENCE_NS)
        return min(max(3 * round(slowest_ns), self.silence_limit_ns), MOST_SILENCE_NS)

    # ---- how it is driven

    def connected(self, now_ns: int) -> None:
        self._restart(now_ns)

    def _restart(self, now_ns: int) -> None:
        self._connected_ns = self._now_ns = now_ns
        self._frames.clear()
        self._counts.restart()
        self._system: int | None = None
        self._component = 1
        self._vendor = ""
        self._autopilot_heard = False
        self._running = False
        self._heartbeat_due_ns = now_ns
        self._request_due_ns = now_ns
        self._asked: set[int] = set()  # messages that came after we had asked for them
        self._heard_ns: dict[int, int] = {}
        self._resets: int | None = None
        self._sensor_ns: dict[int, int] = {}  # when each sensor of distance was last heard
        self._intervals_ns: dict[int, float] = {}  # and how long it takes from one to the next

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        self._now_ns = now_ns
        frames = []
        if now_ns >= self._heartbeat_due_ns:
            self._heartbeat_due_ns = now_ns + _SECOND_NS
            values = (0, _TYPE_ONBOARD, _AUTOPILOT_INVALID, 0, _STATE_ACTIVE, _VERSION)
            frames.append(self._encode(HEARTBEAT, values))
        if self._autopilot_heard and now_ns >= self._request_due_ns:
            self._request_due_ns = now_ns + _REQUEST_PERIOD_NS
            silent = {
                message for message in self._wanted if now_ns - self._heard_ns.get(message, _LONG_AGO) > MOST_SILENCE_NS
            }
            frames += [self._ask_for(message) for message in sorted(silent | (self._wanted - self._asked))]
            self._asked = self._wanted - silent
        return frames

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        self._counters.chunks += 1
        self._counters.bytes += len(chunk)
        for message, behind in self._frames.feed(chunk):
            began_ns = stamp_ns - (behind + message.size) * self._byte_ns
            reading = self._take(message, began_ns)
            if reading is not None:
                self._running = True
                self._counters.readings += 1
                yield reading

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """We moved nothing; its streams are left as they are."""
        return ()

    # ---- out

    def _encode(self, message: int, values: tuple[float, ...]) -> bytes:
        self._sequence += 1
        system = self._system or self._system_wanted or 1  # a companion has the id of its vehicle
        return encode_v2(message, values, sequence=self._sequence - 1, system=system, component=_COMPONENT)

    def _ask_for(self, message: int) -> bytes:
        interval_us = self._period_ns / 1e3
        parameters = (float(message), interval_us, 0.0, 0.0, 0.0, 0.0, 0.0)
        assert self._system is not None
        return self._encode(COMMAND_LONG, (*parameters, _SET_MESSAGE_INTERVAL, self._system, self._component, 0))

    # ---- in

    def _take(self, message: Message, stamp_ns: int) -> Reading | None:
        if not self._is_ours(message):
            return None
        kind = message.message_id
        if kind == HEARTBEAT:
            self._take_heartbeat(message)
            return None
        if kind not in self._wanted:
            return None
        self._heard_ns[kind] = stamp_ns
        match kind:
            case 132:  # DISTANCE_SENSOR
                return self._distance(message.values, stamp_ns)
            case 9000:  # WHEEL_DISTANCE
                return self._wheel_ways(message.values, stamp_ns)
            case 331:  # ODOMETRY
                return self._odometry(message.values, stamp_ns)
            case _:
                return self._attitude(message.values, stamp_ns)

    def _is_ours(self, message: Message) -> bool:
        if self._system is None:
            is_vehicle = message.message_id != HEARTBEAT or message.values[1] != _TYPE_GCS
            asked_for = self._system_wanted in (None, message.system)
            if message.message_id == COMMAND_LONG or not is_vehicle or not asked_for:
                return False
            self._system = message.system
        if message.system != self._system:
            self._counters.drop("other_system")
            return False
        return True

    def _take_heartbeat(self, message: Message) -> None:
        autopilot = int(message.values[2])
        if autopilot != _AUTOPILOT_INVALID:  # not another companion or a gimbal
            self._autopilot_heard = True
            self._component = message.component
            self._vendor = _AUTOPILOTS.get(autopilot, "")

    def _distance(self, values: tuple[float, ...], stamp_ns: int) -> ChainReading:
        _, least, most, current, _, sensor = (int(value) for value in values[:6])
        quality = int(values[14])
        range_m, status = current / 100.0, RangeStatus.ECHO
        if quality == _QUALITY_INVALID or least > most or most == 0 or current == 0:
            range_m, status = math.nan, RangeStatus.INVALID
        elif current < least:
            range_m, status = -math.inf, RangeStatus.TOO_CLOSE
        elif current > most:
            range_m, status = math.inf, RangeStatus.NO_RETURN
        self._note_interval(sensor, stamp_ns)
        stamp_ns = self._rising(ChainReading, stamp_ns)
        return ChainReading(stamp_ns, (RangeReading(sensor + 1, range_m, status),))

    def _note_interval(self, sensor: int, stamp_ns: int) -> None:
        last_ns = self._sensor_ns.get(sensor)
        self._sensor_ns[sensor] = stamp_ns
        if last_ns is not None:
            interval_ns = min(stamp_ns - last_ns, MOST_SILENCE_NS)
            known_ns = self._intervals_ns.get(sensor, interval_ns)
            self._intervals_ns[sensor] = known_ns + 0.2 * (interval_ns - known_ns)

    def _wheel_ways(self, values: tuple[float, ...], stamp_ns: int) -> WheelReading | None:
        count = int(values[17])
        if count <= max(self._wheels):
            self._counters.drop("wheel_missing")
            return None
        left_m, right_m = (values[1 + wheel] for wheel in self._wheels)
        if not (math.isfinite(left_m) and math.isfinite(right_m)) or max(abs(left_m), abs(right_m)) > 1e9:
            self._counters.drop("not_a_way")
            return None
        return self._counts.advance(round(left_m * TICKS_PER_M), round(right_m * TICKS_PER_M), stamp_ns)

    def _odometry(self, values: tuple[float, ...], stamp_ns: int) -> PoseReading | None:
        x_m, y_m = values[1], values[2]
        w, x, y, z = values[4:8]
        frame, child, resets, _, quality = (int(value) for value in values[56:61])
        if (frame, child) not in _DOWN_FRAMES | _UP_FRAMES:
            self._counters.drop("odometry_frame")
            return None
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        if not (math.isfinite(x_m) and math.isfinite(y_m) and 0.9 < norm < 1.1) or quality < 0:
            self._counters.drop("odometry_failed")
            self._resets = None  # what follows a failure follows from nothing
            return None
        yaw_rad = math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
        turned = -1.0 if (frame, child) in _DOWN_FRAMES else 1.0
        continuous = resets == self._resets
        self._resets = resets
        return PoseReading(
            self._rising(PoseReading, stamp_ns),
            x_m,
            turned * y_m,
            turned * yaw_rad,
            continuous,
            quality / 100.0 if quality > 0 else None,
        )

    def _attitude(self, values: tuple[float, ...], stamp_ns: int) -> AttitudeReading | None:
        roll, pitch, yaw, *rates = values[1:7]
        if not all(map(math.isfinite, values[1:7])):
            self._counters.drop("not_an_attitude")
            return None
        stamp_ns = self._rising(AttitudeReading, stamp_ns)
        return AttitudeReading(stamp_ns, roll, -pitch, -yaw, (rates[0], -rates[1], -rates[2]))

    def _rising(self, kind: type[Reading], stamp_ns: int) -> int:
        self._stamps[kind] = max(stamp_ns, self._stamps.get(kind, _LONG_AGO) + 1)
        return self._stamps[kind]
