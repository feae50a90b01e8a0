"""The maps as fusion sees them: thin coats around mapping's grids that know names, sources and when to publish."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.beam_model import beams_of_scan
from mapping.grids.evidence import EvidenceGrid
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.patch import GridPatch
from mapping.grids.rolling import RollingGrid
from mapping.grids.tiles import TILE
from mapping.scan import Scan
from mapping.sectors.artos import ArtosMap
from mapping.sectors.polar import PolarSectors
from mapping.sectors.rectangular import RectSectors
from service.fusion import SECOND, Round, Touch
from service.outputs import GridOut, GridUpdateOut, Output, PolarOut, RectOut

F64 = NDArray[np.float64]

_CELLS_A_SECOND = 1_000_000  # a grid of more cells is sent whole less often, and by updates between
_STILL_M = 1e-3
_HALVINGS_MAX = 16  # nothing is left after so many
_TOUCHED_SURELY = 0.7
_TOUCHES_MAX = 300  # more than a cell can have been looked through
_STILL_RAD = 2e-4  # 6 mm at 30 m
_WALLS_WAITING_MAX = 4096


def insert_sweep(grid: EvidenceGrid, scan: Scan, map_from_sensor: F64) -> None:
    """Put a sweep into a grid, each beam from its own pose (N, 3), or all from one (3,).

    A robot that stands gives the same bearings in every scan, for which the grid has a faster way.
    """
    pose = np.atleast_2d(map_from_sensor)
    middle = pose[len(pose) // 2]
    if np.abs(pose[:, :2] - middle[:2]).max() < _STILL_M and np.abs(pose[:, 2] - middle[2]).max() < _STILL_RAD:
        grid.insert_scan(
            Pose2(*map(float, middle)),
            scan.bearing_rad,
            scan.range_m,
            range_max_m=scan.range_max_m,
            range_min_m=scan.range_min_m,
        )
    else:
        grid.insert_beams(beams_of_scan(scan, map_from_sensor))


def insert_round(grid: EvidenceGrid, source: str, heard: Round, map_from_base: Pose2) -> None:
    """Put the cones of a sonar round into a grid."""
    for cone in heard.cones:
        if math.isnan(cone.range_m):
            continue
        grid.insert_cone(
            map_from_base @ cone.base_from_transducer,
            cone.range_m,
            cone_rad=heard.cone_rad,
            range_max_m=heard.range_max_m,
            range_min_m=heard.range_min_m,
            transducer=(source, cone.channel),
        )


def insert_touch(grid: EvidenceGrid, touch: Touch, map_from_base: Pose2) -> None:
    """Draw what a switch touches as occupied, however often others have looked through it: glass is felt, not seen."""
    count = max(2, math.ceil(touch.switch.width_m / (0.5 * grid.resolution_m)) + 1)
    across = np.linspace(-0.5 * touch.switch.width_m, 0.5 * touch.switch.width_m, count)
    ahead = np.full(count, 0.5 * grid.resolution_m)
    line = (map_from_base @ touch.switch.base_from_contact).apply(np.stack((ahead, across), axis=-1))
    cells = np.array([grid.cell_at(float(x), float(y)) for x, y in line], dtype=np.int64)
    nothing = np.empty((0, 2), dtype=np.int64)
    for _ in range(_TOUCHES_MAX):
        grid.insert_cells(np.unique(cells, axis=0), nothing)
        if (grid.probability_at(line) > _TOUCHED_SURELY).all():
            break


class Forgetting:
    """When a grid halves its evidence, by the stamps of what is drawn into it. period_ns: 0 never."""

    def __init__(self, grid: EvidenceGrid, period_ns: int) -> None:
        self._grid = grid
        self._period_ns = period_ns
        self._halved_ns: int | None = None

    def move_on(self, stamp_ns: int) -> None:
        """To be called before what was seen at this stamp is drawn."""
        if self._period_ns == 0:
            return
        if self._halved_ns is None:
            self._halved_ns = stamp_ns
        times = (stamp_ns - self._halved_ns) // self._period_ns
        if times > 0:
            self._halved_ns += times * self._period_ns
            for _ in range(min(times, _HALVINGS_MAX)):
                self._grid.decay()


class PolarLayer:
    """A polar sector map."""

    def __init__(self, name: str, sectors: PolarSectors, sources: Iterable[str]) -> None:
        self.name = name
        self.sectors = sectors
        self.sources = frozenset(sources)

    def take_scan(self, source: str, scan: Scan, base_from_sensor: Pose2) -> None:
        feed_scan(self.sectors, source, scan, base_from_sensor)

    def take_round(self, source: str, heard: Round) -> None:
        feed_round(self.sectors, source, heard)

    def take_touch(self, source: str, touch: Touch) -> None:
        feed_touch(self.sectors, source, touch)

    def lose(self, source: str) -> None:
        self.sectors.lost(source)

    def output(self, now_ns: int) -> PolarOut:
        return PolarOut(self.name, self.sectors.snapshot(now_ns))


class RectLayer:
    """A rectangular sector map."""

    def __init__(self, name: str, sectors: RectSectors, sources: Iterable[str]) -> None:
        self.name = name
        self.sectors = sectors
        self.sources = frozenset(sources)

    def take_scan(self, source: str, scan: Scan, base_from_sensor: Pose2) -> None:
        feed_scan(self.sectors, source, scan, base_from_sensor)

    def take_round(self, source: str, heard: Round) -> None:
        feed_round(self.sectors, source, heard)

    def take_touch(self, source: str, touch: Touch) -> None:
        feed_touch(self.sectors, source, touch)

    def lose(self, source: str) -> None:
        self.sectors.lost(source)

    def output(self, now_ns: int) -> RectOut:
        return RectOut(self.name, self.sectors.snapshot(now_ns))


def feed_scan(sectors: PolarSectors | RectSectors, source: str, scan: Scan, base_from_sensor: Pose2) -> None:
    """Hand a sweep to a sector map."""
    sectors.update_beams(
        source,
        base_from_sensor=base_from_sensor,
        bearing_rad=scan.bearing_rad,
        range_m=scan.range_m,
        range_min_m=scan.range_min_m,
        range_max_m=scan.range_max_m,
        stamp_ns=scan.stamp_ns,
    )


def feed_round(sectors: PolarSectors | RectSectors, source: str, heard: Round) -> None:
    """Hand the cones of a round to a sector map."""
    for cone in heard.cones:
        sectors.update_cone(
            source,
            cone.channel,
            base_from_transducer=cone.base_from_transducer,
            cone_rad=heard.cone_rad,
            range_m=cone.range_m,
            range_min_m=heard.range_min_m,
            range_max_m=heard.range_max_m,
            stamp_ns=heard.stamp_ns,
        )


def feed_touch(sectors: PolarSectors | RectSectors, source: str, touch: Touch) -> None:
    """Hand what a switch says to a sector map."""
    sectors.update_contact(
        source,
        touch.switch.line,
        base_from_contact=touch.switch.base_from_contact,
        width_m=touch.switch.width_m,
        tripped=touch.tripped,
        stamp_ns=touch.stamp_ns,
    )


class BuildingLayer:
    """The map-fixed grid: sent whole when it has grown or after a while, by changed rectangles between."""

    def __init__(
        self,
        grid: OccupancyGrid,
        sources: Iterable[str],
        *,
        publish_period_ns: int,
        update_period_ns: int,
        halve_period_ns: int = 0,
    ) -> None:
        """halve_period_ns: how often half of all evidence is forgotten; 0 never."""
        self.grid = grid
        self._forgetting = Forgetting(grid, halve_period_ns)
        self.sources = frozenset(sources)
        self._publish_period_ns = publish_period_ns
        self._update_period_ns = update_period_ns
        self._epoch = 0
        self._full: GridPatch | None = None
        self._full_ns = 0
        self._update_ns = 0
        self._unsent = True  # something changed that no full grid holds yet
        self._outgrown = True  # something changed outside the last full grid
        self._walls: deque[tuple[int, int, NDArray[np.uint8]]] = deque(maxlen=_WALLS_WAITING_MAX)

    def offer_walls(self, tile_row: int, tile_col: int, walls: NDArray[np.uint8]) -> None:
        """Walls of a tile, to be shown with the next outputs: see OccupancyGrid.show_walls. Any thread."""
        self._walls.append((tile_row, tile_col, walls))

    def show_walls(self) -> None:
        """Show those that were offered by now."""
        while self._walls:
            self.grid.show_walls(*self._walls.popleft())

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        self._forgetting.move_on(scan.stamp_ns)
        insert_sweep(self.grid, scan, map_from_sensor)

    def take_round(self, source: str, heard: Round, map_from_base: Pose2) -> None:
        self._forgetting.move_on(heard.stamp_ns)
        insert_round(self.grid, source, heard, map_from_base)

    def take_touch(self, source: str, touch: Touch, map_from_base: Pose2) -> None:
        insert_touch(self.grid, touch, map_from_base)

    def outputs(self, map_from_base: Pose2 | None, stamp_ns: int, now_ns: int) -> list[Output]:
        if self._full is not None and now_ns - self._update_ns < self._update_period_ns:
            return []
        self._update_ns = now_ns
        self.show_walls()
        changes = self.grid.take_changes()
        self._unsent |= bool(changes)
        self._outgrown |= any(not self._is_inside(change) for change in changes)
        if self._is_full_due(now_ns):
            return self._send_full(stamp_ns, now_ns)
        return [GridUpdateOut(stamp_ns, self._epoch, change) for change in changes if self._is_inside(change)]

    def start_anew(self) -> None:
        """The grid was replaced, or moved: what was sent so far no longer holds, the next output is a whole grid."""
        self._walls.clear()
        self._full, self._unsent, self._outgrown = None, True, True

    def _is_full_due(self, now_ns: int) -> bool:
        if self._full is None:
            return self._unsent
        waited_ns = now_ns - self._full_ns
        patience_ns = max(self._publish_period_ns, self._full.cells.size * SECOND // _CELLS_A_SECOND)
        return waited_ns >= self._publish_period_ns and (self._outgrown or (self._unsent and waited_ns >= patience_ns))

    def _send_full(self, stamp_ns: int, now_ns: int) -> list[Output]:
        patch = self.grid.patch(whole_tiles=True)
        if patch.cells.size == 0:
            if self._epoch == 0:
                return []
            nothing = np.full((TILE, TILE), -1, dtype=np.int8)  # what subscribers have is not true any more
            patch = GridPatch(self.grid.resolution_m, 0, 0, nothing)
        self._epoch += 1
        self._full, self._full_ns, self._unsent, self._outgrown = patch, now_ns, False, False
        return [GridOut(stamp_ns, self._epoch, patch)]

    def _is_inside(self, patch: GridPatch) -> bool:
        full = self._full
        return full is not None and (
            patch.row0 >= full.row0
            and patch.col0 >= full.col0
            and patch.row0 + patch.cells.shape[0] <= full.row0 + full.cells.shape[0]
            and patch.col0 + patch.cells.shape[1] <= full.col0 + full.cells.shape[1]
        )


class RollingLayer:
    """A grid around the robot, in the map frame, that forgets what it leaves behind: sent whole."""

    def __init__(
        self, name: str, grid: RollingGrid, sources: Iterable[str], *, period_ns: int, halve_period_ns: int = 0
    ) -> None:
        """halve_period_ns: how often half of all evidence is forgotten; 0 never."""
        self.name = name
        self.grid = grid
        self._forgetting = Forgetting(grid, halve_period_ns)
        self.sources = frozenset(sources)
        self._period_ns = period_ns
        self._told_ns: int | None = None
        self._changed = False
        self._epoch = 0

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        middle = np.atleast_2d(map_from_sensor)[-1]
        self.grid.centre_on(float(middle[0]), float(middle[1]))
        self._forgetting.move_on(scan.stamp_ns)
        insert_sweep(self.grid, scan, map_from_sensor)
        self._changed = True

    def take_round(self, source: str, heard: Round, map_from_base: Pose2) -> None:
        self.grid.centre_on(map_from_base.x_m, map_from_base.y_m)
        self._forgetting.move_on(heard.stamp_ns)
        insert_round(self.grid, source, heard, map_from_base)
        self._changed = True

    def start_over(self) -> None:
        """Forget the window: the map frame moved under it."""
        self.grid.clear()
        self._changed = True

    def take_touch(self, source: str, touch: Touch, map_from_base: Pose2) -> None:
        self.grid.centre_on(map_from_base.x_m, map_from_base.y_m)
        insert_touch(self.grid, touch, map_from_base)
        self._changed = True

    def outputs(self, map_from_base: Pose2 | None, stamp_ns: int, now_ns: int) -> list[Output]:
        if not self._changed or (self._told_ns is not None and now_ns - self._told_ns < self._period_ns):
            return []
        self._told_ns, self._changed = now_ns, False
        self._epoch += 1
        return [GridOut(stamp_ns, self._epoch, self.grid.patch(), name=self.name)]


class ArtosLayer:
    """The two-step map, drawn from polar sector maps as they stand: it is fed by maps, not by sensors."""

    sources: frozenset[str] = frozenset()

    def __init__(self, grid: ArtosMap, maps: Iterable[PolarLayer], *, period_ns: int) -> None:
        self.grid = grid
        self._maps = tuple(maps)
        self._period_ns = period_ns
        self._drawn_ns: int | None = None
        self._epoch = 0

    def start_over(self) -> None:
        """Forget the window: the map frame moved under it."""
        self.grid.clear()

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        raise AssertionError("the two-step map is drawn from sector maps")

    def take_round(self, source: str, heard: Round, map_from_base: Pose2) -> None:
        raise AssertionError("the two-step map is drawn from sector maps")

    def take_touch(self, source: str, touch: Touch, map_from_base: Pose2) -> None:
        raise AssertionError("the two-step map is drawn from sector maps")

    def outputs(self, map_from_base: Pose2 | None, stamp_ns: int, now_ns: int) -> list[Output]:
        due = self._drawn_ns is None or now_ns - self._drawn_ns >= self._period_ns
        if map_from_base is None or not due:
            return []
        self._drawn_ns = now_ns
        self._epoch += 1
        self.grid.update([each.sectors.snapshot(now_ns) for each in self._maps], map_from_base)
        return [GridOut(now_ns, self._epoch, self.grid.patch(), name="artos")]
