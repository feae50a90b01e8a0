"""MaxBotix sensors: texts of the data sheets, greetings, noise, and lines of a micro-controller."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.readings import ChainReading, LinkState, RangeReading, RangeStatus
from drivers.sonar_maxbotix import MODELS, Family, MaxBotixConversation, decode_line

MS = 1_000_000


def said(conversation: MaxBotixConversation, stream: bytes, *, at_ms: int = 1000) -> list[RangeReading]:
    return [
        each
        for reading in conversation.receive(stream, at_ms * MS)
        if isinstance(reading, ChainReading)
        for each in reading.ranges
    ]


def test_the_published_bytes() -> None:
    [value] = said(MaxBotixConversation("hr-5m"), bytes.fromhex("52313233340D"))
    assert (value.channel, value.status) == (1, RangeStatus.ECHO)
    assert value.range_m == pytest.approx(1.234)
    [value] = said(MaxBotixConversation("hr-5m"), b"R0480 \r")
    assert value.range_m == pytest.approx(0.48)


@pytest.mark.parametrize(
    ("family", "text", "range_m", "status"),
    [
        ("lv", b"R010\r", 0.254, RangeStatus.ECHO),
        ("lv", b"R006\r", -math.inf, RangeStatus.TOO_CLOSE),
        ("lv", b"R254\r", math.inf, RangeStatus.NO_RETURN),
        ("lv", b"R255\r", math.inf, RangeStatus.NO_RETURN),
        ("lv", b"R300\r", math.nan, RangeStatus.INVALID),
        ("xl", b"R123\r", 1.23, RangeStatus.ECHO),
        ("xl", b"R020\r", -math.inf, RangeStatus.TOO_CLOSE),
        ("xl", b"R765\r", math.inf, RangeStatus.NO_RETURN),
        ("xl", b"R000\r", math.nan, RangeStatus.INVALID),
        ("hr-5m", b"R0300\r", -math.inf, RangeStatus.TOO_CLOSE),
        ("hr-5m", b"R4999\r", 4.999, RangeStatus.ECHO),
        ("hr-5m", b"R5000\r", math.inf, RangeStatus.NO_RETURN),
        ("hr-5m", b"R9999\r", math.inf, RangeStatus.NO_RETURN),
        ("hr-10m", b"R5000\r", 5.0, RangeStatus.ECHO),
        ("hr-10m", b"R9999\r", math.inf, RangeStatus.NO_RETURN),
    ],
)
def test_values(family: Family, text: bytes, range_m: float, status: RangeStatus) -> None:
    [value] = said(MaxBotixConversation(family), text)
    assert value.status is status
    assert value.range_m == pytest.approx(range_m, nan_ok=True)


@pytest.mark.parametrize(
    "text", [b"1234\r", b"R123\r", b"R12345\r", b"R12 4\r", b"R1234  \r", b"R12\x0034\r", b"r1234\r", b"R-123\r"]
)
def test_anything_but_exact_text_is_no_value(text: bytes) -> None:
    conversation = MaxBotixConversation("hr-5m")
    said(conversation, b"R1000\r")
    assert said(conversation, text) == []
    assert sum(conversation.counters.drops.values()) == 1


def test_a_greeting_is_no_fault_and_names_the_sensor() -> None:
    conversation = MaxBotixConversation("hr-5m")
    assert said(conversation, b"HRXL-MaxSonar-WR\rPN:MB7360\rCopyright 2011-2013\rMaxBotix Inc\rRoHS 1.8b 090\r") == []
    before = conversation.state
    assert len(said(conversation, b"R1234\rR1235\r")) == 2
    assert [before, conversation.state] == [LinkState.STARTING, LinkState.RUNNING]
    assert conversation.identity is not None
    assert conversation.identity.model == "HRXL-MaxSonar-WR"
    assert conversation.counters.drops == {}


@pytest.mark.parametrize("family", list(MODELS))
@settings(max_examples=40, deadline=None)
@given(values=st.lists(st.integers(0, 9999), max_size=20), cuts=st.lists(st.integers(1, 9), min_size=1, max_size=9))
def test_any_split_gives_the_same(family: Family, values: list[int], cuts: list[int]) -> None:
    digits = MODELS[family].digits
    stream = b"".join(b"R%0*d\r" % (digits, value % 10**digits) for value in values)
    whole, pieces = MaxBotixConversation(family), MaxBotixConversation(family)
    expected = said(whole, stream)
    got: list[RangeReading] = []
    at = 0
    for cut in cuts * (len(stream) + 1):
        got += said(pieces, stream[at : at + cut])
        at += cut
    assert repr(got) == repr(expected)
    assert len(expected) == len(values)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=30))
def test_at_most_the_line_that_noise_touches_is_lost(noise: bytes) -> None:
    conversation = MaxBotixConversation("hr-5m")
    values = said(conversation, noise + b"R1111\rR1222\r")
    assert values[-1].range_m == pytest.approx(1.222)


def test_the_time_on_the_wire_and_the_cycle_are_taken_off() -> None:
    conversation = MaxBotixConversation("lv")
    [reading] = conversation.receive(b"R100\r", 1000 * MS)
    assert isinstance(reading, ChainReading)
    assert (1000 * MS - reading.stamp_ns) / MS == pytest.approx(49 + 5 * 10 / 9.6, abs=0.1)
    later = list(conversation.receive(b"R100\rR101\r", 1100 * MS))
    stamps = [each.stamp_ns for each in later if isinstance(each, ChainReading)]
    assert stamps[1] - stamps[0] == pytest.approx(5 * 10 / 9.6 * MS, rel=0.01)


@pytest.mark.parametrize(
    "line", [b"3:R1234\r\n", b"3 1234\n", b"S3=1234\r\n", b"3\tR1234 \r", b"sonar3: 1234\r\n", b"03,R1234\n"]
)
def test_labelled_lines(line: bytes) -> None:
    conversation = MaxBotixConversation("hr-5m", form="labelled", channels=(1, 3))
    [value] = said(conversation, b"34\n" + line)
    assert (value.channel, value.status) == (3, RangeStatus.ECHO)
    assert value.range_m == pytest.approx(1.234)


@pytest.mark.parametrize("line", [b"R123 R087 R254\r\n", b"123,087,254\n", b"123;\t087 254 \r\n"])
def test_lists(line: bytes) -> None:
    conversation = MaxBotixConversation("lv", form="list", channels=(1, 3))
    values = said(conversation, b"\n" + line)
    assert [(each.channel, each.status) for each in values] == [(1, RangeStatus.ECHO), (3, RangeStatus.NO_RETURN)]
    assert said(conversation, b"123,087\n") == [], "which one is missing is not known"


def test_a_first_line_that_may_be_torn_gives_no_channel() -> None:
    conversation = MaxBotixConversation("lv", form="labelled")
    assert said(conversation, b"2:R100\n") == [], "it may have been 12:R100"
    assert decode_line("12:R100", "labelled") == [(12, "100")]
    assert [each.channel for each in said(conversation, b"12:R100\n")] == [12]


def test_a_channel_that_stops_is_told_stale_once_and_comes_back() -> None:
    conversation = MaxBotixConversation("lv", form="labelled", channels=(1, 2))
    found: list[RangeReading] = []
    for at_ms in range(0, 3000, 50):
        lines = b"1:R100\n" + (b"2:R090\n" if at_ms < 1000 or at_ms >= 2500 else b"")
        found += said(conversation, lines, at_ms=at_ms)
        if at_ms == 2000:
            assert "channel 2" in (conversation.trouble or "")
    stale = [each for each in found if each.status is RangeStatus.STALE]
    assert [each.channel for each in stale] == [2]
    assert conversation.trouble is None
    assert conversation.counters.drops == {"channel_silent": 1, "torn_line": 1}


def test_troubles_name_the_repair() -> None:
    conversation = MaxBotixConversation("lv")
    conversation.connected(0)
    conversation.requests(1100 * MS)
    assert "power" in (conversation.trouble or "")
    list(conversation.receive(b"\xad\x9d\x93", 1200 * MS))
    conversation.requests(1300 * MS)
    assert "inverted" in (conversation.trouble or "")
    assert conversation.requests(1400 * MS) == ()


def test_random_bytes_raise_nothing_and_hardly_ever_pass() -> None:
    rng = random.Random(52)
    conversation = MaxBotixConversation("hr-5m")
    passed = sum(len(said(conversation, rng.randbytes(200))) for _ in range(2000))
    assert passed <= 1


def test_slow_lists_are_not_taken_for_silence() -> None:
    conversation = MaxBotixConversation("hr-5m", form="list", channels=(1, 2, 3))
    assert conversation.silence_limit_ns > 500 * MS
    assert MaxBotixConversation("lv").silence_limit_ns == 147 * MS
    assert MaxBotixConversation("hr-5m").silence_limit_ns == 450 * MS
