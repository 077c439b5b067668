"""The solver uDEAS: its fast cost is Eq 8, and it finds postures that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from engine.datatypes import Measurement, PoseTrack, Status, Subject
from engine.errors import UnitError
from engine.kinematics.fitting._dynamic_encoding import FunctionCost, draw_codes, search
from engine.kinematics.fitting._humanoid_cost import HumanoidCost
from engine.kinematics.fitting._udeas_report import (
    ANGLES,
    WAIST_SHARE,
    WAIST_SIGMA,
    estimate_sigma,
    share_pitch,
)
from engine.kinematics.fitting._udeas_search import (
    LOWER,
    UPPER,
    SearchPlan,
    polish_clip,
    search_clip,
)
from engine.kinematics.fitting.base import select_solver
from engine.kinematics.fitting.least_squares import FitSettings
from engine.kinematics.fitting.udeas import SOLVER, UdeasSolver
from engine.kinematics.humanoid import (
    FITTED_JOINTS,
    VARIABLES,
    SegmentLengths,
    angles_from_model,
    compute_joints,
    estimate_segment_lengths,
    fit_residual,
    to_world_axes,
)
from engine.skeletons import get_skeleton
from tests.builders import make_pose_track

SUBJECT = Subject(stature_m=1.75)
LENGTHS = SegmentLengths.from_stature(1.75)
NAMES = [variable.name for variable in VARIABLES]
QUICK = UdeasSolver(plan=SearchPlan(restarts=4, n_passes=3))


def random_values(n, seed=0, share=0.6):
    """Return values in the middle `share` of the ranges, shape (n, 21)."""
    shift = share * (np.random.default_rng(seed).random((n, len(VARIABLES))) - 0.5)
    return (LOWER + UPPER) / 2 + shift * (UPPER - LOWER)


def lift_values(n_frames=12):
    """Return a bending and reaching movement with the waist's share of the pitch."""
    bend = np.linspace(0, 1, n_frames)
    values = np.zeros((n_frames, len(VARIABLES)))

    def put(name, start, end):
        values[:, NAMES.index(name)] = np.radians(start + (end - start) * bend)

    values[:, 0] = 1.0
    put("psi_bd", 20, 35)
    put("phi_bd", 2, 6)
    put("theta_bd", 4, 28)
    put("theta_ws", 6, 42)
    put("phi_ws", -3, 5)
    put("psi_ws", 2, -12)
    for side, more in (("l", 0.0), ("r", 8.0)):
        put(f"theta_hp_{side}", 10, 70 + more)
        put(f"theta_kn_{side}", 8, 80 - more)
        put(f"phi_hp_{side}", 5, 10)
        put(f"theta_sh_{side}", 20, 70 + more)
        put(f"phi_sh_{side}", 12, 20)
        put(f"psi_sh_{side}", 10, 25)
        put(f"theta_el_{side}", 35, 50 + more)
    return share_pitch(values)


def make_track(values, *, noise=0.0, sigma=0.01, lengths=LENGTHS, seed=0):
    """Make a track of MediaPipe's keypoints that shows the figure's joints, the rest missing."""
    skeleton = get_skeleton("mediapipe_33")
    position = np.full((len(values), len(skeleton.keypoints), 3), np.nan)
    joints = to_world_axes(compute_joints(values, lengths)) + np.array([0.2, 0.95, -0.1])
    joints += noise * np.random.default_rng(seed).standard_normal(joints.shape)
    for i, name in enumerate(FITTED_JOINTS):
        position[:, skeleton.index(name)] = joints[:, i]
    time_s = np.arange(len(values)) / 30
    return PoseTrack(
        time_s,
        position,
        "m",
        "world",
        "mediapipe_33",
        sigma=np.where(np.isfinite(position[..., 0]), sigma, np.nan),
    )


def without(track, frames, *keypoints):
    """Return the track with keypoints missing in some frames."""
    position = np.array(track.position)
    skeleton = get_skeleton(track.skeleton)
    for keypoint in keypoints:
        position[frames, skeleton.index(keypoint)] = np.nan
    return replace(track, position=position, status=None)


