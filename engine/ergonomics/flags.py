"""What a person should look at in a trial, how urgently, why, and what would change it.

A result alone is never called safe: an `ok` flag states what was found, how sure that is and
what was assumed. It becomes `review` when the interval crosses a limit, when keypoints are
missing, when the method's fit is in doubt, or when it hangs on a favourable assumption.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from engine.datatypes import Coupling, Flag, FlagLevel, Lift, RiskResult
from engine.ergonomics.base import MethodInfo, list_methods
from engine.ergonomics.lifting_equation import LiftCase, LiftPoint, govern, move
from engine.ergonomics.methods.rnle import METHOD as RNLE
from engine.ergonomics.methods.rnle import read_case

__all__ = ["find_best_change", "raise_flags"]

MIN_MEASURED = 0.8
"""Share of keypoint samples that must be measured (not filled or missing) to trust a trial."""

_URGENCY = {FlagLevel.HIGH: 0, FlagLevel.REVIEW: 1, FlagLevel.OK: 2}

# What a workplace can plausibly change in one step.
CLOSER_CM = 10.0
H_MIN_CM = 25.0
HEIGHT_STEP_CM = 30.0
BEST_HEIGHT_CM = 75.0
MIN_HEIGHT_CHANGE_CM = 5.0
MIN_TURN_DEG = 10.0
RARE_PER_MIN = 0.2
MIN_GAIN = 1.02

_DRIVER_TEXT: Mapping[str, str] = {
    "HM": "horizontal distance {H_cm:.0f} cm",
    "VM": "hand height {V_cm:.0f} cm",
    "DM": "vertical travel",
    "AM": "asymmetry {A_deg:.0f} deg",
    "FM": "lifting frequency and duration",
    "CM": "coupling",
}
_ADVICE: Mapping[str, str] = {
    "trunk": "Bring the work higher and closer, so that the trunk stays upright",
    "upper arms": "Bring the work closer or lower, so that the upper arms hang down",
    "legs": "Bring the work higher, so that the knees need not bend",
    "neck": "Bring what must be seen to where the head stays upright",
    "lower arms": "Set the height of the work so that the elbows are bent at about a right angle",
}
_MOMENTS = "worst_moments"
"""Key of `details` in results of methods that score every frame."""
MAX_DRIVERS = 2
DRIVER_BELOW = 0.95


def raise_flags(
    risk: Mapping[str, RiskResult],
    lifts: Sequence[Lift],
    coverage: Mapping[str, float],
    *,
    min_measured: float = MIN_MEASURED,
) -> tuple[Flag, ...]:
    """List what a person should know of a trial, most urgent first.

    Parameters
    ----------
    risk
        Result per method.
    lifts
        The lifts the results refer to by index.
    coverage
        Shares of keypoint samples; `measured` is looked at.
    min_measured
        Below this measured share no result is better than `review`.

    Returns
    -------
    tuple of Flag
        One flag per lift and method (or per method, where it judges the whole trial), one for all
        further methods that can't be used, and one each for a trial without lifts and one with
        many missing keypoints.
    """
    low = _describe_low_coverage(coverage, min_measured)
    flags = [] if low is None else [_flag_coverage(low)]
    if not lifts:
        flags.append(_flag_no_lifts())
    infos = {method.info.name: method.info for method in list_methods()}
    judged: list[Flag] = []
    refused: dict[str, str] = {}
    for result in risk.values():
        # Without lifts the flag above says it once, instead of every lifting method again.
        if (not lifts and not result.is_applicable) or _repeats_rnle(result, risk):
            continue
        for part in result.per_lift or (result,):
            if part.is_applicable or _is_rnle(part):
                judged.append(_flag_result(part, infos.get(part.method), lifts, low))
            else:
                title = _name_method(part, infos.get(part.method))
                refused.setdefault(title, _join_reasons(part))
    flags += [*judged, *_flag_refused(refused), *_flag_disagreement(risk, judged, infos)]
    return tuple(sorted(flags, key=_sort_key))


def _sort_key(flag: Flag) -> tuple[int, bool, float]:
    # Of equally urgent flags the lifting equation's comes first: it is about the lift itself.
    start_s = math.inf if math.isnan(flag.start_s) else flag.start_s
    return _URGENCY[flag.level], flag.method != RNLE.info.name, start_s


def _describe_low_coverage(coverage: Mapping[str, float], min_measured: float) -> str | None:
    measured = coverage.get("measured")
    if measured is None or measured >= min_measured:
        return None
    if math.isnan(measured):
        return "how much of the body was seen is not known"
    return (
        f"only {100 * measured:.0f} % of the keypoint samples were measured "
        f"(at least {100 * min_measured:.0f} % are needed)"
    )


def _flag_coverage(why: str) -> Flag:
    return Flag(
        level=FlagLevel.REVIEW,
        what="Parts of the body were often not seen",
        why=_sentence(why),
        method="coverage",
        change="Film from the side, with the whole body in the picture, in good light.",
    )


def _flag_no_lifts() -> Flag:
    return Flag(
        level=FlagLevel.REVIEW,
        what="No lift was found",
        why="No movement of the hands could be taken for a lift or a lowering of at least 10 cm; "
        "the notes say what was left out.",
        method="lifts",
        change="Check that the video shows the whole lift, with the hands in view.",
    )


def _repeats_rnle(result: RiskResult, risk: Mapping[str, RiskResult]) -> bool:
    """Whether this is the index of a job of one lift, which is that lift's own index."""
    single = risk.get(RNLE.info.name)
    # Both are the same arithmetic in another order, so the last bits may differ.
    return (
        result.method == "rnle_job"
        and single is not None
        and math.isclose(single.value, result.value, rel_tol=1e-9)
    )


