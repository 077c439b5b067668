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

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.kinematics.markers.tree import BodyPoses, KinematicTree

__all__ = ["MarkerProblem", "Solution"]

FRAMES_AT_ONCE = 512
"""Keeps the arrays of one step within the processor's cache and some 30 MB."""
KEY_STEP_S = 0.1
"""Frames solved from afar; the others start between two of them."""
FIRST_DAMPING = 1e-3
TRUSTED_DAMPING = 1e-8
MAX_DAMPING = 1e6
STEP_TOLERANCE = 2e-6
"""Largest change of an angle, rad, in the last step: a ten-thousandth of a degree."""
MAX_STEP = 0.5
"""Largest change of a coordinate in one step, rad or m."""
FLOOR = 1e-7
"""Curvature, in weight times m^2 per rad^2, given to coordinates that no marker shows."""
STRAY_M = 0.01
MAX_RESTARTS = 5


@dataclass(frozen=True, eq=False)
class Solution:
    """Coordinates (T, Q), radians and metres, and what is left over.

    `markers` (T, M, 3) are the model's markers; `rms_m` (T,) the weighted root mean square distance
    to the measured ones; `variance` (T, Q) that of every coordinate for markers whose errors have
    a variance of 1 m^2 divided by their weight.
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
        weights = self.weights * np.isfinite(measured).all(axis=2)
        target = np.where(weights[..., None] > 0, measured, 0.0)
        step = max(1, round(KEY_STEP_S * rate_hz)) if np.isfinite(rate_hz) else 1
        keys = np.unique(np.append(np.arange(0, len(target), step), len(target) - 1))
        at_keys = self._solve_from_afar(
            target[keys], weights[keys], np.tile(start, (keys.size, 1)), max_steps=60
        )
        between = np.stack(
            [np.interp(np.arange(len(target)), keys, column) for column in at_keys.T], axis=1
        )
        found = self._solve_from_afar(target, weights, between, max_steps=30)
        return self._describe(target, weights, found)

    def _solve_from_afar(
        self, target: Array, weights: Array, start: Array, *, max_steps: int
    ) -> Array:
        """Minimise, and start frames that got stuck anew from their neighbours."""
        found, rms = self._minimise_in_parts(target, weights, start, max_steps)
        for _ in range(MAX_RESTARTS):
            usual = float(np.nanmedian(rms)) if np.isfinite(rms).any() else 0.0
            stray = np.flatnonzero(rms > 2.0 * usual + STRAY_M)
            good = np.flatnonzero(rms <= 2.0 * usual + STRAY_M)
            if not stray.size or not good.size:
                break
            nearest = good[np.abs(stray[:, None] - good[None, :]).argmin(axis=1)]
            again, again_rms = self._minimise_in_parts(
                target[stray], weights[stray], found[nearest], max_steps
            )
            better = again_rms < rms[stray] - 1e-6
            if not better.any():
                break
            found[stray[better]], rms[stray[better]] = again[better], again_rms[better]
        return found

    def _minimise_in_parts(
        self, target: Array, weights: Array, start: Array, max_steps: int
    ) -> tuple[Array, Array]:
        found, rms = start.copy(), np.empty(len(start))
        for first in range(0, len(start), FRAMES_AT_ONCE):
            part = slice(first, first + FRAMES_AT_ONCE)
            found[part], cost = self._minimise(target[part], weights[part], start[part], max_steps)
            total = weights[part].sum(axis=1)
            rms[part] = np.sqrt(cost / np.where(total > 0, total, np.nan))
        return found, rms

    def _minimise(
        self, target: Array, weights: Array, start: Array, max_steps: int
    ) -> tuple[Array, Array]:
        """Return coordinates (T, Q) and weighted square sums (T,)."""
        current = start.copy()
        low, high = self.bounds
        current[:, self.free] = np.clip(current[:, self.free], low, high)
        damping = np.full(len(start), FIRST_DAMPING)
        active = np.arange(len(start))
        state = _State.at(self, current, target, weights)
        final_cost = state.cost.copy()
        for _ in range(max_steps):
            change = self._step(state, damping[active], low, high)
            # From afar a full step can turn a limb once round.
            largest = np.abs(change).max(axis=1, keepdims=True)
            change *= MAX_STEP / np.maximum(largest, MAX_STEP)
            trial = state.coordinates.copy()
            trial[:, self.free] = np.clip(trial[:, self.free] + change, low, high)
            moved = np.abs(trial - state.coordinates).max(axis=1)
            tried = _State.at(self, trial, target[active], weights[active])
            is_better = tried.cost <= state.cost
            state = state.replace_where(is_better, tried)
            current[active], final_cost[active] = state.coordinates, state.cost
            factor = np.where(is_better, 0.05, 10.0)
            damping[active] = np.clip(damping[active] * factor, TRUSTED_DAMPING, None)
            going_on = (moved > STEP_TOLERANCE) & (damping[active] < MAX_DAMPING)
            if not going_on.any():
                break
            active, state = active[going_on], state.take(going_on)
        return current, final_cost

    def _step(self, state: _State, damping: Array, low: Array, high: Array) -> Array:
        """Return the damped Gauss-Newton step (T, F), with coordinates held at their bounds."""
        hessian, gradient = self.normal_equations(state)
        at = state.coordinates[:, self.free]
        held = ((at <= low) & (gradient < 0)) | ((at >= high) & (gradient > 0))
        gradient = np.where(held, 0.0, gradient)
        hessian[held[:, :, None] | held[:, None, :]] = 0.0
        diagonal = np.arange(self.free.size)
        own = hessian[:, diagonal, diagonal]
        hessian[:, diagonal, diagonal] = own * (1.0 + damping[:, None]) + FLOOR
        # A held coordinate's row is empty but for the floor, so that it does not move.
        return np.asarray(np.linalg.solve(hessian, gradient[..., None])[..., 0])

    def normal_equations(self, state: _State) -> tuple[Array, Array]:
        """Return J'WJ (T, F, F) and J'Wr (T, F) with J the Jacobian of the markers."""
        weights, points, residual = state.weights, state.points, state.residual
        n_frames, n_bodies = len(points), self._moved.size
        weighted = weights[..., None] * residual
        each = np.concatenate(
            [
                weights[..., None],
                weights[..., None] * points,
                (weights[..., None, None] * points[..., :, None] * points[..., None, :]).reshape(
                    *weights.shape, 9
                ),
                _cross3(points, weighted),
                weighted,
            ],
            axis=2,
        )
        # Moments of everything below each moved body, (bodies, T, 19), in one product.
        below = (self._below @ each.transpose(1, 0, 2).reshape(weights.shape[1], -1)).reshape(
            n_bodies, n_frames, 19
        )[self._slot]
        motion = state.poses.motion[self.free]
        spin, slide = motion[..., :3], motion[..., 3:]
        mass, first = below[..., :1], below[..., 1:4]
        second = below[..., 4:13].reshape(*below.shape[:2], 3, 3)
        trace = np.trace(second, axis1=2, axis2=3)[..., None]
        force = np.empty_like(motion)
        force[..., :3] = trace * spin - (second @ spin[..., None])[..., 0] + _cross3(first, slide)
        force[..., 3:] = mass * slide - _cross3(first, spin)
        product = motion.transpose(1, 0, 2) @ force.transpose(1, 2, 0)
        above, under = self._order
        hessian = np.where(above, product, 0.0) + np.where(under, product.transpose(0, 2, 1), 0.0)
        gradient = (motion * below[..., 13:]).sum(axis=2).T
        return hessian, gradient

    def _describe(self, target: Array, weights: Array, coordinates: Array) -> Solution:
        markers = np.empty_like(target)
        variance = np.full_like(coordinates, np.nan)
        rms = np.full(len(target), np.nan)
        for first in range(0, len(target), FRAMES_AT_ONCE):
            part = slice(first, first + FRAMES_AT_ONCE)
            state = _State.at(self, coordinates[part], target[part], weights[part])
            markers[part] = state.points
            total = weights[part].sum(axis=1)
            rms[part] = np.sqrt(state.cost / np.where(total > 0, total, np.nan))
            hessian, _ = self.normal_equations(state)
            diagonal = np.arange(self.free.size)
            hessian[:, diagonal, diagonal] += FLOOR
            inverse = np.linalg.inv(hessian)
            variance[part, self.free] = inverse[:, diagonal, diagonal]
        return Solution(coordinates, markers, rms, variance)


@dataclass(frozen=True, eq=False)
class _State:
    """A pose of every frame with its markers, what they miss, and the weighted square sum."""

    coordinates: Array
    poses: BodyPoses
    points: Array
    residual: Array
    weights: Array
    cost: Array

    @classmethod
    def at(
        cls, problem: MarkerProblem, coordinates: Array, target: Array, weights: Array
    ) -> _State:
        poses = problem.tree.pose(coordinates)
        points = poses.place(problem.body, problem.local)
        residual = target - points
        cost = (weights * (residual**2).sum(axis=2)).sum(axis=1)
        return cls(coordinates, poses, points, residual, weights, cost)

    def take(self, rows: NDArray[np.bool_]) -> _State:
        poses = BodyPoses(
            self.poses.rotation[:, rows], self.poses.origin[:, rows], self.poses.motion[:, rows]
        )
        return _State(
            self.coordinates[rows],
            poses,
            self.points[rows],
            self.residual[rows],
            self.weights[rows],
            self.cost[rows],
        )

    def replace_where(self, rows: NDArray[np.bool_], other: _State) -> _State:
        """Return this state with some frames from another."""
        if rows.all():
            return other

        def pick(own: Array, theirs: Array, *, frames: int = 0) -> Array:
            shape = [1] * own.ndim
            shape[frames] = rows.size
            return np.where(rows.reshape(shape), theirs, own)

        poses = BodyPoses(
            pick(self.poses.rotation, other.poses.rotation, frames=1),
            pick(self.poses.origin, other.poses.origin, frames=1),
            pick(self.poses.motion, other.poses.motion, frames=1),
        )
        return _State(
            pick(self.coordinates, other.coordinates),
            poses,
            pick(self.points, other.points),
            pick(self.residual, other.residual),
            self.weights,
            pick(self.cost, other.cost),
        )


def _cross3(a: Array, b: Array) -> Array:
    """Return cross products along the last axis; quicker than numpy's for small arrays."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)
