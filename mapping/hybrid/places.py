"""What a hierarchical map is made of: places and hallways with what was seen in them, and how scans are read (S45).

Lines are Lines whose free space is to the right of the walk from start to end, as scans and line maps give them.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2, wrap_angle, wrap_angles
from mapping.lines.line_map import LineMap
from mapping.lines.lines import Lines, segment_distance
from mapping.localise.ekf import MappedLines

F64 = NDArray[np.float64]
Point = tuple[float, float]

_SAMPLES: Final = np.linspace(0.1, 0.9, 5)  # of a line, where it is compared with others
_MOST_POSES: Final = 4000  # that are tried when a scan is looked for in one place


class Kind(StrEnum):
    """What an area is."""

    PLACE = "place"
    """A leaf: local line map, metric pose."""
    HALLWAY = "hallway"
    """A chain of links: corners and openings by the way along it."""


@dataclass(frozen=True, slots=True)
class HybridRules:
    """How scans are read and when areas are told apart.

    opening_least_m, opening_most_m: a gap between two wall ends that can be passed: a door or an arch.  wall_least_m:
    how long a wall has to be for its end to bound an opening.  straight_m, straight_rad: how far the two may be out of
    line.  beyond_m: so far behind an opening the robot is through and looks where it is.
    hallway_width_m: of two facing walls at most so far apart, on either side of the robot; hallway_ratio: at least so
    many times longer than that.
    corner_join_m, corner_bend_rad: ends of neighbouring lines that are one corner.  landmark_m: an observed corner or
    opening is a known one if it is nearer than this.
    near_m, turn_rad: a piece of wall lies on a known one.  same_share: of what is seen, by length, that has to lie on
    known walls for a place to be recognised; lead: by how much more than anywhere else.
    loop_m, loop_share: two openings may be one only if the graph puts them within loop_m and so much of the way round.
    """

    opening_least_m: float = 0.6
    opening_most_m: float = 1.5
    wall_least_m: float = 0.3
    straight_m: float = 0.15
    straight_rad: float = math.radians(8.0)
    beyond_m: float = 0.45
    hallway_width_m: float = 2.6
    hallway_ratio: float = 2.0
    corner_join_m: float = 0.2
    corner_bend_rad: float = math.radians(35.0)
    landmark_m: float = 0.4
    near_m: float = 0.12
    turn_rad: float = math.radians(8.0)
    same_share: float = 0.6
    lead: float = 0.12
    loop_m: float = 1.0
    loop_share: float = 0.03


@dataclass(slots=True)
class Corner:
    """A landmark along a hallway. point_m: frame of the hallway, x is the way along.  convex: it sticks out into the
    hallway.  seen: scans."""

    point_m: Point
    convex: bool
    seen: int = 1


@dataclass(slots=True)
class Opening:
    """A door or an arch, as seen from one area. left_m, right_m: its ends for who leaves through it, frame of the area.

    leads_to: area and number of the opening there that is this one seen from behind; None: never passed.
    there_from_here: the frame of that area and of this, as they lay when it was passed first.
    dismissed: it was passed and the same place lay behind: a gap between furniture.
    """

    left_m: Point
    right_m: Point
    seen: int = 1
    leads_to: tuple[int, int] | None = None
    there_from_here: Pose2 | None = None
    dismissed: bool = False

    @property
    def centre(self) -> Point:
        """The middle."""
        return (0.5 * (self.left_m[0] + self.right_m[0]), 0.5 * (self.left_m[1] + self.right_m[1]))

    @property
    def width_m(self) -> float:
        """Between the ends."""
        return math.dist(self.left_m, self.right_m)

    def outward(self) -> Pose2:
        """area_from_opening: in its middle, x leads out."""
        dx, dy = self.left_m[0] - self.right_m[0], self.left_m[1] - self.right_m[1]
        return Pose2(*self.centre, math.atan2(dy, dx) - 0.5 * math.pi)


@dataclass(slots=True)
class Area:
    """A place or a hallway with a frame of its own: where it was first entered, x leading in (hallway: along it)."""

    number: int
    kind: Kind
    walls: LineMap = field(default_factory=LineMap)
    known: MappedLines | None = None
    openings: list[Opening] = field(default_factory=list)
    corners: list[Corner] = field(default_factory=list)
    visits: int = 1

    def corner_list(self) -> list[Corner]:
        """By the way along the hallway; only what was seen more than once."""
        return sorted((c for c in self.corners if c.seen > 1), key=lambda c: c.point_m)

    def state(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "number": self.number,
            "kind": self.kind.value,
            "visits": self.visits,
            "walls": base64.b64encode(self.walls.to_bytes()).decode("ascii"),
            "known": None if self.known is None else _known_state(self.known),
            "openings": [_opening_state(opening) for opening in self.openings],
            "corners": [[*c.point_m, c.convex, c.seen] for c in self.corners],
        }

    @staticmethod
    def from_state(state: Mapping[str, Any]) -> Area:
        """The area of `state`. Raises ValueError, KeyError or TypeError if it is none."""
        openings = [_opening_of_state(each) for each in state["openings"]]
        corners = [Corner((float(x), float(y)), bool(convex), int(seen)) for x, y, convex, seen in state["corners"]]
        walls = LineMap.from_bytes(base64.b64decode(state["walls"], validate=True))
        known = None if state["known"] is None else _known_of_state(state["known"])
        number, visits = int(state["number"]), int(state["visits"])
        return Area(number, Kind(state["kind"]), walls, known, openings, corners, visits)


def _opening_state(opening: Opening) -> dict[str, Any]:
    to, through = opening.leads_to, opening.there_from_here
    return {
        "left_m": list(opening.left_m),
        "right_m": list(opening.right_m),
        "seen": opening.seen,
        "leads_to": None if to is None else list(to),
        "there_from_here": None if through is None else [through.x_m, through.y_m, through.yaw_rad],
        "dismissed": opening.dismissed,
    }


def _opening_of_state(state: Mapping[str, Any]) -> Opening:
    left, right = ((float(x), float(y)) for x, y in (state["left_m"], state["right_m"]))
    to, through = state["leads_to"], state["there_from_here"]
    if (to is None) != (through is None):
        raise ValueError("an opening that leads somewhere has there_from_here, another has not")
    leads = None if to is None else (int(to[0]), int(to[1]))
    pose = None if through is None else Pose2(*(float(v) for v in through))
    numbers = (*left, *right, *(() if pose is None else (pose.x_m, pose.y_m, pose.yaw_rad)))
    if not all(math.isfinite(v) for v in numbers):
        raise ValueError("an opening has finite numbers")
    return Opening(left, right, int(state["seen"]), leads, pose, bool(state["dismissed"]))


def _known_state(known: MappedLines) -> dict[str, Any]:
    columns = (known.angle_rad, known.distance_m, known.covariance, known.start_m, known.end_m, known.seen)
    names = ("angle_rad", "distance_m", "covariance", "start_m", "end_m", "seen")
    return {name: column.tolist() for name, column in zip(names, columns)}


def _known_of_state(state: Mapping[str, Any]) -> MappedLines:
    count = len(state["angle_rad"])

    def column(name: str, *shape: int) -> F64:
        values = np.array(state[name], dtype=np.float64).reshape(count, *shape)
        if not np.all(np.isfinite(values)):
            raise ValueError(f"{name} of a wall is not finite")
        return values

    return MappedLines(
        column("angle_rad"), column("distance_m"), column("covariance", 2, 2), column("start_m", 2),
        column("end_m", 2), column("seen").astype(np.int64),
    )  # fmt: skip


# --- reading a scan


def openings_in(lines: Lines, sensor: ArrayLike, rules: HybridRules, behind: Lines | None = None) -> list[Opening]:
    """Gaps between the ends of two walls in line, through which something farther off is seen.

    sensor: (2,) from where, in the frame of the lines: what hides a piece of wall makes no opening of it.  behind: what
    may be seen through them; the lines themselves by default.
    """
    here = np.asarray(sensor, dtype=np.float64)
    chosen = np.flatnonzero(lines.length_m >= rules.wall_least_m)
    start, end = lines.start_m[chosen], lines.end_m[chosen]
    way = end - start
    along = way / np.maximum(np.hypot(way[:, 0], way[:, 1]), 1e-9)[:, None]
    if not len(chosen):
        return []
    gap = start[None, :] - end[:, None]
    ahead = np.einsum("ijk,ik->ij", gap, along)
    aside = np.abs(gap[..., 1] * along[:, None, 0] - gap[..., 0] * along[:, None, 1])
    fits = (ahead >= rules.opening_least_m) & (ahead <= rules.opening_most_m) & (aside <= rules.straight_m)
    fits &= along @ along.T >= math.cos(rules.straight_rad)
    points = _sampled(lines if behind is None else behind)
    found = []
    for i, j in np.argwhere(fits):
        a, b = end[i], start[j]  # walking with free space to the right, so out is to the left: b is the right end
        if _seen_through(here, a, b, points):
            found.append(Opening((float(a[0]), float(a[1])), (float(b[0]), float(b[1]))))
    return found


def corners_in(lines: Lines, rules: HybridRules) -> list[Corner]:
    """Where neighbouring lines of a scan meet; lines counter-clockwise around the sensor, as extractors give them."""
    found = []
    count = len(lines)
    for k in range(count if count > 2 else max(0, count - 1)):
        # Counter-clockwise around the sensor a line is walked from end to start.
        n = (k + 1) % count
        a, b, c, d = lines.end_m[k], lines.start_m[k], lines.end_m[n], lines.start_m[n]
        if math.hypot(*(c - b)) > rules.corner_join_m:
            continue
        first, second = b - a, d - c
        bend = math.atan2(float(_cross(first, second)), float(first @ second))
        if abs(bend) < rules.corner_bend_rad or abs(bend) > math.pi - 0.2:
            continue
        share = float(_cross(c - a, second)) / float(_cross(first, second))
        point = a + share * first
        if math.hypot(*(point - b)) <= rules.corner_join_m:
            found.append(Corner((float(point[0]), float(point[1])), convex=bend < 0.0))
    return found


def hallway_along(lines: Lines, sensor: ArrayLike, rules: HybridRules) -> float | None:
    """The direction [rad] of the hallway in which the sensor stands; None if it is a room.

    Its sides are the walls of one direction on either hand: how far they reach along is its length.
    """
    if not len(lines):
        return None
    here = np.asarray(sensor, dtype=np.float64)
    way = lines.end_m - lines.start_m
    length = lines.length_m
    best: tuple[float, float] | None = None
    for k in np.argsort(-length, kind="stable")[:4]:
        u = way[k] / length[k]
        n = np.array([-u[1], u[0]])
        parallel = np.abs(way @ n) <= math.sin(rules.turn_rad) * length
        offset = (0.5 * (lines.start_m + lines.end_m) - here) @ n
        ends = np.stack(((lines.start_m - here) @ u, (lines.end_m - here) @ u), axis=-1)
        sides = []
        for side in (1.0, -1.0):
            mine = np.flatnonzero(parallel & (offset * side > 0.1) & (offset * side < rules.hallway_width_m))
            if not len(mine):
                break
            wall_m = offset[mine[np.argmax(length[mine])]]  # the longest is the wall, what is nearer stands before it
            wall = mine[np.abs(offset[mine] - wall_m) <= rules.straight_m]
            sides.append((abs(float(wall_m)), float(np.ptp(ends[wall])), float(length[wall].sum())))
        if len(sides) < 2:
            continue
        width, reach = sides[0][0] + sides[1][0], max(side[1] for side in sides)
        enough = min(side[2] for side in sides) >= 0.6 * width
        if enough and width <= rules.hallway_width_m and reach >= rules.hallway_ratio * width:
            ratio = reach / width
            if best is None or ratio > best[0]:
                best = (ratio, math.atan2(u[1], u[0]))
    return None if best is None else best[1]


def not_through(lines: Lines, sensor: ArrayLike, openings: Sequence[Opening]) -> Lines:
    """Those that are in the same area as the sensor: not seen through an opening."""
    here = np.asarray(sensor, dtype=np.float64)
    middle = 0.5 * (lines.start_m + lines.end_m)
    kept = np.ones(len(lines), dtype=np.bool_)
    for opening in openings:
        if opening.dismissed:
            continue
        a, b = np.array(opening.left_m), np.array(opening.right_m)
        out = np.array([a[1] - b[1], b[0] - a[0]]) / max(opening.width_m, 1e-9)
        behind = np.minimum((lines.start_m - a) @ out, (lines.end_m - a) @ out) > -0.1
        through = np.array([_crosses(here, m, a, b, 0.1) for m in middle], dtype=np.bool_)
        kept &= ~(behind & through)
    return lines.chosen(kept)


def as_known(walls: Lines) -> MappedLines:
    """Lines of a map as a filter takes them up."""
    angle, distance, covariance = walls.parameters()
    return MappedLines(angle, distance, covariance, walls.start_m, walls.end_m, walls.seen)


def known_share(lines: Lines, walls: Lines, rules: HybridRules) -> float:
    """Share, by length, of lines that lies on walls of the same direction, seen from the same side; 0 for none."""
    if not len(lines) or not len(walls):
        return 0.0
    return float(_shares(lines, walls, [Pose2()], rules)[0])


def find_in(lines: Lines, walls: Lines, rules: HybridRules) -> list[tuple[float, Pose2]]:
    """Poses at which lines fit walls, without a hint: (share, walls_from_lines), the best first, 0.3 m apart.

    Two observed walls that are not parallel and two known ones that stand alike settle a pose; each is then judged by
    all lines.
    """
    poses = _proposals(lines, walls, rules)
    if not poses:
        return []
    shares = _shares(lines, walls, poses, rules)
    found: list[tuple[float, Pose2]] = []
    for k in np.argsort(-shares, kind="stable"):
        pose = poses[k]
        if all(math.hypot(pose.x_m - p.x_m, pose.y_m - p.y_m) > 0.3 or _turned(pose, p) > 0.3 for _, p in found):
            found.append((float(shares[k]), pose))
        if len(found) >= 4:
            break
    return found


def _proposals(lines: Lines, walls: Lines, rules: HybridRules) -> list[Pose2]:
    angle, distance = _signed(lines)
    wall_angle, wall_distance = _signed(walls)
    longest = np.argsort(-lines.length_m, kind="stable")[:6]
    large = np.argsort(-walls.length_m, kind="stable")[:30]
    poses: list[Pose2] = []
    for i, j in combinations(longest, 2):
        between = wrap_angle(float(angle[j] - angle[i]))
        if abs(math.sin(between)) < 0.5:
            continue
        for k in large:
            for m in large:
                if abs(wrap_angle(float(wall_angle[m] - wall_angle[k]) - between)) > rules.turn_rad:
                    continue
                if walls.length_m[k] < 0.6 * lines.length_m[i] or walls.length_m[m] < 0.6 * lines.length_m[j]:
                    continue
                first = wrap_angle(float(wall_angle[k] - angle[i]))
                yaw = first + 0.5 * wrap_angle(float(wall_angle[m] - angle[j]) - first)
                n = np.array([[math.cos(a), math.sin(a)] for a in (wall_angle[k], wall_angle[m])])
                x, y = np.linalg.solve(n, [wall_distance[k] - distance[i], wall_distance[m] - distance[j]])
                poses.append(Pose2(float(x), float(y), wrap_angle(yaw)))
                if len(poses) >= _MOST_POSES:
                    return poses
    return poses


def _signed(lines: Lines) -> tuple[F64, F64]:
    """Angle of the normal to the left of each line's walk, out of free space, and distance along it."""
    way = lines.end_m - lines.start_m
    angle = np.arctan2(way[:, 0], -way[:, 1])
    middle = 0.5 * (lines.start_m + lines.end_m)
    return angle, np.cos(angle) * middle[:, 0] + np.sin(angle) * middle[:, 1]


