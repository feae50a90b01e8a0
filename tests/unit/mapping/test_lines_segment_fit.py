"""The book's forms one by one, against slow literal versions and numpy's SVD (S03 to S06)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.lines.fit import chord_distance, regression_line, shift_to_line, split_at_end_points
from mapping.lines.segment import segment_points

F64 = NDArray[np.float64]


def book_segmentation(points: F64, d: float, c: int) -> tuple[list[list[int]], list[int]]:
    """Algorithm 5.1 word by word with 1-based indices, erratum in branches two and four, last pair compared."""
    n = len(points)
    P = {k + 1: points[k] for k in range(n)}

    def near(a: int, b: int) -> bool:
        return math.dist(P[a], P[b]) < d

    i, clusters, corners = 1, [[1]], []
    while i < n:
        if near(i + 1, i):
            clusters[-1].append(i + 1)
            i += 1
        elif i + 2 > n:
            clusters.append([i + 1])
            i += 1
        elif near(i + 2, i):
            clusters[-1].append(i + 2)
            corners.append(i + 1)
            i += 2
        elif near(i + 2, i + 1):
            clusters.append([i + 1, i + 2])
            i += 2
        else:
            corners.append(i + 1)
            clusters.append([i + 2])
            i += 2
    kept = [cluster for cluster in clusters if len(cluster) > c]
    corners += [k for cluster in clusters if len(cluster) <= c for k in cluster]
    return [[k - 1 for k in cluster] for cluster in kept], sorted(k - 1 for k in corners)


def walk(seed: int, n: int) -> F64:
    """Points in steps of which about a third are too long, with stray ones."""
    random = np.random.default_rng(seed)
    steps = random.choice([0.05, 0.09, 0.3], size=n, p=[0.4, 0.35, 0.25])
    points = np.stack((5.0 + np.cumsum(steps), np.zeros(n)), axis=-1)
    points[random.random(n) < 0.15, 1] += 1.0
    return points


@pytest.mark.parametrize("seed", range(60))
def test_segmentation_is_the_books(seed: int) -> None:
    points = walk(seed, 2 + seed * 3)
    for smallest in (0, 2, 4):
        found = segment_points(points, 0.1, smallest=smallest)
        clusters, corners = book_segmentation(points, 0.1, smallest)
        assert [list(map(int, cluster)) for cluster in found.clusters] == clusters
        assert found.auxiliary.tolist() == corners


def test_stray_point_is_compared_once_and_does_not_end_its_cluster() -> None:
    points = np.array([[1.0, 0.0], [1.05, 0.0], [1.1, 3.0], [1.12, 0.0], [1.2, 0.0], [1.25, 0.0]])
    found = segment_points(points, 0.1)
    assert [c.tolist() for c in found.clusters] == [[0, 1, 3, 4, 5]]
    assert found.auxiliary.tolist() == [2]


def test_gap_grows_with_range() -> None:
    near = np.array([[1.0, 0.0], [1.0, 0.2], [1.0, 0.4]])
    assert len(segment_points(near, 0.1).clusters) == 2  # all apart: the middle one is stray
    assert len(segment_points(10.0 * near, 0.1, gap_per_m=0.25).clusters) == 1
    assert len(segment_points(near, 0.1, gap_per_m=0.25).clusters) == 1
    assert len(segment_points(near, 0.1, gap_per_m=0.1).clusters) == 2


@pytest.mark.parametrize("shift", range(0, 40, 3))
def test_a_full_turn_has_no_seam(shift: int) -> None:
    angle = np.linspace(-np.pi, np.pi, 40, endpoint=False)
    far = np.where(np.abs(angle) < 1.0, 2.0, np.where(np.abs(angle) < 2.5, 4.0, 1.0))
    points = np.stack((far * np.cos(angle), far * np.sin(angle)), axis=-1)
    found = segment_points(np.roll(points, -shift, axis=0), 0.7, full_turn=True)
    sets = {frozenset(((c + shift) % 40).tolist()) for c in found.clusters}
    plain = segment_points(np.roll(points, -20, axis=0), 0.7)
    bits = [frozenset(np.flatnonzero(far == 2.0)), frozenset(np.flatnonzero(far == 1.0))]
    assert set(bits) <= sets
    assert len(found.clusters) == 4
    assert plain.auxiliary.size == 0


def test_a_ring_is_one_cluster() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    ring = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    found = segment_points(ring, 0.1, full_turn=True)
    assert [len(c) for c in found.clusters] == [100]


def literal_split(points: F64, first: int, last: int, tolerance: float) -> list[tuple[int, int]]:
    """[DH73] by recursion, with the distance from geometry instead of sine and cosine."""
    p, q = points[first], points[last]
    chord = float(np.hypot(*(q - p)))
    inner = points[first + 1 : last]
    if len(inner) == 0:
        return [(first, last)]
    if chord > 0.0:
        h = np.abs((q[0] - p[0]) * (p[1] - inner[:, 1]) - (p[0] - inner[:, 0]) * (q[1] - p[1])) / chord
    if chord == 0.0 or h.max() >= chord:
        h = np.hypot(*(inner - p).T)
    if h.max() <= tolerance:
        return [(first, last)]
    at = first + 1 + int(np.argmax(h))
    return literal_split(points, first, at, tolerance) + literal_split(points, at, last, tolerance)


@pytest.mark.parametrize("seed", range(40))
def test_end_point_fit_is_the_recursion(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = np.cumsum(random.normal(0.0, 0.1, (3 + 5 * seed, 2)) + [0.1, 0.0], axis=0)
    found = split_at_end_points(points, 0.15)
    assert [(s.start, s.stop - 1) for s in found] == literal_split(points, 0, len(points) - 1, 0.15)


def test_end_point_fit_of_an_upright_corner() -> None:
    """Vertical chords, where the book's tangent fails."""
    points = np.array([[0.0, y] for y in np.arange(0.0, 1.01, 0.1)] + [[x, 1.0] for x in np.arange(0.1, 1.01, 0.1)])
    assert split_at_end_points(points, 0.05) == [slice(0, 11), slice(10, 21)]
    assert chord_distance([[2.0, 0.0], [2.5, 1.0], [2.0, 5.0]]).tolist() == pytest.approx([0.0, 0.5, 0.0])


