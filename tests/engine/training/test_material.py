"""What networks learn from: movements, cameras, and the errors of the keypoint network."""

from __future__ import annotations

import numpy as np
import pytest

from engine.errors import DataError
from engine.optics import place_on_rays
from engine.training.corpus import BONES, MIRRORED, Clip, read_lifts, read_mocap, vary_windows
from engine.training.detected import Detected, mirror_detected
from engine.training.keypoint_noise import KeypointNoise, landmark_axes, measure_noise
from engine.training.measure_blazepose import NOISE_FILE
from engine.training.simulated import simulate_clips
from engine.training.views import HEAD, NOSE, project_windows, sample_batches


@pytest.fixture(scope="module")
def clips():
    return simulate_clips(6, seed=3)


@pytest.fixture
def windows(clips):
    return np.stack([clip.position[:27] for clip in clips]).astype(float)


def lengths_of(position):
    bones = position[..., BONES[:, 1], :] - position[..., BONES[:, 0], :]
    return np.linalg.norm(bones, axis=-1)


class TestSimulated:
    def test_bones_keep_their_length(self, clips):
        rigid = [i for i, (_, child) in enumerate(BONES) if child not in (7, 8)]
        for clip in clips:
            lengths = lengths_of(clip.position)[:, rigid]
            assert np.ptp(lengths, axis=0).max() < 2e-3

    def test_the_lower_foot_is_on_the_ground(self, clips):
        for clip in clips:
            assert np.allclose(clip.position[:, [3, 6], 2].min(axis=1), 0.08, atol=1e-5)

    def test_lifts_bend_deep_and_both_ways(self):
        steepest, knees = [], []
        for clip in simulate_clips(40, seed=1):
            trunk = clip.position[:, 8] - clip.position[:, 0]
            steepest.append(
                np.degrees(np.arccos(trunk[:, 2] / np.linalg.norm(trunk, axis=1))).max()
            )
            thigh = clip.position[:, 1] - clip.position[:, 2]
            knees.append(np.degrees(np.arccos(thigh[:, 2] / np.linalg.norm(thigh, axis=1))).max())
        assert np.quantile(steepest, 0.75) > 60
        assert np.quantile(knees, 0.75) > 40

    def test_same_seed_same_movements(self):
        first, second = simulate_clips(2, 5), simulate_clips(2, 5)
        assert np.array_equal(first[1].position, second[1].position)


class TestVariation:
    def test_sides_belong_together(self):
        assert np.array_equal(MIRRORED[MIRRORED], np.arange(17))
        assert MIRRORED[[1, 11]].tolist() == [4, 14]

    def test_feet_stay_and_sides_stay_alike(self, windows):
        varied = vary_windows(windows, np.ones(6, dtype=bool), np.random.default_rng(0))
        assert varied.shape == windows.shape
        thighs = lengths_of(varied)[..., [1, 4]]
        assert np.allclose(thighs[..., 0], thighs[..., 1], atol=1e-3)
        assert np.allclose(varied[:, :, 7], 0.5 * (varied[:, :, 0] + varied[:, :, 8]), atol=0.02)

    def test_people_differ_by_some_per_cent(self, windows):
        varied = vary_windows(windows, np.zeros(6, dtype=bool), np.random.default_rng(0))
        share = lengths_of(varied)[:, 0, 1] / lengths_of(windows)[:, 0, 1]
        assert 0.01 < np.abs(share - 1).max() < 0.2


