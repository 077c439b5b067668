"""From two views to markers by a person's own model, on the bundled clip with its exact markers."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from engine.config import Config, KinematicsConfig, PoseConfig, TwoViewConfig
from engine.datatypes import Subject, Task, Trial, View
from engine.errors import ConfigError, DataError, PoseError
from engine.kinematics.markers import fit_markers, keypoints_from_markers
from engine.pipeline import assess, assess_poses
from engine.pose.twin_gp import (
    FEATURES,
    Hyper,
    ModelSource,
    combine_features,
    describe_landmarks,
    describe_video,
    fixed_crop,
    train_model,
)
from engine.skeletons import MEDIAPIPE_33
from engine.subject_model import check_model
from engine.video.reader import read_frames
from tests.engine.cameras.truth import SAMPLES, read_truth, see

VIEWS = ("cam90", "cam135")
SIZE = (720, 480)
LAB_TURN_DEG, LAB_SHIFT_M = 35.0, np.array([1.5, 0.0, -0.7])
"""The laboratory's axes are not the trial's: turned about the vertical, with another origin."""
SOURCE = ModelSource("landmarks", VIEWS, (SIZE, SIZE), subject="S1")


@pytest.fixture(scope="module")
def truth():
    return read_truth("floor_to_knuckle")


@pytest.fixture(scope="module")
def poses(truth):
    found = [see(truth.points, truth.cameras[name], truth.time_s) for name in VIEWS]
    return tuple(
        dataclasses.replace(
            pose, info=dataclasses.replace(pose.info, sha256=name, file_name=f"{name}.mp4")
        )
        for pose, name in zip(found, VIEWS, strict=True)
    )


@pytest.fixture(scope="module")
def markers(truth):
    """Exact markers (T, 45, 3) in the trial's axes, and their names."""
    with np.load(SAMPLES / "floor_to_knuckle" / "truth.npz", allow_pickle=False) as data:
        own, values = data["time"], data["markers"].astype(float)
        names = tuple(map(str, data["marker_names"]))
    flat = values.reshape(len(values), -1).T
    at_frames = np.stack([np.interp(truth.time_s, own, column) for column in flat], axis=1)
    return at_frames.reshape(len(truth.time_s), -1, 3), names


def to_lab(position):
    angle = np.radians(LAB_TURN_DEG)
    c, s = np.cos(angle), np.sin(angle)
    return position @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + LAB_SHIFT_M


def train(features, blocks, markers, source):
    position, names = markers
    quarter = np.arange(len(position)) * 4 // len(position)
    hyper = Hyper((0.1,) * len(blocks), 1e-4)
    return train_model(
        features, to_lab(position), quarter, marker_names=names, blocks=blocks, source=source,
        hyper=hyper,
    )  # fmt: skip


@pytest.fixture(scope="module")
def landmark_model(poses, markers, tmp_path_factory) -> Path:
    views = [describe_landmarks(p.image.position, SIZE) for p in poses]
    features, blocks = combine_features(landmarks=views)
    model = train(features, blocks, markers, SOURCE)
    return model.save(tmp_path_factory.mktemp("model") / "s1.npz")


def make_trial(truth, folder=SAMPLES / "floor_to_knuckle", names=VIEWS):
    views = tuple(View(folder / f"{name}.mp4", camera=truth.cameras.get(name)) for name in names)
    return Trial(views, Subject(stature_m=truth.stature_m), Task(load_kg=10.0))


def settings(model, **pose):
    return Config(
        pose=PoseConfig(backend="twin-gp", model=str(model), **pose),
        two_view=TwoViewConfig(sync="0"),
    )


@pytest.fixture(scope="module")
def result(truth, poses, landmark_model):
    return assess_poses(make_trial(truth), poses, settings(landmark_model))


def test_joints_come_out_in_the_trials_world(result, truth, markers):
    true = keypoints_from_markers(truth.time_s, *markers)
    names = [f"{s}_{p}" for s in ("left", "right") for p in ("hip", "knee", "elbow", "wrist")]
    columns = [MEDIAPIPE_33.index(name) for name in names]
    # The trial's world is found from the exact joints, so it is the truth's.
    miss = np.linalg.norm(result.raw.position[:, columns] - true.position[:, columns], axis=2)
    assert np.median(miss) < 0.02
    assert np.abs(result.raw.position[:, columns, 1] - true.position[:, columns, 1]).mean() < 0.003


def test_the_lift_is_found_with_the_knuckles_of_the_markers(result, truth):
    (lift,) = result.lifts
    assert lift.start_s == pytest.approx(truth.events_s["lift_start"], abs=0.12)
    true_V = 100 * truth.knuckles[truth.at(truth.events_s["lift_start"]), 1]
    assert lift.origin.V_cm.value == pytest.approx(true_V, abs=3.5)
    assert result.risk["rnle"].is_applicable
    assert result.backend == "twin-gp"


