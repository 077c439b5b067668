"""EN 1005-4 and ISO 11226: zones, verdicts by frequency, holding times."""

from __future__ import annotations

import math

import numpy as np
import pytest

from engine.ergonomics.methods.posture_zones import METHOD, PARTS
from engine.ergonomics.posture import read_posture
from tests.engine.ergonomics.exposures import build_lift
from tests.engine.ergonomics.postures import build_posture

NAN = math.nan
BY_KEY = {part.key: part for part in PARTS}


def zone_of(key, **changes):
    posture = read_posture(build_posture(**changes))
    scores = METHOD.score(posture, posture.values(), "neutral")
    return int(np.asarray(scores[key])[0, 0])


def verdict_of(title, **changes):
    details = METHOD.assess(build_posture(**changes)).details
    return next(row for row in details["parts"] if row["part"] == title)


def bump(angle_deg, *, seconds=1.0, n_frames=120, rest=0.0):
    curve = np.full(n_frames, rest)
    curve[30 : 30 + round(30 * seconds)] = angle_deg
    return curve


def arm(angle_deg):
    """Return where the elbow is for an upper arm raised forward."""
    a = math.radians(angle_deg)
    return {"elbow": (0.3 * math.sin(a), 1.44 - 0.3 * math.cos(a), 0.18)}


class TestZones:
    @pytest.mark.parametrize(
        ("flexion", "zone"),
        [(-5.1, 3), (-5.0, 1), (0.0, 1), (20.0, 1), (20.1, 2), (60.0, 2), (60.1, 3), (NAN, 0)],
    )
    def test_trunk(self, flexion, zone):
        if math.isnan(flexion):
            assert read_posture(build_posture(trunk_flexion=flexion)) is None
        else:
            assert zone_of("trunk", trunk_flexion=flexion) == zone

    @pytest.mark.parametrize("name", ["trunk_twist", "trunk_lateral_bend"])
    @pytest.mark.parametrize(("angle", "zone"), [(10.0, 1), (10.1, 3), (-10.0, 1), (-10.1, 3)])
    def test_twist_and_side_bend(self, name, angle, zone):
        assert zone_of("trunk_side", **{name: angle}) == zone

    @pytest.mark.parametrize(
        ("elevation", "zone"), [(0.0, 1), (19.9, 1), (20.1, 2), (59.9, 2), (60.1, 3), (170.0, 3)]
    )
    def test_upper_arm(self, elevation, zone):
        assert zone_of("upper_arm", points=arm(elevation)) == zone

    @pytest.mark.parametrize(
        ("neck", "trunk", "zone"), [(40.0, 0.0, 1), (40.1, 0.0, 3), (20.0, 20.1, 3), (-5.1, 0, 3)]
    )
    def test_head(self, neck, trunk, zone):
        assert zone_of("head", neck=neck, trunk_flexion=trunk) == zone


