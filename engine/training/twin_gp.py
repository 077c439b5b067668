"""Train the model of one person in front of two fixed cameras, for the estimator `twin-gp`.

Run from the project folder, on a folder laid out as docs/datasets.md says::

    python -m engine.training.twin_gp DATASET --person P01 --out P01.npz
    liftlens assess A.mp4 B.mp4 --backend twin-gp --model P01.npz --calibration cameras.toml

All trials of the person train it; what inner validation says of its error (each trial left out in
turn) is printed and kept in the file.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.config import Config
from engine.datatypes import Array, ViewPose, ignore_progress
from engine.errors import ConfigError, EngineError, ShapeError
from engine.kinematics.markers import filter_markers, read_marker_trc, resample_markers
from engine.pose.base import create_backend
from engine.pose.twin_gp import (
    FEATURES,
    REGRESSORS,
    Crop,
    ModelSource,
    TwinGPModel,
    combine_features,
    describe_landmarks,
    describe_video,
    fixed_crop,
    train_model,
)
from engine.subject.detector import PersonDetector
from engine.subject.tracker import follow_person
from engine.validation.protocol.dataset import SubjectFiles, TrialFiles, read_dataset
from engine.video.reader import probe_video, read_frames

__all__ = ["main", "train_subject"]

logger = logging.getLogger(__name__)

DEFAULT_FEATURES = "landmarks-window"
DEFAULT_REGRESSOR = "gp-smooth"
Features = NDArray[np.float32]


def main(arguments: Sequence[str] | None = None) -> int:
    """Train as the command line says; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path, help="folder of persons, see docs/datasets.md")
    parser.add_argument("--person", required=True, help="whose trials to train on")
    parser.add_argument("--out", type=Path, required=True, help="the model's file (.npz)")
    parser.add_argument("--features", default=DEFAULT_FEATURES, help=", ".join(FEATURES))
    parser.add_argument("--regressor", default=DEFAULT_REGRESSOR, help=", ".join(REGRESSORS))
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        (subject,) = read_dataset(options.dataset, persons=[options.person]).subjects
        model = train_subject(subject, features=options.features, regressor=options.regressor)
        model.save(options.out)
    except EngineError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    logger.info(
        "%s: %.1f mm mean marker error on trials left out. The model holds for %s and these "
        "cameras only.", options.out, 1000 * model.inner_error_m, subject.label,
    )  # fmt: skip
    return 0


def train_subject(
    subject: SubjectFiles,
    *,
    features: str = DEFAULT_FEATURES,
    regressor: str = DEFAULT_REGRESSOR,
    config: Config | None = None,
) -> TwinGPModel:
    """Train a model on all trials of a person.

    Parameters
    ----------
    subject
        Where the videos (two of each trial, starting together) and markers are.
    features, regressor
        One of `FEATURES` and one of `REGRESSORS`.
    config
        How the person is followed and seen; the defaults if None.

    Raises
    ------
    ConfigError
        If there are no such features or estimator, or a trial has not two videos.
    DataError, VideoError, PoseError
        If a trial can't be used.
    """
    for name, known in ((features, FEATURES), (regressor, REGRESSORS)):
        if name not in known:
            raise ConfigError(f"Unknown name {name!r}; known: {', '.join(known)}.")
    if any(len(trial.videos) != 2 for trial in subject.trials):
        raise ConfigError("The estimator 'twin-gp' is trained on two videos of every trial.")
    seen = [_see(trial, config or Config()) for trial in subject.trials]
    sizes = tuple(pose.info.size_px for pose in seen[0])
    if any(tuple(pose.info.size_px for pose in views) != sizes for views in seen):
        raise ConfigError("All videos of a view must have pictures of one size; export them alike.")
    crops = tuple(
        fixed_crop(np.concatenate([views[n].box for views in seen]), sizes[n]) for n in (0, 1)
    )
    parts = list(_describe(subject, seen, crops, features))
    names = parts[0][3]
    if any(part[3] != names for part in parts):
        raise ShapeError(
            f"The trials of {subject.label} have different markers; name them alike in all."
        )
    return train_model(
        np.concatenate([part[0] for part in parts]),
        np.concatenate([part[1] for part in parts]),
        np.concatenate([np.full(len(part[0]), n) for n, part in enumerate(parts)]),
        marker_names=names,
        regressor=regressor,
        blocks=parts[0][2],
        source=ModelSource(
            features=features,
            views=tuple(path.stem for path in subject.trials[0].videos),
            picture_px=sizes,
            crops=crops,
            subject=subject.label,
            rate_hz=round(float(np.median([views[0].info.fps for views in seen])), 3),
            stature_m=subject.stature_m,
        ),
    )


def _see(trial: TrialFiles, config: Config) -> tuple[ViewPose, ...]:
    logger.info("%s: following the person", trial.label)
    return tuple(_see_view(path, config) for path in trial.videos)


def _see_view(path: Path, config: Config) -> ViewPose:
    """Follow the person through one video, as an assessment does."""
    detector = PersonDetector(threads=config.pose.threads)
    tracked = follow_person(read_frames(path), detector, **asdict(config.subject))
    return create_backend(config.pose).estimate(tracked, probe_video(path), ignore_progress)


def _describe(
    subject: SubjectFiles,
    seen: Sequence[tuple[ViewPose, ...]],
    crops: Sequence[Crop],
    features: str,
) -> Iterator[tuple[Features, Array, tuple[int, ...], tuple[str, ...]]]:
    """Yield features, markers at the times of the pictures, blocks and names of each trial."""
    chosen = FEATURES[features]
    for trial, views in zip(subject.trials, seen, strict=True):
        time_s = views[0].image.time_s
        hog, landmarks = [], []
        for path, pose, crop in zip(trial.videos, views, crops, strict=True):
            nearest = np.minimum(np.arange(len(time_s)), pose.image.n_frames - 1)
            if chosen.hog is not None:
                hog.append(describe_video(read_frames(path), crop, chosen.hog)[nearest])
            if chosen.uses_landmarks:
                position = pose.image.position[nearest]
                landmarks.append(
                    describe_landmarks(position, pose.info.size_px, window=chosen.window)
                )
        rows, blocks = combine_features(hog=hog, landmarks=landmarks)
        recording = filter_markers(read_marker_trc(trial.markers))
        at_pictures = resample_markers(recording, time_s - trial.marker_offset_s)
        yield rows, at_pictures.position_m, blocks, tuple(at_pictures.names)


if __name__ == "__main__":
    sys.exit(main())
