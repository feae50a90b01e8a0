"""A CANopen rotary encoder of device profile CiA 406 on a wheel; a robot has two such nodes.

Source: CiA 301 (application layer: NMT, SDO, PDO, EMCY, error control) and CiA 406 tables as in public encoder
descriptions; exchanges recorded with a third-party master.

    000          NMT command (01 start, 02 stop, 80 pre-operational, 81 reset node, 82 reset communication), node or 0
    080          SYNC                          080+n  emergency
    180+n, 280+n position, cyclic or on change (TPDO1), on SYNC (TPDO2)
    600+n/580+n  SDO request and answer        700+n  boot-up, heartbeat; node guarding by remote frame

Habits kept: PDOs in operational only, TPDO1 also once on entering it; SDO everywhere but in stopped; heartbeat in all
states; 6200h and 1800h:05 are one number; a PDO's mapping is changed while its entry count is 0. With an event timer of
0 TPDO1 goes out when the position changes, no faster than its inhibit time. Reset node restores what 1010h stored.

Assumed: 6002h reads FFFFFFFFh for the full 32-bit range, which wraps at 2**32 (the register cannot hold that), and 0 or
FFFFFFFFh written mean the same; the speed in 6030h:01 is in steps per second, saturated; block transfer is refused.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import floor, pi
from typing import Literal

from sim_devices.device import Frame, Scene
from sim_devices.wire import SECOND_NS

MILLISECOND_NS = 1_000_000
BOOTING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
FULL_RANGE = 1 << 32
SPEED_WINDOW_NS = 10 * MILLISECOND_NS
ON_CHANGE_POLL_NS = 2 * MILLISECOND_NS
PDO_OFF = 1 << 31

NO_OBJECT, NO_SUBINDEX, READ_ONLY, WRITE_ONLY = 0x06020000, 0x06090011, 0x06010002, 0x06010001
WRONG_LENGTH, TOO_LONG, TOO_SHORT, BAD_VALUE = 0x06070010, 0x06070012, 0x06070013, 0x06090030
BAD_COMMAND, BAD_TOGGLE, NOT_MAPPABLE, MAPPING_TOO_LONG = 0x05040001, 0x05030000, 0x06040041, 0x06040042
WRONG_STATE, BAD_STORE = 0x08000022, 0x08000020

SAVE, LOAD = int.from_bytes(b"save", "little"), int.from_bytes(b"load", "little")
MAPPABLE = {(0x6004, 0): 32, (0x6030, 1): 16, (0x6500, 0): 16, (0x6503, 0): 16, (0x6505, 0): 16, (0x1001, 0): 8}
MAX_DOWNLOAD = 1024

Key = tuple[int, int]
Access = Literal["ro", "rw"]


class SdoAbort(Exception):  # noqa: N818 - CiA's word for it
    """A refused SDO transfer."""

    def __init__(self, code: int) -> None:
        super().__init__(f"SDO abort {code:08X}h")
        self.code = code


@dataclass(slots=True)
class _Entry:
    """One object: its number format (struct code; "s" for text), access, value and how a live value is made."""

    form: str
    access: Access
    value: int | bytes = 0
    live: Callable[[int], int] | None = None


@dataclass(slots=True)
class _Transfer:
    """A segmented SDO transfer under way."""

    key: Key
    data: bytearray
    upload: bool
    toggle: int = 0
    size: int | None = None


@dataclass(slots=True)
class _Pdo:
    """When a transmit PDO goes out next."""

    parameters: int  # index of its communication parameters; its mapping is 200h further
    next_ns: int | None = None
    syncs: int = 0
    sent_ns: int | None = None
    sent_data: bytes = b""
    wanted: bool = field(default=False)


class Cia406Encoder:
    """One encoder node. The first step is power-on.

    wheel: whose travel it counts.  gear: encoder turns for each wheel turn.  sign: -1 where the count falls when the
    robot rolls forward.  start_count: its raw position at power-on (to test wraps).  steps_per_turn: physical steps for
    each encoder turn (6501h).  tpdo1_ms: event timer as stored; 0 sends on change.  heartbeat_ms: as stored.
    """

    def __init__(
        self,
        scene: Scene,
        node: int,
        *,
        wheel: Literal["left", "right"] = "left",
        wheel_radius_m: float = 0.1,
        steps_per_turn: int = 4096,
        gear: float = 1.0,
        sign: int = 1,
        start_count: int = 0,
        tpdo1_ms: int = 20,
        heartbeat_ms: int = 0,
        name: str = "UMFELD SIM ENC",
        serial: int = 4711,
        boot_s: float = 0.1,
    ) -> None:
        if not 1 <= node <= 127:
            raise ValueError("a CANopen node number is 1 to 127")
        self.scene = scene
        self.node = node
        self.wheel = wheel
        self.wheel_radius_m = wheel_radius_m
        self.gear = gear
        self.sign = sign
        self.start_count = start_count
        self.frozen_at_ns: int | None = None
        self.state = BOOTING
        self._physical_steps = steps_per_turn
        self._boot_ns = round(boot_s * SECOND_NS)
        self._objects = self._dictionary(tpdo1_ms, heartbeat_ms, name, serial)
        self._stored = self._writable()
        self._delivered = dict(self._stored)
        self._powered = False
        self._begin_boot(0)

    # -- what the bus and the tests see -------------------------------------------------------------------------------

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        """Advance to now_ns; returns the frames it sends, in order."""
        if not self._powered:
            self.power_on(now_ns)
        out: list[Frame] = []
        self._come_up(now_ns, out)
        self._timers(now_ns, out)
        for frame in received:
            self._hear(frame, now_ns, out)
        return out

    @property
    def next_ns(self) -> int | None:
        """When it wants to send next; None while it only waits."""
        due = [self._ready_ns, self._heartbeat_ns, *(pdo.next_ns for pdo in self._pdos)]
        return min((at_ns for at_ns in due if at_ns is not None), default=None)

    def power_on(self, now_ns: int) -> None:
        """The supply came back: stored values, then boot-up."""
        self._powered = True
        self._restore(self._stored)
        self._begin_boot(now_ns)

    def raise_alarm(self, now_ns: int, *, code: int = 0x1000, alarms: int = 0x0001) -> list[Frame]:
        """An internal fault: error register, 6503h, 1003h and an emergency frame. code 0 ends it."""
        self._objects[0x6503, 0].value = alarms if code else 0
        self._objects[0x1001, 0].value = 0x81 if code else 0
        if code:
            self._log_error(code)
        if self.state not in (PRE_OPERATIONAL, OPERATIONAL) or self._number(0x1014, 0) & PDO_OFF:
            return []
        data = struct.pack("<HB5x", code, self._number(0x1001, 0))
        return [Frame(self._number(0x1014, 0) & 0x7FF, data)]

    def position(self, now_ns: int) -> int:
        """The count in 6004h at now_ns."""
        return (self._scaled_steps(now_ns) + self._offset) % self._range()

    # -- position -----------------------------------------------------------------------------------------------------

    def _travel_m(self, now_ns: int) -> float:
        at_ns = now_ns if self.frozen_at_ns is None else min(now_ns, self.frozen_at_ns)
        left_m, right_m = self.scene.wheel_travel_m(at_ns)
        return left_m if self.wheel == "left" else right_m

    def _scaled_steps(self, now_ns: int) -> int:
        """Steps since power-on of the world, in the direction and scale that are set, unlimited."""
        turns = self._travel_m(now_ns) / (2.0 * pi * self.wheel_radius_m) * self.gear
        control = self._number(0x6000, 0)
        steps = floor(turns * self._physical_steps) * self.sign * (-1 if control & 1 else 1)
        if control & 4:
            steps = steps * self._number(0x6001, 0) // self._physical_steps
        return steps + self.start_count

    def _range(self) -> int:
        if not self._number(0x6000, 0) & 4:
            return FULL_RANGE
        total = self._number(0x6002, 0)
        return FULL_RANGE if total in (0, FULL_RANGE - 1) else total

    def _speed(self, now_ns: int) -> int:
        """Steps per second over the last window, saturated to 16 bits."""
        steps = self._scaled_steps(now_ns) - self._scaled_steps(now_ns - SPEED_WINDOW_NS)
        return max(-32768, min(32767, round(steps * SECOND_NS / SPEED_WINDOW_NS)))

    # -- states -------------------------------------------------------------------------------------------------------

    def _begin_boot(self, now_ns: int) -> None:
        self.state = BOOTING
        self._ready_ns: int | None = now_ns + self._boot_ns
        self._heartbeat_ns: int | None = None
        self._guard_toggle = 0
        self._transfer: _Transfer | None = None
        self._pdos = [_Pdo(0x1800), _Pdo(0x1801)]
        self._up_since_ns = now_ns

    def _come_up(self, now_ns: int, out: list[Frame]) -> None:
        if self._ready_ns is not None and now_ns >= self._ready_ns:
            out.append(Frame(0x700 + self.node, b"\0"))
            self.state = PRE_OPERATIONAL
            self._start_heartbeat(self._ready_ns)
            self._ready_ns = None

    def _network_command(self, command: int, now_ns: int, out: list[Frame]) -> None:
        if command == 0x01 and self.state != OPERATIONAL:
            self.state = OPERATIONAL
            for pdo in self._pdos:
                pdo.syncs = 0
                self._schedule(pdo, now_ns)
            self._send_pdo(self._pdos[0], now_ns, out)
        elif command == 0x02:
            self.state = STOPPED
        elif command == 0x80:
            self.state = PRE_OPERATIONAL
        elif command == 0x81:
            self._restore(self._stored)
            self._begin_boot(now_ns)
        elif command == 0x82:
            self._restore({key: value for key, value in self._stored.items() if 0x1000 <= key[0] < 0x2000})
            self._begin_boot(now_ns)
        if self.state != OPERATIONAL:
            for pdo in self._pdos:
                pdo.next_ns = None

    def _start_heartbeat(self, now_ns: int) -> None:
        period_ms = self._number(0x1017, 0)
        self._heartbeat_ns = now_ns + period_ms * MILLISECOND_NS if period_ms else None

    # -- traffic ------------------------------------------------------------------------------------------------------

    def _hear(self, frame: Frame, now_ns: int, out: list[Frame]) -> None:
        if frame.extended or self.state == BOOTING:
            return
        if frame.can_id == 0x000 and len(frame.data) >= 2 and not frame.remote:
            if frame.data[1] in (0, self.node):
                self._network_command(frame.data[0], now_ns, out)
        elif frame.can_id == self._number(0x1005, 0) & 0x7FF and not frame.remote:
            self._synchronise(now_ns, out)
        elif frame.can_id == 0x600 + self.node and not frame.remote:
            if self.state != STOPPED and len(frame.data) == 8:
                answer = self._serve_sdo(frame.data, now_ns)
                if answer is not None:
                    out.append(Frame(0x580 + self.node, answer))
        elif frame.can_id == 0x700 + self.node and frame.remote and self._heartbeat_ns is None:
            out.append(Frame(0x700 + self.node, bytes((self._guard_toggle | self.state,))))
            self._guard_toggle ^= 0x80
        elif frame.remote:
            self._answer_remote(frame.can_id, now_ns, out)

    def _timers(self, now_ns: int, out: list[Frame]) -> None:
        while self._heartbeat_ns is not None and self._heartbeat_ns <= now_ns:
            out.append(Frame(0x700 + self.node, bytes((self.state,))))
            at_ns = self._heartbeat_ns
            self._start_heartbeat(at_ns if now_ns - at_ns < SECOND_NS else now_ns)
        for pdo in self._pdos:
            while pdo.next_ns is not None and pdo.next_ns <= now_ns:
                at_ns = pdo.next_ns if now_ns - pdo.next_ns < SECOND_NS else now_ns
                self._schedule(pdo, at_ns)
                is_newest = pdo.next_ns is None or pdo.next_ns > now_ns
                sampled_ns = now_ns if is_newest else at_ns  # served late: what leaves now was sampled now
                if self._event_timer_ms(pdo) or self._pdo_data(pdo, sampled_ns) != pdo.sent_data:
                    self._send_pdo(pdo, sampled_ns, out)

    # -- PDOs ---------------------------------------------------------------------------------------------------------

    def _event_timer_ms(self, pdo: _Pdo) -> int:
        return self._number(pdo.parameters, 5)

    def _schedule(self, pdo: _Pdo, now_ns: int) -> None:
        """Set when an event-driven PDO is looked at next."""
        pdo.next_ns = None
        if self.state != OPERATIONAL or self._number(pdo.parameters, 2) < 254 or self._is_off(pdo):
            return
        timer_ns = self._event_timer_ms(pdo) * MILLISECOND_NS
        inhibit_ns = self._number(pdo.parameters, 3) * 100_000
        pdo.next_ns = now_ns + max(timer_ns or ON_CHANGE_POLL_NS, inhibit_ns)

    def _is_off(self, pdo: _Pdo) -> bool:
        return bool(self._number(pdo.parameters, 1) & PDO_OFF)

    def _pdo_data(self, pdo: _Pdo, now_ns: int) -> bytes:
        mapping = pdo.parameters + 0x200
        words = (self._number(mapping, i + 1) for i in range(self._number(mapping, 0)))
        return b"".join(self._raw((word >> 16, word >> 8 & 0xFF), now_ns) for word in words)

    def _send_pdo(self, pdo: _Pdo, now_ns: int, out: list[Frame]) -> None:
        if self.state == OPERATIONAL and not self._is_off(pdo):
            pdo.sent_data = self._pdo_data(pdo, now_ns)
            out.append(Frame(self._number(pdo.parameters, 1) & 0x7FF, pdo.sent_data))

    def _synchronise(self, now_ns: int, out: list[Frame]) -> None:
        for pdo in self._pdos:
            kind = self._number(pdo.parameters, 2)
            if kind == 0:
                if self._pdo_data(pdo, now_ns) != pdo.sent_data:
                    self._send_pdo(pdo, now_ns, out)
            elif kind <= 240:
                pdo.syncs += 1
                if pdo.syncs >= kind:
                    pdo.syncs = 0
                    self._send_pdo(pdo, now_ns, out)

    def _answer_remote(self, can_id: int, now_ns: int, out: list[Frame]) -> None:
        for pdo in self._pdos:
            if self._number(pdo.parameters, 1) & 0x7FF == can_id:
                self._send_pdo(pdo, now_ns, out)

    # -- SDO server ---------------------------------------------------------------------------------------------------

    def _serve_sdo(self, request: bytes, now_ns: int) -> bytes | None:
        key = (int.from_bytes(request[1:3], "little"), request[3])
        command = request[0] >> 5
        try:
            if command == 0:
                return self._download_segment(request, now_ns)
            if command == 1:
                return self._begin_download(request, key, now_ns)
            if command == 2:
                return self._begin_upload(key, now_ns)
            if command == 3:
                return self._upload_segment(request)
            if command == 4:  # the client gives up
                self._transfer = None
                return None
            raise SdoAbort(BAD_COMMAND)
        except SdoAbort as refusal:
            if command in (0, 3):
                key = self._transfer.key if self._transfer is not None else (0, 0)
            self._transfer = None
            return struct.pack("<BHBI", 0x80, *key, refusal.code)

    def _begin_upload(self, key: Key, now_ns: int) -> bytes:
        data = self._raw(key, now_ns)
        if len(data) <= 4:
            return struct.pack("<BHB", 0x43 | (4 - len(data)) << 2, *key) + data.ljust(4, b"\0")
        self._transfer = _Transfer(key, bytearray(data), upload=True)
        return struct.pack("<BHBI", 0x41, *key, len(data))

    def _upload_segment(self, request: bytes) -> bytes:
        transfer = self._expected(request, upload=True)
        part = bytes(transfer.data[:7])
        del transfer.data[:7]
        last = 0 if transfer.data else 1
        if last:
            self._transfer = None
        head = request[0] & 0x10 | (7 - len(part)) << 1 | last
        return bytes((head,)) + part.ljust(7, b"\0")

    def _begin_download(self, request: bytes, key: Key, now_ns: int) -> bytes:
        entry = self._entry(key)
        if entry.access == "ro":
            raise SdoAbort(READ_ONLY)
        if request[0] & 2:  # expedited
            size = 4 - (request[0] >> 2 & 3) if request[0] & 1 else struct.calcsize("<" + entry.form)
            self._write(key, request[4 : 4 + size], now_ns)
        else:
            size_told = int.from_bytes(request[4:8], "little") if request[0] & 1 else None
            if size_told is not None and size_told > MAX_DOWNLOAD:
                raise SdoAbort(TOO_LONG)
            self._transfer = _Transfer(key, bytearray(), upload=False, size=size_told)
        return struct.pack("<BHB4x", 0x60, *key)

    def _download_segment(self, request: bytes, now_ns: int) -> bytes:
        transfer = self._expected(request, upload=False)
        transfer.data += request[1 : 8 - (request[0] >> 1 & 7)]
        if len(transfer.data) > MAX_DOWNLOAD:
            raise SdoAbort(TOO_LONG)
        if request[0] & 1:
            if transfer.size is not None and transfer.size != len(transfer.data):
                raise SdoAbort(WRONG_LENGTH)
            self._write(transfer.key, bytes(transfer.data), now_ns)
            self._transfer = None
        return bytes((0x20 | request[0] & 0x10,)).ljust(8, b"\0")

    def _expected(self, request: bytes, *, upload: bool) -> _Transfer:
        """The transfer a segment belongs to, its toggle bit checked and turned."""
        transfer = self._transfer
        if transfer is None or transfer.upload != upload:
            raise SdoAbort(BAD_COMMAND)
        if request[0] & 0x10 != transfer.toggle:
            raise SdoAbort(BAD_TOGGLE)
        transfer.toggle ^= 0x10
        return transfer

    # -- object dictionary --------------------------------------------------------------------------------------------

    def _entry(self, key: Key) -> _Entry:
        entry = self._objects.get(key)
        if entry is None:
            raise SdoAbort(NO_SUBINDEX if (key[0], 0) in self._objects else NO_OBJECT)
        return entry

    def _number(self, index: int, sub: int) -> int:
        value = self._objects[index, sub].value
        assert isinstance(value, int)
        return value

    def _raw(self, key: Key, now_ns: int) -> bytes:
        """An object's value as it goes over the bus."""
        entry = self._entry(key)
        value = entry.value if entry.live is None else entry.live(now_ns)
        return value if isinstance(value, bytes) else struct.pack("<" + entry.form, value)

    def _write(self, key: Key, data: bytes, now_ns: int) -> None:
        entry = self._entry(key)
        size = struct.calcsize("<" + entry.form)
        if len(data) != size:
            raise SdoAbort(TOO_LONG if len(data) > size else TOO_SHORT)
        (value,) = struct.unpack("<" + entry.form, data)
        self._check_write(key, value)
        entry.value = value
        self._after_write(key, value, now_ns)

    def _check_write(self, key: Key, value: int) -> None:
        """Refuse values that an object cannot take."""
        index, sub = key
        if index == 0x1003 and value != 0:
            raise SdoAbort(BAD_VALUE)
        if (index == 0x1010 and value != SAVE) or (index == 0x1011 and value != LOAD):
            raise SdoAbort(BAD_STORE)
        if index == 0x6001 and value == 0:
            raise SdoAbort(BAD_VALUE)
        if index == 0x6003 and value >= self._range():
            raise SdoAbort(BAD_VALUE)
        if index in (0x1800, 0x1801) and sub == 2 and 241 <= value <= 251:
            raise SdoAbort(BAD_VALUE)
        if index in (0x1A00, 0x1A01):
            self._check_mapping(index, sub, value)

    def _check_mapping(self, index: int, sub: int, value: int) -> None:
        if sub == 0:
            if value > 8:
                raise SdoAbort(BAD_VALUE)
            words = [self._number(index, i + 1) for i in range(value)]
            if any(word == 0 for word in words):
                raise SdoAbort(NOT_MAPPABLE)
            if sum(word & 0xFF for word in words) > 64:
                raise SdoAbort(MAPPING_TOO_LONG)
            return
        if self._number(index, 0) != 0:
            raise SdoAbort(WRONG_STATE)
        if value and MAPPABLE.get((value >> 16, value >> 8 & 0xFF)) != value & 0xFF:
            raise SdoAbort(NOT_MAPPABLE)

    def _after_write(self, key: Key, value: int, now_ns: int) -> None:
        """What a new value sets going."""
        index = key[0]
        if index == 0x1003:
            self._errors.clear()
        elif index == 0x1010:
            self._stored = self._writable()
        elif index == 0x1011:
            self._stored = dict(self._delivered)
        elif index == 0x1017:
            self._start_heartbeat(now_ns)
        elif key == (0x1800, 5):
            self._objects[0x6200, 0].value = value
        elif index == 0x6200:
            self._objects[0x1800, 5].value = value
        elif index == 0x6003:
            self._offset = value - self._scaled_steps(now_ns)
        if index in (0x1800, 0x1801, 0x6200):
            for pdo in self._pdos:
                self._schedule(pdo, now_ns)

    def _log_error(self, code: int) -> None:
        self._errors.insert(0, code)
        del self._errors[4:]

    def _error_entry(self, place: int) -> Callable[[int], int]:
        return lambda _: self._errors[place] if place < len(self._errors) else 0

    def _writable(self) -> dict[Key, int | bytes]:
        """All that 1010h stores."""
        values = {key: entry.value for key, entry in self._objects.items() if entry.access == "rw"}
        return values | {(0, 0): self._offset}

    def _restore(self, stored: dict[Key, int | bytes]) -> None:
        for key, value in stored.items():
            if key == (0, 0):
                assert isinstance(value, int)
                self._offset = value
            else:
                self._objects[key].value = value

    def _dictionary(self, tpdo1_ms: int, heartbeat_ms: int, name: str, serial: int) -> dict[Key, _Entry]:
        self._offset = 0
        self._errors: list[int] = []
        node = self.node
        objects = {
            (0x1000, 0): _Entry("I", "ro", 0x00020196),  # multi-turn absolute rotary encoder, profile 406
            (0x1001, 0): _Entry("B", "ro", 0),
            (0x1003, 0): _Entry("B", "rw", live=lambda _: len(self._errors)),
            (0x1005, 0): _Entry("I", "rw", 0x80),
            (0x1008, 0): _Entry("s", "ro", name.encode("ascii")),
            (0x1009, 0): _Entry("s", "ro", b"1.00"),
            (0x100A, 0): _Entry("s", "ro", b"1.04"),
            (0x100C, 0): _Entry("H", "rw", 0),
            (0x100D, 0): _Entry("B", "rw", 0),
            (0x1010, 0): _Entry("B", "ro", 1),
            (0x1010, 1): _Entry("I", "rw", live=lambda _: 1),
            (0x1011, 0): _Entry("B", "ro", 1),
            (0x1011, 1): _Entry("I", "rw", live=lambda _: 1),
            (0x1014, 0): _Entry("I", "rw", 0x80 + node),
            (0x1017, 0): _Entry("H", "rw", heartbeat_ms),
            (0x1018, 0): _Entry("B", "ro", 4),
            (0x1018, 1): _Entry("I", "ro", 0x5EED),
            (0x1018, 2): _Entry("I", "ro", 406),
            (0x1018, 3): _Entry("I", "ro", 0x00010004),
            (0x1018, 4): _Entry("I", "ro", serial),
            (0x1200, 0): _Entry("B", "ro", 2),
            (0x1200, 1): _Entry("I", "ro", 0x600 + node),
            (0x1200, 2): _Entry("I", "ro", 0x580 + node),
            (0x6000, 0): _Entry("H", "rw", 4),
            (0x6001, 0): _Entry("I", "rw", self._physical_steps),
            (0x6002, 0): _Entry("I", "rw", FULL_RANGE - 1),
            (0x6003, 0): _Entry("I", "rw", 0),
            (0x6004, 0): _Entry("I", "ro", live=self.position),
            (0x6030, 0): _Entry("B", "ro", 1),
            (0x6030, 1): _Entry("h", "ro", live=self._speed),
            (0x6031, 0): _Entry("B", "ro", 1),
            (0x6031, 1): _Entry("B", "ro", 1),
            (0x6200, 0): _Entry("H", "rw", tpdo1_ms),
            (0x6500, 0): _Entry("H", "ro", live=lambda _: self._number(0x6000, 0)),
            (0x6501, 0): _Entry("I", "ro", self._physical_steps),
            (0x6502, 0): _Entry("H", "ro", min(0xFFFF, FULL_RANGE // self._physical_steps)),
            (0x6503, 0): _Entry("H", "ro", 0),
            (0x6504, 0): _Entry("H", "ro", 0x0001),
            (0x6505, 0): _Entry("H", "ro", 0),
            (0x6506, 0): _Entry("H", "ro", 0),
            (0x6507, 0): _Entry("I", "ro", 0x01040302),  # profile 3.2, software 1.4
            (0x6508, 0): _Entry("I", "ro", live=lambda now_ns: (now_ns - self._up_since_ns) // (360 * SECOND_NS)),
            (0x6509, 0): _Entry("i", "ro", live=lambda _: (self._offset + (1 << 31)) % FULL_RANGE - (1 << 31)),
            (0x650A, 0): _Entry("B", "ro", 3),
            (0x650A, 1): _Entry("i", "ro", 0),
            (0x650A, 2): _Entry("i", "ro", 0),
            (0x650A, 3): _Entry("i", "ro", 0),
            (0x650B, 0): _Entry("I", "ro", serial),
            (0x650C, 0): _Entry("I", "ro", 0),
            (0x650D, 0): _Entry("B", "ro", 0),
        }
        objects |= {(0x1003, i + 1): _Entry("I", "ro", live=self._error_entry(i)) for i in range(4)}
        for number, can_id, kind, timer_ms in ((0, 0x180, 254, tpdo1_ms), (1, 0x280, 1, 0)):
            objects |= {
                (0x1800 + number, 0): _Entry("B", "ro", 5),
                (0x1800 + number, 1): _Entry("I", "rw", can_id + node),
                (0x1800 + number, 2): _Entry("B", "rw", kind),
                (0x1800 + number, 3): _Entry("H", "rw", 0),
                (0x1800 + number, 5): _Entry("H", "rw", timer_ms),
                (0x1A00 + number, 0): _Entry("B", "rw", 1),
                (0x1A00 + number, 1): _Entry("I", "rw", 0x60040020),
            }
            objects |= {(0x1A00 + number, i): _Entry("I", "rw", 0) for i in range(2, 9)}
        return objects
