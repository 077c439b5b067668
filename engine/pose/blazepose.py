"""BlazePose: geometry, decoding and the follower that keeps its own region.

Two networks work together (Bazarevsky et al. 2020): a detector that finds a person's
mid-hip and the size of a circle around the whole body, and a landmark network that sees a
turned square crop and returns 33 landmarks, their world coordinates, and two auxiliary points
that give the crop for the next frame.

Picture coordinates are px with integers at pixel centres, as OpenCV and the camera models
use them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import BackendUnavailable
from engine.timing import NETWORK_CLOCK, BusyClock

__all__ = [
    "BlazePoseNetworks",
    "Landmarks",
    "PoseDetection",
    "PoseFollower",
    "PoseGlance",
    "Region",
    "crop_matrix",
    "decode_detections",
    "estimate_sigma_px",
    "hold_region",
    "make_anchors",
    "merge_detections",
    "refine_by_heatmap",
    "region_from_points",
]

P = ParamSpec("P")
R = TypeVar("R")

Image = NDArray[np.uint8]
Float32 = NDArray[np.float32]

DETECTOR_SIZE_PX: Final = 224
CROP_SIZE_PX: Final = 256
N_LANDMARKS: Final = 33
SIGMA_SURE: Final = 0.009
SIGMA_GUESS: Final = 0.05
SURE_CONFIDENCE: Final = 0.7
"""Standard error of a coordinate as a share of the region's side: of landmarks from this confidence
on, and of a confidence of 0; linear between. Measured on the five training persons of the
synthetic lifts against projected joint centres, after taking out the constant difference of
definition (model card).
"""

HIP_CENTRE, BODY_TOP = 33, 34
"""Rows of the auxiliary points: the centre of the next region and a point on its circle."""

ANCHOR_GRIDS: Final = ((28, 2), (14, 2), (7, 6))
"""Cells a side and anchors a cell, in the order of the network's rows."""

REGION_SCALE: Final = 1.25
NMS_IOU: Final = 0.3
HEATMAP_RADIUS: Final = 3
HEATMAP_MIN_CONFIDENCE: Final = 0.5

HIP_SHARE: Final = 0.4
"""How far from the middle of a search square hips may lie, as a share of its side: the edge of
the person's box inside it, for the hips of a bent person lie at the end of the box."""
HOLD_SHIFT: Final = 0.03
HOLD_GROWTH: Final = 0.04
HOLD_TURN_RAD: Final = 0.08
"""The region stays where it is until the next one is further away than this (shift as a share of
its side). A crop that follows every frame makes the landmarks jitter about 1.7 times as much.
"""

MAX_AHEAD: Final = 2
"""Frames that are looked at together."""

CROP_OFFSET_PX: Final = 0.0
"""Where in a crop pixel the picture is sampled when landmarks are sought.

0 is what MediaPipe's own runtime does and gives its landmarks to 0.02 px. Mirrored pictures show
that 0.5 would remove a shift to the right by 0.2 % of the crop, which no angle sees (model card).
"""
DETECTOR_OFFSET_PX: Final = 0.0

MODEL_DIR: Final = Path(__file__).parent / "models"
MODEL_BYTES: Final = {
    "pose_detector.onnx": 6_009_419,
    "pose_landmark_heavy.onnx": 27_698_613,
    "pose_landmark_full.onnx": 6_425_288,
}


@dataclass(frozen=True)
class Region:
    """A turned square in the picture: centre and side in px, angle in radians (clockwise)."""

    x: float
    y: float
    size: float
    angle: float = 0.0

    @property
    def is_usable(self) -> bool:
        """Whether a crop can be cut from it."""
        return math.isfinite(self.x + self.y + self.size + self.angle) and self.size >= 8.0


@dataclass(frozen=True, eq=False)
class PoseDetection:
    """One person the detector saw.

    `box` is left, top, right, bottom (of the face and shoulders) and `points` (4, 2) the key
    points: mid-hip, a point on the circle around the body, mid-shoulder, a point above it; px.
    """

    box: Array
    points: Array
    score: float


