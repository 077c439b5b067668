"""Truth: points are projected first, then moved as the picture is scaled, cropped or turned."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from engine.cameras.picture import adapt_to_picture
from engine.datatypes import Camera, CheckLevel
from engine.optics import project

UP = np.array([0.0, 1.0, 0.0])


def camera(size_px=(1920, 1080), *, roll_deg=0.0):
    level = np.diag([1.0, -1.0, -1.0])
    rotation = Rotation.from_euler("z", roll_deg, degrees=True).as_matrix() @ level
    focal = 0.8 * max(size_px)
    matrix = np.array(
        [[focal, 0, size_px[0] / 2 + 9], [0, focal * 1.01, size_px[1] / 2 - 7], [0, 0, 1]]
    )
    return Camera(
        "cam",
        size_px,
        matrix,
        rotation,
        np.array([0.1, 0.2, 4.0]),
        [-0.1, 0.03, 0.002, -0.001, 0.01],
    )


POINTS = np.random.default_rng(0).uniform(-0.6, 0.6, (20, 3))


def test_equal_sizes_change_nothing():
    one = camera()
    assert adapt_to_picture(one, (1920, 1080)) == (one, None)


@given(st.sampled_from([(1280, 720), (3840, 2160), (960, 540), (854, 480), (640, 360), (426, 240)]))
def test_scaled_pictures_scale_the_points(size):
    adapted, check = adapt_to_picture(camera(), size)
    scale = np.array(size) / [1920, 1080]
    assert np.allclose(project(adapted, POINTS) + 0.5, (project(camera(), POINTS) + 0.5) * scale)
    assert check.level is CheckLevel.GREEN
    assert f"{size[0]} x {size[1]}" in check.sentence


def padded_picture(size_px, bars_px):
    picture = np.full((size_px[1], size_px[0], 3), 120, np.uint8)
    picture[:bars_px] = picture[-bars_px:] = 3
    return picture


def test_black_bars_tell_a_padded_picture():
    """As the real clip: 1088 wide shrunk to 1080, with 7 px of black above and below."""
    one = camera((1088, 1920))
    adapted, check = adapt_to_picture(one, (1080, 1920), picture=padded_picture((1080, 1920), 7))
    scale = 1080 / 1088
    moved = (project(one, POINTS) + 0.5) * scale + [0.0, (1920 - scale * 1920) / 2] - 0.5
    assert np.allclose(project(adapted, POINTS), moved)
    assert check.level is CheckLevel.AMBER
    assert "black bars of 7 px" in check.sentence


@pytest.mark.parametrize("picture", [None, np.full((1080, 1920, 3), 120, np.uint8)])
def test_a_wider_video_of_the_same_sensor_is_cropped(picture):
    one = camera((4032, 3024))
    adapted, check = adapt_to_picture(one, (1920, 1080), picture=picture)
    scale = 1920 / 4032
    moved = (project(one, POINTS) + 0.5) * scale - [0.0, (3024 * scale - 1080) / 2] - 0.5
    assert np.allclose(project(adapted, POINTS), moved)
    assert check.level is CheckLevel.AMBER
    assert "cropped" in check.sentence


def test_a_dark_scene_is_not_taken_for_bars():
    dark = np.full((1920, 1080, 3), 6, np.uint8)
    _, check = adapt_to_picture(camera((1088, 1920)), (1080, 1920), picture=dark)
    assert "cropped" in check.sentence


@pytest.mark.parametrize("up", [None, UP])
def test_a_phone_held_the_other_way_is_refused(up):
    one = camera()
    adapted, check = adapt_to_picture(one, (1080, 1920), up=up)
    assert adapted is one
    assert check.level is CheckLevel.RED
    assert "Calibrate" in check.action


@pytest.mark.parametrize("roll_deg", [90, -90, 85, -94])
@pytest.mark.parametrize("size", [(1080, 1920), (540, 960)])
def test_a_picture_that_was_shown_turned_is_turned_upright(roll_deg, size):
    one = camera(roll_deg=roll_deg)
    adapted, check = adapt_to_picture(one, size, up=UP)
    x, y = (project(one, POINTS) + 0.5).T
    # Up is at the picture's left with positive roll: then it has to be turned to the right.
    turned = np.stack([y, 1920 - x] if (one.rotation @ UP)[0] > 0 else [1080 - y, x], axis=1)
    assert np.allclose(project(adapted, POINTS) + 0.5, turned * size[0] / 1080)
    assert -(adapted.rotation @ UP)[1] > 0.99
    assert check.level is CheckLevel.AMBER


def test_too_small_a_part_of_the_picture_is_refused():
    _, check = adapt_to_picture(camera((1080, 1080)), (1920, 540))
    assert check.level is CheckLevel.RED


@given(st.integers(300, 4000), st.integers(300, 4000))
@settings(max_examples=60)
def test_any_size_gives_a_camera_of_it_or_a_red_check(width, height):
    adapted, check = adapt_to_picture(camera(), (width, height), up=UP)
    if check is None or check.level is not CheckLevel.RED:
        assert adapted.size_px == (width, height)
        assert np.isfinite(project(adapted, POINTS)).all()
