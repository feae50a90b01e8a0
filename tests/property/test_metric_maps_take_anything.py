"""Functions of lines, planes, features and grids that other properties do not reach, given whatever there is: an answer
as documented or a ValueError, never another fault and no numbers out of nothing."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from typing import TypeVar

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from mapping.features.anchors import AnchorFinder, no_anchors
from mapping.features.graph import polar_distance
from mapping.features.histograms import Box, axis_walls
from mapping.features.scenes import SCENE_FEATURES, SceneDatabase, scene_vector, sight_of
from mapping.frames import IDENTITY, Pose2, Pose3
from mapping.grids.beam_model import beam_table
from mapping.grids.sonar_model import SonarMemory, SonarRules, cone_of_reading
from mapping.lines.extract import are_in_order, extract_lines
from mapping.lines.free_space import FreeSpace
from mapping.lines.line_map import LineMap
from mapping.lines.lines import as_points, segment_distance
from mapping.lines.outlines import OutlineKind, kind_of_polygon, signed_area
from mapping.planes.cloud import AngleBuffer, SweepGatherer, SweepPoints, TiltMount, points_of_sweep
from mapping.planes.extract import (
    PlaneRules,
    RangeNoise,
    axes_of,
    depth_step_per_m2,
    noise_of_scatter,
    range_limit_m,
    range_warning,
)
from mapping.pose_buffer import GoneError, NotYetError
from mapping.scan import Scan

F64 = NDArray[np.float64]
T = TypeVar("T")

SOME = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
odd = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-300, 1e300, -1e12])
numbers = st.one_of(st.floats(-30.0, 30.0), odd)
lengths = st.one_of(st.floats(0.0, 40.0), odd)
poses = st.builds(Pose2, st.floats(-50, 50), st.floats(-50, 50), st.floats(-7, 7))
points = hnp.arrays(np.float64, st.tuples(st.integers(0, 40), st.just(2)), elements=numbers)
shapes = hnp.arrays(np.float64, hnp.array_shapes(min_dims=0, max_dims=3, max_side=4), elements=numbers)
columns = hnp.arrays(np.float64, st.integers(0, 60), elements=numbers)
sweeps = st.lists(lengths, min_size=0, max_size=90)


def answer(call: Callable[[], T]) -> T | None:
    """What comes of it; None if it is refused, which only a ValueError may do."""
    try:
        with np.errstate(all="ignore"):
            return call()
    except ValueError:
        return None


def scan_of(ranges: list[float]) -> Scan:
    bearing = np.linspace(-2.0, 2.0, len(ranges)) if ranges else np.zeros(0)
    return Scan(1_000_000_000, 1000.0, bearing, np.array(ranges, dtype=np.float64), 0.02, 30.0)


# -------------------------------------------------------------------------------------------------------------- lines


@SOME
@given(st.one_of(points, shapes))
def test_points_are_finite_pairs_or_refused(given_points: F64) -> None:
    taken = answer(lambda: as_points(given_points))
    wanted = given_points.ndim == 2 and given_points.shape[1:] == (2,) and bool(np.isfinite(given_points).all())
    assert (taken is not None) == wanted or given_points.size == 0
    assert answer(lambda: are_in_order(given_points.ravel())) in (True, False)


@SOME
@given(hnp.arrays(np.float64, st.tuples(st.integers(0, 12), st.just(2)), elements=st.floats(-100, 100)))
def test_areas_and_kinds_of_any_polygon(corners: F64) -> None:
    area = signed_area(corners)
    assert math.isfinite(area)
    assert signed_area(corners[::-1]) == pytest.approx(-area, abs=1e-6)
    assert kind_of_polygon(corners) in OutlineKind
    assert len(corners) > 2 or kind_of_polygon(corners) is OutlineKind.OPEN


@SOME
@given(
    hnp.arrays(np.float64, st.tuples(st.integers(0, 9), st.just(2)), elements=st.floats(-100, 100)),
    hnp.arrays(np.float64, st.tuples(st.integers(0, 5), st.just(4)), elements=st.floats(-100, 100)),
)
def test_distances_to_segments_lie_between_those_to_the_line_and_to_the_ends(spots: F64, ends: F64) -> None:
    found = segment_distance(spots, ends[:, :2], ends[:, 2:])
    assert found.shape == (len(spots), len(ends))
    to_start = np.linalg.norm(spots[:, None] - ends[None, :, :2], axis=2)
    to_end = np.linalg.norm(spots[:, None] - ends[None, :, 2:], axis=2)
    assert np.all(found <= np.minimum(to_start, to_end) + 1e-9)
    assert np.all(found + np.linalg.norm(ends[:, :2] - ends[:, 2:], axis=1) >= np.maximum(to_start, to_end) - 1e-9)


@SOME
@given(st.lists(st.tuples(sweeps, poses), max_size=3), columns, hnp.arrays(np.float64, 2, elements=numbers), lengths)
def test_rays_into_any_line_map(
    drive: list[tuple[list[float], Pose2]], bearing: F64, origin: F64, reach_m: float
) -> None:
    lines_map = LineMap()
    for ranges, pose in drive:
        scan = scan_of(ranges)
        lines = answer(lambda scan=scan: extract_lines(scan.bearing_rad, scan.range_m))  # type: ignore[misc]
        if lines is not None:
            lines_map.insert(lines, pose)
    cast = answer(lambda: lines_map.raycast(origin, bearing, reach_m=reach_m))
    if cast is not None:
        distance, index = cast
        assert distance.shape == index.shape == bearing.shape
        assert np.array_equal(np.isinf(distance), index == -1)
        assert np.all((distance[index >= 0] >= 0.0) & (distance[index >= 0] <= reach_m))
        assert np.all(index < len(lines_map.lines()))


@SOME
@given(st.lists(st.tuples(sweeps, poses), max_size=3))
def test_free_space_has_an_area_and_frontiers(drive: list[tuple[list[float], Pose2]]) -> None:
    space, before = FreeSpace(simplify_m=0.0), 0.0
    for ranges, pose in drive:
        scan = scan_of(ranges)
        answer(
            lambda scan=scan, pose=pose: space.insert(  # type: ignore[misc]
                pose, scan.bearing_rad, scan.range_m, range_max_m=30.0
            )
        )
        area = space.area_m2
        assert area >= before - 1e-4 * (1.0 + before)  # a lattice of a micrometre where exact unions fail
        before = area
    for edge in space.frontiers():
        assert edge.ndim == 2
        assert edge.shape[1] == 2
        assert np.isfinite(edge).all()


def test_beams_of_hardly_any_length_leave_free_space_whole() -> None:
    """Unions of such polygons once raised GEOS's TopologyException."""
    bearing = np.linspace(-2.0, 2.0, 30)
    for seed, tiny in product(range(40), (1e-300, 1e-3)):
        random = np.random.default_rng(seed)
        space = FreeSpace(simplify_m=0.0)
        for _ in range(3):
            ranges = random.choice([0.0, 1.0, 1.0, 5.0, 2.0, 30.0, math.inf, tiny], bearing.size)
            x, y, yaw = (float(v) for v in random.choice([0.0, 1.0, 2.0, 3.0, 0.5], 3))
            space.insert(Pose2(x, y, yaw), bearing, ranges, range_max_m=30.0)
        assert 0.0 <= space.area_m2 < 3.0 * math.pi * 30.0**2


