"""What every source says about the sectors of one map, and what that comes to together.

The rules, each there so that no loss of data makes a sector freer:

- the nearest obstacle of all fresh evidence wins; a sector is free only as far as one fresh source saw all of it;
- evidence that has become too old, or whose device is lost, makes its sectors stale, unless a fresh obstacle is at
  least as near as what it knew;
- an obstacle in a direction that a newer scan says nothing about stays, with its old stamp, until a valid beam looks
  that way again;
- before every source has been heard once no sector is free: nobody knows what the silent one would have seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapping.kernels import sectors as kernels
from mapping.sectors.snapshot import SectorState

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I16 = NDArray[np.int16]
I8 = NDArray[np.int8]
Bool = NDArray[np.bool_]
Looked = Callable[[F64, F64, F64], Bool]
"""Of obstacles, given by distance and two coordinates, (N,) each: in whose direction did the new reading look?"""
_STATES = tuple(int(each) for each in (SectorState.OBSTACLE, SectorState.FREE, SectorState.UNKNOWN, SectorState.STALE))


@dataclass(slots=True)
class Finding:
    """What one reading says about N sectors.

    obstacle_m: (N,) distance of the nearest obstacle, inf none.  u, v: (N,) its coordinates (polar maps: bearing in
    u).  free_m: (N,) up to which all of the sector was seen free, 0 nowhere.  blind: (N,) sectors the reading was
    meant to see and could not.
    """

    obstacle_m: F64
    u: F64
    v: F64
    free_m: F64
    blind: Bool


def blind_finding(blind: Bool) -> Finding:
    """Nothing but where a reading was meant to see and could not, (N,)."""
    count = len(blind)
    nowhere = np.full(count, np.nan)
    return Finding(np.full(count, np.inf), nowhere, nowhere, np.zeros(count), blind)


class Later:
    """A finding that is worked out when somebody asks for it: most maps are read by nobody most of the time.

    make: from values that stay as they are.  obstacles: its obstacle_m, u and v, if they are known already.
    """

    __slots__ = ("_found", "_make", "_obstacles")

    def __init__(self, make: Callable[[], Finding], obstacles: tuple[F64, F64, F64] | None = None) -> None:
        self._make: Callable[[], Finding] | None = make
        self._found: Finding | None = None
        self._obstacles = obstacles

    def found(self) -> Finding:
        """All of it. Two threads that ask at once make the same."""
        make, found = self._make, self._found
        if found is None:
            assert make is not None
            found = self._found = make()
            self._make = None  # what it was made of is not kept
        return found

    def obstacles(self) -> tuple[F64, F64, F64]:
        """Its obstacle_m, u and v."""
        if self._obstacles is None:
            found = self.found()
            self._obstacles = (found.obstacle_m, found.u, found.v)
        return self._obstacles


@dataclass(slots=True)
class _Held:
    """(N,) obstacles of earlier findings in whose direction nobody has looked since. Only dead is ever replaced."""

    obstacle_m: F64
    u: F64
    v: F64
    stamp_ns: I64
    dead: Bool


@dataclass(slots=True)
class _Channel:
    source: int
    stamp_ns: int
    dead: bool
    finding: Finding | Later
    held: _Held | None = None


class _Row(NamedTuple):
    """What a channel says as of one instant."""

    source: int
    stamp_ns: int
    fresh: bool
    finding: Finding | Later
    held: tuple[F64, F64, F64, I64, Bool] | None


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is known together: (N,) arrays as in PolarSnapshot; u, v: of the nearest obstacle."""

    state: I8
    distance_m: F64
    u: F64
    v: F64
    age_ns: I64
    source: I16
    free_m: F64


