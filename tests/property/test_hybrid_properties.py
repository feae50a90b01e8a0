"""What holds for any hierarchical map: kept and taken up it is the same, damage is refused, no scan hurts."""

from __future__ import annotations

import copy
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.hybrid.hierarchical import HierarchicalMap
from mapping.hybrid.places import HybridRules, Opening, corners_in, crossing, find_in, hallway_along, openings_in
from mapping.lines.line_map import rows_of_ends
from mapping.lines.lines import Lines, no_lines

RULES = HybridRules()
NOISE = 1e-6 * np.eye(3)
STILL = (0.0, 0.0)


def lines_of(*ends: tuple[float, float, float, float]) -> Lines:
    table: NDArray[np.float64] = np.array(ends, dtype=np.float64).reshape(-1, 4)
    count = len(table)
    rows = rows_of_ends(table[:, :2], table[:, 2:], np.full(count, 40.0), np.ones(count), np.full(count, 0.01))
    return Lines(rows, np.full((count, 2), -1, dtype=np.int64))


def room(door_m: float = 1.0) -> Lines:
    """4 x 3 m around the origin with a door in the middle of the wall ahead, behind which a wall is seen; as walked
    counter-clockwise around, each line from its left to its right end seen from inside: free space to the right."""
    half = 0.5 * door_m
    return lines_of(
        (2.0, -half, 2.0, -1.5),
        (5.0, 0.3, 5.0, -0.3),
        (2.0, 1.5, 2.0, half),
        (-2.0, 1.5, 2.0, 1.5),
        (-2.0, -1.5, -2.0, 1.5),
        (2.0, -1.5, -2.0, -1.5),
    )


@given(st.floats(-math.pi, math.pi), st.floats(-1.0, 1.0), st.floats(0.65, 1.45))
@settings(max_examples=50, deadline=None)
def test_a_door_is_found_whichever_way_one_stands(yaw: float, y: float, door_m: float) -> None:
    here = Pose2(-0.5, 0.3 * y, yaw)
    seen = room(door_m).transformed(here.inverse())
    (door,) = openings_in(seen, STILL, RULES)
    assert door.width_m == pytest.approx(door_m, abs=1e-6)
    outward = here @ door.outward()
    assert (outward.x_m, outward.y_m, outward.yaw_rad) == pytest.approx((2.0, 0.0, 0.0), abs=1e-6)
    corners = corners_in(seen, RULES)
    assert len(corners) == 4
    assert not any(corner.convex for corner in corners)
    assert hallway_along(seen, STILL, RULES) is None


def test_what_is_hidden_is_no_door() -> None:
    """Nothing is seen through a gap that a cupboard's shadow leaves."""
    rows = room().rows
    assert openings_in(Lines(rows[[0, 2, 3, 4, 5]], np.full((5, 2), -1)), STILL, RULES) == []


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-math.pi, math.pi))
@settings(max_examples=25, deadline=None)
def test_the_pose_is_found_wherever_the_frame_lies(x: float, y: float, yaw: float) -> None:
    moved = Pose2(x, y, yaw)
    share, pose = find_in(room().transformed(moved.inverse()), room(), RULES)[0]
    assert share == pytest.approx(1.0)
    assert (pose.x_m, pose.y_m) == pytest.approx((x, y), abs=1e-6)


def test_an_opening_is_crossed_outward_only() -> None:
    door = Opening((2.0, 0.5), (2.0, -0.5))
    inside, outside = Pose2(1.9, 0.1, 0.0), Pose2(2.1, 0.1, 0.0)
    assert crossing(inside, outside, door)
    assert not crossing(outside, inside, door)
    assert not crossing(Pose2(1.9, 0.8, 0.0), Pose2(2.1, 0.8, 0.0), door)


steps = st.lists(st.tuples(st.floats(-0.3, 0.5), st.floats(-0.1, 0.1), st.floats(-1.0, 1.0)), min_size=1, max_size=25)
walls = st.lists(st.tuples(*[st.floats(-6.0, 6.0)] * 4), max_size=6)


@given(steps, st.lists(walls, min_size=1, max_size=4))
@settings(max_examples=40, deadline=None)
def test_no_scan_hurts_and_the_map_keeps(way: list[tuple[float, float, float]], scans: list[list[tuple[float, ...]]]) -> None:  # fmt: skip # noqa: E501
    hybrid = HierarchicalMap()
    hybrid.take(room(), Pose2(), NOISE)
    for k, step in enumerate(way):
        ends = [(a, b, c, d) for a, b, c, d in scans[k % len(scans)] if math.hypot(c - a, d - b) > 0.1]
        seen = lines_of(*ends) if ends else no_lines()
        where = hybrid.take(seen, Pose2(*step), NOISE)
        assert where.pose is not None
        assert all(map(math.isfinite, (where.pose.x_m, where.pose.y_m, where.pose.yaw_rad)))
    kept = hybrid.state()
    assert HierarchicalMap.from_state(json.loads(json.dumps(kept))).state() == kept


def test_damage_is_refused() -> None:
    hybrid = HierarchicalMap()
    for _ in range(5):
        hybrid.take(room(), Pose2(), NOISE)
    for _ in range(12):
        hybrid.take(room(), Pose2(0.25, 0.0, 0.0), NOISE)
    kept = hybrid.state()
    one_way = copy.deepcopy(kept)
    one_way["areas"][0]["openings"][0].update(leads_to=[0, 5], there_from_here=[0.0, 0.0, 0.0])
    cut = copy.deepcopy(kept)
    cut["areas"][0]["walls"] = cut["areas"][0]["walls"][:-8]
    for broken in ({}, {**kept, "version": 2}, {**kept, "areas": 3}, {**kept, "areas": [{}]}, one_way, cut):
        with pytest.raises(ValueError, match="hierarchical"):
            HierarchicalMap.from_state(broken)


def test_numbers_that_are_none_change_nothing() -> None:
    hybrid = HierarchicalMap()
    hybrid.take(room(), Pose2(), NOISE)
    before = hybrid.state()
    for step, noise in ((Pose2(math.nan, 0.0, 0.0), NOISE), (Pose2(), np.full((3, 3), np.inf)), (Pose2(), np.eye(2))):
        with pytest.raises(ValueError, match="finite"):
            hybrid.take(room(), step, noise)
    assert hybrid.state() == before


def test_a_robot_in_a_room_that_it_does_not_know_is_lost() -> None:
    crooked = lines_of((-1.0, 4.0, 6.0, 4.0), (-3.0, -1.0, -1.0, 4.0), (6.0, -1.0, -3.0, -1.0))
    hybrid = HierarchicalMap()
    for _ in range(4):
        hybrid.take(crooked, Pose2(), NOISE)
    loaded = HierarchicalMap.from_state(hybrid.state())
    assert loaded.take(room(), Pose2(), NOISE).area is None
    assert loaded.take(crooked, Pose2(), NOISE).area == 0


def test_a_room_that_looks_alike_from_two_sides_is_not_recognised() -> None:
    hybrid = HierarchicalMap()
    for _ in range(4):
        hybrid.take(room(), Pose2(), NOISE)
    assert hybrid.recognise(room()) is None
