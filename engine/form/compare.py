"""Compare an attempt with a reference performance: aligned curves, differences, score.

The two movements are aligned in time by their joint angles and the height of the hands, so
that postures are compared at the same point of the movement; how long each phase took is compared
apart. Every difference carries its standard error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from engine.datatypes import Array, Measurement
from engine.errors import AssessmentError, DataError
from engine.form.performance import MAX_GAP_S, Performance, fill_short_gaps
from engine.form.phases import Phase
from engine.form.repetitions import Repetition, find_repetitions
from engine.form.score import WEIGHT_FLOOR_DEG, Score, compute_score
from engine.form.warping import Warp, find_subsequence, warp

__all__ = [
    "Comparison",
    "PhaseDifference",
    "PhaseTiming",
    "compare_every_repetition",
    "compare_performances",
    "order_angles",
]

N_SAMPLES = 101
"""Curves are compared at 0 to 100 % of the reference's movement."""
HAND_SCALE_M = 0.10
"""So much height of the hands counts like one degree of scaled angle in the alignment."""
MIN_ANGLES = 2
MIN_LIKENESS = 0.5
UNKNOWN_SIGMA_DEG = 15.0
"""Assumed where no error is known, and said."""
SAME_VIEW_DEG = 20.0
OWN_ERROR_SAME_PERSON, OWN_ERROR_OTHER_PERSON = 0.2, 0.3
"""Share of a clip's stated error that does not repeat in another clip measured the same way.

An angle's error comes mostly from the joints' definition, hidden limbs and the camera's place,
which repeat. On the synthetic training persons the errors of differences were at most 0.17 (one
person) and 0.24 (two persons) of the stated ones (`benchmarks/form.py`); rounded up, because people
are less regular. Clips measured in different ways share nothing.
"""
LEAST_SIGMA_DEG = 1.5
"""No difference is known better: as good as a static angle of a good marker system repeats."""


@dataclass(frozen=True)
class PhaseDifference:
    """One angle in one phase: attempt minus reference, degrees.

    `mean` is the mean difference over the phase, `peak` that of the greatest values in it;
    `reference_deg` and `attempt_deg` are the means.
    """

    phase: str
    angle: str
    mean: Measurement
    peak: Measurement
    reference_deg: float
    attempt_deg: float

    @property
    def is_beyond_error(self) -> bool:
        """Whether the interval of about 95 % around the mean difference leaves out 0."""
        low, high = self.mean.interval()
        return low > 0 or high < 0


@dataclass(frozen=True)
class PhaseTiming:
    """How long one phase took, seconds, with the ratio attempt to reference."""

    phase: str
    reference_s: Measurement
    attempt_s: Measurement

    @property
    def difference_s(self) -> Measurement:
        """Attempt minus reference."""
        sigma = math.hypot(self.reference_s.sigma, self.attempt_s.sigma)
        return Measurement(self.attempt_s.value - self.reference_s.value, sigma)

    @property
    def is_beyond_error(self) -> bool:
        """Whether the lengths differ by more than about 95 % of their error."""
        low, high = self.difference_s.interval()
        return low > 0 or high < 0


@dataclass(frozen=True, eq=False)
class Comparison:
    """An attempt beside a reference.

    `reference_deg`, `attempt_deg` and their `sigma`: shape (101, A), at `percent` of the
    reference's movement; `difference_sigma_deg` the standard error of attempt minus reference.
    `reference_time_s` and `attempt_time_s` (101,) are the moments in both clips that belong
    together. `phases` and `attempt_phases` are each clip's own. `own_error_share` is the part of
    each clip's errors that does not repeat in the other; `is_same_work` is false where two lifts
    start or end at clearly different heights, or no lift was found in the attempt.
    """

    reference: str
    attempt: str
    names: tuple[str, ...]
    percent: Array
    reference_deg: Array
    reference_sigma_deg: Array
    attempt_deg: Array
    attempt_sigma_deg: Array
    difference_sigma_deg: Array
    reference_time_s: Array
    attempt_time_s: Array
    phases: tuple[Phase, ...]
    attempt_phases: tuple[Phase, ...]
    differences: tuple[PhaseDifference, ...]
    timings: tuple[PhaseTiming, ...]
    score: Score
    likeness: float
    path: Array
    notes: tuple[str, ...]
    reference_repetition: int = 0
    attempt_repetition: int = 0
    own_error_share: float = 1.0
    is_same_work: bool = True

    @property
    def difference_deg(self) -> Array:
        """Attempt minus reference, shape (101, A), degrees."""
        return self.attempt_deg - self.reference_deg

    def attempt_time_at(self, reference_s: float) -> float:
        """Return the moment of the attempt that belongs to one of the reference, seconds."""
        return float(np.interp(reference_s, self.reference_time_s, self.attempt_time_s))


