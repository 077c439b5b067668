"""The whole-clip fit: exact on exact data, honest on noise, calm on bad input."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from engine.datatypes import JointAngles, KinematicFit, PoseTrack, Status, Subject
from engine.errors import UnitError
from engine.kinematics import angles as geometry
from engine.kinematics.fitting.base import list_solvers, select_solver
from engine.kinematics.fitting.least_squares import SOLVER, FitSettings, choose_points, fit_track
from engine.kinematics.humanoid import SegmentLengths, to_world_axes
from engine.kinematics.humanoid.model import ANGLE_COUNT, column
from engine.kinematics.humanoid.tree import Tree
from engine.skeletons import get_skeleton
from tests.builders import make_pose_track

SUBJECT = Subject(stature_m=1.75)
LENGTHS = SegmentLengths.from_stature(1.75)
FPS = 30.0


def make_pose(n_frames: int = 60, fps: float = FPS) -> np.ndarray:
    """Make a stoop with bent knees and elbows and some turn of everything; full pose vectors."""
    time_s = np.arange(n_frames) / fps
    bend = 0.5 * (1 - np.cos(2 * np.pi * time_s / 2.0))
    degrees = {
        "theta_bd": 32 * bend,
        "phi_bd": 4 * np.sin(2 * time_s),
        "psi_bd": 10 * time_s,
        "theta_ws": 48 * bend,
        "phi_ws": 8 * bend,
        "psi_ws": 12 * bend,
    }
    for s, sign in (("l", 1.0), ("r", -1.0)):
        degrees |= {
            f"theta_hp_{s}": 10 + (40 + 4 * sign) * bend,
            f"phi_hp_{s}": 6 + 2 * sign * bend,
            f"psi_hp_{s}": -5.0 + 4 * bend,
            f"theta_kn_{s}": 15 + 45 * bend,
            f"theta_an_{s}": 10 * bend,
            f"psi_an_{s}": -8.0 + 0 * bend,
            f"theta_sh_{s}": 20 + 60 * bend,
            f"phi_sh_{s}": 15 + 5 * sign * bend,
            f"psi_sh_{s}": 15 + 10 * bend,
            f"theta_el_{s}": 30 + 40 * bend,
        }
    degrees["theta_nk"] = 10 * bend
    angles = np.zeros((ANGLE_COUNT, n_frames))
    for name, values in degrees.items():
        angles[column(name)] = np.radians(values)
    return angles


def make_track(
    angles: np.ndarray | None = None,
    *,
    fps: float = FPS,
    noise_m: float = 0.0,
    sigma_m: float | None = 0.01,
    skeleton: str = "mediapipe_33",
    lengths: SegmentLengths = LENGTHS,
    seed: int = 0,
    time_s: np.ndarray | None = None,
) -> PoseTrack:
    """Make the track of the figure itself, its keypoints exact but for the noise."""
    angles = make_pose(fps=fps) if angles is None else angles
    time_s = np.arange(angles.shape[1]) / fps if time_s is None else time_s
    names = choose_points(skeleton)
    points = Tree(names).place(angles, lengths.as_dict()).points
    world = to_world_axes(np.moveaxis(points, 2, 0)) + np.array([0.1, 0.95, -0.3])
    world[..., 0] += 0.05 * np.sin(time_s)[:, None]
    keypoints = get_skeleton(skeleton).keypoints
    position = np.full((angles.shape[1], len(keypoints), 3), np.nan)
    for i, name in enumerate(names):
        position[:, keypoints.index(name)] = world[:, i]
    position += noise_m * np.random.default_rng(seed).normal(size=position.shape)
    sigma = None if sigma_m is None else np.full(position.shape[:2], sigma_m)
    return PoseTrack(time_s, position, "m", "world", skeleton, sigma=sigma)


def change(track: PoseTrack, keypoint: str, frames: slice, value: object) -> PoseTrack:
    position = np.array(track.position)
    position[frames, get_skeleton(track.skeleton).index(keypoint)] = value
    return dataclasses.replace(track, position=position, status=None)


def degrees(angles: np.ndarray, name: str, sign: float = 1.0) -> np.ndarray:
    return sign * np.degrees(angles[column(name)])


DIRECT = [
    (f"{name}_{s}", f"{variable}_{s}", sign)
    for s in ("l", "r")
    for name, variable, sign in (
        ("hip_flexion", "theta_hp", 1.0),
        ("hip_adduction", "phi_hp", -1.0),
        ("hip_rotation", "psi_hp", 1.0),
        ("knee_flexion", "theta_kn", 1.0),
        ("ankle_dorsiflexion", "theta_an", 1.0),
        ("shoulder_flexion", "theta_sh", 1.0),
        ("shoulder_adduction", "phi_sh", -1.0),
        ("shoulder_rotation", "psi_sh", 1.0),
        ("elbow_flexion", "theta_el", 1.0),
    )
] + [
    ("lumbar_flexion", "theta_ws", 1.0),
    ("lumbar_bending", "phi_ws", 1.0),
    ("lumbar_rotation", "psi_ws", 1.0),
]


# ----------------------------------------------------------------------------- truth


@pytest.fixture(scope="module")
def exact() -> KinematicFit:
    # The stated error is small, so that only the assumptions about the waist remain.
    return SOLVER.fit(make_track(sigma_m=0.001), SUBJECT)


@pytest.mark.parametrize(("angle", "variable", "sign"), DIRECT, ids=str)
def test_the_angles_of_a_figure_are_found_again(exact, angle, variable, sign):
    expected = degrees(make_pose(), variable, sign)
    # The pose shares the trunk's pitch 0.6 to 0.4, as is assumed; rotations have a prior.
    loose = any(part in angle for part in ("rotation", "dorsiflexion"))
    np.testing.assert_allclose(exact.angles[angle], expected, atol=2.5 if loose else 1.0)


def test_trunk_angles_are_those_of_the_convention_table(exact):
    track = make_track()
    columns = [
        track.position[:, get_skeleton("mediapipe_33").index(name)]
        for name in ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
    ]
    expected = geometry.compute_trunk_angles(*columns)
    for name, curve in expected._asdict().items():
        np.testing.assert_allclose(exact.angles[f"trunk_{name}"], curve, atol=0.4, err_msg=name)


def test_the_body_model_lies_on_the_keypoints(exact):
    track = make_track()
    assert exact.body is not None
    assert np.all(exact.body.residual_m < 0.003)
    both = exact.body.joints.is_present & track.is_present
    assert both.sum() > 12 * track.n_frames
    gap = np.linalg.norm(exact.body.joints.position - track.position, axis=2)[both]
    assert gap.max() < 0.012
    assert exact.body.joints.frame_of_reference == "world"
    for name in ("thigh", "shank", "trunk", "upper_arm", "forearm"):
        assert exact.body.segment_lengths_m[name] == pytest.approx(
            getattr(LENGTHS, name), rel=0.015
        )
    assert exact.warnings == ()


def test_every_angle_keeps_its_promise_about_names_and_range(exact):
    assert exact.angles.names == SOLVER.info.angles
    assert set(SOLVER.info.angles) <= set(geometry.ANGLE_NAMES)
    marked = {name for row in geometry.ANGLES if row.is_fitted for name in row.names}
    assert set(SOLVER.info.angles) == marked
    known = np.isfinite(exact.angles.value_deg)
    assert np.array_equal(known, np.isfinite(exact.angles.sigma_deg))
    assert np.all(exact.angles.sigma_deg[known] > 0)


def test_the_solver_is_found_by_its_name():
    assert select_solver("least-squares") is SOLVER
    assert SOLVER in list_solvers()


def test_the_share_of_the_waist_is_an_assumption_with_an_error(exact):
    """Pelvis and lumbar spine can't be told apart; the trunk as a whole can."""
    i = int(np.argmax(exact.angles["trunk_flexion"]))
    assert exact.angles.sigma("lumbar_flexion")[i] > 8.0
    assert exact.angles.sigma("pelvis_tilt")[i] > 8.0
    assert exact.angles.sigma("hip_flexion_l")[i] > 8.0
    assert exact.angles.sigma("trunk_flexion")[i] < 2.0
    # Moving the assumption moves the lumbar spine against pelvis and hips, and nothing else.
    other = fit_track(make_track(sigma_m=0.001), SUBJECT.stature, FitSettings(waist_share=0.4))
    assert other is not None
    pose = other.clip.problem.spread(other.clip.state)
    trunk = np.degrees(pose[column("theta_bd"), i] + pose[column("theta_ws"), i])
    assert np.degrees(pose[column("theta_ws"), i]) == pytest.approx(0.4 * trunk, abs=2.0)
    knee = np.degrees(pose[column("theta_kn_l"), i])
    assert knee == pytest.approx(exact.angles["knee_flexion_l"][i], abs=0.3)


