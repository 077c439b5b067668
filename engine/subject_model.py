"""The order of the steps where a person's own model tells the joints: from two views to markers.

The model's axes are the laboratory's, Y up with the floor at zero. They are turned about the
vertical and moved along the floor into the trial's world, so that cameras and joints agree.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from engine.config import Config
from engine.datatypes import Array, Frame, PoseTrack, Status, View, ViewInfo
from engine.errors import ConfigError, DataError, PoseError
from engine.kinematics.markers import keypoints_from_markers
from engine.pose.twin_gp import (
    FEATURES,
    TwinGPModel,
    combine_features,
    describe_landmarks,
    describe_video,
    load_model,
)
from engine.skeletons import MARKER_SETS, get_skeleton
from engine.two_view import JoinedViews
from engine.video.reader import probe_video, read_frames
from engine.video.sync import SyncedViews

__all__ = ["BACKEND", "ModelledJoints", "check_model", "estimate_joints"]

BACKEND: Final = "twin-gp"
UNUSUAL_VARIANCE: Final = 3.0
"""Times the typical variance of left-out training frames: such pictures were never trained on."""
UNUSUAL_SHARE: Final = 0.2
FAR_FROM_SEEN_M: Final = 0.08
"""Joints of a fitting model lie 0.02 to 0.04 m from where lines of sight meet: the landmarks of a
pose network are no joint centres."""
REWEIGHTINGS: Final = 5
JOINT_SIGMA_M: Final = {"hip": 0.030, "shoulder": 0.015, "knee": 0.010}
"""How far joint centres worked out from skin markers lie from true ones, per coordinate: the skin
slides, and regressions hold on average; hips are the worst. Other keypoints 5 mm."""
SURFACE_SIGMA_M: Final = 0.005
HELD_KEYPOINTS: Final = tuple(
    f"{side}_{part}"
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    for side in ("left", "right")
)


@dataclass(frozen=True, eq=False)
class ModelledJoints:
    """What a person's model says of a trial.

    Parameters
    ----------
    track
        Joints in the trial's world, m, with standard errors.
    markers
        The model's own markers there, for solvers that fit them; None if they are of no known set.
    warnings
        What makes them doubtful, in words.
    """

    track: PoseTrack
    markers: PoseTrack | None
    warnings: tuple[str, ...]


def check_model(views: Sequence[View], config: Config) -> TwinGPModel:
    """Read the model and find out before the long work whether it belongs to the videos.

    Raises
    ------
    ConfigError
        If no model is named or there are not two views.
    DataError
        If the file is no model, or its pictures have another size or other views.
    """
    if not config.pose.model:
        raise ConfigError(
            "The estimator 'twin-gp' needs the model of the person filmed: name its file with "
            "--model, or train one with `python -m engine.training.twin_gp`."
        )
    if len(views) != 2:
        raise ConfigError(
            "The estimator 'twin-gp' looks at two videos, as its model was trained; got "
            f"{len(views)}. Give both, first the model's first view, or use another estimator."
        )
    model = load_model(Path(config.pose.model))
    _check_views([probe_video(view.path) for view in views], model)
    return model


def _check_views(infos: Sequence[ViewInfo], model: TwinGPModel) -> None:
    names, sizes = model.source.views, model.source.picture_px
    if len(sizes) != 2:
        raise DataError(
            f"The model was trained on {len(sizes)} view, so it can't be used on two videos; train "
            "it on both."
        )
    for number, (info, size) in enumerate(zip(infos, sizes, strict=True)):
        if info.size_px != size:
            raise DataError(
                f"{info.file_name} has pictures of {info.size_px[0]} x {info.size_px[1]} px, the "
                f"model's view {names[number]} was trained on {size[0]} x {size[1]} px; film and "
                "export at the same size, or train the model on such pictures."
            )
    stems = [Path(info.file_name).stem for info in infos]
    if names[0] in stems[1] and names[1] in stems[0] and names[0] not in stems[0]:
        raise DataError(
            f"The model's first view is {names[0]} and its second {names[1]}, but the videos come "
            "the other way round; exchange them."
        )


def estimate_joints(
    model: TwinGPModel, files: Sequence[View], joined: JoinedViews
) -> ModelledJoints:
    """Estimate the joints of two joined views by a person's model.

    Parameters
    ----------
    model
        Of this person in front of these cameras.
    files
        The videos; looked at again only if the model describes pictures.
    joined
        Both views in one time and one world. Keypoints that markers do not give (nose, eyes,
        thumbs) stay as they were triangulated there.

    Raises
    ------
    PoseError
        If the model describes pictures and a video is gone.
    """
    _check_views([view.info for view in joined.views], model)
    features = _describe(model, files, joined.synced)
    prediction = model.predict(features)
    time_s = joined.track.time_s
    own = _add_knuckles(keypoints_from_markers(time_s, prediction.markers_m, model.marker_names))
    rotation, shift = _find_place(own.position, joined.track)
    placed = replace(own, position=_move(own.position, rotation, shift))
    distance_m = _median_distance(placed.position, joined.track)
    marker_sigma = np.sqrt((prediction.sigma_m**2).mean(axis=1))
    return ModelledJoints(
        _merge(placed, joined.track, marker_sigma, model),
        _as_markers(time_s, _move(prediction.markers_m, rotation, shift), model.marker_names),
        _warn(model, features, prediction.sigma_m, distance_m),
    )


def _as_markers(time_s: Array, position: Array, names: Sequence[str]) -> PoseTrack | None:
    """Return markers as a track of the set that has them all."""
    for name, known in MARKER_SETS.items():
        if set(names) == set(known.keypoints):
            order = [list(names).index(marker) for marker in known.keypoints]
            return PoseTrack(time_s, position[:, order], "m", "world", name)
    return None


def _add_knuckles(track: PoseTrack) -> PoseTrack:
    """Put index and little finger at the marker of the third knuckle, which is their middle.

    Later steps take the third knuckle from the middle of both; fingers seen by one camera only
    would pull it away.
    """
    skeleton = get_skeleton(track.skeleton)
    position = np.array(track.position)
    for side in ("left", "right"):
        position[:, skeleton.index(f"{side}_pinky")] = position[:, skeleton.index(f"{side}_index")]
    there = np.isfinite(position).all(axis=2)
    status = np.where(there, Status.MEASURED, Status.MISSING)
    return replace(track, position=position, status=status)


def _describe(
    model: TwinGPModel, files: Sequence[View], synced: SyncedViews
) -> NDArray[np.float32]:
    """Describe both views at their common times, as in training."""
    chosen = FEATURES[model.source.features]
    hog: list[NDArray[np.float32]] = []
    landmarks: list[NDArray[np.float32]] = []
    for number, view in enumerate(synced.views):
        if chosen.hog is not None:
            hog.append(_describe_pictures(model, files[number], synced, number))
        if chosen.uses_landmarks:
            size = model.source.picture_px[number]
            landmarks.append(describe_landmarks(view.image.position, size, window=chosen.window))
    return combine_features(hog=hog, landmarks=landmarks)[0]


def _describe_pictures(
    model: TwinGPModel, file: View, synced: SyncedViews, number: int
) -> NDArray[np.float32]:
    """Describe one video's pictures at the common times, in a straight line between two."""
    chosen = FEATURES[model.source.features]
    assert chosen.hog is not None
    if not file.path.is_file():
        raise PoseError(
            f"The model looks at the pictures of {file.path.name}, but the video is not there any "
            "more; put it back, or use a model of landmarks."
        )
    crop = model.source.crops[number] if model.source.crops else None
    times: list[float] = []

    def note(frames: Iterator[Frame]) -> Iterator[Frame]:
        for frame in frames:
            times.append(frame.time_s)
            yield frame

    rows = describe_video(note(read_frames(file.path)), crop, chosen.hog)
    common = synced.views[number].image.time_s
    rate = synced.rate_in_second if number else 1.0
    start = synced.start_in_second_s if number else synced.start_in_first_s
    own = np.array(times)
    wanted = np.clip(common * rate + start, own[0], own[-1])
    high = np.clip(np.searchsorted(own, wanted), 1, len(own) - 1)
    share = ((wanted - own[high - 1]) / (own[high] - own[high - 1])).astype(np.float32)[:, None]
    return np.asarray((1 - share) * rows[high - 1] + share * rows[high])


