"""A trained model of one subject: features in, markers in metres with standard errors out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from engine.datatypes import Array
from engine.errors import ConfigError, DataError, ShapeError
from engine.pose.twin_gp.features import FEATURES, Crop
from engine.pose.twin_gp.lengths import (
    SEGMENT_NAMES,
    LengthPenalty,
    Shape,
    find_segments,
    learn_lengths,
)
from engine.pose.twin_gp.projection import BlockProjection, fit_projection
from engine.pose.twin_gp.regressors import REGRESSORS, Hyper, Regressor, TrainingSet
from engine.pose.twin_gp.selection import (
    SEARCH_FRAMES,
    InnerData,
    InnerResult,
    choose_hyper,
    leave_trials_out,
    mean_marker_error,
)
from engine.pose.twin_gp.smoothing import CUTOFFS_HZ, smooth_poses

__all__ = ["ModelSource", "Prediction", "TwinGPModel", "train_model"]

MIN_FRAMES: Final = 20
MAX_FRAMES: Final = 3000
"""More training frames than this are thinned evenly: the inverse grows with their square."""
VIDEO_RATE_HZ: Final = 30.0


@dataclass(frozen=True)
class ModelSource:
    """What a model was trained on, kept with it so that it is not used on anything else.

    Parameters
    ----------
    features
        Name of a feature set.
    views
        Names of the cameras, in order.
    picture_px
        Width and height of each view's pictures.
    crops
        The fixed crop of each view; empty where pictures are not looked at.
    subject
        Label of the person.
    rate_hz
        Frames per second.
    stature_m
        Of the person; None if unknown.
    """

    features: str = "hog"
    views: tuple[str, ...] = ()
    picture_px: tuple[tuple[int, int], ...] = ()
    crops: tuple[Crop, ...] = ()
    subject: str = ""
    rate_hz: float = VIDEO_RATE_HZ
    stature_m: float | None = None

    def __post_init__(self) -> None:
        if self.features not in FEATURES:
            raise ConfigError(f"Unknown features {self.features!r}; known: {', '.join(FEATURES)}.")


@dataclass(frozen=True, eq=False)
class Prediction:
    """Markers of M frames.

    Parameters
    ----------
    markers_m
        Shape (M, D, 3), lab axes; NaN where a frame's features are missing.
    sigma_m
        Shape (M, D), standard error per coordinate, from the process's variance and the errors of
        left-out training trials.
    length_error_m
        Shape (M, 4), upper-limb segments minus the subject's lengths; NaN if the marker
        set has no arms. Columns: `lengths.SEGMENT_NAMES`.
    iterations
        Shape (M,), of the solver; 0 where there is none.
    """

    markers_m: Array
    sigma_m: Array
    length_error_m: Array
    iterations: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class TwinGPModel:
    """Training frames, settings and what they say of the subject.

    Parameters
    ----------
    regressor
        Which estimator.
    training
        Its frames.
    projections
        How features are compressed.
    mean_pose
        Shape (3 D,), m, lab axes.
    marker_names
        D names.
    sigma_at
        Shape (D,): standard error per coordinate at the typical variance of left-out frames, m.
    eta_at
        That variance.
    penalty
        The lengths of the upper limbs and, where the estimator holds them, their weight.
    source
        What the model was trained on.
    inner_error_m
        Mean marker error of left-out training trials.
    """

    regressor: Regressor
    training: TrainingSet
    projections: tuple[BlockProjection, ...]
    mean_pose: Array
    marker_names: tuple[str, ...]
    sigma_at: Array
    eta_at: float
    penalty: LengthPenalty | None
    source: ModelSource = field(default_factory=ModelSource)
    inner_error_m: float = float("nan")

    @property
    def hyper(self) -> Hyper:
        """The settings inner validation chose."""
        return self.training.hyper

    @property
    def lengths_m(self) -> Mapping[str, float]:
        """The subject's upper-limb lengths; empty if the marker set has no arms."""
        if self.penalty is None:
            return {}
        return dict(zip(SEGMENT_NAMES, map(float, self.penalty.length_m), strict=True))

    def predict(self, features: ArrayLike) -> Prediction:
        """Estimate the markers of M frames.

        Parameters
        ----------
        features
            Shape (M, d), made as in training. For estimators that filter over time the rows are
            consecutive frames of one clip at the training's rate.

        Raises
        ------
        ShapeError
            If they are not as wide as in training.
        """
        rows = np.asarray(features, dtype=np.float32)
        width = sum(p.width for p in self.projections)
        if rows.ndim != 2 or rows.shape[1] != width:
            raise ShapeError(
                f"The model was trained on features of {width} numbers, got shape {rows.shape}; "
                "describe the videos with the same features, crops and views as in training."
            )
        known = np.isfinite(rows).all(axis=1)
        pose = np.full((len(rows), len(self.mean_pose)), np.nan)
        eta = np.full(len(rows), np.nan)
        iterations = np.zeros(len(rows), dtype=np.intp)
        if known.any():
            held = self.penalty if self.regressor.segments != "none" else None
            joined = _project(rows[known], self.projections, self.hyper.gamma_r)
            estimate = self.training.predict(joined, held, self.mean_pose)
            pose[known], eta[known] = estimate.pose + self.mean_pose, estimate.eta
            iterations[known] = estimate.iterations
        cutoff_hz = self.hyper.cutoff_hz if self.regressor.smooths else None
        pose = smooth_poses(pose, rate_hz=self.source.rate_hz, cutoff_hz=cutoff_hz)
        markers = pose.reshape(len(rows), -1, 3)
        return Prediction(
            markers_m=markers,
            sigma_m=np.sqrt(eta / self.eta_at)[:, None] * self.sigma_at,
            length_error_m=self._compare_lengths(markers),
            iterations=iterations,
        )

    def _compare_lengths(self, markers: Array) -> Array:
        if self.penalty is None:
            return np.full((len(markers), len(SEGMENT_NAMES)), np.nan)
        vector = np.einsum("cm,nmk->nck", self.penalty.segments, markers)
        return np.asarray(np.linalg.norm(vector, axis=2) - self.penalty.length_m)

    def save(self, path: Path) -> Path:
        """Write the model; see `model_file.write_model`."""
        from engine.pose.twin_gp.model_file import write_model

        return write_model(self, path)


