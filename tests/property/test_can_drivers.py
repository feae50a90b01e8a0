"""Properties of the CAN drivers: any split, any loss, any count; motion and free space are never made up."""

from __future__ import annotations

import math
from itertools import pairwise
from random import Random
from typing import ClassVar

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen_sdo import SdoClient, SdoDone, Upload
from drivers.conversation import CanFrame
from drivers.encoder_cia406 import Cia406PairConversation, Unwrapper
from drivers.errors import FrameError
from drivers.readings import ChainReading, RangeReading, RangeStatus, Reading, WheelReading, status_of_range
from drivers.slcan_bus import decode_line, encode_line
from drivers.sonar_usboard import UsBoardConversation, UsBoardSerialConversation
from drivers.usboard_messages import (
    SendMode,
    UsBoardParameters,
    decode_parameters,
    encode_parameter_write,
    encode_parameters,
    encode_serial_frame,
    parameter_sum,
)

MS = 1_000_000

messages = st.one_of(
    st.builds(
        lambda info, values: bytes((13, info)) + bytes(values),
        st.sampled_from([n << 4 | low for n in (1, 2, 4, 8, 15) for low in range(16)]),
        st.lists(st.integers(0, 255), min_size=6, max_size=6),
    ),
    st.builds(
        lambda command, part, values: bytes((command, part)) + bytes(values) + b"\0\0",
        st.sampled_from([2, 3]),
        st.integers(0, 1),
        st.lists(st.integers(0, 255), min_size=4, max_size=4),
    ),
    st.just(bytes(range(8))),
)

parameter_sets = st.builds(
    UsBoardParameters,
    can_rate_bps=st.sampled_from([1_000_000, 500_000, 250_000, 125_000, 100_000, 50_000]),
    base_id=st.integers(0, 0x7FF),
    extended_ids=st.booleans(),
    termination=st.booleans(),
    analog_inputs=st.booleans(),
    legacy_format=st.booleans(),
    invert_warn_relay=st.booleans(),
    invert_alarm_relay=st.booleans(),
    send_mode=st.sampled_from(SendMode),
    send_groups=st.integers(0, 15),
    interval_s=st.one_of(st.sampled_from([0.2, 0.5, 1.0, 2.0]), st.integers(1, 16).map(lambda n: round(n * 0.05, 2))),
    active=st.integers(0, 0xFFFF),
    warning_cm=st.tuples(*[st.integers(0, 255)] * 16),
    alarm_cm=st.tuples(*[st.integers(0, 255)] * 16),
    resolution_m=st.tuples(*[st.sampled_from([0.01, 0.005, 0.0025, 0.00125])] * 4),
    cross_echo=st.integers(0, 15),
    cross_echo_sender=st.tuples(*[st.integers(0, 3)] * 4),
    fire_interval_s=st.tuples(*[st.integers(1, 16).map(lambda n: n / 100)] * 4),
    low_pass_gain=st.integers(0, 255).map(lambda n: n / 128),
    hardware_version=st.sampled_from([0, 20, 21, 200, 201]),
    serial_number=st.integers(0, 2**32 - 1),
)


def ranges(readings: list[Reading]) -> list[RangeReading]:
    return [each for reading in readings if isinstance(reading, ChainReading) for each in reading.ranges]


# ---- USBoard


@given(parameter_sets)
def test_parameters_there_and_back(parameters: UsBoardParameters) -> None:
    block = encode_parameters(parameters)
    assert decode_parameters(block) == parameters
    parts = encode_parameter_write(parameters, to_eeprom=False)
    assert b"".join(part[2:] for part in parts) == block
    assert parameter_sum(block) < 1 << 16, "fits the answer"


@given(st.binary(min_size=54, max_size=54))
def test_parameters_from_any_bytes_are_refused_or_survive_a_round(block: bytes) -> None:
    try:
        parameters = decode_parameters(block)
    except FrameError:
        return
    if parameters.base_id < 1 << 29:
        assert decode_parameters(encode_parameters(parameters)) == parameters


