"""Mixed pixels go, walls and posts stay (S28)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.mixed_pixels import GRAZING_RAD, OFF_M, STEP_M, WIDEST_RAD, without_mixed_pixels

F64 = NDArray[np.float64]

BEARING: F64 = np.radians(0.5 * np.arange(-30, 31, dtype=np.float64))
FAR_M, NEAR_M = 4.0, 2.0


def edge() -> F64:
    """A box's flat front up to bearing 0, then the flat wall behind it."""
    return np.where(BEARING <= 0.0, NEAR_M, FAR_M) / np.cos(BEARING)


def slow(bearing: F64, ranges: F64) -> F64:
    """The rule word by word, with points in the plane and neighbours on the circle by index."""
    there = np.where(np.isfinite(ranges), ranges, 0.0)
    points = np.stack((there * np.cos(bearing), there * np.sin(bearing)), axis=-1)
    kept, n = ranges.copy(), len(ranges)

    def good(k: int) -> bool:
        return bool(math.isfinite(ranges[k % n]) and ranges[k % n] > 0.0)

    def turn(k: int, j: int) -> float:
        return abs(math.remainder(bearing[k % n] - bearing[j % n], 2.0 * math.pi))

    def flat(k: int, j: int) -> bool:
        """Whether the chord runs along the beam. The chord's end that is nearer is the corner of a right triangle."""
        low, step = min(ranges[k % n], ranges[j % n]), abs(ranges[k % n] - ranges[j % n])
        return math.atan2(low * turn(k, j), step) <= GRAZING_RAD

    def in_line(k: int, j: int, i: int) -> bool:
        if not good(i) or turn(j, i) == 0.0:
            return False
        a, b = points[j % n], points[i % n]
        ray = np.array([math.cos(bearing[k % n]), math.sin(bearing[k % n])])
        along = b - a
        across = ray[0] * along[1] - ray[1] * along[0]
        if abs(across) < 1e-12:
            return False
        meets = (a[0] * along[1] - a[1] * along[0]) / across
        r, near, second = ranges[k % n], ranges[j % n], ranges[i % n]
        off = min(OFF_M * (1.0 + 2.0 * (r / near) ** 2 + (r / second) ** 2), abs(r - near) / 2.0)
        return bool(meets > 0.0 and abs(meets - r) <= off)

    for k in range(n):
        if not (good(k) and good(k - 1) and good(k + 1)):
            continue
        up, down = ranges[(k + 1) % n] - ranges[k], ranges[k] - ranges[k - 1]
        turns = sorted((turn(k, k - 1), turn(k, k + 1)))
        if not (min(up, down) > STEP_M or max(up, down) < -STEP_M):
            continue
        if turns[0] == 0.0 or turns[1] > WIDEST_RAD or turns[1] > 1.5 * turns[0]:
            continue
        if flat(k, k - 1) and flat(k, k + 1) and not in_line(k, k - 1, k - 2) and not in_line(k, k + 1, k + 2):
            kept[k] = np.nan
    return kept


def test_a_mixed_pixel_draws_no_obstacle_and_frees_nothing() -> None:
    at = int(np.flatnonzero(BEARING > 0.0)[0])
    for share in (0.2, 0.5, 0.8):
        ranges = edge()
        ranges[at] = ranges[at - 1] + share * (FAR_M - NEAR_M)
        kept, dropped = without_mixed_pixels(BEARING, ranges)
        assert dropped == 1
        assert np.flatnonzero(np.isnan(kept)).tolist() == [at]
        grid, blind = OccupancyGrid(), OccupancyGrid()
        gone = ranges.copy()
        gone[at] = np.nan
        grid.insert_scan(Pose2(0.01, 0.01), BEARING, kept, range_max_m=10.0)
        blind.insert_scan(Pose2(0.01, 0.01), BEARING, gone, range_max_m=10.0)
        assert np.array_equal(grid.patch().cells, blind.patch().cells)
        place = [(0.01 + ranges[at] * math.cos(BEARING[at]), 0.01 + ranges[at] * math.sin(BEARING[at]))]
        assert not grid.probability_at(place)[0] >= 0.65  # NaN, unknown, is fine


def test_the_edge_itself_and_what_is_behind_stay() -> None:
    for ranges in (edge(), edge()[::-1].copy(), np.full(BEARING.size, np.inf), np.full(BEARING.size, np.nan)):
        kept, dropped = without_mixed_pixels(BEARING, ranges)
        assert dropped == 0
        assert np.array_equal(kept, ranges, equal_nan=True)


def test_walls_seen_flat_stay() -> None:
    """Down a corridor: neighbouring beams are metres apart, all on one line."""
    random = np.random.default_rng(3)
    for wall_m, spacing in ((0.6, 0.25), (1.2, 0.25), (1.0, 0.5), (1.2, 1.0)):
        bearing = np.radians(np.arange(1.0, 90.0, spacing))
        ranges = wall_m / np.sin(bearing)
        ranges[ranges > 30.0] = np.inf
        noisy = ranges + random.normal(0.0, 0.01, bearing.size)
        assert without_mixed_pixels(bearing, ranges)[1] == 0
        assert without_mixed_pixels(bearing, noisy)[1] == 0
        assert without_mixed_pixels(bearing[::-1], noisy[::-1])[1] == 0


def test_a_post_before_a_wall_stays() -> None:
    ranges = np.full(BEARING.size, FAR_M) / np.cos(BEARING)
    ranges[20] = 2.0
    assert without_mixed_pixels(BEARING, ranges)[1] == 0


def test_a_mixed_pixel_at_the_seam_of_a_full_turn() -> None:
    bearing = np.radians(np.arange(0.0, 360.0, 0.5))
    for shift in (0, 1, 2, 5):  # the edge lies at index 0 of the turn, or near it
        ranges = np.roll(np.where(np.arange(720) < 360, NEAR_M, FAR_M), shift)
        ranges[shift] = 3.0
        kept, dropped = without_mixed_pixels(bearing, ranges)
        assert dropped == 1
        assert math.isnan(kept[shift])


def test_as_the_slow_version_has_it() -> None:
    random = np.random.default_rng(11)
    seen = 0
    for _ in range(120):
        count = int(random.integers(1, 80))
        bearing = np.cumsum(random.choice([0.004, 0.004, 0.004, 0.009, 0.06, 0.0], count))
        ranges = np.repeat(random.uniform(0.5, 8.0, count), random.integers(1, 4, count))[:count]
        ranges = ranges + random.normal(0.0, 0.01, count)
        odd = random.random(count)
        ranges[odd < 0.02], ranges[odd > 0.98], ranges[(odd > 0.5) & (odd < 0.52)] = np.nan, np.inf, -np.inf
        kept, dropped = without_mixed_pixels(bearing, ranges)
        if count >= 5:
            assert np.array_equal(kept, slow(bearing, ranges), equal_nan=True)
        else:
            assert dropped == 0
        seen += dropped
    assert seen > 30


def test_shapes_are_checked() -> None:
    for bearing, ranges in ((np.zeros(3), np.zeros(4)), (np.zeros((2, 2)), np.zeros((2, 2)))):
        with pytest.raises(ValueError, match="alike"):
            without_mixed_pixels(bearing, ranges)
    assert without_mixed_pixels(np.zeros(0), np.zeros(0))[1] == 0
