"""REBA: tables, vectors, bounds of every part, missing parts, and the result."""

from __future__ import annotations

import math

import numpy as np
import pytest

from engine.datatypes import Coupling, Provenance
from engine.ergonomics.methods.reba import (
    COUPLING_SCORES,
    LEVELS,
    METHOD,
    TABLE_A,
    TABLE_B,
    TABLE_C,
    combine_reba,
    score_load,
)
from engine.ergonomics.posture import read_posture
from engine.ergonomics.posture_scores import decode_runs, find_level
from tests.engine.ergonomics.exposures import build_lift
from tests.engine.ergonomics.postures import build_posture

NAN = math.nan


def parts_of(exposure, unknown="neutral"):
    """Return the scores of the first frame."""
    posture = read_posture(exposure)
    scores = METHOD.score(posture, posture.values(), unknown)
    return {name: int(np.asarray(values)[0, 0]) for name, values in scores.items()}


class TestTables:
    def test_checksums(self):
        assert (TABLE_A.sum(), TABLE_B.sum(), TABLE_C.sum()) == (321, 177, 1192)
        assert (TABLE_A.shape, TABLE_B.shape, TABLE_C.shape) == ((5, 3, 4), (6, 2, 3), (12, 12))

    @pytest.mark.parametrize("table", [TABLE_A, TABLE_B, TABLE_C], ids="ABC")
    def test_worse_parts_never_score_better(self, table):
        for axis in range(table.ndim):
            assert (np.diff(table.astype(int), axis=axis) >= 0).all()

    @pytest.mark.parametrize(
        ("values", "expected"),
        [
            ((2, 2, 2, 0, 1, 2, 3, 0, 0), (4, 3, 4, 4)),
            ((2, 2, 2, 0, 1, 2, 2, 0, 0), (4, 2, 4, 4)),
            ((1, 1, 1, 0, 1, 1, 1, 0, 0), (1, 1, 1, 1)),
            ((1, 4, 3, 2, 3, 2, 1, 1, 1), (8, 5, 10, 11)),
            ((2, 5, 3, 3, 3, 2, 2, 1, 1), (11, 6, 12, 13)),
            ((3, 3, 2, 1, 4, 1, 2, 2, 2), (7, 7, 9, 11)),
            ((3, 5, 4, 3, 6, 2, 3, 3, 3), (12, 12, 12, 15)),
        ],
        ids=["P1", "P2", "P3", "P4", "P5", "P6", "P7"],
    )
    def test_vectors(self, values, expected):
        names = ("neck", "trunk", "legs", "load", "upper_arm", "lower_arm", "wrist", "coupling")
        given = dict(zip((*names, "activity"), values, strict=True))
        assert tuple(int(x) for x in combine_reba(**given)) == expected

    @pytest.mark.parametrize(
        ("score", "name"),
        [(1, "negligible"), (2, "low"), (3, "low"), (4, "medium"), (7, "medium"), (8, "high"),
         (10, "high"), (11, "very high"), (15, "very high")],
    )  # fmt: skip
    def test_action_levels(self, score, name):
        assert find_level(LEVELS, score).name == name


