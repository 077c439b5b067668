"""Kalman filter and Rauch-Tung-Striebel smoother for all keypoints at once.

Every keypoint moves with constant acceleration but for white jerk. How far a measurement is
trusted follows from the keypoint's own noise, so steady keypoints are hardly smoothed and
jittery ones much; gaps are bridged by the motion on both sides.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from engine.correction.robust import known_median
from engine.datatypes import Array

__all__ = ["KalmanSmoother", "SmoothedPath", "estimate_noise"]

LEAST_NOISE_M = 0.001
"""No camera resolves less; keeps the filter stable on exact data."""
START_SPEED_M_S, START_ACCELERATION_M_S2 = 3.0, 30.0
"""SD of what is not known about a keypoint's motion when it is first seen."""
ORDER = 5
"""Of the differences that show the noise: movements of 4 Hz filmed at 30 frames/s hardly do."""
FRAMES_AT_ONCE = 2000
"""Gains are made ready for so many frames together: fast, within bounded memory."""


@dataclass(frozen=True, eq=False)
class SmoothedPath:
    """Smoothed keypoints.

    Parameters
    ----------
    position
        Shape (T, K, D), m; NaN for keypoints never seen. Gaps and ends are bridged: which of
        those samples may be used is the caller's decision.
    sigma
        Shape (T, K): standard error per coordinate, m, by the model.
    is_gated
        Shape (T, K): measured, but so far from where the motion was heading that it was left out.
    """

    position: Array
    sigma: Array
    is_gated: NDArray[np.bool_]


@dataclass(frozen=True)
class KalmanSmoother:
    """Constant-acceleration model per keypoint, filtered forward and smoothed backward.

    Parameters
    ----------
    jerk
        Spectral density of the jerk's square root, m/s^2.5: how lively people move.
    gate_probability
        Measurements are left out that are further off than this share of all should be (0.999:
        one in a thousand); 1 leaves none out, the default: once exchanged sides and misplaced
        joints are gone, a gate rejects more sudden movements than faults.
    gate_floor_m
        No measurement nearer than this to its prediction is left out.

    References
    ----------
    .. [1] Rauch, Tung & Striebel (1965), AIAA J. 3: 1445-1450.
    .. [2] Bar-Shalom, Li & Kirubarajan (2001), Estimation with Applications to Tracking and
       Navigation, ch. 6.
    """

    jerk: float = 15.0
    gate_probability: float = 1.0
    gate_floor_m: float = 0.10

    @property
    def settings(self) -> dict[str, float]:
        """Return the parameters by name."""
        return dataclasses.asdict(self)

    def smooth(self, time_s: Array, position: Array, confidence: Array) -> SmoothedPath:
        """Smooth all keypoints.

        Parameters
        ----------
        time_s
            Shape (T,), s, increasing, not necessarily even.
        position
            Shape (T, K, D), m; NaN in gaps.
        confidence
            Shape (T, K), 0 to 1: noise counts as inverse to it. NaN counts as 1.

        Returns
        -------
        SmoothedPath
            Same shapes.
        """
        present = np.isfinite(position).all(axis=2)
        seen = present.any(axis=0)
        if not seen.any():
            nothing = np.full(present.shape, np.nan)
            return SmoothedPath(position.copy(), nothing, np.zeros_like(present))
        trust = np.clip(np.nan_to_num(confidence, nan=1.0), 0.1, 1.0)
        noise = estimate_noise(position) ** 2 / trust**2
        columns = np.flatnonzero(seen)
        path = _Pass(time_s, position[:, columns], noise[:, columns], self.jerk**2)
        gate = float(chi2.ppf(self.gate_probability, position.shape[2]))
        path.filter(gate, self.gate_floor_m)
        smoothed, variance = path.smooth()
        # The past alone can't tell a fault from a sudden movement; with the future it can.
        is_right = path.is_gated & ~path.is_far(smoothed, variance, gate, self.gate_floor_m)
        if is_right.any():
            path.filter(gate, self.gate_floor_m, is_trusted=is_right)
            smoothed, variance = path.smooth()
        result = np.full(position.shape, np.nan)
        sigma = np.full(present.shape, np.nan)
        gated = np.zeros(present.shape, dtype=bool)
        result[:, columns], sigma[:, columns] = smoothed, np.sqrt(np.maximum(variance, 0.0))
        gated[:, columns] = path.is_gated
        return SmoothedPath(result, sigma, gated)


def estimate_noise(position: Array) -> Array:
    """Estimate the SD of each keypoint's noise from its fifth differences.

    They hold little of the motion, and the median ignores jumps. Noise that goes on from frame
    to frame (a slow wander) is not seen.

    Parameters
    ----------
    position
        Shape (T, K, D), m; NaN in gaps.

    Returns
    -------
    Array
        Shape (1, K), m, per coordinate, at least `LEAST_NOISE_M`.
    """
    noise = np.full((1, position.shape[1]), LEAST_NOISE_M)
    if len(position) <= ORDER:
        return noise
    # Binomial coefficients, squared and added; 0.6745 is the upper quartile of the normal.
    gain = np.sqrt(comb(2 * ORDER, ORDER))
    difference = np.abs(np.diff(position, n=ORDER, axis=0)) / (0.6745 * gain)
    # The axes of a keypoint share one noise.
    pooled = known_median(difference.transpose(0, 2, 1).reshape(-1, position.shape[1]))
    return np.asarray(np.fmax(noise, pooled[None, :]))


