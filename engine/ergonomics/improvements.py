"""Which single change of the work would help most, and which two together where none suffices.

Every candidate is judged by the lifting equation and by the load on the low back. Before and after
share their errors (the same drawn errors, the same person), so that a difference is known far
better than either value.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from engine.datatypes import Array, Coupling, Lift, Measurement, RiskResult
from engine.ergonomics.base import Exposure
from engine.ergonomics.lifting_equation import LiftCase, compute_rwl_array
from engine.ergonomics.methods.acgih import KNUCKLE_SHARE
from engine.ergonomics.methods.l5s1 import METHOD as L5S1
from engine.ergonomics.methods.rnle import METHOD as RNLE
from engine.ergonomics.methods.rnle import NIOSH_LIMITS, read_case
from engine.ergonomics.propagation import standard_normal_points
from engine.ergonomics.spine import ACTION_LIMIT_N, MAXIMUM_LIMIT_N
from engine.ergonomics.what_if import (
    OUT_OF_REACH_M,
    Change,
    Changed,
    apply_change,
    focus_on_lift,
)
from engine.ergonomics.work import read_repetitions
from engine.errors import ConfigError

__all__ = [
    "LOCKS",
    "Effect",
    "RankedChange",
    "Ranking",
    "compare_change",
    "find_governing_lift",
    "rank_changes",
]

LOCKS: Mapping[str, tuple[str, ...]] = {
    "origin height": ("origin_V_cm",),
    "origin distance": ("origin_H_cm",),
    "origin angle": ("origin_A_deg",),
    "destination height": ("destination_V_cm",),
    "destination distance": ("destination_H_cm",),
    "destination angle": ("destination_A_deg",),
    "load": ("load_kg",),
    "frequency": ("frequency_per_min",),
    "duration": ("duration_h", "recovery_h"),
    "grip": ("coupling",),
}
"""What a workplace may not be able to change, and the fields of a change that it rules out."""

# What a workplace can plausibly arrange.
CLOSE_CM = 30.0
"""A load right before the body: lower distances ask for the load between the feet."""
ELBOW_SHARE = 0.63
"""Height of the elbow of a hanging arm as a share of stature (Winter 2009, fig. 4.1)."""
PLATFORM_CM = 30.0
MIN_STEP_CM = 5.0
MIN_TURN_DEG = 10.0
RARE_PER_MIN = 0.2
SHORTER_H = (2.0, 1.0)
MIN_GAIN = 0.02
"""Changes that lower neither index nor compression by this share are left out."""
SAME_MOMENT_S = 0.2
MAX_PARTNERS = 5
MAX_PAIRS = 3
GOAL_LI = NIOSH_LIMITS[0]


@dataclass(frozen=True)
class Effect:
    """What a change does to one number.

    `interval` is that of `after`, `difference` is after minus before; both intervals about 95 %.
    """

    name: str
    unit: str
    before: float
    after: float
    interval: tuple[float, float]
    difference: float
    difference_interval: tuple[float, float]

    @property
    def is_sure(self) -> bool:
        """Whether the difference is told from none: never the other way in 95 % of the draws."""
        low, high = self.difference_interval
        return (high <= 0 and low < 0) or (low >= 0 and high > 0)


@dataclass(frozen=True)
class RankedChange:
    """One change, or two together, with its effects.

    `lifting_index` is None where the index can't be told (no load, or the equation is refused),
    `compression` where the body was not seen. `limits` says which limits are crossed or still
    exceeded, `is_distinguishable` whether it is told from the next one in the list, `notes` what
    to keep in mind.
    """

    action: str
    change: Change
    rwl: Effect | None
    lifting_index: Effect | None
    compression: Effect | None
    limits: tuple[str, ...] = ()
    meets_goals: bool = False
    is_distinguishable: bool = False
    notes: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """The action with what it does, in one sentence."""
        parts = []
        index, rwl, back = self.lifting_index, self.rwl, self.compression
        if index is not None:
            parts.append(f"LI {_index(index.before)} -> {_index(index.after)}")
        elif rwl is not None:
            parts.append(f"RWL {rwl.before:.1f} -> {rwl.after:.1f} kg")
        if back is not None:
            parts.append(f"compression {back.before / 1e3:.1f} -> {back.after / 1e3:.1f} kN")
        return f"{self.action}: {', '.join(parts)}" if parts else self.action


def _index(value: float) -> str:
    return "infinite" if math.isinf(value) else f"{value:.1f}"


@dataclass(frozen=True)
class Ranking:
    """The changes of one lift, the most helpful first.

    `pairs` are offered where no single change meets the goals (lifting index 1.0, 3400 N);
    `reasons` say why something can't be ranked.
    """

    lift_index: int
    singles: tuple[RankedChange, ...]
    pairs: tuple[RankedChange, ...] = ()
    meets_goals: bool = False
    reasons: tuple[str, ...] = ()


# --------------------------------------------------------------------------- judging one change


@dataclass(frozen=True, eq=False)
class _Verdict:
    """What equation and back model say of one lift; `draws` are limits (kg) for drawn errors."""

    exposure: Exposure
    rnle: RiskResult
    back: RiskResult
    draws: Array
    is_posed: bool = False
    unreached_m: float = 0.0

    @property
    def load_kg(self) -> float | None:
        return self.exposure.task.load_kg

    @property
    def rwl_kg(self) -> float:
        return float(self.rnle.details["rwl_kg"]) if self.rnle.is_applicable else math.nan

    @property
    def goal_distance(self) -> tuple[float, float]:
        """Order of merit: the index (else load-free limit), then the compression."""
        index = self.rnle.value if self.load_kg is not None else -self.rwl_kg
        back = self.back.value if self.back.is_applicable else math.inf
        return (math.inf if math.isnan(index) else index), back

    def meets_goals(self) -> bool:
        index, back = self.rnle, self.back
        is_light = not index.is_applicable or index.value <= GOAL_LI
        return is_light and (not back.is_applicable or back.value <= ACTION_LIMIT_N)


def _judge(exposure: Exposure, found: Changed | None = None) -> _Verdict:
    judged = exposure if found is None else found.exposure
    rnle, back = RNLE.assess(judged), L5S1.assess(judged)
    draws = _draw_limits(exposure.lifts[0], judged.lifts[0], rnle)
    if found is None:
        return _Verdict(judged, rnle, back, draws)
    return _Verdict(judged, rnle, back, draws, found.is_posed, found.unreached_m)


_COLUMNS = ("D", *(f"{p} at {end}" for end in ("origin", "destination") for p in "HVA"))


def _draw_limits(measured: Lift, lift: Lift, rnle: RiskResult) -> Array:
    """Draw recommended weights (kg); what both lifts share is drawn with the same errors."""
    if not rnle.is_applicable:
        return np.full(1, np.nan)
    case = read_case(rnle.details)
    before, now = _places(measured), _places(lift)
    points = standard_normal_points(2 * len(_COLUMNS))
    drawn = {}
    for k, name in enumerate(_COLUMNS):
        # A place that is arranged anew has an error of its own.
        column = k if now[name] == before[name] else k + len(_COLUMNS)
        drawn[name] = np.abs(max(0.0, now[name].value) + now[name].sigma * points[:, column])
    limits = [_limit_at(drawn, end, case) for end in rnle.details["counted_ends"]]
    return np.asarray(np.min(limits, axis=0))


def _places(lift: Lift) -> dict[str, Measurement]:
    places = {"D": lift.D_cm}
    for name in ("origin", "destination"):
        end = getattr(lift, name)
        places |= {
            f"H at {name}": end.H_cm,
            f"V at {name}": end.V_cm,
            f"A at {name}": end.A_deg,
        }
    return places


def _limit_at(drawn: Mapping[str, Array], end: str, case: LiftCase) -> Array:
    return compute_rwl_array(
        H=drawn[f"H at {end}"],
        V=drawn[f"V at {end}"],
        D=drawn["D"],
        A=drawn[f"A at {end}"],
        V_origin=drawn["V at origin"],
        frequency_per_min=case.frequency_per_min,
        duration=case.duration,
        coupling=case.coupling,
    )


def compare_change(exposure: Exposure, change: Change, *, lift_index: int = 0) -> RankedChange:
    """Compare a lift with itself after a change.

    Parameters
    ----------
    exposure
        As measured.
    change
        Its `lift_index` is not looked at.
    lift_index
        Which lift.

    Returns
    -------
    RankedChange
        Without an action of its own words.

    Raises
    ------
    ConfigError
        If there is no such lift.
    """
    single = focus_on_lift(exposure, lift_index)
    now = _judge(single)
    return _compare("As changed", change, now, _apply(single, change))


def _apply(single: Exposure, change: Change) -> _Verdict:
    return _judge(single, apply_change(single, replace(change, lift_index=None)))


def _compare(action: str, change: Change, before: _Verdict, after: _Verdict) -> RankedChange:
    notes = []
    if after.unreached_m > OUT_OF_REACH_M:
        notes.append(
            f"out of reach by {100 * after.unreached_m:.0f} cm from where the feet are: the "
            "person has to step closer"
        )
    rwl, index = _compare_equation(before, after)
    back = _compare_back(before, after)
    return RankedChange(
        action=action,
        change=change,
        rwl=rwl,
        lifting_index=index,
        compression=back,
        limits=(*_name_limits(index, NIOSH_LIMITS), *_name_limits(back, _BACK_LIMITS)),
        meets_goals=after.meets_goals(),
        notes=tuple(notes),
    )


_BACK_LIMITS = (ACTION_LIMIT_N, MAXIMUM_LIMIT_N)


def _compare_equation(before: _Verdict, after: _Verdict) -> tuple[Effect | None, Effect | None]:
    if not (before.rnle.is_applicable and after.rnle.is_applicable):
        return None, None
    limits = before.draws, after.draws
    rwl = Effect(
        "recommended weight limit",
        "kg",
        before.rwl_kg,
        after.rwl_kg,
        _bounds(limits[1]),
        after.rwl_kg - before.rwl_kg,
        _bounds(limits[1] - limits[0]),
    )
    if before.load_kg is None or after.load_kg is None:
        return rwl, None
    with np.errstate(divide="ignore"):
        old, new = before.load_kg / limits[0], after.load_kg / limits[1]
    return rwl, Effect(
        "lifting index",
        "",
        before.rnle.value,
        after.rnle.value,
        after.rnle.interval,
        _subtract(np.array(after.rnle.value), np.array(before.rnle.value)).item(),
        _bounds(_subtract(new, old)),
    )


def _subtract(one: Array, two: Array) -> Array:
    """Return one minus two; two infinite values don't differ."""
    with np.errstate(invalid="ignore"):
        return np.where(one == two, 0.0, one - two)


