"""Anchor point graphs and how much of one is in another (S21, S22)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.features.anchors import AnchorKind, Anchors, joined
from mapping.frames import Pose2
from mapping.kernels import features as kernels

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MOST_VERTICES: Final = 256  # a complete graph of more has too many edges to be a compact description


def polar_distance(r1_m: ArrayLike, bearing1_rad: ArrayLike, r2_m: ArrayLike, bearing2_rad: ArrayLike) -> F64:
    """Distance of two points in polar coordinates, sqrt(r1^2 + r2^2 - 2 r1 r2 cos(b2 - b1)) (eq. 5.39); any shape."""
    r1, r2 = np.asarray(r1_m, dtype=np.float64), np.asarray(r2_m, dtype=np.float64)
    between = np.asarray(bearing2_rad, dtype=np.float64) - np.asarray(bearing1_rad, dtype=np.float64)
    # (r1 - r2)^2 + 4 r1 r2 sin^2(b/2) is the same and does not cancel for close points.
    return np.asarray(np.sqrt((r1 - r2) ** 2 + 4.0 * r1 * r2 * np.sin(0.5 * between) ** 2))


@dataclass(frozen=True)
class AnchorGraph:
    """The complete graph over the anchors of a scene; edges are distances, which no motion of the robot changes."""

    anchors: Anchors

    def __len__(self) -> int:
        return len(self.anchors)

    @cached_property
    def distance_m(self) -> F64:
        """(N, N) distances (eq. 5.39)."""
        p = self.anchors.points
        return np.hypot(p[:, None, 0] - p[None, :, 0], p[:, None, 1] - p[None, :, 1])

    @cached_property
    def edges(self) -> I64:
        """(N (N - 1) / 2, 2) vertices i < j, the longest edge first; equal ones by vertex."""
        i, j = np.triu_indices(len(self.anchors), 1)
        order = np.argsort(-self.distance_m[i, j], kind="stable")
        return np.stack((i[order], j[order]), axis=-1).astype(np.int64)

    @cached_property
    def length_m(self) -> F64:
        """(E,) of the edges, falling."""
        return np.ascontiguousarray(self.distance_m[self.edges[:, 0], self.edges[:, 1]])


def anchor_graph(anchors: Anchors, virtual: Anchors | None = None) -> AnchorGraph:
    """The graph of anchors of types 2 to 4 and, if given, virtual ones; type 1 is left out, it is a shadow's end.

    Of more than 256 those at the longest walls stay. No anchors give an empty graph. ValueError if one is not finite.
    """
    kept = anchors.of_kinds(AnchorKind.WALL_END, AnchorKind.CORNER, AnchorKind.JUMP_EDGE)
    if virtual is not None:
        kept = joined((kept, virtual.of_kinds(AnchorKind.VIRTUAL)))
    if not np.all(np.isfinite(kept.points)):
        raise ValueError("anchors must lie at finite positions")
    if len(kept) > MOST_VERTICES:
        longest = np.argsort(-kept.rows[:, kernels.LENGTH], kind="stable")[:MOST_VERTICES]
        kept = Anchors(kept.rows[np.sort(longest)])
    return AnchorGraph(Anchors(np.ascontiguousarray(kept.rows)))


@dataclass(frozen=True, slots=True)
class MatchRules:
    """tolerance_m: by how much equal distances may differ.  near_m: how far an anchor may lie from its partner.
    turn_deg: by how much walls of partners may differ in direction.  least: partners that make a match."""

    tolerance_m: float = 0.15
    near_m: float = 0.20
    turn_deg: float = 10.0
    least: int = 3

    def __post_init__(self) -> None:
        for name in ("tolerance_m", "near_m", "turn_deg"):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be a number above 0, got {value}")
        if self.least < 2:
            raise ValueError(f"a pose follows from at least 2 anchors, got least {self.least}")


@dataclass(frozen=True, slots=True)
class GraphMatch:
    """pairs: (M, 2) vertex of the first graph and its partner in the second.  second_from_first: the pose they imply.
    rms_m: how far partners lie apart under it."""

    pairs: I64
    second_from_first: Pose2
    rms_m: float

    def __len__(self) -> int:
        return len(self.pairs)


def compare(first: AnchorGraph, second: AnchorGraph, rules: MatchRules | None = None) -> GraphMatch | None:
    """The largest part of one graph that is in the other, with correspondences and the pose they imply.

    Edges of equal length are laid on each other, largest first; each pair of them implies a pose, under which anchors
    within near_m whose walls run alike are partners, one to one; the pose with most partners wins, of equals that
    with the smaller residual. What only one graph has (ghost edges, hidden anchors) costs nothing. None if fewer than
    rules.least anchors have partners: not recognised. Mirror images do not match.
    Cost: edges of equal length x vertices; about E^2 N^2 tolerance / extent in the worst case.  Source: S22.
    """
    chosen = rules or MatchRules()
    if len(first) < 2 or len(second) < 2:
        return None
    pose, partner = np.zeros(3), np.full(len(first), -1, dtype=np.int64)
    count, squares = kernels.compare_graphs(
        first.anchors.rows, second.anchors.rows, first.edges, second.edges, first.length_m, second.length_m,
        chosen.tolerance_m, chosen.near_m, math.radians(chosen.turn_deg), pose, partner,
    )  # fmt: skip
    if count < chosen.least:
        return None
    matched = np.flatnonzero(partner >= 0)
    pairs = np.stack((matched, partner[matched]), axis=-1)
    return GraphMatch(pairs, Pose2(float(pose[0]), float(pose[1]), float(pose[2])), math.sqrt(squares / count))
