"""What a body says about joints that the lines of sight leave open.

Frame by frame, all joints of the limbs and the trunk are found together: each has what the pictures
say of it, links keep their length, and each view's landmarks tell softly how far one end of a link
lies behind the other. Nothing is carried from frame to frame here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.cameras._sight import Sight, point_towards
from engine.datatypes import Array, Camera
from engine.optics import to_camera_axes
from engine.skeletons import Skeleton

__all__ = ["BodyLinks", "attach_points", "measure_links", "picture_terms", "solve_joints"]

PARTS = ("shoulder", "elbow", "wrist", "index", "hip", "knee", "ankle", "heel", "big_toe")


@dataclass(frozen=True)
class LinkRule:
    """A pair of parts that keep their distance.

    `share` of stature (after Drillis and Contini in Winter 2009; widths between keypoints, not
    bones); `sigma` the least relative standard error that a length is given; `depth_m` the standard
    error of the landmarks' depth from one end to the other, infinite for the trunk, whose width
    and lean estimators misjudge by decimetres; `crossed` links run from one side to the other.
    """

    first: str
    second: str
    share: float
    sigma: float
    depth_m: float
    crossed: bool = False


RULES = (
    LinkRule("shoulder", "elbow", 0.186, 0.06, 0.09),
    LinkRule("elbow", "wrist", 0.146, 0.05, 0.07),
    LinkRule("wrist", "index", 0.055, 0.15, 0.06),
    LinkRule("hip", "knee", 0.245, 0.05, 0.08),
    LinkRule("knee", "ankle", 0.246, 0.04, 0.11),
    LinkRule("ankle", "heel", 0.045, 0.15, 0.06),
    LinkRule("ankle", "big_toe", 0.110, 0.10, 0.13),
    LinkRule("heel", "big_toe", 0.130, 0.10, 0.13),
    LinkRule("shoulder", "hip", 0.288, 0.08, np.inf),
    LinkRule("shoulder", "hip", 0.300, 0.08, np.inf, crossed=True),
    LinkRule("shoulder", "shoulder", 0.200, 0.08, np.inf, crossed=True),
    LinkRule("hip", "hip", 0.120, 0.12, 0.06, crossed=True),
)
UNMEASURED_SIGMA = 0.12
LENGTH_RANGE = (0.6, 1.5)
"""Measured lengths are believed between these multiples of the share of stature."""
WELL_SEEN_SHARE = 0.10
"""A length counts where the pictures tell it to this share of itself, one standard error."""
LEAST_FRAMES = 5

ATTACHED_DEPTH_M = 0.06
"""Standard error of the landmarks' depth of fingers behind the wrist, or the face behind the
shoulders."""
WEAK_SIGMA_M = 0.5
"""Holds a joint of which nothing is known near where it was put first."""
ROBUST_SCALE = 3.0
ITERATIONS = 15
CONVERGED_M = 1e-3
SETTLED_SHARE = 0.7
LONGEST_STEP_M = 0.3
FRAMES_AT_ONCE = 300


@dataclass(frozen=True, eq=False)
class BodyLinks:
    """Links of one person, shape (L,) each.

    Columns of both ends, lengths and their standard errors, and the standard error of what
    landmarks tell of the depth from one end to the other, m.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    length: Array
    sigma: Array
    depth_sigma: Array


def body_columns(skeleton: Skeleton) -> list[int]:
    """Return the columns of the joints that are solved together."""
    names = [f"{side}_{part}" for part in PARTS for side in ("left", "right")]
    return [skeleton.index(n) for n in names if n in skeleton.keypoints]


def measure_links(
    points: Array, covariance: Array, skeleton: Skeleton, *, stature_m: float
) -> BodyLinks:
    """Measure the lengths of the links over the clip, both sides together.

    Frames count by how well the pictures tell the length in them, so the side that is seen well
    speaks for the hidden one. Without enough such frames the length is a share of stature.

    Parameters
    ----------
    points, covariance
        Shape (T, K, 3) and (T, K, 3, 3), m, m2, of lines of sight alone.
    """
    first, second, lengths, sigmas, depths = [], [], [], [], []
    for rule in RULES:
        ends = list(_ends(rule, skeleton))
        if not ends:
            continue
        usual = rule.share * stature_m
        length, spread = _measure(points, covariance, ends, usual)
        for a, b in ends:
            first.append(a)
            second.append(b)
            lengths.append(length)
            sigmas.append(max(spread, rule.sigma * length))
            depths.append(rule.depth_m)
    return BodyLinks(
        np.array(first, dtype=np.intp),
        np.array(second, dtype=np.intp),
        np.array(lengths),
        np.array(sigmas),
        np.array(depths),
    )


