"""Simultaneous localisation and mapping with lasers: a pose for every scan, a map that is consistent as a whole.

Front end: each sweep is laid on the last key scans (scan_match), starting from odometry or, without it, from the
motion so far. Every key_m or key_rad a sweep is kept as a key scan. Back end: loops between key scans, and the pose
graph (closures, pose_graph), cut into pieces of work.

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
from collections import Counter, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2, compose_covariance, exp_se2, log_se2, wrap_angle
from mapping.localise.closure_records import (
    Closure,
    ClosureSettings,
    Snapshot,
    WorkResult,
    floored,
    floored_covariance,
    turned_information,
)
from mapping.localise.closures import REFINING, Work
from mapping.localise.kept_places import KeptPlaces
from mapping.localise.key_path import KeyPath
from mapping.localise.odometry_trust import Heading, Trust
from mapping.localise.pose_graph import composed_poses
from mapping.localise.scan_match import Match, Reach, agreement, match_view, weakest_information
from mapping.localise.search import find_view, raster_of
from mapping.localise.views import BearingTable, View, ViewArrays, ViewStore, table_for, view_of
from mapping.scan import Scan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]
Progress = Callable[[int, int], None]

NEARBY = Reach((0.30, 0.22, 0.18, 0.15), (0.08, 0.06, 0.05, 0.04))
HELD_PER_M2 = 2500.0  # the worst direction of a match is sure to 2 cm: it can judge odometry
LEAST_FIT = 0.3  # of a view's points must be explained, or it says nothing about where it was taken
UNMATCHED_PATIENCE = 4.0  # a sweep that fits nothing may be dust, a crowd or a slope: wait before it is kept
VELOCITY_OVER_S = 0.15
FASTEST_M_S = 20.0
FASTEST_RAD_S = 4.0
FINISHING_PASSES = 4
WORTH_ANOTHER_PASS = 3  # closures gained in one
PLACED_EXPLAINED = 0.6
PLACED_OVERLAP = 0.85  # doors and chairs were moved since
MOST_KEYS = 24  # key scans of one place whose views are kept, see KeptPlaces
RESORTED_M = 0.1  # key scans that move more are sorted anew
CLEARLY = 1.1  # times better a match must be to be believed against the prediction
CLEARLY_PER_DEVIATION = 0.04  # and so much more for each deviation beyond the gate
MOST_BEYOND = 20.0
LEAST_SHARE = 0.2  # of pairs of points, in a match that can judge
ROUGH_COST = 0.2  # of a match: hedges and slopes, no walls
LEAST_RAD = math.radians(0.02)  # what odometry errs in a step, at least


@dataclass(frozen=True, slots=True)
class SlamSettings:
    """Defaults for every robot and building.

    key_m, key_rad: a key scan so often.  references: how many key scans a sweep is laid on, the newest within near_m.
    farthest_m: longer readings are not matched.  odometry_*: standard deviation of a step by odometry: a constant, a
    share of the way and of the turn, all times a factor that is learned from how well odometry agrees with what is
    matched, odometry_factor at first.  gate: a match so many deviations off the prediction must prove that it fits
    better.  work_keys: new key scans that make a piece of work.  lag_s, lag_s_per_key: see
    the module's text.
    """

    key_m: float = 0.3
    key_rad: float = math.radians(12.0)
    references: int = 8
    near_m: float = 6.0
    farthest_m: float = 30.0
    odometry_m: float = 0.004
    odometry_share: float = 0.04
    odometry_m_per_rad: float = 0.05
    odometry_rad: float = math.radians(0.2)
    odometry_turn_share: float = 0.05
    odometry_rad_per_m: float = math.radians(0.5)
    odometry_factor: float = 8.0
    gate: float = 6.0
    floor_m: float = 0.008
    floor_rad: float = math.radians(0.1)
    least_points: int = 12
    work_keys: int = 10
    lag_s: float = 1.0
    lag_s_per_key: float = 0.002
    closures: ClosureSettings = field(default_factory=ClosureSettings)


@dataclass(frozen=True, slots=True)
class SlamUpdate:
    """Where the robot was at one scan.

    covariance: (3, 3) of map_from_base, the start of the map taken as exact.  matched: False where the scan fitted
    nothing and the pose is a prediction.  key: the key scan it is tied to; is_key: this scan is a new one.
    epoch: counts corrections of the map: poses of other epochs do not mix.
    """

    stamp_ns: int
    map_from_base: Pose2
    covariance: F64
    matched: bool
    key: int
    is_key: bool
    epoch: int


@dataclass(frozen=True, slots=True)
class SlamState:
    """What is kept of a map, to go on in it: key scans, what was measured between them, closures.

    poses, base_from_sensor: (N, 3).  travel_m, stamps: (N,).  path, information: (N - 1, 3), (N - 1, 3, 3) as measured
    from one key scan to the next.  weight: (C,) of closures.
    """

    views: ViewArrays
    poses: F64
    travel_m: F64
    base_from_sensor: F64
    stamps: I64
    path: F64
    information: F64
    closures: tuple[Closure, ...]
    weight: F64
    epoch: int
    next_number: int


class WorkIsDueError(RuntimeError):
    """A scan was added before the result that is due had been applied."""


@dataclass(slots=True)
class _Sensor:
    """What is known of one laser."""

    table: BearingTable
    last_key: int = -1


@dataclass(frozen=True, slots=True)
class _Place:
    """A predicted pose in the map and its standard deviations; step: what odometry says the base moved, if it is from
    there."""

    map_from_sensor: Pose2
    map_from_base: Pose2
    sigma_m: float
    sigma_rad: float
    step: Pose2 | None = None

    def information(self) -> F64:
        """(3, 3) of x, y, yaw."""
        return np.diag([self.sigma_m**-2.0, self.sigma_m**-2.0, self.sigma_rad**-2.0])

    def deviations(self, pose: Pose2) -> tuple[float, float]:
        """How far another pose is off, in standard deviations: translation, rotation."""
        off = self.map_from_sensor.inverse() @ pose
        return math.hypot(off.x_m, off.y_m) / self.sigma_m, abs(off.yaw_rad) / self.sigma_rad


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
        self._start = start
        self._keep_scans = keep_scans
        self._sensors: dict[str, _Sensor] = {}
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
        self._last: tuple[int, Pose2, Pose2 | None] | None = None  # stamp, map_from_base, odom_from_base
        self._velocity: F64 = np.zeros(3)  # a twist of the base in its own frame [m/s, m/s, rad/s]
        self._recent: deque[tuple[int, Pose2]] = deque(maxlen=64)
        self._trust = Trust(self.settings.odometry_factor)
        self._heading = Heading(self.settings.odometry_rad_per_m, self.settings.odometry_turn_share)
        self._lost_scans = 0
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
        if self._last is not None:
            raise RuntimeError("the first scan was added already")
        self._start = map_from_base

    # --- going on in a map

    def state(self) -> SlamState:
        """What is known, as of now; what is on probation is not."""
        n = len(self._views)
        edges = self._path.edges()
        mounts = np.array([_row(each) for each in self._base_from_sensor]).reshape(-1, 3)
        return SlamState(
            self._views.arrays(), self._poses[:n].copy(), self._travel[:n].copy(), mounts,
            np.array(self._key_stamps, dtype=np.int64), edges.measured, edges.information, self.closures,
            self.closure_weight.copy(), self.epoch, self._next_number,
        )  # fmt: skip

    def resume(self, state: SlamState) -> None:
        """Take up a map before the first scan; where the robot is in it, `join` says. ValueError if it is not whole."""
        n = state.views.count
        shapes = (state.poses.shape, state.travel_m.shape, state.base_from_sensor.shape, state.stamps.shape)
        if shapes != ((n, 3), (n,), (n, 3), (n,)) or state.path.shape != (max(0, n - 1), 3):
            raise ValueError("a stored map whose key scans and poses do not belong together")
        if len(self._views) or self._last is not None:
            raise RuntimeError("a map is taken up before the first scan")
        for row in range(n):
            self._views.add(state.views.view(row))
        room = max(64, n)
        self._poses, self._travel = np.zeros((room, 3)), np.zeros(room)
        self._poses[:n], self._travel[:n] = state.poses, state.travel_m
        shared: dict[Pose2, Pose2] = {}
        mounts = (Pose2(*row) for row in state.base_from_sensor.tolist())
        self._base_from_sensor = [shared.setdefault(mount, mount) for mount in mounts]
        self._key_stamps = state.stamps.tolist()
        for row in np.flatnonzero(self._views.arrays().is_there()).tolist():
            self._may_go.update(self._places.add(row, "", state.poses[row], None))
        self._path = KeyPath(state.path, state.information)
        self.closures, self.closure_weight = state.closures, state.weight.copy()
        self.epoch, self._next_number, self._looked_at = state.epoch, state.next_number, n

    def join(
        self, scan: Scan, map_from_base: Pose2, base_from_sensor: Pose2 = IDENTITY, odom: Pose2 | None = None, *,
        sensor: str = "",
    ) -> SlamUpdate | None:  # fmt: skip
        """Go on in a map that was taken up, the robot having been found there: this scan is its next key scan, tied to
        those around it by a closure. None, and nothing is changed, if it does not fit there.

        map_from_base: where it was found, to some decimetres.
        """
        view = self._view(scan, sensor)
        if view is None:
            return None
        guess = map_from_base @ base_from_sensor
        rows = nearest_keys(
            self._poses[: len(self._views)], guess, self.settings.near_m, self.settings.references,
            self._views.arrays().is_there(),
        )  # fmt: skip
        match = fitting_match(view, self._views.arrays(), rows, self._poses[rows], guess)
        if match is None:
            return None
        nearest = int(rows[0])
        start = self._key_pose(nearest)
        seen = floored(
            turned_information(match.information(), -start.yaw_rad),
            self.settings.closures.floor_m,
            self.settings.closures.floor_rad,
        )
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
        view = self._view(scan, sensor)
        guess = self._predicted(scan.stamp_ns, base_from_sensor, odom_from_base)
        if view is None:
            return self._told_only(scan.stamp_ns, guess.map_from_base, odom_from_base)
        if not len(self._views):
            self._keep(scan.stamp_ns, sensor, view, guess.map_from_sensor, base_from_sensor, odom_from_base, None)
            return self._told(scan.stamp_ns, guess.map_from_sensor, base_from_sensor, odom_from_base, None, True)
        match = self._matched(view, guess)
        pose = guess.map_from_sensor if match is None else match.pose
        is_key = self._is_new_ground(sensor, pose, patience=1.0 if match is not None else UNMATCHED_PATIENCE)
        if is_key:
            self._keep(scan.stamp_ns, sensor, view, pose, base_from_sensor, odom_from_base, match)
        return self._told(scan.stamp_ns, pose, base_from_sensor, odom_from_base, match, is_key)

    def _view(self, scan: Scan, sensor: str) -> View | None:
        """The sweep in its sensor's table; None if there is too little in it."""
        known = self._sensors.get(sensor)
        if known is None:
            try:
                known = _Sensor(table_for(scan.bearing_rad))
            except ValueError:
                self.events["scan_without_beams"] += 1
                return None
            self._sensors[sensor] = known
        view = view_of(scan, known.table, farthest_m=self.settings.farthest_m, grazed=True)
        if view.points < self.settings.least_points:
            self.events["scan_too_empty"] += 1
            return None
        return view

    def _predicted(self, stamp_ns: int, base_from_sensor: Pose2, odom_from_base: Pose2 | None) -> _Place:
        """Where the sensor should be: by odometry since the last scan, else by the motion so far."""
        if self._last is None:
            start = self._start or odom_from_base or IDENTITY
            return _Place(start @ base_from_sensor, start, 1.0, 1.0)
        last_ns, last_pose, last_odom = self._last
        if odom_from_base is not None and last_odom is not None:
            step = last_odom.inverse() @ odom_from_base
            sigma_m, sigma_rad = self._odometry_sigma(math.hypot(step.x_m, step.y_m), abs(step.yaw_rad))
            return _Place(last_pose @ step @ base_from_sensor, last_pose @ step, sigma_m, sigma_rad, step)
        seconds = min(max((stamp_ns - last_ns) * 1e-9, 0.0), 0.5)
        way = self._velocity * seconds
        sigma_m = 0.05 + 2.0 * seconds**2 + 0.3 * math.hypot(way[0], way[1])
        sigma_rad = math.radians(3.0) + 3.0 * seconds**2 + 0.3 * abs(float(way[2]))
        ahead = last_pose @ exp_se2(way)
        return _Place(ahead @ base_from_sensor, ahead, sigma_m, sigma_rad)

    def _odometry_sigma(self, way_m: float, turn_rad: float) -> tuple[float, float]:
        """Standard deviations of a step by odometry, as far as it is trusted by now."""
        s = self.settings
        sigma_m = s.odometry_m + s.odometry_share * way_m + s.odometry_m_per_rad * turn_rad
        sigma_rad = s.odometry_rad + s.odometry_turn_share * turn_rad + s.odometry_rad_per_m * way_m
        return sigma_m * self._trust.factor_m, sigma_rad * self._trust.factor_rad

    def _references(self, near: Pose2) -> I64:
        """The newest key scans that are not far away."""
        n = len(self._views)
        rows = np.arange(max(0, n - self.settings.references), n)
        distance = np.hypot(self._poses[rows, 0] - near.x_m, self._poses[rows, 1] - near.y_m)
        close = rows[distance < self.settings.near_m]
        return close if len(close) else rows[-1:]

    def _matched(self, view: View, guess: _Place) -> Match | None:
        """The view laid on the references by itself; where that is doubtful, the best of what else fits; None if
        nothing does. A prediction that pulled all the time would pull into its own errors, which are no noise."""
        rows = self._references(guess.map_from_sensor)
        store, poses = self._views.arrays(), self._poses[rows]
        match = free = match_view(view, store, rows, poses, guess.map_from_sensor, prior=0.01 * guess.information())
        if match is None or not self._is_plain(match, guess):
            self.events["looked_twice"] += 1
            match = self._best_of(view, rows, guess, match)
        if match is None:
            self.events["not_matched"] += 1
            self._lost_scans += 1
            return None
        self._lost_scans = 0
        self._learn(match, guess)
        self._learn_heading(match, guess, free)
        return match

    def _is_plain(self, match: Match, guess: _Place) -> bool:
        """Whether a match needs no second look: it is held in every direction, and it lies where it was expected."""
        return (
            match.share > LEAST_SHARE
            and match.mean_cost < 0.45
            and weakest_information(match.information()) > HELD_PER_M2
            and max(guess.deviations(match.pose)) < self.settings.gate
        )

    def _learn(self, match: Match, guess: _Place) -> None:
        """What a step that was matched well, by itself, says about odometry."""
        step = guess.step
        if step is None or weakest_information(match.information()) < HELD_PER_M2:
            return
        if math.hypot(step.x_m, step.y_m) > 0.01 or abs(step.yaw_rad) > math.radians(0.5):
            off_m, off_rad = guess.deviations(match.pose)
            self._trust.learn(off_m / math.sqrt(2.0), off_rad)

    def _learn_heading(self, match: Match, guess: _Place, free: Match | None) -> None:
        """What a scan says about odometry's turns. free: its match that nothing held."""
        if guess.step is None or free is None:
            return
        off_rad = wrap_angle(match.pose.yaw_rad - guess.map_from_sensor.yaw_rad)
        left_rad = wrap_angle(free.pose.yaw_rad - match.pose.yaw_rad)
        is_rough = free.mean_cost >= ROUGH_COST or free.share <= LEAST_SHARE
        self._heading.step(_along(guess.step), guess.step.yaw_rad, off_rad, left_rad, is_rough=is_rough)

    def _best_of(self, view: View, rows: I64, guess: _Place, match: Match | None) -> Match | None:
        """Of a free match, one that the prediction holds, and one searched for: what lies nearer to the prediction,
        unless another is clearly better."""
        store, poses = self._views.arrays(), self._poses[rows]
        doubt = 0.5 if match is None else min(match.mean_cost, 0.7)
        pull = guess.information() / (1.0 - doubt) ** 4  # leaves that move and crowds look like many points
        held = match_view(view, store, rows, poses, guess.map_from_sensor, prior=pull, reach=NEARBY)
        best = held
        if match is not None and (held is None or match.score > self._clearly(guess, match) * held.score):
            best = match
        fits = 0.0 if best is None else agreement(view, store, rows, poses, best.pose).explained
        if best is not None and self._is_hollow(best, guess):
            best, fits = self._turned_by_odometry(view, rows, guess, doubt, best, fits)
        if fits < 0.5:
            best, fits = self._looked_around(view, rows, guess, best, fits)
        return best if fits >= LEAST_FIT else None

    def _is_hollow(self, match: Match, guess: _Place) -> bool:
        """Whether a match may look good and be wrong: it lies on no planes, holds the pose badly, and odometry is known
        to turn more truly than such matches do."""
        is_held = match.mean_cost < ROUGH_COST or weakest_information(match.information()) > HELD_PER_M2
        return guess.step is not None and not is_held and self._heading.is_better

    def _turned_by_odometry(
        self, view: View, rows: I64, guess: _Place, doubt: float, best: Match, fits: float
    ) -> tuple[Match, float]:
        """A match whose heading odometry holds, as far as it was true where scans could tell; the one there is if that
        explains too little."""
        assert guess.step is not None
        along_m, turn_rad = _along(guess.step), guess.step.yaw_rad
        expected = guess.map_from_sensor @ Pose2(0.0, 0.0, self._heading.bias_rad(along_m, turn_rad))
        sigma_rad = max(LEAST_RAD, self._heading.sigma_rad(along_m, turn_rad))
        pull = replace(guess, sigma_rad=sigma_rad).information() / (1.0 - doubt) ** 4
        store, poses = self._views.arrays(), self._poses[rows]
        match = match_view(view, store, rows, poses, expected, prior=pull, reach=NEARBY)
        found = 0.0 if match is None else agreement(view, store, rows, poses, match.pose).explained
        if match is None or found < 0.5:
            return best, fits
        self.events["turned_by_odometry"] += 1
        return match, found

    def _clearly(self, guess: _Place, match: Match) -> float:
        """How much better than what the prediction holds a match must fit to be believed: the more, the farther it
        leads from a prediction that has been right so far."""
        beyond = max(0.0, max(guess.deviations(match.pose)) - self.settings.gate)
        return CLEARLY + CLEARLY_PER_DEVIATION * min(beyond, MOST_BEYOND)

    def _looked_around(
        self, view: View, rows: I64, guess: _Place, best: Match | None, fits: float
    ) -> tuple[Match | None, float]:
        """A place searched for within what the prediction may be off, if it explains more of the view."""
        self.events["looked_around"] += 1
        store, poses = self._views.arrays(), self._poses[rows]
        window_m = min(1.0 + 0.2 * self._lost_scans, 3.0, 0.3 + self.settings.gate * guess.sigma_m)
        turn_rad = min(math.radians(30.0), math.radians(2.0) + self.settings.gate * guess.sigma_rad)
        raster = raster_of(store, rows, poses)
        spot = find_view(view, raster, guess.map_from_sensor, window_m=window_m, turn_rad=turn_rad)
        if spot is None or spot.rival > 0.97:
            return best, fits
        other = match_view(view, store, rows, poses, spot.pose, reach=NEARBY)
        if other is None or (best is not None and other.score < self._clearly(guess, other) * best.score):
            return best, fits
        found = agreement(view, store, rows, poses, other.pose).explained
        return (other, found) if found > fits + 0.1 else (best, fits)

    def _is_new_ground(self, sensor: str, pose: Pose2, *, patience: float) -> bool:
        """Whether the sensor has moved enough since its last key scan for another one."""
        last = self._sensors[sensor].last_key
        if last < 0:
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
        self._sensors[sensor].last_key = key
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
            sigma_m, sigma_rad = self._odometry_sigma(way, turn)
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
        return np.diag([0.05**2, 0.05**2, math.radians(3.0) ** 2]) * (1 + self._lost_scans)

    def _told_only(self, stamp_ns: int, map_from_base: Pose2, odom: Pose2 | None) -> SlamUpdate:
        """A scan that nothing can be done with: the prediction stands for it."""
        if not len(self._views):
            self._last = (stamp_ns, map_from_base, odom)
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
        self._note_velocity(stamp_ns, map_from_base, matched=match is not None or is_key)
        self._last = (stamp_ns, map_from_base, odom)
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

    def _note_velocity(self, stamp_ns: int, map_from_base: Pose2, *, matched: bool) -> None:
        """Keep the motion of the base a second, in its own frame, for scans without odometry.

        Taken over at least VELOCITY_OVER_S, because stamps of single scans may be off by as much as a scan lasts.
        What was only predicted says nothing about motion; a robot that is lost is taken to stand.
        """
        if not matched:
            self._recent.clear()
            self._velocity = 0.5 * self._velocity
            return
        self._recent.append((stamp_ns, map_from_base))
        while len(self._recent) > 2 and (stamp_ns - self._recent[1][0]) * 1e-9 >= VELOCITY_OVER_S:
            self._recent.popleft()
        before_ns, before = self._recent[0]
        seconds = (stamp_ns - before_ns) * 1e-9
        if not VELOCITY_OVER_S <= seconds < 1.5:
            self._velocity = np.zeros(3)
            return
        step = before.inverse() @ map_from_base
        speed = log_se2(step) / seconds
        plausible = math.hypot(speed[0], speed[1]) < FASTEST_M_S and abs(speed[2]) < FASTEST_RAD_S
        self._velocity = speed if plausible else np.zeros(3)

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
        assert self._last is not None
        self._due_ns = self._last[0] + round(lag_s * 1e9)
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
            if self._last is not None:
                stamp, pose, odom = self._last
                self._last = (stamp, correction @ pose, odom)
            self._recent = deque(((t, correction @ p) for t, p in self._recent), maxlen=self._recent.maxlen)
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
            self._views.arrays(), self._poses[:n].copy(), self._travel[:n].copy(), self._path.edges(), self.closures,
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
        n, there = len(self._views), self._views.arrays().is_there()
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
        if self._last is not None and len(self._views) > 1:
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
        return None if self._last is None else self._last[1]

    def key_pose(self, key: int) -> Pose2:
        """Base pose of one key scan."""
        return self._key_pose(key) @ self._base_from_sensor[key].inverse()

    def step_covariance(self, step: Pose2) -> F64:
        """(3, 3) of a motion by odometry, as far as it is trusted by now."""
        sigma_m, sigma_rad = self._odometry_sigma(math.hypot(step.x_m, step.y_m), abs(step.yaw_rad))
        return np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])

    @property
    def lost_scans(self) -> int:
        """How many scans in a row fitted nothing."""
        return self._lost_scans

    def key_poses(self) -> F64:
        """(K, 3) base poses of key scans."""
        turned = {mount: mount.inverse() for mount in set(self._base_from_sensor)}
        inverses = np.array([_row(turned[mount]) for mount in self._base_from_sensor]).reshape(-1, 3)
        return composed_poses(self._poses[: len(self._views)], inverses)


