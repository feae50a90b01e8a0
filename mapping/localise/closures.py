"""Closing loops: which key scans see a place again, how sure that is, and what the map looks like afterwards.

All of it is one pure function of a snapshot (`Work.run`), so that a thread may do it while the robot drives on.

1. Candidates: key scans from an earlier part of the way, nearer to the key in question than the drift that may have
   gathered between them. Drift grows with the way through the graph, closures being shortcuts, so that after a loop
   is closed the search is narrow again.
2. Measurement: where the possible drift is small, the matcher starts from the present estimate ("tracked"); else a
   correlative search finds the place ("searched") and the matcher refines it.
   A tracked one that walls do not hold along themselves is put where the ends of walls meet (`slide`).
3. Tests of a single closure: most of the scan's points lie on surfaces the others saw, next to none lies in space
   they saw through; no second place fits nearly as well; the geometry holds the pose in every direction; the
   correction is one that the covariance gathered along the way through the graph can explain.
4. Probation: a searched closure counts only when others, found independently from other places of the way, ask for
   the same correction: the more of them and the farther apart, the less the covariance expects it. Tracked ones
   agree with the map already.
5. Optimisation with weights that let a false closure fall out; a group that does not survive it is undone.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.kernels.graph_ways import lengths_from
from mapping.localise.closure_records import (
    Closure,
    ClosureSettings,
    Snapshot,
    WorkResult,
    edges_of,
    floored,
    turned_information,
)
from mapping.localise.pose_graph import (
    Edges,
    Solution,
    Uncertainty,
    covariance_of,
    mahalanobis,
    optimise,
    weights_of,
)
from mapping.localise.scan_match import (
    TRACKING,
    Agreement,
    Match,
    Reach,
    agreement,
    match_view,
    weakest_information,
)
from mapping.localise.search import APART_M, APART_RAD, find_view, raster_of
from mapping.localise.slide import slid
from mapping.localise.views import View

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

ASIDE = 0.5  # cosine: keys that look more than 60 degrees away
REFINING = Reach((0.40, 0.28, 0.20, 0.15), (0.12, 0.08, 0.06, 0.04))


@dataclass(slots=True)
class Work:
    """One piece of work for the back end; `run` changes nothing but what it returns."""

    snapshot: Snapshot
    settings: ClosureSettings
    _events: Counter[str] = field(default_factory=Counter)
    _uncertainty: Uncertainty | None = None
    _known: Edges | None = None

    def run(self) -> WorkResult:
        """Look for closures of the snapshot's keys, judge what is pending, optimise if it is worth it."""
        self._events = Counter()
        shot = self.snapshot
        accepted, pending = list(shot.closures), list(shot.pending)
        tracked, searched = self._look()
        accepted += tracked
        pending += searched
        poses, weight = shot.poses, None
        unoptimised = shot.unoptimised + len(tracked)
        group, waiting = self._agreeing(pending)
        if group:
            trial = self._solve(poses, accepted + group, start_scale=1e4)
            known = len(shot.path) + len(accepted)
            if float(np.median(trial.weight[known:])) >= 0.25:
                stays = self._staying(group, trial.weight[known:])
                accepted += [closure for closure, good in zip(group, stays) if good]
                pending, poses, unoptimised = waiting, trial.poses, 0
                self._events["accepted_after_probation"] += int(stays.sum())
                self._events["undone"] += int((~stays).sum())
                weight = np.concatenate((trial.weight[:known], trial.weight[known:][stays]))
            else:
                pending = waiting
                self._events["undone"] += len(group)
        elif self._is_due(accepted, unoptimised):
            solved = self._solve(poses, accepted)
            poses, weight, unoptimised = solved.poses, solved.weight, 0
        if weight is None:
            weight = self._weights(poses, accepted)
        if shot.thorough:
            accepted, weight = self._without_refuted(accepted, weight)
        covariance = None
        if poses is not shot.poses:
            covariance = covariance_of(poses, self._edges(accepted), weight, len(poses) - 1)
        numbered, number = _numbered(accepted, shot.next_number)
        return WorkResult(
            poses, numbered, weight[len(shot.path) :], self._kept(pending), unoptimised, number, covariance,
            dict(self._events),
        )  # fmt: skip

    # --- looking

    def _look(self) -> tuple[list[Closure], list[Closure]]:
        """Closures of the snapshot's keys: tracked ones, and searched ones."""
        tracked: list[Closure] = []
        searched: list[Closure] = []
        if not self.snapshot.keys:
            return tracked, searched
        way_m = self._ways(self.snapshot.keys)
        last_search_m = -math.inf
        for row, key in enumerate(self.snapshot.keys):
            near, wide = self._places(key, way_m[row])
            for place in near:
                tracked += self._track(key, place)
            # Where the search is wide, it is made more rarely: it costs more.
            every_m = max(self.settings.every_m, *(0.03 * self._drift(way_m[row][place]) for place in wide), 0.0)
            may_search = self._events["searches"] < max(self.settings.searches, len(self.snapshot.keys) // 3)
            if wide and may_search and self.snapshot.travel_m[key] - last_search_m >= every_m:
                last_search_m = float(self.snapshot.travel_m[key])
                searched += self._search(key, wide, way_m[row])
        return tracked, searched

    def _drift(self, way_m: F64) -> F64:
        """How far off keys may be from each other after ways of these lengths through the graph; any shape."""
        s = self.settings
        return np.minimum(s.search_m, s.drift_m + s.drift_share * np.asarray(way_m))

    def _ways(self, keys: tuple[int, ...]) -> F64:
        """(K, N) length of the shortest way through the graph from each key to every other."""
        shot = self.snapshot
        edges = self._edges(shot.closures)
        length = np.hypot(edges.measured[:, 0], edges.measured[:, 1]) + 1e-3
        starts, count = np.array(keys, dtype=np.int64), len(shot.poses)
        ways: F64 = lengths_from(starts, edges.start, edges.to, length, count)
        return ways

    def _places(self, key: int, way_m: F64) -> tuple[list[int], list[int]]:
        """Keys at the middle of places to compare with: those near enough to track, and those to search."""
        shot, s = self.snapshot, self.settings
        there = shot.views.is_there()[: key + 1]
        earlier = np.flatnonzero((shot.travel_m[key] - shot.travel_m[: key + 1] > s.apart_m) & there)
        if not len(earlier):
            return [], []
        off = shot.poses[earlier] - shot.poses[key]
        distance = np.hypot(off[:, 0], off[:, 1])
        drift = self._drift(way_m[earlier])
        facing = distance + 1.0 - np.cos(off[:, 2])  # of places equally near, the one seen from the same side
        trackable = (drift <= s.tracked_m) & (distance < 2.0)
        near = self._spread(earlier[trackable], facing[trackable], np.full(len(earlier), 2.0 * s.place_m), 2)
        if near:
            return near, []
        wide = (drift > s.tracked_m) & (distance < drift + 2.0)
        apart_m = np.maximum(2.0 * s.place_m, self._reach_m(drift[wide]))
        return [], self._spread(earlier[wide], (facing / drift)[wide], apart_m, s.places)

    def _reach_m(self, drift: F64) -> F64:
        """How much of the way on either side of a key makes a place, where so much is to be searched; any shape."""
        return np.maximum(self.settings.place_m, 0.5 * np.asarray(drift))

    def _spread(self, keys: I64, cost: F64, apart_m: F64, most: int) -> list[int]:
        """The cheapest keys that lie apart along the way: of each, apart_m (K,) from those chosen before."""
        travel = self.snapshot.travel_m
        chosen: list[int] = []
        for index in np.argsort(cost, kind="stable").tolist():
            key = int(keys[index])
            if all(abs(travel[key] - travel[other]) >= apart_m[index] for other in chosen):
                chosen.append(key)
                if len(chosen) == most:
                    break
        return chosen

    def _nearest(self, place: int, key: int, reach_m: float, pose: Pose2) -> int:
        """Of the keys within reach_m along the way of a place, the one that saw it from nearest to a pose."""
        rows = self._around(place, key, reach_m, len(self.snapshot.poses))
        off = self.snapshot.poses[rows] - np.array([pose.x_m, pose.y_m, pose.yaw_rad])
        return int(rows[np.argmin(np.hypot(off[:, 0], off[:, 1]) + 1.0 - np.cos(off[:, 2]))])

    def _seeing(self, view: View, key: int, rows: I64, pose: Pose2) -> int:
        """Of keys (R,), the one around which most was seen of what a view at a pose sees: a laser that looks ahead sees
        a street's houses from one side only, and the same ones from farther on where it drives the other way."""
        shot = self.snapshot
        seen = []
        for place in rows.tolist():
            around = self._around(place, key, self.settings.place_m, 16)
            seen.append(agreement(view, shot.views, around, shot.poses[around], pose).explained)
        return int(rows[int(np.argmax(seen))])

    def _around(self, place: int, key: int, reach_m: float, most: int) -> I64:
        """Keys within reach_m along the way of a place, evenly thinned to `most`; the place itself is one."""
        travel = self.snapshot.travel_m
        rows = np.flatnonzero((np.abs(travel[:key] - travel[place]) < reach_m) & self.snapshot.views.is_there()[:key])
        rows = rows[travel[key] - travel[rows] > 0.5 * self.settings.apart_m]
        if len(rows) > most:
            rows = rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(np.int64))]
        return np.union1d(rows, [place])

    # --- measuring

    def _track(self, key: int, place: int) -> list[Closure]:
        shot = self.snapshot
        rows = self._around(place, key, self.settings.place_m, 8)
        here = Pose2(*shot.poses[key].tolist())
        view = shot.views.view(key)
        match = match_view(view, shot.views, rows, shot.poses[rows], here, reach=TRACKING)
        if match is not None and weakest_information(match.information()) < self.settings.weakest_per_m2:
            held = slid(view, shot.views, rows, shot.poses[rows], match, prominence=self.settings.prominence)
            self._events["slid"] += held is not None
            match = match if held is None else held
        closure = self._judged(key, place, rows, match, here, self.settings.tracked_m, searched=False)
        self._events["tracked"] += closure is not None
        return [] if closure is None else [closure]

    def _search(self, key: int, places: list[int], way_m: F64) -> list[Closure]:
        """The one place of several that fits; none if two do and contradict each other."""
        shot, s = self.snapshot, self.settings
        view, here = shot.views.view(key), Pose2(*shot.poses[key].tolist())
        found: list[tuple[Closure, float]] = []
        others: list[tuple[Pose2, float]] = []  # where it fits as well, here or there
        self._events["searches"] += 1
        for place in places:
            drift = float(self._drift(way_m[place]))
            turn = min(s.turn_most_rad, s.turn_start_rad + s.turn_rad_per_m * float(way_m[place]))
            reach_m = float(self._reach_m(np.array(drift)))
            rows = self._around(place, key, reach_m, 16)
            raster = raster_of(shot.views, rows, shot.poses[rows], window_m=drift)
            spot = find_view(view, raster, here, window_m=drift, turn_rad=turn, doubtful_share=s.rival, least=s.score)
            if spot is None:
                self._events["no_place_fits"] += 1
                continue
            if spot.rival > s.rival:
                self._events["ambiguous"] += 1
                others.append((spot.pose, spot.score))
                continue
            if reach_m > s.place_m:
                place = self._nearest(place, key, reach_m, spot.pose)
                if math.cos(shot.poses[place, 2] - spot.pose.yaw_rad) < ASIDE:
                    place = self._seeing(view, key, rows, spot.pose)
                rows = self._around(place, key, s.place_m, 16)
            match = match_view(view, shot.views, rows, shot.poses[rows], spot.pose, reach=REFINING)
            closure = self._judged(key, place, rows, match, spot.pose, 0.6, searched=True)
            if closure is not None:
                found.append((closure, spot.score))
        if not found:
            return []
        best, score = max(found, key=lambda entry: entry[1])
        is_rivalled = any(
            other_score > s.rival * score and _apart(Pose2(*shot.poses[best.start].tolist()) @ best.measured, pose)
            for pose, other_score in others
        )
        if is_rivalled or any(not self._same_correction(best, other, strict=False) for other, _ in found):
            self._events["contradicting_places"] += 1
            return []
        surprise = self._surprise(best)
        if surprise > s.surprise:
            self._events["beyond_drift"] += 1
            return []
        self._events["searched"] += 1
        return [replace(best, surprise=surprise)]

    def _surprise(self, closure: Closure) -> float:
        """Squared Mahalanobis distance of a closure from where the way through the graph leads."""
        shot = self.snapshot
        if self._uncertainty is None:
            edges = self._edges(shot.closures)
            self._uncertainty = Uncertainty(
                shot.poses, edges, weights_of(shot.poses, edges), held_m=self.settings.held_m
            )
        covariance = self._uncertainty.of_relative(closure.start, closure.to) + np.linalg.inv(closure.information)
        return float(
            mahalanobis(shot.poses, replace(edges_of([closure]), information=np.linalg.inv(covariance)[None]))[0]
        )

    def _judged(
        self, key: int, place: int, rows: I64, match: Match | None, guess: Pose2, most_m: float, *, searched: bool
    ) -> Closure | None:
        """The closure that a match says, if it passes the tests of a single one."""
        shot, s = self.snapshot, self.settings
        if match is None:
            self._events["no_match"] += 1
            return None
        off = guess.inverse() @ match.pose
        if math.hypot(off.x_m, off.y_m) > most_m or abs(off.yaw_rad) > math.radians(8.0):
            self._events["ran_away"] += 1
            return None
        agrees = agreement(shot.views.view(key), shot.views, rows, shot.poses[rows], match.pose)
        information = match.information()
        weakest = weakest_information(information)
        worth = self._worth(agrees, match.mean_cost, weakest)
        if worth <= 0.0 or (worth < 1.0 and not searched):
            self._events["degenerate" if weakest < s.weakest_per_m2 else "does_not_fit"] += 1
            return None
        start = Pose2(*shot.poses[place].tolist())
        seen = floored(turned_information(information, -start.yaw_rad), s.floor_m, s.floor_rad)
        return Closure(place, key, start.inverse() @ match.pose, seen, worth, searched)

    def _worth(self, agrees: Agreement, mean_cost: float, weakest_per_m2: float) -> float:
        """The vote of a single closure; 0 if it does not pass."""
        s = self.settings
        explained, overlap = agrees.explained, agrees.overlap
        if weakest_per_m2 >= s.weakest_per_m2:
            if explained >= s.explained and overlap >= s.overlap and mean_cost <= s.mean_cost:
                return 1.0
            if explained >= s.half_explained and overlap >= s.half_overlap and mean_cost <= s.half_mean_cost:
                return 0.5
        if overlap < s.rough_overlap or mean_cost > s.rough_mean_cost:
            return 0.0
        if explained >= s.rough_explained and weakest_per_m2 >= s.rough_weakest_per_m2:
            return s.rough_worth
        is_faint = explained >= s.faint_explained and mean_cost >= s.mean_cost
        return s.faint_worth if is_faint and weakest_per_m2 >= s.faint_weakest_per_m2 else 0.0

    # --- probation

    def _agreeing(self, pending: list[Closure]) -> tuple[list[Closure], list[Closure]]:
        """The largest group of pending closures that ask for one correction, if it is enough, and the rest."""
        s, travel = self.settings, self.snapshot.travel_m
        best: list[int] = []
        votes = 0.0
        for first in pending:
            group = [k for k, other in enumerate(pending) if self._same_correction(first, other)]
            worth = {pending[k].to: pending[k].worth for k in group}  # a key scan has one vote
            if sum(worth.values()) > votes:
                best, votes = group, sum(worth.values())
        if votes < s.agreeing:
            return [], pending
        surprise = float(np.median([pending[k].surprise for k in best]))
        doubt = 1.0 + max(0.0, surprise - s.expected) / s.doubling
        way = [float(travel[pending[k].to]) for k in best]
        needed_m = doubt * self._way_needed([pending[k] for k in best], doubt * s.agreeing)
        if votes < doubt * s.agreeing or max(way) - min(way) < needed_m:
            return [], pending
        chosen = set(best)
        return [pending[k] for k in best], [c for k, c in enumerate(pending) if k not in chosen]

    def _way_needed(self, group: list[Closure], votes: float) -> float:
        """Over how much of the way a group must agree: the more if it has not as many votes without faint ones, or
        nearly all of its votes are rough."""
        s = self.settings
        firm = {closure.to: closure.worth for closure in group if closure.worth > s.faint_worth}
        if sum(firm.values()) < votes:
            return s.faint_way_m
        return s.rough_way_m if sum(worth >= 0.5 for worth in firm.values()) < 2 else s.agreeing_way_m

    def _staying(self, group: list[Closure], weight: F64) -> NDArray[np.bool_]:
        """(C,) which of a group that was accepted stay: rough ones only if the others bear them out, unless that were
        few. Along a corridor one may slide from niche to niche and be far surer of it than it should."""
        is_rough = np.array([closure.worth <= self.settings.rough_worth for closure in group])
        stays = np.asarray(~is_rough | (weight >= self.settings.rough_weight))
        return stays if 2 * stays.sum() >= len(stays) else np.ones_like(stays)

    def _same_correction(self, a: Closure, b: Closure, *, strict: bool = True) -> bool:
        """Whether two closures move the robot to the same place, drift between them allowed for."""
        if a is b:
            return True
        poses, travel = self.snapshot.poses, self.snapshot.travel_m
        way = abs(float(travel[a.to] - travel[b.to])) + abs(float(travel[a.start] - travel[b.start]))
        if strict and way > 60.0:
            return False
        at = Pose2(*poses[a.to].tolist())
        by_a = Pose2(*poses[a.start].tolist()) @ a.measured
        by_b = Pose2(*poses[b.start].tolist()) @ b.measured @ (Pose2(*poses[b.to].tolist()).inverse() @ at)
        off = by_a.inverse() @ by_b
        return math.hypot(off.x_m, off.y_m) < 0.25 + 0.02 * way and abs(off.yaw_rad) < math.radians(2.0 + 0.1 * way)

    def _kept(self, pending: list[Closure]) -> tuple[Closure, ...]:
        """The newest, as many as may wait."""
        self._events["probation_ended"] += max(0, len(pending) - self.settings.pending)
        return tuple(pending[-self.settings.pending :])

    # --- optimising

    def _without_refuted(self, accepted: list[Closure], weight: F64) -> tuple[list[Closure], F64]:
        """Closures that the finished map contradicts are undone for good."""
        kept = weight[len(self.snapshot.path) :] >= self.settings.undone_below
        self._events["undone"] += int(np.sum(~kept))
        chosen = np.concatenate((np.ones(len(self.snapshot.path), dtype=np.bool_), kept))
        return [c for c, good in zip(accepted, kept) if good], weight[chosen]

    def _is_due(self, accepted: list[Closure], unoptimised: int) -> bool:
        if not unoptimised:
            return self.snapshot.thorough
        if self.snapshot.thorough or unoptimised >= self.settings.optimise_every:
            return True
        newest = edges_of(accepted[-unoptimised:])
        return float(np.median(mahalanobis(self.snapshot.poses, newest))) > self.settings.misfit

    def _solve(self, poses: F64, closures: list[Closure], start_scale: float = 100.0) -> Solution:
        self._events["optimised"] += 1
        return optimise(
            poses, self._edges(closures), start_scale=start_scale, most_steps=25 if self.snapshot.thorough else 12
        )

    def _weights(self, poses: F64, closures: list[Closure]) -> F64:
        return weights_of(poses, self._edges(closures))

    def _edges(self, closures: Sequence[Closure]) -> Edges:
        """The path and these closures, the snapshot's own first: its edges are made once."""
        if self._known is None:
            self._known = self.snapshot.path.joined(edges_of(self.snapshot.closures))
        known = len(self.snapshot.closures)
        if len(closures) >= known and all(a is b for a, b in zip(closures, self.snapshot.closures)):
            return self._known.joined(edges_of(closures[known:])) if len(closures) > known else self._known
        return self.snapshot.path.joined(edges_of(closures))


def _apart(a: Pose2, b: Pose2) -> bool:
    """Whether two poses of one key are two places."""
    off = a.inverse() @ b
    return math.hypot(off.x_m, off.y_m) > APART_M or abs(off.yaw_rad) > APART_RAD


def _numbered(closures: list[Closure], number: int) -> tuple[tuple[Closure, ...], int]:
    """Closures with names, the new ones standing last; the next free name."""
    known = len(closures)
    while known and closures[known - 1].number < 0:
        known -= 1
    new = [replace(closure, number=number + k) for k, closure in enumerate(closures[known:])]
    return (*closures[:known], *new), number + len(new)
