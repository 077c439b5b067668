"""Squared distances and Gaussian kernels, in blocks so that memory stays small."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array

__all__ = ["compute_kernel", "compute_square_distances", "find_median_square"]

BLOCK_COLUMNS: Final = 4096
EXACT_COLUMNS: Final = 1024
MEDIAN_ROWS: Final = 1000

Rows = NDArray[np.float32] | NDArray[np.float64]


def compute_square_distances(first: Rows, second: Rows | None = None) -> Array:
    """Return the squared distances of all rows of `first` to all rows of `second`.

    Products are added up over blocks of columns. Those of wide float32 rows are in float32; rows of
    up to 1024 numbers are compared in float64, because a kernel of near-equal rows is positive
    only if their distances are exact.

    Parameters
    ----------
    first, second
        Shapes (M, d) and (N, d); `second` is `first` if None, and distances to itself are zero.

    Returns
    -------
    Array
        Shape (M, N), never negative.
    """
    other = first if second is None else second
    # Distances don't change when both are moved, and small numbers lose fewer digits.
    centre = other.mean(axis=0)
    if first.shape[1] <= EXACT_COLUMNS:
        first, other = first.astype(np.float64), other.astype(np.float64)
    total = np.zeros((len(first), len(other)))
    for start in range(0, first.shape[1], BLOCK_COLUMNS):
        part = slice(start, start + BLOCK_COLUMNS)
        a: Rows = first[:, part] - centre[part]
        b: Rows = a if second is None else other[:, part] - centre[part]
        total -= 2.0 * (a @ b.T)
        total += np.einsum("ij,ij->i", a, a, dtype=np.float64)[:, None]
        total += np.einsum("ij,ij->i", b, b, dtype=np.float64)
    np.maximum(total, 0.0, out=total)
    if second is None:
        np.fill_diagonal(total, 0.0)
    return total


def compute_kernel(square_distance: Array, gamma: float) -> Array:
    """Return ``exp(-gamma * square_distance)``, of the same shape."""
    return np.asarray(np.exp(-gamma * square_distance))


def find_median_square(square_distance: Array) -> float:
    """Return the median squared distance between different rows, at least 1e-12.

    Parameters
    ----------
    square_distance
        Shape (N, N); of many rows an evenly spaced part is looked at.
    """
    step = max(1, len(square_distance) // MEDIAN_ROWS)
    part = square_distance[::step, ::step]
    values = part[~np.eye(len(part), dtype=bool)]
    return max(float(np.median(values)), 1e-12) if values.size else 1.0
