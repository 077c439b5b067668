"""The method `l5s1`: peak, limits, assumptions, doubts, missing parts."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from engine.datatypes import Provenance, Subject
from engine.ergonomics.methods.l5s1 import LEVELS, METHOD
from engine.ergonomics.work import classify
from tests.engine.ergonomics.figures import build_figure_exposure, build_track, place_figure

NAN = math.nan
ADULT = Subject(stature_m=1.75, mass_kg=80.0, sex="male")


def assess(load_kg=15.0, **options):
    return METHOD.assess(build_figure_exposure(load_kg=load_kg, **options))


@pytest.mark.parametrize(
    ("value", "level"),
    [(3400.0, 0), (3400.1, 1), (6400.0, 1), (6400.1, 2), (math.inf, 2)],
)
def test_both_sides_of_each_limit(value, level):
    assert classify(LEVELS, value) is LEVELS[level]


class TestPeak:
    def test_value_is_the_peak_while_the_load_is_held(self):
        angles = np.r_[np.full(20, 80.0), np.linspace(20, 70, 20), np.full(20, 10.0)]
        track = build_track([place_figure(a, 0.2) for a in angles])
        lift = dataclasses.replace(build_figure_exposure().lifts[0], start_s=0.7, end_s=1.6)
        result = assess(track=track, lifts=[lift])
        assert result.details["peak_s"] == pytest.approx(39 / 30)
        assert result.value == result.details["static"]["compression_n"]
        assert result.unit == "N"

    @pytest.mark.parametrize("change", [{"load_kg": 20.0}, {"reach_m": 0.3}, {"trunk_deg": 60.0}])
    def test_more_load_distance_or_bending_is_more_compression(self, change):
        assert assess(**change).value > assess().value

    def test_worst_lift_is_the_headline(self):
        first = build_figure_exposure().lifts[0]
        second = dataclasses.replace(first, start_s=1.6, end_s=1.9)
        poses = [place_figure(20, 0.1)] * 47 + [place_figure(60, 0.3)] * 13
        result = assess(track=build_track(poses), lifts=[first, second])
        assert result.details["governing_lift"] == 1
        assert [r.lift_index for r in result.per_lift] == [0, 1]
        assert result.value == max(r.value for r in result.per_lift)

    def test_cumulative_moment_is_moment_times_time(self):
        result = assess(load_kg=0.0)
        moment = result.details["static"]["flexion_nm"]
        assert result.details["cumulative_moment_nm_s"] == pytest.approx(moment * 60 / 30)
        assert result.details["cumulative_moment_lift_nm_s"] == pytest.approx(moment * 31 / 30)

    def test_the_worked_numbers_add_up(self):
        result = assess()
        at = result.details["static"]
        assert at["compression_n"] == pytest.approx(
            at["flexion_nm"] / 0.056 + at["shear_n"], rel=1e-6
        )  # at 45 degrees the weight along and across the trunk is equal
        assert f"{at['compression_n']:.0f} N" in " ".join(result.steps)


class TestInterval:
    def test_is_that_of_the_standard_error(self):
        result = assess(sigma=0.02)
        low, high = result.interval
        sigma = result.details["compression_sigma_n"]
        assert (high - low) / 2 == pytest.approx(1.96 * sigma)
        assert low < result.value < high

    def test_shares_of_the_error_sum_to_one_and_name_the_largest(self):
        sure, unsure = assess(sigma=0.0).details, assess(sigma=0.2).details
        for details in (sure, unsure):
            assert sum(details["uncertainty_shares"].values()) == pytest.approx(1.0)
        assert sure["uncertainty_shares"]["the keypoints"] == 0.0
        assert unsure["dominant_input"] == "the keypoints"
        assert assess(sigma=NAN).details["dominant_input"] == ""

    def test_unknown_error_is_an_unknown_interval_and_a_doubt(self):
        result = assess(sigma=NAN)
        assert np.isnan(result.interval).all()
        assert any("no interval" in d for d in result.details["doubts"])


class TestUnknown:
    def test_no_load_is_the_bodys_own_part(self):
        bare, zero = assess(load_kg=None), assess(load_kg=0.0)
        assert bare.value == zero.value
        assert any("the least it can be" in d for d in bare.details["doubts"])
        assert not any("the least it can be" in d for d in zero.details["doubts"])

    def test_unknown_mass_and_sex_are_stated(self):
        result = assess(subject=Subject(stature_m=1.75))
        inputs = {i.name: i for i in result.inputs}
        assert inputs["body mass"].provenance is Provenance.ASSUMED
        assert inputs["sex"].provenance is Provenance.ASSUMED
        assert any("Body mass not given" in r for r in result.reasons)
        assert any("Sex not given" in r for r in result.reasons)
        known = assess()
        width = [np.ptp(r.interval) for r in (result, known)]
        assert width[0] > 1.1 * width[1]

    @pytest.mark.parametrize(
        "subject",
        [
            dataclasses.replace(ADULT, stature_m=1.2, mass_kg=30.0),
            dataclasses.replace(ADULT, age_y=14.0),
        ],
        ids=["small", "young"],
    )
    def test_children_raise_a_doubt(self, subject):
        doubts = assess(subject=subject).details["doubts"]
        assert any("made for adults" in d for d in doubts)

    def test_no_lift_is_not_applicable(self):
        result = assess(lifts=[])
        assert not result.is_applicable
        assert result.reasons == ("no lift was found in the video",)


class TestMissing:
    def track_with_gap(self, first, last):
        track = build_figure_exposure().track
        position = track.position.copy()
        position[first:last] = NAN
        return dataclasses.replace(track, position=position, status=None)

    def test_gap_over_the_lift_off_is_a_doubt(self):
        result = assess(track=self.track_with_gap(15, 18))
        assert any("may be higher" in d for d in result.details["doubts"])

    def test_short_gap_in_the_middle_is_none(self):
        result = assess(track=self.track_with_gap(28, 30))
        assert not any("may be higher" in d for d in result.details["doubts"])

    def test_gap_over_the_whole_lift_refuses_that_lift(self):
        result = assess(track=self.track_with_gap(10, 50))
        assert not result.is_applicable
        assert math.isnan(result.value)
        assert "could not be seen" in result.reasons[0]

    def test_one_lift_hidden_does_not_hide_the_other(self):
        first = build_figure_exposure().lifts[0]
        second = dataclasses.replace(first, start_s=1.7, end_s=1.9)
        result = assess(track=self.track_with_gap(10, 48), lifts=[first, second])
        assert result.is_applicable
        assert result.details["n_assessed"] == 1
        assert any(r.startswith("Lift 1 was not assessed") for r in result.reasons)

    def test_mirrored_arm_is_stated(self):
        hidden = ("left_elbow", "left_wrist", "left_index", "left_pinky")
        result = assess(hidden=hidden)
        assert any("100 % of the frames" in a for a in result.details["assumptions"])
        lift = dataclasses.replace(build_figure_exposure().lifts[0], hands=1)
        one = assess(hidden=hidden, lifts=[lift])
        assert any("one hand lifts" in d for d in one.details["doubts"])


class TestConditions:
    def test_asymmetric_lift_is_a_doubt(self):
        lift = dataclasses.replace(build_figure_exposure().lifts[0], hands=1)
        doubts = assess(trunk_deg=5.0, reach_m=0.0, lifts=[lift]).details["doubts"]
        assert any("sideways" in d for d in doubts)

    def test_doubtful_measuring_conditions_are_passed_on(self):
        doubts = assess(conditions=("camera_moved",)).details["doubts"]
        assert any("camera moved" in d for d in doubts)

    def test_seated_people_are_assessed(self):
        assert assess(conditions=("seated",)).is_applicable

    def test_low_frame_rate_has_no_dynamic_value(self):
        track = build_track([place_figure(45, 0.2)] * 60, fps=15.0)
        result = assess(track=track)
        assert math.isnan(result.details["dynamic"]["compression_n"])
        assert any("not known" in s for s in result.steps)
