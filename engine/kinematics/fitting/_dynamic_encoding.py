"""Univariate dynamic encoding algorithm for searches (uDEAS), many searches in lock-step.

Every variable is a row of bits. A session visits each row once: a bit is appended (bisectional
search, BSS), then the row counts on in the direction that won while the cost falls
(unidirectional search, UDS). Sessions follow until the rows are `last_bits` long. The searches
of a batch are independent of each other; they share only the calls to the cost, which therefore
works on whole arrays.

References
----------
.. [1] Kim, Kim, Kim, Bang (2008), Engineering Optimization 40 (uDEAS).
.. [2] Choi et al. (2024), the order of the rows by cost sensitivity (Eq 6).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array
from engine.errors import ConfigError, ShapeError

__all__ = ["FunctionCost", "SearchResult", "decode", "draw_codes", "minimise", "search"]

Codes = NDArray[np.int64]
Rows = NDArray[np.intp]
Line = Callable[[Array, Rows | slice], Array]
"""Called as ``line(x, members)``: the cost at `x` (..., b) of those members of the group."""

MAX_BITS = 40
"""A longer row would be finer than the arithmetic that decodes it."""

_ALL = slice(None)


class LineCost(Protocol):
    """The cost of a batch of points, asked for along one variable at a time.

    uDEAS never changes two variables at once; a cost that knows what depends on which variable
    can answer far faster than one that starts from the whole point. `look_ahead` is the number of
    steps in a row that it answers faster together than one by one, though some be in vain.
    """

    look_ahead: int

    def place(self, values: Array) -> None:
        """Put every search at its point, shape (B, n)."""

    def aim(self, variable: int, rows: Rows | slice) -> Line:
        """Return the cost of the searches `rows` as a function of one variable."""

    def move(self, variable: int, rows: Rows | slice, values: Array) -> None:
        """Set one variable of the searches `rows` to `values`, shape (b,)."""


class FunctionCost:
    """Any function of whole points as a `LineCost`.

    Parameters
    ----------
    evaluate
        Takes points (b, n) and the number of the search each belongs to (b,); returns costs (b,).
    """

    look_ahead = 1

    def __init__(self, evaluate: Callable[[Array, Rows], Array]) -> None:
        self._evaluate = evaluate
        self._values: Array = np.empty((0, 0))

    def place(self, values: Array) -> None:
        """Put every search at its point, shape (B, n)."""
        self._values = np.array(values)

    def aim(self, variable: int, rows: Rows | slice) -> Line:
        """Return the cost of the searches `rows` as a function of one variable."""
        searches = np.arange(len(self._values))[rows]

        def line(x: Array, members: Rows | slice) -> Array:
            owner = np.broadcast_to(searches[members], x.shape).ravel()
            points = self._values[owner]
            points[:, variable] = x.ravel()
            return self._evaluate(points, owner).reshape(x.shape)

        return line

    def move(self, variable: int, rows: Rows | slice, values: Array) -> None:
        """Set one variable of the searches `rows` to `values`, shape (b,)."""
        self._values[rows, variable] = values


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Where the searches of a batch ended.

    `values` (B, n), `cost` (B,), `codes` (B, n) of `last_bits` bits, `n_evaluations` (B,):
    how many costs each search needed (not counting those asked for in vain by `look_ahead`).
    """

    values: Array
    cost: Array
    codes: Codes
    n_evaluations: NDArray[np.int64]


def decode(codes: Codes, lower: ArrayLike, upper: ArrayLike, bits: int) -> Array:
    """Turn rows of `bits` bits into values: 0 is the lower bound, all ones the upper."""
    lower = np.asarray(lower, dtype=np.float64)
    span = np.asarray(upper, dtype=np.float64) - lower
    return np.asarray(lower + span * codes / (2**bits - 1))


def draw_codes(
    rng: np.random.Generator, n_searches: int, n_variables: int, *, bits: int = 3
) -> Codes:
    """Draw random bit matrices: one row of `bits` bits for every search and variable."""
    return rng.integers(0, 2**bits, size=(n_searches, n_variables), dtype=np.int64)


def search(
    cost: LineCost,
    lower: ArrayLike,
    upper: ArrayLike,
    start: Codes,
    *,
    first_bits: int = 3,
    last_bits: int = 10,
    by_sensitivity: bool = False,
) -> SearchResult:
    """Run one local search from every bit matrix, all in lock-step.

    Parameters
    ----------
    cost
        What to minimise.
    lower, upper
        Range of every variable, shape (n,) or one range per search, (B, n).
    start
        Shape (B, n): the rows as integers of `first_bits` bits.
    first_bits, last_bits
        Length of the rows before the first and after the last session.
    by_sensitivity
        Visit the rows in descending order of the cost sensitivity that the session before found,
        each search in its own order; otherwise always in natural order.

    Returns
    -------
    SearchResult
        One local minimum for each start; every search is what it would be alone.

    Raises
    ------
    ConfigError
        If the lengths of the rows don't increase.
    ShapeError
        If the bounds don't fit the rows.
    """
    if not 0 < first_bits < last_bits <= MAX_BITS:
        raise ConfigError(
            f"Rows must grow from at least 1 bit to at most {MAX_BITS}, "
            f"got {first_bits} to {last_bits}."
        )
    low, high = _check_bounds(lower, upper, start.shape)
    cost.place(decode(start, low, high, first_bits))
    state = _Searches(cost, np.array(start), low, high - low)
    order = np.broadcast_to(np.arange(start.shape[1]), start.shape)
    for bits in range(first_bits + 1, last_bits + 1):
        sensitivity = state.run_session(order, bits, natural=not by_sensitivity)
        if by_sensitivity:
            order = np.argsort(-sensitivity, axis=1, kind="stable")
    values = decode(state.codes, low, high, last_bits)
    return SearchResult(values, state.cost, state.codes, state.n_evaluations)


