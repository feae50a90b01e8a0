"""Maps that take their time (lines, rooms, planes, scenes, topology): made on one thread of their own from what fusion
hands out, so that a slow one delays neither a scan nor a grid.

    fusion --sweeps with their poses--> bounded queue --+
    fusion --grids and updates------> newest, mirrored --+--> maker.make(view) --> outputs, as from fusion

A maker is pure: it gets everything on this thread, asks for no time, and keeps its map in tiles of the store. What it
cannot cope with is counted (`makers.errors`) and told once a kind; the other makers go on. Sweeps that come faster than
makers work are thinned: of those that wait, one goes where the robot has hardly moved since the one before it
(`makers.sweeps_thinned`). Where none is left to thin the oldest is lost (`makers.sweeps_lost`). Such a map is thinner,
never wrong.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from service.errors import Trouble
from service.fusion import Round, Touch
from service.outputs import CloudOut, GridOut, GridUpdateOut, LookOut, OdomOut, Output, PoseOut

log = logging.getLogger(__name__)

F64 = NDArray[np.float64]
T = TypeVar("T")

SWEEPS_WAITING_MAX = 128
THINNED_M, THINNED_RAD = 0.05, math.radians(2.5)  # half a step of makers of maps, and where that is not enough a whole
_CLOUDS_WAITING_MAX = 4
_GRIDS_WAITING_MAX = 256
_ODOMETRY_WAITING_MAX = 4096
_TURN_S = 0.1
ASK_LIMIT_S = 10.0
_DRAWN_TO_THE_END = 0.6  # of the time there is to stop in
Tile = tuple[int, int, bytes]
Sweep = tuple[str, Scan, F64]
Question = tuple[Callable[[], object], threading.Event, list[object]]


@dataclass(frozen=True, slots=True)
class Rect:
    """Cells [row0, row0 + rows) x [col0, col0 + cols) of the map-fixed grid."""

    row0: int
    col0: int
    rows: int
    cols: int


@dataclass(frozen=True, slots=True)
class MapView:
    """What a maker sees. grid: the map-fixed grid as last published, not to be written to nor kept; None before that.

    changed: where it differs from the maker's last view (the grid may also have grown: compare row0, col0 and shape).
    map_from_base: the newest pose, None while unknown.  stamp_ns: of the newest of it all.
    """

    stamp_ns: int
    grid: GridPatch | None
    changed: tuple[Rect, ...]
    map_from_base: Pose2 | None


class MapMaker(Protocol):
    """One map of its own making. All calls come from the makers' thread (start: before it runs)."""

    @property
    def name(self) -> str:
        """Names its layer in the store and its counters."""

    @property
    def sources(self) -> frozenset[str]:
        """Lasers whose sweeps it wants; empty for a map made from the grid alone."""

    @property
    def period_ns(self) -> int:
        """Shortest time between two calls of make."""

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """One sweep, map_from_sensor as in GridLayer: (N, 3) or (3,)."""

    def make(self, view: MapView) -> list[Output]:
        """Bring the map up to date; what is to be published. Called when the grid changed or a sweep was taken."""

    def changed_tiles(self) -> list[Tile]:
        """What to keep in the store, as far as it changed since the last call. (row, col) are the maker's own keys."""

    def restore(self, tiles: Iterable[Tile]) -> None:
        """Take up what changed_tiles gave out earlier; begin empty if there is nothing. ValueError if it is damaged."""


@runtime_checkable
class DrawnFromSweeps(Protocol):
    """A maker whose map is made of posed sweeps, which it cannot move by itself when the map is corrected."""

    def start_anew(self) -> None:
        """Forget the map: every sweep that was kept follows, where it lies now."""


@runtime_checkable
class TellsMotion(Protocol):
    """A maker that takes from the poses of sweeps how the robot moved."""

    def map_moved(self) -> None:
        """The map was corrected: between the last sweep and the next the pose jumps."""


@runtime_checkable
class MadeOfClouds(Protocol):
    """A maker that also wants the clouds of tilting lasers."""

    def take_cloud(self, cloud: CloudOut) -> None:
        """One nod or turn of a mount."""


@runtime_checkable
class MadeOfLooks(Protocol):
    """A maker that wants the looks of a ring, every one of them."""

    def take_look(self, look: LookOut) -> None:
        """One look."""