def order_angles(comparison: Comparison) -> tuple[str, ...]:
    """Return the compared angles, the one that differs most (over its error) first."""
    ratio = np.abs(comparison.difference_deg) / comparison.difference_sigma_deg
    order = np.argsort(-np.sqrt(np.mean(ratio**2, axis=0)), kind="stable")
    return tuple(comparison.names[int(i)] for i in order)


@dataclass(frozen=True, eq=False)
class _Curves:
    """One performance between two moments, evenly sampled; (N, A) angles, (N,) hands."""

    time_s: Array
    value: Array
    sigma: Array
    hands_m: Array


def compare_performances(
    reference: Performance,
    attempt: Performance,
    *,
    reference_repetition: int = 0,
    attempt_repetition: int = 0,
) -> Comparison:
    """Compare one repetition of an attempt with one of a reference.

    Where no repetition is found in the attempt by itself, the part of it that is most like
    the reference's is compared.

    Parameters
    ----------
    reference, attempt
        The clips.
    reference_repetition, attempt_repetition
        Which repetition of each, from 0.

    Returns
    -------
    Comparison
        Angles missing in one of the clips are left out, with a note.

    Raises
    ------
    DataError
        If there is no such repetition, or nothing moves in the reference.
    AssessmentError
        If too few angles are known in both, or the movements are not the same kind.
    """
    own = find_repetitions(reference)
    one = _choose(own, reference_repetition, "reference", reference.label)
    others = find_repetitions(attempt, one.kind)
    other = None
    if others:
        other = _choose(others, attempt_repetition, "attempt", attempt.label)
    return _compare(reference, one, attempt, other)


def compare_every_repetition(
    reference: Performance, attempt: Performance, *, reference_repetition: int = 0
) -> tuple[Comparison, ...]:
    """Compare every repetition of an attempt with one of a reference.

    Raises as `compare_performances`.
    """
    own = find_repetitions(reference)
    one = _choose(own, reference_repetition, "reference", reference.label)
    others = find_repetitions(attempt, one.kind)
    if not others:
        return (_compare(reference, one, attempt, None),)
    return tuple(_compare(reference, one, attempt, other) for other in others)


def _choose(found: Sequence[Repetition], number: int, role: str, label: str) -> Repetition:
    if not found:
        raise DataError(
            f"Neither a lift nor a repeated movement was found in the {role} {label!r}, so there "
            "is nothing to compare with. Choose a clip that shows the whole movement."
        )
    if not 0 <= number < len(found):
        raise DataError(
            f"The {role} {label!r} has {len(found)} repetition(s); expected a number from 1 to "
            f"{len(found)}, got {number + 1}."
        )
    return found[number]


