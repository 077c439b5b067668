import numpy as np
import pytest

from engine.corrections import PROVENANCE_KEY, SideSwap, apply_corrections
from engine.errors import ConfigError
from engine.pipeline import assess_pose
from engine.skeletons import MEDIAPIPE_33
from tests.builders import make_trial, make_view_pose


def column(pose, name, part="image"):
    return getattr(pose, part).position[:, MEDIAPIPE_33.index(name)]


@pytest.fixture
def pose():
    return make_view_pose(n_frames=30)


def test_sides_are_exchanged_in_the_stretch_only(pose):
    (fixed,) = apply_corrections([pose], [SideSwap(0.2, 0.5)])
    inside = (pose.image.time_s >= 0.2) & (pose.image.time_s <= 0.5)
    for part in ("image", "body"):
        left, right = column(pose, "left_knee", part), column(pose, "right_knee", part)
        np.testing.assert_array_equal(column(fixed, "left_knee", part)[inside], right[inside])
        np.testing.assert_array_equal(column(fixed, "right_knee", part)[inside], left[inside])
        np.testing.assert_array_equal(column(fixed, "left_knee", part)[~inside], left[~inside])
        np.testing.assert_array_equal(column(fixed, "nose", part), column(pose, "nose", part))


def test_one_limb_alone_can_be_put_right(pose):
    swap = SideSwap(0.0, 1.0, keypoints=("left_wrist",))
    (fixed,) = apply_corrections([pose], [swap])
    np.testing.assert_array_equal(column(fixed, "left_wrist"), column(pose, "right_wrist"))
    np.testing.assert_array_equal(column(fixed, "left_knee"), column(pose, "left_knee"))


def test_the_same_correction_twice_changes_nothing(pose):
    swap = SideSwap(0.1, 0.7)
    (fixed,) = apply_corrections([pose], [swap, swap])
    np.testing.assert_array_equal(fixed.image.position, pose.image.position)
    np.testing.assert_array_equal(fixed.body.position, pose.body.position)


def test_what_was_corrected_is_written_down_and_the_original_stays(pose):
    before = pose.image.position.copy()
    (fixed,) = apply_corrections([pose], [SideSwap(0.2, 0.5)])
    (note,) = fixed.image.provenance[PROVENANCE_KEY]
    assert (note["kind"], note["start_s"], note["end_s"]) == ("side_swap", 0.2, 0.5)
    assert fixed.image.provenance["made_by"] == "tests"
    assert PROVENANCE_KEY not in pose.image.provenance
    np.testing.assert_array_equal(pose.image.position, before)


def test_keypoints_exchanged_by_an_estimator_are_assessed_as_if_they_never_were():
    truth = make_view_pose(n_frames=60)
    (wrong,) = apply_corrections([truth], [SideSwap(0.0, 2.0)])
    (fixed,) = apply_corrections([wrong], [SideSwap(0.0, 2.0)])
    expected, got = assess_pose(make_trial(), truth), assess_pose(make_trial(), fixed)
    np.testing.assert_array_equal(got.angles.value_deg, expected.angles.value_deg)
    assert len(got.views[0].image.provenance[PROVENANCE_KEY]) == 2


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: SideSwap(0.5, 0.2), "start before its end"),
        (lambda: SideSwap(0.0, 1.0, view=1), "no view 2"),
        (lambda: SideSwap(5.0, 6.0), "No picture lies between"),
        (lambda: SideSwap(0.0, 1.0, keypoints=("left_horn",)), "left_horn"),
    ],
)
def test_what_can_not_be_corrected_says_so(pose, make, says):
    with pytest.raises(ConfigError, match=says):
        apply_corrections([pose], [make()])
