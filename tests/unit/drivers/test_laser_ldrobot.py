"""LDROBOT LD06/LD19: packets against the maker's example, the conversation against a turning head. Time by hand."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from drivers.checksums import crc8_ld06
from drivers.conversation import SetBaudRate
from drivers.errors import FrameError
from drivers.laser_ldrobot import LdrobotConversation, PacketReader, Screen, decode_packet
from drivers.readings import LinkState, ScanReading

MS = 1_000_000
S = 1000 * MS
EXAMPLE = bytes.fromhex(
    "54 2C 68 08 AB 7E E0 00 E4 DC 00 E2 D9 00 E5 D5 00 E3 D3 00 E4 D0 00 E9 CD 00 E4 CA 00 E2 C7 00 E9 C5 00 E5"
    "C2 00 E5 C0 00 E5 BE 82 3A 1A 50"
)


def packet(speed: int, start: float, end: float, distances: list[int], time_ms: int, intensity: int = 200) -> bytes:
    """Written out here so that a misreading in the driver does not agree with itself."""
    angle = [round(each * 100) % 36000 for each in (start, end)]
    body = b"\x54\x2c" + speed.to_bytes(2, "little") + angle[0].to_bytes(2, "little")
    body += b"".join(each.to_bytes(2, "little") + bytes([intensity]) for each in distances)
    body += angle[1].to_bytes(2, "little") + time_ms.to_bytes(2, "little")
    return body + bytes([crc8_ld06(body)])


def test_the_makers_example() -> None:
    read = decode_packet(EXAMPLE)
    assert (read.speed_deg_s, read.start_deg, read.end_deg, read.time_ms) == (2152, 324.27, 334.70, 6714)
    assert read.distance_mm.tolist() == [224, 220, 217, 213, 211, 208, 205, 202, 199, 197, 194, 192]
    assert read.intensity.tolist() == [228, 226, 229, 227, 228, 233, 228, 226, 233, 229, 229, 229]
    assert read.angles_deg()[1] == pytest.approx(325.22, abs=0.005)
    assert read.angles_deg()[-1] == pytest.approx(334.70)
    assert read.span_deg == pytest.approx(10.43)


def test_crc_table_begins_as_published() -> None:
    assert bytes(crc8_ld06(bytes([value])) for value in range(8)) == bytes.fromhex("00 4D 9A D7 79 34 E3 AE")


def test_angles_pass_zero() -> None:
    read = decode_packet(packet(3600, 355.0, 4.0, [1000] * 12, 5))
    angles = read.angles_deg()
    assert read.span_deg == pytest.approx(9.0)
    assert angles[0] == pytest.approx(355.0)
    assert angles[-1] == pytest.approx(4.0)
    assert np.all((angles >= 0) & (angles < 360))


@pytest.mark.parametrize(
    ("offset", "value", "reason"), [(10, 0x55, "bad_crc"), (5, 0xFF, "bad_angle"), (45, 0xFF, "bad_time")]
)
def test_what_no_scanner_says(offset: int, value: int, reason: str) -> None:
    body = bytearray(EXAMPLE)
    body[offset] = value
    if reason != "bad_crc":
        body[-1] = crc8_ld06(bytes(body[:-1]))
    with pytest.raises(FrameError) as error:
        decode_packet(bytes(body))
    assert error.value.reason == reason


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
def test_recorded_packets_at_any_split_and_among_noise() -> None:
    data = (Path(os.environ["UMFELD_DATA"]) / "device_bytes/ld06_two_packets.bin").read_bytes()
    rng = np.random.default_rng(2)
    first, second = (decode_packet(data[at : at + 47]) for at in (0, 47))
    assert (first.speed_deg_s, first.start_deg, first.end_deg, first.time_ms) == (2164, 344.80, 350.74, 2334)
    assert second.time_ms == 6714
    assert data[47:] == EXAMPLE
    for _ in range(100):
        noise = [rng.bytes(int(rng.integers(0, 30))).replace(b"\x54", b"") for _ in range(3)]
        noisy = noise[0] + data[:47] + noise[1] + data[47:] + noise[2]
        cuts = [0, *sorted(rng.integers(0, len(noisy), 6).tolist()), len(noisy)]
        reader = PacketReader()
        found = [each for a, b in pairwise(cuts) for each in reader.feed(noisy[a:b], 0)]
        assert [each.time_ms for each in found] == [2334, 6714]
        start = int(rng.integers(1, 47))
        assert [each.time_ms for each in PacketReader().feed(data[start:], 0)] == [6714]


# --- the conversation -------------------------------------------------------------------------------------------------


def far_wall(angle_deg: float) -> int:
    """2 m ahead of the mark, growing clockwise, so that a scan tells its own orientation."""
    return round(2000 + 5 * (angle_deg % 360))


@dataclass
class Head:
    """A turning head. Sample n is measured at n / 4500 s of its own time at angle n * speed / 4500."""

    speed: int = 3600
    rate: int = 4500
    wall: Callable[[float], int] = far_wall
    clock_ms: float = 29_000.0  # wraps after a second
    delay_ns: int = 3 * MS
    sample: int = 0

    def next(self) -> tuple[int, bytes]:
        """Arrival of the last byte, and the packet."""
        angles = [(self.sample + i) * self.speed / self.rate for i in range(12)]
        end_ns = round((self.sample + 11) * S / self.rate)
        self.sample += 12
        time_ms = int(end_ns / MS + self.clock_ms) % 30000
        data = packet(self.speed, angles[0] % 360, angles[-1] % 360, [self.wall(a) for a in angles], time_ms)
        return end_ns + self.delay_ns + 47 * 10 * S // 230400, data


@dataclass
class Desk:
    conversation: LdrobotConversation
    head: Head
    now_ns: int = 0
    readings: list[ScanReading] = field(default_factory=list)
    sent: list[bytes | SetBaudRate] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.conversation.connected(0)
        self.poll(0)

    @property
    def state(self) -> LinkState:
        return self.conversation.state

    def poll(self, now_ns: int) -> None:
        self.now_ns = max(self.now_ns, now_ns)
        self.sent += self.conversation.requests(self.now_ns)

    def take(self, data: bytes, stamp_ns: int) -> None:
        self.poll(stamp_ns)
        for reading in self.conversation.receive(data, stamp_ns):
            assert isinstance(reading, ScanReading)
            self.readings.append(reading)
        self.poll(stamp_ns)

    def run(self, packets: int, lost: frozenset[int] = frozenset(), late: Callable[[int], int] = lambda _: 0) -> None:
        for number in range(packets):
            stamp_ns, data = self.head.next()
            if number not in lost:
                self.take(data, stamp_ns + late(number))


def desk(head: Head | None = None, **arguments: object) -> Desk:
    return Desk(LdrobotConversation(**arguments), head or Head())  # type: ignore[arg-type]


def test_turns_of_a_steady_head() -> None:
    d = desk()
    d.run(375)
    assert d.sent == [SetBaudRate(230400)]
    assert d.state is LinkState.RUNNING
    assert d.conversation.trouble is None
    assert d.conversation.identity is not None
    assert len(d.readings) == 8  # the first, of which the begin was not seen, and the last are no whole turns
    for reading in d.readings:
        assert len(reading.range_m) == 450
        assert reading.beam_period_ns == pytest.approx(S / 4500, rel=0.002)
        assert reading.scan_period_ns == pytest.approx(100 * MS, rel=0.002)
        # Clockwise angles become negative bearings: the wall is 2 m ahead and farther on to the right.
        angle_deg = np.degrees(-reading.bearing_rad) % 360
        np.testing.assert_allclose(reading.range_m, 2.0 + 0.005 * angle_deg, atol=0.0006)
        assert reading.range_m[0] == pytest.approx(2.0, abs=0.005)
        assert reading.intensity is not None
        assert set(reading.intensity.tolist()) == {200.0}
    assert d.conversation.counters.drops == {}


def test_bearings_are_counter_clockwise_and_run_on_behind_the_head() -> None:
    d = desk(Head(wall=lambda angle: 500 if 80 < angle % 360 < 100 else 0))
    d.run(120)
    reading = d.readings[-1]
    seen = reading.bearing_rad[np.isfinite(reading.range_m)]
    assert np.degrees(seen).mean() == pytest.approx(-90, abs=1)  # to the right
    step = np.diff(reading.bearing_rad)
    assert np.all(step < 0.0)
    assert -2.0 * math.pi < step.sum() < -1.99 * math.pi
    assert abs(reading.bearing_rad[0]) < 0.02


@pytest.mark.parametrize("speed", [2152, 3600, 4500])
def test_stamps_are_the_first_beam(speed: int) -> None:
    rng = np.random.default_rng(4)
    delays = rng.exponential(4 * MS, 4000).astype(int)
    delays[::3] = 0
    d = desk(Head(speed=speed))
    d.run(3000, late=lambda number: int(delays[number]))
    turn_ns = 360 / speed * S
    for reading in d.readings[15:]:
        number = round((reading.stamp_ns - d.head.delay_ns) / turn_ns)
        first_sample = math.ceil(number * 360 / speed * 4500 - 1e-6)
        truth_ns = first_sample / 4500 * S + d.head.delay_ns
        assert abs(reading.stamp_ns - truth_ns) < 1.5 * MS
    assert d.conversation.clock_fit is not None
    assert abs(d.conversation.clock_fit.drift_ppm) < 500
    assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(d.readings))


def test_a_late_turn_is_stamped_by_the_clock() -> None:
    d = desk()
    d.run(1200)
    before = len(d.readings)
    d.run(150, late=lambda _: 30 * MS)
    stamps = np.array([reading.stamp_ns for reading in d.readings[before - 1 :]])
    assert np.abs(np.diff(stamps) - 100 * MS).max() < 1.5 * MS


def test_distance_zero_is_unknown_or_clear() -> None:
    for no_echo, expected in (("unknown", "nan"), ("clear", "inf")):
        d = desk(Head(wall=lambda angle: 0 if angle % 360 < 180 else 3000), no_echo=no_echo)
        d.run(120)
        assert {str(each) for each in d.readings[-1].range_m} == {expected, "3.0"}


def test_beyond_the_limits() -> None:
    d = desk(Head(wall=lambda angle: 15 if angle % 360 < 90 else 12_500))
    d.run(120)
    assert set(d.readings[-1].range_m.tolist()) == {-math.inf, math.inf}


def test_lost_packets_cut_a_turn_in_two() -> None:
    d = desk()
    d.run(200, lost=frozenset({90}))
    counts = [len(reading.range_m) for reading in d.readings]
    assert counts[0] == 450
    pieces = [count for count in counts if count != 450]
    assert len(pieces) == 2
    assert sum(pieces) == 438
    for reading in d.readings:
        angle_deg = np.degrees(-reading.bearing_rad) % 360
        np.testing.assert_allclose(reading.range_m, 2.0 + 0.005 * angle_deg, atol=0.0006)
        # No beam was measured at another time than said.
        since = (reading.stamp_ns + reading.beam_period_ns * np.arange(len(angle_deg)) - d.head.delay_ns) / S
        assert np.abs((since * 3600 - angle_deg + 180) % 360 - 180).max() < 6  # 6 degrees are 1.7 ms
    assert d.conversation.counters.drops["gap"] == 1


def test_a_whole_lost_turn_is_noticed() -> None:
    d = desk(Head(rate=4440))  # 37 packets are exactly a turn
    d.run(37 * 6, lost=frozenset(range(80, 117)))
    assert d.conversation.counters.drops["gap"] == 1
    assert all(len(reading.range_m) <= 445 for reading in d.readings)


def test_packets_that_only_the_code_believes_are_kept_out() -> None:
    """A packet with a right code, in the wrong place: dropped when the next one fits the one before it."""
    d = desk()
    d.run(100)
    clean = d.readings[:]
    false = packet(3600, 10.0, 19.6, [50] * 12, 12_345)
    d.take(false, d.now_ns)
    d.run(100)
    assert len(clean) >= 1
    assert d.conversation.counters.drops == {"implausible": 1}
    assert min(float(np.nanmin(reading.range_m)) for reading in d.readings) > 1.9
    assert {len(reading.range_m) for reading in d.readings} == {450}


def test_a_source_whose_time_stands_is_taken_as_it_is() -> None:
    d = desk()
    for _ in range(200):
        stamp_ns, data = d.head.next()
        data = data[:44] + b"\0\0"
        d.take(data + bytes([crc8_ld06(data)]), stamp_ns)
    assert d.state is LinkState.RUNNING
    assert len(d.readings) >= 3
    assert {len(reading.range_m) for reading in d.readings} == {450}
    late_ns = (d.readings[-1].stamp_ns - d.head.delay_ns + 50 * MS) % (100 * MS) - 50 * MS
    assert abs(late_ns) < 1 * MS


def test_after_a_pause_nothing_is_lost() -> None:
    d = desk()
    d.run(100)
    before = len(d.readings)
    d.head.sample += 4500  # a second without packets
    d.poll(d.now_ns + 450 * MS)
    d.poll(d.now_ns + 10 * MS)
    d.run(80)
    assert len(d.readings) - before >= 1
    assert d.state is LinkState.RUNNING


def test_silence_and_return() -> None:
    d = desk()
    d.run(150)
    d.poll(d.now_ns + 140 * MS)
    d.poll(d.now_ns + 140 * MS)
    d.poll(d.now_ns + 140 * MS)
    assert d.state is LinkState.SILENT
    assert "check the cable" in (d.conversation.trouble or "")
    for _ in range(30):
        d.poll(d.now_ns + 100 * MS)
    assert "sends nothing" in (d.conversation.trouble or "")
    d.head.sample += round(3.42 * 4500)
    d.run(120)
    assert d.readings[-1].stamp_ns > d.now_ns - 250 * MS
    assert d.conversation.trouble is None


def test_another_device_on_the_port() -> None:
    d = desk()
    for _ in range(40):
        d.take(b"\x00\xff\x12\x54" * 8, d.now_ns + 50 * MS)
    assert d.state is LinkState.SILENT
    assert "no LD06 packets" in (d.conversation.trouble or "")


def test_a_head_that_is_held() -> None:
    d = desk()
    d.run(150)
    before = len(d.readings)
    for number in range(100):
        d.take(packet(0, 90.0, 90.0, [500] * 12, 3 * number), d.now_ns + 3 * MS)
    assert len(d.readings) <= before + 1
    assert "does not turn" in (d.conversation.trouble or "")


def test_a_head_that_crawls_never_fills_memory() -> None:
    d = desk(Head(speed=20, sample=round(359.9 / 20 * 4500)))
    d.run(8_400 // 12)
    assert not d.readings
    assert d.conversation.counters.drops["head_stands"] == 1


def test_screen_passes_any_single_packet() -> None:
    assert len(Screen().check(decode_packet(EXAMPLE))) == 1


def test_reconnecting_forgets_half_a_packet() -> None:
    d = desk()
    d.run(100)
    d.take(EXAMPLE[:30], d.now_ns)
    d.conversation.connected(d.now_ns)
    d.run(120)
    assert d.conversation.counters.drops.get("bad_crc") is None
    assert d.state is LinkState.RUNNING


def test_farewell_and_wrong_limits() -> None:
    assert LdrobotConversation().farewell() == ()
    with pytest.raises(ValueError):
        LdrobotConversation(range_min_m=2.0, range_max_m=1.0)
