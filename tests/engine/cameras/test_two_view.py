from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from engine.cameras.triangulation import triangulate
from engine.cameras.two_view import place_in_world, reconstruct_two_views
from engine.datatypes import Array, Calibration, Camera, Measurement, PoseTrack, ViewPose
from engine.errors import AssessmentError
from engine.optics import camera_centre, project
from tests.engine.cameras.truth import NAMES, Truth, make_view, place_camera, read_truth, see

COLUMN = {name: i for i, name in enumerate(NAMES)}
JOINTS = [
    COLUMN[f"{side}_{part}"]
    for side in ("left", "right")
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
]
TURN = cv2.Rodrigues(np.array([1.1, -0.4, 0.8]))[0]
SHIFT = np.array([2.0, -3.0, 5.0])


@pytest.fixture(scope="module")
def lift() -> Truth:
    return read_truth("floor_to_knuckle")


@pytest.fixture(scope="module")
def cameras(lift: Truth) -> tuple[Camera, ...]:
    return lift.cameras["cam90"], lift.cameras["cam135"]


@pytest.fixture(scope="module")
def views(lift: Truth, cameras: tuple[Camera, ...]) -> tuple[ViewPose, ...]:
    return tuple(see(lift.points, camera, lift.time_s) for camera in cameras)


def move(camera: Camera) -> Camera:
    """Express a camera in a world turned by TURN and shifted by SHIFT."""
    rotation = camera.rotation @ TURN.T
    return replace(camera, rotation=rotation, translation=camera.translation - rotation @ SHIFT)


def calibrate(cameras: tuple[Camera, ...], *, is_told: bool = True, **sigmas: float) -> Calibration:
    """Return the cameras in another world, in which gravity and floor are told or not."""
    up = TURN @ np.array([0.0, 1.0, 0.0])
    return Calibration(
        tuple(move(camera) for camera in cameras),
        source="file",
        up=up if is_told else np.full(3, np.nan),
        floor_m=float(up @ SHIFT) if is_told else np.nan,
        **sigmas,
    )


def turn_about_vertical(points: Array, degrees: float) -> Array:
    angle = np.radians(degrees)
    axes = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    return points @ np.array(axes).T


class TestWorld:
    @pytest.mark.parametrize("is_told", [True, False], ids=["gravity told", "from the person"])
    def test_the_person_stands_at_the_origin_and_faces_x(self, lift, cameras, views, is_told):
        track, scene, _ = reconstruct_two_views(
            views, calibrate(cameras, is_told=is_told), Measurement(lift.stature_m, 0.01)
        )
        assert isinstance(track, PoseTrack)
        assert (track.unit, track.frame_of_reference) == ("m", "world")
        found = np.asarray(track.position)
        feet = lift.points[:20, [COLUMN["left_ankle"], COLUMN["right_ankle"]]].mean(axis=(0, 1))
        true = lift.points - [feet[0], 0.0, feet[2]]
        # Heading is what hips, shoulders and feet say of it: within its stated error.
        offsets = np.arange(-15.0, 15.1, 0.25)
        misses = [
            np.median(np.linalg.norm(turn_about_vertical(found, a) - true, axis=2)[:, JOINTS])
            for a in offsets
        ]
        assert min(misses) < (0.01 if is_told else 0.04)
        assert abs(offsets[int(np.argmin(misses))]) < 2 * scene.heading_sigma_deg
        lowest = np.nanmin(found[:20, :, 1])
        assert 0.0 < lowest < 0.06
        assert scene.provenance["up"] == ("calibration" if is_told else "person and cameras")

    def test_gravity_from_the_person_is_within_its_error(self, lift, cameras, views):
        calibration = calibrate(cameras, is_told=False)
        _, scene, turned = reconstruct_two_views(
            views, calibration, Measurement(lift.stature_m, 0.01)
        )
        # Gravity of the found world, in the world of the cameras, against the true one.
        found_up = calibration.cameras[0].rotation.T @ turned.cameras[0].rotation[:, 1]
        tilt = np.degrees(np.arccos(np.clip(found_up @ TURN[:, 1], -1, 1)))
        assert tilt < 2 * scene.tilt_sigma_deg
        assert tilt < 3.0
        assert 0.5 < scene.tilt_sigma_deg < 3.0
        assert turned.tilt_sigma_deg == scene.tilt_sigma_deg

    def test_cameras_and_joints_turn_together(self, lift, cameras, views):
        calibration = calibrate(cameras)
        found = triangulate(views, calibration.cameras, stature_m=lift.stature_m)
        placed = place_in_world(found, calibration, Measurement(lift.stature_m, 0.01))
        for before, after in zip(calibration.cameras, placed.calibration.cameras, strict=True):
            assert project(after, placed.found.track.position) == pytest.approx(
                project(before, found.track.position), abs=1e-6, nan_ok=True
            )
        # The same errors, seen from a turned world.
        spread = np.linalg.eigvalsh(np.asarray(found.covariance))
        assert np.linalg.eigvalsh(np.asarray(placed.found.covariance)) == pytest.approx(spread)
        assert placed.calibration.up == pytest.approx([0, 1, 0])
        assert placed.calibration.floor_m == 0.0

    def test_the_scene_is_the_first_camera(self, lift, cameras, views):
        _, scene, calibration = reconstruct_two_views(
            views[::-1], calibrate(cameras[::-1]), Measurement(lift.stature_m, 0.01)
        )
        assert scene.camera is calibration.cameras[0]
        assert scene.view_azimuth_deg == pytest.approx(135.0, abs=10.0)
        height = camera_centre(lift.cameras["cam135"])[1]
        assert scene.provenance["camera_height_m"] == pytest.approx(height, abs=0.02)

    def test_the_floor_from_the_feet(self, lift, cameras, views):
        told = reconstruct_two_views(views, calibrate(cameras), Measurement(lift.stature_m, 0.01))[
            0
        ]
        calibration = replace(calibrate(cameras), floor_m=np.nan)
        guessed, scene, _ = reconstruct_two_views(
            views, calibration, Measurement(lift.stature_m, 0.01)
        )
        shift = np.asarray(guessed.position)[..., 1] - np.asarray(told.position)[..., 1]
        assert np.nanstd(shift) < 1e-9
        assert abs(np.nanmean(shift)) < 2 * scene.floor_sigma_m


