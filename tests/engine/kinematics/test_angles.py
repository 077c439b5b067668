"""Angle conventions and geometry against analytic cases and published-definition vectors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.errors import ConfigError, ShapeError
from engine.kinematics import angles

DESIGN_NAMES = [
    "trunk_inclination",
    "trunk_flexion",
    "trunk_lateral_bend",
    "trunk_twist",
    "lumbar_flexion",
    "lumbar_bending",
    "lumbar_rotation",
    "pelvis_tilt",
    "pelvis_list",
    "pelvis_rotation",
    "neck_flexion",
    "hip_flexion",
    "hip_adduction",
    "hip_rotation",
    "knee_flexion",
    "ankle_dorsiflexion",
    "shoulder_flexion",
    "shoulder_adduction",
    "shoulder_rotation",
    "elbow_flexion",
    "forearm_pronation",
]

# LShoulder, RShoulder, LHip, RHip in metres -> flexion, lateral bend, twist, inclination.
HIPS = ([0, 1, -0.1], [0, 1, 0.1])
TRUNK_VECTORS = {
    "A1 upright": (([0, 1.5, -0.2], [0, 1.5, 0.2], *HIPS), (0, 0, 0, 0)),
    "A2 flexed": (([0.4330, 1.25, -0.2], [0.4330, 1.25, 0.2], *HIPS), (60, 0, 0, 60)),
    "A3 bent right": (([0, 1.5383, -0.0169], [0, 1.4014, 0.3589], *HIPS), (0, 20, 0, 20)),
    "A4 turned left": (([-0.1, 1.5, -0.1732], [0.1, 1.5, 0.1732], *HIPS), (0, 0, 30, 0)),
    "A5 combined": (
        ([0.4196, 1.3229, -0.0983], [0.2767, 1.3735, 0.2719], *HIPS),
        (45, 10, -20, 45.86),
    ),
    "A6 turned subject": (
        (
            [-0.2366, 1.4199, -0.2402],
            [0.1586, 1.4166, -0.3021],
            [-0.094, 1, -0.0342],
            [0.094, 1, 0.0342],
        ),
        (30, -15, 25, 33.22),
    ),
}


def row(*points):
    return [np.array([p], dtype=float) for p in points]


def rotation_y(angle_deg):
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def rotation_x(angle_deg):
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def rotation_z(angle_deg):
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def build_trunk(flexion, bend, twist, heading=0.0):
    """Shoulders and hips of a trunk turned by the Cardan sequence Z-X-Y."""
    turn = rotation_z(-flexion) @ rotation_x(bend) @ rotation_y(twist)
    shoulders = [turn @ np.array([0.0, 0.5, z]) for z in (-0.2, 0.2)]
    hips = [np.array([0.0, 0.0, z]) for z in (-0.1, 0.1)]
    lift = np.array([0.0, 1.0, 0.0])
    return row(*(rotation_y(heading) @ p + lift for p in (*shoulders, *hips)))


class TestTable:
    def test_has_exactly_the_names_of_the_design(self):
        assert sorted(r.name for r in angles.ANGLES) == sorted(DESIGN_NAMES)

    def test_limb_angles_exist_for_both_sides(self):
        bilateral = {r.name for r in angles.ANGLES if r.is_bilateral}
        assert bilateral == {r.name for r in angles.ANGLES if r.group in ("leg", "arm")}
        assert "knee_flexion_l" in angles.ANGLE_NAMES
        assert "knee_flexion" not in angles.ANGLE_NAMES
        assert len(set(angles.ANGLE_NAMES)) == len(angles.ANGLE_NAMES)

    @pytest.mark.parametrize("system", ["opensim_hamner", "opensim_pose2sim"])
    def test_a_name_shared_with_opensim_has_opensims_sign(self, system):
        shared = 0
        for name in angles.ANGLE_NAMES:
            external = angles.get_external_angle(name, system)
            if external is not None and external.name == name:
                shared += 1
                assert external.sign == 1
        assert shared >= 9

    @pytest.mark.parametrize(
        ("name", "system", "expected"),
        [
            ("knee_flexion_l", "opensim_hamner", ("knee_angle_l", -1)),
            ("knee_flexion_r", "opensim_pose2sim", ("knee_angle_r", 1)),
            ("lumbar_flexion", "opensim_hamner", ("lumbar_extension", -1)),
            ("lumbar_flexion", "opensim_pose2sim", ("L5_S1_Flex_Ext", -1)),
            ("shoulder_adduction_r", "plug_in_gait", ("RShoulderAngles.y", -1)),
            ("shoulder_adduction_r", "opensim_hamner", ("arm_add_r", 1)),
            ("hip_adduction_l", "plug_in_gait", ("LHipAngles.y", 1)),
        ],
    )
    def test_counterparts(self, name, system, expected):
        external = angles.get_external_angle(name, system)
        assert (external.name, external.sign) == expected

    def test_an_angle_without_counterpart_says_so(self):
        assert angles.get_external_angle("trunk_inclination", "opensim_hamner") is None

    def test_unknown_angle_is_a_config_error_that_lists_the_known(self):
        with pytest.raises(ConfigError, match=r"knee_bend.*knee_flexion_l"):
            angles.describe_angle("knee_bend")

    def test_the_printed_page_is_up_to_date(self):
        page = Path(__file__).parents[3] / "docs" / "angles.md"
        assert page.read_text(encoding="utf-8") == angles.format_angle_table()

    def test_every_line_of_the_printed_tables_has_as_many_cells_as_its_head(self):
        lines = [x for x in angles.format_angle_table().splitlines() if x.startswith("|")]
        cells = [x.count("|") for x in lines]
        assert set(cells) == {9, 6}
        assert len(lines) == 2 * (len(angles.ANGLES) + 2)


class TestTrunk:
    @pytest.mark.parametrize(("points", "expected"), TRUNK_VECTORS.values(), ids=TRUNK_VECTORS)
    def test_vectors(self, points, expected):
        trunk = angles.compute_trunk_angles(*row(*points))
        got = [trunk.flexion, trunk.lateral_bend, trunk.twist, trunk.inclination]
        assert np.array(got)[:, 0] == pytest.approx(expected, abs=0.02)

    @given(st.floats(-60, 85), st.floats(-60, 60), st.floats(-80, 80), st.floats(-180, 180))
    def test_recovers_the_rotation_whatever_the_heading(self, flexion, bend, twist, heading):
        trunk = angles.compute_trunk_angles(*build_trunk(flexion, bend, twist, heading))
        assert trunk.flexion[0] == pytest.approx(flexion, abs=1e-6)
        assert trunk.lateral_bend[0] == pytest.approx(bend, abs=1e-6)
        assert trunk.twist[0] == pytest.approx(twist, abs=1e-6)
        cosine = np.cos(np.radians(flexion)) * np.cos(np.radians(bend))
        assert np.cos(np.radians(trunk.inclination[0])) == pytest.approx(cosine, abs=1e-9)

    def test_mirroring_swaps_sides(self):
        ls, rs, lh, rh = build_trunk(40, 12, -17)
        mirror = np.array([1, 1, -1])
        trunk = angles.compute_trunk_angles(rs * mirror, ls * mirror, rh * mirror, lh * mirror)
        assert trunk.flexion[0] == pytest.approx(40)
        assert trunk.lateral_bend[0] == pytest.approx(-12)
        assert trunk.twist[0] == pytest.approx(17)

    def test_hips_above_each_other_have_no_heading_but_an_inclination(self):
        ls, rs, _, _ = build_trunk(30, 0, 0)
        lh, rh = row([0, 0.9, 0.001], [0, 1.1, 0])
        trunk = angles.compute_trunk_angles(ls, rs, lh, rh)
        assert np.isfinite(trunk.inclination[0])
        assert np.isnan([trunk.flexion[0], trunk.lateral_bend[0], trunk.twist[0]]).all()

    def test_a_given_forward_direction_replaces_that_of_the_hips(self):
        points = build_trunk(30, 0, 0, heading=0)
        sideways = angles.compute_trunk_angles(*points, forward=[0.0, 0.3, 1.0])
        assert sideways.flexion[0] == pytest.approx(0, abs=1e-9)
        assert sideways.lateral_bend[0] == pytest.approx(-30)
        same = angles.compute_trunk_angles(*points, forward=[2.0, 0.0, 0.0])
        assert same.flexion[0] == pytest.approx(30)

    def test_a_missing_point_is_nan_in_its_frame_only(self):
        points = [np.repeat(p, 3, axis=0) for p in build_trunk(30, 5, 5)]
        points[0][1] = np.nan
        trunk = angles.compute_trunk_angles(*points)
        for curve in trunk:
            assert np.isnan(curve).tolist() == [False, True, False]

    def test_forward_of_a_subject_facing_x(self):
        assert angles.compute_forward(*row(*HIPS))[0] == pytest.approx([1, 0, 0])


class TestLimbs:
    @given(st.floats(0, 180), st.floats(0.1, 0.6), st.floats(0.1, 0.6))
    def test_hinge_flexion_of_a_two_segment_limb(self, flexion, thigh, shank):
        a = np.radians(flexion)
        hip, knee = [0, thigh, 0], [0, 0, 0]
        ankle = [-shank * np.sin(a), -shank * np.cos(a), 0]
        got = angles.compute_hinge_flexion(*row(hip, knee, ankle))[0]
        assert got == pytest.approx(flexion, abs=1e-6)

    def test_coinciding_points_have_no_angle(self):
        assert np.isnan(angles.compute_included_angle(*row([0, 0, 0], [0, 0, 0], [1, 0, 0]))[0])

    def test_shapes_must_agree(self):
        with pytest.raises(ShapeError, match=r"\(2, 3\)"):
            angles.compute_included_angle(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((3, 3)))

    @pytest.mark.parametrize("flexion", [-30.0, 0.0, 45.0, 90.0, 120.0])
    @pytest.mark.parametrize("side", [-0.1, 0.1])
    def test_hip_flexion_of_an_upright_trunk(self, flexion, side):
        a = np.radians(flexion)
        hip = np.array([0, 1, side])
        # Ten degrees of abduction must not change the angle seen from the side.
        out = np.sign(side) * 0.4 * np.tan(np.radians(10))
        knee = hip + np.array([0.4 * np.sin(a), -0.4 * np.cos(a), out])
        lh, rh = row(*HIPS)
        (top,) = row([0, 1.5, 0])
        got = angles.compute_hip_flexion(
            *row(hip, knee), left_hip=lh, right_hip=rh, mid_shoulder=top
        )
        assert got[0] == pytest.approx(flexion, abs=1e-6)

    def test_hip_flexion_is_relative_to_the_trunk_and_not_to_the_vertical(self):
        ls, rs, lh, rh = build_trunk(60, 0, 0)
        knee = rh + np.array([0.0, -0.4, 0.0])
        got = angles.compute_hip_flexion(
            rh, knee, left_hip=lh, right_hip=rh, mid_shoulder=(ls + rs) / 2
        )
        assert got[0] == pytest.approx(60)

    @given(
        flexion=st.floats(-60, 175),
        adduction=st.floats(-85, 40),
        bend=st.floats(-40, 40),
        twist=st.floats(-40, 40),
        side=st.sampled_from(["left", "right"]),
    )
    def test_shoulder_angles_undo_the_cardan_sequence(self, flexion, adduction, bend, twist, side):
        ls, rs, lh, rh = build_trunk(35, bend, twist, heading=20)
        thorax = rotation_y(20) @ rotation_z(-35) @ rotation_x(bend) @ rotation_y(twist)
        sign = 1 if side == "right" else -1
        # Flexion swings the hanging arm forward (+Z turn), abduction swings it outwards.
        arm = thorax @ rotation_z(flexion) @ rotation_x(sign * adduction) @ [0, -0.3, 0]
        shoulder = rs if side == "right" else ls
        got = angles.compute_shoulder_angles(
            shoulder,
            shoulder + arm,
            left_shoulder=ls,
            right_shoulder=rs,
            mid_hip=(lh + rh) / 2,
            side=side,
        )
        assert got[0][0] == pytest.approx(flexion, abs=1e-5)
        assert got[1][0] == pytest.approx(adduction, abs=1e-5)

    def test_arm_held_out_to_the_side_is_abduction_and_has_no_flexion(self):
        ls, rs, lh, rh = build_trunk(0, 0, 0)
        flexion, adduction = angles.compute_shoulder_angles(
            rs,
            rs + np.array([0, 0, 0.3]),
            left_shoulder=ls,
            right_shoulder=rs,
            mid_hip=(lh + rh) / 2,
            side="right",
        )
        assert np.isnan(flexion[0])
        assert adduction[0] == pytest.approx(-90)

    @pytest.mark.parametrize(
        ("arm", "to_vertical", "to_trunk"),
        [([0, -0.3, 0], 0, 60), ([0.3, 0, 0], 90, 150), ([0, 0.3, 0], 180, 120)],
    )
    def test_upper_arm_elevation(self, arm, to_vertical, to_trunk):
        shoulder, elbow = row([0, 1.5, 0], np.add([0, 1.5, 0], arm))
        (trunk,) = row([np.sin(np.radians(60)), np.cos(np.radians(60)), 0])
        vertical = angles.compute_upper_arm_elevation(shoulder, elbow)[0]
        assert vertical == pytest.approx(to_vertical, abs=1e-6)
        if np.asarray(arm)[1] <= 0:
            relative = angles.compute_upper_arm_elevation(shoulder, elbow, trunk=trunk)[0]
            expected = np.degrees(np.arccos(np.dot(np.asarray(arm) / 0.3, -trunk[0])))
            assert relative == pytest.approx(expected)
            assert relative == pytest.approx(to_trunk)


class TestNeck:
    def test_forward_bend_of_the_head_line_is_positive(self):
        ls, rs, lh, rh = build_trunk(50, 0, 0)
        a = np.radians(50 + 25)
        ear = (ls + rs) / 2 + 0.2 * np.array([[np.sin(a), np.cos(a), 0]])
        got = angles.compute_neck_angle(
            ear, left_shoulder=ls, right_shoulder=rs, mid_hip=(lh + rh) / 2
        )
        assert got[0] == pytest.approx(25)

    def test_neutral_is_the_median_of_upright_frames(self):
        angle = np.array([10.0, 11, 12, 11, 10, 40, 60, np.nan])
        upright = angles.find_upright([0, 5, 19, 20, 3, 21, 80, np.nan])
        assert upright.tolist() == [True] * 5 + [False] * 3
        assert angles.estimate_neutral_deg(angle, upright) == 11.0

    def test_without_enough_upright_frames_there_is_no_neutral(self):
        upright = np.array([True, True, False, False])
        assert np.isnan(angles.estimate_neutral_deg(np.zeros(4), upright))
