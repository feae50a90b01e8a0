"""Poses between stamps: interpolated, not yet, gone; never extrapolated, never across a break."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping.frames import Pose2, interpolate
from mapping.pose_buffer import GoneError, NotYetError, PoseBuffer


def filled(count: int = 5, capacity: int = 100) -> PoseBuffer:
    buffer = PoseBuffer(capacity=capacity)
    for k in range(count):
        buffer.add(100 * k, Pose2(float(k), 2.0 * k, 0.3 * k))
    return buffer


def test_an_empty_buffer_knows_nothing_yet() -> None:
    buffer = PoseBuffer()
    assert (buffer.oldest_ns, buffer.newest_ns) == (None, None)
    with pytest.raises(NotYetError):
        buffer.at(0)


@given(st.integers(0, 400))
def test_between_two_poses_it_is_on_their_arc(stamp: int) -> None:
    k = min(stamp // 100, 3)
    a, b = (Pose2(float(i), 2.0 * i, 0.3 * i) for i in (k, k + 1))
    expected, found = interpolate(a, b, (stamp - 100 * k) / 100.0), filled().at(stamp)
    assert (found.x_m, found.y_m) == pytest.approx((expected.x_m, expected.y_m), abs=1e-12)
    assert found.yaw_rad == pytest.approx(expected.yaw_rad, abs=1e-12)


@pytest.mark.parametrize(("stamp", "error"), [(401, NotYetError), (-1, GoneError)])
def test_nothing_is_extrapolated(stamp: int, error: type[LookupError]) -> None:
    with pytest.raises(error):
        filled().at(stamp)


@pytest.mark.parametrize("stamp", [400, 399, 0, -7])
def test_stamps_must_rise(stamp: int) -> None:
    buffer = filled()
    with pytest.raises(ValueError, match="rise"):
        buffer.add(stamp, Pose2())
    assert buffer.newest_ns == 400


def test_old_poses_are_forgotten_and_the_memory_stays() -> None:
    buffer = filled(count=10_000, capacity=7)
    assert len(buffer) == 7
    assert (buffer.oldest_ns, buffer.newest_ns) == (999_300, 999_900)
    assert buffer.at(999_350).x_m == pytest.approx(9993.5, abs=0.2)
    with pytest.raises(GoneError):
        buffer.at(999_299)


def test_a_break_is_not_bridged() -> None:
    buffer = filled(3)
    buffer.add(300, Pose2(50.0, 0.0, 0.0), after_break=True)
    buffer.add(400, Pose2(51.0, 0.0, 0.0))
    assert buffer.oldest_ns == 300
    with pytest.raises(GoneError):
        buffer.at(250)
    assert buffer.at(200).x_m == pytest.approx(2.0)
    assert buffer.at(300).x_m == pytest.approx(50.0)
    assert buffer.at(350).x_m == pytest.approx(50.5)


def test_a_single_pose_answers_for_its_own_stamp_only() -> None:
    buffer = PoseBuffer()
    buffer.add(5, Pose2(1.0))
    assert buffer.at(5).x_m == 1.0
    with pytest.raises(NotYetError):
        buffer.at(6)


def test_the_short_way_round_is_taken() -> None:
    buffer = PoseBuffer()
    buffer.add(0, Pose2(0.0, 0.0, math.radians(179.0)))
    buffer.add(2, Pose2(0.0, 0.0, math.radians(-179.0)))
    assert abs(buffer.at(1).yaw_rad) == pytest.approx(math.pi)


def test_a_buffer_too_small_to_interpolate_is_refused() -> None:
    with pytest.raises(ValueError, match="two"):
        PoseBuffer(capacity=1)
