"""Loading kernels brings nothing along that they do not need."""

from __future__ import annotations

import subprocess
import sys

_LOAD = """
import sys
import numpy as np
from mapping.kernels.sectors import inside_polygon
here = np.array([0.5, 3.0])
assert inside_polygon(here, here, np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])).tolist() == [True, False]
assert "numba.np.arraymath" in sys.modules
print(sorted(name for name in sys.modules if name.startswith(("scipy.linalg", "scipy.sparse"))))
from scipy.linalg.cython_blas import __name__ as name  # who wants it still gets it
from scipy.linalg import inv
assert np.allclose(inv(np.diag([2.0, 4.0])), np.diag([0.5, 0.25]))
"""


def test_no_linear_algebra_is_loaded_with_a_kernel() -> None:
    ran = subprocess.run([sys.executable, "-c", _LOAD], capture_output=True, text=True, timeout=120, check=True)
    assert ran.stdout.strip() == "[]"


def test_kernels_also_load_where_linear_algebra_is_loaded_already() -> None:
    first = "import scipy.linalg.cython_blas\n" + _LOAD.replace("print(sorted", "str(sorted")
    subprocess.run([sys.executable, "-c", first], capture_output=True, text=True, timeout=120, check=True)
