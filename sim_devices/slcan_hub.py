"""An emulated CAN bus: emulated nodes inside, and one slcan adapter with its own serial port for each host.

Source: the Lawicel CAN232 and CANUSB command sets. Every command ends with CR; done is CR, refused is BEL.

    S0..S8  bit rate, closed only    s....  bit timing registers, closed only    O, L  open, listen only    C  close
    t, T    send a frame (z, Z)      r, R   send a remote frame                  V, N  version, serial number
    F       status flags, open only  Z0/Z1  time stamps in received frames       empty line: CR, nothing happens

Habits kept: the sender does not hear its own frame; a second O is refused and changes nothing; what a full serial
queue cannot take is dropped by whole lines and counted, as an adapter overruns; an adapter opened at another bit rate
than the bus neither sends nor hears and its flags say bus error. An adapter opened without S takes the bus's rate.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from sim_devices.attach import MOST_OWED, OWED_NS, STEP_NS, Link, PortOf
from sim_devices.device import ByteDevice, CanDevice, Frame
from sim_devices.wire import SECOND_NS

CR, BEL = b"\r", b"\x07"
MAX_LINE = 32
BITRATES = {0: 10_000, 1: 20_000, 2: 50_000, 3: 100_000, 4: 125_000, 5: 250_000, 6: 500_000, 7: 800_000, 8: 1_000_000}
MAX_ROUNDS = 16  # of answers to answers within one step
FLAG_OVERRUN, FLAG_WARNING, FLAG_PASSIVE, FLAG_BUS_ERROR = 0x08, 0x04, 0x20, 0x80
HEX = frozenset(b"0123456789ABCDEFabcdef")


class Disturbance(Protocol):
    """What stands between the nodes of a bus and their wires."""

    is_dark: bool  # the nodes have no supply

    def begin(self, now_ns: int) -> None:
        """Told before the nodes are stepped."""

    def carried(self, moved: Sequence[tuple[object, Frame]], now_ns: int) -> list[tuple[object, Frame]]:
        """What of these frames, each with its sender, arrives now."""

    @property
    def next_ns(self) -> int | None:
        """When it wants to be asked again."""


@dataclass(slots=True)
class BusCounters:
    """What happened on the bus, or at one adapter."""

    frames: int = 0
    dropped_lines: int = 0
    refused: int = 0
    lost_to_bitrate: int = 0


class SlcanAdapter:
    """One adapter: a serial port on one side (a ByteDevice), the bus on the other.

    bus_off may be set at any time: the adapter then refuses to send and hears nothing until it is closed and reopened.
    plugged: whether it is plugged into its host.
    """

    def __init__(self, bus: CanBus, *, version: str = "1013", serial: str = "A123") -> None:
        self.counters = BusCounters()
        self.plugged = True
        self.bus_off = False
        self._bus = bus
        self._version = version.encode("ascii")
        self._serial = serial.encode("ascii")
        self.power_on(0)

    def power_on(self, now_ns: int) -> None:
        """Closed, no bit rate chosen, nothing queued."""
        self.is_open = False
        self.listen_only = False
        self.bus_off = False
        self._bitrate_bps: int | None = None
        self._stamps = False
        self._flags = 0
        self._buffer = bytearray()
        self._to_host = bytearray()
        self._now_ns = now_ns

    @property
    def hears(self) -> bool:
        """Whether frames of the bus reach it."""
        return self.is_open and not self.bus_off and self._fits_bus()

    @property
    def has_output(self) -> bool:
        """Whether something waits to go to the host."""
        return bool(self._to_host)

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Obey the host's commands; returns the replies, and the frames heard since."""
        self._now_ns = now_ns
        self._buffer += received
        while (end := self._buffer.find(b"\r")) >= 0:
            line = bytes(self._buffer[:end]).lstrip(b"\n")
            del self._buffer[: end + 1]
            self._to_host += self._obey(line)
        if len(self._buffer) > MAX_LINE:
            self._buffer.clear()
            self._to_host += self._refused()
        out = bytes(self._to_host)
        self._to_host.clear()
        return out

    def hear(self, frame: Frame) -> None:
        """A frame of the bus."""
        if not self.hears:
            return
        letter = ("R" if frame.extended else "r") if frame.remote else ("T" if frame.extended else "t")
        length = frame.dlc if frame.remote and frame.dlc is not None else len(frame.data)
        text = f"{letter}{frame.can_id:0{8 if frame.extended else 3}X}{length:X}{frame.data.hex().upper()}"
        if self._stamps:
            text += f"{self._now_ns // 1_000_000 % 60_000:04X}"
        self._to_host += text.encode("ascii") + CR

    def note_overrun(self, lines: int) -> None:
        """Lines that its serial port could not take."""
        self.counters.dropped_lines += lines
        self._flags |= FLAG_OVERRUN

    def _fits_bus(self) -> bool:
        return self._bitrate_bps is None or self._bitrate_bps == self._bus.bitrate_bps

    def _refused(self) -> bytes:
        self.counters.refused += 1
        return BEL

    def _obey(self, line: bytes) -> bytes:
        if not line:
            return CR
        letter, rest = line[:1], line[1:]
        if letter in (b"t", b"T", b"r", b"R"):
            return self._transmit(letter, rest)
        accepted = False
        match letter:
            case b"V" if not rest:
                return b"V" + self._version + CR
            case b"N" if not rest:
                return b"N" + self._serial + CR
            case b"F" if not rest and self.is_open:
                return b"F%02X" % self._read_flags() + CR
            case b"S" if rest.isdigit() and int(rest) in BITRATES and not self.is_open:
                self._bitrate_bps = BITRATES[int(rest)]
                accepted = True
            case b"s" if len(rest) == 4 and HEX.issuperset(rest) and not self.is_open:
                self._bitrate_bps = None  # register values of an unknown clock: taken to fit
                accepted = True
            case b"O" | b"L" if not rest and not self.is_open:
                self.is_open, self.listen_only, self.bus_off = True, letter == b"L", False
                self._flags = 0
                accepted = True
            case b"C" if not rest and self.is_open:
                self.is_open = False
                accepted = True
            case b"Z" if rest in (b"0", b"1"):
                self._stamps = rest == b"1"
                accepted = True
            case b"M" | b"m" if len(rest) == 8 and HEX.issuperset(rest) and not self.is_open:
                accepted = True  # acceptance filter: known, everything passes
        return CR if accepted else self._refused()

    def _transmit(self, letter: bytes, rest: bytes) -> bytes:
        frame = parsed_frame(letter, rest)
        if frame is None or not self.is_open or self.listen_only or self.bus_off:
            return self._refused()
        if self._fits_bus():
            self._bus.send(self, frame)
        else:
            self.counters.lost_to_bitrate += 1
            self._flags |= FLAG_BUS_ERROR | FLAG_PASSIVE | FLAG_WARNING
        return (b"Z" if frame.extended else b"z") + CR

    def _read_flags(self) -> int:
        flags, self._flags = self._flags, 0
        return flags | (FLAG_BUS_ERROR | FLAG_PASSIVE if self.bus_off else 0)


