"""Keeps what happens as MCAP: every item of every wire, the order in which fusion took the readings, all that is sent.

One recording (a "run") is a series of files NAME-0000.mcap, NAME-0001.mcap, ... of bounded size, ros2 profile:

    /umfeld/wires/<wire>     umfeld_msgs/msg/WireItem      bytes and CAN frames, both ways (drivers/recording.py)
    /umfeld/events           std_msgs/msg/String           JSON: devices that come and go; records that were lost
    /umfeld/fusion           umfeld_msgs/msg/FusionCalls   which reading was taken when
    /<key below the base>    as on Zenoh: CDR as it is, JSON documents as std_msgs/msg/String

Every file carries the configuration (metadata `umfeld.run`), the first one the map as it was at the start (attachments
`tile/<row>/<column>`), the last one a digest of the map at the end (metadata `umfeld.end`).

The threads of the daemon only append to a list; one thread of ours writes. When it cannot follow, published messages
are given up first; then wires, which is noted in the recording. The bound on disk space is kept by removing files from
the middle: the first one, with the set-up of all devices, stays. A disk that is full ends the file where it is whole,
makes room among our own files, and goes on.
"""

from __future__ import annotations

import hashlib
import json
import logging
import struct
import threading
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.ports import Direction, Tap
from drivers.reader import Sink
from drivers.readings import DeviceEvent, Identity, LinkState, Reading
from drivers.recording import Item, WireRecord, WireWriter
from mapping.grids.occupancy import TILE_HEADER, OccupancyGrid
from service.clock import Clock
from service.errors import Trouble
from service.fusion import Fusion
from service.outputs import Output
from service.payloads import Message

if TYPE_CHECKING:
    from service.recording_files import Files

log = logging.getLogger(__name__)

WIRES = "/umfeld/wires/"
EVENTS = "/umfeld/events"
FUSION = "/umfeld/fusion"
RUN, END = "umfeld.run", "umfeld.end"
TILE = "tile/"
SLAM_TILE = "slam/"
SUFFIX = ".mcap"
STRING = "std_msgs/msg/String"
CALLS_TYPE = "umfeld_msgs/msg/FusionCalls"
CALLS_DEFINITION = """uint32 calls
int64[] now_ns
uint32 stamps
int64[] stamp_ns
uint8[] kind
uint8[] source
"""

READING, EVENT, SETTLE, TICK = range(4)
"""Kinds of FusionCalls: a reading was taken, an event, poses were waited for no longer, the clock ticked."""

_DRAIN_PERIOD_S = 0.1
_CDR = b"\x00\x01\x00\x00"


@dataclass(frozen=True, slots=True)
class Settings:
    """Where to, and how much. published: also what is sent over Zenoh, not only what replay needs.

    waiting_bytes: what may wait to be written before anything is given up.
    """

    folder: Path
    file_bytes: int = 256_000_000
    total_bytes: int = 8_000_000_000
    free_bytes: int = 1_000_000_000
    published: bool = True
    waiting_bytes: int = 48_000_000


@dataclass(frozen=True, slots=True)
class Start:
    """What a replay begins from.

    config: the effective configuration as JSON.  sources: every source name; FusionCalls count in this list.
    pose: x, y, yaw of map_from_odom.  complete: from the first byte of a daemon's life, so that a replay ends with the
    very same map.  tiles: the map as it was, as OccupancyGrid.load_tile takes them.  slam: its layer of that name.
    """

    robot: str
    version: str
    config: str
    sources: tuple[str, ...]
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    complete: bool = True
    tiles: tuple[tuple[int, int, bytes], ...] = ()
    slam: tuple[tuple[int, int, bytes], ...] = ()


@dataclass(frozen=True, slots=True)
class Calls:
    """Calls of fusion, in order. stamp_ns: of the item taken, 0 for settle and tick."""

    now_ns: tuple[int, ...]
    stamp_ns: tuple[int, ...]
    kind: bytes
    source: bytes


def encode_calls(calls: Calls) -> bytes:
    """The CDR message; the counts before the arrays keep them aligned without padding."""
    count = len(calls.now_ns)
    return b"".join(
        (
            _CDR,
            struct.pack(f"<II{count}q", count, count, *calls.now_ns),
            struct.pack(f"<II{count}q", count, count, *calls.stamp_ns),
            struct.pack("<I", count),
            calls.kind,
            b"\0" * (-count % 4),
            struct.pack("<I", count),
            calls.source,
        )
    )


def decode_calls(message: bytes) -> Calls:
    """The calls in a message. Raises ValueError if it is none."""
    try:
        (count,) = struct.unpack_from("<I", message, 4)
        now_ns = struct.unpack_from(f"<{count}q", message, 12)
        stamp_ns = struct.unpack_from(f"<{count}q", message, 20 + 8 * count)
    except struct.error as error:
        raise ValueError(f"a torn message: {error}") from error
    place = 24 + 16 * count
    kind = message[place : place + count]
    place += count + (-count % 4) + 4
    source = message[place : place + count]
    if len(source) != count or len(kind) != count:
        raise ValueError("a torn message")
    return Calls(now_ns, stamp_ns, kind, source)


