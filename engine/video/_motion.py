"""How joints move in the picture, on an even clock, and how well two such movements agree.

A joint's speed in the picture of one camera is tied to that in the picture of another: with
cameras far enough away, one direction in each picture shows the same component of the movement
in space (the direction across the epipolar lines; for two cameras held level it is nearly the
vertical). So the vertical speeds find the lag, and the pair of directions that agree best then
measures it within a fraction of a picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.sparse import csr_array

from engine.datatypes import Array, PoseTrack, ViewPose
from engine.skeletons import get_skeleton

__all__ = [
    "Comparison",
    "Motion",
    "compare",
    "compute_motion",
    "find_lags",
    "fit_lines",
    "measure_height",
    "sample",
]

Spectrum = NDArray[np.complex128]

GRID_HZ: Final = 60.0
SMOOTHING_S: Final = 0.06
"""Standard deviation of the bell over which a speed is measured: the same time in both videos."""
JOINTS: Final = tuple(
    f"{side}_{part}"
    for part in ("ear", "shoulder", "elbow", "wrist", "index", "hip", "knee", "ankle")
    for side in ("left", "right")
)
KEYPOINTS: Final = ("nose", *JOINTS)
MAX_SPEED: Final = 15.0
"""Body heights per second; no limb of a lifting person is faster: such a keypoint jumped."""
MOVING_SPEED: Final = 0.10
"""Body heights per second; the shaking of keypoints of a standing person stays below a third."""
WINDOW_S: Final = 0.3
"""Over windows of this length the lag is measured anew. Short ones show best that the phases of
another lift, however alike, come at other times."""
MIN_OVERLAP_S: Final = 1.0
PEAK_DISTANCE_S: Final = 0.4
N_PEAKS: Final = 6
MIN_SHARE: Final = 0.2
"""Of the movement explained at the best lag; a lag that explains less is no rival."""
MAX_SHIFT_S: Final = 0.15
"""Newton's steps that lead farther from a peak have lost it."""
MAX_DRIFT: Final = 2e-3
STEPS: Final = 4


@dataclass(frozen=True, eq=False)
class Motion:
    """Speeds of joints in the picture.

    `velocity` (T, J, 2) in body heights per second, `weight` (T, J) from 0 (unknown) to 1, at
    ``start_s + i / GRID_HZ``.
    """

    start_s: float
    velocity: Array
    weight: Array

    @property
    def time_s(self) -> Array:
        """Times of the samples, shape (T,)."""
        return self.start_s + np.arange(len(self.weight)) / GRID_HZ

    @property
    def is_moving(self) -> Array:
        """Shape (T,), whether the person moves."""
        square = np.sum(self.velocity**2, axis=2)
        known = np.maximum(self.weight.sum(axis=1), 1e-9)
        speed = np.sqrt(np.sum(self.weight * square, axis=1) / known)
        return np.asarray((speed > MOVING_SPEED) & (self.weight.sum(axis=1) > 1.0))

    @property
    def moving_s(self) -> float:
        """For how long the person moves."""
        return float(np.count_nonzero(self.is_moving)) / GRID_HZ


def compute_motion(pose: ViewPose, keypoints: tuple[str, ...]) -> Motion:
    """Measure the speeds of joints in one view.

    At each moment a straight line is fitted to the positions around it, weighted by the square of
    their confidence, so that uneven times, other frame rates and gaps need no special treatment.

    Parameters
    ----------
    pose
        What the estimator saw.
    keypoints
        Names of J joints of its skeleton.

    Returns
    -------
    Motion
        Turned by quarter turns so that the person stands upright in the picture.
    """
    track = pose.image
    skeleton = get_skeleton(track.skeleton)
    columns = [skeleton.index(name) for name in keypoints]
    confidence = np.where(np.isnan(track.confidence), 1.0, np.clip(track.confidence, 0.0, 1.0))
    weight = np.where(track.is_present, confidence**2, 0.0)[:, columns]
    position = np.nan_to_num(track.position[:, columns]) / measure_height(pose)
    grid = np.arange(track.time_s[0], track.time_s[-1] + 1e-9, 1.0 / GRID_HZ)
    _, velocity, weight = fit_lines(track.time_s, position, weight, grid)
    is_possible = np.max(np.abs(velocity), axis=2) < MAX_SPEED
    velocity = np.where(is_possible[..., None], velocity, 0.0)
    weight = np.where(is_possible, weight, 0.0)
    return Motion(float(grid[0]), velocity @ _upright(track).T, weight)


