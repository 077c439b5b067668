"""Bundle adjustment of cameras that see bodies of known shape.

A body is a set of points with known places in its own axes: a board that was moved about, or the
corners of a door. Lenses, places of cameras and places of bodies are found together, as those that
explain all pictures best; priors hold what the pictures leave open.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial.transform import Rotation

from engine.datatypes import Array, Camera
from engine.errors import CalibrationError

__all__ = ["Adjusted", "Bundle", "Lens", "LensPrior", "Sighting", "adjust"]

N_LENS = 9
"""Focal lengths, centre, k1, k2, p1, p2, k3."""
SQUARE_SIGMA = 0.003
"""Pixels of phones are square to a few parts in a thousand."""
HUBER = 3.0
"""Residuals beyond this many standard errors count less and less."""
LEAST_NOISE_PX = 0.05
"""Nobody finds corners better, however well a few of them happen to fit."""
MAX_STEPS = 60


@dataclass(frozen=True, eq=False)
class Lens:
    """The nine parameters of a lens, shape (9,): fx, fy, cx, cy in px, then k1, k2, p1, p2, k3."""

    values: Array

    @classmethod
    def of(cls, camera: Camera) -> Lens:
        """Take those of a camera."""
        matrix = camera.matrix
        centre = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
        return cls(np.r_[centre, camera.distortion])

    @property
    def matrix(self) -> Array:
        """The camera matrix, shape (3, 3)."""
        fx, fy, cx, cy = self.values[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Array:
        """The lens coefficients, shape (5,)."""
        return np.array(self.values[4:])


@dataclass(frozen=True, eq=False)
class LensPrior:
    """What is known of a lens beforehand: mean and standard error of each parameter, shape (9,).

    A standard error of 0 holds the parameter, an infinite one leaves it free.
    """

    mean: Array
    sigma: Array

    @classmethod
    def exact(cls, lens: Lens) -> LensPrior:
        """Hold a known lens."""
        return cls(lens.values, np.zeros(N_LENS))


@dataclass(frozen=True, eq=False)
class Sighting:
    """Points of one body in one picture.

    `rows` (n,) are the body's points, `pixels` (n, 2) where they were seen, with a standard
    error of `sigma_px` each.
    """

    camera: int
    body: int
    rows: NDArray[np.intp]
    pixels: Array
    sigma_px: float = 1.0


@dataclass(frozen=True, eq=False)
class Bundle:
    """A whole problem, with its present solution.

    Parameters
    ----------
    lenses, lens_priors
        One a camera.
    camera_rotation, camera_translation
        Shape (C, 3, 3) and (C, 3), world to camera.
    body_rotation, body_translation
        Shape (B, 3, 3) and (B, 3), body to world.
    points
        Shape (P, 3), m, the same in every body.
    sightings
        What was seen.
    is_camera_held, is_body_held
        Shape (C,) and (B,): whether a place is known.
    point_sigma_m
        Standard error of each coordinate of the points; with 0 they are exact.
    least_noise
        The pixels' errors are not taken for less than this times what is stated, however well a
        few of them fit.
    """

    lenses: tuple[Lens, ...]
    lens_priors: tuple[LensPrior, ...]
    camera_rotation: Array
    camera_translation: Array
    body_rotation: Array
    body_translation: Array
    points: Array
    sightings: tuple[Sighting, ...]
    is_camera_held: NDArray[np.bool_]
    is_body_held: NDArray[np.bool_]
    point_sigma_m: float = 0.0
    least_noise: float = 0.0
    point_offset: Array = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The solution.

    `residual_px` has one array (n, 2) a sighting. `noise` is how many times larger than stated the
    errors of the pixels are. `cost` is chi-square with the stated errors, outliers held down.
    `covariance` is that of `columns`: lens, camera place, body place, points, in this order; zero
    where held.
    """

    bundle: Bundle
    residual_px: tuple[Array, ...]
    noise: float
    cost: float
    covariance: Array

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the seen points from the solution's, px."""
        squares = np.concatenate([np.sum(r * r, axis=1) for r in self.residual_px])
        return float(np.sqrt(squares.mean()))

    def lens_sigma(self, camera: int) -> Array:
        """Return the standard errors of a lens, shape (9,)."""
        start = camera * N_LENS
        block = self.covariance[start : start + N_LENS, start : start + N_LENS]
        return np.asarray(np.sqrt(np.diag(block)))

    def body_covariance(self, body: int) -> Array:
        """Return that of a body's rotation vector (world axes) and place, shape (6, 6)."""
        start = len(self.bundle.lenses) * (N_LENS + 6) + 6 * body
        return self.covariance[start : start + 6, start : start + 6]

    def relative_sigmas(self, first: int, second: int) -> tuple[float, float]:
        """Return the standard errors of two cameras relative to each other.

        Returns
        -------
        tuple of float
            Of the rotation, degrees, and of the second camera's place in the first one's axes, m;
            root mean square over the axes.
        """
        bundle = self.bundle
        offset = len(bundle.lenses) * N_LENS
        columns = np.concatenate([np.arange(6) + offset + 6 * c for c in (first, second)])
        covariance = self.covariance[np.ix_(columns, columns)]
        one, two = bundle.camera_rotation[first], bundle.camera_rotation[second]
        turn = one @ two.T

        # First camera's axes: turn = R1 R2', place of the second camera = t1 - R1 R2' t2.
        carried = turn @ bundle.camera_translation[second]
        by_turn = np.hstack([np.eye(3), np.zeros((3, 3)), -turn, np.zeros((3, 3))])
        by_place = np.hstack([_cross(carried), np.eye(3), -_cross(carried) @ turn, -turn])

        return (
            float(np.degrees(_root_mean(by_turn @ covariance @ by_turn.T))),
            _root_mean(by_place @ covariance @ by_place.T),
        )


