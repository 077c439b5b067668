"""Drawing a surface into a picture."""

from __future__ import annotations

import numpy as np
import pytest

from engine.errors import ShapeError
from engine.video.mesh_overlay import SURFACE, draw_mesh

SQUARE = np.array([[20.0, 20, 5], [60, 20, 5], [60, 60, 5], [20, 60, 5]])
TOWARDS = np.array([[0, 2, 1], [0, 3, 2]], dtype=np.int32)


def draw(points, faces=TOWARDS, **options):
    image = np.full((80, 80, 3), 100, np.uint8)
    draw_mesh(image, np.asarray(points, dtype=np.float64), faces, **options)
    return image


def test_a_face_towards_the_camera_is_mixed_in():
    image = draw(SQUARE, opacity=0.5)
    np.testing.assert_allclose(image[40, 40], (np.array(SURFACE) + 100) / 2, atol=1)
    assert (image[10, 10] == 100).all()
    assert (image[70, 70] == 100).all()


def test_a_face_turned_away_is_not_seen():
    assert (draw(SQUARE, TOWARDS[:, ::-1]) == 100).all()


def test_the_nearer_face_covers_the_farther_one():
    tilted = SQUARE * (1, 1, 1) + np.outer([0, 1, 1, 0], (0.0, 0.0, 30.0)) + (0, 0, 50)
    both = np.concatenate([tilted, SQUARE])
    for faces in (np.concatenate([TOWARDS, TOWARDS + 4]), np.concatenate([TOWARDS + 4, TOWARDS])):
        np.testing.assert_array_equal(draw(both, faces)[40, 40], draw(SQUARE)[40, 40])


def test_slanting_faces_are_darker():
    slanted = SQUARE + np.outer([0, 1, 1, 0], (0.0, 0.0, 60.0))
    assert draw(slanted)[40, 40].sum() < draw(SQUARE)[40, 40].sum()


def test_nothing_is_drawn_of_a_person_who_was_not_seen():
    assert (draw(SQUARE * np.nan) == 100).all()


def test_far_outside_the_picture_nothing_breaks():
    assert (draw(SQUARE + np.array([1e9, 0, 0])) == 100).all()


def test_wrong_shapes_are_named():
    with pytest.raises(ShapeError, match=r"\(4, 2\)"):
        draw(SQUARE[:, :2])
