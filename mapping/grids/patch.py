"""A rectangle of grid cells as it leaves the mapping package."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class GridPatch:
    """cells: (R, C) int8, -1 unknown, 0 to 100 per cent occupied; row with +y, column with +x.

    Cell (row, col) of the map covers x in [col, col + 1) * resolution_m, y alike; cells[0, 0] is (row0, col0).
    """

    resolution_m: float
    row0: int
    col0: int
    cells: NDArray[np.int8]
