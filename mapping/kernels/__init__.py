"""Compiled loops. None of them multiplies matrices or solves systems by numba's own means (`@`, np.dot, np.linalg).

For those numba loads scipy's linear algebra with the first kernel of a process, used or not: 13 MB and a tenth of a
second or more. Here it is made to believe that there is none, so that such a kernel is refused when it is compiled.
"""

from __future__ import annotations

import importlib
import sys

_BLAS = "scipy.linalg.cython_blas"
_ASKS_FOR_IT = "numba.np.arraymath"


def _load_without_blas() -> None:
    """Import the module of numba that looks for linear algebra while there is none to find; once it is there, nothing
    more is asked."""
    if _ASKS_FOR_IT in sys.modules or _BLAS in sys.modules:
        return
    sys.modules[_BLAS] = None  # type: ignore[assignment]  # as the import system has it: to import this fails
    try:
        importlib.import_module(_ASKS_FOR_IT)
    finally:
        del sys.modules[_BLAS]


_load_without_blas()
