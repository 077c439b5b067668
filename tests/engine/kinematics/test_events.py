from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.correction.chain import correct_track
from engine.datatypes import Array, JointAngles, Lift, PoseTrack, WorldScene
from engine.errors import ConfigError
from engine.kinematics.events import (
    SET_BY_USER,
    SET_SIGMA_S,
    LiftFindings,
    compute_hands,
    compute_knuckles,
    detect_lifts,
    find_moves,
    measure_end,
)
from engine.skeletons import H36M_17, MEDIAPIPE_33
from tests.builders import make_pose_track
from tests.engine.cameras.truth import place_camera

STATURE_M = 1.75
NAMES = MEDIAPIPE_33.keypoints
COLUMN = {name: i for i, name in enumerate(NAMES)}
UPRIGHT = np.asarray(make_pose_track(n_frames=60).position)[-1]
PELVIS_Y = 0.92
HANGING = (0.0, 0.763, 0.0)
FLOOR = (0.40, 0.30, 0.0)
TABLE = (0.40, 1.00, 0.0)
SHELF = (0.45, 1.45, 0.0)


@dataclass(frozen=True)
class Phase:
    """The hands go to a place in a time, smoothly and straight, and stay there for a pause."""

    to: tuple[float, float, float]
    seconds: float
    pause_s: float = 0.4
    inclination_deg: float = 10.0


@dataclass(frozen=True)
class Performance:
    """What a figure did, and when its hands started and stopped in each phase."""

    track: PoseTrack
    angles: JointAngles
    scene: WorldScene
    starts_s: tuple[float, ...]
    ends_s: tuple[float, ...]

    def detect(self, **options: Any) -> LiftFindings:
        return detect_lifts(self.track, self.angles, self.scene, stature_m=STATURE_M, **options)


REACH = Phase(FLOOR, 1.0, inclination_deg=70.0)
LIFT = Phase(TABLE, 1.2)
RETURN = Phase(HANGING, 0.8, inclination_deg=0.0)


def minimum_jerk(share: Array) -> Array:
    share = np.clip(share, 0.0, 1.0)
    return share**3 * (10 - 15 * share + 6 * share**2)


def make_scene(*, azimuth_deg: float = 90.0, **errors: float) -> WorldScene:
    """Return a scene that is known exactly, but for the errors given."""
    exact = {
        "scale_sigma": 0.0,
        "tilt_sigma_deg": 0.0,
        "heading_sigma_deg": 0.0,
        "floor_sigma_m": 0.0,
        "plane_sigma_m": 0.0,
        "depth_sigma_m": 0.0,
    }
    return WorldScene(
        camera=place_camera(azimuth_deg=azimuth_deg),
        view_azimuth_deg=azimuth_deg,
        **{**exact, **errors},
    )


TYPICAL = {
    "scale_sigma": 0.02,
    "tilt_sigma_deg": 6.0,
    "heading_sigma_deg": 9.0,
    "floor_sigma_m": 0.015,
    "plane_sigma_m": 0.03,
    "depth_sigma_m": 0.085,
}


def perform(
    *phases: Phase,
    fps: float = 30.0,
    rest_s: float = 0.5,
    separation_m: float = 0.40,
    start: tuple[float, float, float] = HANGING,
    start_inclination_deg: float = 0.0,
    confidence: float = 0.95,
    knee_height_m: float | None = None,
    walk_m: float = 0.0,
    turn_deg: float = 0.0,
    offset_s: float = 0.0,
    scene: WorldScene | None = None,
) -> Performance:
    """Make the track of a figure whose hands go through the phases; feet stay or walk evenly."""
    starts, ends, now = [], [], rest_s
    for phase in phases:
        starts.append(now)
        ends.append(now + phase.seconds)
        now = ends[-1] + phase.pause_s
    time_s = np.arange(round((now + rest_s) * fps) + 1) / fps
    hands = np.tile(start, (len(time_s), 1)).astype(float)
    inclination = np.full(len(time_s), start_inclination_deg)
    before, before_deg = np.array(start), start_inclination_deg
    for phase, begin, end in zip(phases, starts, ends, strict=True):
        share = minimum_jerk((time_s - begin) / (end - begin))
        hands += share[:, None] * (np.array(phase.to) - before)
        inclination += share * (phase.inclination_deg - before_deg)
        before, before_deg = np.array(phase.to), phase.inclination_deg
    position = pose_figure(hands, inclination, separation_m)
    if knee_height_m is not None:
        for side in ("left", "right"):
            position[:, COLUMN[f"{side}_knee"], 1] = knee_height_m
    share = np.linspace(0.0, 1.0, len(time_s))
    position[:, :, 0] += walk_m * share[:, None]
    turn_feet(position, np.radians(turn_deg) * minimum_jerk(2 * share - 0.5))
    track = PoseTrack(
        time_s=time_s + offset_s,
        position=position,
        unit="m",
        frame_of_reference="world",
        skeleton="mediapipe_33",
        confidence=np.full(position.shape[:2], confidence),
    )
    angles = JointAngles(time_s + offset_s, inclination[:, None], ("trunk_flexion",))
    return Performance(track, angles, scene or make_scene(), tuple(starts), tuple(ends))


