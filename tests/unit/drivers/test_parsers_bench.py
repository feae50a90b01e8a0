"""The bench of parsers measures what it says: every device's bytes hold frames that its parser finds."""

from __future__ import annotations

import pytest

from bench.parsers import PARSERS, Figures, bad_bytes, measure_asked, sent_by


@pytest.mark.parametrize("name", [name for name in PARSERS if name != "RoboClaw"])
def test_the_bytes_of_an_emulated_device_hold_frames_and_damage_none_more(name: str) -> None:
    data = sent_by(name, seconds=0.5)
    whole = len(list(PARSERS[name]()(data)))
    assert whole >= 3
    noise, damaged, *_ = bad_bytes(data)
    assert len(noise) > 4096
    assert len(list(PARSERS[name]()(damaged))) <= whole


def test_a_roboclaw_is_asked() -> None:
    assert measure_asked(rounds=500).frames > 50


@pytest.mark.parametrize(
    ("frames", "per_s", "slowest_s", "holds"),
    [(10, 6000.0, 0.01, True), (10, 4000.0, 0.01, False), (10, 6000.0, 0.06, False), (0, 0.0, 0.01, True)],
)
def test_the_limits(frames: int, per_s: float, slowest_s: float, holds: bool) -> None:
    assert Figures("x", frames, per_s, slowest_s).holds is holds
