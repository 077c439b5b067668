"""The built-in inverse kinematics of skin markers, against OpenSim and against the truth.

Run from the project folder::

    python benchmarks/marker_ik.py opensim --out benchmarks/results/marker_ik_opensim.txt
    python benchmarks/marker_ik.py truth --out benchmarks/results/marker_ik_truth.txt
    python benchmarks/marker_ik.py reference --out benchmarks/results/marker_ik_reference.txt

`opensim` needs the extra of that name. It fits the same model to the same markers with both: once
markers without noise, made by the model itself in the movement of a real fit (so that the true
angles are known), once the markers as measured. Then each scales the model by itself. The files
that LiftLens writes are read back by OpenSim's own reader. Times are CPU seconds of one core, which
other work on the machine lengthens for both alike.

`reference` fits models that others scaled (of Rajagopal et al., as changed by Lai and Uhlrich) to
recordings of real squats, and compares with the angles published beside them; those come from
AddBiomechanics, which weighs forces and the whole clip too, so that they are no truth.

`truth` compares the angles of the built-in fit with those of the bones, on the synthetic lifts of
the training persons. Nothing is tuned on the test persons, and they are not read.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from engine.kinematics.markers import (
    MarkerFit,
    MarkerModel,
    MarkerRecording,
    filter_markers,
    fit_markers,
    keypoints_from_markers,
    read_marker_model,
    read_marker_trc,
    resample_markers,
    table3_angles,
    write_coordinates_mot,
    write_marker_trc,
)
from engine.kinematics.markers._opensim import OpenSimRun, read_coordinates_mot, run_opensim
from engine.skeletons import get_skeleton
from engine.validation.reference.base import Recording
from engine.validation.reference.trc import read_trc

ROOT = Path(__file__).resolve().parents[1]
DEFAULT_DATA = ROOT.parent / "shared" / "data" / "synthetic_lifts"
TRAINING = ("P01", "P02", "P03", "P04", "P06")
TASKS = ("FK", "KS", "FS")
VIDEO_HZ = 30.0
TRUTH_NAMES = {
    "hip flexion": ("hip_flexion", 1),
    "hip adduction": ("hip_adduction", 1),
    "hip rotation": ("hip_rotation", 1),
    "knee flexion": ("knee_flexion", 1),
    "ankle flexion": ("ankle_dorsiflexion", 1),
    "lumbar extension": ("lumbar_extension", 1),
    "lumbar bending": ("lumbar_bending", 1),
    "lumbar rotation": ("lumbar_rotation", 1),
    "arm flexion": ("arm_flexion", 1),
    "arm adduction": ("arm_adduction", 1),
    "arm rotation": ("arm_rotation", 1),
    "elbow flexion": ("elbow_flexion", 1),
    "elbow rotation": ("forearm_pronation", 1),
}


def read_trial(data: Path, name: str, *, rate_hz: float | None = None) -> MarkerRecording:
    """Return the filtered markers of a trial, at their own rate or another."""
    recording = filter_markers(read_marker_trc(data / name[:3] / name / "markers.trc"))
    if rate_hz is None:
        return recording
    return resample_markers(recording, np.arange(0, recording.time_s[-1], 1 / rate_hz))


def make_exact(fit: MarkerFit) -> MarkerRecording:
    """Return the markers of the fitted model itself: no noise, no skin."""
    return MarkerRecording(fit.time_s, fit.markers_m, fit.marker_names, VIDEO_HZ, "synthetic_45")


def timed(work: Callable[[], MarkerFit], repeats: int = 3) -> tuple[MarkerFit, float]:
    """Return what a fit gives, and the least CPU seconds it took."""
    took = []
    for _ in range(repeats):
        start = time.process_time()
        result = work()
        took.append(time.process_time() - start)
    return result, min(took)


def as_fit(run: OpenSimRun, fit: MarkerFit) -> MarkerFit:
    """Return OpenSim's coordinates in the form of a fit, for the angles of Table 3."""
    factor = np.where(fit.model.tree.is_translation, 1.0, np.degrees(1.0))
    return replace(fit, coordinates=run.coordinates * factor, model=run.model)


