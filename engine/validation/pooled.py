"""Several compared trials together, by subject and by task.

The units of every test are subjects, or the trials of one subject; never frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from engine.datatypes import Array
from engine.errors import DataError
from engine.validation.agreement import AngleSummary, PairedTrial, summarise_agreement
from engine.validation.bland_altman import BlandAltman
from engine.validation.compare import TrialComparison
from engine.validation.curvewise import N_FLIPS
from engine.validation.statistics import N_RESAMPLES, UNKNOWN, Interval
from engine.validation.wording import describe_angle, title_angle

__all__ = [
    "Agreement",
    "bland_altman_points",
    "describe_agreement",
    "describe_offsets",
    "find_sides",
    "pool_trials",
    "pooled_differences",
]

MAIN_ANGLES = (
    "trunk_flexion",
    "hip_flexion_l",
    "hip_flexion_r",
    "knee_flexion_l",
    "knee_flexion_r",
    "shoulder_flexion_l",
    "shoulder_flexion_r",
    "elbow_flexion_l",
    "elbow_flexion_r",
)
"""The angles that lifting is judged by; their sentences come first."""
SCOPES = (
    "This is one trial of one person and says nothing about others.",
    "These are trials of one person and say nothing about others.",
)
"""How the sentences of `engine.validation.wording` end."""
FULL_TURN_DEG = 360.0
MAX_POINTS = 1500
"""More dots than this only darken a scatter plot."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """How far one or several results are from their references.

    Parameters
    ----------
    trials
        Every comparison.
    angles
        Every angle over all trials.
    tasks
        The same for each task, where there is more than one.
    seed, n_resamples, n_flips
        Of bootstrap and permutation.
    """

    trials: tuple[TrialComparison, ...]
    angles: tuple[AngleSummary, ...]
    tasks: Mapping[str, tuple[AngleSummary, ...]]
    seed: int
    n_resamples: int
    n_flips: int

    @property
    def subjects(self) -> tuple[str, ...]:
        """The subjects, in order of appearance."""
        return tuple(dict.fromkeys(trial.subject for trial in self.trials))

    @property
    def is_offset_removed(self) -> bool:
        """Whether constant differences were taken out in any trial."""
        return any(trial.is_offset_removed for trial in self.trials)

    @property
    def mae_deg(self) -> float:
        """Mean over the angles of each angle's mean absolute error, degrees."""
        errors = [s.pooled.mae_deg for s in self.angles if s.pooled.n_samples]
        return sum(errors) / len(errors) if errors else math.nan


def pool_trials(
    trials: Sequence[TrialComparison],
    *,
    seed: int = 0,
    n_resamples: int = N_RESAMPLES,
    n_flips: int = N_FLIPS,
) -> Agreement:
    """Put compared trials together.

    Parameters
    ----------
    trials
        One or more; labels that occur twice for a subject are numbered.
    seed, n_resamples, n_flips
        Of bootstrap and permutation.

    Raises
    ------
    DataError
        If there is no trial.
    """
    if not trials:
        raise DataError("There is no trial to compare. Give at least one.")
    named = _tell_apart(trials)
    paired = [trial.as_paired_trial() for trial in named]
    options = {"seed": seed, "n_resamples": n_resamples, "n_flips": n_flips}
    tasks = tuple(dict.fromkeys(trial.task for trial in paired))
    by_task = {}
    if len(tasks) > 1:
        by_task = {
            task: _summarise([t for t in paired if t.task == task], **options) for task in tasks
        }
    return Agreement(
        trials=named,
        angles=_summarise(paired, **options),
        tasks=MappingProxyType(by_task),
        **options,
    )


def _summarise(
    paired: Sequence[PairedTrial], *, seed: int, n_resamples: int, n_flips: int
) -> tuple[AngleSummary, ...]:
    summaries = summarise_agreement(paired, seed=seed, n_resamples=n_resamples, n_flips=n_flips)
    return tuple(
        replace(
            s,
            bland_altman=_forget_wide_intervals(s.bland_altman),
            scalars=tuple(
                replace(q, bland_altman=_forget_wide_intervals(q.bland_altman)) for q in s.scalars
            ),
        )
        for s in summaries
    )


def _forget_wide_intervals(limits: BlandAltman) -> BlandAltman:
    """Treat an interval wider than a full turn as unknown: it says nothing about an angle.

    Frames worth hardly more than one independent sample give such.
    """

    def forget(interval: Interval) -> Interval:
        return UNKNOWN if interval.high - interval.low > FULL_TURN_DEG else interval

    return replace(
        limits,
        bias_interval=forget(limits.bias_interval),
        lower_interval=forget(limits.lower_interval),
        upper_interval=forget(limits.upper_interval),
    )