def test_a_longer_body_is_found_and_the_stature_doubted():
    tall = SegmentLengths(**{k: 1.25 * v for k, v in LENGTHS.as_dict().items()})
    fit = SOLVER.fit(make_track(lengths=tall), SUBJECT)
    assert fit.body is not None
    assert fit.body.segment_lengths_m["thigh"] == pytest.approx(tall.thigh, rel=0.03)
    assert any("stature" in warning for warning in fit.warnings)
    expected = degrees(make_pose(), "theta_kn_l")
    np.testing.assert_allclose(fit.angles["knee_flexion_l"], expected, atol=2.0)


@pytest.mark.parametrize("heading", [0.0, 80.0, 170.0, -120.0])
def test_heading_changes_only_the_angles_of_the_heading(exact, heading):
    angles = make_pose()
    angles[column("psi_bd")] += np.radians(heading)
    turned = SOLVER.fit(make_track(angles, sigma_m=0.001), SUBJECT).angles
    for name in ("trunk_flexion", "knee_flexion_l", "elbow_flexion_r", "hip_adduction_l"):
        np.testing.assert_allclose(turned[name], exact.angles[name], atol=0.6, err_msg=name)


def test_an_arm_through_straight_out_to_the_side_stays_smooth():
    """Flexion and rotation have no meaning there; elbow and adduction do."""
    angles = make_pose(60)
    angles[column("phi_sh_l")] = np.radians(np.linspace(20.0, 140.0, 60))
    fit = SOLVER.fit(make_track(angles, sigma_m=0.003), SUBJECT).angles
    np.testing.assert_allclose(fit["elbow_flexion_l"], degrees(angles, "theta_el_l"), atol=1.5)
    out = np.degrees(angles[column("phi_sh_l")])
    np.testing.assert_allclose(
        fit["shoulder_adduction_l"], np.where(out > 90, out - 180, -out), atol=2.0
    )
    sideways = np.abs(out - 90.0) < 3.0
    assert np.isnan(fit["shoulder_flexion_l"][sideways]).all()
    assert np.isfinite(fit["shoulder_flexion_l"][np.abs(out - 90.0) > 15.0]).all()


