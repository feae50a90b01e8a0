"""S21 and S22: distances against eq. 5.39, matches against a slow search through all assignments."""

from __future__ import annotations

import itertools
import math
from typing import Any

import networkx as nx
import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.features.anchors import AnchorKind, Anchors, no_anchors
from mapping.features.graph import AnchorGraph, MatchRules, anchor_graph, compare, polar_distance
from mapping.frames import Pose2, wrap_angle

F64 = NDArray[np.float64]
NAN = math.nan


def plain(points: F64, kind: AnchorKind = AnchorKind.WALL_END) -> Anchors:
    """Anchors without walls, so that distances alone tell."""
    rows = [[x, y, kind, NAN, NAN, 1.0, 0.0] for x, y in points]
    return Anchors(np.array(rows, dtype=np.float64).reshape(-1, 7))


def scattered(seed: int, count: int) -> F64:
    """Points at least 0.8 m apart in a hall of 12 x 9 m."""
    random, points = np.random.default_rng(seed), np.empty((0, 2))
    while len(points) < count:
        point = random.uniform([0.0, 0.0], [12.0, 9.0])
        if not len(points) or np.hypot(*(points - point).T).min() > 0.8:
            points = np.vstack((points, point))
    return points


def largest_clique(first: F64, second: F64, tolerance: float) -> int:
    """Most points that can be assigned so that all distances agree: the largest clique of the association graph."""
    graph: Any = nx.Graph()
    pairs = list(itertools.product(range(len(first)), range(len(second))))
    graph.add_nodes_from(pairs)
    for (i, k), (j, m) in itertools.combinations(pairs, 2):
        if i != j and k != m and abs(math.dist(first[i], first[j]) - math.dist(second[k], second[m])) <= tolerance:
            graph.add_edge((i, k), (j, m))
    return max(len(clique) for clique in nx.find_cliques(graph))


def test_distances_are_equation_5_39() -> None:
    random = np.random.default_rng(1)
    r, b = random.uniform(0.5, 20.0, (2, 50)), random.uniform(-3.0, 3.0, (2, 50))
    printed = np.sqrt(r[0] ** 2 + r[1] ** 2 - 2.0 * r[0] * r[1] * np.cos(b[1] - b[0]))
    np.testing.assert_allclose(polar_distance(r[0], b[0], r[1], b[1]), printed, rtol=1e-9)
    assert float(polar_distance(7.0, 0.4, 7.0, 0.4)) == 0.0
    graph = AnchorGraph(plain(np.stack((r[0] * np.cos(b[0]), r[0] * np.sin(b[0])), axis=-1)))
    np.testing.assert_allclose(graph.distance_m[0], polar_distance(r[0, 0], b[0, 0], r[0], b[0]), atol=1e-12)


def test_the_graph_is_complete_and_its_edges_fall() -> None:
    graph = anchor_graph(plain(scattered(2, 7)))
    assert len(graph.edges) == 7 * 6 // 2
    assert len({tuple(edge) for edge in graph.edges.tolist()}) == 21
    assert (np.diff(graph.length_m) <= 0.0).all()


def test_false_edges_are_left_out_and_virtual_ones_join() -> None:
    anchors = Anchors(np.concatenate([plain(scattered(3, 2), kind).rows for kind in AnchorKind]))
    kinds = anchor_graph(anchors, plain(scattered(4, 3), AnchorKind.VIRTUAL)).anchors.kinds.tolist()
    assert AnchorKind.FALSE_EDGE not in kinds
    assert kinds.count(AnchorKind.VIRTUAL) == 3
    assert len(kinds) == 9


@pytest.mark.parametrize("seed", range(8))
def test_a_part_of_a_scene_is_found_with_its_pose(seed: int) -> None:
    random = np.random.default_rng(100 + seed)
    scene = scattered(seed, 9)
    pose = Pose2(float(random.uniform(-5, 5)), float(random.uniform(-5, 5)), float(random.uniform(-3, 3)))
    order = random.permutation(9)
    seen = pose.inverse().apply(scene[order[:6]])  # three are hidden
    ghosts = scattered(seed + 50, 3) + [20.0, 0.0]
    found = compare(anchor_graph(plain(np.vstack((seen, ghosts)))), anchor_graph(plain(scene)))
    assert found is not None
    truth = {(i, int(order[i])) for i in range(6)}
    assert truth <= {tuple(pair) for pair in found.pairs.tolist()}
    assert math.hypot(found.second_from_first.x_m - pose.x_m, found.second_from_first.y_m - pose.y_m) < 0.1
    assert abs(wrap_angle(found.second_from_first.yaw_rad - pose.yaw_rad)) < 0.05


@pytest.mark.parametrize("seed", range(6))
def test_as_many_partners_as_the_largest_clique_has(seed: int) -> None:
    scene = scattered(seed, 6)
    seen = Pose2(1.0, 2.0, 0.7).apply(scene[:4])
    first = np.vstack((seen, scattered(seed + 9, 2) + 30.0))
    found = compare(anchor_graph(plain(first)), anchor_graph(plain(scene)), MatchRules(tolerance_m=0.01, near_m=0.01))
    assert found is not None
    assert len(found) == largest_clique(first, scene, 0.01)
    assert found.rms_m < 1e-6


def test_a_mirror_image_is_another_scene() -> None:
    scene = scattered(5, 8)
    mirrored = scene * [1.0, -1.0]
    rules = MatchRules(tolerance_m=0.02, near_m=0.02, least=4)
    assert compare(anchor_graph(plain(mirrored)), anchor_graph(plain(scene)), rules) is None


def test_walls_tell_scenes_apart_that_distances_do_not() -> None:
    points = scattered(6, 5)
    rows = plain(points, AnchorKind.JUMP_EDGE).rows
    rows[:, 3] = [0.0, 1.0, 2.0, 3.0, -1.0]
    other = rows.copy()
    other[:, 3] += [0.0, 1.0, 1.5, 2.0, -1.0]
    same, differ = anchor_graph(Anchors(rows)), anchor_graph(Anchors(other))
    match = compare(same, same, MatchRules(near_m=0.05))
    assert match is not None
    assert len(match) == 5
    assert compare(same, differ, MatchRules(near_m=0.05)) is None


def test_too_little_is_not_recognised() -> None:
    scene = anchor_graph(plain(scattered(7, 6)))
    assert compare(anchor_graph(no_anchors()), scene) is None
    assert compare(anchor_graph(plain(scattered(7, 1))), scene) is None
    assert compare(anchor_graph(plain(scattered(7, 2))), scene) is None
    assert compare(scene, anchor_graph(no_anchors())) is None
    twins = anchor_graph(plain(np.zeros((5, 2))))
    assert compare(twins, twins) is None or len(compare(twins, twins) or ()) <= 5


def test_a_crowd_is_cut_to_the_longest_walls() -> None:
    rows = plain(np.random.default_rng(1).uniform(0, 50, (300, 2))).rows
    rows[:, 5] = np.arange(300)
    kept = anchor_graph(Anchors(rows))
    assert len(kept) == 256
    assert kept.anchors.rows[:, 5].min() == 44


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="finite"):
        anchor_graph(plain(np.array([[math.inf, 0.0]])))
    with pytest.raises(ValueError, match="near_m"):
        MatchRules(near_m=math.nan)
    with pytest.raises(ValueError, match="at least 2"):
        MatchRules(least=1)