@runtime_checkable
class MadeOfOdometry(Protocol):
    """A maker that wants where the wheels have the robot, every time."""

    def take_odometry(self, odom: OdomOut) -> None:
        """One pose in the odom frame; those before a sweep's last beam come before the sweep."""


@runtime_checkable
class Counting(Protocol):
    """A maker whose counters belong into the health of the daemon."""

    @property
    def counts(self) -> Mapping[str, int]:
        """By name; the names are always the same."""


class MakersBusy(Trouble):
    """The thread of the slow maps is in a turn that lasts; what it was asked is not done, now or later."""


class _Desk:
    """What the thread remembers of one maker. takes_*: what it wants besides sweeps, None if it does not: asking a
    protocol every turn costs more than most turns."""

    def __init__(self, maker: MapMaker) -> None:
        self.maker = maker
        self.due_ns = 0
        self.is_fed = False
        self.changed: list[Rect] | None = None  # None: nothing
        self.start_anew = maker.start_anew if isinstance(maker, DrawnFromSweeps) else None
        self.takes_odometry = maker.take_odometry if isinstance(maker, MadeOfOdometry) else None
        self.takes_clouds = maker.take_cloud if isinstance(maker, MadeOfClouds) else None
        self.takes_looks = maker.take_look if isinstance(maker, MadeOfLooks) else None