def test_mirroring_the_person_swaps_sides():
    track = make_track(sigma_m=0.005)
    skeleton = get_skeleton(track.skeleton)
    mirrored = dataclasses.replace(
        track,
        position=(np.array(track.position) * [1.0, 1.0, -1.0])[:, list(skeleton.mirror_order)],
    )
    a, b = SOLVER.fit(track, SUBJECT).angles, SOLVER.fit(mirrored, SUBJECT).angles
    for name in ("knee_flexion", "hip_flexion", "hip_adduction", "elbow_flexion"):
        np.testing.assert_allclose(a[f"{name}_l"], b[f"{name}_r"], atol=0.05, err_msg=name)
    np.testing.assert_allclose(a["trunk_lateral_bend"], -b["trunk_lateral_bend"], atol=0.05)
    np.testing.assert_allclose(a["lumbar_rotation"], -b["lumbar_rotation"], atol=0.05)


def test_uneven_frame_times_do_no_harm():
    rng = np.random.default_rng(4)
    keep = np.sort(rng.permutation(np.arange(120))[:70])
    angles = make_pose(120, fps=60.0)[:, keep]
    track = make_track(angles, sigma_m=0.003, time_s=keep / 60.0)
    fit = SOLVER.fit(track, SUBJECT).angles
    np.testing.assert_allclose(fit["knee_flexion_l"], degrees(angles, "theta_kn_l"), atol=1.0)


# ----------------------------------------------------------------------------- noise


