"""What tells two persons apart."""

from __future__ import annotations

import numpy as np
import pytest

from engine.datatypes import PersonBox
from engine.subject.appearance import compare_appearance, describe_appearance

RED, BLUE, GREY = (200, 40, 40), (40, 60, 200), (120, 120, 120)
BOX = PersonBox(20, 10, 60, 110)


def dressed(top, bottom, background=(230, 230, 220), noise=0):
    image = np.empty((120, 80, 3), np.uint8)
    image[:] = background
    image[10:60, 25:55], image[60:110, 25:55] = top, bottom
    shift = np.random.default_rng(0).integers(-noise, noise + 1, image.shape)
    return np.clip(image.astype(int) + shift, 0, 255).astype(np.uint8)


def test_shares_sum_to_one_each():
    looks = describe_appearance(dressed(RED, BLUE), BOX)
    np.testing.assert_allclose(looks.sum(axis=1), 2.0)


def test_same_clothes_are_alike_and_others_are_not():
    one = describe_appearance(dressed(RED, GREY), BOX)
    noisy = describe_appearance(dressed(RED, GREY, noise=8), BOX)
    other = describe_appearance(dressed(BLUE, GREY), BOX)
    exchanged = describe_appearance(dressed(GREY, RED), BOX)
    assert compare_appearance(one, one) == pytest.approx(1.0)
    assert compare_appearance(one, noisy) > 0.8
    assert compare_appearance(one, other) < 0.7
    assert compare_appearance(one, exchanged) < 0.6


def test_background_hardly_counts():
    a = describe_appearance(dressed(RED, BLUE, background=(0, 0, 0)), BOX)
    b = describe_appearance(dressed(RED, BLUE, background=(255, 255, 0)), BOX)
    assert compare_appearance(a, b) > 0.95


def test_box_outside_the_picture_is_unknown():
    assert np.isnan(describe_appearance(dressed(RED, BLUE), PersonBox(200, 10, 260, 90))).all()
