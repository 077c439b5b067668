"""What the views show, in arrays; and which of its names are exchanged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_propagation, uniform_filter1d

from engine.datatypes import Array, ViewPose
from engine.kinematics.fusion._pictures import PictureProblem
from engine.skeletons import Skeleton

__all__ = ["Sight", "find_exchanged", "list_exchanges", "look_at"]

ARMS = ("shoulder", "elbow", "wrist", "pinky", "index", "thumb")
LEGS = ("hip", "knee", "ankle", "heel", "big_toe")
FARTHEST = 25.0
"""Squared distance, in standard errors, beyond which a landmark fits no worse: it is astray."""
WINDOW_S = 0.17
MIN_GAIN = 60.0
"""What exchanging names must gain in a frame, alone and with its neighbours. Exchanged names gain
up to `FARTHEST` a landmark; a poor guess of a hidden limb may gain a little by chance."""
MAX_LEFT = 12.0
"""What may be left a landmark after the exchange, on average: right names fit, if only as well as
the figure is known there."""


@dataclass(frozen=True, eq=False)
class Sight:
    """What V views show of K keypoints in T frames.

    `pixel` has shape (V, K, T, 2), `confidence` (V, K, T); `depth` (V, K, T), m, is what the
    network believes of the distance along the camera's axis, from the mid-hip. NaN where missing.
    """

    pixel: Array
    confidence: Array
    depth: Array

    def choose(self, columns: Sequence[int]) -> Sight:
        """Return some of the keypoints."""
        at = list(columns)
        return Sight(self.pixel[:, at], self.confidence[:, at], self.depth[:, at])

    def relabel(self, exchanged: NDArray[np.intp], orders: NDArray[np.intp]) -> Sight:
        """Exchange names: `exchanged` (V, T) says which of the orders (A, K) holds where."""
        order = np.swapaxes(orders[exchanged], 1, 2)
        return replace(
            self,
            pixel=np.take_along_axis(self.pixel, order[..., None], axis=1),
            confidence=np.take_along_axis(self.confidence, order, axis=1),
            depth=np.take_along_axis(self.depth, order, axis=1),
        )


def look_at(views: Sequence[ViewPose]) -> Sight:
    """Gather the views' landmarks."""
    pixel = np.stack([np.swapaxes(view.image.position, 0, 1) for view in views])
    confidence = np.stack([view.image.confidence.T for view in views])
    missing = np.full(confidence.shape[1:], np.nan)
    depth = [missing if view.body is None else view.body.position[..., 2].T for view in views]
    return Sight(pixel, confidence, np.stack(depth))


def list_exchanges(keypoints: Sequence[str], skeleton: Skeleton) -> NDArray[np.intp]:
    """Return the ways names can be exchanged, as orders of the keypoints, shape (4, K).

    None, all sides, arms only, legs only.
    """
    places = {name: i for i, name in enumerate(keypoints)}
    partner = {skeleton.keypoints[a]: skeleton.keypoints[b] for a, b in skeleton.pairs}
    partner |= {b: a for a, b in partner.items()}
    orders = np.tile(np.arange(len(keypoints)), (4, 1))
    for name, i in places.items():
        other = places.get(partner.get(name, name), i)
        part = name.partition("_")[2]
        orders[1, i] = other
        if part in ARMS:
            orders[2, i] = other
        if part in LEGS:
            orders[3, i] = other
    return orders


def find_exchanged(
    problem: PictureProblem, state: Array, time_s: Array, orders: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Find where a view names left what is right, by what the figure should look like there.

    Parameters
    ----------
    problem
        With the landmarks as the views name them.
    state
        Shape (T, n): the figure, found without the frames in doubt.
    time_s
        Shape (T,).
    orders
        Shape (A, P), from `list_exchanges`; the first exchanges nothing.

    Returns
    -------
    NDArray
        Shape (V, T): places in `orders`.
    """
    expected = problem.project(state)
    cost = []
    for order in orders:
        weight = np.where(problem.pixel_weight[:, order] > 0, problem.pixel_weight, 0.0)
        square = weight * np.sum((problem.pixel[:, order] - expected) ** 2, axis=3)
        cost.append(np.minimum(square, FARTHEST).sum(axis=1))
    gain = cost[0] - np.array(cost)
    n_seen = np.maximum((problem.pixel_weight > 0).sum(axis=1), 1)
    fits = np.array(cost) / n_seen < MAX_LEFT
    window = 1
    if time_s.size > 1:
        window = max(1, round(WINDOW_S / float(np.median(np.diff(time_s)))))
    around = uniform_filter1d(gain, window, axis=2, mode="nearest")
    gains = fits & (gain > MIN_GAIN)
    in_time = np.zeros((3, 3, 3), dtype=bool)
    in_time[1, 1] = True
    # Neighbours vouch for a frame; at the ends of an exchange those on one side do.
    certain = binary_propagation(gains & (around > MIN_GAIN), in_time, mask=gains)
    usable = np.where(certain, gain, -np.inf)
    usable[0] = 0.0
    return np.asarray(usable.argmax(axis=0))
