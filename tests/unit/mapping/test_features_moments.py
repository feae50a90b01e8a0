"""S15 to S17 against slow literal sums, closed forms and numpy's eigenvalues."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.features.moments import (
    arc_weights,
    centre_of_gravity,
    inertia,
    moment,
    smoothed_distances,
    smoothed_inertia,
)

F64 = NDArray[np.float64]


def cloud(seed: int = 1, count: int = 40) -> F64:
    points = np.random.default_rng(seed).normal(0.0, 2.0, (count, 2))
    return np.asarray(points @ np.array([[1.0, 0.4], [0.0, 0.5]]) + [3.0, -1.0])


def room_scan(x: float, y: float, step_deg: float) -> F64:
    """Points on the walls of the room [0, 6] x [0, 4], seen from (x, y), in the room's frame."""
    bearing = np.radians(np.arange(-180.0, 180.0, step_deg))
    c, s = np.cos(bearing), np.sin(bearing)
    r = np.minimum(
        np.where(c > 0.0, 6.0 - x, x) / np.maximum(np.abs(c), 1e-12),
        np.where(s > 0.0, 4.0 - y, y) / np.maximum(np.abs(s), 1e-12),
    )
    return np.stack((x + r * c, y + r * s), axis=-1)


@pytest.mark.parametrize(("p", "q"), [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 2)])
def test_moment_is_the_books_sum(p: int, q: int) -> None:
    points = cloud()
    literal = sum(float(x) ** p * float(y) ** q for x, y in points) / len(points)
    assert moment(points, p, q) == pytest.approx(literal, rel=1e-12)


def test_weights_count_like_repeated_points() -> None:
    points, times = cloud(count=8), [1, 3, 2, 1, 1, 4, 1, 2]
    repeated = np.repeat(points, times, axis=0)
    np.testing.assert_allclose(centre_of_gravity(points, weight=times), centre_of_gravity(repeated), atol=1e-12)
    assert moment(points, 2, 1, weight=times, central=True) == pytest.approx(moment(repeated, 2, 1, central=True))
    assert inertia(points, weight=times).axis_ratio == pytest.approx(inertia(repeated).axis_ratio)


def test_centre_of_a_room_by_arc_length_does_not_depend_on_the_place() -> None:
    for x, y in ((3.0, 2.0), (1.0, 1.0), (5.5, 3.4)):
        points = room_scan(x, y, 0.25)
        weighted = centre_of_gravity(points, weight=arc_weights(points, full_turn=True))
        np.testing.assert_allclose(weighted, [3.0, 2.0], atol=0.01)
    plain = centre_of_gravity(room_scan(5.5, 3.4, 0.25))  # unweighted, beams heap up on what is near
    assert math.hypot(plain[0] - 3.0, plain[1] - 2.0) > 0.5


def test_arc_weights_add_up_to_the_length_of_the_walls() -> None:
    points = room_scan(2.0, 1.0, 0.5)
    assert float(arc_weights(points, full_turn=True).sum()) == pytest.approx(20.0, abs=0.05)
    opened = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [5.0, 0.0], [5.1, 0.0]])
    np.testing.assert_allclose(arc_weights(opened), [0.05, 0.1, 0.05, 0.05, 0.05], atol=1e-12)
    np.testing.assert_array_equal(arc_weights(opened[:1]), [0.0])
    assert arc_weights(np.empty((0, 2))).shape == (0,)


def test_inertia_about_an_axis_is_the_mean_of_squared_distances_to_it() -> None:
    points = cloud()
    found = inertia(points)
    xs, ys = points.mean(axis=0)
    for psi in np.linspace(-3.0, 3.0, 13):
        literal = 0.0
        for x, y in points:
            literal += ((y - ys) * math.cos(psi) - (x - xs) * math.sin(psi)) ** 2
        assert float(found.about(psi)) == pytest.approx(literal / len(points), rel=1e-10)


