"""The emulated LDROBOT scanners against the maker's packet and the checks of the maker's reader."""

from __future__ import annotations

import itertools
import os
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from sim_devices.checksums import LDROBOT_TABLE, ldrobot_crc
from sim_devices.device import F64, Mount
from sim_devices.laser_ldrobot import LD14P, LDROBOT_PROFILES, LdLidar, encode_packet

MS = 1_000_000
SECOND = 1_000_000_000
EXAMPLE = bytes.fromhex(
    "54 2C 68 08 AB 7E E0 00 E4 DC 00 E2 D9 00 E5 D5 00 E3 D3 00 E4 D0 00 E9 CD 00 E4 CA 00 E2 C7 00 E9"
    "C5 00 E5 C2 00 E5 C0 00 E5 BE 82 3A 1A 50"
)


class Circle:
    """All around at one distance, but a post at yaw_deg; notes when beams were fired."""

    def __init__(self, range_m: float = 2.0, post_yaw_deg: float | None = None) -> None:
        self.range_m = range_m
        self.post_yaw_deg = post_yaw_deg
        self.stamps: list[F64] = []

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        self.stamps.append(stamp_ns)
        range_m = np.full(len(bearing_rad), self.range_m)
        if self.post_yaw_deg is not None:
            away = np.abs((np.degrees(bearing_rad) - self.post_yaw_deg + 180.0) % 360.0 - 180.0)
            range_m[away < 10.0] = 1.0
        return range_m

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        raise AssertionError("a laser has no cone")

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        raise AssertionError("a laser has no wheels")


@dataclass(frozen=True)
class Packet:
    speed_dps: int
    start_deg: float
    end_deg: float
    distances_mm: list[int]
    intensities: list[int]
    time_ms: int

    @property
    def span_deg(self) -> float:
        return (self.end_deg - self.start_deg) % 360.0

    @property
    def angles_deg(self) -> list[float]:
        return [(self.start_deg + k * self.span_deg / 11.0) % 360.0 for k in range(12)]


def packets(stream: bytes) -> list[Packet]:
    found = []
    for at in range(0, len(stream) - len(stream) % 47, 47):
        frame = stream[at : at + 47]
        assert frame[:2] == b"\x54\x2c"
        assert ldrobot_crc(frame[:-1]) == frame[-1]
        speed, start = struct.unpack_from("<HH", frame, 2)
        samples = [struct.unpack_from("<HB", frame, 6 + 3 * k) for k in range(12)]
        end, time_ms = struct.unpack_from("<HH", frame, 42)
        assert max(start, end) < 36000
        found.append(Packet(speed, start / 100, end / 100, [s[0] for s in samples], [s[1] for s in samples], time_ms))
    return found


class Bench:
    """A scanner on a wire with the time in hand, up to speed unless told otherwise."""

    def __init__(self, *, scene: Circle | None = None, steady: bool = True, **options: object) -> None:
        self.scene = scene or Circle()
        self.laser = LdLidar(self.scene, **({"noise_scale": 0.0} | options))  # type: ignore[arg-type]
        self.now_ns = 4 * SECOND
        self.baud: int | None = self.laser.profile.line_rate_bps
        self.laser.step(self.now_ns, b"", self.baud)
        if steady:
            self.wait(2.0)

    def wait(self, seconds: float, step_ms: float = 2.0) -> bytes:
        out = bytearray()
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns:
            self.now_ns = min(end_ns, self.now_ns + round(step_ms * MS))
            out += self.laser.step(self.now_ns, b"", self.baud)
        return bytes(out)

    def packets(self, seconds: float) -> list[Packet]:
        """Whole packets; what was under way at the begin is left out."""
        stream = self.wait(seconds)
        start = next(
            at for at in range(47) if stream[at : at + 2] == b"\x54\x2c" and stream[at + 47 : at + 49] == b"\x54\x2c"
        )
        return packets(stream[start:])

    def ask(self, request: bytes) -> None:
        self.laser.step(self.now_ns, request, self.baud)


def command(code: int, payload: bytes) -> bytes:
    frame = bytes((0x54, code, 4)) + payload
    return frame + bytes((ldrobot_crc(frame),))


def test_crc_table_starts_as_published() -> None:
    assert LDROBOT_TABLE[:8] == bytes.fromhex("00 4D 9A D7 79 34 E3 AE")


def test_packet_of_the_maker() -> None:
    (told,) = packets(EXAMPLE)
    assert (told.speed_dps, told.start_deg, told.end_deg, told.time_ms) == (2152, 324.27, 334.70, 6714)
    built = encode_packet(2152, 32427, 33470, np.array(told.distances_mm), np.array(told.intensities), 6714)
    assert built == EXAMPLE


def test_packets_come_by_themselves_as_often_as_published() -> None:
    got = Bench().packets(4.0)
    assert len(got) == pytest.approx(1500, abs=3)
    assert all(packet.speed_dps == pytest.approx(3600, rel=0.012) for packet in got)


