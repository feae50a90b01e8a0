"""The line map in the daemon: what counts, what is told when, what is kept, and what a moving laser sees."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.lines.line_map import LineMap
from mapping.scan import Scan
from service.line_maker import LineMaker
from service.map_makers import MapView
from service.outputs import DocumentOut
from service.payloads import Encoder

F64 = NDArray[np.float64]
BEARING = np.radians(np.arange(-135.0, 135.01, 0.5))
SECOND = 1_000_000_000
WALL_X_M = 5.0


def sweep(poses: F64, bearing: F64 = BEARING) -> Scan:
    """What a laser sees of walls at x = 5 and y = 3 from a pose per beam, (N, 3)."""
    angle = bearing + poses[:, 2]
    with np.errstate(divide="ignore"):
        ahead = np.where(np.cos(angle) > 1e-9, (WALL_X_M - poses[:, 0]) / np.cos(angle), np.inf)
        aside = np.where(np.sin(angle) > 1e-9, (3.0 - poses[:, 1]) / np.sin(angle), np.inf)
    ranges = np.minimum(ahead, aside)
    return Scan(0, 0.0, bearing, np.where(ranges > 20.0, np.inf, ranges), 0.1, 20.0)


def still(x: float, y: float = 0.0, yaw: float = 0.0) -> F64:
    return np.tile([x, y, yaw], (BEARING.size, 1))


def maker() -> LineMaker:
    return LineMaker(LineMap(), ["front"])


def told(maps: LineMaker, stamp_ns: int = 0) -> list[dict[str, Any]]:
    """The documents that are due."""
    outputs = maps.make(MapView(stamp_ns, None, (), None))
    messages = [Encoder().encode(out, 100 * SECOND)[0] for out in outputs if isinstance(out, DocumentOut)]
    assert len(messages) == len(outputs)
    assert all(message.suffix == "map/lines" for message in messages)
    return [json.loads(message.payload) for message in messages]


def test_walls_are_told_once_two_scans_saw_them() -> None:
    maps = maker()
    assert told(maps) == []
    maps.take_sweep("front", sweep(still(0.0)), np.array([0.0, 0.0, 0.0]))
    (first,) = told(maps)
    assert first["lines"] == []  # seen once
    maps.take_sweep("front", sweep(still(0.5)), still(0.5))
    (second,) = told(maps)
    assert second["version"] > first["version"]
    assert sorted(line["distance_m"] for line in second["lines"]) == pytest.approx([3.0, 5.0], abs=1e-3)
    assert told(maps) == []  # nothing new


def test_a_robot_that_stands_adds_nothing() -> None:
    maps = maker()
    for _ in range(50):
        maps.take_sweep("front", sweep(still(1.0)), still(1.0))
    assert maps.line_map.scans == 1
    maps.take_sweep("front", sweep(still(1.0, yaw=0.2)), still(1.0, yaw=0.2))
    assert maps.line_map.scans == 2


@pytest.mark.parametrize("falling", [False, True])
def test_a_moving_laser_sees_straight_walls(falling: bool) -> None:
    """2 m/s and 1 rad/s in a sweep of 0.1 s: drawn from one pose the walls would be 20 cm off."""
    maps = maker()
    bearing = BEARING[::-1].copy() if falling else BEARING
    for start in (0.0, 0.4):
        t = np.linspace(0.0, 0.1, bearing.size)
        poses = np.stack((start + 2.0 * t, 0.0 * t, 1.0 * t), axis=-1)
        maps.take_sweep("front", sweep(poses, bearing), poses)
    lines = maps.line_map.lines(min_seen=2)
    np.testing.assert_allclose(sorted(lines.parameters()[1]), [3.0, WALL_X_M], atol=0.002)
    way = lines.end_m - lines.start_m
    to_robot = np.array([0.5, 0.0]) - lines.start_m
    assert np.all(way[:, 0] * to_robot[:, 1] - way[:, 1] * to_robot[:, 0] < 0.0)  # free to the right


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("trembling", [False, True])
def test_a_head_that_turns_clockwise_all_round_sees_each_wall_from_its_free_side(moving: bool, trembling: bool) -> None:
    """As the scanners with a turning head tell it: from straight ahead to the right and round, 0 to nearly -360."""
    bearing = -np.radians(np.arange(0.0, 359.3, 0.8))
    if trembling:
        bearing[99::100] += 0.02  # behind the one before
    maps = maker()
    for start in (0.0, 0.3):
        t = np.linspace(0.0, 0.1, bearing.size)
        poses = np.stack((start + (2.0 * t if moving else 0.0 * t), 0.0 * t, 0.0 * t), axis=-1)
        angle = bearing + poses[:, 2]
        with np.errstate(divide="ignore"):
            along = np.where(np.cos(angle) > 0.0, WALL_X_M - poses[:, 0], -2.0 - poses[:, 0]) / np.cos(angle)
            across = np.where(np.sin(angle) > 0.0, 3.0, -1.5) / np.sin(angle)
        maps.take_sweep("front", Scan(0, 0.0, bearing, np.minimum(along, across), 0.1, 20.0), poses)
    lines = maps.line_map.lines(min_seen=2)
    np.testing.assert_allclose(sorted({round(float(d), 2) for d in lines.parameters()[1]}), [1.5, 2.0, 3.0, 5.0])
    way, to_robot = lines.end_m - lines.start_m, np.array([0.5, 0.0]) - lines.start_m
    assert np.all(way[:, 0] * to_robot[:, 1] - way[:, 1] * to_robot[:, 0] < 0.0)  # free to the right


def test_sweeps_without_a_pose_or_an_echo_are_left_out() -> None:
    maps = maker()
    lost = still(1.0)
    lost[7] = np.nan
    maps.take_sweep("front", sweep(still(1.0)), lost)
    nothing = Scan(0, 0.0, BEARING, np.full(BEARING.size, np.inf), 0.1, 20.0)
    maps.take_sweep("front", nothing, still(1.0))
    maps.take_sweep("front", nothing, still(1.0) + np.linspace(0.0, 1.0, BEARING.size)[:, None])
    assert (len(maps.line_map), told(maps)) == (0, [])


def test_starting_anew_tells_the_new_map() -> None:
    maps = maker()
    for x in (0.0, 0.5):
        maps.take_sweep("front", sweep(still(x)), still(x))
    (before,) = told(maps)
    maps.start_anew()
    (after,) = told(maps)
    assert after["lines"] == []
    assert after["version"] > before["version"]


def test_what_is_kept_is_taken_up_again() -> None:
    maps = maker()
    for x in (0.0, 0.5):
        maps.take_sweep("front", sweep(still(x)), still(x))
    (before,) = told(maps)
    tiles = maps.changed_tiles()
    assert maps.changed_tiles() == []  # nothing new
    again = maker()
    again.restore(tiles)
    (after,) = told(again)
    np.testing.assert_allclose(
        [line["start"] for line in after["lines"]], [line["start"] for line in before["lines"]], atol=2e-4
    )
    again.restore(())
    assert len(again.line_map) == 0
    with pytest.raises(ValueError, match="line map"):
        again.restore([(0, 0, b"LNS1 but not whole")])


def test_document() -> None:
    maps = maker()
    for x in (0.0, 0.5):
        maps.take_sweep("front", sweep(still(x)), still(x))
    (document,) = told(maps, 1_500_000_000)
    assert document["schema"] == "umfeld.lines.v1"
    assert document["stamp"] == {"sec": 101, "nanosec": 500_000_000}
    assert document["frame"] == "map"
    assert len(json.dumps(document)) < 200 + 300 * len(document["lines"])
    for entry in document["lines"]:
        n = np.array([math.cos(entry["angle_rad"]), math.sin(entry["angle_rad"])])
        for end in (entry["start"], entry["end"]):
            assert float(n @ end) == pytest.approx(entry["distance_m"], abs=3e-4)
        aa, ad, dd = entry["covariance"]
        assert aa > 0.0
        assert aa * dd > ad * ad
        assert entry["scans"] == 2


def test_a_wall_that_was_taken_away_is_told_no_more() -> None:
    """By a robot that stands only what it looks at straight, as that might be glass; what was cut is counted."""
    maps = maker()
    for step in range(5):
        maps.take_sweep("front", sweep(still(0.2 * step)), still(0.2 * step))
    (before,) = told(maps)
    assert maps.counts == {"lines.cut": 0}
    farther = sweep(still(-2.0))  # the wall ahead now stands 2 m farther away
    for k in range(10):
        scan = Scan(k * SECOND // 10, 0.0, BEARING, farther.range_m, 0.1, 20.0)
        maps.take_sweep("front", scan, np.array([0.0, 0.0, 0.0]))
    (after,) = told(maps)
    assert maps.counts["lines.cut"] > 0

    def ahead(document: dict[str, Any]) -> float:
        lines = [line for line in document["lines"] if abs(line["start"][0] - WALL_X_M) < 0.1]
        return sum(abs(float(line["end"][1]) - float(line["start"][1])) for line in lines)

    assert ahead(after) == pytest.approx(ahead(before) - 0.5, abs=0.11)


@pytest.mark.parametrize("bearing", [BEARING[::-1], np.roll(BEARING, 100)], ids=["clockwise", "turning head"])
def test_one_pose_for_a_whole_sweep_is_as_good_as_one_a_beam(bearing: F64) -> None:
    each, one = maker(), maker()
    for x in (0.0, 0.5, 1.0):
        poses = still(x)
        each.take_sweep("front", sweep(poses, bearing), poses)
        one.take_sweep("front", sweep(poses, bearing), poses[0])
    assert len(each.told_lines()) >= 2
    assert told(one) == told(each)
