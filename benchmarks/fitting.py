"""Speed of the whole-clip fit: against clip length, and against OpenSim's inverse kinematics.

OpenSim fits the scaled model of the trial to the markers, frame by frame, through its in-process
interface (no files are read or written while the clock runs; reading the model and the first
assembly are not counted), at its usual accuracy of 1e-5 and at 1e-3. Our solver fits the 17 joints
of the same trial, resampled to the same frames, and computes every angle with its error. Times are
processor time of one thread, so that other work on the machine matters less; the lowest and the
median of several runs. The two do not solve the same problem: OpenSim has 51 markers and a model
with muscles and 39 coordinates, ours 13 points and 25 unknowns a frame, but it also links the
frames and estimates errors.

Run from the repository, where the package `opensim` is installed: python benchmarks/fitting.py
"""

from __future__ import annotations

import argparse
import dataclasses
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from engine.datatypes import PoseTrack, Subject
from engine.kinematics.fitting.base import select_solver
from engine.kinematics.fitting.least_squares import FitSettings, fit_track

SUBJECT = Subject(stature_m=1.70)
TRIAL = "squats1"
OPENCAP = "reference/opencap_subject4"
SEED = 20261122
SIGMA_M = 0.02


def read_clip(data: Path, trial: str) -> PoseTrack:
    """Return the joints of a reference trial, world axes with Y up."""
    with np.load(data / "reference/reference_h36m17_30fps.npz", allow_pickle=False) as file:
        names = [str(name) for name in file["name"]]
        i = next(k for k, name in enumerate(names) if name.endswith(trial))
        rows = slice(file["start"][i], file["start"][i] + file["length"][i])
        joints = file["pose"][rows].astype(float) + file["root"][rows, None]
    world = np.stack([joints[..., 0], joints[..., 2], -joints[..., 1]], axis=-1)
    return make_track(np.arange(len(world)) / 30.0, world)


def make_track(time_s: np.ndarray, position: np.ndarray) -> PoseTrack:
    sigma = np.full(position.shape[:2], SIGMA_M)
    return PoseTrack(time_s, position, "m", "world", "h36m_17", sigma=sigma)


def resample(track: PoseTrack, time_s: np.ndarray) -> PoseTrack:
    """Return the track at other times, by linear interpolation."""
    flat = track.position.reshape(track.n_frames, -1)
    curves = [np.interp(time_s, track.time_s, curve) for curve in flat.T]
    return make_track(time_s, np.stack(curves, axis=1).reshape(time_s.size, -1, 3))


def repeat(track: PoseTrack, n_frames: int) -> PoseTrack:
    """Return a clip of any length: the track to and fro, without jumps."""
    there = np.concatenate([np.arange(track.n_frames), np.arange(track.n_frames)[-2:0:-1]])
    index = np.resize(there, n_frames)
    step = float(np.median(np.diff(track.time_s)))
    return make_track(np.arange(n_frames) * step, track.position[index])


def add_noise(track: PoseTrack, size_m: float) -> PoseTrack:
    noise = np.random.default_rng(SEED).normal(scale=size_m, size=track.position.shape)
    return dataclasses.replace(track, position=track.position + noise)


def best_ms(call: Callable[[], object], n_frames: int, repeats: int) -> tuple[float, float]:
    """Return the lowest and the median processor time per frame, ms."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(1000.0 * (time.process_time() - start) / n_frames)
    return min(times), float(np.median(times))


# --------------------------------------------------------------------------- OpenSim


def read_marker_times(data: Path) -> list[float]:
    """Return the frame times of the trial's marker file."""
    import opensim

    table = opensim.TimeSeriesTableVec3(str(data / f"{OPENCAP}/{TRIAL}.trc"))
    return [float(t) for t in table.getIndependentColumn()]


