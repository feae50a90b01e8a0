"""The emulated CoLa scanners against recorded telegrams of a TiM, and their habits."""

from __future__ import annotations

import gzip
import os
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from sim_devices.device import F64, Mount
from sim_devices.laser_sick_cola import COLA_PROFILES, LMS111, TIM571, SickColaLaser

MS = 1_000_000
SECOND = 1_000_000_000

LOGIN = b"sMN SetAccessMode \x03\xf4\x72\x47\x44"
AS_RECORDED = replace(TIM571, scan_config=(1, 0, 1, 1, 0, 0, 0, 0, 0, 0, 1, 1))  # strength in 16 bits, time
SUBSCRIBE, UNSUBSCRIBE = b"sEN LMDscandata \x01", b"sEN LMDscandata \x00"


class Field:
    """Ranges by beam, resized to what is asked; notes bearings and instants."""

    def __init__(self, ranges_m: ArrayLike) -> None:
        self.ranges_m: F64 = np.asarray(ranges_m, dtype=np.float64)
        self.fired: list[tuple[F64, F64]] = []

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        self.fired.append((bearing_rad, stamp_ns))
        return np.resize(self.ranges_m, len(bearing_rad))

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        raise AssertionError("a laser has no cone")

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        raise AssertionError("a laser has no wheels")


class Bench:
    """A scanner on a line with the time in hand, up to speed."""

    def __init__(self, ranges_m: ArrayLike = 3.0, *, spin: bool = True, **options: object) -> None:
        self.scene = Field(ranges_m)
        self.laser = SickColaLaser(self.scene, **({"noise_scale": 0.0} | options))  # type: ignore[arg-type]
        self.now_ns = 7 * SECOND
        self.laser.step(self.now_ns, b"")
        if spin:
            self.wait(1.5)

    def wait(self, seconds: float, step_ms: float = 3.0) -> bytes:
        out = bytearray()
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns:
            self.now_ns = min(end_ns, self.now_ns + round(step_ms * MS))
            out += self.laser.step(self.now_ns, b"")
        return bytes(out)

    def raw(self, sent: bytes, seconds: float = 0.02) -> bytes:
        return self.laser.step(self.now_ns, sent) + self.wait(seconds)

    def ask(self, payload: bytes) -> bytes:
        """The answer's payload to a binary request."""
        (answer,) = binary_payloads(self.raw(binary(payload)))
        return answer

    def say(self, text: str) -> str:
        """The answer to a request in text."""
        out = self.raw(b"\x02" + text.encode("ascii") + b"\x03")
        assert (out[:1], out[-1:]) == (b"\x02", b"\x03")
        return out[1:-1].decode("ascii")

    def scans(self, seconds: float, subscribe: bytes = SUBSCRIBE) -> list[bytes]:
        out = self.raw(binary(subscribe), seconds)
        return [p for p in binary_payloads(out) if p.startswith(b"sSN")]


def binary(payload: bytes) -> bytes:
    sum_ = 0
    for byte in payload:
        sum_ ^= byte
    return b"\x02\x02\x02\x02" + struct.pack(">I", len(payload)) + payload + bytes((sum_,))


def binary_payloads(stream: bytes) -> list[bytes]:
    found, at = [], 0
    while at < len(stream):
        length = int.from_bytes(stream[at + 4 : at + 8], "big")
        payload = stream[at + 8 : at + 8 + length]
        assert binary(payload) == stream[at : at + 9 + length]
        found.append(payload)
        at += 9 + length
    return found


@dataclass
class Scan:
    """A scan telegram taken apart field by field; `rest` must be empty."""

    head: tuple[int, ...]
    wide: list[tuple[bytes, float, int, int, NDArray[np.uint16]]]
    narrow: list[tuple[bytes, float, int, int, NDArray[np.uint8]]]
    flags: list[int]
    time: tuple[int, ...] | None
    rest: bytes


