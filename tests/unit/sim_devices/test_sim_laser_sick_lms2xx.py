"""The emulated SICK LMS2xx against published telegrams and the habits of the device."""

from __future__ import annotations

import itertools
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from sim_devices.checksums import sick_crc
from sim_devices.device import F64, Mount
from sim_devices.laser_sick_lms2xx import LMS2XX_PROFILES, LMS200, LMS291, SickLms2xxLaser

MS = 1_000_000
SECOND = 1_000_000_000

STATUS = bytes.fromhex("02 00 01 00 31 15 12")
TYPE = bytes.fromhex("02 00 01 00 3A 1E 12")
RESET = bytes.fromhex("02 00 01 00 10 34 12")
READ_CONFIG = bytes.fromhex("02 00 01 00 74 50 12")
INSTALL = bytes.fromhex("02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5")
STREAM = bytes.fromhex("02 00 02 00 20 24 34 08")
STOP = bytes.fromhex("02 00 02 00 20 25 35 08")
TO_9600 = bytes.fromhex("02 00 02 00 20 42 52 08")
TO_38400 = bytes.fromhex("02 00 02 00 20 40 50 08")
TO_500000 = bytes.fromhex("02 00 02 00 20 48 58 08")
ONE_SCAN = bytes.fromhex("02 00 02 00 30 01 31 18")
FULL = bytes.fromhex("02 00 05 00 3B B4 00 64 00 97 49")
FULL_HALF = bytes.fromhex("02 00 05 00 3B B4 00 32 00 3B 1F")
NARROW = bytes.fromhex("02 00 05 00 3B 64 00 64 00 1D 0F")
NARROW_HALF = bytes.fromhex("02 00 05 00 3B 64 00 32 00 B1 59")
NARROW_QUARTER = bytes.fromhex("02 00 05 00 3B 64 00 19 00 E7 72")

A0_OK = bytes.fromhex("02 80 03 00 A0 00 10 16 0A")
BB_FULL_HALF = bytes.fromhex("02 80 07 00 BB 01 B4 00 32 00 10 03 9D")
REPLY_91 = bytes.fromhex("02 80 02 00 91 10 79 30")
REPLY_92 = bytes.fromhex("02 80 02 00 92 10 7F 33")
REPLY_BA = bytes.fromhex("02 80 17 00 BA") + b"LMS200;301063;V02.10 " + bytes.fromhex("10 22 61")
POWER_ON = bytes.fromhex("02 80 17 00 90") + b"LMS200;301063;V02.10 " + bytes.fromhex("10 63 5E")


class Field:
    """A scene that gives the beam at a degrees (0 right, 90 ahead) `range_at(a)`, and notes when beams were fired."""

    def __init__(self, ranges_m: ArrayLike = 3.0) -> None:
        self.ranges_m: F64 = np.asarray(ranges_m, dtype=np.float64)
        self.fired: list[tuple[F64, F64]] = []

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        angle_deg = np.degrees(bearing_rad) + 90.0
        self.fired.append((angle_deg, stamp_ns))
        if self.ranges_m.ndim == 0:
            return np.full(len(bearing_rad), float(self.ranges_m))
        return np.resize(self.ranges_m, len(bearing_rad))

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        raise AssertionError("a laser has no cone")

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        raise AssertionError("a laser has no wheels")


class Bench:
    """A scanner on a wire with the time in hand; the host's rate follows what it is told."""

    def __init__(self, ranges_m: ArrayLike = 3.0, *, boot: bool = True, **options: object) -> None:
        self.scene = Field(ranges_m)
        self.laser = SickLms2xxLaser(self.scene, **({"noise_scale": 0.0} | options))  # type: ignore[arg-type]
        self.baud: int | None = 9600
        self.now_ns = 3 * SECOND
        self.laser.step(self.now_ns, b"", self.baud)
        if boot:
            assert telegrams(self.wait(2.0))[0][0] == 0x90

    def wait(self, seconds: float, step_ms: float = 2.0) -> bytes:
        out = bytearray()
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns:
            self.now_ns = min(end_ns, self.now_ns + round(step_ms * MS))
            out += self.laser.step(self.now_ns, b"", self.baud)
        return bytes(out)

    def ask(self, telegram: bytes, seconds: float = 0.3) -> bytes:
        return self.laser.step(self.now_ns, telegram, self.baud) + self.wait(seconds)

    def at_rate(self, telegram: bytes, rate_bps: int) -> None:
        assert self.ask(telegram) == b"\x06" + A0_OK
        self.baud = rate_bps