def rms_mm(model: MarkerModel, recording: MarkerRecording, coordinates: np.ndarray) -> float:
    """Return the weighted distance of the markers for coordinates in rad and m."""
    problem, used = model.problem(recording.names)
    found = problem.evaluate(recording.position_m[:, used], coordinates)
    return 1000 * float(np.sqrt(np.mean(found.rms_m**2)))


def rows_of(names: tuple[str, ...], difference: np.ndarray) -> list[tuple[str, float, float]]:
    """Return row of Table 3, mean and largest absolute difference, both sides together."""
    rows: dict[str, list[np.ndarray]] = {}
    for name, curve in zip(names, difference.T, strict=True):
        rows.setdefault(name.partition(" (")[0], []).append(np.abs(curve))
    return [(row, float(np.mean(c)), float(np.max(c))) for row, c in rows.items()]


def compare_opensim(data: Path, trial: str) -> list[str]:
    recording = read_trial(data, trial, rate_hz=VIDEO_HZ)
    own = fit_markers(recording.time_s, recording.position_m, recording.names)
    lines: list[str] = []
    for title, markers in (("without noise", make_exact(own)), ("as measured", recording)):
        lines += _same_model(title, markers, own)
    lines += _accuracies(make_exact(own), own)
    lines += _own_scaling(recording, own)
    return lines + _round_trips(recording, own)


def _same_model(title: str, markers: MarkerRecording, own: MarkerFit) -> list[str]:
    model, n_frames = own.model, own.time_s.size

    def work() -> MarkerFit:
        return fit_markers(markers.time_s, markers.position_m, markers.names, model=model)

    fit, took = timed(work)
    run = run_opensim(markers, model, time_limit_s=3600.0)
    names, ours = table3_angles(fit)
    theirs = table3_angles(as_fit(run, fit))[1]
    known = table3_angles(own)[1]
    factor = np.where(model.tree.is_translation, 1.0, np.degrees(1.0))
    lines = [
        "",
        f"Markers {title}, the same model ({n_frames} frames)",
        "                       built-in - OpenSim"
        + ("      built-in - truth    OpenSim - truth" if title == "without noise" else ""),
        "angle, deg                 mean      max"
        + ("        mean      max      mean      max" if title == "without noise" else ""),
    ]
    against = [rows_of(names, ours - known), rows_of(names, theirs - known)]
    for i, (row, mean, largest) in enumerate(rows_of(names, ours - theirs)):
        text = f"{row:<22} {mean:8.3f} {largest:8.3f}"
        if title == "without noise":
            text += "   " + " ".join(f"{a[i][1]:9.4f} {a[i][2]:8.4f}" for a in against)
        lines.append(text)
    difference = np.abs(ours - theirs)
    lines += [
        f"{'all 23 angles':<22} {difference.mean():8.3f} {difference.max():8.3f}",
        (
            f"marker distance (weighted RMS), mm: built-in "
            f"{rms_mm(model, markers, fit.coordinates / factor):.4f}, OpenSim "
            f"{rms_mm(model, markers, run.coordinates):.4f}"
        ),
        (
            f"CPU ms a frame: built-in {1000 * took / n_frames:.2f}, OpenSim "
            f"{1000 * run.took_s['ik_cpu'] / n_frames:.2f}, ratio {run.took_s['ik_cpu'] / took:.1f}"
        ),
    ]
    return lines


def _accuracies(markers: MarkerRecording, own: MarkerFit) -> list[str]:
    """Say what the accuracy asked of OpenSim costs and brings, on markers without noise."""
    known = table3_angles(own)[1]
    lines = [
        "",
        "OpenSim's accuracy, markers without noise",
        "accuracy   CPU ms a frame   mean |d|",
    ]
    for accuracy in (1e-4, 1e-5, 1e-6):
        run = run_opensim(markers, own.model, accuracy=accuracy, time_limit_s=3600.0)
        error = np.abs(table3_angles(as_fit(run, own))[1] - known).mean()
        took = 1000 * run.took_s["ik_cpu"] / markers.time_s.size
        lines.append(f"{accuracy:<10.0e} {took:14.2f} {error:10.3f}")
    return lines


