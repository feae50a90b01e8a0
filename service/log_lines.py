"""Lines of a recorded log: of one scan, or of the whole run as a map (`umfeld extract lines`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.logs import Log, LogError, LogScan
from mapping.frames import Pose2
from mapping.lines.extract import LineExtractor, LineRules, are_in_order
from mapping.lines.line_map import LineMap
from mapping.lines.lines import Lines
from service.errors import WrongUsage
from service.recording_log import read_any_log

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class LogLines:
    """lines in `frame`: "map", or "laser" for a single scan.

    report: for people and programs; map_bytes are those of the compact form, scan_bytes those of the ranges as 4-byte
    numbers.
    """

    lines: Lines
    frame: str
    report: dict[str, object]


def lines_of_log(
    path: Path,
    *,
    scan: int | None = None,
    every: int = 1,
    min_seen: int = 2,
    min_points: int = 12,
    rules: LineRules | None = None,
    progress: Progress | None = None,
) -> LogLines:
    """Read a log and find its lines.

    scan: only this scan (from 0; negative from the end), in the frame of its laser.  every: only every N-th scan.
    min_seen, min_points: leave out what fewer scans saw, or fewer points
    support; a single scan keeps all.  Raises WrongUsage if the log cannot be read or has no such scan.
    """
    try:
        log = read_any_log(path)
    except (LogError, OSError) as error:
        raise WrongUsage(str(error)) from error
    if scan is not None:
        return _of_one_scan(log, scan, rules)
    return _of_run(log, every, min_seen, min_points, rules, progress)


def line_map_of(
    scans: Sequence[LogScan],
    map_from_laser: Sequence[Pose2],
    *,
    range_max_m: float,
    rules: LineRules | None = None,
    progress: Progress | None = None,
) -> tuple[LineMap, int]:
    """The lines of scans from the poses of their laser, as a map; and how many lines there were before fusing them."""
    extractors: dict[int, LineExtractor] = {}
    line_map, found = LineMap(), 0
    for index, (each, pose) in enumerate(zip(scans, map_from_laser, strict=True)):
        if not are_in_order(each.bearing_rad):
            continue  # of a head that trembles
        key = id(each.bearing_rad)  # shared between the scans of a device
        if key not in extractors:
            extractors[key] = LineExtractor(each.bearing_rad, rules, range_max_m=range_max_m)
        lines = extractors[key].extract(each.range_m)
        found += len(lines)
        line_map.insert(lines, pose)
        if progress is not None and index % 64 == 0:
            progress(index, len(scans))
    return line_map, found


def _of_one_scan(log: Log, number: int, rules: LineRules | None) -> LogLines:
    count = len(log.scans)
    if not -count <= number < count:
        raise WrongUsage(f"{log.provenance.path}: has scans 0 to {count - 1}, not {number}")
    chosen = log.scans[number]
    lines = LineExtractor(chosen.bearing_rad, rules, range_max_m=log.range_max_m).extract(chosen.range_m)
    report = {"log": log.provenance.path, "scan": number % count, "stamp": chosen.stamp_text, "lines": len(lines)}
    return LogLines(lines, "laser", report)


def _of_run(
    log: Log, every: int, min_seen: int, min_points: int, rules: LineRules | None, progress: Progress | None
) -> LogLines:
    scans = log.scans[::every]
    started = time.monotonic()
    poses = [Pose2(*each.laser_pose) for each in scans]
    line_map, found = line_map_of(scans, poses, range_max_m=log.range_max_m, rules=rules, progress=progress)
    kept = line_map.lines(min_seen=min_seen, min_count=min_points)
    map_bytes = len(line_map.to_bytes(min_seen=min_seen, min_count=min_points))
    scan_bytes = sum(4 * each.range_m.size for each in scans)
    report: dict[str, object] = {
        "log": log.provenance.path,
        "poses": log.poses.value,
        "scans": len(scans),
        "lines_in_scans": found,
        "lines": len(kept),
        "length_m": round(float(kept.length_m.sum()), 3),
        "map_bytes": map_bytes,
        "scan_bytes": scan_bytes,
        "times_smaller": round(scan_bytes / max(map_bytes, 1), 1),
        "seconds": round(time.monotonic() - started, 3),
    }
    return LogLines(kept, "map", report)