def _held(position: Array, seen: PoseTrack) -> tuple[Array, Array]:
    """Return the joints of the model and those that were seen, at the keypoints both have."""
    skeleton = get_skeleton(seen.skeleton)
    columns = [skeleton.index(name) for name in HELD_KEYPOINTS]
    return position[:, columns], seen.position[:, columns]


def _find_place(position: Array, seen: PoseTrack) -> tuple[Array, Array]:
    """Find the turn about the vertical and the shift along the floor onto the joints seen.

    Returns
    -------
    tuple
        Rotation (2, 2) and shift (2,) of x and z.
    """
    own, other = _held(position, seen)
    known = np.isfinite(own).all(axis=2) & np.isfinite(other).all(axis=2)
    a, b = own[known][:, [0, 2]], other[known][:, [0, 2]]
    if len(a) < len(HELD_KEYPOINTS):
        raise PoseError(
            "Too few joints were seen in both views to place the model's markers; check that the "
            "whole person is visible in both videos."
        )
    return _fit_plane_motion(a, b)


def _move(position: Array, rotation: Array, shift: Array) -> Array:
    """Turn points (T, K, 3) about the vertical and move them along the floor."""
    placed = np.array(position)
    placed[..., [0, 2]] = position[..., [0, 2]] @ rotation.T + shift
    return placed