def host(*payload: int | bytes) -> bytes:
    data = b"".join(bytes((p,)) if isinstance(p, int) else p for p in payload)
    frame = struct.pack("<BBH", 2, 0, len(data)) + data
    return frame + struct.pack("<H", sick_crc(frame))


def telegrams(sent: bytes) -> list[bytes]:
    """Payloads (with command and status) of what the scanner sent; anything but ACK between them is an error."""
    found, at = [], 0
    while at < len(sent):
        if sent[at] == 0x06:
            at += 1
            continue
        assert sent[at : at + 1] == b"\x02", sent[at : at + 20].hex(" ")
        assert sent[at + 1] & 0x80
        length = int.from_bytes(sent[at + 2 : at + 4], "little")
        frame = sent[at : at + length + 6]
        if len(frame) < length + 6:
            break  # still leaving
        assert sick_crc(frame[:-2]) == int.from_bytes(frame[-2:], "little")
        found.append(frame[4:-2])
        at += length + 6
    return found


def words(payload: bytes, head: int = 1) -> tuple[int, list[int]]:
    info = int.from_bytes(payload[head : head + 2], "little")
    count = info & 0x3FF
    return info, list(struct.unpack_from(f"<{count}H", payload, head + 2))


# -- the line ----------------------------------------------------------------------------------------------------------


def test_powers_up_deaf_and_then_tells_what_it_is_at_9600() -> None:
    bench = Bench(boot=False, boot_s=1.0)
    assert bench.ask(STATUS, 0.98) == b""
    assert bench.wait(0.3) == POWER_ON
    assert bench.laser.line_rate_bps == 9600


def test_answers_identification_byte_for_byte() -> None:
    assert Bench().ask(TYPE) == b"\x06" + REPLY_BA


def test_address_is_in_every_reply_and_broadcast_is_obeyed() -> None:
    bench = Bench(address=1)
    assert bench.ask(STOP) == b"\x06" + bytes.fromhex("02 81 03 00 A0 00 10 36 1A")
    own = bytes((2, 1)) + STOP[2:-2]
    assert bench.ask(own + struct.pack("<H", sick_crc(own))).startswith(b"\x06")
    other = bytes((2, 5)) + STOP[2:-2]
    assert bench.ask(other + struct.pack("<H", sick_crc(other))) == b""


def test_wrong_code_gets_nak_and_thirty_milliseconds_of_silence() -> None:
    bench = Bench()
    assert bench.ask(STATUS[:-1] + b"\0", 0.02) == b"\x15"
    assert bench.ask(TYPE, 0.005) == b""
    bench.wait(0.03)
    assert bench.ask(TYPE) == b"\x06" + REPLY_BA


def test_gap_of_more_than_six_milliseconds_voids_a_telegram() -> None:
    bench = Bench()
    assert bench.ask(TYPE[:3], 0.008) + bench.ask(TYPE[3:]) == b""
    slowly = b"".join(bench.ask(TYPE[i : i + 1], 0.005) for i in range(len(TYPE)))
    assert (slowly + bench.wait(0.3)) == b"\x06" + REPLY_BA


def test_unknown_command_is_refused() -> None:
    assert Bench().ask(host(0x4F)) == b"\x06" + REPLY_92


def test_host_at_another_rate_is_not_heard_and_hears_noise() -> None:
    bench = Bench()
    bench.baud = 38400
    assert bench.ask(STATUS) == b""
    bench.baud = 9600
    bench.ask(STREAM, 0.1)
    bench.baud = 19200
    noise = bench.wait(1.0)
    assert len(noise) > 500
    assert b"\x02\x80\xd6\x02\xb0" not in noise


