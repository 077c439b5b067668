"""The twin's cost is a divergence of Gaussians; its gradient and its solver must agree with it."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize

from engine.pose.twin_gp.kernels import compute_kernel, compute_square_distances
from engine.pose.twin_gp.lengths import LengthPenalty
from engine.pose.twin_gp.twin import (
    LocalTwin,
    LowRankInverse,
    SharedTwin,
    factor_kernel,
    minimise,
    solve_with_lengths,
)

N, D, M = 30, 6, 5
GAMMA_R, GAMMA_X, LAMBDA_R, LAMBDA_X = 0.4, 0.7, 0.05, 0.02


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(1)
    hidden = rng.normal(size=(N + M, 2))
    features = np.tanh(hidden @ rng.normal(size=(2, 4)))
    pose = np.sin(hidden @ rng.normal(size=(2, D)))
    return features[:N], pose[:N], features[N:], pose[N:]


def kernels(features, tests):
    def gram(a, b, gamma):
        return np.exp(-gamma * ((a[:, None] - b[None]) ** 2).sum(2))

    k_r = gram(features, features, GAMMA_R) + LAMBDA_R * np.eye(len(features))
    cross = gram(tests, features, GAMMA_R)
    u = np.linalg.solve(k_r, cross.T).T
    return u, 1 + LAMBDA_R - np.sum(cross * u, axis=1)


def shared(problem):
    features, pose, tests, _ = problem
    u, eta = kernels(features, tests)
    factor = factor_kernel(pose, GAMMA_X, 1e-12)
    return SharedTwin(pose, LowRankInverse.from_factor(factor, LAMBDA_X), GAMMA_X, u, eta)


def local(problem):
    features, pose, tests, _ = problem
    u, eta = kernels(features, tests)
    gram = np.exp(-GAMMA_X * ((pose[:, None] - pose[None]) ** 2).sum(2))
    inverse = np.linalg.inv(gram + LAMBDA_X * np.eye(N))
    each = np.tile(pose, (M, 1, 1)), np.tile(inverse, (M, 1, 1))
    return LocalTwin(*each, GAMMA_X, LAMBDA_X, u, eta)


def divergence(problem, row, x):
    """2 eta times the divergence of the two Gaussians, from their whole covariances."""
    features, pose, tests, _ = problem

    def covariance(points, gamma, noise):
        square = ((points[:, None] - points[None]) ** 2).sum(2)
        return np.exp(-gamma * square) + noise * np.eye(len(points))

    k_r = covariance(np.vstack([features, tests[row]]), GAMMA_R, LAMBDA_R)
    k_x = covariance(np.vstack([pose, x]), GAMMA_X, LAMBDA_X)
    _, log_r = np.linalg.slogdet(k_r)
    _, log_x = np.linalg.slogdet(k_x)
    return 0.5 * (np.trace(np.linalg.solve(k_r, k_x)) - log_x + log_r - N - 1)


@pytest.mark.parametrize("make", [shared, local])
def test_cost_is_the_divergence_but_for_a_constant(problem, make):
    twin = make(problem)
    rng = np.random.default_rng(2)
    for row in range(M):
        poses = rng.normal(scale=0.5, size=(4, D))
        cost, *_ = twin.evaluate(poses, np.full(4, row))
        brute = [2 * twin.eta[row] * divergence(problem, row, x) for x in poses]
        np.testing.assert_allclose(np.diff(cost), np.diff(brute), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("make", [shared, local])
def test_gradient_agrees_with_central_differences(problem, make):
    twin = make(problem)
    pose = np.random.default_rng(4).normal(scale=0.6, size=(M, D))
    rows = np.arange(M)
    _, gradient, _ = twin.evaluate(pose, rows)
    for column in range(D):
        step = np.zeros(D)
        step[column] = 1e-5
        up, down = (twin.evaluate(pose + sign * step, rows)[0] for sign in (1, -1))
        np.testing.assert_allclose(gradient[:, column], (up - down) / 2e-5, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("shape", ["squared", "pseudo-huber"])
def test_gradient_of_the_penalty(shape):
    rng = np.random.default_rng(5)
    segments = np.array([[1.0, -0.5, -0.5], [0.0, 0.5, -0.5]])
    penalty = LengthPenalty(segments, np.array([0.3, 0.2]), np.array([0.01, 0.02]), shape=shape)
    pose = rng.normal(size=(4, 9))
    weight = penalty.weigh(np.array([0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_allclose(weight[0], 0.1 / np.array([1e-4, 4e-4]))
    _, gradient = penalty.evaluate(pose, weight)
    for column in range(9):
        step = np.zeros(9)
        step[column] = 1e-6
        up, down = (penalty.evaluate(pose + sign * step, weight)[0] for sign in (1, -1))
        np.testing.assert_allclose(gradient[:, column], (up - down) / 2e-6, rtol=1e-4, atol=1e-3)


def test_low_rank_inverse_is_the_inverse():
    rng = np.random.default_rng(6)
    path = np.column_stack([np.sin(k * np.linspace(0, 6, 200)) for k in range(1, 4)])
    points = path + rng.normal(scale=1e-4, size=path.shape)
    noise = 1e-2
    gram = compute_kernel(compute_square_distances(points), 0.3)
    factor = factor_kernel(points, 0.3, 1e-6 * noise)
    assert factor.shape[1] < 0.7 * len(points)
    kernel = compute_kernel(compute_square_distances(points[:9] + 0.05, points), 0.3)
    exact = kernel @ np.linalg.inv(gram + noise * np.eye(200))
    low = LowRankInverse.from_factor(factor, noise)
    np.testing.assert_allclose(low.apply(kernel), exact, atol=1e-4 * np.abs(exact).max())


@pytest.mark.parametrize("make", [shared, local])
def test_solver_finds_the_minimum_that_scipy_finds(problem, make):
    twin = make(problem)
    start = twin.u @ problem[1]
    solution = minimise(twin, start)
    for row in range(M):
        at = np.array([row])
        peer = scipy.optimize.minimize(
            lambda x, at=at: twin.evaluate(x[None], at)[0][0],
            start[row],
            jac=lambda x, at=at: twin.evaluate(x[None], at)[1][0],
            method="BFGS",
            options={"gtol": 1e-8},
        )
        assert solution.cost[row] <= peer.fun + 1e-6
        np.testing.assert_allclose(solution.pose[row], peer.x, atol=5e-3)


def test_rows_do_not_influence_each_other(problem):
    twin = shared(problem)
    start = twin.u @ problem[1]
    together = minimise(twin, start).pose
    for row in range(M):
        alone = SharedTwin(twin.train, twin.inverse, twin.gamma, twin.u[[row]], twin.eta[[row]])
        np.testing.assert_allclose(minimise(alone, start[[row]]).pose[0], together[row], atol=1e-6)


def test_penalty_restores_lengths(problem):
    twin = shared(problem)
    start = twin.u @ problem[1]
    segments = np.array([[1.0, -1.0]])
    penalty = LengthPenalty(segments, np.array([0.4]), np.array([0.002]))
    offset = np.zeros(D)
    solution = solve_with_lengths(twin, start, eta=twin.eta, penalty=penalty, offset=offset)
    markers = solution.pose.reshape(M, 2, 3)
    length = np.linalg.norm(markers[:, 0] - markers[:, 1], axis=1)
    np.testing.assert_allclose(length, 0.4, atol=0.004)


def test_a_frame_that_starts_at_nan_stays_nan(problem):
    twin = shared(problem)
    start = twin.u @ problem[1]
    start[2] = np.nan
    solution = minimise(twin, start)
    assert np.isnan(solution.pose[2]).all()
    assert np.isfinite(np.delete(solution.pose, 2, axis=0)).all()
