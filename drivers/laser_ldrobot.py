"""LDROBOT LD06 and LD19: a stream that nobody asks for. Bytes in, scans out. Pure.

    offset  bytes                       47 bytes, low byte first, 375 packets a second at 230400 bit/s
    0       1     54
    1       1     2C: type 1, 12 samples
    2       2     speed, degrees per second
    4       2     angle of the first sample, 0.01 degree, clockwise from the mark on the housing
    6       36    12 times: distance mm (2), 0 for none; intensity (1)
    42      2     angle of the last sample
    44      2     time, ms, starts again at 30000
    46      1     CRC-8, polynomial 4D, of all before

An 8-bit code lets one damaged packet of 256 pass. So a packet must also fit the one before, in time and angle; one
that does not is kept until the next ones tell which of the two was right.
Source: LDROBOT LD06 development manual; the maker's example packet is a test. Quirks: docs/devices/ldrobot_ld06.md.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.checksums import crc8_ld06
from drivers.clock_fit import DeviceClock
from drivers.conversation import SetBaudRate
from drivers.errors import FrameError
from drivers.readings import F64, ClockFit, Identity, LinkState, Reading, SourceCounters
from drivers.scripted import ScriptedConversation, Step
from drivers.turns import Limits, NoEcho, Samples, TurnAssembler

_MS = 1_000_000
HEADER = b"\x54\x2c"
PACKET_SIZE = 47
SAMPLES = 12
TIME_WRAP_MS = 30_000
BAUD = 230400
_RAD_PER_DEG = math.pi / 180.0
RANGE_MIN_M, RANGE_MAX_M = 0.02, 12.0
_LAYOUT = np.dtype([("distance_mm", "<u2"), ("intensity", "u1")])
_INDEX: F64 = np.arange(SAMPLES, dtype=np.float64)
_BEFORE_LAST: F64 = _INDEX[::-1].copy()


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet. Angles in degrees, clockwise.  size_behind: bytes that had arrived behind it."""

    speed_deg_s: int
    start_deg: float
    end_deg: float
    time_ms: int
    distance_mm: F64
    intensity: F64
    arrived_ns: int = 0
    size_behind: int = 0

    @property
    def span_deg(self) -> float:
        """From the first sample to the last."""
        return (self.end_deg - self.start_deg) % 360.0

    @property
    def sample_ns(self) -> float:
        """From one sample to the next, as speed and span have it."""
        return self.span_deg / (SAMPLES - 1) / self.speed_deg_s * 1e9

    def angles_deg(self) -> F64:
        """(12,) of the samples."""
        angles = self.start_deg + _INDEX * (self.span_deg / (SAMPLES - 1))
        return angles if self.end_deg >= self.start_deg else np.asarray(angles % 360.0)


def decode_packet(frame: bytes) -> Packet:
    """A packet of 47 bytes. Raises FrameError for a wrong code, and for what no scanner of this kind can say."""
    if len(frame) != PACKET_SIZE or not frame.startswith(HEADER):
        raise FrameError("bad_length")
    if crc8_ld06(frame[:-1]) != frame[-1]:
        raise FrameError("bad_crc")
    speed, start = struct.unpack_from("<HH", frame, 2)
    end, time_ms = struct.unpack_from("<HH", frame, 42)
    if start > 36000 or end > 36000:
        raise FrameError("bad_angle", f"{start} to {end}")
    if time_ms > TIME_WRAP_MS:
        raise FrameError("bad_time", str(time_ms))
    samples = np.frombuffer(frame, _LAYOUT, SAMPLES, 6)
    return Packet(
        speed,
        start / 100.0,
        end / 100.0,
        time_ms,
        samples["distance_mm"].astype(np.float64),
        samples["intensity"].astype(np.float64),
    )


