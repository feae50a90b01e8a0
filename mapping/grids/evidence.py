"""What unbounded and rolling grids share: taking in scans, beams, cones and cells, and answering (S26 to S29)."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2
from mapping.grids.beam_model import Beams, BeamTable, Fan, beam_table, fan_of_beams
from mapping.grids.geometry import cell_of, cells_of, check_resolution
from mapping.grids.patch import GridPatch
from mapping.grids.sonar_model import SonarMemory, SonarRules, cone_of_reading
from mapping.grids.tiles import TILE, TO_PUBLISH, TilePool, Window
from mapping.kernels import grids as kernels
from mapping.kernels import sonar_cones

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I8 = NDArray[np.int8]

Model = Literal["counters", "log-odds"]
ODDS_STEP: Final = 0.001  # log-odds of one step of a cell
MAX_REACH_CELLS: Final = 1 << 14  # the longest beam: 819 m at 5 cm
MAX_COORDINATE_CELLS: Final = 1 << 40
KEPT_TABLES: Final = 16


class CellState(IntEnum):
    """What is known about a cell."""

    UNKNOWN = -1
    FREE = 0
    PARTLY_FREE = 1
    OCCUPIED = 2


UNKNOWN, FREE, PARTLY_FREE, OCCUPIED = CellState.UNKNOWN, CellState.FREE, CellState.PARTLY_FREE, CellState.OCCUPIED


@dataclass(frozen=True, slots=True)
class CellRules:
    """How evidence adds up in a cell, and which share of it makes a state.

    count_limit: "counters": before hits or misses pass it, both are halved, so that the ratio (eq. 5.46) follows a
    change of the world after about as many observations (2 to 254).
    hit_log_odds, miss_log_odds, lowest_log_odds, highest_log_odds: "log-odds": steps and bounds.
    free_below, occupied_from: a cell with a smaller probability is FREE, from the other on OCCUPIED, else PARTLY_FREE.
    """

    count_limit: int = 64
    hit_log_odds: float = 0.85
    miss_log_odds: float = 0.4
    lowest_log_odds: float = -2.0
    highest_log_odds: float = 3.5
    free_below: float = 0.25
    occupied_from: float = 0.65

    def __post_init__(self) -> None:
        if not 2 <= self.count_limit <= 254:
            raise ValueError(f"count_limit is 2 to 254, got {self.count_limit}")
        if not (-8.0 <= self.lowest_log_odds < 0.0 < self.highest_log_odds <= 8.0):
            raise ValueError("lowest_log_odds is -8 to 0, highest_log_odds 0 to 8")
        if not (0.0 < self.hit_log_odds <= 8.0 and 0.0 < self.miss_log_odds <= 8.0):
            raise ValueError("hit_log_odds and miss_log_odds are above 0, at most 8")
        if not 0.0 < self.free_below <= self.occupied_from <= 1.0:
            raise ValueError("0 < free_below <= occupied_from <= 1")


class _Work:
    """Work arrays of the kernels, kept between scans."""

    def __init__(self) -> None:
        self.needed = np.zeros(3, dtype=np.int64)
        self.beams(2048)
        self.rows = np.zeros(4096, dtype=np.int64)
        self.crossings(1 << 14)
        self.saved(1 << 14)

    def beams(self, n: int) -> None:
        self.free_len, self.hit_len, self.ray_x, self.ray_y, self.silent_m = np.zeros((5, n))
        self.from_x, self.from_y, self.to_x, self.to_y = np.zeros((4, n))
        self.todo_row, self.todo_col = np.zeros((2, n), dtype=np.int64)

    def crossings(self, n: int) -> None:
        self.cross_row, self.cross_col = np.zeros(n, dtype=np.int32), np.zeros(n, dtype=np.int32)
        self.sorted_col = np.zeros(n, dtype=np.int32)

    def saved(self, n: int) -> None:
        self.saved_at, self.saved_value = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.uint16)
        self.saved_kind = np.zeros(n, dtype=np.uint8)

    def list_cells(self, cells: I64) -> None:
        """Hand (N, 2) cells to a kernel."""
        n = len(cells)
        if n > self.todo_row.size:
            self.beams(2 * n)
        if n > self.saved_at.size:
            self.saved(2 * n)
        self.todo_row[:n], self.todo_col[:n] = cells[:, 0], cells[:, 1]

    def grow(self) -> None:
        """Bring the room that the last kernel asked for."""
        crossings, saved, rows = (int(k) for k in self.needed)
        if crossings > self.cross_row.size:
            self.crossings(2 * crossings)
        if saved > self.saved_at.size:
            self.saved(2 * saved)
        if rows > self.rows.size:
            self.rows = np.zeros(2 * rows, dtype=np.int64)


class EvidenceGrid:
    """Cells with evidence from lasers and sonars; subclasses decide which cells exist. Not for two threads at once.

    Cells follow mapping.grids.geometry; what a beam proves mapping.grids.beam_model, an echo mapping.grids.sonar_model.
    """

    def __init__(
        self,
        pool: TilePool,
        *,
        resolution_m: float,
        model: Model,
        rules: CellRules,
        sonar_rules: SonarRules,
        fill_gap_m: float,
        use_max_m: float,
    ) -> None:
        if model not in ("counters", "log-odds"):
            raise ValueError(f'model is "counters" or "log-odds", got {model!r}')
        if not fill_gap_m >= 0.0 or not use_max_m > 0.0:
            raise ValueError("fill_gap_m is at least 0, use_max_m above 0")
        self.resolution_m = check_resolution(resolution_m)
        self.model: Model = model
        self.rules = rules
        self.refused_insertions = 0
        self._pool = pool
        self._fill_gap_m = fill_gap_m
        self._use_max_m = use_max_m
        self._model_number = kernels.COUNTERS if model == "counters" else kernels.LOG_ODDS
        self._rule = _rule_numbers(model, rules)
        self._laser_probability = _probabilities_of_cells(model)
        self._laser_percent = _percent(self._laser_probability)
        self._sonar_probability = _probabilities_of_sonar()
        self._sonar_percent = _percent(self._sonar_probability)
        self._sonar_rules = sonar_rules
        self._sonar = SonarMemory(sonar_rules, resolution_m)
        self._sonar_weights: dict[float, F64] = {}
        self._tables: OrderedDict[int, tuple[bytes, BeamTable]] = OrderedDict()
        self._work = _Work()

    @property
    def refused_tiles(self) -> int:
        """How often a tile found no room: what falls there stays unknown."""
        return self._pool.refused

    @property
    def rejected_echoes(self) -> int:
        """Sonar readings not believed so far."""
        return self._sonar.rejected

    # ------------------------------------------------------------------ taking in

    def insert_scan(
        self,
        map_from_sensor: Pose2,
        bearing_rad: F64,
        range_m: F64,
        *,
        range_max_m: float,
        clear_no_return: bool = True,
        range_min_m: float = 0.0,
        fill: Literal["wedges", "lines"] = "wedges",
    ) -> None:
        """One sweep seen from one pose.

        bearing_rad, range_m: (N,) as in mapping.scan.Scan; the beams may come in any order.
        range_min_m: if positive, -inf puts an obstacle there.  fill: "lines" frees only cells that a beam passes.
        A scan that would make the table too large is passed over and counted in refused_insertions.
        Raises ValueError for shapes that differ, bearings or a pose that are not finite, or a range_max_m too long.
        """
        ranges = np.ascontiguousarray(range_m, dtype=np.float64)
        bearings = np.asarray(bearing_rad, dtype=np.float64)
        if ranges.ndim != 1 or bearings.shape != ranges.shape:
            raise ValueError(f"a scan has as many bearings as ranges, got {bearings.shape} and {ranges.shape}")
        reach_m = self._checked_reach(range_max_m)
        if ranges.size == 0:
            self._checked_place(map_from_sensor)
            return
        table = self._table_for(bearings)
        if table.order is not None:
            ranges = ranges[table.order]
        wedge = table.wedge_m / self.resolution_m if fill == "wedges" else np.zeros(ranges.size)
        ox, oy = self._checked_place(map_from_sensor)
        window = self._window_around(ox, oy, max(reach_m, range_min_m) / self.resolution_m)
        if window is None:
            return
        w, pool = self._beam_work(ranges.size), self._pool
        while not kernels.insert_scan(
            ox, oy, math.cos(map_from_sensor.yaw_rad), math.sin(map_from_sensor.yaw_rad), table.turned_rad,
            table.gap_max_rad, ranges, 1.0 / self.resolution_m, float(range_min_m), float(range_max_m),
            self._use_max_m, bool(clear_no_return), w.silent_m, table.dir_x, table.dir_y, wedge, w.free_len, w.hit_len,
            w.ray_x, w.ray_y, w.from_x, w.from_y, w.to_x, w.to_y, w.cross_row, w.cross_col, w.sorted_col, w.rows,
            w.todo_row, w.todo_col, w.saved_at, w.saved_value, w.saved_kind, w.needed, window,
            pool.tile_row0, pool.tile_col0, pool.cells, pool.index, pool.tile_at, pool.free_slots, pool.flags,
            pool.state, self._model_number, self._rule,
        ):  # fmt: skip
            w.grow()

    def insert_beams(self, beams: Beams) -> None:
        """One sweep whose sensor moved (de-skewed): see Beams, and beams_of_scan which makes them.

        While all origins lie within half a cell of the middle one, wedges are filled as if all beams came from there
        (an error of at most half a cell, at the sensor's end); otherwise each beam frees the cells of its own line.
        Raises ValueError for shapes that differ, or for beams that are not finite or too long for the grid.
        """
        n = beams.origin_m.shape[0]
        if not (beams.origin_m.shape == beams.end_m.shape == (n, 2) and beams.free.shape == beams.hit.shape == (n,)):
            raise ValueError("beams have (N, 2) origins and ends, (N,) free and hit")
        beams = Beams(
            np.ascontiguousarray(beams.origin_m),
            np.ascontiguousarray(beams.end_m),
            np.ascontiguousarray(beams.free),
            np.ascontiguousarray(beams.hit),
        )
        measures = np.zeros(4)
        if not kernels.measure_lines(beams.origin_m, beams.end_m, beams.free | beams.hit, measures):
            return
        middle, spread_m, length_m = measures[:2], float(measures[2]), float(measures[3])
        if not math.isfinite(spread_m + length_m):
            raise ValueError("a beam that is free or hit has finite ends")
        self._checked_reach(length_m)
        ox, oy = self._checked_place(Pose2(float(middle[0]), float(middle[1])))
        window = self._window_around(ox, oy, (length_m + spread_m) / self.resolution_m)
        if window is None:
            return
        if spread_m < self.resolution_m / 2.0:
            fan = fan_of_beams(beams, middle, spread_m, self._fill_gap_m)
            self._insert_fan(fan, ox, oy, window)
        else:
            self._insert_lines(beams, window)

    def _insert_fan(self, fan: Fan, ox: float, oy: float, window: I64) -> None:
        d = self.resolution_m
        w, pool = self._beam_work(fan.free_m.size), self._pool
        free_len, hit_len, wedge = fan.free_m / d, fan.hit_m / d, fan.wedge_m / d
        while not kernels.insert_fan(
            ox, oy, 1.0, 0.0, fan.dir_x, fan.dir_y, wedge, free_len, hit_len, w.ray_x, w.ray_y, w.from_x, w.from_y,
            w.to_x, w.to_y, w.cross_row, w.cross_col, w.sorted_col, w.rows, w.todo_row, w.todo_col, w.saved_at,
            w.saved_value, w.saved_kind, w.needed, window, pool.tile_row0, pool.tile_col0, pool.cells, pool.index,
            pool.tile_at, pool.free_slots, pool.flags, pool.state, self._model_number, self._rule,
        ):  # fmt: skip
            w.grow()

    def _insert_lines(self, beams: Beams, window: I64) -> None:
        d = self.resolution_m
        start, end = beams.origin_m[beams.free].T / d, beams.end_m[beams.free].T / d
        hit = cells_of(beams.end_m[beams.hit], d)
        w, pool = self._work, self._pool
        w.list_cells(hit)
        while not kernels.insert_lines(
            start.shape[1], np.ascontiguousarray(start[0]), np.ascontiguousarray(start[1]),
            np.ascontiguousarray(end[0]), np.ascontiguousarray(end[1]), len(hit), w.todo_row, w.todo_col, w.saved_at,
            w.saved_value, w.saved_kind, w.needed, window, pool.tile_row0, pool.tile_col0, pool.cells, pool.index,
            pool.tile_at, pool.free_slots, pool.flags, pool.state, self._model_number, self._rule,
        ):  # fmt: skip
            w.grow()

    def insert_cells(self, hit_cells: ArrayLike, free_cells: ArrayLike) -> None:
        """One observation given as cells, e.g. of a sector map (S39, S40): (N, 2) [row, col] each, N may be 0.

        Every cell counts once; a cell in both lists is a hit. Raises ValueError for other shapes or kinds.
        """
        hit, free = _cell_list(hit_cells), _cell_list(free_cells)
        cells = np.concatenate((hit, free))
        if len(cells) == 0:
            return
        low, high = cells.min(axis=0), cells.max(axis=0)
        if np.max(np.abs(cells)) > MAX_COORDINATE_CELLS:
            raise ValueError("a cell is too far from the origin")
        window = self._window_of(Window(int(low[0]), int(high[0]) + 1, int(low[1]), int(high[1]) + 1))
        if window is None:
            return
        w, pool = self._work, self._pool
        w.list_cells(cells)
        kernels.insert_listed(
            len(cells), len(hit), w.todo_row, w.todo_col, w.saved_at, w.saved_value, w.saved_kind, window,
            pool.tile_row0, pool.tile_col0, pool.cells, pool.index, pool.tile_at, pool.free_slots, pool.flags,
            pool.state, self._model_number, self._rule,
        )  # fmt: skip

    def insert_cone(
        self,
        map_from_sensor: Pose2,
        range_m: float,
        *,
        cone_rad: float,
        range_max_m: float,
        range_min_m: float = 0.0,
        transducer: Hashable | None = None,
        clear_no_return: bool = True,
    ) -> bool:
        """One reading of a sonar (S29); whether it was believed.

        cone_rad: full opening angle, above 0 and at most pi.  transducer: the same name for each reading of one
        transducer; without it the reading is taken as it is, unchecked by others and unguarded from them.
        Raises ValueError for a pose or limits that are not finite, or a range_max_m too long.
        """
        if not 0.0 < cone_rad <= math.pi or not 0.0 <= range_min_m <= range_max_m:
            raise ValueError("cone_rad is above 0 and at most pi, 0 <= range_min_m <= range_max_m")
        self._checked_reach(range_max_m)
        ox, oy = self._checked_place(map_from_sensor)
        if not self._sonar.believe(transducer, range_m, map_from_sensor.x_m, map_from_sensor.y_m):
            return False
        cone = cone_of_reading(
            self._sonar_rules, map_from_sensor, range_m, cone_rad=cone_rad, range_min_m=range_min_m,
            range_max_m=range_max_m, resolution_m=self.resolution_m, clear_no_return=clear_no_return,
        )  # fmt: skip
        if cone is None:
            return True
        guards = self._sonar.guards(transducer)
        self._sonar.remember(transducer, cone)
        d, explain_m = self.resolution_m, self._sonar_rules.explain_m
        window = self._window_around(ox, oy, (range_max_m + cone.arc_half_m + explain_m) / d)
        if window is None:
            return True
        pool = self._pool
        pool.need_sonar()
        sonar_cones.insert_reading(
            ox, oy, cone.axis_x, cone.axis_y, cone.cos_half, cone.arc_m / d, cone.arc_half_m / d,
            (cone.arc_half_m + explain_m) / d, cone.free_from_m / d, cone.free_m / d,
            self._weights_of(cone.free_log_odds), guards, window, pool.tile_row0, pool.tile_col0, pool.cells,
            self._laser_percent, math.ceil(100.0 * self.rules.occupied_from), pool.sonar, pool.sonar_seen, pool.index,
            pool.tile_at, pool.free_slots, pool.flags, pool.state,
        )  # fmt: skip
        return True

    def _weights_of(self, free_log_odds: float) -> F64:
        """What the kernel weighs a cone's evidence by."""
        weights = self._sonar_weights.get(free_log_odds)
        if weights is None:
            rules, step = self._sonar_rules, sonar_cones.SONAR_STEP
            weights = self._sonar_weights[free_log_odds] = np.array(
                [
                    rules.occupied_log_odds / step,
                    rules.edge_share,
                    free_log_odds / step,
                    rules.lowest_log_odds / step,
                    rules.highest_log_odds / step,
                ]
            )
        return weights

    def decay(self) -> None:
        """Forget half of all evidence, for maps that should follow a changing world even where nobody looks.

        Cells with next to nothing left become unknown, and none becomes freer than its evidence was. Call it from time
        to time; one call costs about 2 us a tile.
        """
        pool = self._pool
        for slot in pool.slots():
            start, stop = int(slot) * kernels.TILE_CELLS, (int(slot) + 1) * kernels.TILE_CELLS
            kernels.halve_cells(pool.cells, start, stop, self._model_number)
            if pool.sonar_seen[slot]:
                sonar_cones.halve_sonar(pool.sonar, start, stop)
            pool.flags[slot] = 0xFF

    # ------------------------------------------------------------------ answering

    def probability_at(self, points_m: ArrayLike) -> F64:
        """(N,) probability of being occupied at (N, 2) points in the map, NaN where unknown.

        Laser: C = hits / (hits + misses) (eq. 5.46) or the logistic of the log-odds; joined with the sonar layer as
        published. Points that are not finite are unknown.
        """
        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2:
            raise ValueError(f"points are (N, 2), got {points.shape}")
        answer = np.full(len(points), np.nan)
        near = np.all(np.abs(points) < MAX_COORDINATE_CELLS * self.resolution_m, axis=1)
        slot, at = self._pool.look_up(cells_of(points[near], self.resolution_m))
        value = np.where(slot > 0, self._laser_probability[self._pool.cells[at]], np.nan)
        if self._pool.has_sonar:
            sonar = np.where(slot > 0, self._sonar_probability[self._pool.sonar[at]], np.nan)
            louder = np.isnan(value) | ((sonar >= self.rules.occupied_from) & (sonar > value))
            value = np.where(louder, sonar, value)
        answer[near] = value
        return answer

    def state_at(self, points_m: ArrayLike) -> I8:
        """(N,) CellState at (N, 2) points in the map; where nothing was recorded UNKNOWN."""
        p = self.probability_at(points_m)
        state = np.full(p.shape, PARTLY_FREE, dtype=np.int8)
        state[p < self.rules.free_below] = FREE
        state[p >= self.rules.occupied_from] = OCCUPIED
        state[np.isnan(p)] = UNKNOWN
        return state

    def counts_at(self, points_m: ArrayLike) -> tuple[I64, I64]:
        """(N,) hits and (N,) misses of the laser at (N, 2) points; ValueError for another model."""
        if self.model != "counters":
            raise ValueError("a log-odds grid keeps no counters")
        slot, at = self._pool.look_up(cells_of(points_m, self.resolution_m))
        value = np.where(slot > 0, self._pool.cells[at].astype(np.int64), 0)
        return value >> 8, value & 0xFF

    def cells_in(self, window: Window) -> I8:
        """(R, C) int8 of any rectangle of cells, -1 unknown (also where no tile is), 0 to 100."""
        image = np.full((window.row1 - window.row0, window.col1 - window.col0), -1, dtype=np.int8)
        tile = np.empty((TILE, TILE), dtype=np.int8)
        for slot in self._pool.slots():
            row0, col0 = (int(k) * TILE for k in self._pool.tile_at[slot])
            top, bottom = max(row0, window.row0), min(row0 + TILE, window.row1)
            left, right = max(col0, window.col0), min(col0 + TILE, window.col1)
            if top < bottom and left < right:
                self._tile_percent(int(slot), tile)
                image[top - window.row0 : bottom - window.row0, left - window.col0 : right - window.col0] = tile[
                    top - row0 : bottom - row0, left - col0 : right - col0
                ]
        return image

    def _tile_percent(self, slot: int, out: I8) -> None:
        pool = self._pool
        kernels.percent_of_tile(
            slot, pool.cells, self._laser_percent, pool.sonar, bool(pool.sonar_seen[slot]), self._sonar_percent,
            math.ceil(100.0 * self.rules.occupied_from), out,
        )  # fmt: skip

    # ------------------------------------------------------------------ helpers

    def _checked_place(self, pose: Pose2) -> tuple[float, float]:
        """A pose's place in cells."""
        ox, oy = pose.x_m / self.resolution_m, pose.y_m / self.resolution_m
        if not (math.isfinite(pose.yaw_rad) and max(abs(ox), abs(oy)) < MAX_COORDINATE_CELLS):  # catches NaN too
            raise ValueError(f"a pose is finite and not too far from the origin, got {pose}")
        return ox, oy

    def _checked_reach(self, range_max_m: float) -> float:
        reach_m = min(float(range_max_m), self._use_max_m)
        if not 0.0 <= reach_m <= MAX_REACH_CELLS * self.resolution_m:
            raise ValueError(
                f"a beam is 0 to {MAX_REACH_CELLS * self.resolution_m:g} m long at this resolution, got {range_max_m}"
            )
        return reach_m

    def _table_for(self, bearing_rad: F64) -> BeamTable:
        """The table of these bearings; devices repeat theirs from scan to scan."""
        given = bearing_rad.tobytes()  # compared as they lie in memory: a seventh of what comparing numbers takes
        for key in reversed(self._tables):
            kept, table = self._tables[key]
            if kept == given:
                self._tables.move_to_end(key)
                return table
        table = beam_table(bearing_rad, self._fill_gap_m)
        self._tables[id(table)] = given, table
        if len(self._tables) > KEPT_TABLES:
            self._tables.popitem(last=False)
        return table

    def _beam_work(self, n: int) -> _Work:
        if self._work.free_len.size < n:
            self._work.beams(2 * n)
        return self._work

    def _window_around(self, ox: float, oy: float, reach: float) -> I64 | None:
        """Which cells a scan may write, as kernels take it; None if none."""
        return self._window_of(
            Window(
                math.floor(oy - reach) - 2,
                math.floor(oy + reach) + 3,
                math.floor(ox - reach) - 2,
                math.floor(ox + reach) + 3,
            )
        )

    def _window_of(self, wanted: Window) -> I64 | None:
        """Overridden where not every cell may be written."""
        if not self._pool.cover(wanted):
            self.refused_insertions += 1
            return None
        return np.array([wanted.row0, wanted.row1, wanted.col0, wanted.col1], dtype=np.int64)

    def _patch_of(self, window: Window) -> GridPatch:
        return GridPatch(self.resolution_m, window.row0, window.col0, self.cells_in(window))

    def mark_published(self) -> None:
        """Forget which tiles changed, for a reader that has just taken everything."""
        self._pool.flags[self._pool.slots()] &= ~TO_PUBLISH & np.uint8(0xFF)

    def cell_at(self, x_m: float, y_m: float) -> tuple[int, int]:
        """(row, col) of a point."""
        return int(cell_of(y_m, self.resolution_m)), int(cell_of(x_m, self.resolution_m))


def _rule_numbers(model: Model, rules: CellRules) -> I64:
    if model == "counters":
        return np.array([rules.count_limit, 0, 0, 0], dtype=np.int64)
    return np.array(
        [
            round(rules.hit_log_odds / ODDS_STEP),
            round(rules.miss_log_odds / ODDS_STEP),
            round(rules.lowest_log_odds / ODDS_STEP) + kernels.ODDS_ZERO,
            round(rules.highest_log_odds / ODDS_STEP) + kernels.ODDS_ZERO,
        ],
        dtype=np.int64,
    )


@cache
def _probabilities_of_cells(model: Model) -> F64:
    """(65536,) probability of each content of a cell, NaN unknown."""
    value = np.arange(1 << 16)
    if model == "counters":
        hits, misses = value >> 8, value & 0xFF
        with np.errstate(invalid="ignore"):
            return np.asarray(hits / (hits + misses))  # eq. 5.46
    odds = np.clip((value - kernels.ODDS_ZERO) * ODDS_STEP, -50.0, 50.0)
    return np.where(value == 0, np.nan, 1.0 / (1.0 + np.exp(-odds)))


@cache
def _probabilities_of_sonar() -> F64:
    """(256,) the same for the sonar layer."""
    value = np.arange(256)
    odds = (value - sonar_cones.SONAR_ZERO) * sonar_cones.SONAR_STEP
    return np.where(value == 0, np.nan, 1.0 / (1.0 + np.exp(-odds)))


def _percent(probability: F64) -> I8:
    """-1 unknown, else 0 to 100."""
    return np.where(np.isnan(probability), -1.0, np.rint(100.0 * np.nan_to_num(probability))).astype(np.int8)


def _cell_list(cells: ArrayLike) -> I64:
    array = np.asarray(cells)
    if array.size == 0:
        return np.zeros((0, 2), dtype=np.int64)
    if array.ndim != 2 or array.shape[1] != 2 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"cells are (N, 2) whole numbers, got {array.dtype} {array.shape}")
    return array.astype(np.int64)
