"""Whether the intervals of the agreement statistics hold what they promise, and what they cost.

Run from the project folder::

    .venv/bin/python benchmarks/agreement_statistics.py

Simulated studies with known truth: every subject has an offset of its own, every frame an error
that depends on the frame before (like that of a smoothed keypoint). The first table counts how
often the 95 % intervals hold the truth and how often tests find a difference that isn't there; the
second gives the time of the whole comparison. Results go to
``benchmarks/results/agreement_statistics.txt``.
"""

from __future__ import annotations

import argparse
import math
import platform
import time
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import lfilter
from scipy.special import ndtri

from engine.validation.agreement import PairedTrial, summarise_agreement, summarise_angle
from engine.validation.metrics import ALIGNMENTS, compare_poses

RESULTS = Path(__file__).parent / "results" / "agreement_statistics.txt"
BETWEEN_DEG, WITHIN_DEG, BIAS_DEG = 2.0, 3.0, 1.0
DECAY_S = 0.2
"""Time in which the correlation of the frames' errors falls to 1/e."""


def simulate(
    rng: np.random.Generator,
    n_subjects: int,
    n_trials: int,
    *,
    bias: float,
    between: float = BETWEEN_DEG,
    fps: float = 30.0,
    n_angles: int = 1,
    duration_s: float = 10.0,
) -> list[PairedTrial]:
    """Return trials with known bias, scatter between subjects and correlated errors of frames."""
    n = int(duration_s * fps)
    phase = np.linspace(0, 2 * np.pi, n)[:, None] + np.arange(n_angles)
    truth = 60.0 - 50.0 * np.cos(phase)
    r = np.exp(-1 / (fps * DECAY_S))
    trials = []
    for s in range(n_subjects):
        own = rng.normal(bias, between, n_angles)
        for t in range(n_trials):
            noise = rng.normal(0, np.sqrt(1 - r**2), (n, n_angles))
            noise[0] = rng.normal(size=n_angles)
            error = WITHIN_DEG * lfilter([1.0], [1.0, -r], noise, axis=0)
            names = tuple(f"angle_{i}" for i in range(n_angles))
            trials.append(
                PairedTrial(f"S{s}", f"T{t}", np.arange(n) / fps, names, truth + own + error, truth)
            )
    return trials


def count_coverage(n_subjects: int, n_trials: int, n_studies: int, seed: int) -> dict[str, float]:
    """Return the percentage of intervals that hold the truth, and of false findings."""
    rng = np.random.default_rng([seed, n_subjects, n_trials])
    # One subject's offset can't be told from the bias: it is the truth there.
    between = BETWEEN_DEG if n_subjects > 1 else 0.0
    limit = BIAS_DEG + float(ndtri(0.975)) * np.hypot(between, WITHIN_DEG)
    hits = dict.fromkeys(
        (
            "bias interval",
            "bootstrap bias",
            "upper limit",
            "t frames naive",
            "t frames corrected",
            "t trials",
            "t subjects",
            "curves max-t",
        ),
        0,
    )
    for _ in range(n_studies):
        trials = simulate(rng, n_subjects, n_trials, bias=BIAS_DEG, between=between)
        found = summarise_angle("angle_0", trials, n_resamples=1000, n_flips=1024)
        hits["bias interval"] += found.bland_altman.bias_interval.contains(BIAS_DEG)
        hits["bootstrap bias"] += found.bias.interval.contains(BIAS_DEG)
        hits["upper limit"] += found.bland_altman.upper_interval.contains(limit)
        trials = simulate(rng, n_subjects, n_trials, bias=0.0, between=between)
        null = summarise_angle("angle_0", trials, n_resamples=10, n_flips=1024)
        hits["t frames naive"] += null.per_frame.naive.p < 0.05
        hits["t frames corrected"] += null.per_frame.corrected.p < 0.05
        hits["t trials"] += null.per_trial.p < 0.05
        hits["t subjects"] += null.per_unit.p < 0.05
        hits["curves max-t"] += null.curve_test.p <= 0.05
    shares = {name: 100.0 * hit / n_studies for name, hit in hits.items()}
    # What a design can't give is not a failure.
    unknown = {
        "bootstrap bias": not found.bias.interval.is_known,
        "t trials": math.isnan(null.per_trial.p),
        "t subjects": math.isnan(null.per_unit.p),
        "curves max-t": not null.curve_test.can_find_differences,
    }
    return {name: math.nan if unknown.get(name) else v for name, v in shares.items()}


