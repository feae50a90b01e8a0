"""The emulated ultrasonic board against the maker's frames and its parameters' meaning."""

from __future__ import annotations

from math import inf, radians

import pytest

from sim_devices.device import F64, Frame, Mount
from sim_devices.sonar_usboard import (
    Transducer,
    UsBoard,
    UsBoardCan,
    UsBoardSerial,
    board_with,
    default_parameters,
    packed_12bit,
    speed_of_sound,
)

MS = 1_000_000
SECOND = 1_000_000_000


class Walls:
    """Each channel's distance by the x of its mount; notes when each was asked."""

    def __init__(self, range_m: dict[int, float]) -> None:
        self.range_m = range_m
        self.asked: list[tuple[int, int]] = []

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        raise AssertionError("a sonar has no beams")

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        channel = round(mount.x_m)
        self.asked.append((channel, now_ns))
        return self.range_m.get(channel, inf)

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        raise AssertionError("a sonar has no wheels")


def transducers(*channels: int) -> dict[int, Transducer]:
    return {channel: Transducer(Mount(x_m=channel)) for channel in channels}


def board(range_m: dict[int, float], parameters: bytes | None = None, **options: object) -> UsBoard:
    connected = transducers(*range_m)
    options = {"noise_m": 0.0} | options
    return UsBoard(Walls(range_m), connected, parameters=parameters, **options)  # type: ignore[arg-type]


def changed(parameters: bytes, at: int, *values: int) -> bytes:
    return parameters[:at] + bytes(values) + parameters[at + len(values) :]


class OnCan:
    def __init__(self, board: UsBoard) -> None:
        self.board = board
        self.can = UsBoardCan(board)
        self.now_ns = 3 * SECOND
        self.can.step(self.now_ns, [])
        self.wait(0.4)

    def wait(self, seconds: float, step_s: float = 0.005) -> list[tuple[int, str]]:
        frames: list[Frame] = []
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns:
            self.now_ns = min(end_ns, self.now_ns + round(step_s * SECOND))
            frames += self.can.step(self.now_ns, [])
        return [(frame.can_id, frame.data.hex().upper()) for frame in frames]

    def ask(self, data: bytes, seconds: float = 0.0) -> list[tuple[int, str]]:
        frames = self.can.step(self.now_ns, [Frame(self.board.base_id, data)])
        return [(frame.can_id, frame.data.hex().upper()) for frame in frames] + self.wait(seconds)


# -- the maker's frames -----------------------------------------------------------------------------------------------


def test_connect() -> None:
    assert OnCan(board({1: 0.5})).ask(b"\0") == [(0x401, "0001020304050607")]


def test_short_data_of_the_published_frames() -> None:
    one = OnCan(board({i + 1: 0.30 + 0.05 * i for i in range(16)}))
    assert one.ask(bytes((2,))) == [(0x402, "02001E23282D0000"), (0x403, "020132373C410000")]
    assert one.ask(bytes((3,))) == [(0x404, "030046" + "4B50550000"), (0x405, "03015A5F64690000")]


def test_group_data_of_the_published_frames() -> None:
    ranges = {1: 0.30, 2: 0.35, 3: 0.40, 4: 0.45, 5: 0.50, 6: 0.55, 7: 0.60, 8: 0.65}
    ranges |= {14: 0.05, 15: inf, 16: 1.05}
    one = OnCan(board(ranges))
    assert one.ask(bytes((13, 0b1011))) == [
        (0x40D, "0DF43C46505A0000"),
        (0x40E, "0DF5646E78820000"),
        (0x410, "0DF7000102D20000"),
    ]


def test_parameters_of_the_published_frames() -> None:
    frames = OnCan(board({})).ask(bytes((6,)))
    assert {can_id for can_id, _ in frames} == {0x406}
    assert [data for _, data in frames] == [
        "0600000004000000", "0601F000FFFF6464", "0602646464646464", "0603646464646464", "0604" + "64" * 2 + "1E" * 4,
        "0605" + "1E" * 6, "0606" + "1E" * 6, "0607550000111180", "0608001539300000",
    ]  # fmt: skip


def test_analog_inputs() -> None:
    one = OnCan(board({}, analog=(291, 1110, 1929, 2748)))
    assert one.ask(bytes((7,))) == [(0x407, "07235689BC41A700")]