def test_noise_is_lower_than_of_single_frames_and_its_size_is_known():
    angles = make_pose(90)
    track = make_track(angles, noise_m=0.02, sigma_m=0.02, seed=3)
    whole = SOLVER.fit(track, SUBJECT).angles
    single = fit_track(track, SUBJECT.stature, FitSettings(is_smooth=False))
    assert single is not None
    pose = single.clip.problem.spread(single.clip.state)
    inside = []
    for angle, variable, sign in DIRECT:
        expected = degrees(angles, variable, sign)
        error = np.abs(whole[angle] - expected)
        inside.append(error[np.isfinite(error)] < 1.96 * whole.sigma(angle)[np.isfinite(error)])
        if "knee" in angle:
            alone = np.abs(degrees(pose, variable, sign) - expected)
            assert error.mean() < 0.75 * alone.mean()
    assert 0.90 < np.concatenate(inside).mean() <= 1.0


def test_slow_errors_are_not_averaged_away():
    """Noise that stays alike for many frames must not shrink the standard error."""
    rng = np.random.default_rng(1)
    track = make_track(make_pose(90), sigma_m=0.02)
    noise = np.zeros(track.position.shape)
    noise[0] = rng.normal(size=noise.shape[1:])
    for i in range(1, len(noise)):
        noise[i] = 0.97 * noise[i - 1] + np.sqrt(1 - 0.97**2) * rng.normal(size=noise.shape[1:])
    slow = dataclasses.replace(track, position=track.position + 0.02 * noise)
    quick = make_track(make_pose(90), noise_m=0.02, sigma_m=0.02)
    sigma = [
        np.nanmedian(SOLVER.fit(t, SUBJECT).angles.sigma("knee_flexion_l")) for t in (slow, quick)
    ]
    assert sigma[0] > 1.3 * sigma[1]


def test_an_outlier_counts_little():
    track = change(make_track(sigma_m=0.01), "left_ankle", slice(30, 33), [1.0, 1.0, 1.0])
    fit = SOLVER.fit(track, SUBJECT).angles
    expected = degrees(make_pose(), "theta_kn_l")
    np.testing.assert_allclose(fit["knee_flexion_l"], expected, atol=6.0)
    np.testing.assert_allclose(fit["elbow_flexion_l"], degrees(make_pose(), "theta_el_l"), atol=2.0)


def test_a_few_frames_seen_back_to_front_do_not_turn_the_person():
    track = make_track(sigma_m=0.01)
    position = np.array(track.position)
    order = list(get_skeleton(track.skeleton).mirror_order)
    position[20:23] = position[20:23][:, order]
    position[40:50] = position[40:50][:, order]
    result = SOLVER.fit(dataclasses.replace(track, position=position), SUBJECT)
    fit, expected = result.angles, degrees(make_pose(), "psi_bd")
    seen = np.r_[0:40, 50:60]  # the short exchange is bridged, the long one left out
    np.testing.assert_allclose(fit["pelvis_rotation"][seen], expected[seen], atol=2.0)
    assert np.all(fit.status[20:23, fit.names.index("pelvis_rotation")] == Status.FILLED)
    assert np.isnan(fit["pelvis_rotation"][40:50]).all()
    assert any("exchanged in 13 pictures" in warning for warning in result.warnings)


def test_turning_round_is_not_taken_for_an_exchange():
    angles = make_pose(90)
    angles[column("psi_bd")] += np.radians(np.clip(np.arange(90) - 30, 0, 30) * 6.0)
    result = SOLVER.fit(make_track(angles, sigma_m=0.01), SUBJECT)
    assert result.warnings == ()
    turn = np.degrees(np.unwrap(np.radians(result.angles["pelvis_rotation"])))
    assert turn[-1] - turn[0] > 170.0


def test_less_certain_keypoints_give_less_certain_angles():
    close, far = (
        SOLVER.fit(make_track(sigma_m=sigma), SUBJECT).angles.sigma("knee_flexion_l").mean()
        for sigma in (0.01, 0.04)
    )
    assert far > 2.0 * close


# ----------------------------------------------------------------------------- what isn't seen


def test_nothing_is_invented_where_a_joint_is_missing():
    track = change(make_track(), "left_ankle", slice(20, 40), np.nan)
    angles = SOLVER.fit(track, SUBJECT).angles
    assert np.isnan(angles["knee_flexion_l"][20:40]).all()
    assert np.isfinite(angles["knee_flexion_l"][:20]).all()
    assert np.isfinite(angles["knee_flexion_r"]).all()
    column_ = angles.names.index("knee_flexion_l")
    assert np.all(angles.status[20:40, column_] == Status.MISSING)
    assert np.all(angles.status[:20, column_] == Status.MEASURED)


