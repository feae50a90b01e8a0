"""The loop that joins wires and conversations: opens, reads, asks, notices silence, comes back, counts.

One thread per wire; several conversations may share a CAN wire, each then sees every frame. The loop never gives up:

    port cannot be opened or is lost   ABSENT at once; tried again after 0.1 s, later up to 1 s, for ever
    no reading within silence_limit    SILENT at once, while it goes on asking; after 0.4 s more (0.6 s in all, at
       (three of its usual periods)    least) it starts from reset, then again after up to 1 s each; only time counts
                                       in which this thread was there to listen, see _hear_out
    set-up takes for ever              the conversation starts from reset after 20 s
    an exception in a conversation     a bug: logged with its traceback, counted, that conversation alone restarts

`step` does one turn of the loop and may be called without a thread: tests own clock and port.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic

from drivers.conversation import MOST_SILENCE_NS, Conversation, SetBaudRate, WireT
from drivers.errors import PortError
from drivers.ports import Clock, Direction, Port, Tap
from drivers.reader_memory import LONGEST_BACKOFF_NS, Backoff, HoldUps, Rate, RateLimitedLog, UsualPeriod
from drivers.readings import ClockFit, DeviceEvent, Identity, LinkState, Reading, SourceCounters

log = logging.getLogger(__name__)

Sink = Callable[[str, Reading | DeviceEvent], None]
"""Where readings and events go: (source, item). Must not block; BoundedQueue.put is one."""

POLL_PERIOD_NS = 20_000_000  # requests() is called at least so often, of conversations that do not tell when
LONGEST_TURN_NS = 60_000_000  # even where all tell: what others post waits no longer
_SILENCE_PATIENCE_NS = 400_000_000  # a device that only paused keeps its set-up, and wheels their count
_SHORTEST_BEFORE_RESET_NS = 600_000_000
_SILENCE_OF_STRANGERS_NS = 200_000_000  # until a source's usual period is known
_MUCH_LONGER = 1.5  # less is the jitter of its deliveries
_SETTLING_NS = 100_000_000  # waits that begin so soon after it runs again are the device's, and teach nothing
_CHECK_PERIOD_NS = 50_000_000  # words are looked at so often; a change of state, and silence, at once
_HELD_UP_NS = 5_000_000  # a turn that took so much longer than it should was held up: by the system, or other threads
_SETUP_LIMIT_NS = 20_000_000_000  # spin-up and the search for a line speed included
_EVENT_PERIOD_NS = 1_000_000_000  # between two events that tell the same state in other words
_SHORTEST_WAIT_S = 0.0005
_POSTED_MAX = 16


@dataclass(frozen=True, slots=True)
class SourceHealth:
    """One source at one instant, for the health report.

    since_ns: when the state was entered.  trouble: in words, with the repair, or None.  rate_hz: readings a second.
    age_ns: since the last reading, None if there was none.  restarts: conversations begun anew.  bugs: exceptions.
    """

    name: str
    state: LinkState
    since_ns: int
    trouble: str | None
    identity: Identity | None
    rate_hz: float
    age_ns: int | None
    readings: int
    restarts: int
    bugs: int
    counters: SourceCounters
    clock_fit: ClockFit | None


@dataclass(frozen=True, slots=True)
class WireHealth:
    """One wire at one instant.

    openings: how often it was opened.  attempts: how often that was tried.  drops: what the port threw away, by reason.
    """

    name: str
    is_open: bool
    trouble: str | None
    openings: int
    drops: dict[str, int]
    sources: dict[str, SourceHealth] = field(default_factory=dict)
    attempts: int = 0


class WireReader(Generic[WireT]):
    """Owns one wire and the conversations on it.

    open_port: opens the wire, raising PortError when it cannot.  conversations: by source name.  clock: monotonic
    nanoseconds.  tap: hears every item in and out, for the recording.  wait: sleeps between attempts to open (tests
    hand in one that cranks their clock); by default a wait that stop() ends.
    """

    def __init__(
        self,
        name: str,
        open_port: Callable[[], Port[WireT]],
        conversations: Mapping[str, Conversation[WireT]],
        sink: Sink,
        *,
        clock: Clock,
        tap: Tap | None = None,
        wait: Callable[[float], object] | None = None,
    ) -> None:
        self.name = name
        self._open_port: Callable[[], Port[WireT]] = open_port
        self._clock = clock
        self._tap = tap
        self._stopping = threading.Event()
        self._start_anew = threading.Event()
        self._posted: deque[WireT] = deque(maxlen=_POSTED_MAX)
        self._wait = wait if wait is not None else self._stopping.wait
        self._lock = threading.RLock()  # held while a batch is worked on, never while waiting for one
        self._port: Port[WireT] | None = None
        self._port_trouble: str | None = "not opened yet"
        self._past_drops: dict[str, int] = {}
        self._openings = self._attempts = 0
        self._backoff = Backoff()
        self._heard_ns = 0
        self._turned_ns = 0  # when the loop last had its turn
        self._thread: threading.Thread | None = None
        self._log = RateLimitedLog()
        self._sources: list[_Source[WireT]] = [
            _Source(source, conversation, sink, self._log, tap) for source, conversation in conversations.items()
        ]

    # ---- the thread

    def start(self) -> None:
        """Start the thread. A reader starts once."""
        self._thread = threading.Thread(target=self.run, name=f"wire {self.name}", daemon=True)
        self._thread.start()

    def stop(self, deadline_s: float = 1.0) -> bool:
        """Say farewell to the devices, close the wire, end the thread; False if that took longer than deadline_s."""
        self._stopping.set()
        if self._thread is None:
            self.close()
            return True
        self._thread.join(deadline_s)
        if self._thread.is_alive():
            log.error("%s: did not close within %.1f s and is left behind", self.name, deadline_s)
            return False
        return True

    def start_anew(self) -> None:
        """Begin every conversation from reset with the next turn, so that a recording has its set-up. Any thread."""
        self._start_anew.set()

    def post(self, item: WireT) -> None:
        """Send something that no conversation asked for, with the next turn; the oldest is lost if many wait."""
        self._posted.append(item)

    def run(self) -> None:
        """The loop, until stop(). Called by the thread."""
        while not self._stopping.is_set():
            try:
                self.step()
            except Exception:  # a bug here or in the port: this wire starts again, the others never notice
                self._log.exception(self._clock(), f"{self.name}: loop", "%s: internal error, reopening", self.name)
                self._give_up("internal error (a bug: see the log)")
        self.close()

    def close(self) -> None:
        """Leave the devices safe and close the wire. For use without a thread; stop() does it otherwise."""
        with self._lock:
            port, self._port = self._port, None
        if port is None:
            return
        try:
            for source in self._sources:
                self._send(port, source.farewell(), self._clock())
        except PortError as error:
            log.warning("%s: could not say farewell: %s", self.name, error)
        port.close()

    # ---- one turn

    def step(self) -> None:
        """One turn: open if closed, else wait for input (20 ms at most, 60 ms where every conversation runs and tells
        when it has something to ask), hand it on, send what is due.

        A message of which only the beginning came is waited for, too: a turn for each piece would cost more than it.
        """
        if self._port is None:
            self._open_when_due()
            return
        port = self._port
        try:
            wait_s = self._wait_s(self._clock())
            asked_ns = self._clock()
            items = port.read(wait_s)
            said: _Said[WireT] | None = None
            if not items and (said := self._say_prepared(port)) is not None:
                left_s = self._wait_s(said.sent_ns, but=said.source)
                wait_s += left_s
                items = port.read(left_s)
            heard_out_ns = items[-1][1] if items else min(self._clock(), asked_ns + round(wait_s * 1e9))
            if said is not None:
                with self._lock:
                    self._note_said(port, said)
            with self._lock:
                self._hand_on(items)
            while items and self._is_amid() and (left_ns := asked_ns + round(wait_s * 1e9) - self._clock()) > 0:
                items = port.read(left_ns / 1e9)
                heard_out_ns = items[-1][1] if items else self._clock()
                with self._lock:
                    self._hand_on(items)
            with self._lock:
                now_ns = self._clock()
                if now_ns - heard_out_ns > _HELD_UP_NS:  # what came meanwhile belongs to the questions asked before
                    heard_out_ns = now_ns
                    self._hand_on(port.read(0.0))
                    now_ns = max(self._clock(), now_ns)
                due = [source for source in self._sources if source.is_due(now_ns)]
                self._tap_turn(now_ns, due)
                for source in due:
                    self._send(port, source.requests(now_ns), now_ns)
                self._send_posted(port)
                self._hear_out(due, now_ns, heard_out_ns, round(wait_s * 1e9))
                if self._start_anew.is_set():
                    self._start_anew.clear()
                    for source in self._sources:
                        source.start_anew(now_ns)
        except PortError as error:
            self._give_up(str(error))
            return
        self._reopen_if_dead_silent(port)

    def health(self) -> WireHealth:
        """A snapshot, from any thread."""
        with self._lock:
            now_ns = self._clock()
            drops = dict(self._past_drops)
            if self._port is not None:
                _add(drops, self._port.drops)
            return WireHealth(
                name=self.name,
                is_open=self._port is not None,
                trouble=self._port_trouble,
                openings=self._openings,
                drops=drops,
                sources={source.name: source.health(now_ns) for source in self._sources},
                attempts=self._attempts,
            )

    def _open_when_due(self) -> None:
        wait_ns = self._backoff.due_ns - self._clock()
        if wait_ns > 0:
            self._wait(min(wait_ns, LONGEST_BACKOFF_NS) / 1e9)
            return
        try:
            port = self._open_port()
        except PortError as error:
            self._give_up(str(error))
            self._attempts += 1  # the reason is told by now
            return
        with self._lock:
            self._port = port
            self._port_trouble = None
            self._openings += 1
            self._attempts += 1
            now_ns = self._clock()
            self._heard_ns = now_ns
            self._turned_ns = now_ns
            for source in self._sources:
                source.opened(now_ns)

    def _wait_s(self, now_ns: int, *, but: _Source[WireT] | None = None) -> float:
        """Until a turn is needed; for the source `but`, which has just spoken, only if no answer comes."""
        due_ns = now_ns + (LONGEST_TURN_NS if but is None else POLL_PERIOD_NS)
        for source in self._sources:
            if source is not but:
                due_ns = min(due_ns, source.next_ns)
        return max((due_ns - now_ns) / 1e9, _SHORTEST_WAIT_S)

    def _say_prepared(self, port: Port[WireT]) -> _Said[WireT] | None:
        """Send what a source prepared for now, if that is all there is to do; the rest follows with the answer.

        After a wait nothing is in the processor's caches: a whole turn for each SYNC costs as much as for its answers.
        """
        if self._posted:
            return None
        now_ns = self._clock()
        due = [source for source in self._sources if source.is_due(now_ns)]
        if len(due) != 1 or (item := due[0].prepared) is None:
            return None
        port.write(item)
        return _Said(due[0], item, now_ns)

    def _note_said(self, port: Port[WireT], said: _Said[WireT]) -> None:
        """Let the source know that it has spoken; whatever else it had to say then is sent now."""
        self._tap_turn(said.sent_ns, [said.source])
        to_come = True
        for item in said.source.requests(said.sent_ns):
            if to_come and item == said.item:
                to_come = False
                if self._tap is not None:
                    self._tap(Direction.OUT, said.sent_ns, item)
            else:
                self._send(port, (item,), said.sent_ns)
        said.source.plan(said.sent_ns)

    def _tap_turn(self, now_ns: int, asked: Sequence[_Source[WireT]]) -> None:
        """Let the recording know who is asked now: all, or those whose names it is told."""
        if self._tap is not None and asked:
            names = "" if len(asked) == len(self._sources) else "\n".join(source.name for source in asked)
            self._tap(Direction.TURN, now_ns, names)

    def _is_amid(self) -> bool:
        """Whether the rest of a message is on its way, and no conversation has anything to ask before that."""
        return all(source.is_amid() for source in self._sources)

    def _hand_on(self, items: list[tuple[WireT, int]]) -> None:
        for item, stamp_ns in items:
            self._heard_ns = stamp_ns
            if self._tap is not None:
                self._tap(Direction.IN, stamp_ns, item)
            for source in self._sources:
                source.receive(item, stamp_ns)
        if items:
            self._backoff.reset()

    def _hear_out(self, due: Iterable[_Source[WireT]], now_ns: int, heard_out_ns: int, wait_ns: int) -> None:
        """Silence, as far as it was surely heard: whatever came until heard_out_ns was read in this turn.

        wait_ns: how long the turn meant to take. What it took beyond, this thread was held up: it neither listened nor
        asked, and so that is no device's silence.
        """
        done_ns = self._clock()
        late_ns = done_ns - self._turned_ns - wait_ns
        held_up_ns = late_ns if late_ns > _HELD_UP_NS else 0
        for source in due:
            source.check(now_ns, min(heard_out_ns, done_ns - held_up_ns))
        if held_up_ns:
            for source in self._sources:
                source.forgive(held_up_ns, done_ns)
        for source in due:
            source.plan(now_ns)
        self._turned_ns = done_ns

    def _send(self, port: Port[WireT], items: Iterable[WireT | SetBaudRate], now_ns: int) -> None:
        for item in items:
            if self._tap is not None:
                self._tap(Direction.OUT, now_ns, item)
            if isinstance(item, SetBaudRate):
                port.set_baud(item.bits_per_s)
            else:
                port.write(item)

    def _send_posted(self, port: Port[WireT]) -> None:
        while self._posted:
            port.write(self._posted.popleft())

    def _give_up(self, why: str) -> None:
        """The wire is lost or cannot be opened: close it, tell everyone, come back after the back-off."""
        with self._lock:
            now_ns = self._clock()
            port, self._port = self._port, None
            self._port_trouble = why
            self._backoff.next(now_ns)
            if port is not None and self._tap is not None:
                self._tap(Direction.LOST, now_ns, why)
            for source in self._sources:
                source.lost(now_ns, why)
            if port is not None:
                _add(self._past_drops, port.drops)
        if port is not None:
            port.close()

    def _reopen_if_dead_silent(self, port: Port[WireT]) -> None:
        """A wire on which nothing at all is heard may be half open: begin anew, quietly (all is SILENT already)."""
        limit_s = port.silence_reopen_s
        if limit_s is None or self._clock() - self._heard_ns < limit_s * 1e9:
            return
        with self._lock:
            self._port = None
            self._port_trouble = f"nothing heard for {limit_s:.0f} s, opening again"
            self._backoff.due_ns = self._clock()
            if self._tap is not None:
                self._tap(Direction.LOST, self._clock(), self._port_trouble)
            _add(self._past_drops, port.drops)
        port.close()


@dataclass(frozen=True, slots=True)
class _Said(Generic[WireT]):
    """What a source had prepared and was sent, and when."""

    source: _Source[WireT]
    item: WireT
    sent_ns: int


class _Source(Generic[WireT]):
    """One conversation with what the loop keeps about it. Pure but for the sink and the log."""

    def __init__(
        self, name: str, conversation: Conversation[WireT], sink: Sink, rated_log: RateLimitedLog, tap: Tap | None
    ) -> None:
        self.name = name
        self._conversation: Conversation[WireT] = conversation
        self._sink = sink
        self._log = rated_log
        self._tap = tap
        self._next_request: Callable[[], int | None] | None = getattr(conversation, "next_request_ns", None)
        self._amid: Callable[[], bool] | None = getattr(conversation, "is_amid", None)
        self._hears: Callable[[WireT], bool] | None = getattr(conversation, "hears", None)
        self._has_heard = False  # since it was last asked what it has to say
        self._tells = False  # it runs, and said when it has something to say
        self.next_ns = 0  # until then, and if it hears nothing, no turn is needed for it
        self._prepare: Callable[[], WireT | None] | None = getattr(conversation, "prepared", None)
        self.prepared: WireT | None = None  # what it will say then, if it hears nothing
        self._wire_trouble: str | None = "not opened yet"
        self._loop_trouble: str | None = None  # what the loop found wrong: silence, a bug
        self._broken_until_ns: int | None = None  # after a bug: left alone until then
        self._restart_backoff = Backoff()
        self._life_ns = 0  # last reading, or when RUNNING was entered
        self._alive_ns = 0  # the same, and what was forgiven since
        self._longest_ns = 0  # the longest that was forgiven since
        self._setup_ns = 0  # when the conversation was last (re)started or moved on
        self._seen_state: LinkState | None = None
        self._told: tuple[LinkState, str, Identity | None] | None = None
        self._told_ns = 0
        self._checked_ns = -_CHECK_PERIOD_NS
        self._since_ns = 0
        self._readings = 0
        self._restarts = 0
        self._bugs = 0
        self._last_reading_ns: int | None = None
        self._resumed_ns = 0  # the first reading after a start, or a silence that was told
        self._rate = Rate()
        self._usual = UsualPeriod()
        self._hold_ups = HoldUps()
        self._limit_ns = MOST_SILENCE_NS  # as last looked at

    # ---- what the loop tells

    def opened(self, now_ns: int) -> None:
        self._wire_trouble = None
        self._loop_trouble = None
        self._broken_until_ns = None
        self._restart(now_ns)
        self._tell_safely(now_ns)

    def forgive(self, held_up_ns: int, now_ns: int) -> None:
        """The reader was held up for so long in the turn that ends now."""
        self._longest_ns = max(self._longest_ns, held_up_ns)
        self._alive_ns = min(self._alive_ns + held_up_ns, max(now_ns, self._alive_ns))
        self._setup_ns = min(self._setup_ns + held_up_ns, max(now_ns, self._setup_ns))

    def lost(self, now_ns: int, why: str) -> None:
        self._wire_trouble = why
        self._tell_safely(now_ns)

    def receive(self, item: WireT, stamp_ns: int) -> None:
        if self._broken_until_ns is not None or (self._hears is not None and not self._hears(item)):
            return
        self._has_heard = True
        self.prepared = None
        try:
            for reading in self._conversation.receive(item, stamp_ns):
                self._note_reading(stamp_ns)
                self._sink(self.name, reading)
        except Exception as error:
            self._note_bug(stamp_ns, error)

    def requests(self, now_ns: int) -> Iterable[WireT | SetBaudRate]:
        self._has_heard = False
        self.prepared = None
        if self._broken_until_ns is not None:
            return ()
        try:
            items: Iterable[WireT | SetBaudRate] = self._conversation.requests(now_ns)
        except Exception as error:
            self._note_bug(now_ns, error)
            return ()
        return items

    def farewell(self) -> Iterable[WireT | SetBaudRate]:
        try:
            items: Iterable[WireT | SetBaudRate] = self._conversation.farewell()
        except Exception:
            log.exception("%s: farewell failed", self.name)
            return ()
        return items

    def is_due(self, now_ns: int) -> bool:
        """Whether this turn concerns it. A turn touches no more than it must: after each wait all of it is cold."""
        return self._has_heard or not self._tells or now_ns >= self.next_ns

    def plan(self, now_ns: int) -> None:
        """After a turn that concerned it: when the next one does."""
        self._tells = (
            self._next_request is not None and self._seen_state is LinkState.RUNNING and self._broken_until_ns is None
        )
        request_ns = self._next_request_ns(now_ns + POLL_PERIOD_NS)
        self.next_ns = min(request_ns, self.silent_from_ns(now_ns + LONGEST_TURN_NS))
        self.prepared = None
        if self._tells and self._prepare is not None and self.next_ns == request_ns:
            self.prepared = self._prepare()

    def _next_request_ns(self, poll_ns: int) -> int:
        """When requests() should be called next; a conversation that keeps a beat says so, others are polled, and all
        while they are set up."""
        if self._next_request is None or self._broken_until_ns is not None:
            return poll_ns
        try:
            due_ns = self._next_request()
        except Exception:
            return poll_ns  # requests() will meet the same trouble and report it
        if due_ns is None:
            return poll_ns
        return due_ns if self._seen_state is LinkState.RUNNING else min(due_ns, poll_ns)

    def is_amid(self) -> bool:
        """Whether a message has begun that is not complete, and nothing is to be asked before it is."""
        return self._amid is not None and self._broken_until_ns is None and self._amid()

    def silent_from_ns(self, latest_ns: int) -> int:
        """When it will be silent if nothing comes; latest_ns if it is, or if it does not run."""
        if self._seen_state is not LinkState.RUNNING or self._loop_trouble or self._broken_until_ns is not None:
            return latest_ns
        return self._quiet_since_ns() + self._limit_ns

    def check(self, now_ns: int, heard_out_ns: int) -> None:
        """Notice silence, set-up that does not end, and changes worth telling."""
        if self._broken_until_ns is not None:
            if now_ns >= self._broken_until_ns:
                self._broken_until_ns = None
                self._loop_trouble = None
                self._restart(now_ns)
            return
        try:
            is_due = now_ns >= self._checked_ns + _CHECK_PERIOD_NS or heard_out_ns >= self.silent_from_ns(now_ns + 1)
            if self._conversation.state is self._seen_state and not is_due:
                return
            self._checked_ns = now_ns
            self._supervise(now_ns, heard_out_ns)
            self._tell(now_ns)
        except Exception as error:
            self._note_bug(now_ns, error)

    def health(self, now_ns: int) -> SourceHealth:
        conversation = self._conversation
        state, text, identity = self._told if self._told is not None else (LinkState.ABSENT, "not opened yet", None)
        counters = conversation.counters
        return SourceHealth(
            name=self.name,
            state=state,
            since_ns=self._since_ns,
            trouble=self._trouble() if state is LinkState.RUNNING else text,
            identity=identity,
            rate_hz=self._rate.hz(now_ns),
            age_ns=None if self._last_reading_ns is None else now_ns - self._last_reading_ns,
            readings=self._readings,
            restarts=self._restarts,
            bugs=self._bugs,
            counters=replace(counters, drops=dict(counters.drops)),
            clock_fit=conversation.clock_fit,
        )

    # ---- how it works

    def _supervise(self, now_ns: int, heard_out_ns: int) -> None:
        state = self._conversation.state
        if state is not self._seen_state:
            self._seen_state = state
            self._setup_ns = now_ns
            if state in (LinkState.STARTING, LinkState.RUNNING):
                self._loop_trouble = None  # it answers again
            if state is LinkState.RUNNING:
                self._note_life(max(self._alive_ns, now_ns))
        limit_ns = self._limit_ns = self._silence_limit_ns()
        if state is LinkState.RUNNING:
            silence_ns = heard_out_ns - self._quiet_since_ns()
            if silence_ns >= limit_ns:
                unheard_s = (heard_out_ns - self._life_ns) / 1e9
                self._loop_trouble = f"no reading for {unheard_s:.2f} s: check its power and cable"
                if silence_ns >= max(limit_ns + _SILENCE_PATIENCE_NS, _SHORTEST_BEFORE_RESET_NS):
                    self._restart_when_due(now_ns)
            else:
                self._loop_trouble = None
        elif now_ns - self._setup_ns > _SETUP_LIMIT_NS:
            self._restart(now_ns)

    def _note_life(self, stamp_ns: int) -> None:
        self._life_ns = self._alive_ns = stamp_ns
        self._longest_ns = 0

    def _quiet_since_ns(self) -> int:
        """From when silence counts: the last reading, and what was forgiven since.

        However often this thread was held up, a silence is told 500 ms after the last reading and its longest hold-up.
        """
        return min(self._alive_ns, self._life_ns + self._longest_ns + max(MOST_SILENCE_NS - self._limit_ns, 0))

    def _silence_limit_ns(self) -> int:
        """What the conversation says; more where the device takes longer, or is held back on its way.

        That is three of the periods that were measured, if those are much longer, and half as much again as readings
        were lately held back, up to 60 ms.
        """
        told_ns = self._conversation.silence_limit_ns
        if self._usual.period_ns == 0:
            return max(told_ns, _SILENCE_OF_STRANGERS_NS)
        told_ns = max(told_ns, self._hold_ups.limit_ns)
        found_ns = min(3 * self._usual.period_ns, MOST_SILENCE_NS)
        return found_ns if found_ns > _MUCH_LONGER * told_ns else told_ns

    def _restart_when_due(self, now_ns: int) -> None:
        """Silence: start anew, but no more often than the back-off allows: a device may come and go."""
        if now_ns >= self._restart_backoff.due_ns:
            self._restart_backoff.next(now_ns)
            self._restart(now_ns)

    def start_anew(self, now_ns: int) -> None:
        """Begin from reset because somebody asked for it."""
        if self._broken_until_ns is None:
            self._restart(now_ns)

    def _restart(self, now_ns: int) -> None:
        self._restarts += 1
        self._setup_ns = now_ns
        self.next_ns = now_ns
        self.prepared = None
        if self._tap is not None:
            self._tap(Direction.CONNECTED, now_ns, self.name)
        try:
            self._conversation.connected(now_ns)
        except Exception as error:
            self._note_bug(now_ns, error)

    def _note_reading(self, stamp_ns: int) -> None:
        self._readings += 1
        if self._last_reading_ns is not None and self._alive_ns - self._resumed_ns >= _SETTLING_NS:
            self._hold_ups.count(stamp_ns, stamp_ns - self._alive_ns)
        if self._loop_trouble is not None or self._seen_state is not LinkState.RUNNING:
            self._resumed_ns = stamp_ns
        self._note_life(stamp_ns)
        self._last_reading_ns = stamp_ns
        self._loop_trouble = None
        self._restart_backoff.note_life(stamp_ns)
        self._rate.count(stamp_ns)
        self._usual.count(stamp_ns)

    def _note_bug(self, now_ns: int, error: Exception) -> None:
        """Called while handling the exception. The conversation is left alone for a second, then restarted."""
        self._bugs += 1
        self._conversation.counters.drop("bug")
        self._broken_until_ns = now_ns + LONGEST_BACKOFF_NS
        self._loop_trouble = f"internal error, {type(error).__name__}: {error} (a bug: please report it with the log)"
        self._log.exception(now_ns, f"{self.name}: {type(error).__name__}", "%s: %s", self.name, self._loop_trouble)
        self._tell(now_ns)

    def _identity(self) -> Identity | None:
        if self._broken_until_ns is not None:  # do not ask a conversation that has just failed
            return self._told[2] if self._told is not None else None
        return self._conversation.identity

    def _trouble(self) -> str | None:
        if self._broken_until_ns is not None:
            return self._loop_trouble
        return self._conversation.trouble or self._loop_trouble

    def _tell_safely(self, now_ns: int) -> None:
        try:
            self._tell(now_ns)
        except Exception as error:
            self._note_bug(now_ns, error)

    def _tell(self, now_ns: int) -> None:
        """Queue an event if there is news: another state, another identity, or (once a second) other words."""
        if self._wire_trouble is not None:
            state, text = LinkState.ABSENT, self._wire_trouble
        else:
            state = LinkState.SILENT if self._loop_trouble is not None else self._conversation.state
            text = self._trouble() or _words(state)
        news = (state, text, self._identity())
        if news == self._told:
            return
        told = self._told
        if told is not None and told[0] is state and told[2] == news[2] and now_ns - self._told_ns < _EVENT_PERIOD_NS:
            return
        if told is None or told[0] is not state:
            self._since_ns = now_ns
        self._told, self._told_ns = news, now_ns
        self._sink(self.name, DeviceEvent(now_ns, state, text, news[2]))
        good = state in (LinkState.STARTING, LinkState.RUNNING) or text == _WORDS[LinkState.SILENT]
        level = logging.INFO if good else logging.WARNING
        cause = f"{self.name}: {state.name}"
        if not good:  # a start in silence is no reason to keep the first true one back, nor "no reading" what is wrong
            cause += ", told by the loop" if text == self._loop_trouble else ", told by the device"
        is_said = self._log.say(now_ns, cause, level, f"{self.name}: {state.name.lower()}: {text}")
        if is_said and not good:  # whoever reads of the trouble reads of its end, too
            self._log.forget(f"{self.name}: {LinkState.RUNNING.name}")


_WORDS = {
    LinkState.ABSENT: "its port is not there",
    LinkState.SILENT: "no answer yet",
    LinkState.STARTING: "answers, is being set up",
    LinkState.RUNNING: "readings arrive",
}


def _words(state: LinkState) -> str:
    return _WORDS[state]


def _add(total: dict[str, int], more: dict[str, int]) -> None:
    for reason, count in more.items():
        total[reason] = total.get(reason, 0) + count
