"""Once localisation is warm, a first closure loads nothing: an import in the middle of a drive holds all threads up."""

from __future__ import annotations

import subprocess
import sys

_FIRST_CLOSURE = """
import sys
import numpy as np
from mapping.localise.pose_graph import Edges, Uncertainty, covariance_of, optimise
from mapping.localise.warm_up import warm_up
warm_up()
before = set(sys.modules)
count = 30
start = np.append(np.arange(count - 1), count - 1)
to = np.append(np.arange(1, count), 0)
turn = 2.0 * np.pi / count
measured = np.tile([1.0, 0.0, turn], (count, 1))
edges = Edges(start, to, measured, np.array([np.eye(3) * 100.0] * count), start == count - 1)
solved = optimise(np.zeros((count, 3)), edges)
assert np.isfinite(solved.poses).all()
assert covariance_of(solved.poses, edges, solved.weight, 7).shape == (3, 3)
Uncertainty(solved.poses, edges, solved.weight, held_m=0.1).of_relative(3, 20)
print(sorted(name for name in set(sys.modules) - before))
"""


def test_the_first_closure_loads_nothing() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", _FIRST_CLOSURE], capture_output=True, text=True, timeout=200, check=True
    )
    assert ran.stdout.strip() == "[]"
