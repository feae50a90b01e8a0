"""Lines of 1081-beam scans: ours, and the book's steps in plain Python and numpy, in one run; and a map over runs.

    python bench/lines.py [--rounds N] [--json FILE]

Scans are those of bench/grid_insert.py (office and hall), with 8 mm of range noise. Figures:
time       microseconds a scan, from the array of ranges to lines with covariance, with what the caller pays on top
wall error mean distance of a line's ends and its middle from the wall it lies on, mean over lines, in mm
lines      a scan; in brackets those of at least 9 points and half a metre
           (a corner's point counts for one of ours, for two of the plain ones: 9 there may be 8 here)
walls      different walls a scan that the plain steps find, with 9 points and half a metre, and how many we miss
growth     time for 1, 4 and 16 times the beams in the same office
With UMFELD_DATA also the logs with known poses: see docs/algorithms/lines.md.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.grid_insert import BEARING_RAD, RANGE_MAX_M, cast, drive, hall, office
from drivers.logs import read_log
from mapping.frames import Pose2
from mapping.lines.extract import LineExtractor, LineRules
from mapping.lines.line_map import LineMap
from mapping.lines.lines import Lines, segment_distance

F64 = NDArray[np.float64]
Row = tuple[float, float, float, float]  # start and end

NOISE_M = 0.008
RULES = LineRules(sigma_m=NOISE_M)
BIG_POINTS, BIG_M = 9, 0.5
LOGS = ("seattle", "belgioioso", "acapulco")


def walls_of(place: str) -> F64:
    """The walls behind grid_insert.drive."""
    return office(np.random.default_rng(20))[0] if place == "office" else hall(np.random.default_rng(21))[0]


def scans_of(place: str, bearing: F64, noise_m: float) -> list[tuple[Pose2, F64]]:
    """(pose, ranges) of the same drive with any beams."""
    random, walls = np.random.default_rng(1), walls_of(place)
    return [
        (pose, cast(walls, pose.x_m, pose.y_m, bearing + pose.yaw_rad) + random.normal(0.0, noise_m, bearing.size))
        for pose, _ in drive(place)
    ]


def plain_lines(bearing: F64, ranges: F64, rules: LineRules) -> list[tuple[Row, int]]:
    """The book's steps with numpy, a step after the other: segments, end point fit, regression, shift. (ends, N)."""
    seen = np.isfinite(ranges)
    r, a = ranges[seen], bearing[seen]
    points = np.stack((r * np.cos(a), r * np.sin(a)), axis=-1)
    gap = np.hypot(*np.diff(points, axis=0).T)
    limit = np.maximum(rules.gap_m, rules.gap_beams * np.median(np.diff(bearing)) * np.minimum(r[:-1], r[1:]))
    found: list[tuple[Row, int]] = []
    for cluster in np.split(points, np.flatnonzero(gap >= limit) + 1):
        for part in plain_split(cluster, max(rules.split_m, rules.split_sigmas * rules.sigma_m)):
            if len(part) < rules.min_points:
                continue
            centre = part.mean(axis=0)
            u = np.linalg.svd(part - centre, full_matrices=False)[2][0]
            t = (part[[0, -1]] - centre) @ u
            if abs(t[1] - t[0]) >= rules.min_length_m:
                p, q = centre + t[0] * u, centre + t[1] * u
                found.append(((float(p[0]), float(p[1]), float(q[0]), float(q[1])), len(part)))
    return found


def plain_split(points: F64, tolerance_m: float) -> list[F64]:
    """[DH73] by recursion."""
    if len(points) < 3:
        return [points]
    way = points[-1] - points[0]
    away = points - points[0]
    h = np.abs(away[:, 1] * way[0] - away[:, 0] * way[1]) / max(float(np.hypot(*way)), 1e-9)
    at = int(np.argmax(h))
    if h[at] <= tolerance_m or at in (0, len(points) - 1):
        return [points]
    return plain_split(points[: at + 1], tolerance_m) + plain_split(points[at:], tolerance_m)


def wall_error(ends: F64, walls: F64) -> F64:
    """(K,) mean distance of both ends and the middle of lines (K, 4) from the wall that each fits best; NaN if none."""
    return np.asarray(np.nanmin(_off_walls(ends, walls), axis=1)) if len(ends) else np.empty(0)


def walls_found(ends: F64, walls: F64) -> set[int]:
    """Which walls lines (K, 4) lie on, within 5 cm: pieces of one count once."""
    off = np.nan_to_num(_off_walls(ends, walls), nan=np.inf)
    return {int(k) for k, least in zip(off.argmin(axis=1), off.min(axis=1)) if least < 0.05}


