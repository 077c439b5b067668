import time

import numpy as np
import pytest

from engine.datatypes import JointAngles
from engine.errors import AssessmentError, DataError
from engine.form import (
    advise,
    compare_every_repetition,
    compare_performances,
    make_performance,
)
from tests.builders import make_angles, make_pose_track
from tests.engine.form.performances import (
    DEPTH_DEG,
    make_known_lift,
    make_lift_clip,
    make_performance_of,
    make_squats,
)


def test_a_performance_beside_itself_scores_100_and_nothing_is_named():
    clip = make_lift_clip()
    found = compare_performances(clip, clip)
    assert found.score.value == 100
    assert not any(d.is_beyond_error for d in found.differences)
    assert not any(t.is_beyond_error for t in found.timings)
    assert np.allclose(found.attempt_time_s, found.reference_time_s, atol=1e-6)
    assert found.notes == ()


def test_speed_alone_does_not_change_the_score():
    found = compare_performances(make_lift_clip(), make_lift_clip(stretch=1.6))
    assert found.score.value > 99
    rise = next(t for t in found.timings if t.phase == "rise")
    assert rise.difference_s.value == pytest.approx(0.6)
    assert rise.is_beyond_error
    assert found.attempt_time_at(2.0) == pytest.approx(3.2, abs=0.15)


def test_a_built_in_difference_is_measured_and_named():
    depth = {**DEPTH_DEG, "trunk_flexion": 70.0}
    found = compare_performances(make_lift_clip(), make_lift_clip(depth=depth))
    trunk = {d.phase: d for d in found.differences if d.angle == "trunk_flexion"}
    assert trunk["lift_off"].mean.value == pytest.approx(18, abs=3)
    assert trunk["rise"].peak.value == pytest.approx(18, abs=3)
    named = {d.angle for d in found.differences if d.is_beyond_error}
    assert named == {"trunk_flexion"}
    first = advise(found)[0]
    assert "your trunk leans" in first
    assert "further forward than in the reference" in first
    assert first.startswith("At lift-off")


def test_the_score_falls_with_the_difference():
    knees = [90, 75, 60, 45, 30]
    scores = [
        compare_performances(
            make_lift_clip(),
            make_lift_clip(depth={**DEPTH_DEG, "knee_flexion_l": k, "knee_flexion_r": k}),
        ).score.value
        for k in knees
    ]
    assert scores == sorted(scores, reverse=True)
    assert scores[0] == 100
    assert scores[-1] < 80


def test_a_larger_error_names_less():
    depth = {**DEPTH_DEG, "trunk_flexion": 60.0}
    sure, unsure = (
        compare_performances(make_lift_clip(sigma_deg=s), make_lift_clip(depth=depth, sigma_deg=s))
        for s in (3.0, 30.0)
    )
    assert any(d.is_beyond_error for d in sure.differences)
    assert not any(d.is_beyond_error for d in unsure.differences)
    assert unsure.score.value == 100
    assert "No joint differs" in advise(unsure)[0]


def test_other_ways_of_measuring_share_no_error():
    alike = compare_performances(make_lift_clip(), make_lift_clip())
    apart = compare_performances(make_lift_clip(), make_lift_clip(solver="least-squares"))
    assert apart.difference_sigma_deg.mean() == pytest.approx(np.hypot(3 * np.sqrt(2), 1.5))
    assert alike.difference_sigma_deg.mean() < 0.5 * apart.difference_sigma_deg.mean()
    assert "found in different ways" in apart.notes[0]


def test_other_persons_views_and_heights_are_noted():
    reference = make_lift_clip(view_azimuth_deg=90.0)
    found = compare_performances(
        reference, make_lift_clip(person="P02", view_azimuth_deg=135.0, n_views=2)
    )
    text = " ".join(found.notes)
    assert "45 degrees apart" in text
    assert "Two different persons" in text
    assert "1 and the other by 2" in text


def test_a_higher_shelf_is_noted():
    clip = make_lift_clip()
    other = make_performance_of(
        clip.time_s,
        clip.angles["hip_flexion_l"] / 80,
        lifts=(make_known_lift(2, 3, destination_cm=130),),
    )
    assert "ends 50 cm higher" in " ".join(compare_performances(clip, other).notes)


