"""SICK CoLa binary: telegrams against published and recorded ones, the conversation against a peer. Time by hand."""

from __future__ import annotations

import gzip
import math
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import reduce
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from drivers.cola import (
    TelegramReader,
    decode_identity,
    decode_scan,
    encode_telegram,
    exact_step_deg,
    trouble_of_status,
)
from drivers.errors import FrameError
from drivers.laser_sick_cola import (
    ASK_STATE,
    IDENTIFY,
    LOG_IN,
    RUN,
    START_MEASURING,
    SUBSCRIBE,
    UNSUBSCRIBE,
    SickColaConversation,
)
from drivers.readings import LinkState, ScanReading

MS = 1_000_000
S = 1000 * MS


def telegram(payload: bytes) -> bytes:
    """Written out here so that a misreading in the driver does not agree with itself."""
    return (
        b"\x02\x02\x02\x02" + struct.pack(">I", len(payload)) + payload + bytes([reduce(lambda a, b: a ^ b, payload)])
    )


TAIL = bytes(8) + b"\x00\x01" + bytes.fromhex("07b2 01 01 00 32 0e 00021340") + b"\x00\x00"


def scan_payload(
    raw: list[int],
    *,
    scan_us: int = 1000,
    sent_us: int = 7000,
    serial: int = 18480390,
    status: int = 0,
    hz: float = 15.0,
    first: int = -450000,
    step: int = 3333,
    scale: float = 1.0,
    rssi: list[int] | None = None,
    encoders: int = 0,
    tail: bytes = TAIL,
    head: bytes = b"sSN LMDscandata ",
) -> bytes:
    fixed = struct.pack(">HHIHHHIIHHHII", 1, 1, serial, status, 5, 6, scan_us, sent_us, 0, 8, 0, round(hz * 100), 162)
    body = fixed + struct.pack(">H", encoders) + bytes(6 * encoders)
    rows = [(b"DIST1", raw, scale)] + ([(b"RSSI1", rssi, 1.0)] if rssi is not None else [])
    body += struct.pack(">H", len(rows))
    for name, values, factor in rows:
        body += struct.pack(">5sffiHH", name, factor, 0.0, first, step, len(values))
        body += b"".join(value.to_bytes(2, "big") for value in values)
    return head + body + tail


def test_published_request() -> None:
    """From the operating instructions of the TiM781, p. 41."""
    published = bytes.fromhex("02 02 02 02 00 00 00 0F 73 52 4E 20 4C 4D 44 73 63 61 6E 64 61 74 61 05")
    assert encode_telegram(b"sRN LMDscandata") == published
    assert [each.payload for each in TelegramReader().feed(published, 0)] == [b"sRN LMDscandata"]


def test_requests_have_binary_arguments() -> None:
    assert telegram(b"sRN DeviceIdent") == IDENTIFY
    assert telegram(b"sEN LMDscandata \x01") == SUBSCRIBE
    assert telegram(b"sEN LMDscandata \x00") == UNSUBSCRIBE
    assert telegram(b"sMN SetAccessMode " + bytes.fromhex("03F4724744")) == LOG_IN


def test_identity() -> None:
    payload = b"sRA DeviceIdent \x00\x10LMS10x_FieldEval\x00\x10V1.36-21.10.2010"
    assert decode_identity(payload) == ("LMS10x_FieldEval", "V1.36-21.10.2010")
    assert decode_identity(b"sRA DeviceIdent ") == ("", "")


STEPS = [
    (0.3333, 1 / 3),
    (0.1667, 1 / 6),
    (0.1666, 1 / 6),
    (0.0833, 1 / 12),
    (0.5, 0.5),
    (0.25, 0.25),
    (1, 1),
    (0.2, 0.2),
]


@pytest.mark.parametrize(("sent", "exact"), STEPS)
def test_steps_are_made_exact(sent: float, exact: float) -> None:
    assert exact_step_deg(sent) == exact


