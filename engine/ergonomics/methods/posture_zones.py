"""Posture zones: EN 1005-4 for movements, ISO 11226 for postures that are held."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.posture import COUNTED_AFTER_S, THRESHOLDS, Posture, read_posture
from engine.ergonomics.posture_bands import BandRows, BoolArray, IntArray, find_holds
from engine.ergonomics.posture_scores import (
    N_DRAWS,
    Scores,
    Unknown,
    assess_frames,
    fill,
    find_level,
)
from engine.ergonomics.posture_words import format_signal
from engine.ergonomics.propagation import standard_normal_points

__all__ = ["METHOD", "PARTS", "HoldLimit", "Verdicts", "judge_movement"]

ACCEPTABLE, CONDITIONAL, NOT_ACCEPTABLE = 1, 2, 3
NEUTRAL_ZONE, MIDDLE_ZONE, OUTER_ZONE = 1, 2, 3

FREQUENT_PER_MIN = 2.0
STATIC_S = 4.0
STATIC_RANGE_DEG = 5.0


@dataclass(frozen=True)
class Verdicts:
    """EN 1005-4's verdict on one zone: moved into rarely, at least twice a minute, held there."""

    rare: int
    frequent: int
    held: int


@dataclass(frozen=True)
class HoldLimit:
    """ISO 11226: how long a posture may be held without support; linear between two angles."""

    low_deg: float
    high_deg: float
    low_s: float
    high_s: float

    def __call__(self, angle_deg: float) -> float:
        """Return the longest time in s: infinite below the zone, 0 above it."""
        if angle_deg < self.low_deg:
            return math.inf
        if angle_deg > self.high_deg:
            return 0.0
        share = (angle_deg - self.low_deg) / max(self.high_deg - self.low_deg, 1e-9)
        return self.low_s + share * (self.high_s - self.low_s)


OUTER = Verdicts(rare=CONDITIONAL, frequent=NOT_ACCEPTABLE, held=NOT_ACCEPTABLE)
NEVER = Verdicts(rare=ACCEPTABLE, frequent=ACCEPTABLE, held=ACCEPTABLE)


@dataclass(frozen=True)
class Part:
    """One row of the standards.

    `bands` give the zone of an angle; `is_signed` is false for sizes (twist, side-bend). Angles
    below `back_deg` (leaning back) may not be held at all.
    """

    key: str
    title: str
    signals: tuple[str, ...]
    bands: BandRows
    middle: Verdicts
    hold_limit: HoldLimit
    is_signed: bool = True
    back_deg: float = -math.inf


BACK = -THRESHOLDS.upright_deg
"""Leaning back counts from where it can be told from upright."""
_VISIBLE_BANDS = ((10.0, NEUTRAL_ZONE), (math.inf, OUTER_ZONE))
# Above 10 degrees nothing may be held; up to there for any time.
_VISIBLE_HOLD = HoldLimit(math.nextafter(10.0, 11.0), 10.0, 0.0, 0.0)
_ARM_BANDS = ((20.0, NEUTRAL_ZONE), (60.0, MIDDLE_ZONE), (math.inf, OUTER_ZONE))

PARTS: tuple[Part, ...] = (
    Part(
        key="trunk",
        title="trunk flexion",
        signals=("trunk_flexion",),
        bands=(
            (BACK, OUTER_ZONE),
            (20.0, NEUTRAL_ZONE),
            (60.0, MIDDLE_ZONE),
            (math.inf, OUTER_ZONE),
        ),
        middle=Verdicts(CONDITIONAL, CONDITIONAL, CONDITIONAL),
        hold_limit=HoldLimit(20.0, 60.0, 240.0, 60.0),
        back_deg=BACK,
    ),
    Part(
        key="trunk_side",
        title="trunk side-bend or twist",
        signals=("trunk_lateral_bend", "trunk_twist"),
        bands=_VISIBLE_BANDS,
        middle=NEVER,
        hold_limit=_VISIBLE_HOLD,
        is_signed=False,
    ),
    Part(
        key="upper_arm",
        title="upper-arm elevation",
        signals=("arm_elevation_l", "arm_elevation_r"),
        bands=_ARM_BANDS,
        middle=Verdicts(ACCEPTABLE, CONDITIONAL, CONDITIONAL),
        hold_limit=HoldLimit(20.0, 60.0, 180.0, 60.0),
    ),
    Part(
        key="head",
        title="head inclination",
        signals=("head_inclination",),
        bands=((BACK, OUTER_ZONE), (40.0, NEUTRAL_ZONE), (math.inf, OUTER_ZONE)),
        middle=NEVER,
        hold_limit=HoldLimit(25.0, 85.0, 480.0, 60.0),
        back_deg=BACK,
    ),
)
"""EN 1005-4:2005+A1:2008 and ISO 11226:2000. Zones of trunk, side-bend, twist and arm [V2]; head,
leaning back and holding times from a single source [V1]."""

