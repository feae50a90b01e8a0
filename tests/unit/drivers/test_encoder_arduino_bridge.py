"""ros_arduino_bridge boards: lines as the firmware writes them, and talks with a scripted board on a cranked clock."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.encoder_arduino_bridge import ArduinoBridgeConversation, decode_line, encode_question, is_baud
from drivers.errors import FrameError
from drivers.readings import (
    ChainReading,
    ContactReading,
    ContactState,
    LinkState,
    RangeStatus,
    Reading,
    WheelReading,
)
from drivers.shares import share_out

MS = 1_000_000


def test_published_lines() -> None:
    assert encode_question("e") == bytes.fromhex("650D")
    assert encode_question("p", 7) == b"p 7\r"
    assert decode_line(b"0 0") == (0, 0)
    assert decode_line(b"201 -35") == (201, -35)
    assert decode_line(b"107") == (107,)
    assert decode_line(b" 201 -35 ") == (201, -35)
    assert decode_line(b"Invalid Command") is None
    assert is_baud(decode_line(b"57600"))
    assert not is_baud(decode_line(b"1023"))
    assert not is_baud(decode_line(b"57600 1"))


@pytest.mark.parametrize("bad", [b"", b"201  -35", b"2-1", b"1 2 3", b"OK", b"1.5", b"99999999999", b"\xb2 1"])
def test_other_lines_are_refused(bad: bytes) -> None:
    with pytest.raises(FrameError):
        decode_line(bad)


class Board:
    """A board as its protocol notes tell: collects a line up to CR, answers it, is deaf while it boots."""

    def __init__(self, *, boot_ms: int = 0, knows: str = "bepd") -> None:
        self.deaf_until_ms = boot_ms
        self.knows = knows
        self.counts = [0, 0]
        self.pings = {7: 107, 8: 0, 9: 398, 10: 650}
        self.inputs = {2: 1, 4: 0}
        self.ping_ms = 3
        self.stuck_pins: set[int] = set()
        self.asked: list[str] = []
        self._line = b""
        self._out: list[tuple[int, bytes]] = []

    def hear(self, data: bytes, ms: int) -> None:
        if ms < self.deaf_until_ms:
            return
        for byte in data:
            if byte != 0x0D:
                self._line += bytes((byte,))
                continue
            words = self._line.decode("ascii", "replace").split(" ")
            self._line = b""
            self.asked.append(" ".join(words))
            self._say(words, ms)

    def _say(self, words: list[str], ms: int) -> None:
        letter = words[0]
        ready = max([ms + 1, *(at for at, _ in self._out)])
        if letter not in self.knows or letter == "":
            answer = "Invalid Command"
        elif letter == "b":
            answer = "57600"
        elif letter == "e":
            answer = f"{self.counts[0]} {self.counts[1]}"
        elif letter == "p":
            pin = int(words[1])
            ready += 1000 if pin in self.stuck_pins else self.ping_ms
            answer = "0" if pin in self.stuck_pins else str(self.pings[pin])
        else:
            answer = str(self.inputs[int(words[1])])
        self._out.append((ready, answer.encode() + b"\r\n"))

    def say(self, ms: int) -> bytes:
        ready = b"".join(line for at, line in self._out if at <= ms)
        self._out = [(at, line) for at, line in self._out if at > ms]
        return ready

    def reset(self, ms: int, boot_ms: int) -> None:
        self.deaf_until_ms = ms + boot_ms
        self.counts = [0, 0]
        self._line = b""
        self._out.clear()


def run(
    conversation: ArduinoBridgeConversation,
    board: Board,
    *,
    from_ms: int = 0,
    for_ms: int = 1000,
    each_ms: Callable[[int], None] = lambda ms: None,
    spoil: Callable[[bytes], list[bytes]] = lambda data: [data],
) -> list[Reading]:
    found: list[Reading] = []
    for ms in range(from_ms, from_ms + for_ms):
        each_ms(ms)
        if data := board.say(ms):
            for piece in spoil(data):
                found += conversation.receive(piece, ms * MS)
        for question in conversation.requests(ms * MS):
            assert isinstance(question, bytes)
            board.hear(question, ms)
    return found


def wheels_in(found: list[Reading]) -> list[WheelReading]:
    return [reading for reading in found if isinstance(reading, WheelReading)]


def full() -> ArduinoBridgeConversation:
    conversation = ArduinoBridgeConversation(pings=(7, 8, 9, 10), contacts={2: True, 4: False})
    conversation.connected(0)
    return conversation


def test_a_sketch_without_b_is_read_after_two_seconds_of_invalid_commands() -> None:
    conversation, board = full(), Board(knows="epd")
    found = run(conversation, board, for_ms=6000)
    assert conversation.state is LinkState.RUNNING
    assert not [reading for reading in found if reading.stamp_ns < 1900 * MS]
    assert len(wheels_in(found)) > 80
    assert conversation.counters.drops == {}


def test_a_board_that_knows_b_is_not_believed_without_it() -> None:
    """However often the talk began anew: its Invalid Command, for the end of line before `b`, is no word for `b`."""
    conversation, board = full(), Board()
    run(conversation, board, for_ms=3000)
    for k in range(12):
        begin = 3000 + 300 * k
        list(conversation.receive(b"?\r\n", begin * MS))  # out of step
        run(conversation, board, from_ms=begin, for_ms=300)
    board.knows = "epd"
    list(conversation.receive(b"?\r\n", 7000 * MS))
    found = run(conversation, board, from_ms=7000, for_ms=1500)
    assert wheels_in(found) == []


def test_everything_is_asked_in_turn_at_its_rate() -> None:
    conversation, board = full(), Board()

    def roll(ms: int) -> None:
        board.counts = [2 * ms, -3 * ms]

    found = run(conversation, board, for_ms=4000, each_ms=roll)
    assert conversation.state is LinkState.RUNNING
    assert conversation.trouble is None
    assert conversation.counters.drops == {}
    wheels = wheels_in(found)
    assert len(wheels) == pytest.approx(4 * 30, abs=8)
    assert [reading.continuous for reading in wheels] == [False] + [True] * (len(wheels) - 1)
    span_ms = (wheels[-1].stamp_ns - wheels[0].stamp_ns) / MS
    assert wheels[-1].left_ticks == pytest.approx(2 * span_ms, abs=8)
    assert wheels[-1].right_ticks == pytest.approx(-3 * span_ms, abs=12)
    ranges = [each for reading in found if isinstance(reading, ChainReading) for each in reading.ranges]
    for pin, range_m, status in (
        (7, 1.07, RangeStatus.ECHO),
        (8, math.nan, RangeStatus.INVALID),
        (9, 3.98, RangeStatus.ECHO),
        (10, math.inf, RangeStatus.NO_RETURN),
    ):
        of_pin = [each for each in ranges if each.channel == pin]
        assert len(of_pin) == pytest.approx(4 * 5, abs=3)
        assert {each.status for each in of_pin} == {status}
        assert of_pin[0].range_m == pytest.approx(range_m, nan_ok=True)
    lines = [each for reading in found if isinstance(reading, ContactReading) for each in reading.lines]
    assert {each.state for each in lines} == {ContactState.CLEAR}
    assert len(lines) == pytest.approx(2 * 4 * 20, abs=10)


def test_switches_are_tripped_by_their_polarity() -> None:
    conversation, board = full(), Board()
    board.inputs = {2: 0, 4: 1}
    found = run(conversation, board)
    lines = [each for reading in found if isinstance(reading, ContactReading) for each in reading.lines]
    assert {each.line for each in lines} == {2, 4}
    assert {each.state for each in lines} == {ContactState.TRIPPED}


def test_nobody_starves_when_more_is_wanted_than_the_board_can_do() -> None:
    board = Board()
    board.ping_ms = 40
    conversation = ArduinoBridgeConversation(
        pings=(7, 9, 10), contacts={2: False}, wheel_rate_hz=100, ping_rate_hz=50, contact_rate_hz=100
    )
    conversation.connected(0)
    run(conversation, board, for_ms=5000)
    polled = [question for question in board.asked if question not in ("", "b")]
    counts = {question: polled.count(question) for question in set(polled)}
    assert set(counts) == {"e", "p 7", "p 9", "p 10", "d 2"}
    assert min(counts.values()) > 15
    assert counts["e"] >= max(counts["p 7"], counts["p 9"], counts["p 10"])


def test_a_board_that_boots_for_two_seconds_is_waited_for() -> None:
    conversation, board = full(), Board(boot_ms=2000)
    assert run(conversation, board, for_ms=2000) == []
    assert conversation.state is LinkState.SILENT
    assert conversation.trouble is None, "it may still be booting"
    assert wheels_in(run(conversation, board, from_ms=2000, for_ms=600))
    assert conversation.identity is not None


def test_a_board_that_never_answers_is_told_with_the_repair() -> None:
    conversation, board = full(), Board(boot_ms=10**9)
    run(conversation, board, for_ms=3200)
    assert conversation.state is LinkState.SILENT
    assert "line speed" in (conversation.trouble or "")


def test_a_reset_of_the_board_is_no_motion() -> None:
    conversation, board = full(), Board()
    board.counts = [900, 950]
    run(conversation, board, for_ms=500)
    board.reset(500, boot_ms=1200)
    found = wheels_in(run(conversation, board, from_ms=500, for_ms=3000))
    assert not found[0].continuous
    assert all(reading.continuous for reading in found[1:])
    assert (found[-1].left_ticks, found[-1].right_ticks) == (0, 0)


def test_a_reset_too_short_to_be_missed_is_no_motion() -> None:
    conversation, board = full(), Board()
    board.counts = [900, 950]
    run(conversation, board, for_ms=500)
    board.counts = [0, 0]  # somebody else sent `r`
    found = wheels_in(run(conversation, board, from_ms=500, for_ms=500))
    assert [reading.continuous for reading in found[:2]] == [False, True]
    assert {reading.left_ticks for reading in found} == {0}


def test_counts_wrap_both_ways() -> None:
    conversation, board = full(), Board()

    def roll(ms: int) -> None:
        board.counts = [
            (2**31 - 700 + 2 * ms + 2**31) % 2**32 - 2**31,
            (-(2**31) + 700 - 2 * ms + 2**31) % 2**32 - 2**31,
        ]

    wheels = wheels_in(run(conversation, board, for_ms=1000, each_ms=roll))
    assert all(reading.continuous for reading in wheels[1:])
    assert wheels[-1].left_ticks == -wheels[-1].right_ticks
    assert wheels[-1].left_ticks > 1700


def test_a_sketch_without_base_support_is_told() -> None:
    conversation, board = full(), Board(knows="bpd")
    found = run(conversation, board)
    assert not wheels_in(found)
    assert any(isinstance(reading, ChainReading) for reading in found)
    assert "USE_BASE" in (conversation.trouble or "")
    assert board.asked.count("e") < 10


def test_an_unplugged_sonar_at_which_the_board_stands_still() -> None:
    """It is told stale, asked seldom, and its late `0` is nobody else's answer."""
    conversation, board = full(), Board()
    board.stuck_pins = {9}
    board.pings[7] = 200
    found = run(conversation, board, for_ms=9000)
    ranges = [each for reading in found if isinstance(reading, ChainReading) for each in reading.ranges]
    assert {each.status for each in ranges if each.channel == 9} == {RangeStatus.STALE}
    assert {each.range_m for each in ranges if each.channel == 7} == {2.0}
    lines = [each for reading in found if isinstance(reading, ContactReading) for each in reading.lines]
    assert {each.state for each in lines} == {ContactState.CLEAR}
    assert board.asked.count("p 9") <= 3
    assert "pin 9" in (conversation.trouble or "")
    late = wheels_in(run(conversation, board, from_ms=9000, for_ms=2000))
    assert len(late) > 50


