"""The experimental disc model: the document's vectors, and that it needs its switch."""

from __future__ import annotations

import numpy as np
import pytest

from engine.datatypes import Subject
from engine.ergonomics.base import select_methods
from engine.ergonomics.disc import (
    compute_pelvis_rotation,
    compute_polynomial_compression,
    compute_sacral_inclination,
    find_shear_limit,
    locate_l5s1,
)
from engine.ergonomics.methods.l5s1 import METHOD as L5S1
from engine.ergonomics.methods.l5s1_disc import METHOD
from engine.errors import ConfigError
from tests.engine.ergonomics.figures import build_figure_exposure

UP, FORWARD = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("trunk", "knee", "rotation"),
    [(0, 180, -1.08), (45, 180, 13.41), (90, 180, 48.10), (45, 120, 10.11), (90, 90, 36.26)],
)
def test_pelvis_rotation(trunk, knee, rotation):
    assert compute_pelvis_rotation(trunk, knee) == pytest.approx(rotation, abs=0.01)
    assert compute_sacral_inclination(trunk, knee) == pytest.approx(40 + rotation, abs=0.01)


@pytest.mark.parametrize(
    ("moments", "compression"),
    [
        ((0, 0, 0), 1067.6),
        ((100, 0, 0), 1919.5),
        ((200, 0, 0), 3831.4),
        ((150, 30, 0), 2981.7),
        ((150, 30, 20), 3156.2),
        ((150, -30, -20), 3156.2),
    ],
)
def test_polynomial(moments, compression):
    assert compute_polynomial_compression(*moments) == pytest.approx(compression, abs=0.06)


def test_place_of_a_mid_size_man():
    place = locate_l5s1(np.zeros(3), 0.1624, UP, FORWARD, "male")
    assert place == pytest.approx([-0.054, 0.076, 0.0], abs=5e-4)


@pytest.mark.parametrize(
    ("per_day", "limit"), [(0, 1000), (100, 1000), (101, 700), (1000, 700), (1001, 700)]
)
def test_shear_limit(per_day, limit):
    assert find_shear_limit(per_day) == limit


class TestMethod:
    def test_needs_the_switch(self):
        with pytest.raises(ConfigError, match="experimental"):
            select_methods(("l5s1_disc",))
        assert select_methods(("l5s1_disc",), experimental=True) == (METHOD,)

    def test_differs_from_the_simple_model_only_by_joint_and_disc(self):
        exposure = build_figure_exposure(load_kg=15.0)
        simple, disc = L5S1.assess(exposure), METHOD.assess(exposure)
        assert disc.value == pytest.approx(simple.value, rel=0.25)
        assert disc.details["static"]["lateral_nm"] == pytest.approx(0.0, abs=1e-6)

    @pytest.mark.parametrize("turn_deg", [40, 200])
    def test_turning_the_person_changes_nothing(self, turn_deg):
        one, two = (
            METHOD.assess(build_figure_exposure(load_kg=15.0, turn_deg=turn))
            for turn in (0, turn_deg)
        )
        assert one.value == pytest.approx(two.value)
        assert one.details["peak_shear_n"] == pytest.approx(two.details["peak_shear_n"])

    def test_sex_is_needed(self):
        exposure = build_figure_exposure(load_kg=15.0, subject=Subject(stature_m=1.7))
        assert not METHOD.assess(exposure).is_applicable