def pose_figure(hands: Array, inclination_deg: Array, separation_m: float) -> Array:
    """Bend the upright figure at the hips and put its hands where they belong, (T, 33, 3)."""
    position = np.repeat(UPRIGHT[None], len(hands), axis=0)
    low = ("hip", "knee", "ankle", "heel", "big_toe")
    upper = [i for i, name in enumerate(NAMES) if name.split("_", 1)[-1] not in low]
    x, y = position[:, upper, 0], position[:, upper, 1] - PELVIS_Y
    angle = np.radians(inclination_deg)[:, None]
    position[:, upper, 0] = np.cos(angle) * x + np.sin(angle) * y
    position[:, upper, 1] = PELVIS_Y - np.sin(angle) * x + np.cos(angle) * y
    for side, sign in (("left", -1.0), ("right", 1.0)):
        hand = hands + np.array([0.0, 0.0, sign * separation_m / 2])
        for part in ("wrist", "index", "pinky", "thumb"):
            position[:, COLUMN[f"{side}_{part}"]] = hand
        shoulder = position[:, COLUMN[f"{side}_shoulder"]]
        position[:, COLUMN[f"{side}_elbow"]] = 0.5 * (shoulder + hand)
    return position


def turn_feet(position: Array, angle: Array) -> None:
    """Turn heels and toes about the ankles to the left, in place."""
    for side in ("left", "right"):
        ankle = position[:, COLUMN[f"{side}_ankle"]]
        for part in ("heel", "big_toe"):
            point = position[:, COLUMN[f"{side}_{part}"]]
            x, z = (point - ankle)[:, 0], (point - ankle)[:, 2]
            point[:, 0] = ankle[:, 0] + np.cos(angle) * x + np.sin(angle) * z
            point[:, 2] = ankle[:, 2] - np.sin(angle) * x + np.cos(angle) * z


def crossing_s(seconds: float, path_m: float, *, floor: float = 0.10, share: float = 0.12) -> float:
    """Return how long after its start a minimum-jerk movement reaches the threshold speed."""
    grid = np.linspace(0.0, 0.5, 20001)
    speed = 30 * grid**2 * (1 - grid) ** 2 * path_m / seconds
    threshold = max(floor, share * speed[-1])
    return float(grid[np.argmax(speed >= threshold)] * seconds)


def hold(
    *,
    ankles: tuple[Sequence[float], Sequence[float]],
    knuckles: tuple[Sequence[float], Sequence[float]],
    confidence: tuple[float, float] = (1.0, 1.0),
    n_frames: int = 15,
) -> PoseTrack:
    """Return a still person of whom ankles and knuckles (left, right) are known."""
    position = np.full((n_frames, len(NAMES), 3), np.nan)
    certain = np.ones(position.shape[:2])
    for i, side in enumerate(("left", "right")):
        position[:, COLUMN[f"{side}_ankle"]] = ankles[i]
        for part in ("wrist", "index", "pinky"):
            position[:, COLUMN[f"{side}_{part}"]] = knuckles[i]
            certain[:, COLUMN[f"{side}_{part}"]] = confidence[i]
    return PoseTrack(
        np.arange(n_frames) / 30, position, "m", "world", "mediapipe_33", confidence=certain
    )


ANKLES = ((0.0, 0.08, -0.10), (0.0, 0.08, 0.10))
# Manual of the project's methods, vectors G1 to G3: name, ankles, knuckles, H, V, A.
GEOMETRY = [
    pytest.param(ANKLES, ((0.40, 0.30, -0.15), (0.40, 0.30, 0.15)), 40.0, 30.0, 0.0, id="G1"),
    pytest.param(ANKLES, ((0.30, 0.90, 0.15), (0.30, 0.90, 0.45)), 42.43, 90.0, 45.0, id="G2"),
    pytest.param(
        ((0.05, 0.08, -0.12), (-0.05, 0.08, 0.12)),
        ((0.35, 1.20, -0.50), (0.15, 1.20, -0.30)),
        47.17,
        120.0,
        57.99,
        id="G3",
    ),
]


class TestTwoHands:
    """Which hand the middle follows when one is known worse than the other."""

    KNUCKLES = ((0.40, 0.9, -0.2), (0.60, 0.9, 0.2))

    def follow(self, left_sigma: float, **errors: float) -> float:
        track = hold(ankles=((0.0, 0.1, -0.1), (0.0, 0.1, 0.1)), knuckles=self.KNUCKLES)
        sigma = np.full(track.confidence.shape, 0.02)
        sigma[:, COLUMN["left_wrist"]] = left_sigma
        scene = make_scene(**errors)
        mid = compute_hands(dataclasses.replace(track, sigma=sigma), scene).mid
        return float(mid[5, 0])

    def test_equal_errors_count_alike(self):
        assert self.follow(0.02, plane_sigma_m=0.02, depth_sigma_m=0.02) == pytest.approx(0.5)

    def test_with_two_views_the_worse_hand_hardly_counts(self):
        near = 0.6 - 0.2 * (1 / 101)
        found = self.follow(0.2, plane_sigma_m=0.02, depth_sigma_m=0.02)
        assert found == pytest.approx(near, abs=1e-6)

    def test_with_one_view_errors_along_the_line_of_sight_tell_nothing(self):
        assert self.follow(0.2, plane_sigma_m=0.02, depth_sigma_m=0.08) == pytest.approx(0.5)


