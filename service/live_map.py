"""The live map and the disk: restored at the start, saved while driving, copied, loaded and listed on request.

Two layers a map: `grid` holds the grid's own tiles, from which it is restored exactly; `occupancy` the percentages that
exports read. The grid belongs to the fusion thread: everything that touches it goes there by `ask`.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol, TypeVar

from mapping.frames import IDENTITY, Pose2
from mapping.grids.evidence import Model
from mapping.grids.occupancy import GridTile, OccupancyGrid
from mapping.grids.tiles import TILE
from service.errors import Trouble
from service.layers import BuildingLayer
from service.map_makers import MakersBusy, MapMakers
from service.new_map import keep_and_empty, keep_replaced, told
from service.rpc import CallRefused
from service.store import OCCUPANCY, SUFFIX, MapStore, SnapshotQueue, Tile, list_maps, occupancy_tiles

log = logging.getLogger(__name__)

GRID = "grid"
"""The layer of tiles as OccupancyGrid.load_tile takes them; meta `grid` has resolution_m, model and tile_cells."""

SLAM = "slam"
"""The layer of SLAM's own tiles (service/slam_store.py)."""

ANCHOR = "anchor"
"""Meta: latitude_deg, longitude_deg, height_m, yaw_deg of the map's origin and x axis."""

_MAKERS_WAIT_S = 1.0  # a snapshot goes on without them

T = TypeVar("T")


class Ask(Protocol):
    """Runs a function where the grid may be touched, and gives its result."""

    def __call__(self, work: Callable[[], T], /) -> T: ...


class Drawing(Protocol):
    """What draws the grid: Fusion."""

    def pose(self) -> Pose2 | None:
        """Where the robot is in the map."""

    def drain(self) -> None:
        """Draw what is held back."""

    def map_was_replaced(self, tiles: Iterable[Tile], slam: Iterable[Tile]) -> None:
        """The grid holds these stored tiles now; slam: that layer of the map."""

    def begin_map(self) -> None:
        """The grid is empty, and the robot at its origin."""

    def kept_of_slam(self) -> Callable[[], list[Tile]] | None:
        """Makes the changed tiles of the layer `slam`; None if there is nothing to keep."""