def svd_line(points: F64, weight: F64) -> tuple[F64, float]:
    """Unit normal and offset by numpy's singular values."""
    centre = np.average(points, axis=0, weights=weight)
    _, _, v = np.linalg.svd((points - centre) * np.sqrt(weight)[:, None], full_matrices=False)
    normal = v[-1]
    offset = float(normal @ centre)
    return (normal, offset) if offset >= 0.0 else (-normal, -offset)


@settings(max_examples=150, deadline=None)
@given(
    st.floats(-math.pi, math.pi), st.floats(0.3, 20.0), st.integers(3, 60), st.integers(0, 2**31), st.booleans()
)  # fmt: skip
def test_regression_is_the_least_squares_line(angle: float, far: float, n: int, seed: int, weighted: bool) -> None:
    random = np.random.default_rng(seed)
    t, h = random.uniform(-2.0, 2.0, n), random.normal(0.0, 0.02, n)
    t[:2] = (-2.0, 2.0)
    c, s = math.cos(angle), math.sin(angle)
    points = np.stack((far * c - t * s + h * c, far * s + t * c + h * s), axis=-1)
    sigma = random.uniform(0.005, 0.05, n) if weighted else np.full(n, 0.02)
    line = regression_line(points, sigma_m=sigma)
    normal, offset = svd_line(points, 1.0 / sigma**2)
    assert line.distance_m == pytest.approx(offset, abs=1e-9)
    np.testing.assert_allclose([math.cos(line.angle_rad), math.sin(line.angle_rad)], normal, atol=1e-8)
    across = np.sum(((points @ normal - offset) / sigma) ** 2)
    assert line.sum_of_squares == pytest.approx(float(across), rel=1e-6)


@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 90.0, 135.0, 180.0, -90.0, -45.0])
def test_exact_points_give_the_exact_line(angle_deg: float) -> None:
    a = math.radians(angle_deg)
    n = np.array([math.cos(a), math.sin(a)])
    points = 3.0 * n + np.linspace(-1.0, 2.0, 7)[:, None] * np.array([-n[1], n[0]])
    line = regression_line(points)
    assert line.distance_m == pytest.approx(3.0)
    assert math.cos(line.angle_rad - a) == pytest.approx(1.0)
    assert line.sum_of_squares == pytest.approx(0.0, abs=1e-20)


