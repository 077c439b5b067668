"""How the clocks of two videos of one movement belong together.

The movement itself is the clock: the same joints speed up and slow down in both pictures
(`engine.video._motion`). Sound, where there is any, is a second witness (`engine.video._audio`),
and known cameras sharpen the result (`refine_offset`). An estimate says how sure it is; one that is
not sure is red and must not be used, see `require_sure`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from engine.datatypes import CheckLevel, SyncEstimate, ViewPose
from engine.errors import DataError, SyncError
from engine.skeletons import get_skeleton
from engine.video._audio import AudioLag, AudioTrack, estimate_audio_lag, read_audio
from engine.video._epipolar import refine_offset
from engine.video._motion import (
    KEYPOINTS,
    MIN_OVERLAP_S,
    Comparison,
    Motion,
    compare,
    compute_motion,
    find_lags,
    measure_height,
)
from engine.video._resample import SyncedViews, resample_views

__all__ = [
    "AudioTrack",
    "SyncedViews",
    "check_offset",
    "estimate_offset",
    "read_audio",
    "refine_offset",
    "require_sure",
    "resample_views",
]

EVIDENCE: Final = (-26.03, -5.56, 3.48, -22.8)
"""Constant, scatter, number of parts and lack of correlation: logistic regression in
`_weigh_evidence`, fitted on true and false pairs of synthetic training lifts and of made figures
(``benchmarks/sync.py --fit``)."""
USUAL_CORRELATION: Final = 0.9
"""Of nearly all true pairs, noise included; a lower one speaks against a pair."""
ENOUGH_MOVING_S: Final = 1.5
SHORTNESS: Final = -6.0
"""Log-odds per second of common movement that is lacking: seconds of two lifts agree by chance."""
MAX_PARTS: Final = 20.0
"""More parts than this were not in the pairs of the fit, so they count no further."""
GREEN_CONFIDENCE: Final = 0.9
AMBER_CONFIDENCE: Final = 0.5
MIN_MOVING_S: Final = 0.5
SAME_LAG_S: Final = 0.2
"""Peaks that converge within this time of each other are one."""
SCATTER_FLOOR_S: Final = 0.003
SIGMA_FLOOR_S: Final = 0.002
USER_SIGMA_S: Final = 1.0 / 60.0
"""Half a picture at 30 per second: nobody reads an offset off two videos more closely."""
USER_TOLERANCE_S: Final = 0.07
SAME_VIEW_SHARE: Final = 0.008
"""Of the body height: keypoints of one clip, cut or coded anew, differ less; two cameras more."""
DRIFT_OVERLAP_S: Final = 30.0
DRIFT_SIGMAS: Final = 4.0
ADVICE: Final = (
    "Clap once in view of both cameras and film with sound, or give the offset with --sync SECONDS."
)


def estimate_offset(
    first: ViewPose,
    second: ViewPose,
    *,
    audio: tuple[AudioTrack | None, AudioTrack | None] | None = None,
) -> SyncEstimate:
    """Find out when the second video started, seen from the first.

    Parameters
    ----------
    first, second
        What an estimator saw in each video, each with its own clock. The cameras may stand
        anywhere around the person, about level or turned by quarter turns.
    audio
        Sound of both videos (see `read_audio`), None where there is none.

    Returns
    -------
    SyncEstimate
        Red, with the best guess or NaN as offset, where it is not sure: clips that do not overlap,
        other movements, nobody who moves, movements that repeat alike, one clip twice.

    Notes
    -----
    Candidates are the lags at which the vertical speeds correlate. At each, the lag is measured
    anew in short parts of the movement: where the videos show the same lift the parts agree
    within some 20 ms, where they show two lifts, however alike, they do not. The confidence is the
    probability of the best candidate against all others and against none, from a logistic
    regression on that scatter, equally many true and false pairs assumed.
    """
    sound = None if audio is None else estimate_audio_lag(*audio)
    motions = _compute_motions(first, second)
    complaint = _find_complaint(first, second, motions)
    if complaint:
        return _by_sound(sound) or _refuse(complaint)
    candidates = _find_candidates(*motions, extra=() if sound is None else (sound.offset_s,))
    if not candidates:
        return _by_sound(sound) or _refuse(
            f"The videos can't be aligned: at no offset do both show the person for "
            f"{MIN_OVERLAP_S:g} s with the same movement. Check that both show the same lift. "
            f"{ADVICE}"
        )
    best, confidence = _weigh(candidates)
    estimate = _from_motion(best, confidence, candidates)
    if _show_same_picture(first, second, best.offset_s):
        return dataclasses.replace(
            estimate, confidence=0.0, level=CheckLevel.RED, sentence=_same_clip_sentence()
        )
    return estimate if sound is None else _join(estimate, candidates, sound)


def check_offset(first: ViewPose, second: ViewPose, offset_s: float) -> SyncEstimate:
    """Take an offset the user gave, and compare it with the movement.

    Parameters
    ----------
    first, second
        What an estimator saw in each video.
    offset_s
        Seconds to add to times of the second video to get those of the first.

    Returns
    -------
    SyncEstimate
        With the user's offset; amber where the pictures contradict it, red where the videos
        do not overlap at it.

    Raises
    ------
    DataError
        If the offset is not a number.
    """
    if not math.isfinite(offset_s):
        raise DataError(f"The offset must be a number of seconds, got {offset_s!r}.")
    given = SyncEstimate(offset_s, USER_SIGMA_S, sentence=f"Offset given: {offset_s:.3f} s.")
    overlap_s = _overlap_s(first, second, offset_s)
    if overlap_s <= 0.0:
        return dataclasses.replace(
            given,
            confidence=0.0,
            level=CheckLevel.RED,
            sentence=f"At the given offset of {offset_s:.3f} s the videos do not overlap: they are "
            f"{-overlap_s:.1f} s apart. Check the sign and the unit (seconds).",
        )
    if _show_same_picture(first, second, offset_s):
        return dataclasses.replace(
            given, confidence=0.0, level=CheckLevel.RED, sentence=_same_clip_sentence()
        )
    motions = _compute_motions(first, second)
    if _find_complaint(first, second, motions):
        return given
    return _compare_with_user(given, _find_candidates(*motions, extra=(offset_s,)))


def require_sure(estimate: SyncEstimate) -> SyncEstimate:
    """Return the estimate if it may be used.

    Raises
    ------
    SyncError
        If it is red; the message says why and what to do.
    """
    if estimate.level is CheckLevel.RED:
        raise SyncError(estimate.sentence)
    return estimate


@dataclass(frozen=True)
class _Candidate:
    """One way the videos may belong together; `evidence` is the log-odds that it is true."""

    comparison: Comparison
    evidence: float

    @property
    def offset_s(self) -> float:
        return self.comparison.offset_s

    @property
    def sigma_s(self) -> float:
        found = self.comparison
        parts = found.timing_rms_s**2 / found.n_parts
        joints = found.joint_rms_s**2 / found.n_joints
        return math.sqrt(parts + joints + SIGMA_FLOOR_S**2)


def _compute_motions(first: ViewPose, second: ViewPose) -> tuple[Motion, Motion]:
    skeletons = [get_skeleton(view.image.skeleton) for view in (first, second)]
    shared = tuple(k for k in KEYPOINTS if all(k in s.keypoints for s in skeletons))
    return compute_motion(first, shared), compute_motion(second, shared)


def _find_complaint(first: ViewPose, second: ViewPose, motions: Sequence[Motion]) -> str:
    """Return why the movement can't tell the offset, empty where it may."""
    if _is_same_file(first, second):
        return _same_clip_sentence()
    for name, view, motion in zip(("first", "second"), (first, second), motions, strict=True):
        if not view.image.is_present.any():
            return f"The {name} video shows nobody, so the videos can't be aligned. Film again."
        length_s = float(view.image.time_s[-1] - view.image.time_s[0])
        if length_s < MIN_OVERLAP_S:
            return (
                f"The {name} video lasts {length_s:.1f} s, too little to align it: at least "
                f"{MIN_OVERLAP_S:g} s of common movement are needed. {ADVICE}"
            )
        if motion.moving_s < MIN_MOVING_S:
            return (
                f"The person hardly moves in the {name} video ({motion.moving_s:.1f} s), so the "
                f"movement can't tell the offset. {ADVICE}"
            )
    return ""


