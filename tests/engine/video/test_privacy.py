"""Covering heads: what is covered, when, and that it can't be undone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.datatypes import PersonBox
from engine.video.privacy import BlurRegion, blur_regions, estimate_head_regions
from tests.engine.video import clips

PX_PER_M = 110.0
STANDING_BOX = (110.0, 15.0, 190.0, 225.0)


def is_covered(regions, x: float, y: float) -> bool:
    """Whether the pixel around a point is covered, by doing it."""
    image = np.zeros((400, 600, 3), np.uint8)
    column, row = round(x) + 100, round(y) + 100
    image[row - 1 : row + 2, column - 1 : column + 2] = 255
    shifted = [
        BlurRegion(r.left + 100, r.top + 100, r.right + 100, r.bottom + 100, r.is_round)
        for r in regions
    ]
    blur_regions(image, shifted)
    return bool(image[row, column].max() < 255)


# --- the covering itself ---------------------------------------------------------------------

BOUND = st.floats(min_value=-40, max_value=140)


@settings(max_examples=60, deadline=None)
@given(x=BOUND, y=BOUND, width=st.floats(1, 120), height=st.floats(1, 120), round_=st.booleans())
def test_nothing_outside_changes_and_everything_inside_does(x, y, width, height, round_) -> None:
    region = BlurRegion(x, y, x + width, y + height, is_round=round_)
    rows, columns = np.mgrid[:100, :100] + 0.5
    across = np.abs(columns - (x + width / 2)) / (width / 2)
    down = np.abs(rows - (y + height / 2)) / (height / 2)
    if round_:
        inside = across**2 + down**2 <= 1
        far = (
            np.hypot(
                np.maximum(0, across * width / 2) / (width / 2 + 2),
                np.maximum(0, down * height / 2) / (height / 2 + 2),
            )
            > 1
        )
    else:
        inside = (across <= 1) & (down <= 1)
        far = (across > 1 + 4 / width) | (down > 1 + 4 / height)
    image = clips.noise_image(100, 100)
    image[::2, ::2] = 255
    before = image.copy()
    blur_regions(image, [region])
    assert np.array_equal(image[far], before[far])
    if inside.sum() > 200:
        assert np.mean(np.any(image != before, axis=2)[inside]) > 0.97


def test_detail_can_not_be_computed_back() -> None:
    """Pictures that differ in every detail, but not in their mean colours, come out alike."""
    rows, columns = np.mgrid[:120, :120]
    board = (((rows + columns) % 2) * 200).astype(np.uint8)
    one = np.repeat(board[:, :, None], 3, axis=2)
    other = 200 - one
    for image in (one, other):
        blur_regions(image, [BlurRegion(0, 0, 120, 120, is_round=False)])
    assert np.abs(one.astype(int) - other).max() <= 1
    assert one.std() < 2


@pytest.mark.parametrize("side", [12, 40, 120, 400])
def test_a_face_keeps_five_by_five_colours_at_most(side: int) -> None:
    """What is left is a 5 x 5 picture: 25 numbers explain every pixel."""
    rng = np.random.default_rng(3)
    flat = []
    for _ in range(40):
        coarse = rng.integers(0, 256, (9, 9, 3), dtype=np.uint8)
        image = cv2.resize(coarse, (side, side), interpolation=cv2.INTER_NEAREST)
        blur_regions(image, [BlurRegion(0, 0, side, side, is_round=False)])
        flat.append(image[:, :, 0].ravel().astype(float))
    centred = np.array(flat) - np.mean(flat, axis=0)
    strengths = np.linalg.svd(centred, compute_uv=False)
    assert strengths[25:].sum() < 0.1 * strengths.sum()  # rounding to whole grey values


def test_regions_off_the_picture_are_ignored() -> None:
    image = clips.noise_image(50, 50)
    before = image.copy()
    blur_regions(image, [BlurRegion(-30, -30, -1, 20), BlurRegion(60, 0, 90, 90)])
    assert np.array_equal(image, before)


def test_scaling_and_growing() -> None:
    region = BlurRegion.around(100.0, 60.0, 20.0)
    assert region.scaled(0.5) == BlurRegion(40, 20, 60, 40)
    assert region.grown(2.0) == BlurRegion(60, 20, 140, 100)


# --- where heads are -------------------------------------------------------------------------


def project_person(yaw_deg: float, trunk_deg: float, neck_deg: float):
    """Return keypoints and outline of the head of an adult, seen from far away.

    Axes of the person: x forward, y up, z right; turned by `yaw_deg` to the camera, the trunk bent
    forward by `trunk_deg`, the head by `neck_deg` against it.
    """
    ears = [(0.0, 0.0, -0.0775), (0.0, 0.0, 0.0775)]
    head = {
        "left_ear": ears[0],
        "right_ear": ears[1],
        "nose": (0.12, -0.02, 0.0),
        "left_eye": (0.09, 0.03, -0.032),
        "right_eye": (0.09, 0.03, 0.032),
        "left_mouth": (0.10, -0.07, -0.025),
        "right_mouth": (0.10, -0.07, 0.025),
    }
    outline = [
        (0.0, 0.155, 0.0),  # vertex with hair
        (0.09, 0.10, 0.0),  # forehead
        (0.13, -0.02, 0.0),  # tip of the nose
        (0.09, -0.12, 0.0),  # chin
        (-0.12, 0.04, 0.0),  # occiput with hair
        (0.0, 0.02, -0.095),
        (0.0, 0.02, 0.095),
    ]
    trunk = {
        "left_shoulder": (0.0, 0.52, -0.18),
        "right_shoulder": (0.0, 0.52, 0.18),
        "left_hip": (0.0, 0.0, -0.14),
        "right_hip": (0.0, 0.0, 0.14),
    }

    def bend(point, angle_deg):
        a = np.deg2rad(angle_deg)
        x, y, z = point
        return np.array([x * np.cos(a) + y * np.sin(a), y * np.cos(a) - x * np.sin(a), z])

    def place(point, in_head):
        p = bend(point, neck_deg) + np.array([0.02, 0.75, 0.0]) if in_head else np.array(point)
        x, y, z = bend(p, trunk_deg)
        a = np.deg2rad(yaw_deg)
        return 150 + PX_PER_M * (x * np.cos(a) + z * np.sin(a)), 130 - PX_PER_M * y

    points = {name: place(p, in_head=True) for name, p in head.items()}
    points |= {name: place(p, in_head=False) for name, p in trunk.items()}
    legs = {"left_knee": (0.0, -0.4, -0.1), "right_knee": (0.0, -0.4, 0.1)}
    for name, (x, y, z) in legs.items():
        a = np.deg2rad(yaw_deg)
        points[name] = (150 + PX_PER_M * (x * np.cos(a) + z * np.sin(a)), 130 - PX_PER_M * y)
    return points, [place(p, in_head=True) for p in outline]


def box_around(points, outline, margin: float = 8.0):
    xy = np.array([*points.values(), *outline, (150, 130 + 0.86 * PX_PER_M)])
    return (*(xy.min(axis=0) - margin), *(xy.max(axis=0) + margin))


POSTURES = {
    "yaw_deg": st.floats(-180, 180),
    "trunk_deg": st.floats(0, 120),
    "neck_deg": st.floats(-30, 45),
}


@settings(max_examples=150, deadline=None)
@given(**POSTURES)
def test_the_whole_head_is_covered_however_the_person_stands(yaw_deg, trunk_deg, neck_deg) -> None:
    points, outline = project_person(yaw_deg, trunk_deg, neck_deg)
    pose = clips.make_pose(points, n_frames=2, box=box_around(points, outline))
    (regions, _) = estimate_head_regions(pose)
    assert len(regions) == 1
    assert all(is_covered(regions, x, y) for x, y in outline)
    assert regions[0].right - regions[0].left < 0.6 * PX_PER_M  # generous, not everything


HIDDEN = ("left_ear", "right_ear", "nose", "left_eye", "right_eye", "left_mouth", "right_mouth")


@settings(max_examples=150, deadline=None)
@given(**POSTURES)
def test_a_head_without_keypoints_is_covered_from_box_and_trunk(
    yaw_deg, trunk_deg, neck_deg
) -> None:
    points, outline = project_person(yaw_deg, trunk_deg, neck_deg)
    body = {name: p for name, p in points.items() if name not in HIDDEN}
    pose = clips.make_pose(body, n_frames=2, box=box_around(points, outline))
    (regions, _) = estimate_head_regions(pose)
    assert all(is_covered(regions, x, y) for x, y in outline)


@settings(max_examples=100, deadline=None)
@given(**POSTURES)
def test_a_head_is_covered_when_only_the_box_is_known(yaw_deg, trunk_deg, neck_deg) -> None:
    points, outline = project_person(yaw_deg, trunk_deg, neck_deg)
    pose = clips.make_pose({}, n_frames=2, box=box_around(points, outline))
    (regions, _) = estimate_head_regions(pose)
    assert all(is_covered(regions, x, y) for x, y in outline)


def test_doubtful_keypoints_do_not_lead_the_cover_away() -> None:
    points, outline = project_person(90, 0, 0)
    box = box_around(points, outline)
    astray = {n: (p[0] + 90, p[1] + 60) if n in HIDDEN else p for n, p in points.items()}
    pose = clips.make_pose(astray, box=box, confidence=0.1)
    regions = estimate_head_regions(pose)[10]
    assert all(is_covered(regions, x, y) for x, y in outline)


def test_a_head_far_from_its_person_is_not_believed() -> None:
    points, outline = project_person(90, 0, 0)
    astray = {n: (p[0] + 250, p[1]) if n in HIDDEN else p for n, p in points.items()}
    pose = clips.make_pose(astray, box=box_around(points, outline), confidence=0.95)
    regions = estimate_head_regions(pose)[10]
    assert all(is_covered(regions, x, y) for x, y in outline)


def test_a_stray_keypoint_does_not_cover_the_picture() -> None:
    points, outline = project_person(90, 0, 0)
    box = box_around(points, outline)
    points["left_knee"] = (3000.0, 2000.0)
    (regions, _) = estimate_head_regions(clips.make_pose(points, n_frames=2, box=box))
    assert regions[0].right - regions[0].left < (box[3] - box[1])


# --- over time -------------------------------------------------------------------------------


def test_a_lost_person_stays_covered_for_a_while_and_before() -> None:
    points, outline = project_person(60, 10, 0)
    present = [2.5 <= i / 30 < 3.5 for i in range(180)]
    pose = clips.make_pose(points, n_frames=180, box=box_around(points, outline), present=present)
    covers = estimate_head_regions(pose, hold_s=2.0)
    for i, regions in enumerate(covers):
        away_s = max(2.5 - i / 30, i / 30 - 104 / 30, 0.0)
        covered = bool(regions) and all(is_covered(regions, x, y) for x, y in outline)
        assert covered == (away_s <= 2.0 + 1e-6), f"{i / 30:.2f} s"


def test_the_cover_follows_a_head_that_moves_while_hidden() -> None:
    points, outline = project_person(60, 10, 0)
    pose = clips.make_pose(points, n_frames=31, box=box_around(points, outline))
    position = pose.image.position.copy()
    box = pose.box.copy()
    shift = np.linspace(0, 60, 31)
    position[:, :, 0] += shift[:, None]
    box[:, [0, 2]] += shift[:, None]
    hidden = slice(8, 23)
    position[hidden], box[hidden] = np.nan, np.nan
    moving = clips.replace_arrays(pose, position, box)
    for i, regions in enumerate(estimate_head_regions(moving)):
        assert all(is_covered(regions, x + shift[i], y) for x, y in outline), i


def test_nobody_seen_means_nothing_covered() -> None:
    assert estimate_head_regions(clips.make_pose(n_frames=5)) == ((),) * 5


def test_others_stay_covered_between_the_looks() -> None:
    """Two bystanders seen every 15th frame, one missed at one look; they walk slowly."""
    n_frames = 61
    others = [()] * n_frames
    for i in range(0, n_frames, 15):
        a = PersonBox(20 + i / 2, 50, 60 + i / 2, 200)
        b = PersonBox(250, 40, 290, 210)
        others[i] = (a,) if i == 30 else (b, a)
    covers = estimate_head_regions(clips.make_pose(n_frames=n_frames, others=tuple(others)))
    for i, regions in enumerate(covers):
        assert is_covered(regions, 40 + i / 2, 65), i
        assert is_covered(regions, 270, 55), i
        assert not is_covered(regions, 150, 120), i


def test_fewer_looks_than_frames_are_allowed() -> None:
    pose = clips.make_pose(n_frames=3, others=((PersonBox(250, 40, 290, 210),),))
    assert all(is_covered(regions, 270, 55) for regions in estimate_head_regions(pose))