def test_a_gap_of_a_moment_is_bridged_and_said_to_be():
    track = change(make_track(), "left_ankle", slice(20, 22), np.nan)
    fit = SOLVER.fit(track, SUBJECT).angles
    column_ = fit.names.index("knee_flexion_l")
    assert np.all(fit.status[20:22, column_] == Status.FILLED)
    expected = degrees(make_pose(), "theta_kn_l")
    np.testing.assert_allclose(fit["knee_flexion_l"][20:22], expected[20:22], atol=2.0)
    assert np.all(fit.sigma("knee_flexion_l")[20:22] > fit.sigma("knee_flexion_l")[15])


def test_the_turn_of_a_straight_arm_is_not_reported():
    angles = make_pose()
    angles[column("theta_el_l")] = np.radians(3.0)
    fit = SOLVER.fit(make_track(angles, sigma_m=0.02), SUBJECT)
    assert np.isnan(fit.angles["shoulder_rotation_l"]).all()
    assert np.isfinite(fit.angles["shoulder_rotation_r"]).all()
    assert any("shoulder_rotation_l" in warning for warning in fit.warnings)


def test_the_turn_of_the_thigh_needs_a_bent_knee_or_a_foot():
    angles = make_pose()
    for s in ("l", "r"):
        angles[column(f"theta_kn_{s}")] = np.radians(3.0)
    fit = SOLVER.fit(make_track(angles, skeleton="h36m_17", sigma_m=0.02), SUBJECT).angles
    assert np.isnan(fit["hip_rotation_l"]).all()
    with_feet = SOLVER.fit(make_track(angles, sigma_m=0.02), SUBJECT).angles
    assert np.isfinite(with_feet["hip_rotation_l"]).mean() > 0.5


def test_a_skeleton_without_feet_and_ears_leaves_their_angles_out():
    fit = SOLVER.fit(make_track(skeleton="h36m_17"), SUBJECT)
    for name in ("ankle_dorsiflexion_l", "neck_flexion"):
        assert np.isnan(fit.angles[name]).all()
    assert fit.body is not None
    names = get_skeleton("h36m_17").keypoints
    present = fit.body.joints.is_present
    assert present[:, [names.index("pelvis"), names.index("thorax")]].all()
    assert not present[:, names.index("head")].any()


def test_the_neck_is_measured_from_upright_standing():
    fit = SOLVER.fit(make_pose_track(n_frames=60), Subject(stature_m=1.75)).angles
    standing = fit["trunk_inclination"] < 15.0
    assert np.abs(fit["neck_flexion"][standing]).max() < 4.0


# ----------------------------------------------------------------------------- bad input


def _scatter(position: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(0)
    bad = rng.random(len(position)) < 0.8
    return position + bad[:, None, None] * rng.normal(size=position.shape)


def _replace(frames: object, value: object) -> Callable[[np.ndarray], np.ndarray]:
    def apply(position: np.ndarray) -> np.ndarray:
        position[frames] = value
        return position

    return apply


LEFT_KNEE = get_skeleton("mediapipe_33").index("left_knee")
SPOILT: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "all missing": _replace(slice(None), np.nan),
    "one joint missing": _replace((slice(None), LEFT_KNEE), np.nan),
    "one frame only": _replace(slice(1, None), np.nan),
    "constant": lambda position: np.repeat(position[10:11], len(position), axis=0),
    "80 % bad": _scatter,
    "mirrored": lambda position: position * [1.0, 1.0, -1.0],
    "upside down": lambda position: position * [1.0, -1.0, 1.0],
    "coincident": _replace(slice(None), [0.0, 1.0, 0.0]),
    "infinite": _replace(5, np.inf),
    "huge": _replace(7, 1e12),
    "tiny": lambda position: position * 1e-6,
}
SHORT = {"one frame": (1, 30.0), "two frames": (2, 30.0), "one frame a second": (6, 1.0)}


