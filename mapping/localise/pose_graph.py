"""The pose graph: where all key scans are, given what was measured between pairs of them.

Edges of the path (each key scan to the next) are believed. Closures are not: each carries a weight that falls with
how far it disagrees, and the weights sharpen from iteration to iteration, so that a crowd of closures that agree wins
over single ones that do not, wherever the start values lie.
Source: Gauss-Newton on SE(2) with sparse factorisation; Geman-McClure weights under graduated non-convexity
(Yang, Antonante, Tzoumas, Carlone, IEEE RA-L 2020), here on the squared Mahalanobis distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.frames import wrap_angles
from mapping.localise.sparse_factor import symmetric_factor

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

FINAL_SCALE = 9.0  # squared Mahalanobis distance, 3 degrees of freedom (99 % lie below 11.3), where a weight is 1/4
SHRINK = 0.3  # of the scale, from one step to the next
SMALL_STEP = 1e-4
GAUGE = 1e9


@dataclass(frozen=True, slots=True)
class Edges:
    """Measured poses of key `to` seen from key `start`.

    start, to: (E,).  measured: (E, 3) x, y, yaw.  information: (E, 3, 3) in the frame of start.
    doubtful: (E,) closures, whose weight is found; the others count fully.
    """

    start: I64
    to: I64
    measured: F64
    information: F64
    doubtful: Bools

    def __len__(self) -> int:
        return len(self.start)

    @staticmethod
    def none() -> Edges:
        """No edge."""
        empty = np.zeros(0, dtype=np.int64)
        return Edges(empty, empty, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, dtype=np.bool_))

    def joined(self, other: Edges) -> Edges:
        """These edges, then the others."""
        return Edges(
            np.concatenate((self.start, other.start)),
            np.concatenate((self.to, other.to)),
            np.concatenate((self.measured, other.measured)),
            np.concatenate((self.information, other.information)),
            np.concatenate((self.doubtful, other.doubtful)),
        )

    def only(self, chosen: Bools) -> Edges:
        """Some of them: chosen (E,)."""
        return Edges(
            self.start[chosen], self.to[chosen], self.measured[chosen], self.information[chosen], self.doubtful[chosen]
        )


@dataclass(frozen=True, slots=True)
class Solution:
    """Optimised poses (N, 3), and of each edge its weight (E,) in (0, 1] and squared Mahalanobis distance (E,)."""

    poses: F64
    weight: F64
    distance: F64
    steps: int


def residuals(poses: F64, edges: Edges) -> F64:
    """(E, 3): the pose seen minus the pose measured, in the frame of each edge's start."""
    a, b = poses[edges.start], poses[edges.to]
    return relative_poses(a, b) - edges.measured


