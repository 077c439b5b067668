"""A stored trial assessed anew: with other corrections and everything else as it was."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from engine.config import Config, build_config
from engine.corrections import CONFIG_TABLE, Corrections, read_corrections, restore_sides
from engine.datatypes import ProgressCallback, Trial, TrialResult, View, ignore_progress
from engine.errors import ConfigError, VideoError
from engine.pipeline import assess, assess_poses, require_target, write_trial
from engine.storage.results import CALIBRATION_NAME, StoredResult
from engine.video.reader import probe_video

__all__ = ["OLD_OVERLAY", "reassess", "reassess_to_folder"]

OLD_OVERLAY: Final = (
    "The annotated video was not drawn again, since the original is no longer kept: it shows "
    "sides and lifts as they were before the correction."
)


def reassess(
    stored: StoredResult,
    corrections: Corrections,
    videos: Sequence[Path] = (),
    progress: ProgressCallback = ignore_progress,
) -> TrialResult:
    """Assess a stored trial anew, with other corrections and everything else as it was.

    Parameters
    ----------
    stored
        The result to start from.
    corrections
        All that is to be corrected now; what the result was corrected by before, and is not among
        them, is taken back.
    videos
        The videos it was made from, in their order; only needed where another person is followed
        than before. Otherwise the stored keypoints are used.
    progress
        As in `assess`.

    Returns
    -------
    TrialResult
        Nothing is written.

    Raises
    ------
    VideoError
        If videos are needed and not given, or are not the ones that were assessed.
    ConfigError
        If a correction can't be followed.
    """
    _require_same_videos(stored, videos)
    trial, config = _recall(stored, videos)
    if set(corrections.persons) == set(read_corrections(stored.document).persons):
        progress("scene", 0, 0)
        return assess_poses(trial, restore_sides(stored.views), config, corrections)
    if not videos:
        names = " and ".join(view.info.file_name for view in stored.views)
        raise VideoError(
            f"Following another person needs the video again; add the file that was assessed "
            f"({names})."
        )
    return assess(trial, config, progress, corrections)


def reassess_to_folder(
    stored: StoredResult,
    corrections: Corrections,
    folder: Path,
    videos: Sequence[Path] = (),
    progress: ProgressCallback = ignore_progress,
) -> Path:
    """Assess a stored trial anew (see `reassess`) and write its result folder.

    Without the videos, the annotated ones are taken over as they are, and the result says so.

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
    result = reassess(stored, corrections, videos, progress)
    _, config = _recall(stored, videos)
    if videos or stored.overlay_path is None:
        drawn = dataclasses.replace(config.output, overlay=stored.overlay_path is not None)
        return write_trial(result, dataclasses.replace(config, output=drawn), folder, progress)
    result = dataclasses.replace(result, warnings=(*result.warnings, OLD_OVERLAY))
    return write_trial(result, config, folder, progress, earlier=stored)


def _require_same_videos(stored: StoredResult, videos: Sequence[Path]) -> None:
    if videos and len(videos) != len(stored.views):
        raise ConfigError(
            f"The trial has {len(stored.views)} videos, but {len(videos)} are given; give all."
        )
    for video, view in zip(videos, stored.views, strict=False):
        if probe_video(video).sha256 != view.info.sha256:
            raise VideoError(
                f"{video.name} is not the video that was assessed: expected {view.info.file_name} "
                f"with the fingerprint {view.info.sha256[:16]}; choose that file."
            )


def _recall(stored: StoredResult, videos: Sequence[Path]) -> tuple[Trial, Config]:
    """Return the trial and the settings a result was made from."""
    document = stored.document
    # Without a video only its name counts; nothing in the working folder may be taken for it.
    names = [view.info.file_name for view in stored.views]
    paths = videos or [stored.folder / "video not kept" / name for name in names]
    trial = Trial(
        views=tuple(View(path) for path in paths),
        subject=stored.subject,
        task=stored.task,
        label=document["label"],
        site=document["site"],
        job=document["job"],
    )
    tables = {k: v for k, v in document["config"].items() if k != CONFIG_TABLE}
    return trial, _keep_cameras(build_config(tables), stored, videos)


def _keep_cameras(config: Config, stored: StoredResult, videos: Sequence[Path]) -> Config:
    """Take cameras and clocks from the result where what they were found from is gone."""
    two_view, sync = config.two_view, stored.sync
    kept = stored.folder / CALIBRATION_NAME
    if two_view.calibration and not Path(two_view.calibration).is_file() and kept.is_file():
        two_view = dataclasses.replace(two_view, calibration=str(kept))
    if sync is not None and not videos and sync.method in ("audio", "both"):
        two_view = dataclasses.replace(two_view, sync=repr(sync.offset_s))
    return dataclasses.replace(config, two_view=two_view)
