"""How far away each joint is, from one picture.

A picture gives the line of sight to every joint but not how far along it the
joint lies. The solver finds those depths for a whole clip at once, so that the body
agrees with what is known of any body: bones keep their length, feet stand on the floor, elbows and
knees bend one way, a person who stays in place is balanced over the feet, and
nothing jumps. What a pose network says of depth enters as one soft statement among these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from engine.datatypes import Array

__all__ = ["JOINTS", "DepthProblem", "DepthSettings", "solve_depths"]

_PARTS = ("ankle", "knee", "hip", "shoulder", "elbow", "wrist", "hand", "heel", "big_toe")
JOINTS: tuple[str, ...] = tuple(f"{side}_{part}" for part in _PARTS for side in ("left", "right"))
"""The joints that are solved for; `hand` is the middle of the knuckles."""
_INDEX = {name: i for i, name in enumerate(JOINTS)}

_CHAIN = (
    ("ankle", "knee"),
    ("knee", "hip"),
    ("hip", "shoulder"),
    ("shoulder", "elbow"),
    ("elbow", "wrist"),
    ("wrist", "hand"),
    ("ankle", "heel"),
    ("ankle", "big_toe"),
)
BONES: tuple[tuple[str, str], ...] = (
    *((f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in _CHAIN),
    ("left_hip", "right_hip"),
    ("left_shoulder", "right_shoulder"),
    ("left_hip", "right_shoulder"),
    ("right_hip", "left_shoulder"),
)
"""Pairs whose distance stays (nearly) the same, the trunk's diagonals included."""

_FLOOR_JOINTS = tuple(n for n in JOINTS if n.endswith(("ankle", "heel", "big_toe")))
_HINGES = tuple(
    (f"{side}_{a}", f"{side}_{b}", f"{side}_{c}", sense)
    for side in ("left", "right")
    for a, b, c, sense in (("shoulder", "elbow", "wrist", 1.0), ("hip", "knee", "ankle", -1.0))
)
_MASS_SHARES = (
    # proximal, distal, share of body mass of one side, centre of mass from the proximal end
    ("hip", "knee", 0.142, 0.41),
    ("knee", "ankle", 0.043, 0.44),
    ("ankle", "big_toe", 0.014, 0.40),
    ("shoulder", "elbow", 0.027, 0.58),
    ("elbow", "wrist", 0.016, 0.46),
    ("wrist", "hand", 0.006, 0.80),
    ("shoulder", "hip", 0.217, 0.45),  # half of the trunk
    ("shoulder", "shoulder", 0.035, 0.0),  # half of head and neck, taken at shoulder level
)
"""Segment masses after de Leva (1996), both sexes, rounded."""

JUMP_SIGMA_M = 0.04
JUMP_CAP = 25.0
"""How far a wrist's depth moves in a frame, and the most a jump may cost: turning does happen."""


@dataclass(frozen=True)
class DepthSettings:
    """How strictly each statement is meant; standard errors in metres unless named otherwise."""

    prior_m: float = 0.06
    prior_share: float = 0.2
    floor_m: float = 0.02
    feet_m: float = 0.3
    balance_m: float = 0.06
    outward_m: float = 0.05
    hinge: float = 0.1
    acceleration_m_s2: float = 3.0
    hidden_factor: float = 2.0
    iterations: int = 12


@dataclass(frozen=True, eq=False)
class DepthProblem:
    """What is seen and known of one clip.

    Parameters
    ----------
    rays
        Shape (T, J, 3), lines of sight with unit depth in camera axes, `JOINTS` order; NaN where
        a joint was not seen.
    prior
        Shape (T, J), m, the network's depths relative to the feet; NaN where it told none.
    confidence
        Shape (T, J), 0 to 1.
    feet_depth
        Shape (T,), m, roughly where the feet are.
    lengths, length_sigma
        Shape (B,), m, of `BONES`.
    up, right
        Shape (3,), upwards and to the subject's right, camera axes.
    floor_height
        Height of the floor relative to the camera, m (negative).
    joint_heights
        Heights above the floor of the floor joints when the foot is down, m.
    is_standing
        Shape (T,), where the feet stay in place, so that the body must be in balance.
    step_s
        Time between frames, s.
    """

    rays: Array
    prior: Array
    confidence: Array
    feet_depth: Array
    lengths: Array
    length_sigma: Array
    up: Array
    right: Array
    floor_height: float
    joint_heights: Array
    is_standing: NDArray[np.bool_]
    step_s: float


