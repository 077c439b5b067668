"""What LiFFT, the Shoulder Tool, KIM-LHC and the LMM features make of a measured lift."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from engine.datatypes import JointAngles, Provenance, Subject
from engine.ergonomics.fatigue import (
    compute_back_damage,
    compute_risk_percent,
    compute_shoulder_damage,
    compute_shoulder_moment,
)
from engine.ergonomics.methods import kim_lhc, lifft, lmm, shoulder_tool
from engine.ergonomics.segments import ABOVE_L5S1
from engine.ergonomics.work import classify
from engine.errors import DataError
from tests.engine.ergonomics.exposures import build_end, build_exposure, build_lift
from tests.engine.ergonomics.figures import (
    TRUNK_M,
    build_figure_exposure,
    build_track,
    place_figure,
)

NAN = math.nan
G = 9.80665
WORK = {"load_kg": 13.0, "frequency_per_min": 2.0, "duration_h": 4.0}
LEVER_M = TRUNK_M * math.sin(math.pi / 4) * (1 - ABOVE_L5S1["male"].l5s1_height) + 0.2


def run(method, **options):
    return method.METHOD.assess(build_figure_exposure(**{**WORK, **options}))


BOTH = pytest.mark.parametrize("method", [lifft, shoulder_tool], ids=["lifft", "shoulder"])
ALL = pytest.mark.parametrize(
    "method", [lifft, shoulder_tool, kim_lhc], ids=["lifft", "shoulder", "kim"]
)


@BOTH
@pytest.mark.parametrize(
    ("value", "level"), [(24.999, 0), (25.0, 1), (50.0, 1), (50.001, 2), (100.0, 2)]
)
def test_both_sides_of_the_bands(method, value, level):
    assert classify(method.LEVELS, value) is method.LEVELS[level]


class TestLifft:
    def test_moment_and_repetitions_follow_from_the_figure(self):
        result = run(lifft)
        moment = 13 * G * LEVER_M
        assert result.details["peak_moment_nm"] == pytest.approx(moment)
        assert result.details["lifts_per_day"] == pytest.approx(480)
        expected = compute_risk_percent(480 * compute_back_damage(moment), "lifft")
        assert result.value == pytest.approx(expected)

    def test_two_lifts_share_the_day(self):
        first = build_figure_exposure().lifts[0]
        same = dataclasses.replace(first, start_s=1.6, end_s=1.9)
        assert run(lifft, lifts=[first, same]).value == pytest.approx(run(lifft).value)

    def test_interval_holds_the_value_and_widens_with_the_error(self):
        sure, unsure = run(lifft, sigma=0.01), run(lifft, sigma=0.06)
        for result in (sure, unsure):
            assert result.interval[0] < result.value < result.interval[1]
        assert np.ptp(unsure.interval) > np.ptp(sure.interval)

    def test_large_moment_is_a_doubt(self):
        assert any("caution" in d for d in run(lifft, load_kg=30.0).details["doubts"])
        assert not any("caution" in d for d in run(lifft).details["doubts"])


class TestShoulderTool:
    def test_each_arm_carries_half(self):
        result = run(shoulder_tool, load_kg=2 * 2 * 0.45359237, reach_m=16 * 0.0254)
        expected = 480 * compute_shoulder_damage(compute_shoulder_moment(2, 16))
        assert result.details["damage_per_day"] == pytest.approx(expected)

    def test_one_hand_carries_all(self):
        one = run(shoulder_tool, hands=1)
        assert {i.name: i for i in one.inputs}["load on this arm"].value == 13.0
        assert one.value > run(shoulder_tool).value

    def test_says_whose_bands_they_are(self):
        assert "bands are those of LiFFT" in shoulder_tool.METHOD.info.description


@ALL
class TestUnknown:
    def test_load_is_needed(self, method):
        result = run(method, load_kg=None)
        assert not result.is_applicable
        assert "load is not given" in result.reasons[0]

    def test_rate_and_duration_are_assumed_and_stated(self, method):
        result = run(method, frequency_per_min=None, duration_h=None)
        inputs = {i.name: i for i in result.inputs}
        assert inputs["frequency"].provenance is Provenance.ASSUMED
        assert inputs["duration"].provenance is Provenance.ASSUMED
        assert sum("not given" in a for a in result.details["assumptions"]) >= 2
        assert result.details["demanding_li"] > result.value
        assert math.isnan(run(method).details["demanding_li"])

    def test_rate_is_counted_in_a_quarter_of_an_hour(self, method):
        result = run(method, frequency_per_min=None, observed_s=900.0)
        frequency = {i.name: i for i in result.inputs}["frequency"]
        assert (frequency.value, frequency.provenance) == (1 / 15, Provenance.DERIVED)

    def test_zero_frequency_is_no_lift_a_day(self, method):
        result = run(method, frequency_per_min=0.0)
        assert result.is_applicable
        assert result.value <= run(method).value

    def test_zero_load_is_allowed(self, method):
        assert run(method, load_kg=0.0).is_applicable

    def test_no_lift(self, method):
        assert run(method, lifts=[]).reasons == ("no lift was found in the video",)


@BOTH
def test_hidden_hands_are_not_applicable(method):
    names = [f"{s}_{p}" for s in ("left", "right") for p in ("index", "pinky", "elbow", "wrist")]
    assert not run(method, hidden=names).is_applicable


class TestKim:
    @pytest.mark.parametrize(
        ("ratings", "score"),
        [((4, 2, 2, 0), 16), ((4, 7, 2, 0), 36), ((1, 25, 1, 0), 26), ((10, 1, 4, 1), 60)],
    )
    def test_scores(self, ratings, score):
        assert kim_lhc.compute_score(*ratings) == score

    @pytest.mark.parametrize(
        ("lifts", "rating"),
        [
            (0, 1),
            (9, 1),
            (10, 2),
            (39, 2),
            (40, 4),
            (199, 4),
            (200, 6),
            (499, 6),
            (500, 8),
            (999, 8),
            (1000, 10),
            (5000, 10),
        ],
    )
    def test_time_rating(self, lifts, rating):
        assert kim_lhc.rate_time(lifts) == rating

    @pytest.mark.parametrize(
        ("kg", "man", "woman"),
        [
            (4.9, 1, 1),
            (5, 1, 2),
            (9.9, 1, 2),
            (10, 2, 4),
            (14.9, 2, 4),
            (15, 2, 7),
            (19.9, 2, 7),
            (20, 4, 7),
            (24.9, 4, 7),
            (25, 4, 25),
            (29.9, 4, 25),
            (30, 7, 25),
            (39.9, 7, 25),
            (40, 25, 25),
        ],
    )
    def test_load_rating(self, kg, man, woman):
        assert (kim_lhc.rate_load(kg, "male"), kim_lhc.rate_load(kg, "female")) == (man, woman)

    @pytest.mark.parametrize(
        ("value", "level"), [(9.9, 0), (10, 1), (24.9, 1), (25, 2), (49.9, 2), (50, 3)]
    )
    def test_both_sides_of_the_bands(self, value, level):
        assert classify(kim_lhc.LEVELS, value) is kim_lhc.LEVELS[level]

    def test_2019_vectors(self):
        assert kim_lhc.rate_time_2019(150) * (kim_lhc.rate_load_2019(18, "male") + 10) == 63
        woman = kim_lhc.rate_load_2019(13, "female")
        assert kim_lhc.rate_time_2019(220) * (woman + 7 + 2) == 73.5

    @pytest.mark.parametrize(
        ("times", "rating"),
        [(1, 1), (5, 1), (20, 1.5), (35, 1.75), (50, 2), (300, 4), (2500, 10)],
    )
    def test_2019_time_is_interpolated(self, times, rating):
        assert kim_lhc.rate_time_2019(times) == pytest.approx(rating)
        assert math.isnan(kim_lhc.rate_time_2019(2501))

    @pytest.mark.parametrize(
        ("kg", "man", "woman"),
        [
            (3, 4, 6),
            (5, 4, 6),
            (5.1, 6, 9),
            (10, 6, 9),
            (15, 8, 12),
            (15.1, 11, 25),
            (20, 11, 25),
            (25, 15, 75),
            (30, 25, 85),
            (35, 35, 100),
            (40, 75, 100),
            (40.1, 100, 100),
        ],
    )
    def test_2019_load(self, kg, man, woman):
        found = kim_lhc.rate_load_2019(kg, "male"), kim_lhc.rate_load_2019(kg, "female")
        assert found == (man, woman)
        assert math.isnan(kim_lhc.rate_load_2019(2.9, "male"))

    @pytest.mark.parametrize(
        ("place", "bend", "rating"),
        [
            ((30, 80, 0), 10, 1),
            ((30, 80, 0), 19.9, 1),
            ((30, 80, 0), 20, 2),
            ((30, 80, 30), 10, 2),
            ((50, 80, 0), 10, 4),
            ((49.9, 80, 29.9), 59.9, 2),
            ((50, 80, 0), 30, 4),
            ((30, 80, 30), 30, 4),
            ((30, 20, 0), 60, 4),
            ((50, 20, 0), 60, 8),
            ((30, 160, 0), 0, 8),
        ],
    )
    def test_posture_as_this_product_reads_the_sheet(self, place, bend, rating):
        time_s = np.arange(40) / 10.0
        angles = JointAngles(time_s, np.full((40, 1), float(bend)), ("trunk_inclination",))
        upright = build_end(25, 80, 0, time_s=NAN)
        lift = dataclasses.replace(build_lift(), origin=build_end(*place), destination=upright)
        exposure = dataclasses.replace(
            build_exposure(lift, **WORK),
            angles=angles,
            subject=Subject(stature_m=1.75, sex="male"),
        )
        assert kim_lhc.METHOD.assess(exposure).details["posture_rating"] == rating

    def test_unknown_sex_is_rated_as_for_women_and_the_interval_holds_men(self):
        unknown = run(kim_lhc, subject=Subject(stature_m=1.75), load_kg=15.0)
        man = run(kim_lhc, subject=Subject(stature_m=1.75, sex="male"), load_kg=15.0)
        woman = run(kim_lhc, subject=Subject(stature_m=1.75, sex="female"), load_kg=15.0)
        assert unknown.value == woman.value > man.value
        assert unknown.interval == (man.interval[0], woman.interval[1])

    def test_missing_trunk_is_not_applicable(self):
        angles = JointAngles(np.arange(60) / 30, np.full((60, 1), NAN), ("trunk_inclination",))
        assert not run(kim_lhc, angles=angles).is_applicable

    def test_is_marked_single_source(self):
        assert kim_lhc.METHOD.info.verification == "V1"


class TestLmm:
    def test_features_of_a_known_movement(self):
        time_s = np.arange(90) / 30.0
        names = ("lumbar_flexion", "lumbar_rotation", "lumbar_bending")
        curves = np.stack([20 + 10 * time_s, 6 * time_s, -15 * time_s], axis=1)
        angles = JointAngles(time_s, curves, names)
        track = build_track([place_figure(45, 0.2)] * 90)
        found = run(lmm, track=track, angles=angles).details
        assert found["lift_rate_per_h"] == 120
        assert found["max_moment_nm"] == pytest.approx(13 * G * LEVER_M)
        assert found["max_sagittal_flexion_deg"] == pytest.approx(35.0)
        assert found["mean_twist_velocity_deg_s"] == pytest.approx(6.0)
        assert found["max_lateral_velocity_deg_s"] == pytest.approx(15.0)

    def test_trunk_angles_stand_in_and_it_is_said(self):
        angles = JointAngles(np.arange(60) / 30, np.full((60, 1), 40.0), ("trunk_flexion",))
        result = run(lmm, angles=angles)
        assert result.details["max_sagittal_flexion_deg"] == 40.0
        assert math.isnan(result.details["mean_twist_velocity_deg_s"])
        assert any("overstates" in r for r in result.reasons)

    @pytest.mark.parametrize(
        ("values", "expected"),
        [
            ((0.2, 0.4, 0.6, 0.8, 1.0), 0.6),
            ((0, 0, 0, 0, 0), 0.0),
            ((1, 1, 1, 1, 1), 1.0),
        ],
    )
    def test_probability_is_the_mean(self, values, expected):
        features = {str(k): v for k, v in enumerate(values)}
        scales = {name: [(0.0, 0.0), (1.0, 1.0)] for name in features}
        assert lmm.compute_probability(features, scales) == pytest.approx(expected)

    @pytest.mark.parametrize(("value", "expected"), [(25, 0.25), (250, 1.0), (-5, 0.0)])
    def test_scales_are_linear_and_clamped(self, value, expected):
        scale = {"x": [(0.0, 0.0), (100.0, 1.0)]}
        assert lmm.compute_probability({"x": value}, scale) == pytest.approx(expected)

    def test_missing_scale_is_an_error(self):
        with pytest.raises(DataError, match="a scale for each of x, got y"):
            lmm.compute_probability({"x": 1.0}, {"y": [(0.0, 0.0)]})

    def test_no_number_is_called_a_risk(self):
        assert lmm.METHOD.info.is_experimental
        assert run(lmm).category == "features only"
