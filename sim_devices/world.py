"""How far is the wall? Walls, furniture and people of a floor plan, measured in closed form by rays and by cones.

Everything is a segment or a circle with a material and a height. Distances are exact: no grid, no stepping. A beam
has its own origin and its own moment, so a scan taken on the move is distorted as a real one is.

A scanner that is tilted (a nodding mount) meets the same walls by their heights, and besides them the floor, pits in
it, the ceiling, and the tops and undersides of furniture: `ray_distances`.

Laser light: a wall answers. Glass answers only within a few degrees of the perpendicular and else lets the beam
pass. Black answers only near by (farther at right angles) and swallows the beam beyond. People are two legs.
Ultrasound: a surface answers where its nearest point within the cone is hit steeply enough (else the sound is
thrown aside), an end or a corner always, if nothing stands before it. Glass is a wall, soft things swallow.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sim_devices.floor_plan import CEILING_M, MATERIALS, FloorPlan, Point, WalkerPlan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

WALL, GLASS, BLACK, SOFT = range(len(MATERIALS))
GLASS_ANSWERS_WITHIN_RAD = math.radians(5.0)
BLACK_REACH_M = 6.0  # of a beam at right angles; less by the cosine at a slant
SONAR_INCIDENCE_LIMIT_RAD = math.radians(28.0)  # beyond it a flat wall throws the sound away
LEG_RADIUS_M = 0.07
LEG_OFFSET_M = 0.11
STRIDE_M = 1.3  # way of a person in which both legs made a step
LEG_SWING_M = 0.25
BODY_RADIUS_M = 0.22
PERSON_HEIGHT_M = 1.8
NOTHING_NEAR_M = 1e-9
STEEPEST_LEVEL = 1e-9  # level share of a beam that goes straight up or down
TABLE_TOP_M = 0.03
TURN = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class Segments:
    """Straight surfaces: a, b (S, 2) ends, material (S,), bottom_m and top_m (S,).

    solid: (S,) faces of bodies, which lie left of a to b: from there nothing of them is seen.
    """

    a: F64
    b: F64
    material: I64
    bottom_m: F64
    top_m: F64
    solid: Bools

    def at_height(self, z_m: float) -> Segments:
        """Those that a sensor at this height meets."""
        return self.only((self.bottom_m <= z_m) & (z_m <= self.top_m))

    def only(self, chosen: Bools) -> Segments:
        """A choice of them."""
        c = chosen
        return Segments(self.a[c], self.b[c], self.material[c], self.bottom_m[c], self.top_m[c], self.solid[c])


@dataclass(frozen=True, slots=True)
class Circles:
    """Round surfaces: center (C, 2), radius_m, material, bottom_m, top_m (C,)."""

    center: F64
    radius_m: F64
    material: I64
    bottom_m: F64
    top_m: F64

    def at_height(self, z_m: float) -> Circles:
        """Those that a sensor at this height meets."""
        seen = (self.bottom_m <= z_m) & (z_m <= self.top_m)
        return Circles(
            self.center[seen], self.radius_m[seen], self.material[seen], self.bottom_m[seen], self.top_m[seen]
        )


@dataclass(frozen=True, slots=True)
class Plates:
    """Level rectangles: center (P, 2), half_size_m (P, 2) along their own axes, yaw_rad (P,), z_m (P,).

    Floor and ceiling reach everywhere. pits: rows of this table whose rectangle is a hole in the floor.
    """

    center: F64
    half_size_m: F64
    yaw_rad: F64
    z_m: F64
    is_pit: Bools

    def hold(self, which: I64, point: F64) -> Bools:
        """Whether points (N, 2) lie within plates which (N,)."""
        off = point - self.center[which]
        c, s = np.cos(self.yaw_rad[which]), np.sin(self.yaw_rad[which])
        own = np.stack((c * off[:, 0] + s * off[:, 1], -s * off[:, 0] + c * off[:, 1]), axis=-1)
        inside: Bools = np.all(np.abs(own) <= self.half_size_m[which], axis=1)
        return inside


NO_PLATES = Plates(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.bool_))


class Walker:
    """A person on a fixed round, whose place at any time follows in closed form.

    seed: where on the round the person is at time 0, and how much faster or slower than planned (up to 15 %).
    """

    def __init__(self, plan: WalkerPlan, seed: int) -> None:
        random = np.random.default_rng(seed)
        points = np.array([*plan.points, plan.points[0]])
        legs = np.hypot(*np.diff(points, axis=0).T)
        speed = plan.speed_m_s * random.uniform(0.85, 1.15)
        self._knots_s, self._points, self._way_m = _timetable(points, legs, speed, plan.pause_s)
        self._round_s = float(self._knots_s[-1])
        self._knots: list[float] = self._knots_s.tolist()
        self._corners: list[Point] = [(float(x), float(y)) for x, y in self._points]
        self._offset_s = random.uniform(0.0, self._round_s)

    def place(self, stamp_s: F64) -> tuple[F64, F64, F64]:
        """Position (N, 2), heading (N,) and way walked within the round (N,) at times (N,)."""
        t = np.mod(stamp_s + self._offset_s, self._round_s)
        k = np.clip(np.searchsorted(self._knots_s, t, side="right") - 1, 0, len(self._knots_s) - 2)
        span = self._knots_s[k + 1] - self._knots_s[k]
        part = (t - self._knots_s[k]) / np.where(span > 0.0, span, 1.0)
        step = self._points[k + 1] - self._points[k]
        position = self._points[k] + part[:, None] * step
        way = self._way_m[k] + part * (self._way_m[k + 1] - self._way_m[k])
        return position, np.arctan2(step[:, 1], step[:, 0]), way

    def place_now(self, time_s: float) -> Point:
        """The position at one moment; as `place`, without arrays."""
        t = (time_s + self._offset_s) % self._round_s
        k = min(max(bisect_right(self._knots, t) - 1, 0), len(self._knots) - 2)
        span = self._knots[k + 1] - self._knots[k]
        part = (t - self._knots[k]) / span if span > 0.0 else 0.0
        (ax, ay), (bx, by) = self._corners[k], self._corners[k + 1]
        return (ax + part * (bx - ax), ay + part * (by - ay))

    def legs(self, stamp_s: F64) -> tuple[F64, F64]:
        """Centres (N, 2) of the left and the right leg."""
        position, heading, way = self.place(stamp_s)
        forward = np.stack((np.cos(heading), np.sin(heading)), axis=-1)
        left = np.stack((-forward[:, 1], forward[:, 0]), axis=-1) * LEG_OFFSET_M
        swing = forward * (LEG_SWING_M * np.sin(TURN * way / STRIDE_M))[:, None]
        return position + left + swing, position - left - swing


def _timetable(points: F64, legs: F64, speed: float, pause_s: float) -> tuple[F64, F64, F64]:
    """Knots of a round: times, points and ways walked; each point twice where there is a pause."""
    times, places, ways = [0.0], [points[0]], [0.0]
    for leg, target in zip(legs, points[1:]):
        for wait, walked in ((pause_s, 0.0), (leg / speed, leg)):
            times.append(times[-1] + wait)
            places.append(target if walked else places[-1])
            ways.append(ways[-1] + walked)
    return np.array(times), np.array(places), np.array(ways)


@dataclass(slots=True)
class World:
    """The surfaces of a floor plan and the people in it. Times are seconds since the world began."""

    segments: Segments
    circles: Circles
    walkers: list[Walker] = field(default_factory=list)
    plates: Plates = NO_PLATES
    _seen_at: dict[float, tuple[Segments, Circles]] = field(default_factory=dict)
    _bodies: tuple[float, F64] | None = None

    @staticmethod
    def from_plan(plan: FloorPlan, seed: int = 0) -> World:
        """Build the world of a floor plan; the seed moves the people only."""
        walkers = [Walker(w, seed * 1000 + i) for i, w in enumerate(plan.walkers)]
        return World(_segments_of(plan), _circles_of(plan), walkers, _plates_of(plan))

    def beam_distances(self, origin: F64, heading_rad: F64, stamp_s: F64, *, z_m: float, range_max_m: float) -> F64:
        """Distances that beams of light travel to the first surface that answers; +inf if none up to range_max_m.

        origin: (N, 2), heading_rad: (N,), stamp_s: (N,): each beam has its own place and moment.
        """
        if not len(heading_rad):
            return np.zeros(0)
        segments, circles = self._surfaces(z_m)
        rays = _Rays.of(origin, heading_rad)
        answer = np.full(len(heading_rad), np.inf)
        swallowed = np.full(len(heading_rad), np.inf)
        rays.meet_segments(segments, range_max_m, answer, swallowed)
        rays.meet_circles(circles.center, circles.radius_m, range_max_m, answer)
        if z_m <= PERSON_HEIGHT_M:
            rays.meet_people(self.walkers, stamp_s, range_max_m, answer)
        answer[(swallowed < answer) | (answer > range_max_m)] = np.inf
        return answer

    def ray_distances(self, origin: F64, direction: F64, stamp_s: F64, *, range_max_m: float) -> F64:
        """Distances that tilted beams travel to the first surface that answers; +inf if none up to range_max_m.

        origin: (N, 3), direction: (N, 3) unit vectors, stamp_s: (N,): each beam has its own place and moment.
        """
        if not len(direction):
            return np.zeros(0)
        level = np.maximum(np.hypot(direction[:, 0], direction[:, 1]), STEEPEST_LEVEL)
        tilt = _Tilt(origin[:, 2], direction[:, 2] / level, level)
        rays = _Rays.of(origin[:, :2], np.arctan2(direction[:, 1], direction[:, 0]), tilt)
        answer = np.full(len(direction), np.inf)
        swallowed = np.full(len(direction), np.inf)
        circles = self.circles
        rays.meet_segments(self.segments, range_max_m, answer, swallowed)
        rays.meet_circles(circles.center, circles.radius_m, range_max_m, answer, circles.bottom_m, circles.top_m)
        rays.meet_people(self.walkers, stamp_s, range_max_m, answer)
        rays.meet_plates(self.plates, answer)
        rays.meet_floor_and_ceiling(self.plates, answer)
        answer[swallowed < answer] = np.inf
        distance = answer / level
        return np.where(distance <= range_max_m, distance, np.inf)

    def floor_m(self, place: Point) -> float:
        """Height of the floor there: 0, or below in a pit."""
        pits = np.flatnonzero(self.plates.is_pit)
        inside = self.plates.hold(pits, np.broadcast_to(np.asarray(place, dtype=np.float64), (len(pits), 2)))
        return float(np.min(self.plates.z_m[pits][inside], initial=0.0))

    def cone_distance(
        self,
        origin: Point,
        heading_rad: float,
        half_angle_rad: float,
        stamp_s: float,
        *,
        z_m: float,
        range_max_m: float,
    ) -> float:
        """Distance of the nearest thing that an ultrasonic transducer hears within its cone; +inf if none.

        half_angle_rad: below pi / 2.
        """
        segments, circles = self._surfaces(z_m)
        here = np.asarray(origin, dtype=np.float64)
        segments = segments.only(np.hypot(*_nearest_points(segments.a - here, segments.b - here).T) <= range_max_m)
        centers, radii = self._round_things(circles, stamp_s, z_m)
        in_reach = np.hypot(*(centers - here).T) <= range_max_m + radii
        centers, radii = centers[in_reach], radii[in_reach]
        points = np.concatenate(
            (
                _echo_points(segments, here, heading_rad, half_angle_rad),
                _circle_points(centers, radii, here, heading_rad, half_angle_rad),
            )
        )
        distance = np.hypot(*(points - here).T)
        near = distance <= range_max_m
        for k in np.argsort(np.where(near, distance, np.inf))[: int(near.sum())]:
            if not _hidden(here, points[k], float(distance[k]), segments, centers, radii):
                return float(distance[k])
        return math.inf

    def _surfaces(self, z_m: float) -> tuple[Segments, Circles]:
        if z_m not in self._seen_at:
            self._seen_at[z_m] = (self.segments.at_height(z_m), self.circles.at_height(z_m))
        return self._seen_at[z_m]

    def _round_things(self, circles: Circles, stamp_s: float, z_m: float) -> tuple[F64, F64]:
        """Centres and radii of circles and people that a sonar meets."""
        if not self.walkers or z_m > PERSON_HEIGHT_M:
            return circles.center, circles.radius_m
        if self._bodies is None or self._bodies[0] != stamp_s:
            self._bodies = (stamp_s, np.array([w.place_now(stamp_s) for w in self.walkers]))
        bodies = self._bodies[1]
        radii = np.append(circles.radius_m, np.full(len(bodies), BODY_RADIUS_M))
        return np.concatenate((circles.center, bodies)), radii


# --- rays ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Tilt:
    """How beams leave the level: height at their origin, rise for each level metre, level share of their length."""

    z_m: F64
    climb: F64
    level: F64

    def misses(self, away: F64, beam: I64, bottom_m: F64 | float, top_m: F64 | float) -> Bools:
        """Whether beams pass above or below something at level distances away (P,)."""
        z = self.z_m[beam] + np.where(np.isfinite(away), away, 0.0) * self.climb[beam]
        return (z < bottom_m) | (z > top_m)


@dataclass(frozen=True, slots=True)
class _Rays:
    """Beams, and what is needed to test each surface only against the beams that can meet it.

    A surface fills an interval of bearings as seen from the middle of all origins. Seen from another origin at most
    `spread_m` away, a point at distance d is turned by at most asin(spread_m / d): the interval is widened by that.
    """

    origin: F64
    direction: F64
    order: NDArray[np.intp]  # of the beams by bearing
    bearing: F64  # (N,) in that order, in [0, 2 pi)
    middle: F64
    spread_m: float
    tilt: _Tilt | None = None

    @staticmethod
    def of(origin: F64, heading_rad: F64, tilt: _Tilt | None = None) -> _Rays:
        direction = np.stack((np.cos(heading_rad), np.sin(heading_rad)), axis=-1)
        bearing = np.mod(heading_rad, TURN)
        order = np.argsort(bearing, kind="stable")
        middle = 0.5 * (origin.min(axis=0) + origin.max(axis=0))
        spread = float(np.hypot(*(origin - middle).T).max())
        return _Rays(origin, direction, order, bearing[order], middle, spread, tilt)

    def meet_segments(self, segments: Segments, range_max_m: float, answer: F64, swallowed: F64) -> None:
        """Lower `answer` to the nearest segment that answers each beam, `swallowed` to the nearest that takes it."""
        a, b = segments.a - self.middle, segments.b - self.middle
        edge = b - a
        inside = edge[:, 0] * -a[:, 1] + edge[:, 1] * a[:, 0] > self.spread_m * np.hypot(edge[:, 0], edge[:, 1])
        front = ~(segments.solid & inside)
        segments, a, b = segments.only(front), a[front], b[front]
        nearest = np.hypot(*_nearest_points(a, b).T)
        from_rad = np.arctan2(a[:, 1], a[:, 0])
        turn = np.arctan2(b[:, 1], b[:, 0]) - from_rad
        turn = np.mod(turn + math.pi, TURN) - math.pi  # a segment never fills more than half a turn
        start = from_rad + np.minimum(turn, 0.0)
        which, beam = self._pairs(start, np.abs(turn), nearest, range_max_m)
        away, cosine = self._along_segments(segments, which, beam)
        if self.tilt is not None:
            away[self.tilt.misses(away, beam, segments.bottom_m[which], segments.top_m[which])] = np.inf
            cosine = cosine * self.tilt.level[beam]
        material = segments.material[which]
        away[(material == GLASS) & (cosine < math.cos(GLASS_ANSWERS_WITHIN_RAD))] = np.inf
        black = (material == BLACK) & (away > BLACK_REACH_M * cosine)
        if black.any():
            np.minimum.at(swallowed, beam[black], away[black])
            away[black] = np.inf
        np.minimum.at(answer, beam, away)

    def meet_circles(
        self,
        center: F64,
        radius_m: F64,
        range_max_m: float,
        answer: F64,
        bottom_m: F64 | None = None,
        top_m: F64 | None = None,
    ) -> None:
        """Lower `answer` to the nearest circle. bottom_m, top_m: for tilted beams."""
        which, beam = self._pairs_with_circles(center, radius_m, range_max_m)
        hit = _ray_circle(self.origin[beam], self.direction[beam], center[which], radius_m[which])
        if self.tilt is not None and bottom_m is not None and top_m is not None:
            hit[self.tilt.misses(hit, beam, bottom_m[which], top_m[which])] = np.inf
        np.minimum.at(answer, beam, hit)

    def meet_people(self, walkers: Sequence[Walker], stamp_s: F64, range_max_m: float, answer: F64) -> None:
        """Lower `answer` to the nearest leg, each beam at its own moment stamp_s (N,)."""
        for walker in walkers:
            ends = walker.place(np.array([stamp_s.min(), stamp_s.max()]))[0]
            around = LEG_OFFSET_M + LEG_SWING_M + LEG_RADIUS_M + float(np.hypot(*(ends[1] - ends[0])))
            _, beam = self._pairs_with_circles(ends[:1], np.array([around]), range_max_m)
            if len(beam):
                for leg in walker.legs(stamp_s[beam]):
                    hit = _ray_circle(self.origin[beam], self.direction[beam], leg, LEG_RADIUS_M)
                    if self.tilt is not None:
                        hit[self.tilt.misses(hit, beam, 0.0, PERSON_HEIGHT_M)] = np.inf
                    np.minimum.at(answer, beam, hit)

    def meet_plates(self, plates: Plates, answer: F64) -> None:
        """Lower `answer` to the nearest level plate that a tilted beam meets, from above or from below."""
        assert self.tilt is not None
        for k in np.flatnonzero(~plates.is_pit):
            away = self._level_m(float(plates.z_m[k]))
            met = np.flatnonzero(away < answer)
            point = self.origin[met] + away[met, None] * self.direction[met]
            met = met[plates.hold(np.full(len(met), k), point)]
            answer[met] = away[met]

    def meet_floor_and_ceiling(self, plates: Plates, answer: F64) -> None:
        """Lower `answer` to the floor, or the ground of the pit that a beam falls into, and to the ceiling."""
        np.minimum(answer, self._level_m(CEILING_M), out=answer)
        away = self._level_m(0.0)
        point = self.origin + np.where(np.isfinite(away), away, 0.0)[:, None] * self.direction
        for k in np.flatnonzero(plates.is_pit):
            falls = np.flatnonzero(plates.hold(np.full(len(point), k), point))
            away[falls] = self._level_m(float(plates.z_m[k]))[falls]
        np.minimum(answer, away, out=answer)

    def _level_m(self, z_m: float) -> F64:
        """(N,) level distances at which beams are at this height; +inf where they never are."""
        assert self.tilt is not None
        rise = z_m - self.tilt.z_m
        level = np.abs(self.tilt.climb) < 1e-12
        away = rise / np.where(level, 1.0, self.tilt.climb)
        return np.where(level | (away <= 0.0), np.inf, away)

    def _pairs_with_circles(self, center: F64, radius_m: F64, range_max_m: float) -> tuple[I64, I64]:
        to_center = center - self.middle
        away = np.hypot(*to_center.T)
        half = np.arcsin(np.minimum(1.0, radius_m / np.maximum(away, NOTHING_NEAR_M)))
        start = np.arctan2(to_center[:, 1], to_center[:, 0]) - half
        return self._pairs(start, 2.0 * half, away - radius_m, range_max_m)

    def _pairs(self, start: F64, width: F64, nearest_m: F64, range_max_m: float) -> tuple[I64, I64]:
        """Surfaces and beams that may meet: two index arrays of the same length.

        start, width: (S,) intervals of bearings.  nearest_m: (S,) distance of the surface from the middle.
        """
        around = nearest_m < 2.0 * self.spread_m + 1e-6
        margin = np.arcsin(np.minimum(1.0, self.spread_m / np.maximum(nearest_m, NOTHING_NEAR_M))) + 1e-9
        start = np.mod(np.where(around, 0.0, start - margin), TURN)
        stop = start + np.where(around, TURN, width + 2.0 * margin)
        low = np.concatenate((np.searchsorted(self.bearing, start), np.zeros(len(start), dtype=np.intp)))
        high = np.concatenate(
            (
                np.searchsorted(self.bearing, stop, side="right"),
                np.searchsorted(self.bearing, stop - TURN, side="right"),
            )
        )
        high[: len(start)][around] = len(self.bearing)
        low[: len(start)][around] = 0
        high[len(start) :][around] = 0
        out_of_reach = nearest_m - self.spread_m > range_max_m
        count = np.where(np.tile(out_of_reach, 2), 0, np.maximum(0, high - low))
        which = np.repeat(np.tile(np.arange(len(start)), 2), count)
        first = np.cumsum(count) - count
        position = np.arange(int(count.sum())) - np.repeat(first - low, count)
        return which.astype(np.int64), self.order[position].astype(np.int64)

    def _along_segments(self, segments: Segments, which: I64, beam: I64) -> tuple[F64, F64]:
        """Distances (P,) of the pairs' meetings, +inf where they miss, and cosines of the incidence angles."""
        a = segments.a[which] - self.origin[beam]
        edge = segments.b[which] - segments.a[which]
        d = self.direction[beam]
        across = d[:, 0] * edge[:, 1] - d[:, 1] * edge[:, 0]
        parallel = np.abs(across) < 1e-15
        safe = np.where(parallel, 1.0, across)
        away = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) / safe
        along = (a[:, 0] * d[:, 1] - a[:, 1] * d[:, 0]) / safe
        missed = parallel | (away <= 0.0) | (along < -1e-9) | (along > 1.0 + 1e-9)
        cosine = np.abs(across) / np.maximum(np.hypot(edge[:, 0], edge[:, 1]), NOTHING_NEAR_M)
        return np.where(missed, np.inf, away), cosine


