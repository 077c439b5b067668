"""Measure how BlazePose errs in the picture, on the lifting trials of the training persons.

Run from the project folder, after `benchmarks/monocular_lifts.py` has kept its keypoints::

    python -m engine.training.measure_blazepose --data ../shared/data/synthetic_lifts \
        --keypoints .benchmark_cache/monocular_lifts
"""

from __future__ import annotations

import argparse
from pathlib import Path

from engine.training.detected import read_detected
from engine.training.keypoint_noise import measure_noise

__all__ = ["NOISE_FILE", "main"]

NOISE_FILE = Path(__file__).with_name("blazepose_noise.json")


def main() -> None:
    """Measure, and write the values beside this module."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--keypoints", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=NOISE_FILE)
    options = parser.parse_args()
    measure_noise(read_detected(options.data, options.keypoints)).write(options.out)


if __name__ == "__main__":
    main()
