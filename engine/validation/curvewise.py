"""Tests of whole curves: where along a movement the estimate differs from the reference.

A permutation test of the largest t over the curve (max-t) keeps the chance of any false finding at
the chosen level without assuming a distribution or the smoothness of the curves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array
from engine.errors import ConfigError, DataError, ShapeError

__all__ = ["CurveTest", "DifferingPart", "normalise_curve", "permute_curves"]

N_NODES = 101
N_FLIPS = 10_000
TIE = 1e-12
"""Flips whose shares differ by less are the same but for rounding."""
_CHUNK = 2048
"""Sign flips worked on at a time: 2048 x 101 numbers stay in the processor's cache."""


@dataclass(frozen=True)
class DifferingPart:
    """A stretch of the movement where the curves differ: from and to in percent, its p."""

    start_percent: float
    end_percent: float
    p: float


@dataclass(frozen=True)
class CurveTest:
    """A sign-flip permutation test of paired curves.

    Parameters
    ----------
    n_curves
        Curves (subjects, or trials of one subject) that were used.
    n_flips, is_exact
        Sign flips tried, and whether those were all there are.
    t
        t of every node; NaN where the node was removed.
    critical_t
        A node whose ``|t|`` exceeds this differs; infinite if none can.
    p
        Smallest adjusted p over the curve.
    p_nodes
        Adjusted p of every node.
    parts
        Where the curves differ.
    n_removed
        Nodes without variance or with a missing curve.
    smallest_p
        Smallest p this number of curves can give. Above `alpha` the test can't find anything.
    """

    n_curves: int
    n_flips: int
    is_exact: bool
    t: tuple[float, ...]
    critical_t: float
    p: float
    p_nodes: tuple[float, ...]
    parts: tuple[DifferingPart, ...]
    n_removed: int
    smallest_p: float
    alpha: float = 0.05

    @property
    def can_find_differences(self) -> bool:
        """Whether there are enough curves for any difference to show."""
        return self.smallest_p <= self.alpha


def normalise_curve(time_s: ArrayLike, curve: ArrayLike, *, n_nodes: int = N_NODES) -> Array:
    """Resample a curve to an even grid from 0 to 100 % of its time.

    Linear between samples. A node inside a gap stays missing: its neighbours on both sides must
    exist (or the sample it falls on).

    Parameters
    ----------
    time_s
        Shape (T,), s, increasing; the first and last time are 0 and 100 %.
    curve
        Shape (T,); NaN where missing.
    n_nodes
        Number of nodes.

    Returns
    -------
    Array
        Shape (n_nodes,).
    """
    time, values = np.asarray(time_s, np.float64), np.asarray(curve, np.float64)
    if time.ndim != 1 or time.shape != values.shape or time.size < 2:
        raise ShapeError(
            f"Expected a time and a value for two frames or more, got {time.shape}, {values.shape}."
        )
    if not np.all(np.diff(time) > 0):
        raise DataError("time_s must increase from frame to frame, but it does not.")
    if n_nodes < 2:
        raise ConfigError(f"A curve needs at least two nodes, got {n_nodes}.")
    grid = np.linspace(time[0], time[-1], n_nodes)
    right = np.clip(np.searchsorted(time, grid), 1, time.size - 1)
    left = right - 1
    share = (grid - time[left]) / (time[right] - time[left])
    # A node on a sample must not become missing because of the neighbour it doesn't need.
    low = np.where(share < 1, (1 - share) * values[left], 0.0)
    return np.asarray(low + np.where(share > 0, share * values[right], 0.0))


