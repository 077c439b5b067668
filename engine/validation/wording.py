"""What the statistics of agreement say, in plain sentences.

A sentence never claims more than its numbers: an offset is called one only where its interval
leaves out zero, "good enough" needs the limits of agreement at their worst, a difference that was
not shown is not called agreement, and what rests on one trial or one person says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from engine.validation.agreement import AngleSummary
from engine.validation.bland_altman import BlandAltman
from engine.validation.curves import CurveAgreement
from engine.validation.curvewise import CurveTest
from engine.validation.majae import Improvement
from engine.validation.statistics import EquivalenceTest, Interval, PairedTest

__all__ = [
    "PURPOSES",
    "Purpose",
    "Verdict",
    "describe_angle",
    "describe_curve",
    "describe_curve_test",
    "describe_equivalence",
    "describe_improvement",
    "describe_test",
    "judge_purposes",
    "title_angle",
]

Answer = Literal["yes", "unclear", "no"]


@dataclass(frozen=True)
class Purpose:
    """Something angles are used for, and the width of the steps it distinguishes."""

    words: str
    step_deg: float


PURPOSES = (
    Purpose("bands 30° wide (such as the knee's in REBA)", 30.0),
    Purpose("bands 20° wide (such as the trunk's in REBA and RULA)", 20.0),
    Purpose("bands 10° wide (such as the neck's in RULA)", 10.0),
    Purpose("steps of 5° (such as the ankle's)", 5.0),
)
"""Widest first. An angle in the middle of a band stays in it if its error is under half the width.

RULA: McAtamney & Corlett (1993); REBA: Hignett & McAtamney (2000)."""


@dataclass(frozen=True)
class Verdict:
    """Whether the errors are small enough for a purpose.

    `yes`: the limits of agreement at their worst lie within half a step. `no`: the limits
    themselves don't. `unclear`: the limits do, but the data are too few to be sure.
    """

    purpose: Purpose
    answer: Answer


def title_angle(name: str) -> str:
    """Turn an angle's name into words: `knee_flexion_l` into ``Knee flexion (left)``."""
    side = {"_l": " (left)", "_r": " (right)"}.get(name[-2:], "")
    stem = name[:-2] if side else name
    return stem.replace("_", " ").capitalize() + side


def judge_purposes(
    limits: BlandAltman,
    purposes: tuple[Purpose, ...] = PURPOSES,
    *,
    p95_deg: float = 0.0,
) -> tuple[Verdict, ...]:
    """Judge for each purpose whether the limits of agreement are narrow enough.

    Parameters
    ----------
    limits
        On frames, degrees.
    purposes
        What to judge.
    p95_deg
        The difference that 95 % of the frames don't exceed: it must fit as well, since differences
        with long tails exceed the limits more often than normal ones.

    Returns
    -------
    tuple of Verdict
        One per purpose, in its order.
    """
    found = max(abs(limits.lower), abs(limits.upper), p95_deg)
    worst = max(abs(limits.outer_limits.low), abs(limits.outer_limits.high), p95_deg)
    # NaN compares as false, so limits that can't be computed never pass.
    is_known = limits.outer_limits.is_known

    def answer(step_deg: float) -> Answer:
        if found > step_deg / 2:
            return "no"
        return "yes" if is_known and worst <= step_deg / 2 else "unclear"

    return tuple(Verdict(purpose, answer(purpose.step_deg)) for purpose in purposes)


def describe_angle(summary: AngleSummary, purposes: tuple[Purpose, ...] = PURPOSES) -> str:
    """Say how far an angle is off over all trials, and what that is good enough for.

    Parameters
    ----------
    summary
        From `engine.validation.agreement`.
    purposes
        What to judge, widest step first.

    Returns
    -------
    str
        Two to four sentences.
    """
    title = title_angle(summary.name)
    if summary.pooled.n_samples == 0:
        return f"{title}: no frame has both an estimate and a reference, so nothing can be said."
    limits = summary.bland_altman
    offset = _say_offset(limits.bias, limits.bias_interval)
    within = f"within {_degrees_up(summary.pooled.p95_deg)} in 95 % of the frames"
    sentences = [
        f"{title}: {offset}, {within} ({_say_data(summary)}).",
        _say_verdicts(judge_purposes(limits, purposes, p95_deg=summary.pooled.p95_deg)),
        _say_scope(summary),
    ]
    return " ".join(filter(None, sentences))


def describe_curve(name: str, curve: CurveAgreement) -> str:
    """Say how far an angle is off in one trial; no claim beyond its frames."""
    title = title_angle(name)
    if curve.n_samples == 0:
        return f"{title}: no frame has both an estimate and a reference, so nothing can be said."
    missing = curve.n_frames - curve.n_samples
    gap = f", {missing} of {_count(curve.n_frames, 'frame')} missing" if missing else ""
    return (
        f"{title}: {_say_mean(curve.bias_deg)} in this trial, within "
        f"{_degrees_up(curve.p95_deg)} in 95 % of the {_count(curve.n_samples, 'frame')}{gap}."
    )


def describe_test(test: PairedTest, *, unit: str = "subject") -> str:
    """Say what a paired t-test shows; a large p is no agreement."""
    if math.isnan(test.p):
        return f"A t-test needs two or more {unit}s that differ, so nothing was tested."
    data = f"p = {_p_value(test.p)}, {_count(test.n, unit)}"
    if test.p < 1.0 - test.level:
        return f"The mean difference is not chance alone ({data}): {_say_mean(test.mean)}."
    return f"No mean difference was shown ({data}); that does not show agreement."