def relative_poses(a: F64, b: F64) -> F64:
    """Poses b (N, 3) seen from poses a (N, 3); yaw not wrapped."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    return np.stack((c * dx + s * dy, c * dy - s * dx, b[:, 2] - a[:, 2]), axis=-1)


def composed_poses(a: F64, b: F64) -> F64:
    """Poses b (N, 3), given in frames a (N, 3) or (3,), in the frame of a; yaw wrapped."""
    a = np.broadcast_to(a, b.shape)
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    x, y = a[:, 0] + c * b[:, 0] - s * b[:, 1], a[:, 1] + s * b[:, 0] + c * b[:, 1]
    return np.stack((x, y, wrap_angles(a[:, 2] + b[:, 2])), axis=-1)


def mahalanobis(poses: F64, edges: Edges) -> F64:
    """(E,) squared distances of edges from what the poses say."""
    off = residuals(poses, edges)
    off[:, 2] = wrap_angles(off[:, 2])
    return np.asarray(np.einsum("ni,nij,nj->n", off, edges.information, off))


def optimise(poses: F64, edges: Edges, *, start_scale: float = FINAL_SCALE, most_steps: int = 12) -> Solution:
    """Poses (N, 3) that fit the edges best; the first pose stays.

    start_scale: how forgiving doubtful edges are judged at first (FINAL_SCALE: as strictly as in the end; large: all
    count fully, then the scale shrinks).
    """
    x = np.array(poses, dtype=np.float64)
    scale = max(start_scale, FINAL_SCALE)
    steps = 0
    if len(x) > 1 and len(edges):
        pattern = _Pattern(len(x), edges)
        while steps < most_steps:
            weight = np.where(edges.doubtful, (scale / (scale + mahalanobis(x, edges))) ** 2, 1.0)
            step = pattern.solve(x, edges, weight)
            x -= step
            x[:, 2] = wrap_angles(x[:, 2])
            steps += 1
            if scale <= FINAL_SCALE and float(np.abs(step).max()) < SMALL_STEP:
                break
            scale = max(FINAL_SCALE, SHRINK * scale)
    return Solution(x, weights_of(x, edges), mahalanobis(x, edges), steps)


def weights_of(poses: F64, edges: Edges) -> F64:
    """(E,) weights of edges as the poses stand."""
    inside = FINAL_SCALE / (FINAL_SCALE + mahalanobis(poses, edges))
    return np.where(edges.doubtful, inside**2, 1.0)


def covariance_of(poses: F64, edges: Edges, weight: F64, key: int) -> F64:
    """(3, 3) covariance of one key's pose in the map frame, the first key taken as exact."""
    if len(poses) < 2 or not len(edges) or key == 0:
        return np.zeros((3, 3))
    _, factor = _Pattern(len(poses), edges).factor(poses, edges, weight)
    unit = np.zeros((3 * len(poses), 3))
    unit[3 * key : 3 * key + 3] = np.eye(3)
    block = np.asarray(factor.solve(unit))[3 * key : 3 * key + 3]
    return np.asarray(0.5 * (block + block.T))


class Uncertainty:
    """How far poses of a graph may be off each other, its edges' errors being what they say they are.

    But steps of the path that are less sure than held_m along themselves are not held by what was seen, but by the
    wheels, and these err alike at each: of them a share that all have in common is added, as large as they are unsure.
    Around a loop it cancels out; along a bare corridor it grows with the way and not with its root.
    """

    def __init__(self, poses: F64, edges: Edges, weight: F64, *, held_m: float) -> None:
        """poses: (N, 3), at least two.  weight: (E,) of edges."""
        self._poses = poses
        pattern = _Pattern(len(poses), edges)
        (wa, wb), self._factor = pattern.factor(poses, edges, weight)
        self._together = np.asarray(self._factor.solve(pattern.pull(wa, wb, edges, _common_error(edges, held_m))))

    def of_relative(self, start: int, to: int) -> F64:
        """(3, 3) covariance of pose `to` seen from pose `start`, in the frame of start."""
        pair = Edges(
            np.array([start]), np.array([to]), np.zeros((1, 3)), np.zeros((1, 3, 3)), np.zeros(1, dtype=np.bool_)
        )
        a, b = _jacobians(self._poses, pair)
        rows = np.concatenate((np.arange(3 * start, 3 * start + 3), np.arange(3 * to, 3 * to + 3)))
        unit = np.zeros((len(self._together), 6))
        unit[rows, np.arange(6)] = 1.0
        by_pose = np.concatenate((a[0], b[0]), axis=1)
        both = by_pose @ np.asarray(self._factor.solve(unit))[rows] @ by_pose.T
        together = by_pose @ self._together[rows]
        return np.asarray(0.5 * (both + both.T) + np.outer(together, together))