class TestMeasureEnd:
    @pytest.mark.parametrize(("ankles", "knuckles", "H", "V", "A"), GEOMETRY)
    @pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 135.0, -120.0])
    def test_vectors(self, ankles, knuckles, H, V, A, azimuth_deg):
        track, scene = hold(ankles=ankles, knuckles=knuckles), make_scene(azimuth_deg=azimuth_deg)
        end = measure_end(track, compute_hands(track, scene), scene, at_s=0.25)
        assert end.H_cm.value == pytest.approx(H, abs=0.005)
        assert end.V_cm.value == pytest.approx(V, abs=0.005)
        assert end.A_deg.value == pytest.approx(A, abs=0.005)
        assert end.H_cm.sigma == pytest.approx(0.0, abs=1e-9)
        assert end.V_cm.sigma == pytest.approx(0.0, abs=1e-9)
        assert end.A_deg.sigma == pytest.approx(0.0, abs=1e-9)

    @pytest.mark.parametrize(("ankles", "knuckles", "H", "V", "A"), GEOMETRY)
    def test_a_turned_world_changes_nothing(self, ankles, knuckles, H, V, A):
        turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        track = hold(
            ankles=tuple(np.array(ankles) @ turn.T), knuckles=tuple(np.array(knuckles) @ turn.T)
        )
        scene = make_scene()
        # The rightly turned forward direction is given; the knuckles' own axes are not used.
        end = measure_end(
            track, compute_hands(track, scene), scene, at_s=0.2, forward=turn @ [1.0, 0.0, 0.0]
        )
        assert (end.H_cm.value, end.V_cm.value, end.A_deg.value) == pytest.approx(
            (H, V, A), abs=0.005
        )

    def test_behind_the_feet_is_more_than_a_right_angle(self):
        track = hold(ankles=ANKLES, knuckles=((-0.3, 0.8, 0.15), (-0.3, 0.8, 0.45)))
        scene = make_scene()
        end = measure_end(track, compute_hands(track, scene), scene, at_s=0.2)
        assert end.A_deg.value == pytest.approx(135.0)

    def test_median_over_a_tenth_of_a_second_ignores_one_bad_frame(self):
        track = hold(ankles=ANKLES, knuckles=((0.40, 0.30, -0.15), (0.40, 0.30, 0.15)))
        position = np.array(track.position)
        position[6, [COLUMN["left_index"], COLUMN["right_index"]]] += 0.5
        track = dataclasses.replace(track, position=position)
        scene = make_scene()
        end = measure_end(track, compute_hands(track, scene), scene, at_s=0.2)
        assert (end.H_cm.value, end.V_cm.value) == pytest.approx((40.0, 30.0))

    def test_unseen_hands_or_feet_are_missing(self):
        track = hold(ankles=ANKLES, knuckles=(np.full(3, np.nan), np.full(3, np.nan)))
        scene = make_scene()
        end = measure_end(track, compute_hands(track, scene), scene, at_s=0.2)
        assert end.H_cm.is_missing
        assert end.V_cm.is_missing
        assert end.A_deg.is_missing
        lost = hold(ankles=(np.full(3, np.nan), np.zeros(3)), knuckles=ANKLES)
        assert measure_end(lost, compute_hands(lost, scene), scene, at_s=0.2).H_cm.is_missing

    def test_one_seen_hand_stands_for_both(self):
        track = hold(ankles=ANKLES, knuckles=((0.40, 0.30, 0.0), np.full(3, np.nan)))
        scene = make_scene()
        end = measure_end(track, compute_hands(track, scene), scene, at_s=0.2)
        assert (end.H_cm.value, end.V_cm.value) == pytest.approx((40.0, 30.0))

    @pytest.mark.parametrize(
        ("error", "touched"),
        [
            ({"scale_sigma": 0.05}, {"H_cm", "V_cm"}),
            ({"floor_sigma_m": 0.02}, {"V_cm"}),
            ({"plane_sigma_m": 0.02}, {"H_cm", "V_cm"}),
            ({"depth_sigma_m": 0.08}, {"A_deg"}),
            ({"heading_sigma_deg": 9.0}, {"A_deg"}),
        ],
        ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
    )
    def test_each_error_of_the_scene_reaches_what_it_touches(self, error, touched):
        # Seen from the right: forward and up lie across the line of sight.
        track = hold(ankles=ANKLES, knuckles=((0.40, 0.60, -0.15), (0.40, 0.60, 0.15)))
        scene = make_scene(**error)
        end = measure_end(track, compute_hands(track, scene), scene, at_s=0.2)
        sigmas = {name: getattr(end, name).sigma for name in ("H_cm", "V_cm", "A_deg")}
        assert {name for name, sigma in sigmas.items() if sigma > 0.1} >= touched
        for name in {"H_cm", "V_cm"} - touched:
            assert sigmas[name] == pytest.approx(0.0, abs=1e-6)

    def test_scale_error_is_a_share_of_the_distance(self):
        track = hold(ankles=ANKLES, knuckles=((0.40, 0.60, -0.15), (0.40, 0.60, 0.15)))
        scene = make_scene(scale_sigma=0.05)
        end = measure_end(track, compute_hands(track, scene), scene, at_s=0.2)
        assert end.H_cm.sigma == pytest.approx(0.05 * 40.0)
        assert end.V_cm.sigma == pytest.approx(0.05 * 60.0)

    def test_tilt_raises_what_is_nearer_to_the_camera(self):
        # Filmed from the front, hands 0.4 m nearer than the feet: 0.4 m x sin(5 deg) = 3.5 cm.
        track = hold(ankles=ANKLES, knuckles=((0.40, 0.60, -0.15), (0.40, 0.60, 0.15)))
        scene = make_scene(azimuth_deg=0.0, tilt_sigma_deg=5.0)
        end = measure_end(track, compute_hands(track, scene), scene, at_s=0.2)
        assert end.V_cm.sigma == pytest.approx(40.0 * np.radians(5.0), rel=1e-6)

    def test_hidden_hands_have_wider_errors(self):
        places = {"ankles": ANKLES, "knuckles": ((0.40, 0.60, -0.15), (0.40, 0.60, 0.15))}
        scene = make_scene(**TYPICAL)
        ends = []
        for confidence in (0.95, 0.2):
            track = hold(**places, confidence=(confidence, confidence))
            ends.append(measure_end(track, compute_hands(track, scene), scene, at_s=0.2))
        for name in ("H_cm", "V_cm", "A_deg"):
            assert getattr(ends[1], name).sigma > 1.5 * getattr(ends[0], name).sigma

    @settings(max_examples=30)
    @given(
        x=st.floats(0.2, 0.7), y=st.floats(0.0, 1.8), z=st.floats(-0.6, 0.6), side=st.floats(0, 360)
    )
    def test_mirroring_leaves_all_but_the_side_alone(self, x, y, z, side):
        knuckles = ((x, y, z - 0.2), (x, y, z + 0.2))
        mirrored = tuple(np.array(k) * [1, 1, -1] for k in knuckles[::-1])
        ends = []
        for hands, azimuth in ((knuckles, side), (mirrored, -side)):
            track = hold(ankles=ANKLES, knuckles=hands)
            scene = make_scene(azimuth_deg=azimuth, **TYPICAL)
            ends.append(measure_end(track, compute_hands(track, scene), scene, at_s=0.2))
        for name in ("H_cm", "V_cm", "A_deg"):
            a, b = getattr(ends[0], name), getattr(ends[1], name)
            assert (a.value, a.sigma) == pytest.approx((b.value, b.sigma), abs=1e-6)


