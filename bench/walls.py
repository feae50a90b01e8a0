"""How well walls of finished maps hold against scans that are not in them, for docs/algorithms/grids.md.

UMFELD_DATA=folder python bench/walls.py [--only NAME ...] [--bound] [--picture FILE]

Logs with corrected poses, every 10th scan held back. Two figures in per cent, as `umfeld map build --hold-out 10` tells
them: held-back end points within 10 cm of the middle of an occupied cell, held-back beams that cross an occupied cell
more than 20 cm before their end. For grids as counted (occupied from 65 %, and other shares) and for walls found in all
scans together (mapping.grids.walls; by the defaults, and for other ends_per_pass).

--bound adds what a choice of cells reaches that knows the very beams by which it is judged: chosen greedily and judged
on the scans in the map, most newly explained end points for each beam that no chosen cell was crossed by before.
--picture draws the curves, and a piece of belgioioso's map both ways.
"""

from __future__ import annotations

import argparse
import heapq
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib
import numpy as np
from numba import njit
from numpy.typing import NDArray

matplotlib.use("Agg")
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from drivers.logs import Log, LogScan, read_log
from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.patch import GridPatch
from mapping.grids.tiles import Window
from mapping.grids.walls import BeamCounts, WallRules
from service.map_build import BEFORE_END_M, NEAR_M, PoseSource, insert_scans, judge, poses_from_log

F64 = NDArray[np.float64]
I8 = NDArray[np.int8]
Curve = list[tuple[float, float, float]]  # parameter, near, early, the last two in per cent

