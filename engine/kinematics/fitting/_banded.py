"""Linear algebra of a clip: one block of unknowns a frame, neighbours linked by smoothness.

The smoothness of a curve is the integral of its squared second derivative, so every frame is
linked with the next two. Ordered frame by frame the system is a band, and solving it takes time
in proportion to the number of frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from engine.datatypes import Array

__all__ = ["BandedFactor", "Roughness", "factorise", "make_roughness"]


@dataclass(frozen=True, eq=False)
class Roughness:
    """The quadratic form that measures how rough the curves of a clip are.

    `bands`, shape (3, T, n), holds the links of the unknowns of every frame with themselves, the
    same ones in the next frame, and in the one after.
    """

    bands: Array

    def apply(self, state: Array) -> Array:
        """Multiply by the curves: half the gradient of the cost; shapes (T, n)."""
        own, following, after = self.bands
        product = own * state
        product[:-1] += following[:-1] * state[1:]
        product[1:] += following[:-1] * state[:-1]
        product[:-2] += after[:-2] * state[2:]
        product[2:] += after[:-2] * state[:-2]
        return np.asarray(product)


def make_roughness(time_s: Array, weight: Array) -> Roughness:
    """Build the roughness of curves sampled at any times.

    Parameters
    ----------
    time_s
        Shape (T,), increasing; the spacing may vary.
    weight
        Shape (T, n): one over the power density of the second derivative that is expected of each
        unknown around each frame, s^3 over its unit squared.

    Notes
    -----
    The second derivative at a frame is that of the parabola through it and its neighbours, and
    counts for half the time between them.
    """
    bands = np.zeros((3, *weight.shape))
    if time_s.size >= 3:
        before, after = np.diff(time_s)[:-1], np.diff(time_s)[1:]
        span = before + after
        share = (span / 2)[:, None] * weight[1:-1]
        a, b, c = (
            part[:, None]
            for part in (2 / (before * span), -2 / (before * after), 2 / (after * span))
        )
        bands[0, :-2] += share * a * a
        bands[0, 1:-1] += share * b * b
        bands[0, 2:] += share * c * c
        bands[1, :-2] += share * a * b
        bands[1, 1:-1] += share * b * c
        bands[2, :-2] += share * a * c
    return Roughness(bands)


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """The Cholesky factor of a clip's system, in LAPACK's lower band storage."""

    band: Array
    n_frames: int
    n_unknowns: int

    def solve(self, right_side: Array) -> Array:
        """Solve for one or several right sides of shape (T, n) or (T, n, R)."""
        flat = right_side.reshape(self.n_frames * self.n_unknowns, -1)
        solution, info = lapack.dpbtrs(self.band, np.asfortranarray(flat), lower=1)
        if info != 0:
            raise np.linalg.LinAlgError(f"dpbtrs failed with code {info}.")
        return np.asarray(solution).reshape(right_side.shape)

    def invert_blocks(self) -> Array:
        """Return the diagonal blocks of the inverse, shape (T, n, n).

        The inverse of a band is full, but its diagonal blocks follow from the factor alone, from
        the last frame backwards, two frames at a time.

        References
        ----------
        .. [1] Takahashi, Fagan & Chin (1973), Formation of a sparse bus impedance matrix.
        """
        size = 2 * self.n_unknowns
        n_pairs = (self.n_frames + 1) // 2
        own, below = self._dense_pairs(size, n_pairs)
        blocks = np.empty((n_pairs, size, size))
        inverse = np.zeros((size, size))
        for i in range(n_pairs - 1, -1, -1):
            triangle, _ = lapack.dtrtri(own[i], lower=1)
            if i == n_pairs - 1:
                inverse = triangle.T @ triangle
            else:
                link = below[i] @ triangle
                inverse = triangle.T @ triangle + link.T @ inverse @ link
            blocks[i] = inverse
        n = self.n_unknowns
        parts = np.stack([blocks[:, :n, :n], blocks[:, n:, n:]], axis=1)
        return parts.reshape(-1, n, n)[: self.n_frames]

    def _dense_pairs(self, size: int, n_pairs: int) -> tuple[Array, Array]:
        """Return the factor's blocks of two frames: on the diagonal, and below it."""
        band = self.band
        missing = n_pairs * size - band.shape[1]
        if missing:  # an odd last frame gets a partner that is linked with nothing
            pad = np.zeros((band.shape[0], missing))
            pad[0] = 1.0
            band = np.concatenate([band, pad], axis=1)
        columns = band.T.reshape(n_pairs, size, band.shape[0])
        row, col = np.tril_indices(size)
        own = np.zeros((n_pairs, size, size))
        own[:, row, col] = columns[:, col, row - col]
        upper_row, upper_col = np.triu_indices(size)
        below = np.zeros((n_pairs, size, size))
        below[:, upper_row, upper_col] = columns[:, upper_col, size + upper_row - upper_col]
        return own, below


def factorise(blocks: Array, roughness: Roughness) -> BandedFactor | None:
    """Factorise the system of a clip: a block a frame, plus the roughness.

    Parameters
    ----------
    blocks
        Shape (T, n, n), symmetric.
    roughness
        Of the same frames and unknowns.

    Returns
    -------
    BandedFactor or None
        None where the system isn't positive definite.
    """
    n_frames, n, _ = blocks.shape
    # One row a column of the system, which is LAPACK's storage when seen transposed.
    band = np.zeros((n_frames, n, 2 * n + 1))
    row, col = np.tril_indices(n)
    band[:, col, row - col] = blocks[:, row, col]
    for step, link in enumerate(roughness.bands):
        band[:, :, step * n] += link
    factor, info = lapack.dpbtrf(band.reshape(n_frames * n, 2 * n + 1).T, lower=1, overwrite_ab=1)
    return BandedFactor(factor, n_frames, n) if info == 0 else None