def _nearest_points(a: F64, b: F64) -> F64:
    """(S, 2) points of segments nearest to the origin."""
    edge = b - a
    length2 = np.maximum(np.einsum("ij,ij->i", edge, edge), 1e-30)
    part = np.clip(-np.einsum("ij,ij->i", a, edge) / length2, 0.0, 1.0)
    return np.asarray(a + part[:, None] * edge)


def _ray_circle(origin: F64, direction: F64, center: F64, radius_m: F64 | float) -> F64:
    """Distances (N,) along rays to circles from outside; +inf where they miss or start inside."""
    to_center = center - origin
    along = np.einsum("ij,ij->i", to_center, direction)
    off2 = np.einsum("ij,ij->i", to_center, to_center) - along**2
    inside2 = np.asarray(radius_m, dtype=np.float64) ** 2 - off2
    away = along - np.sqrt(np.maximum(inside2, 0.0))
    return np.where((inside2 >= 0.0) & (away > 0.0), away, np.inf)


# --- cones ---------------------------------------------------------------------------------------------------------


def _echo_points(segments: Segments, here: F64, heading_rad: float, half_angle_rad: float) -> F64:
    """(E, 2) points of straight surfaces that would answer a sonar here, hidden or not."""
    hard = segments.material != SOFT
    a, b = segments.a[hard] - here, segments.b[hard] - here
    turned = np.array([[math.cos(heading_rad), -math.sin(heading_rad)], [math.sin(heading_rad), math.cos(heading_rad)]])
    a, b = a @ turned, b @ turned  # x axis along the cone's axis
    low, high = _clipped_to_cone(a, b, half_angle_rad)
    reached = low <= high
    a, b, low, high = a[reached], b[reached], low[reached], high[reached]
    edge = b - a
    length2 = np.maximum(np.einsum("ij,ij->i", edge, edge), 1e-30)
    foot = -np.einsum("ij,ij->i", a, edge) / length2
    part = np.clip(foot, low, high)
    point = a + part[:, None] * edge
    off_foot = np.abs(part - foot) * np.sqrt(length2)
    foot_away = np.hypot(*(a + foot[:, None] * edge).T)
    steep = off_foot <= math.tan(SONAR_INCIDENCE_LIMIT_RAD) * foot_away
    at_end = ((part == 0.0) | (part == 1.0)) & (part != foot)
    back: F64 = point[steep | at_end] @ turned.T + here
    return back


