"""Speed of BlazePose from decoded pictures to landmarks, against MediaPipe's own runtime.

Needs the extra `bench`, best in an environment of its own (see `blazepose_parity.py`).

    python benchmarks/blazepose_speed.py [--shared ../shared] [--variant heavy] [--rounds 5]

Both see the same decoded pictures of one clip and follow one person (MediaPipe in its VIDEO
mode). The contestants take turns, so that a busy machine disturbs all alike; medians over the
rounds. `landmarks` starts from known person boxes; `product` finds them too, as `assess` does.
MediaPipe runs its network on one thread, whatever the machine; `one core` confines it wholly.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from engine.config import PoseConfig
from engine.datatypes import Frame, ViewInfo, ignore_progress
from engine.pose.backends.mediapipe import Backend
from engine.subject.detector import PersonDetector
from engine.subject.tracker import follow_person
from engine.video.reader import probe_video, read_frames

CLIP = "data/synthetic_lifts/P01/P01_FS_01/cam90.mp4"
WARM_UP = 10

Contestant = Callable[[list[Frame]], float]
"""Takes pictures, returns seconds a picture."""


def landmarks(variant: str, threads: int, view: ViewInfo, detector: PersonDetector) -> Contestant:
    backend = Backend(PoseConfig(variant=variant, threads=threads))

    def run(frames: list[Frame]) -> float:
        tracked = list(follow_person(iter(frames), detector))
        start = time.perf_counter()
        backend.estimate(iter(tracked), view, ignore_progress)
        return (time.perf_counter() - start) / len(frames)

    return run


def product(variant: str, threads: int, view: ViewInfo) -> Contestant:
    backend = Backend(PoseConfig(variant=variant, threads=threads))
    detector = PersonDetector(threads=threads)

    def run(frames: list[Frame]) -> float:
        start = time.perf_counter()
        backend.estimate(follow_person(iter(frames), detector), view, ignore_progress)
        return (time.perf_counter() - start) / len(frames)

    return run


def peer(shared: Path, variant: str) -> Contestant:
    import mediapipe as mp
    from mediapipe.tasks.python import BaseOptions, vision

    model = shared / f"models/peer/pose_landmarker_{variant}.task"

    def run(frames: list[Frame]) -> float:
        options = vision.PoseLandmarkerOptions(
            base_options=BaseOptions(model_asset_path=str(model)),
            running_mode=vision.RunningMode.VIDEO,
        )
        with vision.PoseLandmarker.create_from_options(options) as landmarker:
            start = time.perf_counter()
            for i, frame in enumerate(frames):
                image = mp.Image(image_format=mp.ImageFormat.SRGB, data=frame.image)
                landmarker.detect_for_video(image, 33 * i)
            return (time.perf_counter() - start) / len(frames)

    return run


def confined(contestant: Contestant, cores: set[int]) -> Contestant:
    """Return the contestant confined to some cores."""

    def run(frames: list[Frame]) -> float:
        everywhere = os.sched_getaffinity(0)
        # Only the calling thread is confined, and what it starts.
        os.sched_setaffinity(0, cores)
        try:
            return contestant(frames)
        finally:
            os.sched_setaffinity(0, everywhere)

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--variant", default="heavy", choices=("heavy", "full"))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=150)
    options = parser.parse_args()
    path = options.shared / CLIP
    frames = [
        Frame(f.index, f.time_s, np.ascontiguousarray(f.image))
        for f in read_frames(path)
        if f.index < options.frames
    ]
    view = probe_video(path)
    mediapipe = peer(options.shared, options.variant)
    core = {min(os.sched_getaffinity(0))}
    contestants = {
        "MediaPipe": mediapipe,
        "MediaPipe, one core": confined(mediapipe, core),
        "LiftLens landmarks, 1 thread": landmarks(options.variant, 1, view, PersonDetector()),
        "LiftLens landmarks, 2 threads": landmarks(options.variant, 2, view, PersonDetector()),
        "LiftLens product, 1 thread": product(options.variant, 1, view),
        "LiftLens product, 2 threads": product(options.variant, 2, view),
    }
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for contestant in contestants.values():
        contestant(frames[:WARM_UP])
    for _ in range(options.rounds):
        for name, contestant in contestants.items():
            seconds[name].append(contestant(frames))
    median = {name: statistics.median(values) for name, values in seconds.items()}
    print(
        f"{options.variant}, {len(frames)} pictures of {view.size_px}, {options.rounds} rounds, "
        f"{os.cpu_count()} cores, {platform.machine()}, load {os.getloadavg()[0]:.1f}"
    )
    print(f"{'':32} {'ms/picture':>10} {'best':>6} {'x MediaPipe':>11}")
    for name, value in median.items():
        print(
            f"{name:32} {1000 * value:10.1f} {1000 * min(seconds[name]):6.1f} "
            f"{median['MediaPipe'] / value:11.2f}"
        )


if __name__ == "__main__":
    main()
