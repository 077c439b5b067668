"""A low-pass filter over the frames of one clip."""

from __future__ import annotations

from typing import Final

import numpy as np

from engine.datatypes import Array

__all__ = ["CUTOFFS_HZ", "smooth_poses"]

CUTOFFS_HZ: Final = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
MIN_FRAMES: Final = 12
_TWO_PASSES: Final = (np.sqrt(2.0) - 1.0) ** 0.25
"""What a second-order Butterworth's cut-off shrinks by when it is run forth and back."""


def smooth_poses(pose: Array, *, rate_hz: float, cutoff_hz: float | None) -> Array:
    """Filter consecutive frames by a zero-lag Butterworth filter of fourth order in total.

    Parameters
    ----------
    pose
        Shape (T, D). Frames with NaN are left out and stay NaN; the filter runs over each
        stretch between them, and one of fewer than 12 frames stays as it is.
    rate_hz
        Frames per second.
    cutoff_hz
        Where the gain of both passes together is 0.71; None, or more than 0.45 of the rate, filters
        nothing.
    """
    if cutoff_hz is None or cutoff_hz / _TWO_PASSES >= 0.5 * rate_hz:
        return np.array(pose)
    from scipy import signal  # takes a second to import

    sos = signal.butter(2, cutoff_hz / _TWO_PASSES, fs=rate_hz, output="sos")
    smooth = np.array(pose)
    known = np.isfinite(pose).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start >= MIN_FRAMES:
            pad = min(stop - start - 1, int(rate_hz))
            smooth[start:stop] = signal.sosfiltfilt(sos, pose[start:stop], axis=0, padlen=pad)
    return smooth
