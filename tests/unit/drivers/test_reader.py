"""The reader loop with a cranked clock and scripted ports; only the last tests start its thread."""

from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import pytest

from drivers.conversation import SetBaudRate, silence_limit
from drivers.errors import PortAbsent, PortError
from drivers.ports import Direction
from drivers.queues import BoundedQueue
from drivers.reader import LONGEST_TURN_NS, POLL_PERIOD_NS, WireReader
from drivers.readings import (
    ChainReading,
    ClockFit,
    DeviceEvent,
    Identity,
    LinkState,
    RangeReading,
    RangeStatus,
    Reading,
    SourceCounters,
)
from tests.waiting import GIVE_UP_S, wait_for

MS = 1_000_000


def reading_at(stamp_ns: int) -> ChainReading:
    return ChainReading(stamp_ns, (RangeReading(1, 1.0, RangeStatus.ECHO),))


class Talker:
    """A conversation that answers `?` with a reading for each `!` and does what the test tells it."""

    def __init__(self) -> None:
        self.state = LinkState.SILENT
        self.trouble: str | None = None
        self.identity: Identity | None = None
        self.clock_fit: ClockFit | None = None
        self.counters = SourceCounters()
        self.silence_limit_ns = 300 * MS
        self.connected_at: list[int] = []
        self.requested_at: list[int] = []
        self.outbox: list[bytes | SetBaudRate] = []
        self.fail_in: str | None = None

    def connected(self, now_ns: int) -> None:
        self._may_fail("connected")
        self.connected_at.append(now_ns)
        self.state = LinkState.SILENT

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        self._may_fail("receive")
        for _ in range(chunk.count(b"!")):
            self.state = LinkState.RUNNING
            yield reading_at(stamp_ns)

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        self._may_fail("requests")
        self.requested_at.append(now_ns)
        sent, self.outbox = self.outbox, []
        return sent

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        self._may_fail("farewell")
        return [b"bye"]

    def _may_fail(self, where: str) -> None:
        if self.fail_in == where:
            raise ZeroDivisionError(f"bug in {where}")


class ScriptedPort:
    """Hands out what the bench queued; a read that waits cranks the clock."""

    silence_reopen_s: float | None = None

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.drops: dict[str, int] = {}
        self.done: list[object] = []
        self.closed = False
        self.lost: str | None = None
        self.writable = True

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]:
        if self.lost is not None:
            raise PortAbsent(self.lost)
        assert 0 <= timeout_s <= LONGEST_TURN_NS / 1e9 + 1e-9
        end_ns = self.bench.now_ns + round(timeout_s * 1e9)
        while not self.bench.inbox and self.bench.now_ns < end_ns:
            due_ns = self.bench.plan[0][0] if self.bench.plan else end_ns
            self.bench.now_ns = max(self.bench.now_ns, min(due_ns, end_ns))
            self.bench.play()
        items, self.bench.inbox = self.bench.inbox, []
        if timeout_s > 0.0:
            self.bench.now_ns += self.bench.late_ns
            self.bench.play()
        return items

    def write(self, item: bytes) -> None:
        if not self.writable:
            raise PortError("takes no bytes")
        self.done.append(item)

    def set_baud(self, bits_per_s: int) -> None:
        self.done.append(bits_per_s)

    def close(self) -> None:
        self.closed = True

    def fileno(self) -> int | None:
        return None