def test_another_movement_is_refused():
    raise_arms = {**dict.fromkeys(DEPTH_DEG, 0.0), "shoulder_flexion_l": 120.0}
    raise_arms |= {"shoulder_flexion_r": 120.0, "elbow_flexion_l": -60, "elbow_flexion_r": -60}
    with pytest.raises(AssessmentError, match="different movements") as refused:
        compare_performances(make_squats(1), make_squats(1, depth=raise_arms))
    assert refused.value.exit_code == 3


def test_an_angle_with_a_long_gap_is_left_out_and_said():
    clip = make_lift_clip()
    value = np.array(clip.angles.value_deg)
    column = clip.angles.names.index("elbow_flexion_l")
    value[60:90, column] = np.nan
    gappy = make_lift_clip()
    angles = JointAngles(clip.time_s, value, clip.angles.names, clip.angles.sigma_deg)
    object.__setattr__(gappy, "angles", angles)
    found = compare_performances(clip, gappy)
    assert "elbow_flexion_l" not in found.names
    assert "Elbow flexion, left" in found.notes[0]
    assert found.score.value == 100


def test_a_short_gap_is_bridged():
    clip = make_lift_clip()
    value = np.array(clip.angles.value_deg)
    value[60:64] = np.nan
    gappy = make_lift_clip()
    angles = JointAngles(clip.time_s, value, clip.angles.names, clip.angles.sigma_deg)
    object.__setattr__(gappy, "angles", angles)
    found = compare_performances(clip, gappy)
    assert found.names == clip.form_angles
    assert found.score.value > 99


def test_every_repetition_gets_its_score():
    reference = make_squats(1)
    found = compare_every_repetition(reference, make_squats(4))
    assert [c.attempt_repetition for c in found] == [0, 1, 2, 3]
    assert all(c.score.value > 99 for c in found)


def test_a_reference_is_found_inside_an_attempt_without_lifts():
    """The lift detector found nothing in the attempt; the movement is there all the same."""
    reference = make_lift_clip()
    time_s = np.arange(0, 12, 1 / 30)
    bend = np.interp(time_s, reference.time_s + 4, reference.angles["hip_flexion_l"] / 80)
    found = compare_performances(reference, make_performance_of(time_s, bend, label="long"))
    assert "No whole movement was found in long" in found.notes[0]
    assert found.score.value > 95
    assert found.attempt_time_at(2.0) == pytest.approx(6.0, abs=0.25)


def test_wrong_numbers_and_still_clips_are_refused():
    clip = make_lift_clip()
    with pytest.raises(DataError, match=r"from 1 to 1, got 4"):
        compare_performances(clip, clip, attempt_repetition=3)
    time_s = np.arange(0, 3, 1 / 30)
    still = make_performance_of(time_s, np.zeros(len(time_s)), label="still")
    with pytest.raises(DataError, match="Neither a lift nor a repeated movement"):
        compare_performances(still, clip)


def test_ten_seconds_are_compared_quickly():
    one, two = make_squats(4, rest_s=1.0), make_squats(4, rest_s=1.0, period_s=1.9)
    compare_performances(one, two)
    spent = []
    for _ in range(5):
        start = time.perf_counter()
        compare_performances(one, two)
        spent.append(time.perf_counter() - start)
    assert min(spent) < 0.3


def test_three_sentences_never_claim_more_than_was_measured():
    depth = {**DEPTH_DEG, "knee_flexion_l": 50.0, "knee_flexion_r": 50.0, "trunk_flexion": 75.0}
    found = compare_performances(make_lift_clip(), make_lift_clip(depth=depth))
    sentences = advise(found)
    assert len(sentences) == 3
    assert any("both" not in s and "your knees are bent" in s and "less" in s for s in sentences)
    for word in ("injur", "pain", "safe", "danger", "health", "risk"):
        assert not any(word in s.lower() for s in sentences)


def test_a_performance_is_made_from_what_an_assessment_left():
    track, angles = make_pose_track(), make_angles()
    made = make_performance(angles, track, label="x", solver="geometric", person="P01")
    assert made.hand_height_m.shape == angles.time_s.shape
    assert made.hand_height_m[-1] > made.hand_height_m[0]
    with pytest.raises(DataError, match="at least"):
        make_performance(
            make_angles(n_frames=2), make_pose_track(n_frames=2), label="short", solver=""
        )
