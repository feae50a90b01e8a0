"""Sonar rounds as they are kept: small, and the same again."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapping.frames import Pose2
from service.fusion import Cone, Round
from service.kept_rounds import KeptRound, Shapes

_NUMBERS = st.floats(allow_nan=False, width=64)
_RANGES = st.one_of(st.floats(0.0, 10.0), st.sampled_from([math.inf, -math.inf, math.nan]))
_CONES = st.lists(st.tuples(st.integers(0, 31), st.tuples(_NUMBERS, _NUMBERS, _NUMBERS), _RANGES), max_size=16)


@given(_CONES, st.integers(0, 1 << 62), st.lists(_NUMBERS, min_size=6, max_size=6), st.integers(0, 1 << 40))
def test_a_round_comes_back_as_it_was(
    told: list[tuple[int, tuple[float, float, float], float]], stamp_ns: int, poses: list[float], key: int
) -> None:
    cones = tuple(Cone(channel, Pose2(*where), range_m) for channel, where, range_m in told)
    heard = Round(stamp_ns, cones, 0.5, 0.02, 3.0)
    kept = KeptRound.of("left", key, np.array(poses).reshape(2, 3), heard, {})
    assert repr(kept.heard) == repr(heard)  # NaN is not NaN
    assert (kept.sensor, kept.key, kept.reach_m) == ("left", key, 3.0)
    np.testing.assert_array_equal(kept.in_key, np.array(poses).reshape(2, 3))


def test_what_rounds_have_in_common_is_held_once() -> None:
    shapes: Shapes = {}

    def kept(sensor: str, channels: range, range_m: float) -> KeptRound:
        cones = tuple(Cone(channel, Pose2(0.1 * channel, 0.0, 0.0), range_m) for channel in channels)
        return KeptRound.of(sensor, 3, np.zeros((2, 3)), Round(7, cones, 0.5, 0.02, 3.0), shapes)

    rounds = [kept("left", range(4), 0.1 * k) for k in range(10)]
    assert len({id(each.shape) for each in rounds}) == 1
    assert len(rounds[0].numbers) == 8 * (6 + 4)
    assert kept("left", range(4, 8), 1.0).shape.name == "left/[4, 5, 6, 7]"
    assert kept("right", range(4), 1.0).shape is not rounds[0].shape
    assert len(shapes) == 3
