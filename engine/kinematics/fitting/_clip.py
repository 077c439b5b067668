"""Gauss-Newton fit of the figure to a whole clip, with exact derivatives.

Minimised is the sum over frames and points of the squared distance between figure and keypoint
in units of the keypoint's standard error (large ones count less: Huber), plus the roughness of
every curve, plus weak priors. The unknowns of a frame are the mid-hip (three coordinates, m) and
the angles in use (rad), in this order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.kinematics.fitting._banded import BandedFactor, Roughness, factorise
from engine.kinematics.humanoid.model import ANGLE_COUNT, ANGLE_VARIABLES, column
from engine.kinematics.humanoid.tree import Posture, Tree

__all__ = [
    "ROOT",
    "ClipFit",
    "ClipProblem",
    "Linearisation",
    "Pull",
    "fit_clip",
    "fit_frames",
    "linearise",
]

ROOT = 3
"""Unknowns of a frame before the angles: the mid-hip."""
CHUNK = 256
"""Frames worked on at once: their derivatives stay in the processor's cache."""
MAX_STEP_RAD = 0.7
MAX_DAMPING = 1e6
GAIN_TOLERANCE = 1e-4
"""A step that lowers the cost by less than this share moves no angle by a tenth of its error."""
LENGTH_STEPS = 2
"""Steps in which segment lengths are refined; they settle long before the angles do."""
LIMIT_SIGMA = np.radians(3.0)
LIMIT_MARGIN = np.radians(15.0)


@dataclass(frozen=True, eq=False)
class Pull:
    """How what was seen pulls on the figure's points in t frames, to first order.

    `residual` has shape (R, t), in standard errors, less where the robust loss discounts it;
    `misfit` (t,) is what the loss makes of a frame. `carry` turns derivatives of the points, shape
    (P, 3, m, t), into those of the residuals, shape (R, m, t); it may overwrite what it is given.
    """

    residual: Array
    misfit: Array
    carry: Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class ClipProblem:
    """What is fitted: keypoints, their errors and what is known beforehand.

    Parameters
    ----------
    tree
        The figure with P points.
    target, weight
        Shape (P, 3, T), m, in the figure's axes, and (P, T), 1/m^2: one over the squared standard
        error, zero where the keypoint is missing (the target is then any number).
    lengths
        Segment lengths, m.
    roughness
        Of the unknowns.
    prior_mean, prior_weight
        Shape (T, n) and (n,).
    waist_share, waist_weight
        Expected share of the waist in the trunk's pitch, and, shape (T,), one over the variance of
        the waist's pitch around it, 1/rad^2.
    huber
        Distance, in standard errors, from which a keypoint counts less.
    """

    tree: Tree
    target: Array
    weight: Array
    lengths: Mapping[str, float]
    roughness: Roughness
    prior_mean: Array
    prior_weight: Array
    waist_share: float
    waist_weight: Array
    huber: float

    @property
    def variables(self) -> tuple[int, ...]:
        """Places in a full pose vector of the angles in use."""
        return self.tree.variables

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return int(self.target.shape[2])

    def spread(self, state: Array) -> Array:
        """Return full pose vectors (29, T) from states (T, n); angles not in use are zero."""
        angles = np.zeros((ANGLE_COUNT, len(state)))
        angles[list(self.variables)] = state[:, ROOT:].T
        return angles

    def place(self, state: Array) -> Array:
        """Return the figure's points, shape (P, 3, T), m."""
        points = self.tree.place(self.spread(state), self.lengths).points
        return np.asarray(points + state[:, :ROOT].T)

    def unknown(self, name: str) -> int:
        """Return the place of an angle in the state of a frame."""
        place: int = self.variables.index(column(name))
        return ROOT + place

    def weigh(self, points: Array, part: slice) -> Pull:
        """Compare points of shape (P, 3, t) with what was seen in a part of the frames."""
        residual = points - self.target[:, :, part]
        weight = self.weight[:, part]
        distance = np.sqrt(weight * np.einsum("pct,pct->pt", residual, residual))
        is_far = distance > self.huber
        loss = np.where(is_far, self.huber * (2.0 * distance - self.huber), distance**2)
        share = np.where(is_far, self.huber / np.maximum(distance, 1e-9), 1.0)
        pull = np.sqrt(weight * share)

        def carry(slope: Array) -> Array:
            slope *= pull[:, None, None, :]
            return slope.reshape(-1, *slope.shape[2:])

        residual *= pull[:, None, :]
        return Pull(residual.reshape(-1, residual.shape[2]), loss.sum(axis=0), carry)

    def count_samples(self) -> Array:
        """Return how many numbers were seen in every frame, shape (T,)."""
        return np.asarray(3.0 * (self.weight > 0).sum(axis=0))

    def compare(self, state: Array) -> Array:
        """Return the residuals (R, T) at a state (T, n), those of outliers cut to `huber`."""
        residual = self.place(state) - self.target
        residual *= np.sqrt(self.weight)[:, None, :]
        length = np.linalg.norm(residual, axis=1, keepdims=True)
        residual *= np.minimum(1.0, self.huber / np.maximum(length, 1e-9))
        return residual.reshape(-1, residual.shape[2])