def _is_same_file(first: ViewPose, second: ViewPose) -> bool:
    return bool(first.info.sha256) and first.info.sha256 == second.info.sha256


def _same_clip_sentence() -> str:
    return (
        "Both videos show the person from the same place: it is one clip twice, or the cameras "
        "stood side by side. Choose the video of the other camera, or assess one video alone."
    )


def _find_candidates(
    first: Motion, second: Motion, *, extra: Sequence[float] = ()
) -> list[_Candidate]:
    """Return the ways the movements may belong together, the likeliest first."""
    found: list[_Candidate] = []
    # Peaks come by what they explain: of two that lead to about the same lag the first is kept.
    for lag_s in (*find_lags(first, second), *extra):
        comparison = compare(first, second, lag_s)
        if comparison is None or not comparison.moving_s > 0.0:
            continue
        if any(abs(comparison.offset_s - other.offset_s) < SAME_LAG_S for other in found):
            continue
        comparison = _add_drift(first, second, comparison)
        found.append(_Candidate(comparison, _weigh_evidence(comparison)))
    return sorted(found, key=lambda candidate: -candidate.evidence)


def _add_drift(first: Motion, second: Motion, plain: Comparison) -> Comparison:
    """Return the comparison with clocks of different rates where that is clearly better."""
    if plain.overlap_s < DRIFT_OVERLAP_S:
        return plain
    tilted = compare(first, second, plain.offset_s, with_drift=True)
    if tilted is None or not abs(tilted.drift) > DRIFT_SIGMAS * tilted.drift_sigma:
        return plain
    return tilted


