"""From keypoints to the load on the back: places, mirrored arms, errors, accelerations."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from engine.datatypes import PoseTrack, Provenance, Subject
from engine.ergonomics.segments import ABOVE_L5S1
from engine.ergonomics.spine import EXTENSOR_LEVER_M
from engine.ergonomics.upper_body import (
    compute_back_load,
    differentiate_twice,
    measure_upper_body,
    read_mass,
)
from engine.skeletons import H36M_17
from tests.engine.ergonomics.figures import (
    FOREARM_M,
    HAND_M,
    NECK_M,
    TRUNK_M,
    UPPER_ARM_M,
    build_figure_exposure,
    build_track,
    place_figure,
)

G = 9.80665
MASS_KG, LOAD_KG = 80.0, 15.0


def compute(exposure, load_kg=LOAD_KG):
    body = measure_upper_body(exposure)
    load = compute_back_load(body, exposure.lifts, subject=exposure.subject, load_kg=load_kg)
    return body, load


def moment_by_hand(trunk_deg, reach_m, load_kg):
    """Flexion moment of the figure, written out part by part."""
    s, sine = ABOVE_L5S1["male"], np.sin(np.radians(trunk_deg))
    shoulder = TRUNK_M * sine
    parts = [
        (s.trunk, s.trunk_centre * shoulder),
        (s.head, shoulder + NECK_M * sine),
        (2 * s.upper_arm, shoulder + s.upper_arm_centre * reach_m),
        (2 * s.forearm, shoulder + reach_m),
        (2 * s.hand, shoulder + reach_m),
    ]
    joint = s.l5s1_height * shoulder
    body = sum(MASS_KG * share * (x - joint) for share, x in parts)
    return G * (body + load_kg * (shoulder + reach_m - joint))


class TestStatic:
    @pytest.mark.parametrize(("trunk_deg", "reach_m"), [(0, 0.0), (0, 0.3), (45, 0.2), (85, 0.1)])
    @pytest.mark.parametrize("turn_deg", [0, 130])
    def test_moment_is_that_worked_by_hand(self, trunk_deg, reach_m, turn_deg):
        exposure = build_figure_exposure(trunk_deg=trunk_deg, reach_m=reach_m, turn_deg=turn_deg)
        _, load = compute(exposure)
        assert load.static.flexion_nm[30] == pytest.approx(
            moment_by_hand(trunk_deg, reach_m, LOAD_KG)
        )
        assert load.static.flexion_nm[0] == pytest.approx(moment_by_hand(trunk_deg, reach_m, 0.0))
        assert load.static.lateral_nm[30] == pytest.approx(0.0, abs=1e-9)

    def test_load_counts_only_while_it_is_held(self):
        _, load = compute(build_figure_exposure())
        held = load.load_kg > 0
        assert load.time_s[held][[0, -1]] == pytest.approx([0.5, 1.5])
        assert np.isnan(load.load_lever_m[~held]).all()
        reach = TRUNK_M * np.sin(np.pi / 4) * (1 - ABOVE_L5S1["male"].l5s1_height) + 0.2
        assert load.load_lever_m[30] == pytest.approx(reach)

    def test_still_person_has_equal_static_and_dynamic_loads(self):
        _, load = compute(build_figure_exposure())
        np.testing.assert_allclose(load.static.flexion_nm, load.dynamic.flexion_nm, atol=1e-6)

    def test_one_hand_bends_to_its_side(self):
        exposure = build_figure_exposure()
        poses = [place_figure(45, 0.2) for _ in range(60)]
        for k, pose in enumerate(poses):
            for name in ("right_index", "right_pinky"):
                pose[name] = pose[name] + [0.0, 0.005 * k, 0.0]
        lift = dataclasses.replace(exposure.lifts[0], hands=1)
        exposure = build_figure_exposure(track=build_track(poses), lifts=[lift])
        body, load = compute(exposure)
        assert body.grip(lift) == {"right_knuckle": 1.0}
        # Bent by 45 degrees, the load bends sideways and turns the trunk alike.
        part = LOAD_KG * G * 0.18 * np.cos(np.pi / 4)
        assert load.static.lateral_nm[30] == pytest.approx(part)
        assert load.static.twist_nm[30] == pytest.approx(part)


class TestHiddenArm:
    ARM = ("left_elbow", "left_wrist", "left_index", "left_pinky")

    @pytest.mark.parametrize("turn_deg", [0, 70])
    def test_the_mirror_image_of_a_symmetric_figure_is_exact(self, turn_deg):
        seen = build_figure_exposure(turn_deg=turn_deg)
        hidden = build_figure_exposure(turn_deg=turn_deg, hidden=self.ARM)
        (_, one), (body, two) = compute(seen), compute(hidden)
        assert body.is_mirrored.all()
        np.testing.assert_allclose(one.static.compression_n, two.static.compression_n)

    def test_a_mirrored_arm_is_less_sure(self):
        (_, one), (_, two) = (
            compute(build_figure_exposure(sigma=0.03, hidden=hidden)) for hidden in ((), self.ARM)
        )
        assert (two.flexion_sigma_nm > one.flexion_sigma_nm).all()

    def test_both_arms_hidden_is_missing_not_invented(self):
        both = self.ARM + tuple(n.replace("left", "right") for n in self.ARM)
        _, load = compute(build_figure_exposure(hidden=both))
        assert np.isnan(load.static.flexion_nm).all()

    def test_hidden_hips_are_missing(self):
        _, load = compute(build_figure_exposure(hidden=("left_hip",)))
        assert np.isnan(load.static.compression_n).all()


class TestErrors:
    def test_moment_error_agrees_with_random_errors_of_keypoints(self):
        """Standard error by propagation against the scatter of 4000 disturbed figures."""
        rng = np.random.default_rng(7)
        n, sigma = 4000, 0.02
        exposure = build_figure_exposure(n_frames=n, sigma=sigma)
        lift = dataclasses.replace(exposure.lifts[0], start_s=0.0, end_s=1e4)
        noisy = dataclasses.replace(
            exposure.track,
            position=exposure.track.position + rng.normal(0, sigma, exposure.track.position.shape),
        )
        exposure = build_figure_exposure(track=noisy, lifts=[lift])
        subject = dataclasses.replace(exposure.subject)
        body = measure_upper_body(exposure)
        load = compute_back_load(body, [lift], subject=subject, load_kg=LOAD_KG)
        # Only keypoints scatter here: take the other errors out of the stated one.
        moment = float(np.median(load.static.flexion_nm))
        s = ABOVE_L5S1["male"]
        total = G * (s.total * MASS_KG + LOAD_KG)
        carried = moment_by_hand(45, 0.2, LOAD_KG) - moment_by_hand(45, 0.2, 0.0)
        others = (total * 0.025, moment * 0.01 / 1.75, (moment - carried) * 0.03, carried * 0.03)
        stated = np.sqrt(np.median(load.flexion_sigma_nm) ** 2 - np.sum(np.square(others)))
        assert stated == pytest.approx(np.std(load.static.flexion_nm), rel=0.06)

    def test_compression_error_holds_moment_and_lever(self):
        _, load = compute(build_figure_exposure(sigma=0.02))
        moment, spread = load.static.flexion_nm[30], load.flexion_sigma_nm[30]
        expected = np.hypot(spread / EXTENSOR_LEVER_M, moment * 0.003 / EXTENSOR_LEVER_M**2)
        assert load.compression_sigma_n[30] == pytest.approx(expected)

    def test_unknown_body_mass_is_assumed_and_widens(self):
        known = Subject(stature_m=1.75, mass_kg=76.5625, sex="male")
        unknown = dataclasses.replace(known, mass_kg=None)
        mass, source, notes = read_mass(unknown)
        assert (mass.value, source) == (pytest.approx(76.5625), Provenance.ASSUMED)
        assert "77 kg assumed" in notes[0]
        loads = [compute(build_figure_exposure(subject=s))[1] for s in (known, unknown)]
        assert loads[1].static.flexion_nm[30] == pytest.approx(loads[0].static.flexion_nm[30])
        assert loads[1].flexion_sigma_nm[30] > 1.2 * loads[0].flexion_sigma_nm[30]

    def test_unknown_keypoint_error_is_an_unknown_error(self):
        _, load = compute(build_figure_exposure(sigma=np.nan))
        assert np.isnan(load.flexion_sigma_nm).all()
        assert np.isfinite(load.static.flexion_nm).all()


class TestAccelerations:
    TIME = np.arange(180) / 30.0

    def test_a_parabola_has_its_constant_acceleration(self):
        position = 1.5 * self.TIME**2
        found = differentiate_twice(position, self.TIME)
        # The filter's padding bends the ends; the middle is exact.
        np.testing.assert_allclose(found[30:-30], 3.0, atol=0.02)

    @pytest.mark.parametrize(("frequency_hz", "gain"), [(0.5, 1.0), (3.0, 2**-0.5)])
    def test_cut_off_is_that_of_both_passes(self, frequency_hz, gain):
        omega = 2 * np.pi * frequency_hz
        time_s = np.arange(1200) / 120.0
        found = differentiate_twice(np.sin(omega * time_s), time_s)[300:-300]
        assert np.max(found) == pytest.approx(gain * omega**2, rel=0.03)

    def test_gaps_and_short_stretches_stay_missing(self):
        position = np.sin(self.TIME)
        position[[60, 70]] = np.nan
        found = differentiate_twice(position, self.TIME)
        assert np.isnan(found[60:71]).all()
        assert np.isfinite(found[:60]).all()
        assert np.isfinite(found[71:]).all()

    def test_no_acceleration_below_25_frames_per_second(self):
        time_s = np.arange(60) / 15.0
        assert np.isnan(differentiate_twice(np.sin(time_s), time_s)).all()

    def test_lifting_faster_loads_the_back_more(self):
        def rise(duration_s):
            time_s = np.arange(90) / 30.0
            phase = np.clip((time_s - 1.0) / duration_s, 0.0, 1.0)
            heights = 0.5 * (phase - np.sin(2 * np.pi * phase) / (2 * np.pi))
            poses = [place_figure(20, 0.3) for _ in time_s]
            for pose, height in zip(poses, heights, strict=True):
                for name in list(pose):
                    if any(part in name for part in ("wrist", "index", "pinky")):
                        pose[name] = pose[name] + [0.0, height, 0.0]
            lift = build_figure_exposure().lifts[0]
            lift = dataclasses.replace(lift, start_s=0.9, end_s=2.2)
            _, load = compute(build_figure_exposure(track=build_track(poses), lifts=[lift]))
            return np.nanmax(load.dynamic.compression_n), np.nanmax(load.static.compression_n)

        (slow, slow_static), (fast, fast_static) = rise(1.2), rise(0.6)
        assert slow_static == pytest.approx(fast_static, rel=1e-6)
        assert fast > slow > slow_static


def test_the_17_joint_skeleton_works_too():
    poses = place_figure(45, 0.2)
    position = np.full((60, 17, 3), np.nan)
    for name in H36M_17.keypoints:
        if name in poses:
            position[:, H36M_17.index(name)] = poses[name]
    thorax = (poses["left_shoulder"] + poses["right_shoulder"]) / 2
    ears = (poses["left_ear"] + poses["right_ear"]) / 2
    position[:, H36M_17.index("thorax")] = thorax
    position[:, H36M_17.index("head")] = thorax + 2 * (ears - thorax)
    time_s = np.arange(60) / 30.0
    track = PoseTrack(time_s, position, "m", "world", "h36m_17", sigma=np.zeros((60, 17)))
    body, load = compute(build_figure_exposure(track=track))
    knuckle = poses["left_wrist"] + 0.32 * (poses["left_wrist"] - poses["left_elbow"])
    np.testing.assert_allclose(body.points["left_knuckle"][0], knuckle)
    assert abs(0.32 * FOREARM_M - HAND_M) < 0.01 < UPPER_ARM_M
    assert load.static.flexion_nm[30] == pytest.approx(moment_by_hand(45, 0.2, LOAD_KG))
