from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.cameras.triangulation import Triangulation, triangulate, triangulate_points
from engine.datatypes import Array, Camera, Status, ViewPose
from engine.errors import CalibrationError, DataError
from engine.optics import camera_centre, project
from engine.skeletons import H36M_17, MEDIAPIPE_33
from tests.engine.cameras.truth import NAMES, Truth, make_view, place_camera, read_truth, see

COLUMN = {name: i for i, name in enumerate(NAMES)}
JOINTS = [
    COLUMN[f"{side}_{part}"]
    for side in ("left", "right")
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
]
ORDER = list(MEDIAPIPE_33.mirror_order)


@pytest.fixture(scope="module")
def lift() -> Truth:
    return read_truth("floor_to_knuckle")


@pytest.fixture(scope="module")
def cameras(lift: Truth) -> tuple[Camera, Camera]:
    return lift.cameras["cam90"], lift.cameras["cam135"]


@pytest.fixture(scope="module")
def views(lift: Truth, cameras: tuple[Camera, Camera]) -> tuple[ViewPose, ViewPose]:
    return tuple(see(lift.points, camera, lift.time_s) for camera in cameras)


def with_image(
    view: ViewPose, image: Array, confidence: Array | float = 0.99, body: Array | None = None
) -> ViewPose:
    body = np.asarray(view.body.position) if body is None else body
    time_s = np.asarray(view.image.time_s)
    return make_view(image, body, time_s, view.info.size_px, confidence=confidence)


def errors_of(found: Triangulation, points: Array) -> Array:
    return np.linalg.norm(np.asarray(found.track.position) - points, axis=2)


def errors(found: Triangulation, lift: Truth) -> Array:
    """Return the distances from the truth, shape (T, K), m."""
    return errors_of(found, lift.points)


def distort(camera: Camera) -> Camera:
    return replace(camera, distortion=np.array([-0.20, 0.05, 0.002, -0.001, 0.0]))


class TestExactViews:
    @pytest.mark.parametrize("use_body", [False, True])
    def test_joints_come_back(self, lift, cameras, views, use_body):
        found = triangulate(views, cameras, stature_m=lift.stature_m, use_body=use_body)
        # Bones of the figure keep their length, so the body has nothing to add but rounding.
        assert errors(found, lift)[:, JOINTS].max() < (0.03 if use_body else 1e-6)
        assert np.median(errors(found, lift)[:, JOINTS]) < (0.006 if use_body else 1e-6)
        assert (found.n_views == 2).all()
        assert (np.asarray(found.track.status) == Status.MEASURED).all()

    def test_a_lens_with_distortion(self, lift, cameras):
        bent = tuple(distort(camera) for camera in cameras)
        views = []
        for camera in bent:
            image = project(camera, lift.points)
            views.append(make_view(image, None, lift.time_s, camera.size_px))
        found = triangulate(views, bent, use_body=False)
        seen = found.n_views == 2  # the bent lens moves some feet out of the picture
        assert seen.mean() > 0.9
        assert errors(found, lift)[seen].max() < 1e-5
        ignored = triangulate(views, cameras, use_body=False)
        assert np.nanmax(errors(ignored, lift)) > 0.005

    def test_three_views(self, lift, cameras, views):
        third = place_camera(azimuth_deg=30.0)
        seen = (*views, see(lift.points, third, lift.time_s))
        found = triangulate(seen, (*cameras, third), stature_m=lift.stature_m)
        assert found.reprojection_px.shape == (3, *lift.points.shape[:2])
        assert found.n_views.max() == 3
        assert np.median(errors(found, lift)[:, JOINTS]) < 0.006

    def test_reprojection_is_the_distance_in_the_picture(self, lift, cameras, views):
        image = np.array(views[0].image.position)
        image[:, COLUMN["nose"], 1] += 8.0
        found = triangulate((with_image(views[0], image), views[1]), cameras, use_body=False)
        shown = np.asarray(found.track.position)
        for v, (camera, pixels) in enumerate(
            zip(cameras, (image, np.asarray(views[1].image.position)), strict=True)
        ):
            expected = np.linalg.norm(pixels - project(camera, shown), axis=2)
            assert found.reprojection_px[v] == pytest.approx(expected)
        assert 2.0 < np.median(found.reprojection_px[:, :, COLUMN["nose"]]) < 8.0


