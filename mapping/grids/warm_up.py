"""Load or compile every kernel of the grids before a device is opened: a first call takes up to some seconds."""

from __future__ import annotations

import math

import numpy as np

from mapping.frames import Pose2
from mapping.grids.beam_model import beams_of_scan
from mapping.grids.clearance import DistanceField, clearance_layer
from mapping.grids.evidence import Model
from mapping.grids.live_walls import LiveWalls
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.walls import BeamCounts, EndTiles
from mapping.kernels.beams import drop_own
from mapping.mixed_pixels import without_mixed_pixels
from mapping.narrow_gaps import without_narrow_gaps
from mapping.scan import Scan


def warm_up(model: Model = "counters") -> None:
    """Use a grid that is thrown away in all the ways a daemon does; both models share their kernels."""
    bearing = np.linspace(-1.0, 1.0, 9)
    ranges = np.array([1.0, 1.0, np.inf, 2.0, 1.0, np.nan, -np.inf, 1.0, 1.0])
    grid = OccupancyGrid(model=model, max_tiles=16)
    ranges, _ = without_mixed_pixels(bearing, ranges)
    without_narrow_gaps(bearing, np.full(len(bearing), math.inf))
    drop_own(bearing, ranges, 0.0, 0.0, 0.0, np.eye(3, 2), math.nan, np.empty_like(ranges))
    grid.insert_scan(Pose2(), bearing, ranges, range_max_m=2.0, range_min_m=0.1)
    for drift_m in (0.0, 1.0):  # as a fan, and line by line
        poses = np.stack(
            (np.linspace(0.0, drift_m, bearing.size), np.zeros(bearing.size), np.zeros(bearing.size)), axis=-1
        )
        grid.insert_beams(beams_of_scan(Scan(0, 0.0, bearing, ranges, 0.1, 2.0), poses))
    grid.insert_cells([(0, 0)], [(0, 1)])
    grid.insert_cone(Pose2(), 1.0, cone_rad=math.radians(30.0), range_max_m=2.0)
    grid.take_changes()
    grid.decay()
    for row, col, payload in list(grid.tiles()):
        grid.load_tile(row, col, payload)
    grid.empty_copy().take_tiles(grid, grid.places())
    clearance_layer(grid.patch())
    for reach in (None, 2):
        DistanceField(np.eye(3, dtype=np.bool_), reach_cells=reach).update([(0, 1), (0, 2)], [(0, 0), (1, 1)])


def warm_up_walls() -> None:
    """What finished maps need besides."""
    grid = OccupancyGrid(max_tiles=16)
    bearing, ranges = np.linspace(-1.0, 1.0, 9), np.ones(9)
    grid.insert_scan(Pose2(), bearing, ranges, range_max_m=2.0)
    ends = EndTiles(grid)
    ends.add(Pose2(), bearing, ranges, range_max_m=2.0)
    counts = BeamCounts(grid, ends.places())
    counts.add(Pose2(), bearing, ranges, range_max_m=2.0)
    grid.call_occupied(counts.walls())


def warm_up_live_walls(model: Model = "counters") -> None:
    """What a daemon needs that shows its grid by the walls in it."""
    grid, walls = OccupancyGrid(model=model, max_tiles=16), LiveWalls(resolution_m=0.05)
    bearing, ranges = np.linspace(-1.0, 1.0, 9), np.ones(9)
    grid.insert_scan(Pose2(), bearing, ranges, range_max_m=2.0)
    for pose in (np.zeros(3), np.zeros((9, 3))):
        walls.add(pose, bearing, ranges, range_max_m=2.0)
    for row, col in walls.places:
        grid.show_walls(row, col, walls.judge((row, col)))
    grid.patch()
