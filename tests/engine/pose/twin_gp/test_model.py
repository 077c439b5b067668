"""Training, prediction and files, on movements made here."""

from __future__ import annotations

import json

import numpy as np
import pytest

from engine.errors import ConfigError, DataError, ShapeError
from engine.pose.twin_gp import (
    REGRESSORS,
    Crop,
    Hyper,
    ModelSource,
    load_model,
    train_model,
)
from engine.pose.twin_gp.lengths import find_segments, learn_lengths
from engine.pose.twin_gp.regressors import invert_kernel
from engine.pose.twin_gp.selection import InnerData, leave_trials_out

NAMES = (
    "RSHO",
    "RELL",
    "RELM",
    "RWRR",
    "RWRU",
    "LSHO",
    "LELL",
    "LELM",
    "LWRR",
    "LWRU",
    "C7",
    "T10",
)


def make_arms(bend, raise_, swing=0.0):
    """Markers (12, 3) of two arms of 0.30 and 0.25 m whose shoulder and elbow bend."""
    points = []
    for side in (1.0, -1.0):
        shoulder = np.array([0.05 * np.sin(swing), 1.4 + 0.05 * np.cos(swing), 0.2 * side])
        elbow = shoulder + 0.30 * np.array([np.sin(raise_), -np.cos(raise_), 0.0])
        wrist = elbow + 0.25 * np.array([np.sin(raise_ + bend), -np.cos(raise_ + bend), 0.0])
        across = np.array([0.0, 0.0, 0.03])
        points += [shoulder, elbow + across, elbow - across, wrist + across, wrist - across]
    return np.array([*points, [0.0, 1.5, 0.0], [-0.1, 1.2, 0.02]])


@pytest.fixture(scope="module")
def data():
    """Four trials of 60 frames: features are random waves of the pose, with a little noise."""
    rng = np.random.default_rng(0)
    mixing = rng.normal(size=(2, 40))
    phase = rng.uniform(0, 6, 40)
    features, markers, groups = [], [], []
    for trial in range(4):
        t = np.linspace(0, 1, 60)
        lift = np.sin(np.pi * t) * (0.9 + 0.1 * trial)
        state = np.column_stack([1.2 * lift, 0.3 + lift * (1 + 0.05 * trial)])
        features.append(np.sin(state @ mixing + phase) + 0.02 * rng.normal(size=(60, 40)))
        markers.append([make_arms(*row) for row in state])
        groups += [f"trial {trial}"] * 60
    return np.concatenate(features).astype(np.float32), np.concatenate(markers), np.array(groups)


@pytest.fixture(scope="module")
def split(data):
    features, markers, groups = data
    test = groups == "trial 2"
    return (features[~test], markers[~test], groups[~test]), (features[test], markers[test])


@pytest.mark.parametrize("name", REGRESSORS)
def test_every_estimator_learns_the_movement(split, name):
    train, (features, markers) = split
    model = train_model(*train, marker_names=NAMES, regressor=name)
    got = model.predict(features)
    error = np.linalg.norm(got.markers_m - markers, axis=2)
    plain = np.linalg.norm(train[1].mean(axis=0) - markers, axis=2)
    assert error.mean() < 0.06 * plain.mean()
    assert got.sigma_m.shape == markers.shape[:2]
    # Stated errors are of the size of the true ones.
    arm = slice(1, 5)
    z = (got.markers_m[:, arm] - markers[:, arm]) / got.sigma_m[:, arm, None]
    assert 0.2 < np.sqrt((z**2).mean()) < 3.0
    # The trials left out in training include the highest and the lowest lift, which are harder.
    assert 0.5 * error.mean() < model.inner_error_m < 6 * error.mean()


def test_the_constraint_holds_lengths(split):
    train, (features, _) = split
    free = train_model(*train, marker_names=NAMES, regressor="gp").predict(features)
    held = train_model(*train, marker_names=NAMES, regressor="tgp-constrained").predict(features)
    assert np.abs(held.length_error_m).mean() < 0.3 * np.abs(free.length_error_m).mean()


def test_the_subjects_lengths_are_learnt(split):
    model = train_model(*split[0], marker_names=NAMES, regressor="gp")
    assert model.lengths_m["right_upper_arm"] == pytest.approx(0.30, abs=1e-6)
    assert model.lengths_m["left_forearm"] == pytest.approx(0.25, abs=1e-6)


def test_the_shoulders_centre_is_found_where_the_acromion_slides():
    rng = np.random.default_rng(2)
    trunk = {
        "C7": (0, 1.5, 0),
        "T10": (-0.1, 1.2, 0),
        "CLAV": (0.1, 1.4, 0),
        "STRN": (0.12, 1.3, 0),
    }
    names = [*NAMES[:10], *trunk]
    frames = []
    for raise_ in np.linspace(-0.5, 2.2, 80):
        arms = make_arms(0.3, raise_)[:10]
        # The acromion lies over the centre and moves with the raised arm.
        for shoulder in (0, 5):
            arms[shoulder] += [0.01 * raise_, 0.04, 0.0]
        frames.append(np.vstack([arms, np.array(list(trunk.values()), dtype=float)]))
    markers = np.array(frames) + 1e-4 * rng.normal(size=(80, len(names), 3))
    _, slides = learn_lengths(find_segments(names), markers)
    length, sigma = learn_lengths(find_segments(names, markers, glenohumeral=True), markers)
    assert slides[0] > 0.01
    assert sigma[0] < 0.5 * slides[0]
    assert length[0] == pytest.approx(0.30, abs=0.03)


