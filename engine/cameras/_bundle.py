"""Bundle adjustment of two cameras and a person whose bones keep their lengths.

The unknowns are the joints in every chosen frame and a few dozen numbers they share: the
second camera relative to the first, focal lengths, gravity, floor, bone lengths, and where each
view's network places each joint. Frames meet only in the shared numbers, so each step
solves small systems, one a frame (Schur complement), and one for what is shared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from engine.cameras._person import (
    CALIBRATION_JOINTS,
    FEET,
    LINK_KINDS,
    LINKS,
    Evidence,
    column,
    part_noise,
)
from engine.cameras.monocular import ANKLE_HEIGHT, EAR_HEIGHT
from engine.datatypes import Array

__all__ = ["BundlePriors", "BundleState", "Solution", "rotation_from", "solve_bundle"]

_J = len(CALIBRATION_JOINTS)
_FIRST, _SECOND, _KIND = (np.array(part) for part in zip(*LINKS, strict=True))
_N_LINKS = len(LINKS)

# Columns of the shared unknowns.
FOCAL = slice(0, 2)
CENTRE = slice(2, 6)
ROTATION = slice(6, 9)
TRANSLATION = slice(9, 12)
CAMERAS = slice(0, 12)
UP = slice(12, 14)
FLOOR = 14
SPAN = 15
LEAN = slice(16, 18)
FOOT = slice(18, 22)
PITCH = slice(22, 24)
LENGTH = slice(24, 24 + len(LINK_KINDS))
OFFSET = slice(LENGTH.stop, LENGTH.stop + 4 * _J)
N_SHARED = OFFSET.stop

_DEGREES_OF_FREEDOM = 4.0
"""Of Student's t: how heavy the tails of all residuals are."""
LEAN_SIGMA_M = 0.05
BENT_LEAN_SIGMA_M = 0.30
"""How far the head is beside the feet, on average: of a standing person, and of one who never
stands straight."""
UPRIGHT_SIGMA_M = 0.015
HEEL_M, TOE_M = 0.042, 0.030
"""Heights of the keypoints of heel and toe above the floor, in shoes."""
FLOOR_SIGMA_M = 0.015
FOOT_SIGMA_M = 0.010
DEPTH_SIGMA_M = 0.10
BODY_PITCH_SIGMA = 0.20
SPAN_SIGMA = 0.015
FRAMES_ALIKE = 20.0
"""How many chosen frames are worth one independent frame: errors of a network last."""


@dataclass(frozen=True, eq=False)
class BundlePriors:
    """What is known beforehand.

    `matrices` (2, 3, 3) px with relative standard errors `focal_sigma` (2,) and of the principal
    point `centre_sigma_px` (2,); stature in m; how far cameras are off level, degrees;
    `body_scale` (2,) metres per unit of each view's body landmarks.
    """

    matrices: Array
    focal_sigma: Array
    centre_sigma_px: Array
    stature_m: float
    stature_sigma_m: float
    pitch_sigma_deg: float
    roll_sigma_deg: float
    body: Array
    """Shape (2, F, J, 3): body landmarks in the axes of the cameras, metres."""

    def take(self, frames: Array) -> BundlePriors:
        """Return what is known of some of the frames."""
        return replace(self, body=self.body[:, frames])


