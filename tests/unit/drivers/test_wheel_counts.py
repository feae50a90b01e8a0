"""Wheel counts: wraps both ways, damage told from resets, gaps; and two wheels that speak at different times."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.readings import SourceCounters, WheelReading
from drivers.wheel_counts import FULL_RANGE, Meeting, WheelCounts

MS = 1_000_000


def wheels(max_ticks_per_s: float = 10_000.0) -> tuple[WheelCounts, SourceCounters]:
    counters = SourceCounters()
    return WheelCounts(counters, max_ticks_per_s=max_ticks_per_s), counters


def feed(counts: WheelCounts, samples: list[tuple[int, int]], *, step_ms: int = 20) -> list[WheelReading]:
    found = (counts.advance(*raw, index * step_ms * MS) for index, raw in enumerate(samples))
    return [reading for reading in found if reading is not None]


@given(
    st.integers(-(2**31), 2**31 - 1),
    st.integers(-(2**31), 2**31 - 1),
    st.lists(st.tuples(st.integers(-200, 200), st.integers(-200, 200)), max_size=30),
)
def test_any_motion_across_any_wrap_is_added_up_exactly(left: int, right: int, steps: list[tuple[int, int]]) -> None:
    counts, counters = wheels()
    total, raws = [(0, 0)], [(left % FULL_RANGE, right % FULL_RANGE)]
    for a, b in steps:
        total.append((total[-1][0] + a, total[-1][1] + b))
        raws.append(((raws[-1][0] + a) % FULL_RANGE, (raws[-1][1] + b) % FULL_RANGE))
    if (0, 0) in raws[1:]:
        return  # landing on zero with both wheels has a test of its own
    readings = feed(counts, raws)
    assert [(r.left_ticks, r.right_ticks) for r in readings] == total
    assert [r.continuous for r in readings] == [False] + [True] * len(steps)
    assert counters.drops == {}


def test_one_damaged_sample_is_dropped_and_no_motion_lost() -> None:
    counts, counters = wheels()
    readings = feed(counts, [(100, 100), (110, 110), (9_110, 110), (130, 130)])
    assert [(r.left_ticks, r.continuous) for r in readings] == [(0, False), (10, True), (30, True)]
    assert counters.drops == {"count_implausible": 1}


@pytest.mark.parametrize("after", [[(0, 0), (3, 2)], [(0, 0), (0, 0)], [(5, 4), (8, 9)]])
def test_a_reset_is_no_motion(after: list[tuple[int, int]]) -> None:
    counts, counters = wheels()
    readings = feed(counts, [(50_000, 60_000), (50_010, 60_010), *after, (10, 12)])
    assert [r.continuous for r in readings] == [False, True, False, True]
    assert counters.drops == {"count_reset": 1}
    assert readings[-1].left_ticks <= 10 + 10, "nothing of the jump is counted"


def test_a_reset_soon_after_the_start_is_no_motion() -> None:
    counts, counters = wheels()
    readings = feed(counts, [(80, 90), (100, 120), (0, 0), (1, 1), (5, 5)])
    assert [(r.left_ticks, r.continuous) for r in readings] == [(0, False), (20, True), (21, False), (25, True)]
    assert counters.drops == {"count_reset": 1}


def test_rolling_slowly_through_zero_is_motion() -> None:
    counts, counters = wheels()
    readings = feed(counts, [(4, 4), (2, 2), (0, 0), (-2 % FULL_RANGE, -2 % FULL_RANGE)])
    assert [r.left_ticks for r in readings] == [0, -2, -4, -6]
    assert counters.drops == {}


def test_after_a_gap_counts_near_zero_follow_from_nothing_but_large_ones_go_on() -> None:
    for before, after, known in ((1000, 400, False), (1000, 1000, True), (5_000_000, 5_000_400, True)):
        counts, _ = wheels()
        counts.advance(before, before, 0)
        reading = counts.advance(after, after, 500 * MS)
        assert reading is not None
        assert reading.continuous is known


def test_only_one_wheel_booted() -> None:
    counts, _ = wheels()
    counts.advance(2000, 5_000_000, 0)
    reading = counts.advance(10, 5_000_100, 500 * MS)
    assert reading is not None
    assert not reading.continuous


def test_a_gap_in_which_the_count_could_wrap_is_unknown() -> None:
    counts, counters = wheels(max_ticks_per_s=1e6)
    counts.advance(1_000_000_000, 5, 0)
    reading = counts.advance(1_000_000_010, 15, 3_000_000 * MS)
    assert reading is not None
    assert not reading.continuous
    assert counters.drops == {"count_gap": 1}


def test_stamps_rise_even_if_the_clock_does_not() -> None:
    counts, _ = wheels()
    stamps = [counts.advance(index, index, 7 * MS) for index in range(1, 5)]
    values = [reading.stamp_ns for reading in stamps if reading is not None]
    assert values == sorted(set(values))
    assert len(values) == 4


@given(st.integers(0, FULL_RANGE - 1), st.integers(1, 99), st.integers(-1000, 1000))
def test_wheels_that_speak_in_turn_meet_on_the_line_between(start: int, phase: int, speed: int) -> None:
    """Both roll at the same constant speed: at the common times both counts agree with it to half a tick."""
    meeting = Meeting(longest_gap_ns=150 * MS)
    met = []
    for index in range(6):
        for side, at_ms in ((0, 100 * index), (1, 100 * index + phase)):
            count = (start + speed * at_ms) % FULL_RANGE
            if (pair := meeting.add(side, count, at_ms * MS)) is not None:
                met.append(pair)
    assert len(met) >= 5
    for left, right, stamp_ns in met:
        for count in (left, right):
            error = (count - start - speed * stamp_ns // MS) % FULL_RANGE
            assert min(error, FULL_RANGE - error) <= 1


def test_nothing_is_interpolated_across_a_long_gap() -> None:
    meeting = Meeting(longest_gap_ns=150 * MS)
    assert meeting.add(0, 10, 0) is None
    assert meeting.add(1, 10, 10 * MS) is None, "the left wheel is not known at 10 ms yet"
    assert meeting.add(0, 30, 500 * MS) is None
    assert meeting.add(1, 30, 510 * MS) is None, "nor the right one at 500 ms"
    assert meeting.add(0, 31, 520 * MS) is not None