def taken_apart(payload: bytes) -> Scan:
    head_of = struct.Struct(">HHIBBHHIIBBBBHIIH")
    at = len(b"sSN LMDscandata ")
    head = head_of.unpack_from(payload, at)
    at += head_of.size
    wide, narrow = [], []
    (count,) = struct.unpack_from(">H", payload, at)
    at += 2
    for _ in range(count):
        name, scale, _offset, start, step, points = struct.unpack_from(">5sffiHH", payload, at)
        wide.append((name, scale, start, step, np.frombuffer(payload, ">u2", points, at + 21).astype(np.uint16)))
        at += 21 + 2 * points
    (count,) = struct.unpack_from(">H", payload, at)
    at += 2
    for _ in range(count):
        name, scale, _offset, start, step, points = struct.unpack_from(">5sffiHH", payload, at)
        narrow.append((name, scale, start, step, np.frombuffer(payload, np.uint8, points, at + 21)))
        at += 21 + points
    flags = list(struct.unpack_from(">HHHH", payload, at))
    at += 8
    time = None
    if flags[3]:
        time = struct.unpack_from(">HBBBBBI", payload, at)
        at += 11
    flags += struct.unpack_from(">H", payload, at)
    at += 2
    return Scan(head, wide, narrow, flags, time, payload[at:])


# -- the line ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", sorted(COLA_PROFILES))
def test_identity_in_both_dialects(profile: str) -> None:
    told = COLA_PROFILES[profile]
    bench = Bench(profile=told)
    name, version = told.name.encode(), told.firmware.encode()
    text = struct.pack(">H", len(name)) + name + struct.pack(">H", len(version)) + version
    assert bench.ask(b"sRN DeviceIdent") == b"sRA DeviceIdent " + text
    expected = f"sRA DeviceIdent {len(name):X} {told.name} {len(version):X} {told.firmware}"
    assert bench.say("sRN DeviceIdent") == expected
    assert bench.say("sRI0") == expected.replace("DeviceIdent", "0")
    assert bench.ask(b"sRI 0") == b"sRA 0 " + text


def test_noise_and_wrong_sums_are_skipped() -> None:
    bench = Bench()
    asked = binary(b"sRN SCdevicestate")
    assert bench.raw(asked[:-1] + bytes((asked[-1] ^ 1,))) == b""
    assert binary_payloads(bench.raw(b"\xff\x00noise" + asked)) == [b"sRA SCdevicestate \x01"]
    assert bench.raw(b"\x02sRN SCdev" + b"\x02sRN SCdevicestate\x03") == b"\x02sRA SCdevicestate 1\x03"


def test_lines_and_fields_rest() -> None:
    """A host of the maker's asks for all of them before it measures, and gives up where one is refused."""
    bench = Bench()
    assert bench.ask(b"sRN LIDinputstate") == b"sRA LIDinputstate " + bytes(2 + 4 + 4 + 2)
    assert bench.ask(b"sRN LIDoutputstate") == b"sRA LIDoutputstate " + bytes(2 + 4 + 3 * 5 + 2)
    field = struct.pack(">ffIiBB4H", 1.0, 0.0, 1, 0, 0, 47, 0, 0, 0, 0)
    assert bench.ask(b"sRN field047") == b"sRA field047 " + field
    assert bench.ask(b"sRN field048") == b"sFA \x03"
    for name in ("LFErec", "LIDinputstate", "LIDoutputstate"):
        assert bench.say(f"sEN {name} 1") == f"sEA {name} 1"


def test_unknown_things_are_refused_by_their_kind() -> None:
    bench = Bench()
    assert bench.say("sRN Nonsense") == "sFA 3"
    assert bench.say("sMN Nonsense") == "sFA 2"
    assert bench.say("sEN Nonsense 1") == "sFA F"
    assert bench.say("sXY Nonsense") == "sFA C"
    assert bench.ask(b"sRN Nonsense") == b"sFA \x03"