def _common_error(edges: Edges, held_m: float) -> F64:
    """(E, 3) in the frame of each edge's start: what may be common to steps of the path, along the way of each."""
    off = np.zeros((len(edges), 3))
    way = np.hypot(edges.measured[:, 0], edges.measured[:, 1])
    moved = np.flatnonzero(~edges.doubtful & (way > 1e-3))
    along = edges.measured[moved, :2] / way[moved, None]
    covariance = np.linalg.inv(edges.information[moved])[:, :2, :2]
    square = np.einsum("ni,nij,nj->n", along, covariance, along)
    off[moved, :2] = along * np.sqrt(np.maximum(0.0, square - held_m**2))[:, None]
    return off


class _Pattern:
    """Where the blocks of the normal equations stand: the same for all steps of one optimisation."""

    def __init__(self, keys: int, edges: Edges) -> None:
        three = np.arange(3)
        i = (3 * edges.start)[:, None, None] + three[None, :, None] + np.zeros((1, 1, 3), dtype=np.int64)
        j = (3 * edges.to)[:, None, None] + three[None, :, None] + np.zeros((1, 1, 3), dtype=np.int64)
        i_t, j_t = i.transpose(0, 2, 1), j.transpose(0, 2, 1)
        self._rows = np.concatenate([i.ravel(), i.ravel(), j.ravel(), j.ravel(), three])
        self._columns = np.concatenate([i_t.ravel(), j_t.ravel(), i_t.ravel(), j_t.ravel(), three])
        self._size = 3 * keys

    def factor(self, x: F64, edges: Edges, weight: F64) -> tuple[tuple[F64, F64], Any]:
        """Weighted Jacobians (E, 3, 3) of both ends, and the factorised normal matrix."""
        a, b = _jacobians(x, edges)
        weighted = edges.information * weight[:, None, None]
        wa, wb = weighted @ a, weighted @ b
        a_t, b_t = a.transpose(0, 2, 1), b.transpose(0, 2, 1)
        cross = a_t @ wb
        values = np.concatenate(
            [
                (a_t @ wa).ravel(), cross.ravel(), cross.transpose(0, 2, 1).ravel(), (b_t @ wb).ravel(),
                np.full(3, GAUGE),
            ]
        )  # fmt: skip
        return (wa, wb), symmetric_factor(values, self._rows, self._columns, self._size)

    def solve(self, x: F64, edges: Edges, weight: F64) -> F64:
        """The Gauss-Newton step (N, 3), to be subtracted."""
        (wa, wb), factor = self.factor(x, edges, weight)
        off = residuals(x, edges)
        off[:, 2] = wrap_angles(off[:, 2])
        return np.asarray(factor.solve(self.pull(wa, wb, edges, off))).reshape(-1, 3)

    def pull(self, wa: F64, wb: F64, edges: Edges, off: F64) -> F64:
        """(3 N,) what residuals `off` (E, 3) pull at the poses, by the weighted Jacobians of both ends."""
        three = np.arange(3)
        pull = np.bincount(
            (3 * edges.start[:, None] + three).ravel(), np.einsum("nji,nj->ni", wa, off).ravel(), self._size
        )
        pull += np.bincount(
            (3 * edges.to[:, None] + three).ravel(), np.einsum("nji,nj->ni", wb, off).ravel(), self._size
        )
        return np.asarray(pull)


def _jacobians(x: F64, edges: Edges) -> tuple[F64, F64]:
    """Derivatives (E, 3, 3) of the residuals by the start's and the end's pose."""
    p, q = x[edges.start], x[edges.to]
    c, s = np.cos(p[:, 2]), np.sin(p[:, 2])
    dx, dy = q[:, 0] - p[:, 0], q[:, 1] - p[:, 1]
    a, b = np.zeros((len(p), 3, 3)), np.zeros((len(p), 3, 3))
    b[:, 0, 0], b[:, 0, 1], b[:, 1, 0], b[:, 1, 1], b[:, 2, 2] = c, s, -s, c, 1.0
    a[:, :2, :2] = -b[:, :2, :2]
    a[:, 0, 2], a[:, 1, 2], a[:, 2, 2] = c * dy - s * dx, -c * dx - s * dy, -1.0
    return a, b