class TestStandardErrors:
    def test_covariance_is_that_of_repeated_measurements(self, cameras):
        rng = np.random.default_rng(1)
        point = np.array([0.2, 1.1, 0.1])
        sigma = np.array([2.0, 5.0])
        pixels = np.stack([np.tile(project(c, point), (4000, 1)) for c in cameras])
        pixels = pixels + sigma[:, None, None] * rng.standard_normal(pixels.shape)
        wide = np.broadcast_to(sigma[:, None], pixels.shape[:2])
        points, covariance, miss = triangulate_points(cameras, pixels, wide)
        measured = np.cov(points.T)
        stated = np.median(covariance, axis=0)
        assert np.abs(measured - stated).max() < 0.1 * np.abs(stated).max()
        # One of the four coordinates is left over to disagree.
        assert miss.mean() == pytest.approx(1.0, rel=0.1)
        assert points.mean(axis=0) == pytest.approx(point, abs=1e-3)

    def test_the_better_view_counts_more(self, cameras):
        point = np.array([0.2, 1.1, 0.1])
        pixels = np.stack([project(c, point) for c in cameras])
        pixels[1, 1] += 10.0  # they now miss each other by some centimetres in height
        trusting = [
            triangulate_points(cameras, pixels, np.array(sigma))[0]
            for sigma in ([1.0, 10.0], [10.0, 1.0])
        ]
        misses = [
            [np.linalg.norm(project(c, p) - pixels[v]) for v, c in enumerate(cameras)]
            for p in trusting
        ]
        assert misses[0][0] < 0.2 < 5.0 < misses[0][1]
        assert misses[1][1] < 0.2 < 5.0 < misses[1][0]

    def test_most_joints_lie_within_their_stated_errors(self, lift, cameras):
        noisy = [
            see(lift.points, c, lift.time_s, noise_px=2.5, seed=i) for i, c in enumerate(cameras)
        ]
        found = triangulate(noisy, cameras, stature_m=lift.stature_m)
        spread = np.sqrt(np.diagonal(np.asarray(found.covariance), axis1=2, axis2=3))
        z = (np.asarray(found.track.position) - lift.points)[:, JOINTS] / spread[:, JOINTS]
        assert (np.abs(z) < 1.96).mean() > 0.95
        sigma = np.asarray(found.track.sigma)
        assert sigma == pytest.approx(np.sqrt((spread**2).mean(axis=2)))

    def test_doubtful_cameras_widen_the_errors(self, lift, cameras, views):
        sure = triangulate(views, cameras, stature_m=lift.stature_m)
        shaky = triangulate(
            views,
            cameras,
            stature_m=lift.stature_m,
            rotation_sigma_deg=1.0,
            translation_sigma_m=0.05,
        )
        assert (shaky.track.sigma[:, JOINTS] > sure.track.sigma[:, JOINTS]).all()
        unknown = triangulate(views, cameras, stature_m=lift.stature_m, rotation_sigma_deg=np.nan)
        assert unknown.track.sigma == pytest.approx(sure.track.sigma)

    def test_narrow_angles_leave_the_distance_open(self, lift):
        pair = [place_camera(azimuth_deg=a) for a in (90.0, 95.0)]
        views = [see(lift.points, c, lift.time_s) for c in pair]
        found = triangulate(views, pair, stature_m=lift.stature_m, use_body=False)
        covariance = np.asarray(found.covariance)[0, COLUMN["right_wrist"]]
        look = lift.points[0, COLUMN["right_wrist"]] - camera_centre(pair[0])
        look /= np.linalg.norm(look)
        along = look @ covariance @ look
        across = (np.trace(covariance) - along) / 2
        assert np.sqrt(along) > 5 * np.sqrt(across)


