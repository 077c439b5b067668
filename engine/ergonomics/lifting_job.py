"""Jobs made of several lifts: composite, variable and sequential lifting indices.

Plain functions beside `engine.ergonomics.lifting_equation`; nothing here knows about videos.

References
----------
.. [1] Waters, Putz-Anderson & Garg (1994, revised 2021), Applications Manual for the Revised
   NIOSH Lifting Equation, DHHS (NIOSH) Publication 94-110, section 2 [V2].
.. [2] Waters, Occhipinti, Colombini, Alvarez-Casado & Fox (2016), Human Factors 58(5), 695-711:
   outline [V1], sextiles with their means [R].
.. [3] Waters, Lu & Occhipinti (2007), Ergonomics 50(11), 1761-1770 [R].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from engine.ergonomics.lifting_equation import (
    Duration,
    compute_frequency_multiplier,
    compute_lifting_index,
)
from engine.errors import DataError

__all__ = [
    "CompositeIndex",
    "LiftingTask",
    "TaskIndex",
    "TaskSet",
    "compute_cli",
    "compute_sli",
    "compute_vli",
]

N_VLI_CATEGORIES = 6
SHIFT_MIN = 480.0


@dataclass(frozen=True)
class LiftingTask:
    """One task of a job.

    `firwl_kg` is the frequency-independent recommended weight limit, the smaller of the evaluated
    ends; `V_cm` the height of the hands at the origin. The largest load governs strength, the mean
    load fatigue.
    """

    name: str
    firwl_kg: float
    V_cm: float
    frequency_per_min: float
    mean_load_kg: float
    max_load_kg: float

    def __post_init__(self) -> None:
        values = (
            self.firwl_kg,
            self.V_cm,
            self.frequency_per_min,
            self.mean_load_kg,
            self.max_load_kg,
        )
        if any(value < 0 for value in values):
            raise DataError(
                f"Task {self.name!r}: limit, height, frequency and loads can't be negative."
            )
        if self.mean_load_kg > self.max_load_kg:
            raise DataError(
                f"Task {self.name!r}: the mean load ({self.mean_load_kg:g} kg) can't be above the "
                f"largest ({self.max_load_kg:g} kg)."
            )


@dataclass(frozen=True)
class TaskIndex:
    """A task's indices; `increment` is what it adds to the composite index."""

    task: LiftingTask
    FM: float
    STRWL_kg: float
    FILI: float
    STLI: float
    increment: float = math.nan


@dataclass(frozen=True)
class CompositeIndex:
    """The composite lifting index, and its tasks in the order of the summation."""

    value: float
    tasks: tuple[TaskIndex, ...]


def _multiplier(frequency: float, duration: Duration, V_cm: float) -> float:
    return float(compute_frequency_multiplier(frequency, duration, V_cm))


def _compute_task(task: LiftingTask, duration: Duration) -> TaskIndex:
    multiplier = _multiplier(task.frequency_per_min, duration, task.V_cm)
    limit = task.firwl_kg * multiplier
    return TaskIndex(
        task=task,
        FM=multiplier,
        STRWL_kg=limit,
        FILI=compute_lifting_index(task.max_load_kg, task.firwl_kg),
        STLI=compute_lifting_index(task.mean_load_kg, limit),
    )


def compute_cli(tasks: Sequence[LiftingTask], duration: Duration) -> CompositeIndex:
    """Compute the composite lifting index of a job ([1], section 2.4).

    Parameters
    ----------
    tasks
        The tasks that are done in turn within one stretch of work.
    duration
        Class of the whole stretch.

    Returns
    -------
    CompositeIndex
        Infinite as soon as a frequency multiplier is 0; NaN where a task is not known.

    Raises
    ------
    DataError
        If there is no task.

    Notes
    -----
    The manual leaves open which column of the frequency table holds for the summed frequency:
    that of the task whose increment is computed is used here.
    """
    if not tasks:
        raise DataError("A job needs at least one lifting task.")
    found = [_compute_task(task, duration) for task in tasks]
    if any(math.isnan(index.STLI) or math.isnan(index.FILI) for index in found):
        return CompositeIndex(math.nan, tuple(found))
    # Rounded, so that equal indices tie whatever their last digit.
    found.sort(key=lambda index: (-round(index.STLI, 9), -index.task.frequency_per_min))
    ordered, summed = [], 0.0
    for k, index in enumerate(found):
        before, summed = summed, summed + index.task.frequency_per_min
        increment = index.STLI if k == 0 else _increment(index, duration, before, summed)
        ordered.append(
            TaskIndex(index.task, index.FM, index.STRWL_kg, index.FILI, index.STLI, increment)
        )
    return CompositeIndex(sum(index.increment for index in ordered), tuple(ordered))


