"""Bringing positions of a result and a reference into one frame.

One transform for a whole trial: errors that change over time are left to be seen. What kind of
transform it was is part of the answer, because each kind hides another error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from engine.datatypes import Array, PoseTrack, frozen_array
from engine.errors import ConfigError, DataError, ShapeError, UnitError
from engine.skeletons import BODY_SEGMENTS, get_skeleton

__all__ = [
    "SegmentLengths",
    "SpatialAlignment",
    "SpatialMode",
    "align_positions",
    "compare_segment_lengths",
]

SpatialMode = Literal["none", "rigid", "similarity"]
UNIT_FACTOR = 5.0
"""Bodies that differ more in size than this are in different units."""
OTHER_BODY = 0.12
"""Limbs that differ by more than this share on average are hardly those of one person."""
LIMBS = ("thigh", "shank", "upper_arm", "forearm")


@dataclass(frozen=True, eq=False)
class SpatialAlignment:
    """One transform for a whole trial: ``aligned = scale * rotation @ result + translation``.

    `rms_m` is the root mean square distance that remains over `n_points` samples; `turn_deg` the
    whole angle of the rotation and `tilt_deg` how far it turns the vertical.
    """

    mode: SpatialMode
    rotation: Array
    translation_m: Array
    scale: float
    rms_m: float
    n_points: int

    def apply(self, position: Array) -> Array:
        """Transform positions of shape (..., 3), m."""
        return np.asarray(self.scale * position @ self.rotation.T + self.translation_m)

    @property
    def turn_deg(self) -> float:
        """Angle of the rotation, degrees."""
        return float(np.degrees(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1, 1))))

    @property
    def tilt_deg(self) -> float:
        """Angle between both verticals, degrees."""
        return float(np.degrees(np.arccos(np.clip(self.rotation[1, 1], -1, 1))))


def align_positions(
    result: PoseTrack,
    reference: PoseTrack,
    *,
    mode: SpatialMode = "rigid",
    keypoints: Sequence[str] | None = None,
) -> SpatialAlignment:
    """Find the one transform that brings a whole trial onto its reference.

    Parameters
    ----------
    result, reference
        World metres, at the same times (see `resample_positions`); skeletons may differ.
    mode
        `none` where both are in one laboratory frame, `rigid` for position and heading,
        `similarity` for the size as well (then the size is no longer validated).
    keypoints
        Names to use; by default all that both have.

    Raises
    ------
    ConfigError
        If the mode is unknown.
    ShapeError
        If a track has two dimensions only, or the times differ.
    DataError
        If fewer than three common points exist, or they lie on a line.
    UnitError
        If the sizes differ so much that a unit must be wrong.
    """
    if mode not in get_args(SpatialMode):
        raise ConfigError(f"mode must be one of {', '.join(get_args(SpatialMode))}, got {mode!r}.")
    moving, fixed = _common_points(result, reference, keypoints)
    rotation, translation, scale = np.eye(3), np.zeros(3), 1.0
    if mode != "none":
        rotation, translation, scale = _fit_transform(moving, fixed, with_scale=True)
        if not 1 / UNIT_FACTOR <= scale <= UNIT_FACTOR:
            raise UnitError(
                f"The reference is {scale:.4g} times the size of the result; one of them is not "
                "in metres. Set length_unit in an import profile."
            )
        if mode == "rigid":
            scale = 1.0
            translation = fixed.mean(axis=0) - moving.mean(axis=0) @ rotation.T
    left = scale * moving @ rotation.T + translation - fixed
    return SpatialAlignment(
        mode=mode,
        rotation=frozen_array(rotation),
        translation_m=frozen_array(translation),
        scale=float(scale),
        rms_m=float(np.sqrt((left**2).sum(axis=1).mean())),
        n_points=len(moving),
    )


def _common_points(
    result: PoseTrack, reference: PoseTrack, keypoints: Sequence[str] | None
) -> tuple[Array, Array]:
    """Return the samples that both tracks have, shape (N, 3) each."""
    for track, word in ((result, "result"), (reference, "reference")):
        if track.position.shape[2] != 3 or track.unit != "m":
            raise ShapeError(
                f"The {word} is {track.position.shape[2]}D in {track.unit}, so that positions "
                "can't be compared; expected 3D in metres. Compare its angles instead."
            )
    if result.time_s.shape != reference.time_s.shape or not np.allclose(
        result.time_s, reference.time_s
    ):
        raise ShapeError("Both tracks need the same times; resample one of them first.")
    own, other = get_skeleton(result.skeleton), get_skeleton(reference.skeleton)
    wanted = own.keypoints if keypoints is None else tuple(keypoints)
    names = [n for n in wanted if n in own.keypoints and n in other.keypoints]
    moving = result.position[:, [own.index(n) for n in names]].reshape(-1, 3)
    fixed = reference.position[:, [other.index(n) for n in names]].reshape(-1, 3)
    known = np.isfinite(moving).all(axis=1) & np.isfinite(fixed).all(axis=1)
    if known.sum() < 3:
        raise DataError(
            "Result and reference have fewer than three points in common; check the labels of the "
            "reference."
        )
    return moving[known], fixed[known]


def _fit_transform(moving: Array, fixed: Array, *, with_scale: bool) -> tuple[Array, Array, float]:
    """Fit rotation, translation and scale by least squares, never a mirror image.

    References
    ----------
    .. [1] Umeyama (1991), IEEE Trans. Pattern Analysis and Machine Intelligence 13, 376-380.
    """
    a, b = moving - moving.mean(axis=0), fixed - fixed.mean(axis=0)
    u, singular, vt = np.linalg.svd(b.T @ a / len(a))
    if singular[1] < 1e-9 * max(singular[0], 1e-300):
        raise DataError(
            "The common points lie on one line, so that no rotation is defined; compare more "
            "joints."
        )
    guard = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(guard) @ vt
    spread = (a**2).sum(axis=1).mean()
    scale = float((singular * guard).sum() / spread) if with_scale else 1.0
    return rotation, fixed.mean(axis=0) - scale * moving.mean(axis=0) @ rotation.T, scale


@dataclass(frozen=True)
class SegmentLengths:
    """Median lengths of segments that both tracks have, m.

    `notes` says so where the bodies differ so much that they may be two persons.
    """

    names: tuple[str, ...]
    result_m: tuple[float, ...]
    reference_m: tuple[float, ...]
    notes: tuple[str, ...] = ()


def compare_segment_lengths(result: PoseTrack, reference: PoseTrack) -> SegmentLengths:
    """Compare the bodies of two tracks, as a check that they show one person.

    Parameters
    ----------
    result, reference
        3D, in metres, at any times.
    """
    rows: list[tuple[str, float, float]] = []
    for name, proximal, distal in BODY_SEGMENTS:
        own = _segment_length(result, proximal, distal)
        other = _segment_length(reference, proximal, distal)
        if np.isfinite([own, other]).all() and other > 0:
            rows.append((name, own, other))
    ratios = [ours / theirs for name, ours, theirs in rows if name.endswith(LIMBS)]
    notes: tuple[str, ...] = ()
    if ratios and abs(np.mean(ratios) - 1.0) > OTHER_BODY:
        word = "longer" if np.mean(ratios) > 1.0 else "shorter"
        share = 100.0 * abs(np.mean(ratios) - 1.0)
        note = (
            f"The limbs of the result are {share:.0f} % {word} than those of the reference: is it "
            "another person, or a wrong stature?"
        )
        notes = (note,)
    return SegmentLengths(
        names=tuple(name for name, _, _ in rows),
        result_m=tuple(own for _, own, _ in rows),
        reference_m=tuple(other for _, _, other in rows),
        notes=notes,
    )


def _segment_length(track: PoseTrack, proximal: str, distal: str) -> float:
    skeleton = get_skeleton(track.skeleton)
    if not (skeleton.has(proximal) and skeleton.has(distal)):
        return float("nan")
    line = skeleton.point(track.position, distal) - skeleton.point(track.position, proximal)
    length = np.linalg.norm(line, axis=1)
    known = length[np.isfinite(length)]
    return float(np.median(known)) if known.size else float("nan")
