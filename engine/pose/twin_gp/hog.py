"""Histograms of oriented gradients: scikit-image's, number for number but faster, and a soft kind.

Grey values are whole numbers from 0 to 255, so a gradient is one of 511 x 511 pairs: orientation
bin and magnitude of each are computed once, exactly, and then looked up.

The soft kind changes two things that regression suffers from. A vote is shared between neighbouring
orientations and cells, so that the descriptor changes smoothly when a limb moves by a pixel. And
blocks are divided by the root of their energy plus that of a noise floor: without one a block of
even background, which holds nothing but the noise of the codec, is blown up to full length.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from engine.errors import ConfigError, ShapeError

__all__ = ["HogSettings", "compute_hog", "compute_soft_hog"]

BINS = 9
BLOCK_CELLS = 2
CLIP = 0.2
EPSILON = 1e-5
SUB_CELLS = 4
"""Soft votes are collected in this many strips per cell side and then shared between cells."""
_REACH = 255
_SIDE = 2 * _REACH + 1


@dataclass(frozen=True)
class HogSettings:
    """How a picture is described.

    Nine unsigned orientations, blocks of 2 x 2 cells one cell apart, L2-Hys: the defaults of
    MATLAB's extractHOGFeatures, which Mehrizi et al. (2018) used.

    Parameters
    ----------
    size_px
        Width and height that the part of the picture to describe is scaled to; None takes the
        whole picture as it is.
    cell_px
        Side of a cell.
    noise_floor
        None for the descriptor of scikit-image; otherwise votes are soft and this is the gradient,
        in grey values per two pixels and averaged over a cell, below which a block counts as even.
    """

    size_px: tuple[int, int] | None = (128, 256)
    cell_px: int = 8
    noise_floor: float | None = None

    def __post_init__(self) -> None:
        if self.noise_floor is not None and (self.cell_px % SUB_CELLS or self.noise_floor <= 0):
            raise ConfigError(
                f"Soft HoG needs cells of a multiple of {SUB_CELLS} px and a noise floor above 0, "
                f"got {self.cell_px} px and {self.noise_floor:g}."
            )
        if self.cell_px < 2:
            raise ConfigError(f"A HoG cell needs a side of at least 2 px, got {self.cell_px}.")
        if self.size_px is not None:
            self.length(self.size_px)

    def length(self, size_px: tuple[int, int]) -> int:
        """Return how many numbers describe a picture of `size_px` (width, height)."""
        blocks = [side // self.cell_px - BLOCK_CELLS + 1 for side in size_px]
        if min(blocks) < 1:
            raise ConfigError(
                f"A picture of {size_px[0]} x {size_px[1]} px is too small for blocks of "
                f"{BLOCK_CELLS} x {BLOCK_CELLS} cells of {self.cell_px} px; use smaller cells."
            )
        return blocks[0] * blocks[1] * BLOCK_CELLS**2 * BINS


def compute_hog(grey: NDArray[np.uint8], *, cell_px: int = 8) -> NDArray[np.float32]:
    """Describe a grey picture by histograms of oriented gradients.

    Equal to ``skimage.feature.hog(grey, 9, (cell_px, cell_px), (2, 2), block_norm="L2-Hys")``:
    central differences, each pixel votes with its magnitude for one of nine bins of 20 degrees,
    blocks are normalised, clipped at 0.2 and normalised again.

    Parameters
    ----------
    grey
        Shape (H, W), uint8.
    cell_px
        Side of a cell; pixels beyond the last whole cell are left out.

    Returns
    -------
    NDArray[np.float32]
        Shape (blocks down * blocks across * 36,), ordered as scikit-image orders it.

    Raises
    ------
    ShapeError
        If the picture is not grey with 8 bits.

    References
    ----------
    .. [1] Dalal, Triggs (2005), Histograms of oriented gradients for human detection, CVPR.
    """
    if grey.ndim != 2 or grey.dtype != np.uint8:
        raise ShapeError(
            f"Expected a grey picture (H, W) of uint8, got {grey.dtype} of shape {grey.shape}."
        )
    cells = _vote(grey, cell_px)
    return _normalise_blocks(cells)


def compute_soft_hog(
    grey: NDArray[np.uint8], *, cell_px: int = 16, noise_floor: float = 20.0
) -> NDArray[np.float32]:
    """Describe a grey picture by gradients with votes shared between bins and cells.

    Parameters
    ----------
    grey
        Shape (H, W), uint8.
    cell_px
        Side of a cell, a multiple of 4.
    noise_floor
        See `HogSettings`.

    Returns
    -------
    NDArray[np.float32]
        Of the length and order of `compute_hog`; a block's length is below 1, and near 0 where the
        picture is even.
    """
    if grey.ndim != 2 or grey.dtype != np.uint8:
        raise ShapeError(
            f"Expected a grey picture (H, W) of uint8, got {grey.dtype} of shape {grey.shape}."
        )
    HogSettings(None, cell_px, noise_floor).length((grey.shape[1], grey.shape[0]))
    rows, columns = grey.shape[0] // cell_px, grey.shape[1] // cell_px
    strip = cell_px // SUB_CELLS
    strips = (rows * SUB_CELLS, columns * SUB_CELLS)
    index = _index_gradients(grey)[: rows * cell_px, : columns * cell_px].ravel()
    place = _cell_offsets(*strips, strip).ravel()
    votes = np.zeros(strips[0] * strips[1] * BINS)
    for bins, weight in _soft_tables():
        votes += np.bincount(place + bins.take(index), weight.take(index), votes.size)
    fine = votes.reshape(*strips, BINS) / cell_px**2
    down, across = _share(rows), _share(columns)
    cells = np.einsum("ri,ijb->rjb", down, np.einsum("cj,ijb->icb", across, fine))
    blocks = _join_blocks(cells.astype(np.float32))
    energy = np.einsum("rcf,rcf->rc", blocks, blocks) + noise_floor**2
    return np.asarray(np.minimum(blocks / np.sqrt(energy)[..., None], CLIP).ravel())


@lru_cache(maxsize=1)
def _soft_tables() -> tuple[tuple[NDArray[np.int32], NDArray[np.float32]], ...]:
    """Return the two bins next to every gradient's orientation, with their shares of the vote."""
    steps = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    down, across = np.meshgrid(steps, steps, indexing="ij")
    place = np.rad2deg(np.arctan2(down, across)) % 180 / (180 / BINS) - 0.5
    low = np.floor(place)
    share = place - low
    magnitude = np.hypot(down, across)
    return tuple(
        (
            (low + step).astype(np.int32).ravel() % BINS,
            (magnitude * part).astype(np.float32).ravel(),
        )
        for step, part in ((0, 1 - share), (1, share))
    )