def parsed_frame(letter: bytes, rest: bytes) -> Frame | None:
    """The frame of a t, T, r or R command, None if it is not well formed."""
    extended, remote = letter in b"TR", letter in b"rR"
    digits = 8 if extended else 3
    if len(rest) < digits + 1 or not HEX.issuperset(rest):
        return None
    can_id, length = int(rest[:digits], 16), int(rest[digits : digits + 1], 16)
    data = rest[digits + 1 :]
    if length > 8 or can_id > (0x1FFFFFFF if extended else 0x7FF):
        return None
    if len(data) != (0 if remote else 2 * length):
        return None
    if remote:
        return Frame(can_id, extended=extended, remote=True, dlc=length)
    return Frame(can_id, bytes.fromhex(data.decode("ascii")), extended=extended)


class CanBus:
    """The bus itself, pure: nodes and adapters, each frame to all but its sender.

    bitrate_bps: what an adapter must be opened with.  paced: frames take their time and the lowest id goes first;
    otherwise they arrive at once, in the order they were sent.
    """

    def __init__(self, *, bitrate_bps: int = 1_000_000, paced: bool = False) -> None:
        self.bitrate_bps = bitrate_bps
        self.counters = BusCounters()
        self.nodes: dict[str, CanDevice] = {}
        self.adapters: dict[str, SlcanAdapter] = {}
        self.disturbance: Disturbance | None = None
        self._paced = paced
        self._free_ns = 0
        self._sequence = 0
        self._now_ns = 0
        self._waiting: list[tuple[int, int, int, object, Frame]] = []  # arbitration rank, order, since, sender, frame

    def add_node(self, name: str, node: CanDevice) -> None:
        """Put an emulated node on the bus."""
        self.nodes[name] = node

    def add_adapter(self, name: str) -> SlcanAdapter:
        """Put a host's adapter on the bus."""
        adapter = SlcanAdapter(self)
        self.adapters[name] = adapter
        return adapter

    def send(self, sender: object, frame: Frame) -> None:
        """Queue a frame; `exchange` carries it to the others."""
        rank = 0 if not self._paced else frame.can_id << (0 if frame.extended else 18)
        heapq.heappush(self._waiting, (rank, self._sequence, self._now_ns, sender, frame))
        self._sequence += 1

    def exchange(self, now_ns: int) -> None:
        """Step all nodes to now_ns and carry frames until the bus is quiet, or busy past now_ns."""
        self._now_ns = now_ns
        if self.disturbance is not None:
            self.disturbance.begin(now_ns)
            if self.disturbance.is_dark:
                self._waiting.clear()
                return
        for node in self.nodes.values():
            for frame in node.step(now_ns, ()):
                self.send(node, frame)
        for _ in range(MAX_ROUNDS):
            moved = self._take(now_ns)
            if self.disturbance is not None:
                moved = self.disturbance.carried(moved, now_ns)
            if not moved:
                return
            for sender, frame in moved:
                for adapter in self.adapters.values():
                    if adapter is not sender:
                        adapter.hear(frame)
            for node in self.nodes.values():
                heard = [frame for sender, frame in moved if sender is not node]
                for answer in node.step(now_ns, heard) if heard else ():
                    self.send(node, answer)

    @property
    def next_ns(self) -> int | None:
        """When a node or a frame under way wants to be served."""
        if self.disturbance is not None and self.disturbance.is_dark:
            return self.disturbance.next_ns
        due = [at_ns for node in self.nodes.values() if (at_ns := getattr(node, "next_ns", None)) is not None]
        if self._waiting:
            due.append(self._end_of_first_ns())
        return min(due, default=None)

    def _take(self, now_ns: int) -> list[tuple[object, Frame]]:
        """The frames that have crossed the bus by now."""
        if not self._paced:
            moved = [(sender, frame) for *_, sender, frame in sorted(self._waiting, key=lambda item: item[1])]
            self._waiting.clear()
            self.counters.frames += len(moved)
            return moved
        moved = []
        while self._waiting and (end_ns := self._end_of_first_ns()) <= now_ns:
            *_, sender, frame = heapq.heappop(self._waiting)
            self._free_ns = end_ns
            moved.append((sender, frame))
            self.counters.frames += 1
        return moved

    def _end_of_first_ns(self) -> int:
        _, _, since_ns, _, frame = self._waiting[0]
        return since_ns if not self._paced else max(self._free_ns, since_ns) + self._frame_ns(frame)

    def _frame_ns(self, frame: Frame) -> int:
        """Time on the wire, with the stuff bits of an average frame."""
        bits = (67 if frame.extended else 47) + 8 * len(frame.data)
        return round(bits * 1.1) * SECOND_NS // self.bitrate_bps


