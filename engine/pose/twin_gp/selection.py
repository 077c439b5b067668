"""Inner validation: every setting is chosen by leaving whole training trials out, in turn.

For kernel regression that takes one inverse per setting, not one per trial: without the
rows G of a left-out trial the predictions are ``y_G - ([A]_GG)^-1 [A y]_G`` with
``A = (K + lambda I)^-1`` of all frames, and the weights and variances follow the same way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.pose.twin_gp.kernels import (
    compute_kernel,
    compute_square_distances,
    find_median_square,
)
from engine.pose.twin_gp.lengths import LengthPenalty
from engine.pose.twin_gp.regressors import (
    Hyper,
    Kind,
    invert_kernel,
    solve_locally,
    solve_twin,
    weigh_neighbours,
)
from engine.pose.twin_gp.twin import (
    FACTOR_TOLERANCE,
    LowRankInverse,
    SharedTwin,
    factor_kernel,
)

__all__ = ["InnerData", "InnerResult", "choose_hyper", "leave_trials_out", "mean_marker_error"]

SEARCH_FRAMES: Final = 1000
TWIN_FRAMES_PER_TRIAL: Final = 10
GAMMAS: Final = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Widths of a block of features, per median squared distance."""
NOISES: Final = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
POSE_GAMMAS: Final = (0.1, 0.3, 1.0)
POSE_NOISES: Final = (1e-2, 1e-1)
NEIGHBOURS: Final = (3, 5, 10, 20)
LOCAL_NEIGHBOURS: Final = (30, 100)
RIDGE_NOISES: Final = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)


