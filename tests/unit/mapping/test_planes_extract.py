"""Plane extraction against numpy's SVD, slow literal forms of its steps, shapely, and rooms whose walls are known."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray
from shapely import MultiPoint

from mapping.kernels import planes as kernels
from mapping.planes.extract import (
    PlaneRules,
    Planes,
    RangeNoise,
    axes_of,
    depth_step_per_m2,
    extract_planes,
    noise_of_scatter,
    range_limit_m,
    range_warning,
)

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def patch(corner: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], step: float) -> F64:
    """A parallelogram as a lattice of points, half a step from its edges."""
    a, b = np.linalg.norm(u), np.linalg.norm(v)
    s, t = np.arange(step / 2, a, step) / a, np.arange(step / 2, b, step) / b
    grid_s, grid_t = (g.ravel()[:, None] for g in np.meshgrid(s, t))
    return np.asarray(np.array(corner) + grid_s * np.array(u) + grid_t * np.array(v))


WALLS = (  # normal away from the sensor, distance
    ((0.0, 0.0, -1.0), 1.2, patch((-2, -1.5, -1.2), (4, 0, 0), (0, 3, 0), 0.04)),
    ((0.0, 0.0, 1.0), 1.4, patch((-2, -1.5, 1.4), (4, 0, 0), (0, 3, 0), 0.04)),
    ((1.0, 0.0, 0.0), 2.0, patch((2, -1.5, -1.2), (0, 3, 0), (0, 0, 2.6), 0.04)),
    ((0.0, -1.0, 0.0), 1.5, patch((-2, -1.5, -1.2), (4, 0, 0), (0, 0, 2.6), 0.04)),
    ((-0.8, 0.6, 0.0), 1.6, patch((-2, 0, -1.2), (1.2, 1.6, 0), (0, 0, 2.6), 0.04)),
)


def room(sigma_m: float = 0.006, clutter: int = 800) -> tuple[F64, I64]:
    """Points of WALLS with noise along their rays, and strays; the wall of each, -1 for strays."""
    random = np.random.default_rng(7)
    points = np.concatenate([p for _, _, p in WALLS])
    wall = np.repeat(np.arange(len(WALLS)), [len(p) for _, _, p in WALLS])
    away = np.linalg.norm(points, axis=1, keepdims=True)
    points = points * (1.0 + random.normal(0.0, sigma_m, away.shape) / away)
    strays = random.uniform((-2.0, -1.5, -1.2), (2.0, 1.5, 1.4), (clutter, 3))
    order = random.permutation(len(points) + clutter)
    return np.concatenate((points, strays))[order], np.concatenate((wall, np.full(clutter, -1)))[order]


def test_a_blunt_edge_is_drawn_where_it_is() -> None:
    """Two planes that meet at 23 degrees, and noise along the rays: points near the edge lie within the tolerance of
    both, and belong to the side that they lie on."""
    random = np.random.default_rng(11)
    slope = math.radians(23.0)
    left = patch((2.0, 0.0, -0.5), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), 0.012)
    right = patch((2.0, 0.0, -0.5), (0.6 * math.sin(slope), -0.6 * math.cos(slope), 0.0), (0.0, 0.0, 1.0), 0.012)
    points = np.concatenate((left, right))
    side = np.repeat((0, 1), (len(left), len(right)))
    points *= 1.0 + random.normal(0.0, 0.004, (len(points), 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    planes = extract_planes(points)
    assert len(planes) == 2
    near = np.abs(points[:, 1]) < 0.1
    assert np.mean(planes.label[near] == side[near]) > 0.95  # 0.70 by distance alone
    assert np.mean(planes.label == side) > 0.98


def test_a_shelf_does_not_end_the_wall_that_it_meets() -> None:
    """Of two planes that do not both end where they meet, the distance counts, and the larger one's cells come first:
    a shelf cuts no strip out of its wall."""
    random = np.random.default_rng(12)
    wall = patch((2.0, -1.0, -1.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0), 0.015)
    shelf = patch((1.5, -0.5, 0.4), (0.5, 0.0, -0.09), (0.0, 1.0, 0.0), 0.015)
    points = np.concatenate((wall, shelf))
    points *= 1.0 + random.normal(0.0, 0.004, (len(points), 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    planes = extract_planes(points)
    assert len(planes) == 2
    assert np.mean(planes.label[: len(wall)] == 0) > 0.98


def same(a: Planes, b: Planes) -> bool:
    fields = ("normal", "distance_m", "centre_m", "covariance", "count", "cells", "rms_m", "label")
    outlines = all(np.array_equal(p, q) for p, q in zip(a.polygon, b.polygon))
    return all(np.array_equal(getattr(a, f), getattr(b, f)) for f in fields) and outlines


# --- the room


@pytest.mark.parametrize("rules", [PlaneRules(), PlaneRules.book()], ids=["refined", "book"])
def test_the_walls_of_a_room(rules: PlaneRules) -> None:
    points, wall = room()
    planes = extract_planes(points, rules)
    assert len(planes) == len(WALLS)
    for number, (normal, distance, _) in enumerate(WALLS):
        k = int(np.argmax(planes.normal @ normal))
        assert math.degrees(math.acos(min(1.0, float(planes.normal[k] @ normal)))) < (0.3 if rules.refined else 1.0)
        assert planes.distance_m[k] == pytest.approx(distance, abs=0.002 if rules.refined else 0.012)
        mine, found = wall == number, planes.label == k
        shared = np.count_nonzero(mine & found)
        assert shared > (0.93 if rules.refined else 0.6) * np.count_nonzero(mine)
        assert shared > 0.9 * np.count_nonzero(found)


@pytest.mark.parametrize(
    "rules", [PlaneRules(noise=RangeNoise(0.004, 0.002)), PlaneRules.book()], ids=["refined", "book"]
)
def test_what_is_said_of_a_plane_follows_from_its_points(rules: PlaneRules) -> None:
    points, _ = room()
    planes = extract_planes(points, rules)
    assert np.all(np.diff(planes.count) <= 0)
    for k in range(len(planes)):
        own = points[planes.label == k]
        assert len(own) == planes.count[k]
        weight = 1.0 / (rules.noise or RangeNoise(1.0)).at(np.linalg.norm(own, axis=1)) ** 2
        centre = weight @ own / weight.sum()
        np.testing.assert_allclose(planes.centre_m[k], centre, atol=1e-9)
        root = np.sqrt(weight / weight.sum())[:, None] * (own - centre)
        np.testing.assert_allclose(planes.covariance[k], root.T @ root, atol=1e-9)
        _, spread, axes = np.linalg.svd(root, full_matrices=False)  # eq. 5.23: the direction of the least scatter
        normal = axes[2] * np.sign(axes[2] @ centre)
        np.testing.assert_allclose(planes.normal[k], normal, atol=1e-7)
        assert planes.distance_m[k] == pytest.approx(float(normal @ centre), abs=1e-9)
        assert planes.rms_m[k] == pytest.approx(float(spread[2]), abs=1e-9)
        assert planes.distance_m[k] >= 0.0


def test_the_outline_is_the_convex_hull_in_the_plane() -> None:
    points, _ = room()
    planes = extract_planes(points)
    along, across = axes_of(planes.normal)
    for k, corners in enumerate(planes.polygon):
        np.testing.assert_allclose((corners - planes.centre_m[k]) @ planes.normal[k], 0.0, atol=1e-9)
        flat = (points[planes.label == k] - planes.centre_m[k]) @ np.stack((along[k], across[k]), axis=-1)
        hull = MultiPoint(flat).convex_hull
        mine = MultiPoint((corners - planes.centre_m[k]) @ np.stack((along[k], across[k]), axis=-1)).convex_hull
        assert mine.symmetric_difference(hull).area < 1e-9
        turn = np.cross(np.diff(corners, axis=0)[:-1], np.diff(corners, axis=0)[1:])
        assert np.all(turn @ -planes.normal[k] > 0.0), "counter-clockwise, seen from the sensor"


def test_the_same_points_give_the_same_planes_whoever_works() -> None:
    points, _ = room()
    first = extract_planes(points)
    assert same(first, extract_planes(points.copy()))
    with ThreadPoolExecutor(2) as pool:
        assert same(first, extract_planes(points, run=pool.map))
    backwards = extract_planes(points, run=lambda work, parts: [work(k) for k in list(parts)[::-1]][::-1])
    assert same(first, backwards)


def test_a_sensor_elsewhere_moves_the_ranges_not_the_planes() -> None:
    points, _ = room()
    here, there = extract_planes(points), extract_planes(points + (10.0, -4.0, 2.0), sensor_m=(10.0, -4.0, 2.0))
    assert len(there) == len(here)
    # Coordinates are rounded elsewhere, and a point at a border may fall into the other cell.
    np.testing.assert_allclose(there.centre_m - (10.0, -4.0, 2.0), here.centre_m, atol=0.01)
    np.testing.assert_allclose(np.abs(np.sum(there.normal * here.normal, axis=1)), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.sum(there.normal * there.centre_m, axis=1), there.distance_m, atol=1e-9)


def test_a_stair_of_small_steps_is_not_one_plane() -> None:
    """Four treads, 8 cm high and 25 cm deep: the book's 50 mm mixes them, the refined form keeps them apart."""
    treads = [patch((1.0 + 0.25 * k, -0.6, -0.5 + 0.08 * k), (0.25, 0, 0), (0, 1.2, 0), 0.02) for k in range(4)]
    points = np.concatenate(treads) + np.random.default_rng(2).normal(0.0, 0.002, (sum(map(len, treads)), 3))
    planes = extract_planes(points)
    level = planes.centre_m[np.abs(planes.normal[:, 2]) > 0.99, 2]
    np.testing.assert_allclose(np.sort(level), [-0.5, -0.42, -0.34, -0.26], atol=0.003)