def test_the_ellipse_has_the_eigenvalues_of_the_scatter() -> None:
    points = cloud(seed=5)
    found = inertia(points)
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    assert (found.least, found.most) == pytest.approx(tuple(values), rel=1e-10)
    assert found.axis_ratio == pytest.approx(math.sqrt(values[0] / values[1]))
    along = np.array([math.cos(found.direction_rad), math.sin(found.direction_rad)])
    assert abs(float(along @ vectors[:, 1])) == pytest.approx(1.0, abs=1e-10)
    assert float(found.about(found.direction_rad)) == pytest.approx(found.least, rel=1e-9)


def test_inertia_of_a_rectangles_outline_in_closed_form() -> None:
    a, b = 6.0, 4.0
    points = room_scan(2.0, 1.5, 0.1)
    found = inertia(points, weight=arc_weights(points, full_turn=True))
    along_x = a**3 / 6.0 + a * a * b / 2.0  # integral of (x - a/2)^2 over the outline: two sides, and two at a/2
    along_y = b**3 / 6.0 + b * b * a / 2.0
    assert found.sxx == pytest.approx(along_x / (2 * (a + b)), rel=5e-3)
    assert found.syy == pytest.approx(along_y / (2 * (a + b)), rel=5e-3)
    assert found.direction_rad == pytest.approx(0.0, abs=2e-3)


def test_smoothing_is_equation_5_38() -> None:
    points = cloud(seed=3)
    centre = points.mean(axis=0)
    d = [math.dist(p, centre) for p in points]
    d0 = sum(d) / len(d)
    literal = [each / (1.0 + math.exp(4.0 * (each - d0) / d0)) for each in d]
    np.testing.assert_allclose(smoothed_distances(points, steepness=4.0), literal, rtol=1e-12)


def test_smoothing_halves_the_mean_distance_and_forgets_what_is_far() -> None:
    ring = np.stack((np.cos(np.linspace(0, 6.2, 20)), np.sin(np.linspace(0, 6.2, 20))), axis=-1)
    far = np.vstack((np.vstack((ring, -ring)), [[80.0, 0.0], [-80.0, 0.0]]))
    damped = smoothed_distances(far)
    assert damped[-1] < 1e-10
    assert smoothed_inertia(far).axis_ratio > 0.9
    assert inertia(far).axis_ratio < 0.1
    circle = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    np.testing.assert_allclose(smoothed_distances(circle), 0.5, atol=1e-12)


def test_points_that_are_one_point() -> None:
    same = np.full((5, 2), 7.0)
    found = inertia(same)
    assert (found.axis_ratio, found.direction_rad, found.most) == (1.0, 0.0, 0.0)
    np.testing.assert_array_equal(smoothed_distances(same), np.zeros(5))
    assert inertia([[1.0, 2.0]]).centre == (1.0, 2.0)
    assert inertia([[0.0, 0.0], [0.0, 2.0]]).direction_rad == pytest.approx(-math.pi / 2)


@pytest.mark.parametrize(
    ("points", "text"),
    [
        (np.empty((0, 2)), "no points"),
        ([[math.nan, 0.0]], "finite"),
        ([[1.0, 2.0, 3.0]], r"\(N, 2\)"),
        ([[1e200, 0.0]], "1e100"),
    ],
)
def test_bad_points(points: F64, text: str) -> None:
    for function in (centre_of_gravity, inertia, smoothed_distances, smoothed_inertia):
        with pytest.raises(ValueError, match=text):
            function(points)
    with pytest.raises(ValueError, match=text):
        moment(points, 1, 0)


def test_bad_weights_orders_and_limits() -> None:
    with pytest.raises(ValueError, match="all weights are 0"):
        centre_of_gravity(cloud(count=2), weight=[0.0, 0.0])
    with pytest.raises(ValueError, match=">= 0"):
        inertia(cloud(count=2), weight=[1.0, -1.0])
    with pytest.raises(ValueError, match="like the points"):
        inertia(cloud(count=2), weight=[1.0])
    with pytest.raises(ValueError, match="orders"):
        moment(cloud(), -1, 0)
    with pytest.raises(ValueError, match="too large"):
        moment([[1e90, 0.0]], 9, 0)
    with pytest.raises(ValueError, match="steepness"):
        smoothed_distances(cloud(), steepness=0.0)
    with pytest.raises(ValueError, match="gap_m"):
        arc_weights(cloud(), gap_m=math.nan)