def measure_height(pose: ViewPose) -> float:
    """Return the person's height in the picture, px: that of the taller boxes."""
    heights = pose.box[:, 3] - pose.box[:, 1]
    known = heights[np.isfinite(heights)]
    if known.size:
        return float(max(np.percentile(known, 95.0), 1.0))
    rows = pose.image.position[..., 1]
    spans = [np.ptp(row[np.isfinite(row)]) for row in rows if np.isfinite(row).any()]
    return float(max(np.percentile(spans, 95.0), 1.0)) if spans else 1.0


def _upright(track: PoseTrack) -> Array:
    """Return the rotation by quarter turns that puts the shoulders above the feet."""
    skeleton = get_skeleton(track.skeleton)
    down = skeleton.point(track.position, "mid_ankle") - skeleton.point(track.position, "thorax")
    known = down[np.isfinite(down).all(axis=1)]
    x, y = np.median(known, axis=0) if len(known) else (0.0, 1.0)
    turns = round(math.atan2(x, y) / (math.pi / 2))
    return np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), turns % 4)


def fit_lines(
    time_s: Array, position: Array, weight: Array, grid: Array
) -> tuple[Array, Array, Array]:
    """Fit a line around each moment of an even clock.

    Parameters
    ----------
    time_s, position, weight
        Shape (T,), (T, J, D) without NaN, and (T, J), zero where a position is unknown.
    grid
        Shape (G,), the moments.

    Returns
    -------
    value, slope
        Shape (G, J, D); zero where unknown.
    weight
        Shape (G, J), 0 to 1: less at gaps and ends.
    """
    kernel, lever, lever2 = _bell(time_s, grid)
    moment0, moment1, moment2 = (np.asarray(m @ weight) for m in (kernel, lever, lever2))
    flat = (weight[..., None] * position).reshape(len(time_s), -1)
    shape = (len(grid), *position.shape[1:])
    sum0, sum1 = (kernel @ flat).reshape(shape), (lever @ flat).reshape(shape)
    spread = moment0 * moment2 - moment1**2
    is_known = spread > 1e-3 * moment0 * moment2 + 1e-15
    safe = np.where(is_known, spread, 1.0)[..., None]
    value = (moment2[..., None] * sum0 - moment1[..., None] * sum1) / safe
    slope = (moment0[..., None] * sum1 - moment1[..., None] * sum0) / safe
    # A line through samples of one side only tells less, as does one through few samples.
    step_s = float(np.median(np.diff(time_s)))
    share = moment0 * step_s / (SMOOTHING_S * math.sqrt(2.0 * math.pi))
    balance = spread / np.maximum(moment0 * moment2, 1e-15)
    return (
        np.where(is_known[..., None], value, 0.0),
        np.where(is_known[..., None], slope, 0.0),
        np.where(is_known, np.minimum(share, 1.0) * balance, 0.0),
    )


def _bell(time_s: Array, grid: Array) -> tuple[csr_array, csr_array, csr_array]:
    """Return the bell's weights (G, T), and the same times the distance and its square."""
    reach = 3.0 * SMOOTHING_S
    first = np.searchsorted(time_s, grid - reach)
    count = np.searchsorted(time_s, grid + reach) - first
    starts = np.concatenate([[0], np.cumsum(count)])
    column = np.arange(starts[-1]) - np.repeat(starts[:-1] - first, count)
    distance = time_s[column] - np.repeat(grid, count)
    bell = np.exp(-0.5 * (distance / SMOOTHING_S) ** 2)
    shape = (len(grid), len(time_s))

    def matrix(values: Array) -> csr_array:
        return csr_array((values, column, starts), shape=shape)

    return matrix(bell), matrix(bell * distance), matrix(bell * distance**2)


def find_lags(first: Motion, second: Motion) -> list[float]:
    """Find the lags at which the vertical speeds agree, best first.

    The correlation at every lag is normalised by the overlapping parts only, and ranked by how
    much movement it explains: a short overlap can agree by chance.

    Returns
    -------
    list of float
        Seconds to add to times of the second, at most `N_PEAKS`; empty where the movements share
        less than `MIN_OVERLAP_S`.
    """
    least = math.ceil(MIN_OVERLAP_S * GRID_HZ)
    n_first, n_second = len(first.weight), len(second.weight)
    lags = np.arange(least - n_second, n_first - least + 1)
    if not lags.size:
        return []
    product, energy = _correlate(first, second, lags)
    correlation = np.clip(product / np.maximum(energy, 1e-12), 0.0, 0.9999)
    explained = -energy * np.log1p(-(correlation**2))
    distance = round(PEAK_DISTANCE_S * GRID_HZ)
    least_explained = MIN_SHARE * float(explained.max())
    peaks: list[float] = []
    while len(peaks) < N_PEAKS and explained.max() > max(least_explained, 0.0):
        best = int(np.argmax(explained))
        peaks.append(float(lags[best]) / GRID_HZ + first.start_s - second.start_s)
        explained[max(0, best - distance) : best + distance + 1] = 0.0
    return peaks


