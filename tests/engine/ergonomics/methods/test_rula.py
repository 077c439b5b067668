"""RULA: tables, vectors, bounds of every part, missing parts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from engine.ergonomics.methods.rula import (
    LEVELS,
    METHOD,
    TABLE_A,
    TABLE_B,
    TABLE_C,
    combine_rula,
    score_force,
)
from engine.ergonomics.posture import read_posture
from engine.ergonomics.posture_scores import find_level
from tests.engine.ergonomics.exposures import build_lift
from tests.engine.ergonomics.postures import build_posture

NAN = math.nan
NAMES = ("upper_arm", "lower_arm", "wrist", "wrist_twist", "muscle_a", "force_a",
         "neck", "trunk", "legs", "muscle_b", "force_b")  # fmt: skip


def parts_of(exposure, unknown="neutral"):
    posture = read_posture(exposure)
    scores = METHOD.score(posture, posture.values(), unknown)
    return {name: int(np.asarray(values)[0, 0]) for name, values in scores.items()}


class TestTables:
    def test_checksums(self):
        assert (TABLE_A.sum(), TABLE_B.sum(), TABLE_C.sum()) == (705, 438, 269)
        assert (TABLE_A.shape, TABLE_B.shape, TABLE_C.shape) == ((6, 3, 4, 2), (6, 6, 2), (8, 7))

    def test_case_study(self):
        assert [TABLE_B[neck, 4, 0] for neck in range(3)] == [6, 6, 6]

    @pytest.mark.parametrize(
        ("values", "expected"),
        [
            ((1, 1, 1, 1, 0, 0, 1, 1, 1, 0, 0), (1, 1, 1)),
            ((2, 1, 2, 1, 0, 1, 2, 2, 1, 0, 1), (4, 3, 3)),
            ((3, 2, 3, 1, 1, 0, 3, 3, 1, 1, 0), (5, 5, 6)),
            ((4, 2, 3, 2, 1, 2, 2, 4, 2, 1, 2), (8, 8, 7)),
            ((3, 1, 2, 1, 0, 3, 1, 4, 1, 0, 3), (7, 8, 7)),
            ((6, 3, 4, 2, 1, 3, 6, 6, 2, 1, 3), (13, 13, 7)),
        ],
        ids=["U1", "U2", "U3", "U4", "U5", "U6"],
    )
    def test_vectors(self, values, expected):
        found = combine_rula(**dict(zip(NAMES, values, strict=True)))
        assert tuple(int(x) for x in found) == expected

    @pytest.mark.parametrize(
        ("score", "name"),
        [(1, "acceptable"), (2, "acceptable"), (3, "investigate"), (4, "investigate"),
         (5, "change soon"), (6, "change soon"), (7, "change now")],
    )  # fmt: skip
    def test_action_levels(self, score, name):
        assert find_level(LEVELS, score).name == name


class TestParts:
    @pytest.mark.parametrize(
        ("flexion", "score"),
        [(-5.1, 4), (-5.0, 1), (10.0, 1), (10.1, 2), (20.0, 2), (20.1, 3)],
    )
    def test_neck(self, flexion, score):
        assert parts_of(build_posture(neck=flexion))["neck"] == score

    @pytest.mark.parametrize(
        ("flexion", "score"),
        [(-5.1, 2), (-5.0, 1), (5.0, 1), (5.1, 2), (20.0, 2), (20.1, 3), (60.0, 3), (60.1, 4)],
    )
    def test_trunk(self, flexion, score):
        assert parts_of(build_posture(trunk_flexion=flexion))["trunk"] == score

    def test_twist_and_side_bend_add_one_each(self):
        assert parts_of(build_posture(trunk_twist=10.1))["trunk"] == 2
        assert parts_of(build_posture(trunk_twist=10.1, trunk_lateral_bend=-10.1))["trunk"] == 3
        assert parts_of(build_posture(trunk_twist=10.0, trunk_lateral_bend=-10.0))["trunk"] == 1

    @pytest.mark.parametrize(
        ("flexion", "score"),
        [(-20.1, 2), (-20.0, 1), (20.0, 1), (20.1, 2), (45.0, 2), (45.1, 3), (90.0, 3), (90.1, 4)],
    )
    def test_upper_arm(self, flexion, score):
        assert parts_of(build_posture(arms=flexion))["upper_arm"] == score
        assert parts_of(build_posture(arms=flexion, adduction=-25.0))["upper_arm"] == score + 1

    @pytest.mark.parametrize(("elbow", "score"), [(59.9, 2), (60.0, 1), (100.0, 1), (100.1, 2)])
    def test_lower_arm(self, elbow, score):
        assert parts_of(build_posture(elbows=elbow))["lower_arm"] == score

    def test_legs_are_uneven_on_one_leg_walking_or_kneeling(self):
        assert parts_of(build_posture())["legs"] == 1
        assert parts_of(build_posture(travel_m_s=1.0))["legs"] == 2
        assert parts_of(build_posture(points={"left_ankle": (0, 0.25, 0.1)}))["legs"] == 2
        kneeling = build_posture(points={"left_knee": (0.3, 0.1, 0.1)}, knee_flexion_l=90.0)
        assert parts_of(kneeling)["legs"] == 2
        assert parts_of(build_posture(conditions=("seated",), travel_m_s=1.0))["legs"] == 1

    @pytest.mark.parametrize(
        ("load", "seldom", "often"),
        [(1.9, 0, 0), (2.0, 1, 2), (10.0, 1, 2), (10.1, 3, 3)],
    )
    def test_force(self, load, seldom, often):
        assert score_force(load, is_repeated=False) == seldom
        assert score_force(load, is_repeated=True) == often

    def test_force_and_repetition_enter_both_groups(self):
        lift = build_lift(start_s=0.0)
        plain = parts_of(build_posture(lift, load_kg=1.0))
        heavy = parts_of(build_posture(lift, load_kg=12.0))
        often = parts_of(build_posture(lift, load_kg=12.0, frequency_per_min=5.0))
        assert (heavy["A"] - plain["A"], heavy["B"] - plain["B"]) == (3, 3)
        assert (often["A"] - heavy["A"], often["B"] - heavy["B"]) == (1, 1)


def test_no_trunk_is_not_scored():
    assert not METHOD.assess(build_posture(trunk_flexion=NAN)).is_applicable


@pytest.mark.parametrize("name", ["neck", "arms", "elbows"])
def test_a_hidden_part_is_neutral_in_the_score_and_worst_in_the_bound(name):
    exposure = build_posture(**{name: NAN, "adduction": NAN if name == "arms" else 0.0})
    plain, bad = parts_of(exposure), parts_of(exposure, "worst")
    assert plain["score"] == parts_of(build_posture())["score"]
    assert bad["score"] > plain["score"]


def test_the_steps_end_in_the_headline():
    lift = build_lift(start_s=0.2)
    result = METHOD.assess(build_posture(lift, trunk_flexion=50.0, arms=50.0, load_kg=5.0))
    assert result.steps[-1].endswith(f"RULA score {result.value:.0f}")
    assert any("wrist 1, wrist twist 1 [assumed]" in step for step in result.steps)
    assert any("How often the work repeats is not known" in r for r in result.reasons)