@pytest.mark.parametrize(("telegram", "rate"), [(TO_38400, 38400), (TO_500000, 500000), (TO_9600, 9600)])
def test_rate_changes_after_the_answer_at_the_old_one(telegram: bytes, rate: int) -> None:
    bench = Bench()
    bench.at_rate(telegram, rate)
    assert bench.laser.line_rate_bps == rate
    assert bench.ask(TYPE) == b"\x06" + REPLY_BA


def test_bytes_take_their_time() -> None:
    bench = Bench()
    out = bench.ask(TYPE, 0.015)
    assert 1 < len(out) < len(REPLY_BA)  # 1 + 29 bytes take 31 ms


def test_reset_answers_then_boots_at_9600() -> None:
    bench = Bench()
    bench.at_rate(TO_38400, 38400)
    assert bench.ask(RESET, 0.5) == b"\x06" + REPLY_91
    bench.baud = 9600
    assert bench.wait(1.0) == POWER_ON


# -- modes and configuration -------------------------------------------------------------------------------------------


def test_password_opens_installation_mode() -> None:
    bench = Bench()
    assert bench.ask(INSTALL) == b"\x06" + A0_OK
    assert telegrams(bench.ask(host(0x20, 0x00, b"SICKLMS "))) == [bytes((0xA0, 1, 0x10))]
    assert telegrams(bench.ask(host(0x20, 0x7E))) == [bytes((0xA0, 2, 0x10))]


def test_configuration_is_written_in_installation_mode_only() -> None:
    bench = Bench()
    (read,) = telegrams(bench.ask(READ_CONFIG))
    assert (read[0], len(read)) == (0xF4, 36)
    config = bytearray(read[1:-1])
    config[6] ^= 1
    (refused,) = telegrams(bench.ask(host(0x77, bytes(config)), 1.0))
    assert refused[:2] == b"\xf7\0"
    bench.ask(INSTALL)
    (accepted,) = telegrams(bench.ask(host(0x77, bytes(config)), 1.0))
    assert accepted == b"\xf7\x01" + bytes(config) + b"\x10"
    bench.ask(STOP)
    assert telegrams(bench.ask(READ_CONFIG))[0][1:-1] == bytes(config)


@pytest.mark.parametrize("size", [7, 32, 33, 34])
def test_configuration_of_older_length_keeps_the_rest(size: int) -> None:
    bench = Bench()
    bench.ask(INSTALL)
    config = bytes(6) + b"\1" + bytes(range(1, size - 6))
    (answer,) = telegrams(bench.ask(host(0x77, config), 1.0))
    assert answer[2 : 2 + size] == config
    assert len(answer) == 2 + 34 + 1


@pytest.mark.parametrize("place_and_value", [(5, 0x3F), (5, 0x77), (6, 2)])
def test_configuration_that_is_not_possible_is_refused(place_and_value: tuple[int, int]) -> None:
    bench = Bench()
    bench.ask(INSTALL)
    config = bytearray(34)
    config[place_and_value[0]] = place_and_value[1]
    assert telegrams(bench.ask(host(0x77, bytes(config)), 1.0))[0][1] == 0


@pytest.mark.parametrize(
    ("telegram", "degrees", "resolution"),
    [(FULL, 180, 100), (FULL_HALF, 180, 50), (NARROW, 100, 100), (NARROW_HALF, 100, 50), (NARROW_QUARTER, 100, 25)],
)
def test_variants(telegram: bytes, degrees: int, resolution: int) -> None:
    bench = Bench()
    answer = bench.ask(telegram)
    assert telegrams(answer) == [struct.pack("<BBHHB", 0xBB, 1, degrees, resolution, 0x10)]
    assert telegram != FULL_HALF or answer == b"\x06" + BB_FULL_HALF
    bench.at_rate(TO_500000, 500000)
    (scan,) = telegrams(bench.ask(ONE_SCAN))
    info, values = words(scan)
    assert (scan[0], info >> 14) == (0xB0, 1)
    assert len(values) == degrees * 100 // resolution + 1
    angle_deg, _ = bench.scene.fired[-1]
    assert np.allclose(angle_deg, (180 - degrees) / 2 + np.arange(len(values)) * resolution / 100)


