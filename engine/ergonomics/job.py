"""A job made of several filmed tasks: composite index, cumulative load, and what stands out.

Every part is a trial with what it adds to the job: how often its lifts are done and, where the
tasks are done one after the other, for how long. The equation's indices are about the work, so
that parts may show different people; loads on the back add up in one back only.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from engine.datatypes import Flag, Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo
from engine.ergonomics.fatigue import compute_damage, compute_risk_percent
from engine.ergonomics.flags import raise_flags
from engine.ergonomics.lifting_equation import (
    MAX_DURATION_H,
    Duration,
    find_duration,
    repeat_session,
)
from engine.ergonomics.lifting_job import (
    CompositeIndex,
    LiftingTask,
    TaskSet,
    compute_cli,
    compute_sli,
    compute_vli,
)
from engine.ergonomics.methods.l5s1 import METHOD as L5S1
from engine.ergonomics.methods.lifft import METHOD as LIFFT
from engine.ergonomics.methods.rnle import METHOD as RNLE
from engine.ergonomics.methods.rnle import classify as classify_index
from engine.ergonomics.methods.rnle_job import METHOD as JOB
from engine.ergonomics.methods.rnle_job import read_tasks
from engine.ergonomics.work import classify, refuse
from engine.errors import ConfigError

__all__ = ["JobPart", "JobResult", "PartResult", "assess_job"]

MINUTES_PER_H = 60.0


@dataclass(frozen=True, eq=False)
class JobPart:
    """One filmed task of a job.

    `frequency_per_min` is the rate of its lifts, all lifts of the trial together: over the whole
    stretch where the tasks alternate, over its own time in a rotation. `duration_h` is that time,
    in a rotation only.
    """

    name: str
    exposure: Exposure
    frequency_per_min: float
    duration_h: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.frequency_per_min <= 60.0:
            raise ConfigError(
                f"{self.name}: the frequency must lie between 0 and 60 lifts per minute, got "
                f"{self.frequency_per_min:g}."
            )
        if self.duration_h is not None and not 0.0 < self.duration_h <= 24.0:
            raise ConfigError(
                f"{self.name}: the time must be above 0 h and at most 24 h, got "
                f"{self.duration_h:g} h."
            )


@dataclass(frozen=True, eq=False)
class PartResult:
    """What one part is and adds.

    `rnle` is the equation at the part's own rate and the job's duration, `lifft` the damage of its
    lifts of a day; `lifts_per_day` and their `share` of all; `moment_nm_s` is the L5/S1 moment
    times time of a day, NaN where not known.
    """

    name: str
    person: str
    rnle: RiskResult
    back: RiskResult
    lifft: RiskResult
    lifts_per_day: float
    share: float
    moment_nm_s: float

    @property
    def damage(self) -> float:
        """LiFFT's damage of a day; NaN where not known."""
        known = self.lifft.is_applicable
        return float(self.lifft.details["damage_per_day"]) if known else math.nan


@dataclass(frozen=True, eq=False)
class JobResult:
    """What the parts amount to.

    `risk` holds the results for the job as a whole by method (`rnle_job`, `lifft`, `l5s1`, and with
    the experimental switch `rnle_vli`, `rnle_sli`); refused ones say why. `reasons` hold for the
    job as a whole.
    """

    parts: tuple[PartResult, ...]
    risk: dict[str, RiskResult]
    flags: tuple[Flag, ...]
    duration: Duration
    reasons: tuple[str, ...]


