"""One body from two pictures: exact on exact views, honest on noise, not led astray by one view."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from engine.datatypes import Camera, PoseTrack, Status, Subject, SubjectState, ViewPose
from engine.errors import DataError, ShapeError, UnitError
from engine.kinematics.fitting.least_squares import choose_points
from engine.kinematics.fusion import FusedFit, FusionSettings, fuse_views
from engine.kinematics.humanoid import FITTED_JOINTS, SegmentLengths, to_world_axes
from engine.kinematics.humanoid.model import ANGLE_COUNT, column
from engine.kinematics.humanoid.tree import Tree
from engine.optics import camera_centre, compute_directions, project, to_camera_axes
from engine.skeletons import MEDIAPIPE_33
from tests.builders import make_view_info

STATURE_M = 1.75
SUBJECT = Subject(stature_m=STATURE_M)
LENGTHS = SegmentLengths.from_stature(STATURE_M)
FPS = 30.0
N_FRAMES = 75
NOISE_PX = 3.0
JOINTS = [MEDIAPIPE_33.index(name) for name in FITTED_JOINTS]
ANGLES = {
    "knee_flexion_r": ("theta_kn_r", 1.0),
    "knee_flexion_l": ("theta_kn_l", 1.0),
    "elbow_flexion_r": ("theta_el_r", 1.0),
    "elbow_flexion_l": ("theta_el_l", 1.0),
    "shoulder_adduction_r": ("phi_sh_r", -1.0),
    "hip_adduction_l": ("phi_hp_l", -1.0),
}


def make_squat(n_frames: int = N_FRAMES) -> np.ndarray:
    """Make a squat with level feet and arms that reach forward; full pose vectors."""
    time_s = np.arange(n_frames) / FPS
    bend = 0.5 * (1 - np.cos(2 * np.pi * time_s / 2.5))
    pitch, hip, knee = 15 * bend, 8 + 60 * bend, 12 + 65 * bend
    degrees = {"theta_bd": pitch, "theta_ws": 1.5 * pitch, "phi_ws": 4 * bend, "psi_ws": 6 * bend}
    for s in ("l", "r"):
        degrees |= {
            f"theta_hp_{s}": hip,
            f"theta_kn_{s}": knee,
            f"theta_an_{s}": knee - hip + pitch,
            f"theta_sh_{s}": 15 + 55 * bend,
            f"phi_sh_{s}": 12 + 5 * bend,
            f"psi_sh_{s}": 10 + 0 * bend,
            f"theta_el_{s}": 25 + 35 * bend,
        }
    angles = np.zeros((ANGLE_COUNT, n_frames))
    for name, values in degrees.items():
        angles[column(name)] = np.radians(values)
    return angles


def make_truth(angles: np.ndarray, lengths: SegmentLengths = LENGTHS) -> np.ndarray:
    """Place the squat's points, feet on the floor where they are, shape (T, 33, 3), m."""
    names = choose_points("mediapipe_33")
    points = Tree(names).place(angles, lengths.as_dict()).points
    feet = [names.index(f"{side}_ankle") for side in ("left", "right")]
    points = points - points[feet].mean(axis=0)
    points[:, 2] += lengths.heel_down + 0.02
    world = to_world_axes(np.moveaxis(points, 2, 0))
    position = np.full((world.shape[0], len(MEDIAPIPE_33.keypoints), 3), np.nan)
    for i, name in enumerate(names):
        position[:, MEDIAPIPE_33.index(name)] = world[:, i]
    return position


def make_camera(name: str, centre: tuple[float, float, float]) -> Camera:
    """Make a camera with a lens that bends lines, looking at the person's middle."""
    forward = np.array([0.1, 0.9, 0.0]) - np.array(centre)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.array([[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]])
    return Camera(
        name,
        (1280, 720),
        matrix,
        rotation,
        -rotation @ centre,
        np.array([-0.2, 0.08, 1e-3, -1e-3, 0]),
    )


CAMERAS = (make_camera("side", (0.2, 1.2, 3.8)), make_camera("front", (3.0, 1.4, 2.4)))
TRUE_ANGLES = make_squat()
TRUTH = make_truth(TRUE_ANGLES)
TIME_S = np.arange(N_FRAMES) / FPS


