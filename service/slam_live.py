"""SLAM as the daemon's localiser: every scan is laid on the last key scans at once, loops are closed beside.

    take_scan: what is due is taken up --> match --> kept for redrawing --> drawn by fusion
                   ^ by stamps alone         |
                   +-- closures, pose graph <+-- background (mapping.localise.slam says what it does)

The pose never waits: between scans it is odometry on top of the last correction. A scan is passed over while the robot
has not moved enough since the last one to say anything new: odometry tells, and what is seen must not tell otherwise.
Scans that fit nothing are not drawn, for they would wipe out walls. Which scans are matched, and when results are
taken up, depends on stamps, odometry and scans alone: a replay makes the same map, bit for bit.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mapping.deskew import beam_stamps, deskew
from mapping.frames import IDENTITY, Pose2, compose_covariance, exp_se2
from mapping.localise.closure_records import Closure, WorkResult
from mapping.localise.placing import LEFT_M, LEFT_QUALITY, LEFT_RAD, Placing
from mapping.localise.slam import Slam
from mapping.localise.slam_records import SlamSettings, SlamUpdate
from mapping.localise.sweep_change import Depths, depths_of, is_changed
from mapping.localise.views import table_for
from mapping.odometry import OdometryState
from mapping.pose_buffer import PoseBuffer
from mapping.scan import Scan
from service.background import Submit
from service.fusion import Located, Round, StoredTile, Touch, compose_many, located_by_odometry
from service.outputs import DocumentOut, Output
from service.redraw import Redrawer
from service.rpc import CallRefused
from service.slam_store import Keeper, Stored, stored_of

log = logging.getLogger(__name__)

F64 = NDArray[np.float64]

KEY = "map/graph"
MATCH_M = 0.05
MATCH_RAD = math.radians(2.0)
MATCH_NS = 250_000_000  # so often at least while it moves
STILL_M = 1e-3
STILL_RAD = 1e-3
MATCH_STILL_NS = 1_000_000_000
DOUBT_SCANS = 20  # in a row that fit nothing: then it is said
PLACING_NS = 500_000_000
PLACING_NS_PER_PLACE = 200_000_000  # several times what a look at one takes
SEARCH_NS = 5_000_000_000  # then it is looked for again
SEARCH_M = 1.0
CARRIED_M_S = 1.5  # by somebody who walks, or on its own wheels
CARRIED_M = 1.0
DRIVEN_M = 0.5  # by its own wheels it comes as far as at the fastest that it was seen to go, and a little more
DRIVEN_SHARE = 1.2
DRIVEN_M_S = 0.3
DRIVEN_RAD = 0.35
DRIVEN_RAD_S = 0.7  # less than it can: a place that fits only a robot that has turned round is most often another one
BRIDGED_S = 0.5  # so far ahead the motion is predicted where odometry is missing
STRAYED = 0.1  # of the way since, which odometry may be off
NOT_PLACED_COVARIANCE: F64 = np.diag([100.0, 100.0, 10.0])
_GRAPH_PERIOD_NS = 1_000_000_000
_KEYS_A_SECOND = 2_000  # larger graphs are sent more seldom


@dataclass(frozen=True, slots=True)
class _Search:
    """Looking for the robot in a stored map. odom: where it was when the scan was taken."""

    future: Future[tuple[Pose2, ...]]
    due_ns: int
    odom: Pose2


@dataclass(frozen=True, slots=True)
class _Lost:
    """left: where in the map the robot was seen last.  odom: where odometry went on, reach_m around there at most.
    ahead: how far the motion of then would have carried it; None: it stood, and may stand where it was left.
    turn_rad: how far it can have turned.
    """

    left: Pose2
    odom: Pose2
    reach_m: float
    ahead: Pose2 | None = None
    turn_rad: float = math.pi

    def can_have_come(self, map_from_base: Pose2, odom: Pose2, strayed_m: float) -> bool:
        """Whether a robot that is there now, odometry there, can have been lost here. strayed_m: odometry's error."""
        then = map_from_base @ (odom.inverse() @ self.odom)
        off = self.left.inverse() @ then
        return math.hypot(off.x_m, off.y_m) <= self.reach_m + strayed_m and abs(off.yaw_rad) <= self.turn_rad


