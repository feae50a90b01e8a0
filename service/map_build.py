"""`umfeld map build`: a recorded log becomes a map, offline, as fast as this machine goes.

    trajectory.tum   stamp x y z qx qy qz qw of the robot, a line for every scan, stamps as the log writes them
    map.pgm map.yaml map.png    the occupancy grid, as map servers read it, and to look at; its walls are found in
                     all scans together (mapping.grids.walls)
    lines.geojson    the walls as lines, of scans 20 cm or 10 degrees apart
    map.umfeld       the store, which `umfeld run` and `umfeld map load` take
    report.json      counts, timings, memory; with hold_out also how well scans that were left out fit

Two figures judge a grid without knowing the truth (hold_out): of the end points of scans that were not inserted, the
share within 10 cm of an occupied cell, which is a square; of their beams, the share that is in an occupied cell more
than 20 cm before its end.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.logs import Log, LogError, LogScan, PoseKind
from mapping.frames import Pose2, wrap_angle
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.patch import GridPatch
from mapping.grids.walls import BeamCounts, EndTiles
from mapping.lines.line_map import LineMap
from service.errors import WrongUsage
from service.export import image_of, save_grid, save_pgm_yaml
from service.files import write_whole
from service.line_files import write_lines
from service.log_lines import line_map_of
from service.map_export import LINES, lines_layer
from service.map_import import write_grid_map
from service.recording_log import read_any_log
from service.resident import give_back_code, give_back_heap, peak_bytes

F64 = NDArray[np.float64]
Progress = Callable[[int, int], None]

OCCUPIED_FROM_PERCENT = 65  # as map servers read a map: occupied_thresh 0.65
NEAR_M = 0.10
BEFORE_END_M = 0.20
LIGHTER_AT = (4, 40, 160)  # calls of progress: when kernels of the first scans are loaded, of closures, of all
LIGHTER_EVERY = 80
TRIMMED_EVERY = 20  # calls of progress
APART_M, APART_RAD = 0.2, math.radians(10.0)  # of scans that add lines: more of them add little


class PoseSource(StrEnum):
    """Where the robot's poses come from."""

    SLAM = "slam"
    LOG = "log"
    ODOMETRY = "odometry"


@dataclass(frozen=True, slots=True)
class HoldOut:
    """How scans that were not inserted fit the grid. Shares in [0, 1]; beams without echo are not judged.

    near_occupied: of end points, with NEAR_M or less from there to the nearest point of an occupied cell.
    near_middle: so much between the middles of the cell that they lie in and of an occupied one, which is stricter.
    crossing_early: of beams, with a point in an occupied cell and BEFORE_END_M or more from there to their end.
    """

    scans: int
    end_points: int
    near_occupied: float
    near_middle: float
    crossing_early: float


@dataclass(frozen=True, slots=True)
class Walls:
    """What `find_walls` changed: cells that it called occupied, and occupied ones that it left undecided."""

    cells: int
    added: int
    undecided: int


@dataclass(frozen=True, slots=True)
class Built:
    """A finished map. robot_poses: (N, 3) x, y, yaw in the map frame, one a scan.  slam: figures of SLAM, if it ran."""

    log: Log
    scans: Sequence[LogScan]
    robot_poses: F64
    grid: OccupancyGrid
    line_map: LineMap
    inserted: int
    hold_out: HoldOut | None
    seconds: dict[str, float]
    walls: Walls | None = None
    slam: dict[str, object] | None = None