def make_views(
    *, noise_px: float = 0.0, with_body: bool = True, confidence: float = 1.0, seed: int = 0
) -> list[ViewPose]:
    rng = np.random.default_rng(seed)
    views = []
    for camera in CAMERAS:
        pixel = project(camera, TRUTH)
        pixel = pixel + noise_px * rng.normal(size=pixel.shape)
        views.append(wrap(camera, pixel, with_body=with_body, confidence=confidence))
    return views


def wrap(camera: Camera, pixel: np.ndarray, *, with_body: bool, confidence: float) -> ViewPose:
    known = np.full(pixel.shape[:2], confidence)
    image = PoseTrack(TIME_S, pixel, "px", "image", "mediapipe_33", known)
    hips = [MEDIAPIPE_33.index(f"{side}_hip") for side in ("left", "right")]
    turned = to_camera_axes(camera, TRUTH)
    turned = turned - turned[:, hips].mean(axis=1, keepdims=True)
    body = PoseTrack(TIME_S, turned, "m", "body", "mediapipe_33", known) if with_body else None
    box = np.tile([300.0, 50.0, 900.0, 700.0], (N_FRAMES, 1))
    return ViewPose(image, body, box, (SubjectState.TRACKED,) * N_FRAMES, make_view_info())


def change_view(
    views: list[ViewPose], view: int, edit: Callable[[np.ndarray], np.ndarray]
) -> list[ViewPose]:
    image = views[view].image
    position = edit(np.array(image.position))
    changed = dataclasses.replace(image, position=position, status=None)
    result = list(views)
    result[view] = dataclasses.replace(views[view], image=changed)
    return result


def triangulate(views: list[ViewPose]) -> PoseTrack:
    """Intersect the lines of sight, each joint by itself, as a start: the mean of two rays."""
    position = np.full(TRUTH.shape, np.nan)
    centres = [camera_centre(camera) for camera in CAMERAS]
    rays = [compute_directions(c, v.image.position) for c, v in zip(CAMERAS, views, strict=True)]
    for frame in range(N_FRAMES):
        for k in range(TRUTH.shape[1]):
            normal, right = np.zeros((3, 3)), np.zeros(3)
            for centre, ray in zip(centres, (r[frame, k] for r in rays), strict=True):
                across = np.eye(3) - np.outer(ray, ray)
                normal, right = normal + across, right + across @ centre
            if np.isfinite(right).all():
                position[frame, k] = np.linalg.solve(normal, right)
    return PoseTrack(TIME_S, position, "m", "world", "mediapipe_33")


def fuse(views: list[ViewPose], track: PoseTrack | None = None) -> FusedFit:
    return fuse_views(views, CAMERAS, track or triangulate(views), SUBJECT)


def joint_error_m(fused: FusedFit, frames: slice = slice(None)) -> np.ndarray:
    return np.linalg.norm((fused.track.position - TRUTH)[frames][:, JOINTS], axis=2)


def angle_error_deg(fused: FusedFit, name: str) -> np.ndarray:
    variable, sign = ANGLES[name]
    return fused.fit.angles[name] - sign * np.degrees(TRUE_ANGLES[column(variable)])


@pytest.fixture(scope="module")
def exact() -> FusedFit:
    return fuse(make_views())


@pytest.fixture(scope="module")
def noisy() -> FusedFit:
    return fuse(make_views(noise_px=NOISE_PX))


def test_a_figure_filmed_through_two_lenses_is_found_again(exact):
    assert joint_error_m(exact).max() < 0.01
    for name in ANGLES:
        assert np.abs(angle_error_deg(exact, name)).max() < 2.5, name
    assert np.nanmax(exact.reprojection_px) < 3.0
    assert not exact.rejected.any()
    assert (exact.track.status[:, JOINTS] == Status.MEASURED).all()


def test_segments_keep_their_length(noisy):
    joints = noisy.fit.body.joints.position
    thigh = joints[:, MEDIAPIPE_33.index("left_hip")] - joints[:, MEDIAPIPE_33.index("left_knee")]
    assert np.ptp(np.linalg.norm(thigh, axis=1)) < 1e-6
    assert noisy.fit.body.segment_lengths_m["thigh"] == pytest.approx(LENGTHS.thigh, rel=0.03)


