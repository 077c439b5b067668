from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from engine.cameras.monocular import (
    align_with_line_of_sight,
    assumed_camera_matrix,
    compute_rays,
    find_upright_frames,
    reconstruct_single_view,
    up_direction,
)
from engine.datatypes import Array, Camera, Measurement, PoseTrack, Subject, ViewPose, WorldScene
from engine.errors import AssessmentError
from engine.skeletons import MEDIAPIPE_33
from tests.engine.cameras.truth import (
    CLIPS,
    NAMES,
    Truth,
    make_view,
    place_camera,
    read_truth,
    see,
)

COLUMN = {name: i for i, name in enumerate(NAMES)}
HANDS = [COLUMN[f"{s}_{n}"] for s in ("left", "right") for n in ("index", "pinky")]
ALL = tuple(NAMES)


@pytest.fixture(scope="module", params=CLIPS)
def truth(request: pytest.FixtureRequest) -> Truth:
    return read_truth(request.param)


@pytest.fixture(scope="module")
def lift() -> Truth:
    return read_truth("floor_to_knuckle")


@pytest.fixture(scope="module")
def seen(lift: Truth) -> ViewPose:
    return see(lift.points, lift.cameras["cam90"], lift.time_s)


@pytest.fixture(scope="module")
def placed(lift: Truth, seen: ViewPose) -> tuple[Array, WorldScene]:
    return place(seen, lift)


def place(
    view: ViewPose, truth: Truth, camera: Camera | None = None, **options: Any
) -> tuple[Array, WorldScene]:
    camera = camera or truth.cameras["cam90"]
    options.setdefault("matrix", camera.matrix)
    track, scene = reconstruct_single_view(view, Measurement(truth.stature_m, 0.01), **options)
    return np.array(track.position), scene


def point(position: Array, name: str) -> Array:
    return MEDIAPIPE_33.point(position, name)


def hide(view: ViewPose, parts: Sequence[str], frames: slice = slice(None)) -> ViewPose:
    """Take keypoints away whose name contains one of `parts`."""
    columns = [i for i, name in enumerate(NAMES) if any(part in name for part in parts)]
    image, body = np.array(view.image.position), np.array(view.body.position)
    for column in columns:
        image[frames, column] = body[frames, column] = np.nan
    return make_view(image, body, np.asarray(view.image.time_s), view.info.size_px)


def cut(view: ViewPose, frames: slice) -> ViewPose:
    return make_view(
        np.asarray(view.image.position)[frames],
        np.asarray(view.body.position)[frames],
        np.asarray(view.image.time_s)[frames],
        view.info.size_px,
    )


def tilt_error_deg(scene: WorldScene, camera: Camera) -> float:
    """Return the angle between the true and the estimated upward direction in the camera."""
    cosine = scene.camera.rotation[:, 1] @ camera.rotation[:, 1]
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


