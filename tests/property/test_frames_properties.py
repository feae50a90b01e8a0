"""Poses form a group; covariances follow first-order theory, judged by sampling."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping.frames import (
    IDENTITY,
    Pose2,
    Pose3,
    compose_covariance,
    exp_se2,
    interpolate,
    inverse_covariance,
    log_se2,
    wrap_angle,
    wrap_angles,
)
from mapping.pose_buffer import PoseBuffer

LENGTH = st.floats(-100.0, 100.0)
ANGLE = st.floats(-10.0, 10.0)
POSES = st.builds(Pose2, LENGTH, LENGTH, ANGLE)
POSES3 = st.builds(Pose3, LENGTH, LENGTH, LENGTH, ANGLE, ANGLE, ANGLE)
SHARE = st.floats(0.0, 1.0)


def assert_same(a: Pose2, b: Pose2, tolerance: float = 1e-9) -> None:
    assert math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) < tolerance * 100.0
    assert abs(wrap_angle(a.yaw_rad - b.yaw_rad)) < tolerance


@given(POSES, POSES, POSES)
def test_composition_is_associative(a: Pose2, b: Pose2, c: Pose2) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))


@given(POSES)
def test_inverse_cancels(a: Pose2) -> None:
    assert_same(a @ a.inverse(), IDENTITY)
    assert_same(a.inverse() @ a, IDENTITY)


@given(POSES, POSES)
def test_matrices_say_the_same(a: Pose2, b: Pose2) -> None:
    assert np.allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-9)
    assert_same(Pose2.from_matrix(a.matrix()), a)


@given(POSES, LENGTH, LENGTH)
def test_points_follow_the_matrix(a: Pose2, x: float, y: float) -> None:
    assert np.allclose(a.apply([x, y]), (a.matrix() @ [x, y, 1.0])[:2], atol=1e-9)


@given(ANGLE)
def test_wrapped_angles_point_the_same_way(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-12)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-12)
    assert wrap_angles([angle])[0] == wrapped


@given(LENGTH, LENGTH, st.floats(-3.1, 3.1))
def test_log_undoes_exp(vx: float, vy: float, w: float) -> None:
    assert np.allclose(log_se2(exp_se2((vx, vy, w))), (vx, vy, w), atol=1e-7)


@given(LENGTH, LENGTH, st.floats(-2.5, 2.5))
def test_exp_is_the_limit_of_small_steps(vx: float, vy: float, w: float) -> None:
    pose = IDENTITY
    for _ in range(1000):
        pose = pose @ Pose2(vx / 1000.0, vy / 1000.0, w / 1000.0)
    assert_same(exp_se2((vx, vy, w)), pose, tolerance=5e-3)


@given(POSES, POSES, SHARE)
def test_interpolation_reaches_its_ends_and_is_the_same_backwards(a: Pose2, b: Pose2, share: float) -> None:
    assert_same(interpolate(a, b, 0.0), a)
    if abs(abs(wrap_angle(b.yaw_rad - a.yaw_rad)) - math.pi) < 1e-3:
        return  # half a turn: both ways round are as short
    assert_same(interpolate(a, b, 1.0), b, tolerance=1e-7)
    assert_same(interpolate(a, b, share), interpolate(b, a, 1.0 - share), tolerance=1e-6)


@given(POSES, POSES, SHARE)
def test_array_form_agrees_with_the_single_one(a: Pose2, b: Pose2, share: float) -> None:
    if abs(abs(wrap_angle(b.yaw_rad - a.yaw_rad)) - math.pi) < 1e-9:
        return
    track = PoseBuffer()
    track.add(0, a)
    track.add(1_000_000_000, b)
    stamp_ns = round(share * 1e9)
    assert_same(track.at(stamp_ns), interpolate(a, b, stamp_ns * 1e-9), tolerance=1e-6)


@pytest.mark.parametrize("share", [-0.01, 1.01, math.nan])
def test_nothing_is_extrapolated(share: float) -> None:
    with pytest.raises(ValueError, match="share"):
        interpolate(IDENTITY, Pose2(1.0), share)


def sampled(rng: np.random.Generator, pose: Pose2, cov: np.ndarray, n: int = 20_000) -> list[Pose2]:
    errors = rng.multivariate_normal(np.zeros(3), cov, n)
    return [Pose2(pose.x_m + dx, pose.y_m + dy, pose.yaw_rad + dw) for dx, dy, dw in errors]


def spread(poses: list[Pose2], mean: Pose2) -> np.ndarray:
    rows = np.array([(p.x_m - mean.x_m, p.y_m - mean.y_m, wrap_angle(p.yaw_rad - mean.yaw_rad)) for p in poses])
    return np.asarray(rows.T @ rows / len(rows))


def test_covariances_agree_with_samples() -> None:
    rng = np.random.default_rng(5)
    a, b = Pose2(1.0, -2.0, 0.7), Pose2(3.0, 0.5, -1.1)
    cov_a = np.array([[4e-4, 1e-4, 5e-5], [1e-4, 9e-4, -2e-5], [5e-5, -2e-5, 1e-4]])
    cov_b = np.diag([1e-4, 4e-4, 2.5e-4])
    samples = [p @ q for p, q in zip(sampled(rng, a, cov_a), sampled(rng, b, cov_b))]
    predicted = compose_covariance(a, cov_a, b, cov_b)
    # 20,000 samples know a variance to 1 %; four standard errors and the second-order terms fit in 6 % of the scale
    assert np.abs(spread(samples, a @ b) - predicted).max() < 0.06 * predicted.max()
    back = inverse_covariance(a, cov_a)
    assert np.abs(spread([p.inverse() for p in sampled(rng, a, cov_a)], a.inverse()) - back).max() < 0.06 * back.max()


@given(POSES3, POSES3)
def test_spatial_poses_compose_like_matrices(a: Pose3, b: Pose3) -> None:
    assert np.allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-6)
    assert np.allclose((a @ a.inverse()).matrix(), np.eye(4), atol=1e-6)
    assert np.allclose(a.apply([1.0, 2.0, 3.0]), (a.matrix() @ [1.0, 2.0, 3.0, 1.0])[:3], atol=1e-9)


@given(st.floats(-1e-9, 1e-9), st.sampled_from([-math.pi / 2, math.pi / 2]), ANGLE)
def test_looking_straight_up_or_down_keeps_the_rotation(off: float, pitch: float, yaw: float) -> None:
    pose = Pose3(pitch_rad=pitch + off, yaw_rad=yaw, roll_rad=0.3)
    assert np.allclose(Pose3.from_matrix(pose.matrix()).matrix(), pose.matrix(), atol=1e-6)


@given(POSES, LENGTH)
def test_the_plane_fits_into_space(pose: Pose2, z: float) -> None:
    assert_same(Pose3.from_plane(pose, z).in_plane(), pose)


@pytest.mark.parametrize("shape", [(2, 2), (3, 4)])
def test_wrong_matrices_are_refused(shape: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="matrix"):
        Pose2.from_matrix(np.zeros(shape))
    with pytest.raises(ValueError, match="matrix"):
        Pose3.from_matrix(np.zeros(shape))