def test_what_waves_is_one_plane_and_what_stands_back_is_not() -> None:
    """A ceiling of facets that tilt by 4 degrees to and fro, and a wall with a door that is set back by 4 cm."""
    random = np.random.default_rng(8)
    ceiling = patch((0.0, -1.0, 0.0), (3.0, 0, 0), (0, 2.0, 0), 0.025)
    ceiling[:, 2] = 1.5 + 0.07 * np.abs((ceiling[:, 0] % 0.8) - 0.4)
    wall = patch((4.0, -1.5, -1.0), (0, 3.0, 0), (0, 0, 2.2), 0.025)
    in_door = (np.abs(wall[:, 1]) < 0.5) & (wall[:, 2] < 0.9)
    wall[in_door, 0] += 0.04
    points = np.concatenate((ceiling, wall)) + random.normal(0.0, 0.002, (len(ceiling) + len(wall), 3))
    planes = extract_planes(points)
    assert len(planes) == 3
    assert len(np.unique(planes.label[: len(ceiling)])) <= 2, "one, and few points of none"
    leaf, rest = planes.label[len(ceiling) :][in_door], planes.label[len(ceiling) :][~in_door]
    assert np.bincount(leaf[leaf >= 0]).argmax() != np.bincount(rest[rest >= 0]).argmax()