class TestAgainstTruth:
    """Exact keypoints and the true lens: what is left is what one picture can't tell."""

    @pytest.mark.parametrize("view", ["cam90", "cam135"])
    @pytest.mark.parametrize("knows_lens", [True, False], ids=["known lens", "assumed lens"])
    def test_hands_where_the_load_is_lifted_and_placed(self, truth, view, knows_lens):
        camera = truth.cameras[view]
        matrix = camera.matrix if knows_lens else None
        found, scene = place(see(truth.points, camera, truth.time_s), truth, camera, matrix=matrix)
        hands, true = found[:, HANDS].mean(axis=1), truth.points[:, HANDS].mean(axis=1)
        feet, true_feet = point(found, "mid_ankle"), point(truth.points, "mid_ankle")
        for event in ("lift_start", "place"):
            frame = truth.at(truth.events_s[event])
            V_error = hands[frame, 1] - true[frame, 1]
            H = np.linalg.norm((hands - feet)[frame, [0, 2]])
            true_H = np.linalg.norm((true - true_feet)[frame, [0, 2]])
            assert abs(V_error) < 0.045
            assert abs(H - true_H) < (0.04 if view == "cam90" else 0.10)
            sigma = np.hypot(scene.plane_sigma_m, 0.03)
            assert abs(V_error) < 2 * sigma

    def test_axes_are_the_subjects(self, truth):
        camera = truth.cameras["cam90"]
        found, _ = place(see(truth.points, camera, truth.time_s), truth)
        standing = found[:10].mean(axis=0)
        true = truth.points[:10].mean(axis=0)
        up = standing[COLUMN["left_ear"], 1] - standing[COLUMN["left_ankle"], 1]
        assert up == pytest.approx(true[COLUMN["left_ear"], 1] - 0.097, abs=0.03)
        for side, sign in (("left", -1), ("right", 1)):
            forward = standing[COLUMN[f"{side}_big_toe"]] - standing[COLUMN[f"{side}_heel"]]
            assert forward[0] > 0.2
            assert abs(forward[2]) < 0.06
            assert sign * standing[COLUMN[f"{side}_hip"], 2] > 0.05
            assert sign * standing[COLUMN[f"{side}_shoulder"], 2] > 0.05

    def test_floor_is_at_zero_and_the_ankles_at_the_origin(self, truth):
        found, _ = place(see(truth.points, truth.cameras["cam90"], truth.time_s), truth)
        for side in ("left", "right"):
            for part in ("ankle", "heel", "big_toe"):
                true = truth.points[:, COLUMN[f"{side}_{part}"], 1]
                assert found[:, COLUMN[f"{side}_{part}"], 1] == pytest.approx(true, abs=0.035)
        assert point(found, "mid_ankle")[:, [0, 2]] == pytest.approx(0.0, abs=0.05)

    def test_scale_comes_from_the_stature(self, truth):
        found, _ = place(see(truth.points, truth.cameras["cam90"], truth.time_s), truth)
        for a, b in (("hip", "knee"), ("knee", "ankle")):
            for side in ("left", "right"):
                columns = COLUMN[f"{side}_{a}"], COLUMN[f"{side}_{b}"]
                length, true = (
                    np.linalg.norm(p[:10, columns[0]] - p[:10, columns[1]], axis=1).mean()
                    for p in (found, truth.points)
                )
                assert length == pytest.approx(true, rel=0.03)

    def test_picture_is_reproduced(self, truth):
        # Depths move points along their lines of sight only: the view must not change.
        camera = truth.cameras["cam135"]
        view = see(truth.points, camera, truth.time_s)
        found, scene = place(view, truth, camera)
        local = found @ scene.camera.rotation.T + scene.camera.translation
        pixels = local @ scene.camera.matrix.T
        assert pixels[..., :2] / pixels[..., 2:] == pytest.approx(
            np.asarray(view.image.position), abs=1e-6
        )

    @pytest.mark.parametrize("azimuth_deg", [60.0, 90.0, 120.0, -90.0, -135.0])
    def test_where_the_camera_stands(self, lift, azimuth_deg):
        camera = place_camera(azimuth_deg=azimuth_deg)
        found, scene = place(see(lift.points, camera, lift.time_s), lift, camera)
        assert scene.view_azimuth_deg == pytest.approx(azimuth_deg, abs=2 * scene.heading_sigma_deg)
        assert scene.provenance["camera_distance_m"] == pytest.approx(4.0, rel=0.05)
        assert scene.provenance["camera_height_m"] == pytest.approx(1.3, abs=0.3)
        assert np.isfinite(found).all()

    def test_provenance_says_what_was_assumed(self, lift, seen, placed):
        _, scene = place(seen, lift, matrix=None)
        assert scene.provenance["camera_matrix"] == "assumed"
        assert placed[1].provenance["camera_matrix"] == "user"
        assert placed[1].provenance["upright_frames"] > 20