class CanBusStation:
    """The bus in the attachment's loop: an adapter's serial port for each host, under its member's name."""

    def __init__(self, bus: CanBus) -> None:
        self.bus = bus
        self._members: dict[str, _Member] = {}

    def add_member(self, name: str, link: Link, device: ByteDevice | None = None) -> SlcanAdapter:
        """A host's adapter on a link. device: what stands on the link instead, a fault wrapper made by `wrapped`."""
        adapter = self.bus.add_adapter(name)
        self._members[name] = _Member(adapter, adapter if device is None else device, link)
        return adapter

    def wrap_member(self, name: str, device: ByteDevice) -> None:
        """Put a wrapper around a member's adapter, such as one that injects faults."""
        self._members[name].device = device

    def device_of(self, member: str) -> ByteDevice:
        """What stands on a member's link: its adapter or what wraps it."""
        return self._members[member].device

    def link_of(self, member: str) -> Link:
        """A member's link."""
        return self._members[member].link

    def files(self) -> list[int]:
        return [file for member in self._members.values() for file in member.link.files()]

    def plug(self, connected: bool, member: str = "") -> None:
        """Put in or pull out one member's adapter, or all if none is named. An adapter comes back closed."""
        for name in [member] if member else list(self._members):
            self._members[name].wanted = connected

    def service(self, now_ns: int) -> int | None:
        for member in self._members.values():
            member.take(now_ns)
        self.bus.exchange(now_ns)
        for member in self._members.values():
            member.give(now_ns)
        return self._due_ns(now_ns)

    def close(self) -> None:
        for member in self._members.values():
            member.link.close()

    def _due_ns(self, now_ns: int) -> int | None:
        silent = any(not hasattr(node, "next_ns") for node in self.bus.nodes.values())
        owing = any(member.owes for member in self._members.values())
        due = [now_ns + STEP_NS] if silent or owing else []
        for device in (self.bus, *(member.device for member in self._members.values())):
            at_ns: int | None = getattr(device, "next_ns", None)
            if at_ns is not None:
                due.append(at_ns)
        return min(due, default=None)


