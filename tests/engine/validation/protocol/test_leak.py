"""The alarm: remembering neighbours is told from understanding new lifts."""

import numpy as np
import pytest

from engine.errors import ShapeError
from engine.validation.protocol.folds import make_folds
from engine.validation.protocol.leak import check_leak, find_neighbours
from tests.engine.validation.protocol.studies import make_frames


def walk(n_trials=4, n=60, *, seed=0, step_m=0.004):
    """Return trials whose features are their markers: smooth within a trial, apart between."""
    noise = np.random.default_rng(seed)
    trials = [make_frames(repetition=r + 1, n=n, rate_hz=30.0) for r in range(n_trials)]
    path = np.cumsum(np.full((n_trials, n, 3), step_m), axis=1) + noise.normal(
        0, 0.05, (n_trials, 1, 3)
    )
    markers = np.repeat(path[:, :, None], 2, axis=2)
    features = path.reshape(-1, 3).astype(np.float32)
    return trials, features, markers.reshape(-1, 2, 3)


def run(kind, trials, features, markers):
    folds = make_folds(trials, kind)
    found = [find_neighbours(features, markers, trials, fold) for fold in folds]
    return check_leak(found, np.split(markers, len(trials)))


def test_random_frames_raise_the_alarm():
    check = run("random", *walk())
    assert check.is_raised
    assert check.shared > 0.5
    assert check.median_gap_s == pytest.approx(1 / 30, abs=0.02)
    assert check.sentence.startswith("Leak:")


def test_whole_recordings_do_not():
    trials, features, markers = walk()
    check = run("trial", trials, features, markers)
    assert check.shared == 0.0
    assert not check.is_raised
    assert "No sign of a leak" in check.sentence
    assert check.step_mm == pytest.approx(1000 * 0.004 * np.sqrt(3), rel=1e-6)


def test_the_same_recording_twice_is_suspected():
    trials, features, markers = walk(n_trials=4)
    half = len(features) // 4
    for copy in range(1, 4):
        features[copy * half : (copy + 1) * half] = features[:half]
        markers[copy * half : (copy + 1) * half] = markers[:half]
    check = run("trial", trials, features, markers)
    assert check.is_raised
    assert "twice" in check.sentence


def test_the_neighbour_is_the_nearest_by_brute_force():
    trials, features, markers = walk(seed=3)
    (fold, *_) = make_folds(trials, "trial")
    found = find_neighbours(features, markers, trials, fold)
    train, test = features[fold.train], features[fold.test]
    brute = np.argmin(np.linalg.norm(test[:, None] - train[None], axis=-1), axis=1)
    expected = np.linalg.norm(markers[fold.train][brute] - markers[fold.test], axis=-1).mean(axis=1)
    np.testing.assert_allclose(found.error_mm, 1000 * expected, rtol=1e-6)


def test_arrays_of_another_length_are_refused():
    trials, features, markers = walk()
    (fold, *_) = make_folds(trials, "trial")
    with pytest.raises(ShapeError, match="240 frames, got 239"):
        find_neighbours(features[1:], markers, trials, fold)