@dataclass(frozen=True, eq=False)
class Landmarks:
    """What the landmark network saw in one region.

    `image` (33, 2) px; `world` (33, 3) m around the mid-hip in camera axes (x right, y down,
    z away); `visibility` and `presence` (33,) probabilities; `flag` probability that there is a
    person; `region` where they were seen, `next_region` where to look in the next frame.
    """

    image: Array
    world: Array
    visibility: Array
    presence: Array
    flag: float
    region: Region
    next_region: Region


def make_anchors() -> Array:
    """Return the anchor centres of the detector, shape (2254, 2), as shares of the input side."""
    rows = []
    for cells, per_cell in ANCHOR_GRIDS:
        centre = (np.arange(cells) + 0.5) / cells
        y, x = np.meshgrid(centre, centre, indexing="ij")
        grid = np.stack([x.ravel(), y.ravel()], axis=1)
        rows.append(np.repeat(grid, per_cell, axis=0))
    return np.concatenate(rows)


def decode_detections(
    raw: Float32, logits: Float32, anchors: Array, *, min_score: float = 0.5
) -> tuple[Array, Array]:
    """Decode the detector's rows.

    Parameters
    ----------
    raw
        Shape (N, 12): centre, size, four key points, in input px from the anchor's centre.
    logits
        Shape (N,).
    anchors
        Shape (N, 2).
    min_score
        Rows below are dropped.

    Returns
    -------
    tuple
        Rows (M, 12): left, top, right, bottom, then four x, y, as shares of the input side;
        scores (M,).
    """
    scores = 1.0 / (1.0 + np.exp(-np.clip(logits.astype(np.float64), -100.0, 100.0)))
    keep = scores >= min_score
    offset = raw[keep].astype(np.float64) / DETECTOR_SIZE_PX
    centre = offset[:, 0:2] + anchors[keep]
    half = offset[:, 2:4] / 2
    points = offset[:, 4:12].reshape(-1, 4, 2) + anchors[keep][:, None, :]
    rows = np.concatenate([centre - half, centre + half, points.reshape(-1, 8)], axis=1)
    return rows, scores[keep]


def merge_detections(
    rows: Array, scores: Array, *, iou: float = NMS_IOU
) -> list[tuple[Array, float]]:
    """Merge overlapping rows into their score-weighted mean (weighted non-maximum suppression).

    Returns
    -------
    list
        Pairs of row (12,) and best score, best first.
    """
    order = np.argsort(-scores, kind="stable")
    merged = []
    while order.size:
        overlap = _iou(rows[order[0], :4], rows[order, :4]) > iou
        overlap[0] = True
        group = order[overlap]
        weight = scores[group] / scores[group].sum()
        merged.append((weight @ rows[group], float(scores[group[0]])))
        order = order[~overlap]
    return merged


def _iou(box: Array, boxes: Array) -> Array:
    low = np.maximum(box[:2], boxes[:, :2])
    high = np.minimum(box[2:4], boxes[:, 2:4])
    inter = np.prod(np.maximum(high - low, 0.0), axis=1)
    area = np.prod(boxes[:, 2:4] - boxes[:, :2], axis=1)
    union = np.prod(box[2:4] - box[:2]) + area - inter
    return np.asarray(np.where(union > 0, inter / np.maximum(union, 1e-12), 0.0))


def region_from_points(centre: Array, rim: Array, *, scale: float = REGION_SCALE) -> Region:
    """Return the square around a circle, turned so that `rim` lies straight above `centre`."""
    dx, dy = float(rim[0] - centre[0]), float(rim[1] - centre[1])
    angle = math.pi / 2 - math.atan2(-dy, dx)
    angle -= 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))
    return Region(float(centre[0]), float(centre[1]), 2 * math.hypot(dx, dy) * scale, angle)


def hold_region(held: Region | None, proposed: Region) -> Region:
    """Keep the region that was used as long as the proposed one hardly differs from it."""
    if held is None or held.size <= 0:
        return proposed
    shift = math.hypot(proposed.x - held.x, proposed.y - held.y) / held.size
    growth = abs(proposed.size / held.size - 1)
    turn = abs(math.remainder(proposed.angle - held.angle, 2 * math.pi))
    is_near = shift <= HOLD_SHIFT and growth <= HOLD_GROWTH and turn <= HOLD_TURN_RAD
    return held if is_near else proposed


