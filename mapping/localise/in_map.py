"""Where a robot is in a known map: from no idea to a tracked pose, how sure it is, and when it is lost.

Many places are followed at once. Each is a pose with a covariance; every scan moves it by odometry and lays it on the
map's walls; every key scan (so much way, turn or time) is evidence for or against it: what its beams met, and what
they passed through. Evidence is kept for the last `window` key scans and counts less the older it is. New places
come from a search of the whole map with the last key scans joined by odometry, again and again: often while the place
is not sure, now and then while it is, so that a belief never goes unchallenged. A place that a search proposes is led
back through the window, so that old and new places are judged by the same scans.

How probable it is that the first place is right follows from its lead over others and from how well scans fit it
(`confidence`), fitted on recorded logs.
From settings.sure on it is "sure", until it falls below settings.unsure or has not reached settings.stays
for grace_s; what was believed and is not any more is "lost"; before, it is "searching".

Threads: none of ours. As with SLAM, a search is handed out as a piece of work that may run anywhere and whose result
is applied at a moment that stamps alone decide:

    if localiser.is_due(stamp_ns):
        localiser.apply(pending.result())
    located = localiser.add_scan(stamp_ns, points, odom_from_base)
    work = localiser.take_work()
    if work is not None:
        pending = pool.submit(work.run)

The map is read only: there is no way from here to change a cell of it.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angles
from mapping.localise.confidence import Evidence, probability
from mapping.localise.known_map import Fits, KnownMap, Points, apart, find_places, hold, lay, pose_of, thinned

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

SAME_M = 0.3
SAME_RAD = math.radians(8.0)
RIVAL_M = 0.6  # a place so far off is another place, not a finer or coarser word for the same
RIVAL_RAD = math.radians(15.0)
CARRIED_FOR = 2  # key scans at least since the robot was carried away
TURNED_RAD = math.radians(6.0)
CLEARLY = 0.1  # so much more of a scan matches
STOOD = 3
FIRST = 8  # places that may have lost their heading in a turn


@dataclass(frozen=True, slots=True)
class InMapSettings:
    """Defaults for every robot and building.

    key_*: a key scan so often.  window, forget: key scans that count, and what a key scan counts against the next.
    beams_as_one, beams_as_witness: so many beams of a scan say as much as one that is independent, of where exactly a
    place is and of which place is right.  most_per_key: no scan says more (log) against a place.  places: followed at
    most.  margin: so much less likely than the best (log) and a place is given up.  carried: log odds of not having
    been carried away, see `_Crowd.weight`; also what a new place must make good against one that is sure.  doubted: the
    same against one that was sure until it was lost.
    search_*: from one search to the next while not sure, and while sure.  joined_m: way over which key scans are joined
    for a search.  point_sigma_m, floor_*: see `_corrected`.  odometry_*: standard deviations of a step.  sure, stays,
    grace_s, unsure: see the module.
    """

    key_m: float = 0.2
    key_rad: float = math.radians(8.0)
    key_s: float = 0.5
    window: int = 64
    forget: float = 0.98
    beams_as_one: float = 14.0
    beams_as_witness: float = 30.0
    most_per_key: float = 4.0
    places: int = 40
    margin: float = 16.0
    carried: float = 10.0
    doubted: float = 3.0
    search_s: float = 1.0
    search_sure_s: float = 4.0
    lag_s: float = 0.4
    lag_s_per_m2: float = 0.0005
    joined_m: float = 4.0
    point_sigma_m: float = 0.05
    floor_m: float = 0.02
    floor_rad: float = math.radians(0.3)
    odometry_m: float = 0.005
    odometry_share: float = 0.08
    odometry_m_per_rad: float = 0.05
    odometry_rad: float = math.radians(0.3)
    odometry_turn_share: float = 0.08
    odometry_rad_per_m: float = math.radians(2.0)
    least_points: int = 12
    sure: float = 0.97
    stays: float = 0.95
    grace_s: float = 2.0
    unsure: float = 0.7
    search_points: int = 120


class State(StrEnum):
    """What the localiser says of itself."""

    LOST = "lost"
    SEARCHING = "searching"
    SURE = "sure"


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place the robot may be at. share: of the belief in all places followed; explained, through: shares of the last
    beams that end on a wall of the map, and that went through one."""

    pose: Pose2
    share: float
    explained: float
    through: float


