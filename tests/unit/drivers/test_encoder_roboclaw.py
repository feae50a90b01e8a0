"""RoboClaw: the published vectors, and a conversation with a scripted controller on a cranked clock."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.checksums import crc16_ccitt
from drivers.encoder_roboclaw import (
    Command,
    RoboClawConversation,
    decode_answer,
    decode_both_counts,
    decode_count,
    decode_version,
    encode_question,
)
from drivers.errors import FrameError
from drivers.readings import LinkState, Reading, WheelReading

MS = 1_000_000
ADDRESS = 0x80

VECTORS = [
    (Command.COUNT_M1, "80 10", "00 00 03 E8 00 71 36"),
    (Command.COUNT_M2, "80 11", "FF FF F8 30 02 8A F5"),
    (Command.MAIN_BATTERY, "80 18", "00 79 D8 44"),
    (Command.BOTH_COUNTS, "80 4E", "00 00 03 E8 FF FF F8 30 17 A0"),
    (Command.VERSION, "80 15", b"USB Roboclaw 2x15a v4.2.4\n\0".hex() + "C403"),
]


@pytest.mark.parametrize(("command", "question", "answer"), VECTORS)
def test_published_answers_pass_and_no_single_changed_bit_does(command: Command, question: str, answer: str) -> None:
    whole = bytes.fromhex(answer)
    assert encode_question(ADDRESS, command) == bytes.fromhex(question)
    assert decode_answer(ADDRESS, command, whole) == whole[:-2]
    for bit in range(8 * len(whole)):
        bad = bytearray(whole)
        bad[bit // 8] ^= 1 << bit % 8
        with pytest.raises(FrameError):
            decode_answer(ADDRESS, command, bytes(bad))
    with pytest.raises(FrameError):
        decode_answer(ADDRESS + 1, command, whole)


def test_published_values() -> None:
    data = {command: bytes.fromhex(answer)[:-2] for command, _, answer in VECTORS}
    assert decode_count(data[Command.COUNT_M1]) == 1000
    assert decode_count(data[Command.COUNT_M2]) == -2000
    assert decode_both_counts(data[Command.BOTH_COUNTS]) == (1000, -2000)
    assert decode_version(data[Command.VERSION]) == "USB Roboclaw 2x15a v4.2.4"


class Controller:
    """Answers as a controller would, from counts that a test sets; deaf to commands it does not know."""

    def __init__(self, *, knows: set[int] | None = None) -> None:
        self.counts = [0, 0]
        self.knows = knows if knows is not None else {16, 17, 21, 24, 78}
        self.powered = True

    def answer(self, question: bytes) -> bytes:
        address, command = question
        if address != ADDRESS or command not in self.knows or not self.powered:
            return b""
        wrapped = [count % 2**32 for count in self.counts]
        data = {
            16: struct.pack(">IB", wrapped[0], 0),
            17: struct.pack(">IB", wrapped[1], 0),
            21: b"USB Roboclaw 2x7a v4.1.34\n\0",
            24: (118).to_bytes(2, "big"),
            78: struct.pack(">II", *wrapped),
        }[command]
        return data + crc16_ccitt(question + data).to_bytes(2, "big")


def run(
    conversation: RoboClawConversation,
    controller: Controller,
    *,
    from_ms: int = 0,
    for_ms: int = 1000,
    each_ms: Callable[[int], None] = lambda ms: None,
    spoil: Callable[[bytes], list[bytes]] = lambda answer: [answer],
) -> list[WheelReading]:
    """Turn the crank every millisecond; an answer comes one millisecond after its question."""
    found: list[Reading] = []
    pending: list[bytes] = []
    for ms in range(from_ms, from_ms + for_ms):
        each_ms(ms)
        for chunk in pending:
            found += conversation.receive(chunk, ms * MS)
        pending = []
        for question in conversation.requests(ms * MS):
            assert isinstance(question, bytes)
            if answer := controller.answer(question):
                pending += spoil(answer)
    return [reading for reading in found if isinstance(reading, WheelReading)]


def test_it_introduces_itself_then_counts_at_the_wanted_rate() -> None:
    conversation, controller = RoboClawConversation(rate_hz=50.0), Controller()
    conversation.connected(0)

    def roll(ms: int) -> None:
        controller.counts = [3 * ms, -2 * ms]

    readings = run(conversation, controller, each_ms=roll, for_ms=6000)
    assert conversation.state is LinkState.RUNNING
    identity = conversation.identity
    assert identity is not None
    assert (identity.model, identity.firmware) == ("USB Roboclaw 2x7a", "v4.1.34")
    assert 290 <= len(readings) <= 300
    assert [reading.continuous for reading in readings] == [False] + [True] * (len(readings) - 1)
    first, last = readings[0], readings[-1]
    span_ms = (last.stamp_ns - first.stamp_ns) / MS
    assert last.left_ticks == pytest.approx(3 * span_ms, abs=6)
    assert last.right_ticks == pytest.approx(-2 * span_ms, abs=4)
    assert conversation.battery_v == pytest.approx(11.8)
    assert conversation.counters.drops == {}
    assert conversation.trouble is None


def test_the_left_motor_may_be_the_second() -> None:
    conversation, controller = RoboClawConversation(left_motor=2), Controller()
    conversation.connected(0)

    def roll(ms: int) -> None:
        controller.counts = [ms, 5 * ms]

    last = run(conversation, controller, each_ms=roll)[-1]
    assert last.left_ticks == pytest.approx(5 * last.right_ticks, rel=0.02)


def test_counts_go_on_across_the_wrap_both_ways() -> None:
    conversation, controller = RoboClawConversation(), Controller()
    conversation.connected(0)

    def roll(ms: int) -> None:
        controller.counts = [2**31 - 500 + 2 * ms, -(2**31) + 500 - 2 * ms]

    readings = run(conversation, controller, each_ms=roll)
    assert all(reading.continuous for reading in readings[1:])
    assert readings[-1].left_ticks == -readings[-1].right_ticks
    assert readings[-1].left_ticks > 1800


def test_a_power_cycle_is_no_motion() -> None:
    conversation, controller = RoboClawConversation(), Controller()
    conversation.connected(0)
    controller.counts = [70_000, 80_000]
    run(conversation, controller, for_ms=500)
    controller.powered = False
    run(conversation, controller, from_ms=500, for_ms=300)
    controller.powered, controller.counts = True, [12, 15]
    readings = run(conversation, controller, from_ms=800, for_ms=500)
    assert [reading.continuous for reading in readings[:3]] == [False, True, True]
    assert readings[-1].left_ticks == 0


def test_older_firmware_is_asked_motor_by_motor() -> None:
    conversation, controller = RoboClawConversation(rate_hz=50), Controller(knows={16, 17, 21})
    conversation.connected(0)

    def roll(ms: int) -> None:
        controller.counts = [4 * ms, 4 * ms]

    readings = run(conversation, controller, each_ms=roll, for_ms=2000)
    assert conversation.state is LinkState.RUNNING
    assert len(readings) > 100
    assert all(abs(r.left_ticks - r.right_ticks) <= 8 for r in readings), "both at the same time"


def test_silence_is_told_with_the_repair_and_ends_when_it_answers() -> None:
    conversation, controller = RoboClawConversation(), Controller()
    controller.powered = False
    conversation.connected(0)
    run(conversation, controller, for_ms=800)
    assert conversation.state is LinkState.SILENT
    assert "80h" in (conversation.trouble or "")
    controller.powered = True
    assert run(conversation, controller, from_ms=800, for_ms=400)
    assert conversation.trouble is None


def test_never_more_than_one_question_is_open() -> None:
    conversation, controller = RoboClawConversation(), Controller()
    conversation.connected(0)
    open_questions = 0
    for ms in range(300):
        asked = conversation.requests(ms * MS)
        open_questions += len(asked)
        assert open_questions <= 1
        for question in asked:
            assert isinstance(question, bytes)
            list(conversation.receive(controller.answer(question), ms * MS))
            open_questions -= 1


@settings(max_examples=60)
@given(st.binary(max_size=12), st.lists(st.integers(1, 6), min_size=1, max_size=6), st.binary(max_size=6))
def test_noise_around_an_answer_and_any_split_hide_nothing(noise: bytes, cuts: list[int], behind: bytes) -> None:
    conversation, controller = RoboClawConversation(), Controller()
    conversation.connected(0)
    controller.counts = [1234, -4321]
    run(conversation, controller, for_ms=200)

    def spoil(answer: bytes) -> list[bytes]:
        stream = noise + answer
        pieces = []
        for cut in cuts * len(stream):
            if stream:
                pieces.append(stream[:cut])
                stream = stream[cut:]
        return [*pieces, *([behind] if behind else [])]

    readings = run(conversation, controller, from_ms=200, for_ms=300, spoil=spoil)
    assert len(readings) >= 5
    assert all((r.left_ticks, r.right_ticks) == (0, 0) and r.continuous for r in readings)


def test_mutated_answers_never_move_the_wheels() -> None:
    """Every answer is damaged at up to two places; a count that got through would show as motion."""
    rng = random.Random(78)
    conversation, controller = RoboClawConversation(rate_hz=200), Controller()
    conversation.connected(0)
    controller.counts = [5_000_000, -7_000_000]
    run(conversation, controller, for_ms=100)

    def spoil(answer: bytes) -> list[bytes]:
        bad = bytearray(answer)
        for _ in range(rng.choice((1, 2))):
            action = rng.randrange(3)
            at = rng.randrange(len(bad))
            if action == 0:
                bad[at] ^= rng.randrange(1, 256)
            elif action == 1:
                del bad[at]
            else:
                bad.insert(at, rng.randrange(256))
        return [bytes(bad)] if bytes(bad) != answer else []

    readings = run(conversation, controller, from_ms=100, for_ms=20_000, spoil=spoil)
    assert {(r.left_ticks, r.right_ticks) for r in readings} <= {(0, 0)}
    assert conversation.counters.drops["bad_answer"] > 150
    again = run(conversation, controller, from_ms=20_200, for_ms=200)
    assert again, "and it is read again at once"


def test_an_answer_that_lay_waiting_for_us_was_sampled_as_soon_as_any() -> None:
    """This program was held up for 50 ms behind a question: what it read then is no later than usual."""
    conversation, controller = RoboClawConversation(rate_hz=50.0), Controller()
    conversation.connected(0)
    run(conversation, controller)
    ms, asked = 1000, False
    while not asked:
        asked = encode_question(ADDRESS, Command.BOTH_COUNTS) in conversation.requests(ms * MS)
        ms += 1
    answer = controller.answer(encode_question(ADDRESS, Command.BOTH_COUNTS))
    (reading,) = conversation.receive(answer, (ms + 49) * MS)
    assert (ms - 1) * MS <= reading.stamp_ns <= ms * MS