def _compare(
    reference: Performance, one: Repetition, attempt: Performance, other: Repetition | None
) -> Comparison:
    names, notes = _shared_angles(reference, one, attempt, other)
    first = _sample(reference, names, one.start_s, one.end_s)
    if other is None:
        start_s, end_s = _find_part(first, attempt, names)
        notes.append(
            f"No whole movement was found in {attempt.label} by itself; the part from "
            f"{start_s:.1f} to {end_s:.1f} s, most like the reference, is compared."
        )
    else:
        start_s, end_s = other.start_s, other.end_s
    second = _sample(attempt, names, start_s, end_s)
    share = _own_error_share(reference, attempt)
    doubt = _difference_sigma(first.sigma, second.sigma, share)
    scale = np.sqrt(np.mean(doubt**2, axis=0) + WEIGHT_FLOOR_DEG**2)
    found = warp(_features(first, scale), _features(second, scale))
    moved = _move(second, found)
    likeness = _likeness(first.value, moved.value, scale)
    if likeness < MIN_LIKENESS:
        raise AssessmentError(
            f"{reference.label} and {attempt.label} are different movements (likeness "
            f"{likeness:.2f}, at least {MIN_LIKENESS:g} is needed); compare two performances of "
            "the same lift or exercise."
        )
    sigma = _difference_sigma(first.sigma, moved.sigma, share)
    heights = tuple(_describe_heights(reference, one, attempt, other))
    phases = other.phases if other else _map_phases(one.phases, first.time_s, moved.time_s)
    return Comparison(
        reference=reference.label,
        attempt=attempt.label,
        names=names,
        percent=np.linspace(0.0, 100.0, N_SAMPLES),
        reference_deg=first.value,
        reference_sigma_deg=first.sigma,
        attempt_deg=moved.value,
        attempt_sigma_deg=moved.sigma,
        difference_sigma_deg=sigma,
        reference_time_s=first.time_s,
        attempt_time_s=moved.time_s,
        phases=one.phases,
        attempt_phases=phases,
        differences=tuple(_differences(names, first, moved, sigma, one.phases)),
        timings=tuple(_timings(one.phases, phases)),
        score=compute_score(moved.value - first.value, sigma),
        likeness=likeness,
        path=np.asarray(found.path, dtype=np.float64),
        notes=(*notes, *_describe_conditions(reference, attempt), *heights),
        reference_repetition=one.number,
        attempt_repetition=0 if other is None else other.number,
        own_error_share=share,
        is_same_work=not heights and (other is not None or one.kind == "exercise"),
    )


# --------------------------------------------------------------------------- curves


def _shared_angles(
    reference: Performance, one: Repetition, attempt: Performance, other: Repetition | None
) -> tuple[tuple[str, ...], list[str]]:
    """Return the angles known throughout both movements, and what was left out."""
    spans = [(reference, one.start_s, one.end_s)]
    spans.append(
        (attempt, attempt.time_s[0], attempt.time_s[-1])
        if other is None
        else (attempt, other.start_s, other.end_s)
    )
    both = [n for n in reference.form_angles if n in attempt.form_angles]
    names, unseen = [], []
    for name in both:
        if any(_has_gap(p, name, low, high, other is None) for p, low, high in spans):
            unseen.append(_plain(name))
        else:
            names.append(name)
    notes = []
    if unseen:
        notes.append(
            f"Not compared, because they were not seen for longer than {MAX_GAP_S:g} s in one of "
            f"the clips: {'; '.join(unseen)}."
        )
    if len(names) < MIN_ANGLES:
        raise AssessmentError(
            f"Only {len(names)} joint angles are known throughout both movements, at least "
            f"{MIN_ANGLES} are needed; film the whole body from the side."
        )
    return tuple(names), notes


def _has_gap(
    performance: Performance, name: str, low_s: float, high_s: float, is_search: bool
) -> bool:
    time_s = performance.time_s
    part = (time_s >= low_s - 1e-9) & (time_s <= high_s + 1e-9)
    values = performance.values((name,))[part, 0]
    # While the movement is still looked for, the clip's ends may be missing.
    return bool(np.isnan(values).mean() > 0.2 if is_search else np.isnan(values[1:-1]).any())


def _plain(name: str) -> str:
    side = {"_l": ", left", "_r": ", right"}.get(name[-2:], "")
    return (name[:-2] if side else name).replace("_", " ").capitalize() + side