def describe_equivalence(test: EquivalenceTest, *, unit: str = "subject") -> str:
    """Say whether the mean was shown to agree within a margin."""
    margin = f"±{test.margin:g}°"
    if math.isnan(test.p):
        return f"Agreement of the mean within {margin} needs two or more {unit}s to be tested."
    data = f"p = {_p_value(test.p)}, {_count(test.n, unit)}"
    if test.is_equivalent:
        return f"The mean agrees within {margin} ({data}); single frames may be further off."
    return f"Agreement of the mean within {margin} was not shown ({data})."


def describe_curve_test(test: CurveTest, *, unit: str = "subject") -> str:
    """Say where along the movement the curves differ."""
    if math.isnan(test.p):
        return f"Comparing whole curves needs two or more {unit}s that differ; it was not done."
    if not test.can_find_differences:
        return (
            f"With {_count(test.n_curves, unit)} no difference between whole curves can be shown: "
            f"the smallest possible p is {_p_value(test.smallest_p)}."
        )
    if not test.parts:
        return (
            f"No part of the movement was shown to differ (p = {_p_value(test.p)}, "
            f"{_count(test.n_curves, unit)}); that does not show agreement."
        )
    parts = ", ".join(f"{p.start_percent:.0f}–{p.end_percent:.0f} %" for p in test.parts)
    data = f"p = {_p_value(test.p)}, {_count(test.n_curves, unit)}"
    return f"The curves differ at {parts} of the movement ({data})."


def describe_improvement(improvement: Improvement) -> str:
    """Say by how much a correction lowers an error, in both ways of averaging."""
    if improvement.n_rows == 0:
        return "No row has an error before and after the correction, so nothing can be said."
    shown = improvement.of_mean_interval
    if not shown.is_known or shown.contains(0.0):
        head = "The correction was not shown to change the mean error"
    elif improvement.of_mean_percent > 0:
        head = "The correction lowers the mean error"
    else:
        head = "The correction raises the mean error"
    before, after = improvement.original_mean, improvement.corrected_mean
    worse = f"; worse in {improvement.n_worse}" if improvement.n_worse else ""
    return (
        f"{head} from {before:.2f} to {after:.2f}, by {improvement.of_mean_percent:.1f} %"
        f"{_say_interval(shown, ' %')}. The mean of the improvements of the "
        f"{_count(improvement.n_rows, 'row')} is {improvement.mean_of_rows_percent:.1f} %"
        f"{_say_interval(improvement.mean_of_rows_interval, ' %')}{worse}."
    )


# --------------------------------------------------------------------------- parts of sentences


def _say_mean(bias_deg: float) -> str:
    if abs(bias_deg) < 0.05:
        return "less than 0.1° off on average"
    return f"{abs(bias_deg):.1f}° too {'low' if bias_deg < 0 else 'high'} on average"


def _say_offset(bias_deg: float, interval: Interval) -> str:
    """Say the bias; call it one only where its interval leaves out zero."""
    if not interval.is_known:
        return f"{_say_mean(bias_deg)} in these frames, too few to tell from chance"
    if interval.contains(0.0):
        return f"no clear offset ({bias_deg:+.1f}° on average{_say_interval(interval, '°', '; ')})"
    return f"{_say_mean(bias_deg)}{_say_interval(interval, '°')}"


def _say_interval(interval: Interval, unit: str, before: str = " (") -> str:
    if not interval.is_known:
        return ""
    after = ")" if before == " (" else ""
    # Adding zero turns a rounded -0.0 into 0.0.
    low, high = (round(value, 1) + 0.0 for value in interval)
    return f"{before}95 % interval {low:.1f} to {high:.1f}{unit}{after}"


def _say_data(summary: AngleSummary) -> str:
    pooled = summary.pooled
    return (
        f"{_count(pooled.n_samples, 'frame')}, worth {math.floor(pooled.n_effective)} independent, "
        f"of {_count(summary.n_trials, 'trial')}, {_count(summary.n_subjects, 'person', 'persons')}"
    )


def _say_verdicts(verdicts: tuple[Verdict, ...]) -> str:
    """Name the finest purpose that passes and the coarsest that does not."""
    passed = [v.purpose.words for v in verdicts if v.answer == "yes"]
    unclear = [v.purpose.words for v in verdicts if v.answer == "unclear"]
    failed = [v.purpose.words for v in verdicts if v.answer == "no"]
    parts = [f"good enough for {passed[-1]}"] if passed else []
    if unclear:
        parts.append(f"too few data to say for {unclear[0]}")
    if failed:
        parts.append(f"not good enough for {failed[0]}" if not passed else f"not for {failed[0]}")
    sentence = ", ".join(parts)
    return f"{sentence[:1].upper()}{sentence[1:]}." if sentence else ""


def _say_scope(summary: AngleSummary) -> str:
    if summary.n_trials == 1:
        return "This is one trial of one person and says nothing about others."
    if summary.n_subjects == 1:
        return "These are trials of one person and say nothing about others."
    return ""


def _count(n: int, noun: str, plural: str | None = None) -> str:
    return f"{n} {noun if n == 1 else plural or noun + 's'}"


def _degrees_up(value_deg: float) -> str:
    """Round up, so that "within" stays true."""
    return f"{math.ceil(value_deg * 10.0 - 1e-9) / 10.0:.1f}°"


def _p_value(p: float) -> str:
    return "under 0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"