def _clipped_to_cone(a: F64, b: F64, half_angle_rad: float) -> tuple[F64, F64]:
    """The part [low, high] of each segment a + t (b - a) within the cone about +x; low > high where none."""
    low, high = np.zeros(len(a)), np.ones(len(a))
    s, c = math.sin(half_angle_rad), math.cos(half_angle_rad)
    for normal in (np.array([s, -c]), np.array([s, c])):  # inside: normal . p >= 0
        at_a, at_b = a @ normal, b @ normal
        change = at_b - at_a
        flat = np.abs(change) < 1e-15
        crossing = -at_a / np.where(flat, 1.0, change)
        low = np.where(~flat & (change > 0.0), np.maximum(low, crossing), low)
        high = np.where(~flat & (change < 0.0), np.minimum(high, crossing), high)
        high = np.where(flat & (at_a < 0.0), -1.0, high)
    return low, high


def _circle_points(centers: F64, radii: F64, here: F64, heading_rad: float, half_angle_rad: float) -> F64:
    """(E, 2) nearest points of circles that reach into the cone from outside."""
    if not len(centers):
        return np.zeros((0, 2))
    to_center = centers - here
    away = np.hypot(*to_center.T)
    bearing = np.arctan2(to_center[:, 1], to_center[:, 0])
    off = np.abs(np.mod(bearing - heading_rad + math.pi, TURN) - math.pi)
    outside = away > radii
    half_seen = np.arcsin(np.minimum(1.0, radii / np.maximum(away, NOTHING_NEAR_M)))
    heard = outside & (off <= half_angle_rad + half_seen)
    # A circle whose centre lies outside the cone answers from where the cone's edge meets it: nearly its nearest point.
    side = np.clip(np.mod(bearing - heading_rad + math.pi, TURN) - math.pi, -half_angle_rad, half_angle_rad)
    direction = np.stack((np.cos(heading_rad + side), np.sin(heading_rad + side)), axis=-1)
    reach = _ray_circle(np.broadcast_to(here, centers.shape), direction, centers, radii)
    heard &= np.isfinite(reach)
    return np.asarray(here + direction[heard] * reach[heard, None])