class TestMovement:
    @pytest.mark.parametrize(
        ("angle", "per_min", "verdict"),
        [(15.0, 10.0, 1), (40.0, 1.0, 2), (40.0, 10.0, 2), (70.0, 1.9, 2), (70.0, 2.0, 3),
         (-15.0, 1.0, 2), (-15.0, 2.0, 3)],
    )  # fmt: skip
    def test_trunk_by_frequency(self, angle, per_min, verdict):
        row = verdict_of(
            "trunk flexion",
            n_frames=120,
            trunk_flexion=bump(angle),
            frequency_per_min=per_min,
        )
        # Without a lift there is no cycle to count by.
        assert row["en_1005_4"] == min(verdict, 2)
        details = METHOD.assess(
            build_posture(
                build_lift(), n_frames=120, trunk_flexion=bump(angle), frequency_per_min=per_min
            )
        ).details
        assert details["parts"][0]["en_1005_4"] == verdict

    def test_twice_bent_in_one_cycle_counts_twice(self):
        curve = bump(70.0)
        curve[80:100] = 70.0
        details = METHOD.assess(
            build_posture(build_lift(), n_frames=120, trunk_flexion=curve, frequency_per_min=1.0)
        ).details
        assert details["parts"][0]["en_1005_4"] == 3

    def test_held_there_is_not_acceptable(self):
        row = verdict_of(
            "trunk flexion", n_frames=240, trunk_flexion=bump(70, seconds=5, n_frames=240)
        )
        assert row["en_1005_4"] == 3

    @pytest.mark.parametrize(("per_min", "verdict"), [(1.0, 1), (2.0, 2)])
    def test_arms_in_the_middle_zone(self, per_min, verdict):
        exposure = build_posture(build_lift(), points=arm(40), frequency_per_min=per_min)
        row = METHOD.assess(exposure).details["parts"][2]
        assert row["en_1005_4"] == verdict

    def test_an_unknown_frequency_is_rare_with_a_doubt(self):
        result = METHOD.assess(build_posture(build_lift(), n_frames=120, trunk_flexion=bump(70)))
        assert result.value == 2
        assert any("from 2 on it would be not acceptable" in d for d in result.details["doubts"])
        assert result.details["worst_case"] == 3

    def test_a_minute_of_work_is_counted(self):
        curve = np.tile(bump(70.0, n_frames=300), 7)  # 7 bends in 70 s
        exposure = build_posture(n_frames=2100, trunk_flexion=curve)
        result = METHOD.assess(exposure)
        assert result.value == 3
        assert result.details["doubts"] == []


class TestHolding:
    @pytest.mark.parametrize(
        ("key", "angle", "limit"),
        [("trunk", 20.0, 240.0), ("trunk", 40.0, 150.0), ("trunk", 60.0, 60.0),
         ("trunk", 61.0, 0.0), ("trunk", 10.0, math.inf), ("upper_arm", 40.0, 120.0),
         ("upper_arm", 20.0, 180.0), ("head", 55.0, 270.0), ("head", 25.0, 480.0),
         ("head", 85.0, 60.0), ("head", 85.1, 0.0),
         ("trunk_side", 10.0, math.inf), ("trunk_side", 10.1, 0.0)],
    )  # fmt: skip
    def test_vectors(self, key, angle, limit):
        assert BY_KEY[key].hold_limit(angle) == pytest.approx(limit)

    def test_a_hold_beyond_its_time_fails_iso_only(self):
        n = 30 * 70
        row = verdict_of("trunk flexion", n_frames=n, trunk_flexion=np.full(n, 59.0))
        assert (row["iso_11226"], row["en_1005_4"], row["verdict"]) == (3, 2, 3)

    def test_a_short_hold_passes(self):
        row = verdict_of("trunk flexion", n_frames=300, trunk_flexion=np.full(300, 59.0))
        assert row["iso_11226"] == 1

    def test_a_held_twist_fails_both(self):
        row = verdict_of("trunk side-bend or twist", n_frames=150, trunk_twist=np.full(150, 15.0))
        assert (row["iso_11226"], row["en_1005_4"]) == (3, 3)


class TestResult:
    def test_neutral_is_acceptable(self):
        result = METHOD.assess(build_posture())
        assert (result.value, result.category) == (1, "acceptable")
        assert result.interval == (1.0, 1.0)

    def test_errors_across_a_bound_widen_the_interval(self):
        result = METHOD.assess(build_posture(trunk_flexion=19.0, sigma=2.0))
        assert result.interval[1] > 1

    def test_an_unseen_part_is_not_judged(self):
        row = verdict_of("head inclination", neck=NAN)
        assert row["en_1005_4"] is None

    def test_no_trunk_is_not_judged(self):
        assert not METHOD.assess(build_posture(trunk_flexion=NAN)).is_applicable

    def test_single_source_is_said(self):
        assert METHOD.info.verification == "V1"
        assert "single source" in METHOD.info.reference