def assess_job(
    parts: Sequence[JobPart],
    *,
    duration_h: float | None = None,
    recovery_h: float | None = None,
    experimental: bool = False,
) -> JobResult:
    """Judge several filmed tasks as one job.

    Parameters
    ----------
    parts
        The tasks. In a rotation each has its own `duration_h`; if none has, the tasks alternate
        within one stretch.
    duration_h, recovery_h
        Length of that stretch, and of the light work after it. In a rotation the stretch is the
        sum of the parts.
    experimental
        Whether the variable and the sequential index are computed as well.

    Returns
    -------
    JobResult
        Parts without lifts or load are named in the results that need them; the others run.

    Raises
    ------
    ConfigError
        If there is no part, the work is longer than 8 h, its length is not known, or only some
        parts have a time of their own.
    """
    total_h, is_rotation = _find_length(parts, duration_h)
    duration = _find_class(total_h, recovery_h)
    found = tuple(_assess_part(part, total_h, duration) for part in parts)
    every = sum(part.lifts_per_day for part in found)
    found = tuple(
        replace(part, share=part.lifts_per_day / every if every > 0 else 0.0) for part in found
    )
    risk = {"rnle_job": _compose_index(parts, found, duration, total_h)}
    risk["lifft"] = _add_damage(found)
    risk["l5s1"] = _add_back(found)
    if experimental:
        risk["rnle_vli"] = _compose_variable(parts, found, duration, total_h)
        if is_rotation:
            risk["rnle_sli"] = _compose_sequential(parts, found, duration)
    judged = {name: result for name, result in risk.items() if name != "rnle_sli"}
    lifts = tuple(lift for part in parts for lift in part.exposure.lifts)
    flags = raise_flags(judged, lifts, {})
    return JobResult(found, risk, flags, duration, tuple(_list_reasons(parts, found, is_rotation)))


def _find_length(parts: Sequence[JobPart], duration_h: float | None) -> tuple[float, bool]:
    if not parts:
        raise ConfigError("A job needs at least one task; add a trial.")
    own = [part.duration_h for part in parts if part.duration_h is not None]
    if own and len(own) < len(parts):
        missing = next(part.name for part in parts if part.duration_h is None)
        raise ConfigError(
            f"{missing} has no time of its own, but others have: give every task its time, or none."
        )
    total = sum(own) if own else duration_h
    if total is None or not total > 0:
        raise ConfigError("How long the work lasts is not known: give the hours of lifting a day.")
    if total > MAX_DURATION_H + 1e-9:
        raise ConfigError(
            f"The tasks take {total:g} h together; the indices cover at most {MAX_DURATION_H:g} h "
            "a day. Shorten the work, or leave a task out."
        )
    return total, bool(own)


def _find_class(total_h: float, recovery_h: float | None) -> Duration:
    sessions = [(total_h, math.inf)] if recovery_h is None else repeat_session(total_h, recovery_h)
    return find_duration(sessions) or Duration.LONG


def _rate_over_job(part: JobPart, total_h: float) -> float:
    """Return the part's rate over the whole stretch, lifts per minute."""
    return part.frequency_per_min * (1.0 if part.duration_h is None else part.duration_h / total_h)


_HOURS = {Duration.SHORT: 1.0, Duration.MODERATE: 2.0, Duration.LONG: 8.0}


def _assess_part(part: JobPart, total_h: float, duration: Duration) -> PartResult:
    exposure = part.exposure
    own_h = total_h if part.duration_h is None else part.duration_h
    work = replace(exposure.task, frequency_per_min=part.frequency_per_min, duration_h=own_h)
    # The equation's class is that of the whole stretch, whatever the part's own time.
    classed = replace(work, duration_h=_HOURS[duration], recovery_h=None)
    back = L5S1.assess(exposure)
    per_day = MINUTES_PER_H * part.frequency_per_min * own_h
    moments = [
        float(lift.details["cumulative_moment_lift_nm_s"])
        for lift in back.per_lift
        if lift.is_applicable
    ]
    has_load = exposure.task.load_kg is not None
    return PartResult(
        name=part.name,
        person=exposure.subject.label,
        rnle=RNLE.assess(replace(exposure, task=classed)),
        back=back,
        lifft=LIFFT.assess(replace(exposure, task=work)),
        lifts_per_day=per_day,
        share=0.0,
        moment_nm_s=per_day * sum(moments) / len(moments) if moments and has_load else math.nan,
    )


# --------------------------------------------------------------------------- the equation


