from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from engine.cameras.depth import (
    BONES,
    JOINTS,
    JUMP_CAP,
    JUMP_SIGMA_M,
    DepthProblem,
    DepthSettings,
    _banded_step,
    _Rows,
    _steady_choice,
    bone_rows,
    mass_weights,
    solve_depths,
)
from engine.datatypes import Array
from tests.engine.cameras.truth import NAMES, place_camera, read_truth

N_BONES = len(BONES)
# Rows of one frame, in the order in which they are put together, and whether they are robust.
BLOCKS = {
    "bones": (slice(0, N_BONES), True),
    "priors": (slice(N_BONES, 2 * N_BONES), True),
    "floor": (slice(2 * N_BONES, 2 * N_BONES + 6), True),
    "feet": (slice(2 * N_BONES + 6, 2 * N_BONES + 8), False),
    "hinges": (slice(2 * N_BONES + 8, 2 * N_BONES + 12), False),
    "forearms": (slice(2 * N_BONES + 12, 2 * N_BONES + 14), False),
    "balance": (slice(2 * N_BONES + 14, 2 * N_BONES + 15), False),
}


@dataclasses.dataclass(frozen=True)
class Case:
    """A problem and the depths it was made from."""

    problem: DepthProblem
    depth: Array

    def change(self, **values: Any) -> DepthProblem:
        return dataclasses.replace(self.problem, **values)


def joint_points(points: Array) -> Array:
    columns = []
    for name in JOINTS:
        side, part = name.split("_", 1)
        parts = ("index", "pinky") if part == "hand" else (part,)
        columns.append(np.mean([points[:, NAMES.index(f"{side}_{p}")] for p in parts], axis=0))
    return np.stack(columns, axis=1)


@pytest.fixture(scope="module")
def case() -> Case:
    """The lift from floor to knuckles from the right, and all that is true of it."""
    truth = read_truth("floor_to_knuckle")
    camera = place_camera(azimuth_deg=100.0, pitch_deg=5.0)
    world = joint_points(truth.points)
    local = world @ camera.rotation.T + camera.translation
    depth = local[..., 2]
    lengths = np.median(
        [
            np.linalg.norm(local[:, JOINTS.index(a)] - local[:, JOINTS.index(b)], axis=1)
            for a, b in BONES
        ],
        axis=1,
    )
    floor_joints = [i for i, n in enumerate(JOINTS) if n.endswith(("ankle", "heel", "big_toe"))]
    feet = depth[:, [JOINTS.index("left_ankle"), JOINTS.index("right_ankle")]].mean(axis=1)
    problem = DepthProblem(
        rays=local / depth[..., None],
        prior=depth - feet[:, None],
        confidence=np.full(depth.shape, 0.99),
        feet_depth=feet,
        lengths=lengths,
        length_sigma=0.03 * lengths,
        up=camera.rotation[:, 1],
        right=camera.rotation[:, 2],
        floor_height=-1.3,
        joint_heights=world[:, floor_joints, 1].mean(axis=0),
        is_standing=np.ones(len(depth), dtype=bool),
        step_s=1 / 30,
    )
    return Case(problem, depth)


def rows(problem: DepthProblem) -> _Rows:
    seen = np.isfinite(problem.rays).all(axis=2)
    return _Rows(problem, seen, DepthSettings())


def plain(block: str, jacobian: Array, residual: Array) -> tuple[Array, Array]:
    """Return one block's rows with the robust weights taken off again."""
    part, is_robust = BLOCKS[block]
    jacobian, residual = jacobian[:, part], residual[:, part]
    if not is_robust:
        return jacobian, residual
    # weighted = r / sqrt(1 + (r / 3)^2), so r = weighted / sqrt(1 - (weighted / 3)^2).
    weight = np.sqrt(1 - (residual / 3) ** 2)
    return jacobian / weight[..., None], residual / weight


