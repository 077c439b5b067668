"""OpenSim's own scaling and inverse kinematics, through a worker process.

Everything OpenSim reads and writes is a file in one folder of its own. The folder goes when
all went well; when something failed it stays, with OpenSim's log in it, and the error names it.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from engine.datatypes import Array
from engine.errors import AssessmentError, BackendUnavailable, DataError
from engine.kinematics.markers.model import LOCKED, MEASUREMENTS, MarkerModel
from engine.kinematics.markers.osim import read_osim
from engine.kinematics.markers.osim_writer import write_osim
from engine.kinematics.markers.recording import MarkerRecording
from engine.kinematics.markers.trc import write_marker_trc
from engine.skeletons import MARKER_SETS

__all__ = ["OpenSimRun", "read_coordinates_mot", "require_opensim", "run_opensim"]

ACCURACY = 1e-6
"""Of OpenSim's optimiser. At 1e-3 angles are off by a degree; the default of the tool is 1e-5."""
WORKER = Path(__file__).with_name("_opensim_worker.py")
START_LIMIT_S = 120.0
FRAME_LIMIT_S = 0.2
"""Time allowed: to start and scale, and for every frame (it takes some 5 ms)."""
LOG_TAIL = 300


@dataclass(frozen=True, eq=False)
class OpenSimRun:
    """Coordinates (T, Q) in rad and m as OpenSim found them, and the model it made.

    `took_s` has the seconds of each step, with `_cpu` those of the processor.
    """

    coordinates: Array
    model: MarkerModel
    took_s: Mapping[str, float]


def require_opensim() -> None:
    """Refuse to go on without OpenSim.

    Raises
    ------
    BackendUnavailable
        If it is not installed, with the command that installs it.
    """
    if importlib.util.find_spec("opensim") is None:
        raise BackendUnavailable(
            "OpenSim is not installed; run: pip install 'liftlens[opensim]', or use the built-in "
            "inverse kinematics (solver markers)."
        )


def run_opensim(
    recording: MarkerRecording,
    model: MarkerModel,
    *,
    static_m: Array | None = None,
    stature_m: float | None = None,
    mass_kg: float | None = None,
    accuracy: float = ACCURACY,
    time_limit_s: float | None = None,
    command: Sequence[str] | None = None,
) -> OpenSimRun:
    """Fit markers with OpenSim.

    Parameters
    ----------
    recording
        What to fit.
    model
        Already scaled; or, with `static_m`, what OpenSim's `ScaleTool` is to scale. Its
        `static_coordinates` then become the model's default pose, as the tool measures in it.
    static_m
        Shape (M, 3): the markers while standing, in the recording's order.
    stature_m, mass_kg
        For the files only.
    accuracy
        Of the optimiser; 1e-4 or finer.
    time_limit_s
        After which OpenSim is stopped; by default 2 minutes and 0.2 s a frame.
    command
        What starts the worker, for a Python of its own or for tests.

    Raises
    ------
    BackendUnavailable
        If OpenSim is not installed.
    AssessmentError
        If it fails or does not end; the message names its log.
    """
    if command is None:
        require_opensim()
    if not 0 < accuracy <= 1e-4:
        raise DataError(f"The accuracy of OpenSim must be 1e-4 or finer, got {accuracy:g}.")
    folder = Path(tempfile.mkdtemp(prefix="liftlens_opensim_")).resolve()
    steps = ["ik"] if static_m is None else ["scale", "ik"]
    _write_inputs(folder, recording, model, static_m, stature_m, mass_kg, accuracy)
    limit = time_limit_s or START_LIMIT_S + FRAME_LIMIT_S * recording.time_s.size
    _run_worker([*(command or (sys.executable, str(WORKER))), str(folder), *steps], folder, limit)
    names = model.tree.coordinate_names
    times, values = read_coordinates_mot(folder / "ik.mot", names)
    coordinates = np.full((recording.time_s.size, len(names)), np.nan)
    rows = np.abs(recording.time_s[:, None] - times[None, :]).argmin(axis=0)
    coordinates[rows] = values
    made = model if static_m is None else _read_scaled(folder, model)
    took = json.loads((folder / "done.json").read_text(encoding="utf-8"))
    shutil.rmtree(folder, ignore_errors=True)
    return OpenSimRun(coordinates, made, took)