class _Member:
    """One adapter, what stands on its link, and the rest of a line that the link did not take."""

    def __init__(self, adapter: SlcanAdapter, device: ByteDevice, link: Link) -> None:
        self.adapter = adapter
        self.device = device
        self.link = link
        self.wanted = True
        self._port = PortOf(link)
        self._rest = b""
        self._out = b""
        self._moved_ns = 0  # when the link last took something

    @property
    def owes(self) -> bool:
        """Whether the link could not take all yet."""
        return bool(self._rest)

    def take(self, now_ns: int) -> None:
        """Hear the host."""
        self._follow_plug(now_ns)
        received = self.link.read() if self.link.is_open else b""
        self._out = self.device.step(now_ns, received, self.link.baud)

    def give(self, now_ns: int) -> None:
        """Tell the host."""
        if self.adapter.has_output:
            self._out += self.device.step(now_ns, b"", self.link.baud)
        self._follow_plug(now_ns)
        if not self._out and not self._rest:
            return
        data = self._rest + self._out
        taken = self.link.write(data)
        rest = data[taken:]
        if taken:
            self._moved_ns = now_ns
        if now_ns - self._moved_ns <= OWED_NS:  # the host is busy for a moment: see attach.DeviceStation
            kept = _end_of_line(rest, MOST_OWED)
        else:
            kept = _end_of_line(rest) if taken or self._rest else 0
        self._rest = rest[:kept]
        self.link.counters.dropped_bytes -= kept
        if lost := rest[kept:]:
            self.adapter.note_overrun(lost.count(CR) + lost.count(BEL))

    def _follow_plug(self, now_ns: int) -> None:
        if self._port.follow(self.device, self.wanted and self.adapter.plugged):
            self.adapter.power_on(now_ns)
            self._rest = self._out = b""


def _end_of_line(data: bytes, most: int = 0) -> int:
    """Length of the whole lines at the beginning of data, ends included: of `most` bytes, or else of the first."""
    if len(data) <= most:
        return len(data)
    if most and (end := max(data.rfind(CR, 0, most), data.rfind(BEL, 0, most))) >= 0:
        return end + 1
    ends: Sequence[int] = [end for end in (data.find(CR), data.find(BEL)) if end >= 0]
    return min(ends) + 1 if ends else len(data)