@dataclass(frozen=True, eq=False)
class LengthTerms:
    """How the problem depends on L segment lengths.

    `coupling` (T, n, L) links them with the unknowns of every frame; `block` (L, L) and `gradient`
    (L,) are their own.
    """

    coupling: Array
    block: Array
    gradient: Array


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The problem around one state.

    `blocks` (T, n, n) and `gradient` (T, n) leave out the roughness; `data_blocks` is the part of
    the blocks from the keypoints alone, `prior_blocks` that of what is known beforehand, without
    the limits of the joints: that a knee is straight tells nothing about how straight. `cost` (T,)
    is likewise without roughness; `misfit` (T,) the squared distances in units of the squared
    standard errors, as the robust loss counts them.
    """

    blocks: Array
    gradient: Array
    data_blocks: Array
    prior_blocks: Array
    cost: Array
    misfit: Array
    by_length: LengthTerms


@dataclass(frozen=True, eq=False)
class ClipFit:
    """The result of a fit: the state (T, n), its cost, and how the fit ended."""

    problem: ClipProblem
    state: Array
    around: Linearisation
    cost: float
    n_iterations: int
    has_converged: bool


def linearise(
    problem: ClipProblem, state: Array, length_names: tuple[str, ...] = ()
) -> Linearisation:
    """Compute cost, gradient and Gauss-Newton blocks at a state of shape (T, n).

    With `length_names` also how the keypoints' part depends on these segment lengths.
    """
    n_frames, n = state.shape
    count = len(length_names)
    blocks, gradient = np.empty((n_frames, n, n)), np.empty((n_frames, n))
    misfit = np.empty(n_frames)
    by_length = LengthTerms(
        np.empty((n_frames, n, count)), np.zeros((count, count)), np.zeros(count)
    )
    for start in range(0, n_frames, CHUNK):
        part = slice(start, min(start + CHUNK, n_frames))
        posture = problem.tree.place(problem.spread(state[part]), problem.lengths)
        pull = problem.weigh(posture.points + state[part, :ROOT].T, part)
        misfit[part] = pull.misfit
        rows = _weighted_rows(problem, posture, pull, n)
        pulled = pull.residual.T
        gradient[part] = (rows @ pulled[..., None])[..., 0]
        blocks[part] = rows @ rows.transpose(0, 2, 1)
        if count:
            slope = problem.tree.differentiate_lengths(posture, length_names)
            columns = np.ascontiguousarray(pull.carry(slope).transpose(2, 0, 1))
            by_length.coupling[part] = rows @ columns
            by_length.block[:] += np.tensordot(columns, columns, axes=([0, 1], [0, 1]))
            by_length.gradient[:] += np.tensordot(columns, pulled, axes=([0, 1], [0, 1]))
    prior = np.zeros_like(blocks)
    cost = misfit + _add_priors(problem, state, prior, gradient)
    whole = blocks + prior
    cost += _add_limits(problem, state, whole, gradient)
    return Linearisation(whole, gradient, blocks, prior, cost, misfit, by_length)


def _weighted_rows(problem: ClipProblem, posture: Posture, pull: Pull, n: int) -> Array:
    """Return the derivatives of all residuals by the unknowns, shape (T, n, R)."""
    n_points, _, n_frames = posture.points.shape
    jacobian = np.zeros((n_points, 3, n, n_frames))
    for axis in range(3):
        jacobian[:, axis, axis] = 1.0
    jacobian[:, :, ROOT:] = problem.tree.differentiate(posture, problem.variables)
    return np.ascontiguousarray(pull.carry(jacobian).transpose(2, 1, 0))


def _add_priors(problem: ClipProblem, state: Array, blocks: Array, gradient: Array) -> Array:
    """Add what is known beforehand to blocks and gradient in place; return its cost (T,)."""
    off = state - problem.prior_mean
    pull = problem.prior_weight * off
    cost = np.einsum("tn,tn->t", pull, off)
    diagonal = np.arange(state.shape[1])
    blocks[:, diagonal, diagonal] += problem.prior_weight
    gradient += pull
    return np.asarray(cost + _add_waist_prior(problem, state, blocks, gradient))


def _add_limits(problem: ClipProblem, state: Array, blocks: Array, gradient: Array) -> Array:
    """Add what it costs to bend a joint beyond its range; return it, (T,)."""
    lower, upper = _soft_limits(problem)
    excess = state - np.clip(state, lower, upper)
    diagonal = np.arange(state.shape[1])
    blocks[:, diagonal, diagonal] += (excess != 0.0) / LIMIT_SIGMA**2
    gradient += excess / LIMIT_SIGMA**2
    return np.asarray(np.einsum("tn,tn->t", excess, excess) / LIMIT_SIGMA**2)


def _add_waist_prior(problem: ClipProblem, state: Array, blocks: Array, gradient: Array) -> Array:
    """Add the expected share of the waist in the trunk's pitch.

    Without it pelvis, waist and both hips could pitch against each other for free: no joint
    would move.
    """
    body, waist = problem.unknown("theta_bd"), problem.unknown("theta_ws")
    total = state[:, body] + state[:, waist]
    weight = problem.waist_weight
    share = problem.waist_share
    off = state[:, waist] - share * total
    slope = {body: -share, waist: 1.0 - share}
    for i, first in slope.items():
        gradient[:, i] += weight * first * off
        for j, second in slope.items():
            blocks[:, i, j] += weight * first * second
    return np.asarray(weight * off**2)


def _soft_limits(problem: ClipProblem) -> tuple[Array, Array]:
    """Return the ranges of the unknowns with some room: noise must not push against them."""
    lower = np.full(ROOT + len(problem.variables), -np.inf)
    upper = -lower
    for i, place in enumerate(problem.variables, start=ROOT):
        variable = ANGLE_VARIABLES[place]
        low, high = variable.bounds
        is_hinge = variable.name.startswith(("theta_kn", "theta_el"))
        lower[i] = low - (0.0 if is_hinge else LIMIT_MARGIN)
        upper[i] = high + LIMIT_MARGIN
        if variable.name == "psi_bd" or "_sh_" in variable.name:
            # Full turns are no error; shoulders are given by rotation vectors.
            lower[i], upper[i] = -np.inf, np.inf
    return lower, upper


def fit_clip(
    problem: ClipProblem,
    start: Array,
    *,
    refine_lengths: Mapping[str, float] | None = None,
    max_iterations: int = 30,
) -> ClipFit:
    """Fit all frames together.

    Parameters
    ----------
    problem
        What to fit.
    start
        Shape (T, n): the first guess.
    refine_lengths
        Standard deviation in metres, by name, of the segment lengths to refine along with the
        angles; around the lengths of `problem`.
    max_iterations
        The fit ends earlier when a step hardly lowers the cost any more.

    Returns
    -------
    ClipFit
        With the refined lengths in its problem. The cost never rises from step to step.
    """
    state, damping = np.array(start), 0.0
    lengths = _LengthStep(refine_lengths or {}, problem.lengths)
    around = linearise(problem, state, lengths.names)
    cost = _total_cost(problem, around, state)
    has_converged = False
    for iteration in range(1, max_iterations + 1):
        step, changed = _clip_step(problem, around, state, damping, lengths)
        trial = replace(problem, lengths=changed) if changed else problem
        new_state = state + step
        new = linearise(trial, new_state, lengths.names if iteration < LENGTH_STEPS else ())
        new_cost = _total_cost(trial, new, new_state) + lengths.cost(trial.lengths)
        gain = cost - new_cost
        if not gain >= -1e-9 * cost:
            damping = max(10.0 * damping, 1e-3)
            if damping > MAX_DAMPING:
                break
            continue
        problem, state, around, cost = trial, new_state, new, new_cost
        damping = damping / 10.0 if damping > 1e-3 else 0.0
        if iteration >= LENGTH_STEPS:
            lengths.is_free = False
        if gain <= GAIN_TOLERANCE * (cost + len(state)) and not lengths.is_free:
            has_converged = True
            break
    return ClipFit(problem, state, around, cost, iteration, has_converged)


def _total_cost(problem: ClipProblem, around: Linearisation, state: Array) -> float:
    rough = np.einsum("tn,tn->", state, problem.roughness.apply(state))
    return float(around.cost.sum() + rough)


def _clip_step(
    problem: ClipProblem,
    around: Linearisation,
    state: Array,
    damping: float,
    lengths: _LengthStep,
) -> tuple[Array, dict[str, float]]:
    """Return the change of the state, and the new lengths where they are refined."""
    blocks = around.blocks
    if damping:
        blocks = blocks.copy()
        diagonal = np.arange(blocks.shape[1])
        blocks[:, diagonal, diagonal] *= 1.0 + damping
    factor = factorise(blocks, problem.roughness)
    if factor is None:
        # Not positive definite only where numbers overflow; a short step downhill then.
        return _limit(-1e-3 * around.gradient / np.abs(around.gradient).max(initial=1.0)), {}
    downhill = -(around.gradient + problem.roughness.apply(state))
    if not lengths.is_free:
        return _limit(factor.solve(downhill)), {}
    return lengths.solve(problem, around.by_length, factor, downhill)


def _limit(step: Array) -> Array:
    return np.clip(step, -MAX_STEP_RAD, MAX_STEP_RAD)


class _LengthStep:
    """The segment lengths as further unknowns that all frames share."""

    def __init__(self, sigma: Mapping[str, float], centre: Mapping[str, float]) -> None:
        self.names = tuple(sigma)
        self.is_free = bool(sigma)
        self._weight = np.array([sigma[name] ** -2 for name in self.names])
        self._centre = np.array([centre[name] for name in self.names])

    def cost(self, lengths: Mapping[str, float]) -> float:
        """Return the cost of lengths away from where they were expected."""
        return float(self._weight @ self._off(lengths) ** 2)

    def _off(self, lengths: Mapping[str, float]) -> Array:
        return np.asarray(np.array([lengths[name] for name in self.names]) - self._centre)

    def solve(
        self, problem: ClipProblem, terms: LengthTerms, factor: BandedFactor, downhill: Array
    ) -> tuple[Array, dict[str, float]]:
        """Eliminate the frames' unknowns, solve for the lengths, and put them back in."""
        coupling = terms.coupling
        answer = factor.solve(np.concatenate([downhill[..., None], coupling], axis=2))
        free, bound = answer[..., 0], answer[..., 1:]
        frames = ([0, 1], [0, 1])
        left = terms.block + np.diag(self._weight) - np.tensordot(coupling, bound, axes=frames)
        right = (
            -terms.gradient
            - self._weight * self._off(problem.lengths)
            - np.tensordot(coupling, free, axes=frames)
        )
        change = np.linalg.solve(left, right)
        # A length that leaves the human range in one step is the first guess' fault.
        change = np.clip(change, -0.2 * self._centre, 0.2 * self._centre)
        step = free - bound @ change
        new = {n: problem.lengths[n] + float(d) for n, d in zip(self.names, change, strict=True)}
        return _limit(step), {**problem.lengths, **new}


