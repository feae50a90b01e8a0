"""Two CANopen encoders (CiA 406), one at each wheel of a differential drive, read together by SYNC.

    id         what                                                 bytes
    000        NMT, from us                                         01|80 nn: start, pre-operational
    080        SYNC, from us                                        none
    080 + n    emergency                                            code u16, register u8, 5 of the maker's
    180 + n    TPDO1, by timer or on change                         position u32 (6004h)
    280 + n    TPDO2, on SYNC                                       position u32 (6004h)
    580/600+n  SDO answer and question                              see canopen_sdo.py
    700 + n    heartbeat                                            00 boot-up, 7F pre-operational, 05 operational, 04

Each node: pre-operational -> who are you (1000h, 1018h, 1008h), how do you count (6001h, 6002h) -> heartbeat 100 ms,
TPDO2 on each SYNC -> start -> TPDO1 off where SYNC is ours (100 frames a second that nobody needs). When both are
started we send SYNC at the wanted rate; a reading is complete when both have answered the same SYNC. A node that boots,
falls silent or leaves the operational state is set up again.

Why not the `canopen` package: it owns threads and the bus; what is needed of CiA 301 here is an SDO client and a few
ids, which fit a conversation better. The package judges our SDO client in the tests instead.

Source: CiA 301 (NMT, SDO, PDO, heartbeat, emergency), CiA 406 (objects 6000h to 650Dh).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from functools import partial, reduce
from typing import Literal

from drivers.canopen_sdo import ANSWER_ID, TIMED_OUT, Download, SdoAborted, SdoClient, SdoDone, Upload
from drivers.conversation import CanFrame, SetBaudRate, silence_limit
from drivers.readings import AngleReading, ClockFit, Identity, LinkState, Reading, SourceCounters, WheelReading

_SYNC_ID = 0x080
_SYNC = CanFrame(_SYNC_ID)
_NMT_START = 0x01
_NMT_PRE_OPERATIONAL = 0x80
_BOOT_UP, _OPERATIONAL = 0x00, 0x05
_DEVICE_PROFILE = 406
_POSITION_MAPPING = 0x60040020
_PDO_DISABLED = 1 << 31
_FULL_RANGE = 1 << 32
_TELLS_FULL_RANGE = (0, _FULL_RANGE - 1)  # 6002h has 32 bits, in which 2^32 cannot be said

_HEARTBEAT_MS = 100
# Missing readings are noticed after three periods. A node is given up, and with it the run of its count, only
# after five heartbeats: until then it may have been the bus or this machine that paused.
_LIFE_NS = 5 * _HEARTBEAT_MS * 1_000_000
_SEARCH_PERIOD_NS = 250_000_000
_REFUSED_RETRY_NS = 1_000_000_000
_START_REPEAT_NS = 300_000_000
_STARTS_UNTIL_TOLD = 3
_SYNC_PATIENCE_NS = 1_000_000_000  # started, alive, but no TPDO2 for so long: this node does not know SYNC
_TRIPS_KEPT = 15
_SHORTEST_ANSWER_LIMIT_NS = 40_000_000  # an answer that is later was lost, where another node answered
_PAUSE_LIMIT_NS = (
    100_000_000  # where none has answered: the bus or a computer paused, and their answers are on their way
)
_UNKNOWN_STEPS = 65536
_JUMP_FACTOR = 10.0  # a count that moved ten times as far as the fastest wheel was set anew
_NEVER = 1 << 62

Sampling = Literal["auto", "sync", "cyclic"]
"""auto: SYNC, and the timer of TPDO1 for nodes that do not answer SYNC. sync, cyclic: that one only."""


# ---- counts


class Unwrapper:
    """A running total from a count that wraps, in both directions.

    range_ticks: the count runs from 0 to range_ticks - 1.  steps_per_turn, max_turns_per_s: how fast it can move;
    where it could have gone half the range since the last sample, its direction is not known any more.
    """

    def __init__(self, max_turns_per_s: float) -> None:
        self.total = 0
        self._max_turns_per_s = max_turns_per_s
        self._stamp_ns = 0
        self.configure(_FULL_RANGE, _UNKNOWN_STEPS)

    def configure(self, range_ticks: int, steps_per_turn: int) -> None:
        """The device has told how it counts; the next sample follows from nothing."""
        self.range_ticks = range_ticks
        self._ticks_per_ns = steps_per_turn * self._max_turns_per_s / 1e9
        self._raw: int | None = None

    def restart(self) -> None:
        """The next sample follows from nothing."""
        self._raw = None

    @property
    def absolute(self) -> int | None:
        """The newest sample as it came, the upper half of the range as below 0; None before the first."""
        if self._raw is None:
            return None
        return self._raw if self._raw < self.range_ticks // 2 else self._raw - self.range_ticks

    def advance(self, raw: int, stamp_ns: int) -> bool:
        """Take a sample; True if the total moved on by what was rolled since the last, False if that is not known."""
        before, gap_ns = self._raw, max(stamp_ns - self._stamp_ns, 0)
        self._raw, self._stamp_ns = raw, stamp_ns
        if before is None:
            return False
        step = (raw - before) % self.range_ticks
        if step > self.range_ticks // 2:
            step -= self.range_ticks
        farthest = self._ticks_per_ns * gap_ns
        could_hide_a_wrap = 2 * farthest >= self.range_ticks
        was_set_anew = abs(step) > _JUMP_FACTOR * max(farthest, self._ticks_per_ns * 20e6)
        if could_hide_a_wrap or was_set_anew:
            return False
        self.total += step
        return True


# ---- one node


class _Phase(Enum):
    SEARCHING = auto()  # no answer yet, or no longer
    SETTING_UP = auto()
    STARTED = auto()


Script = Generator[Upload | Download, SdoDone, None]


class _Refused(Exception):  # noqa: N818 - never leaves this module
    """Set-up cannot go on; the text says why and how to repair it."""


class _Node:
    """One encoder: found, set up, started, watched."""

    def __init__(
        self,
        node: int,
        side: str,
        counters: SourceCounters,
        *,
        period_ms: int,
        max_turns_per_s: float,
        only_on_sync: bool,
    ) -> None:
        """only_on_sync: nobody else on the bus is to have its positions: those it sends by timer are switched off."""
        self._only_on_sync = only_on_sync
        self.node = node
        self.name = f"node {node:02X}h ({side})"
        self._counters = counters
        self._period_ms = period_ms
        self._life_ns = max(_LIFE_NS, 3 * period_ms * 1_000_000)
        self._sdo = SdoClient(node)
        self.sync_pdo_id = 0x280 + node
        self.cyclic_pdo_id = 0x180 + node
        self.missing = False  # it was asked and did not answer
        self.identity = Identity()
        self.unwrapper = Unwrapper(max_turns_per_s)
        self.begin(0, cyclic=False)

    def begin(self, now_ns: int, *, cyclic: bool) -> None:
        """Look for the node and set it up from the start."""
        self.phase = _Phase.SEARCHING
        self.cyclic = cyclic
        self.answered = False
        self.refusal: str | None = None
        self.emergency: int | None = None
        self.started_ns = 0
        self._script: Script | None = None
        self._search_due_ns = now_ns
        self._heard_ns = now_ns
        self._beats = False
        self._start_due_ns = _NEVER
        self.starts_refused = 0  # one after the other, as its heartbeat tells
        self._newest_error = 0
        self._sdo.cancel()
        self.unwrapper.restart()

    def booted(self, now_ns: int) -> None:
        """It has just been switched on or reset: what we set is gone, its count may be another."""
        self._counters.drop("node_reset")
        self.begin(now_ns, cyclic=self.cyclic)

    @property
    def trouble(self) -> str | None:
        if self.refusal is not None:
            return f"{self.name}: {self.refusal}"
        if self.missing:
            return f"{self.name} does not answer: check its power, the wiring and termination, node id and bit rate"
        if self.emergency is not None:
            return f"{self.name} reports error {self.emergency:04X}h: see its manual for this emergency code"
        if self.starts_refused >= _STARTS_UNTIL_TOLD:
            cause = (
                f"its newest error is {self._newest_error:04X}h (1003h), see its manual"
                if self._newest_error
                else ("an error of its own, or another master of the bus, keeps it from starting")
            )
            return f"{self.name} does not become operational: {cause}"
        return None

    # ---- out

    def requests(self, now_ns: int) -> list[CanFrame]:
        self._notice_loss(now_ns)
        frames: list[CanFrame] = []
        if self.phase is _Phase.SEARCHING and now_ns >= self._search_due_ns:
            self._search_due_ns = now_ns + _SEARCH_PERIOD_NS
            self._script = self._set_up()
            self._sdo.ask(next(self._script), now_ns)
            self.phase = _Phase.SETTING_UP
            frames.append(self._nmt(_NMT_PRE_OPERATIONAL))  # a stopped node does not answer SDO
        sdo_frames, timed_out = self._sdo.requests(now_ns)
        frames += sdo_frames
        if timed_out is not None:
            self._go_on(timed_out, now_ns)
        if self.phase is _Phase.STARTED and now_ns >= self._start_due_ns:
            self._start_due_ns = _NEVER
            self.started_ns = now_ns
            frames.append(self._nmt(_NMT_START))
        return frames

    def farewell(self) -> list[CanFrame]:
        """Back to pre-operational: no more PDOs on the bus."""
        return [self._nmt(_NMT_PRE_OPERATIONAL)] if self.phase is _Phase.STARTED else []

    def _nmt(self, command: int) -> CanFrame:
        return CanFrame(0, bytes((command, self.node)))

    def _notice_loss(self, now_ns: int) -> None:
        if self.phase is _Phase.STARTED and self._beats and now_ns - self._heard_ns > self._life_ns:
            self._counters.drop("node_lost")
            self.begin(now_ns, cyclic=self.cyclic)
            self.missing = True

    # ---- in

    def hear(self, now_ns: int) -> None:
        """Any frame of the node is a sign of life."""
        self._heard_ns = now_ns

    def take_sdo(self, data: bytes, now_ns: int) -> None:
        done = self._sdo.receive(data, now_ns)
        if done is not None:
            self._go_on(done, now_ns)

    def take_heartbeat(self, data: bytes, now_ns: int) -> None:
        if len(data) != 1:
            self._counters.drop("wrong_length")
            return
        state = data[0] & 0x7F
        if state == _BOOT_UP:
            self.booted(now_ns)
        elif state == _OPERATIONAL:
            self.starts_refused = 0
        elif self._start_overdue(now_ns):
            self._counters.drop("not_operational")
            self._start_due_ns = now_ns
            self.unwrapper.restart()
            self.starts_refused += 1
            if self.starts_refused == _STARTS_UNTIL_TOLD and self._script is None:
                self._script = self._ask_why()
                self._sdo.ask(next(self._script), now_ns)

    def take_emergency(self, data: bytes) -> None:
        if len(data) != 8:
            self._counters.drop("wrong_length")
            return
        code = int.from_bytes(data[:2], "little")
        self.emergency = code or None  # 0: the error is gone
        if code:
            self._counters.drop("emergency")

    def position(self, data: bytes) -> int | None:
        """The count in a PDO; None (and counted) if there is none in it."""
        if len(data) < 4:
            self._counters.drop("wrong_length")
            return None
        raw = int.from_bytes(data[:4], "little")
        range_ticks = self.unwrapper.range_ticks
        if raw >= range_ticks:
            self._counters.drop("position_out_of_range")
            self.refusal = f"its position exceeds its range of {range_ticks} (6002h): switch on scaling (6000h bit 2)"
            return None
        self.refusal = None
        return raw

    def _start_overdue(self, now_ns: int) -> bool:
        return (
            self.phase is _Phase.STARTED
            and self._start_due_ns == _NEVER
            and (now_ns - self.started_ns > _START_REPEAT_NS)
        )

    # ---- set-up

    def _go_on(self, done: SdoDone, now_ns: int) -> None:
        """An SDO transfer has ended: the next step of the set-up."""
        if self.phase is _Phase.STARTED:
            self._go_on_afterwards(done, now_ns)
            return
        if done.abort_code == TIMED_OUT:
            self.begin(max(now_ns, self._search_due_ns), cyclic=self.cyclic)
            self.missing = True
            return
        if self._script is None:
            return
        self.answered = True
        self.missing = False
        if not done.ok:
            self._counters.drop("sdo_abort")
        try:
            self._sdo.ask(self._script.send(done), now_ns)
        except StopIteration:
            self.phase = _Phase.STARTED
            self._start_due_ns = now_ns
            self._heard_ns = now_ns
            self._script = None
            if self._only_on_sync and not self.cyclic:
                self._script = _switch_off(0x1800)
                self._sdo.ask(next(self._script), now_ns)
        except (_Refused, SdoAborted) as error:
            self._script = None
            self.phase = _Phase.SEARCHING
            self._search_due_ns = now_ns + _REFUSED_RETRY_NS
            self.refusal = str(error)

    def _go_on_afterwards(self, done: SdoDone, now_ns: int) -> None:
        """The same of what may fail: the node reads well without it."""
        if self._script is None:
            return
        try:
            if done.abort_code == TIMED_OUT:
                raise StopIteration
            self._sdo.ask(self._script.send(done), now_ns)
        except StopIteration:
            self._script = None

    def _ask_why(self) -> Script:
        """The newest error on its list: what it told when it happened, we may not have heard."""
        done = yield Upload(0x1003, 1)
        self._newest_error = done.number & 0xFFFF if done.ok else 0

    def _set_up(self) -> Script:
        """The questions and settings in order; each `yield` is one SDO transfer."""
        kind = yield from _must(Upload(0x1000))
        profile = kind & 0xFFFF
        if profile != _DEVICE_PROFILE:
            raise _Refused(f"device profile {profile} is not that of an encoder ({_DEVICE_PROFILE}): check the node id")
        self.refusal = None
        self.identity = yield from _ask_identity()
        steps_per_turn = (yield from _number(Upload(0x6001))) or _UNKNOWN_STEPS
        range_ticks = yield from _number(Upload(0x6002))
        if range_ticks in _TELLS_FULL_RANGE:
            range_ticks = _FULL_RANGE
        self.unwrapper.configure(range_ticks, steps_per_turn)
        self._beats = yield from _set_heartbeat()  # without one, missing readings tell that it is gone
        if self.cyclic:
            self.cyclic_pdo_id = (yield from _pdo_id(0x1800)) or 0x180 + self.node
            yield from _send_by_timer(self._period_ms)
        else:
            self.sync_pdo_id = (yield from _pdo_id(0x1801)) or 0x280 + self.node
            yield from _send_on_sync()


Steps = Generator[Upload | Download, SdoDone, int]


def _must(question: Upload | Download) -> Steps:
    """The answer's number; SdoAborted if the node refuses."""
    done = yield question
    if done.abort_code is not None:
        raise SdoAborted(question, done.abort_code)
    return done.number


