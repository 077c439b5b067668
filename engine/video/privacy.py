"""Heads made unrecognisable, for every person that was seen.

A region is laid over the head of the followed person and of everybody else, in every
frame. It fails safe: what is doubtful is covered generously, what is missing for a
moment stays covered, and where only the person's box is known the part of it
that can hold the head is covered.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, PoseTrack, ViewPose
from engine.skeletons import get_skeleton

__all__ = ["BlurRegion", "blur_regions", "estimate_head_regions"]

MIN_CONFIDENCE = 0.3
"""Below this a keypoint does not tell where the head is."""
HOLD_S = 2.0
"""How long a head or person that is no longer seen stays covered."""
GROWTH_PER_S = 0.5
"""Share by which the cover of a head grows per second since it was seen."""
HEAD_RADIUS_M = 0.19
"""Covers head and hair from a centre between the ears: half of 0.24 m, with margin for error."""
STEADY_S = 0.25
"""The cover is as large as the largest within this time, so that it does not pulse."""
N_CELLS = 5
"""Colour cells across a cover: 8 cm each on a head, too coarse for eyes, nose and mouth."""

EARS = ("left_ear", "right_ear")
FACE = ("nose", "left_eye", "right_eye", "left_mouth", "right_mouth", "head")
NECK_TO_HEAD_M = 0.25
"""From between the shoulders to between the ears."""
UNSURE_M = 0.06
"""Added to the radius when ears or face are missing: the middle is then less sure."""
UPRIGHT_ASPECT = 2.0
"""A box taller than this many widths holds somebody upright, whose head is in its upper part."""
UPRIGHT_SHARE = 0.4
"""Holds the head of an upright person even with the arms raised over it."""
BENT_SHARE = 0.7
"""Holds the head of a person who bends to the floor."""
RULERS: tuple[tuple[str, str, float], ...] = (
    ("left_ear", "right_ear", 0.155),
    ("nose", "left_ear", 0.13),
    ("nose", "right_ear", 0.13),
    ("left_shoulder", "right_shoulder", 0.36),
    ("left_shoulder", "left_hip", 0.52),
    ("right_shoulder", "right_hip", 0.52),
    ("left_hip", "left_knee", 0.42),
    ("right_hip", "right_knee", 0.42),
    ("left_knee", "left_ankle", 0.42),
    ("right_knee", "right_ankle", 0.42),
)
"""Pairs of keypoints and their distance on an adult of middle size (m).

Seen obliquely each looks shorter, never longer, so the largest ratio gives the scale.
"""


@dataclass(frozen=True)
class BlurRegion:
    """A part of the picture to cover: left, top, right, bottom in px.

    An ellipse that fits this box, or the whole box.
    """

    left: float
    top: float
    right: float
    bottom: float
    is_round: bool = True

    @classmethod
    def around(cls, x: float, y: float, radius: float) -> Self:
        """Return a circle."""
        return cls(x - radius, y - radius, x + radius, y + radius)

    @property
    def center(self) -> tuple[float, float]:
        """Middle of the region, px."""
        return (self.left + self.right) / 2, (self.top + self.bottom) / 2

    def grown(self, factor: float) -> BlurRegion:
        """Return the region enlarged about its middle."""
        x, y = self.center
        half_width = (self.right - self.left) / 2 * factor
        half_height = (self.bottom - self.top) / 2 * factor
        return replace(
            self,
            left=x - half_width,
            top=y - half_height,
            right=x + half_width,
            bottom=y + half_height,
        )

    def scaled(self, factor: float) -> BlurRegion:
        """Return the region for a picture of another size, `factor` times this one's."""
        return replace(
            self,
            left=self.left * factor,
            top=self.top * factor,
            right=self.right * factor,
            bottom=self.bottom * factor,
        )


