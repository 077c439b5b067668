"""The rules that follow one person's box; no network needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.config import SubjectConfig
from engine.datatypes import Frame, PersonBox, SubjectState, TrackedFrame
from engine.errors import ConfigError, NoPersonFound
from engine.subject.tracker import (
    PersonTracker,
    compute_iou,
    follow_person,
    select_first,
    select_next,
)

PICTURE = np.zeros((480, 720, 3), np.uint8)


def person(left: float, top: float = 100, width: float = 100, height: float = 300, c: float = 0.9):
    return PersonBox(left, top, left + width, top + height, confidence=c)


def follow(
    looks: Sequence[Sequence[PersonBox]], tracker: PersonTracker | None = None
) -> list[PersonBox | None]:
    """Step through frames; the tracker decides which of them it looks at."""
    tracker = tracker or PersonTracker(detect_every=1)
    return [tracker.step(seen if tracker.wants_look else None) for seen in looks]


# Equations 1 to 5


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        pytest.param((0, 0, 10, 10), (0, 0, 10, 10), 1.0, id="same"),
        pytest.param((0, 0, 10, 10), (5, 0, 15, 10), 50 / 150, id="half"),
        pytest.param((0, 0, 10, 10), (2, 2, 4, 4), 4 / 100, id="inside"),
        pytest.param((0, 0, 10, 10), (10, 0, 20, 10), 0.0, id="touching"),
        pytest.param((0, 0, 0, 0), (0, 0, 0, 0), 0.0, id="empty"),
    ],
)
def test_iou_by_hand(a, b, expected):
    assert compute_iou(PersonBox(*a), PersonBox(*b)) == pytest.approx(expected)


coordinates = st.floats(-1000, 1000, allow_nan=False).map(lambda v: round(v, 2))
boxes = st.builds(
    lambda x, y, w, h: PersonBox(x, y, x + abs(w) + 1, y + abs(h) + 1),
    coordinates,
    coordinates,
    coordinates,
    coordinates,
)


@given(a=boxes, b=boxes)
def test_iou_is_symmetric_and_a_share(a, b):
    assert compute_iou(a, b) == pytest.approx(compute_iou(b, a))
    assert 0 <= compute_iou(a, b) <= 1


def test_first_frame_takes_the_largest_confident_person_not_the_most_confident():
    near, far = person(0, height=300, c=0.75), person(300, height=100, c=0.99)
    faint_giant = person(100, top=0, width=300, height=480, c=0.69)
    chosen = select_first([far, near, faint_giant], threshold=0.7, step=0.1, floor=0.2)
    assert chosen is near


@pytest.mark.parametrize(
    ("confidences", "expected"),
    [
        pytest.param((0.7,), 0, id="on the threshold"),
        pytest.param((0.45, 0.55), 1, id="first level with anybody"),
        pytest.param((0.41, 0.48), 0, id="same level: larger wins"),
        pytest.param((0.2,), 0, id="on the floor"),
        pytest.param((0.19,), None, id="under the floor"),
        pytest.param((), None, id="nobody"),
    ],
)
def test_first_threshold_is_lowered_in_steps(confidences, expected):
    # Earlier ones are larger.
    seen = [person(0, height=300 - 10 * i, c=c) for i, c in enumerate(confidences)]
    chosen = select_first(seen, threshold=0.7, step=0.1, floor=0.2)
    assert chosen is (None if expected is None else seen[expected])


def test_sum_and_literal_form_of_eq_5_differ():
    previous = person(0)
    same = person(10, c=0.6)  # IoU 90 / 110
    elsewhere = person(400, c=0.9)  # IoU 0
    assert compute_iou(previous, same) == pytest.approx(9 / 11)
    by_sum = select_next([same, elsewhere], previous, threshold=0.3, score="sum")
    literal = select_next([same, elsewhere], previous, threshold=0.3, score="literal")
    assert by_sum == replace(same, iou=pytest.approx(9 / 11))
    assert literal == replace(elsewhere, iou=0.0)


@pytest.mark.parametrize(
    ("weight", "expected"),
    [pytest.param(1.0, 10, id="0.6 + 0.82 > 0.9"), pytest.param(0.3, 400, id="0.6 + 0.25 < 0.9")],
)
def test_weight_of_the_overlap(weight, expected):
    chosen = select_next(
        [person(10, c=0.6), person(400, c=0.9)], person(0), threshold=0.3, iou_weight=weight
    )
    assert chosen is not None
    assert chosen.left == expected


def test_later_frames_drop_faint_boxes():
    assert select_next([person(0, c=0.29)], person(0), threshold=0.3) is None


# Holding, losing, finding again


def test_states_of_a_person_who_stays():
    states = [b.state for b in follow([[person(0)]] * 4)]
    assert states == [SubjectState.INIT, *[SubjectState.TRACKED] * 3]


def test_unseen_person_is_held_at_constant_velocity_then_lost():
    walk = [[person(10.0 * i)] for i in range(10)]
    tracker = PersonTracker(detect_every=1, hold_frames=5)
    boxes = follow([*walk, *[[]] * 12], tracker)
    held = boxes[10:]
    states = [SubjectState.LOST if b is None else b.state for b in held]
    assert states[:5] == [SubjectState.HELD] * 5
    assert set(states[7:]) == {SubjectState.LOST}
    # Ten px a frame so far; the prediction goes on and slows down, never back.
    steps = np.diff([boxes[9].left, *(b.left for b in held[:5])])
    assert steps[0] == pytest.approx(10.0, rel=0.05)
    assert np.all(steps > 5)
    assert np.all(np.diff(steps) < 0)


def test_lost_person_is_found_again_nearby_only():
    gone = [[person(100)]] * 5 + [[]] * 30
    near, far = [person(130)], [person(600)]
    assert [b for b in follow([*gone, *[near] * 4]) if b][-1].left == 130
    tracker = PersonTracker(detect_every=1)
    assert follow([*gone, *[far] * 4], tracker)[-1] is None
    assert tracker.others[0].left == 600


def test_neighbourhood_grows_while_nobody_is_found():
    gone = [[person(100)]] * 5 + [[]] * 120
    assert follow([*gone, *[[person(600)]] * 4])[-1].left == 600


def test_restart_says_so():
    boxes = follow([[person(100)]] * 3 + [[]] * 30 + [[person(100)]] * 6)
    assert SubjectState.INIT in [b.state for b in boxes[30:] if b]


def test_who_walks_away_is_not_replaced_by_a_bystander():
    bystander = person(500, c=0.95)
    together = [[person(100 - 12 * i), bystander] for i in range(16)]
    boxes = follow([*together, *[[bystander]] * 200])
    assert boxes[-1] is None
    assert all(b is None or b.left < 200 for b in boxes)


def test_a_box_elsewhere_of_another_size_is_not_taken():
    boxes = follow([[person(100)]] * 3 + [[person(600, width=30, height=90, c=0.99)]] * 3)
    assert [b.state for b in boxes[3:]] == [SubjectState.HELD] * 3


def test_faint_first_guess_gives_way_to_a_convincing_person():
    chair, worker = person(50, c=0.25), person(500, c=0.8)
    boxes = follow([[chair]] * 5 + [[chair, worker]] * 3)
    assert boxes[4].left == 50
    assert boxes[-1].left == 500


# A user's box


def test_named_person_is_followed_not_the_largest():
    small, large = person(500, height=150, width=60, c=0.6), person(100, c=0.9)
    tracker = PersonTracker(detect_every=1, box=(490, 90, 570, 260))
    boxes = follow([[large, small]] * 5, tracker)
    assert {b.left for b in boxes} == {500}


def test_named_box_counts_even_if_the_detector_sees_nobody_there():
    tracker = PersonTracker(detect_every=1, box=(10, 20, 110, 320))
    box = tracker.step([])
    assert (box.left, box.top, box.right, box.bottom, box.state) == (
        10,
        20,
        110,
        320,
        SubjectState.INIT,
    )


def test_named_box_outside_the_picture_is_refused():
    frames = iter([Frame(0, 0.0, PICTURE)])
    with pytest.raises(ConfigError, match="720 x 480"):
        list(follow_person(frames, lambda image: [], box=(900, 10, 1000, 200)))


# Two people


def crossing(front: str) -> list[list[PersonBox]]:
    """Two people walk through each other; while they overlap much only the front one is seen."""
    looks = []
    for i in range(60):
        a, b = person(50 + 8 * i, c=0.8), person(522 - 8 * i, top=104, c=0.7)
        covered = compute_iou(a, b) > 0.5
        looks.append([a] if covered and front == "a" else [b] if covered else [a, b])
    return looks


@pytest.mark.parametrize("front", ["a", "b"])
def test_crossing_people_keep_their_ways(front):
    looks = crossing(front)
    boxes = follow(looks, PersonTracker(detect_every=15, box=(50, 100, 150, 400)))
    assert boxes[-1].left == pytest.approx(50 + 8 * 59, abs=10)


def test_looks_correct_an_exchange():
    """They meet, one vanishes behind the other, and both turn back: only clothes can tell."""
    red, blue = 2 * np.eye(2)  # shares of colours and of brightness sum to 1 each

    def way(i: int) -> float:
        return 50 + 8 * min(i, 60 - i)

    looks, clothes = [], []
    for i in range(60):
        a, b = person(way(i), c=0.8), person(572 - way(i), c=0.7)
        covered = compute_iou(a, b) > 0.5
        looks.append([b] if covered else [a, b])
        clothes.append({id(a): red, id(b): blue})

    tracker = PersonTracker(box=(50, 100, 150, 400))
    wearing = []
    for seen, worn in zip(looks, clothes, strict=True):

        def describe(box: PersonBox, seen=seen, worn=worn):
            nearest = min(seen, key=lambda p: abs(p.left - box.left))
            return np.tile(worn[id(nearest)], (2, 1))

        box = tracker.step(seen if tracker.wants_look else None, describe)
        wearing.append(describe(box)[0, 0])
    assert wearing[0] == 2
    assert wearing[-1] == 2


# How often the detector looks


def test_detector_rests_while_there_is_no_doubt():
    tracker = PersonTracker(detect_every=15)
    n_looks = 0
    for _ in range(150):
        n_looks += tracker.wants_look
        tracker.step([person(100)] if tracker.wants_look else None)
    assert n_looks <= 14


def test_detector_looks_at_every_frame_while_somebody_is_near():
    tracker = PersonTracker(detect_every=15)
    n_looks = 0
    for _i in range(40):
        n_looks += tracker.wants_look
        tracker.step([person(100), person(190)] if tracker.wants_look else None)
    assert n_looks >= 39


def test_detector_looks_more_often_while_somebody_else_is_in_the_picture():
    tracker = PersonTracker(detect_every=15)
    n_looks = 0
    for _ in range(120):
        n_looks += tracker.wants_look
        tracker.step([person(100), person(500)] if tracker.wants_look else None)
    assert 25 <= n_looks <= 35


def test_no_look_without_need_uses_the_prediction():
    tracker = PersonTracker(detect_every=15)
    lefts = []
    for i in range(40):
        box = tracker.step([person(100 + 2.0 * i)] if tracker.wants_look else None)
        lefts.append(box.left)
    # Never more than the slowing of a prediction over 15 frames behind.
    assert np.abs(np.array(lefts[5:]) - (100 + 2.0 * np.arange(5, 40))).max() < 12


# The stream


def stream(n: int):
    return (Frame(i, i / 30, PICTURE) for i in range(n))


def test_every_frame_comes_out_in_order_with_its_box():
    tracked: list[TrackedFrame] = list(
        follow_person(stream(20), lambda image: [person(100), person(400, c=0.6)])
    )
    assert [t.frame.index for t in tracked] == list(range(20))
    assert all(t.box is not None for t in tracked)
    assert tracked[0].is_anchor
    assert any(not t.is_anchor for t in tracked)
    assert tracked[-1].others[0].left == 400


def test_frames_are_read_only_when_asked_for():
    read = []

    def frames():
        for frame in stream(100):
            read.append(frame.index)
            yield frame

    follower = follow_person(frames(), lambda image: [person(100)])
    next(follower)
    next(follower)
    assert read == [0, 1]


def test_few_frames_a_second_are_all_looked_at():
    frames = (Frame(i, float(i), PICTURE) for i in range(20))
    tracked = list(follow_person(frames, lambda image: [person(100)]))
    assert all(t.is_anchor for t in tracked)


def test_nobody_in_the_whole_video():
    with pytest.raises(NoPersonFound, match="12 pictures"):
        list(follow_person(stream(12), lambda image: []))


def test_person_who_leaves_half_way_is_no_error():
    seen = iter([[person(100)]] * 40 + [[]] * 1000)
    tracked = list(follow_person(stream(120), lambda image: next(seen), detect_every=1))
    assert tracked[30].box is not None
    assert tracked[-1].box is None


def test_settings_are_those_of_the_configuration():
    import dataclasses
    import inspect

    parameters = inspect.signature(follow_person).parameters
    for field in dataclasses.fields(SubjectConfig):
        assert parameters[field.name].default == field.default


@given(
    confidences=st.lists(
        st.lists(st.tuples(st.floats(0, 700), st.floats(0.0, 1.0)), max_size=4),
        min_size=1,
        max_size=40,
    )
)
def test_any_detections_give_finite_boxes_and_valid_states(confidences):
    tracker = PersonTracker()
    for seen in confidences:
        box = tracker.step([person(x, c=c) for x, c in seen] if tracker.wants_look else None)
        if box is not None:
            assert math.isfinite(box.left + box.top + box.right + box.bottom)
            assert box.state is not SubjectState.LOST