def _shares(lines: Lines, walls: Lines, poses: Sequence[Pose2], rules: HybridRules) -> F64:
    points = _sampled(lines)  # (K, 5, 2)
    angle, wall_angle = _signed(lines)[0], _signed(walls)[0]
    weight = lines.length_m / lines.length_m.sum()
    shares = np.empty(len(poses))
    for n, pose in enumerate(poses):
        away = segment_distance(pose.apply(points.reshape(-1, 2)), walls.start_m, walls.end_m)
        turned = np.abs(wrap_angles(wall_angle[None, :] - angle[:, None] - pose.yaw_rad)) > rules.turn_rad
        near = away.reshape(len(lines), len(_SAMPLES), -1) <= rules.near_m
        shares[n] = float(weight @ np.any(near & ~turned[:, None, :], axis=2).mean(axis=1))
    return shares


def _sampled(lines: Lines) -> F64:
    """(K, 5, 2) points on lines."""
    way = lines.end_m - lines.start_m
    return np.asarray(lines.start_m[:, None, :] + _SAMPLES[None, :, None] * way[:, None, :])


def _seen_through(here: F64, a: F64, b: F64, points: F64) -> bool:
    """Whether a point is seen well behind the gap from a to b, whose front is to the right of a to b."""
    out = np.array([a[1] - b[1], b[0] - a[0]]) / max(math.hypot(*(b - a)), 1e-9)
    if float((here - a) @ out) > 0.0:
        return False
    flat = points.reshape(-1, 2)
    behind = flat[(flat - a) @ out > 0.3]
    return any(_crosses(here, p, a, b, -0.05) for p in behind)


def _crosses(p: F64, q: F64, a: F64, b: F64, margin_m: float) -> bool:
    """Whether the way from p to q crosses that from a to b, the latter longer by a margin at both ends."""
    side = float(_cross(b - a, p - a)), float(_cross(b - a, q - a))
    if side[0] * side[1] > 0.0 or side[0] == side[1]:
        return False
    at = p + (q - p) * side[0] / (side[0] - side[1])
    width = math.hypot(*(b - a))
    share = float((at - a) @ (b - a)) / max(width, 1e-9)
    return -margin_m <= share <= width + margin_m


def crossing(before: Pose2, after: Pose2, opening: Opening) -> bool:
    """Whether a step leads out through an opening."""
    a, b = np.array(opening.left_m), np.array(opening.right_m)
    p, q = np.array([before.x_m, before.y_m]), np.array([after.x_m, after.y_m])
    inside = opening.outward().inverse().apply(np.stack((p, q)))
    return bool(inside[0, 0] <= 0.0 < inside[1, 0] and _crosses(p, q, a, b, 0.05))


def _cross(a: F64, b: F64) -> Any:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _turned(a: Pose2, b: Pose2) -> float:
    return abs(wrap_angle(a.yaw_rad - b.yaw_rad))