@given(st.lists(messages, max_size=12), st.lists(st.integers(1, 30), min_size=1, max_size=20))
def test_any_split_of_the_serial_line_gives_the_same_readings(sent: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(encode_serial_frame(message) for message in sent)
    whole, pieces = UsBoardSerialConversation(), UsBoardSerialConversation()
    expected = list(whole.receive(stream, MS))
    got: list[Reading] = []
    at = index = 0
    while at < len(stream):
        size = cuts[index % len(cuts)]
        got += pieces.receive(stream[at : at + size], MS)
        at, index = at + size, index + 1
    assert repr(got) == repr(expected)
    assert whole.counters.drops == pieces.counters.drops


@given(st.lists(messages, min_size=1, max_size=8), st.binary(max_size=15))
def test_nothing_true_is_lost_behind_noise(sent: list[bytes], noise: bytes) -> None:
    """Noise can swallow at most what it overlaps: frames that follow it are all read (a CRC match in noise aside)."""
    clean, noisy = UsBoardSerialConversation(), UsBoardSerialConversation()
    stream = b"".join(encode_serial_frame(message) for message in sent)
    expected = repr([r.ranges for r in clean.receive(stream, MS) if isinstance(r, ChainReading)])
    got = [r.ranges for r in noisy.receive(noise + stream + bytes(11), MS) if isinstance(r, ChainReading)]
    assert repr(got) == expected


@given(st.lists(messages, max_size=20), st.integers(0, 0xFFFF))
def test_free_is_said_only_where_the_board_looked_and_saw_nothing(sent: list[bytes], active: int) -> None:
    conversation = UsBoardConversation()
    block = encode_parameters(UsBoardParameters(hardware_version=21, active=active))
    for part in range(9):
        frame = CanFrame(0x406, bytes((6, part)) + block[6 * part : 6 * part + 6])
        assert list(conversation.receive(frame, MS)) == []
    for message in sent:
        offset = 13 + (message[1] & 3) if message[0] == 13 else 2 * (message[0] - 1) + (message[1] & 1)
        for each in ranges(list(conversation.receive(CanFrame(0x400 + offset, message), MS))):
            if each.status in (RangeStatus.ECHO, RangeStatus.NO_RETURN, RangeStatus.TOO_CLOSE):
                assert status_of_range(each.range_m) is each.status
            else:
                assert math.isnan(each.range_m)
            if each.status is RangeStatus.NO_RETURN:
                assert each.heard_from is None
                assert active >> (each.channel - 1) & 1
                assert 2 in message[2:6]


# ---- SDO


@given(st.binary(min_size=1, max_size=300), st.integers(1, 7), st.booleans())
def test_upload_of_any_length_in_segments_of_any_size(value: bytes, size: int, told: bool) -> None:
    client = SdoClient(0x21)
    client.ask(Upload(0x1008), 0)
    client.requests(0)
    head = bytes((0x41 if told else 0x40,)) + b"\x08\x10\x00" + (len(value) if told else 0).to_bytes(4, "little")
    assert client.receive(head, 0) is None
    toggle, done = 0, None
    for at in range(0, len(value), size):
        [request], _ = client.requests(0)
        assert request.data == bytes((0x60 | toggle,)).ljust(8, b"\0")
        part = value[at : at + size]
        last = at + size >= len(value)
        done = client.receive(bytes((toggle | (7 - len(part)) << 1 | last,)) + part.ljust(7, b"\0"), 0)
        toggle ^= 0x10
    assert done == SdoDone(value)


# ---- counts


@given(
    st.sampled_from([16, 4096, 1 << 16, 1 << 25, 1 << 32, 1_000_003]),
    st.integers(0, 2**32 - 1),
    st.lists(st.floats(-0.49, 0.49), max_size=60),
)
def test_the_total_follows_the_wheel_through_every_wrap(range_ticks: int, start: int, moves: list[float]) -> None:
    """Moves are parts of the range; the shaft may do a fifth of it in a sample's time, so no wrap can hide."""
    unwrapper = Unwrapper(max_turns_per_s=200.0)
    unwrapper.configure(range_ticks, steps_per_turn=range_ticks)
    truth = start
    assert not unwrapper.advance(truth % range_ticks, 0)
    for index, move in enumerate(moves, start=1):
        truth += int(move * range_ticks)
        assert unwrapper.advance(truth % range_ticks, index * MS)
    assert unwrapper.total == truth - start


# ---- the pair: a bus that loses frames


class PerfectNode:
    """A node that answers every question with what makes the driver content, and SYNC with its position."""

    NUMBERS: ClassVar = {0x1000: 0x20196, 0x1017: 100, 0x6001: 4096, 0x1801: 1, 0x1A01: 0x60040020}

    def __init__(self, node: int, range_ticks: int) -> None:
        self.node, self.range_ticks, self.position, self.started = node, range_ticks, 0, False

    def answer(self, frame: CanFrame) -> list[CanFrame]:
        if frame.can_id == 0 and frame.data[1] == self.node:
            self.started = frame.data[0] == 1
        if frame.can_id == 0x80 and self.started:
            raw = self.position % self.range_ticks
            return [CanFrame(0x280 + self.node, raw.to_bytes(4, "little"))]
        if frame.can_id != 0x600 + self.node or frame.data[0] == 0x80:
            return []
        multiplexer, index = frame.data[1:4], int.from_bytes(frame.data[1:3], "little")
        value = self.range_ticks if index == 0x6002 else self.NUMBERS.get(index)
        if index == 0x1801 and frame.data[3] == 1:
            value = 0x280 + self.node
        if value is None:
            return [CanFrame(0x580 + self.node, b"\x80" + multiplexer + (0x06020000).to_bytes(4, "little"))]
        return [CanFrame(0x580 + self.node, b"\x43" + multiplexer + value.to_bytes(4, "little"))]

    def heartbeat(self) -> CanFrame:
        return CanFrame(0x700 + self.node, b"\x05" if self.started else b"\x7f")

    def reboot(self) -> CanFrame:
        self.started, self.position = False, 0
        return CanFrame(0x700 + self.node, b"\0")


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([1 << 16, 1 << 25]), st.sampled_from([0.0, 0.05, 0.4]))
def test_no_loss_and_no_reset_makes_motion_up(seed: int, range_ticks: int, loss: float) -> None:
    """Frames get lost both ways, nodes reboot: between continuous readings the counts are the truth's at the SYNCs that
    their stamps tell, however late it was proved that the answers were theirs."""
    random = Random(seed)
    nodes = [PerfectNode(0x20, range_ticks), PerfectNode(0x21, range_ticks)]
    pair = Cia406PairConversation(0x20, 0x21)
    pair.connected(0)
    travelled, reboots = [0, 0], 0
    readings: list[tuple[WheelReading, list[int], int]] = []
    at_sync: list[tuple[list[int], int]] = []  # of each step: what was travelled, and reboots so far
    for step in range(2400):
        now_ns = step * 2 * MS
        sent = [frame for frame in pair.requests(now_ns) if isinstance(frame, CanFrame)]
        at_sync.append((list(travelled), reboots))
        heard = [frame for frame in sent if random.random() >= loss]
        arriving = [answer for frame in heard for node in nodes for answer in node.answer(frame)]
        if step % 50 == 0:
            arriving += [node.heartbeat() for node in nodes]
        if random.random() < 0.003:
            arriving.append(random.choice(nodes).reboot())
            reboots += 1
        for frame in arriving:
            if random.random() < loss:
                continue
            for reading in pair.receive(frame, now_ns + MS):
                assert isinstance(reading, WheelReading)
                readings.append((reading, *at_sync[reading.stamp_ns // (2 * MS)]))
        for side, node in enumerate(nodes):
            move = random.randint(-60, 60)
            travelled[side] += move
            node.position += move
    assert len(readings) >= {0.0: 120, 0.05: 1, 0.4: 0}[loss]
    for (before, truth_before, reboots_before), (after, truth_after, reboots_after) in pairwise(readings):
        assert after.stamp_ns > before.stamp_ns
        moved = (after.left_ticks - before.left_ticks, after.right_ticks - before.right_ticks)
        if after.continuous and reboots_before == reboots_after:
            assert moved == tuple(b - a for a, b in zip(truth_before, truth_after))


# ---- slcan


can_frames = st.one_of(
    st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8)),
    st.builds(CanFrame, st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.just(True)),
    st.builds(lambda can_id, dlc: CanFrame(can_id, remote=True, dlc=dlc), st.integers(0, 0x7FF), st.integers(0, 8)),
)


@given(can_frames)
def test_lines_there_and_back(frame: CanFrame) -> None:
    dlc = frame.dlc if frame.dlc is not None else len(frame.data)
    line = encode_line(frame.can_id, frame.data, frame.extended, frame.remote, dlc)
    assert decode_line(line[:-1]) == frame


@given(st.one_of(st.binary(max_size=30), st.from_regex(rb"[tTrR][0-9A-Fa-f ]{0,30}", fullmatch=True)))
def test_any_line_is_a_valid_frame_or_none(line: bytes) -> None:
    frame = decode_line(line)
    if frame is None:
        return
    assert frame.can_id <= (0x1FFFFFFF if frame.extended else 0x7FF)
    dlc = frame.dlc if frame.dlc is not None else len(frame.data)
    again = encode_line(frame.can_id, frame.data, frame.extended, frame.remote, dlc)[:-1]
    assert line.upper().startswith(again.upper()), "says what the line said"
    assert len(line) - len(again) in (0, 4)