@dataclass(frozen=True, slots=True)
class Located:
    """What is known at one scan.

    map_from_base: the best place, None before there is one.  covariance: (3, 3) of it, if it is the right place.
    probability: that it is right (0.5 m, 10 degrees).  candidates: the best first.
    """

    stamp_ns: int
    state: State
    probability: float
    map_from_base: Pose2 | None
    covariance: F64
    candidates: tuple[Candidate, ...]
    evidence: Evidence


@dataclass(frozen=True, slots=True)
class _Key:
    """A scan that is kept in the window."""

    number: int
    stamp_ns: int
    points: Points
    odom_from_base: Pose2


@dataclass(frozen=True, slots=True)
class _Crowd:
    """Places, one a row: poses (K, 3), covariance (K, 3, 3), log prior (K,); of the window's key scans, the newest
    first: log evidence (K, W), shares of beams explained, through and unexpected (K, W)."""

    poses: F64
    covariance: F64
    prior: F64
    log: F64
    explained: F64
    through: F64
    unexpected: F64

    def __len__(self) -> int:
        return len(self.poses)

    def rows(self, rows: I64) -> _Crowd:
        return _Crowd(
            self.poses[rows], self.covariance[rows], self.prior[rows], self.log[rows],
            self.explained[rows], self.through[rows], self.unexpected[rows],
        )  # fmt: skip

    def and_(self, other: _Crowd) -> _Crowd:
        return _Crowd(*(np.concatenate(pair) for pair in zip(self.columns(), other.columns())))

    def columns(self) -> tuple[F64, ...]:
        return (self.poses, self.covariance, self.prior, *self.seen())

    def seen(self) -> tuple[F64, F64, F64, F64]:
        return (self.log, self.explained, self.through, self.unexpected)

    def weight(self, s: InMapSettings, then: F64 | None = None) -> F64:
        """(K,) log of how likely each is, but for a constant; see `weighed`."""
        return self.weighed(s, then)[0]

    def weighed(self, s: InMapSettings, then: F64 | None = None) -> tuple[F64, I64]:
        """(K,) log of how likely each is, but for a constant, and (K,) how many key scans, the newest, it rests on.

        Either the robot was there all the time, or it was carried there: then the older key scans were made where they
        fit best, and being carried must be made good by the newer ones. It may be carried anywhere, so that each of so
        many places has its share only of the chance.
        then: (W,) log evidence of each key scan for the place that was sure when it was taken, NaN where none was.
        That place may have been given up since: what it explained is explained, and no place that is followed now
        need account for it.
        """
        if not len(self):
            return self.prior, np.zeros(0, dtype=np.int64)
        log, prior, best = self.log, self.prior, self.log.max(axis=0)
        if then is not None:
            log = np.concatenate((log, np.where(np.isnan(then), best - s.most_per_key, then)[None]))
            prior, best = np.append(prior, 0.0), log.max(axis=0)
        bounded = np.maximum(log, best - s.most_per_key) * s.forget ** np.arange(s.window)
        whole = prior + bounded.sum(axis=1)
        newer = np.cumsum(bounded, axis=1)
        elsewhere = (whole[:, None] - newer).max(axis=0)  # older key scans, seen from the place that explains them best
        carried = (newer + elsewhere)[: len(self), CARRIED_FOR - 1 :] - s.carried - math.log(s.places)
        since, whole = carried.argmax(axis=1), whole[: len(self)]
        best_carried = carried.max(axis=1)
        own = np.where(whole >= best_carried, s.window, since + CARRIED_FOR)
        return np.asarray(np.maximum(whole, best_carried)), np.asarray(own)


def _crowd_at(poses: F64, covariance: F64, window: int) -> _Crowd:
    """Places of which nothing has been seen yet; covariance (3, 3) of each."""
    k = len(poses)
    blank = np.zeros((k, window))
    return _Crowd(poses, np.repeat(covariance[None], k, axis=0), np.zeros(k), blank, blank, blank, blank)


class SearchIsDueError(RuntimeError):
    """A scan was added before the result that is due had been applied."""


