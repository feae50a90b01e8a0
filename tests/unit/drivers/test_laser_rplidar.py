"""RPLIDAR: messages against published ones, and the conversation against a peer that answers by the protocol.

The peer turns its head by time and answers from a table with a few switches; it is no emulator. Time is turned by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import reduce
from itertools import pairwise

import numpy as np
import pytest

from drivers.conversation import SetBaudRate
from drivers.errors import FrameError
from drivers.laser_rplidar import RplidarConversation
from drivers.readings import LinkState, ScanReading
from drivers.rplidar_messages import (
    CAPSULES,
    CONFIG,
    GET_BOARD,
    HEALTH,
    INFO,
    NODES,
    Answer,
    AnswerReader,
    Block,
    config_text,
    config_value,
    decode_capsule,
    decode_info,
    express_scan,
    get_config,
    motor_pwm,
)

MS = 1_000_000
S = 1000 * MS
INFO_HEAD = bytes.fromhex("A5 5A 14 00 00 00 04")
HEALTH_HEAD = bytes.fromhex("A5 5A 03 00 00 00 06")
RATES_HEAD = bytes.fromhex("A5 5A 04 00 00 00 15")
NODES_HEAD = bytes.fromhex("A5 5A 05 00 00 40 81")
CAPSULES_HEAD = bytes.fromhex("A5 5A 54 00 00 40 82")
BOARD_HEAD = bytes.fromhex("A5 5A 04 00 00 00 FF")


def node(angle_deg: float, mm: float, *, start: bool = False, quality: int = 15) -> bytes:
    """Written out here so that a misreading in the driver does not agree with itself."""
    angle = round(angle_deg * 64) % (360 * 64)
    head = bytes([quality << 2 | (1 if start else 2)]) + (angle << 1 | 1).to_bytes(2, "little")
    return head + round(mm * 4).to_bytes(2, "little")


def capsule(start_deg: float, mm: list[int], *, first: bool = False, offsets: list[int] | None = None) -> bytes:
    """offsets: 32 in 1/8 degree, with sign."""
    offsets = offsets or [0] * 32
    start = round(start_deg * 64) % (360 * 64) | (0x8000 if first else 0)
    body = start.to_bytes(2, "little")
    for cabin in range(16):
        low = 0
        for place in (0, 1):
            value = offsets[2 * cabin + place] & 0x3F
            body += (mm[2 * cabin + place] * 4 & 0xFFFC | value >> 4).to_bytes(2, "little")
            low |= (value & 0xF) << 4 * place
        body += bytes([low])
    total = reduce(lambda a, b: a ^ b, body)
    return bytes([0xA0 | total & 0xF, 0x50 | total >> 4]) + body


def test_requests() -> None:
    for request, expected in (
        (express_scan(0), "A5 82 05 00 00 00 00 00 22"),
        (express_scan(1), "A5 82 05 01 00 00 00 00 23"),
        (motor_pwm(660), "A5 F0 02 94 02 C1"),
        (motor_pwm(0), "A5 F0 02 00 00 57"),
        (get_config(0x70), "A5 84 04 70 00 00 00 55"),
        (get_config(0x7C), "A5 84 04 7C 00 00 00 59"),
        (get_config(0x71, 1), "A5 84 06 71 00 00 00 01 00 57"),
        (GET_BOARD, "A5 FF 04 00 00 00 00 5E"),
    ):
        assert request == bytes.fromhex(expected)


def test_answers_among_boot_text() -> None:
    text = b"RP LIDAR System.\r\nFirmware Ver 1.24 - rtm, HW Ver 0\r\nModel: 0\r\n"
    body = bytes([0x18, 29, 1, 7, *range(16)])
    data = text + INFO_HEAD + body + HEALTH_HEAD + b"\x02\x34\x12" + text
    for size in (1, 2, 3, 7, 1000):
        reader = AnswerReader()
        found = [each for at in range(0, len(data), size) for each in reader.feed(data[at : at + size], 0)]
        assert found == [Answer(INFO, body), Answer(HEALTH, b"\x02\x34\x12")]
    info = decode_info(body)
    assert info.name == "RPLIDAR A1M8"
    assert info.firmware == (1, 29)
    assert info.serial == "000102030405060708090A0B0C0D0E0F"


def test_descriptors_that_cannot_be_are_noise() -> None:
    body = bytes([0x28, 24, 1, 0, *range(16)])
    data = bytes.fromhex("A5 5A 15 00 00 00 04 A5 5A A5") + INFO_HEAD + body
    assert AnswerReader().feed(data, 0) == [Answer(INFO, body)]
    assert decode_info(body).name == "RPLIDAR A2M8"


def test_config_values() -> None:
    body = (0x71).to_bytes(4, "little") + (250 * 256).to_bytes(4, "little")
    assert AnswerReader().feed(b"\xa5\x5a\x08\0\0\0\x20" + body, 0) == [Answer(CONFIG, body)]
    assert config_value(body, 0x71) == 64_000
    assert config_value(body, 0x74) is None
    assert config_value(body[:4], 0x71) is None
    assert config_text((0x7F).to_bytes(4, "little") + b"Express\0", 0x7F) == "Express"


def blocks(data: bytes) -> list[Block]:
    found = AnswerReader().feed(data, 0)
    assert all(isinstance(each, Block) for each in found[1:])
    return [each for each in found if isinstance(each, Block)]


def test_published_nodes() -> None:
    published = bytes.fromhex("3D 01 00 A0 0F") + bytes.fromhex("3E 73 00 A4 0F")
    invalid = bytes.fromhex("02 FF B3 00 00")
    assert node(0, 1000, start=True) == published[:5]
    assert node(57 / 64, 1001) == published[5:]
    assert node(359.984375, 0, quality=0) == invalid
    (block,) = blocks(NODES_HEAD + invalid + published + node(1.8, 1002) + node(2.7, 1003) + node(3.6, 1004))
    np.testing.assert_allclose(np.degrees(block.angle_rad[:3]), [359.984375, 0.0, 0.890625])
    np.testing.assert_allclose(block.distance_m[:3], [0.0, 1.0, 1.001])
    assert block.quality[:3].tolist() == [0, 15, 15]
    assert block.starts is not None
    assert block.starts.tolist() == [False, True, False, False, False]
    assert not block.after_gap


def test_published_capsule() -> None:
    data = capsule(0.0, list(range(1000, 1032)), first=True)
    assert data.startswith(bytes.fromhex("A0 58 00 80 A0 0F A4 0F 00 A8 0F AC 0F 00"))
    assert data.endswith(bytes.fromhex("18 10 1C 10 00"))
    read = decode_capsule(data)
    assert read.is_first
    assert read.start_rad == 0.0
    np.testing.assert_allclose(read.distance_m, np.arange(1000, 1032) / 1000)
    assert not read.offset_rad.any()
    for at in (0, 1, 2, 50, 83):
        with pytest.raises(FrameError):
            decode_capsule(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])


def test_capsules_are_told_with_the_next_one() -> None:
    offsets = [-32, 31, -1, 0] * 8
    first = capsule(350.0, [500 + i for i in range(32)], first=True, offsets=offsets)
    (block,) = blocks(CAPSULES_HEAD + first + capsule(6.0, [0] * 32))
    expected = (350.0 + 0.5 * np.arange(32) - np.array(offsets) / 8) % 360
    np.testing.assert_allclose(np.degrees(block.angle_rad), expected)
    np.testing.assert_allclose(block.distance_m, 0.5 + np.arange(32) / 1000)
    assert block.starts is None


def test_a_capsule_beside_damage_is_not_told() -> None:
    """Its own span is not known then, and only its neighbour shows that no byte of it is missing."""
    each = [capsule(16.0 * n, [1000] * 32, first=n == 0) for n in range(8)]
    broken = each[3][:40] + b"\x00" + each[3][41:]
    found = blocks(CAPSULES_HEAD + b"".join([*each[:3], broken, *each[4:]]))
    assert [round(math.degrees(block.angle_rad[0])) for block in found] == [0, 16, 64, 80, 96]
    assert [block.after_gap for block in found] == [False, False, True, False, False]


def test_a_capsule_that_is_missing_without_a_trace_costs_its_neighbour_only() -> None:
    each = [capsule(16.0 * n % 360, [1000] * 32, first=n == 0) for n in range(8)]
    found = blocks(CAPSULES_HEAD + b"".join([*each[:3], *each[4:]]))
    assert [round(math.degrees(block.angle_rad[0])) for block in found] == [0, 16, 64, 80, 96]


def test_nodes_find_their_step_again() -> None:
    nodes = [node(2.0 * n, 1000 + n, start=n == 0) for n in range(60)]
    for lost in (1, 2, 3, 4, 7):
        data = b"".join(nodes)
        data = NODES_HEAD + data[: 30 * 5 - 2] + data[30 * 5 - 2 + lost :]
        found = blocks(data)
        mm = np.concatenate([block.distance_m for block in found]) * 1000
        angle = np.degrees(np.concatenate([block.angle_rad for block in found]))
        # Nothing false; the halves of two neighbours make one that lies between them.
        np.testing.assert_allclose(mm - 1000, angle / 2, atol=1.0)
        assert np.sum(np.abs(mm - 1000 - angle / 2) > 1e-6) <= 1
        assert len(mm) >= 60 - 1 - 2 - (lost + 2) // 5
        assert found[-1].after_gap


# --- the conversation -------------------------------------------------------------------------------------------------


def wall_mm(angle_deg: float) -> int:
    """2 m ahead, farther clockwise: a scan tells its own orientation."""
    return round(2000 + 5 * (angle_deg % 360))


@dataclass
class Peer:
    """A scanner on a line of its speed. Its head turns on a clock of its own while it scans."""

    model: int = 0x18
    firmware: tuple[int, int] = (1, 29)
    speed: int = 115200
    power: bool = True
    health: int = 0
    heals: bool = True
    turns_hz: float = 7.0
    rates_us: tuple[int, int] = (500, 250)
    true_us: float | None = None  # what its samples really take
    modes: list[tuple[int, float]] = field(default_factory=lambda: [(0x81, 500), (0x82, 250), (0x84, 125)])
    typical: int = 2
    knows_config: bool = True
    knows_express: bool = True
    board: int | None = 1
    delay_ns: int = 1 * MS
    line_speed: int = 0
    kind: int | None = None
    motor: int | None = None
    begun_ns: int = 0
    sent: int = 0
    received: list[bytes] = field(default_factory=list)
    out: list[tuple[int, bytes]] = field(default_factory=list)
    mute: bool = False

    def heard(self, item: bytes | SetBaudRate, now_ns: int) -> None:
        if isinstance(item, SetBaudRate):
            self.line_speed = item.bits_per_s
            return
        if not self.power or self.line_speed != self.speed:
            return
        self.received.append(item)
        command = item[1]
        if command & 0x80:
            assert len(item) == 4 + item[2]
            assert reduce(lambda a, b: a ^ b, item) == 0
        answer = self.answer(command, item[3:-1], now_ns)
        if answer:
            self.out.append((now_ns + self.delay_ns, answer))

    def answer(self, command: int, data: bytes, now_ns: int) -> bytes:
        if command == 0x25:
            self.kind = None
        elif command == 0x40:
            self.kind = None
            self.health = 0 if self.heals else self.health
            return b"RP LIDAR System.\r\n"
        elif command == 0x50:
            return INFO_HEAD + bytes([self.model, self.firmware[1], self.firmware[0], 7, *range(16)])
        elif command == 0x52:
            return HEALTH_HEAD + bytes([self.health]) + b"\x05\x00"
        elif command == 0x59:
            return RATES_HEAD + b"".join(each.to_bytes(2, "little") for each in self.rates_us)
        elif command == 0x84 and self.knows_config:
            return self.config(int.from_bytes(data[:4], "little"), int.from_bytes(data[4:6], "little"))
        elif command == 0xFF and self.board is not None:
            return BOARD_HEAD + self.board.to_bytes(4, "little")
        elif command == 0xF0:
            self.motor = int.from_bytes(data, "little")
        elif command == 0x20:
            return self.start(0x81, now_ns)
        elif command == 0x82 and self.knows_express:
            return self.start(0x82, now_ns)
        return b""

    def config(self, key: int, mode: int) -> bytes:
        values: dict[int, Callable[[], bytes]] = {
            0x70: lambda: len(self.modes).to_bytes(2, "little"),
            0x7C: lambda: self.typical.to_bytes(2, "little"),
            0x71: lambda: round(self.modes[mode][1] * 256).to_bytes(4, "little"),
            0x74: lambda: (12 * 256).to_bytes(4, "little"),
            0x75: lambda: bytes([self.modes[mode][0]]),
            0x7F: lambda: b"Some\0",
        }
        value = values[key]()
        return b"\xa5\x5a" + (4 + len(value)).to_bytes(4, "little") + b"\x20" + key.to_bytes(4, "little") + value

    def start(self, kind: int, now_ns: int) -> bytes:
        self.kind, self.begun_ns, self.sent = kind, now_ns, 0
        return NODES_HEAD if kind == 0x81 else CAPSULES_HEAD

    def sample_ns(self) -> float:
        if self.true_us is not None:
            return self.true_us * 1000
        return self.rates_us[0 if self.kind == 0x81 else 1] * 1000

    def angle(self, sample: int) -> float:
        return (100.0 + sample * self.sample_ns() / S * self.turns_hz * 360) % 360

    def stream(self, now_ns: int) -> None:
        """Samples up to now, each on the wire when it is measured (a capsule with its last)."""
        if self.kind is None or self.mute or self.motor == 0:
            return
        block = 1 if self.kind == 0x81 else 32
        while True:
            last = self.sent + block - 1
            when_ns = round(self.begun_ns + last * self.sample_ns())
            if when_ns > now_ns:
                return
            if block == 1:
                angle = self.angle(self.sent)
                data = node(angle, wall_mm(angle), start=angle < self.angle(self.sent - 1))
            else:
                angles = [self.angle(n) for n in range(self.sent, self.sent + 32)]
                data = capsule(angles[0], [wall_mm(angle) for angle in angles], first=self.sent == 0)
            self.sent += block
            self.out.append((when_ns + self.delay_ns + len(data) * 10 * S // self.speed, data))


@dataclass
class Desk:
    """Conversation, peer and a clock in steps of 1 ms, at which what has come is read as one chunk."""

    conversation: RplidarConversation
    peer: Peer
    now_ns: int = 0
    readings: list[ScanReading] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.conversation.connected(0)

    @property
    def state(self) -> LinkState:
        return self.conversation.state

    @property
    def trouble(self) -> str:
        return self.conversation.trouble or ""

    def run(self, seconds: float) -> None:
        end = self.now_ns + round(seconds * S)
        while self.now_ns < end:
            self.now_ns += 1 * MS
            self.peer.stream(self.now_ns)
            due = b"".join(data for when, data in self.peer.out if when <= self.now_ns)
            self.peer.out = [each for each in self.peer.out if each[0] > self.now_ns]
            if due:
                self.take(due)
            for item in self.conversation.requests(self.now_ns):
                self.peer.heard(item, self.now_ns)

    def take(self, data: bytes) -> None:
        for reading in self.conversation.receive(data, self.now_ns):
            assert isinstance(reading, ScanReading)
            self.readings.append(reading)


def desk(peer: Peer | None = None, **arguments: object) -> Desk:
    return Desk(RplidarConversation(**arguments), peer or Peer())  # type: ignore[arg-type]


def check_scan(reading: ScanReading, tolerance_deg: float = 0.5) -> None:
    angle_deg = np.degrees(-reading.bearing_rad) % 360
    expected = 2.0 + 0.005 * angle_deg
    assert np.abs(reading.range_m - expected).max() < 0.005 * tolerance_deg + 0.001
    assert reading.range_m.shape == reading.bearing_rad.shape


def check_times(d: Desk, reading: ScanReading, tolerance_ns: float) -> None:
    """Every beam was measured when it is said to have been: the head's angle tells."""
    peer = d.peer
    when_ns = reading.stamp_ns + reading.beam_period_ns * np.arange(len(reading.bearing_rad))
    sample = (when_ns - peer.delay_ns - peer.begun_ns) / peer.sample_ns()
    truth_deg = 100.0 + sample * peer.sample_ns() / S * peer.turns_hz * 360
    error_deg = (np.degrees(-reading.bearing_rad) - truth_deg + 180) % 360 - 180
    assert np.abs(error_deg).max() < tolerance_ns / S * peer.turns_hz * 360


