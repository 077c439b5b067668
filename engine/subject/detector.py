"""Finds persons in a picture with NanoDet-g, a COCO detector of 416 x 416 input.

Only the person class is decoded. Boxes are px of the original picture.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, PersonBox
from engine.errors import BackendUnavailable
from engine.timing import NETWORK_CLOCK

__all__ = ["PersonDetector", "decode_persons", "letterbox", "suppress_overlaps"]

INPUT_SIZE_PX: Final = 416
STRIDES: Final = (8, 16, 32)
N_BINS: Final = 11
PERSON: Final = 0
MEAN_BGR: Final = (103.53, 116.28, 123.675)
STD_BGR: Final = (57.375, 57.12, 58.395)
NMS_IOU: Final = 0.6
MAX_CANDIDATES: Final = 200

MODEL_PATH: Final = Path(__file__).parent / "models" / "coco_nanodet_g_416.onnx"
MODEL_BYTES: Final = 7_601_902


def letterbox(width: int, height: int) -> tuple[float, float, float]:
    """Return how a picture fits into the square input.

    Returns
    -------
    tuple
        Scale, left margin and top margin (input px): an edge at x px of the picture lies at
        ``x * scale + left`` of the input.
    """
    scale = INPUT_SIZE_PX / max(width, height)
    left = (INPUT_SIZE_PX - width * scale) / 2
    top = (INPUT_SIZE_PX - height * scale) / 2
    return scale, left, top


def decode_persons(
    scores: list[NDArray[np.float32]],
    distances: list[NDArray[np.float32]],
    *,
    threshold: float,
) -> tuple[Array, Array]:
    """Decode the network's outputs into boxes of persons.

    Parameters
    ----------
    scores
        Per stride (N, 80), probabilities.
    distances
        Per stride (N, 44): logits of the distances to left, top, right, bottom, 11 bins each,
        in units of the stride.
    threshold
        Boxes with a lower score are dropped.

    Returns
    -------
    tuple
        Boxes (M, 4): left, top, right, bottom in input px; scores (M,).
    """
    boxes, kept = [], []
    for stride, score, distance in zip(STRIDES, scores, distances, strict=True):
        index = np.flatnonzero(score[:, PERSON] >= threshold)
        cells = INPUT_SIZE_PX // stride
        x, y = (index % cells + 0.5) * stride, (index // cells + 0.5) * stride
        logits = distance[index].reshape(-1, 4, N_BINS).astype(np.float64)
        weight = np.exp(logits - logits.max(axis=2, keepdims=True))
        reach = weight @ np.arange(N_BINS) / weight.sum(axis=2) * stride
        boxes.append(
            np.stack([x - reach[:, 0], y - reach[:, 1], x + reach[:, 2], y + reach[:, 3]], axis=1)
        )
        kept.append(score[index, PERSON].astype(np.float64))
    return np.concatenate(boxes), np.concatenate(kept)


def suppress_overlaps(boxes: Array, scores: Array, *, iou: float = NMS_IOU) -> NDArray[np.intp]:
    """Return the rows that stay when of overlapping boxes only the best is kept, best first."""
    order = np.argsort(-scores, kind="stable")[:MAX_CANDIDATES]
    kept = []
    while order.size:
        best, order = order[0], order[1:]
        kept.append(best)
        low = np.maximum(boxes[best, :2], boxes[order, :2])
        high = np.minimum(boxes[best, 2:], boxes[order, 2:])
        inter = np.prod(np.maximum(high - low, 0.0), axis=1)
        area = np.prod(boxes[order, 2:] - boxes[order, :2], axis=1)
        union = np.prod(boxes[best, 2:] - boxes[best, :2]) + area - inter
        order = order[inter <= iou * union]
    return np.array(kept, dtype=np.intp)


class PersonDetector:
    """NanoDet-g on the CPU.

    Parameters
    ----------
    threads
        Inference threads; 0 = one per core.
    threshold
        Least confidence of a person that is reported.

    Attributes
    ----------
    model_time_s
        Time spent inside the network so far; add it to the pose estimator's.

    Raises
    ------
    BackendUnavailable
        If the network's file is missing or damaged.
    """

    def __init__(
        self, *, threads: int = 0, threshold: float = 0.2, model_path: Path = MODEL_PATH
    ) -> None:
        self._session = _open_session(model_path, threads)
        self._threshold = threshold
        self._outputs = [output.name for output in self._session.get_outputs()]
        self.model_time_s = 0.0

    def __call__(self, image: NDArray[np.uint8]) -> list[PersonBox]:
        """Find the persons in a picture.

        Parameters
        ----------
        image
            Shape (H, W, 3), RGB.

        Returns
        -------
        list of PersonBox
            Best first; px of the picture, cut at its border.
        """
        height, width = image.shape[:2]
        scale, left, top = letterbox(width, height)
        tensor = _prepare(image, scale, left, top)
        start = time.perf_counter()
        with NETWORK_CLOCK:
            outputs = self._session.run(self._outputs, {"image": tensor})
        self.model_time_s += time.perf_counter() - start
        boxes, scores = decode_persons(
            [o[0] for o in outputs[:3]], [o[0] for o in outputs[3:]], threshold=self._threshold
        )
        keep = suppress_overlaps(boxes, scores)
        edges = (boxes[keep] - np.array([left, top, left, top])) / scale
        edges = np.clip(edges, 0.0, np.array([width, height, width, height]))
        return [
            PersonBox(left=e[0], top=e[1], right=e[2], bottom=e[3], confidence=float(score))
            for e, score in zip(edges.tolist(), scores[keep], strict=True)
            if e[2] > e[0] and e[3] > e[1]
        ]


def _prepare(
    image: NDArray[np.uint8], scale: float, left: float, top: float
) -> NDArray[np.float32]:
    """Return the network's input (1, 3, 416, 416): letterboxed, BGR, normalised."""
    # Edges map to edges, so pixel centres (at +0.5) need a shift.
    shift = 0.5 * scale - 0.5
    matrix = np.array([[scale, 0.0, left + shift], [0.0, scale, top + shift]])
    size = (INPUT_SIZE_PX, INPUT_SIZE_PX)
    square = cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR)
    tensor = np.empty((1, 3, INPUT_SIZE_PX, INPUT_SIZE_PX), np.float32)
    for channel, (mean, std) in enumerate(zip(MEAN_BGR, STD_BGR, strict=True)):
        plane = square[:, :, 2 - channel]
        np.multiply(plane, np.float32(1 / std), out=tensor[0, channel])
        tensor[0, channel] -= np.float32(mean / std)
    return tensor


def _open_session(path: Path, threads: int) -> Any:
    import onnxruntime

    found = path.stat().st_size if path.is_file() else None
    if found != MODEL_BYTES:
        state = "is missing" if found is None else f"has {found} bytes instead of {MODEL_BYTES}"
        raise BackendUnavailable(
            f"The network file {path.name} {state}; install LiftLens again to get it."
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # It runs now and then; between its runs waiting threads would take time from the others.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
