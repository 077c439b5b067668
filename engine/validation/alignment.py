"""Bringing the angles of a result and a reference onto one time axis.

The lag comes from the cross-correlation of several angles at once and is refused where the curves
don't fit. Then angles are paired sample by sample; a constant offset by convention is kept apart
from error. Positions are brought together by `engine.validation.spatial`.

Times: ``result time = reference time + lag_s``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, JointAngles, frozen_array
from engine.errors import ConfigError, DataError, ShapeError, UnitError
from engine.validation.curves import wrap_deg
from engine.validation.lag_search import (
    GRID_HZ,
    EvenCurves,
    LagSearch,
    excursion,
    find_peak,
    find_runner_up,
    refine_peak,
    resample_evenly,
    search_lags,
)
from engine.validation.resampling import resample_angles

__all__ = [
    "OffsetMethod",
    "PairedAngles",
    "TimeAlignment",
    "estimate_lag",
    "pair_angles",
]

OffsetMethod = Literal["none", "median", "start"]

MIN_CORRELATION = 0.75
"""Unlike movements reach 0.7 by chance, as one of the peaks of any two recordings fits best."""
MIN_EXPLAINED = 0.6
"""Lifts filmed by one camera explain 0.7 and more of their own reference, squats 0.55 at most."""
SWAP_GAIN = 0.15
"""Sides count as exchanged when the correlation gains more than this by exchanging them."""
UNIT_FACTOR = 20.0
OPPOSITE = -0.6
BLOCK_S = 0.5
SMOOTH_S = 0.25
STILL_MARGIN = 0.03


@dataclass(frozen=True)
class TimeAlignment:
    """How far a reference is shifted in time, and how sure that is.

    Parameters
    ----------
    lag_s
        To add to the reference's times.
    lag_sigma_s
        Its standard error, from what is left between the curves.
    correlation
        Of all angles together at that lag, each by its excursion; 1 is perfect.
    correlations
        Of every angle that was used.
    overlap_s
        How long both last together.
    runner_up_s, runner_up_correlation
        The best lag apart from this one; movements that repeat have such.
    opposite
        Angles that run the other way: their sign is likely wrong.
    notes
        What to know, in words.
    """

    lag_s: float
    lag_sigma_s: float
    correlation: float
    correlations: Mapping[str, float]
    overlap_s: float
    runner_up_s: float = float("nan")
    runner_up_correlation: float = float("nan")
    opposite: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def confidence(self) -> float:
        """Return 0 (another lag fits as well) to 1 (no other lag comes near)."""
        other = self.runner_up_correlation
        if not np.isfinite(other):
            return self.correlation
        # The share of what the runner-up leaves unexplained that the best lag explains.
        gain = (self.correlation - other) / max(1.0 - other, 1e-9)
        return float(np.clip(gain, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class PairedAngles:
    """Two sets of curves at the same times; shape (T, A), degrees, NaN where either is missing.

    `offset_deg` (A,) is the constant difference, result minus reference, that counts as
    convention; `difference_deg` still holds it, `error_deg` does not.
    """

    time_s: Array
    names: tuple[str, ...]
    estimated_deg: Array
    reference_deg: Array
    offset_deg: Array
    offset_method: OffsetMethod
    sigma_deg: Array

    def __post_init__(self) -> None:
        shape = (np.asarray(self.time_s).shape[0], len(self.names))
        for name in ("time_s", "estimated_deg", "reference_deg", "offset_deg", "sigma_deg"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))
        for name in ("estimated_deg", "reference_deg", "sigma_deg"):
            if getattr(self, name).shape != shape:
                raise ShapeError(f"{name} needs shape {shape}, got {getattr(self, name).shape}.")

    @property
    def difference_deg(self) -> Array:
        """Result minus reference, -180 to 180, shape (T, A)."""
        return wrap_deg(self.estimated_deg - self.reference_deg)

    @property
    def error_deg(self) -> Array:
        """The difference without the offset by convention, shape (T, A)."""
        return wrap_deg(self.difference_deg - self.offset_deg)


# --------------------------------------------------------------------------- lag


def estimate_lag(
    result: JointAngles,
    reference: JointAngles,
    *,
    names: Sequence[str] | None = None,
    max_lag_s: float | None = None,
    min_correlation: float = MIN_CORRELATION,
    min_explained: float = MIN_EXPLAINED,
) -> TimeAlignment:
    """Find the shift in time that fits the curves best.

    All angles count together, each by its excursion, so that curves that hardly move add
    little. Constant offsets don't matter; rates may differ, and either recording may be the
    shorter one. The peak is interpolated between samples.

    Parameters
    ----------
    result, reference
        Angles in one convention.
    names
        Angles to use; by default all that both have.
    max_lag_s
        Lags to try to either side; by default all that leave enough overlap (1 s and 40 % of the
        shorter recording).
    min_correlation
        Below this the recordings count as different movements.
    min_explained
        The same for the share of the reference's variance that the result explains as it is,
        constant offsets aside. Other movements of bending people correlate, but differ in size.

    Raises
    ------
    DataError
        If no angle is common, the recordings are too short, or they don't fit: another movement
        or person, or left and right exchanged.
    UnitError
        If the reference looks like radians taken for degrees or the reverse.
    """
    common = _common_names(result, reference, names)
    own = resample_evenly(result, common, word="result")
    other = resample_evenly(reference, common, word="reference")
    search = search_lags(own, other, [(name, name) for name in common], max_lag_s=max_lag_s)
    best = find_peak(search)
    _refuse_swapped_sides(own, other, max_lag_s, float(search.pooled[best]))
    if not search.pooled[best] >= min_correlation:
        raise DataError(
            f"The reference does not fit the result: the best correlation is "
            f"{search.pooled[best]:.2f}, at a lag of {search.lag_s[best]:.2f} s; expected at least "
            f"{min_correlation:g}. Is it the same person and movement?"
        )
    lag = refine_peak(search, best)
    runner, runner_r = find_runner_up(search, best)
    single = dict(zip(search.names, map(float, search.single[:, best]), strict=True))
    time, aligned, moved = _paired_at(result, reference, search.names, lag)
    _refuse_wrong_unit(aligned, moved)
    opposite = tuple(name for name, r in single.items() if r < OPPOSITE)
    alike = [name not in opposite for name in search.names]
    _refuse_other_movement(aligned[:, alike], moved[:, alike], lag, min_explained)
    return TimeAlignment(
        lag_s=lag,
        lag_sigma_s=_estimate_lag_sigma(time, aligned, moved),
        correlation=float(search.pooled[best]),
        correlations=single,
        overlap_s=float(search.overlap_s[best]),
        runner_up_s=runner,
        runner_up_correlation=runner_r,
        opposite=opposite,
        notes=_lag_notes(float(search.pooled[best]), runner, runner_r, opposite),
    )


def _lag_notes(
    correlation: float, runner_up_s: float, runner_up: float, opposite: tuple[str, ...]
) -> tuple[str, ...]:
    notes = []
    if runner_up > correlation - STILL_MARGIN:
        notes.append(
            f"The movement repeats: a lag of {runner_up_s:.2f} s fits nearly as well. Check that "
            "the right repetitions lie on each other, or limit max_lag_s."
        )
    if opposite:
        notes.append(
            f"These angles run the other way than in the result: {', '.join(opposite)}. Check "
            "their sign in the import profile."
        )
    return tuple(notes)


def _common_names(
    result: JointAngles, reference: JointAngles, names: Sequence[str] | None
) -> tuple[str, ...]:
    wanted = result.names if names is None else tuple(names)
    common = tuple(n for n in wanted if n in result.names and n in reference.names)
    if not common:
        raise DataError(
            "Result and reference have no angle in common; the result has "
            f"{', '.join(result.names[:4])} ..., the reference {', '.join(reference.names[:4])} ..."
        )
    return common


def _pick(angles: JointAngles, names: Sequence[str]) -> Array:
    return np.column_stack([angles[name] for name in names])


def _paired_at(
    result: JointAngles, reference: JointAngles, names: Sequence[str], lag_s: float
) -> tuple[Array, Array, Array]:
    """Return common times and both sets of curves (T, A) there."""
    moved = replace(reference, time_s=reference.time_s + lag_s)
    start = max(result.time_s[0], moved.time_s[0])
    end = min(result.time_s[-1], moved.time_s[-1])
    time = np.arange(start, end, 1.0 / GRID_HZ)
    return (
        time,
        _pick(resample_angles(result, time, names=names), names),
        _pick(resample_angles(moved, time, names=names), names),
    )


def _estimate_lag_sigma(time: Array, own: Array, other: Array) -> float:
    """Return the standard error of the lag by the sandwich rule over blocks of half a second.

    A residual e moves the best lag by sum(e dx/dt) / sum((dx/dt)^2). Residuals of neighbouring
    samples go together, so their products are summed per block before they are squared.
    """
    if time.size < 3:
        return float("nan")
    # Slopes of noise would look like steepness, so they are taken from smoothed curves.
    middle = np.column_stack([_smooth(column) for column in ((own + other) / 2).T])
    slope = np.gradient(middle, time, axis=0)
    residual = own - other
    known = np.isfinite(residual)
    means = np.where(known, residual, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    residual = residual - means
    product = np.nan_to_num(residual * slope).sum(axis=1)
    steepness = float(np.nansum(slope**2))
    block = max(1, round(BLOCK_S * GRID_HZ))
    sums = np.add.reduceat(product, np.arange(0, product.size, block))
    return float(np.sqrt((sums**2).sum()) / steepness) if steepness > 0 else float("nan")


def _smooth(curve: Array) -> Array:
    """Return the moving mean over `SMOOTH_S`, of the samples that exist."""
    window = np.ones(round(SMOOTH_S * GRID_HZ) | 1)
    window = window[: max(1, curve.size - (curve.size % 2 == 0))]
    known = np.isfinite(curve)
    total = np.convolve(np.where(known, curve, 0.0), window, mode="same")
    count = np.convolve(known.astype(np.float64), window, mode="same")
    return np.where(known, total / np.maximum(count, 1.0), np.nan)


def _refuse_swapped_sides(
    result: EvenCurves, reference: EvenCurves, max_lag_s: float | None, as_labelled: float
) -> None:
    other = {"_l": "_r", "_r": "_l"}
    exchanged = [
        (name, f"{name[:-2]}{other[name[-2:]]}")
        for name in result.curves
        if name[-2:] in other and f"{name[:-2]}{other[name[-2:]]}" in reference.curves
    ]
    if not exchanged:
        return
    labelled = [(name, name) for name, _ in exchanged]
    try:
        r_exchanged = _best(search_lags(result, reference, exchanged, max_lag_s=max_lag_s))
        r_labelled = _best(search_lags(result, reference, labelled, max_lag_s=max_lag_s))
    except DataError:
        return  # no limb moves, so that the sides can't be told
    if r_exchanged > max(r_labelled, as_labelled) + SWAP_GAIN and r_exchanged >= MIN_CORRELATION:
        raise DataError(
            "Left and right look exchanged in the reference: the correlation is "
            f"{r_exchanged:.2f} with sides exchanged and {r_labelled:.2f} as labelled. Set "
            "swap_sides = true in an import profile, or check that the video is not mirrored."
        )


def _best(search: LagSearch) -> float:
    return float(search.pooled[find_peak(search)])


def _refuse_wrong_unit(own: Array, other: Array) -> None:
    """Refuse a reference whose curves are some 57 times too small or too large."""
    moves = [(excursion(other[:, i]), excursion(own[:, i])) for i in range(own.shape[1])]
    ratios = [theirs / ours for theirs, ours in moves if ours > 0]
    if not ratios:
        return
    ratio = float(np.median(ratios))
    if not 1 / UNIT_FACTOR <= ratio <= UNIT_FACTOR:
        word = "radians" if ratio < 1 else "degrees"
        raise UnitError(
            f"The angles of the reference move {ratio:.3g} times as much as those of the result; "
            f"they look like {word}. Set angle_unit = '{word[:3]}' in an import profile."
        )


def _refuse_other_movement(own: Array, other: Array, lag_s: float, min_explained: float) -> None:
    """Refuse curves that rise and fall together but by other amounts."""
    known = np.isfinite(own) & np.isfinite(other)
    difference = np.where(known, own - other, np.nan)[:, known.sum(axis=0) >= 2]
    reached = np.where(known, other, np.nan)[:, known.sum(axis=0) >= 2]
    total = float(np.nanvar(reached, axis=0).sum()) if reached.size else 0.0
    if total <= 0:
        return
    explained = 1.0 - float(np.nanvar(difference, axis=0).sum()) / total
    if explained < min_explained:
        raise DataError(
            f"The reference does not fit the result: at the best lag of {lag_s:.2f} s the angles "
            f"rise and fall together, but explain only {100 * max(0.0, explained):.0f} % of the "
            f"reference's movement; expected at least {100 * min_explained:.0f} %. Is it the same "
            "person and movement?"
        )


# --------------------------------------------------------------------------- pairing


def pair_angles(
    result: JointAngles,
    reference: JointAngles,
    *,
    lag_s: float = 0.0,
    names: Sequence[str] | None = None,
    offset: OffsetMethod = "median",
    start_s: float = 1.0,
) -> PairedAngles:
    """Bring two sets of angles together, at the result's times within the overlap.

    Parameters
    ----------
    result, reference
        Angles in one convention.
    lag_s
        To add to the reference's times.
    names
        Angles to compare; by default all that both have.
    offset
        What counts as convention: `median` the median difference over the overlap, `start` over
        its first `start_s` seconds, `none` nothing.
    start_s
        How long the start is.

    Raises
    ------
    DataError
        If there is no common angle or the recordings don't overlap.
    ConfigError
        If the offset method is unknown.
    """
    if offset not in get_args(OffsetMethod):
        raise ConfigError(
            f"offset must be one of {', '.join(get_args(OffsetMethod))}, got {offset!r}."
        )
    common = _common_names(result, reference, names)
    moved = replace(reference, time_s=reference.time_s + lag_s)
    inside = (result.time_s >= moved.time_s[0]) & (result.time_s <= moved.time_s[-1])
    if inside.sum() < 2:
        raise DataError(
            f"Result ({result.time_s[0]:.2f} to {result.time_s[-1]:.2f} s) and reference "
            f"({moved.time_s[0]:.2f} to {moved.time_s[-1]:.2f} s with a lag of {lag_s:.2f} s) do "
            "not overlap; estimate the lag first."
        )
    time = result.time_s[inside]
    own = _pick(result, common)[inside]
    other = _pick(resample_angles(moved, time, names=common), common)
    missing = ~(np.isfinite(own) & np.isfinite(other))
    own, other = np.where(missing, np.nan, own), np.where(missing, np.nan, other)
    window = time <= time[0] + start_s if offset == "start" else np.ones(time.size, dtype=bool)
    return PairedAngles(
        time_s=time,
        names=common,
        estimated_deg=own,
        reference_deg=other,
        offset_deg=_offsets(own - other, window, offset),
        offset_method=offset,
        sigma_deg=np.column_stack([result.sigma(name) for name in common])[inside],
    )


def _offsets(difference: Array, window: NDArray[np.bool_], method: OffsetMethod) -> Array:
    """Return the median difference of every angle in the window; NaN without samples there."""
    offsets = np.zeros(difference.shape[1])
    if method == "none":
        return offsets
    for i, column in enumerate(difference.T):
        known = wrap_deg(column[window & np.isfinite(column)])
        if not known.size:
            offsets[i] = np.nan
            continue
        # The median of angles near +-180 is taken around their own mean direction.
        middle = np.degrees(np.angle(np.exp(1j * np.radians(known)).sum()))
        offsets[i] = wrap_deg(middle + np.median(wrap_deg(known - middle)))
    return offsets
