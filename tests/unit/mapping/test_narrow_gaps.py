"""Nothing seen between surfaces close together frees nothing; doors and open space stay open (S28)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from mapping.narrow_gaps import NARROW_M, without_narrow_gaps

F64 = NDArray[np.float64]
HALF: F64 = np.radians(np.arange(-90.0, 91.0))
TURN: F64 = np.radians(np.arange(0.0, 360.0))
RANGES = st.sampled_from([math.inf, math.inf, math.nan, -math.inf, 0.4, 1.0, 3.0, 9.0])


def slow(bearing: F64, ranges: F64, *, is_turn: bool) -> F64:
    """Beam by beam, with points in the plane."""
    n, kept = len(ranges), ranges.copy()
    points = [(r * math.cos(b), r * math.sin(b)) if 0.0 < r < math.inf else None for b, r in zip(bearing, ranges)]

    def end(k: int, way: int) -> tuple[float, float] | None:
        for step in range(1, n):
            j = k + way * step
            if not is_turn and not 0 <= j < n:
                return None
            j %= n
            if points[j] is not None or ranges[j] <= 0.0:
                return points[j]
        return None

    for k in range(n):
        left, right = end(k, 1), end(k, -1)
        if ranges[k] == math.inf and left is not None and right is not None and math.dist(left, right) < NARROW_M:
            kept[k] = math.nan
    return kept


@given(arrays(np.float64, st.integers(0, 24), elements=RANGES), st.booleans(), st.booleans())
def test_it_is_the_slow_rule(ranges: F64, is_turn: bool, is_clockwise: bool) -> None:
    n = len(ranges)
    if is_turn and n < 4:
        return
    bearing: F64 = np.arange(n, dtype=np.float64) * (2.0 * math.pi / n if is_turn else 0.1)
    bearing = -bearing if is_clockwise else bearing
    kept, dropped = without_narrow_gaps(bearing, ranges)
    expected = slow(bearing, ranges, is_turn=is_turn)
    if is_turn and np.isfinite(ranges[ranges > 0.0]).sum() == 1:  # from a single end round to itself
        return
    np.testing.assert_array_equal(kept, expected)
    assert dropped == np.isposinf(ranges).sum() - np.isposinf(expected).sum()


@pytest.mark.parametrize("bearing", [HALF, HALF[::-1].copy()])
def test_a_dark_edge_frees_nothing_and_a_door_stays_open(bearing: F64) -> None:
    ranges = np.full(len(bearing), 3.0)
    ranges[40:45] = math.inf  # 0.3 m of the wall
    ranges[100:125] = math.inf  # 1.3 m
    ranges[42] = math.nan
    kept, dropped = without_narrow_gaps(bearing, ranges)
    assert dropped == 4
    assert np.isnan(kept[40:45]).all()
    assert np.isposinf(kept[100:125]).all()


def test_open_at_the_end_of_the_field_of_view_and_round_a_whole_turn() -> None:
    ranges = np.full(181, 1.0)
    ranges[:3] = ranges[-3:] = math.inf
    assert without_narrow_gaps(HALF, ranges)[1] == 0
    turn = np.full(360, 1.0)
    turn[:3] = turn[-3:] = math.inf
    assert without_narrow_gaps(TURN, turn)[1] == 6


def test_nothing_but_nothing_stays() -> None:
    ranges = np.full(360, math.inf)
    assert without_narrow_gaps(TURN, ranges)[1] == 0
    with pytest.raises(ValueError, match="alike"):
        without_narrow_gaps(TURN, ranges[1:])
