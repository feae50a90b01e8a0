"""Plays a recording through the real drivers and fusion: the same recording, the same map, bit for bit.

Time is that of the recording; the host's clock only paces what is shown to people. Where the recording says in which
order fusion took the readings, and nothing of it is missing, that order is repeated, so that the map becomes the very
one that was made live. Otherwise (lost records, a file from the middle removed, another configuration) readings are
taken as they arrive, with a tick every 25 ms: the same every time as well, but not the map that was made live.
"""

from __future__ import annotations

import json
import logging
import math
import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from drivers.errors import FrameError
from drivers.readings import DeviceEvent, Reading
from drivers.recording import WirePlayer, WireRecord, decode_record
from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from service import assemble, assemble_wires
from service.background import at_once
from service.clock import CrankedClock
from service.config import Config, check
from service.config_files import Layers
from service.errors import Trouble
from service.fusion import TICK_PERIOD_NS, Fusion, GridLayer, StoredTile
from service.outputs import Output, PoseOut
from service.recording import (
    END,
    EVENT,
    EVENTS,
    FUSION,
    READING,
    RUN,
    SETTLE,
    SLAM_TILE,
    TICK,
    TILE,
    WIRES,
    Calls,
    Start,
    decode_calls,
    decode_string,
    digest_of,
    event_of,
)

log = logging.getLogger(__name__)

Offer = Callable[[Output], None]
Pace = Callable[[int], None]
"""Called with the recording's time before it is played; may wait."""


@dataclass(frozen=True, slots=True)
class Taken:
    """A record of a wire, as it stands in the recording."""

    wire: str
    record: WireRecord


@dataclass(frozen=True, slots=True)
class Lost:
    """Records are missing here. why: in words."""

    why: str


Entry = Taken | tuple[str, DeviceEvent] | Calls | Lost


@dataclass(frozen=True, slots=True)
class Head:
    """What the first file says about the run. number: which file of the run it is, from 0."""

    start: Start
    begun_ns: int
    wall_offset_ns: int
    number: int


@dataclass(slots=True)
class Recording:
    """The files of one run, read in the order in which they were written. A cut file is read as far as it goes.

    end: what the last file says about the end, None until it was read, or if it is missing.
    """

    files: tuple[Path, ...]
    end: dict[str, str] | None = None
    cut: list[str] = field(default_factory=list)
    bytes_read: int = 0

    @classmethod
    def of(cls, path: Path) -> Recording:
        """The run that a file belongs to, or the newest run in a folder. Trouble if there is none."""
        from service.recording_files import recordings_in, run_of

        if path.is_dir():
            found = recordings_in(path)
            if not found:
                raise Trouble(f"{path}: holds no recording; `umfeld record` makes one")
            path = found[-1]
        if not path.is_file():
            raise Trouble(f"{path}: there is no such file")
        return cls(tuple(run_of(path)))

    def head(self) -> Head:
        """What the run begins from. Trouble if the first file is not one of ours."""
        about: dict[str, str] | None = None
        tiles: dict[str, list[StoredTile]] = {TILE: [], SLAM_TILE: []}
        for record in _records(self.files[0], []):
            kind = type(record).__name__
            if kind == "Metadata" and record.name == RUN:
                about = record.metadata
            elif kind == "Attachment" and record.name.startswith((TILE, SLAM_TILE)):
                layer, row, column = record.name.split("/")
                tiles[f"{layer}/"].append((int(row), int(column), record.data))
            elif kind == "Message" or (about is not None and _has_all(about, tiles)):
                break
        if about is None:
            raise Trouble(f"{self.files[0]}: is not a recording of umfeld (it has no {RUN})")
        try:
            return _head_of(about, tuple(tiles[TILE]), tuple(tiles[SLAM_TILE]))
        except (KeyError, ValueError) as error:
            raise Trouble(f"{self.files[0]}: its metadata {RUN} cannot be read: {error}") from error

    def entries(self) -> Iterator[Entry]:
        """Everything that replay needs, in order."""
        last: int | None = None
        for path in self.files:
            number = self._number_in(path)
            if number != (0 if last is None else last + 1):
                yield Lost(f"{path.name} does not follow the file before it")
            last = number
            yield from self._entries_of(path)
            self.bytes_read += path.stat().st_size

    def _number_in(self, path: Path) -> int:
        return Recording((path,)).head().number

    def _entries_of(self, path: Path) -> Iterator[Entry]:
        topics: dict[int, str] = {}
        cut: list[str] = []
        for record in _records(path, cut):
            match type(record).__name__:
                case "Channel":
                    topics[record.id] = record.topic
                case "Metadata" if record.name == END:
                    self.end = dict(record.metadata)
                case "Message":
                    try:
                        entry = _entry_of(topics[record.channel_id], record.data)
                    except (FrameError, ValueError, KeyError, TypeError, struct.error) as error:
                        entry = Lost(f"{path.name}: a record that cannot be read: {error}")
                    if entry is not None:
                        yield entry
        if cut:
            self.cut.extend(cut)
            if path != self.files[-1]:
                yield Lost(cut[0])