def _number(question: Upload) -> Steps:
    """The answer's number, 0 if the node does not have the object."""
    done = yield question
    return done.number if done.ok else 0


def _text(question: Upload) -> Generator[Upload | Download, SdoDone, str]:
    done = yield question
    return done.data.decode("ascii", "replace").strip("\0 ") if done.ok else ""


def _ask_identity() -> Generator[Upload | Download, SdoDone, Identity]:
    vendor = yield from _number(Upload(0x1018, 1))
    product = yield from _number(Upload(0x1018, 2))
    revision = yield from _number(Upload(0x1018, 3))
    serial = yield from _number(Upload(0x1018, 4))
    name = yield from _text(Upload(0x1008))
    return Identity(
        vendor=f"CANopen vendor {vendor:X}h",
        model=name or f"product {product:X}h",
        serial=str(serial),
        firmware=f"revision {revision >> 16}.{revision & 0xFFFF}",
    )


def _set_heartbeat() -> Generator[Upload | Download, SdoDone, bool]:
    """True if the node sends its heartbeat as often as we want."""
    if (yield from _number(Upload(0x1017))) == _HEARTBEAT_MS:
        return True
    done = yield Download(0x1017, 0, _HEARTBEAT_MS.to_bytes(2, "little"))
    return done.ok


