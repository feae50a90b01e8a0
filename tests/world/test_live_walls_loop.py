"""Walls shown while a loop is driven and closed: the map is drawn anew, and its walls are found anew."""

from __future__ import annotations

import numpy as np

from mapping.grids.live_walls import LiveWalls
from mapping.grids.occupancy import OccupancyGrid
from service.map_makers import MapMakers
from service.wall_maker import WallMaker
from tests.world.test_live_slam_worlds import drive, robot, wall_errors_m


def test_after_a_loop_was_closed_walls_stand_where_the_map_has_them() -> None:
    driving = drive("loop", 1.25)
    shown_in: list[OccupancyGrid] = []
    maker = WallMaker(
        LiveWalls(resolution_m=0.05), ["front"], lambda row, col, walls: shown_in[0].show_walls(row, col, walls)
    )
    makers = MapMakers([maker], lambda _output: None, now_ns=lambda: 0)
    made = robot(driving.truth(0), makers=makers)
    shown_in.append(made.grid)
    made.play(driving.items)
    assert made.fusion.counters()["map.redrawn"] >= 1
    assert makers.counters()["makers.errors"] == 0
    maker.settle()
    shown = made.grid.patch(whole_tiles=True)
    for place in made.grid.places():
        made.grid.show_walls(*place, None)
    counted = made.grid.patch(whole_tiles=True)
    thin, thick = wall_errors_m(driving, shown), wall_errors_m(driving, counted)
    assert len(thin) < len(thick)
    assert np.median(thin) < 0.04
    assert np.percentile(thin, 95) <= np.percentile(thick, 95) + 0.01
    freer = (shown.cells >= 0) & (shown.cells < 25) & (counted.cells >= 25)
    assert not freer.any()