def _ends(rule: LinkRule, skeleton: Skeleton) -> Sequence[tuple[int, int]]:
    found = []
    for side, other in (("left", "right"), ("right", "left")):
        a = f"{side}_{rule.first}"
        b = f"{other if rule.crossed else side}_{rule.second}"
        if a in skeleton.keypoints and b in skeleton.keypoints:
            found.append((skeleton.index(a), skeleton.index(b)))
    return found[:1] if rule.first == rule.second else found


def _measure(
    points: Array, covariance: Array, ends: Sequence[tuple[int, int]], usual_m: float
) -> tuple[float, float]:
    """Return the length of a link and how much it varies from frame to frame, m."""
    a, b = (list(column) for column in zip(*ends, strict=True))
    vector = points[:, a] - points[:, b]
    length = np.linalg.norm(vector, axis=-1)
    way = vector / np.where(length > 1e-9, length, np.nan)[..., None]
    variance = np.einsum("tli,tlij,tlj->tl", way, covariance[:, a] + covariance[:, b], way)
    low, high = LENGTH_RANGE
    with np.errstate(invalid="ignore"):
        is_good = (variance < (WELL_SEEN_SHARE * usual_m) ** 2) & (length > low * usual_m)
        is_good &= length < high * usual_m
    if is_good.sum() < LEAST_FRAMES:
        return usual_m, UNMEASURED_SIGMA * usual_m
    values = length[is_good]
    weight = 1.0 / (variance[is_good] + (0.03 * usual_m) ** 2) ** 2
    middle = _weighted_quantile(values, weight, 0.5)
    spread = 1.4826 * _weighted_quantile(np.abs(values - middle), weight, 0.5)
    return middle, spread


def _weighted_quantile(values: Array, weight: Array, share: float) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, share * total[-1])])


def picture_terms(
    cameras: Sequence[Camera], flat: Array, sigma: Array, points: Array
) -> tuple[Array, Array, Array]:
    """Return what the pictures say of points, linearised.

    Parameters
    ----------
    flat, sigma
        Shape (V, ..., 2) and (V, ...): undistorted pictures at unit depth and standard errors;
        NaN where a view does not show the point.
    points
        Shape (..., 3), m.

    Returns
    -------
    information, gradient, miss
        Shape (..., 3, 3), (..., 3) and (...): the normal matrix, the right side of the step, and
        the sum of squared errors in units of their standard errors.
    """
    # Component by component: ten thousand products of 3 x 3 numbers are far slower.
    products = {(i, j): np.zeros(points.shape[:-1]) for i in range(3) for j in range(i, 3)}
    gradient = np.zeros(points.shape)
    miss = np.zeros(points.shape[:-1])
    for v, camera in enumerate(cameras):
        seen = to_camera_axes(camera, points)
        depth = np.where(seen[..., 2] > 0, seen[..., 2], np.nan)
        for axis in (0, 1):
            at = seen[..., axis] / depth
            error = (flat[v][..., axis] - at) / sigma[v]
            is_known = np.isfinite(error)
            error = np.where(is_known, error, 0.0)
            per_metre = np.where(is_known, 1.0 / (sigma[v] * depth), 0.0)
            at = np.where(is_known, at, 0.0)
            row = [
                (camera.rotation[axis, i] - at * camera.rotation[2, i]) * per_metre
                for i in range(3)
            ]
            for i, j in products:
                products[i, j] += row[i] * row[j]
            for i in range(3):
                gradient[..., i] += error * row[i]
            miss += error**2
    information = np.empty((*points.shape, 3))
    for (i, j), product in products.items():
        information[..., i, j] = information[..., j, i] = product
    return information, gradient, miss


@dataclass(frozen=True, eq=False)
class BodyTask:
    """One clip for `solve_joints`.

    Parameters
    ----------
    cameras, sight, sigma
        What is seen, and its standard errors (V, T, K) at unit depth.
    start
        Shape (T, K, 3), m, finite for all body joints.
    links
        Lengths.
    depth_scale
        Metres per unit of the landmarks of each view, shape (V,).
    hint, hint_sigma
        Shape (T, K, 3) and (T, K), m: where a joint is known to be from elsewhere (its
        neighbours in time); infinite sigma where nothing is.
    """

    cameras: Sequence[Camera]
    sight: Sight
    sigma: Array
    start: Array
    links: BodyLinks
    depth_scale: Array
    hint: Array
    hint_sigma: Array

    def cut(self, part: slice | NDArray[np.intp]) -> BodyTask:
        """Return some of the frames."""
        return BodyTask(
            self.cameras,
            self.sight.cut(part),
            self.sigma[:, part],
            self.start[part],
            self.links,
            self.depth_scale,
            self.hint[part],
            self.hint_sigma[part],
        )