class TestCameras:
    def test_everybody_stands_upright_before_the_camera(self, windows):
        seen = project_windows(windows, np.random.default_rng(0))
        assert seen[..., 2].min() > 0.5
        # Head above feet: y points down.
        assert (seen[:, 0, 10, 1] < seen[:, 0, 3, 1]).all()
        assert np.allclose(lengths_of(seen), lengths_of(windows))

    def test_points_are_where_the_joints_are_seen(self, clips):
        batch = next(sample_batches(clips, n_frames=27, batch_size=8, noise=None, seed=0))
        points, joints = batch.points.astype(float), batch.joints.astype(float)
        assert np.allclose(points[:, :, HEAD], points[:, :, NOSE])
        assert np.allclose(points[..., 2], 1.0)
        assert np.allclose(joints[:, :, 0], 0.0)
        flat = joints[..., :2] - joints[:, :, :1, :2]
        seen = points[..., :2] - points[:, :, :1, :2]
        others = [i for i in range(17) if i != HEAD]
        # At some distance a picture is nearly a scaled shadow.
        error = np.linalg.norm(flat - seen, axis=-1)[:, :, others]
        assert np.median(error) < 0.03

    def test_batches_follow_the_seed(self, clips):
        noise = KeypointNoise.read(NOISE_FILE)
        first, second, other = (
            next(sample_batches(clips, n_frames=9, batch_size=4, noise=noise, seed=seed))
            for seed in (1, 1, 2)
        )
        assert np.array_equal(first.points, second.points)
        assert not np.array_equal(first.points, other.points)


def detected_from(clip, noise, rng, *, size=1.75):
    """Return what a network with the given errors would see of a movement."""
    joints = project_windows(clip.position[None].astype(float), rng)
    moved = noise.displace(joints, np.array([size]), _Usual())[0]
    rays = moved / moved[..., 2:]
    return Detected("P01", rays, np.ones(rays.shape[:2]), joints[0], size)


class _Usual:
    """Draws the usual strength and no deviation from it."""

    def uniform(self, _low, _high, shape):
        return np.ones(shape)

    def normal(self, _mean, _sd, shape):
        return np.zeros(shape)


class TestKeypointErrors:
    def test_axes_are_rotations_and_mirror_each_other(self, windows):
        for joint in (1, 5, 12, 16):
            for axes in landmark_axes(windows, joint):
                unit = np.einsum("...ij,...ik->...jk", axes, axes)
                assert np.allclose(unit, np.eye(3), atol=1e-6)
        left, right = landmark_axes(windows, 4)[0], landmark_axes(windows, 1)[0]
        assert np.allclose(left[..., 1], -right[..., 1])

    def test_planted_offsets_are_measured(self):
        offset = np.zeros((17, 2, 3))
        for joint in (1, 4):
            offset[joint] = [[0.0, 0.0, 0.01], [0.02, -0.01, -0.02]]
        for joint in (3, 6):
            offset[joint] = 2 * [[0.005, 0.0, 0.004]]
        planted = KeypointNoise(offset.tolist(), (0.0,) * 17, (0.0,) * 17, (0.0,) * 17)
        rng = np.random.default_rng(0)
        videos = [detected_from(clip, planted, rng) for clip in simulate_clips(12, seed=2)]
        found = np.array(measure_noise(videos, ridge=1e-6).offset)
        assert np.abs(found[1] - offset[1]).max() < 2e-3
        assert np.abs(found[3].sum(axis=0) - offset[3].sum(axis=0)).max() < 2e-3
        assert np.abs(found[[2, 12, 13, 15, 16]]).max() < 2e-3

    def test_noise_is_measured_in_statures(self, clips):
        quiet = KeypointNoise(np.zeros((17, 2, 3)).tolist(), (0.0,) * 17, (0.0,) * 17, (0.01,) * 17)
        rng = np.random.default_rng(1)
        videos = []
        for clip in clips:
            video = detected_from(clip, quiet, rng)
            size = video.stature_m / video.joints[:, 0, 2].mean()
            rays = video.rays.copy()
            rays[..., :2] += size * rng.normal(0, 0.01, rays[..., :2].shape)
            videos.append(Detected("P01", rays, video.confidence, video.joints, video.stature_m))
        found = measure_noise(videos)
        assert np.allclose(found.fast, 0.01, rtol=0.15)
        assert np.max(found.bias) < 0.005

    def test_kept_values_come_back(self, tmp_path):
        noise = KeypointNoise.read(NOISE_FILE)
        noise.write(tmp_path / "noise.json")
        assert KeypointNoise.read(tmp_path / "noise.json") == noise

    def test_measured_hips_lie_before_and_below_the_joint_along_the_thigh(self):
        """What is known of BlazePose: both sides alike, a few per cent of the stature at most."""
        offset = np.array(KeypointNoise.read(NOISE_FILE).offset)
        assert np.allclose(offset, offset[MIRRORED])
        assert np.abs(offset).max() < 0.05

    def test_imitated_noise_has_its_size_and_marks_what_is_lost(self):
        noise = KeypointNoise.read(NOISE_FILE)
        points, size = np.zeros((200, 27, 17, 2)), np.full(200, 0.3)
        noisy, confidence = noise.blur(points, size, np.random.default_rng(0))
        lost = confidence < 0.05
        assert 0.0 < lost.mean() < 0.01
        assert np.median(np.abs(noisy[:, :, 16])) < 0.3 * 0.02
        assert np.median(np.abs(noisy[:, :, 16])) > 0.3 * 0.002

    def test_a_mirror_shows_the_other_side(self, clips):
        noise = KeypointNoise.read(NOISE_FILE)
        video = detected_from(clips[0], noise, np.random.default_rng(0))
        twice = mirror_detected(mirror_detected(video))
        assert np.array_equal(twice.rays, video.rays)
        once = mirror_detected(video)
        assert np.allclose(once.joints[:, 1, 0], -video.joints[:, 4, 0])