def test_never_more_than_one_question_is_open() -> None:
    conversation, board = full(), Board()
    open_questions = 0
    for ms in range(1500):
        data = board.say(ms)
        open_questions -= data.count(b"\n") - data.count(b"Invalid")
        list(conversation.receive(data, ms * MS))
        for question in conversation.requests(ms * MS):
            assert isinstance(question, bytes)
            open_questions += 1
            board.hear(question, ms)
        assert open_questions <= 1


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([1, 2, 3]))
def test_noise_costs_time_but_neither_swaps_answers_nor_stops_the_talk(seed: int, kind: int) -> None:
    """Lines lost, doubled or garbled: each sonar keeps its own value, counts never jump, and it always goes on."""
    rng = random.Random(seed)
    conversation, board = full(), Board()
    board.counts = [123_456_789, -123_456_789]
    board.pings = {7: 111, 8: 122, 9: 133, 10: 144}

    def spoil(data: bytes) -> list[bytes]:
        if rng.random() > 0.1:
            return [data]
        if kind == 1:
            return []
        if kind == 2:
            return [data, data]
        at = rng.randrange(len(data))
        return [data[:at], bytes((rng.choice((0x00, 0x0A, 0x80, 0xFF)),)), data[at:]]

    found = run(conversation, board, for_ms=3000, spoil=spoil)
    for reading in found:
        if isinstance(reading, ChainReading):
            for each in reading.ranges:
                if each.status is RangeStatus.ECHO:
                    assert each.range_m == board.pings[each.channel] / 100
        if isinstance(reading, WheelReading):
            assert (reading.left_ticks, reading.right_ticks) == (0, 0)
    assert len(wheels_in(run(conversation, board, from_ms=3000, for_ms=1000))) > 20


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 5), min_size=1, max_size=8))
def test_any_split_gives_the_same_readings(cuts: list[int]) -> None:
    def in_pieces(data: bytes) -> list[bytes]:
        pieces = []
        for cut in cuts * len(data):
            if data:
                pieces.append(data[:cut])
                data = data[cut:]
        return pieces

    whole, pieces = full(), full()
    assert repr(run(whole, Board(), for_ms=400)) == repr(run(pieces, Board(), for_ms=400, spoil=in_pieces))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=40), max_size=10))