@pytest.fixture(scope="module")
def clip():
    """Values of a movement, its joints, and its joints with 10 mm of noise."""
    values = lift_values(16)
    targets = compute_joints(values, LENGTHS)
    noise = 0.01 * np.random.default_rng(0).standard_normal(targets.shape)
    return values, targets, targets + noise


@pytest.fixture(scope="module")
def exact():
    """A clip without noise, and its fit with polish."""
    values = lift_values()
    return values, select_solver("udeas+polish").fit(make_track(values), SUBJECT)


class TestCostAlongOneVariable:
    @pytest.fixture
    def problem(self):
        """Two frames with one joint missing, and 40 searches over them."""
        rng = np.random.default_rng(5)
        targets = compute_joints(random_values(2, seed=1), LENGTHS)
        targets += 0.05 * rng.standard_normal(targets.shape)
        targets[1, 4] = np.nan
        return targets, np.repeat([0, 1], 20), random_values(40, seed=2, share=1.0)

    @pytest.mark.parametrize("is_weighted", [False, True], ids=["plain", "weighted"])
    def test_equals_the_whole_cost_for_every_variable(self, problem, is_weighted):
        targets, frames, values = problem
        rng = np.random.default_rng(6)
        weights = rng.random((2, 12)) if is_weighted else None
        own = None if weights is None else weights[frames]
        cost = HumanoidCost(targets, LENGTHS, frames, weights=weights)
        cost.place(values)
        assert cost.total() == pytest.approx(
            fit_residual(values, LENGTHS, targets[frames], own), abs=1e-12
        )
        for variable in rng.permutation(len(VARIABLES)):
            rows = rng.permutation(40)[:25]
            span = UPPER[variable] - LOWER[variable]
            x = LOWER[variable] + span * rng.random((3, rows.size))
            found = cost.aim(int(variable), rows)(x, slice(None))
            for tried, along in zip(x, found, strict=True):
                moved = values.copy()
                moved[rows, variable] = tried
                whole = fit_residual(moved, LENGTHS, targets[frames], own)
                assert along == pytest.approx(whole[rows], abs=1e-9)
            cost.move(int(variable), rows, x[0])
            values[rows, variable] = x[0]
            whole = fit_residual(values, LENGTHS, targets[frames], own)
            assert cost.total() == pytest.approx(whole, abs=1e-9)

    @pytest.mark.parametrize("by_sensitivity", [False, True], ids=["natural", "sensitivity"])
    def test_a_search_ends_where_it_does_with_the_whole_cost(self, problem, by_sensitivity):
        targets, frames, _ = problem
        # A joint that is missing would leave costs that only rounding tells apart.
        targets, frames = targets[:1], frames[:12] * 0
        start = draw_codes(np.random.default_rng(0), 12, len(VARIABLES))
        options = {"last_bits": 6, "by_sensitivity": by_sensitivity}
        whole = FunctionCost(lambda p, o: fit_residual(p, LENGTHS, targets[frames[o]]))
        slow = search(whole, LOWER, UPPER, start, **options)
        fast = search(HumanoidCost(targets, LENGTHS, frames), LOWER, UPPER, start, **options)
        assert np.array_equal(fast.codes, slow.codes)
        assert fast.cost == pytest.approx(slow.cost, abs=1e-9)
        assert np.array_equal(fast.n_evaluations, slow.n_evaluations)

    def test_every_frame_may_show_another_person(self, problem):
        targets, frames, values = problem
        people = [LENGTHS, SegmentLengths.from_stature(1.5)]
        cost = HumanoidCost(targets, people, frames)
        cost.place(values)
        for i, person in enumerate(people):
            own = frames == i
            whole = fit_residual(values[own], person, targets[i])
            assert cost.total()[own] == pytest.approx(whole, abs=1e-12)

    def test_small_distances_count_by_their_square_with_huber(self, problem):
        targets, frames, values = problem
        cost = HumanoidCost(targets, LENGTHS, frames, huber_m=0.3)
        cost.place(values)
        distance = np.linalg.norm(compute_joints(values, LENGTHS) - targets[frames], axis=2)
        huber = np.where(distance < 0.3, distance**2 / 0.6, distance - 0.15)
        assert cost.total() == pytest.approx(np.nanmean(huber, axis=1), abs=1e-12)