def _bounds(draws: Array) -> tuple[float, float]:
    """Return the bounds that hold 95 % of the draws; some of them may be infinite."""
    if np.isnan(draws).any():
        return math.nan, math.nan
    low, high = np.percentile(draws, (2.5, 97.5), method="inverted_cdf")
    return float(low), float(high)


def _compare_back(before: _Verdict, after: _Verdict) -> Effect | None:
    one, two = before.back, after.back
    if not (one.is_applicable and two.is_applicable):
        return None
    half = 1.96 * _difference_sigma(one, two, is_posed=after.is_posed)
    difference = two.value - one.value
    return Effect(
        "peak compression at L5/S1",
        "N",
        one.value,
        two.value,
        two.interval,
        difference,
        (difference - half, difference + half),
    )


def _difference_sigma(one: RiskResult, two: RiskResult, *, is_posed: bool) -> float:
    """Return the standard error of a difference in compression, N.

    Body mass, stature, place of L5/S1, lever arm of the muscle and load err in the same way before
    and after: what is left of them is the difference of their effects. So do the keypoints of one
    moment; a posed posture adds its own doubt to them, which is what its error exceeds theirs by,
    and two moments err independently.
    """
    old, new = _sigmas(one), _sigmas(two)
    apart_s = abs(float(one.details["peak_s"]) - float(two.details["peak_s"]))
    variance = 0.0
    for cause, sigma in new.items():
        before = old.get(cause, 0.0)
        shared = (sigma - before) ** 2
        if cause == "the keypoints" and apart_s > SAME_MOMENT_S:
            variance += sigma**2 + before**2
        elif cause == "the keypoints" and is_posed:
            variance += max(shared, sigma**2 - before**2)
        else:
            variance += shared
    return math.sqrt(variance)