def _pdo_id(communication: int) -> Steps:
    """The id under which a PDO is sent, 0 if the node does not say, or says one that no PDO can have."""
    cob_id = yield from _number(Upload(communication, 1))
    return cob_id & 0x7FF if 0x180 < cob_id & 0x7FF < 0x580 else 0


def _map_position(number: int, cob_id: int) -> Steps:
    """TPDO `number` has the position and nothing else. Returns its COB-ID as it is now: switched off, if it was mapped.

    What is so already is not written, since some nodes store each write; a node that does not tell has it fixed.
    """
    communication, mapping = 0x1800 + number, 0x1A00 + number
    count = yield Upload(mapping, 0)
    first = yield Upload(mapping, 1)
    if not count.ok and not first.ok:
        return cob_id
    if first.ok and first.number == _POSITION_MAPPING and (not count.ok or count.number == 1):
        return cob_id
    yield Download(communication, 1, (cob_id | _PDO_DISABLED).to_bytes(4, "little"))
    yield Download(mapping, 0, b"\0")
    yield Download(mapping, 1, _POSITION_MAPPING.to_bytes(4, "little"))
    yield Download(mapping, 0, b"\1")
    return cob_id | _PDO_DISABLED


def _switch_on(communication: int, cob_id: int) -> Generator[Upload | Download, SdoDone, None]:
    if cob_id & _PDO_DISABLED:
        yield Download(communication, 1, (cob_id & ~_PDO_DISABLED).to_bytes(4, "little"))