def solve_joints(task: BodyTask) -> tuple[Array, Array]:
    """Find the body's joints in every frame.

    Gauss-Newton; links and depths are made robust by Cauchy weights (scale 3).

    Returns
    -------
    Array, Array
        Shape (T, J, 3) and (T, J, 3, 3), m and m2, in the order of `body_columns`.
    """
    pieces = []
    for start in range(0, len(task.start), FRAMES_AT_ONCE):
        pieces.append(_solve_piece(task.cut(slice(start, start + FRAMES_AT_ONCE))))
    return (
        np.concatenate([points for points, _ in pieces]),
        np.concatenate([covariance for _, covariance in pieces]),
    )


def _solve_piece(task: BodyTask) -> tuple[Array, Array]:
    columns = body_columns(task.sight.skeleton)
    system = _System(task, columns)
    points = task.start[:, columns].copy()
    active, part = np.arange(len(points)), system
    for _ in range(ITERATIONS):
        normal, right = part.assemble(points[active])
        step = np.linalg.solve(normal, right[..., None])[..., 0].reshape(points[active].shape)
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        points[active] += step * np.minimum(1.0, LONGEST_STEP_M / np.maximum(length, 1e-12))
        is_moving = np.asarray(length.max(axis=(1, 2)) > CONVERGED_M)
        if not is_moving.any():
            break
        # Most frames settle at once; only the others are worth going on with.
        if is_moving.mean() < SETTLED_SHARE:
            active = active[is_moving]
            part = _System(task.cut(active), columns)
    normal, _ = system.assemble(points)
    inverse = np.linalg.inv(normal)
    n_joints = len(columns)
    blocks = inverse.reshape(len(points), n_joints, 3, n_joints, 3)
    joint = np.arange(n_joints)
    own: Array = np.asarray(blocks[:, joint, :, joint, :])
    return points, np.moveaxis(own, 0, 1)


class _System:
    """Normal equations of all joints of a frame, (T, 3J, 3J) and (T, 3J)."""

    def __init__(self, task: BodyTask, columns: list[int]) -> None:
        self.task, self.columns = task, columns
        place = {k: j for j, k in enumerate(columns)}
        self.first = np.array([place[int(k)] for k in task.links.first], dtype=np.intp)
        self.second = np.array([place[int(k)] for k in task.links.second], dtype=np.intp)
        self.flat = task.sight.flat[:, :, columns]
        self.sigma = task.sigma[:, :, columns]
        self.weak = task.start[:, columns]
        self.hint = np.nan_to_num(task.hint[:, columns])
        self.hint_weight = 1.0 / task.hint_sigma[:, columns] ** 2
        body = task.sight.body[:, :, columns] * task.depth_scale[:, None, None, None]
        self.told = body[:, :, self.first] - body[:, :, self.second]

    def assemble(self, points: Array) -> tuple[Array, Array]:
        """Return the normal matrix and the right side at `points` (T, J, 3)."""
        n_frames, n_joints, _ = points.shape
        blocks = np.zeros((n_frames, n_joints, 3, n_joints, 3))
        right = np.zeros(points.shape)
        information, gradient, _ = picture_terms(self.task.cameras, self.flat, self.sigma, points)
        weak = WEAK_SIGMA_M**-2
        joint = np.arange(n_joints)
        own = information + (weak + self.hint_weight)[..., None, None] * np.eye(3)
        blocks[:, joint, :, joint, :] = np.moveaxis(own, 1, 0)
        right += gradient + weak * (self.weak - points)
        right += self.hint_weight[..., None] * (self.hint - points)
        self._add_links(blocks, right, points)
        size = 3 * n_joints
        return blocks.reshape(n_frames, size, size), right.reshape(n_frames, size)

    def _add_links(self, blocks: Array, right: Array, points: Array) -> None:
        """Add what links say; all statements about one link concern the same two joints."""
        vector = points[:, self.first] - points[:, self.second]
        length = np.maximum(np.linalg.norm(vector, axis=-1), 1e-6)
        links = self.task.links
        rows = [_row(vector / length[..., None], links.length - length, links.sigma)]
        towards = point_towards(self.task.cameras, points)
        for v in range(len(self.task.cameras)):
            look = towards[v][:, self.first] + towards[v][:, self.second]
            look /= np.linalg.norm(look, axis=-1, keepdims=True)
            error = (look * (self.told[v] - vector)).sum(axis=-1)
            rows.append(_row(look, error, links.depth_sigma))
        outer = np.sum([o for o, _ in rows], axis=0)
        pull = np.sum([p for _, p in rows], axis=0)
        for i, (a, b) in enumerate(zip(self.first, self.second, strict=True)):
            blocks[:, a, :, a] += outer[:, i]
            blocks[:, b, :, b] += outer[:, i]
            blocks[:, a, :, b] -= outer[:, i]
            blocks[:, b, :, a] -= outer[:, i]
            right[:, a] += pull[:, i]
            right[:, b] -= pull[:, i]