LEVELS = (
    RiskLevel("acceptable", ACCEPTABLE, "within the acceptable zones", "none"),
    RiskLevel(
        "conditional", CONDITIONAL, "acceptable under conditions only", "look at time and support"
    ),
    RiskLevel("not acceptable", math.inf, "outside what the standards allow", "redesign"),
)
ZONES = (
    RiskLevel("neutral zone", NEUTRAL_ZONE, "acceptable", "none"),
    RiskLevel("middle zone", MIDDLE_ZONE, "limited in time or frequency", "look at it"),
    RiskLevel("outer zone", math.inf, "neither to be held nor frequent", "avoid"),
)


def judge_movement(
    middle: Verdicts,
    *,
    zone: NDArray[Any],
    is_held: BoolArray,
    per_min_of_entry: float,
) -> NDArray[np.int64]:
    """Judge one curve by EN 1005-4.

    Parameters
    ----------
    middle
        Verdicts on the middle zone of this part.
    zone
        Shape (T, N): zone of every frame, 0 where not seen.
    is_held
        Shape (T,): whether the posture is held there.
    per_min_of_entry
        How often a minute one entry of the video happens at work.

    Returns
    -------
    NDArray
        Shape (N,): 1 acceptable, 2 conditional, 3 not acceptable.
    """
    verdict = np.full(zone.shape[1], ACCEPTABLE)
    for at_least, verdicts in ((MIDDLE_ZONE, middle), (OUTER_ZONE, OUTER)):
        inside = zone >= at_least
        own = zone == at_least
        entries = inside[0] + (inside[1:] & ~inside[:-1]).sum(axis=0)
        found = np.where(
            entries * per_min_of_entry >= FREQUENT_PER_MIN, verdicts.frequent, verdicts.rare
        )
        found = np.where((own & is_held[:, None]).any(axis=0), verdicts.held, found)
        verdict = np.maximum(verdict, np.where(own.any(axis=0), found, ACCEPTABLE))
    return verdict


def find_rate(exposure: Exposure) -> float:
    """Return how often a minute what is seen once in the video happens at work; NaN if unknown."""
    given, lifts = exposure.task.frequency_per_min, len(exposure.lifts)
    if given is not None and lifts:
        return given / lifts
    if exposure.observed_s >= COUNTED_AFTER_S:
        return 60.0 / exposure.observed_s
    return math.nan


@dataclass(frozen=True)
class _Hold:
    """One posture that is held, and how long it may be."""

    signal: str
    start_s: float
    length_s: float
    angle_deg: float
    limit_s: float

    @property
    def is_too_long(self) -> bool:
        return self.length_s > self.limit_s


UNSEEN = (
    "Assumed, since the video does not show it: no support of trunk, arms or head; head "
    "inclination stands for the line of sight."
)


