"""What the live map calls free is free: nobody may drive into a wall because of it.

Truth: the space that is reached from the robot's start without passing a surface of the world. What is called free
elsewhere is false: inside walls and furniture, or outside, where a sweep was drawn at a wrong pose or went through what
does not answer.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from mapping.grids.patch import GridPatch
from tests.world.test_live_slam_worlds import HEIGHT_M, Drive, drive, driven

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

FREE_BELOW = 35  # of 100: what a planner of ROS takes as free
RASTER_M = 0.02
WALL_M = 0.05  # half of a cell that a surface crosses is free, and a surface is drawn a centimetre off
DEEP_M = 0.11  # two cells
STOPPING_M = 0.5


def false_free(driving: Drive, patch: GridPatch) -> tuple[F64, F64, int]:
    """(N, 2) middles of cells that are called free wrongly, (N,) how far they are from where they might be free, and
    how many cells are called free."""
    rows, cols = np.nonzero((patch.cells >= 0) & (patch.cells < FREE_BELOW))
    free = np.asarray((np.stack((cols + patch.col0, rows + patch.row0), axis=-1) + 0.5) * patch.resolution_m)
    low, high = free.min(axis=0) - 0.5, free.max(axis=0) + 0.5
    shape = tuple(np.ceil((high - low) / RASTER_M).astype(int))
    solid = np.zeros(shape, dtype=bool)
    for points in surfaces(driving):
        at = np.floor((points - low) / RASTER_M).astype(int)
        at = at[((at >= 0) & (at < shape)).all(axis=1)]
        solid[at[:, 0], at[:, 1]] = True
    pieces, _ = ndimage.label(~solid)  # four neighbours: nothing slips through between two diagonal cells
    start = driving.truth(0)
    here = pieces[tuple(np.floor((np.array([start.x_m, start.y_m]) - low) / RASTER_M).astype(int))]
    away_m = ndimage.distance_transform_edt(pieces != here) * RASTER_M
    at = np.floor((free - low) / RASTER_M).astype(int)
    depth_m = away_m[at[:, 0], at[:, 1]]
    return free[depth_m > WALL_M], depth_m[depth_m > WALL_M], len(free)


def surfaces(driving: Drive) -> list[F64]:
    """Points along everything that stands at the laser's height, nearer to each other than the raster's cells."""
    segments = driving.world.segments.at_height(HEIGHT_M)
    circles = driving.world.circles.at_height(HEIGHT_M)
    found = []
    for a, b in zip(segments.a, segments.b):
        steps = max(2, int(np.hypot(*(b - a)) / (0.4 * RASTER_M)))
        found.append(a + np.linspace(0.0, 1.0, steps)[:, None] * (b - a))
    turn = np.linspace(0.0, 2.0 * np.pi, 400)
    found += [c + r * np.stack((np.cos(turn), np.sin(turn)), axis=-1) for c, r in zip(circles.center, circles.radius_m)]
    return found


@pytest.mark.parametrize("name", ["flat", "office", "walkers"])
def test_hardly_a_cell_is_called_free_that_is_not(name: str) -> None:
    driving = drive(name, 1.0)
    made = driven(driving)
    wrong, depth_m, free = false_free(driving, made.grid.patch())
    assert len(wrong) <= 0.001 * free
    path = np.array([[pose.map_from_base.x_m, pose.map_from_base.y_m] for pose in made.poses])
    assert all(np.hypot(*(path - cell).T).min() > STOPPING_M for cell in wrong[depth_m > DEEP_M])