class Bench:
    """One wire, its conversations and the clock. `plan`: (time, what to do), in order."""

    def __init__(self, *names: str, tap: Callable[[Direction, int, object], None] | None = None) -> None:
        self.now_ns = 0
        self.late_ns = 0  # so much later the thread goes on after it has waited
        self.inbox: list[tuple[bytes, int]] = []
        self.plan: list[tuple[int, Callable[[], object]]] = []
        self.talkers = {name: Talker() for name in names or ("front",)}
        self.items: list[tuple[int, str, Reading | DeviceEvent]] = []
        self.ports: list[ScriptedPort] = []
        self.opening_fails: PortError | None = None
        self.attempts: list[int] = []
        self.silence_reopen_s: float | None = None
        self.reader: WireReader[bytes] = WireReader(
            "bench", self.open, self.talkers, self.sink, clock=lambda: self.now_ns, wait=self.wait, tap=tap
        )

    def open(self) -> ScriptedPort:
        self.attempts.append(self.now_ns)
        if self.opening_fails is not None:
            raise self.opening_fails
        self.ports.append(ScriptedPort(self))
        self.ports[-1].silence_reopen_s = self.silence_reopen_s
        return self.ports[-1]

    def wait(self, duration_s: float) -> None:
        assert duration_s <= 1.0
        self.now_ns += max(round(duration_s * 1e9), 1)
        self.play()

    def play(self) -> None:
        while self.plan and self.plan[0][0] <= self.now_ns:
            self.plan.pop(0)[1]()

    def sink(self, source: str, item: Reading | DeviceEvent) -> None:
        self.items.append((self.now_ns, source, item))

    def say(self, chunk: bytes = b"!") -> None:
        self.inbox.append((chunk, self.now_ns))

    def say_from_to(self, start_ms: int, stop_ms: int, period_ms: int = 100) -> None:
        self.plan += [(ms * MS, self.say) for ms in range(start_ms, stop_ms, period_ms)]

    def run_until(self, ms: int) -> None:
        while self.now_ns < ms * MS:
            self.reader.step()

    @property
    def port(self) -> ScriptedPort:
        return self.ports[-1]

    @property
    def talker(self) -> Talker:
        return next(iter(self.talkers.values()))

    def events(self, source: str = "front") -> list[tuple[int, LinkState, str]]:
        return [
            (at // MS, item.state, item.text)
            for at, name, item in self.items
            if name == source and isinstance(item, DeviceEvent)
        ]

    def states(self, source: str = "front") -> list[LinkState]:
        return [state for _, state, _ in self.events(source)]

    def readings(self, source: str = "front") -> int:
        return sum(name == source and not isinstance(item, DeviceEvent) for _, name, item in self.items)


def test_requests_are_polled_every_20_ms_and_after_each_receive() -> None:
    bench = Bench()
    bench.plan = [(150 * MS + 3 * MS, bench.say)]
    bench.run_until(1000)
    asked = bench.talker.requested_at
    assert max(b - a for a, b in pairwise(asked)) <= POLL_PERIOD_NS
    assert 160 * MS in asked or 153 * MS in asked
    assert len(asked) == pytest.approx(51, abs=2), "and no more often: nothing busy-waits"


def test_a_conversation_with_a_beat_is_asked_on_the_beat() -> None:
    bench = Bench()
    beat_ns = 7 * MS
    due = [beat_ns]

    class Beating(Talker):
        def next_request_ns(self) -> int:
            return due[0]

        def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
            if now_ns >= due[0]:
                self.requested_at.append(now_ns)
                due[0] += beat_ns
            return []

    beating = Beating()
    bench.reader = WireReader(
        "bench", bench.open, {"front": beating}, bench.sink, clock=lambda: bench.now_ns, wait=bench.wait
    )
    bench.run_until(700)
    assert beating.requested_at == list(range(beat_ns, 700 * MS + 1, beat_ns))


class Telling(Talker):
    """Knows that it has something to say at due_ns only, and whether a message has begun: `!` ends one."""

    def __init__(self) -> None:
        super().__init__()
        self.due_ns = 1 << 62
        self.amid = False

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        self.amid = not chunk.endswith(b"!")
        return super().receive(chunk, stamp_ns)

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        if now_ns >= self.due_ns:
            self.due_ns = 1 << 62
        return super().requests(now_ns)

    def next_request_ns(self) -> int:
        return self.due_ns

    def is_amid(self) -> bool:
        return self.amid


def telling_bench(*plan: tuple[int, bytes], tap: Callable[[Direction, int, object], None] | None = None) -> Bench:
    """plan: milliseconds and what is then said."""
    bench = Bench()
    bench.talkers = {"front": Telling()}
    bench.reader = WireReader(
        "bench", bench.open, bench.talkers, bench.sink, clock=lambda: bench.now_ns, wait=bench.wait, tap=tap
    )
    bench.plan = [(ms * MS, partial(bench.say, chunk)) for ms, chunk in plan]
    return bench


def test_a_conversation_that_tells_when_is_polled_only_until_it_runs() -> None:
    bench = telling_bench(*((ms, b"!") for ms in range(200, 1000, 25)))
    bench.run_until(990)
    asked = bench.talker.requested_at
    starting = [at for at in asked if at < 200 * MS]
    assert max(b - a for a, b in pairwise(starting)) <= POLL_PERIOD_NS
    assert [at for at in asked if 210 * MS < at < 980 * MS] == [ms * MS for ms in range(225, 980, 25)]
    assert all(state is not LinkState.SILENT for state in bench.states()[-1:])
    bench.run_until(1250)
    assert bench.states()[-1] is LinkState.SILENT
    told_at = bench.events()[-1][0]
    assert 975 + 75 <= told_at <= 975 + 300, "silence is noticed when it is due, whoever is polled"


def test_a_conversation_is_not_asked_before_it_has_something_to_say() -> None:
    """A turn that another one needs, with nothing heard: only who is due is asked."""
    bench = telling_bench(*((ms, b"!") for ms in range(100, 1000, 25)))
    first = bench.talker
    other = Talker()
    bench.reader = WireReader(
        "bench", bench.open, {"front": first, "other": other}, bench.sink, clock=lambda: bench.now_ns, wait=bench.wait
    )
    bench.run_until(900)
    between = [at for at in other.requested_at if at > 200 * MS and (at // MS) % 25]
    assert between, "it is polled every 20 ms"
    assert not set(between) & set(first.requested_at)


def test_pieces_of_a_message_cost_one_turn() -> None:
    turns: list[int] = []
    heard: list[tuple[int, object]] = []

    def tap(direction: Direction, stamp_ns: int, item: object) -> None:
        if direction is Direction.TURN:
            turns.append(stamp_ns)
        elif direction is Direction.IN:
            heard.append((stamp_ns, item))

    bench = telling_bench((100, b"!"), (200, b"a"), (201, b"b"), (203, b"c!"), (240, b"!"), tap=tap)
    bench.run_until(260)
    assert heard == [(100 * MS, b"!"), (200 * MS, b"a"), (201 * MS, b"b"), (203 * MS, b"c!"), (240 * MS, b"!")]
    assert [at // MS for at in turns if 190 * MS < at < 250 * MS] == [203, 240]
    assert [at // MS for at, _, item in bench.items if isinstance(item, ChainReading)] == [100, 203, 240]


def test_a_message_that_never_ends_holds_up_no_question() -> None:
    bench = telling_bench((100, b"!"), *((ms, b"a") for ms in range(150, 400, 3)))
    talker = bench.talker
    assert isinstance(talker, Telling)
    talker.due_ns = 210 * MS
    bench.run_until(212)
    assert 210 * MS in talker.requested_at
    talker.requested_at.clear()
    bench.run_until(390)
    asked = talker.requested_at
    assert max(b - a for a, b in pairwise(asked)) <= LONGEST_TURN_NS + MS


class Asking(Telling):
    """Asks `?` every 10 ms once the last one was answered, and has it prepared."""

    def __init__(self) -> None:
        super().__init__()
        self.due_ns = 10 * MS
        self.open = False
        self.more: list[bytes | SetBaudRate] = []

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        assert self.open, "an answer is heard behind its question"
        self.open = False
        return super().receive(chunk, stamp_ns)

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        self.requested_at.append(now_ns)
        if self.open or now_ns < self.due_ns:
            return []
        self.open, self.due_ns = True, self.due_ns + 10 * MS
        more, self.more = self.more, []
        return [*more, b"?"]

    def next_request_ns(self) -> int:
        return self.due_ns + 20 * MS if self.open else self.due_ns

    def prepared(self) -> bytes | None:
        return None if self.open else b"?"


def test_what_is_prepared_leaves_on_time_once_and_is_asked_for_before_its_answer_is_heard() -> None:
    heard: list[tuple[Direction, int, object]] = []
    bench = Bench(tap=lambda *event: heard.append(event))
    asking = Asking()
    bench.reader = WireReader(
        "bench", bench.open, {"drive": asking}, bench.sink, clock=lambda: bench.now_ns, wait=bench.wait,
        tap=lambda *event: heard.append(event),
    )  # fmt: skip
    sent_at: list[int] = []
    write = ScriptedPort.write

    def answered(port: ScriptedPort, item: bytes) -> None:
        write(port, item)
        if item == b"?":
            sent_at.append(bench.now_ns)
            bench.plan.append((bench.now_ns + 2 * MS, lambda: bench.say(b"!")))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ScriptedPort, "write", answered)
        bench.run_until(500)
        asking.more = [b"too"]
        bench.run_until(1000)
    assert [at // MS for at in sent_at] == list(range(10, 1001, 10))
    assert bench.port.done.count(b"too") == 1
    assert bench.readings("drive") == len(sent_at) - (1 if asking.open else 0)
    turns = [at for direction, at, _ in heard if direction is Direction.TURN]
    late = [at // MS for at in turns if at > 105 * MS]
    assert late[:6] == [110, 112, 120, 122, 130, 132], "one turn to ask, one for the answer"
    out = [(at, item) for direction, at, item in heard if direction is Direction.OUT and at > 100 * MS]
    assert [at for at, item in out if item == b"?"] == [at for at in sent_at if at > 100 * MS]
    order = [(direction, at // MS) for direction, at, _ in heard if 200 * MS <= at < 210 * MS]
    assert order == [(Direction.TURN, 200), (Direction.OUT, 200), (Direction.IN, 202), (Direction.TURN, 202)]


def test_a_recording_is_told_who_of_a_shared_wire_was_asked() -> None:
    heard: list[tuple[Direction, int, object]] = []
    bench = Bench()
    talkers = {"left": Telling(), "right": Telling()}
    bench.reader = WireReader(
        "bench", bench.open, talkers, bench.sink, clock=lambda: bench.now_ns, wait=bench.wait,
        tap=lambda *event: heard.append(event),
    )  # fmt: skip
    for ms in range(5, 500, 20):
        bench.plan.append((ms * MS, lambda: bench.say(b"!")))
    for ms, name in ((204, "left"), (304, "right"), (404, "left")):  # so that the next turn knows
        bench.plan.append((ms * MS, partial(setattr, talkers[name], "due_ns", (ms + 9) * MS)))
    bench.plan.sort(key=lambda each: each[0])
    bench.run_until(500)
    asked: dict[str, list[int]] = {name: [] for name in talkers}
    for direction, at_ns, item in heard:
        if direction is Direction.TURN:
            for name in str(item).split("\n") if item else talkers:
                asked[name].append(at_ns)
    assert asked == {name: talker.requested_at for name, talker in talkers.items()}
    assert {item for direction, _, item in heard if direction is Direction.TURN} == {"", "left", "right"}


def test_what_is_not_for_a_conversation_is_not_given_to_it_and_needs_no_turn_of_it() -> None:
    class Choosy(Telling):
        def __init__(self, mark: bytes) -> None:
            super().__init__()
            self.mark = mark
            self.heard: list[bytes] = []

        def hears(self, chunk: bytes) -> bool:
            return chunk.startswith(self.mark)

        def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
            self.heard.append(chunk)
            return super().receive(chunk, stamp_ns)

    bench = Bench()
    left, right = Choosy(b"l"), Choosy(b"r")
    bench.reader = WireReader(
        "bench", bench.open, {"left": left, "right": right}, bench.sink, clock=lambda: bench.now_ns, wait=bench.wait
    )
    bench.plan = [(ms * MS, partial(bench.say, b"l!" if ms % 20 else b"r!")) for ms in range(100, 400, 10)]
    bench.run_until(395)
    assert left.heard == [b"l!"] * 15
    assert right.heard == [b"r!"] * 15
    assert {at // MS % 20 for at in left.requested_at if at > 200 * MS} == {10}
    assert {at // MS % 20 for at in right.requested_at if at > 200 * MS} == {0}
    assert bench.states("left")[-1] is bench.states("right")[-1] is LinkState.RUNNING


def test_what_came_while_the_thread_was_held_up_is_heard_before_anything_is_asked() -> None:
    """An answer that lies in the port is no missing answer: whoever counts those is asked behind it."""
    bench = Bench()
    order: list[str] = []
    talker = bench.talker
    receive, requests = talker.receive, talker.requests

    def slow(chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        order.append(chunk.decode())
        if chunk == b"a":  # the system runs others for 60 ms, and the device speaks
            bench.now_ns += 60 * MS
            bench.say(b"b")
        yield from receive(chunk, stamp_ns)

    def noted(now_ns: int) -> Sequence[bytes | SetBaudRate]:
        order.append("asked")
        return requests(now_ns)

    talker.receive, talker.requests = slow, noted  # type: ignore[method-assign]
    bench.plan.append((100 * MS, lambda: bench.say(b"a")))
    bench.run_until(200)
    at = order.index("a")
    assert order[at : at + 3] == ["a", "b", "asked"]


def test_readings_and_events_come_in_order() -> None:
    bench = Bench()
    bench.say_from_to(50, 1000)
    bench.run_until(1000)
    assert bench.states() == [LinkState.SILENT, LinkState.RUNNING]
    assert bench.readings() == 10
    health = bench.reader.health()
    assert health.is_open
    assert health.openings == 1
    source = health.sources["front"]
    assert source.state is LinkState.RUNNING
    assert source.readings == 10
    assert source.rate_hz == pytest.approx(10.0)
    assert source.age_ns is not None
    assert source.age_ns <= 100 * MS


def test_bytes_and_line_speed_keep_their_order() -> None:
    bench = Bench()
    bench.talker.outbox = [b"SS115200\n", SetBaudRate(115200), b"BM\n"]
    bench.run_until(50)
    assert bench.port.done == [b"SS115200\n", 115200, b"BM\n"]


def test_silence_is_told_in_time_and_the_conversation_starts_anew() -> None:
    bench = Bench()
    bench.say_from_to(50, 1000)
    bench.run_until(3000)
    told_ms, state, text = bench.events()[1 + bench.states().index(LinkState.RUNNING)]
    assert state is LinkState.SILENT
    assert told_ms - 950 <= 300 + 20
    assert "no reading for" in text
    assert bench.talker.connected_at[1] - told_ms * MS == pytest.approx(400 * MS, abs=20 * MS)
    bench.say_from_to(3000, 4000)
    bench.run_until(4000)
    assert bench.states()[-1] is LinkState.RUNNING


def test_a_pause_is_told_but_costs_no_reset() -> None:
    """Wheels keep their count: it went on while nothing was heard."""
    bench = Bench()
    bench.say_from_to(50, 1000)
    bench.say_from_to(1500, 3000)
    bench.run_until(3000)
    assert bench.states() == [LinkState.SILENT, LinkState.RUNNING, LinkState.SILENT, LinkState.RUNNING]
    assert len(bench.talker.connected_at) == 1


def test_late_and_bunched_deliveries_are_no_silence() -> None:
    """100 readings a second through a hub that holds them back for up to 45 ms: no alarm; their end is seen in time."""
    bench = Bench()
    bench.talker.silence_limit_ns = silence_limit(10 * MS)
    delay = random.Random(5)
    held_until_ms = 0
    for ms in range(50, 20_000, 10):
        if ms >= held_until_ms:
            held_until_ms = ms + delay.randrange(0, 46)
        bench.plan.append((held_until_ms * MS, bench.say))
    bench.run_until(20_000)
    assert bench.states() == [LinkState.SILENT, LinkState.RUNNING]
    last_ms = bench.plan[-1][0] // MS if bench.plan else held_until_ms
    bench.run_until(20_300)
    told_ms, state, _ = bench.events()[-1]
    assert state is LinkState.SILENT
    assert told_ms - last_ms <= 60 + 20


def test_a_hundred_readings_a_second_are_missed_after_three_periods() -> None:
    bench = Bench()
    bench.talker.silence_limit_ns = silence_limit(10 * MS)
    bench.say_from_to(50, 3_000, 10)
    bench.run_until(3_200)
    told_ms, state, _ = bench.events()[2]
    assert state is LinkState.SILENT
    assert told_ms - 2_990 in (30, 31)


def test_a_wait_right_after_a_silence_buys_no_time_for_the_next_one() -> None:
    """A device that needs 28 ms for its second reading, once it is back, is missed after three periods all the same."""
    bench = Bench()
    bench.talker.silence_limit_ns = silence_limit(10 * MS)
    bench.say_from_to(50, 3_000, 10)
    bench.plan.append((3_400 * MS, bench.say))
    bench.say_from_to(3_428, 5_000, 10)
    bench.run_until(5_200)
    told_ms, state, _ = bench.events()[-1]
    assert state is LinkState.SILENT
    assert told_ms - 4_998 in (30, 31)


def test_readings_that_are_held_back_get_more_time_and_it_is_taken_back_later() -> None:
    """A hub that delivers every 34 ms for a while: told once at most, until 20 s after the last of them."""
    bench = Bench()
    bench.talker.silence_limit_ns = silence_limit(10 * MS)
    bench.say_from_to(50, 3_000, 10)
    for ms in range(3_000, 6_000, 34):
        bench.plan += 3 * [(ms * MS, bench.say)]
    bench.say_from_to(6_010, 10_000, 10)
    bench.run_until(9_900)
    assert bench.states()[1:] in ([LinkState.RUNNING], [LinkState.RUNNING, LinkState.SILENT, LinkState.RUNNING])
    before = len(bench.states())
    bench.run_until(10_200)
    told_ms, state, _ = bench.events()[before]
    assert state is LinkState.SILENT
    assert 50 <= told_ms - 9_990 <= 53, "half as much again as 34 ms"
    bench.say_from_to(10_500, 36_000, 10)
    bench.run_until(35_900)
    before = len(bench.states())
    bench.run_until(36_200)
    told_ms, state, _ = bench.events()[before]
    assert state is LinkState.SILENT
    assert told_ms - 35_990 in (30, 31)


@pytest.mark.parametrize("late_ms", [8, 25, 45])
def test_a_thread_that_wakes_late_tells_nothing_of_what_came_meanwhile(late_ms: int) -> None:
    """Readings lie in the port while this thread waits for its turn: what was not listened to is no silence."""
    bench = Bench()
    bench.talker.silence_limit_ns = silence_limit(10 * MS)
    bench.say_from_to(50, 3_000, 10)
    bench.run_until(2_900)

    def sleep_on() -> None:
        bench.now_ns += late_ms * MS

    for ms in range(3_000, 6_000, 100):  # the thread sleeps from 1 ms after a reading on, and finds the next ones late
        spoken = [at for at in range(ms, ms + 100, 10) if not ms < at <= ms + 1 + late_ms]
        bench.plan += [(at * MS, bench.say) for at in spoken] + [((ms + 1) * MS, sleep_on)]
        bench.plan += [((ms + 1 + late_ms) * MS, bench.say)]
    bench.plan.sort(key=lambda each: each[0])
    bench.run_until(5_900)
    assert bench.states()[2:] == []


@pytest.mark.parametrize("late_ms", [6, 20, 50, 100])
@pytest.mark.parametrize("period_ms", [10, 25, 100, 200])
def test_a_thread_that_is_late_at_every_turn_still_tells_a_silence(period_ms: int, late_ms: int) -> None:
    """However many hold-ups are forgiven: 500 ms after the last reading, the longest hold-up, and one turn of such."""
    bench = Bench()
    bench.late_ns = late_ms * MS
    bench.talker.silence_limit_ns = silence_limit(period_ms * MS)
    bench.say_from_to(50, 5_000, period_ms)
    last_ms = bench.plan[-1][0] // MS
    bench.run_until(last_ms)
    before = len(bench.states())
    bench.run_until(8_000)
    told_ms = next(at for at, state, _ in bench.events()[before:] if state is LinkState.SILENT)
    assert told_ms - last_ms <= 500 + late_ms + 2 * (20 + late_ms)


def test_a_device_slower_than_it_was_told_to_be_gets_three_of_its_own_periods() -> None:
    bench = Bench()
    bench.talker.silence_limit_ns = silence_limit(20 * MS)
    bench.say_from_to(50, 5_050, 80)
    bench.run_until(1_000)
    settled = len(bench.states())
    bench.run_until(5_000)
    assert len(bench.states()) == settled, "known after a few readings"
    bench.run_until(6_000)
    told_ms, state, _ = bench.events()[settled]
    assert state is LinkState.SILENT
    assert told_ms - 5_010 <= 3 * 80 + 20


def test_readings_in_pairs_are_no_silence_between_them() -> None:
    """Two nodes that send at their own times, ten times a second, where a hundred were configured."""
    bench = Bench()
    bench.talker.silence_limit_ns = silence_limit(10 * MS)
    bench.say_from_to(50, 5_000, 100)
    bench.say_from_to(54, 5_000, 100)
    bench.plan.sort(key=lambda each: each[0])
    bench.run_until(1_500)
    settled = len(bench.states())
    bench.run_until(5_000)
    assert len(bench.states()) == settled


def test_our_own_pause_is_no_silence_of_the_device() -> None:
    """This thread did not run for 2 s, so it did not ask: the device could not answer."""
    bench = Bench()
    bench.say_from_to(50, 1000)

    def pause() -> None:
        bench.now_ns += 2_000 * MS

    bench.plan.append((1000 * MS, pause))
    bench.say_from_to(3050, 4000)
    bench.run_until(4000)
    assert bench.states() == [LinkState.SILENT, LinkState.RUNNING]
    bench.run_until(4500)
    assert bench.states()[-1] is LinkState.SILENT


def test_a_device_that_comes_and_goes_is_not_restarted_in_a_rush() -> None:
    """A reading every 950 ms with a limit of 300 ms: restarts wait longer and longer, but never end."""
    bench = Bench()
    bench.say_from_to(0, 20_000, 950)
    bench.run_until(20_000)
    gaps = [b - a for a, b in pairwise(bench.talker.connected_at)]
    assert len(gaps) > 10
    assert min(gaps[5:]) >= 790 * MS
    assert max(gaps) <= 2_000 * MS
    assert bench.states()[-1] in (LinkState.SILENT, LinkState.RUNNING)


def test_endless_set_up_is_begun_anew() -> None:
    bench = Bench()
    bench.plan = [(100 * MS, lambda: setattr(bench.talker, "state", LinkState.STARTING))]
    bench.run_until(45_000)
    assert len(bench.talker.connected_at) == 3
    assert bench.states()[:2] == [LinkState.SILENT, LinkState.STARTING]


def test_a_lost_wire_is_absent_at_once_and_comes_back() -> None:
    bench = Bench()
    bench.say_from_to(20, 500)
    bench.run_until(500)
    bench.port.lost = "/dev/x was lost"
    bench.reader.step()
    assert bench.events()[-1] == (bench.now_ns // MS, LinkState.ABSENT, "/dev/x was lost")
    assert bench.ports[0].closed
    lost_ns = bench.now_ns
    bench.say_from_to(700, 1500)
    bench.run_until(1500)
    assert len(bench.ports) == 2
    assert bench.talker.connected_at[-1] - lost_ns <= 150 * MS
    assert bench.states()[-2:] == [LinkState.SILENT, LinkState.RUNNING]
    assert not bench.reader.health().drops


def test_opening_is_tried_for_ever_never_rarer_than_each_second() -> None:
    bench = Bench()
    bench.opening_fails = PortAbsent("no /dev/x: is it plugged in?")
    bench.run_until(60_000)
    gaps = [b - a for a, b in pairwise(bench.attempts)]
    assert max(gaps) <= 1_000 * MS + 1
    assert gaps[0] >= 90 * MS
    assert bench.events() == [(0, LinkState.ABSENT, "no /dev/x: is it plugged in?")], "told once"
    bench.opening_fails = None
    bench.say_from_to(60_500, 62_000)
    bench.run_until(62_000)
    assert bench.states()[-1] is LinkState.RUNNING


def test_a_failing_write_gives_the_wire_up() -> None:
    bench = Bench()
    bench.run_until(100)
    bench.port.writable = False
    bench.talker.outbox = [b"?"]
    bench.run_until(140)
    assert bench.states()[-1] is LinkState.ABSENT


def test_a_wire_on_which_nothing_at_all_is_heard_is_opened_anew_quietly() -> None:
    bench = Bench()
    bench.silence_reopen_s = 2.0
    bench.run_until(9_000)
    assert len(bench.ports) == pytest.approx(5, abs=1)
    assert all(port.closed for port in bench.ports[:-1])
    assert set(bench.states()) == {LinkState.SILENT}


def test_port_drops_survive_reopening() -> None:
    bench = Bench()
    bench.run_until(100)
    bench.port.drops["tx_full"] = 3
    bench.port.lost = "gone"
    bench.run_until(400)
    bench.port.drops["tx_full"] = 2
    assert bench.reader.health().drops == {"tx_full": 5}


@pytest.mark.parametrize("where", ["receive", "requests", "connected"])
def test_a_bug_in_one_conversation_hurts_no_other(where: str, caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench("front", "rear")
    bench.say_from_to(50, 10_000)
    bench.run_until(0 if where == "connected" else 500)
    bench.talkers["front"].fail_in = where
    with caplog.at_level(logging.ERROR):
        bench.run_until(5_000)
    assert bench.readings("rear") == 50
    assert bench.states("rear") == [LinkState.SILENT, LinkState.RUNNING]
    assert bench.states()[-1] is LinkState.SILENT
    assert "bug" in bench.events()[-1][2]
    health = bench.reader.health().sources["front"]
    assert health.bugs == health.counters.drops["bug"] == pytest.approx(5, abs=1)
    tracebacks = [record for record in caplog.records if record.exc_info]
    assert len(tracebacks) == 1, "one a minute"
    bench.talkers["front"].fail_in = None
    bench.run_until(7_000)
    assert bench.states()[-1] is LinkState.RUNNING


def test_a_property_that_raises_is_a_bug_too() -> None:
    bench = Bench("front", "rear")

    class Broken(Talker):
        @property
        def state(self) -> LinkState:
            raise RuntimeError("no state")

        @state.setter
        def state(self, value: LinkState) -> None:
            pass

    talkers: dict[str, Any] = {"front": Broken(), "rear": bench.talkers["rear"]}
    bench.reader = WireReader("bench", bench.open, talkers, bench.sink, clock=lambda: bench.now_ns, wait=bench.wait)
    bench.say_from_to(50, 1_000)
    bench.run_until(1_000)
    assert bench.readings("rear") == 10


def test_events_tell_identity_and_trouble_but_not_in_a_flood() -> None:
    bench = Bench()
    bench.say_from_to(0, 10_000, 10)
    numbers = iter(range(10_000))
    bench.plan += [
        (ms * MS, lambda: setattr(bench.talker, "trouble", f"bad {next(numbers)}")) for ms in range(0, 5000, 20)
    ]
    bench.plan.sort(key=lambda step: step[0])
    bench.run_until(1_000)
    bench.talker.identity = Identity(vendor="Maker")
    bench.run_until(5_000)
    assert 5 <= len(bench.events()) <= 9
    identities = [item.identity for _, _, item in bench.items if isinstance(item, DeviceEvent)]
    assert identities[-1] == Identity(vendor="Maker")


def test_the_log_has_one_line_per_cause_per_minute(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()
    with caplog.at_level(logging.INFO):
        for start in range(0, 90_000, 1_000):  # comes and goes once a second
            bench.say_from_to(start, start + 500, 100)
        bench.run_until(90_000)
    lines = [record.getMessage() for record in caplog.records]
    assert len(bench.events()) > 100
    assert len(lines) <= 6, "twice each, the start in silence, and running again after the trouble that was told"
    assert any("times more" in line for line in lines)


def test_the_log_has_the_first_silence_soon_after_a_start_in_silence(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()
    with caplog.at_level(logging.INFO):
        bench.run_until(1_000)
        bench.say_from_to(1_000, 2_000)
        bench.run_until(2_400)
        bench.talker.trouble = "the left node does not answer"
        bench.run_until(5_000)
        bench.talker.trouble = None
        bench.say_from_to(5_000, 6_000)
        bench.run_until(5_500)
    lines = [record.getMessage() for record in caplog.records if record.name == "drivers.reader"]
    assert [line.split(": ")[1] for line in lines] == ["silent", "running", "silent", "silent", "running"]
    assert "no answer yet" in lines[0]
    assert "no reading for" in lines[2]
    assert "the left node does not answer" in lines[3]


def test_the_tap_hears_everything_in_order() -> None:
    heard: list[tuple[Direction, int, object]] = []
    bench = Bench(tap=lambda direction, stamp_ns, item: heard.append((direction, stamp_ns, item)))
    bench.talker.outbox = [b"?", SetBaudRate(9600)]
    bench.plan = [(30 * MS, lambda: bench.say(b"ab!"))]
    bench.run_until(40)
    bench.port.lost = "gone"
    bench.reader.step()
    assert heard[0] == (Direction.CONNECTED, 0, "front")
    assert [(direction, item) for direction, _, item in heard[1:] if direction is not Direction.TURN] == [
        (Direction.OUT, b"?"),
        (Direction.OUT, SetBaudRate(9600)),
        (Direction.IN, b"ab!"),
        (Direction.LOST, "gone"),
    ]
    turns = [stamp_ns for direction, stamp_ns, _ in heard if direction is Direction.TURN]
    assert turns == bench.talker.requested_at, "every time given to requests(), so that a replay can repeat it"
    assert heard[1][0] is Direction.TURN


def test_asked_to_start_anew_every_conversation_begins_from_reset() -> None:
    heard: list[tuple[Direction, object]] = []
    bench = Bench("front", "rear", tap=lambda direction, _stamp_ns, item: heard.append((direction, item)))
    bench.run_until(40)
    before = [item for direction, item in heard if direction is Direction.CONNECTED]
    assert before == ["front", "rear"]
    bench.reader.start_anew()
    bench.run_until(200)
    assert [item for direction, item in heard if direction is Direction.CONNECTED] == [*before, "front", "rear"]
    assert bench.reader.health().openings == 1


def test_close_says_farewell() -> None:
    bench = Bench("front", "rear")
    bench.talkers["front"].fail_in = "farewell"
    bench.run_until(50)
    assert bench.reader.stop()
    assert bench.port.done == [b"bye"], "a bug in one farewell does not stop the other"
    assert bench.port.closed


def test_close_of_a_stuck_wire() -> None:
    bench = Bench()
    bench.run_until(50)
    bench.port.writable = False
    bench.reader.close()
    assert bench.port.closed


# ---- the thread


class LivePort:
    """A port of real time: silent, or hanging, or raising what no port should."""

    silence_reopen_s: float | None = None

    def __init__(self, hang: threading.Event | None = None) -> None:
        self.drops: dict[str, int] = {}
        self.hang = hang
        self.written: list[bytes] = []
        self.closed = False
        self.explode = False

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]:
        if self.explode:
            self.explode = False
            raise ZeroDivisionError("bug in a port")
        if self.hang is not None:
            self.hang.wait(2 * GIVE_UP_S)
        time.sleep(timeout_s)
        return [(b"!", time.monotonic_ns())]

    def write(self, item: bytes) -> None:
        self.written.append(item)

    def set_baud(self, bits_per_s: int) -> None: ...

    def close(self) -> None:
        self.closed = True

    def fileno(self) -> int | None:
        return None


def test_thread_runs_and_stops_with_farewell() -> None:
    port = LivePort()
    queue: BoundedQueue[Reading | DeviceEvent] = BoundedQueue(1000)
    reader: WireReader[bytes] = WireReader(
        "live", lambda: port, {"front": Talker()}, queue.put, clock=time.monotonic_ns
    )
    reader.start()
    wait_for("the thread", lambda: len(queue) > 5)
    assert reader.health().sources["front"].state is LinkState.RUNNING
    assert reader.stop(GIVE_UP_S)
    assert port.written == [b"bye"]
    assert port.closed


def test_thread_survives_a_bug_in_the_port() -> None:
    ports = [LivePort(), LivePort()]
    ports[0].explode = True
    waiting = iter(ports)
    queue: BoundedQueue[Reading | DeviceEvent] = BoundedQueue(1000)
    reader: WireReader[bytes] = WireReader(
        "live", lambda: next(waiting), {"front": Talker()}, queue.put, clock=time.monotonic_ns
    )
    reader.start()
    wait_for("the thread", lambda: reader.health().sources["front"].readings > 3)
    assert reader.stop(GIVE_UP_S)
    assert ports[0].closed


def test_stop_does_not_wait_for_a_hanging_wire() -> None:
    hang = threading.Event()
    reader: WireReader[bytes] = WireReader(
        "live", lambda: LivePort(hang), {"front": Talker()}, lambda source, item: None, clock=time.monotonic_ns
    )
    reader.start()
    wait_for("the thread", lambda: reader.health().is_open)
    started = time.monotonic()
    assert not reader.stop(0.2)
    assert time.monotonic() - started < GIVE_UP_S, "the wire hangs for twice as long"
    hang.set()


# ---- the queue


def event(text: str) -> DeviceEvent:
    return DeviceEvent(0, LinkState.SILENT, text)


def test_queue_drops_the_oldest_reading_of_the_loudest_and_keeps_events() -> None:
    queue: BoundedQueue[Reading | DeviceEvent] = BoundedQueue(5)
    queue.put("quiet", reading_at(1))
    queue.put("loud", event("first"))
    for stamp in range(10, 20):
        queue.put("loud", reading_at(stamp))
    items = queue.get_all(0.0)
    assert [(source, item.stamp_ns) for source, item in items] == [
        ("quiet", 1),
        ("loud", 0),
        ("loud", 17),
        ("loud", 18),
        ("loud", 19),
    ]
    assert queue.dropped() == {"loud": 7}
    assert queue.get(0.0) is None


def test_queue_of_events_only_drops_the_oldest() -> None:
    queue: BoundedQueue[Reading | DeviceEvent] = BoundedQueue(2)
    for text in "abc":
        queue.put("x", event(text))
    assert [item.text for _, item in queue.get_all(0.0) if isinstance(item, DeviceEvent)] == ["b", "c"]
    assert queue.dropped() == {"x": 1}


def test_queue_wakes_the_waiting() -> None:
    queue: BoundedQueue[Reading | DeviceEvent] = BoundedQueue(2)
    threading.Timer(0.05, queue.put, ("x", reading_at(7))).start()
    got = queue.get(GIVE_UP_S)
    assert got is not None
    assert got[1].stamp_ns == 7


def test_queue_counts_stay_right_when_taken_one_by_one() -> None:
    queue: BoundedQueue[Reading | DeviceEvent] = BoundedQueue(3)
    for stamp in range(100):
        queue.put("x", reading_at(stamp))
        if stamp % 2:
            assert queue.get(0.0) is not None
    assert len(queue) == 2
    assert queue.dropped() == {"x": 48}


def test_a_queue_needs_room() -> None:
    with pytest.raises(ValueError):
        BoundedQueue[DeviceEvent](0)
