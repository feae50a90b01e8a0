"""The emulated RPLIDAR against published frames and the habits of the device."""

from __future__ import annotations

import itertools
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_devices.device import F64, Mount
from sim_devices.laser_rplidar import A1M8, A2M8, RPLIDAR_PROFILES, RpLidar, encode_capsule, encode_node

MS = 1_000_000
SECOND = 1_000_000_000

STOP, RESET, SCAN, FORCE = b"\xa5\x25", b"\xa5\x40", b"\xa5\x20", b"\xa5\x21"
INFO, HEALTH, RATES = b"\xa5\x50", b"\xa5\x52", b"\xa5\x59"
EXPRESS_0 = bytes.fromhex("A5 82 05 00 00 00 00 00 22")
EXPRESS_1 = bytes.fromhex("A5 82 05 01 00 00 00 00 23")
PWM_660 = bytes.fromhex("A5 F0 02 94 02 C1")
PWM_0 = bytes.fromhex("A5 F0 02 00 00 57")
MODE_COUNT = bytes.fromhex("A5 84 04 70 00 00 00 55")
TYPICAL = bytes.fromhex("A5 84 04 7C 00 00 00 59")
US_OF_MODE_1 = bytes.fromhex("A5 84 06 71 00 00 00 01 00 57")
BOARD = bytes.fromhex("A5 FF 04 00 00 00 00 5E")
SCAN_HEAD = bytes.fromhex("A5 5A 05 00 00 40 81")
EXPRESS_HEAD = bytes.fromhex("A5 5A 54 00 00 40 82")


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


class Bench:
    """A scanner on a wire with the time in hand."""

    def __init__(self, *, scene: Circle | None = None, boot: bool = True, **options: object) -> None:
        self.scene = scene or Circle()
        self.laser = RpLidar(self.scene, **({"noise_scale": 0.0} | options))  # type: ignore[arg-type]
        self.now_ns = 5 * SECOND
        self.baud: int | None = self.laser.profile.line_rate_bps
        self.laser.step(self.now_ns, b"", self.baud)
        if boot:
            assert self.wait(1.5).startswith(b"RP LIDAR System.\r\n")

    def wait(self, seconds: float, step_ms: float = 2.0) -> bytes:
        out = bytearray()
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns:
            self.now_ns = min(end_ns, self.now_ns + round(step_ms * MS))
            out += self.laser.step(self.now_ns, b"", self.baud)
        return bytes(out)

    def ask(self, request: bytes, seconds: float = 0.05) -> bytes:
        return self.laser.step(self.now_ns, request, self.baud) + self.wait(seconds)


def request(command: int, data: bytes) -> bytes:
    frame = bytes((0xA5, command, len(data))) + data
    return frame + bytes((xor(frame),))


def xor(data: bytes) -> int:
    sum_ = 0
    for byte in data:
        sum_ ^= byte
    return sum_


def nodes(stream: bytes) -> list[tuple[bool, int, float, float]]:
    """(begins, quality, degrees, mm) of whole nodes; each must carry its check bits."""
    out = []
    for at in range(0, len(stream) - len(stream) % 5, 5):
        flags, angle, distance = struct.unpack_from("<BHH", stream, at)
        assert (flags ^ flags >> 1) & 1
        assert angle & 1
        out.append((bool(flags & 1), flags >> 2, (angle >> 1) / 64.0, distance / 4.0))
    return out


def capsules(stream: bytes) -> list[bytes]:
    out = [stream[at : at + 84] for at in range(0, len(stream) - len(stream) % 84, 84)]
    for capsule in out:
        assert (capsule[0] & 0xF0, capsule[1] & 0xF0) == (0xA0, 0x50)
        assert xor(capsule[2:]) == (capsule[0] & 15) | (capsule[1] & 15) << 4
    return out


def samples_of(capsule: bytes, after: bytes) -> list[tuple[float, float]]:
    """(degrees, mm) of the 32 samples of a capsule, by the start of the next."""
    begin, end = (int.from_bytes(c[2:4], "little") & 0x7FFF for c in (capsule, after))
    width = (end - begin) % 23040 / 64.0
    out = []
    for cabin in range(16):
        a, b, o = struct.unpack_from("<HHB", capsule, 4 + 5 * cabin)
        for k, (word, nibble) in enumerate(((a, o & 15), (b, o >> 4))):
            offset = nibble | (word & 3) << 4
            angle = begin / 64.0 + (2 * cabin + k) * width / 32.0 - offset / 8.0
            out.append((angle % 360.0, (word & 0xFFFC) / 4.0))
    return out