class TestKnuckles:
    def test_from_wrist_and_elbow_vector_g5(self):
        position = np.zeros((1, len(H36M_17.keypoints), 3))
        position[0, H36M_17.index("left_elbow")] = (0.0, 1.2, 0.0)
        position[0, H36M_17.index("left_wrist")] = (0.25, 1.0, 0.0)
        knuckle = compute_knuckles(position, H36M_17, "left", sex="male")
        assert knuckle[0] == pytest.approx((0.33, 0.936, 0.0))

    @pytest.mark.parametrize(("sex", "ratio"), [("male", 0.32), ("female", 0.30), (None, 0.31)])
    def test_hand_length_by_sex(self, sex, ratio):
        position = np.zeros((1, len(H36M_17.keypoints), 3))
        position[0, H36M_17.index("right_wrist")] = (1.0, 0.0, 0.0)
        knuckle = compute_knuckles(position, H36M_17, "right", sex=sex)
        assert knuckle[0] == pytest.approx((1.0 + ratio, 0.0, 0.0))

    def test_middle_of_the_knuckles_where_they_are_known(self):
        position = np.zeros((1, len(NAMES), 3))
        position[0, COLUMN["left_index"]] = (0.2, 0.4, 0.0)
        position[0, COLUMN["left_pinky"]] = (0.4, 0.2, 0.0)
        knuckle = compute_knuckles(position, MEDIAPIPE_33, "left", sex="male")
        assert knuckle[0] == pytest.approx((0.3, 0.3, 0.0))


