"""A VESC motor controller on CAN: status frames of one motor, sent by itself, and the commands that drive it.

Source: vedderb/bldc, comm_can.c, commands.c and datatypes.h; big-endian, 29-bit id = packet << 8 | controller id.

     9 status    i32 ERPM, i16 current * 10, i16 duty * 1000      14, 15  amp, watt hours * 1e4: i32 used, i32 charged
    16 status 4  i16 FET temp * 10, i16 motor temp * 10, i16 input current * 10, i16 position * 50
    27 status 5  i32 tachometer, i16 input voltage * 10, i16 0    58  status 6: three inputs and PPM, i16 * 1000
     0 duty * 1e5, 1 current, 2 brake, 3 ERPM: i32                17  ping [own id] -> 18 pong
     8 a message of its serial protocol, up to 6 bytes: [asker's id, how to answer, message]
     5 a longer one in parts: [offset, up to 7 bytes], then 7: [own id, 1, u16 length, CRC-16]

Of the serial protocol it answers what hosts on CAN ask: firmware version (0), values (4) and chosen values (50); and
obeys duty, current, brake and ERPM (5 to 8).

Habits kept: the tachometer counts six steps for each electrical turn and is signed 32 bits, 0 after power-on; commands
hold for a second, then the motor is released.

Assumed: currents and energies are 0; a released motor stops at once; current commands turn nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from math import floor

from sim_devices.checksums import crc16_ccitt
from sim_devices.device import Frame
from sim_devices.wheel import Undo, Wheel, signed
from sim_devices.wire import SECOND_NS

STATUS, STATUS_2, STATUS_3, STATUS_4, STATUS_5, STATUS_6 = 9, 14, 15, 16, 27, 58
SET_DUTY, SET_CURRENT, SET_BRAKE, SET_RPM, PING, PONG = 0, 1, 2, 3, 17, 18
FILL_BUFFER, PROCESS_BUFFER, PROCESS_SHORT = 5, 7, 8
ANSWER_TO_ASKER = 0  # other ways: none, or to whom it was passed on from
COMM_VERSION, COMM_VALUES, COMM_CHOSEN_VALUES = 0, 4, 50
COMM_SET_DUTY, COMM_SET_CURRENT, COMM_SET_BRAKE, COMM_SET_RPM = 5, 6, 7, 8
FIRMWARE = (6, 2)
HARDWARE = b"60\0"
STEPS_PER_ELECTRICAL_TURN = 6
BOOT_NS = SECOND_NS // 2
HOLD_NS = SECOND_NS


class Vesc:
    """One controller. The first step is power-on.

    wheel: what its motor turns.  gear: motor turns for each turn of the wheel.  sign: -1 for a motor mounted the other
    way round.  rates_hz: how often each status is sent; 0 or left out: not at all.
    """

    fault_family = "encoder"

    def __init__(
        self,
        wheel: Wheel,
        controller: int,
        *,
        pole_pairs: int = 7,
        gear: float = 1.0,
        sign: int = 1,
        rates_hz: Mapping[int, float] | None = None,
        input_v: float = 24.0,
        top_erpm: float = 30000.0,
        start_count: int = 0,
    ) -> None:
        if not 0 <= controller <= 254:
            raise ValueError("a VESC has a controller id from 0 to 254")
        self.wheel = wheel
        self.controller = controller
        self.input_v = input_v
        self._electrical = pole_pairs * gear * sign  # turns for each turn of the wheel
        rates = {STATUS: 50.0, STATUS_4: 50.0, STATUS_5: 50.0} if rates_hz is None else rates_hz
        self._period_ns = {packet: round(SECOND_NS / rate) for packet, rate in rates.items() if rate > 0}
        self._top_erpm = top_erpm
        self._start_count = start_count
        self._powered = False
        self._begin(0)

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        """Advance to now_ns; returns the frames it sends, in order."""
        if not self._powered:
            self.power_on(now_ns)
        out: list[Frame] = []
        if self._release_ns is not None and now_ns >= self._release_ns:
            self._drive(0.0, self._release_ns)
        while self._due_ns and (at_ns := min(self._due_ns.values())) <= now_ns:
            for packet, due_ns in sorted(self._due_ns.items()):
                if due_ns == at_ns:
                    at = now_ns if now_ns - at_ns > SECOND_NS else at_ns
                    out.append(self._frame(packet, self._status(packet, at)))
                    self._due_ns[packet] = at + self._period_ns[packet]
        if now_ns >= self._awake_ns:
            for frame in received:
                self._hear(frame, now_ns, out)
        return out

    @property
    def next_ns(self) -> int | None:
        """When it wants to send next, or lets go of its motor."""
        due = [*self._due_ns.values()] + ([] if self._release_ns is None else [self._release_ns])
        return min(due, default=None)

    def power_on(self, now_ns: int) -> None:
        """The tachometer starts at 0, the motor stands."""
        self._powered = True
        self._begin(now_ns)
        self._awake_ns = now_ns + BOOT_NS
        self._due_ns.update(dict.fromkeys(self._period_ns, self._awake_ns))
        self._zero = self._steps(now_ns) - self._start_count
        self._drive(0.0, now_ns)

    def tachometer(self, now_ns: int) -> int:
        """Six steps an electrical turn, since power-on; without any limit."""
        return self._steps(now_ns) - self._zero

    def inflict(self, kind: str, value: float, arguments: Mapping[str, float], now_ns: int) -> Undo | None:
        """See wheel.Faulty."""
        if kind == "reset":
            self.power_on(now_ns)
        elif kind == "wrap":
            end = -(1 << 31) + round(value) if arguments.get("down") else (1 << 31) - round(value)
            self._zero = self._steps(now_ns) - end
        return None

    def _begin(self, now_ns: int) -> None:
        self._awake_ns = now_ns
        self._due_ns: dict[int, int] = {}
        self._release_ns: int | None = None
        self._zero = 0

    def _steps(self, now_ns: int) -> int:
        return floor(self.wheel.turns(now_ns) * self._electrical * STEPS_PER_ELECTRICAL_TURN)

    def _erpm(self, now_ns: int) -> int:
        window_ns = 10_000_000
        turned = self.wheel.turns(now_ns) - self.wheel.turns(now_ns - window_ns)
        return round(60.0 * turned * self._electrical * SECOND_NS / window_ns)

    def _frame(self, packet: int, data: bytes) -> Frame:
        return Frame(packet << 8 | self.controller, data, extended=True)

    def _status(self, packet: int, now_ns: int) -> bytes:
        if packet == STATUS:
            erpm = self._erpm(now_ns)
            return struct.pack(">ihh", erpm, 0, max(-1000, min(1000, round(1000.0 * erpm / self._top_erpm))))
        if packet == STATUS_4:
            degrees = self.wheel.turns(now_ns) * self._electrical * 360.0 % 360.0
            return struct.pack(">hhhh", 300, 250, 0, floor(degrees * 50.0))
        if packet == STATUS_5:
            return struct.pack(">ihh", signed(self.tachometer(now_ns), 32), round(10.0 * self.input_v), 0)
        return bytes(8)

    def _hear(self, frame: Frame, now_ns: int, out: list[Frame]) -> None:
        if not frame.extended or frame.remote or frame.can_id & 0xFF not in (self.controller, 0xFF):
            return
        packet = frame.can_id >> 8
        if packet == PING and frame.data:
            out.append(Frame(PONG << 8 | frame.data[0], bytes((self.controller, 0)), extended=True))
        elif packet in (SET_DUTY, SET_CURRENT, SET_BRAKE, SET_RPM) and len(frame.data) >= 4:
            self._obey(packet, frame.data, now_ns)
        elif packet == PROCESS_SHORT and len(frame.data) >= 3:
            self._take_message(frame.data[0], frame.data[1], frame.data[2], frame.data[3:], now_ns, out)

    def _obey(self, packet: int, data: bytes, now_ns: int) -> None:
        value = struct.unpack(">i", data[:4])[0]
        erpm = {SET_DUTY: value / 1e5 * self._top_erpm, SET_RPM: float(value)}.get(packet, 0.0)
        self._drive(max(-self._top_erpm, min(self._top_erpm, erpm)), now_ns)
        self._release_ns = now_ns + HOLD_NS

    def _take_message(self, asker: int, way: int, kind: int, data: bytes, now_ns: int, out: list[Frame]) -> None:
        """A message of the serial protocol that came over CAN."""
        if COMM_SET_DUTY <= kind <= COMM_SET_RPM and len(data) >= 4:
            self._obey(kind - COMM_SET_DUTY + SET_DUTY, data, now_ns)
        elif way == ANSWER_TO_ASKER:
            if kind == COMM_VERSION:
                identity = self.controller.to_bytes(12, "big")
                flags, name, code = bytes(8), b"\0", bytes(4)
                self._answer(asker, bytes((kind, *FIRMWARE)) + HARDWARE + identity + flags + name + code, out)
            elif kind == COMM_VALUES:
                self._answer(asker, bytes((kind,)) + self._values((1 << 32) - 1, now_ns), out)
            elif kind == COMM_CHOSEN_VALUES and len(data) >= 4:
                chosen = int.from_bytes(data[:4], "big")
                self._answer(asker, bytes((kind,)) + data[:4] + self._values(chosen, now_ns), out)

    def _answer(self, asker: int, message: bytes, out: list[Frame]) -> None:
        """In parts of seven bytes; none of its answers is longer than the 255 that these can number."""
        for at in range(0, len(message), 7):
            part = bytes((at,)) + message[at : at + 7]
            out.append(Frame(FILL_BUFFER << 8 | asker, part, extended=True))
        end = struct.pack(">BBHH", self.controller, 1, len(message), crc16_ccitt(message))
        out.append(Frame(PROCESS_BUFFER << 8 | asker, end, extended=True))

    def _values(self, chosen: int, now_ns: int) -> bytes:
        """The values whose bits are set, in order."""
        tachometer = signed(self.tachometer(now_ns), 32)
        duty = max(-1000, min(1000, round(1000.0 * self._erpm(now_ns) / self._top_erpm)))
        position = round(1e6 * (self.wheel.turns(now_ns) * self._electrical * 360.0 % 360.0))
        values: tuple[tuple[str, tuple[int, ...]], ...] = (
            ("h", (300,)), ("h", (250,)),  # temperatures
            ("i", (0,)), ("i", (0,)), ("i", (0,)), ("i", (0,)),  # currents
            ("h", (duty,)), ("i", (self._erpm(now_ns),)), ("h", (round(10.0 * self.input_v),)),
            ("i", (0,)), ("i", (0,)), ("i", (0,)), ("i", (0,)),  # amp and watt hours
            ("i", (tachometer,)), ("i", (abs(tachometer),)), ("B", (0,)),  # fault
            ("i", (position,)), ("B", (self.controller,)), ("3h", (300, 300, 300)),
            ("i", (0,)), ("i", (0,)), ("B", (0,)),  # voltages, status
        )  # fmt: skip
        return b"".join(struct.pack(">" + form, *told) for k, (form, told) in enumerate(values) if chosen >> k & 1)

    def _drive(self, erpm: float, now_ns: int) -> None:
        self._release_ns = None
        self.wheel.drive(now_ns, erpm / 60.0 / self._electrical * self.wheel.ticks_per_turn)
