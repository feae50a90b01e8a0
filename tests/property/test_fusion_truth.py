"""Properties of fusion with real maps behind it, under anything that readings can do.

The world is a round room with a pillar: truth is known in closed form, so whatever is called free can be judged.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.readings import (
    ChainReading,
    DeviceEvent,
    LinkState,
    RangeReading,
    RangeStatus,
    Reading,
    ScanReading,
    WheelReading,
)
from mapping.grids.occupancy import OccupancyGrid
from mapping.sectors.snapshot import SectorState
from service import assemble
from service.config import Config
from service.fusion import Fusion, OdometryOnly
from service.outputs import GridOut, Output, PolarOut, RectOut
from service.payloads import Encoder

MS = 1_000_000
ROOM_M = 4.0
PILLAR_M, PILLAR_FROM, PILLAR_TO = 1.5, 0.2, 0.6  # nearer between these bearings
CONFIG = Config.model_validate(
    {
        "drive": {"source": "base"},
        "can": {"main": {"interface": "virtual", "channel": "x"}},
        "lasers": {"front": {"driver": "hokuyo", "port": "/dev/none"}},
        "sonars": {
            "ring": {
                "driver": "usboard",
                "can": "main",
                "transducers": ({"channel": 1, "yaw_deg": 0.0}, {"channel": 2, "yaw_deg": 90.0}),
            }
        },
        "wheels": {"base": {"driver": "cia406", "can": "main"}},
        "sectors": {
            "polar": {"all": {"sources": ("front",)}, "ears": {"sources": ("ring",)}},
            "rect": {"around": {"sources": ("front", "ring"), "size_m": (6.0, 6.0), "sector_m": 0.5}},
        },
    }
)
BEARING = np.linspace(-2.0, 2.0, 161)

Item = tuple[str, Reading | DeviceEvent]


def truth_m(bearing_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far it is from the origin to the first thing, by bearing."""
    pillar = (bearing_rad >= PILLAR_FROM) & (bearing_rad <= PILLAR_TO)
    return np.where(pillar, PILLAR_M, ROOM_M)


def honest(step: int) -> list[Item]:
    """What the devices say at step * 50 ms; the robot stands still."""
    now = 1000 * MS + step * 50 * MS
    scan = ScanReading(now, 0.0, 50 * MS, BEARING, truth_m(BEARING), 0.05, 10.0)
    heard = (RangeReading(1, PILLAR_M, RangeStatus.ECHO), RangeReading(2, math.inf, RangeStatus.NO_RETURN))
    return [("base", WheelReading(now - MS, 0, 0, True)), ("front", scan), ("ring", ChainReading(now, heard))]


def spoilt(item: Item, how: str, strength: int) -> list[Item]:
    """One reading as a fault leaves it. No fault invents a longer distance: devices that lie are for the emulators."""
    source, reading = item
    now = reading.stamp_ns
    match how:
        case "none":
            return [item]
        case "drop":
            return []
        case "twice":
            return [item, item]
        case "late":
            return [(source, replace(reading, stamp_ns=now - strength * MS))]
        case "early":
            return [(source, replace(reading, stamp_ns=now + strength * MS))]
        case "gone":
            return [(source, DeviceEvent(now, LinkState(strength % 3), "a fault")), item]
        case "lost":
            return [item, (source, DeviceEvent(now, LinkState(strength % 3), "a fault"))]
    if isinstance(reading, ScanReading):
        return [(source, _spoilt_scan(reading, how, strength))]
    return [item]


def _spoilt_scan(reading: ScanReading, how: str, strength: int) -> ScanReading:
    chosen = np.random.default_rng(strength).random(len(BEARING)) < 0.3
    match how:
        case "invalid":
            return replace(reading, range_m=np.where(chosen, np.nan, reading.range_m))
        case "close":
            return replace(reading, range_m=np.where(chosen, -np.inf, reading.range_m))
        case "zero":
            return replace(reading, range_m=np.where(chosen, 0.0, reading.range_m))
        case "half":
            return replace(reading, bearing_rad=BEARING[: strength % 161], range_m=truth_m(BEARING)[: strength % 161])
        case "wrong":
            return replace(reading, range_m=reading.range_m[:-1])
        case "sparse":
            return replace(reading, bearing_rad=BEARING[::7], range_m=truth_m(BEARING)[::7])
        case "unplaced":
            return replace(reading, bearing_rad=np.where(chosen, np.nan, BEARING))
        case _:
            raise AssertionError(how)


FAULTS = (
    *("none", "drop", "twice", "late", "early", "gone", "lost"),
    *("invalid", "close", "zero", "half", "wrong", "sparse", "unplaced"),
)
STORY = st.lists(st.tuples(st.sampled_from(FAULTS), st.integers(0, 400)), min_size=3, max_size=60)


def told(story: list[tuple[str, int]]) -> list[tuple[int, Item]]:
    """A story of faults as items with the time they arrive."""
    items: list[tuple[int, Item]] = []
    for number, (how, strength) in enumerate(story):
        step, which = divmod(number, 3)
        now = 1000 * MS + step * 50 * MS + 30 * MS
        items += [(now, item) for item in spoilt(honest(step)[which], how, strength)]
    return items


