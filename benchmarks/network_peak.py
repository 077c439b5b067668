"""How near BlazePose's landmark network comes to what one core of the machine can compute.

    .venv/bin/python benchmarks/network_peak.py [--variant heavy] [--runs 30]

The yardstick is the product of two single-precision matrices on one thread. A network whose
pointwise convolutions run near it can't be made much faster by another runtime, only by less
exact numbers.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import onnxruntime
from threadpoolctl import threadpool_limits

from engine.pose.blazepose import CROP_SIZE_PX, MODEL_DIR


def measure_peak(size: int = 1024, runs: int = 100) -> float:
    """Return the speed of a matrix product on one thread, 1e9 operations a second."""
    matrix = np.random.default_rng(0).random((size, size), dtype=np.float32)
    times = []
    with threadpool_limits(limits=1, user_api="blas"):
        for _ in range(runs):
            start = time.perf_counter()
            matrix @ matrix
            times.append(time.perf_counter() - start)
    return 2 * size**3 / statistics.median(times) / 1e9


def profile(model: Path, runs: int) -> list[dict]:
    """Run the network on one thread and return what ONNX Runtime notes of every layer."""
    with tempfile.TemporaryDirectory() as scratch:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.log_severity_level = 3
        options.enable_profiling = True
        options.profile_file_prefix = str(Path(scratch) / "profile")
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        picture = np.random.default_rng(0).random((1, CROP_SIZE_PX, CROP_SIZE_PX, 3), np.float32)
        for _ in range(runs):
            session.run(None, {"image": picture})
        return json.loads(Path(session.end_profiling()).read_text())


def kind_of(operator: str, weights: list[int] | None) -> str:
    """Name the kind of a layer."""
    if operator != "Conv" or weights is None:
        return "everything else"
    outputs, inputs, height, width = weights
    if inputs == 1 and outputs > 1:
        return "depthwise convolution"
    return "pointwise convolution" if (height, width) == (1, 1) else "other convolution"


def summarise(events: list[dict], runs: int) -> dict[str, tuple[float, float]]:
    """Return milliseconds and 1e9 operations of every kind of layer, for one picture."""
    spent: dict[str, float] = defaultdict(float)
    done: dict[str, float] = defaultdict(float)
    for event in events:
        if event.get("cat") != "Node" or not event["name"].endswith("kernel_time"):
            continue
        shapes = [next(iter(s.values())) for s in event["args"]["input_type_shape"]]
        weights = shapes[1] if len(shapes) > 1 and len(shapes[1]) == 4 else None
        kind = kind_of(event["args"]["op_name"], weights)
        spent[kind] += event["dur"] / 1000 / runs
        if kind.endswith("convolution"):
            output = next(iter(event["args"]["output_type_shape"][0].values()))
            done[kind] += 2 * np.prod(output) * np.prod(weights[1:]) / 1e9 / runs
    return {kind: (spent[kind], done[kind]) for kind in sorted(spent, key=spent.get, reverse=True)}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--variant", default="heavy", choices=("heavy", "full"))
    parser.add_argument("--runs", type=int, default=30)
    options = parser.parse_args()
    peak = measure_peak()
    rows = summarise(
        profile(MODEL_DIR / f"pose_landmark_{options.variant}.onnx", options.runs), options.runs
    )
    total = sum(ms for ms, _ in rows.values())
    print(
        f"{options.variant}, one thread, {platform.machine()}, load {os.getloadavg()[0]:.1f}; "
        f"matrix product {peak:.0f} GFLOP/s"
    )
    print(f"{'':24} {'ms':>6} {'share':>6} {'GFLOP/s':>8} {'of the product':>15}")
    for kind, (ms, operations) in rows.items():
        speed = operations / ms * 1000
        known = f"{speed:8.0f} {speed / peak:15.0%}" if operations else ""
        print(f"{kind:24} {ms:6.1f} {ms / total:6.0%} {known}")


if __name__ == "__main__":
    main()