class TestRows:
    def test_blocks_are_all_rows(self, case):
        jacobian, residual = rows(case.problem).evaluate(case.depth)
        stop = max(part.stop for part, _ in BLOCKS.values())
        assert residual.shape == (len(case.depth), stop)
        assert jacobian.shape == (len(case.depth), stop, len(JOINTS))

    @pytest.mark.parametrize("block", BLOCKS)
    @pytest.mark.parametrize("seed", [0, 1])
    def test_jacobian_is_the_derivative_of_the_residuals(self, case, block, seed):
        # Far from the truth, so that forearms point outwards; and with the right side called the
        # left, so that elbows and knees bend the wrong way.
        frames = slice(60, 90, 5)
        problem = dataclasses.replace(
            case.problem,
            right=(-1 if block == "hinges" else 1) * case.problem.right,
            **{
                name: getattr(case.problem, name)[frames]
                for name in ("rays", "prior", "confidence", "feet_depth", "is_standing")
            },
        )
        noise = np.random.default_rng(seed).standard_normal((6, len(JOINTS)))
        depth = case.depth[frames] + 0.12 * noise
        statements = rows(problem)
        jacobian, residual = plain(block, *statements.evaluate(depth))
        step = 1e-6
        for joint in range(len(JOINTS)):
            shift = step * (np.arange(len(JOINTS)) == joint)
            high = plain(block, *statements.evaluate(depth + shift))[1]
            low = plain(block, *statements.evaluate(depth - shift))[1]
            assert jacobian[:, :, joint] == pytest.approx(
                (high - low) / (2 * step), abs=1e-3, rel=1e-4
            )
        assert np.abs(residual).max() > 0.1
        assert np.abs(jacobian).max() > 0.1

    @pytest.mark.parametrize("block", ["priors", "floor", "feet", "hinges"])
    def test_truth_agrees_with_every_statement(self, case, block):
        _, residual = plain(block, *rows(case.problem).evaluate(case.depth))
        assert np.abs(residual).max() < 1.0

    def test_unseen_joints_say_nothing(self, case):
        rays = np.array(case.problem.rays)
        wrist = JOINTS.index("left_wrist")
        rays[:, wrist] = np.nan
        jacobian, residual = rows(case.change(rays=rays)).evaluate(case.depth)
        assert np.isfinite(residual).all()
        assert (jacobian[:, :, wrist] == 0).all()

    def test_joints_the_network_told_nothing_of_have_no_prior(self, case):
        prior = np.array(case.problem.prior)
        wrist = JOINTS.index("left_wrist")
        prior[:, wrist] = np.nan
        jacobian, _ = rows(case.change(prior=prior)).evaluate(case.depth)
        assert (jacobian[:, BLOCKS["priors"][0], wrist] == 0).all()
        assert (jacobian[:, BLOCKS["bones"][0], wrist] != 0).any()


class TestSolve:
    def test_truth_stays(self, case):
        solved = solve_depths(case.problem)
        assert np.abs(solved - case.depth).mean() < 0.02
        assert np.abs(solved - case.depth).max() < 0.12

    @pytest.mark.parametrize("seed", range(3))
    def test_a_wrong_prior_is_corrected(self, case, seed):
        # Each joint's depth is wrong by its own 15 cm (SD) during the whole clip.
        offset = 0.15 * np.random.default_rng(seed).standard_normal(len(JOINTS))
        solved = solve_depths(case.change(prior=case.problem.prior + offset))
        error = solved - case.depth
        assert np.abs(error).mean() < 0.6 * np.abs(offset - offset.mean()).mean()
        legs = [JOINTS.index(f"{s}_{n}") for s in ("left", "right") for n in ("ankle", "knee")]
        assert np.abs(error[:, legs]).mean() < 0.10

    def test_a_scattered_prior_is_smoothed(self, case):
        noise = 0.10 * np.random.default_rng(0).standard_normal(case.depth.shape)
        solved = solve_depths(case.change(prior=case.problem.prior + noise))
        assert np.abs(solved - case.depth).mean() < 0.04
        jitter = np.abs(np.diff(solved, n=2, axis=0)).mean()
        assert jitter < 0.1 * np.abs(np.diff(noise, n=2, axis=0)).mean()

    def test_bones_keep_their_length(self, case):
        offset = 0.10 * np.random.default_rng(3).standard_normal(len(JOINTS))
        problem = case.change(prior=case.problem.prior + offset)
        solved = solve_depths(problem)
        points = problem.rays * solved[..., None]
        for row in bone_rows(("knee", "hip")) + bone_rows(("ankle", "knee")):
            a, b = (JOINTS.index(n) for n in BONES[row])
            length = np.linalg.norm(points[:, a] - points[:, b], axis=1)
            assert length == pytest.approx(problem.lengths[row], rel=0.08)

    def test_unseen_samples_are_missing_and_do_not_disturb_the_others(self, case):
        rays = np.array(case.problem.rays)
        hand = [JOINTS.index(f"left_{n}") for n in ("wrist", "hand")]
        rays[50:80, hand] = np.nan
        solved, whole = solve_depths(case.change(rays=rays)), solve_depths(case.problem)
        assert np.isnan(solved[50:80][:, hand]).all()
        seen = np.isfinite(rays).all(axis=2)
        assert np.isfinite(solved[seen]).all()
        assert solved[seen] == pytest.approx(whole[seen], abs=0.10)

    def test_a_hand_without_a_wrist_stays_near_the_arm(self, case):
        rays = np.array(case.problem.rays)
        rays[:, JOINTS.index("left_wrist")] = np.nan
        solved = solve_depths(case.change(rays=rays))
        hand = JOINTS.index("left_hand")
        assert np.abs(solved[:, hand] - case.depth[:, hand]).max() < 0.25

    @pytest.mark.parametrize("chunk", [40, 90, 183])
    def test_pieces_agree_with_the_whole(self, case, chunk):
        whole, pieces = solve_depths(case.problem), solve_depths(case.problem, chunk=chunk)
        assert pieces == pytest.approx(whole, abs=0.03)

    @pytest.mark.parametrize("n_frames", [1, 2, 3])
    def test_very_short_clips(self, case, n_frames):
        fields = ("rays", "prior", "confidence", "feet_depth", "is_standing")
        problem = case.change(**{n: getattr(case.problem, n)[:n_frames] for n in fields})
        assert np.abs(solve_depths(problem) - case.depth[:n_frames]).max() < 0.12