def _write_inputs(
    folder: Path,
    recording: MarkerRecording,
    model: MarkerModel,
    static_m: Array | None,
    stature_m: float | None,
    mass_kg: float | None,
    accuracy: float,
) -> None:
    write_marker_trc(recording, folder / "motion.trc")
    names = model.tree.coordinate_names
    start = dict(zip(names, model.start.tolist(), strict=True))
    generic = static_m is not None
    write_osim(
        model.source,
        folder / ("generic.osim" if generic else "scaled.osim"),
        markers=model.model.markers,
        scale={} if generic else model.scale,
        defaults=start,
        locked=[name for name in names if name[:-2] in LOCKED],
    )
    weights = {n: model.weights.get(n, 1.0) for n in model.marker_names if n in recording.names}
    if static_m is not None:
        standing = replace(
            recording,
            time_s=np.array([0.0, 0.01]),
            position_m=np.stack([static_m, static_m]),
            rate_hz=100.0,
            is_filled=np.zeros((2, len(recording.names)), dtype=bool),
        )
        write_marker_trc(standing, folder / "static.trc")
        _write_scale_setup(folder, model, weights, recording.names, stature_m, mass_kg)
    _write_ik_setup(folder, weights, recording, accuracy)


def _add(parent: Element, tag: str, text: object = None, **attributes: str) -> Element:
    element = SubElement(parent, tag, attributes)
    if text is not None:
        element.text = str(text)
    return element


def _write_document(tool: Element, path: Path) -> None:
    root = Element("OpenSimDocument", {"Version": "40000"})
    root.append(tool)
    ElementTree.ElementTree(root).write(path, encoding="UTF-8", xml_declaration=True)


def _add_tasks(parent: Element, weights: Mapping[str, float]) -> None:
    objects = _add(_add(parent, "IKTaskSet"), "objects")
    for marker, weight in weights.items():
        task = _add(objects, "IKMarkerTask", name=marker)
        _add(task, "apply", "true")
        _add(task, "weight", weight)


def _write_scale_setup(
    folder: Path,
    model: MarkerModel,
    weights: Mapping[str, float],
    seen: Sequence[str],
    stature_m: float | None,
    mass_kg: float | None,
) -> None:
    # Names alone: the tool puts the folder of its set-up file before whatever path it reads.
    tool = Element("ScaleTool", {"name": "subject"})
    _add(tool, "mass", -1 if mass_kg is None else mass_kg)
    _add(tool, "height", -1 if stature_m is None else 1000.0 * stature_m)
    _add(_add(tool, "GenericModelMaker"), "model_file", "generic.osim")
    scaler = _add(tool, "ModelScaler")
    _add(scaler, "apply", "true")
    _add(scaler, "scaling_order", "measurements")
    _add_measurements(scaler, model, seen)
    _add(scaler, "marker_file", "static.trc")
    _add(scaler, "time_range", "0 0.01")
    _add(scaler, "preserve_mass_distribution", "true")
    _add(scaler, "output_model_file", "sized.osim")
    _add(scaler, "output_scale_file", "scale_factors.xml")
    placer = _add(tool, "MarkerPlacer")
    _add(placer, "apply", "true")
    _add_tasks(placer, weights)
    _add(placer, "marker_file", "static.trc")
    _add(placer, "time_range", "0 0.01")
    _add(placer, "output_model_file", "scaled.osim")
    _write_document(tool, folder / "scale.xml")


def _add_measurements(scaler: Element, model: MarkerModel, seen: Sequence[str]) -> None:
    of = MARKER_SETS[model.marker_set].of_landmark
    objects = _add(_add(scaler, "MeasurementSet"), "objects")
    for number, measurement in enumerate(MEASUREMENTS):
        element = _add(objects, "Measurement", name=f"measurement_{number}")
        _add(element, "apply", "true")
        pairs = _add(_add(element, "MarkerPairSet"), "objects")
        for a, b in measurement.pairs:
            for side in ("left", "right") if "*" in a else ("",):
                ends = [of.get(k.replace("*", side), "") for k in (a, b)]
                if all(end in seen for end in ends):
                    _add(_add(pairs, "MarkerPair"), "markers", " ".join(ends))
        bodies = _add(_add(element, "BodyScaleSet"), "objects")
        for body in measurement.bodies:
            for letter in ("l", "r") if "*" in body else ("",):
                scale = _add(bodies, "BodyScale", name=body.replace("*", letter))
                _add(scale, "axes", "X Y Z")