class TestParts:
    @pytest.mark.parametrize(
        ("flexion", "score"),
        [(-20.1, 3), (-20.0, 2), (-5.0, 1), (0.0, 1), (5.0, 1), (5.1, 2), (20.0, 2), (20.1, 3),
         (60.0, 3), (60.1, 4)],
    )  # fmt: skip
    def test_trunk(self, flexion, score):
        assert parts_of(build_posture(trunk_flexion=flexion))["trunk"] == score

    @pytest.mark.parametrize("name", ["trunk_twist", "trunk_lateral_bend"])
    @pytest.mark.parametrize(("angle", "more"), [(10.0, 0), (10.1, 1), (-10.0, 0), (-10.1, 1)])
    def test_twist_and_side_bend_add_one(self, name, angle, more):
        assert parts_of(build_posture(**{name: angle}))["trunk"] == 1 + more

    def test_twist_and_side_bend_add_one_together(self):
        found = parts_of(
            build_posture(trunk_flexion=70.0, trunk_twist=30.0, trunk_lateral_bend=30.0)
        )
        assert found["trunk"] == 5

    @pytest.mark.parametrize(
        ("flexion", "score"), [(-5.1, 2), (-5.0, 1), (0.0, 1), (9.0, 1), (20.0, 1), (20.1, 2)]
    )
    def test_neck(self, flexion, score):
        assert parts_of(build_posture(neck=flexion))["neck"] == score

    @pytest.mark.parametrize(
        ("knee", "score"), [(0.0, 1), (30.0, 1), (30.1, 2), (60.0, 2), (60.1, 3)]
    )
    def test_legs(self, knee, score):
        assert parts_of(build_posture(knees=knee))["legs"] == score
        assert parts_of(build_posture(knee_flexion_l=knee))["legs"] == score, "one knee counts"

    @pytest.mark.parametrize(("lift", "score"), [(0.09, 1), (0.11, 2)])
    @pytest.mark.parametrize("side", ["left", "right"])
    def test_one_leg(self, side, lift, score):
        points = {f"{side}_ankle": (0.0, 0.09 + lift, 0.1)}
        assert parts_of(build_posture(points=points))["legs"] == score
        walking = build_posture(points=points, travel_m_s=1.0)
        assert parts_of(walking)["legs"] == 1, "walking is bilateral"

    def test_knees_do_not_count_when_sitting(self):
        assert parts_of(build_posture(knees=90.0, conditions=("seated",)))["legs"] == 1

    @pytest.mark.parametrize(
        ("flexion", "score"),
        [(-20.1, 2), (-20.0, 1), (20.0, 1), (20.1, 2), (45.0, 2), (45.1, 3), (90.0, 3), (90.1, 4)],
    )
    def test_upper_arm(self, flexion, score):
        assert parts_of(build_posture(arms=flexion))["upper_arm"] == score

    @pytest.mark.parametrize(("adduction", "more"), [(-20.0, 0), (-20.1, 1), (40.0, 0)])
    def test_abduction_adds_one(self, adduction, more):
        assert parts_of(build_posture(adduction=adduction))["upper_arm"] == 1 + more

    def test_an_arm_straight_out_to_the_side_is_raised(self):
        assert parts_of(build_posture(arms=NAN, adduction=-85.0))["upper_arm"] == 4

    @pytest.mark.parametrize(("elbow", "score"), [(59.9, 2), (60.0, 1), (100.0, 1), (100.1, 2)])
    def test_lower_arm(self, elbow, score):
        assert parts_of(build_posture(elbows=elbow))["lower_arm"] == score

    @pytest.mark.parametrize(
        ("load", "score"), [(0.0, 0), (4.9, 0), (5.0, 1), (10.0, 1), (10.1, 2)]
    )
    def test_load(self, load, score):
        assert score_load(load) == score
        lift = build_lift(start_s=0.0)
        assert parts_of(build_posture(lift, load_kg=load))["load"] == score

    def test_every_grip_has_a_score(self):
        assert set(COUPLING_SCORES) == set(Coupling)

    def test_the_worse_side_counts(self):
        found = parts_of(build_posture(shoulder_flexion_r=100.0))
        assert (found["side"], found["upper_arm"]) == (2, 4)
        found = parts_of(build_posture(shoulder_flexion_l=100.0))
        assert (found["side"], found["upper_arm"]) == (1, 4)

    def test_the_load_counts_from_lift_off_to_set_down_only(self):
        lift = build_lift(start_s=0.5)
        details = METHOD.assess(build_posture(lift, load_kg=20.0)).details
        load = decode_runs(details["series"]["load"])
        assert np.flatnonzero(load).tolist() == list(range(15, 52))
        assert set(load) == {0, 2}

    def test_repetition_adds_one(self):
        often, seldom = (
            METHOD.assess(build_posture(frequency_per_min=f)).value for f in (4.1, 4.0)
        )
        assert often - seldom == 1

    def test_a_hold_of_over_a_minute_adds_one(self):
        long, short = (METHOD.assess(build_posture(n_frames=n)) for n in (1900, 1700))
        assert (long.value, short.value) == (2, 1)
        assert any("held still for over a minute" in step for step in long.steps)


class TestMissing:
    def test_no_trunk_is_not_scored(self):
        result = METHOD.assess(build_posture(trunk_flexion=NAN))
        assert not result.is_applicable
        assert "trunk" in result.reasons[0]

    def test_frames_without_a_trunk_stay_unscored(self):
        bend = np.full(60, 30.0)
        bend[20:30] = np.nan
        details = METHOD.assess(build_posture(trunk_flexion=bend)).details
        series = decode_runs(details["series"]["score"])
        assert (series[20:30] == 0).all()
        assert (np.delete(series, np.s_[20:30]) > 0).all()
        assert details["scored_share"] == pytest.approx(50 / 60, abs=1e-3)

    def test_little_scored_is_a_doubt(self):
        bend = np.full(60, 30.0)
        bend[:20] = np.nan
        assert any("67 %" in d for d in METHOD.assess(build_posture(trunk_flexion=bend)).reasons)

    def test_without_a_heading_the_inclination_stands_in(self):
        exposure = build_posture(trunk_flexion=NAN, trunk_inclination=65.0)
        assert parts_of(exposure)["trunk"] == 4

    def test_one_hidden_arm_leaves_the_other(self):
        hidden = build_posture(
            shoulder_flexion_l=NAN, shoulder_adduction_l=NAN, elbow_flexion_l=NAN
        )
        found = parts_of(hidden)
        assert (found["side"], found["score"]) == (2, parts_of(build_posture())["score"])

    @pytest.mark.parametrize("name", ["neck", "knees", "elbows"])
    def test_a_hidden_part_is_neutral_in_the_score_and_worst_in_the_bound(self, name):
        exposure = build_posture(**{name: NAN})
        assert parts_of(exposure)["score"] == parts_of(build_posture())["score"]
        assert parts_of(exposure, "worst")["score"] >= parts_of(build_posture(), "worst")["score"]
        result = METHOD.assess(exposure)
        assert any("Not seen, by share of the frames" in r for r in result.reasons)
        assert "not seen" in {i.value for i in result.inputs}

    def test_both_arms_hidden_is_assumed_and_bounded(self):
        exposure = build_posture(arms=NAN, adduction=NAN, elbows=NAN)
        assert parts_of(exposure)["score"] == 1
        assert parts_of(exposure, "worst")["score"] == 6  # table C: A 1, B 9

    def test_unknown_load_is_light_in_the_score_and_heavy_in_the_bound(self):
        lift = build_lift(start_s=0.0)
        exposure = build_posture(lift, trunk_flexion=70.0)
        assert parts_of(exposure)["load"] == 0
        assert parts_of(exposure, "worst")["load"] == 2
        load = next(i for i in METHOD.assess(exposure).inputs if i.name == "load")
        assert load.provenance is Provenance.ASSUMED


