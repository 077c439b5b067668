"""The sampler of D3DP: from noise to postures in a few steps (Shan et al. 2023).

The network says what the joints are without the noise; the implicit sampler (DDIM, Song et al.
2021) goes from one noise level to the next.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array

__all__ = ["CLAMP", "N_STEPS", "cosine_schedule", "sample_postures", "step_times"]

N_STEPS = 1000
_OFFSET = 0.008
_LARGEST_FALL = 0.999
CLAMP = 1.1
"""Largest coordinate of a joint that is believed, as published."""

Denoiser = Callable[[Array, int], Array]
"""Takes noisy joints (..., 3) and the step, gives joints without noise."""


def cosine_schedule(n_steps: int = N_STEPS) -> Array:
    """Return the share of the signal's variance that is left at each step.

    Returns
    -------
    Array
        Shape (n_steps,), falling from about 1 to about 0.

    References
    ----------
    .. [1] Nichol, Dhariwal (2021), Improved denoising diffusion probabilistic models, Eq. 17.
    """
    time = np.linspace(0.0, 1.0, n_steps + 1)
    curve = np.cos((time + _OFFSET) / (1 + _OFFSET) * np.pi / 2) ** 2
    return np.cumprod(1.0 - np.minimum(1.0 - curve[1:] / curve[:-1], _LARGEST_FALL))


def step_times(n_steps: int, n_taken: int) -> NDArray[np.intp]:
    """Return the noise steps to visit, from the noisiest on; the last, -1, is without noise."""
    return np.linspace(-1, n_steps - 1, n_taken + 1).astype(np.intp)[::-1]


def sample_postures(
    denoise: Denoiser,
    shape: tuple[int, ...],
    *,
    steps: int,
    rng: np.random.Generator,
    eta: float = 1.0,
    clamp: float = CLAMP,
) -> Array:
    """Draw postures.

    Parameters
    ----------
    denoise
        The network.
    shape
        Of the joints, (..., 3).
    steps
        How many times the network is asked; at least 1.
    rng
        Draws the noise.
    eta
        Share of the noise that is drawn anew at each step; 1 as published.
    clamp
        Largest coordinate believed.

    Returns
    -------
    Array
        The joints of the last step, of the given shape.
    """
    kept = cosine_schedule()
    noisy = rng.standard_normal(shape)
    times = step_times(N_STEPS, steps)
    joints = noisy
    for now, then in pairwise(times):
        joints = np.clip(denoise(noisy, int(now)), -clamp, clamp)
        if then < 0:
            break
        a, b = kept[now], kept[then]
        noise = (noisy / np.sqrt(a) - joints) / np.sqrt(1.0 / a - 1.0)
        fresh = eta * np.sqrt((1.0 - a / b) * (1.0 - b) / (1.0 - a))
        noisy = (
            np.sqrt(b) * joints
            + np.sqrt(np.maximum(1.0 - b - fresh**2, 0.0)) * noise
            + fresh * rng.standard_normal(shape)
        )
    return np.asarray(joints)