# -- frames and requests -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "begins", "quality", "angle", "mm"),
    [("3D 01 00 A0 0F", True, 15, 0, 1000), ("3E 73 00 A4 0F", False, 15, 57, 1001),
     ("02 FF B3 00 00", False, 0, 23039, 0)],
)  # fmt: skip
def test_nodes_are_as_published(frame: str, begins: bool, quality: int, angle: int, mm: int) -> None:
    assert encode_node(angle, mm * 4, quality, begins=begins) == bytes.fromhex(frame)


def test_capsule_is_as_published() -> None:
    capsule = encode_capsule(0, (1000 + np.arange(32)) * 4, np.zeros(32, np.int64), first=True)
    assert capsule[:14] == bytes.fromhex("A0 58 00 80 A0 0F A4 0F 00 A8 0F AC 0F 00")
    assert capsule[-5:] == bytes.fromhex("18 10 1C 10 00")
    assert len(capsule) == 84


@pytest.mark.parametrize("profile", sorted(RPLIDAR_PROFILES))
def test_identity(profile: str) -> None:
    bench = Bench(profile=RPLIDAR_PROFILES[profile], serial=bytes(range(16)))
    told = RPLIDAR_PROFILES[profile]
    head = bytes.fromhex("A5 5A 14 00 00 00 04") + bytes((told.model, 29, 1, told.hardware))
    assert bench.ask(INFO) == head + bytes(range(16))
    assert bench.ask(HEALTH) == bytes.fromhex("A5 5A 03 00 00 00 06 00 00 00")


def test_rates_and_board() -> None:
    assert Bench().ask(RATES) == bytes.fromhex("A5 5A 04 00 00 00 15") + struct.pack("<HH", 500, 250)
    assert Bench().ask(BOARD)[-4:] == bytes(4)
    assert Bench(profile=A2M8).ask(BOARD) == bytes.fromhex("A5 5A 04 00 00 00 FF 01 00 00 00")


def test_configuration_keys() -> None:
    bench = Bench(profile=A2M8)

    def value(asked: bytes) -> bytes:
        answer = bench.ask(asked)
        assert answer[:2] == b"\xa5\x5a"
        assert answer[6] == 0x20
        assert int.from_bytes(answer[2:6], "little") == len(answer) - 7
        assert answer[7:11] == asked[3:7]
        return answer[11:]

    assert value(MODE_COUNT) == b"\2\0"
    assert value(TYPICAL) == b"\1\0"
    assert value(US_OF_MODE_1) == struct.pack("<I", 250 * 256)
    assert value(request(0x84, struct.pack("<IH", 0x74, 0))) == struct.pack("<I", 16 * 256)
    assert value(request(0x84, struct.pack("<IH", 0x75, 0))) == b"\x81"
    assert value(request(0x84, struct.pack("<IH", 0x75, 1))) == b"\x82"
    assert value(request(0x84, struct.pack("<IH", 0x7F, 1))) == b"Express\0"
    assert value(request(0x84, struct.pack("<I", 0x01))) == struct.pack("<HH", 600, 660)
    assert value(request(0x84, struct.pack("<IH", 0x71, 9))) == b""
    assert value(request(0x84, struct.pack("<I", 0x4242))) == b""


def test_old_firmware_knows_no_configuration_and_one_express_mode() -> None:
    bench = Bench(firmware=(1, 20))
    assert bench.ask(INFO)[8:10] == bytes((20, 1))
    assert bench.ask(MODE_COUNT, 0.5) == b""
    assert bench.ask(RATES)[7:] == struct.pack("<HH", 500, 250)
    assert bench.ask(EXPRESS_0).startswith(EXPRESS_HEAD)


def test_wrong_sum_and_noise_are_not_answered() -> None:
    bench = Bench()
    assert bench.ask(MODE_COUNT[:-1] + b"\0") == b""
    assert bench.ask(b"\x00\xff\x13" + INFO)[6] == 4
    assert bench.ask(b"\xa5" + HEALTH)[6] == 6
    assert bench.ask(b"\xa5\x77") == b""


def test_host_at_another_rate_is_not_heard_and_hears_noise() -> None:
    bench = Bench()
    bench.baud = 9600
    assert bench.ask(INFO) == b""
    bench.baud = 115200
    bench.ask(SCAN)
    bench.baud = 256000
    noise = bench.wait(1.0)
    assert len(noise) > 5000
    valid = sum(1 for at in range(0, len(noise) - 5, 5) if (noise[at] ^ noise[at] >> 1) & 1 and noise[at + 1] & 1)
    assert valid < len(noise) / 5 * 0.4


def test_reset_is_followed_by_silence_and_boot_text() -> None:
    bench = Bench(boot_s=0.5)
    bench.ask(SCAN)
    assert bench.ask(RESET, 0.4) == b""
    text = bench.wait(0.3)
    assert text == b"RP LIDAR System.\r\nFirmware Ver 1.29 - rtm, HW Ver 5\r\nModel: 18\r\n"
    assert len(text) > 62, "some drivers wait for so many bytes of it"
    assert bench.wait(1.0) == b""


