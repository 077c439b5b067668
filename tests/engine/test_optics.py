"""The camera model agrees with OpenCV, and its inverse and derivative with itself."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.datatypes import Camera
from engine.optics import (
    camera_centre,
    compute_directions,
    normalise_points,
    place_on_rays,
    project,
    projection_jacobian,
    with_size,
)

PHONE_LENS = (0.12, -0.25, 0.001, -0.0008, 0.05)


def make_camera(distortion=PHONE_LENS) -> Camera:
    rotation, _ = cv2.Rodrigues(np.array([2.9, 0.3, -0.4]))
    return Camera(
        name="left",
        size_px=(1920, 1080),
        matrix=np.array([[1500.0, 0.0, 955.0], [0.0, 1510.0, 545.0], [0.0, 0.0, 1.0]]),
        rotation=rotation,
        translation=np.array([0.2, 0.8, 4.0]),
        distortion=np.array(distortion),
    )


def make_points(n: int = 200) -> np.ndarray:
    return np.random.default_rng(3).uniform([-0.8, -1.0, -0.8], [0.8, 1.0, 0.8], (n, 3))


def test_projection_is_that_of_opencv() -> None:
    camera, points = make_camera(), make_points()
    expected, _ = cv2.projectPoints(
        points,
        cv2.Rodrigues(camera.rotation)[0],
        camera.translation,
        camera.matrix,
        camera.distortion,
    )
    np.testing.assert_allclose(project(camera, points), expected[:, 0], atol=1e-8)


def test_points_behind_the_camera_are_nowhere_in_the_picture() -> None:
    camera = make_camera()
    behind = camera_centre(camera) - camera.rotation[2]
    assert np.isnan(project(camera, behind)).all()


def test_a_line_of_sight_goes_through_its_point() -> None:
    camera, points = make_camera(), make_points().reshape(10, 20, 3)
    away = points - camera_centre(camera)
    expected = away / np.linalg.norm(away, axis=-1, keepdims=True)
    np.testing.assert_allclose(
        compute_directions(camera, project(camera, points)), expected, atol=1e-9
    )


def test_missing_points_stay_missing_and_harm_no_others() -> None:
    camera, pixels = make_camera(), np.array([[900.0, 500.0], [np.nan, np.nan], [100.0, 900.0]])
    flat = normalise_points(camera, pixels)
    assert np.isnan(flat[1]).all()
    np.testing.assert_allclose(flat[::2], normalise_points(camera, pixels[::2]))


def test_a_point_no_lens_of_this_kind_can_show_is_missing() -> None:
    camera = make_camera((-0.5, 0.0, 0.0, 0.0, 0.0))
    assert np.isnan(normalise_points(camera, [9000.0, 9000.0])).all()


def test_the_derivative_is_that_of_small_steps() -> None:
    camera, points = make_camera(), make_points(20)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        slope = (project(camera, points + step) - project(camera, points - step)) / 2e-6
        np.testing.assert_allclose(
            projection_jacobian(camera, points)[..., axis], slope, rtol=1e-5, atol=1e-4
        )


@given(st.integers(160, 8000), st.integers(160, 8000))
def test_a_scaled_picture_shows_the_same_world(width: int, height: int) -> None:
    camera, points = make_camera(), make_points(5)
    scaled = project(with_size(camera, (width, height)), points)
    expected = (project(camera, points) + 0.5) * np.array([width / 1920, height / 1080]) - 0.5
    np.testing.assert_allclose(scaled, expected, rtol=1e-9, atol=1e-6)


def test_an_undistorted_picture_takes_no_iteration() -> None:
    camera = make_camera((0.0,) * 5)
    np.testing.assert_allclose(normalise_points(camera, [955.0, 545.0]), 0.0, atol=1e-15)
    assert normalise_points(camera, [955.0 + 1500.0, 545.0])[0] == pytest.approx(1.0)


class TestPlaceOnRays:
    """A body is put where it looks most like the picture."""

    body = np.random.default_rng(4).uniform(-0.5, 0.5, (6, 12, 3))

    def rays(self, place):
        points = self.body + place
        return points / points[..., 2:]

    @pytest.mark.parametrize("place", [(0.0, 0.0, 3.0), (1.0, -0.5, 6.0), (-2.0, 1.0, 4.0)])
    def test_the_place_is_found(self, place):
        found = place_on_rays(self.body, self.rays(np.array(place)), np.ones((6, 12)))
        assert np.allclose(found, place)

    def test_what_is_missing_is_left_out(self):
        rays, body = self.rays(np.array([0.3, 0.1, 3.0])), self.body.copy()
        rays[0, :4], body[1, 5:9] = np.nan, np.nan
        assert np.allclose(place_on_rays(body, rays, np.ones((6, 12))), [0.3, 0.1, 3.0])

    def test_weights_count(self):
        rays, weight = self.rays(np.array([0.3, 0.1, 3.0])), np.ones((6, 12))
        rays[:, 0, :2] += 0.3
        weight[:, 0] = 0.0
        assert np.allclose(place_on_rays(self.body, rays, weight), [0.3, 0.1, 3.0])

    def test_too_little_to_tell(self):
        rays, weight = self.rays(np.array([0.3, 0.1, 3.0])), np.zeros((6, 12))
        weight[:, :2] = 1.0
        assert np.isnan(place_on_rays(self.body, rays, weight)).all()

    def test_a_body_that_fits_only_behind_the_camera(self):
        mirrored = -self.rays(np.array([0.0, 0.0, 3.0]))
        mirrored[..., 2] = 1.0
        assert np.isnan(place_on_rays(self.body, mirrored, np.ones((6, 12)))).all()
