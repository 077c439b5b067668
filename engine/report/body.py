"""The person: the photograph of a moment, or a stick figure of the measured joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from engine.datatypes import Array
from engine.report.fonts import text_width
from engine.report.layout import INK, QUIET, SOFT
from engine.report.levels import LEFT, RIGHT, TICK, write_line
from engine.report.picture import Photo
from engine.report.sheet import Sheet
from engine.report.wording import Words
from engine.skeletons import get_skeleton
from engine.storage.results import StoredResult

__all__ = ["PhotoBox", "StickFigure", "pose_at"]


@dataclass(frozen=True)
class PhotoBox:
    """A photograph, as large as fits."""

    photo: Photo
    alt: str
    height_pt: float = 165.0

    def height(self, width: float) -> float:
        """Return the height: that of the picture where it is limited by the width."""
        return min(self.height_pt, width * self.photo.height_px / self.photo.width_px)

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw it in the middle of its box."""
        height = self.height(width)
        shown = min(width, height * self.photo.width_px / self.photo.height_px)
        if shown < width - 1:
            sheet.rectangle(x, top - height, width, height, fill=SOFT)
        with sheet.tag("Figure", alt=self.alt):
            sheet.image(self.photo.jpeg, x + (width - shown) / 2, top - height, shown, height)


FACE = ("nose", "eye", "ear", "mouth")
HEAD_RADIUS_M = 0.105
SEARCH_S = 0.15


def pose_at(stored: StoredResult, time_s: float) -> Array | None:
    """Return the joints close to a moment as seen by the camera.

    Returns
    -------
    Array or None
        Shape (K, 2), metres to the right and up, NaN where missing; None where too little was
        measured to draw anything.
    """
    track = stored.corrected
    near = np.flatnonzero(np.abs(track.time_s - time_s) <= SEARCH_S)
    if not near.size:
        near = np.array([int(np.argmin(np.abs(track.time_s - time_s)))])
    best = near[int(np.argmax(track.is_present[near].sum(axis=1)))]
    if track.is_present[best].sum() < 4:
        return None
    rotation = stored.scene.camera.rotation
    if rotation is None or track.frame_of_reference != "world":
        return None
    seen = track.position[best] @ np.asarray(rotation).T
    return np.stack([seen[:, 0], -seen[:, 1]], axis=1)


@dataclass(frozen=True, eq=False)
class StickFigure:
    """The measured joints of one moment as a drawing; `points` (K, 2) in metres."""

    points: Array
    skeleton: str
    words: Words
    height_pt: float = 165.0

    def height(self, width: float) -> float:
        """Return its fixed height."""
        return self.height_pt

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw floor, bones and head."""
        bottom = top - self.height_pt
        with sheet.tag("Figure", alt=self.words["alt_figure"]):
            sheet.rectangle(x, bottom, width, self.height_pt, fill=SOFT)
            place, scale = self._fit(x, bottom, width)
            sheet.polyline(
                [(x + 14, bottom + 14), (x + width - 14, bottom + 14)], stroke=QUIET, line=0.8
            )
            self._draw_bones(sheet, place)
            self._draw_head(sheet, place, scale)
            at = x + 14
            for side, colour in (("left", LEFT), ("right", RIGHT)):
                sheet.polyline([(at, bottom + 6.5), (at + 12, bottom + 6.5)], stroke=colour, line=2)
                write_line(sheet, at + 16, bottom + 4.5, self.words[side], TICK)
                at += 24 + text_width(self.words[side], TICK.font, TICK.size)

    def _fit(self, x: float, bottom: float, width: float) -> tuple[Array, float]:
        seen = self.points[np.isfinite(self.points).all(axis=1)]
        low, high = seen.min(axis=0) - (0.15, 0.02), seen.max(axis=0) + 0.15
        scale = min((width - 24) / (high[0] - low[0]), (self.height_pt - 22) / (high[1] - low[1]))
        place = (self.points - np.array([(low[0] + high[0]) / 2, low[1]])) * scale
        return place + np.array([x + width / 2, bottom + 14]), float(scale)

    def _draw_bones(self, sheet: Sheet, place: Array) -> None:
        known = get_skeleton(self.skeleton)
        for a, b in known.edges:
            ends = place[[known.index(a), known.index(b)]]
            if np.isfinite(ends).all() and not (_is_face(a) or _is_face(b)):
                line = [(float(px), float(py)) for px, py in ends]
                sheet.polyline(line, stroke=_side_colour(a, b), line=2.6)

    def _draw_head(self, sheet: Sheet, place: Array, scale: float) -> None:
        names = get_skeleton(self.skeleton).keypoints
        face = place[[i for i, name in enumerate(names) if _is_face(name) or name == "head"]]
        face = face[np.isfinite(face).all(axis=1)]
        if face.size:
            px, py = (float(v) for v in face.mean(axis=0))
            shoulders = place[[i for i, name in enumerate(names) if name.endswith("_shoulder")]]
            if np.isfinite(shoulders).all():
                sx, sy = (float(v) for v in shoulders.mean(axis=0))
                sheet.polyline([(sx, sy), (px, py)], stroke=INK, line=2.6)
            sheet.circle(px, py, HEAD_RADIUS_M * scale, fill="#ffffff", stroke=INK, line=1.4)


def _is_face(name: str) -> bool:
    return any(part in name for part in FACE)


def _side_colour(*names: str) -> str:
    if all(name.startswith("left_") for name in names):
        return LEFT
    return RIGHT if all(name.startswith("right_") for name in names) else INK