# --- the steps


def test_morton_keys_interleave_and_come_back() -> None:
    random = np.random.default_rng(3)
    for i, j, h in [(0, 0, 0), (2**20 - 1,) * 3, *random.integers(0, 2**20, (50, 3)).tolist()]:
        key = kernels.spread(i) | (kernels.spread(j) << 1) | (kernels.spread(h) << 2)
        literal = sum(((i >> b & 1) | (j >> b & 1) << 1 | (h >> b & 1) << 2) << 3 * b for b in range(20))
        assert key == literal
        assert (kernels.squeeze(key), kernels.squeeze(key >> 1), kernels.squeeze(key >> 2)) == (i, j, h)


@pytest.mark.parametrize("most", [1, 5, 2**20, 2**60])
def test_the_radix_sort_is_a_stable_sort(most: int) -> None:
    key = np.random.default_rng(4).integers(0, most, 3000)
    order, ordered = kernels.sort_by_key(key)
    np.testing.assert_array_equal(order, np.argsort(key, kind="stable"))
    np.testing.assert_array_equal(ordered, np.sort(key))


def fitted_cells(points: F64, *, deepest: int, book_depth: int, rules: PlaneRules) -> tuple[I64, F64, I64, I64, I64]:
    """Key, row, begin, end, level of cells of 0.1 m at the deepest."""
    key = np.empty(len(points), dtype=np.int64)
    size = 0.1
    kernels.morton_keys(
        points, np.floor(points.min(axis=0) / (size * 2**deepest)) * size * 2**deepest, size, 0, len(points), key
    )
    order, key = kernels.sort_by_key(key)
    x, y, z = points[order].T.copy()
    n = len(points)
    row = np.empty((n, kernels.ROW))
    begin, end, level = (np.empty(n, dtype=np.int64) for _ in range(3))
    start = kernels.runs_of(key, 3 * deepest)
    vector = rules.vector(rules.noise or RangeNoise(0.006))
    count = kernels.fit_cells(
        x, y, z, np.ones(n), key, start, 0, len(start) - 1, 0, book_depth, deepest, vector, row, begin, end, level
    )
    return key, row[:count], begin[:count], end[:count], level[:count]


