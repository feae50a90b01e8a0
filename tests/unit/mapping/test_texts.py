"""Compiled digits are those of printf."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mapping.kernels.texts import LONGEST, write_number


def written(value: float, digits: int) -> str | None:
    out = np.zeros(LONGEST, dtype=np.uint8)
    end = write_number(out, 0, value, digits)
    return None if end < 0 else out[:end].tobytes().decode()


@given(st.floats(-1e9, 1e9), st.sampled_from([3, 4, 5]))
@example(0.00005, 4)
@example(-0.0, 4)
@example(-0.00004, 4)
@example(0.99995, 4)
@example(9.99999999999, 4)
@example(2.675, 3)
@example(12.1705, 3)
@settings(max_examples=1000, deadline=None)
def test_digits_are_those_of_printf(value: float, digits: int) -> None:
    assert written(value, digits) == f"{value:.{digits}f}"


@given(st.integers(-(10**9), 10**9), st.integers(0, 12))
@settings(max_examples=500, deadline=None)
def test_exact_halves_go_to_even(count: int, power: int) -> None:
    """Sums of powers of two, which end in a five exactly where digits are cut."""
    value = count / 2**power
    assert written(value, 3) == f"{value:.3f}"


@given(st.integers(-(10**8), 10**8), st.sampled_from([-1, 0, 1]))
@settings(max_examples=500, deadline=None)
def test_neighbours_of_halves(count: int, step: int) -> None:
    """The doubles around each decimal half, which a product alone rounds to the wrong side."""
    value = float(np.nextafter((count + 0.5) / 1e4, np.inf * step)) if step else (count + 0.5) / 1e4
    assert written(value, 4) == f"{value:.4f}"


@pytest.mark.parametrize("value", [1e12, -1e12, 1e300])
def test_what_is_too_large_is_told(value: float) -> None:
    assert written(value, 4) is None