def test_writing_needs_the_password_of_a_level() -> None:
    bench = Bench()
    config = "sWN LMDscandatacfg 01 00 0 1 0 00 00 0 0 0 0 +1"
    assert bench.say(config) == "sFA A"
    assert bench.say("sMN LMCstopmeas") == "sFA 1"
    assert bench.say("sMN SetAccessMode 03 F4724745") == "sAN SetAccessMode 0"
    assert bench.ask(LOGIN) == b"sAN SetAccessMode \x01"
    assert bench.say(config) == "sWA LMDscandatacfg"
    assert bench.say("sMN Run") == "sAN Run 1"
    assert bench.say(config) == "sFA A"


def test_host_that_goes_away_is_forgotten() -> None:
    bench = Bench()
    bench.ask(LOGIN)
    assert bench.scans(0.5)
    bench.laser.link_lost(bench.now_ns)
    assert bench.wait(0.5) == b""
    assert bench.say("sMN LMCstopmeas") == "sFA 1"


def test_state_is_busy_until_the_mirror_is_up_to_speed() -> None:
    bench = Bench(spin=False, spin_up_s=1.0)
    assert bench.say("sRN SCdevicestate") == "sRA SCdevicestate 0"
    assert bench.scans(0.9) == []
    bench.wait(0.2)
    assert bench.say("sEN LMDscandata 0") == "sEA LMDscandata 0"
    assert bench.say("sRN SCdevicestate") == "sRA SCdevicestate 1"
    assert bench.say("sRN STlms").startswith("sRA STlms 7 0 8 00:00:01 A ")
    assert bench.say("sRN LCMstate") == "sRA LCMstate 0"
    assert bench.say("sRN LSPdatetime").startswith("sRA LSPdatetime 7B2 1 1 0 0 1 ")


# -- configuration -----------------------------------------------------------------------------------------------------


def test_scan_configuration_reads_and_writes() -> None:
    bench = Bench(profile=LMS111)
    assert bench.say("sRN LMPscancfg") == "sRA LMPscancfg 1388 1 1388 FFF92230 225510"
    assert bench.ask(b"sRN LMPscancfg")[-18:] == struct.pack(">IHIii", 5000, 1, 5000, -450000, 2250000)
    bench.ask(LOGIN)
    answer = bench.say("sMN mLMPsetscancfg +2500 +1 +2500 -450000 +2250000")
    assert answer == "sAN mLMPsetscancfg 0 9C4 1 9C4 FFF92230 225510"
    assert bench.say("sMN mLMPsetscancfg +2600 +1 +2500 -450000 +2250000").startswith("sAN mLMPsetscancfg 1 ")
    assert bench.say("sMN mLMPsetscancfg +2500 +1 +5000 -450000 +2250000").startswith("sAN mLMPsetscancfg 2 ")
    scans = [taken_apart(p) for p in bench.scans(1.0)]
    assert len(scans) == pytest.approx(25, abs=1)
    assert len(scans[0].wide[0][4]) == 1081


def test_output_range_cuts_the_scan() -> None:
    bench = Bench()
    bench.ask(LOGIN)
    limits = struct.pack(">HIii", 1, 3333, 0, 1800000)
    assert bench.ask(b"sWN LMPoutputRange " + limits) == b"sWA LMPoutputRange "
    assert bench.ask(b"sRN LMPoutputRange") == b"sRA LMPoutputRange " + limits
    _, _, start, step, values = taken_apart(bench.scans(0.2)[0]).wide[0]
    assert (start, step, len(values)) == (0, 3333, 541)
    bearing_rad, _ = bench.scene.fired[-1]
    assert np.allclose(np.degrees(bearing_rad[[0, -1]]), [-90.0, 90.0], atol=1e-6)
    assert bench.say("sWN LMPoutputRange 1 D05 FFF00000 225510") == "sFA 5"


