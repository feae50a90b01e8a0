"""The octree (S32) beside OctoMap: insertion, memory, queries, bytes, for the same clouds at the same resolution.

    python bench/octree.py [--rounds N] [--resolutions-m M ...] [--json FILE] [--data FOLDER]

The clouds: eight scans of 92,000 points in a furnished room of 8 m x 6 m x 2.7 m, ray casting with a fixed seed, 8 mm
of noise; with --data (or UMFELD_DATA) also recorded ones: a room, a corridor, a depth camera's frames. OctoMap is
compiled here from bench/octomap_insert.cpp if liboctomap-dev is there, and gets the clouds in the same rounds. Its
values are compared with ours voxel by voxel. Times are processor time of the one thread that each of them uses, as the
machine may have other work. Exit code 1 if a goal is missed: 5 times as fast, half of the memory.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.grids.octree import Octree

F64 = NDArray[np.float64]
Clouds = list[tuple[F64, F64]]

HEADER = Path("/usr/include/octomap/octomap.h")
QUERIES = 200_000
SPEED_GOAL, MEMORY_GOAL = 5.0, 0.5


# --------------------------------------------------------------------------------------------------------- the clouds


def boxes(rng: np.random.Generator) -> F64:
    """(N, 6) lower and upper corners: the room itself first, then what stands in it."""
    room = [(-4.0, -3.0, 0.0, 4.0, 3.0, 2.7)]
    for _ in range(24):
        x, y = rng.uniform(-3.8, 3.2), rng.uniform(-2.8, 2.2)
        w, d, h = rng.uniform(0.2, 0.9), rng.uniform(0.2, 0.6), rng.uniform(0.3, 1.9)
        if not (max(x, -x - w, y, -y - d) < 1.2):
            room.append((x, y, 0.0, x + w, y + d, h))
    return np.array(room)


def scan_of(walls: F64, origin: F64, count: int, rng: np.random.Generator) -> F64:
    """(count, 3) first points that rays in all directions meet, with noise along them."""
    z = rng.uniform(-1.0, 1.0, count)
    turn = rng.uniform(-math.pi, math.pi, count)
    level = np.sqrt(1.0 - z * z)
    way = np.stack((level * np.cos(turn), level * np.sin(turn), z), axis=-1)
    with np.errstate(divide="ignore"):
        to_low = (walls[:, None, :3] - origin) / way
        to_high = (walls[:, None, 3:] - origin) / way
    enter, leave = np.minimum(to_low, to_high).max(axis=2), np.maximum(to_low, to_high).min(axis=2)
    met = (enter <= leave) & (enter > 0.0)
    met[0] = False
    nearest = np.minimum(np.where(met, enter, np.inf).min(axis=0), leave[0])  # the room is left, the others entered
    return np.asarray(origin + way * (nearest + rng.normal(0.0, 0.008, count))[:, None])


def room_clouds(scans: int = 8, points: int = 92_000) -> Clouds:
    """The made room."""
    rng = np.random.default_rng(32)
    walls = boxes(rng)
    places = [np.array([rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0), rng.uniform(0.8, 1.6)]) for _ in range(scans)]
    return [(place, scan_of(walls, place, points, rng)) for place in places]


def recorded_clouds(folder: Path) -> dict[str, Clouds]:
    """What the data folder has: a room, a corridor, frames of a depth camera."""
    from service.cloud_files import read_cloud

    found: dict[str, Clouds] = {}
    for name, file in (
        ("room_scan1", "point_clouds/room_scan1.pcd"),
        ("indoor_pair_0", "point_clouds/indoor_pair_0.xyz.gz"),
    ):
        points = read_cloud(folder / file).points_m
        found[name] = [(np.zeros(3), points[np.isfinite(points).all(axis=1)])]
    text = (folder / "depth_images/living_room.trajectory.txt").read_text().split("\n")
    frames: Clouds = []
    for k in range(5):
        pose = np.array([[float(v) for v in line.split()] for line in text[5 * k + 1 : 5 * k + 5]])
        points = read_cloud(folder / f"depth_images/living_room_{k}.png").points_m
        points = points[np.isfinite(points).all(axis=1)]
        frames.append((pose[:3, 3].copy(), points @ pose[:3, :3].T + pose[:3, 3]))
    found["living_room, 5 frames"] = frames
    return found


# ----------------------------------------------------------------------------------------------------- the contenders


@dataclass(frozen=True, slots=True)
class Figures:
    """One contender on one set of clouds at one resolution."""

    insert_ns: float
    query_ns: float
    memory_bytes: int
    leaves: int
    file_bytes: int
    log_odds: F64
    lazy_ns: float = math.nan


def ours(clouds: Clouds, resolution_m: float, queries: F64) -> Figures:
    tree = Octree(resolution_m=resolution_m)
    before = time.thread_time_ns()
    for origin, points in clouds:
        tree.insert(origin, points)
    insert_ns = (time.thread_time_ns() - before) / sum(len(points) for _, points in clouds)
    before = time.thread_time_ns()
    log_odds = tree.log_odds_at(queries)
    query_ns = (time.thread_time_ns() - before) / len(queries)
    return Figures(insert_ns, query_ns, tree.memory_bytes, tree.leaf_count(), len(tree.to_bytes()), log_odds)


class OctoMap:
    """Compiled once in a folder, then run for each measurement."""

    def __init__(self, folder: Path) -> None:
        self._file, self._program = folder / "clouds.bin", folder / "octomap_insert"
        source = Path(__file__).with_name("octomap_insert.cpp")
        subprocess.run(
            ["g++", "-O3", "-DNDEBUG", "-std=c++17", str(source), "-o", str(self._program), "-loctomap", "-loctomath"],
            check=True,
        )

    def measure(self, clouds: Clouds, resolution_m: float, queries: F64) -> Figures:
        head = struct.pack("<iid", len(clouds), len(queries), resolution_m)
        bodies = (
            struct.pack("<3di", *origin, len(points)) + points.astype("<f4").tobytes() for origin, points in clouds
        )
        self._file.write_bytes(head + b"".join(bodies) + queries.astype("<f4").tobytes())
        said = subprocess.run([str(self._program), str(self._file)], capture_output=True, text=True, check=True)
        plain, lazy, query, memory, leaves, size, *values = said.stdout.split()
        return Figures(
            float(plain), float(query), int(memory), int(leaves), int(size), np.array(values, dtype=float), float(lazy)
        )


def queries_in(clouds: Clouds, resolution_m: float, count: int) -> F64:
    """(count, 3) centres of voxels in the box of the clouds, as 4-byte numbers have them."""
    rng = np.random.default_rng(7)
    everything = np.concatenate([points for _, points in clouds])
    low, high = np.percentile(everything, 1.0, axis=0), np.percentile(everything, 99.0, axis=0)
    places = rng.uniform(low, high, (count, 3))
    return np.asarray((np.floor(places / resolution_m) + 0.5) * resolution_m)


# -------------------------------------------------------------------------------------------------------- the figures


def compare(name: str, clouds: Clouds, resolution_m: float, rounds: int, peer: OctoMap | None) -> dict[str, Any]:
    """Medians of rounds in which all contenders take turns; the first warms up."""
    queries = queries_in(clouds, resolution_m, QUERIES)
    mine, theirs = [], []
    for number in range(rounds + 1):
        figures = ours(clouds, resolution_m, queries)
        other = peer.measure(clouds, resolution_m, queries) if peer is not None else None
        if number > 0:
            mine.append(figures)
            theirs += [] if other is None else [other]
    row: dict[str, Any] = {
        "name": name,
        "resolution_m": resolution_m,
        "points": sum(len(points) for _, points in clouds),
        "ours": summary(mine),
    }
    if theirs:
        row["octomap"] = summary(theirs)
        a, b = mine[-1].log_odds, theirs[-1].log_odds
        row["same_value"] = float(np.mean((np.abs(a - b) < 0.01) | (np.isnan(a) & np.isnan(b))))
        row["free_here_not_there"] = float(np.mean((a < 0) & ~(b < 0)))
    return row


def summary(figures: list[Figures]) -> dict[str, Any]:
    last = figures[-1]
    return {
        "insert_us": round(float(np.median([f.insert_ns for f in figures])) / 1e3, 3),
        "insert_us_spread": [round(float(p) / 1e3, 3) for p in np.percentile([f.insert_ns for f in figures], [10, 90])],
        "lazy_us": round(float(np.median([f.lazy_ns for f in figures])) / 1e3, 3),
        "query_us": round(float(np.median([f.query_ns for f in figures])) / 1e3, 3),
        "memory_bytes": last.memory_bytes,
        "leaves": last.leaves,
        "bytes_per_leaf": round(last.memory_bytes / max(last.leaves, 1), 1),
        "file_bytes": last.file_bytes,
    }


def growth(rounds: int) -> list[dict[str, float]]:
    """Cost of a point for 1, 4 and 16 times the points, and for cells of a half and a quarter."""
    rows = []
    for points, resolution_m in ((5_750, 0.1), (23_000, 0.1), (92_000, 0.1), (92_000, 0.05), (92_000, 0.025)):
        clouds = room_clouds(2, points)
        best = min(ours(clouds, resolution_m, np.zeros((1, 3))).insert_ns for _ in range(rounds + 1))
        rows.append({"points": points, "resolution_m": resolution_m, "insert_us": round(best / 1e3, 3)})
    return rows


def show(rows: list[dict[str, Any]], grown: list[dict[str, float]]) -> None:
    for row in rows:
        print(f"{row['name']}, {row['points']} points, {100 * row['resolution_m']:g} cm")
        for who in ("ours", "octomap"):
            if who in row:
                f = row[who]
                low, high = f["insert_us_spread"]
                lazy = "" if math.isnan(f["lazy_us"]) else f" (lazy, one ray a voxel: {f['lazy_us']:.2f})"
                print(
                    f"  {who:8} insert {f['insert_us']:.2f} us a point ({low:.2f} to {high:.2f}){lazy}, query"
                    f" {f['query_us']:.3f} us, {f['memory_bytes'] / 1e6:.2f} MB, {f['leaves']} leaves,"
                    f" {f['bytes_per_leaf']:.1f} B a leaf, file {f['file_bytes'] / 1e3:.0f} kB"
                )
        if "octomap" in row:
            speed, memory = ratios(row)
            print(
                f"  {speed:.1f} times as fast, {memory:.2f} of the memory; of {QUERIES} voxels the same value in"
                f" {100 * row['same_value']:.2f} %, free here and not there {100 * row['free_here_not_there']:.3f} %"
            )
    for figure in grown:
        size = f"{figure['points']} points a scan, {100 * figure['resolution_m']:g} cm"
        print(f"{size}: {figure['insert_us']:.2f} us a point")


def ratios(row: dict[str, Any]) -> tuple[float, float]:
    return (
        row["octomap"]["insert_us"] / row["ours"]["insert_us"],
        row["ours"]["memory_bytes"] / row["octomap"]["memory_bytes"],
    )


def main() -> int:
    """Run, print, and say with the exit code whether the goals were met."""
    parser = argparse.ArgumentParser(description="Octree beside OctoMap.")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--resolutions-m", type=float, nargs="+", default=[0.05, 0.1, 0.2])
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    parser.add_argument("--data", type=Path, default=os.environ.get("UMFELD_DATA"), help="folder of recorded data")
    options = parser.parse_args()
    sets = {"made room, 8 scans": room_clouds()}
    if options.data is not None:
        sets |= recorded_clouds(Path(options.data))
    with tempfile.TemporaryDirectory() as folder:
        peer = OctoMap(Path(folder)) if HEADER.exists() and shutil.which("g++") else None
        rows = [
            compare(name, clouds, resolution_m, options.rounds, peer)
            for name, clouds in sets.items()
            for resolution_m in options.resolutions_m
        ]
    grown = growth(options.rounds)
    show(rows, grown)
    if peer is None:
        print("OctoMap is left out: apt install liboctomap-dev g++")
    if options.json is not None:
        options.json.write_text(json.dumps({"rows": rows, "growth": grown}, indent=2) + "\n")
    reached = [ratios(row) for row in rows if "octomap" in row]
    return 0 if all(speed >= SPEED_GOAL and memory <= MEMORY_GOAL for speed, memory in reached) else 1


if __name__ == "__main__":
    sys.exit(main())