def test_a1_with_modes_scans_express() -> None:
    d = desk()
    d.run(4.0)
    assert d.state is LinkState.RUNNING
    assert d.trouble == ""
    identity = d.conversation.identity
    assert identity is not None
    assert (identity.vendor, identity.model, identity.firmware) == ("Slamtec", "RPLIDAR A1M8", "1.29")
    assert identity.serial == "000102030405060708090A0B0C0D0E0F"
    assert express_scan(1) in d.peer.received  # the typical mode sends capsules that are not read
    assert not any(each[1] in (0xF0, 0xFF) for each in d.peer.received)  # an A1 knows neither
    assert len(d.readings) > 15
    for reading in d.readings:
        check_scan(reading)
        assert len(reading.range_m) == pytest.approx(4000 / 7, abs=2)
        assert reading.beam_period_ns == 250_000
    for reading in d.readings[1:]:
        check_times(d, reading, 1.5 * MS)
        assert reading.scan_period_ns == pytest.approx(S / 7, rel=0.02)
    assert d.conversation.counters.drops == {}


def test_standard_scan_by_wish_and_on_old_firmware() -> None:
    for d in (desk(scan_mode="standard"), desk(Peer(firmware=(1, 15), knows_config=False))):
        d.run(4.0)
        assert d.state is LinkState.RUNNING
        assert b"\xa5\x20" in d.peer.received
        assert len(d.readings) > 15
        for reading in d.readings[1:]:
            check_scan(reading, 0.05)
            check_times(d, reading, 1.5 * MS)
            assert reading.beam_period_ns == 500_000
            assert reading.intensity is not None
            assert reading.intensity.max() == 15