@pytest.mark.parametrize(("status", "word"), [(0, None), (1, "error"), (2, "dirty"), (4, "dirty"), (5, "error")])
def test_status(status: int, word: str | None) -> None:
    trouble = trouble_of_status(status)
    assert (trouble is None) if word is None else (trouble is not None and word in trouble)


def test_encoders_and_a_second_row_are_understood() -> None:
    scan = decode_scan(scan_payload([20, 30], rssi=[7, 8], encoders=2, scale=2.0))
    assert scan.channels["DIST1"].scaled.tolist() == [40.0, 60.0]
    assert scan.channels["RSSI1"].raw.tolist() == [7.0, 8.0]
    assert scan.channels["DIST1"].first_deg == -45.0
    assert not scan.tail_is_odd


@pytest.mark.parametrize("cut", [10, 60, 80, 90])
def test_cut_scans_are_refused(cut: int) -> None:
    with pytest.raises(FrameError):
        decode_scan(scan_payload([1000] * 20)[:cut])


@pytest.mark.parametrize(
    "tail",
    [TAIL[:-1], TAIL + b"\0", TAIL[:4] + b"\x00\x07" + TAIL[6:], TAIL[:12] + b"\x0d" + TAIL[13:], TAIL[:2]],
)
def test_odd_tails_are_noticed(tail: bytes) -> None:
    assert decode_scan(scan_payload([1000] * 5, tail=tail)).tail_is_odd


def test_name_and_position_in_the_tail() -> None:
    position = b"\x00\x01" + bytes(25)
    name = b"\x00\x01\x05front"
    tail = b"\x00\x00" + position + name + b"\x00\x00" + b"\x00\x00" + b"\x00\x00"
    assert not decode_scan(scan_payload([1000] * 5, tail=tail)).tail_is_odd


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
class TestRecorded:
    """301 scans of a TiM at 15 Hz."""

    @staticmethod
    def data() -> bytes:
        return gzip.decompress(
            (Path(os.environ["UMFELD_DATA"]) / "device_bytes/sick_tim_colab_tcp.bin.gz").read_bytes()
        )

    def chunks(self) -> list[tuple[int, bytes]]:
        table = Path(os.environ["UMFELD_DATA"]) / "device_bytes/sick_tim_colab_tcp.chunks.csv.gz"
        data = self.data()
        rows = [row.split(",") for row in gzip.decompress(table.read_bytes()).decode().split()[1:]]
        begin = float(rows[0][0])
        return [(round((float(t) - begin) * S) + S, data[int(at) : int(at) + int(size)]) for t, at, size in rows]

    def test_every_scan_as_struct_reads_it(self) -> None:
        data = self.data()
        telegrams = TelegramReader().feed(data, 0)
        assert len(telegrams) == 301
        for number, each in enumerate(telegrams):
            frame = data[number * 3374 : (number + 1) * 3374]
            scan = each.scan
            assert scan is not None
            at = frame.index(b"DIST1") + 21
            assert scan.channels["DIST1"].raw.tolist() == list(struct.unpack_from(">811H", frame, at))
            at = frame.index(b"RSSI1") + 21
            assert scan.channels["RSSI1"].raw.tolist() == list(struct.unpack_from(">811H", frame, at))
            assert scan.serial == 18480390
            assert scan.scans_per_s == 15.0
            assert scan.beams_per_s == 16200.0
            assert scan.scan_count == 0xAFB5 + number
            assert not scan.tail_is_odd

    def test_any_split_start_and_noise(self) -> None:
        data = self.data()[: 3374 * 12]
        frames = [data[at : at + 3374] for at in range(0, len(data), 3374)]
        rng = np.random.default_rng(6)
        for _ in range(30):
            start = int(rng.integers(1, 3374))
            noise = [rng.bytes(int(rng.integers(0, 60))) for _ in range(12)]
            noisy = frames[0][start:] + b"".join(a + b for a, b in zip(noise, frames[1:], strict=False)) + noise[-1]
            cuts = [0, *sorted(rng.integers(0, len(noisy), 20).tolist()), len(noisy)]
            reader = TelegramReader()
            found = [each.payload for a, b in pairwise(cuts) for each in reader.feed(noisy[a:b], 0)]
            assert found == [frame[8:-1] for frame in frames[1:]]

    def test_as_a_conversation(self) -> None:
        conversation = SickColaConversation()
        conversation.connected(0)
        conversation.requests(0)
        list(conversation.receive(telegram(b"sRA DeviceIdent \x00\x04TiM7\x00\x02V1"), 10 * MS))
        conversation.requests(10 * MS)
        readings: list[ScanReading] = []
        arrived: list[int] = []
        for stamp_ns, chunk in self.chunks():
            for reading in conversation.receive(chunk, stamp_ns):
                assert isinstance(reading, ScanReading)
                readings.append(reading)
                arrived.append(stamp_ns)
        assert len(readings) == 301
        assert conversation.counters.drops == {}
        assert conversation.state is LinkState.RUNNING
        assert conversation.identity is not None
        assert conversation.identity.serial == "18480390"
        steps = np.diff([reading.stamp_ns for reading in readings])
        assert np.abs(steps[20:] - 66.67 * MS).max() < 0.4 * MS  # arrivals jump by 1 ms
        reading = readings[-1]
        np.testing.assert_allclose(np.degrees(reading.bearing_rad[[0, 405, 810]]), [-135, 0, 135], atol=1e-9)
        assert reading.beam_period_ns == pytest.approx(S / 16200, rel=1e-6)
        # No beam after its bytes were sent, and not long before.
        lag_ns = np.array(arrived) - np.array([r.stamp_ns + r.beam_period_ns * 810 for r in readings])
        assert lag_ns.min() >= 0
        assert lag_ns.max() < 10 * MS
        codes = np.isnan(reading.range_m)
        assert 0.0 < codes.mean() < 0.5
        assert np.nanmin(reading.range_m) >= 0.05


