"""Elevation, slope, step, roughness, traversability (S33), and what of it sectors hold (S37)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.height import Elevation, ElevationMap, Ground, GroundRules
from mapping.sectors.ground import ground_in_sectors

F64 = NDArray[np.float64]
D = 0.1


def floor_points(side_m: float = 4.0, per_cell: int = 5, seed: int = 1) -> F64:
    """(N, 3) around the origin, height 0, every cell with points."""
    rng = np.random.default_rng(seed)
    cells = np.stack(np.meshgrid(*[np.arange(-side_m / 2, side_m / 2, D)] * 2), axis=-1).reshape(-1, 2)
    xy = np.repeat(cells, per_cell, axis=0) + rng.uniform(0.01, D - 0.01, (len(cells) * per_cell, 2))
    return np.column_stack((xy, np.zeros(len(xy))))


def elevation_of(*clouds: F64, rules: GroundRules | None = None) -> Elevation:
    heights = ElevationMap(resolution_m=D, rules=rules)
    for cloud in clouds:
        heights.insert(cloud)
    return heights.elevation()


def at(elevation: Elevation, layer: NDArray[np.generic], x: float, y: float) -> float:
    return float(layer[math.floor(y / D + 1e-9) - elevation.row0, math.floor(x / D + 1e-9) - elevation.col0])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 300))
def test_moments_of_each_cell_are_those_of_its_points(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    cloud = rng.normal(0.0, 0.3, (count, 3)) + [rng.normal(0.0, 5.0), 0.0, 40.0]
    heights = ElevationMap(resolution_m=D, rules=GroundRules(points_min=1))
    for part in np.array_split(cloud, 3):
        heights.insert(part)
    found = heights.elevation()
    rows, cols = np.floor(cloud[:, 1] / D).astype(int), np.floor(cloud[:, 0] / D).astype(int)
    for row, col in set(zip(rows.tolist(), cols.tolist())):
        z = cloud[(rows == row) & (cols == col), 2]
        cell = (row - found.row0, col - found.col0)
        assert found.count[cell] == len(z)
        assert (found.min_m[cell], found.max_m[cell]) == (z.min(), z.max())
        assert found.mean_m[cell] == pytest.approx(z.mean())
        assert found.variance_m2[cell] == pytest.approx(z.var(), abs=1e-9)
    assert found.count.sum() == count
    assert np.all(np.isnan(found.mean_m[found.count == 0]))


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(-1000.0, 1000.0))
def test_a_plane_has_its_slope_and_no_roughness(a: float, b: float, height: float) -> None:
    cloud = floor_points(1.0)
    centres = (np.floor(cloud[:, :2] / D + 1e-9) + 0.5) * D
    cloud[:, 2] = height + a * centres[:, 0] + b * centres[:, 1]
    found = elevation_of(cloud)
    inner = np.s_[1:-1, 1:-1]
    assert found.slope_rad[inner] == pytest.approx(math.atan(math.hypot(a, b)), abs=1e-6)
    assert np.all(found.roughness_m[inner] < 1e-5)
    assert found.step_m[inner] == pytest.approx(D * (abs(a) + abs(b)), abs=1e-6)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_slope_and_roughness_are_those_of_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cloud = floor_points(0.8, per_cell=3, seed=seed)
    cell = np.floor(cloud[:, :2] / D + 1e-9).astype(int)
    kept = rng.random((40, 40))[cell[:, 0], cell[:, 1]] < 0.8
    cloud, cell = cloud[kept], cell[kept]
    cloud[:, 2] = rng.normal(0.0, 0.05, len(cloud))
    found = elevation_of(cloud)
    for row in range(1, found.mean_m.shape[0] - 1):
        for col in range(1, found.mean_m.shape[1] - 1):
            z = found.mean_m[row - 1 : row + 2, col - 1 : col + 2].ravel()
            y, x = D * (np.indices((3, 3)).reshape(2, -1) - 1.0)
            there = ~np.isnan(z)
            matrix = np.stack((x, y, np.ones(9)), axis=-1)[there]
            if np.isnan(z[4]) or there.sum() < 5 or np.linalg.matrix_rank(matrix) < 3:
                assert np.isnan(found.slope_rad[row, col])
                continue
            solution = np.linalg.lstsq(matrix, z[there], rcond=None)[0]
            assert found.slope_rad[row, col] == pytest.approx(math.atan(math.hypot(solution[0], solution[1])))
            rest = z[there] - matrix @ solution
            assert found.roughness_m[row, col] == pytest.approx(math.sqrt(np.mean(rest**2)), abs=1e-9)


def test_classes_of_a_floor_with_a_kerb_a_ramp_a_wall_and_rubble() -> None:
    cloud = floor_points(6.0)
    x, y = cloud[:, 0], cloud[:, 1]
    cloud[(x >= 1.0) & (x < 2.0) & (y > 0.0), 2] = 0.12  # a kerb
    ramp = (x >= 1.0) & (x < 2.0) & (y < -1.0)
    cloud[ramp, 2] = (x[ramp] - 1.0) * math.tan(math.radians(30.0))
    rubble = (x < -2.0) & (y > 1.0)
    cloud[rubble, 2] += np.random.default_rng(2).uniform(-0.07, 0.07, np.count_nonzero(rubble)) / 2
    wall = np.column_stack((np.full(200, -1.45), np.full(200, -1.55), np.linspace(0.0, 1.0, 200)))
    found = elevation_of(cloud, wall, rules=GroundRules(step_max_m=0.1, roughness_max_m=0.008))
    ground = found.ground
    assert at(found, ground, 0.0, 0.5) == Ground.TRAVERSABLE
    assert at(found, ground, 1.5, 1.5) == Ground.TRAVERSABLE  # on the kerb
    assert at(found, ground, 1.0, 1.0) == Ground.STEP
    assert at(found, ground, 0.9, 1.0) == Ground.STEP
    assert at(found, ground, 1.5, -1.5) == Ground.STEEP
    assert at(found, ground, -1.45, -1.55) == Ground.STEP
    assert np.count_nonzero(ground[found.row0 * 0 :][:, :5] == Ground.ROUGH) > 0
    assert np.all(np.isin(ground, list(Ground)))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_what_was_not_seen_well_enough_is_never_traversable(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cloud = floor_points(1.5, per_cell=4, seed=seed)
    cloud = cloud[rng.random(len(cloud)) < rng.uniform(0.1, 0.9)]
    rules = GroundRules(points_min=int(rng.integers(1, 5)), neighbours_min=int(rng.integers(2, 9)))
    found = elevation_of(cloud, rules=rules)
    known = np.pad(found.count >= rules.points_min, 1)
    rows, cols = found.count.shape
    around = sum(known[1 + i : 1 + i + rows, 1 + j : 1 + j + cols].astype(int) for i in (-1, 0, 1) for j in (-1, 0, 1))
    driven = found.ground == Ground.TRAVERSABLE
    assert not np.any(driven & ~known[1:-1, 1:-1])
    assert not np.any(driven & (around - 1 < rules.neighbours_min))


def test_ceilings_and_points_that_are_none() -> None:
    heights = ElevationMap(resolution_m=D, height_max_m=1.5)
    assert heights.elevation().ground.shape == (0, 0)
    heights.insert(np.zeros((0, 3)))
    heights.insert([(np.nan, 0.0, 0.0), (0.0, np.inf, 0.0), (0.0, 0.0, 2.4)])
    assert heights.rejected_points == 2
    assert heights.elevation().count.sum() == 0
    heights.insert([(0.0, 0.0, 0.1)] * 3)
    with pytest.raises(ValueError, match="too many"):
        heights.insert([(1e6, 1e6, 0.0)])
    assert heights.elevation().count.sum() == 3
    for points in ([(1.0, 2.0)], [1.0, 2.0, 3.0]):
        with pytest.raises(ValueError, match="points"):
            heights.insert(points)


@pytest.mark.parametrize(
    "options", [{"slope_max_rad": 2.0}, {"step_max_m": 0.0}, {"points_min": 0}, {"neighbours_min": 9}]
)
def test_rules_that_make_no_sense_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError):
        GroundRules(**options)  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------------------------------ sectors


def edges(count: int = 8) -> F64:
    return np.linspace(-math.pi, math.pi, count + 1)


def test_a_sector_is_traversable_up_to_what_stops_it() -> None:
    wall = np.column_stack(
        (np.full(600, 1.55), np.repeat(np.linspace(-0.6, 0.6, 30), 20), np.tile(np.linspace(0, 1, 20), 30))
    )
    found = elevation_of(floor_points(8.0), wall)
    ground = ground_in_sectors(found, Pose2(0.0, 0.0, math.radians(-22.5)), edges(8), reach_m=3.0)
    ahead = int(np.searchsorted(edges(8), math.radians(22.5)) - 1)  # the wedge along the map's x axis
    assert ground.stopped_by[ahead] == Ground.STEP
    assert 1.2 < ground.traversable_m[ahead] <= 1.5
    behind = (ahead + 4) % 8
    assert ground.stopped_by[behind] == Ground.TRAVERSABLE
    assert ground.traversable_m[behind] == 3.0
    assert ground.slope_rad[behind] == pytest.approx(0.0, abs=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_driven_way_in_a_sector_meets_what_is_not_traversable(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cloud = floor_points(3.0, per_cell=4, seed=seed)
    hole = rng.normal(0.0, 1.0, 2)
    cloud = cloud[np.hypot(*(cloud[:, :2] - hole).T) > 0.3]
    found = elevation_of(cloud)
    pose = Pose2(float(rng.normal(0.0, 0.4)), float(rng.normal(0.0, 0.4)), float(rng.uniform(-3.0, 3.0)))
    bounds = np.sort(rng.uniform(-3.1, 3.1, 4))
    ground = ground_in_sectors(found, pose, bounds, reach_m=2.5)
    for k in range(3):
        bearing = rng.uniform(bounds[k], bounds[k + 1], 20) + pose.yaw_rad
        length = rng.uniform(0.0, 1.0, 20) * (ground.traversable_m[k] - 1e-6)
        for b, r in zip(bearing, length):
            if r > 0.0:
                x, y = pose.x_m + r * math.cos(b), pose.y_m + r * math.sin(b)
                row, col = math.floor(y / D) - found.row0, math.floor(x / D) - found.col0
                assert 0 <= row < found.ground.shape[0]
                assert 0 <= col < found.ground.shape[1]
                assert found.ground[row, col] == Ground.TRAVERSABLE


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_sector_ends_at_the_first_cell_that_is_not_traversable(seed: int) -> None:
    """Which cells' circles meet a wedge, and how near they come, by shapely; a millionth of a metre may be either."""
    rng = np.random.default_rng(seed)
    cloud = floor_points(3.0, per_cell=4, seed=seed)
    for hole in rng.normal(0.0, 1.0, (2, 2)):
        cloud = cloud[np.hypot(*(cloud[:, :2] - hole).T) > 0.25]
    high = rng.random((60, 60)) < 0.01
    cell = np.floor(cloud[:, :2] / D + 1e-9).astype(int)
    cloud[high[cell[:, 0], cell[:, 1]], 2] = 0.5
    found = elevation_of(cloud)
    pose = Pose2(float(rng.normal(0.0, 0.4)), float(rng.normal(0.0, 0.4)), float(rng.uniform(-3.0, 3.0)))
    bounds = np.cumsum(rng.uniform(0.2, 1.5, 5)) - 3.0
    reach_m, radius = 1.8, D * math.sqrt(0.5)
    ground = ground_in_sectors(found, pose, bounds, reach_m=reach_m)
    rows, cols = np.mgrid[-40:40, -40:40].reshape(2, -1)
    r, c = rows - found.row0, cols - found.col0
    known = (r >= 0) & (r < found.ground.shape[0]) & (c >= 0) & (c < found.ground.shape[1])
    kind = np.full(len(rows), int(Ground.UNKNOWN))
    kind[known] = found.ground[r[known], c[known]]
    middle = np.stack(((cols + 0.5) * D, (rows + 0.5) * D), axis=-1)
    nearest = np.maximum(np.hypot(*(middle - [pose.x_m, pose.y_m]).T) - radius, 0.0)
    for k in range(4):
        bearing = pose.yaw_rad + np.array([bounds[k], (bounds[k] + bounds[k + 1]) / 2.0, bounds[k + 1]])
        far = np.stack((pose.x_m + 99.0 * np.cos(bearing), pose.y_m + 99.0 * np.sin(bearing)), axis=-1)
        away = shapely.distance(shapely.Polygon([(pose.x_m, pose.y_m), *far]), shapely.points(middle))
        stops = kind != Ground.TRAVERSABLE
        latest = nearest[stops & (away < radius - 1e-6)].min(initial=reach_m)
        earliest = nearest[stops & (away < radius + 1e-6)].min(initial=reach_m)
        assert earliest - 1e-6 <= ground.traversable_m[k] <= latest + 1e-6
        if earliest < reach_m - 1e-6:
            at = stops & (away < radius + 1e-6) & (np.abs(nearest - ground.traversable_m[k]) < 1e-6)
            assert ground.stopped_by[k] in kind[at]
        else:
            assert ground.stopped_by[k] == Ground.TRAVERSABLE or latest < reach_m + 1e-6


def test_an_unknown_ground_stops_at_once_and_bad_sectors_are_refused() -> None:
    nothing = ElevationMap(resolution_m=D).elevation()
    ground = ground_in_sectors(nothing, Pose2(5.0, 5.0, 0.0), edges(4), reach_m=2.0)
    assert ground.traversable_m.tolist() == [0.0] * 4
    assert ground.stopped_by.tolist() == [Ground.UNKNOWN] * 4
    blind = ground_in_sectors(elevation_of(floor_points(4.0)), Pose2(), edges(4), reach_m=1.5, blind_m=0.3)
    assert blind.traversable_m.tolist() == [1.5] * 4
    for bad, reach_m in ((edges(4)[::-1], 1.0), (np.zeros(1), 1.0), (edges(4), math.nan), (edges(4), 0.0)):
        with pytest.raises(ValueError):
            ground_in_sectors(nothing, Pose2(), bad, reach_m=reach_m)
