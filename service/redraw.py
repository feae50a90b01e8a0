"""After a correction the map is drawn again where it moved, from sweeps that were kept for that.

    fusion thread: keep() ... corrected() --job--> background --grid--> take_up(): tiles replaced, a new epoch begins

Kept are sweeps and sonar rounds every STEP_M or STEP_RAD of the way. A job finds the tiles on which anything that moved
by more than TOLERANCE_M was or will be drawn, with the tiles around them, and draws these anew. The result is taken up
before the first scan that is older than a delay that stamps and counts alone decide, in one go: subscribers see the
map before or after, never a mixture. What was kept meanwhile is drawn on top. Tiles nobody moved stay as they are.

Of a place that is seen often, the oldest of what was kept is given up in time (KeptPlaces): a robot that drives the
same rooms for days keeps no more than after some laps. What is drawn already stays drawn.

What is drawn around the robot (FollowsCorrections) moves at once, as the robot's pose does.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.tiles import TILE
from mapping.localise.kept_places import KeptPlaces, profile_of
from mapping.localise.kept_sweeps import KeptSweep, kept_sweep, shifts_m
from mapping.localise.pose_graph import composed_poses
from mapping.scan import Scan
from service.background import Submit
from service.fusion import FollowsCorrections, GridLayer, Round, Touch
from service.kept_rounds import KeptRound, KeptTouch, Shapes
from service.layers import BuildingLayer, insert_round, insert_sweep, insert_touch

log = logging.getLogger(__name__)

F64 = NDArray[np.float64]
Place = tuple[int, int]
Sweep = tuple[str, Scan, F64]
OnRedrawn = Callable[[Sequence[Callable[[], Sweep]]], None]
"""Told after each redrawing: every kept sweep as it is drawn now, made when it is called for."""

STEP_M = 0.10
STEP_RAD = math.radians(5.0)
TOLERANCE_M = 0.015
DELAY_NS = 500_000_000
DELAY_NS_PER_KEPT = 2_000_000  # about ten times what one takes to draw thrice
GIVE_UP_AT_ONCE = 64  # so many may go before anything does: the rest is moved together each time
_NO_CHANNELS: frozenset[int] = frozenset()
RECENT = 40  # kept sweeps that make up what is around the robot


Kept = KeptSweep | KeptRound | KeptTouch


@dataclass(frozen=True, slots=True)
class Job:
    """What a redrawing sees. drawn, now: (N, 2, 3) base poses of what is kept, as it is drawn and as it should be;
    moved: (N,) which of it moves.  sources: what is drawn of it.  base: stored tiles that lie under it all."""

    empty: OccupancyGrid
    kept: Sequence[Kept]
    mounts: Mapping[str, F64]
    drawn: F64
    now: F64
    moved: NDArray[np.bool_]
    sources: frozenset[str]
    base: Mapping[Place, bytes]

    def run(self) -> Redrawn:
        """Draw anew."""
        places = self._dirty()
        grid = self.empty.empty_copy()
        for row, col in sorted(places & self.base.keys()):
            grid.load_tile(row, col, self.base[row, col])
        for index, each in enumerate(self.kept):
            ends = self.now[index] if self.moved[index] else self.drawn[index]
            if each.sensor in self.sources and _may_reach(ends, each.reach_m, places, grid.resolution_m):
                draw(grid, each, ends, self.mounts)
        return Redrawn(grid, sorted(places))

    def _dirty(self) -> set[Place]:
        """Tiles that hold something that moves, or will; and their neighbours, for what was not kept."""
        scratch = self.empty.empty_copy()
        for index in np.flatnonzero(self.moved).tolist():
            if self.kept[index].sensor not in self.sources:
                continue
            for ends in (self.drawn[index], self.now[index]):
                draw(scratch, self.kept[index], ends, self.mounts)
        return {(row + i, col + j) for row, col in scratch.places() for i in (-1, 0, 1) for j in (-1, 0, 1)}


@dataclass(frozen=True, slots=True)
class Redrawn:
    """New tiles: these places of this grid."""

    grid: OccupancyGrid
    places: list[Place]


@dataclass(frozen=True, slots=True)
class RedrawState:
    """What is kept for drawing again, to be stored. drawn: (N, 2, 3) as in Job.  serials: (N,) numbers that rise and
    are never used again; next_serial comes next.  base: tiles under it all.  mounts: base_from_sensor (3,) of each
    laser when its sweeps were taken, as it was configured then."""

    kept: tuple[Kept, ...]
    drawn: F64
    serials: NDArray[np.int64]
    next_serial: int
    base: Mapping[Place, bytes]
    mounts: Mapping[str, F64] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _UnderWay:
    job: Job
    future: Future[Redrawn]
    due_ns: int


class Redrawer:
    """What was drawn, and drawing it again. Its methods are for the fusion thread."""

    def __init__(
        self,
        layers: Sequence[GridLayer],
        building: BuildingLayer | None,
        mounts: Mapping[str, Pose2],
        *,
        submit: Submit,
    ) -> None:
        """mounts: base_from_sensor of every laser.  submit: where jobs are done."""
        self._building = building
        self._around = [layer for layer in layers if isinstance(layer, FollowsCorrections)]
        self._mounts = {name: _row(mount) for name, mount in mounts.items()}
        self._submit = submit
        self._kept: list[Kept] = []
        self._serial: list[int] = []  # of what is kept: rises
        self._next_serial = 0
        self._places = KeptPlaces()
        self._gone: set[int] = set()  # serials that go as soon as no job sees them
        self._key: NDArray[np.int64] = np.zeros(64, dtype=np.int64)
        self._in_key: F64 = np.zeros((64, 2, 3))
        self._drawn: F64 = np.zeros((64, 2, 3))
        self._reach: F64 = np.zeros(64)
        self._last: dict[tuple[str, frozenset[int]], Pose2] = {}
        self._bearings: dict[str, NDArray[np.float32]] = {}
        self._shapes: Shapes = {}
        self._under_way: _UnderWay | None = None
        self._base: dict[Place, bytes] = {}
        self.on_redrawn: OnRedrawn = _ignore
        self.counts = {"map.redrawn": 0, "map.redraw_errors": 0, "map.given_up_sweeps": 0}

    # --- keeping

    def keep_sweep(self, source: str, scan: Scan, key: int, key_pose: Pose2, ends: F64) -> None:
        """A sweep that is drawn now, unless it says nothing at all: ends (2, 3) base poses at its first and last beam,
        in the map."""
        if np.isnan(scan.range_m).all():
            return
        if source in self._mounts and self._has_moved(source, Pose2(*ends[0].tolist()), _NO_CHANNELS):
            sweep = kept_sweep(
                source, scan, key=key, in_key=_seen_from(key_pose, ends), known_bearing_rad=self._bearings.get(source)
            )
            self._bearings[source] = sweep.bearing_rad
            self._keep(sweep, ends)

    def keep_round(self, source: str, heard: Round, key: int, key_pose: Pose2, map_from_base: Pose2) -> None:
        """The same for sonars."""
        if self._has_moved(source, map_from_base, frozenset(cone.channel for cone in heard.cones)):
            ends = _at_both_ends(map_from_base)
            self._keep(KeptRound.of(source, key, _seen_from(key_pose, ends), heard, self._shapes), ends)

    def _has_moved(self, source: str, pose: Pose2, channels: frozenset[int]) -> bool:
        last = self._last.get((source, channels))
        if last is not None:
            way_m = math.hypot(pose.x_m - last.x_m, pose.y_m - last.y_m)
            if way_m < STEP_M and abs(wrap_angle(pose.yaw_rad - last.yaw_rad)) < STEP_RAD:
                return False
        self._last[source, channels] = pose
        return True

    def _keep(self, kept: Kept, ends: F64) -> None:
        n = len(self._kept)
        if n == len(self._key):
            self._key = np.concatenate((self._key, np.zeros_like(self._key)))
            self._in_key = np.concatenate((self._in_key, np.zeros_like(self._in_key)))
            self._drawn = np.concatenate((self._drawn, np.zeros_like(self._drawn)))
            self._reach = np.concatenate((self._reach, np.zeros_like(self._reach)))
        self._key[n], self._in_key[n], self._drawn[n], self._reach[n] = kept.key, kept.in_key, ends, kept.reach_m
        self._kept.append(kept)
        serial, self._next_serial = self._next_serial, self._next_serial + 1
        self._serial.append(serial)
        self._gone.update(self._places.add(serial, _name(kept), ends[0], self._profile(kept, ends[0])))
        if len(self._gone) >= GIVE_UP_AT_ONCE:
            self._give_up()

    def _profile(self, kept: Kept, pose: F64) -> NDArray[np.float32] | None:
        if not isinstance(kept, KeptSweep):
            return None
        scan = kept.scan()
        return profile_of(scan.bearing_rad, scan.range_m, float(pose[2] + self._mounts[kept.sensor][2]))

    def _give_up(self) -> None:
        """Forget what may go, unless a job is under way, which counts by place in the list."""
        if self._under_way is not None or not self._gone:
            return
        stays = np.array([serial not in self._gone for serial in self._serial])
        n = int(stays.sum())
        for array in (self._key, self._in_key, self._drawn, self._reach):
            array[:n] = array[: len(stays)][stays]
        self._kept = [kept for kept, here in zip(self._kept, stays) if here]
        self._serial = [serial for serial, here in zip(self._serial, stays) if here]
        self.counts["map.given_up_sweeps"] += len(self._gone)
        self._gone.clear()

    def keep_touch(self, source: str, touch: Touch, key: int, key_pose: Pose2, map_from_base: Pose2) -> None:
        """The same for a switch that is tripped."""
        if self._has_moved(source, map_from_base, frozenset([touch.switch.line])):
            ends = _at_both_ends(map_from_base)
            self._keep(KeptTouch(source, key, _seen_from(key_pose, ends), touch), ends)

    def start_over(self, base: Iterable[tuple[int, int, bytes]] = ()) -> None:
        """Forget what was kept; base: tiles of the map that is there now."""
        self._kept, self._under_way = [], None
        self._serial, self._next_serial, self._places = [], 0, KeptPlaces()
        self._gone.clear()
        self._last.clear()
        self._base = {(row, col): payload for row, col, payload in base}

    def state(self) -> RedrawState:
        """As of now."""
        serials = np.array(self._serial, dtype=np.int64)
        return RedrawState(
            tuple(self._kept), self._drawn[: len(self._kept)].copy(), serials, self._next_serial, self._base,
            dict(self._mounts),
        )  # fmt: skip

    def resume(self, state: RedrawState) -> None:
        """Take up what was kept of the map that is there now.

        Where a laser's mount was configured otherwise then, its sweeps stay where they were seen: by the mount of
        today they were taken from other poses of the base.
        """
        self.start_over()
        self._base = dict(state.base)
        otherwise = {
            name: composed_poses(then, _inverse_of(self._mounts[name]))
            for name, then in state.mounts.items()
            if name in self._mounts and not np.array_equal(then, self._mounts[name])
        }
        for kept, ends, serial in zip(state.kept, state.drawn, state.serials.tolist()):
            if not isinstance(kept, KeptSweep) or kept.sensor in self._mounts:
                if isinstance(kept, KeptSweep) and kept.sensor in otherwise:
                    then_from_now = np.broadcast_to(otherwise[kept.sensor], (2, 3))
                    kept = replace(kept, in_key=composed_poses(kept.in_key, then_from_now))
                    ends = composed_poses(ends, then_from_now)
                self._next_serial = serial
                self._keep(kept, ends)
        self._next_serial = state.next_serial

    def forget_recent(self) -> None:
        """The robot was put elsewhere: what is around it begins again, and the next sweep is kept."""
        self._last.clear()
        for layer in self._around:
            layer.start_over()

    # --- correcting

    def corrected(self, stamp_ns: int, key_poses: F64) -> None:
        """Key scans (K, 3) moved. Begins to draw anew what moved, unless a redrawing is under way: then afterwards."""
        self._draw_around(key_poses)
        self._begin(stamp_ns, key_poses)

    def is_due(self, stamp_ns: int) -> bool:
        """Whether a redrawing is to be taken up before a scan of this stamp is drawn."""
        return self._under_way is not None and stamp_ns >= self._under_way.due_ns

    def is_ready(self, stamp_ns: int) -> bool:
        """Whether `take_up` at this stamp would not wait."""
        return not self.is_due(stamp_ns) or (self._under_way is not None and self._under_way.future.done())

    def take_up(self, stamp_ns: int, key_poses: F64) -> None:
        """Put the redrawing that is due in its place, waiting for it if need be."""
        under_way, self._under_way = self._under_way, None
        if under_way is None:
            return
        building, job = self._building, under_way.job
        assert building is not None
        try:
            redrawn = under_way.future.result()
        except Exception:  # the map stays as it was drawn, skewed; the next correction tries again
            self.counts["map.redraw_errors"] += 1
            log.exception("internal error while drawing the map again")
            return
        self._drawn[: len(job.kept)][job.moved] = job.now[job.moved]
        moved = np.flatnonzero(job.moved)
        self._places.move([self._serial[k] for k in moved.tolist()], job.now[moved, 0])
        for index in range(len(job.kept), len(self._kept)):
            if self._kept[index].sensor in job.sources:
                draw(redrawn.grid, self._kept[index], self._drawn[index], self._mounts)
        building.grid.take_tiles(redrawn.grid, redrawn.places)
        building.start_anew()
        self.counts["map.redrawn"] += 1
        self.on_redrawn(self.sweeps())
        self._begin(stamp_ns, key_poses)

    def sweeps(self) -> list[Callable[[], Sweep]]:
        """Makers of every kept sweep as it is drawn, oldest first."""
        made: list[Callable[[], Sweep]] = []
        for index, kept in enumerate(self._kept):
            if isinstance(kept, KeptSweep):
                made.append(_SweepMaker(kept, self._drawn[index].copy(), self._mounts[kept.sensor]))
        return made

    def _begin(self, stamp_ns: int, key_poses: F64) -> None:
        if self._under_way is not None or self._building is None or not self._kept:
            return
        self._give_up()
        n = len(self._kept)
        drawn = self._drawn[:n].copy()
        now = self._poses_now(key_poses, slice(0, n))
        moved = shifts_m(now, drawn, self._reach[:n]) > TOLERANCE_M
        if not moved.any():
            return
        job = Job(
            self._building.grid.empty_copy(), tuple(self._kept), self._mounts, drawn, now, moved,
            self._building.sources, dict(self._base),
        )  # fmt: skip
        due_ns = stamp_ns + DELAY_NS + DELAY_NS_PER_KEPT * n
        self._under_way = _UnderWay(job, self._submit(job.run), due_ns)

    def _poses_now(self, key_poses: F64, which: slice) -> F64:
        keys, in_key = key_poses[self._key[which]], self._in_key[which]
        return np.stack([composed_poses(keys, in_key[:, end]) for end in (0, 1)], axis=1)

    def _draw_around(self, key_poses: F64) -> None:
        if not self._around or not self._kept:
            return
        first = max(0, len(self._kept) - RECENT)
        ends = self._poses_now(key_poses, slice(first, len(self._kept)))
        for layer in self._around:
            layer.start_over()
            for kept, at in zip(self._kept[first:], ends):
                if kept.sensor not in layer.sources:
                    continue
                if isinstance(kept, KeptSweep):
                    layer.take_sweep(kept.sensor, kept.scan(), kept.poses(at, self._mounts[kept.sensor]))
                elif isinstance(kept, KeptRound):
                    layer.take_round(kept.sensor, kept.heard, Pose2(*at[0].tolist()))
                else:
                    layer.take_touch(kept.sensor, kept.heard, Pose2(*at[0].tolist()))

    @property
    def kept(self) -> int:
        """How many sweeps and rounds are kept."""
        return len(self._kept)


@dataclass(frozen=True, slots=True)
class _SweepMaker:
    """One kept sweep where it is drawn."""

    kept: KeptSweep
    ends: F64
    mount: F64

    def __call__(self) -> Sweep:
        return self.kept.sensor, self.kept.scan(), self.kept.poses(self.ends, self.mount)


def draw(grid: OccupancyGrid, kept: Kept, ends: F64, mounts: Mapping[str, F64]) -> None:
    """Put something kept into a grid, the base having been at ends (2, 3); what it cannot hold is left out."""
    try:
        if isinstance(kept, KeptSweep):
            insert_sweep(grid, kept.scan(), kept.poses(ends, mounts[kept.sensor]))
        elif isinstance(kept, KeptRound):
            insert_round(grid, kept.sensor, kept.heard, Pose2(*ends[0].tolist()))
        else:
            insert_touch(grid, kept.heard, Pose2(*ends[0].tolist()))
    except ValueError:  # farther or longer than a grid can hold: it was not drawn the first time either
        return


def _may_reach(ends: F64, reach_m: float, places: set[Place], resolution_m: float) -> bool:
    """Whether a sweep could touch one of these tiles."""
    side = TILE * resolution_m
    reach = reach_m + 2.0  # sensors sit off the base
    low = np.floor((ends[:, :2].min(axis=0) - reach) / side).astype(int)
    high = np.floor((ends[:, :2].max(axis=0) + reach) / side).astype(int)
    return any((row, col) in places for row in range(low[1], high[1] + 1) for col in range(low[0], high[0] + 1))


def _seen_from(key_pose: Pose2, ends: F64) -> F64:
    return composed_poses(_row(key_pose.inverse()), ends)


def _inverse_of(pose: F64) -> F64:
    return _row(Pose2(*pose.tolist()).inverse())[None, :]


def _at_both_ends(pose: Pose2) -> F64:
    """(2, 3) of what was heard at one instant."""
    return np.array([[pose.x_m, pose.y_m, pose.yaw_rad]] * 2)


def _row(pose: Pose2) -> F64:
    return np.array([pose.x_m, pose.y_m, pose.yaw_rad])


def _name(kept: Kept) -> str:
    """What may stand for what: a laser's sweeps for each other, rounds of the same transducers."""
    if isinstance(kept, KeptSweep):
        return kept.sensor
    if isinstance(kept, KeptRound):
        return kept.shape.name
    return f"{kept.sensor}/{kept.heard.switch.line}"


def _ignore(_: Sequence[Callable[[], Sweep]]) -> None:
    pass
