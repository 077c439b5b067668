"""How long comparing with references takes: 20 trials of 10 s, and one on the dashboard's page.

Trials are the bundled synthetic lifts, repeated to 10 s, with noise, each with markers at 100 Hz
(TRC) and a result at 30 frames per second, as a video gives. Timed are reading both, joint
centres, the reference's angles, alignment and all statistics (10 000 resamples and sign flips),
tables and the JSON document; figures are timed apart. Names and machine apart, the run is
repeatable: ``python benchmarks/validate_speed.py``.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
import time
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from engine.datatypes import PoseTrack, Subject  # noqa: E402
from engine.kinematics.fitting.geometric import SOLVER  # noqa: E402
from engine.storage.results import read_result, write_result  # noqa: E402
from engine.validate import compare_results  # noqa: E402
from engine.validation.joint_centres import build_pose_track  # noqa: E402
from engine.validation.outcome import build_agreement_document  # noqa: E402
from engine.validation.reference.base import Reference  # noqa: E402
from engine.validation.reference.files import read_reference  # noqa: E402
from engine.validation.resampling import resample_positions  # noqa: E402
from engine.validation.tables import build_tables, format_csv  # noqa: E402
from tests.builders import make_trial, make_trial_result  # noqa: E402
from tests.engine.validation.recordings import write_trc  # noqa: E402

LENGTH_S = 10.0
LIFTS = ("floor_to_knuckle", "floor_to_shoulder")
LIMIT_S, PAGE_LIMIT_S = 5.0, 1.0


def lengthen(reference: Reference, noise_m: float, rng: np.random.Generator) -> np.ndarray:
    """Return 10 s of markers: there and back again, with noise."""
    markers = reference.markers
    assert markers is not None
    n = round(LENGTH_S * markers.rate_hz) + 1
    there = markers.position
    both = np.concatenate([there, there[::-1]])
    cycle = np.concatenate([both] * (1 + n // len(both)))[:n]
    return cycle + rng.normal(0.0, noise_m, cycle.shape)


def make_pair(folder: Path, number: int, seed: int) -> tuple[Path, Path]:
    """Write one result and its reference; return both paths."""
    rng = np.random.default_rng([seed, number])
    lift = LIFTS[number % len(LIFTS)]
    reference = read_reference(ROOT / "sample_data" / lift / "markers.trc")
    assert reference.markers is not None
    trc = write_trc(
        folder / f"{number:02d}.trc",
        reference.markers.labels,
        1000.0 * lengthen(reference, 0.001, rng),
    )
    truth = build_pose_track(read_reference(trc), skeleton="mediapipe_33")
    wanted = np.arange(0.0, LENGTH_S, 1 / 30)
    seen = resample_positions(truth, wanted).position
    track = PoseTrack(
        wanted + 0.1, seen + rng.normal(0.0, 0.01, seen.shape), "m", "world", "mediapipe_33"
    )
    person = Subject(label=f"P{number % 10:02d}", stature_m=1.73)
    result = make_trial_result(
        n_frames=track.n_frames,
        trial=make_trial(subject=person, label=f"trial {number}", job=lift),
        raw=track,
        corrected=track,
        angles=SOLVER.fit(track, person).angles,
    )
    return write_result(result, folder / f"result_{number:02d}"), trc


def time_comparison(pairs: list[tuple[Path, Path]]) -> dict[str, float]:
    """Return seconds by stage."""
    spent: dict[str, float] = {}
    start, cpu = time.perf_counter(), time.process_time()
    loaded = [(read_result(result), read_reference(trc)) for result, trc in pairs]
    spent["read"] = time.perf_counter() - start
    agreement = compare_results(loaded)
    spent["compare"] = time.perf_counter() - start - spent["read"]
    build_agreement_document(agreement)
    for table in build_tables(agreement):
        format_csv(table)
    spent["tables"] = time.perf_counter() - start - spent["read"] - spent["compare"]
    spent["total"] = time.perf_counter() - start
    spent["cpu"] = time.process_time() - cpu
    return spent


def time_figures(pairs: list[tuple[Path, Path]]) -> float:
    from engine.validation.figures import draw_figures

    agreement = compare_results([(read_result(a), read_reference(b)) for a, b in pairs])
    start = time.process_time()
    draw_figures(agreement)
    return time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        pairs = [make_pair(Path(scratch), i, options.seed) for i in range(options.trials)]
        time_comparison(pairs[:1])  # imports and caches
        many = [time_comparison(pairs) for _ in range(options.repeats)]
        one = [time_comparison(pairs[:1]) for _ in range(options.repeats)]
        figures_s = time_figures(pairs[:1])
    best, single = (min(runs, key=lambda run: run["total"]) for runs in (many, one))
    repeats = options.repeats
    command = f"--trials {options.trials} --repeats {repeats} --seed {options.seed}"
    machine = f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    lines = [
        f"# python benchmarks/validate_speed.py {command}",
        f"# {machine}; one thread used; best of {repeats}; seconds",
        "# cpu: time on the processor, which other programs on the machine don't lengthen",
        f"{'what':<26}{'read':>8}{'compare':>9}{'tables':>8}{'total':>8}{'cpu':>8}{'limit':>8}",
    ]
    for what, run, limit in (
        (f"{options.trials} trials of {LENGTH_S:.0f} s", best, LIMIT_S),
        ("1 trial, as on the page", single, PAGE_LIMIT_S),
    ):
        row = f"{run['read']:>8.2f}{run['compare']:>9.2f}{run['tables']:>8.2f}{run['total']:>8.2f}"
        row += f"{run['cpu']:>8.2f}"
        lines.append(f"{what:<26}{row}{limit:>8.1f}  {'ok' if run['total'] <= limit else 'MISSED'}")
    lines.append(f"figures of one trial (PNG), apart: {figures_s:.1f} s cpu")
    text = "\n".join(lines) + "\n"
    print(text)
    (ROOT / "benchmarks" / "results" / "validate_speed.txt").write_text(text)


if __name__ == "__main__":
    main()
