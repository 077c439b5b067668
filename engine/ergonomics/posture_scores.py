"""From the scores of every frame to one result: how sure, how long, when worst, and why.

A posture method only says how one frame is scored (`FrameScorer`). Everything that follows is the
same for all of them and stands here: the headline, its interval, time in each level, the worst
moments, what drives the score and what drives the doubt.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array, Lift, Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.posture import (
    MIN_FRAMES_S,
    SIDE_NAMES,
    THRESHOLDS,
    Posture,
    read_posture,
)
from engine.ergonomics.posture_bands import IntArray, held_maximum
from engine.ergonomics.posture_words import describe_posture
from engine.ergonomics.propagation import standard_normal_points

__all__ = [
    "FrameScorer",
    "Scores",
    "Unknown",
    "assess_frames",
    "decode_runs",
    "encode_runs",
    "fill",
    "find_level",
    "find_moments",
    "take_worse",
]

Unknown = Literal["neutral", "worst"]
"""What stands in for a part nobody can see: the neutral posture, or the worst there is."""
Scores = Mapping[str, NDArray[Any]]

N_DRAWS = 96
"""Enough for chances to within some 5 percentage points; every draw scores the whole clip."""
DRAWN_AT_ONCE = 60_000
"""Frames times draws held in memory together."""
N_MOMENTS = 5
MOMENTS_APART_S = 1.0
MIN_SCORED = 0.8
"""A result that rests on a smaller share of the frames is reviewed."""
MIN_DRIVER_SHARE = 0.05

NEUTRAL_GROUPS: Mapping[str, Mapping[str, float]] = {
    "trunk": {
        "trunk_flexion": 0.0,
        "trunk_lateral_bend": 0.0,
        "trunk_twist": 0.0,
        "head_inclination": 0.0,
    },
    "neck": {"neck_flexion": 0.0},
    "legs": {"knee_flexion_l": 0.0, "knee_flexion_r": 0.0, "ankle_difference": 0.0},
    "upper arms": {
        f"{name}_{side}": low
        for side in SIDE_NAMES
        for name, low in (
            ("shoulder_flexion", 0.0),
            ("shoulder_abduction", 0.0),
            ("arm_elevation", 0.0),
            ("elbow_height", -0.3),
        )
    },
    "lower arms": {"elbow_flexion_l": 80.0, "elbow_flexion_r": 80.0},
}
"""Parts of the body, with what their signals are in a neutral posture."""

DOUBTFUL_CONDITIONS: Mapping[str, str] = {
    "camera_moved": "the camera moved, so the posture is less certain than stated",
}


UNKNOWN_REPETITION = "How often the work repeats is not known: less than 4 times a minute assumed."


class FrameScorer(Protocol):
    """How one method scores frames.

    `series` names the scores kept per frame, the total first, under `score`; `signals` those
    that enter; `unseen` says what is assumed because no camera of this kind shows it.
    `frame_levels` are the bands of one frame's score; `uses_repetition` tells whether repeated
    work adds to it.
    """

    info: MethodInfo
    frame_levels: tuple[RiskLevel, ...]
    series: tuple[str, ...]
    signals: tuple[str, ...]
    unseen: tuple[str, ...]
    uses_repetition: bool

    def score(self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown) -> Scores:
        """Return scores of shape (T, N) for drawn signals; 0 where a frame can't be scored."""

    def explain(self, posture: Posture, scores: Scores) -> Iterator[str]:
        """Write the calculation of one frame, a line a step."""

    def list_entered(self, posture: Posture) -> Iterator[RiskInput]:
        """Return what was entered or assumed of the work."""


def fill(part: ArrayLike, neutral: int, worst: int, unknown: Unknown) -> IntArray:
    """Put what is assumed in place of a part that was not seen."""
    scores = np.asarray(part, dtype=np.int8)
    stand_in = np.int8(neutral if unknown == "neutral" else worst)
    return np.where(scores == 0, stand_in, scores)


