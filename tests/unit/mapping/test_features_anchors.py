"""S18 and S19: algorithm 5.3 written out as the book has it, and anchors against rooms whose corners are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.features.anchors import AnchorFinder, AnchorKind, AnchorRules, Anchors, no_anchors
from mapping.features.range_image import Mark, segment_ranges, surface_angles
from mapping.frames import Pose2
from mapping.lines.extract import LineRules

F64 = NDArray[np.float64]
TURN = np.radians(np.arange(-180.0, 180.0, 0.5))
FRONT = np.radians(np.arange(-90.0, 90.5, 0.5))


def cast(walls: list[tuple[float, float, float, float]], x: float, y: float, bearing: F64) -> F64:
    """Ranges to the nearest of some walls, by solving for each in turn; +inf where there is none."""
    out = np.full(bearing.size, math.inf)
    for k, b in enumerate(bearing):
        c, s = math.cos(b), math.sin(b)
        for x0, y0, x1, y1 in walls:
            system = np.array([[c, x0 - x1], [s, y0 - y1]])
            if abs(np.linalg.det(system)) < 1e-12:
                continue
            r, t = np.linalg.solve(system, np.array([x0 - x, y0 - y]))
            if r > 0.0 and -1e-9 <= t <= 1.0 + 1e-9:
                out[k] = min(out[k], r)
    return out


def polygon(*corners: tuple[float, float]) -> list[tuple[float, float, float, float]]:
    return [(*a, *b) for a, b in zip(corners, corners[1:] + corners[:1])]


def literal_5_3(ranges: F64, s: float) -> tuple[list[int], list[int]]:
    """Algorithm 5.3 for finite ranges, line by line, with its two misprints corrected."""
    n = len(ranges)
    label, mark = [-1] * n, [int(Mark.INSIDE)] * n
    segment, i = 0, 0
    label[0] = 0
    while i < n - 1:
        step = abs(ranges[i + 1] - ranges[i])
        if step <= s:
            label[i + 1] = segment
            i = i + 1
        elif i + 2 < n and abs(ranges[i + 2] - ranges[i]) <= s:
            label[i + 2] = segment
            mark[i + 1] = int(Mark.STRAY)
            i = i + 2
        elif i + 2 >= n or abs(ranges[i + 2] - ranges[i + 1]) <= s:
            mark[i] = int(Mark.EDGE)
            segment += 1
            label[i + 1] = segment
            i = i + 1
        else:
            mark[i + 1] = int(Mark.FALSE_EDGE)
            segment += 1
            label[i + 2] = segment
            i = i + 2
    return label, mark


@pytest.mark.parametrize("seed", range(30))
def test_segmentation_is_algorithm_5_3(seed: int) -> None:
    random = np.random.default_rng(seed)
    ranges = np.round(np.cumsum(random.choice([0.0, 0.05, -0.05, 1.0, -1.0], 60)) + 20.0, 3)
    found = segment_ranges(ranges, 0.3)
    label, mark = literal_5_3(ranges, 0.3)
    assert found.label.tolist() == label
    assert found.mark.tolist() == mark
    assert found.count == max(label) + 1
    assert sum(len(part) for part in found.segments()) == sum(k >= 0 for k in label)


def test_each_branch_of_algorithm_5_3() -> None:
    found = segment_ranges([1.0, 1.1, 5.0, 1.1, 1.2, 4.0, 4.1, 9.0, 2.0, 2.1], 0.3)
    assert found.label.tolist() == [0, 0, -1, 0, 0, 1, 1, -1, 2, 2]
    assert found.mark[[2, 4, 7]].tolist() == [Mark.STRAY, Mark.EDGE, Mark.FALSE_EDGE]


def test_beams_without_a_range_end_a_segment_and_belong_to_none() -> None:
    found = segment_ranges([1.0, 1.0, math.nan, 1.0, math.inf, -math.inf, 1.0], 0.3)
    assert found.label.tolist() == [0, 0, -1, 1, -1, -1, 2]
    assert segment_ranges(np.full(5, math.nan), 0.3).count == 0
    assert segment_ranges([], 0.3).count == 0
    assert segment_ranges([2.0], 0.3).label.tolist() == [0]


def test_a_limit_that_grows_with_range() -> None:
    ranges = [10.0, 10.8, 11.6]
    assert segment_ranges(ranges, 0.3).count > 1
    assert segment_ranges(ranges, 0.3, jump_per_m=0.1).count == 1


def test_bad_ranges_and_limits() -> None:
    with pytest.raises(ValueError, match="one row"):
        segment_ranges([[1.0]], 0.3)
    with pytest.raises(ValueError, match="jump_m"):
        segment_ranges([1.0], math.nan)
    with pytest.raises(ValueError, match="jump_per_m"):
        segment_ranges([1.0], 0.3, jump_per_m=-1.0)


def test_surface_angles_are_level_on_walls_and_climb_on_a_pillar() -> None:
    ranges = cast(polygon((-3, -2), (3, -2), (3, 2), (-3, 2)), 0.0, 0.0, FRONT)
    points = np.stack((ranges * np.cos(FRONT), ranges * np.sin(FRONT)), axis=-1)
    angle = surface_angles(points, segment_ranges(ranges, 0.3).label)
    corner = math.atan2(2.0, 3.0)
    front = np.abs(FRONT) < corner - 0.2
    np.testing.assert_allclose(angle[front], -math.pi / 2, atol=1e-6)
    side = corner + 0.2 < FRONT
    np.testing.assert_allclose(angle[side], 0.0, atol=1e-6)
    round_bearing = np.linspace(-0.4, 0.4, 81)
    circle = 3.0 * np.cos(round_bearing) - np.sqrt(1.5**2 - (3.0 * np.sin(round_bearing)) ** 2)
    on_it = np.stack((circle * np.cos(round_bearing), circle * np.sin(round_bearing)), axis=-1)
    slope = surface_angles(on_it, np.zeros(81, dtype=np.int64))
    # The tangent at a point p of a circle about c stands on p - c.
    truth = np.arctan2(on_it[:, 1], on_it[:, 0] - 3.0) - math.pi / 2
    off = np.mod(slope - truth + math.pi / 2, math.pi) - math.pi / 2
    assert float(np.abs(off[15:-15]).max()) < 0.02  # neighbours on either side are not equally many
    assert np.isnan(surface_angles(on_it[:2], [0, 0])).all()
    assert np.isnan(surface_angles(on_it, np.full(81, -1))).all()


def test_bad_surface_angles() -> None:
    with pytest.raises(ValueError, match=r"\(N, 2\)"):
        surface_angles([[1.0, 2.0]], [0, 1])
    with pytest.raises(ValueError, match="finite"):
        surface_angles([[math.inf, 2.0]], [0])
    with pytest.raises(ValueError, match="half_m"):
        surface_angles([[1.0, 2.0]], [0], half_m=0.0)


def expect(found: Anchors, kind: AnchorKind, places: list[tuple[float, float]], atol: float) -> None:
    """The anchors of one kind lie at these places, in any order."""
    points = found.of_kinds(kind).points
    assert len(points) == len(places), (kind, points)
    for place in places:
        assert float(np.hypot(*(points - place).T).min()) < atol, (kind, place, points)


def test_corners_of_a_room_seen_all_round() -> None:
    corners = [(-3.0, -2.0), (3.0, -2.0), (3.0, 2.0), (-3.0, 2.0)]
    found = AnchorFinder(TURN).find(cast(polygon(*corners), 0.0, 0.0, TURN))
    expect(found, AnchorKind.CORNER, corners, 2e-3)  # a point beside a corner may count for the wrong wall
    assert len(found) == 4
    for (x, y), walls in zip(found.points, found.walls_rad):
        truth = {0.0 if x < 0 else math.pi, math.pi / 2 if y < 0 else -math.pi / 2}
        for direction in truth:
            assert min(abs(math.remainder(float(w) - direction, 2 * math.pi)) for w in walls) < 2e-3


def test_a_box_in_a_room_has_real_edges_and_throws_false_ones() -> None:
    room, block = polygon((-1, -6), (8, -6), (8, 6), (-1, 6)), polygon((3, -1), (4, -1), (4, 1), (3, 1))
    found = AnchorFinder(FRONT).find(cast(room + block, 0.0, 0.0, FRONT))
    expect(found, AnchorKind.JUMP_EDGE, [(3.0, -1.0), (3.0, 1.0)], 0.05)
    expect(found, AnchorKind.CORNER, [(8.0, -6.0), (8.0, 6.0)], 1e-6)
    expect(found, AnchorKind.FALSE_EDGE, [(8.0, 8.0 / 3.0), (8.0, -8.0 / 3.0)], 0.15)
    assert (found.beams >= 0).all()


def test_a_corner_that_sticks_out_is_one_too() -> None:
    walls = [(-1.0, 3.0, 2.0, 3.0), (2.0, 3.0, 2.0, 5.0), (2.0, 5.0, 6.0, 5.0), (6.0, 5.0, 6.0, -5.0)]
    found = AnchorFinder(FRONT).find(cast(walls, 4.0, 0.0, FRONT + 1.0))
    places = [(x - 4.0, y) for x, y in ((2.0, 3.0), (2.0, 5.0), (6.0, 5.0))]
    turned = found.transformed(Pose2(0.0, 0.0, 1.0))
    expect(turned, AnchorKind.CORNER, places, 1e-6)


def test_a_wall_that_goes_over_into_something_rough_ends() -> None:
    bearing = np.radians(np.arange(-60.0, 60.0, 0.5))
    hedge = 3.0 + np.random.default_rng(2).uniform(-0.12, 0.12, bearing.size)
    ranges = np.where(bearing > 0.0, hedge, 3.0) / np.cos(bearing)
    ends = AnchorFinder(bearing, AnchorRules(lines=LineRules(sigma_m=0.005))).find(ranges).of_kinds(AnchorKind.WALL_END)
    assert float(np.hypot(*(ends.points - [3.0, 0.0]).T).min()) < 0.1


def test_nothing_seen_behind_is_an_edge_and_not_known_is_none() -> None:
    walls = [(3.0, -1.0, 3.0, 1.0)]
    ranges = cast(walls, 0.0, 0.0, FRONT)
    finder = AnchorFinder(FRONT)
    expect(finder.find(ranges), AnchorKind.JUMP_EDGE, [(3.0, -1.0), (3.0, 1.0)], 0.05)
    ranges[np.isinf(ranges)] = math.nan
    assert len(finder.find(ranges)) == 0
    ranges[np.isnan(ranges)] = -math.inf
    assert len(finder.find(ranges)) == 0


def test_a_stray_point_beside_a_wall_is_no_edge() -> None:
    ranges = cast(polygon((-3, -2), (3, -2), (3, 2), (-3, 2)), 0.0, 0.0, TURN)
    clean = AnchorFinder(TURN).find(ranges)
    ranges[[200, 360, 500]] = 0.7
    np.testing.assert_allclose(AnchorFinder(TURN).find(ranges).points, clean.points, atol=1e-6)


def test_a_wall_that_beams_become_too_sparse_to_follow_does_not_end_there() -> None:
    bearing = np.radians(np.arange(-90.0, 0.5, 1.0))
    found = AnchorFinder(bearing).find(np.where(bearing < -0.02, 1.0 / np.maximum(np.sin(-bearing), 1e-3), math.nan))
    assert len(found) == 0


def test_beams_in_falling_order_give_the_same_anchors() -> None:
    walls = polygon((-1, -6), (8, -6), (8, 6), (-1, 6)) + polygon((3, -1), (4, -1), (4, 1), (3, 1))
    ranges = cast(walls, 0.0, 0.0, FRONT)
    rising, falling = AnchorFinder(FRONT).find(ranges), AnchorFinder(FRONT[::-1]).find(ranges[::-1])
    np.testing.assert_allclose(rising.points, falling.points, atol=1e-12)
    np.testing.assert_array_equal(rising.beams, FRONT.size - 1 - falling.beams)


def test_nothing_gives_no_anchors() -> None:
    finder = AnchorFinder(FRONT)
    for filler in (math.nan, math.inf, -math.inf, 0.0, 1e300):
        assert len(finder.find(np.full(FRONT.size, filler))) == 0
    alone = np.full(FRONT.size, math.inf)
    alone[7] = 2.0
    assert len(finder.find(alone)) == 0
    assert len(AnchorFinder([]).find([])) == 0
    assert len(no_anchors()) == 0


def test_bad_shapes_and_rules() -> None:
    with pytest.raises(ValueError, match="range_m is"):
        AnchorFinder(FRONT).find([1.0])
    with pytest.raises(ValueError, match="rise or fall"):
        AnchorFinder([0.0, 1.0, 0.5])
    with pytest.raises(ValueError, match="corner_m"):
        AnchorRules(corner_m=0.0)
    with pytest.raises(ValueError, match="bend_deg"):
        AnchorRules(bend_deg=90.0)