class MapMakers:
    """Owns the makers and their thread. offer: where outputs go."""

    def __init__(
        self,
        makers: Sequence[MapMaker],
        offer: Callable[[Output], None],
        *,
        now_ns: Callable[[], int],
        ask_limit_s: float = ASK_LIMIT_S,
    ) -> None:
        """ask_limit_s: so long a question waits for a turn to end, if it does not say otherwise."""
        self._ask_limit_s = ask_limit_s
        self._desks = [_Desk(maker) for maker in makers]
        self._offer = offer
        self._now_ns = now_ns
        self._sweeps: deque[Sweep] = deque()
        self._redrawn: Iterable[Callable[[], Sweep]] | None = None
        self._replaced: Mapping[str, Sequence[Tile]] | None = None
        self._grids: deque[GridOut | GridUpdateOut] = deque()
        self._clouds: deque[CloudOut] = deque()
        self._looks: deque[LookOut] = deque()
        self._odometry: deque[OdomOut] = deque()
        self._wants_odometry = any(desk.takes_odometry is not None for desk in self._desks)
        self._asked: deque[Question] = deque()
        self._changed = threading.Condition()
        self._stopping = False
        self._is_cut_short = False
        self._half_drawn: set[str] = set()
        self._thread = threading.Thread(target=self._run, name="maps", daemon=True)
        self._mirror = _Mirror()
        self._pose: PoseOut | None = None
        self._complained: set[str] = set()
        self.counts = {
            "makers.sweeps_lost": 0,
            "makers.sweeps_thinned": 0,
            "makers.grids_lost": 0,
            "makers.clouds_lost": 0,
            "makers.looks_lost": 0,
            "makers.odometry_lost": 0,
            "makers.errors": 0,
        }

    @property
    def sources(self) -> frozenset[str]:
        """Every laser that a maker wants sweeps of."""
        return frozenset().union(*(desk.maker.sources for desk in self._desks))

    @property
    def layers(self) -> list[str]:
        """Names of their layers in the store."""
        return [layer_of(desk.maker) for desk in self._desks]

    # --- from other threads

    def start(self) -> None:
        self._thread.start()

    def stop(self, deadline_s: float) -> bool:
        """End after the turn under way; False if that took longer.

        Where it draws maps anew and that would take too long they are left half drawn: nothing of them is given out to
        be kept then.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(_DRAWN_TO_THE_END * deadline_s)
            self._is_cut_short = self._thread.is_alive()
            self._thread.join((1.0 - _DRAWN_TO_THE_END) * deadline_s)
        return not self._thread.is_alive()

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """From fusion; never blocks."""
        with self._changed:
            self._sweeps.append((source, scan, map_from_sensor))
            if len(self._sweeps) > SWEEPS_WAITING_MAX:
                self._make_room()

    def _make_room(self) -> None:
        waiting = len(self._sweeps)
        for steps in (1.0, 2.0):
            if len(self._sweeps) > SWEEPS_WAITING_MAX:
                self._sweeps = thinned(self._sweeps, steps)
        self.counts["makers.sweeps_thinned"] += waiting - len(self._sweeps)
        if len(self._sweeps) > SWEEPS_WAITING_MAX:
            self._sweeps.popleft()
            self.counts["makers.sweeps_lost"] += 1

    def redraw(self, sweeps: Iterable[Callable[[], Sweep]]) -> None:
        """The map was corrected: these are the sweeps it is made of, where they lie now. Never blocks."""
        with self._changed:
            self._redrawn = sweeps
            self._sweeps.clear()  # those that were kept are among them

    def take_output(self, output: Output) -> None:
        """Everything that is published passes here; grids, clouds and poses are of use. Never blocks."""
        match output:
            case LookOut():
                with self._changed:
                    self._looks.append(output)
                    if len(self._looks) > SWEEPS_WAITING_MAX:
                        self._looks.popleft()
                        self.counts["makers.looks_lost"] += 1
            case CloudOut():
                with self._changed:
                    self._clouds.append(output)
                    if len(self._clouds) > _CLOUDS_WAITING_MAX:
                        self._clouds.popleft()
                        self.counts["makers.clouds_lost"] += 1
            case PoseOut():
                self._pose = output
            case OdomOut() if self._wants_odometry:
                with self._changed:
                    self._odometry.append(output)
                    if len(self._odometry) > _ODOMETRY_WAITING_MAX:
                        self._odometry.popleft()
                        self.counts["makers.odometry_lost"] += 1
            case GridOut(name="grid"):
                with self._changed:
                    self._grids.clear()  # it says all that they would
                    self._grids.append(output)
            case GridUpdateOut():
                with self._changed:
                    self._grids.append(output)
                    if len(self._grids) > _GRIDS_WAITING_MAX:
                        self._grids.popleft()
                        self.counts["makers.grids_lost"] += 1

    def ask(self, work: Callable[[], T], limit_s: float | None = None) -> T:
        """Run a function between two turns and give its result: for calls that look into a maker's map.

        MakersBusy if it was not begun within limit_s, None: what all questions wait.
        """
        limit_s = self._ask_limit_s if limit_s is None else limit_s
        if not self._thread.is_alive() or threading.current_thread() is self._thread:
            self._take_replaced()
            return work()
        done, result = threading.Event(), list[object]()
        question: Question = (work, done, result)
        with self._changed:
            self._asked.append(question)
            self._changed.notify_all()
        if not done.wait(limit_s):
            self._take_back(question, limit_s)
            if not done.wait(ASK_LIMIT_S):  # under way: what it gives out must not be lost
                raise Trouble(f"the thread of the slow maps did not end a question within {ASK_LIMIT_S:.0f} s")
        error, value = result
        if isinstance(error, BaseException):
            raise error
        return value  # type: ignore[return-value]

    def _take_back(self, question: Question, limit_s: float) -> None:
        with self._changed:
            if any(waiting is question for waiting in self._asked):
                self._asked = deque(waiting for waiting in self._asked if waiting is not question)
                raise MakersBusy(
                    f"lines, rooms and other slow maps are being drawn and did not answer within {limit_s:.0f} s: "
                    "the computer is busy, or the map was just corrected; try again in a moment"
                )

    def changed_tiles(self, limit_s: float | None = None) -> dict[str, list[Tile]]:
        """By layer of the store. MakersBusy: nothing was taken, it all comes with the next call."""
        return self.ask(
            lambda: {
                layer_of(desk.maker): desk.maker.changed_tiles()
                for desk in self._desks
                if desk.maker.name not in self._half_drawn
            },
            limit_s,
        )

    def restore(self, load: Callable[[str], Iterable[Tile]]) -> None:
        """Take up every maker's map from the store's layers; a damaged one begins empty and says so."""
        self.ask(partial(self._take_up, load))

    def replace(self, layers: Mapping[str, Sequence[Tile]]) -> None:
        """Another map is the live one from now on: what these layers hold of it; the others are empty. Never blocks.

        What waits was measured in the map before and is left out; what comes after this call belongs to the new one.
        """
        with self._changed:
            self._replaced, self._redrawn = layers, None
            for waiting in (self._sweeps, self._grids, self._clouds, self._looks, self._odometry):
                waiting.clear()
            self._changed.notify_all()

    def _take_up(self, load: Callable[[str], Iterable[Tile]]) -> None:
        for desk in self._desks:
            try:
                desk.is_fed = True  # so that what was taken up is published
                desk.maker.restore(load(layer_of(desk.maker)))
            except ValueError as error:
                log.error("%s: begins empty: what was stored cannot be used: %s", desk.maker.name, error)
                desk.maker.restore(())

    def _take_replaced(self) -> None:
        with self._changed:
            layers, self._replaced = self._replaced, None
        if layers is None:
            return
        self._mirror = _Mirror()
        self._take_up(lambda layer: layers.get(layer, ()))
        for desk in self._desks:
            desk.changed = None
            if isinstance(desk.maker, TellsMotion):
                self._guard(desk, desk.maker.map_moved)

    def counters(self) -> Mapping[str, int]:
        """Our own, and those of makers that count."""
        counts = dict(self.counts)
        for desk in self._desks:
            if isinstance(desk.maker, Counting):
                counts |= desk.maker.counts
        return counts

    # --- the thread

    def _run(self) -> None:
        while True:
            with self._changed:
                if not (self._stopping or self._asked or self._replaced is not None):
                    self._changed.wait(_TURN_S)
                last = self._stopping
            self.turn(self._now_ns())
            if last:
                return

    def turn(self, now_ns: int) -> None:
        """Work off what waits; tests call it without the thread."""
        self._take_replaced()
        with self._changed:
            sweeps, self._sweeps = self._sweeps, deque()
            grids, self._grids = self._grids, deque()
            clouds, self._clouds = self._clouds, deque()
            looks, self._looks = self._looks, deque()
            odometry, self._odometry = self._odometry, deque()
            asked, self._asked = self._asked, deque()
            redrawn, self._redrawn = self._redrawn, None
        for work, done, result in asked:
            try:
                result.extend((None, work()))
            except BaseException as error:  # it belongs to the thread that asked
                result.extend((error, None))
            done.set()
        if redrawn is not None:
            self._draw_anew(redrawn)
            for desk in self._desks:
                if isinstance(desk.maker, TellsMotion):
                    self._guard(desk, desk.maker.map_moved)
        for output in grids:
            self._note(self._mirror.take(output))
        for desk in self._desks:
            if desk.maker.name in self._half_drawn:
                continue
            if desk.takes_odometry is not None:
                for odom in odometry:
                    self._guard(desk, partial(desk.takes_odometry, odom))
            for source, scan, map_from_sensor in sweeps:
                if source in desk.maker.sources:
                    desk.is_fed = True
                    self._guard(desk, partial(desk.maker.take_sweep, source, scan, map_from_sensor))
            if desk.takes_clouds is not None:
                for cloud in clouds:
                    desk.is_fed = True
                    self._guard(desk, partial(desk.takes_clouds, cloud))
            if desk.takes_looks is not None:
                for look in looks:
                    desk.is_fed = True
                    self._guard(desk, partial(desk.takes_looks, look))
            if now_ns >= desk.due_ns and (desk.is_fed or desk.changed):
                self._make(desk, now_ns)

    def _draw_anew(self, sweeps: Iterable[Callable[[], Sweep]]) -> None:
        """Every map that is made of sweeps begins again with these; each is made once for all of them."""
        desks = []
        for desk in self._desks:
            if desk.start_anew is not None:
                desks.append(desk)
                desk.is_fed = True
                self._guard(desk, desk.start_anew)
        for make in sweeps if desks else ():
            if self._is_cut_short:
                self._half_drawn = {desk.maker.name for desk in desks}
                log.warning("stopped while maps were being drawn anew: they stay as they were saved before")
                return
            source, scan, map_from_sensor = make()
            for desk in desks:
                if source in desk.maker.sources:
                    self._guard(desk, partial(desk.maker.take_sweep, source, scan, map_from_sensor))

    def _note(self, changed: Rect | None) -> None:
        if changed is not None:
            for desk in self._desks:
                desk.changed = [*(desk.changed or ()), changed]

    def _make(self, desk: _Desk, now_ns: int) -> None:
        pose = self._pose
        stamp_ns = max(self._mirror.stamp_ns, 0 if pose is None else pose.stamp_ns)
        view = MapView(
            stamp_ns, self._mirror.patch, tuple(desk.changed or ()), None if pose is None else pose.map_from_base
        )
        desk.due_ns, desk.is_fed, desk.changed = now_ns + desk.maker.period_ns, False, None

        def make() -> None:
            for output in desk.maker.make(view):
                self._offer(output)

        self._guard(desk, make)

    def _guard(self, desk: _Desk, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:
            self.counts["makers.errors"] += 1
            kind = f"{desk.maker.name}: {type(error).__name__}: {error}"[:200]
            if kind not in self._complained and len(self._complained) < 100:
                self._complained.add(kind)
                log.exception("internal error in a map maker: %s", kind)


def thinned(sweeps: Sequence[Sweep], steps: float = 1.0) -> deque[Sweep]:
    """Without those that were taken nearer than so many THINNED_M and THINNED_RAD to the last one that stays of their
    source; its newest always stays."""
    newest = {source: number for number, (source, _, _) in enumerate(sweeps)}
    places: dict[str, list[float]] = {}
    stay: deque[Sweep] = deque()
    for number, sweep in enumerate(sweeps):
        source, _, pose = sweep
        place = (pose if pose.ndim == 1 else pose[len(pose) // 2]).tolist()
        last = places.get(source)
        if last is None or number == newest[source] or _is_apart(last, place, steps):
            places[source] = place
            stay.append(sweep)
    return stay


def _is_apart(a: Sequence[float], b: Sequence[float], steps: float) -> bool:
    way_m, turn_rad = math.hypot(b[0] - a[0], b[1] - a[1]), abs(wrap_angle(b[2] - a[2]))
    return way_m >= steps * THINNED_M or turn_rad >= steps * THINNED_RAD


class SweepTap:
    """A grid layer, as fusion sees it, that draws nothing and passes posed sweeps on."""

    def __init__(self, makers: MapMakers, sources: Iterable[str]) -> None:
        self._makers = makers
        self.sources = frozenset(sources)

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        self._makers.take_sweep(source, scan, map_from_sensor)

    def take_round(self, source: str, heard: Round, map_from_base: Pose2) -> None:
        """Cones go into grids only."""

    def take_touch(self, source: str, touch: Touch, map_from_base: Pose2) -> None:
        """So does what switches touch."""

    def outputs(self, map_from_base: Pose2 | None, stamp_ns: int, now_ns: int) -> list[Output]:
        return []


class _Mirror:
    """The published grid, put together from whole grids and updates as a subscriber would."""

    def __init__(self) -> None:
        self.patch: GridPatch | None = None
        self.stamp_ns = 0
        self._epoch = -1

    def take(self, output: GridOut | GridUpdateOut) -> Rect | None:
        """Take one in; where it changed something."""
        if isinstance(output, GridOut):
            return self._replace(output)
        if self.patch is None or output.epoch != self._epoch:
            return None
        self.stamp_ns = output.stamp_ns
        return self._paste(self.patch, output.patch)

    def _replace(self, output: GridOut) -> Rect | None:
        old, new = self.patch, output.patch
        self.patch = GridPatch(new.resolution_m, new.row0, new.col0, new.cells.copy())
        self.stamp_ns, self._epoch = output.stamp_ns, output.epoch
        was = np.full_like(new.cells, -1)
        if old is not None and old.resolution_m == new.resolution_m:
            into, out_of = _overlap(was.shape, (new.row0, new.col0), old)
            was[into] = old.cells[out_of]
        return _bounds(was != new.cells, new.row0, new.col0)

    def _paste(self, mirror: GridPatch, piece: GridPatch) -> Rect | None:
        into, out_of = _overlap(mirror.cells.shape, (mirror.row0, mirror.col0), piece)
        target, source = mirror.cells[into], piece.cells[out_of]
        changed = _bounds(target != source, mirror.row0 + into[0].start, mirror.col0 + into[1].start)
        target[...] = source
        return changed


def _overlap(
    shape: tuple[int, ...], origin: tuple[int, int], piece: GridPatch
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of the common part: in an array of this shape and origin, and in the piece."""
    slices = []
    for size, first, piece_first, piece_size in zip(shape, origin, (piece.row0, piece.col0), piece.cells.shape):
        begin = max(first, piece_first)
        end = max(begin, min(first + size, piece_first + piece_size))
        slices.append((slice(begin - first, end - first), slice(begin - piece_first, end - piece_first)))
    (rows_into, rows_from), (cols_into, cols_from) = slices
    return (rows_into, cols_into), (rows_from, cols_from)


def _bounds(mask: NDArray[np.bool_], row0: int, col0: int) -> Rect | None:
    """The box around what is true."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return Rect(row0 + int(rows[0]), col0 + int(cols[0]), int(rows[-1] - rows[0]) + 1, int(cols[-1] - cols[0]) + 1)


def layer_of(maker: MapMaker) -> str:
    """The name of a maker's layer of tiles in the store."""
    return f"maker-{maker.name}"