def _off_walls(ends: F64, walls: F64) -> F64:
    """(K, W) mean distance of ends and middle of lines from walls; NaN where the middle is not on the wall."""
    way = walls[:, 2:] - walls[:, :2]
    normal = np.stack((-way[:, 1], way[:, 0]), axis=-1) / np.hypot(way[:, 0], way[:, 1])[:, None]
    spots = np.stack((ends[:, :2], 0.5 * (ends[:, :2] + ends[:, 2:]), ends[:, 2:]))
    off = np.abs(np.sum((spots[:, :, None, :] - walls[:, :2]) * normal, axis=3)).mean(axis=0)
    off[segment_distance(spots[1], walls[:, :2], walls[:, 2:]) > 0.1] = np.nan
    return np.asarray(off)


def timed_us(call: Callable[[F64], object], scans: list[tuple[Pose2, F64]], rounds: int) -> list[float]:
    """Microseconds of every call; the first round warms up."""
    times = []
    for number in range(rounds + 1):
        for _, ranges in scans:
            before = time.perf_counter_ns()
            call(ranges)
            if number:
                times.append((time.perf_counter_ns() - before) / 1e3)
    return times


def place_figures(place: str, rounds: int) -> dict[str, float]:
    """One place, both ways."""
    scans, walls = scans_of(place, BEARING_RAD, NOISE_M), walls_of(place)
    extractor = LineExtractor(BEARING_RAD, RULES, range_max_m=RANGE_MAX_M)

    def with_covariance(ranges: F64) -> object:
        return extractor.extract(ranges).parameters()

    extract_us = timed_us(extractor.extract, scans, rounds)
    ours_us = timed_us(with_covariance, scans, rounds)
    plain_us = timed_us(lambda r: plain_lines(BEARING_RAD, r, RULES), scans, min(rounds, 3))
    errors: dict[str, list[F64]] = {"ours": [], "big": [], "plain": []}
    counts = dict.fromkeys(("ours", "big", "plain", "plain_big", "walls", "walls_missed"), 0)
    for pose, ranges in scans:
        lines = extractor.extract(ranges).transformed(pose)
        big = lines.chosen((lines.count >= BIG_POINTS) & (lines.length_m >= BIG_M))
        plain = plain_lines(BEARING_RAD, ranges, RULES)
        counts["ours"] += len(lines)
        counts["big"] += len(big)
        counts["plain"] += len(plain)
        counts["plain_big"] += sum(is_big(row, n) for row, n in plain)
        errors["ours"].append(wall_error(lines.rows[:, :4], walls))
        errors["big"].append(wall_error(big.rows[:, :4], walls))
        placed = big_ends(pose, plain)
        errors["plain"].append(wall_error(placed, walls))
        shown = walls_found(placed, walls)
        counts["walls"] += len(shown)
        counts["walls_missed"] += len(shown - walls_found(lines.rows[:, :4], walls))
    figures = {f"lines_{name}": round(count / len(scans), 2) for name, count in counts.items()}
    for name, parts in errors.items():
        figures[f"wall_error_{name}_mm"] = round(1e3 * float(np.nanmean(np.concatenate(parts))), 2)
    for name, times in (("extract", extract_us), ("with_covariance", ours_us), ("plain", plain_us)):
        low, middle, high = np.percentile(times, [10, 50, 90])
        figures |= {f"{name}_us": round(middle, 1), f"{name}_p10_us": round(low, 1), f"{name}_p90_us": round(high, 1)}
    return figures


def big_ends(pose: Pose2, lines: list[tuple[Row, int]]) -> F64:
    """(K, 4) ends of those lines that are big, in the map frame."""
    ends = np.array([row for row, n in lines if is_big(row, n)]).reshape(-1, 4)
    return np.concatenate((pose.apply(ends[:, :2]), pose.apply(ends[:, 2:])), axis=1)


def is_big(row: Row, points: int) -> bool:
    """What counts as a line for programs that want 9 points and half a metre."""
    return points >= BIG_POINTS and math.hypot(row[2] - row[0], row[3] - row[1]) >= BIG_M


def growth(rounds: int) -> dict[int, float]:
    """Microseconds a scan for more and more beams."""
    figures = {}
    for factor in (1, 4, 16):
        bearing = np.linspace(float(BEARING_RAD[0]), float(BEARING_RAD[-1]), 1080 * factor + 1)
        extractor = LineExtractor(bearing, RULES, range_max_m=RANGE_MAX_M)
        scans = scans_of("office", bearing, NOISE_M)[:6]
        figures[bearing.size] = round(float(np.median(timed_us(extractor.extract, scans, rounds))), 1)
    return figures


def wall_points(points: F64) -> NDArray[np.bool_]:
    """Which points of a scan lie on a wall: their neighbours along the scan, within 0.4 m both ways, are at least five,
    span half a metre and stray less than 2 cm (rms, SVD) from a line."""
    n, on_wall = len(points), np.zeros(len(points), dtype=bool)
    gap = np.hypot(*np.diff(points, axis=0).T)
    for j in range(n):
        low = high = j
        while low > 0 and gap[low - 1] < 0.4 and math.dist(points[low - 1], points[j]) < 0.4:
            low -= 1
        while high < n - 1 and gap[high] < 0.4 and math.dist(points[high + 1], points[j]) < 0.4:
            high += 1
        part = points[low : high + 1]
        if len(part) >= 5 and math.dist(part[0], part[-1]) >= 0.5:
            across = float(np.linalg.svd(part - part.mean(axis=0), compute_uv=False)[1])
            on_wall[j] = across / math.sqrt(len(part)) < 0.02
    return on_wall


