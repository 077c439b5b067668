"""The order of the steps; the only module that knows it."""

from __future__ import annotations

import dataclasses
import math
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from engine.cameras.monocular import reconstruct_single_view
from engine.config import Config
from engine.correction.chain import correct_track, summarise_status
from engine.datatypes import (
    JointAngles,
    PoseTrack,
    ProgressCallback,
    RiskResult,
    Trial,
    TrialResult,
    View,
    ViewPose,
    WorldScene,
    ignore_progress,
)
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.base import Exposure, select_methods
from engine.ergonomics.flags import raise_flags
from engine.errors import ConfigError, VideoError
from engine.kinematics.events import LiftFindings, detect_lifts
from engine.kinematics.fitting.base import add_scene_errors, select_solver
from engine.pose.base import create_backend
from engine.storage.atomic import scratch_folder
from engine.storage.results import check_target, write_result
from engine.subject.detector import PersonDetector
from engine.subject.tracker import follow_person
from engine.timing import NETWORK_CLOCK
from engine.version import __version__, list_versions
from engine.video.overlay import write_overlay
from engine.video.reader import probe_video, read_frames
from engine.video.steadiness import CameraWatch
from engine.video.thumbnail import write_thumbnail

__all__ = ["assess", "assess_pose", "assess_to_folder"]


def assess(
    trial: Trial, config: Config | None = None, progress: ProgressCallback = ignore_progress
) -> TrialResult:
    """Assess one trial: from video to lifts, risk and flags.

    Parameters
    ----------
    trial
        The video, the person and the task.
    config
        Settings; the defaults if None.
    progress
        Called as ``progress(stage, done, total)``; may raise `Cancelled`.

    Returns
    -------
    TrialResult
        Nothing is written.

    Raises
    ------
    ConfigError
        If a setting can't be followed.
    VideoError
        If the video can't be used.
    NoPersonFound
        If there is nobody to measure.
    BackendUnavailable
        If the estimator or a part of it is missing.
    AssessmentError
        If the video doesn't show enough of the person to find scale and direction.
    """
    config = config or Config()
    if len(trial.views) != 1:
        raise ConfigError("Assessing two views together is not available yet; give one video.")
    # Wrong names fail before the long work, not after it.
    select_solver(config.kinematics.solver)
    select_methods(config.risk.methods, experimental=config.risk.experimental)
    start = time.perf_counter()
    pose = estimate_view(trial.views[0], config, progress)
    spent = time.perf_counter() - start
    progress("scene", 0, 0)
    result = assess_pose(trial, pose, config)
    timings = {"pose": spent, "networks": pose.model_time_s, **result.timings_s}
    return dataclasses.replace(result, timings_s=timings)


def assess_pose(trial: Trial, pose: ViewPose, config: Config | None = None) -> TrialResult:
    """Assess a trial from keypoints that were already estimated.

    Parameters
    ----------
    trial
        The person and the task; its video is not opened.
    pose
        What an estimator saw in the video.
    config
        Settings; the defaults if None.

    Returns
    -------
    TrialResult
        Nothing is written.

    Raises
    ------
    AssessmentError
        If the keypoints don't show enough of the person to find scale and direction.
    ConfigError
        If a setting can't be followed.
    """
    # Thousands of tiny matrices: handing each to several threads costs a hundred times the work.
    with threadpool_limits(limits=1, user_api="blas"):
        return _assess_pose(trial, pose, config or Config())


