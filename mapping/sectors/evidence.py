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

from collections.abc import Callable
from dataclasses import dataclass

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


@dataclass(slots=True)
class _Channel:
    source: int
    stamp_ns: int
    dead: bool
    finding: Finding
    held_m: F64
    held_u: F64
    held_v: F64
    held_stamp_ns: I64
    held_dead: Bool
    holds: bool  # held_* are its own, not those that stand for nothing held


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is known together: (N,) arrays as in PolarSnapshot; u, v: of the nearest obstacle."""

    state: I8
    distance_m: F64
    u: F64
    v: F64
    age_ns: I64
    source: I16


class _Table:
    """Findings as the kernel takes them: a row for each channel's in force, then one for what each still holds from
    earlier ones. Only what has changed since the last time is written."""

    def __init__(self, channels: int, count: int) -> None:
        shape = (2 * channels, count)
        self._obstacle, self._u, self._v, self._free = (np.zeros(shape) for _ in range(4))
        self._blind, self._fresh = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        self._stamp, self._source = np.zeros(shape, dtype=np.int64), np.zeros(shape[0], dtype=np.int64)
        self._findings: list[Finding | None] = [None] * channels
        self._stamps = [-1] * channels
        self._freshness = [False] * channels

    def columns(
        self, channels: list[_Channel], now_ns: int, limits: tuple[int, ...]
    ) -> tuple[F64, F64, F64, F64, Bool, I64, Bool, I64]:
        """Obstacle, u, v, free, blind, stamp, fresh (F, N) and source (F,) of as many channels as it was made for."""
        rows = len(channels)
        for row, c in enumerate(channels):
            found = c.finding
            if self._findings[row] is not found:
                self._findings[row] = found
                self._obstacle[row], self._u[row], self._v[row] = found.obstacle_m, found.u, found.v
                self._free[row], self._blind[row], self._source[row] = found.free_m, found.blind, c.source
            if self._stamps[row] != c.stamp_ns:
                self._stamp[row] = self._stamps[row] = c.stamp_ns
            if self._freshness[row] == c.dead:
                self._fresh[row] = self._freshness[row] = not c.dead
        for c in channels:
            if c.holds and np.isfinite(c.held_m).any():
                self._obstacle[rows], self._u[rows], self._v[rows] = c.held_m, c.held_u, c.held_v
                self._free[rows], self._blind[rows], self._source[rows] = 0.0, False, c.source
                self._stamp[rows] = c.held_stamp_ns
                self._fresh[rows] = ~c.held_dead & (now_ns - c.held_stamp_ns <= limits[c.source])
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
        self._nothing_held: tuple[F64, F64, F64, I64, Bool] = (
            np.full(count, np.inf),
            np.full(count, np.nan),
            np.full(count, np.nan),
            np.zeros(count, dtype=np.int64),
            np.zeros(count, dtype=bool),
        )
        for each in self._nothing_held:
            each.setflags(write=False)

    def index(self, source: str) -> int:
        """Of a source by name; ValueError names the ones there are."""
        try:
            return self.sources.index(source)
        except ValueError:
            raise ValueError(f"{source!r} does not feed this sector map, only {', '.join(self.sources)}") from None

    def revise(self, source: str, channel: int, finding: Finding, *, stamp_ns: int, looked: Looked | None) -> None:
        """Replace a channel's finding by a newer one. Older ones than the last are passed over.

        looked: None if the reading looked everywhere its predecessor did.
        """
        at = self.index(source)
        self._heard[at] = True
        old = self._channels.get((at, channel))
        if old is not None and not old.dead and stamp_ns < old.stamp_ns:
            return
        new = _Channel(at, stamp_ns, False, finding, *self._nothing_held, holds=False)
        if old is not None and looked is not None:
            _hold(new, old, looked)
        self._channels[at, channel] = new
        if old is None:
            self._channels = dict(sorted(self._channels.items()))
            self._table = _Table(len(self._channels), self._count)

    def nothing_heard(self, source: str, channel: int, finding: Finding, *, stamp_ns: int) -> None:
        """An invalid reading: what the channel said before stays and ages; a first one only says where it is blind."""
        at = self.index(source)
        if (at, channel) not in self._channels:
            self.revise(source, channel, finding, stamp_ns=stamp_ns, looked=None)

    def feel(self, source: str, channel: int, touched: Finding, *, tripped: bool | None, stamp_ns: int) -> None:
        """Take a switch. touched: what it says when it is tripped; else it says nothing, and None that it is stale."""
        at = self.index(source)
        nothing_m, nowhere, *_ = self._nothing_held
        none = np.zeros(self._count)
        clear = Finding(nothing_m, nowhere, nowhere, none, none.astype(bool))
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
                if channel.holds:
                    channel.held_dead[:] = True

    def verdict(self, now_ns: int) -> Verdict:
        """What is known of each sector at an instant."""
        count = self._count
        if not self._channels:
            nan = np.full(count, np.nan)
            return Verdict(
                np.full(count, SectorState.UNKNOWN, dtype=np.int8),
                nan,
                nan.copy(),
                nan.copy(),
                np.full(count, -1, dtype=np.int64),
                np.full(count, -1, dtype=np.int16),
            )
        for channel in self._channels.values():
            # A stamp far ahead is a broken clock: it must not keep an old reading young.
            if abs(now_ns - channel.stamp_ns) > self._limits[channel.source]:
                channel.dead = True
        return self._judge(now_ns)

    def _judge(self, now_ns: int) -> Verdict:
        columns = self._table.columns(list(self._channels.values()), now_ns, self._limits)
        return Verdict(*kernels.judge(*columns, all(self._heard), now_ns, _STATES))


def _hold(new: _Channel, old: _Channel, looked: Looked) -> None:
    """Of what was held before and of the last finding: the nearest obstacle nobody has looked at since."""
    if old.holds:
        stays = _unseen(new, old.held_m, old.held_u, old.held_v, looked)
        if len(stays):
            _hold_also(new, stays, old.held_m, old.held_u, old.held_v)
            new.held_stamp_ns[stays], new.held_dead[stays] = old.held_stamp_ns[stays], old.held_dead[stays]
    found = old.finding
    stays = _unseen(new, found.obstacle_m, found.u, found.v, looked)
    if len(stays):
        _hold_also(new, stays, found.obstacle_m, found.u, found.v)
        new.held_stamp_ns[stays], new.held_dead[stays] = old.stamp_ns, old.dead


def _unseen(new: _Channel, obstacle_m: F64, u: F64, v: F64, looked: Looked) -> I64:
    """Sectors whose obstacle is nearer than all the new reading and what is held already say, and not looked at."""
    ours_m = new.finding.obstacle_m
    nearer: I64 = kernels.nearer_than_both(obstacle_m, ours_m, new.held_m if new.holds else ours_m)
    if len(nearer) == 0:
        return nearer
    return nearer[~looked(obstacle_m[nearer], u[nearer], v[nearer])]


def _hold_also(new: _Channel, stays: I64, obstacle_m: F64, u: F64, v: F64) -> None:
    if not new.holds:  # until now it has what stands for nothing held
        new.held_m, new.held_u, new.held_v = new.held_m.copy(), new.held_u.copy(), new.held_v.copy()
        new.held_stamp_ns, new.held_dead, new.holds = new.held_stamp_ns.copy(), new.held_dead.copy(), True
    new.held_m[stays], new.held_u[stays], new.held_v[stays] = obstacle_m[stays], u[stays], v[stays]
