"""Which sensor a hand means: literal readings of covered and uncovered sensors."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.readings import ChainReading, RangeReading, RangeStatus, ScanReading, WheelReading
from service.identify import Meant, Watch

MS = 1_000_000
SECOND = 1000 * MS


def scan(stamp_ns: int, near: float) -> ScanReading:
    """near: share of the beams that see a hand."""
    distance = np.full(100, 2.0)
    distance[: round(100 * near)] = 0.05
    return ScanReading(stamp_ns, 0.0, 100 * MS, np.linspace(-2, 2, 100), distance, 0.02, 10.0)


def play(watch: Watch, shares: list[float], source: str = "front", period_ms: int = 100) -> Meant | None:
    for step, near in enumerate(shares):
        now_ns = step * period_ms * MS
        if (meant := watch.take(source, scan(now_ns, near), now_ns)) is not None:
            return meant
    return None


def test_a_covered_laser_is_meant_a_short_shadow_or_a_wall_that_was_there_is_not() -> None:
    assert play(Watch(0), [0.1] * 25 + [0.9] * 5) == Meant("front")
    assert play(Watch(0), [0.1] * 25 + [0.9, 0.9, 0.1] * 10) is None
    assert play(Watch(0), [0.5] * 25 + [0.6] * 20) is None
    assert play(Watch(0), [0.5] * 25 + [1.0] * 5) == Meant("front")
    assert play(Watch(0), [1.0] * 60) is None, "covered from the start: it cannot tell"
    assert play(Watch(0), [0.1] * 10 + [0.9] * 9) is None, "it is still learning"


@given(st.lists(st.floats(0, 1), min_size=21, max_size=60))
@settings(max_examples=60)
def test_what_was_seen_while_learning_is_never_meant(shares: list[float]) -> None:
    learnt = shares[:20]
    rest = [min(share, max(learnt)) for share in shares[20:]]
    assert play(Watch(0), learnt + rest) is None


def chain(stamp_ns: int, *status: RangeStatus) -> ChainReading:
    return ChainReading(stamp_ns, tuple(RangeReading(k, 1.0, each) for k, each in enumerate(status, start=1)))


def test_of_a_chain_the_transducer_is_named() -> None:
    watch, meant = Watch(0), None
    echo, close, absent = RangeStatus.ECHO, RangeStatus.TOO_CLOSE, RangeStatus.NOT_LOOKED
    for step in range(40):
        covered = close if step > 25 else echo
        meant = meant or watch.take("left", chain(step * 100 * MS, echo, absent, covered), step * 100 * MS)
    assert meant == Meant("left", "channel 3")
    assert meant.text() == "left, channel 3"
    assert watch.heard() == ["left"]


def test_the_wheel_that_turns_is_named_and_a_gap_is_no_turn() -> None:
    watch = Watch(0)
    ticks = [(0, 0)] * 25 + [(0, k) for k in range(0, 60, 4)]
    meant = None
    for step, (left, right) in enumerate(ticks):
        meant = meant or watch.take("drive", WheelReading(step * 100 * MS, left, right, True), step * 100 * MS)
    assert meant == Meant("drive", "right wheel")
    watch = Watch(0)
    watch.take("drive", WheelReading(0, 0, 0, False), 0)
    assert watch.take("drive", WheelReading(3 * SECOND, 9999, 9999, False), 3 * SECOND) is None
