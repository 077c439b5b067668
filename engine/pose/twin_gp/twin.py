"""Twin Gaussian processes: poses whose kernel agrees with that of their features.

For features with kernel weights ``u = (K_R + lambda_R I)^-1 k_R`` and predictive variance ``eta``,
the pose x minimises

    F(x) = -2 u . k_X(x) - eta log s(x),    s(x) = 1 + lambda_X - k_X(x) . v(x),
    v(x) = (K_X + lambda_X I)^-1 k_X(x),

which is ``2 eta`` times the divergence of the two processes over the training frames and the new
one, but for a constant (Bo and Sminchisescu, 2010). Its gradient is
``2 gamma (sum_i w_i x_i - (sum_i w_i) x)`` with ``w = (2 (eta / s) v - 2 u) k_X(x)``.

Many frames are solved at once: an evaluation of all is a few matrix products.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.pose.twin_gp.kernels import compute_kernel, compute_square_distances
from engine.pose.twin_gp.lengths import LengthPenalty

__all__ = [
    "LocalTwin",
    "LowRankInverse",
    "Objective",
    "SharedTwin",
    "Solution",
    "minimise",
    "solve_with_lengths",
]

CLAMP: Final = 1e-12
"""Smallest s and eta: variances can't be negative."""
MAX_ITERATIONS: Final = 50
STEP_TOLERANCE_M: Final = 2e-5
"""A frame whose coordinates all move less in an iteration is done: far below any marker's error."""
COST_TOLERANCE: Final = 1e-9
HISTORY: Final = 6
ARMIJO: Final = 1e-4
MAX_HALVINGS: Final = 20
FIRST_STEP_M: Final = 0.05
"""No coordinate moves further in the first iteration."""
CONTINUATION: Final = (0.01, 0.1, 1.0)
"""Shares of the penalty's weight that are solved one after the other: a stiff penalty at once takes
ten times the iterations."""
FACTOR_TOLERANCE: Final = 1e-6
MAX_RANK: Final = 1000

Rows = NDArray[np.intp]


class Objective(Protocol):
    """A cost of each of M poses, to be minimised row by row."""

    def evaluate(self, pose: Array, rows: Rows) -> tuple[Array, Array, Array]:
        """Return cost (R,), gradient (R, D) and a first guess of the curvature (R,).

        Parameters
        ----------
        pose
            Shape (R, D), the poses to judge, m.
        rows
            Shape (R,): which of the M frames they belong to.
        """


@dataclass(frozen=True, eq=False)
class LowRankInverse:
    """``(K + lambda I)^-1`` of a smooth kernel, by the few directions in which K is not zero.

    Poses that people take lie close together, so K has few large eigenvalues: with the pivoted
    Cholesky factor of K, cut where the rest is below `FACTOR_TOLERANCE` times lambda, a product
    costs O(N r) rather than O(N^2).

    Parameters
    ----------
    basis
        Shape (N, r), orthonormal columns.
    shrink
        Shape (r,), eigenvalue / (eigenvalue + lambda).
    noise
        lambda.
    """

    basis: Array
    shrink: Array
    noise: float

    @classmethod
    def from_factor(cls, factor: Array, noise: float) -> LowRankInverse:
        """Build it from a factor (N, r) with ``K = factor @ factor.T``."""
        value, vector = np.linalg.eigh(factor.T @ factor)
        kept = value > FACTOR_TOLERANCE * noise
        value, vector = value[kept], vector[:, kept]
        return cls(factor @ (vector / np.sqrt(value)), value / (value + noise), noise)

    def apply(self, kernel: Array) -> Array:
        """Return ``kernel @ (K + lambda I)^-1`` for rows (M, N)."""
        return np.asarray(
            (kernel - ((kernel @ self.basis) * self.shrink) @ self.basis.T) / self.noise
        )