def encode_runs(values: ArrayLike) -> dict[str, list[int]]:
    """Write a series, shape (T,), as runs of equal values; `np.repeat(value, frames)` undoes it."""
    series = np.asarray(values).astype(int)
    start = np.flatnonzero(np.concatenate(([True], series[1:] != series[:-1])))
    return {
        "value": series[start].tolist(),
        "frames": np.diff(np.append(start, series.size)).tolist(),
    }


def decode_runs(runs: Mapping[str, Sequence[int]]) -> NDArray[np.int64]:
    """Return the series that `encode_runs` wrote, shape (T,)."""
    return np.repeat(np.asarray(runs["value"], dtype=np.int64), runs["frames"])


def assess_frames(
    scorer: FrameScorer, exposure: Exposure, *, posture: Posture | None = None
) -> RiskResult:
    """Score every frame by one method and sum up.

    Parameters
    ----------
    scorer
        The method.
    exposure
        What was measured.
    posture
        The same, if it was read already.

    Returns
    -------
    RiskResult
        `value` is the highest score held for 0.2 s, `interval` its interval of about 95 % from
        the errors of the angles (not from what is assumed: see `details["worst_case"]`).
    """
    posture = posture or read_posture(exposure)
    if posture is None:
        return _refuse(scorer.info, exposure)
    found = _Summary(scorer, posture)
    value = found.value
    return RiskResult(
        method=scorer.info.name,
        value=float(value),
        category=find_level(scorer.frame_levels, value).name,
        inputs=(*_list_inputs(scorer, found.worst), *scorer.list_entered(posture)),
        steps=found.explain_worst(),
        interval=found.interval,
        reference=scorer.info.reference,
        reasons=(*found.assumptions, *found.find_doubts(exposure)),
        details=found.build_details(exposure),
    )


def _refuse(info: MethodInfo, exposure: Exposure) -> RiskResult:
    angles = exposure.angles
    name = "trunk_flexion"
    seen = int(np.isfinite(angles[name]).sum()) if name in angles.names else 0
    return RiskResult(
        method=info.name,
        value=math.nan,
        category="not applicable",
        reference=info.reference,
        is_applicable=False,
        reasons=("the trunk was hardly seen, so that no posture can be scored",),
        steps=(
            (
                f"The trunk was seen in {seen} of {angles.time_s.size} frames; at least "
                f"{MIN_FRAMES_S:g} s are needed"
            ),
        ),
    )


def find_level(levels: Sequence[RiskLevel], score: float) -> RiskLevel:
    """Return the action level of a score."""
    return next(level for level in levels if score <= level.upper)


def _list_inputs(scorer: FrameScorer, moment: Posture) -> Iterator[RiskInput]:
    """Return the signals at one moment."""
    for name in scorer.signals:
        signal = moment.signals[name]
        value = float(signal.value[0])
        is_seen = math.isfinite(value)
        yield RiskInput(
            signal.title,
            value if is_seen else "not seen",
            signal.unit if is_seen else "",
            Provenance.MEASURED if is_seen else Provenance.ASSUMED,
            float(signal.sigma[0]) if is_seen else math.nan,
        )


@dataclass(frozen=True)
class Moment:
    """A stretch of one score: first frame, the one after its last, and a typical one."""

    start: int
    stop: int
    score: int
    frame: int