def test_error_state_refuses_scans_until_a_reset() -> None:
    bench = Bench(health=2, error=0x8001)
    assert bench.ask(HEALTH)[7:] == struct.pack("<BH", 2, 0x8001)
    assert bench.ask(SCAN, 0.5) == b""
    bench.ask(RESET, 1.0)
    assert bench.ask(HEALTH)[7:] == bytes(3)
    assert bench.ask(SCAN).startswith(SCAN_HEAD)


def test_trouble_ends_a_scan_and_outlasts_a_reset() -> None:
    bench = Bench()
    bench.ask(SCAN, 0.5)
    bench.laser.trouble("51", bench.now_ns)
    bench.wait(0.05)
    assert bench.wait(0.5) == b""
    bench.ask(RESET, 1.0)
    assert bench.ask(HEALTH)[7:] == struct.pack("<BH", 2, 51)
    bench.laser.trouble(None, bench.now_ns)
    assert bench.ask(SCAN).startswith(SCAN_HEAD)


# -- scans -------------------------------------------------------------------------------------------------------------


def stream(bench: Bench, asked: bytes, seconds: float, head: bytes = SCAN_HEAD) -> bytes:
    out = bench.ask(asked, seconds)
    assert out.startswith(head)
    return out[7:]


def test_standard_scan_keeps_sample_rate_and_turns() -> None:
    got = nodes(stream(Bench(), SCAN, 3.0))
    assert len(got) == pytest.approx(6000, abs=30)
    starts = [k for k, node in enumerate(got) if node[0]]
    turns = np.diff(starts)
    assert len(starts) in (20, 21, 22)
    assert turns.mean() == pytest.approx(2000 / 7.0, rel=0.015)
    assert len(set(turns)) > 1  # never the same number in every turn
    for before, after in itertools.pairwise(got):
        step_deg = (after[2] - before[2]) % 360.0
        assert 0.0 < step_deg < 2.0
        assert after[0] == (after[2] < before[2])
    assert {mm for _, _, _, mm in got} == {2000.0}


@pytest.mark.parametrize("yaw_deg", [90.0, -45.0])
def test_angles_grow_clockwise(yaw_deg: float) -> None:
    got = nodes(stream(Bench(scene=Circle(post_yaw_deg=yaw_deg)), SCAN, 1.0))
    post = np.radians([angle for _, _, angle, mm in got if mm == 1000.0])
    middle_deg = np.degrees(np.arctan2(np.sin(post).mean(), np.cos(post).mean()))
    assert middle_deg == pytest.approx(-yaw_deg, abs=1.0)


def test_samples_are_taken_at_their_instants() -> None:
    bench = Bench()
    bench.ask(SCAN, 1.0)
    stamps = np.concatenate(bench.scene.stamps)
    assert set(np.diff(stamps)) == {500_000.0}


@pytest.mark.parametrize(
    ("range_m", "mm"), [(0.10, 0), (0.16, 160), (11.9, 11900), (12.1, 0), (np.inf, 0), (np.nan, 0)]
)
def test_what_is_no_distance_is_zero(range_m: float, mm: float) -> None:
    got = nodes(stream(Bench(scene=Circle(range_m)), SCAN, 0.3))
    assert {node[3] for node in got} == {mm}
    assert all((quality > 0) == (mm > 0) for _, quality, _, _ in got)


@pytest.mark.parametrize("asked", [EXPRESS_0, EXPRESS_1])
def test_express_scan(asked: bytes) -> None:
    got = capsules(stream(Bench(scene=Circle(post_yaw_deg=-90.0)), asked, 2.0, EXPRESS_HEAD))
    assert len(got) == pytest.approx(250, abs=3)
    assert [c[3] >> 7 for c in got[:3]] == [1, 0, 0]
    samples = [s for pair in itertools.pairwise(got) for s in samples_of(*pair)]
    near = np.array([angle for angle, mm in samples if mm == 1000.0])
    assert near.min() == pytest.approx(80.0, abs=0.7)
    assert near.max() == pytest.approx(100.0, abs=0.7)
    assert len(near) / len(samples) == pytest.approx(20.0 / 360.0, rel=0.05)


def test_express_offsets_grow_when_things_are_near() -> None:
    def mean_offset(range_m: float) -> float:
        got = capsules(stream(Bench(scene=Circle(range_m)), EXPRESS_0, 0.5, EXPRESS_HEAD))
        return float(np.mean([c[8] & 15 | (c[4] & 3) << 4 for c in got]))  # of each first sample

    assert mean_offset(8.0) <= mean_offset(2.0) < mean_offset(0.5)


def test_a_scan_is_ended_by_stop_and_by_any_other_request() -> None:
    bench = Bench()
    for ending in (STOP, HEALTH):
        stream(bench, SCAN, 0.5)
        bench.ask(ending, 0.05)
        assert bench.wait(0.3) == b""