class TestCameraPose:
    @pytest.mark.parametrize("roll_deg", [-5.0, 5.0])
    def test_rolled_camera(self, lift, roll_deg):
        camera = place_camera(roll_deg=roll_deg)
        found, scene = place(see(lift.points, camera, lift.time_s), lift, camera)
        # A small share of the roll is believed, as people do not stand exactly upright either.
        assert np.sign(scene.provenance["roll_deg"]) == np.sign(roll_deg)
        assert tilt_error_deg(scene, camera) < 5.0
        assert tilt_error_deg(scene, camera) < 2 * scene.tilt_sigma_deg
        frame = lift.at(lift.events_s["lift_start"])
        hands = found[frame, HANDS, 1].mean()
        assert hands == pytest.approx(lift.points[frame, HANDS, 1].mean(), abs=0.06)

    def test_roll_is_followed_when_level_is_not_trusted(self, lift):
        camera = place_camera(roll_deg=5.0)
        view = see(lift.points, camera, lift.time_s)
        _, scene = place(view, lift, camera, roll_sigma_deg=60.0)
        # The person leans 2.5 deg forward while standing, and that is seen as roll too.
        assert scene.provenance["roll_deg"] == pytest.approx(5.0, abs=4.0)
        assert scene.provenance["roll_deg"] > 3.0

    @pytest.mark.parametrize(("pitch_deg", "height_m"), [(0.0, 1.0), (8.0, 1.6), (-4.0, 0.9)])
    def test_pitched_camera(self, lift, pitch_deg, height_m):
        camera = place_camera(pitch_deg=pitch_deg, height_m=height_m)
        _, scene = place(see(lift.points, camera, lift.time_s), lift, camera)
        assert tilt_error_deg(scene, camera) < 2 * scene.tilt_sigma_deg

    def test_up_direction_of_a_camera_that_looks_down(self):
        assert up_direction(0.0, 0.0) == pytest.approx([0.0, -1.0, 0.0])
        camera = place_camera(pitch_deg=20.0, roll_deg=7.0)
        assert up_direction(20.0, 7.0) == pytest.approx(camera.rotation[:, 1])

    def test_crop_axes_are_undone(self, lift):
        camera = place_camera(azimuth_deg=90.0)
        shifted = lift.points + np.array([1.2, 0.0, 0.0])
        view = see(shifted, camera, lift.time_s)
        rays = compute_rays(np.asarray(view.image.position), camera.matrix)
        body = align_with_line_of_sight(np.asarray(view.body.position), rays, MEDIAPIPE_33)
        local = shifted @ camera.rotation.T
        hips = MEDIAPIPE_33.point(local, "pelvis")[:, None]
        # The line of sight is that to the middle of the hips in the picture.
        assert body == pytest.approx(local - hips, abs=0.01)

    def test_assumed_matrix_shows_the_angle_along_the_longer_side(self):
        for size in ((720, 480), (480, 720)):
            matrix = assumed_camera_matrix(size, horizontal_fov_deg=58.0)
            assert 2 * np.degrees(np.arctan(360.0 / matrix[0, 0])) == pytest.approx(58.0)
            assert tuple(matrix[:2, 2]) == ((size[0] - 1) / 2, (size[1] - 1) / 2)


