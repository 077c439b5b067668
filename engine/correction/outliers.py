"""Joints that are in a wrong place: which links say so, and which joint is to blame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.correction.jumps import find_bumps
from engine.correction.links import Links, find_edges, find_excursions
from engine.correction.robust import frame_interval_s, odd_window, running_median, widen
from engine.datatypes import Array
from engine.skeletons import Skeleton

__all__ = ["LOST_SHARE", "OutlierFindings", "find_outliers"]

LOST_SHARE = 0.6
"""From this share of the links on (six of ten) the person is lost, not one joint."""

LIMBS = (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
LIMB_LINKS = {"hip": ("pelvis_width", "thigh", "shank")} | {
    "shoulder": ("shoulder_width", "upper_arm", "forearm")
}
BEYOND = {"ankle": ("heel", "big_toe", "small_toe"), "wrist": ("pinky", "index", "thumb")}
"""Keypoints that hang on the end of a limb and go with it."""


@dataclass(frozen=True, eq=False)
class OutlierFindings:
    """What the link lengths say.

    Parameters
    ----------
    is_misdetected
        Shape (T, K): this joint, or one nearer to the trunk, is in a wrong place.
    is_lost
        Shape (T,): most links are wrong at once.
    is_jitter
        Shape (T, J): short alternating jumps; smoothing is all they need.
    is_flagged
        Shape (T, J): the link has a wrong length.
    is_unsteady
        Shape (J,): the link is wrong most of the time.
    """

    is_misdetected: NDArray[np.bool_]
    is_lost: NDArray[np.bool_]
    is_jitter: NDArray[np.bool_]
    is_flagged: NDArray[np.bool_]
    is_unsteady: NDArray[np.bool_]

    @property
    def is_rejected(self) -> NDArray[np.bool_]:
        """Shape (T, K): every sample to delete."""
        return self.is_misdetected | self.is_lost[:, None]


def find_outliers(
    time_s: Array, position: Array, links: Links, skeleton: Skeleton
) -> OutlierFindings:
    """Find misdetected joints, jitter and the loss of the person.

    A joint that jumps away and back is wrong by itself (`find_bumps`). From link lengths, only the
    joint that explains the wrong links is blamed, with the joints beyond it on the same
    limb: a wrong forearm alone is the wrist's fault, forearm and upper arm together the
    elbow's, upper arm and shoulder width together the shoulder's.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    position
        Shape (T, K, D), any unit.
    links
        Lengths measured on `position`.
    skeleton
        Names of the keypoints.

    Returns
    -------
    OutlierFindings
        Nothing found if the skeleton has no links.
    """
    edges = find_edges(time_s, links.length_cm)
    flagged, _ = find_excursions(time_s, links.length_cm, edges)
    n_links = np.isfinite(links.length_cm).sum(axis=1)
    is_lost = (n_links > 0) & (flagged.sum(axis=1) >= np.maximum(LOST_SHARE * n_links, 2))
    misdetected = np.zeros(position.shape[:2], dtype=bool)
    names = {name: flagged[:, j] for j, name in enumerate(links.names)}
    deviation = _deviation(time_s, position)
    misdetected |= find_bumps(time_s, position * (links.scale_cm / 100.0)[:, None, None], skeleton)
    for root, middle, end in LIMBS:
        for side in ("left", "right"):
            chain = (f"{side}_{root}", f"{side}_{middle}", f"{side}_{end}")
            if all(name in skeleton.keypoints for name in chain):
                _blame_limb(misdetected, names, chain, skeleton, deviation)
    rejected = misdetected | is_lost[:, None]
    explained = flagged | rejected[:, links.ends].any(axis=2) | ~np.isfinite(links.length_cm)
    return OutlierFindings(
        is_misdetected=misdetected & ~is_lost[:, None],
        is_lost=is_lost,
        is_jitter=edges.is_edge & ~widen(explained, 1),
        is_flagged=flagged,
        is_unsteady=edges.is_unsteady,
    )


def _deviation(time_s: Array, position: Array) -> Array:
    """Return how far each joint is from its running median of half a second; shape (T, K)."""
    window = odd_window(0.5, frame_interval_s(time_s))
    series = position.reshape(len(position), position.shape[1] * position.shape[2])
    residual = (series - running_median(series, window)).reshape(position.shape)
    return np.asarray(np.linalg.norm(residual, axis=2))


def _blame_limb(
    misdetected: NDArray[np.bool_],
    flagged: dict[str, NDArray[np.bool_]],
    chain: tuple[str, str, str],
    skeleton: Skeleton,
    deviation: Array,
) -> None:
    """Mark the joints of one limb that explain its wrong links, in place."""
    side, root = chain[0].split("_", 1)
    width_name, near_name, far_name = LIMB_LINKS[root]
    quiet = np.zeros(len(misdetected), dtype=bool)
    width = flagged.get(width_name, quiet)
    near = flagged.get(f"{side}_{near_name}", quiet)
    far = flagged.get(f"{side}_{far_name}", quiet)
    other = "right" if side == "left" else "left"
    here, there = (deviation[:, skeleton.index(f"{s}_{root}")] for s in (side, other))
    neighbours = near | flagged.get(f"{other}_{near_name}", quiet)
    # A width alone doesn't say which of its two ends is wrong; the one out of place is.
    is_root = width & (near | (~neighbours & (here >= there)))
    is_middle = near & ~is_root
    is_end = far & ~near & ~is_root
    for marked, joints in ((is_root, chain), (is_middle, chain[1:]), (is_end, chain[2:])):
        for name in (*joints, *_beyond(chain[2])):
            if name in skeleton.keypoints:
                misdetected[marked, skeleton.index(name)] = True


def _beyond(end: str) -> tuple[str, ...]:
    side, part = end.split("_", 1)
    return tuple(f"{side}_{name}" for name in BEYOND[part])