@pytest.mark.parametrize("profile", sorted(LDROBOT_PROFILES))
def test_speed_span_and_time_agree_from_standstill_on(profile: str) -> None:
    told = LDROBOT_PROFILES[profile]
    bench = Bench(steady=False, profile=told, boot_s=0.0)
    got = packets(bench.wait(2.0))
    assert got[0].speed_dps < 100
    assert got[-1].speed_dps == pytest.approx(told.turns_per_s * 360, rel=0.02)
    for before, packet in itertools.pairwise(got):
        predicted_deg = packet.speed_dps * 11 / told.samples_per_s
        assert packet.span_deg == pytest.approx(predicted_deg, abs=0.03)
        if told.samples_per_s == 4500 and packet.speed_dps > 400:  # as the maker's reader of these checks it
            whole_deg = (int(packet.end_deg) - int(packet.start_deg)) % 360
            assert whole_deg <= packet.speed_dps * 12 / told.samples_per_s * 1.5
        gap_deg = (packet.start_deg - before.end_deg) % 360.0
        assert gap_deg == pytest.approx(packet.speed_dps / told.samples_per_s, abs=0.05)
        assert (packet.time_ms - before.time_ms) % 30000 <= 12_000 / told.samples_per_s + 1


def test_time_counts_milliseconds_and_wraps_at_thirty_seconds() -> None:
    bench = Bench(clock_start_ms=27_000)
    got = bench.packets(2.0)
    times = [packet.time_ms for packet in got]
    assert times[0] > 28_900
    assert times[-1] < 2_000
    assert sum((b - a) % 30_000 for a, b in itertools.pairwise(times)) == pytest.approx(2000, abs=6)


def test_clock_drift_does_not_jump() -> None:
    bench = Bench()
    before = bench.laser.clock_ms(bench.now_ns)
    bench.laser.set_clock_drift(1000.0, bench.now_ns)
    assert bench.laser.clock_ms(bench.now_ns) == before
    assert bench.laser.clock_ms(bench.now_ns + 20 * SECOND) == (before + 20_020) % 30_000


@pytest.mark.parametrize("yaw_deg", [90.0, -45.0])
def test_angles_grow_clockwise(yaw_deg: float) -> None:
    got = Bench(scene=Circle(post_yaw_deg=yaw_deg)).packets(1.0)
    post = [
        np.radians(angle) for packet in got for angle, mm in zip(packet.angles_deg, packet.distances_mm) if mm == 1000
    ]
    middle_deg = np.degrees(np.arctan2(np.sin(post).mean(), np.cos(post).mean()))
    assert middle_deg == pytest.approx(-yaw_deg, abs=1.0)


@pytest.mark.parametrize(("range_m", "mm"), [(0.01, 0), (0.03, 30), (11.9, 11900), (12.1, 0), (np.inf, 0), (np.nan, 0)])
def test_what_is_no_distance_is_zero_with_an_intensity(range_m: float, mm: int) -> None:
    got = Bench(scene=Circle(range_m)).packets(0.2)
    assert {value for packet in got for value in packet.distances_mm} == {mm}
    assert all(value > 0 for packet in got for value in packet.intensities)


def test_samples_are_taken_at_their_instants() -> None:
    bench = Bench()
    bench.wait(1.0)
    stamps = np.concatenate(bench.scene.stamps)
    assert np.allclose(np.diff(stamps), SECOND / 4500, atol=1024.0)  # float64 nanoseconds


def test_host_at_another_rate_hears_noise() -> None:
    bench = Bench()
    bench.baud = 115200
    noise = bench.wait(1.0)
    assert len(noise) > 15_000
    whole = [at for at in range(len(noise) - 47) if noise[at : at + 2] == b"\x54\x2c"]
    assert not any(ldrobot_crc(noise[at : at + 46]) == noise[at + 46] for at in whole)


def test_trouble_stops_the_motor_and_all_echoes() -> None:
    bench = Bench()
    bench.laser.trouble("51", bench.now_ns)
    bench.wait(1.5)
    got = bench.packets(0.3)
    assert {packet.speed_dps for packet in got} == {0}
    assert {mm for packet in got for mm in packet.distances_mm} == {0}
    bench.laser.trouble(None, bench.now_ns)
    bench.wait(1.5)
    assert bench.packets(0.1)[0].distances_mm[0] == 2000


def test_speed_follows_its_share() -> None:
    bench = Bench()
    bench.laser.set_speed_share(0.5, bench.now_ns)
    bench.wait(1.0)
    assert bench.packets(0.1)[0].speed_dps == pytest.approx(1800, rel=0.03)


def test_ld06_does_not_listen_and_ld14p_obeys() -> None:
    stop, start = command(0xA1, bytes(4)), command(0xA0, bytes(4))
    deaf = Bench()
    deaf.ask(stop)
    assert deaf.packets(0.5)
    bench = Bench(profile=LD14P)
    bench.ask(stop)
    bench.wait(0.1)
    assert bench.wait(0.5) == b""
    bench.ask(b"\x54\xa0" + start)  # noise before it
    bench.wait(1.5)
    assert bench.packets(0.2)
    bench.ask(command(0xA2, struct.pack("<i", 720)))
    bench.wait(1.5)
    assert bench.packets(0.2)[0].speed_dps == pytest.approx(720, rel=0.03)


def test_power_cycle_begins_from_standstill() -> None:
    bench = Bench()
    bench.laser.power_on(bench.now_ns)
    assert bench.wait(0.19) == b""
    assert packets(bench.wait(0.1))[0].speed_dps < 1000


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
def test_recorded_packets_are_built_again_byte_for_byte() -> None:
    recorded = (Path(os.environ["UMFELD_DATA"]) / "device_bytes" / "ld06_two_packets.bin").read_bytes()
    for number, told in enumerate(packets(recorded)):
        built = encode_packet(
            told.speed_dps,
            round(told.start_deg * 100),
            round(told.end_deg * 100),
            np.array(told.distances_mm),
            np.array(told.intensities),
            told.time_ms,
        )
        assert built == recorded[47 * number : 47 * (number + 1)]