def test_the_printed_root_would_be_the_maximum() -> None:
    """Of a z^2 + b z - a = 0 one root is the best, one the worst line; ours is the best (erratum of 5.15, 5.16)."""
    points = np.array([[0.0, 0.0], [1.0, 0.1], [2.0, -0.1], [3.0, 0.05]])
    centre = points.mean(axis=0)
    dx, dy = (points - centre).T
    a, b = float(np.sum(dx * dy)), float(np.sum(dx * dx - dy * dy))
    roots = [-b / (2 * a) + sign * math.sqrt(1.0 + b * b / (4 * a * a)) for sign in (1.0, -1.0)]
    costs = [float(np.sum((dy * math.cos(g) - dx * math.sin(g)) ** 2)) for g in map(math.atan, roots)]
    line = regression_line(points)
    assert line.sum_of_squares == pytest.approx(min(costs))
    assert max(costs) > 100.0 * min(costs)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_covariance_is_what_repeated_measurements_scatter(side: float) -> None:
    """Monte Carlo, with weights that do not fit the errors, so that the mixed term counts. 20,000 draws: 3 %."""
    random = np.random.default_rng(5)
    t = np.linspace(-1.0, 3.0, 15)
    u, n = np.array([math.cos(0.4), math.sin(0.4)]), np.array([-math.sin(0.4), math.cos(0.4)])
    clean = 2.0 * side * n + t[:, None] * u
    sigma, across = np.linspace(0.01, 0.03, 15), np.linspace(0.02, 0.005, 15)
    found = []
    for _ in range(20000):
        w = 1.0 / sigma**2
        p = clean + (random.normal(size=15) * across)[:, None] * n
        centre = w @ p / w.sum()
        dx, dy = (p - centre).T
        gamma = 0.5 * math.atan2(2.0 * (w @ (dx * dy)), w @ (dx * dx - dy * dy))
        normal = side * np.array([-math.sin(gamma), math.cos(gamma)])
        found.append((math.atan2(normal[1], normal[0]), normal @ centre))
    predicted = regression_line(clean, sigma_m=sigma, across_m=across).covariance
    observed = np.cov(np.array(found).T)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    np.testing.assert_allclose(observed / scale, predicted / scale, atol=0.04)
    assert np.linalg.eigvalsh(predicted).min() > 0.0


def test_shift_moves_ends_at_right_angles_onto_the_line() -> None:
    random = np.random.default_rng(3)
    points = np.stack((np.linspace(0.0, 4.0, 30), np.linspace(1.0, 3.0, 30)), axis=-1) + random.normal(0, 0.03, (30, 2))
    line = regression_line(points)
    moved = shift_to_line(points[[0, -1]], line)
    normal = np.array([math.cos(line.angle_rad), math.sin(line.angle_rad)])
    np.testing.assert_allclose(moved @ normal, line.distance_m, atol=1e-12)
    way = moved - points[[0, -1]]
    np.testing.assert_allclose(way[:, 0] * normal[1] - way[:, 1] * normal[0], 0.0, atol=1e-12)
    assert np.abs(way).max() > 1e-4


BAD_POINTS = [[1.0, 2.0], [[1.0, 2.0, 3.0]], [[[1.0, 2.0]]], [[math.nan, 0.0], [1.0, 1.0]], [[math.inf, 0.0]]]


@pytest.mark.parametrize("points", BAD_POINTS)
def test_what_are_no_points_is_refused(points: list[float]) -> None:
    for call in (
        lambda: segment_points(points, 0.1),
        lambda: split_at_end_points(points, 0.1),
        lambda: regression_line(points),
        lambda: chord_distance(points),
    ):
        with pytest.raises(ValueError, match="points"):
            call()


def test_too_little_is_empty_or_refused() -> None:
    assert segment_points([], 0.1).clusters == ()
    assert [c.tolist() for c in segment_points([[1.0, 1.0]], 0.1, full_turn=True).clusters] == [[0]]
    assert split_at_end_points([], 0.1) == []
    assert split_at_end_points([[1.0, 1.0]], 0.1) == []
    assert split_at_end_points([[1.0, 1.0]] * 50, 0.0) == [slice(0, 50)]
    assert chord_distance([]).size == 0
    for few in ([], [[1.0, 1.0]], [[1.0, 1.0]] * 9):
        with pytest.raises(ValueError, match="two different points"):
            regression_line(few)
    with pytest.raises(ValueError, match="sigma_m"):
        regression_line([[0.0, 0.0], [1.0, 0.0]], sigma_m=0.0)
    with pytest.raises(ValueError, match="across_m"):
        regression_line([[0.0, 0.0], [1.0, 0.0]], across_m=[1.0, math.nan])
    for gap in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="gap_m"):
            segment_points([[1.0, 1.0]], gap)
    with pytest.raises(ValueError, match="tolerance_m"):
        split_at_end_points([[1.0, 1.0]], -0.1)
