"""A map of many places without one global frame: a graph of openings and places, each place with its own metric map.

    hybrid = HierarchicalMap()
    where = hybrid.take(lines, step, covariance)    # at every scan
    where.place, where.pose                         # in a place: metric, in the frame of the place
    where.link, where.way_m                         # on a hallway: between which openings, how far along
    route(hybrid.graph(), "place 0", "place 3")     # mapping.topology.queries

Rooms are leaves: a local line map, and the extended Kalman filter of S46 in it. Hallways are chains of links between
openings; corners and openings along them are the landmarks that tell progress and arrival. Passing an opening switches
from one to the other. Errors stay where they were made: nothing is bent to fit elsewhere.
An opening that was passed before leads where it led. Behind a new one lies a known area only if the graph puts it there
and its walls are seen; else a new one. Source: S45, hierarchical hybrid map [TNS03].
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import networkx as nx
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import IDENTITY, Pose2, wrap_angle
from mapping.hybrid.places import (
    Area,
    Corner,
    HybridRules,
    Kind,
    Opening,
    as_known,
    corners_in,
    crossing,
    find_in,
    hallway_along,
    known_share,
    not_through,
    openings_in,
)
from mapping.hybrid.way_along import WayAlong
from mapping.lines.lines import Lines
from mapping.localise.ekf import LineEkf

F64 = NDArray[np.float64]

_VERSION: Final = 1
_ENTERED: Final = np.diag([0.08**2, 0.08**2, 0.04**2])  # of a pose behind an opening that was passed before
_DOUBTED: Final = np.diag([0.3**2, 0.3**2, 0.1**2])  # the same where the walls do not bear it out
_SURE_SEEN: Final = 3  # scans, of an opening that is told
_GUESSED: Final = np.diag([0.2**2, 0.2**2, 0.08**2])  # of a pose told by an opening that is seen from two sides
_ENOUGH_SHARE: Final = 0.4
_ABOUT: Final = Pose2(0.0, 0.0, math.pi)


@dataclass(frozen=True, slots=True)
class Link:
    """A stretch of a hallway between neighbouring openings: the nodes at its ends, its length, its corners in order."""

    start: str
    end: str
    length_m: float
    corners: tuple[Corner, ...]


@dataclass(frozen=True, slots=True)
class Where:
    """Where the robot is, on both levels.

    area: number of the place or hallway; None: lost.  pose: of the base in the frame of the area.
    covariance: (3, 3) of x, y, yaw there.  place: the node, in a place.  link: the nodes before and behind, on a
    hallway; at its ends one is None.  way_m: along the hallway from its first opening.  corners: known landmarks
    that were matched.  leaving: the robot is in an opening, and the area is the one that it leaves.
    """

    area: int | None
    kind: Kind | None
    pose: Pose2 | None
    covariance: F64 | None
    place: str | None = None
    link: tuple[str | None, str | None] | None = None
    way_m: float | None = None
    corners: int = 0
    leaving: bool = False


@dataclass(frozen=True, slots=True)
class _Leaving:
    """An opening is being passed."""

    opening: int


class HierarchicalMap:
    """See the module's docstring. Same calls, same map, bit for bit."""

    def __init__(self, rules: HybridRules | None = None) -> None:
        self.rules = rules or HybridRules()
        self.areas: list[Area] = []
        self.revisits = 0
        self.loops = 0
        self.dismissed = 0
        self.doubtful = 0
        self._at: int | None = None
        self._ekf: LineEkf | None = None
        self._along: WayAlong | None = None
        self._leaving: _Leaving | None = None
        self._matched = 0

    # --- driving

    def take(self, lines: Lines, step: Pose2, covariance: ArrayLike) -> Where:
        """One scan and the motion since the last.

        lines: of the scan, base frame, counter-clockwise as an extractor gives them.  step: of the base, in its own
        frame before; covariance: (3, 3) of it there.  Raises ValueError if a number is not finite; nothing is changed.
        """
        noise = np.array(covariance, dtype=np.float64)
        numbers = (step.x_m, step.y_m, step.yaw_rad)
        if not (all(map(math.isfinite, numbers)) and noise.shape == (3, 3) and np.all(np.isfinite(noise))):
            raise ValueError("a step is finite, its covariance (3, 3) and finite")
        if not np.all(np.isfinite(lines.rows)):
            raise ValueError("lines must be finite")
        if self._at is None:
            self._begin(lines)
            return self.where()
        before = self._pose()
        self._predict(step, noise)
        if self._leaving is None:
            self._look_for_crossing(before)
        if self._leaving is None:
            self._observe(lines)
        else:
            self._pass_through(lines)
        return self.where()

    def where(self) -> Where:
        """As of the last scan."""
        if self._at is None:
            return Where(None, None, None, None)
        area, pose = self.areas[self._at], self._pose()
        leaving = self._leaving is not None
        if area.kind is Kind.PLACE:
            return Where(area.number, area.kind, pose, self._covariance(), _name(area), leaving=leaving)
        nodes = self._nodes(area)
        behind = [name for way, name in nodes if way <= pose.x_m]
        ahead = [name for way, name in nodes if way > pose.x_m]
        link = (behind[-1] if behind else None, ahead[0] if ahead else None)
        return Where(
            area.number, area.kind, pose, self._covariance(), None, link, pose.x_m, self._matched, leaving
        )  # fmt: skip

    # --- questions

    def graph(self) -> nx.Graph[Any]:
        """Places and openings of hallways as nodes, ways between them as edges with length_m.

        "place 3" is a place (data: kind, area), "node 2.0" opening 0 of hallway 2. A route's corners are in `links`.
        """
        graph: nx.Graph[Any] = nx.Graph()
        for area in self.areas:
            if area.kind is Kind.PLACE:
                graph.add_node(_name(area), kind="place", area=area.number)
            for k in self._told(area) if area.kind is Kind.HALLWAY else ():
                graph.add_node(f"node {area.number}.{k}", kind="opening", area=area.number)
        for link in self.links():
            graph.add_edge(link.start, link.end, length_m=link.length_m)
        for area in self.areas:
            for k, opening in enumerate(area.openings):
                if opening.leads_to is not None and opening.leads_to > (area.number, k):
                    other, there = self.areas[opening.leads_to[0]], opening.leads_to[1]
                    length = _inside_m(area, opening) + _inside_m(other, other.openings[there])
                    graph.add_edge(_node(area, k), _node(other, there), length_m=length)
        return graph

    def links(self) -> list[Link]:
        """Of all hallways, in order along each."""
        found = []
        for area in self.areas:
            if area.kind is not Kind.HALLWAY:
                continue
            nodes = self._nodes(area)
            for (low, start), (high, end) in pairwise(nodes):
                corners = tuple(c for c in area.corner_list() if low <= c.point_m[0] <= high)
                found.append(Link(start, end, high - low, corners))
        return found

    def recognise(self, lines: Lines) -> tuple[int, Pose2] | None:
        """The area in which a scan (base frame) was taken and the pose there, without a hint; None: unknown.

        Unknown, too, where another place, or the same from elsewhere, fits nearly as well.
        """
        found = [
            (self._share_at(lines, area, pose), area.number, pose)
            for area in self.areas
            for _, pose in find_in(lines, self._walls(area), self.rules)
            if not any(_is_just_behind(area.openings[k], pose) for k in self._told(area))
        ]
        found.sort(key=lambda each: (-each[0], each[1]))
        if not found or found[0][0] < self.rules.same_share:
            return None
        if len(found) > 1 and found[1][0] > found[0][0] - self.rules.lead:
            return None
        return found[0][1], found[0][2]

    # --- keeping

    def state(self) -> dict[str, Any]:
        """For JSON. Where the robot is, is not kept: after loading it is recognised, or lost."""
        self._remember()
        return {"version": _VERSION, "areas": [area.state() for area in self.areas]}

    @staticmethod
    def from_state(state: Mapping[str, Any], rules: HybridRules | None = None) -> HierarchicalMap:
        """The map of `state`. Raises ValueError if it is not one, whole."""
        made = HierarchicalMap(rules)
        try:
            if state["version"] != _VERSION:
                raise ValueError(f"version {state['version']}")
            made.areas = [Area.from_state(each) for each in state["areas"]]
            for k, area in enumerate(made.areas):
                if area.number != k:
                    raise ValueError(f"area {area.number} stands at {k}")
                for n, opening in enumerate(area.openings):
                    if opening.leads_to is not None:
                        there, at = opening.leads_to
                        if min(there, at) < 0 or made.areas[there].openings[at].leads_to != (k, n):
                            raise ValueError(f"opening {n} of area {k} does not lead back")
        except (KeyError, TypeError, IndexError, AttributeError, OverflowError, ValueError) as error:
            raise ValueError(f"not a hierarchical map: {error}") from error
        return made

    # --- where in the area

    def _pose(self) -> Pose2:
        if self._ekf is not None:
            return self._ekf.pose
        assert self._along is not None
        return self._along.pose

    def _covariance(self) -> F64:
        if self._ekf is not None:
            return self._ekf.pose_covariance
        assert self._along is not None
        return self._along.covariance.copy()

    def _predict(self, step: Pose2, covariance: F64) -> None:
        mover = self._along if self._ekf is None else self._ekf
        assert mover is not None
        mover.predict(step, covariance)

    def _observe(self, lines: Lines) -> None:
        """Localise by one scan, then learn from it."""
        assert self._at is not None
        area, here = self.areas[self._at], self._pose()
        in_area = lines.transformed(here)
        seen = openings_in(in_area, (here.x_m, here.y_m), self.rules)
        own = not_through(in_area, (here.x_m, here.y_m), [*area.openings, *seen])
        from_base = own.transformed(here.inverse())
        if self._ekf is not None:
            self._ekf.update(from_base)
        else:
            assert self._along is not None
            corners = corners_in(from_base, self.rules)
            openings = openings_in(lines, (0.0, 0.0), self.rules)
            self._matched = self._along.correct(from_base, corners, openings, area)
            self._along.learn(corners, area)
        now = self._pose()
        area.walls.insert(from_base, now)
        own, everything = from_base.transformed(now), lines.transformed(now)
        for opening in openings_in(own, (now.x_m, now.y_m), self.rules, everything):
            _note(area, opening, self.rules)

    # --- between areas

    def _look_for_crossing(self, before: Pose2) -> None:
        assert self._at is not None
        after = self._pose()
        for k, opening in enumerate(self.areas[self._at].openings):
            sure = opening.leads_to is not None or opening.seen >= _SURE_SEEN
            if sure and not opening.dismissed and crossing(before, after, opening):
                self._leaving = _Leaving(k)
                return

    def _pass_through(self, lines: Lines) -> None:
        """Within an opening only the wheels count; through it, look; or back in."""
        assert self._at is not None
        assert self._leaving is not None
        area = self.areas[self._at]
        opening = area.openings[self._leaving.opening]
        beyond = opening.outward().inverse() @ self._pose()
        if beyond.x_m < -0.2:
            self._leaving = None
        elif beyond.x_m >= self.rules.beyond_m:
            self._arrive(lines, area, self._leaving.opening)
            self._leaving = None

    def _arrive(self, lines: Lines, area: Area, number: int) -> None:
        opening, here = area.openings[number], self._pose()
        back = Opening(opening.right_m, opening.left_m)
        place = here.x_m, here.y_m
        in_area = not_through(lines.transformed(here), place, [back])
        if opening.leads_to is not None:
            self._remember()
            self._go_back_to(lines, opening, here)
        elif known_share(in_area, self._walls(area), self.rules) > 0.5:
            opening.dismissed = True  # between furniture: the same room on its other side
            self.dismissed += 1
        else:
            self._remember()
            behind = in_area.transformed(here.inverse())
            known = self._known_behind(behind, area, opening, here)
            if known is None:
                self._found_new(behind, area, number, here)
            else:
                self._join(area, number, *known, here)
                self.loops += 1

    def _go_back_to(self, lines: Lines, opening: Opening, here: Pose2) -> None:
        """Through an opening that was passed before."""
        assert opening.leads_to is not None
        assert opening.there_from_here is not None
        area = self.areas[opening.leads_to[0]]
        expected = opening.there_from_here @ here
        share = self._share_at(lines, area, expected)
        covariance = _ENTERED
        if share < _ENOUGH_SHARE:
            settled = self._settled(lines, area, expected)
            if _is_near(settled, expected, 0.5) and self._share_at(lines, area, settled) >= _ENOUGH_SHARE:
                expected = settled
            else:
                self.doubtful += 1
                covariance = _DOUBTED
        area.visits += 1
        self.revisits += 1
        self._enter(area, expected, covariance)

    def _known_behind(self, lines: Lines, area: Area, opening: Opening, here: Pose2) -> tuple[Area, Pose2] | None:
        """The area known already that lies behind an opening never passed, and the pose in it."""
        best: list[tuple[float, Area, Pose2]] = []
        for number, (there_from_here, way) in self._frames_from(area.number).items():
            other = self.areas[number]
            if number == area.number:
                continue
            expected = there_from_here @ here
            slack = self.rules.loop_m + self.rules.loop_share * way
            fits = find_in(lines, self._walls(other), self.rules)
            for seen in other.openings:  # a hallway looks alike all along: its openings tell
                if seen.leads_to is None and seen.seen >= _SURE_SEEN:
                    pose = self._settled(lines, other, seen.outward() @ _ABOUT @ opening.outward().inverse() @ here)
                    fits.append((self._share_at(lines, other, pose), pose))
            near = [fit for fit in fits if fit[0] >= self.rules.same_share and _is_near(fit[1], expected, slack)]
            if near:
                share, pose = max(near, key=lambda fit: fit[0])
                best.append((share, other, pose))
        best.sort(key=lambda each: (-each[0], each[1].number))
        if not best or (len(best) > 1 and best[1][0] > best[0][0] - self.rules.lead):
            return None
        return best[0][1], best[0][2]

    def _frames_from(self, number: int) -> dict[int, tuple[Pose2, float]]:
        """Frames of all areas that ways lead to from one: (there_from_here, length of the way), fewest openings first.

        Only good enough to tell what is about where: errors of all areas on the way add up."""
        found: dict[int, tuple[Pose2, float]] = {number: (IDENTITY, 0.0)}
        waiting = deque([number])
        while waiting:
            at = waiting.popleft()
            pose, way = found[at]
            for opening in self.areas[at].openings:
                if opening.leads_to is None or opening.leads_to[0] in found:
                    continue
                assert opening.there_from_here is not None
                found[opening.leads_to[0]] = (
                    opening.there_from_here @ pose,
                    way + math.hypot(*opening.centre) + opening.width_m,
                )
                waiting.append(opening.leads_to[0])
        return found

    def _found_new(self, lines: Lines, area: Area, number: int, here: Pose2) -> None:
        opening_from_base = area.openings[number].outward().inverse() @ here
        direction = hallway_along(lines, (0.0, 0.0), self.rules)
        if direction is None:
            other, pose = Area(len(self.areas), Kind.PLACE), opening_from_base
        else:
            other = Area(len(self.areas), Kind.HALLWAY)
            direction += opening_from_base.yaw_rad  # in the frame of the opening
            if math.cos(direction) < 0.0:
                direction += math.pi
            pose = Pose2(0.0, 0.0, wrap_angle(-direction)) @ opening_from_base
        self.areas.append(other)
        self._join(area, number, other, pose, here)

    def _join(self, area: Area, number: int, other: Area, pose: Pose2, here: Pose2) -> None:
        """The opening leads to another area, in which the robot is at `pose`."""
        opening = area.openings[number]
        there_from_here = pose @ here.inverse()
        left, right = there_from_here.apply(np.array([opening.right_m, opening.left_m]))
        seen = Opening((float(left[0]), float(left[1])), (float(right[0]), float(right[1])), _SURE_SEEN)
        free = [k for k, each in enumerate(other.openings) if each.leads_to is None]
        same = [k for k in free if math.dist(other.openings[k].centre, seen.centre) < 2.0 * self.rules.landmark_m]
        at = same[0] if same else len(other.openings)
        if not same:
            other.openings.append(seen)
        back = other.openings[at]
        back.dismissed = False
        opening.leads_to, opening.there_from_here = (other.number, at), there_from_here
        back.leads_to, back.there_from_here = (area.number, number), there_from_here.inverse()
        self._enter(other, pose, _ENTERED if other.known is not None or other.corners else np.zeros((3, 3)))

    def _begin(self, lines: Lines) -> None:
        """The first scan: of a new map the first area; in a loaded one the robot is somewhere, or lost."""
        if self.areas:
            found = self.recognise(lines)
            if found is not None:
                area = self.areas[found[0]]
                area.visits += 1
                self.revisits += 1
                self._enter(area, found[1], _ENTERED)
            return
        if not len(lines):
            return
        direction = hallway_along(lines, (0.0, 0.0), self.rules)
        area = Area(0, Kind.PLACE if direction is None else Kind.HALLWAY)
        self.areas.append(area)
        self._enter(area, Pose2(0.0, 0.0, wrap_angle(-(direction or 0.0))), np.zeros((3, 3)))
        self._observe(lines)

    def _enter(self, area: Area, pose: Pose2, covariance: F64) -> None:
        self._at, self._matched = area.number, 0
        self._ekf = self._along = None
        if area.kind is Kind.PLACE:
            self._ekf = LineEkf(pose, covariance, known=area.known)
        else:
            self._along = WayAlong(pose, covariance, self.rules)

    def _remember(self) -> None:
        """Keep in the area what its filter knows."""
        if self._at is not None and self._ekf is not None:
            self.areas[self._at].known = self._ekf.lines(least_seen=2)

    def _share_at(self, lines: Lines, area: Area, pose: Pose2) -> float:
        """Of what is seen of an area from a pose in it, the share that lies on its walls."""
        seen = not_through(lines.transformed(pose), (pose.x_m, pose.y_m), area.openings)
        return known_share(seen, self._walls(area), self.rules)

    def _settled(self, lines: Lines, area: Area, guess: Pose2) -> Pose2:
        """The pose near a guess at which what is seen of an area lies on its walls."""
        known = as_known(self._walls(area))
        seen = not_through(lines.transformed(guess), (guess.x_m, guess.y_m), area.openings)
        ekf = LineEkf(guess, _GUESSED, known=known, learn=False)
        ekf.update(seen.transformed(guess.inverse()))
        return ekf.pose

    def _walls(self, area: Area) -> Lines:
        walls = area.walls.lines(min_seen=2, min_length_m=self.rules.wall_least_m)
        return walls if len(walls) else area.walls.lines()

    def _told(self, area: Area) -> Sequence[int]:
        return [
            k
            for k, each in enumerate(area.openings)
            if each.leads_to is not None or (each.seen >= _SURE_SEEN and not each.dismissed)
        ]

    def _nodes(self, area: Area) -> list[tuple[float, str]]:
        """Openings of a hallway by the way along it."""
        return sorted((area.openings[k].centre[0], _node(area, k)) for k in self._told(area))