def test_serial_packets_of_the_maker() -> None:
    wire = UsBoardSerial(board({1: 0.30, 2: 0.35, 3: 0.40, 4: 0.45}))
    wire.step(0, b"")
    wire.step(SECOND, b"")
    wire.step(SECOND, bytes((13, 1, 0, 0, 0, 0, 0, 0)) + bytes(8))
    assert wire.step(2 * SECOND, b"").hex().upper() == "FF0DF43C46505A00003C14" + "FF0001020304050607040F"


def test_serial_bytes_take_their_time_and_junk_is_forgotten() -> None:
    wire = UsBoardSerial(board({}))
    wire.step(0, b"")
    now_ns = SECOND
    wire.step(now_ns, b"\x55\x66\x77")
    now_ns += 100 * MS
    wire.step(now_ns, bytes(8))
    assert wire.step(now_ns + 5 * MS, b"") == b""  # 11 bytes take 5.7 ms; a USB chip hands them on together
    assert wire.step(now_ns + 6 * MS, b"") == bytes.fromhex("FF0001020304050607040F")


def test_serial_at_another_rate_reads_noise_and_hears_nothing() -> None:
    wire = UsBoardSerial(board({}))
    wire.step(0, b"", 19200)
    wire.step(SECOND, bytes(8), 9600)
    assert wire.step(2 * SECOND, b"", 19200) == b""
    wire.step(2 * SECOND, bytes(8), 19200)
    assert b"\xff\x00\x01\x02" not in wire.step(3 * SECOND, b"", 9600)


# -- codes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("resolution", "unit_m"), [(0, 0.01), (1, 0.005), (2, 0.0025), (3, 0.00125)], ids=["1cm", "5mm", "2.5mm", "1.25mm"]
)
def test_resolutions(resolution: int, unit_m: float) -> None:
    parameters = changed(default_parameters(), 42, 0b01010101 * resolution)
    ((_, data),) = OnCan(board({9: 1.0, 10: 3.9}, parameters)).ask(bytes((13, 0b100)))
    raw = bytes.fromhex(data)
    assert raw[1] == 0xF0 | resolution << 2 | 2
    assert raw[2] | (raw[6] & 15) << 8 == round(1.0 / unit_m)
    assert raw[3] | raw[6] >> 4 << 8 == round(3.9 / unit_m)


def test_inactive_channel_reads_as_not_connected() -> None:
    one = OnCan(board({1: 1.0, 2: 1.0, 9: 1.0}))
    one.ask(bytes((1, 0b11111101, 0b11111110)))
    assert one.ask(bytes((13, 0b101))) == [(0x40D, "0DF4C80000000000"), (0x40F, "0DF6000000000000")]


def test_long_distance_in_the_short_format() -> None:
    assert OnCan(board({1: 3.5})).ask(bytes((2,)))[0] == (0x402, "0200FF0000000000")


@pytest.mark.parametrize(
    "message", [b"", bytes((9, 9)), bytes((255,) * 8), bytes((4, 9, 1, 2, 3, 4, 5, 6)), bytes((13, 0))]
)
def test_nonsense_is_not_answered(message: bytes) -> None:
    assert OnCan(board({1: 1.0})).ask(message) == []


def test_foreign_and_remote_frames_are_not_answered() -> None:
    one = OnCan(board({1: 1.0}))
    frames = [Frame(0x401, bytes(8)), Frame(0x400, b"\0", extended=True), Frame(0x400, remote=True, dlc=8)]
    assert one.can.step(one.now_ns, frames) == []


def test_v1_board_knows_only_short_data() -> None:
    one = OnCan(board({1: 0.3}, default_parameters(hardware=0)))
    assert one.ask(bytes((13, 15))) == []
    assert one.ask(bytes((2,)))[0] == (0x402, "02001E0000000000")


def test_v1_board_sends_all_four_groups_whatever_the_mask_of_newer_boards() -> None:
    """The maker's node for it (neo_usboard, on CAN) writes 1, "on CAN", into byte 6 and waits for all four messages."""
    one = OnCan(board({1: 0.3, 16: 0.5}, changed(default_parameters(hardware=0), 6, 0x01)))
    one.now_ns += 600 * MS
    assert [frame.can_id for frame in one.can.step(one.now_ns, [])] == [0x402, 0x403, 0x404, 0x405]


def test_board_is_deaf_while_it_boots() -> None:
    can = UsBoardCan(board({}))
    assert can.step(5 * SECOND, [Frame(0x400, b"\0")]) == []
    assert can.step(5 * SECOND + 251 * MS, [Frame(0x400, b"\0")]) != []