def build(
    path: Path,
    *,
    poses: PoseSource,
    every: int = 1,
    hold_out: int = 0,
    resolution_m: float = 0.05,
    model: str = "log-odds",
    crisp: bool = True,
    progress: Progress | None = None,
) -> Built:
    """Read a log and make its map.

    every: use only every N-th scan.  hold_out: of those, keep every N-th back, from the first on, and judge the grid by
    them; 0 inserts all.  crisp: find walls in all scans together (mapping.grids.walls), else cell by cell.
    Raises WrongUsage if the log is none, is empty, or has no poses of that source.
    """
    started = time.monotonic()
    try:
        log = read_any_log(path)
    except (LogError, OSError) as error:
        raise WrongUsage(str(error)) from error
    scans = log.scans[::every]
    if not scans:
        raise WrongUsage(f"{path}: holds no laser scan")
    give_back_heap()  # what was read line by line
    read = time.monotonic()
    slam: dict[str, object] | None = None
    if poses is PoseSource.SLAM:
        from service.slam_log import run_slam

        run = run_slam(log, scans, progress=_Lighter(progress))
        robot_poses, slam = run.robot_poses, run.figures
        del run  # and with it the views of all key scans
        give_back_heap()
    else:
        robot_poses = poses_from_log(log, scans, poses)
    localised = time.monotonic()
    grid = OccupancyGrid(resolution_m=resolution_m, model="counters" if model == "counters" else "log-odds")
    held = set(range(0, len(scans), hold_out)) if hold_out else set()
    insert_scans(grid, log, scans, robot_poses, left_out=held, progress=_Lighter(progress))
    walls = find_walls(grid, log, scans, robot_poses, left_out=held) if crisp else None
    mapped = time.monotonic()
    line_map = lines_of(log, scans, robot_poses, left_out=held)
    lined = time.monotonic()
    judged = judge(grid.patch(), log, [scans[i] for i in sorted(held)], robot_poses[sorted(held)]) if held else None
    return Built(
        log, scans, robot_poses, grid, line_map, len(scans) - len(held), judged,
        {"read": read - started, "localise": localised - read, "map": mapped - localised, "lines": lined - mapped},
        walls, slam,
    )  # fmt: skip