def test_noise_is_lower_than_by_triangulation_and_the_intervals_hold_the_truth(noisy):
    plain = triangulate(make_views(noise_px=NOISE_PX)).position
    by_rays = np.linalg.norm((plain - TRUTH)[:, JOINTS], axis=2)
    assert joint_error_m(noisy).mean() < 0.6 * by_rays.mean()
    inside = [
        np.abs(angle_error_deg(noisy, name)) < 1.96 * noisy.fit.angles.sigma(name)
        for name in ANGLES
    ]
    assert np.mean(inside) > 0.9
    off = np.abs(noisy.track.position - TRUTH)[:, JOINTS]
    assert np.mean(off < 1.96 * noisy.track.sigma[:, JOINTS, None]) > 0.9


@pytest.mark.parametrize("with_body", [True, False], ids=["with depths", "pictures only"])
def test_a_view_without_the_person_for_a_second_is_stood_in_for(noisy, with_body):
    gone = slice(20, 50)

    def lose(position: np.ndarray) -> np.ndarray:
        position[gone] = np.nan
        return position

    views = change_view(make_views(noise_px=NOISE_PX, with_body=with_body), 1, lose)
    fused = fuse(views)
    assert joint_error_m(fused, gone).mean() < 0.05
    assert np.isfinite(fused.track.position[:, JOINTS]).all()
    knee = MEDIAPIPE_33.index("left_knee")
    assert fused.track.sigma[30:40, knee].mean() > 1.1 * noisy.track.sigma[30:40, knee].mean()
    inside = np.abs(fused.track.position - TRUTH)[gone][:, JOINTS]
    assert np.mean(inside < 1.96 * fused.track.sigma[gone][:, JOINTS, None]) > 0.9
    assert any("front shows nobody in 30 of 75" in text for text in fused.fit.warnings)


@pytest.mark.parametrize(
    "parts",
    [
        ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "heel", "big_toe", "ear"),
        ("hip", "knee", "ankle", "heel", "big_toe"),
    ],
    ids=["all", "legs"],
)
def test_left_taken_for_right_in_one_view_is_put_right(noisy, parts):
    frames = slice(30, 40)
    order = list(range(len(MEDIAPIPE_33.keypoints)))
    for part in parts:
        left, right = MEDIAPIPE_33.index(f"left_{part}"), MEDIAPIPE_33.index(f"right_{part}")
        order[left], order[right] = right, left

    def swap(position: np.ndarray) -> np.ndarray:
        position[frames] = position[frames][:, order]
        return position

    fused = fuse(change_view(make_views(noise_px=NOISE_PX), 1, swap))
    assert joint_error_m(fused, frames).mean() < 1.3 * joint_error_m(noisy, frames).mean() + 1e-3
    repaired = fused.track.status[:, JOINTS] == Status.REPAIRED
    assert repaired[frames].all()
    assert not repaired[:28].any()
    assert not repaired[42:].any()
    assert any("front took left for right in 10 pictures" in t for t in fused.fit.warnings)


def test_a_landmark_far_off_in_one_view_is_left_out(noisy):
    frames, wrist = slice(30, 45), MEDIAPIPE_33.index("left_wrist")

    def push(position: np.ndarray) -> np.ndarray:
        position[frames, wrist] += (80.0, -60.0)
        return position

    fused = fuse(change_view(make_views(noise_px=NOISE_PX), 0, push))
    assert fused.rejected[0, frames, wrist].mean() > 0.9
    assert not fused.rejected[1, frames, wrist].any()
    own = np.linalg.norm((fused.track.position - TRUTH)[frames, wrist], axis=1)
    assert own.mean() < 0.05
    others = [k for k in JOINTS if k != wrist]
    change = (fused.track.position - noisy.track.position)[frames][:, others]
    assert np.linalg.norm(change, axis=2).mean() < 0.015
    assert np.nanmedian(fused.reprojection_px[0, frames, wrist]) > 80.0


def test_a_joint_seen_by_one_view_only_is_placed_with_a_larger_error(noisy):
    elbow = MEDIAPIPE_33.index("left_elbow")

    def hide(position: np.ndarray) -> np.ndarray:
        position[:, elbow] = np.nan
        return position

    fused = fuse(change_view(make_views(noise_px=NOISE_PX), 1, hide))
    own = np.linalg.norm((fused.track.position - TRUTH)[:, elbow], axis=1)
    assert own.mean() < 0.05
    assert (fused.track.sigma[:, elbow] > noisy.track.sigma[:, elbow]).mean() > 0.9


