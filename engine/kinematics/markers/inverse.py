"""Inverse kinematics: the pose of a model in which its markers lie nearest to the measured ones.

Least squares over all frames at once by Levenberg and Marquardt's method. The normal equations of
a tree need no Jacobian in full: as in the composite-rigid-body algorithm, the markers below a joint
act like one rigid body of point masses (the weights), whose moments give every product of two
columns.

References
----------
.. [1] Featherstone (2008), Rigid Body Dynamics Algorithms, sec. 6.2.
.. [2] Lu & O'Connor (1999), Journal of Biomechanics 32, 129-134 (whole-body optimisation).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from engine.datatypes import Array
from engine.kinematics.markers.tree import BodyPoses, KinematicTree, cross

__all__ = ["MarkerProblem", "Solution"]

FRAMES_AT_ONCE = 256
"""Keeps the arrays of one step within the processor's cache and some 20 MB."""
KEY_STEP_S = 0.1
"""Frames solved from afar; the others start between two of them."""
FAR_DAMPING, NEAR_DAMPING = 1e-3, 1e-7
LEAST_DAMPING = 1e-9
MAX_DAMPING = 1e6
STEP_TOLERANCE = 2e-5
"""Largest change of an angle, rad, in the last step. Steps shrink at least tenfold near the end, so
that what is left is a ten-thousandth of a degree."""
MAX_STEP = 0.5
"""Largest change of a coordinate in one step, rad or m."""
FLOOR = 1e-7
"""Curvature, in weight times m^2 per rad^2, given to coordinates that no marker shows."""
UNSEEN = 1e4
"""Variance, rad^2 per m^2, above which no marker shows a coordinate: errors of 1 cm turn it by a
radian."""
STRAY_M = 0.01
MAX_RESTARTS = 5
MAX_STEPS = 60
MAX_BOUND_PASSES = 3
BOUND_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class Solution:
    """Coordinates (T, Q), radians and metres, and what is left over.

    `markers` (T, M, 3) are the model's markers; `rms_m` (T,) the weighted root mean square distance
    to the measured ones; `variance` (T, Q) that of every coordinate per variance of the markers,
    all measured alike well; NaN for coordinates that may not change.
    """

    coordinates: Array
    markers: Array
    rms_m: Array
    variance: Array