class TestNullDirection:
    def test_sharing_the_pitch_moves_no_joint(self):
        values = random_values(200, seed=3, share=0.9)
        shared = share_pitch(values)
        assert compute_joints(shared, LENGTHS) == pytest.approx(
            compute_joints(values, LENGTHS), abs=1e-9
        )

    def test_the_waist_gets_its_share(self):
        shared = share_pitch(random_values(200, seed=4, share=0.5))
        pelvis, waist = (shared[:, NAMES.index(name)] for name in ("theta_bd", "theta_ws"))
        assert waist == pytest.approx(WAIST_SHARE * (waist + pelvis), abs=1e-4)

    def test_the_solvers_assume_the_same(self):
        settings = FitSettings()
        assert (settings.waist_share, settings.waist_sigma) == (WAIST_SHARE, WAIST_SIGMA)


class TestSearch:
    def test_noisy_joints_are_fitted_as_well_as_the_truth_fits_them(self, clip):
        values, _, noisy = clip
        found = search_clip(noisy, LENGTHS, SearchPlan())
        truth = fit_residual(values, LENGTHS, noisy)
        assert (found.residual_m < truth + 0.001).mean() >= 0.9
        assert found.residual_m == pytest.approx(fit_residual(found.values, LENGTHS, noisy))

    def test_polish_reaches_the_optimum_of_exact_joints(self, clip):
        _, targets, _ = clip
        found = search_clip(targets, LENGTHS, select_solver("udeas+polish").plan)
        assert np.median(found.residual_m) < 1e-4
        assert found.residual_m.max() < 0.005

    def test_polish_never_makes_it_worse_and_keeps_the_ranges(self, clip):
        _, _, noisy = clip
        start = random_values(len(noisy), seed=8)
        polished = polish_clip(start, noisy, LENGTHS)
        before, after = (fit_residual(v, LENGTHS, noisy) for v in (start, polished))
        assert (after <= before).all()
        bounded = [i for i, name in enumerate(NAMES) if name != "psi_bd"]
        assert (polished >= LOWER)[:, bounded].all()
        assert (polished <= UPPER)[:, bounded].all()

    def test_values_keep_to_their_ranges(self, clip):
        _, _, noisy = clip
        found = search_clip(noisy, LENGTHS, QUICK.plan).values
        bounded = [i for i, name in enumerate(NAMES) if name != "psi_bd"]
        assert (found >= LOWER)[:, bounded].all()
        assert (found <= UPPER)[:, bounded].all()

    def test_passes_in_windows_lower_the_cost(self, clip):
        _, _, noisy = clip
        once = search_clip(noisy, LENGTHS, SearchPlan(n_passes=0))
        assert (search_clip(noisy, LENGTHS, QUICK.plan).residual_m.mean()) < (
            once.residual_m.mean()
        )

    def test_both_orders_are_available(self, clip):
        _, _, noisy = clip
        few = SearchPlan(restarts=2, n_passes=1)
        plans = [replace(few, by_sensitivity=flag) for flag in (False, True)]
        first, second = (search_clip(noisy[:3], LENGTHS, plan) for plan in plans)
        assert not np.array_equal(first.values, second.values)