class _Table:
    """Findings as the kernel takes them: a row for each channel's in force, then one for what each still holds from
    earlier ones. Only what has changed since the last time is written."""

    def __init__(self, channels: int, count: int) -> None:
        shape = (2 * channels, count)
        self._obstacle, self._u, self._v, self._free = (np.zeros(shape) for _ in range(4))
        self._blind, self._fresh = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        self._stamp, self._source = np.zeros(shape, dtype=np.int64), np.zeros(shape[0], dtype=np.int64)
        self._findings: list[Finding | Later | None] = [None] * channels
        self._stamps = [-1] * channels
        self._freshness = [False] * channels

    def columns(
        self, channels: Sequence[_Row], now_ns: int, limits: tuple[int, ...]
    ) -> tuple[F64, F64, F64, F64, Bool, I64, Bool, I64]:
        """Obstacle, u, v, free, blind, stamp, fresh (F, N) and source (F,) of as many channels as it was made for."""
        rows = len(channels)
        for row, c in enumerate(channels):
            if self._findings[row] is not c.finding:
                self._findings[row] = c.finding
                found = c.finding.found() if isinstance(c.finding, Later) else c.finding
                self._obstacle[row], self._u[row], self._v[row] = found.obstacle_m, found.u, found.v
                self._free[row], self._blind[row], self._source[row] = found.free_m, found.blind, c.source
            if self._stamps[row] != c.stamp_ns:
                self._stamp[row] = self._stamps[row] = c.stamp_ns
            if self._freshness[row] != c.fresh:
                self._fresh[row] = self._freshness[row] = c.fresh
        for c in channels:
            if c.held is not None and np.isfinite(c.held[0]).any():
                self._obstacle[rows], self._u[rows], self._v[rows], self._stamp[rows], dead = c.held
                self._free[rows], self._blind[rows], self._source[rows] = 0.0, False, c.source
                self._fresh[rows] = ~dead & (now_ns - c.held[3] <= limits[c.source])
                rows += 1
        return (
            self._obstacle[:rows], self._u[:rows], self._v[:rows], self._free[:rows], self._blind[:rows],
            self._stamp[:rows], self._fresh[:rows], self._source[:rows],
        )  # fmt: skip


class Evidence:
    """The newest findings of every source and channel about the sectors of one map.

    stale_after_ns: for all sources, or one for each.  wait_for_sources: no free sector before all have been heard.
    """

    def __init__(
        self, *, count: int, sources: tuple[str, ...], stale_after_ns: int | tuple[int, ...], wait_for_sources: bool
    ) -> None:
        limits = (stale_after_ns,) * len(sources) if isinstance(stale_after_ns, int) else tuple(stale_after_ns)
        if not sources or len(set(sources)) != len(sources):
            raise ValueError("a sector map needs sources with different names")
        if len(limits) != len(sources) or min(limits) <= 0:
            raise ValueError("stale_after_ns must be positive: one number, or one for each source")
        self.sources = sources
        self._count = count
        self._limits = limits
        self._channels: dict[tuple[int, int], _Channel] = {}  # in order of their keys; they only become more
        self._table = _Table(0, count)
        self._touched: dict[tuple[int, int], Finding] = {}  # of switches: what each would say if it were tripped
        self._heard = [not wait_for_sources] * len(sources)
        self._nothing_m, self._nowhere = np.full(count, np.inf), np.full(count, np.nan)
        for each in (self._nothing_m, self._nowhere):
            each.setflags(write=False)

    def index(self, source: str) -> int:
        """Of a source by name; ValueError names the ones there are."""
        try:
            return self.sources.index(source)
        except ValueError:
            raise ValueError(f"{source!r} does not feed this sector map, only {', '.join(self.sources)}") from None

    def has_heard(self, source: str, channel: int) -> bool:
        """Whether a channel has said anything yet. ValueError for an unknown source."""
        return (self.index(source), channel) in self._channels

    def revise(
        self, source: str, channel: int, finding: Finding | Later, *, stamp_ns: int, looked: Looked | None
    ) -> None:
        """Replace a channel's finding by a newer one. Older ones than the last are passed over.

        looked: None if the reading looked everywhere its predecessor did.
        """
        at = self.index(source)
        self._heard[at] = True
        old = self._channels.get((at, channel))
        if old is not None and not old.dead and stamp_ns < old.stamp_ns:
            return
        new = _Channel(at, stamp_ns, False, finding)
        if old is not None and looked is not None:
            _hold(new, old, looked)
        self._channels[at, channel] = new
        if old is None:
            self._channels = dict(sorted(self._channels.items()))
            self._table = _Table(len(self._channels), self._count)

    def feel(self, source: str, channel: int, touched: Finding, *, tripped: bool | None, stamp_ns: int) -> None:
        """Take a switch. touched: what it says when it is tripped; else it says nothing, and None that it is stale."""
        at = self.index(source)
        none = np.zeros(self._count)
        clear = Finding(self._nothing_m, self._nowhere, self._nowhere, none, none.astype(bool))
        self._touched[at, channel] = touched
        self.revise(source, channel, clear if tripped is False else touched, stamp_ns=stamp_ns, looked=None)
        if tripped is None:
            self._channels[at, channel].dead = True

    def lost(self, source: str) -> None:
        """The device is gone: all it said is stale from now on, until each channel speaks again."""
        at = self.index(source)
        for (owner, number), touched in self._touched.items():
            if owner == at:  # nobody knows any more whether it is touched
                self._channels[owner, number].finding = touched
        for channel in self._channels.values():
            if channel.source == at:
                channel.dead = True
                if channel.held is not None:
                    channel.held.dead = np.ones(self._count, dtype=bool)

    def verdict(self, now_ns: int) -> Verdict:
        """What is known of each sector at an instant."""
        return _judged(self._rows(now_ns), self._table, self._count, self._limits, all(self._heard), now_ns)

    def verdict_later(self, now_ns: int) -> Callable[[], Verdict]:
        """The same, worked out when it is called, by whichever thread; what comes until then does not change it."""
        rows, all_heard, count, limits = self._rows(now_ns), all(self._heard), self._count, self._limits
        return lambda: _judged(rows, _Table(len(rows), count), count, limits, all_heard, now_ns)

    def _rows(self, now_ns: int) -> list[_Row]:
        """All channels as they stand; those that have become too old stay so."""
        rows = []
        for c in self._channels.values():
            # A stamp far ahead is a broken clock: it must not keep an old reading young.
            if abs(now_ns - c.stamp_ns) > self._limits[c.source]:
                c.dead = True
            held = c.held
            kept = None if held is None else (held.obstacle_m, held.u, held.v, held.stamp_ns, held.dead)
            rows.append(_Row(c.source, c.stamp_ns, not c.dead, c.finding, kept))
        return rows