def _switch_off(communication: int) -> Generator[Upload | Download, SdoDone, None]:
    """A PDO is not sent any more; a node that refuses goes on sending it."""
    cob_id = yield from _number(Upload(communication, 1))
    if cob_id and not cob_id & _PDO_DISABLED:
        yield Download(communication, 1, (cob_id | _PDO_DISABLED).to_bytes(4, "little"))


def _send_on_sync() -> Generator[Upload | Download, SdoDone, None]:
    """TPDO2: the position, after each SYNC."""
    cob_id = yield from _number(Upload(0x1801, 1))
    cob_id = yield from _map_position(1, cob_id)
    kind = yield from _number(Upload(0x1801, 2))
    if kind != 1:
        done = yield Download(0x1801, 2, b"\1")
        if not done.ok and not cob_id & _PDO_DISABLED:  # some take it only while the PDO is switched off
            yield Download(0x1801, 1, (cob_id | _PDO_DISABLED).to_bytes(4, "little"))
            cob_id |= _PDO_DISABLED
            yield Download(0x1801, 2, b"\1")
    yield from _switch_on(0x1801, cob_id)


def _send_by_timer(period_ms: int) -> Generator[Upload | Download, SdoDone, None]:
    """TPDO1: the position, every period_ms. 6200h and 1800h:05 are the same timer; one of the two is enough."""
    cob_id = yield from _number(Upload(0x1800, 1))
    cob_id = yield from _map_position(0, cob_id)
    timer = period_ms.to_bytes(2, "little")
    yield Download(0x1800, 2, b"\xfe")
    first = yield Download(0x1800, 5, timer)
    second = yield Download(0x6200, 0, timer)
    if not first.ok and not second.ok:
        raise _Refused("it takes no timer (1800h:05, 6200h) for its position: set one with the maker's tool")
    yield from _switch_on(0x1800, cob_id)