class PacketReader:
    """Whole packets from chunks. What does not fit is looked at again from its second byte."""

    def __init__(self, counters: SourceCounters | None = None) -> None:
        self._counters = counters or SourceCounters()
        self._buffer = bytearray()

    def clear(self) -> None:
        """Forget a packet that has only begun."""
        self._buffer.clear()

    def feed(self, chunk: bytes, stamp_ns: int) -> list[Packet]:
        """Packets with a right code that this chunk completes."""
        self._buffer += chunk
        data = bytes(self._buffer)
        found: list[Packet] = []
        at = 0
        while (begin := data.find(HEADER, at)) >= 0 and begin + PACKET_SIZE <= len(data):
            self._count_noise(begin - at)
            frame = data[begin : begin + PACKET_SIZE]
            try:
                packet = decode_packet(frame)
            except FrameError as error:
                self._counters.drop(error.reason)
                at = begin + 1
                continue
            at = begin + PACKET_SIZE
            found.append(_arrived(packet, stamp_ns, len(data) - at))
        if begin < 0:
            begin = max(at, len(data) - data.endswith(HEADER[:1]))
        self._count_noise(begin - at)
        del self._buffer[:begin]
        return found

    def _count_noise(self, size: int) -> None:
        if size > 0:
            self._counters.drop("noise_bytes", size)


def _arrived(packet: Packet, stamp_ns: int, size_behind: int) -> Packet:
    return Packet(
        packet.speed_deg_s,
        packet.start_deg,
        packet.end_deg,
        packet.time_ms,
        packet.distance_mm,
        packet.intensity,
        stamp_ns,
        size_behind,
    )


class Screen:
    """Passes packets that fit the one before; of two that contradict each other the next ones tell which was right.

    A source whose packets never fit (its clock stands, its angles jump) is taken as it is after a while.
    """

    PATIENCE = 4
    TOGETHER_MS = 100  # packets farther apart in time say nothing about each other
    TICKS_MS = 1.6  # two rounded times differ by up to one from the truth; and speed trembles
    MARGIN_DEG = 2.0

    def __init__(self, counters: SourceCounters | None = None) -> None:
        self._counters = counters or SourceCounters()
        self.restart()

    def restart(self) -> None:
        """What comes next follows nothing."""
        self._last: Packet | None = None
        self._suspects: list[Packet] = []
        self.is_useless = False

    def check(self, packet: Packet) -> list[Packet]:
        """Packets that may now be believed, in order."""
        if self._last is None or self._fits(self._last, packet):
            self.is_useless = self.is_useless and self._last is None
            return self._accept(packet, suspects=0)
        if self.is_useless:
            return self._accept(packet, suspects=0)
        if self._suspects and self._fits(self._suspects[-1], packet):
            return self._accept(packet, suspects=1)
        self._suspects.append(packet)
        if len(self._suspects) < self.PATIENCE:
            return []
        self.is_useless = True
        believed, self._suspects, self._last = self._suspects, [], packet
        return believed

    def _accept(self, packet: Packet, *, suspects: int) -> list[Packet]:
        believed = [*self._suspects[len(self._suspects) - suspects :], packet]
        doubtful = len(self._suspects) - suspects
        if doubtful:
            self._counters.drop("implausible", doubtful)
        self._suspects, self._last = [], packet
        return believed

    def _fits(self, before: Packet, packet: Packet) -> bool:
        """Whether the head can have turned from one to the other in the time between."""
        passed_ms = (packet.time_ms - before.time_ms) % TIME_WRAP_MS
        speed = max(before.speed_deg_s, packet.speed_deg_s)
        if not 0 < speed < 2 * min(before.speed_deg_s, packet.speed_deg_s):
            return False
        if not 0.1 <= packet.span_deg / max(before.span_deg, 0.01) <= 10.0 or passed_ms > self.TOGETHER_MS:
            return False
        turned_deg = (packet.start_deg - before.start_deg) % 360.0
        error_deg = (turned_deg - packet.speed_deg_s * passed_ms / 1000.0 + 180.0) % 360.0 - 180.0
        return abs(error_deg) <= self.TICKS_MS * speed / 1000.0 + self.MARGIN_DEG