@pytest.mark.parametrize("variant", [(180, 25), (90, 50), (0, 0)])
def test_variant_that_is_not_there_is_refused(variant: tuple[int, int]) -> None:
    bench = Bench()
    (answer,) = telegrams(bench.ask(host(0x3B, struct.pack("<HH", *variant))))
    assert answer == struct.pack("<BBHHB", 0xBB, 0, 180, 50, 0x10)


@pytest.mark.parametrize("rate", [(TO_38400, 38400, 0x8019), (TO_500000, 500000, 0x8001), (TO_9600, 9600, 0x8067)])
def test_status_telegram_has_its_fields_in_place(rate: tuple[bytes, int, int]) -> None:
    bench = Bench()
    bench.at_rate(rate[0], rate[1])
    bench.ask(NARROW_QUARTER)
    (status,) = telegrams(bench.ask(STATUS))
    data = status[1:-1]
    assert len(data) == 152
    assert data[0:7] == b"V02.10 "
    assert (data[7], data[8], data[101]) == (0x25, 0, 0)
    assert struct.unpack_from("<HH", data, 106) == (100, 25)
    assert struct.unpack_from("<H", data, 115) == (rate[2],)
    assert (data[119], data[121]) == (0, 1)
    assert data[123:130] == b"V01.50 "


# -- scans -------------------------------------------------------------------------------------------------------------


def test_scan_of_millimetres_is_the_published_telegram() -> None:
    bench = Bench(np.arange(361) * 1e-3 + 1.0)
    bench.at_rate(TO_500000, 500000)
    frame = bench.ask(ONE_SCAN)[1:]
    assert frame[:9] == bytes.fromhex("02 80 D6 02 B0 69 41 E8 03")
    assert frame[-5:] == bytes.fromhex("50 05 10 86 0C")
    assert len(frame) == 732


def test_scan_of_centimetres_is_the_published_telegram() -> None:
    bench = Bench(np.arange(181) * 0.01 + 1.0, profile=LMS291)
    bench.at_rate(TO_500000, 500000)
    bench.ask(FULL)
    frame = bench.ask(ONE_SCAN)[1:]
    assert frame[:9] == bytes.fromhex("02 80 6E 01 B0 B5 00 64 00")
    assert frame[-5:] == bytes.fromhex("18 01 10 BB 6D")
    assert len(frame) == 372


@pytest.mark.parametrize(
    ("range_m", "word"),
    [(8.182, 8182), (8.19, 0x1FF7), (9.0, 0x1FF7), (np.inf, 0x1FF7), (np.nan, 0x1FFF), (-np.inf, 0x1FFF), (0.0, 0)],
)
def test_what_is_no_distance_has_a_code(range_m: float, word: int) -> None:
    bench = Bench(range_m)
    bench.at_rate(TO_500000, 500000)
    assert set(words(telegrams(bench.ask(ONE_SCAN))[0])[1]) == {word}


@pytest.mark.parametrize(("mode", "top"), [(0x00, 0x1FFF), (0x04, 0x3FFF), (0x0F, 0x7FFF)])
def test_measuring_mode_sets_the_bits_of_a_distance(mode: int, top: int) -> None:
    bench = Bench(np.inf)
    bench.ask(INSTALL)
    bench.ask(host(0x77, bytes(5) + bytes((mode, 1)) + bytes(27)), 1.0)
    bench.ask(STOP)
    bench.at_rate(TO_500000, 500000)
    assert set(words(telegrams(bench.ask(ONE_SCAN))[0])[1]) == {top - 8}
    bench.scene.ranges_m = np.array(8.1)
    assert set(words(telegrams(bench.ask(ONE_SCAN))[0])[1]) == {8100}