LOGS: Final = ("belgioioso", "seattle", "acapulco")
EVERY: Final = 10
PERCENT: Final = (5, 10, 20, 30, 40, 50, 65, 75, 85, 95)
ENDS_PER_PASS: Final = (0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
DEFAULT_PERCENT, DEFAULT_ENDS = 65, WallRules().ends_per_pass
PIECE: Final = (700, 950, 200, 450)  # of belgioioso: rows and columns of its map that are drawn


class Trial:
    """One log in a map, but for every 10th scan."""

    def __init__(self, path: Path) -> None:
        self.log: Log = read_log(path)
        self.scans: Sequence[LogScan] = self.log.scans
        self.poses = poses_from_log(self.log, self.scans, PoseSource.LOG)
        self.held = list(range(0, len(self.scans), EVERY))
        self.grid = OccupancyGrid(resolution_m=0.05, model="log-odds")
        insert_scans(self.grid, self.log, self.scans, self.poses, left_out=set(self.held))
        self.counted = self.grid.patch()

    def judged(self, patch: GridPatch) -> tuple[float, float]:
        found = judge(patch, self.log, [self.scans[k] for k in self.held], self.poses[self.held])
        return 100.0 * found.near_occupied, 100.0 * found.crossing_early

    def as_counted(self) -> Curve:
        patch = self.counted
        curve: Curve = []
        for percent in PERCENT:
            cells = np.where(patch.cells >= percent, 100, 0).astype(np.int8)
            curve.append((percent, *self.judged(GridPatch(patch.resolution_m, patch.row0, patch.col0, cells))))
        return curve

    def piece(self) -> I8:
        row0, row1, col0, col1 = PIECE
        row, col = self.counted.row0, self.counted.col0
        return self.grid.cells_in(Window(row + row0, row + row1, col + col0, col + col1))

    def as_found(self) -> tuple[Curve, I8]:
        """The curve, and a piece of the map by the defaults."""
        counts = BeamCounts(self.grid)
        for index, (scan, pose) in enumerate(zip(self.scans, self.poses)):
            if index % EVERY:
                counts.add(Pose2(*pose), scan.bearing_rad, scan.range_m, range_max_m=self.log.range_max_m)
        curve: Curve = []
        default = self.piece()
        for ends in ENDS_PER_PASS:
            self.grid.call_occupied(counts.walls(WallRules(ends_per_pass=ends)))
            curve.append((ends, *self.judged(self.grid.patch())))
            default = self.piece() if ends == DEFAULT_ENDS else default
        return curve, default

    def bound(self) -> Curve:
        """Chosen on the scans in the map and judged on them, at some shares of crossing beams."""
        origin, end = self._beams()
        middle = np.floor(end / self.grid.resolution_m).astype(np.int64)
        low = middle.min(axis=0) - 4
        width, height = (int(k) for k in middle.max(axis=0) - low + 5)
        cell_m = self.grid.resolution_m
        length = np.maximum(np.hypot(*(end - origin).T), 1e-9)
        early = origin + (end - origin) * np.maximum(0.0, 1.0 - BEFORE_END_M / length)[:, None]
        reach = np.array(
            [(r, c) for r in range(-2, 3) for c in range(-2, 3) if np.hypot(r, c) * cell_m <= NEAR_M + 1e-9]
        )
        near = (middle[:, 1, None] - low[1] + reach[:, 0]) * width + middle[:, 0, None] - low[0] + reach[:, 1]
        wanted = np.zeros(width * height, dtype=np.bool_)
        wanted[near] = True
        walks, walked = _walks(origin / cell_m - low, early / cell_m - low, width, height, wanted)
        return _greedy(near.astype(np.int64), walks, walked, width * height)

    def _beams(self) -> tuple[F64, F64]:
        """Origins and ends (N, 2) of the beams in the map that end somewhere."""
        origins, ends = [], []
        for index, (scan, pose) in enumerate(zip(self.scans, self.poses)):
            if index % EVERY:
                hit = np.isfinite(scan.range_m)
                bearing = pose[2] + scan.bearing_rad[hit]
                way = np.stack((np.cos(bearing), np.sin(bearing)), axis=-1) * scan.range_m[hit, None]
                origins.append(np.broadcast_to(pose[:2], way.shape))
                ends.append(pose[:2] + way)
        return np.concatenate(origins), np.concatenate(ends)


@njit
def _walks(start: Any, end: Any, width: int, height: int, wanted: Any) -> Any:
    """Cells that lines pass, of those wanted: where each line's begin (N + 1,), and the cells of all lines."""
    first = np.zeros(len(start) + 1, dtype=np.int64)
    cells = np.empty(0, dtype=np.int32)
    for turn in range(2):  # count, then write
        if turn == 1:
            cells = np.empty(first[-1], dtype=np.int32)
        for i in range(len(start)):
            at = first[i]
            col, row = int(np.floor(start[i, 0])), int(np.floor(start[i, 1]))
            dx, dy = end[i, 0] - start[i, 0], end[i, 1] - start[i, 1]
            cols, rows = abs(int(np.floor(end[i, 0])) - col), abs(int(np.floor(end[i, 1])) - row)
            to_col = ((col + 1 - start[i, 0]) if dx > 0 else (start[i, 0] - col)) / max(abs(dx), 1e-12)
            to_row = ((row + 1 - start[i, 1]) if dy > 0 else (start[i, 1] - row)) / max(abs(dy), 1e-12)
            while True:
                if 0 <= row < height and 0 <= col < width and wanted[row * width + col]:
                    if turn == 1:
                        cells[at] = row * width + col
                    at += 1
                if cols + rows == 0:
                    break
                if rows == 0 or (cols > 0 and to_col < to_row):
                    col, cols, to_col = col + (1 if dx > 0 else -1), cols - 1, to_col + 1.0 / max(abs(dx), 1e-12)
                else:
                    row, rows, to_row = row + (1 if dy > 0 else -1), rows - 1, to_row + 1.0 / max(abs(dy), 1e-12)
            if turn == 0:
                first[i + 1] = at
    return first, cells


@njit
def _by_cell(first: Any, cells: Any, count: int) -> Any:
    """Which line each cell is in: where each cell's begin (count + 1,), and the lines."""
    begin = np.zeros(count + 1, dtype=np.int64)
    for cell in cells:
        begin[cell + 1] += 1
    begin = np.cumsum(begin)
    at, lines = begin[:-1].copy(), np.empty(len(cells), dtype=np.int32)
    for i in range(len(first) - 1):
        for cell in cells[first[i] : first[i + 1]]:
            lines[at[cell]] = i
            at[cell] += 1
    return begin, lines


@njit
def _choose(near: Any, near_lines: Any, walk: Any, walk_lines: Any, beams: int, out: Any) -> int:
    """out: (N, 2) ends explained and beams crossed after each choice. Returns how many choices."""
    explained, crossed = np.zeros(beams, dtype=np.bool_), np.zeros(beams, dtype=np.bool_)
    heap = [(0.0, 0) for _ in range(0)]
    for cell in range(len(near) - 1):
        if near[cell + 1] > near[cell]:
            heap.append((-(near[cell + 1] - near[cell]) / (walk[cell + 1] - walk[cell] + 0.1), cell))
    heapq.heapify(heap)
    ends, cross, count = 0, 0, 0
    while len(heap) > 0:
        _, cell = heapq.heappop(heap)
        gain, cost = 0, 0
        for i in near_lines[near[cell] : near[cell + 1]]:
            gain += not explained[i]
        for i in walk_lines[walk[cell] : walk[cell + 1]]:
            cost += not crossed[i]
        if gain == 0:
            continue
        worth = gain / (cost + 0.1)
        if len(heap) > 0 and -worth > heap[0][0] + 1e-12:
            heapq.heappush(heap, (-worth, cell))
            continue
        explained[near_lines[near[cell] : near[cell + 1]]] = True
        crossed[walk_lines[walk[cell] : walk[cell + 1]]] = True
        ends, cross = ends + gain, cross + cost
        out[count, 0], out[count, 1] = ends, cross
        count += 1
    return count


def _greedy(near: NDArray[np.int64], first: Any, cells: Any, count: int) -> Curve:
    beams = len(near)
    of_near = _by_cell(np.arange(beams + 1) * near.shape[1], near.ravel(), count)
    steps = np.zeros((count, 2), dtype=np.int64)
    steps = steps[: _choose(*of_near, *_by_cell(first, cells, count), beams, steps)]
    share = 100.0 * steps / beams
    found: Curve = []
    for early in (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0):
        last = int(np.searchsorted(share[:, 1], early, side="right")) - 1
        found.append((early, float(share[last, 0]), float(share[last, 1])))
    return found


def picture(curves: dict[str, dict[str, Curve]], piece: tuple[I8, I8] | None, out: Path) -> None:
    figure = Figure(figsize=(13.0, 4.6), dpi=80)
    axes = figure.subplots(1, 1 if piece is None else 3, squeeze=False)[0]
    colours = dict(zip(LOGS, ("tab:blue", "tab:green", "tab:red")))
    styles = {"counted": "--", "found": "-", "bound": ":"}
    for name, kinds in curves.items():
        for kind, curve in kinds.items():
            _, near, early = zip(*curve)
            label = f"{name}, {kind}" if name == LOGS[0] else (name if kind == "found" else None)
            axes[0].plot(early, near, styles[kind], color=colours[name], label=label)
            for value, x, y in curve:
                if (kind, value) in (("counted", DEFAULT_PERCENT), ("found", DEFAULT_ENDS)):
                    axes[0].plot(y, x, "o", color=colours[name], fillstyle="full" if kind == "found" else "none")
    axes[0].set(xlim=(0.0, 10.0), ylim=(60.0, 100.5))
    axes[0].set_xlabel("held-back beams that cross a wall, %")
    axes[0].set_ylabel("held-back end points near a wall, %")
    axes[0].grid(visible=True, alpha=0.3)
    axes[0].legend(fontsize=8, loc="lower right")
    for axis, cells in zip(axes[1:], piece or ()):
        level = np.select([cells < 0, cells >= DEFAULT_PERCENT, cells < 25], [0.8, 0.0, 1.0], 0.6)
        axis.imshow(level, cmap="gray", vmin=0.0, vmax=1.0, origin="lower", interpolation="nearest")
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(out)


def main() -> None:
    parser = argparse.ArgumentParser(description="Walls of finished maps against scans that are not in them.")
    parser.add_argument("--only", nargs="+", default=list(LOGS), choices=LOGS)
    parser.add_argument("--bound", action="store_true", help="also what knowing the judge would give")
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    data = Path(os.environ["UMFELD_DATA"])
    curves: dict[str, dict[str, Curve]] = {}
    piece = None
    for name in asked.only:
        trial = Trial(data / f"known_pose_logs/{name}-corrected.log.gz")
        before = trial.piece()
        found, after = trial.as_found()
        curves[name] = {"counted": trial.as_counted(), "found": found}
        if asked.bound:
            curves[name]["bound"] = trial.bound()
        if name == LOGS[0]:
            piece = (before, after)
        for kind, curve in curves[name].items():
            print(
                f"{name:11} {kind:8}" + "  ".join(f"{value:g}: {near:.1f}/{early:.1f}" for value, near, early in curve)
            )
    if asked.picture is not None:
        picture(curves, piece, asked.picture)


if __name__ == "__main__":
    main()
