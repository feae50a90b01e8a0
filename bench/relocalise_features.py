"""Where am I, by anchor graphs alone: scenes from the first 60 % of a recorded run, questions from the rest.

    UMFELD_DATA=... python bench/relocalise_features.py [--json FILE] [--across]

Truth: the corrected paths of the logs (gfs). A scene and a question every 0.4 m or 20 degrees; each question is asked
without a hint, by one single scan and by one with the anchors of the last 2 m, joined by the log's odometry. Figures,
over the questions asked from where the place was seen before (a scene was taken within 1 m and 45 degrees; also within
2 m and 60), and over the others:
right    within 0.5 m and 5 degrees of the truth
wrong    another place was told
unknown  no place was told
Then the time of a question against 1, 4 and 16 times the scenes (the run's, laid out again 1 km apart with other walls:
mirrored and stretched) and with 1, 4 and 16 times the beams (of a simulated room).

--across does something else: least_score and least_lead are chosen on one log alone, and judged on the other. Chosen
are those with the most right answers among questions seen before (1 m, 45 degrees), at most 2 % of these wrong.
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from drivers.logs import read_log
from mapping.features.graph import AnchorGraph
from mapping.features.scenes import Answer, RecogniseRules, SceneDatabase, Sight, sight_of
from mapping.features.stretch import Stretch
from mapping.frames import Pose2, wrap_angle
from mapping.scan import Scan

F64 = NDArray[np.float64]
Posed = tuple[Scan, Pose2, Pose2]  # scan, truth, odometry

LOGS = ("intel", "fr079")
SHARE = 0.6
STEP_M, STEP_RAD = 0.4, math.radians(20.0)
RIGHT_M, RIGHT_RAD = 0.5, math.radians(5.0)
WRONG_SHARE = 0.02
HOW = ("one scan", "the last 2 m")
SEEN = {"seen before, 1 m and 45 deg": (1.0, 45.0), "seen before, 2 m and 60 deg": (2.0, 60.0)}


def posed_scans(name: str) -> list[Posed]:
    """The scans of a log that its corrected path has a pose for."""
    folder = Path(os.environ["UMFELD_DATA"]) / "carmen_logs"
    log = read_log(folder / f"{name}.clf.gz")
    path: dict[str, Pose2] = {}
    with gzip.open(folder / f"{name}.gfs.txt.gz", "rt") as file:
        for line in file:
            words = line.split()
            if words and not line.startswith("#"):
                path[words[0]] = Pose2(*(float(word) for word in words[1:4]))
    return [
        (
            Scan(0, 0.0, each.bearing_rad, each.range_m, 0.02, log.range_max_m),
            path[each.stamp_text],
            Pose2(*(float(v) for v in each.laser_pose)),
        )
        for each in log.scans
        if each.stamp_text in path
    ]


def spaced(scans: list[Posed]) -> Iterator[tuple[Scan, Pose2]]:
    """Those that are STEP_M or STEP_RAD from the last one."""
    for scan, pose, _ in stretches(scans):
        yield scan, pose


def stretches(scans: list[Posed]) -> Iterator[tuple[Scan, Pose2, Stretch]]:
    """The same, with the way there (to be asked at once)."""
    last: Pose2 | None = None
    stretch = Stretch(jump_m=math.inf, jump_rad=math.inf)
    for scan, pose, odometry in scans:
        stretch.take(scan, odometry)
        if last is None or distance(pose, last) >= STEP_M or abs(wrap_angle(pose.yaw_rad - last.yaw_rad)) >= STEP_RAD:
            last = pose
            yield scan, pose, stretch


def distance(a: Pose2, b: Pose2) -> float:
    return math.hypot(a.x_m - b.x_m, a.y_m - b.y_m)


def remembered(scans: list[Posed]) -> SceneDatabase:
    database = SceneDatabase()
    for scan, pose in spaced(scans):
        if not database.covers(pose):
            database.add(sight_of(scan), pose)
    return database


def outcome(database: SceneDatabase, sight: Sight, truth: Pose2, on_the_way: AnchorGraph | None = None) -> str:
    place = database.where_am_i(sight, on_the_way=on_the_way).place
    return "unknown" if place is None else judged(place.map_from_sensor, truth)


def judged(found: Pose2, truth: Pose2) -> str:
    return "right" if is_near(found, truth, RIGHT_M, RIGHT_RAD) else "wrong"


def is_near(a: Pose2, b: Pose2, within_m: float, within_rad: float) -> bool:
    return distance(a, b) < within_m and abs(wrap_angle(a.yaw_rad - b.yaw_rad)) < within_rad


def relocalise(name: str) -> dict[str, Any]:
    scans = posed_scans(name)
    cut = round(SHARE * len(scans))
    database = remembered(scans[:cut])
    tables = {
        f"{how}, {label}": {"right": 0, "wrong": 0, "unknown": 0} for how in HOW for label in (*SEEN, "not seen before")
    }
    for scan, pose, stretch in stretches(scans[cut:]):
        sight = sight_of(scan)
        told = (outcome(database, sight, pose), outcome(database, sight, pose, stretch.graph()))
        place, turn = database.apart(pose)
        seen = [label for label, (m, deg) in SEEN.items() if np.any((place < m) & (turn < math.radians(deg)))]
        for label in seen or ["not seen before"]:
            for how, each in zip(HOW, told, strict=True):
                tables[f"{how}, {label}"][each] += 1
    return {"scenes": len(database), "anchors": database.anchors, "memory_bytes": database.memory_bytes, **tables}


@dataclass(frozen=True, slots=True)
class Asked:
    """A question, all that was considered as its answers, by the way there and by the scan alone, and whether the place
    was seen before (1 m, 45 degrees)."""

    truth: Pose2
    answers: tuple[Answer, Answer]
    seen: bool

    def outcome(self, rules: RecogniseRules) -> str:
        """As `outcome`, had the answers been given by these rules: least_score, least_lead and least_partners."""
        first, second = (self._outcome(answer, rules) for answer in self.answers)
        return second if first == "unknown" else first

    def _outcome(self, answer: Answer, rules: RecogniseRules) -> str:
        if not answer.candidates:
            return "unknown"
        best, *others = answer.candidates
        place = best.map_from_sensor
        rivals = [
            each.score
            for each in others
            if not is_near(place, each.map_from_sensor, rules.apart_m, math.radians(rules.apart_deg))
        ]
        lead = best.score - max(rivals, default=-math.inf)
        if best.score < rules.least_score or best.partners < rules.least_partners or lead < rules.least_lead:
            return "unknown"
        return judged(place, self.truth)


def asked(name: str) -> list[Asked]:
    """Every question of a log."""
    scans = posed_scans(name)
    cut = round(SHARE * len(scans))
    database = remembered(scans[:cut])
    within_m, within_deg = next(iter(SEEN.values()))
    found = []
    for scan, pose, stretch in stretches(scans[cut:]):
        place, turn = database.apart(pose)
        seen = bool(np.any((place < within_m) & (turn < math.radians(within_deg))))
        sight = sight_of(scan)
        by_the_way = database.where_am_i(replace(sight, graph=stretch.graph()))
        found.append(Asked(pose, (by_the_way, database.where_am_i(sight)), seen))
    return found


def table(questions: list[Asked], rules: RecogniseRules) -> Counter[str]:
    return Counter({"right": 0, "wrong": 0, "unknown": 0}) + Counter(each.outcome(rules) for each in questions)


def chosen(questions: list[Asked]) -> RecogniseRules:
    """Of the rules that are wrong seldom enough, those that are right most often; the strictest of equals."""
    seen = [each for each in questions if each.seen]
    best, most = RecogniseRules(least_score=0.9, least_lead=0.3), -1
    for score, lead in product(np.arange(90, 49, -5), np.arange(30, 0, -5)):
        rules = RecogniseRules(least_score=score / 100, least_lead=lead / 100)
        counts = table(seen, rules)
        if counts["wrong"] <= WRONG_SHARE * len(seen) and counts["right"] > most:
            best, most = rules, counts["right"]
    return best


def across() -> dict[str, Any]:
    """Rules chosen on each log, and what they do on both."""
    questions = {name: asked(name) for name in LOGS}
    report: dict[str, Any] = {}
    for name in LOGS:
        rules = chosen(questions[name])
        entry: dict[str, Any] = {"least_score": rules.least_score, "least_lead": rules.least_lead}
        report[f"chosen on {name}"] = entry
        for judge in LOGS:
            for seen in (True, False):
                some = [each for each in questions[judge] if each.seen == seen]
                entry[f"{judge}, {'' if seen else 'not '}seen before"] = dict(table(some, rules))
    return report


def question_ms(database: SceneDatabase, sights: list[Sight], rounds: int = 3) -> dict[str, float]:
    """Median and 95th percentile over all questions, each the fastest of some rounds."""
    database.where_am_i(sights[0])
    times = []
    for sight in sights:
        spent = []
        for _ in range(rounds):
            start = time.perf_counter()
            database.where_am_i(sight)
            spent.append(time.perf_counter() - start)
        times.append(1e3 * min(spent))
    return {"median": round(float(np.median(times)), 2), "p95": round(float(np.percentile(times, 95)), 2)}


def other_walls(scan: Scan, number: int) -> Scan:
    """The scan of another building: stretched differently along both axes, every other one mirrored."""
    factor = 1.0 + 0.03 * number
    bearing, distance_m = scan.bearing_rad, scan.range_m
    c, s = np.cos(bearing), np.sin(bearing) / factor
    stretched = distance_m / np.hypot(c, s)
    return replace(scan, range_m=stretched if number % 2 == 0 else stretched[::-1].copy())


def growth_with_scenes(name: str) -> dict[str, Any]:
    scans = posed_scans(name)
    cut = round(SHARE * len(scans))
    kept = [(scan, pose) for scan, pose in spaced(scans[:cut])]
    sights = [sight_of(scan) for scan, _ in list(spaced(scans[cut:]))[:120]]
    result: dict[str, Any] = {}
    for times in (1, 4, 16):
        database = SceneDatabase()
        for number in range(times):
            for scan, pose in kept:
                at = Pose2(pose.x_m + 1000.0 * number, pose.y_m, pose.yaw_rad)
                database.add(sight_of(scan if number == 0 else other_walls(scan, number)), at)
        start = time.perf_counter()
        database.where_am_i(sights[0])
        first_ms = 1e3 * (time.perf_counter() - start)
        result[f"{times}x"] = {
            "scenes": len(database),
            "index_ms": round(first_ms, 1),
            "memory_mb": round(database.memory_bytes / 1e6, 1),
            "question_ms": question_ms(database, sights),
        }
    return result


def growth_with_beams() -> dict[str, Any]:
    """A drive through the office of bench/grid_insert.py, 270, 1080 and 4320 beams over 270 degrees."""
    from bench.grid_insert import cast, drive, office

    walls = office(np.random.default_rng(20))[0]
    result: dict[str, Any] = {}
    for beams in (270, 1080, 4320):
        bearing = np.linspace(-0.75 * math.pi, 0.75 * math.pi, beams)
        random, database, sights, made = np.random.default_rng(1), SceneDatabase(), [], []
        for pose, _ in drive("office"):
            ranges = cast(walls, pose.x_m, pose.y_m, bearing + pose.yaw_rad) + random.normal(0.0, 0.008, beams)
            scan = Scan(0, 0.0, bearing, ranges, 0.05, 30.0)
            sight_of(scan)
            start = time.perf_counter()
            sights.append(sight_of(scan))
            made.append(1e3 * (time.perf_counter() - start))
            database.add(sights[-1], pose)
        result[f"{beams} beams"] = {
            "scan_to_sight_ms": round(float(np.median(made)), 2),
            "question_ms": question_ms(database, sights[:40]),
        }
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--across", action="store_true")
    arguments = parser.parse_args()
    if "UMFELD_DATA" not in os.environ:
        parser.error("set UMFELD_DATA to the folder of recorded data")
    if arguments.across:
        print(json.dumps(across(), indent=2))
        return
    report: dict[str, Any] = {name: relocalise(name) for name in LOGS}
    for name in LOGS:
        print(f"{name}: {report[name]['scenes']} scenes, {report[name]['anchors']} anchors")
        for label in (f"{how}, {each}" for how in HOW for each in (*SEEN, "not seen before")):
            counts = report[name][label]
            total = sum(counts.values())
            shares = ", ".join(f"{key} {n} ({100 * n / max(total, 1):.1f} %)" for key, n in counts.items())
            print(f"  {label}: {total} asked; {shares}")
    report["scenes"] = growth_with_scenes("fr079")
    report["beams"] = growth_with_beams()
    for part in ("scenes", "beams"):
        for label, row in report[part].items():
            print(f"{part} {label}: {row}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
