"""L5/S1 mechanics: printed vectors, closed forms and properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.ergonomics.segments import ABOVE_L5S1, DE_LEVA, share_above_l5s1
from engine.ergonomics.spine import (
    build_trunk_axes,
    compute_planar_forces,
    compute_top_down,
    resolve_forces,
)
from engine.errors import ShapeError

G_OF_VECTORS = 9.81
G = 9.80665


class TestSegments:
    @pytest.mark.parametrize("sex", ["male", "female"])
    def test_masses_sum_to_the_body(self, sex):
        table = DE_LEVA[sex]
        pairs = ("upper arm", "forearm", "hand", "thigh", "shank", "foot")
        total = table["head"].mass + table["trunk"].mass + 2 * sum(table[n].mass for n in pairs)
        assert total == pytest.approx(1.0, abs=2e-4)

    @pytest.mark.parametrize("sex", ["male", "female"])
    def test_trunk_parts_sum_to_the_trunk(self, sex):
        table = DE_LEVA[sex]
        parts = sum(table[f"{part} trunk"].mass for part in ("upper", "middle", "lower"))
        assert parts == pytest.approx(table["trunk"].mass, abs=2e-4)

    @pytest.mark.parametrize(
        ("sex", "trunk", "total"), [("male", 0.3788, 0.547), ("female", 0.3634, 0.520)]
    )
    def test_share_above_l5s1(self, sex, trunk, total):
        assert ABOVE_L5S1[sex].trunk == pytest.approx(trunk, abs=1e-4)
        assert ABOVE_L5S1[sex].total == pytest.approx(total, abs=6e-4)

    def test_the_trunk_centre_follows_from_its_parts(self):
        for sex in ("male", "female"):
            table = DE_LEVA[sex]
            upper, middle, lower = (table[f"{p} trunk"] for p in ("upper", "middle", "lower"))
            down = [
                upper.centre * upper.length_mm,
                upper.length_mm + middle.centre * middle.length_mm,
                # The upper half of the lower part, taken as even.
                upper.length_mm + middle.length_mm + 0.25 * lower.length_mm,
            ]
            mass = [upper.mass, middle.mass, 0.5 * lower.mass]
            whole = upper.length_mm + middle.length_mm + lower.length_mm
            height = whole - np.average(down, weights=mass)
            share = height / table["trunk"].length_mm
            assert ABOVE_L5S1[sex].trunk_centre == pytest.approx(share, abs=0.02)

    def test_unknown_sex_is_the_mean(self):
        both = share_above_l5s1(None)
        assert both.head == pytest.approx((0.0694 + 0.0668) / 2)
        assert both.total == pytest.approx((0.547 + 0.520) / 2, abs=1e-3)


class TestLinkEquation:
    @pytest.mark.parametrize(
        ("moment", "weight", "angle", "lever", "compression", "shear"),
        [
            (100, 400, 45, 0.050, 2282.84, 282.84),
            (100, 400, 45, 0.060, 1949.51, 282.84),
            (200, 600, 0, 0.056, 4171.43, 0.0),
            (150, 550, 60, 0.056, 2953.57, 476.31),
            (250, 650, 90, 0.050, 5000.00, 650.00),
        ],
    )
    def test_vectors(self, moment, weight, angle, lever, compression, shear):
        found = compute_planar_forces(moment, weight, angle, lever_m=lever)
        assert found == (pytest.approx(compression, abs=0.01), pytest.approx(shear, abs=0.01))


def _axes(inclination_deg):
    angle = np.radians(inclination_deg)
    shoulders = np.array([[0.5 * np.sin(angle), 0.5 * np.cos(angle), 0.0]])
    return build_trunk_axes(np.zeros((1, 3)), shoulders, np.array([[0.0, 0.0, 1.0]]))


def _whole_model(sex, mass, places, load, load_place, inclination, *, lever, up_m_s2):
    shares = ABOVE_L5S1[sex]
    # The document's rounded masses of both arms together.
    parts = [shares.trunk, shares.head, 2 * shares.upper_arm, 2 * shares.forearm, 2 * shares.hand]
    kg = np.array([*(mass * s for s in parts), load])
    points = np.zeros((1, 6, 3))
    points[0, :5, :2] = places
    points[0, 5, :2] = load_place
    acceleration = np.zeros_like(points)
    acceleration[0, 5, 1] = up_m_s2
    moment, force = compute_top_down(points, kg, acceleration)
    return resolve_forces(moment, force, _axes(inclination), lever_m=lever)


B1 = (
    "male",
    80,
    [(0.18, 0.18), (0.42, 0.42), (0.38, 0.22), (0.42, 0), (0.45, -0.18)],
    15,
    (0.48, -0.22),
    45,
)
B4 = (
    "female",
    62,
    [(0, 0.27), (0.03, 0.60), (0.02, 0.33), (0.15, 0.15), (0.30, 0.15)],
    5,
    (0.36, 0.15),
    0,
)
B5 = ("male", 80, [(0, 0)] * 5, 0, (0, 0), 0)
B6 = (
    "female",
    62,
    [(0.26, 0.05), (0.58, 0.12), (0.48, -0.08), (0.50, -0.30), (0.52, -0.48)],
    12,
    (0.55, -0.55),
    80,
)


class TestWholeModel:
    @pytest.mark.parametrize(
        ("case", "lever", "up", "moment", "compression", "shear"),
        [
            (B1, 0.056, 0.0, 178.17, 3589.2, 407.6),
            (B1, 0.050, 0.0, 178.17, 3971.0, 407.6),
            (B1, 0.056, 3.0, 199.77, 4006.7, 439.4),
            (B4, 0.056, 0.0, 24.06, 794.9, 0.0),
            (B5, 0.056, 0.0, 0.0, 429.3, 0.0),
            (B6, 0.056, 0.0, 172.60, 3157.6, 427.4),
        ],
        ids=["B1", "B2", "B3", "B4", "B5", "B6"],
    )
    def test_vectors(self, case, lever, up, moment, compression, shear, monkeypatch):
        monkeypatch.setattr("engine.ergonomics.spine.GRAVITY_M_S2", G_OF_VECTORS)
        found = _whole_model(*case, lever=lever, up_m_s2=up)
        assert found.flexion_nm[0] == pytest.approx(moment, abs=0.05)
        assert found.compression_n[0] == pytest.approx(compression, abs=1.0)
        assert found.shear_n[0] == pytest.approx(shear, abs=0.1)

    def test_a_tenth_of_a_metre_further_costs_load_times_g_over_the_lever(self):
        near, far = (
            _whole_model(*B1[:4], (x, -0.22), 45, lever=0.056, up_m_s2=0.0) for x in (0.48, 0.58)
        )
        difference = far.compression_n[0] - near.compression_n[0]
        assert difference == pytest.approx(15 * G * 0.10 / 0.056)


class TestThreeDirections:
    def test_a_load_to_the_right_bends_to_the_right(self):
        moment, force = compute_top_down(np.array([[[0.0, 0.3, 0.4]]]), [10.0])
        found = resolve_forces(moment, force, _axes(0))
        assert found.lateral_nm[0] == pytest.approx(10 * G * 0.4)
        assert found.flexion_nm[0] == pytest.approx(0.0)
        assert found.twist_nm[0] == pytest.approx(0.0)

    def test_pushing_the_load_forward_on_the_right_turns_to_the_left(self):
        acceleration = np.array([[[-2.0, 0.0, 0.0]]])
        moment, _ = compute_top_down(np.array([[[0.0, 0.0, 0.4]]]), [10.0], acceleration)
        # The hands feel +20 N forward at 0.4 m to the right: a turn to the left is positive.
        assert moment[0, 1] == pytest.approx(10 * 2.0 * 0.4)

    @given(
        turn=st.floats(-180, 180),
        inclination=st.floats(0, 90),
        place=st.tuples(*[st.floats(-0.8, 0.8)] * 3),
    )
    def test_turning_the_person_changes_nothing(self, turn, inclination, place):
        angle = np.radians(turn)
        about = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        )
        tilt = np.radians(inclination)
        shoulders = np.array([0.5 * np.sin(tilt), 0.5 * np.cos(tilt), 0.0])
        results = []
        for rotation in (np.eye(3), about):
            axes = build_trunk_axes(
                np.zeros((1, 3)), (rotation @ shoulders)[None], (rotation @ [0, 0, 1.0])[None]
            )
            moment, force = compute_top_down((rotation @ np.array(place))[None, None], [12.0])
            results.append(np.concatenate(list(vars(resolve_forces(moment, force, axes)).values())))
        np.testing.assert_allclose(*results, atol=1e-6)

    def test_bending_backwards_adds_no_muscle_force(self):
        moment, force = compute_top_down(np.array([[[-0.3, 0.3, 0.0]]]), [10.0])
        found = resolve_forces(moment, force, _axes(0))
        assert found.flexion_nm[0] < 0
        assert found.compression_n[0] == pytest.approx(10 * G)

    def test_a_missing_point_is_a_missing_result(self):
        lever = np.array([[[0.1, 0.1, 0.0], [np.nan] * 3]])
        moment, _ = compute_top_down(lever, [10.0, 1.0])
        assert np.isnan(moment).any()
        moment, force = compute_top_down(lever, [10.0, 0.0])
        assert np.isfinite(moment).all()
        assert force[0, 1] == pytest.approx(-10 * G)

    def test_wrong_shape_says_what_it_needs(self):
        with pytest.raises(ShapeError, match=r"\(T, B, 3\)"):
            compute_top_down(np.zeros((3, 3)), [1.0])