def _hidden(here: F64, point: F64, distance: float, segments: Segments, centers: F64, radii: F64) -> bool:
    """Whether something stands between here and a point at this distance."""
    if distance <= NOTHING_NEAR_M:
        return False
    d = (point - here) / distance
    a = segments.a - here
    edge = segments.b - segments.a
    across = d[0] * edge[:, 1] - d[1] * edge[:, 0]
    safe = np.where(np.abs(across) < 1e-15, np.inf, across)
    away = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) / safe
    along = (a[:, 0] * d[1] - a[:, 1] * d[0]) / safe
    if np.any((away > 1e-9) & (away < distance - 1e-6) & (along > 1e-9) & (along < 1.0 - 1e-9) & np.isfinite(safe)):
        return True
    if not len(centers):
        return False
    ray = np.broadcast_to(d, centers.shape)
    return bool(np.any(_ray_circle(np.broadcast_to(here, centers.shape), ray, centers, radii) < distance - 1e-6))


# --- from the plan to surfaces --------------------------------------------------------------------------------------


def _segments_of(plan: FloorPlan) -> Segments:
    rows: list[_Face] = []
    for wall in plan.walls:
        for a, b in zip(wall.points, wall.points[1:]):
            rows += _faces(_slab(a, b, wall.thickness_m), wall.material, wall.bottom_m, wall.top_m)
    for door in plan.doors:
        swung = math.radians(door.closed_deg + door.open_deg)
        tip = (door.hinge[0] + door.width_m * math.cos(swung), door.hinge[1] + door.width_m * math.sin(swung))
        rows += _faces(_slab(door.hinge, tip, door.thickness_m, overlap=False), door.material, 0.0, CEILING_M)
    for pit in plan.pits:
        around = _corners(pit.center, pit.size_m, pit.yaw_deg)
        for a, b in zip(around, around[1:] + around[:1]):
            rows += _faces([a, b], "wall", -pit.depth_m, -0.001)  # a level sensor on the floor does not see it
    for box in plan.boxes:
        rows += _faces(_corners(box.center, box.size_m, box.yaw_deg), box.material, box.bottom_m, box.top_m)
    return Segments(
        np.array([r[0] for r in rows], dtype=np.float64).reshape(-1, 2),
        np.array([r[1] for r in rows], dtype=np.float64).reshape(-1, 2),
        np.array([r[2] for r in rows], dtype=np.int64),
        np.array([r[3] for r in rows], dtype=np.float64),
        np.array([r[4] for r in rows], dtype=np.float64),
        np.array([r[5] for r in rows], dtype=np.bool_),
    )