def _has_all(about: dict[str, str], tiles: dict[str, list[StoredTile]]) -> bool:
    return len(tiles[TILE]) >= int(about["tiles"]) and len(tiles[SLAM_TILE]) >= int(about.get("slam_tiles", "0"))


def _head_of(about: dict[str, str], tiles: tuple[StoredTile, ...], slam: tuple[StoredTile, ...]) -> Head:
    x_m, y_m, yaw_rad = json.loads(about["pose"])
    start = Start(
        about["robot"],
        about["version"],
        about["config"],
        tuple(json.loads(about["sources"])),
        (float(x_m), float(y_m), float(yaw_rad)),
        about["complete"] == "true",
        tiles,
        slam,
    )
    return Head(start, int(about["begun_ns"]), int(about["wall_offset_ns"]), int(about["number"]))


def _records(path: Path, cut: list[str]) -> Iterator[Any]:
    """MCAP records in the order of the file, up to where it is cut; then one line is added to `cut`."""
    from mcap.exceptions import McapError
    from mcap.records import Footer
    from mcap.stream_reader import StreamReader

    try:
        with path.open("rb") as stream:
            try:
                for record in StreamReader(stream, validate_crcs=True).records:
                    if isinstance(record, Footer):
                        return
                    yield record
            except (McapError, ValueError, EOFError, struct.error, zlib.error, AssertionError) as error:
                cut.append(f"{path.name} ends early ({type(error).__name__}: {error})")
                return
            except Exception as error:  # the decompressor has errors of its own
                if type(error).__name__ != "ZstdError":
                    raise
                cut.append(f"{path.name} ends early ({error})")
                return
    except OSError as error:
        raise Trouble(f"{path}: cannot be read: {error.strerror}") from error


def _entry_of(topic: str, data: bytes) -> Entry | None:
    if topic.startswith(WIRES):
        return Taken(topic.removeprefix(WIRES), decode_record(data))
    if topic == FUSION:
        return decode_calls(data)
    if topic != EVENTS:
        return None
    document = json.loads(decode_string(data))
    if "lost" in document:
        return Lost(f"{document['lost']} records were lost while recording")
    return event_of(document)


# --- playing ----------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Report:
    """What a replay found.

    exact: fusion was called exactly as it was live.  digest: of the map.  same_map: whether it is the map that was
    made live, None if the recording does not say or has no reading.  sent_otherwise: requests that today's drivers
    would not have sent like that.  errors: exceptions in drivers and fusion.
    """

    exact: bool = True
    why_not: list[str] = field(default_factory=list)
    digest: str = ""
    same_map: bool | None = None
    seconds: float = 0.0
    records: int = 0
    readings: int = 0
    calls: int = 0
    sent: int = 0
    sent_otherwise: int = 0
    errors: int = 0

    def document(self) -> dict[str, object]:
        """For JSON."""
        return {
            "exact": self.exact,
            "why_not": self.why_not,
            "map_sha256": self.digest,
            "same_map_as_live": self.same_map,
            "recorded_seconds": round(self.seconds, 3),
            "records": self.records,
            "readings": self.readings,
            "calls": self.calls,
            "requests_as_recorded": self.sent,
            "requests_otherwise": self.sent_otherwise,
            "errors": self.errors,
        }