def fit_frames(
    problem: ClipProblem,
    start: Array,
    *,
    max_iterations: int = 60,
    tolerance_rad: float = 1e-3,
) -> ClipFit:
    """Fit every frame by itself: no roughness, otherwise as `fit_clip`."""
    state = np.array(start)
    damping = np.full(problem.n_frames, 1e-6)
    around = linearise(problem, state)
    diagonal = np.arange(state.shape[1])
    iteration = 0
    while iteration < max_iterations:
        iteration += 1
        blocks = around.blocks.copy()
        blocks[:, diagonal, diagonal] *= 1.0 + damping[:, None]
        answer = np.asarray(np.linalg.solve(blocks, around.gradient[..., None]), dtype=np.float64)
        step = _limit(-answer[..., 0])
        new = linearise(problem, state + step)
        better = new.cost <= around.cost * (1 + 1e-12)
        state = np.where(better[:, None], state + step, state)
        around = _mix(better, new, around)
        damping = np.clip(np.where(better, damping / 10.0, damping * 10.0), 1e-6, 1e6)
        moved = np.abs(step).max(axis=1)
        if np.all((moved < tolerance_rad) | (damping >= 1e6)):
            break
    cost, settled = float(around.cost.sum()), bool(np.all(moved < tolerance_rad))
    return ClipFit(problem, state, around, cost, iteration, settled)


def _mix(chosen: NDArray[np.bool_], new: Linearisation, old: Linearisation) -> Linearisation:
    """Take chosen frames from `new`, the others from `old`."""
    parts = {}
    for name in ("blocks", "gradient", "data_blocks", "prior_blocks", "cost", "misfit"):
        a, b = getattr(new, name), getattr(old, name)
        parts[name] = np.where(chosen.reshape(-1, *(1,) * (a.ndim - 1)), a, b)
    return replace(old, **parts)
