"""BlazePose here against MediaPipe's own runtime, on still pictures; and the mirror test.

Needs the extra `bench`, best in an environment of its own: MediaPipe brings OpenCV 5, whose warps
differ a little from those of the OpenCV 4 the product uses.

    python benchmarks/blazepose_parity.py [--shared ../shared] [--variant heavy]

Rows: how finely each crop pixel is placed (`offset`, see `engine.pose.blazepose.CROP_OFFSET_PX`).
Columns: distance of the 33 landmarks from MediaPipe's in px and of the world landmarks in mm, and
half the distance between a picture's landmarks and those of its mirror image, along x: the bias.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from engine.pose.blazepose import CROP_OFFSET_PX, BlazePoseNetworks, Region, region_from_points
from engine.skeletons import MEDIAPIPE_33
from engine.video.reader import read_frames

REAL = "data/real_four_view/cam0*.mp4"
SYNTHETIC = "data/synthetic_lifts/P0[124]/P0*_FS_01/cam*.mp4"
EVERY = 15
MIN_CONFIDENCE = 0.8
MIRROR = list(MEDIAPIPE_33.mirror_order)


def read_pictures(shared: Path, pattern: str) -> Iterator[np.ndarray]:
    for path in sorted(shared.glob(pattern)):
        for frame in read_frames(path):
            if frame.index % EVERY == 0 and frame.index < 100:
                yield frame.image


def ask_peer(shared: Path, variant: str, pictures) -> list[tuple[np.ndarray, np.ndarray] | None]:
    """Return MediaPipe's landmarks (33, 2) px and world landmarks (33, 3) m of every picture."""
    import mediapipe as mp
    from mediapipe.tasks.python import BaseOptions, vision

    model = shared / f"models/peer/pose_landmarker_{variant}.task"
    options = vision.PoseLandmarkerOptions(
        base_options=BaseOptions(model_asset_path=str(model)),
        running_mode=vision.RunningMode.IMAGE,
    )
    results = []
    with vision.PoseLandmarker.create_from_options(options) as landmarker:
        for picture in pictures:
            height, width = picture.shape[:2]
            image = mp.Image(image_format=mp.ImageFormat.SRGB, data=np.ascontiguousarray(picture))
            found = landmarker.detect(image)
            if not found.pose_landmarks:
                results.append(None)
                continue
            points = np.array([(p.x * width, p.y * height) for p in found.pose_landmarks[0]])
            world = np.array([(p.x, p.y, p.z) for p in found.pose_world_landmarks[0]])
            results.append((points, world))
    return results


def compare_with_peer(networks: BlazePoseNetworks, pictures, peer_results):
    image_px, world_mm = [], []
    for picture, peer in zip(pictures, peer_results, strict=True):
        found = networks.detect(picture)
        if peer is None or not found:
            continue
        ours = networks.find_landmarks(picture, region_from_points(*found[0].points[:2]))
        image_px.append(np.linalg.norm(ours.image - peer[0], axis=1))
        world_mm.append(1000 * np.linalg.norm(ours.world - peer[1], axis=1))
    return np.concatenate(image_px), np.concatenate(world_mm)


def measure_mirror_bias(networks: BlazePoseNetworks, pictures) -> np.ndarray:
    """Return half of x minus the mirrored picture's x, per confident landmark (px)."""
    bias = []
    for picture in pictures:
        found = networks.detect(picture)
        if not found:
            continue
        region = region_from_points(*found[0].points[:2])
        region = networks.find_landmarks(picture, region).next_region
        last = picture.shape[1] - 1
        mirrored_region = Region(last - region.x, region.y, region.size, -region.angle)
        seen = networks.find_landmarks(picture, region)
        mirrored = networks.find_landmarks(np.ascontiguousarray(picture[:, ::-1]), mirrored_region)
        is_sure = np.minimum(seen.visibility, seen.presence) > MIN_CONFIDENCE
        bias.append((seen.image[:, 0] - (last - mirrored.image[MIRROR, 0]))[is_sure] / 2)
    return np.concatenate(bias)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--variant", default="heavy", choices=("heavy", "full"))
    options = parser.parse_args()
    print(
        f"{'pictures':10} {'n':>3} {'offset':>6} {'px median':>9} {'px 95 %':>8} {'mm median':>9} "
        f"{'mirror bias px':>14}"
    )
    for name, pattern in (("real", REAL), ("synthetic", SYNTHETIC)):
        pictures = list(read_pictures(options.shared, pattern))
        peer_results = ask_peer(options.shared, options.variant, pictures)
        for offset in (CROP_OFFSET_PX, 0.125, 0.25, 0.5):
            networks = BlazePoseNetworks(options.variant, threads=2, crop_offset_px=offset)
            px, mm = compare_with_peer(networks, pictures, peer_results)
            bias = measure_mirror_bias(networks, pictures)
            mark = " <- product" if offset == CROP_OFFSET_PX else ""
            print(
                f"{name:10} {len(pictures):3d} {offset:6.3f} {np.median(px):9.3f} "
                f"{np.percentile(px, 95):8.3f} {np.median(mm):9.2f} {np.median(bias):+14.2f}{mark}",
                flush=True,
            )


if __name__ == "__main__":
    main()
