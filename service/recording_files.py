"""The files of a recording: a series of MCAP files of bounded size in a bounded folder, whole whatever happens.

What is in them: see recording.py. Apart from it because only a daemon that records needs the libraries behind it.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from drivers.recording import WIRE_DEFINITION, WIRE_TYPE, encode_record
from service.errors import Trouble
from service.payloads import Message
from service.recording import (
    CALLS_DEFINITION,
    CALLS_TYPE,
    END,
    EVENTS,
    FUSION,
    RUN,
    SLAM_TILE,
    STRING,
    SUFFIX,
    TILE,
    WIRES,
    Calls,
    EventItem,
    Published,
    Settings,
    Start,
    Thing,
    WireItem,
    encode_calls,
    encode_string,
)

log = logging.getLogger(__name__)

_SYNC_PERIOD_S = 1.0
_RETRY_PERIOD_S = 5.0
_NAME = re.compile(r"(?P<run>.+-\d{8}T\d{6}Z(?:-\d+x)?)-(?P<number>\d{4,})\.mcap\Z")  # nobody else's, for make_room


class _Writer(McapWriter):
    """MCAP with chunks that end when we say so: what was written a second ago survives a cut cable.

    The library ends a chunk by size only. Its own method does what is needed, under the name that its class gives it.
    """

    def end_chunk(self) -> None:
        self._Writer__finalize_chunk()  # type: ignore[attr-defined]
        self._Writer__flush()  # type: ignore[attr-defined]


@dataclass(slots=True)
class _Open:
    """One file being written. whole_bytes: up to there it can be read whatever happens."""

    path: Path
    stream: IO[bytes]
    writer: Any
    channels: dict[str, int] = field(default_factory=dict)
    schemas: dict[str, int] = field(default_factory=dict)
    whole_bytes: int = 0


class Files:
    """The series of files of one run. Used by one thread."""

    def __init__(self, settings: Settings, start: Start, wall_offset_ns: int, now_ns: int) -> None:
        self._settings = settings
        self._start = start
        self._offset_ns = wall_offset_ns
        self._begun_ns = now_ns
        self._run = _free_name(settings.folder, start.robot, now_ns + wall_offset_ns)
        self._open: _Open | None = None
        self._last_ns = now_ns
        self._synced_ns = now_ns
        self._retry_ns = now_ns
        self._definitions = _Definitions()
        self._lost_here = 0
        self.number = 0
        self.bytes_written = 0
        self.not_written = 0

    @property
    def path(self) -> Path:
        """The file being written, or the next one."""
        return self._path_of(self.number - 1 if self._open is not None else self.number)

    @property
    def is_open(self) -> bool:
        return self._open is not None

    def of_this_run(self) -> list[Path]:
        """The files there are, in order."""
        return files_of_run(self._settings.folder, self._run)

    def open_next(self) -> Path:
        """Begin the next file, making room for it. Trouble if the first cannot be made; OSError later."""
        folder = self._settings.folder
        if self.number == 0:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                return self._begin_file()
            except OSError as error:
                raise Trouble(
                    f"{folder}: cannot record there: {error.strerror}; set [recording] folder to another one"
                ) from error
        return self._begin_file()

    def write(self, things: Sequence[Thing], lost: int) -> None:
        """Write what was handed over; OSError if the disk refuses, then it is counted as lost and said so later."""
        now_ns = self._newest_ns(things)
        self._lost_here += lost
        if self._open is None:
            if now_ns < self._retry_ns:
                self._lose(things)
                return
            self._retry_ns = now_ns + int(_RETRY_PERIOD_S * 1e9)
            self._begin_file()
        try:
            self._write_all(things, now_ns)
            self._end_chunk_when_due(now_ns)
        except OSError:
            self._lose(things)
            self._abandon()
            self._retry_ns = now_ns + int(_RETRY_PERIOD_S * 1e9)
            raise

    def finish(self, end: Mapping[str, str]) -> None:
        """Close the last file with what is known at the end."""
        if self._open is None:
            return
        if self._lost_here:
            self._note_lost(self._last_ns)
        self._open.writer.add_metadata(END, dict(end))
        self._close()

    # ---- one file

    def _path_of(self, number: int) -> Path:
        return self._settings.folder / f"{self._run}-{number:04d}{SUFFIX}"

    def _begin_file(self) -> Path:
        make_room(self._settings, self._path_of(0))
        path = self._path_of(self.number)
        stream = path.open("xb")
        writer = _Writer(stream, chunk_size=1 << 20, compression=CompressionType.ZSTD)
        opened = _Open(path, stream, writer)
        try:
            writer.start(profile="ros2", library="umfeld")
            writer.add_metadata(RUN, self._about())
            if self.number == 0:
                stamp_ns = self._begun_ns + self._offset_ns
                for kind, tiles in ((TILE, self._start.tiles), (SLAM_TILE, self._start.slam)):
                    for row, column, payload in tiles:
                        name = f"{kind}{row}/{column}"
                        writer.add_attachment(stamp_ns, stamp_ns, name, "application/x-umfeld", payload)
            self._sync(opened)
        except OSError:
            stream.close()
            path.unlink(missing_ok=True)
            raise
        self._open = opened
        self.number += 1
        return path

    def _about(self) -> dict[str, str]:
        start = self._start
        return {
            "robot": start.robot,
            "version": start.version,
            "run": self._run,
            "number": str(self.number),
            "config": start.config,
            "sources": json.dumps(start.sources),
            "pose": json.dumps(start.pose),
            "complete": str(start.complete).lower(),
            "tiles": str(len(start.tiles)),
            "slam_tiles": str(len(start.slam)),
            "begun_ns": str(self._begun_ns),
            "wall_offset_ns": str(self._offset_ns),
        }

    def _write_all(self, things: Sequence[Thing], now_ns: int) -> None:
        if self._lost_here:
            self._note_lost(now_ns)
        calls: list[tuple[int, int, int, int]] = []
        for thing in things:
            match thing:
                case WireItem(wire, record):
                    self._add(WIRES + wire, WIRE_TYPE, record.stamp_ns, encode_record(record))
                case EventItem(stamp_ns, text):
                    self._add(EVENTS, STRING, stamp_ns, encode_string(text))
                case Published(message, sent_ns):
                    self._add_published(message, sent_ns)
                case _:
                    calls.append(thing)
        if calls:
            now, stamps, kinds, sources = zip(*calls)
            self._add(FUSION, CALLS_TYPE, now_ns, encode_calls(Calls(now, stamps, bytes(kinds), bytes(sources))))

    def _add_published(self, message: Message, now_ns: int) -> None:
        topic = message.topic
        if topic.is_cdr:
            self._add(f"/{message.suffix}", topic.payload, now_ns, message.payload)
        else:
            text = message.payload.decode(errors="replace")
            self._add(f"/{message.suffix}", STRING, now_ns, encode_string(text))

    def _add(self, topic: str, ros_type: str, now_ns: int, payload: bytes) -> None:
        opened = self._open
        assert opened is not None
        channel = opened.channels.get(topic)
        if channel is None:
            channel = opened.channels[topic] = self._channel(opened, topic, ros_type)
        stamp_ns = max(now_ns + self._offset_ns, 0)
        opened.writer.add_message(channel, stamp_ns, payload, stamp_ns)
        self._last_ns = max(self._last_ns, now_ns)

    def _channel(self, opened: _Open, topic: str, ros_type: str) -> int:
        schema = opened.schemas.get(ros_type)
        if schema is None:
            text = self._definitions.of(ros_type).encode()
            schema = opened.schemas[ros_type] = opened.writer.register_schema(ros_type, "ros2msg", text)
        metadata = {"offered_qos_profiles": "", "topic_type_hash": self._definitions.hash_of(ros_type)}
        return int(opened.writer.register_channel(topic, "cdr", schema, metadata))

    def _end_chunk_when_due(self, now_ns: int) -> None:
        opened = self._open
        assert opened is not None
        if now_ns - self._synced_ns >= _SYNC_PERIOD_S * 1e9:
            self._synced_ns = now_ns
            self._sync(opened)
        if opened.stream.tell() >= self._settings.file_bytes:
            self._close()
            self._begin_file()

    def _sync(self, opened: _Open) -> None:
        opened.writer.end_chunk()
        opened.stream.flush()
        size = opened.stream.tell()
        self.bytes_written += size - opened.whole_bytes
        opened.whole_bytes = size
        os.fdatasync(opened.stream.fileno())

    def _close(self) -> None:
        opened = self._open
        assert opened is not None
        try:
            opened.writer.finish()
            opened.stream.flush()
            self.bytes_written += opened.stream.tell() - opened.whole_bytes
            os.fsync(opened.stream.fileno())
        except OSError:
            self._abandon()
            raise
        self._open = None
        opened.stream.close()

    def _abandon(self) -> None:
        """The disk refused in the middle: leave the file as far as it is whole."""
        opened, self._open = self._open, None
        if opened is None:
            return
        try:
            os.ftruncate(opened.stream.fileno(), opened.whole_bytes)
        except OSError as error:
            log.warning("%s: could not be cut: %s", opened.path, error)
        try:
            opened.stream.close()
        except OSError:  # what was buffered does not fit either
            log.debug("%s: closed with unwritten bytes", opened.path)

    # ---- losses

    def _lose(self, things: Sequence[Thing]) -> None:
        lost = sum(not isinstance(thing, Published) for thing in things)
        self.not_written += lost
        self._lost_here += lost

    def _note_lost(self, now_ns: int) -> None:
        text = json.dumps({"lost": self._lost_here, "stamp_ns": now_ns})
        self._add(EVENTS, STRING, now_ns, encode_string(text))
        self._lost_here = 0

    def _newest_ns(self, things: Iterable[Thing]) -> int:
        """The time by what is written: nobody here asks a clock."""
        for thing in things:
            match thing:
                case WireItem(_, record):
                    self._last_ns = max(self._last_ns, record.stamp_ns)
                case Published(_, now_ns) | (now_ns, _, _, _):
                    self._last_ns = max(self._last_ns, now_ns)
        return self._last_ns


def make_room(settings: Settings, keep: Path) -> None:
    """Remove old recordings until a new file fits: other runs first, oldest first, then this run's middle.

    keep: the first file of the run that is being written; without it nothing after it can be replayed. OSError
    (ENOSPC) if there is not enough space even so.
    """
    run = _run_of(keep)
    files = recordings_in(settings.folder)
    ours = [path for path in files if _run_of(path) == run]
    candidates = [path for path in files if _run_of(path) != run] + [path for path in ours if path != keep]
    total = sum(_size_of_file(path) for path in files)
    for path in candidates:
        if total + settings.file_bytes <= settings.total_bytes and _free_bytes(settings.folder) >= settings.free_bytes:
            return
        total -= _size_of_file(path)
        log.info("removing the recording %s to make room", path)
        path.unlink(missing_ok=True)
    if _free_bytes(settings.folder) < settings.free_bytes:
        megabytes = settings.free_bytes // 1_000_000
        raise OSError(errno.ENOSPC, f"less than {megabytes} MB are free", str(settings.folder))


def recordings_in(folder: Path) -> list[Path]:
    """Every file of every run, oldest run first, in order."""
    found = [path for path in folder.glob(f"*{SUFFIX}") if _NAME.match(path.name)] if folder.is_dir() else []
    return sorted(found, key=lambda path: (_run_of(path), _number_of(path)))


def files_of_run(folder: Path, run: str) -> list[Path]:
    """The files of one run, in order."""
    return [path for path in recordings_in(folder) if _run_of(path) == run]


def run_of(path: Path) -> list[Path]:
    """All files of the run that a file belongs to; the file alone if its name is not one of ours."""
    if _NAME.match(path.name) is None:
        return [path]
    return files_of_run(path.parent, _run_of(path))


def _run_of(path: Path) -> str:
    match = _NAME.match(path.name)
    return match["run"] if match else path.stem


def _number_of(path: Path) -> int:
    match = _NAME.match(path.name)
    return int(match["number"]) if match else 0


def _free_name(folder: Path, robot: str, wall_ns: int) -> str:
    """A name by the time of day, that sorts by it; a clock that was set back finds another one."""
    name = f"{robot}-{datetime.fromtimestamp(wall_ns / 1e9, UTC):%Y%m%dT%H%M%SZ}"
    taken = {_run_of(path) for path in recordings_in(folder)}
    return next(each for each in _names(name) if each not in taken)


def _names(name: str) -> Iterator[str]:
    yield name
    number = 2
    while True:
        yield f"{name}-{number}x"
        number += 1


def _free_bytes(folder: Path) -> int:
    about = os.statvfs(folder)
    return about.f_bavail * about.f_frsize


def _size_of_file(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


class _Definitions:
    """The text of message types, as bag readers want it."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._store = get_typestore(Stores.ROS2_JAZZY)
        if "map_msgs/msg/OccupancyGridUpdate" not in self._store.types:
            definition = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data\n"
            self._store.register(get_types_from_msg(definition, "map_msgs/msg/OccupancyGridUpdate"))
        self._store.register(get_types_from_msg(WIRE_DEFINITION, WIRE_TYPE))
        self._store.register(get_types_from_msg(CALLS_DEFINITION, CALLS_TYPE))

    def of(self, ros_type: str) -> str:
        return str(self._store.generate_msgdef(ros_type, ros_version=2)[0])

    def hash_of(self, ros_type: str) -> str:
        return str(self._store.hash_rihs01(ros_type))
