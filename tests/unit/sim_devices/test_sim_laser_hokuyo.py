"""The emulated Hokuyo against the worked exchanges of the protocol and its rules."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from sim_devices.device import F64, Mount
from sim_devices.laser_hokuyo import (
    PROFILES,
    UHG_08LX,
    URG_04LX,
    UST_10LX,
    UTM_30LX,
    HokuyoLaser,
    LaserProfile,
    data_lines,
    encode_number,
    encode_numbers,
)

MS = 1_000_000
SECOND = 1_000_000_000


class RampScene:
    """Step k of the sweep is at 1000 + k - 44 mm, and notes when each beam was fired."""

    def __init__(self, profile: LaserProfile = URG_04LX) -> None:
        self.profile = profile
        self.stamps: list[F64] = []
        self.replace: dict[int, float] = {}

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        self.stamps.append(stamp_ns)
        step = np.rint(bearing_rad * self.profile.steps_per_turn / (2 * np.pi)) + self.profile.front_step
        range_m = (1000.0 + step - 44.0) * 1e-3
        for at, value in self.replace.items():
            range_m[step == at] = value
        return range_m

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        raise AssertionError("a laser has no cone")

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        raise AssertionError("a laser has no wheels")


class Bench:
    """A laser on a wire with the time in hand."""

    def __init__(self, profile: LaserProfile = URG_04LX, **options: object) -> None:
        self.scene = RampScene(profile)
        options = {"noise_scale": 0.0, "spin_up_s": 0.5, "link": "usb"} | options
        self.laser = HokuyoLaser(self.scene, profile=profile, **options)  # type: ignore[arg-type]
        self.now_ns = 7 * SECOND
        self.laser.step(self.now_ns, b"")

    def wait(self, seconds: float, step_s: float = 0.001, baud: int | None = None) -> bytes:
        out = bytearray()
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns:
            self.now_ns = min(end_ns, self.now_ns + round(step_s * SECOND))
            out += self.laser.step(self.now_ns, b"", baud)
        return bytes(out)

    def ask(self, command: bytes, seconds: float = 0.02, baud: int | None = None) -> bytes:
        return self.laser.step(self.now_ns, command, baud) + self.wait(seconds, baud=baud)


def decoded(message: bytes, characters: int = 3) -> list[int]:
    """Distances of one report, its blocks joined."""
    lines = message.rstrip(b"\n").split(b"\n")[3:]
    data = b"".join(line[:-1] for line in lines)
    digits = np.frombuffer(data, np.uint8).astype(int) - 0x30
    weights = 64 ** np.arange(characters - 1, -1, -1)
    return [int(value) for value in digits.reshape(-1, characters) @ weights]


def reports(stream: bytes) -> list[bytes]:
    return [part + b"\n\n" for part in stream.split(b"\n\n") if part]


# -- encoding ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "characters", "text"),
    [(1234, 2, b"CB"), (4095, 2, b"oo"), (5432, 3, b"1Dh"), (1000, 3, b"0?X"), (0, 3, b"000"),
     (16000000, 4, b"m2@0"), (123456, 4, b"0N90"), (16777215, 4, b"oooo")],
)  # fmt: skip
def test_number_encoding(value: int, characters: int, text: bytes) -> None:
    assert encode_number(value, characters) == text
    assert encode_numbers(np.array([value]), characters).tobytes() == text


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 128, 2046])
def test_data_is_cut_into_blocks_of_64(count: int) -> None:
    data = np.full(count, ord("0"), np.uint8)
    lines = data_lines(data).split(b"\n")[:-1]
    assert [len(line) - 1 for line in lines] == [64] * (count // 64) + ([count % 64] if count % 64 else [])


# -- exchanges --------------------------------------------------------------------------------------------------------


def test_version_of_the_real_sensor() -> None:
    assert Bench().ask(b"VV\n") == (
        b"VV\n00P\nVEND:Hokuyo Automatic Co.,Ltd.;[\nPROD:SOKUIKI Sensor URG-04LX;[\nFIRM:3.1.00(18/Jan./2007);`\n"
        b"PROT:SCIP 2.0;N\nSERI:H0614967;V\n\n"
    )


def test_parameters_of_the_real_sensor() -> None:
    assert Bench().ask(b"PP\n") == (
        b"PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nDMIN:20;4\nDMAX:5600;_\nARES:1024;\\\nAMIN:44;7\n"
        b"AMAX:725;o\nAFRT:384;6\nSCAN:600;e\n\n"
    )


def test_parameters_of_the_utm() -> None:
    reply = Bench(UTM_30LX).ask(b"PP\n")
    for line in (
        b"DMIN:23;7",
        b"DMAX:60000;J",
        b"ARES:1440;^",
        b"AMIN:0;?",
        b"AMAX:1080;Z",
        b"AFRT:540;0",
        b"SCAN:2400;U",
    ):
        assert b"\n" + line + b"\n" in reply


def test_state_of_the_real_sensor() -> None:
    bench = Bench(link=None, clock_start_ms=0x81615)
    bench.wait(0.6)
    bench.laser.step(bench.now_ns, b"II\n")
    reply = bench.wait(0.2)
    for line in (b"LASR:OFF;7", b"SCSP:Initial(600[rpm])<-Default setting by user;A", b"MESM:IDLE;:",
                 b"SBPS:19200[bps]<-Default setting by user;A", b"STAT:Sensor works well.;8"):  # fmt: skip
        assert b"\n" + line + b"\n" in reply
    assert len(reply.rstrip(b"\n").split(b"\n")) == 2 + 7


def test_starting_motor_is_told() -> None:
    assert b"STAT:Motor is starting up." in Bench(spin_up_s=3.0).ask(b"II\n")


@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES.keys())
def test_state_changes_and_their_statuses(profile: LaserProfile) -> None:
    bench = Bench(profile)
    exchanges = """
        QT 00P, BM 00P, BM 02R, XX 0Ee, TM2 03S, TM0 00P
        TM0 02R, TM7 01Q, VV 0Ee, MD0044072501000 0Ee, QT 00P, TM2 00P
        HS1 00P, HS1 02R, HSx 01Q, TM0 00P, RS 00P, HS0 02R
        DB99 02R, RB 01Q, RB 00P
    """
    for exchange in exchanges.replace("\n", ",").split(","):
        if exchange.strip():
            command, status = exchange.split()
            assert bench.ask(command.encode() + b"\n") == f"{command}\n{status}\n\n".encode()


def test_time_of_the_worked_example() -> None:
    bench = Bench(clock_start_ms=123456 - 20)
    assert bench.ask(b"TM0\n") == b"TM0\n00P\n\n"
    assert bench.ask(b"TM1\n") == b"TM1\n00P\n0N90W\n\n"


def test_time_outside_time_mode_is_refused_by_the_urg_and_answered_by_the_utm() -> None:
    assert Bench().ask(b"TM1\n") == b"TM1\n04T\n\n"
    assert Bench(UTM_30LX).ask(b"TM1\n").startswith(b"TM1\n00P\n")


@pytest.mark.parametrize(
    ("command", "status"),
    [
        (b"MDx044072501000", b"01Q"),
        (b"MD0044x72501000", b"02R"),
        (b"MD00440725x1000", b"03S"),
        (b"MD0044076901000", b"04T"),
        (b"MD0072004401000", b"05U"),
        (b"MD0044072501x00", b"06V"),
        (b"MD00440725010x0", b"07W"),
        (b"MD004407250100", b"0Cc"),
        (b"MD00440725010000", b"0Dd"),
        (b"VVV", b"0Dd"),
        (b"TM", b"0Cc"),
        (b"GD0044072501", b"10Q"),
        (b"GD9999072501", b"05U"),
        (b"VV;a*b", b"0Hh"),
        (b"SS11520x", b"01Q"),
        (b"SS123456", b"02R"),
        (b"SS115200", b"00P"),
        (b"CRxx", b"01Q"),
        (b"CR11", b"02R"),
        (b"CR00", b"03S"),
        (b"CR05", b"00P"),
        (b"ME0044072501000", b"0Ee"),
        (b"HD0044072501", b"0Ee"),
        (b"%ST", b"0Ee"),
        (b"VV;" + b"a" * 17, b"0Gg"),
    ],
)
def test_parameter_errors(command: bytes, status: bytes) -> None:
    assert Bench().ask(command + b"\n") == command + b"\n" + status + b"\n\n"


def test_free_string_is_echoed_in_every_part() -> None:
    bench = Bench()
    bench.wait(1.0)
    stream = bench.ask(b"MD0044004501001;cart-1 a.b_c+@\n", 0.4)
    first, second = reports(stream)
    assert first == b"MD0044004501001;cart-1 a.b_c+@\n00P\n\n"
    assert second.startswith(b"MD0044004501000;cart-1 a.b_c+@\n99b\n")


@pytest.mark.parametrize("end", [b"\n", b"\r", b"\r\n"])
def test_line_ends(end: bytes) -> None:
    bench = Bench()
    assert bench.ask(b"QT" + end) == b"QT\n00P\n\n"
    assert bench.ask(b"\n") == b""


def test_commands_arriving_byte_by_byte_and_two_at_once() -> None:
    bench = Bench()
    out = b"".join(bench.ask(bytes((byte,)), 0.001) for byte in b"QT\nBM\n")
    assert out + bench.wait(0.01) == b"QT\n00P\n\nBM\n00P\n\n"
    assert bench.ask(b"QT\nQT\n") == b"QT\n00P\n\n" * 2


def test_hasty_repetition_is_refused_when_asked_for() -> None:
    assert Bench(refuse_hasty=True).ask(b"QT\nQT\n") == b"QT\n00P\n\nQT\n0Bb\n\n"


def test_endless_junk_without_a_line_end_is_forgotten() -> None:
    bench = Bench()
    for _ in range(50):
        bench.ask(b"\xff" * 100, 0.001)
    assert bench.ask(b"\nQT\n").endswith(b"QT\n00P\n\n")


# -- SCIP 1.1 ---------------------------------------------------------------------------------------------------------


def test_power_up_in_scip_1() -> None:
    bench = Bench(start_in_scip1=True)
    assert bench.ask(b"QT\n") == b"QT\nE\n\n"
    assert bench.ask(b"V\n").startswith(b"V\n0\nVEND:Hokuyo Automatic Co.,Ltd.\nPROD:")
    assert bench.ask(b"SCIP2.0\n") == b"SCIP2.0\n0\n\n"
    assert bench.ask(b"QT\n") == b"QT\n00P\n\n"
    assert bench.ask(b"SCIP2.0\n") == b"SCIP2.0\n0Ee\n\n"


def test_scans_of_scip_1_have_two_characters_a_value_and_no_sums() -> None:
    """What drivers of the first URGs ask; ranges are 1000 mm and up from step 44 on."""
    bench = Bench(start_in_scip1=True)
    bench.wait(1.0)
    reply = bench.ask(b"G04408301\n")
    assert reply.startswith(b"G04408301\n0\n?X?Y?Z?[?\\?]?^?_")
    lines = reply.rstrip(b"\n").split(b"\n")[2:]
    assert [len(line) for line in lines] == [64, 16]
    digits = np.frombuffer(b"".join(lines), np.uint8).astype(int) - 0x30
    assert list(digits[::2] * 64 + digits[1::2]) == list(range(1000, 1040))
    assert bench.ask(b"G04405104\n") == b"G04405104\n0\n?X?\\\n\n"  # the nearest of four
    assert [bench.ask(b"L0\n"), bench.ask(b"G04405104\n")] == [b"L0\n0\n\n", b"G04405104\nE\n\n"]
    assert [bench.ask(b"L1\n"), bench.ask(b"G04408399\n")[:12]] == [b"L1\n0\n\n", b"G04408399\n0\n"]
    for wrong in (b"G083044001\n", b"G08304401\n", b"G04476901\n", b"S1234567654321\n", b"G0x408301\n"):
        assert bench.ask(wrong) == wrong + b"E\n\n"


def test_scip_1_changes_its_rate_after_the_answer() -> None:
    bench = Bench(start_in_scip1=True, link="rs232")
    bench.wait(1.0)
    assert bench.ask(b"S1152007654321\n", 0.05, baud=19200) == b"S1152007654321\n0\n\n"
    assert bench.ask(b"V\n", 0.2, baud=115200).startswith(b"V\n0\nVEND:")


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
def test_greeting_has_the_form_of_the_recorded_one() -> None:
    """The recorded sensor and ours agree on every line but its own numbers."""
    path = Path(os.environ["UMFELD_DATA"]) / "device_bytes" / "urg04lx_scip2.bin.gz"
    recorded = gzip.decompress(path.read_bytes())
    bench = Bench(start_in_scip1=True, link=None)
    bench.ask(b"SCIP2.0\n", 0.5)
    assert b"SCIP2.0\n0\n\n" in recorded
    ours = bench.ask(b"PP\n", 0.5)
    assert ours in recorded
    form = [line.split(b":")[0] for line in bench.ask(b"II\n", 0.5).split(b"\n")]
    theirs = recorded[recorded.index(b"II\n00P") :].split(b"\n")[: len(form) - 1]
    assert [line.split(b":")[0] for line in theirs] == form[:-1]


# -- streaming --------------------------------------------------------------------------------------------------------


def test_worked_stream() -> None:
    """Ranges 1000..1039 mm at steps 44..83, byte for byte."""
    bench = Bench(clock_start_ms=5000 - 500)
    stream = bench.ask(b"MD0044008301000\n", 0.62)
    first, second = reports(stream)
    assert first == b"MD0044008301000\n00P\n\n"
    assert second == (
        b"MD0044008301000\n99b\n01>8G\n"
        b"0?X0?Y0?Z0?[0?\\0?]0?^0?_0?`0?a0?b0?c0?d0?e0?f0?g0?h0?i0?j0?k0?l0E\n"
        b"?m0?n0?o0@00@10@20@30@40@50@60@70@80@90@:0@;0@<0@=0@>0@?O\n\n"
    )


def test_count_tells_the_scans_that_remain_and_laser_goes_off() -> None:
    bench = Bench()
    bench.wait(1.0)
    stream = reports(bench.ask(b"MD0044072501005\n", 1.0))
    assert [part[13:15] for part in stream] == [b"05", b"04", b"03", b"02", b"01", b"00"]
    assert not bench.laser.laser_is_on
    assert bench.ask(b"GD0044072501\n") == b"GD0044072501\n10Q\n\n"


def test_interval_skips_scans() -> None:
    bench = Bench()
    stream = reports(bench.ask(b"MD0044004501203\n", 3.0))
    stamps = [decoded(b"a\nb\nc\n" + part.split(b"\n")[2] + b"\n", 4)[0] for part in stream[1:]]
    assert np.diff(stamps).tolist() == [300, 300]


def test_quit_lets_the_scan_under_way_finish() -> None:
    bench = Bench(UTM_30LX)
    bench.wait(1.0)
    bench.ask(b"MD0000108001000\n", 0.05)
    while not (part := bench.wait(0.0005, 0.0005)):
        pass
    rest = bench.ask(b"QT\n", 0.1)
    whole = part + rest
    assert whole.endswith(b"\n\nQT\n00P\n\n")
    assert len(decoded(whole[: whole.index(b"QT\n00P")][-3372:])) == 1081
    assert bench.wait(0.2) == b""


def test_clusters_take_the_smallest_distance_and_codes_only_if_nothing_else() -> None:
    bench = Bench()
    bench.scene.replace = {44: 0.005, 45: 3.0, 46: 2.0, 47: np.inf, 48: np.nan, 49: -np.inf, 50: 0.9}
    bench.wait(1.0)
    report = reports(bench.ask(b"MD0044005003001\n", 0.3))[1]
    assert decoded(report) == [2000, 0, 900]


def test_two_character_form_is_clipped() -> None:
    bench = Bench()
    bench.scene.replace = {44: 0.019, 45: 1.0, 46: 4.2}
    bench.wait(1.0)
    assert decoded(reports(bench.ask(b"MS0044004601001\n", 0.3))[1], 2) == [18, 1000, 4095]


@pytest.mark.parametrize(
    ("profile", "nothing", "near", "unknown"), [(URG_04LX, 0, 18, 19), (UHG_08LX, 0, 18, 19), (UTM_30LX, 1, 2, 3)]
)
def test_codes_of_what_is_no_distance(profile: LaserProfile, nothing: int, near: int, unknown: int) -> None:
    bench = Bench(profile)
    bench.scene.replace = {44: np.inf, 45: 0.001, 46: -np.inf, 47: np.nan, 48: 1e6, 49: 1.0}
    bench.wait(1.0)
    assert decoded(reports(bench.ask(b"MD0044004901001\n", 0.3))[1]) == [nothing, near, near, unknown, nothing, 1000]


def test_dead_steps_of_the_urg_are_not_measurable() -> None:
    bench = Bench()
    bench.wait(1.0)
    values = decoded(reports(bench.ask(b"MD0042076801001\n", 0.3))[1])
    assert values[:3] == [19, 19, 1000]
    assert values[725 - 42 : 725 - 42 + 2] == [1681, 19]


def test_intensity_pairs_of_the_utm() -> None:
    bench = Bench(UTM_30LX)
    bench.scene.replace = {1: np.inf}
    bench.wait(1.0)
    values = decoded(reports(bench.ask(b"ME0000000301001\n", 0.2))[1])
    assert values[0::2] == [956, 1, 958, 959]
    assert values[1] > 2000
    assert values[3] == 0


def test_latest_scan_waits_for_the_first_and_is_then_at_hand() -> None:
    bench = Bench()
    assert bench.ask(b"BM\nGD0044072501\n", 0.1) == b"BM\n00P\n\n"
    assert len(decoded(bench.wait(0.55))) == 682
    again = bench.ask(b"GS0044008301\n", 0.01)
    assert again.startswith(b"GS0044008301\n00P\n")
    assert decoded(again, 2)[:2] == [1000, 1001]


def test_new_stream_replaces_the_running_one() -> None:
    bench = Bench()
    bench.wait(1.0)
    bench.ask(b"MD0044072501000\n", 0.25)
    stream = reports(bench.ask(b"MD0044004501000\n", 0.35))
    assert all(part.startswith(b"MD00440045") for part in stream)


# -- time -------------------------------------------------------------------------------------------------------------


def test_beams_are_fired_one_after_the_other_and_leave_when_the_sweep_is_done() -> None:
    bench = Bench()
    stream = b""
    bench.laser.step(bench.now_ns, b"MD0044072501001\n")
    while b"99b" not in stream:
        stream += bench.wait(0.0001, 0.0001)
    stamp_ns = bench.scene.stamps[0]
    assert np.allclose(np.diff(stamp_ns), 100 * MS / 1024, atol=1.0)
    assert stamp_ns[0] == pytest.approx(7.5 * SECOND + 44 / 1024 * 100 * MS, abs=2)
    assert bench.now_ns >= stamp_ns[-1]
    assert bench.now_ns - stamp_ns[-1] < 10 * MS


def test_scans_follow_the_rotation_not_the_requests() -> None:
    bench = Bench(UTM_30LX)
    bench.wait(0.513)
    bench.ask(b"MD0000108001000\n", 1.0)
    starts = [stamp[0] for stamp in bench.scene.stamps]
    assert np.allclose((np.array(starts) - 7.5 * SECOND) % (25 * MS), 0, atol=2)
    assert np.allclose(np.diff(starts), 25 * MS, atol=2)


def test_clock_drifts_and_wraps() -> None:
    bench = Bench(clock_drift_ppm=1000.0, clock_start_ms=(1 << 24) - 100)
    assert bench.laser.clock_ms(bench.now_ns) == (1 << 24) - 100
    assert bench.laser.clock_ms(bench.now_ns + 10 * SECOND) == 10_010 - 100
    bench.laser.set_clock_drift(0.0, bench.now_ns + 10 * SECOND)
    assert bench.laser.clock_ms(bench.now_ns + 11 * SECOND) == 11_010 - 100


def test_reset_sets_the_clock_to_zero() -> None:
    bench = Bench(clock_start_ms=4711)
    bench.ask(b"RS\n", 0.0)
    assert bench.laser.clock_ms(bench.now_ns + 3 * MS) == 3


def test_slower_motor() -> None:
    bench = Bench()
    bench.wait(1.0)
    bench.ask(b"CR10\n")
    bench.ask(b"MD0044004501003\n", 1.0)
    starts = [stamp[0] for stamp in bench.scene.stamps]
    assert np.allclose(np.diff(starts), 100 * MS / 0.9, atol=3)
    assert b"SCSP:10%Down(540[rpm])" in bench.ask(b"II\n")


# -- the line ---------------------------------------------------------------------------------------------------------


def test_bytes_leave_at_the_rate_of_the_line() -> None:
    bench = Bench(link=None)
    bench.laser.step(bench.now_ns, b"PP\n")
    begin_ns, total = bench.now_ns, b""
    while not total.endswith(b"\n\n"):
        total += bench.wait(0.0001, 0.0001)
        assert len(total) <= (bench.now_ns - begin_ns) * 1920 / SECOND
    assert (bench.now_ns - begin_ns) * 1e-9 == pytest.approx(len(total) / 1920, abs=2e-4)


def test_slow_line_skips_scans_and_keeps_the_rest_whole() -> None:
    bench = Bench(link=None)
    bench.wait(1.0)
    stream = bench.ask(b"MD0044072501000\n", 6.0)
    whole = [part for part in reports(stream)[1:] if len(part) > 2000]
    assert 4 <= len(whole) <= 6
    assert bench.laser.skipped_scans > 30
    assert all(len(decoded(part)) == 682 for part in whole[:-1])


def test_rate_change_answers_at_the_old_rate() -> None:
    bench = Bench(link=None)
    reply = bench.ask(b"SS115200\n", 0.1, baud=19200)
    assert reply == b"SS115200\n00P\n\n"
    assert bench.laser.line_rate_bps == 115200
    assert bench.ask(b"QT\n", 0.1, baud=19200) == b""
    assert bench.ask(b"QT\n", 0.1, baud=115200) == b"QT\n00P\n\n"
    assert bench.ask(b"SS115200\n", 0.1, baud=115200) == b"SS115200\n03S\n\n"
    assert bench.ask(b"RS\n", 0.1, baud=115200) == b"RS\n00P\n\n"
    assert bench.laser.line_rate_bps == 19200


def test_host_at_another_rate_reads_noise() -> None:
    bench = Bench(link=None)
    bench.wait(1.0)
    bench.ask(b"MD0044072501000\n", 0.1, baud=19200)
    noise = bench.wait(1.0, baud=115200)
    assert len(noise) > 500
    assert b"MD0044" not in noise
    assert max(noise) > 0x7F


def test_usb_does_not_mind_the_rate() -> None:
    bench = Bench(UTM_30LX)
    assert bench.ask(b"QT\n", baud=9600) == b"QT\n00P\n\n"
    assert bench.ask(b"SS019200\n") == b"SS019200\n00P\n\n"


# -- trouble ----------------------------------------------------------------------------------------------------------


def test_trouble_ends_the_stream_and_keeps_the_laser_off() -> None:
    bench = Bench()
    bench.wait(1.0)
    bench.ask(b"MD0044004501000\n", 0.25)
    bench.laser.trouble("51", bench.now_ns)
    assert bench.wait(0.2).endswith(b"MD0044004501000\n51V\n\n")
    assert bench.ask(b"BM\n") == b"BM\n01Q\n\n"
    assert b"STAT:Error 51" in bench.ask(b"II\n")
    assert bench.ask(b"DB10\n") == b"DB10\n00P\n\n"
    assert bench.ask(b"BM\n") == b"BM\n00P\n\n"


def test_reboot_forgets_everything_and_motor_starts_again() -> None:
    bench = Bench(UTM_30LX, clock_start_ms=0)
    bench.wait(2.0)
    bench.ask(b"BM\nRB\nRB\n")
    assert not bench.laser.laser_is_on
    assert bench.laser.clock_ms(bench.now_ns) <= 20
    assert bench.ask(b"QT\n", 0.4) == b""
    bench.wait(0.1)
    assert b"STAT:Motor is starting up." in bench.ask(b"II\n")


def test_two_reboots_too_far_apart_are_none() -> None:
    bench = Bench(UTM_30LX)
    assert bench.ask(b"RB\n", 1.5) == b"RB\n01Q\n\n"
    assert bench.ask(b"RB\n") == b"RB\n01Q\n\n"


def test_short_state_of_the_ust() -> None:
    bench = Bench(UST_10LX, link=None)
    bench.wait(1.0)
    states = []
    for command in (b"", b"BM\n", b"MD0000108001000\n", b"QT\n", b"TM0\n"):
        bench.ask(command, 0.05)
        reply = bench.ask(b"%ST\n", 0.05)
        states.append(reply[reply.index(b"%ST\n00P\n") + 8 :][:3])
    assert states == [b"000", b"003", b"004", b"000", b"002"]


def test_lost_tcp_host_stops_the_stream() -> None:
    bench = Bench(UST_10LX, link=None)
    bench.wait(1.0)
    bench.ask(b"MD0000108001000\n", 0.1)
    bench.laser.link_lost(bench.now_ns)
    assert bench.wait(0.5) == b""
    assert not bench.laser.laser_is_on


# -- noise ------------------------------------------------------------------------------------------------------------


def test_noise_is_seeded_and_of_the_models_size() -> None:
    def measured(seed: int) -> list[int]:
        bench = Bench(UTM_30LX, noise_scale=1.0, seed=seed)
        bench.scene.replace = dict.fromkeys(range(1081), 10.0)
        bench.wait(1.0)
        return decoded(reports(bench.ask(b"MD0000108001001\n", 0.2))[1])

    assert measured(1) == measured(1)
    assert measured(1) != measured(2)
    assert np.mean(measured(3)) == pytest.approx(10_000, abs=3)
    assert np.std(measured(3)) == pytest.approx(14, rel=0.2)  # 8 mm + 0.6 mm/m


def test_dropouts_are_codes() -> None:
    bench = Bench(UTM_30LX, dropout=0.3)
    bench.wait(1.0)
    values = np.array(decoded(reports(bench.ask(b"MD0000108001001\n", 0.2))[1]))
    assert 0.2 < np.mean(values == 2) < 0.4
    assert np.all((values == 2) | (values >= 23))


def test_long_pause_between_steps_neither_floods_nor_hangs() -> None:
    bench = Bench(UTM_30LX)
    bench.ask(b"MD0000108001000\n", 1.0)
    bench.now_ns += 5 * SECOND
    late = bench.laser.step(bench.now_ns, b"")
    assert 190 <= len(reports(late)) <= 202


def test_sleep_turns_all_off_until_it_is_asked_to_measure() -> None:
    bench = Bench(UST_10LX, link="tcp")
    bench.wait(1.0)
    assert bench.ask(b"BM\n") == b"BM\n00P\n\n"
    assert bench.ask(b"%SL\n") == b"%SL\n00P\n\n"
    assert not bench.laser.laser_is_on
    assert b"\n005" in bench.ask(b"%ST\n")
    bench.ask(b"BM\n")
    assert b"\n005" not in bench.ask(b"%ST\n")


def test_only_devices_on_a_network_sleep() -> None:
    assert b"\n0E" in Bench(UTM_30LX).ask(b"%SL\n")