def train_model(
    features: ArrayLike,
    markers_m: ArrayLike,
    groups: ArrayLike,
    *,
    marker_names: Sequence[str],
    regressor: str = "gp",
    blocks: Sequence[int] | None = None,
    source: ModelSource | None = None,
    hyper: Hyper | None = None,
    fixed_weight: float | None = None,
    penalty_shape: Shape = "squared",
    max_frames: int = MAX_FRAMES,
    seed: int = 0,
) -> TwinGPModel:
    """Train an estimator on the frames of one subject (or of several, jointly).

    Settings are chosen by leaving one training trial out at a time; nothing but what is given here
    is looked at. Frames with a missing number are left out.

    Parameters
    ----------
    features
        Shape (N, d), one row per frame; the frames of a trial in order.
    markers_m
        Shape (N, D, 3), m, lab axes.
    groups
        Shape (N,), the trial of each frame.
    marker_names
        D names.
    regressor
        One of `REGRESSORS`.
    blocks
        Widths of the blocks of features, as `combine_features` returns them; one block if None.
    source
        What the features are of, kept with the model.
    hyper
        Settings; chosen by inner validation if None.
    fixed_weight
        Weight of the length penalty per m^2, in place of the one that scales itself.
    penalty_shape
        `squared` or `pseudo-huber`.
    max_frames
        More are thinned evenly.
    seed
        Nothing here is random; kept so that every estimator can be called alike.

    Raises
    ------
    ConfigError
        If there is no such estimator.
    ShapeError
        If the arrays don't belong together.
    DataError
        If there are too few frames, or markers in millimetres.
    """
    del seed
    if regressor not in REGRESSORS:
        raise ConfigError(f"Unknown estimator {regressor!r}; known: {', '.join(REGRESSORS)}.")
    chosen = REGRESSORS[regressor]
    rows, markers, trial = _check_training(features, markers_m, groups, marker_names)
    step = -(-len(rows) // max_frames)
    rows, markers, trial = rows[::step], markers[::step], trial[::step]
    source = source or ModelSource()
    with threadpool_limits(limits=1, user_api="blas"):
        projections = fit_projection(rows, blocks or (rows.shape[1],))
        mean = markers.reshape(len(markers), -1).mean(axis=0)
        data = InnerData(
            _compress(rows, projections), markers.reshape(len(markers), -1) - mean, trial
        )
        penalty = _learn_penalty(
            marker_names, markers, chosen, fixed_weight=fixed_weight, shape=penalty_shape
        )
        held = penalty if chosen.segments != "none" else None
        if hyper is None:
            hyper, inner = choose_hyper(data, chosen.kind, held, mean)
            part = data.thin(SEARCH_FRAMES)
        else:
            inner, part = None, data
        if chosen.name == "nn":
            hyper = replace(hyper, neighbours=1)
        training = TrainingSet(data.join(hyper.gamma_r), data.pose, chosen.kind, hyper)
        if chosen.kind in ("gp", "ridge") or inner is None:
            inner, part = leave_trials_out(training.inverse, data), data
        if chosen.smooths and hyper.cutoff_hz is None:
            hyper = replace(hyper, cutoff_hz=_choose_cutoff(inner, data, source.rate_hz / step))
            training = _with_hyper(training, hyper)
        if chosen.smooths:
            inner = _smooth_inner(inner, data, source.rate_hz / step, hyper.cutoff_hz)
    truth = part.pose[inner.rows]
    sigma, eta = _calibrate(inner, truth)
    return TwinGPModel(
        regressor=chosen,
        training=training,
        projections=projections,
        mean_pose=mean,
        marker_names=tuple(marker_names),
        sigma_at=sigma,
        eta_at=eta,
        penalty=penalty,
        source=source,
        inner_error_m=mean_marker_error(inner.pose, truth),
    )


def _with_hyper(training: TrainingSet, hyper: Hyper) -> TrainingSet:
    """Return the same frames with other settings, keeping the kernel's inverse."""
    other = replace(training, hyper=hyper)
    other.__dict__["inverse"] = training.inverse
    return other


def _check_training(
    features: ArrayLike, markers_m: ArrayLike, groups: ArrayLike, names: Sequence[str]
) -> tuple[NDArray[np.float32], Array, NDArray[np.intp]]:
    rows = np.asarray(features, dtype=np.float32)
    markers = np.asarray(markers_m, dtype=np.float64)
    _, trial = np.unique(np.asarray(groups), return_inverse=True)
    if rows.ndim != 2 or markers.shape != (len(rows), len(names), 3) or len(trial) != len(rows):
        raise ShapeError(
            f"Expected features (N, d), markers (N, {len(names)}, 3) and one trial per frame, got "
            f"{rows.shape}, {markers.shape} and {trial.shape}."
        )
    known = np.isfinite(rows).all(axis=1) & np.isfinite(markers).all(axis=(1, 2))
    if known.sum() < MIN_FRAMES:
        raise DataError(
            f"Training needs at least {MIN_FRAMES} frames with all features and markers, got "
            f"{int(known.sum())} of {len(rows)}; check for markers or views that are never there."
        )
    rows, markers, trial = rows[known], markers[known], trial[known]
    extent = float(np.ptp(markers, axis=(0, 1)).max())
    if extent > 50.0:
        raise DataError(
            f"The markers span {extent:.0f} m, so they seem to be in millimetres; give metres."
        )
    if len(np.unique(trial)) < 2:
        # One trial can't be left out whole: its quarters are, which share neighbouring frames.
        trial = np.arange(len(trial)) * 4 // len(trial)
    return rows, markers, trial


def _compress(
    rows: NDArray[np.float32], projections: Sequence[BlockProjection]
) -> tuple[NDArray[np.float32], ...]:
    edges = np.cumsum([0, *(p.width for p in projections)])
    return tuple(
        p.apply(rows[:, a:b]) for p, a, b in zip(projections, edges[:-1], edges[1:], strict=True)
    )


def _project(
    rows: NDArray[np.float32], projections: Sequence[BlockProjection], gamma_r: Sequence[float]
) -> NDArray[np.float32]:
    blocks = _compress(rows, projections)
    scaled = [np.float32(np.sqrt(g)) * b for g, b in zip(gamma_r, blocks, strict=True)]
    return np.concatenate(scaled, axis=1)


def _learn_penalty(
    names: Sequence[str],
    markers: Array,
    chosen: Regressor,
    *,
    fixed_weight: float | None,
    shape: Shape,
) -> LengthPenalty | None:
    """Learn the subject's upper-limb lengths; None where nothing needs markers that are missing."""
    try:
        segments = find_segments(names, markers, glenohumeral=chosen.segments == "glenohumeral")
    except DataError:
        if chosen.segments != "none":
            raise
        return None
    length, sigma = learn_lengths(segments, markers)
    return LengthPenalty(segments, length, sigma, fixed_weight, shape)


def _choose_cutoff(inner: InnerResult, data: InnerData, rate_hz: float) -> float | None:
    choices = (None, *CUTOFFS_HZ)
    errors = [
        mean_marker_error(_smooth_inner(inner, data, rate_hz, c).pose, data.pose) for c in choices
    ]
    return choices[int(np.argmin(errors))]


def _smooth_inner(
    inner: InnerResult, data: InnerData, rate_hz: float, cutoff_hz: float | None
) -> InnerResult:
    pose = np.array(inner.pose)
    for rows in data.groups:
        pose[rows] = smooth_poses(pose[rows], rate_hz=rate_hz, cutoff_hz=cutoff_hz)
    return InnerResult(inner.rows, pose, inner.eta)


def _calibrate(inner: InnerResult, truth: Array) -> tuple[Array, float]:
    """Return each marker's error per coordinate (D,) at the mean variance, and that variance.

    Scaled so that the errors of left-out frames are as large as stated, taken together.
    """
    miss = (inner.pose - truth).reshape(len(truth), -1, 3)
    eta = max(float(inner.eta.mean()), 1e-12)
    return np.sqrt((miss**2).mean(axis=(0, 2))), eta
