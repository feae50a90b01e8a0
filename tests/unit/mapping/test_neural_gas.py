"""Growing neural gas: exact search against brute force, both rules against literal versions (S42)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.topology import nearest
from mapping.topology.nearest import NearestNodes
from mapping.topology.neural_gas import (
    Change,
    FritzkeGas,
    FritzkeRules,
    GasRules,
    GasState,
    NeuralGas,
    flat_picture,
    quantisation_error,
)

F64 = NDArray[np.float64]
GRADES = [0.0, 0.125, 0.25, 0.5, 0.75, 1.0]


def impressions(count: int, seed: int) -> F64:
    """Vectors as a robot with 24 light and 24 touch sensors gets them in a room with five lamps."""
    random = np.random.default_rng(seed)
    lamps = np.array([[0.0, 0.0], [8.0, 1.0], [4.0, 6.0], [1.0, 5.0], [7.0, 5.5]])
    place, yaw = random.random((count, 2)) * [8.0, 6.0], random.random(count) * 2.0 * np.pi
    bearing = yaw[:, None] + np.arange(24) * np.pi / 12.0
    light = np.zeros((count, 24))
    for lamp in lamps:
        away = lamp - place
        off = bearing - np.arctan2(away[:, 1], away[:, 0])[:, None]
        light += np.exp(-((np.angle(np.exp(1j * off)) / 0.35) ** 2)) / (1.0 + np.sum(away**2, axis=1))[:, None]
    light = np.clip(light / light.max() + random.normal(0.0, 0.02, light.shape), 0.0, 1.0)
    x, y = place[:, :1] + 0.35 * np.cos(bearing), place[:, 1:] + 0.35 * np.sin(bearing)
    touch = ((x < 0.0) | (x > 8.0) | (y < 0.0) | (y > 6.0)).astype(float)
    touch = (2.0 * touch + np.roll(touch, 1, axis=1) + np.roll(touch, -1, axis=1)) / 4.0
    return np.concatenate((light, touch), axis=1)


def brute(nodes: F64, vector: F64) -> tuple[int, float]:
    distance = np.sqrt(np.sum((nodes - vector) ** 2, axis=1))
    return int(np.argmin(distance)), float(distance.min())


@pytest.mark.parametrize("reach", [None, 0.05, 0.2, 0.6])
@pytest.mark.parametrize("kind", ["impressions", "uniform", "clumped"])
def test_nearest_is_that_of_brute_force(kind: str, reach: float | None) -> None:
    random = np.random.default_rng(3)
    vectors = {
        "impressions": impressions(3400, 1),
        "uniform": random.random((3400, 48)),
        "clumped": np.clip(
            random.random((40, 48))[random.integers(0, 40, 3400)] + random.normal(0, 0.01, (3400, 48)), 0, 1
        ),
    }[kind]
    nodes, queries = vectors[:3000].copy(), vectors[3000:]
    net = NearestNodes(48, reach=reach)
    for vector in nodes:
        net.add(vector)
    for number in random.integers(0, 3000, 300):  # moved a little, and across the room
        nodes[number] = np.clip(nodes[number] + 0.01, 0.0, 1.0) if number % 2 else random.random(48)
        net.move(int(number), nodes[number])
    for query in queries:
        number, distance = brute(nodes, query)
        found = net.nearest(query)
        assert found is not None
        assert found[0] == number
        assert found[1] == pytest.approx(distance, abs=1e-12)
        if reach is not None:
            within = net.within_reach(query)
            assert (within is None) == (distance > reach)
            assert within is None or within[0] == number
    assert net.effort.queries == 400 * (1 if reach is None else 2)


@pytest.mark.parametrize("kind", ["impressions", "uniform", "equal"])
def test_a_hundred_thousand_answers_are_those_of_brute_force(kind: str) -> None:
    random = np.random.default_rng(11)
    count = 33_334
    vectors = impressions(count + 2500, 7) if kind == "impressions" else random.random((count + 2500, 48))
    if kind == "equal":  # quarters, whose sums are exact: many nodes equally far
        vectors = np.round(vectors[:, :6] * 4.0) / 4.0
    nodes, queries = vectors[:2500], vectors[2500:]
    net = NearestNodes(vectors.shape[1])
    for vector in nodes:
        net.add(vector)
    for first in range(0, count, 4096):
        asked = queries[first : first + 4096]
        about = np.sum(nodes**2, axis=1) - 2.0 * asked @ nodes.T + np.sum(asked**2, axis=1)[:, None]
        for query, row in zip(asked, about):
            near = np.flatnonzero(row <= row.min() + 1e-9)  # the product is off by less; exact among these
            exact = np.sum((nodes[near] - query) ** 2, axis=1)
            found = net.nearest(query)
            assert found is not None
            assert found[1] == pytest.approx(math.sqrt(exact.min()), abs=1e-12)
            same = near[exact <= exact.min() + 1e-14]
            assert found[0] == same[0] if len(same) == 1 or kind == "equal" else found[0] in same


def test_exact_while_nodes_come_and_move() -> None:
    """Through blocks that fill, are sorted, and are made anew."""
    random = np.random.default_rng(12)
    vectors = impressions(4000, 9)
    net, nodes = NearestNodes(48), np.zeros((0, 48))
    for k, vector in enumerate(vectors):
        net.add(vector)
        nodes = vectors[: k + 1]
        if k > nearest.FLAT_BELOW and k % 8 == 0:
            at = int(random.integers(k))
            vectors[at] = np.clip(vectors[at] + random.normal(0.0, 0.02 if k % 16 else 0.5, 48), 0.0, 1.0)
            net.move(at, vectors[at])
            query = np.clip(vectors[int(random.integers(4000))] + random.normal(0.0, 0.01, 48), 0.0, 1.0)
            assert net.nearest(query) == pytest.approx(brute(nodes, query))
    for _ in range(9 * len(nodes)):
        at = int(random.integers(len(nodes)))
        vectors[at, 5] = random.random()
        net.move(at, vectors[at])
    for query in impressions(200, 10):
        assert net.nearest(query) == pytest.approx(brute(vectors, query))


def test_boxes_rule_out_most_nodes_where_vectors_lie_together() -> None:
    vectors = impressions(20_500, 2)
    net = NearestNodes(48)
    for vector in vectors[:20_000]:
        net.add(vector)
    for vector in vectors[20_000:]:
        net.nearest(vector)
    assert net.effort.looked_at < 0.4 * 500 * 20_000
    assert net.effort.read < 500 * 1.2


def test_marks_answer_where_they_help_and_rest_where_they_do_not() -> None:
    random = np.random.default_rng(5)
    fine = NearestNodes(4, reach=0.02)
    for vector in random.random((4000, 4)):
        fine.add(vector)
    for vector in random.random((200, 4)):
        fine.within_reach(vector)
    assert fine.marks_pay
    assert fine.effort.by_marks == 200
    assert fine.effort.by_bounds == 0
    assert fine.effort.candidates < 200 * 4000 / 500

    coarse = NearestNodes(4, reach=0.4)
    for vector in random.random((4000, 4)):
        coarse.add(vector)
    for vector in random.random((400, 4)):
        coarse.within_reach(vector)
    assert not coarse.marks_pay
    assert coarse.effort.by_bounds > 390


def test_bounds_read_few_nodes() -> None:
    vectors = impressions(4200, 2)
    net = NearestNodes(48)
    for vector in vectors[:4000]:
        net.add(vector)
    for vector in vectors[4000:]:
        net.nearest(vector)
    assert net.effort.by_bounds == 200
    assert net.effort.read < 200 * 4000 / 40


@settings(max_examples=60, deadline=None)
@given(
    nodes=st.lists(st.lists(st.sampled_from(GRADES), min_size=3, max_size=3), min_size=1, max_size=40),
    query=st.lists(st.sampled_from([*GRADES, 0.375]), min_size=3, max_size=3),
    reach=st.sampled_from([0.125, 0.25, 0.3, 0.5]),
    finer=st.integers(0, 2),
)
def test_marks_miss_no_node_within_reach(
    nodes: list[list[float]], query: list[float], reach: float, finer: int
) -> None:
    """On the borders of intervals and at exactly D; the flat search is not allowed to help out."""
    table, vector = np.array(nodes), np.array(query)
    net = NearestNodes(3, reach=reach, finer_bits=finer)
    for row in table:
        net.add(row)
    assert net._marks is not None
    best, squared, candidates = net._marks.nearest(net._nodes, len(table), vector, len(table))
    number, distance = brute(table, vector)
    if distance <= reach:
        assert best == number
        assert squared == pytest.approx(distance**2)
    boxed = np.all(np.abs(table - vector) <= reach, axis=1)
    assert candidates >= int(boxed.sum())


def test_equals_go_to_the_first() -> None:
    for count in (3, nearest.FLAT_BELOW * 3):
        net = NearestNodes(2, reach=0.1)
        for _ in range(count):
            net.add([0.5, 0.5])
        found = net.nearest([0.52, 0.5])
        assert found is not None
        assert found[0] == 0
        assert found[1] == pytest.approx(0.02)


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="dimensions"):
        NearestNodes(0)
    for reach in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="reach"):
            NearestNodes(2, reach=reach)
    with pytest.raises(ValueError, match="finer_bits"):
        NearestNodes(2, reach=0.1, finer_bits=-1)
    net = NearestNodes(2, reach=0.5)
    assert net.nearest([0.0, 0.0]) is None
    assert net.within_reach([0.0, 0.0]) is None
    for vector in ([0.0], [0.0, math.nan], [0.0, 1.1], [-0.1, 0.0], [[0.0, 0.0]]):
        with pytest.raises(ValueError, match="scene vector"):
            net.add(vector)
    assert len(net) == 0
    with pytest.raises(IndexError):
        net.move(0, [0.0, 0.0])
    with pytest.raises(ValueError, match="no reach"):
        NearestNodes(2).within_reach([0.0, 0.0])
    with pytest.raises(ValueError, match="read-only"):
        net.vectors[...] = 1.0


# --- the book's rule


class Literal:
    """Algorithm 5.5 line by line."""

    def __init__(self, rules: GasRules) -> None:
        self.rules, self.nodes, self.counts = rules, [], []  # type: ignore[var-annotated]

    def learn(self, scene: F64) -> None:
        if not self.nodes:
            self.nodes.append(scene.copy())
            self.counts.append(0)
            return
        distances = [math.dist(node, scene) for node in self.nodes]
        i = distances.index(min(distances))
        if distances[i] > self.rules.new_node_distance:
            self.nodes.append(scene.copy())
            self.counts.append(0)
        elif self.counts[i] < self.rules.split_count:
            self.counts[i] += 1
            for r in range(len(scene)):
                self.nodes[i][r] += self.rules.shift * (scene[r] - self.nodes[i][r]) / self.counts[i]
        else:
            self.counts[i] = self.rules.split_count // 2
            self.nodes.append(scene.copy())
            self.counts.append(self.rules.split_count // 2)


def test_net_is_that_of_the_literal_algorithm() -> None:
    rules = GasRules(new_node_distance=0.3, split_count=12, shift=0.4)
    gas, literal = NeuralGas(48, rules), Literal(rules)
    for scene in impressions(900, 7):
        gas.learn(scene)
        literal.learn(scene)
    assert len(gas) == len(literal.nodes) > nearest.FLAT_BELOW
    np.testing.assert_allclose(gas.vectors, literal.nodes, atol=1e-12)
    assert gas.counts.tolist() == literal.counts
    assert gas.total == 900


def test_steps_of_the_algorithm() -> None:
    gas = NeuralGas(1, GasRules(new_node_distance=0.2, split_count=2, shift=0.5))
    assert gas.learn([0.1]).change is Change.NEW
    assert gas.learn([0.3]).change is Change.SHIFTED  # exactly D away is not farther than D
    assert gas.vectors.tolist() == [[pytest.approx(0.2)]]  # by epsilon (s - b) / 1
    gas.learn([0.3])
    assert gas.vectors[0, 0] == pytest.approx(0.225)  # by epsilon (s - b) / 2
    split = gas.learn([0.3])
    assert (split.node, split.change) == (1, Change.SPLIT)
    assert gas.counts.tolist() == [1, 1]
    assert gas.vectors[:, 0].tolist() == [pytest.approx(0.225), 0.3]
    assert gas.total == 4
    assert gas.learn([0.9]).node == 2
    assert gas.match([0.51]) is None
    matched, near = gas.match([0.31]), gas.nearest([0.55])
    assert matched is not None
    assert near is not None
    assert (matched[0], near[0]) == (1, 1)
    assert matched[1] == pytest.approx(0.01)
    assert near[1] == pytest.approx(0.25)


def test_same_vector_for_ever_is_one_node() -> None:
    gas = NeuralGas(2, GasRules(new_node_distance=0.1, split_count=4))
    for _ in range(100):
        gas.learn([0.5, 0.5])
    assert len(gas) == 1
    assert gas.total == 100


def test_full_net_says_so_and_keeps_learning() -> None:
    gas = NeuralGas(1, GasRules(new_node_distance=0.1, split_count=2, max_nodes=2))
    gas.learn([0.0])
    gas.learn([0.5])
    assert gas.learn([1.0]).change is Change.FULL
    changes = [gas.learn([0.52]).change for _ in range(3)]
    assert changes == [Change.SHIFTED, Change.SHIFTED, Change.FULL]  # due to be split, but there is no room
    assert len(gas) == 2
    assert gas.total == 6


def test_state_brings_the_net_back() -> None:
    rules = GasRules(new_node_distance=0.4, split_count=10)
    gas = NeuralGas(48, rules)
    for scene in impressions(300, 8):
        gas.learn(scene)
    again = NeuralGas.from_state(gas.state(), rules)
    for scene in impressions(100, 9):
        assert gas.learn(scene) == again.learn(scene)
    np.testing.assert_array_equal(gas.vectors, again.vectors)


@pytest.mark.parametrize(
    "state",
    [
        GasState(np.zeros((2, 3)), np.zeros(1, dtype=np.int64), 0),
        GasState(np.zeros(3), np.zeros(3, dtype=np.int64), 0),
        GasState(np.full((1, 3), 2.0), np.zeros(1, dtype=np.int64), 0),
        GasState(np.zeros((1, 3)), np.array([-1]), 0),
        GasState(np.zeros((1, 3)), np.array([1]), -1),
        GasState(np.zeros((3, 3)), np.zeros(3, dtype=np.int64), 3),
    ],
)
def test_broken_state_is_refused(state: GasState) -> None:
    with pytest.raises(ValueError):
        NeuralGas.from_state(state, GasRules(max_nodes=2))


@pytest.mark.parametrize(
    "wrong",
    [{"new_node_distance": 0.0}, {"new_node_distance": math.nan}, {"split_count": 1}, {"shift": 0.0}, {"max_nodes": 0}],
)
def test_wrong_rules(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError):
        GasRules(**wrong)  # type: ignore[arg-type]


# --- Fritzke's rule


def test_fritzke_grows_along_two_rings() -> None:
    """Nodes spread over both rings, edges never join them once they are found: topology is learnt."""
    random = np.random.default_rng(4)
    gas = FritzkeGas(2, FritzkeRules(max_nodes=40, every=50, oldest=30))
    for _ in range(6000):
        angle, centre = random.random() * 2.0 * math.pi, random.choice([0.25, 0.75])
        gas.learn([centre + 0.15 * math.cos(angle), 0.5 + 0.15 * math.sin(angle)])
    assert len(gas) == 40
    nodes = {number: gas.vector(number) for number in gas.numbers}
    for vector in nodes.values():
        off = min(abs(math.dist(vector, (centre, 0.5)) - 0.15) for centre in (0.25, 0.75))
        assert off < 0.03
    assert all((nodes[a][0] < 0.5) == (nodes[b][0] < 0.5) for a, b in gas.edges)
    degree = np.bincount(np.array(gas.edges).ravel())
    assert np.median(degree[degree > 0]) == 2.0


def test_fritzke_step_by_step() -> None:
    gas = FritzkeGas(1, FritzkeRules(shift=0.5, neighbour_shift=0.1, oldest=1, every=3, decay=1.0, max_nodes=3))
    assert [gas.learn([0.0]), gas.learn([1.0])] == [0, 1]
    assert gas.learn([0.2]) == 0  # total 3: a node goes between the two
    assert len(gas) == 3
    assert gas.vector(0)[0] == pytest.approx(0.1)
    assert gas.vector(2)[0] == pytest.approx(0.5 * (0.1 + 1.0))
    assert gas.edges == [(0, 2), (1, 2)]
    gas.learn([0.1])  # 0 nearest, 2 second; the edge 0-2 is new again
    assert gas.edges == [(0, 2), (1, 2)]
    assert gas.vector(2)[0] == pytest.approx(0.55 + 0.1 * (0.1 - 0.55))
    for _ in range(2):
        gas.learn([0.3])  # between 0 and 2: the edge from the nearer to 1 ages, breaks at 2, and 1 dies with it
    assert 1 in gas.numbers or (0, 2) in gas.edges
    with pytest.raises(KeyError):
        gas.vector(77)
    for vector in ([0.0, 0.0], [math.inf]):
        with pytest.raises(ValueError):
            gas.learn(vector)
    for wrong in ({"shift": 1.5}, {"oldest": 0}, {"max_nodes": 1}):
        with pytest.raises(ValueError):
            FritzkeRules(**wrong)


# --- figures


def test_quantisation_error_and_picture() -> None:
    vectors = impressions(200, 6)
    nodes = vectors[:50]
    expected = [brute(nodes, vector)[1] for vector in vectors]
    np.testing.assert_allclose(quantisation_error(nodes, vectors), expected, atol=1e-12)
    with pytest.raises(ValueError, match="no node"):
        quantisation_error(np.zeros((0, 48)), vectors)
    drawn = flat_picture(vectors)
    assert drawn.shape == (200, 2)
    singular = np.linalg.svd(vectors - vectors.mean(axis=0), compute_uv=False)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=0), singular[:2], rtol=1e-9)
    assert flat_picture(np.zeros((0, 5))).shape == (0, 2)
    assert flat_picture(np.array([[0.0], [1.0]])).tolist() == [[-0.5, 0.0], [0.5, 0.0]]
    with pytest.raises(ValueError):
        flat_picture(np.zeros(3))
