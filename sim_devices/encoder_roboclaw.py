"""A RoboClaw motor controller on packet serial: counts and speeds of two motors, and the commands that drive them.

Source: Basicmicro, RoboClaw User Manual; the makers' Python packages; numbers are big-endian.

    read    host: address, command                       board: data, CRC over address, command and data
    write   host: address, command, data, CRC over all   board: FF
    CRC-16, polynomial 1021h, start 0; addresses 80h to 87h

Habits kept: a bad CRC, an unknown command and another address meet silence; a pause of more than 10 ms inside a packet
throws away what came of it. Counts are 32 bits and go round. Status bits 0 and 2 of commands 16 and 17 (went below 0,
above the top) clear when read, bit 1 (backward) is live and keeps its last state at rest. Settings that are written
can be read back. With a serial timeout (14) set, motors stop when nothing valid came for so long.

Assumed: motors reach a speed at once, accelerations are taken and not obeyed; a way or a target position is driven at
its speed for the time that takes, at once, whatever the buffer byte says; 100 % duty is the speed `top_ticks_per_s`.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

from sim_devices.checksums import crc16_ccitt
from sim_devices.wheel import Undo, Wheel, inflict_on_counts, signed
from sim_devices.wire import SECOND_NS, PacedWire

ADDRESSES = range(0x80, 0x88)
PACKET_GAP_NS = 10_000_000
ANSWER_NS = 500_000  # from the last byte of a packet to the first of its answer
FULL = 1 << 32
SPEED_WINDOW_NS = SECOND_NS // 30
RAW_SPEED_WINDOW_NS = SECOND_NS // 300
UNDERFLOW, BACKWARD, OVERFLOW = 0x01, 0x02, 0x04
ACKNOWLEDGED = b"\xff"
BUFFER_EMPTY = 0x80

LEAST_BY_BYTE, MOST_BY_BYTE = (2, 26), (3, 27)  # limits of batteries: (V - 6) * 5, V * 5.12

# What is only kept: command that writes -> (format, command that reads back, place in what that one returns).
SETTINGS: dict[int, tuple[str, int, int]] = {
    2: ("B", 59, 0), 3: ("B", 59, 1), 14: ("B", 15, 0), 26: ("B", 60, 0), 27: ("B", 60, 1),
    28: ("IIII", 55, 0), 29: ("IIII", 56, 0), 57: ("HH", 59, 0), 58: ("HH", 60, 0),
    61: ("7I", 63, 0), 62: ("7I", 64, 0), 68: ("I", 81, 0), 69: ("I", 81, 1), 70: ("H", 72, 0), 71: ("H", 72, 1),
    74: ("BBB", 75, 0), 76: ("BBHHHHHBBHHHHH", 77, 0), 92: ("B", 91, 0), 93: ("B", 91, 1), 98: ("H", 99, 0),
    105: ("I", 107, 0), 106: ("I", 107, 1), 109: ("HH", 110, 0), 112: ("HH", 113, 0), 115: ("BB", 116, 0),
    128: ("II", 130, 0), 129: ("II", 131, 0), 133: ("II", 135, 0), 134: ("II", 136, 0), 139: ("BBB", 140, 0),
    148: ("B", 149, 0), 160: ("BB", 161, 0), 201: ("B", 202, 0),
}  # fmt: skip
DEFAULTS: dict[int, tuple[str, list[int]]] = {
    15: ("B", [0]), 55: ("IIII", [0, 65536, 32768, 44000]), 56: ("IIII", [0, 65536, 32768, 44000]),
    59: ("HH", [60, 340]), 60: ("HH", [60, 340]), 63: ("7I", [0] * 7), 64: ("7I", [0] * 7),
    72: ("HH", [32767, 32767]), 75: ("BBB", [0] * 3), 77: ("BBHHHHHBBHHHHH", [0] * 14), 81: ("II", [0] * 2),
    91: ("BB", [0, 0]), 99: ("H", [3]), 107: ("II", [0, 0]), 110: ("HH", [0, 0]), 113: ("HH", [0, 0]),
    116: ("BB", [0, 0]), 130: ("II", [0, 0]), 131: ("II", [0, 0]), 135: ("II", [1000, 0]), 136: ("II", [1000, 0]),
    140: ("BBB", [0, 1, 2]), 149: ("B", [0]), 161: ("BB", [0, 0]), 202: ("B", [0]),
}  # fmt: skip

# What newer firmware has instead: limits that follow the battery, CTRL1 and CTRL2 as well, one mode a motor.
NEW_SETTINGS: dict[int, tuple[str, int, int]] = {
    57: ("HHB", 59, 0), 68: ("II", 81, 0), 69: ("II", 81, 2), 74: ("5B", 75, 0), 148: ("BB", 149, 0),
}  # fmt: skip
NEW_DEFAULTS: dict[int, tuple[str, list[int]]] = {
    59: ("HHB", [60, 340, 0]), 75: ("5B", [0] * 5), 81: ("4I", [0] * 4), 149: ("BB", [0, 0]),
}  # fmt: skip

# Both motors by one 7-bit number, as "mixed": way ahead and turn, each kept until the next; sign, and whether about 64.
MIXED: dict[int, tuple[str, int, int]] = {
    8: ("ahead", 1, 0), 9: ("ahead", -1, 0), 10: ("turn", 1, 0), 11: ("turn", -1, 0), 12: ("ahead", 1, 64),
    13: ("turn", 1, 64),
}  # fmt: skip

# Commands that move motors: which motors, and what each argument is: s speed, d duty, w way, t target position,
# u 7-bit duty, x 7-bit duty about 64, other letters nothing that is obeyed.
MOVES: dict[int, tuple[str, str, str]] = {
    0: ("1", "B", "u"), 1: ("1", "B", "U"), 4: ("2", "B", "u"), 5: ("2", "B", "U"), 6: ("1", "B", "x"),
    7: ("2", "B", "x"), 32: ("1", "h", "d"), 33: ("2", "h", "d"), 34: ("12", "hh", "dd"),
    35: ("1", "i", "s"), 36: ("2", "i", "s"), 37: ("12", "ii", "ss"),
    38: ("1", "Ii", "as"), 39: ("2", "Ii", "as"), 40: ("12", "Iii", "ass"),
    41: ("1", "iIB", "swb"), 42: ("2", "iIB", "swb"), 43: ("12", "iIiIB", "swswb"),
    44: ("1", "IiIB", "aswb"), 45: ("2", "IiIB", "aswb"), 46: ("12", "IiIiIB", "aswswb"),
    50: ("12", "IiIi", "asas"), 51: ("12", "IiIIiIB", "aswaswb"),
    52: ("1", "hI", "da"), 53: ("2", "hI", "da"), 54: ("12", "hIhI", "dada"),
    65: ("1", "IIIiB", "asatb"), 66: ("2", "IIIiB", "asatb"), 67: ("12", "IIIiIIIiB", "asatasatb"),
    119: ("1", "iB", "tb"), 120: ("2", "iB", "tb"), 121: ("12", "iiB", "ttb"),
    122: ("1", "IiB", "stb"), 123: ("2", "IiB", "stb"), 124: ("12", "IiIiB", "ststb"),
}  # fmt: skip
PLAIN_WRITES: dict[int, str] = {20: "", 22: "i", 23: "i", 80: "", 94: "I", 95: "", 200: ""}  # 80 of new: a key
READS = frozenset(
    {16, 17, 18, 19, 21, 24, 25, 30, 31, 47, 48, 49, 73, 78, 79, 82, 83, 90, 100, 101, 103, 108, 111, 114}
)


@dataclass(slots=True)
class _Motor:
    """A motor, and what its count did since it was asked."""

    wheel: Wheel
    last: int = 0  # the unlimited count when last looked at
    flags: int = 0
    backward: bool = False
    stop_ns: int | None = None
    duty: int = 0

    def look(self, now_ns: int) -> int:
        """The 32-bit count; notes what happened on the way."""
        count, before = self.wheel.count(now_ns), self.last
        if count // FULL != before // FULL:
            self.flags |= OVERFLOW if count > before else UNDERFLOW
        if count != before:
            self.backward = count < before
        self.last = count
        return count % FULL

    def set_count(self, count: int, now_ns: int) -> None:
        self.wheel.set_count(count % FULL, now_ns)
        self.last, self.flags = count % FULL, 0

    def speed(self, now_ns: int, window_ns: int = SPEED_WINDOW_NS) -> int:
        return round(self.wheel.ticks_per_s(now_ns, window_ns))


class RoboClaw:
    """The controller on its serial line. The first step is power-on.

    m1, m2: left and right wheel as wired.  link: "usb" takes any line speed, "ttl" only baud_bps.
    main_v, logic_v: its batteries.  top_ticks_per_s: speed at 100 % duty.  wide_status: command 90 answers 32 bits (new
    firmware) or 16.  new_firmware: some settings have the longer forms of NEW_SETTINGS.  packet_gap_ns: pause that
    ends a packet.
    """

    fault_family = "encoder"

    def __init__(
        self,
        m1: Wheel,
        m2: Wheel,
        *,
        address: int = 0x80,
        link: str = "usb",
        baud_bps: int = 38400,
        version: str = "USB Roboclaw 2x15a v4.2.4\n",
        main_v: float = 12.1,
        logic_v: float = 5.0,
        top_ticks_per_s: float = 44000.0,
        wide_status: bool = True,
        new_firmware: bool = False,
        packet_gap_ns: int = PACKET_GAP_NS,
    ) -> None:
        if address not in ADDRESSES:
            raise ValueError("a RoboClaw has an address from 80h to 87h")
        if link not in ("usb", "ttl"):
            raise ValueError("a RoboClaw is on usb or ttl")
        self.address = address
        self.main_v = main_v
        self.logic_v = logic_v
        self.status = 0
        self.temperature_c = 25.0
        self.motors = (_Motor(m1), _Motor(m2))
        self._baud = baud_bps if link == "ttl" else None
        self._version = version.encode("ascii") + b"\0"
        self._top = top_ticks_per_s
        self._wide_status = wide_status
        self._settings = SETTINGS | (NEW_SETTINGS if new_firmware else {})
        self._defaults = DEFAULTS | (NEW_DEFAULTS if new_firmware else {})
        self._writes = PLAIN_WRITES | ({80: "I"} if new_firmware else {})
        self._gap_ns = packet_gap_ns
        self._wire = PacedWire(baud_bps if link == "ttl" else 2_000_000)
        self._powered = False
        self._begin(0)

    # -- what the wire and the tests see ------------------------------------------------------------------------------

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns the bytes that have left by then."""
        if not self._powered:
            self.power_on(now_ns)
        self._stop_in_time(now_ns)
        for motor in self.motors:
            motor.look(now_ns)
        if self._baud is not None and baud is not None and baud != self._baud:
            return bytes(byte ^ 0x5A for byte in self._wire.leave_by(now_ns))
        if received:
            self._take(received, now_ns)
        return self._wire.leave_by(now_ns)

    @property
    def next_ns(self) -> int | None:
        """When it wants to be served next; None while it only waits for commands."""
        due = [self._wire.next_ns, *(motor.stop_ns for motor in self.motors)]
        if self._timeout_ns and any(motor.wheel.commanded_m_s for motor in self.motors):
            due.append(self._valid_ns + self._timeout_ns)
        return min((at_ns for at_ns in due if at_ns is not None), default=None)

    def power_on(self, now_ns: int) -> None:
        """Counts start at 0, motors stand, settings are the stored ones."""
        self._powered = True
        self._begin(now_ns)
        for motor in self.motors:
            motor.set_count(0, now_ns)
            self._turn(motor, 0.0, now_ns)

    def inflict(self, kind: str, value: float, arguments: Mapping[str, float], now_ns: int) -> Undo | None:
        """See wheel.Faulty. `wrap` is where the 32 bits go round: at the top rolling upwards, at 0 downwards."""
        if kind == "reset":
            self.power_on(now_ns)
        elif kind == "alarm":
            before, self.status = self.status, round(value)
            return lambda _: setattr(self, "status", before)
        elif kind == "wrap":
            wheels = tuple(motor.wheel for motor in self.motors)
            inflict_on_counts(wheels, kind, value, arguments, now_ns, lowest=0, highest=FULL - 1)
            for motor in self.motors:
                motor.last = motor.wheel.count(now_ns)
        return None

    # -- packets ------------------------------------------------------------------------------------------------------

    def _begin(self, now_ns: int) -> None:
        self._packet = bytearray()
        self._lost = False  # the rest of a packet nobody knows is thrown away
        self._heard_ns: int = now_ns
        self._valid_ns: int = now_ns
        self._restore()
        self._mixed = {"ahead": 0.0, "turn": 0.0}
        self._wire.clear(now_ns)

    def _restore(self) -> None:
        self._values = {command: (form, list(values)) for command, (form, values) in self._defaults.items()}

    @property
    def _timeout_ns(self) -> int:
        return self._values[15][1][0] * 100_000_000

    def _take(self, received: bytes, now_ns: int) -> None:
        if now_ns - self._heard_ns > self._gap_ns:
            self._packet.clear()
            self._lost = False
        self._heard_ns = now_ns
        self._packet += received
        self._read_packets(now_ns)

    def _read_packets(self, now_ns: int) -> None:
        while not self._lost and self._packet:
            if self._packet[0] not in ADDRESSES:
                del self._packet[0]
                continue
            if len(self._packet) < 2:
                return
            command = self._packet[1]
            form = self._form_of(command)
            if form is None:
                self._lost = True
                break
            is_write = command not in READS and command not in self._values
            length = 2 + struct.calcsize(">" + form) + (2 if is_write else 0)
            if len(self._packet) < length:
                return
            packet = bytes(self._packet[:length])
            del self._packet[:length]
            if is_write and crc16_ccitt(packet) != 0:  # a message followed by its own CRC leaves none
                self._lost = True
            elif packet[0] == self.address:
                self._valid_ns = now_ns
                self._obey(packet, form, now_ns)
        if self._lost:
            self._packet.clear()

    def _form_of(self, command: int) -> str | None:
        """The data that follow a command, as a struct format; None if nobody knows it."""
        if command in READS or command in self._values:
            return ""
        if command in self._settings:
            return self._settings[command][0]
        if command in MOVES:
            return MOVES[command][1]
        if command in MIXED:
            return "B"
        return self._writes.get(command)

    def _obey(self, packet: bytes, form: str, now_ns: int) -> None:
        command = packet[1]
        if command in READS or command in self._values:
            answer = self._read(command, now_ns)
            answer += crc16_ccitt(packet[:2] + answer).to_bytes(2, "big")
        else:
            self._write(command, list(struct.unpack(">" + form, packet[2:-2])), now_ns)
            answer = ACKNOWLEDGED
        self._wire.send(answer, now_ns + ANSWER_NS, whole=self._baud is None)  # one packet on USB

    # -- reading ------------------------------------------------------------------------------------------------------

    def _read(self, command: int, now_ns: int) -> bytes:
        if command in self._values:
            form, values = self._values[command]
            return struct.pack(">" + form, *values)
        first, second = self.motors
        match command:
            case 16 | 17:
                return self._count_and_status(self.motors[command - 16], now_ns)
            case 18 | 19:
                return _magnitude(self.motors[command - 18].speed(now_ns))
            case 30 | 31:
                return _magnitude(self.motors[command - 30].speed(now_ns, RAW_SPEED_WINDOW_NS))
            case 21:
                return self._version
            case 24 | 25:
                return struct.pack(">H", round(10.0 * (self.main_v if command == 24 else self.logic_v)))
            case 47:
                return bytes((BUFFER_EMPTY, BUFFER_EMPTY))
            case 48:
                return struct.pack(">hh", first.duty, second.duty)
            case 49 | 111 | 114:  # currents; errors of speed and position: there are none
                return bytes(4)
            case 73:
                return self._all_at_once(now_ns)
            case 78:
                return struct.pack(">II", first.look(now_ns), second.look(now_ns))
            case 79:
                return struct.pack(">ii", *(motor.speed(now_ns, RAW_SPEED_WINDOW_NS) for motor in self.motors))
            case 82 | 83:
                return struct.pack(">H", round(10.0 * self.temperature_c))
            case 90:
                return struct.pack(">I", self.status) if self._wide_status else struct.pack(">H", self.status & 0xFFFF)
            case 100:
                return struct.pack(">HH", round(10.0 * self.main_v), round(10.0 * self.logic_v))
            case 101:
                return struct.pack(">HH", *[round(10.0 * self.temperature_c)] * 2)
            case 103:
                return bytes(self._take_flags(motor, now_ns) for motor in self.motors)
            case _:  # 108
                return struct.pack(">ii", first.speed(now_ns), second.speed(now_ns))

    def _count_and_status(self, motor: _Motor, now_ns: int) -> bytes:
        count = motor.look(now_ns)
        return struct.pack(">IB", count, self._take_flags(motor, now_ns))

    def _take_flags(self, motor: _Motor, now_ns: int) -> int:
        motor.look(now_ns)
        flags, motor.flags = motor.flags, 0
        return flags | (BACKWARD if motor.backward else 0)

    def _all_at_once(self, now_ns: int) -> bytes:
        """Command 73: tick, status, temperatures, batteries, duties, currents, counts, speeds, errors."""
        first, second = self.motors
        heat, (main, logic) = round(10.0 * self.temperature_c), (round(10.0 * v) for v in (self.main_v, self.logic_v))
        return struct.pack(
            ">IIHHHHhhhhIIiiiiHHHH",
            *(now_ns // 1_000_000 % FULL, self.status, heat, heat, main, logic, first.duty, second.duty, 0, 0),
            *(first.look(now_ns), second.look(now_ns), first.speed(now_ns), second.speed(now_ns)),
            *(first.speed(now_ns, RAW_SPEED_WINDOW_NS), second.speed(now_ns, RAW_SPEED_WINDOW_NS), 0, 0, 0, 0),
        )

    # -- writing ------------------------------------------------------------------------------------------------------

    def _write(self, command: int, values: list[int], now_ns: int) -> None:
        if command in self._settings:
            _, read, place = self._settings[command]
            if command in LEAST_BY_BYTE:
                values = [60 + 2 * values[0]]
            elif command in MOST_BY_BYTE:
                values = [round(values[0] / 0.512)]
            self._values[read][1][place : place + len(values)] = values
        elif command in MOVES:
            self._move(command, values, now_ns)
        elif command in MIXED:
            self._mix(command, values[0], now_ns)
        elif command == 20:
            for motor in self.motors:
                motor.set_count(0, now_ns)
        elif command in (22, 23):
            self.motors[command - 22].set_count(values[0], now_ns)
        elif command == 80:
            self._restore()

    def _move(self, command: int, values: list[int], now_ns: int) -> None:
        """Deal the arguments out to the motors: each letter that occurs twice goes to one motor after the other."""
        which, _, letters = MOVES[command]
        dealt: dict[str, list[int]] = {}
        for letter, value in zip(letters, values):
            dealt.setdefault(letter, []).append(value)
        for place, name in enumerate(which):
            told = {letter: given[min(place, len(given) - 1)] for letter, given in dealt.items()}
            self._move_one(self.motors[int(name) - 1], told, now_ns)

    def _mix(self, command: int, value: int, now_ns: int) -> None:
        what, sign, middle = MIXED[command]
        self._mixed[what] = sign * (min(127, value) - middle) / (127.0 - middle)
        ahead, turn = self._mixed["ahead"], self._mixed["turn"]
        for motor, share in zip(self.motors, (ahead + turn, ahead - turn)):
            self._turn(motor, max(-1.0, min(1.0, share)) * self._top, now_ns)

    def _move_one(self, motor: _Motor, told: Mapping[str, int], now_ns: int) -> None:
        if "d" in told:
            return self._turn(motor, told["d"] / 32767.0 * self._top, now_ns)
        if "u" in told or "U" in told:
            share = min(127, told.get("u", 0)) - min(127, told.get("U", 0))
            return self._turn(motor, share / 127.0 * self._top, now_ns)
        if "x" in told:
            return self._turn(motor, (min(127, told["x"]) - 64) / 63.0 * self._top, now_ns)
        speed = float(told.get("s", self._top / 2.0))
        way = told.get("w")
        if "t" in told:
            ahead = signed(told["t"] - motor.look(now_ns), 32)
            speed, way = (abs(speed) if ahead > 0 else -abs(speed)), abs(ahead)
        self._turn(motor, speed if way != 0 else 0.0, now_ns)
        if way and speed:
            motor.stop_ns = now_ns + round(way / abs(speed) * SECOND_NS)
        return None

    def _turn(self, motor: _Motor, ticks_per_s: float, now_ns: int) -> None:
        motor.stop_ns = None
        motor.duty = max(-32767, min(32767, round(32767.0 * ticks_per_s / self._top)))
        motor.wheel.drive(now_ns, ticks_per_s)

    def _stop_in_time(self, now_ns: int) -> None:
        for motor in self.motors:
            if motor.stop_ns is not None and now_ns >= motor.stop_ns:
                self._turn(motor, 0.0, motor.stop_ns)
        if self._timeout_ns and now_ns - self._valid_ns >= self._timeout_ns:
            for motor in self.motors:
                if motor.wheel.commanded_m_s:
                    self._turn(motor, 0.0, now_ns)


def _magnitude(speed: int) -> bytes:
    return struct.pack(">IB", abs(speed) % FULL, 1 if speed < 0 else 0)
