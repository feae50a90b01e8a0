"""Insertion of 1081-beam scans into a 5 cm grid: ours, a numpy-only form of the same update, and MRPT, in one run.

    python bench/grid_insert.py [--rounds N] [--json FILE]

The scans are those of a 270 degree, 0.25 degree, 30 m laser on a drive through an office of corridors and furnished
rooms and through a hall with pillars, made by ray casting with a fixed seed. Every contender gets the same scans in
the same order; rounds take turns, so that a busy minute hits all of them. Figures are microseconds a scan, with what
the caller pays on top of the kernel. MRPT is compiled here from bench/mrpt_insert.cpp if libmrpt-maps-dev is there.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.frames import Pose2
from mapping.grids.beam_model import beams_of_scan
from mapping.grids.occupancy import OccupancyGrid
from mapping.scan import Scan

F64 = NDArray[np.float64]

BEAMS = 1081
FIRST_RAD, STEP_RAD = math.radians(-135.0), math.radians(0.25)
RANGE_MAX_M = 30.0
CELL_M = 0.05
EXTENT_M = 64.0
NOISE_M = 0.01
BEARING_RAD: F64 = FIRST_RAD + STEP_RAD * np.arange(BEAMS, dtype=np.float64)
MRPT_HEADER = Path("/usr/include/mrpt/maps/include/mrpt/maps/COccupancyGridMap2D.h")
MRPT_PARTS = (
    *("maps", "obs", "poses", "math", "serialization", "rtti", "typemeta", "core", "containers", "config"),
    *("img", "system", "opengl", "bayes", "tfest", "io", "random", "graphs", "expr"),
)


# ---------------------------------------------------------------------------------------------------------- the scans


def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    """Four walls."""
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


def office(rng: np.random.Generator) -> tuple[F64, list[tuple[float, float]]]:
    """Walls (N, 4) of two rows of rooms along a corridor, and the places of a drive through them."""
    walls = box(-18.0, -8.0, 18.0, 8.0)
    places: list[tuple[float, float]] = []
    for side in (-1.0, 1.0):
        for k in range(6):
            x0 = -18.0 + 6.0 * k
            door = x0 + rng.uniform(1.0, 4.0)
            walls += [(x0, side, door, side), (door + 0.9, side, x0 + 6.0, side), (x0, side, x0, 8.0 * side)]
            for _ in range(9):
                x, y = rng.uniform(x0 + 0.3, x0 + 5.0), side * rng.uniform(2.0, 7.2)
                w, h = rng.uniform(0.05, 0.7, 2)
                if not (x - 0.5 < x0 + 3.0 < x + w + 0.5 and y - 0.5 < 3.6 * side < y + h + 0.5):
                    walls += box(x, y, x + w, y + h)
            places += [(x0 + 3.0, 3.6 * side), (x0 + 3.0, 0.2 * side)]
    return np.array(walls), places


def hall(rng: np.random.Generator) -> tuple[F64, list[tuple[float, float]]]:
    """A 46 m x 40 m hall with two rows of pillars, and a drive along its middle."""
    walls = box(-23.0, -20.0, 23.0, 20.0)
    for x in range(-20, 25, 8):
        for y in (-12.0, 12.0):
            walls += box(x - 0.3, y - 0.3, x + 0.3, y + 0.3)
    places = [(float(x), float(rng.uniform(-2.0, 2.0))) for x in np.linspace(-12.0, 12.0, 24)]
    return np.array(walls), places


def cast(walls: F64, x: float, y: float, bearing_rad: F64) -> F64:
    """(N,) distance to the nearest wall along each bearing, +inf beyond the laser's range."""
    nearest = np.full(bearing_rad.size, np.inf)
    dx, dy = np.cos(bearing_rad), np.sin(bearing_rad)
    for ax, ay, bx, by in walls:
        ex, ey = bx - ax, by - ay
        cross = dx * ey - dy * ex
        cross = np.where(np.abs(cross) < 1e-12, np.nan, cross)
        along = ((ax - x) * ey - (ay - y) * ex) / cross
        across = ((ax - x) * dy - (ay - y) * dx) / cross
        hit = (along > 0.0) & (across >= 0.0) & (across <= 1.0)
        nearest = np.where(hit & (along < nearest), along, nearest)
    return np.where(nearest > RANGE_MAX_M, np.inf, nearest)


def drive(name: str) -> list[tuple[Pose2, F64]]:
    """(pose, ranges) of 24 scans in one of the two places."""
    rng = np.random.default_rng(20 if name == "office" else 21)
    walls, places = office(rng) if name == "office" else hall(rng)
    scans = []
    for x, y in places:
        pose = Pose2(x + rng.uniform(-0.1, 0.1), y + rng.uniform(-0.1, 0.1), rng.uniform(-math.pi, math.pi))
        ranges = cast(walls, pose.x_m, pose.y_m, BEARING_RAD + pose.yaw_rad) + rng.normal(0.0, NOISE_M, BEAMS)
        scans.append((pose, ranges))
    return scans


