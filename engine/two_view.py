"""Two videos of one movement become one track in world metres.

The steps between the keypoints of two views and the joints in the world: the clocks, the cameras,
the lines of sight, and what the world says of the cameras. What can't be trusted is refused with a
sentence; what is doubtful goes on with a warning.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from engine.cameras.files import adapt_to_pictures, match_cameras, read_calibration
from engine.cameras.self_calibration import calibrate_from_person
from engine.cameras.two_view import reconstruct_two_views
from engine.cameras.verdict import check_calibration, summarise_checks
from engine.config import CameraConfig, TwoViewConfig
from engine.datatypes import (
    Calibration,
    CalibrationCheck,
    CheckLevel,
    Measurement,
    PoseTrack,
    SyncEstimate,
    View,
    ViewPose,
    WorldScene,
)
from engine.errors import CalibrationError, VideoError
from engine.video.reader import probe_video, read_frames
from engine.video.sync import (
    SyncedViews,
    check_offset,
    estimate_offset,
    read_audio,
    refine_offset,
    require_sure,
    resample_views,
)

__all__ = ["JoinedViews", "check_files", "find_cameras", "join_views", "synchronise"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class JoinedViews:
    """Two views in one time and one world.

    Parameters
    ----------
    synced
        What was seen, at common times from 0.
    sync
        How the clocks belong together.
    calibration
        The cameras in the world of `track`.
    checks
        What the world says of them.
    track
        The joints in world metres.
    scene
        The first camera, and what is not known of the world.
    """

    synced: SyncedViews
    sync: SyncEstimate
    calibration: Calibration
    checks: tuple[CalibrationCheck, ...]
    track: PoseTrack
    scene: WorldScene

    @property
    def views(self) -> tuple[ViewPose, ViewPose]:
        """What was seen, at common times."""
        return self.synced.views

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes clocks or cameras doubtful, in plain words."""
        doubts = [c for c in self.checks if c.level is not CheckLevel.GREEN]
        said = [f"{check.sentence} {check.action}".strip() for check in doubts]
        if self.sync.level is not CheckLevel.GREEN:
            said.insert(0, self.sync.sentence)
        return (*said, *self.calibration.provenance.get("notes", ()))


def join_views(
    files: Sequence[View],
    poses: Sequence[ViewPose],
    stature: Measurement,
    settings: TwoViewConfig,
    camera: CameraConfig,
) -> JoinedViews:
    """Bring two views into one time and one world.

    Parameters
    ----------
    files
        The two videos; cameras they hold win over a calibration file.
    poses
        What an estimator saw in each, in each video's own time.
    stature
        Metres, with standard error.
    settings
        Where the cameras and the offset come from.
    camera
        What is assumed of cameras nobody calibrated.

    Raises
    ------
    SyncError
        If it can't be told how the clocks belong together.
    CalibrationError
        If the cameras can't be found, or the world says that they are wrong.
    AssessmentError
        If too little of the person is seen.
    """
    sync = synchronise(files, poses, settings)
    synced = resample_views(poses, sync)
    calibration = find_cameras(files, synced.views, stature, settings, camera)
    sharper = refine_offset(poses[0], poses[1], calibration.cameras, sync)
    if sharper is not sync:
        sync, synced = sharper, resample_views(poses, sharper)
    checks = check_calibration(synced.views, calibration, stature)
    _refuse_wrong_cameras(checks, calibration)
    track, scene, placed = reconstruct_two_views(synced.views, calibration, stature)
    return JoinedViews(synced, sync, placed, checks, track, scene)


def check_files(files: Sequence[View], settings: TwoViewConfig) -> None:
    """Find out before the long work what is wrong with the videos and their calibration.

    Raises
    ------
    VideoError
        If a video can't be read, or both are the same film.
    CalibrationError
        If the calibration can't be read or was made for other pictures.
    """
    infos = [probe_video(file.path) for file in files]
    if infos[0].sha256 and infos[0].sha256 == infos[1].sha256:
        raise VideoError(
            f"{infos[0].file_name} and {infos[1].file_name} are the same film; choose the video of "
            "the other camera, or assess one video alone."
        )
    if settings.calibration:
        _read_file(files, [info.size_px for info in infos], settings)


def _read_file(
    files: Sequence[View], sizes_px: Sequence[tuple[int, int]], settings: TwoViewConfig
) -> Calibration:
    """Read the cameras of the videos and fit them to their pictures."""
    calibration, named = match_cameras(
        read_calibration(Path(settings.calibration)), [file.path.name for file in files]
    )
    # Black bars in a picture tell a padded one from a cropped one.
    pictures = [next(iter(read_frames(f.path))).image for f in files if f.path.is_file()]
    calibration, fitted = adapt_to_pictures(
        calibration, sizes_px, pictures if len(pictures) == len(files) else None
    )
    for check in (named, *fitted):
        if check.level is CheckLevel.RED:
            raise CalibrationError(f"{check.sentence} {check.action}".strip())
    doubts = [
        f"{check.sentence} {check.action}".strip()
        for check in (named, *fitted)
        if check.level is not CheckLevel.GREEN
    ]
    notes = [*calibration.provenance.get("notes", ()), *doubts]
    return replace(calibration, provenance={**calibration.provenance, "notes": notes})


def synchronise(
    files: Sequence[View], poses: Sequence[ViewPose], settings: TwoViewConfig
) -> SyncEstimate:
    """Find out, or take from the user, how the clocks of two videos belong together.

    Raises
    ------
    SyncError
        If that can't be told.
    """
    first, second = poses
    if settings.given_offset_s is not None:
        return check_offset(first, second, settings.given_offset_s)
    # Keypoints may be assessed again after the videos are gone.
    heard, also_heard = (read_audio(f.path) if f.path.is_file() else None for f in files)
    return require_sure(estimate_offset(first, second, audio=(heard, also_heard)))


def find_cameras(
    files: Sequence[View],
    views: Sequence[ViewPose],
    stature: Measurement,
    settings: TwoViewConfig,
    camera: CameraConfig,
) -> Calibration:
    """Return the cameras: those given, those of the file, or calibrated from the person.

    Raises
    ------
    CalibrationError
        If they can't be read or found.
    """
    given = [file.camera for file in files if file.camera is not None]
    if len(given) == len(files):
        return Calibration(cameras=tuple(given), source="file")
    if settings.calibration:
        return _read_file(files, [view.info.size_px for view in views], settings)
    return calibrate_from_person(
        views,
        stature,
        horizontal_fov_deg=camera.horizontal_fov_deg,
        fov_sigma_deg=camera.fov_sigma_deg,
    )


def _refuse_wrong_cameras(checks: Sequence[CalibrationCheck], calibration: Calibration) -> None:
    worst = summarise_checks(checks)
    if worst.level is not CheckLevel.RED:
        return
    way_out = "Or assess one of the videos alone."
    is_late = any(c.key == "time" and c.level is CheckLevel.RED for c in checks)
    if calibration.source != "person" and not is_late:
        way_out = "Or leave the calibration out: cameras are then found from the moving person."
    parts = ["The cameras can't be trusted.", worst.sentence, worst.action, way_out]
    raise CalibrationError(" ".join(part for part in parts if part))
