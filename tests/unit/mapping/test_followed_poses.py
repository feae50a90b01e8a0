"""Another estimator's poses as odometry: steps are followed, jumps are not, and a new start moves nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping.frames import Pose2
from mapping.odometry import FollowedPoses

STEP_NS = 50_000_000
poses = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-math.pi, math.pi)).map(lambda p: Pose2(*p))


def follow(track: list[Pose2]) -> FollowedPoses:
    followed = FollowedPoses(max_speed_m_s=5.0)
    for number, pose in enumerate(track):
        assert followed.update((number + 1) * STEP_NS, pose) is not None
    return followed


@given(poses, st.lists(st.tuples(st.floats(-0.2, 0.2), st.floats(-0.1, 0.1), st.floats(-0.3, 0.3)), max_size=20))
def test_the_track_is_the_estimators_seen_from_its_first_pose(start: Pose2, steps: list[tuple[float, ...]]) -> None:
    track = [start]
    for x, y, yaw in steps:
        track.append(track[-1] @ Pose2(x, y, yaw))
    followed = FollowedPoses(max_speed_m_s=10.0)
    for number, pose in enumerate(track):
        state = followed.update((number + 1) * STEP_NS, pose)
        assert state is not None
        want = start.inverse() @ pose
        assert (state.odom_from_base.x_m, state.odom_from_base.y_m) == pytest.approx((want.x_m, want.y_m), abs=1e-9)
        assert math.remainder(state.odom_from_base.yaw_rad - want.yaw_rad, 2 * math.pi) == pytest.approx(0, abs=1e-9)
        assert np.linalg.eigvalsh(state.covariance).min() >= -1e-12
        assert not state.broken


def test_speeds_are_those_of_the_last_step() -> None:
    followed = follow([Pose2(), Pose2(0.05, 0.0, 0.1)])
    state = followed.update(3 * STEP_NS, Pose2(0.05, 0.0, 0.1) @ Pose2(0.1, 0.0, -0.05))
    assert state is not None
    assert (state.forward_m_s, state.yaw_rad_s) == pytest.approx((2.0, -1.0))


def test_a_step_no_robot_makes_is_refused_and_believed_only_if_it_stays() -> None:
    followed = follow([Pose2(), Pose2(0.01, 0.0, 0.0)])
    far = Pose2(9.0, 0.0, 0.0)
    answers = [followed.update((3 + k) * STEP_NS, far) for k in range(6)]
    assert [answer is None for answer in answers] == [True] * 5 + [False]
    last = answers[-1]
    assert last is not None
    assert last.broken
    assert last.odom_from_base.x_m == pytest.approx(0.01)  # kept: what lay between is not known
    assert last.covariance[0, 0] > 1.0


def test_one_wild_pose_leaves_no_trace() -> None:
    followed = follow([Pose2(), Pose2(0.01, 0.0, 0.0)])
    assert followed.update(3 * STEP_NS, Pose2(9.0, 0.0, 0.0)) is None
    state = followed.update(4 * STEP_NS, Pose2(0.03, 0.0, 0.0))
    assert state is not None
    assert state.odom_from_base.x_m == pytest.approx(0.03)
    assert not state.broken


def test_an_estimator_that_begins_anew_moves_nothing_but_the_doubt() -> None:
    followed = follow([Pose2(), Pose2(0.1, 0.0, 0.0)])
    state = followed.update(3 * STEP_NS, Pose2(-7.0, 3.0, 1.0), continuous=False)
    assert state is not None
    assert state.broken
    assert state.odom_from_base == Pose2(0.1, 0.0, 0.0)
    onward = followed.update(4 * STEP_NS, Pose2(-7.0, 3.0, 1.0) @ Pose2(0.1, 0.0, 0.0))
    assert onward is not None
    assert onward.odom_from_base.x_m == pytest.approx(0.2)


def test_stamps_rise() -> None:
    followed = follow([Pose2()])
    with pytest.raises(ValueError, match="rise"):
        followed.update(STEP_NS, Pose2())
