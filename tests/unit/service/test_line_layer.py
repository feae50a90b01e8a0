"""The line map in the daemon: who counts, what is told when, and what a moving laser sees."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.lines.line_map import LineMap
from mapping.scan import Scan
from service.line_layer import LineLayer, lines_json

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


def layer() -> LineLayer:
    return LineLayer(LineMap(), ["front"])


def test_walls_are_told_once_two_scans_saw_them() -> None:
    maps = layer()
    assert maps.outputs(None, 0, 0) == []
    maps.take_sweep("front", sweep(still(0.0)), np.array([0.0, 0.0, 0.0]))
    first = maps.outputs(None, 5, 5)
    assert [len(out.lines) for out in first] == [0]  # seen once
    maps.take_sweep("front", sweep(still(0.5)), still(0.5))
    assert maps.outputs(None, 6, SECOND // 2) == []  # too soon
    (out,) = maps.outputs(None, 7, 2 * SECOND)
    assert out.version > first[0].version
    assert sorted(np.round(out.lines.parameters()[1], 3)) == [3.0, 5.0]
    assert maps.outputs(None, 8, 9 * SECOND) == []  # nothing new


def test_a_robot_that_stands_adds_nothing() -> None:
    maps = layer()
    for _ in range(50):
        maps.take_sweep("front", sweep(still(1.0)), still(1.0))
    assert maps.line_map.scans == 1
    maps.take_sweep("front", sweep(still(1.0, yaw=0.2)), still(1.0, yaw=0.2))
    assert maps.line_map.scans == 2


@pytest.mark.parametrize("falling", [False, True])
def test_a_moving_laser_sees_straight_walls(falling: bool) -> None:
    """2 m/s and 1 rad/s in a sweep of 0.1 s: drawn from one pose the walls would be 20 cm off."""
    maps = layer()
    bearing = BEARING[::-1].copy() if falling else BEARING
    for start in (0.0, 0.4):
        t = np.linspace(0.0, 0.1, bearing.size)
        poses = np.stack((start + 2.0 * t, 0.0 * t, 1.0 * t), axis=-1)
        maps.take_sweep("front", sweep(poses, bearing), poses)
    (out,) = maps.outputs(None, 0, 0)
    np.testing.assert_allclose(sorted(out.lines.parameters()[1]), [3.0, WALL_X_M], atol=0.002)
    way = out.lines.end_m - out.lines.start_m
    to_robot = np.array([0.5, 0.0]) - out.lines.start_m
    assert np.all(way[:, 0] * to_robot[:, 1] - way[:, 1] * to_robot[:, 0] < 0.0)  # free to the right


def test_sweeps_without_a_pose_or_an_echo_are_left_out() -> None:
    maps = layer()
    lost = still(1.0)
    lost[7] = np.nan
    maps.take_sweep("front", sweep(still(1.0)), lost)
    nothing = Scan(0, 0.0, BEARING, np.full(BEARING.size, np.inf), 0.1, 20.0)
    maps.take_sweep("front", nothing, still(1.0))
    maps.take_sweep("front", nothing, still(1.0) + np.linspace(0.0, 1.0, BEARING.size)[:, None])
    maps.take_round("sonar", None, Pose2())
    assert (len(maps.line_map), maps.outputs(None, 0, 0)) == (0, [])


def test_starting_anew_tells_the_new_map() -> None:
    maps = layer()
    for x in (0.0, 0.5):
        maps.take_sweep("front", sweep(still(x)), still(x))
    (before,) = maps.outputs(None, 0, 0)
    maps.start_anew()
    (after,) = maps.outputs(None, 0, 5 * SECOND)
    assert len(after.lines) == 0
    assert after.version > before.version


def test_document() -> None:
    maps = layer()
    for x in (0.0, 0.5):
        maps.take_sweep("front", sweep(still(x)), still(x))
    (out,) = maps.outputs(None, 1_500_000_000, 0)
    data = lines_json(out, 100 * SECOND)
    document = json.loads(data)
    assert document["schema"] == "umfeld.lines.v1"
    assert document["stamp"] == {"sec": 101, "nanosec": 500_000_000}
    assert document["frame"] == "map"
    assert len(data) < 200 + 300 * len(document["lines"])
    for entry in document["lines"]:
        n = np.array([math.cos(entry["angle_rad"]), math.sin(entry["angle_rad"])])
        for end in (entry["start"], entry["end"]):
            assert float(n @ end) == pytest.approx(entry["distance_m"], abs=3e-4)
        aa, ad, dd = entry["covariance"]
        assert aa > 0.0
        assert aa * dd > ad * ad
        assert entry["scans"] == 2