def time_opensim(
    data: Path, times: list[float], accuracy: float, repeats: int
) -> tuple[float, float]:
    """Return lowest and median time per frame of OpenSim's inverse kinematics."""
    import opensim

    opensim.Logger.setLevelString("Off")
    table = opensim.TimeSeriesTableVec3(str(data / f"{OPENCAP}/{TRIAL}.trc"))
    model = opensim.Model(str(data / OPENCAP / "model_scaled.osim"))
    state = model.initSystem()
    markers = opensim.MarkersReference(table, opensim.SetMarkerWeights())
    solver = opensim.InverseKinematicsSolver(
        model, markers, opensim.SimTKArrayCoordinateReference(), float("inf")
    )
    solver.setAccuracy(accuracy)
    state.setTime(times[0])
    solver.assemble(state)

    def run() -> None:
        for moment in times:
            state.setTime(moment)
            solver.track(state)

    return best_ms(run, len(times), repeats)


# --------------------------------------------------------------------------- tables


def compare_with_opensim(data: Path, n_frames: int, repeats: int) -> list[str]:
    """Return times of both on the same frames of one trial."""
    times = read_marker_times(data)[:n_frames]
    rows = [
        f"{TRIAL}, {len(times)} frames at 100 Hz",
        "solver                      ms/frame min  median",
    ]
    theirs = {}
    for accuracy in (1e-5, 1e-3):
        label = f"OpenSim 4.6 IK, {accuracy:g}"
        theirs[label] = time_opensim(data, times, accuracy, max(1, repeats // 4))
        rows.append(f"{label:28s} {theirs[label][0]:11.3f} {theirs[label][1]:7.3f}")
    clip = resample(read_clip(data, TRIAL), np.array(times))
    solver = select_solver("least-squares")
    ours = best_ms(lambda: solver.fit(clip, SUBJECT), len(times), repeats)
    rows.append(f"{'least-squares':28s} {ours[0]:11.3f} {ours[1]:7.3f}")
    for label, (low, middle) in theirs.items():
        rows.append(
            f"{label} takes {low / ours[0]:.0f} times as long (medians {middle / ours[1]:.0f})."
        )
    return rows


def measure_growth(data: Path, repeats: int) -> list[str]:
    """Return times against clip length, clean and noisy, and what a single-frame fit takes."""
    solver = select_solver("least-squares")
    track = read_clip(data, TRIAL)
    rows = ["clip      frames  ms/frame min  median  all ms"]
    for noise in (0.0, SIGMA_M):
        for n_frames in (100, 200, 400, 800, 1600, 3200):
            clip = add_noise(repeat(track, n_frames), noise)
            few = max(2, min(repeats, 2000 // n_frames))
            low, middle = best_ms(lambda clip=clip: solver.fit(clip, SUBJECT), n_frames, few)
            kind = "noisy" if noise else "clean"
            rows.append(f"{kind:8s} {n_frames:7d} {low:13.3f} {middle:7.3f} {low * n_frames:7.0f}")
    clip = add_noise(repeat(track, 400), SIGMA_M)
    single = FitSettings(is_smooth=False)
    low, middle = best_ms(lambda: fit_track(clip, SUBJECT.stature, single), 400, 3)
    rows.append(f"Each frame by itself (noisy, 400 frames, no errors): {low:.3f} ({middle:.3f}).")
    return rows


def main() -> None:
    """Run the comparison and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--repeats", type=int, default=12)
    parser.add_argument("--frames", type=int, default=100, help="of the comparison with OpenSim")
    parser.add_argument("--without-opensim", action="store_true")
    parser.add_argument("--out", type=Path, help="write the tables to this file too")
    options = parser.parse_args()
    head = (
        f"Speed of the whole-clip fit, one thread. Seed {SEED}, {platform.machine()}, Python "
        f"{platform.python_version()}, NumPy {np.__version__}. Command: python "
        "benchmarks/fitting.py"
    )
    text = [head]
    with threadpool_limits(limits=1, user_api="blas"):
        if not options.without_opensim:
            text += ["", *compare_with_opensim(options.data, options.frames, options.repeats)]
        text += ["", *measure_growth(options.data, options.repeats)]
    print("\n".join(text))
    if options.out:
        options.out.write_text("\n".join(text) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