def log_figures(path: Path) -> dict[str, float]:
    """A recorded run: its scans, and the map they make."""
    log = read_log(path)
    extractor = LineExtractor(log.scans[0].bearing_rad, range_max_m=log.range_max_m)
    line_map, insert_us, found = LineMap(), [], []
    for scan in log.scans:
        before = time.perf_counter_ns()
        lines = extractor.extract(scan.range_m)
        line_map.insert(lines, Pose2(*scan.laser_pose))
        insert_us.append((time.perf_counter_ns() - before) / 1e3)
        found.append(lines)
    kept = line_map.lines(min_seen=2, min_count=12)
    in_scan, in_map, on_walls, by_scan, by_map = [], [], 0, 0, 0
    for scan, lines in list(zip(log.scans, found))[::4]:
        seen = np.isfinite(scan.range_m)
        r, a = scan.range_m[seen], scan.bearing_rad[seen]
        points = np.stack((r * np.cos(a), r * np.sin(a)), axis=-1)
        wall = wall_points(points)
        placed = kept.distance_to(Pose2(*scan.laser_pose).apply(points)).min(axis=1)
        on_walls, by_map = on_walls + int(wall.sum()), by_map + int((wall & (placed < 0.1)).sum())
        if len(lines):
            by_scan += int((wall & (lines.distance_to(points).min(axis=1) < 0.05)).sum())
            own, supports = supporting(lines, points, seen)
            in_scan.append(own)
            in_map.append(placed[supports])
    size = len(line_map.to_bytes(min_seen=2, min_count=12))
    return {
        "scans": len(log.scans),
        "lines_in_scans": sum(len(lines) for lines in found),
        "lines_in_map": len(kept),
        "median_in_scan_mm": round(1e3 * float(np.median(np.concatenate(in_scan))), 1),
        "median_in_map_mm": round(1e3 * float(np.median(np.concatenate(in_map))), 1),
        "walls_explained_by_scan": round(by_scan / on_walls, 4),
        "walls_explained_by_map": round(by_map / on_walls, 4),
        "map_bytes": size,
        "times_smaller": round(sum(4 * scan.range_m.size for scan in log.scans) / size, 1),
        "scan_into_map_us": round(float(np.median(insert_us)), 1),
    }


def supporting(lines: Lines, points: F64, seen: NDArray[np.bool_]) -> tuple[F64, NDArray[np.int64]]:
    """Distances of the supporting points from their own lines, and which points they are."""
    number, away = np.cumsum(seen) - 1, lines.distance_to(points)
    parts = [np.arange(number[first], number[last] + 1) for first, last in lines.beams]
    return np.concatenate([away[part, k] for k, part in enumerate(parts)]), np.concatenate(parts)


def main() -> int:
    """Run, print, and say with the exit code whether the goals were met."""
    parser = argparse.ArgumentParser(description="Lines of scans and of runs.")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    options = parser.parse_args()
    report: dict[str, dict[str, float] | dict[int, float]] = {}
    for place in ("office", "hall"):
        f = place_figures(place, options.rounds)
        report[place] = f
        print(
            f"{place:7} extract {f['extract_us']:.0f} us ({f['extract_p10_us']:.0f} to {f['extract_p90_us']:.0f}), "
            f"with covariance {f['with_covariance_us']:.0f} us, numpy {f['plain_us']:.0f} us; wall error "
            f"{f['wall_error_ours_mm']:.2f} mm ({f['wall_error_big_mm']:.2f}; numpy {f['wall_error_plain_mm']:.2f}); "
            f"lines {f['lines_ours']:.2f} ({f['lines_big']:.2f}; numpy {f['lines_plain']:.2f} "
            f"({f['lines_plain_big']:.2f})); of {f['lines_walls']:.2f} walls missed {f['lines_walls_missed']:.2f}"
        )
    report["growth_us"] = growth(options.rounds)
    print("growth ", ", ".join(f"{beams} beams {us:.0f} us" for beams, us in report["growth_us"].items()))
    data = os.environ.get("UMFELD_DATA")
    for name in LOGS if data else ():
        report[name] = log_figures(Path(str(data)) / "known_pose_logs" / f"{name}-corrected.log.gz")
        print(f"{name:11}", ", ".join(f"{key} {value:g}" for key, value in report[name].items()))
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    figures = report["office"]
    assert "with_covariance_us" in figures
    fast = float(figures["with_covariance_us"]) <= 100.0  # type: ignore[index]
    true = float(figures["wall_error_big_mm"]) <= 2.0  # type: ignore[index]
    return 0 if fast and true else 1


if __name__ == "__main__":
    sys.exit(main())
