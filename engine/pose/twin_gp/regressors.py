"""The estimators: from compressed features to poses, all on the same training frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.pose.twin_gp.kernels import compute_kernel, compute_square_distances
from engine.pose.twin_gp.lengths import LengthPenalty
from engine.pose.twin_gp.twin import (
    FACTOR_TOLERANCE,
    LocalTwin,
    LowRankInverse,
    Objective,
    SharedTwin,
    factor_kernel,
    minimise,
    solve_with_lengths,
)

__all__ = [
    "REGRESSORS",
    "Estimate",
    "Hyper",
    "Kind",
    "Regressor",
    "TrainingSet",
    "invert_kernel",
    "solve_twin",
    "weigh_neighbours",
]

Kind = Literal["neighbour", "ridge", "gp", "tgp", "tgp-knn"]
CHUNK_FRAMES: Final = 512
KNN_CHUNK_FRAMES: Final = 64


@dataclass(frozen=True)
class Regressor:
    """A named estimator.

    `segments` says which upper-limb lengths are held: none, from the acromion, or from the
    shoulder's centre of rotation. `smooths` whether a Butterworth filter over the clip follows.
    """

    name: str
    title: str
    kind: Kind
    segments: Literal["none", "acromion", "glenohumeral"] = "none"
    smooths: bool = False


REGRESSORS: Final[Mapping[str, Regressor]] = {
    r.name: r
    for r in (
        Regressor("nn", "Nearest training frame", "neighbour"),
        Regressor("wknn", "Weighted nearest training frames", "neighbour"),
        Regressor("ridge", "Ridge regression", "ridge"),
        Regressor("gp", "Gaussian process, mean", "gp"),
        Regressor("gp-smooth", "Gaussian process, mean, low-pass filtered", "gp", smooths=True),
        Regressor("tgp", "Twin Gaussian process", "tgp"),
        Regressor("tgp-knn", "Twin Gaussian process of nearest frames", "tgp-knn"),
        Regressor(
            "tgp-constrained", "Twin Gaussian process, upper-limb lengths held", "tgp", "acromion"
        ),
        Regressor(
            "tgp-constrained-gh",
            "Twin Gaussian process, lengths held from the shoulder's centre",
            "tgp",
            "glenohumeral",
        ),
    )
}


@dataclass(frozen=True)
class Hyper:
    """What inner validation chooses.

    Parameters
    ----------
    gamma_r
        Width of the feature kernel, one per block, per median squared distance.
    lambda_r, lambda_x
        Noise of the feature and the pose kernel, relative to their height of 1.
    gamma_x
        Width of the pose kernel, 1/m^2.
    neighbours
        K of the nearest-neighbour estimators and of `tgp-knn`.
    cutoff_hz
        Of the filter over time; None filters nothing.
    """

    gamma_r: tuple[float, ...] = (0.3,)
    lambda_r: float = 1e-2
    gamma_x: float = 1.0
    lambda_x: float = 1e-2
    neighbours: int = 1
    cutoff_hz: float | None = None


@dataclass(frozen=True, eq=False)
class Estimate:
    """Poses (M, D) in m around the training mean, predictive variance (M,), iterations (M,)."""

    pose: Array
    eta: Array
    iterations: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """Training frames with everything an estimator needs of them, worked out once.

    Parameters
    ----------
    features
        Shape (N, k), compressed, blocks scaled by the roots of their `gamma_r`: the feature kernel
        is ``exp(-|a - b|^2)``.
    pose
        Shape (N, D), m, around their mean.
    kind
        Of estimator; ridge regression has the linear kernel.
    hyper
        Chosen settings.
    """

    features: NDArray[np.float32]
    pose: Array
    kind: Kind
    hyper: Hyper

    def compare(self, features: NDArray[np.float32]) -> Array:
        """Return the feature kernel of M frames with the training frames, (M, N)."""
        if self.kind == "ridge":
            # Noise far below the signal needs more digits than float32 has.
            return features.astype(np.float64) @ self.features.T.astype(np.float64)
        return compute_kernel(compute_square_distances(features, self.features), 1.0)

    @cached_property
    def inverse(self) -> Array:
        """``(K_R + lambda_R I)^-1``, shape (N, N)."""
        kernel = self.compare(self.features)
        return invert_kernel(kernel, self.hyper.lambda_r)

    @cached_property
    def pose_inverse(self) -> LowRankInverse:
        """Of the pose kernel."""
        tolerance = FACTOR_TOLERANCE * self.hyper.lambda_x
        factor = factor_kernel(self.pose, self.hyper.gamma_x, tolerance)
        return LowRankInverse.from_factor(factor, self.hyper.lambda_x)

    def predict(
        self, features: NDArray[np.float32], penalty: LengthPenalty | None, offset: Array
    ) -> Estimate:
        """Estimate the poses of M frames.

        Parameters
        ----------
        features
            Shape (M, k), compressed and scaled like those of training.
        penalty
            On the lengths of segments, if they are held.
        offset
            Shape (D,), the mean training pose, m.
        """
        step = KNN_CHUNK_FRAMES if self.kind == "tgp-knn" else CHUNK_FRAMES
        parts = [
            self._predict_chunk(features[i : i + step], penalty, offset)
            for i in range(0, len(features), step)
        ]
        return Estimate(
            np.concatenate([p.pose for p in parts]),
            np.concatenate([p.eta for p in parts]),
            np.concatenate([p.iterations for p in parts]),
        )

    def _predict_chunk(
        self, features: NDArray[np.float32], penalty: LengthPenalty | None, offset: Array
    ) -> Estimate:
        if self.kind == "tgp-knn":
            return self._predict_locally(features, penalty, offset)
        if self.kind == "neighbour":
            distance = compute_square_distances(features, self.features)
            weight = weigh_neighbours(distance, self.hyper.neighbours)
            eta = 1.0 - compute_kernel(distance.min(axis=1), 1.0)
            return Estimate(weight @ self.pose, eta, np.zeros(len(features), dtype=np.intp))
        kernel = self.compare(features)
        u = kernel @ self.inverse
        linear = self.kind == "ridge"
        own = np.einsum("mk,mk->m", features, features, dtype=np.float64) if linear else 1.0
        eta = np.maximum(own + self.hyper.lambda_r - np.einsum("mn,mn->m", kernel, u), 1e-12)
        start = u @ self.pose
        if self.kind != "tgp":
            return Estimate(start, eta, np.zeros(len(features), dtype=np.intp))
        twin = SharedTwin(self.pose, self.pose_inverse, self.hyper.gamma_x, u, eta)
        pose, iterations = solve_twin(twin, start, eta, penalty, offset)
        return Estimate(pose, eta, iterations)

    def _predict_locally(
        self, features: NDArray[np.float32], penalty: LengthPenalty | None, offset: Array
    ) -> Estimate:
        distance = compute_square_distances(features, self.features)
        count = min(self.hyper.neighbours, len(self.features))
        near = np.argpartition(distance, count - 1, axis=1)[:, :count]
        return solve_locally(
            np.take_along_axis(distance, near, axis=1),
            self.features[near],
            self.pose[near],
            self.hyper,
            penalty=penalty,
            offset=offset,
        )


def solve_locally(
    distance: Array,
    features: NDArray[np.float32],
    pose: Array,
    hyper: Hyper,
    *,
    penalty: LengthPenalty | None,
    offset: Array,
) -> Estimate:
    """Solve the twin of every frame with its own nearest training frames (TGPKNN).

    Parameters
    ----------
    distance
        Shape (M, K), squared distances of the features to those of the neighbours.
    features, pose
        Shapes (M, K, k) and (M, K, D), those of the neighbours.
    hyper, penalty, offset
        As `TrainingSet.predict`.
    """
    inverse_r = _invert_small(compute_kernel(_square_inside(features), 1.0), hyper.lambda_r)
    kernel = compute_kernel(distance, 1.0)
    u = np.matmul(kernel[:, None], inverse_r)[:, 0]
    eta = np.maximum(1.0 + hyper.lambda_r - np.einsum("mk,mk->m", kernel, u), 1e-12)
    inverse_x = _invert_small(compute_kernel(_square_inside(pose), hyper.gamma_x), hyper.lambda_x)
    twin = LocalTwin(pose, inverse_x, hyper.gamma_x, hyper.lambda_x, u, eta)
    middle = pose.mean(axis=1)
    start = middle + np.einsum("mk,mkd->md", u, pose - middle[:, None])
    solved, iterations = solve_twin(twin, start, eta, penalty, offset)
    return Estimate(solved, eta, iterations)


def solve_twin(
    twin: Objective, start: Array, eta: Array, penalty: LengthPenalty | None, offset: Array
) -> tuple[Array, NDArray[np.intp]]:
    """Return the poses that minimise a twin's cost, with or without penalty, and iterations."""
    if penalty is None:
        solution = minimise(twin, start)
    else:
        solution = solve_with_lengths(twin, start, eta=eta, penalty=penalty, offset=offset)
    return solution.pose, solution.iterations


