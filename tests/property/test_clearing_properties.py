"""What takes evidence away frees no cell by itself: the filters of mixed pixels and of the robot's body, forgetting."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.mixed_pixels import without_mixed_pixels
from mapping.sectors.footprint import checked_polygon, in_polygon
from mapping.sectors.inputs import without_self

F64 = NDArray[np.float64]

D = 0.05
BEARING = np.radians(np.arange(0.0, 360.0, 1.0))
BODY = checked_polygon([[0.3, 0.2], [-0.3, 0.2], [-0.3, -0.2], [0.3, -0.2]])
ODD = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, 0.15, 1.0, 2.5, 4.9])
SWEEPS = st.tuples(st.integers(0, 2**32 - 1), st.lists(st.tuples(st.integers(0, 359), ODD), max_size=20))
POSES = st.builds(Pose2, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3.2, 3.2))
SLOW = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def ranges_of(sweep: tuple[int, list[tuple[int, float]]]) -> F64:
    """Things at all distances, with edges between them, some of these mixed, and some readings of any kind."""
    random = np.random.default_rng(sweep[0])
    ranges = np.repeat(random.uniform(0.3, 5.0, 60), 6)
    mixed = np.arange(6, 360, 6)[random.random(59) < 0.5]
    ranges[mixed] += random.random(len(mixed)) * (ranges[mixed - 1] - ranges[mixed])
    for at, value in sweep[1]:
        ranges[at] = value
    return ranges


def drawn(pose: Pose2, ranges: F64, model: Literal["counters", "log-odds"] = "counters") -> OccupancyGrid:
    grid = OccupancyGrid(resolution_m=D, model=model)
    grid.insert_scan(pose, BEARING, ranges, range_max_m=5.0, range_min_m=0.1)
    return grid


def centres_of(grid: OccupancyGrid) -> F64:
    patch = grid.patch()
    rows, cols = np.nonzero(patch.cells >= 0)
    return np.stack(((cols + patch.col0 + 0.5) * D, (rows + patch.row0 + 0.5) * D), axis=-1)


@SLOW
@given(POSES, SWEEPS)
def test_filtered_beams_are_as_if_they_were_missing(pose: Pose2, sweep: tuple[int, list[tuple[int, float]]]) -> None:
    ranges = ranges_of(sweep)
    mixed, _ = without_mixed_pixels(BEARING, ranges)
    kept = without_self(BEARING, mixed, Pose2(), BODY, too_close_m=0.1)
    assert np.all(np.isnan(kept) | (kept == ranges))
    whole, filtered = drawn(pose, ranges), drawn(pose, kept)
    points = centres_of(filtered)
    hits, misses = whole.counts_at(points)
    hits_kept, misses_kept = filtered.counts_at(points)
    assert np.all(hits_kept <= hits)
    freer = (misses_kept > misses) & (hits <= hits_kept)  # elsewhere a false hit was in the way of others
    assert passed_by_a_beam(points[freer], pose, kept).all()


def passed_by_a_beam(points: F64, pose: Pose2, ranges: F64) -> NDArray[np.bool_]:
    """Which cells lie on a beam of their own, before its end: one whose neighbour is missing frees its whole line."""
    ends_m = np.where(np.isposinf(ranges), 5.0, np.where(np.isfinite(ranges), ranges, 0.0))
    local = pose.inverse().apply(points) if len(points) else points
    along = local[:, :1] * np.cos(BEARING) + local[:, 1:] * np.sin(BEARING)
    across = local[:, 1:] * np.cos(BEARING) - local[:, :1] * np.sin(BEARING)
    half = D * math.sqrt(0.5) + 1e-9
    on_beam = (np.abs(across) <= half) & (along >= -half) & (along <= ends_m + half)
    return np.asarray(np.any(on_beam, axis=1))


@SLOW
@given(SWEEPS)
def test_what_ends_on_the_robot_draws_nothing_there(sweep: tuple[int, list[tuple[int, float]]]) -> None:
    ranges = np.minimum(ranges_of(sweep), 0.5)
    kept = without_self(BEARING, ranges, Pose2(0.05, 0.0, 0.3), BODY, too_close_m=0.1)
    ends_m = np.where(np.isneginf(kept), 0.1, kept)
    there = np.isfinite(ends_m) & (ends_m >= 0.0)
    points = np.stack((ends_m * np.cos(BEARING), ends_m * np.sin(BEARING)), axis=-1)[there]
    assert not in_polygon(Pose2(0.05, 0.0, 0.3).apply(points), BODY).any()


@SLOW
@given(st.lists(SWEEPS, min_size=1, max_size=6), st.sampled_from(["counters", "log-odds"]), st.integers(1, 4))
def test_forgetting_makes_nothing_freer(
    sweeps: list[tuple[int, list[tuple[int, float]]]], model: Literal["counters", "log-odds"], times: int
) -> None:
    grid = OccupancyGrid(resolution_m=D, model=model)
    for sweep in sweeps:
        grid.insert_scan(Pose2(0.01, 0.02), BEARING, ranges_of(sweep), range_max_m=5.0)
    points = centres_of(grid)
    before, state = grid.probability_at(points), grid.state_at(points)
    for _ in range(times):
        grid.decay()
        after = grid.probability_at(points)
        known = ~np.isnan(after)
        if model == "counters":
            assert np.all(after[known] >= before[known] - 1e-12)
        else:  # what is believed to be an obstacle fades to undecided, never beyond
            assert np.all((after[known] >= before[known] - 1e-12) | (after[known] >= 0.5 - 1e-12))
        freer = (grid.state_at(points) == 0) & (state != 0)
        assert not freer.any()