def play(items: list[tuple[int, Item]]) -> tuple[list[tuple[int, Output]], OccupancyGrid]:
    """All outputs with the time they were made, ticks between included, and the grid at the end."""
    sensors = assemble.sensors(CONFIG)
    maps = assemble.maps(CONFIG, sensors)
    assert maps.building is not None
    fusion = Fusion(assemble.parts(CONFIG, sensors, maps, OdometryOnly()))
    outputs: list[tuple[int, Output]] = []
    now = 1000 * MS
    for arrival, (source, reading) in [*items, (items[-1][0] + 1500 * MS if items else now, ("none", _NEWS))]:
        while now + 25 * MS <= arrival:
            now += 25 * MS
            outputs += [(now, output) for output in fusion.tick(now)]
        outputs += [(arrival, output) for output in fusion.on_item(source, reading, arrival)]
        fusion.settle(arrival)
    return outputs, maps.building.grid


_NEWS = DeviceEvent(0, LinkState.RUNNING, "")


def test_the_honest_story_is_seen_as_it_is() -> None:
    """The others would pass on a fusion that never calls anything free."""
    outputs, grid = play(told([("none", 0)] * 30))
    last = [output for now, output in outputs if now < 1500 * MS and isinstance(output, PolarOut)]
    polar = next(output.snapshot for output in reversed(last) if output.name == "all")
    assert (polar.state == SectorState.OBSTACLE).sum() >= 44
    assert np.nanmin(polar.distance_m) == pytest.approx(PILLAR_M)
    rect = next(
        output.snapshot for _, output in outputs if isinstance(output, RectOut) and (output.snapshot.state == 1).any()
    )
    assert (rect.state == SectorState.FREE).sum() >= 10
    assert (grid.patch().cells == 0).sum() > 1000


MANY = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@MANY
@given(STORY)
def test_no_fault_makes_anything_freer_than_it_is(story: list[tuple[str, int]]) -> None:
    outputs, grid = play(told(story))
    for _, output in outputs:
        if isinstance(output, PolarOut) and output.name == "all":
            snap = output.snapshot
            for index in np.flatnonzero(snap.state == SectorState.FREE):
                inside = np.linspace(snap.edges_rad[index], snap.edges_rad[index + 1], 20)[1:-1]
                assert snap.distance_m[index] <= truth_m(inside).min() + 1e-6
        if isinstance(output, RectOut):
            rect = output.snapshot
            for row, col in np.argwhere(rect.state == SectorState.FREE):
                corners = [
                    math.hypot(x, y) for x in rect.x_edges_m[col : col + 2] for y in rect.y_edges_m[row : row + 2]
                ]
                assert max(corners) <= ROOM_M + 1e-6
    patch = grid.patch()
    rows, cols = np.nonzero((patch.cells >= 0) & (patch.cells <= 20))
    x, y = (cols + patch.col0 + 0.5) * 0.05, (rows + patch.row0 + 0.5) * 0.05
    reach = truth_m(np.arctan2(y, x))
    edge = np.minimum(np.abs(np.arctan2(y, x) - PILLAR_FROM), np.abs(np.arctan2(y, x) - PILLAR_TO)) * np.hypot(x, y)
    beyond = (np.hypot(x, y) > reach + 0.1) & (edge > 0.1)
    assert not beyond.any(), "free cells behind an obstacle"


@MANY
@given(STORY)
def test_half_a_second_after_the_last_word_nothing_is_free(story: list[tuple[str, int]]) -> None:
    items = [(now, item) for now, item in told(story) if not isinstance(item[1], DeviceEvent)]
    assume(items)
    outputs, _ = play(items)
    last = max(now for now, _ in items)
    late = [output for now, output in outputs if now > last + 525 * MS]  # a tick later than half a second
    assert late
    for output in late:
        if isinstance(output, PolarOut | RectOut):
            assert not np.isin(output.snapshot.state, (SectorState.FREE, SectorState.OBSTACLE)).any()


@MANY
@given(STORY)
def test_the_same_readings_give_the_same_bytes(story: list[tuple[str, int]]) -> None:
    def run() -> tuple[list[tuple[int, str, bytes]], list[tuple[int, int, bytes]]]:
        outputs, grid = play(told(story))
        encoder = Encoder()
        sent = [
            (now, message.suffix, message.payload)
            for now, output in outputs
            if not (isinstance(output, GridOut) and output.name != "grid")
            for message in encoder.encode(output, 0)
        ]
        return sent, list(grid.tiles())

    assert run() == run()


@MANY
@given(STORY)
def test_every_scan_is_either_used_or_counted(story: list[tuple[str, int]]) -> None:
    sensors = assemble.sensors(CONFIG)
    fusion = Fusion(assemble.parts(CONFIG, sensors, assemble.maps(CONFIG, sensors), OdometryOnly()))
    scans = used = 0
    for arrival, (source, reading) in told(story):
        outputs = fusion.on_item(source, reading, arrival)
        if isinstance(reading, ScanReading):
            scans += 1
            used += bool(outputs)
    reasons = {**fusion.drops.get("front", {})}
    reasons.pop("range_out_of_bounds", None)  # counts beams
    assert scans == used + sum(reasons.values())
