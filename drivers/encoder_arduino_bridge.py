"""Micro-controller boards with the text protocol of ros_arduino_bridge: wheel counts, ping sonars, switches.

    question   answer           meaning                                     8N1, 57600 bit/s by habit
    b          57600            line speed; used as "are you there"         a question ends with CR
    e          201 -35          counts left and right, signed 32 bits       an answer ends with CR LF
    p 7        107              sonar at pin 7, cm                          one question at a time, no checksum
    d 4        0 or 1           digital input at pin 4
    else       Invalid Command  also an empty line

Answers do not say what they answer. So a question is put only when nothing is under way and nothing else comes, every
line is held against the form of the answer expected, and after anything odd the talk begins anew: an end of line, `b`,
and nothing is believed until the line speed has come, which no sonar (cm), input or pair of counts can be mistaken for.

A sketch without `b` answers it by Invalid Command, which is no value either: after 2 s of that it does in its place.

A board starts anew when its port is opened (DTR) and is deaf for 1 to 2 s: `b` is repeated until it answers.

This driver only asks: it moves no motor, sets no pin and resets no count.

Source: the firmware of hbrobotics/ros_arduino_bridge as run on a PC (protocol notes in docs/devices/arduino_bridge.md).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto

from drivers.conversation import MOST_SILENCE_NS, SetBaudRate, silence_limit
from drivers.errors import FrameError
from drivers.readings import (
    ChainReading,
    ClockFit,
    ContactLine,
    ContactReading,
    ContactState,
    Identity,
    LinkState,
    RangeReading,
    RangeStatus,
    Reading,
    SourceCounters,
    WheelReading,
)
from drivers.trips import Trips
from drivers.wheel_counts import WheelCounts

_MS = 1_000_000
_HELLO_PERIOD_NS = 250 * _MS
_OVERDUE_NS = 3_000 * _MS  # a board with a boot loader may need 2 s
_REFUSED_HELLOS = 8
_QUIET_NS = 20 * _MS  # after the line speed: answers to earlier, repeated questions come out first
_GAP_NS = 2 * _MS  # after an answer: what follows it unasked shows that the talk is out of step
_PATIENCE_NS = 150 * _MS
_PING_PATIENCE_NS = 250 * _MS  # the board waits for the echo
_REFUSED_PERIOD_NS = 1_000 * _MS
_DEAD_PIN_PERIOD_NS = 30_000 * _MS  # the firmware stands still for 1 s at a pin without a sonar
_GIVE_UP_AFTER = 2
_LONGEST_LINE = 64
_LOWEST_BAUD, _HIGHEST_BAUD = 1200, 4_000_000
_FARTHEST_CM = 1199  # below every line speed
_LONG_AGO = -(1 << 62)

INVALID_COMMAND = "Invalid Command"
_NUMBERS = re.compile(r"-?\d{1,10}(?: -?\d{1,10})?")


# ---- messages


def encode_question(letter: str, pin: int | None = None) -> bytes:
    """A question: a letter, perhaps a pin, CR."""
    return (letter if pin is None else f"{letter} {pin}").encode("ascii") + b"\r"


def decode_line(line: bytes) -> tuple[int, ...] | None:
    """The one or two numbers of an answer (CR LF taken off), None for Invalid Command. FrameError for anything else."""
    text = line.decode("ascii", "replace").strip(" ")  # some sketches print a blank before or after
    if text == INVALID_COMMAND:
        return None
    if not _NUMBERS.fullmatch(text):
        raise FrameError("bad_line", repr(text))
    numbers = tuple(int(word) for word in text.split(" "))
    if any(not -(1 << 31) <= number < 1 << 31 for number in numbers):
        raise FrameError("bad_line", repr(text))
    return numbers


def is_baud(numbers: Sequence[int] | None) -> bool:
    """Whether an answer is a line speed."""
    return numbers is not None and len(numbers) == 1 and _LOWEST_BAUD <= numbers[0] <= _HIGHEST_BAUD


# ---- what is asked in turn


@dataclass(slots=True, eq=False)
class _Task:
    """One question that is put again and again."""

    letter: str
    pin: int | None
    period_ns: int
    due_ns: int = 0
    misses: int = 0  # in a row
    refusals: int = 0  # in a row

    @property
    def name(self) -> str:
        return self.letter if self.pin is None else f"{self.letter} {self.pin}"


class _Phase(Enum):
    HELLO = auto()  # `b` is repeated until the line speed comes
    QUIET = auto()  # it came; what else is on its way comes out
    IDLE = auto()
    ASKED = auto()


class ArduinoBridgeConversation:
    """A board with any of wheel counts, ping sonars and switches.

    wheels: ask for counts.  pings: pins of sonars; a sonar's channel is its pin.  contacts: pins of switches, each with
    whether it is tripped when low.  *_rate_hz: of each.  max_ticks_per_s: no wheel counts faster.
    ping_range_max_m: farther values mean that nothing was seen.  zero_is_free: what a board says with 0 cm; the
    firmware says it for a sonar that is unplugged, so it is taken as "nothing known" unless this is True.
    baud_bps: of the line, for the time that an answer takes on it.
    """

    def __init__(
        self,
        *,
        wheels: bool = True,
        pings: Sequence[int] = (),
        contacts: Mapping[int, bool] | None = None,
        wheel_rate_hz: float = 30.0,
        ping_rate_hz: float = 5.0,
        contact_rate_hz: float = 20.0,
        max_ticks_per_s: float = 50_000.0,
        ping_range_max_m: float = 4.0,
        zero_is_free: bool = False,
        baud_bps: int = 57600,
    ) -> None:
        contacts = contacts or {}
        if not wheels and not pings and not contacts:
            raise ValueError("nothing to ask the board for: wheels, pings or contacts")
        if min(wheel_rate_hz, ping_rate_hz, contact_rate_hz) <= 0.0:
            raise ValueError("rates are above 0")
        self._active_low = dict(contacts)
        self._ping_range_max_m = ping_range_max_m
        self._zero_is_free = zero_is_free
        self._byte_ns = 10 * 1_000_000_000 // baud_bps
        periods = {"e": wheel_rate_hz, "p": ping_rate_hz, "d": contact_rate_hz}
        asked = [("e", None)] * wheels + [("p", pin) for pin in pings] + [("d", pin) for pin in contacts]
        self._tasks = [_Task(letter, pin, round(1e9 / periods[letter])) for letter, pin in asked]
        self._counters = SourceCounters()
        self._counts = WheelCounts(self._counters, max_ticks_per_s=max_ticks_per_s)
        self._identity: Identity | None = None
        self._stamps: dict[type[Reading], int] = {}
        self._restart(0)

    # ---- what a conversation shows

    @property
    def state(self) -> LinkState:
        if self._running:
            return LinkState.RUNNING
        return LinkState.STARTING if self._answered else LinkState.SILENT

    @property
    def trouble(self) -> str | None:
        if not self._answered:
            hint = "no answer from the board: check its USB cable, the sketch on it and the line speed"
            return hint if self._overdue else None
        troubles = (self.trouble_of(kind) for kind in _LETTERS.values())
        return "; ".join(trouble for trouble in troubles if trouble is not None) or None

    def trouble_of(self, kind: type[Reading]) -> str | None:
        """What is wrong with the wheels, the sonars or the switches."""
        troubled = [task for task in self._tasks if _LETTERS[task.letter] is kind]
        if any(task.refusals >= _GIVE_UP_AFTER for task in troubled if task.letter == "e"):
            return "the board has no wheel encoders in its sketch (`e` is an invalid command): build it with USE_BASE"
        if refused := [task.name for task in troubled if task.refusals >= _GIVE_UP_AFTER]:
            return f"the board does not know {', '.join(refused)}: check the sketch"
        if silent := [str(task.pin) for task in troubled if task.misses >= _GIVE_UP_AFTER and task.letter == "p"]:
            return f"no answer for the sonar at pin {', '.join(silent)}: check its plug"
        return None

    @property
    def identity(self) -> Identity | None:
        return self._identity

    @property
    def clock_fit(self) -> ClockFit | None:
        """The board tells no time."""
        return None

    @property
    def counters(self) -> SourceCounters:
        return self._counters

    @property
    def silence_limit_ns(self) -> int:
        return min(self.silence_limit_of(_LETTERS[task.letter]) for task in self._tasks)

    def silence_limit_of(self, kind: type[Reading]) -> int:
        """Three periods of that kind of reading."""
        periods = [task.period_ns for task in self._tasks if _LETTERS[task.letter] is kind]
        return silence_limit(min(periods, default=MOST_SILENCE_NS))

    # ---- how it is driven

    def connected(self, now_ns: int) -> None:
        self._restart(now_ns)

    def _restart(self, now_ns: int) -> None:
        self._buffer = bytearray()
        self._phase = _Phase.HELLO
        self._answered = self._running = self._overdue = False
        self._refused_hellos, self._hello_refused = 0, False  # in a row; the one under way
        self._connected_ns = now_ns
        self._due_ns = now_ns  # of the next step of the phase
        self._task: _Task | None = None
        self._asked_ns = now_ns
        self._gone: list[Reading] = []  # of sonars and switches that were not answered; told with the next chunk
        self._counts.restart()
        self._trips = Trips()
        for index, task in enumerate(self._tasks):
            task.misses = task.refusals = 0
            task.due_ns = now_ns + index  # the order of the first round

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        self._overdue = now_ns - self._connected_ns > _OVERDUE_NS
        if self._phase is _Phase.ASKED and now_ns >= self._due_ns:
            self._note_missing(now_ns)
        if now_ns < self.next_request_ns():
            return ()
        if self._phase is _Phase.HELLO:
            self._due_ns = now_ns + _HELLO_PERIOD_NS
            self._refused_hellos = self._refused_hellos + 1 if self._hello_refused else 0
            self._hello_refused = False
            self._buffer.clear()
            return (b"\r" + encode_question("b"),)  # the end of line: of whatever the board holds half of
        return (self._ask(now_ns),)

    def next_request_ns(self) -> int:
        """When requests() has something to say next, if nothing arrives before."""
        if self._phase is _Phase.IDLE or self._phase is _Phase.QUIET:
            return max(self._due_ns, min(task.due_ns for task in self._tasks))
        return self._due_ns

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        self._counters.chunks += 1
        self._counters.bytes += len(chunk)
        self._buffer += chunk
        while (end := self._buffer.find(b"\n")) >= 0:
            line = bytes(self._buffer[: end + 1])
            del self._buffer[: end + 1]
            reading = self._take_line(line, stamp_ns)
            if reading is not None:
                self._running = True
                self._counters.readings += 1
                yield reading
        yield from self._gone
        self._gone.clear()
        if len(self._buffer) > _LONGEST_LINE:
            self._counters.drop("noise_bytes", len(self._buffer))
            self._buffer.clear()

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """We moved nothing."""
        return ()

    # ---- out

    def _ask(self, now_ns: int) -> bytes:
        """The question that waits longest. Every one is put off by its period, so none can starve another."""
        task = min(self._tasks, key=lambda each: each.due_ns)
        missed = now_ns - task.due_ns > task.period_ns  # no backlog
        task.due_ns = (now_ns if missed else task.due_ns) + self._period_of(task)
        self._task = task
        self._phase = _Phase.ASKED
        self._asked_ns = now_ns
        self._due_ns = now_ns + (_PING_PATIENCE_NS if task.letter == "p" else _PATIENCE_NS)
        if self._buffer:
            self._counters.drop("noise_bytes", len(self._buffer))
            self._buffer.clear()
        return encode_question(task.letter, task.pin)

    def _period_of(self, task: _Task) -> int:
        if task.letter == "p" and task.misses >= _GIVE_UP_AFTER:
            return _DEAD_PIN_PERIOD_NS
        return max(task.period_ns, _REFUSED_PERIOD_NS) if task.refusals >= _GIVE_UP_AFTER else task.period_ns

    def _note_missing(self, now_ns: int) -> None:
        assert self._task is not None
        self._counters.drop("unanswered")
        self._task.misses += 1
        if self._task.misses >= _GIVE_UP_AFTER:
            self._task.due_ns = max(self._task.due_ns, now_ns + self._period_of(self._task) // 2)
            self._gone.extend(self._nothing_known(self._task, now_ns))
        self._begin_anew(now_ns)

    def _nothing_known(self, task: _Task, now_ns: int) -> Iterator[Reading]:
        """So that nobody goes on believing what a sonar or a switch said last."""
        if task.pin is not None and task.letter == "p":
            stale = RangeReading(task.pin, math.nan, RangeStatus.STALE)
            yield ChainReading(self._rising(ChainReading, now_ns), (stale,))
        elif task.pin is not None:
            unknown = ContactLine(task.pin, ContactState.UNKNOWN)
            yield ContactReading(self._rising(ContactReading, now_ns), (unknown,))

    def _begin_anew(self, now_ns: int) -> None:
        """Out of step: nothing is believed until the line speed has come."""
        self._phase = _Phase.HELLO
        self._task = None
        self._due_ns = now_ns + _GAP_NS

    # ---- in

    def _take_line(self, line: bytes, stamp_ns: int) -> Reading | None:
        """One line with its end, that arrived at stamp_ns."""
        try:
            if not line.endswith(b"\r\n"):
                raise FrameError("bad_line", repr(line))
            numbers = decode_line(line[:-2])
        except FrameError as error:
            if self._answered:
                self._counters.drop(error.reason)  # before, it is the greeting of a sketch
            if self._phase in (_Phase.ASKED, _Phase.IDLE):
                self._begin_anew(stamp_ns)
            return None
        match self._phase:
            case _Phase.HELLO | _Phase.QUIET:
                self._take_hello(numbers, stamp_ns)
            case _Phase.IDLE:
                self._counters.drop("unasked_line")
                self._begin_anew(stamp_ns)
            case _Phase.ASKED:
                return self._take_answer(numbers, len(line), stamp_ns)
        return None

    def _take_hello(self, numbers: tuple[int, ...] | None, stamp_ns: int) -> None:
        self._hello_refused = self._hello_refused or numbers is None
        knows_no_b = numbers is None and self._refused_hellos >= _REFUSED_HELLOS
        if is_baud(numbers) or knows_no_b:
            self._answered = True
            self._identity = Identity(model="ros_arduino_bridge", firmware=f"{numbers[0]} bit/s" if numbers else "")
            self._phase = _Phase.QUIET
        if is_baud(numbers):
            self._refused_hellos, self._hello_refused = 0, False
        if self._phase is _Phase.QUIET:
            self._due_ns = stamp_ns + _QUIET_NS

    def _take_answer(self, numbers: tuple[int, ...] | None, size: int, stamp_ns: int) -> Reading | None:
        task = self._task
        assert task is not None
        if numbers is None:
            task.refusals += 1
            self._counters.drop("refused")
        elif not self._has_form(task, numbers):
            self._counters.drop("stray_answer")
            self._begin_anew(stamp_ns)
            return None
        self._task = None
        self._phase = _Phase.IDLE
        self._due_ns = stamp_ns + _GAP_NS
        task.misses = 0
        if numbers is None:
            return None
        task.refusals = 0
        sent_ns = stamp_ns - size * self._byte_ns  # when the board began to send
        if task.letter == "p":  # a ping takes as long as its echo, and is not stamped by its answer
            return self._understand(task, numbers, sent_ns)
        return self._understand(task, numbers, self._trips.sampled_ns(self._asked_ns, sent_ns))

    def _has_form(self, task: _Task, numbers: tuple[int, ...]) -> bool:
        match task.letter:
            case "e":
                return len(numbers) == 2
            case "p":
                return len(numbers) == 1 and 0 <= numbers[0] <= _FARTHEST_CM
            case _:
                return numbers in ((0,), (1,))

    def _understand(self, task: _Task, numbers: tuple[int, ...], sent_ns: int) -> Reading | None:
        if task.letter == "e":
            return self._counts.advance(numbers[0], numbers[1], sent_ns)
        assert task.pin is not None
        if task.letter == "p":
            # It fired as soon as the question was in.
            fired_ns = self._asked_ns + len(encode_question("p", task.pin)) * self._byte_ns
            return ChainReading(self._rising(ChainReading, fired_ns), (self._range(task.pin, numbers[0]),))
        tripped = bool(numbers[0]) is not self._active_low[task.pin]
        state = ContactState.TRIPPED if tripped else ContactState.CLEAR
        return ContactReading(self._rising(ContactReading, sent_ns), (ContactLine(task.pin, state),))

    def _range(self, pin: int, centimetres: int) -> RangeReading:
        range_m = centimetres / 100.0
        if centimetres == 0 and not self._zero_is_free:
            return RangeReading(pin, math.nan, RangeStatus.INVALID)
        if centimetres == 0 or range_m > self._ping_range_max_m:
            return RangeReading(pin, math.inf, RangeStatus.NO_RETURN)
        return RangeReading(pin, range_m, RangeStatus.ECHO)

    def _rising(self, kind: type[Reading], stamp_ns: int) -> int:
        self._stamps[kind] = max(stamp_ns, self._stamps.get(kind, _LONG_AGO) + 1)
        return self._stamps[kind]


_LETTERS: dict[str, type[Reading]] = {"e": WheelReading, "p": ChainReading, "d": ContactReading}
