"""The keypoint solver: values, error propagation, status and discovery."""

from __future__ import annotations

import numpy as np
import pytest

from engine.datatypes import PoseTrack, Status, Subject
from engine.errors import ConfigError, UnitError
from engine.kinematics import angles
from engine.kinematics.fitting.base import list_solvers, select_solver
from engine.kinematics.fitting.geometric import SOLVER, UNKNOWN_SIGMA_DEG, propagate_sigma
from engine.skeletons import H36M_17, MEDIAPIPE_33

STANDING = {
    "left_ear": [0.03, 1.62, -0.07],
    "right_ear": [0.03, 1.62, 0.07],
    "left_shoulder": [0, 1.45, -0.18],
    "right_shoulder": [0, 1.45, 0.18],
    "left_elbow": [0, 1.15, -0.20],
    "right_elbow": [0, 1.15, 0.20],
    "left_wrist": [0.03, 0.90, -0.20],
    "right_wrist": [0.03, 0.90, 0.20],
    "left_hip": [0, 0.95, -0.10],
    "right_hip": [0, 0.95, 0.10],
    "left_knee": [0, 0.50, -0.10],
    "right_knee": [0, 0.50, 0.10],
    "left_ankle": [0, 0.08, -0.10],
    "right_ankle": [0, 0.08, 0.10],
}


def build_track(*poses, sigma=0.01, skeleton=MEDIAPIPE_33, **kwargs):
    position = np.full((len(poses), len(skeleton.keypoints), 3), np.nan)
    for t, pose in enumerate(poses):
        for name, point in pose.items():
            if name in skeleton.keypoints:
                position[t, skeleton.index(name)] = point
    options = {"unit": "m", "frame_of_reference": "world", **kwargs}
    return PoseTrack(
        time_s=np.arange(len(poses)) / 30.0,
        position=position,
        sigma=np.full(position.shape[:2], sigma),
        skeleton=skeleton.name,
        **options,
    )


def bow(pose, flexion_deg):
    """Turn everything above the hips forward about the hip line."""
    a = np.radians(flexion_deg)
    turn = np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])
    hips = np.array([0, 0.95, 0])
    upper = ("ear", "shoulder", "elbow", "wrist")
    return {
        k: turn @ (np.array(p) - hips) + hips if k.split("_")[1] in upper else p
        for k, p in pose.items()
    }


SUBJECT = Subject()


