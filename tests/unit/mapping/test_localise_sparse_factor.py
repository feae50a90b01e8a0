"""Sparse factors without scipy.sparse.linalg: the same to the last bit, and splu where they cannot be had."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from mapping.localise import sparse_factor
from mapping.localise.sparse_factor import symmetric_factor

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def entries(size: int) -> tuple[F64, I64, I64]:
    """Of a symmetric matrix that can be factored; some places come twice."""
    rng = np.random.default_rng(size)
    a, b, v = rng.integers(0, size, 8 * size), rng.integers(0, size, 8 * size), rng.normal(size=8 * size)
    middle = np.arange(size)
    values = np.concatenate((v, v, np.full(size, 100.0)))
    return values, np.concatenate((a, b, middle)), np.concatenate((b, a, middle))


@pytest.mark.parametrize("is_found", [True, False])
def test_factors_are_those_of_scipy(is_found: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not is_found:
        monkeypatch.setattr(sparse_factor, "_superlu", lambda: None)
    values, rows, columns = entries(300)
    right = np.random.default_rng(1).normal(size=(300, 2))
    matrix = csc_matrix((values, (rows, columns)), shape=(300, 300))
    wanted = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    np.testing.assert_array_equal(symmetric_factor(values, rows, columns, 300).solve(right), wanted.solve(right))


def test_a_singular_matrix_is_an_error() -> None:
    with pytest.raises(RuntimeError, match="singular"):
        symmetric_factor(np.array([1.0, 0.0]), np.array([0, 1]), np.array([0, 1]), 2)


def test_it_is_found_in_this_scipy_and_loads_no_more_than_itself() -> None:
    script = """
import sys
import numpy as np
from mapping.localise.sparse_factor import symmetric_factor, _superlu
factor = symmetric_factor(np.array([2.0, 4.0]), np.array([0, 1]), np.array([0, 1]), 2)
assert factor.solve(np.array([2.0, 2.0])).tolist() == [1.0, 0.5]
print(_superlu() is not None, "scipy.linalg" in sys.modules)
import scipy.sparse.linalg  # afterwards, by somebody else
a = scipy.sparse.csc_matrix(np.eye(2) * 2.0)
assert scipy.sparse.linalg.splu(a).solve(np.ones(2)).tolist() == [0.5, 0.5]
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=True)
    assert ran.stdout.split() == ["True", "False"]
