"""SLAM on recorded logs: error against relations, speed on one core, memory, and what each part is worth.

    UMFELD_DATA=folder .venv/bin/python bench/slam.py [--logs intel fr079] [--ablation] [--variants NAME ...] [--json F]

Times are those of the thread on its core; the worst second is the slowest stretch of scans that took one.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers.logs import Log, read_log
from mapping.frames import Pose2
from mapping.localise.slam_records import SlamSettings
from service.evaluate import Trajectory, read_relations, relation_error
from service.slam_log import SlamRun, run_slam

LOGS = {"intel": "carmen_logs/intel", "fr079": "carmen_logs/fr079"}


def variants() -> dict[str, SlamSettings]:
    """Settings with one part taken out each."""
    whole = SlamSettings()
    closures = whole.closures
    return {
        "all of it": whole,
        "no closures": replace(whole, closures=replace(closures, apart_m=math.inf)),
        "searched closures only": replace(whole, closures=replace(closures, tracked_m=-1.0)),
        "no probation": replace(whole, closures=replace(closures, agreeing=1, agreeing_way_m=0.0)),
        "whatever the way says": replace(whole, closures=replace(closures, surprise=math.inf, doubling=math.inf)),
        "single tests off": replace(
            whole, closures=replace(closures, explained=0.0, overlap=0.0, mean_cost=1.0, weakest_per_m2=0.0, rival=2.0)
        ),
        "laid on 1 key scan": replace(whole, references=1),
        "laid on 4 key scans": replace(whole, references=4),
        "key scan every 0.6 m, 25 deg": replace(whole, key_m=0.6, key_rad=math.radians(25.0)),
        "odometry never doubted": replace(whole, odometry_factor=1.0, gate=2.0),
    }


def figures(name: str, log: Log, run: SlamRun, seconds: float, relations: Path) -> dict[str, object]:
    """One row of the table."""
    texts = tuple(scan.stamp_text for scan in log.scans)
    path = Trajectory(texts, np.array([scan.stamp_s for scan in log.scans]), run.robot_poses)
    found = relation_error(path, read_relations(relations))
    return {
        "log": name,
        "translation_m": round(found.translation_m.mean, 4),
        "rotation_deg": round(found.rotation_deg.mean, 3),
        "largest_m": round(found.translation_m.largest, 2),
        "not_evaluated": found.not_evaluated,
        "key_scans": run.slam.keys,
        "closures": len(run.slam.closures),
        "seconds": round(seconds, 1),
        "worst_second": run.figures["worst_second_scans_per_second"],
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0),
    }


def without_injected(log: Log, run: SlamRun, relations: Path, *, false: int = 20) -> float:
    """Mean translation error after as many false, very sure closures were added to a finished map."""
    rng = np.random.default_rng(1)
    sure = np.diag([1.0 / 0.02**2, 1.0 / 0.02**2, 1.0 / math.radians(0.3) ** 2])
    for _ in range(false):
        a, b = sorted(int(v) for v in rng.choice(run.slam.keys, 2, replace=False))
        x, y, yaw = (float(v) for v in (*rng.normal(0.0, 2.0, 2), rng.uniform(-3.0, 3.0)))
        run.slam.add_closure(a, b, Pose2(x, y, yaw), sure)
    run.slam.finish()
    texts = tuple(scan.stamp_text for scan in log.scans)
    path = Trajectory(texts, np.array([scan.stamp_s for scan in log.scans]), run.slam.trajectory()[1])
    return relation_error(path, read_relations(relations)).translation_m.mean


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", nargs="+", default=list(LOGS), choices=list(LOGS))
    parser.add_argument("--ablation", action="store_true", help="also without each part")
    parser.add_argument("--variants", nargs="+", choices=list(variants()), help="only these")
    parser.add_argument("--json", type=Path, help="write the rows there")
    options = parser.parse_args()
    data = Path(os.environ.get("UMFELD_DATA", ""))
    rows: list[dict[str, object]] = []
    for name in options.logs:
        log = read_log(data / f"{LOGS[name]}.clf.gz")
        relations = data / f"{LOGS[name]}.relations.gz"
        run_slam(log, log.scans[:200])  # compiles
        for variant, settings in variants().items():
            if variant not in (options.variants or variants()):
                continue
            began = time.thread_time()
            run = run_slam(log, log.scans, settings=settings)
            row = {"variant": variant, **figures(name, log, run, time.thread_time() - began, relations)}
            if variant == "all of it":
                row["with_20_false_closures_m"] = round(without_injected(log, run, relations), 4)
            rows.append(row)
            print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
            if not options.ablation and options.variants is None:
                break
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
