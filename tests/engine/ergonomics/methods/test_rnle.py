"""The method `rnle`: ends, assumptions, refusals, intervals and the worked steps."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from engine.datatypes import Provenance
from engine.ergonomics.lifting_equation import compute_rwl_array, govern
from engine.ergonomics.methods.rnle import LEVELS, METHOD, classify, read_case
from tests.engine.ergonomics.exposures import OCCASIONAL, build_exposure, build_lift

NAN = math.nan


def assess(*lifts, **changes):
    options = {k: changes.pop(k) for k in ("observed_s", "conditions") if k in changes}
    return METHOD.assess(build_exposure(*lifts, **options, **{**OCCASIONAL, **changes}))


class TestEnds:
    def test_g4_with_control_the_destination_governs(self):
        result = assess(build_lift())
        assert result.value == pytest.approx(1.513, abs=1e-3)
        assert result.details["governing_end"] == "destination"
        assert result.details["origin"]["RWL_kg"] == pytest.approx(10.572, abs=1e-3)
        assert result.details["destination"]["RWL_kg"] == pytest.approx(9.916, abs=1e-3)
        assert result.details["rwl_kg"] == result.details["destination"]["RWL_kg"]

    def test_without_control_the_origin_governs_but_both_are_shown(self):
        result = assess(build_lift(), destination_control=False)
        assert result.value == pytest.approx(1.419, abs=1e-3)
        assert result.details["governing_end"] == "origin"
        assert result.details["counted_ends"] == ["origin"]
        assert result.details["destination"]["LI"] == pytest.approx(1.513, abs=1e-3)

    def test_unknown_control_takes_the_larger_index_and_says_so(self):
        result = assess(build_lift(), destination_control=None)
        assert result.value == pytest.approx(1.513, abs=1e-3)
        assert any("control at the destination assumed" in r for r in result.reasons)
        control = {i.name: i for i in result.inputs}["significant control"]
        assert (control.value, control.provenance) == (True, Provenance.ASSUMED)

    def test_the_frequency_column_is_that_of_the_origin(self):
        result = assess(build_lift(), frequency_per_min=13.0)
        assert result.details["destination"]["FM"] == 0.0
        assert result.value == math.inf

    def test_missing_destination_leaves_the_origin_with_a_doubt(self):
        lift = build_lift(destination=(NAN, 90.0, 0.0))
        result = assess(lift)
        assert result.value == pytest.approx(1.419, abs=1e-3)
        assert "destination" not in result.details
        assert any("for the origin only" in d for d in result.details["doubts"])

    def test_hands_a_little_below_the_floor_are_on_the_floor(self):
        result = assess(build_lift(origin=(40.0, -1.5, 0.0), D=91.5))
        assert result.details["origin"]["V_cm"] == 0.0
        assert result.details["origin"]["VM"] == pytest.approx(0.775)


class TestHeadline:
    def test_the_worst_lift_is_the_headline(self):
        easy = build_lift(origin=(25.0, 75.0, 0.0), destination=(25.0, 100.0, 0.0))
        result = assess(easy, build_lift(start_s=5.0), easy)
        assert result.value == pytest.approx(1.513, abs=1e-3)
        assert result.lift_index is None
        assert result.details["governing_lift"] == 1
        assert [r.lift_index for r in result.per_lift] == [0, 1, 2]
        assert result.value == max(r.value for r in result.per_lift)

    def test_a_refused_lift_does_not_hide_the_others(self):
        result = assess(build_lift(), build_lift(hands=1))
        assert result.is_applicable
        assert result.details["n_assessed"] == 1
        assert any(r.startswith("Lift 2 was not assessed") for r in result.reasons)

    def test_no_lift_is_not_applicable_with_a_reason(self):
        result = assess()
        assert not result.is_applicable
        assert math.isnan(result.value)
        assert result.category == "not applicable"
        assert result.reasons == ("no lift was found in the video",)

    def test_nothing_may_be_lifted_is_an_infinite_index_with_its_reason(self):
        result = assess(build_lift(origin=(64.0, 30.0, 0.0)))
        assert result.value == math.inf
        assert result.category == "very high"
        assert "HM = 0: H 64 is beyond 63" in result.reasons

    def test_equal_inputs_give_equal_results(self):
        lift = build_lift(sigma=(5.0, 3.0, 8.0))
        one, two = assess(lift), assess(lift)
        assert (one.interval, one.steps, one.details) == (two.interval, two.steps, two.details)


class TestAssumptions:
    def test_no_load_gives_the_weight_limit_but_no_index(self):
        result = assess(build_lift(sigma=(2.0, 2.0, 2.0)), load_kg=None)
        assert result.is_applicable
        assert math.isnan(result.value)
        assert np.isnan(result.interval).all()
        assert result.category == "load not given"
        assert result.details["rwl_kg"] == pytest.approx(9.916, abs=1e-3)
        low, high = result.details["rwl_interval_kg"]
        assert low < 9.916 < high
        assert result.reasons[0].startswith("The load is not given")

    def test_everything_missing_is_assumed_and_flagged(self):
        result = METHOD.assess(build_exposure(build_lift(), load_kg=15.0))
        inputs = {i.name: i for i in result.inputs}
        assert inputs["coupling"].value == "fair"
        assert inputs["frequency"].value == 0.2
        assert inputs["duration class"].value == "short"
        for name in ("coupling", "frequency", "duration class", "significant control"):
            assert inputs[name].provenance is Provenance.ASSUMED
        for name in ("H at origin", "V at origin", "A at origin", "D", "H at destination"):
            assert inputs[name].provenance is Provenance.MEASURED
        assert inputs["load"].provenance is Provenance.USER
        for word in ("frequency", "Duration", "Grip", "control"):
            assert any(word in text for text in result.details["assumptions"])

    def test_assumed_rare_lifting_says_what_demanding_work_would_mean(self):
        result = METHOD.assess(build_exposure(build_lift(), load_kg=15.0))
        assert any("75 % of this" in r for r in result.reasons)
        assert result.details["demanding_li"] == pytest.approx(result.value / 0.75)
        assert math.isnan(assess(build_lift()).details["demanding_li"])

    def test_fast_lifting_of_unknown_duration_may_allow_nothing(self):
        result = assess(build_lift(), frequency_per_min=11.0, duration_h=None, recovery_h=None)
        assert math.isfinite(result.value)
        assert result.details["demanding_li"] == math.inf

    def test_frequency_is_counted_when_a_quarter_of_an_hour_was_watched(self):
        lifts = [build_lift(start_s=10.0 * k) for k in range(30)]
        result = assess(*lifts, frequency_per_min=None, observed_s=900.0)
        frequency = {i.name: i for i in result.inputs}["frequency"]
        assert (frequency.value, frequency.provenance) == (2.0, Provenance.DERIVED)
        short = assess(*lifts, frequency_per_min=None, observed_s=899.0)
        assert {i.name: i for i in short.inputs}["frequency"].value == 0.2

    @pytest.mark.parametrize(
        ("duration", "recovery", "expected"),
        [
            (1.0, None, "short"),
            (1.5, None, "moderate"),
            (3.0, None, "long"),
            (1.0, 1.0, "short"),
            (1.0, 0.5, "long"),
            (2.0, 0.6, "moderate"),
        ],
    )
    def test_duration_class(self, duration, recovery, expected):
        result = assess(build_lift(), duration_h=duration, recovery_h=recovery)
        assert result.details["duration_class"] == expected


class TestApplicability:
    @pytest.mark.parametrize(
        ("lift", "task", "conditions", "word"),
        [
            ({"hands": 1}, {}, (), "one hand"),
            ({}, {"hands": 1}, (), "one hand"),
            ({"notes": ("walking",)}, {}, (), "carrying"),
            ({}, {}, ("walking",), "carrying"),
            ({}, {}, ("seated",), "sits"),
            ({}, {}, ("kneeling",), "kneels"),
            ({}, {"duration_h": 8.5}, (), "8.5 h"),
            ({"origin": (NAN, 30.0, 0.0)}, {}, (), "could not be measured"),
            ({"origin": (40.0, NAN, 0.0), "D": 60.0}, {}, (), "could not be measured"),
            ({"D": NAN}, {}, (), "could not be measured"),
        ],
    )
    def test_refused_with_the_reason(self, lift, task, conditions, word):
        result = assess(build_lift(**lift), conditions=conditions, **task)
        assert not result.is_applicable
        assert math.isnan(result.value)
        assert len(result.reasons) == 1
        assert word in result.reasons[0]
        assert result.per_lift[0].inputs

    def test_eight_hours_are_covered(self):
        assert assess(build_lift(), duration_h=8.0, recovery_h=None).is_applicable

    def test_stated_two_hands_overrule_the_camera_with_a_doubt(self):
        result = assess(build_lift(hands=1), hands=2)
        assert result.is_applicable
        assert any("only one seems to move" in d for d in result.details["doubts"])

    @pytest.mark.parametrize(("speed", "is_doubtful"), [(0.76, False), (0.77, True), (NAN, False)])
    def test_fast_lifts_are_a_doubt_and_no_refusal(self, speed, is_doubtful):
        result = assess(build_lift(peak_hand_speed_m_s=speed))
        assert result.is_applicable
        assert any("m/s" in d for d in result.details["doubts"]) is is_doubtful

    def test_conditions_without_a_rule_are_passed_on(self):
        result = assess(build_lift(), conditions=("camera_shake",))
        assert any("camera_shake" in d for d in result.details["doubts"])


class TestInterval:
    def test_one_eighth_for_five_centimetres_at_forty(self):
        lift = build_lift(origin=(40.0, 30.0, 0.0), destination=(25.0, 75.0, 0.0), D=60.0)
        ends = {"origin": (5.0, 0.0, 0.0)}
        lift = _with_sigma(lift, ends)
        result = assess(lift, destination_control=False)
        low, high = result.interval
        assert low < result.value < high
        assert (high - low) / (2 * 1.96) / result.value == pytest.approx(0.125, abs=0.004)
        assert result.details["dominant_input"] == "H at origin"

    def test_matches_brute_force_with_kinks_and_both_ends(self):
        lift = build_lift(
            origin=(27.0, 73.0, 5.0), destination=(30.0, 110.0, 20.0), sigma=(5.0, 4.0, 10.0)
        )
        result = assess(lift)
        rng = np.random.default_rng(7)
        n = 200_000
        V0 = np.abs(73 + 4 * rng.standard_normal(n))
        D = np.abs(37 + 4 * rng.standard_normal(n))
        work = {"D": D, "V_origin": V0, "frequency_per_min": 0.2}
        ends = []
        for H, V, A in ((27, V0, 5), (30, np.abs(110 + 4 * rng.standard_normal(n)), 20)):
            ends.append(
                compute_rwl_array(
                    H=np.abs(H + 5 * rng.standard_normal(n)),
                    V=V,
                    A=np.abs(A + 10 * rng.standard_normal(n)),
                    duration="short",
                    coupling="fair",
                    **work,
                )
            )
        low, high = np.percentile(np.min(ends, axis=0), [2.5, 97.5])
        assert result.details["rwl_interval_kg"] == pytest.approx([low, high], rel=0.015)
        assert result.interval == pytest.approx((15 / high, 15 / low), rel=0.015)

    def test_an_interval_can_reach_infinity(self):
        lift = build_lift(origin=(61.0, 30.0, 0.0), sigma=(3.0, 0.0, 0.0))
        result = assess(lift)
        assert math.isfinite(result.value)
        assert result.interval[1] == math.inf

    def test_an_unknown_error_gives_no_interval_and_says_so(self):
        result = assess(build_lift(sigma=(NAN, 1.0, 1.0)))
        assert result.value == pytest.approx(1.513, abs=1e-3)
        assert np.isnan(result.interval).all()
        assert any("no interval" in d for d in result.details["doubts"])

    def test_more_error_is_a_wider_interval(self):
        narrow = assess(build_lift(sigma=(2.0, 2.0, 2.0))).interval
        wide = assess(build_lift(sigma=(4.0, 4.0, 4.0))).interval
        assert wide[0] < narrow[0] < narrow[1] < wide[1]

    def test_shares_add_up(self):
        shares = assess(build_lift(sigma=(4.0, 3.0, 8.0))).details["uncertainty_shares"]
        assert sum(shares.values()) == pytest.approx(1.0)
        assert max(shares, key=shares.get) == "H at destination"


def _with_sigma(lift, ends):
    import dataclasses

    from engine.datatypes import LiftEnd, Measurement

    changed = {}
    for name, sigma in ends.items():
        end = getattr(lift, name)
        values = (end.H_cm.value, end.V_cm.value, end.A_deg.value)
        changed[name] = LiftEnd(end.time_s, *map(Measurement, values, sigma))
    return dataclasses.replace(lift, **changed)


class TestSteps:
    def test_worked_calculation_of_the_origin(self):
        steps = assess(build_lift(), destination_control=False).steps
        assert "Origin at 1.00 s: H = 40.0 cm, V = 30.0 cm, A = 0 deg" in steps
        assert "HM = 25 / 40.0 = 0.625" in steps
        assert "VM = 1 - 0.003 x |30.0 - 75| = 0.865" in steps
        assert "DM = 0.82 + 4.5 / 60.0 = 0.895" in steps
        assert "LI = 15 kg / 10.57 kg = 1.42" in steps

    def test_every_printed_product_is_right(self):
        for step in assess(build_lift()).steps:
            product = re.fullmatch(r"RWL = ([\d. x]+) = ([\d.]+) kg", step)
            if product:
                factors = [float(f) for f in product[1].split(" x ")]
                assert math.prod(factors) == pytest.approx(float(product[2]), rel=2e-3)

    def test_clamps_and_zeros_are_explained(self):
        steps = assess(build_lift(origin=(20.0, 70.0, 0.0), destination=(70.0, 80.0, 0.0))).steps
        assert "HM = 25 / 25.0 = 1.000 (H below 25 cm counts as 25)" in steps
        assert any("D below 25 cm counts as 25" in s for s in steps)
        assert "HM = 0: H 70 is beyond 63" in steps

    def test_details_rebuild_the_case(self):
        for control in (True, False, None):
            result = assess(build_lift(), destination_control=control)
            rwl, index = govern(read_case(result.details))
            assert rwl == pytest.approx(result.details["rwl_kg"])
            assert index == pytest.approx(result.value)


class TestBands:
    @pytest.mark.parametrize(
        ("index", "name"),
        [
            (0.0, "very low"),
            (1.0, "very low"),
            (1.001, "low"),
            (1.5, "low"),
            (1.501, "moderate"),
            (2.0, "moderate"),
            (2.001, "high"),
            (3.0, "high"),
            (3.001, "very high"),
            (math.inf, "very high"),
        ],
    )
    def test_both_sides_of_every_bound(self, index, name):
        assert classify(index).name == name

    def test_an_unknown_index_has_no_band(self):
        assert classify(NAN) is None

    def test_levels_rise_and_niosh_own_words_are_told(self):
        uppers = [level.upper for level in LEVELS]
        assert uppers == sorted(uppers)
        assert "NIOSH itself says only" in METHOD.info.description
        assert "NIOSH itself says only" in assess(build_lift()).details["notes"][0]
        assert "[V2]" in assess(build_lift()).reference