@dataclass(slots=True)
class _Looked:
    """The newest scan of a laser that was laid on the map, or could not be.

    depths: what it saw, None where there was too little.  odom: the base then.
    """

    stamp_ns: int
    odom: Pose2
    depths: Depths | None


class SlamLocaliser:
    """See the module's docstring and fusion.Localiser."""

    def __init__(
        self,
        sources: Iterable[str],
        *,
        start: Pose2 = IDENTITY,
        submit: Submit,
        redrawer: Redrawer | None = None,
        settings: SlamSettings | None = None,
        stored: Stored | None = None,
        lost_when_broken: bool = False,
    ) -> None:
        """sources: lasers that are matched.  start: map_from_odom before the first scan.  submit: where closures are
        looked for.  redrawer: draws the map again after a correction.  stored: the map to go on in, where the robot is
        first looked for.  lost_when_broken: wherever odometry has lost track the robot is looked for again, as far
        around as it can have come meanwhile; else only after a gap that no prediction bridges.
        """
        self._sources = frozenset(sources)
        self._settings = settings
        self._slam = Slam(settings, keep_scans=False)
        self._submit = submit
        self._redrawer = redrawer
        self._work: Future[WorkResult] | None = None
        self._map_from_odom = start
        self._looked: dict[str, _Looked] = {}
        self._fits = True  # the newest scan that was looked at, or it made new ground
        self._update: SlamUpdate | None = None
        self._update_odom = IDENTITY
        self._is_broken = False
        self._lost_when_broken = lost_when_broken
        self._odometry: OdometryState | None = None
        self._way_m = 0.0  # since it was lost
        self._fastest_m_s = 0.0
        self._lost: _Lost | None = None
        self._search: _Search | None = None
        self._searched: tuple[int, Pose2] | None = None  # stamp and odometry of the last search
        self._searches = 0
        self._hypotheses: tuple[Pose2, tuple[Pose2, ...]] = (IDENTITY, ())  # odometry, and where the base may be then
        self._asked_to_undo: set[tuple[int, int]] = set()
        self._keeper = Keeper()
        self._told_ns: int | None = None
        self._told: tuple[int, int, int] | None = None
        self._counts = {
            "slam.scans": 0,
            "slam.scans_passed": 0,
            "slam.scans_unordered": 0,
            "slam.scans_elsewhere": 0,
            "slam.scans_not_drawn": 0,
            "slam.rounds_not_drawn": 0,
            "slam.work_errors": 0,
            "slam.closures_undone": 0,
        }
        if stored is not None:
            self._resume(stored)

    # --- what fusion asks

    def is_ready(self, stamp_ns: int) -> bool:
        late = self._slam.is_due(stamp_ns) and self._work is not None and not self._work.done()
        search = self._search
        late |= search is not None and stamp_ns >= search.due_ns and not search.future.done()
        return not late and (self._redrawer is None or self._redrawer.is_ready(stamp_ns))

    def take_odometry(self, state: OdometryState) -> None:
        self._is_broken |= state.broken
        before = self._odometry
        if before is not None and self._slam.keys:
            seconds = (state.stamp_ns - before.stamp_ns) * 1e-9
            if state.broken and (self._lost_when_broken or seconds > BRIDGED_S):
                if self._lost_when_broken:  # by its laser: somebody may have carried it off
                    self._unplace(state.odom_from_base, CARRIED_M + CARRIED_M_S * seconds)
                else:
                    reach_m = DRIVEN_M + max(DRIVEN_SHARE * self._fastest_m_s, DRIVEN_M_S) * seconds
                    turn_rad = DRIVEN_RAD + DRIVEN_RAD_S * seconds
                    self._unplace(state.odom_from_base, reach_m, _way_ahead(before, seconds), turn_rad)
            elif self._lost is not None:
                step = before.odom_from_base.inverse() @ state.odom_from_base
                self._way_m += math.hypot(step.x_m, step.y_m)
        self._odometry = state
        self._fastest_m_s = max(self._fastest_m_s, min(abs(state.forward_m_s), CARRIED_M_S))

    def _unplace(self, odom: Pose2, reach_m: float, ahead: Pose2 | None = None, turn_rad: float = math.pi) -> None:
        """Where the robot is in the map is not known any more: it is looked for, and nothing is drawn meanwhile.

        odom: where odometry goes on.  reach_m: how far it can have come unseen before.  ahead, turn_rad: see _Lost.
        """
        if self._lost is not None:  # once more before it was found
            way = self._lost.odom.inverse() @ odom
            reach_m += self._lost.reach_m + math.hypot(way.x_m, way.y_m)
            self._lost = _Lost(self._lost.left, odom, reach_m, self._lost.ahead or IDENTITY, math.pi)
        elif self.is_placed():  # in a stored map it may be anywhere
            self._lost, self._way_m = _Lost(self._map_from_odom @ odom, odom, reach_m, ahead, turn_rad), 0.0
        self._update, self._search, self._searched = None, None, None
        self._searches, self._hypotheses = 0, (IDENTITY, ())
        self._looked.clear()
        self._fits = True

    def take_scan(self, sensor: str, scan: Scan, odom_from_base: PoseBuffer, base_from_sensor: Pose2) -> bool:
        self._take_up(scan.stamp_ns)
        if sensor in self._sources:
            self._match_moving(sensor, scan, odom_from_base, base_from_sensor)
        if not self._fits:
            self._counts["slam.scans_not_drawn"] += 1
            return False
        if self._redrawer is not None and self._update is not None and self._slam.keys:
            key = self._slam.keys - 1
            ends = self._ends(scan, odom_from_base)
            self._redrawer.keep_sweep(sensor, scan, key, self._slam.key_pose(key), ends)
        return True

    def take_round(self, source: str, heard: Round | Touch, odom_from_base: Pose2) -> bool:
        if not self._fits and isinstance(heard, Round):  # a touch wipes nothing out
            self._counts["slam.rounds_not_drawn"] += 1
            return False
        if self._redrawer is not None and self._update is not None and self._slam.keys:
            key = self._slam.keys - 1
            pose = self._map_from_odom @ odom_from_base
            if isinstance(heard, Round):
                self._redrawer.keep_round(source, heard, key, self._slam.key_pose(key), pose)
            else:
                self._redrawer.keep_touch(source, heard, key, self._slam.key_pose(key), pose)
        return True

    def map_from_odom(self) -> Pose2:
        return self._map_from_odom

    def is_placed(self) -> bool:
        return self._update is not None or not self._slam.keys

    def locate(self, state: OdometryState) -> Located:
        if not self.is_placed():
            pose = self._map_from_odom @ state.odom_from_base
            return Located(state.stamp_ns, pose, self._map_from_odom, NOT_PLACED_COVARIANCE)
        if self._update is None:
            return located_by_odometry(self._map_from_odom, state)
        step = self._update_odom.inverse() @ state.odom_from_base
        covariance = compose_covariance(
            self._map_from_odom @ self._update_odom, self._update.covariance, step, self._slam.step_covariance(step)
        )
        map_from_base = self._map_from_odom @ state.odom_from_base
        return Located(state.stamp_ns, map_from_base, self._map_from_odom, covariance)

    def map_was_replaced(self, tiles: Iterable[StoredTile], slam: Iterable[StoredTile]) -> None:
        """Key scans belong to the map that is gone; those of the new one are taken up, if it has any."""
        self._slam = Slam(self._settings, keep_scans=False)
        self._work, self._update, self._told, self._search, self._searched = None, None, None, None, None
        self._keeper, self._searches, self._hypotheses = Keeper(), 0, (IDENTITY, ())
        self._lost = None
        self._looked.clear()
        self._fits = True
        self._asked_to_undo.clear()
        if self._redrawer is not None:
            self._redrawer.start_over(tiles)
        stored = stored_or_none(slam)
        if stored is not None:
            self._resume(stored)

    def begin_map(self, map_from_odom: Pose2) -> None:
        self.map_was_replaced((), ())
        self._map_from_odom = map_from_odom

    def kept(self) -> Callable[[], list[StoredTile]] | None:
        if self._redrawer is None or not self._slam.keys:
            return None
        return partial(self._keeper.changed_tiles, Stored(self._slam.state(), self._redrawer.state()))

    def _resume(self, stored: Stored) -> None:
        self._slam.resume(stored.slam)
        if self._redrawer is not None:
            self._redrawer.resume(stored.redraw)

    def outputs(self, now_ns: int) -> list[Output]:
        state = (self._slam.keys, self._slam.epoch, len(self._slam.closures))
        if self._update is None or state == self._told:
            return []
        period_ns = max(_GRAPH_PERIOD_NS, self._slam.keys * _GRAPH_PERIOD_NS // _KEYS_A_SECOND)
        if self._told_ns is not None and now_ns - self._told_ns < period_ns:
            return []
        self._told, self._told_ns = state, now_ns
        return [DocumentOut(KEY, self._update.stamp_ns, graph_fields(self._slam))]

    def troubles(self) -> list[str]:
        if not self.is_placed() and self._searches:
            return [
                f"the robot does not find itself in the map ({self._searches} searches): nothing is drawn "
                "meanwhile; drive it to where the map is known, or begin a new one (`umfeld map new`)"
            ]
        if self._slam.lost_scans < DOUBT_SCANS:
            return []
        return [
            f"{self._slam.lost_scans} scans in a row fit nothing seen before: the pose is odometry's and "
            "nothing is drawn meanwhile; is the laser blinded, tilted or its mount in [lasers] wrong?"
        ]

    def counters(self) -> Mapping[str, int]:
        slam = self._slam
        return {
            **self._counts,
            "slam.key_scans": slam.keys,
            "slam.closures": len(slam.closures),
            "slam.corrections": slam.epoch,
            **({} if self._redrawer is None else {**self._redrawer.counts, "map.kept_sweeps": self._redrawer.kept}),
        }

    @property
    def slam(self) -> Slam:
        """What it knows; not to be changed."""
        return self._slam

    # --- matching

    def _match_moving(self, sensor: str, scan: Scan, odom_from_base: PoseBuffer, base_from_sensor: Pose2) -> None:
        stamps = beam_stamps(scan)
        odom = odom_from_base.at(int(stamps[len(stamps) // 2]))
        if self._says_nothing_new(sensor, scan.stamp_ns, odom):
            if not self._looks_elsewhere(sensor, scan, odom_from_base, base_from_sensor):
                self._counts["slam.scans_passed"] += 1
                return
            self._counts["slam.scans_elsewhere"] += 1
        swept = replace(deskew(scan, odom_from_base, base_from_sensor).scan, stamp_ns=scan.stamp_ns)
        if self._match(sensor, swept, base_from_sensor, odom):
            self._looked[sensor] = _Looked(scan.stamp_ns, odom, _depths_or_none(swept, self._looked.get(sensor)))

    def _says_nothing_new(self, sensor: str, stamp_ns: int, odom: Pose2) -> bool:
        """Whether odometry says that the robot is where the last scan was laid on the map."""
        if sensor not in self._looked or self._is_broken:
            return False
        looked = self._looked[sensor]
        step = looked.odom.inverse() @ odom
        way, turn, waited_ns = math.hypot(step.x_m, step.y_m), abs(step.yaw_rad), stamp_ns - looked.stamp_ns
        if way < STILL_M and turn < STILL_RAD:
            return waited_ns < MATCH_STILL_NS
        return way < MATCH_M and turn < MATCH_RAD and waited_ns < MATCH_NS

    def _looks_elsewhere(self, sensor: str, scan: Scan, odom_from_base: PoseBuffer, base_from_sensor: Pose2) -> bool:
        """Whether a scan shows that odometry is wrong since the last match."""
        looked = self._looked[sensor]
        if looked.depths is None:
            return False
        sensor_from_odom = (looked.odom @ base_from_sensor).inverse()
        seen_from_base = compose_many(sensor_from_odom, odom_from_base.at_many(beam_stamps(scan)))
        return is_changed(scan, looked.depths, seen_from_base, base_from_sensor)

    def _match(self, sensor: str, scan: Scan, base_from_sensor: Pose2, odom: Pose2) -> bool:
        if not self.is_placed():
            return self._look_for_place(sensor, scan, base_from_sensor, odom)
        if self._update is not None and scan.stamp_ns <= self._update.stamp_ns:
            self._counts["slam.scans_unordered"] += 1  # sweeps of two lasers that overlap
            return False
        if self._update is None:
            self._slam.begin_at(self._map_from_odom @ odom)
        seen_odom = None if self._is_broken else odom
        self._take_update(self._slam.add_scan(scan, base_from_sensor, seen_odom, sensor=sensor), odom)
        self._is_broken = False
        self._begin_work()
        return True

    def _begin_work(self) -> None:
        work = self._slam.take_work()
        if work is not None:
            self._work = self._submit(work.run)

    def _take_update(self, update: SlamUpdate, odom: Pose2) -> None:
        self._update, self._update_odom = update, odom
        self._map_from_odom = update.map_from_base @ self._update_odom.inverse()
        self._counts["slam.scans"] += 1
        self._fits = update.is_key or self._slam.lost_scans == 0

    def _ends(self, scan: Scan, odom_from_base: PoseBuffer) -> F64:
        """(2, 3) base poses in the map at the first and the last beam."""
        stamps = beam_stamps(scan)
        return compose_many(self._map_from_odom, odom_from_base.at_many(stamps[[0, -1]]))

    # --- finding the place in a stored map

    def _look_for_place(self, sensor: str, scan: Scan, base_from_sensor: Pose2, at: Pose2) -> bool:
        """Nothing is drawn before this has found the robot; it may drive meanwhile. Places that look alike go along
        with odometry until one is left."""
        if self._slam.is_working:
            return False
        search = self._search
        if search is not None:
            if scan.stamp_ns < search.due_ns:
                return False
            self._search = None
            now = [base @ (search.odom.inverse() @ at) for base in search.future.result()]
            self._hypotheses = (at, tuple(base for base in now if self._is_within_reach(base, at)))
            if len(self._hypotheses[1]) == 1 and self._join(sensor, scan, base_from_sensor, at, self._hypotheses[1][0]):
                return True
        if self._searched is not None:
            before_ns, before = self._searched
            way = before.inverse() @ at
            if scan.stamp_ns - before_ns < SEARCH_NS and math.hypot(way.x_m, way.y_m) < SEARCH_M:
                return False
        placing = self._placing(scan, base_from_sensor, at)
        if not self._searches and (self._lost is None or self._lost.ahead is None):
            left = placing.left_at(self._map_from_odom @ at @ base_from_sensor)
            base = None if left is None else left.pose @ base_from_sensor.inverse()
            if base is not None and self._join(sensor, scan, base_from_sensor, at, base):
                return True
        self._begin_search(placing, base_from_sensor, at)
        return False

    def _is_within_reach(self, map_from_base: Pose2, at: Pose2) -> bool:
        """Whether a robot that is there now can have come there from where it was lost."""
        return self._lost is None or self._lost.can_have_come(map_from_base, at, STRAYED * self._way_m)

    def _placing(self, scan: Scan, base_from_sensor: Pose2, at: Pose2) -> Placing:
        state = self._slam.state()
        told_at, bases = self._hypotheses
        among = tuple(base @ (told_at.inverse() @ at) @ base_from_sensor for base in bases) if len(bases) > 1 else ()
        anywhere = Placing(state.views, state.poses, scan, among, self._slam.settings.farthest_m)
        lost, strayed_m = self._lost, STRAYED * self._way_m
        if lost is None:
            return anywhere
        way = lost.odom.inverse() @ at
        ahead = (IDENTITY,) if lost.ahead is None else (IDENTITY, lost.ahead)
        to_sensor_m = math.hypot(base_from_sensor.x_m, base_from_sensor.y_m)
        radius_m = lost.reach_m + strayed_m + math.hypot(way.x_m, way.y_m) + to_sensor_m
        return replace(
            anywhere,
            may_be=lambda pose: lost.can_have_come(pose @ base_from_sensor.inverse(), at, strayed_m),
            near=(lost.left.x_m, lost.left.y_m, radius_m),
            guesses=tuple(lost.left @ each @ way @ base_from_sensor for each in ahead),
            least=LEFT_QUALITY,
        )

    def _begin_search(self, placing: Placing, base_from_sensor: Pose2, at: Pose2) -> None:
        def work() -> tuple[Pose2, ...]:
            return tuple(place.pose @ base_from_sensor.inverse() for place in placing.run())

        self._searches += 1
        stamp_ns = placing.scan.stamp_ns
        self._searched = (stamp_ns, at)
        due_ns = stamp_ns + PLACING_NS + PLACING_NS_PER_PLACE * placing.cost
        self._search = _Search(self._submit(work), due_ns, at)

    def _join(self, sensor: str, scan: Scan, base_from_sensor: Pose2, odom: Pose2, map_from_base: Pose2) -> bool:
        update = self._slam.join(scan, map_from_base, base_from_sensor, odom, sensor=sensor)
        if update is None:
            return False
        self._take_update(update, odom)
        self._is_broken, self._lost = False, None
        pose = update.map_from_base
        log.info("found itself in the map at x %.2f m y %.2f m", pose.x_m, pose.y_m)
        if self._redrawer is not None:
            self._redrawer.forget_recent()
        return True

    # --- corrections

    def _take_up(self, stamp_ns: int) -> None:
        """Results that are due."""
        if self._redrawer is not None and self._redrawer.is_due(stamp_ns):
            self._redrawer.take_up(stamp_ns, self._slam.key_poses())
        if not self._slam.is_due(stamp_ns) or self._work is None:
            return
        epoch = self._slam.epoch
        try:
            self._slam.apply(self._work.result())
        except Exception:  # the map is as good as it was; later key scans get their chance
            self._counts["slam.work_errors"] += 1
            log.exception("internal error while looking for loops; these key scans stay without")
            self._slam.abandon()
        self._work = None
        self._undo_asked()
        last = self._slam.last_pose
        if last is not None:
            self._map_from_odom = last @ self._update_odom.inverse()
        if self._redrawer is not None and self._slam.epoch != epoch:
            self._redrawer.corrected(stamp_ns, self._slam.key_poses())

    # --- undoing, on the fusion thread

    def closures_told(self) -> Mapping[str, object]:
        """The answer of `@rpc/list_closures`."""
        return closure_fields(self._slam)

    def undo(self, arguments: Mapping[str, Any]) -> Mapping[str, object]:
        """The answer of `@rpc/undo_closure`: what is forgotten, at once or as soon as the work under way, which knows
        it, has been taken up. The graph then settles as after any work, and the map is drawn again where it moved."""
        chosen = _chosen(arguments, [*self._slam.closures, *self._slam.pending])
        told = [
            each
            for name in ("closures", "on_probation")
            for each in cast(list[dict[str, Any]], closure_fields(self._slam)[name])
            if (each["from"], each["to"]) in chosen
        ]
        self._asked_to_undo |= chosen
        if not self._slam.is_working:
            self._undo_asked()
        left = sum((each.start, each.to) not in chosen for each in self._slam.closures)
        return {"undone": told, "closures": left, "epoch": self._slam.epoch}

    def _undo_asked(self) -> None:
        if self._asked_to_undo:
            undone = self._slam.undo_between(self._asked_to_undo)
            self._asked_to_undo.clear()
            self._counts["slam.closures_undone"] += undone
            if undone:
                self._slam.settle()
                self._begin_work()


def _way_ahead(state: OdometryState, seconds: float) -> Pose2 | None:
    """How far a robot comes that goes on like this; None if that is where it stands."""
    if abs(state.forward_m_s) * seconds <= LEFT_M and abs(state.yaw_rad_s) * seconds <= LEFT_RAD:
        return None
    return exp_se2((state.forward_m_s * seconds, 0.0, state.yaw_rad_s * seconds))


def _depths_or_none(swept: Scan, before: _Looked | None) -> Depths | None:
    """What a scan saw, in the bins of the one before where there are any."""
    if before is not None and before.depths is not None:
        return depths_of(swept, before.depths.table)
    try:
        return depths_of(swept, table_for(swept.bearing_rad))
    except ValueError:
        return None


def _chosen(arguments: Mapping[str, Any], closures: Sequence[Closure]) -> set[tuple[int, int]]:
    """Pairs of key scans whose closures are meant; CallRefused says what is wrong with the arguments."""
    near = arguments.get("near", 0)
    unknown = arguments.keys() - {"number", "first", "second", "near"}
    by_number = set(arguments) - {"near"} == {"number"}
    by_pair = set(arguments) - {"near"} == {"first", "second"}
    values = [near, *(arguments[name] for name in arguments.keys() & {"number", "first", "second"})]
    if unknown or by_number == by_pair or not all(type(value) is int and value >= 0 for value in values):
        raise CallRefused('write {"number": 7}, or {"first": 12, "second": 180}; "near": 10 may be added')
    if by_number:
        meant = [c for c in closures if c.number == arguments["number"]]
    else:
        ends = {arguments["first"], arguments["second"]}
        meant = [c for c in closures if {c.start, c.to} == ends]
    if not meant:
        raise CallRefused("there is no such closure; list_closures tells those there are")
    return {
        (c.start, c.to)
        for c in closures
        if any(abs(c.start - m.start) <= near and abs(c.to - m.to) <= near for m in meant)
    }


def stored_or_none(tiles: Iterable[StoredTile]) -> Stored | None:
    """What the layer `slam` of a map holds; damaged, it is left out, and said."""
    try:
        return stored_of(tiles)
    except ValueError as error:
        log.error("the map goes on without its key scans, where it was left: %s", error)
        return None


def graph_fields(slam: Slam) -> dict[str, object]:
    """The document umfeld.graph.v1 but for its schema and stamp: where the robot came along, and which places it saw
    again. Metres and radians, rounded to a millimetre and a milliradian."""
    keys = [[round(float(v), 3) + 0.0 for v in pose] for pose in slam.key_poses()]
    return {"frame": "map", "epoch": slam.epoch, "keys": keys, "closures": _accepted(slam)}


def closure_fields(slam: Slam) -> dict[str, object]:
    """Closures as in graph_fields, each with how far its key scans stand from where it wants them; and those on
    probation, which pull at nothing yet."""
    poses = slam.snapshot().poses
    accepted = [{**told, **_misfit(each, poses)} for told, each in zip(_accepted(slam), slam.closures)]
    waiting = [{"from": c.start, "to": c.to, "votes": c.worth, **_misfit(c, poses)} for c in slam.pending]
    return {"epoch": slam.epoch, "closures": accepted, "on_probation": waiting}


def _accepted(slam: Slam) -> list[dict[str, object]]:
    return [
        {
            "number": closure.number,
            "from": closure.start,
            "to": closure.to,
            "weight": round(float(weight), 3),
            "found": "searched" if closure.searched else "tracked",
        }
        for closure, weight in zip(slam.closures, slam.closure_weight)
    ]


def _misfit(closure: Closure, poses: F64) -> dict[str, float]:
    """poses: (K, 3) of the sensor at key scans."""
    start, to = (Pose2(*poses[key].tolist()) for key in (closure.start, closure.to))
    off = closure.measured.inverse() @ (start.inverse() @ to)
    return {"off_m": round(math.hypot(off.x_m, off.y_m), 3), "off_deg": round(math.degrees(abs(off.yaw_rad)), 2)}
