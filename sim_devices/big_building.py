"""A large building drawn from a few numbers and a seed: corridors between crossings, doors that repeat, some glass.

    rows of corridors along x at `rows_m`, columns along y at `columns_m`; both as crossings name them: (column, row)

A corridor is two walls with a door every few metres: a shallow niche, or an open door with a bare room behind. A part
of the walls is glass, here and there stands a bin or a bench. Crossings are as wide as the corridors, or lobbies. What
a robot sees between two crossings hardly differs from one corridor to the next: that is the point of it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim_devices.floor_plan import Box, Circle, FloorPlan, Point, Route, Wall

Crossing = tuple[int, int]
PlaceAt = Callable[..., Point]

DOOR_M = 1.0
NICHE_M = 0.12
WEAVE_M = 0.25  # people do not steer along the middle line
WEAVE_EVERY_M = 12.0


@dataclass(frozen=True, slots=True)
class BigBuilding:
    """columns_m, rows_m: where corridors lie.  tour: crossings in the order they are driven.  half_m: of a corridor's
    width.  door_every_m: between doors.  open_share, glass_share: of doors and of the pieces of wall between doors.
    bare: no niches, bins or benches, nothing but straight walls between crossings; bare_share: of the corridors, those
    that are so in any case.  alike: doors stand at the same places in every corridor, no crossing is a lobby."""

    columns_m: tuple[float, ...]
    rows_m: tuple[float, ...]
    tour: tuple[Crossing, ...]
    half_m: float = 1.25
    door_every_m: float = 3.6
    open_share: float = 0.08
    glass_share: float = 0.05
    bare: bool = False
    bare_share: float = 0.0
    alike: bool = False
    speed_m_s: float = 0.9

    def plan(self, seed: int) -> FloorPlan:
        """The floor plan; the seed decides over doors, glass, lobbies, bins and how the robot weaves."""
        draft = _Draft(self, np.random.default_rng(seed))
        return draft.plan()


class _Draft:
    def __init__(self, building: BigBuilding, rng: np.random.Generator) -> None:
        self._b, self._rng = building, rng
        self._walls: list[Wall] = []
        self._boxes: list[Box] = []
        self._circles: list[Circle] = []
        self._half: dict[Crossing, float] = {}

    def plan(self) -> FloorPlan:
        pairs = {tuple(sorted(pair)) for pair in self._legs()}
        for crossing in sorted({c for pair in pairs for c in pair}):
            lobby = self._rng.random() < 0.35 and not self._b.alike
            self._half[crossing] = self._b.half_m + (float(self._rng.uniform(0.8, 2.5)) if lobby else 0.0)
        open_sides = {(a, _side(a, b)) for pair in pairs for a, b in (pair, pair[::-1])}
        for crossing in self._half:
            self._crossing(crossing, {side for at, side in open_sides if at == crossing})
        for a, b in sorted(pairs):
            self._corridor(a, b)
        return FloorPlan(
            "big building", tuple(self._walls), (), tuple(self._boxes), (), tuple(self._circles), route=self._route()
        )

    def _legs(self) -> list[tuple[Crossing, Crossing]]:
        """Neighbouring crossings along the tour."""
        legs = []
        for (ca, ra), (cb, rb) in itertools.pairwise(self._b.tour):
            if (ca == cb) == (ra == rb):
                raise ValueError(f"no corridor leads from {(ca, ra)} to {(cb, rb)}")
            steps = max(abs(cb - ca), abs(rb - ra))
            step = (int(np.sign(cb - ca)), int(np.sign(rb - ra)))
            legs += [
                ((ca + k * step[0], ra + k * step[1]), (ca + (k + 1) * step[0], ra + (k + 1) * step[1]))
                for k in range(steps)
            ]
        return legs

    def _place(self, crossing: Crossing) -> Point:
        return self._b.columns_m[crossing[0]], self._b.rows_m[crossing[1]]

    def _crossing(self, crossing: Crossing, open_sides: set[int]) -> None:
        """Walls around a crossing: whole where no corridor leaves, else left and right of it."""
        (x, y), half, door = self._place(crossing), self._half[crossing], self._b.half_m
        for side in range(4):
            along, out = _turned((0.0, 1.0), side), _turned((1.0, 0.0), side)
            spans = [(-half, -door), (door, half)] if side in open_sides else [(-half, half)]
            for low, high in spans:
                if high > low:
                    ends = [(x + half * out[0] + t * along[0], y + half * out[1] + t * along[1]) for t in (low, high)]
                    self._walls.append(Wall(tuple(ends), 0.0))

    def _corridor(self, a: Crossing, b: Crossing) -> None:
        """Both walls of a corridor, and what stands in it."""
        side = _side(a, b)
        along, left = _turned((1.0, 0.0), side), _turned((0.0, 1.0), side)
        start, end = self._place(a), self._place(b)
        length = abs(end[0] - start[0]) + abs(end[1] - start[1]) - self._half[a] - self._half[b]
        begin = (start[0] + self._half[a] * along[0], start[1] + self._half[a] * along[1])
        bare = self._b.bare or (self._b.bare_share > 0.0 and self._rng.random() < self._b.bare_share)
        for hand in (1.0, -1.0):
            self._wall(begin, along, (hand * left[0], hand * left[1]), length, bare=bare)

    def _wall(self, begin: Point, along: Point, out: Point, length: float, *, bare: bool) -> None:
        """One wall of a corridor: out points from its middle to this wall."""

        def at(t: float, depth: float = 0.0) -> Point:
            off = self._b.half_m + depth
            return begin[0] + t * along[0] + off * out[0], begin[1] + t * along[1] + off * out[1]

        if bare:
            self._walls.append(Wall((at(0.0), at(length)), 0.0))
            return
        rng, t = self._rng, 0.0
        door = 2.0 if self._b.alike else float(rng.uniform(0.8, 0.8 + self._b.door_every_m))
        while door + DOOR_M < length - 0.5:
            material = "glass" if rng.random() < self._b.glass_share else "wall"
            self._walls.append(Wall((at(t), at(door)), 0.0, material))
            if rng.random() < self._b.open_share:
                self._room(at, door)
            else:
                corners = (at(door), at(door, NICHE_M), at(door + DOOR_M, NICHE_M), at(door + DOOR_M))
                self._walls.append(Wall(corners, 0.0))
            self._clutter(at, door + DOOR_M + 0.8)
            t, door = door + DOOR_M, door + self._b.door_every_m
        self._walls.append(Wall((at(t), at(length)), 0.0))

    def _room(self, at: PlaceAt, door: float) -> None:
        """A bare room behind an open door."""
        depth, wide = float(self._rng.uniform(3.0, 5.0)), float(self._rng.uniform(0.3, 0.8))
        left, right, thick = door - wide, door + DOOR_M + wide, NICHE_M
        near = (at(door), at(door, thick), at(left, thick), at(left, depth))
        far = (at(right, depth), at(right, thick), at(door + DOOR_M, thick), at(door + DOOR_M))
        self._walls.append(Wall((*near, *far), 0.0))

    def _clutter(self, at: PlaceAt, t: float) -> None:
        """Seldom a bin or a bench by the wall."""
        kind = self._rng.random()
        if kind < 0.04:
            self._circles.append(Circle(at(t, -0.25), 0.2))
        elif kind < 0.07:
            a, b = at(t, -0.2), at(t + 1.2, -0.2)
            flat = abs(a[0] - b[0]) > abs(a[1] - b[1])
            center = (0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]))
            self._boxes.append(Box(center, (1.2, 0.4) if flat else (0.4, 1.2)))

    def _route(self) -> Route:
        """From crossing to crossing, weaving a little between."""
        points: list[Point] = [self._place(self._b.tour[0])]
        for a, b in itertools.pairwise(self._b.tour):
            start, end = np.array(self._place(a)), np.array(self._place(b))
            length = float(np.hypot(*(end - start)))
            count = max(0, math.floor((length - 8.0) / WEAVE_EVERY_M))
            across = np.array([-(end - start)[1], (end - start)[0]]) / length
            for k in range(count):
                share = (4.0 + (k + 0.5) * (length - 8.0) / count) / length
                p = start + share * (end - start) + float(self._rng.uniform(-WEAVE_M, WEAVE_M)) * across
                points.append((float(p[0]), float(p[1])))
            points.append((float(end[0]), float(end[1])))
        return Route(tuple(points), speed_m_s=self._b.speed_m_s, corner_radius_m=0.7)


def _side(a: Crossing, b: Crossing) -> int:
    """In which quarter turn from +x the other crossing lies."""
    return {(1, 0): 0, (0, 1): 1, (-1, 0): 2, (0, -1): 3}[(int(np.sign(b[0] - a[0])), int(np.sign(b[1] - a[1])))]


def _turned(v: Point, quarters: int) -> Point:
    x, y = v
    for _ in range(quarters):
        x, y = -y, x
    return x, y
