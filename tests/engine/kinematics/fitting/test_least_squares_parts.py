"""The parts of the whole-clip fit against dense algebra and differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from engine.kinematics.fitting._banded import factorise, make_roughness
from engine.kinematics.fitting._clip import ClipProblem, fit_clip, fit_frames, linearise
from engine.kinematics.fitting._initial import guess_angles
from engine.kinematics.humanoid import SegmentLengths
from engine.kinematics.humanoid.model import ANGLE_COUNT, ANGLE_VARIABLES, column
from engine.kinematics.humanoid.readout import (
    SHOULDER_ROWS,
    shoulder_from_vectors,
    vectors_from_shoulder,
)
from engine.kinematics.humanoid.rotation import compute_rotation, compute_slope, compute_vectors
from engine.kinematics.humanoid.tree import POINTS, Tree

LENGTHS = SegmentLengths.from_stature(1.75).as_dict()
ARMS = ("shoulder_l", "shoulder_r")

# ----------------------------------------------------------------------------- banded algebra


def dense(blocks: np.ndarray, time_s: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the system of a clip, written out from second differences."""
    n_frames, n, _ = blocks.shape
    system = np.zeros((n_frames, n, n_frames, n))
    for t in range(n_frames):
        system[t, :, t] = blocks[t]
    for t in range(1, n_frames - 1):
        before, after = time_s[t] - time_s[t - 1], time_s[t + 1] - time_s[t]
        row = np.zeros(n_frames)
        row[t - 1 : t + 2] = (1 / before, -1 / before - 1 / after, 1 / after)
        row *= 2 / (before + after)
        for k in range(n):
            system[:, k, :, k] += (before + after) / 2 * weight[t, k] * np.outer(row, row)
    return system.reshape(n_frames * n, n_frames * n)


@pytest.mark.parametrize("n_frames", [1, 2, 3, 4, 7, 8])
def test_solution_and_inverse_equal_dense_algebra(n_frames):
    rng = np.random.default_rng(n_frames)
    n = 4
    time_s = np.cumsum(rng.uniform(0.02, 0.08, n_frames))
    weight = rng.uniform(1e-5, 1e-3, (n_frames, n))
    half = rng.normal(size=(n_frames, n, n))
    blocks = half @ half.transpose(0, 2, 1) + np.eye(n)
    system = dense(blocks, time_s, weight)
    roughness = make_roughness(time_s, weight)
    factor = factorise(blocks, roughness)
    assert factor is not None
    right = rng.normal(size=(n_frames, n, 3))
    expected = np.linalg.solve(system, right.reshape(-1, 3)).reshape(right.shape)
    np.testing.assert_allclose(factor.solve(right), expected, rtol=1e-9, atol=1e-12)
    state = rng.normal(size=(n_frames, n))
    only = system - dense(blocks, time_s, 0 * weight)
    np.testing.assert_allclose(roughness.apply(state).ravel(), only @ state.ravel(), atol=1e-8)
    inverse = np.linalg.inv(system)
    for t, block in enumerate(factor.invert_blocks()):
        part = slice(t * n, (t + 1) * n)
        np.testing.assert_allclose(block, inverse[part, part], rtol=1e-8, atol=1e-12)


def test_straight_lines_are_not_rough_and_parabolas_are_by_their_bend():
    time_s = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.1, 30))
    roughness = make_roughness(time_s, np.ones((30, 1)))
    line, parabola = (2.0 + 3.0 * time_s)[:, None], (1.5 * time_s**2)[:, None]
    assert np.abs(roughness.apply(line)).max() < 1e-8
    cost = np.sum(parabola * roughness.apply(parabola))
    assert cost == pytest.approx(3.0**2 * np.sum(time_s[2:] - time_s[:-2]) / 2)


def test_a_system_that_is_not_positive_definite_is_noticed():
    roughness = make_roughness(np.arange(3.0), np.ones((3, 2)))
    assert factorise(-np.tile(100 * np.eye(2), (3, 1, 1)), roughness) is None


