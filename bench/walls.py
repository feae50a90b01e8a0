"""How well walls of finished maps hold against scans that are not in them, for docs/algorithms/grids.md.

UMFELD_DATA=folder python bench/walls.py [--only NAME ...] [--from N ...] [--control] [--bound] [--picture FILE]

Logs with corrected poses, every 10th scan held back, from the first on, or from the N-th. Figures in per cent:

    near      held-back end points with an occupied cell within 10 cm: its nearest point, for a cell is a square
    middle    the same between the middles of the cell they lie in and of the occupied one
    in        held-back beams that are in an occupied cell more than 20 cm before their end
    out       held-back beams that are in one and out of it again more than 20 cm before their end

`umfeld map build --hold-out 10` tells the first three. For grids as counted (occupied from 65 %, and other shares) and
for walls found in all scans together (mapping.grids.walls; by the defaults, and for other ends_per_pass).

--control adds Intel and fr079 by their particle filters' paths, on which nothing was chosen, by the defaults.
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
Row = tuple[float, float, float, float, float]  # parameter, near, middle, in, out, the last four in per cent
Curve = list[Row]
Drawn = list[tuple[float, float, float]]  # parameter, near, in

LOGS: Final = ("belgioioso", "seattle", "acapulco")
CONTROL: Final = {"intel": 1, "fr079": 2}  # every n-th scan
EVERY: Final = 10
PERCENT: Final = (5, 10, 20, 30, 40, 50, 65, 75, 85, 95)
ENDS_PER_PASS: Final = (0.15, 0.3, 0.5, 0.7, 0.85, 0.95, 1.05, 1.2, 1.5, 2.0)
SAME_S: Final = 1e-3
DEFAULT_PERCENT, DEFAULT_ENDS = 65, WallRules().ends_per_pass
PIECE: Final = (700, 950, 200, 450)  # of belgioioso: rows and columns of its map that are drawn


class Trial:
    """One log in a map, but for every 10th scan from the given one on; of dense logs every n-th scan is a scan."""

    def __init__(self, path: Path, *, first: int = 0, every: int = 1, way: Path | None = None) -> None:
        """way: lines of stamp, x, y, yaw of the robot, for scans of the same stamps; else by the log's own poses."""
        self.log: Log = read_log(path)
        self.scans: Sequence[LogScan] = self.log.scans[::every]
        if way is None:
            self.poses = poses_from_log(self.log, self.scans, PoseSource.LOG)
        else:
            self.scans, self.poses = _on_the_way(self.log.scans, np.loadtxt(way), every)
        self.held = list(range(first, len(self.scans), EVERY))
        self.inside = sorted(set(range(len(self.scans))) - set(self.held))
        self.grid = OccupancyGrid(resolution_m=0.05, model="log-odds")
        insert_scans(self.grid, self.log, self.scans, self.poses, left_out=set(self.held))
        self.counted = self.grid.patch()

    def judged(self, patch: GridPatch) -> tuple[float, float, float, float]:
        found = judge(patch, self.log, [self.scans[k] for k in self.held], self.poses[self.held])
        shares = (found.near_occupied, found.near_middle, found.crossing_early, self.leaving(patch))
        near, middle, early, out = (100.0 * share for share in shares)
        return near, middle, early, out

    def leaving(self, patch: GridPatch) -> float:
        """Share of held-back beams that have crossed an occupied cell more than BEFORE_END_M before their end."""
        low = np.array([patch.col0, patch.row0], dtype=np.float64)
        start, stop = (points / patch.resolution_m - low for points in self.beams(self.held)[:2])
        height, width = patch.cells.shape
        first, cells = _walks(start, stop, width, height, patch.cells.ravel() >= DEFAULT_PERCENT)
        col, row = np.floor(stop).astype(np.int64).T
        beam = np.repeat(np.arange(len(start)), np.diff(first))
        return len(np.unique(beam[cells != (row * width + col)[beam]])) / max(len(start), 1)

    def as_counted(self, percents: Sequence[int]) -> Curve:
        patch = self.counted
        curve: Curve = []
        for percent in percents:
            cells = np.where(patch.cells >= percent, 100, 0).astype(np.int8)
            curve.append((percent, *self.judged(GridPatch(patch.resolution_m, patch.row0, patch.col0, cells))))
        return curve

    def piece(self) -> I8:
        row0, row1, col0, col1 = PIECE
        row, col = self.counted.row0, self.counted.col0
        return self.grid.cells_in(Window(row + row0, row + row1, col + col0, col + col1))

    def as_found(self, ends_per_pass: Sequence[float]) -> tuple[Curve, I8]:
        """The curve, and a piece of the map by the defaults."""
        counts = BeamCounts(self.grid)
        robot_from_laser = Pose2(*self.log.robot_from_laser)
        for k in self.inside:
            scan, pose = self.scans[k], Pose2(*self.poses[k]) @ robot_from_laser
            counts.add(pose, scan.bearing_rad, scan.range_m, range_max_m=self.log.range_max_m)
        curve: Curve = []
        default = self.piece()
        for ends in ends_per_pass:
            self.grid.call_occupied(counts.walls(WallRules(ends_per_pass=ends)))
            curve.append((ends, *self.judged(self.grid.patch())))
            default = self.piece() if ends == DEFAULT_ENDS else default
        return curve, default

    def bound(self) -> Drawn:
        """Chosen on the scans in the map and judged on them, at some shares of beams that are in a cell early: near."""
        origin, early, end = (points / self.grid.resolution_m for points in self.beams(self.inside))
        middle = np.floor(end).astype(np.int64)
        low = middle.min(axis=0) - 4
        width, height = (int(k) for k in middle.max(axis=0) - low + 5)
        reach = NEAR_M / self.grid.resolution_m
        lines, near = [], []
        for row in range(-3, 4):
            for col in range(-3, 4):
                corner = middle + (col, row)
                away = np.maximum(np.maximum(corner - end, end - (corner + 1)), 0.0)
                close = np.flatnonzero(np.hypot(*away.T) <= reach)
                lines.append(close)
                near.append((corner[close, 1] - low[1]) * width + corner[close, 0] - low[0])
        order = np.argsort(np.concatenate(lines), kind="stable")
        first = np.searchsorted(np.concatenate(lines)[order], np.arange(len(end) + 1))
        cells = np.concatenate(near)[order]
        wanted = np.zeros(width * height, dtype=np.bool_)
        wanted[cells] = True
        walks, walked = _walks(origin - low, early - low, width, height, wanted)
        return _greedy(first, cells, walks, walked, width * height)

    def beams(self, scans: Sequence[int]) -> tuple[F64, F64, F64]:
        """Of the beams that end somewhere: where they begin, BEFORE_END_M before their end, and their end, (N, 2)."""
        origins, earlies, ends = [], [], []
        robot_from_laser = Pose2(*self.log.robot_from_laser)
        for k in scans:
            scan, pose = self.scans[k], Pose2(*self.poses[k]) @ robot_from_laser
            hit = np.isfinite(scan.range_m)
            length, bearing = scan.range_m[hit, None], pose.yaw_rad + scan.bearing_rad[hit]
            way = np.stack((np.cos(bearing), np.sin(bearing)), axis=-1)
            origin = np.broadcast_to([pose.x_m, pose.y_m], way.shape)
            origins.append(origin)
            earlies.append(origin + way * np.maximum(length - BEFORE_END_M, 0.0))
            ends.append(origin + way * length)
        return np.concatenate(origins), np.concatenate(earlies), np.concatenate(ends)


