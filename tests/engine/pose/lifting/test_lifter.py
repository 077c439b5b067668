"""Whole clips: what goes into a network and what comes out around it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from engine.config import PoseConfig
from engine.datatypes import PoseTrack
from engine.errors import DataError
from engine.pose.backends import d3dp, mhformer
from engine.pose.base import LiftingBackend
from engine.pose.lifting.joints import LIFTED_KEYPOINTS, to_h36m
from engine.pose.lifting.lifter import DiffusionLifter, DirectLifter
from engine.pose.lifting.normalise import sight_axes, stature_of
from engine.skeletons import MEDIAPIPE_33
from tests.engine.pose.lifting.networks import fake_network, flat, random_answer
from tests.engine.pose.lifting.people import SIZE_PX, film

DATA = Path(__file__).with_name("data")
LIFTED = [MEDIAPIPE_33.index(name) for name in LIFTED_KEYPOINTS]


def lift(pose, network=None, **options):
    return DirectLifter(network or fake_network(flat), **options).lift(pose, {"weights": "test"})


@pytest.mark.parametrize("fps", [15.0, 24.0, 30.0, 60.0])
def test_a_flat_person_comes_back_in_metres(fps):
    """A person in a plane across the line of sight is what the flat network is right for."""
    pose, truth = film(fps)
    body = lift(pose).body
    assert np.abs(body.position[:, LIFTED] - truth[:, LIFTED]).max() < 0.02
    assert np.isnan(body.position).sum() == 0
    assert body.time_s.shape == pose.image.time_s.shape


@pytest.mark.parametrize("centre", [(1.2, 0.3, 4.0), (-1.5, -0.4, 5.0)])
def test_beside_the_middle_of_the_picture_the_body_is_in_the_axes_of_its_line_of_sight(centre):
    pose, _ = film(30.0, place=centre, axes=sight_axes(np.array(centre)))
    body = lift(pose).body
    assert np.abs(body.position[:, LIFTED] - pose.body.position[:, LIFTED]).max() < 0.02


def test_face_hands_and_feet_go_along_without_an_error_of_their_own():
    pose, truth = film(30.0)
    body = lift(pose).body
    others = [i for i in range(33) if i not in LIFTED]
    assert np.abs(body.position[:, others] - truth[:, others]).max() < 0.03
    assert np.isfinite(body.sigma[:, LIFTED]).all()
    assert np.isnan(body.sigma[:, others]).all()


def test_what_was_seen_stays_as_it_is():
    pose, _ = film(30.0)
    found = lift(pose)
    assert np.array_equal(found.image.position, pose.image.position)
    assert found.image.provenance["weights"] == "test"
    assert found.body.provenance["weights"] == "test"
    assert found.info == pose.info


@pytest.mark.parametrize("n_frames", [1, 2, 5, 9, 10, 40])
def test_any_length(n_frames):
    pose, truth = film(30.0)
    cut = _cut(pose, slice(0, n_frames))
    body = lift(cut).body
    assert body.position.shape == (n_frames, 33, 3)
    assert np.abs(body.position[:, LIFTED] - truth[:n_frames, LIFTED]).max() < 0.02


def _cut(pose, rows):
    def part(track):
        return PoseTrack(
            track.time_s[rows], track.position[rows], track.unit, track.frame_of_reference,
            track.skeleton, track.confidence[rows],
        )  # fmt: skip

    return dataclasses.replace(
        pose, image=part(pose.image), body=part(pose.body), box=pose.box[rows],
        state=pose.state[rows],
    )  # fmt: skip


def _lose(pose, rows):
    image, body = np.array(pose.image.position), np.array(pose.body.position)
    image[rows] = body[rows] = np.nan
    return dataclasses.replace(
        pose,
        image=dataclasses.replace(pose.image, position=image, status=None),
        body=dataclasses.replace(pose.body, position=body, status=None),
    )


def test_long_gaps_stay_empty_and_short_ones_don_t_harm():
    pose, truth = film(30.0, seconds=4.0)
    gappy = _lose(pose, np.r_[20:24, 60:90])
    body = lift(gappy).body.position
    assert np.isnan(body[65:85]).all()
    seen = np.r_[0:20, 24:55, 95:120]
    assert np.abs(body[seen][:, LIFTED] - truth[seen][:, LIFTED]).max() < 0.03


def test_nobody_in_the_whole_clip():
    pose, _ = film(30.0)
    with pytest.raises(DataError, match="none in the clip; film the whole body"):
        lift(_lose(pose, slice(None)))


def test_without_landmarks_in_metres_legs_and_trunk_give_the_size():
    pose, truth = film(30.0, with_body=False)
    body = lift(pose).body.position[:, LIFTED]
    scale = np.linalg.norm(truth[:, LIFTED]) / np.linalg.norm(body)
    assert np.abs(scale * body - truth[:, LIFTED]).max() < 0.03


def test_mirrored_person_is_lifted_to_the_mirrored_body():
    """Flip averaging makes any network treat both sides alike."""
    pose, _ = film(30.0, place=(0.4, 0.0, 4.0))
    order = list(MEDIAPIPE_33.mirror_order)
    image = np.array(pose.image.position)[:, order]
    image[..., 0] = SIZE_PX[0] - 1 - image[..., 0]
    flipped = dataclasses.replace(
        pose,
        image=dataclasses.replace(pose.image, position=image),
        body=dataclasses.replace(
            pose.body, position=np.array(pose.body.position)[:, order] * [-1, 1, 1]
        ),
    )
    network = fake_network(random_answer(3))
    straight, mirrored = lift(pose, network).body.position, lift(flipped, network).body.position
    assert np.abs(straight[:, LIFTED, 2]).max() > 1e-3
    assert np.allclose(mirrored[:, order] * [-1, 1, 1], straight, atol=1e-6)


def test_published_networks_get_the_picture_and_give_metres():
    seen = []

    def answer(points, **_):
        seen.append(points)
        return flat(points)[:, 4:5]

    pose, _ = film(30.0)
    network = fake_network(answer, n_out=1, n_numbers=2)
    body = lift(pose, network).body
    width, height = SIZE_PX
    nose = np.array(pose.image.position)[4, MEDIAPIPE_33.index("nose")]
    assert np.allclose(
        seen[0][0, 4, 9], [2 * nose[0] / width - 1, 2 * nose[1] / width - height / width], atol=1e-4
    )
    # Every frame but the ends is the middle of a window of its own.
    left = np.array(pose.image.position)[:, MEDIAPIPE_33.index("left_wrist")]
    hips = MEDIAPIPE_33.point(np.array(pose.image.position), "pelvis")
    wanted = 2 * (left - hips) / width
    found = body.position[:, MEDIAPIPE_33.index("left_wrist"), :2]
    assert np.allclose(found[4:-4], wanted[4:-4], atol=2e-3)


def test_hypotheses_are_the_same_for_the_same_seed():
    def answer(points, noisy, step):
        return 0.9 * flat(points) + 0.1 * np.tanh(noisy) * (step[0] > 0)

    pose, _ = film(30.0)
    network = fake_network(answer, kind="denoiser")
    runs = [
        DiffusionLifter(network, hypotheses=3, steps=2, seed=seed).lift(pose, {}).body
        for seed in (1, 1, 2)
    ]
    assert np.array_equal(runs[0].position, runs[1].position)
    assert np.array_equal(runs[0].sigma, runs[1].sigma, equal_nan=True)
    assert not np.array_equal(runs[0].position, runs[2].position)


def test_more_spread_is_more_error():
    """The file says what spread is usual, and what error goes with it."""

    def answer(points, noisy, step):
        joints = flat(points)
        joints[:, :, [13, 16]] += 0.1 * noisy[:, :, [13, 16]]
        joints[:, :, [3, 6]] += 0.001 * noisy[:, :, [3, 6]]
        return joints

    facts = {"sigma": [0.02] * 17, "spread": [0.02] * 17}
    pose, _ = film(30.0)
    lifter = DiffusionLifter(fake_network(answer, kind="denoiser", facts=facts), hypotheses=6)
    sigma = lifter.lift(pose, {}).body.sigma
    wrist, ankle = (
        np.median(sigma[:, MEDIAPIPE_33.index(f"left_{n}")]) for n in ("wrist", "ankle")
    )
    stature = float(stature_of(to_h36m(np.asarray(pose.body.position))))
    assert ankle == pytest.approx(0.5 * 0.02 * stature)  # never below half of the usual
    assert wrist > 2 * ankle


def test_other_keypoints_are_refused():
    pose, _ = film(30.0)
    other = dataclasses.replace(
        pose,
        image=PoseTrack(pose.image.time_s, np.zeros((61, 17, 2)), "px", "image", "h36m_17"),
    )
    with pytest.raises(DataError, match=r"33 landmarks, got h36m_17 keypoints"):
        lift(other)


@pytest.mark.parametrize(("module", "file"), [(mhformer, "lifter.onnx"), (d3dp, "denoiser.onnx")])
def test_estimators_take_a_network_of_the_user(module, file):
    backend = module.Backend(PoseConfig(backend=module.BACKEND_INFO.name, model=str(DATA / file)))
    assert isinstance(backend, LiftingBackend)
    pose, truth = film(30.0)
    found = backend.lift(pose)
    assert found.body.provenance["weights"] == f"{module.BACKEND_INFO.name}-custom"
    assert len(found.body.provenance["sha256"]) == 64
    assert np.abs(found.body.position[:, LIFTED] - truth[:, LIFTED]).max() < 0.02


def test_long_clips_in_parts_give_the_same():
    pose, truth = film(30.0, seconds=24.0)
    network = fake_network(flat)
    body = lift(pose, network, hop_share=0.25).body.position
    assert network.session.calls > 2 * 5  # 360 windows in parts of 64, each seen twice
    assert np.abs(body[:, LIFTED] - truth[:, LIFTED]).max() < 0.02