def measure_time(n_subjects: int, n_trials: int, *, seed: int) -> dict[str, float]:
    """Return the seconds that comparing 25 angles and 45 markers takes, trials at 30 to 100 fps."""
    rng = np.random.default_rng(seed)
    rates = np.linspace(30, 100, n_subjects * n_trials)
    trials = [
        trial
        for i, fps in enumerate(rates)
        for trial in simulate(rng, 1, 1, bias=1.0, fps=float(fps), n_angles=25)
    ]
    trials = [
        PairedTrial(
            f"S{i % n_subjects}",
            f"T{i}",
            t.time_s,
            t.names,
            t.estimated_deg,
            t.reference_deg,
        )
        for i, t in enumerate(trials)
    ]
    start = _now()
    summarise_agreement(trials, seed=seed)
    angles = _now() - start
    start = _now()
    names = [f"m{k}" for k in range(45)]
    for trial in trials:
        reference = rng.normal(size=(trial.time_s.size, 45, 3))
        estimated = reference + 0.02 * rng.normal(size=reference.shape)
        for alignment in ALIGNMENTS:
            compare_poses(
                trial.time_s, estimated, reference, names=names, alignment=alignment, root=(0, 1)
            )
    positions = _now() - start
    return {
        "frames": sum(t.time_s.size for t in trials),
        "angles, processor": angles[0],
        "angles, clock": angles[1],
        "positions, processor": positions[0],
        "positions, clock": positions[1],
    }


def _now() -> np.ndarray:
    return np.array([time.process_time(), time.perf_counter()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=200, help="simulated studies per row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    designs = [(1, 1), (1, 4), (3, 1), (3, 4), (5, 4), (8, 2), (12, 3), (20, 1)]
    coverage = pd.DataFrame(
        [
            {"subjects": s, "trials each": t, **count_coverage(s, t, args.studies, args.seed)}
            for s, t in designs
        ]
    )
    speed = pd.DataFrame(
        [
            {"subjects": s, "trials each": t, **measure_time(s, t, seed=args.seed)}
            for s, t in ((1, 20), (5, 4), (20, 1))
        ]
    )
    text = f"""\
Statistics of agreement on simulated studies with known truth. {platform.machine()}, \
Python {platform.python_version()}
Command: benchmarks/agreement_statistics.py --studies {args.studies} --seed {args.seed}
10 s at 30 frames/s; SD of the subjects' offsets {BETWEEN_DEG:g} deg, of a frame's error \
{WITHIN_DEG:g} deg, correlated over {DECAY_S:g} s.

Share of 95 % intervals that hold the truth (should be 95), and of tests at 5 % that find a
difference where there is none (should be 5), percent; standard error of either \
{100 * np.sqrt(0.95 * 0.05 / args.studies):.1f}.
{coverage.to_string(index=False, float_format="{:.1f}".format, na_rep="-")}
With one subject its own offset is the truth, and its trials are what the tests count. "-": not
given for so few. Naive: every frame taken as independent, as papers do; corrected: the effective
number of frames, but trials of a subject still taken as independent; use trials or subjects.

Time of the whole comparison, 20 trials of 10 s at 30 to 100 frames/s: 25 angles; 45 markers under
four alignments. Seconds of the processor, and by the clock on whatever else the machine did.
{speed.to_string(index=False, float_format="{:.2f}".format)}
"""
    print(text)
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