def permute_curves(
    difference: ArrayLike, *, alpha: float = 0.05, n_flips: int = N_FLIPS, seed: int = 0
) -> CurveTest:
    """Test at which part of the movement paired curves differ.

    If estimate and reference were the same but for chance, the sign of every difference curve
    could as well be the other. The largest ``|t|`` over the curve is compared with those of
    flipped signs: of all flips where these are at most `n_flips`, of random ones otherwise.

    Parameters
    ----------
    difference
        Shape (n, N): one curve of differences per independent unit. Average the trials of one
        subject first: the test takes rows as independent.
    alpha
        Chance of any false finding over the whole curve.
    n_flips, seed
        Number of flips, and the seed for random ones.

    Returns
    -------
    CurveTest
        With fewer than two curves, or no node left, p is NaN and nothing differs.

    References
    ----------
    .. [1] Nichols & Holmes (2002), Hum. Brain Mapp. 15, 1-25.
    .. [2] Pataky, Vanrenterghem & Robinson (2015), J. Biomech. 48, 1277-1285.
    """
    curves = np.asarray(difference, dtype=np.float64)
    if curves.ndim != 2:
        raise ShapeError(f"difference needs shape (curves, nodes), got {curves.shape}.")
    if not 0 < alpha < 1 or n_flips < 1:
        raise ConfigError(f"Expected alpha in 0 to 1 and a flip or more, got {alpha}, {n_flips}.")
    curves = curves[np.isfinite(curves).any(axis=1)]
    n, n_nodes = curves.shape
    usable = _usable_nodes(curves)
    removed = int(n_nodes - usable.sum())
    t, p_nodes = np.full(n_nodes, np.nan), np.full(n_nodes, np.nan)
    is_exact = 2.0**n <= n_flips
    if n < 2 or not usable.any():
        return CurveTest(
            n, 0, is_exact, tuple(t), math.inf, math.nan, tuple(p_nodes), (), removed, 1.0, alpha
        )
    kept = curves[:, usable]
    largest = _largest_shares(kept, n_flips, seed, is_exact=is_exact)
    t[usable] = kept.mean(axis=0) / (kept.std(axis=0, ddof=1) / math.sqrt(n))
    p_nodes[usable] = _p_values(_shares(kept.mean(axis=0), kept), largest)
    return CurveTest(
        n_curves=n,
        n_flips=largest.size,
        is_exact=is_exact,
        t=tuple(t.tolist()),
        critical_t=_critical_t(largest, alpha, n),
        p=float(np.nanmin(p_nodes)),
        p_nodes=tuple(p_nodes.tolist()),
        parts=_differing_parts(p_nodes, alpha),
        n_removed=removed,
        # The observed signs and all of them flipped give the same |t|.
        smallest_p=2.0 / 2.0**n if is_exact else max(1.0 / largest.size, 2.0 / 2.0**n),
        alpha=alpha,
    )


def _usable_nodes(curves: Array) -> NDArray[np.bool_]:
    """Mark the nodes that every curve has and where the curves vary."""
    if curves.shape[0] < 2:
        return np.zeros(curves.shape[1], dtype=np.bool_)
    complete = np.isfinite(curves).all(axis=0)
    known = np.where(complete, curves, 0.0)
    size = np.abs(known).max(axis=0)
    return np.asarray(complete & (np.ptp(known, axis=0) > 1e-9 * size))


def _shares(mean: Array, curves: Array) -> Array:
    """Return the squared mean as a share of the mean square, 0 to 1, for every node.

    The mean square doesn't change when signs flip, so for one number of curves the share orders
    flips as ``|t|`` does: ``t^2 = (n - 1) share / (1 - share)``. It costs no division per flip and
    loses no digits where t is huge.
    """
    return np.asarray(np.square(mean) / np.square(curves).mean(axis=0))


def _largest_shares(curves: Array, n_flips: int, seed: int, *, is_exact: bool) -> Array:
    """Return the largest share over the nodes for every flip; the first flip is none at all."""
    n = curves.shape[0]
    flips = _all_flips(n) if is_exact else _random_flips(n, n_flips, seed)
    scaled = curves / (n * np.sqrt(np.square(curves).mean(axis=0)))
    largest = []
    for start in range(0, len(flips), _CHUNK):
        product = flips[start : start + _CHUNK] @ scaled
        largest.append(np.abs(product, out=product).max(axis=1))
    return np.asarray(np.square(np.concatenate(largest)))


@lru_cache(maxsize=4)
def _all_flips(n: int) -> Array:
    """Return every combination of n signs, shape (2^n, n)."""
    flips = np.asarray(1.0 - 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1), float)
    flips.setflags(write=False)
    return flips


@lru_cache(maxsize=4)
def _random_flips(n: int, n_flips: int, seed: int) -> Array:
    """Return random signs, shape (n_flips, n); the same for every angle of a study."""
    heads = np.random.default_rng(seed).integers(0, 2, size=(n_flips, n))
    flips = np.asarray(1.0 - 2.0 * heads, float)
    flips[0] = 1.0
    flips.setflags(write=False)
    return flips


def _p_values(observed: Array, largest: Array) -> Array:
    """Return the share of flips that reach the observed value; equal but for rounding counts."""
    reached = largest.size - np.searchsorted(np.sort(largest), observed - TIE)
    return np.asarray(reached / largest.size)


def _critical_t(largest: Array, alpha: float, n: int) -> float:
    """Return the largest ``|t|`` whose p exceeds alpha; infinite if that of every flip does."""
    ordered = np.sort(largest)
    reached = ordered.size - np.searchsorted(ordered, ordered - TIE)
    is_chance = reached > alpha * ordered.size + 1e-9
    if is_chance.all():
        return math.inf
    share = float(ordered[is_chance][-1])
    return math.sqrt((n - 1) * share / max(1.0 - share, TIE))


def _differing_parts(p_nodes: Array, alpha: float) -> tuple[DifferingPart, ...]:
    found = np.concatenate([[False], np.nan_to_num(p_nodes, nan=1.0) <= alpha, [False]])
    edges = np.flatnonzero(np.diff(found.astype(np.int8)))
    scale = 100.0 / max(p_nodes.size - 1, 1)
    return tuple(
        DifferingPart(float(a * scale), float((b - 1) * scale), float(p_nodes[a:b].min()))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    )