# ---- the pair


@dataclass(slots=True)
class _Round:
    """One SYNC and what was answered to it: positions by side."""

    sync_ns: int
    raw: list[int | None]
    heard_ns: list[int]  # when each came

    @property
    def is_complete(self) -> bool:
        """Whether every node has answered."""
        return None not in self.raw

    @property
    def first_answer_ns(self) -> int | None:
        """None before there is one."""
        return min((at_ns for raw, at_ns in zip(self.raw, self.heard_ns) if raw is not None), default=None)


@dataclass(slots=True)
class _Debt:
    """SYNCs that were given up and that a node may answer yet.

    While there are any, its next answer may be to one of them. But it answers in order, and what was held back comes at
    once: from its first answer on, those that come before it is quiet are to the earlier SYNCs; if none comes, these
    were lost.  open: how many may come yet.  paid: how many came.  quiet_ns: from then on none comes, once it speaks.
    """

    open: int = 0
    paid: int = 0
    quiet_ns: int | None = None

    @property
    def is_doubtful(self) -> bool:
        """Whether it cannot be told to which SYNC its newest answer is: some came, and some did not."""
        return self.open > 0 and self.paid > 0

    def is_due(self, now_ns: int) -> bool:
        """Whether an answer to an earlier SYNC may still come."""
        return self.open > 0 and (self.quiet_ns is None or now_ns < self.quiet_ns)

    def forget(self) -> None:
        self.open, self.paid, self.quiet_ns = 0, 0, None


@dataclass(slots=True)
class _Track:
    """The two newest samples of a node that sends by timer: (stamp, total)."""

    before: tuple[int, int] | None = None
    newest: tuple[int, int] | None = None

    def at(self, stamp_ns: int) -> int | None:
        """The total at a time between the two, None outside."""
        if self.newest is None:
            return None
        if stamp_ns == self.newest[0]:
            return self.newest[1]
        if self.before is None or not self.before[0] <= stamp_ns < self.newest[0]:
            return None
        (t0, x0), (t1, x1) = self.before, self.newest
        return x0 + round((x1 - x0) * (stamp_ns - t0) / (t1 - t0))