def _sigmas(back: RiskResult) -> dict[str, float]:
    total = float(back.details["compression_sigma_n"])
    shares: Mapping[str, float] = back.details["uncertainty_shares"]
    return {cause: total * math.sqrt(share) for cause, share in shares.items()}


def _name_limits(effect: Effect | None, limits: tuple[float, ...]) -> Iterator[str]:
    """Say which limits a change crosses, and which is still exceeded."""
    if effect is None:
        return
    unit = f" {effect.unit}" if effect.unit else ""
    digits = 0 if effect.unit == "N" else 1
    for limit in limits:
        was, stays = effect.before > limit, effect.after > limit
        if was and not stays:
            sure = "" if effect.interval[1] <= limit else ", not surely"
            yield f"{effect.name} falls below {limit:.{digits}f}{unit}{sure}"
        elif stays and not was:
            yield f"{effect.name} rises above {limit:.{digits}f}{unit}"
    exceeded = [limit for limit in limits if effect.before > limit and effect.after > limit]
    if exceeded:
        yield f"{effect.name} stays above {max(exceeded):.{digits}f}{unit}"


# --------------------------------------------------------------------------- candidates


def find_governing_lift(exposure: Exposure) -> int:
    """Return the lift that allows the least weight; of those not judged, the highest compression.

    Raises
    ------
    ConfigError
        If there is no lift.
    """
    if not exposure.lifts:
        raise ConfigError("There is no lift in this trial, so that no change can be tried on it.")
    for result in (RNLE.assess(exposure), L5S1.assess(exposure)):
        if result.is_applicable:
            return int(result.details["governing_lift"])
    return 0