def _correlate(first: Motion, second: Motion, lags: NDArray[np.int_]) -> tuple[Array, Array]:
    """Return the products and the geometric mean of both energies in the overlap, per lag."""
    length = next_fast_len(len(first.weight) + len(second.weight), real=True)

    def transform(motion: Motion) -> list[Spectrum]:
        vertical = motion.velocity[..., 1]
        parts = (motion.weight * vertical, motion.weight * vertical**2, motion.weight)
        return [rfft(part, length, axis=0) for part in parts]

    def sum_over_joints(a: Spectrum, b: Spectrum) -> Array:
        return np.asarray(irfft(np.sum(a * np.conj(b), axis=1), length)[lags])

    speed_a, square_a, known_a = transform(first)
    speed_b, square_b, known_b = transform(second)
    energy_a = np.maximum(sum_over_joints(square_a, known_b), 0.0)
    energy_b = np.maximum(sum_over_joints(known_a, square_b), 0.0)
    return sum_over_joints(speed_a, speed_b), np.sqrt(energy_a * energy_b)


@dataclass(frozen=True)
class Comparison:
    """How well two movements agree once the second is shifted.

    `offset_s` and `drift` are the refined clock. `correlation` is that of the pair of directions
    that agree best. `timing_rms_s` tells how much the lag differs between parts of the movement,
    `joint_rms_s` how much between joints. `n_parts` is the effective number of parts with
    movement, `overlap_s` and `moving_s` how long both see the person, and moving. `drift_sigma` is
    the standard error of the drift, NaN where it was not fitted.
    """

    offset_s: float
    drift: float
    correlation: float
    timing_rms_s: float
    joint_rms_s: float
    n_parts: float
    n_joints: float
    overlap_s: float
    moving_s: float
    drift_sigma: float = math.nan


def compare(
    first: Motion, second: Motion, offset_s: float, *, with_drift: bool = False, steps: int = STEPS
) -> Comparison | None:
    """Shift the second movement until it agrees best with the first, and say how well it does.

    Newton's steps on the squared difference of the speeds along the best pair of directions.

    Parameters
    ----------
    first, second
        Speeds of the same joints.
    offset_s
        Where to start, within about 0.1 s.
    with_drift
        Whether the clocks may run at different rates.
    steps
        How many steps; 0 judges the given offset as it is.

    Returns
    -------
    Comparison or None
        None where the movements do not overlap by `MIN_OVERLAP_S`, nothing moves, or there is
        no best lag near the given one.
    """
    drift, start_s = 0.0, offset_s
    for _ in range(steps):
        lags = _measure_lags(first, second, offset_s, drift)
        if lags is None:
            return None
        shift, slope, _ = lags.fit(with_drift)
        drift = float(np.clip(drift + slope, -MAX_DRIFT, MAX_DRIFT))
        # The line is fitted around the middle of the movement, the clock starts at zero.
        offset_s += shift - slope * lags.centre_s
        if abs(offset_s + drift * lags.centre_s - start_s) > MAX_SHIFT_S:
            return None
    lags = _measure_lags(first, second, offset_s, drift)
    return None if lags is None else lags.describe(offset_s, drift, with_drift)


@dataclass(frozen=True, eq=False)
class _Lags:
    """Remaining lags of P parts of the movement and J joints.

    `lag_s` and `weight` (P, J); `time_s` (P,) the middle of each part, in the first's time.
    """

    lag_s: Array
    weight: Array
    time_s: Array
    correlation: float
    overlap_s: float
    moving_s: float

    @property
    def centre_s(self) -> float:
        return float(np.average(self.time_s, weights=self.weight.sum(axis=1)))

    @property
    def of_parts(self) -> tuple[Array, Array]:
        """Lag of each part, and its weight."""
        weight = self.weight.sum(axis=1)
        return np.sum(self.weight * self.lag_s, axis=1) / np.maximum(weight, 1e-12), weight

    def fit(self, with_drift: bool) -> tuple[float, float, float]:
        """Return the mean lag, its slope over time and the slope's standard error."""
        lag, weight = self.of_parts
        mean = float(np.average(lag, weights=weight))
        if not with_drift:
            return mean, 0.0, math.nan
        time = self.time_s - self.centre_s
        lever = float(np.sum(weight * time**2))
        slope = float(np.sum(weight * time * lag)) / max(lever, 1e-12)
        left = lag - mean - slope * time
        # Parts differ in how well they tell the lag, so the error is that of their own scatter.
        error = math.sqrt(float(np.sum((weight * time * left) ** 2))) / max(lever, 1e-12)
        return mean, slope, error

    def describe(self, offset_s: float, drift: float, with_drift: bool) -> Comparison:
        lag, weight = self.of_parts
        joint_weight = self.weight.sum(axis=0)
        joint = np.sum(self.weight * self.lag_s, axis=0) / np.maximum(joint_weight, 1e-12)
        return Comparison(
            offset_s=offset_s,
            drift=drift,
            correlation=self.correlation,
            timing_rms_s=_scatter(lag, weight),
            joint_rms_s=_scatter(joint, joint_weight),
            n_parts=_effective(weight),
            n_joints=_effective(joint_weight),
            overlap_s=self.overlap_s,
            moving_s=self.moving_s,
            drift_sigma=self.fit(with_drift)[2],
        )


