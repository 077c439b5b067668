"""The figure against two pictures: what the landmarks of all views pull on it.

Beside the landmarks in the pictures there may be differences in depth (what a network believes) and
fixed places in space (a foot that stands).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Camera
from engine.kinematics.fitting._clip import ClipProblem, Pull
from engine.kinematics.humanoid.model import to_world_axes
from engine.optics import project, projection_jacobian

__all__ = ["DepthBeliefs", "PictureProblem", "turn_to_model_axes"]

_LEAST = 1e-4
"""Least information, 1/m^2, in any direction: nothing beside a metre's."""


def turn_to_model_axes(camera: Camera) -> Camera:
    """Return the camera as seen from the figure's axes instead of the world's."""
    return replace(camera, rotation=camera.rotation @ to_world_axes(np.eye(3)).T)


@dataclass(frozen=True, eq=False)
class DepthBeliefs:
    """How much further than another a point is believed to be from a camera.

    `ends` has shape (S, 2), places among the figure's points; `axes` (V, 3), the cameras' axes in
    those of the figure; `depth` (V, S, T), m, second end minus first; `weight` (V, S, T), 1/m^2,
    zero where nothing is believed.
    """

    ends: NDArray[np.intp]
    axes: Array
    depth: Array
    weight: Array


@dataclass(frozen=True, eq=False)
class PictureProblem(ClipProblem):
    """A clip seen by V cameras.

    The targets of the `ClipProblem` are places in space here, where something is known of them: a
    foot that stands.

    Parameters
    ----------
    cameras
        In the figure's axes.
    pixel, pixel_weight
        Shape (V, P, T, 2), px, and (V, P, T), 1/px^2: zero where a landmark is missing (the pixel
        is then any number).
    beliefs
        What the network says of depth; None for nothing.
    softness
        Distance in standard errors from which a landmark counts less.
    is_fading
        Whether the pull of a landmark further off falls again, towards nothing; otherwise it stays
        the same, which finds the way from a poor first guess.
    """

    cameras: tuple[Camera, ...]
    pixel: Array
    pixel_weight: Array
    beliefs: DepthBeliefs | None = None
    softness: float = 2.5
    is_fading: bool = False

    def weigh(self, points: Array, part: slice) -> Pull:
        """Compare points of shape (P, 3, t) with what was seen in a part of the frames."""
        information, gradient, misfit = self._weigh_pictures(points, part)
        misfit += self._weigh_held(points, part, information, gradient)
        root = _factor(information)
        residual = _substitute(root, gradient).reshape(-1, points.shape[2])
        depths = None if self.beliefs is None else self._weigh_depths(self.beliefs, points, part)

        def carry(slope: Array) -> Array:
            rows = np.empty_like(slope)
            for i in range(3):
                np.multiply(root[i][i][:, None], slope[:, i], out=rows[:, i])
                for j in range(i + 1, 3):
                    rows[:, i] += root[j][i][:, None] * slope[:, j]
            rows = rows.reshape(-1, *slope.shape[2:])
            return rows if depths is None else np.concatenate([rows, depths.carry(slope)])

        if depths is None:
            return Pull(residual, misfit, carry)
        return Pull(np.concatenate([residual, depths.residual]), misfit + depths.misfit, carry)

    def weigh_pictures(self, points: Array) -> tuple[Array, Array]:
        """Return what the pictures say of points (P, 3, T), one by one.

        Information, shape (P, 3, 3, T), 1/m^2, and gradient, (P, 3, T), 1/m.
        """
        return self._weigh_pictures(points, slice(None))[:2]

    def project(self, state: Array) -> Array:
        """Return where the figure's points are in the pictures, shape (V, P, T, 2), px."""
        place = np.moveaxis(self.place(state), 1, 2)
        return np.stack([project(camera, place) for camera in self.cameras])

    def measure_distance(self, state: Array) -> Array:
        """Return how far landmarks are from the figure, in standard errors, shape (V, P, T).

        Zero where a landmark is missing.
        """
        square = np.sum((self.project(state) - self.pixel) ** 2, axis=3)
        return np.asarray(np.sqrt(np.nan_to_num(self.pixel_weight * square)))

    def _weigh_pictures(self, points: Array, part: slice) -> tuple[Array, Array, Array]:
        """Return information (P, 3, 3, t), gradient (P, 3, t) and misfit (t,) of the pictures."""
        place = np.moveaxis(points, 1, 2)
        residual, weight, misfit = self._look(place, part)
        slopes = np.stack([projection_jacobian(camera, place) for camera in self.cameras])
        slopes = np.moveaxis(np.nan_to_num(slopes), 2, 4)
        pulled = slopes * weight[:, :, None, None]
        information = np.einsum("vpait,vpajt->pijt", pulled, slopes)
        gradient = np.einsum("vpait,vpta->pit", pulled, residual)
        return information, gradient, misfit

    def _look(self, place: Array, part: slice) -> tuple[Array, Array, Array]:
        """Return residuals (V, P, t, 2) of points (P, t, 3), their robust weights and the loss."""
        seen = np.stack([project(camera, place) for camera in self.cameras])
        residual = np.nan_to_num(seen - self.pixel[:, :, part])
        weight = np.where(np.isfinite(seen).all(axis=3), self.pixel_weight[:, :, part], 0.0)
        distance = np.sqrt(weight * np.sum(residual**2, axis=3))
        loss = _fade if self.is_fading else _huber
        share, cost = loss(distance, self.softness)
        return residual, weight * share, cost.sum(axis=(0, 1))

    def _weigh_held(self, points: Array, part: slice, information: Array, gradient: Array) -> Array:
        held = np.flatnonzero(self.weight.any(axis=1))
        residual = points[held] - self.target[held][:, :, part]
        weight = self.weight[held][:, part]
        distance = np.sqrt(weight * np.einsum("pct,pct->pt", residual, residual))
        share, loss = _huber(distance, self.huber)
        weight = weight * share
        for axis in range(3):
            information[held, axis, axis] += weight
        gradient[held] += weight[:, None] * residual
        return np.asarray(loss.sum(axis=0))

    def _weigh_depths(self, beliefs: DepthBeliefs, points: Array, part: slice) -> Pull:
        first, last = beliefs.ends.T
        depth = np.einsum("pct,vc->vpt", points, beliefs.axes)
        residual = depth[:, last] - depth[:, first] - beliefs.depth[:, :, part]
        weight = beliefs.weight[:, :, part]
        share, loss = _huber(np.sqrt(weight) * np.abs(residual), self.huber)
        pull = np.sqrt(weight * share)

        def carry(slope: Array) -> Array:
            rows = []
            for (x, y, z), strength in zip(beliefs.axes, pull, strict=True):
                deeper = x * slope[:, 0] + y * slope[:, 1] + z * slope[:, 2]
                rows.append((deeper[last] - deeper[first]) * strength[:, None])
            return np.concatenate(rows)

        rows = (residual * pull).reshape(-1, points.shape[2])
        return Pull(rows, loss.sum(axis=(0, 1)), carry)

    def count_samples(self) -> Array:
        """Return how many numbers were seen in every frame, shape (T,)."""
        return np.asarray(2.0 * (self.pixel_weight > 0).sum(axis=(0, 1)))

    def compare(self, state: Array) -> Array:
        """Return the residuals (R, T) at a state (T, n) as the loss counts them."""
        residual, weight, _ = self._look(np.moveaxis(self.place(state), 1, 2), slice(None))
        rows = np.moveaxis(residual * np.sqrt(weight)[..., None], 3, 2)
        return np.asarray(rows.reshape(-1, rows.shape[3]))