# -- parameters -------------------------------------------------------------------------------------------------------


def write(one: OnCan, command: int, parameters: bytes, seconds: float = 0.0) -> list[tuple[int, str]]:
    answers = []
    for part in range(9):
        answers += one.ask(bytes((command, part)) + parameters[6 * part : 6 * part + 6], seconds)
    return answers


def test_written_parameters_are_acknowledged_with_their_sum_and_hold() -> None:
    one = OnCan(board({1: 1.0}))
    wanted = changed(default_parameters(0x420), 42, 0)
    answers = write(one, 4, wanted)
    total = sum(wanted[:48])
    assert answers[:8] == [(0x408, "0400000000000000")] * 8
    assert answers[8] == (0x408, bytes((4, total & 255, total >> 8)).ljust(8, b"\0").hex().upper())
    assert one.board.base_id == 0x420
    assert one.ask(bytes((13, 1))) == [(0x42D, "0DF0640000000000")]
    one.can.power_on(one.now_ns)
    assert one.board.base_id == 0x400


def test_stored_parameters_survive_and_version_and_serial_number_are_the_boards_own() -> None:
    one = OnCan(board({}))
    wanted = changed(changed(default_parameters(0x430), 47, 64), 49, 99, 1, 2, 3, 4)
    answers = write(one, 5, wanted, 0.03)
    assert len(answers) == 9
    assert answers[0] == (0x409, "0500000000000000")
    one.can.power_on(one.now_ns)
    one.wait(0.3)
    frames = one.ask(bytes((6,)))
    assert frames[0] == (0x436, "0600003004000000")
    assert frames[7][1].endswith("40")
    assert frames[8][1] == "0608001539300000"


def test_extended_ids() -> None:
    parameters = changed(changed(default_parameters(0x12345), 5, 1), 3, 1)
    one = UsBoardCan(board({}, parameters))
    one.step(0, [])
    (answer,) = one.step(SECOND, [Frame(0x12345, b"\0", extended=True)])
    assert answer.extended
    assert answer.can_id == 0x12346


# -- firing -----------------------------------------------------------------------------------------------------------