class TestOneView:
    @pytest.mark.parametrize("name", ["right_wrist", "left_knee", "right_elbow"])
    def test_a_joint_that_one_view_shows_is_placed_by_the_body(self, lift, cameras, views, name):
        column = COLUMN[name]
        image = np.array(views[1].image.position)
        image[60:90, column] = np.nan
        found = triangulate(
            (views[0], with_image(views[1], image)), cameras, stature_m=lift.stature_m
        )
        part = (slice(60, 90), column)
        assert (found.n_views[part] == 1).all()
        assert (np.asarray(found.track.status)[part] == Status.FILLED).all()
        # On its line of sight, and about where a body can have it.
        assert np.nanmax(found.reprojection_px[(0, *part)]) < 3.0
        distance = errors(found, lift)[part]
        assert distance.max() < 0.12
        assert (distance < 3.0 * np.sqrt(3.0) * found.track.sigma[part]).all()
        assert np.median(found.track.sigma[part]) > 1.3 * np.median(found.track.sigma[:50, column])
        assert np.isnan(found.reprojection_px[(1, *part)]).all()

    def test_its_error_lies_along_the_line_of_sight(self, lift, cameras, views):
        column = COLUMN["right_wrist"]
        image = np.array(views[1].image.position)
        image[:, column] = np.nan
        found = triangulate(
            (views[0], with_image(views[1], image)), cameras, stature_m=lift.stature_m
        )
        look = lift.points[:, column] - camera_centre(cameras[0])
        look /= np.linalg.norm(look, axis=1, keepdims=True)
        covariance = np.asarray(found.covariance)[:, column]
        along = np.einsum("ti,tij,tj->t", look, covariance, look)
        across = (np.trace(covariance, axis1=1, axis2=2) - along) / 2
        assert np.median(along / across) > 2.0

    def test_without_the_body_it_is_missing(self, lift, cameras, views):
        column = COLUMN["right_wrist"]
        image = np.array(views[1].image.position)
        image[60:90, column] = np.nan
        found = triangulate((views[0], with_image(views[1], image)), cameras, use_body=False)
        assert np.isnan(found.track.position[60:90, column]).all()
        assert (np.asarray(found.track.status)[60:90, column] == Status.MISSING).all()

    def test_a_whole_view_lost_for_a_while(self, lift, cameras, views):
        image = np.array(views[0].image.position)
        image[60:90] = np.nan
        body = np.array(views[0].body.position)
        body[60:90] = np.nan
        found = triangulate(
            (with_image(views[0], image, body=body), views[1]), cameras, stature_m=lift.stature_m
        )
        assert np.isfinite(found.track.position[:, JOINTS]).mean() > 0.95
        gone = found.track.sigma[60:90][:, JOINTS]
        assert np.nanmedian(gone) > 1.5 * np.median(found.track.sigma[:60][:, JOINTS])
        assert np.median(errors(found, lift)[:60][:, JOINTS]) < 0.006

    def test_seen_by_nobody(self, cameras, views):
        lost = []
        for view in views:
            image, body = np.array(view.image.position), np.array(view.body.position)
            image[60:90], body[60:90] = np.nan, np.nan
            lost.append(with_image(view, image, body=body))
        found = triangulate(lost, cameras)
        assert np.isnan(found.track.position[60:90]).all()
        assert np.isnan(found.covariance[60:90]).all()
        assert (found.n_views[60:90] == 0).all()
        assert (np.asarray(found.track.status)[60:90] == Status.MISSING).all()

    def test_outside_the_picture_nothing_was_seen(self, cameras, views):
        image = np.array(views[1].image.position)
        image[:, COLUMN["left_wrist"], 0] = -40.0
        found = triangulate((views[0], with_image(views[1], image)), cameras)
        assert (found.n_views[:, COLUMN["left_wrist"]] == 1).all()