class _Summary:
    """Everything that is worked out from one scorer and one posture."""

    def __init__(self, scorer: FrameScorer, posture: Posture) -> None:
        self.scorer, self.posture = scorer, posture
        self.scores = scorer.score(posture, posture.values(), "neutral")
        self.score = np.asarray(self.scores["score"])[:, 0].astype(np.int64)
        self.value = int(held_maximum(self.score[:, None], posture.time_s)[0])
        bad = scorer.score(posture, posture.values(), "worst")["score"]
        self.worst_case = int(held_maximum(bad, posture.time_s)[0])
        self.is_error_known = self._know_errors()
        self.drawn = self._draw_scores()
        self.moments = self._find_moments()
        self.worst = replace(posture.at(self.moments[0].frame), is_steady=False)

    # ------------------------------------------------------------------ errors

    def _know_errors(self) -> bool:
        seen = [self.posture.signals[n] for n in self.scorer.signals]
        return all(np.isfinite(s.sigma[s.is_seen]).all() for s in seen)

    def _normal(self) -> Array:
        return standard_normal_points(len(self.posture.signals), n_draws=N_DRAWS)

    def _draw_scores(self) -> IntArray:
        """Return the scores of every draw, shape (T, N)."""
        normal = self._normal()
        at_once = max(1, DRAWN_AT_ONCE // self.posture.n_frames)
        plain = replace(self.posture, is_steady=False)
        parts = [
            self.scorer.score(plain, plain.draw(normal[k : k + at_once]), "neutral")
            for k in range(0, len(normal), at_once)
        ]
        return np.concatenate([np.asarray(p["score"], dtype=np.int8) for p in parts], axis=1)

    @property
    def maxima(self) -> NDArray[np.int64]:
        """The headline of every draw, shape (N,)."""
        return held_maximum(self.drawn, self.posture.time_s)

    @property
    def interval(self) -> tuple[float, float]:
        """About 95 %; it holds the value itself."""
        if not self.is_error_known:
            return math.nan, math.nan
        low, high = np.percentile(self.maxima, (2.5, 97.5), method="inverted_cdf")
        return float(min(low, self.value)), float(max(high, self.value))

    def share_errors(self) -> dict[str, float]:
        """Return each signal's share of the variance of the score at the worst moment."""
        moment, normal = self.worst, self._normal()
        fixed = {name: np.repeat(v, N_DRAWS, axis=1) for name, v in moment.values().items()}
        variance = {}
        for name, drawn in moment.draw(normal).items():
            if name in self.scorer.signals:
                changed = self.scorer.score(moment, {**fixed, name: drawn}, "neutral")["score"]
                variance[moment.signals[name].title] = float(np.var(changed))
        total = sum(variance.values())
        ranked = sorted(variance.items(), key=lambda item: -item[1])
        return {n: round(v / total, 3) for n, v in ranked if total and v / total > 0.005}

    # ------------------------------------------------------------------ what it says

    def _find_moments(self) -> tuple[Moment, ...]:
        # Peaks too short for the headline count as much as it.
        capped = np.minimum(self.score, self.value)
        least = min(self.value, int(self.scorer.frame_levels[0].upper) + 1)
        found = []
        for moment in find_moments(capped, self.posture.time_s, least=least):
            frames = np.arange(moment.start, moment.stop)
            typical = frames[self.score[frames] == moment.score]
            nearest = np.argmin(np.abs(typical - moment.frame)) if typical.size else 0
            frame = int(typical[nearest]) if typical.size else moment.frame
            found.append(replace(moment, frame=frame))
        return tuple(found)

    def explain_worst(self) -> tuple[str, ...]:
        """Write the calculation of the worst moment."""
        moment = self.worst
        scores = self.scorer.score(moment, moment.values(), "neutral")
        at_s = float(moment.time_s[0])
        return (f"Worst moment: {at_s:.2f} s", *self.scorer.explain(moment, scores))

    def find_drivers(self) -> list[dict[str, Any]]:
        """Return by how much the score would fall if one part alone were neutral."""
        moment = self.worst
        values = moment.values()
        now = int(self.scorer.score(moment, values, "neutral")["score"][0, 0])
        found = []
        for part, neutral in NEUTRAL_GROUPS.items():
            changed = {n: np.full((1, 1), v) for n, v in neutral.items() if n in values}
            then = self.scorer.score(moment, {**values, **changed}, "neutral")["score"][0, 0]
            if int(then) < now:
                found.append((int(then), part))
        return [
            {"part": part, "score_without": then, "falls_by": now - then}
            for then, part in sorted(found)
        ]

    @property
    def assumptions(self) -> tuple[str, ...]:
        """What is assumed in every frame, and where parts were hidden."""
        hidden = []
        for name in self.scorer.signals:
            signal = self.posture.signals[name]
            share = 1.0 - float(signal.is_seen.mean())
            if share > 0.02:
                hidden.append(f"{signal.title} {100 * share:.0f} %")
        gaps = () if not hidden else (f"Not seen, by share of the frames: {', '.join(hidden)}.",)
        rate = self.posture.repeated_per_min
        is_open = self.scorer.uses_repetition and math.isnan(rate)
        repetition = (UNKNOWN_REPETITION,) if is_open else ()
        return (*self.posture.notes, *repetition, *self.scorer.unseen, *gaps)

    @property
    def scored_share(self) -> float:
        """Share of the time in which a score could be given."""
        steps = self.posture.step_s
        return float(steps[self.score > 0].sum() / steps.sum())

    def find_doubts(self, exposure: Exposure) -> list[str]:
        """List what keeps the result from being taken as it is."""
        doubts = [DOUBTFUL_CONDITIONS[c] for c in exposure.conditions if c in DOUBTFUL_CONDITIONS]
        if self.scored_share < MIN_SCORED:
            doubts.append(f"only {100 * self.scored_share:.0f} % of the time could be scored")
        if not self.is_error_known:
            doubts.append("the measuring error is not known, so that no interval can be given")
        levels = self.scorer.frame_levels
        if find_level(levels, self.worst_case) != find_level(levels, self.value):
            doubts.append(
                "what the video does not show is assumed to be in order; at its worst the score "
                f"would be {self.worst_case}"
            )
        return doubts

    def build_details(self, exposure: Exposure) -> dict[str, Any]:
        """Return every number of the result as plain values."""
        time_s, steps = self.posture.time_s, self.posture.step_s
        scored = np.sort(self.score[self.score > 0])
        weights = np.where(self.score > 0, steps, 0.0)
        series = {
            name: encode_runs(np.asarray(self.scores[name])[:, 0]) for name in self.scorer.series
        }
        return {
            "start_s": round(float(time_s[0]), 4),
            "time_step_s": round(float(np.median(np.diff(time_s))), 5),
            "n_frames": self.posture.n_frames,
            "series": {**series, **self._encode_band()},
            "levels": self._list_levels(),
            "maximum": int(scored[-1]),
            "p95": int(np.percentile(scored, 95, method="inverted_cdf")),
            "mean": round(float(np.average(self.score, weights=weights)), 3),
            "scored_share": round(self.scored_share, 4),
            "worst_case": self.worst_case,
            "worst_moments": [self._describe_moment(m) for m in self.moments],
            "lifts": [self._score_lift(k, lift) for k, lift in enumerate(exposure.lifts)],
            "drivers": self.find_drivers(),
            "uncertainty_shares": self.share_errors(),
            "assumptions": list(self.assumptions),
            "doubts": self.find_doubts(exposure),
            "thresholds": asdict(THRESHOLDS),
        }

    def _encode_band(self) -> dict[str, Any]:
        """Return the interval of every frame."""
        if not self.is_error_known:
            return {}
        low, high = np.percentile(self.drawn, (2.5, 97.5), axis=1, method="inverted_cdf")
        # A frame that is scored holds its own score.
        low, high = np.minimum(low, self.score), np.maximum(high, self.score)
        return {"low": encode_runs(low), "high": encode_runs(high)}

    def _list_levels(self) -> list[dict[str, Any]]:
        """Return time, share with interval, and probability of every action level."""
        steps = self.posture.step_s
        maxima, drawn = self.maxima, self.drawn
        rows, below = [], 0.0
        scored_s = np.maximum((steps[:, None] * (drawn > 0)).sum(axis=0), 1e-12)
        for level in self.scorer.frame_levels:
            inside = (self.score > below) & (self.score <= level.upper)
            drawn_inside = (drawn > below) & (drawn <= level.upper)
            shares = (steps[:, None] * drawn_inside).sum(axis=0) / scored_s
            low, high = np.percentile(shares, (2.5, 97.5))
            time_s = float(steps[inside].sum())
            share = time_s / float(steps[self.score > 0].sum())
            known = self.is_error_known
            rows.append(
                {
                    "name": level.name,
                    "upper": level.upper,
                    "time_s": round(time_s, 3),
                    "share": round(share, 4),
                    "share_low": round(min(float(low), share), 4) if known else math.nan,
                    "share_high": round(max(float(high), share), 4) if known else math.nan,
                    "probability": round(
                        float(np.mean((maxima > below) & (maxima <= level.upper))), 3
                    )
                    if known
                    else math.nan,
                }
            )
            below = level.upper
        return rows

    def _describe_moment(self, moment: Moment) -> dict[str, Any]:
        time_s, steps = self.posture.time_s, self.posture.step_s
        stop = moment.stop - 1
        return {
            "start_s": round(float(time_s[moment.start]), 3),
            "end_s": round(float(time_s[stop] + steps[stop]), 3),
            "peak_s": round(float(time_s[moment.frame]), 3),
            "score": moment.score,
            "level": find_level(self.scorer.frame_levels, moment.score).name,
            "parts": {
                name: int(np.asarray(self.scores[name])[moment.frame, 0])
                for name in self.scorer.series
            },
            "posture": describe_posture(self.posture.at(moment.frame)),
        }

    def _score_lift(self, index: int, lift: Lift) -> dict[str, Any]:
        """Return the score where a lift starts, where the trunk bends most, and where it ends."""
        time_s = self.posture.time_s
        begin, end = (
            plain if math.isnan(wide) else wide
            for wide, plain in ((lift.reach_start_s, lift.start_s), (lift.return_end_s, lift.end_s))
        )
        bend = np.where(
            (time_s >= begin) & (time_s <= end),
            self.posture.signals["trunk_flexion"].value,
            np.nan,
        )
        frames = {name: _nearest(time_s, at) for name, at in
                  (("start", lift.start_s), ("end", lift.end_s))}  # fmt: skip
        if np.isfinite(bend).any():
            frames["peak_flexion"] = int(np.nanargmax(bend))
        return {
            "lift_index": index,
            **{name: int(self.score[frame]) or math.nan for name, frame in frames.items()},
        }


def _nearest(time_s: Array, at_s: float) -> int:
    return int(np.argmin(np.abs(time_s - at_s)))


def find_moments(
    score: NDArray[np.int64], time_s: Array, *, least: int, n_moments: int = N_MOMENTS
) -> Iterator[Moment]:
    """Yield the worst moments, the worst first, at least a second apart.

    Parameters
    ----------
    score
        Shape (T,), 0 where nothing was scored.
    time_s
        Shape (T,).
    least
        Lower scores are not worth looking at.
    n_moments
        At most so many.
    """
    edges = np.flatnonzero(np.concatenate(([True], score[1:] != score[:-1], [True])))
    runs = [Moment(int(a), int(b), int(score[a]), int(a + b - 1) // 2) for a, b in pairwise(edges)]
    # Of two equal scores the longer one is worse.
    runs.sort(key=lambda run: (-run.score, -(run.stop - run.start), run.start))
    taken: list[Moment] = []
    for run in runs:
        if run.score < max(least, 1) or len(taken) == n_moments:
            return
        near = (
            time_s[run.start] - MOMENTS_APART_S < time_s[other.stop - 1]
            and time_s[other.start] < time_s[run.stop - 1] + MOMENTS_APART_S
            for other in taken
        )
        if not any(near):
            taken.append(run)
            yield run


def take_worse(
    best: dict[str, NDArray[Any]], values: dict[str, NDArray[Any]]
) -> dict[str, NDArray[Any]]:
    """Take, frame by frame, the values of the side with the higher score."""
    if not best:
        return values
    is_worse = values["score"] > best["score"]
    return {name: np.where(is_worse, values[name], kept) for name, kept in best.items()}
