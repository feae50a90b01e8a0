"""SLAM in large buildings with bad odometry: error against the truth, loops closed, closures that are false.

    UMFELD_DATA=folder .venv/bin/python bench/slam_large.py [CASE ...] [--seeds 1 2] [--json FILE] [--draw FOLDER]

Cases: buildings of the simulator (mit: 2 km of corridor, mit8: seen up to 8 m, plain: without a door or a bin between
the crossings, halls: two loops of 400 m, alike: parallel corridors 7.5 m apart, alike_plain: those without doors, bare:
one loop of 230 m without doors, aces, aces8: four courts whose corridors are the same but for open doors, killian,
killian8: loops of 200 to 700 m along a corridor of 250 m, four corridors of ten bare, half a metre between scans; the
laser of these four sees 80 m or 8 m and errs by 2 cm), 180 degrees at 1 degree as an old SICK, and recordings whose
poses others corrected (belgioioso, seattle, acapulco). Odometry is made from the true poses: a scale that is off, turns
that are off, a heading that drifts and wanders, slips (`Wheels`).

A pair of visits: scans less than PAIR_M and PAIR_RAD apart in truth and at least 60 s and 30 m of way apart. Its error
is what the relation error of the benchmark is: inverse(true) * (inverse(a) * b).  A closure is false if it is off the
truth by more than FALSE_M or FALSE_RAD.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.logs import read_log
from mapping.frames import Pose2, wrap_angles
from mapping.localise.pose_graph import relative_poses
from mapping.localise.slam import Slam, run_here
from mapping.localise.slam_records import SlamSettings
from mapping.scan import Scan
from sim_devices.big_building import BigBuilding
from sim_devices.robot import follow
from sim_devices.world import World

F64 = NDArray[np.float64]

PAIR_M = 2.0
PAIR_RAD = math.radians(45.0)
MOST_PAIRS = 20_000
GOOD_M = 0.5  # a pair that errs less is one whose loop is closed
FALSE_M = 0.30
FALSE_RAD = math.radians(3.0)
MOUNT = Pose2(0.1, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Wheels:
    """How odometry errs: shares of way and turn, heading drift per metre, its wander, and slips."""

    way_share: float = 0.02
    turn_share: float = 0.04
    drift_rad_per_m: float = math.radians(0.08)
    wander_rad: float = math.radians(0.4)  # per square root of a metre
    slips_per_m: float = 0.01
    slip_rad: float = math.radians(4.0)
    slip_m: float = 0.1

    def odometry(self, truth: F64, rng: np.random.Generator) -> F64:
        """(N, 3) from true base poses (N, 3)."""
        step = relative_poses(truth[:-1], truth[1:])
        step[:, 2] = wrap_angles(step[:, 2])
        way = np.hypot(step[:, 0], step[:, 1])
        n = len(step)
        sign = rng.choice([-1.0, 1.0], 3)
        step[:, :2] *= 1.0 + sign[0] * self.way_share
        step[:, 0] += rng.normal(0.0, 0.02, n) * np.sqrt(way)
        slip = rng.random(n) < self.slips_per_m * way
        step[:, 0] -= slip * rng.uniform(0.0, self.slip_m, n)
        step[:, 2] = (
            step[:, 2] * (1.0 + sign[1] * self.turn_share)
            + sign[2] * self.drift_rad_per_m * way
            + rng.normal(0.0, self.wander_rad, n) * np.sqrt(way)
            + slip * rng.normal(0.0, self.slip_rad, n)
        )
        pose, out = Pose2(*truth[0].tolist()), [truth[0]]
        for row in step:
            pose = pose @ Pose2(*row.tolist())
            out.append(np.array([pose.x_m, pose.y_m, pose.yaw_rad]))
        return np.array(out)


@dataclass(frozen=True, slots=True)
class Case:
    """A drive. truth, odometry: (N, 3) of the base.  mount: base_from_sensor."""

    name: str
    scans: tuple[Scan, ...]
    truth: F64
    odometry: F64
    mount: Pose2


MIT = BigBuilding(
    columns_m=(0.0, 60.0, 131.0, 250.0),
    rows_m=(0.0, 61.0, 126.0),
    tour=(
        (0, 0), (3, 0), (3, 2), (0, 2), (0, 0), (1, 0), (1, 1), (0, 1), (0, 0), (2, 0), (2, 2), (1, 2), (1, 1), (3, 1),
        (3, 2), (0, 2), (0, 0),
    ),
)  # fmt: skip
HALLS = BigBuilding(
    columns_m=(0.0, 90.0, 140.0), rows_m=(0.0, 100.0),
    tour=((0, 0), (2, 0), (2, 1), (0, 1), (0, 0), (1, 0), (1, 1), (0, 1), (0, 0), (1, 0)), open_share=0.2,
)  # fmt: skip
BARE = BigBuilding(columns_m=(0.0, 70.0), rows_m=(0.0, 45.0), tour=((0, 0), (1, 0), (1, 1), (0, 1)) * 2, bare=True)
ALIKE = BigBuilding(
    columns_m=(0.0, 20.0, 40.0, 60.0, 80.0, 100.0, 120.0), rows_m=(0.0, 7.5, 15.0, 22.5), half_m=1.0,
    tour=((0, 0), (6, 0), (6, 1), (0, 1), (0, 2), (6, 2), (6, 3), (0, 3), (0, 0), (6, 0), (6, 1)),
)  # fmt: skip


COURTS = BigBuilding(
    columns_m=(0.0, 27.0, 55.0), rows_m=(0.0, 26.0, 54.0), alike=True,
    tour=(
        (0, 0), (1, 0), (1, 1), (0, 1), (0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 1), (1, 1), (1, 2), (2, 2),
        (2, 1), (1, 1), (1, 0), (0, 0), (0, 2), (2, 2), (2, 0), (0, 0),
    ),
)  # fmt: skip
KILLIAN = BigBuilding(
    columns_m=(0.0, 38.0, 96.0, 171.0, 250.0), rows_m=(0.0, 52.0, 118.0, 205.0), bare_share=0.4,
    tour=(
        (0, 0), (4, 0), (4, 1), (2, 1), (2, 0), (1, 0), (1, 3), (3, 3), (3, 1), (4, 1), (4, 0), (2, 0), (2, 2), (1, 2),
        (1, 0), (0, 0), (0, 1), (2, 1), (2, 3), (4, 3), (4, 0), (0, 0),
    ),
)  # fmt: skip


def simulated(
    name: str, building: BigBuilding, seed: int, *, range_m: float = 30.0, hertz: float = 5.0, noise_m: float = 0.012,
    wheels: Wheels | None = None,
) -> Case:  # fmt: skip
    """A drive through a building, the laser erring by noise_m and telling whole centimetres."""
    plan = building.plan(seed)
    assert plan.route is not None
    world, motion = World.from_plan(plan, seed), follow(plan.route)
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, motion.lap_s, 1.0 / hertz)
    truth = motion.pose_at(time_s)
    bearing = np.radians(np.arange(-90.0, 90.0))
    scans = []
    for now_s, at in zip(time_s, truth):
        sensor = Pose2(*at.tolist()) @ MOUNT
        origin = np.repeat([[sensor.x_m, sensor.y_m]], len(bearing), axis=0)
        reach = world.beam_distances(
            origin, sensor.yaw_rad + bearing, np.full(len(bearing), now_s), z_m=0.3, range_max_m=range_m
        )
        reach = np.round((reach + rng.normal(0.0, noise_m, len(reach))) * 100.0) / 100.0
        scans.append(Scan(round(now_s * 1e9), 0.0, bearing, reach, 0.05, range_m))
    return Case(name, tuple(scans), truth, (wheels or Wheels()).odometry(truth, rng), MOUNT)


def recorded(name: str, _: int, *, seed_of_wheels: int = 0) -> Case:
    """A recording with corrected poses; its stamps as if driven at 0.6 m/s and 0.5 rad/s."""
    log = read_log(Path(os.environ["UMFELD_DATA"]) / "known_pose_logs" / f"{name}-corrected.log.gz")
    truth = np.array([scan.robot_pose for scan in log.scans])
    step = relative_poses(truth[:-1], truth[1:])
    seconds = np.hypot(step[:, 0], step[:, 1]) / 0.6 + np.abs(wrap_angles(step[:, 2])) / 0.5 + 0.1
    time_s = np.concatenate(([0.0], np.cumsum(seconds)))
    scans = tuple(
        Scan(round(t * 1e9), 0.0, scan.bearing_rad, scan.range_m, 0.05, log.range_max_m)
        for t, scan in zip(time_s.tolist(), log.scans)
    )
    odometry = Wheels().odometry(truth, np.random.default_rng(seed_of_wheels))
    return Case(name, scans, truth, odometry, Pose2(*log.robot_from_laser))


CASES: dict[str, Callable[[int], Case]] = {
    "mit": partial(simulated, "mit", MIT),
    "mit8": partial(simulated, "mit8", MIT, range_m=8.0),
    "plain": partial(simulated, "plain", replace(MIT, bare=True)),
    "halls": partial(simulated, "halls", HALLS),
    "alike": partial(simulated, "alike", ALIKE),
    "alike_plain": partial(simulated, "alike_plain", replace(ALIKE, bare=True)),
    "bare": partial(simulated, "bare", BARE),
    "aces": partial(simulated, "aces", COURTS, range_m=80.0, noise_m=0.02, wheels=Wheels(way_share=0.04)),
    "aces8": partial(simulated, "aces8", COURTS, range_m=8.0, noise_m=0.02, wheels=Wheels(way_share=0.04)),
    "killian": partial(simulated, "killian", KILLIAN, range_m=80.0, noise_m=0.02, hertz=2.0),
    "killian8": partial(simulated, "killian8", KILLIAN, range_m=8.0, noise_m=0.02, hertz=2.0),
    "belgioioso": lambda seed: recorded("belgioioso", seed, seed_of_wheels=seed),
    "seattle": lambda seed: recorded("seattle", seed, seed_of_wheels=seed),
    "acapulco": lambda seed: recorded("acapulco", seed, seed_of_wheels=seed),
}


def drive(case: Case, settings: SlamSettings | None = None) -> Slam:
    """The whole of a case through SLAM."""
    slam = Slam(settings, start=Pose2(*case.truth[0].tolist()))
    pending = None
    for scan, odom in zip(case.scans, case.odometry):
        pending = run_here(slam, scan.stamp_ns, pending)
        slam.add_scan(scan, case.mount, Pose2(*odom.tolist()))
        work = slam.take_work()
        if work is not None:
            pending = work.run()
    slam.finish()
    return slam


def pairs(case: Case) -> NDArray[np.int64]:
    """(P, 2) scans of two visits of a place, thinned evenly."""
    from scipy.spatial import cKDTree

    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(case.truth[:, :2], axis=0).T))))
    stamp = np.array([scan.stamp_ns for scan in case.scans]) * 1e-9
    near = cKDTree(case.truth[:, :2]).query_pairs(PAIR_M, output_type="ndarray")
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    a, b = near.T
    turned = np.abs(wrap_angles(case.truth[a, 2] - case.truth[b, 2]))
    far = (np.abs(way[b] - way[a]) > 30.0) & (np.abs(stamp[b] - stamp[a]) > 60.0) & (turned < PAIR_RAD)
    chosen = near[far]
    if not len(chosen):
        raise ValueError(f"{case.name}: no place is visited twice")
    return np.asarray(chosen[np.unique(np.linspace(0, len(chosen) - 1, MOST_PAIRS).astype(np.int64))], dtype=np.int64)


def pair_errors(case: Case, poses: F64, chosen: NDArray[np.int64]) -> tuple[F64, F64]:
    """(P,) metres and (P,) degrees."""
    a, b = chosen.T
    true, seen = relative_poses(case.truth[a], case.truth[b]), relative_poses(poses[a], poses[b])
    off = relative_poses(true, seen)
    return np.hypot(off[:, 0], off[:, 1]), np.abs(np.degrees(wrap_angles(off[:, 2])))


def false_closures(case: Case, slam: Slam) -> list[tuple[float, float]]:
    """How far (metres, degrees) those closures are off that are off too far."""
    truth = {s.stamp_ns: Pose2(*p.tolist()) @ case.mount for s, p in zip(case.scans, case.truth)}
    stamps, out = slam.key_stamps(), []
    for closure in slam.closures:
        off = (truth[stamps[closure.start]].inverse() @ truth[stamps[closure.to]]).inverse() @ closure.measured
        if math.hypot(off.x_m, off.y_m) > FALSE_M or abs(off.yaw_rad) > FALSE_RAD:
            out.append((math.hypot(off.x_m, off.y_m), math.degrees(off.yaw_rad)))
    return out


def after_fit(poses: F64, truth: F64) -> F64:
    """(N,) distances after the best rigid motion of poses onto truth."""
    p, t = poses[:, :2] - poses[:, :2].mean(axis=0), truth[:, :2] - truth[:, :2].mean(axis=0)
    yaw = math.atan2(float((p[:, 0] * t[:, 1] - p[:, 1] * t[:, 0]).sum()), float((p * t).sum()))
    c, s = math.cos(yaw), math.sin(yaw)
    return np.asarray(np.hypot(c * p[:, 0] - s * p[:, 1] - t[:, 0], s * p[:, 0] + c * p[:, 1] - t[:, 1]))


def row(case: Case, slam: Slam, seconds: float) -> dict[str, object]:
    """One line of the table."""
    poses, chosen = slam.trajectory()[1], pairs(case)
    off_m, off_deg = pair_errors(case, poses, chosen)
    false = false_closures(case, slam)
    way = float(np.hypot(*np.diff(case.truth[:, :2], axis=0).T).sum())
    return {
        "case": case.name,
        "way_m": round(way),
        "scans": len(case.scans),
        "odometry_off_m": round(float(after_fit(case.odometry, case.truth).max()), 1),
        "off_mean_m": round(float(after_fit(poses, case.truth).mean()), 3),
        "off_most_m": round(float(after_fit(poses, case.truth).max()), 3),
        "pairs": len(chosen),
        "pairs_closed": round(float((off_m < GOOD_M).mean()), 3),
        "pair_mean_m": round(float(off_m.mean()), 3),
        "pair_mean_deg": round(float(off_deg.mean()), 2),
        "closures": len(slam.closures),
        "searched": sum(c.searched for c in slam.closures),
        "false": len(false),
        "worst_false": [round(v, 2) for v in max(false, default=(0.0, 0.0))],
        "keys": slam.keys,
        "seconds": round(seconds, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0),
        "events": dict(sorted(slam.events.items())),
    }


def draw(case: Case, slam: Slam, path: Path) -> None:
    """Points of key scans where SLAM has them, and the path over the truth."""
    from PIL import Image

    poses = slam.trajectory()[1]
    step = 0.1
    clouds = []
    for scan, pose in zip(case.scans[::3], poses[::3]):
        at = Pose2(*pose.tolist()) @ case.mount
        seen = np.isfinite(scan.range_m) & (scan.range_m < 15.0)
        r, b = scan.range_m[seen], scan.bearing_rad[seen] + at.yaw_rad
        clouds.append(np.stack((at.x_m + r * np.cos(b), at.y_m + r * np.sin(b)), axis=-1))
    points = np.concatenate(clouds)
    low, high = points.min(axis=0) - 1.0, points.max(axis=0) + 1.0
    step = max(step, float((high - low).max()) / 2000.0)
    shape = np.ceil((high - low) / step).astype(int)
    picture = np.full((shape[1], shape[0], 3), 255, dtype=np.uint8)
    for cloud, colour in ((points, (0, 0, 0)), (case.truth[:, :2], (0, 160, 0)), (poses[:, :2], (200, 0, 0))):
        cell = np.floor((cloud - low) / step).astype(int)
        inside = np.all((cell >= 0) & (cell < shape), axis=1)
        picture[shape[1] - 1 - cell[inside, 1], cell[inside, 0]] = colour
    Image.fromarray(picture).save(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--json", type=Path, help="write the rows there")
    parser.add_argument("--draw", type=Path, help="a folder for pictures")
    options = parser.parse_args()
    rows: list[dict[str, object]] = []
    for name in options.cases:
        for seed in options.seeds:
            case = CASES[name](seed)
            began = time.thread_time()
            slam = drive(case)
            found = {"seed": seed, **row(case, slam, time.thread_time() - began)}
            rows.append(found)
            print("  ".join(f"{key} {value}" for key, value in found.items()), flush=True)
            if options.draw is not None:
                draw(case, slam, options.draw / f"{name}-{seed}.png")
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