# --- the conversation -------------------------------------------------------------------------------------------------


@dataclass
class Peer:
    measures: bool = True
    speaks_binary: bool = True
    knows_its_name: bool = True
    knows_its_state: bool = True
    warms_up_ns: int = 0
    measures_from_ns: int = 1 << 62
    told: list[int] = field(default_factory=list)
    power: bool = True
    raw: list[int] = field(default_factory=lambda: [1000 + i for i in range(811)])
    clock_us: int = (1 << 32) - 3_000_000  # wraps after three seconds
    status: int = 0
    sends: bool = False
    serial: int = 18480390
    delay_ns: int = 1 * MS
    late_ns: Callable[[int], int] = lambda _: 0
    received: list[bytes] = field(default_factory=list)
    out: list[tuple[int, bytes]] = field(default_factory=list)
    scan: int = 0

    def heard(self, item: bytes, now_ns: int) -> None:
        if not self.power:
            return
        payload = item[8:-1]
        self.received.append(payload)
        if not self.speaks_binary:
            self.out.append((now_ns + MS, b"\x02sFA 1\x03"))
        elif payload == b"sRN SCdevicestate" and self.knows_its_state:
            self.tell(b"sRA SCdevicestate \x01", now_ns)
        elif payload == b"sRN DeviceIdent" and self.knows_its_name:
            self.tell(b"sRA DeviceIdent \x00\x07TiM551B\x00\x04V2.5", now_ns)
        elif payload.startswith(b"sEN LMDscandata "):
            self.sends = payload[-1] == 1
            self.tell(b"sEA LMDscandata " + payload[-1:], now_ns)
        elif payload == b"sMN Run":
            self.measures_from_ns = now_ns + self.warms_up_ns
            self.tell(b"sAN Run \x01", now_ns)
        elif payload.startswith(b"sMN"):
            self.tell(b"sAN" + payload[3:].split(b" ")[0] + payload[3:18] + b" \x01", now_ns)

    def tell(self, payload: bytes, now_ns: int) -> None:
        self.out.append((now_ns + self.delay_ns, telegram(payload)))
        self.told.append(now_ns)

    def turn(self, now_ns: int) -> None:
        """A scan of 50 ms every 1/15 s, sent 6 ms after its last beam."""
        while (end_ns := self.scan * S // 15 + 50 * MS) <= now_ns:
            self.scan += 1
            self.measures = self.measures or now_ns >= self.measures_from_ns
            if self.power and self.sends and self.measures:
                self.told.append(now_ns)
                us = [(self.clock_us + at // 1000) % (1 << 32) for at in (end_ns, end_ns + 6 * MS)]
                payload = scan_payload(self.raw, scan_us=us[0], sent_us=us[1], serial=self.serial, status=self.status)
                self.out.append((end_ns + 6 * MS + self.delay_ns + self.late_ns(self.scan), telegram(payload)))


@dataclass
class Desk:
    conversation: SickColaConversation
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
            self.peer.turn(self.now_ns)
            due = [data for when, data in self.peer.out if when <= self.now_ns]
            self.peer.out = [each for each in self.peer.out if each[0] > self.now_ns]
            for data in due:
                self.take(data)
            for item in self.conversation.requests(self.now_ns):
                assert isinstance(item, bytes)
                self.peer.heard(item, self.now_ns)

    def take(self, data: bytes) -> None:
        for reading in self.conversation.receive(data, self.now_ns):
            assert isinstance(reading, ScanReading)
            self.readings.append(reading)


def desk(peer: Peer | None = None, **arguments: object) -> Desk:
    return Desk(SickColaConversation(**arguments), peer or Peer())  # type: ignore[arg-type]


def test_from_connection_to_scans() -> None:
    d = desk()
    d.run(6.0)
    assert d.state is LinkState.RUNNING
    assert d.trouble == ""
    assert d.conversation.identity is not None
    identity = d.conversation.identity
    assert (identity.vendor, identity.model, identity.serial, identity.firmware) == (
        "SICK",
        "TiM551B",
        "18480390",
        "V2.5",
    )
    assert d.peer.received == [b"sRN DeviceIdent", b"sEN LMDscandata \x01"]
    assert len(d.readings) > 80
    assert d.conversation.counters.drops == {}
    reading = d.readings[-1]
    np.testing.assert_allclose(reading.range_m, 1.0 + np.arange(811) / 1000)
    assert reading.intensity is None
    assert reading.range_max_m == 10.0
    assert reading.scan_period_ns == pytest.approx(S / 15, abs=1)


def test_stamps_are_the_first_beam_also_when_messages_are_late() -> None:
    d = desk(Peer(late_ns=lambda scan: 20 * MS if scan % 7 == 0 else 0))
    d.run(8.0)
    for reading in d.readings[30:]:
        # The peer's sweeps begin at whole fifteenths of a second; its delay cannot be known.
        late_ns = (reading.stamp_ns - d.peer.delay_ns + S // 30) % (S // 15) - S // 30
        assert abs(late_ns) < 1.5 * MS
    assert d.conversation.clock_fit is not None
    assert abs(d.conversation.clock_fit.drift_ppm) < 500


def test_codes_and_limits() -> None:
    raw = [0, 1, 2, 15, 16, 40, 5000, 12_000]
    for no_echo, first in (("unknown", math.nan), ("clear", math.inf)):
        d = desk(Peer(raw=raw), no_echo=no_echo)
        d.run(1.0)
        expected = [first, math.nan, math.nan, math.nan, -math.inf, -math.inf, 5.0, math.inf]
        np.testing.assert_array_equal(d.readings[-1].range_m, expected)


def test_status_is_told() -> None:
    d = desk(Peer(status=2))
    d.run(1.0)
    assert d.state is LinkState.RUNNING
    assert "dirty" in d.trouble
    d.peer.status = 0
    d.run(0.2)
    assert d.trouble == ""


def test_a_scanner_that_does_not_measure_is_started() -> None:
    d = desk(Peer(measures=False))
    d.run(4.0)
    assert d.state is LinkState.RUNNING
    sent = [telegram(each) for each in d.peer.received]
    assert sent[2:8] == [ASK_STATE, ASK_STATE, ASK_STATE, LOG_IN, START_MEASURING, RUN]
    d = desk(Peer(measures=False), start=False)
    d.run(4.0)
    assert d.state is LinkState.STARTING
    assert "start = true" in d.trouble
    assert LOG_IN not in [telegram(each) for each in d.peer.received]


def test_a_connection_to_a_scanner_that_does_not_measure_yet_never_looks_dead() -> None:
    """The reader opens a TCP connection again on which nothing came for 1.5 s: the start would never be reached."""
    d = desk(Peer(measures=False, warms_up_ns=9 * S))
    for _ in range(15):
        heard = len(d.peer.told)
        d.run(1.0)
        assert len(d.peer.told) > heard
    assert d.state is LinkState.RUNNING


def test_a_scanner_that_does_not_know_its_name_is_read_all_the_same() -> None:
    """As other projects' simple servers: they answer what their own driver asks, and nothing else."""
    d = desk(Peer(knows_its_name=False))
    d.run(4.0)
    assert d.state is LinkState.RUNNING
    assert d.conversation.identity is not None
    assert d.conversation.identity.model == "CoLa scanner"


def test_text_dialect_is_named() -> None:
    d = desk(Peer(speaks_binary=False))
    d.run(2.0)
    assert d.state is LinkState.SILENT
    assert "CoLa B" in d.trouble


def test_power_cycle() -> None:
    d = desk()
    d.run(2.0)
    d.peer.power = False
    d.run(0.5)
    assert d.state is LinkState.SILENT
    d.run(1.5)
    assert "does not answer" in d.trouble
    d.peer.power, d.peer.sends, d.peer.clock_us = True, False, 1_000_000 - d.now_ns // 1000
    d.run(2.0)
    assert d.readings[-1].stamp_ns > d.now_ns - 200 * MS
    assert d.trouble == ""


def test_damage_that_the_sum_does_not_find() -> None:
    d = desk()
    d.run(2.0)
    before = len(d.readings)
    good = {"scan_us": 10, "sent_us": 6010}
    for payload, reason in (
        (scan_payload(d.peer.raw, serial=7, **good), "other_serial"),  # type: ignore[arg-type]
        (scan_payload(d.peer.raw, tail=TAIL + b"\0", **good), "odd_tail"),  # type: ignore[arg-type]
        (scan_payload(d.peer.raw, scan_us=99_000_000, sent_us=99_006_000), "implausible_stamp"),
        (scan_payload(d.peer.raw, hz=0.0), "bad_layout"),
        (scan_payload([]), "no_distances"),
        (scan_payload(d.peer.raw, scale=math.nan), "bad_layout"),
    ):
        d.take(telegram(payload))
        assert d.conversation.counters.drops.pop(reason) == 1
    assert len(d.readings) == before
    d.run(0.5)
    assert len(d.readings) > before + 5
    assert set(d.conversation.counters.drops) == {"noise_bytes"}  # their bytes were looked through for a telegram


def test_another_unit_is_believed_at_last() -> None:
    d = desk()
    d.run(2.0)
    d.peer.serial = 20010001
    d.run(1.0)
    assert d.conversation.identity is not None
    assert d.conversation.identity.serial == "20010001"


def test_a_broken_telegram_does_not_hold_up_the_reply_behind_it() -> None:
    d = desk(Peer(power=False))
    d.run(0.05)
    d.take(telegram(scan_payload(d.peer.raw))[:900])
    d.take(telegram(b"sRA DeviceIdent \x00\x01T\x00\x01V"))
    d.run(0.2)
    assert d.state is LinkState.STARTING


def test_farewell() -> None:
    assert SickColaConversation().farewell() == [UNSUBSCRIBE]


def test_a_simple_server_that_only_sends_scans() -> None:
    d = desk(Peer(knows_its_name=False, knows_its_state=False))
    d.run(4.0)
    assert d.state is LinkState.RUNNING
    assert len(d.readings) > 20
    assert d.conversation.identity is not None
