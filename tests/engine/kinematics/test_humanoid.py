"""The figure against an independent chain of rotation matrices, and every sign by itself."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from engine.datatypes import Measurement, PoseTrack, Status
from engine.errors import ConfigError, DataError, ShapeError
from engine.kinematics import angles as geometry
from engine.kinematics.humanoid import (
    FITTED_JOINTS,
    VARIABLES,
    SegmentLengths,
    angles_from_model,
    centre_on_pelvis,
    compute_jacobian,
    compute_joints,
    estimate_segment_lengths,
    fit_residual,
    to_model_axes,
    to_world_axes,
)
from engine.kinematics.humanoid.model import ANGLE_COUNT, ANGLE_VARIABLES, column
from engine.kinematics.humanoid.tree import POINTS, Tree
from engine.skeletons import get_skeleton
from tests.builders import make_pose_track

LENGTHS = SegmentLengths.from_stature(1.75)
NAMES = [v.name for v in VARIABLES]
LOWER = np.array([v.bounds[0] for v in VARIABLES])
UPPER = np.array([v.bounds[1] for v in VARIABLES])
FORWARD, LEFT, UP = range(3)


def values_of(**degrees: float) -> np.ndarray:
    values = np.zeros(len(VARIABLES))
    values[0] = degrees.pop("gamma", 1.0)
    for name, angle in degrees.items():
        values[NAMES.index(name)] = np.radians(angle)
    return values


def random_values(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return LOWER + (UPPER - LOWER) * rng.random((n, len(VARIABLES)))


def joint(joints: np.ndarray, name: str) -> np.ndarray:
    return joints[..., FITTED_JOINTS.index(name), :]


def turn(axis: str, angle: float) -> np.ndarray:
    return Rotation.from_euler(axis, angle).as_matrix()


def chain(values: np.ndarray, lengths: SegmentLengths) -> dict[str, np.ndarray]:
    """Return the joints by products of rotation matrices, as the methods describe the figure."""
    v = dict(zip(NAMES, values, strict=True))
    body = turn("z", v["psi_bd"]) @ turn("y", v["theta_bd"]) @ turn("x", v["phi_bd"])
    trunk = body @ turn("y", v["theta_ws"]) @ turn("x", v["phi_ws"]) @ turn("z", v["psi_ws"])
    joints = {}
    for name, s, side in (("left", "l", 1.0), ("right", "r", -1.0)):
        hip = body @ [0, side * lengths.pelvis_half_width, 0]
        thigh = body @ turn("y", -v[f"theta_hp_{s}"]) @ turn("x", side * v[f"phi_hp_{s}"])
        knee = hip + thigh @ [0, 0, -lengths.thigh]
        shank = thigh @ turn("y", v[f"theta_kn_{s}"])
        shoulder = trunk @ [0, side * lengths.shoulder_half_width, lengths.trunk]
        arm = (
            trunk
            @ turn("y", -v[f"theta_sh_{s}"])
            @ turn("x", side * v[f"phi_sh_{s}"])
            @ turn("z", -side * v[f"psi_sh_{s}"])
        )
        elbow = shoulder + arm @ [0, 0, -lengths.upper_arm]
        forearm = arm @ turn("y", -v[f"theta_el_{s}"])
        joints |= {
            f"{name}_hip": hip,
            f"{name}_knee": knee,
            f"{name}_ankle": knee + shank @ [0, 0, -lengths.shank],
            f"{name}_shoulder": shoulder,
            f"{name}_elbow": elbow,
            f"{name}_wrist": elbow + forearm @ [0, 0, -lengths.forearm],
        }
    return {name: v["gamma"] * point for name, point in joints.items()}


# ----------------------------------------------------------------------------- variables


def test_the_variables_are_the_21_of_the_paper_in_groups():
    assert len(VARIABLES) == 21
    groups = [v.group for v in VARIABLES]
    count = {g: groups.count(g) for g in groups}
    assert count == {
        "size": 1,
        "body": 3,
        "torso": 3,
        "sagittal": 8,
        "coronal": 4,
        "transversal": 2,
    }
    # 17 of 26 degrees of freedom, three of the whole body and the size factor.
    assert ANGLE_COUNT == 26 + 3


@pytest.mark.parametrize("variable", ANGLE_VARIABLES, ids=lambda v: v.name)
def test_every_range_holds_the_neutral_pose_and_mirrors_left_to_right(variable):
    assert variable.lower <= 0.0 <= variable.upper
    if variable.name.endswith("_l"):
        twin = next(v for v in ANGLE_VARIABLES if v.name == f"{variable.name[:-2]}_r")
        assert (twin.lower, twin.upper, twin.group) == (
            variable.lower,
            variable.upper,
            variable.group,
        )


# ----------------------------------------------------------------------------- positions


def test_the_neutral_figure_stands_upright():
    joints = compute_joints(values_of(), LENGTHS)
    leg = LENGTHS.thigh + LENGTHS.shank
    arm = LENGTHS.upper_arm + LENGTHS.forearm
    np.testing.assert_allclose(
        joint(joints, "left_ankle"), [0, LENGTHS.pelvis_half_width, -leg], atol=1e-12
    )
    np.testing.assert_allclose(
        joint(joints, "right_wrist"),
        [0, -LENGTHS.shoulder_half_width, LENGTHS.trunk - arm],
        atol=1e-12,
    )


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.0, 1.0), min_size=21, max_size=21))
def test_positions_equal_a_product_of_rotation_matrices(share):
    values = LOWER + (UPPER - LOWER) * np.array(share)
    expected = chain(values, LENGTHS)
    joints = compute_joints(values, LENGTHS)
    for name in FITTED_JOINTS:
        np.testing.assert_allclose(joint(joints, name), expected[name], atol=1e-12)


@pytest.mark.parametrize(
    ("variable", "moved", "axis", "sign"),
    [
        ("theta_bd", "left_shoulder", FORWARD, 1),
        ("phi_bd", "left_shoulder", LEFT, -1),
        ("psi_bd", "right_shoulder", FORWARD, 1),
        ("theta_ws", "left_shoulder", FORWARD, 1),
        ("phi_ws", "left_shoulder", LEFT, -1),
        ("psi_ws", "right_shoulder", FORWARD, 1),
        ("theta_hp_l", "left_knee", FORWARD, 1),
        ("theta_hp_r", "right_knee", FORWARD, 1),
        ("phi_hp_l", "left_knee", LEFT, 1),
        ("phi_hp_r", "right_knee", LEFT, -1),
        ("theta_kn_l", "left_ankle", FORWARD, -1),
        ("theta_kn_r", "right_ankle", FORWARD, -1),
        ("theta_sh_l", "left_elbow", FORWARD, 1),
        ("theta_sh_r", "right_elbow", FORWARD, 1),
        ("phi_sh_l", "left_elbow", LEFT, 1),
        ("phi_sh_r", "right_elbow", LEFT, -1),
        ("theta_el_l", "left_wrist", FORWARD, 1),
        ("theta_el_r", "right_wrist", FORWARD, 1),
    ],
)
def test_each_angle_alone_moves_its_joint_the_expected_way(variable, moved, axis, sign):
    before = joint(compute_joints(values_of(), LENGTHS), moved)
    after = joint(compute_joints(values_of(**{variable: 20.0}), LENGTHS), moved)
    assert sign * (after - before)[axis] > 0.02


@pytest.mark.parametrize(("side", "sign"), [("l", -1), ("r", 1)])
def test_turning_an_arm_inwards_brings_the_bent_forearm_to_the_middle(side, sign):
    name = {"l": "left_wrist", "r": "right_wrist"}[side]
    bent = {f"theta_el_{side}": 90.0}
    before = joint(compute_joints(values_of(**bent), LENGTHS), name)
    after = joint(compute_joints(values_of(**bent, **{f"psi_sh_{side}": 20.0}), LENGTHS), name)
    assert sign * (after - before)[LEFT] > 0.02


@pytest.mark.parametrize(
    ("variable", "point", "axis", "sign"),
    [
        ("theta_an_l", "left_big_toe", UP, 1),
        ("theta_an_r", "right_big_toe", UP, 1),
        ("psi_an_l", "left_big_toe", LEFT, -1),
        ("psi_an_r", "right_big_toe", LEFT, 1),
        ("psi_hp_l", "left_big_toe", LEFT, -1),
        ("psi_hp_r", "right_big_toe", LEFT, 1),
        ("theta_nk", "nose", UP, -1),
        ("phi_nk", "nose", LEFT, -1),
        ("psi_nk", "nose", LEFT, 1),
        ("theta_ws", "spine", FORWARD, 1),
    ],
)
def test_each_further_angle_moves_its_point_the_expected_way(variable, point, axis, sign):
    tree = Tree((point,))
    angles = np.zeros((ANGLE_COUNT, 2))
    angles[column(variable), 1] = np.radians(20.0)
    points = tree.place(angles, LENGTHS.as_dict()).points
    assert sign * (points[0, axis, 1] - points[0, axis, 0]) > 0.005


def test_lengths_are_kept_in_every_posture():
    joints = compute_joints(random_values(200), LENGTHS) / random_values(200)[:, :1, None]
    for side in ("left", "right"):
        for a, b, name in (
            ("hip", "knee", "thigh"),
            ("knee", "ankle", "shank"),
            ("shoulder", "elbow", "upper_arm"),
            ("elbow", "wrist", "forearm"),
        ):
            length = np.linalg.norm(
                joint(joints, f"{side}_{a}") - joint(joints, f"{side}_{b}"), axis=-1
            )
            np.testing.assert_allclose(length, getattr(LENGTHS, name), rtol=1e-12)


def test_the_size_factor_scales_everything():
    small, large = (compute_joints(values_of(theta_bd=30, gamma=g), LENGTHS) for g in (0.8, 1.2))
    np.testing.assert_allclose(large, 1.5 * small)


def test_many_candidates_in_half_precision_agree():
    values = random_values(500)
    exact = compute_joints(values, LENGTHS)
    quick = compute_joints(values.astype(np.float32), LENGTHS)
    assert quick.dtype == np.float32
    np.testing.assert_allclose(quick, exact, atol=2e-6)


def test_leading_dimensions_are_kept():
    values = random_values(6).reshape(2, 3, 21)
    assert compute_joints(values, LENGTHS).shape == (2, 3, 12, 3)
    np.testing.assert_array_equal(
        compute_joints(values, LENGTHS)[1, 2], compute_joints(values[1, 2], LENGTHS)
    )
    assert compute_jacobian(values, LENGTHS).shape == (2, 3, 36, 21)


@pytest.mark.parametrize("call", [compute_joints, compute_jacobian])
def test_a_wrong_number_of_values_is_refused(call):
    with pytest.raises(ShapeError, match="21"):
        call(np.zeros(20), LENGTHS)


# ----------------------------------------------------------------------------- derivatives


def test_derivatives_equal_differences():
    values = random_values(40, seed=3)
    exact = compute_jacobian(values, LENGTHS)
    step = 1e-6
    for k in range(21):
        shift = step * np.eye(21)[k]
        change = compute_joints(values + shift, LENGTHS) - compute_joints(values - shift, LENGTHS)
        np.testing.assert_allclose(
            exact[:, :, k], change.reshape(40, 36) / (2 * step), atol=1e-8, err_msg=NAMES[k]
        )


def test_derivatives_of_every_point_equal_differences():
    tree = Tree(tuple(POINTS))
    rng = np.random.default_rng(1)
    angles = rng.uniform(-1.0, 1.0, (ANGLE_COUNT, 20))
    lengths = LENGTHS.as_dict()
    posture = tree.place(angles, lengths)
    exact = tree.differentiate(posture)
    step = 1e-6
    for k in range(ANGLE_COUNT):
        shift = step * np.eye(ANGLE_COUNT)[k][:, None]
        change = (
            tree.place(angles + shift, lengths).points - tree.place(angles - shift, lengths).points
        )
        np.testing.assert_allclose(exact[:, :, k], change / (2 * step), atol=1e-8)
    names = tuple(lengths)
    by_length = tree.differentiate_lengths(posture, names)
    for i, name in enumerate(names):
        change = tree.place(angles, lengths | {name: lengths[name] + 0.01}).points - posture.points
        np.testing.assert_allclose(by_length[:, :, i], change / 0.01, atol=1e-10, err_msg=name)


def test_pelvis_waist_and_hips_have_an_exact_null_direction():
    """Pitching pelvis against waist and hips leaves every joint where it is."""
    upright = values_of(theta_bd=20, theta_ws=15, theta_hp_l=30, theta_hp_r=10, theta_kn_l=40)
    tilted = upright + (
        values_of(theta_bd=-7, theta_ws=7, theta_hp_l=-7, theta_hp_r=-7) - values_of()
    )
    np.testing.assert_allclose(
        compute_joints(upright, LENGTHS), compute_joints(tilted, LENGTHS), atol=1e-12
    )
    angles_only = compute_jacobian(upright, LENGTHS)[:, 1:]
    assert np.linalg.svd(angles_only, compute_uv=False)[-1] < 1e-12


def test_a_point_the_figure_has_not_is_refused():
    with pytest.raises(ConfigError, match="left_thumb"):
        Tree(("left_thumb",))


# ----------------------------------------------------------------------------- joint angles


def test_angles_equal_the_definitions_of_the_convention_table():
    values = random_values(300, seed=5)
    named = angles_from_model(values)
    world = to_world_axes(compute_joints(values, LENGTHS))
    points = {name: joint(world, name) for name in FITTED_JOINTS}
    trunk = geometry.compute_trunk_angles(
        *(points[n] for n in ("left_shoulder", "right_shoulder", "left_hip", "right_hip"))
    )
    for name, expected in trunk._asdict().items():
        np.testing.assert_allclose(named[f"trunk_{name}"], expected, atol=1e-6, err_msg=name)
    for s, side in (("l", "left"), ("r", "right")):
        flexion, adduction = geometry.compute_shoulder_angles(
            points[f"{side}_shoulder"],
            points[f"{side}_elbow"],
            left_shoulder=points["left_shoulder"],
            right_shoulder=points["right_shoulder"],
            mid_hip=np.zeros((300, 3)),
            side=side,
        )
        known = np.isfinite(flexion)
        assert known.mean() > 0.9
        np.testing.assert_allclose(named[f"shoulder_flexion_{s}"][known], flexion[known], atol=1e-6)
        np.testing.assert_allclose(named[f"shoulder_adduction_{s}"], adduction, atol=1e-6)
        for part, chain_of in (("knee", "hip knee ankle"), ("elbow", "shoulder elbow wrist")):
            hinge = geometry.compute_hinge_flexion(
                *(points[f"{side}_{name}"] for name in chain_of.split())
            )
            np.testing.assert_allclose(named[f"{part}_flexion_{s}"], hinge, atol=1e-5)


def test_pelvis_angles_are_those_of_the_sequence_z_x_y():
    values = random_values(50, seed=7)
    v = {name: values[:, i] for i, name in enumerate(NAMES)}
    named = angles_from_model(values)
    for i in range(50):
        body = turn("z", v["psi_bd"][i]) @ turn("y", v["theta_bd"][i]) @ turn("x", v["phi_bd"][i])
        # Rows: the world's X, Y, Z as (forward, up, right) of the figure.
        to_world = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        expected = Rotation.from_matrix(to_world @ body @ to_world.T).as_euler("ZXY", degrees=True)
        found = [named[f"pelvis_{n}"][i] for n in ("tilt", "list", "rotation")]
        np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("angle", "values", "expected"),
    [
        ("trunk_flexion", {"theta_bd": 20, "theta_ws": 30}, 50),
        ("trunk_lateral_bend", {"phi_ws": 10}, 10),
        ("trunk_twist", {"psi_ws": 15}, 15),
        ("lumbar_flexion", {"theta_ws": 30}, 30),
        ("lumbar_bending", {"phi_ws": 10}, 10),
        ("lumbar_rotation", {"psi_ws": 15}, 15),
        ("pelvis_tilt", {"theta_bd": 20}, -20),
        ("pelvis_list", {"phi_bd": 10}, 10),
        ("pelvis_rotation", {"psi_bd": 40}, 40),
        ("hip_flexion_l", {"theta_hp_l": 50}, 50),
        ("hip_adduction_r", {"phi_hp_r": 12}, -12),
        ("shoulder_flexion_r", {"theta_sh_r": 60}, 60),
        ("shoulder_adduction_l", {"phi_sh_l": 25}, -25),
        ("shoulder_rotation_l", {"psi_sh_l": 25}, 25),
        ("shoulder_adduction_l", {"phi_sh_l": 140}, -40),
        ("shoulder_flexion_l", {"phi_sh_l": 140}, 180),
        ("elbow_flexion_r", {"theta_el_r": 70}, 70),
        ("knee_flexion_l", {"theta_kn_l": 80}, 80),
    ],
)
def test_one_variable_alone_reads_as_its_angle(angle, values, expected):
    assert angles_from_model(values_of(**values))[angle] == pytest.approx(expected, abs=1e-9)


# ----------------------------------------------------------------------------- cost


def test_the_cost_is_zero_at_the_truth_and_the_shift_elsewhere():
    values = random_values(30)
    targets = compute_joints(values, LENGTHS)
    np.testing.assert_allclose(fit_residual(values, LENGTHS, targets), 0.0, atol=1e-12)
    shifted = targets + np.array([0.03, 0.0, 0.04])
    np.testing.assert_allclose(fit_residual(values, LENGTHS, shifted), 0.05, atol=1e-12)


def test_the_cost_counts_seen_joints_by_their_weight():
    targets = compute_joints(values_of(), LENGTHS).copy()
    targets[0, 0] += 0.12
    assert fit_residual(values_of(), LENGTHS, targets) == pytest.approx(0.01)
    weights = np.ones(12)
    weights[0] = 0.0
    assert fit_residual(values_of(), LENGTHS, targets, weights) == pytest.approx(0.0, abs=1e-12)
    targets[0] = np.nan
    assert fit_residual(values_of(), LENGTHS, targets) == pytest.approx(0.0, abs=1e-12)
    targets[:] = np.nan
    assert np.isnan(fit_residual(values_of(), LENGTHS, targets))


def test_one_target_serves_many_candidates():
    values = random_values(7)
    target = compute_joints(values[3], LENGTHS)
    cost = fit_residual(values, LENGTHS, target)
    assert cost.shape == (7,)
    assert cost.argmin() == 3
    with pytest.raises(ShapeError, match="12, 3"):
        fit_residual(values, LENGTHS, target[:11])


# ----------------------------------------------------------------------------- tracks, lengths


def track_of(values: np.ndarray, lengths: SegmentLengths, skeleton: str = "h36m_17") -> PoseTrack:
    keypoints = get_skeleton(skeleton).keypoints
    position = np.full((len(values), len(keypoints), 3), np.nan)
    world = to_world_axes(compute_joints(values, lengths)) + np.array([0.3, 0.9, -0.2])
    for i, name in enumerate(FITTED_JOINTS):
        position[:, keypoints.index(name)] = world[:, i]
    return PoseTrack(np.arange(len(values)) / 30, position, "m", "world", skeleton)


def test_axes_go_there_and_back():
    points = np.random.default_rng(0).normal(size=(4, 5, 3))
    np.testing.assert_array_equal(to_world_axes(to_model_axes(points)), points)
    np.testing.assert_array_equal(to_model_axes([1.0, 2.0, 3.0]), [1.0, -3.0, 2.0])
    with pytest.raises(ShapeError, match=r"\(\.\.\., 3\)"):
        to_model_axes([1.0, 2.0])


@pytest.mark.parametrize("skeleton", ["h36m_17", "mediapipe_33"])
def test_a_track_is_brought_to_the_figure(skeleton):
    values = random_values(8)
    values[:, 0] = 1.0
    np.testing.assert_allclose(
        centre_on_pelvis(track_of(values, LENGTHS, skeleton)),
        compute_joints(values, LENGTHS),
        atol=1e-12,
    )


def test_lengths_seen_in_a_clip_are_found():
    person = SegmentLengths(**{**LENGTHS.as_dict(), "thigh": 0.46, "trunk": 0.47, "forearm": 0.24})
    values = random_values(40)
    values[:, 0] = 1.0
    found = estimate_segment_lengths(track_of(values, person), Measurement(1.75, 0.01))
    for name in ("thigh", "shank", "trunk", "upper_arm", "forearm", "pelvis_half_width"):
        assert getattr(found, name) == pytest.approx(getattr(person, name), rel=0.03)
    assert found.neck == LENGTHS.neck  # nothing to see it by


def test_noisy_lengths_lean_towards_the_typical_ones():
    person = SegmentLengths(**{**LENGTHS.as_dict(), "forearm": 0.30})
    values = random_values(60)
    values[:, 0] = 1.0
    clean = track_of(values, person)
    rng = np.random.default_rng(0)
    noisy = PoseTrack(
        clean.time_s,
        clean.position + 0.05 * rng.normal(size=clean.position.shape),
        "m",
        "world",
        "h36m_17",
    )
    stature = Measurement(1.75, 0.01)
    exact, rough = (estimate_segment_lengths(t, stature).forearm for t in (clean, noisy))
    assert exact == pytest.approx(0.30, abs=0.006)
    assert LENGTHS.forearm < rough < 0.30


def test_rejected_samples_do_not_count_for_lengths():
    values = random_values(40)
    values[:, 0] = 1.0
    track = track_of(values, LENGTHS)
    position, status = np.array(track.position), np.array(track.status)
    wrist = get_skeleton("h36m_17").index("left_wrist")
    position[:25, wrist] += 1.0
    status[:25, wrist] = Status.REJECTED
    spoilt = PoseTrack(track.time_s, position, "m", "world", "h36m_17", status=status)
    found = estimate_segment_lengths(spoilt, Measurement(1.75, 0.01))
    assert found.forearm == pytest.approx(LENGTHS.forearm, rel=1e-6)


def test_without_a_picture_of_the_person_lengths_are_typical():
    track = track_of(np.full((10, 21), np.nan), LENGTHS)
    found = estimate_segment_lengths(track, Measurement(1.6, 0.01))
    assert found == SegmentLengths.from_stature(1.6)


def test_head_and_feet_are_seen_where_there_are_keypoints():
    track = make_pose_track(n_frames=20)
    found = estimate_segment_lengths(track, Measurement(1.75, 0.01))
    # The builder's foot: heel 5 cm behind, toe 18 cm ahead, both 6 cm below the ankle.
    assert found.heel_back == pytest.approx(0.05, abs=0.002)
    assert found.toe_forward == pytest.approx(0.18, abs=0.002)
    assert found.heel_down == pytest.approx(0.06, abs=0.002)
    assert found.nose_forward == pytest.approx(0.11, abs=0.002)


@pytest.mark.parametrize("bad", [0.0, -0.2, np.nan])
def test_an_impossible_length_is_refused(bad):
    with pytest.raises(DataError, match="thigh"):
        SegmentLengths(**{**LENGTHS.as_dict(), "thigh": bad})
