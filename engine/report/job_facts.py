"""What a summary of several trials states: counts, worst lifts, frequent changes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from engine.datatypes import FlagLevel
from engine.report.facts import URGENCY, LiftFacts, TrialFacts, fingerprint

__all__ = [
    "GroupFacts",
    "JobFacts",
    "WorstLift",
    "list_jobs",
    "summarise_trials",
]

LEVELS: tuple[FlagLevel | None, ...] = (*URGENCY, None)


@dataclass(frozen=True, eq=False)
class WorstLift:
    """One lift with the trial it belongs to; `number` is that of the trial in the report."""

    number: int
    trial: TrialFacts
    lift: LiftFacts


@dataclass(frozen=True, eq=False)
class GroupFacts:
    """Several trials in order of time.

    `lift_levels` and `trial_levels` count by level; `worst` are the lifts with a lifting index, the
    highest first; `changes` are what to do and in how many trials it is asked for.
    """

    trials: tuple[TrialFacts, ...]
    lift_levels: tuple[tuple[FlagLevel | None, int], ...]
    trial_levels: tuple[tuple[FlagLevel | None, int], ...]
    worst: tuple[WorstLift, ...]
    changes: tuple[tuple[str, int], ...]

    @property
    def n_lifts(self) -> int:
        """Number of lifts."""
        return sum(len(trial.lifts) for trial in self.trials)

    @property
    def persons(self) -> tuple[str, ...]:
        """The pseudonyms, each once."""
        return tuple(sorted({trial.person for trial in self.trials}))

    @property
    def level(self) -> FlagLevel | None:
        """The worst level of a trial."""
        return next((level for level, n in self.trial_levels if n and level is not None), None)

    @property
    def n_high_lifts(self) -> int:
        """Number of lifts at high risk."""
        return dict(self.lift_levels)[FlagLevel.HIGH]


@dataclass(frozen=True, eq=False)
class JobFacts:
    """The trials of one job within a department."""

    name: str
    group: GroupFacts


def summarise_trials(trials: Iterable[TrialFacts]) -> GroupFacts:
    """Put trials in order of time, undated ones last, and count."""
    ordered = sorted(trials, key=_when)
    lifts = [
        WorstLift(number, trial, lift)
        for number, trial in enumerate(ordered, start=1)
        for lift in trial.lifts
    ]
    known = [entry for entry in lifts if not math.isnan(entry.lift.lifting_index)]
    return GroupFacts(
        trials=tuple(ordered),
        lift_levels=_count(entry.lift.level for entry in lifts),
        trial_levels=_count(trial.level for trial in ordered),
        worst=tuple(sorted(known, key=lambda e: (-e.lift.lifting_index, e.number))),
        changes=_count_changes(ordered),
    )


def list_jobs(group: GroupFacts) -> tuple[JobFacts, ...]:
    """Return the jobs of a department, the one with the most urgent lifts first."""
    names = dict.fromkeys(trial.job for trial in group.trials)
    jobs = [
        JobFacts(name, summarise_trials(t for t in group.trials if t.job == name)) for name in names
    ]
    return tuple(sorted(jobs, key=_job_key))


def _job_key(job: JobFacts) -> tuple[int, float, str]:
    worst = job.group.worst[0].lift.lifting_index if job.group.worst else 0.0
    return LEVELS.index(job.group.level), -worst, job.name


def _when(trial: TrialFacts) -> tuple[bool, float, str, str]:
    stamp = 0.0 if trial.created is None else trial.created.timestamp()
    return trial.created is None, stamp, trial.label, fingerprint(trial.stored.document)


def _count(levels: Iterable[FlagLevel | None]) -> tuple[tuple[FlagLevel | None, int], ...]:
    counts = Counter(levels)
    return tuple((level, counts[level]) for level in LEVELS)


def _count_changes(trials: Sequence[TrialFacts]) -> tuple[tuple[str, int], ...]:
    counts: Counter[str] = Counter()
    for trial in trials:
        counts.update(dict.fromkeys((change.action for change in trial.changes), 1))
    return tuple(counts.most_common())