def test_fingers_go_along_with_the_wrist():
    views = make_views()
    track = triangulate(views)
    wrist, index = MEDIAPIPE_33.index("left_wrist"), MEDIAPIPE_33.index("left_index")
    position = np.array(track.position)
    position[:, wrist] += (0.0, 0.0, 0.08)
    position[:, index] = position[:, wrist] + (0.07, -0.03, 0.0)
    fused = fuse(views, dataclasses.replace(track, position=position, status=None))
    hand = fused.track.position[:, index] - TRUTH[:, wrist]
    np.testing.assert_allclose(hand, np.tile([0.07, -0.03, 0.0], (N_FRAMES, 1)), atol=0.01)


def test_the_doubtful_view_counts_less(noisy):
    wrist = MEDIAPIPE_33.index("right_wrist")

    def drag(position: np.ndarray) -> np.ndarray:
        position[:, wrist] += (0.0, 14.0)
        return position

    def doubt(views: list[ViewPose]) -> list[ViewPose]:
        confidence = np.array(views[1].image.confidence)
        confidence[:, wrist] = 0.05
        views[1] = dataclasses.replace(
            views[1], image=dataclasses.replace(views[1].image, confidence=confidence)
        )
        return views

    sure = fuse(change_view(make_views(noise_px=NOISE_PX), 1, drag))
    doubted = fuse(doubt(change_view(make_views(noise_px=NOISE_PX), 1, drag)))
    errors = [
        np.linalg.norm((f.track.position - TRUTH)[:, wrist], axis=1).mean() for f in (sure, doubted)
    ]
    assert errors[1] < 0.6 * errors[0]


def test_resting_feet_do_not_move_or_sink(noisy):
    views = make_views(noise_px=NOISE_PX)
    free = fuse_views(
        views, CAMERAS, triangulate(views), SUBJECT, settings=FusionSettings(stands=False)
    )
    for side in ("left", "right"):
        heel = MEDIAPIPE_33.index(f"{side}_heel")
        held, loose = (f.fit.body.joints.position[:, heel] for f in (noisy, free))
        assert np.std(held, axis=0).max() < 0.6 * np.std(loose, axis=0).max()
        assert held[:, 1].min() > -0.005


def test_a_long_time_without_anybody_stays_missing():
    def lose(position: np.ndarray) -> np.ndarray:
        position[25:55] = np.nan
        return position

    views = make_views()
    for view in range(2):
        views = change_view(views, view, lose)
    fused = fuse(views)
    assert np.isnan(fused.track.position[25:55][:, JOINTS]).all()
    assert (fused.track.status[25:55][:, JOINTS] == Status.MISSING).all()
    assert np.isnan(fused.fit.angles["knee_flexion_r"][27:53]).all()
    assert np.isfinite(fused.track.position[:25][:, JOINTS]).all()


def test_without_any_landmark_there_are_no_angles_but_a_reason():
    def lose(position: np.ndarray) -> np.ndarray:
        return np.full_like(position, np.nan)

    views = make_views()
    for view in range(2):
        views = change_view(views, view, lose)
    fused = fuse(views)
    assert np.isnan(fused.fit.angles.value_deg).all()
    assert "film the whole person" in fused.fit.warnings[0]


def test_the_views_may_come_in_any_order(noisy):
    views = make_views(noise_px=NOISE_PX)
    turned = fuse_views(views[::-1], CAMERAS[::-1], triangulate(views), SUBJECT)
    shift = np.abs(turned.track.position - noisy.track.position)[:, JOINTS]
    assert shift.max() < 1e-3
    np.testing.assert_allclose(turned.reprojection_px[::-1], noisy.reprojection_px, atol=0.5)


def test_what_does_not_belong_together_is_refused():
    views, track = make_views(), triangulate(make_views())
    with pytest.raises(ShapeError, match="2 views and 1 cameras"):
        fuse_views(views, CAMERAS[:1], track, SUBJECT)
    late = dataclasses.replace(track, time_s=track.time_s + 0.5)
    with pytest.raises(ShapeError, match="same times"):
        fuse_views(views, CAMERAS, late, SUBJECT)
    with pytest.raises(UnitError, match="world frame"):
        fuse_views(views, CAMERAS, dataclasses.replace(track, frame_of_reference="camera"), SUBJECT)
    other = PoseTrack(TIME_S, TRUTH[:, :17], "m", "world", "h36m_17")
    with pytest.raises(DataError, match="same skeleton"):
        fuse_views(views, CAMERAS, other, SUBJECT)
