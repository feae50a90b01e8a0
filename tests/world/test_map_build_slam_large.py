"""SLAM round a block of long corridors whose doors repeat, with wheels that lie as badly as any recorded log's."""

from __future__ import annotations

import math
import os
from dataclasses import replace

import numpy as np
import pytest

from bench.slam_large import (
    ALIKE,
    HALLS,
    Case,
    Wheels,
    drive,
    false_closures,
    pair_errors,
    pairs,
    recorded,
    simulated,
)
from mapping.frames import Pose2
from mapping.localise.pose_graph import relative_poses
from mapping.scan import Scan

BLOCK = replace(HALLS, columns_m=(0.0, 62.0), rows_m=(0.0, 44.0), tour=((0, 0), (1, 0), (1, 1), (0, 1), (0, 0), (1, 0)))

THERE_AND_BACK = replace(
    HALLS, columns_m=(0.0, 36.0), rows_m=(0.0, 24.0), tour=((0, 0), (1, 0), (1, 1), (1, 0), (0, 0))
)

EMPTY = Scan(0, 0.0, np.zeros(0), np.zeros(0), 0.05, 30.0)


@pytest.mark.slow
def test_a_loop_of_two_hundred_metres_is_closed_and_nothing_else() -> None:
    case = simulated("block", BLOCK, 5)
    assert np.hypot(*(case.odometry[:, :2] - case.truth[:, :2]).T).max() > 5.0  # or the test would prove nothing
    slam = drive(case)
    off_m, off_deg = pair_errors(case, slam.trajectory()[1], pairs(case))
    assert off_m.max() < 0.15
    assert off_deg.max() < 1.5
    assert sum(closure.searched for closure in slam.closures) >= 3
    assert not false_closures(case, slam)


@pytest.mark.slow
def test_corridors_that_all_look_alike_are_not_taken_for_each_other() -> None:
    """Each is like the next but one, 15 m aside, which was seen before it: only the way there tells them apart."""
    case = simulated("alike", ALIKE, 4)
    slam = drive(case)
    assert not false_closures(case, slam)
    assert sum(closure.searched for closure in slam.closures) >= 10
    off_m, off_deg = pair_errors(case, slam.trajectory()[1], pairs(case))
    assert off_m.max() < 0.3
    assert off_deg.max() < 1.5


@pytest.mark.slow
def test_corridors_driven_back_lie_on_themselves() -> None:
    """Of doors a robot sees one side of the frame on its way there and the other on its way back."""
    case = simulated("there and back", THERE_AND_BACK, 3, wheels=Wheels(way_share=0.05))
    slam = drive(case)
    truth, poses = case.truth, slam.trajectory()[1]
    middle = int(np.argmax(truth[:, 1]))
    there = np.arange(0, middle)
    back = np.array([k for k in range(middle, len(truth)) if math.cos(truth[k, 2] - truth[0, 2]) < -0.9])
    nearest = there[np.argmin(np.hypot(*(truth[back, None, :2] - truth[None, there, :2]).transpose(2, 0, 1)), axis=1)]
    true, found = relative_poses(truth[nearest], truth[back]), relative_poses(poses[nearest], poses[back])
    off_m = np.hypot(*relative_poses(true, found)[:, :2].T)
    assert len(off_m) > 100
    assert off_m.mean() < 0.08
    assert off_m.max() < 0.2
    assert slam.events["slid"] > 10
    assert not false_closures(case, slam)


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
def test_halls_seen_every_metre_are_closed() -> None:
    """Its headings drift by 15 degrees and its few second visits are short: votes must not be asked for that true
    closures, as far off as the covariance says they may be, cannot give."""
    case = recorded("acapulco", 1, seed_of_wheels=1)
    slam = drive(case)
    assert not false_closures(case, slam)
    off_m, _ = pair_errors(case, slam.trajectory()[1], pairs(case))
    assert (off_m < 0.5).mean() > 0.9


def test_pairs_are_visits_of_one_place_and_their_errors_are_relations() -> None:
    x = np.concatenate((np.linspace(0.0, 40.0, 100), np.linspace(40.0, 0.0, 100), np.linspace(0.0, 40.0, 100)))
    yaw = np.repeat([0.0, math.pi, 0.0], 100)
    truth = np.stack((x, np.zeros(300), yaw), axis=-1)
    scans = tuple(replace(EMPTY, stamp_ns=k * 10**9) for k in range(300))
    case = Case("straight", scans, truth, truth, Pose2())
    chosen = pairs(case)
    assert np.all((chosen[:, 0] < 100) & (chosen[:, 1] >= 200))  # facing the other way is no second visit
    assert np.max(np.abs(truth[chosen[:, 0], 0] - truth[chosen[:, 1], 0])) <= 2.0
    moved = truth.copy()
    moved[200:, 1] += 0.3
    moved[200:, 2] += 0.1
    off_m, off_deg = pair_errors(case, moved, chosen)
    np.testing.assert_allclose(off_m, 0.3, atol=1e-9)
    np.testing.assert_allclose(off_deg, math.degrees(0.1), atol=1e-9)