def _own_scaling(recording: MarkerRecording, own: MarkerFit) -> list[str]:
    theirs = fit_markers(recording.time_s, recording.position_m, recording.names, ik="opensim")
    names, ours = table3_angles(own)
    difference = ours - table3_angles(theirs)[1]
    lines = [
        "",
        "Each scales by itself, markers as measured",
        "angle, deg            mean |d|      max   mean signed",
    ]
    signed = {r: [] for r, _, _ in rows_of(names, difference)}
    for name, curve in zip(names, difference.T, strict=True):
        signed[name.partition(" (")[0]].append(curve.mean())
    for row, mean, largest in rows_of(names, difference):
        lines.append(f"{row:<22} {mean:8.3f} {largest:8.3f} {np.mean(signed[row]):+12.3f}")
    lines.append(f"{'all 23 angles':<22} {np.abs(difference).mean():8.3f}")
    lines.append(
        "size of bodies, built-in / OpenSim: "
        + ", ".join(
            f"{body} {own.scale[body]:.3f} / {theirs.scale[body]:.3f}"
            for body in (
                "torso",
                "pelvis",
                "femur_r",
                "tibia_r",
                "calcn_r",
                "humerus_r",
                "radius_r",
            )
        )
    )
    return lines


READ_BACK = """
import sys, opensim
opensim.Logger.removeFileSink()
trc = opensim.TimeSeriesTableVec3(sys.argv[1])
mot = opensim.TimeSeriesTable(sys.argv[2])
row = trc.getRowAtIndex(10)
first = row.getElt(0, 0)
labels = list(mot.getColumnLabels())
print(trc.getNumRows(), trc.getNumColumns(), first[0], first[1], first[2], mot.getNumRows(),
      mot.getNumColumns(), mot.getDependentColumn('knee_angle_r')[10])
"""


def _round_trips(recording: MarkerRecording, fit: MarkerFit) -> list[str]:
    """Let OpenSim's own reader read what LiftLens writes."""
    with tempfile.TemporaryDirectory() as folder:
        trc, mot = Path(folder) / "markers.trc", Path(folder) / "coordinates.mot"
        write_marker_trc(recording, trc)
        write_coordinates_mot(fit, mot)
        done = subprocess.run(
            [sys.executable, "-c", READ_BACK, str(trc), str(mot)],
            capture_output=True,
            text=True,
            check=True,
            cwd=folder,
        )
    words = done.stdout.split()[-8:]
    at = np.array([float(w) for w in words[2:5]])
    marker_mm = np.abs(at - 1000 * recording.position_m[10, 0]).max()
    if marker_mm > 100:  # OpenSim 4 turns a TRC file to metres in some versions
        marker_mm = 1000 * np.abs(at - recording.position_m[10, 0]).max()
    knee = abs(float(words[7]) - fit["knee_angle_r"][10])
    return [
        "",
        "Read back by OpenSim's TimeSeriesTable",
        (
            f"TRC: {words[0]} of {recording.time_s.size} frames, {words[1]} of "
            f"{len(recording.names)} markers, a marker off by {marker_mm:.5f} mm"
        ),
        (
            f"MOT: {words[5]} of {fit.time_s.size} frames, {words[6]} of "
            f"{len(fit.coordinate_names)} coordinates, a knee angle off by {knee:.2e} deg"
        ),
    ]


# --------------------------------------------------------------------------- reference

REFERENCE_TRIALS = (("opencap_subject4", "squats1"), ("double_leg_squat", "DLS01"))
REFERENCE_ROWS = {
    "hip flexion": "hip_flexion_*",
    "hip adduction": "hip_adduction_*",
    "hip rotation": "hip_rotation_*",
    "knee flexion": "knee_angle_*",
    "ankle flexion": "ankle_angle_*",
    "lumbar extension": "lumbar_extension",
    "lumbar bending": "lumbar_bending",
    "lumbar rotation": "lumbar_rotation",
    "arm flexion": "arm_flex_*",
    "arm adduction": "arm_add_*",
    "arm rotation": "arm_rot_*",
    "elbow flexion": "elbow_flex_*",
}