def test_a_motor_that_stands_gives_no_samples() -> None:
    bench = Bench(profile=A2M8, spin_up_s=1.0)
    stream(bench, SCAN, 0.5)
    assert bench.ask(PWM_0, 1.0)
    assert bench.wait(0.5) == b""
    bench.ask(STOP, 0.1)
    assert bench.ask(SCAN, 1.0) == SCAN_HEAD
    assert bench.ask(PWM_660, 0.5) == b""  # still spinning up
    assert len(nodes(bench.wait(1.0))) > 500


def test_forced_scan_does_not_wait_for_the_motor() -> None:
    bench = Bench(profile=A2M8)
    bench.ask(PWM_0, 2.0)
    got = nodes(stream(bench, FORCE, 0.5))
    assert len(got) > 900
    assert len({angle for _, _, angle, _ in got}) == 1
    assert not any(begins for begins, _, _, _ in got)


def test_pwm_sets_the_speed() -> None:
    bench = Bench(profile=A2M8)
    bench.ask(request(0xF0, struct.pack("<H", 330)), 2.0)
    assert bench.laser.turns_per_s == pytest.approx(5.0)
    got = nodes(stream(bench, SCAN, 2.0))
    assert sum(begins for begins, _, _, _ in got) == pytest.approx(10, abs=1)


def test_a1_motor_is_switched_from_outside() -> None:
    bench = Bench(profile=A1M8)
    bench.ask(PWM_0)
    assert bench.laser.turns_per_s == 7.0
    bench.laser.switch_motor(False, bench.now_ns)
    bench.wait(2.0)
    assert bench.ask(SCAN, 1.0) == SCAN_HEAD
    bench.laser.switch_motor(True, bench.now_ns)
    assert nodes(bench.wait(1.5))


@given(st.lists(st.tuples(st.binary(max_size=30), st.integers(0, 50)), max_size=6))
@settings(max_examples=40, deadline=None)
def test_survives_any_bytes_and_then_answers(pieces: list[tuple[bytes, int]]) -> None:
    bench = Bench()
    for piece, pause_ms in pieces:
        bench.ask(piece, pause_ms * 1e-3)
    bench.ask(bytes(300), 0.5)  # ends whatever was half said
    bench.ask(RESET, 1.0)
    assert bench.ask(INFO).startswith(bytes.fromhex("A5 5A 14 00 00 00 04 18"))


@given(st.lists(st.sampled_from([INFO, HEALTH, RATES, MODE_COUNT, BOARD, STOP, PWM_660]), max_size=6), st.data())
@settings(max_examples=30, deadline=None)
def test_same_answers_however_the_requests_are_cut(asked: list[bytes], data: st.DataObject) -> None:
    sent = b"".join(asked)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(sent)), max_size=5)))
    answers = []
    for pieces in ([sent], [sent[a:b] for a, b in zip([0, *cuts], [*cuts, len(sent)])]):
        bench = Bench()
        out = b"".join(bench.laser.step(bench.now_ns, piece, bench.baud) for piece in pieces)
        answers.append(out + bench.wait(0.2))
    assert answers[0] == answers[1]
    assert answers[0].count(b"\xa5\x5a") == sum(one not in (STOP, PWM_660) for one in asked)


@given(st.lists(st.integers(100_000, 60 * MS), min_size=1, max_size=20))
@settings(max_examples=20, deadline=None)
def test_same_stream_however_it_is_stepped(steps: list[int]) -> None:
    streams = []
    for pace in ([MS], steps):
        bench = Bench(noise_scale=1.0)
        out = bytearray(bench.laser.step(bench.now_ns, SCAN, bench.baud))
        end_ns = bench.now_ns + SECOND // 2
        for step_ns in itertools.cycle(pace):
            bench.now_ns = min(end_ns, bench.now_ns + step_ns)
            out += bench.laser.step(bench.now_ns, b"", bench.baud)
            if bench.now_ns == end_ns:
                break
        streams.append(bytes(out))
    assert streams[0] == streams[1]


def test_left_out_points_make_turns_of_varying_length() -> None:
    bench = Bench()
    bench.laser.points_left_out = 0.3
    got = nodes(stream(bench, SCAN, 2.0))
    assert len(got) == pytest.approx(2800, rel=0.05)
    assert sum(begins for begins, _, _, _ in got) in (13, 14, 15)


def test_supply_lost_stops_the_motor_and_a_reset_does_not() -> None:
    bench = Bench(spin_up_s=1.0, boot_s=0.2)
    bench.ask(RESET, 0.3)
    assert nodes(stream(bench, SCAN, 0.3))
    bench.laser.power_on(bench.now_ns)
    bench.wait(0.3)
    assert bench.ask(SCAN, 0.3) == SCAN_HEAD
