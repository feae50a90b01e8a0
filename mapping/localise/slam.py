"""Simultaneous localisation and mapping with lasers: a pose for every scan, a map that is consistent as a whole.

Front end (tracker): each sweep is laid on the last key scans, starting from odometry or, without it, from the motion
so far. Every key_m or key_rad a sweep is kept as a key scan. Back end: loops between key scans, and the pose graph
(closures, pose_graph), cut into pieces of work.

Whose thread does what: none of ours. `add_scan` is called in order of stamps. After it `take_work` may hand out a
piece of work, whose `run` may be called anywhere, also in another thread. Its result is applied at a moment that only
the stamps of the scans decide: `is_due(stamp)` says so before a scan is added. So a trajectory does not depend on
how fast anything ran, and a replay or an offline run gives the same bytes.

    if slam.is_due(scan.stamp_ns):
        slam.apply(pending.result())          # of a thread pool, or simply work.run() of before
    update = slam.add_scan(scan, base_from_sensor, odom_from_base)
    work = slam.take_work()
    if work is not None:
        pending = pool.submit(work.run)

The lag is settings.lag_s plus lag_s_per_key for each key scan of the graph, about ten times what the work takes on
one core of a small machine. If the worker is later than that, whoever calls waits before it adds the next scan, or
holds scans back and goes on with odometry and the last correction: both give the same trajectory in the end.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2, compose_covariance
from mapping.localise.closure_records import (
    Closure,
    ClosureSettings,
    Snapshot,
    WorkResult,
    floored,
    floored_covariance,
    turned_information,
)
from mapping.localise.closures import Work
from mapping.localise.fitting import fitting_match, nearest_keys
from mapping.localise.kept_places import KeptPlaces
from mapping.localise.key_path import KeyPath
from mapping.localise.pose_graph import composed_poses
from mapping.localise.scan_match import Match
from mapping.localise.slam_records import SlamSettings, SlamState, SlamUpdate, WorkIsDueError
from mapping.localise.tracker import References, Tracker
from mapping.localise.views import View, ViewStore
from mapping.scan import Scan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]
Progress = Callable[[int, int], None]

UNMATCHED_PATIENCE = 4.0  # a sweep that fits nothing may be dust, a crowd or a slope: wait before it is kept
FINISHING_PASSES = 4
WORTH_ANOTHER_PASS = 3  # closures gained in one
MOST_KEYS = 24  # key scans of one place whose views are kept, see KeptPlaces
RESORTED_M = 0.1  # key scans that move more are sorted anew


class Slam:
    """See the module's text. Lasers are told apart by the name given with their scans."""

    def __init__(
        self, settings: SlamSettings | None = None, *, start: Pose2 | None = None, keep_scans: bool = True
    ) -> None:
        """start: the base at the first scan; by default where odometry has it.  keep_scans: remember where every scan
        was, for trajectory(); a robot that drives for days keeps key scans only."""
        self.settings = settings if settings is not None else SlamSettings()
        self.epoch = 0
        self.events: Counter[str] = Counter()
        self.closures: tuple[Closure, ...] = ()
        self.closure_weight: F64 = np.zeros(0)
        self._tracker = Tracker(self.settings, self.events)
        self._tracker.start = start
        self._keep_scans = keep_scans
        self._last_key: dict[str, int] = {}  # of each laser
        self._views = ViewStore()
        self._places = KeptPlaces(MOST_KEYS)
        self._may_go: set[int] = set()  # key scans whose views are given up once nothing needs them
        self._poses: F64 = np.zeros((64, 3))  # map_from_sensor of key scans
        self._travel: F64 = np.zeros(64)
        self._base_from_sensor: list[Pose2] = []
        self._key_stamps: list[int] = []
        self._path = KeyPath()
        self._pending: tuple[Closure, ...] = ()
        self._stamps: list[int] = []
        self._scan_key: list[int] = []
        self._scan_in_key: list[tuple[float, float, float]] = []  # base pose in the key scan's sensor frame
        self._key_odom: Pose2 | None = None  # of the sensor, at the newest key scan
        self._key_covariance: F64 = np.zeros((3, 3))
        self._looked_at = 0
        self._outstanding: Work | None = None
        self._due_ns = 0
        self._unoptimised = 0
        self._next_number = 0
        self._handed_out = False

    def begin_at(self, map_from_base: Pose2) -> None:
        """Where the base is at the first scan, said before it is added."""
        if self._tracker.last is not None:
            raise RuntimeError("the first scan was added already")
        self._tracker.start = map_from_base

    # --- going on in a map

    def state(self) -> SlamState:
        """What is known, as of now; what is on probation is not."""
        n = len(self._views)
        edges = self._path.edges()
        mounts = np.array([_row(each) for each in self._base_from_sensor]).reshape(-1, 3)
        return SlamState(
            self._views.kept(), self._poses[:n].copy(), self._travel[:n].copy(), mounts,
            np.array(self._key_stamps, dtype=np.int64), edges.measured, edges.information, self.closures,
            self.closure_weight.copy(), self.epoch, self._next_number,
        )  # fmt: skip

    def resume(self, state: SlamState) -> None:
        """Take up a map before the first scan; where the robot is in it, `join` says. ValueError if it is not whole."""
        n = state.views.count
        shapes = (state.poses.shape, state.travel_m.shape, state.base_from_sensor.shape, state.stamps.shape)
        if shapes != ((n, 3), (n,), (n, 3), (n,)) or state.path.shape != (max(0, n - 1), 3):
            raise ValueError("a stored map whose key scans and poses do not belong together")
        if len(self._views) or self._tracker.last is not None:
            raise RuntimeError("a map is taken up before the first scan")
        for row in range(n):
            self._views.add_packed(state.views.packed(row))
        room = max(64, n)
        self._poses, self._travel = np.zeros((room, 3)), np.zeros(room)
        self._poses[:n], self._travel[:n] = state.poses, state.travel_m
        shared: dict[Pose2, Pose2] = {}
        mounts = (Pose2(*row) for row in state.base_from_sensor.tolist())
        self._base_from_sensor = [shared.setdefault(mount, mount) for mount in mounts]
        self._key_stamps = state.stamps.tolist()
        for row in np.flatnonzero(self._views.kept().is_there()).tolist():
            self._may_go.update(self._places.add(row, "", state.poses[row], None))
        self._path = KeyPath(state.path, state.information)
        self.closures, self.closure_weight = state.closures, state.weight.copy()
        self.epoch, self._next_number, self._looked_at = state.epoch, state.next_number, n

    def join(
        self, scan: Scan, map_from_base: Pose2, base_from_sensor: Pose2 = IDENTITY, odom: Pose2 | None = None, *,
        sensor: str = "",
    ) -> SlamUpdate | None:  # fmt: skip
        """Go on in a map that was taken up, or after the robot was lost, where it was found: this scan is its next key
        scan, tied to those around it by a closure. None, and nothing is changed, if it does not fit there.

        map_from_base: where it was found, to some decimetres.  WorkIsDueError if work is out.
        """
        if self._outstanding is not None:
            raise WorkIsDueError("apply the result of the work that was taken first")
        view = self._tracker.view(scan, sensor)
        if view is None:
            return None
        guess = map_from_base @ base_from_sensor
        rows = nearest_keys(
            self._poses[: len(self._views)], guess, self.settings.near_m, self.settings.references,
            self._views.kept().is_there(),
        )  # fmt: skip
        match = fitting_match(view, self._views.kept(), rows, self._poses[rows], guess)
        if match is None:
            return None
        nearest = int(rows[0])
        start = self._key_pose(nearest)
        seen = floored(
            turned_information(match.information(), -start.yaw_rad),
            self.settings.closures.floor_m,
            self.settings.closures.floor_rad,
        )
        self._key_odom = None  # how it came there is not known
        self._keep(scan.stamp_ns, sensor, view, match.pose, base_from_sensor, odom, None)
        key = len(self._views) - 1
        closure = Closure(nearest, key, start.inverse() @ match.pose, seen, 1.0, True, self._next_number)
        self.closures, self.closure_weight = (*self.closures, closure), np.append(self.closure_weight, 1.0)
        self._next_number += 1
        self._unoptimised += 1
        held = floored(match.information(), self.settings.floor_m, self.settings.floor_rad)
        self._key_covariance = np.asarray(np.linalg.inv(held))
        return self._told(scan.stamp_ns, match.pose, base_from_sensor, odom, match, True)

    # --- scans

    def add_scan(
        self, scan: Scan, base_from_sensor: Pose2 = IDENTITY, odom_from_base: Pose2 | None = None, *, sensor: str = ""
    ) -> SlamUpdate:
        """Find where the robot was at scan.stamp_ns; scans in order of stamps, de-skewed, in their sensor's frame.

        odom_from_base: odometry at that time; None where there is none.
        Raises WorkIsDueError if `is_due(scan.stamp_ns)` and the result was not applied.
        """
        if self.is_due(scan.stamp_ns):
            raise WorkIsDueError("apply the result of the work that was taken before adding this scan")
        view = self._tracker.view(scan, sensor)
        guess = self._tracker.predicted(scan.stamp_ns, base_from_sensor, odom_from_base)
        if view is None:
            return self._told_only(scan.stamp_ns, guess.map_from_base, odom_from_base)
        if not len(self._views):
            self._keep(scan.stamp_ns, sensor, view, guess.map_from_sensor, base_from_sensor, odom_from_base, None)
            return self._told(scan.stamp_ns, guess.map_from_sensor, base_from_sensor, odom_from_base, None, True)
        match = self._tracker.matched(view, self._references(guess.map_from_sensor), guess)
        pose = guess.map_from_sensor if match is None else match.pose
        is_key = self._is_new_ground(sensor, pose, patience=1.0 if match is not None else UNMATCHED_PATIENCE)
        if is_key:
            self._keep(scan.stamp_ns, sensor, view, pose, base_from_sensor, odom_from_base, match)
        return self._told(scan.stamp_ns, pose, base_from_sensor, odom_from_base, match, is_key)

    def _references(self, near: Pose2) -> References:
        """The newest key scans that are not far away."""
        n = len(self._views)
        rows = np.arange(max(0, n - self.settings.references), n)
        distance = np.hypot(self._poses[rows, 0] - near.x_m, self._poses[rows, 1] - near.y_m)
        close = rows[distance < self.settings.near_m]
        chosen = close if len(close) else rows[-1:]
        return References(self._views.kept(), chosen, self._poses[chosen])

    def _is_new_ground(self, sensor: str, pose: Pose2, *, patience: float) -> bool:
        """Whether the sensor has moved enough since its last key scan for another one."""
        last = self._last_key.get(sensor)
        if last is None:
            return True
        off = self._key_pose(last).inverse() @ pose
        moved_m, turned_rad = math.hypot(off.x_m, off.y_m), abs(off.yaw_rad)
        return moved_m > patience * self.settings.key_m or turned_rad > patience * self.settings.key_rad

    def _key_pose(self, key: int) -> Pose2:
        x, y, yaw = self._poses[key].tolist()
        return Pose2(x, y, yaw)

    def _keep(
        self, stamp_ns: int, sensor: str, view: View, pose: Pose2, base_from_sensor: Pose2, odom: Pose2 | None,
        match: Match | None,
    ) -> None:  # fmt: skip
        """Make this scan a key scan."""
        key = self._views.add(view)
        if key == len(self._poses):
            self._poses = np.concatenate((self._poses, np.zeros_like(self._poses)))
            self._travel = np.concatenate((self._travel, np.zeros_like(self._travel)))
        self._poses[key] = (pose.x_m, pose.y_m, pose.yaw_rad)
        self._last_key[sensor] = key
        self._base_from_sensor.append(base_from_sensor)
        self._key_stamps.append(stamp_ns)
        odom_from_sensor = None if odom is None else odom @ base_from_sensor
        if key > 0:
            before = self._key_pose(key - 1)
            measured = before.inverse() @ pose
            information = self._path_information(before, measured, match, odom_from_sensor)
            self._path.append(measured, information)
            self._travel[key] = self._travel[key - 1] + math.hypot(measured.x_m, measured.y_m)
            self._key_covariance = compose_covariance(
                before, self._key_covariance, measured, np.linalg.inv(information)
            )
        self._key_odom = odom_from_sensor
        self._may_go.update(self._places.add(key, "", self._poses[key], None))
        needed = min(self._looked_at, key - self.settings.references)
        gone = sorted(number for number in self._may_go if number < needed)
        self._views.give_up(gone)
        self._may_go.difference_update(gone)

    def _path_information(self, before: Pose2, measured: Pose2, match: Match | None, odom: Pose2 | None) -> F64:
        """Of a key scan's pose seen from the one before: what the match holds, and what odometry holds."""
        s = self.settings
        way, turn = math.hypot(measured.x_m, measured.y_m), abs(measured.yaw_rad)
        if odom is not None and self._key_odom is not None:
            sigma_m, sigma_rad = self._tracker.odometry_sigma(way, turn)
        else:
            sigma_m, sigma_rad = 0.1 + 0.5 * way, math.radians(5.0) + 0.3 * turn
        information = np.diag([1.0 / sigma_m**2, 1.0 / sigma_m**2, 1.0 / sigma_rad**2])
        if match is not None:
            information = information + turned_information(match.information(), -before.yaw_rad)
        else:
            information = np.asarray(np.linalg.inv(np.linalg.inv(information) + self._unseen()), dtype=np.float64)
        return floored(information, s.floor_m, s.floor_rad)

    def _unseen(self) -> F64:
        """(3, 3) what may have happened beside odometry while nothing was matched: a slip, a push."""
        return np.diag([0.05**2, 0.05**2, math.radians(3.0) ** 2]) * (1 + self._tracker.lost_scans)

    def _told_only(self, stamp_ns: int, map_from_base: Pose2, odom: Pose2 | None) -> SlamUpdate:
        """A scan that nothing can be done with: the prediction stands for it."""
        if not len(self._views):
            self._tracker.last = (stamp_ns, map_from_base, odom)
            return SlamUpdate(stamp_ns, map_from_base, np.zeros((3, 3)), False, -1, False, self.epoch)
        key = len(self._views) - 1
        sensor = map_from_base @ self._base_from_sensor[key]
        return self._told(stamp_ns, sensor, self._base_from_sensor[key], odom, None, False)

    def _told(
        self, stamp_ns: int, map_from_sensor: Pose2, base_from_sensor: Pose2, odom: Pose2 | None, match: Match | None,
        is_key: bool,
    ) -> SlamUpdate:  # fmt: skip
        """Note where a scan was, and say it."""
        key = len(self._views) - 1
        map_from_base = map_from_sensor @ base_from_sensor.inverse()
        self._tracker.told(stamp_ns, map_from_base, odom, matched=match is not None or is_key)
        key_pose = self._key_pose(key)
        in_key = key_pose.inverse() @ map_from_base
        if self._keep_scans:
            self._stamps.append(stamp_ns)
            self._scan_key.append(key)
            self._scan_in_key.append((in_key.x_m, in_key.y_m, in_key.yaw_rad))
        covariance = self._key_covariance
        if not is_key and match is not None:
            seen = turned_information(match.information(), -key_pose.yaw_rad)
            held = floored_covariance(seen, 0.005, math.radians(0.1))
            covariance = compose_covariance(key_pose, covariance, in_key, held)
        elif match is None and key > 0:
            covariance = covariance + self._unseen()
        return SlamUpdate(stamp_ns, map_from_base, covariance, match is not None or key == 0, key, is_key, self.epoch)

    # --- the back end

    def take_work(self) -> Work | None:
        """The piece of work that became ready with the last scan, once; None if there is none."""
        n = len(self._views)
        if self._outstanding is None and n - self._looked_at >= self.settings.work_keys:
            self._hand_out(self._snapshot(tuple(range(self._looked_at, n))))
            self._looked_at = n
        if self._outstanding is None or self._handed_out:
            return None
        self._handed_out = True
        return self._outstanding

    def _hand_out(self, snapshot: Snapshot) -> None:
        self._outstanding = Work(snapshot, self._closing())
        lag_s = self.settings.lag_s + self.settings.lag_s_per_key * len(self._views)
        assert self._tracker.last is not None
        self._due_ns = self._tracker.last[0] + round(lag_s * 1e9)
        self._handed_out = False

    def _closing(self) -> ClosureSettings:
        """Without odometry a match that goes astray in a turn is not known to: the way cannot say what it explains."""
        if self._key_odom is not None:
            return self.settings.closures
        return replace(self.settings.closures, surprise=math.inf, doubling=math.inf)

    def is_due(self, stamp_ns: int) -> bool:
        """Whether the result of the work that was taken must be applied before a scan of this stamp is added."""
        return self._outstanding is not None and stamp_ns >= self._due_ns

    def apply(self, result: WorkResult) -> None:
        """Take the result of the work that was handed out; later key scans move along with the last it knew."""
        if self._outstanding is None:
            raise RuntimeError("no work was taken")
        known, n = len(result.poses), len(self._views)
        assert known == len(self._outstanding.snapshot.poses)
        before = self._key_pose(known - 1)
        after = Pose2(*result.poses[-1].tolist())
        moved = float(np.abs(result.poses[:, :2] - self._poses[:known, :2]).max(initial=0.0))
        if moved > 0.0:
            tail = self._poses[known:n].copy()
            far = np.flatnonzero(np.abs(result.poses[:, :2] - self._poses[:known, :2]).max(axis=1) > RESORTED_M)
            self._places.move(far.tolist(), result.poses[far])
            correction = after @ before.inverse()
            self._poses[:known] = result.poses
            self._poses[known:n] = composed_poses(_row(correction), tail)
            self._tracker.moved(correction)
        if moved > 0.01:
            self.epoch += 1
        self._pending, self.closures, self.closure_weight = result.pending, result.closures, result.weight
        self._unoptimised, self._next_number = result.unoptimised, result.next_number
        if result.covariance is not None:
            self._key_covariance = self._grown(result.covariance, known - 1)
        self.events.update(result.events)
        self._outstanding = None

    def abandon(self) -> None:
        """Give up the work that was handed out: its key scans stay without closures of their own."""
        self._outstanding = None

    def _grown(self, covariance: F64, key: int) -> F64:
        """Covariance of the newest key scan from that of an earlier one, along the path."""
        for k in range(key, len(self._views) - 1):
            measured, information = self._path.step(k)
            covariance = compose_covariance(self._key_pose(k), covariance, measured, np.linalg.inv(information))
        return covariance

    def _snapshot(self, keys: tuple[int, ...], *, thorough: bool = False) -> Snapshot:
        n = len(self._views)
        return Snapshot(
            self._views.kept(), self._poses[:n].copy(), self._travel[:n].copy(), self._path.edges(), self.closures,
            self._pending, keys, self._unoptimised, self._next_number, thorough,
        )  # fmt: skip

    def snapshot(self) -> Snapshot:
        """What is known, as a piece of work would see it."""
        return self._snapshot(())

    def finish(self, progress: Progress | None = None) -> None:
        """No scan will follow: do what work is left, here, then look again at every key scan and optimise until
        nothing moves. May be called in the midst of a run; scans may follow."""
        if self._outstanding is not None:
            self.apply(self._outstanding.run())
        n = len(self._views)
        if n < 2:
            return
        while self._looked_at < n:
            keys = tuple(range(self._looked_at, min(n, self._looked_at + 50)))
            self._looked_at = keys[-1] + 1
            self._do(self._snapshot(keys))
        self._do(self._snapshot((), thorough=True))
        for done in range(FINISHING_PASSES):  # each may bring others within reach
            before = len(self.closures)
            self._look_again(done * n, FINISHING_PASSES * n, progress)
            if len(self.closures) < before + WORTH_ANOTHER_PASS:
                break

    def _look_again(self, done: int, total: int, progress: Progress | None) -> None:
        """Look for closures of the key scans that have none, then let the graph settle: a loop that was closed
        late brings others within reach."""
        n, there = len(self._views), self._views.kept().is_there()
        for first in range(0, n, 40):
            closed = {c.to for c in self.closures}
            keys = tuple(k for k in range(first, min(n, first + 40)) if k not in closed and there[k])
            if keys:
                self._do(self._snapshot(keys))
            if progress is not None:
                progress(done + min(n, first + 40), total)
        self._do(self._snapshot((), thorough=True))

    def _do(self, snapshot: Snapshot) -> None:
        self._outstanding = Work(snapshot, self._closing())
        self.apply(self._outstanding.run())

    def add_closure(self, start: int, to: int, measured: Pose2, information: F64) -> int:
        """A closure from elsewhere: key scan `to` seen from `start` (sensor frames). It is as doubtful as any and
        counts from the next optimisation on. Returns its number."""
        if not 0 <= start < len(self._views) or not 0 <= to < len(self._views) or start == to:
            raise ValueError(f"no such pair of key scans: {start}, {to}; there are {len(self._views)}")
        if self._outstanding is not None:
            raise WorkIsDueError("apply the result of the work that was taken first")
        number = self._next_number
        closure = Closure(start, to, measured, np.asarray(information, dtype=np.float64), 1.0, True, number)
        self.closures = (*self.closures, closure)
        self.closure_weight = np.append(self.closure_weight, 1.0)
        self._next_number += 1
        self._unoptimised += 1
        return number

    def undo_closure(self, number: int) -> None:
        """Forget one closure; the map settles at the next optimisation. KeyError if there is none of that number."""
        if self._outstanding is not None:
            raise WorkIsDueError("apply the result of the work that was taken first")
        kept = [k for k, c in enumerate(self.closures) if c.number != number]
        if len(kept) == len(self.closures):
            raise KeyError(number)
        self.closures = tuple(self.closures[k] for k in kept)
        self.closure_weight = self.closure_weight[kept]
        self._unoptimised += 1

    def undo_between(self, pairs: Collection[tuple[int, int]]) -> int:
        """Forget every closure, accepted or on probation, that ties one of these pairs (start, to) of key scans; how
        many were accepted. The map settles with `settle`, or at the next optimisation."""
        if self._outstanding is not None:
            raise WorkIsDueError("apply the result of the work that was taken first")
        kept = [k for k, c in enumerate(self.closures) if (c.start, c.to) not in pairs]
        undone = len(self.closures) - len(kept)
        self.closures = tuple(self.closures[k] for k in kept)
        self.closure_weight = self.closure_weight[kept]
        self._pending = tuple(c for c in self._pending if (c.start, c.to) not in pairs)
        self._unoptimised += undone
        return undone

    def settle(self) -> None:
        """Make a piece of work that optimises the graph as it is, for `take_work`; WorkIsDueError if one is out."""
        if self._outstanding is not None:
            raise WorkIsDueError("apply the result of the work that was taken first")
        if self._tracker.last is not None and len(self._views) > 1:
            due = max(self._unoptimised, self.settings.closures.optimise_every)
            self._hand_out(replace(self._snapshot(()), unoptimised=due))

    # --- what is known

    @property
    def keys(self) -> int:
        """Number of key scans."""
        return len(self._views)

    @property
    def pending(self) -> tuple[Closure, ...]:
        """Closures on probation, in the order they were found."""
        return self._pending

    @property
    def is_working(self) -> bool:
        """Whether a piece of work is out whose result was not applied yet."""
        return self._outstanding is not None

    @property
    def memory_bytes(self) -> int:
        """What views take; the rest is small."""
        return self._views.memory_bytes

    def trajectory(self) -> tuple[I64, F64]:
        """Stamps (N,) and base poses (N, 3) of all scans, as the map stands now; none without keep_scans."""
        if not self._stamps:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        keys = np.array(self._scan_key)
        poses = composed_poses(self._poses[keys], np.array(self._scan_in_key))
        return np.array(self._stamps, dtype=np.int64), poses

    def path_between(self, first: int, last: int) -> list[tuple[Pose2, F64]]:
        """Measured motions between successive key scans, and their information (3, 3), from scan `first` to `last`."""
        return [self._path.step(k) for k in range(self._scan_key[first], self._scan_key[last])]

    def key_stamps(self) -> tuple[int, ...]:
        """When key scans were taken."""
        return tuple(self._key_stamps)

    @property
    def last_pose(self) -> Pose2 | None:
        """Base pose at the last scan, as the map stands now; None before the first."""
        return None if self._tracker.last is None else self._tracker.last[1]

    def key_pose(self, key: int) -> Pose2:
        """Base pose of one key scan."""
        return self._key_pose(key) @ self._base_from_sensor[key].inverse()

    def step_covariance(self, step: Pose2) -> F64:
        """(3, 3) of a motion by odometry, as far as it is trusted by now."""
        sigma_m, sigma_rad = self._tracker.odometry_sigma(math.hypot(step.x_m, step.y_m), abs(step.yaw_rad))
        return np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])

    @property
    def lost_scans(self) -> int:
        """How many scans in a row fitted nothing."""
        return self._tracker.lost_scans

    def key_poses(self) -> F64:
        """(K, 3) base poses of key scans."""
        turned = {mount: mount.inverse() for mount in set(self._base_from_sensor)}
        inverses = np.array([_row(turned[mount]) for mount in self._base_from_sensor]).reshape(-1, 3)
        return composed_poses(self._poses[: len(self._views)], inverses)


def run_here(slam: Slam, stamp_ns: int, result: WorkResult | None) -> WorkResult | None:
    """For one thread: apply the result that is due before a scan of this stamp; what is left to apply."""
    if slam.is_due(stamp_ns):
        assert result is not None
        slam.apply(result)
        return None
    return result


def _row(pose: Pose2) -> F64:
    return np.array([pose.x_m, pose.y_m, pose.yaw_rad])
