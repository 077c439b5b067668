"""Upper-limb segments between markers, and the penalty on their change of length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import DataError

__all__ = ["SEGMENT_NAMES", "LengthPenalty", "Shape", "find_segments", "learn_lengths"]

Shape = Literal["squared", "pseudo-huber"]
Joint = tuple[str, ...]

SEGMENT_NAMES: Final = ("right_upper_arm", "left_upper_arm", "right_forearm", "left_forearm")
SIGMA_FLOOR_M: Final = 0.002
_SHORT_M: Final = 1e-6

_SYNONYMS: Final = {
    "acromion": ("SHO", "AC"),
    "lateral_epicondyle": ("ELL", "LHE"),
    "medial_epicondyle": ("ELM", "MHE"),
    "radial_styloid": ("WRR", "RS"),
    "ulnar_styloid": ("WRU", "US"),
}
"""Names of landmarks without the side's letter: the synthetic lifts', and those of Cappozzo's
style."""
_TRUNK: Final = ("C7", "T10", "CLAV", "IJ", "STRN", "PX", "RSHO", "RAC", "LSHO", "LAC")
_TIKHONOV: Final = 0.05
"""How strongly the shoulder's centre is held to the acromion, as a share of the arm's movement."""


def find_segments(
    names: Sequence[str], markers_m: Array | None = None, *, glenohumeral: bool = False
) -> Array:
    """Return the weights of the markers in each upper-limb segment.

    Parameters
    ----------
    names
        The D marker names: those of either marker set.
    markers_m
        Shape (N, D, 3), training frames; needed for `glenohumeral`.
    glenohumeral
        Whether the upper arm starts at the shoulder's centre of rotation, found from the
        training frames as the point of the trunk whose distance to the elbow changes least,
        rather than at the acromion, which slides on it.

    Returns
    -------
    Array
        Shape (4, D), proximal minus distal joint: a segment's vector is ``weights @ markers``.

    Raises
    ------
    DataError
        If a landmark of the arm is not among the names.
    """
    segments = []
    for side in ("R", "L"):
        shoulder = _weigh(names, side, ("acromion",))
        elbow = _weigh(names, side, ("lateral_epicondyle", "medial_epicondyle"))
        wrist = _weigh(names, side, ("radial_styloid", "ulnar_styloid"))
        if glenohumeral and markers_m is not None:
            shoulder = _find_shoulder_centre(names, markers_m, shoulder, elbow)
        segments += [shoulder - elbow, elbow - wrist]
    return np.array(segments)[[0, 2, 1, 3]]


def _weigh(names: Sequence[str], side: str, landmarks: Joint) -> Array:
    weights = np.zeros(len(names))
    for landmark in landmarks:
        wanted = [side + short for short in _SYNONYMS[landmark]]
        found = [name for name in wanted if name in names]
        if not found:
            raise DataError(
                f"The length constraint needs the marker {' or '.join(wanted)}, which is not "
                "among the markers; name it so, or choose an estimator without the constraint."
            )
        weights[list(names).index(found[0])] = 1.0 / len(landmarks)
    return weights


def _find_shoulder_centre(
    names: Sequence[str], markers_m: Array, shoulder: Array, elbow: Array
) -> Array:
    """Return the centre of the elbow's sphere around the trunk, as weights of trunk markers."""
    trunk = [list(names).index(name) for name in _TRUNK if name in names]
    if len(trunk) < 4:
        raise DataError(
            "The shoulder's centre needs at least four trunk markers (C7, T10, sternum, "
            f"acromions), got {len(trunk)}; choose an estimator without it."
        )
    complete = markers_m[np.isfinite(markers_m).all(axis=(1, 2))]
    rotation, origin, template = _align(complete[:, trunk])
    arm = np.einsum("tij,ti->tj", rotation, np.tensordot(complete, elbow, (1, 0)) - origin)
    start = np.einsum(
        "tij,ti->tj", rotation, np.tensordot(complete, shoulder, (1, 0)) - origin
    ).mean(axis=0)
    offset = arm - start
    # |offset - c|^2 = const is linear in c and the constant; pulled towards c = 0, the acromion.
    spread = float(np.mean(np.sum((offset - offset.mean(axis=0)) ** 2, axis=1)))
    pull = np.sqrt(_TIKHONOV * spread * len(offset)) * np.eye(3, 4)
    left = np.vstack([np.column_stack([2 * offset, np.ones(len(offset))]), pull])
    right = np.concatenate([np.sum(offset**2, axis=1), np.zeros(3)])
    centre = start + np.linalg.lstsq(left, right)[0][:3]
    affine = np.vstack([template.T, np.ones(len(trunk))])
    weights = np.zeros(len(names))
    weights[trunk] = np.linalg.lstsq(affine, np.append(centre, 1.0))[0]
    return weights


