"""What live SLAM costs: a laser of 1081 beams at 40 Hz round the simulated 60 m loop, in real time, wheels at 100 Hz.

    python bench/slam_live.py [--seconds 40] [--json FILE]

The daemon's own fusion thread, background threads and localiser; no wires, no network. Told are the core's share of
localising (de-skew, match, keep, and what runs beside: loops, drawing anew), that of the whole, and how long after a
wheel reading arrived its pose was handed to the publisher. Run it on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from drivers.readings import Reading, ScanReading, WheelReading
from mapping.frames import Pose2
from mapping.pose_buffer import PoseBuffer
from mapping.scan import Scan
from service import assemble
from service.background import Background
from service.config import Config
from service.fusion import Fusion
from service.outputs import HealthOut, Output, PoseOut
from service.redraw import Redrawer
from service.slam_live import SlamLocaliser
from service.warm_up import warm_up
from service.worker import Worker
from sim_devices.floor_plan import load_floor_plan
from sim_devices.robot import follow
from sim_devices.world import World

F64 = NDArray[np.float64]
T = TypeVar("T")

MS = 1_000_000
BEAMS = 1081
SCAN_MS = 25
WHEELS_MS = 10
TRACK_M = 0.4
TICKS_PER_M = 20_000
RANGE_MAX_M = 30.0

CONFIG = Config.model_validate(
    {
        "drive": {
            "source": "base",
            "wheel_radius_left_m": 1 / (2 * math.pi),
            "wheel_radius_right_m": 1 / (2 * math.pi),
            "track_width_m": TRACK_M,
            "ticks_per_turn_left": TICKS_PER_M,
            "ticks_per_turn_right": TICKS_PER_M,
        },
        "can": {"main": {"interface": "virtual", "channel": "x"}},
        "lasers": {"front": {"driver": "hokuyo", "port": "/dev/none", "mount": {"x_m": 0.2, "z_m": 0.3}}},
        "wheels": {"base": {"driver": "cia406", "can": "main"}},
        "sectors": {"polar": {"all": {"sources": ("front",)}}},
    }
)


def readings(seconds: float) -> list[tuple[int, str, Reading]]:
    """(arrival, source, reading) by arrival; odometry errs by 3 % in turns."""
    plan = load_floor_plan("loop")
    assert plan.route is not None
    world, motion = World.from_plan(plan, 0), follow(plan.route)
    rng = np.random.default_rng(0)
    stamps = np.arange(0, round(seconds * 1000), WHEELS_MS)
    way = np.stack(motion.way_at(stamps.astype(np.float64) * 1e-3))
    turned = 1.03 * way[1]
    left, right = way[0] - 0.5 * TRACK_M * turned, way[0] + 0.5 * TRACK_M * turned
    items: list[tuple[int, str, Reading]] = []
    for stamp, a, b in zip(stamps.tolist(), left, right):
        reading = WheelReading(stamp * MS, round(a * TICKS_PER_M), round(b * TICKS_PER_M), True)
        items.append((stamp * MS + MS, "base", reading))
    bearing = np.radians(np.linspace(-135.0, 135.0, BEAMS))
    period_ns = SCAN_MS * MS * 0.75 / BEAMS
    for stamp in range(SCAN_MS, round(seconds * 1000) - 100, SCAN_MS):
        beams_s = stamp * 1e-3 + np.arange(BEAMS, dtype=np.float64) * period_ns * 1e-9
        bases = motion.pose_at(beams_s)
        origin = bases[:, :2] + 0.2 * np.stack((np.cos(bases[:, 2]), np.sin(bases[:, 2])), axis=-1)
        reach = world.beam_distances(origin, bases[:, 2] + bearing, beams_s, z_m=0.3, range_max_m=RANGE_MAX_M)
        noisy = reach + rng.normal(0.0, 0.01, BEAMS)
        scan = ScanReading(stamp * MS, period_ns, SCAN_MS * MS, bearing, noisy, 0.05, RANGE_MAX_M)
        items.append((stamp * MS + 19 * MS, "front", scan))
    items.sort(key=lambda item: item[0])
    return items


class Metered(SlamLocaliser):
    """Counts the core time of localising on the fusion thread."""

    spent_ns = 0

    def take_scan(self, sensor: str, scan: Scan, odom_from_base: PoseBuffer, base_from_sensor: Pose2) -> bool:
        began = time.thread_time_ns()
        fits = super().take_scan(sensor, scan, odom_from_base, base_from_sensor)
        self.spent_ns += time.thread_time_ns() - began
        return fits


def measure(seconds: float) -> dict[str, float]:
    """Play in real time; see the module's text."""
    sys.setswitchinterval(0.001)  # as the daemon does
    items = readings(seconds)
    warm_up(CONFIG)
    beside_ns: list[int] = []
    background = Background()

    def submit(work: Callable[[], T], /) -> Future[T]:
        def timed() -> T:
            began = time.thread_time_ns()
            try:
                return work()
            finally:
                beside_ns.append(time.thread_time_ns() - began)

        return background.submit(timed)

    sensors = assemble.sensors(CONFIG)
    maps = assemble.maps(CONFIG, sensors)
    redrawer = Redrawer(maps.grids, maps.building, {"front": Pose2(0.2, 0.0, 0.0)}, submit=submit)
    localiser = Metered({"front"}, submit=submit, redrawer=redrawer)
    fusion = Fusion(assemble.parts(CONFIG, sensors, maps, localiser))
    begun_ns = time.monotonic_ns() + 200 * MS
    told: list[tuple[int, int]] = []

    def offer(output: Output) -> None:
        if isinstance(output, PoseOut):
            told.append((output.stamp_ns, time.monotonic_ns() - begun_ns))

    worker = Worker(
        fusion,
        offer,
        now_ns=lambda: time.monotonic_ns() - begun_ns,
        beat=lambda _: None,
        health=lambda now_ns: HealthOut(now_ns, 0, "", (), {}, {}),
    )
    arrived: dict[int, int] = {}
    cpu_began = time.process_time_ns()
    worker.start()
    pause = threading.Event()
    for arrival_ns, source, reading in items:
        left_s = (arrival_ns - (time.monotonic_ns() - begun_ns)) * 1e-9
        if left_s > 0:
            pause.wait(left_s)
        if source == "base":
            arrived[reading.stamp_ns] = time.monotonic_ns() - begun_ns
        worker.sink(source, reading)
    worker.stop(10.0)
    background.stop(10.0)
    cpu_ns = time.process_time_ns() - cpu_began
    late_ms = np.array([(at - arrived[stamp]) / 1e6 for stamp, at in told])
    counters = fusion.counters()
    return {
        "seconds": seconds,
        "localising_percent_of_a_core": round(100.0 * localiser.spent_ns * 1e-9 / seconds, 1),
        "beside_percent_of_a_core": round(100.0 * sum(beside_ns) * 1e-9 / seconds, 1),
        "process_percent_of_a_core": round(100.0 * cpu_ns * 1e-9 / seconds, 1),
        "pose_latency_ms_p50": round(float(np.quantile(late_ms, 0.5)), 2),
        "pose_latency_ms_p99": round(float(np.quantile(late_ms, 0.99)), 2),
        "pose_latency_ms_most": round(float(late_ms.max()), 2),
        "scans_matched": counters["slam.scans"],
        "scans_passed": counters["slam.scans_passed"],
        "key_scans": counters["slam.key_scans"],
        "closures": counters["slam.closures"],
        "redrawn": counters["map.redrawn"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--json", type=Path, help="write the figures there")
    arguments = parser.parse_args()
    figures = measure(arguments.seconds)
    for name, value in figures.items():
        print(f"{name:32} {value}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
