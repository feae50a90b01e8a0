"""Laying each sweep on the last key scans: SLAM's front end, and all of laser odometry.

A sweep is expected where odometry has it or, without odometry, where the motion so far leads. It is laid there by
itself; a match that is held badly, or lies where it was not expected, is looked at again in several ways.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2, exp_se2, log_se2, wrap_angle
from mapping.localise.fitting import HELD_PER_M2
from mapping.localise.odometry_trust import Heading, Trust
from mapping.localise.scan_match import (
    NO_PRIOR,
    TRACKING,
    Match,
    Reach,
    agreement,
    match_view,
    weakest_information,
)
from mapping.localise.search import find_view, raster_of
from mapping.localise.slam_records import SlamSettings
from mapping.localise.views import BearingTable, KeptViews, View, table_for, view_of
from mapping.scan import Scan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

NEARBY = Reach((0.30, 0.22, 0.18, 0.15), (0.08, 0.06, 0.05, 0.04))
LEAST_FIT = 0.3  # of a view's points must be explained, or it says nothing about where it was taken
FASTEST_M_S = 20.0
FASTEST_RAD_S = 4.0
LEAP_M, LEAP_RAD = 2.0, 1.0  # odometry does not move so far at once; stamps may be a scan or two off
LEAP_M_S = 10.0
CLEARLY = 1.1  # times better a match must be to be believed against the prediction
CLEARLY_PER_DEVIATION = 0.04  # and so much more for each deviation beyond the gate
MOST_BEYOND = 20.0
LEAST_SHARE = 0.2  # of pairs of points, in a match that can judge
ROUGH_COST = 0.2  # of a match: hedges and slopes, no walls
LEAST_RAD = math.radians(0.02)  # what odometry errs in a step, at least


@dataclass(frozen=True, slots=True)
class Place:
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


@dataclass(frozen=True, slots=True)
class References:
    """Key scans that a view is laid on: numbers (R,) in a store of views, map_from_sensor (R, 3)."""

    store: KeptViews
    rows: I64
    poses: F64

    def match(self, view: View, guess: Pose2, *, prior: F64 = NO_PRIOR, reach: Reach = TRACKING) -> Match | None:
        """The view laid on them, from a guess of map_from_sensor."""
        return match_view(view, self.store, self.rows, self.poses, guess, prior=prior, reach=reach)

    def explained(self, view: View, pose: Pose2) -> float:
        """Share of the view's points that they explain, seen from a pose."""
        return agreement(view, self.store, self.rows, self.poses, pose).explained