def _note(area: Area, opening: Opening, rules: HybridRules) -> None:
    """See an opening again, or for the first time."""
    for known in area.openings:
        if math.dist(known.centre, opening.centre) > rules.landmark_m:
            continue
        if abs(wrap_angle(known.outward().yaw_rad - opening.outward().yaw_rad)) > 0.5:
            continue
        share = 1.0 / min(known.seen + 1, 20)
        known.left_m, known.right_m = (
            (old[0] + share * (new[0] - old[0]), old[1] + share * (new[1] - old[1]))
            for old, new in ((known.left_m, opening.left_m), (known.right_m, opening.right_m))
        )
        known.seen += 1
        return
    area.openings.append(opening)


def _name(area: Area) -> str:
    return f"place {area.number}"


def _node(area: Area, opening: int) -> str:
    return _name(area) if area.kind is Kind.PLACE else f"node {area.number}.{opening}"


def _inside_m(area: Area, opening: Opening) -> float:
    """From the middle of a place to its opening; 0 on a hallway, whose opening is the node."""
    walls = area.walls.lines()
    if area.kind is Kind.HALLWAY or not len(walls):
        return 0.0
    ends = np.concatenate((walls.start_m, walls.end_m))
    middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
    return math.dist(opening.centre, (float(middle[0]), float(middle[1])))


def _is_just_behind(opening: Opening, pose: Pose2) -> bool:
    """Whether a pose is outside the area, in front of one of its openings: from there the area is well seen, too."""
    at = opening.outward().inverse() @ pose
    return 0.0 < at.x_m < 3.0 and abs(at.y_m) < opening.width_m


def _is_near(a: Pose2, b: Pose2, slack_m: float) -> bool:
    turned = abs(wrap_angle(a.yaw_rad - b.yaw_rad))
    return math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) <= slack_m and turned < 0.6