def _compose_index(
    parts: Sequence[JobPart], found: Sequence[PartResult], duration: Duration, total_h: float
) -> RiskResult:
    """Return the composite index of all lifts of all parts."""
    refusals = list(_find_refusals(parts, found))
    if refusals:
        return refuse(JOB.info, *refusals)
    index = compute_cli(_list_tasks(parts, found, total_h), duration)
    high, low = (
        compute_cli(_list_tasks(parts, found, total_h, bound=k), duration).value for k in (0, 1)
    )
    level = classify_index(index.value)
    doubts = [*_doubt_rate(index, duration), *_list_doubts(found)]
    return RiskResult(
        method=JOB.info.name,
        value=index.value,
        category="unknown" if level is None else level.name,
        inputs=tuple(_list_inputs(parts, total_h, duration)),
        steps=tuple(_explain(index, duration)),
        interval=(low, high),
        reference=JOB.info.reference,
        reasons=tuple(doubts),
        details={
            "cli": index.value,
            "duration_class": duration.value,
            "tasks": [_describe_task(task.task.name, index) for task in index.tasks],
            "assumptions": [],
            "doubts": doubts,
        },
    )


def _find_refusals(parts: Sequence[JobPart], found: Sequence[PartResult]) -> Iterator[str]:
    for part, result in zip(parts, found, strict=True):
        if part.frequency_per_min == 0.0:
            continue
        if part.exposure.task.load_kg is None:
            yield f"the load of {part.name} is not given: give it to add the task to the index"
        elif not any(lift.is_applicable for lift in result.rnle.per_lift):
            yield f"{part.name}: {'; '.join(result.rnle.reasons)}"
    if all(part.frequency_per_min == 0.0 for part in parts):
        yield "no task is ever done: every frequency is 0"


def _list_tasks(
    parts: Sequence[JobPart],
    found: Sequence[PartResult],
    total_h: float,
    *,
    bound: int | None = None,
) -> list[LiftingTask]:
    """Return one task per lift of every part that is done at all."""
    tasks: list[LiftingTask] = []
    for part, result in zip(parts, found, strict=True):
        lifts = [lift for lift in result.rnle.per_lift if lift.is_applicable]
        rate = _rate_over_job(part, total_h)
        if rate > 0 and lifts:
            own = read_tasks(lifts, rate, part.exposure.task.load_kg or 0.0, bound=bound)
            tasks += [replace(task, name=f"{part.name}, {task.name}") for task in own]
    return tasks


def _list_doubts(found: Sequence[PartResult]) -> Iterator[str]:
    """Say every doubt once: with the first part that has it, and how many more do."""
    known: dict[str, list[tuple[str, str]]] = {}
    for part in found:
        unseen = sum(not lift.is_applicable for lift in part.rnle.per_lift)
        doubts = [d for lift in part.rnle.per_lift for d in lift.details.get("doubts", ())]
        if unseen:
            doubts.append(f"{unseen} of {len(part.rnle.per_lift)} lifts could not be judged")
        for doubt in dict.fromkeys(doubts):
            # The same sentence with another number is the same doubt.
            known.setdefault(re.sub(r"[\d.]+", "#", doubt), []).append((part.name, doubt))
    for parts in known.values():
        name, doubt = parts[0]
        others = len({other for other, _ in parts} - {name})
        more = f" and {others} more" if others else ""
        yield f"{name}{more}: {doubt}"


def _doubt_rate(index: CompositeIndex, duration: Duration) -> Iterator[str]:
    """Say why there is no limit left, where it is the rate of all tasks together."""
    is_alone = all(math.isfinite(task.STLI) for task in index.tasks)
    if math.isinf(index.value) and is_alone:
        rate = sum(task.task.frequency_per_min for task in index.tasks)
        yield (
            f"the tasks together make {rate:.3g} lifts per minute, more than the equation's table "
            f"has for {duration} duration"
        )


def _list_inputs(
    parts: Sequence[JobPart], total_h: float, duration: Duration
) -> Iterator[RiskInput]:
    user = Provenance.USER
    for part in parts:
        rate = _rate_over_job(part, total_h)
        yield RiskInput(f"frequency, {part.name}", rate, "1/min", user)
        yield RiskInput(f"load, {part.name}", part.exposure.task.load_kg, "kg", user)
    yield RiskInput("duration", total_h, "h", user)
    yield RiskInput("duration class", duration.value, "", Provenance.DERIVED)