def _judged(
    rows: Sequence[_Row], table: _Table, count: int, limits: tuple[int, ...], all_heard: bool, now_ns: int
) -> Verdict:
    if rows:
        return Verdict(*kernels.judge(*table.columns(rows, now_ns, limits), all_heard, now_ns, _STATES))
    nan, none = np.full(count, np.nan), np.full(count, -1, dtype=np.int64)
    state = np.full(count, SectorState.UNKNOWN, dtype=np.int8)
    return Verdict(state, nan, nan.copy(), nan.copy(), none, none.astype(np.int16), np.zeros(count))


def _hold(new: _Channel, old: _Channel, looked: Looked) -> None:
    """Of what was held before and of the last finding: the nearest obstacle nobody has looked at since."""
    ours_m = _obstacles(new.finding)[0]
    if old.held is not None:
        was = old.held
        stays = _unseen(ours_m, ours_m, was.obstacle_m, was.u, was.v, looked)
        if len(stays):
            held = new.held = _nothing_held(len(ours_m))
            _take(held, stays, was.obstacle_m, was.u, was.v)
            held.stamp_ns[stays], held.dead[stays] = was.stamp_ns[stays], was.dead[stays]
    obstacle_m, u, v = _obstacles(old.finding)
    stays = _unseen(ours_m, ours_m if new.held is None else new.held.obstacle_m, obstacle_m, u, v, looked)
    if len(stays):
        held = new.held = new.held or _nothing_held(len(ours_m))
        _take(held, stays, obstacle_m, u, v)
        held.stamp_ns[stays], held.dead[stays] = old.stamp_ns, old.dead


def _obstacles(finding: Finding | Later) -> tuple[F64, F64, F64]:
    return finding.obstacles() if isinstance(finding, Later) else (finding.obstacle_m, finding.u, finding.v)


def _unseen(ours_m: F64, held_m: F64, obstacle_m: F64, u: F64, v: F64, looked: Looked) -> I64:
    """Sectors whose obstacle is nearer than all the new reading and what is held already say, and not looked at."""
    nearer: I64 = kernels.nearer_than_both(obstacle_m, ours_m, held_m)
    if len(nearer) == 0:
        return nearer
    return nearer[~looked(obstacle_m[nearer], u[nearer], v[nearer])]


def _nothing_held(count: int) -> _Held:
    nowhere = np.full(count, np.nan)
    return _Held(
        np.full(count, np.inf), nowhere, nowhere.copy(), np.zeros(count, dtype=np.int64), np.zeros(count, dtype=bool)
    )


def _take(held: _Held, stays: I64, obstacle_m: F64, u: F64, v: F64) -> None:
    held.obstacle_m[stays], held.u[stays], held.v[stays] = obstacle_m[stays], u[stays], v[stays]