def _align(points: Array) -> tuple[Array, Array, Array]:
    """Return rotations (T, 3, 3) and origins (T, 3) of a cloud, and its mean shape (n, 3)."""
    origin = points.mean(axis=1)
    centred = points - origin[:, None]
    shape = centred[0]
    rotation = np.tile(np.eye(3), (len(points), 1, 1))
    for _ in range(5):
        u, _s, vt = np.linalg.svd(np.einsum("tni,nj->tij", centred, shape))
        u[..., -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
        rotation = u @ vt
        shape = np.einsum("tij,tni->tnj", rotation, centred).mean(axis=0)
    return rotation, origin, shape


def learn_lengths(segments: Array, markers_m: Array) -> tuple[Array, Array]:
    """Return each segment's median length and standard deviation over frames, both (4,), m.

    The deviation is at least 2 mm.
    """
    length = np.linalg.norm(np.einsum("cm,nmk->nck", segments, markers_m), axis=2)
    sigma = np.maximum(np.nanstd(length, axis=0), SIGMA_FLOOR_M)
    return np.asarray(np.nanmedian(length, axis=0)), np.asarray(sigma)


@dataclass(frozen=True, eq=False)
class LengthPenalty:
    """What a pose costs whose segments have the wrong length.

    Parameters
    ----------
    segments
        Shape (C, D), from `find_segments`.
    length_m
        Shape (C,), the right lengths.
    sigma_m
        Shape (C,): how much a length varies anyway. The weight of a frame's penalty is
        ``eta / sigma ** 2``, eta being the predictive variance of its features, so that the
        penalty is that of a Gaussian belief in the length.
    fixed_weight
        Weight per m^2 that replaces it, if given.
    shape
        `squared`, or `pseudo-huber`: beyond one sigma the cost grows with the error, not
        with its square.
    """

    segments: Array
    length_m: Array
    sigma_m: Array
    fixed_weight: float | None = None
    shape: Shape = "squared"

    def weigh(self, eta: Array) -> Array:
        """Return the weights of frames with predictive variances `eta`, shape (M, C), per m^2."""
        if self.fixed_weight is not None:
            return np.full((len(eta), len(self.length_m)), self.fixed_weight)
        return np.asarray(eta[:, None] / self.sigma_m**2)

    def evaluate(
        self, flat: NDArray[np.float64], weight: Array
    ) -> tuple[Array, NDArray[np.float64]]:
        """Return the penalty (M,) and its gradient (M, 3 D) for poses `flat` (M, 3 D)."""
        markers = flat.reshape(len(flat), -1, 3)
        vector = np.einsum("cm,nmk->nck", self.segments, markers)
        length = np.maximum(np.linalg.norm(vector, axis=2), _SHORT_M)
        miss = length - self.length_m
        if self.shape == "squared":
            cost, slope = miss**2, 2.0 * miss
        else:
            bend = np.sqrt(1.0 + (miss / self.sigma_m) ** 2)
            cost, slope = 2.0 * self.sigma_m**2 * (bend - 1.0), 2.0 * miss / bend
        pull = (weight * slope / length)[..., None] * vector
        gradient = np.einsum("cm,nck->nmk", self.segments, pull)
        return np.sum(weight * cost, axis=1), gradient.reshape(len(flat), -1)
