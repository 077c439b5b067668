"""How far a landmark in one picture may be from the joint it names.

A pose network also draws joints that it can't see: behind the trunk, behind the other leg, behind
the load. Its confidence tells part of it (it doubts far elbows and wrists, never far shoulders and
hips); whether the body itself is in the way tells the rest. Errors are metres at the person: a
network works on the cut-out person, whatever the camera's resolution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from engine.datatypes import Array

__all__ = ["LandmarkNoise", "find_hidden", "landmark_sigma_m"]


@dataclass(frozen=True)
class LandmarkNoise:
    """Standard errors of a kind of landmark, per coordinate in the picture, m at the person.

    `clear_m` where it is seen well; `hidden_m` is added (as variance) where the body is in the
    way, `unsure_m` where the network has no confidence at all.
    """

    clear_m: float
    hidden_m: float
    unsure_m: float


NOISE: Mapping[str, LandmarkNoise] = {
    "shoulder": LandmarkNoise(0.014, 0.060, 0.060),
    "elbow": LandmarkNoise(0.012, 0.050, 0.045),
    "wrist": LandmarkNoise(0.009, 0.040, 0.085),
    "hip": LandmarkNoise(0.016, 0.020, 0.040),
    "knee": LandmarkNoise(0.011, 0.040, 0.010),
    "ankle": LandmarkNoise(0.010, 0.030, 0.010),
    "heel": LandmarkNoise(0.012, 0.030, 0.010),
    "big_toe": LandmarkNoise(0.014, 0.040, 0.015),
    "ear": LandmarkNoise(0.014, 0.040, 0.040),
}
OTHER_NOISE = LandmarkNoise(0.016, 0.040, 0.060)

LIMB_COVER = 0.3
_SIDES = ("left", "right")
_CAPSULES: tuple[tuple[tuple[str, ...], tuple[str, ...], float, float], ...] = (
    (("left_hip", "right_hip"), ("left_shoulder", "right_shoulder"), 0.130, 1.0),
    *(
        ((f"{side}_{a}",), (f"{side}_{b}",), radius, LIMB_COVER)
        for a, b, radius in (
            ("hip", "knee", 0.075),
            ("knee", "ankle", 0.055),
            ("shoulder", "elbow", 0.050),
            ("elbow", "wrist", 0.040),
        )
        for side in _SIDES
    ),
)
"""Ends (middles of the named points) and radius, m, of what of a body can be in the way."""
_BEYOND = {
    "heel": "ankle",
    "big_toe": "ankle",
    "index": "wrist",
    "pinky": "wrist",
    "thumb": "wrist",
}


def find_hidden(names: Sequence[str], points: Array, centre: Array) -> Array:
    """Return how much the body hides each point from a camera, 0 to 1.

    Parameters
    ----------
    names
        The P points.
    points
        Shape (P, 3, T), m.
    centre
        Shape (3,), m: where the camera is.

    Returns
    -------
    Array
        Shape (P, T).
    """
    place = {name: points[i] for i, name in enumerate(names)}
    hidden = np.zeros((len(names), points.shape[2]))
    for start, stop, radius, cover in _CAPSULES:
        a, b = (np.mean([place[n] for n in ends], axis=0) for ends in (start, stop))
        chosen = [i for i, name in enumerate(names) if not _belongs(name, (*start, *stop))]
        distance, behind = _pass_by(centre, points[chosen], a, b)
        in_the_way = np.clip(1.5 - distance / (0.5 * radius) + 1.0, 0.0, 1.0)
        is_behind = np.clip((behind / radius - 0.7) / 0.3, 0.0, 1.0)
        hidden[chosen] = np.maximum(hidden[chosen], cover * in_the_way * is_behind)
    return hidden


def _belongs(name: str, ends: tuple[str, ...]) -> bool:
    """Whether a point is an end of a limb, or sits on that end."""
    if len(ends) > 2:  # the trunk is wide: it does hide the joints of its far side
        return False
    side, _, part = name.partition("_")
    return name in ends or f"{side}_{_BEYOND.get(part, '')}" in ends


def _pass_by(centre: Array, points: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """Return how close lines of sight pass by the line a to b, and how far before the point.

    Points have shape (P, 3, T), ends (3, T); results (P, T), m.
    """
    sight = points - centre[:, None]
    line, offset = b - a, centre[:, None] - a
    sight_square = np.einsum("pct,pct->pt", sight, sight)
    line_square = np.maximum(np.einsum("ct,ct->t", line, line), 1e-9)
    across = np.einsum("pct,ct->pt", sight, line)
    along_line = np.einsum("ct,ct->t", line, offset)
    along_sight = np.einsum("pct,ct->pt", sight, offset)
    span = np.maximum(sight_square * line_square - across**2, 1e-9)
    s = np.clip((across * along_line - along_sight * line_square) / span, 0.0, 1.0)
    u = np.clip((across * s + along_line) / line_square, 0.0, 1.0)
    s = np.clip((across * u - along_sight) / np.maximum(sight_square, 1e-9), 0.0, 1.0)
    gap = offset + s[:, None] * sight - u[:, None] * line
    return np.linalg.norm(gap, axis=1), (1.0 - s) * np.sqrt(sight_square)


def landmark_sigma_m(names: Sequence[str], confidence: Array, hidden: Array) -> Array:
    """Return the standard error of landmarks, m at the person, shape (P, T).

    Parameters
    ----------
    names
        The P points.
    confidence
        Shape (P, T), 0 to 1; NaN counts as full.
    hidden
        Shape (P, T), as `find_hidden` returns it.
    """
    noise = [
        NOISE.get(name.removeprefix("left_").removeprefix("right_"), OTHER_NOISE) for name in names
    ]
    clear, behind, unsure = (
        np.array([getattr(n, field) for n in noise])[:, None]
        for field in ("clear_m", "hidden_m", "unsure_m")
    )
    doubt = 1.0 - np.where(np.isfinite(confidence), confidence, 1.0)
    return np.asarray(np.sqrt(clear**2 + (behind * hidden) ** 2 + (unsure * doubt) ** 2))