class TestTimes:
    @pytest.mark.parametrize("fps", [25.0, 30.0, 60.0, 120.0])
    def test_start_and_end_are_where_the_speed_crosses_the_threshold(self, fps):
        scene = perform(REACH, LIFT, RETURN, fps=fps)
        (lift,) = scene.detect().lifts
        wait = crossing_s(1.2, 0.70)
        assert lift.start_s == pytest.approx(scene.starts_s[1] + wait, abs=1.5 / fps)
        assert lift.end_s == pytest.approx(scene.ends_s[1] - wait, abs=1.5 / fps)
        assert lift.start_s == pytest.approx(scene.starts_s[1], abs=0.2)
        assert lift.end_s == pytest.approx(scene.ends_s[1], abs=0.2)
        assert lift.reach_start_s == pytest.approx(scene.starts_s[0], abs=0.2)
        assert lift.return_end_s == pytest.approx(scene.ends_s[2], abs=0.2)

    def test_peak_speeds(self):
        (lift,) = perform(REACH, LIFT, RETURN, fps=120.0).detect().lifts
        # Minimum jerk: the peak is 1.875 times the mean speed.
        assert lift.peak_hand_speed_m_s == pytest.approx(1.875 * 0.70 / 1.2, rel=0.01)
        assert lift.peak_trunk_velocity_deg_s == pytest.approx(1.875 * 60.0 / 1.2, rel=0.01)

    def test_both_ends_are_measured(self):
        (lift,) = perform(REACH, LIFT, RETURN, fps=60.0).detect().lifts
        assert lift.origin.V_cm.value == pytest.approx(30.0, abs=1.0)
        assert lift.origin.H_cm.value == pytest.approx(40.0, abs=0.5)
        assert lift.destination.V_cm.value == pytest.approx(100.0, abs=1.0)
        assert lift.D_cm.value == pytest.approx(70.0, abs=2.0)
        assert lift.D_cm.value == pytest.approx(
            lift.destination.V_cm.value - lift.origin.V_cm.value
        )
        assert lift.hands == 2
        assert lift.notes == ()

    def test_slow_in_the_middle_is_still_one_lift(self):
        # Up past the shelf's edge, then forward onto it, without a stop between.
        path = (Phase((0.40, 0.95, 0.0), 1.0, pause_s=-0.35), Phase((0.60, 1.05, 0.0), 0.8))
        lifts = perform(REACH, *path, RETURN).detect().lifts
        assert len(lifts) == 1
        assert lifts[0].destination.V_cm.value == pytest.approx(105.0, abs=2.0)

    def test_standard_errors_of_the_times_are_small_but_not_nothing(self):
        (lift,) = perform(REACH, LIFT, RETURN, scene=make_scene(**TYPICAL)).detect().lifts
        assert 0.005 < lift.start_sigma_s < 0.1
        assert 0.005 < lift.end_sigma_s < 0.1

    @settings(max_examples=20)
    @given(offset_s=st.floats(0.0, 1e4))
    def test_shifting_time_shifts_events(self, offset_s):
        (here,) = perform(REACH, LIFT, RETURN).detect().lifts
        (there,) = perform(REACH, LIFT, RETURN, offset_s=offset_s).detect().lifts
        for name in ("start_s", "end_s", "reach_start_s", "return_end_s"):
            assert getattr(there, name) - offset_s == pytest.approx(getattr(here, name), abs=1e-6)
        assert_same_measures(here, there)

    @settings(max_examples=20)
    @given(
        azimuth_deg=st.sampled_from([0.0, 45.0, 90.0, 135.0, 180.0]),
        z=st.floats(-0.4, 0.4),
        y=st.floats(0.55, 1.5),
    )
    def test_mirroring_left_and_right_leaves_the_lift_alone(self, azimuth_deg, z, y):
        to = Phase((0.40, y, z), 1.2)
        scene = make_scene(azimuth_deg=azimuth_deg, **TYPICAL)
        seen = perform(REACH, to, RETURN, scene=scene)
        order = list(MEDIAPIPE_33.mirror_order)
        mirrored = dataclasses.replace(
            seen,
            track=dataclasses.replace(
                seen.track, position=np.asarray(seen.track.position)[:, order] * [1, 1, -1]
            ),
            scene=make_scene(azimuth_deg=-azimuth_deg, **TYPICAL),
        )
        (here,), (there,) = seen.detect().lifts, mirrored.detect().lifts
        assert (here.start_s, here.end_s) == (there.start_s, there.end_s)
        assert_same_measures(here, there)

    @settings(max_examples=25)
    @given(
        low=st.floats(0.0, 0.6),
        rise=st.floats(0.4, 1.0),
        seconds=st.floats(0.8, 2.0),
        reach=st.floats(0.35, 0.6),
    )
    def test_any_plain_lift_is_found_and_measured(self, low, rise, seconds, reach):
        scene = perform(
            Phase((reach, low, 0.0), 1.0, inclination_deg=60.0),
            Phase((reach, low + rise, 0.0), seconds),
            RETURN,
            fps=60.0,
        )
        (lift,) = scene.detect().lifts
        wait = crossing_s(seconds, rise)
        assert lift.start_s == pytest.approx(scene.starts_s[1] + wait, abs=0.03)
        assert lift.end_s == pytest.approx(scene.ends_s[1] - wait, abs=0.03)
        assert lift.origin.V_cm.value == pytest.approx(100 * low, abs=2.5)
        assert lift.destination.V_cm.value == pytest.approx(100 * (low + rise), abs=2.5)
        assert lift.origin.H_cm.value == pytest.approx(100 * reach, abs=0.5)


def assert_same_measures(here: Lift, there: Lift) -> None:
    for end in ("origin", "destination"):
        for name in ("H_cm", "V_cm", "A_deg"):
            a, b = (getattr(getattr(lift, end), name) for lift in (here, there))
            assert (a.value, a.sigma) == pytest.approx((b.value, b.sigma), abs=1e-6)
    assert here.D_cm.value == pytest.approx(there.D_cm.value, abs=1e-6)
    assert here.notes == there.notes


