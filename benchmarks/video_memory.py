"""Peak memory while reading a short and a long video.

Run ``python benchmarks/video_memory.py``. Each length is read in a process of its own;
both peaks should be the same, since only a few pictures are held at a time.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from engine.video.reader import read_frames
from engine.video.writer import VideoWriter

LENGTHS_S = (20, 300)
FPS = 30


def write_clip(path: Path, duration_s: int, width: int, height: int) -> None:
    """Write a picture that drifts sideways, so that every frame has something to code."""
    rows, columns = np.mgrid[:height, : 2 * width]
    wide = np.stack([columns // 8, rows // 4, (columns + rows) // 8], axis=2).astype(np.uint8)
    with VideoWriter(path) as writer:
        for i in range(duration_s * FPS):
            left = (2 * i) % width
            writer.write(np.ascontiguousarray(wide[:, left : left + width]), i / FPS)


def read_clip(path: Path) -> None:
    """Read a clip and print frames, seconds, memory before and at most."""
    process = psutil.Process()
    before_mb = highest_mb = process.memory_info().rss / 2**20
    n_frames = 0
    start = time.perf_counter()
    for _ in read_frames(path):
        n_frames += 1
        highest_mb = max(highest_mb, process.memory_info().rss / 2**20)
    print(n_frames, time.perf_counter() - start, before_mb, highest_mb)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720), metavar=("W", "H"))
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.read:
        read_clip(arguments.read)
        return
    print(f"Reading {arguments.size[0]} x {arguments.size[1]} px at {FPS} frames/s")
    print(f"{'clip s':>7} {'frames':>7} {'ms/frame':>9} {'MB at start':>12} {'peak MB':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for duration_s in LENGTHS_S:
            path = Path(folder) / f"{duration_s}.mp4"
            write_clip(path, duration_s, *arguments.size)
            command = [sys.executable, __file__, "--read", str(path)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            n_frames, seconds, start_mb, end_mb = map(float, done.stdout.split())
            print(
                f"{duration_s:7d} {n_frames:7.0f} {1e3 * seconds / n_frames:9.2f} "
                f"{start_mb:12.0f} {end_mb:8.0f}"
            )


if __name__ == "__main__":
    main()
