"""A device clock against the host's: known truth in, the truth out; and stamps that cannot be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.clock_fit import DeviceClock, EnvelopeLine

MS = 1_000_000
S = 1000 * MS
WRAP = (1 << 24) * MS


def clock() -> DeviceClock:
    return DeviceClock(wrap_ns=WRAP, tick_ns=MS)


def ticks(device_ns: float) -> int:
    """What a 24-bit millisecond counter shows."""
    return int(device_ns // MS) * MS % WRAP


@settings(max_examples=30, deadline=None)
@given(
    drift_ppm=st.floats(-200, 200),
    offset_ns=st.integers(-(10**15), 10**15),
    seed=st.integers(0, 1000),
    late_share=st.floats(0.0, 0.3),
)
def test_line_lies_under_the_delays(drift_ppm: float, offset_ns: int, seed: int, late_share: float) -> None:
    rng = np.random.default_rng(seed)
    line = EnvelopeLine()
    device = np.arange(2400) * 25 * MS
    delay = rng.exponential(1.5 * MS, device.size)
    delay[rng.random(device.size) < late_share] += 80 * MS
    host = offset_ns + device + (device * drift_ppm * 1e-6).astype(np.int64)
    for d, h, late in zip(device.tolist(), host.tolist(), delay.tolist(), strict=True):
        line.add(d, h + int(late))
    assert line.drift_ppm == pytest.approx(drift_ppm, abs=5)
    for at in (600, 1200, 2399):
        assert -0.05 * MS < line.host_ns(int(device[at])) - int(host[at]) < 0.3 * MS


def test_drift_beyond_any_quartz_is_limited() -> None:
    line = EnvelopeLine()
    for at in range(1000):
        line.add(at * 100 * MS, at * 102 * MS)
    assert line.drift_ppm == 500.0


def test_jitter_is_the_scatter_of_the_delays() -> None:
    rng = np.random.default_rng(1)
    line = EnvelopeLine()
    for at in range(1000):
        line.add(at * 25 * MS, at * 25 * MS + int(rng.uniform(0, 4) * MS))
    assert line.jitter_ns == pytest.approx(4 * MS / np.sqrt(12), rel=0.15)


def test_questions_enclose_the_offset() -> None:
    """Answers read anywhere within 5 ms give the offset to what the fit says of itself, and that is below 2 ms."""
    rng = np.random.default_rng(3)
    c = clock()
    offset = 77_123_456_789
    for at in range(12):
        sent = 5_000 * S + at * 7_300_000
        read_at = sent + int(rng.uniform(0.3, 4.7) * MS)
        assert c.ask(ticks(read_at - offset), sent_ns=sent, received_ns=sent + 5 * MS)
    assert c.anchored
    fit = c.fit
    assert fit is not None
    raw = ticks(read_at - offset)
    turns = round((read_at - fit.offset_ns - raw) / WRAP)
    assert abs(fit.offset_ns + raw + turns * WRAP - read_at) < fit.jitter_ns + MS / 2
    assert fit.jitter_ns < 2 * MS


def test_contradicting_questions_start_anew() -> None:
    c = clock()
    assert c.ask(1000 * MS, sent_ns=5 * S, received_ns=5 * S + MS)
    assert not c.ask(3000 * MS, sent_ns=5 * S + 10 * MS, received_ns=5 * S + 11 * MS)
    assert c.ask(3010 * MS, sent_ns=5 * S + 20 * MS, received_ns=5 * S + 21 * MS)


def test_constant_delay_of_the_data_is_taken_off_when_questions_were_answered() -> None:
    rng = np.random.default_rng(6)
    c = clock()
    for at in range(12):
        now = at * 3_700_000
        c.ask(ticks(now + 400 * S), sent_ns=now - 200_000, received_ns=now + 200_000)
    errors = []
    for at in range(1, 2000):
        true = at * 100 * MS + int(rng.uniform(-1, 1) * MS)
        placed = c.place(ticks(true + 400 * S), true + 17 * MS + int(rng.exponential(2 * MS)), period_ns=100 * MS)
        assert placed is not None
        errors.append((placed[1] - true) / MS)
    assert np.abs(errors).max() < 1.1  # half a tick of the device and what questions left open
    assert abs(np.mean(errors)) < 0.3


def test_without_questions_the_least_delay_remains() -> None:
    rng = np.random.default_rng(6)
    c = clock()
    errors = []
    for at in range(1, 2000):
        true = at * 25 * MS + int(rng.uniform(-1, 1) * MS)
        placed = c.place(ticks(true), true + 3 * MS + int(rng.exponential(2 * MS)), period_ns=25 * MS)
        assert placed is not None
        errors.append((placed[1] - true) / MS)
    assert not c.anchored
    assert np.mean(errors[200:]) == pytest.approx(3.0, abs=0.4)
    assert np.abs(np.array(errors[200:]) - 3.0).max() < 1.1


@pytest.mark.parametrize("silence_s", [1, 16.777, 16.8, 100, 3600])
def test_wraps_during_silence(silence_s: float) -> None:
    c = clock()
    now = 0
    for _ in range(200):
        now += 25 * MS
        placed = c.place(ticks(now), now + MS, period_ns=25 * MS)
    assert placed is not None
    now += round(silence_s * S)
    after = c.place(ticks(now), now + MS, period_ns=25 * MS)
    assert after is not None
    assert abs(after[0] - now) < MS
    assert abs(after[1] - now) < 2.5 * MS


def steady(c: DeviceClock, count: int = 100, period_ns: int = 25 * MS) -> int:
    for at in range(1, count + 1):
        assert c.place(ticks(at * period_ns), at * period_ns + MS, period_ns=period_ns) is not None
    return count * period_ns


@pytest.mark.parametrize("error_ms", [7, 64, 4096, -30, -64, -4096, 262_144])
def test_an_impossible_stamp_is_refused_and_forgotten(error_ms: int) -> None:
    c = clock()
    now = steady(c) + 25 * MS
    assert c.place(ticks(now + error_ms * MS), now + MS, period_ns=25 * MS) is None
    for _ in range(20):
        now += 25 * MS
        placed = c.place(ticks(now), now + MS, period_ns=25 * MS)
        assert placed is not None
        assert abs(placed[1] - now) < 1.6 * MS


def test_the_same_stamp_twice_is_refused() -> None:
    c = clock()
    now = steady(c)
    assert c.place(ticks(now), now + MS, period_ns=25 * MS) is None


def test_three_agreeing_stamps_are_a_restarted_device() -> None:
    c = clock()
    now = steady(c)
    results = []
    for at in range(1, 6):
        host = now + at * 25 * MS
        results.append(c.place(ticks(host - now + 500 * MS), host + MS, period_ns=25 * MS))
    assert [result is None for result in results] == [True, True, False, False, False]
    assert results[-1] is not None
    assert results[-1][1] == pytest.approx(now + 126 * MS, abs=MS)


def test_refused_stamps_that_disagree_change_nothing() -> None:
    c = clock()
    now = steady(c)
    rng = np.random.default_rng(9)
    for at in range(1, 30):
        host = now + at * 25 * MS
        c.place(ticks(host + int(rng.uniform(1, 8) * S)), host + MS, period_ns=25 * MS)
    placed = c.place(ticks(host + 25 * MS), host + 26 * MS, period_ns=25 * MS)
    assert placed is not None
    assert abs(placed[1] - host - 25 * MS) < 1.6 * MS


def test_a_stalled_host_gets_true_stamps_for_what_waited() -> None:
    c = clock()
    now = steady(c)
    for at in range(1, 81):
        placed = c.place(ticks(now + at * 25 * MS), now + 2 * S, period_ns=25 * MS)
        assert placed is not None, at
        assert abs(placed[1] - now - at * 25 * MS) < 1.6 * MS


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_never_raises_and_device_time_only_rises_between_restarts(data: st.DataObject) -> None:
    c = clock()
    host, before = 0, None
    for _ in range(data.draw(st.integers(1, 60))):
        host += data.draw(st.integers(0, 60 * S))
        stamp = data.draw(st.integers(0, (1 << 24) - 1)) * MS
        if data.draw(st.booleans()):
            c.ask(stamp, sent_ns=host, received_ns=host + data.draw(st.integers(0, S)))
            before = None
            continue
        placed = c.place(stamp, host, period_ns=25 * MS)
        fit = c.fit
        if placed is not None:
            assert fit is not None
            if before is not None and placed[0] < before:
                assert fit.samples <= 3
            before = placed[0]
