"""Recorded logs through emulated bytes, driver, fusion and makers of maps: the daemon's grid against scans held back.

As `umfeld sim --log` and `umfeld run` do it with poses from the wheels, in simulated time: every tenth scan of a log
with corrected poses is left out, the rest is played by the emulated laser as bytes, the wheels are asked every 10 ms.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from drivers.conversation import SetBaudRate
from drivers.laser_hokuyo import HokuyoConversation
from drivers.logs import Log, read_log
from drivers.readings import Reading, ScanReading, WheelReading
from mapping.frames import Pose2
from service import assemble, assemble_makers
from service.background import at_once
from service.config import Config
from service.fusion import TICK_PERIOD_NS, Fusion
from service.layers import BuildingLayer
from service.map_build import HoldOut, judge
from service.map_makers import MapMakers, SweepTap
from service.outputs import Output
from sim_devices.laser_hokuyo import HokuyoLaser
from sim_devices.log_scene import LogScene, Pace, laser_profile
from sim_devices.presets import for_log, preset
from tests.world.test_live_slam_worlds import Subscriber

DATA = Path(os.environ.get("UMFELD_DATA", "/nonexistent"))
needs_data = pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")

EVERY = 10
PACE = Pace(speed=1000.0)  # as fast as stands and ways allow
STEP_NS = 2_000_000
WHEELS_NS = 10_000_000
TRACK_M = 0.5
TICKS_PER_M = 4096 / (2.0 * math.pi * 0.1)


@dataclass(frozen=True)
class Made:
    """What a subscriber has at the end, and what is exported."""

    published: HoldOut
    exported: HoldOut
    counted: HoldOut


def scene_of(log: Log) -> LogScene:
    left = tuple(scan for k, scan in enumerate(log.scans) if k % EVERY)
    return LogScene(replace(log, scans=left), pace=PACE, track_width_m=TRACK_M)


def said(log: Log) -> list[tuple[int, str, Reading]]:
    """What driver and wheels say, and when it is there."""
    scene = scene_of(log)
    laser = HokuyoLaser(scene, scene.mount, profile=laser_profile(scene.log), link="usb", noise_scale=0.0)
    driver = HokuyoConversation()
    now = 1_000_000_000
    driver.connected(now)
    items: list[tuple[int, str, Reading]] = []
    to_device = b""
    start = scene.wheel_travel_m(now)
    while not scene.has_ended(now):
        now += STEP_NS
        if now % WHEELS_NS == 0:
            left, right = (b - a for a, b in zip(start, scene.wheel_travel_m(now)))
            ticks = round(left * TICKS_PER_M), round(-right * TICKS_PER_M)
            items.append((now, "drive", WheelReading(now, *ticks, True)))
        sent = laser.step(now, to_device)
        to_device = b""
        if sent:
            items += [(now, "front", r) for r in driver.receive(sent, now) if isinstance(r, ScanReading)]
        for request in driver.requests(now):
            to_device += b"" if isinstance(request, SetBaudRate) else request
        if items and items[-1][1] == "front":
            scene.begin_motion(now)
    return items


@lru_cache(maxsize=1)
def log_and_items(name: str) -> tuple[Log, list[tuple[int, str, Reading]]]:
    log = read_log(DATA / f"known_pose_logs/{name}-corrected.log.gz")
    return log, said(log)


def made(name: str, **grid: object) -> Made:
    log, items = log_and_items(name)
    table = for_log(preset("artos"), scene_of(log).mount, track_width_m=TRACK_M, rate_hz=100.0, wheel_m_s=10.0)
    table["grid"] = {**table.get("grid", {}), **grid}
    table["slam"] = {"enabled": False}
    config = Config.model_validate_json(json.dumps(table))
    sensors = assemble.sensors(config)
    maps = assemble.maps(config, sensors)
    building = maps.building
    assert isinstance(building, BuildingLayer)
    walls = assemble_makers.wall_maker(config, sensors, building)
    makers = MapMakers([] if walls is None else [walls], lambda _output: None, now_ns=lambda: 0)
    parts = assemble.parts(config, sensors, maps, assemble.localiser(config, sensors, maps, Pose2(), at_once))
    fusion = Fusion(replace(parts, grids=(*parts.grids, SweepTap(makers, makers.sources))))
    subscriber = Subscriber()

    def take(outputs: list[Output], now_ns: int) -> None:
        for output in outputs:
            subscriber.take(output)
            makers.take_output(output)
        makers.turn(now_ns)

    tick_ns = items[0][0]
    for now_ns, source, reading in items:
        while tick_ns <= now_ns:
            take(fusion.tick(tick_ns), tick_ns)
            tick_ns += TICK_PERIOD_NS
        take(fusion.on_item(source, reading, now_ns), now_ns)
        fusion.settle(now_ns)
    if walls is not None:
        walls.settle()
    for _ in range(200):
        take(fusion.tick(tick_ns), tick_ns)
        tick_ns += TICK_PERIOD_NS
    assert subscriber.patch is not None
    assert makers.counters()["makers.errors"] == 0
    assert sum(sum(each.values()) for each in fusion.drops.values()) == 0, fusion.drops
    exported = building.grid.patch()
    for row, col in building.grid.places():
        building.grid.show_walls(row, col, None)
    held = range(0, len(log.scans), EVERY)
    first = Pose2(*log.scans[1].robot_pose).inverse()
    poses = [first @ Pose2(*log.scans[k].robot_pose) for k in held]
    rows = np.array([(pose.x_m, pose.y_m, pose.yaw_rad) for pose in poses])
    judged = [
        judge(patch, log, [log.scans[k] for k in held], rows)
        for patch in (subscriber.patch, exported, building.grid.patch())
    ]
    return Made(*judged)


@pytest.mark.data
@needs_data
@pytest.mark.parametrize(
    ("name", "near", "early"),
    [("belgioioso", 0.96, 0.025), ("seattle", 0.99, 0.021)],  # measured 0.966, 0.0245 and 0.996, 0.0205
)
def test_the_daemons_walls_are_crisp(name: str, near: float, early: float) -> None:
    """Cells as counted give 0.919, 0.032 and 0.979, 0.037 here."""
    crisp = made(name)
    assert crisp.published == crisp.exported
    assert crisp.published.near_occupied >= near
    assert crisp.published.crossing_early <= early
    assert crisp.published.near_occupied > crisp.counted.near_occupied + 0.01
    assert crisp.published.crossing_early < crisp.counted.crossing_early


@pytest.mark.data
@needs_data
def test_without_the_walls_cells_are_published_as_counted() -> None:
    plain = made("seattle", crisp=False)
    assert plain.published == plain.exported == plain.counted
