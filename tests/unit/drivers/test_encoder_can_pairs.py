"""ODrive and VESC pairs on CAN: published frames, wraps, resets, both firmware generations."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.conversation import CanFrame
from drivers.encoder_odrive import (
    Command,
    ODrivePairConversation,
    can_id_of,
    decode_count,
    decode_estimates,
    decode_heartbeat,
)
from drivers.encoder_vesc import VescPairConversation, decode_speed, decode_tachometer
from drivers.encoder_vesc import can_id_of as vesc_id
from drivers.errors import FrameError
from drivers.readings import LinkState, Reading, WheelReading

MS = 1_000_000


def wheels_in(found: list[Reading]) -> list[WheelReading]:
    return [reading for reading in found if isinstance(reading, WheelReading)]


# ---- ODrive


def test_published_odrive_frames() -> None:
    assert can_id_of(0, Command.ESTIMATES) == 0x009
    assert decode_estimates(bytes.fromhex("0000C03F000080BE")) == (1.5, -0.25)
    heartbeat = decode_heartbeat(bytes.fromhex("0000000008000100"))
    assert (heartbeat.axis_error, heartbeat.state, heartbeat.flags) == (0, 8, b"\x00\x01\x00")
    assert decode_count(struct.pack("<ii", -5, 8187)) == (-5, 8187)
    with pytest.raises(FrameError):
        decode_count(b"\0" * 7)
    for bad in (math.nan, math.inf, 1e30):
        with pytest.raises(FrameError):
            decode_estimates(struct.pack("<ff", bad, 0.0))


class Axes:
    """Two axes by the protocol's table. generation 5 answers 0Ah; both send heartbeats and, if told, estimates."""

    def __init__(self, generation: int, *, cyclic_ms: int = 10, nodes: tuple[int, int] = (0, 1)) -> None:
        self.generation = generation
        self.cyclic_ms = cyclic_ms
        self.nodes = nodes
        self.turns = [0.0, 0.0]
        self.heartbeat = bytes.fromhex("0000000008000000")
        self.powered = True
        self.asked: list[CanFrame] = []

    def estimates(self, side: int) -> CanFrame:
        return CanFrame(self.nodes[side] << 5 | 9, struct.pack("<ff", self.turns[side], 0.0))

    def count(self, side: int) -> CanFrame:
        total = math.floor(self.turns[side] * 8192)
        wrapped = (total + 2**31) % 2**32 - 2**31
        return CanFrame(self.nodes[side] << 5 | 10, struct.pack("<ii", wrapped, total % 8192))

    def say(self, ms: int) -> list[CanFrame]:
        frames = []
        for side, node in enumerate(self.nodes):
            if ms % 100 == 3 + side:
                frames.append(CanFrame(node << 5 | 1, self.heartbeat))
            if self.cyclic_ms and ms % self.cyclic_ms == 4 * side:
                frames.append(self.estimates(side))
        return frames if self.powered else []

    def answer(self, frame: CanFrame) -> list[CanFrame]:
        self.asked.append(frame)
        assert frame.remote
        assert not frame.data
        if not self.powered:
            return []
        side, command = self.nodes.index(frame.can_id >> 5), frame.can_id & 31
        if command == 10 and self.generation == 5:
            return [self.count(side)]
        return [self.estimates(side)] if command == 9 else []


def run_axes(
    conversation: ODrivePairConversation,
    axes: Axes,
    *,
    from_ms: int = 0,
    for_ms: int = 1000,
    each_ms: Callable[[int], None] = lambda ms: None,
) -> list[WheelReading]:
    found: list[Reading] = []
    pending: list[CanFrame] = []
    for ms in range(from_ms, from_ms + for_ms):
        each_ms(ms)
        for frame in pending + axes.say(ms):
            found += conversation.receive(frame, ms * MS)
        pending = []
        for question in conversation.requests(ms * MS):
            assert isinstance(question, CanFrame)
            pending += axes.answer(question)
    return wheels_in(found)


