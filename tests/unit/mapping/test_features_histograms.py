"""S20 and S14: rooms whose walls, orientation and hidden corners are known."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.features.anchors import AnchorKind
from mapping.features.histograms import axis_walls, box_feature, main_orientation, square_scene, virtual_edges
from mapping.frames import Pose2

F64 = NDArray[np.float64]


def outline(width: float, height: float, step: float = 0.02, *, without: tuple[float, float] | None = None) -> F64:
    """Points along a rectangle about the origin, counter-clockwise from its right lower corner; a corner may be hidden
    (what lies within 0.6 m of `without`)."""
    a, b = 0.5 * width, 0.5 * height
    corners = np.array([[a, -b], [a, b], [-a, b], [-a, -b], [a, -b]])
    sides = [
        start + (end - start) * np.arange(0.0, 1.0, step / math.dist(start, end))[:, None]
        for start, end in pairwise(corners)
    ]
    points = np.concatenate(sides)
    return points if without is None else points[np.hypot(*(points - without).T) > 0.6]


def noisy(points: F64, sigma: float, seed: int = 3) -> F64:
    return points + np.random.default_rng(seed).normal(0.0, sigma, points.shape)


@pytest.mark.parametrize("degrees", [-44.0, -30.0, -3.0, 0.0, 12.5, 40.0, 44.9])
def test_the_main_orientation_of_a_room(degrees: float) -> None:
    turned = Pose2(2.0, 1.0, math.radians(degrees)).apply(noisy(outline(6.0, 4.0), 0.008))
    found = main_orientation(turned)
    assert found is not None
    assert math.degrees(found.angle_rad) == pytest.approx(degrees, abs=0.4)
    assert found.share > 0.8


def test_a_room_at_45_degrees_is_on_either_end_of_the_range() -> None:
    found = main_orientation(Pose2(0.0, 0.0, math.radians(45.0)).apply(outline(6.0, 4.0)))
    assert found is not None
    assert abs(math.degrees(found.angle_rad)) == pytest.approx(45.0, abs=0.4)


def test_chords_between_neighbours_are_the_books_form() -> None:
    points = Pose2(0.0, 0.0, 0.3).apply(outline(6.0, 4.0))
    found = main_orientation(points, span_m=0.0)
    assert found is not None
    assert found.angle_rad == pytest.approx(0.3, abs=1e-3)
    noise = noisy(points, 0.02)
    short, long = main_orientation(noise, span_m=0.0), main_orientation(noise)
    assert short is not None
    assert long is not None
    assert long.share > 2.0 * short.share  # noise drowns short chords


def test_round_things_have_no_strong_orientation() -> None:
    turn = np.linspace(0.0, 2.0 * math.pi, 400)
    found = main_orientation(3.0 * np.stack((np.cos(turn), np.sin(turn)), axis=-1))
    assert found is not None
    assert found.share < 0.2


def test_nothing_has_no_orientation() -> None:
    for points in (np.empty((0, 2)), [[1.0, 1.0]], np.full((9, 2), 3.0), [[0.0, 0.0], [90.0, 0.0]]):
        assert main_orientation(points) is None
        assert square_scene(points) is None


def test_walls_are_where_the_histogram_heaps() -> None:
    scene = square_scene(noisy(outline(6.0, 4.0), 0.01))
    assert scene is not None
    walls = scene.x_walls
    np.testing.assert_allclose(walls.position_m, [-3.0, 3.0], atol=0.02)
    assert (walls.length_m > 3.2).all()
    np.testing.assert_allclose(walls.low_m, -2.0, atol=0.25)  # a surface bends within a quarter of a metre of a corner
    np.testing.assert_allclose(walls.high_m, 2.0, atol=0.25)


def test_peaks_are_those_of_a_slow_histogram() -> None:
    random = np.random.default_rng(8)
    x = np.concatenate((random.normal(1.0, 0.01, 80), random.normal(4.0, 0.01, 50), random.uniform(0.0, 6.0, 60)))
    walls = axis_walls(x, np.zeros(x.size), np.full(x.size, 0.05), bin_m=0.1, least_m=1.0)
    counts: dict[int, float] = {}
    for value in x:
        k = int((value - x.min()) / 0.1)
        counts[k] = counts.get(k, 0.0) + 0.05
    three = {k: sum(counts.get(k + d, 0.0) for d in (-1, 0, 1)) for k in range(int((x.max() - x.min()) / 0.1) + 1)}
    tops = [k for k, v in three.items() if v >= 1.0 and v == max(three.get(k + d, 0.0) for d in range(-2, 3))]
    groups = sum(1 for a, b in zip([-9, *tops], tops) if b - a > 2)
    assert len(walls) == groups == 2
    np.testing.assert_allclose(walls.position_m, [1.0, 4.0], atol=0.03)


def test_the_corner_that_no_beam_hit_is_a_virtual_edge() -> None:
    pose = Pose2(1.0, -2.0, 0.4)
    scene = square_scene(pose.apply(outline(6.0, 4.0, without=(3.0, 2.0))))
    assert scene is not None
    found = virtual_edges(scene)
    np.testing.assert_allclose(found.points, [pose.apply([3.0, 2.0])], atol=0.05)
    assert found.kinds.tolist() == [AnchorKind.VIRTUAL]
    assert found.beams.tolist() == [-1]
    assert np.isnan(found.walls_rad).all()
    complete = square_scene(outline(6.0, 4.0))
    assert complete is not None
    assert len(virtual_edges(complete)) == 0


def test_walls_that_end_far_from_each_other_meet_only_in_the_book() -> None:
    apart = np.concatenate(
        (
            np.stack((np.arange(0.0, 2.0, 0.02), np.zeros(100)), axis=-1),
            [[7.0, 9.0]] + np.outer(np.arange(100), [0, 0.02]),
        )
    )
    scene = square_scene(apart)
    assert scene is not None
    assert len(virtual_edges(scene)) == 0
    np.testing.assert_allclose(virtual_edges(scene, reach_m=math.inf).points, [[7.0, 0.0]], atol=0.05)


@pytest.mark.parametrize("degrees", [-60.0, 0.0, 30.0, 80.0])
def test_the_box_of_a_room(degrees: float) -> None:
    pose = Pose2(1.0, 2.0, math.radians(degrees))
    scene = square_scene(pose.apply(noisy(outline(6.0, 4.0), 0.008)))
    assert scene is not None
    box = box_feature(scene)
    assert box is not None
    assert box.size_m == pytest.approx((6.0, 4.0), abs=0.03)
    assert box.centre_m == pytest.approx((1.0, 2.0), abs=0.03)
    assert math.remainder(box.angle_rad - math.radians(degrees), math.pi) == pytest.approx(0.0, abs=0.01)
    truth = pose.apply(np.array([[3.0, 2.0], [-3.0, 2.0], [-3.0, -2.0], [3.0, -2.0]]))
    for corner in box.corners():
        assert float(np.hypot(*(truth - corner).T).min()) < 0.06


def test_furniture_inside_does_not_change_the_box() -> None:
    cupboard = np.stack((np.full(60, 1.0), np.linspace(-0.6, 0.6, 60)), axis=-1)
    scene = square_scene(np.concatenate((outline(6.0, 4.0), cupboard)))
    assert scene is not None
    box = box_feature(scene)
    assert box is not None
    assert box.size_m == pytest.approx((6.0, 4.0), abs=0.02)
    assert len(scene.x_walls) == 3


def test_one_wall_is_no_box() -> None:
    scene = square_scene(np.stack((np.arange(0.0, 3.0, 0.02), np.ones(150)), axis=-1))
    assert scene is not None
    assert box_feature(scene) is None


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="finite"):
        main_orientation([[math.nan, 0.0]])
    with pytest.raises(ValueError, match="span_m"):
        main_orientation([[0.0, 0.0]], span_m=-1.0)
    with pytest.raises(ValueError, match="one length"):
        axis_walls([0.0], [0.0, 1.0], [1.0])
    with pytest.raises(ValueError, match="finite"):
        axis_walls([math.nan], [0.0], [1.0])
    with pytest.raises(ValueError, match="bins"):
        axis_walls([0.0, 1e9], [0.0, 0.0], [1.0, 1.0])
    with pytest.raises(ValueError, match="above 0"):
        axis_walls([0.0], [0.0], [1.0], bin_m=0.0)
    scene = square_scene(outline(6.0, 4.0))
    assert scene is not None
    with pytest.raises(ValueError, match="above 0"):
        virtual_edges(scene, near_m=0.0)