def _sample(
    performance: Performance, names: Sequence[str], start_s: float, end_s: float, n: int = N_SAMPLES
) -> _Curves:
    """Resample a part of a clip evenly; what is missing at its ends is held."""
    time_s = np.linspace(start_s, end_s, n)
    own = performance.time_s
    value = np.column_stack([_interpolate(time_s, own, performance.angles[n]) for n in names])
    doubt = np.column_stack([_interpolate(time_s, own, performance.angles.sigma(n)) for n in names])
    height = fill_short_gaps(own, performance.hand_height_m)
    return _Curves(
        time_s=time_s,
        value=value,
        sigma=np.where(np.isfinite(doubt), doubt, UNKNOWN_SIGMA_DEG),
        hands_m=_interpolate(time_s, own, height),
    )


def _interpolate(wanted_s: Array, time_s: Array, values: Array) -> Array:
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(wanted_s), np.nan)
    return np.asarray(np.interp(wanted_s, time_s[known], values[known]))


def _features(curves: _Curves, scale: Array) -> Array:
    """Return what the alignment looks at: angles over their doubt, and the hands' height."""
    angles = curves.value / scale
    hands = curves.hands_m - np.min(curves.hands_m)
    if not np.isfinite(hands).all():
        hands = np.zeros(len(hands))
    return np.column_stack([angles, hands / HAND_SCALE_M])


def _find_part(first: _Curves, attempt: Performance, names: Sequence[str]) -> tuple[float, float]:
    """Return the part of the attempt that is most like the reference's movement."""
    step_s = float(first.time_s[1] - first.time_s[0])
    own = attempt.time_s
    n = max(3, round((own[-1] - own[0]) / step_s) + 1)
    whole = _sample(attempt, names, float(own[0]), float(own[-1]), n)
    scale = np.sqrt(np.mean(first.sigma**2, axis=0) + WEIGHT_FLOOR_DEG**2)
    start, end, _ = find_subsequence(_features(first, scale), _features(whole, scale))
    if end - start < 0.25 * N_SAMPLES:
        raise AssessmentError(
            f"The reference's movement was not found in {attempt.label}; choose a clip that shows "
            "the same lift or exercise from beginning to end."
        )
    return float(whole.time_s[start]), float(whole.time_s[end])


def _move(second: _Curves, found: Warp) -> _Curves:
    """Return the attempt's curves at the reference's samples."""
    n = np.arange(len(second.time_s), dtype=np.float64)

    def take(values: Array) -> Array:
        return np.asarray(np.interp(found.position, n, values))

    return _Curves(
        time_s=take(second.time_s),
        value=np.column_stack([take(column) for column in second.value.T]),
        sigma=np.column_stack([take(column) for column in second.sigma.T]),
        hands_m=take(second.hands_m),
    )


def _own_error_share(reference: Performance, attempt: Performance) -> float:
    """Return which share of the stated errors is not the same one in both clips."""
    if _is_measured_alike(reference, attempt):
        same = bool(reference.person) and reference.person == attempt.person
        return OWN_ERROR_SAME_PERSON if same else OWN_ERROR_OTHER_PERSON
    return 1.0


def _is_measured_alike(reference: Performance, attempt: Performance) -> bool:
    how = [(p.skeleton, p.solver, p.n_views) for p in (reference, attempt)]
    return how[0] == how[1] and not _view_apart(reference, attempt) > SAME_VIEW_DEG


def _view_apart(reference: Performance, attempt: Performance) -> float:
    """Return the angle between the cameras around the person, degrees; NaN where unknown."""
    return abs((reference.view_azimuth_deg - attempt.view_azimuth_deg + 180) % 360 - 180)


def _difference_sigma(first: Array, second: Array, share: float) -> Array:
    return np.asarray(np.hypot(share * np.hypot(first, second), LEAST_SIGMA_DEG))


def _likeness(reference: Array, attempt: Array, scale: Array) -> float:
    """Return the correlation of all movements together, -1 to 1; large movements count most."""
    one = (reference - reference.mean(axis=0)) / scale
    two = (attempt - attempt.mean(axis=0)) / scale
    size = math.sqrt(float((one**2).sum() * (two**2).sum()))
    return float((one * two).sum()) / size if size > 0 else 0.0


