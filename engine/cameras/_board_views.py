"""Finding a calibration board in pictures, and saying why it is not found."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Frame, ProgressCallback, ignore_progress
from engine.errors import CalibrationError, ConfigError

__all__ = ["BoardSpec", "BoardView", "Sightings", "collect_views", "make_aruco_board"]

BoardKind = Literal["charuco", "checkerboard"]
Gray = NDArray[np.uint8]

DICTIONARIES = {
    name: getattr(cv2.aruco, name)
    for name in sorted(dir(cv2.aruco))
    if name.startswith(("DICT_4X4", "DICT_5X5", "DICT_6X6", "DICT_7X7"))
}
SQUARE_M = (0.008, 0.5)
MEASURED_TO_M = 0.0005
"""A ruler laid along the whole board reads to half a millimetre."""
SEARCH_SIDE_PX = 1280
"""A checkerboard is looked for in a picture of at most this size, then located in the full one."""
LEAST_CORNERS = 6
QUICK_SEARCH = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE + cv2.CALIB_CB_FAST_CHECK
KEPT_PICTURES = 6
"""Pictures kept for finding out what is wrong."""
LEAST_CONTRAST = 12.0
MISTAKEN_PX = 0.7
"""Lenses bend the corners of one view by less than this from a plane's perspective."""


@dataclass(frozen=True)
class BoardSpec:
    """The board that is filmed.

    Parameters
    ----------
    kind
        `charuco` (a checkerboard with markers) or `checkerboard`.
    columns, rows
        Squares, not inner corners.
    square_m
        Side of a square as measured on the print, m.
    marker_m
        Side of a marker's black border (charuco), m; by default three quarters of a square.
    dictionary
        OpenCV's name of the markers' set (charuco).
    scale_sigma
        Relative standard error of the squares' size; NaN for that of a ruler along the board.
    """

    kind: BoardKind = "charuco"
    columns: int = 6
    rows: int = 4
    square_m: float = 0.064
    marker_m: float | None = None
    dictionary: str = "DICT_4X4_50"
    scale_sigma: float = math.nan

    def __post_init__(self) -> None:
        if self.kind not in ("charuco", "checkerboard"):
            raise ConfigError(f"The board must be charuco or checkerboard, got {self.kind!r}.")
        least = 3 if self.kind == "charuco" else 4
        if not (least <= self.columns <= 30 and least <= self.rows <= 30):
            raise ConfigError(
                f"A {self.kind} board has {least} to 30 columns and rows of squares, got "
                f"{self.columns} x {self.rows}."
            )
        if self.kind == "checkerboard" and self.columns == self.rows:
            raise ConfigError(
                f"A checkerboard of {self.columns} x {self.rows} squares looks the same from four "
                "sides; use one with unequal columns and rows, such as 7 x 5."
            )
        _require_square(self.square_m)
        if self.marker_m is not None and not 0.3 * self.square_m < self.marker_m < self.square_m:
            raise ConfigError(
                f"Markers must be smaller than squares, but more than a third of them; got "
                f"{self.marker_m * 1000:g} mm in squares of {self.square_m * 1000:g} mm."
            )
        if self.dictionary not in DICTIONARIES:
            raise ConfigError(
                f"Unknown set of markers {self.dictionary!r}; expected one such as DICT_4X4_50."
            )

    @property
    def marker_side_m(self) -> float:
        """Side of a marker, m."""
        return 0.75 * self.square_m if self.marker_m is None else self.marker_m

    @property
    def corners(self) -> Array:
        """Places of the inner corners on the board, shape ((columns - 1) * (rows - 1), 3), m."""
        across, down = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        flat = np.stack([across.ravel(), down.ravel(), np.zeros(across.size)], axis=1)
        return np.asarray(self.square_m * flat)

    @property
    def size_sigma(self) -> float:
        """Relative standard error of the board's size."""
        if math.isfinite(self.scale_sigma):
            return self.scale_sigma
        return MEASURED_TO_M / (self.square_m * max(self.columns, self.rows))

    @property
    def is_symmetric(self) -> bool:
        """Whether the board looks the same when turned by half a turn."""
        return self.kind == "checkerboard" and (self.columns + self.rows) % 2 == 0