# ------------------------------------------------------------------------------------------------------------- planes


@SOME
@given(
    st.lists(st.tuples(st.integers(-5, 10**10), numbers), max_size=20),
    sweeps,
    st.sampled_from(["pitch", "roll", "yaw"]),
    st.booleans(),
)
def test_sweeps_of_any_mount_are_points_or_not_yet_or_gone(
    angles: list[tuple[int, float]], ranges: list[float], axle: str, turning: bool
) -> None:
    buffer, gatherer = AngleBuffer(capacity=8), SweepGatherer(turning=turning, most_points=50)
    for stamp_ns, angle in angles:
        buffer.add(stamp_ns, angle)
    mount = TiltMount(Pose3(0.1, 0.0, 0.5, 0.0, 0.0, 0.0), axle)  # type: ignore[arg-type]
    scan = scan_of(ranges)
    try:
        swept = answer(lambda: points_of_sweep(scan, buffer, mount))
    except (NotYetError, GoneError):
        return
    if swept is not None:
        assert swept.points_m.shape == swept.origin_m.shape
        assert np.isfinite(swept.points_m).all()
        cloud = gatherer.add(swept, IDENTITY)
        assert cloud is None or cloud.shape[1:] == (3,)


@SOME
@given(st.lists(st.tuples(st.floats(-20.0, 20.0), st.integers(0, 20)), max_size=30), st.booleans())
def test_a_gatherer_never_holds_more_than_it_may(sweeps_of: list[tuple[float, int]], turning: bool) -> None:
    gatherer = SweepGatherer(turning=turning, most_points=40)
    for k, (angle, count) in enumerate(sweeps_of):
        swept = SweepPoints(np.ones((count, 3)), np.zeros((count, 3)), k, angle, angle + 0.01)
        cloud = gatherer.add(swept, Pose2(0.01 * k))
        assert cloud is None or len(cloud) <= 40 + 20