def event_text(source: str, event: DeviceEvent) -> str:
    """An event as JSON."""
    identity = None if event.identity is None else asdict(event.identity)
    document = {"source": source, "stamp_ns": event.stamp_ns, "state": event.state.name, "text": event.text}
    return json.dumps(document | {"identity": identity}, ensure_ascii=False)


def event_of(document: Mapping[str, Any]) -> tuple[str, DeviceEvent]:
    """The event in a JSON document of event_text."""
    identity = document.get("identity")
    return str(document["source"]), DeviceEvent(
        int(document["stamp_ns"]),
        LinkState[document["state"]],
        str(document["text"]),
        None if identity is None else Identity(**identity),
    )


def encode_string(text: str) -> bytes:
    """std_msgs/msg/String."""
    data = text.encode() + b"\0"
    return _CDR + struct.pack("<I", len(data)) + data


def decode_string(message: bytes) -> str:
    """The text of a std_msgs/msg/String."""
    (length,) = struct.unpack_from("<I", message, 4)
    return message[8 : 8 + length].removesuffix(b"\0").decode(errors="replace")


def digest_of(grid: OccupancyGrid) -> str:
    """SHA-256 over every cell of a map: two maps with the same digest are the same, bit for bit."""
    digest = hashlib.sha256()
    for row, column, payload in sorted(grid.tiles()):
        head, body = payload[: TILE_HEADER.size], payload[TILE_HEADER.size :]
        digest.update(struct.pack("<qq", row, column) + head + zlib.decompress(body))
    return digest.hexdigest()


# --- what the daemon's threads call ---------------------------------------------------------------------------------


class Recorder:
    """The daemon's recorder. Taps may be hung in at any time; they cost nothing until begin().

    Every method but begin and end may be called from any thread and never blocks.
    """

    def __init__(self, settings: Settings, *, clock: Clock) -> None:
        self._settings = settings
        self._clock = clock
        self._lock = threading.Lock()
        self._waiting = _Waiting(settings.waiting_bytes)
        self._active = False
        self._writers: dict[str, WireWriter] = {}
        self._sources: dict[str, int] = {}
        self._writing: _WritingThread | None = None

    @property
    def is_active(self) -> bool:
        """Whether something is being recorded."""
        return self._active

    def begin(self, start: Start, *, published: bool | None = None) -> Path:
        """Start a new run; returns its first file. Trouble if it cannot be written, or one is being recorded."""
        with self._lock:
            if self._active:
                raise Trouble("a recording is under way; end it first (`umfeld record --stop`)")
            settings = self._settings
            self._published = settings.published if published is None else published
            offset_ns = self._clock.wall_from_monotonic_ns(0)
            from service.recording_files import Files  # here: who does not record needs none of its libraries

            files = Files(settings, start, offset_ns, self._clock.now_ns())
            path = files.open_next()
            self._sources = {name: index for index, name in enumerate(start.sources)}
            self._waiting = _Waiting(settings.waiting_bytes)
            self._writers.clear()
            self._writing = _WritingThread(self._waiting, files)
            self._active = True
            self._writing.start()
            return path

    def end(self, end: Mapping[str, str] | None = None, deadline_s: float = 3.0) -> Mapping[str, Any] | None:
        """Write what waits and close the file; what was recorded, None if nothing was.

        end: what is known only now, such as the digest of the map.
        """
        with self._lock:
            if not self._active or self._writing is None:
                return None
            self._active = False
            writing, self._writing = self._writing, None
            self._flush_turns()
        return writing.finish(end or {}, deadline_s)

    def tap(self, wire: str) -> Tap:
        """A tap for the reader of a wire."""

        def hear(direction: Direction, stamp_ns: int, item: Item) -> None:
            if not self._active:
                return
            writer = self._writers.get(wire)
            if writer is None:
                writer = self._writers[wire] = WireWriter()
            record = writer.take(direction, stamp_ns, item)
            if record is not None:
                self._waiting.put(WireItem(wire, record), 100 + 8 * len(record.asked_ns) + _size_of(item))

        return hear

    def sink(self, sink: Sink) -> Sink:
        """A sink that also keeps the events; readings come again from the bytes."""

        def keep(source: str, item: Reading | DeviceEvent) -> None:
            if self._active and isinstance(item, DeviceEvent):
                self._waiting.put(EventItem(item.stamp_ns, event_text(source, item)), 400)
            sink(source, item)

        return keep

    def call(self, kind: int, now_ns: int, source: str = "", stamp_ns: int = 0) -> None:
        """Fusion is about to be called."""
        if self._active:
            self._waiting.put((now_ns, stamp_ns, kind, self._sources.get(source, 255)), 60)

    def message(self, message: Message) -> None:
        """A tap for the publisher."""
        if self._active and self._published:
            self._waiting.put(Published(message, self._clock.now_ns()), 200 + len(message.payload), is_extra=True)

    def counters(self) -> dict[str, int]:
        """For the health report; empty while nothing is recorded."""
        writing = self._writing
        if writing is None:
            return {}
        return {f"recording.{name}": count for name, count in (writing.counts() | self._waiting.counts()).items()}

    def trouble(self) -> str | None:
        """Why nothing is written now."""
        writing = self._writing
        return None if writing is None else writing.trouble

    def status(self) -> dict[str, Any]:
        """For people who ask."""
        writing = self._writing
        if writing is None:
            return {"recording": False}
        return {"recording": True, "file": str(writing.path), "trouble": writing.trouble, **self.counters()}

    def _flush_turns(self) -> None:
        for wire, writer in list(self._writers.items()):
            if (record := writer.rest()) is not None:
                self._waiting.put(WireItem(wire, record), 500)