def _assess_pose(trial: Trial, pose: ViewPose, config: Config) -> TrialResult:
    camera = trial.views[0].camera
    timings: dict[str, float] = {}
    with _timed(timings, "reconstruction"):
        raw, scene = reconstruct_single_view(
            pose,
            trial.subject.stature,
            matrix=camera.matrix if camera else None,
            **dataclasses.asdict(config.camera),
        )
    with _timed(timings, "correction"):
        corrected = correct_track(
            raw, stature_m=trial.subject.stature.value, **dataclasses.asdict(config.correction)
        )
    with _timed(timings, "kinematics"):
        solver = select_solver(config.kinematics.solver)
        fit = solver.fit(corrected, trial.subject)
        angles = add_scene_errors(fit.angles, scene)
        findings = _find_lifts(trial, raw, angles, scene, config)
    coverage = summarise_status(corrected, keypoints=MEASURED_KEYPOINTS)
    with _timed(timings, "risk"):
        risk = _assess_risk(trial, scene, corrected, angles, findings, config)
        flags = raise_flags(risk, findings.lifts, coverage)
    return TrialResult(
        trial=trial,
        views=(pose,),
        raw=raw,
        corrected=corrected,
        scene=scene,
        angles=angles,
        lifts=findings.lifts,
        risk=risk,
        flags=flags,
        warnings=(
            *_warn(trial, pose, scene),
            *_warnings_of_correction(corrected),
            *fit.warnings,
            *findings.warnings,
        ),
        config=config.as_dict(),
        backend=config.pose.backend,
        solver=config.kinematics.solver,
        versions={"liftlens": __version__, "python": platform.python_version(), **list_versions()},
        timings_s=timings,
        coverage=coverage,
        body=fit.body,
    )


CAMERA_TRAVEL = "camera_travel"
"""Key of the camera's travel, a share of the picture, in the provenance of the image track."""
STEADY_TRAVEL = 0.005
"""Up to this travel a camera counts as fixed; one on a tripod stays below a tenth of it."""
SHORT_CLIP_S = 1.0

MEASURED_KEYPOINTS = tuple(
    f"{side}_{part}"
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "heel", "big_toe")
    for side in ("left", "right")
)
"""The joints that coverage is counted over; fingers and face hardly enter the assessment."""


def estimate_view(view: View, config: Config, progress: ProgressCallback) -> ViewPose:
    """Read one video, follow the person and estimate the pose, in one pass over the pictures."""
    # Networks take a second to load: between them is a chance to cancel.
    progress("probe", 0, 0)
    info = probe_video(view.path)
    progress("subject", 0, 0)
    backend = create_backend(config.pose)
    progress("subject", 0, 0)
    detector = PersonDetector(threads=config.pose.threads)
    progress("subject", 0, 0)
    frames = read_frames(view.path, start_s=config.video.start_s, stop_s=config.video.stop_s)
    tracked = follow_person(frames, detector, **dataclasses.asdict(config.subject))
    camera = CameraWatch()
    networks_s = NETWORK_CLOCK.total_s
    pose = backend.estimate(camera.watch(tracked), info, progress)
    if pose.image.n_frames < 2:
        raise VideoError(
            f"Expected a video of a movement, but {info.file_name} holds a single picture in the "
            "part to assess; film the whole lift, with a second of standing before and after."
        )
    provenance = dict(pose.image.provenance)
    if not math.isnan(camera.travel):
        provenance[CAMERA_TRAVEL] = camera.travel
    return dataclasses.replace(
        pose,
        image=dataclasses.replace(pose.image, provenance=provenance),
        model_time_s=NETWORK_CLOCK.total_s - networks_s,
    )


def _doubtful_view(track: PoseTrack, scene: WorldScene) -> Iterator[str]:
    """Name what makes lengths less certain than their stated errors, so that it is reviewed."""
    if track.provenance.get(CAMERA_TRAVEL, 0.0) > STEADY_TRAVEL:
        yield "camera_moved"
    if not scene.provenance.get("upright_frames"):
        yield "never_upright"


def _assess_risk(
    trial: Trial,
    scene: WorldScene,
    corrected: PoseTrack,
    angles: JointAngles,
    findings: LiftFindings,
    config: Config,
) -> dict[str, RiskResult]:
    exposure = Exposure(
        track=corrected,
        angles=angles,
        lifts=findings.lifts,
        subject=trial.subject,
        task=trial.task,
        observed_s=float(corrected.time_s[-1] - corrected.time_s[0]),
        conditions=(*findings.conditions, *_doubtful_view(corrected, scene)),
    )
    return assess_risk(exposure, methods=config.risk.methods, experimental=config.risk.experimental)