# --------------------------------------------------------------------------- phases


def _map_phases(phases: Sequence[Phase], reference_s: Array, attempt_s: Array) -> tuple[Phase, ...]:
    """Return a reference's phases at the attempt's moments; their error is not known."""
    return tuple(
        Phase(
            p.key,
            float(np.interp(p.start_s, reference_s, attempt_s)),
            float(np.interp(p.end_s, reference_s, attempt_s)),
        )
        for p in phases
    )


def _differences(
    names: Sequence[str], first: _Curves, second: _Curves, sigma: Array, phases: Sequence[Phase]
) -> Iterator[PhaseDifference]:
    for phase in phases:
        part = (first.time_s >= phase.start_s - 1e-9) & (first.time_s <= phase.end_s + 1e-9)
        if not part.any():
            part = (
                np.abs(first.time_s - phase.start_s) == np.abs(first.time_s - phase.start_s).min()
            )
        for i, name in enumerate(names):
            one, two, doubt = first.value[part, i], second.value[part, i], sigma[part, i]
            yield PhaseDifference(
                phase=phase.key,
                angle=name,
                # One error for the whole phase: averaging over its samples does not shrink it.
                mean=Measurement(float(np.mean(two - one)), float(np.mean(doubt))),
                peak=Measurement(float(two.max() - one.max()), float(doubt[np.argmax(two)])),
                reference_deg=float(one.mean()),
                attempt_deg=float(two.mean()),
            )


def _timings(phases: Sequence[Phase], others: Sequence[Phase]) -> Iterator[PhaseTiming]:
    for one, two in zip(phases, others, strict=True):
        if not one.is_moment:
            yield PhaseTiming(
                one.key,
                Measurement(one.duration_s, one.duration_sigma_s),
                Measurement(two.duration_s, two.duration_sigma_s),
            )


def _describe_conditions(reference: Performance, attempt: Performance) -> Iterator[str]:
    """Say what differs between the recordings rather than between the movements."""
    if reference.skeleton != attempt.skeleton or reference.solver != attempt.solver:
        yield (
            "The angles were found in different ways "
            f"({reference.solver or 'unknown'}, {reference.skeleton or 'unknown'} and "
            f"{attempt.solver or 'unknown'}, {attempt.skeleton or 'unknown'}); part of the "
            "differences may come from that. Assess both with the same settings."
        )
    if reference.n_views != attempt.n_views:
        yield (
            f"One was filmed by {reference.n_views} and the other by {attempt.n_views} "
            "camera(s); the errors stated are those of each."
        )
    apart = _view_apart(reference, attempt)
    if apart > SAME_VIEW_DEG:
        yield (
            f"The cameras stood {apart:.0f} degrees apart around the person; film from the same "
            "side to compare small differences."
        )
    if reference.person and attempt.person and reference.person != attempt.person:
        yield ("Two different persons are compared: body proportions make part of the differences.")


def _describe_heights(
    reference: Performance, one: Repetition, attempt: Performance, other: Repetition | None
) -> Iterator[str]:
    """Say where two lifts start or end at different heights."""
    if one.kind != "lift" or other is None:
        return
    pairs = (("starts", "origin"), ("ends", "destination"))
    lifts = [sorted(p.lifts, key=lambda x: x.start_s) for p in (reference, attempt)]
    first, second = lifts[0][one.number], lifts[1][other.number]
    for verb, end in pairs:
        a, b = getattr(first, end).V_cm, getattr(second, end).V_cm
        if math.isnan(a.value) or math.isnan(b.value):
            continue
        apart = b.value - a.value
        if abs(apart) > max(20.0, 1.96 * math.hypot(a.sigma, b.sigma)):
            yield (
                f"The attempt {verb} {abs(apart):.0f} cm {'higher' if apart > 0 else 'lower'} "
                "than the reference: the work differs, not only the form."
            )