def _root_mean(covariance: Array) -> float:
    return float(np.sqrt(np.trace(covariance) / len(covariance)))


def adjust(bundle: Bundle) -> Adjusted:
    """Find the lenses and places that explain all sightings best.

    Levenberg-Marquardt on robust (Huber) residuals; the noise of the pixels is estimated along the
    way, so that priors keep their weight against it [1]_. The covariance is the larger of the
    usual one and of one that allows errors to be common to a picture [2]_.

    Raises
    ------
    CalibrationError
        If the sightings don't determine the solution.

    References
    ----------
    .. [1] Triggs et al. (2000), Bundle adjustment: a modern synthesis.
    .. [2] Liang and Zeger (1986), Biometrika 73:13-22.
    """
    noise = 1.0
    for _ in range(3):
        bundle = _descend(bundle, noise)
        before, noise = noise, _estimate_noise(bundle)
        if abs(noise / before - 1.0) < 0.05:
            break
    system = _System.at(bundle, noise)
    pixels = _residuals(bundle)
    ends = np.cumsum([len(s.pixels) for s in bundle.sightings])[:-1]
    return Adjusted(
        bundle=bundle,
        residual_px=tuple(np.split(pixels, ends)),
        noise=noise,
        cost=_cost(bundle, 1.0),
        covariance=_covariance(bundle, system),
    )


