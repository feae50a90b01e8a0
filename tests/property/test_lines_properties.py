"""What must hold of lines whatever the scene: rigid motion, order, splitting, rubbish (S03 to S10)."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.lines.extract import LineExtractor, LineRules, extract_from_points, extract_lines
from mapping.lines.fit import regression_line, split_at_end_points
from mapping.lines.free_space import FreeSpace, visibility_polygon
from mapping.lines.fuse import fuse
from mapping.lines.line_map import LineMap
from mapping.lines.lines import Lines
from mapping.lines.outlines import outlines
from mapping.lines.segment import segment_points

F64 = NDArray[np.float64]
TURN = np.radians(np.arange(-180.0, 180.0, 1.0))

poses = st.builds(Pose2, st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1))
rooms = st.tuples(
    st.floats(1.0, 6.0), st.floats(1.0, 6.0), st.floats(1.0, 6.0), st.floats(1.0, 6.0), st.integers(0, 99)
)
any_range = st.one_of(
    st.floats(0.05, 12.0), st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -1.0, 1e300, 5e-324, 9e3, 2e4])
)
any_scan = st.lists(any_range, min_size=0, max_size=90)
any_points = hnp.arrays(
    np.float64, st.tuples(st.integers(0, 40), st.just(2)),
    elements=st.one_of(st.floats(-20, 20), st.sampled_from([0.0, 1.0, 9e3, -9e3, 1e-300])),
)  # fmt: skip


def room(size: tuple[float, float, float, float, int], bearing: F64 = TURN) -> F64:
    """Ranges in a rectangular room around the sensor, with a pillar's shadow and 5 mm of noise."""
    right, up, left, down, seed = size
    c, s = np.cos(bearing), np.sin(bearing)
    across = np.where(c > 0.0, right, left) / np.maximum(np.abs(c), 1e-9)
    along = np.where(s > 0.0, up, down) / np.maximum(np.abs(s), 1e-9)
    ranges = np.minimum(across, along) + np.random.default_rng(seed).normal(0.0, 0.005, bearing.size)
    ranges[40:52] = 0.5
    return np.asarray(ranges)


def points_of(ranges: F64) -> F64:
    return np.stack((ranges * np.cos(TURN), ranges * np.sin(TURN)), axis=-1)


def same_lines(a: Lines, b: Lines, atol: float) -> None:
    assert len(a) == len(b)
    np.testing.assert_allclose(a.start_m, b.start_m, atol=atol)
    np.testing.assert_allclose(a.end_m, b.end_m, atol=atol)
    np.testing.assert_array_equal(a.count, b.count)


@settings(max_examples=60, deadline=None)
@given(rooms, st.floats(-3.1, 3.1))
def test_turning_the_sensor_turns_the_lines(size: tuple[float, float, float, float, int], yaw: float) -> None:
    points = points_of(room(size))
    turned = extract_from_points(Pose2(0.0, 0.0, yaw).apply(points), spacing_rad=0.01745)
    same_lines(turned, extract_from_points(points, spacing_rad=0.01745).transformed(Pose2(0.0, 0.0, yaw)), 1e-7)


@settings(max_examples=60, deadline=None)
@given(rooms, poses)
def test_parameters_follow_a_rigid_motion(size: tuple[float, float, float, float, int], pose: Pose2) -> None:
    lines = extract_lines(TURN, room(size))
    moved = lines.transformed(pose)
    angle, distance, covariance = moved.parameters()
    normal = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    for ends in (moved.start_m, moved.end_m):
        np.testing.assert_allclose(np.sum(ends * normal, axis=1), distance, atol=1e-8)
    assert np.all(distance >= 0.0)
    assert np.all(np.linalg.eigvalsh(covariance) >= -1e-12)
    np.testing.assert_allclose(covariance[:, 0, 0], lines.parameters()[2][:, 0, 0], rtol=1e-6)  # turns stay as sure
    same_lines(moved.transformed(pose.inverse()), lines, 1e-9)


@example((1.4480728249271149, 5.296875, 1.40625, 2.0625, 33))  # a wall of five beams, seen one way round only
@settings(max_examples=60, deadline=None)
@given(rooms)
def test_mirrored_scans_have_mirrored_lines(size: tuple[float, float, float, float, int]) -> None:
    """The other way round the same walls are found. Ends may differ by the beam at a corner, and so may what is left of
    a wall of hardly more beams than a line needs."""
    ranges = room(size)
    found = extract_lines(TURN, ranges), extract_lines(-TURN, ranges)
    for lines, others in (found, found[::-1]):
        a, d, _ = lines.chosen(lines.count >= 2 * LineRules().min_points).parameters()
        b, e, _ = others.parameters()
        for angle, distance in zip(a, d):
            assert np.min(np.abs(np.exp(-1j * angle) - np.exp(1j * b)) + np.abs(distance - e)) < 0.05