def minimise(
    evaluate: Callable[[Array], Array],
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    restarts: int = 20,
    seed: int = 0,
    first_bits: int = 3,
    last_bits: int = 10,
    by_sensitivity: bool = False,
) -> tuple[Array, float]:
    """Minimise a function of several variables with restarts from random bit matrices.

    Parameters
    ----------
    evaluate
        Takes points (b, n), returns costs (b,).
    lower, upper
        Shape (n,).
    restarts, seed
        Number of random starts, and what they are drawn with.
    first_bits, last_bits, by_sensitivity
        See `search`.

    Returns
    -------
    tuple of Array and float
        The best point (n,) and its cost; a cost that is NaN never wins.
    """
    n_variables = np.asarray(lower).size
    start = draw_codes(np.random.default_rng(seed), restarts, n_variables, bits=first_bits)
    found = search(
        FunctionCost(lambda points, _owner: evaluate(points)),
        lower,
        upper,
        start,
        first_bits=first_bits,
        last_bits=last_bits,
        by_sensitivity=by_sensitivity,
    )
    best = int(np.argmin(np.where(np.isnan(found.cost), np.inf, found.cost)))
    return found.values[best], float(found.cost[best])


class _Searches:
    """The bit matrices of a batch while the sessions run."""

    def __init__(self, cost: LineCost, codes: Codes, low: Array, span: Array) -> None:
        self._cost_along = cost
        self._low, self._span = low, span
        self.codes = codes
        self.cost: Array = np.full(len(codes), np.nan)
        self.n_evaluations: NDArray[np.int64] = np.zeros(len(codes), dtype=np.int64)

    def run_session(self, order: NDArray[np.intp], bits: int, *, natural: bool) -> Array:
        """Visit every row once and return the cost sensitivity of each, shape (B, n)."""
        sensitivity = np.zeros(self.codes.shape)
        for visit in range(self.codes.shape[1]):
            groups = [(visit, _ALL)] if natural else _group(order[:, visit])
            for variable, rows in groups:
                sensitivity[rows, variable] = self._visit(variable, rows, bits)
        return sensitivity

    def _visit(self, variable: int, rows: Rows | slice, bits: int) -> Array:
        """Append one bit to a row (BSS), then count on while the cost falls (UDS)."""
        low, last = self._low[rows, variable], 2**bits - 1
        step = self._span[rows, variable] / last
        line = self._cost_along.aim(variable, rows)

        zero = 2 * self.codes[rows, variable]
        pair = line(low + step * np.stack([zero, zero + 1]), _ALL)
        goes_up = pair[1] < pair[0]
        code, cost = zero + goes_up, np.where(goes_up, pair[1], pair[0])
        difference = np.abs(pair[1] - pair[0])

        first_code, first_cost = code.copy(), cost.copy()
        room = np.where(goes_up, last - code, code)
        direction = np.where(goes_up, 1, -1)
        following, width = np.flatnonzero(room > 0), 1
        while following.size:
            ahead = np.arange(1, width + 1)[:, None]
            tried = code[following] + direction[following] * ahead
            found = line(low[following] + step[following] * tried, following)
            n_better = _count_falls(cost[following], found, room[following])
            won = n_better > 0
            moved, n_moved = following[won], n_better[won]
            cost[moved] = found[n_moved - 1, np.flatnonzero(won)]
            code[moved] += direction[moved] * n_moved
            room[moved] -= n_moved
            following = following[(n_better == width) & (room[following] > 0)]
            width = min(2 * width, self._cost_along.look_ahead)

        self.codes[rows, variable], self.cost[rows] = code, cost
        successes = np.abs(code - first_code)
        self.n_evaluations[rows] += 2 + successes + (room > 0)
        self._cost_along.move(variable, rows, low + step * code)
        # Eq 6; all steps are equally wide, and those of UDS all go down, so that their sum is
        # the whole fall. A variable without a range can't change the cost.
        fall = difference + np.where(successes > 0, first_cost - cost, 0.0)
        return np.asarray(fall / (np.where(step > 0, step, np.inf) * (successes + 1)))


def _count_falls(cost: Array, found: Array, room: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count how many of the steps in a row, shape (w, b), each lower the cost further."""
    before = np.concatenate([cost[None], found[:-1]])
    falls = (found < before) & (np.arange(len(found))[:, None] < room)
    return np.asarray(np.logical_and.accumulate(falls, axis=0).sum(axis=0))


def _group(variables: NDArray[np.intp]) -> Iterator[tuple[int, Rows]]:
    """Yield each variable that is due, with the searches that visit it now."""
    by_variable = np.argsort(variables, kind="stable")
    edges = np.flatnonzero(np.diff(variables[by_variable])) + 1
    for rows in np.split(by_variable, edges):
        if rows.size:
            yield int(variables[rows[0]]), rows


def _check_bounds(
    lower: ArrayLike, upper: ArrayLike, shape: tuple[int, ...]
) -> tuple[Array, Array]:
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    for name, bound in (("lower", low), ("upper", high)):
        if bound.shape not in (shape, shape[1:]):
            raise ShapeError(
                f"The {name} bounds need shape {shape[1:]} or {shape}, got {bound.shape}."
            )
    if not np.all(low <= high):
        raise ConfigError("Every lower bound must be at most its upper bound.")
    return np.broadcast_to(low, shape), np.broadcast_to(high, shape)