def _row(way: Array, error: Array, sigma: Array) -> tuple[Array, Array]:
    """Return normal matrices (T, L, 3, 3) and right sides of statements about ``way . vector``.

    `error` (T, L) is what is missing; Cauchy weights.
    """
    is_known = np.isfinite(error)
    error = np.where(is_known, error, 0.0)
    weight = is_known / (sigma**2 * (1.0 + (error / (ROBUST_SCALE * sigma)) ** 2))
    weighted = weight[..., None] * way
    return weighted[..., :, None] * way[..., None, :], error[..., None] * weighted


def attach_points(
    task: BodyTask, joints: Array, joint_covariance: Array, columns: Sequence[int]
) -> tuple[Array, Array]:
    """Find further keypoints one by one, relative to the body's joints.

    Lines of sight decide; how far fingers lie behind their wrist and the face behind the
    shoulders, each view's landmarks tell softly.

    Parameters
    ----------
    joints, joint_covariance
        As returned by `solve_joints`.
    columns
        Keypoints to find, columns of the skeleton.

    Returns
    -------
    Array, Array
        Shape (T, len(columns), 3) and (T, len(columns), 3, 3), m and m2.
    """
    picked = list(columns)
    anchor, told, variance = _find_anchors(task, joints, joint_covariance, picked)
    points = np.where(np.isfinite(task.start[:, picked]), task.start[:, picked], anchor)
    weak_at = points.copy()
    flat, sigma = task.sight.flat[:, :, picked], task.sigma[:, :, picked]
    normal = np.zeros((*points.shape, 3))
    for _ in range(ITERATIONS):
        normal, right, _ = picture_terms(task.cameras, flat, sigma, points)
        normal = normal + WEAK_SIGMA_M**-2 * np.eye(3)
        right = right + WEAK_SIGMA_M**-2 * (weak_at - points)
        look = point_towards(task.cameras, points)
        error = (look * (told + (anchor - points)[None])).sum(axis=-1)
        is_known = np.isfinite(error)
        error = np.where(is_known, error, 0.0)
        weight = is_known / (variance * (1.0 + error**2 / (variance * ROBUST_SCALE**2)))
        normal = normal + np.einsum("vtk,vtki,vtkj->tkij", weight, look, look)
        right = right + np.einsum("vtk,vtki->tki", weight * error, look)
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        points = points + step * np.minimum(1.0, LONGEST_STEP_M / np.maximum(length, 1e-12))
        if np.quantile(length, 0.999) < CONVERGED_M:
            break
    return points, np.linalg.inv(normal)


def _find_anchors(
    task: BodyTask, joints: Array, joint_covariance: Array, picked: list[int]
) -> tuple[Array, Array, Array]:
    """Return anchors (T, N, 3), the landmarks' way from them (V, T, N, 3), its variance (T, N)."""
    skeleton = task.sight.skeleton
    place = {k: j for j, k in enumerate(body_columns(skeleton))}
    spread = np.trace(joint_covariance, axis1=2, axis2=3) / 3.0
    anchors, told, variance = [], [], []
    for k in picked:
        name = skeleton.keypoints[k]
        side = name.split("_", 1)[0]
        names = (
            [f"{side}_wrist"]
            if name.endswith(("_pinky", "_thumb", "_index"))
            else ["left_shoulder", "right_shoulder"]
        )
        ends = [skeleton.index(n) for n in names]
        at = [place[e] for e in ends]
        anchors.append(joints[:, at].mean(axis=1))
        way = task.sight.body[:, :, k] - task.sight.body[:, :, ends].mean(axis=2)
        told.append(way * task.depth_scale[:, None, None])
        variance.append(spread[:, at].mean(axis=1) + ATTACHED_DEPTH_M**2)
    return np.stack(anchors, axis=1), np.stack(told, axis=2), np.stack(variance, axis=1)
