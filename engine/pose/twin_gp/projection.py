"""Fewer numbers for the same distances: principal components, and a scale for each block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import ShapeError
from engine.pose.twin_gp.kernels import compute_square_distances, find_median_square

__all__ = ["BlockProjection", "fit_projection"]

MAX_DIMENSIONS: Final = 300
FIT_ROWS: Final = 900
"""Of this many frames, evenly spaced, the components are found."""


@dataclass(frozen=True, eq=False)
class BlockProjection:
    """How one block of features is compressed.

    Parameters
    ----------
    mean
        Shape (d,).
    components
        Shape (d, k), orthonormal columns; None keeps all d numbers.
    scale
        What each number is multiplied by, so that the median squared distance between training
        frames is 1.
    """

    mean: NDArray[np.float32]
    components: NDArray[np.float32] | None
    scale: float

    @property
    def width(self) -> int:
        """How many numbers go in."""
        return len(self.mean)

    def apply(self, block: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the compressed block, shape (N, k)."""
        centred = block - self.mean
        if self.components is not None:
            centred = centred @ self.components
        return np.asarray(centred * np.float32(self.scale), dtype=np.float32)


def fit_projection(
    features: NDArray[np.float32], blocks: Sequence[int]
) -> tuple[BlockProjection, ...]:
    """Learn from training frames how to compress each block of their features.

    Parameters
    ----------
    features
        Shape (N, D).
    blocks
        Widths that add up to D.

    Raises
    ------
    ShapeError
        If they don't.
    """
    if features.ndim != 2 or sum(blocks) != features.shape[1]:
        raise ShapeError(
            f"Expected features of {sum(blocks)} numbers (blocks {', '.join(map(str, blocks))}), "
            f"got shape {features.shape}."
        )
    edges = np.cumsum([0, *blocks])
    return tuple(_fit_block(features[:, a:b]) for a, b in pairwise(edges))


def _fit_block(block: NDArray[np.float32]) -> BlockProjection:
    part = block[:: max(1, len(block) // FIT_ROWS)]
    mean = part.mean(axis=0)
    components = _find_components(part - mean) if block.shape[1] > MAX_DIMENSIONS else None
    plain = BlockProjection(mean, components, 1.0)
    median = find_median_square(compute_square_distances(plain.apply(part)))
    return BlockProjection(mean, components, float(1.0 / np.sqrt(median)))


def _find_components(centred: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the leading principal directions, by the smaller of the two products."""
    gram: Array = (centred @ centred.T).astype(np.float64)
    value, vector = np.linalg.eigh(gram)
    order = np.argsort(value)[::-1][:MAX_DIMENSIONS]
    order = order[value[order] > 1e-9 * value[order[0]]]
    weights = (vector[:, order] / np.sqrt(value[order])).astype(np.float32)
    return np.ascontiguousarray(centred.T @ weights)