def compare_reference(data: Path) -> list[str]:
    lines: list[str] = []
    for folder, trial in REFERENCE_TRIALS:
        base = data.parent / "reference" / folder
        recording = read_trc(base / f"{trial}.trc")
        model = read_marker_model(base / "model_scaled.osim")
        fit, took = timed(
            partial(
                fit_markers, recording.time_s, recording.position, recording.labels, model=model
            ),
            repeats=1,
        )
        _, published = read_coordinates_mot(base / f"{trial}_ik.mot", fit.coordinate_names)
        factor = np.where(model.tree.is_translation, 1.0, np.degrees(1.0))
        own = 1000 * float(np.sqrt(np.nanmean(fit.residual_m**2)))
        theirs = rms_mm(model, _as_markers(recording), np.nan_to_num(published))
        lines += [
            "",
            f"{folder}, {trial}: {recording.time_s.size} frames",
            f"marker distance (RMS), mm: built-in {own:.2f}, published angles {theirs:.2f}",
            f"CPU ms a frame: {1000 * took / recording.time_s.size:.2f}",
            "angle, deg            median of d   mean |d|   range of motion",
        ]
        for row, pattern in REFERENCE_ROWS.items():
            names = [pattern.replace("*", s) for s in ("lr" if "*" in pattern else " ")]
            columns = [fit.coordinate_names.index(n) for n in names]
            curve = (published * factor)[:, columns]
            d = fit.coordinates[:, columns] - curve
            lines.append(
                f"{row:<22} {np.median(d):+10.2f} {np.abs(d).mean():10.2f} "
                f"{np.ptp(curve, axis=0).mean():14.1f}"
            )
    return lines


def _as_markers(recording: Recording) -> MarkerRecording:
    return MarkerRecording(recording.time_s, recording.position, recording.labels, 100.0)


# --------------------------------------------------------------------------- truth


def compare_truth(data: Path, repetition: str) -> list[str]:
    signed: dict[str, list[np.ndarray]] = {}
    excursion: dict[str, list[float]] = {}
    centres: dict[str, list[float]] = {}
    pelvis: list[np.ndarray] = []
    residual: list[float] = []
    n_trials = 0
    for person in TRAINING:
        for task in TASKS:
            name = f"{person}_{task}_{repetition}"
            recording = read_trial(data, name, rate_hz=VIDEO_HZ)
            truth = np.load(data / person / name / "truth.npz", allow_pickle=False)
            fit = fit_markers(recording.time_s, recording.position_m, recording.names)
            n_trials += 1
            residual.append(float(np.sqrt(np.nanmean(fit.residual_m**2))))
            _add_angles(fit, truth, signed, excursion)
            _add_centres(recording, truth, centres)
            pelvis.append(_pelvis_of_markers(recording, truth))
    lines = [
        (
            f"{n_trials} trials of {', '.join(TRAINING)} (repetition {repetition}, tasks "
            f"{', '.join(TASKS)}), markers resampled to {VIDEO_HZ:g} Hz"
        ),
        f"marker distance from the model (RMS): {1000 * np.mean(residual):.1f} mm",
        "",
        "fitted - bone, deg; without offset: minus the median of the trial",
        "angle                mean signed   mean |d|   without offset   excursion",
    ]
    every, without = [], []
    for row, curves in signed.items():
        offset_free = [np.abs(c - np.median(c)).mean() for c in curves]
        size = float(np.mean([np.abs(c).mean() for c in curves]))
        weight = 1 if row.startswith("lumbar") else 2
        every += [size] * weight
        without += [float(np.mean(offset_free))] * weight
        lines.append(
            f"{row:<20} {np.mean([c.mean() for c in curves]):+11.2f} {size:10.2f} "
            f"{np.mean(offset_free):16.2f} {np.mean(excursion[row]):11.1f}"
        )
    lines.append(
        f"{'mean of 23 angles':<20} {'':11} {np.mean(every):10.2f} {np.mean(without):16.2f}"
    )
    shared = [
        np.concatenate(signed["hip flexion"][2 * i : 2 * i + 2]) - np.tile(extension, 2)
        for i, extension in enumerate(signed["lumbar extension"])
    ]
    lines += [
        "",
        (
            "Hip and lumbar flexion together (thigh against thorax): mean signed "
            f"{np.mean([c.mean() for c in shared]):+.2f}, mean |d| "
            f"{np.mean([np.abs(c).mean() for c in shared]):.2f}, without offset "
            f"{np.mean([np.abs(c - np.median(c)).mean() for c in shared]):.2f} deg"
        ),
        "",
        (
            "Four pelvis markers alone, tilt of their plane - tilt of the bone, minus its value at "
            "the start, deg:"
        ),
        (
            f"largest of a trial {np.mean([np.abs(p).max() for p in pelvis]):.1f} on average "
            f"({np.max([np.abs(p).max() for p in pelvis]):.1f} at most): skin over the pelvis, "
            "not the fit, moves hip flexion against lumbar extension"
        ),
        "",
        "Keypoints straight from markers - joint centres, mean distance, mm",
        *(f"{joint:<10} {np.mean(v):6.1f}" for joint, v in centres.items()),
    ]
    return lines