class TestValues:
    def test_standing_person(self):
        found = SOLVER.fit(build_track(*[STANDING] * 6), SUBJECT).angles
        for name in ("trunk_flexion", "trunk_twist", "hip_flexion_l", "knee_flexion_r"):
            assert found[name] == pytest.approx(np.zeros(6), abs=1e-6)
        assert found["elbow_flexion_l"][0] == pytest.approx(7.82953, abs=1e-4)
        assert found["shoulder_adduction_r"][0] == pytest.approx(-np.degrees(np.arctan(0.02 / 0.3)))
        assert found["neck_flexion"] == pytest.approx(np.zeros(6), abs=1e-9)

    def test_bowing_moves_trunk_and_hips_but_neither_neck_nor_arms(self):
        poses = [STANDING] * 6 + [bow(STANDING, 70)]
        found = SOLVER.fit(build_track(*poses), SUBJECT).angles
        last = {name: found[name][-1] for name in found.names}
        assert last["trunk_inclination"] == pytest.approx(70)
        assert last["trunk_flexion"] == pytest.approx(70)
        assert last["hip_flexion_l"] == pytest.approx(70)
        assert last["hip_flexion_r"] == pytest.approx(70)
        assert last["neck_flexion"] == pytest.approx(0, abs=1e-9)
        assert last["shoulder_flexion_l"] == pytest.approx(0, abs=1e-9)

    def test_turning_the_subject_leaves_every_angle_alone(self):
        pose = bow({**STANDING, "right_knee": [0.3, 0.6, 0.15]}, 40)
        c, s = np.cos(1.1), np.sin(1.1)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        turned = {k: turn @ np.array(p) * 1.3 + [2, 0, -1] for k, p in pose.items()}
        before = SOLVER.fit(build_track(pose), SUBJECT).angles.value_deg
        after = SOLVER.fit(build_track(turned), SUBJECT).angles.value_deg
        np.testing.assert_allclose(after, before, atol=1e-6)

    def test_mirroring_swaps_sides(self):
        pose = bow({**STANDING, "right_knee": [0.3, 0.6, 0.15], "left_elbow": [0.2, 1.2, -0.3]}, 40)
        swap = {"left": "right", "right": "left"}
        mirrored = {
            k.replace(k.split("_")[0], swap[k.split("_")[0]]): np.array(p) * [1, 1, -1]
            for k, p in pose.items()
        }
        one = SOLVER.fit(build_track(pose), SUBJECT).angles
        two = SOLVER.fit(build_track(mirrored), SUBJECT).angles
        for name in ("hip_flexion", "knee_flexion", "shoulder_flexion", "shoulder_adduction"):
            assert one[f"{name}_l"] == pytest.approx(two[f"{name}_r"], abs=1e-9)
        assert one["trunk_flexion"] == pytest.approx(two["trunk_flexion"], abs=1e-9)

    def test_no_neutral_posture_means_no_neck_flexion(self):
        found = SOLVER.fit(build_track(*[bow(STANDING, 60)] * 8), SUBJECT).angles
        assert np.isnan(found["neck_flexion"]).all()
        assert np.isnan(found.sigma("neck_flexion")).all()
        assert (np.asarray(found.status)[:, found.names.index("neck_flexion")] == 0).all()

    def test_a_skeleton_without_ears_gives_the_other_angles(self):
        found = SOLVER.fit(build_track(*[STANDING] * 6, skeleton=H36M_17), SUBJECT).angles
        assert found.names == SOLVER.info.angles
        assert np.isnan(found["neck_flexion"]).all()
        assert np.isfinite(found["knee_flexion_l"]).all()

    def test_a_missing_point_takes_its_own_angles_only(self):
        broken = {**STANDING, "left_ankle": [np.nan] * 3}
        found = SOLVER.fit(build_track(STANDING, broken, STANDING), SUBJECT).angles
        assert np.isnan(found["knee_flexion_l"]).tolist() == [False, True, False]
        assert np.isfinite(found["knee_flexion_r"]).all()
        assert np.isfinite(found["hip_flexion_l"]).all()

    @pytest.mark.parametrize(("unit", "frame"), [("m", "body"), ("m", "camera"), ("px", "image")])
    def test_refuses_a_track_that_is_not_in_the_world(self, unit, frame):
        with pytest.raises(UnitError, match="world"):
            SOLVER.fit(build_track(STANDING, unit=unit, frame_of_reference=frame), SUBJECT)


class TestStatus:
    def test_the_worst_keypoint_counts(self):
        track = build_track(*[STANDING] * 4)
        status = np.full((4, 33), Status.MEASURED, dtype=np.uint8)
        hip, knee = MEDIAPIPE_33.index("left_hip"), MEDIAPIPE_33.index("left_knee")
        status[1, knee] = Status.SMOOTHED
        status[2, [hip, knee]] = Status.FILLED, Status.REPAIRED
        status[3, hip] = Status.REPAIRED
        track = PoseTrack(
            **{k: getattr(track, k) for k in ("time_s", "position", "unit", "skeleton", "sigma")},
            frame_of_reference="world",
            status=status,
        )
        found = SOLVER.fit(track, SUBJECT).angles
        column = found.names.index("knee_flexion_l")
        assert np.asarray(found.status)[:, column].tolist() == [
            Status.MEASURED,
            Status.SMOOTHED,
            Status.FILLED,
            Status.REPAIRED,
        ]
        other = found.names.index("elbow_flexion_r")
        assert (np.asarray(found.status)[:, other] == Status.MEASURED).all()


