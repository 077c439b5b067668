"""RULA: Rapid Upper Limb Assessment, scored in every frame for both sides."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array, Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.posture import SIDE_NAMES, THRESHOLDS, Posture
from engine.ergonomics.posture_bands import IntArray
from engine.ergonomics.posture_scores import Scores, Unknown, assess_frames, fill, take_worse
from engine.ergonomics.posture_words import (
    describe_activity,
    describe_legs,
    describe_load,
    format_signal,
    list_work,
    name_source,
)

__all__ = ["METHOD", "TABLE_A", "TABLE_B", "TABLE_C", "combine_rula"]

# McAtamney & Corlett (1993), Applied Ergonomics 24(2):91-99.

TABLE_A = np.array(
    [
        [1, 2, 2, 2, 2, 3, 3, 3],
        [2, 2, 2, 2, 3, 3, 3, 3],
        [2, 3, 3, 3, 3, 3, 4, 4],
        [2, 3, 3, 3, 3, 4, 4, 4],
        [3, 3, 3, 3, 3, 4, 4, 4],
        [3, 4, 4, 4, 4, 4, 5, 5],
        [3, 3, 4, 4, 4, 4, 5, 5],
        [3, 4, 4, 4, 4, 4, 5, 5],
        [4, 4, 4, 4, 4, 5, 5, 5],
        [4, 4, 4, 4, 4, 5, 5, 5],
        [4, 4, 4, 4, 4, 5, 5, 5],
        [4, 4, 4, 5, 5, 5, 6, 6],
        [5, 5, 5, 5, 5, 6, 6, 7],
        [5, 6, 6, 6, 6, 7, 7, 7],
        [6, 6, 6, 7, 7, 7, 7, 8],
        [7, 7, 7, 7, 7, 8, 8, 9],
        [8, 8, 8, 8, 8, 9, 9, 9],
        [9, 9, 9, 9, 9, 9, 9, 9],
    ],
    dtype=np.int8,
).reshape(6, 3, 4, 2)
"""Table A: upper arm 1-6, lower arm 1-3, wrist 1-4, wrist twist 1-2."""

TABLE_B = np.array(
    [
        [1, 3, 2, 3, 3, 4, 5, 5, 6, 6, 7, 7],
        [2, 3, 2, 3, 4, 5, 5, 5, 6, 7, 7, 7],
        [3, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 7],
        [5, 5, 5, 6, 6, 7, 7, 7, 7, 7, 8, 8],
        [7, 7, 7, 7, 7, 8, 8, 8, 8, 8, 8, 8],
        [8, 8, 8, 8, 8, 8, 8, 9, 9, 9, 9, 9],
    ],
    dtype=np.int8,
).reshape(6, 6, 2)
"""Table B: neck 1-6, trunk 1-6, legs 1-2."""

TABLE_C = np.array(
    [
        [1, 2, 3, 3, 4, 5, 5],
        [2, 2, 3, 4, 4, 5, 5],
        [3, 3, 3, 4, 4, 5, 6],
        [3, 3, 3, 4, 5, 6, 6],
        [4, 4, 4, 5, 6, 7, 7],
        [4, 4, 5, 6, 6, 7, 7],
        [5, 5, 6, 6, 7, 7, 7],
        [5, 5, 6, 7, 7, 7, 7],
    ],
    dtype=np.int8,
)
"""Table C: wrist and arm score 1 to 8 or more, neck, trunk and leg score 1 to 7 or more."""

UPRIGHT = THRESHOLDS.upright_deg
NECK_BANDS = ((-UPRIGHT, 4), (10.0, 1), (20.0, 2), (math.inf, 3))
TRUNK_BANDS = ((-20.0, 3), (-UPRIGHT, 2), (UPRIGHT, 1), (20.0, 2), (60.0, 3), (math.inf, 4))
"""The sheet has no band for a trunk bent backward; it is scored like the same bend forward."""
UPPER_ARM_BANDS = ((-20.0, 2), (20.0, 1), (45.0, 2), (90.0, 3), (math.inf, 4))
LOWER_ARM_BANDS = ((60.0, 2), (100.0, 1), (math.inf, 2))
NECK_MAX, TRUNK_MAX, UPPER_ARM_MAX = 6, 6, 6
WRIST_WORST, WRIST_TWIST_WORST = 4, 2
LIGHT_KG, HEAVY_KG = 2.0, 10.0

LEVELS = (
    RiskLevel("acceptable", 2, "acceptable if not held or repeated for long", "none"),
    RiskLevel("investigate", 4, "further investigation is needed", "change may be needed"),
    RiskLevel("change soon", 6, "investigation and change are needed soon", "change soon"),
    RiskLevel("change now", math.inf, "investigation and change at once", "change immediately"),
)


class Combined(NamedTuple):
    """Scores on the way from the parts to the total."""

    A: NDArray[Any]
    B: NDArray[Any]
    score: NDArray[Any]


def combine_rula(
    *,
    upper_arm: ArrayLike,
    lower_arm: ArrayLike,
    wrist: ArrayLike,
    wrist_twist: ArrayLike,
    neck: ArrayLike,
    trunk: ArrayLike,
    legs: ArrayLike,
    muscle_a: ArrayLike,
    force_a: ArrayLike,
    muscle_b: ArrayLike,
    force_b: ArrayLike,
) -> Combined:
    """Combine the scores of the parts by tables A, B and C.

    All arguments are whole numbers that broadcast together. `A` and `B` of the result include
    muscle use and force.
    """
    a = [np.asarray(part) - 1 for part in (upper_arm, lower_arm, wrist, wrist_twist)]
    b = [np.asarray(part) - 1 for part in (neck, trunk, legs)]
    A = TABLE_A[a[0], a[1], a[2], a[3]] + np.asarray(muscle_a) + force_a
    B = TABLE_B[b[0], b[1], b[2]] + np.asarray(muscle_b) + force_b
    score = TABLE_C[np.minimum(A, 8) - 1, np.minimum(B, 7) - 1]
    return Combined(np.asarray(A), np.asarray(B), np.asarray(score))


def score_force(load_kg: float, *, is_repeated: bool) -> int:
    """Return the force score: below 2 kg, 2 to 10 kg, above 10 kg."""
    if load_kg < LIGHT_KG:
        return 0
    if load_kg > HEAVY_KG:
        return 3
    return 2 if is_repeated else 1


UNSEEN = (
    "Assumed, since the video does not show it: wrists straight and in mid-range of twist, "
    "neck not twisted or bent to the side, shoulders not raised, arms not supported and "
    "not across the midline, no sudden force."
)


class Rula:
    """Rapid Upper Limb Assessment."""

    info = MethodInfo(
        name="rula",
        title="RULA (Rapid Upper Limb Assessment)",
        reference="McAtamney & Corlett (1993), Applied Ergonomics 24(2):91-99, tables A, B and C "
        "[V2]. Where worksheets differ: arm neutral within 20 deg, static from 1 min, more than "
        "10 kg scores 3.",
        verification="V2",
        levels=LEVELS,
        required_angles=("trunk_flexion",),
        description="Posture of arms, neck and trunk, and force, scored from 1 to 7 in every "
        "frame; the worse side counts. Made for work in one place: bent knees do not enter. The "
        "headline is the highest score held for 0.2 s.",
        value_name="RULA score",
        decimals=0,
    )
    frame_levels: tuple[RiskLevel, ...] = LEVELS
    series: tuple[str, ...] = (
        "score",
        "A",
        "B",
        "trunk",
        "neck",
        "legs",
        "upper_arm",
        "lower_arm",
        "side",
    )
    signals: tuple[str, ...] = (
        "trunk_flexion",
        "trunk_lateral_bend",
        "trunk_twist",
        "neck_flexion",
        "ankle_difference",
        "shoulder_flexion_l",
        "shoulder_flexion_r",
        "shoulder_abduction_l",
        "shoulder_abduction_r",
        "elbow_flexion_l",
        "elbow_flexion_r",
    )
    unseen: tuple[str, ...] = (UNSEEN,)
    uses_repetition = True

    def assess(self, exposure: Exposure) -> RiskResult:
        """Score every frame; see `engine.ergonomics.posture_scores.assess_frames`."""
        return assess_frames(self, exposure)

    def score(self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown) -> Scores:
        """Return total and parts, shape (T, N); where one arm is hidden the other decides."""
        body = self._score_body(posture, drawn, unknown)
        arms = {side: self._score_arm(posture, drawn, side) for side in SIDE_NAMES}
        both_hidden = np.all([arm["upper_arm"] == 0 for arm in arms.values()], axis=0)
        muscle = posture.is_static[:, None] | posture.is_repeated
        force = self._score_force(posture, unknown)[:, None]
        is_bad = unknown == "worst"
        best: dict[str, NDArray[Any]] = {}
        for number, arm in enumerate(arms.values(), start=1):
            is_hidden = arm["upper_arm"] == 0
            found = combine_rula(
                upper_arm=fill(arm["upper_arm"], 1, UPPER_ARM_MAX, unknown),
                lower_arm=fill(arm["lower_arm"], 1, 3, unknown),
                wrist=WRIST_WORST if is_bad else 1,
                wrist_twist=WRIST_TWIST_WORST if is_bad else 1,
                neck=body["neck"],
                trunk=np.maximum(body["trunk"], 1),
                legs=body["legs"],
                muscle_a=muscle,
                force_a=force,
                muscle_b=muscle,
                force_b=force,
            )
            usable = (body["trunk"] > 0) & (~is_hidden | both_hidden)
            values = {**found._asdict(), **arm, "side": np.full(is_hidden.shape, number)}
            values["score"] = np.where(usable, found.score, 0)
            best = take_worse(best, values)
        return {**best, **body}

    def _score_body(
        self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown
    ) -> dict[str, NDArray[Any]]:
        trunk = posture.score_bands(drawn["trunk_flexion"], TRUNK_BANDS)
        extra = np.zeros_like(trunk)
        for name, limit in (
            ("trunk_twist", THRESHOLDS.twist_deg),
            ("trunk_lateral_bend", THRESHOLDS.side_bend_deg),
        ):
            size = np.abs(drawn[name])
            extra += posture.exceeds(size, limit) | (np.isnan(size) & (unknown == "worst"))
        neck = fill(posture.score_bands(drawn["neck_flexion"], NECK_BANDS), 1, 4, unknown)
        # Neck twist and side-bend are not seen: two more at worst.
        neck = np.minimum(neck + 2 * (unknown == "worst"), NECK_MAX)
        return {
            "trunk": np.where(trunk > 0, np.minimum(trunk + extra, TRUNK_MAX), 0),
            "neck": neck,
            "legs": self._score_legs(posture, drawn, unknown),
        }

    def _score_legs(
        self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown
    ) -> IntArray:
        height = np.abs(drawn["ankle_difference"])
        uneven = posture.exceeds_m(height, THRESHOLDS.one_leg_m)
        uneven |= posture.is_kneeling[:, None] | posture.is_walking[:, None]
        if unknown == "worst":
            uneven |= np.isnan(height)
        return np.where(posture.is_seated[:, None], 1, 1 + uneven).astype(np.int8)

    def _score_arm(
        self, posture: Posture, drawn: Mapping[str, Array], side: str
    ) -> dict[str, NDArray[Any]]:
        upper = posture.score_bands(drawn[f"shoulder_flexion_{side}"], UPPER_ARM_BANDS)
        away = posture.exceeds(drawn[f"shoulder_abduction_{side}"], THRESHOLDS.abduction_deg)
        return {
            "upper_arm": np.where(upper > 0, np.minimum(upper + away, UPPER_ARM_MAX), 0),
            "lower_arm": posture.score_bands(drawn[f"elbow_flexion_{side}"], LOWER_ARM_BANDS),
        }

    def _score_force(self, posture: Posture, unknown: Unknown) -> IntArray:
        if posture.task.load_kg is None:
            force = 0 if unknown == "neutral" else 3
        else:
            force = score_force(posture.task.load_kg, is_repeated=posture.is_repeated)
        return np.where(posture.has_load, force, 0).astype(np.int8)

    def list_entered(self, posture: Posture) -> Iterator[RiskInput]:
        """Return load, wrist and repetition."""
        yield from (item for item in list_work(posture) if item.name != "coupling")
        yield RiskInput("wrist", "straight, not twisted", "", Provenance.ASSUMED)

    def explain(self, posture: Posture, scores: Scores) -> Iterator[str]:
        """Write the calculation of one frame, a line a step."""
        part = {name: int(np.asarray(values).flat[0]) for name, values in scores.items()}
        side = "l" if part["side"] == 1 else "r"
        shown = {name: format_signal(signal) for name, signal in posture.signals.items()}
        arm = [shown[f"{n}_{side}"] for n in ("shoulder_flexion", "shoulder_abduction")]
        elbow = shown[f"elbow_flexion_{side}"]
        upper, lower = max(part["upper_arm"], 1), max(part["lower_arm"], 1)
        where = SIDE_NAMES[side].capitalize()
        yield (
            f"{where} upper arm {upper}: flexion {arm[0]}, abduction {arm[1]}{name_source(arm[0])}"
        )
        yield f"{where} lower arm {lower}: elbow flexion {elbow}{name_source(elbow)}"
        force = int(self._score_force(posture, "neutral")[0])
        muscle = int(posture.is_static[0] or posture.is_repeated)
        more = f"muscle use {muscle} + force {force} ({describe_load(posture)})"
        yield (
            f"Table A (upper arm {upper}, lower arm {lower}, wrist 1, wrist twist 1 [assumed]) + "
            f"{more} = {part['A']}"
        )
        neck = shown["neck_flexion"]
        yield f"Neck {part['neck']}: flexion {neck}{name_source(neck)}"
        yield (
            f"Trunk {part['trunk']}: flexion {shown['trunk_flexion']}, twist "
            f"{shown['trunk_twist']}, side-bend {shown['trunk_lateral_bend']} [measured]"
        )
        yield f"Legs {part['legs']}: {describe_legs(posture)}"
        yield (
            f"Table B (neck {part['neck']}, trunk {part['trunk']}, legs {part['legs']}) + {more} "
            f"= {part['B']}; muscle use: {describe_activity(posture)}"
        )
        yield f"Table C (A {part['A']}, B {part['B']}): RULA score {part['score']}"


METHOD = Rula()
