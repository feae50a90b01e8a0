"""Localisation in a known map on recorded logs: global start, tracking, kidnapping, and how well its probability tells.

    UMFELD_DATA=folder PYTHONPATH=. .venv/bin/python bench/localise.py [--starts 200] [--kidnaps 40]
        [--cases fr079-2 wean3 ...] [--seed 7] [--no-tracking] [--fit] [--json FILE] [--picture FILE]
    PYTHONPATH=. .venv/bin/python bench/localise.py --drawn FILE [FILE ...] --picture FILE

Cases: LOG-1 is the first half of a log played in a map of its second half, LOG-2 the second half in a map of the first;
maps and truth are by SLAM over the whole log, so both halves lie in one frame. wean1, wean3 are Wean Hall's logs in the
map of another robot; their truth is the place tracked from the known start without a search, which is no independent
measurement. courts, courts8, alike, halls are buildings of the simulator (bench/localise_worlds.py); nothing is fitted
on them, and they are looked at only when they are asked for. Starts are random moments from which the robot drives for
10 s (standing still does not count) at places that the map shows. Kidnapping: 20 s of driving, then 20 s from another
place, the wheels feeling nothing; every other time the robot stands there for 3 s first.

Starts and jumps of one seed are always the same; --seed draws others, to judge what was chosen on the first. A case
takes about half a second of one core a start and 2 s a jump; several cases may be run side by side, each with a --json
of its own, and --drawn draws the reliability diagram of such files.

--fit fits the coefficients of mapping/localise/confidence.py on fr079-2, intel-2 and wean1 and prints them; the others
are held back.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.localise_worlds import WORLDS, driven_again, map_of
from drivers.logs import Log, read_log
from mapping.frames import Pose2, wrap_angle, wrap_angles
from mapping.grids.occupancy import OccupancyGrid
from mapping.localise.confidence import Coefficients, features, probability
from mapping.localise.in_map import InMapSettings, Located, MapLocaliser, SearchResult, State
from mapping.localise.known_map import BEAMS, FARTHEST_M, KnownMap, Points, hold, known_map, points_of, pose_of
from service.map_localiser import read_map
from service.slam_log import run_slam

F64 = NDArray[np.float64]

FITTED_ON = ("fr079-2", "intel-2", "wean1")
ALL = ("fr079-1", "fr079-2", "intel-1", "intel-2", "wean1", "wean3")
SIMULATED = tuple(WORLDS)
RIGHT_M, RIGHT_RAD = 0.5, math.radians(10.0)
WEAN_START = Pose2(44.75, 15.65, -1.54)
FEW = 10
CERTAIN = 0.95
WRONG_COUNTS = 2.0  # a right place that is doubted costs a moment, a wrong one that is believed more
BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 1.001)


@dataclass(frozen=True)
class Case:
    """A log in a map. first, last: scans that are played.  truth: (N, 3) robot poses in the map."""

    name: str
    known: KnownMap
    stamp_s: F64
    odom: F64
    points: Sequence[Points]
    truth: F64
    first: int
    last: int


def cases_of(names: Sequence[str], data: Path) -> list[Case]:
    """The cases asked for; SLAM runs once a log."""
    found = []
    for log_name in dict.fromkeys(name.rpartition("-")[0] for name in names if "-" in name):
        log = read_log(data / f"carmen_logs/{log_name}.clf.gz")
        truth = run_slam(log, log.scans).robot_poses
        middle, end = len(log.scans) // 2, len(log.scans)
        for name, played, mapped in (
            (f"{log_name}-1", (0, middle), (middle, end)),
            (f"{log_name}-2", (middle, end), (0, middle)),
        ):
            if name in names:
                found.append(_case(name, log, known_map(_grid(log, truth, *mapped).patch()), truth, *played))
    for name in names:
        if name.startswith("wean"):
            log = read_log(data / f"wean_localisation/robotdata{name[4:]}.log.gz")
            known = known_map(read_map(data / "wean_localisation/wean5300.yaml"))
            case = _case(name, log, known, np.zeros((len(log.scans), 3)), 0, len(log.scans))
            found.append(replace(case, truth=_tracked(case)))
        elif name in WORLDS:
            stamps, odom, points, truth = driven_again(name)
            found.append(Case(name, map_of(name), stamps, odom, points, truth, 0, len(stamps)))
    return found


def _case(name: str, log: Log, known: KnownMap, truth: F64, first: int, last: int) -> Case:
    mount = Pose2(*log.robot_from_laser)
    points = [
        points_of(s.bearing_rad, s.range_m, mount, nearest_m=0.05, farthest_m=FARTHEST_M, most=BEAMS) for s in log.scans
    ]
    stamps = np.array([scan.stamp_s for scan in log.scans])
    return Case(name, known, stamps, np.array([s.robot_pose for s in log.scans]), points, truth, first, last)


def _grid(log: Log, poses: F64, first: int, last: int) -> OccupancyGrid:
    grid = OccupancyGrid(model="log-odds")
    mount = Pose2(*log.robot_from_laser)
    for scan, pose in zip(log.scans[first:last], poses[first:last]):
        grid.insert_scan(
            pose_of(pose) @ mount, scan.bearing_rad, scan.range_m, range_max_m=log.range_max_m, clear_no_return=False
        )
    return grid


def _tracked(case: Case) -> F64:
    """The way from the known start, rivals kept out."""
    quiet = InMapSettings(carried=60.0, unsure=-1.0, stays=-1.0, sure=-1.0)
    if case.name == "wean3":
        quiet = InMapSettings(search_s=1e9, search_sure_s=1e9)
    played = play(case, range(case.first, case.last), settings=quiet, start=WEAN_START)
    return np.array([_row(located.map_from_base) for _, _, located in played])


def _row(pose: Pose2 | None) -> tuple[float, float, float]:
    return (math.nan,) * 3 if pose is None else (pose.x_m, pose.y_m, pose.yaw_rad)


Played = list[tuple[int, float, Located]]


def play(
    case: Case, order: Sequence[int], *, settings: InMapSettings | None = None, start: Pose2 | None = None
) -> Played:
    """Scans in an order; where it jumps the wheels feel nothing. Gives index, seconds from the first, what is known."""
    localiser = MapLocaliser(case.known, settings, start=start)
    pending: SearchResult | None = None
    odom, seconds, last, out = Pose2(), 0.0, -1, []
    for index in order:
        if last >= 0:
            if index == last + 1:
                odom = odom @ (pose_of(case.odom[last]).inverse() @ pose_of(case.odom[index]))
                seconds += max(0.0, float(case.stamp_s[index] - case.stamp_s[last]))
            else:
                seconds += 0.2
        last = index
        stamp_ns = round(seconds * 1e9)
        if localiser.is_due(stamp_ns) and pending is not None:
            localiser.apply(pending)
        out.append((index, seconds, localiser.add_scan(stamp_ns, case.points[index], odom)))
        work = localiser.take_work()
        pending = pending if work is None else work.run()
    return out


def off(case: Case, index: int, located: Located) -> tuple[float, float]:
    """Error in metres and radians; infinite without a place."""
    p, truth = located.map_from_base, case.truth[index]
    if p is None:
        return math.inf, math.inf
    return math.hypot(p.x_m - truth[0], p.y_m - truth[1]), abs(wrap_angle(p.yaw_rad - truth[2]))


def is_right(case: Case, index: int, located: Located) -> bool:
    metres, radians = off(case, index, located)
    return bool(metres < RIGHT_M and radians < RIGHT_RAD)


def driven(case: Case) -> F64:
    """(N,) seconds of driving up to each scan."""
    step, seconds = np.diff(case.odom, axis=0), np.maximum(np.diff(case.stamp_s), 1e-3)
    moves = (np.hypot(step[:, 0], step[:, 1]) / seconds > 0.03) | (
        np.abs(wrap_angles(step[:, 2])) / seconds > math.radians(3.0)
    )
    return np.concatenate(([0.0], np.cumsum(np.where(moves, seconds, 0.0))))


def starts_of(case: Case, count: int, seconds: float, seed: int) -> list[tuple[int, int]]:
    """Random pieces (first, after last) of so much driving at places that the map shows."""
    way = driven(case)
    shown = np.zeros(len(case.points), dtype=bool)
    for index in range(case.first, case.last):
        if len(case.points[index]) >= 12:
            shown[index] = hold(case.known, case.points[index], case.truth[index][None]).explained[0] > 0.6
    pieces = []
    for index in range(case.first, case.last):
        end = int(np.searchsorted(way, way[index] + seconds))
        lasts = end < case.last and case.stamp_s[end] - case.stamp_s[index] < 3.0 * seconds
        if lasts and shown[index:end].mean() > 0.8:
            pieces.append((index, end))
    rng = np.random.default_rng(seed)
    return [pieces[k] for k in rng.choice(len(pieces), min(count, len(pieces)), replace=False)]


Sample = tuple[F64, F64, bool, float]


def samples_of(case: Case, played: Played) -> list[Sample]:
    """Every 0.4 s: features, whether the first place is right, the probability told."""
    found, told_s = [], -1.0
    for index, seconds, located in played:
        if located.map_from_base is None or not located.evidence.challenged or seconds - told_s < 0.4:
            continue
        told_s = seconds
        alone, fits = features(located.evidence)
        found.append((alone, fits, is_right(case, index, located), probability(located.evidence)))
    return found


def global_starts(case: Case, count: int, samples: list[Sample], *, seed: int = 7) -> dict[str, object]:
    """How many starts end right after 10 s of driving, and for how long any was sure of a wrong place."""
    way = driven(case)
    right = sure = wrong = lost = 0
    longest_s = 0.0
    pieces = starts_of(case, count, 10.0, seed=seed)
    began, scans = time.thread_time(), 0
    for first, end in pieces:
        played = play(case, range(first, end + 1))
        scans += len(played)
        index, _, located = [each for each in played if way[each[0]] - way[first] <= 10.0][-1]
        good = is_right(case, index, located)
        right += good
        sure += good and located.state is State.SURE
        wrong += not good and located.state is State.SURE
        lost += not good and located.state is State.LOST
        wrong_spans = [(s, each.state is State.SURE and not is_right(case, k, each)) for k, s, each in played]
        longest_s = max(longest_s, _longest(wrong_spans))
        samples += samples_of(case, played)
    spent = time.thread_time() - began
    return {
        "starts": len(pieces), "best_right": right, "sure_right": sure, "sure_wrong": wrong, "lost": lost,
        "longest_sure_of_a_wrong_place_s": round(longest_s, 1),
        "ms_per_scan": round(1e3 * spent / max(1, scans), 2),
    }  # fmt: skip


def tracking(case: Case) -> dict[str, object]:
    """Errors while sure over the whole run, and squared errors in units of the covariance."""
    errors, turns, nees, sure = [], [], [], 0
    began = time.thread_time()
    played = play(case, range(case.first, case.last))
    spent = time.thread_time() - began
    for index, _, located in played:
        if located.state is not State.SURE or located.map_from_base is None:
            continue
        sure += 1
        metres, radians = off(case, index, located)
        if metres < RIGHT_M and radians < RIGHT_RAD:
            p, truth = located.map_from_base, case.truth[index]
            e = np.array([p.x_m - truth[0], p.y_m - truth[1], wrap_angle(p.yaw_rad - truth[2])])
            nees.append(float(e @ np.linalg.solve(located.covariance, e)))
        errors.append(metres)
        turns.append(math.degrees(radians))
    return {
        "sure_share": round(sure / len(played), 3),
        "median_m": round(float(np.median(errors)), 4), "p95_m": round(float(np.percentile(errors, 95)), 3),
        "median_deg": round(float(np.median(turns)), 3),
        "wrong_share": round(float(np.mean(np.array(errors) > RIGHT_M)), 4),
        "nees_median": round(float(np.median(nees)), 2), "nees_mean": round(float(np.mean(nees)), 2),
        "scans_per_second": round(len(played) / spent, 1),
    }  # fmt: skip


def kidnapping(
    case: Case, count: int, samples: list[Sample], *, seed: int = 11, watch_s: float = 20.0
) -> dict[str, object]:
    """Jumps of robots that were sure and right: how long still sure of the wrong place, and when sure of the right.

    watch_s: of driving after the jump that are looked at, fewer where the run ends.  wrong_at_the_end: those whose best
    place was wrong then, sure or not.
    """
    way = driven(case)
    pieces = starts_of(case, 4 * count, 20.0, seed=seed)
    wrong_s: list[float] = []
    longest_s: list[float] = []
    back_s: list[float] = []
    not_back = not_right = 0
    for (first, end), (other, other_end) in zip(pieces[0::2], pieces[1::2]):
        if len(wrong_s) >= count or abs(other - first) < 50:
            continue
        before, standing = range(first, end), [other] * (15 * (len(wrong_s) % 2))
        if watch_s > 20.0:
            other_end = min(int(np.searchsorted(way, way[other] + watch_s)), case.last)
        played = play(case, [*before, *standing, *range(other, other_end)])
        samples += samples_of(case, played)
        index, jump_s, located = played[len(before) - 1]
        if located.state is not State.SURE or not is_right(case, index, located):
            continue
        if math.dist(case.truth[end - 1][:2], case.truth[other][:2]) < 1.0:
            continue
        after = played[len(before) :]
        states = [(s - jump_s, each.state is State.SURE, is_right(case, k, each)) for k, s, each in after]
        wrong_s.append(next((s for s, sure, right in states if not sure or right), math.inf))
        longest_s.append(_longest([(s, sure and not right) for s, sure, right in states]))
        came = next((s for s, sure, right in states if sure and right), None)
        back_s += [] if came is None else [came]
        not_back += came is None
        not_right += not states[-1][2]
    if not wrong_s:
        return {"jumps": 0}
    return {
        "jumps": len(wrong_s),
        "said_within_5_s": round(float(np.mean(np.array(wrong_s) <= 5.0)), 3),
        "said_median_s": round(float(np.median(wrong_s)), 2), "said_largest_s": round(float(np.max(wrong_s)), 2),
        "wrong_for_more_than_5_s": int(np.sum(np.array(longest_s) > 5.0)),
        "back_median_s": round(float(np.median(back_s)), 2) if back_s else None,
        "back_largest_s": round(float(np.max(back_s)), 2) if back_s else None, "not_back": not_back,
        "wrong_at_the_end": not_right,
    }  # fmt: skip


def _longest(spans: list[tuple[float, bool]]) -> float:
    """Longest stretch of seconds in which it is so."""
    longest, began = 0.0, None
    for seconds, so in spans:
        began = (began if began is not None else seconds) if so else None
        longest = max(longest, 0.0 if began is None else seconds - began)
    return longest


def reliability(samples: list[Sample]) -> list[tuple[float, float, int]]:
    """For each bin of told probability: its mean, the share that was right, how many."""
    told = np.array([s[3] for s in samples])
    right = np.array([s[2] for s in samples], dtype=float)
    rows = []
    for low, high in pairwise(BINS):
        inside = (told >= low) & (told < high)
        if inside.any():
            rows.append(
                (round(float(told[inside].mean()), 3), round(float(right[inside].mean()), 3), int(inside.sum()))
            )
    return rows


def told(samples: list[Sample]) -> dict[str, float]:
    """How the probability does over all samples: Brier score, how far off it is on average over the bins (ECE), and
    what is told as almost certain."""
    p, right = np.array([s[3] for s in samples]), np.array([s[2] for s in samples], dtype=float)
    certain = p >= CERTAIN
    off_by = sum(abs(mean - share) * count for mean, share, count in reliability(samples)) / len(samples)
    return {
        "brier": round(float(np.mean((p - right) ** 2)), 3), "ece": round(off_by, 3),
        "certain_share": round(float(certain.mean()), 3),
        "wrong_of_certain": round(float(1.0 - right[certain].mean()), 4) if certain.any() else 0.0,
    }  # fmt: skip


def fitted(samples: list[Sample]) -> Coefficients:
    """Coefficients of least cross entropy, a little shrunk; wrong places count more than right ones."""
    from scipy.optimize import minimize

    alone, fits = np.array([s[0] for s in samples]), np.array([s[1] for s in samples])
    right = np.array([s[2] for s in samples], dtype=float)
    logistic: Callable[[F64], F64] = lambda z: 1.0 / (1.0 + np.exp(-np.clip(z, -50.0, 50.0)))  # noqa: E731

    def loss(w: F64) -> float:
        p = np.clip(logistic(alone @ w[:3]) * logistic(fits @ w[3:]), 1e-6, 1.0 - 1e-6)
        return float(-np.mean(right * np.log(p) + WRONG_COUNTS * (1.0 - right) * np.log(1.0 - p)) + 1e-4 * w @ w)

    best = minimize(loss, np.array([3.4, 0.9, -1.2, -7.0, 10.6, 1.3, 1.0]), method="BFGS").x
    a, b, c, d, e, f, g = (round(float(v), 2) for v in best)
    return Coefficients((a, b, c), (d, e, f, g))


def draw(rows: dict[str, list[tuple[float, float, int]]], path: Path) -> None:
    """The reliability diagram, without bins of fewer than FEW samples."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5.2, 4.6), dpi=110)
    axes.plot([0, 1], [0, 1], color="0.6", lw=1)
    for name, every in rows.items():
        each = [row for row in every if row[2] >= FEW]
        style = "--" if name in FITTED_ON else "-"
        axes.plot([r[0] for r in each], [r[1] for r in each], f"o{style}", ms=4, lw=1.2, label=name)
    axes.set(xlabel="probability told", ylabel="share that was right", xlim=(0, 1.01), ylim=(0, 1.01))
    axes.legend(title="dashed: fitted on", fontsize=8)
    figure.tight_layout()
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=list(ALL), choices=ALL + SIMULATED)
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--kidnaps", type=int, default=40)
    parser.add_argument("--watch-s", type=float, default=20.0, help="driving that is looked at after a jump")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--no-tracking", action="store_true")
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--drawn", nargs="+", type=Path, help="reports that --json wrote: draw these, measure nothing")
    asked = parser.parse_args()
    if asked.drawn is not None:
        kept = {name: each for path in asked.drawn for name, each in json.loads(path.read_text()).items()}
        draw({name: kept[name]["reliability"] for name in ALL + SIMULATED if name in kept}, asked.picture)
        return
    report: dict[str, dict[str, object]] = {}
    samples: dict[str, list[Sample]] = {}
    for case in cases_of(asked.cases, Path(os.environ["UMFELD_DATA"])):
        seen = samples.setdefault(case.name, [])
        report[case.name] = {
            **({} if asked.no_tracking else {"tracking": tracking(case)}),
            "start": global_starts(case, asked.starts, seen, seed=asked.seed),
            "kidnapping": kidnapping(case, asked.kidnaps, seen, seed=asked.seed + 4, watch_s=asked.watch_s),
            "told": told(seen) if seen else {},
            "reliability": reliability(seen),
        }
        print(case.name, json.dumps(report[case.name]), flush=True)
        if asked.json is not None:
            asked.json.write_text(json.dumps(report, indent=1) + "\n")
    if asked.picture is not None:
        draw({name: reliability(each) for name, each in samples.items()}, asked.picture)
    if asked.fit:
        print(fitted([s for name in FITTED_ON for s in samples.get(name, [])]))


if __name__ == "__main__":
    main()