def _tell_apart(trials: Sequence[TrialComparison]) -> tuple[TrialComparison, ...]:
    """Add a number to labels that one subject has twice."""
    seen: dict[tuple[str, str], int] = {}
    named = []
    for trial in trials:
        key = (trial.subject, trial.label)
        seen[key] = seen.get(key, 0) + 1
        label = trial.label if seen[key] == 1 else f"{trial.label} ({seen[key]})"
        named.append(replace(trial, label=label))
    return tuple(named)


def describe_agreement(agreement: Agreement) -> tuple[str, ...]:
    """Say in plain sentences how far the result is off: all together, then angle by angle.

    The angles that lifting is judged by come first. What limits all sentences is said once.
    """
    known = {s.name: s for s in agreement.angles}
    order = [n for n in MAIN_ANGLES if n in known]
    order += [n for n in known if n not in MAIN_ANGLES]
    sentences = [describe_angle(known[name]) for name in order]
    scope = next((words for words in SCOPES if sentences[0].endswith(words)), "")
    lead = f"{_say_overall(agreement)} {scope}".strip()
    return (lead, *(s.removesuffix(scope).strip() for s in sentences))


def _say_overall(agreement: Agreement) -> str:
    seen = [s for s in agreement.angles if s.pooled.n_samples]
    best = min(seen, key=lambda s: s.pooled.mae_deg)
    worst = max(seen, key=lambda s: s.pooled.mae_deg)
    n_trials, n_subjects = len(agreement.trials), len(agreement.subjects)
    people = "1 person" if n_subjects == 1 else f"{n_subjects} persons"
    trials = "1 trial" if n_trials == 1 else f"{n_trials} trials"
    if len(seen) == 1:
        return f"{title_angle(best.name)} is {best.pooled.mae_deg:.1f}° off on average ({trials})."
    return (
        f"The {len(seen)} angles are {agreement.mae_deg:.1f}° off on average ({trials}, {people}): "
        f"least {title_angle(best.name).lower()} with {best.pooled.mae_deg:.1f}°, most "
        f"{title_angle(worst.name).lower()} with {worst.pooled.mae_deg:.1f}°."
    )


def describe_offsets(agreement: Agreement) -> str:
    """Say what was done with constant differences."""
    removed = [trial.is_offset_removed for trial in agreement.trials]
    recorded = any(trial.source == "recorded" for trial in agreement.trials)
    why = (
        "the recording's angles follow the definitions of another body model"
        if recorded
        else "this was asked for"
    )
    if all(removed):
        return (
            f"The constant difference of each angle and trial was taken out first, because {why}. "
            "It is listed as the offset; a true constant error can't be told from it."
        )
    if any(removed):
        return (
            f"In {sum(removed)} of {len(removed)} trials the constant difference of each angle was "
            f"taken out first, because {why}. It is listed as the offset."
        )
    if recorded:
        return (
            "Constant differences were kept, though the recording's angles follow the definitions "
            "of another body model: what is called an error may be a matter of definition."
        )
    return (
        "Both sets of angles were computed from joint positions in the same way, so a constant "
        "difference counts as error."
    )


def find_sides(agreement: Agreement) -> tuple[tuple[str, AngleSummary, AngleSummary], ...]:
    """Return (name without side, left, right) for every angle that both sides have."""
    known = {s.name: s for s in agreement.angles if s.pooled.n_samples}
    return tuple(
        (name[:-2], summary, known[f"{name[:-2]}_r"])
        for name, summary in known.items()
        if name.endswith("_l") and f"{name[:-2]}_r" in known
    )


def pooled_differences(trials: Sequence[TrialComparison], name: str) -> Array:
    """Return the known differences of one angle in all frames of all trials, degrees."""
    columns = [t.difference_deg[:, t.names.index(name)] for t in trials if name in t.names]
    joined = np.concatenate(columns)
    return np.asarray(joined[np.isfinite(joined)])


def bland_altman_points(trials: Sequence[TrialComparison], name: str) -> tuple[Array, Array]:
    """Return mean and difference of both curves, shape (n,) each, thinned evenly."""
    means, differences = [], []
    for trial in trials:
        if name in trial.names:
            i = trial.names.index(name)
            difference = trial.difference_deg[:, i]
            means.append(trial.pairs.reference_deg[:, i] + difference / 2)
            differences.append(difference)
    mean, difference = np.concatenate(means), np.concatenate(differences)
    known = np.isfinite(mean) & np.isfinite(difference)
    step = -(-int(known.sum()) // MAX_POINTS) or 1
    return np.asarray(mean[known][::step]), np.asarray(difference[known][::step])