@dataclass(frozen=True, eq=False)
class MarkerProblem:
    """What is fitted: a tree, markers in its bodies, weights, and which coordinates may change.

    Parameters
    ----------
    tree
        The model.
    body, local
        Shape (M,) and (M, 3): where the markers are, m.
    weights
        Shape (M,).
    free
        Columns of the coordinates that may change.
    """

    tree: KinematicTree
    body: NDArray[np.intp]
    local: Array
    weights: Array
    free: NDArray[np.intp]

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest value of every free coordinate; infinite unless clamped."""
        chosen = [self.tree.model.coordinates[i] for i in self.free]
        low = np.array([c.low if c.is_clamped else -np.inf for c in chosen])
        high = np.array([c.high if c.is_clamped else np.inf for c in chosen])
        return low, high

    @cached_property
    def bodies(self) -> NDArray[np.intp]:
        """Bodies with markers on them."""
        return np.unique(self.body)

    @cached_property
    def _moved(self) -> NDArray[np.intp]:
        """Bodies that free coordinates move first, each once."""
        return np.unique(self.tree.body_of_coordinate[self.free])

    @cached_property
    def _below(self) -> Array:
        """Shape (bodies of `_moved`, M): 1 where a marker hangs below."""
        return self.tree.is_below[self._moved][:, self.body].astype(np.float64)

    @cached_property
    def _slot(self) -> NDArray[np.intp]:
        """Row of `_moved` for every free coordinate."""
        return np.searchsorted(self._moved, self.tree.body_of_coordinate[self.free])

    @cached_property
    def _order(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Whether coordinate i is above (or beside) j, and below j only; shape (F, F) each."""
        bodies = self.tree.body_of_coordinate[self.free]
        above = self.tree.is_below[bodies][:, bodies]
        return above, above.T & ~above

    def solve(self, measured: Array, start: Array, *, rate_hz: float) -> Solution:
        """Fit every frame.

        Parameters
        ----------
        measured
            Shape (T, M, 3), m; NaN where missing.
        start
            Shape (Q,), a pose near that of some frame.
        rate_hz
            Of the frames; tells how far neighbours may differ.
        """
        target, weights = self._frames_last(measured)
        n_frames = len(measured)
        step = max(1, round(KEY_STEP_S * rate_hz)) if np.isfinite(rate_hz) else 1
        keys = np.unique(np.append(np.arange(0, n_frames, step), n_frames - 1))
        at_keys = self._fit(
            target[..., keys], weights[:, keys], np.tile(start, (keys.size, 1)), FAR_DAMPING
        )
        if keys.size == n_frames:
            return self._describe(target, weights, at_keys)
        between = CubicSpline(keys, at_keys) if keys.size > 3 else _Line(keys, at_keys)
        found = self._fit(target, weights, between(np.arange(n_frames)), NEAR_DAMPING)
        return self._describe(target, weights, found)

    def evaluate(self, measured: Array, coordinates: Array) -> Solution:
        """Describe coordinates (T, Q) found elsewhere as the fit to markers (T, M, 3)."""
        return self._describe(*self._frames_last(measured), coordinates)

    def _frames_last(self, measured: Array) -> tuple[Array, Array]:
        """Return positions (3, M, T) and weights (M, T), 0 where a marker is missing."""
        seen = np.asarray(np.isfinite(measured).all(axis=2))
        filled = np.where(seen[..., None], measured, 0.0)
        weights = np.ascontiguousarray((self.weights * seen).T)
        return np.ascontiguousarray(filled.transpose(2, 1, 0)), weights

    def _fit(self, target: Array, weights: Array, start: Array, damping: float) -> Array:
        """Minimise, and start frames that got stuck anew from their neighbours."""
        found, rms = self._minimise_in_parts(target, weights, start, damping)
        for _ in range(MAX_RESTARTS):
            usual = float(np.nanmedian(rms)) if np.isfinite(rms).any() else 0.0
            stray = np.flatnonzero(rms > 2.0 * usual + STRAY_M)
            good = np.flatnonzero(rms <= 2.0 * usual + STRAY_M)
            if not stray.size or not good.size:
                break
            nearest = good[np.abs(stray[:, None] - good[None, :]).argmin(axis=1)]
            again, again_rms = self._minimise_in_parts(
                target[..., stray], weights[:, stray], found[nearest], FAR_DAMPING
            )
            better = again_rms < rms[stray] - 1e-6
            if not better.any():
                break
            found[stray[better]], rms[stray[better]] = again[better], again_rms[better]
        return found

    def _minimise_in_parts(
        self, target: Array, weights: Array, start: Array, damping: float
    ) -> tuple[Array, Array]:
        """Return coordinates (T, Q) and weighted root mean squares (T,)."""
        found, rms = start.copy(), np.empty(len(start))
        for first in range(0, len(start), FRAMES_AT_ONCE):
            part = slice(first, first + FRAMES_AT_ONCE)
            found[part], cost = self._minimise(
                target[..., part], weights[:, part], start[part], damping
            )
            total = weights[:, part].sum(axis=0)
            rms[part] = np.sqrt(cost / np.where(total > 0, total, np.nan))
        return found, rms

    def _minimise(
        self, target: Array, weights: Array, start: Array, first_damping: float
    ) -> tuple[Array, Array]:
        """Return coordinates (T, Q) and weighted square sums (T,)."""
        current = start.copy()
        low, high = self.bounds
        current[:, self.free] = np.clip(current[:, self.free], low, high)
        active, damping = np.arange(len(start)), np.full(len(start), first_damping)
        state = State.at(self, current, target, weights)
        final_cost = state.cost.copy()
        for _ in range(MAX_STEPS):
            change = self._step(state, damping, low, high)
            # From afar a full step can turn a limb once round.
            largest = np.abs(change).max(axis=1, keepdims=True)
            change *= MAX_STEP / np.maximum(largest, MAX_STEP)
            trial = state.coordinates.copy()
            trial[:, self.free] = np.clip(trial[:, self.free] + change, low, high)
            moved = np.abs(trial - state.coordinates).max(axis=1)
            tried = State.at(self, trial, state.target, state.weights)
            is_better = tried.cost <= state.cost
            state = state.replace_where(is_better, tried)
            current[active], final_cost[active] = state.coordinates, state.cost
            damping = np.maximum(damping * np.where(is_better, 0.05, 10.0), LEAST_DAMPING)
            going_on = (moved > STEP_TOLERANCE) & (damping < MAX_DAMPING)
            if not going_on.any():
                break
            if not going_on.all():
                active, damping = active[going_on], damping[going_on]
                state = state.take(going_on)
        return current, final_cost

    def _step(self, state: State, damping: Array, low: Array, high: Array) -> Array:
        """Return the damped Gauss-Newton step (T, F) that stays within the bounds.

        Coordinates that would cross a bound go right up to it, and the others are solved anew with
        that known; clipping alone would spoil a step in which they work together.
        """
        hessian, gradient = self.normal_equations(state)
        at = state.coordinates[:, self.free]
        diagonal = np.arange(self.free.size)
        own = hessian[:, diagonal, diagonal]
        hessian[:, diagonal, diagonal] = own * (1.0 + damping[:, None]) + FLOOR
        # What sits at a bound and pushes against it stays there.
        fixed = ((at <= low) & (gradient < 0)) | ((at >= high) & (gradient > 0))
        change = _solve_with(hessian, gradient, fixed, np.zeros_like(at))
        for _ in range(MAX_BOUND_PASSES):
            aim = at + change
            crossing = ((aim < low - BOUND_TOLERANCE) | (aim > high + BOUND_TOLERANCE)) & ~fixed
            rows = np.flatnonzero(crossing.any(axis=1))
            if not rows.size:
                break
            fixed[rows] |= crossing[rows]
            known = np.where(fixed[rows], np.clip(aim[rows], low, high) - at[rows], 0.0)
            change[rows] = _solve_with(hessian[rows], gradient[rows], fixed[rows], known)
        return change

    def normal_equations(self, state: State) -> tuple[Array, Array]:
        """Return J'WJ (T, F, F) and J'Wr (T, F) with J the Jacobian of the markers."""
        weights, points, residual = state.weights, state.points, state.residual
        pull, pointed = weights * residual, weights * points
        each = np.empty((_MOMENTS, *weights.shape))
        each[0], each[1:4] = weights, pointed
        for slot, (i, j) in enumerate(_SECOND, start=4):
            np.multiply(pointed[i], points[j], out=each[slot])
        each[10:13], each[13:] = cross(points, pull), pull
        # Moments of everything below each moved body, then of every free coordinate: (16, F, T).
        below = (self._below @ each)[:, self._slot]
        motion = state.poses.motion[self.free].transpose(1, 0, 2)
        spin, slide = motion[:3], motion[3:]
        mass, first = below[0], below[1:4]
        xx, xy, xz, yy, yz, zz = below[4:10]
        force = np.empty_like(motion)
        moments = cross(first, slide)
        force[0] = (yy + zz) * spin[0] - xy * spin[1] - xz * spin[2] + moments[0]
        force[1] = (xx + zz) * spin[1] - xy * spin[0] - yz * spin[2] + moments[1]
        force[2] = (xx + yy) * spin[2] - xz * spin[0] - yz * spin[1] + moments[2]
        force[3:] = mass * slide - cross(first, spin)
        by_frame = np.ascontiguousarray(motion.transpose(2, 1, 0))
        product = by_frame @ np.ascontiguousarray(force.transpose(2, 0, 1))
        above, under = self._order
        hessian = above * product + under * product.transpose(0, 2, 1)
        gradient = (motion * below[10:]).sum(axis=0).T
        return hessian, gradient

    def _describe(self, target: Array, weights: Array, coordinates: Array) -> Solution:
        markers = np.empty_like(target)
        variance = np.full_like(coordinates, np.nan)
        rms = np.full(len(coordinates), np.nan)
        diagonal = np.arange(self.free.size)
        for first in range(0, len(coordinates), FRAMES_AT_ONCE):
            part = slice(first, first + FRAMES_AT_ONCE)
            state = State.at(self, coordinates[part], target[..., part], weights[:, part])
            markers[..., part] = state.points
            total = state.weights.sum(axis=0)
            rms[part] = np.sqrt(state.cost / np.where(total > 0, total, np.nan))
            hessian, _ = self.normal_equations(state)
            hessian[:, diagonal, diagonal] += FLOOR
            inverse = np.linalg.inv(hessian)
            # Weights say what to trust in this model, not how well a marker was measured.
            squared, _ = self.normal_equations(replace(state, weights=state.weights**2))
            own = inverse[:, diagonal, diagonal]
            spread = ((inverse @ squared) * inverse).sum(axis=2)
            variance[part, self.free] = np.where(own > UNSEEN, own, spread)
        return Solution(coordinates, markers.transpose(2, 1, 0), rms, variance)


