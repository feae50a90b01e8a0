"""Anchors of the last metres as one graph: joined by odometry, each once; they tell a place that one sweep cannot."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mapping.features.anchors import Anchors, no_anchors
from mapping.features.graph import anchor_graph
from mapping.features.scenes import SceneDatabase, sight_of
from mapping.features.stretch import LENGTH_M, MOST, Stretch, merged
from mapping.frames import Pose2
from tests.unit.mapping.test_features_scenes import DRIVE, flat, scan_at

ODOMETRY_FROM_MAP = Pose2(4.0, -7.0, 0.8)


def way(count: int, step_m: float = 0.3) -> list[Pose2]:
    return [Pose2(1.3 + step_m * k, 1.6, 0.02 * k) for k in range(count)]


def driven(poses: list[Pose2]) -> Stretch:
    stretch = Stretch()
    for k, pose in enumerate(poses):
        stretch.take(scan_at(flat(), pose, seed=40 + k), ODOMETRY_FROM_MAP @ pose)
    return stretch


def test_the_graph_of_a_stretch_lies_on_what_the_newest_sweep_would_see() -> None:
    poses = way(6)
    graph = driven(poses).graph()
    single = sight_of(scan_at(flat(), poses[-1], seed=45)).graph
    assert len(graph) > len(single) >= 2
    assert np.array_equal(graph.anchors.rows[: len(single)], single.anchors.rows, equal_nan=True)
    walls = flat()
    corners = np.concatenate((walls[:, :2], walls[:, 2:]))
    crossings = np.array([[x, y] for x in (5.0, 9.5) for y in (0.0, 4.0)])
    places = poses[-1].apply(graph.anchors.points)
    known = np.concatenate((corners, crossings))
    off = np.min(np.hypot(*(places[:, None] - known[None]).transpose(2, 0, 1)), axis=1)
    assert np.mean(off < 0.15) > 0.7
    assert np.all(graph.anchors.beams[len(single) :] == -1)


def test_a_sweep_without_anchors_is_placed_by_those_of_the_way_there() -> None:
    database = SceneDatabase()
    for k, pose in enumerate(DRIVE):
        database.add(sight_of(scan_at(flat(), pose, seed=k)), pose)
    poses = way(6)
    stretch = driven(poses)
    bare = replace(sight_of(scan_at(flat(), poses[-1], seed=77)), graph=anchor_graph(no_anchors()))
    assert "too few" in database.where_am_i(bare).reason
    place = database.where_am_i(bare, on_the_way=stretch.graph()).place
    assert place is not None
    found = place.map_from_sensor
    assert math.hypot(found.x_m - poses[-1].x_m, found.y_m - poses[-1].y_m) < 0.05
    assert "too few" in database.where_am_i(bare, on_the_way=anchor_graph(no_anchors())).reason
    whole = sight_of(scan_at(flat(), poses[-1], seed=77))
    assert database.where_am_i(whole, on_the_way=anchor_graph(no_anchors())) == database.where_am_i(whole)


def test_only_the_last_metres_count_and_only_so_many_sweeps() -> None:
    far, near = driven(way(20)), driven(way(20)[-1 - math.ceil(LENGTH_M / 0.3) :])
    assert len(far.graph()) == pytest.approx(len(near.graph()), abs=3)
    turning = Stretch()
    for k in range(4 * MOST):
        turning.take(scan_at(flat(), Pose2(2.0, 2.0, 0.3 * k), seed=k), Pose2(2.0, 2.0, 0.3 * k))
    assert len(turning._kept) == MOST


def test_a_pose_that_jumps_and_a_corrected_map_begin_anew() -> None:
    poses = way(6)
    single = sight_of(scan_at(flat(), poses[-1], seed=45)).graph
    jumped = driven(poses)
    jumped.take(scan_at(flat(), poses[-1], seed=45), Pose2(50.0, 0.0, 0.0))
    assert len(jumped.graph()) == len(single)
    corrected = driven(poses)
    corrected.begin_anew()
    assert len(corrected.graph()) == len(single)
    assert Stretch().sight() is None
    assert len(Stretch().graph()) == 0


def test_anchors_at_one_place_are_one_unless_their_walls_differ() -> None:
    corner = [1.0, 2.0, 3.0, 0.5, math.nan, 1.0, 7.0]
    turned = [1.0, 2.0, 3.0, 2.5, math.nan, 1.0, 7.0]
    beside = [1.5, 2.0, 3.0, 0.5, math.nan, 1.0, 7.0]
    nearly = [1.1, 2.0, 3.0, 0.6, math.nan, 1.0, 7.0]
    found = merged([Anchors(np.array([corner])), Anchors(np.array([turned, beside, nearly]))])
    assert found.points.tolist() == [[1.0, 2.0], [1.0, 2.0], [1.5, 2.0]]
    assert found.beams.tolist() == [7, -1, -1]
    assert len(merged([])) == 0