@settings(max_examples=40)
@given(
    candidates=arrays(float, (2, 7), elements=st.floats(2.0, 4.0)),
    cost=arrays(float, (2, 7), elements=st.floats(0.0, 60.0)),
)
def test_steady_choice_is_the_best_of_all(candidates, cost):
    n_frames = candidates.shape[1]

    def total(choice: tuple[int, ...]) -> float:
        path = candidates[list(choice), np.arange(n_frames)]
        jumps = np.minimum((np.diff(path) / JUMP_SIGMA_M) ** 2, JUMP_CAP)
        return float(cost[list(choice), np.arange(n_frames)].sum() + jumps.sum())

    best = min(total(choice) for choice in itertools.product((0, 1), repeat=n_frames))
    assert total(tuple(_steady_choice(candidates, cost))) == pytest.approx(best)


@pytest.mark.parametrize("n_frames", [1, 2, 3, 4, 9])
def test_banded_step_solves_the_full_equations(n_frames):
    rng = np.random.default_rng(n_frames)
    n_joints, smoothness = 3, 7.0
    root = rng.standard_normal((n_frames, 5, n_joints))
    normal = root.transpose(0, 2, 1) @ root
    gradient = rng.standard_normal((n_frames, n_joints))
    depth = rng.standard_normal((n_frames, n_joints))
    second = np.zeros((max(n_frames - 2, 0), n_frames))
    for row in range(len(second)):
        second[row, row : row + 3] = 1.0, -2.0, 1.0
    penalty = smoothness * np.kron(second.T @ second, np.eye(n_joints))
    full = penalty + 1e-6 * np.eye(n_frames * n_joints)
    for frame in range(n_frames):
        part = slice(frame * n_joints, (frame + 1) * n_joints)
        full[part, part] += normal[frame]
    expected = np.linalg.solve(full, -(gradient.ravel() + penalty @ depth.ravel()))
    step = _banded_step(normal, gradient, depth, smoothness)
    assert step.ravel() == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_masses_and_support_are_shares_of_the_whole():
    mass, support = mass_weights()
    assert mass.sum() == pytest.approx(1.0)
    assert support.sum() == pytest.approx(1.0)
    assert (mass >= 0).all()
    left = [i for i, name in enumerate(JOINTS) if name.startswith("left_")]
    right = [JOINTS.index(JOINTS[i].replace("left_", "right_")) for i in left]
    assert mass[left] == pytest.approx(mass[right])


def test_bone_rows_are_left_and_right():
    for row in bone_rows(("knee", "hip")):
        a, b = BONES[row]
        assert a.split("_")[0] == b.split("_")[0]
    assert len(bone_rows(("knee", "hip"))) == 2
    assert bone_rows(("hip", "wrist")) == []
