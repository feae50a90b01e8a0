"""A conversation whose questions are written as one script that reads from top to bottom. Pure.

    class MyConversation(ScriptedConversation[MyMessage]):
        _messages   bytes -> whole messages        _take    a message -> readings
        _life       the script: yields a Step, is sent the message the step waited for, or None when time was up
        _forget     what a reopened wire makes void

The base class owns the clockwork: time-outs, the state, silence, and a stall of our own during which nothing was read.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from drivers.conversation import SetBaudRate
from drivers.readings import ClockFit, Identity, LinkState, Reading, SourceCounters

_MS = 1_000_000
FIRST_READING_NS = 4_000 * _MS  # a motor takes seconds to spin up
SILENCE_CAP_NS = 500 * _MS
RESTART_NS = 450 * _MS  # without a reading for this long the device is asked what is the matter
GARBLED_NS = 2_000 * _MS  # so long when bytes do come, but nothing is whole
STALL_NS = 150 * _MS  # we ourselves were not called for so long: what came meanwhile must be read first

MessageT = TypeVar("MessageT")


def _nothing(_: object) -> bool:
    return False


@dataclass(frozen=True, slots=True)
class Step(Generic[MessageT]):
    """Send this, then wait for a message that `awaits` takes, at most wait_ns; prolonged: counted from each reading."""

    send: tuple[bytes | SetBaudRate, ...] = ()
    awaits: Callable[[MessageT], bool] = _nothing
    wait_ns: int = 0
    prolonged: bool = False


class ScriptedConversation(ABC, Generic[MessageT]):
    """A `Conversation[bytes]` that runs a script. See the module's docstring for what a device adds."""

    def __init__(self) -> None:
        self._counters = SourceCounters()
        self._state = LinkState.SILENT
        self._trouble: str | None = None
        self._identity: Identity | None = None
        self._clear(0)

    def _clear(self, now_ns: int) -> None:
        self._script: Generator[Step[MessageT], MessageT | None, None] | None = None
        self._step: Step[MessageT] = Step()
        self._step_sent = True
        self._deadline_ns = now_ns
        self._asked_ns = now_ns  # newest call of requests()
        self._received_ns = now_ns
        self._read_ns = now_ns  # newest reading
        self._period_ns: float | None = None  # between two readings, while they are expected
        self._standing_trouble: str | None = None  # what is wrong although readings come

    # What a device adds.

    @abstractmethod
    def _messages(self, chunk: bytes, stamp_ns: int) -> Iterable[MessageT]:
        """Whole messages in what arrived."""

    @abstractmethod
    def _take(self, message: MessageT, stamp_ns: int) -> Iterable[Reading]:
        """Readings that a message completes."""

    @abstractmethod
    def _life(self) -> Generator[Step[MessageT], MessageT | None, None]:
        """The script. Must not end."""

    @abstractmethod
    def _forget(self) -> None:
        """Drop partial messages and what was agreed with the device."""

    # What a reader asks.

    @property
    def state(self) -> LinkState:
        """SILENT until the device answers, STARTING until readings flow, RUNNING while they do."""
        return self._state

    @property
    def trouble(self) -> str | None:
        """What is wrong now and how to repair it, in one line, or None."""
        return self._trouble

    @property
    def identity(self) -> Identity | None:
        """Who the device says it is, once it said so."""
        return self._identity

    @property
    def clock_fit(self) -> ClockFit | None:
        """The device's clock against the host's; None for a device without a clock."""
        return None

    @property
    def counters(self) -> SourceCounters:
        """What was counted since construction."""
        return self._counters

    @property
    def silence_limit_ns(self) -> int:
        """3 periods, at most 500 ms (but never less than 1.5 periods); generous while the motor spins up."""
        if self._period_ns is None or self._state is not LinkState.RUNNING:
            return FIRST_READING_NS
        return round(max(min(3 * self._period_ns, SILENCE_CAP_NS), 1.5 * self._period_ns))

    # How a reader drives.

    def connected(self, now_ns: int) -> None:
        """The wire was opened or reopened."""
        self._clear(now_ns)
        self._forget()
        self._state = LinkState.SILENT
        self._script = self._life()
        self._begin(next(self._script), now_ns)

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        """Take what arrived; yields finished readings."""
        self._counters.chunks += 1
        self._counters.bytes += len(chunk)
        self._received_ns = stamp_ns
        for message in self._messages(chunk, stamp_ns):
            for reading in self._take(message, stamp_ns):
                self._note_reading(stamp_ns)
                yield reading
            self._advance(message, stamp_ns)

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        """What is to be sent now; notices time-outs."""
        if self._script is None:
            return []
        self._notice_silence(now_ns)
        out: list[bytes | SetBaudRate] = []
        while not self._step_sent or now_ns >= self._deadline_ns:
            if not self._step_sent:
                out += self._step.send
                self._step_sent = True
                self._deadline_ns = now_ns + self._step.wait_ns
            else:
                self._begin(self._script.send(None), now_ns)
        return out

    @abstractmethod
    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """What leaves the device safe."""

    # The clockwork.

    def _advance(self, message: MessageT, now_ns: int) -> None:
        if self._script is not None and self._step_sent and self._step.awaits(message):
            self._begin(self._script.send(message), now_ns)

    def _begin(self, step: Step[MessageT], now_ns: int) -> None:
        self._step = step
        self._step_sent = not step.send
        self._deadline_ns = now_ns + step.wait_ns

    def _note_reading(self, now_ns: int) -> None:
        self._counters.readings += 1
        self._read_ns = now_ns
        self._state = LinkState.RUNNING
        self._trouble = self._standing_trouble
        if self._step.prolonged:
            wait_ns = RESTART_NS if self._period_ns is None else max(RESTART_NS, round(1.5 * self._period_ns))
            self._deadline_ns = now_ns + wait_ns

    def _notice_silence(self, now_ns: int) -> None:
        """Say that readings have stopped, long after the reader did; after a stall, read first what waits."""
        if now_ns - self._asked_ns > STALL_NS and now_ns - self._received_ns > STALL_NS:
            self._deadline_ns = max(self._deadline_ns, now_ns + STALL_NS // 3)
        elif self._state is LinkState.RUNNING and now_ns - self._read_ns > max(self.silence_limit_ns, RESTART_NS):
            self._state = LinkState.SILENT
            self._trouble = "scans have stopped: check the cable and the power supply; the driver keeps asking"
        self._asked_ns = now_ns

    # Pieces of scripts.

    def _watch(
        self, ends: Callable[[MessageT], bool] = _nothing, first_ns: int = FIRST_READING_NS
    ) -> Generator[Step[MessageT], MessageT | None, MessageT | None]:
        """Until readings stop, or a message comes that ends them; returns that message. first_ns: for the first one."""
        wait_ns = first_ns
        began_ns = self._read_ns
        while True:
            message = yield Step((), ends, wait_ns, prolonged=True)
            if message is not None:
                return message
            if not self._is_only_garbled(began_ns):
                self._state = LinkState.SILENT
                self._trouble = "no scans: check the cable and the power supply; the driver keeps asking"
                return None
            wait_ns = RESTART_NS // 2

    def _is_only_garbled(self, began_ns: int) -> bool:
        """Bytes still come, so a new start would not help; but not for ever."""
        has_read = self._read_ns > began_ns
        bytes_come = self._asked_ns - self._received_ns < STALL_NS
        return has_read and bytes_come and self._asked_ns - self._read_ns < GARBLED_NS


def pause(wait_ns: int) -> Step[MessageT]:
    """Wait, whatever comes."""
    return Step((), _nothing, wait_ns)
