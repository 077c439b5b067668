import dataclasses

import numpy as np
import pytest

from engine.form.phases import EXERCISE_PHASES, LIFT_PHASES, segment_lift
from engine.form.repetitions import find_repetitions, principal_movement
from tests.engine.form.performances import (
    DEPTH_DEG,
    course,
    make_known_lift,
    make_lift_clip,
    make_performance_of,
    make_squats,
)


@pytest.mark.parametrize("n", [1, 2, 5, 12])
@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_every_squat_is_counted(n, noise):
    found = find_repetitions(make_squats(n, noise=noise))
    assert len(found) == n
    assert all(r.kind == "exercise" for r in found)
    assert [r.number for r in found] == list(range(n))


def test_two_alike_movements_far_apart_do_not_hide_those_between():
    time_s = np.arange(0, 21, 1 / 30)
    turns = ((0.5, 2.5, 1.0), (3.0, 4.2, 0.7), (4.2, 5.4, 0.75), (18.0, 20.0, 1.0))
    bend = sum(depth * course(time_s, start, end) for start, end, depth in turns)
    assert len(find_repetitions(make_performance_of(time_s, bend))) == 4


def test_standing_is_no_repetition():
    time_s = np.arange(0, 5, 1 / 30)
    still = make_performance_of(time_s, np.zeros(len(time_s)), noise=2.0)
    assert find_repetitions(still) == ()


def test_a_squat_that_is_cut_off_is_not_counted():
    whole = make_squats(3, rest_s=0.5)
    part = whole.time_s < 0.5 + 2.5 * 2.0 - 0.2
    angles = dataclasses.replace(
        whole.angles,
        time_s=whole.time_s[part],
        value_deg=whole.angles.value_deg[part],
        sigma_deg=whole.angles.sigma_deg[part],
        status=whole.angles.status[part],
    )
    cut = dataclasses.replace(whole, angles=angles, hand_height_m=whole.hand_height_m[part])
    assert len(find_repetitions(cut)) == 2


def test_phases_of_a_squat_lie_where_the_course_says():
    (squat,) = find_repetitions(make_squats(1, period_s=2.0, rest_s=1.0, fps=100))
    assert tuple(p.key for p in squat.phases) == EXERCISE_PHASES
    # sin^2 passes 5 % at 0.1436 and 90 % at 0.7952 of half its length.
    bounds = [1.1436, 1.7952, 2.2048, 2.8564]
    found = [squat.start_s, squat.phases[1].start_s, squat.phases[1].end_s, squat.end_s]
    assert found == pytest.approx(bounds, abs=0.012)


def test_range_of_motion_and_symmetry_are_those_built_in():
    depth = {**DEPTH_DEG, "knee_flexion_l": 70.0}
    (squat,) = find_repetitions(make_squats(1, depth=depth))
    assert squat.range_of_motion_deg["hip_flexion_r"].value == pytest.approx(80, abs=5)
    knee = squat.asymmetry_deg["knee_flexion"]
    assert knee.value < -5
    assert knee.sigma == pytest.approx(3 * np.sqrt(2))
    assert squat.asymmetry_deg["hip_flexion"].value == pytest.approx(0)


def test_a_lift_has_five_phases_at_known_times():
    clip = make_lift_clip(fps=60)
    (lift,) = find_repetitions(clip)
    assert tuple(p.key for p in lift.phases) == LIFT_PHASES
    reach, off, rise, down, back = lift.phases
    assert reach.start_s == pytest.approx(1.0, abs=0.1)
    assert off.start_s < rise.start_s == 2.0 < off.end_s
    assert down.start_s < rise.end_s == 3.0 < down.end_s
    assert back.end_s == pytest.approx(4.0, abs=0.1)
    assert all(p.start_sigma_s > 0 and p.end_sigma_s > 0 for p in lift.phases)
    assert set(lift.tempo_s) == {"reach", "rise", "return"}


def test_a_stop_to_grip_does_not_end_the_reach():
    time_s = np.arange(0, 6, 1 / 60)
    bend = np.interp(time_s, [0, 1, 2, 2.2, 3, 3.2, 4.2, 6], [0, 0, 1, 1, 0.3, 0.3, 0, 0])
    clip = make_performance_of(time_s, bend, lifts=(make_known_lift(2.2, 3.0),))
    phases = segment_lift(clip, clip.lifts[0])
    assert phases[0].start_s == pytest.approx(1.0, abs=0.05)
    assert phases[-1].end_s == pytest.approx(4.2, abs=0.05)


def test_lifts_in_a_row_do_not_overlap():
    time_s = np.arange(0, 9, 1 / 30)
    bend = np.interp(time_s, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9], [0, 0, 1, 0.3, 0, 0, 1, 0.3, 0, 0])
    lifts = (make_known_lift(6, 7), make_known_lift(2, 3))
    one, two = find_repetitions(make_performance_of(time_s, bend, lifts=lifts))
    assert one.end_s <= two.start_s
    assert two.phases[2].start_s == 6


def test_the_principal_movement_grows_with_bending():
    squats = make_squats(2)
    signal = principal_movement(squats)
    assert np.corrcoef(signal, -squats.hand_height_m)[0, 1] > 0.999
