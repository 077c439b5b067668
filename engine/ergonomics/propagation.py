"""Errors of inputs carried through formulas with kinks, the same way every time.

Risk formulas have clamps and tables, where derivatives mislead. The inputs are therefore
drawn many times from their error distributions, on a fixed low-discrepancy sequence: no random
numbers, so equal inputs give equal intervals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from statistics import NormalDist

import numpy as np

from engine.datatypes import Array, Measurement, frozen_array

__all__ = ["compute_interval", "compute_shares", "draw_inputs", "standard_normal_points"]

N_DRAWS = 4096
INTERVAL_PERCENT = (2.5, 97.5)


@cache
def standard_normal_points(n_inputs: int, n_draws: int = N_DRAWS) -> Array:
    """Return evenly spread points of independent standard normal variables.

    Parameters
    ----------
    n_inputs
        Number of variables.
    n_draws
        Number of points.

    Returns
    -------
    Array
        Shape (n_draws, n_inputs), read-only; always the same for the same arguments.

    Notes
    -----
    An additive recurrence whose steps are powers of the generalised golden ratio, turned into
    normal deviates. Each column is centred and scaled to mean 0 and standard deviation 1.
    """
    ratio = 2.0
    for _ in range(60):  # fixed point of x^(n+1) = x + 1
        ratio = (1.0 + ratio) ** (1.0 / (n_inputs + 1))
    steps = ratio ** -np.arange(1.0, n_inputs + 1)
    uniform = (0.5 + np.arange(1, n_draws + 1)[:, None] * steps) % 1.0
    # Python's own quantiles are as exact as SciPy's, which would take longer to load than to use.
    quantiles = map(NormalDist().inv_cdf, np.clip(uniform, 1e-9, 1 - 1e-9).flat)
    normal = np.fromiter(quantiles, np.float64, uniform.size).reshape(uniform.shape)
    return frozen_array((normal - normal.mean(axis=0)) / normal.std(axis=0))


def draw_inputs(inputs: Mapping[str, Measurement]) -> dict[str, Array]:
    """Draw every input from a normal distribution around its value, independently.

    The inputs are magnitudes, their values not negative: draws below zero are reflected to the
    positive side.
    """
    points = standard_normal_points(max(1, len(inputs)))
    return {
        name: np.abs(item.value + item.sigma * points[:, k])
        for k, (name, item) in enumerate(inputs.items())
    }


def compute_interval(values: Array) -> tuple[float, float]:
    """Return the bounds that hold 95 % of the draws, as many below as above."""
    low, high = np.percentile(values, INTERVAL_PERCENT)
    return float(low), float(high)


def compute_shares(
    function: Callable[[Mapping[str, Array]], Array], inputs: Mapping[str, Measurement]
) -> dict[str, float]:
    """Return each input's share of the variance, from moving it alone; together 1.

    All shares are 0 where nothing varies.
    """
    drawn = draw_inputs(inputs)
    fixed = {name: np.full(N_DRAWS, item.value) for name, item in inputs.items()}
    variance = {
        name: float(np.var(function({**fixed, name: values}))) for name, values in drawn.items()
    }
    total = sum(variance.values())
    # Rounding leaves a trace of variance in constants.
    return {n: round(v / total, 9) if total > 0 else 0.0 for n, v in variance.items()}