@dataclass(frozen=True, eq=False)
class InnerData:
    """Training frames for the search.

    Parameters
    ----------
    blocks
        Compressed features of each block, each with median squared distance 1, (N, k).
    pose
        Shape (N, D), m, around their mean.
    trial
        Shape (N,), which trial a frame is of.
    """

    blocks: tuple[NDArray[np.float32], ...]
    pose: Array
    trial: NDArray[np.intp]

    def thin(self, count: int) -> InnerData:
        """Return at most about `count` evenly spaced frames."""
        step = max(1, -(-len(self.pose) // count))
        part = slice(None, None, step)
        return InnerData(tuple(b[part] for b in self.blocks), self.pose[part], self.trial[part])

    @property
    def groups(self) -> list[NDArray[np.intp]]:
        """The rows of each trial."""
        return [np.flatnonzero(self.trial == t) for t in np.unique(self.trial)]

    def join(self, gamma_r: Sequence[float]) -> NDArray[np.float32]:
        """Return features (N, k) whose squared distances hold the widths of the blocks."""
        scaled = [np.float32(np.sqrt(g)) * b for g, b in zip(gamma_r, self.blocks, strict=True)]
        return np.concatenate(scaled, axis=1)


@dataclass(frozen=True, eq=False)
class InnerResult:
    """Poses of left-out trials: rows (R,), poses (R, D) around the mean, and variances (R,)."""

    rows: NDArray[np.intp]
    pose: Array
    eta: Array


def mean_marker_error(pose: Array, truth: Array) -> float:
    """Return the mean distance of markers between poses (M, 3 D), in their unit."""
    miss = (pose - truth).reshape(len(pose), -1, 3)
    return float(np.linalg.norm(miss, axis=2).mean())


def leave_trials_out(inverse: Array, data: InnerData) -> InnerResult:
    """Return what kernel regression says of every trial without having seen it, in closed form.

    Parameters
    ----------
    inverse
        Shape (N, N), ``(K_R + lambda_R I)^-1`` of all frames.
    data
        The frames.
    """
    weighted = inverse @ data.pose
    pose, eta = np.empty_like(data.pose), np.empty(len(data.pose))
    for rows in data.groups:
        covariance = np.linalg.inv(inverse[np.ix_(rows, rows)])
        pose[rows] = data.pose[rows] - covariance @ weighted[rows]
        eta[rows] = np.diagonal(covariance)
    return InnerResult(np.arange(len(pose)), pose, eta)


def choose_hyper(
    data: InnerData, kind: Kind, penalty: LengthPenalty | None = None, offset: Array | None = None
) -> tuple[Hyper, InnerResult]:
    """Choose the settings of an estimator by the marker error of left-out trials.

    Parameters
    ----------
    data
        All training frames; the search looks at an evenly spaced part.
    kind
        Of estimator.
    penalty, offset
        On segment lengths, and the mean pose (D,); the twin's settings are chosen without the
        penalty, its answers for left-out trials are with it.

    Returns
    -------
    tuple
        The settings, and the poses of left-out frames under them (rows count in the thinned data
        returned by ``data.thin(SEARCH_FRAMES)``).
    """
    part = data.thin(SEARCH_FRAMES)
    offset = np.zeros(part.pose.shape[1]) if offset is None else offset
    if kind == "neighbour":
        return _choose_neighbours(part)
    if kind == "ridge":
        return _choose_ridge(part)
    hyper, plain = _choose_kernel(part)
    if kind == "gp":
        return hyper, plain
    if kind == "tgp-knn":
        return _choose_local(part, hyper, offset)
    return _choose_twin(part, hyper, penalty, offset)


def _choose_neighbours(part: InnerData) -> tuple[Hyper, InnerResult]:
    distance = sum(compute_square_distances(block) for block in part.blocks)
    distance = np.where(part.trial[:, None] == part.trial, np.inf, distance)
    rows = np.arange(len(part.pose))

    def predict(count: int) -> Array:
        return np.asarray(weigh_neighbours(distance, count) @ part.pose)

    best = min(NEIGHBOURS, key=lambda count: mean_marker_error(predict(count), part.pose))
    ones = (1.0,) * len(part.blocks)
    eta = 1.0 - compute_kernel(distance.min(axis=1), 1.0)
    return Hyper(gamma_r=ones, neighbours=best), InnerResult(rows, predict(best), eta)


def _choose_ridge(part: InnerData) -> tuple[Hyper, InnerResult]:
    features = part.join((1.0,) * len(part.blocks)).astype(np.float64)
    kernel = features @ features.T
    noises = [share * float(np.trace(kernel)) / len(kernel) for share in RIDGE_NOISES]
    tried = [leave_trials_out(invert_kernel(kernel, noise), part) for noise in noises]
    errors = [mean_marker_error(result.pose, part.pose) for result in tried]
    best = int(np.argmin(errors))
    hyper = Hyper(gamma_r=(1.0,) * len(part.blocks), lambda_r=noises[best])
    return hyper, tried[best]


def _choose_kernel(part: InnerData) -> tuple[Hyper, InnerResult]:
    """Choose widths and noise of the feature kernel."""
    distances = [compute_square_distances(block) for block in part.blocks]
    best, best_error, best_result = Hyper(), np.inf, None
    for gammas, noise in product(product(GAMMAS, repeat=len(distances)), NOISES):
        total = sum(g * d for g, d in zip(gammas, distances, strict=True))
        result = leave_trials_out(
            invert_kernel(compute_kernel(np.asarray(total), 1.0), noise), part
        )
        error = mean_marker_error(result.pose, part.pose)
        if error < best_error:
            best, best_error, best_result = Hyper(gammas, noise), error, result
    if best_result is None:  # every error was NaN
        raise FloatingPointError("No setting of the feature kernel gives finite poses.")
    return best, best_result


def _choose_twin(
    part: InnerData, hyper: Hyper, penalty: LengthPenalty | None, offset: Array
) -> tuple[Hyper, InnerResult]:
    """Choose width and noise of the pose kernel."""
    features = part.join(hyper.gamma_r)
    kernel = compute_kernel(compute_square_distances(features), 1.0)
    inverse = invert_kernel(kernel, hyper.lambda_r)
    median = find_median_square(compute_square_distances(part.pose))
    choices = [
        replace(hyper, gamma_x=gamma / median, lambda_x=noise)
        for gamma, noise in product(POSE_GAMMAS, POSE_NOISES)
    ]

    def judge(choice: Hyper) -> float:
        result = _solve_left_out(part, inverse, choice, None, offset)
        return mean_marker_error(result.pose, part.pose[result.rows])

    best = min(choices, key=judge)
    return best, _solve_left_out(part, inverse, best, penalty, offset)


def _solve_left_out(
    part: InnerData, inverse: Array, hyper: Hyper, penalty: LengthPenalty | None, offset: Array
) -> InnerResult:
    """Solve the twin for some frames of every trial, without that trial."""
    factor = factor_kernel(part.pose, hyper.gamma_x, FACTOR_TOLERANCE * hyper.lambda_x)
    answers = []
    for rows, others in _split(part):
        looked = _thin_rows(rows)
        covariance = np.linalg.inv(inverse[np.ix_(rows, rows)])
        at = np.searchsorted(rows, looked)
        u = -covariance[at] @ inverse[np.ix_(rows, others)]
        twin = SharedTwin(
            part.pose[others],
            LowRankInverse.from_factor(factor[others], hyper.lambda_x),
            hyper.gamma_x,
            u,
            np.maximum(np.diagonal(covariance)[at], 1e-12),
        )
        pose, _ = solve_twin(twin, u @ part.pose[others], twin.eta, penalty, offset)
        answers.append(InnerResult(looked, pose, twin.eta))
    return _join_results(answers)


def _choose_local(part: InnerData, hyper: Hyper, offset: Array) -> tuple[Hyper, InnerResult]:
    """Choose the neighbours and the noise of the pose kernel of TGPKNN."""
    features = part.join(hyper.gamma_r)
    median = find_median_square(compute_square_distances(part.pose))
    choices = [
        replace(hyper, gamma_x=1.0 / median, lambda_x=noise, neighbours=count)
        for noise, count in product(POSE_NOISES, LOCAL_NEIGHBOURS)
    ]

    def solve(choice: Hyper) -> InnerResult:
        answers = []
        for rows, others in _split(part):
            looked = _thin_rows(rows)
            distance = compute_square_distances(features[looked], features[others])
            count = min(choice.neighbours, len(others))
            near = np.argpartition(distance, count - 1, axis=1)[:, :count]
            estimate = solve_locally(
                np.take_along_axis(distance, near, axis=1),
                features[others][near],
                part.pose[others][near],
                choice,
                penalty=None,
                offset=offset,
            )
            answers.append(InnerResult(looked, estimate.pose, estimate.eta))
        return _join_results(answers)

    results = [solve(choice) for choice in choices]
    errors = [mean_marker_error(r.pose, part.pose[r.rows]) for r in results]
    best = int(np.argmin(errors))
    return choices[best], results[best]


def _split(part: InnerData) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    for rows in part.groups:
        yield rows, np.setdiff1d(np.arange(len(part.pose)), rows)


def _thin_rows(rows: NDArray[np.intp]) -> NDArray[np.intp]:
    return rows[:: max(1, len(rows) // TWIN_FRAMES_PER_TRIAL)]


def _join_results(parts: Sequence[InnerResult]) -> InnerResult:
    return InnerResult(
        np.concatenate([p.rows for p in parts]),
        np.concatenate([p.pose for p in parts]),
        np.concatenate([p.eta for p in parts]),
    )