def _increment(index: TaskIndex, duration: Duration, before: float, after: float) -> float:
    """Return what a further task adds: its strength index times the cost of the higher rate."""
    low, high = (_multiplier(rate, duration, index.task.V_cm) for rate in (before, after))
    if low == 0.0 or high == 0.0:
        return math.inf
    gain = 1.0 / high - 1.0 / low
    return index.FILI * gain if gain > 0 else 0.0


def compute_vli(
    fili: Sequence[float],
    frequency_per_min: float,
    duration: Duration,
    *,
    V_cm: float = 75.0,
) -> float:
    """Compute the variable lifting index from a sample of lifts [2].

    Parameters
    ----------
    fili
        Frequency-independent lifting index of every sampled lift.
    frequency_per_min
        Of all lifts together.
    duration
        Class of the work.
    V_cm
        Height that selects the column of the frequency table.

    Returns
    -------
    float
        The composite index of six groups of equal size, each with the mean of its lifts. Fewer
        than six lifts form as many groups as there are lifts. Experimental: the grouping was not
        checked against the publication.

    Raises
    ------
    DataError
        If there is no lift.
    """
    if len(fili) == 0:
        raise DataError("A variable lifting index needs at least one lift.")
    if any(math.isinf(value) for value in fili):
        return math.inf
    ordered = np.sort(np.asarray(fili, dtype=np.float64))
    groups = np.array_split(ordered, min(N_VLI_CATEGORIES, len(ordered)))
    tasks = [
        LiftingTask(
            name=f"category {k + 1}",
            firwl_kg=1.0,
            V_cm=V_cm,
            frequency_per_min=frequency_per_min * len(group) / len(ordered),
            mean_load_kg=float(group.mean()),
            max_load_kg=float(group.mean()),
        )
        for k, group in enumerate(groups)
    ]
    return compute_cli(tasks, duration).value


@dataclass(frozen=True)
class TaskSet:
    """A set of tasks in a rotation.

    `own_index` is its lifting index for its own continuous duration, `shift_index` that for the
    duration class of all lifting of the shift; `minutes` is its time.
    """

    own_index: float
    shift_index: float
    minutes: float


def compute_sli(sets: Sequence[TaskSet]) -> float:
    """Compute the sequential lifting index of a rotation between sets of tasks [3].

    Returns
    -------
    float
        Between the worst set's own index and its index for the whole shift. Experimental: the
        formula was not checked against the publication.

    Raises
    ------
    DataError
        If there is no set, or the times exceed a shift of 480 min.
    """
    if not sets:
        raise DataError("A sequential lifting index needs at least one set of tasks.")
    total = sum(part.minutes for part in sets)
    if any(part.minutes < 0 for part in sets) or total > SHIFT_MIN + 1e-9:
        raise DataError(
            f"The sets' times must be at least 0 and at most {SHIFT_MIN:g} min together, got "
            f"{total:g} min."
        )
    worst = max(sets, key=lambda part: part.shift_index)
    if worst.shift_index == 0.0 or math.isinf(worst.shift_index):
        return worst.shift_index
    weighted = sum(part.shift_index * part.minutes / SHIFT_MIN for part in sets)
    share = weighted / worst.shift_index
    return worst.own_index + (worst.shift_index - worst.own_index) * share
