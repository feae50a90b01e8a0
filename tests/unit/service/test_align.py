"""Waiting for odometry: covered, not yet, gone; bounded in time and number."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.align import Cover, WaitingRoom, cover


@pytest.mark.parametrize(
    ("first", "last", "oldest", "newest", "expected"),
    [
        (10, 20, 10, 20, Cover.COVERED),
        (10, 20, 0, 30, Cover.COVERED),
        (10, 21, 0, 20, Cover.NOT_YET),
        (9, 20, 10, 20, Cover.GONE),
        (9, 21, 10, 20, Cover.NOT_YET),
        (0, 0, None, None, Cover.NOT_YET),
        (0, 0, 0, 0, Cover.COVERED),
    ],
)
def test_cover(first: int, last: int, oldest: int | None, newest: int | None, expected: Cover) -> None:
    assert cover(first, last, oldest_ns=oldest, newest_ns=newest) is expected


def test_values_leave_in_order_of_stamps_when_covered() -> None:
    room: WaitingRoom[str] = WaitingRoom(limit_ns=1000)
    room.put("b", "late", 50, 60, now_ns=0)
    room.put("a", "early", 10, 20, now_ns=0)
    room.put("a", "same, later arrival", 50, 55, now_ns=0)
    assert room.release(oldest_ns=0, newest_ns=20, now_ns=1).ready == [("a", "early")]
    released = room.release(oldest_ns=0, newest_ns=60, now_ns=2)
    assert released.ready == [("a", "same, later arrival"), ("b", "late")]
    assert released.dropped == []
    assert len(room) == 0


def test_nobody_waits_for_ever() -> None:
    room: WaitingRoom[str] = WaitingRoom(limit_ns=500)
    room.put("a", "x", 10, 20, now_ns=100)
    assert room.longest_wait_ns(350) == 250
    assert room.release(oldest_ns=None, newest_ns=None, now_ns=600).dropped == []
    assert room.release(oldest_ns=None, newest_ns=None, now_ns=601).dropped == [("a", "odometry_late")]
    assert room.longest_wait_ns(700) == 0


def test_what_is_older_than_all_poses_is_dropped_at_once() -> None:
    room: WaitingRoom[str] = WaitingRoom(limit_ns=500)
    room.put("a", "x", 10, 20, now_ns=0)
    released = room.release(oldest_ns=15, newest_ns=30, now_ns=1)
    assert (released.ready, released.dropped) == ([], [("a", "odometry_gone")])


def test_what_was_measured_before_there_was_any_pose_is_told_apart() -> None:
    room: WaitingRoom[str] = WaitingRoom(limit_ns=500)
    room.put("a", "x", 10, 20, now_ns=0)
    room.put("b", "y", 14, 20, now_ns=0)
    released = room.release(oldest_ns=15, newest_ns=30, now_ns=1, begun_ns=12)
    assert released.dropped == [("a", "before_odometry"), ("b", "odometry_gone")]


def test_the_oldest_leaves_a_full_room() -> None:
    room: WaitingRoom[int] = WaitingRoom(limit_ns=500, capacity=2)
    assert room.put("a", 1, 10, 10, now_ns=0) == []
    assert room.put("b", 2, 20, 20, now_ns=0) == []
    assert room.put("c", 3, 15, 15, now_ns=0) == [("a", "waiting_full")]
    assert room.release(oldest_ns=0, newest_ns=99, now_ns=1).ready == [("c", 3), ("b", 2)]


@given(
    st.lists(st.tuples(st.integers(0, 100), st.integers(0, 20)), max_size=40),
    st.lists(st.tuples(st.integers(0, 120), st.integers(0, 120)), max_size=20),
)
def test_every_value_leaves_exactly_once(spans: list[tuple[int, int]], looks: list[tuple[int, int]]) -> None:
    room: WaitingRoom[int] = WaitingRoom(limit_ns=10, capacity=8)
    left: list[int] = []
    refused = 0
    for number, (first, length) in enumerate(spans):
        refused += len(room.put("a", number, first, first + length, now_ns=0))
    for oldest, newest in looks:
        released = room.release(oldest_ns=oldest, newest_ns=newest, now_ns=5)
        left += [value for _, value in released.ready]
        refused += len(released.dropped)
        assert all(oldest <= spans[v][0] and sum(spans[v]) <= newest for _, v in released.ready)
    refused += len(room.release(oldest_ns=None, newest_ns=None, now_ns=100).dropped)
    assert len(left) == len(set(left))
    assert len(left) + refused == len(spans)
    assert len(room) == 0
