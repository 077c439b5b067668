"""Whether landmarks belong to a person's box."""

from __future__ import annotations

import numpy as np
import pytest

from engine.datatypes import PersonBox
from engine.pose.association import (
    agrees_with_box,
    bound_landmarks,
    compute_box_iou,
    interpolate_box,
)

BOX = PersonBox(100, 100, 200, 400)


def landmarks(left=110, top=110, right=190, bottom=390, n=33, confidence=0.9):
    rng = np.random.default_rng(1)
    points = rng.uniform([left, top], [right, bottom], (n, 2))
    points[0], points[1] = (left, top), (right, bottom)
    return points, np.full(n, confidence)


def test_bounds_leave_guesses_out():
    points, confidence = landmarks()
    points[5], confidence[5] = (900, 900), 0.2
    points[6] = np.nan
    np.testing.assert_allclose(bound_landmarks(points, confidence), [110, 110, 190, 390])
    assert bound_landmarks(*landmarks(confidence=0.3)) is None


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        pytest.param(landmarks(), True, id="inside"),
        pytest.param(landmarks(left=300, right=380), False, id="elsewhere"),
        pytest.param(landmarks(right=390), False, id="both people"),
        pytest.param(landmarks(confidence=0.1), False, id="only guesses"),
    ],
)
def test_agreement_with_an_observed_box(points, expected):
    assert agrees_with_box(*points, BOX) is expected


def test_predicted_box_may_lag_behind():
    moved = landmarks(left=165, right=245)
    assert not agrees_with_box(*moved, BOX)
    assert agrees_with_box(*moved, BOX, is_observed=False)


def test_another_persons_box_that_fits_better_wins():
    seen = landmarks(left=150, right=230)
    other = PersonBox(145, 100, 240, 400)
    assert agrees_with_box(*seen, BOX, is_observed=False)
    assert not agrees_with_box(*seen, BOX, [other], is_observed=False)


def test_interpolated_box():
    box = interpolate_box(PersonBox(0, 0, 10, 10), PersonBox(10, 20, 30, 50), 0.25)
    assert (box.left, box.top, box.right, box.bottom) == (2.5, 5, 15, 20)


def test_overlap_of_boxes():
    assert compute_box_iou(BOX, BOX) == 1
    assert compute_box_iou(BOX, PersonBox(150, 100, 250, 400)) == pytest.approx(1 / 3)