def nearest_keys(poses: F64, near: Pose2, within_m: float, most: int, there: Bools) -> I64:
    """Key scans (K, 3) around a place, the nearest first, those seen from the same side before others; at least one.

    there: (K,) those whose views are still kept.
    """
    distance = np.where(there, np.hypot(poses[:, 0] - near.x_m, poses[:, 1] - near.y_m), np.inf)
    order = np.argsort(distance + 1.0 - np.cos(poses[:, 2] - near.yaw_rad), kind="stable")
    close = order[distance[order] < within_m][:most]
    return close if len(close) else order[:1]


def fitting_match(view: View, store: ViewArrays, rows: I64, poses: F64, guess: Pose2) -> Match | None:
    """The view laid on key scans from a rough guess; None unless it fits well enough to say where it was taken."""
    match = match_view(view, store, rows, poses, guess, reach=REFINING)
    if match is None or weakest_information(match.information()) < HELD_PER_M2:
        return None
    agrees = agreement(view, store, rows, poses, match.pose)
    fits = agrees.explained >= PLACED_EXPLAINED and agrees.overlap >= PLACED_OVERLAP
    off = guess.inverse() @ match.pose
    return match if fits and math.hypot(off.x_m, off.y_m) < 0.8 and abs(off.yaw_rad) < math.radians(10.0) else None


def run_here(slam: Slam, stamp_ns: int, result: WorkResult | None) -> WorkResult | None:
    """For one thread: apply the result that is due before a scan of this stamp; what is left to apply."""
    if slam.is_due(stamp_ns):
        assert result is not None
        slam.apply(result)
        return None
    return result


def _along(step: Pose2) -> float:
    """The way of a step, negative backwards."""
    return math.copysign(math.hypot(step.x_m, step.y_m), step.x_m)


def _row(pose: Pose2) -> F64:
    return np.array([pose.x_m, pose.y_m, pose.yaw_rad])
