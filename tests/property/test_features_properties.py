"""What must hold of features whatever the scene: rigid motion, order, viewpoint, rubbish (S14 to S24)."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from mapping.features.anchors import AnchorFinder, AnchorKind, Anchors
from mapping.features.graph import AnchorGraph, anchor_graph, compare
from mapping.features.histograms import box_feature, main_orientation, square_scene, virtual_edges
from mapping.features.moments import (
    arc_weights,
    centre_of_gravity,
    inertia,
    moment,
    smoothed_distances,
    smoothed_inertia,
)
from mapping.features.range_image import segment_ranges, surface_angles
from mapping.features.vectors import Feature, FeatureSpace, Scale
from mapping.frames import Pose2, wrap_angle

F64 = NDArray[np.float64]
TURN = np.radians(np.arange(-180.0, 180.0, 0.5))

poses = st.builds(Pose2, st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1))
clouds = hnp.arrays(np.float64, st.tuples(st.integers(1, 40), st.just(2)), elements=st.floats(-20, 20))
places = st.tuples(st.floats(0.1, 0.9), st.floats(0.1, 0.9))
inside = st.tuples(st.floats(0.3, 0.7), st.floats(0.3, 0.7))  # so that beams follow every wall into its corners
odd = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -1.0, 1e300, 5e-324, 9e3, 2e4])
any_scan = st.lists(st.one_of(st.floats(0.05, 12.0), odd), max_size=90)
any_points = hnp.arrays(
    np.float64, st.tuples(st.integers(0, 40), st.just(2)),
    elements=st.one_of(st.floats(-20, 20), st.sampled_from([0.0, 1.0, 9e3, -9e3, 1e-300])),
)  # fmt: skip


def room_ranges(width: float, height: float, x: float, y: float, yaw: float) -> F64:
    """Ranges all round in the room [0, width] x [0, height]."""
    c, s = np.cos(TURN + yaw), np.sin(TURN + yaw)
    across = np.where(c > 0.0, width - x, x) / np.maximum(np.abs(c), 1e-9)
    along = np.where(s > 0.0, height - y, y) / np.maximum(np.abs(s), 1e-9)
    return np.asarray(np.minimum(across, along))


def points_of(ranges: F64) -> F64:
    return np.stack((ranges * np.cos(TURN), ranges * np.sin(TURN)), axis=-1)


@given(clouds, poses)
def test_inertia_moves_with_the_points(points: F64, pose: Pose2) -> None:
    here, there = inertia(points), inertia(pose.apply(points))
    assert math.dist(there.centre, pose.apply(np.array(here.centre))) < 1e-6
    assert abs(here.least - there.least) < 1e-6 * (1.0 + here.most)
    assert abs(here.most - there.most) < 1e-6 * (1.0 + here.most)
    if here.most > 1e-6 and here.axis_ratio < 0.9:
        off = wrap_angle(2.0 * (there.direction_rad - here.direction_rad - pose.yaw_rad))
        assert abs(off) < 1e-4


@given(clouds, st.floats(-100, 100), st.floats(-100, 100), st.integers(0, 3), st.integers(0, 3))
def test_central_moments_do_not_see_a_shift(points: F64, dx: float, dy: float, p: int, q: int) -> None:
    here = moment(points, p, q, central=True)
    there = moment(points + [dx, dy], p, q, central=True)
    assert abs(here - there) <= 1e-6 * (1.0 + 40.0 ** (p + q))


@given(clouds, st.floats(-3.2, 3.2))
def test_inertia_lies_between_its_least_and_its_most(points: F64, axis: float) -> None:
    found = inertia(points)
    assert found.least - 1e-9 * (1 + found.most) <= float(found.about(axis)) <= found.most + 1e-9 * (1 + found.most)
    assert 0.0 <= found.axis_ratio <= 1.0


@given(clouds, st.floats(0.1, 20.0), poses)
def test_smoothing_shortens_and_does_not_see_a_motion(points: F64, steepness: float, pose: Pose2) -> None:
    centre = centre_of_gravity(points)
    damped = smoothed_distances(points, steepness=steepness)
    assert (damped >= 0.0).all()
    assert (damped <= np.hypot(*(points - centre).T) + 1e-12).all()
    spread = float(np.hypot(*(points - centre).T).mean())
    assume(spread > 1e-3)
    np.testing.assert_allclose(smoothed_distances(pose.apply(points), steepness=steepness), damped, atol=1e-6)


@settings(max_examples=40)
@given(st.floats(4.0, 9.0), st.floats(3.0, 8.0), places, places, st.floats(-3.1, 3.1))
def test_invariants_of_a_room_do_not_depend_on_where_it_is_seen_from(
    width: float, height: float, one: tuple[float, float], two: tuple[float, float], yaw: float
) -> None:
    assume(abs(width - height) > 0.3)
    found = []
    for (u, v), turn in ((one, 0.0), (two, yaw)):
        points = points_of(room_ranges(width, height, u * width, v * height, turn))
        scene = square_scene(points, full_turn=True)
        assert scene is not None
        box = box_feature(scene)
        weighted = inertia(points, weight=arc_weights(points, gap_m=1.0, full_turn=True))
        in_room = Pose2(u * width, v * height, turn).apply(np.array(weighted.centre))
        found.append((box, weighted.axis_ratio, in_room))
    (box, ratio, centre), (other_box, other_ratio, other_centre) = found
    assert box is not None
    assert other_box is not None
    np.testing.assert_allclose(box.size_m, other_box.size_m, atol=0.1)
    assert abs(ratio - other_ratio) < 0.03
    np.testing.assert_allclose(centre, other_centre, atol=0.08)


@settings(max_examples=40)
@given(st.floats(4.0, 7.0), st.floats(4.0, 7.0), inside, inside, st.floats(-3.1, 3.1))
def test_corners_of_a_room_stay_and_imply_the_pose(
    width: float, height: float, one: tuple[float, float], two: tuple[float, float], yaw: float
) -> None:
    assume(abs(width - height) > 0.5)
    finder = AnchorFinder(TURN)
    first = Pose2(one[0] * width, one[1] * height, 0.0)
    second = Pose2(two[0] * width, two[1] * height, yaw)
    graphs = []
    for pose in (first, second):
        found = finder.find(room_ranges(width, height, pose.x_m, pose.y_m, pose.yaw_rad))
        corners = pose.apply(found.of_kinds(AnchorKind.CORNER).points)
        truth = np.array([[0, 0], [width, 0], [width, height], [0, height]])
        assert len(corners) == 4
        assert max(float(np.hypot(*(truth - corner).T).min()) for corner in corners) < 0.02
        graphs.append(anchor_graph(found))
    match = compare(graphs[1], graphs[0])
    assert match is not None
    assert len(match) == 4
    truth_pose = first.inverse() @ second
    # A rectangle is the same after half a turn.
    centre = Pose2(0.5 * width, 0.5 * height, 0.0)
    half = first.inverse() @ centre @ Pose2(0.0, 0.0, math.pi) @ centre.inverse() @ second
    implied = match.second_from_first
    assert (
        min(
            math.hypot(implied.x_m - p.x_m, implied.y_m - p.y_m) + abs(wrap_angle(implied.yaw_rad - p.yaw_rad))
            for p in (truth_pose, half)
        )
        < 0.05
    )


@given(hnp.arrays(np.float64, st.tuples(st.integers(4, 10), st.just(2)), elements=st.floats(-15, 15)), poses)
def test_a_graph_is_found_in_itself_after_any_motion(points: F64, pose: Pose2) -> None:
    gaps = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)) + np.eye(len(points)) * 99.0
    assume(gaps.min() > 0.8)
    rows = np.array([[x, y, AnchorKind.CORNER, math.nan, math.nan, 1.0, 0.0] for x, y in points])
    graph = anchor_graph(Anchors(rows))
    match = compare(graph, anchor_graph(Anchors(rows).transformed(pose)))
    assert match is not None
    assert len(match) == len(points)
    assert match.rms_m < 0.2
    np.testing.assert_allclose(match.second_from_first.apply(points)[match.pairs[:, 0]],
                               pose.apply(points)[match.pairs[:, 1]], atol=0.4)  # fmt: skip


@given(any_scan, st.floats(0.0, 2.0), st.floats(0.0, 0.5))
def test_every_beam_is_in_at_most_one_segment_and_segments_are_in_order(
    ranges: list[float], s: float, k: float
) -> None:
    found = segment_ranges(ranges, s, jump_per_m=k)
    seen = found.label[found.label >= 0]
    assert (np.diff(seen) >= 0).all()
    assert set(seen.tolist()) == set(range(found.count))
    assert not np.isfinite(np.array(ranges))[found.label < 0].any() or (found.mark[found.label < 0] >= 0).all()


@given(any_scan)
def test_any_scan_gives_anchors_or_none(ranges: list[float]) -> None:
    bearing = np.linspace(-2.0, 2.0, len(ranges)) if ranges else np.empty(0)
    found = AnchorFinder(bearing).find(ranges)
    assert np.isfinite(found.points).all()
    assert ((found.beams >= 0) & (found.beams < max(len(ranges), 1))).all()
    graph = anchor_graph(found)
    assert len(graph.edges) == len(graph) * (len(graph) - 1) // 2
    match = compare(graph, graph)
    assert match is None or len(match) <= len(graph)


@given(any_points)
def test_any_points_have_features_or_none(points: F64) -> None:
    orientation = main_orientation(points)
    assert orientation is None or (
        -math.pi / 4 <= orientation.angle_rad <= math.pi / 4 and 0 <= orientation.share <= 1 + 1e-9
    )
    try:
        scene = square_scene(points)
    except ValueError:
        assert np.ptp(points, axis=0).max() > 5e3  # too wide for a histogram, which is said
    else:
        if scene is not None:
            assert np.isfinite(virtual_edges(scene).points).all()
            box = box_feature(scene)
            assert box is None or box.size_m[0] >= box.size_m[1] > 0.0
    assert (arc_weights(points) >= 0.0).all()
    angles = surface_angles(points, np.zeros(len(points), dtype=np.int64))
    assert (np.isnan(angles) | (np.abs(angles) <= math.pi / 2)).all()
    if len(points):
        assert 0.0 <= smoothed_inertia(points).axis_ratio <= 1.0


@given(
    st.lists(st.tuples(st.floats(-9, 9), st.integers(0, 3), st.integers(0, 2)), min_size=2, max_size=6), st.booleans()
)
def test_distances_of_vectors_are_a_metric_within_the_cube(values: list[tuple[float, int, int]], must: bool) -> None:
    space = FeatureSpace(
        [
            Feature("a", low=-3.0, high=5.0),
            Feature("b", Scale.ORDERED, values=4),
            Feature("c", Scale.UNORDERED, values=3, must_agree=must),
        ]
    )
    v = space.normalised(np.array(values, dtype=np.float64))
    d = space.distance(v[:, None].reshape(-1, 3).repeat(len(v), axis=0), np.tile(v, (len(v), 1))).reshape(len(v), -1)
    assert (d >= 0.0).all()
    assert (d <= space.farthest + 1e-12).all()
    np.testing.assert_allclose(d, d.T)
    np.testing.assert_array_equal(np.diag(d), 0.0)
    for i in range(len(v)):
        assert (d <= d[:, i][:, None] + d[i][None, :] + 1e-9).all()


def test_an_empty_graph_is_a_graph() -> None:
    empty = AnchorGraph(Anchors(np.empty((0, 7))))
    assert empty.edges.shape == (0, 2)
    assert compare(empty, empty) is None