@dataclass(frozen=True, slots=True)
class Search:
    """A piece of work: look through the whole map, or near a hint. run() may be called in any thread."""

    number: int
    known: KnownMap
    settings: InMapSettings
    keys: tuple[_Key, ...]  # the newest first
    joined: int  # so many of them are searched by; all of them judge what was found
    near: tuple[Pose2, float] | None
    then: F64  # see `_Crowd.weight`

    def run(self) -> SearchResult:
        """Places at the newest key scan, with the evidence of all of them."""
        s, newest = self.settings, self.keys[0]
        found = find_places(self.known, _joined(self.keys[: self.joined], s), near=self.near)
        if not len(found.poses):
            return SearchResult(self.number, newest.number, _crowd_at(np.zeros((0, 3)), _anywhere(), s.window))
        stride = 2 if len(newest.points) >= 60 else 1
        fits = lay(self.known, newest.points, found.poses, stride=stride)
        close = _near_guess(fits, found.poses)
        poses = np.where(close[:, None], fits.poses, found.poses)
        order = np.argsort(-hold(self.known, newest.points, poses, stride=stride).log, kind="stable")[: s.places]
        return SearchResult(self.number, newest.number, _led_back(self.known, s, self.keys, poses[order]))

    def candidates(self, most: int = 8) -> tuple[Candidate, ...]:
        """What run() finds, for people: the best first."""
        crowd = _ranked(self.run().crowd, self.settings, self.then)
        return _told(crowd, crowd.weight(self.settings, self.then), most)


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Places that a search found, at key scan `key`."""

    number: int
    key: int
    crowd: _Crowd


class MapLocaliser:
    """See the module's text."""

    def __init__(
        self, known: KnownMap, settings: InMapSettings | None = None, *, start: Pose2 | None = None,
        start_sigma_m: float = 0.5,
    ) -> None:  # fmt: skip
        """start: where the robot should be, to be confirmed by its scans before it is believed."""
        self.known = known
        self.settings = settings if settings is not None else InMapSettings()
        self.state = State.SEARCHING
        self.events: Counter[str] = Counter()
        self._crowd = _crowd_at(np.zeros((0, 3)), _anywhere(), self.settings.window)
        self._keys: deque[_Key] = deque(maxlen=self.settings.window)  # the newest first
        self._then: F64 = np.full(self.settings.window, math.nan)  # what each meant to the place that was sure then
        self._last_odom: Pose2 | None = None
        self._last_ns: int | None = None
        self._anchor: Pose2 | None = None  # odometry at the last key scan that was taken for way or turn
        self._stood = 0  # key scans that took the place of the last one: the newest stands for them too
        self._next_key = 0
        self._next_search = 0
        self._outstanding: Search | None = None
        self._handed_out = True
        self._due_ns = 0
        self._searched_ns: int | None = None
        self._challenged = False  # whether a search has been applied since the places were last doubted
        self._doubted: int | None = None  # the key scan at which a place that was sure became lost
        self._hint: tuple[Pose2, float] | None = None
        self._probability = 0.0
        self._sure_ns = 0  # when the probability last reached settings.stays
        self._evidence = Evidence()
        if start is not None:
            self._begin_at(start, start_sigma_m)

    def _begin_at(self, start: Pose2, sigma_m: float) -> None:
        turn_sigma = 0.5 * min(1.0, sigma_m)
        self._crowd = _crowd_at(
            np.array([[start.x_m, start.y_m, start.yaw_rad]]),
            np.diag([sigma_m**2, sigma_m**2, turn_sigma**2]),
            self.settings.window,
        )

    # --- what is asked of it

    def relocalise(self, hint: Pose2 | None = None, *, radius_m: float = 3.0) -> None:
        """Forget every place and search anew: the whole map, or first within radius_m of a hint."""
        self._throw_away()
        self.state = State.SEARCHING
        self._hint = None if hint is None else (hint, radius_m)
        self.events["asked_to_relocalise"] += 1

    def located(self, stamp_ns: int) -> Located:
        """What is known now."""
        s, crowd = self.settings, self._crowd
        if not len(crowd):
            return Located(stamp_ns, self.state, 0.0, None, _anywhere(), (), self._evidence)
        candidates = _told(crowd, crowd.weight(s, self._then), 8)
        told = crowd.covariance[0] + np.diag([s.floor_m**2, s.floor_m**2, s.floor_rad**2])
        return Located(
            stamp_ns, self.state, self._probability, candidates[0].pose, told, candidates, self._evidence
        )  # fmt: skip

    # --- scans

    def add_scan(self, stamp_ns: int, points: Points, odom_from_base: Pose2 | None = None) -> Located:
        """Take a sweep's points (`known_map.points_of`), in order of stamps.

        odom_from_base: odometry at that time; None where there is none: the robot is then taken to stand about still.
        Raises SearchIsDueError if `is_due(stamp_ns)` and the result was not applied.
        """
        if self.is_due(stamp_ns):
            raise SearchIsDueError("apply the result of the search that was taken before adding this scan")
        odom = odom_from_base if odom_from_base is not None else (self._last_odom or Pose2())
        seconds = 0.0 if self._last_ns is None else max(0.0, (stamp_ns - self._last_ns) * 1e-9)
        step = Pose2() if self._last_odom is None else self._last_odom.inverse() @ odom
        blind_s = seconds if odom_from_base is None else 0.0
        self._crowd = _moved(self._crowd, step, self.settings, blind_s=blind_s)
        self._last_odom, self._last_ns = odom, stamp_ns
        if len(points) < self.settings.least_points:
            self.events["scan_too_empty"] += 1
            return self.located(stamp_ns)
        why = self._key_because(stamp_ns, odom)
        if why is None:
            self._follow_first(points)
        else:
            self._take_key(_Key(self._next_key, stamp_ns, points, odom), instead=why == "time")
        self._maybe_search(stamp_ns)
        return self.located(stamp_ns)

    def _key_because(self, stamp_ns: int, odom: Pose2) -> str | None:
        if not self._keys or self._anchor is None:
            return "first"
        s, last = self.settings, self._keys[0]
        step = self._anchor.inverse() @ odom
        if math.hypot(step.x_m, step.y_m) >= s.key_m or abs(step.yaw_rad) >= s.key_rad:
            return "way"
        return "time" if stamp_ns - last.stamp_ns >= s.key_s * 1e9 else None

    def _follow_first(self, points: Points) -> None:
        """Between key scans only the best place is laid on the map."""
        if len(self._crowd):
            first = _corrected(self.known, points, self._crowd.rows(np.array([0])), self.settings, turned=1)
            rest = self._crowd.rows(np.arange(1, len(self._crowd)))
            self._crowd = first.and_(rest)

    def _take_key(self, key: _Key, *, instead: bool) -> None:
        """A key scan as evidence; instead: the robot has hardly moved, so it takes the last one's place."""
        self._next_key += 1
        if instead:
            self._keys.popleft()
            self._stood = min(self._stood + 1, STOOD)
        else:
            self._anchor, self._stood = key.odom_from_base, 0
        self._keys.appendleft(key)
        if not instead:
            self._then = np.concatenate(([math.nan], self._then[:-1]))
        if len(self._crowd):
            crowd = _corrected(self.known, key.points, self._crowd, self.settings, turned=FIRST)
            crowd = _with_evidence(self.known, key.points, crowd, self.settings, instead=instead)
            if self.state is State.SURE:
                self._then = np.concatenate((crowd.log[:1, 0], self._then[1:]))
            self._crowd = _ranked(crowd, self.settings, self._then)
        self._judge_state()

    def _judge_state(self) -> None:
        s = self.settings
        self._evidence = self._weigh()
        self._probability = probability(self._evidence)
        before, now_ns = self.state, self._last_ns if self._last_ns is not None else 0
        if self._probability >= (s.stays if before is State.SURE else s.sure):
            self.state = State.SURE
            self._doubted = None
            self._sure_ns = now_ns
        elif before is State.SURE and (self._probability < s.unsure or now_ns - self._sure_ns >= s.grace_s * 1e9):
            self.state = State.LOST
            self.events["lost"] += 1
            self._look_anew()
        if self.state is not before:
            self.events[f"became_{self.state.value}"] += 1

    def _weigh(self) -> Evidence:
        """What there is to judge the first place by."""
        crowd = self._crowd
        if not len(crowd):
            return Evidence()
        weight, rests_on = crowd.weighed(self.settings, self._then)
        away = np.hypot(*(crowd.poses[:, :2] - crowd.poses[0, :2]).T) > RIVAL_M
        rival = away | (np.abs(wrap_angles(crowd.poses[:, 2] - crowd.poses[0, 2])) > RIVAL_RAD)
        n, last = len(self._keys), min(len(self._keys), 6)
        own = max(1, min(int(rests_on[0]), n))
        return Evidence(
            lead=float(weight[0] - np.logaddexp.reduce(weight[rival])) if rival.any() else self.settings.margin,
            explained=float(crowd.explained[0, :last].mean()),
            explained_now=float(np.average(crowd.explained[0, : min(n, 2)], weights=[1 + self._stood, 1][:n])),
            through=float(crowd.through[0, :last].mean()),
            keys=n,
            own_keys=own,
            explained_own=float(crowd.explained[0, :own].mean()),
            challenged=self._challenged,
        )

    # --- searching

    def _maybe_search(self, stamp_ns: int) -> None:
        if self._outstanding is not None or not self._keys:
            return
        s = self.settings
        if self._searched_ns is not None:
            calm = self.state is State.SURE and self._probability >= s.stays
            if (stamp_ns - self._searched_ns) * 1e-9 < (s.search_sure_s if calm else s.search_s):
                return
        floor = self.known.floor_m2 if self._hint is None else min(self.known.floor_m2, 4.0 * self._hint[1] ** 2)
        joined = len(self._keys)
        if self._doubted is not None and self._next_search % 2 == 0:
            joined = max(1, sum(key.number > self._doubted - CARRIED_FOR for key in self._keys))
        self._outstanding = Search(self._next_search, self.known, s, tuple(self._keys), joined, self._hint, self._then)
        self._next_search += 1
        self._hint = None
        self._handed_out = False
        self._searched_ns = stamp_ns
        self._due_ns = stamp_ns + round((s.lag_s + s.lag_s_per_m2 * floor) * 1e9)

    def take_work(self) -> Search | None:
        """The search that is to be run, once; None if there is none."""
        if self._handed_out or self._outstanding is None:
            return None
        self._handed_out = True
        return self._outstanding

    def search_now(self, near: tuple[Pose2, float] | None = None) -> Search | None:
        """A search by the key scans there are, beside the own ones; nothing changes. None before the first scan."""
        keys = tuple(self._keys)
        return Search(-1, self.known, self.settings, keys, len(keys), near, self._then) if keys else None

    def abandon(self) -> None:
        """The search that is due came to nothing."""
        self._outstanding = None

    def is_due(self, stamp_ns: int) -> bool:
        """Whether a result must be applied before a scan of this stamp is added."""
        return self._outstanding is not None and stamp_ns >= self._due_ns

    def apply(self, result: SearchResult) -> None:
        """Take the places of a search among those that are followed."""
        search, self._outstanding = self._outstanding, None
        if search is None or result.number != search.number:  # what was asked for has been thrown away since
            self.events["search_outdated"] += 1
            return
        self.events["searches"] += 1
        later = [key for key in self._keys if key.number > result.key]
        if len(later) == self.settings.window or self._last_odom is None:
            self.events["search_outdated"] += 1
            return
        crowd, at = result.crowd, search.keys[0].odom_from_base
        replaced = all(key.number != result.key for key in self._keys)  # by one taken at the same spot
        for key in reversed(later):
            crowd = _moved(crowd, at.inverse() @ key.odom_from_base, self.settings)
            crowd = _corrected(self.known, key.points, crowd, self.settings)
            crowd = _with_evidence(self.known, key.points, crowd, self.settings, instead=replaced)
            at, replaced = key.odom_from_base, False
        crowd = _moved(crowd, at.inverse() @ self._last_odom, self.settings)
        self._challenged = True
        if self.state is State.SURE:
            crowd = replace(crowd, prior=np.full(len(crowd), -self.settings.carried))
        elif self._doubted is not None:
            crowd = replace(crowd, prior=np.full(len(crowd), -self.settings.doubted))
        together = self._crowd.and_(crowd)
        if len(together):
            self._crowd = _ranked(together, self.settings, self._then)
            self._judge_state()

    # --- throwing away

    def _throw_away(self) -> None:
        self._crowd = _crowd_at(np.zeros((0, 3)), _anywhere(), self.settings.window)
        self._keys.clear()
        self._then = np.full(self.settings.window, math.nan)
        self._doubted = None
        self._start_anew()

    def _look_anew(self) -> None:
        """What was believed is doubted: it is sure again only after a search. Nothing that was seen is forgotten, for
        most doubts are the map's fault; but a search by all of it finds no robot that was carried away."""
        self._doubted = self._keys[0].number
        self._start_anew()

    def _start_anew(self) -> None:
        self._outstanding, self._handed_out = None, True
        self._searched_ns = None
        self._challenged = False
        self._probability = 0.0 if not self._keys else self._probability


