"""Growing neural gas: few nodes that stand for many scene vectors, learnt as these come in (S42, alg. 5.5).

Two rules. `NeuralGas` is the book's: a vector farther than D from all nodes becomes a node, else the nearest node is
shifted towards it, less each time; a node that was met Z times is split. `FritzkeGas` is Fritzke's own [Fri95]: edges
between the nearest and the second, which age and break, and a new node where the summed error is largest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.kernels import topology as kernels
from mapping.topology.nearest import Effort, NearestNodes

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class Change(Enum):
    """What a vector did to the net."""

    NEW = "new"  # it lies farther than D from every node and is one now
    SHIFTED = "shifted"  # its nearest node came closer to it
    SPLIT = "split"  # its nearest node had been met Z times: half of them go to a new node at the vector
    FULL = "full"  # it would be a node of its own, but the net has as many as it may


@dataclass(frozen=True, slots=True)
class Learnt:
    """node: the best matching unit, or the new node.  distance: from the unit before the shift; of a new node 0."""

    node: int
    change: Change
    distance: float


@dataclass(frozen=True, slots=True)
class GasRules:
    """D, Z and epsilon of alg. 5.5, and how many nodes there may be.

    new_node_distance: D, in (0, sqrt(n)].  split_count: Z >= 2.  shift: epsilon in (0, 1].  ValueError if not.
    """

    new_node_distance: float = 0.5
    split_count: int = 1000
    shift: float = 0.3
    max_nodes: int = 20_000

    def __post_init__(self) -> None:
        if not (math.isfinite(self.new_node_distance) and self.new_node_distance > 0.0):
            raise ValueError(f"new_node_distance is above 0, got {self.new_node_distance}")
        if self.split_count < 2:
            raise ValueError(f"split_count is at least 2, got {self.split_count}")
        if not 0.0 < self.shift <= 1.0:
            raise ValueError(f"shift lies in (0, 1], got {self.shift}")
        if self.max_nodes < 1:
            raise ValueError(f"max_nodes is at least 1, got {self.max_nodes}")


@dataclass(frozen=True, slots=True)
class GasState:
    """A net at rest, for the store. vectors: (m, n).  counts: (m,).  total: scene vectors read."""

    vectors: F64
    counts: I64
    total: int


class NeuralGas:
    """Algorithm 5.5, one vector at a time.

    A new node starts with count 0, as the book has it, a split one with Z // 2. The sum of counts is then not the
    number of vectors read: `total` is. A vector equal to a node that is due to be split makes no second node on the
    same spot, which no vector could ever match; the count is halved all the same.
    """

    def __init__(self, dimensions: int, rules: GasRules | None = None) -> None:
        self.rules = rules or GasRules()
        self.total = 0
        self._net = NearestNodes(dimensions, reach=self.rules.new_node_distance)
        self._counts: list[int] = []

    def __len__(self) -> int:
        return len(self._net)

    @property
    def vectors(self) -> F64:
        """(m, n) read-only view, overwritten as the net learns."""
        return self._net.vectors

    @property
    def counts(self) -> I64:
        """(m,) how often each was met, less what splits took."""
        return np.array(self._counts, dtype=np.int64)

    @property
    def effort(self) -> Effort:
        """What the searches cost."""
        return self._net.effort

    def learn(self, vector: ArrayLike) -> Learnt:
        """Take one scene vector in. ValueError unless it has n components in [0, 1]; then nothing has changed."""
        scene = self._net.checked(vector)
        found = self._net.within_reach(scene)
        self.total += 1
        if found is None:
            if self._is_full:
                return self._refused(scene)
            return Learnt(self._new(scene, 0), Change.NEW, 0.0)
        node, distance = found
        if self._counts[node] < self.rules.split_count:
            self._counts[node] += 1
            here = self.vectors[node]
            # eq. in alg. 5.5; clipped because rounding may leave [0, 1] by an ulp
            self._net.move(node, np.clip(here + self.rules.shift * (scene - here) / self._counts[node], 0.0, 1.0))
            return Learnt(node, Change.SHIFTED, distance)
        half = self.rules.split_count // 2
        self._counts[node] = half
        if distance == 0.0 or self._is_full:
            return Learnt(node, Change.FULL if self._is_full else Change.SHIFTED, distance)
        return Learnt(self._new(scene, half), Change.SPLIT, 0.0)

    def match(self, vector: ArrayLike) -> tuple[int, float] | None:
        """Number and distance of the nearest node within D, without learning; None: this scene is new."""
        return self._net.within_reach(vector)

    def nearest(self, vector: ArrayLike) -> tuple[int, float] | None:
        """Number and distance of the nearest node, however far; None if the net is empty."""
        return self._net.nearest(vector)

    def state(self) -> GasState:
        """A copy that does not change."""
        return GasState(self.vectors.copy(), self.counts, self.total)

    @classmethod
    def from_state(cls, state: GasState, rules: GasRules | None = None) -> NeuralGas:
        """The net again. ValueError if arrays do not fit together, hold bad numbers, or more nodes than allowed."""
        vectors, counts = np.asarray(state.vectors, dtype=np.float64), np.asarray(state.counts)
        if vectors.ndim != 2 or counts.shape != (len(vectors),):
            raise ValueError(f"a net has (m, n) vectors and (m,) counts, got {vectors.shape} and {counts.shape}")
        net = cls(vectors.shape[1], rules)
        if len(vectors) > net.rules.max_nodes:
            raise ValueError(f"{len(vectors)} nodes, but max_nodes is {net.rules.max_nodes}")
        if np.any(counts < 0) or state.total < 0:
            raise ValueError("counts are 0 or more")
        for vector, count in zip(vectors, counts):
            net._new(vector, int(count))
        net.total = int(state.total)
        return net

    @property
    def _is_full(self) -> bool:
        return len(self) >= self.rules.max_nodes

    def _new(self, scene: F64, count: int) -> int:
        number = self._net.add(scene)
        self._counts.append(count)
        return number

    def _refused(self, scene: F64) -> Learnt:
        nearest = self._net.nearest(scene)
        assert nearest is not None  # a full net has nodes
        return Learnt(nearest[0], Change.FULL, nearest[1])


@dataclass(frozen=True, slots=True)
class FritzkeRules:
    """The constants of [Fri95], under its names.

    shift, neighbour_shift: epsilon_b, epsilon_n.  oldest: a_max.  every: lambda, vectors between two new nodes.
    error_share: alpha.  decay: d, what is left of all errors after a vector.
    """

    shift: float = 0.05
    neighbour_shift: float = 0.0006
    oldest: int = 50
    every: int = 100
    error_share: float = 0.5
    decay: float = 0.995
    max_nodes: int = 500

    def __post_init__(self) -> None:
        shares = (self.shift, self.neighbour_shift, self.error_share, self.decay)
        if not all(0.0 <= share <= 1.0 for share in shares):
            raise ValueError("shift, neighbour_shift, error_share and decay lie in [0, 1]")
        if self.oldest < 1 or self.every < 1 or self.max_nodes < 2:
            raise ValueError("oldest and every are at least 1, max_nodes at least 2")


class FritzkeGas:
    """Fritzke's growing neural gas [Fri95]: the second rule, to compare with.

    B. Fritzke, "A growing neural gas network learns topologies", NIPS 7, 1995; his steps are numbered in the code.
    Nodes keep their number while they live; a dead one's number is given again.
    """

    def __init__(self, dimensions: int, rules: FritzkeRules | None = None) -> None:
        self.rules = rules or FritzkeRules()
        self.dimensions = dimensions
        self.total = 0
        self._nodes: F64 = np.zeros((self.rules.max_nodes, dimensions))
        self._errors: F64 = np.zeros(self.rules.max_nodes)
        self._alive: NDArray[np.bool_] = np.zeros(self.rules.max_nodes, dtype=np.bool_)
        self._ages: dict[int, dict[int, int]] = {}  # of the edges, from both their ends

    def __len__(self) -> int:
        return len(self._ages)

    @property
    def numbers(self) -> list[int]:
        """Of the nodes that live, rising."""
        return sorted(self._ages)

    def vector(self, number: int) -> F64:
        """(n,) of a living node; KeyError if it does not live."""
        if number not in self._ages:
            raise KeyError(f"no node {number}")
        vector: F64 = self._nodes[number].copy()
        return vector

    @property
    def edges(self) -> list[tuple[int, int]]:
        """Pairs of numbers, each once, rising."""
        return sorted((a, b) for a, neighbours in self._ages.items() for b in neighbours if a < b)

    def learn(self, vector: ArrayLike) -> int:
        """Take one vector in; returns the number of its nearest node. ValueError unless (n,) and finite."""
        scene = np.ascontiguousarray(vector, dtype=np.float64)
        if scene.shape != (self.dimensions,) or not np.all(np.isfinite(scene)):
            raise ValueError(f"a vector has {self.dimensions} finite components")
        self.total += 1
        if len(self._ages) < 2:  # step 0
            return self._new(scene)
        nearest, second, squared = kernels.two_nearest_flat(self._nodes, self._alive, scene)  # steps 1 and 2
        near, other = int(nearest), int(second)
        neighbours = self._ages[near]
        for number in neighbours:  # step 3
            neighbours[number] += 1
            self._ages[number][near] += 1
        self._errors[near] += float(squared)  # step 4
        self._nodes[near] += self.rules.shift * (scene - self._nodes[near])  # step 5
        for number in neighbours:
            self._nodes[number] += self.rules.neighbour_shift * (scene - self._nodes[number])
        neighbours[other] = self._ages[other][near] = 0  # step 6
        self._drop_old(near)  # step 7
        if self.total % self.rules.every == 0 and len(self._ages) < self.rules.max_nodes:
            self._insert()  # step 8
        self._errors *= self.rules.decay  # step 9
        return near

    def _new(self, scene: F64) -> int:
        number = int(np.argmin(self._alive))
        self._nodes[number], self._errors[number], self._alive[number] = scene, 0.0, True
        self._ages[number] = {}
        return number

    def _drop_old(self, near: int) -> None:
        for number in [n for n, age in self._ages[near].items() if age > self.rules.oldest]:
            del self._ages[near][number], self._ages[number][near]
            if not self._ages[number]:
                del self._ages[number]
                self._alive[number] = False

    def _insert(self) -> None:
        worst = int(np.argmax(np.where(self._alive, self._errors, -1.0)))
        partner = min(self._ages[worst], key=lambda number: (-self._errors[number], number), default=None)
        if partner is None:
            return
        number = self._new(0.5 * (self._nodes[worst] + self._nodes[partner]))
        del self._ages[worst][partner], self._ages[partner][worst]
        for end in (worst, partner):
            self._ages[end][number] = self._ages[number][end] = 0
            self._errors[end] *= self.rules.error_share
        self._errors[number] = self._errors[worst]


def quantisation_error(nodes: ArrayLike, vectors: ArrayLike) -> F64:
    """(N,) distance of each vector (N, n) from the nearest of the nodes (m, n). ValueError if there is no node."""
    net = np.ascontiguousarray(nodes, dtype=np.float64)
    if net.ndim != 2 or not len(net):
        raise ValueError("there is no node")
    scenes = np.ascontiguousarray(vectors, dtype=np.float64).reshape(-1, net.shape[1])
    return np.sqrt([kernels.nearest_flat(net, len(net), scene)[1] for scene in scenes])


def flat_picture(vectors: ArrayLike) -> F64:
    """(m, 2) where to draw nodes (m, n) so that their two widest directions are seen; signs fixed, so it is stable."""
    net = np.asarray(vectors, dtype=np.float64)
    if net.ndim != 2:
        raise ValueError(f"nodes are (m, n), got {net.shape}")
    if not len(net):
        return np.zeros((0, 2))
    away = net - net.mean(axis=0)
    _, axes = np.linalg.eigh(away.T @ away)
    two = np.zeros((net.shape[1], 2))
    two[:, : min(2, net.shape[1])] = axes[:, ::-1][:, :2]
    two *= np.where(two[np.argmax(np.abs(two), axis=0), [0, 1]] < 0.0, -1.0, 1.0)
    drawn: F64 = away @ two
    return drawn