def test_channels_and_rate_follow_the_configuration() -> None:
    bench = Bench()
    bench.ask(LOGIN)
    bench.say("sWN LMDscandatacfg 01 00 0 1 0 00 00 0 0 0 0 +3")
    scans = [taken_apart(p) for p in bench.scans(2.0)]
    assert len(scans) == pytest.approx(10, abs=1)
    assert [c[0] for c in scans[0].wide] == [b"DIST1"]
    assert (scans[0].narrow, scans[0].time) == ([], None)
    bench.ask(UNSUBSCRIBE)
    bench.ask(LOGIN)
    bench.say("sWN LMDscandatacfg 01 00 1 0 0 00 00 0 0 0 1 +1")
    scan = taken_apart(bench.scans(0.2)[0])
    assert [c[0] for c in scan.narrow] == [b"RSSI1"]
    assert scan.time is not None
    assert scan.rest == b""


def test_plain_variables_are_kept() -> None:
    bench = Bench(needs_login=False)
    assert bench.ask(b"sWN FREchoFilter \x02") == b"sWA FREchoFilter "
    assert bench.ask(b"sRN FREchoFilter") == b"sRA FREchoFilter \x02"
    assert bench.say("sWN LFPmeanfilter 0 2 0") == "sWA LFPmeanfilter"
    assert bench.say("sRN LocationName") == "sRA LocationName B not defined"
    assert bench.say("sWN LocationName D OutdoorDevice") == "sWA LocationName"
    assert bench.say("sRN LocationName") == "sRA LocationName D OutdoorDevice"
    assert bench.say("sRN DIornr").split()[-1] == bench.say("sRN OrdNum").split()[-1]


# -- scans -------------------------------------------------------------------------------------------------------------


def test_scans_come_at_the_rate_of_the_mirror_with_counters_and_clock() -> None:
    bench = Bench()
    scans = [taken_apart(p) for p in bench.scans(4.0)]
    assert len(scans) == pytest.approx(60, abs=1)
    heads = np.array([scan.head for scan in scans], dtype=np.int64)
    assert set(np.diff(heads[:, 5])) == {1}
    assert set(np.diff(heads[:, 6])) == {1}
    assert set(np.diff(heads[:, 7])) <= {66666, 66667}
    assert np.allclose(heads[:, 8] - heads[:, 7], 66667 * 0.75, atol=2)


def test_beams_are_measured_as_the_mirror_turns() -> None:
    bench = Bench()
    bench.scans(0.3)
    bearing_rad, stamp_ns = bench.scene.fired[-1]
    assert np.allclose(np.degrees(bearing_rad), -135.0 + np.arange(811) / 3.0, atol=1e-6)
    assert np.allclose(np.diff(stamp_ns), SECOND / 15 / 1080, atol=2.0)


def test_what_is_no_distance_has_a_code_and_no_strength() -> None:
    bench = Bench([1.0, 0.02, np.inf, 26.0, np.nan, -np.inf, 24.9], profile=AS_RECORDED)
    _, rssi = (channel[4][:7] for channel in taken_apart(bench.scans(0.2)[0]).wide)
    values = taken_apart(bench.scans(0.2)[0]).wide[0][4][:7]
    assert list(values) == [1000, 2, 0, 0, 1, 2, 24900]
    assert [bool(v) for v in rssi] == [True, False, False, False, False, False, True]


def test_text_scan_says_the_same_as_a_binary_one() -> None:
    bench = Bench(np.arange(811) * 1e-3 + 1.0)
    words = bench.say("sRN LMDscandata").split()
    assert words[:5] == ["sRA", "LMDscandata", "1", "1", "119FD06"]
    at = words.index("DIST1")
    assert words[at - 4 : at + 6] == ["5DC", "A2", "0", "1", "DIST1", "3F800000", "00000000", "FFF92230", "D05", "32B"]
    assert [int(word, 16) for word in words[at + 6 : at + 6 + 811]] == list(range(1000, 1811))
    assert words[at + 817 :] == ["0", "0", "1", "B", "not", "defined", "0", "0", "0"], "no strength; its name"
    out = bench.raw(b"\x02sEN LMDscandata 1\x03", 0.2)
    assert out.startswith(b"\x02sEA LMDscandata 1\x03\x02sSN LMDscandata 1 1 119FD06 ")


