"""Recordings as logs: what a sweep becomes that was taken while moving, and files that are none."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.logs import LogError
from mapping.frames import Pose2
from mapping.scan import Scan
from service.config import Config
from service.recording_log import _log_scan, _wheels_of, read_any_log

SPEEDS = st.floats(-2.0, 2.0)


@given(SPEEDS, SPEEDS, st.floats(-3.0, 3.0), st.booleans(), st.integers(0, 2**32 - 1))
def test_every_echo_stays_where_it_was(forward: float, aside: float, turn: float, clockwise: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 90
    bearing = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False) * (-1.0 if clockwise else 1.0)
    reach = rng.uniform(0.3, 10.0, count)
    reach[rng.random(count) < 0.2] = math.inf
    t = np.linspace(0.0, 0.1, count)
    poses = np.stack((1.0 + forward * t, 2.0 + aside * t, 0.5 + turn * t), axis=-1)
    mount = Pose2(0.2, 0.1, 0.3)
    made = _log_scan(Scan(5_000_000_000, 1e6, bearing, reach, 0.1, 20.0), poses, mount, 1_000_000_000, 7)
    assert np.all(np.diff(made.bearing_rad) > 0.0)
    assert made.bearing_rad[-1] - made.bearing_rad[0] < 2.0 * math.pi
    assert (made.stamp_text, made.stamp_s, made.line) == ("6.000000000", 6.0, 7)
    laser = Pose2(*made.robot_pose) @ mount
    np.testing.assert_allclose((laser.x_m, laser.y_m), poses[0, :2], atol=1e-9)
    hit, seen = np.isfinite(reach), np.isfinite(made.range_m)
    angle = bearing + poses[:, 2]
    truth = poses[hit, :2] + reach[hit, None] * np.stack((np.cos(angle[hit]), np.sin(angle[hit])), axis=-1)
    at = made.bearing_rad[seen]
    found = laser.apply(made.range_m[seen, None] * np.stack((np.cos(at), np.sin(at)), axis=-1))
    assert len(found) >= 0.8 * len(truth)  # a turn that overlaps itself is cut
    off = np.hypot(*(found[:, None] - truth[None]).transpose(2, 0, 1)).min(axis=1)
    assert off.max() < 1e-9


def test_a_file_that_only_begins_like_a_recording_is_told(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(50))
    with pytest.raises(LogError, match="recording"):
        read_any_log(tmp_path / "x.mcap")
    with pytest.raises(LogError, match=r"absent\.mcap"):
        read_any_log(tmp_path / "absent.mcap")
    with pytest.raises(LogError, match="no recording"):
        read_any_log(tmp_path)


def test_a_recording_tells_what_made_its_odometry() -> None:
    data = {
        "drive": {"source": "base", "ticks_per_turn_right": -4096.0, "track_width_m": 0.4},
        "wheels": {"base": {"driver": "cia406", "can": "main"}},
        "can": {"main": {"interface": "virtual", "channel": "x"}},
    }
    wheels = _wheels_of(Config.model_validate(data))
    assert wheels is not None
    assert wheels.left_m_per_tick == pytest.approx(2.0 * math.pi * 0.1 / 4096.0)
    assert wheels.right_m_per_tick == -wheels.left_m_per_tick
    assert wheels.track_width_m == 0.4
    assert _wheels_of(Config()) is None