def _flag_refused(refused: Mapping[str, str]) -> Iterator[Flag]:
    """Say once which methods can't be used, and why: mostly all lack the same."""
    if not refused:
        return
    because: dict[str, list[str]] = {}
    for title, reasons in refused.items():
        because.setdefault(reasons, []).append(title)
    why = " ".join(f"{', '.join(titles)}: {reasons}" for reasons, titles in because.items())
    number = "1 method" if len(refused) == 1 else f"{len(refused)} methods"
    yield Flag(
        level=FlagLevel.REVIEW,
        what=f"{number} can't be used here",
        why=f"{why} That is no statement about the risk.",
        method="methods",
    )


def _flag_disagreement(
    risk: Mapping[str, RiskResult], flags: Sequence[Flag], infos: Mapping[str, MethodInfo]
) -> Iterator[Flag]:
    """Say that methods disagree, instead of averaging it away: one urgent, another content."""
    worst: dict[str, FlagLevel] = {}
    for flag in flags:
        if risk[flag.method].is_applicable and not math.isnan(risk[flag.method].value):
            level = worst.get(flag.method, FlagLevel.OK)
            worst[flag.method] = min(level, flag.level, key=lambda x: _URGENCY[x])
    high, fine = (
        [_name_verdict(risk[name], infos.get(name)) for name, level in worst.items() if level is x]
        for x in (FlagLevel.HIGH, FlagLevel.OK)
    )
    if high and fine:
        yield Flag(
            level=FlagLevel.REVIEW,
            what="The methods disagree",
            why=f"{', '.join(high)} call for action at once; {', '.join(fine)} for none. They look "
            "at different things (posture, load, repetition), so neither settles the other.",
            method="disagreement",
            change="Let a professional weigh what each method looks at for this job.",
        )


def _name_verdict(result: RiskResult, info: MethodInfo | None) -> str:
    return f"{_name_value(result, info)} ({result.category})"


# --------------------------------------------------------------------------- one result


@dataclass(frozen=True)
class _Limits:
    """Up to `low` a result needs no action, above `high` it is urgent; `bounds` are all bands'."""

    low: float
    high: float
    bounds: tuple[float, ...] = ()
    decimals: int | None = None