def _factor(information: Array) -> list[list[Array]]:
    """Return the Cholesky factor of (P, 3, 3, t) as lists of its entries by row and column."""
    lower: list[list[Array]] = [[], [], []]
    for i in range(3):
        for j in range(i + 1):
            rest = information[:, i, j] - sum(
                (lower[i][k] * lower[j][k] for k in range(j)), start=np.zeros(1)
            )
            if i == j:
                # A point seen by nobody, or by one camera, leaves directions free.
                lower[i].append(np.sqrt(np.maximum(rest, _LEAST)))
            else:
                lower[i].append(rest / lower[j][j])
    return lower


def _substitute(lower: list[list[Array]], right: Array) -> Array:
    """Solve with the lower factor for (P, 3, t)."""
    answer = np.empty_like(right)
    for i in range(3):
        known = sum((lower[i][k] * answer[:, k] for k in range(i)), start=np.zeros(1))
        answer[:, i] = (right[:, i] - known) / lower[i][i]
    return answer


def _huber(distance: Array, limit: float) -> tuple[Array, Array]:
    """Return the share of its weight that a residual keeps, and its loss."""
    is_far = distance > limit
    loss = np.where(is_far, limit * (2.0 * distance - limit), distance**2)
    return np.where(is_far, limit / np.maximum(distance, 1e-9), 1.0), loss


def _fade(distance: Array, limit: float) -> tuple[Array, Array]:
    """Return the same for a loss that grows ever more slowly (Cauchy)."""
    ratio = (distance / limit) ** 2
    return 1.0 / (1.0 + ratio), limit**2 * np.log1p(ratio)
