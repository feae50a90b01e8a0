"""Factors of sparse symmetric matrices by SuperLU as scipy has it, without all that scipy loads with it.

`scipy.sparse.linalg` loads eigenvalues, matrix functions and dense linear algebra, too: 10 MB for a daemon that wants
one function. The extension with that function is loaded by itself, and called as `scipy.sparse.linalg.splu` calls it;
where that fails (another scipy), splu itself is called. The factors are the same to the last bit.
"""

from __future__ import annotations

import importlib.util
import sys
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_FULL_NAME = "scipy.sparse.linalg._dsolve._superlu"
_ORDER = "MMD_AT_PLUS_A"


def symmetric_factor(values: F64, rows: I64, columns: I64, size: int) -> Any:
    """Factor of the matrix (size, size) with these entries (N,), those of one place added; `solve(right)` solves.

    RuntimeError if it is singular.
    """
    from scipy.sparse import csc_matrix

    matrix = csc_matrix((values, (rows, columns)), shape=(size, size))
    superlu = _superlu()
    if superlu is not None and matrix.indices.dtype == np.intc and matrix.indptr.dtype == np.intc:
        matrix.sum_duplicates()
        options = {
            "DiagPivotThresh": 0.0, "ColPerm": _ORDER, "PanelSize": None, "Relax": None, "SymmetricMode": True,
        }  # fmt: skip
        try:
            return superlu.gstrf(
                size, matrix.nnz, matrix.data, matrix.indices, matrix.indptr,
                csc_construct_func=None, ilu=False, options=options,
            )  # fmt: skip
        except (TypeError, ValueError):  # it takes something else nowadays
            pass
    from scipy.sparse.linalg import splu

    return splu(matrix, permc_spec=_ORDER, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


@cache
def _superlu() -> Any:
    """The extension; None where it is not found as it is known here."""
    import scipy

    known = sys.modules.get(_FULL_NAME)
    if known is not None:
        return known
    folder = Path(scipy.__file__).parent / "sparse" / "linalg" / "_dsolve"
    path = next((p for suffix in EXTENSION_SUFFIXES if (p := folder / f"_superlu{suffix}").exists()), None)
    if path is None:
        return None
    try:
        loader = ExtensionFileLoader("_superlu", str(path))
        spec = importlib.util.spec_from_loader("_superlu", loader)
        assert spec is not None
        module = importlib.util.module_from_spec(spec)
        loader.exec_module(module)
    except ImportError:
        return None
    return module if hasattr(module, "gstrf") else None
