"""Flags: levels, reasons and the change that helps most."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from engine.datatypes import FlagLevel, RiskResult
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.flags import find_best_change, raise_flags
from engine.ergonomics.lifting_equation import Duration, LiftCase, LiftPoint, govern
from tests.engine.ergonomics.exposures import OCCASIONAL, build_exposure, build_lift
from tests.engine.ergonomics.postures import build_posture

SEEN = {"measured": 0.95, "filled": 0.05}
EASY = {"origin": (30.0, 60.0, 0.0), "destination": (30.0, 90.0, 0.0)}


def flags_of(*lifts, coverage=SEEN, conditions=(), **changes):
    exposure = build_exposure(*lifts, conditions=conditions, **{**OCCASIONAL, **changes})
    return raise_flags(assess_risk(exposure, methods=("rnle",)), lifts, coverage)


def only_flag(*lifts, **changes):
    (flag,) = flags_of(*lifts, **changes)
    return flag


class TestLevels:
    @pytest.mark.parametrize(
        ("load", "level"),
        [
            (5.0, FlagLevel.OK),
            (9.9, FlagLevel.OK),
            (9.93, FlagLevel.REVIEW),
            (29.7, FlagLevel.REVIEW),
            (29.8, FlagLevel.HIGH),
        ],
    )
    def test_niosh_limits_without_error(self, load, level):
        # The recommended weight of this lift is 9.916 kg.
        assert only_flag(build_lift(), load_kg=load).level is level

    def test_an_interval_across_the_limit_is_review(self):
        flag = only_flag(build_lift(sigma=(4.0, 3.0, 8.0)), load_kg=9.0)
        assert flag.level is FlagLevel.REVIEW
        assert "crosses the limit 1.0" in flag.why
        assert "H at destination contributes most" in flag.why
        assert "about 95 % interval 0.8 to 1.1" in flag.why

    def test_an_index_above_three_stays_high_when_the_interval_crosses(self):
        flag = only_flag(build_lift(sigma=(4.0, 3.0, 8.0)), load_kg=31.0)
        assert flag.level is FlagLevel.HIGH
        assert "crosses the limit 3.0" in flag.why

    def test_low_coverage_is_never_ok(self):
        flags = flags_of(build_lift(**EASY), load_kg=5.0, coverage={"measured": 0.79})
        assert [f.level for f in flags] == [FlagLevel.REVIEW] * 2
        assert {f.method for f in flags} == {"rnle", "coverage"}
        assert all("79 %" in f.why for f in flags)

    def test_enough_coverage_says_nothing(self):
        flag = only_flag(build_lift(**EASY), load_kg=5.0, coverage={"measured": 0.8})
        assert flag.level is FlagLevel.OK

    def test_unknown_coverage_is_review(self):
        flags = flags_of(build_lift(**EASY), load_kg=5.0, coverage={"measured": math.nan})
        assert all(f.level is FlagLevel.REVIEW for f in flags)

    def test_doubtful_validity_is_review(self):
        flag = only_flag(build_lift(**EASY, peak_hand_speed_m_s=1.1), load_kg=5.0)
        assert flag.level is FlagLevel.REVIEW
        assert "1.10 m/s" in flag.why

    def test_an_ok_that_hangs_on_a_favourable_assumption_is_review(self):
        flag = only_flag(build_lift(), load_kg=9.0, frequency_per_min=None, duration_h=None)
        assert flag.level is FlagLevel.REVIEW
        assert "rare and short lifting only" in flag.why
        robust = only_flag(build_lift(), load_kg=5.0, frequency_per_min=None, duration_h=None)
        assert robust.level is FlagLevel.OK

    def test_ok_states_value_limit_and_assumptions_and_never_safe(self):
        flag = only_flag(build_lift(**EASY, sigma=(2.0, 2.0, 2.0)), load_kg=5.0, coupling=None)
        assert flag.level is FlagLevel.OK
        assert "about 95 % interval" in flag.why
        assert "not above NIOSH's limit of 1.0" in flag.why
        assert "fair coupling assumed" in flag.why
        assert "safe" not in f"{flag.what} {flag.why} {flag.change}".lower()
        assert flag.change == ""

    def test_no_lift_is_said_once(self):
        (flag,) = flags_of()
        assert (flag.level, flag.method) == (FlagLevel.REVIEW, "lifts")

    def test_a_refused_lift_is_review_with_its_reason(self):
        flag = only_flag(build_lift(hands=1))
        assert flag.level is FlagLevel.REVIEW
        assert "one hand" in flag.why
        assert "no statement about the risk" in flag.why

    def test_no_load_asks_for_it(self):
        flag = only_flag(build_lift(), load_kg=None)
        assert flag.level is FlagLevel.REVIEW
        assert "9.9 kg" in flag.what
        assert "Give the load" in flag.change


class TestContent:
    def test_names_the_lift_and_its_time(self):
        flags = flags_of(build_lift(**EASY), build_lift(start_s=7.0), load_kg=11.0)
        worst = flags[0]
        assert worst.lift_index == 1
        assert worst.what.startswith("Lift 2: lifting index 1.1")
        assert (worst.start_s, worst.end_s) == (7.0, pytest.approx(8.2))

    def test_most_urgent_first_then_by_time(self):
        heavy = build_lift(origin=(62.0, 5.0, 90.0), start_s=9.0)
        flags = flags_of(build_lift(**EASY, start_s=5.0), build_lift(**EASY), heavy, load_kg=15.0)
        assert [f.level for f in flags] == [FlagLevel.HIGH, FlagLevel.OK, FlagLevel.OK]
        assert [f.start_s for f in flags] == [9.0, 1.0, 5.0]

    def test_names_the_inputs_that_cost_most(self):
        why = only_flag(build_lift()).why
        assert "horizontal distance 42 cm (x 0.59)" in why
        assert "asymmetry 45 deg (x 0.86)" in why
        assert "at the destination" in why

    def test_the_printed_number_lies_in_its_band(self):
        # 1.513 would round to 1.5, which the band 'moderate' does not contain.
        flag = only_flag(build_lift())
        assert "1.51, moderate" in flag.what

    def test_nothing_may_be_lifted(self):
        flag = only_flag(build_lift(origin=(64.0, 30.0, 0.0)))
        assert flag.level is FlagLevel.HIGH
        assert "infinite" in flag.what
        assert "Bring the load 10 cm closer" in flag.change

    def test_other_methods_are_read_by_their_category(self):
        result = RiskResult(method="other", value=7.0, category="medium")
        (flag,) = raise_flags({"other": result}, [build_lift()], SEEN)
        assert flag.method == "other"
        assert math.isnan(flag.start_s)


class TestRefused:
    def test_methods_that_lack_the_same_are_said_once(self):
        lifts = (build_lift(),)
        exposure = build_exposure(*lifts, **{**OCCASIONAL, "load_kg": None})
        risk = assess_risk(exposure)
        refused = [name for name, result in risk.items() if not result.is_applicable]
        assert len(refused) > 2
        flags = [f for f in raise_flags(risk, lifts, SEEN) if "can't be used here" in f.what]
        assert [f.what for f in flags] == [f"{len(refused)} methods can't be used here"]
        assert flags[0].level is FlagLevel.REVIEW
        assert "oad" in flags[0].why
        assert flags[0].why.endswith("That is no statement about the risk.")

    def test_a_limit_is_named_once(self):
        lifts = (build_lift(sigma=(6.0, 4.0, 8.0)),)
        exposure = build_exposure(*lifts, **{**OCCASIONAL, "load_kg": 15.0})
        for flag in raise_flags(assess_risk(exposure), lifts, SEEN):
            sentences = [s for s in flag.why.split(". ") if "crosses the limit" in s]
            assert len(sentences) == len(set(sentences)), flag.why

    @pytest.mark.parametrize(
        ("interval", "level"),
        [((0.7, math.inf), FlagLevel.REVIEW), ((1.1, math.inf), FlagLevel.HIGH)],
    )
    def test_a_single_limit_alarms_only_when_it_is_surely_passed(self, interval, level):
        result = RiskResult("acgih", math.inf, "above the limit", interval=interval)
        (flag,) = raise_flags({"acgih": result}, (build_lift(),), SEEN)
        assert flag.level is level

    def test_of_equally_urgent_flags_the_lifting_equation_comes_first(self):
        lifts = (build_lift(),)
        exposure = build_exposure(*lifts, **{**OCCASIONAL, "load_kg": 15.0})
        flags = raise_flags(assess_risk(exposure), lifts, SEEN)
        assert [f.level for f in flags] == sorted(
            (f.level for f in flags), key=[FlagLevel.HIGH, FlagLevel.REVIEW, FlagLevel.OK].index
        )
        same = [f.method for f in flags if f.level is FlagLevel.REVIEW]
        assert len(same) > 2
        assert same[0] == "rnle"


class TestChange:
    def case(self, origin=(40.0, 30.0, 0.0), destination=None, **changes):
        values = {
            "D_cm": 60.0,
            "frequency_per_min": 0.2,
            "duration": Duration.SHORT,
            "coupling": "good",
            "load_kg": 15.0,
        }
        return LiftCase(
            origin=LiftPoint(*origin),
            destination=None if destination is None else LiftPoint(*destination),
            **{**values, **changes},
        )

    @pytest.mark.parametrize(
        ("case", "text"),
        [
            ({}, "10 cm closer"),
            ({"origin": (27.0, 30.0, 90.0)}, "turn the feet"),
            ({"origin": (26.0, 5.0, 0.0)}, "raise the origin of the lift by 30 cm"),
            (
                {"origin": (26.0, 75.0, 0.0), "destination": (26.0, 150.0, 0.0), "D_cm": 75.0},
                "lower the destination of the lift by 30 cm",
            ),
            ({"origin": (25.0, 75.0, 0.0), "coupling": "poor"}, "good handles"),
            (
                {"frequency_per_min": 8.0, "duration": Duration.LONG},
                "lower the lifting frequency to 4 per minute",
            ),
        ],
    )
    def test_picks_what_helps_most(self, case, text):
        case = self.case(**case)
        change = find_best_change(case)
        assert text in change.text
        assert change.rwl_kg > govern(case)[0]
        assert change.lifting_index == pytest.approx(15.0 / change.rwl_kg)

    def test_closer_never_goes_below_25_cm(self):
        change = find_best_change(self.case(origin=(31.0, 75.0, 0.0)))
        assert "6 cm closer" in change.text
        assert change.lifting_index == pytest.approx(15.0 / (23.0 * 0.895))

    def test_a_perfect_lift_has_nothing_to_gain(self):
        assert find_best_change(self.case(origin=(25.0, 75.0, 0.0))) is None

    def test_the_flag_shows_before_and_after_and_a_weight_that_keeps_the_limit(self):
        flag = only_flag(build_lift(), destination_control=False)
        # HM from 0.625 to 0.833.
        assert "10 cm closer to the body: lifting index 1.4 -> 1.1, still above 1.0" in flag.change
        assert "at most 10.5 kg" in flag.change


def posture_flags(load_kg=12.0, coverage=SEEN, methods=("reba",), **angles):
    lift = build_lift(start_s=0.5)
    exposure = build_posture(lift, load_kg=load_kg, **angles)
    return raise_flags(assess_risk(exposure, methods=methods), (lift,), coverage)


class TestPostureFlags:
    def test_one_flag_for_the_trial_with_its_worst_moment(self):
        bend = np.zeros(60)
        bend[20:40] = 70.0
        (flag,) = posture_flags(load_kg=3.0, trunk_flexion=bend)
        assert flag.lift_index is None
        assert (flag.start_s, flag.end_s) == (0.667, 1.333)
        assert "trunk 70 deg forward" in flag.why
        assert "At this level for 0.7 s (33 %)" in flag.why
        assert "trunk stays upright: the worst score would be" in flag.change

    def test_the_score_is_a_whole_number_with_its_published_action(self):
        (flag,) = posture_flags(trunk_flexion=70.0)
        assert flag.what.startswith("REBA score ")
        assert "." not in flag.what.split(",")[0]
        assert "action: necessary" in flag.why

    def test_low_coverage_and_wide_errors_are_never_ok(self):
        easy = {"load_kg": 1.0, "methods": ("owas",)}
        (flag,) = posture_flags(**easy)
        assert flag.level is FlagLevel.OK
        assert "safe" not in f"{flag.what} {flag.why}".lower()
        assert posture_flags(**easy, coverage={"measured": 0.5})[0].level is FlagLevel.REVIEW
        (flag,) = posture_flags(**easy, trunk_flexion=18.0, sigma=5.0)
        assert flag.level is FlagLevel.REVIEW
        assert "interval crosses the limit 1" in flag.why

    def test_last_level_is_high(self):
        flags = posture_flags(
            methods=("rula",), trunk_flexion=70.0, trunk_twist=20.0, arms=100.0, elbows=0.0
        )
        assert flags[0].level is FlagLevel.HIGH
        assert "change immediately" in flags[0].why

    def test_the_last_level_needs_to_be_sure_to_alarm(self):
        flags = posture_flags(
            methods=("rula",),
            load_kg=5.0,
            trunk_flexion=61.0,
            arms=100.0,
            adduction=-30.0,
            elbows=0.0,
            sigma={"trunk_flexion": 6.0},
        )
        assert "RULA score 7" in flags[0].what
        assert "crosses the limit 6" in flags[0].why
        assert flags[0].level is FlagLevel.REVIEW

    def test_a_design_standard_is_never_an_alarm(self):
        (flag,) = posture_flags(
            methods=("posture_zones",), trunk_flexion=70.0, frequency_per_min=5.0
        )
        assert "not acceptable" in flag.what
        assert flag.level is FlagLevel.REVIEW

    def test_disagreement_is_shown(self):
        posture = build_posture(build_lift(**EASY), **{**OCCASIONAL, "load_kg": 5.0})
        risk = assess_risk(posture, methods=("rnle", "rula"))
        assert not [f for f in raise_flags(risk, posture.lifts, SEEN) if f.method == "disagreement"]
        rula = dataclasses.replace(risk["rula"], value=7.0, interval=(7.0, 7.0))
        flags = raise_flags({**risk, "rula": rula}, posture.lifts, SEEN)
        (flag,) = [f for f in flags if f.method == "disagreement"]
        assert flag.level is FlagLevel.REVIEW
        assert "RULA score 7" in flag.why
        assert "lifting index" in flag.why