def crop_matrix(region: Region, side_px: int, *, offset_px: float = CROP_OFFSET_PX) -> Array:
    """Return the (2, 3) map from crop pixel indices to picture pixel indices."""
    step = region.size / side_px
    cos, sin = step * math.cos(region.angle), step * math.sin(region.angle)
    start = offset_px - side_px / 2
    return np.array(
        [
            [cos, -sin, region.x + (cos - sin) * start],
            [sin, cos, region.y + (sin + cos) * start],
        ]
    )


def refine_by_heatmap(points: Array, heatmap: Float32) -> Array:
    """Move points to the centre of mass of the heat map around them.

    Parameters
    ----------
    points
        Shape (K, 2), shares of the crop's side.
    heatmap
        Shape (H, W, K), logits.

    Returns
    -------
    Array
        Shape (K, 2); a point stays where it was if it lies outside or nothing near it reaches
        a probability of one half.
    """
    height, width, n_points = heatmap.shape
    col = (points[:, 0] * width).astype(np.intp)
    row = (points[:, 1] * height).astype(np.intp)
    span = np.arange(-HEATMAP_RADIUS, HEATMAP_RADIUS + 1)
    rows, cols = row[:, None] + span, col[:, None] + span
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((cols >= 0) & (cols < width))[
        :, None, :
    ]
    window = heatmap[
        np.clip(rows, 0, height - 1)[:, :, None],
        np.clip(cols, 0, width - 1)[:, None, :],
        np.arange(n_points)[:, None, None],
    ]
    weight = np.where(inside, 1.0 / (1.0 + np.exp(-window.astype(np.float64))), 0.0)
    total = weight.sum(axis=(1, 2))
    x = (weight.sum(axis=1) * cols).sum(axis=1)
    y = (weight.sum(axis=2) * rows).sum(axis=1)
    is_refined = (weight.max(axis=(1, 2)) >= HEATMAP_MIN_CONFIDENCE) & (
        (col >= 0) & (col < width) & (row >= 0) & (row < height)
    )
    total = np.maximum(total, 1e-12)
    moved = np.stack([x / total / width, y / total / height], axis=1)
    return np.where(is_refined[:, None], moved, points)


def estimate_sigma_px(confidence: Array, region: Region) -> Array:
    """Estimate the standard error of each image coordinate from a landmark's confidence.

    Parameters
    ----------
    confidence
        Shape (K,), the smaller of visibility and presence.
    region
        Where the landmarks were seen.

    Returns
    -------
    Array
        Shape (K,), px.
    """
    doubt = np.clip((SURE_CONFIDENCE - confidence) / SURE_CONFIDENCE, 0.0, 1.0)
    return np.asarray((SIGMA_SURE + (SIGMA_GUESS - SIGMA_SURE) * doubt) * region.size)


