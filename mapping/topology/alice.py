"""ALICE's map: places that look alike are nodes, ways driven between them are edges (S43, [ZvP94]).

A round robot with a synchro drive has 24 photo sensors and 24 touch whiskers around it; its body does not turn with its
wheels. Each look is a vector of 48 numbers, for which a growing neural gas (S42) names the best matching unit. The
robot has driven from one unit to the next: that is an edge, and each unit is annotated with where it was met.

False measurements are unlike everything and become units of their own; but no way leads there twice. Each drive along
an edge strengthens it and weakens the others at the unit that was left; an edge that sinks below a limit is dropped.

A synchro drive drags its body along a little, so its heading drifts, and with it every position. The light impression
tells: turned back by the heading believed in, it should be that of the place. The circular correlation with what was
seen there earlier gives the error; a part of it corrects the heading, another the rate of drift per metre, which is
steady. Beyond the book, meeting a unit again pulls the position a little towards where that unit was met before.

Angles: sensor k looks k * 15 degrees counter-clockwise of the body's front.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2, wrap_angle, wrap_angles
from mapping.topology.neural_gas import Change, GasRules, GasState, NeuralGas

F64 = NDArray[np.float64]

RING = 24
SENSOR_RAD = 2.0 * math.pi / RING
_NEAR_SQUARES = 3.0  # how far away, in squares, references are used
_FLATTER = 0.3  # keeps the slope of their plane low where they do not lie around
_PULL_LOOKS = 4
_ARRAYS = 10  # of AliceMap.arrays
_FINE = 8  # steps a sensor in which correlation is looked at before the parabola


@dataclass(frozen=True, slots=True)
class AliceRules:
    """gas: D, Z and epsilon.  new_strength: of an edge first driven; each further drive adds 1, up to most_strength.
    weaken: what the other edges of the unit left lose.  drop_below: the limit.  driven_at_least: how often an edge was
    driven before it is published.

    correct_heading: use the light.  reference_m: one impression is kept in each square of this size.  gain, drift_gain:
    share of the heading error that corrects heading and drift per metre.  outlier_rad: larger errors are false
    measurements.  likeness: least correlation of two impressions that are compared.  pull: share of the way towards
    the mean place of a unit, if that was never met farther away than pull_width_m (root mean square): the middle of a
    wide one says little, and pulling towards it would shrink the map.
    """

    gas: GasRules = field(default_factory=lambda: GasRules(new_node_distance=0.2, split_count=2000, shift=0.5))
    new_strength: float = 1.0
    most_strength: float = 5.0
    weaken: float = 0.05
    drop_below: float = 0.5
    driven_at_least: int = 2
    correct_heading: bool = True
    reference_m: float = 0.6
    gain: float = 0.2
    drift_gain: float = 0.02
    outlier_rad: float = math.radians(25.0)
    likeness: float = 0.9
    pull: float = 0.02
    pull_width_m: float = 0.25

    def __post_init__(self) -> None:
        shares = (self.weaken, self.gain, self.drift_gain, self.likeness, self.pull)
        if not all(0.0 <= share <= 1.0 for share in shares):
            raise ValueError("weaken, gain, drift_gain, likeness and pull lie in [0, 1]")
        if not 0.0 < self.drop_below <= self.new_strength <= self.most_strength:
            raise ValueError("0 < drop_below <= new_strength <= most_strength must hold")
        if self.driven_at_least < 1 or not (min(self.reference_m, self.outlier_rad, self.pull_width_m) > 0.0):
            raise ValueError("driven_at_least is 1 or more; reference_m, outlier_rad, pull_width_m are above 0")


@dataclass(slots=True)
class Edge:
    """A way driven between two units. strength: the book's visiting counter, with its losses.

    up, down: how often it was driven from the lower number to the higher, and back.
    """

    strength: float
    up: int = 0
    down: int = 0

    @property
    def driven(self) -> int:
        """In the direction in which it was driven more often: there and back again once is what one false look does."""
        return max(self.up, self.down)


@dataclass(frozen=True, slots=True)
class TopoNode:
    """A place. position_m: mean of where it was met.  looks: how often.  vector: what it looks like, (48,)."""

    number: int
    position_m: tuple[float, float]
    looks: int
    vector: F64


@dataclass(frozen=True, slots=True)
class TopoGraph:
    """The map as published. edges: (from, to, strength, driven), from < to, in order."""

    nodes: tuple[TopoNode, ...]
    edges: tuple[tuple[int, int, float, int], ...]


def smoothed_touch(touch: ArrayLike) -> F64:
    """(24,) (2 T_i + T_i-1 + T_i+1) / 4 around the ring. ValueError unless (24,) in [0, 1]."""
    t = _ring(touch, "touch")
    return (2.0 * t + np.roll(t, 1) + np.roll(t, -1)) / 4.0


def turned_ring(ring: ArrayLike, angle_rad: float) -> F64:
    """(24,) what the ring would read if its body were turned clockwise by the angle: values move on to higher indices.

    Between sensors values are interpolated along straight lines, which leaves them in their range.
    """
    values = np.asarray(ring, dtype=np.float64)
    at = np.arange(RING) - angle_rad / SENSOR_RAD
    low = np.floor(at).astype(np.int64)
    share = at - low
    turned: F64 = (1.0 - share) * values[low % RING] + share * values[(low + 1) % RING]
    return turned


def ring_offsets(seen: ArrayLike, known: ArrayLike) -> tuple[F64, F64]:
    """Angles (N,) by which `seen` (24,) must be turned (turned_ring) to be most like each of `known` (N, 24), and the
    correlations (N,) then, -1 .. 1.

    Circular correlation, by Fourier series, exact between sensors for rings without frequencies of the 12th and
    above.  A ring without any contrast has no direction: 0 and 0.
    """
    a, b = np.asarray(seen, dtype=np.float64), np.asarray(known, dtype=np.float64).reshape(-1, RING)
    a, b = a - a.mean(), b - b.mean(axis=1, keepdims=True)
    size = np.linalg.norm(a) * np.linalg.norm(b, axis=1)
    spectrum = np.conj(np.fft.rfft(a)) * np.fft.rfft(b, axis=1)
    spectrum[:, -1] *= 0.5  # the 12th frequency stands for +12 and -12 alike
    fine = np.fft.irfft(spectrum, RING * _FINE, axis=1) * _FINE
    rows, k = np.arange(len(b)), np.argmax(fine, axis=1)
    before, top, after = fine[rows, k - 1], fine[rows, k], fine[rows, (k + 1) % fine.shape[1]]
    bend = before - 2.0 * top + after
    flat = size < 1e-12
    part = np.where(bend < 0.0, 0.5 * (before - after) / np.where(bend < 0.0, bend, 1.0), 0.0)
    angles = wrap_angles((k + part) * SENSOR_RAD / _FINE)
    return np.where(flat, 0.0, angles), np.where(flat, 0.0, np.minimum(top / np.where(flat, 1.0, size), 1.0))


class AliceMap:
    """The topological map of the driven free space, look by look.

    A look comes with the way since the last one as odometry has it: metres ahead and to the left of the body's front.
    `pose` is where the map believes the body to be; it begins at the origin, the front along x.
    """

    def __init__(self, rules: AliceRules | None = None) -> None:
        self.rules = rules or AliceRules()
        self.pose = Pose2()
        self.drift_rad_per_m = 0.0  # of the body, as learnt so far
        self.edges: dict[tuple[int, int], Edge] = {}
        self.dropped = 0
        self._gas = NeuralGas(2 * RING, self.rules.gas)
        self._places: F64 = np.zeros((64, 2))
        self._looks: list[int] = []
        self._scatter: list[float] = []  # summed squares of the way from their mean place
        self._references = _References(self.rules.reference_m)
        self._last: int | None = None
        self._before_last: int | None = None
        self._neighbours: dict[int, set[int]] = {}

    def __len__(self) -> int:
        return len(self._gas)

    def look(self, light: ArrayLike, touch: ArrayLike, way_m: tuple[float, float]) -> int:
        """Take one look in; the number of its unit.

        light, touch: (24,) in [0, 1].  ValueError if they are not, or the way is not finite; then nothing changed.
        """
        lights, touches = _ring(light, "light"), smoothed_touch(touch)
        if not (len(way_m) == 2 and all(math.isfinite(part) for part in way_m)):
            raise ValueError(f"the way is two finite lengths, got {way_m}")
        self._move(way_m)
        if self.rules.correct_heading:
            self._correct_heading(lights, math.hypot(*way_m))
        scene = np.concatenate((turned_ring(lights, self.pose.yaw_rad), turned_ring(touches, self.pose.yaw_rad)))
        learnt = self._gas.learn(np.clip(scene, 0.0, 1.0))
        self._annotate(learnt.node, is_new=learnt.change in (Change.NEW, Change.SPLIT))
        self._drive_to(learnt.node)
        return learnt.node

    def position_m(self, number: int) -> tuple[float, float]:
        """Where a unit is; IndexError if there is none of the number."""
        if not 0 <= number < len(self._looks):
            raise IndexError(f"unit {number} of {len(self._looks)}")
        return float(self._places[number, 0]), float(self._places[number, 1])

    def graph(self) -> TopoGraph:
        """Edges driven often enough and the nodes they join: what is not joined is not part of the driven space."""
        edges = tuple(
            (a, b, round(edge.strength, 6), edge.driven)
            for (a, b), edge in sorted(self.edges.items())
            if edge.driven >= self.rules.driven_at_least
        )
        numbers = sorted({number for a, b, _, _ in edges for number in (a, b)})
        vectors = self._gas.vectors
        nodes = (TopoNode(n, self.position_m(n), self._looks[n], vectors[n].copy()) for n in numbers)
        return TopoGraph(tuple(nodes), edges)

    def arrays(self) -> list[NDArray[Any]]:
        """All that the map is, for from_arrays."""
        count = len(self._looks)
        gas = self._gas.state()
        edges = [(a, b, e.strength, e.up, e.down) for (a, b), e in sorted(self.edges.items())]
        places, rings = self._references.arrays()
        pose = (self.pose.x_m, self.pose.y_m, self.pose.yaw_rad, self.drift_rad_per_m)
        last = [-1 if number is None else number for number in (self._before_last, self._last)]
        return [
            gas.vectors,
            gas.counts,
            self._places[:count].copy(),
            np.array(self._looks, dtype=np.int64),
            np.array(self._scatter, dtype=np.float64),
            np.array(edges, dtype=np.float64).reshape(-1, 5),
            places,
            rings,
            np.array(pose),
            np.array([gas.total, self.dropped, *last], dtype=np.int64),
        ]

    @classmethod
    def from_arrays(cls, arrays: Sequence[NDArray[Any]], rules: AliceRules | None = None) -> AliceMap:
        """The map that arrays() told. ValueError if they are damaged or do not fit together."""
        if len(arrays) != _ARRAYS:
            raise ValueError(f"a map of ALICE is {_ARRAYS} arrays, got {len(arrays)}")
        vectors, counts, places, looks, scatter, edges, reference_places, rings, pose, numbers = arrays
        count = len(counts)
        shapes = [array.shape for array in arrays]
        wanted = [(count, 2 * RING), (count,), (count, 2), (count,), (count,), (len(edges), 5)]
        wanted += [(len(rings), 2), (len(rings), RING), (4,), (4,)]
        if shapes != wanted or not all(np.all(np.isfinite(array)) for array in arrays):
            raise ValueError(f"arrays of a map of ALICE do not fit together: {shapes}")
        topo = cls(rules)
        total, topo.dropped, before_last, last = (int(number) for number in numbers)
        topo._gas = NeuralGas.from_state(GasState(vectors, counts, total), topo.rules.gas)
        topo._places = np.concatenate((places, np.zeros((max(64, count), 2))))
        topo._looks = [int(number) for number in looks]
        topo._scatter = [float(value) for value in scatter]
        topo._neighbours = {number: set() for number in range(count)}
        for a, b, strength, up, down in edges:
            pair = (int(a), int(b))
            if not 0 <= pair[0] < pair[1] < count:
                raise ValueError(f"an edge of a map of ALICE joins {pair} of {count} units")
            topo.edges[pair] = Edge(float(strength), int(up), int(down))
            topo._neighbours[pair[0]].add(pair[1])
            topo._neighbours[pair[1]].add(pair[0])
        if max(before_last, last) >= count:
            raise ValueError(f"a map of ALICE ends at unit {max(before_last, last)} of {count}")
        topo._before_last, topo._last = (None if number < 0 else number for number in (before_last, last))
        for place, ring in zip(reference_places, rings):
            topo._references.keep((float(place[0]), float(place[1])), ring)
        topo.pose = Pose2(float(pose[0]), float(pose[1]), float(pose[2]))
        topo.drift_rad_per_m = float(pose[3])
        return topo

    def _move(self, way_m: tuple[float, float]) -> None:
        """Half the drift before, half after the way: the body turns while it drives."""
        drift = self.drift_rad_per_m * math.hypot(*way_m)
        turned = Pose2(self.pose.x_m, self.pose.y_m, wrap_angle(self.pose.yaw_rad + 0.5 * drift))
        moved = turned @ Pose2(way_m[0], way_m[1], 0.0)
        self.pose = Pose2(moved.x_m, moved.y_m, wrap_angle(moved.yaw_rad + 0.5 * drift))

    def _correct_heading(self, lights: F64, way_m: float) -> None:
        """By what the light should be here, told from where it was seen before; and remember it where it was not."""
        here = (self.pose.x_m, self.pose.y_m)
        expected = self._references.expected(here)
        if expected is not None:
            turns, likeness = ring_offsets(lights, expected)
            error = wrap_angle(float(turns[0]) - self.pose.yaw_rad)
            if likeness[0] < self.rules.likeness or abs(error) > self.rules.outlier_rad:
                return  # a false measurement, or lamps were switched: nothing to learn from
            if way_m > 0.0:
                self.drift_rad_per_m += self.rules.drift_gain * error
            self.pose = Pose2(*here, wrap_angle(self.pose.yaw_rad + self.rules.gain * error))
        self._references.keep(here, turned_ring(lights, self.pose.yaw_rad))

    def _annotate(self, node: int, *, is_new: bool) -> None:
        """Mean of the places where the unit was met; and a pull of the robot towards it."""
        here = np.array([self.pose.x_m, self.pose.y_m])
        if is_new:
            if node == len(self._places):
                self._places = np.concatenate((self._places, np.zeros_like(self._places)))
            self._places[node] = here
            self._looks.append(1)
            self._scatter.append(0.0)
            self._neighbours[node] = set()
            return
        if self.rules.correct_heading and self._looks[node] >= _PULL_LOOKS:
            toward = self._places[node] - here
            width = math.sqrt(self._scatter[node] / self._looks[node])
            if width <= self.rules.pull_width_m and math.hypot(*toward) <= 4.0 * self.rules.pull_width_m:
                here = here + self.rules.pull * toward
                self.pose = Pose2(float(here[0]), float(here[1]), self.pose.yaw_rad)
        self._looks[node] += 1
        away = here - self._places[node]
        self._places[node] += away / self._looks[node]
        self._scatter[node] += float(away @ (here - self._places[node]))

    def _drive_to(self, node: int) -> None:
        before_last, last = self._before_last, self._last
        if last == node:
            return
        self._before_last, self._last = last, node
        if last is None:
            return
        driven = (min(last, node), max(last, node))
        for other in list(self._neighbours[last]):
            pair = (min(last, other), max(last, other))
            if pair == driven:
                continue
            rival = self.edges[pair]
            rival.strength -= self.rules.weaken
            if rival.strength < self.rules.drop_below:
                self._drop(pair)
        edge = self.edges.get(driven)
        if edge is None:
            edge = self.edges[driven] = Edge(self.rules.new_strength)
            self._neighbours[last].add(node)
            self._neighbours[node].add(last)
        elif node != before_last:  # going straight back proves nothing
            edge.strength = min(edge.strength + 1.0, self.rules.most_strength)
        if last < node:
            edge.up += 1
        else:
            edge.down += 1

    def _drop(self, pair: tuple[int, int]) -> None:
        del self.edges[pair]
        self._neighbours[pair[0]].discard(pair[1])
        self._neighbours[pair[1]].discard(pair[0])
        self.dropped += 1


class _References:
    """Light impressions and where they were had, the first in each square of a grid; never changed, so that heading
    errors cannot creep into them."""

    def __init__(self, square_m: float) -> None:
        self._square_m = square_m
        self._squares: dict[tuple[int, int], int] = {}
        self._places: F64 = np.zeros((64, 2))
        self._rings: F64 = np.zeros((64, RING))

    def arrays(self) -> tuple[F64, F64]:
        """(N, 2) places and (N, 24) rings, in the order of keeping."""
        count = len(self._squares)
        return self._places[:count].copy(), self._rings[:count].copy()

    def keep(self, here: tuple[float, float], ring: F64) -> None:
        """Remember the ring, turned to heading 0, if this square has none."""
        square = (math.floor(here[0] / self._square_m), math.floor(here[1] / self._square_m))
        number = len(self._squares)
        if self._squares.setdefault(square, number) < number:
            return
        if number == len(self._places):
            self._places = np.concatenate((self._places, np.zeros_like(self._places)))
            self._rings = np.concatenate((self._rings, np.zeros_like(self._rings)))
        self._places[number], self._rings[number] = here, ring

    def expected(self, here: tuple[float, float]) -> F64 | None:
        """(24,) the ring at heading 0: a plane through those around, weighted by nearness, so that lamps that move by
        as one drives past do not look like a turn; None if there is none near."""
        count = len(self._squares)
        away = (self._places[:count] - here) / self._square_m
        squared = np.einsum("ij,ij->i", away, away)
        near = np.flatnonzero(squared < _NEAR_SQUARES**2)
        if not len(near):
            return None
        weight = np.exp(-squared[near] / 4.0)
        columns = np.concatenate((np.ones((len(near), 1)), away[near]), axis=1)
        normal = columns.T @ (weight[:, None] * columns)
        normal[1, 1] += _FLATTER
        normal[2, 2] += _FLATTER
        plane: F64 = np.linalg.solve(normal, columns.T @ (weight[:, None] * self._rings[near]))
        level: F64 = plane[0]
        return level


def _ring(values: ArrayLike, what: str) -> F64:
    ring = np.asarray(values, dtype=np.float64)
    if ring.shape != (RING,) or not (ring.min() >= 0.0 and ring.max() <= 1.0):  # NaN fails both
        raise ValueError(f"{what} is {RING} values in [0, 1]")
    return ring
