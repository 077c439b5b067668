"""OWAS: the table, its anchors, bounds of every digit, shares of time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from engine.ergonomics.methods.owas import (
    CODES,
    METHOD,
    TABLE,
    TIME_SHARE_TABLE,
    look_up_action,
    look_up_share,
    score_load,
)
from engine.ergonomics.posture import read_posture
from tests.engine.ergonomics.exposures import build_lift
from tests.engine.ergonomics.postures import build_posture

NAN = math.nan


def code_of(exposure, unknown="neutral"):
    posture = read_posture(exposure)
    scores = METHOD.score(posture, posture.values(), unknown)
    return {name: int(np.asarray(values)[0, 0]) for name, values in scores.items()}


class TestTables:
    def test_counts(self):
        assert TABLE.size == 252
        assert [int((k == TABLE).sum()) for k in (1, 2, 3, 4)] == [72, 53, 55, 72]

    @pytest.mark.parametrize(
        ("code", "category"),
        [("1121", 1), ("1111", 1), ("2141", 3), ("2343", 4), ("4341", 4), ("4343", 4), ("3233", 2),
         ("3151", 4), ("1343", 3), ("2373", 4), ("3261", 3), ("2253", 4), ("3373", 1),
         ("4132", 2)],
    )  # fmt: skip
    def test_anchors(self, code, category):
        assert look_up_action(*map(int, code)) == category

    def test_a_heavier_load_is_never_better(self):
        assert (np.diff(TABLE.astype(int), axis=3) >= 0).all()

    def test_share_table_is_whole(self):
        assert all(len(row) == 10 for row in TIME_SHARE_TABLE.values())
        assert set(TIME_SHARE_TABLE) == {
            (part, code + 1)
            for part in ("back", "arms", "legs")
            for code in range(len(CODES[part]))
        }

    @pytest.mark.parametrize(
        ("part", "code", "share", "category"),
        [("back", 2, 0.3, 1), ("back", 2, 0.301, 2), ("back", 4, 0.1, 1), ("back", 4, 0.101, 2),
         ("arms", 3, 0.8, 3), ("arms", 3, 0.7, 2), ("legs", 1, 1.0, 2), ("legs", 4, 0.0, 1),
         ("legs", 7, 0.8, 1), ("legs", 7, 0.81, 2)],
    )  # fmt: skip
    def test_shares(self, part, code, share, category):
        assert look_up_share(part, code, share) == category


class TestDigits:
    @pytest.mark.parametrize(
        ("flexion", "code"), [(20.0, 1), (20.1, 2), (-20.0, 1), (-20.1, 2), (0.0, 1)]
    )
    def test_back_bent(self, flexion, code):
        assert code_of(build_posture(trunk_flexion=flexion))["back"] == code

    @pytest.mark.parametrize("name", ["trunk_twist", "trunk_lateral_bend"])
    def test_back_turned(self, name):
        assert code_of(build_posture(**{name: 20.0}))["back"] == 1
        assert code_of(build_posture(**{name: -20.1}))["back"] == 3
        assert code_of(build_posture(**{name: 20.1}, trunk_flexion=30.0))["back"] == 4

    @pytest.mark.parametrize(
        ("points", "code"),
        [({}, 1), ({"left_elbow": (0.3, 1.44, 0.2)}, 2), ({"left_elbow": (0.3, 1.43, 0.2)}, 1),
         ({"elbow": (0.3, 1.5, 0.2)}, 3)],
    )  # fmt: skip
    def test_arms(self, points, code):
        assert code_of(build_posture(points=points))["arms"] == code

    @pytest.mark.parametrize(
        ("changes", "code"),
        [
            ({}, 2),
            ({"knees": 30.0}, 2),
            ({"knees": 30.1}, 4),
            ({"knee_flexion_l": 45.0}, 5),
            ({"points": {"left_ankle": (0, 0.3, 0.1)}, "knee_flexion_l": 60.0}, 3),
            ({"points": {"left_ankle": (0, 0.3, 0.1)}, "knees": 60.0}, 5),
            ({"points": {"right_ankle": (0, 0.3, 0.1)}, "knee_flexion_r": 60.0}, 3),
            ({"points": {"left_knee": (0.3, 0.1, 0.1)}, "knee_flexion_l": 71.0}, 6),
            ({"points": {"left_knee": (0.3, 0.16, 0.1)}, "knee_flexion_l": 71.0}, 5),
            ({"travel_m_s": 0.4}, 7),
            ({"travel_m_s": 0.3}, 2),
            ({"conditions": ("seated",)}, 1),
        ],
    )
    def test_legs(self, changes, code):
        assert code_of(build_posture(**changes))["legs"] == code

    def test_sitting_is_seen(self):
        seated = {"hip": (0.0, 0.5, 0.1), "knee": (0.42, 0.5, 0.1), "ankle": (0.42, 0.09, 0.1)}
        assert code_of(build_posture(points=seated, knees=90.0))["legs"] == 1
        squat = {"hip": (0.0, 0.5, 0.1), "knee": (0.4, 0.5, 0.1), "ankle": (0.1, 0.09, 0.1)}
        assert code_of(build_posture(points=squat, knees=110.0))["legs"] == 4

    @pytest.mark.parametrize(
        ("load", "code"), [(0.0, 1), (10.0, 1), (10.1, 2), (20.0, 2), (20.1, 3)]
    )
    def test_load(self, load, code):
        assert score_load(load) == code

    def test_hidden_knees_are_straight_in_the_score_and_bent_in_the_bound(self):
        exposure = build_posture(knees=NAN, trunk_flexion=30.0)
        assert (code_of(exposure)["legs"], code_of(exposure, "worst")["legs"]) == (2, 5)
        assert code_of(exposure, "worst")["score"] > code_of(exposure)["score"]


def test_no_trunk_is_not_scored():
    assert not METHOD.assess(build_posture(trunk_flexion=NAN)).is_applicable


def test_shares_per_part_are_told_with_their_category():
    bend = np.where(np.arange(100) < 40, 30.0, 0.0)
    details = METHOD.assess(build_posture(n_frames=100, trunk_flexion=bend)).details
    rows = {(row["part"], row["code"]): row for row in details["body_parts"]}
    assert rows["back", 2]["share"] == pytest.approx(0.4)
    assert rows["back", 2]["category"] == 2
    assert rows["legs", 2]["share"] == 1.0


def test_the_steps_give_the_code():
    lift = build_lift(start_s=0.0)
    result = METHOD.assess(build_posture(lift, trunk_flexion=30.0, knees=50.0, load_kg=15.0))
    assert result.steps[-1] == "Code 2142: action category 3"
    assert result.value == 3