def _weigh_evidence(found: Comparison) -> float:
    """Return the log-odds that both videos show the same movement at this offset."""
    timing = math.log(found.timing_rms_s + SCATTER_FLOOR_S)
    parts = math.log(min(found.n_parts, MAX_PARTS))
    lack = max(0.0, USUAL_CORRELATION - found.correlation)
    short_s = max(0.0, ENOUGH_MOVING_S - found.moving_s)
    return float(np.dot(EVIDENCE, (1.0, timing, parts, lack))) + SHORTNESS * short_s


def _weigh(candidates: Sequence[_Candidate]) -> tuple[_Candidate, float]:
    """Return the best candidate with its probability against the others and against none."""
    odds = np.array([candidate.evidence for candidate in candidates])
    highest = max(float(odds.max()), 0.0)
    total = math.exp(-highest) + float(np.sum(np.exp(odds - highest)))
    return candidates[0], math.exp(candidates[0].evidence - highest) / total


def _level(confidence: float) -> CheckLevel:
    if confidence >= GREEN_CONFIDENCE:
        return CheckLevel.GREEN
    return CheckLevel.AMBER if confidence >= AMBER_CONFIDENCE else CheckLevel.RED


def _from_motion(
    best: _Candidate, confidence: float, candidates: Sequence[_Candidate]
) -> SyncEstimate:
    level = _level(confidence)
    text = f"offset {best.offset_s:.3f} s ± {1.96 * best.sigma_s:.3f} s from the movement"
    rival = candidates[1] if len(candidates) > 1 else None
    if level is CheckLevel.GREEN:
        sentence = f"Videos aligned: {text}."
    elif rival is not None and rival.evidence > max(best.evidence - 2.0, 0.0):
        sentence = (
            f"The movement repeats so alike that offsets of {best.offset_s:.2f} s and "
            f"{rival.offset_s:.2f} s fit about equally well. {ADVICE}"
        )
    elif best.comparison.moving_s < ENOUGH_MOVING_S:
        sentence = (
            f"Not surely aligned: at the best offset ({best.offset_s:.2f} s) both videos show only "
            f"{best.comparison.moving_s:.1f} s of common movement. Start both cameras before the "
            f"lift and stop them after it. {ADVICE}"
        )
    elif level is CheckLevel.AMBER:
        sentence = f"Probably aligned: {text}, but not surely. Check it in the overlay. {ADVICE}"
    else:
        sentence = (
            f"The videos can't be aligned: even at the best offset ({best.offset_s:.2f} s) the "
            "phases of the movement do not come at the same times. Check that both videos show "
            f"the same lift, and enough of it. {ADVICE}"
        )
    return SyncEstimate(
        offset_s=best.offset_s,
        sigma_s=best.sigma_s,
        drift=best.comparison.drift,
        confidence=confidence,
        method="motion",
        level=level,
        sentence=sentence,
    )


def _refuse(sentence: str) -> SyncEstimate:
    return SyncEstimate(
        math.nan, confidence=0.0, method="motion", level=CheckLevel.RED, sentence=sentence
    )


def _by_sound(sound: AudioLag | None) -> SyncEstimate | None:
    """Return an estimate by sound alone, None where it is not sure."""
    if sound is None or sound.confidence < GREEN_CONFIDENCE:
        return None
    return SyncEstimate(
        offset_s=sound.offset_s,
        sigma_s=sound.sigma_s,
        drift=sound.drift,
        confidence=sound.confidence,
        method="audio",
        level=CheckLevel.AMBER,
        sentence=f"Aligned by sound alone: offset {sound.offset_s:.3f} s. The movement tells "
        "nothing; check it in the overlay.",
    )


