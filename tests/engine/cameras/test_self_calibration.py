"""Cameras found from a moving person, against the cameras through which it was seen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from engine.cameras._bundle import (
    N_SHARED,
    ROTATION,
    UP,
    Bundle,
    BundlePriors,
    BundleState,
    rotation_from,
    start_shared,
)
from engine.cameras._person import choose_frames, collect_evidence
from engine.cameras._starts import body_in_camera
from engine.cameras.self_calibration import calibrate_from_person
from engine.datatypes import Array, Calibration, Camera, Measurement, ViewPose
from engine.errors import CalibrationError
from engine.optics import camera_centre, project
from tests.engine.cameras.truth import Truth, make_view, place_camera, read_truth, see


@cache
def clip() -> Truth:
    return read_truth("floor_to_knuckle")


def camera(azimuth_deg: float, **settings: float) -> Camera:
    return place_camera(azimuth_deg=azimuth_deg, **settings)


def film(*cameras: Camera, noise_px: float = 0.0, part: slice = slice(None)) -> list[ViewPose]:
    points, time_s = clip().points[part], clip().time_s[part]
    return [see(points, c, time_s, noise_px=noise_px, seed=10 + i) for i, c in enumerate(cameras)]


def stature(sigma: float = 0.01) -> Measurement:
    return Measurement(clip().stature_m, sigma)


def relative(cameras: tuple[Camera, ...] | list[Camera]) -> tuple[Array, Array]:
    first, second = cameras
    rotation = second.rotation @ first.rotation.T
    return rotation, second.translation - rotation @ first.translation


def turn_deg(rotation: Array) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))


def angle_deg(a: Array, b: Array) -> float:
    return float(np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))))


def assert_near(found: Calibration, true: list[Camera], *, factor: float = 2.5) -> None:
    """Check errors against what the calibration says of itself."""
    rotation, translation = relative(found.cameras)
    true_rotation, true_translation = relative(true)
    told = found.provenance
    assert (
        turn_deg(rotation @ true_rotation.T) < factor * np.sqrt(3) * told["pose_rotation_sigma_deg"]
    )
    off = np.linalg.norm(translation - true_translation)
    assert off < factor * np.sqrt(3) * told["pose_translation_sigma_m"]
    for own, known in zip(found.cameras, true, strict=True):
        error = 100 * abs(own.matrix[0, 0] / known.matrix[0, 0] - 1)
        assert error < factor * max(told["focal_sigma_percent"], 0.3)


PLACES = {
    "right angle": (45.0, 135.0),
    "half": (80.0, 130.0),
    "wide": (20.0, 150.0),
    "left and front": (-60.0, 10.0),
}


@pytest.mark.parametrize("azimuths", PLACES.values(), ids=PLACES)
def test_noisy_views_give_the_cameras_within_their_stated_errors(azimuths):
    true = [camera(azimuths[0], pitch_deg=5.0), camera(azimuths[1], distance_m=3.5, roll_deg=1.5)]
    found = calibrate_from_person(film(*true, noise_px=2.0), stature())
    assert_near(found, true)
    assert turn_deg(relative(found.cameras)[0] @ relative(true)[0].T) < 6.0


def test_known_matrices_are_kept_and_sharpen_the_place():
    true = [camera(60.0), camera(140.0)]
    views = film(*true, noise_px=1.0)
    found = calibrate_from_person(views, stature(), matrices=[c.matrix for c in true])
    assert_near(found, true)
    _, translation = relative(found.cameras)
    assert np.linalg.norm(translation - relative(true)[1]) < 0.20
    for own, known in zip(found.cameras, true, strict=True):
        assert own.matrix[0, 0] == pytest.approx(known.matrix[0, 0], rel=0.01)
    assumed = calibrate_from_person(views, stature())
    assert (
        found.provenance["pose_translation_sigma_m"]
        < 0.5 * assumed.provenance["pose_translation_sigma_m"]
    )


def test_the_world_has_gravity_floor_and_metres():
    true = [camera(60.0, height_m=1.5, pitch_deg=4.0), camera(140.0, height_m=1.0)]
    found = calibrate_from_person(
        film(*true, noise_px=1.0), stature(), matrices=[c.matrix for c in true]
    )
    for own, known in zip(found.cameras, true, strict=True):
        up = known.rotation.T @ own.rotation @ found.up
        assert angle_deg(up, np.array([0.0, 1.0, 0.0])) < 2.5 * np.sqrt(2) * found.tilt_sigma_deg
    heights = [float(camera_centre(c)[1]) for c in found.cameras]
    assert heights == pytest.approx([1.5, 1.0], abs=0.15)
    assert found.floor_m == 0.0
    # The same person, seen by the found cameras, keeps the size of the true one.
    first, second = (np.linalg.norm(relative(c)[1]) for c in (found.cameras, true))
    assert first / second == pytest.approx(1.0, abs=2.5 * found.scale_sigma + 0.03)


def test_exchanging_the_views_exchanges_the_cameras():
    true = [camera(60.0), camera(140.0)]
    views = film(*true, noise_px=1.0)
    forth, back = (
        calibrate_from_person(v, stature(), matrices=[true[0].matrix] * 2)
        for v in (views, views[::-1])
    )
    rotation, _ = relative(forth.cameras)
    assert turn_deg(relative(back.cameras)[0] @ rotation) < 1.5


def test_works_without_body_landmarks():
    true = [camera(60.0), camera(140.0)]
    views = [replace(v, body=None) for v in film(*true, noise_px=0.5)]
    found = calibrate_from_person(views, stature(), matrices=[c.matrix for c in true])
    assert turn_deg(relative(found.cameras)[0] @ relative(true)[0].T) < 5.0


def test_exchanged_sides_and_wild_joints_in_one_view_do_no_harm():
    true = [camera(60.0), camera(140.0)]
    views = film(*true, noise_px=1.0)
    image = np.array(views[1].image.position)
    swapped = [*range(11), *(i + (1 if i % 2 else -1) for i in range(11, 33))]
    image[100:125] = image[100:125][:, swapped]
    image[30:45, 15] += 150.0
    views[1] = replace(views[1], image=replace(views[1].image, position=image))
    found = calibrate_from_person(views, stature(), matrices=[c.matrix for c in true])
    assert turn_deg(relative(found.cameras)[0] @ relative(true)[0].T) < 4.0


def test_an_unknown_stature_widens_the_scale():
    views = film(camera(60.0), camera(140.0), noise_px=1.0)
    known, unknown = (calibrate_from_person(views, stature(s)) for s in (0.01, 0.10))
    assert known.scale_sigma < 0.02
    assert unknown.scale_sigma == pytest.approx(0.10 / clip().stature_m, rel=0.2)


def _still() -> list[ViewPose]:
    points = np.repeat(clip().points[:1], 60, axis=0)
    return [see(points, camera(a), clip().time_s[:60]) for a in (60.0, 140.0)]


def _blind() -> list[ViewPose]:
    views = film(camera(60.0), camera(140.0))
    hidden = np.array(views[0].image.position)
    hidden[8:] = np.nan
    views[0] = make_view(hidden, np.array(views[0].body.position), clip().time_s, (720, 480))
    return views


def _unrelated() -> list[ViewPose]:
    first, second = film(camera(60.0), camera(140.0))
    backwards = np.array(second.image.position)[::-1]
    body = np.array(second.body.position)[::-1]
    other = np.roll(backwards, 70, axis=0)
    return [first, make_view(other, np.roll(body, 70, axis=0), clip().time_s, (720, 480))]


def _unequal_times() -> list[ViewPose]:
    first, second = film(camera(60.0), camera(140.0))
    late = replace(second.image, time_s=np.asarray(second.image.time_s) + 0.5)
    return [first, replace(second, image=late)]


REFUSALS = {
    "one video twice": (lambda: film(camera(60.0), camera(60.0)), "same place"),
    "side by side": (lambda: film(camera(60.0), camera(67.0), noise_px=1.0), "same direction"),
    "face to face": (lambda: film(camera(0.0), camera(176.0), noise_px=1.0), "at each other"),
    "nothing moves": (_still, "hardly moves"),
    "hardly seen": (_blind, "at least 12 frames"),
    "other movement": (_unrelated, "same person at the same time"),
    "not synchronised": (_unequal_times, "synchronise them"),
    "one view": (lambda: film(camera(60.0)), "two views, got 1"),
}


@pytest.mark.parametrize(("make", "words"), REFUSALS.values(), ids=REFUSALS)
def test_refuses_with_a_reason(make, words):
    with pytest.raises(CalibrationError, match=words):
        calibrate_from_person(make(), stature())


def test_refuses_a_wrong_number_of_matrices():
    with pytest.raises(CalibrationError, match="each of 2 views, got 1"):
        calibrate_from_person(film(camera(60.0), camera(140.0)), stature(), matrices=[None])


def test_derivatives_of_the_bundle_are_right():
    evidence = collect_evidence(film(camera(60.0), camera(140.0), noise_px=1.0))
    evidence = evidence.take(choose_frames(evidence, 3))
    evidence = replace(
        evidence,
        is_upright=np.ones_like(evidence.is_upright),
        is_planted=np.ones_like(evidence.is_planted),
    )
    matrices = np.stack([camera(60.0).matrix] * 2)
    body, _ = body_in_camera(evidence, matrices, 1.7)
    priors = BundlePriors(matrices, np.full(2, 0.2), np.full(2, 7.0), 1.7, 0.01, 8.0, 2.0, body)
    rng = np.random.default_rng(3)
    shared = start_shared(priors, np.array([-2.0, 0.1, 2.0])) + 0.05 * rng.standard_normal(N_SHARED)
    shared[ROTATION] = shared[UP] = 0.0
    up = np.array([0.05, -0.99, -0.1])
    state = BundleState(
        shared,
        rotation_from(np.array([0.1, 0.8, 0.05])),
        up / np.linalg.norm(up),
        rng.standard_normal(body.shape[1:]) + np.array([0.0, 0.0, 4.0]),
    )
    bundle = Bundle(evidence, priors)
    rows, by_points, by_shared = bundle.linearise(state)
    step = 1e-6
    for column in rng.choice(N_SHARED, 40, replace=False):
        if column in range(*UP.indices(N_SHARED)):
            continue  # The two axes across `up` turn with it, which linearising leaves out.
        move = np.zeros(N_SHARED)
        move[column] = step
        moved = bundle.residuals(state.moved(move, np.zeros_like(state.points)))
        slope = (moved - rows) / step
        assert slope == pytest.approx(by_shared[:, :, column], rel=2e-3, abs=2e-3)
    for column in rng.choice(by_points.shape[2], 15, replace=False):
        points = np.zeros_like(state.points).reshape(evidence.n_frames, -1)
        points[:, column] = step
        moved = bundle.residuals(state.moved(np.zeros(N_SHARED), points.reshape(body.shape[1:])))
        assert (moved - rows) / step == pytest.approx(by_points[:, :, column], rel=2e-3, abs=2e-3)


def test_planted_feet_come_to_lie_on_the_floor():
    true = [camera(60.0), camera(140.0)]
    views = film(*true, noise_px=0.5)
    found = calibrate_from_person(views, stature(), matrices=[c.matrix for c in true])
    # A point on the true floor between the feet, carried over by the first camera.
    seen = true[0].rotation @ np.zeros(3) + true[0].translation
    own = found.cameras[0]
    height = float((own.rotation.T @ (seen - own.translation)) @ found.up)
    assert height == pytest.approx(0.0, abs=2.5 * found.floor_sigma_m + 0.02)
    assert np.isfinite(project(own, clip().points[0])).all()