@lru_cache(maxsize=8)
def _share(cells: int) -> NDArray[np.float64]:
    """Return how much of each strip goes to each cell: all at its middle, none a cell away."""
    strip = (np.arange(cells * SUB_CELLS) + 0.5) / SUB_CELLS
    middle = np.arange(cells) + 0.5
    return np.maximum(0.0, 1.0 - np.abs(strip - middle[:, None]))


@lru_cache(maxsize=1)
def _tables() -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return orientation bin and magnitude of every gradient (down, across), flattened."""
    steps = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    down, across = np.meshgrid(steps, steps, indexing="ij")
    degrees = np.rad2deg(np.arctan2(down, across)) % 180
    bins = np.floor(degrees / (180 / BINS)).astype(np.uint8)
    # A tiny negative angle wraps to 180 itself, which belongs to no bin.
    magnitude = np.where(bins < BINS, np.hypot(down, across), 0.0)
    return np.minimum(bins, BINS - 1).ravel(), magnitude.astype(np.float32).ravel()


@lru_cache(maxsize=8)
def _cell_offsets(rows: int, columns: int, cell_px: int) -> NDArray[np.int32]:
    """Return for every pixel of whole cells where the histogram of its cell starts."""
    row = np.arange(rows * cell_px, dtype=np.int32) // cell_px
    column = np.arange(columns * cell_px, dtype=np.int32) // cell_px
    return (row[:, None] * columns + column) * BINS


def _vote(grey: NDArray[np.uint8], cell_px: int) -> NDArray[np.float32]:
    """Return the histograms of all cells, shape (rows, columns, 9)."""
    rows, columns = grey.shape[0] // cell_px, grey.shape[1] // cell_px
    HogSettings(size_px=None, cell_px=cell_px).length((grey.shape[1], grey.shape[0]))
    bins, magnitude = _tables()
    whole = _index_gradients(grey)[: rows * cell_px, : columns * cell_px]
    place = _cell_offsets(rows, columns, cell_px) + bins.take(whole)
    votes = np.bincount(
        place.ravel(), weights=magnitude.take(whole).ravel(), minlength=rows * columns * BINS
    )
    return (votes / cell_px**2).reshape(rows, columns, BINS).astype(np.float32)


def _index_gradients(grey: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return where in the tables each pixel's gradient is, shape (H, W)."""
    value = grey.astype(np.int32)
    index = np.full(grey.shape, _REACH * _SIDE + _REACH, dtype=np.int32)
    index[1:-1] += (value[2:] - value[:-2]) * _SIDE
    index[:, 1:-1] += value[:, 2:] - value[:, :-2]
    return index


def _join_blocks(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the histograms of all blocks of 2 x 2 cells, (rows - 1, columns - 1, 36)."""
    corners = [cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]]
    return np.concatenate(corners, axis=2)


def _normalise_blocks(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    blocks = _join_blocks(cells)
    clipped = np.minimum(blocks / _lengths(blocks), CLIP)
    return np.ascontiguousarray((clipped / _lengths(clipped)).ravel())


def _lengths(blocks: NDArray[np.float32]) -> NDArray[np.float32]:
    energy = np.einsum("rcf,rcf->rc", blocks, blocks) + np.float32(EPSILON**2)
    return np.asarray(np.sqrt(energy)[..., None])