def rank_changes(
    exposure: Exposure, locks: frozenset[str] = frozenset(), *, lift_index: int | None = None
) -> Ranking:
    """Try plausible changes of one lift and rank them.

    Parameters
    ----------
    exposure
        As measured.
    locks
        Keys of `LOCKS`: what can't be changed at this workplace.
    lift_index
        Which lift; the one that allows the least weight if None.

    Returns
    -------
    Ranking
        By lifting index (by the recommended weight where the load is not known, by compression
        where the equation is refused), then by compression. Changes that gain less than 2 % of
        both are left out.

    Raises
    ------
    ConfigError
        If a lock or the lift is not known.
    """
    unknown = locks - set(LOCKS)
    if unknown:
        raise ConfigError(
            f"Unknown lock {sorted(unknown)[0]!r}; what can be locked: {', '.join(LOCKS)}."
        )
    index = find_governing_lift(exposure) if lift_index is None else lift_index
    single = focus_on_lift(exposure, index)
    now = _judge(single)
    reasons = _list_reasons(now)
    if not (now.rnle.is_applicable or now.back.is_applicable):
        return Ranking(index, (), reasons=reasons)
    blocked = {name for lock in locks for name in LOCKS[lock]}
    tried = [
        (action, change, _apply(single, change))
        for action, change in _list_candidates(single)
        if not any(getattr(change, name) is not None for name in blocked)
    ]
    singles = _rank(now, [one for one in tried if _gains(now, one[2])])
    done = now.meets_goals() or any(one.meets_goals for one in singles)
    pairs = () if done else _rank_pairs(single, now, singles)
    return Ranking(index, singles, pairs, now.meets_goals(), reasons)


def _list_reasons(now: _Verdict) -> tuple[str, ...]:
    reasons = []
    if not now.rnle.is_applicable:
        why = "; ".join(now.rnle.reasons)
        reasons.append(f"The lifting equation can't be used here: {why}.")
    elif now.load_kg is None:
        reasons.append(
            "The load is not given: changes are ranked by the recommended weight, and compression "
            "is the body's own part."
        )
    if not now.back.is_applicable:
        reasons.append(f"The load on the back can't be told: {'; '.join(now.back.reasons)}.")
    return tuple(reasons)


_Tried = tuple[str, Change, _Verdict]


def _gains(now: _Verdict, then: _Verdict) -> bool:
    """Whether a change helps at all, and harms neither index nor back by more than it helps."""
    rwl = _ratio(_demand(then), _demand(now))
    back = _ratio(then.back.value, now.back.value)
    return min(rwl, back) <= 1.0 - MIN_GAIN and rwl * back < 1.0


def _demand(verdict: _Verdict) -> float:
    """Return the lifting index; of no known load, that of 1 kg."""
    load = 1.0 if verdict.load_kg is None else verdict.load_kg
    rwl = verdict.rwl_kg
    return load / rwl if rwl > 0 else (math.nan if math.isnan(rwl) else math.inf)


def _ratio(after: float, before: float) -> float:
    if math.isnan(after) or math.isnan(before) or after == before:
        return 1.0
    if math.isinf(before):
        return 0.0
    return after / before if before > 0 else 1.0


def _rank(now: _Verdict, tried: list[_Tried]) -> tuple[RankedChange, ...]:
    ordered = sorted(tried, key=lambda one: one[2].goal_distance)
    ranked = []
    for k, (action, change, verdict) in enumerate(ordered):
        found = _compare(action, change, now, verdict)
        after = ordered[k + 1][2] if k + 1 < len(ordered) else None
        told = after is None or _is_told_apart(verdict, after)
        ranked.append(replace(found, is_distinguishable=told))
    return tuple(ranked)