def weigh_neighbours(distance: Array, count: int) -> Array:
    """Return weights (M, N) of the `count` nearest frames, inverse to their distance."""
    count = min(count, distance.shape[1])
    near = np.argpartition(distance, count - 1, axis=1)[:, :count]
    inverse = 1.0 / np.sqrt(np.maximum(np.take_along_axis(distance, near, axis=1), 1e-12))
    weight = np.zeros(distance.shape)
    np.put_along_axis(weight, near, inverse / inverse.sum(axis=1, keepdims=True), axis=1)
    return weight


def invert_kernel(kernel: Array, noise: float) -> Array:
    """Return ``(kernel + noise I)^-1`` of a symmetric positive kernel, shape (N, N)."""
    padded = np.array(kernel, dtype=np.float64)
    padded[np.diag_indices_from(padded)] += noise
    factor, _ = scipy.linalg.cho_factor(padded, lower=True, overwrite_a=True, check_finite=False)
    inverse, info = scipy.linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)
    if info:  # pragma: no cover - a factor that exists has an inverse
        raise np.linalg.LinAlgError(f"dpotri returned {info}.")
    return np.asarray(inverse + np.tril(inverse, -1).T - np.triu(inverse, 1))


def _square_inside(points: NDArray[np.float32] | Array) -> Array:
    """Return squared distances (M, K, K) inside each of M groups (M, K, d)."""
    centred = points.astype(np.float64) - points.mean(axis=1, keepdims=True)
    square = np.einsum("mkd,mkd->mk", centred, centred)
    product = np.matmul(centred, centred.transpose(0, 2, 1))
    return np.asarray(np.maximum(square[:, :, None] + square[:, None] - 2.0 * product, 0.0))


def _invert_small(kernel: Array, noise: float) -> Array:
    return np.asarray(np.linalg.inv(kernel + noise * np.eye(kernel.shape[1])))