def _write_ik_setup(
    folder: Path, weights: Mapping[str, float], recording: MarkerRecording, accuracy: float
) -> None:
    tool = Element("InverseKinematicsTool", {"name": "ik"})
    _add(tool, "results_directory", folder)
    _add(tool, "model_file", folder / "scaled.osim")
    _add(tool, "constraint_weight", "Inf")
    _add(tool, "accuracy", accuracy)
    _add_tasks(tool, weights)
    _add(tool, "marker_file", folder / "motion.trc")
    _add(tool, "time_range", f"{recording.time_s[0]:.6f} {recording.time_s[-1]:.6f}")
    _add(tool, "report_errors", "false")
    _add(tool, "output_motion_file", folder / "ik.mot")
    _write_document(tool, folder / "ik.xml")


def _run_worker(command: Sequence[str], folder: Path, limit_s: float) -> None:
    """Run the worker with its output in a log; stop it when the time is over."""
    log = folder / "opensim.log"
    environment = {**os.environ, "LC_ALL": "C", "LC_NUMERIC": "C"}
    with log.open("wb") as sink:
        process = subprocess.Popen(
            list(command), stdout=sink, stderr=subprocess.STDOUT, cwd=folder, env=environment
        )
        try:
            code = process.wait(timeout=limit_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise AssessmentError(
                f"OpenSim did not end within {limit_s:.0f} s and was stopped; its log is {log}. "
                "Try the built-in inverse kinematics (solver markers)."
            ) from None
        except BaseException:
            process.kill()
            process.wait()
            raise
    if code != 0 or not (folder / "done.json").exists():
        said = log.read_text(encoding="utf-8", errors="replace").strip()[-LOG_TAIL:]
        raise AssessmentError(
            f"OpenSim failed (code {code}); its log is {log} and ends with: {said!r}. Check the "
            "markers, or use the built-in inverse kinematics (solver markers)."
        )


def _read_scaled(folder: Path, unscaled: MarkerModel) -> MarkerModel:
    """Return the model that OpenSim scaled, with its markers in the set's order."""
    found = read_osim(folder / "scaled.osim")
    own = {marker.name: marker for marker in found.markers}
    kept = tuple(own[name] for name in unscaled.marker_names if name in own)
    factors = {}
    root = ElementTree.parse(folder / "scale_factors.xml").getroot()  # noqa: S314 - OpenSim's own
    for scale in root.iter("Scale"):
        words = (scale.findtext("scales") or "1 1 1").split()
        factors[(scale.findtext("segment") or "").strip()] = float(words[0])
    return replace(unscaled, model=replace(found, markers=kept), scale=factors)


def read_coordinates_mot(path: Path, names: Sequence[str]) -> tuple[Array, Array]:
    """Read the coordinates of a model from an OpenSim motion file.

    Parameters
    ----------
    path
        Degrees or radians, as its header says; short names or paths such as
        ``/jointset/hip_r/hip_flexion_r/value``.
    names
        The Q coordinates to return.

    Returns
    -------
    tuple
        Times (T,) and values (T, Q) in rad and m; NaN for coordinates that the file lacks.

    Raises
    ------
    DataError
        If the file has no header or does not say whether angles are in degrees.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    end = next((i for i, line in enumerate(lines) if line.strip().lower() == "endheader"), None)
    if end is None:
        raise DataError(f"{path.name} is no OpenSim motion file: it has no endheader line.")
    header = dict(line.split("=", 1) for line in lines[:end] if "=" in line)
    unit = {k.strip().lower(): v.strip().lower() for k, v in header.items()}.get("indegrees")
    if unit not in ("yes", "no"):
        raise DataError(f"{path.name} does not say inDegrees=yes or no; export it again.")
    labels = [_short_name(word) for word in lines[end + 1].split()]
    table = np.loadtxt(lines[end + 2 :], ndmin=2)
    values = np.full((len(table), len(names)), np.nan)
    for column, name in enumerate(names):
        if name in labels:
            values[:, column] = table[:, labels.index(name)]
            is_length = name.endswith(("_tx", "_ty", "_tz"))
            if unit == "yes" and not is_length:
                values[:, column] = np.radians(values[:, column])
    return table[:, 0], values


def _short_name(label: str) -> str:
    parts = label.strip("/").split("/")
    return parts[-2] if len(parts) > 1 and parts[-1] == "value" else parts[-1]
