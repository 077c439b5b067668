"""A skeleton with constant bones behind the landmarks, by swing-twist inverse kinematics."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from engine.config import PoseConfig
from engine.datatypes import Array, PoseTrack, ProgressCallback, TrackedStream, ViewInfo, ViewPose
from engine.errors import ConfigError, NoPersonFound
from engine.pose.backends import mediapipe
from engine.pose.base import BackendInfo
from engine.pose.swing_twist.landmarks import landmarks_from_joints, picture_scale
from engine.pose.swing_twist.official import CROP_MARGIN, OfficialNetwork, crop_person
from engine.pose.swing_twist.posture import pose_landmarks
from engine.pose.swing_twist.skeleton29 import N_JOINTS
from engine.skeletons import MEDIAPIPE_33

BACKEND_INFO = BackendInfo(
    name="hybrik",
    title="HybrIK-style (swing-twist)",
    skeleton=MEDIAPIPE_33.name,
    licence="Apache-2.0; with pose.model that of your network",
    description=(
        "BlazePose's landmarks carried by a skeleton whose bones keep their lengths, posed by "
        "analytic inverse kinematics in the manner of HybrIK; it is not HybrIK, and the published "
        "accuracy is not its own. pose.model names your own copy of the published network as ONNX."
    ),
    requires=mediapipe.BACKEND_INFO.requires,
    takes_model=True,
    lifts=True,
)


class Backend:
    """Landmarks of BlazePose on a skeleton of constant bones.

    Parameters
    ----------
    config
        `ik` and `model` are used here, the rest by BlazePose.

    Raises
    ------
    ConfigError
        If `model` names a file that is no such network.
    """

    info = BACKEND_INFO

    def __init__(self, config: PoseConfig) -> None:
        self._ik = config.ik
        self._network = (
            OfficialNetwork(Path(config.model), threads=config.threads) if config.model else None
        )
        self._landmarks = mediapipe.Backend(dataclasses.replace(config, model=""))

    def estimate(
        self, frames: TrackedStream, view: ViewInfo, progress: ProgressCallback
    ) -> ViewPose:
        """Estimate the landmarks of the followed person.

        The track in the picture is BlazePose's. In the body track every bone has one length all
        along, the median of the clip; with a network of the user's own its joints come from there.

        Parameters, returns and errors are those of the estimator `mediapipe`.
        """
        if self._network is None:
            pose = self._landmarks.estimate(frames, view, progress)
            return self.lift(pose)
        watched = _Watched(self._network)
        pose = self._landmarks.estimate(watched.watch(frames), view, progress)
        return watched.replace_body(pose)

    def lift(self, pose: ViewPose) -> ViewPose:
        """Return what BlazePose saw with its body track on a skeleton of constant bones.

        Raises
        ------
        ConfigError
            If a network of the user's own was named: it needs the pictures.
        NoPersonFound
            If legs and trunk are never seen together.
        """
        if self._network is not None:
            raise ConfigError(
                "The network named by pose.model looks at the pictures, but only keypoints are "
                "there; assess the video itself, or leave the model out."
            )
        body = _body_of(pose)
        posed, _ = pose_landmarks(np.array(body.position), ik=self._ik)
        return _with_body(pose, posed, {"estimator": "hybrik-open", "ik": self._ik})


class _Watched:
    """Runs the user's network on every frame that passes by."""

    def __init__(self, network: OfficialNetwork) -> None:
        self._network = network
        self._joints: list[Array] = []
        self._side_px: list[float] = []

    def watch(self, frames: TrackedStream) -> TrackedStream:
        for tracked in frames:
            joints, side_px = np.full((N_JOINTS, 3), np.nan), np.nan
            if tracked.box is not None:
                joints, _ = self._network.estimate(crop_person(tracked.frame.image, tracked.box))
                side_px = max(tracked.box.size_px) * CROP_MARGIN
            self._joints.append(joints)
            self._side_px.append(side_px)
            yield tracked

    def replace_body(self, pose: ViewPose) -> ViewPose:
        """Put the network's joints where BlazePose's were; both must have seen the person."""
        body = np.array(_body_of(pose).position)
        joints = np.array(self._joints)
        if not self._network.gives_metres:
            metres = picture_scale(body, np.array(pose.image.position)) * np.array(self._side_px)
            joints[..., :2] *= metres[:, None, None]
        placed = landmarks_from_joints(joints - joints[:, :1], body)
        provenance = {"estimator": "hybrik-official", "model_sha256": self._network.sha256}
        return _with_body(pose, placed, provenance)


def _body_of(pose: ViewPose) -> PoseTrack:
    if pose.body is None:
        raise NoPersonFound(
            "Expected landmarks in metres from BlazePose, but this view came without; estimate it "
            "with mediapipe first."
        )
    return pose.body


def _with_body(pose: ViewPose, position: Array, provenance: dict[str, str]) -> ViewPose:
    """Return the view with another body track; who saw what goes into the provenance."""
    body = _body_of(pose)
    told = {**body.provenance, "landmarks": "mediapipe", **provenance}
    return dataclasses.replace(
        pose,
        image=dataclasses.replace(pose.image, provenance=told),
        body=PoseTrack(
            time_s=body.time_s,
            position=position,
            unit=body.unit,
            frame_of_reference=body.frame_of_reference,
            skeleton=body.skeleton,
            confidence=body.confidence,
            provenance=told,
        ),
    )