class TestResult:
    def test_exact_angles_have_no_interval_width(self):
        result = METHOD.assess(build_posture(trunk_flexion=70.0))
        assert result.interval == (result.value, result.value)
        assert sum(level["probability"] for level in result.details["levels"]) == 1.0

    def test_errors_across_a_bound_widen_the_interval_evenly(self):
        result = METHOD.assess(build_posture(trunk_flexion=60.0, sigma=0.5, knees=70.0))
        assert result.interval[0] < result.interval[1]
        rows = {row["name"]: row["probability"] for row in result.details["levels"]}
        assert sum(rows.values()) == pytest.approx(1.0, abs=0.01)
        drawn = decode_runs(result.details["series"]["high"])
        assert (drawn >= decode_runs(result.details["series"]["score"])).all()
        assert result.details["uncertainty_shares"] == {"trunk flexion": 1.0}

    @pytest.mark.parametrize(("flexion", "chance"), [(58.0, 0.159), (60.0, 0.5), (62.0, 0.841)])
    def test_the_chance_of_a_level_is_that_of_the_normal_distribution(self, flexion, chance):
        # Above 60 degrees the trunk scores 4 and the whole body 2, which is another level.
        exposure = build_posture(trunk_flexion=flexion, sigma={"trunk_flexion": 2.0})
        levels = {row["name"]: row for row in METHOD.assess(exposure).details["levels"]}
        assert levels["low"]["probability"] == pytest.approx(chance, abs=0.05)
        assert levels["negligible"]["probability"] == pytest.approx(1 - chance, abs=0.05)

    def test_unknown_errors_give_no_interval_and_a_doubt(self):
        result = METHOD.assess(build_posture(trunk_flexion=30.0, sigma=None))
        assert math.isnan(result.interval[0])
        assert any("no interval can be given" in d for d in result.details["doubts"])

    def test_time_in_levels_adds_up(self):
        bend = np.where(np.arange(90) < 30, 0.0, 70.0)
        details = METHOD.assess(build_posture(n_frames=90, trunk_flexion=bend, knees=70.0)).details
        assert sum(row["time_s"] for row in details["levels"]) == pytest.approx(3.0, abs=1e-3)
        assert sum(row["share"] for row in details["levels"]) == pytest.approx(1.0, abs=1e-3)

    def test_a_peak_too_short_is_in_the_maximum_and_not_the_headline(self):
        arms = np.zeros(60)
        arms[30:34] = 100.0
        # Two parts that pass their bounds for 0.13 s are dropped part by part.
        assert METHOD.assess(build_posture(arms=arms)).value == 1

    def test_lift_moments_and_drivers(self):
        lift = build_lift(start_s=0.5)
        bend = 70.0 * np.exp(-(((np.arange(60) - 24) / 12) ** 2))
        details = METHOD.assess(build_posture(lift, trunk_flexion=bend, load_kg=3.0)).details
        (row,) = details["lifts"]
        assert row["peak_flexion"] == decode_runs(details["series"]["score"])[24]
        assert row["start"] == decode_runs(details["series"]["score"])[15]
        assert details["drivers"][0]["part"] == "trunk"

    def test_steps_tell_measured_assumed_and_entered(self):
        lift = build_lift(start_s=0.0)
        exposure = build_posture(lift, trunk_flexion=70.0, load_kg=12.0, elbows=NAN)
        steps = " ".join(METHOD.assess(exposure).steps)
        for part in ("[measured]", "12 kg [entered]", "wrist 1 [assumed]", "fair [assumed]",
                     "not seen [assumed neutral]", "Worst moment: "):  # fmt: skip
            assert part in steps

    def test_the_steps_end_in_the_headline(self):
        lift = build_lift(start_s=0.3)
        result = METHOD.assess(build_posture(lift, trunk_flexion=70.0, load_kg=12.0, knees=40.0))
        assert result.steps[-1] == f"REBA score {result.value:.0f}"

    def test_a_long_clip_is_scored_in_pieces(self):
        n = 9000
        bend = 40.0 + 40.0 * np.sin(np.arange(n) / 40)
        result = METHOD.assess(build_posture(n_frames=n, trunk_flexion=bend, sigma=3.0))
        assert decode_runs(result.details["series"]["score"]).size == n
