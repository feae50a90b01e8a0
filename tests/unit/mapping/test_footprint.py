"""The vehicle's border as seen from a virtual sensor (S35)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mapping.frames import IDENTITY, Pose2
from mapping.sectors.footprint import Outline, checked_polygon, is_star_shaped, signed_area

RECTANGLE = [[0.45, 0.30], [-0.45, 0.30], [-0.45, -0.30], [0.45, -0.30]]
ARROW = np.array([[1.0, 0.0], [-1.0, 1.0], [-0.5, 0.0], [-1.0, -1.0]])  # star-shaped, not convex


def test_a_rectangle_from_its_middle() -> None:
    outline = Outline(RECTANGLE, IDENTITY)
    bearing = np.deg2rad([0.0, 90.0, 180.0, -90.0, 45.0])
    np.testing.assert_allclose(outline.border_m(bearing), [0.45, 0.30, 0.45, 0.30, 0.30 * math.sqrt(2.0)])


def test_corners_are_exact_from_anywhere_inside() -> None:
    pose = Pose2(0.2, -0.1, 0.7)
    outline = Outline(RECTANGLE, pose)
    corner = pose.inverse().apply(np.array(RECTANGLE))
    bearing = np.arctan2(corner[:, 1], corner[:, 0])
    np.testing.assert_allclose(outline.border_m(bearing), np.hypot(corner[:, 0], corner[:, 1]))


def test_a_border_point_lies_on_the_border_of_a_star() -> None:
    outline = Outline(ARROW, IDENTITY)
    bearing = np.linspace(-np.pi, np.pi, 181)
    border = outline.border_m(bearing)
    for share, inside in ((0.999, True), (1.001, False)):
        points = share * border[:, None] * np.stack((np.cos(bearing), np.sin(bearing)), axis=-1)
        assert (outline.contains(points) == inside).all()


def test_from_outside_the_far_side_counts_and_a_miss_is_zero() -> None:
    outline = Outline(RECTANGLE, Pose2(-2.0, 0.0, 0.0))
    np.testing.assert_allclose(outline.border_m([0.0, math.pi / 2.0]), [2.45, 0.0])
    assert not outline.contains_origin


def test_no_footprint_has_no_border() -> None:
    outline = Outline(None, IDENTITY)
    assert outline.border_m([0.3]) == 0.0
    assert not outline.contains(np.zeros((3, 2))).any()


def test_farthest_border_sees_the_corner_between_the_edges() -> None:
    outline = Outline(RECTANGLE, IDENTITY)
    edges = np.deg2rad([0.0, 20.0, 60.0, 90.0])
    corner = math.hypot(0.45, 0.30)  # at 33.7 degrees
    assert outline.farthest_border_m(edges)[1] == pytest.approx(corner)
    assert outline.farthest_border_m(edges)[0] == pytest.approx(0.45 / math.cos(math.radians(20.0)))


def test_clockwise_and_closed_rings_are_taken() -> None:
    ring = [*RECTANGLE[::-1], RECTANGLE[-1]]
    assert signed_area(checked_polygon(ring)) == pytest.approx(0.54)


def test_star_shape_is_judged_from_the_origin() -> None:
    assert is_star_shaped(ARROW)
    assert not is_star_shaped(ARROW + [0.7, 0.0])  # the origin lies in the notch


def test_a_sensor_on_the_bumper_is_outside() -> None:
    outline = Outline(RECTANGLE, Pose2(0.45, 0.0, 0.0))
    assert not outline.contains_origin
    assert outline.border_m([0.0])[0] == pytest.approx(0.0)


@pytest.mark.parametrize(
    "bad", [[], [[0, 0], [1, 1]], [[0, 0], [1, 1], [2, 2]], [[0, 0], [1, math.nan], [2, 0]], [[1], [2]]]
)
def test_what_is_no_outline_is_refused(bad: list[list[float]]) -> None:
    with pytest.raises(ValueError):
        checked_polygon(bad)
