"""Keypoints from markers, against the joint centres of the model that made the markers."""

import numpy as np
import pytest

from engine.errors import DataError, ShapeError
from engine.kinematics.markers import keypoints_from_markers
from engine.skeletons import get_skeleton
from tests.engine.kinematics.markers.builders import make_lift


@pytest.mark.parametrize("marker_set", ["synthetic_45", "lifting_45"])
def test_keypoints_lie_at_the_joints_of_the_model(marker_set):
    lift = make_lift(n_frames=20, marker_set=marker_set)
    rec = lift.recording
    track = keypoints_from_markers(rec.time_s, rec.position_m, rec.names)
    centres = lift.model.joint_centres(lift.coordinates)
    skeleton = get_skeleton(track.skeleton)
    # The model's own markers stand only roughly round its joints.
    for joint, within in (("knee", 0.03), ("elbow", 0.04), ("hip", 0.04), ("wrist", 0.05)):
        for side in ("left", "right"):
            own = track.position[:, skeleton.index(f"{side}_{joint}")]
            distance = np.linalg.norm(own - centres[f"{side}_{joint}"], axis=1)
            assert distance.max() < within, (side, joint)
    assert np.isnan(track.position[:, skeleton.index("nose")]).all()
    ears = [track.position[:, skeleton.index(f"{s}_ear")] for s in ("left", "right")]
    assert (ears[1][:, 2] > ears[0][:, 2]).all()
    assert track.provenance["markers"] == marker_set


def test_a_missing_marker_makes_only_its_joint_missing():
    rec = make_lift(n_frames=5).recording
    position = np.array(rec.position_m)
    position[2, rec.names.index("RLEP")] = np.nan
    track = keypoints_from_markers(rec.time_s, position, rec.names)
    gone = np.isnan(track.position[2]).any(axis=1) & np.isfinite(track.position[0]).all(axis=1)
    names = np.array(get_skeleton(track.skeleton).keypoints)[gone]
    assert set(names) == {"right_knee"}


def test_h36m_gets_pelvis_and_thorax():
    rec = make_lift(n_frames=5).recording
    track = keypoints_from_markers(rec.time_s, rec.position_m, rec.names, skeleton="h36m_17")
    skeleton = get_skeleton("h36m_17")
    hips = [track.position[:, skeleton.index(f"{s}_hip")] for s in ("left", "right")]
    np.testing.assert_allclose(
        track.position[:, skeleton.index("pelvis")], sum(hips) / 2, atol=1e-12
    )


def test_wrong_shapes_and_names_are_refused():
    with pytest.raises(ShapeError):
        keypoints_from_markers(np.arange(2.0), np.zeros((2, 3, 3)), ("C7", "T10"))
    with pytest.raises(DataError, match="no known set"):
        keypoints_from_markers(np.arange(2.0), np.zeros((2, 1, 3)), ("toe9",))
