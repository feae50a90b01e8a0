"""Records of wires: bytes and back, and the same records through the same conversation."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.conversation import CanFrame, SetBaudRate
from drivers.errors import FrameError
from drivers.ports import Direction
from drivers.readings import ChainReading, ClockFit, Identity, LinkState, Reading, SourceCounters
from drivers.recording import (
    WIRE_DEFINITION,
    WIRE_TYPE,
    Item,
    WirePlayer,
    WireRecord,
    WireWriter,
    decode_record,
    encode_record,
)

STAMPS = st.integers(-(1 << 62), 1 << 62)
FRAMES = st.one_of(
    st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8)),
    st.builds(CanFrame, st.integers(0, (1 << 29) - 1), st.binary(max_size=8), st.just(True)),
    st.builds(
        CanFrame, st.integers(0, 0x7FF), st.just(b""), st.just(False), st.just(True), st.none() | st.integers(0, 8)
    ),
)
ITEMS = st.one_of(st.binary(max_size=300), FRAMES, st.builds(SetBaudRate, st.integers(1, 4_000_000)), st.text())
RECORDS = st.builds(
    WireRecord, STAMPS, st.sampled_from(list(Direction)), ITEMS, st.lists(STAMPS, max_size=5).map(tuple)
)


@given(RECORDS)
def test_a_record_comes_back_as_it_was(record: WireRecord) -> None:
    assert decode_record(encode_record(record)) == record


@given(RECORDS)
def test_readers_of_ros_bags_read_a_record_by_its_definition(record: WireRecord) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(WIRE_DEFINITION, WIRE_TYPE))
    message: Any = store.deserialize_cdr(encode_record(record), WIRE_TYPE)
    assert message.stamp_ns == record.stamp_ns
    assert tuple(message.asked_ns) == record.asked_ns
    if isinstance(record.item, bytes):
        assert bytes(message.data) == record.item


@given(RECORDS, st.data())
def test_a_torn_record_is_refused_or_another_one_but_never_an_uncaught_error(
    record: WireRecord, data: st.DataObject
) -> None:
    message = bytearray(encode_record(record))
    cut = data.draw(st.integers(0, len(message) - 1))
    with pytest.raises(FrameError):
        decode_record(bytes(message[:cut]))
    message[data.draw(st.integers(0, len(message) - 1))] ^= data.draw(st.integers(1, 255))
    with contextlib.suppress(FrameError):
        decode_record(bytes(message))


class Sums:
    """A conversation whose every answer depends on all that happened to it, in order."""

    identity: Identity | None = None
    clock_fit: ClockFit | None = None
    trouble: str | None = None
    state = LinkState.RUNNING
    silence_limit_ns = 1

    def __init__(self) -> None:
        self.counters = SourceCounters()
        self.sum = 0
        self.fail = False

    def connected(self, now_ns: int) -> None:
        self.sum = now_ns % 1009

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        if chunk == b"!":
            raise ZeroDivisionError
        for byte in chunk:
            self.sum = (self.sum * 31 + byte + stamp_ns) % 1009
            if self.sum % 3 == 0:
                yield ChainReading(self.sum, ())

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        self.sum = (self.sum * 7 + now_ns) % 1009
        return [b"?%d" % self.sum] if self.sum % 4 == 0 else []

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        return []


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("in"), st.binary(max_size=6)),
        st.tuples(st.just("in"), st.just(b"!")),
        st.tuples(st.just("turn"), st.just(b"")),
        st.tuples(st.just("connected"), st.just(b"")),
    ),
    max_size=120,
)


def live(steps: list[tuple[str, bytes]]) -> tuple[list[WireRecord], list[Reading]]:
    """What the reader does with a wire, taped."""
    talker, writer, broken = Sums(), WireWriter(), False
    records: list[WireRecord] = []
    readings: list[Reading] = []

    def tap(direction: Direction, stamp_ns: int, item: Item) -> None:
        if (record := writer.take(direction, stamp_ns, item)) is not None:
            records.append(record)

    tap(Direction.CONNECTED, 0, "x")
    talker.connected(0)
    for now_ns, (what, chunk) in enumerate(steps, start=1):
        if what == "in":
            tap(Direction.IN, now_ns, chunk)
            if broken:
                continue
            try:
                for reading in talker.receive(chunk, now_ns):
                    readings.append(reading)
            except ZeroDivisionError:
                broken = True
        elif what == "turn":
            tap(Direction.TURN, now_ns, "")
            for item in () if broken else talker.requests(now_ns):
                tap(Direction.OUT, now_ns, item)
        else:
            tap(Direction.CONNECTED, now_ns, "x")
            talker.connected(now_ns)
            broken = False
    if (rest := writer.rest()) is not None:
        records.append(rest)
    return records, readings


@given(STEPS)
def test_replayed_records_give_the_same_readings_and_the_same_requests(steps: list[tuple[str, bytes]]) -> None:
    records, readings = live(steps)
    player = WirePlayer({"x": Sums()})
    assert [reading for record in records for _, reading in player.play(record)] == readings
    assert player.sent_otherwise == 0
    assert player.sent == sum(record.direction is Direction.OUT for record in records)


def test_what_a_changed_driver_would_have_asked_is_noticed() -> None:
    records, _ = live([("turn", b"")] * 100)
    assert any(record.direction is Direction.OUT for record in records)
    other = Sums()
    other.requests = lambda now_ns: [b"other"]  # type: ignore[method-assign]
    player = WirePlayer({"x": other})
    for record in records:
        list(player.play(record))
    assert player.sent == 0
    assert player.sent_otherwise > 0


def test_a_wire_that_only_turns_is_written_now_and_then() -> None:
    records, _ = live([("turn", b"")] * 1000)
    longest = max(len(record.asked_ns) for record in records)
    assert longest <= 50
    assert sum(len(record.asked_ns) for record in records) == 1000


@given(st.lists(st.lists(st.sampled_from(["left", "right"]), min_size=1, max_size=2, unique=True), max_size=60))
def test_of_a_shared_wire_those_are_asked_again_who_were_asked(turns: list[list[str]]) -> None:
    """A turn concerns whom it must; a driver that is asked more often than it was says something else."""
    talkers, writer = {"left": Sums(), "right": Sums()}, WireWriter()
    records: list[WireRecord] = []

    def tap(direction: Direction, stamp_ns: int, item: Item) -> None:
        if (record := writer.take(direction, stamp_ns, item)) is not None:
            records.append(decode_record(encode_record(record)))

    for name, talker in talkers.items():
        tap(Direction.CONNECTED, 0, name)
        talker.connected(0)
    sent = 0
    for now_ns, asked in enumerate(turns, start=1):
        names = [name for name in talkers if name in asked]
        tap(Direction.TURN, now_ns, "" if len(names) == len(talkers) else "\n".join(names))
        for name in names:
            for item in talkers[name].requests(now_ns):
                tap(Direction.OUT, now_ns, item)
                sent += 1
    if (rest := writer.rest()) is not None:
        records.append(rest)
    again = {"left": Sums(), "right": Sums()}
    player = WirePlayer(again)
    for record in records:
        list(player.play(record))
    assert (player.sent, player.sent_otherwise) == (sent, 0)
    assert [each.sum for each in again.values()] == [each.sum for each in talkers.values()]