def test_firmware_without_modes_is_asked_for_rates() -> None:
    d = desk(Peer(firmware=(1, 20), knows_config=False, rates_us=(508, 254)))
    d.run(4.0)
    kinds = [each[1] for each in d.peer.received]
    assert 0x84 not in kinds
    assert 0x59 in kinds
    assert express_scan(0) in d.peer.received
    assert d.readings[-1].beam_period_ns == 254_000


def test_firmware_that_should_know_modes_but_does_not() -> None:
    d = desk(Peer(knows_config=False, rates_us=(500, 250)))
    d.run(4.0)
    assert d.state is LinkState.RUNNING


def test_a_typical_mode_that_can_be_read_is_taken() -> None:
    d = desk(Peer(modes=[(0x81, 500), (0x82, 250), (0x82, 200)], typical=1))
    d.run(3.0)
    assert express_scan(1) in d.peer.received
    d = desk(Peer(modes=[(0x84, 500), (0x82, 250), (0x82, 200)], typical=0, rates_us=(500, 200)))
    d.run(3.0)
    assert express_scan(2) in d.peer.received
    assert d.readings[-1].beam_period_ns == 200_000


def test_express_that_is_not_answered_falls_back_to_standard() -> None:
    d = desk(Peer(knows_express=False))
    d.run(6.0)
    assert d.state is LinkState.RUNNING
    assert d.readings[-1].beam_period_ns == 500_000