class LiveMap:
    """One building's grid and the store behind it. Calls may come from any thread."""

    def __init__(
        self,
        layer: BuildingLayer,
        store: MapStore | None,
        *,
        ask: Ask,
        fusion: Drawing,
        makers: MapMakers | None = None,
        anchor: Mapping[str, float] | None = None,
        settle_walls: Callable[[], None] = lambda: None,
    ) -> None:
        """fusion: draws the grid, and knows where the robot is; touched where `ask` runs.  makers: kept too.

        anchor: the map on the earth, as map files keep it; None: what the store says.  settle_walls: finds the walls of
        the grid as it is now, before it is saved; run where makers are.
        """
        self._layer = layer
        self._store = store
        self._queue = None if store is None else SnapshotQueue(store)
        self._ask = ask
        self._fusion = fusion
        self._makers = makers
        self._disk = threading.RLock()  # what is on it and the live map change together: no snapshot between
        self._settle_walls = settle_walls
        self._makers_left_out = 0
        self._anchor = store.get_meta(ANCHOR) if anchor is None and store is not None else anchor

    # --- while running

    def snapshot(self, *, is_whole: bool = False) -> bool:
        """Write what changed since the last one; False if the disk refused (it is tried again with the next).

        While slow maps are being drawn theirs stay for the next one, and are counted (`makers_left_out`).
        is_whole: MakersBusy instead.
        """
        with self._disk:
            return self._queue is None or self._write(self._queue, is_whole)

    def _write(self, queue: SnapshotQueue, is_whole: bool) -> bool:
        changed, pose, slam = self._ask(self._changed)
        if slam is not None:
            queue.offer(SLAM, slam())
        if changed:
            queue.offer(GRID, ((tile.tile_row, tile.tile_col, tile.payload()) for tile in changed))
            queue.offer(OCCUPANCY, occupancy_of(changed), self._meta(pose))
        for name, tiles in self._made(is_whole).items():
            if tiles:
                queue.offer(name, tiles)
        return queue.commit()

    def _made(self, is_whole: bool) -> dict[str, list[Tile]]:
        if self._makers is None:
            return {}
        if is_whole:
            return self._makers.changed_tiles()
        try:
            return self._makers.changed_tiles(_MAKERS_WAIT_S)
        except MakersBusy:
            self._makers_left_out += 1
            return {}

    def _changed(self) -> tuple[list[GridTile], Pose2 | None, Callable[[], list[Tile]] | None]:
        self._layer.show_walls()
        return self._layer.grid.changed_tiles(), self._fusion.pose(), self._fusion.kept_of_slam()

    def counters(self) -> dict[str, int]:
        """Commits and tiles written, and what failed."""
        return (
            {}
            if self._queue is None
            else {
                **self._queue.counts,
                "store_waiting": self._queue.waiting,
                "makers_left_out": self._makers_left_out,
            }
        )

    def trouble(self) -> str | None:
        """Why the last snapshot was not written."""
        return None if self._queue is None else self._queue.trouble

    def finish(self) -> None:
        """The last snapshot, and a whole copy as the newest generation."""
        self._ask(self._fusion.drain)
        if self._store is None:
            return
        try:
            self._find_walls(0.0)
        except MakersBusy:
            log.warning(
                "stopped while slow maps were being drawn: the grid is saved, they stay as they were saved before"
            )
        if not self.snapshot():
            raise Trouble(self.trouble() or f"{self._store.path}: not saved")
        self._store.keep_generation()

    def _find_walls(self, limit_s: float | None = None) -> None:
        if self._makers is not None:
            self._makers.ask(self._settle_walls, limit_s)

    def _meta(self, pose: Pose2 | None) -> dict[str, Any]:
        grid = self._layer.grid
        meta: dict[str, Any] = {
            GRID: {"resolution_m": grid.resolution_m, "model": grid.model, "tile_cells": TILE},
            OCCUPANCY: {"resolution_m": grid.resolution_m, "tile_cells": TILE},
        }
        if self._anchor is not None:
            meta[ANCHOR] = dict(self._anchor)
        if pose is not None:
            meta["pose"] = {"x_m": pose.x_m, "y_m": pose.y_m, "yaw_rad": pose.yaw_rad}
        return meta

    # --- calls

    def save(self, name: str) -> Mapping[str, Any]:
        """Write the map now, under this name beside the live one."""
        store = self._needed_store()
        with self._disk:
            self._find_walls()
            if not self.snapshot(is_whole=True):
                raise CallRefused(f"not saved: {self.trouble()}")
            return store.save_as(store.path.parent / f"{name}{SUFFIX}").document()

    def load(self, name: str) -> Mapping[str, Any]:
        """Replace the live map by the one saved under this name; it is kept as `replaced`. The robot's pose stays."""
        store = self._needed_store()
        path = store.path.parent / f"{name}{SUFFIX}"
        if path == store.path:
            raise CallRefused(f"{name} is the live map itself; save it under another name first")
        with MapStore.open(path, wall_ns=lambda: 0, read_only=True) as saved:
            tiles = saved.load_tiles(GRID)
            ready_made = saved.load_tiles(OCCUPANCY)
            made = {} if self._makers is None else {name: saved.load_tiles(name) for name in self._makers.layers}
            slam = saved.load_tiles(SLAM)
            anchor = saved.get_meta(ANCHOR)
            check_fits(self._layer.grid, saved)
        if not tiles:
            raise CallRefused(f"{path}: holds no grid to go on with; `umfeld map import` makes one from a picture")
        self._check_tiles(path, tiles)
        with self._disk:
            self._find_walls()
            if not self.snapshot(is_whole=True):  # else older tiles would wait behind what is written next
                raise CallRefused(f"not loaded: {self.trouble()}; the live map is as it was")
            kept = keep_replaced(store)
            meta = {**self._meta(None), ANCHOR: anchor}
            store.snapshot({GRID: tiles, OCCUPANCY: ready_made, SLAM: slam, **made}, meta, replace=True)
            self._anchor = anchor
            self._ask(lambda: self._replace(tiles, slam, made))
        return {"name": name, "path": str(path), "tiles": len(tiles), "kept": kept}

    def _replace(self, tiles: list[Tile], slam: list[Tile], made: Mapping[str, list[Tile]]) -> None:
        self._fusion.drain()
        replace_tiles(self._layer, tiles)
        self._fusion.map_was_replaced(tiles, slam)
        if self._makers is not None:
            self._makers.replace(made)

    def new(self, name: str | None = None) -> Mapping[str, Any]:
        """Keep the live map under this name, None: by the time, and begin an empty one where the robot stands."""
        store = self._needed_store()
        with self._disk:
            self._find_walls()
            if not self.snapshot(is_whole=True):
                raise CallRefused(f"no new map is begun, since the old one cannot be kept: {self.trouble()}")
            answer = keep_and_empty(store, name, wall_ns=store.wall_ns())
            self._anchor = None
            self._ask(self._begin)
        log.warning("%s", told(answer))
        return answer

    def _begin(self) -> None:
        self._fusion.drain()
        replace_tiles(self._layer, ())
        self._fusion.begin_map()
        if self._makers is not None:
            self._makers.replace({})

    def _check_tiles(self, path: Path, tiles: Iterable[Tile]) -> None:
        """Load them aside first: the live map is replaced as a whole or not at all."""
        live = self._layer.grid
        aside = OccupancyGrid(resolution_m=live.resolution_m, model=live.model)
        try:
            for row, column, payload in tiles:
                aside.load_tile(row, column, payload)
        except ValueError as error:
            raise CallRefused(f"{path}: {error}; the live map is as it was") from error

    def list(self) -> Mapping[str, Any]:
        """Every map beside the live one."""
        return {"maps": list_maps(self._needed_store().path.parent)}

    def info(self) -> Mapping[str, Any]:
        """About the live map."""
        patch = self._ask(self._layer.grid.patch)
        known = patch.cells >= 0
        about: dict[str, Any] = {
            "resolution_m": patch.resolution_m,
            "rows": patch.cells.shape[0],
            "columns": patch.cells.shape[1],
            "origin_m": [patch.col0 * patch.resolution_m, patch.row0 * patch.resolution_m],
            "known_cells": int(known.sum()),
            "occupied_cells": int((patch.cells >= 65).sum()),
        }
        return about | ({} if self._store is None else {"store": self._store.info()})

    def _needed_store(self) -> MapStore:
        if self._store is None:
            raise CallRefused("the daemon keeps no map on disk: set [store] enabled = true and start it again")
        return self._store


