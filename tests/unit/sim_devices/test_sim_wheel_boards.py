"""Boards that count wheels and drive motors: published bytes, habits, faults, and what any host may send them."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_devices.checksums import crc16_ccitt
from sim_devices.device import F64, ByteDevice, Frame, Mount
from sim_devices.encoder_arduino_bridge import ArduinoBridge, Sonar
from sim_devices.encoder_odrive import ODriveAxis
from sim_devices.encoder_roboclaw import RoboClaw
from sim_devices.encoder_vesc import Vesc
from sim_devices.wheel import Side, Wheel

MS = 1_000_000
SECOND = 1_000_000_000
TURN_M = 2.0 * np.pi * 0.1


class Bench:
    """Wheels on blocks: they turn as motors tell them; `turns` moves them by hand. A wall 1.05 m away."""

    def __init__(self) -> None:
        self.speed = {"left": 0.0, "right": 0.0}
        self.since = {"left": 0, "right": 0}
        self.base = {"left": 0.0, "right": 0.0}
        self.wall_m = 1.05

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.full(len(bearing_rad), self.wall_m)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return self.wall_m

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return self._at("left", now_ns), self._at("right", now_ns)

    def drive_wheel(self, now_ns: int, side: Side, speed_m_s: float) -> None:
        self.base[side], self.since[side] = self._at(side, now_ns), now_ns
        self.speed[side] = speed_m_s

    def turn(self, left: float, right: float) -> None:
        self.base["left"] += left * TURN_M
        self.base["right"] += right * TURN_M

    def _at(self, side: str, now_ns: int) -> float:
        return self.base[side] + self.speed[side] * (now_ns - self.since[side]) * 1e-9


def wheels(scene: Bench, ticks_left: float = 1000.0, ticks_right: float = 1000.0) -> tuple[Wheel, Wheel]:
    return Wheel(scene, "left", 0.1, ticks_left), Wheel(scene, "right", 0.1, ticks_right)


def talk(device: ByteDevice, sent: bytes, now_ns: int, wait_ns: int = 50 * MS) -> bytes:
    """Send at now_ns, and what came back up to wait_ns later."""
    out = device.step(now_ns, sent)
    for later in range(MS, wait_ns + 1, MS):
        out += device.step(now_ns + later, b"")
    return out


# -- ros_arduino_bridge -----------------------------------------------------------------------------------------------


def bridge(scene: Bench | None = None) -> tuple[ArduinoBridge, Bench]:
    scene = scene or Bench()
    board = ArduinoBridge(*wheels(scene), sonars={7: Sonar(Mount())}, analog={2: 512}, pins={4: lambda _: True})
    board.step(0, b"")
    return board, scene


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        (b"b", b"57600"), (b"e", b"0 0"), (b"r", b"OK"), (b"m 20 20", b"OK"), (b"u 20:12:0:50", b"OK"),
        (b"a 2", b"512"), (b"a 3", b"0"), (b"d 4", b"1"), (b"d 5", b"0"), (b"w 13 1", b"OK"), (b"x 3 200", b"OK"),
        (b"c 5 0", b"OK"), (b"s 0 90", b"OK"), (b"t 0", b"90"), (b"", b"Invalid Command"), (b"q", b"Invalid Command"),
        (b"\ne", b"0 0"), (b"xyze", b"0 0"), (b"z 1 2", b"Invalid Command"),
    ],
)  # fmt: skip
def test_bridge_replies(command: bytes, reply: bytes) -> None:
    board, _ = bridge()
    assert talk(board, command + b"\r", 2 * SECOND) == reply + b"\r\n"


def test_bridge_reply_bytes_of_the_sheet() -> None:
    board, _ = bridge()
    assert talk(board, bytes.fromhex("650D"), 2 * SECOND).hex() == "302030" + "0d0a"


def test_bridge_counts_follow_the_wheels_and_r_zeroes_them() -> None:
    board, scene = bridge()
    scene.turn(0.2011, -0.0345)
    assert talk(board, b"e\r", 2 * SECOND) == b"201 -35\r\n"
    talk(board, b"r\r", 3 * SECOND)
    assert talk(board, b"e\r", 4 * SECOND) == b"0 0\r\n"


def test_bridge_line_feed_ends_nothing() -> None:
    board, _ = bridge()
    assert talk(board, b"e\n", 2 * SECOND) == b""
    assert talk(board, b"e\r", 3 * SECOND) == b"0 0\r\n"


def test_bridge_replies_come_whole_when_their_last_character_has_left() -> None:
    board, _ = bridge()
    board.step(2 * SECOND, b"r\r")
    pieces = {at_ns: board.step(2 * SECOND + at_ns, b"") for at_ns in range(0, MS, 10_000)}
    at_ns, text = next((at_ns, piece) for at_ns, piece in pieces.items() if piece)
    assert text == b"OK\r\n"
    assert at_ns == pytest.approx(200_000 + 4 * 10 * SECOND / 57600, abs=10_000)


def test_bridge_motors_stop_two_seconds_after_the_last_command() -> None:
    board, _ = bridge()
    talk(board, b"m 10 -20\r", 2 * SECOND)
    for at_ns in range(2 * SECOND, 6 * SECOND, 10 * MS):
        board.step(at_ns, b"")
    left, right = (int(word) for word in talk(board, b"e\r", 6 * SECOND).split())
    assert left == pytest.approx(2 * 30 * 10, abs=2)
    assert right == pytest.approx(-2 * 30 * 20, abs=2)
    assert not board.moving


def test_bridge_ping_takes_its_time_and_blocks_the_board() -> None:
    board, scene = bridge()
    out = board.step(2 * SECOND, b"p 7\re\r")
    out += board.step(2 * SECOND + 5 * MS, b"")
    assert out == b""  # 1.05 m there and back: 6.1 ms
    assert talk(board, b"", 2 * SECOND + 6 * MS) == b"105\r\n0 0\r\n"
    scene.wall_m = np.inf
    assert talk(board, b"p 7\r", 4 * SECOND, 37 * MS) == b""
    assert talk(board, b"", 4 * SECOND + 38 * MS) == b"0\r\n"
    assert talk(board, b"p 9\r", 5 * SECOND, 999 * MS) == b""
    assert talk(board, b"", 6 * SECOND) == b"0\r\n"


def test_bridge_is_deaf_while_it_boots_and_counts_from_zero_after_a_reset() -> None:
    board, scene = bridge()
    assert talk(board, b"b\r", SECOND // 2) == b""
    scene.turn(1.0, 1.0)
    assert talk(board, b"e\r", 2 * SECOND) == b"1000 1000\r\n"
    board.inflict("reset", 1.0, {}, 3 * SECOND)
    assert talk(board, b"e\r", 3 * SECOND + MS) == b""
    assert talk(board, b"e\r", 5 * SECOND) == b"0 0\r\n"


def test_bridge_counts_wrap_at_32_bits_signed() -> None:
    board, scene = bridge()
    board.inflict("wrap", 5, {}, 2 * SECOND)
    assert talk(board, b"e\r", 2 * SECOND) == b"2147483643 2147483643\r\n"
    scene.turn(0.0105, 0.0105)
    assert talk(board, b"e\r", 3 * SECOND) == b"-2147483643 -2147483643\r\n"
    board.inflict("wrap", 5, {"side": 1, "down": 1}, 4 * SECOND)
    assert talk(board, b"e\r", 4 * SECOND) == b"-2147483643 -2147483643\r\n"


def test_bridge_without_base_has_no_wheels() -> None:
    board = ArduinoBridge(None, None)
    board.step(0, b"")
    for at, command in enumerate((b"e", b"r", b"m 1 1", b"u 1:1:1:1"), start=2):
        assert talk(board, command + b"\r", at * SECOND) == b"Invalid Command\r\n"


def test_bridge_at_another_rate_hears_nothing_and_says_nonsense() -> None:
    board, _ = bridge()
    assert board.step(2 * SECOND, b"b\r", 9600) == b""
    board.step(3 * SECOND, b"b\r", 57600)
    assert board.step(3 * SECOND + 50 * MS, b"", 115200) not in (b"", b"57600\r\n")


# -- RoboClaw ---------------------------------------------------------------------------------------------------------


def claw(**options: object) -> tuple[RoboClaw, Bench]:
    scene = Bench()
    board = RoboClaw(*wheels(scene), **options)  # type: ignore[arg-type]
    board.step(0, b"")
    return board, scene


def ask(board: RoboClaw, text: str, now_ns: int) -> str:
    return talk(board, bytes.fromhex(text), now_ns, 20 * MS).hex(" ").upper()


def test_claw_bytes_of_the_sheet_for_counts() -> None:
    board, scene = claw()
    scene.turn(1.0, -2.0)
    board.step(SECOND, b"")
    board._read(17, SECOND)  # underflow was told before
    assert ask(board, "8010", 2 * SECOND) == "00 00 03 E8 00 71 36"
    assert ask(board, "8011", 3 * SECOND) == "FF FF F8 30 02 8A F5"
    assert ask(board, "804E", 4 * SECOND) == "00 00 03 E8 FF FF F8 30 17 A0"


def test_claw_bytes_of_the_sheet_for_speeds() -> None:
    board, scene = claw()
    scene.drive_wheel(0, "left", 0.15 * TURN_M)
    scene.drive_wheel(0, "right", -0.075 * TURN_M)
    assert ask(board, "8012", 2 * SECOND) == "00 00 00 96 00 88 70"
    assert ask(board, "8013", 3 * SECOND) == "00 00 00 4B 01 BE 8A"
    assert ask(board, "804F", 4 * SECOND) == "00 00 00 96 FF FF FF B5 B8 F7"


def test_claw_bytes_of_the_sheet_for_the_rest() -> None:
    board, _ = claw()
    assert ask(board, "8015", SECOND) == (b"USB Roboclaw 2x15a v4.2.4\n\0".hex(" ") + " C4 03").upper()
    assert ask(board, "8018", 2 * SECOND) == "00 79 D8 44"
    assert ask(board, "80 16 FF FF FF FB C4 B4", 3 * SECOND) == "FF"
    assert ask(board, "8010", 4 * SECOND).startswith("FF FF FF FB 00")
    assert ask(board, "80 14 49 2D", 5 * SECOND) == "FF"
    assert ask(board, "8010", 6 * SECOND).startswith("00 00 00 00 00")


@pytest.mark.parametrize(
    ("packet", "left", "right"),
    [("80 23 00 00 01 F4 AE EC", 500, 0), ("80 25 00 00 01 F4 FF FF FE 0C B2 76", 500, -500)],
)
def test_claw_drives(packet: str, left: int, right: int) -> None:
    board, _ = claw()
    assert ask(board, packet, SECOND) == "FF"
    count = bytes.fromhex(ask(board, "804E", 3 * SECOND))
    assert struct.unpack(">ii", count[:8]) == pytest.approx((2 * left, 2 * right), abs=3)


def test_claw_silence() -> None:
    board, _ = claw()
    assert ask(board, "80 23 00 00 01 F4 AE ED", SECOND) == ""  # bad CRC
    assert ask(board, "81 10", 2 * SECOND) == ""  # another address
    assert ask(board, "80 F0", 3 * SECOND) == ""  # nobody's command
    assert ask(board, "80 10", 4 * SECOND) != ""


def test_claw_forgets_a_packet_after_ten_milliseconds() -> None:
    board, _ = claw()
    board.step(SECOND, bytes.fromhex("80 23 00 00"))
    assert talk(board, bytes.fromhex("01 F4 AE EC"), SECOND + 9 * MS) == b"\xff"
    board.step(2 * SECOND, bytes.fromhex("80 23 00 00"))
    assert talk(board, bytes.fromhex("01 F4 AE EC"), 2 * SECOND + 11 * MS) == b""
    assert talk(board, bytes.fromhex("80 14 49 2D"), 3 * SECOND) == b"\xff"


def test_claw_tells_once_that_its_count_went_round() -> None:
    board, scene = claw()
    board.inflict("wrap", 5, {}, SECOND)
    assert ask(board, "8010", SECOND).startswith("FF FF FF FB 00")
    scene.turn(0.010, -1.0)
    assert ask(board, "8010", 2 * SECOND).startswith("00 00 00 05 04")
    assert ask(board, "8010", 3 * SECOND).startswith("00 00 00 05 00")
    scene.turn(-0.010, 0.0)
    assert ask(board, "8010", 4 * SECOND)[:14] in ("FF FF FF FB 01", "FF FF FF FB 03")


def test_claw_keeps_settings_and_stops_when_nobody_talks() -> None:
    board, scene = claw()

    def write(now_ns: int, *packet: int) -> str:
        text = bytes(packet)
        return ask(board, (text + crc16_ccitt(text).to_bytes(2, "big")).hex(), now_ns)

    assert write(SECOND, 0x80, 14, 5) == "FF"
    assert ask(board, "800F", 2 * SECOND).startswith("05")
    write(3 * SECOND, 0x80, 35, 0, 0, 1, 0)
    for at_ns in range(3 * SECOND, 5 * SECOND, 10 * MS):
        board.step(at_ns, b"")
    assert scene.speed["left"] == 0.0
    assert scene.base["left"] / TURN_M * 1000 == pytest.approx(0.5 * 256, abs=8)
    write(6 * SECOND, 0x80, 41, 0, 0, 1, 0, 0, 0, 0, 64, 1)  # 64 steps at 256 a second
    for at_ns in range(6 * SECOND, 7 * SECOND, 10 * MS):
        board.step(at_ns, bytes.fromhex("8010"))
    assert (scene.base["left"] / TURN_M * 1000) % 1000 == pytest.approx(0.5 * 256 + 64, abs=10)


def write_claw(board: RoboClaw, now_ns: int, *packet: int) -> str:
    text = bytes(packet)
    return ask(board, (text + crc16_ccitt(text).to_bytes(2, "big")).hex(), now_ns)


@pytest.mark.parametrize(("new", "modes"), [(False, (1, 2, 3)), (True, (1, 2, 3, 4, 5))])
def test_claw_has_the_settings_of_its_firmware(new: bool, modes: tuple[int, ...]) -> None:
    board, _ = claw(new_firmware=new)
    limits, key = ((0, 120, 1, 44), ()) if not new else ((0, 120, 1, 44, 1), (0xE2, 0x2E, 0xAB, 0x7A))
    assert write_claw(board, SECOND // 2, 0x80, 57, *limits) == "FF"
    assert bytes.fromhex(ask(board, "803B", SECOND // 4 * 3))[:-2] == bytes(limits)
    assert write_claw(board, SECOND, 0x80, 74, *modes) == "FF"
    answer = bytes.fromhex(ask(board, "804B", 2 * SECOND))
    assert tuple(answer[:-2]) == modes
    assert write_claw(board, 3 * SECOND, 0x80, 80, *key) == "FF"  # as delivered
    assert bytes.fromhex(ask(board, "804B", 4 * SECOND))[:-2] == bytes(len(modes))


def test_claw_takes_limits_of_batteries_by_byte() -> None:
    board, _ = claw()
    assert [write_claw(board, k * SECOND, 0x80, 2 + k, value) for k, value in enumerate((30, 154))] == ["FF", "FF"]
    assert struct.unpack(">HH", bytes.fromhex(ask(board, "803B", 3 * SECOND))[:4]) == (120, 301)


def test_claw_drives_and_turns_by_seven_bits() -> None:
    board, scene = claw(top_ticks_per_s=1000.0)
    for at, (command, value, left, right) in enumerate(
        [(8, 64, 504, 504), (10, 32, 756, 252), (13, 64, 504, 504), (12, 64, 0, 0), (11, 127, -1000, 1000)], start=1
    ):
        assert write_claw(board, at * SECOND, 0x80, command, value) == "FF"
        told = [1000.0 * scene.speed[side] / TURN_M for side in ("left", "right")]
        assert told == pytest.approx((left, right), abs=1)


def test_claw_on_usb_answers_in_one_packet() -> None:
    """Drivers that read once for each question rely on it."""
    board, _ = claw()
    board.step(SECOND, bytes.fromhex("8015"))
    pieces = [board.step(SECOND + at_ns, b"") for at_ns in range(0, MS, 10_000)]
    assert [len(piece) for piece in pieces if piece] == [len(b"USB Roboclaw 2x15a v4.2.4\n\0") + 2]


def test_claw_on_ttl_keeps_its_rate() -> None:
    board, _ = claw(link="ttl", baud_bps=38400)
    assert board.step(SECOND, bytes.fromhex("8010"), 115200) == b""
    assert board.step(2 * SECOND, b"", 38400) == b""
    board.step(3 * SECOND, bytes.fromhex("8010"), 38400)
    assert len(board.step(3 * SECOND + 2 * MS, b"", 38400)) == 5  # 1.5 ms of 3.8 characters a millisecond


# -- ODrive -----------------------------------------------------------------------------------------------------------


def axis(generation: str = "0.6", **options: object) -> tuple[ODriveAxis, Bench]:
    scene = Bench()
    one = ODriveAxis(Wheel(scene, "left", 0.1, 1.0), 0, generation=generation, **options)  # type: ignore[arg-type]
    one.step(0, [])
    return one, scene


def frames(one: ODriveAxis | Vesc, begin_ns: int, end_ns: int) -> list[Frame]:
    return [frame for at_ns in range(begin_ns, end_ns, MS) for frame in one.step(at_ns, [])]


def test_odrive_bytes_of_the_sheet() -> None:
    one, scene = axis(start_turns=1.5)
    scene.drive_wheel(0, "left", -0.25 * TURN_M)
    frames(one, MS, 300 * MS)
    first = frames(one, 300 * MS, 301 * MS)
    assert [frame.can_id for frame in first] == [0x001, 0x009]
    one._zero_turns = one._raw_turns(SECOND) - 1.5
    assert one._value(9, SECOND)[:4].hex().upper() == "0000C03F"
    assert struct.unpack("<f", one._value(9, SECOND)[4:])[0] == pytest.approx(-0.25)
    frames(one, 301 * MS, SECOND)
    scene.drive_wheel(SECOND, "left", 0.0)
    one.step(SECOND, [Frame(0x007, struct.pack("<I", 8))])
    beats = [frame for frame in frames(one, SECOND, 2 * SECOND) if frame.can_id == 0x001]
    assert len(beats) == 9  # the tenth left with the answer to the command
    assert beats[-1].data.hex().upper() == "0000000008000100"


def test_odrive_sends_estimates_every_ten_milliseconds() -> None:
    one, _ = axis()
    assert sum(frame.can_id == 0x009 for frame in frames(one, 0, 1300 * MS)) == 100


@pytest.mark.parametrize("ask_by", [Frame(0x00A, remote=True, dlc=8), Frame(0x00A)])
def test_odrive_counts_of_the_old_generation_on_request(ask_by: Frame) -> None:
    one, scene = axis("0.5")
    scene.turn(-1.25, 0.0)
    frames(one, 0, SECOND)
    answers = [frame for frame in one.step(SECOND, [ask_by]) if frame.can_id == 0x00A]
    assert struct.unpack("<ii", answers[0].data) == (-10240, 6144)
    new, _ = axis("0.6")
    frames(new, 0, SECOND)
    assert not [frame for frame in new.step(SECOND, [ask_by]) if frame.can_id == 0x00A]


def test_odrive_heartbeat_of_the_old_generation() -> None:
    one, _ = axis("0.5")
    assert one._heartbeat().hex() == "0000000001000080"
    one.inflict("alarm", 0x40, {}, SECOND)
    assert one._heartbeat().hex() == "4000000001010080"
    new, _ = axis("0.6")
    assert new._heartbeat().hex() == "0000000001000100"


def test_odrive_turns_in_closed_loop_only_and_stops_with_idle() -> None:
    one, scene = axis()
    frames(one, 0, SECOND)
    velocity = Frame(0x00D, struct.pack("<ff", 2.0, 0.0))
    one.step(SECOND, [velocity])
    assert scene.speed["left"] == 0.0
    one.step(SECOND, [Frame(0x007, struct.pack("<II", 8, 0)), velocity])
    assert scene.speed["left"] == pytest.approx(2.0 * TURN_M)
    frames(one, SECOND, 2 * SECOND)
    assert one.turns(2 * SECOND) == pytest.approx(2.0)
    one.step(2 * SECOND, [Frame(0x007, struct.pack("<I", 1))])
    assert scene.speed["left"] == 0.0
    one.step(2 * SECOND, [Frame(0x007, struct.pack("<I", 8)), Frame(0x00D, struct.pack("<ff", np.nan, 0.0))])
    assert scene.speed["left"] == 0.0


@pytest.mark.parametrize("generation", ["0.5", "0.6"])
def test_odrive_obeys_positions_and_velocities_until_a_mode_is_set(generation: str) -> None:
    """Programs that set none rely on the saved one, which their users chose for what they command."""
    one, _ = axis(generation)
    one.step(SECOND, [Frame(0x007, bytes((8, 0, 0, 0)))])
    one.step(SECOND, [Frame(0x00C, struct.pack("<fhh", 2.0, 0, 0))])
    for ms in range(1001, 2000):
        one.step(ms * SECOND // 1000, [])
    assert one.turns(2 * SECOND) == pytest.approx(2.0, abs=0.02)
    one.step(2 * SECOND, [Frame(0x00D, struct.pack("<ff", 1.0, 0.0))])
    assert one.turns(3 * SECOND) == pytest.approx(3.0, abs=0.02)
    one.step(3 * SECOND, [Frame(0x00B, struct.pack("<II", 2, 1)), Frame(0x00C, struct.pack("<fhh", 9.0, 0, 0))])
    assert one.turns(4 * SECOND) == pytest.approx(4.0, abs=0.02), "a position is nothing to a velocity controller"


def test_odrive_calibration_takes_seconds() -> None:
    one, _ = axis()
    one.step(SECOND, [Frame(0x007, struct.pack("<I", 3))])
    frames(one, SECOND, 2 * SECOND)
    assert one.state == 3
    frames(one, 2 * SECOND, 8 * SECOND)
    assert one.state == 1


def test_odrive_position_loses_steps_far_out_as_a_float_does() -> None:
    one, scene = axis(start_turns=10000.0)
    scene.turn(0.0004, 0.0)
    frames(one, 0, SECOND)
    assert struct.unpack("<f", one._value(9, SECOND)[:4])[0] == 10000.0
    scene.turn(0.0004, 0.0)
    assert struct.unpack("<f", one._value(9, SECOND)[:4])[0] == pytest.approx(10000.0 + 1 / 1024, abs=1e-9)


def test_odrive_reboot_starts_at_zero_again() -> None:
    one, scene = axis()
    scene.turn(3.0, 0.0)
    frames(one, 0, SECOND)
    assert one.turns(SECOND) == pytest.approx(3.0)
    one.step(SECOND, [Frame(0x016)])
    assert not frames(one, SECOND, SECOND + 299 * MS)
    assert one.turns(2 * SECOND) == 0.0


# -- VESC -------------------------------------------------------------------------------------------------------------


def vesc(**options: object) -> tuple[Vesc, Bench]:
    scene = Bench()
    one = Vesc(Wheel(scene, "right", 0.1, 1.0), 10, pole_pairs=7, **options)  # type: ignore[arg-type]
    one.step(0, [])
    return one, scene


def test_vesc_status_frames() -> None:
    one, scene = vesc()
    scene.turn(0.0, 2.0)
    sent = frames(one, 500 * MS, 1500 * MS)
    assert {frame.can_id for frame in sent} == {0x090A, 0x100A, 0x1B0A}
    assert all(frame.extended and len(frame.data) == 8 for frame in sent)
    assert len(sent) == 150
    tach, volts, _ = struct.unpack(">ihh", sent[-1].data)
    assert (tach, volts) == (2 * 7 * 6, 240)


def test_vesc_drives_for_a_second() -> None:
    one, scene = vesc()
    frames(one, 0, SECOND)
    one.step(SECOND, [Frame(0x030A, struct.pack(">i", 840), extended=True)])  # 120 rpm
    assert scene.speed["right"] == pytest.approx(2.0 * TURN_M)
    sent = frames(one, SECOND, 1900 * MS)
    assert struct.unpack(">i", [f for f in sent if f.can_id == 0x090A][-1].data[:4])[0] == 840
    frames(one, 1900 * MS, 2100 * MS)
    assert scene.speed["right"] == 0.0


def test_vesc_answers_pings_and_wraps() -> None:
    one, scene = vesc()
    frames(one, 0, SECOND)
    answer = one.step(SECOND, [Frame(0x110A, b"\x2a", extended=True)])
    assert Frame(0x122A, b"\x0a\x00", extended=True) in answer
    one.inflict("wrap", 3, {}, SECOND)
    assert struct.unpack(">i", one._status(27, SECOND)[:4])[0] == 2**31 - 3
    scene.turn(0.0, 1.0 / 7.0 + 1e-9)
    assert struct.unpack(">i", one._status(27, SECOND)[:4])[0] == -(2**31) + 3


# -- whatever comes ---------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.binary(max_size=40), st.integers(0, 30)), max_size=20))
def test_serial_boards_survive_any_bytes_and_answer_afterwards(sent: list[tuple[bytes, int]]) -> None:
    board, _ = bridge()
    claws, _ = claw()
    now_ns = 2 * SECOND
    for data, wait_ms in sent:
        now_ns += wait_ms * MS
        board.step(now_ns, data)
        claws.step(now_ns, data)
    now_ns += 200 * SECOND  # a host may have asked for many pings of empty pins
    talk(board, b"\r", now_ns)
    for _ in range(70):
        now_ns += SECOND
        talk(board, b"", now_ns, MS)
    assert talk(board, b"b\r", now_ns + SECOND).endswith(b"57600\r\n")
    assert len(talk(claws, b"\x80\x18", now_ns + SECOND)) in (0, 4)  # 0: its address may have stayed, not its silence
    assert len(talk(claws, b"\x80\x18", now_ns + 2 * SECOND)) == 4


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.builds(
            lambda can_id, data, extended, remote: Frame(can_id, data, extended, remote),
            st.integers(0, 0x1FFF), st.binary(max_size=8), st.booleans(), st.booleans(),
        ),
        max_size=30,
    )
)  # fmt: skip
def test_can_boards_survive_any_frames(received: list[Frame]) -> None:
    makers: list[Callable[[], tuple[ODriveAxis | Vesc, Bench]]] = [lambda: axis("0.5"), axis, vesc]
    for make in makers:
        one, _ = make()
        frames(one, 0, 600 * MS)
        for number, frame in enumerate(received):
            for answer in one.step(600 * MS + number * MS, [frame]):
                assert len(answer.data) <= 8
                assert 0 <= answer.can_id < 1 << 29
        assert frames(one, SECOND, 2 * SECOND)
