"""Several estimators on the same keypoints."""

import dataclasses
import math

import numpy as np
import pytest

from engine import estimators
from engine.config import PoseConfig
from engine.errors import Cancelled, ConfigError, DataError
from engine.estimators import (
    compare_estimators,
    compare_on_stored,
    lift_keypoints,
    mean_differences,
    outlier_ratio,
)
from engine.pose.base import BackendInfo
from engine.storage.results import read_result, write_result
from tests.builders import make_pose_track, make_trial, make_trial_result, make_view_pose

FLAT = BackendInfo("flat", "Flat", "mediapipe_33", "none", "Halves the depth.", lifts=True)
BROKEN = BackendInfo("broken", "Broken", "mediapipe_33", "none", "Always refuses.", lifts=True)


class Flat:
    info = FLAT

    def __init__(self, config):
        pass

    def estimate(self, frames, view, progress):
        raise NotImplementedError

    def lift(self, pose):
        position = pose.body.position * [1.0, 1.0, 0.5]
        return dataclasses.replace(pose, body=dataclasses.replace(pose.body, position=position))


class Broken(Flat):
    info = BROKEN

    def lift(self, pose):
        raise DataError("Expected 27 frames, got 3.")


@pytest.fixture
def with_fakes(monkeypatch):
    """Offer two estimators that are not part of the product."""
    real_list, real_create = estimators.list_backends, estimators.create_backend
    fakes = {"flat": Flat, "broken": Broken}
    monkeypatch.setattr(estimators, "list_backends", lambda: (*real_list(), FLAT, BROKEN))
    monkeypatch.setattr(
        estimators,
        "create_backend",
        lambda config: (
            fakes[config.backend](config) if config.backend in fakes else real_create(config)
        ),
    )


@pytest.fixture(scope="module")
def pose():
    return make_view_pose(n_frames=60)


def test_a_steady_body_has_no_outliers():
    assert outlier_ratio(make_pose_track(n_frames=90), stature_m=1.75) == 0.0


def test_frames_with_a_wrist_elsewhere_are_counted():
    track = make_pose_track(n_frames=90, noise=0.001)
    position = track.position.copy()
    wrist = 15
    position[40:46, wrist] += 0.4
    ratio = outlier_ratio(dataclasses.replace(track, position=position), stature_m=1.75)
    # The frame after the stretch holds the way back.
    assert 6 / 90 <= ratio <= 8 / 90


def test_frames_without_a_person_do_not_count():
    track = make_pose_track(n_frames=90)
    position = track.position.copy()
    position[:45] = np.nan
    assert outlier_ratio(dataclasses.replace(track, position=position), stature_m=1.75) == 0.0
    position[:] = np.nan
    assert math.isnan(outlier_ratio(dataclasses.replace(track, position=position)))


def test_every_estimator_gets_its_row_and_a_refusal_says_why(with_fakes, pose):
    steps = []
    runs = compare_estimators(
        make_trial(), pose, ("mediapipe", "flat", "broken"), progress=lambda *a: steps.append(a)
    )
    assert [run.info.name for run in runs] == ["mediapipe", "flat", "broken"]
    first, flat, broken = runs
    assert first.lifting_s_per_frame == 0.0
    assert flat.lifting_s_per_frame > 0.0
    assert first.result is not None
    assert flat.result is not None
    assert flat.result.backend == "flat"
    assert 0.0 <= flat.outlier_ratio <= 1.0
    assert flat.fit_residual_m > 0.0
    assert broken.result is None
    assert broken.refusal == "Expected 27 frames, got 3."
    assert steps[0] == ("estimators", 0, 3)
    assert steps[-1] == ("estimators", 3, 3)
    differences = mean_differences(flat, first)
    assert differences["knee_flexion_r"] >= 0.0
    assert mean_differences(first, first)["trunk_inclination"] == 0.0
    assert mean_differences(broken, first) == {}


def test_the_comparison_can_be_cancelled(with_fakes, pose):
    def stop(stage, done, total):
        if done:
            raise Cancelled("Stopped.")

    with pytest.raises(Cancelled):
        compare_estimators(make_trial(), pose, ("mediapipe", "flat"), progress=stop)


def test_differences_are_the_shorter_way_round_and_over_common_frames(with_fakes, pose):
    first, flat = compare_estimators(make_trial(), pose, ("mediapipe", "flat"))
    angles = first.result.angles
    column = angles.names.index("knee_flexion_l")
    values = angles.value_deg.copy()
    values[:, column] += 359.0
    values[:5, column] = np.nan
    turned = dataclasses.replace(angles, value_deg=values)
    other = dataclasses.replace(flat, result=dataclasses.replace(first.result, angles=turned))
    assert mean_differences(other, first)["knee_flexion_l"] == pytest.approx(1.0)


def test_unknown_estimators_are_named(pose):
    with pytest.raises(ConfigError, match=r"Unknown estimator 'hal'; known: .*mediapipe"):
        compare_estimators(make_trial(), pose, ("mediapipe", "hal"))


def test_an_estimator_that_needs_the_video_is_refused(tmp_path, pose):
    file = tmp_path / "kept.npz"
    np.savez(file, time_s=pose.image.time_s, image=pose.image.position)
    with pytest.raises(ConfigError, match="needs the video again"):
        lift_keypoints(pose, PoseConfig(backend="stored", model=str(file)))


def test_a_stored_trial_is_compared_without_its_video(with_fakes, tmp_path, pose):
    folder = write_result(make_trial_result(n_frames=60, views=(pose,)), tmp_path / "one")
    runs = compare_on_stored(read_result(folder), ("mediapipe", "flat"))
    assert [run.result is not None for run in runs] == [True, True]


def test_keypoints_of_another_kind_are_refused(tmp_path):
    pose = make_view_pose(n_frames=30, with_body=False)
    image = make_pose_track(n_frames=30, frame_of_reference="image", skeleton="h36m_17")
    other = dataclasses.replace(pose, image=image)
    folder = write_result(
        make_trial_result(n_frames=30, views=(other,), backend="stored"), tmp_path / "one"
    )
    with pytest.raises(DataError, match="assessed with 'stored'"):
        compare_on_stored(read_result(folder), ("mediapipe",))


def test_what_the_others_start_from_comes_first():
    names = [info.name for info in estimators.list_lifters()]
    assert names[0] == "mediapipe"
    assert {"d3dp", "hybrik", "mhformer"} <= set(names)
    assert "stored" not in names
