"""What closing loops works with: its settings, a closure, what a piece of work sees and what comes of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.pose_graph import Edges
from mapping.localise.views import KeptViews

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ClosureSettings:
    """What counts as seeing a place again. Lengths along the way are metres driven.

    apart_m: the way between two visits.  drift_m, drift_share: how far off a key may be after a way through the graph:
    the sum of both, at most search_m.  tracked_m: up to this drift no search is needed.  turn_rad_per_m: heading drift.
    place_m: key scans on either side along the way that make up a place.  every_m: a place is searched for so
    often, at most `searches` times in one piece of work.  score, rival: of a search, see Found.
    explained, overlap, mean_cost: of the points, see Agreement and Match; half_*: what still has half a vote.
    weakest_per_m2: least information in the worst direction.  prominence: of a peak that may stand for it where a match
    is tracked, see mapping.localise.slide.  rough_*: what still has rough_worth of a vote: outdoors
    nothing is a plane and little holds a pose, but nearly all that was seen is seen again.  rough_weight: what one
    needs in the graph with the group it came with.  faint_*: what has faint_worth only, and counts where many agree
    over faint_way_m: half of the points, where surfaces are rough (they fit no better than mean_cost): what is plain
    repeats, hedges and parked cars do not.
    surprise: squared Mahalanobis distance of a searched closure, by the covariance along the way, beyond which nothing
    explains it; held_m: steps less sure than that are held by the wheels alone, see Uncertainty.
    agreeing: searched closures that must ask for the same correction, over at least agreeing_way_m of the way,
    groups of rough ones over rough_way_m; as much again for each `doubling` of surprise beyond `expected`, which is
    what nine of ten true ones stay below.
    pending: how many closures wait at most.  undone_below: the weight under which a closure is forgotten in the end.
    floor_*: errors of a match that no matcher sees.  misfit: median squared distance of new closures from the map that
    makes an optimisation due; so do optimise_every new ones.
    """

    apart_m: float = 8.0
    drift_m: float = 0.6
    drift_share: float = 0.05
    search_m: float = 40.0
    tracked_m: float = 1.0
    turn_start_rad: float = math.radians(6.0)
    turn_rad_per_m: float = math.radians(0.15)
    turn_most_rad: float = math.radians(30.0)
    place_m: float = 2.5
    places: int = 3
    every_m: float = 0.8
    searches: int = 6
    score: float = 0.55
    rival: float = 0.93
    explained: float = 0.55
    overlap: float = 0.93
    mean_cost: float = 0.30
    half_explained: float = 0.50
    half_overlap: float = 0.88
    half_mean_cost: float = 0.42
    weakest_per_m2: float = 1000.0
    prominence: float = 0.04
    rough_explained: float = 0.70
    rough_overlap: float = 0.95
    rough_mean_cost: float = 0.60
    rough_weakest_per_m2: float = 250.0
    rough_worth: float = 0.34
    rough_weight: float = 0.65
    faint_explained: float = 0.50
    faint_weakest_per_m2: float = 150.0
    faint_worth: float = 0.17
    faint_way_m: float = 12.0
    surprise: float = 12.0
    held_m: float = 0.0115
    expected: float = 6.25
    doubling: float = 3.0
    agreeing: int = 3
    agreeing_way_m: float = 1.2
    rough_way_m: float = 6.0
    pending: int = 64
    floor_m: float = 0.015
    floor_rad: float = math.radians(0.15)
    undone_below: float = 0.15
    misfit: float = 30.0
    optimise_every: int = 60


@dataclass(frozen=True, slots=True)
class Closure:
    """Key `to` seen from key `start`, an earlier one.

    information: (3, 3) in the frame of start.  worth: its vote on probation.  searched: found by search,
    not from the estimate.  number: its name, for undoing; -1 until it is accepted.  surprise: squared Mahalanobis
    distance from where the way led, when it was found.
    """

    start: int
    to: int
    measured: Pose2
    information: F64
    worth: float
    searched: bool
    number: int = -1
    surprise: float = 0.0


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What a piece of work sees.

    poses: (N, 3) of key scans in the map frame.  travel_m: (N,) way driven up to each.  path: edges between successive
    key scans.  closures: accepted.  pending: on probation.  keys: those to look for closures of.  thorough: optimise
    in any case, until nothing moves.
    """

    views: KeptViews
    poses: F64
    travel_m: F64
    path: Edges
    closures: tuple[Closure, ...]
    pending: tuple[Closure, ...]
    keys: tuple[int, ...]
    unoptimised: int
    next_number: int
    thorough: bool = False


@dataclass(frozen=True, slots=True)
class WorkResult:
    """What came of it. poses: (N, 3) of the snapshot's keys; closures: all that are accepted now, weight: (C,) of each.

    covariance: (3, 3) of the last key's pose, first key exact; None if nothing was optimised: what it was before, grown
    along the path, stands and is on the safe side.  events: how often what happened.
    """

    poses: F64
    closures: tuple[Closure, ...]
    weight: F64
    pending: tuple[Closure, ...]
    unoptimised: int
    next_number: int
    covariance: F64 | None
    events: dict[str, int]


def edges_of(closures: Sequence[Closure]) -> Edges:
    """Closures as doubtful edges."""
    if not closures:
        return Edges.none()
    return Edges(
        np.array([c.start for c in closures], dtype=np.int64),
        np.array([c.to for c in closures], dtype=np.int64),
        np.array([(c.measured.x_m, c.measured.y_m, c.measured.yaw_rad) for c in closures]),
        np.array([c.information for c in closures]),
        np.ones(len(closures), dtype=np.bool_),
    )


def turned_information(information: F64, yaw_rad: float) -> F64:
    """An information matrix over (x, y, yaw) in a frame turned by yaw_rad against the one it is given in."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(turn @ information @ turn.T)


def floored(information: F64, floor_m: float, floor_rad: float) -> F64:
    """An information matrix after errors of floor_m and floor_rad that no matcher sees were added."""
    inverse = np.linalg.inv(floored_covariance(information, floor_m, floor_rad))
    return np.asarray(0.5 * (inverse + inverse.T))


def floored_covariance(information: F64, floor_m: float, floor_rad: float) -> F64:
    """The covariance (3, 3) of what `floored` says."""
    covariance = np.linalg.inv(information + 1e-6 * np.eye(3)) + np.diag([floor_m**2, floor_m**2, floor_rad**2])
    return np.asarray(covariance, dtype=np.float64)
