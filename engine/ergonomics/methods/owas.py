"""OWAS: Ovako Working Posture Analysing System, coded in every frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.posture import SIDE_NAMES, THRESHOLDS, Posture
from engine.ergonomics.posture_bands import IntArray
from engine.ergonomics.posture_scores import (
    Scores,
    Unknown,
    assess_frames,
    decode_runs,
    fill,
)
from engine.ergonomics.posture_words import (
    describe_legs,
    describe_load,
    format_signal,
    list_work,
    name_source,
)

__all__ = ["METHOD", "TABLE", "TIME_SHARE_TABLE", "look_up_action", "look_up_share"]

_ROWS = """
111 111 111 222 222 111 111
111 111 111 222 222 111 111
111 111 111 223 223 111 112
223 223 223 333 333 222 233
223 223 233 344 344 334 234
334 223 333 344 444 444 234
111 111 112 333 444 111 111
223 111 112 444 444 333 111
223 111 233 444 444 444 111
233 223 223 444 444 444 234
334 234 334 444 444 444 234
444 234 334 444 444 444 234
"""
TABLE = np.array([int(c) for c in _ROWS if c.isdigit()], dtype=np.int8).reshape(4, 3, 7, 3)
"""Action category by back 1-4, arms 1-3, legs 1-7, load 1-3; Karhu, Kansi & Kuorinka (1977) with
the manual of Louhevaara & Suurnäkki (1992)."""

TIME_SHARE_TABLE: Mapping[tuple[str, int], str] = {
    ("back", 1): "1111111111",
    ("back", 2): "1112222233",
    ("back", 3): "1122233333",
    ("back", 4): "1223333444",
    ("arms", 1): "1111111111",
    ("arms", 2): "1112222233",
    ("arms", 3): "1122222333",
    ("legs", 1): "1111111112",
    ("legs", 2): "1111111122",
    ("legs", 3): "1112222233",
    ("legs", 4): "1223333444",
    ("legs", 5): "1223333444",
    ("legs", 6): "1122233333",
    ("legs", 7): "1111111122",
}
"""Action category of one posture by its share of the time: up to 10, 20, ... 100 %. From a single
source [V1]."""

CODES: Mapping[str, tuple[str, ...]] = {
    "back": ("straight", "bent", "twisted or bent to the side", "bent and twisted"),
    "arms": ("both below the shoulder", "one at or above the shoulder", "both at or above it"),
    "legs": (
        "sitting",
        "standing on two straight legs",
        "standing on one straight leg",
        "both knees bent",
        "on one bent knee",
        "kneeling",
        "walking",
    ),
    "load": ("up to 10 kg", "above 10 to 20 kg", "above 20 kg"),
}

BACK_DEG = 20.0
KNEE_DEG = 30.0
LOAD_BOUNDS_KG = (10.0, 20.0)
LEGS_WORST = 5

LEVELS = (
    RiskLevel("normal", 1, "normal posture (action category 1)", "none"),
    RiskLevel("slightly harmful", 2, "action category 2", "change in the near future"),
    RiskLevel("distinctly harmful", 3, "action category 3", "change as soon as possible"),
    RiskLevel("extremely harmful", math.inf, "action category 4", "change immediately"),
)


def look_up_action(back: int, arms: int, legs: int, load: int) -> int:
    """Return the action category of one posture code."""
    return int(TABLE[back - 1, arms - 1, legs - 1, load - 1])


def look_up_share(part: str, code: int, share: float) -> int:
    """Return the action category of a posture that takes a share of the time, 0 to 1."""
    # Shares come from sums of frame lengths: rounding must not lift 10 % into the next column.
    column = max(0, math.ceil(10 * share - 1e-9) - 1)
    return int(TIME_SHARE_TABLE[part, code][column])


def score_load(load_kg: float) -> int:
    """Return the code of the load: up to 10 kg, above 10 to 20 kg, above 20 kg."""
    return 1 + sum(load_kg > bound for bound in LOAD_BOUNDS_KG)


UNSEEN = (
    "One bent knee counts as standing on it, the conservative reading where the video does "
    "not show which leg carries."
)


class Owas:
    """Ovako Working Posture Analysing System."""

    info = MethodInfo(
        name="owas",
        title="OWAS (Ovako Working Posture Analysing System)",
        reference="Karhu, Kansi & Kuorinka (1977), Applied Ergonomics 8(4):199-201; manual of "
        "Louhevaara & Suurnäkki (1992) [V2]. Categories by share of time: single source [V1].",
        verification="V2",
        levels=LEVELS,
        required_angles=("trunk_flexion",),
        description="Back, arms, legs and load coded in every frame; the action category from 1 "
        "to 4 follows from the code. The headline is the highest category held for 0.2 s; "
        "categories by share of time per body part come with it.",
        value_name="OWAS action category",
        decimals=0,
    )
    frame_levels: tuple[RiskLevel, ...] = LEVELS
    series: tuple[str, ...] = ("score", "back", "arms", "legs", "load")
    signals: tuple[str, ...] = (
        "trunk_flexion",
        "trunk_lateral_bend",
        "trunk_twist",
        "knee_flexion_l",
        "knee_flexion_r",
        "ankle_difference",
        "elbow_height_l",
        "elbow_height_r",
    )
    unseen: tuple[str, ...] = (UNSEEN,)
    uses_repetition = False

    def assess(self, exposure: Exposure) -> RiskResult:
        """Code every frame; see `engine.ergonomics.posture_scores.assess_frames`."""
        result = assess_frames(self, exposure)
        if not result.is_applicable:
            return result
        return replace(result, details={**result.details, "body_parts": _share_parts(result)})

    def score(self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown) -> Scores:
        """Return action category and codes, shape (T, N)."""
        back = self._code_back(posture, drawn, unknown)
        arms = self._code_arms(posture, drawn, unknown)
        legs = self._code_legs(posture, drawn, unknown)
        load = np.broadcast_to(self._code_load(posture, unknown)[:, None], back.shape)
        action = TABLE[np.maximum(back, 1) - 1, arms - 1, legs - 1, load - 1]
        score = np.where(back > 0, action, 0)
        return {"score": score, "back": back, "arms": arms, "legs": legs, "load": load}

    def _code_back(
        self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown
    ) -> IntArray:
        flexion = drawn["trunk_flexion"]
        bent = posture.exceeds(np.abs(flexion), BACK_DEG)
        turned = np.zeros(flexion.shape, dtype=bool)
        for name in ("trunk_twist", "trunk_lateral_bend"):
            size = np.abs(drawn[name])
            turned |= posture.exceeds(size, BACK_DEG) | (np.isnan(size) & (unknown == "worst"))
        code = 1 + bent + 2 * turned
        return np.where(np.isnan(flexion), 0, code).astype(np.int8)

    def _code_arms(
        self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown
    ) -> IntArray:
        code = np.ones(drawn["trunk_flexion"].shape, dtype=np.int8)
        for side in SIDE_NAMES:
            height = drawn[f"elbow_height_{side}"]
            # At the level of the shoulder counts as above it.
            code += posture.exceeds_m(height, -1e-9)
            code += np.isnan(height) & (unknown == "worst")
        return code

    def _code_legs(
        self, posture: Posture, drawn: Mapping[str, Array], unknown: Unknown
    ) -> IntArray:
        knees = [drawn[f"knee_flexion_{side}"] for side in SIDE_NAMES]
        left, right = (posture.exceeds(knee, KNEE_DEG) for knee in knees)
        height = drawn["ankle_difference"]
        lifted = THRESHOLDS.one_leg_m
        on_right = posture.exceeds_m(height, lifted)
        on_left = posture.exceeds_m(-height, lifted)
        code = np.select(
            [on_right, on_left, left & right, left | right],
            [np.where(right, 5, 3), np.where(left, 5, 3), 4, 5],
            2,
        )
        code = np.where(np.isnan(knees).all(axis=0), 0, code)
        code = fill(code, 2, LEGS_WORST, unknown)
        states = (posture.is_seated, posture.is_kneeling, posture.is_walking)
        conditions = [np.broadcast_to(s[:, None], code.shape) for s in states]
        return np.select(conditions, [1, 6, 7], code).astype(np.int8)

    def _code_load(self, posture: Posture, unknown: Unknown) -> IntArray:
        if posture.task.load_kg is None:
            load = 1 if unknown == "neutral" else 3
        else:
            load = score_load(posture.task.load_kg)
        return np.where(posture.has_load, load, 1).astype(np.int8)

    def list_entered(self, posture: Posture) -> Iterator[RiskInput]:
        """Return the load."""
        yield from (item for item in list_work(posture) if item.name == "load")

    def explain(self, posture: Posture, scores: Scores) -> Iterator[str]:
        """Write the coding of one frame, a line a digit."""
        code = {name: int(np.asarray(values).flat[0]) for name, values in scores.items()}
        words = {part: names[code[part] - 1] for part, names in CODES.items()}
        shown = {name: format_signal(signal) for name, signal in posture.signals.items()}
        yield (
            f"Back {code['back']}, {words['back']}: flexion {shown['trunk_flexion']}, twist "
            f"{shown['trunk_twist']}, side-bend {shown['trunk_lateral_bend']} [measured]"
        )
        left, right = (shown[f"elbow_height_{side}"] for side in SIDE_NAMES)
        source = name_source(left if right == "not seen" else right)
        yield (
            f"Arms {code['arms']}, {words['arms']}: elbows {left} (left) and {right} (right) "
            f"above the shoulder{source}"
        )
        yield f"Legs {code['legs']}, {words['legs']}: {describe_legs(posture)}"
        yield f"Load {code['load']}, {words['load']}: {describe_load(posture)}"
        digits = "".join(str(code[part]) for part in CODES)
        yield f"Code {digits}: action category {code['score']}"


def _share_parts(result: RiskResult) -> list[dict[str, Any]]:
    """Return the share of time of every posture of back, arms and legs, and its category."""
    runs = result.details["series"]
    is_scored = decode_runs(runs["score"]) > 0
    rows = []
    for (part, code), _ in TIME_SHARE_TABLE.items():
        series: NDArray[np.int64] = decode_runs(runs[part])[is_scored]
        share = float(np.mean(series == code))
        if share > 0:
            rows.append(
                {
                    "part": part,
                    "code": code,
                    "posture": CODES[part][code - 1],
                    "share": round(share, 4),
                    "category": look_up_share(part, code, share),
                }
            )
    return rows


METHOD = Owas()