@pytest.mark.parametrize(("board", "pwm"), [(1, 700), (None, 700), (0, None)])
def test_the_motor_of_an_a2(board: int | None, pwm: int | None) -> None:
    d = desk(Peer(model=0x28, board=board), pwm=700)
    d.run(4.0)
    assert d.state is LinkState.RUNNING
    assert d.peer.motor == pwm
    assert d.readings[-1].range_max_m == 12.0  # the mode says so
    farewell = list(d.conversation.farewell())
    assert farewell == ([b"\xa5\x25", motor_pwm(0)] if pwm else [b"\xa5\x25"])


def test_a3_at_its_speed() -> None:
    d = desk(Peer(model=0x31, speed=256000))
    d.run(5.0)
    assert d.state is LinkState.RUNNING
    assert d.conversation.identity is not None
    assert d.conversation.identity.model == "RPLIDAR A3M1"


def test_an_error_of_health_is_reset() -> None:
    d = desk(Peer(health=2))
    d.run(1.0)
    assert not d.readings
    assert "error (code 0005h)" in d.trouble
    d.run(5.0)
    assert b"\xa5\x40" in d.peer.received
    assert d.state is LinkState.RUNNING
    assert d.trouble == ""


def test_an_error_that_stays_and_a_warning() -> None:
    d = desk(Peer(health=2, heals=False))
    d.run(15.0)
    assert 3 <= d.peer.received.count(b"\xa5\x40") <= 5
    assert "needs service" in d.trouble
    d = desk(Peer(health=1))
    d.run(3.0)
    assert d.state is LinkState.RUNNING
    assert "warns" in d.trouble