def test_trouble_shows_in_state_and_scans() -> None:
    bench = Bench()
    bench.laser.trouble("51", bench.now_ns)
    assert bench.say("sRN SCdevicestate") == "sRA SCdevicestate 2"
    scan = taken_apart(bench.scans(0.2)[0])
    assert scan.head[4] == 1
    assert not scan.wide[0][4].any()
    bench.laser.trouble(None, bench.now_ns)
    bench.raw(binary(UNSUBSCRIBE))
    assert taken_apart(bench.scans(0.2)[0]).wide[0][4].all()


def test_stopped_measuring_stops_the_scans() -> None:
    bench = Bench(needs_login=False)
    bench.ask(b"sMN LMCstopmeas")
    assert bench.scans(0.5) == []
    bench.ask(b"sMN LMCstartmeas")
    assert len(binary_payloads(bench.wait(0.5))) > 5


def test_slower_mirror_and_drifting_clock() -> None:
    bench = Bench()
    bench.laser.set_clock_drift(1000.0, bench.now_ns)
    bench.laser.set_speed_share(0.5, bench.now_ns)
    heads = np.array([taken_apart(p).head for p in bench.scans(2.0)], dtype=np.int64)
    assert np.diff(heads[:, 7]).mean() == pytest.approx(133_333 * 1.001, abs=2)


def test_reboot_answers_and_starts_from_scratch() -> None:
    bench = Bench()
    bench.ask(LOGIN)
    assert bench.say("sMN mSCreboot") == "sAN mSCreboot"
    assert bench.say("sRN SCdevicestate") == "sRA SCdevicestate 0"
    assert bench.say("sMN LMCstopmeas") == "sFA 1"


@given(st.lists(st.binary(max_size=60), max_size=8))
@settings(max_examples=60, deadline=None)
def test_survives_any_bytes_and_then_answers(pieces: list[bytes]) -> None:
    bench = Bench()
    for piece in pieces:
        bench.raw(piece, 0.003)
    bench.laser.link_lost(bench.now_ns)
    assert bench.ask(b"sRN SCdevicestate") == b"sRA SCdevicestate \x01"


@given(
    st.lists(
        st.sampled_from([binary(b"sRN DeviceIdent"), binary(LOGIN), b"\x02sRN LMPscancfg\x03", b"\x02sMN Run\x03"]),
        max_size=6,
    ),
    st.data(),
)
@settings(max_examples=40, deadline=None)
def test_same_answers_however_the_requests_are_cut(asked: list[bytes], data: st.DataObject) -> None:
    sent = b"".join(asked)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(sent)), max_size=5)))
    answers = []
    for pieces in ([sent], [sent[a:b] for a, b in zip([0, *cuts], [*cuts, len(sent)])]):
        bench = Bench()
        out = b"".join(bench.laser.step(bench.now_ns, piece) for piece in pieces)
        answers.append(out + bench.wait(0.1))
    assert answers[0] == answers[1]
    assert answers[0].count(b"s") >= len(asked)


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
def test_scans_have_the_layout_of_recorded_ones() -> None:
    folder = Path(os.environ["UMFELD_DATA"]) / "device_bytes"
    recorded = gzip.decompress((folder / "sick_tim_colab_tcp.bin.gz").read_bytes())
    whole = recorded[: len(recorded) // 3374 * 3374]
    for payload in binary_payloads(whole)[::30]:
        told = taken_apart(payload)
        ranges_m = np.where(told.wide[0][4] > 20, told.wide[0][4] * 1e-3, np.inf)
        ours_payload = Bench(ranges_m, profile=AS_RECORDED, serial=told.head[2]).scans(0.1)[0]
        ours = taken_apart(ours_payload)
        assert len(ours_payload) == len(payload)
        assert (told.rest, ours.rest) == (b"", b"")
        assert ours.head[:5] == told.head[:5]
        assert ours.head[13:] == told.head[13:]
        assert (ours.flags, [c[:4] for c in ours.wide]) == (told.flags, [c[:4] for c in told.wide])
        near = told.wide[0][4] > 50
        assert np.array_equal(ours.wide[0][4][near], told.wide[0][4][near])
