"""What other SLAM programs wrote is read as they meant it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.slam_peers import MissingError, after_scans, between_nodes, from_first
from bench.slam_peers_child import carried, compose, inverse, moved

ODOMETRY = np.array([(0.1 * k, 0.0, 0.0) for k in range(8)])  # 0.7 m straight on, a scan every 0.1 m


def test_icp_slam_writes_a_pose_after_each_scan_and_one_after_each_odometry() -> None:
    rows = np.array([(0, 9, 9, 9), (1, 1.0, 2.0, 0.3), (2, 9, 9, 9), (3, 1.5, 2.0, 0.4)])
    assert after_scans(rows).tolist() == [[1.0, 2.0, 0.3], [1.5, 2.0, 0.4]]


def test_scans_between_nodes_go_on_by_odometry_from_the_node_where_it_was_moved_to() -> None:
    graph = "VERTEX_SE2 0 0 0 0\nFIX 0\nVERTEX_SE2 1 0 1 1.5707963\nVERTEX_SE2 2 5 5 0\nEDGE_SE2 0 1 1 0 0\n"
    path = between_nodes(graph, ODOMETRY, 0.25, 1.0)
    assert path[[0, 2], :2] == pytest.approx(np.array([(0.0, 0.0), (0.2, 0.0)]))
    assert path[[3, 5], :2] == pytest.approx(np.array([(0.0, 1.0), (0.0, 1.2)]), abs=1e-6)
    assert path[[6, 7], :2] == pytest.approx(np.array([(5.0, 5.0), (5.1, 5.0)]))


def test_a_graph_with_another_number_of_nodes_is_not_guessed_at() -> None:
    with pytest.raises(MissingError, match="1 nodes where 3 were expected"):
        between_nodes("VERTEX_SE2 0 0 0 0\n", ODOMETRY, 0.25, 1.0)


def test_turns_count_the_short_way_round() -> None:
    odometry = np.array([(0.0, 0.0, math.pi - 0.01), (0.0, 0.0, -math.pi + 0.01), (0.0, 0.0, -math.pi + 0.3)])
    assert moved(odometry, 1.0, 0.2) == [2]


def test_poses_undo_each_other() -> None:
    a = (1.0, -2.0, 0.7)
    assert compose(inverse(a), a) == pytest.approx((0.0, 0.0, 0.0))
    seen = from_first([a, tuple(compose(a, (0.5, 0.1, 0.2)))])
    assert seen == pytest.approx(np.array([(0.0, 0.0, 0.0), (0.5, 0.1, 0.2)]))
    assert carried(seen, [0], np.array([a]))[1] == pytest.approx(compose(a, (0.5, 0.1, 0.2)))