# ----------------------------------------------------------------------------- rotation vectors


@settings(max_examples=80, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
def test_rotations_equal_those_of_scipy(vector):
    v = np.array(vector)[:, None]
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(compute_rotation(v)[..., 0], expected, atol=1e-9)


@pytest.mark.parametrize("length", [0.0, 1e-6, 0.3, 2.0, 4.0])
def test_the_slope_is_the_small_turn_of_a_small_change(length):
    v = length * np.array([[0.6], [-0.48], [0.64]])
    slope = compute_slope(v)[..., 0]
    step = 1e-6
    for k in range(3):
        shift = step * np.eye(3)[:, [k]]
        change = compute_rotation(v + shift)[..., 0] @ compute_rotation(v - shift)[..., 0].T
        turn = Rotation.from_matrix(change).as_rotvec() / (2 * step)
        np.testing.assert_allclose(slope[:, k], turn, atol=1e-6)


def test_vectors_follow_a_turn_beyond_half_a_circle_without_a_jump():
    angle = np.linspace(0.1, 5.0, 60)
    expected = angle[:, None] * np.array([0.0, -0.6, 0.8])
    found = compute_vectors(Rotation.from_rotvec(expected).as_matrix())
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("side", ["l", "r"])
def test_a_shoulder_goes_to_vectors_and_back(side):
    rng = np.random.default_rng(0)
    angles = rng.uniform(-1.5, 1.5, (3, 40))
    vectors = vectors_from_shoulder(angles, side)
    np.testing.assert_allclose(shoulder_from_vectors(vectors, side), angles, atol=1e-9)
    full = rng.uniform(-1.0, 1.0, (ANGLE_COUNT, 40))
    by_vector = full.copy()
    full[list(SHOULDER_ROWS[side])] = angles
    by_vector[list(SHOULDER_ROWS[side])] = vectors
    points = (f"{'left' if side == 'l' else 'right'}_wrist",)
    np.testing.assert_allclose(
        Tree(points, by_vector=ARMS).place(by_vector, LENGTHS).points,
        Tree(points).place(full, LENGTHS).points,
        atol=1e-9,
    )


def test_derivatives_by_rotation_vectors_equal_differences():
    tree = Tree(tuple(POINTS), by_vector=ARMS)
    angles = np.random.default_rng(2).uniform(-1.5, 1.5, (ANGLE_COUNT, 10))
    exact = tree.differentiate(tree.place(angles, LENGTHS))
    for k in range(ANGLE_COUNT):
        shift = 1e-6 * np.eye(ANGLE_COUNT)[:, [k]]
        above, below = (tree.place(angles + s * shift, LENGTHS).points for s in (1, -1))
        np.testing.assert_allclose(exact[:, :, k], (above - below) / 2e-6, atol=1e-8)


# ----------------------------------------------------------------------------- first guess


def test_the_first_guess_is_exact_on_exact_keypoints():
    rng = np.random.default_rng(0)
    time_s = np.arange(4) / 30
    names = tuple(POINTS)
    angles = np.zeros((ANGLE_COUNT, 4))
    for i, variable in enumerate(ANGLE_VARIABLES):
        low, high = variable.bounds
        angles[i] = rng.uniform(max(low, -0.6), min(high, 0.6))
    for name in ("theta_kn_l", "theta_kn_r", "theta_el_l", "theta_el_r"):
        angles[column(name)] = 1.0
    for name in ("psi_an_l", "psi_an_r", "theta_bd", "theta_ws"):
        angles[column(name)] = 0.2
    angles[column("theta_bd")] = 0.2 * 0.4 / 0.6
    placed = Tree(names).place(angles, LENGTHS).points
    points = {name: placed[i].T for i, name in enumerate(names)}
    guess = guess_angles(points, time_s, waist_share=0.6)
    rebuilt = Tree(names, by_vector=ARMS).place(guess, LENGTHS).points
    body = [i for i, name in enumerate(names) if name not in ("nose", "spine")]
    # Heel and toe lie a little off the line that the guess goes by.
    assert np.abs(rebuilt - placed)[body].max() < 0.03


# ----------------------------------------------------------------------------- the fit itself


def make_problem(n_frames: int = 6, *, smooth: float = 1e-3, seed: int = 0) -> tuple:
    rng = np.random.default_rng(seed)
    tree = Tree(tuple(POINTS), by_vector=ARMS)
    n = 3 + len(tree.variables)
    state = np.zeros((n_frames, n))
    state[:, 3:] = rng.uniform(0.1, 0.5, n - 3)
    target = tree.place(_spread(tree, state), LENGTHS).points + state[:, :3].T
    problem = ClipProblem(
        tree=tree,
        target=target + 0.02 * rng.normal(size=target.shape),
        weight=np.full((len(POINTS), n_frames), 1 / 0.02**2),
        lengths=LENGTHS,
        roughness=make_roughness(np.arange(n_frames) / 30, np.full((n_frames, n), smooth)),
        prior_mean=np.zeros((n_frames, n)),
        prior_weight=np.full(n, 0.1),
        waist_share=0.6,
        waist_weight=np.full(n_frames, 50.0),
        huber=2.5,
    )
    return problem, state


def _spread(tree: Tree, state: np.ndarray) -> np.ndarray:
    angles = np.zeros((ANGLE_COUNT, len(state)))
    angles[list(tree.variables)] = state[:, 3:].T
    return angles


def test_the_gradient_equals_differences_of_the_cost():
    problem, state = make_problem(3)
    state = state + 0.15  # far enough for the robust loss to bend
    around = linearise(problem, state)
    for k in range(state.shape[1]):
        shift = 1e-5 * np.eye(state.shape[1])[k]
        rise = linearise(problem, state + shift).cost - linearise(problem, state - shift).cost
        np.testing.assert_allclose(2 * around.gradient[:, k], rise / 2e-5, rtol=1e-4, atol=1e-3)


def test_the_clip_fit_ends_in_a_minimum():
    problem, start = make_problem(8)
    fit = fit_clip(problem, start)
    assert fit.has_converged
    rng = np.random.default_rng(5)

    def cost(state: np.ndarray) -> float:
        rough = np.sum(state * problem.roughness.apply(state))
        return float(linearise(problem, state).cost.sum() + rough)

    assert fit.cost == pytest.approx(cost(fit.state))
    for _ in range(20):
        away = fit.state + 0.01 * rng.normal(size=fit.state.shape)
        assert cost(away) > fit.cost - 1e-3


def test_without_roughness_both_fits_agree():
    problem, start = make_problem(5, smooth=1e-12)
    together, alone = fit_clip(problem, start), fit_frames(problem, start)
    assert alone.cost == pytest.approx(together.cost, rel=0.01)
    # Knees are well seen; the turn of an arm with a nearly straight elbow is not.
    knee = problem.unknown("theta_kn_l")
    np.testing.assert_allclose(alone.state[:, knee], together.state[:, knee], atol=0.01)


def test_refined_lengths_lower_the_cost():
    problem, start = make_problem(20)
    wrong = {**LENGTHS, "thigh": 0.9 * LENGTHS["thigh"], "forearm": 1.1 * LENGTHS["forearm"]}
    fixed = ClipProblem(**{**vars(problem), "lengths": wrong})
    free = fit_clip(fixed, start, refine_lengths={"thigh": 0.05, "forearm": 0.05})
    assert free.cost < fit_clip(fixed, start).cost
    assert free.problem.lengths["thigh"] == pytest.approx(LENGTHS["thigh"], rel=0.02)
    assert free.problem.lengths["forearm"] == pytest.approx(LENGTHS["forearm"], rel=0.03)
    assert free.problem.lengths["shank"] == LENGTHS["shank"]