# --- crowds ---------------------------------------------------------------------------------------------------------


def _anywhere() -> F64:
    return np.diag([1e6, 1e6, math.pi**2])


def _ranked(crowd: _Crowd, s: InMapSettings, then: F64 | None = None) -> _Crowd:
    """Best first, one for each place, without those that are out of the running."""
    if not len(crowd):
        return crowd
    weight = crowd.weight(s, then)
    order = np.argsort(-weight, kind="stable")
    order = order[weight[order] >= weight[order[0]] - s.margin]
    crowd = crowd.rows(order)
    return crowd.rows(apart(crowd.poses, metres=SAME_M, radians=SAME_RAD, most=s.places))


def _told(crowd: _Crowd, weight: F64, most: int) -> tuple[Candidate, ...]:
    """The first places, with their shares of the belief in all."""
    if not len(crowd):
        return ()
    share = np.exp(weight - weight.max())
    share /= share.sum()
    return tuple(
        Candidate(pose_of(crowd.poses[k]), float(share[k]), float(crowd.explained[k, 0]), float(crowd.through[k, 0]))
        for k in range(min(most, len(crowd)))
    )


def _moved(crowd: _Crowd, step: Pose2, s: InMapSettings, *, blind_s: float = 0.0) -> _Crowd:
    """Every place after a step of odometry; blind_s: so long without any."""
    if not len(crowd):
        return crowd
    way, turn = math.hypot(step.x_m, step.y_m), abs(step.yaw_rad)
    yaw = crowd.poses[:, 2]
    c, sn = np.cos(yaw), np.sin(yaw)
    dx, dy = c * step.x_m - sn * step.y_m, sn * step.x_m + c * step.y_m
    poses = np.stack((crowd.poses[:, 0] + dx, crowd.poses[:, 1] + dy, wrap_angles(yaw + step.yaw_rad)), axis=-1)
    still = way < 1e-4 and turn < 1e-4 and blind_s == 0.0
    sigma_m = 0.0 if still else s.odometry_m + s.odometry_share * way + s.odometry_m_per_rad * turn + 0.5 * blind_s
    sigma_rad = (
        0.0 if still else s.odometry_rad + s.odometry_turn_share * turn + s.odometry_rad_per_m * way + 0.5 * blind_s
    )
    jacobian = np.zeros((len(crowd), 3, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = jacobian[:, 2, 2] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -dy, dx
    covariance = jacobian @ crowd.covariance @ jacobian.transpose(0, 2, 1)
    covariance = covariance + np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
    return replace(crowd, poses=poses, covariance=covariance)


def _corrected(known: KnownMap, points: Points, crowd: _Crowd, s: InMapSettings, *, turned: int = 0) -> _Crowd:
    """Every place laid on the map, held by what was expected as far as that is sure.

    The information of a match is its Hessian over point_sigma_m squared, for every beams_as_one beams one: neighbouring
    beams err together, by the map's errors and by their own. turned: the first so many places are also laid from
    headings to the left and to the right; see `_turned_back`.
    """
    if not len(crowd):
        return crowd
    stride = 1 if len(crowd) <= 4 or len(points) < 60 else 2
    laid = _laid(known, points, crowd, s, stride)
    if turned:
        first = np.arange(min(turned, len(crowd)))
        better = _turned_back(known, points, crowd.rows(first), laid, s, stride)
        laid = _Laid(*(np.concatenate((new, old[len(first) :])) for new, old in zip(better, laid)))
    good = laid.matched > 0.0
    return replace(
        crowd,
        poses=np.where(good[:, None], laid.poses, crowd.poses),
        covariance=np.where(good[:, None, None], laid.covariance, crowd.covariance),
    )


class _Laid(NamedTuple):
    """Places laid on the map: poses (K, 3), covariance (K, 3, 3), matched (K,) how well, from 0 to 1."""

    poses: F64
    covariance: F64
    matched: F64


def _laid(known: KnownMap, points: Points, crowd: _Crowd, s: InMapSettings, stride: int) -> _Laid:
    unit = s.point_sigma_m**2 * s.beams_as_one
    priors: F64 = np.asarray(
        np.linalg.inv(crowd.covariance + np.diag([1e-6, 1e-6, 1e-8])) * (unit / stride), dtype=float
    )
    fits = lay(known, points, crowd.poses, priors=priors, stride=stride)
    good = fits.solved & (fits.share > 0.2) & (fits.mean_cost < 0.7)
    covariance: F64 = np.asarray(np.linalg.inv((priors + fits.hessian) * (stride / unit)), dtype=float)
    return _Laid(fits.poses, covariance, np.where(good, fits.share * (1.0 - fits.mean_cost), 0.0))


def _turned_back(known: KnownMap, points: Points, crowd: _Crowd, laid: _Laid, s: InMapSettings, stride: int) -> _Laid:
    """The first rows of `laid`, where a heading TURNED to either side fits clearly better: that one.

    Wheels lose degrees in a turn, and laying on walls catches 4 or 5 only: beyond that it is caught between walls.
    """
    best = _Laid(*(column[: len(crowd)] for column in laid))
    for side in (-TURNED_RAD, TURNED_RAD):
        aside = replace(
            crowd,
            poses=crowd.poses + np.array([0.0, 0.0, side]),
            covariance=crowd.covariance + np.diag([0.0, 0.0, TURNED_RAD**2]),
        )
        other = _laid(known, points, aside, s, stride)
        clear = other.matched > best.matched + CLEARLY
        best = _Laid(*(np.where(clear.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(other, best)))
    return best


def _with_evidence(known: KnownMap, points: Points, crowd: _Crowd, s: InMapSettings, *, instead: bool) -> _Crowd:
    """The crowd with a key scan's verdicts in front; instead of the last ones if told so."""
    if not len(crowd):
        return crowd
    said = hold(known, points, crowd.poses, stride=1 if len(crowd) <= 4 or len(points) < 60 else 2)
    log = said.log / said.beams * min(len(points), 90) / s.beams_as_witness

    def put(kept: F64, new: F64) -> F64:
        return np.concatenate((new[:, None], kept[:, 1:] if instead else kept[:, :-1]), axis=1)

    return replace(
        crowd,
        log=put(crowd.log, log),
        explained=put(crowd.explained, said.explained),
        through=put(crowd.through, said.through),
        unexpected=put(crowd.unexpected, said.unexpected),
    )


def _joined(keys: tuple[_Key, ...], s: InMapSettings) -> F64:
    """Points (N, 2) of the last key scans in the newest one's base frame, thinned."""
    newest = keys[0].odom_from_base.inverse()
    found, way = [], 0.0
    for index, key in enumerate(keys):
        if index:
            step = keys[index - 1].odom_from_base.inverse() @ key.odom_from_base
            way += math.hypot(step.x_m, step.y_m)
        if way > s.joined_m:
            break
        found.append((newest @ key.odom_from_base).apply(np.stack((key.points.x_m, key.points.y_m), axis=-1)))
    return thinned(np.concatenate(found), cell_m=0.2, most=s.search_points)


def _near_guess(fits: Fits, guesses: F64) -> NDArray[np.bool_]:
    """Whether laying kept to the place that was searched for."""
    off = np.hypot(*(fits.poses[:, :2] - guesses[:, :2]).T)
    return np.asarray((off < 0.5) & (np.abs(wrap_angles(fits.poses[:, 2] - guesses[:, 2])) < math.radians(8.0)))


def _led_back(known: KnownMap, s: InMapSettings, keys: tuple[_Key, ...], poses: F64) -> _Crowd:
    """Places at the newest key scan, each led back over all keys, with the evidence of each."""
    walker = _crowd_at(poses, np.diag([0.1**2, 0.1**2, math.radians(2.0) ** 2]), s.window)
    first = walker
    columns = [np.zeros((len(poses), s.window)) for _ in range(4)]
    for index, key in enumerate(keys):
        if index:
            walker = _moved(walker, keys[index - 1].odom_from_base.inverse() @ key.odom_from_base, s)
        walker = _corrected(known, key.points, walker, s)
        if not index:
            first = walker
        said = _with_evidence(known, key.points, walker, s, instead=True)
        for column, new in zip(columns, said.seen()):
            column[:, index] = new[:, 0]
    return _Crowd(first.poses, first.covariance, first.prior, *columns)
