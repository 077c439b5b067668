"""Small videos and poses for the tests."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from engine.datatypes import PersonBox, PoseTrack, SubjectState, ViewInfo, ViewPose
from engine.skeletons import MEDIAPIPE_33

COLOURS = {"red": (220, 30, 30), "green": (30, 200, 30), "blue": (30, 30, 220), "white": (230,) * 3}
CODEC_OPTIONS = {"libx265": {"x265-params": "log-level=none"}, "libvpx-vp9": {"cpu-used": "8"}}
PIXEL_FORMATS = {"mjpeg": "yuvj420p"}


def grey(index: int) -> int:
    """Grey value that tells which picture of a clip this is (0 to 31)."""
    return 7 * (index % 32) + 12


def counting_image(index: int, width: int, height: int) -> np.ndarray:
    return np.full((height, width, 3), grey(index), np.uint8)


def index_of(image: np.ndarray) -> int:
    return round((float(image.mean()) - 12) / 7)


def quadrants(width: int, height: int) -> np.ndarray:
    """Red at the top left, green top right, blue bottom left, white bottom right."""
    image = np.empty((height, width, 3), np.uint8)
    image[: height // 2, : width // 2] = COLOURS["red"]
    image[: height // 2, width // 2 :] = COLOURS["green"]
    image[height // 2 :, : width // 2] = COLOURS["blue"]
    image[height // 2 :, width // 2 :] = COLOURS["white"]
    return image


def noise_image(width: int, height: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def write_clip(
    path: Path,
    images: Iterable[np.ndarray],
    *,
    codec: str = "libx264",
    rate: int = 30,
    times_ms: Sequence[int] | None = None,
    pixel_format: str | None = None,
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
    shift_packets: int = 0,
    sound: bool = False,
) -> Path:
    """Code images as they are; the clip says nothing but codec and times."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = None
        for index, image in enumerate(images):
            if stream is None:
                chosen = {**CODEC_OPTIONS.get(codec, {}), **(options or {})}
                stream = container.add_stream(codec, rate=rate, options=chosen)
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = pixel_format or PIXEL_FORMATS.get(codec, "yuv420p")
                if times_ms is not None:
                    stream.codec_context.time_base = Fraction(1, 1000)
                if sound:
                    add_sound(container)
            picture = av.VideoFrame.from_ndarray(image, "rgb24")
            picture.pts = index if times_ms is None else times_ms[index]
            picture.time_base = Fraction(1, rate) if times_ms is None else Fraction(1, 1000)
            _mux(container, stream.encode(picture), shift_packets)
        _mux(container, stream.encode(None), shift_packets)
    return path


def _mux(container, packets, shift: int) -> None:
    for packet in packets:
        if shift:
            packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
        container.mux(packet)


def add_sound(container) -> None:
    stream = container.add_stream("aac", rate=16000, layout="mono")
    frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
    frame.rate, frame.pts = 16000, 0
    container.mux(stream.encode(frame))
    container.mux(stream.encode(None))


def write_sound(path: Path) -> Path:
    with av.open(str(path), "w") as container:
        add_sound(container)
    return path


def counting_clip(path: Path, n_frames: int = 30, size=(64, 48), **kwargs) -> Path:
    images = (counting_image(i, *size) for i in range(n_frames))
    return write_clip(path, images, **kwargs)


def noise_clip(path: Path, n_frames: int = 40, **kwargs) -> Path:
    return write_clip(path, (noise_image(96, 64, i) for i in range(n_frames)), **kwargs)


def set_display_matrix(path: Path, a: int, b: int, c: int, d: int) -> None:
    """Write the matrix of QuickTime's track header: shown = (a x + c y, b x + d y)."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 44
    one = 1 << 16
    values = (a * one, b * one, 0, c * one, d * one, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, start, *values)
    path.write_bytes(data)


def top_level_boxes(path: Path) -> list[str]:
    data, position, names = path.read_bytes(), 0, []
    while position < len(data):
        size = int.from_bytes(data[position : position + 4], "big")
        names.append(data[position + 4 : position + 8].decode("latin-1"))
        position += size
    return names


def make_info(width: int = 320, height: int = 240, n_frames: int = 30) -> ViewInfo:
    return ViewInfo("clip.mp4", "0" * 64, 30.0, n_frames, (width, height), n_frames / 30)


def make_pose(
    points: dict[str, tuple[float, float]] | None = None,
    *,
    n_frames: int = 30,
    size=(320, 240),
    box: tuple[float, float, float, float] | None = None,
    confidence: float = 0.9,
    others: tuple[tuple[PersonBox, ...], ...] = (),
    present: Sequence[bool] | None = None,
) -> ViewPose:
    """Build a person who stands still at the given keypoints; `present` blanks frames."""
    position = np.full((n_frames, len(MEDIAPIPE_33.keypoints), 2), np.nan)
    for name, point in (points or {}).items():
        position[:, MEDIAPIPE_33.index(name)] = point
    boxes = np.full((n_frames, 4), np.nan)
    if box is not None:
        boxes[:] = box
    keep = np.ones(n_frames, bool) if present is None else np.asarray(present)
    position[~keep], boxes[~keep] = np.nan, np.nan
    track = PoseTrack(
        time_s=np.arange(n_frames) / 30,
        position=position,
        unit="px",
        frame_of_reference="image",
        skeleton="mediapipe_33",
        confidence=np.full(position.shape[:2], confidence),
    )
    state = tuple(SubjectState.TRACKED if k else SubjectState.LOST for k in keep)
    return ViewPose(track, None, boxes, state, make_info(*size, n_frames), others)


def replace_arrays(pose: ViewPose, position: np.ndarray, box: np.ndarray) -> ViewPose:
    """Return the pose with other keypoints and boxes."""
    track = dataclasses.replace(pose.image, position=position, status=None)
    return dataclasses.replace(pose, image=track, box=box)