class Replay:
    """One robot made of a recording: drivers, fusion, maps; no thread, socket or port.

    config: another configuration than the recorded one: then the order of calls is not repeated.
    offer and pace may be set before it runs: offer takes every output as it comes, for pace see Pace.
    """

    def __init__(self, recording: Recording, *, config: Config | None = None, layers: Sequence[GridLayer] = ()) -> None:
        """layers: more that takes posed sweeps, as grids do."""
        self.recording = recording
        self.head = recording.head()
        self.config = config_of(self.head) if config is None else config
        self.report = Report()
        self.clock = CrankedClock(self.head.begun_ns, self.head.wall_offset_ns)
        self.trajectory: list[PoseOut] = []
        self.offer: Offer = _ignore
        self.pace: Pace = _ignore
        self._players = {
            wire.name: WirePlayer({name: make() for name, make in wire.conversations.items()})
            for wire in assemble_wires.wires(self.config)
        }
        found = assemble.sensors(self.config)
        maps = assemble.maps(self.config, found)
        self._building = maps.building
        self._load_map()
        start = self.head.start
        localiser = assemble.localiser(self.config, found, maps, Pose2(*start.pose), at_once, stored=start.slam)
        parts = assemble.parts(self.config, found, maps, localiser)
        self.fusion = Fusion(replace(parts, grids=(*parts.grids, *layers)))
        self._waiting: dict[str, deque[Reading | DeviceEvent]] = {}
        self._next_tick_ns = self.head.begun_ns
        self._unknown_wires: set[str] = set()
        self._matched: set[str] = set()
        if config is not None:
            self._give_up_order("another configuration than the recorded one")
        elif not self.head.start.complete:
            self.report.why_not.append("it began while the daemon was running: its first poses are not in it")

    @property
    def grid(self) -> OccupancyGrid | None:
        """The map, as far as it was played."""
        return None if self._building is None else self._building.grid

    def run(self) -> Report:
        """Play everything; returns what was found."""
        for _ in self.steps():
            pass
        return self.finish()

    def steps(self) -> Iterator[int]:
        """Play; yields the recording's time after each entry."""
        for entry in self.recording.entries():
            self.report.records += 1
            match entry:
                case Taken():
                    self._play(entry)
                case Calls():
                    self._call(entry)
                case Lost():
                    self._give_up_order(entry.why)
                case (source, event):
                    self._take(source, event, event.stamp_ns)
            yield self.clock.now_ns()

    def finish(self) -> Report:
        """The report; call it once all steps are done."""
        report = self.report
        report.seconds = (self.clock.now_ns() - self.head.begun_ns) / 1e9
        report.sent = sum(player.sent for player in self._players.values())
        report.sent_otherwise = sum(player.sent_otherwise for player in self._players.values())
        report.errors += sum(player.bugs for player in self._players.values())
        self.fusion.drain()
        if self.grid is not None:
            report.digest = digest_of(self.grid)
        live = (self.recording.end or {}).get("map_sha256")
        if live is not None and self.head.start.complete:
            report.same_map = live == report.digest
            if report.same_map and not report.readings:
                report.same_map = None  # nothing was played: nothing is proved
        report.why_not.extend(self.recording.cut)
        report.exact = report.exact and not report.why_not
        return report

    # ---- what the recording says

    def _play(self, taken: Taken) -> None:
        player = self._players.get(taken.wire)
        if player is None:
            if taken.wire not in self._unknown_wires:
                self._unknown_wires.add(taken.wire)
                self.report.why_not.append(f"the configuration has no wire {taken.wire}")
            return
        for source, reading in player.play(taken.record):
            self.report.readings += 1
            self._take(source, reading, taken.record.stamp_ns)

    def _take(self, source: str, item: Reading | DeviceEvent, now_ns: int) -> None:
        """A reading or an event has come: to wait until fusion took it, or to be taken at once."""
        if self.report.exact:
            self._waiting.setdefault(source, deque()).append(item)
        else:
            self._feed(source, item, now_ns)

    def _call(self, calls: Calls) -> None:
        if not self.report.exact:
            return
        for now_ns, stamp_ns, kind, source in zip(calls.now_ns, calls.stamp_ns, calls.kind, calls.source):
            self.report.calls += 1
            self._turn_to(now_ns)
            if kind == SETTLE:
                self._guard(partial(self._settle, now_ns))
            elif kind == TICK:
                self._guard(partial(self.fusion.tick, now_ns))
            elif kind in (READING, EVENT) and source < len(self.head.start.sources):
                self._take_waiting(self.head.start.sources[source], kind == EVENT, stamp_ns, now_ns)

    def _take_waiting(self, source: str, is_event: bool, stamp_ns: int, now_ns: int) -> None:
        """The item that fusion took then; those before it were thrown away by a full queue."""
        waiting = self._waiting.get(source, deque())
        for place, item in enumerate(waiting):
            if item.stamp_ns == stamp_ns and isinstance(item, DeviceEvent) == is_event:
                for _ in range(place + 1):
                    waiting.popleft()
                self._guard(partial(self.fusion.stream, source, item, now_ns))
                if not is_event:  # news come from before the device was set up anew, too
                    self._matched.add(source)
                return
        if not self.head.start.complete and source not in self._matched:
            return  # its bytes came before the recording began
        self._give_up_order(f"{source}: a reading that was taken live does not come out of its bytes")

    def _give_up_order(self, why: str) -> None:
        """From here on readings are taken as they come, those that wait first."""
        if len(self.report.why_not) < 20:
            self.report.why_not.append(why)
        if not self.report.exact:
            return
        self.report.exact = False
        self._next_tick_ns = self.clock.now_ns()
        for source, waiting in self._waiting.items():
            while waiting:
                self._feed(source, waiting.popleft(), self.clock.now_ns())

    # ---- fusion

    def _feed(self, source: str, item: Reading | DeviceEvent, now_ns: int) -> None:
        self._turn_to(now_ns)
        now_ns = self.clock.now_ns()
        if now_ns - self._next_tick_ns > 40 * TICK_PERIOD_NS:  # a gap in the recording is not worked through
            self._next_tick_ns = now_ns
        while self._next_tick_ns <= now_ns:
            self._guard(partial(self.fusion.tick, self._next_tick_ns))
            self._next_tick_ns += TICK_PERIOD_NS
        self._guard(partial(self.fusion.stream, source, item, now_ns))
        self._guard(partial(self._settle, now_ns))

    def _turn_to(self, now_ns: int) -> None:
        self.pace(now_ns)
        self.clock.turn(max(0, now_ns - self.clock.now_ns()))

    def _settle(self, now_ns: int) -> Iterable[Output]:
        self.fusion.settle(now_ns)
        return ()

    def _guard(self, work: Callable[[], Iterable[Output]]) -> None:
        """What was survived live is survived again."""
        try:
            for output in work():
                if isinstance(output, PoseOut):
                    self.trajectory.append(output)
                self.offer(output)
        except Exception as error:
            self.report.errors += 1
            if self.report.errors <= 20:
                log.warning("%s in fusion: %s", type(error).__name__, error)

    def _load_map(self) -> None:
        if self._building is None:
            return
        for row, column, payload in self.head.start.tiles:
            try:
                self._building.grid.load_tile(row, column, payload)
            except ValueError as error:
                if len(self.report.why_not) < 20:
                    self.report.why_not.append(f"the map it began with: {error}")


def _ignore(_: object) -> None:
    pass


def config_of(head: Head) -> Config:
    """The configuration that was recorded. Trouble if this version does not know it any more."""
    try:
        return check(Layers(json.loads(head.start.config), {}, {}, ()))
    except (ValueError, Trouble) as error:
        raise Trouble(
            f"the configuration in this recording (version {head.start.version}) is not valid here: {error}; give one "
            "with --config"
        ) from error


def trajectory_text(replay: Replay) -> str:
    """The poses in the TUM form, stamps in wall clock seconds."""
    lines = []
    for pose in replay.trajectory:
        place, stamp_ns = pose.map_from_base, pose.stamp_ns + replay.head.wall_offset_ns
        seconds, rest = divmod(stamp_ns, 1_000_000_000)
        half = place.yaw_rad / 2.0
        lines.append(
            f"{seconds}.{rest:09d} {place.x_m:.9f} {place.y_m:.9f} 0 0 0 {math.sin(half):.12f} {math.cos(half):.12f}\n"
        )
    return "".join(lines)