# ----------------------------------------------------------------------------------------------------- the contenders


class NumpyGrid:
    """The update in numpy alone: beams sampled at half a cell, cells marked in a rectangle, then counted."""

    def __init__(self) -> None:
        side = round(2 * EXTENT_M / CELL_M)
        self.hits, self.misses = np.zeros((side, side), np.uint8), np.zeros((side, side), np.uint8)
        self.marked = np.zeros((side, side), np.bool_)

    def insert(self, pose: Pose2, ranges: F64) -> None:
        bearing = BEARING_RAD + pose.yaw_rad
        length = np.minimum(ranges, RANGE_MAX_M)
        steps = np.arange(0.0, float(length.max()), CELL_M / 2)
        along, beam = np.nonzero(steps[:, None] < length)
        row, col = self._cells(pose, steps[along], bearing[beam])
        seen = np.isfinite(ranges)
        hit_row, hit_col = self._cells(pose, ranges[seen], bearing[seen])
        self.marked[row, col] = True
        self.marked[hit_row, hit_col] = False
        part = np.s_[row.min() : row.max() + 1, col.min() : col.max() + 1]
        self._count(self.misses[part], self.hits[part], self.marked[part])
        self.marked[part] = False
        self.marked[hit_row, hit_col] = True
        part = np.s_[hit_row.min() : hit_row.max() + 1, hit_col.min() : hit_col.max() + 1]
        self._count(self.hits[part], self.misses[part], self.marked[part])
        self.marked[hit_row, hit_col] = False

    def _count(self, counts: NDArray[np.uint8], other: NDArray[np.uint8], marked: NDArray[np.bool_]) -> None:
        full = marked & (counts >= 64)
        counts[full] >>= 1
        other[full] >>= 1
        counts += marked

    def _cells(self, pose: Pose2, length: F64, bearing: F64) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        col = np.floor((pose.x_m + length * np.cos(bearing) + EXTENT_M) / CELL_M).astype(np.int64)
        row = np.floor((pose.y_m + length * np.sin(bearing) + EXTENT_M) / CELL_M).astype(np.int64)
        return row, col


def ours(**options: str) -> Callable[[Pose2, F64], None]:
    """Our grid; fill="lines" or "wedges", model as OccupancyGrid."""
    grid = OccupancyGrid(resolution_m=CELL_M, model="log-odds" if options.get("model") == "log-odds" else "counters")
    if options.get("fill") == "lines":
        return lambda pose, ranges: grid.insert_scan(
            pose, BEARING_RAD, ranges, range_max_m=RANGE_MAX_M, fill="lines"
        )  # fmt: skip
    return lambda pose, ranges: grid.insert_scan(pose, BEARING_RAD, ranges, range_max_m=RANGE_MAX_M)


def ours_moving() -> Callable[[Pose2, F64], None]:
    """Our grid, de-skewed: each beam from its own pose, at 0.5 m/s and 0.5 rad/s in a sweep of 25 ms."""
    grid = OccupancyGrid(resolution_m=CELL_M)
    passed_s = np.linspace(-0.0125, 0.0125, BEAMS)

    def insert(pose: Pose2, ranges: F64) -> None:
        way = 0.5 * passed_s
        poses = np.stack(
            (
                pose.x_m + way * math.cos(pose.yaw_rad),
                pose.y_m + way * math.sin(pose.yaw_rad),
                pose.yaw_rad + 0.5 * passed_s,
            ),
            axis=-1,
        )
        scan = Scan(0, 2.3e4, BEARING_RAD, ranges, 0.1, RANGE_MAX_M)
        grid.insert_beams(beams_of_scan(scan, poses))

    return insert


@dataclass
class Contender:
    """One row of the table."""

    name: str
    round_us: Callable[[list[tuple[Pose2, F64]]], list[float]]
    times_us: dict[str, list[float]] = field(default_factory=lambda: {"office": [], "hall": []})


def timed(insert: Callable[[Pose2, F64], None]) -> Callable[[list[tuple[Pose2, F64]]], list[float]]:
    """Microseconds of each scan of a round."""

    def round_us(scans: list[tuple[Pose2, F64]]) -> list[float]:
        times = []
        for pose, ranges in scans:
            before = time.perf_counter_ns()
            insert(pose, ranges)
            times.append((time.perf_counter_ns() - before) / 1e3)
        return times

    return round_us