def blur_regions(image: NDArray[np.uint8], regions: Iterable[BlurRegion]) -> None:
    """Cover regions of a picture, in place, so that nobody can be recognised.

    Each region keeps no more than 5 x 5 mean colours; between them the colour changes smoothly.
    What was under it can't be computed back. Outside the regions nothing changes.

    Parameters
    ----------
    image
        Shape (H, W, 3), uint8, writeable.
    regions
        In px of this picture; they may reach over its border.
    """
    height, width = image.shape[:2]
    for region in regions:
        left, top = max(0, int(np.floor(region.left))), max(0, int(np.floor(region.top)))
        right = min(width, int(np.ceil(region.right)))
        bottom = min(height, int(np.ceil(region.bottom)))
        if right <= left or bottom <= top:
            continue
        window = image[top:bottom, left:right]
        covered = _pixelate(window)
        if region.is_round:
            np.copyto(window, covered, where=_ellipse_mask(region, left, top, window.shape))
        else:
            window[:] = covered


def _pixelate(window: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = window.shape[:2]
    columns, rows = min(N_CELLS, -(-width // 4)), min(N_CELLS, -(-height // 4))
    cells = cv2.resize(window, (columns, rows), interpolation=cv2.INTER_AREA)
    smooth = cv2.resize(cells, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(smooth, dtype=np.uint8)


def _ellipse_mask(
    region: BlurRegion, left: int, top: int, shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Return shape (H, W, 1): which pixels of a window the ellipse touches."""
    x, y = region.center
    # Half a pixel more: a pixel counts as soon as the ellipse reaches into it.
    half_width = (region.right - region.left) / 2 + 0.5
    half_height = (region.bottom - region.top) / 2 + 0.5
    across = ((np.arange(shape[1]) + left + 0.5 - x) / half_width) ** 2
    down = ((np.arange(shape[0]) + top + 0.5 - y) / half_height) ** 2
    return np.asarray(down[:, None, None] + across[None, :, None] <= 1.0)


def estimate_head_regions(
    pose: ViewPose, *, min_confidence: float = MIN_CONFIDENCE, hold_s: float = HOLD_S
) -> tuple[tuple[BlurRegion, ...], ...]:
    """Estimate what must be covered in every frame so that no head can be recognised.

    Where the head of the followed person is seen, a circle covers it. Where it is not,
    three things are covered together: where it was and will be within `hold_s`, where the trunk
    points, and the part of the person's box that can hold it. Of other persons the part of the box
    that can hold the head is covered, carried over the frames in which nobody looked.

    Parameters
    ----------
    pose
        Keypoints and boxes of one view.
    min_confidence
        Keypoints below it do not tell where the head is; an unknown confidence counts as sure.
    hold_s
        How long something no longer (or not yet) seen stays covered, s.

    Returns
    -------
    tuple of tuple of BlurRegion
        Per frame of `pose.image`, in px of the original picture; empty where nobody was seen.
    """
    time_s = pose.image.time_s
    trusted = _trust_points(pose.image, min_confidence)
    scale = _estimate_scale(pose, trusted)
    heads = _find_heads(pose, trusted, scale)
    by_trunk = _find_heads_by_trunk(trusted, scale)
    by_box = [_head_part(*box) if np.isfinite(box).all() else None for box in pose.box]
    fallbacks = [_fill(time_s, guess, hold_s) for guess in (heads, by_trunk, by_box)]
    others = _cover_others(pose, hold_s)
    return tuple(
        (*((head,) if head is not None else (r for f in fallbacks for r in f[i])), *others[i])
        for i, head in enumerate(heads)
    )


def _trust_points(track: PoseTrack, min_confidence: float) -> dict[str, Array]:
    """Return the keypoints of head, trunk and legs, shape (T, 2) each, NaN where doubtful."""
    skeleton = get_skeleton(track.skeleton)
    names = {*EARS, *FACE, *(name for a, b, _ in RULERS for name in (a, b))}
    confidence = np.ones(track.position.shape[:2])
    if track.confidence is not None:
        confidence = np.where(np.isnan(track.confidence), 1.0, track.confidence)
    points = {}
    for name in names & set(skeleton.keypoints):
        column = skeleton.index(name)
        sure = confidence[:, column] >= min_confidence
        points[name] = np.where(sure[:, None], track.position[:, column, :2], np.nan)
    missing = np.full((track.n_frames, 2), np.nan)
    return {name: points.get(name, missing) for name in names}


def _estimate_scale(pose: ViewPose, trusted: dict[str, Array]) -> Array:
    """Return px per metre at the person, shape (T,): the largest within `STEADY_S`; NaN if unknown.

    Nobody's box is shorter than 0.9 m on its longer side, which bounds what a stray keypoint does.
    """
    ratios = [np.linalg.norm(trusted[a] - trusted[b], axis=1) / m for a, b, m in RULERS]
    box_side = np.fmax(pose.box[:, 2] - pose.box[:, 0], pose.box[:, 3] - pose.box[:, 1])
    scale = np.fmin(np.fmax.reduce(ratios), np.where(box_side > 0, box_side / 0.9, np.inf))
    time_s = pose.image.time_s
    first = np.searchsorted(time_s, time_s - STEADY_S)
    last = np.searchsorted(time_s, time_s + STEADY_S, side="right")
    return np.array([np.fmax.reduce(scale[i:j]) for i, j in zip(first, last, strict=True)])


def _mean_of(points: dict[str, Array], names: Sequence[str]) -> Array:
    """Return the mean of the points that exist, shape (T, 2)."""
    stack = np.stack([points[name] for name in names])
    found = np.isfinite(stack)
    count = found.sum(axis=0)
    total = np.where(found, stack, 0.0).sum(axis=0)
    return np.asarray(np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0))


def _find_heads(pose: ViewPose, trusted: dict[str, Array], scale: Array) -> list[BlurRegion | None]:
    """Return a circle over the head where two of its keypoints are trusted."""
    ears, face = _mean_of(trusted, EARS), _mean_of(trusted, FACE)
    both = np.isfinite(ears[:, 0] + face[:, 0])
    center = np.where(both[:, None], 0.7 * ears + 0.3 * face, np.fmax(ears, face))
    stack = np.stack([trusted[name] for name in (*EARS, *FACE)])
    reach = np.fmax.reduce(np.linalg.norm(stack - center, axis=2))
    radius = (HEAD_RADIUS_M + np.where(both, 0.0, UNSURE_M)) * scale
    radius = np.fmax(radius, 1.4 * reach + UNSURE_M * scale)
    enough = np.isfinite(stack[:, :, 0]).sum(axis=0) >= 2
    usable = enough & _is_in_box(center, pose.box)
    return _make_circles(center, np.where(usable, radius, np.nan))


def _make_circles(center: Array, radius: Array) -> list[BlurRegion | None]:
    """Return one circle a frame; None where a value is missing."""
    rows = np.column_stack([center, radius])
    return [BlurRegion.around(*row) if np.isfinite(row).all() else None for row in rows]


def _is_in_box(center: Array, box: Array) -> NDArray[np.bool_]:
    """Return whether a head lies in or near the person's box; True where there is no box."""
    margin = 0.25 * np.fmax(box[:, 2] - box[:, 0], box[:, 3] - box[:, 1])[:, None]
    outside = (center < box[:, :2] - margin) | (center > box[:, 2:] + margin)
    return np.asarray(~outside.any(axis=1))


def _find_heads_by_trunk(trusted: dict[str, Array], scale: Array) -> list[BlurRegion | None]:
    """Return a wide circle where the trunk points, as far as shoulders and hips are trusted."""
    shoulders = _mean_of(trusted, ("left_shoulder", "right_shoulder"))
    trunk = shoulders - _mean_of(trusted, ("left_hip", "right_hip"))
    length = np.linalg.norm(trunk, axis=1, keepdims=True)
    unit = np.divide(trunk, length, out=np.full(trunk.shape, np.nan), where=length > 0)
    center = shoulders + unit * (NECK_TO_HEAD_M * scale)[:, None]
    radius = 1.5 * HEAD_RADIUS_M * scale
    return [
        BlurRegion.around(float(c[0]), float(c[1]), float(r))
        if np.isfinite([*c, r]).all()
        else None
        for c, r in zip(center, radius, strict=True)
    ]


def _head_part(left: float, top: float, right: float, bottom: float) -> BlurRegion:
    """Return the part of a person's box that can hold the head, with a margin."""
    width, height = right - left, bottom - top
    share = UPRIGHT_SHARE if height > UPRIGHT_ASPECT * width else BENT_SHARE
    return BlurRegion(
        left=left - 0.05 * width,
        top=top - 0.05 * height,
        right=right + 0.05 * width,
        bottom=top + share * height,
        is_round=False,
    )


def _cover_others(pose: ViewPose, hold_s: float) -> list[tuple[BlurRegion, ...]]:
    """Return the covers of the other persons in every frame, carried over unseen frames."""
    time_s = pose.image.time_s
    seen = [
        tuple(_head_part(b.left, b.top, b.right, b.bottom) for b in boxes) for boxes in pose.others
    ]
    seen += [()] * (time_s.size - len(seen))
    tracks = [_fill(time_s, track, hold_s) for track in _link(time_s, seen, hold_s)]
    return [tuple(region for track in tracks for region in track[i]) for i in range(time_s.size)]


def _link(
    time_s: Array, seen: Sequence[Sequence[BlurRegion]], hold_s: float
) -> list[list[BlurRegion | None]]:
    """Join what was seen into one track per person, by nearness."""
    tracks: list[list[BlurRegion | None]] = []
    latest: list[tuple[float, BlurRegion]] = []
    for i, regions in enumerate(seen):
        free = [k for k, (last_s, _) in enumerate(latest) if time_s[i] - last_s <= hold_s]
        for region in regions:
            near = {k: _distance(latest[k][1], region) for k in free}
            k = min(near, key=lambda key: near[key], default=-1)
            if k < 0 or near[k] > 1.0:
                k = len(tracks)
                tracks.append([None] * len(seen))
                latest.append((0.0, region))
            else:
                free.remove(k)
            tracks[k][i] = region
            latest[k] = (float(time_s[i]), region)
    return tracks


def _distance(a: BlurRegion, b: BlurRegion) -> float:
    """Return the distance of two regions relative to their size."""
    (ax, ay), (bx, by) = a.center, b.center
    size = max(a.right - a.left, b.right - b.left, a.bottom - a.top, b.bottom - b.top)
    return float(np.hypot(ax - bx, ay - by)) / max(size, 1e-9)


def _fill(
    time_s: Array, track: Sequence[BlurRegion | None], hold_s: float
) -> list[tuple[BlurRegion, ...]]:
    """Return the covers of one head in every frame: as seen, between two sightings, or held.

    A gap up to `hold_s` is bridged in a straight line; in a longer one the last and the next
    sighting stay covered for `hold_s` each. All grow with the time from the sighting.
    """
    known = [i for i, region in enumerate(track) if region is not None]
    filled: list[tuple[BlurRegion, ...]] = []
    for i, region in enumerate(track):
        if region is not None:
            filled.append((region,))
            continue
        k = int(np.searchsorted(known, i))
        ends = [known[j] for j in (k - 1, k) if 0 <= j < len(known)]
        filled.append(_cover_gap(time_s, track, i, ends, hold_s))
    return filled


def _cover_gap(
    time_s: Array,
    track: Sequence[BlurRegion | None],
    i: int,
    ends: Sequence[int],
    hold_s: float,
) -> tuple[BlurRegion, ...]:
    held = {j: track[j] for j in ends}
    ages = {j: abs(float(time_s[i] - time_s[j])) for j in ends}
    if len(ends) == 2 and time_s[ends[1]] - time_s[ends[0]] <= hold_s:
        before, after = (held[j] for j in ends)
        if before is not None and after is not None:
            share = ages[ends[0]] / (ages[ends[0]] + ages[ends[1]])
            middle = _between(before, after, share)
            return (middle.grown(1.15 + GROWTH_PER_S * min(ages.values())),)
    return tuple(
        region.grown(1.0 + GROWTH_PER_S * ages[j])
        for j, region in held.items()
        if region is not None and ages[j] <= hold_s
    )


def _between(a: BlurRegion, b: BlurRegion, share: float) -> BlurRegion:
    def mix(x: float, y: float) -> float:
        return (1 - share) * x + share * y

    return BlurRegion(
        mix(a.left, b.left),
        mix(a.top, b.top),
        mix(a.right, b.right),
        mix(a.bottom, b.bottom),
        is_round=a.is_round and b.is_round,
    )