class TestWrongViews:
    @pytest.mark.parametrize("wrong", [0, 1])
    @pytest.mark.parametrize("name", ["right_wrist", "left_ankle"])
    def test_a_view_that_shows_a_joint_elsewhere_is_left_out(
        self, lift, cameras, views, wrong, name
    ):
        column, part = COLUMN[name], slice(70, 80)
        image = np.array(views[wrong].image.position)
        image[part, column] += [40.0, -90.0]
        seen = [with_image(v, image) if i == wrong else v for i, v in enumerate(views)]
        found = triangulate(seen, cameras, stature_m=lift.stature_m)
        plain = triangulate(seen, cameras, use_body=False, repair_labels=False)
        assert np.median(errors(plain, lift)[part, column]) > 0.15
        assert errors(found, lift)[part, column].max() < 0.10
        assert (np.asarray(found.track.status)[part, column] == Status.REPAIRED).all()
        assert (found.n_views[part, column] == 1).all()
        assert (found.reprojection_px[wrong, part, column] > 50.0).all()
        others = [k for k in JOINTS if k != column]
        assert errors(found, lift)[part][:, others].max() < 0.06

    @pytest.mark.parametrize("wrong", [0, 1])
    @pytest.mark.parametrize(
        "parts",
        [
            ("",),
            ("elbow", "wrist", "pinky", "index", "thumb"),
            ("hip", "knee", "ankle", "heel", "toe"),
        ],
        ids=["whole body", "arms", "legs"],
    )
    @pytest.mark.parametrize("part", [slice(0, 8), slice(75, 85)], ids=["start", "middle"])
    def test_exchanged_sides_are_put_right(self, lift, cameras, views, wrong, parts, part):
        columns = [k for k, n in enumerate(NAMES) if any(n.endswith(p) for p in parts)]
        order = np.arange(len(NAMES))
        order[columns] = np.array(ORDER)[columns]
        image = np.array(views[wrong].image.position)
        body = np.array(views[wrong].body.position)
        image[part], body[part] = image[part][:, order], body[part][:, order]
        seen = [with_image(v, image, body=body) if i == wrong else v for i, v in enumerate(views)]
        found = triangulate(seen, cameras, stature_m=lift.stature_m)
        assert np.median(errors(found, lift)[:, JOINTS]) < 0.006
        assert errors(found, lift)[part][:, JOINTS].max() < 0.05
        sides = [k for k in JOINTS if k in columns]
        assert (np.asarray(found.track.status)[part][:, sides] == Status.REPAIRED).all()
        assert found.track.provenance["triangulation"]["exchanged"] > 0
        wrongly = triangulate(seen, cameras, repair_labels=False, use_body=False)
        assert np.median(errors(wrongly, lift)[part][:, sides]) > 0.03

    def test_right_labels_stay(self, lift, cameras):
        noisy = [
            see(lift.points, c, lift.time_s, noise_px=4.0, seed=9 + i)
            for i, c in enumerate(cameras)
        ]
        found = triangulate(noisy, cameras, stature_m=lift.stature_m)
        assert found.track.provenance["triangulation"]["exchanged"] == 0


@settings(max_examples=15, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    shift=st.tuples(*[st.floats(-10.0, 10.0)] * 3),
)
def test_the_choice_of_world_does_not_matter(turn, shift):
    import cv2

    rotation = cv2.Rodrigues(np.array(turn))[0]
    pair = (place_camera(azimuth_deg=60.0), place_camera(azimuth_deg=140.0, pitch_deg=10.0))
    moved = tuple(
        replace(
            c,
            rotation=c.rotation @ rotation.T,
            translation=c.translation - c.rotation @ rotation.T @ np.array(shift),
        )
        for c in pair
    )
    points = np.random.default_rng(3).uniform([-0.5, 0.0, -0.5], [0.5, 1.8, 0.5], (20, 3))
    pixels = np.stack([project(c, points) for c in pair]) + 1.5
    sigma = np.ones(pixels.shape[:2])
    here, covariance, miss = triangulate_points(pair, pixels, sigma)
    there, turned, again = triangulate_points(moved, pixels, sigma)
    assert there == pytest.approx(here @ rotation.T + np.array(shift), abs=1e-5)
    assert turned == pytest.approx(rotation @ covariance @ rotation.T, rel=1e-3, abs=1e-8)
    assert again == pytest.approx(miss, rel=1e-3, abs=1e-6)