def _require_square(square_m: float) -> None:
    if not SQUARE_M[0] <= square_m <= SQUARE_M[1]:
        hint = ""
        if math.isfinite(square_m) and SQUARE_M[0] <= square_m * 10 <= 0.15:
            hint = f" It looks like centimetres: did you mean {square_m * 10000:g} mm?"
        raise ConfigError(
            f"The squares must be {SQUARE_M[0] * 1000:g} to {SQUARE_M[1] * 1000:g} mm, got "
            f"{square_m * 1000:g} mm.{hint}"
        )


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board as seen in one picture.

    `rows` (n,) number the inner corners as `BoardSpec.corners` does, `pixels` (n, 2) are their
    places. `speed_px_s` is how fast they move, NaN where no neighbour in time shows them.
    """

    time_s: float
    rows: NDArray[np.intp]
    pixels: Array
    speed_px_s: float = math.nan


@dataclass(frozen=True, eq=False)
class Sightings:
    """All views of the board by one camera. `pictures` are a few for finding faults."""

    name: str
    size_px: tuple[int, int]
    views: tuple[BoardView, ...]
    n_pictures: int
    pictures: tuple[Gray, ...] = field(repr=False, default=())


class _Finder(Protocol):
    def find(self, gray: Gray) -> tuple[NDArray[np.intp], Array] | None:
        """Return the numbers and places of the corners in a picture."""


def collect_views(
    frames: Iterable[Frame],
    board: BoardSpec,
    name: str,
    *,
    every_s: float = 0.2,
    is_thorough: bool = False,
    progress: ProgressCallback = ignore_progress,
) -> Sightings:
    """Look for the board in pictures.

    Parameters
    ----------
    frames
        Of one camera, in order of time.
    board
        What to look for.
    name
        Of the camera.
    every_s
        Pictures nearer in time than this to the last one are left out.
    is_thorough
        Look longer in every picture, for a few stills.
    progress
        Called with the number of pictures looked at.

    Raises
    ------
    CalibrationError
        If there are no pictures, they change their size, or the board is not in them; it says
        why, where that can be told.
    """
    finder = _make_finder(board, is_thorough=is_thorough)
    views: list[BoardView] = []
    pictures: list[Gray] = []
    size_px: tuple[int, int] | None = None
    n_pictures, kept_every, last_s = 0, 1, -math.inf
    for frame in frames:
        if frame.time_s - last_s < every_s - 1e-6:
            continue
        gray = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        size_px = _require_same_size(size_px, (gray.shape[1], gray.shape[0]), name)
        found = finder.find(gray)
        if found is not None:
            views.append(BoardView(frame.time_s, *found))
        if n_pictures % kept_every == 0:
            pictures.append(gray)
        if len(pictures) > KEPT_PICTURES:
            pictures, kept_every = pictures[::2], kept_every * 2
        n_pictures, last_s = n_pictures + 1, frame.time_s
        progress(f"board in {name}", n_pictures, 0)
    if size_px is None:
        raise CalibrationError(f"There are no pictures of camera {name}.")
    if not views:
        raise CalibrationError(_explain_absence(board, pictures, name, n_pictures))
    if board.kind == "checkerboard":
        _require_whole_board(board, pictures, name, is_thorough=is_thorough)
    return Sightings(name, size_px, _with_speeds(views), n_pictures, tuple(pictures))


def _make_finder(board: BoardSpec, *, is_thorough: bool) -> _Finder:
    if board.kind == "charuco":
        return _CharucoFinder(board)
    return _CheckerFinder(board, is_thorough=is_thorough)


def make_aruco_board(board: BoardSpec, *, is_legacy: bool = False) -> Any:
    """Return OpenCV's own object for a charuco board."""
    aruco = cv2.aruco.CharucoBoard(
        (board.columns, board.rows),
        board.square_m,
        board.marker_side_m,
        cv2.aruco.getPredefinedDictionary(DICTIONARIES[board.dictionary]),
    )
    aruco.setLegacyPattern(is_legacy)
    return aruco