def mass_weights() -> tuple[Array, Array]:
    """Return the joints' shares of body mass and of the base of support, shape (J,) each."""
    mass, support = np.zeros(len(JOINTS)), np.zeros(len(JOINTS))
    for side in ("left", "right"):
        for proximal, distal, share, centre in _MASS_SHARES:
            mass[_INDEX[f"{side}_{proximal}"]] += share * (1 - centre)
            mass[_INDEX[f"{side}_{distal}"]] += share * centre
        support[_INDEX[f"{side}_ankle"]] += 0.3
        support[_INDEX[f"{side}_big_toe"]] += 0.2
    return mass / mass.sum(), support


def solve_depths(
    problem: DepthProblem, settings: DepthSettings | None = None, *, chunk: int = 600
) -> Array:
    """Find the depth of every joint in every frame.

    Damped Gauss-Newton on a robust (Cauchy) sum of squares over the whole clip;
    the normal equations are banded because only neighbouring frames touch. Long
    clips are solved in overlapping pieces, so that memory does not grow with them.

    Parameters
    ----------
    problem
        One clip.
    settings
        Strictness of the statements.
    chunk
        Frames per piece.

    Returns
    -------
    Array
        Shape (T, J), m along the camera's axis; NaN where a joint was not seen.
    """
    settings = settings or DepthSettings()
    n_frames = problem.rays.shape[0]
    overlap = min(60, chunk // 4)
    depth = np.full(problem.rays.shape[:2], np.nan)
    start = 0
    while True:
        stop = min(start + chunk, n_frames)
        piece = _solve_piece(_cut(problem, start, stop), settings)
        # The first half of an overlap is kept from the piece before, whose end is further away.
        skip = overlap // 2 if start else 0
        depth[start + skip : stop] = piece[skip:]
        if stop == n_frames:
            return np.where(np.isfinite(problem.rays).all(axis=2), depth, np.nan)
        start = stop - overlap


def _cut(problem: DepthProblem, start: int, stop: int) -> DepthProblem:
    part = slice(start, stop)
    return DepthProblem(
        rays=problem.rays[part],
        prior=problem.prior[part],
        confidence=problem.confidence[part],
        feet_depth=problem.feet_depth[part],
        lengths=problem.lengths,
        length_sigma=problem.length_sigma,
        up=problem.up,
        right=problem.right,
        floor_height=problem.floor_height,
        joint_heights=problem.joint_heights,
        is_standing=problem.is_standing[part],
        step_s=problem.step_s,
    )


def _solve_piece(problem: DepthProblem, settings: DepthSettings) -> Array:
    seen = np.asarray(np.isfinite(problem.rays).all(axis=2))
    rows = _Rows(problem, seen, settings)
    depth = problem.feet_depth[:, None] + np.where(seen, np.nan_to_num(problem.prior), 0.0)
    depth = _bridge_gaps(_unfold_forearms(rows, depth), problem, seen)
    smoothness = (settings.acceleration_m_s2 * problem.step_s**2) ** -2
    for _ in range(settings.iterations):
        jacobian, residual = rows.evaluate(depth)
        normal = np.matmul(jacobian.transpose(0, 2, 1), jacobian)
        gradient = np.matmul(jacobian.transpose(0, 2, 1), residual[:, :, None])[:, :, 0]
        step = _banded_step(normal, gradient, depth, smoothness)
        depth = depth + np.clip(step, -0.15, 0.15)
        if np.abs(step).max() < 5e-3:
            break
    return depth


def _bridge_gaps(depth: Array, problem: DepthProblem, seen: NDArray[np.bool_]) -> Array:
    """Start unseen samples between their neighbours in time, so that they do not pull on those."""
    bridged, frame = depth.copy(), np.arange(len(depth))
    for joint in range(depth.shape[1]):
        known = seen[:, joint]
        if known.all():
            continue
        bridged[:, joint] = (
            np.interp(frame, frame[known], depth[known, joint])
            if known.any()
            else problem.feet_depth
        )
    return bridged


def _unfold_forearms(rows: _Rows, depth: Array) -> Array:
    """Start every forearm on the side of its elbow where an arm can be.

    A forearm of known length meets the wrist's line of sight in two places, one
    behind and one before the elbow; the search can't cross from one to the other by itself.
    """
    problem, rays, settings = rows.problem, rows.rays, rows.settings
    depth = depth.copy()
    forward_sense = problem.right
    for side, outward in (("left", -1.0), ("right", 1.0)):
        shoulder, elbow, wrist, hand = (
            _INDEX[f"{side}_{n}"] for n in ("shoulder", "elbow", "wrist", "hand")
        )
        length = problem.lengths[BONES.index((f"{side}_elbow", f"{side}_wrist"))]
        upper = (
            rays[:, elbow] * depth[:, elbow, None] - rays[:, shoulder] * depth[:, shoulder, None]
        )
        start = rays[:, elbow] * depth[:, elbow, None]
        square = np.maximum((rays[:, wrist] ** 2).sum(axis=1), 1e-9)
        along = (rays[:, wrist] * start).sum(axis=1)
        root = np.sqrt(np.maximum(along**2 - square * ((start**2).sum(axis=1) - length**2), 0.0))
        candidates = np.stack([(along - root) / square, (along + root) / square])
        told = problem.prior[:, wrist] - problem.prior[:, elbow]
        cost = np.zeros_like(candidates)
        for i, candidate in enumerate(candidates):
            lower = rays[:, wrist] * candidate[:, None] - start
            bend = np.cross(upper, lower) @ forward_sense / length**2
            out = np.maximum(lower @ problem.right * outward, 0.0)
            cost[i] = (
                (np.minimum(bend, 0.0) / settings.hinge) ** 2
                + (out / settings.outward_m) ** 2
                + ((candidate - depth[:, elbow] - np.nan_to_num(told)) / 0.12) ** 2
            )
        chosen = candidates[_steady_choice(candidates, cost), np.arange(len(depth))]
        known = rows.seen[:, [elbow, wrist]].all(axis=1)
        depth[known, wrist] = chosen[known]
        depth[known, hand] = (chosen + 0.3 * (chosen - depth[:, elbow]))[known]
    return depth


def _steady_choice(candidates: Array, cost: Array) -> NDArray[np.intp]:
    """Choose between two depths in every frame so that cost and jumps together are least.

    Dynamic programming over the clip (Viterbi).

    Parameters
    ----------
    candidates, cost
        Shape (2, T), m and squared standard errors.

    Returns
    -------
    NDArray[int]
        Shape (T,), 0 or 1.
    """
    n_frames = candidates.shape[1]
    jump = (candidates[:, None, 1:] - candidates[None, :, :-1]) / JUMP_SIGMA_M
    change = np.minimum(jump**2, JUMP_CAP)  # (now, before, T - 1)
    total, source = cost[:, 0].copy(), np.zeros((2, n_frames), dtype=np.intp)
    for t in range(1, n_frames):
        reach = total[None, :] + change[:, :, t - 1]
        source[:, t] = np.argmin(reach, axis=1)
        total = cost[:, t] + reach.min(axis=1)
    chosen = np.zeros(n_frames, dtype=np.intp)
    chosen[-1] = np.argmin(total)
    for t in range(n_frames - 1, 0, -1):
        chosen[t - 1] = source[chosen[t], t]
    return chosen


class _Rows:
    """The statements about one frame, linearised: residuals (T, R) and Jacobian (T, R, J).

    Residuals are in units of their standard error. Statements about bones, the network's
    depths and the floor are made robust by Cauchy weights (scale 3).
    """

    def __init__(
        self, problem: DepthProblem, seen: NDArray[np.bool_], settings: DepthSettings
    ) -> None:
        self.problem, self.settings = problem, settings
        self.rays = np.where(seen[:, :, None], np.nan_to_num(problem.rays), 0.0)
        self.seen = seen
        self.first = np.array([_INDEX[a] for a, _ in BONES])
        self.second = np.array([_INDEX[b] for _, b in BONES])
        self.both_seen = seen[:, self.first] & seen[:, self.second]
        certain = np.minimum(problem.confidence[:, self.first], problem.confidence[:, self.second])
        doubt = 1.0 + settings.hidden_factor * (1.0 - np.nan_to_num(certain, nan=0.5))
        self.length_sigma = problem.length_sigma * doubt
        self.prior_sigma = np.maximum(settings.prior_m, settings.prior_share * problem.lengths)
        difference = problem.prior[:, self.first] - problem.prior[:, self.second]
        self.is_told = self.both_seen & np.isfinite(difference)
        self.prior_difference = np.nan_to_num(difference)

    def evaluate(self, depth: Array) -> tuple[Array, Array]:
        """Return the Jacobian (T, R, J) and residuals (T, R) at `depth` (T, J)."""
        points = self.rays * depth[:, :, None]
        parts = (
            self._bones(points),
            self._priors(depth),
            self._floor(points),
            self._feet(depth),
            self._hinges(points),
            self._forearms(points),
            self._balance(points),
        )
        return (
            np.concatenate([jacobian for jacobian, _ in parts], axis=1),
            np.concatenate([residual for _, residual in parts], axis=1),
        )

    def _empty(self, n_rows: int) -> Array:
        return np.zeros((len(self.rays), n_rows, len(JOINTS)))

    @staticmethod
    def _robust(jacobian: Array, residual: Array, use: NDArray[np.bool_]) -> tuple[Array, Array]:
        weight = np.where(use, 1.0 / np.sqrt(1.0 + (residual / 3.0) ** 2), 0.0)
        return jacobian * weight[:, :, None], residual * weight

    def _bones(self, points: Array) -> tuple[Array, Array]:
        vector = points[:, self.first] - points[:, self.second]
        length = np.maximum(np.linalg.norm(vector, axis=2), 1e-6)
        direction = vector / length[:, :, None]
        jacobian, row = self._empty(len(BONES)), np.arange(len(BONES))
        jacobian[:, row, self.first] = (direction * self.rays[:, self.first]).sum(axis=2)
        jacobian[:, row, self.second] = -(direction * self.rays[:, self.second]).sum(axis=2)
        residual = (length - self.problem.lengths) / self.length_sigma
        return self._robust(jacobian / self.length_sigma[:, :, None], residual, self.both_seen)

    def _priors(self, depth: Array) -> tuple[Array, Array]:
        jacobian, row = self._empty(len(BONES)), np.arange(len(BONES))
        jacobian[:, row, self.first] = 1.0 / self.prior_sigma
        jacobian[:, row, self.second] = -1.0 / self.prior_sigma
        difference = depth[:, self.first] - depth[:, self.second]
        residual = (difference - self.prior_difference) / self.prior_sigma
        return self._robust(jacobian, residual, self.is_told)

    def _floor(self, points: Array) -> tuple[Array, Array]:
        columns = np.array([_INDEX[n] for n in _FLOOR_JOINTS])
        jacobian = self._empty(len(columns))
        slope = self.rays[:, columns] @ self.problem.up / self.settings.floor_m
        jacobian[:, np.arange(len(columns)), columns] = slope
        height = points[:, columns] @ self.problem.up
        wanted = self.problem.floor_height + self.problem.joint_heights
        residual = (height - wanted) / self.settings.floor_m
        return self._robust(jacobian, residual, self.seen[:, columns])

    def _feet(self, depth: Array) -> tuple[Array, Array]:
        columns = np.array([_INDEX["left_ankle"], _INDEX["right_ankle"]])
        jacobian = self._empty(2)
        jacobian[:, [0, 1], columns] = 1.0 / self.settings.feet_m
        residual = (depth[:, columns] - self.problem.feet_depth[:, None]) / self.settings.feet_m
        return jacobian, residual

    def _hinges(self, points: Array) -> tuple[Array, Array]:
        """Let elbows and knees bend one way: upper x lower has one sign along the right."""
        jacobian, residual = self._empty(len(_HINGES)), np.zeros((len(points), len(_HINGES)))
        axis = self.problem.right
        # 0.08 m2 is about the product of two adjacent limb segments.
        unit = self.settings.hinge * 0.08
        for row, (a, b, c, sense) in enumerate(_HINGES):
            i, j, k = _INDEX[a], _INDEX[b], _INDEX[c]
            upper, lower = points[:, j] - points[:, i], points[:, k] - points[:, j]
            bend = sense * (np.cross(upper, lower) @ axis)
            is_wrong = (bend < 0) & self.seen[:, [i, j, k]].all(axis=1)
            scale = np.where(is_wrong, sense / unit, 0.0)
            jacobian[:, row, i] = scale * (np.cross(-self.rays[:, i], lower) @ axis)
            jacobian[:, row, j] = scale * (
                np.cross(self.rays[:, j], lower) @ axis - np.cross(upper, self.rays[:, j]) @ axis
            )
            jacobian[:, row, k] = scale * (np.cross(upper, self.rays[:, k]) @ axis)
            residual[:, row] = np.where(is_wrong, bend / unit, 0.0)
        return jacobian, residual

    def _forearms(self, points: Array) -> tuple[Array, Array]:
        """Keep forearms from pointing outwards: the shoulder turns outwards only so far."""
        jacobian, residual = self._empty(2), np.zeros((len(points), 2))
        for row, (side, outward) in enumerate((("left", -1.0), ("right", 1.0))):
            elbow, wrist = _INDEX[f"{side}_elbow"], _INDEX[f"{side}_wrist"]
            axis = outward * self.problem.right
            out = (points[:, wrist] - points[:, elbow]) @ axis
            use = (out > 0) & self.seen[:, elbow] & self.seen[:, wrist]
            scale = np.where(use, 1.0 / self.settings.outward_m, 0.0)
            jacobian[:, row, elbow] = -scale * (self.rays[:, elbow] @ axis)
            jacobian[:, row, wrist] = scale * (self.rays[:, wrist] @ axis)
            residual[:, row] = scale * out
        return jacobian, residual

    def _balance(self, points: Array) -> tuple[Array, Array]:
        """Keep the centre of mass over the feet, along the horizontal line of sight."""
        away = np.array([0.0, 0.0, 1.0])
        away = away - (away @ self.problem.up) * self.problem.up
        away /= np.linalg.norm(away)
        mass, support = mass_weights()
        weight = mass - support
        use = self.problem.is_standing & self.seen.all(axis=1)
        scale = np.where(use, 1.0 / self.settings.balance_m, 0.0)
        jacobian = scale[:, None] * weight * (self.rays @ away)
        residual = scale * (weight * (points @ away)).sum(axis=1)
        return jacobian[:, None, :], residual[:, None]


def _banded_step(normal: Array, gradient: Array, depth: Array, smoothness: float) -> Array:
    """Solve the normal equations with a penalty on second differences between frames.

    Upper banded storage: a frame touches itself and the next two.
    """
    n_frames, n_joints = depth.shape
    gradient = gradient.copy()
    bands = np.zeros((2 * n_joints + 1, n_frames * n_joints))
    frame = np.arange(n_frames)[:, None] * n_joints
    row, column = np.triu_indices(n_joints)
    bands[2 * n_joints - (column - row), frame + column] = normal[:, row, column]
    diagonal, next_one, next_two = np.zeros(n_frames), np.zeros(n_frames), np.zeros(n_frames)
    if n_frames > 2:
        second = depth[2:] - 2 * depth[1:-1] + depth[:-2]
        for offset, factor in ((0, 1.0), (1, -2.0), (2, 1.0)):
            part = slice(offset, n_frames - 2 + offset)
            gradient[part] += smoothness * factor * second
            diagonal[part] += factor**2
        next_one[1:-1] -= 2.0
        next_one[2:] -= 2.0
        next_two[2:] += 1.0
    for band, values in ((0, diagonal), (n_joints, next_one), (2 * n_joints, next_two)):
        bands[2 * n_joints - band] += smoothness * np.repeat(values, n_joints)
    # Keeps joints that nobody saw in any frame solvable; they are dropped afterwards.
    bands[2 * n_joints] += 1e-6
    step = solveh_banded(bands, -gradient.ravel(), overwrite_ab=True, check_finite=False)
    return np.asarray(step).reshape(n_frames, n_joints)


def bone_rows(names: Sequence[str]) -> list[int]:
    """Return the rows of `BONES` that join two parts, left and right, for example hip and knee."""
    a, b = names
    return [
        i
        for i, (first, second) in enumerate(BONES)
        if first.split("_", 1)[1] == a
        and second.split("_", 1)[1] == b
        and first.split("_", 1)[0] == second.split("_", 1)[0]
    ]