def neighbours(key: I64, begin: I64, level: I64, deepest: int) -> tuple[I64, I64]:
    """Which cells touch which, in two chunks."""
    mark, index = kernels.names_of_cells(key, begin, level, deepest)
    pairs = []
    for first, last in ((0, len(begin) // 3), (len(begin) // 3, len(begin))):
        pair = np.empty((26 * (last - first), 2), dtype=np.int64)
        pairs.append(pair[: kernels.pairs_of_cells(mark, index, key, begin, level, deepest, first, last, pair)])
    start, touching = kernels.neighbours_of_pairs(np.concatenate(pairs), len(begin))
    return start, touching


def test_cells_cover_all_points_once_and_touch_as_boxes_do() -> None:
    points, _ = room()
    points = points[::3]
    deepest = 3
    key, row, begin, end, level = fitted_cells(points, deepest=deepest, book_depth=2, rules=PlaneRules())
    assert begin[0] == 0
    assert end[-1] == len(points)
    np.testing.assert_array_equal(begin[1:], end[:-1])
    assert len(set(level.tolist())) > 1, "cells of several sizes"
    up = 3 * (deepest - level)
    own = key[begin] >> up
    assert np.all((key[end - 1] >> up) == own), "all of a cell's points are in it"
    low = np.stack(
        [np.array([kernels.squeeze(int(k) >> a) for k in own]) << (deepest - level) for a in range(3)], axis=1
    )
    high = low + (1 << (deepest - level))[:, None]
    first, neighbour = neighbours(key, begin, level, deepest)
    for c in range(0, len(begin), 7):  # literally: boxes that share a face, an edge or a corner
        touching = np.all((low <= high[c]) & (low[c] <= high), axis=1)
        touching[c] = False
        assert sorted(neighbour[first[c] : first[c + 1]]) == np.flatnonzero(touching).tolist()
    assert np.count_nonzero(row[:, kernels.COUNT] > 0) > 50


def test_growing_is_the_books() -> None:
    """Against a literal region growing with Python's own lists."""
    points, _ = room()
    rules = PlaneRules.book()
    key, row, begin, _, level = fitted_cells(points, deepest=0, book_depth=0, rules=rules)
    first, neighbour = neighbours(key, begin, level, 0)
    seeds = np.flatnonzero(row[:, kernels.COUNT] > 0)
    region = np.empty(len(row), dtype=np.int64)
    count = kernels.grow(row, seeds, first, neighbour, False, rules.vector(RangeNoise(1.0)), region, np.zeros_like(row))
    normal, d, cog = row[:, kernels.NX : kernels.NZ + 1], row[:, kernels.D], row[:, kernels.CX : kernels.CZ + 1]
    literal: dict[int, int] = {}
    regions = 0
    for seed in seeds.tolist():
        if seed in literal:
            continue
        waiting = [seed]
        literal[seed] = regions
        while waiting:
            c = waiting.pop(0)
            for other in neighbour[first[c] : first[c + 1]].tolist():
                angle = math.acos(min(1.0, abs(float(normal[c] @ normal[other]))))
                if other in literal or row[other, kernels.COUNT] == 0 or angle > rules.angle_rad:
                    continue
                if abs(float(normal[c] @ cog[other]) - d[c]) <= rules.apart_m:
                    literal[other] = regions
                    waiting.append(other)
        regions += 1
    assert regions == count
    assert region.tolist() == [literal.get(c, -1) for c in range(len(row))]


def test_ransac_finds_the_plane_that_most_points_are_on() -> None:
    random = np.random.default_rng(5)
    flat = np.column_stack((random.uniform(0, 1, (60, 2)), np.full(60, 0.3)))
    points = np.concatenate((flat, random.uniform(0, 1, (40, 3))))
    x, y, z = points.T.copy()
    count, nx, ny, nz, d = kernels.ransac(x, y, z, 0, 100, 0.01, 200, 12345)
    off = np.abs(points @ (nx, ny, nz) - d)
    assert count == np.count_nonzero(off <= 0.01)
    assert count >= 60
    assert abs(nz) == pytest.approx(1.0, abs=1e-3)
    assert kernels.ransac(x, y, z, 0, 100, 0.01, 200, 12345) == (count, nx, ny, nz, d)
    line = np.arange(20.0)
    assert kernels.ransac(line, 2.0 * line, -line, 0, 20, 0.01, 50, 1)[0] == 0


# --- noise, steps, limits


def test_noise_is_taken_from_the_cloud() -> None:
    for sigma in (0.002, 0.006, 0.012):
        points, _ = room(sigma, clutter=0)
        across = extract_planes(points).noise.sigma_m  # along the ray; across a wall it is less where seen at a slant
        assert 0.4 * sigma < across < 1.3 * sigma
    near, far = np.linspace(0.5, 4.0, 400), np.linspace(0.5, 4.0, 400)
    found = noise_of_scatter(near, 0.001 + 0.002 * far**2, most_m=0.1)
    assert found.sigma_m == pytest.approx(0.001, rel=0.3)
    assert found.sigma_per_m2 == pytest.approx(0.002, rel=0.05)


def test_depth_cameras_are_known_by_their_steps() -> None:
    random = np.random.default_rng(6)
    true = random.uniform(0.8, 4.0, 20_000)
    disparity = np.round(8.0 * 43.5 / true) / 8.0  # in eighths of a pixel
    z = 43.5 / disparity
    x, y = random.normal(size=(2, len(z))) * z
    assert depth_step_per_m2(x, y, z) == pytest.approx(1.0 / (8.0 * 43.5), rel=0.1)
    assert depth_step_per_m2(x, y, true) == 0.0
    assert depth_step_per_m2(np.round(x, 1), y, np.round(true, 2)) == 0.0, "a lattice has no steps of depth"


def test_the_range_limit_of_a_cell() -> None:
    assert range_limit_m(0.2, math.radians(0.5)) == pytest.approx(11.46, abs=0.005)
    rules = PlaneRules.book(min_points=9)
    assert range_warning(rules, math.radians(0.5), 11.4) is None
    warning = range_warning(rules, math.radians(0.5), 11.6)
    assert warning is not None
    assert "11.5 m" in warning
    assert range_warning(PlaneRules(), math.radians(0.5), 11.6) is None, "larger cells reach farther"


@pytest.mark.parametrize("bad", [(0.0, 0.1), (-1.0, 0.1), (math.nan, 0.1), (0.2, 0.0), (0.2, 2.0), (0.2, math.nan)])
def test_a_range_limit_needs_a_cell_and_an_angle(bad: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"_m must be|_rad lies"):
        range_limit_m(*bad)


# --- bad input


@pytest.mark.parametrize("rules", [PlaneRules(), PlaneRules.book()], ids=["refined", "book"])
@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3)),
        np.ones((1, 3)),
        np.full((500, 3), np.nan),
        np.ones((500, 3)),
        np.linspace(0, 5, 500)[:, None] * (1.0, 2.0, 3.0),
        np.full((500, 3), 1e300),
        np.random.default_rng(1).uniform(-9e3, 9e3, (500, 3)),
        np.random.default_rng(1).uniform(-1e-9, 1e-9, (500, 3)),
    ],
    ids=["none", "one", "nan", "equal", "collinear", "huge", "scattered", "tiny"],
)
def test_what_has_no_planes(points: F64, rules: PlaneRules) -> None:
    planes = extract_planes(points, rules)
    assert len(planes) == 0
    assert planes.label.tolist() == [-1] * len(points)
    assert planes.normal.shape == (0, 3)


def test_bad_points_are_left_out_not_the_others() -> None:
    points, _ = room()
    spoiled = points.copy()
    spoiled[::50] = (np.nan, 0.0, 0.0)
    spoiled[1::50] = (np.inf, 1.0, 1.0)
    spoiled[2::50] = 2e4
    planes = extract_planes(spoiled)
    assert len(planes) == len(WALLS)
    assert np.all(planes.label[::50] == -1)
    assert np.all(planes.label[2::50] == -1)


@pytest.mark.parametrize("shape", [(3,), (5, 2), (2, 2, 3)])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="points_m"):
        extract_planes(np.zeros(shape))


@pytest.mark.parametrize(
    "changes",
    [
        {"cell_m": 0.0},
        {"inlier_m": -1.0},
        {"angle_rad": 2.0},
        {"min_points": 2},
        {"iterations": 0},
        {"seed": -1},
        {"coarser": 9},
        {"warp": math.nan},
    ],
)
def test_rules_that_make_no_sense(changes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes)).split("_")[0]):
        PlaneRules(**changes)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="sigma_m"):
        RangeNoise(0.0)