class TestWhatCounts:
    def test_several_lifts_with_hanging_arms_between(self):
        scene = perform(REACH, LIFT, RETURN, REACH, Phase(SHELF, 1.5), RETURN)
        lifts = scene.detect().lifts
        assert [round(lift.destination.V_cm.value, -1) for lift in lifts] == [100, 140]
        assert lifts[1].start_s == pytest.approx(scene.starts_s[4], abs=0.2)

    def test_lowering(self):
        scene = perform(
            Phase(TABLE, 1.0), Phase(FLOOR, 1.2, inclination_deg=70.0), Phase(HANGING, 1.0, 0.4, 0)
        )
        (lift,) = scene.detect().lifts
        assert lift.origin.V_cm.value == pytest.approx(100.0, abs=2.0)
        assert lift.destination.V_cm.value == pytest.approx(30.0, abs=2.0)
        assert lift.D_cm.value == pytest.approx(70.0, abs=3.0)

    @pytest.mark.parametrize("direction", ["up", "down"])
    def test_pick_and_place_counts_the_dominant_direction(self, direction):
        down = Phase(FLOOR, 1.2, inclination_deg=70.0)
        path = (REACH, LIFT, down, LIFT, down, LIFT, RETURN)
        if direction == "down":
            path = (LIFT, down, LIFT, down, LIFT, down, Phase(HANGING, 1.0, 0.4, 0.0))
        findings = perform(*path).detect()
        rises = [x.destination.V_cm.value - x.origin.V_cm.value for x in findings.lifts]
        assert len(rises) == 3
        assert all(rise > 0 for rise in rises) == (direction == "up")
        assert all("one_direction" in lift.notes for lift in findings.lifts)
        assert any("direction" in text for text in findings.warnings)

    def test_equally_often_up_and_down_counts_up(self):
        down = Phase(FLOOR, 1.2, inclination_deg=70.0)
        findings = perform(REACH, LIFT, down, RETURN).detect()
        (lift,) = findings.lifts
        assert lift.destination.V_cm.value > lift.origin.V_cm.value

    def test_lift_until_the_arms_hang_is_a_doubtful_one(self):
        findings = perform(REACH, Phase(HANGING, 1.2, 0.4, 0.0)).detect()
        (lift,) = findings.lifts
        assert lift.notes == ("ends_at_rest",)
        assert any("hanging arms" in text for text in findings.warnings)

    @pytest.mark.parametrize(
        "path",
        [
            pytest.param((), id="standing"),
            pytest.param((Phase(TABLE, 1.0), RETURN), id="reaching to a table and back"),
            pytest.param(
                tuple(Phase((0.1 * (-1) ** k, 0.78, 0.0), 0.5, 0.0, 0.0) for k in range(8)),
                id="swinging arms",
            ),
        ],
    )
    def test_no_lift(self, path):
        findings = perform(*path).detect()
        assert findings.lifts == ()
        assert findings.warnings == ()

    def test_walking_is_no_lift(self):
        findings = perform(
            *(Phase((0.12 * (-1) ** k, 0.78, 0.0), 0.5, 0.0, 0.0) for k in range(8)), walk_m=5.0
        ).detect()
        assert findings.lifts == ()

    def test_waving_is_no_lift(self):
        # One hand is raised, sways sideways, and goes down; the other hangs.
        still = perform(Phase(HANGING, 8.0, inclination_deg=0.0), fps=30.0)
        position, time_s = np.array(still.track.position), np.asarray(still.track.time_s)
        up = minimum_jerk((time_s - 1.0) / 0.8) - minimum_jerk((time_s - 6.5) / 0.8)
        sway = 0.15 * np.sin(2 * np.pi * 1.5 * time_s) * (up > 0.99)
        for part in ("wrist", "index", "pinky", "thumb"):
            position[:, COLUMN[f"right_{part}"]] += np.stack(
                [0.2 * up, 0.9 * up, 0.3 * up + sway], axis=1
            )
        track = dataclasses.replace(still.track, position=position)
        findings = dataclasses.replace(still, track=track).detect()
        assert findings.lifts == ()

    def test_hands_far_apart_hold_no_common_load(self):
        # From the side the distance between the hands lies along the line of sight, unseen.
        for separation_m, azimuth_deg, hands in ((0.75, 0, 1), (0.55, 0, 2), (0.75, 90, 2)):
            scene = make_scene(azimuth_deg=azimuth_deg)
            (lift,) = (
                perform(REACH, LIFT, RETURN, separation_m=separation_m, scene=scene).detect().lifts
            )
            assert lift.hands == hands
            assert ("one_handed" in lift.notes) == (hands == 1)

    def test_kneeling(self):
        (lift,) = perform(REACH, LIFT, RETURN, knee_height_m=0.06).detect().lifts
        assert "kneeling" in lift.notes

    def test_carrying_is_noted(self):
        lifts = perform(REACH, LIFT, RETURN, walk_m=4.0).detect().lifts
        assert lifts
        assert all("walking" in lift.notes for lift in lifts)

    def test_a_pivot_is_noted_and_the_feet_at_the_destination_count(self):
        to_the_left = Phase((0.0, 1.0, -0.40), 1.2)
        (still,) = perform(REACH, to_the_left, RETURN).detect().lifts
        (turned,) = perform(REACH, to_the_left, RETURN, turn_deg=90.0).detect().lifts
        assert "pivot" not in still.notes
        assert still.destination.A_deg.value == pytest.approx(90.0, abs=3.0)
        assert "pivot" in turned.notes
        assert turned.destination.A_deg.value < 40.0

    def test_sitting_is_a_condition_of_the_whole_clip(self):
        scene = perform(REACH, LIFT, RETURN)
        assert scene.detect().conditions == ()
        position = np.array(scene.track.position)
        for side in ("left", "right"):
            position[:, COLUMN[f"{side}_hip"], 1] = 0.45
        seated = dataclasses.replace(
            scene, track=dataclasses.replace(scene.track, position=position)
        )
        assert seated.detect().conditions == ("seated",)

    @pytest.mark.parametrize(("rise_m", "count"), [(0.08, 0), (0.14, 1)])
    def test_a_lift_rises_ten_centimetres(self, rise_m, count):
        path = (Phase(TABLE, 1.0), Phase((0.75, TABLE[1] + rise_m, 0.0), 0.8), RETURN)
        findings = perform(*path).detect()
        assert len(findings.lifts) == count