def _flag_result(
    result: RiskResult, info: MethodInfo | None, lifts: Sequence[Lift], low_coverage: str | None
) -> Flag:
    level, what, why, change = _judge(result, info, low_coverage)
    index = result.lift_index
    lift = lifts[index] if index is not None and index < len(lifts) else None
    start_s, end_s = _find_window(result, lift)
    return Flag(
        level=level,
        what=what[:1].upper() + what[1:] if index is None else f"Lift {index + 1}: {what}",
        why=why,
        method=result.method,
        start_s=start_s,
        end_s=end_s,
        change=change,
        lift_index=index,
    )


def _find_window(result: RiskResult, lift: Lift | None) -> tuple[float, float]:
    """Return when to look: the lift, or the worst moment of a method that scores every frame."""
    if lift is not None:
        return lift.start_s, lift.end_s
    moments = result.details.get(_MOMENTS, ())
    return (moments[0]["start_s"], moments[0]["end_s"]) if moments else (math.nan, math.nan)


def _judge(
    result: RiskResult, info: MethodInfo | None, low_coverage: str | None
) -> tuple[FlagLevel, str, str, str]:
    """Return level, what, why and change."""
    title = _name_method(result, info)
    reasons = _join_reasons(result)
    if not result.is_applicable:
        what = f"{title} can't be used here"
        why = f"{reasons} That is no statement about the risk.".strip()
        return FlagLevel.REVIEW, what, why, ""
    if math.isnan(result.value):
        return FlagLevel.REVIEW, *_describe_no_value(result, title, reasons)
    limits = _read_limits(info)
    doubts = _find_doubts(result, limits, low_coverage)
    level = _find_level(result, limits, has_doubts=bool(doubts))
    value = (
        _describe_frames(result, info, limits)
        if info is not None and _MOMENTS in result.details
        else _describe_value(result, limits)
    )
    why = " ".join((value, *map(_sentence, doubts)))
    if level is FlagLevel.OK:
        why = " ".join((why, *result.details.get("assumptions", ())))
    is_raised = max(result.value, _upper(result)) > limits.low
    change = _describe_change(result) if is_raised else ""
    return level, f"{_name_value(result, info)}, {result.category}", why, change


def _read_limits(info: MethodInfo | None) -> _Limits:
    """Take the limits from the method's levels: end of the first, begin of the last."""
    if info is None or len(info.levels) < 2:
        return _Limits(math.inf, math.inf)
    bounds = tuple(level.upper for level in info.levels[:-1])
    low, high = info.flag_limits or (bounds[0], bounds[-1])
    return _Limits(low, high, bounds, info.decimals)


def _find_level(result: RiskResult, limits: _Limits, *, has_doubts: bool) -> FlagLevel:
    # The worst of hundreds of frames is easily one too many, and a limit without a range of
    # caution below it is easily crossed by an error: both alarm only if it is sure.
    needs_surety = _MOMENTS in result.details or limits.low == limits.high
    is_sure = not needs_surety or not result.interval[0] <= limits.high
    if result.value > limits.high and is_sure:
        return FlagLevel.HIGH
    return FlagLevel.REVIEW if result.value > limits.low or has_doubts else FlagLevel.OK


def _upper(result: RiskResult) -> float:
    upper = result.interval[1]
    return -math.inf if math.isnan(upper) else upper


def _find_doubts(result: RiskResult, limits: _Limits, low_coverage: str | None) -> list[str]:
    """List what keeps a result from being `ok` whatever its value."""
    crossed = limits.bounds if _MOMENTS in result.details else (limits.low, limits.high)
    doubts = [
        f"the interval crosses the limit {_format_limit(limit, limits)}"
        for limit in dict.fromkeys(crossed)
        if result.interval[0] <= limit < result.interval[1]
    ]
    dominant = result.details.get("dominant_input")
    if doubts and dominant:
        doubts[-1] += f"; the error of {dominant} contributes most"
    demanding = result.details.get("demanding_li", math.nan)
    if demanding is not None and result.value <= limits.low < demanding:
        doubts.append(
            "this holds for rare and short lifting only: with demanding work "
            f"it would be {_format_value(demanding, limits)}"
        )
    doubts += result.details.get("doubts", ())
    return [*doubts, low_coverage] if low_coverage else doubts


# --------------------------------------------------------------------------- wording


def _sentence(text: str) -> str:
    text = text.strip()
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith((".", "!", "?")) else ".")