@dataclass(frozen=True, eq=False)
class BundleState:
    """Where everything is, in the axes of the first camera.

    `shared` (N_SHARED,) holds the additive unknowns; `rotation` (3, 3) and `up` (3,) are
    turned instead; `points` (F, J, 3) are the joints, m.
    """

    shared: Array
    rotation: Array
    up: Array
    points: Array

    def moved(self, step: Array, points: Array) -> BundleState:
        """Return the state after a step of the shared unknowns and of the points."""
        east, south = tangent(self.up)
        up = self.up + step[UP][0] * east + step[UP][1] * south
        shared = self.shared + step
        shared[ROTATION] = shared[UP] = 0.0
        return BundleState(
            shared,
            rotation_from(step[ROTATION]) @ self.rotation,
            up / np.linalg.norm(up),
            self.points + points,
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a bundle adjustment ended.

    `cost` is the robust cost, `covariance` (N_SHARED, N_SHARED) that of the shared unknowns,
    `residual_px` (2, F, J) the distances in the pictures, and `shape_sigma_m` by how much a joint
    is typically off, because of the cameras, once the whole is laid over the truth. `level_misfit`
    is how far the cameras are off level, in units of what is usual.
    """

    state: BundleState
    cost: float
    covariance: Array
    residual_px: Array
    shape_sigma_m: float
    level_misfit: float


def tangent(up: Array) -> tuple[Array, Array]:
    """Return two unit vectors across `up`."""
    east = np.cross(up, [0.0, 0.0, 1.0] if abs(up[2]) < 0.9 else [1.0, 0.0, 0.0])
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def rotation_from(vector: Array) -> Array:
    """Return the rotation matrix of a rotation vector (Rodrigues), radians."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3) + _cross_matrix(vector)
    k = _cross_matrix(vector / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k)


def _cross_matrix(v: Array) -> Array:
    """Return the matrices of the cross product with vectors (..., 3)."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return matrix


def start_shared(priors: BundlePriors, translation: Array) -> Array:
    """Return the shared unknowns before anything was seen, shape (N_SHARED,)."""
    shared = np.zeros(N_SHARED)
    shared[TRANSLATION] = translation
    shared[SPAN] = np.log(priors.stature_m)
    shared[LENGTH] = np.log([row[3] * priors.stature_m for row in LINK_KINDS])
    return shared


# The residuals of one frame, in this order.
_R_IMAGE = slice(0, 4 * _J)
_R_LINK = slice(_R_IMAGE.stop, _R_IMAGE.stop + _N_LINKS)
_R_DEPTH = slice(_R_LINK.stop, _R_LINK.stop + 2 * _J)
_R_FLOOR = slice(_R_DEPTH.stop, _R_DEPTH.stop + len(FEET))
_R_UPRIGHT = slice(_R_FLOOR.stop, _R_FLOOR.stop + 3)
_N_ROWS = _R_UPRIGHT.stop
_FOOT_HEIGHTS = np.array([HEEL_M, HEEL_M, TOE_M, TOE_M])
_EARS = [column("left_ear"), column("right_ear")]
_ANKLES = [column("left_ankle"), column("right_ankle")]
_HIPS = [column("left_hip"), column("right_hip")]


class Bundle:
    """One problem: evidence and priors, ready to be linearised at any state."""

    def __init__(self, evidence: Evidence, priors: BundlePriors) -> None:
        self.evidence, self.priors = evidence, priors
        self.n_frames = evidence.n_frames
        steady = np.array([noise.steady for noise in part_noise()])
        self._steady_px = evidence.height_px[:, None] * steady
        self._inverse_sigma = self._weigh()

    def _weigh(self) -> Array:
        """Return one over the standard error of every residual, zero where unseen, (F, R)."""
        evidence, stature = self.evidence, self.priors.stature_m
        rows = np.zeros((self.n_frames, _N_ROWS))
        seen = np.isfinite(evidence.pixels).all(axis=-1)
        image = np.asarray(np.where(seen, 1.0 / evidence.sigma_px, 0.0))
        rows[:, _R_IMAGE] = np.repeat(_by_frame(image), 2, axis=1)
        wobble = np.array([row[5] for row in LINK_KINDS])[_KIND] * stature
        rows[:, _R_LINK] = 1.0 / wobble
        told = np.isfinite(self.priors.body).all(axis=-1)
        rows[:, _R_DEPTH] = _by_frame(told.astype(np.float64)) / DEPTH_SIGMA_M
        # The network's errors of depth last: all frames together are worth about four.
        rows[:, _R_DEPTH] *= np.sqrt(min(1.0, 4.0 * FRAMES_ALIKE / self.n_frames))
        rows[:, _R_FLOOR] = evidence.is_planted / FLOOR_SIGMA_M
        rows[:, _R_UPRIGHT] = evidence.is_upright[:, None] / np.array(
            [UPRIGHT_SIGMA_M, 2 * UPRIGHT_SIGMA_M, 2 * UPRIGHT_SIGMA_M]
        )
        if not evidence.has_upright:
            rows[:, _R_UPRIGHT.start] = 0.0
        return rows

    def matrices(self, shared: Array) -> tuple[Array, Array]:
        """Return focal lengths (2, 2) and principal points (2, 2), px."""
        known = self.priors.matrices
        focal = known[:, [0, 1], [0, 1]] * np.exp(shared[FOCAL])[:, None]
        return focal, known[:, :2, 2] + shared[CENTRE].reshape(2, 2)

    def offsets_px(self, shared: Array) -> Array:
        """Return how far each view misplaces each joint, shape (2, J, 2), px."""
        return np.asarray(shared[OFFSET].reshape(2, _J, 2) * self._steady_px[:, :, None])

    def residuals(self, state: BundleState) -> Array:
        """Return all residuals in units of their standard errors, shape (F, R)."""
        rows, _, _ = self._evaluate(state, linear=False)
        return rows

    def linearise(self, state: BundleState) -> tuple[Array, Array, Array]:
        """Return residuals (F, R), derivatives by points (F, R, 3J) and by shared (F, R, G)."""
        return self._evaluate(state, linear=True)

    def _evaluate(self, state: BundleState, *, linear: bool) -> tuple[Array, Array, Array]:
        frames = self.n_frames
        rows = np.zeros((frames, _N_ROWS))
        by_points = np.zeros((frames, _N_ROWS, 3 * _J) if linear else (0, 0, 0))
        by_shared = np.zeros((frames, _N_ROWS, N_SHARED) if linear else (0, 0, 0))
        seen = [state.points, state.points @ state.rotation.T + state.shared[TRANSLATION]]
        self._image_rows(state, seen, rows, by_points, by_shared, linear)
        self._link_rows(state, rows, by_points, by_shared, linear)
        self._depth_rows(state, seen, rows, by_points, by_shared, linear)
        self._ground_rows(state, rows, by_points, by_shared, linear)
        # In shares of the stature: else a smaller world would have smaller errors.
        size = np.exp(state.shared[SPAN]) / self.priors.stature_m
        for values in (rows, by_points, by_shared) if linear else (rows,):
            values[:, _R_IMAGE.stop :] /= size
        if linear:
            by_shared[:, _R_IMAGE.stop :, SPAN] -= rows[:, _R_IMAGE.stop :]
        rows = np.where(self._inverse_sigma > 0, rows * self._inverse_sigma, 0.0)
        if linear:
            by_points *= self._inverse_sigma[:, :, None]
            by_shared *= self._inverse_sigma[:, :, None]
        return rows, by_points, by_shared

    def _image_rows(
        self,
        state: BundleState,
        seen: list[Array],
        rows: Array,
        by_points: Array,
        by_shared: Array,
        linear: bool,
    ) -> None:
        focal, centre = self.matrices(state.shared)
        offset = self.offsets_px(state.shared)
        joint = np.arange(_J)
        for v, points in enumerate(seen):
            depth = np.maximum(points[..., 2], 0.1)
            flat = points[..., :2] / depth[..., None]
            found = focal[v] * flat + centre[v] + offset[v]
            start = 2 * _J * v
            rows[:, start : start + 2 * _J] = (found - self.evidence.pixels[v]).reshape(
                self.n_frames, -1
            )
            if not linear:
                continue
            chain = np.zeros((self.n_frames, _J, 2, 3))
            chain[..., 0, 0] = focal[v, 0] / depth
            chain[..., 1, 1] = focal[v, 1] / depth
            chain[..., 2] = -focal[v] * flat / depth[..., None]
            for axis in range(2):
                row = start + 2 * joint + axis
                turned = chain[:, :, axis] @ (state.rotation if v else np.eye(3))
                for k in range(3):
                    by_points[:, row, 3 * joint + k] = turned[..., k]
                by_shared[:, row, v] = focal[v, axis] * flat[..., axis]
                by_shared[:, row, CENTRE.start + 2 * v + axis] = 1.0
                by_shared[:, row, OFFSET.start + 2 * _J * v + 2 * joint + axis] = self._steady_px[v]
                if v:
                    lever = points - state.shared[TRANSLATION]
                    by_shared[:, row, ROTATION] = np.cross(lever, chain[:, :, axis])
                    by_shared[:, row, TRANSLATION] = chain[:, :, axis]

    def _link_rows(
        self, state: BundleState, rows: Array, by_points: Array, by_shared: Array, linear: bool
    ) -> None:
        difference = state.points[:, _FIRST] - state.points[:, _SECOND]
        length = np.maximum(np.linalg.norm(difference, axis=-1), 1e-6)
        wanted = np.exp(state.shared[LENGTH])[_KIND]
        rows[:, _R_LINK] = length - wanted
        if not linear:
            return
        unit = difference / length[..., None]
        row = _R_LINK.start + np.arange(_N_LINKS)
        for k in range(3):
            by_points[:, row, 3 * _FIRST + k] = unit[..., k]
            by_points[:, row, 3 * _SECOND + k] = -unit[..., k]
        by_shared[:, row, LENGTH.start + _KIND] = -wanted

    def _depth_rows(
        self,
        state: BundleState,
        seen: list[Array],
        rows: Array,
        by_points: Array,
        by_shared: Array,
        linear: bool,
    ) -> None:
        """Compare depths behind the hips with the networks' own; these may lean as a whole."""
        # Landmarks were scaled to the stature, so they grow with it.
        body = np.nan_to_num(self.priors.body)
        body = body * np.exp(state.shared[SPAN]) / self.priors.stature_m
        joint = np.arange(_J)
        for v, points in enumerate(seen):
            middle = points[:, _HIPS, 2].mean(axis=1, keepdims=True)
            lean = state.shared[PITCH][v]
            told = body[v, ..., 2] + lean * body[v, ..., 1]
            row = _R_DEPTH.start + _J * v + joint
            rows[:, row] = points[..., 2] - middle - told
            if not linear:
                continue
            axis = state.rotation[2] if v else np.array([0.0, 0.0, 1.0])
            for k in range(3):
                by_points[:, row, 3 * joint + k] = axis[k]
                for hip in _HIPS:
                    by_points[:, row, 3 * hip + k] -= 0.5 * axis[k]
            by_shared[:, row, PITCH.start + v] = -body[v, ..., 1]
            by_shared[:, row, SPAN] = -told
            if v:
                lever = points - points[:, _HIPS].mean(axis=1, keepdims=True)
                by_shared[:, row, ROTATION] = np.cross(lever, [0.0, 0.0, 1.0])

    def _ground_rows(
        self, state: BundleState, rows: Array, by_points: Array, by_shared: Array, linear: bool
    ) -> None:
        east, south = tangent(state.up)
        feet = state.points[:, FEET]
        floor = state.shared[FLOOR] + _FOOT_HEIGHTS + state.shared[FOOT]
        rows[:, _R_FLOOR] = feet @ state.up - floor
        # The head is carried over the middle of the feet; its height counts from the ankles.
        ears, lean = state.points[:, _EARS].mean(axis=1), np.array(state.shared[LEAN])
        stand = ears - state.points[:, _ANKLES].mean(axis=1)
        above = ears - feet.mean(axis=1)
        span = (EAR_HEIGHT - ANKLE_HEIGHT) * np.exp(state.shared[SPAN])
        row = _R_UPRIGHT.start
        rows[:, row] = stand @ state.up - span
        rows[:, row + 1 : row + 3] = above @ np.stack([east, south], axis=1) - lean
        if not linear:
            return
        for i, k in enumerate(FEET):
            by_points[:, _R_FLOOR.start + i, 3 * k : 3 * k + 3] = state.up
            by_shared[:, _R_FLOOR.start + i, FOOT.start + i] = -1.0
        by_shared[:, _R_FLOOR, UP] = np.stack([feet @ east, feet @ south], axis=-1)
        by_shared[:, _R_FLOOR, FLOOR] = -1.0
        for i, axis in enumerate((state.up, east, south)):
            below = FEET if i else _ANKLES
            for joints in (_EARS, below):
                share = (0.5 if joints is _EARS else -1.0 / len(below)) * axis
                for k in joints:
                    by_points[:, row + i, 3 * k : 3 * k + 3] = share
        by_shared[:, row, UP] = np.stack([stand @ east, stand @ south], axis=-1)
        by_shared[:, row, SPAN] = -span
        by_shared[:, row + 1, UP.start] = by_shared[:, row + 2, UP.start + 1] = -above @ state.up
        by_shared[:, row + 1, LEAN.start] = by_shared[:, row + 2, LEAN.start + 1] = -1.0

    def prior_rows(self, state: BundleState) -> tuple[Array, Array]:
        """Return the residuals of what is known beforehand (P,) and their derivatives (P, G)."""
        priors, shared = self.priors, state.shared
        stature = np.hypot(priors.stature_sigma_m / priors.stature_m, SPAN_SIGMA)
        lean = LEAN_SIGMA_M if self.evidence.has_upright else BENT_LEAN_SIGMA_M
        plain = (
            (FOCAL, shared[FOCAL], priors.focal_sigma),
            (CENTRE, shared[CENTRE], np.repeat(priors.centre_sigma_px, 2)),
            (slice(SPAN, SPAN + 1), shared[[SPAN]] - np.log(priors.stature_m), [stature]),
            (LEAN, shared[LEAN], [lean] * 2),
            (FOOT, shared[FOOT], [FOOT_SIGMA_M] * 4),
            (PITCH, shared[PITCH], [BODY_PITCH_SIGMA] * 2),
            (OFFSET, shared[OFFSET], np.ones(4 * _J)),
        )
        values, jacobian = [], []
        for where, value, sigma in plain:
            values.append(value / np.asarray(sigma))
            jacobian.append(np.eye(N_SHARED)[where] / np.asarray(sigma)[:, None])
        # Shares of whatever the stature turns out to be: they must not tell it.
        share, sigma = (np.array([row[i] for row in LINK_KINDS]) for i in (3, 4))
        values.append((shared[LENGTH] - np.log(share) - shared[SPAN]) / sigma)
        by_length = np.eye(N_SHARED)[LENGTH]
        by_length[:, SPAN] = -1.0
        jacobian.append(by_length / sigma[:, None])
        level = self._level_rows(state)
        return np.concatenate([*values, level[0]]), np.concatenate([*jacobian, level[1]])

    def off_level(self, state: BundleState) -> Array:
        """Return how far the cameras are off level, in standard errors, shape (2, 2)."""
        sigma = np.radians([self.priors.roll_sigma_deg, self.priors.pitch_sigma_deg])
        seen = [state.up, state.rotation @ state.up]
        return np.stack([up[[0, 2]] / sigma for up in seen])

    def _level_rows(self, state: BundleState) -> tuple[Array, Array]:
        """Return how far the cameras are off level: `up` across and along the line of sight."""
        east, south = tangent(state.up)
        sigma = np.radians([self.priors.roll_sigma_deg, self.priors.pitch_sigma_deg])
        values, jacobian = np.zeros(4), np.zeros((4, N_SHARED))
        all_off = self.off_level(state)
        for v, rotation in enumerate((np.eye(3), state.rotation)):
            seen, off = rotation @ state.up, all_off[v]
            # Most cameras are level, but one on a wall looks down by far: a soft tail.
            soft = np.sqrt(_soft_share(off))
            values[2 * v : 2 * v + 2] = off * soft
            by_up = (rotation @ np.stack([east, south], axis=1))[[0, 2]]
            jacobian[2 * v : 2 * v + 2, UP] = by_up * (soft / sigma)[:, None]
            if v:
                turn = -_cross_matrix(seen)[[0, 2]]
                jacobian[2:4, ROTATION] = turn * (soft / sigma)[:, None]
        return values, jacobian

    def cost(self, rows: Array, prior: Array) -> float:
        """Return the robust cost of residuals, the frames counting as `FRAMES_ALIKE` tells."""
        square, size = _group_squares(rows)
        nu = _DEGREES_OF_FREEDOM
        robust = (nu + size) * np.log1p(square / nu)
        return float(robust.sum() / FRAMES_ALIKE + prior @ prior)

    def step_system(self, state: BundleState) -> _Normal:
        """Linearise at a state."""
        rows, by_points, by_shared = self.linearise(state)
        square, size = _group_squares(rows)
        nu = _DEGREES_OF_FREEDOM
        weight = np.sqrt((nu + size) / (nu + square) / FRAMES_ALIKE)
        weight = np.concatenate(
            [np.repeat(weight[:, : 2 * _J], 2, axis=1), weight[:, 2 * _J :]], axis=1
        )
        rows, by_points = rows * weight, by_points * weight[:, :, None]
        by_shared *= weight[:, :, None]
        prior, by_prior = self.prior_rows(state)
        turned = by_points.transpose(0, 2, 1)
        flat = by_shared.reshape(-1, N_SHARED)
        return _Normal(
            points=turned @ by_points,
            cross=turned @ by_shared,
            shared=flat.T @ flat + by_prior.T @ by_prior,
            points_right=-(turned @ rows[:, :, None])[..., 0],
            shared_right=-(flat.T @ rows.reshape(-1) + by_prior.T @ prior),
        )


def _by_frame(values: Array | np.float64) -> Array:
    """Turn (2, F, J) into (F, 2 J)."""
    rows = np.swapaxes(np.asarray(values), 0, 1)
    return np.asarray(rows.reshape(len(rows), -1))


def _soft_share(off: Array) -> Array:
    """Return the share of a squared residual that Student's t leaves of it."""
    square = off**2
    nu = _DEGREES_OF_FREEDOM
    return np.asarray(np.where(square > 1e-9, nu * np.log1p(square / nu) / (square + 1e-12), 1.0))


def _group_squares(rows: Array) -> tuple[Array, Array]:
    """Return squared lengths of image residuals (both axes together) and of all others."""
    image = (rows[:, _R_IMAGE].reshape(len(rows), -1, 2) ** 2).sum(axis=-1)
    square = np.concatenate([image, rows[:, _R_IMAGE.stop :] ** 2], axis=1)
    size = np.concatenate([np.full(2 * _J, 2.0), np.ones(_N_ROWS - 4 * _J)])
    return square, size


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations: blocks of the points (F, 3J, 3J), of the shared (G, G), and between."""

    points: Array
    cross: Array
    shared: Array
    points_right: Array
    shared_right: Array

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Return the steps of the shared unknowns (G,) and of the points (F, J, 3)."""
        inverse_cross, inverse_right, reduced = self._eliminate(damping)
        right = self.shared_right - self.cross.reshape(-1, N_SHARED).T @ inverse_right.reshape(-1)
        step = np.asarray(np.linalg.solve(reduced, right))
        points = inverse_right - inverse_cross @ step
        return step, np.asarray(points.reshape(len(points), _J, 3))

    def solve_points(self) -> Array:
        """Return the steps of the points (F, J, 3) while the shared unknowns stay."""
        blocks = self.points + 1e-4 * np.eye(self.points.shape[1])
        step = np.linalg.solve(blocks, self.points_right[..., None])
        return np.asarray(step.reshape(-1, _J, 3))

    def _eliminate(self, damping: float) -> tuple[Array, Array, Array]:
        blocks = self.points.copy()
        index = np.arange(blocks.shape[1])
        # A joint that no view sees hangs on its links; the small term keeps it where it is.
        blocks[:, index, index] += damping * blocks[:, index, index] + 1e-4
        joined = np.concatenate([self.cross, self.points_right[..., None]], axis=2)
        solved = np.linalg.solve(blocks, joined)
        follow = solved[..., :-1].reshape(-1, N_SHARED)
        reduced = self.shared - self.cross.reshape(-1, N_SHARED).T @ follow
        index = np.arange(N_SHARED)
        reduced[index, index] += damping * self.shared[index, index] + 1e-9
        return solved[..., :-1], solved[..., -1], reduced

    def covariance(self) -> tuple[Array, Array]:
        """Return the covariance of the shared unknowns, and how the points follow them."""
        solved, _, reduced = self._eliminate(0.0)
        return np.asarray(np.linalg.inv(0.5 * (reduced + reduced.T))), -solved


def solve_bundle(
    evidence: Evidence,
    priors: BundlePriors,
    start: BundleState,
    *,
    max_steps: int = 40,
    tolerance: float = 1e-4,
) -> Solution:
    """Adjust cameras, joints and body until nothing improves (Levenberg-Marquardt).

    Parameters
    ----------
    evidence, priors
        What was seen and what is known, of the same frames.
    start
        Where to begin.
    max_steps
        At most so many steps are tried.
    tolerance
        Stop when the cost falls by less than this share.
    """
    bundle = Bundle(evidence, priors)
    state, damping = start, 1e-3
    cost = bundle.cost(bundle.residuals(state), bundle.prior_rows(state)[0])
    system = bundle.step_system(state)
    for _ in range(max_steps):
        trial = state.moved(*system.solve(damping))
        new = bundle.cost(bundle.residuals(trial), bundle.prior_rows(trial)[0])
        if not new < cost:
            damping *= 8.0
            if damping > 1e6:
                break
            continue
        fall, state, cost = cost - new, trial, new
        damping = max(damping / 5.0, 1e-7)
        system = bundle.step_system(state)
        if fall < tolerance * cost:
            break
    distance = bundle.residuals(state)[:, _R_IMAGE].reshape(-1, 2, _J, 2).transpose(1, 0, 2, 3)
    residual = np.linalg.norm(distance, axis=-1) * evidence.sigma_px
    covariance, moves = system.covariance()
    shape = _shape_sigma(state.points, moves, covariance)
    level = float(np.sqrt(np.mean(bundle.off_level(state) ** 2)))
    return Solution(state, cost, covariance, residual, shape, level)


def _shape_sigma(points: Array, moves: Array, covariance: Array) -> float:
    """Return the typical error of a joint without what moves and turns everything alike, m.

    `moves` (F, 3J, G) is how the points follow the shared unknowns.
    """
    flat = points.reshape(-1, 3)
    arm = flat - flat.mean(axis=0)
    rigid = np.concatenate(
        [
            np.tile(np.eye(3), (len(flat), 1, 1)),
            -_cross_matrix(arm),
        ],
        axis=2,
    ).reshape(-1, 6)
    follow = moves[..., CAMERAS].reshape(len(rigid), -1)
    covariance = covariance[CAMERAS, CAMERAS]
    basis, _ = np.linalg.qr(rigid)
    follow = follow - basis @ (basis.T @ follow)
    variance = np.einsum("pg,gh,ph->", follow, covariance, follow, optimize=True) / len(flat)
    return float(np.sqrt(max(variance, 0.0) / 3.0))
