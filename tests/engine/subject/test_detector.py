"""Decoding of the person detector, and the detector on sample pictures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.errors import BackendUnavailable
from engine.subject.detector import (
    INPUT_SIZE_PX,
    N_BINS,
    STRIDES,
    PersonDetector,
    decode_persons,
    letterbox,
    suppress_overlaps,
)
from tests.engine.pose.scenes import SAMPLES, read_images

CELLS = [(INPUT_SIZE_PX // s) ** 2 for s in STRIDES]


def empty_outputs():
    scores = [np.zeros((n, 80), np.float32) for n in CELLS]
    distances = [np.zeros((n, 4 * N_BINS), np.float32) for n in CELLS]
    return scores, distances


@given(width=st.integers(16, 8000), height=st.integers(16, 8000))
def test_letterbox_fits_centres_and_goes_back(width, height):
    scale, left, top = letterbox(width, height)
    corner = np.array([width * scale + left, height * scale + top])
    assert left >= -1e-9
    assert top >= -1e-9
    assert max(corner) <= INPUT_SIZE_PX + 1e-6
    assert min(left, top) == pytest.approx(0, abs=1e-9)
    assert width * scale + 2 * left == pytest.approx(INPUT_SIZE_PX)
    assert height * scale + 2 * top == pytest.approx(INPUT_SIZE_PX)


@pytest.mark.parametrize("level", range(3))
def test_box_of_one_cell_by_hand(level):
    scores, distances = empty_outputs()
    stride, column, row = STRIDES[level], 5, 3
    cell = row * (INPUT_SIZE_PX // stride) + column
    scores[level][cell, 0] = 0.8
    # All weight on bins 1, 2, 3 and, half each, on 4 and 5.
    for side, bins in enumerate(([1], [2], [3], [4, 5])):
        for b in bins:
            distances[level][cell, side * N_BINS + b] = 80.0
    boxes, confidence = decode_persons(scores, distances, threshold=0.5)
    x, y = (column + 0.5) * stride, (row + 0.5) * stride
    expected = [x - stride, y - 2 * stride, x + 3 * stride, y + 4.5 * stride]
    np.testing.assert_allclose(boxes, [expected])
    np.testing.assert_allclose(confidence, [0.8])


def test_other_classes_and_faint_persons_are_dropped():
    scores, distances = empty_outputs()
    scores[0][7, 56] = 0.9  # a chair
    scores[1][7, 0] = 0.29
    boxes, confidence = decode_persons(scores, distances, threshold=0.3)
    assert boxes.shape == (0, 4)
    assert confidence.shape == (0,)


def test_of_overlapping_boxes_the_best_stays():
    boxes = np.array([[0, 0, 10, 10], [0, 0, 10, 9], [0, 0, 10, 5], [50, 50, 60, 60]], float)
    scores = np.array([0.5, 0.9, 0.6, 0.3])
    # Second with first: 0.9, dropped; second with third: 5 / 9 = 0.56, under 0.6.
    assert suppress_overlaps(boxes, scores, iou=0.6).tolist() == [1, 2, 3]
    assert suppress_overlaps(boxes, scores, iou=0.5).tolist() == [1, 3]
    assert suppress_overlaps(np.empty((0, 4)), np.empty(0)).tolist() == []


@pytest.mark.parametrize("content", [None, b"not a network"], ids=["missing", "damaged"])
def test_missing_network_says_so(tmp_path, content):
    path = tmp_path / "coco_nanodet_g_416.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(BackendUnavailable, match=r"coco_nanodet_g_416\.onnx"):
        PersonDetector(model_path=path)


@pytest.fixture(scope="module")
def detector():
    return PersonDetector(threads=1)


@pytest.fixture(scope="module")
def picture():
    return read_images(SAMPLES / "floor_to_knuckle" / "cam90.mp4", 1)[0]


@pytest.mark.model
def test_person_is_found_where_they_stand(detector, picture):
    truth = np.load(SAMPLES / "floor_to_knuckle" / "truth.npz")
    assert truth["time"][0] == 0
    before = detector.model_time_s
    best = detector(picture)[0]
    assert detector.model_time_s > before
    # The person stands upright in the middle; measured in the picture by eye.
    np.testing.assert_allclose(
        [best.left, best.top, best.right, best.bottom], [287, 70, 352, 412], atol=15
    )


@pytest.mark.model
def test_mirrored_picture_gives_mirrored_box(detector, picture):
    box = detector(picture)[0]
    mirrored = detector(np.ascontiguousarray(picture[:, ::-1]))[0]
    width = picture.shape[1]
    np.testing.assert_allclose(
        [width - mirrored.right, width - mirrored.left], [box.left, box.right], atol=6
    )


@pytest.mark.model
def test_empty_room_and_odd_sizes(detector, picture):
    for shape in ((480, 720), (37, 2000), (16, 16)):
        assert detector(np.full((*shape, 3), 90, np.uint8)) == []
    # Upright strip with the person: letterboxed on both sides.
    assert len(detector(picture[:, 230:430])) >= 1