class _CharucoFinder:
    """Finds boards with markers, also those of OpenCV before 4.6, whose first square is white."""

    def __init__(self, board: BoardSpec) -> None:
        self._flat = board.corners[:, :2]
        self._detectors = [
            cv2.aruco.CharucoDetector(make_aruco_board(board, is_legacy=is_legacy))
            for is_legacy in (False, True)
        ]

    def find(self, gray: Gray) -> tuple[NDArray[np.intp], Array] | None:
        for index, detector in enumerate(self._detectors):
            corners, rows, _, markers = detector.detectBoard(gray)
            if corners is not None and len(corners) >= LEAST_CORNERS:
                if index:
                    self._detectors.reverse()
                return self._clean(
                    np.asarray(rows).ravel().astype(np.intp),
                    np.asarray(corners, dtype=np.float64).reshape(-1, 2),
                )
            if markers is None or len(markers) < 3:
                return None
        return None

    def _clean(
        self, rows: NDArray[np.intp], pixels: Array
    ) -> tuple[NDArray[np.intp], Array] | None:
        """Leave out corners that were taken for an edge of a marker beside them."""
        if _is_on_line(pixels):
            return None
        homography, _ = cv2.findHomography(self._flat[rows], pixels, cv2.RANSAC, MISTAKEN_PX)
        if np.size(homography) != 9:
            return None
        expected = cv2.perspectiveTransform(self._flat[rows][None], homography)[0]
        miss = np.linalg.norm(expected - pixels, axis=1)
        is_good = miss <= max(MISTAKEN_PX, 3.0 * float(np.median(miss)))
        if is_good.sum() < LEAST_CORNERS or _is_on_line(pixels[is_good]):
            return None
        return rows[is_good], pixels[is_good]


class _CheckerFinder:
    """Finds plain checkerboards; the dark first square tells which way round they lie."""

    def __init__(self, board: BoardSpec, *, is_thorough: bool) -> None:
        self._pattern = (board.columns - 1, board.rows - 1)
        self._is_symmetric = board.is_symmetric
        self._is_thorough = is_thorough

    def find(self, gray: Gray) -> tuple[NDArray[np.intp], Array] | None:
        pixels = _find_checkers(gray, self._pattern, is_thorough=self._is_thorough)
        if pixels is None:
            return None
        contrast = _compare_colours(gray, pixels, self._pattern)
        if abs(contrast) < LEAST_CONTRAST:
            return None
        if contrast > 0 and not self._is_symmetric:
            pixels = pixels[::-1]
        return np.arange(len(pixels)), pixels


