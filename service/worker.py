"""The fusion thread: takes what the wires say, hands it to fusion, publishes what comes out, beats the watchdog.

Everything that touches the maps happens here; other threads ask (`ask`) and wait. A sweep goes before sonar rounds,
questions, the grids and reports that wait, whenever it comes: it is what a robot brakes by, and each of them takes a
millisecond or more.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TypeVar

from drivers.queues import BoundedQueue
from drivers.readings import ChainReading, DeviceEvent, PoseReading, Reading, ScanReading, WheelReading
from service.errors import Trouble
from service.fusion import POSE_PERIOD_NS, SECOND, TICK_PERIOD_NS, Fusion
from service.outputs import HealthOut, Output

log = logging.getLogger(__name__)

QUEUE_LIMIT = 2048  # seconds of readings; a consumer this late is a fault, not a jam
_HEALTH_PERIOD_NS = SECOND
_FIRST_HEALTH_NS = 300_000_000
_HEALTH_GAP_NS = SECOND // 10  # between two reports, however much changes
_ASK_LIMIT_S = 10.0
_ASK_LOOK_S = 0.2

T = TypeVar("T")


class _Asked:
    """A function that another thread wants run here."""

    def __init__(self, work: Callable[[], object]) -> None:
        self.work = work
        self.done = threading.Event()
        self.result: object = None
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self.result = self.work()
        except BaseException as error:  # it belongs to the thread that asked
            self.error = error
        finally:
            self.done.set()


Item = Reading | DeviceEvent | _Asked


class Worker:
    """Owns the fusion thread. `sink` is where readers put readings; `offer` takes outputs and never blocks."""

    def __init__(
        self,
        fusion: Fusion,
        offer: Callable[[Output], None],
        *,
        now_ns: Callable[[], int],
        beat: Callable[[int], None],
        health: Callable[[int], HealthOut],
        offered: Callable[[], None] = lambda: None,
        odometry_is_read: Callable[[], bool] = lambda: True,
    ) -> None:
        """offered: called when nothing more is offered for a while.  odometry_is_read: whether anybody gets every
        motion of the wheels; asked from readers' threads."""
        self._fusion = fusion
        self._offer = offer
        self._offered = offered
        self._odometry_is_read = odometry_is_read
        self._sweep_waits = False  # for the next motion, to be drawn
        self._woken_ns: dict[str, int] = {}  # by source of motion: stamp of the last that this thread was woken for
        self._now_ns = now_ns
        self._beat = beat
        self._health = health
        self._queue: BoundedQueue[Item] = BoundedQueue(QUEUE_LIMIT, keep=_is_kept)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fusion", daemon=True)
        self._next_tick_ns = 0
        self._next_health_ns = 0
        self._health_told_ns = -_HEALTH_GAP_NS
        self.errors = 0
        self.longest_turn_ns = 0

    def start(self) -> None:
        """Begin. The first health report leaves time for the wires to be opened."""
        self._next_health_ns = self._now_ns() + _FIRST_HEALTH_NS
        self._thread.start()

    def stop(self, deadline_s: float) -> bool:
        """Work off what waits and end; False if that took longer."""
        self._stopping.set()
        self._thread.join(deadline_s)
        return not self._thread.is_alive()

    def sink(self, source: str, item: Reading | DeviceEvent) -> None:
        """For readers; never blocks."""
        self._queue.put(source, item, urgent=not self._can_wait(source, item))

    def _can_wait(self, source: str, item: Reading | DeviceEvent) -> bool:
        """Whether the fusion thread, which a tick wakes at the latest, need not be woken for this.

        A hundred motions a second are wanted where odometry is read. Elsewhere they are for the poses of the robot,
        which are told every 25 ms, and of scans: the first one behind a scan is taken at once, so that the scan is
        drawn long before the next one comes.
        """
        if not isinstance(item, WheelReading | PoseReading) or self._odometry_is_read():
            return False
        if self._sweep_waits:
            self._sweep_waits = False
            return False
        woken_ns = self._woken_ns.get(source)
        if woken_ns is not None and 0 <= item.stamp_ns - woken_ns < POSE_PERIOD_NS:
            return True
        self._woken_ns[source] = item.stamp_ns
        return False

    def ask(self, work: Callable[[], T]) -> T:
        """Run a function between two readings and give its result. Trouble if that does not happen soon."""
        if threading.current_thread() is self._thread or not self._thread.is_alive():
            return work()
        asked = _Asked(work)
        self._queue.put("", asked)
        end_ns = self._now_ns() + round(_ASK_LIMIT_S * SECOND)
        while not asked.done.wait(_ASK_LOOK_S):
            if not self._thread.is_alive() and not asked.done.is_set():  # it ended without having looked again
                asked.run()
            elif self._now_ns() >= end_ns:
                raise Trouble(f"the fusion thread did not answer within {_ASK_LIMIT_S:.0f} s; see its log")
        if asked.error is not None:
            raise asked.error
        return asked.result  # type: ignore[return-value]

    def counters(self) -> dict[str, int]:
        """Depth and losses of the queue, and what went wrong."""
        dropped = {f"queue.dropped.{source}": count for source, count in sorted(self._queue.dropped().items())}
        return {
            "queue.depth": len(self._queue),
            "fusion.errors": self.errors,
            "fusion.longest_turn_us": self.longest_turn_ns // 1000,
            **dropped,
        }

    def turn(self, timeout_s: float) -> None:
        """One turn of the loop; tests call it without the thread."""
        items = self._queue.get_all(timeout_s)
        began_ns = self._now_ns()
        first = goes_first(items)
        is_news = any(isinstance(item, DeviceEvent) for _, item in items)
        for place in first:
            self._handle(*items[place])
        for place in (place for place in range(len(items)) if place not in first):
            if not is_news:
                self._let_sweeps_ahead()
            self._handle(*items[place])
        if items:
            self._offered()  # before the slow part
            self._let_sweeps_ahead()
            self._guard("settle", partial(self._settle, self._now_ns()))
        if self._now_ns() >= self._next_tick_ns:
            self._let_sweeps_ahead()
            now_ns = self._now_ns()
            self._next_tick_ns = now_ns + TICK_PERIOD_NS
            self._guard("tick", partial(self._fusion.tick, now_ns))
        if self._now_ns() >= self._next_health_ns:
            self._let_sweeps_ahead()
            self._tell_health(self._now_ns())
        self._offered()
        self._beat(self._now_ns())
        self.longest_turn_ns = max(self.longest_turn_ns, self._now_ns() - began_ns)

    def _let_sweeps_ahead(self) -> None:
        """Take sweeps that came meanwhile."""
        for source, item in self._queue.take(sweeps_first):
            self._handle(source, item)

    def _handle(self, source: str, item: Item) -> None:
        if isinstance(item, _Asked):
            item.run()
            return
        self._take(source, item)
        if isinstance(item, ScanReading):
            self._sweep_waits = True
        if isinstance(item, DeviceEvent):
            self._next_health_ns = min(self._next_health_ns, self._health_told_ns + _HEALTH_GAP_NS)

    def _run(self) -> None:
        while not self._stopping.is_set():
            self.turn(max(0.0, (self._next_tick_ns - self._now_ns()) / SECOND))
        self.turn(0.0)

    def _take(self, source: str, item: Reading | DeviceEvent) -> None:
        self._guard(source, lambda: self._fusion.stream(source, item, self._now_ns()))

    def _guard(self, source: str, work: Callable[[], Iterable[Output]]) -> None:
        """No reading may end the daemon: a bug is logged with its traceback once a kind, counted, and work goes on."""
        try:
            for output in work():
                self._offer(output)
        except Exception as error:
            self.errors += 1
            if self.errors <= 20 or self.errors % 1000 == 0:
                log.exception("%s: internal error in fusion (%s); the reading is lost", source, error)

    def _settle(self, now_ns: int) -> list[Output]:
        self._fusion.settle(now_ns)
        return []

    def _tell_health(self, now_ns: int) -> None:
        self._health_told_ns = now_ns
        self._next_health_ns = now_ns + _HEALTH_PERIOD_NS
        self._guard("health", lambda: [self._health(now_ns)])
        self.longest_turn_ns = 0


def goes_first(items: Sequence[tuple[str, Item]]) -> list[int]:
    """Places, rising, of all that is neither a round of sonars nor a question.

    None where there are news about a device: they say what the readings around them are worth.
    """
    if any(isinstance(item, DeviceEvent) for _, item in items):
        return []
    return [place for place, (_, item) in enumerate(items) if not isinstance(item, ChainReading | _Asked)]


def sweeps_first(items: Sequence[tuple[str, Item]]) -> list[int]:
    """The same of what came up to the newest sweep; none where there is no sweep."""
    newest = max((place for place, (_, item) in enumerate(items) if isinstance(item, ScanReading)), default=-1)
    return goes_first(items[: newest + 1])


def _is_kept(item: Item) -> bool:
    """Never thrown away while a reading can go instead: news about devices, and questions somebody waits for."""
    return isinstance(item, DeviceEvent | _Asked)