_Face = tuple[Point, Point, int, float, float, bool]


def _faces(corners: Sequence[Point], material: str, bottom_m: float, top_m: float) -> list[_Face]:
    """Faces of a body with these corners, counter-clockwise; of two corners the single face between them."""
    if not corners:
        return []
    solid = len(corners) > 2
    closed = [*corners, corners[0]] if solid else list(corners)
    return [(a, b, MATERIALS.index(material), bottom_m, top_m, solid) for a, b in itertools.pairwise(closed)]


def _slab(a: Point, b: Point, thickness_m: float, *, overlap: bool = True) -> list[Point]:
    """Outline of a wall with the middle line a-b, longer by half its thickness at both ends so that corners close."""
    length = math.dist(a, b)
    if length <= 0.0:
        return []
    ux, uy = (b[0] - a[0]) / length, (b[1] - a[1]) / length
    if thickness_m == 0.0:
        return [a, b]
    h = 0.5 * thickness_m
    e = h if overlap else 0.0
    return [
        (a[0] - e * ux + h * uy, a[1] - e * uy - h * ux),
        (b[0] + e * ux + h * uy, b[1] + e * uy - h * ux),
        (b[0] + e * ux - h * uy, b[1] + e * uy + h * ux),
        (a[0] - e * ux - h * uy, a[1] - e * uy + h * ux),
    ]