class TestReading:
    def test_other_files_are_refused(self, tmp_path):
        np.savez(tmp_path / "other.npz", pose=np.zeros((1, 17, 3)))
        with pytest.raises(DataError, match="no motion-capture corpus: it lacks"):
            read_mocap(tmp_path / "other.npz", "train")
        with pytest.raises(DataError, match="holds no lifting trials of P01"):
            read_lifts(tmp_path, ("P01",))

    def test_splits_are_by_person(self, tmp_path):
        np.savez(
            tmp_path / "corpus.npz",
            pose=np.zeros((5, 17, 3), dtype=np.float16), root=np.arange(15.0).reshape(5, 3),
            start=[0, 3], length=[3, 2], name=["01_01", "02_01"], subject=["01", "02"],
            split=["train", "test"], bending=[True, False],
        )  # fmt: skip
        (clip,) = read_mocap(tmp_path / "corpus.npz", "train")
        assert (clip.subject, clip.weight, len(clip.position)) == ("01", 4.0, 3)
        assert np.allclose(clip.position[1, 4], [3.0, 4.0, 5.0])
        with pytest.raises(DataError, match="no clips in the split 'val'"):
            read_mocap(tmp_path / "corpus.npz", "val")


def test_detected_windows_keep_points_and_joints_together(clips):
    noise = KeypointNoise(np.zeros((17, 2, 3)).tolist(), (0.0,) * 17, (0.0,) * 17, (0.0,) * 17)
    videos = [detected_from(c, noise, np.random.default_rng(i)) for i, c in enumerate(clips)]
    batch = next(
        sample_batches(
            clips, n_frames=9, batch_size=6, noise=None, seed=0, detected=videos, detected_share=1.0
        )
    )
    points, joints = batch.points.astype(float), batch.joints.astype(float)
    rays = np.concatenate([points[..., :2] * 0.4, np.ones((*points.shape[:3], 1))], axis=-1)
    others = [i for i in range(17) if i != HEAD]
    place = place_on_rays(joints[:, :, others], rays[:, :, others], np.ones((6, 9, 16)))
    again = joints[:, :, others] + place[:, :, None]
    off = again[..., :2] / again[..., 2:] - rays[:, :, others, :2]
    assert np.abs(off).max() < 0.03


def test_a_clip_has_a_place_in_its_corpus():
    assert Clip("a", "b", "mocap", np.zeros((2, 17, 3), dtype=np.float32)).split == "train"
