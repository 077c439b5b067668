"""One number for how alike two performances are, with its uncertainty.

What counts is the part of a difference beyond the measurement error: of every sample of every
angle ``max(0, d^2 - (1.96 s)^2)``, with the difference ``d`` and its standard error ``s``. The
mean over the aligned movement, angles weighted by ``1 / (s^2 + 10^2)``, is the squared excess
difference ``D^2``. The score is ``100 * 2^(-D / 15)``: 100 means that nothing goes beyond the
measurement error, and every 15 degrees that do halve it. It never rises when a difference
grows. It compares posture only; speed is reported beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.datatypes import Array
from engine.errors import ShapeError

__all__ = ["HALVING_DEG", "WEIGHT_FLOOR_DEG", "Score", "angle_weights", "compute_score"]

HALVING_DEG = 15.0
"""A scale, not a finding: clearly different techniques of one lift then score 50 to 80."""
WEIGHT_FLOOR_DEG = 10.0
"""Angles known better than this weigh alike: form is no matter of single degrees."""

COVERAGE_FACTOR = 1.96
SAME = 99.5
"""A score that rounds to 100."""


@dataclass(frozen=True)
class Score:
    """How alike two performances are.

    `value` runs from 0 to 100 with `interval` of about 95 %; `difference_deg` is the
    root mean square difference beyond the measurement error behind it, `raw_difference_deg`
    the one before the error was taken off, `error_deg` what errors alone would give.
    """

    value: float
    interval: tuple[float, float]
    difference_deg: float
    raw_difference_deg: float
    error_deg: float

    @property
    def is_same(self) -> bool:
        """Whether no difference beyond the measurement error was found."""
        return self.interval[1] >= SAME


def angle_weights(sigma_deg: Array) -> Array:
    """Return the weights of the angles, shape (A,), sum 1.

    Parameters
    ----------
    sigma_deg
        Shape (N, A), standard errors of the differences.
    """
    weight = 1.0 / (np.mean(sigma_deg**2, axis=0) + WEIGHT_FLOOR_DEG**2)
    return np.asarray(weight / weight.sum())


def compute_score(difference_deg: Array, sigma_deg: Array) -> Score:
    """Return the score of aligned differences.

    Parameters
    ----------
    difference_deg, sigma_deg
        Shape (N, A) each: attempt minus reference, and the standard error of that. Errors of one
        angle are taken as the same throughout a movement (they come from the camera's place
        and the joints' definition), those of different angles as independent.

    Returns
    -------
    Score
        The interval (about 95 %) follows from the score of differences larger and smaller by
        their errors, angle by angle.

    Raises
    ------
    ShapeError
        If the shapes differ or hold nothing.
    """
    if difference_deg.shape != sigma_deg.shape or difference_deg.ndim != 2:
        raise ShapeError(
            f"Differences and errors need one shape (N, A); got {difference_deg.shape} and "
            f"{sigma_deg.shape}."
        )
    if not difference_deg.size:
        raise ShapeError("A score needs at least one angle and one sample, got none.")
    weight = angle_weights(sigma_deg)
    size, error = np.abs(difference_deg), COVERAGE_FACTOR * sigma_deg
    found = weight * _excess(size, error)
    larger, smaller = _excess(size + error, error), _excess(np.maximum(size - error, 0.0), error)
    # Angles err on their own: what each could add or take joins in squares.
    half = float(np.sqrt(np.sum((0.5 * weight * (larger - smaller)) ** 2)))
    excess = float(found.sum())
    return Score(
        value=_to_score(excess),
        interval=(_to_score(excess + half), _to_score(excess - half)),
        difference_deg=math.sqrt(excess),
        raw_difference_deg=math.sqrt(float(weight @ np.mean(difference_deg**2, axis=0))),
        error_deg=math.sqrt(float(weight @ np.mean(sigma_deg**2, axis=0))),
    )


def _excess(size_deg: Array, error_deg: Array) -> Array:
    """Return the mean squared excess of every angle, shape (A,)."""
    return np.asarray(np.maximum(size_deg**2 - error_deg**2, 0.0).mean(axis=0))


def _to_score(squared: float) -> float:
    return float(100.0 * 2.0 ** (-math.sqrt(max(squared, 0.0)) / HALVING_DEG))
