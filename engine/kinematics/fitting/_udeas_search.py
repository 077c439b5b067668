"""uDEAS over a whole clip: everywhere first, then in shrinking windows around what was found.

A search over the full ranges ends in one of many local minima. Neighbouring frames rarely end in
the same ones, and they show almost the same posture: so every frame is searched again around its
own best point and around those of its neighbours, in windows that shrink from pass to pass. The
better point spreads through the clip, frame by frame. All frames move in lock-step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.kinematics.fitting._dynamic_encoding import Codes, draw_codes, search
from engine.kinematics.fitting._humanoid_cost import HumanoidCost
from engine.kinematics.humanoid import (
    VARIABLES,
    SegmentLengths,
    compute_jacobian,
    compute_joints,
    fit_residual,
)

__all__ = ["LOWER", "UPPER", "ClipSearch", "SearchPlan", "descend", "polish_clip", "search_clip"]

LOWER, UPPER = np.array([variable.bounds for variable in VARIABLES]).T
"""Ranges of the variables: a ratio, then radians."""
_SIZE = [v.group for v in VARIABLES].index("size")
_HEADING = [v.name for v in VARIABLES].index("psi_bd")

SEARCHES_AT_ONCE = 6000
"""More searches in lock-step share the cost of a call; beyond, their numbers leave the cache."""
SIZE_PER_RADIAN = 0.3
"""Width of the window of the size factor, relative to that of the angles."""


@dataclass(frozen=True)
class SearchPlan:
    """How hard to search.

    Parameters
    ----------
    restarts
        Searches over the full ranges, each frame.
    n_passes
        Passes in windows; their half-widths fall from `widest_deg` to `narrowest_deg` in equal
        ratios.
    searches_per_centre
        Searches in each window.
    full_bits, window_bits
        First and last length of the rows.
    huber_m
        Distances below it count by their square while the windows are wider than `plain_deg`:
        the kinks of the plain mean distance stop a search that moves one variable at a time.
    by_sensitivity
        Visit the variables in the order of Eq 6.
    polish_steps
        Least-squares steps that follow the searches; none in uDEAS proper.
    seed
        Of all random bit matrices.
    """

    restarts: int = 12
    n_passes: int = 16
    widest_deg: float = 40.0
    narrowest_deg: float = 0.7
    searches_per_centre: int = 2
    full_bits: tuple[int, int] = (3, 7)
    window_bits: tuple[int, int] = (2, 6)
    huber_m: float = 0.02
    plain_deg: float = 2.0
    by_sensitivity: bool = False
    polish_steps: int = 0
    seed: int = 0

    @property
    def half_widths(self) -> Array:
        """Half-width of the window in every pass, radians."""
        return np.asarray(
            np.radians(np.geomspace(self.widest_deg, self.narrowest_deg, self.n_passes))
        )


@dataclass(frozen=True, eq=False)
class ClipSearch:
    """What was found: `values` (T, 21), the cost of Eq 8 `residual_m` (T,), and the effort."""

    values: Array
    residual_m: Array
    n_evaluations: int


def search_clip(
    targets: Array,
    lengths: SegmentLengths,
    plan: SearchPlan,
    *,
    weights: Array | None = None,
) -> ClipSearch:
    """Fit the figure to every frame of a clip.

    Parameters
    ----------
    targets
        Shape (T, 12, 3): the joints around the mid-hip, in the figure's axes, m; NaN where
        missing, at least one in every frame.
    lengths
        Segment lengths, m.
    plan
        How hard to search.
    weights
        Shape (T, 12), not negative; all alike if None.

    Returns
    -------
    ClipSearch
        One set of values a frame; the same for the same plan.
    """
    clip = _Clip(targets, lengths, plan, weights)
    values = clip.search_everywhere()
    before = values
    for half_width in plan.half_widths:
        # A step as long as the last one follows a valley that no single variable runs along.
        ahead = 2 * values - before
        before, values = values, clip.search_around(values, ahead, half_width)
    if plan.polish_steps:
        values = polish_clip(values, targets, lengths, weights=weights, steps=plan.polish_steps)
    residual = np.asarray(fit_residual(values, lengths, targets, weights), dtype=np.float64)
    return ClipSearch(values, residual, clip.n_evaluations)


class _Clip:
    """The frames that are searched, and the random numbers."""

    def __init__(
        self, targets: Array, lengths: SegmentLengths, plan: SearchPlan, weights: Array | None
    ) -> None:
        self._targets, self._lengths, self._plan, self._weights = targets, lengths, plan, weights
        self._rng = np.random.default_rng(plan.seed)
        self.n_evaluations = 0

    def search_everywhere(self) -> Array:
        """Search the full ranges from random starts; return the best of each frame (T, 21)."""
        plan, n_frames = self._plan, len(self._targets)
        frames = np.repeat(np.arange(n_frames), plan.restarts)
        codes = draw_codes(self._rng, frames.size, len(VARIABLES), bits=plan.full_bits[0])
        shape = (frames.size, len(VARIABLES))
        bounds = np.broadcast_to(LOWER, shape), np.broadcast_to(UPPER, shape)
        values, _ = self._search(frames, bounds, codes, plan.full_bits, plan.huber_m)
        return values

    def search_around(self, values: Array, ahead: Array, half_width: float) -> Array:
        """Search in windows around each frame's point, its neighbours' and the one ahead.

        Parameters
        ----------
        values, ahead
            Shape (T, 21).
        half_width
            Of the windows, radians.

        Returns
        -------
        Array
            Shape (T, 21): the better of what was found and `values`.
        """
        plan, n_frames = self._plan, len(values)
        earlier, later = np.roll(values, 1, axis=0), np.roll(values, -1, axis=0)
        earlier[0], later[-1] = values[0], values[-1]
        centres = np.stack([values, earlier, later, ahead], axis=1)
        centres = np.repeat(centres, plan.searches_per_centre, axis=1)
        frames = np.repeat(np.arange(n_frames), centres.shape[1])
        bounds = _window(centres.reshape(frames.size, -1), half_width)
        codes = draw_codes(self._rng, frames.size, len(VARIABLES), bits=plan.window_bits[0])
        huber_m = plan.huber_m if half_width > np.radians(plan.plain_deg) else 0.0
        found, cost = self._search(frames, bounds, codes, plan.window_bits, huber_m)
        improves = cost < self._cost(values, huber_m)
        return np.where(improves[:, None], found, values)

    def _search(
        self,
        frames: NDArray[np.intp],
        bounds: tuple[Array, Array],
        codes: Codes,
        bits: tuple[int, int],
        huber_m: float,
    ) -> tuple[Array, Array]:
        """Run the searches in portions; return the best point and cost of each frame."""
        values, cost = np.empty(codes.shape), np.empty(frames.size)
        for start in range(0, frames.size, SEARCHES_AT_ONCE):
            part = slice(start, start + SEARCHES_AT_ONCE)
            found = search(
                HumanoidCost(
                    self._targets,
                    self._lengths,
                    frames[part],
                    weights=self._weights,
                    huber_m=huber_m,
                ),
                bounds[0][part],
                bounds[1][part],
                codes[part],
                first_bits=bits[0],
                last_bits=bits[1],
                by_sensitivity=self._plan.by_sensitivity,
            )
            values[part], cost[part] = found.values, found.cost
            self.n_evaluations += int(found.n_evaluations.sum())
        n_frames = len(self._targets)
        best = cost.reshape(n_frames, -1).argmin(axis=1)
        best += np.arange(n_frames) * (frames.size // n_frames)
        return values[best], cost[best]

    def _cost(self, values: Array, huber_m: float) -> Array:
        """Return the cost of one point a frame, shape (T,)."""
        everyone = np.arange(len(values))
        cost = HumanoidCost(
            self._targets, self._lengths, everyone, weights=self._weights, huber_m=huber_m
        )
        cost.place(values)
        return cost.total()


def _window(centres: Array, half_width: float) -> tuple[Array, Array]:
    """Return the bounds of windows, within the ranges; the heading has none to keep to."""
    half = np.full(len(VARIABLES), half_width)
    half[_SIZE] *= SIZE_PER_RADIAN
    lowest, highest = LOWER.copy(), UPPER.copy()
    lowest[_HEADING], highest[_HEADING] = -np.inf, np.inf
    inside = np.clip(centres, lowest, highest)
    return np.maximum(inside - half, lowest), np.minimum(inside + half, highest)


def polish_clip(
    values: Array,
    targets: Array,
    lengths: SegmentLengths,
    *,
    weights: Array | None = None,
    steps: int = 6,
) -> Array:
    """Finish every frame with a few least-squares steps down the same cost.

    The mean distance is lowered by Levenberg-Marquardt steps on squared distances, each joint
    divided by its present distance (iteratively reweighted least squares). Then frames try their
    neighbours' points as starts, once from either side.

    Parameters
    ----------
    values
        Shape (T, 21).
    targets, lengths, weights
        See `search_clip`.
    steps
        Of least squares, from each start.

    Returns
    -------
    Array
        Shape (T, 21), within the ranges; the residual is never larger than before.
    """
    known = np.asarray(np.isfinite(targets).all(axis=2))
    weight = np.where(known, 1.0 if weights is None else weights, 0.0)
    goal = np.where(known[..., None], targets, 0.0)
    best, cost = descend(values, goal, weight, lengths, steps)
    for shift in (1, -1):
        start = np.roll(best, shift, axis=0)
        other, other_cost = descend(start, goal, weight, lengths, 2 * steps)
        improves = other_cost < cost
        best, cost = np.where(improves[:, None], other, best), np.minimum(cost, other_cost)
    return best


MIN_DISTANCE_M = 0.002
"""A joint this close to its target is weighed no higher still."""


def descend(
    start: Array, goal: Array, weight: Array, lengths: SegmentLengths, steps: int
) -> tuple[Array, Array]:
    """Take damped least-squares steps down the mean distance, in every frame.

    Parameters
    ----------
    start
        Shape (T, 21).
    goal, weight
        Shape (T, 12, 3), m, and (T, 12); a joint without weight may have any goal but NaN.
    lengths
        Segment lengths, m.
    steps
        How many; a step that does not lower the cost is not taken, and the next is shorter.

    Returns
    -------
    tuple of Array
        Values (T, 21) within the ranges, and the weighted sum of distances (T,), m.
    """
    lower, upper = LOWER.copy(), UPPER.copy()
    lower[_HEADING], upper[_HEADING] = -np.inf, np.inf
    values = np.clip(start, lower, upper)
    cost = _weighted_distance(values, goal, weight, lengths)
    damping = np.full(len(values), 1e-3)
    for _ in range(steps):
        step = _damped_step(values, goal, weight, lengths, damping, (lower, upper))
        trial = np.clip(values + step, lower, upper)
        trial_cost = _weighted_distance(trial, goal, weight, lengths)
        improves = trial_cost < cost
        values, cost = np.where(improves[:, None], trial, values), np.minimum(cost, trial_cost)
        damping = np.where(improves, damping / 5, damping * 5)
    return values, cost


def _weighted_distance(values: Array, goal: Array, weight: Array, lengths: SegmentLengths) -> Array:
    distance = np.linalg.norm(compute_joints(values, lengths) - goal, axis=2)
    return np.asarray((weight * distance).sum(axis=1))


def _damped_step(
    values: Array,
    goal: Array,
    weight: Array,
    lengths: SegmentLengths,
    damping: Array,
    bounds: tuple[Array, Array],
) -> Array:
    """Return one Levenberg-Marquardt step, shape (T, 21); variables held at a bound stay."""
    offset = compute_joints(values, lengths) - goal
    distance = np.linalg.norm(offset, axis=2)
    pull = np.repeat(np.sqrt(weight / np.maximum(distance, MIN_DISTANCE_M)), 3, axis=1)
    slopes = compute_jacobian(values, lengths) * pull[..., None]
    normal = slopes.transpose(0, 2, 1) @ slopes
    gradient = np.einsum("tkn,tk->tn", slopes, offset.reshape(len(values), -1) * pull)
    held = ((values <= bounds[0]) & (gradient > 0)) | ((values >= bounds[1]) & (gradient < 0))
    normal[held[:, :, None] | held[:, None, :]] = 0.0
    gradient[held] = 0.0
    diagonal = np.einsum("tnn->tn", normal)
    # The second term keeps directions that move no joint at all from making the matrix singular.
    added = diagonal * damping[:, None] + 1e-6 * diagonal.max(axis=1, keepdims=True) + held + 1e-9
    places = np.arange(values.shape[1])
    normal[:, places, places] += added
    return np.asarray(np.linalg.solve(normal, -gradient[..., None])[..., 0])
