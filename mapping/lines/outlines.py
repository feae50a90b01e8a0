"""Directed lines chained into outlines of rooms and obstacles (S08).

Free space is to the right of a line walked from start to end. So the inside of a room is walked clockwise, an
isolated obstacle counter-clockwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mapping.lines.lines import Lines, as_points

F64 = NDArray[np.float64]

_NARROW_M: Final = 0.05  # narrower on average, a ring is no room


class OutlineKind(Enum):
    """What an outline goes around."""

    ROOM = "room"  # closed, clockwise: free inside
    OBSTACLE = "obstacle"  # closed, counter-clockwise: free outside
    OPEN = "open"  # ends somewhere


@dataclass(frozen=True, slots=True)
class Outline:
    """points_m: (N, 2) corners in walking direction, a closed one without its first point again.

    members: indices of its lines in that order.
    """

    points_m: F64
    members: tuple[int, ...]
    kind: OutlineKind


def signed_area(points: ArrayLike) -> float:
    """Area of a polygon (N, 2) in square metres: above 0 if walked counter-clockwise. 0 for fewer than 3 points."""
    p = as_points(points)
    if len(p) < 3:
        return 0.0
    q = p - p[0]
    after = np.roll(q, -1, axis=0)
    return 0.5 * float(np.sum(q[:, 0] * after[:, 1] - after[:, 0] * q[:, 1]))


def kind_of_polygon(points: ArrayLike) -> OutlineKind:
    """Room or obstacle, by the direction in which a closed polygon (N, 2) is walked; OPEN if it has no area."""
    area = signed_area(points)
    if area == 0.0:
        return OutlineKind.OPEN
    return OutlineKind.ROOM if area < 0.0 else OutlineKind.OBSTACLE


def outlines(lines: Lines, *, join_m: float = 0.30) -> list[Outline]:
    """Chains of lines that follow each other, end to start, no farther apart than join_m.

    Nearest pairs are joined first, each end and each start once; a line is not joined to itself. Where
    neighbours cross near by, the corner is their crossing, else both ends stay. n log n but for
    crowds of ends at one place.
    Raises ValueError if join_m is not above 0. Source: S08, figs. 5.6 and 5.7.
    """
    if not (math.isfinite(join_m) and join_m > 0.0):
        raise ValueError(f"join_m must be above 0, got {join_m}")
    if len(lines) == 0:
        return []
    after = _successors(lines, join_m)
    chains, closed = _chains(after, len(lines))
    return [_outline(lines, chain, is_closed, join_m) for chain, is_closed in zip(chains, closed)]


def _successors(lines: Lines, join_m: float) -> dict[int, int]:
    """Line that follows each line, where one does."""
    near = cKDTree(lines.end_m).query_ball_tree(cKDTree(lines.start_m), join_m)
    pairs = [
        (float(np.hypot(*(lines.start_m[j] - lines.end_m[i]))), i, j)
        for i, starts in enumerate(near)
        for j in starts
        if i != j
    ]
    after: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in sorted(pairs):
        if i not in after and j not in taken:
            after[i] = j
            taken.add(j)
    return after


def _chains(after: dict[int, int], count: int) -> tuple[list[list[int]], list[bool]]:
    """Open chains from their first line, then the rings that are left."""
    followers = set(after.values())
    chains: list[list[int]] = []
    closed: list[bool] = []
    done: set[int] = set()
    for first in [k for k in range(count) if k not in followers] + list(range(count)):
        if first in done:
            continue
        chain = [first]
        while chain[-1] in after and after[chain[-1]] != first:
            chain.append(after[chain[-1]])
        done.update(chain)
        chains.append(chain)
        closed.append(after.get(chain[-1]) == first)
    return chains, closed


def _outline(lines: Lines, chain: list[int], closed: bool, join_m: float) -> Outline:
    points: list[F64] = [] if closed else [lines.start_m[chain[0]]]
    followers = chain[1:] + (chain[:1] if closed else [])
    for here, following in zip(chain, followers):
        corner = _corner(lines, here, following, join_m)
        points += [corner] if corner is not None else [lines.end_m[here], lines.start_m[following]]
    if not closed:
        points.append(lines.end_m[chain[-1]])
    polygon = np.array(points)
    return Outline(polygon, tuple(chain), _kind_of_ring(polygon) if closed else OutlineKind.OPEN)


def _kind_of_ring(polygon: F64) -> OutlineKind:
    """As kind_of_polygon, but what is too narrow to be a room is an obstacle: both sides of a partition, whose noise
    can turn the ring inside out."""
    around = float(np.sum(np.hypot(*(np.roll(polygon, -1, axis=0) - polygon).T)))
    if abs(signed_area(polygon)) < 0.5 * _NARROW_M * around:
        return OutlineKind.OBSTACLE
    return kind_of_polygon(polygon)


def _corner(lines: Lines, here: int, following: int, join_m: float) -> F64 | None:
    """Where two lines cross, if that is within join_m of both the end and the start that meet."""
    p, q = lines.end_m[here], lines.start_m[following]
    u, v = p - lines.start_m[here], lines.end_m[following] - q
    cross = u[0] * v[1] - u[1] * v[0]
    if abs(cross) < 1e-3 * float(np.hypot(*u) * np.hypot(*v)):
        return None
    way = q - p
    corner = p + u * float(way[0] * v[1] - way[1] * v[0]) / cross
    near = np.hypot(*(corner - p)) <= join_m and np.hypot(*(corner - q)) <= join_m
    return np.asarray(corner) if near else None