def test_groups_fire_in_parallel_their_members_in_turn() -> None:
    one = board(dict.fromkeys(range(1, 17), 1.0), changed(default_parameters(), 45, 0x21, 0x43))
    one.power_on(0)
    firings: dict[int, list[int]] = {}
    for at_ns, transducer in one.firings(0, SECOND):
        firings.setdefault(round(transducer.mount.x_m), []).append(at_ns // MS)
    for group, interval_ms in enumerate((20, 30, 40, 50)):
        for place in range(4):
            times = firings[4 * group + place + 1]
            assert times[:2] == [place * interval_ms, (4 + place) * interval_ms]


def test_answer_holds_the_last_completed_firing() -> None:
    one = OnCan(board({1: 1.0, 4: 1.0}))
    walls = one.board.scene
    assert isinstance(walls, Walls)
    walls.asked.clear()
    one.wait(0.033)
    one.ask(bytes((13, 1)))
    fired = dict(walls.asked)
    since_ns = {channel: one.now_ns - at_ns for channel, at_ns in fired.items()}
    assert all(20 * MS <= ago < 100 * MS for ago in since_ns.values())
    assert (fired[4] - fired[1]) % (80 * MS) == 60 * MS


def test_cross_echo_group_has_one_sender() -> None:
    parameters = changed(default_parameters(), 43, 0b0001, 0b10)
    one = OnCan(board({1: 1.0, 2: 1.2, 3: 1.1, 4: inf}, parameters))
    ((_, data),) = one.ask(bytes((13, 1)))
    raw = bytes.fromhex(data)
    assert raw[1] >> 4 == 1 << 2
    assert list(raw[2:6]) == [210, 230, 220, 2]
    assert {round(source.mount.x_m) for _, source in one.board.firings(one.now_ns, one.now_ns + SECOND)} == {3}


def test_low_pass_filter_follows_slowly() -> None:
    one = OnCan(board({1: 1.0}, changed(default_parameters(), 47, 32)))
    one.ask(bytes((13, 1)))
    one.board.scene.range_m[1] = 2.0  # type: ignore[attr-defined]
    values = []
    for _ in range(20):
        one.wait(0.08)
        values.append(int(one.ask(bytes((13, 1)))[0][1][4:6], 16) + 256 * int(one.ask(bytes((13, 1)))[0][1][13], 16))
    assert values == sorted(values)
    assert 200 < values[0] < 300
    assert values[-1] == pytest.approx(400, abs=5)


@pytest.mark.parametrize(
    ("kind", "custom", "period_s"), [(0, 0, 0.5), (1, 0, 1.0), (2, 0, 2.0), (3, 0, 0.2), (15, 1, 0.1)]
)
def test_automatic_sending(kind: int, custom: int, period_s: float) -> None:
    parameters = changed(default_parameters(), 6, 0b0101_0001, custom << 4 | kind)
    one = OnCan(board({1: 1.0}, parameters))
    frames = one.wait(4.0, 0.01)
    assert {can_id for can_id, _ in frames} == {0x40D, 0x40F}
    assert len(frames) == 2 * round(4.0 / period_s)


def test_automatic_sending_in_the_legacy_format() -> None:
    parameters = changed(default_parameters(), 5, 8, 0b0110_0011, 3)
    one = OnCan(board({5: 1.0}, parameters))
    assert {can_id for can_id, _ in one.wait(0.4)} == {0x403, 0x404}


def test_serial_only_sending_leaves_the_bus_alone() -> None:
    one = OnCan(board({1: 1.0}, changed(default_parameters(), 6, 0xF2, 3)))
    assert one.wait(1.0) == []


# -- what goes wrong --------------------------------------------------------------------------------------------------


def test_cold_air_makes_things_look_farther() -> None:
    one = OnCan(board({1: 2.0}, air_temp_c=-10.0))
    raw = int(one.ask(bytes((13, 1)))[0][1][4:6], 16) + 256
    assert raw * 0.005 == pytest.approx(2.0 * 343.4 / speed_of_sound(-10.0), abs=0.005)
    assert speed_of_sound(20.0) == pytest.approx(343.4, abs=0.1)


def test_cross_talk_needs_overlapping_cones_and_the_right_moment() -> None:
    def heard(other_yaw_rad: float, late_ns: int) -> float:
        wall = Walls({1: 3.0})
        listener = UsBoard(wall, {1: Transducer(Mount(x_m=1))}, noise_m=0.0)
        other = UsBoard(wall, {1: Transducer(Mount(x_m=1, yaw_rad=other_yaw_rad))}, noise_m=0.0)
        listener.power_on(0)
        other.power_on(late_ns)
        listener.hears = [other]
        frame = UsBoardCan(listener)
        (answer,) = frame.step(SECOND, [Frame(0x400, bytes((13, 1)))])
        return (answer.data[2] | (answer.data[6] & 15) << 8) * 0.005

    assert heard(0.0, -10 * MS) == pytest.approx(3.0 - 0.01 * 343.4 / 2, abs=0.01)
    assert heard(0.0, 10 * MS) == pytest.approx(3.0, abs=0.01)
    assert heard(radians(90), -10 * MS) == pytest.approx(3.0, abs=0.01)


def test_noise_has_the_given_size() -> None:
    one = OnCan(board({1: 2.0}, changed(default_parameters(), 42, 0xFF), noise_m=0.02, seed=3))
    values = []
    for _ in range(200):
        one.wait(0.08, 0.08)
        raw = bytes.fromhex(one.ask(bytes((13, 1)))[0][1])
        values.append((raw[2] | (raw[6] & 15) << 8) * 0.00125)
    mean_m = sum(values) / len(values)
    assert mean_m == pytest.approx(2.0, abs=0.006)
    assert (sum((value - mean_m) ** 2 for value in values) / len(values)) ** 0.5 == pytest.approx(0.02, rel=0.2)


def test_two_boards_side_by_side() -> None:
    boards = [board_with(base, Walls({1: 1.0}), transducers(1)) for base in (0x400, 0x420)]
    for one in boards:
        one.step(0, [])
    answers = [frame.can_id for one in boards for frame in one.step(SECOND, [Frame(0x420, b"\0")])]
    assert answers == [0x421]


def test_faulty_construction_is_refused() -> None:
    with pytest.raises(ValueError, match="channels"):
        UsBoard(Walls({}), transducers(17))
    with pytest.raises(ValueError, match="54"):
        UsBoard(Walls({}), {}, parameters=bytes(53))


def test_packing_of_the_published_analog_frame() -> None:
    assert bytes(packed_12bit((291, 1110, 1929, 2748))).hex() == "235689bc41a7"