def _find_checkers(gray: Gray, pattern: tuple[int, int], *, is_thorough: bool) -> Array | None:
    """Return the inner corners row by row, shape (n, 2), px.

    The quick search takes a thirtieth of the thorough one's time, in which it finds boards that
    are blurred or unevenly lit too.
    """
    scale = min(1.0, SEARCH_SIDE_PX / max(gray.shape))
    small = gray
    if scale < 1.0:
        small = np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    is_found, corners = cv2.findChessboardCorners(small, pattern, flags=QUICK_SEARCH)
    if not is_found and is_thorough:
        is_found, corners = cv2.findChessboardCornersSB(small, pattern)
    if not is_found:
        return None
    # Integers are pixel centres, so the pictures' corners lie at -0.5.
    pixels = (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
    return _locate(gray, _to_right_hand(pixels, pattern), pattern)


def _to_right_hand(pixels: Array, pattern: tuple[int, int]) -> Array:
    """Return the corners with columns to the right of rows, as on a board seen from the front."""
    grid = pixels.reshape(pattern[1], pattern[0], 2)
    across, down = grid[:, -1] - grid[:, 0], grid[-1] - grid[0]
    (ax, ay), (bx, by) = across.mean(axis=0), down.mean(axis=0)
    return grid[:, ::-1].reshape(-1, 2) if ax * by < ay * bx else pixels


def _locate(gray: Gray, pixels: Array, pattern: tuple[int, int]) -> Array:
    """Return the corners in the full picture, to a few hundredths of a pixel."""
    grid = pixels.reshape(pattern[1], pattern[0], 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    half = max(2, min(20, int(0.4 * min(steps))))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 0.001)
    start = np.ascontiguousarray(pixels.reshape(-1, 1, 2), dtype=np.float32)
    moved = cv2.cornerSubPix(gray, start, (half, half), (-1, -1), stop)
    return np.asarray(moved, dtype=np.float64).reshape(-1, 2)


def _compare_colours(gray: Gray, pixels: Array, pattern: tuple[int, int]) -> float:
    """Return how much brighter the first inner square and those like it are than the others."""
    grid = pixels.reshape(pattern[1], pattern[0], 2)
    middle = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    x, y = np.round(middle).astype(int).reshape(-1, 2).T
    height, width = gray.shape
    bright = gray[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(float)
    like_first = (np.indices(middle.shape[:2]).sum(axis=0) % 2 == 0).ravel()
    return float(bright[like_first].mean() - bright[~like_first].mean())


def _is_on_line(pixels: Array) -> bool:
    spread = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)
    return bool(spread[1] < 0.05 * spread[0])


def _with_speeds(views: Sequence[BoardView]) -> tuple[BoardView, ...]:
    return tuple(
        replace(view, speed_px_s=_speed(view, [*views[max(0, i - 1) : i], *views[i + 1 : i + 2]]))
        for i, view in enumerate(views)
    )


def _speed(view: BoardView, neighbours: Sequence[BoardView]) -> float:
    speeds = []
    for other in neighbours:
        _, here, there = np.intersect1d(view.rows, other.rows, return_indices=True)
        gap_s = abs(other.time_s - view.time_s)
        if len(here) and gap_s <= 1.0:
            moved = np.linalg.norm(view.pixels[here] - other.pixels[there], axis=1)
            speeds.append(float(np.median(moved)) / gap_s)
    return max(speeds, default=math.nan)


def _require_same_size(
    known: tuple[int, int] | None, size: tuple[int, int], name: str
) -> tuple[int, int]:
    if known is not None and known != size:
        raise CalibrationError(
            f"The pictures of camera {name} have different sizes ({known[0]} x {known[1]} and "
            f"{size[0]} x {size[1]} px); use those of one format."
        )
    return size


def _require_whole_board(
    board: BoardSpec, pictures: Sequence[Gray], name: str, *, is_thorough: bool
) -> None:
    """Refuse a board that is larger than stated: any part of it would fit, another in each view."""
    pattern = (board.columns - 1, board.rows - 1)
    for gray in pictures:
        pixels = _find_checkers(gray, pattern, is_thorough=is_thorough)
        if pixels is not None and _goes_on(gray, pixels, pattern):
            raise CalibrationError(
                f"The checkerboard in the pictures of {name} has more than {board.columns} x "
                f"{board.rows} squares; count all its squares, not its inner corners."
            )


def _goes_on(gray: Gray, pixels: Array, pattern: tuple[int, int]) -> bool:
    """Return whether squares of both colours follow beyond the outer ones on any side."""
    columns, rows = pattern
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    homography, _ = cv2.findHomography(grid.astype(np.float64), pixels)
    along_x, along_y = np.arange(columns - 1) + 0.5, np.arange(rows - 1) + 0.5
    sides = [(along_x, np.full(columns - 1, y)) for y in (-1.5, rows + 0.5)]
    sides += [(np.full(rows - 1, x), along_y) for x in (-1.5, columns + 0.5)]
    inside = abs(_compare_colours(gray, pixels, pattern))
    height, width = gray.shape
    for x, y in sides:
        places = cv2.perspectiveTransform(np.stack([x, y], axis=1)[None], homography)[0]
        u, v = np.round(places).astype(int).T
        if (u < 0).any() or (v < 0).any() or (u >= width).any() or (v >= height).any():
            continue
        bright = gray[v, u].astype(float)
        is_even = np.arange(len(bright)) % 2 == 0
        if abs(bright[is_even].mean() - bright[~is_even].mean()) > 0.5 * inside:
            return True
    return False


def _explain_absence(board: BoardSpec, pictures: Sequence[Gray], name: str, n_pictures: int) -> str:
    """Return the likeliest reason why a board is in none of the pictures."""
    reasons = _CHARUCO_FAULTS if board.kind == "charuco" else _CHECKER_FAULTS
    for explain in reasons:
        reason = explain(board, pictures)
        if reason:
            return f"Camera {name}: {reason}"
    return (
        f"Camera {name}: the {board.kind} board of {board.columns} x {board.rows} squares is in "
        f"none of {n_pictures} pictures. Film the whole board flat, sharp and well lit, so near "
        "that a square is at least 15 px wide."
    )


def _count_corners(board: BoardSpec, pictures: Sequence[Gray]) -> int:
    finder = _CharucoFinder(board)
    return sum(finder.find(gray) is not None for gray in pictures)


def _is_exchanged(board: BoardSpec, pictures: Sequence[Gray]) -> str:
    other = replace(board, columns=board.rows, rows=board.columns)
    if board.columns == board.rows or not _count_corners(other, pictures):
        return ""
    return (
        f"columns and rows are exchanged: the board in the pictures has {other.columns} columns "
        f"and {other.rows} rows."
    )


def _is_mirrored(board: BoardSpec, pictures: Sequence[Gray]) -> str:
    if not _count_corners(board, [np.ascontiguousarray(gray[:, ::-1]) for gray in pictures]):
        return ""
    return (
        "the pictures are mirrored, as those of a selfie camera; film with the main camera, or "
        "switch mirroring off."
    )


def _is_other_size(board: BoardSpec, pictures: Sequence[Gray]) -> str:
    seen = _most_markers(board.dictionary, pictures)
    if seen < 4:
        return ""
    return (
        f"the markers are there, but not as on a board of {board.columns} x {board.rows} squares; "
        "count the columns and rows of squares again."
    )


def _is_other_set(board: BoardSpec, pictures: Sequence[Gray]) -> str:
    counts = {n: _most_markers(n, pictures) for n in DICTIONARIES if n.endswith(("50", "250"))}
    best = max(counts, key=lambda name: counts[name])
    if counts[best] < 6 or best == board.dictionary:
        return ""
    return f"the board's markers are of the set {best}, not {board.dictionary}."


def _most_markers(dictionary: str, pictures: Sequence[Gray]) -> int:
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]))
    found = [detector.detectMarkers(gray)[1] for gray in pictures]
    return max((len(set(np.ravel(ids))) for ids in found if ids is not None), default=0)


def _is_miscounted(board: BoardSpec, pictures: Sequence[Gray]) -> str:
    stated = (board.columns, board.rows)
    # Inner corners given for squares, one line missed, or the outer squares not counted.
    for more in ((1, 1), (-1, -1), (1, 0), (0, 1), (-1, 0), (0, -1)):
        columns, rows = stated[0] + more[0], stated[1] + more[1]
        if min(columns, rows) < 4 or columns == rows:
            continue
        pattern = (columns - 1, rows - 1)
        if any(_find_checkers(gray, pattern, is_thorough=False) is not None for gray in pictures):
            return (
                f"the pictures show {columns} x {rows} squares of a checkerboard, not {stated[0]} "
                f"x {stated[1]}; count squares, not inner corners, and film the whole board."
            )
    return ""


_Explain = Callable[[BoardSpec, Sequence[Gray]], str]
_CHARUCO_FAULTS: tuple[_Explain, ...] = (_is_exchanged, _is_mirrored, _is_other_size, _is_other_set)
_CHECKER_FAULTS: tuple[_Explain, ...] = (_is_miscounted,)
