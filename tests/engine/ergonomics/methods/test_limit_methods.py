"""ISO 11228-1, ACGIH, Liberty Mutual and the composite index, from measured lifts."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from engine.datatypes import Measurement, Provenance, Subject
from engine.ergonomics.methods import acgih, iso11228, lm_mmh, rnle, rnle_job, rnle_vli
from engine.ergonomics.work import classify
from engine.errors import DataError
from tests.engine.ergonomics.exposures import OCCASIONAL, build_exposure, build_lift

NAN = math.nan
MAN = Subject(stature_m=1.75, mass_kg=80.0, sex="male", age_y=30.0)
IDEAL = {"origin": (25.0, 75.0, 0.0), "destination": (25.0, 75.0, 0.0)}


def run(module, *lifts, subject=MAN, **changes):
    options = {k: changes.pop(k) for k in ("observed_s", "conditions") if k in changes}
    exposure = build_exposure(*lifts, **options, **{**OCCASIONAL, **changes})
    return module.METHOD.assess(dataclasses.replace(exposure, subject=subject))


class TestIso:
    @pytest.mark.parametrize(
        ("sex", "age", "mass"),
        [
            ("male", 30, 25.0),
            ("male", 50, 20.0),
            ("female", 30, 20.0),
            ("female", 50, 15.0),
            ("male", 19.9, 20.0),
            ("male", 20, 25.0),
            ("male", 45, 25.0),
            ("male", 45.1, 20.0),
            ("female", 19.9, 15.0),
            ("female", 45, 20.0),
            (None, 30, 15.0),
            ("male", None, 15.0),
            (None, None, 15.0),
        ],
    )
    def test_limit_of_the_ideal_lift_is_the_reference_mass(self, sex, age, mass):
        subject = Subject(stature_m=1.75, sex=sex, age_y=age)
        result = run(iso11228, build_lift(**IDEAL), subject=subject, coupling="good", load_kg=10.0)
        assert result.details["limit_kg"] == pytest.approx(mass)
        assert result.value == pytest.approx(10.0 / mass)
        reference = {i.name: i for i in result.inputs}["reference mass"]
        is_known = sex is not None and age is not None
        assert (reference.provenance is Provenance.DERIVED) == is_known
        assert any("for all workers" in r for r in result.reasons) != is_known

    def test_m2_geometry(self):
        woman = Subject(stature_m=1.65, sex="female", age_y=30.0)
        lift = build_lift(origin=(40.0, 15.0, 0.0), destination=(40.0, 75.0, 0.0))
        result = run(iso11228, lift, subject=woman, destination_control=False)
        assert result.details["limit_kg"] == pytest.approx(8.715, abs=1e-3)
        assert result.value == pytest.approx(1.721, abs=1e-3)

    def test_equals_the_lifting_equation_but_for_the_mass(self):
        lift = build_lift(sigma=(3.0, 2.0, 5.0))
        one, two = run(rnle, lift), run(iso11228, lift)
        assert two.value * 25 == pytest.approx(one.value * 23)
        assert np.array(two.interval) * 25 == pytest.approx(np.array(one.interval) * 23)

    @pytest.mark.parametrize(
        ("change", "word"),
        [
            ({"load_kg": 2.9}, "3 kg or more"),
            ({"hands": 1}, "one hand"),
            ({"duration_h": 9.0}, "at most 8 h"),
            ({"conditions": ("seated",)}, "sits"),
            ({"conditions": ("kneeling",)}, "kneels"),
        ],
    )
    def test_refusals(self, change, word):
        result = run(iso11228, build_lift(), **change)
        assert not result.is_applicable
        assert any(word in reason for reason in result.reasons)

    def test_three_kilograms_are_enough(self):
        assert run(iso11228, build_lift(), load_kg=3.0).is_applicable

    def test_no_load_gives_the_limit(self):
        result = run(iso11228, build_lift(), load_kg=None)
        assert math.isnan(result.value)
        assert result.details["limit_kg"] == pytest.approx(9.916 * 25 / 23, abs=1e-3)

    def test_children(self):
        child = Subject(stature_m=1.5, sex="female", age_y=14.0)
        doubts = run(iso11228, build_lift(), subject=child).details["doubts"]
        assert any("made for adults" in d for d in doubts)


class TestAcgihTable:
    @pytest.mark.parametrize(
        ("per_hour", "hours", "table"),
        [
            (60, 2, 1),
            (60.1, 2, 2),
            (360, 2, 2),
            (361, 2, None),
            (12, 2.1, 1),
            (12.1, 8, 2),
            (30, 8, 2),
            (30.1, 8, 3),
            (40, 4, 3),
            (360, 8, 3),
            (361, 8, None),
        ],
    )
    def test_choice_of_table(self, per_hour, hours, table):
        assert acgih.find_table(per_hour, hours) == table

    # Stature 1.75 m: shoulder 143.15, torso to 135.15, knuckle 75.6, shin 28.35 cm.
    @pytest.mark.parametrize(
        ("V", "limits"),
        [
            (181.0, (0, 0, 0)),
            (173.2, (0, 0, 0)),
            (173.1, (16, 7, 0)),
            (135.2, (16, 7, 0)),
            (135.1, (32, 16, 9)),
            (75.6, (32, 16, 9)),
            (75.5, (18, 14, 7)),
            (28.4, (18, 14, 7)),
            (28.3, (14, 0, 0)),
            (0.0, (14, 0, 0)),
        ],
    )
    def test_every_cell_and_both_sides_of_each_height(self, V, limits):
        H = np.array([29.9, 59.9, 80.0])
        np.testing.assert_array_equal(acgih.find_limit(H, np.array(V), 175.0), limits)

    @pytest.mark.parametrize(
        ("H", "limit"),
        [(0, 32), (29.9, 32), (30, 16), (59.9, 16), (60, 9), (80, 9), (80.1, 0)],
    )
    def test_both_sides_of_each_distance(self, H, limit):
        assert acgih.find_limit(np.array(float(H)), np.array(100.0), 175.0) == limit

    def test_nothing_above_180_cm_however_tall(self):
        assert acgih.find_limit(np.array(20.0), np.array(180.1), 210.0) == 0

    def test_unknown_place_is_unknown(self):
        assert np.isnan(acgih.find_limit(np.array(NAN), np.array(100.0), 175.0))


class TestAcgih:
    @pytest.mark.parametrize(
        ("place", "load", "hours", "per_hour", "limit", "level"),
        [
            ((40, 100, 0), 10.0, 1, 30, 16, "within the limit"),
            ((70, 50, 0), 10.0, 4, 10, 7, "above the limit"),
            ((85, 100, 0), 20.0, 1, 30, 0, "above the limit"),
        ],
    )
    def test_vectors(self, place, load, hours, per_hour, limit, level):
        result = run(
            acgih,
            build_lift(origin=place),
            load_kg=load,
            duration_h=float(hours),
            frequency_per_min=per_hour / 60,
        )
        assert (result.details["limit_kg"], result.category) == (limit, level)
        assert result.value == (load / limit if limit else math.inf)

    @pytest.mark.parametrize(("per_min", "word"), [(40 / 60, "table 3"), (10.0, "more than")])
    def test_frequent_lifting_is_not_judged(self, per_min, word):
        result = run(acgih, build_lift(), duration_h=4.0, frequency_per_min=per_min)
        assert not result.is_applicable
        assert word in result.reasons[0]

    def test_load_equal_to_the_limit_is_within(self):
        result = run(acgih, build_lift(origin=(40, 100, 0)), load_kg=16.0)
        assert result.category == "within the limit"

    def test_interval_crosses_near_a_zones_edge(self):
        near = build_lift(origin=(59.0, 100.0, 0), sigma=(2.0, 2.0, 5.0))
        far = build_lift(origin=(45.0, 100.0, 0), sigma=(2.0, 2.0, 5.0))
        assert run(acgih, near, load_kg=12.0).interval == (12 / 16, 12 / 9)
        assert run(acgih, far, load_kg=12.0).interval == (12 / 16, 12 / 16)

    @pytest.mark.parametrize(
        ("change", "word"),
        [
            ({"hands": 1}, "one hand"),
            ({"conditions": ("seated",)}, "sits"),
            ({"coupling": "poor"}, "grip"),
            ({"duration_h": 9.0}, "more than 8 h"),
        ],
    )
    def test_cautions_are_doubts(self, change, word):
        doubts = run(acgih, build_lift(), **change).details["doubts"]
        assert any(word in d and "lower than stated" in d for d in doubts)

    def test_to_the_side_is_a_doubt(self):
        for angle, expected in ((30.0, False), (30.1, True)):
            doubts = run(acgih, build_lift(origin=(40, 100, angle))).details["doubts"]
            assert any("to the side" in d for d in doubts) is expected

    def test_load_is_needed(self):
        assert not run(acgih, build_lift(), load_kg=None).is_applicable

    def test_missing_origin_is_not_applicable(self):
        assert not run(acgih, build_lift(origin=(NAN, 30.0, 0.0), D=60.0)).is_applicable


class TestLibertyMutual:
    @pytest.mark.parametrize(
        ("direction", "sex", "H", "V", "F", "factors", "median", "sd", "for_75"),
        [
            (
                "lift",
                "female",
                0.38,
                (0.775, 1.285),
                1,
                (0.766, 0.948, 0.907, 0.677),
                15.56,
                4.05,
                12.83,
            ),
            (
                "lift",
                "female",
                0.38,
                (0.1, 0.8),
                1,
                (0.7658, 0.9986, 0.8662, 0.6767),
                15.645,
                4.068,
                12.899,
            ),
            (
                "lift",
                "male",
                0.40,
                (0.1, 0.8),
                1,
                (0.7881, 0.9485, 0.9031, 0.6259),
                34.903,
                9.633,
                28.401,
            ),
            (
                "lift",
                "male",
                0.50,
                (0.75, 1.40),
                4,
                (0.6469, 0.9862, 0.9101, 0.4581),
                21.967,
                6.063,
                17.874,
            ),
            (
                "lower",
                "female",
                0.35,
                (1.2, 0.7),
                0.5,
                (0.8048, 0.9592, 0.9100, 0.7296),
                18.965,
                5.822,
                15.035,
            ),
            (
                "lower",
                "male",
                0.45,
                (1.0, 0.2),
                2,
                (0.7175, 0.9792, 0.8905, 0.5112),
                30.675,
                9.325,
                24.380,
            ),
        ],
        ids=["Q1", "Q2", "Q3", "Q4", "Q5", "Q6"],
    )
    def test_vectors(self, direction, sex, H, V, F, factors, median, sd, for_75):
        found = lm_mmh.compute_acceptable_lift(
            direction, sex, H_m=H, VRM_m=sum(V) / 2, DV_m=abs(V[1] - V[0]), F=F
        )
        assert list(found.factors.values()) == pytest.approx(factors, abs=6e-4)
        assert found.median_kg == pytest.approx(median, abs=0.01)
        assert found.sd_kg == pytest.approx(sd, abs=0.006)
        assert found.for_75_percent_kg == pytest.approx(for_75, abs=0.01)

    @pytest.mark.parametrize(
        ("median", "sd", "load", "percent"),
        [
            (15.56, 4.05, 12, 81.0),
            (15.645, 4.068, 15, 56.30),
            (34.903, 9.633, 15, 98.06),
            (21.967, 6.063, 15, 87.47),
            (18.965, 5.822, 15, 75.21),
            (30.675, 9.325, 15, 95.36),
        ],
    )
    def test_percent_capable(self, median, sd, load, percent):
        found = lm_mmh.compute_percent_capable(load, median, sd)
        assert found == pytest.approx(percent, abs=0.05)

    @pytest.mark.parametrize(
        ("sex", "V", "median", "for_75"),
        [("female", 0.75, 17.532, 14.799), ("male", 0.85, 32.514, 26.413)],
    )
    def test_carry(self, sex, V, median, for_75):
        found = lm_mmh.compute_acceptable_carry(sex, V_m=V, DH_m=4.3, F=1)
        assert found.median_kg == pytest.approx(median, abs=2e-3)
        assert found.for_75_percent_kg == pytest.approx(for_75, abs=2e-3)

    def test_published_table_of_maxima(self):
        rows = {(d, s): e for (d, s), e in lm_mmh.EQUATIONS.items()}
        found = {k: e.reference_kg * (1 - 0.675 * e.variation) for k, e in rows.items()}
        assert found == pytest.approx(
            {
                ("lift", "female"): 28.8,
                ("lift", "male"): 67.2,
                ("lower", "female"): 29.3,
                ("lower", "male"): 76.2,
            },
            abs=0.06,
        )
        carry = [kg * (1 - 0.675 * cv) for kg, cv in lm_mmh.CARRY_KG.values()]
        assert carry == pytest.approx([24.1, 60.9], abs=0.06)

    @pytest.mark.parametrize("key", list(lm_mmh.EQUATIONS))
    def test_frequency_factor_is_one_at_the_lowest_rate(self, key):
        found = lm_mmh.compute_acceptable_lift(*key, H_m=0.25, VRM_m=0.7, DV_m=0.25, F=1 / 480)
        assert found.factors["FSF"] == pytest.approx(1.0, abs=5e-3)
        assert all(0 <= value <= 1 for value in found.factors.values())

    def test_a_measured_lift(self):
        lift = build_lift(origin=(38.0, 77.5, 0.0), destination=(35.0, 128.5, 0.0))
        result = run(lm_mmh, lift, load_kg=12.0, frequency_per_min=1.0, coupling="good")
        assert result.value == pytest.approx(19.0, abs=0.1)
        assert result.category == "acceptable"
        assert result.details["women"]["acceptable_to_75_percent_kg"] == pytest.approx(
            12.83, abs=0.01
        )
        poor = run(lm_mmh, lift, load_kg=12.0, frequency_per_min=1.0, coupling="poor")
        assert poor.details["women"]["median_kg"] == pytest.approx(
            0.84 * result.details["women"]["median_kg"]
        )

    def test_lowering_uses_its_own_equation(self):
        down = build_lift(origin=(35.0, 120.0, 0.0), destination=(35.0, 70.0, 0.0))
        result = run(lm_mmh, down, frequency_per_min=0.5, coupling="good")
        assert result.details["direction"] == "lower"
        assert result.details["women"]["median_kg"] == pytest.approx(18.965, abs=0.01)

    def test_interval_holds_the_value(self):
        lift = build_lift(sigma=(4.0, 3.0, 5.0))
        low, high = run(lm_mmh, lift).interval
        assert low < run(lm_mmh, lift).value < high

    @pytest.mark.parametrize(
        ("lift", "change", "word"),
        [
            ({"origin": (68.1, 30.0, 0.0)}, {}, "end at 68 cm"),
            ({"destination": (40.0, 196.5, 0.0)}, {}, "1.96 m"),
            ({}, {"frequency_per_min": 20.5}, "more than 20"),
            ({}, {"frequency_per_min": 19.0}, "11 m up or down"),
            ({}, {"hands": 1}, "two-handed"),
            ({"notes": ("walking",)}, {}, "walks"),
            ({"origin": (NAN, 30.0, 0.0), "D": 60.0}, {}, "could not be measured"),
        ],
    )
    def test_refusals(self, lift, change, word):
        result = run(lm_mmh, build_lift(**lift), **change)
        assert not result.is_applicable
        assert any(word in reason for reason in result.reasons)

    def test_limits_themselves_are_allowed(self):
        lift = build_lift(origin=(68.0, 30.0, 0.0), destination=(40.0, 40.0, 0.0))
        assert run(lm_mmh, lift, frequency_per_min=20.0).is_applicable

    def test_zero_frequency_and_short_travel_are_clamped(self):
        lift = build_lift(origin=(40.0, 70.0, 0.0), destination=(40.0, 80.0, 0.0))
        result = run(lm_mmh, lift, frequency_per_min=0.0)
        assert result.is_applicable
        assert result.details["women"]["DVSF"] == 1.0

    def test_no_load_gives_acceptable_loads(self):
        result = run(lm_mmh, build_lift(), load_kg=None)
        assert math.isnan(result.value)
        assert result.category == "load not given"
        assert result.details["women"]["median_kg"] > 0

    @pytest.mark.parametrize(("value", "level"), [(25, 0), (25.1, 1), (50, 1), (50.1, 2)])
    def test_both_sides_of_the_bands(self, value, level):
        assert classify(lm_mmh.LEVELS, value) is lm_mmh.LEVELS[level]

    def test_impossible_inputs_are_errors(self):
        with pytest.raises(DataError, match="above 0"):
            lm_mmh.compute_acceptable_lift("lift", "male", H_m=0.3, VRM_m=0.5, DV_m=0.0, F=1.0)
        with pytest.raises(DataError, match="above 0"):
            lm_mmh.compute_acceptable_carry("male", V_m=0.8, DH_m=0.0, F=1.0)


class TestJob:
    EASY = build_lift(origin=(25.0, 75.0, 0.0), destination=(25.0, 100.0, 0.0), start_s=1.0)
    HARD = build_lift(start_s=5.0)

    def test_one_lift_is_its_lifting_index(self):
        one = run(rnle_job, self.HARD)
        assert one.value == pytest.approx(run(rnle, self.HARD).value)
        assert one.interval == pytest.approx(run(rnle, self.HARD).interval)

    def test_worst_first_and_the_others_add_the_rate(self):
        result = run(rnle_job, self.EASY, self.HARD, frequency_per_min=4.0, duration_h=1.0)
        hard, easy = result.details["tasks"]
        assert (hard["name"], easy["name"]) == ("lift 2", "lift 1")
        firwl = 9.916  # G4: the destination governs
        firwl_easy = 23 * 0.925
        assert hard["FIRWL_kg"] == pytest.approx(firwl, abs=1e-3)
        assert hard["STLI"] == pytest.approx(15 / (firwl * 0.91), abs=1e-3)
        assert easy["increment"] == pytest.approx(15 / firwl_easy * (1 / 0.84 - 1 / 0.91), abs=1e-3)
        assert result.value == pytest.approx(hard["STLI"] + easy["increment"])

    def test_a_repeated_lift_is_one_task_at_the_whole_rate(self):
        job = run(rnle_job, *[self.HARD] * 5, frequency_per_min=4.0)
        single = run(rnle, self.HARD, frequency_per_min=4.0)
        assert job.value == pytest.approx(single.value)

    def test_rate_is_counted_from_the_video(self):
        result = run(rnle_job, self.EASY, self.HARD, frequency_per_min=None, observed_s=30.0)
        frequency = {i.name: i for i in result.inputs}["frequency, all lifts"]
        assert (frequency.value, frequency.provenance) == (4.0, Provenance.DERIVED)
        assert any("less than 15 min" in d for d in result.details["doubts"])
        watched = run(rnle_job, self.EASY, self.HARD, frequency_per_min=None, observed_s=900.0)
        assert not any("less than 15 min" in d for d in watched.details["doubts"])

    def test_one_lift_is_too_few_to_count(self):
        result = run(rnle_job, self.HARD, frequency_per_min=None, observed_s=30.0)
        frequency = {i.name: i for i in result.inputs}["frequency, all lifts"]
        assert (frequency.value, frequency.provenance) == (0.2, Provenance.ASSUMED)

    def test_too_fast_a_job_is_infinite(self):
        result = run(rnle_job, *[self.HARD] * 4, frequency_per_min=16.0)
        assert (result.value, result.category) == (math.inf, "very high")

    def test_errors_are_taken_as_common(self):
        lift = dataclasses.replace(build_lift(sigma=(5.0, 3.0, 5.0)), D_cm=Measurement(60.0, 3.0))
        one, two = run(rnle_job, lift), run(rnle_job, lift, lift)
        assert two.interval == pytest.approx(one.interval)
        assert one.interval[0] < one.value < one.interval[1]

    def test_nothing_allowed_may_still_have_a_finite_end(self):
        lift = build_lift(origin=(64.0, 30.0, 0.0), sigma=(3.0, 1.0, 1.0))
        one, job = run(rnle, lift), run(rnle_job, lift)
        assert job.value == math.inf
        assert job.interval == pytest.approx(one.interval)
        assert math.isfinite(job.interval[0])

    def test_refused_lifts_are_named(self):
        result = run(rnle_job, self.HARD, dataclasses.replace(self.EASY, hands=1))
        assert result.details["n_lifts"] == 1
        assert any("only 1 of 2" in d for d in result.details["doubts"])
        assert not run(rnle_job, dataclasses.replace(self.EASY, hands=1)).is_applicable

    def test_load_is_needed(self):
        result = run(rnle_job, self.HARD, load_kg=None)
        assert not result.is_applicable
        assert "load is not given" in result.reasons[0]


class TestVariableIndex:
    def test_equal_lifts_give_the_lifting_index(self):
        lift = TestJob.HARD
        result = run(rnle_vli, *[lift] * 7, frequency_per_min=4.0, destination_control=False)
        # The table's column differs: the categories are read from 75 cm upwards.
        expected = 15 / 10.572 / 0.84
        assert result.value == pytest.approx(expected, abs=1e-3)
        assert result.details["cli"] == pytest.approx(expected, abs=1e-3)

    def test_few_lifts_are_a_doubt(self):
        doubts = run(rnle_vli, TestJob.HARD, TestJob.EASY).details["doubts"]
        assert any("too few" in d for d in doubts)

    def test_is_experimental_and_passes_refusals_on(self):
        assert rnle_vli.METHOD.info.is_experimental
        assert not run(rnle_vli, TestJob.HARD, load_kg=None).is_applicable
