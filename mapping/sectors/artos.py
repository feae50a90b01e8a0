"""An occupancy grid drawn from polar sector maps in two steps, as on the robot ARTOS (S40, section 5.3 [AKSB07])."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.grids.patch import GridPatch
from mapping.kernels import sectors as kernels
from mapping.sectors.snapshot import PolarSnapshot, SectorState

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]
_Kind = TypeVar("_Kind", np.int16, np.bool_)
_CELLS_MAX = 16_000_000


class ArtosMap:
    """Occupancy counters in a square window that follows the robot; cells stay where they are in the map.

    resolution_m: edge of a cell.  size_m: edge of the window, rounded up to whole cells.  counter_max: counters stay
    within -counter_max and +counter_max; a cell at +counter_max is 100 per cent occupied, at 0 it is 50.
    area_m: edges, along x and y, of the rectangle around the sensor whose cells the second step visits; default: the
    window.  follow: whether the window moves along; if not, it stays centred on the map's origin.
    """

    def __init__(
        self,
        *,
        resolution_m: float,
        size_m: float,
        counter_max: int = 10,
        area_m: tuple[float, float] | None = None,
        follow: bool = True,
    ) -> None:
        if not (resolution_m > 0.0 and size_m > 0.0 and math.isfinite(size_m / resolution_m)):
            raise ValueError("resolution_m and size_m must be positive")
        if not 1 <= counter_max <= 10_000:
            raise ValueError("counter_max must be within 1 and 10000")
        count = max(1, math.ceil(size_m / resolution_m - 1e-6))
        if count * count > _CELLS_MAX:
            raise ValueError(f"{count} x {count} cells are too many: enlarge resolution_m")
        self._resolution_m = resolution_m
        self._counter_max = counter_max
        self._area_m = area_m
        self._follow = follow
        self._counters = np.zeros((count, count), dtype=np.int16)
        self._touched = np.zeros((count, count), dtype=bool)
        self._hit = np.zeros((count, count), dtype=bool)
        self._row0, self._col0 = self._corner(IDENTITY)

    def update(self, snapshot: PolarSnapshot | Sequence[PolarSnapshot], map_from_base: Pose2) -> None:
        """Draw one sector map, or several of one instant together.

        Step 1 counts up the cell of each sector's obstacle. Step 2 visits the cells around each sensor and counts
        down those whose centre lies in a sector, nearer than its obstacle, or than free was seen. A cell hit in
        step 1 is left alone in step 2; sectors that know nothing, or nothing new, change nothing.
        """
        snapshots = [snapshot] if isinstance(snapshot, PolarSnapshot) else list(snapshot)
        if self._follow:
            self._scroll(*self._corner(map_from_base))
        self._hit[:] = False
        for step in (1, 2):
            for one in snapshots:
                self._draw(one, map_from_base @ one.base_from_sensor, step)

    def clear(self) -> None:
        """Forget everything."""
        self._counters[:] = 0
        self._touched[:] = False

    def patch(self) -> GridPatch:
        """The window as a grid in map cells: -1 never touched, else 50 per cent and the counter's share of 50."""
        cells = np.floor(50.5 + 50.0 * self._counters / self._counter_max).astype(np.int8)
        cells[~self._touched] = -1
        return GridPatch(self._resolution_m, self._row0, self._col0, cells)

    def counters(self) -> NDArray[np.int16]:
        """(R, C) a copy of the counters, in the cells of patch()."""
        return self._counters.copy()

    def _corner(self, map_from_base: Pose2) -> tuple[int, int]:
        half = len(self._counters) // 2
        row = math.floor(map_from_base.y_m / self._resolution_m)
        col = math.floor(map_from_base.x_m / self._resolution_m)
        return row - half, col - half

    def _scroll(self, row0: int, col0: int) -> None:
        down, right = row0 - self._row0, col0 - self._col0
        if down or right:
            self._counters = _shifted(self._counters, down, right)
            self._touched = _shifted(self._touched, down, right)
            self._row0, self._col0 = row0, col0

    def _area(self, sensor: Pose2) -> I64:
        count = len(self._counters)
        if self._area_m is None:
            return np.array([0, count, 0, count])
        cells = []
        for centre, edge, first in (
            (sensor.y_m, self._area_m[1], self._row0),
            (sensor.x_m, self._area_m[0], self._col0),
        ):
            cells.append(math.floor((centre - 0.5 * edge) / self._resolution_m) - first)
            cells.append(math.floor((centre + 0.5 * edge) / self._resolution_m) + 1 - first)
        return np.clip(np.array(cells, dtype=np.int64), 0, count)

    def _draw(self, snapshot: PolarSnapshot, sensor: Pose2, step: int) -> None:
        is_obstacle = snapshot.state == SectorState.OBSTACLE
        knows = is_obstacle | (snapshot.state == SectorState.FREE)
        edges = snapshot.edges_rad
        kernels.artos_update(
            self._counters,
            self._touched,
            self._row0,
            self._col0,
            self._resolution_m,
            sensor.x_m,
            sensor.y_m,
            sensor.yaw_rad,
            float(edges[0]),
            float(edges[1] - edges[0]),
            float(edges[-1] - edges[0]),
            self._hit,
            np.where(is_obstacle, snapshot.distance_m, np.nan),
            np.ascontiguousarray(snapshot.bearing_rad),
            np.where(knows, np.nan_to_num(snapshot.distance_m, nan=0.0), 0.0),
            self._area(sensor),
            self._counter_max,
            step,
        )


def _shifted(cells: NDArray[_Kind], down: int, right: int) -> NDArray[_Kind]:
    # The same cells in a window that begins `down` rows and `right` columns later; what comes in is empty.
    moved = np.zeros_like(cells)
    rows, cols = cells.shape
    if abs(down) < rows and abs(right) < cols:
        moved[max(-down, 0) : rows - max(down, 0), max(-right, 0) : cols - max(right, 0)] = cells[
            max(down, 0) : rows - max(-down, 0), max(right, 0) : cols - max(-right, 0)
        ]
    return moved
