"""Load or compile every kernel of rooms and plans before a device is opened: a first call takes up to some seconds."""

from __future__ import annotations

import numpy as np

from mapping.hybrid.planner import Planner
from mapping.hybrid.rooms import find_rooms
from mapping.hybrid.voronoi import VoronoiGrid

_CELL_M = 0.1


def warm_up() -> None:
    """Use a small plan of two rooms that is thrown away."""
    free = np.zeros((60, 130), dtype=np.bool_)
    free[2:58, 2:64] = free[2:58, 66:128] = free[25:35, 60:70] = True
    find_rooms(free, _CELL_M)
    grid = VoronoiGrid(free)
    grid.set_cells([[30, 20]], [[2, 65]])
    planner = Planner(grid, _CELL_M)
    planner.plan((1.0, 1.0), (12.0, 5.0))
    planner.plan((1.0, 1.0), (7.0, 3.0))