def test_an_old_stream_is_drained() -> None:
    peer = Peer()
    peer.kind = 0x81
    d = desk(peer)
    d.run(4.0)
    assert d.state is LinkState.RUNNING
    assert all(len(reading.range_m) > 500 for reading in d.readings)


@pytest.mark.parametrize("standard", [False, True])
def test_a_sample_rate_that_is_not_as_told_is_measured(standard: bool) -> None:
    d = desk(Peer(true_us=400.0), scan_mode="standard" if standard else "auto")
    d.run(7.0)
    assert d.readings[-1].beam_period_ns == pytest.approx(400_000, rel=0.01)
    for reading in d.readings[-10:]:
        check_times(d, reading, 2.5 * MS)


def test_speed_changes_and_beam_count_with_it() -> None:
    d = desk()
    d.run(3.0)
    counts = {len(reading.range_m) for reading in d.readings}
    # A new speed from here on, at the angle where the head is.
    d.peer.begun_ns = d.now_ns
    d.peer.sent = 0
    d.peer.turns_hz = 10.0
    d.run(2.0)
    assert max(counts) > 560
    assert len(d.readings[-1].range_m) == pytest.approx(400, abs=2)
    assert d.readings[-1].scan_period_ns == pytest.approx(100 * MS, rel=0.02)
    assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(d.readings))