@settings(max_examples=40, deadline=None)
@given(rooms, st.integers(0, 359))
def test_a_full_turn_has_no_seam(size: tuple[float, float, float, float, int], shift: int) -> None:
    ranges = room(size)
    bearing = np.concatenate((TURN[shift:], TURN[:shift] + 2.0 * math.pi))
    here, there = extract_lines(TURN, ranges), extract_lines(bearing, np.roll(ranges, -shift))
    same_lines(in_one_order(here), in_one_order(there), 1e-6)


def in_one_order(lines: Lines) -> Lines:
    return lines.chosen(np.lexsort(lines.start_m.round(6).T))


@settings(max_examples=60, deadline=None)
@given(rooms, st.integers(20, 340))
def test_a_scan_in_two_halves_fuses_to_its_walls(size: tuple[float, float, float, float, int], cut: int) -> None:
    """Lines of the halves, fused, cover what the whole scan's lines cover."""
    ranges = room(size)
    whole = extract_lines(TURN, ranges)
    first, second = ranges.copy(), ranges.copy()
    first[cut:], second[: cut - 1] = np.nan, np.nan
    both = fuse(extract_lines(TURN, first), extract_lines(TURN, second))
    middle = 0.5 * (whole.start_m + whole.end_m)
    long = whole.length_m > 1.0
    if np.any(long):
        assert float(both.distance_to(middle[long]).min(axis=1).max()) < 0.35  # at worst a stub at the cut is missing
    assert len(both) <= len(whole) + 1


@settings(max_examples=200, deadline=None)
@given(any_scan, st.booleans(), st.booleans())
def test_any_scan_gives_finite_lines(ranges: list[float], full: bool, falling: bool) -> None:
    n = len(ranges)
    bearing = np.linspace(-math.pi, math.pi, n, endpoint=False) if full else np.linspace(-1.0, 1.0, n)
    bearing = bearing[::-1] if falling else bearing
    rules = LineRules(min_points=2, min_length_m=0.0, smallest=0)
    lines = LineExtractor(bearing, rules).extract(ranges)
    assert np.all(np.isfinite(lines.rows))
    angle, distance, covariance = lines.parameters()
    assert np.all(np.isfinite(angle))
    assert np.all(distance >= 0.0)
    assert np.all(np.isfinite(covariance))
    assert int(lines.count.sum()) <= n + len(lines)  # two short lines may share the point at their corner
    line_map = LineMap()
    line_map.insert(lines, Pose2(1.0, 2.0, 3.0))
    outlines(line_map.lines())
    if n:
        assert visibility_polygon(bearing, ranges, range_max_m=12.0).is_valid


@settings(max_examples=200, deadline=None)
@given(any_points, st.booleans())
def test_any_points_are_split_and_grouped_without_loss(points: F64, full_turn: bool) -> None:
    found = segment_points(points, 0.5, smallest=1, full_turn=full_turn)
    used = np.concatenate([found.auxiliary, *found.clusters]) if len(points) else found.auxiliary
    assert sorted(used.tolist()) == list(range(len(points)))
    runs = split_at_end_points(points, 0.1)
    if len(points) >= 2:
        assert runs[0].start == 0
        assert runs[-1].stop == len(points)
        assert all(a.stop - 1 == b.start for a, b in pairwise(runs))
        if np.any(points != points[0]):
            try:
                line = regression_line(points)
            except ValueError:
                line = None
            assert line is None or math.isfinite(line.distance_m)
    lines = extract_from_points(points, full_turn=full_turn)
    assert np.all(np.isfinite(lines.rows))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(rooms, poses), min_size=1, max_size=5))
def test_maps_of_any_drive_stay_sound(drive: list[tuple[tuple[float, float, float, float, int], Pose2]]) -> None:
    line_map, points = LineMap(), 0
    for size, pose in drive:
        lines = extract_lines(TURN, room(size))
        line_map.insert(lines, pose)
        points += int(lines.count.sum())
    lines = line_map.lines()
    assert int(lines.count.sum()) == points  # moments and counts are kept, whatever is fused
    assert len(fuse(lines, Lines(lines.rows[:0], lines.beams[:0]))) <= len(lines)
    assert LineMap.from_bytes(line_map.to_bytes()).to_bytes() == line_map.to_bytes()


@settings(max_examples=25, deadline=None)
@given(
    rooms, st.lists(st.sampled_from([math.nan, -math.inf, 0.0, -1.0]), min_size=360, max_size=360), st.integers(0, 99)
)
def test_no_fault_frees_space(size: tuple[float, float, float, float, int], faults: list[float], seed: int) -> None:
    """Beams that fail only take away from what the whole scan saw."""
    ranges = room(size)
    broken = np.where(np.random.default_rng(seed).random(360) < 0.2, faults, ranges)
    whole, less = FreeSpace(simplify_m=0.0), FreeSpace(simplify_m=0.0)
    whole.insert(Pose2(1.0, 2.0, 0.5), TURN, ranges, range_max_m=20.0)
    less.insert(Pose2(1.0, 2.0, 0.5), TURN, broken, range_max_m=20.0)
    assert less.polygon.difference(whole.polygon).area < 1e-9
