"""The order of the steps; the only module that knows it."""

from __future__ import annotations

import dataclasses
import math
import platform
import shutil
import time
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from engine import subject_model
from engine.cameras.files.own import format_calibration
from engine.cameras.monocular import reconstruct_single_view
from engine.config import Config, SubjectConfig
from engine.correction.chain import correct_track, summarise_status
from engine.corrections import (
    CONFIG_TABLE,
    NO_CORRECTIONS,
    SAME_MOMENT_S,
    Corrections,
    PersonChoice,
    apply_corrections,
)
from engine.datatypes import (
    Frame,
    JointAngles,
    PoseTrack,
    ProgressCallback,
    RiskResult,
    TrackedFrame,
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
from engine.errors import ConfigError, NoPersonFound, VideoError
from engine.kinematics.events import LiftFindings, detect_lifts
from engine.kinematics.fitting.base import (
    Solver,
    SolverInfo,
    add_scene_errors,
    select_solver,
)
from engine.kinematics.fusion import fuse_views
from engine.mesh_video import require_surface, write_mesh_overlay
from engine.pose.base import create_backend
from engine.pose.twin_gp import load_model
from engine.storage.atomic import scratch_folder
from engine.storage.results import StoredResult, check_target, write_result
from engine.subject.detector import PersonDetector
from engine.subject.tracker import follow_person
from engine.timing import NETWORK_CLOCK
from engine.two_view import JoinedViews, check_files, join_views, synchronise
from engine.version import __version__, list_versions
from engine.video.overlay import write_overlay
from engine.video.reader import probe_video, read_frames
from engine.video.steadiness import CameraWatch
from engine.video.sync import resample_views
from engine.video.thumbnail import write_thumbnail

__all__ = [
    "assess",
    "assess_pose",
    "assess_poses",
    "assess_to_folder",
    "observe_views",
    "require_target",
    "write_trial",
]


def assess(
    trial: Trial,
    config: Config | None = None,
    progress: ProgressCallback = ignore_progress,
    corrections: Corrections = NO_CORRECTIONS,
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
    corrections
        What a person saw otherwise than LiftLens.

    Returns
    -------
    TrialResult
        Nothing is written.

    Raises
    ------
    ConfigError
        If a setting or a correction can't be followed.
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
    # Wrong names fail before the long work, not after it.
    solver = select_solver(config.kinematics.solver)
    if solver.info.takes_markers and config.pose.backend != subject_model.BACKEND:
        raise _no_markers(solver.info)
    select_methods(config.risk.methods, experimental=config.risk.experimental)
    if config.pose.backend == subject_model.BACKEND:
        subject_model.check_model(trial.views, config)
    if len(trial.views) == 2:
        check_files(trial.views, config.two_view)
    start = time.perf_counter()
    poses = tuple(
        estimate_view(
            view,
            config,
            _share_of(progress, number, len(trial.views)),
            persons=corrections.persons_in(number),
        )
        for number, view in enumerate(trial.views)
    )
    spent = time.perf_counter() - start
    progress("scene", 0, 0)
    result = assess_poses(trial, poses, config, corrections)
    networks_s = sum(pose.model_time_s for pose in poses)
    timings = {"pose": spent, "networks": networks_s, **result.timings_s}
    return dataclasses.replace(result, timings_s=timings)


def observe_views(
    files: Sequence[View], config: Config, progress: ProgressCallback = ignore_progress
) -> tuple[ViewPose, ...]:
    """See one movement in two videos, and bring both to common times.

    Raises
    ------
    SyncError
        If it can't be told how their clocks belong together.
    VideoError, NoPersonFound, BackendUnavailable
        As `assess`.
    """
    check_files(files, config.two_view)
    poses = [
        estimate_view(view, config, _share_of(progress, number, len(files)))
        for number, view in enumerate(files)
    ]
    with threadpool_limits(limits=1, user_api="blas"):
        return resample_views(poses, synchronise(files, poses, config.two_view)).views


def _share_of(progress: ProgressCallback, number: int, count: int) -> ProgressCallback:
    """Report the work on one of several videos as a part of the whole."""

    def report(stage: str, done: int, total: int) -> None:
        progress(stage, done + number * total, count * total)

    return report


def assess_pose(trial: Trial, pose: ViewPose, config: Config | None = None) -> TrialResult:
    """Assess a trial of one view from keypoints that were already estimated; see `assess_poses`."""
    return assess_poses(trial, (pose,), config)


def assess_poses(
    trial: Trial,
    poses: Sequence[ViewPose],
    config: Config | None = None,
    corrections: Corrections = NO_CORRECTIONS,
) -> TrialResult:
    """Assess a trial from keypoints that were already estimated.

    Parameters
    ----------
    trial
        The person and the task; the pictures of its videos are not looked at.
    poses
        What an estimator saw in each video, in that video's time.
    config
        Settings; the defaults if None.
    corrections
        What a person saw otherwise: sides to exchange in `poses`, and when the lifts were. Whom
        they followed is in `poses` already.

    Returns
    -------
    TrialResult
        Nothing is written.

    Raises
    ------
    AssessmentError
        If the keypoints don't show enough of the person to find scale and direction.
    ConfigError
        If a setting or a correction can't be followed, or there are not as many poses as views.
    SyncError, CalibrationError
        If two views can't be brought into one time and one world.
    """
    if len(poses) != len(trial.views):
        raise ConfigError(
            f"The trial has {len(trial.views)} views, but keypoints of {len(poses)} are given."
        )
    # Thousands of tiny matrices: handing each to several threads costs a hundred times the work.
    with threadpool_limits(limits=1, user_api="blas"):
        return _assess_poses(trial, tuple(poses), config or Config(), corrections)


def _assess_poses(
    trial: Trial, poses: tuple[ViewPose, ...], config: Config, corrections: Corrections
) -> TrialResult:
    poses = apply_corrections(poses, corrections.swaps)
    timings: dict[str, float] = {}
    with _timed(timings, "reconstruction"):
        raw, scene, joined = _reconstruct(trial, poses, config)
        modelled = _ask_model(trial, joined, config)
        raw = modelled.track if modelled else raw
    fused_views = joined if config.two_view.fusion == "model" and modelled is None else None
    with _timed(timings, "correction"):
        corrected = every_joint = _keep_doubtful_joints(trial, raw, config)
        if fused_views is None:
            corrected = correct_track(
                raw, stature_m=trial.subject.stature.value, **dataclasses.asdict(config.correction)
            )
    with _timed(timings, "kinematics"):
        if fused_views is not None:
            cameras = fused_views.calibration.cameras
            fused = fuse_views(fused_views.views, cameras, every_joint, trial.subject)
            # A body fitted to both pictures knows where hidden hands are.
            corrected, fit, every_joint = fused.track, fused.fit, fused.track
        else:
            solver = select_solver(config.kinematics.solver)
            fit = solver.fit(_choose_track(solver, corrected, modelled), trial.subject)
        angles = add_scene_errors(fit.angles, scene)
        findings = _find_lifts(trial, every_joint, angles, scene, config, corrections)
    coverage = summarise_status(corrected, keypoints=MEASURED_KEYPOINTS)
    with _timed(timings, "risk"):
        risk = _assess_risk(trial, scene, corrected, angles, findings, config)
        flags = raise_flags(risk, findings.lifts, coverage)
    return TrialResult(
        trial=trial,
        views=poses,
        raw=raw,
        corrected=corrected,
        scene=scene,
        angles=angles,
        lifts=findings.lifts,
        risk=risk,
        flags=flags,
        warnings=(
            *_warn(trial, poses, scene),
            *(joined.warnings if joined else ()),
            *(modelled.warnings if modelled else ()),
            *_warnings_of_correction(corrected),
            *fit.warnings,
            *findings.warnings,
            *corrections.describe(),
        ),
        config=_list_settings(config, corrections),
        backend=config.pose.backend,
        solver=config.kinematics.solver,
        versions={"liftlens": __version__, "python": platform.python_version(), **list_versions()},
        timings_s=timings,
        coverage=coverage,
        body=fit.body,
        calibration=joined.calibration if joined else None,
        checks=joined.checks if joined else (),
        sync=joined.sync if joined else None,
    )


def _list_settings(config: Config, corrections: Corrections) -> dict[str, Any]:
    """Return all that decided a result, as it is stored with it."""
    if corrections == NO_CORRECTIONS:
        return config.as_dict()
    return {**config.as_dict(), CONFIG_TABLE: corrections.as_plain()}


def _reconstruct(
    trial: Trial, poses: tuple[ViewPose, ...], config: Config
) -> tuple[PoseTrack, WorldScene, JoinedViews | None]:
    """Place the joints in the world, from one view or from two."""
    stature = trial.subject.stature
    if len(poses) == 2:
        joined = join_views(trial.views, poses, stature, config.two_view, config.camera)
        return joined.track, joined.scene, joined
    camera = trial.views[0].camera
    track, scene = reconstruct_single_view(
        poses[0],
        stature,
        matrix=camera.matrix if camera else None,
        **dataclasses.asdict(config.camera),
    )
    return track, scene, None


def _ask_model(
    trial: Trial, joined: JoinedViews | None, config: Config
) -> subject_model.ModelledJoints | None:
    """Return what the person's own model says, if the trial is assessed by one."""
    if config.pose.backend != subject_model.BACKEND:
        return None
    if joined is None:
        raise ConfigError("The estimator 'twin-gp' needs keypoints of two views, got those of one.")
    model = load_model(Path(config.pose.model))
    return subject_model.estimate_joints(model, trial.views, joined)


def _choose_track(
    solver: Solver, keypoints: PoseTrack, modelled: subject_model.ModelledJoints | None
) -> PoseTrack:
    """Return what a solver fits: skin markers or keypoints."""
    if not solver.info.takes_markers:
        return keypoints
    if modelled is None or modelled.markers is None:
        raise _no_markers(solver.info)
    return modelled.markers


def _no_markers(solver: SolverInfo) -> ConfigError:
    return ConfigError(
        f"The solver {solver.name!r} fits skin markers, which only the estimator "
        f"{subject_model.BACKEND!r} gives, from a model trained on a known set of them; choose "
        "another solver, such as least-squares."
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


def estimate_view(
    view: View,
    config: Config,
    progress: ProgressCallback,
    *,
    persons: Sequence[PersonChoice] = (),
) -> ViewPose:
    """Read one video, follow the person and estimate the pose, in one pass over the pictures.

    `persons` are those a user chose, in order of time.
    """
    # Networks take a second to load: between them is a chance to cancel.
    progress("probe", 0, 0)
    info = probe_video(view.path)
    progress("subject", 0, 0)
    backend = create_backend(config.pose)
    progress("subject", 0, 0)
    detector = PersonDetector(threads=config.pose.threads)
    progress("subject", 0, 0)
    frames = read_frames(view.path, start_s=config.video.start_s, stop_s=config.video.stop_s)
    tracked = _follow(frames, detector, config.subject, persons)
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


def _follow(
    frames: Iterable[Frame],
    detector: PersonDetector,
    settings: SubjectConfig,
    persons: Sequence[PersonChoice],
) -> Iterator[TrackedFrame]:
    """Follow one person, and from the moment of each choice on whom the user chose.

    Raises
    ------
    ConfigError
        If the video ends before a choice.
    NoPersonFound
        If nobody was seen.
    """
    moments = [person.at_s - SAME_MOMENT_S for person in persons]
    number, last_s = 0, 0.0
    for number, part in groupby(frames, key=lambda frame: bisect_right(moments, frame.time_s)):
        box = persons[number - 1].box if number else settings.box
        try:
            for tracked in follow_person(
                part, detector, **{**dataclasses.asdict(settings), "box": box}
            ):
                last_s = tracked.frame.time_s
                yield tracked
        except NoPersonFound:
            # Before the first choice there may be nobody.
            if not persons:
                raise
    if number < len(persons):
        raise ConfigError(
            f"The person to follow is chosen at {persons[-1].at_s:.2f} s, but the video ends at "
            f"{last_s:.2f} s; choose a moment before that."
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


def _keep_doubtful_joints(trial: Trial, raw: PoseTrack, config: Config) -> PoseTrack:
    """Return the corrected joints with every doubtful one kept.

    A hand hidden behind the body or the load still has to be somewhere: the estimator's guess
    is used for finding lifts, with a wide error, while joint angles leave it out.
    """
    settings = dataclasses.asdict(config.correction) | {"min_confidence": 0.0}
    if settings["preset"] == "none":
        settings["preset"] = "default"
    return correct_track(raw, stature_m=trial.subject.stature.value, **settings)


def _find_lifts(
    trial: Trial,
    track: PoseTrack,
    angles: JointAngles,
    scene: WorldScene,
    config: Config,
    corrections: Corrections,
) -> LiftFindings:
    return detect_lifts(
        track,
        angles,
        scene,
        stature_m=trial.subject.stature.value,
        sex=trial.subject.sex,
        set_lifts=corrections.set_lifts,
        not_lifts=corrections.not_lifts,
        **dataclasses.asdict(config.events),
    )


def _warn(trial: Trial, poses: tuple[ViewPose, ...], scene: WorldScene) -> Iterator[str]:
    """Say in plain words what makes this assessment less certain."""
    for pose in poses:
        name = f"{pose.info.file_name}: " if len(poses) > 1 else ""
        yield from (name + warning for warning in _warn_of_video(pose))
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
    corrections: Corrections = NO_CORRECTIONS,
) -> Path:
    """Assess one trial and write its result folder, annotated video included.

    Parameters
    ----------
    trial, config, progress, corrections
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
    folder = require_target(folder)
    if config.output.surface:
        require_surface()
    return write_trial(assess(trial, config, progress, corrections), config, folder, progress)


def require_target(folder: Path) -> Path:
    """Return where a result may be written; found out before the long work.

    Raises
    ------
    OutputError
        If nothing can be written there.
    """
    folder = check_target(folder)
    with scratch_folder(folder):
        pass  # a disk that takes nothing is found out now, not after the long work
    return folder


def write_trial(
    result: TrialResult,
    config: Config,
    folder: Path,
    progress: ProgressCallback,
    earlier: StoredResult | None = None,
) -> Path:
    """Write a result folder with the annotated videos: drawn anew, or those of an `earlier` one."""
    timings = dict(result.timings_s)
    with scratch_folder(folder) as scratch:
        overlays: list[Path] = []
        thumbnail = None
        if earlier is not None:
            overlays, thumbnail = _copy_pictures(earlier, scratch)
        elif config.output.overlay:
            with _timed(timings, "overlay"):
                overlays = _write_overlays(result, config, scratch, progress)
            thumbnail = write_thumbnail(
                overlays[0], scratch / "thumbnail.jpg", at_s=_telling_moment(result)
            )
        result = dataclasses.replace(result, timings_s=timings)
        progress("write", 0, 0)
        return write_result(
            result,
            folder,
            overlay=overlays[0] if overlays else None,
            second_overlay=overlays[1] if len(overlays) > 1 else None,
            thumbnail=thumbnail,
            calibration_text=format_calibration(result.calibration) if result.calibration else "",
        )


def _copy_pictures(earlier: StoredResult, scratch: Path) -> tuple[list[Path], Path | None]:
    """Copy the annotated videos and the still picture of a result; return where they are."""
    videos = [p for p in (earlier.overlay_path, earlier.second_overlay_path) if p is not None]
    overlays = [Path(shutil.copyfile(p, scratch / p.name)) for p in videos]
    still = earlier.thumbnail_path
    return overlays, None if still is None else Path(shutil.copyfile(still, scratch / still.name))


def _write_overlays(
    result: TrialResult, config: Config, scratch: Path, progress: ProgressCallback
) -> list[Path]:
    """Write the annotated videos; those of two views show the same time, from its start on."""
    written = []
    spans = _spans(result, config)
    write = write_mesh_overlay if config.output.surface else write_overlay
    for number, (pose, span) in enumerate(zip(result.views, spans, strict=True)):
        written.append(scratch / f"overlay{number}.mp4")
        write(
            result.trial.views[number].path,
            pose,
            written[-1],
            blur_heads=config.output.blur_heads,
            lifts=result.lifts,
            start_s=span.start_s,
            stop_s=span.stop_s,
            time_offset_s=span.time_offset_s,
            progress=_share_of(progress, number, len(spans)),
        )
    return written


@dataclass(frozen=True)
class _Span:
    """Which part of a video is shown, in its own time, and what to add for the trial's time."""

    start_s: float
    stop_s: float | None
    time_offset_s: float = 0.0


def _spans(result: TrialResult, config: Config) -> list[_Span]:
    if result.sync is None:
        return [_Span(config.video.start_s, config.video.stop_s)]
    synced = resample_views(result.views, result.sync)
    # Half a frame of room: the first common picture must be in both videos.
    room = 0.5 / max(result.views[0].info.fps, result.views[1].info.fps, 1.0)
    length_s = float(synced.views[0].image.time_s[-1])
    starts = (synced.start_in_first_s, synced.start_in_second_s)
    return [_Span(start - room, start + length_s + room, -start) for start in starts]


def _telling_moment(result: TrialResult) -> float:
    """Return when the first load leaves its place, or the middle, in the overlay's time."""
    time_s = result.corrected.time_s
    moment = result.lifts[0].start_s if result.lifts else float(time_s[len(time_s) // 2])
    return max(0.0, moment - float(time_s[0]))