def test_silence_power_cycle_and_return() -> None:
    d = desk()
    d.run(3.0)
    d.peer.power, d.peer.kind = False, None
    d.run(0.6)
    assert d.state is LinkState.SILENT
    d.run(3.0)
    assert "does not answer" in d.trouble
    d.peer.power = True
    d.peer.out.append((d.now_ns + 20 * MS, b"RP LIDAR System.\r\nFirmware Ver 1.29\r\n"))
    d.run(2.0)
    assert d.readings[-1].stamp_ns > d.now_ns - 400 * MS
    assert d.trouble == ""


def test_loss_within_a_turn_makes_two_readings_of_it() -> None:
    d = desk(scan_mode="standard")
    d.run(3.0)
    before = len(d.readings)
    whole = d.peer.stream
    lost = {"left": 23}  # bytes

    def lossy(now_ns: int) -> None:
        seen = len(d.peer.out)
        whole(now_ns)
        for at in range(seen, len(d.peer.out)):
            when, data = d.peer.out[at]
            cut = min(lost["left"], len(data))
            lost["left"] -= cut
            d.peer.out[at] = (when, data[cut:])

    d.peer.stream = lossy  # type: ignore[method-assign]
    d.run(1.0)
    assert d.conversation.counters.drops["gap"] == 1
    for reading in d.readings[before:]:
        check_scan(reading, 0.05)
        check_times(d, reading, 2.5 * MS)
    pieces = [len(reading.range_m) for reading in d.readings[before:] if len(reading.range_m) < 280]
    assert len(pieces) in (1, 2)
    assert sum(len(reading.range_m) for reading in d.readings[before:]) > 1.0 * 7 * 2000 / 7 - 290 - 12


def test_distance_zero_and_limits() -> None:
    for no_echo, expected in (("unknown", "nan"), ("clear", "inf")):
        d = desk(scan_mode="standard", no_echo=no_echo)
        d.run(2.0)
        d.peer.kind = None
        d.run(0.05)
        turn = [node(angle, [0, 100, 13_000, 3000][angle // 90], start=angle == 0) for angle in range(360)]
        d.take(b"".join(turn) + b"".join(node(angle, 0, start=angle == 0) for angle in range(7)))
        found = d.readings[-1].range_m
        assert {str(each) for each in found} == {expected, "-inf", "inf", "3.0"}


def test_nobody_and_somebody_else() -> None:
    d = desk(Peer(power=False))
    d.run(2.0)
    assert d.state is LinkState.SILENT
    assert "does not answer" in d.trouble
    for _ in range(200):
        d.take(b"$GPGGA,4807.038,N,01131.000,E\r\n")
        d.run(0.01)
    assert "another device" in d.trouble


def test_arguments() -> None:
    for arguments in ({"scan_mode": "fast"}, {"pwm": 0}, {"pwm": 1024}):
        with pytest.raises(ValueError):
            desk(None, **arguments)


def test_stream_kinds_announce_themselves() -> None:
    assert AnswerReader().feed(NODES_HEAD, 0) == [Answer(NODES)]
    assert AnswerReader().feed(CAPSULES_HEAD, 0) == [Answer(CAPSULES)]