class LdrobotConversation(ScriptedConversation[Packet]):
    """A `Conversation[bytes]` with an LD06 or LD19. It only listens: these scanners start and stop with their power.

    baud: line speed.  range_min_m, range_max_m: of the model.  no_echo: what a distance of 0 means.
    """

    LONGEST_STEP_MS = 50

    def __init__(
        self,
        *,
        baud: int = BAUD,
        range_min_m: float = RANGE_MIN_M,
        range_max_m: float = RANGE_MAX_M,
        no_echo: NoEcho = "unknown",
    ) -> None:
        if not 0 <= range_min_m < range_max_m:
            raise ValueError(f"range_min_m {range_min_m} is not below range_max_m {range_max_m}")
        self._baud = baud
        super().__init__()
        self._packets = PacketReader(self._counters)
        self._screen = Screen(self._counters)
        self._clock = DeviceClock(wrap_ns=TIME_WRAP_MS * _MS, tick_ns=_MS)
        self._turns = TurnAssembler(
            Limits(range_min_m, range_max_m, no_echo), beam_ns=1e9 / 4500, counters=self._counters
        )
        self._last: Packet | None = None

    def _forget(self) -> None:
        self._packets.clear()
        self._screen.restart()
        self._turns.restart()
        self._last = None

    @property
    def clock_fit(self) -> ClockFit | None:
        """The millisecond clock of the scanner, unwrapped, against the host's."""
        return self._clock.fit

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """It understands no command: it stops when its power is cut."""
        return ()

    def _life(self) -> Generator[Step[Packet], Packet | None, None]:
        yield Step((SetBaudRate(self._baud),))
        while True:
            heard_bytes = self._counters.bytes
            packet = yield Step((), lambda _: True, 1_000 * _MS)
            if packet is None:
                self._state = LinkState.SILENT
                self._trouble = self._trouble_of_silence(self._counters.bytes > heard_bytes)
                continue
            if self._state is LinkState.SILENT:
                self._state = LinkState.STARTING
                self._trouble = None
            self._identity = Identity(vendor="LDROBOT", model="LD06/LD19")
            self._period_ns = 360.0 / max(packet.speed_deg_s, 360) * 1e9
            yield from self._watch()
            self._turns.restart()
            self._screen.restart()

    def _trouble_of_silence(self, heard: bool) -> str:
        if heard:
            return f"sends bytes that are no LD06 packets: another device, or not {self._baud} bit/s"
        return "sends nothing: check its 5 V supply, and that its TX is on this port's RX"

    def _messages(self, chunk: bytes, stamp_ns: int) -> Iterable[Packet]:
        for packet in self._packets.feed(chunk, stamp_ns):
            yield from self._screen.check(packet)

    def _take(self, packet: Packet, stamp_ns: int) -> Iterator[Reading]:
        if packet.speed_deg_s == 0 or packet.span_deg == 0.0:
            self._counters.drop("head_stands")
            self._standing_trouble = "its head does not turn: is something in its way, is the supply 5 V and 300 mA?"
            self._trouble = self._standing_trouble
            return
        self._standing_trouble = None
        if self._last is not None and not self._follows(self._last, packet):
            self._counters.drop("gap")
            yield from self._turns.cut()
        self._last = packet
        self._turns.beam_ns += 0.1 * (packet.sample_ns - self._turns.beam_ns)
        yield from self._turns.add(self._samples(packet))
        if self._turns.turn_ns is not None:
            self._period_ns = self._turns.turn_ns

    def _follows(self, before: Packet, packet: Packet) -> bool:
        """Whether no packet is missing between the two: one sample's angle from the end of one to the next."""
        passed_ms = (packet.time_ms - before.time_ms) % TIME_WRAP_MS
        if passed_ms > self.LONGEST_STEP_MS and not self._screen.is_useless:
            return False  # a whole turn may be missing
        gap_deg = (packet.start_deg - before.end_deg + 180.0) % 360.0 - 180.0
        return -0.5 <= gap_deg / max(before.span_deg, packet.span_deg, 0.05) <= 0.6

    def _samples(self, packet: Packet) -> Samples:
        ns_per_byte = 10e9 / self._baud
        arrived_ns = packet.arrived_ns - round((PACKET_SIZE + packet.size_behind) * ns_per_byte)
        stamp_ns = packet.time_ms % TIME_WRAP_MS * _MS
        placed = self._clock.place(stamp_ns, arrived_ns, period_ns=packet.sample_ns * SAMPLES)
        clock_ns = math.nan if placed is None else float(placed[1])
        before_last_ns = _BEFORE_LAST * self._turns.beam_ns
        return Samples(
            angle_rad=packet.angles_deg() * _RAD_PER_DEG,
            distance_m=packet.distance_mm / 1000.0,
            intensity=packet.intensity,
            arrived_ns=arrived_ns - before_last_ns,
            clock_ns=clock_ns - before_last_ns,
        )
