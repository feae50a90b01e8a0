"""SICK LMS2xx: telegrams against published ones, and the conversation against a peer that answers by the listing.

The peer is a table of replies with a few switches and a line that takes its time; it is no emulator. Time is turned
by hand.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from drivers.checksums import crc16_sick
from drivers.conversation import SetBaudRate
from drivers.errors import FrameError
from drivers.laser_sick_lms2xx import ASK_STATUS, ASK_TYPE, INSTALLATION, START, STOP, SickLms2xxConversation, Unit
from drivers.readings import LinkState, ScanReading
from drivers.sick_telegrams import (
    MEASURING_MODES,
    TelegramReader,
    crc16_fast,
    decode_status,
    decode_type,
    decode_values,
    encode_telegram,
    range_max_m,
    ranges_of,
    trouble_of_status,
)

MS = 1_000_000
S = 1000 * MS


def hexed(text: str) -> bytes:
    return bytes.fromhex(text)


def reply(payload: bytes, address: int = 0x80) -> bytes:
    """A telegram of the scanner, written out here so that a misreading in the driver does not agree with itself."""
    frame = bytes([0x02, address]) + len(payload).to_bytes(2, "little") + payload
    return frame + crc16_sick(frame).to_bytes(2, "little")


def values_reply(words: list[int], *, mm: bool = True, info: int = 0, status: int = 0x10) -> bytes:
    head = len(words) | (0x4000 if mm else 0) | info
    return reply(
        b"\xb0" + head.to_bytes(2, "little") + b"".join(w.to_bytes(2, "little") for w in words) + bytes([status])
    )


HOST_TELEGRAMS = {
    "10": "02 00 01 00 10 34 12",
    "31": "02 00 01 00 31 15 12",
    "3A": "02 00 01 00 3A 1E 12",
    "74": "02 00 01 00 74 50 12",
    "20 00 53 49 43 4B 5F 4C 4D 53": "02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5",
    "20 24": "02 00 02 00 20 24 34 08",
    "20 25": "02 00 02 00 20 25 35 08",
    "20 42": "02 00 02 00 20 42 52 08",
    "20 41": "02 00 02 00 20 41 51 08",
    "20 40": "02 00 02 00 20 40 50 08",
    "20 48": "02 00 02 00 20 48 58 08",
    "30 01": "02 00 02 00 30 01 31 18",
    "3B B4 00 64 00": "02 00 05 00 3B B4 00 64 00 97 49",
    "3B B4 00 32 00": "02 00 05 00 3B B4 00 32 00 3B 1F",
    "3B 64 00 64 00": "02 00 05 00 3B 64 00 64 00 1D 0F",
    "3B 64 00 32 00": "02 00 05 00 3B 64 00 32 00 B1 59",
    "3B 64 00 19 00": "02 00 05 00 3B 64 00 19 00 E7 72",
}


@pytest.mark.parametrize(("payload", "frame"), HOST_TELEGRAMS.items())
def test_host_telegrams(payload: str, frame: str) -> None:
    assert encode_telegram(hexed(payload)) == hexed(frame)


def test_constants_are_the_published_telegrams() -> None:
    assert hexed(HOST_TELEGRAMS["20 25"]) == STOP
    assert hexed(HOST_TELEGRAMS["20 24"]) == START
    assert hexed(HOST_TELEGRAMS["3A"]) == ASK_TYPE
    assert hexed(HOST_TELEGRAMS["31"]) == ASK_STATUS
    assert hexed(HOST_TELEGRAMS["20 00 53 49 43 4B 5F 4C 4D 53"]) == INSTALLATION


TYPE_TEXT = b"LMS200;301063;V02.10 "
SCANNER_TELEGRAMS = [
    ("02 80 03 00 A0 00 10 16 0A", "A0 00 10"),
    ("02 81 03 00 A0 00 10 36 1A", "A0 00 10"),
    ("02 80 07 00 BB 01 B4 00 32 00 10 03 9D", "BB 01 B4 00 32 00 10"),
    ("02 80 02 00 91 10 79 30", "91 10"),
    ("02 80 02 00 92 10 7F 33", "92 10"),
    (f"02 80 17 00 BA {TYPE_TEXT.hex()} 10 22 61", f"BA {TYPE_TEXT.hex()} 10"),
    (f"02 80 17 00 90 {TYPE_TEXT.hex()} 10 63 5E", f"90 {TYPE_TEXT.hex()} 10"),
    ("02 80 0E 00 B0 05 40 E8 03 E9 03 FF 1F 51 00 C4 09 10 B3 42", "B0 05 40 E8 03 E9 03 FF 1F 51 00 C4 09 10"),
]


@pytest.mark.parametrize(("frame", "payload"), SCANNER_TELEGRAMS)
def test_scanner_telegrams(frame: str, payload: str) -> None:
    (telegram,) = TelegramReader().feed(hexed(frame), 0)
    assert telegram.payload == hexed(payload)
    assert telegram.size == len(hexed(frame))


def test_type_names_model_and_firmware() -> None:
    assert decode_type(b"\xba" + TYPE_TEXT + b"\x10") == ("LMS200", "V02.10")
    assert decode_type(b"\xba\x10") == ("", "")


@pytest.mark.parametrize(
    ("words", "mm", "size", "begin", "end"),
    [
        (list(range(1000, 1361)), True, 732, "02 80 D6 02 B0 69 41 E8 03 E9 03", "50 05 10 86 0C"),
        (list(range(100, 281)), False, 372, "02 80 6E 01 B0 B5 00 64 00 65 00", "18 01 10 BB 6D"),
    ],
)
def test_published_scans(words: list[int], mm: bool, size: int, begin: str, end: str) -> None:
    frame = values_reply(words, mm=mm)
    assert len(frame) == size
    assert frame.startswith(hexed(begin))
    assert frame.endswith(hexed(end))
    (telegram,) = TelegramReader().feed(frame, 0)
    values = decode_values(telegram.payload)
    assert values.words.tolist() == words
    assert values.unit_mm == (1 if mm else 10)
    np.testing.assert_allclose(ranges_of(values, MEASURING_MODES[0]), np.array(words) * (0.001 if mm else 0.01))


def test_codes_are_no_distances() -> None:
    words = [0x1FFF, 0x1FFE, 0x1FFD, 0x1FFC, 0x1FFB, 0x1FFA, 0x1FF9, 0x1FF8, 0x1FF7, 0x1FF6, 0, 81, 0x8000 | 500]
    words += [0x2000 | 600, 0x4000 | 700]  # inside field A, field B
    range_m = ranges_of(decode_values(TelegramReader().feed(values_reply(words), 0)[0].payload), MEASURING_MODES[0])
    assert np.isnan(range_m[:8]).all()
    assert range_m[8] == math.inf
    assert range_m[9] == pytest.approx(8.182)
    assert range_m[10] == -math.inf
    assert range_m[11] == pytest.approx(0.081)
    assert math.isnan(range_m[12])  # dazzled
    np.testing.assert_allclose(range_m[13:], [0.6, 0.7])


def test_modes_with_more_bits_of_distance() -> None:
    words = [0x3FFF, 0x3FF7, 0x1FFF, 0xC000 | 5]
    payload = TelegramReader().feed(values_reply(words), 0)[0].payload
    in_16_m = ranges_of(decode_values(payload), MEASURING_MODES[4])
    assert math.isnan(in_16_m[0])
    assert in_16_m[1] == math.inf
    np.testing.assert_allclose(in_16_m[2:], [8.191, 0.005])
    assert range_max_m(1, MEASURING_MODES[0]) == pytest.approx(8.182)
    assert range_max_m(10, MEASURING_MODES[0]) == pytest.approx(81.82)
    assert range_max_m(1, MEASURING_MODES[0x0F]) == pytest.approx(32.758)


@pytest.mark.parametrize("payload", [b"\xb0", b"\xb0\x05\x40\x10", b"\xb0\x00\x80\x10", b"\xb1\x00\x00\x10"])
def test_values_that_do_not_fit_are_refused(payload: bytes) -> None:
    with pytest.raises(FrameError):
        decode_values(payload)


def test_short_status_is_refused() -> None:
    with pytest.raises(FrameError):
        decode_status(b"\xb1" + bytes(100) + b"\x10")


@pytest.mark.parametrize(
    ("status", "word"), [(0x10, None), (0x90, "dirty"), (0x13, "error"), (0x14, "fatal"), (0x50, "implausible")]
)
def test_status_byte(status: int, word: str | None) -> None:
    trouble = trouble_of_status(status)
    assert (trouble is None) if word is None else (trouble is not None and word in trouble)


def test_fast_crc_is_the_crc() -> None:
    rng = np.random.default_rng(3)
    for size in (5, 6, 7, 100, 732, 814):
        frame = rng.bytes(size)
        assert crc16_fast(frame + crc16_sick(frame).to_bytes(2, "little")) == 0
        assert crc16_fast(frame + ((crc16_sick(frame) + 1) % 65536).to_bytes(2, "little")) != 0


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
def test_recorded_telegram_at_any_split_and_among_noise() -> None:
    frame = (Path(os.environ["UMFELD_DATA"]) / "device_bytes/sick_lms2xx_361.bin").read_bytes()
    rng = np.random.default_rng(1)
    (whole,) = TelegramReader().feed(frame, 0)
    values = decode_values(whole.payload)
    assert len(values.words) == 361
    assert values.unit_mm == 1
    assert values.words[:7].tolist() == [0x08CB, 0x08CB, 0x08C2, 0x08C2, 0x08C3, 0x08BA, 0x08B9]
    assert values.words[-3:].tolist() == [0x22B1, 0x22D7, 0x0518]
    for start in range(1, len(frame), 7):
        reader = TelegramReader()
        noise = rng.bytes(int(rng.integers(0, 40))).replace(b"\x02", b"\x03")
        data = frame[start:] + noise + frame + noise + frame + noise
        cuts = [0, *sorted(rng.integers(0, len(data), 5).tolist()), len(data)]
        found = [each for a, b in pairwise(cuts) for each in reader.feed(data[a:b], 0) if each.size > 1]
        assert [each.payload for each in found] == [whole.payload] * 2


# --- the conversation -------------------------------------------------------------------------------------------------


@dataclass
class Peer:
    """A scanner behind a line of its speed. pending: (when, bytes) on their way to the host."""

    speed: int = 9600
    address: int = 0x80
    power: bool = True
    streaming: bool = False
    unit_mm: bool = False
    mode: int = 0
    variant: tuple[int, int] = (180, 100)
    nak_next: int = 0
    knows_type: bool = True
    mute_to: bytes = b""  # commands
    refuse_38400: bool = False
    status: int = 0x10
    paced: bool = True
    word: int = 1000
    received: list[bytes] = field(default_factory=list)
    pending: list[tuple[int, bytes]] = field(default_factory=list)
    line_free_ns: int = 0
    line_speed: int = 0
    installation: bool = False

    def heard(self, item: bytes | SetBaudRate, now_ns: int) -> None:
        if isinstance(item, SetBaudRate):
            self.line_speed = item.bits_per_s
            return
        if not self.power or self.line_speed != self.speed:
            return
        assert crc16_sick(item[:-2]) == int.from_bytes(item[-2:], "little")
        if self.nak_next:
            self.nak_next -= 1
            self.send(b"\x15", now_ns)
            return
        self.received.append(item[4:-2])
        if item[4] in self.mute_to:
            return
        self.send(b"\x06", now_ns)
        self.answer(item[4:-2], now_ns)

    def send(self, data: bytes, now_ns: int) -> None:
        at_ns = max(now_ns, self.line_free_ns)
        for start in range(0, len(data), 16):
            piece = data[start : start + 16]
            at_ns += len(piece) * 10 * S // self.speed if self.paced else 0
            self.pending.append((at_ns, piece))
        self.line_free_ns = at_ns

    def tell(self, payload: bytes, now_ns: int) -> None:
        self.send(reply(payload + bytes([self.status]), self.address), now_ns + 5 * MS)

    def answer(self, payload: bytes, now_ns: int) -> None:
        new_speed = {0x42: 9600, 0x41: 19200, 0x40: 38400, 0x48: 500000}
        if payload[0] == 0x20:
            if payload[1] == 0x40 and self.refuse_38400:
                self.tell(b"\xa0\x02", now_ns)
                return
            self.streaming = payload[1] == 0x24
            self.installation = payload[1:] == b"\x00SICK_LMS"
            self.tell(b"\xa0\x00", now_ns)
            self.speed = new_speed.get(payload[1], self.speed)
        elif payload == b"\x3a":
            self.tell(b"\xba" + TYPE_TEXT if self.knows_type else b"\x92", now_ns)
        elif payload == b"\x31":
            data = bytearray(152)
            data[:7] = b"V02.10 "
            self.tell(b"\xb1" + bytes(data), now_ns)
        elif payload == b"\x74":
            self.tell(b"\xf4" + self.configuration(), now_ns)
        elif payload[0] == 0x77:
            assert len(payload) == 35
            accepted = self.installation
            if accepted:
                self.mode, self.unit_mm = payload[6], payload[7] == 1
            self.tell(b"\xf7" + bytes([accepted]) + self.configuration(), now_ns)
        elif payload[0] == 0x3B:
            self.variant = (payload[1], payload[3])
            self.tell(b"\xbb\x01" + payload[1:], now_ns)

    def configuration(self) -> bytes:
        data = bytearray(34)
        data[0], data[2], data[5], data[6], data[9] = 0x00, 0x46, self.mode, self.unit_mm, 0x2A
        return bytes(data)

    def scan(self) -> bytes:
        count = self.variant[0] * 100 // self.variant[1] + 1
        return values_reply([self.word + i for i in range(count)], mm=self.unit_mm, status=self.status)


@dataclass
class Desk:
    """Conversation, peer and clock. The clock goes in steps of 1 ms."""

    conversation: SickLms2xxConversation
    peer: Peer
    now_ns: int = 0
    readings: list[ScanReading] = field(default_factory=list)
    sent_at: list[tuple[int, bytes]] = field(default_factory=list)
    next_turn_ns: int = 0
    measured: list[int] = field(default_factory=list)  # when the first beam of each scan sent was measured

    def __post_init__(self) -> None:
        self.conversation.connected(self.now_ns)

    def run(self, seconds: float) -> None:
        end = self.now_ns + round(seconds * S)
        while self.now_ns < end:
            self.now_ns += 1 * MS
            self.stream()
            due = [data for when, data in self.peer.pending if when <= self.now_ns]
            self.peer.pending = [each for each in self.peer.pending if each[0] > self.now_ns]
            if due:
                self.take(b"".join(due))
            for item in self.conversation.requests(self.now_ns):
                if isinstance(item, bytes):
                    self.sent_at.append((self.now_ns, item))
                self.peer.heard(item, self.now_ns)

    def take(self, data: bytes) -> None:
        for reading in self.conversation.receive(data, self.now_ns):
            assert isinstance(reading, ScanReading)
            self.readings.append(reading)

    @property
    def state(self) -> LinkState:
        return self.conversation.state

    def stream(self) -> None:
        """A telegram whenever the line is free, of the newest whole scan."""
        peer = self.peer
        if peer.power and peer.streaming and peer.line_free_ns <= self.now_ns >= self.next_turn_ns:
            turns = 100 // peer.variant[1]
            sweep_ns = (turns - 1 + peer.variant[0] / 360) * S / 75
            self.measured.append(round(self.now_ns - sweep_ns))
            peer.send(peer.scan(), self.now_ns)
            self.next_turn_ns = self.now_ns + round(turns * S / 75)


def desk(unit: Unit = "keep", baud: int = 38400, field_deg: int = 180, step: float = 0.5, **peer: object) -> Desk:
    conversation = SickLms2xxConversation(unit=unit, baud=baud, field_deg=field_deg, resolution_deg=step)
    return Desk(conversation, Peer(**peer))  # type: ignore[arg-type]


@pytest.mark.parametrize("speed", [9600, 19200, 38400])
@pytest.mark.parametrize("address", [0x80, 0x81])
def test_from_any_speed_to_scans(speed: int, address: int) -> None:
    d = desk(speed=speed, address=address)
    d.run(3.0)
    assert d.state is LinkState.RUNNING
    assert d.conversation.trouble is None
    assert d.peer.speed == 38400
    assert d.conversation.identity is not None
    assert (d.conversation.identity.vendor, d.conversation.identity.model) == ("SICK", "LMS200")
    assert d.conversation.identity.firmware == "V02.10"
    assert len(d.readings) >= 5
    reading = d.readings[-1]
    assert reading.range_m.shape == (361,)
    assert reading.intensity is None
    assert d.conversation.counters.drops == {}


def test_an_old_stream_is_stopped_first() -> None:
    d = desk(speed=38400, streaming=True, variant=(180, 100))
    d.run(3.0)
    assert d.state is LinkState.RUNNING
    assert {len(reading.range_m) for reading in d.readings} == {361}


@pytest.mark.parametrize(
    ("field_deg", "step", "count"),
    [(180, 1.0, 181), (180, 0.5, 361), (100, 1.0, 101), (100, 0.5, 201), (100, 0.25, 401)],
)
def test_bearings_and_times_of_every_variant(field_deg: int, step: float, count: int) -> None:
    d = desk(field_deg=field_deg, step=step, speed=38400)
    d.run(3.0)
    reading = d.readings[-1]
    # Value i looks i * step from the right end, whatever the order in which beams are handed out.
    value = np.rint(reading.range_m / 0.01 - 1000).astype(int)
    assert sorted(value.tolist()) == list(range(count))
    np.testing.assert_allclose(reading.bearing_rad, np.radians(value * step - field_deg / 2), atol=1e-9)
    # Beams of the same turn of the mirror are a degree apart, and a turn takes 13.3 ms.
    turns = round(1 / step)
    assert np.all(np.diff(value[: field_deg + 1]) == turns)
    when_ns = reading.beam_period_ns * np.arange(count)
    truth_ns = (value % turns + value * step / 360) * S / 75
    # Half of the time in which the mirror looks elsewhere, where a scan takes several turns.
    gap_ns = (1 - field_deg / 360) * S / 75 * 2 * (1 - step)
    assert np.abs(when_ns - truth_ns).max() < (1000 if turns == 1 else gap_ns / 2 + 0.1 * MS)
    assert when_ns[-1] == pytest.approx(truth_ns[-1], abs=1000)


def test_stamps_are_the_first_beam_with_wire_time_taken_off() -> None:
    d = desk(speed=38400)
    d.run(4.0)
    errors = [min(abs(reading.stamp_ns - measured) for measured in d.measured) for reading in d.readings[2:]]
    assert len(errors) > 8
    assert max(errors) < 2 * MS  # the clock here goes in steps of 1 ms
    assert d.readings[-1].scan_period_ns == pytest.approx(190.6 * MS, rel=0.01)


def test_stamps_of_a_line_that_takes_no_time() -> None:
    """A pty or a serial server delivers telegrams at once: nothing may then be taken off."""
    d = desk(speed=38400, paced=False)
    d.run(4.0)
    errors = [min(abs(reading.stamp_ns - measured) for measured in d.measured) for reading in d.readings[10:]]
    assert len(errors) > 20
    assert max(errors) < 2 * MS


@pytest.mark.parametrize(("unit", "is_mm", "factor"), [("mm", False, 0.001), ("cm", True, 0.01), ("cm", False, 0.01)])
def test_unit_is_written_only_where_it_differs(unit: Unit, is_mm: bool, factor: float) -> None:
    d = desk(unit=unit, unit_mm=is_mm)
    d.run(3.0)
    writes = [each for each in d.peer.received if each[0] == 0x77]
    assert len(writes) == (1 if (unit == "mm") != is_mm else 0)
    assert d.peer.unit_mm == (unit == "mm")
    assert d.readings[-1].range_m[0] == pytest.approx(1000 * factor)
    if writes:  # all else stays as it was read
        assert (writes[0][3], writes[0][10]) == (0x46, 0x2A)
    assert d.conversation.trouble is None


def test_measuring_mode_is_learnt() -> None:
    d = desk(mode=0x04, unit_mm=True, speed=38400, word=9000)
    d.run(3.0)
    assert d.readings[-1].range_m[0] == pytest.approx(9.0)
    assert d.readings[-1].range_max_m == pytest.approx(16.374)


def test_mode_without_distances_is_told() -> None:
    d = desk(mode=0x3F)
    d.run(3.0)
    assert not d.readings
    assert "measuring mode 3F" in (d.conversation.trouble or "")


def test_refused_telegrams_are_repeated_after_a_pause() -> None:
    d = desk(speed=38400, nak_next=2)
    d.run(3.0)
    assert d.state is LinkState.RUNNING
    gaps = [b - a for (a, _), (b, _) in pairwise(d.sent_at)]
    assert min(gaps[:2]) >= 30 * MS


def test_a_unit_without_type_and_a_refused_speed() -> None:
    d = desk(knows_type=False, refuse_38400=True)
    d.run(6.0)
    assert d.state is LinkState.RUNNING
    assert d.peer.speed == 9600
    assert "38400" in (d.conversation.trouble or "")
    assert d.conversation.identity is not None
    assert d.conversation.identity.firmware == "V02.10"
    assert d.conversation.silence_limit_ns > 1.4 * 760 * MS  # a scan takes 0.76 s here


def test_a_high_speed_line() -> None:
    d = desk(speed=500000, baud=500000, step=1.0)
    d.run(2.0)
    assert d.peer.speed == 500000
    assert d.state is LinkState.RUNNING
    assert len(d.readings) > 50


def test_pollution_is_told_and_taken_back() -> None:
    d = desk(speed=38400)
    d.run(2.0)
    d.peer.status = 0x90
    d.run(1.0)
    assert d.state is LinkState.RUNNING
    assert "dirty" in (d.conversation.trouble or "")
    d.peer.status = 0x10
    d.run(1.0)
    assert d.conversation.trouble is None


def test_power_cycle() -> None:
    d = desk(speed=38400)
    d.run(2.0)
    d.peer.power = False
    d.peer.pending.clear()
    d.run(0.55)
    assert d.state is LinkState.SILENT
    assert d.conversation.trouble is not None
    d.run(3.0)
    d.peer.power, d.peer.speed, d.peer.streaming, d.peer.variant = True, 9600, False, (180, 100)
    d.peer.send(reply(b"\x90" + TYPE_TEXT + b"\x10"), d.now_ns)
    before = len(d.readings)
    d.run(2.0)
    assert d.readings[before:]
    assert d.readings[-1].stamp_ns > d.now_ns - 500 * MS


def test_power_on_telegram_in_the_stream_starts_anew() -> None:
    d = desk(speed=9600, refuse_38400=True)
    d.run(5.0)
    assert d.state is LinkState.RUNNING
    d.peer.streaming = False
    d.peer.pending.clear()
    d.peer.line_free_ns = d.now_ns
    d.peer.send(reply(b"\x90" + TYPE_TEXT + b"\x10"), d.now_ns)
    d.run(0.3)
    assert d.sent_at[-1][0] > d.now_ns - 300 * MS  # asked again at once, not after a silence
    d.run(3.0)
    assert d.state is LinkState.RUNNING


def test_partial_scans() -> None:
    d = desk(speed=38400)
    d.run(2.0)
    d.peer.streaming = False
    d.run(0.2)
    before = len(d.readings)
    for number, count in ((0, 181), (1, 180), (2, 181), (1, 181)):
        frame = values_reply([2000] * count, info=0x2000 | number << 11)
        d.take(frame)
        d.now_ns += 20 * MS
    first, second = d.readings[before:]
    assert first.bearing_rad[0] == pytest.approx(-math.pi / 2)
    assert second.bearing_rad[0] == pytest.approx(math.radians(-89.5))
    assert first.beam_period_ns == pytest.approx(S / 75 / 360, rel=1e-3)
    assert d.conversation.counters.drops["bad_count"] == 2


def test_scans_of_another_variant_are_dropped() -> None:
    d = desk(speed=38400)
    d.run(2.0)
    before = len(d.readings)
    assert list(d.conversation.receive(values_reply([5] * 181), d.now_ns)) == []
    assert d.conversation.counters.drops["bad_count"] == 1
    assert len(d.readings) == before


def test_nobody_there_and_somebody_else_there() -> None:
    d = desk(power=False)
    d.run(3.0)
    assert d.state is LinkState.SILENT
    assert "does not answer" in (d.conversation.trouble or "")
    assert {item for _, item in d.sent_at} == {STOP}
    for _ in range(300):
        list(d.conversation.receive(b"$GPGGA,123519,4807.038,N\r\n", d.now_ns))
        d.run(0.01)
    assert "no LMS2xx telegrams" in (d.conversation.trouble or "")


def test_stamps_rise_strictly_even_if_the_host_stood_still() -> None:
    d = desk(speed=38400)
    d.run(2.0)
    d.peer.streaming = False
    frame = values_reply([1000] * 361)
    stamps = [
        reading.stamp_ns for reading in d.conversation.receive(frame * 5, d.now_ns) if isinstance(reading, ScanReading)
    ]
    assert len(stamps) == 5
    assert all(b > a for a, b in zip([d.readings[-1].stamp_ns, *stamps], stamps))


def test_farewell_stops_the_stream() -> None:
    assert SickLms2xxConversation().farewell() == [STOP]


@pytest.mark.parametrize("arguments", [{"field_deg": 90}, {"resolution_deg": 0.25}, {"baud": 115200}, {"unit": "m"}])
def test_wrong_arguments(arguments: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        SickLms2xxConversation(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize("variant", [(180, 50), (180, 100)])
def test_a_simple_device_that_only_stops_and_streams(variant: tuple[int, int]) -> None:
    """Others' simulators, mostly. Scans of another variant than the wanted one are dropped, not misread."""
    desk = Desk(SickLms2xxConversation(), Peer(mute_to=b"\x31\x3a\x3b\x74", variant=variant))
    desk.run(14.0)
    fits = variant == (180, 50)
    assert (desk.state is LinkState.RUNNING) == fits
    assert bool(desk.readings) == fits
    assert ("bad_count" in desk.conversation.counters.drops) == (not fits)
    assert not fits or "field and resolution" in (desk.conversation.trouble or "")
