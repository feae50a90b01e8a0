"""Sends outputs over Zenoh: newest wins (of readings the newest eight), losses are counted; answers get() and calls.

fusion --send---------------------------------> publishers            (sector maps: nothing may delay them)
       --defer--> flush() --------------------> publishers            (scans, poses, ranges: when these have left)
others --offer--> outbox --> stream thread --> publishers            (health, documents)
              \\-> outbox --> map thread   --> publishers            (grids: slow, so they delay nothing else)
                             last values --> answer thread --> get()

Waking a thread costs more than most messages: fusion sends what it measured by itself. Who offers much at once says
`wake=False`, and `wake()` once at the end.
"""

from __future__ import annotations

import json
import logging
import queue
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from service import export, topics, zenoh_session
from service.clock import Clock
from service.namesakes import Namesakes
from service.outputs import (
    CloudOut,
    DocumentOut,
    GridOut,
    GridUpdateOut,
    HealthOut,
    LookOut,
    OdomOut,
    Output,
    PolarOut,
    PoseOut,
    RangesOut,
    RectOut,
    ScanOut,
)
from service.payloads import Encoder, Message, RobotInfo
from service.ros import RosMirror, RosSettings
from service.rpc import Calls
from service.tls import Certificate, own_certificate
from service.topics import Lane
from service.zenoh_session import NetworkSettings, Readers

_LOG = logging.getLogger(__name__)
_UPDATES_WAITING_MAX = 64
_READINGS_WAITING_MAX = 8
_QUERIES_WAITING_MAX = 64

Parcel = Callable[[], list[Message]]


