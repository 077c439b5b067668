"""Which frames an estimator learns from, and which it is judged on.

Frames of a video are near-duplicates of their neighbours. Where both sides of a fold hold frames of
one recording, an estimator that remembers looks like one that understands; `trial` and `subject`
folds can't leak that way, `block` folds leave a gap, `random` folds leak and are for comparison
with papers only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, frozen_array
from engine.errors import ConfigError, DataError, ShapeError

__all__ = [
    "FOLD_WORDS",
    "GUARD_S",
    "N_FOLDS",
    "Fold",
    "FoldKind",
    "TrialFrames",
    "make_folds",
    "parse_fold_kind",
]

FoldKind = Literal["trial", "block", "random", "subject"]
Mask = NDArray[np.bool_]

N_FOLDS = 4
"""Partitions of the lifting paper."""
GUARD_S = 0.5
"""No frame this close to a test frame of the same recording is learnt from, in `block` folds."""

FOLD_WORDS: dict[FoldKind, str] = {
    "trial": "trial-wise folds: every repetition is judged by an estimator that never saw it",
    "block": (
        "block folds: contiguous parts of every recording, with a guard around them; the same "
        "recording is on both sides, so the errors are optimistic"
    ),
    "random": (
        "random-frame folds: leaky, neighbouring frames of a recording are on both sides; for "
        "comparison with papers that cut their data so, never as an accuracy"
    ),
    "subject": "leave-one-subject-out: every person is judged by an estimator of the others",
}


@dataclass(frozen=True, eq=False)
class TrialFrames:
    """The frames of one recording; `is_usable` (T,) says which have all their markers."""

    subject: str
    label: str
    task: str
    repetition: int
    time_s: Array
    is_usable: Mask

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", frozen_array(self.time_s))
        object.__setattr__(self, "is_usable", frozen_array(self.is_usable, bool))
        if self.is_usable.shape != self.time_s.shape:
            raise ShapeError(
                f"is_usable of {self.label} needs shape {self.time_s.shape}, got "
                f"{self.is_usable.shape}."
            )

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return int(self.time_s.size)


@dataclass(frozen=True, eq=False)
class Fold:
    """One partition: masks (N,) over the frames of all its trials, one trial after the other.

    Frames without all their markers are tested, as far as they can be, but not learnt from.
    """

    name: str
    train: Mask
    test: Mask

    def __post_init__(self) -> None:
        for name in ("train", "test"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), bool))
        if self.train.shape != self.test.shape:
            raise ShapeError(f"The masks of {self.name} differ: {self.train.shape} and "
                             f"{self.test.shape}.")  # fmt: skip
        if np.any(self.train & self.test):
            raise DataError(f"{self.name} would be judged on frames it learnt from.")


def parse_fold_kind(text: str) -> FoldKind:
    """Return which folds are meant.

    Raises
    ------
    ConfigError
        If it is none of trial, block, random, subject.
    """
    for kind in get_args(FoldKind):
        if text.strip().lower() == kind:
            return kind  # type: ignore[no-any-return]
    raise ConfigError(f"--folds must be one of {', '.join(get_args(FoldKind))}, got {text!r}.")


def make_folds(
    trials: Sequence[TrialFrames],
    kind: FoldKind,
    *,
    n_folds: int = N_FOLDS,
    guard_s: float = GUARD_S,
    train_repetitions: int | None = None,
    seed: int = 0,
) -> tuple[Fold, ...]:
    """Cut the frames of trials into folds.

    Parameters
    ----------
    trials
        Those of one person; of all persons for `subject` folds.
    kind
        Where to cut.
    n_folds
        Number of partitions; `subject` folds have one per person.
    guard_s
        Of `block` folds.
    train_repetitions
        With `trial` folds, learn from at most so many repetitions of each task.
    seed
        Of `random` folds.

    Returns
    -------
    tuple of Fold
        Every frame is tested exactly once.

    Raises
    ------
    ConfigError
        If the numbers make no sense.
    DataError
        If there are fewer trials or persons than folds, or a fold has nothing to learn from.
    """
    if not trials:
        raise DataError("There is no trial to make folds of.")
    if n_folds < 2:
        raise ConfigError(f"At least 2 folds are needed, got {n_folds}.")
    if train_repetitions is not None and train_repetitions < 1:
        raise ConfigError(
            f"At least 1 repetition of each task is needed for training, got {train_repetitions}."
        )
    if kind == "trial":
        folds = tuple(_cut_trials(trials, n_folds, train_repetitions))
    elif kind == "subject":
        folds = tuple(_cut_subjects(trials))
    else:
        folds = tuple(_cut_frames(trials, kind, n_folds, guard_s, seed))
    empty = next((fold for fold in folds if not fold.train.any()), None)
    if empty is not None:
        raise DataError(
            f"{empty.name} has no frame to learn from: markers are missing in all of them, or the "
            "recordings are too short. Fill the gaps, or use fewer folds."
        )
    return folds


def _usable(trials: Sequence[TrialFrames]) -> Mask:
    return np.concatenate([trial.is_usable for trial in trials])


def _spread(trials: Sequence[TrialFrames], chosen: Sequence[bool]) -> Mask:
    """Return the mask of all frames of the chosen trials."""
    return np.repeat(np.array(chosen, dtype=bool), [trial.n_frames for trial in trials])


# --------------------------------------------------------------------------- whole recordings


def _cut_trials(
    trials: Sequence[TrialFrames], n_folds: int, train_repetitions: int | None
) -> Iterator[Fold]:
    turn = _number_repetitions(trials, n_folds)
    for k in range(n_folds):
        is_test = [t == k for t in turn]
        # The repetitions after the tested one, going round, so that each is learnt from as often.
        allowed = {(k + 1 + i) % n_folds for i in range(train_repetitions or n_folds - 1)} - {k}
        train = _spread(trials, [t in allowed for t in turn]) & _usable(trials)
        yield Fold(f"{trials[0].subject}, repetition {k + 1}", train, _spread(trials, is_test))


def _number_repetitions(trials: Sequence[TrialFrames], n_folds: int) -> list[int]:
    """Return the fold in which each trial is tested: its place among those of its task."""
    place: dict[str, list[int]] = {}
    for i, trial in sorted(enumerate(trials), key=lambda pair: (pair[1].repetition, pair[1].label)):
        place.setdefault(trial.task, []).append(i)
    for task, members in place.items():
        if len(members) < n_folds:
            raise DataError(
                f"{trials[0].subject} has {len(members)} usable trials of {task}, fewer than the "
                f"{n_folds} folds; record more, or ask for at most {len(members)} folds with "
                "--n-folds."
                if len(members) > 1
                else f"{trials[0].subject} has 1 usable trial of {task}; trial-wise folds need at "
                "least 2. Record more, or use --folds block."
            )
    turn = {i: k % n_folds for members in place.values() for k, i in enumerate(members)}
    return [turn[i] for i in range(len(trials))]


def _cut_subjects(trials: Sequence[TrialFrames]) -> Iterator[Fold]:
    subjects = tuple(dict.fromkeys(trial.subject for trial in trials))
    if len(subjects) < 2:
        raise DataError(
            f"Leave-one-subject-out needs at least 2 persons, but there is only {subjects[0]}; "
            "use --folds trial."
        )
    for subject in subjects:
        test = _spread(trials, [trial.subject == subject for trial in trials])
        yield Fold(f"all but {subject}", ~test & _usable(trials), test)


# --------------------------------------------------------------------------- parts of recordings


def _cut_frames(
    trials: Sequence[TrialFrames], kind: FoldKind, n_folds: int, guard_s: float, seed: int
) -> Iterator[Fold]:
    shortest = min(trials, key=lambda trial: trial.n_frames)
    if shortest.n_frames < n_folds:
        raise DataError(
            f"{shortest.label} has {shortest.n_frames} frames, fewer than the {n_folds} folds."
        )
    if kind == "random":
        n = sum(trial.n_frames for trial in trials)
        turn = np.random.default_rng(seed).permutation(n) % n_folds
        guard_s = 0.0
    else:
        turn = np.concatenate([_number_blocks(trial.n_frames, n_folds) for trial in trials])
    for k in range(n_folds):
        test = turn == k
        train = ~test & _usable(trials) & ~_find_guarded(trials, test, guard_s)
        yield Fold(f"{trials[0].subject}, part {k + 1}", train, test)


def _number_blocks(n_frames: int, n_folds: int) -> NDArray[np.intp]:
    return np.arange(n_frames) * n_folds // n_frames


def _find_guarded(trials: Sequence[TrialFrames], test: Mask, guard_s: float) -> Mask:
    """Return the frames that are closer to a test frame of their recording than the guard."""
    guarded = np.zeros(test.shape, dtype=bool)
    if not guard_s > 0:
        return guarded
    start = 0
    for trial in trials:
        part = slice(start, start + trial.n_frames)
        start += trial.n_frames
        tested = trial.time_s[test[part]]
        if not tested.size:
            continue
        after = np.searchsorted(tested, trial.time_s).clip(1, max(tested.size - 1, 1))
        neighbours = tested[np.minimum([after - 1, after], tested.size - 1)]
        near = np.abs(neighbours - trial.time_s).min(axis=0)
        guarded[part] = near < guard_s - 1e-9
    return guarded