@pytest.mark.parametrize(("generation", "cyclic_ms"), [(5, 10), (5, 0), (6, 10), (6, 0)])
def test_both_generations_count_the_same_motion(generation: int, cyclic_ms: int) -> None:
    conversation, axes = ODrivePairConversation(0, 1), Axes(generation, cyclic_ms=cyclic_ms)
    conversation.connected(0)

    def roll(ms: int) -> None:
        axes.turns = [100.0 + 0.002 * ms, -50.0 - 0.001 * ms]

    readings = run_axes(conversation, axes, for_ms=3000, each_ms=roll)
    assert conversation.state is LinkState.RUNNING
    assert len(readings) > 200
    assert [reading.continuous for reading in readings] == [False] + [True] * (len(readings) - 1)
    span_ms = (readings[-1].stamp_ns - readings[0].stamp_ns) / MS
    assert readings[-1].left_ticks == pytest.approx(0.002 * span_ms * 8192, abs=40)
    assert readings[-1].right_ticks == pytest.approx(-0.001 * span_ms * 8192, abs=40)
    assert conversation.identity is not None
    assert conversation.identity.firmware == f"0.{generation}.x"
    assert conversation.trouble is None
    assert conversation.counters.drops == {}


@pytest.mark.parametrize("generation", [5, 6])
def test_answers_of_axes_that_lay_waiting_for_us_were_sampled_as_soon_as_any(generation: int) -> None:
    """This program was held up for 80 ms behind its questions: what it read then is no later than usual."""
    conversation, axes = ODrivePairConversation(0, 1), Axes(generation, cyclic_ms=0)
    conversation.connected(0)
    run_axes(conversation, axes)
    ms, asked = 1000, [frame for frame in conversation.requests(1000 * MS) if isinstance(frame, CanFrame)]
    while not asked:
        ms += 1
        asked = [frame for frame in conversation.requests(ms * MS) if isinstance(frame, CanFrame)]
    answers = [answer for question in asked for answer in axes.answer(question)]
    readings = wheels_in([each for answer in answers for each in conversation.receive(answer, (ms + 80) * MS)])
    assert [ms * MS <= reading.stamp_ns <= (ms + 1) * MS for reading in readings] == [True]


def test_positions_that_come_by_themselves_are_not_asked_for() -> None:
    conversation, axes = ODrivePairConversation(0, 1, firmware="0.6"), Axes(6, cyclic_ms=10)
    conversation.connected(0)
    run_axes(conversation, axes, for_ms=500)
    axes.asked.clear()
    run_axes(conversation, axes, from_ms=500, for_ms=1000)
    assert axes.asked == []
    assert all(frame.can_id & 31 != 10 for frame in axes.asked)


def test_counts_of_odrive_wrap_both_ways() -> None:
    conversation, axes = ODrivePairConversation(3, 5), Axes(5, nodes=(3, 5))
    conversation.connected(0)

    def roll(ms: int) -> None:
        axes.turns = [(2**31 - 3000) / 8192 + 0.001 * ms, -(2**31) / 8192 + 0.3 - 0.001 * ms]

    readings = run_axes(conversation, axes, each_ms=roll)
    assert all(reading.continuous for reading in readings[1:])
    assert readings[-1].left_ticks > 7000
    assert readings[-1].right_ticks < -7000


@pytest.mark.parametrize("generation", [5, 6])
def test_an_odrive_that_boots_again_is_no_motion(generation: int) -> None:
    conversation, axes = ODrivePairConversation(0, 1), Axes(generation)
    conversation.connected(0)
    axes.turns = [12.0, 13.0]
    run_axes(conversation, axes, for_ms=800)
    axes.powered = False
    run_axes(conversation, axes, from_ms=800, for_ms=400)
    axes.powered, axes.turns = True, [0.0, 0.0]
    readings = run_axes(conversation, axes, from_ms=1200, for_ms=500)
    assert [reading.continuous for reading in readings[:2]] == [False, True]
    assert readings[-1].left_ticks == 0


def test_troubles_of_axes_are_told() -> None:
    conversation, axes = ODrivePairConversation(0, 1), Axes(5)
    conversation.connected(0)
    axes.heartbeat = bytes.fromhex("4000000001000100")
    run_axes(conversation, axes, for_ms=500)
    assert "00000040h" in (conversation.trouble or "")
    assert "encoder" in (conversation.trouble or "")
    axes.powered = False
    run_axes(conversation, axes, from_ms=500, for_ms=700)
    assert "node 0 (left wheel) is not heard" in (conversation.trouble or "")


def test_in_the_newer_heartbeat_trajectory_done_is_no_error() -> None:
    conversation, axes = ODrivePairConversation(0, 1), Axes(6)
    axes.heartbeat = bytes.fromhex("0000000008010100")  # procedure result 1, trajectory done
    conversation.connected(0)
    run_axes(conversation, axes)
    assert conversation.trouble is None


