"""The pose graph against dense algebra and against truth with liars among the edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import wrap_angles
from mapping.localise.pose_graph import (
    Edges,
    Uncertainty,
    composed_poses,
    covariance_of,
    mahalanobis,
    optimise,
    relative_poses,
    residuals,
    weights_of,
)

F64 = NDArray[np.float64]
SURE = np.diag([1.0 / 0.02**2, 1.0 / 0.03**2, 1.0 / 0.01**2])


def ring(keys: int = 60, laps: int = 2) -> F64:
    """Poses (N, 3) on a circle of 5 m."""
    turn = np.linspace(0.0, 2.0 * math.pi * laps, keys)
    return np.stack((5.0 * np.sin(turn), 5.0 - 5.0 * np.cos(turn), wrap_angles(turn)), axis=-1)


def edges_between(poses: F64, pairs: list[tuple[int, int]], *, doubtful: bool, noise: float, seed: int) -> Edges:
    start, to = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    measured = relative_poses(poses[start], poses[to])
    measured += noise * np.random.default_rng(seed).normal(0.0, 1.0, measured.shape) * [0.02, 0.03, 0.01]
    measured[:, 2] = wrap_angles(measured[:, 2])
    return Edges(start, to, measured, np.repeat(SURE[None], len(pairs), axis=0), np.full(len(pairs), doubtful))


def drifted(path: Edges, start: F64) -> F64:
    poses = [start]
    for measured in path.measured:
        poses.append(composed_poses(poses[-1], measured[None])[0])
    return np.array(poses)


def test_true_edges_are_fulfilled_from_a_bad_start() -> None:
    truth = ring()
    path = edges_between(truth, [(k, k + 1) for k in range(59)], doubtful=False, noise=0.0, seed=0)
    start = truth + np.random.default_rng(1).normal(0.0, 0.1, truth.shape)
    start[0] = truth[0]
    solved = optimise(start, path)
    assert np.abs(solved.poses[:, :2] - truth[:, :2]).max() < 1e-6
    assert np.abs(wrap_angles(solved.poses[:, 2] - truth[:, 2])).max() < 1e-7


@pytest.mark.parametrize("liars", [0, 5, 20])
def test_liars_lose(liars: int) -> None:
    truth = ring(120, 3)
    path = edges_between(truth, [(k, k + 1) for k in range(119)], doubtful=False, noise=1.0, seed=2)
    honest = edges_between(truth, [(k, k + 40) for k in range(0, 70, 2)], doubtful=True, noise=1.0, seed=3)
    rng = np.random.default_rng(4)
    pairs = [(a, b) for a, b in rng.integers(0, 120, (liars * 2, 2)).tolist() if a != b][:liars]
    false = edges_between(truth, pairs, doubtful=True, noise=0.0, seed=0) if pairs else Edges.none()
    false.measured[:, :2] += rng.uniform(1.0, 4.0, (len(false), 2))
    edges = path.joined(honest).joined(false)
    solved = optimise(drifted(path, truth[0]), edges, start_scale=1e4, most_steps=30)
    assert np.hypot(*(solved.poses[:, :2] - truth[:, :2]).T).max() < 0.25
    assert solved.weight[len(path) + len(honest) :].max(initial=0.0) < 0.01
    assert np.median(solved.weight[len(path) : len(path) + len(honest)]) > 0.3
    assert np.all(solved.weight[: len(path)] == 1.0)


def test_residuals_vanish_at_the_truth_and_wrap() -> None:
    truth = ring()
    edges = edges_between(truth, [(0, 30), (5, 59)], doubtful=True, noise=0.0, seed=0)
    assert mahalanobis(truth, edges).max() < 1e-18
    turned = truth.copy()
    turned[:, 2] += 2.0 * math.pi * np.arange(len(turned))
    assert mahalanobis(turned, edges).max() < 1e-16
    assert np.all(weights_of(truth, edges) == pytest.approx(1.0))


def test_the_step_is_that_of_dense_gauss_newton() -> None:
    truth = ring(12, 1)
    edges = edges_between(truth, [(k, k + 1) for k in range(11)] + [(0, 7)], doubtful=False, noise=1.0, seed=5)
    start = truth + np.random.default_rng(6).normal(0.0, 0.05, truth.shape)
    once = optimise(start, edges, most_steps=1)

    def off(flat: F64) -> F64:
        found = residuals(flat.reshape(-1, 3), edges)
        found[:, 2] = wrap_angles(found[:, 2])
        return found.ravel()

    jacobian = np.zeros((3 * len(edges), start.size))
    for k in range(start.size):
        step = np.zeros(start.size)
        step[k] = 1e-6
        jacobian[:, k] = (off(start.ravel() + step) - off(start.ravel() - step)) / 2e-6
    weight = np.kron(np.eye(len(edges)), SURE)
    hessian = jacobian.T @ weight @ jacobian
    hessian[:3, :3] += 1e9 * np.eye(3)
    expected = start.ravel() - np.linalg.solve(hessian, jacobian.T @ weight @ off(start.ravel()))
    assert np.abs(wrap_angles(once.poses[:, 2] - expected.reshape(-1, 3)[:, 2])).max() < 1e-5
    assert np.abs(once.poses[:, :2] - expected.reshape(-1, 3)[:, :2]).max() < 1e-5
    covariance = covariance_of(start, edges, np.ones(len(edges)), 7)
    assert np.allclose(covariance, np.linalg.inv(hessian)[21:24, 21:24], rtol=1e-4, atol=1e-9)


def test_small_graphs() -> None:
    one = np.array([[1.0, 2.0, 3.0]])
    assert np.array_equal(optimise(one, Edges.none()).poses, one)
    assert np.array_equal(covariance_of(one, Edges.none(), np.zeros(0), 0), np.zeros((3, 3)))


def chain(poses: F64, sigma_m: float, sigma_rad: float) -> Edges:
    """Steps from pose to pose, all equally sure."""
    pairs = [(k, k + 1) for k in range(len(poses) - 1)]
    path = edges_between(poses, pairs, doubtful=False, noise=0.0, seed=0)
    sure = np.diag([sigma_m**-2.0, sigma_m**-2.0, sigma_rad**-2.0])
    return Edges(path.start, path.to, path.measured, np.repeat(sure[None], len(pairs), axis=0), path.doubtful)


def test_uncertainty_along_a_path_is_that_of_its_steps() -> None:
    poses = ring(40, 1)
    path = chain(poses, 0.02, 0.01)
    told = Uncertainty(poses, path, np.ones(39), held_m=1.0).of_relative(5, 30)
    rng = np.random.default_rng(1)
    ends = np.repeat(np.zeros((1, 3)), 20_000, axis=0)
    for measured in path.measured[5:30]:
        ends = composed_poses(ends, measured + rng.normal(0.0, 1.0, ends.shape) * [0.02, 0.02, 0.01])
    np.testing.assert_allclose(told, np.cov(ends.T), rtol=0.1, atol=2e-4)


def test_steps_that_wheels_alone_hold_err_together() -> None:
    """Along a straight way with it, and not at all around a loop, where a gain that is wrong cancels out."""
    straight = np.zeros((101, 3))
    straight[:, 0] = 0.3 * np.arange(101)
    sure = Uncertainty(straight, chain(straight, 0.01, 1e-4), np.ones(100), held_m=0.0115).of_relative(0, 100)
    assert math.sqrt(sure[0, 0]) == pytest.approx(0.1, rel=0.01)
    bare = Uncertainty(straight, chain(straight, 0.02, 1e-4), np.ones(100), held_m=0.0115).of_relative(0, 100)
    assert math.sqrt(bare[0, 0]) > 100 * 0.016
    assert math.sqrt(bare[1, 1]) < 0.25
    loop = ring(101, 1)
    around = Uncertainty(loop, chain(loop, 0.02, 1e-4), np.ones(100), held_m=0.0115).of_relative(0, 100)
    assert math.sqrt(around[0, 0]) < 0.3


def test_a_closure_takes_uncertainty_away() -> None:
    poses = ring(61, 1)
    path = chain(poses, 0.02, 0.01)
    closure = edges_between(poses, [(0, 59)], doubtful=True, noise=0.0, seed=0)
    before = Uncertainty(poses, path, np.ones(60), held_m=0.0115).of_relative(1, 58)
    after = Uncertainty(poses, path.joined(closure), np.ones(61), held_m=0.0115).of_relative(1, 58)
    assert np.trace(after) < 0.2 * np.trace(before)