def _explain(index: CompositeIndex, duration: Duration) -> Iterator[str]:
    rate = sum(task.task.frequency_per_min for task in index.tasks)
    number = len(index.tasks)
    lifts = "1 lift has" if number == 1 else f"{number} lifts share"
    yield f"{lifts} {rate:.3g} per minute, {duration} duration; most demanding first"
    for k, task in enumerate(index.tasks):
        added = "the index starts with STLI" if k == 0 else f"adds {task.increment:.3f}"
        yield (
            f"{task.task.name}: {task.task.frequency_per_min:.3g} per minute, FIRWL = "
            f"{task.task.firwl_kg:.2f} kg, FM = {task.FM:.3f}, STRWL = {task.STRWL_kg:.2f} kg, "
            f"FILI = {task.FILI:.2f}, STLI = {task.STLI:.2f}; {added}"
        )
    yield f"CLI = {index.value:.2f}"


def _describe_task(name: str, index: CompositeIndex) -> dict[str, Any]:
    task = next(one for one in index.tasks if one.task.name == name)
    return {
        "name": name,
        "frequency_per_min": task.task.frequency_per_min,
        "FIRWL_kg": task.task.firwl_kg,
        "STRWL_kg": task.STRWL_kg,
        "FILI": task.FILI,
        "STLI": task.STLI,
        "increment": task.increment,
    }


_VLI = MethodInfo(
    name="rnle_vli",
    title="Variable lifting index of the job",
    reference="Waters et al. (2016), Human Factors 58(5):695-711: outline [V1], grouping [R].",
    verification="R",
    levels=JOB.info.levels,
    value_name="variable lifting index",
)
_SLI = MethodInfo(
    name="rnle_sli",
    title="Sequential lifting index of the rotation",
    reference="Waters, Lu & Occhipinti (2007), Ergonomics 50(11):1761-1770: formula recalled [R].",
    verification="R",
    levels=JOB.info.levels,
    value_name="sequential lifting index",
)


def _compose_variable(
    parts: Sequence[JobPart], found: Sequence[PartResult], duration: Duration, total_h: float
) -> RiskResult:
    """Return the variable index: every lift weighs by how often it is done."""
    refusals = list(_find_refusals(parts, found))
    if refusals:
        return refuse(_VLI, *refusals)
    tasks = _list_tasks(parts, found, total_h)
    rate = sum(task.frequency_per_min for task in tasks)
    fili = [math.inf if t.firwl_kg == 0 else t.max_load_kg / t.firwl_kg for t in tasks]
    # The sample stands for the job: a lift that is done more often is in it more often.
    least = min(task.frequency_per_min for task in tasks)
    repeated = [
        value
        for value, task in zip(fili, tasks, strict=True)
        for _ in range(max(1, round(min(50.0, task.frequency_per_min / least))))
    ]
    value = compute_vli(repeated, rate, duration)
    return _state_experimental(_VLI, value, f"VLI = {value:.2f} of {len(tasks)} different lifts")


def _compose_sequential(
    parts: Sequence[JobPart], found: Sequence[PartResult], duration: Duration
) -> RiskResult:
    """Return the sequential index: every task with its own time, one after the other."""
    refusals = list(_find_refusals(parts, found))
    if refusals:
        return refuse(_SLI, *refusals)
    sets = []
    for part, result in zip(parts, found, strict=True):
        hours = part.duration_h or 0.0
        tasks = _list_tasks([part], [result], hours)
        if tasks:
            own = compute_cli(tasks, _find_class(hours, None)).value
            shift = compute_cli(tasks, duration).value
            sets.append(TaskSet(own, shift, MINUTES_PER_H * hours))
    value = compute_sli(sets)
    return _state_experimental(_SLI, value, f"SLI = {value:.2f} of {len(sets)} tasks in turn")


def _state_experimental(info: MethodInfo, value: float, step: str) -> RiskResult:
    level = classify_index(value)
    doubt = "experimental: the formula was not checked against its publication"
    return RiskResult(
        method=info.name,
        value=value,
        category="unknown" if level is None else level.name,
        steps=(step,),
        reference=info.reference,
        reasons=(doubt,),
        details={"assumptions": [], "doubts": [doubt]},
    )