class TestSolver:
    def test_known_angles(self, exact):
        values, found = exact
        truth = angles_from_model(values)
        for name in ANGLES:
            error = np.abs(found.angles[name] - truth[name])
            assert np.median(error) < 1.0, name
            assert np.mean(error < 6.0) > 0.8, name

    def test_udeas_alone_comes_close(self):
        values = lift_values()
        found = SOLVER.fit(make_track(values, noise=0.005), SUBJECT)
        truth = angles_from_model(values)
        errors = {name: np.abs(found.angles[name] - truth[name]).mean() for name in ANGLES}
        assert np.mean(list(errors.values())) < 5.0
        for name in ("trunk_inclination", "knee_flexion_l", "elbow_flexion_r"):
            assert errors[name] < 4.0, name

    def test_the_body_lies_on_the_keypoints(self, exact):
        values, found = exact
        track = make_track(values)
        joints = [get_skeleton(track.skeleton).index(name) for name in FITTED_JOINTS]
        offset = np.linalg.norm(found.body.joints.position - track.position, axis=2)[:, joints]
        assert offset.mean(axis=1) == pytest.approx(np.asarray(found.body.residual_m), abs=1e-6)
        assert np.median(offset) < 0.002
        estimated = estimate_segment_lengths(track, Measurement(1.75, 0.01))
        assert found.body.segment_lengths_m["thigh"] == pytest.approx(estimated.thigh, rel=0.02)
        assert found.warnings == ()

    def test_the_same_track_gives_the_same_angles(self):
        track = make_track(lift_values(4), noise=0.01)
        first, second = (QUICK.fit(track, SUBJECT).angles.value_deg for _ in range(2))
        assert np.array_equal(first, second, equal_nan=True)

    def test_names_and_discovery(self):
        for name in ("udeas", "udeas+polish"):
            solver = select_solver(name)
            assert solver.info.name == name
            found = UdeasSolver(solver.info, QUICK.plan).fit(make_track(lift_values(3)), SUBJECT)
            assert found.angles.names == solver.info.angles

    def test_a_track_in_pixels_is_refused(self):
        with pytest.raises(UnitError, match="world frame"):
            SOLVER.fit(make_pose_track(frame_of_reference="image"), SUBJECT)

    def test_a_skeleton_of_17_joints(self):
        track = without(make_pose_track(n_frames=3, skeleton="h36m_17"), slice(None), "pelvis")
        found = QUICK.fit(track, SUBJECT)
        assert np.isfinite(found.angles["trunk_inclination"]).all()
        assert np.isfinite(found.body.joints.position[:, track_index(track, "thorax")]).all()


def track_index(track, keypoint):
    return get_skeleton(track.skeleton).index(keypoint)


class TestStandardErrors:
    def test_equal_the_spread_of_repeated_fits(self):
        """600 noisy pictures of one posture, each fitted from the truth."""
        values = np.repeat(lift_values(5)[3:4], 600, axis=0)
        exact = compute_joints(values, LENGTHS)
        rng = np.random.default_rng(0)
        noise = 0.01 * rng.standard_normal(exact.shape)
        hips = [FITTED_JOINTS.index(f"{side}_hip") for side in ("left", "right")]
        noisy = exact + noise - noise[:, hips].mean(axis=1, keepdims=True)
        found = share_pitch(polish_clip(values, noisy, LENGTHS, steps=4))
        sigma = estimate_sigma(found, LENGTHS, noisy, np.full((600, 12), 0.01))
        named = angles_from_model(found)
        for i, name in enumerate(ANGLES):
            if name.startswith(("lumbar_flexion", "pelvis_tilt", "pelvis_list", "hip_flexion")):
                continue  # their error is that of the assumed share, which is not drawn here
            ratio = np.std(named[name]) / np.median(sigma[:, i])
            assert 0.7 < ratio < 1.35, name

    def test_the_assumed_share_enters(self):
        upright, bent = lift_values()[[0, -1]][:, None]
        for values, pitch in ((upright, 10.0), (bent, 70.0)):
            joints = compute_joints(values, LENGTHS)
            sigma = estimate_sigma(values, LENGTHS, joints, np.full((1, 12), 1e-4))
            expected = np.hypot(5.0, WAIST_SIGMA * pitch)
            assert sigma[0, ANGLES.index("lumbar_flexion")] == pytest.approx(expected, rel=0.1)
            assert sigma[0, ANGLES.index("trunk_flexion")] < 0.1

    def test_larger_residuals_than_stated_widen_them(self):
        quiet = make_track(lift_values(6), noise=0.02, sigma=0.02)
        bold = replace(quiet, sigma=np.asarray(quiet.sigma) / 20)
        stated, scaled = (
            QUICK.fit(t, SUBJECT).angles.sigma("knee_flexion_l") for t in (quiet, bold)
        )
        assert scaled == pytest.approx(stated, rel=0.5)

    def test_an_unknown_error_of_a_keypoint_is_not_zero(self):
        track = replace(make_track(lift_values(3)), sigma=None)
        assert (QUICK.fit(track, SUBJECT).angles.sigma("trunk_flexion") > 0.5).all()


