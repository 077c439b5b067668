"""Several estimators on one clip: what each makes of the same keypoints in the picture.

All see the same person and the same points of the picture; they differ in how they find the depth.
Each then goes through the same placing in the world, correction and fit of the body, so that the
differences are the estimators' own.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from engine.config import Config, KinematicsConfig, PoseConfig
from engine.correction.links import measure_links
from engine.correction.paper import correct_as_published
from engine.datatypes import (
    PoseTrack,
    ProgressCallback,
    Trial,
    TrialResult,
    View,
    ViewPose,
    ignore_progress,
)
from engine.errors import ConfigError, DataError, EngineError
from engine.pipeline import assess_pose
from engine.pose.base import BackendInfo, LiftingBackend, create_backend, list_backends
from engine.storage.results import StoredResult
from engine.validation.curves import angle_difference

__all__ = [
    "EstimatorRun",
    "compare_estimators",
    "compare_on_stored",
    "lift_keypoints",
    "list_lifters",
    "mean_differences",
    "outlier_ratio",
]

LANDMARKS = "mediapipe"
"""The estimator whose keypoints in the picture all others start from."""


@dataclass(frozen=True, eq=False)
class EstimatorRun:
    """One estimator on one clip.

    Parameters
    ----------
    info
        Which estimator.
    result
        What became of it; None if it could not be used, and `refusal` says why.
    outlier_ratio
        Share of frames in which the published test of link lengths finds a wrong joint.
    fit_residual_m
        Mean distance of the fitted body's joints from the corrected keypoints.
    lifting_s_per_frame
        Time to lift the keypoints, without finding them in the picture; 0 for `mediapipe`, whose
        network gives both at once.
    """

    info: BackendInfo
    result: TrialResult | None
    outlier_ratio: float = math.nan
    fit_residual_m: float = math.nan
    lifting_s_per_frame: float = math.nan
    refusal: str = ""


def list_lifters() -> tuple[BackendInfo, ...]:
    """Describe the estimators that can be compared on stored keypoints, `mediapipe` first."""
    usable = (i for i in list_backends() if i.name == LANDMARKS or i.lifts)
    return tuple(sorted(usable, key=lambda info: info.name != LANDMARKS))


def lift_keypoints(pose: ViewPose, settings: PoseConfig) -> ViewPose:
    """Let another estimator find the depth of stored keypoints.

    Raises
    ------
    ConfigError
        If the estimator needs the pictures.
    BackendUnavailable
        If something it needs is not installed.
    DataError
        If the keypoints are not those it starts from.
    """
    if settings.backend == LANDMARKS:
        return pose
    backend = create_backend(settings)
    if not isinstance(backend, LiftingBackend):
        names = ", ".join(info.name for info in list_lifters())
        raise ConfigError(
            f"The estimator {settings.backend!r} needs the video again; estimators that start from "
            f"stored keypoints are {names}."
        )
    return backend.lift(pose)


def compare_estimators(
    trial: Trial,
    pose: ViewPose,
    names: Sequence[str],
    config: Config | None = None,
    progress: ProgressCallback = ignore_progress,
) -> tuple[EstimatorRun, ...]:
    """Run several estimators on one view.

    Parameters
    ----------
    trial
        The person and the task, with one view.
    pose
        What `mediapipe` saw in it.
    names
        Estimators, in the order wanted; see `list_lifters`.
    config
        Settings of everything else; if None the defaults, with the fit of the body.
    progress
        Called as ``progress("estimators", done, total)``; may raise `Cancelled`.

    Returns
    -------
    tuple of EstimatorRun
        An estimator that can't be used is there too, with the reason.

    Raises
    ------
    ConfigError
        If there is no estimator of a name.
    """
    # Only a fitted body has a distance from the keypoints.
    config = config or Config(kinematics=KinematicsConfig(solver="least-squares"))
    known = {info.name: info for info in list_backends()}
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(
            f"Unknown estimator {', '.join(map(repr, unknown))}; known: {', '.join(known)}."
        )
    runs = []
    for done, name in enumerate(names):
        progress("estimators", done, len(names))
        runs.append(_run(known[name], trial, pose, config))
    progress("estimators", len(names), len(names))
    return tuple(runs)


def _run(info: BackendInfo, trial: Trial, pose: ViewPose, config: Config) -> EstimatorRun:
    settings = dataclasses.replace(config.pose, backend=info.name, model="")
    config = dataclasses.replace(config, pose=settings)
    start = time.perf_counter()
    try:
        lifted = lift_keypoints(pose, settings)
        spent = time.perf_counter() - start
        result = assess_pose(trial, lifted, config)
    except EngineError as error:
        return EstimatorRun(info, None, refusal=str(error))
    n_frames = max(1, pose.image.n_frames)
    return EstimatorRun(
        info,
        result,
        outlier_ratio=outlier_ratio(result.raw, stature_m=trial.subject.stature.value),
        fit_residual_m=_mean_residual(result),
        lifting_s_per_frame=0.0 if lifted is pose else spent / n_frames,
    )


def mean_differences(run: EstimatorRun, against: EstimatorRun) -> dict[str, float]:
    """Return the mean absolute difference of every angle that both give, degrees.

    Frames in which either is missing are left out; NaN where no frame is left.
    """
    if run.result is None or against.result is None:
        return {}
    ours, theirs = run.result.angles, against.result.angles
    differences = {}
    for name in ours.names:
        if name in theirs.names:
            off = np.abs(angle_difference(ours[name], theirs[name]))
            known = np.isfinite(off)
            differences[name] = float(off[known].mean()) if known.any() else math.nan
    return differences


def _mean_residual(result: TrialResult) -> float:
    if result.body is None or not np.isfinite(result.body.residual_m).any():
        return math.nan
    return float(np.nanmean(result.body.residual_m))


def outlier_ratio(track: PoseTrack, *, stature_m: float | None = None) -> float:
    """Return the share of frames with a joint that the published test of link lengths removes.

    Frames in which nothing was seen don't count.

    Parameters
    ----------
    track
        Uncorrected, px or m.
    stature_m
        Sets the scale of the thresholds.

    References
    ----------
    .. [1] Choi et al. (2024), Table 2.
    """
    links = measure_links(track, stature_m=stature_m)
    removed = correct_as_published(track.time_s, track.position, links).is_removed
    seen = track.is_present.any(axis=1)
    return float(np.mean(removed[seen].any(axis=1))) if seen.any() else math.nan


def compare_on_stored(
    stored: StoredResult,
    names: Sequence[str],
    *,
    view: int = 0,
    progress: ProgressCallback = ignore_progress,
) -> tuple[EstimatorRun, ...]:
    """Run several estimators on one view of a stored result; the video is not needed.

    Raises
    ------
    DataError
        If the result's keypoints are not MediaPipe's, which the others start from.
    ConfigError
        If there is no estimator of a name.
    """
    pose = stored.views[view]
    backend = stored.document.get("backend", "")
    if pose.image.skeleton != "mediapipe_33":
        raise DataError(
            "Estimators are compared on MediaPipe's landmarks, but this trial was assessed with "
            f"{backend!r}. Assess the video with the estimator 'mediapipe' first."
        )
    trial = Trial(
        views=(View(stored.folder / pose.info.file_name),),
        subject=stored.subject,
        task=stored.task,
    )
    return compare_estimators(trial, pose, names, progress=progress)