@SOME
@given(columns, st.floats(-4, 4))
def test_rays_of_a_mount_are_unit_vectors(bearing: F64, angle: float) -> None:
    made = answer(lambda: TiltMount().rays(bearing, np.full(len(bearing), angle)))
    if made is not None and np.isfinite(bearing).all():
        assert made[0].shape == made[1].shape == (len(bearing), 3)
        np.testing.assert_allclose(np.linalg.norm(made[1], axis=1), 1.0)


@SOME
@given(lengths, lengths, lengths)
def test_limits_and_warnings_of_range(cell_m: float, spacing: float, range_m: float) -> None:
    limit = answer(lambda: range_limit_m(cell_m, spacing))
    assert limit is None or limit > 0.0
    said = answer(lambda: range_warning(PlaneRules(), spacing, range_m))
    assert said is None or "beams" in said
    noise = answer(lambda: RangeNoise(cell_m, spacing, range_m))
    if noise is not None:
        assert np.all(noise.at([0.0, 1.0, 30.0]) > 0.0)


@SOME
@given(st.lists(st.tuples(st.floats(0.0, 50.0), st.floats(0.0, 1.0)), max_size=200), st.floats(1e-3, 0.1))
def test_the_noise_of_any_scatter_is_a_noise(cells: list[tuple[float, float]], most_m: float) -> None:
    table = np.array(cells, dtype=np.float64).reshape(-1, 2)
    noise = noise_of_scatter(table[:, 0].copy(), table[:, 1].copy(), most_m=most_m)
    assert 0.0 < noise.sigma_m <= most_m
    assert noise.sigma_per_m2 >= 0.0


@SOME
@given(hnp.arrays(np.float64, st.tuples(st.integers(0, 200), st.just(3)), elements=st.floats(-1e4, 1e4)), st.booleans())
def test_steps_of_depth_are_found_or_not(cloud: F64, rounded: bool) -> None:
    x, y, z = (np.round(cloud) if rounded else cloud).T.copy()
    step = depth_step_per_m2(x, y, z)
    assert math.isfinite(step)
    assert step >= 0.0


@SOME
@given(hnp.arrays(np.float64, st.tuples(st.integers(0, 9), st.just(3)), elements=st.floats(-1, 1)))
def test_axes_span_the_plane(normal: F64) -> None:
    length = np.linalg.norm(normal, axis=1)
    normal = normal[length > 1e-3] / length[length > 1e-3, None]
    along, across = axes_of(normal)
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1.0)
    np.testing.assert_allclose(np.cross(along, across), -normal, atol=1e-9)


# ----------------------------------------------------------------------------------------------------------- features


@SOME
@given(*(st.floats(0, 1e3), st.floats(-10, 10)) * 2)
def test_polar_distance_is_the_distance(r1: float, a: float, r2: float, b: float) -> None:
    found = float(polar_distance(r1, a, r2, b))
    wanted = math.dist((r1 * math.cos(a), r1 * math.sin(a)), (r2 * math.cos(b), r2 * math.sin(b)))
    assert found == pytest.approx(wanted, abs=1e-4)


@SOME
@given(columns, columns, columns)
def test_walls_across_an_axis(across: F64, along: F64, weight: F64) -> None:
    walls = answer(lambda: axis_walls(across, along, weight))
    if walls is not None and np.isfinite(across).all() and np.isfinite(weight).all() and len(across):
        assert np.all(np.diff(walls.position_m) > 0.0)
        assert len(walls.position_m) == len(walls.length_m) == len(walls.low_m) == len(walls.high_m)