def factor_kernel(points: Array, gamma: float, tolerance: float) -> Array:
    """Return a factor L (N, r) of the Gaussian kernel of N points, by pivoted Cholesky.

    ``trace(K - L L^T) <= tolerance * N``, unless `MAX_RANK` columns do not reach it.

    References
    ----------
    .. [1] Harbrecht, Peters, Schneider (2012), On the low-rank approximation by the pivoted
       Cholesky decomposition, Appl. Numer. Math. 62.
    """
    n = len(points)
    rest = np.ones(n)
    factor = np.zeros((min(n, MAX_RANK), n))
    for rank in range(len(factor)):
        pivot = int(np.argmax(rest))
        if rest.sum() <= tolerance * n or rest[pivot] <= CLAMP:
            return np.ascontiguousarray(factor[:rank].T)
        distance = np.sum((points - points[pivot]) ** 2, axis=1)
        column = compute_kernel(distance, gamma) - factor[:rank, pivot] @ factor[:rank]
        factor[rank] = column / np.sqrt(rest[pivot])
        rest = np.maximum(rest - factor[rank] ** 2, 0.0)
        rest[pivot] = 0.0
    return np.ascontiguousarray(factor.T)


@dataclass(frozen=True, eq=False)
class SharedTwin:
    """The twin's cost where all frames share the training poses.

    Parameters
    ----------
    train
        Shape (N, D), training poses, m.
    inverse
        Of their kernel.
    gamma
        Width of the pose kernel, 1/m^2.
    u
        Shape (M, N), kernel weights of the features of M frames.
    eta
        Shape (M,), their predictive variance.
    """

    train: Array
    inverse: LowRankInverse
    gamma: float
    u: Array
    eta: Array

    def evaluate(self, pose: Array, rows: Rows) -> tuple[Array, Array, Array]:
        """Return cost, gradient and curvature; see `Objective`."""
        kernel = compute_kernel(compute_square_distances(pose, self.train), self.gamma)
        v = self.inverse.apply(kernel)
        u, eta = self.u[rows], self.eta[rows]
        s = np.maximum(1.0 + self.inverse.noise - np.einsum("mn,mn->m", kernel, v), CLAMP)
        cost = -2.0 * np.einsum("mn,mn->m", u, kernel) - eta * np.log(s)
        w = 2.0 * ((eta / s)[:, None] * v - u) * kernel
        total = w.sum(axis=1)
        gradient = 2.0 * self.gamma * (w @ self.train - total[:, None] * pose)
        return cost, gradient, -2.0 * self.gamma * total


@dataclass(frozen=True, eq=False)
class LocalTwin:
    """The twin's cost where every frame has K training poses of its own (TGPKNN).

    Parameters
    ----------
    train
        Shape (M, K, D), m.
    inverse
        Shape (M, K, K), ``(K_X + lambda_X I)^-1`` of each frame.
    gamma, noise
        Width of the pose kernel, 1/m^2, and lambda_X.
    u
        Shape (M, K).
    eta
        Shape (M,).
    """

    train: Array
    inverse: Array
    gamma: float
    noise: float
    u: Array
    eta: Array

    def evaluate(self, pose: Array, rows: Rows) -> tuple[Array, Array, Array]:
        """Return cost, gradient and curvature; see `Objective`."""
        train, u, eta = self.train[rows], self.u[rows], self.eta[rows]
        kernel = compute_kernel(np.sum((train - pose[:, None]) ** 2, axis=2), self.gamma)
        v = np.matmul(kernel[:, None], self.inverse[rows])[:, 0]
        s = np.maximum(1.0 + self.noise - np.einsum("mn,mn->m", kernel, v), CLAMP)
        cost = -2.0 * np.einsum("mn,mn->m", u, kernel) - eta * np.log(s)
        w = 2.0 * ((eta / s)[:, None] * v - u) * kernel
        total = w.sum(axis=1)
        mean = np.matmul(w[:, None], train)[:, 0]
        gradient = 2.0 * self.gamma * (mean - total[:, None] * pose)
        return cost, gradient, -2.0 * self.gamma * total