class Tracker:
    """See the module's docstring. Lasers are told apart by name.

    last: stamp, map_from_base and odom_from_base of the newest scan.  lost_scans: how many in a row fitted nothing.
    """

    def __init__(self, settings: SlamSettings, events: Counter[str], *, velocity_over_s: float = 0.15) -> None:
        """events: where it is counted what happened.  velocity_over_s: motion is taken over at least that long."""
        self.events = events
        self.lost_scans = 0
        self.start: Pose2 | None = None
        self.last: tuple[int, Pose2, Pose2 | None] | None = None
        self.trust = Trust(settings.odometry_factor)
        self.heading = Heading(settings.odometry_rad_per_m, settings.odometry_turn_share)
        self._settings = settings
        self._velocity_over_s = velocity_over_s
        self._tables: dict[str, BearingTable] = {}
        self._velocity: F64 = np.zeros(3)  # a twist of the base in its own frame [m/s, m/s, rad/s]
        self._recent: deque[tuple[int, Pose2]] = deque(maxlen=64)

    def view(self, scan: Scan, sensor: str) -> View | None:
        """The sweep in its sensor's table; None if there is too little in it."""
        table = self._tables.get(sensor)
        if table is None:
            try:
                table = table_for(scan.bearing_rad)
            except ValueError:
                self.events["scan_without_beams"] += 1
                return None
            self._tables[sensor] = table
        view = view_of(scan, table, farthest_m=self._settings.farthest_m, grazed=True)
        if view.points < self._settings.least_points:
            self.events["scan_too_empty"] += 1
            return None
        return view

    def predicted(self, stamp_ns: int, base_from_sensor: Pose2, odom_from_base: Pose2 | None) -> Place:
        """Where the sensor should be: by odometry since the last scan, else, or if that leapt, by the motion so far."""
        if self.last is None:
            start = self.start or odom_from_base or IDENTITY
            return Place(start @ base_from_sensor, start, 1.0, 1.0)
        last_ns, last_pose, last_odom = self.last
        step = None if odom_from_base is None or last_odom is None else last_odom.inverse() @ odom_from_base
        if step is not None and _leaps(step, (stamp_ns - last_ns) * 1e-9):
            self.events["odometry_leapt"] += 1
            step = None
        if step is not None:
            sigma_m, sigma_rad = self.odometry_sigma(math.hypot(step.x_m, step.y_m), abs(step.yaw_rad))
            return Place(last_pose @ step @ base_from_sensor, last_pose @ step, sigma_m, sigma_rad, step)
        seconds = min(max((stamp_ns - last_ns) * 1e-9, 0.0), 0.5)
        way = self._velocity * seconds
        sigma_m = 0.05 + 2.0 * seconds**2 + 0.3 * math.hypot(way[0], way[1])
        sigma_rad = math.radians(3.0) + 3.0 * seconds**2 + 0.3 * abs(float(way[2]))
        ahead = last_pose @ exp_se2(way)
        return Place(ahead @ base_from_sensor, ahead, sigma_m, sigma_rad)

    def odometry_sigma(self, way_m: float, turn_rad: float) -> tuple[float, float]:
        """Standard deviations of a step by odometry, as far as it is trusted by now."""
        s = self._settings
        sigma_m = s.odometry_m + s.odometry_share * way_m + s.odometry_m_per_rad * turn_rad
        sigma_rad = s.odometry_rad + s.odometry_turn_share * turn_rad + s.odometry_rad_per_m * way_m
        return sigma_m * self.trust.factor_m, sigma_rad * self.trust.factor_rad

    def matched(self, view: View, references: References, guess: Place) -> Match | None:
        """The view laid on the references by itself; where that is doubtful, the best of what else fits; None if
        nothing does. A prediction that pulled all the time would pull into its own errors, which are no noise."""
        match = free = references.match(view, guess.map_from_sensor, prior=0.01 * guess.information())
        if match is None or not self._is_plain(match, guess):
            self.events["looked_twice"] += 1
            match = self._best_of(view, references, guess, match)
        if match is None:
            self.events["not_matched"] += 1
            self.lost_scans += 1
            return None
        self.lost_scans = 0
        self._learn(match, guess)
        self._learn_heading(match, guess, free)
        return match

    def _is_plain(self, match: Match, guess: Place) -> bool:
        """Whether a match needs no second look: it is held in every direction, and it lies where it was expected."""
        return (
            match.share > LEAST_SHARE
            and match.mean_cost < 0.45
            and weakest_information(match.information()) > HELD_PER_M2
            and max(guess.deviations(match.pose)) < self._settings.gate
        )

    def _learn(self, match: Match, guess: Place) -> None:
        """What a step that was matched well, by itself, says about odometry."""
        step = guess.step
        if step is None or weakest_information(match.information()) < HELD_PER_M2:
            return
        if math.hypot(step.x_m, step.y_m) > 0.01 or abs(step.yaw_rad) > math.radians(0.5):
            off_m, off_rad = guess.deviations(match.pose)
            self.trust.learn(off_m / math.sqrt(2.0), off_rad)

    def _learn_heading(self, match: Match, guess: Place, free: Match | None) -> None:
        """What a scan says about odometry's turns. free: its match that nothing held."""
        if guess.step is None or free is None:
            return
        off_rad = wrap_angle(match.pose.yaw_rad - guess.map_from_sensor.yaw_rad)
        left_rad = wrap_angle(free.pose.yaw_rad - match.pose.yaw_rad)
        is_rough = free.mean_cost >= ROUGH_COST or free.share <= LEAST_SHARE
        self.heading.step(_along(guess.step), guess.step.yaw_rad, off_rad, left_rad, is_rough=is_rough)

    def _best_of(self, view: View, references: References, guess: Place, match: Match | None) -> Match | None:
        """Of a free match, one that the prediction holds, and one searched for: what lies nearer to the prediction,
        unless another is clearly better."""
        doubt = 0.5 if match is None else min(match.mean_cost, 0.7)
        pull = guess.information() / (1.0 - doubt) ** 4  # leaves that move and crowds look like many points
        held = references.match(view, guess.map_from_sensor, prior=pull, reach=NEARBY)
        best = held
        if match is not None and (held is None or match.score > self._clearly(guess, match) * held.score):
            best = match
        fits = 0.0 if best is None else references.explained(view, best.pose)
        if best is not None and self._is_hollow(best, guess):
            best, fits = self._turned_by_odometry(view, references, guess, doubt, best, fits)
        if fits < 0.5:
            best, fits = self._looked_around(view, references, guess, best, fits)
        return best if fits >= LEAST_FIT else None

    def _is_hollow(self, match: Match, guess: Place) -> bool:
        """Whether a match may look good and be wrong: it lies on no planes, holds the pose badly, and odometry is known
        to turn more truly than such matches do."""
        is_held = match.mean_cost < ROUGH_COST or weakest_information(match.information()) > HELD_PER_M2
        return guess.step is not None and not is_held and self.heading.is_better

    def _turned_by_odometry(
        self, view: View, references: References, guess: Place, doubt: float, best: Match, fits: float
    ) -> tuple[Match, float]:
        """A match whose heading odometry holds, as far as it was true where scans could tell; the one there is if that
        explains too little."""
        assert guess.step is not None
        along_m, turn_rad = _along(guess.step), guess.step.yaw_rad
        expected = guess.map_from_sensor @ Pose2(0.0, 0.0, self.heading.bias_rad(along_m, turn_rad))
        sigma_rad = max(LEAST_RAD, self.heading.sigma_rad(along_m, turn_rad))
        pull = replace(guess, sigma_rad=sigma_rad).information() / (1.0 - doubt) ** 4
        match = references.match(view, expected, prior=pull, reach=NEARBY)
        found = 0.0 if match is None else references.explained(view, match.pose)
        if match is None or found < 0.5:
            return best, fits
        self.events["turned_by_odometry"] += 1
        return match, found

    def _clearly(self, guess: Place, match: Match) -> float:
        """How much better than what the prediction holds a match must fit to be believed: the more, the farther it
        leads from a prediction that has been right so far."""
        beyond = max(0.0, max(guess.deviations(match.pose)) - self._settings.gate)
        return CLEARLY + CLEARLY_PER_DEVIATION * min(beyond, MOST_BEYOND)

    def _looked_around(
        self, view: View, references: References, guess: Place, best: Match | None, fits: float
    ) -> tuple[Match | None, float]:
        """A place searched for within what the prediction may be off, if it explains more of the view."""
        self.events["looked_around"] += 1
        window_m = min(1.0 + 0.2 * self.lost_scans, 3.0, 0.3 + self._settings.gate * guess.sigma_m)
        turn_rad = min(math.radians(30.0), math.radians(2.0) + self._settings.gate * guess.sigma_rad)
        raster = raster_of(references.store, references.rows, references.poses)
        spot = find_view(view, raster, guess.map_from_sensor, window_m=window_m, turn_rad=turn_rad)
        if spot is None or spot.rival > 0.97:
            return best, fits
        other = references.match(view, spot.pose, reach=NEARBY)
        if other is None or (best is not None and other.score < self._clearly(guess, other) * best.score):
            return best, fits
        found = references.explained(view, other.pose)
        return (other, found) if found > fits + 0.1 else (best, fits)

    def told(self, stamp_ns: int, map_from_base: Pose2, odom: Pose2 | None, *, matched: bool) -> None:
        """A scan was there: what the next ones start from."""
        self._note_velocity(stamp_ns, map_from_base, matched=matched)
        self.last = (stamp_ns, map_from_base, odom)

    def _note_velocity(self, stamp_ns: int, map_from_base: Pose2, *, matched: bool) -> None:
        """Keep the motion of the base a second, in its own frame, for scans without odometry.

        Taken over at least velocity_over_s, because stamps of single scans may be off by as much as a scan lasts.
        What was only predicted says nothing about motion; a robot that is lost is taken to stand.
        """
        if not matched:
            self._recent.clear()
            self._velocity = 0.5 * self._velocity
            return
        self._recent.append((stamp_ns, map_from_base))
        while len(self._recent) > 2 and (stamp_ns - self._recent[1][0]) * 1e-9 >= self._velocity_over_s:
            self._recent.popleft()
        before_ns, before = self._recent[0]
        seconds = (stamp_ns - before_ns) * 1e-9
        if not self._velocity_over_s <= seconds < 1.5:
            self._velocity = np.zeros(3)
            return
        step = before.inverse() @ map_from_base
        speed = log_se2(step) / seconds
        plausible = math.hypot(speed[0], speed[1]) < FASTEST_M_S and abs(speed[2]) < FASTEST_RAD_S
        self._velocity = speed if plausible else np.zeros(3)

    def moved(self, correction: Pose2) -> None:
        """The map has moved under the newest key scans: map_from_map."""
        if self.last is not None:
            stamp, pose, odom = self.last
            self.last = (stamp, correction @ pose, odom)
        self._recent = deque(((t, correction @ p) for t, p in self._recent), maxlen=self._recent.maxlen)


def _leaps(step: Pose2, seconds: float) -> bool:
    """Whether no robot moves so in that time: its odometry began anew, or was set."""
    way_m, turn_rad = math.hypot(step.x_m, step.y_m), abs(step.yaw_rad)
    return way_m > LEAP_M + LEAP_M_S * max(seconds, 0.0) or turn_rad > LEAP_RAD + FASTEST_RAD_S * max(seconds, 0.0)


def _along(step: Pose2) -> float:
    """The way of a step, negative backwards."""
    return math.copysign(math.hypot(step.x_m, step.y_m), step.x_m)