def _transition(step_s: Array) -> Array:
    """Return the transition matrices of constant acceleration; shape (T, 3, 3)."""
    matrix = np.tile(np.eye(3), (len(step_s), 1, 1))
    matrix[:, 0, 1] = matrix[:, 1, 2] = step_s
    matrix[:, 0, 2] = step_s**2 / 2.0
    return matrix


def _drive(step_s: Array, density: float) -> Array:
    """Return the covariance that white jerk adds over each step; shape (T, 9)."""
    h = step_s
    a, b, c = h**5 / 20.0, h**4 / 8.0, h**3 / 6.0
    rows = [a, b, c, b, h**3 / 3.0, h**2 / 2.0, c, h**2 / 2.0, h]
    return density * np.stack(rows, axis=1)


class _Pass:
    """One forward and backward pass; covariances (K, 3, 3) are kept as rows of nine."""

    def __init__(self, time_s: Array, position: Array, noise: Array, density: float) -> None:
        self.shape = position.shape
        n_frames, n_points, n_axes = position.shape
        self.measured = position
        self.noise = np.broadcast_to(noise, (n_frames, n_points))
        step = np.diff(time_s, prepend=time_s[0])
        self.move = _transition(step)
        # P -> F P F' in one product for rows of nine.
        self.move_twice = np.einsum("tij,tkl->tikjl", self.move, self.move).reshape(-1, 9, 9)
        self.drive = _drive(step, density)
        self.state = np.zeros((n_frames, 3, n_points, n_axes))
        self.covariance = np.zeros((n_frames, n_points, 9))
        self.is_gated = np.zeros((n_frames, n_points), dtype=bool)

    def is_far(
        self, position: Array, variance: Array, gate: float, floor_m: float
    ) -> NDArray[np.bool_]:
        """Return whether each measurement is too far from where it should be; shape (T, K)."""
        square = np.nan_to_num(((self.measured - position) ** 2).sum(axis=2))
        return np.asarray((square > gate * (variance + self.noise)) & (square > floor_m**2))

    def filter(
        self, gate: float, floor_m: float, is_trusted: NDArray[np.bool_] | None = None
    ) -> None:
        """Run forward; `gate` is the squared distance in standard errors that is allowed."""
        n_frames, n_points, n_axes = self.shape
        present = np.asarray(np.isfinite(self.measured).all(axis=2))
        first = present.argmax(axis=0)
        x = np.zeros((3, n_points, n_axes))
        x[0] = self.measured[first, np.arange(n_points)]
        start = (1.0, 0, 0, 0, START_SPEED_M_S**2, 0, 0, 0, START_ACCELERATION_M_S2**2)
        p = np.tile(np.array(start), (n_points, 1))
        values = np.where(present[:, :, None], self.measured, 0.0)
        is_gate = present if is_trusted is None else present & ~is_trusted
        for t in range(n_frames):
            if t:
                x = (self.move[t] @ x.reshape(3, -1)).reshape(3, n_points, n_axes)
                p = p @ self.move_twice[t].T + self.drive[t]
            innovation = values[t] - x[0]
            spread = p[:, 0] + self.noise[t]
            square = (innovation**2).sum(axis=1)
            is_far = (square > gate * spread) & (square > floor_m**2) & is_gate[t]
            self.is_gated[t] = is_far
            gain = p[:, ::3] / spread[:, None] * (present[t] & ~is_far)[:, None]
            x = x + gain.T[:, :, None] * innovation
            p = p - (gain[:, :, None] * p[:, None, :3]).reshape(n_points, 9)
            self.state[t], self.covariance[t] = x, p

    def smooth(self) -> tuple[Array, Array]:
        """Run backward; return position (T, K, D) and its variance (T, K)."""
        n_frames, n_points, _ = self.shape
        position = np.empty(self.shape)
        variance = np.empty((n_frames, n_points))
        x = self.state[-1].transpose(1, 0, 2)
        p = self.covariance[-1].reshape(n_points, 3, 3)
        position[-1], variance[-1] = x[:, 0], p[:, 0, 0]
        for stop in range(n_frames - 1, 0, -FRAMES_AT_ONCE):
            start = max(0, stop - FRAMES_AT_ONCE)
            gain, ahead, p_ahead, here = self._prepare(start, stop)
            turned = gain.transpose(0, 1, 3, 2)
            for i in range(stop - start - 1, -1, -1):
                t = start + i
                x = here[i] + gain[i] @ (x - ahead[i])
                before = self.covariance[t].reshape(n_points, 3, 3)
                p = before + gain[i] @ (p - p_ahead[i]) @ turned[i]
                position[t], variance[t] = x[:, 0], p[:, 0, 0]
        return position, variance

    def _prepare(self, start: int, stop: int) -> tuple[Array, Array, Array, Array]:
        """Return gains, predicted states and covariances, and states of frames start to stop."""
        n_points = self.shape[1]
        part, following = slice(start, stop), slice(start + 1, stop + 1)
        here = self.state[part].transpose(0, 2, 1, 3)
        covariance = self.covariance[part]
        predicted = covariance @ self.move_twice[following].transpose(0, 2, 1)
        predicted = (predicted + self.drive[following][:, None]).reshape(-1, n_points, 3, 3)
        move = self.move[following][:, None]
        crossed = move @ covariance.reshape(-1, n_points, 3, 3)
        gain = np.linalg.solve(predicted, crossed).transpose(0, 1, 3, 2)
        return gain, move @ here, predicted, here