class TestOtherInput:
    def test_an_estimator_without_landmarks_in_metres(self, lift, cameras, views):
        bare = [
            make_view(np.asarray(v.image.position), None, lift.time_s, v.info.size_px)
            for v in views
        ]
        image = np.array(bare[0].image.position)
        image[60:90, COLUMN["right_wrist"]] = np.nan
        bare[0] = make_view(image, None, lift.time_s, bare[0].info.size_px)
        found = triangulate(bare, cameras, stature_m=lift.stature_m)
        assert np.median(errors(found, lift)[:, JOINTS]) < 0.006
        # The forearm's length alone still tells where along the line the wrist can be.
        part = (slice(60, 90), COLUMN["right_wrist"])
        assert np.isfinite(found.track.position[part]).all()
        assert np.median(errors(found, lift)[part]) < 0.15

    def test_another_skeleton(self, lift, cameras):
        names = H36M_17.keypoints
        kept = {n: COLUMN[n] for n in names if n in COLUMN}
        middle = {
            "pelvis": ("left_hip", "right_hip"),
            "spine": ("left_hip", "right_shoulder"),
            "thorax": ("left_shoulder", "right_shoulder"),
            "head": ("left_ear", "right_ear"),
        }
        points = np.stack(
            [
                lift.points[:, kept[n]]
                if n in kept
                else lift.points[:, [COLUMN[m] for m in middle[n]]].mean(axis=1)
                for n in names
            ],
            axis=1,
        )
        views = []
        for camera in cameras:
            view = make_view(project(camera, points), None, lift.time_s, camera.size_px)
            views.append(replace(view, image=replace(view.image, skeleton="h36m_17")))
        found = triangulate(views, cameras, stature_m=lift.stature_m)
        distance = np.linalg.norm(np.asarray(found.track.position) - points, axis=2)
        assert np.median(distance) < 0.006
        assert np.isfinite(distance).all()

    @pytest.mark.parametrize("count", [1, 2, 3])
    def test_very_short_clips(self, lift, cameras, count):
        views = [see(lift.points[:count], c, lift.time_s[:count]) for c in cameras]
        found = triangulate(views, cameras, stature_m=lift.stature_m)
        assert np.nanmax(errors_of(found, lift.points[:count])[:, JOINTS]) < 0.06

    def test_long_clips_solved_in_pieces_agree_with_the_whole(
        self, lift, cameras, views, monkeypatch
    ):
        from engine.cameras import _body

        whole = triangulate(views, cameras, stature_m=lift.stature_m)
        monkeypatch.setattr(_body, "FRAMES_AT_ONCE", 50)
        pieces = triangulate(views, cameras, stature_m=lift.stature_m)
        assert pieces.track.position == pytest.approx(np.asarray(whole.track.position), abs=2e-3)


class TestPoints:
    def test_one_line_of_sight_is_no_point(self, cameras):
        pixels = np.stack([project(c, np.array([0.0, 1.0, 0.0])) for c in cameras])
        pixels[1] = np.nan
        points, covariance, miss = triangulate_points(cameras, pixels, np.ones(2))
        assert np.isnan(points).all()
        assert np.isnan(covariance).all()
        assert np.isnan(miss)

    def test_behind_a_camera_is_no_point(self):
        # Lines of sight that open away from each other meet behind the cameras.
        pair = (place_camera(azimuth_deg=90.0), place_camera(azimuth_deg=100.0))
        pixels = np.array([[700.0, 240.0], [20.0, 240.0]])
        order = pixels if project_meets_behind(pair, pixels) else pixels[::-1]
        assert np.isnan(triangulate_points(pair, order, np.ones(2))[0]).all()

    def test_parallel_lines_are_far_and_unsure(self):
        pair = (place_camera(), place_camera())
        pixels = np.array([[300.0, 200.0], [300.0, 200.0]])
        _, covariance, _ = triangulate_points(pair, pixels, np.ones(2))
        assert not np.sqrt(np.trace(covariance)) < 10.0


def project_meets_behind(pair: tuple[Camera, Camera], pixels: Array) -> bool:
    return bool(np.isnan(triangulate_points(pair, pixels, np.ones(2))[0]).any())


class TestWrongCalls:
    def test_one_view(self, cameras, views):
        with pytest.raises(DataError, match="two views or more, got 1"):
            triangulate(views[:1], cameras[:1])

    def test_too_few_cameras(self, cameras, views):
        with pytest.raises(CalibrationError, match="2 views and 1 cameras"):
            triangulate(views, cameras[:1])

    def test_other_times(self, lift, cameras, views):
        late = make_view(
            np.asarray(views[1].image.position),
            np.asarray(views[1].body.position),
            lift.time_s + 0.02,
            views[1].info.size_px,
        )
        with pytest.raises(DataError, match="synchronise and resample"):
            triangulate((views[0], late), cameras)

    def test_other_picture_size(self, cameras, views):
        larger = replace(cameras[1], size_px=(1440, 960))
        with pytest.raises(CalibrationError, match=r"1440 x 960 px, but exact\.mp4 has 720 x 480"):
            triangulate(views, (cameras[0], larger))