def _spoil(kind: str) -> PoseTrack:
    if kind in SHORT:
        n_frames, fps = SHORT[kind]
        return make_track(make_pose(n_frames, fps=fps), fps=fps)
    track = make_track()
    return dataclasses.replace(track, position=SPOILT[kind](np.array(track.position)), status=None)


@pytest.mark.parametrize("kind", [*SPOILT, *SHORT])
@pytest.mark.parametrize("sigma", ["stated", "unknown"])
def test_bad_input_gives_angles_or_nan_but_no_exception(kind, sigma):
    track = _spoil(kind)
    if sigma == "unknown":
        track = dataclasses.replace(track, sigma=None)
    fit = SOLVER.fit(track, SUBJECT)
    angles = fit.angles
    assert isinstance(angles, JointAngles)
    assert angles.value_deg.shape == (track.n_frames, len(SOLVER.info.angles))
    known = np.isfinite(angles.value_deg)
    assert np.isfinite(angles.sigma_deg[known]).all()
    assert np.all(angles.status[known] != Status.MISSING)
    assert all(warning.endswith(".") for warning in fit.warnings)


def test_what_is_missing_is_said_in_plain_words():
    nothing = SOLVER.fit(_spoil("all missing"), SUBJECT)
    assert np.isnan(nothing.angles.value_deg).all()
    assert nothing.body is None
    assert "film the whole person" in nothing.warnings[0]
    bad = SOLVER.fit(_spoil("80 % bad"), SUBJECT)
    assert any("cm from the fitted body" in warning for warning in bad.warnings)


def test_one_frame_and_slow_film_are_as_exact_as_the_keypoints():
    for n_frames, fps in ((1, 30.0), (2, 30.0), (6, 1.0)):
        angles = make_pose(n_frames, fps=fps)
        fit = SOLVER.fit(make_track(angles, fps=fps, sigma_m=0.005), SUBJECT).angles
        expected = degrees(angles, "theta_kn_l")
        np.testing.assert_allclose(fit["knee_flexion_l"], expected, atol=2.0)


def test_a_track_in_pixels_is_refused():
    with pytest.raises(UnitError, match="place the track in the world"):
        SOLVER.fit(make_pose_track(frame_of_reference="image"), SUBJECT)


def test_results_repeat():
    track = make_track(noise_m=0.02)
    first, second = (SOLVER.fit(track, SUBJECT).angles for _ in range(2))
    np.testing.assert_array_equal(first.value_deg, second.value_deg)
    np.testing.assert_array_equal(first.sigma_deg, second.sigma_deg)


def test_the_intervals_hold_the_truth_as_often_as_they_say():
    """About 95 % of the angles lie within 1.96 standard errors, whether noise is quick or slow."""
    inside: dict[str, list[np.ndarray]] = {"quick": [], "slow": []}
    angles = make_pose(120)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        clean = make_track(angles, sigma_m=0.02)
        quick = rng.normal(size=clean.position.shape)
        slow = np.array(quick)
        for i in range(1, len(slow)):
            slow[i] = 0.9 * slow[i - 1] + np.sqrt(1 - 0.9**2) * quick[i]
        for kind, noise in (("quick", quick), ("slow", slow)):
            track = dataclasses.replace(clean, position=clean.position + 0.02 * noise)
            fit = SOLVER.fit(track, SUBJECT).angles
            for angle, variable, sign in DIRECT:
                # Those that rest on an assumption are exact here, because the assumption is.
                if angle.startswith(("knee", "elbow", "lumbar_bending", "hip_adduction")):
                    error = np.abs(fit[angle] - degrees(angles, variable, sign))
                    inside[kind].append(error < 1.96 * fit.sigma(angle))
    for kind, parts in inside.items():
        assert 0.92 < np.concatenate(parts).mean() < 0.995, kind


def test_a_joint_at_its_limit_is_no_more_certain_for_it():
    angles = make_pose()
    straight, bent = angles.copy(), angles.copy()
    straight[column("theta_kn_l")], bent[column("theta_kn_l")] = 0.0, np.radians(20.0)
    sigma = [
        np.median(
            SOLVER.fit(make_track(a, noise_m=0.02, sigma_m=0.02), SUBJECT).angles.sigma(
                "knee_flexion_l"
            )
        )
        for a in (straight, bent)
    ]
    assert sigma[0] > 0.7 * sigma[1]