class InlineExecutor(Executor):
    """Does the work at once, in the thread that asks for it."""

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """Call `fn` and return its outcome."""
        future: Future[R] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class BlazePoseNetworks:
    """The two networks and what is done before and after them.

    Parameters
    ----------
    variant
        `heavy` or `full`.
    threads
        Inference threads; 0 = one per core. From two on, two pictures can be seen at once
        (`make_executor`), each by half of the threads: they then need not wait for each other in
        every layer, which is slow on a busy machine.
    crop_offset_px
        See `CROP_OFFSET_PX`.

    Raises
    ------
    BackendUnavailable
        If a network's file is missing or damaged.
    """

    def __init__(
        self,
        variant: str = "heavy",
        *,
        threads: int = 0,
        crop_offset_px: float = CROP_OFFSET_PX,
        model_dir: Path = MODEL_DIR,
    ) -> None:
        threads = threads or count_cores()
        self._n_at_once = min(MAX_AHEAD, threads)
        self._threads = max(1, threads // self._n_at_once)
        self._landmarker = open_session(model_dir / f"pose_landmark_{variant}.onnx", self._threads)
        self._detector_path = model_dir / "pose_detector.onnx"
        self._detector: Any = None
        self._offset_px = crop_offset_px
        self._anchors = make_anchors()
        self._clock = BusyClock()

    @property
    def model_time_s(self) -> float:
        """Time during which at least one of the networks was running, so far."""
        return self._clock.total_s

    def make_executor(self) -> Executor:
        """Return what runs `find_landmarks` on two pictures at once if there are threads for it."""
        return InlineExecutor() if self._n_at_once == 1 else ThreadPoolExecutor(self._n_at_once)

    def _run(self, session: Any, image: Float32, names: list[str]) -> list[Float32]:
        with self._clock, NETWORK_CLOCK:
            outputs: list[Float32] = session.run(names, {"image": image})
        return outputs

    def detect(
        self, image: Image, region: Region | None = None, *, min_score: float = 0.5
    ) -> list[PoseDetection]:
        """Find persons in the picture, or in one upright region of it.

        Parameters
        ----------
        image
            Shape (H, W, 3), RGB.
        region
            Where to look; None for the whole picture.

        Returns
        -------
        list of PoseDetection
            Best first.
        """
        if self._detector is None:
            self._detector = open_session(self._detector_path, self._threads)
        height, width = image.shape[:2]
        if region is None:
            # MediaPipe counts from the border here; half a pixel changes the outcome visibly.
            region = Region(width / 2, height / 2, float(max(width, height)))
        matrix = crop_matrix(region, DETECTOR_SIZE_PX, offset_px=DETECTOR_OFFSET_PX)
        crop = cv2.warpAffine(
            image,
            matrix,
            (DETECTOR_SIZE_PX, DETECTOR_SIZE_PX),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
        )
        tensor = (crop.astype(np.float32) * (2 / 255) - 1)[None]
        raw, logits = self._run(self._detector, tensor, ["boxes", "scores"])
        rows, scores = decode_detections(
            raw[0], logits[0, :, 0], self._anchors, min_score=min_score
        )
        corner = np.array([region.x, region.y]) - region.size / 2
        found = []
        for row, score in merge_detections(rows, scores):
            points = row.reshape(6, 2) * region.size + corner
            found.append(PoseDetection(points[:2].ravel(), points[2:], score))
        return found

    def find_landmarks(self, image: Image, region: Region) -> Landmarks:
        """Estimate the landmarks of the person in a region.

        Parameters
        ----------
        image
            Shape (H, W, 3), RGB.
        region
            The turned square to look at; where it leaves the picture, the border is repeated.
        """
        matrix = crop_matrix(region, CROP_SIZE_PX, offset_px=self._offset_px)
        crop = cv2.warpAffine(
            image,
            matrix,
            (CROP_SIZE_PX, CROP_SIZE_PX),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        tensor = np.multiply(crop, np.float32(1 / 255), dtype=np.float32)[None]
        rows, flag, heatmap, world = self._run(
            self._landmarker, tensor, ["landmarks", "pose_flag", "heatmap", "world"]
        )
        return _place_landmarks(
            rows.reshape(39, 5), float(flag.item()), heatmap[0], world.reshape(39, 3), region
        )


def _place_landmarks(
    rows: Float32, flag: float, heatmap: Float32, world: Float32, region: Region
) -> Landmarks:
    """Bring one crop's outputs back to the picture."""
    share = refine_by_heatmap(rows[:, :2].astype(np.float64) / CROP_SIZE_PX, heatmap)
    cos, sin = math.cos(region.angle), math.sin(region.angle)
    turn = np.array([[cos, sin], [-sin, cos]])
    points = (share - 0.5) @ turn * region.size + np.array([region.x, region.y])
    placed = world[:N_LANDMARKS].astype(np.float64)
    placed[:, :2] = placed[:, :2] @ turn
    certainty = 1.0 / (1.0 + np.exp(-rows[:N_LANDMARKS, 3:5].astype(np.float64)))
    return Landmarks(
        image=points[:N_LANDMARKS],
        world=placed,
        visibility=certainty[:, 0],
        presence=certainty[:, 1],
        flag=flag,
        region=region,
        next_region=region_from_points(points[HIP_CENTRE], points[BODY_TOP]),
    )


@dataclass(frozen=True, eq=False)
class PoseGlance:
    """A picture that is being looked at, where the person was expected when it was begun."""

    image: Image
    generation: int
    landmarks: Future[Landmarks] | None


class PoseFollower:
    """Follows one person's landmarks from frame to frame.

    A frame's auxiliary points give the region of a later one; the detector runs only when there is
    no region, or when the landmark network says that the person is gone.

    A frame may be begun before the frames before it are finished: it then uses the region known so
    far, which moves little from frame to frame.

    Parameters
    ----------
    networks
        The loaded networks.
    min_confidence
        Least probability of a person, for the detector and for the landmarks.
    executor
        Runs what is begun; by default at once.
    """

    def __init__(
        self,
        networks: BlazePoseNetworks,
        *,
        min_confidence: float = 0.5,
        executor: Executor | None = None,
    ) -> None:
        self._networks = networks
        self._min_confidence = min_confidence
        self._executor = executor or InlineExecutor()
        self._generation = 0
        self.region: Region | None = None

    def restart(self) -> None:
        """Forget where the person was; what was begun before is looked at anew."""
        self.region = None
        self._generation += 1

    def resume(self, region: Region | None) -> None:
        """Follow on from a region."""
        self.region = region
        self._generation += 1

    def begin(self, image: Image) -> PoseGlance:
        """Begin to look for the person in the next frame, shape (H, W, 3), RGB."""
        future = None
        if self.region is not None:
            future = self._executor.submit(self._networks.find_landmarks, image, self.region)
        return PoseGlance(image, self._generation, future)

    def finish(self, glance: PoseGlance, search: Region | None = None) -> Landmarks | None:
        """Return the person's landmarks in a frame that was begun; frames finish in order.

        Parameters
        ----------
        glance
            What `begin` returned.
        search
            Upright square in which a person is sought if none is followed; None for the whole
            picture. With a square, only a person whose hips lie in its middle half is taken.

        Returns
        -------
        Landmarks or None
            None if there is nobody; the next frame then starts anew.
        """
        landmarks = None
        if glance.landmarks is not None and glance.generation == self._generation:
            landmarks = self._accept(glance.landmarks.result())
        elif self.region is not None:
            landmarks = self._accept(self._networks.find_landmarks(glance.image, self.region))
        return landmarks or self._start(glance.image, search)

    def update(self, image: Image, search: Region | None = None) -> Landmarks | None:
        """Find the person's landmarks in the next frame: `begin` and `finish` in one."""
        return self.finish(self.begin(image), search)

    def _start(self, image: Image, search: Region | None) -> Landmarks | None:
        self.restart()
        found = self._networks.detect(image, search, min_score=self._min_confidence)
        person = _choose_detection(found, search)
        if person is None:
            return None
        first = self._accept(
            self._networks.find_landmarks(image, region_from_points(*person.points[:2]))
        )
        if first is None or self.region is None:
            return None
        # The detector's region is coarse; look again with the one the landmarks give.
        return self._accept(self._networks.find_landmarks(image, self.region))

    def _accept(self, landmarks: Landmarks) -> Landmarks | None:
        is_person = landmarks.flag >= self._min_confidence and landmarks.next_region.is_usable
        if not is_person:
            self.restart()
            return None
        self.region = hold_region(self.region, landmarks.next_region)
        return landmarks


def _choose_detection(found: list[PoseDetection], search: Region | None) -> PoseDetection | None:
    """Return the best detection; in a square, the one whose hips are nearest to its centre."""
    if search is None:
        return found[0] if found else None

    def distance(detection: PoseDetection) -> float:
        x, y = detection.points[0]
        return float(max(abs(x - search.x), abs(y - search.y)))

    central = [d for d in found if distance(d) <= HIP_SHARE * search.size]
    return min(central, key=distance, default=None)


def count_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def open_session(path: Path, threads: int) -> Any:
    """Open a network for the CPU.

    Raises
    ------
    BackendUnavailable
        If the file is missing, incomplete or unreadable.
    """
    import onnxruntime

    expected = MODEL_BYTES.get(path.name)
    found = path.stat().st_size if path.is_file() else None
    if found is None or (expected is not None and found != expected):
        state = "is missing" if found is None else f"has {found} bytes instead of {expected}"
        raise BackendUnavailable(
            f"The network file {path.name} {state}; install LiftLens again to get it."
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Waiting threads would take time from the other picture's, and from whatever else runs.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
