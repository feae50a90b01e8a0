"""The USBoard driver against the maker's vectors and a scripted board; the test owns the clock."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest

from drivers.conversation import CanFrame
from drivers.errors import FrameError
from drivers.readings import ChainReading, ContactReading, ContactState, LinkState, RangeReading, RangeStatus, Reading
from drivers.sonar_usboard import UsBoardConversation, UsBoardSerialConversation
from drivers.usboard_messages import (
    Command,
    SendMode,
    UsBoardParameters,
    decode_analog,
    decode_group,
    decode_parameters,
    decode_part,
    encode_command,
    encode_get_data,
    encode_parameter_write,
    encode_parameters,
    encode_serial_frame,
    encode_set_active,
    offset_of,
    parameter_sum,
    write_accepted,
)

MS = 1_000_000
CONNECT_ANSWER = bytes.fromhex("0001020304050607")
PARAMETER_VECTOR = [  # hardware version 21, serial number 12345, all else as delivered
    "0600000004000000",
    "0601F000FFFF6464",
    "0602646464646464",
    "0603646464646464",
    "060464641E1E1E1E",
    "06051E1E1E1E1E1E",
    "06061E1E1E1E1E1E",
    "0607550000111180",
    "0608001539300000",
]
SERIAL_VECTORS = [
    ("FF 00 01 02 03 04 05 06 07 04 0F", "0001020304050607"),
    ("FF 02 00 1E 23 28 2D 00 00 83 04", "02001E23282D0000"),
    ("FF 02 01 32 37 3C 41 00 00 6E D6", "020132373C410000"),
    ("FF 03 00 46 4B 50 55 00 00 6C C3", "0300464B50550000"),
    ("FF 03 01 5A 5F 64 69 00 00 97 32", "03015A5F64690000"),
    ("FF 07 23 56 89 BC 41 A7 00 31 7C", "07235689BC41A700"),
    ("FF 0D F4 3C 46 50 5A 00 00 3C 14", "0DF43C46505A0000"),
]


def can(text: str) -> CanFrame:
    can_id, data = text.split("#")
    return CanFrame(int(can_id, 16), bytes.fromhex(data))


def ranges_of(readings: Iterable[Reading]) -> list[RangeReading]:
    return [each for reading in readings if isinstance(reading, ChainReading) for each in reading.ranges]


def echoes_cm(readings: Iterable[Reading]) -> dict[int, float]:
    return {each.channel: each.range_m * 100 for each in ranges_of(readings)}


def state_of(conversation: UsBoardConversation) -> LinkState:
    return conversation.state  # through a call, because a type checker believes that it never changes


class ScriptedBoard:
    """Answers as a USBoard does; `deaf_to` makes it leave commands unanswered."""

    def __init__(self, parameters: UsBoardParameters | None = None, base_id: int = 0x400) -> None:
        self.block = encode_parameters(
            parameters if parameters is not None else UsBoardParameters(hardware_version=21, serial_number=12345)
        )
        self.base_id = base_id
        self.deaf_to: set[int] = set()
        self.dead_groups: set[int] = set()
        self.heard: list[int] = []
        self.raw = 200
        self.inputs = [0, 4095, 2048, 0]

    def answer(self, message: bytes) -> list[bytes]:
        command = message[0]
        self.heard.append(command)
        if command in self.deaf_to:
            return []
        if command == 0:
            return [CONNECT_ANSWER]
        if command == 6:
            return [bytes((6, i)) + self.block[6 * i : 6 * i + 6] for i in range(9)]
        if command == 13:
            return [self.group(g) for g in range(4) if message[1] >> g & 1 and g not in self.dead_groups]
        if command == 7:
            nibbles = [value >> 8 for value in self.inputs]
            return [bytes((7, *(v & 0xFF for v in self.inputs), nibbles[0] | nibbles[1] << 4,
                           nibbles[2] | nibbles[3] << 4, 0))]  # fmt: skip
        if command in (2, 3):
            return [bytes((command, part, 30, 40, 50, 60, 0, 0)) for part in (0, 1)]
        return []

    def group(self, group: int) -> bytes:
        return bytes((13, 0xF4 | group, *[self.raw] * 4, 0, 0))

    def on_can(self, frame: CanFrame) -> list[CanFrame]:
        if frame.can_id != self.base_id:
            return []
        return [CanFrame(self.base_id + (offset_of(m) or 0), m) for m in self.answer(frame.data)]


def converse(
    conversation: UsBoardConversation, board: ScriptedBoard | None, start_ns: int, stop_ns: int
) -> list[Reading]:
    """Both talk over a perfect bus, in steps of 5 ms."""
    readings: list[Reading] = []
    for now_ns in range(start_ns, stop_ns, 5 * MS):
        for frame in conversation.requests(now_ns):
            assert isinstance(frame, CanFrame)
            for answer in board.on_can(frame) if board is not None else []:
                readings += conversation.receive(answer, now_ns + MS)
    return readings


# ---- messages


def test_data_vectors_in_centimetres() -> None:
    values = {}
    for text in ("02001E23282D0000", "020132373C410000", "0300464B50550000", "03015A5F64690000"):
        part = decode_part(bytes.fromhex(text))
        for index, value in enumerate(part.values):
            values[part.first_channel + index] = round(value * part.resolution_m * 100)
    assert values == {channel: 25 + 5 * channel for channel in range(1, 17)}


def test_group_vectors() -> None:
    first = decode_group(bytes.fromhex("0DF43C46505A0000"))
    assert (first.first_channel, first.fired_by, first.resolution_m) == (1, None, 0.005)
    assert [value * first.resolution_m for value in first.values] == pytest.approx([0.30, 0.35, 0.40, 0.45])
    second = decode_group(bytes.fromhex("0DF5646E78820000"))
    assert second.first_channel == 5
    assert [value * second.resolution_m for value in second.values] == pytest.approx([0.5, 0.55, 0.6, 0.65])


def test_group_high_nibbles_and_resolutions() -> None:
    group = decode_group(bytes.fromhex("0DFE010203042143"))
    assert group.values == (0x101, 0x202, 0x303, 0x404)
    assert group.first_channel == 9
    assert group.resolution_m == 0.00125


def test_cross_echo_names_the_one_that_fired() -> None:
    assert [decode_group(bytes((13, nibble << 4 | 1, 9, 9, 9, 9, 0, 0))).fired_by for nibble in (1, 2, 4, 8)] == [
        5,
        6,
        7,
        8,
    ]


@pytest.mark.parametrize("nibble", [0, 3, 5, 6, 7, 9, 10, 11, 12, 13, 14])
def test_nobody_or_several_fired_is_refused(nibble: int) -> None:
    with pytest.raises(FrameError, match="bad_info"):
        decode_group(bytes((13, nibble << 4, 9, 9, 9, 9, 0, 0)))


def test_analog_vector() -> None:
    volts = decode_analog(bytes.fromhex("07235689BC41A700"))
    assert [round(volt * 4095 / 5) for volt in volts] == [291, 1110, 1929, 2748]


@pytest.mark.parametrize(("frame", "message"), SERIAL_VECTORS)
def test_serial_vectors(frame: str, message: str) -> None:
    assert encode_serial_frame(bytes.fromhex(message)) == bytes.fromhex(frame)


def test_commands() -> None:
    assert encode_command(Command.CONNECT) == bytes(8)
    assert encode_get_data([0, 2]) == bytes.fromhex("0D05000000000000")
    assert encode_set_active([1, 2, 3, 4, 5, 16]) == bytes.fromhex("011F800000000000")


# ---- parameters


def test_parameter_vector() -> None:
    block = b"".join(bytes.fromhex(part)[2:] for part in PARAMETER_VECTOR)
    parameters = decode_parameters(block)
    assert parameters == UsBoardParameters(hardware_version=21, serial_number=12345)
    assert encode_parameters(parameters) == block


def test_parameter_write_and_its_sum() -> None:
    parameters = UsBoardParameters(hardware_version=21, serial_number=12345, send_mode=SendMode.ON_CAN, interval_s=0.1)
    messages = encode_parameter_write(parameters, to_eeprom=False)
    assert [message[:2] for message in messages] == [bytes((4, part)) for part in range(9)]
    assert messages[1] == bytes.fromhex("0401F11FFFFF6464")
    block = encode_parameters(parameters)
    total = parameter_sum(block)
    assert total == sum(sum(message[2:]) for message in messages[:-1])
    assert write_accepted(bytes.fromhex("0400000000000000"), block, last=False)
    assert write_accepted(bytes((4, total & 255, total >> 8, 0, 0, 0, 0, 0)), block, last=True)
    assert not write_accepted(bytes((4, total + 1 & 255, total >> 8, 0, 0, 0, 0, 0)), block, last=True)
    assert encode_parameter_write(parameters, to_eeprom=True)[0][0] == 5


@pytest.mark.parametrize(
    "wrong",
    [
        {"interval_s": 0.33},
        {"interval_s": 3.0},
        {"can_rate_bps": 800_000},
        {"warning_cm": (100,) * 15},
        {"alarm_cm": (256,) * 16},
        {"resolution_m": (0.005,) * 3},
        {"fire_interval_s": (0.2,) * 4},
        {"active": 1 << 16},
        {"base_id": -1},
    ],
)
def test_parameters_that_cannot_be_expressed(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        encode_parameters(UsBoardParameters(**wrong))  # type: ignore[arg-type]


@pytest.mark.parametrize(("offset", "value"), [(0, 6), (6, 4), (7, 4)])
def test_parameters_that_make_no_sense(offset: int, value: int) -> None:
    block = bytearray(encode_parameters(UsBoardParameters()))
    block[offset] = value
    with pytest.raises(FrameError, match="bad_parameters"):
        decode_parameters(bytes(block))


# ---- what values mean


def test_near_none_unconnected_and_echo_are_told_apart() -> None:
    conversation = UsBoardConversation()
    conversation.connected(0)
    found = ranges_of(conversation.receive(can("410#0DF7000102D20000"), 1_000 * MS))
    assert [(each.channel, each.status) for each in found] == [
        (13, RangeStatus.NOT_LOOKED),
        (14, RangeStatus.TOO_CLOSE),
        (15, RangeStatus.NO_RETURN),
        (16, RangeStatus.ECHO),
    ]
    assert math.isnan(found[0].range_m)
    assert found[1].range_m == -math.inf
    assert found[2].range_m == math.inf
    assert found[3].range_m == pytest.approx(1.05)
    assert all(each.heard_from is None for each in found)


def test_cross_echo_frees_nothing() -> None:
    """Group 0, channel 2 fired: 1 has an echo of it, 2 its own, 3 heard nothing, 4 is too close."""
    conversation = UsBoardConversation()
    conversation.connected(0)
    found = ranges_of(conversation.receive(can("40D#0D243C4602010000"), 1_000 * MS))
    assert [(each.channel, each.status, each.heard_from) for each in found] == [
        (1, RangeStatus.ECHO, 2),
        (2, RangeStatus.ECHO, None),
        (4, RangeStatus.TOO_CLOSE, 2),
    ]


def test_a_value_beyond_the_transducers_reach_is_invalid_not_far() -> None:
    conversation = UsBoardConversation(range_max_m=6.0)
    found = ranges_of(conversation.receive(can("40D#0DF0FF5900002000"), 1_000 * MS))  # 255 and 601 cm
    assert found[0].status is RangeStatus.ECHO
    assert found[1].status is RangeStatus.INVALID
    assert conversation.counters.drops == {"range_implausible": 1}


def test_a_channel_switched_off_never_reports_free() -> None:
    board = ScriptedBoard(UsBoardParameters(hardware_version=21, active=0xFFFE))
    board.raw = 2
    conversation = UsBoardConversation(channels=[1, 2])
    conversation.connected(0)
    found = ranges_of(converse(conversation, board, 0, 300 * MS))
    assert {each.status for each in found if each.channel == 1} == {RangeStatus.NOT_LOOKED}
    assert {each.status for each in found if each.channel == 2} == {RangeStatus.NO_RETURN}
    assert conversation.trouble is not None
    assert "1 are switched off" in conversation.trouble


# ---- conversation on CAN


def test_set_up_then_ten_readings_a_second_of_every_group() -> None:
    board = ScriptedBoard()
    conversation = UsBoardConversation()
    conversation.connected(0)
    assert state_of(conversation) is LinkState.SILENT
    readings = converse(conversation, board, 0, 1_050 * MS)
    assert state_of(conversation) is LinkState.RUNNING
    assert conversation.trouble is None
    identity = conversation.identity
    assert identity is not None
    assert (identity.model, identity.serial, identity.firmware) == ("USBoard-USS5", "12345", "hardware 21")
    assert board.heard[:2] == [0, 6]
    assert board.heard.count(13) == 11
    assert len(readings) == 4 * 11
    assert set(echoes_cm(readings).values()) == {100.0}
    assert conversation.counters.drops == {}
    stamps = [reading.stamp_ns for reading in readings]
    assert stamps == sorted(set(stamps)), "strictly rising, also within one batch"
    assert stamps[0] == pytest.approx(6 * MS - 80 * MS, abs=6 * MS), "one round of four at 20 ms before arrival"


def test_only_the_groups_in_use_are_asked() -> None:
    board = ScriptedBoard()
    conversation = UsBoardConversation(channels=[5, 6, 12])
    conversation.connected(0)
    readings = converse(conversation, board, 0, 500 * MS)
    assert set(echoes_cm(readings)) == {5, 6, 12}


def test_as_fast_as_it_fires() -> None:
    board = ScriptedBoard(UsBoardParameters(hardware_version=21, active=0x000F, fire_interval_s=(0.01,) * 4))
    conversation = UsBoardConversation(channels=[1, 2], rate_hz=None)
    conversation.connected(0)
    converse(conversation, board, 0, 1_010 * MS)
    assert board.heard.count(13) == pytest.approx(25, abs=1)  # 4 x 10 ms a round
    assert conversation.silence_limit_ns == 120 * MS


def contacts_of(readings: Iterable[Reading]) -> list[dict[int, ContactState]]:
    return [{each.line: each.state for each in r.lines} for r in readings if isinstance(r, ContactReading)]


def test_switches_at_the_inputs() -> None:
    """Low, high, and what is neither: a line that is torn half-way is not believed."""
    board = ScriptedBoard()
    conversation = UsBoardConversation(
        channels=[1], switches={0: False, 1: False, 2: False, 3: True}, analog_rate_hz=20.0
    )
    conversation.connected(0)
    readings = converse(conversation, board, 0, 1_000 * MS)
    told = contacts_of(readings)
    clear, tripped, unknown = ContactState.CLEAR, ContactState.TRIPPED, ContactState.UNKNOWN
    assert told[-1] == {0: clear, 1: tripped, 2: unknown, 3: tripped}
    assert len(told) == pytest.approx(20, abs=2)
    assert conversation.counters.drops == {"between_levels": len(told)}
    assert set(echoes_cm(readings)) == {1}
    assert conversation.silence_limit_of(ContactReading) == 150 * MS
    stamps = [r.stamp_ns for r in readings if isinstance(r, ContactReading)]
    assert stamps == sorted(set(stamps))


def test_a_board_of_switches_alone_is_not_asked_for_ranges() -> None:
    board = ScriptedBoard()
    conversation = UsBoardConversation(switches={1: True}, analog_rate_hz=20.0, measures=False)
    conversation.connected(0)
    readings = converse(conversation, board, 0, 3_000 * MS)
    assert contacts_of(readings)[-1] == {1: ContactState.CLEAR}
    assert not ranges_of(readings)
    assert set(board.heard) == {0, 6, 7}
    assert state_of(conversation) is LinkState.RUNNING
    assert conversation.counters.drops == {}


def test_inputs_that_the_board_keeps_to_itself_are_named() -> None:
    board = ScriptedBoard()
    board.deaf_to = {7}
    conversation = UsBoardConversation(channels=[1], switches={0: False}, analog_rate_hz=20.0)
    conversation.connected(0)
    assert contacts_of(converse(conversation, board, 0, 1_000 * MS)) == []
    assert "byte 5, bit 2" in (conversation.trouble_of(ContactReading) or "")
    assert conversation.trouble_of(ChainReading) is None
    with pytest.raises(ValueError, match="inputs 0 to 3"):
        UsBoardConversation(switches={4: False})


def test_connect_is_repeated_until_answered_without_end() -> None:
    conversation = UsBoardConversation()
    conversation.connected(0)
    sent = [frame for now in range(0, 10_000 * MS, 20 * MS) for frame in conversation.requests(now)]
    assert len(sent) == pytest.approx(39, abs=2)
    assert all(frame == CanFrame(0x400, bytes(8)) for frame in sent)
    assert state_of(conversation) is LinkState.SILENT
    assert "400h" in (conversation.trouble or "")


def test_a_board_that_keeps_its_parameters_secret_is_measured_all_the_same() -> None:
    board = ScriptedBoard()
    board.deaf_to = {6}
    conversation = UsBoardConversation()
    conversation.connected(0)
    assert converse(conversation, board, 0, 2_000 * MS)
    assert conversation.identity is None
    board.deaf_to = set()
    converse(conversation, board, 2_000 * MS, 9_000 * MS)
    assert conversation.identity is not None, "it is asked again now and then"


def test_old_board_is_asked_the_old_way() -> None:
    board = ScriptedBoard(UsBoardParameters(hardware_version=0, serial_number=7))
    board.deaf_to = {13}
    conversation = UsBoardConversation()
    conversation.connected(0)
    readings = converse(conversation, board, 0, 500 * MS)
    assert 13 not in board.heard
    assert set(echoes_cm(readings)) == set(range(1, 17))
    assert echoes_cm(readings)[1] == pytest.approx(30.0)
    assert conversation.identity is not None
    assert conversation.identity.model == "USBoard V1"


def test_old_board_without_parameters_is_found_out() -> None:
    board = ScriptedBoard()
    board.deaf_to = {6, 13}
    conversation = UsBoardConversation(channels=[1])
    conversation.connected(0)
    readings = converse(conversation, board, 0, 3_000 * MS)
    assert set(echoes_cm(readings)) == {1}
    assert conversation.counters.drops["unanswered"] >= 3


def test_a_board_that_sends_by_itself_is_listened_to() -> None:
    parameters = UsBoardParameters(hardware_version=21, send_mode=SendMode.ON_CAN, interval_s=0.1)
    board = ScriptedBoard(parameters)
    conversation = UsBoardConversation()
    conversation.connected(0)
    readings = []
    for now in range(0, 2_000 * MS, 100 * MS):
        readings += converse(conversation, board, now, now + 100 * MS)
        for group in range(4):
            readings += conversation.receive(CanFrame(0x40D + group, board.group(group)), now)
    assert 13 not in board.heard
    assert len(readings) == 4 * 20
    assert conversation.silence_limit_ns == 300 * MS


@pytest.mark.parametrize(
    "parameters",
    [
        UsBoardParameters(hardware_version=21, send_mode=SendMode.ON_CAN, interval_s=0.5),
        UsBoardParameters(hardware_version=21, send_mode=SendMode.ON_SERIAL, interval_s=0.1),
        UsBoardParameters(hardware_version=21, send_mode=SendMode.ON_CAN, interval_s=0.1, send_groups=0x3),
        UsBoardParameters(hardware_version=21, send_mode=SendMode.ON_CAN, interval_s=0.1, legacy_format=True),
    ],
)
def test_a_board_that_sends_too_little_is_asked(parameters: UsBoardParameters) -> None:
    board = ScriptedBoard(parameters)
    conversation = UsBoardConversation()
    conversation.connected(0)
    assert converse(conversation, board, 0, 500 * MS)
    assert 13 in board.heard


def test_a_board_that_only_says_that_it_sends_is_asked_after_a_second() -> None:
    board = ScriptedBoard(UsBoardParameters(hardware_version=21, send_mode=SendMode.ON_CAN, interval_s=0.1))
    conversation = UsBoardConversation()
    conversation.connected(0)
    assert not converse(conversation, board, 0, 900 * MS)
    assert converse(conversation, board, 900 * MS, 1_500 * MS)


def test_listening_never_asks_for_data_and_complains_of_a_slow_board() -> None:
    board = ScriptedBoard(UsBoardParameters(hardware_version=21, send_mode=SendMode.ON_CAN, interval_s=0.5))
    conversation = UsBoardConversation(mode="listen")
    conversation.connected(0)
    converse(conversation, board, 0, 1_000 * MS)
    assert 13 not in board.heard
    assert list(conversation.receive(CanFrame(0x40D, board.group(0)), 1_000 * MS))
    assert "150 ms" in (conversation.trouble or "")
    assert conversation.silence_limit_ns == 750 * MS, "or each pause would look like a loss"


def test_cut_values_of_the_old_format_never_say_free() -> None:
    """A USS5 that sends the old format cuts 258 units to 2: that may be a wall 2.58 m away."""
    board = ScriptedBoard(
        UsBoardParameters(hardware_version=21, send_mode=SendMode.ON_CAN, interval_s=0.1, legacy_format=True)
    )
    conversation = UsBoardConversation(mode="listen")
    conversation.connected(0)
    converse(conversation, board, 0, 100 * MS)
    found = ranges_of(conversation.receive(can("402#0200020202020000"), 100 * MS))
    assert {each.status for each in found} == {RangeStatus.INVALID}


def test_a_group_that_falls_silent_goes_stale_while_others_go_on() -> None:
    board = ScriptedBoard()
    conversation = UsBoardConversation()
    conversation.connected(0)
    converse(conversation, board, 0, 500 * MS)
    board.dead_groups = {2}
    readings = converse(conversation, board, 500 * MS, 1_500 * MS)
    stale = [each for each in ranges_of(readings) if each.status is RangeStatus.STALE]
    assert [each.channel for each in stale] == [9, 10, 11, 12]
    assert "9 to 12" in (conversation.trouble or "")
    board.dead_groups = set()
    readings = converse(conversation, board, 1_500 * MS, 1_700 * MS)
    assert 9 in echoes_cm(readings)
    assert conversation.trouble is None


def test_a_pause_of_the_whole_board_makes_no_single_group_stale() -> None:
    board = ScriptedBoard()
    conversation = UsBoardConversation()
    conversation.connected(0)
    converse(conversation, board, 0, 500 * MS)
    converse(conversation, None, 500 * MS, 1_000 * MS)
    readings = converse(conversation, board, 1_000 * MS, 1_500 * MS)
    assert {each.status for each in ranges_of(readings)} == {RangeStatus.ECHO}


def test_two_boards_do_not_disturb_each_other() -> None:
    boards = [ScriptedBoard(base_id=0x400), ScriptedBoard(base_id=0x420)]
    boards[1].raw = 250
    conversations = [UsBoardConversation(0x400), UsBoardConversation(0x420)]
    readings: list[list[Reading]] = [[], []]
    for conversation in conversations:
        conversation.connected(0)
    for now in range(0, 1_000 * MS, 5 * MS):
        bus = [frame for conversation in conversations for frame in conversation.requests(now)]
        for frame in bus:
            assert isinstance(frame, CanFrame)
            for answer in boards[0].on_can(frame) + boards[1].on_can(frame):
                for index, conversation in enumerate(conversations):
                    readings[index] += conversation.receive(answer, now)
    assert set(echoes_cm(readings[0]).values()) == {100.0}
    assert set(echoes_cm(readings[1]).values()) == {125.0}
    assert all(conversation.counters.drops == {} for conversation in conversations)


def test_after_reopening_it_begins_with_connect() -> None:
    board = ScriptedBoard()
    conversation = UsBoardConversation()
    conversation.connected(0)
    converse(conversation, board, 0, 500 * MS)
    conversation.connected(600 * MS)
    assert state_of(conversation) is LinkState.SILENT
    assert conversation.requests(600 * MS) == [CanFrame(0x400, bytes(8))]


def test_a_board_lost_during_set_up_is_looked_for_again() -> None:
    board = ScriptedBoard()
    conversation = UsBoardConversation()
    conversation.connected(0)
    board.deaf_to = {6}
    converse(conversation, board, 0, 10 * MS)
    assert state_of(conversation) is LinkState.STARTING
    converse(conversation, None, 10 * MS, 3_000 * MS)
    assert state_of(conversation) is LinkState.SILENT


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (CanFrame(0x401, bytes(7)), "wrong_length"),
        (CanFrame(0x401, remote=True, dlc=8), "wrong_length"),
        (CanFrame(0x402, CONNECT_ANSWER), "id_mismatch"),
        (CanFrame(0x40E, bytes.fromhex("0DF43C46505A0000")), "id_mismatch"),
        (CanFrame(0x40A, bytes(8)), "id_mismatch"),
        (CanFrame(0x401, bytes(8)), "bad_connect"),
        (CanFrame(0x406, bytes.fromhex("0609000000000000")), "bad_parameters"),
        (CanFrame(0x40D, bytes.fromhex("0D043C46505A0000")), "bad_info"),
        (CanFrame(0x402, bytes.fromhex("02001E23282D0001")), "bad_part"),
    ],
)
def test_bad_frames_are_counted_and_change_nothing(frame: CanFrame, reason: str) -> None:
    conversation = UsBoardConversation()
    conversation.connected(0)
    assert list(conversation.receive(frame, MS)) == []
    assert conversation.counters.drops == {reason: 1}
    assert state_of(conversation) is LinkState.SILENT


def test_frames_of_others_are_not_even_counted() -> None:
    conversation = UsBoardConversation()
    for frame in (CanFrame(0x400, bytes(8)), CanFrame(0x411, bytes(8)), CanFrame(0x401, CONNECT_ANSWER, extended=True)):
        assert list(conversation.receive(frame, MS)) == []
    assert conversation.counters.chunks == 0


@pytest.mark.parametrize("bad", [{"channels": [0]}, {"channels": [17]}, {"channels": []}, {"rate_hz": 0.0}])
def test_impossible_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        UsBoardConversation(**bad)  # type: ignore[arg-type]


def test_analog_inputs_are_asked_when_wanted() -> None:
    conversation = UsBoardConversation(analog_rate_hz=20.0)
    board = ScriptedBoard()
    conversation.connected(0)
    converse(conversation, board, 0, 1_000 * MS)
    assert board.heard.count(7) == pytest.approx(20, abs=1)
    list(conversation.receive(can("407#07235689BC41A700"), 1_000 * MS))
    assert conversation.analog_v is not None
    assert conversation.analog_v[0] == pytest.approx(291 * 5 / 4095)


# ---- conversation on the serial line


def test_serial_set_up_and_readings() -> None:
    board = ScriptedBoard()
    conversation = UsBoardSerialConversation()
    conversation.connected(0)
    readings: list[Reading] = []
    for now in range(0, 1_000 * MS, 5 * MS):
        for message in conversation.requests(now):
            assert isinstance(message, bytes)
            assert len(message) == 8
            for answer in board.answer(message):
                readings += conversation.receive(encode_serial_frame(answer), now)
    assert set(echoes_cm(readings)) == set(range(1, 17))
    assert conversation.identity is not None
    assert conversation.counters.drops == {}


def test_serial_finds_its_feet_after_noise_and_loses_nothing_true() -> None:
    stream = b"".join(bytes.fromhex(frame) for frame, _ in SERIAL_VECTORS)
    conversation = UsBoardSerialConversation()
    found = echoes_cm(conversation.receive(b"\xff\x0d\xff\x00" + stream + b"\x00\xff\xff\x02" + stream, MS))
    assert found == pytest.approx({**{c: 25.0 + 5 * c for c in range(1, 17)}})
    assert conversation.counters.readings == 10
    assert conversation.counters.drops["bad_crc"] >= 1


def test_serial_byte_by_byte_equals_whole() -> None:
    stream = b"".join(bytes.fromhex(frame) for frame, _ in SERIAL_VECTORS)
    whole, single = UsBoardSerialConversation(), UsBoardSerialConversation()
    expected = list(whole.receive(stream, MS))
    got = [reading for byte in stream for reading in single.receive(bytes((byte,)), MS)]
    assert len(expected) == 5
    assert repr(got) == repr(expected)