@dataclass(frozen=True, eq=False)
class _Constrained:
    """A cost with a penalty on the lengths of segments; `weight` is (M, C), per m^2."""

    twin: Objective
    penalty: LengthPenalty
    weight: Array
    offset: Array

    def evaluate(self, pose: Array, rows: Rows) -> tuple[Array, Array, Array]:
        cost, gradient, curvature = self.twin.evaluate(pose, rows)
        extra, slope = self.penalty.evaluate(pose + self.offset, self.weight[rows])
        return cost + extra, gradient + slope, curvature


@dataclass(frozen=True, eq=False)
class Solution:
    """Poses (M, D) in m, their cost (M,), and how many iterations each took (M,)."""

    pose: Array
    cost: Array
    iterations: NDArray[np.intp]


def solve_with_lengths(
    twin: Objective, start: Array, *, eta: Array, penalty: LengthPenalty, offset: Array
) -> Solution:
    """Minimise the cost plus the penalty, with growing weight; see `minimise`.

    Parameters
    ----------
    twin, start
        The cost of M frames and where to start, (M, D).
    eta
        Shape (M,), which weighs the penalty.
    penalty
        On the segments' lengths.
    offset
        Shape (D,), what to add to poses to get markers, m.
    """
    weight = penalty.weigh(eta)
    solution = Solution(start, np.zeros(len(start)), np.zeros(len(start), dtype=np.intp))
    for share in CONTINUATION:
        stage = minimise(_Constrained(twin, penalty, share * weight, offset), solution.pose)
        solution = Solution(stage.pose, stage.cost, solution.iterations + stage.iterations)
    return solution


def minimise(
    objective: Objective, start: Array, *, max_iterations: int = MAX_ITERATIONS
) -> Solution:
    """Minimise the costs of many poses at once by limited-memory BFGS.

    Each row has its own step length (halved until the cost falls enough, Armijo's rule) and is
    frozen once it moves less than `STEP_TOLERANCE_M`.

    Parameters
    ----------
    objective
        The costs.
    start
        Shape (M, D), m.
    max_iterations
        At most this many for a row.

    References
    ----------
    .. [1] Nocedal, Wright (2006), Numerical Optimization, 2nd ed., algorithms 3.1 and 7.4.
    """
    state = _State(objective, np.array(start, dtype=np.float64))
    iterations = np.zeros(len(start), dtype=np.intp)
    for _ in range(max_iterations):
        rows = np.flatnonzero(state.is_active)
        if not len(rows):
            break
        iterations[rows] += 1
        state.step(rows)
    return Solution(state.pose, state.cost, iterations)


