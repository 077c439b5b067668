"""REBA: Rapid Entire Body Assessment, scored in every frame for both sides."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array, Coupling, Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.posture import SIDE_NAMES, THRESHOLDS, Posture
from engine.ergonomics.posture_bands import IntArray
from engine.ergonomics.posture_scores import Scores, Unknown, assess_frames, fill, take_worse
from engine.ergonomics.posture_words import (
    describe_activity,
    describe_coupling,
    describe_legs,
    describe_load,
    format_signal,
    list_work,
    name_source,
)

__all__ = ["METHOD", "TABLE_A", "TABLE_B", "TABLE_C", "combine_reba"]

# Hignett & McAtamney (2000), Applied Ergonomics 31(2):201-205.

TABLE_A = np.array(
    [
        [[1, 2, 3, 4], [1, 2, 3, 4], [3, 3, 5, 6]],
        [[2, 3, 4, 5], [3, 4, 5, 6], [4, 5, 6, 7]],
        [[2, 4, 5, 6], [4, 5, 6, 7], [5, 6, 7, 8]],
        [[3, 5, 6, 7], [5, 6, 7, 8], [6, 7, 8, 9]],
        [[4, 6, 7, 8], [6, 7, 8, 9], [7, 8, 9, 9]],
    ],
    dtype=np.int8,
)
"""Table A: trunk 1-5, neck 1-3, legs 1-4."""

TABLE_B = np.array(
    [
        [[1, 2, 2], [1, 2, 3]],
        [[1, 2, 3], [2, 3, 4]],
        [[3, 4, 5], [4, 5, 5]],
        [[4, 5, 5], [5, 6, 7]],
        [[6, 7, 8], [7, 8, 8]],
        [[7, 8, 8], [8, 9, 9]],
    ],
    dtype=np.int8,
)
"""Table B: upper arm 1-6, lower arm 1-2, wrist 1-3."""

TABLE_C = np.array(
    [
        [1, 1, 1, 2, 3, 3, 4, 5, 6, 7, 7, 7],
        [1, 2, 2, 3, 4, 4, 5, 6, 6, 7, 7, 8],
        [2, 3, 3, 3, 4, 5, 6, 7, 7, 8, 8, 8],
        [3, 4, 4, 4, 5, 6, 7, 8, 8, 9, 9, 9],
        [4, 4, 4, 5, 6, 7, 8, 8, 9, 9, 9, 9],
        [6, 6, 6, 7, 8, 8, 9, 9, 10, 10, 10, 10],
        [7, 7, 7, 8, 9, 9, 9, 10, 10, 11, 11, 11],
        [8, 8, 8, 9, 10, 10, 10, 10, 10, 11, 11, 11],
        [9, 9, 9, 10, 10, 10, 11, 11, 11, 12, 12, 12],
        [10, 10, 10, 11, 11, 11, 11, 12, 12, 12, 12, 12],
        [11, 11, 11, 11, 12, 12, 12, 12, 12, 12, 12, 12],
        [12, 12, 12, 12, 12, 12, 12, 12, 12, 12, 12, 12],
    ],
    dtype=np.int8,
)
"""Table C: score A 1-12, score B 1-12."""

UPRIGHT = THRESHOLDS.upright_deg
TRUNK_BANDS = ((-20.0, 3), (-UPRIGHT, 2), (UPRIGHT, 1), (20.0, 2), (60.0, 3), (math.inf, 4))
NECK_BANDS = ((-UPRIGHT, 2), (20.0, 1), (math.inf, 2))
"""Any extension scores 2; it counts from where it can be told from upright."""
KNEE_BANDS = ((30.0, 1), (60.0, 2), (math.inf, 3))
"""One more than what bent knees add: 0 means not seen."""
UPPER_ARM_BANDS = ((-20.0, 2), (20.0, 1), (45.0, 2), (90.0, 3), (math.inf, 4))
LOWER_ARM_BANDS = ((60.0, 2), (100.0, 1), (math.inf, 2))
LOAD_BANDS_KG = ((5.0, 0), (10.0, 1), (math.inf, 2))
"""Below 5 kg, from 5 to 10 kg, above 10 kg."""
COUPLING_SCORES: Mapping[Coupling, int] = {Coupling.GOOD: 0, Coupling.FAIR: 1, Coupling.POOR: 2}

TRUNK_MAX, NECK_MAX, LEGS_MAX, UPPER_ARM_MAX, WRIST_MAX = 5, 3, 4, 6, 3

LEVELS = (
    RiskLevel("negligible", 1, "negligible risk (action level 0)", "none"),
    RiskLevel("low", 3, "low risk (action level 1)", "may be needed"),
    RiskLevel("medium", 7, "medium risk (action level 2)", "necessary"),
    RiskLevel("high", 10, "high risk (action level 3)", "necessary soon"),
    RiskLevel("very high", math.inf, "very high risk (action level 4)", "necessary now"),
)


class Combined(NamedTuple):
    """Scores on the way from the parts to the total."""

    A: NDArray[Any]
    B: NDArray[Any]
    C: NDArray[Any]
    score: NDArray[Any]


def combine_reba(
    *,
    neck: ArrayLike,
    trunk: ArrayLike,
    legs: ArrayLike,
    load: ArrayLike,
    upper_arm: ArrayLike,
    lower_arm: ArrayLike,
    wrist: ArrayLike,
    coupling: ArrayLike,
    activity: ArrayLike,
) -> Combined:
    """Combine the scores of the parts by tables A, B and C.

    All arguments are whole numbers that broadcast together. Score A and B are limited to the 12
    rows and columns of table C.
    """
    index = [np.asarray(part) - 1 for part in (trunk, neck, legs, upper_arm, lower_arm, wrist)]
    A = np.minimum(TABLE_A[index[0], index[1], index[2]] + load, 12)
    B = np.minimum(TABLE_B[index[3], index[4], index[5]] + coupling, 12)
    C = TABLE_C[A - 1, B - 1]
    return Combined(A, B, C, np.asarray(C + activity))


def score_load(load_kg: float) -> int:
    """Return the load score; exactly 5 kg scores 1, exactly 10 kg too."""
    if load_kg < LOAD_BANDS_KG[0][0]:
        return 0
    return 1 if load_kg <= LOAD_BANDS_KG[1][0] else 2


def _twist_or_bend(
    drawn: Mapping[str, Array], posture: Posture, unknown: Unknown
) -> NDArray[np.bool_]:
    """Tell where the trunk is twisted or bent to the side."""
    found = np.zeros(drawn["trunk_twist"].shape, dtype=bool)
    for name, limit in (
        ("trunk_twist", THRESHOLDS.twist_deg),
        ("trunk_lateral_bend", THRESHOLDS.side_bend_deg),
    ):
        size = np.abs(drawn[name])
        found |= posture.exceeds(size, limit)
        if unknown == "worst":
            found |= np.isnan(size)
    return found


UNSEEN = (
    "Assumed, since the video does not show it: wrists straight, neck not twisted or bent to "
    "the side, shoulders not raised, arms not supported, no sudden force."
)


class Reba:
    """Rapid Entire Body Assessment."""

    info = MethodInfo(
        name="reba",
        title="REBA (Rapid Entire Body Assessment)",
        reference="Hignett & McAtamney (2000), Applied Ergonomics 31(2):201-205, tables A, B "
        "and C [V2].",
        verification="V2",
        levels=LEVELS,
        required_angles=("trunk_flexion",),
        description="Posture, load and grip of the whole body scored from 1 to 15 in every frame; "
        "the worse side counts. The headline is the highest score held for 0.2 s.",
        value_name="REBA score",
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
        "load",
        "upper_arm",
        "lower_arm",
        "side",
    )
    signals: tuple[str, ...] = (
        "trunk_flexion",
        "trunk_lateral_bend",
        "trunk_twist",
        "neck_flexion",
        "knee_flexion_l",
        "knee_flexion_r",
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
        is_scored = body["trunk"] > 0
        best: dict[str, NDArray[Any]] = {}
        for number, arm in enumerate(arms.values(), start=1):
            is_hidden = arm["upper_arm"] == 0
            found = combine_reba(
                neck=body["neck"],
                trunk=np.maximum(body["trunk"], 1),
                legs=body["legs"],
                load=body["load"],
                upper_arm=fill(arm["upper_arm"], 1, UPPER_ARM_MAX, unknown),
                lower_arm=fill(arm["lower_arm"], 1, 2, unknown),
                wrist=1 if unknown == "neutral" else WRIST_MAX,
                coupling=self._score_coupling(posture, unknown)[:, None],
                activity=self._score_activity(posture)[:, None],
            )
            usable = is_scored & (~is_hidden | both_hidden)
            values = {**found._asdict(), **arm, "side": np.full(is_hidden.shape, number)}
            values["score"] = np.where(usable, found.score, 0)
            best = take_worse(best, values)
        return {**best, **body}

    def _score_body(
        self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown
    ) -> dict[str, NDArray[Any]]:
        bent = _twist_or_bend(drawn, posture, unknown)
        flexed = posture.score_bands(drawn["trunk_flexion"], TRUNK_BANDS)
        trunk = np.where(flexed > 0, np.minimum(flexed + bent, TRUNK_MAX), 0)
        neck = fill(posture.score_bands(drawn["neck_flexion"], NECK_BANDS), 1, 2, unknown)
        neck = np.minimum(neck + (unknown == "worst"), NECK_MAX)
        load = self._score_load(posture, unknown)[:, None]
        return {
            "trunk": trunk,
            "neck": neck,
            "legs": self._score_legs(posture, drawn, unknown),
            "load": np.broadcast_to(load, trunk.shape),
        }

    def _score_legs(
        self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown
    ) -> IntArray:
        knees = [
            posture.score_bands(drawn[f"knee_flexion_{side}"], KNEE_BANDS) for side in SIDE_NAMES
        ]
        bent = fill(np.maximum(*knees), 1, 3, unknown) - 1
        height = np.abs(drawn["ankle_difference"])
        on_one = posture.exceeds_m(height, THRESHOLDS.one_leg_m)
        on_one &= ~posture.is_walking[:, None]
        legs = np.minimum(1 + on_one + bent, LEGS_MAX)
        return np.where(posture.is_seated[:, None], 1, legs).astype(np.int8)

    def _score_arm(
        self, posture: Posture, drawn: Mapping[str, Array], side: str
    ) -> dict[str, NDArray[Any]]:
        upper = posture.score_bands(drawn[f"shoulder_flexion_{side}"], UPPER_ARM_BANDS)
        away = posture.exceeds(drawn[f"shoulder_abduction_{side}"], THRESHOLDS.abduction_deg)
        upper = np.where(upper > 0, np.minimum(upper + away, UPPER_ARM_MAX), 0)
        return {
            "upper_arm": upper,
            "lower_arm": posture.score_bands(drawn[f"elbow_flexion_{side}"], LOWER_ARM_BANDS),
        }

    def _score_load(self, posture: Posture, unknown: Unknown) -> IntArray:
        if posture.task.load_kg is None:
            load = 0 if unknown == "neutral" else LOAD_BANDS_KG[-1][1]
        else:
            load = score_load(posture.task.load_kg)
        return np.where(posture.has_load, load, 0).astype(np.int8)

    def _score_coupling(self, posture: Posture, unknown: Unknown) -> IntArray:
        coupling = posture.task.coupling
        if coupling is None:
            coupling = Coupling.FAIR if unknown == "neutral" else Coupling.POOR
        return np.where(posture.has_load, COUPLING_SCORES[coupling], 0).astype(np.int8)

    def _score_activity(self, posture: Posture) -> IntArray:
        return posture.is_static.astype(np.int8) + np.int8(posture.is_repeated)

    def list_entered(self, posture: Posture) -> Iterator[RiskInput]:
        """Return load, grip, wrist and repetition."""
        yield from list_work(posture)
        yield RiskInput("wrist", "straight", "", Provenance.ASSUMED)

    def explain(self, posture: Posture, scores: Scores) -> Iterator[str]:
        """Write the calculation of one frame, a line a step."""
        part = {name: int(np.asarray(values).flat[0]) for name, values in scores.items()}
        shown = {name: format_signal(signal) for name, signal in posture.signals.items()}
        side = "l" if part["side"] == 1 else "r"
        yield (
            f"Trunk {part['trunk']}: flexion {shown['trunk_flexion']}, twist "
            f"{shown['trunk_twist']}, side-bend {shown['trunk_lateral_bend']} [measured]"
        )
        neck = shown["neck_flexion"]
        yield f"Neck {part['neck']}: flexion {neck}{name_source(neck)}"
        yield f"Legs {part['legs']}: {describe_legs(posture)}"
        yield (
            f"Table A (trunk {part['trunk']}, neck {part['neck']}, legs {part['legs']}) + load "
            f"{part['load']} ({describe_load(posture)}) = score A {part['A']}"
        )
        yield from self._explain_arms(posture, part, side)
        activity = part["score"] - part["C"]
        yield (
            f"Table C (A {part['A']}, B {part['B']}) = {part['C']}; activity +{activity} "
            f"({describe_activity(posture)})"
        )
        yield f"REBA score {part['score']}"

    def _explain_arms(self, posture: Posture, part: Mapping[str, int], side: str) -> Iterator[str]:
        where = SIDE_NAMES[side].capitalize()
        flexion, abduction, elbow = (
            format_signal(posture.signals[f"{name}_{side}"])
            for name in ("shoulder_flexion", "shoulder_abduction", "elbow_flexion")
        )
        upper, lower = max(part["upper_arm"], 1), max(part["lower_arm"], 1)
        coupling = int(self._score_coupling(posture, "neutral")[0])
        yield (
            f"{where} upper arm {upper}: flexion {flexion}, abduction {abduction}"
            f"{name_source(flexion)}"
        )
        yield f"{where} lower arm {lower}: elbow flexion {elbow}{name_source(elbow)}"
        yield (
            f"Table B (upper arm {upper}, lower arm {lower}, wrist 1 [assumed]) + coupling "
            f"{coupling} ({describe_coupling(posture)}) = score B {part['B']}"
        )


METHOD = Reba()