def _find_lifts(
    trial: Trial, raw: PoseTrack, angles: JointAngles, scene: WorldScene, config: Config
) -> LiftFindings:
    # A hand hidden behind the body or the load still has to be somewhere: the estimator's guess
    # is used here, with a wide error, while joint angles leave it out.
    settings = dataclasses.asdict(config.correction) | {"min_confidence": 0.0}
    if settings["preset"] == "none":
        settings["preset"] = "default"
    return detect_lifts(
        correct_track(raw, stature_m=trial.subject.stature.value, **settings),
        angles,
        scene,
        stature_m=trial.subject.stature.value,
        sex=trial.subject.sex,
        **dataclasses.asdict(config.events),
    )


def _warn(trial: Trial, pose: ViewPose, scene: WorldScene) -> Iterator[str]:
    """Say in plain words what makes this assessment less certain."""
    yield from _warn_of_video(pose)
    if trial.subject.stature_m is None:
        yield (
            f"Stature not given: {trial.subject.stature.value:.2f} m assumed, so all lengths are "
            f"uncertain by about {100 * scene.scale_sigma:.0f} %. Give the stature."
        )
    if not scene.provenance.get("upright_frames"):
        yield (
            "The person never stands upright in the video, so scale and floor are uncertain by "
            f"about {100 * scene.scale_sigma:.0f} %. Film a second of upright standing."
        )


def _warnings_of_correction(corrected: PoseTrack) -> Iterator[str]:
    yield from corrected.provenance.get("correction", {}).get("warnings", ())


def _warn_of_video(pose: ViewPose) -> Iterator[str]:
    duration_s = float(pose.image.time_s[-1] - pose.image.time_s[0])
    if duration_s < SHORT_CLIP_S:
        yield (
            f"Only {duration_s:.1f} s ({pose.image.n_frames} pictures) were assessed, too little "
            "for a whole lift. Film from a second before the load is touched to a second after it "
            "is set down."
        )
    travel = pose.image.provenance.get(CAMERA_TRAVEL, math.nan)
    if travel > STEADY_TRAVEL:
        yield (
            f"The camera moved: the background travelled by {100 * travel:.1f} % of the picture. "
            "Distances and heights of the hands are less certain than their stated errors say. "
            "Put the camera on a tripod or a table and film again."
        )
    lost = int(np.isnan(pose.box).any(axis=1).sum())
    if lost:
        yield (
            f"The person was not seen in {lost} of {pose.image.n_frames} pictures; nothing is "
            "filled in there."
        )
    if pose.info.n_missing_frames:
        yield (
            f"The video is cut off: {pose.info.n_missing_frames} pictures that it announces are "
            "not in it. Only what is there was assessed."
        )


@contextmanager
def _timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - start


def assess_to_folder(
    trial: Trial,
    config: Config,
    folder: Path,
    progress: ProgressCallback = ignore_progress,
) -> Path:
    """Assess one trial and write its result folder, annotated video included.

    Parameters
    ----------
    trial, config, progress
        As in `assess`.
    folder
        Where to write; complete or not at all.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    OutputError
        If the folder can't be written.
    """
    folder = check_target(folder)
    with scratch_folder(folder):
        pass  # a disk that takes nothing is found out now, not after the long work
    result = assess(trial, config, progress)
    timings = dict(result.timings_s)
    with scratch_folder(folder) as scratch:
        overlay = thumbnail = None
        if config.output.overlay:
            with _timed(timings, "overlay"):
                overlay = scratch / "overlay.mp4"
                write_overlay(
                    trial.views[0].path,
                    result.views[0],
                    overlay,
                    blur_heads=config.output.blur_heads,
                    lifts=result.lifts,
                    start_s=config.video.start_s,
                    stop_s=config.video.stop_s,
                    progress=progress,
                )
            thumbnail = write_thumbnail(
                overlay, scratch / "thumbnail.jpg", at_s=_telling_moment(result)
            )
        result = dataclasses.replace(result, timings_s=timings)
        progress("write", 0, 0)
        return write_result(result, folder, overlay=overlay, thumbnail=thumbnail)


def _telling_moment(result: TrialResult) -> float:
    """Return when the first load leaves its place, or the middle, in the overlay's time."""
    time_s = result.corrected.time_s
    moment = result.lifts[0].start_s if result.lifts else float(time_s[len(time_s) // 2])
    return max(0.0, moment - float(time_s[0]))