class TestLeftOut:
    def test_faster_than_loads_are_lifted(self):
        # 1.15 m in 0.35 s: 1.875 times the mean speed is 6.2 m/s.
        findings = perform(REACH, Phase(SHELF, 0.35), RETURN, fps=60.0).detect()
        assert findings.lifts == ()
        (text,) = findings.warnings
        assert "6.1 m/s" in text
        assert "4 m/s" in text
        assert "from 1.9 to 2.2 s" in text

    def test_a_quick_lift_still_counts(self):
        findings = perform(REACH, Phase(SHELF, 0.7), RETURN, fps=60.0).detect()
        assert len(findings.lifts) == 1
        assert findings.lifts[0].peak_hand_speed_m_s > 3.0
        assert findings.warnings == ()

    def test_a_leap_of_the_estimator_does_not_hide_the_lift_beside_it(self):
        # The hands leap to the head and back within two frames, well after the lift.
        scene = perform(REACH, LIFT, RETURN, rest_s=1.0)
        position = np.array(scene.track.position)
        hands = [i for i, n in enumerate(NAMES) if n.endswith(("wrist", "index", "pinky"))]
        position[-20:-16, hands, 1] += 0.8
        jumped = dataclasses.replace(
            scene, track=dataclasses.replace(scene.track, position=position)
        ).detect()
        assert [x.start_s for x in jumped.lifts] == [x.start_s for x in scene.detect().lifts]
        assert jumped.warnings
        assert all("m/s" in text for text in jumped.warnings)

    def test_hidden_hands(self):
        findings = perform(REACH, LIFT, RETURN, confidence=0.1).detect()
        assert findings.lifts == ()
        assert any("hidden" in text for text in findings.warnings)

    def test_one_hidden_hand_is_enough_to_go_on(self):
        scene = perform(REACH, LIFT, RETURN)
        confidence = np.array(scene.track.confidence)
        confidence[:, COLUMN["left_wrist"]] = 0.05
        track = dataclasses.replace(scene.track, confidence=confidence)
        assert len(dataclasses.replace(scene, track=track).detect().lifts) == 1

    def test_lost_in_the_middle_of_the_lift(self):
        scene = lose(perform(REACH, LIFT, RETURN), 2.3, 2.9)
        findings = scene.detect()
        assert findings.lifts == ()
        assert any("not seen all the time" in text for text in findings.warnings)

    def test_lost_before_the_reach_does_not_matter(self):
        whole = perform(REACH, LIFT, RETURN, rest_s=1.5)
        lost = lose(whole, 0.2, 0.9).detect()
        assert lost.warnings == ()
        assert [x.start_s for x in lost.lifts] == [x.start_s for x in whole.detect().lifts]

    def test_never_seen(self):
        findings = lose(perform(REACH, LIFT, RETURN), -1.0, 99.0).detect()
        assert findings.lifts == ()

    @pytest.mark.parametrize(
        ("start_s", "stop_s", "words"),
        [(2.4, 99.0, "when the video starts"), (0.0, 2.5, "when the video ends")],
    )
    def test_clip_cut_within_the_lift(self, start_s, stop_s, words):
        scene = perform(REACH, LIFT, RETURN)
        keep = (scene.track.time_s >= start_s) & (scene.track.time_s <= stop_s)
        track = PoseTrack(
            scene.track.time_s[keep],
            scene.track.position[keep],
            "m",
            "world",
            "mediapipe_33",
            confidence=scene.track.confidence[keep],
        )
        angles = JointAngles(track.time_s, scene.angles.value_deg[keep], scene.angles.names)
        findings = dataclasses.replace(scene, track=track, angles=angles).detect()
        assert findings.lifts == ()
        assert any(words in text for text in findings.warnings)

    @pytest.mark.parametrize("seconds", [0.32, 9.0])
    def test_too_short_or_too_long(self, seconds):
        rise = 0.3 if seconds < 1 else 1.45
        findings = perform(
            REACH, Phase((0.4, 0.3 + rise, 0.0), seconds, inclination_deg=40.0), RETURN, fps=60.0
        ).detect()
        assert findings.lifts == ()
        assert any("a lift lasts 0.3 to 5 s" in text for text in findings.warnings)

    def test_too_few_pictures_a_second(self):
        findings = perform(REACH, LIFT, RETURN, fps=12.0).detect()
        assert findings.lifts == ()
        (text,) = findings.warnings
        assert "at least 15 frames per second" in text
        assert "has 12.0" in text

    def test_peak_speeds_at_few_pictures_are_doubted(self):
        findings = perform(REACH, LIFT, RETURN, fps=20.0).detect()
        assert len(findings.lifts) == 1
        assert any("Peak speeds need 25" in text for text in findings.warnings)

    def test_too_short_a_clip(self):
        track = make_pose_track(n_frames=2)
        angles = JointAngles(track.time_s, np.zeros((2, 1)), ("trunk_flexion",))
        findings = detect_lifts(track, angles, make_scene(), stature_m=STATURE_M)
        assert findings.lifts == ()
        assert "too short" in findings.warnings[0]


def lose(scene: Performance, start_s: float, stop_s: float) -> Performance:
    """Take the whole person away for some time."""
    position = np.array(scene.track.position)
    position[(scene.track.time_s > start_s) & (scene.track.time_s < stop_s)] = np.nan
    return dataclasses.replace(scene, track=dataclasses.replace(scene.track, position=position))