@pytest.mark.parametrize(
    ("rate", "variant", "per_second"),
    [
        (TO_38400, FULL, 10.3),
        (TO_38400, FULL_HALF, 5.2),
        (TO_38400, NARROW_QUARTER, 4.7),
        (TO_500000, FULL, 75.0),
        (TO_500000, FULL_HALF, 37.5),
        (TO_500000, NARROW_QUARTER, 18.75),
    ],
)
def test_stream_is_as_fast_as_mirror_and_line_allow(rate: bytes, variant: bytes, per_second: float) -> None:
    bench = Bench()
    bench.at_rate(rate, {TO_38400: 38400, TO_500000: 500000}[rate])
    bench.ask(variant)
    bench.ask(STREAM)
    sent = bench.wait(4.0)
    scans = [t for t in telegrams(sent[sent.find(b"\x02\x80") :]) if t[0] == 0xB0]
    assert len(scans) / 4.0 == pytest.approx(per_second, rel=0.05)


def test_beams_are_measured_when_the_mirror_looks_there() -> None:
    bench = Bench()
    bench.at_rate(TO_500000, 500000)
    bench.ask(FULL_HALF)
    bench.ask(STREAM, 0.2)
    _, stamp_ns = bench.scene.fired[-1]
    turn_ns = SECOND / 75
    whole, half = stamp_ns[0::2], stamp_ns[1::2]
    assert np.allclose(np.diff(whole), turn_ns / 360, atol=1.0)
    assert np.allclose(half - whole[:-1], turn_ns + turn_ns / 720, atol=1.0)
    spacing = np.diff([stamps[0] for _, stamps in bench.scene.fired[-4:]])
    assert np.allclose(spacing, 2 * turn_ns, atol=2.0)


def test_stream_ends_with_mode_25_and_is_answered_after_what_is_leaving() -> None:
    bench = Bench()
    bench.at_rate(TO_38400, 38400)
    bench.ask(STREAM, 0.3)
    out = bench.ask(STOP, 0.5)
    assert out.endswith(b"\x06" + A0_OK)
    assert bench.wait(1.0) == b""


def test_partial_scans_come_every_turn_with_their_number() -> None:
    bench = Bench()
    bench.at_rate(TO_500000, 500000)
    bench.ask(host(0x20, 0x2A), 0.039)
    out = telegrams(bench.wait(1.0))
    scans = [words(t) for t in out if t[0] == 0xB0]
    assert len(scans) == pytest.approx(75, abs=3)
    for (info, values), (after, _) in itertools.pairwise(scans):
        number = info >> 11 & 3
        assert info & 0x2000
        assert len(values) == {0: 181, 2: 180}[number]
        assert (after >> 11 & 3) == 2 - number


def test_subrange_and_mean() -> None:
    bench = Bench(np.arange(361) * 1e-3 + 1.0)
    bench.at_rate(TO_500000, 500000)
    (part,) = telegrams(bench.ask(host(0x30, 3, struct.pack("<HH", 11, 20))))
    assert part[:5] == b"\xb7" + struct.pack("<HH", 11, 20)
    assert words(part, head=5)[1] == [1010 + i for i in range(10)]
    (mean,) = telegrams(bench.ask(host(0x30, 2, 4), 0.5))
    assert mean[:2] == b"\xb6\x04"
    assert words(mean, head=2)[1] == [1000 + i for i in range(361)]
    assert telegrams(bench.ask(host(0x30, 3, struct.pack("<HH", 20, 400)))) == [b"\x92\x10"]


def test_real_time_indices_follow_the_values_when_configured() -> None:
    bench = Bench()
    bench.at_rate(TO_500000, 500000)
    bench.ask(INSTALL)
    bench.ask(host(0x77, bytes(4) + b"\2\0\1" + bytes(27)), 1.0)
    bench.ask(STOP)
    bench.ask(STREAM, 0.039)
    scans = [t for t in telegrams(bench.wait(0.5)) if t[0] == 0xB0]
    assert {len(t) for t in scans} == {1 + 2 + 722 + 2 + 1}
    telegram_index = [t[-2] for t in scans]
    assert telegram_index == list(range(telegram_index[0], telegram_index[0] + len(scans)))


# -- trouble -----------------------------------------------------------------------------------------------------------


