"""Where the walls are in the daemon's grid: posed sweeps in, walls of tiles out, to be shown with the grid (S27).

Counting cell by cell makes walls as thick as poses scatter. Here the beams of sweeps that robots take every STEP_M or
STEP_RAD of the way are counted together (mapping.grids.live_walls), and the grid is told which cells are walls. The
grid itself stays as counted (OccupancyGrid.show_walls); clearance keeps clear of what was counted, too, and sector maps
know nothing of grids.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from mapping.frames import wrap_angle
from mapping.grids.live_walls import LiveWalls
from mapping.scan import Scan
from service.map_makers import MapView, Tile
from service.outputs import Output

F64 = NDArray[np.float64]
Tell = Callable[[int, int, NDArray[np.uint8]], None]
"""Takes the walls of a tile: its row and column, (TILE, TILE) 0 or 1. Any thread; never blocks."""

NAME = "walls"
STEP_M = 0.10
STEP_RAD = math.radians(5.0)
PERIOD_NS = 2_000_000_000
ALL_PERIOD_NS = 10_000_000_000  # so often every tile is judged that was given any beam
SHARE = 0.25  # of new beams in a tile: then it is judged before
AT_ONCE = 48  # tiles, some 0.5 ms each
BEAMS_MOST = 720  # of one sweep: of finer ones every second, third ... is counted, others of the next


class WallMaker:
    """A map maker that counts beams and tells walls."""

    def __init__(self, walls: LiveWalls, sources: Iterable[str], tell: Tell) -> None:
        self.name = NAME
        self.sources = frozenset(sources)
        self.period_ns = PERIOD_NS
        self._walls = walls
        self._tell = tell
        self._last: dict[str, F64] = {}
        self._counted = 0
        self._all_ns: int | None = None
        self._told: set[tuple[int, int]] = set()  # tiles that have walls
        self._unkept: set[tuple[int, int]] = set()

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        if not np.isfinite(scan.range_m).any():
            return  # and the next one that ends somewhere is taken, however near
        pose = np.atleast_2d(map_from_sensor)
        middle = pose[len(pose) // 2]
        last = self._last.get(source)
        if last is not None:
            way = math.hypot(middle[0] - last[0], middle[1] - last[1])
            if way < STEP_M and abs(wrap_angle(float(middle[2] - last[2]))) < STEP_RAD:
                return
        self._last[source] = middle.copy()
        apart = math.ceil(len(scan.range_m) / BEAMS_MOST)
        self._counted += 1
        some = slice(self._counted % apart, None, apart)
        poses = pose if len(pose) == 1 else pose[some]
        self._walls.add(poses, scan.bearing_rad[some], scan.range_m[some], range_max_m=scan.range_max_m)

    def start_anew(self) -> None:
        """The map was corrected: every sweep that was kept follows, where it lies now."""
        self._walls.clear()
        self._last.clear()

    def make(self, view: MapView) -> list[Output]:
        """Judge what is worth it; nothing is published from here."""
        is_all = self._all_ns is None or view.stamp_ns - self._all_ns >= ALL_PERIOD_NS
        worth = self._walls.worth(0.0 if is_all else SHARE)
        self._judge(worth[:AT_ONCE])
        if is_all and len(worth) <= AT_ONCE:
            self._all_ns = view.stamp_ns
            self._forget_gone()
        return []

    def settle(self) -> None:
        """Judge all that was counted by now: before a map is saved."""
        self._judge(self._walls.worth(0.0))
        self._forget_gone()

    def _judge(self, places: Iterable[tuple[int, int]]) -> None:
        for place in places:
            self._told.add(place)
            self._unkept.add(place)
            self._tell(*place, self._walls.judge(place))

    def _forget_gone(self) -> None:
        """Tiles in which nothing ends any more, after a correction."""
        for place in self._told - set(self._walls.places):
            self._told.discard(place)
            self._unkept.add(place)
            self._tell(*place, self._walls.judge(place))

    def changed_tiles(self) -> list[Tile]:
        """Counts of what was judged since the last call; an empty one where nothing ends any more."""
        here = set(self._walls.places)
        unkept, self._unkept = sorted(self._unkept), set()
        return [(*place, self._walls.payload(place) if place in here else b"") for place in unkept]

    def restore(self, tiles: Iterable[Tile]) -> None:
        self._last.clear()
        self._unkept.clear()
        self._all_ns = None
        self._walls.load(tile for tile in tiles if tile[2])
