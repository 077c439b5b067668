"""Did the change work: two sets of trials of one job, before and after.

What is compared is the trial: the mean of its lifts. How sure a difference is follows from the
repetitions: of persons where several were filmed both times, of trials where one person was. One
trial each leaves the measuring error only, which is less than what a repetition would show.

References
----------
.. [1] Weir (2005), J. Strength Cond. Res. 19(1), 231-240: standard error of measurement and minimal
   detectable change.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np

from engine.datatypes import Array, JointAngles, Lift, Measurement, RiskResult, Subject, Task
from engine.errors import DataError

__all__ = [
    "MEASURES",
    "BeforeAfter",
    "Measure",
    "MeasureChange",
    "TrialMeasures",
    "Verdict",
    "compare_before_after",
    "measure_trial",
]

LEVEL = 0.95
Z_95 = 1.96
MAX_ARRANGEMENTS = 20_000
"""Up to so many arrangements the permutation test is exact; beyond them it is left out."""
MIN_PERSONS = 3
"""From so many different persons on either side, sets without a person in common are compared."""


class Verdict(StrEnum):
    """What a difference amounts to."""

    IMPROVED = "improved"
    NOT_DISTINGUISHABLE = "not distinguishable"
    WORSE = "worse"


Better = Literal["lower", "higher", ""]
Unit = Literal["persons", "trials", "measuring error"]


@dataclass(frozen=True)
class Measure:
    """One number of a trial: its name and unit, which way is better, how many decimals to show."""

    key: str
    name: str
    unit: str
    better: Better
    decimals: int = 1


MEASURES: tuple[Measure, ...] = (
    Measure("li", "lifting index", "", "lower"),
    Measure("rwl", "recommended weight limit", "kg", "higher"),
    Measure("compression", "peak compression at L5/S1", "N", "lower", 0),
    Measure("origin_H", "reach at the start (H)", "cm", "lower", 0),
    Measure("origin_V", "height at the start (V)", "cm", "", 0),
    Measure("destination_H", "reach at the end (H)", "cm", "lower", 0),
    Measure("destination_V", "height at the end (V)", "cm", "", 0),
    Measure("trunk", "largest forward bend of the trunk", "deg", "lower", 0),
    Measure("reba", "REBA", "", "lower"),
    Measure("rula", "RULA", "", "lower"),
    Measure("lifft", "LiFFT, probability of a high-risk job", "%", "lower", 0),
    Measure("lm_mmh", "women for whom the load is too heavy", "%", "lower", 0),
)
PRIMARY = ("li", "rwl", "compression")
"""The verdict as a whole is that of the first of these that could be compared."""


@dataclass(frozen=True)
class TrialMeasures:
    """The numbers of one trial, with their measuring errors.

    `values` holds, by key of `MEASURES`, what could be told. `settings` name how the trial was
    measured (estimator, solver), so that unlike ones are not compared unnoticed.
    """

    label: str
    person: str
    task: Task
    values: Mapping[str, Measurement]
    settings: Mapping[str, str] = field(default_factory=dict)


def measure_trial(
    *,
    label: str,
    subject: Subject,
    task: Task,
    lifts: Sequence[Lift],
    angles: JointAngles,
    risk: Mapping[str, RiskResult],
    settings: Mapping[str, str] | None = None,
) -> TrialMeasures:
    """Collect the numbers of one trial: means over its lifts, with their common measuring error."""
    values: dict[str, Measurement] = {}
    for key, method in (("li", "rnle"), ("compression", "l5s1"), ("lm_mmh", "lm_mmh")):
        values[key] = _mean([_read(part) for part in _parts(risk.get(method))])
    values["rwl"] = _mean([_read_limit(part) for part in _parts(risk.get("rnle"))])
    for key in ("reba", "rula", "lifft"):
        whole = risk.get(key)
        values[key] = Measurement(math.nan) if whole is None else _read(whole)
    for end in ("origin", "destination"):
        values[f"{end}_H"] = _mean([getattr(lift, end).H_cm for lift in lifts])
        values[f"{end}_V"] = _mean([getattr(lift, end).V_cm for lift in lifts])
    values["trunk"] = _mean([_largest_bend(angles, lift) for lift in lifts])
    known = {key: value for key, value in values.items() if not math.isnan(value.value)}
    return TrialMeasures(label, subject.label, task, known, settings or {})


def _parts(result: RiskResult | None) -> Sequence[RiskResult]:
    if result is None:
        return ()
    return [part for part in result.per_lift or (result,) if part.is_applicable]


def _read(result: RiskResult) -> Measurement:
    if not result.is_applicable:
        return Measurement(math.nan)
    return Measurement(result.value, _half_width(result.interval))


def _half_width(interval: tuple[float, float]) -> float:
    low, high = interval
    return (high - low) / (2 * Z_95) if math.isfinite(high - low) else math.nan


def _read_limit(result: RiskResult) -> Measurement:
    low, high = result.details.get("rwl_interval_kg", (math.nan, math.nan))
    unknown = low is None or high is None
    sigma = math.nan if unknown else _half_width((low, high))
    return Measurement(float(result.details.get("rwl_kg", math.nan)), sigma)


def _mean(items: Sequence[Measurement]) -> Measurement:
    known = [item for item in items if not item.is_missing]
    if not known:
        return Measurement(math.nan)
    # The lifts of one clip share camera and scale: their errors don't average out.
    return Measurement(
        float(np.mean([item.value for item in known])),
        float(np.mean([item.sigma for item in known])),
    )


def _largest_bend(angles: JointAngles, lift: Lift) -> Measurement:
    if "trunk_inclination" not in angles.names:
        return Measurement(math.nan)
    held = (angles.time_s >= lift.start_s) & (angles.time_s <= lift.end_s)
    bend = np.where(held, angles["trunk_inclination"], np.nan)
    if not np.isfinite(bend).any():
        return Measurement(math.nan)
    frame = int(np.nanargmax(bend))
    return Measurement(float(bend[frame]), float(angles.sigma("trunk_inclination")[frame]))


# --------------------------------------------------------------------------- comparison


@dataclass(frozen=True)
class MeasureChange:
    """How one measure changed.

    `difference` is after minus before with its 95 % interval; `unit_of_analysis` says what was
    repeated, `n` how often, before and after. `p` is that of the exact permutation test (NaN where
    there is nothing to permute). `sem` is the standard error of measurement of one trial from the
    repetitions, `mdc` the smallest change between two single trials that is none of it; both from
    the measuring error where nothing was repeated.
    """

    measure: Measure
    before: float
    after: float
    difference: float
    interval: tuple[float, float]
    verdict: Verdict
    unit_of_analysis: Unit
    n: tuple[int, int]
    p: float = math.nan
    sem: float = math.nan
    mdc: float = math.nan

    @property
    def sentence(self) -> str:
        """The change in one sentence, with numbers and unit."""
        digits, unit = self.measure.decimals, self.measure.unit and f" {self.measure.unit}"
        name = self.measure.name[:1].upper() + self.measure.name[1:]
        low, high = self.interval
        sure = (
            "no interval known"
            if math.isnan(low)
            else f"95 % interval {low:+.{digits}f} to {high:+.{digits}f}"
        )
        return (
            f"{name} {self.before:.{digits}f} -> {self.after:.{digits}f}{unit}: difference "
            f"{self.difference:+.{digits}f} ({sure}), {self.verdict}."
        )


@dataclass(frozen=True)
class BeforeAfter:
    """The comparison of two sets of trials.

    `verdict` is None where the sets must not be compared; `reasons` then say why, else what to
    keep in mind. `sentence` is the outcome in words.
    """

    verdict: Verdict | None
    sentence: str
    changes: tuple[MeasureChange, ...]
    reasons: tuple[str, ...]
    n: tuple[int, int]
    unit_of_analysis: Unit = "measuring error"


def compare_before_after(
    before: Sequence[TrialMeasures], after: Sequence[TrialMeasures]
) -> BeforeAfter:
    """Compare two sets of trials of one job.

    Parameters
    ----------
    before, after
        The trials of either set.

    Returns
    -------
    BeforeAfter
        One row per measure that both sets have. Several persons filmed both times: paired
        differences of the persons' means, Student's t. One person: his or her trials, Welch's t.
        One trial each: the measuring errors, taken as independent.

    Raises
    ------
    DataError
        If a set is empty, or a trial is in both.
    """
    if not before or not after:
        raise DataError("Before and after need at least one trial each; choose them.")
    shared = {id(one) for one in before} & {id(one) for one in after}
    if shared:
        raise DataError("A trial can't be before and after at once; leave it out of one set.")
    n = len(before), len(after)
    persons = [sorted({one.person for one in part}) for part in (before, after)]
    refusal = _find_refusal(persons)
    reasons = list(_list_reasons(before, after, persons))
    if refusal:
        return BeforeAfter(None, refusal, (), (*reasons,), n)
    changes = []
    for measure in MEASURES:
        change = _compare_measure(measure, before, after)
        if change is not None:
            changes.append(change)
        elif any(measure.key in one.values for one in (*before, *after)):
            reasons.append(f"{measure.name} is not known of all trials, and not compared")
    verdict, sentence, unit = _sum_up(changes)
    reasons += _list_limits_of(unit)
    return BeforeAfter(verdict, sentence, tuple(changes), tuple(reasons), n, unit)


def _find_refusal(persons: Sequence[Sequence[str]]) -> str:
    one, two = persons
    if set(one) & set(two) or min(len(one), len(two)) >= MIN_PERSONS:
        return ""
    return (
        f"Before shows {', '.join(one)}, after shows {', '.join(two)}: with different people, a "
        "difference may be theirs and not that of the work. Film the same person both times, or "
        f"at least {MIN_PERSONS} persons each time."
    )


def _list_reasons(
    before: Sequence[TrialMeasures],
    after: Sequence[TrialMeasures],
    persons: Sequence[Sequence[str]],
) -> Iterator[str]:
    common = set(persons[0]) & set(persons[1])
    if common and (set(persons[0]) | set(persons[1])) - common:
        yield "only persons who were filmed both times count: " + ", ".join(sorted(common))
    for key, word, unit in _TASK_WORDS:
        values = [_distinct(getattr(one.task, key) for one in part) for part in (before, after)]
        if values[0] != values[1]:
            yield (
                f"{word} differs, {_write(values[0], unit)} before and {_write(values[1], unit)} "
                "after: what it changes is in the difference"
            )
    names = sorted({name for one in (*before, *after) for name in one.settings})
    for name in names:
        kinds = [_distinct(one.settings.get(name) for one in part) for part in (before, after)]
        if kinds[0] != kinds[1]:
            yield (
                f"the {name} differs, {_write(kinds[0])} before and {_write(kinds[1])} after: a "
                "difference may come from it; assess all videos in the same way"
            )


_TASK_WORDS = (
    ("load_kg", "the load", "kg"),
    ("frequency_per_min", "the lifting frequency", "per minute"),
    ("duration_h", "the duration", "h"),
    ("coupling", "the grip", ""),
    ("hands", "the number of hands", ""),
    ("destination_control", "whether the load is placed with care", ""),
)


def _distinct(values: Iterator[object]) -> tuple[object, ...]:
    return tuple(sorted(set(values), key=str))


def _write(values: Sequence[object], unit: str = "") -> str:
    known = ["not given" if value is None else f"{value} {unit}".strip() for value in values]
    return " or ".join(known)


def _list_limits_of(unit: Unit) -> Iterator[str]:
    if unit == "measuring error":
        yield (
            "one trial each: the intervals hold the measuring error only, not how a person varies "
            "from lift to lift; film three or more trials each time"
        )
    elif unit == "trials":
        yield "one person: the verdict is about this person, not about others"
    if unit != "measuring error":
        yield (
            "what errs alike in all trials of a set (the camera's place, the stature) is not in "
            "the intervals; film both times from the same place"
        )


@dataclass(frozen=True, eq=False)
class _Samples:
    """The trials of one measure: values, measuring errors and persons, before and after."""

    values: tuple[Array, Array]
    sigmas: tuple[Array, Array]
    persons: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def common(self) -> list[str]:
        return sorted(set(self.persons[0]) & set(self.persons[1]))

    def of(self, person: str) -> tuple[Array, Array]:
        """Return the values of one person, before and after."""
        one, two = (
            values[[name == person for name in names]]
            for values, names in zip(self.values, self.persons, strict=True)
        )
        return one, two


def _compare_measure(
    measure: Measure, before: Sequence[TrialMeasures], after: Sequence[TrialMeasures]
) -> MeasureChange | None:
    samples = _gather(measure, before, after)
    if samples is None:
        return None
    one, two = samples.values
    unit, difference, sigma, freedom, p, counts = _analyse(samples)
    half = _t_quantile(freedom) * sigma
    interval = (difference - half, difference + half)
    sem = _standard_error_of_measurement(samples)
    return MeasureChange(
        measure=measure,
        before=float(one.mean()),
        after=float(two.mean()),
        difference=difference,
        interval=interval,
        verdict=_judge(measure, interval),
        unit_of_analysis=unit,
        n=counts,
        p=p,
        sem=sem,
        mdc=Z_95 * math.sqrt(2.0) * sem,
    )


def _gather(
    measure: Measure, before: Sequence[TrialMeasures], after: Sequence[TrialMeasures]
) -> _Samples | None:
    """Collect one measure; None where it is not finite in every trial."""
    common = {one.person for one in before} & {one.person for one in after}
    parts = [
        [one for one in part if one.person in common] if common else list(part)
        for part in (before, after)
    ]
    for one in itertools.chain(*parts):
        if not math.isfinite(one.values.get(measure.key, Measurement(math.nan)).value):
            return None
    values, sigmas = (
        tuple(np.array([getattr(one.values[measure.key], name) for one in part]) for part in parts)
        for name in ("value", "sigma")
    )
    persons = tuple(tuple(one.person for one in part) for part in parts)
    return _Samples((values[0], values[1]), (sigmas[0], sigmas[1]), (persons[0], persons[1]))


_Analysis = tuple[Unit, float, float, float, float, tuple[int, int]]


def _analyse(samples: _Samples) -> _Analysis:
    """Return unit, difference, its standard error, degrees of freedom, p and numbers."""
    one, two = samples.values
    common = samples.common
    if len(common) > 1:
        pairs = np.array([float(b.mean() - a.mean()) for a, b in map(samples.of, common)])
        sigma = float(pairs.std(ddof=1)) / math.sqrt(pairs.size)
        counts = (pairs.size, pairs.size)
        return "persons", float(pairs.mean()), sigma, pairs.size - 1.0, _flip_signs(pairs), counts
    unit: Unit = "trials"
    if not common:
        unit, one, two = "persons", *(_person_means(samples, k) for k in (0, 1))
    counts = (one.size, two.size)
    difference = float(two.mean() - one.mean())
    if one.size == two.size == 1:
        sigma = math.hypot(float(samples.sigmas[0][0]), float(samples.sigmas[1][0]))
        return "measuring error", difference, sigma, math.inf, math.nan, counts
    sigma, freedom = _welch(one, two)
    return unit, difference, sigma, freedom, _permute(one, two), counts


def _person_means(samples: _Samples, k: int) -> Array:
    values, persons = samples.values[k], samples.persons[k]
    return np.array(
        [values[[name == person for name in persons]].mean() for person in sorted(set(persons))]
    )


def _welch(one: Array, two: Array) -> tuple[float, float]:
    """Return standard error and degrees of freedom; a single value borrows the other's spread."""
    if min(one.size, two.size) == 1:
        spread = float(max(one, two, key=len).std(ddof=1))
        return spread * math.sqrt(1 / one.size + 1 / two.size), max(one.size, two.size) - 1.0
    parts = [float(x.var(ddof=1)) / x.size for x in (one, two)]
    total = sum(parts)
    if total == 0.0:
        return 0.0, float(one.size + two.size - 2)
    freedom = total**2 / sum(v**2 / (x.size - 1) for v, x in zip(parts, (one, two), strict=True))
    return math.sqrt(total), freedom