def _is_told_apart(one: _Verdict, two: _Verdict) -> bool:
    """Whether the first is better than the second beyond the errors they don't share."""
    if one.rnle.is_applicable and two.rnle.is_applicable:
        loads = [1.0 if v.load_kg is None else v.load_kg for v in (one, two)]
        with np.errstate(divide="ignore"):
            low, high = _bounds(_subtract(loads[1] / two.draws, loads[0] / one.draws))
        return low >= 0 and high > 0
    sigma = _difference_sigma(one.back, two.back, is_posed=one.is_posed or two.is_posed)
    return two.back.value - one.back.value > 1.96 * sigma


def _rank_pairs(
    single: Exposure, now: _Verdict, singles: tuple[RankedChange, ...]
) -> tuple[RankedChange, ...]:
    """Try the best changes two by two; keep pairs that beat both of their parts."""
    best = singles[0] if singles else None
    tried = []
    for one, two in itertools.combinations(singles[:MAX_PARTNERS], 2):
        both = one.change.merge(two.change)
        if both is not None:
            action = f"{one.action}, and {two.action[:1].lower()}{two.action[1:]}"
            tried.append((action, both, _apply(single, both)))
    ranked = _rank(now, [one for one in tried if _gains(now, one[2])])
    beats = [pair for pair in ranked if best is not None and _beats(pair, best)]
    return tuple(beats[:MAX_PAIRS])


def _beats(pair: RankedChange, best: RankedChange) -> bool:
    for mine, other in (
        (pair.lifting_index, best.lifting_index),
        (pair.compression, best.compression),
    ):
        if mine is not None and other is not None and mine.after < other.after:
            return True
    return pair.rwl is not None and best.rwl is not None and pair.rwl.after > best.rwl.after


def _list_candidates(single: Exposure) -> Iterator[tuple[str, Change]]:
    lift = single.lifts[0]
    stature_cm = 100.0 * single.subject.stature.value
    for end in ("origin", "destination"):
        place = getattr(lift, end)
        yield from _raise_or_lower(end, place.V_cm.value, stature_cm)
        if place.H_cm.value > CLOSE_CM + MIN_STEP_CM:
            action = (
                f"Bring the load closer at the {end}: {CLOSE_CM:.0f} cm before the ankles instead "
                f"of {place.H_cm.value:.0f}"
            )
            yield (
                action,
                Change.at(end, H_cm=CLOSE_CM),
            )
        if place.A_deg.value >= MIN_TURN_DEG:
            yield (
                f"Turn the {end} in front of the feet, so that the body does not twist",
                Change.at(end, A_deg=0.0),
            )
    yield from _change_work(single)


def _raise_or_lower(end: str, height_cm: float, stature_cm: float) -> Iterator[tuple[str, Change]]:
    knuckle, elbow = round(KNUCKLE_SHARE * stature_cm), round(ELBOW_SHARE * stature_cm)
    if height_cm < knuckle - MIN_STEP_CM:
        yield (
            f"Raise the {end} to knuckle height ({knuckle} cm)",
            Change.at(end, V_cm=float(knuckle)),
        )
        if height_cm + PLATFORM_CM < knuckle - MIN_STEP_CM:
            target = float(round(height_cm + PLATFORM_CM))
            yield (
                f"Raise the {end} by {PLATFORM_CM:.0f} cm, to {target:.0f} cm (pallet or platform)",
                Change.at(end, V_cm=target),
            )
    if height_cm > elbow + MIN_STEP_CM:
        yield f"Lower the {end} to elbow height ({elbow} cm)", Change.at(end, V_cm=float(elbow))


def _change_work(single: Exposure) -> Iterator[tuple[str, Change]]:
    task, work = single.task, read_repetitions(single)
    rate = work.frequency_per_min
    if task.load_kg:
        half = task.load_kg / 2
        yield (
            f"Split the load in two of {half:.3g} kg, lifted twice as often",
            Change(load_kg=half, frequency_per_min=min(60.0, 2 * rate)),
        )
    if rate > RARE_PER_MIN:
        slower = max(RARE_PER_MIN, rate / 2)
        yield (
            f"Lift half as often: {slower:.2g} per minute",
            Change(frequency_per_min=slower),
        )
    if task.duration_h is not None:
        shorter = next((h for h in SHORTER_H if task.duration_h > h), None)
        if shorter is not None:
            yield (
                f"Lift for at most {shorter:g} h at a time, then {shorter:g} h of light work",
                Change(duration_h=shorter, recovery_h=shorter),
            )
    if task.coupling is not Coupling.GOOD:
        yield "Give the load good handles", Change(coupling=Coupling.GOOD)
