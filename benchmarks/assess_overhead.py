"""What an assessment costs beyond its neural networks, and how much memory it needs.

Run from the project folder::

    .venv/bin/python benchmarks/assess_overhead.py --repeats 5
    .venv/bin/python benchmarks/assess_overhead.py --memory

The first takes a 5 s clip of 720 x 480 px and relates the time of the whole assessment to the
time inside its own networks, in the same run. The second assesses clips of 20 s and 5 min
(a sample clip over and over) in processes of their own and prints their peak memory.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from engine import Config, Subject, Task, Trial, View, assess
from engine.config import OutputConfig
from engine.pipeline import assess_to_folder
from engine.video.reader import read_frames
from engine.video.writer import VideoWriter

SAMPLE = Path(__file__).parents[1] / "sample_data/floor_to_knuckle/cam90.mp4"


def write_clip(path: Path, duration_s: float) -> Path:
    """Write the sample clip over and over until it lasts long enough, back and forth."""
    with VideoWriter(path) as writer:
        start_s = 0.0
        while start_s < duration_s:
            last_s = 0.0
            for frame in read_frames(SAMPLE):
                if start_s + frame.time_s >= duration_s:
                    break
                writer.write(frame.image, start_s + frame.time_s)
                last_s = frame.time_s
            start_s += last_s + 1 / 30
    return path


def make_trial(video: Path) -> Trial:
    """Describe the sample's person and load."""
    return Trial((View(video),), Subject(stature_m=1.725), Task(load_kg=10.0))


def measure_time(video: Path, repeats: int) -> None:
    """Print the time of whole assessments as a ratio to that of their networks."""
    config = Config()
    assess(make_trial(video), config)  # warms up imports and caches
    print("whole / networks        without video   with annotated video")
    bare, full = [], []
    for _ in range(repeats):
        start = time.perf_counter()
        result = assess(make_trial(video), config)
        bare.append((time.perf_counter() - start) / result.timings_s["networks"])
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            out = assess_to_folder(make_trial(video), config, Path(folder) / "result")
            spent = time.perf_counter() - start
            full.append(spent / _network_time(out))
        print(f"                        {bare[-1]:13.3f}   {full[-1]:20.3f}")
    print(f"median                  {median(bare):13.3f}   {median(full):20.3f}")
    print("last run, s:", {k: round(v, 3) for k, v in result.timings_s.items()})


def _network_time(folder: Path) -> float:
    from engine.storage.results import read_document

    return float(read_document(folder)["timings_s"]["networks"])


def measure_memory() -> None:
    """Print the peak memory of assessing a short and a long clip."""
    with tempfile.TemporaryDirectory() as folder:
        for seconds in (20, 300):
            video = write_clip(Path(folder) / f"{seconds}.mp4", seconds)
            command = [sys.executable, __file__, "--assess", str(video)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            print(f"{seconds:4d} s clip: peak {done.stdout.strip()} MB", flush=True)


def assess_once(video: Path) -> None:
    """Assess one video with its annotated video and print this process's peak memory."""
    config = Config(output=OutputConfig())
    with tempfile.TemporaryDirectory() as folder:
        assess_to_folder(make_trial(video), config, Path(folder) / "result")
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--assess", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.assess:
        assess_once(options.assess)
    elif options.memory:
        measure_memory()
    else:
        with tempfile.TemporaryDirectory() as folder:
            measure_time(write_clip(Path(folder) / "clip.mp4", 5.0), options.repeats)


if __name__ == "__main__":
    main()