class _State:
    """Where the rows are, and what was learnt of their curvature."""

    def __init__(self, objective: Objective, pose: Array) -> None:
        rows = np.arange(len(pose))
        self._evaluate: Callable[[Array, Rows], tuple[Array, Array, Array]] = objective.evaluate
        self.pose = pose
        self.cost, self.gradient, self.curvature = self._evaluate(pose, rows)
        self.is_active = np.isfinite(self.cost)
        self._moves: list[Array] = []
        self._bends: list[Array] = []
        self._rho: list[Array] = []

    def step(self, rows: Rows) -> None:
        """Do one iteration on some rows."""
        direction = self._find_direction(rows)
        slope = np.einsum("md,md->m", direction, self.gradient[rows])
        is_uphill = slope >= 0
        if is_uphill.any():
            direction[is_uphill] = -self.gradient[rows[is_uphill]]
            slope[is_uphill] = -np.sum(direction[is_uphill] ** 2, axis=1)
        limit = FIRST_STEP_M if not self._moves else 10 * FIRST_STEP_M
        longest = np.maximum(np.abs(direction).max(axis=1), CLAMP)
        size = np.minimum(1.0, limit / longest)
        move, cost, gradient, curvature = self._search(rows, direction, slope, size)
        self._remember(rows, move, gradient - self.gradient[rows])
        gain = self.cost[rows] - cost
        self.pose[rows] += move
        self.cost[rows], self.gradient[rows], self.curvature[rows] = cost, gradient, curvature
        small = np.abs(move).max(axis=1) < STEP_TOLERANCE_M
        self.is_active[rows[small | (gain <= COST_TOLERANCE * np.maximum(1e-3, np.abs(cost)))]] = (
            False
        )

    def _search(
        self, rows: Rows, direction: Array, slope: Array, size: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Halve the steps until each cost falls; a row that can't fall stays where it is."""
        move = np.zeros_like(direction)
        cost, gradient = self.cost[rows].copy(), self.gradient[rows].copy()
        curvature = self.curvature[rows].copy()
        open_rows = np.arange(len(rows))
        for _ in range(MAX_HALVINGS):
            tried = size[open_rows, None] * direction[open_rows]
            at = rows[open_rows]
            new = self._evaluate(self.pose[at] + tried, at)
            wanted = self.cost[at] + ARMIJO * size[open_rows] * slope[open_rows]
            fell = new[0] <= wanted
            done = open_rows[fell]
            move[done] = tried[fell]
            cost[done], gradient[done], curvature[done] = (part[fell] for part in new)
            open_rows = open_rows[~fell]
            if not len(open_rows):
                break
            size[open_rows] *= 0.5
        return move, cost, gradient, curvature

    def _remember(self, rows: Rows, move: Array, bend: Array) -> None:
        product = np.einsum("md,md->m", move, bend)
        is_convex = product > CLAMP * np.einsum("md,md->m", bend, bend)
        moves, bends = np.zeros_like(self.pose), np.zeros_like(self.pose)
        rho = np.zeros(len(self.pose))
        kept = rows[is_convex]
        moves[kept], bends[kept] = move[is_convex], bend[is_convex]
        rho[kept] = 1.0 / product[is_convex]
        self._moves, self._bends, self._rho = (
            [*old, new][-HISTORY:]
            for old, new in (
                (self._moves, moves),
                (self._bends, bends),
                (self._rho, rho),
            )
        )

    def _find_direction(self, rows: Rows) -> Array:
        """Return the quasi-Newton direction of each row by the two-loop recursion."""
        q = -self.gradient[rows]
        shares = []
        for move, bend, rho in zip(
            reversed(self._moves), reversed(self._bends), reversed(self._rho), strict=True
        ):
            share = rho[rows] * np.einsum("md,md->m", move[rows], q)
            q -= share[:, None] * bend[rows]
            shares.append(share)
        q *= self._scale(rows)[:, None]
        for move, bend, rho, share in zip(
            self._moves, self._bends, self._rho, reversed(shares), strict=True
        ):
            back = rho[rows] * np.einsum("md,md->m", bend[rows], q)
            q += (share - back)[:, None] * move[rows]
        return q

    def _scale(self, rows: Rows) -> Array:
        """Return the first guess of the inverse curvature: that of the last move, or the twin's."""
        guess = self.curvature[rows]
        steepest = np.abs(self.gradient[rows]).max(axis=1)
        # Where the weights sum to nothing the fixed point is nowhere: a short step instead.
        scale = np.where(
            guess > CLAMP,
            1.0 / np.maximum(guess, CLAMP),
            FIRST_STEP_M / np.maximum(steepest, CLAMP),
        )
        if self._moves:
            square = np.einsum("md,md->m", self._bends[-1][rows], self._bends[-1][rows])
            known = (self._rho[-1][rows] > 0) & (square > 0)
            inverse = 1.0 / np.maximum(self._rho[-1][rows] * square, CLAMP**2)
            scale = np.where(known, inverse, scale)
        return np.asarray(scale)