def _descend(bundle: Bundle, noise: float) -> Bundle:
    damping = 1e-4
    cost = _cost(bundle, noise)
    for _ in range(MAX_STEPS):
        system = _System.at(bundle, noise)
        while True:
            step = system.solve(damping)
            trial = _move(bundle, step)
            trial_cost = _cost(trial, noise)
            if trial_cost <= cost or damping > 1e8:
                break
            damping *= 10.0
        if not trial_cost <= cost:
            break
        gain, bundle, cost = cost - trial_cost, trial, trial_cost
        damping = max(damping * 0.1, 1e-9)
        if gain <= 1e-9 * (1.0 + cost):
            break
    return bundle


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations: `normal` with priors, `prior` alone, and the gradient of each sighting."""

    normal: Array
    prior: Array
    gradient: Array
    scores: Array
    is_free: NDArray[np.bool_]

    @classmethod
    def at(cls, bundle: Bundle, noise: float) -> _System:
        jacobian = _jacobian(bundle)
        whitened = _residuals(bundle) / (noise * _sigmas(bundle))[:, None]
        length = np.linalg.norm(whitened, axis=1)
        weight = np.minimum(1.0, HUBER / np.maximum(length, 1e-12))
        root = np.repeat(np.sqrt(weight) / (noise * _sigmas(bundle)), 2)
        scaled = sparse.diags(root) @ jacobian
        residual = np.repeat(np.sqrt(weight), 2) * whitened.reshape(-1)
        prior, prior_gradient = _priors(bundle)
        groups = np.repeat(
            [s.body for s in bundle.sightings], [len(s.rows) for s in bundle.sightings]
        )
        # A body may be seen by two cameras at once: what is common to them is common.
        member = sparse.csr_matrix(
            (residual, (np.repeat(groups, 2), np.arange(len(residual)))),
            shape=(len(bundle.body_rotation), len(residual)),
        )
        data = np.asarray((scaled.T @ scaled).todense())
        return cls(
            normal=data + prior,
            prior=prior,
            gradient=np.asarray(scaled.T @ residual) + prior_gradient,
            scores=np.asarray((member @ scaled).todense()),
            is_free=_free_columns(bundle),
        )

    def solve(self, damping: float) -> Array:
        """Return the damped step, zero where held."""
        free = self.is_free
        inner = self.normal[np.ix_(free, free)]
        inner = inner + damping * np.diag(np.diag(inner))
        step = np.zeros(len(free))
        try:
            step[free] = -np.linalg.solve(inner, self.gradient[free])
        except np.linalg.LinAlgError:
            raise CalibrationError(
                "The pictures leave the cameras open; show more points, in more places."
            ) from None
        return step


def _covariance(bundle: Bundle, system: _System) -> Array:
    free = system.is_free
    inner = system.normal[np.ix_(free, free)]
    scale = 1.0 / np.sqrt(np.diag(inner))
    try:
        inverse = np.linalg.inv(inner * np.outer(scale, scale)) * np.outer(scale, scale)
    except np.linalg.LinAlgError:
        raise CalibrationError(
            "The pictures leave the cameras open; show more points, in more places."
        ) from None
    covariance = np.zeros((len(free), len(free)))
    n_groups = len(bundle.body_rotation)
    usual = inverse
    if n_groups > 3:
        scores = system.scores[:, free] * np.sqrt(n_groups / (n_groups - 1.0))
        spread = scores.T @ scores + system.prior[np.ix_(free, free)]
        common = inverse @ spread @ inverse
        larger = np.sqrt(np.maximum(np.diag(common) / np.diag(usual), 1.0))
        usual = usual * np.outer(larger, larger)
    covariance[np.ix_(free, free)] = usual
    return covariance


def _estimate_noise(bundle: Bundle) -> float:
    whitened = _residuals(bundle) / _sigmas(bundle)[:, None]
    spread = np.median(np.abs(whitened)) * 1.4826
    length = np.linalg.norm(whitened, axis=1)
    weight = np.minimum(1.0, HUBER * max(spread, 1e-12) / np.maximum(length, 1e-12))
    n_free = int(_free_columns(bundle).sum()) - (bundle.points.size if bundle.point_sigma_m else 0)
    freedom = max(whitened.size - n_free, 0.2 * whitened.size)
    least = max(bundle.least_noise, LEAST_NOISE_PX / float(np.median(_sigmas(bundle))))
    return max(float(np.sqrt(np.sum(weight * length**2) / freedom)), least)


def _cost(bundle: Bundle, noise: float) -> float:
    length = np.linalg.norm(_residuals(bundle), axis=1) / (noise * _sigmas(bundle))
    if not np.isfinite(length).all():
        return np.inf
    robust = np.where(length <= HUBER, length**2, 2.0 * HUBER * length - HUBER**2)
    return float(robust.sum() + _prior_cost(bundle))


def _sigmas(bundle: Bundle) -> Array:
    return np.concatenate([np.full(len(s.rows), s.sigma_px) for s in bundle.sightings])


def _indices(bundle: Bundle) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    sizes = [len(s.rows) for s in bundle.sightings]
    camera = np.repeat([s.camera for s in bundle.sightings], sizes)
    body = np.repeat([s.body for s in bundle.sightings], sizes)
    return camera, body, np.concatenate([s.rows for s in bundle.sightings])


def _place(bundle: Bundle) -> tuple[Array, Array, Array, Array]:
    """Return body axes, world and camera coordinates without and with translation, (N, 3)."""
    camera, body, row = _indices(bundle)
    shape = bundle.points + bundle.point_offset if bundle.point_offset.size else bundle.points
    turned = np.einsum("nij,nj->ni", bundle.body_rotation[body], shape[row])
    world = turned + bundle.body_translation[body]
    carried = np.einsum("nij,nj->ni", bundle.camera_rotation[camera], world)
    return turned, world, carried, carried + bundle.camera_translation[camera]


def _lens_values(bundle: Bundle) -> Array:
    camera, _, _ = _indices(bundle)
    return np.asarray(np.stack([lens.values for lens in bundle.lenses])[camera])


def _residuals(bundle: Bundle) -> Array:
    """Return predicted minus seen, shape (N, 2), px; infinite for points behind a camera."""
    seen = np.concatenate([s.pixels for s in bundle.sightings])
    *_, points = _place(bundle)
    values = _lens_values(bundle)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        flat = points[:, :2] / points[:, 2:]
        predicted = values[:, :2] * _bend(flat, values[:, 4:]) + values[:, 2:4]
    return np.where(points[:, 2:] > 1e-6, predicted - seen, np.inf)


def _bend(flat: Array, coefficients: Array) -> Array:
    k1, k2, p1, p2, k3 = coefficients.T
    x, y = flat.T
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )


def _bend_by_flat(flat: Array, coefficients: Array) -> Array:
    k1, k2, p1, p2, k3 = coefficients.T
    x, y = flat.T
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    slope = 2.0 * (k1 + square * (2.0 * k2 + 3.0 * square * k3))
    result = np.empty((len(flat), 2, 2))
    result[:, 0, 0] = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    result[:, 1, 1] = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    result[:, 0, 1] = result[:, 1, 0] = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    return result


def _by_lens(flat: Array, values: Array) -> Array:
    """Return the derivative of the pixel by the nine parameters, shape (N, 2, 9)."""
    x, y = flat.T
    square = x * x + y * y
    bent = _bend(flat, values[:, 4:])
    result = np.zeros((len(flat), 2, N_LENS))
    for axis, other in ((0, 1), (1, 0)):
        own = flat[:, axis]
        focal = values[:, axis]
        result[:, axis, axis] = bent[:, axis]
        result[:, axis, 2 + axis] = 1.0
        result[:, axis, 4] = focal * own * square
        result[:, axis, 5] = focal * own * square**2
        result[:, axis, 8] = focal * own * square**3
        result[:, axis, 6 + axis] = focal * 2.0 * x * y
        result[:, axis, 6 + other] = focal * (square + 2.0 * own * own)
    return result


def _jacobian(bundle: Bundle) -> sparse.csr_matrix:
    camera, body, row = _indices(bundle)
    turned, _, carried, points = _place(bundle)
    values = _lens_values(bundle)
    flat = points[:, :2] / points[:, 2:]
    by_flat = values[:, :2, None] * _bend_by_flat(flat, values[:, 4:])
    perspective = np.zeros((len(points), 2, 3))
    perspective[:, 0, 0] = perspective[:, 1, 1] = 1.0 / points[:, 2]
    perspective[:, :, 2] = -flat / points[:, 2:]
    by_point = by_flat @ perspective
    by_world = by_point @ bundle.camera_rotation[camera]
    parts = [
        (_by_lens(flat, values), camera * N_LENS),
        (np.concatenate([by_point @ -_crosses(carried), by_point], axis=2), camera * 6),
        (np.concatenate([by_world @ -_crosses(turned), by_world], axis=2), body * 6),
        (by_world @ bundle.body_rotation[body], row * 3),
    ]
    starts = np.cumsum([0, *_widths(bundle)])
    blocks = [
        _scatter(part, first + start, int(starts[-1]))
        for (part, first), start in zip(parts, starts[:-1], strict=True)
    ]
    total: sparse.csr_matrix = blocks[0] + blocks[1] + blocks[2] + blocks[3]
    return total


def _widths(bundle: Bundle) -> tuple[int, int, int, int]:
    n = len(bundle.lenses)
    return n * N_LENS, n * 6, len(bundle.body_rotation) * 6, bundle.points.size


def _scatter(part: Array, first: NDArray[np.intp], n_columns: int) -> sparse.csr_matrix:
    """Place (N, 2, k) derivatives in the columns from `first` (N,) on."""
    n, _, width = part.shape
    columns = np.broadcast_to(first[:, None, None] + np.arange(width), part.shape)
    rows = np.broadcast_to(np.arange(2 * n).reshape(n, 2, 1), part.shape)
    flat = (part.ravel(), (rows.ravel(), columns.ravel().astype(int)))
    return sparse.csr_matrix(flat, shape=(2 * n, n_columns))


def _free_columns(bundle: Bundle) -> NDArray[np.bool_]:
    lens = np.concatenate([prior.sigma > 0 for prior in bundle.lens_priors])
    return np.concatenate(
        [
            lens,
            np.repeat(~np.asarray(bundle.is_camera_held, dtype=bool), 6),
            np.repeat(~np.asarray(bundle.is_body_held, dtype=bool), 6),
            np.full(bundle.points.size, bundle.point_sigma_m > 0),
        ]
    )


def _priors(bundle: Bundle) -> tuple[Array, Array]:
    """Return the information of the priors and the gradient of their cost."""
    widths = _widths(bundle)
    total = sum(widths)
    information = np.zeros((total, total))
    gradient = np.zeros(total)
    pairs = zip(bundle.lenses, bundle.lens_priors, strict=True)
    for index, (lens, prior) in enumerate(pairs):
        start = index * N_LENS
        weight = np.where(prior.sigma > 0, prior.sigma, np.inf) ** -2.0
        columns = np.arange(start, start + N_LENS)
        information[columns, columns] += weight
        gradient[columns] += weight * (lens.values - prior.mean)
        if not prior.sigma[:2].any():
            continue
        fx, fy = lens.values[:2]
        by_focal = np.array([1.0 / fx, -1.0 / fy]) / SQUARE_SIGMA
        information[start : start + 2, start : start + 2] += np.outer(by_focal, by_focal)
        gradient[start : start + 2] += by_focal * np.log(fx / fy) / SQUARE_SIGMA
    if bundle.point_sigma_m > 0:
        columns = np.arange(sum(widths[:3]), total)
        information[columns, columns] += bundle.point_sigma_m**-2
        if bundle.point_offset.size:
            gradient[columns] += bundle.point_offset.reshape(-1) / bundle.point_sigma_m**2
    return information, gradient


def _prior_cost(bundle: Bundle) -> float:
    cost = 0.0
    for lens, prior in zip(bundle.lenses, bundle.lens_priors, strict=True):
        free = prior.sigma > 0
        cost += float(np.sum(((lens.values - prior.mean)[free] / prior.sigma[free]) ** 2))
        if not prior.sigma[:2].any():
            continue
        cost += float((np.log(lens.values[0] / lens.values[1]) / SQUARE_SIGMA) ** 2)
    if bundle.point_sigma_m > 0 and bundle.point_offset.size:
        cost += float(np.sum((bundle.point_offset / bundle.point_sigma_m) ** 2))
    return cost


def _move(bundle: Bundle, step: Array) -> Bundle:
    parts = np.split(step, np.cumsum(_widths(bundle))[:-1])
    lens_steps = parts[0].reshape(-1, N_LENS)
    lenses = []
    for lens, change in zip(bundle.lenses, lens_steps, strict=True):
        moved = lens.values + change
        # A focal length can't be halved or doubled in one step, nor turn negative.
        moved[:2] = np.clip(moved[:2], 0.5 * lens.values[:2], 2.0 * lens.values[:2])
        lenses.append(Lens(moved))
    camera, body = parts[1].reshape(-1, 6), parts[2].reshape(-1, 6)
    offset = bundle.point_offset if bundle.point_offset.size else np.zeros_like(bundle.points)
    return replace(
        bundle,
        lenses=tuple(lenses),
        camera_rotation=Rotation.from_rotvec(camera[:, :3]).as_matrix() @ bundle.camera_rotation,
        camera_translation=bundle.camera_translation + camera[:, 3:],
        body_rotation=Rotation.from_rotvec(body[:, :3]).as_matrix() @ bundle.body_rotation,
        body_translation=bundle.body_translation + body[:, 3:],
        point_offset=offset + parts[3].reshape(-1, 3),
    )


def _cross(vector: Array) -> Array:
    return np.asarray(_crosses(vector[None])[0])


def _crosses(vectors: Array) -> Array:
    """Return the matrices that multiply as the cross product with each vector, (N, 3, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