class _Lighter:
    """Hands progress on, and gives back what loading kernels left in memory, some 70 MB, once they are loaded."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress, self._calls = progress, 0

    def __call__(self, done: int, total: int) -> None:
        self._calls += 1
        if self._calls in LIGHTER_AT or self._calls % LIGHTER_EVERY == 0:
            give_back_code()
        if self._calls % TRIMMED_EVERY == 0:
            give_back_heap()  # what optimising the graph took
        if self._progress is not None:
            self._progress(done, total)


def poses_from_log(log: Log, scans: Sequence[LogScan], source: PoseSource) -> F64:
    """Robot poses (N, 3) of scans as the log has them; WrongUsage if the log has none of that source."""
    if source is PoseSource.ODOMETRY and log.poses is PoseKind.CORRECTED:
        raise WrongUsage(f"{log.provenance.path}: its poses are corrected ones, not odometry: use --poses log")
    return np.array([scan.robot_pose for scan in scans], dtype=np.float64)


def insert_scans(
    grid: OccupancyGrid,
    log: Log,
    scans: Sequence[LogScan],
    robot_poses: F64,
    *,
    left_out: set[int],
    progress: Progress | None = None,
) -> None:
    """Put scans into a grid, but those whose index is in left_out."""
    robot_from_laser = Pose2(*log.robot_from_laser)
    for index, (scan, pose) in enumerate(zip(scans, robot_poses)):
        if index not in left_out:
            map_from_laser = Pose2(*pose) @ robot_from_laser
            # A log's "no echo" may be glass or a dark surface as well as nothing: it proves no free space.
            grid.insert_scan(
                map_from_laser, scan.bearing_rad, scan.range_m, range_max_m=log.range_max_m, clear_no_return=False
            )
        if progress is not None and index % 64 == 0:
            progress(index, len(scans))


def find_walls(
    grid: OccupancyGrid, log: Log, scans: Sequence[LogScan], robot_poses: F64, *, left_out: set[int]
) -> Walls:
    """Let a grid that holds these scans call occupied what explains their ends best, and nothing else."""
    robot_from_laser = Pose2(*log.robot_from_laser)
    ends = EndTiles(grid)

    def add_all(to: EndTiles | BeamCounts) -> None:
        for index, (scan, pose) in enumerate(zip(scans, robot_poses)):
            if index not in left_out:
                map_from_laser = Pose2(*pose) @ robot_from_laser
                to.add(map_from_laser, scan.bearing_rad, scan.range_m, range_max_m=log.range_max_m)

    add_all(ends)
    counts = BeamCounts(grid, ends.places())
    add_all(counts)
    cells = counts.walls()
    added, undecided = grid.call_occupied(cells)
    return Walls(len(cells), added, undecided)


def lines_of(log: Log, scans: Sequence[LogScan], robot_poses: F64, *, left_out: set[int]) -> LineMap:
    """Walls of scans whose robot stood APART_M or APART_RAD from the one before."""
    robot_from_laser = Pose2(*log.robot_from_laser)
    chosen: list[int] = []
    for index, pose in enumerate(robot_poses):
        if index in left_out:
            continue
        way = np.abs(pose - robot_poses[chosen[-1]]) if chosen else np.full(3, np.inf)
        if math.hypot(way[0], way[1]) >= APART_M or abs(wrap_angle(float(way[2]))) >= APART_RAD:
            chosen.append(index)
    poses = [Pose2(*robot_poses[index]) @ robot_from_laser for index in chosen]
    line_map, _ = line_map_of([scans[index] for index in chosen], poses, range_max_m=log.range_max_m)
    return line_map


def judge(patch: GridPatch, log: Log, scans: Sequence[LogScan], robot_poses: F64) -> HoldOut:
    """Hold scans against a grid they are not in."""
    distance_m = _distance_to(patch.cells >= OCCUPIED_FROM_PERCENT) * patch.resolution_m
    robot_from_laser = Pose2(*log.robot_from_laser)
    ends = near = near_middle = early = 0
    for scan, pose in zip(scans, robot_poses):
        map_from_laser = Pose2(*pose) @ robot_from_laser
        hit = np.isfinite(scan.range_m)
        reach = scan.range_m[hit]
        bearing = scan.bearing_rad[hit] + map_from_laser.yaw_rad
        direction = np.stack((np.cos(bearing), np.sin(bearing)), axis=-1)
        origin = np.array([map_from_laser.x_m, map_from_laser.y_m])
        ends += len(reach)
        end = origin + reach[:, None] * direction
        near += int(np.sum(_are_near(patch, end)))
        near_middle += int(np.sum(_at(distance_m, patch, end, np.inf) <= NEAR_M))
        early += sum(_crosses(distance_m, patch, origin, d, r - BEFORE_END_M) for d, r in zip(direction, reach))
    near_share, middle_share, early_share = (count / max(ends, 1) for count in (near, near_middle, early))
    return HoldOut(len(scans), ends, near_share, middle_share, early_share)


def _distance_to(occupied: NDArray[np.bool_]) -> F64:
    """Distances between middles of cells, in cells, to the nearest occupied one; infinite if there is none."""
    from scipy.ndimage import distance_transform_edt

    if not occupied.any():
        return np.full(occupied.shape, np.inf)
    return np.asarray(distance_transform_edt(~occupied))


def _are_near(patch: GridPatch, points: F64) -> NDArray[np.bool_]:
    """Whether points (N, 2) have an occupied cell within NEAR_M: its nearest point, not its middle."""
    at = points / patch.resolution_m
    reach = NEAR_M / patch.resolution_m
    around = np.arange(-math.ceil(reach), math.ceil(reach) + 1)
    offsets = np.stack(np.meshgrid(around, around), axis=-1).reshape(-1, 1, 2)
    low = np.floor(at) + offsets  # (K, N, 2)
    away = np.maximum(np.maximum(low - at, at - (low + 1.0)), 0.0)
    cells = low.astype(np.int64) - (patch.col0, patch.row0)
    inside = np.all((cells >= 0) & (cells < patch.cells.shape[::-1]), axis=-1)
    cells[~inside] = 0
    occupied = inside & (patch.cells[cells[..., 1], cells[..., 0]] >= OCCUPIED_FROM_PERCENT)
    return np.asarray(np.any(occupied & (np.hypot(*np.moveaxis(away, -1, 0)) <= reach), axis=0))


def _at(values: F64, patch: GridPatch, points: F64, outside: float) -> F64:
    """Values (N,) of the cells under points (N, 2)."""
    cells = np.floor(points / patch.resolution_m).astype(np.int64) - (patch.col0, patch.row0)
    inside = np.all((cells >= 0) & (cells < (values.shape[1], values.shape[0])), axis=1)
    found = np.full(len(points), outside)
    found[inside] = values[cells[inside, 1], cells[inside, 0]]
    return found


def _crosses(distance_m: F64, patch: GridPatch, origin: F64, direction: F64, length_m: float) -> bool:
    """Whether a beam meets an occupied cell within length_m; exact walk through the cells it crosses."""
    if length_m <= 0.0:
        return False
    r = patch.resolution_m
    cuts = [np.zeros(1)]
    for axis in (0, 1):
        if direction[axis] != 0.0:
            first, last = sorted((origin[axis], origin[axis] + length_m * direction[axis]))
            borders = np.arange(math.ceil(first / r), math.floor(last / r) + 1) * r
            cuts.append((borders - origin[axis]) / direction[axis])
    at = np.sort(np.concatenate([*cuts, np.array([length_m])]))
    middle = (at[:-1] + at[1:]) / 2.0
    points = origin + middle[:, None] * direction
    return bool(np.any(_at(distance_m, patch, points, np.inf) == 0.0))


def write(built: Built, out: Path, *, source: PoseSource) -> dict[str, object]:
    """Write everything into the folder `out` (made if absent); returns the report."""
    started = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    patch = built.grid.patch()
    write_whole(out / "trajectory.tum", trajectory_text(built).encode())
    receipts = save_pgm_yaml(image_of(patch), out / "map.yaml")
    receipts += save_grid(image_of(patch), out / "map.png")
    receipts.append(write_lines(built.line_map.lines(min_seen=2), out / "lines.geojson"))
    receipts.append(
        write_grid_map(
            built.grid,
            out / "map.umfeld",
            source=built.log.provenance.path,
            layers={LINES: lines_layer(built.line_map)},
        )
    )
    built.seconds["write"] = time.monotonic() - started
    report = report_of(built, patch, source)
    report["files"] = {receipt.path.name: receipt.document() for receipt in receipts}
    write_whole(out / "report.json", (json.dumps(report, indent=2) + "\n").encode())
    return report


def trajectory_text(built: Built) -> str:
    """The TUM form: stamp x y z qx qy qz qw. Stamps are the log's own text, so that relations find them."""
    lines = [
        f"{scan.stamp_text} {x:.9f} {y:.9f} 0 0 0 {math.sin(yaw / 2.0):.12f} {math.cos(yaw / 2.0):.12f}\n"
        for scan, (x, y, yaw) in zip(built.scans, built.robot_poses)
    ]
    return "".join(lines)