def test_a_body_is_fitted_to_the_markers_themselves(truth, poses, markers, landmark_model):
    config = dataclasses.replace(
        settings(landmark_model), kinematics=KinematicsConfig(solver="markers")
    )
    found = assess_poses(make_trial(truth), poses, config)
    true = fit_markers(truth.time_s, *markers).angles
    for name in ("knee_flexion_l", "hip_flexion_r", "elbow_flexion_r"):
        assert np.nanmean(np.abs(found.angles[name] - true[name])) < 3.0, name
    assert found.solver == "markers"
    assert found.body.joints.skeleton == "synthetic_45"


def test_a_solver_of_markers_needs_the_estimator_that_gives_them(truth):
    config = Config(kinematics=KinematicsConfig(solver="markers"))
    with pytest.raises(ConfigError, match="only the estimator 'twin-gp' gives") as caught:
        assess(make_trial(truth), config)
    assert caught.value.exit_code == 2


def test_the_result_says_where_joints_come_from(result):
    said = result.raw.provenance
    assert (said["subject"], said["features"]) == ("S1", "landmarks")
    assert "nose" in said["as_triangulated"]
    assert "left_hip" not in said["as_triangulated"]
    assert any("model of S1" in warning for warning in result.warnings)
    hip = MEDIAPIPE_33.index("left_hip")
    assert np.all(result.raw.sigma[:, hip] > 0.01)


def test_pictures_unlike_training_are_reported(truth, poses, markers, tmp_path):
    standing = truth.time_s < 1.0
    views = [describe_landmarks(p.image.position[standing], SIZE) for p in poses]
    features, blocks = combine_features(landmarks=views)
    model = train(features, blocks, (markers[0][standing], markers[1]), SOURCE)
    path = model.save(tmp_path / "standing.npz")
    result = assess_poses(make_trial(truth), poses, settings(path))
    assert any("look unlike those the model was trained on" in w for w in result.warnings)


def test_a_model_of_pictures_looks_at_the_videos(truth, poses, markers, tmp_path):
    hog = FEATURES["hog"].hog
    crops = tuple(fixed_crop(pose.box, SIZE) for pose in poses)
    folder = SAMPLES / "floor_to_knuckle"
    rows = [
        describe_video(read_frames(folder / f"{name}.mp4"), crop, hog)
        for name, crop in zip(VIEWS, crops, strict=True)
    ]
    features, blocks = combine_features(hog=rows)
    seen = slice(None, None, 2)  # every second picture is new to the model
    source = dataclasses.replace(SOURCE, features="hog", crops=crops)
    model = train(features[seen], blocks, (markers[0][seen], markers[1]), source)
    path = model.save(tmp_path / "hog.npz")
    result = assess_poses(make_trial(truth), poses, settings(path))
    true = keypoints_from_markers(truth.time_s, *markers).position
    wrist = MEDIAPIPE_33.index("right_wrist")
    assert np.median(np.linalg.norm(result.raw.position[:, wrist] - true[:, wrist], axis=1)) < 0.04
    gone = make_trial(truth, tmp_path)
    with pytest.raises(PoseError, match=r"cam90\.mp4, but the video is not there"):
        assess_poses(gone, poses, settings(path))


class TestBeforeTheWork:
    def test_one_view_is_refused(self, truth, landmark_model):
        trial = make_trial(truth, names=VIEWS[:1])
        with pytest.raises(ConfigError, match="looks at two videos") as caught:
            assess(trial, settings(landmark_model))
        assert caught.value.exit_code == 2

    def test_a_model_is_needed(self, truth):
        with pytest.raises(ConfigError, match="name its file with --model") as caught:
            assess(make_trial(truth), settings(""))
        assert caught.value.exit_code == 2

    def test_pictures_of_another_size_are_refused(self, truth, markers, poses, tmp_path):
        views = [describe_landmarks(p.image.position, SIZE) for p in poses]
        source = dataclasses.replace(SOURCE, picture_px=((1280, 720), (1280, 720)))
        model = train(*combine_features(landmarks=views), markers, source)
        path = model.save(tmp_path / "large.npz")
        words = r"cam90\.mp4 has pictures of 720 x 480 px, .* trained on 1280 x 720 px"
        with pytest.raises(DataError, match=words) as caught:
            assess(make_trial(truth), settings(path))
        assert caught.value.exit_code == 3

    def test_a_model_of_one_view_is_refused(self, truth, markers, poses, tmp_path):
        views = [describe_landmarks(poses[0].image.position, SIZE)]
        source = dataclasses.replace(SOURCE, views=VIEWS[:1], picture_px=(SIZE,))
        model = train(*combine_features(landmarks=views), markers, source)
        with pytest.raises(DataError, match="trained on 1 view") as caught:
            check_model(make_trial(truth).views, settings(model.save(tmp_path / "one.npz")))
        assert caught.value.exit_code == 3

    def test_exchanged_views_are_noticed(self, truth, landmark_model):
        trial = make_trial(truth, names=VIEWS[::-1])
        with pytest.raises(DataError, match="the other way round"):
            check_model(trial.views, settings(landmark_model))