@SOME
@given(st.floats(-9, 9), st.floats(-9, 9), st.floats(0.1, 9), st.floats(0.1, 9), st.floats(-1.5, 1.5))
def test_corners_of_a_box_make_its_area(x: float, y: float, a: float, b: float, angle: float) -> None:
    corners = Box((x, y), (max(a, b), min(a, b)), angle).corners()
    assert signed_area(corners) == pytest.approx(a * b)
    np.testing.assert_allclose(corners.mean(axis=0), (x, y), atol=1e-9)


@SOME
@given(sweeps)
def test_anchors_from_lines_are_those_from_the_scan(ranges: list[float]) -> None:
    scan = scan_of(ranges)
    finder = answer(lambda: AnchorFinder(scan.bearing_rad))
    if finder is None:
        return
    found = answer(lambda: finder.find(scan.range_m))
    if found is None:
        return
    of_lines = finder.of_lines(scan.range_m, finder.extractor.extract(scan.range_m))
    np.testing.assert_array_equal(of_lines.rows, found.rows)
    assert len(found) >= len(no_anchors()) == 0


@SOME
@given(st.lists(st.tuples(sweeps, poses), min_size=1, max_size=4), sweeps)
def test_any_scenes_are_kept_and_asked(seen: list[tuple[list[float], Pose2]], asked: list[float]) -> None:
    database, again = SceneDatabase(most=3), SceneDatabase()
    for ranges, pose in seen:
        sight = answer(lambda ranges=ranges: sight_of(scan_of(ranges)))  # type: ignore[misc]
        if sight is None:
            continue
        assert np.all((sight.vector >= 0.0) & (sight.vector <= 1.0) | np.isnan(sight.vector))
        number = database.add(sight, pose)
        if number is None:
            assert len(database) == 3
            continue
        assert again.add_bytes(database.scene_bytes(number)) == number
        assert again.pose(number) == database.pose(number)
        assert database.covers(pose)
    query = answer(lambda: sight_of(scan_of(asked)))
    if query is not None:
        told = database.where_am_i(query)
        assert (told.place is None) == bool(told.reason)
        similar = database.similar(query.vector, 2)
        assert len(similar) == min(2, len(database))
    assert database.memory_bytes >= 0


@SOME
@given(st.binary(max_size=200))
def test_bytes_that_are_no_scene_are_refused(payload: bytes) -> None:
    with pytest.raises(ValueError, match="scene"):
        SceneDatabase().add_bytes(payload)


@SOME
@given(points)
def test_the_vector_of_any_points_lies_in_the_cube(spots: F64) -> None:
    vector = answer(lambda: scene_vector(spots))
    assert vector is None or vector.shape == (len(SCENE_FEATURES),)


# -------------------------------------------------------------------------------------------------------------- grids


@SOME
@given(columns, st.floats(0.0, 1.0))
def test_the_table_of_any_bearings(bearing: F64, gap_m: float) -> None:
    table = answer(lambda: beam_table(bearing, gap_m))
    assert (table is not None) == bool(np.isfinite(bearing).all())
    if table is not None:
        np.testing.assert_allclose(np.hypot(table.dir_x, table.dir_y), 1.0)
        assert np.all(table.wedge_m >= 0.0)
        assert table.order is None or sorted(table.order.tolist()) == list(range(len(bearing)))


@SOME
@given(st.lists(st.tuples(st.sampled_from(["a", "b", None]), lengths, poses), max_size=12), st.booleans())
def test_sonars_say_nothing_or_something_within_reach(
    heard: list[tuple[str | None, float, Pose2]], clear_no_return: bool
) -> None:
    rules = SonarRules()
    memory = SonarMemory(rules, 0.05)
    for name, range_m, pose in heard:
        if not memory.believe(name, range_m, pose.x_m, pose.y_m):
            continue
        cone = cone_of_reading(
            rules, pose, range_m, cone_rad=0.5, range_min_m=0.05, range_max_m=3.0, resolution_m=0.05,
            clear_no_return=clear_no_return,
        )  # fmt: skip
        if cone is not None:
            memory.remember(name, cone)
        guards = memory.guards(name)
        assert guards.shape[1:] == (7,)
        assert np.isfinite(guards).all()