# --------------------------------------------------------------------------- the back


def _add_damage(found: Sequence[PartResult]) -> RiskResult:
    """Return LiFFT of the whole day: damages add up."""
    done = [part for part in found if part.lifts_per_day > 0]
    unknown = [part.name for part in done if math.isnan(part.damage)]
    if unknown:
        return refuse(
            LIFFT.info,
            f"{', '.join(unknown)}: load or hands are not known, so that the day's sum is not",
        )
    damage = sum(part.damage for part in done)
    low, high = (
        sum(compute_damage(part.lifft.interval[k], "lifft") for part in done) for k in (0, 1)
    )
    value = compute_risk_percent(damage, "lifft")
    level = classify(LIFFT.info.levels, value)
    steps = [
        f"{part.name}: {part.lifts_per_day:.0f} lifts a day, damage {part.damage:.3g} "
        f"({100 * part.damage / damage:.0f} % of the day's)"
        for part in done
    ]
    doubts = list(_doubt_persons(found))
    return RiskResult(
        method=LIFFT.info.name,
        value=value,
        unit="%",
        category="unknown" if level is None else level.name,
        steps=(*steps, f"Damage of the day {damage:.3g}", f"Probability {value:.1f} %"),
        interval=(compute_risk_percent(low, "lifft"), compute_risk_percent(high, "lifft")),
        reference=LIFFT.info.reference,
        reasons=tuple(doubts),
        details={
            "damage_per_day": damage,
            "lifts_per_day": sum(part.lifts_per_day for part in done),
            "assumptions": [],
            "doubts": doubts,
        },
    )


def _doubt_persons(found: Sequence[PartResult]) -> Iterator[str]:
    persons = sorted({part.person for part in found})
    if len(persons) > 1:
        yield (
            f"the parts show {', '.join(persons)}: the sum is of one person who does it all as "
            "they do"
        )


def _add_back(found: Sequence[PartResult]) -> RiskResult:
    """Return the highest peak of all parts, with the moment times time of the day."""
    done = [part for part in found if part.lifts_per_day > 0]
    seen = [part for part in done if part.back.is_applicable]
    if not seen:
        return refuse(L5S1.info, "no part shows trunk, head and arms while a load is held")
    worst = max(seen, key=lambda part: part.back.value)
    persons = sorted({part.person for part in done})
    missing = [part.name for part in done if math.isnan(part.moment_nm_s)]
    dose, doubts = math.nan, [f"{worst.name}: {d}" for d in worst.back.details["doubts"]]
    if len(persons) > 1:
        doubts.append(
            f"the parts show {', '.join(persons)}: loads of different backs are not added up"
        )
    elif missing:
        doubts.append(f"{', '.join(missing)}: not known, so that no sum of the day is given")
    else:
        dose = sum(part.moment_nm_s for part in done)
    steps = [f"Highest in {worst.name}", *worst.back.steps]
    if math.isfinite(dose):
        steps.append(f"Moment times time, all lifts of the day: {dose / 3600:.1f} N m h")
    return replace(
        worst.back,
        lift_index=None,
        per_lift=(),
        steps=tuple(steps),
        reasons=(*worst.back.details["assumptions"], *doubts),
        details={
            **worst.back.details,
            "doubts": doubts,
            "part": worst.name,
            "moment_dose_nm_s": dose,
        },
    )


def _list_reasons(
    parts: Sequence[JobPart], found: Sequence[PartResult], is_rotation: bool
) -> Iterator[str]:
    persons = sorted({part.person for part in found})
    if len(persons) > 1:
        yield (
            f"The parts show different people ({', '.join(persons)}). The lifting equation judges "
            "the work, not the person, so that its index holds; it is that of whoever reaches as "
            "they do."
        )
    idle = [part.name for part in parts if part.frequency_per_min == 0.0]
    if idle:
        yield f"{', '.join(idle)}: never done (frequency 0), and left out."
    if is_rotation:
        yield (
            "The composite index spreads every task over the whole stretch, as if the tasks "
            "alternated; in a rotation the back works in blocks, which may be harder."
        )