class TestSymmetry:
    def test_mirror_image_swaps_sides(self, lift, seen, placed):
        order = list(MEDIAPIPE_33.mirror_order)
        image = np.array(seen.image.position)
        image[..., 0] = (seen.info.size_px[0] - 1) - image[..., 0]
        body = np.array(seen.body.position) * [-1, 1, 1]
        view = make_view(image[:, order], body[:, order], lift.time_s, seen.info.size_px)
        found, scene = place(view, lift)
        assert found[:, order] * [1, 1, -1] == pytest.approx(placed[0], abs=1e-9)
        assert scene.view_azimuth_deg == pytest.approx(-placed[1].view_azimuth_deg)

    @pytest.mark.parametrize("factor", [0.5, 2.0])
    def test_a_larger_picture_gives_the_same_metres(self, lift, seen, factor):
        image = factor * (np.array(seen.image.position) + 0.5) - 0.5
        size = tuple(int(factor * n) for n in seen.info.size_px)
        larger = make_view(image, np.asarray(seen.body.position), lift.time_s, size)
        assert place(larger, lift, matrix=None)[0] == pytest.approx(
            place(seen, lift, matrix=None)[0], abs=1e-9
        )

    def test_the_estimators_own_scale_does_not_matter(self, lift, seen, placed):
        body = 1.3 * np.asarray(seen.body.position)
        view = make_view(np.asarray(seen.image.position), body, lift.time_s, seen.info.size_px)
        assert place(view, lift)[0] == pytest.approx(placed[0], abs=1e-6)

    @pytest.mark.parametrize("factor", [1.1, 2.0])
    def test_lengths_scale_with_the_stature(self, lift, seen, placed, factor):
        taller = Measurement(factor * lift.stature_m, 0.01)
        track, _ = reconstruct_single_view(seen, taller, matrix=lift.cameras["cam90"].matrix)
        for a, b in (("ear", "ankle"), ("hip", "knee"), ("shoulder", "hip"), ("shoulder", "elbow")):
            columns = COLUMN[f"right_{a}"], COLUMN[f"right_{b}"]
            long, short = (
                np.linalg.norm(p[:, columns[0]] - p[:, columns[1]], axis=1).mean()
                for p in (np.asarray(track.position), placed[0])
            )
            assert long / short == pytest.approx(factor, rel=0.03)


class TestErrors:
    def test_unknown_stature_is_assumed_with_a_wide_error(self, lift, seen, placed):
        stature = Subject().stature
        track, scene = reconstruct_single_view(seen, stature, matrix=lift.cameras["cam90"].matrix)
        assert stature.value == 1.70
        assert scene.scale_sigma > 0.058
        assert scene.scale_sigma > 2.5 * placed[1].scale_sigma
        ear, ankle = (
            np.asarray(track.position)[:5, COLUMN[f"left_{n}"], 1] for n in ("ear", "ankle")
        )
        assert (ear - ankle).mean() / 0.883 == pytest.approx(1.70, abs=0.05)

    @pytest.mark.parametrize(
        ("option", "small", "large", "field"),
        [
            ("pitch_sigma_deg", 2.0, 12.0, "tilt_sigma_deg"),
            ("roll_sigma_deg", 0.5, 6.0, "tilt_sigma_deg"),
            ("fov_sigma_deg", 0.0, 15.0, "tilt_sigma_deg"),
        ],
    )
    def test_less_certain_assumptions_widen_the_errors(
        self, lift, seen, option, small, large, field
    ):
        narrow, wide = (
            place(seen, lift, matrix=None, **{option: value})[1] for value in (small, large)
        )
        assert getattr(wide, field) > getattr(narrow, field) + 0.5

    def test_a_known_lens_leaves_out_the_error_of_an_assumed_one(self, lift, seen):
        scenes = [place(seen, lift, fov_sigma_deg=value)[1] for value in (0.0, 20.0)]
        assert scenes[0].tilt_sigma_deg == scenes[1].tilt_sigma_deg

    def test_error_of_the_lens_covers_what_the_lens_does(self, lift, seen):
        frame = lift.at(lift.events_s["lift_start"])
        V = [
            place(seen, lift, matrix=None, horizontal_fov_deg=fov)[0][frame, HANDS, 1].mean()
            for fov in (49.0, 67.0)
        ]
        assert abs(V[0] - V[1]) / 2 < 0.02

    def test_no_standing_frame_widens_the_scale(self, lift, seen):
        first = lift.at(lift.events_s["at_box"])
        _, scene = place(cut(seen, slice(first - 5, first + 10)), lift)
        assert scene.provenance["upright_frames"] == 0
        assert scene.scale_sigma > 0.07
        assert "no standing frame" in scene.provenance["scale"]

    def test_doubtful_keypoints_have_wider_errors(self, lift, seen):
        confidence = np.full(seen.image.confidence.shape, 0.99)
        confidence[:, COLUMN["left_wrist"]] = 0.2
        view = make_view(
            np.asarray(seen.image.position),
            np.asarray(seen.body.position),
            lift.time_s,
            seen.info.size_px,
            confidence=confidence,
        )
        track, _ = reconstruct_single_view(view, Measurement(lift.stature_m, 0.01))
        assert (
            track.sigma[:, COLUMN["left_wrist"]] > 2 * track.sigma[:, COLUMN["right_wrist"]]
        ).all()