def report_of(built: Built, patch: GridPatch, source: PoseSource) -> dict[str, object]:
    """Counts, timings, memory, and the judgement of held-out scans."""
    provenance = built.log.provenance
    area = patch.resolution_m**2
    occupied = sum(int(np.count_nonzero(row >= OCCUPIED_FROM_PERCENT)) for row in patch.cells)
    free = sum(int(np.count_nonzero(row >= 0)) for row in patch.cells) - occupied
    report: dict[str, object] = {
        "log": {"path": provenance.path, "dialect": provenance.dialect, "sha256": provenance.sha256},
        "poses": source.value,
        "scans": len(built.scans),
        "inserted": built.inserted,
        "duration_s": built.log.duration_s,
        "path_m": float(np.hypot(*np.diff(built.robot_poses[:, :2], axis=0).T).sum()),
        "skipped_lines": built.log.skipped,
        "stamps_repaired": built.log.stamps_repaired,
        "stamps_made_up": built.log.stamps_made_up,
        "resolution_m": patch.resolution_m,
        "cells": {"rows": patch.cells.shape[0], "columns": patch.cells.shape[1]},
        "free_m2": float(free * area),
        "occupied_m2": float(occupied * area),
        "lines": len(built.line_map.lines(min_seen=2)),
        "refused_tiles": built.grid.refused_tiles,
        "seconds": {name: round(value, 3) for name, value in built.seconds.items()},
        "peak_memory_mb": round(peak_bytes() / 2**20, 1),
    }
    if built.walls is not None:
        report["walls"] = {
            "cells": built.walls.cells,
            "added": built.walls.added,
            "undecided": built.walls.undecided,
        }
    if built.slam is not None:
        report["slam"] = built.slam
    if built.hold_out is not None:
        report["hold_out"] = {
            "scans": built.hold_out.scans,
            "end_points": built.hold_out.end_points,
            "near_occupied": round(built.hold_out.near_occupied, 5),
            "near_middle": round(built.hold_out.near_middle, 5),
            "crossing_early": round(built.hold_out.crossing_early, 5),
        }
    return report
