"""`umfeld localise`: a recorded log in a map of its building: where the robot was, and when it was sure of it."""

from __future__ import annotations

import io
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.logs import Log, LogError, LogScan
from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.localise.in_map import InMapSettings, Located, MapLocaliser, SearchResult, State
from mapping.localise.known_map import BEAMS, FARTHEST_M, KnownMap, digest_of, known_map, points_of
from service.errors import WrongUsage
from service.export import pixels_of
from service.files import Receipt, write_whole
from service.map_localiser import fields_of, read_map, seen_by_lasers
from service.recording_log import read_any_log

Progress = Callable[[int, int], None]

NEAREST_M = 0.05
_COLOURS = {State.LOST: (214, 39, 40), State.SEARCHING: (255, 150, 30), State.SURE: (0, 110, 220)}
_LARGEST_PX = 4000


@dataclass(frozen=True, slots=True)
class LocalisedLog:
    """A log in a map. located: one for each scan.  events: what happened, by name.  seconds: of this thread."""

    log: Log
    scans: tuple[LogScan, ...]
    patch: GridPatch
    located: tuple[Located, ...]
    events: Mapping[str, int]
    seconds: float
    digest_before: str
    digest_after: str


def prepared(patch: GridPatch, path: Path) -> KnownMap:
    """The map made ready; WrongUsage if it cannot be localised in."""
    try:
        return known_map(patch)
    except ValueError as error:
        raise WrongUsage(f"{path}: {error}") from error


def localise_log(
    log_path: Path,
    map_path: Path,
    *,
    every: int = 1,
    start: Pose2 | None = None,
    settings: InMapSettings | None = None,
    progress: Progress | None = None,
) -> LocalisedLog:
    """Play a log in a map. start: a hint where the robot is at first; None is anywhere.

    Raises WrongUsage if the log is none or holds no scan, MapFileTrouble if the map cannot be read.
    """
    try:
        log = read_any_log(log_path)
    except (LogError, OSError) as error:
        raise WrongUsage(str(error)) from error
    scans = log.scans[::every]
    if not scans:
        raise WrongUsage(f"{log_path}: holds no laser scan")
    patch = read_map(map_path)
    digest = digest_of(patch)
    known = prepared(seen_by_lasers(map_path, patch), map_path)
    localiser = MapLocaliser(known, settings, start=start)
    mount = Pose2(*log.robot_from_laser)
    located: list[Located] = []
    pending: SearchResult | None = None
    began = time.thread_time()
    for index, scan in enumerate(scans):
        stamp_ns = round(scan.stamp_s * 1e9)
        if localiser.is_due(stamp_ns) and pending is not None:
            localiser.apply(pending)
        points = points_of(
            scan.bearing_rad, scan.range_m, mount, nearest_m=NEAREST_M, farthest_m=FARTHEST_M, most=BEAMS
        )
        located.append(localiser.add_scan(stamp_ns, points, Pose2(*scan.robot_pose)))
        work = localiser.take_work()
        if work is not None:
            pending = work.run()
        if progress is not None and index % 32 == 0:
            progress(index, len(scans))
    seconds = time.thread_time() - began
    return LocalisedLog(
        log, scans, patch, tuple(located), localiser.events, seconds, digest, digest_of(patch)
    )  # fmt: skip


def report_of(run: LocalisedLog) -> dict[str, object]:
    """Counts and times for people and programs."""
    stamps = np.array([scan.stamp_s for scan in run.scans]) - run.scans[0].stamp_s
    sure = [index for index, each in enumerate(run.located) if each.state is State.SURE]
    states = Counter(each.state.value for each in run.located)
    return {
        "scans": len(run.scans),
        "duration_s": round(float(stamps[-1]), 3),
        "first_sure_s": None if not sure else round(float(stamps[sure[0]]), 3),
        "share_by_state": {state.value: round(states[state.value] / len(run.scans), 4) for state in State},
        "events": dict(sorted(run.events.items())),
        "core_seconds": round(run.seconds, 3),
        "scans_per_second": round(len(run.scans) / max(run.seconds, 1e-9), 1),
        "map": {
            "resolution_m": run.patch.resolution_m,
            "cells": list(run.patch.cells.shape),
            "sha256": run.digest_before,
            "unchanged": run.digest_before == run.digest_after,
        },
    }


def rows_of(run: LocalisedLog) -> list[dict[str, object]]:
    """One row a scan: stamp, state, probability, the first place with its standard deviations, and its rivals."""
    return [
        {"stamp": scan.stamp_text, "s": round(scan.stamp_s - run.scans[0].stamp_s, 3), **fields_of(located)}
        for scan, located in zip(run.scans, run.located)
    ]


def write_json(run: LocalisedLog, path: Path) -> Receipt:
    """The report and every row."""
    document = {"schema": "umfeld.localised-log.v1", **report_of(run), "trajectory": rows_of(run)}
    return write_whole(path, (json.dumps(document, indent=1) + "\n").encode())


def write_png(run: LocalisedLog, path: Path) -> Receipt:
    """The map, and on it where the robot believed to be: blue sure, orange searching, red lost."""
    from PIL import Image, ImageDraw

    patch = run.patch
    rows, cols = patch.cells.shape
    scale = max(1, min(8, _LARGEST_PX // max(rows, cols, 1), 1600 // max(rows, cols, 1) or 1))
    picture = Image.fromarray(pixels_of(patch.cells)).convert("RGB")
    picture = picture.resize((cols * scale, rows * scale), Image.Resampling.NEAREST)
    pen = ImageDraw.Draw(picture)
    size = patch.resolution_m / scale
    x0, y1 = patch.col0 * patch.resolution_m, (patch.row0 + rows) * patch.resolution_m
    radius = max(1, round(0.05 / size))
    order = (State.SEARCHING, State.LOST, State.SURE)
    for located in sorted(run.located, key=lambda each: order.index(each.state)):
        if located.map_from_base is not None:
            x, y = (located.map_from_base.x_m - x0) / size, (y1 - located.map_from_base.y_m) / size
            pen.ellipse((x - radius, y - radius, x + radius, y + radius), fill=_COLOURS[located.state])
    out = io.BytesIO()
    picture.save(out, "PNG")
    return write_whole(path, out.getvalue())


def trajectory_text(run: LocalisedLog) -> str:
    """TUM: stamp x y z qx qy qz qw, of the scans at which the robot was sure of its place."""
    return "".join(
        f"{scan.stamp_text} {p.x_m:.6f} {p.y_m:.6f} 0 0 0 {math.sin(p.yaw_rad / 2):.9f} {math.cos(p.yaw_rad / 2):.9f}\n"
        for scan, located in zip(run.scans, run.located)
        if located.state is State.SURE and (p := located.map_from_base) is not None
    )