class TestMissing:
    def test_frames_without_the_person_stay_missing(self, lift, seen, placed):
        lost = slice(60, 90)
        track, _ = reconstruct_single_view(
            hide(seen, ALL, lost),
            Measurement(lift.stature_m, 0.01),
            matrix=lift.cameras["cam90"].matrix,
        )
        found = np.asarray(track.position)
        assert np.isnan(found[lost]).all()
        assert np.isnan(track.sigma[lost]).all()
        rest = np.r_[0:60, 90 : len(found)]
        assert np.isfinite(found[rest]).all()
        assert found[rest] == pytest.approx(placed[0][rest], abs=0.10)

    def test_lost_at_the_start(self, lift, seen, placed):
        found, _ = place(hide(seen, ALL, slice(0, 12)), lift)
        assert np.isnan(found[:12]).all()
        assert found[12:] == pytest.approx(placed[0][12:], abs=0.06)

    @pytest.mark.parametrize("part", ["wrist", "elbow", "index", "eye", "left_heel", "left_pinky"])
    def test_a_part_that_is_never_seen_leaves_the_rest_in_place(self, lift, seen, placed, part):
        found, _ = place(hide(seen, [part]), lift)
        hidden = [i for i, name in enumerate(NAMES) if part in name]
        # Without the elbow (or wrist) nothing but the estimator tells how far away a hand is.
        ends = ("wrist", "index", "pinky", "thumb")
        fingers = [i for i, name in enumerate(NAMES) if name.endswith(ends)]
        assert np.isnan(found[:, hidden]).all()
        others = [i for i in range(len(NAMES)) if i not in hidden and i not in fingers]
        assert found[:, others] == pytest.approx(placed[0][:, others], abs=0.15)
        seen_fingers = [i for i in fingers if np.isfinite(found[:, i]).all()]
        assert found[:, seen_fingers] == pytest.approx(placed[0][:, seen_fingers], abs=0.35)

    def test_an_ankle_that_is_hidden_for_a_while(self, lift, seen, placed):
        found, _ = place(hide(seen, ["left_ankle"], slice(60, 100)), lift)
        shown = [i for i, name in enumerate(NAMES) if name != "left_ankle"]
        assert found[:, shown] == pytest.approx(placed[0][:, shown], abs=0.10)

    @pytest.mark.parametrize(
        ("parts", "words"),
        [
            (["ankle"], "Feet and head must be in the picture"),
            (["ear"], "Feet and head must be in the picture"),
            (ALL, "Feet and head must be in the picture"),
            (["heel"], "heel and toes"),
            (["big_toe"], "heel and toes"),
            (["hip"], "shoulders, hips, knees and ankles"),
            (["knee"], "shoulders, hips, knees and ankles"),
            (["shoulder"], "shoulders, hips, knees and ankles"),
        ],
        ids=lambda value: value[0] if isinstance(value, list) else "",
    )
    def test_never_seen(self, lift, seen, parts, words):
        with pytest.raises(AssessmentError, match=words) as caught:
            place(hide(seen, parts), lift)
        assert "film the whole person" in str(caught.value)

    def test_feet_that_come_into_view_later_are_used(self, lift, seen, placed):
        found, scene = place(hide(seen, ["heel", "big_toe"], slice(0, 35)), lift)
        assert scene.view_azimuth_deg == pytest.approx(placed[1].view_azimuth_deg, abs=3.0)
        assert np.isfinite(found[60:]).all()

    def test_without_body_landmarks(self, lift, seen):
        view = make_view(np.asarray(seen.image.position), None, lift.time_s, seen.info.size_px)
        with pytest.raises(AssessmentError, match="landmarks in metres"):
            place(view, lift)

    @pytest.mark.parametrize("count", [1, 2, 3])
    def test_very_short_clips(self, lift, seen, placed, count):
        found, scene = place(cut(seen, slice(0, count)), lift)
        assert found.shape == (count, len(NAMES), 3)
        assert found == pytest.approx(placed[0][:count], abs=0.08)
        assert scene.provenance["upright_frames"] == count