def mrpt(folder: Path) -> tuple[Contender | None, str]:
    """MRPT, compiled in a folder; or None and why not."""
    source = Path(__file__).with_name("mrpt_insert.cpp")
    if not MRPT_HEADER.exists():
        return None, "MRPT is left out: apt install libmrpt-maps-dev"
    if shutil.which("g++") is None:
        return None, "MRPT is left out: no g++"
    program = folder / "mrpt_insert"
    includes = [f"-I/usr/include/mrpt/{part}/include" for part in MRPT_PARTS] + ["-I/usr/include/eigen3"]
    libraries = [f"-lmrpt-{part}" for part in ("maps", "obs", "poses", "math", "system", "core")]
    built = subprocess.run(
        ["g++", "-O3", "-DNDEBUG", "-std=c++17", *includes, str(source), "-o", str(program), *libraries],
        capture_output=True,
        text=True,
    )
    if built.returncode != 0:
        return None, "MRPT is left out, it did not compile:\n" + "\n".join(built.stderr.splitlines()[:6])

    def round_us(scans: list[tuple[Pose2, F64]]) -> list[float]:
        file = folder / "scans.bin"
        file.write_bytes(scans_as_bytes(scans))
        said = subprocess.run([str(program), str(file), "1"], capture_output=True, text=True, check=True)
        return [float(line) for line in said.stdout.split()]

    return Contender("MRPT COccupancyGridMap2D (C++)", round_us), ""


def scans_as_bytes(scans: list[tuple[Pose2, F64]]) -> bytes:
    """As bench/mrpt_insert.cpp reads them."""
    head = struct.pack("<ii5d", len(scans), BEAMS, FIRST_RAD, STEP_RAD, RANGE_MAX_M, CELL_M, EXTENT_M)
    bodies = (struct.pack("<3d", p.x_m, p.y_m, p.yaw_rad) + r.astype("<f4").tobytes() for p, r in scans)
    return head + b"".join(bodies)


# --------------------------------------------------------------------------------------------------------- the figures


def measure(contenders: Iterable[Contender], rounds: int) -> dict[str, object]:
    """Rounds in turn; the first of each contender and place warms up and is dropped."""
    places = {name: drive(name) for name in ("office", "hall")}
    everyone = list(contenders)
    for number in range(rounds + 1):
        for place, scans in places.items():
            for contender in everyone:
                if "numpy" in contender.name and number > 2:
                    continue
                times = contender.round_us(scans)
                if number > 0:
                    contender.times_us[place] += times
    mean_m = {
        place: float(np.mean(np.concatenate([r[np.isfinite(r)] for _, r in scans]))) for place, scans in places.items()
    }
    rows = []
    for contender in everyone:
        row: dict[str, object] = {"name": contender.name}
        for place, times in contender.times_us.items():
            low, middle, high = np.percentile(times, [10, 50, 90])
            row[place] = {"median_us": round(middle, 1), "p10_us": round(low, 1), "p90_us": round(high, 1)}
        rows.append(row)
    return {"beams": BEAMS, "cell_m": CELL_M, "rounds": rounds, "mean_range_m": mean_m, "rows": rows}


def median_of(report: dict[str, object], name: str, place: str) -> float | None:
    """One figure of a report, None if that contender did not take part."""
    rows = report["rows"]
    assert isinstance(rows, list)
    for row in rows:
        if str(row["name"]).startswith(name):
            return float(row[place]["median_us"])
    return None


def table(report: dict[str, object]) -> str:
    """The report for people."""
    rows, means = report["rows"], report["mean_range_m"]
    assert isinstance(rows, list)
    assert isinstance(means, dict)
    heads = [f"{place} (mean {metres:.1f} m)" for place, metres in means.items()]
    lines = [f"{'microseconds a scan: median (p10 to p90)':44}" + "".join(f"{head:>28}" for head in heads)]
    for row in rows:
        figures = [row[place] for place in means]
        cells = [f"{f['median_us']:.0f} ({f['p10_us']:.0f} to {f['p90_us']:.0f})" for f in figures]
        lines.append(f"{row['name']:44}" + "".join(f"{cell:>28}" for cell in cells))
    for place in means:
        mine, theirs = median_of(report, "ours, wedges", place), median_of(report, "MRPT", place)
        if mine is not None and theirs is not None:
            lines.append(f"{place}: {theirs / mine:.1f} times as fast as MRPT")
    return "\n".join(lines)


def main() -> int:
    """Run, print, and say with the exit code whether the goal was met (MRPT: only if it took part)."""
    parser = argparse.ArgumentParser(description="Grid insertion beside its peers.")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    options = parser.parse_args()
    contenders = [
        Contender("ours, wedges (the default)", timed(ours())),
        Contender("ours, wedges, log-odds", timed(ours(model="log-odds"))),
        Contender("ours, wedges, de-skewed beams", timed(ours_moving())),
        Contender("ours, lines (walking)", timed(ours(fill="lines"))),
        Contender("numpy alone", timed(NumpyGrid().insert)),
    ]
    with tempfile.TemporaryDirectory() as folder:
        peer, why_not = mrpt(Path(folder))
        if peer is not None:
            contenders.append(peer)
        report = measure(contenders, options.rounds)
    print(table(report))
    if why_not:
        print(why_not)
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    mine, theirs = median_of(report, "ours, wedges", "office"), median_of(report, "MRPT", "office")
    assert mine is not None
    return 0 if mine <= 160.0 and (theirs is None or theirs >= 1.5 * mine) else 1


if __name__ == "__main__":
    sys.exit(main())
