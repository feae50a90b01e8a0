"""Logs as old robots wrote them, of simulated buildings: `umfeld map build` and `umfeld evaluate` with what ships.

    PYTHONPATH=. .venv/bin/python bench/slam_logs.py [CASE ...] [--folder F] [--closures] [--json FILE] [--seed N]

Each case is a drive through a plan of bench/slam_log_worlds.py whose log has faults that such logs have: few digits,
odometry that drifts, slips or lags behind, stretches without scans, stamps that repeat or go backwards, a laser that
sees 8 m, people. Relations are true ones: of scans about 1 m apart along the way and of two visits of a place, looking
the same way. Nothing is told to the program but the log. --closures: run SLAM here too and count false closures.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.slam_large import FALSE_M, FALSE_RAD, Wheels
from bench.slam_log_worlds import columns_m, corridors, curved, offices, shelves, yard
from mapping.frames import Pose2, wrap_angles
from mapping.localise.pose_graph import composed_poses, relative_poses
from sim_devices.big_building import BigBuilding
from sim_devices.floor_plan import FloorPlan
from sim_devices.robot import follow
from sim_devices.world import World

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

STEP_M = 1.0  # of relations along the way
PAIR_M, PAIR_RAD, PAIR_S = 1.5, math.radians(40.0), 60.0
MOST_RELATIONS = 1500
EPOCH_S = 1.1e9


@dataclass(frozen=True, slots=True)
class Form:
    """How a log is written, and what its laser and wheels are like.

    beams: over 180 degrees, as FLASER has them.  reach_m: what the laser sees; code_m: what it says beyond.  *_digits:
    behind the point.  late_s: by how much odometry lags behind the scans.  gaps: stretches of gap_s without a scan.
    repeated, backward: shares of stamps that are the same as the one before, or earlier.  jitter_s: of stamps.
    stray: share of readings that are short at random.  mount_told: the log tells where the laser is on the robot; else
    relations are the laser's.
    """

    beams: int = 180
    hertz: float = 5.0
    reach_m: float = 80.0
    code_m: float = 81.83
    noise_m: float = 0.015
    stray: float = 0.002
    range_digits: int = 2
    pose_digits: int = 6
    stamp_digits: int = 6
    robotlaser: bool = False
    odom_lines: bool = True
    late_s: float = 0.0
    gaps: int = 0
    gap_s: float = 4.0
    repeated: float = 0.0
    backward: float = 0.0
    jitter_s: float = 0.0
    mount: Pose2 = field(default_factory=lambda: Pose2(0.12, 0.0, 0.0))
    mount_told: bool = True
    wheels: Wheels = field(default_factory=Wheels)


@dataclass(frozen=True, slots=True)
class Case:
    """A drive as a log."""

    plan: Callable[[int], FloorPlan]
    form: Form


COURT = BigBuilding(
    columns_m=columns_m(4, 5, 38.0, 70.0), rows_m=columns_m(4, 6, 30.0, 62.0), bare_share=0.3,
    tour=(
        (0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 0), (1, 2), (3, 2), (3, 1), (0, 1), (0, 2), (2, 2), (2, 0), (3, 0),
        (3, 1), (1, 1), (1, 3), (2, 3), (2, 1), (0, 1), (0, 3), (3, 3), (3, 2), (0, 2), (0, 0),
    ),
)  # fmt: skip
CELLAR = BigBuilding(
    columns_m=(0.0, 46.0, 81.0), rows_m=(0.0, 33.0, 57.0), bare_share=0.6, half_m=1.0,
    tour=((0, 0), (2, 0), (2, 1), (0, 1), (0, 0), (1, 0), (1, 2), (0, 2), (0, 1), (2, 1), (2, 2), (1, 2), (1, 1),
          (2, 1)),
)  # fmt: skip
SCHOOL = BigBuilding(
    columns_m=(0.0, 34.0, 71.0), rows_m=(0.0, 29.0), half_m=1.6, door_every_m=7.2, open_share=0.3,
    tour=((0, 0), (2, 0), (2, 1), (0, 1), (0, 0), (1, 0), (1, 1), (2, 1), (2, 0), (0, 0), (0, 1), (1, 1)),
    speed_m_s=0.6,
)  # fmt: skip
FRONT = BigBuilding(
    columns_m=(0.0, 41.0, 66.0, 108.0), rows_m=(0.0, 24.0), half_m=1.4, glass_share=0.45, open_share=0.15,
    tour=((0, 0), (3, 0), (3, 1), (0, 1), (0, 0), (1, 0), (1, 1), (2, 1), (2, 0), (3, 0), (3, 1), (1, 1)),
)  # fmt: skip
TWINS = BigBuilding(
    columns_m=(0.0, 24.0, 48.0, 72.0), rows_m=(0.0, 24.0, 48.0), alike=True, door_every_m=4.0, open_share=0.12,
    tour=(
        (0, 0), (3, 0), (3, 1), (0, 1), (0, 2), (3, 2), (3, 0), (1, 0), (1, 2), (2, 2), (2, 0), (0, 0), (0, 2), (1, 2),
        (1, 1), (3, 1),
    ),
)  # fmt: skip
WING = BigBuilding(
    columns_m=(0.0, 52.0, 97.0, 151.0), rows_m=(0.0, 21.0), half_m=1.2,
    tour=((0, 0), (3, 0), (3, 1), (0, 1), (0, 0), (1, 0), (1, 1), (2, 1), (2, 0), (3, 0), (3, 1), (2, 1)),
)  # fmt: skip
RING = BigBuilding(
    columns_m=(0.0, 31.0, 58.0), rows_m=(0.0, 26.0, 49.0), half_m=1.1,
    tour=((0, 0), (2, 0), (2, 2), (0, 2), (0, 1), (1, 1), (1, 0)),
)  # fmt: skip

SLIPPERY = Wheels(slips_per_m=0.06, slip_rad=math.radians(9.0), slip_m=0.35)
DRIFTING = Wheels(way_share=0.05, turn_share=0.12, drift_rad_per_m=math.radians(0.6), wander_rad=math.radians(0.8))

CASES: dict[str, Case] = {
    "court": Case(lambda s: corridors(COURT, s), Form(hertz=8.0, noise_m=0.02)),
    "cellar": Case(lambda s: corridors(CELLAR, s), Form(reach_m=8.0, code_m=8.19, wheels=SLIPPERY)),
    "school": Case(
        lambda s: corridors(SCHOOL, s, walkers=True),
        Form(beams=181, hertz=10.0, reach_m=50.0, code_m=50.0, robotlaser=True, odom_lines=False, late_s=0.15, gaps=8,
             range_digits=3),
    ),
    "front": Case(
        lambda s: corridors(FRONT, s, walkers=True),
        Form(beams=361, hertz=5.0, reach_m=30.0, code_m=81.91, repeated=0.03, backward=0.03, jitter_s=0.03),
    ),
    "twins": Case(lambda s: corridors(TWINS, s), Form(beams=360, wheels=DRIFTING, mount_told=False)),
    "wing": Case(
        lambda s: curved(corridors(WING, s), 110.0), Form(hertz=6.0, reach_m=30.0, code_m=30.0, pose_digits=2)
    ),
    "ring": Case(
        lambda s: corridors(RING, s, backwards=True),
        Form(beams=180, hertz=20.0, reach_m=50.0, code_m=51.2, pose_digits=3, range_digits=4, wheels=DRIFTING),
    ),
    "offices": Case(lambda s: offices(s), Form(beams=360, hertz=5.0, late_s=0.1)),
    "offices8": Case(
        lambda s: offices(s, bays=12), Form(beams=180, hertz=4.0, reach_m=8.0, code_m=8.19, wheels=DRIFTING, gaps=5)
    ),
    "shelves": Case(lambda s: shelves(s), Form(beams=361, hertz=10.0, reach_m=30.0, code_m=81.91, robotlaser=True)),
    "yard": Case(lambda s: yard(s), Form(beams=361, hertz=5.0, noise_m=0.02, stray=0.01)),
    "yard1": Case(lambda s: yard(s, laps=1), Form(beams=181, hertz=2.0, reach_m=50.0, code_m=81.91, robotlaser=True)),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Recorded:
    """A written log. text: the stamps as written; truth: (N, 3) of the base, in the order of the lines."""

    log: Path
    relations: Path
    opposite: Path
    text: tuple[str, ...]
    truth: F64


def record(name: str, seed: int, folder: Path) -> Recorded:
    """Drive a case, unless that was done, and write its log and relations."""
    case, form = CASES[name], CASES[name].form
    plan = case.plan(seed)
    assert plan.route is not None
    motion = follow(plan.route)
    rng = np.random.default_rng(seed + 100)
    time_s = np.arange(0.0, motion.lap_s, 1.0 / form.hertz)
    for _ in range(form.gaps):
        at = rng.uniform(20.0, time_s[-1] - 20.0)
        time_s = time_s[(time_s < at) | (time_s > at + form.gap_s)]
    truth = motion.pose_at(time_s)
    fine_s = np.arange(0.0, motion.lap_s, 0.05)
    wheels = form.wheels.odometry(motion.pose_at(fine_s), rng)
    odometry = _at(fine_s, wheels, time_s - form.late_s)
    text = _stamps(form, time_s, rng)
    base = folder / f"{name}-{seed}"
    mount = np.array([form.mount.x_m, form.mount.y_m, form.mount.yaw_rad])
    told = truth if form.mount_told else composed_poses(truth, np.tile(mount, (len(truth), 1)))
    relations, opposite = base.with_suffix(".relations"), base.with_suffix(".opposite")
    out = Recorded(base.with_suffix(".clf"), relations, opposite, text, told)
    if out.log.exists():
        return out
    world = World.from_plan(plan, seed)
    with out.log.open("w") as file:
        file.write("# simulated\nPARAM robot_frontlaser_offset 0.12\n")
        for k, (now_s, at) in enumerate(zip(time_s, truth)):
            if form.odom_lines:
                file.write(_odom(form, odometry[k], time_s[k]))
            file.write(_scan(form, _look(form, world, float(now_s), at, rng), odometry[k], text[k]))
    _write_relations(out.relations, text, told, _pairs(truth, time_s, text, same_way=True))
    _write_relations(out.opposite, text, told, _pairs(truth, time_s, text, same_way=False))
    return out


def _at(stamps_s: F64, poses: F64, time_s: F64) -> F64:
    """(N, 3) poses between those of a path."""
    t = np.clip(time_s, stamps_s[0], stamps_s[-1])
    yaw = np.interp(t, stamps_s, np.unwrap(poses[:, 2]))
    return np.stack(
        (np.interp(t, stamps_s, poses[:, 0]), np.interp(t, stamps_s, poses[:, 1]), wrap_angles(yaw)), axis=-1
    )


def _stamps(form: Form, time_s: F64, rng: np.random.Generator) -> tuple[str, ...]:
    told = EPOCH_S + time_s + rng.uniform(-0.5, 0.5, len(time_s)) * form.jitter_s
    odd = rng.random(len(time_s))
    for k in range(1, len(told)):
        if odd[k] < form.repeated:
            told[k] = told[k - 1]
        elif odd[k] < form.repeated + form.backward:
            told[k] = told[k] - rng.uniform(0.1, 0.8)
    return tuple(f"{t:.{form.stamp_digits}f}" for t in told)


def _look(form: Form, world: World, now_s: float, at: F64, rng: np.random.Generator) -> F64:
    """(beams,) readings as the laser tells them."""
    sensor = Pose2(*at.tolist()) @ form.mount
    n = form.beams
    bearing = np.radians(-90.0 + np.arange(n) * 180.0 / (n - n % 2))
    origin = np.repeat([[sensor.x_m, sensor.y_m]], n, axis=0)
    true = world.beam_distances(origin, sensor.yaw_rad + bearing, np.full(n, now_s), z_m=0.3, range_max_m=form.reach_m)
    told = true + rng.normal(0.0, form.noise_m, n)
    stray = rng.random(n) < form.stray
    told[stray] *= rng.uniform(0.2, 1.0, int(stray.sum()))
    return np.where(np.isfinite(true) & (told < form.reach_m), np.maximum(told, 0.0), form.code_m)


def _pose_text(form: Form, pose: Pose2) -> str:
    return " ".join(f"{v:.{form.pose_digits}f}" for v in (pose.x_m, pose.y_m, pose.yaw_rad))


def _odom(form: Form, odometry: F64, time_s: float) -> str:
    stamp = EPOCH_S + time_s
    return f"ODOM {_pose_text(form, Pose2(*odometry.tolist()))} 0 0 0 {stamp:.6f} nohost {stamp - EPOCH_S:.6f}\n"


def _scan(form: Form, ranges: F64, odometry: F64, stamp: str) -> str:
    robot = Pose2(*odometry.tolist())
    laser = robot @ form.mount if form.mount_told else robot
    told = " ".join(f"{r:.{form.range_digits}f}" for r in ranges)
    tail = f"{_pose_text(form, laser)} {_pose_text(form, robot)}"
    if form.robotlaser:
        step = math.pi / (form.beams - form.beams % 2)
        head = f"ROBOTLASER1 0 {-math.pi / 2:.6f} {math.pi:.6f} {step:.6f} {form.code_m:.6f} 0.010000 0"
        return f"{head} {form.beams} {told} 0 {tail} 0 0 0 0 0 {stamp} nohost 0\n"
    return f"FLASER {form.beams} {told} {tail} {stamp} nohost 0\n"


def _pairs(truth: F64, time_s: F64, text: tuple[str, ...], *, same_way: bool) -> I64:
    """(R, 2): half of scans about STEP_M apart, half of two visits; if not same_way, visits looking opposite ways."""
    from scipy.spatial import cKDTree

    _, first, count = np.unique(np.array(text), return_index=True, return_counts=True)
    single = np.zeros(len(text), dtype=np.bool_)
    single[first[count == 1]] = True
    near = cKDTree(truth[:, :2]).query_pairs(PAIR_M, output_type="ndarray")
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    a, b = near.T
    turned = np.abs(wrap_angles(truth[a, 2] - truth[b, 2]))
    facing = turned < PAIR_RAD if same_way else turned > math.pi - PAIR_RAD
    visits = near[facing & (np.abs(time_s[a] - time_s[b]) > PAIR_S) & single[a] & single[b]]
    visits = _thinned(visits, MOST_RELATIONS // 2)
    if not same_way:
        return visits
    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))))
    start = np.flatnonzero(single)
    end = np.minimum(np.searchsorted(way, way[start] + STEP_M), len(way) - 1)
    steps = np.stack((start, end), axis=-1)[(end > start) & single[end]]
    return np.concatenate((_thinned(steps, MOST_RELATIONS // 2), visits))


def _thinned(pairs: I64, most: int) -> I64:
    if len(pairs) <= most:
        return pairs
    return np.asarray(pairs[np.linspace(0, len(pairs) - 1, most).astype(np.int64)])


def _write_relations(path: Path, text: tuple[str, ...], truth: F64, pairs: I64) -> None:
    seen = relative_poses(truth[pairs[:, 0]], truth[pairs[:, 1]])
    rows = [
        f"{text[i]} {text[j]} {x:.6f} {y:.6f} 0 0 0 {yaw:.6f}\n"
        for (i, j), (x, y, yaw) in zip(pairs.tolist(), np.column_stack((seen[:, :2], wrap_angles(seen[:, 2]))).tolist())
    ]
    path.write_text("".join(rows))


def judged(name: str, seed: int, folder: Path, *, closures: bool) -> dict[str, object]:
    """One case: map built and evaluated by the commands that ship."""
    recorded = record(name, seed, folder)
    out = recorded.log.with_suffix("")
    umfeld = [sys.executable, "-m", "service"]
    began = time.monotonic()
    build = subprocess.Popen([*umfeld, "map", "build", str(recorded.log), "--out", str(out), "--json"],
                             stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)  # fmt: skip
    said, trouble = build.communicate()
    seconds = time.monotonic() - began
    if build.returncode:
        return {"case": name, "seed": seed, "failed": trouble[-400:]}
    report = json.loads(said)
    row: dict[str, object] = {
        "case": name, "seed": seed, "scans": report["scans"], "way_m": round(report["path_m"]),
        **_error(umfeld, out / "trajectory.tum", recorded.relations, ""),
        **_error(umfeld, out / "trajectory.tum", recorded.opposite, "opposite_"),
        "keys": report["slam"]["key_scans"], "closures": report["slam"]["closures"],
        "searched": report["slam"]["closures_searched"], "seconds": round(seconds, 1),
        "slam_s": round(sum(report["slam"]["core_seconds"].values()), 1), "peak_mb": report["peak_memory_mb"],
        "repaired": report["stamps_repaired"], "skipped": report["skipped_lines"], "events": report["slam"]["events"],
    }  # fmt: skip
    if closures:
        row["false"] = _false_closures(recorded)
    return row


def _error(umfeld: list[str], trajectory: Path, relations: Path, name: str) -> dict[str, object]:
    if not relations.stat().st_size:
        return {}
    said = subprocess.run(
        [*umfeld, "evaluate", str(trajectory), str(relations), "--json"], capture_output=True, text=True
    )
    found = json.loads(said.stdout)
    return {
        f"{name}m": round(found["translation_m"]["mean"], 4), f"{name}deg": round(found["rotation_deg"]["mean"], 3),
        f"{name}largest_m": round(found["translation_m"]["largest"], 2),
        f"{name}not_evaluated": found["not_evaluated"],
    }  # fmt: skip


def _false_closures(recorded: Recorded) -> list[tuple[float, float]]:
    """Metres and degrees of accepted closures that are off too far."""
    from drivers.logs import read_log
    from service.slam_log import run_slam

    log = read_log(recorded.log)
    slam = run_slam(log, log.scans).slam
    mount = Pose2(*log.robot_from_laser)
    where = dict(zip(recorded.text, recorded.truth))
    truth = {round(scan.stamp_s * 1e9): Pose2(*where[scan.stamp_text].tolist()) @ mount for scan in log.scans}
    stamps, off = slam.key_stamps(), []
    for closure in slam.closures:
        true = truth[stamps[closure.start]].inverse() @ truth[stamps[closure.to]]
        error = true.inverse() @ closure.measured
        metres = math.hypot(error.x_m, error.y_m)
        if metres > FALSE_M or abs(error.yaw_rad) > FALSE_RAD:
            off.append((round(metres, 2), round(math.degrees(error.yaw_rad), 1)))
    return off


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path("slam_logs"), help="for logs and maps")
    parser.add_argument("--closures", action="store_true", help="run SLAM here too and look for false closures")
    parser.add_argument("--only-record", action="store_true", help="write the logs, build nothing")
    parser.add_argument("--json", type=Path, help="write the rows there")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("PYTHONPATH", ".")
    rows = []
    for name in options.cases:
        if options.only_record:
            record(name, options.seed, options.folder)
            continue
        rows.append(judged(name, options.seed, options.folder, closures=options.closures))
        print("  ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