class TestSigma:
    def limb(self, flexion_deg, sigma):
        a = np.radians(flexion_deg)
        points = {
            "hip": np.array([[0, 0.4, 0]]),
            "knee": np.zeros((1, 3)),
            "ankle": np.array([[-0.4 * np.sin(a), -0.4 * np.cos(a), 0]]),
        }
        return points, {k: np.array([sigma]) for k in points}

    @staticmethod
    def flexion(points):
        return angles.compute_hinge_flexion(points["hip"], points["knee"], points["ankle"])[:, None]

    @pytest.mark.parametrize("flexion", [40.0, 90.0, 130.0])
    def test_matches_the_formula_and_monte_carlo(self, flexion):
        points, sigma = self.limb(flexion, 0.01)
        got = propagate_sigma(self.flexion, points, sigma)[0, 0]
        # Ends: sigma / length each. Middle: the two segments' turns, which share the knee.
        cosine = np.cos(np.radians(180 - flexion))
        ends, knee = 2 / 0.4**2, (2 - 2 * cosine) / 0.4**2
        assert got == pytest.approx(np.degrees(0.01 * np.sqrt(ends + knee)), rel=0.02)
        rng = np.random.default_rng(1)
        noisy = {k: p + 0.01 * rng.standard_normal((20000, 3)) for k, p in points.items()}
        assert got == pytest.approx(np.std(self.flexion(noisy)), rel=0.03)

    def test_keeps_its_size_at_a_straight_limb(self):
        points, sigma = self.limb(0.0, 0.01)
        got = propagate_sigma(self.flexion, points, sigma)[0, 0]
        rng = np.random.default_rng(2)
        noisy = {k: p + 0.01 * rng.standard_normal((20000, 3)) for k, p in points.items()}
        root_mean_square = np.sqrt(np.mean(self.flexion(noisy) ** 2))
        assert got == pytest.approx(root_mean_square, rel=0.05)

    def test_trunk_errors_match_monte_carlo(self):
        pose = bow(STANDING, 45)
        found = SOLVER.fit(build_track(pose, sigma=0.015), SUBJECT).angles
        rng = np.random.default_rng(3)
        noisy = [
            {k: np.array(p) + 0.015 * rng.standard_normal(3) for k, p in pose.items()}
            for _ in range(4000)
        ]
        spread = SOLVER.fit(build_track(*noisy), SUBJECT).angles
        for name in ("trunk_inclination", "trunk_flexion", "trunk_lateral_bend", "trunk_twist"):
            assert found.sigma(name)[0] == pytest.approx(np.std(spread[name]), rel=0.08)

    def test_unknown_keypoint_error_is_an_unknown_angle_error(self):
        points, sigma = self.limb(60.0, 0.01)
        sigma["ankle"] = np.array([np.nan])
        assert np.isnan(propagate_sigma(self.flexion, points, sigma)[0, 0])

    def test_doubling_the_error_doubles_it(self):
        one = SOLVER.fit(build_track(bow(STANDING, 30), sigma=0.001), SUBJECT).angles
        two = SOLVER.fit(build_track(bow(STANDING, 30), sigma=0.002), SUBJECT).angles
        assert two.sigma("hip_flexion_l") == pytest.approx(2 * one.sigma("hip_flexion_l"), rel=0.01)

    def test_never_exceeds_that_of_a_random_angle(self):
        found = SOLVER.fit(build_track(*[STANDING] * 6, sigma=5.0), SUBJECT).angles
        sigma = np.asarray(found.sigma_deg)
        assert np.isfinite(sigma[:, found.names.index("trunk_flexion")]).all()
        neck = found.names.index("neck_flexion")
        assert (np.delete(sigma, neck, axis=1) <= UNKNOWN_SIGMA_DEG).all()


class TestDiscovery:
    def test_the_table_knows_what_the_solver_provides(self):
        marked = [n for r in angles.ANGLES if r.is_geometric for n in r.names]
        assert tuple(marked) == SOLVER.info.angles

    def test_every_solver_keeps_the_contract(self):
        for solver in list_solvers():
            assert set(solver.info.angles) <= set(angles.ANGLE_NAMES)
            if not solver.info.missing:
                assert select_solver(solver.info.name) is solver

    def test_unknown_solver_is_a_config_error_that_lists_the_known(self):
        with pytest.raises(ConfigError, match=r"'udaes'; known: .*geometric"):
            select_solver("udaes")