def _on_the_way(scans: Sequence[LogScan], way: F64, every: int) -> tuple[Sequence[LogScan], F64]:
    """Every n-th of the scans at a stamp of the way (N, 4), and the poses (M, 3) there."""
    stamps = np.array([scan.stamp_s for scan in scans])
    nearest = np.abs(way[:, 0, None] - stamps).argmin(axis=1)
    same = np.flatnonzero(np.abs(stamps[nearest] - way[:, 0]) < SAME_S)[::every]
    return [scans[k] for k in nearest[same]], way[same, 1:]


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


def _greedy(near_first: Any, near: Any, first: Any, cells: Any, count: int) -> Drawn:
    beams = len(first) - 1
    steps = np.zeros((count, 2), dtype=np.int64)
    steps = steps[: _choose(*_by_cell(near_first, near, count), *_by_cell(first, cells, count), beams, steps)]
    share = 100.0 * steps / beams
    found: Drawn = []
    for early in (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0):
        last = int(np.searchsorted(share[:, 1], early, side="right")) - 1
        found.append((early, float(share[last, 0]), float(share[last, 1])))
    return found


def picture(curves: dict[str, dict[str, Drawn]], piece: tuple[I8, I8] | None, out: Path) -> None:
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
    axes[0].set_xlabel("held-back beams in a wall 20 cm before their end, %")
    axes[0].set_ylabel("held-back end points within 10 cm of a wall, %")
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
    parser.add_argument("--from", nargs="+", type=int, default=[0], choices=range(EVERY), dest="firsts", metavar="N")
    parser.add_argument("--control", action="store_true", help="also Intel and fr079")
    parser.add_argument("--bound", action="store_true", help="also what knowing the judge would give")
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    data = Path(os.environ["UMFELD_DATA"])
    paths = {name: data / f"known_pose_logs/{name}-corrected.log.gz" for name in asked.only}
    if asked.control:
        paths |= {name: data / f"carmen_logs/{name}.clf.gz" for name in CONTROL}
    curves: dict[str, dict[str, Drawn]] = {}
    piece = None
    for name, path in paths.items():
        rows: dict[str, list[Curve]] = {"counted": [], "found": []}
        for first in asked.firsts:
            way = data / f"carmen_logs/{name}.gfs.txt.gz" if name in CONTROL else None
            trial = Trial(path, first=first, every=CONTROL.get(name, 1), way=way)
            before = trial.piece() if name == LOGS[0] else None
            found, after = trial.as_found((DEFAULT_ENDS,) if name in CONTROL else ENDS_PER_PASS)
            rows["found"].append(found)
            rows["counted"].append(trial.as_counted((DEFAULT_PERCENT,) if name in CONTROL else PERCENT))
            if before is not None and first == asked.firsts[0]:
                piece = (before, after)
        for kind, each in rows.items():
            mean = np.mean(each, axis=0)
            print(f"{name} {kind}: parameter, near middle in out; held back from {asked.firsts}")
            for value, *figures in mean.tolist():
                print(f"    {value:6g}  " + "  ".join(f"{figure:6.2f}" for figure in figures))
            curves.setdefault(name, {})[kind] = [(row[0], row[1], row[3]) for row in mean.tolist()]
        if asked.bound and name in LOGS:
            curves[name]["bound"] = trial.bound()
            print(
                f"{name} bound: " + "  ".join(f"{near:.1f} / {early:.1f}" for _, near, early in curves[name]["bound"])
            )
    if asked.picture is not None:
        picture({name: kinds for name, kinds in curves.items() if name in LOGS}, piece, asked.picture)


if __name__ == "__main__":
    main()