class _Cia406Conversation(ABC):
    """Encoders that are read together; subclasses say what is made of a round of counts."""

    def __init__(
        self,
        nodes: Sequence[tuple[int, str]],
        *,
        sync_rate_hz: float,
        produce_sync: bool,
        sampling: Sampling,
        max_turns_per_s: float,
    ) -> None:
        if not 1.0 <= sync_rate_hz <= 1000.0:
            raise ValueError(f"sync_rate_hz {sync_rate_hz}: 1 to 1000")
        self._period_ns = round(1e9 / sync_rate_hz)
        self._produce_sync = produce_sync
        self._sampling = sampling
        self._counters = SourceCounters()
        self._last_stamp_ns = -_NEVER
        self._proved: list[Reading] = []  # complete, and told with the next frame
        period_ms = max(1, round(1e3 / sync_rate_hz))
        self._nodes = [
            _Node(
                node,
                what,
                self._counters,
                period_ms=period_ms,
                max_turns_per_s=max_turns_per_s,
                only_on_sync=produce_sync,
            )
            for node, what in nodes
        ]
        self._restart(0)

    @abstractmethod
    def _told(self, stamp_ns: int, totals: Sequence[int], continuous: bool) -> Reading:
        """The reading of one instant. totals: running counts, by node."""

    # ---- what a conversation shows

    @property
    def state(self) -> LinkState:
        if not all(node.answered for node in self._nodes):
            return LinkState.SILENT
        return LinkState.RUNNING if self._running and self._all_started() else LinkState.STARTING

    @property
    def trouble(self) -> str | None:
        troubles = [trouble for node in self._nodes if (trouble := node.trouble) is not None]
        if self._foreign_sync:
            troubles.append("another member of the bus sends SYNC too: switch one of the two off (produce_sync)")
        if self._fallen_back:
            troubles.append("SYNC is not answered (TPDO2): reading by timer, the wheels are not sampled together")
        return "; ".join(troubles) or None

    @property
    def identity(self) -> Identity | None:
        identities = [node.identity for node in self._nodes]
        if Identity() in identities:
            return None
        return Identity(*(reduce(_both, each) for each in zip(*map(_fields, identities))))

    @property
    def clock_fit(self) -> ClockFit | None:
        """Encoders have no clock."""
        return None

    @property
    def counters(self) -> SourceCounters:
        return self._counters

    @property
    def silence_limit_ns(self) -> int:
        return silence_limit(self._period_ns)

    # ---- how it is driven

    def connected(self, now_ns: int) -> None:
        self._restart(now_ns)

    def requests(self, now_ns: int) -> Sequence[CanFrame | SetBaudRate]:
        frames = [frame for node in self._nodes for frame in node.requests(now_ns)]
        if not self._all_started():
            self._pause()
        else:
            self._notice_deafness(now_ns)
            if self._sync_is_due(now_ns):
                frames.append(_SYNC)
        return frames

    def next_request_ns(self) -> int:
        """When the next SYNC is due, if it is not held back by answers still out."""
        if self._cyclic or not self._produce_sync or not self._all_started():
            return _NEVER
        return self._sync_due_ns if self._round is None else self._round_ends_ns(self._round)

    def prepared(self) -> CanFrame | None:
        """The SYNC of next_request_ns(), if one is to be sent then."""
        is_next = self._produce_sync and not self._cyclic and self._round is None and self._all_started()
        return _SYNC if is_next else None

    def hears(self, chunk: CanFrame) -> bool:
        """Whether a frame is of one of the nodes, or SYNC."""
        return chunk.can_id in self._handlers

    def receive(self, chunk: CanFrame, stamp_ns: int) -> Iterator[Reading]:
        handler = self._handlers.get(chunk.can_id)
        if handler is None or chunk.extended or chunk.remote:
            return iter(())
        self._counters.chunks += 1
        self._counters.bytes += len(chunk.data)
        reading = handler(chunk.data, stamp_ns)
        if reading is None and not self._proved:
            return iter(())
        readings = self._proved if reading is None else [*self._proved, reading]
        self._proved = []
        self._running = True
        self._counters.readings += len(readings)
        return iter(readings)

    def farewell(self) -> Sequence[CanFrame | SetBaudRate]:
        """The nodes go back to pre-operational and send no more positions."""
        return [frame for node in self._nodes for frame in node.farewell()]

    # ---- beginning

    def _restart(self, now_ns: int) -> None:
        self._cyclic = self._sampling == "cyclic"
        self._fallen_back = False
        self._foreign_sync = False
        self._begin_nodes(now_ns)

    def _begin_nodes(self, now_ns: int) -> None:
        for node in self._nodes:
            node.begin(now_ns, cyclic=self._cyclic)
            node.missing = False
        self._tracks = [_Track() for _ in self._nodes]
        self._listen()
        self._pause()

    def _listen(self) -> None:
        """Which id means what; others are ignored at the cost of one look-up."""
        self._handlers: dict[int, Callable[[bytes, int], Reading | None]] = {_SYNC_ID: self._take_sync}
        for side, node in enumerate(self._nodes):
            self._handlers[node.sync_pdo_id] = partial(self._take_sync_pdo, side)
            self._handlers[node.cyclic_pdo_id] = partial(self._take_timer_pdo, side)
            self._handlers[ANSWER_ID + node.node] = partial(self._take_sdo, node)
            self._handlers[0x700 + node.node] = partial(self._take_heartbeat, node)
            self._handlers[0x080 + node.node] = partial(self._take_emergency, node)

    def _pause(self) -> None:
        """No readings until both nodes are started; the first one then follows from nothing."""
        self._running = False
        self._fresh = True
        self._round: _Round | None = None
        self._debts = [_Debt() for _ in self._nodes]
        self._sync_due_ns = 0
        self._deaf_since_ns: int | None = None
        self._trips_ns: deque[int] = deque(maxlen=_TRIPS_KEPT)  # from SYNC to the first answer

    def _all_started(self) -> bool:
        return all(node.phase is _Phase.STARTED for node in self._nodes)

    # ---- sampling by SYNC

    def _sync_is_due(self, now_ns: int) -> bool:
        """Begin a round if it is time and the last one is answered: an answer can then belong to one SYNC only."""
        if self._cyclic or not self._produce_sync:
            return False
        if self._round is not None:
            if now_ns < self._round_ends_ns(self._round):
                return False
            self._end_round(self._round, now_ns)
        if now_ns < self._sync_due_ns:
            return False
        late = now_ns - self._sync_due_ns > self._period_ns
        self._sync_due_ns = (now_ns if late else self._sync_due_ns) + self._period_ns
        self._begin_round(now_ns)
        return True

    def _begin_round(self, sync_ns: int) -> None:
        self._round = _Round(sync_ns, [None for _ in self._nodes], [0 for _ in self._nodes])

    def _answer_limit_ns(self) -> int:
        return max(2 * self._period_ns, _SHORTEST_ANSWER_LIMIT_NS)

    def _round_ends_ns(self, current: _Round) -> int:
        """Until when nothing else is asked: so long an answer may still come to this SYNC, or show that it was not."""
        if current.is_complete:
            return max((debt.quiet_ns or 0 for debt in self._debts), default=0)
        return current.sync_ns + self._answer_limit_ns()

    def _end_round(self, current: _Round, now_ns: int) -> None:
        """The next SYNC goes out. A complete round is a reading by now, unless it is not clear whose answers it has;
        else those that did not answer may do so yet."""
        self._round = None
        if current.is_complete:
            if any(debt.is_doubtful or debt.is_due(now_ns) for debt in self._debts):
                self._counters.drop("ambiguous_pdo")
            else:
                self._proved.append(self._reading_of(current, now_ns))
        else:
            self._counters.drop("sync_unanswered")
        for debt, raw in zip(self._debts, current.raw):
            if debt.quiet_ns is not None and now_ns >= debt.quiet_ns:
                debt.forget()
            debt.open += raw is None

    def _take_sync(self, data: bytes, stamp_ns: int) -> None:
        if not self._produce_sync:
            if self._round is not None:
                self._end_round(self._round, stamp_ns)
            self._begin_round(stamp_ns)
        elif self._round is None or self._round.first_answer_ns is not None:  # else it may be the echo of our own
            self._foreign_sync = True
            self._counters.drop("foreign_sync")

    def _take_sync_pdo(self, side: int, data: bytes, stamp_ns: int) -> Reading | None:
        node = self._nodes[side]
        node.hear(stamp_ns)
        if self._cyclic or not self._all_started():
            return None
        current, debt = self._round, self._debts[side]
        is_due = debt.is_due(stamp_ns)
        if is_due:
            debt.quiet_ns = stamp_ns + 3 * self._period_ns // 4
        if current is None or current.raw[side] is not None:
            if not is_due:
                self._counters.drop("extra_pdo")
                return None
            debt.open, debt.paid = debt.open - 1, debt.paid + 1  # its SYNC is counted as unanswered
            if debt.open == 0:
                debt.forget()
        if current is None:
            return None
        raw = node.position(data)
        if raw is None:
            return None
        current.raw[side], current.heard_ns[side] = raw, stamp_ns
        if not current.is_complete or any(debt.open > 0 for debt in self._debts):
            return None
        self._round = None
        return self._reading_of(current, stamp_ns)

    def _reading_of(self, current: _Round, now_ns: int) -> Reading:
        first_ns = current.first_answer_ns
        assert first_ns is not None
        self._deaf_since_ns = now_ns
        answers = [answer for answer in current.raw if answer is not None]
        return self._reading(answers, self._sampled_ns(current.sync_ns, first_ns))

    def _sampled_ns(self, sync_ns: int, answer_ns: int) -> int:
        """When the nodes heard SYNC: between its sending and the first answer.

        The way there and back is about equally long (adapter, host), so the middle is right to within half their
        difference. Longer than the limit no answer takes by itself: then this program was held up while the answer lay
        waiting, or the bus was, and the ways took what they usually take.
        """
        trip_ns = answer_ns - sync_ns
        if not self._produce_sync or trip_ns <= self._answer_limit_ns():
            self._trips_ns.append(trip_ns)
        else:
            trip_ns = sorted(self._trips_ns)[len(self._trips_ns) // 2] if self._trips_ns else self._answer_limit_ns()
        return sync_ns + trip_ns // 2

    def _reading(self, answers: Sequence[int], stamp_ns: int) -> Reading:
        stamp_ns = max(stamp_ns, self._last_stamp_ns + 1)
        self._last_stamp_ns = stamp_ns
        known = [node.unwrapper.advance(raw, stamp_ns) for node, raw in zip(self._nodes, answers)]
        if not self._fresh and not all(known):
            self._counters.drop("discontinuity")
        continuous = all(known) and not self._fresh
        self._fresh = False
        return self._told(stamp_ns, [node.unwrapper.total for node in self._nodes], continuous)

    def _notice_deafness(self, now_ns: int) -> None:
        """Both nodes live and are started, but SYNC brings no pair of positions: read them by timer instead."""
        if self._cyclic or self._sampling != "auto":
            return
        if self._deaf_since_ns is None or any(node.starts_refused for node in self._nodes):
            self._deaf_since_ns = (
                now_ns  # who is not operational answers no SYNC, and would send nothing by timer either
            )
        if self._running or now_ns - self._deaf_since_ns <= _SYNC_PATIENCE_NS:
            return
        self._cyclic = self._fallen_back = True
        self._begin_nodes(now_ns)

    # ---- sampling by timer

    def _take_timer_pdo(self, side: int, data: bytes, stamp_ns: int) -> Reading | None:
        node = self._nodes[side]
        node.hear(stamp_ns)
        if not self._cyclic or not self._all_started():
            return None
        raw = node.position(data)
        if raw is None:
            return None
        track = self._tracks[side]
        if not node.unwrapper.advance(raw, stamp_ns):
            self._fresh = True
            track.newest = None
        track.before, track.newest = track.newest, (stamp_ns, node.unwrapper.total)
        return self._interpolated()

    def _interpolated(self) -> Reading | None:
        """All totals at the newest time that all are known for: those that spoke later are interpolated."""
        newest = [track.newest for track in self._tracks if track.newest is not None]
        if len(newest) < len(self._tracks):
            return None
        stamp_ns = min(stamp for stamp, _ in newest)
        totals = [total for track in self._tracks if (total := track.at(stamp_ns)) is not None]
        if stamp_ns <= self._last_stamp_ns or len(totals) < len(self._tracks):
            return None
        self._last_stamp_ns = stamp_ns
        continuous = not self._fresh
        self._fresh = False
        return self._told(stamp_ns, totals, continuous)

    # ---- the rest of the nodes' frames

    def _take_sdo(self, node: _Node, data: bytes, now_ns: int) -> None:
        node.hear(now_ns)
        node.take_sdo(data, now_ns)
        if node.phase is _Phase.STARTED:
            self._listen()  # it may have told other PDO ids

    def _take_heartbeat(self, node: _Node, data: bytes, now_ns: int) -> None:
        node.hear(now_ns)
        node.take_heartbeat(data, now_ns)
        if not self._all_started():
            self._pause()

    def _take_emergency(self, node: _Node, data: bytes, now_ns: int) -> None:
        node.hear(now_ns)
        node.take_emergency(data)


class Cia406PairConversation(_Cia406Conversation):
    """The two wheel encoders of a differential drive. Counts are in the nodes' own directions: signs are configuration.

    sync_rate_hz: of our SYNC, and so of the readings.  produce_sync: False where another member of the bus does it.
    sampling: see Sampling.  max_turns_per_s: of the encoder's shaft; bounds how long a gap may hide a wrap.
    """

    def __init__(
        self,
        node_left: int,
        node_right: int,
        *,
        sync_rate_hz: float = 100.0,
        produce_sync: bool = True,
        sampling: Sampling = "auto",
        max_turns_per_s: float = 20.0,
    ) -> None:
        if node_left == node_right:
            raise ValueError(f"both wheels are node {node_left:02X}h: each encoder needs a node id of its own")
        super().__init__(
            ((node_left, "left wheel"), (node_right, "right wheel")),
            sync_rate_hz=sync_rate_hz,
            produce_sync=produce_sync,
            sampling=sampling,
            max_turns_per_s=max_turns_per_s,
        )

    def _told(self, stamp_ns: int, totals: Sequence[int], continuous: bool) -> WheelReading:
        left, right = totals
        return WheelReading(stamp_ns, left, right, continuous)


class Cia406AxleConversation(_Cia406Conversation):
    """One encoder whose count is an angle, as on the axle of a nodding mount: read by its own timer, so that it needs
    no SYNC and shares a bus with wheels that have one. The arguments as above."""

    def __init__(self, node: int, *, rate_hz: float = 100.0, max_turns_per_s: float = 20.0) -> None:
        self._offset = 0
        super().__init__(
            ((node, "axle"),),
            sync_rate_hz=rate_hz,
            produce_sync=False,
            sampling="cyclic",
            max_turns_per_s=max_turns_per_s,
        )

    def _told(self, stamp_ns: int, totals: Sequence[int], continuous: bool) -> AngleReading:
        absolute = self._nodes[0].unwrapper.absolute
        if not continuous and absolute is not None:
            self._offset = absolute - totals[0]
        return AngleReading(stamp_ns, totals[0] + self._offset, continuous)


def _fields(identity: Identity) -> tuple[str, str, str, str]:
    return identity.vendor, identity.model, identity.serial, identity.firmware


def _both(left: str, right: str) -> str:
    """Told once if both wheels say the same."""
    return left if left == right else f"{left} / {right}"