def test_pollution_shows_in_every_status_byte() -> None:
    bench = Bench(pollution=0.6)
    assert telegrams(bench.ask(STOP))[0][-1] == 0x92
    bench.laser.pollution = 1.0
    assert telegrams(bench.ask(STOP))[0][-1] == 0x93
    assert telegrams(bench.ask(STATUS))[0][1 + 8] == 1
    assert telegrams(bench.ask(host(0x32)))[0] == bytes((0xB2, 3, 2, 0x93))


def test_dazzled_beams_have_code_and_flag() -> None:
    bench = Bench(dazzle=1.0)
    bench.at_rate(TO_500000, 500000)
    assert set(words(telegrams(bench.ask(ONE_SCAN))[0])[1]) == {0x8000 | 0x1FFE}


def test_trouble_gives_channel_faults_until_it_ends() -> None:
    bench = Bench()
    bench.at_rate(TO_500000, 500000)
    bench.laser.trouble("51", bench.now_ns)
    (scan,) = telegrams(bench.ask(ONE_SCAN))
    assert set(words(scan)[1]) == {0x1FFA}
    assert scan[-1] == 0x13
    bench.laser.trouble(None, bench.now_ns)
    assert set(words(telegrams(bench.ask(ONE_SCAN))[0])[1]) == {3000}


def test_slow_mirror_makes_slow_scans() -> None:
    bench = Bench()
    bench.at_rate(TO_500000, 500000)
    bench.laser.set_speed_share(0.5, bench.now_ns)
    bench.ask(STREAM)
    scans = [t for t in telegrams(bench.wait(2.0)) if t[0] == 0xB0]
    assert len(scans) == pytest.approx(37.5, abs=2)


@pytest.mark.parametrize("profile", sorted(LMS2XX_PROFILES))
def test_every_model_starts_and_streams(profile: str) -> None:
    bench = Bench(profile=LMS2XX_PROFILES[profile])
    assert any(t[0] == 0xB0 for t in telegrams(bench.ask(STREAM, 2.0)))


@given(st.lists(st.tuples(st.binary(max_size=40), st.integers(0, 40)), max_size=8))
@settings(max_examples=40, deadline=None)
def test_survives_any_bytes_and_then_answers(pieces: list[tuple[bytes, int]]) -> None:
    bench = Bench()
    for piece, pause_ms in pieces:
        bench.ask(piece, pause_ms * 1e-3)
    bench.laser.power_on(bench.now_ns)  # whatever the noise told it
    bench.baud = 9600
    bench.wait(2.0)
    assert bench.ask(TYPE) == b"\x06" + REPLY_BA


@given(st.lists(st.sampled_from([TYPE, STATUS, STOP, INSTALL, READ_CONFIG, FULL, NARROW_HALF]), max_size=6), st.data())
@settings(max_examples=30, deadline=None)
def test_same_answers_however_the_telegrams_are_cut(asked: list[bytes], data: st.DataObject) -> None:
    sent = b"".join(asked)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(sent)), max_size=5)))
    answers = []
    for pieces in ([sent], [sent[a:b] for a, b in zip([0, *cuts], [*cuts, len(sent)])]):
        bench = Bench(profile=LMS200)
        out = b"".join(bench.laser.step(bench.now_ns, piece, 9600) for piece in pieces)
        answers.append(out + bench.wait(2.0))
    assert answers[0] == answers[1]
    assert answers[0].count(b"\x06") >= len(asked)


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
def test_recorded_scan_leaves_as_it_was_recorded() -> None:
    recorded = (Path(os.environ["UMFELD_DATA"]) / "device_bytes" / "sick_lms2xx_361.bin").read_bytes()
    _, values = words(recorded[4:-2])
    bench = Bench(np.array([v & 0x1FFF for v in values]) * 1e-3)
    bench.at_rate(TO_500000, 500000)
    ours = bench.ask(ONE_SCAN)[1:]
    assert ours[:7] == recorded[:7]
    assert words(ours[4:-2])[1] == [v & 0x1FFF for v in values]
    assert sick_crc(recorded[:-2]) == int.from_bytes(recorded[-2:], "little")