class TestErrors:
    def test_two_good_views_know_all_directions_alike(self, lift, cameras, views):
        _, scene, _ = reconstruct_two_views(
            views, calibrate(cameras), Measurement(lift.stature_m, 0.01)
        )
        assert scene.plane_sigma_m == scene.depth_sigma_m
        assert 0.005 < scene.plane_sigma_m < 0.04

    def test_nearly_parallel_views_do_not(self, lift):
        pair = (place_camera(azimuth_deg=88.0), place_camera(azimuth_deg=92.0))
        views = [see(lift.points, c, lift.time_s) for c in pair]
        calibration = Calibration(pair, "file", up=np.array([0.0, 1.0, 0.0]), floor_m=0.0)
        _, scene, _ = reconstruct_two_views(views, calibration, Measurement(lift.stature_m, 0.01))
        assert scene.depth_sigma_m > 1.5 * scene.plane_sigma_m
        assert scene.provenance["ray_angle_deg"] == pytest.approx(4.0, abs=0.5)

    def test_stated_errors_are_handed_on_and_silence_is_not_certainty(self, lift, cameras, views):
        stature = Measurement(lift.stature_m, 0.01)
        stated = calibrate(cameras, scale_sigma=0.003, tilt_sigma_deg=0.4, floor_sigma_m=0.004)
        _, scene, _ = reconstruct_two_views(views, stated, stature)
        assert scene.scale_sigma == 0.003
        assert scene.tilt_sigma_deg == 0.4
        assert scene.floor_sigma_m == 0.004
        _, scene, calibration = reconstruct_two_views(views, calibrate(cameras), stature)
        assert scene.scale_sigma > 0
        assert scene.tilt_sigma_deg > 0
        assert scene.floor_sigma_m > 0
        assert calibration.scale_sigma == scene.scale_sigma

    def test_the_persons_height_tells_a_wrong_scale(self, lift, cameras, views):
        stature = Measurement(lift.stature_m, 0.01)
        _, scene, _ = reconstruct_two_views(views, calibrate(cameras), stature)
        assert scene.provenance["stature_ratio"] == pytest.approx(1.0, abs=0.03)
        larger = calibrate(
            tuple(replace(c, translation=1.1 * np.asarray(c.translation)) for c in cameras)
        )
        larger = replace(larger, floor_m=np.nan)
        _, scene, _ = reconstruct_two_views(views, larger, stature)
        assert scene.provenance["stature_ratio"] == pytest.approx(1.1, abs=0.03)


class TestMissing:
    def test_feet_never_seen(self, lift, cameras, views):
        hidden = []
        for view in views:
            image = np.array(view.image.position)
            image[:, [k for k, n in enumerate(NAMES) if n.endswith("ankle")]] = np.nan
            hidden.append(
                make_view(image, np.asarray(view.body.position), lift.time_s, view.info.size_px)
            )
        with pytest.raises(AssessmentError, match="Feet and head"):
            reconstruct_two_views(hidden, calibrate(cameras), Measurement(lift.stature_m, 0.01))

    def test_frames_without_the_person_stay_missing(self, lift, cameras, views):
        lost = []
        for view in views:
            image, body = np.array(view.image.position), np.array(view.body.position)
            image[:15], body[:15] = np.nan, np.nan
            lost.append(make_view(image, body, lift.time_s, view.info.size_px))
        track, _, _ = reconstruct_two_views(
            lost, calibrate(cameras), Measurement(lift.stature_m, 0.01)
        )
        assert np.isnan(track.position[:15]).all()
        assert np.isfinite(track.position[15:]).all()
