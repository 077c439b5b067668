"""Geometry and decoding of BlazePose, and the networks on sample pictures."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.errors import BackendUnavailable
from engine.pose.blazepose import (
    CROP_SIZE_PX,
    MODEL_DIR,
    BlazePoseNetworks,
    PoseFollower,
    Region,
    crop_matrix,
    decode_detections,
    estimate_sigma_px,
    hold_region,
    make_anchors,
    merge_detections,
    refine_by_heatmap,
    region_from_points,
)
from engine.skeletons import MEDIAPIPE_33
from tests.engine.pose.scenes import SAMPLES, read_images

PEER = json.loads((Path(__file__).parent / "mediapipe_landmarks.json").read_text())["pictures"]


# Detector


def test_anchors_of_the_three_grids():
    anchors = make_anchors()
    assert anchors.shape == (2254, 2)
    assert 28 * 28 * 2 + 14 * 14 * 2 + 7 * 7 * 6 == 2254
    # Two anchors a cell, x before y, rows from the top.
    np.testing.assert_allclose(anchors[:2], [[0.5 / 28, 0.5 / 28]] * 2)
    np.testing.assert_allclose(anchors[2], [1.5 / 28, 0.5 / 28])
    np.testing.assert_allclose(anchors[2 * 28], [0.5 / 28, 1.5 / 28])
    np.testing.assert_allclose(anchors[1568], [0.5 / 14, 0.5 / 14])
    np.testing.assert_allclose(anchors[-6:], [[6.5 / 7, 6.5 / 7]] * 6)


def test_detection_by_hand():
    anchors = np.array([[0.5, 0.25], [0.1, 0.1]])
    raw = np.zeros((2, 12), np.float32)
    # Centre 22.4 px right of the anchor, 44.8 px wide, 22.4 px high; first key point 11.2 px up.
    raw[0, :6] = 22.4, 0.0, 44.8, 22.4, 0.0, -11.2
    rows, scores = decode_detections(raw, np.array([0.0, -3.0], np.float32), anchors)
    np.testing.assert_allclose(scores, [0.5])
    np.testing.assert_allclose(rows[0, :4], [0.5, 0.2, 0.7, 0.3], atol=1e-6)
    np.testing.assert_allclose(rows[0, 4:8], [0.5, 0.2, 0.5, 0.25], atol=1e-6)


def test_overlapping_detections_become_their_weighted_mean():
    rows = np.zeros((3, 12))
    rows[0, :4], rows[1, :4], rows[2, :4] = (0, 0, 1, 1), (0, 0, 1, 0.8), (2, 2, 3, 3)
    rows[:, 4] = 1.0, 2.0, 7.0
    merged = merge_detections(rows, np.array([0.9, 0.6, 0.7]))
    assert [score for _, score in merged] == [0.9, 0.7]
    assert merged[0][0][3] == pytest.approx((0.9 * 1 + 0.6 * 0.8) / 1.5)
    assert merged[0][0][4] == pytest.approx((0.9 * 1 + 0.6 * 2) / 1.5)
    assert merged[1][0][4] == 7.0
    assert merge_detections(np.empty((0, 12)), np.empty(0)) == []


# Regions


@pytest.mark.parametrize(
    ("rim", "degrees"),
    [((100, 50), 0), ((150, 100), 90), ((50, 100), -90), ((100 + 50, 100 - 50), 45)],
    ids=["upright", "to the right", "to the left", "oblique"],
)
def test_region_of_a_circle(rim, degrees):
    region = region_from_points(np.array([100.0, 100.0]), np.array(rim, float))
    assert (region.x, region.y) == (100, 100)
    assert region.size == pytest.approx(2.5 * math.dist((100, 100), rim))
    assert math.degrees(region.angle) == pytest.approx(degrees)


regions = st.builds(
    Region, st.floats(-500, 2000), st.floats(-500, 2000), st.floats(20, 3000), st.floats(-3.1, 3.1)
)


@given(region=regions)
def test_crop_map_is_a_turned_square_around_the_centre(region):
    matrix = crop_matrix(region, 256)
    corners = matrix @ np.array([[0, 256, 256, 0], [0, 0, 256, 256], [1, 1, 1, 1]], float)
    np.testing.assert_allclose(corners.mean(axis=1), [region.x, region.y], atol=1e-6)
    sides = np.linalg.norm(np.diff(corners, axis=1), axis=0)
    np.testing.assert_allclose(sides, region.size, rtol=1e-9)
    up = matrix @ np.array([128.0, 0.0, 1.0]) - [region.x, region.y]
    expected = [math.sin(region.angle), -math.cos(region.angle)]
    np.testing.assert_allclose(up / (region.size / 2), expected, atol=1e-9)


def test_region_stays_while_the_next_one_is_near():
    held = Region(100, 100, 200, 0.0)
    assert hold_region(None, held) is held
    assert hold_region(held, Region(105, 100, 206, 0.05)) is held
    for far in (Region(107, 100, 200), Region(100, 100, 210), Region(100, 100, 200, -0.1)):
        assert hold_region(held, far) is far
    # The angle goes round.
    turned = Region(100, 100, 200, math.pi - 0.01)
    assert hold_region(turned, Region(100, 100, 200, -math.pi + 0.01)) is turned


# Landmarks


def test_heat_map_moves_a_point_to_the_centre_of_mass():
    heatmap = np.full((64, 64, 3), -20.0, np.float32)
    heatmap[20, 30, 0] = heatmap[20, 32, 0] = heatmap[22, 31, 0] = 20.0
    heatmap[20, 30, 1] = -0.1  # never reaches one half
    heatmap[0, 0, 2] = 20.0  # at the border
    points = np.array([[31.5, 20.5], [31.5, 20.5], [1.5, 2.5]]) / 64
    refined = refine_by_heatmap(points, heatmap) * 64
    np.testing.assert_allclose(refined[0], [31.0, (20 + 20 + 22) / 3], atol=1e-3)
    np.testing.assert_allclose(refined[1], [31.5, 20.5])
    np.testing.assert_allclose(refined[2], [0.0, 0.0], atol=1e-3)


def test_points_outside_the_crop_stay():
    heatmap = np.full((64, 64, 2), 20.0, np.float32)
    points = np.array([[1.2, 0.5], [0.5, -0.1]])
    np.testing.assert_allclose(refine_by_heatmap(points, heatmap), points)


def test_standard_error_grows_as_confidence_falls():
    confidence = np.array([1.0, 0.7, 0.35, 0.0])
    sigma_px = estimate_sigma_px(confidence, Region(0, 0, 400))
    np.testing.assert_allclose(sigma_px, [3.6, 3.6, (3.6 + 20) / 2, 20])


@pytest.mark.parametrize("content", [None, b"half a file"], ids=["missing", "damaged"])
def test_missing_network_says_so(tmp_path, content):
    if content is not None:
        (tmp_path / "pose_landmark_heavy.onnx").write_bytes(content)
    with pytest.raises(BackendUnavailable, match=r"pose_landmark_heavy\.onnx .* install LiftLens"):
        BlazePoseNetworks(model_dir=tmp_path)


def test_networks_and_licence_are_shipped():
    assert {p.name for p in MODEL_DIR.iterdir()} >= {
        "pose_detector.onnx",
        "pose_landmark_heavy.onnx",
        "pose_landmark_full.onnx",
        "README.md",
        "LICENSE",
    }


# The networks on pictures


@pytest.fixture(scope="module")
def heavy():
    return BlazePoseNetworks("heavy", threads=1)


@pytest.fixture(scope="module")
def picture():
    return read_images(SAMPLES / "floor_to_knuckle" / "cam90.mp4", 61)[60]


def region_in(networks, image):
    found = networks.detect(image)
    first = networks.find_landmarks(image, region_from_points(*found[0].points[:2]))
    return first.next_region


def sure(*landmarks):
    return np.min([np.minimum(s.visibility, s.presence) for s in landmarks], axis=0) > 0.8


@pytest.mark.model
@pytest.mark.parametrize("name", PEER)
def test_still_picture_gives_the_landmarks_of_mediapipe(heavy, name):
    path, index = name.split()
    image = read_images(SAMPLES / path, int(index) + 1)[int(index)]
    found = heavy.detect(image)
    ours = heavy.find_landmarks(image, region_from_points(*found[0].points[:2]))
    px = np.linalg.norm(ours.image - np.array(PEER[name]["image_px"]), axis=1)
    mm = 1000 * np.linalg.norm(ours.world - np.array(PEER[name]["world_m"]), axis=1)
    assert np.median(px) < 0.2
    assert np.percentile(px, 90) < 1.0
    assert np.median(mm) < 3.0


@pytest.mark.model
def test_person_is_seen_where_the_truth_is(heavy, picture):
    truth = np.load(SAMPLES / "floor_to_knuckle" / "truth.npz")
    subject = json.loads((SAMPLES / "floor_to_knuckle" / "subject.json").read_text())
    camera = subject["calibration"][0]
    at_s = truth["video_time"][60]
    names = list(truth["joint_names"])
    seen = heavy.find_landmarks(picture, region_in(heavy, picture))
    for ours, theirs in (("right_wrist", "wrist_R"), ("right_knee", "knee_R"), ("nose", "nose")):
        joint = truth["joints"][:, names.index(theirs)]
        point = [np.interp(at_s, truth["time"], joint[:, axis]) for axis in range(3)]
        x = np.array(camera["K"]) @ (np.array(camera["R"]) @ point + np.array(camera["t"]))
        distance = np.linalg.norm(seen.image[MEDIAPIPE_33.index(ours)] - x[:2] / x[2])
        assert distance < 12, ours  # about 6 cm; joint centres aren't keypoints


@pytest.mark.model
def test_mirrored_picture_exchanges_left_and_right(heavy, picture):
    region = region_in(heavy, picture)
    last = picture.shape[1] - 1
    seen = heavy.find_landmarks(picture, region)
    mirrored = heavy.find_landmarks(
        np.ascontiguousarray(picture[:, ::-1]),
        Region(last - region.x, region.y, region.size, -region.angle),
    )
    order = list(MEDIAPIPE_33.mirror_order)
    back = mirrored.image[order] * [-1, 1] + [last, 0]
    distance = np.linalg.norm(seen.image - back, axis=1)
    is_sure = sure(seen) & (np.minimum(mirrored.visibility, mirrored.presence)[order] > 0.8)
    assert is_sure.sum() > 10
    assert np.median(distance[is_sure]) < 4
    world = mirrored.world[order] * [-1, 1, 1]
    assert np.median(np.linalg.norm(seen.world - world, axis=1)[is_sure]) < 0.06


@pytest.mark.model
@pytest.mark.parametrize("quarter_turns", [1, 3])
def test_turned_picture_gives_turned_landmarks(heavy, picture, quarter_turns):
    code = {1: cv2.ROTATE_90_CLOCKWISE, 3: cv2.ROTATE_90_COUNTERCLOCKWISE}[quarter_turns]
    region = region_in(heavy, picture)
    height, width = picture.shape[:2]

    def turn(points):
        x, y = points[:, 0], points[:, 1]
        pair = (height - 1 - y, x) if quarter_turns == 1 else (y, width - 1 - x)
        return np.stack(pair, axis=1)

    (x, y), angle = turn(np.array([[region.x, region.y]]))[0], quarter_turns * math.pi / 2
    seen = heavy.find_landmarks(picture, region)
    turned = heavy.find_landmarks(
        cv2.rotate(picture, code), Region(x, y, region.size, region.angle + angle)
    )
    distance = np.linalg.norm(turn(seen.image) - turned.image, axis=1)
    assert np.median(distance[sure(seen, turned)]) < 1.5
    # The world landmarks turn with the picture, about the viewing direction.
    wx, wy, wz = seen.world.T
    expected = np.stack([-wy, wx, wz] if quarter_turns == 1 else [wy, -wx, wz], axis=1)
    assert np.median(np.linalg.norm(turned.world - expected, axis=1)[sure(seen, turned)]) < 0.03


@pytest.mark.model
def test_follower_keeps_its_region_and_gives_up_an_empty_room(heavy, picture):
    follower = PoseFollower(heavy)
    assert follower.update(picture) is not None
    region = follower.region
    assert follower.update(picture) is not None
    assert follower.region is region
    room = np.full_like(picture, 120)
    assert follower.update(room) is None
    assert follower.region is None
    follower.update(picture)
    follower.restart()
    assert follower.region is None


@pytest.mark.model
def test_full_variant_agrees_with_heavy(heavy, picture):
    full = BlazePoseNetworks("full", threads=1)
    region = region_in(heavy, picture)
    a, b = heavy.find_landmarks(picture, region), full.find_landmarks(picture, region)
    distance = np.linalg.norm(a.image - b.image, axis=1)
    assert 0 < np.median(distance[sure(a, b)]) < 0.05 * CROP_SIZE_PX
    assert full.model_time_s > 0