class Outbox:
    """What waits to be sent by one thread: one parcel a slot, the newest; or a short queue where order matters.

    Thread-safe. dropped counts parcels by slot that were replaced, fell out of a full queue or were superseded.
    """

    def __init__(self) -> None:
        self._slots: OrderedDict[str, deque[Parcel]] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False
        self._asleep = False  # whoever takes waits, and nobody has woken it
        self.dropped: Counter[str] = Counter()

    def put(
        self, slot: str, parcel: Parcel, *, depth: int = 1, supersedes: str | None = None, wake: bool = True
    ) -> None:
        """Add a parcel; beyond depth the slot's oldest is lost. supersedes: a slot that this parcel empties.

        wake: False if wake() follows soon.
        """
        with self._changed:
            if supersedes is not None and (old := self._slots.pop(supersedes, None)):
                self.dropped[supersedes] += len(old)
            waiting = self._slots.setdefault(slot, deque())
            waiting.append(parcel)
            if len(waiting) > depth:
                waiting.popleft()
                self.dropped[slot] += 1
            if wake:
                self._wake()

    def wake(self) -> None:
        """Whoever takes is to look what waits."""
        with self._changed:
            if self._slots:
                self._wake()

    def _wake(self) -> None:
        if self._asleep:
            self._asleep = False
            self._changed.notify()

    def take(self) -> Parcel | None:
        """The parcel that waited longest, waiting for one; None when closed and empty."""
        with self._changed:
            while not self._slots:
                if self._closed:
                    return None
                self._asleep = True
                self._changed.wait()
            self._asleep = False
            slot, waiting = next(iter(self._slots.items()))
            parcel = waiting.popleft()
            if not waiting:
                del self._slots[slot]
            else:
                self._slots.move_to_end(slot)
            return parcel

    def close(self) -> None:
        """What waits is still taken; then take() gives None."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


@dataclass(frozen=True, slots=True)
class _Kept:
    """The last value of a key. measured_ns: monotonic.  grid: what is behind it, for other formats."""

    message: Message
    measured_ns: int
    grid: GridOut | None = None


class Publisher:
    """The daemon's Zenoh side. Construct, register calls, start(), offer() outputs, close()."""

    def __init__(
        self,
        base: str,
        network: NetworkSettings,
        *,
        clock: Clock,
        encoder: Encoder | None = None,
        ros: RosSettings | None = None,
    ) -> None:
        """clock: monotonic stamps leave as wall time by it.  ros: also speak rmw_zenoh if given."""
        self.base = topics.check_base(base)
        self.calls = Calls(base)
        self._network = network
        self._clock = clock
        self._encoder = encoder or Encoder()
        self._ros_settings = ros
        self._ros: RosMirror | None = None
        self._session: Any = None
        self._token: Any = None
        self._namesakes: Namesakes | None = None
        self._certificate: Certificate | None = None
        self._told_of_certificate: str | None = None
        self._outboxes = {lane: Outbox() for lane in Lane}
        self._publishers: dict[str, tuple[Any, Readers | None]] = {}
        self._last: dict[str, _Kept] = {}
        self._queries: queue.Queue[Any] = queue.Queue(_QUERIES_WAITING_MAX)
        self._threads: list[threading.Thread] = []
        self._deferred: list[Output] = []
        self._taps: list[Callable[[Message], None]] = []
        self._counts: Counter[str] = Counter()
        self._complained: set[str] = set()

    def add_tap(self, tap: Callable[[Message], None]) -> None:
        """Every message is also handed to tap, from the sending threads: a recording, for instance. Before start()."""
        self._taps.append(tap)

    def start(self, *, announce: bool = True) -> None:
        """Open the router and begin. PortInUse or NetworkTrouble if that cannot be.

        announce: say that the robot is there; else announce() does, when it can answer every call.
        """
        if self._network.tls is not None:
            self._certificate = own_certificate(self._network.tls)
        self._session = zenoh_session.open_router(self._network)
        if self._ros_settings is not None:
            self._ros = RosMirror(self._session, self._ros_settings)
        zenoh_session.declare_queryable(self._session, f"{self.base}/**", self._on_query)
        self.calls.start(self._session)
        for lane in Lane:
            self._spawn(f"publish-{lane.value}", self._send_loop, self._outboxes[lane])
        self._spawn("publish-answers", self._answer_loop)
        if announce:
            self.announce()

    def announce(self) -> None:
        """Put the liveliness token up, and look for other daemons of this robot's id."""
        self._token = self._session.liveliness().declare_token(f"{self.base}/{topics.ALIVE}")
        self._namesakes = Namesakes(self._session, self.base)

    def troubles(self, now_ns: int) -> list[str]:
        """What is wrong with the network, in words; for one thread."""
        namesakes = None if self._namesakes is None else self._namesakes.trouble(now_ns)
        return [each for each in (namesakes, self._certificate_trouble(now_ns)) if each is not None]

    def _certificate_trouble(self, now_ns: int) -> str | None:
        if self._certificate is None:
            return None
        trouble = self._certificate.trouble(self._clock.wall_from_monotonic_ns(now_ns) / 1e9, self._network.listen)
        if trouble is not None and trouble != self._told_of_certificate:
            _LOG.error("%s", trouble)
        self._told_of_certificate = trouble
        return trouble

    def _spawn(self, name: str, target: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=target, args=arguments, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def send(self, output: Output) -> None:
        """Send at once, from the thread that has it; outputs of one kind from one thread.

        A congested link may hold this up as long as Zenoh waits before it drops, a millisecond by default; what follows
        is dropped without waiting.
        """
        self._send_all(partial(self._encode, output))

    def defer(self, output: Output) -> None:
        """Send from this thread with the next flush(). For one thread, the one that also calls flush()."""
        self._deferred.append(output)

    def flush(self) -> None:
        """Send what was deferred, in order, and wake the threads for what was offered with wake=False."""
        deferred, self._deferred = self._deferred, []
        for output in deferred:
            self.send(output)
        self.wake()

    def wake(self) -> None:
        """After outputs were offered with wake=False."""
        for outbox in self._outboxes.values():
            outbox.wake()

    def offer(self, output: Output, *, wake: bool = True) -> None:
        """Send this soon, or something newer of its kind. Never waits; any thread. wake: False if wake() follows.

        Full grids are to be offered at most once a second, each before the updates of its epoch.
        """
        slot = slot_of(output)

        def parcel() -> list[Message]:
            return self._encode(output)

        match output:
            case GridOut(name="grid"):
                self._outboxes[Lane.MAP].put(slot, parcel, supersedes=topics.MAP_GRID_UPDATE.pattern, wake=wake)
            case GridOut() | CloudOut():
                self._outboxes[Lane.MAP].put(slot, parcel, wake=wake)
            case DocumentOut():
                self._outboxes[topics.topic_of(output.key).lane].put(slot, parcel, wake=wake)
            case LookOut():
                pass  # for the makers of maps only
            case GridUpdateOut():
                self._outboxes[Lane.MAP].put(slot, parcel, depth=_UPDATES_WAITING_MAX, wake=wake)
            case ScanOut() | OdomOut() | RangesOut():  # as measured: what comes in bursts is sent one after the other
                self._outboxes[Lane.STREAM].put(slot, parcel, depth=_READINGS_WAITING_MAX, wake=wake)
            case _:
                self._outboxes[Lane.STREAM].put(slot, parcel, wake=wake)

    def odometry_is_read(self) -> bool:
        """Whether anybody gets every motion: a subscriber of `odom` or `tf`, or ROS. True while that is not known yet.
        Any thread."""
        if self._ros is not None:
            return True
        found = [self._publishers.get(key) for key in (topics.ODOM.pattern, topics.TF_KEY.pattern)]
        return any(each is None or each[1] is None or each[1].any for each in found)

    def publish_info(self, info: RobotInfo) -> None:
        """Send `info` and the fixed transforms; again whenever they change."""
        self._outboxes[Lane.STREAM].put("info", lambda: self._encoder.info(info))

    def counters(self) -> dict[str, int]:
        """Everything sent, lost and refused so far, by name."""
        counts = dict(self._counts)
        for outbox in self._outboxes.values():
            counts |= {f"not_sent.{slot}": count for slot, count in outbox.dropped.copy().items()}
        counts["calls_answered"] = self.calls.answered
        counts["calls_failed"] = self.calls.failed
        counts["calls_refused"] = self.calls.refused
        counts["grid_update_cells_outside"] = self._encoder.cells_outside
        return counts

    def close(self, deadline_s: float = 3.0) -> bool:
        """Send what waits, close the session; False if the deadline passed (end the process with os._exit then)."""
        end_ns = self._clock.now_ns() + int(deadline_s * 1e9)

        def left_s() -> float:
            return max(0.05, (end_ns - self._clock.now_ns()) / 1e9)

        for outbox in self._outboxes.values():
            outbox.close()
        self._stop_answers()
        self.calls.stop(left_s() / 2)
        for thread in self._threads:
            thread.join(left_s())
        closed = self._session is None or zenoh_session.close_within(self._session, left_s())
        self._session = None
        return closed and not any(thread.is_alive() for thread in self._threads)

    def _encode(self, output: Output) -> list[Message]:
        offset_ns = self._clock.wall_from_monotonic_ns(0)
        messages = self._encoder.encode(output, offset_ns)
        if isinstance(output, GridOut):
            self._last[messages[0].suffix] = _Kept(messages[0], messages[0].stamp_ns - offset_ns, output)
        return messages

    def _send_loop(self, outbox: Outbox) -> None:
        while (parcel := outbox.take()) is not None:
            self._send_all(parcel)

    def _send_all(self, parcel: Parcel) -> None:
        try:
            for message in parcel():
                self._send(message)
        except Exception as error:  # one bad value must not silence the robot; it is counted and told once
            self._counts["not_sent_errors"] += 1
            self._complain(error)

    def _complain(self, error: Exception) -> None:
        kind = f"{type(error).__name__}: {error}"[:200]
        if kind not in self._complained and len(self._complained) < 100:
            self._complained.add(kind)
            _LOG.error("a value could not be published: %s", kind, exc_info=error)

    def _send(self, message: Message) -> None:
        kept = self._last.get(message.suffix)
        if kept is None or kept.message is not message:
            measured_ns = message.stamp_ns - self._clock.wall_from_monotonic_ns(0)
            self._last[message.suffix] = _Kept(message, measured_ns)
        publisher, readers = self._publisher_of(message)
        if readers is None or readers.any:
            publisher.put(message.payload, encoding=message.encoding, attachment=message.attachment)
            self._counts["sent"] += 1
        if self._ros is not None:
            self._ros.publish(message)
        for tap in self._taps:
            tap(message)

    def _publisher_of(self, message: Message) -> tuple[Any, Readers | None]:
        """readers: None for a key whose cache must hold every value for late joiners."""
        found = self._publishers.get(message.suffix)
        if found is None:
            topic, key = message.topic, f"{self.base}/{message.suffix}"
            if topic.cached:
                found = zenoh_session.declare_latched(self._session, key, topic.priority), None
            else:
                stream = zenoh_session.declare_stream(self._session, key, topic.priority, express=topic.express)
                found = stream, Readers(stream)
            self._publishers[message.suffix] = found
        return found

    def _on_query(self, query: Any) -> None:
        try:
            self._queries.put_nowait(query)
        except queue.Full:
            self._counts["queries_refused"] += 1
            with query:
                query.reply_err(b"busy: too many queries are waiting; try again", encoding="text/plain")

    def _stop_answers(self) -> None:
        try:
            self._queries.put_nowait(None)
        except queue.Full:
            self._queries.get_nowait()
            self._queries.put_nowait(None)

    def _answer_loop(self) -> None:
        while (query := self._queries.get()) is not None:
            with query:
                try:
                    self._answer(query)
                    self._counts["queries_answered"] += 1
                except Exception as error:
                    self._counts["queries_failed"] += 1
                    self._complain(error)

    def _answer(self, query: Any) -> None:
        wanted = query.key_expr
        picture = query.parameters.get("format")
        youngest_ns = self._youngest_allowed(query.parameters.get("max_age"))
        for suffix, kept in list(self._last.items()):
            key = f"{self.base}/{suffix}"
            if not wanted.intersects(key) or kept.measured_ns < youngest_ns:
                continue
            if picture is None or kept.grid is None:
                message = kept.message
                query.reply(key, message.payload, encoding=message.encoding, attachment=message.attachment)
            elif picture in export.GRID_FORMATS:
                grid = kept.grid
                properties = export.grid_properties(
                    grid.patch, kept.message.stamp_ns, frame=grid.frame, frame_from_grid=grid.frame_from_grid
                )
                payload, encoding = export.render_grid(grid.patch, picture, properties)
                query.reply(key, payload, encoding=encoding, attachment=json.dumps(properties))
            else:
                text = f"format={picture}: there are {', '.join(export.GRID_FORMATS)}"
                query.reply_err(text.encode(), encoding="text/plain")

    def _youngest_allowed(self, max_age: str | None) -> int:
        """The oldest measurement to answer with, from `max_age` in seconds: by the monotonic clock, since one that was
        set back would make old values young."""
        try:
            seconds = float(max_age) if max_age else None
        except ValueError:
            seconds = None
        if seconds is None or seconds < 0:
            return -(1 << 62)
        return self._clock.now_ns() - int(min(seconds, 1e9) * 1e9)


def slot_of(output: Output) -> str:
    """Outputs with the same slot replace each other while they wait."""
    match output:
        case ScanOut():
            return f"scan/{output.sensor}"
        case LookOut():
            return f"look/{output.sensor}"
        case CloudOut():
            return f"cloud/{output.mount}"
        case PolarOut():
            return f"sectors/polar/{output.name}"
        case RectOut():
            return f"sectors/rect/{output.name}"
        case OdomOut():
            return "odom"
        case PoseOut():
            return "pose"
        case GridOut():
            return f"map/{output.name}"
        case GridUpdateOut():
            return topics.MAP_GRID_UPDATE.pattern
        case HealthOut():
            return "health"
        case DocumentOut():
            return output.key
        case _:
            return f"range/{output.sensor}"
