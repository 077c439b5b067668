"""The correction of one track: sides exchanged back, outliers rejected, gaps filled, smoothed."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from engine.correction.diagnosis import Diagnosis, diagnose
from engine.correction.gaps import fill_gaps, long_gaps
from engine.correction.kalman import KalmanSmoother
from engine.correction.links import measure_links
from engine.correction.notes import describe_diagnosis, list_unrepairable, list_warnings
from engine.correction.paper import correct_as_published
from engine.correction.smoothers import (
    Butterworth,
    Hampel,
    Median,
    OneEuro,
    SavitzkyGolay,
    Smoother,
    Unsmoothed,
    smooth_runs,
)
from engine.datatypes import Array, PoseTrack, Status
from engine.errors import ConfigError
from engine.skeletons import get_skeleton

__all__ = ["correct_track", "summarise_status"]

Mask = NDArray[np.bool_]


def correct_track(
    track: PoseTrack,
    *,
    preset: Literal["default", "paper", "none"] = "default",
    min_confidence: float = 0.3,
    max_gap_s: float = 0.5,
    smoother: str = "kalman",
    cutoff_hz: float = 6.0,
    window_s: float = 0.3,
    jerk: float = 15.0,
    gate_probability: float = 1.0,
    min_cutoff_hz: float = 3.0,
    beta: float = 4.0,
    repair_swaps: bool = True,
    reject_outliers: bool = True,
    stature_m: float | None = None,
) -> PoseTrack:
    """Clean the keypoints of one track.

    The chain `default` (1) exchanges left and right back where they were mixed up, (2) rejects
    samples of low confidence, and joints that make links change their length with what hangs on
    them, (3) fills gaps up to `max_gap_s` and (4) smooths. Longer gaps stay NaN, and so do those at
    the ends of the clip. `paper` is the chain of Choi et al. (2024); see `correct_as_published`.

    Parameters
    ----------
    track
        Any track, px or m.
    preset
        `default`, `paper`, or `none`, which returns the track as it is.
    min_confidence
        0 to 1. A sample of unknown confidence is kept. `paper` takes no notice of it.
    max_gap_s
        Longest gap that is filled, s; `paper` fills any.
    smoother
        `kalman`, `butterworth`, `savitzky_golay`, `median`, `hampel`, `one_euro` or `none`.
    cutoff_hz
        Of `butterworth`: cut-off frequency after both passes, Hz.
    window_s
        Of `savitzky_golay`, `median` and `hampel`, s.
    jerk, gate_probability
        Of `kalman`: how lively people move, m/s^2.5, and how likely a measurement must be to be
        left out as an outlier of the motion (0.999 leaves out one in a thousand, 1 none).
    min_cutoff_hz, beta
        Of `one_euro`: cut-off at rest, Hz, and its rise with speed, Hz per m/s.
    repair_swaps, reject_outliers
        Whether sides are exchanged back, and whether link lengths are tested.
    stature_m
        To express links in centimetres; an average adult's if None.

    Returns
    -------
    PoseTrack
        With the status of every sample, wider `sigma` where filled, and what was done and why
        in `provenance["correction"]`.

    Raises
    ------
    ConfigError
        If the preset or the smoother does not exist.
    """
    if preset == "none":
        return track
    if preset == "paper":
        return _correct_as_published(track, stature_m)
    if preset != "default":
        raise ConfigError(
            f"The correction preset must be 'default', 'paper' or 'none', got {preset!r}."
        )
    chosen = _choose_smoother(
        smoother,
        cutoff_hz=cutoff_hz,
        window_s=window_s,
        jerk=jerk,
        gate_probability=gate_probability,
        min_cutoff_hz=min_cutoff_hz,
        beta=beta,
    )
    found = diagnose(
        track,
        min_confidence=min_confidence,
        repair_swaps=repair_swaps,
        reject_outliers=reject_outliers,
        stature_m=stature_m,
    )
    corrected, n_gated = _fill_and_smooth(found, chosen, max_gap_s, stature_m)
    unrepairable = list_unrepairable(corrected, found, max_gap_s=max_gap_s)
    note = {
        "smoother": smoother,
        **chosen.settings,
        "max_gap_s": max_gap_s,
        "min_confidence": min_confidence,
        **describe_diagnosis(found),
        "gated": n_gated,
        "unrepairable": unrepairable,
        # What was merely hidden shows in the coverage.
        "warnings": list_warnings(
            found, sum(stretch["reason"] != "low confidence" for stretch in unrepairable)
        ),
    }
    return _with_note(corrected, "default", note)


def _with_note(track: PoseTrack, preset: str, note: dict[str, Any]) -> PoseTrack:
    note = {"preset": preset, **note, **summarise_status(track)}
    return dataclasses.replace(track, provenance={**track.provenance, "correction": note})


def _choose_smoother(name: str, **settings: float) -> Smoother | KalmanSmoother:
    """Return the smoother of a name with those of the settings that it has."""
    kinds: dict[str, Any] = {
        "kalman": KalmanSmoother,
        "butterworth": Butterworth,
        "savitzky_golay": SavitzkyGolay,
        "median": Median,
        "hampel": Hampel,
        "one_euro": OneEuro,
        "none": Unsmoothed,
    }
    if name not in kinds:
        raise ConfigError(f"The smoother must be one of {', '.join(kinds)}; got {name!r}.")
    kind = kinds[name]
    own = {f.name for f in dataclasses.fields(kind)}
    smoother: Smoother | KalmanSmoother = kind(**{k: v for k, v in settings.items() if k in own})
    return smoother


def _fill_and_smooth(
    found: Diagnosis, chosen: Smoother | KalmanSmoother, max_gap_s: float, stature_m: float | None
) -> tuple[PoseTrack, int]:
    """Return the corrected track and how many more samples the smoother left out."""
    track = found.track
    rejected = found.is_rejected
    status, sigma = np.array(track.status), np.array(track.sigma)
    kept = np.where((rejected | ~track.is_present)[:, :, None], np.nan, track.position)
    # Smoothers are set in metres; pixels are brought to the size of the body.
    unit_m = _metres_per_unit(track, stature_m)
    if isinstance(chosen, KalmanSmoother):
        path = chosen.smooth(track.time_s, kept * unit_m, track.confidence)
        kept = np.where(path.is_gated[:, :, None], np.nan, kept)
        rejected = rejected | path.is_gated
        position = path.position / unit_m
        _remove_long_gaps(track.time_s, position, kept, max_gap_s)
    else:
        filled = [
            fill_gaps(track.time_s, kept[:, k], max_gap_s=max_gap_s) for k in range(kept.shape[1])
        ]
        position = smooth_runs(chosen, track.time_s, np.stack(filled, axis=1) * unit_m) / unit_m
    is_kept = np.asarray(np.isfinite(kept).all(axis=2))
    is_filled = np.asarray(np.isfinite(position).all(axis=2) & ~is_kept)
    for k in np.flatnonzero(is_filled.any(axis=0)):
        sigma[:, k] = _widen_filled(track.time_s, kept[:, k], sigma[:, k], is_filled[:, k])
    _settle_status(status, position, rejected=rejected, is_filled=is_filled)
    n_gated = int((rejected & ~found.is_rejected).sum())
    return dataclasses.replace(track, position=position, sigma=sigma, status=status), n_gated


def _settle_status(
    status: NDArray[np.uint8], position: Array, *, rejected: Mask, is_filled: Mask
) -> None:
    """Say of every sample what happened to it, in place."""
    is_absent = ~np.isfinite(position).all(axis=2)
    status[is_absent & (status != Status.REJECTED)] = Status.MISSING
    status[rejected] = Status.REJECTED
    status[is_filled] = Status.FILLED


def _metres_per_unit(track: PoseTrack, stature_m: float | None) -> float:
    if track.unit == "m":
        return 1.0
    scale = measure_links(track, stature_m=stature_m).scale_cm
    known = scale[np.isfinite(scale)]
    # A body without links: taken as 400 px tall, which only sets how strongly it is smoothed.
    return float(np.median(known)) / 100.0 if known.size else 1.7 / 400.0


def _remove_long_gaps(time_s: Array, position: Array, kept: Array, max_gap_s: float) -> None:
    """Set the samples that must not be filled to NaN, in place."""
    missing = np.asarray(~np.isfinite(kept).all(axis=2))
    for k in np.flatnonzero(missing.any(axis=0)):
        position[long_gaps(time_s, missing[:, k], max_gap_s=max_gap_s), k] = np.nan


def _widen_filled(time_s: Array, kept: Array, sigma: Array, is_filled: Mask) -> Array:
    """Return standard errors that grow into a gap with the point's own typical motion."""
    known = np.isfinite(kept).all(axis=1)
    if not is_filled.any() or known.sum() < 2:
        return sigma
    known_s = time_s[known]
    after = np.clip(np.searchsorted(known_s, time_s[is_filled]), 1, known_s.size - 1)
    nearest = np.minimum(
        np.abs(time_s[is_filled] - known_s[after - 1]), np.abs(time_s[is_filled] - known_s[after])
    )
    speed = np.linalg.norm(np.diff(kept[known], axis=0), axis=1) / np.diff(time_s[known])
    # Per coordinate; a filled path may leave the true one by about the typical speed x time away.
    drift = nearest * float(np.median(speed)) / np.sqrt(kept.shape[1])
    base = float(np.nanmedian(sigma[known])) if np.isfinite(sigma[known]).any() else 0.0
    widened = sigma.copy()
    widened[is_filled] = np.hypot(base, drift)
    return widened