def _scatter(values: Array, weight: Array) -> float:
    mean = np.average(values, weights=weight)
    return float(np.sqrt(np.average((values - mean) ** 2, weights=weight)))


def _effective(weight: Array) -> float:
    """Return how many equal weights would count as much."""
    return float(np.sum(weight) ** 2 / np.sum(weight**2))


def _measure_lags(first: Motion, second: Motion, offset_s: float, drift: float) -> _Lags | None:
    """Measure by how much each part and joint of the first is later than the shifted second."""
    time_s = first.time_s
    at = ((time_s - offset_s) / (1.0 + drift) - second.start_s) * GRID_HZ
    inside = (at >= 0.0) & (at <= len(second.weight) - 1)
    if np.count_nonzero(inside) < MIN_OVERLAP_S * GRID_HZ:
        return None
    at, time_s = at[inside], time_s[inside]
    velocity_b, weight_b = sample(second.velocity, at), sample(second.weight, at)
    velocity_a = first.velocity[inside]
    weight = np.minimum(first.weight[inside], weight_b)
    directions = _agreeing_directions(velocity_a, velocity_b, weight)
    if directions is None:
        return None
    along_a, along_b, correlation = directions
    slope = 0.5 * GRID_HZ * (np.gradient(along_a, axis=0) + np.gradient(along_b, axis=0))
    moments = (-weight * slope * (along_a - along_b), weight * slope**2, time_s[:, None])
    n_parts = max(2, int(len(time_s) / (WINDOW_S * GRID_HZ)))
    edges = np.linspace(0, len(time_s), n_parts + 1).astype(int)
    miss, strength, times = (np.add.reduceat(m, edges[:-1], axis=0) for m in moments)
    if not strength.sum() > 0.0:
        return None
    moving = Motion(0.0, velocity_a, weight).moving_s, Motion(0.0, velocity_b, weight).moving_s
    return _Lags(
        lag_s=miss / np.maximum(strength, 1e-12),
        weight=strength,
        time_s=times[:, 0] / np.diff(edges),
        correlation=correlation,
        overlap_s=len(time_s) / GRID_HZ,
        moving_s=min(moving),
    )


def sample(values: Array, at: Array) -> Array:
    """Interpolate along the first axis at fractional indices."""
    low = np.minimum(at.astype(int), len(values) - 2)
    share = (at - low).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1.0 - share) * values[low] + share * values[low + 1])


def _agreeing_directions(
    velocity_a: Array, velocity_b: Array, weight: Array
) -> tuple[Array, Array, float] | None:
    """Return the speeds (T, J) along the pair of directions that agree best, and how well.

    The first canonical correlation of both pictures, over all joints together; each joint
    then gets a scale of its own, because the cameras see it from different distances.
    """
    rows = np.sqrt(weight)[..., None] * np.concatenate([velocity_a, velocity_b], axis=2)
    flat = rows.reshape(-1, 4)
    cross = flat.T @ flat
    if min(np.trace(cross[:2, :2]), np.trace(cross[2:, 2:])) <= 1e-9:
        return None
    cross += 1e-9 * np.trace(cross) * np.eye(4)
    white_a = np.linalg.inv(np.linalg.cholesky(cross[:2, :2]))
    white_b = np.linalg.inv(np.linalg.cholesky(cross[2:, 2:]))
    left, values, right = np.linalg.svd(white_a @ cross[:2, 2:] @ white_b.T)
    along_a, along_b = velocity_a @ (white_a.T @ left[:, 0]), velocity_b @ (white_b.T @ right[0])
    energy_a, energy_b = (np.sum(weight * along**2, axis=0) for along in (along_a, along_b))
    # A joint that hardly moves must not be blown up: its scale leans on that of all joints.
    floor_a, floor_b = 0.05 * energy_a.mean(), 0.05 * energy_b.mean()
    scale = np.sqrt((energy_a + floor_a) / (energy_b + floor_b))
    size = math.sqrt(float(energy_a.sum() / max(weight.sum(), 1e-12)))
    return along_a / size, along_b * scale / size, float(values[0])