def _join(
    estimate: SyncEstimate, candidates: Sequence[_Candidate], sound: AudioLag
) -> SyncEstimate:
    """Let movement and sound confirm or contradict each other."""
    if sound.confidence < AMBER_CONFIDENCE:
        return estimate
    near = [c for c in candidates if _agree(c, sound)]
    if near:
        return _confirm(near[0], sound, _weigh([near[0]])[1])
    if estimate.level is CheckLevel.RED:
        return _by_sound(sound) or estimate
    level = CheckLevel.AMBER if sound.confidence < GREEN_CONFIDENCE else CheckLevel.RED
    return dataclasses.replace(
        estimate,
        confidence=estimate.confidence * (1.0 - sound.confidence),
        level=level,
        sentence=f"Movement and sound disagree: the movement says {estimate.offset_s:.3f} s, the "
        f"sound {sound.offset_s:.3f} s. Look which is right in the overlay and give it with "
        "--sync SECONDS.",
    )


def _agree(candidate: _Candidate, sound: AudioLag) -> bool:
    tolerance_s = 3.0 * math.hypot(candidate.sigma_s, sound.sigma_s)
    return candidate.evidence > -2.0 and abs(candidate.offset_s - sound.offset_s) < tolerance_s


def _confirm(candidate: _Candidate, sound: AudioLag, alone: float) -> SyncEstimate:
    share = sound.sigma_s**2 / (candidate.sigma_s**2 + sound.sigma_s**2)
    offset_s = share * candidate.offset_s + (1.0 - share) * sound.offset_s
    sigma_s = candidate.sigma_s * math.sqrt(share)
    confidence = 1.0 - (1.0 - alone) * (1.0 - sound.confidence)
    return SyncEstimate(
        offset_s=offset_s,
        sigma_s=sigma_s,
        drift=candidate.comparison.drift or sound.drift,
        confidence=confidence,
        method="both",
        level=_level(confidence),
        sentence=f"Videos aligned: offset {offset_s:.3f} s ± {1.96 * sigma_s:.3f} s; movement and "
        "sound agree.",
    )


def _compare_with_user(given: SyncEstimate, candidates: Sequence[_Candidate]) -> SyncEstimate:
    if not candidates:
        return given
    best, confidence = _weigh(candidates)
    miss_s = abs(best.offset_s - given.offset_s)
    if confidence < AMBER_CONFIDENCE:
        near = [c for c in candidates if abs(c.offset_s - given.offset_s) < USER_TOLERANCE_S]
        if near and near[0].evidence > -2.0:
            return given
        return dataclasses.replace(
            given,
            confidence=confidence,
            level=CheckLevel.AMBER,
            sentence=f"Offset given: {given.offset_s:.3f} s, but the movements in the two videos "
            "do not agree there, nor anywhere else. Check that both show the same lift.",
        )
    if miss_s > max(USER_TOLERANCE_S, 3.0 * best.sigma_s):
        return dataclasses.replace(
            given,
            confidence=1.0 - confidence,
            level=CheckLevel.AMBER,
            sentence=f"Offset given: {given.offset_s:.3f} s, but the movement says "
            f"{best.offset_s:.3f} s. Look in the overlay which is right.",
        )
    return dataclasses.replace(
        given,
        confidence=confidence,
        sentence=f"Offset given: {given.offset_s:.3f} s; the movement says {best.offset_s:.3f} s.",
    )


def _overlap_s(first: ViewPose, second: ViewPose, offset_s: float) -> float:
    """Return for how long both videos run at an offset; negative: how far they are apart."""
    a, b = first.image.time_s, second.image.time_s + offset_s
    return float(min(a[-1], b[-1]) - max(a[0], b[0]))


def _show_same_picture(first: ViewPose, second: ViewPose, offset_s: float) -> bool:
    """Whether the keypoints are the same in both pictures, up to size and place of the picture."""
    if _is_same_file(first, second):
        return True
    if first.image.skeleton != second.image.skeleton or first.image.n_frames < 2:
        return False
    a = first.image.position
    # The nearest picture of a copy is the same picture; between two copies nothing is blended.
    times = first.image.time_s - offset_s
    nearest = np.searchsorted(second.image.time_s, times - 1e-3)
    nearest = np.clip(nearest, 0, second.image.n_frames - 1)
    step_s = float(np.median(np.diff(first.image.time_s)))
    close = np.abs(second.image.time_s[nearest] - times) < 0.5 * step_s
    b = second.image.position[nearest]
    known = np.isfinite(a).all(axis=2) & np.isfinite(b).all(axis=2) & close[:, None]
    if np.count_nonzero(known) < 100:
        return False
    x, y = a[known] - a[known].mean(axis=0), b[known] - b[known].mean(axis=0)
    scale = float(np.sum(x * y) / max(float(np.sum(y * y)), 1e-12))
    miss = float(np.sqrt(np.median(np.sum((x - scale * y) ** 2, axis=1))))
    return scale > 0.0 and miss < SAME_VIEW_SHARE * measure_height(first)