def _median_distance(position: Array, seen: PoseTrack) -> float:
    """Return how far the model's joints lie from those that were seen, m."""
    own, other = _held(position, seen)
    return float(np.nanmedian(np.linalg.norm(own - other, axis=2)))


def _fit_plane_motion(first: Array, second: Array) -> tuple[Array, Array]:
    """Return the rotation (2, 2) and shift (2,) that bring points (N, 2) onto others.

    Far-off pairs count less (weights of Cauchy), so that joints seen wrongly do not turn the body.
    """
    rotation, shift = np.eye(2), np.zeros(2)
    weight = np.ones(len(first))
    for _ in range(REWEIGHTINGS):
        middle, other = (np.average(p, axis=0, weights=weight) for p in (first, second))
        product = ((first - middle) * weight[:, None]).T @ (second - other)
        angle = np.arctan2(product[0, 1] - product[1, 0], product[0, 0] + product[1, 1])
        cosine, sine = np.cos(angle), np.sin(angle)
        rotation = np.array([[cosine, -sine], [sine, cosine]])
        shift = other - rotation @ middle
        miss = np.linalg.norm(first @ rotation.T + shift - second, axis=1)
        weight = 1.0 / (1.0 + (miss / max(float(np.median(miss)), 1e-6)) ** 2)
    return rotation, shift


def _merge(own: PoseTrack, seen: PoseTrack, sigma_m: Array, model: TwinGPModel) -> PoseTrack:
    """Put the model's joints where it has them, and keep the others as they were seen."""
    has = own.is_present
    modelled = np.asarray(has.any(axis=0))
    position = np.where(modelled[:, None], own.position, seen.position)
    names = get_skeleton(seen.skeleton).keypoints
    definition = [JOINT_SIGMA_M.get(n.partition("_")[2], SURFACE_SIGMA_M) for n in names]
    sigma = np.where(modelled, np.hypot(sigma_m[:, None], definition), seen.sigma)
    # The model sees whole pictures: it is as sure of a hidden joint as its standard error says.
    confidence = np.where(modelled, np.where(has, 1.0, 0.0), seen.confidence)
    provenance = {
        **own.provenance,
        "estimator": BACKEND,
        "subject": model.source.subject,
        "regressor": model.regressor.name,
        "features": model.source.features,
        "inner_error_mm": round(1000 * model.inner_error_m, 1),
        "as_triangulated": [
            name for name, is_own in zip(names, modelled, strict=True) if not is_own
        ],
    }
    return replace(
        seen,
        position=position,
        sigma=sigma,
        confidence=confidence,
        status=np.where(np.isfinite(position).all(axis=2), Status.MEASURED, Status.MISSING),
        provenance={**seen.provenance, **provenance},
    )


def _warn(
    model: TwinGPModel, features: NDArray[np.float32], sigma_m: Array, distance_m: float
) -> tuple[str, ...]:
    """Say where the model may not hold."""
    who = model.source.subject or "the person it was trained on"
    caution = (
        f"Joints come from a model of {who} in front of two cameras that stood still: on anybody "
        "else, or after a camera was moved, they are wrong without notice."
    )
    said = [caution]
    ratio = (sigma_m / model.sigma_at) ** 2
    unusual = float((ratio.mean(axis=1) > UNUSUAL_VARIANCE).mean())
    if unusual > UNUSUAL_SHARE:
        said.append(
            f"{unusual:.0%} of the pictures look unlike those the model was trained on, so its "
            "joints are uncertain there; check the person, the clothes and the cameras, or train "
            "it on this task too."
        )
    lost = float((~np.isfinite(features).all(axis=1)).mean())
    if lost:
        said.append(f"In {lost:.0%} of the pictures the person was not seen by both cameras.")
    if distance_m > FAR_FROM_SEEN_M:
        said.append(
            f"The model's joints lie {100 * distance_m:.0f} cm from where both cameras see them, "
            "more than another definition of joints explains; check that the model belongs to this "
            "person and these cameras."
        )
    return tuple(said)