def _corners(center: Point, size_m: Point, yaw_deg: float) -> list[Point]:
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    half = [(sx * size_m[0] / 2.0, sy * size_m[1] / 2.0) for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return [(center[0] + c * x - s * y, center[1] + s * x + c * y) for x, y in half]


def _plates_of(plan: FloorPlan) -> Plates:
    """Tops and undersides of boxes and tables, and pits."""
    rows: list[tuple[Point, Point, float, float, bool]] = []
    for box in plan.boxes:
        rows.append((box.center, box.size_m, box.yaw_deg, box.top_m, False))
        if box.bottom_m > 0.0:
            rows.append((box.center, box.size_m, box.yaw_deg, box.bottom_m, False))
    for table in plan.tables:
        for z_m in (table.top_m, table.top_m - TABLE_TOP_M):
            rows.append((table.center, table.size_m, table.yaw_deg, z_m, False))
    rows += [(pit.center, pit.size_m, pit.yaw_deg, -pit.depth_m, True) for pit in plan.pits]
    return Plates(
        np.array([r[0] for r in rows], dtype=np.float64).reshape(-1, 2),
        0.5 * np.array([r[1] for r in rows], dtype=np.float64).reshape(-1, 2),
        np.radians(np.array([r[2] for r in rows], dtype=np.float64)),
        np.array([r[3] for r in rows], dtype=np.float64),
        np.array([r[4] for r in rows], dtype=np.bool_),
    )


def _circles_of(plan: FloorPlan) -> Circles:
    rows = [(c.center, c.radius_m, MATERIALS.index(c.material), c.bottom_m, c.top_m) for c in plan.circles]
    for table in plan.tables:
        inset = (table.size_m[0] - 2.0 * table.leg_radius_m, table.size_m[1] - 2.0 * table.leg_radius_m)
        for corner in _corners(table.center, inset, table.yaw_deg):
            rows.append((corner, table.leg_radius_m, WALL, 0.0, table.top_m))
    return Circles(
        np.array([r[0] for r in rows], dtype=np.float64).reshape(-1, 2),
        np.array([r[1] for r in rows], dtype=np.float64),
        np.array([r[2] for r in rows], dtype=np.int64),
        np.array([r[3] for r in rows], dtype=np.float64),
        np.array([r[4] for r in rows], dtype=np.float64),
    )
