"""Inverse kinematics against poses that are known."""

import numpy as np
import pytest

from engine.kinematics.markers import fit_markers
from engine.kinematics.markers.inverse import State
from tests.engine.kinematics.markers.builders import make_lift


@pytest.fixture(scope="module")
def lift():
    return make_lift()


def test_normal_equations_are_those_of_the_numeric_jacobian(lift):
    problem, _ = lift.model.problem(lift.recording.names)
    at = lift.coordinates[[0, 30, 40]] + 0.05
    rng = np.random.default_rng(3)
    target = lift.recording.position_m[[0, 30, 40]] + 0.01 * rng.standard_normal((3, 45, 3))
    weights = rng.uniform(0.5, 5.0, (3, 45)) * (rng.uniform(size=(3, 45)) > 0.2)
    state = State.at(problem, at, target.transpose(2, 1, 0), weights.T)
    hessian, gradient = problem.normal_equations(state)

    jacobian = np.empty((3, 45, 3, problem.free.size))
    for i, column in enumerate(problem.free):
        step = np.zeros(at.shape[1])
        step[column] = 1e-6
        moved = [
            problem.tree.pose(at + sign * step)
            .place(problem.body, problem.local)
            .transpose(2, 1, 0)
            for sign in (1, -1)
        ]
        jacobian[..., i] = (moved[0] - moved[1]) / 2e-6
    flat = jacobian.reshape(3, 135, -1)
    weighted = flat * weights.repeat(3, axis=1)[..., None]
    np.testing.assert_allclose(hessian, weighted.transpose(0, 2, 1) @ flat, atol=1e-6)
    expected = (weighted * state.residual.transpose(2, 1, 0).reshape(3, 135, 1)).sum(axis=1)
    np.testing.assert_allclose(gradient, expected, atol=1e-8)


def test_markers_of_a_known_pose_give_that_pose_back(lift):
    rec = lift.recording
    fit = fit_markers(rec.time_s, rec.position_m, rec.names, model=lift.model)
    free = lift.model.free
    factor = np.where(lift.model.tree.is_translation, 1.0, np.degrees(1.0))
    error = fit.coordinates - lift.coordinates * factor
    assert np.abs(error[:, free]).max() < 1e-3
    assert np.nanmax(fit.residual_m) < 1e-6