def _join_reasons(result: RiskResult) -> str:
    return " ".join(_sentence(reason) for reason in result.reasons)


def _name_method(result: RiskResult, info: MethodInfo | None) -> str:
    return result.method if info is None else info.title


def _is_rnle(result: RiskResult) -> bool:
    return result.method == RNLE.info.name


def _name_value(result: RiskResult, info: MethodInfo | None) -> str:
    name = "lifting index" if _is_rnle(result) else (info and info.value_name) or result.method
    limits = _RNLE_LIMITS if info is None else _read_limits(info)
    return f"{name} {_format_value(result.value, limits)}{result.unit and ' ' + result.unit}"


def _format_limit(limit: float, limits: _Limits) -> str:
    return f"{limit:.{1 if limits.decimals is None else limits.decimals}f}"


def _format_value(value: float, limits: _Limits) -> str:
    """Write with as few decimals as keep the value in its band."""
    if math.isinf(value):
        return "infinite"
    if limits.decimals is not None:
        return f"{value:.{limits.decimals}f}"
    for digits in (1, 2, 3):
        text = f"{value:.{digits}f}"
        if all((float(text) > x) == (value > x) for x in limits.bounds):
            return text
    return f"{value:.4f}"


_RNLE_LIMITS = _read_limits(RNLE.info)


def _describe_no_value(result: RiskResult, title: str, reasons: str) -> tuple[str, str, str]:
    rwl = result.details.get("rwl_kg")
    if rwl is None:
        return f"{title} gives no value", reasons, ""
    what = f"recommended weight limit {rwl:.1f} kg, load not given"
    low, high = result.details["rwl_interval_kg"]
    sure = "" if math.isnan(low) else f" (about 95 % interval {low:.1f} to {high:.1f} kg)"
    why = f"The lift as filmed allows {rwl:.1f} kg{sure}. {reasons}"
    return what, why, "Give the load in kg to get the lifting index."


def _describe_value(result: RiskResult, limits: _Limits) -> str:
    """State value, interval, limit and what drives it."""
    low, high = result.interval
    sure = (
        "no interval known"
        if math.isnan(low)
        else f"about 95 % interval {_format_value(low, limits)} to {_format_value(high, limits)}"
    )
    value = _format_value(result.value, limits)
    limit = limits.high if result.value > limits.high else limits.low
    side = "above" if result.value > limit else "not above"
    owner = "NIOSH's limit of " if _is_rnle(result) else "the limit "
    text = f"{value} ({sure}) is {side} {owner}{limit:.1f}."
    drivers = _find_drivers(result)
    return f"{text} What lowers the recommended weight most: {drivers}." if drivers else text


def _describe_frames(result: RiskResult, info: MethodInfo, limits: _Limits) -> str:
    """State score, interval, worst moment and time at that level of a method that scores frames."""
    low, high = (_format_value(x, limits) for x in result.interval)
    sure = "no interval known" if low == "nan" else f"about 95 % interval {low} to {high}"
    band = next(level for level in info.levels if result.value <= level.upper)
    text = f"{_format_value(result.value, limits)} ({sure}): {band.meaning}; action: {band.action}."
    moment = result.details[_MOMENTS][0]
    text += f" Worst at {moment['peak_s']:.1f} s: {moment['posture']}."
    for row in result.details["levels"]:
        if row["name"] == moment["level"]:
            text += f" At this level for {row['time_s']:.1f} s ({100 * row['share']:.0f} %)."
    return text


def _find_drivers(result: RiskResult) -> str:
    """Name the multipliers that cost most at the governing end."""
    end = result.details.get("governing_end")
    if end is None:
        return ""
    values = result.details[end]
    costly = sorted((values[k], k) for k in _DRIVER_TEXT if values[k] < DRIVER_BELOW)
    parts = [f"{_DRIVER_TEXT[k].format(**values)} (x {v:.2f})" for v, k in costly[:MAX_DRIVERS]]
    return f"{' and '.join(parts)} at the {end}" if parts else ""


# --------------------------------------------------------------------------- change