def _solve_with(hessian: Array, gradient: Array, fixed: NDArray[np.bool_], known: Array) -> Array:
    """Return the step (T, F) that solves the free part, with the fixed part as `known`."""
    if not fixed.any():
        return np.asarray(np.linalg.solve(hessian, gradient[..., None])[..., 0])
    right = gradient - (hessian @ known[..., None])[..., 0]
    reduced = np.where(fixed[:, :, None] | fixed[:, None, :], 0.0, hessian)
    diagonal = np.arange(fixed.shape[1])
    reduced[:, diagonal, diagonal] += fixed
    right = np.where(fixed, 0.0, right)
    return np.asarray(np.linalg.solve(reduced, right[..., None])[..., 0] + known)


_SECOND = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_MOMENTS = 16


@dataclass(frozen=True, eq=False)
class _Line:
    """Straight lines between keys, for clips too short for a spline."""

    keys: NDArray[np.intp]
    values: Array

    def __call__(self, at: NDArray[np.intp]) -> Array:
        return np.stack([np.interp(at, self.keys, column) for column in self.values.T], axis=1)


@dataclass(frozen=True, eq=False)
class State:
    """A pose of every frame with its markers, what they miss, and the weighted square sum.

    `coordinates` (T, Q); `target`, `points` and `residual` (3, M, T), `weights` (M, T), `cost`
    (T,).
    """

    coordinates: Array
    poses: BodyPoses
    target: Array
    points: Array
    weights: Array
    cost: Array

    @property
    def residual(self) -> Array:
        """From the model's markers to the measured ones, shape (3, M, T)."""
        return self.target - self.points

    @classmethod
    def at(cls, problem: MarkerProblem, coordinates: Array, target: Array, weights: Array) -> State:
        """Evaluate coordinates (T, Q)."""
        poses = problem.tree.pose(coordinates, bodies=problem.bodies)
        points = poses.place(problem.body, problem.local)
        cost = (weights * ((target - points) ** 2).sum(axis=0)).sum(axis=0)
        return cls(coordinates, poses, target, points, weights, cost)

    def take(self, frames: NDArray[np.bool_]) -> State:
        """Return some frames."""
        return State(
            self.coordinates[frames],
            self.poses.take(frames),
            self.target[..., frames],
            self.points[..., frames],
            self.weights[:, frames],
            self.cost[frames],
        )

    def replace_where(self, frames: NDArray[np.bool_], other: State) -> State:
        """Return this state with some frames from another."""
        if frames.all():
            return other
        poses = BodyPoses(
            np.where(frames, other.poses.rotation, self.poses.rotation),
            np.where(frames, other.poses.origin, self.poses.origin),
            np.where(frames, other.poses.motion, self.poses.motion),
        )
        return State(
            np.where(frames[:, None], other.coordinates, self.coordinates),
            poses,
            self.target,
            np.where(frames, other.points, self.points),
            self.weights,
            np.where(frames, other.cost, self.cost),
        )
