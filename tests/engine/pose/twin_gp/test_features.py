"""Crops, landmarks and pictures become rows of numbers; what is missing stays visible."""

from __future__ import annotations

import numpy as np
import pytest

from engine.datatypes import Frame
from engine.errors import ConfigError, DataError, ShapeError
from engine.pose.twin_gp import (
    FEATURES,
    Crop,
    HogSettings,
    combine_features,
    describe_landmarks,
    describe_picture,
    describe_video,
    fixed_crop,
)


def test_the_crop_is_around_all_boxes_with_a_margin():
    boxes = np.array([[100, 50, 200, 250], [150, 60, 300, 240], [np.nan] * 4])
    assert fixed_crop(boxes, (640, 480)) == Crop(80, 30, 320, 270, (640, 480))
    assert fixed_crop(boxes, (310, 260)) == Crop(80, 30, 310, 260, (310, 260))


def test_a_crop_needs_a_person():
    with pytest.raises(DataError, match="at least one box"):
        fixed_crop(np.full((3, 4), np.nan), (640, 480))
    with pytest.raises(ShapeError, match=r"\(T, 4\)"):
        fixed_crop(np.zeros(4), (640, 480))
    with pytest.raises(DataError, match="inside its picture"):
        Crop(0, 0, 700, 10, (640, 480))


@pytest.mark.parametrize("name", ["hog", "hog-soft", "hog-paper"])
def test_pictures_become_rows_of_length_one(name):
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (3, 96, 64, 3)).astype(np.uint8)
    frames = [Frame(i, i / 30, image) for i, image in enumerate(images)]
    rows = describe_video(frames, Crop(4, 4, 60, 90, (64, 96)), FEATURES[name].hog)
    assert rows.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1.0, rtol=1e-5)
    assert np.linalg.norm(rows[0] - rows[1]) > 0.1


def test_what_is_outside_the_crop_does_not_count():
    image = np.random.default_rng(1).integers(0, 256, (96, 64, 3)).astype(np.uint8)
    other = image.copy()
    other[:, 50:] = 0
    crop = Crop(0, 0, 48, 96, (64, 96))
    one, same = (describe_picture(i, crop, HogSettings()) for i in (image, other))
    np.testing.assert_array_equal(one, same)


def test_a_picture_of_another_size_is_refused():
    with pytest.raises(DataError, match="64 x 96 px, as the crop was made for, got 96 x 96"):
        describe_picture(np.zeros((96, 96, 3), np.uint8), Crop(0, 0, 9, 9, (64, 96)), HogSettings())
    with pytest.raises(DataError, match="got none"):
        describe_video([], None, HogSettings())


def test_landmarks_do_not_depend_on_the_resolution():
    position = np.random.default_rng(2).uniform(0, 400, (8, 33, 2))
    small = describe_landmarks(position, (720, 480))
    np.testing.assert_allclose(describe_landmarks(2 * position, (1440, 960)), small, atol=1e-6)


def test_neighbouring_frames_lend_their_landmarks():
    position = np.tile(np.arange(8.0)[:, None, None], (1, 33, 2))
    plain = describe_landmarks(position, (2, 1))
    wide = describe_landmarks(position, (2, 1), window=1)
    k = plain.shape[1]
    assert wide.shape == (8, 3 * k)
    np.testing.assert_array_equal(wide[:, k : 2 * k], plain)
    np.testing.assert_array_equal(wide[3, :k], plain[1])
    np.testing.assert_array_equal(wide[3, 2 * k :], plain[5])
    np.testing.assert_array_equal(wide[7, 2 * k :], plain[7])  # the clip's end repeats


def test_short_gaps_are_bridged_and_what_is_never_seen_is_missing():
    position = np.tile(np.arange(6.0)[:, None, None], (1, 33, 2))
    holes = position.copy()
    holes[2:4] = np.nan
    np.testing.assert_allclose(
        describe_landmarks(holes, (2, 1)), describe_landmarks(position, (2, 1)), atol=1e-6
    )
    assert np.isnan(describe_landmarks(np.full((6, 33, 2), np.nan), (2, 1))).all()


def test_blocks_tell_hog_from_landmarks():
    hog = [np.eye(4, 5, dtype=np.float32), np.eye(4, 5, dtype=np.float32)]
    landmarks = [np.full((4, 3), 7, dtype=np.float32)]
    rows, blocks = combine_features(hog=hog, landmarks=landmarks)
    assert blocks == (10, 3)
    np.testing.assert_allclose(np.linalg.norm(rows[:, :10], axis=1), 1.0)
    np.testing.assert_array_equal(rows[:, 10:], 7)
    with pytest.raises(ConfigError, match="at least one view"):
        combine_features()
    with pytest.raises(ShapeError, match="same number of frames, got 4, 3"):
        combine_features(hog=hog, landmarks=[landmarks[0][:3]])