def restore(grid: OccupancyGrid, store: MapStore) -> Pose2:
    """Fill a grid from a store; returns where the robot last was in that map.

    Trouble if the store's map was made with another resolution or model.
    """
    check_fits(grid, store)
    refused = 0
    for row, column, payload in store.load_tiles(GRID):
        try:
            grid.load_tile(row, column, payload)
        except ValueError as error:
            refused += 1
            log.error("%s: tile %d, %d is left out: %s", store.path, row, column, error)
    if refused:
        log.error("%s: %d tiles were left out; older ones are in %s.1", store.path, refused, store.path.name)
    pose = store.get_meta("pose")
    return IDENTITY if not isinstance(pose, dict) else Pose2(pose["x_m"], pose["y_m"], pose["yaw_rad"])


def told_of(store: MapStore, grid: OccupancyGrid, wall_ns: int) -> str:
    """How much of a building was restored from a store, and how old that is, in words."""
    square_m = int((grid.patch().cells >= 0).sum()) * grid.resolution_m**2
    saved_ns = store.get_meta("saved_ns")
    if not isinstance(saved_ns, int):
        return f"{store.path}, {square_m:.0f} m² known"
    at = datetime.fromtimestamp(saved_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    age_s = round((wall_ns - saved_ns) / 1e9)
    if age_s < 0:
        return f"{store.path}, {square_m:.0f} m² known, saved at {at}, by a clock that was ahead of today's"
    return f"{store.path}, {square_m:.0f} m² known, saved at {at}, {span_in_words(age_s)} ago"


def span_in_words(seconds: float) -> str:
    """A time in the unit that suits it: 12 s, 3 min, 5 h, 2 days."""
    for unit, name, most in ((1, "s", 120), (60, "min", 120 * 60), (3600, "h", 48 * 3600)):
        if seconds < most:
            return f"{seconds / unit:.0f} {name}"
    return f"{seconds / 86400:.0f} days"


def check_fits(grid: OccupancyGrid, store: MapStore) -> None:
    """Trouble if a stored map cannot be put into this grid; names the setting that makes it fit."""
    made_with = store.get_meta(GRID)
    if not made_with:
        return
    for key, ours in (("resolution_m", grid.resolution_m), ("model", grid.model)):
        theirs = made_with.get(key)
        if theirs != ours:
            raise Trouble(
                f"{store.path}: this map has {key} {theirs}, the configuration {ours}; set {key} in [grid], or another "
                "path in [store]"
            )


def replace_tiles(layer: BuildingLayer, tiles: Iterable[Tile]) -> None:
    """Forget the live grid and take these tiles instead."""
    layer.grid.start_anew()
    for row, column, payload in tiles:
        layer.grid.load_tile(row, column, payload)
    layer.start_anew()


def occupancy_of(changed: Iterable[GridTile]) -> list[Tile]:
    """Percentages of tiles of one grid, made from their copies: for the thread that writes."""
    found: list[Tile] = []
    alone: OccupancyGrid | None = None  # one for all: making its tables takes longer than a tile
    for tile in changed:
        if alone is None:
            model: Model = tile.model
            alone = OccupancyGrid(resolution_m=tile.resolution_m, model=model, max_tiles=1)
        alone.start_anew()
        alone.load_tile(tile.tile_row, tile.tile_col, tile.payload())
        alone.show_walls(tile.tile_row, tile.tile_col, tile.walls)
        found.extend(occupancy_tiles(alone.patch(whole_tiles=True), TILE, also_unknown=True))
    return found