class TestSetByAPerson:
    """What a person says of when the lifts were goes before what was found."""

    SCENE = perform(REACH, LIFT, RETURN)

    def test_a_set_lift_is_measured_at_its_times(self):
        start_s, end_s = self.SCENE.starts_s[1], self.SCENE.ends_s[1]
        (lift,) = self.SCENE.detect(set_lifts=[(start_s, end_s)]).lifts
        assert (lift.start_s, lift.end_s) == pytest.approx((start_s, end_s), abs=1 / 60)
        assert lift.origin.V_cm.value == pytest.approx(30.0, abs=0.5)
        assert lift.destination.V_cm.value == pytest.approx(100.0, abs=0.5)
        assert lift.D_cm.value == pytest.approx(70.0, abs=1.0)
        assert SET_BY_USER in lift.notes
        assert (lift.start_sigma_s, lift.end_sigma_s) == (SET_SIGMA_S, SET_SIGMA_S)
        (found,) = self.SCENE.detect().lifts
        assert (lift.reach_start_s, lift.return_end_s) == (found.reach_start_s, found.return_end_s)
        assert SET_BY_USER not in found.notes

    def test_a_missed_lift_joins_the_others_in_order_of_time(self):
        scene = perform(REACH, LIFT, RETURN, rest_s=1.5)
        (found,) = scene.detect().lifts
        findings = scene.detect(set_lifts=[(0.2, 0.9)])
        assert [x.start_s for x in findings.lifts] == [pytest.approx(0.2), found.start_s]
        assert findings.lifts[1] == found

    def test_a_false_lift_is_left_out_and_nothing_is_explained(self):
        (found,) = self.SCENE.detect().lifts
        findings = self.SCENE.detect(not_lifts=[(found.start_s, found.end_s)])
        assert findings.lifts == ()
        assert findings.warnings == ()

    def test_a_lift_that_touches_a_refused_time_only_a_little_stays(self):
        (found,) = self.SCENE.detect().lifts
        before = (found.start_s - 1.0, found.start_s + 0.1)
        assert self.SCENE.detect(not_lifts=[before]).lifts == (found,)

    def test_what_was_left_out_is_no_news_where_a_person_set_a_lift(self):
        scene = perform(REACH, LIFT, RETURN, confidence=0.1)
        assert scene.detect().warnings
        start_s, end_s = scene.starts_s[1], scene.ends_s[1]
        findings = scene.detect(set_lifts=[(start_s, end_s)])
        assert len(findings.lifts) == 1
        assert not any(f"from {start_s:.1f}" in text for text in findings.warnings)

    def test_hands_that_were_not_seen_stay_unmeasured(self):
        scene = lose(self.SCENE, 1.5, 3.6)
        (lift,) = scene.detect(set_lifts=[(2.0, 3.0)]).lifts
        assert lift.origin.H_cm.is_missing
        assert lift.destination.V_cm.is_missing
        assert np.isnan([lift.peak_hand_speed_m_s, lift.D_cm.value]).all()

    def test_few_pictures_a_second_are_enough_to_measure_both_ends(self):
        scene = perform(REACH, LIFT, RETURN, fps=12.0)
        findings = scene.detect(set_lifts=[(scene.starts_s[1], scene.ends_s[1])])
        assert findings.lifts[0].origin.V_cm.value == pytest.approx(30.0, abs=2.0)
        assert any("at least 15 frames per second" in text for text in findings.warnings)

    @pytest.mark.parametrize(
        ("span", "words"),
        [
            ((1.0, 99.0), "within the clip, 0.00 to"),
            ((-1.0, 1.0), "within the clip"),
            ((2.0, 1.0), "within the clip"),
            ((1.0, 1.004), "longer than one picture"),
            ((float("nan"), 1.0), "within the clip"),
        ],
    )
    def test_impossible_times_are_refused(self, span, words):
        with pytest.raises(ConfigError, match=words):
            self.SCENE.detect(set_lifts=[span])

    @settings(max_examples=25)
    @given(times=st.tuples(st.floats(0.0, 4.0), st.floats(0.0, 4.0)).map(sorted))
    def test_lifts_never_overlap_and_keep_to_pictures(self, times):
        start_s, end_s = times
        if end_s - start_s < 1 / 30:
            return
        lifts = self.SCENE.detect(set_lifts=[(start_s, end_s)]).lifts
        (own,) = [x for x in lifts if SET_BY_USER in x.notes]
        assert abs(own.start_s - start_s) <= 1 / 60 + 1e-9
        assert abs(own.end_s - end_s) <= 1 / 60 + 1e-9
        for one, two in pairwise(lifts):
            assert one.end_s <= two.start_s


class TestNoise:
    @pytest.mark.parametrize("seed", range(5))
    def test_a_centimetre_of_noise_after_smoothing(self, seed):
        scene = perform(REACH, LIFT, RETURN, scene=make_scene(**TYPICAL))
        rng = np.random.default_rng(seed)
        noisy = np.asarray(scene.track.position)
        noisy = noisy + 0.01 * rng.standard_normal(noisy.shape)
        track = correct_track(dataclasses.replace(scene.track, position=noisy))
        (lift,) = dataclasses.replace(scene, track=track).detect().lifts
        assert lift.start_s == pytest.approx(scene.starts_s[1], abs=0.2)
        assert lift.end_s == pytest.approx(scene.ends_s[1], abs=0.2)
        assert lift.origin.V_cm.value == pytest.approx(30.0, abs=3.0)
        assert lift.destination.V_cm.value == pytest.approx(100.0, abs=3.0)

    def test_noise_along_the_line_of_sight_is_weighted_down(self):
        scene = perform(Phase(HANGING, 4.0, inclination_deg=0.0))
        position = np.array(scene.track.position)
        position[:, :, 2] += 0.03 * np.sin(2 * np.pi * 3 * scene.track.time_s)[:, None]
        track = dataclasses.replace(scene.track, position=position)
        exact = compute_hands(track, make_scene())
        typical = compute_hands(track, make_scene(**TYPICAL))
        assert np.max(exact.speed) > 0.5
        assert np.max(typical.speed) == pytest.approx(
            (TYPICAL["plane_sigma_m"] / TYPICAL["depth_sigma_m"]) ** 2 * np.max(exact.speed)
        )
        assert find_moves(exact)
        assert not find_moves(typical)