class TestMovement:
    def test_a_walking_person_moves_as_far_as_in_truth(self, lift):
        # The standing figure glides 1.5 m forward across the picture, seen from the side.
        points = np.repeat(lift.points[:1], 120, axis=0)
        points[:, :, 0] += np.linspace(-0.75, 0.75, 120)[:, None]
        time_s = np.arange(120) / 30
        camera = place_camera(height_m=1.3, pitch_deg=5.0)
        found, _ = place(see(points, camera, time_s), lift, camera)
        travelled = point(found, "mid_ankle")[-1] - point(found, "mid_ankle")[0]
        assert np.linalg.norm(travelled) == pytest.approx(1.5, rel=0.05)
        assert abs(travelled[1]) < 0.03

    def test_a_person_who_walks_towards_the_camera(self, lift):
        points = np.repeat(lift.points[:1], 120, axis=0)
        points[:, :, 2] += np.linspace(-0.6, 0.9, 120)[:, None]
        time_s = np.arange(120) / 30
        camera = place_camera(height_m=1.5, pitch_deg=8.0)
        found, _ = place(see(points, camera, time_s), lift, camera)
        depth = point(found, "pelvis")[-1] - point(found, "pelvis")[0]
        # Told from where the feet meet the floor, so an error of the tilt weighs in.
        assert np.linalg.norm(depth) == pytest.approx(1.5, rel=0.35)
        height = found[:, COLUMN["left_ear"], 1] - found[:, COLUMN["left_ankle"], 1]
        assert height == pytest.approx(height[0], rel=0.12)

    def test_long_clips_solved_in_pieces_agree_with_the_whole(self, lift, seen, monkeypatch):
        from engine.cameras import depth, monocular

        whole = place(seen, lift)[0]
        monkeypatch.setattr(
            monocular, "solve_depths", lambda problem: depth.solve_depths(problem, chunk=80)
        )
        pieces = place(seen, lift)[0]
        assert pieces == pytest.approx(whole, abs=0.03)
        assert np.abs(np.diff(pieces, axis=0)).max() < 0.08


def test_upright_frames_are_those_in_which_the_person_stands(lift, seen):
    rays = compute_rays(np.asarray(seen.image.position), lift.cameras["cam90"].matrix)
    upright = find_upright_frames(np.asarray(seen.body.position), rays, MEDIAPIPE_33)
    assert upright.is_found
    before = lift.time_s < lift.events_s["reach_start"]
    bent = (lift.time_s > lift.events_s["at_box"]) & (lift.time_s < lift.events_s["lift_start"])
    assert upright.frames[before].all()
    assert not upright.frames[bent].any()


def test_track_is_in_world_metres(seen, lift):
    track, _ = reconstruct_single_view(seen, Measurement(lift.stature_m, 0.01))
    assert isinstance(track, PoseTrack)
    assert (track.unit, track.frame_of_reference, track.skeleton) == ("m", "world", "mediapipe_33")
    assert track.time_s == pytest.approx(lift.time_s)
    assert np.isfinite(track.sigma).all()
