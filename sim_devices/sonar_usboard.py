"""Neobotix USBoard-USS5 and USBoard V1: sixteen ultrasonic transducers on CAN or RS-232, the board's side.

Source: the maker's pages on USBoard-USS5 and USBoard, and frames that the maker's code decoded.

    8-byte messages on both links, byte 0 is the command.
    CAN     host writes to the base id; answers to commands leave under base + 1..9, data groups under base + 13..16
    serial  19200 8N1; host writes the bare 8 bytes, the board FF, 8 bytes, check code (two bytes, high one first)

Habits kept: within a group of four the transducers fire one after the other at the fire interval, the four groups in
parallel, from power-on and whether asked or not; an answer holds the last completed firing of each. A cross-echo group
fires its sending transducer only, and all four listen. Parameters written with command 4 hold until power-off, with 5
they stay; a new base id holds from the answer to the ninth part on. A board that is switched on is deaf for a while.

Assumed, the papers being silent: the codes 0, 1, 2 (not connected, too close, no echo) hold in the one-byte format of
V1 as well, and distances past 255 cm read 255 there; V1 sends all four groups by itself, whatever the mask in byte 6
(the maker's node for it writes none and waits for all); an inactive transducer reads as not connected; the CAN rate in
the parameters is kept but changes nothing before a power cycle; a V1 board does not know command 13; a serial command
that stops half-way for 50 ms is forgotten.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import cos, inf, isfinite, radians

import numpy as np

from sim_devices.checksums import usboard_crc
from sim_devices.device import Frame, Mount, Scene
from sim_devices.wire import SECOND_NS, PacedWire

CONNECT, SET_ACTIVE, DATA_1TO8, DATA_9TO16, WRITE, WRITE_EEPROM, READ, ANALOG, DATA = 0, 1, 2, 3, 4, 5, 6, 7, 13
NOT_CONNECTED, TOO_CLOSE, NO_ECHO = 0, 1, 2
PARAMETERS = 54
PART = 6
CHANNELS = 16
BAUD = 19200
SPOILED_AFTER_NS = 50_000_000
INTERVALS_MS = {0: 500, 1: 1000, 2: 2000, 3: 200}
CUSTOM_INTERVAL = 15
ON_CAN, ON_SERIAL = 1, 2
ANALOG_ON = 4  # in parameter byte 5
RESOLUTIONS_M = (0.01, 0.005, 0.0025, 0.00125)
SOUND_AT_20_C = 343.4  # what the board reckons with


def default_parameters(base_id: int = 0x400, hardware: int = 21, serial: int = 12345) -> bytes:
    """The 54 parameter bytes of a board as delivered."""
    head = bytes((0, *base_id.to_bytes(4, "little"), 0, 0xF0, 0, 0xFF, 0xFF))
    tail = bytes((0x55, 0, 0, 0x11, 0x11, 0x80, 0, hardware)) + serial.to_bytes(4, "little")
    return head + bytes([100] * CHANNELS) + bytes([30] * CHANNELS) + tail


@dataclass(frozen=True, slots=True)
class Transducer:
    """One transducer that is connected: its pose on the robot and half its opening angle."""

    mount: Mount
    half_angle_rad: float = radians(15.0)


class UsBoard:
    """The board behind either link: messages in, messages out. UsBoardCan and UsBoardSerial put it on a wire.

    transducers: channel (1..16) -> what is connected there.  parameters: the 54 bytes of its EEPROM.
    range_min_m, range_max_m: what it can measure.  noise_m: standard deviation of a distance.
    air_temp_c: true air temperature; the board reckons with the speed of sound at 20 degrees.
    analog: four 12-bit levels of its inputs.  switches: lines at those inputs (0..3), pulled up to 5 V; told the time,
    whether the line is high.  eeprom_s: time that storing one part takes.
    Faults: `hears` lists boards whose pulses this one takes for its own echoes; `stuck_m` gives channels that always
    read the same.
    """

    def __init__(
        self,
        scene: Scene,
        transducers: Mapping[int, Transducer],
        *,
        parameters: bytes | None = None,
        range_min_m: float = 0.2,
        range_max_m: float = 4.0,
        noise_m: float = 0.005,
        air_temp_c: float = 20.0,
        analog: Sequence[int] = (0, 0, 0, 0),
        switches: Mapping[int, Callable[[int], bool]] | None = None,
        boot_s: float = 0.25,
        eeprom_s: float = 0.02,
        seed: int = 0,
    ) -> None:
        if not all(1 <= channel <= CHANNELS for channel in transducers):
            raise ValueError("channels of a board are 1 to 16")
        self.scene = scene
        self.transducers = dict(transducers)
        self.eeprom = bytes(default_parameters() if parameters is None else parameters)
        if len(self.eeprom) != PARAMETERS:
            raise ValueError(f"a board has {PARAMETERS} parameter bytes, not {len(self.eeprom)}")
        self.range_min_m = range_min_m
        self.range_max_m = range_max_m
        self.noise_m = noise_m
        self.air_temp_c = air_temp_c
        self.analog = list(analog)
        self.switches = dict(switches or {})
        self.eeprom_s = eeprom_s
        self.hears: list[UsBoard] = []
        self.stuck_m: dict[int, float] = {}
        self._boot_ns = round(boot_s * SECOND_NS)
        self._random = np.random.default_rng(seed)
        self.power_on(0)
        self._powered = False

    def power_on(self, now_ns: int) -> None:
        """Start with the stored parameters."""
        self._powered = True
        self._power_ns = now_ns
        self.parameters = bytearray(self.eeprom)
        self.take_new_base()
        self._active = self._active_mask(self.parameters[8], self.parameters[9])
        self._written = bytearray(self.parameters)
        self._smoothed: dict[int, tuple[int, float]] = {}
        self._next_send_ns = now_ns + self._boot_ns + self._interval_ns()

    def begin(self, now_ns: int) -> bool:
        """Power on at the first step; whether the board is awake."""
        if not self._powered:
            self.power_on(now_ns)
        return now_ns >= self._power_ns + self._boot_ns

    # -- parameters ---------------------------------------------------------------------------------------------------

    @property
    def is_v1(self) -> bool:
        """A first-generation board: one-byte distances only."""
        return self.parameters[49] == 0

    @property
    def next_send_ns(self) -> int | None:
        """When it sends by itself next; None if it only answers."""
        return self._next_send_ns if self.parameters[6] & 0x0F else None

    def _interval_ns(self) -> int:
        kind, custom = self.parameters[7] & 0x0F, self.parameters[7] >> 4
        milliseconds = (custom + 1) * 50 if kind == CUSTOM_INTERVAL else INTERVALS_MS.get(kind, 500)
        return milliseconds * 1_000_000

    def _fire_ns(self, group: int) -> int:
        nibble = self.parameters[45 + group // 2] >> 4 * (group % 2) & 0x0F
        return (nibble + 1) * 10_000_000

    def _sender(self, group: int) -> int | None:
        """In a cross-echo group the transducer that fires (0..3); None in a normal one."""
        return self.parameters[44] >> 2 * group & 3 if self.parameters[43] >> group & 1 else None

    def _active_mask(self, low: int, high: int) -> int:
        return low | high << 8

    # -- messages -----------------------------------------------------------------------------------------------------

    def answer(self, message: bytes, now_ns: int) -> list[tuple[int, bytes, int]]:
        """What a command brings back: (offset of the id from the base, 8 bytes, when it leaves), in order."""
        padded = message[:8].ljust(8, b"\0")
        command = padded[0]
        if command == CONNECT:
            return [(1, bytes(range(8)), now_ns)]
        if command == SET_ACTIVE:
            self._active = self._active_mask(padded[1], padded[2])
        elif command in (DATA_1TO8, DATA_9TO16):
            return [(offset, data, now_ns) for offset, data in self._short_frames(command, now_ns)]
        elif command in (WRITE, WRITE_EEPROM):
            return self._write(command, padded, now_ns)
        elif command == READ:
            parts = (bytes((READ, i)) + self.parameters[PART * i : PART * (i + 1)] for i in range(9))
            return [(6, bytes(part), now_ns) for part in parts]
        elif command == ANALOG:
            return [(7, bytes((ANALOG, *packed_12bit(self._inputs(now_ns)), 0)), now_ns)]
        elif command == DATA and not self.is_v1:
            return [(13 + g, self._group_frame(g, now_ns), now_ns) for g in range(4) if padded[1] >> g & 1]
        return []

    def unasked(self, now_ns: int, link: int) -> list[tuple[int, bytes, int]]:
        """What automatic sending has put on this link (ON_CAN or ON_SERIAL) by now. Call in order of time."""
        out: list[tuple[int, bytes, int]] = []
        if not self.parameters[6] & 0x0F:
            return out
        while self._next_send_ns <= now_ns:
            at_ns = self._next_send_ns
            self._next_send_ns += self._interval_ns()
            if now_ns - at_ns > SECOND_NS * 10 or not self.parameters[6] & link:
                continue
            out += [(offset, data, at_ns) for offset, data in self._round_frames(at_ns)]
        return out

    def _round_frames(self, now_ns: int) -> list[tuple[int, bytes]]:
        groups = [g for g in range(4) if self.is_v1 or self.parameters[6] >> 4 + g & 1]
        if not (self.is_v1 or self.parameters[5] & 8):
            return [(13 + g, self._group_frame(g, now_ns)) for g in groups]
        frames = [*self._short_frames(DATA_1TO8, now_ns), *self._short_frames(DATA_9TO16, now_ns)]
        return [frames[g] for g in groups]

    def _inputs(self, now_ns: int) -> list[int]:
        """Levels of the four inputs: what stands there, or a line near ground or near 5 V, with a little noise."""
        levels = list(self.analog)
        for line, is_high in self.switches.items():
            stray = int(self._random.integers(0, 60))
            levels[line] = 4095 - stray if is_high(now_ns) else stray
        return levels

    def _write(self, command: int, message: bytes, now_ns: int) -> list[tuple[int, bytes, int]]:
        part = message[1]
        if part > 8:
            return []
        self._written[PART * part : PART * (part + 1)] = message[2:]
        offset = 8 if command == WRITE else 9
        done_ns = now_ns + (round(self.eeprom_s * SECOND_NS) if command == WRITE_EEPROM else 0)
        if part < 8:
            return [(offset, bytes((command,)).ljust(8, b"\0"), done_ns)]
        self._written[48:] = self.parameters[48:]  # version and serial number are the board's own
        total = sum(self._written[:48]) & 0xFFFF
        self.parameters[:] = self._written
        self._active = self._active_mask(self.parameters[8], self.parameters[9])
        self._smoothed.clear()
        self._next_send_ns = now_ns + self._interval_ns()
        if command == WRITE_EEPROM:
            self.eeprom = bytes(self.parameters)
        return [(offset, bytes((command, *total.to_bytes(2, "little"))).ljust(8, b"\0"), done_ns)]

    def take_new_base(self) -> None:
        """Answer under the base id in the parameters from now on."""
        self.extended_ids = bool(self.parameters[5] & 1)
        self.base_id = int.from_bytes(self.parameters[1:5], "little") & (0x1FFFFFFF if self.extended_ids else 0x7FF)

    def _short_frames(self, command: int, now_ns: int) -> list[tuple[int, bytes]]:
        first = 0 if command == DATA_1TO8 else 2
        return [
            (2 * command - 2 + part, bytes((command, part, *self._short_values(first + part, now_ns), 0, 0)))
            for part in (0, 1)
        ]

    def _short_values(self, group: int, now_ns: int) -> list[int]:
        return [self._coded(range_m, 0.01, 255) for range_m in self._ranges(group, now_ns)]

    def _group_frame(self, group: int, now_ns: int) -> bytes:
        resolution = self.parameters[42] >> 2 * group & 3
        values = [self._coded(range_m, RESOLUTIONS_M[resolution], 4095) for range_m in self._ranges(group, now_ns)]
        sender = self._sender(group)
        fired = 0x0F if sender is None else 1 << sender
        return bytes((DATA, fired << 4 | resolution << 2 | group, *packed_12bit(values)))

    def _coded(self, range_m: float | None, resolution_m: float, largest: int) -> int:
        if range_m is None:
            return NOT_CONNECTED
        if range_m < self.range_min_m:
            return TOO_CLOSE
        if not range_m <= self.range_max_m:
            return NO_ECHO
        return min(largest, max(NO_ECHO + 1, round(range_m / resolution_m)))

    # -- measuring ----------------------------------------------------------------------------------------------------

    def _ranges(self, group: int, now_ns: int) -> list[float | None]:
        """Last completed measurement of a group's transducers; None where none is connected or it is inactive."""
        return [self._range(4 * group + i + 1, now_ns) for i in range(4)]

    def _range(self, channel: int, now_ns: int) -> float | None:
        transducer = self.transducers.get(channel)
        if transducer is None or not self._active >> channel - 1 & 1:
            return None
        if channel in self.stuck_m:
            return self.stuck_m[channel]
        firing = self._last_firing(channel, now_ns)
        done, value = self._smoothed.get(channel, (-1, inf))
        gain = self.parameters[47] / 128
        first = firing if gain >= 1.0 else max(done + 1, firing - 31, 0)
        if firing > done:
            for index in range(max(first, 0), firing + 1):
                raw = self._heard(channel, transducer, self._firing_ns(channel, index))
                value = value + gain * (raw - value) if gain < 1.0 and isfinite(value) and isfinite(raw) else raw
            self._smoothed[channel] = (firing, value)
        return value

    def _cycle_ns(self, group: int) -> int:
        return self._fire_ns(group) * (4 if self._sender(group) is None else 1)

    def _firing_ns(self, channel: int, index: int) -> int:
        group, place = divmod(channel - 1, 4)
        late = place if self._sender(group) is None else 0
        return self._power_ns + index * self._cycle_ns(group) + late * self._fire_ns(group)

    def _last_firing(self, channel: int, now_ns: int) -> int:
        """Index of the channel's last firing whose listening window is over by now."""
        group = (channel - 1) // 4
        window_end_ns = self._firing_ns(channel, 0) + self._fire_ns(group)
        return max(0, (now_ns - window_end_ns) // self._cycle_ns(group))

    def _heard(self, channel: int, transducer: Transducer, fired_ns: int) -> float:
        """The distance the board makes of one firing: infinite for silence."""
        group, place = divmod(channel - 1, 4)
        range_m = self._echo_m(transducer, fired_ns)
        sender = self._sender(group)
        if sender is not None and sender != place:
            source = self.transducers.get(4 * group + sender + 1)
            # Half the way from the sender to the surface and back to this one.
            range_m = inf if source is None else (range_m + self._echo_m(source, fired_ns)) / 2
        range_m = min([range_m, *self._foreign_m(transducer, fired_ns)])
        if isfinite(range_m):
            range_m *= SOUND_AT_20_C / speed_of_sound(self.air_temp_c)
            range_m = max(0.0, range_m + self.noise_m * float(self._random.standard_normal()))
        return range_m

    def _echo_m(self, transducer: Transducer, fired_ns: int) -> float:
        return self.scene.cone_range(transducer.mount, transducer.half_angle_rad, fired_ns, self.range_max_m)

    def _foreign_m(self, listener: Transducer, fired_ns: int) -> list[float]:
        """Distances that pulses of the boards in `hears` feign: their echoes falling into this listening window."""
        feigned = []
        for board in self.hears:
            for at_ns, source in board.firings(fired_ns - 40_000_000, fired_ns + 40_000_000):
                reach = listener.half_angle_rad + source.half_angle_rad
                if cos(listener.mount.yaw_rad - source.mount.yaw_rad) < cos(min(reach, 3.1)):
                    continue
                echo_m = board._echo_m(source, at_ns) + (at_ns - fired_ns) * 1e-9 * SOUND_AT_20_C / 2
                if self.range_min_m < echo_m < self.range_max_m:
                    feigned.append(echo_m)
        return feigned

    def firings(self, begin_ns: int, end_ns: int) -> list[tuple[int, Transducer]]:
        """When this board's transducers fire in [begin_ns, end_ns)."""
        found = []
        for channel, transducer in self.transducers.items():
            group, place = divmod(channel - 1, 4)
            if not self._active >> channel - 1 & 1 or self._sender(group) not in (None, place):
                continue
            index = max(0, -((self._firing_ns(channel, 0) - begin_ns) // self._cycle_ns(group)))
            while (at_ns := self._firing_ns(channel, index)) < end_ns:
                found.append((at_ns, transducer))
                index += 1
        return found


class UsBoardCan:
    """A board on a CAN bus."""

    def __init__(self, board: UsBoard) -> None:
        self.board = board
        self._waiting: list[tuple[int, Frame]] = []

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        """Advance to now_ns; returns the frames it sends, in order."""
        board = self.board
        if not board.begin(now_ns):
            return []
        self._queue(board.unasked(now_ns, ON_CAN))
        for frame in received:
            if frame.can_id == board.base_id and frame.extended == board.extended_ids and self._is_command(frame):
                self._queue(board.answer(frame.data, now_ns))
                board.take_new_base()
        out = [frame for at_ns, frame in self._waiting if at_ns <= now_ns]
        self._waiting = [item for item in self._waiting if item[0] > now_ns]
        return out

    @property
    def next_ns(self) -> int | None:
        """When it wants to send next; None while it only waits for commands."""
        due = [at_ns for at_ns, _ in self._waiting]
        if (unasked_ns := self.board.next_send_ns) is not None:
            due.append(unasked_ns)
        return min(due, default=None)

    def power_on(self, now_ns: int) -> None:
        """The supply came back."""
        self._waiting.clear()
        self.board.power_on(now_ns)

    @staticmethod
    def _is_command(frame: Frame) -> bool:
        return not frame.remote and len(frame.data) > 0

    def _queue(self, messages: list[tuple[int, bytes, int]]) -> None:
        extended = self.board.extended_ids
        for offset, data, at_ns in messages:
            self._waiting.append((at_ns, Frame(self.board.base_id + offset, data, extended=extended)))


class UsBoardSerial:
    """A board on RS-232 or USB."""

    def __init__(self, board: UsBoard) -> None:
        self.board = board
        self._wire = PacedWire(BAUD)
        self._buffer = bytearray()
        self._heard_ns = 0

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns the bytes that have left by then."""
        board = self.board
        if not board.begin(now_ns):
            return b""
        self._queue(board.unasked(now_ns, ON_SERIAL))
        fits = baud is None or baud == BAUD
        if received and fits:
            if now_ns - self._heard_ns > SPOILED_AFTER_NS:
                self._buffer.clear()
            self._heard_ns = now_ns
            self._buffer += received
            while len(self._buffer) >= 8:
                self._queue(board.answer(bytes(self._buffer[:8]), now_ns))
                board.take_new_base()
                del self._buffer[:8]
        out = self._wire.leave_by(now_ns)
        return out if fits else bytes(byte ^ 0xA5 for byte in out)

    @property
    def next_ns(self) -> int | None:
        """When bytes are due to leave; None while it only waits for commands."""
        due = [at_ns for at_ns in (self._wire.next_ns, self.board.next_send_ns) if at_ns is not None]
        return min(due, default=None)

    def power_on(self, now_ns: int) -> None:
        """The supply came back."""
        self._wire.clear(now_ns)
        self._buffer.clear()
        self.board.power_on(now_ns)

    def _queue(self, messages: list[tuple[int, bytes, int]]) -> None:
        for _, data, at_ns in messages:
            self._wire.send(b"\xff" + data + usboard_crc(data).to_bytes(2, "big"), at_ns, whole=True)


def packed_12bit(values: Sequence[int]) -> list[int]:
    """Four 12-bit values as four low bytes and two bytes of high nibbles."""
    a, b, c, d = values
    return [a & 0xFF, b & 0xFF, c & 0xFF, d & 0xFF, a >> 8 | b >> 8 << 4, c >> 8 | d >> 8 << 4]


def speed_of_sound(air_temp_c: float) -> float:
    """Speed of sound in dry air, m/s."""
    return 331.3 + 0.606 * air_temp_c


def board_with(base_id: int, scene: Scene, transducers: Mapping[int, Transducer], **options: object) -> UsBoardCan:
    """A board on CAN with the delivered parameters but for its base id. options: as UsBoard takes them."""
    board = UsBoard(scene, transducers, parameters=default_parameters(base_id), **options)  # type: ignore[arg-type]
    return UsBoardCan(board)