class TestBadInput:
    def test_a_missing_joint_hides_only_what_it_determines(self):
        track = without(make_track(lift_values(6)), slice(2, 4), "left_wrist")
        angles = QUICK.fit(track, SUBJECT).angles
        hidden = {"elbow_flexion_l", "shoulder_rotation_l"}
        for name in ANGLES:
            is_known = np.isfinite(angles[name])
            assert is_known[[0, 1, 4, 5]].all(), name
            assert is_known[2:4].all() == (name not in hidden), name
        column = ANGLES.index("elbow_flexion_l")
        assert (np.asarray(angles.status)[2:4, column] == Status.MISSING).all()

    def test_without_a_hip_there_is_nothing(self):
        track = without(make_track(lift_values(6)), slice(0, 3), "right_hip")
        found = QUICK.fit(track, SUBJECT)
        assert np.isnan(found.angles.value_deg[:3]).all()
        assert np.isfinite(found.angles["knee_flexion_l"][3:]).all()
        assert np.isnan(found.body.residual_m[:3]).all()
        assert any("both hips" in warning for warning in found.warnings)

    def test_nothing_at_all(self):
        track = make_track(lift_values(4))
        nothing = replace(track, position=np.full(track.position.shape, np.nan), status=None)
        found = QUICK.fit(nothing, SUBJECT)
        assert np.isnan(found.angles.value_deg).all()
        assert np.isnan(found.body.joints.position).all()
        assert found.warnings

    @pytest.mark.parametrize("n_frames", [1, 2])
    def test_a_frame_or_two(self, n_frames):
        found = QUICK.fit(make_track(lift_values(n_frames)), SUBJECT)
        assert np.isfinite(found.angles["trunk_inclination"]).all()

    def test_a_person_who_stands_still(self):
        found = QUICK.fit(make_track(np.repeat(lift_values(5)[2:3], 5, axis=0)), SUBJECT)
        assert np.isfinite(found.angles["knee_flexion_r"]).all()

    def test_all_joints_in_one_place(self):
        track = make_track(lift_values(4))
        collapsed = replace(track, position=np.where(np.isfinite(track.position), 1.0, np.nan))
        found = QUICK.fit(collapsed, SUBJECT)
        assert np.isnan(found.angles.value_deg).all()
        assert any("no human posture" in warning for warning in found.warnings)

    @pytest.mark.parametrize("value", [np.inf, -np.inf, 1e12])
    def test_numbers_that_are_none(self, value):
        track = make_track(lift_values(4))
        position = np.array(track.position)
        position[1, track_index(track, "left_knee")] = value
        angles = QUICK.fit(replace(track, position=position), SUBJECT).angles
        assert np.isnan(angles["knee_flexion_l"][1])
        assert np.isfinite(angles["knee_flexion_r"]).all()

    def test_rejected_keypoints_keep_their_status(self):
        track = without(make_track(lift_values(3)), slice(1, 2), "left_elbow")
        status = np.array(track.status)
        status[1, track_index(track, "left_elbow")] = Status.REJECTED
        angles = QUICK.fit(replace(track, status=status), SUBJECT).angles
        assert np.asarray(angles.status)[1, ANGLES.index("elbow_flexion_l")] == Status.REJECTED

    def test_a_wrong_stature_is_noticed(self):
        found = QUICK.fit(make_track(lift_values(6)), Subject(stature_m=1.25))
        assert any("check the stature" in warning for warning in found.warnings)

    def test_a_hidden_turn_of_a_straight_arm(self):
        values = lift_values(3)
        for side in ("l", "r"):
            values[:, NAMES.index(f"theta_el_{side}")] = np.radians(3.0)
        angles = QUICK.fit(make_track(values), SUBJECT).angles
        is_straight = angles["elbow_flexion_l"] < 15
        assert is_straight.any()
        assert np.isnan(angles["shoulder_rotation_l"][is_straight]).all()