class RecordedFusion(Fusion):
    """Fusion that tells a recorder of every call before it does it."""

    recorder: Recorder | None = None

    def stream(self, source: str, item: Reading | DeviceEvent, now_ns: int) -> Iterable[Output]:
        if self.recorder is not None:
            kind = EVENT if isinstance(item, DeviceEvent) else READING
            self.recorder.call(kind, now_ns, source, item.stamp_ns)
        return super().stream(source, item, now_ns)

    def settle(self, now_ns: int) -> None:
        if self.recorder is not None:
            self.recorder.call(SETTLE, now_ns)
        super().settle(now_ns)

    def tick(self, now_ns: int) -> list[Output]:
        if self.recorder is not None:
            self.recorder.call(TICK, now_ns)
        return super().tick(now_ns)


# --- between the threads --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class WireItem:
    wire: str
    record: WireRecord


@dataclass(frozen=True, slots=True)
class EventItem:
    stamp_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class Published:
    message: Message
    now_ns: int


_Call = tuple[int, int, int, int]
Thing = WireItem | EventItem | Published | _Call


class _Waiting:
    """What waits to be written: a list with a bound in bytes. What is extra is refused when it is half full."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._lock = threading.Lock()
        self._things: list[Thing] = []
        self._bytes = 0
        self._lost = 0
        self._lost_told = 0
        self._extra_lost = 0

    def put(self, thing: Thing, size: int, *, is_extra: bool = False) -> None:
        with self._lock:
            if self._bytes + size > (self._limit // 2 if is_extra else self._limit):
                self._lost += not is_extra
                self._extra_lost += is_extra
                return
            self._bytes += size
            self._things.append(thing)

    def take_all(self) -> tuple[list[Thing], int]:
        """Everything, and how much was lost since the last time."""
        with self._lock:
            things, self._things, self._bytes = self._things, [], 0
            lost, self._lost_told = self._lost - self._lost_told, self._lost
            return things, lost

    def counts(self) -> dict[str, int]:
        return {"lost": self._lost, "lost_published": self._extra_lost, "waiting_bytes": self._bytes}


class _WritingThread:
    """Writes what waits, ten times a second; makes room when the disk is full."""

    def __init__(self, waiting: _Waiting, files: Files) -> None:
        self._waiting = waiting
        self._files = files
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._end: Mapping[str, str] = {}
        self.trouble: str | None = None

    @property
    def path(self) -> Path:
        return self._files.path

    def start(self) -> None:
        self._thread.start()

    def counts(self) -> dict[str, int]:
        return {"bytes": self._files.bytes_written, "files": self._files.number, "not_written": self._files.not_written}

    def finish(self, end: Mapping[str, str], deadline_s: float) -> dict[str, Any]:
        self._end = end
        self._ending.set()
        self._thread.join(deadline_s)
        counts = self.counts() | self._waiting.counts()
        files = [str(path) for path in self._files.of_this_run()]
        return {**counts, "files": files, "finished": not self._thread.is_alive(), "trouble": self.trouble}

    def _run(self) -> None:
        while not self._ending.wait(_DRAIN_PERIOD_S):
            self._write()
        self._write()
        try:
            self._files.finish(self._end)
        except OSError as error:
            self._note(error)

    def _write(self) -> None:
        things, lost = self._waiting.take_all()
        try:
            self._files.write(things, lost)
        except OSError as error:
            self._note(error)
        else:
            if self._files.is_open:
                self.trouble = None

    def _note(self, error: OSError) -> None:
        reason = error.strerror or str(error)
        if self.trouble is None:
            log.error("the recording stands still: %s: %s", self._files.path, reason)
        self.trouble = (
            f"nothing is recorded: {self._files.path.parent}: {reason}; free some space, or set [recording] folder"
        )


def _size_of(item: Item) -> int:
    return len(item) if isinstance(item, bytes | str) else 8