@dataclass(frozen=True)
class Change:
    """One change of the work: what to do, and the RWL (kg) and lifting index it leads to."""

    text: str
    rwl_kg: float
    lifting_index: float


def find_best_change(case: LiftCase) -> Change | None:
    """Find the single plausible change that raises the recommended weight most.

    Tried are: the load 10 cm closer (not below 25 cm), either end up to 30 cm nearer to 75 cm
    above the floor, the feet turned towards the load, good handles, and half the lifting
    frequency.

    Returns
    -------
    Change or None
        None if no change gains 2 %.
    """
    rwl, _ = govern(case)
    changes = [Change(text, *govern(changed)) for text, changed in _list_changes(case)]
    best = max(changes, key=lambda change: change.rwl_kg, default=None)
    return best if best is not None and best.rwl_kg > MIN_GAIN * rwl else None


def _ends(case: LiftCase) -> Iterator[tuple[str, LiftPoint]]:
    yield "origin", case.origin
    if case.destination is not None:
        yield "destination", case.destination


def _list_changes(case: LiftCase) -> Iterator[tuple[str, LiftCase]]:
    closer = case
    for end, point in _ends(case):
        closer = move(closer, end, H_cm=max(min(point.H_cm, H_MIN_CM), point.H_cm - CLOSER_CM))
    gain = max(p.H_cm - q.H_cm for (_, p), (_, q) in zip(_ends(case), _ends(closer), strict=True))
    yield f"bring the load {gain:.0f} cm closer to the body", closer
    for end, point in _ends(case):
        yield from _list_height_changes(case, end, point)
        if point.A_deg >= MIN_TURN_DEG:
            text = f"turn the feet towards the load at the {end}, so that the body doesn't twist"
            yield text, move(case, end, A_deg=0.0)
    if case.coupling is not Coupling.GOOD:
        yield "give the load good handles", replace(case, coupling=Coupling.GOOD)
    if case.frequency_per_min > RARE_PER_MIN:
        half = max(RARE_PER_MIN, case.frequency_per_min / 2)
        text = f"lower the lifting frequency to {half:.2g} per minute"
        yield text, replace(case, frequency_per_min=half)


def _list_height_changes(
    case: LiftCase, end: str, point: LiftPoint
) -> Iterator[tuple[str, LiftCase]]:
    to_best = BEST_HEIGHT_CM - point.V_cm
    step = max(-HEIGHT_STEP_CM, min(HEIGHT_STEP_CM, to_best))
    if abs(step) >= MIN_HEIGHT_CHANGE_CM:
        verb = "raise" if step > 0 else "lower"
        text = f"{verb} the {end} of the lift by {abs(step):.0f} cm"
        yield text, move(case, end, V_cm=point.V_cm + step)


def _describe_change(result: RiskResult) -> str:
    if not _is_rnle(result):
        return _describe_posture_change(result)
    case = read_case(result.details)
    rwl, index = govern(case)
    best = find_best_change(case)
    parts = []
    if best is not None:
        before, after = (_format_value(x, _RNLE_LIMITS) for x in (index, best.lifting_index))
        still = ", still above 1.0" if best.lifting_index > _RNLE_LIMITS.low else ""
        parts.append(f"{_sentence(best.text)[:-1]}: lifting index {before} -> {after}{still}.")
    if index > _RNLE_LIMITS.low:
        parts.append(
            # Rounded down: the stated weight itself must keep to the limit.
            f"As the lift is, at most {math.floor(10 * rwl) / 10:.1f} kg would keep to the limit."
            if rwl > 0
            else "As the lift is, no load keeps to the limit; its layout must change."
        )
    return " ".join(parts)


def _describe_posture_change(result: RiskResult) -> str:
    """Name the part of the body whose neutral posture would lower the score most."""
    drivers = result.details.get("drivers", ())
    advice = next((_ADVICE[d["part"]] for d in drivers if d["part"] in _ADVICE), None)
    if advice is None:
        return ""
    first = next(d for d in drivers if d["part"] in _ADVICE)
    after = first["score_without"]
    return f"{advice}: the worst score would be {after} instead of {after + first['falls_by']}."
