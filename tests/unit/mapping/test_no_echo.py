"""How far silence is free: up to the line between two echoes, nowhere beside what was not measured, wide silence."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from mapping.no_echo import OPEN_M, WIDE_M, reach_without_echo

F64 = NDArray[np.float64]
HALF: F64 = np.radians(np.arange(-90.0, 91.0))
THREE_QUARTERS: F64 = np.radians(np.arange(-135.0, 136.0))
TURN: F64 = np.radians(np.arange(0.0, 360.0))
MAX_M = 30.0
RANGES = st.sampled_from([math.inf, math.inf, math.inf, math.nan, -math.inf, 0.0, -1.0, 0.4, 1.0, 3.0, 9.0, 31.0])


def slow(ranges: F64, step_rad: float, *, is_turn: bool) -> F64:
    """Beam by beam, with points in the plane."""
    n, reach = len(ranges), ranges.copy()

    def ways(k: int, way: int) -> tuple[int, float | None]:
        """Silent beams on to one side, and the range of the echo that ends them."""
        for step in range(1, n + 1):
            j = k + way * step
            if not is_turn and not 0 <= j < n:
                return step - 1, None
            if ranges[j % n] != math.inf:
                return step - 1, float(ranges[j % n]) if 0.0 < ranges[j % n] <= MAX_M else None
        return n, None

    for k in np.flatnonzero(np.isposinf(ranges)):
        (left, a), (right, b) = ways(int(k), -1), ways(int(k), 1)
        span = step_rad * min(left + right, n)
        far = OPEN_M if span > math.pi - 1e-6 else WIDE_M if span >= 2.0 * math.pi / 3.0 else 0.0
        if a is not None and b is not None and (left + right + 2) * step_rad < math.pi - 1e-9:
            p = a * np.exp(-1j * (left + 1) * step_rad)
            q = b * np.exp(1j * (right + 1) * step_rad)
            share = -p.imag / (q.imag - p.imag)  # where the line from p to q meets the beam, the real axis
            far = max(far, float((p + share * (q - p)).real))
        reach[k] = min(far, MAX_M)
    return reach


@given(arrays(np.float64, st.integers(4, 40), elements=RANGES), st.booleans(), st.booleans())
def test_it_is_the_slow_rule(ranges: F64, is_turn: bool, is_clockwise: bool) -> None:
    n = len(ranges)
    step_rad = 2.0 * math.pi / n if is_turn else 0.11
    if step_rad > 0.19:  # separate sensors
        return
    bearing: F64 = np.arange(n, dtype=np.float64) * step_rad
    reach = reach_without_echo(-bearing if is_clockwise else bearing, ranges, MAX_M)
    np.testing.assert_allclose(reach, slow(ranges, step_rad, is_turn=is_turn), rtol=1e-9)


@pytest.mark.parametrize("bearing", [HALF, HALF[::-1].copy()])
def test_a_hole_in_a_wall_is_free_up_to_the_wall(bearing: F64) -> None:
    wall = np.minimum(3.0 / np.maximum(np.cos(bearing), 0.15), 20.0)
    ranges = wall.copy()
    ranges[80:106] = math.inf  # 1.4 m
    reach = reach_without_echo(bearing, ranges, 60.0)
    np.testing.assert_allclose(reach, wall, rtol=1e-9)


def test_what_stands_before_a_corner_frees_nothing_behind_it() -> None:
    """Walls ahead and to the left; a cabinet hides their corner."""
    bearing = np.radians(np.arange(-30.0, 121.0))
    wall = np.minimum(4.0 / np.maximum(np.cos(bearing), 1e-9), 3.0 / np.maximum(np.sin(bearing), 1e-9))
    ranges = np.where((bearing > 0.5) & (bearing < 0.8), math.inf, wall)
    reach = reach_without_echo(bearing, ranges, 60.0)
    assert np.isposinf(ranges).sum() > 10
    assert np.all(reach <= wall + 1e-9)


def test_silence_at_the_end_of_the_view_and_beside_what_was_not_measured_frees_nothing() -> None:
    ranges = np.full(181, 2.0)
    ranges[:20] = ranges[100:120] = math.inf
    ranges[120] = math.nan
    reach = reach_without_echo(HALF, ranges, 60.0)
    assert (reach[:20] == 0.0).all()
    assert (reach[100:120] == 0.0).all()
    gone = np.delete(np.arange(181), np.arange(115, 121))  # missing beams, not silent ones
    assert (reach_without_echo(HALF[gone], ranges[gone], 60.0)[100:115] == 0.0).all()


def test_no_straight_surface_opens_the_view() -> None:
    """A black wall along one side, however near and long."""
    for away_m in (0.05, 0.5, 2.0):
        silent = np.abs(TURN - math.pi / 2) < math.pi / 2 - math.atan2(away_m, 8.0)
        reach = reach_without_echo(TURN, np.where(silent, math.inf, 8.0), 60.0)
        assert silent.sum() > 140
        assert (reach[silent] <= np.maximum(WIDE_M, (away_m + 0.2) / np.sin(TURN[silent]))).all()


def test_wide_silence_is_believed() -> None:
    nothing = np.full(271, math.inf)
    assert (reach_without_echo(THREE_QUARTERS, nothing, 60.0) == OPEN_M).all()
    assert (reach_without_echo(HALF, nothing[:181], 60.0) == OPEN_M).all()
    assert (reach_without_echo(TURN, np.full(360, math.inf), 5.6) == 5.6).all()
    wall = nothing.copy()  # along a wall to the right
    wall[:110] = 1.0
    assert (reach_without_echo(THREE_QUARTERS, wall, 60.0)[110:] == WIDE_M).all()
    post = np.full(360, math.inf)
    post[10] = 1.0
    assert (reach_without_echo(TURN, post, 60.0)[11:] == OPEN_M).all()


def test_nothing_silent_and_other_shapes() -> None:
    ranges = np.array([1.0, math.nan, -math.inf])
    assert reach_without_echo(HALF[:3], ranges, 60.0) is ranges
    assert reach_without_echo(HALF[:1], np.array([math.inf]), 60.0).tolist() == [0.0]
    with pytest.raises(ValueError, match="alike"):
        reach_without_echo(HALF, ranges, 60.0)
