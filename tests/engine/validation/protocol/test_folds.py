"""Folds: every frame judged once, nothing learnt that is judged, and no way around that."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.errors import ConfigError, DataError
from engine.validation.protocol.folds import FOLD_WORDS, Fold, make_folds, parse_fold_kind
from tests.engine.validation.protocol.studies import make_frames


def owners(trials):
    return np.repeat(np.arange(len(trials)), [t.n_frames for t in trials])


def lifts(tasks=("FK", "KS"), repetitions=4, **options):
    return [
        make_frames(task=task, repetition=r, **options)
        for task in tasks
        for r in range(1, repetitions + 1)
    ]


@settings(max_examples=60, deadline=None)
@given(
    kind=st.sampled_from(["trial", "block", "random"]),
    n=st.integers(12, 40),
    n_folds=st.integers(2, 4),
    seed=st.integers(0, 5),
)
def test_every_frame_is_judged_exactly_once_and_never_learnt_from(kind, n, n_folds, seed):
    trials = lifts(n=n, unusable=(3,))
    folds = make_folds(trials, kind, n_folds=n_folds, guard_s=0.2, seed=seed)
    assert len(folds) == n_folds
    assert (np.sum([f.test for f in folds], axis=0) == 1).all()
    usable = np.concatenate([t.is_usable for t in trials])
    for fold in folds:
        assert not (fold.train & fold.test).any()
        assert not (fold.train & ~usable).any()


def test_trial_folds_keep_recordings_whole():
    trials = lifts()
    owner = owners(trials)
    for k, fold in enumerate(make_folds(trials, "trial")):
        assert set(owner[fold.test]) == {k, 4 + k}, "repetition k + 1 of both tasks"
        assert not set(owner[fold.test]) & set(owner[fold.train])
        assert len(set(owner[fold.train])) == 6


def test_repetitions_count_in_their_own_order_not_in_that_of_the_files():
    trials = lifts(tasks=("FK",))[::-1]
    folds = make_folds(trials, "trial")
    assert set(owners(trials)[folds[0].test]) == {3}, "the first repetition stands last"


@pytest.mark.parametrize("count", [1, 2, 3])
def test_fewer_training_repetitions_are_learnt_from_equally_often(count):
    trials = lifts(tasks=("FK",))
    owner = owners(trials)
    folds = make_folds(trials, "trial", train_repetitions=count)
    used = [set(owner[fold.train]) for fold in folds]
    assert {len(u) for u in used} == {count}
    assert [sum(k in u for u in used) for k in range(4)] == [count] * 4


def test_block_folds_leave_a_guard_on_both_sides():
    trial = make_frames(n=40, rate_hz=10.0)
    folds = make_folds([trial], "block", guard_s=0.5)
    second = folds[1]
    assert np.flatnonzero(second.test).tolist() == list(range(10, 20))
    near = np.abs(np.flatnonzero(second.train)[:, None] - np.flatnonzero(second.test)).min()
    assert near == 5, "0.5 s at 10 Hz"
    assert set(np.flatnonzero(second.train)) == {*range(6), *range(24, 40)}


def test_without_a_guard_neighbours_are_learnt_from():
    folds = make_folds([make_frames(n=40)], "block", guard_s=0.0)
    assert folds[1].train[9]
    assert folds[1].train[20]


def test_random_folds_follow_their_seed():
    trials = lifts(n=20)
    one, same, other = (make_folds(trials, "random", seed=s)[0].test for s in (1, 1, 2))
    assert (one == same).all()
    assert (one != other).any()


def test_subject_folds_hold_out_one_person():
    trials = [make_frames(subject=s, repetition=r) for s in ("S1", "S2", "S3") for r in (1, 2)]
    owner = np.array([t.subject for t in trials])[owners(trials)]
    folds = make_folds(trials, "subject")
    assert [f.name for f in folds] == ["all but S1", "all but S2", "all but S3"]
    for fold, subject in zip(folds, ("S1", "S2", "S3"), strict=True):
        assert set(owner[fold.test]) == {subject}
        assert subject not in owner[fold.train]


@pytest.mark.parametrize(
    ("trials", "kind", "words"),
    [
        (lifts(repetitions=3), "trial", "S1 has 3 usable trials of FK, fewer than the 4 folds"),
        (lifts(repetitions=1), "trial", "1 usable trial of FK; trial-wise folds need at least 2"),
        (lifts(n=3), "block", "has 3 frames, fewer than the 4 folds"),
        (lifts(), "subject", "at least 2 persons, but there is only S1"),
        (lifts(n=8, unusable=range(8)), "trial", "no frame to learn from"),
        ([], "trial", "no trial"),
    ],
    ids=["few", "one", "short", "person", "gaps", "none"],
)
def test_too_little_data_is_said(trials, kind, words):
    with pytest.raises(DataError, match=words):
        make_folds(trials, kind)


def test_numbers_that_make_no_sense_are_refused():
    with pytest.raises(ConfigError, match="At least 2 folds"):
        make_folds(lifts(), "trial", n_folds=1)
    with pytest.raises(ConfigError, match="At least 1 repetition"):
        make_folds(lifts(), "trial", train_repetitions=0)
    with pytest.raises(ConfigError, match="--folds must be one of trial, block, random, subject"):
        parse_fold_kind("trials")
    assert parse_fold_kind(" Trial ") == "trial"


def test_a_fold_judged_on_what_it_learnt_can_t_be_made():
    with pytest.raises(DataError, match="learnt from"):
        Fold("bad", np.array([True, True]), np.array([False, True]))


def test_leaky_folds_are_called_leaky():
    assert "leaky" in FOLD_WORDS["random"]
    assert "optimistic" in FOLD_WORDS["block"]