def test_trials_left_out_in_closed_form_are_those_left_out_one_by_one(data):
    features, markers, groups = (a[::6] for a in data)
    pose = markers.reshape(len(markers), -1)
    pose = pose - pose.mean(axis=0)
    _, trial = np.unique(groups, return_inverse=True)
    gram = np.exp(-0.05 * ((features[:, None] - features[None]) ** 2).sum(2))
    noise = 0.01
    result = leave_trials_out(invert_kernel(gram, noise), InnerData((features,), pose, trial))
    for t in range(4):
        out = trial == t
        inverse = np.linalg.inv(gram[np.ix_(~out, ~out)] + noise * np.eye((~out).sum()))
        u = gram[np.ix_(out, ~out)] @ inverse
        np.testing.assert_allclose(result.pose[out], u @ pose[~out], atol=1e-8)
        eta = 1 + noise - np.sum(u * gram[np.ix_(out, ~out)], axis=1)
        np.testing.assert_allclose(result.eta[out], eta, atol=1e-8)


@pytest.mark.parametrize("name", ["gp-smooth", "tgp-constrained-gh"])
def test_a_saved_model_predicts_the_same(split, tmp_path, name):
    train, (features, _) = split
    source = ModelSource(
        features="hog",
        views=("side", "rear"),
        picture_px=((64, 48), (64, 48)),
        crops=(Crop(1, 2, 30, 40, (64, 48)), Crop(0, 0, 64, 48, (64, 48))),
        subject="S1",
        stature_m=1.8,
    )
    model = train_model(*train, marker_names=NAMES, regressor=name, source=source)
    again = load_model(model.save(tmp_path / "deep" / "model.npz"))
    assert again.source == source
    assert again.hyper == model.hyper
    assert again.marker_names == NAMES
    one, other = model.predict(features), again.predict(features)
    np.testing.assert_allclose(other.markers_m, one.markers_m, atol=2e-5)
    # Sums of 32-bit features end alike to five digits, in whatever order they are added.
    np.testing.assert_allclose(other.sigma_m, one.sigma_m, rtol=1e-4, atol=1e-9)
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["model.npz"]


def test_frames_without_features_stay_missing(split):
    train, (features, _) = split
    model = train_model(*train, marker_names=NAMES, regressor="gp-smooth")
    rows = features.copy()
    rows[20:24] = np.nan
    got = model.predict(rows)
    assert np.isnan(got.markers_m[20:24]).all()
    assert np.isnan(got.sigma_m[20:24]).all()
    assert np.isfinite(np.delete(got.markers_m, range(20, 24), axis=0)).all()


def test_frames_with_missing_markers_are_not_trained_on(split):
    (features, markers, groups), _ = split
    holes = markers.copy()
    holes[::7, 3] = np.nan
    kept = np.arange(len(markers)) % 7 != 0
    hyper = Hyper((0.3,), 1e-2)
    one = train_model(features, holes, groups, marker_names=NAMES, hyper=hyper)
    other = train_model(
        features[kept], markers[kept], groups[kept], marker_names=NAMES, hyper=hyper
    )
    np.testing.assert_array_equal(
        one.predict(features).markers_m, other.predict(features).markers_m
    )


def test_wrong_calls_say_what_to_do(split):
    (features, markers, groups), _ = split
    with pytest.raises(ConfigError, match="Unknown estimator 'svm'; known: nn, wknn"):
        train_model(features, markers, groups, marker_names=NAMES, regressor="svm")
    with pytest.raises(DataError, match="millimetres"):
        train_model(features, markers * 1000, groups, marker_names=NAMES)
    with pytest.raises(DataError, match="at least 20 frames"):
        train_model(features[:5], markers[:5], groups[:5], marker_names=NAMES)
    with pytest.raises(ShapeError, match="one trial per frame"):
        train_model(features, markers, groups[:-1], marker_names=NAMES)
    with pytest.raises(DataError, match="needs the marker RSHO or RAC"):
        train_model(
            features,
            markers,
            groups,
            marker_names=[n.replace("RSHO", "X") for n in NAMES],
            regressor="tgp-constrained",
        )
    model = train_model(features, markers, groups, marker_names=NAMES, hyper=Hyper())
    with pytest.raises(ShapeError, match="features of 40 numbers"):
        model.predict(features[:, :30])


def test_files_that_are_no_model_say_so(split, tmp_path):
    with pytest.raises(ConfigError, match="no model file"):
        load_model(tmp_path / "none.npz")
    bad = tmp_path / "bad.npz"
    bad.write_bytes(b"nothing")
    with pytest.raises(DataError, match="Expected a trained model"):
        load_model(bad)
    np.savez(bad, meta=np.array(json.dumps({"format": "other", "version": 1})))
    with pytest.raises(DataError, match="not a twin Gaussian process model"):
        load_model(bad)
    model = train_model(*split[0], marker_names=NAMES, hyper=Hyper())
    good = model.save(tmp_path / "good.npz")
    with np.load(good) as stored:
        arrays = dict(stored)
    arrays["meta"] = np.array(str(arrays["meta"]).replace('"version": 1', '"version": 9'))
    np.savez(bad, **arrays)
    with pytest.raises(DataError, match=r"model of version 9.*update LiftLens"):
        load_model(bad)
    del arrays["pose"]
    arrays["meta"] = np.array(str(arrays["meta"]).replace('"version": 9', '"version": 1'))
    np.savez(bad, **arrays)
    with pytest.raises(DataError, match="can't be read as one"):
        load_model(bad)