def test_any_bytes_raise_nothing(chunks: list[bytes]) -> None:
    conversation = full()
    for index, chunk in enumerate(chunks):
        list(conversation.receive(chunk, index * MS))
        conversation.requests(index * MS)
        assert conversation.state in LinkState
        assert conversation.trouble is None or conversation.trouble


def test_the_sources_of_one_board_each_show_their_own() -> None:
    board = Board()
    shares = share_out(full(), {"drive": WheelReading, "front": ChainReading, "bumper": ContactReading})
    for share in shares.values():
        share.connected(0)
    found: dict[str, list[Reading]] = {name: [] for name in shares}
    for ms in range(1000):
        data = board.say(ms)
        for name, share in shares.items():
            if data:
                found[name] += share.receive(data, ms * MS)
            for question in share.requests(ms * MS):
                assert isinstance(question, bytes)
                board.hear(question, ms)
    assert {name: {type(each) for each in readings} for name, readings in found.items()} == {
        "drive": {WheelReading},
        "front": {ChainReading},
        "bumper": {ContactReading},
    }
    assert all(share.state is LinkState.RUNNING for share in shares.values())
    assert shares["front"].counters.readings == len(found["front"])
    with pytest.raises(ValueError, match="two sources"):
        share_out(full(), {"a": WheelReading, "b": WheelReading})


def test_an_answer_that_lay_waiting_for_us_was_sampled_as_soon_as_any() -> None:
    """This program was held up for 100 ms behind a question: what it read then is no later than usual."""
    conversation, board = ArduinoBridgeConversation(), Board()
    conversation.connected(0)
    run(conversation, board)
    ms = 1000
    while encode_question("e") not in conversation.requests(ms * MS):
        ms += 1
    (reading,) = conversation.receive(b"5 5\r\n", (ms + 100) * MS)
    assert ms * MS <= reading.stamp_ns <= (ms + 1) * MS


def test_a_ping_that_lay_waiting_for_us_keeps_the_time_of_its_question() -> None:
    conversation, board = ArduinoBridgeConversation(wheels=False, pings=(7,)), Board()
    conversation.connected(0)
    run(conversation, board)
    ms = 1000
    while encode_question("p", 7) not in conversation.requests(ms * MS):
        ms += 1
    (reading,) = conversation.receive(b"107\r\n", (ms + 100) * MS)
    assert ms * MS <= reading.stamp_ns <= (ms + 1) * MS