def test_a_position_too_far_from_zero_is_told() -> None:
    conversation, axes = ODrivePairConversation(0, 1), Axes(6)
    axes.turns = [10_000.0, 1.0]
    conversation.connected(0)
    run_axes(conversation, axes)
    assert "1/1024 turn" in (conversation.trouble or "")


# ---- VESC


def test_vesc_frames() -> None:
    assert vesc_id(27, 5) == 0x1B05
    assert decode_tachometer(struct.pack(">ihh", -123456, 243, 0)) == (-123456, 24.3)
    assert decode_tachometer(struct.pack(">ih", 7, 240)) == (7, 24.0)
    assert decode_speed(struct.pack(">ihh", 4200, -15, 250)) == (4200, -1.5, 0.25)
    for size in (0, 4, 5, 7):
        with pytest.raises(ValueError, match="bytes"):
            decode_tachometer(bytes(size))


def status5(controller: int, count: int) -> CanFrame:
    wrapped = (count + 2**31) % 2**32 - 2**31
    return CanFrame(27 << 8 | controller, struct.pack(">ihh", wrapped, 240, 0), extended=True)


def status1(controller: int) -> CanFrame:
    return CanFrame(9 << 8 | controller, struct.pack(">ihh", 0, 0, 0), extended=True)


@settings(max_examples=30, deadline=None)
@given(
    st.integers(-(2**31), 2**31 - 1).filter(lambda start: abs(start) > 25_000),  # not both through 0 at once
    st.integers(1, 19),
    st.integers(-20, 20),
    st.integers(-20, 20),
)
def test_vesc_tachometers_meet_on_the_line_of_their_motion(start: int, phase: int, left: int, right: int) -> None:
    conversation = VescPairConversation(10, 11)
    conversation.connected(0)
    found: list[Reading] = []
    for ms in range(1000):
        if ms % 20 == 0:
            found += conversation.receive(status5(10, start + left * ms), ms * MS)
        if ms % 20 == phase:
            found += conversation.receive(status5(11, start + right * ms), ms * MS)
    readings = wheels_in(found)
    assert len(readings) > 90
    assert [reading.continuous for reading in readings].count(False) == 1
    first = readings[0]
    for reading in readings:
        ms_since = (reading.stamp_ns - first.stamp_ns) / MS
        assert abs(reading.left_ticks - left * ms_since) <= 1
        assert abs(reading.right_ticks - right * ms_since) <= 1


def test_a_vesc_without_status_5_is_told() -> None:
    conversation = VescPairConversation(10, 11)
    conversation.connected(0)
    for ms in range(0, 1500, 20):
        for controller in (10, 11):
            assert not list(conversation.receive(status1(controller), ms * MS))
        if ms % 40:
            list(conversation.receive(status5(11, ms), ms * MS))
        assert conversation.requests(ms * MS) == ()
    assert conversation.state is LinkState.STARTING
    assert conversation.trouble == (
        "controller 10 (left wheel) does not send its tachometer: switch on CAN status message 5 in VESC Tool"
    )


def test_a_vesc_that_boots_is_no_motion() -> None:
    conversation = VescPairConversation(10, 11)
    conversation.connected(0)
    found: list[Reading] = []
    for ms in range(0, 2000, 20):
        if not 900 <= ms < 1400:
            found += conversation.receive(status5(10, 5000 if ms < 900 else 3), ms * MS)
        found += conversation.receive(status5(11, 80_000), (ms + 7) * MS)
    readings = wheels_in(found)
    assert [reading.continuous for reading in readings].count(False) == 2
    assert {reading.left_ticks for reading in readings} == {0}


@pytest.mark.parametrize("conversation", [VescPairConversation(1, 2), ODrivePairConversation(1, 2)])
def test_foreign_short_and_remote_frames_are_no_readings(
    conversation: VescPairConversation | ODrivePairConversation,
) -> None:
    ids = [27 << 8 | 1, 9 << 8 | 2, 1 << 5 | 9, 2 << 5 | 10, 2 << 5 | 1]
    for can_id in ids:
        for extended in (False, True):
            for data in (b"", b"\0" * 5, b"\xff" * 7):
                frame = CanFrame(can_id, data, extended=extended)
                assert list(conversation.receive(frame, MS)) == []
            assert list(conversation.receive(CanFrame(can_id, extended=extended, remote=True, dlc=8), MS)) == []
    assert set(conversation.counters.drops) == {"wrong_length"}
    assert list(conversation.farewell()) == []