def _t_quantile(freedom: float) -> float:
    from scipy.special import stdtrit

    if math.isinf(freedom):
        return Z_95
    return float(stdtrit(freedom, 0.5 + LEVEL / 2))


def _permute(one: Array, two: Array) -> float:
    """Return p of the exact two-sided permutation test of a difference of means."""
    pooled = np.concatenate([one, two])
    if math.comb(pooled.size, one.size) > MAX_ARRANGEMENTS:
        return math.nan
    chosen = np.array(list(itertools.combinations(range(pooled.size), one.size)))
    first = pooled[chosen].sum(axis=1)
    gap = (pooled.sum() - first) / two.size - first / one.size
    seen = abs(float(two.mean() - one.mean()))
    return float(np.mean(np.abs(gap) >= seen - 1e-9 * (1.0 + seen)))


def _flip_signs(pairs: Array) -> float:
    """Return p of the exact two-sided sign-flip test of paired differences."""
    if 2**pairs.size > MAX_ARRANGEMENTS:
        return math.nan
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=pairs.size)))
    seen = abs(float(pairs.mean()))
    gap = np.abs(signs @ pairs) / pairs.size
    return float(np.mean(gap >= seen - 1e-9 * (1.0 + seen)))


def _standard_error_of_measurement(samples: _Samples) -> float:
    """Return the spread of repeated trials of one person at one time; else the measuring error."""
    squares, freedom = 0.0, 0
    for values, persons in zip(samples.values, samples.persons, strict=True):
        for person in set(persons):
            own = values[[name == person for name in persons]]
            squares += float(np.sum((own - own.mean()) ** 2))
            freedom += own.size - 1
    if freedom:
        return math.sqrt(squares / freedom)
    return float(np.sqrt(np.mean(np.square(np.concatenate(samples.sigmas)))))


def _judge(measure: Measure, interval: tuple[float, float]) -> Verdict:
    low, high = interval
    if not measure.better or not (low > 0 or high < 0):
        return Verdict.NOT_DISTINGUISHABLE
    falls = high < 0
    return Verdict.IMPROVED if falls is (measure.better == "lower") else Verdict.WORSE


def _sum_up(changes: Sequence[MeasureChange]) -> tuple[Verdict | None, str, Unit]:
    by_key = {change.measure.key: change for change in changes}
    main = next((by_key[key] for key in PRIMARY if key in by_key), None)
    if main is None:
        said = (
            "Neither lifting index, weight limit nor compression is known of all trials, so that "
            "there is no verdict."
        )
        return None, said, "measuring error"
    against = [c for c in changes if c.verdict is Verdict.WORSE and c is not main]
    sentence = main.sentence
    if against and main.verdict is Verdict.IMPROVED:
        sentence += f" Worse: {', '.join(c.measure.name for c in against)}."
    return main.verdict, sentence, main.unit_of_analysis