def _at(truth: np.lib.npyio.NpzFile, key: str, time_s: np.ndarray) -> np.ndarray:
    values = truth[key].reshape(truth["time"].size, -1)
    return np.stack([np.interp(time_s, truth["time"], column) for column in values.T], axis=1)


def _add_angles(
    fit: MarkerFit,
    truth: np.lib.npyio.NpzFile,
    signed: dict[str, list[np.ndarray]],
    excursion: dict[str, list[float]],
) -> None:
    names, curves = table3_angles(fit)
    known = truth["angle_names"].tolist()
    true = _at(truth, "angles", fit.time_s)
    for name, curve in zip(names, curves.T, strict=True):
        row, _, side = name.partition(" (")
        base, sign = TRUTH_NAMES[row]
        column = known.index(f"{base}_{side[0]}" if side else base)
        signed.setdefault(row, []).append(curve - sign * true[:, column])
        excursion.setdefault(row, []).append(float(np.ptp(true[:, column])))


def _add_centres(
    recording: MarkerRecording, truth: np.lib.npyio.NpzFile, centres: dict[str, list[float]]
) -> None:
    track = keypoints_from_markers(recording.time_s, recording.position_m, recording.names)
    joints = truth["joint_names"].tolist()
    true = _at(truth, "joints", recording.time_s).reshape(recording.time_s.size, -1, 3)
    for joint in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist", "ear"):
        for side in ("left", "right"):
            own = track.position[:, get_skeleton(track.skeleton).index(f"{side}_{joint}")]
            other = true[:, joints.index(f"{joint}_{side[0].upper()}")]
            distance = 1000 * np.linalg.norm(own - other, axis=1)
            centres.setdefault(joint, []).append(float(distance.mean()))


def _pelvis_of_markers(recording: MarkerRecording, truth: np.lib.npyio.NpzFile) -> np.ndarray:
    at = [recording.names.index(k) for k in ("RASI", "LASI", "RPSI", "LPSI")]
    corners = recording.position_m[:, at]
    forward = corners[:, :2].mean(axis=1) - corners[:, 2:].mean(axis=1)
    tilt = np.degrees(np.arctan2(forward[:, 1], forward[:, 0]))
    column = truth["angle_names"].tolist().index("pelvis_tilt")
    error = tilt - _at(truth, "angles", recording.time_s)[:, column]
    return np.asarray(error - error[:5].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("opensim", "truth", "reference"))
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA)
    parser.add_argument("--trial", default="P01_FK_01", help="of a training person")
    parser.add_argument("--repetition", default="01")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with threadpool_limits(1):
        if args.part == "opensim":
            what, lines = (
                f"synthetic lifts, trial {args.trial}",
                compare_opensim(args.data, args.trial),
            )
        elif args.part == "truth":
            what, lines = (
                "synthetic lifts, training persons",
                compare_truth(args.data, args.repetition),
            )
        else:
            what, lines = "real squats", compare_reference(args.data)
    head = [
        f"Inverse kinematics of skin markers, {what}; no random numbers.",
        f"python benchmarks/marker_ik.py {args.part}",
        (
            f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
            f"load {os.getloadavg()[0]:.1f}"
        ),
    ]
    text = "\n".join([*head, *lines]) + "\n"
    print(text)
    if args.out:
        args.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
