"""Bundle adjustment against numeric derivatives and against its own stated errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from engine.cameras import _adjust
from engine.cameras._adjust import Bundle, Lens, LensPrior, Sighting, adjust
from engine.optics import camera_centre, project
from tests.engine.cameras.board_scenes import lay_board, pair_of_cameras, random_poses

GRID = np.stack([*np.meshgrid(np.arange(6.0), np.arange(4.0)), np.zeros((4, 6))], axis=-1)
SHAPE = GRID.reshape(-1, 3) * 0.07


def make_bundle(seed=0, *, n=6, noise_px=0.0, point_sigma_m=0.0):
    """Return a bundle at the truth, with noisy pixels."""
    rng = np.random.default_rng(seed)
    cameras = pair_of_cameras()
    poses = random_poses(n, seed)
    sightings = []
    for body, pose in enumerate(poses):
        world = SHAPE @ pose[:, :3].T + pose[:, 3]
        for index, camera in enumerate(cameras):
            pixels = project(camera, world) + rng.normal(0, noise_px, (len(SHAPE), 2))
            sightings.append(Sighting(index, body, np.arange(len(SHAPE)), pixels, 1.0))
    lenses = tuple(Lens.of(c) for c in cameras)
    sigma = np.r_[np.inf, np.inf, 30.0, 30.0, 0.3, 0.5, 0.01, 0.01, 0.0]
    return Bundle(
        lenses=lenses,
        lens_priors=tuple(LensPrior(lens.values, sigma) for lens in lenses),
        camera_rotation=np.stack([c.rotation for c in cameras]),
        camera_translation=np.stack([c.translation for c in cameras]),
        body_rotation=np.stack([p[:, :3] for p in poses]),
        body_translation=np.stack([p[:, 3] for p in poses]),
        points=SHAPE,
        sightings=tuple(sightings),
        is_camera_held=np.array([True, False]),
        is_body_held=np.zeros(n, dtype=bool),
        point_sigma_m=point_sigma_m,
    )


def disturb(bundle, seed=1):
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(0, 0.03, (len(bundle.body_rotation), 3))).as_matrix()
    lenses = tuple(Lens(lens.values * np.r_[1.06, 1.06, np.ones(7)]) for lens in bundle.lenses)
    return replace(
        bundle,
        lenses=lenses,
        body_rotation=turn @ bundle.body_rotation,
        body_translation=bundle.body_translation + rng.normal(0, 0.03, (len(turn), 3)),
        camera_translation=bundle.camera_translation + np.array([[0, 0, 0], [0.05, -0.03, 0.04]]),
    )


def test_derivatives_are_those_of_the_prediction():
    bundle = make_bundle(n=2, point_sigma_m=0.01)
    exact = _adjust._jacobian(bundle).toarray()
    for column in range(exact.shape[1]):
        step = np.zeros(exact.shape[1])
        step[column] = 1e-6
        ahead, back = (_adjust._residuals(_adjust._move(bundle, s * step)) for s in (1, -1))
        numeric = (ahead - back).ravel() / 2e-6
        assert np.allclose(exact[:, column], numeric, rtol=1e-4, atol=1e-4 * np.abs(numeric).max())


def test_exact_pixels_give_the_exact_cameras():
    found = adjust(disturb(make_bundle()))
    truth = make_bundle()
    assert found.rms_px < 1e-4
    assert np.allclose(found.bundle.camera_translation, truth.camera_translation, atol=1e-5)
    for one, two in zip(found.bundle.lenses, truth.lenses, strict=True):
        assert np.allclose(one.values[:4], two.values[:4], atol=0.05)


def relative_errors(found):
    first, second = pair_of_cameras()
    turn = first.rotation @ second.rotation.T
    place = first.rotation @ camera_centre(second) + first.translation
    rotation, translation = found.bundle.camera_rotation, found.bundle.camera_translation
    got = rotation[0] @ rotation[1].T
    miss = np.degrees(Rotation.from_matrix(got @ turn.T).as_rotvec())
    return miss, translation[0] - got @ translation[1] - place


def test_stated_errors_are_those_that_happen():
    ratios = []
    for seed in range(12):
        found = adjust(make_bundle(seed, noise_px=0.4))
        sigmas = found.relative_sigmas(0, 1)
        assert found.noise == pytest.approx(0.4, rel=0.12)
        errors = relative_errors(found)
        ratios.append([np.sqrt(np.mean(e**2)) / s for e, s in zip(errors, sigmas, strict=True)])
    # 36 errors each: the root mean square of errors over their sigmas is 1 within a third.
    assert np.all(np.abs(np.sqrt(np.mean(np.square(ratios), axis=0)) - 1.0) < 0.35)


def test_wrong_corners_are_held_down():
    bundle = make_bundle(noise_px=0.2)
    bad = bundle.sightings[3]
    pixels = bad.pixels.copy()
    pixels[:3] += [15.0, -9.0]
    sightings = list(bundle.sightings)
    sightings[3] = replace(bad, pixels=pixels)
    clean, spoilt = adjust(bundle), adjust(replace(bundle, sightings=tuple(sightings)))
    errors = relative_errors(clean), relative_errors(spoilt)
    pairs = zip(*errors, clean.relative_sigmas(0, 1), strict=True)
    for with_all, with_wrong, sigma in pairs:
        assert np.abs(with_all - with_wrong).max() < 1.5 * sigma


def test_errors_common_to_a_view_widen_the_stated_ones():
    """Each view's corners are shifted together, as by a bent board: more than noise allows."""
    bundle = make_bundle(n=10, noise_px=0.05)
    rng = np.random.default_rng(3)
    bent = 2e-3 * (SHAPE[:, :1] - 0.15) ** 2 / 0.15**2
    shifted = []
    for sighting in bundle.sightings:
        amount = 250 * rng.normal() * bent * np.array([[1.0, 0.4]])
        shifted.append(replace(sighting, pixels=sighting.pixels + amount))
    bundle = replace(bundle, sightings=tuple(shifted))
    found = adjust(bundle)
    alone = adjust(make_bundle(n=10, noise_px=found.noise))
    assert found.relative_sigmas(0, 1)[1] > 1.3 * alone.relative_sigmas(0, 1)[1]


def test_points_with_errors_of_their_own_move_within_them():
    bundle = make_bundle(n=1, noise_px=0.1, point_sigma_m=0.002)
    moved = bundle.points + np.random.default_rng(5).normal(0, 0.002, bundle.points.shape)
    found = adjust(replace(bundle, points=moved, is_body_held=np.ones(1, bool)))
    left = found.bundle.points + found.bundle.point_offset - SHAPE
    assert np.sqrt(np.mean(left**2)) < np.sqrt(np.mean((moved - SHAPE) ** 2))
    assert np.abs(found.bundle.point_offset).max() < 0.01


def test_boards_in_a_scene_face_the_point_they_should():
    pose = lay_board((0.0, 1.0, 0.0), (0.0, 1.0, 3.0))
    assert np.allclose(pose[:, 2], [0, 0, -1])
    assert np.linalg.det(pose[:, :3]) == pytest.approx(1.0)