class PostureZones:
    """EN 1005-4 and ISO 11226."""

    info = MethodInfo(
        name="posture_zones",
        title="Posture zones (EN 1005-4, ISO 11226)",
        reference="EN 1005-4:2005+A1:2008, postures and movements at machinery; ISO 11226:2000, "
        "static working postures. Zones of trunk and arm [V2]; head, leaning back and holding "
        "times: single source [V1].",
        verification="V1",
        levels=LEVELS,
        required_angles=("trunk_flexion",),
        description="Zones of trunk, arm and head in every frame, judged by how often they are "
        "entered (EN 1005-4) and how long they are held (ISO 11226). The headline is the worse of "
        "the two standards over all parts; both are shown. Single-source for holding times.",
        value_name="posture verdict",
        decimals=0,
        # A design standard: it asks for a redesign, not for stopping the work.
        flag_limits=(float(ACCEPTABLE), math.inf),
    )
    frame_levels: tuple[RiskLevel, ...] = ZONES
    series: tuple[str, ...] = ("score", *(part.key for part in PARTS))
    signals: tuple[str, ...] = tuple(name for part in PARTS for name in part.signals)
    unseen: tuple[str, ...] = (UNSEEN,)
    uses_repetition = False

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge the zones of every part by both standards."""
        posture = read_posture(exposure)
        result = assess_frames(self, exposure, posture=posture)
        if posture is None:
            return result
        per_min = find_rate(exposure)
        judged = _judge(posture, 0.0 if math.isnan(per_min) else per_min)
        # One entry of the video at least twice a minute at work.
        frequent = _judge(posture, FREQUENT_PER_MIN, n_draws=1)
        value = judged.value
        doubts = self._find_doubts(result, value, per_min, frequent)
        interval = judged.interval if not math.isnan(result.interval[0]) else result.interval
        return replace(
            result,
            value=float(value),
            category=find_level(LEVELS, value).name,
            interval=interval,
            steps=tuple(_explain(judged, per_min)),
            reasons=(*self.unseen, *doubts),
            details={
                **result.details,
                "parts": judged.verdict,
                "holds": [vars(hold) for hold in judged.holds],
                "rate_per_min": per_min,
                # The parts that decide are in `parts`; those of one frame's zone would mislead.
                "drivers": [],
                "worst_case": frequent.value,
                "doubts": doubts,
                "assumptions": [*self.unseen],
            },
        )

    def _find_doubts(
        self, result: RiskResult, value: int, per_min: float, frequent: _Judged
    ) -> list[str]:
        doubts = [d for d in result.details["doubts"] if "assumed to be in order" not in d]
        worst = frequent.value
        if math.isnan(per_min) and worst > value:
            doubts.append(
                "how often the movement happens is not known: fewer than 2 times a minute assumed; "
                f"from 2 on it would be {find_level(LEVELS, worst).name}"
            )
        return doubts

    def score(self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown) -> Scores:
        """Return the zone of every part, shape (T, N); the total is the outermost."""
        zones: dict[str, NDArray[Any]] = {}
        for part in PARTS:
            each = [_find_zone(part, posture, drawn[name]) for name in part.signals]
            zones[part.key] = np.max(each, axis=0)
        filled = [fill(zone, NEUTRAL_ZONE, OUTER_ZONE, unknown) for zone in zones.values()]
        score = np.where(zones["trunk"] > 0, np.max(filled, axis=0), 0)
        return {"score": score, **zones}

    def list_entered(self, posture: Posture) -> Iterator[RiskInput]:
        """Return how often the work repeats and what supports the body."""
        given = posture.task.frequency_per_min
        if given is not None:
            yield RiskInput("frequency", given, "1/min", Provenance.USER)
        yield RiskInput("support of trunk, arms and head", "none", "", Provenance.ASSUMED)

    def explain(self, posture: Posture, scores: Scores) -> Iterator[str]:
        """Write the zones of one frame, a line a part."""
        for part in PARTS:
            zone = int(np.asarray(scores[part.key]).flat[0])
            shown = ", ".join(format_signal(posture.signals[name]) for name in part.signals)
            where = "not seen" if zone == 0 else find_level(ZONES, zone).name
            yield f"{part.title.capitalize()}: {shown}: {where}"


def _find_zone(part: Part, posture: Posture, value: Array) -> IntArray:
    return posture.score_bands(value if part.is_signed else np.abs(value), part.bands)


@dataclass(frozen=True)
class _Judged:
    """Verdicts per part by both standards, the holds, and the interval of the worst verdict."""

    verdict: list[dict[str, Any]]
    holds: tuple[_Hold, ...]
    interval: tuple[float, float]

    @property
    def value(self) -> int:
        """The worst verdict."""
        return max(int(row["verdict"]) for row in self.verdict)


def _judge(posture: Posture, per_min: float, *, n_draws: int = N_DRAWS) -> _Judged:
    """Judge every part, and every draw of it."""
    normal = standard_normal_points(len(posture.signals), n_draws=N_DRAWS)[:n_draws]
    rows: list[dict[str, Any]] = []
    holds: list[_Hold] = []
    worst = np.full(n_draws, ACCEPTABLE)
    for part in PARTS:
        movement, iso = ACCEPTABLE, ACCEPTABLE
        for name in part.signals:
            own, spread, found = _judge_signal(part, name, posture, per_min, normal)
            own_iso = NOT_ACCEPTABLE if any(h.is_too_long for h in found) else ACCEPTABLE
            holds += found
            movement, iso = max(movement, own), max(iso, own_iso)
            worst = np.maximum(worst, np.maximum(spread, own_iso))
        is_seen = any(posture.signals[name].is_seen.any() for name in part.signals)
        rows.append(
            {
                "part": part.title,
                "en_1005_4": movement if is_seen else None,
                "iso_11226": iso if is_seen else None,
                "verdict": max(movement, iso),
            }
        )
    value = max(row["verdict"] for row in rows)
    low, high = np.percentile(worst, (2.5, 97.5), method="inverted_cdf")
    interval = float(min(low, value)), float(max(high, value))
    return _Judged(rows, tuple(holds), interval)


def _judge_signal(
    part: Part, name: str, posture: Posture, per_min: float, normal: Array
) -> tuple[int, NDArray[np.int64], list[_Hold]]:
    """Return the verdict on one curve, that on every draw of it, and its holds."""
    curve = posture.signals[name].value
    is_held = find_holds(curve, posture.time_s, half_width=STATIC_RANGE_DEG, hold_s=STATIC_S)
    k = list(posture.signals).index(name)
    drawn = posture.signals[name].draw(normal[:, k])
    own, spread = (
        judge_movement(
            part.middle,
            zone=_find_zone(part, who, values),
            is_held=is_held,
            per_min_of_entry=per_min,
        )
        for who, values in ((posture, curve[:, None]), (replace(posture, is_steady=False), drawn))
    )
    return int(own[0]), spread, list(_list_holds(part, name, posture, is_held))


def _list_holds(part: Part, name: str, posture: Posture, is_held: BoolArray) -> Iterator[_Hold]:
    """Yield the postures of one curve that are held outside the neutral zone."""
    curve = posture.signals[name].value
    edges = np.flatnonzero(np.diff(np.concatenate(([False], is_held, [False])).astype(int)))
    for start, stop in edges.reshape(-1, 2):
        angle = float(np.median(curve[start:stop]))
        size = angle if part.is_signed else abs(angle)
        limit_s = 0.0 if angle < part.back_deg else part.hold_limit(size)
        if math.isinf(limit_s):
            continue
        yield _Hold(
            signal=posture.signals[name].title,
            start_s=round(float(posture.time_s[start]), 3),
            length_s=round(float(posture.step_s[start:stop].sum()), 3),
            angle_deg=round(angle, 1),
            limit_s=limit_s,
        )


def _explain(judged: _Judged, per_min: float) -> Iterator[str]:
    """Write both verdicts, a line a part, and every hold."""
    if math.isnan(per_min):
        yield "Movements fewer than 2 times a minute [assumed]: the frequency is not known"
    else:
        yield f"Each movement in the video stands for {per_min:.3g} a minute"
    for row in judged.verdict:
        if row["en_1005_4"] is None:
            yield f"{row['part'].capitalize()}: not seen, not judged"
            continue
        en, iso = (find_level(LEVELS, row[key]).name for key in ("en_1005_4", "iso_11226"))
        yield f"{row['part'].capitalize()}: EN 1005-4 (movement) {en}; ISO 11226 (holding) {iso}"
    yield from _explain_holds(judged.holds)


def _explain_holds(holds: Sequence[_Hold]) -> Iterator[str]:
    if not holds:
        yield f"No posture outside the neutral zones was held for {STATIC_S:g} s"
    for hold in holds:
        limit = f"at most {hold.limit_s:.0f} s" if hold.limit_s else "not to be held"
        yield (
            f"Held: {hold.signal} {hold.angle_deg:.0f} deg for {hold.length_s:.1f} s from "
            f"{hold.start_s:.1f} s; ISO 11226: {limit}"
        )


METHOD = PostureZones()