def _correct_as_published(track: PoseTrack, stature_m: float | None) -> PoseTrack:
    clean = np.where(track.is_present[:, :, None], track.position, np.nan)
    links = measure_links(track, stature_m=stature_m)
    published = correct_as_published(track.time_s, clean, links)
    removed = published.is_removed & track.is_present
    is_back = np.isfinite(published.position).all(axis=2)
    is_filled = np.asarray(is_back & (removed | ~track.is_present))
    status, sigma = np.array(track.status), np.array(track.sigma)
    _settle_status(status, published.position, rejected=removed, is_filled=is_filled)
    kept = np.where(removed[:, :, None], np.nan, clean)
    for k in np.flatnonzero(is_filled.any(axis=0)):
        sigma[:, k] = _widen_filled(track.time_s, kept[:, k], sigma[:, k], is_filled[:, k])
    corrected = dataclasses.replace(track, position=published.position, sigma=sigma, status=status)
    warnings = []
    if published.is_unsteady.any():
        warnings.append(
            f"{int(published.is_unsteady.sum())} of {published.is_unsteady.size} links change "
            "their length in most of the frames; fixed thresholds were used."
        )
    note = {"smoother": "median", "rejected": int(removed.sum()), "warnings": warnings}
    return _with_note(corrected, "paper", note)


def summarise_status(
    track: PoseTrack, *, keypoints: tuple[str, ...] | None = None
) -> dict[str, float]:
    """Return the share of joint samples measured, repaired, filled and missing (sum 1).

    A sample that exists after smoothing counts by how it came to be; a rejected sample that
    could not be filled is missing.

    Parameters
    ----------
    track
        Any track.
    keypoints
        Names to count; all if None.
    """
    skeleton = get_skeleton(track.skeleton)
    columns = [skeleton.index(k) for k in keypoints or skeleton.keypoints]
    status = np.asarray(track.status)[:, columns]
    present = track.is_present[:, columns]
    total = max(status.size, 1)
    shares = {
        "measured": (present & np.isin(status, (Status.MEASURED, Status.SMOOTHED))).sum(),
        "repaired": (present & (status == Status.REPAIRED)).sum(),
        "filled": (present & (status == Status.FILLED)).sum(),
    }
    result = {name: float(count) / total for name, count in shares.items()}
    result["missing"] = 1.0 - sum(result.values())
    return result
