"""What the validation protocol writes: pictures with markers, tables, figures, page and PDF."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from engine.cameras.files.reading import read_calibration
from engine.datatypes import Array, Camera, Frame, ProgressCallback
from engine.errors import CalibrationError
from engine.kinematics.markers.keypoints import find_marker_set
from engine.optics import project
from engine.protocol_inputs import PersonData, write_arrays
from engine.protocol_stored import PDF_NAME, REFERENCE_FOLDER
from engine.report.study_report import render_study_pdf
from engine.storage.atomic import explain_os_errors, write_aside
from engine.validation.protocol.dataset import SubjectFiles, TrialFiles
from engine.validation.protocol.figures import Overlay, draw_study
from engine.validation.protocol.report import build_report, render_study
from engine.validation.protocol.statistics import (
    MethodTrial,
    Study,
    compare_methods,
    summarise_rows,
)
from engine.version import __version__
from engine.video.privacy import BlurRegion, blur_regions
from engine.video.reader import read_frames

__all__ = ["draw_pictures", "write_reference", "write_study"]

MOMENTS = (("lift_start", "grab"), ("place", "place"), ("stand", "stand"))
"""Events of a trial, and what Figure 2 calls them."""
SHARES = (0.35, 0.65, 0.95)
"""Where in a trial without events those moments are looked for."""
HEAD_LANDMARKS = ("vertex", "forehead", "front_head", "back_head", "side_head")
HEAD_RADIUS_M = 0.19
"""A head with its hair lies within so much of the middle of its markers."""


def write_study(
    study: Study, overlays: Sequence[Sequence[Overlay]], out: Path, progress: ProgressCallback
) -> None:
    """Write every file of a study; study.json comes last, so that it means all are there."""
    progress("testing the differences", 0, 0)
    rows = {method.name: summarise_rows(method) for method in study.methods}
    comparisons = compare_methods(study.methods)
    progress("drawing the figures", 0, 0)
    figures = draw_study(study, rows[study.main.name], overlays)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    report = build_report(study, rows, comparisons, figures, version=__version__, created=created)
    files = render_study(study, rows, comparisons, report, version=__version__, created=created)
    files = {PDF_NAME: render_study_pdf(report), **files}
    progress("writing the report", 0, 0)
    with explain_os_errors(out, "The study"):
        for name in ("tables", "figures"):
            shutil.rmtree(out / name, ignore_errors=True)
        for name, content in files.items():
            path = out / name
            path.parent.mkdir(parents=True, exist_ok=True)
            with write_aside(path) as aside:
                aside.write_bytes(content)


def write_reference(persons: Sequence[PersonData], out: Path) -> None:
    """Keep what was measured beside what was estimated, one file per trial."""
    for person in persons:
        for trial in person.trials:
            arrays = {
                "time_s": trial.time_s,
                "marker_names": np.array(trial.marker_names),
                "markers_m": trial.measured_m.astype(np.float32),
                "angle_names": np.array(trial.angle_names),
                "angles_deg": trial.reference_deg,
                "true_angles_deg": trial.truth_deg,
            }
            write_arrays(out / REFERENCE_FOLDER / f"{trial.subject}_{trial.label}.npz", arrays)


# --------------------------------------------------------------------------- figure 2


def draw_pictures(
    one: MethodTrial, persons: Sequence[PersonData], progress: ProgressCallback
) -> list[list[Overlay]]:
    """Show both sets of markers in the pictures at three moments; nothing without cameras.

    Heads are blurred.
    """
    progress("drawing the markers into the pictures", 0, 0)
    person = next(p for p in persons if p.label == one.trial.subject)
    files = next(f for f in person.files.trials if f.label == one.trial.label)
    cameras = _find_cameras(person.files, files, person.picture_px)
    if not cameras:
        return []
    return [
        _draw_view(one, files, number, camera)
        for number, camera in enumerate(cameras[: len(files.videos)])
    ]


def _find_cameras(
    subject: SubjectFiles, files: TrialFiles, picture_px: Sequence[tuple[int, int]]
) -> tuple[Camera, ...]:
    if subject.cameras or subject.calibration is None:
        return subject.cameras
    try:
        found = read_calibration(
            subject.calibration, sizes_px=picture_px, names=[path.name for path in files.videos]
        )
    except CalibrationError:
        # Only the overlays need it; everything else is worth having without them.
        return ()
    return found.cameras


def _draw_view(one: MethodTrial, files: TrialFiles, view: int, camera: Camera) -> list[Overlay]:
    wanted = _find_moments(one, files)
    found: dict[int, Frame] = {}
    for frame in read_frames(files.videos[view]):
        if frame.index in wanted:
            found[frame.index] = frame
    overlays = []
    for index, words in wanted.items():
        if index not in found:
            continue
        measured, estimated = one.trial.measured_m[index], one.estimated_m[index]
        image = np.array(found[index].image)
        _blur_head(image, camera, measured, one.trial.marker_names)
        overlays.append(
            Overlay(
                image=image,
                estimated_px=project(camera, estimated),
                measured_px=project(camera, measured),
                title=f"{words}, {files.videos[view].stem}, {one.trial.time_s[index]:.2f} s: "
                f"{one.frame_mm[index]:.0f} mm",
            )
        )
    return overlays


def _find_moments(one: MethodTrial, files: TrialFiles) -> dict[int, str]:
    """Return the frames of the three moments, with their names."""
    time_s = one.trial.time_s
    moments = {}
    for (event, words), share in zip(MOMENTS, SHARES, strict=True):
        moment = files.events_s.get(event, time_s[0] + share * (time_s[-1] - time_s[0]))
        moments[int(np.argmin(np.abs(time_s - moment)))] = words
    return moments


def _blur_head(image: np.ndarray, camera: Camera, marker_m: Array, names: Sequence[str]) -> None:
    """Cover the head where its markers are; the whole top of the picture if there are none."""
    known = find_marker_set(names)
    at = [
        list(names).index(marker)
        for landmark, marker in known.of_landmark.items()
        if landmark.removeprefix("left_").removeprefix("right_") in HEAD_LANDMARKS
        and marker in names
    ]
    seen = marker_m[at][np.isfinite(marker_m[at]).all(axis=1)]
    if not len(seen):
        height, width = image.shape[:2]
        blur_regions(image, [BlurRegion(0, 0, width, height / 2, is_round=False)])
        return
    # The markers lie on the top of the head; the face is below them.
    middle = seen.mean(axis=0) - np.array([0.0, 0.05, 0.0])
    x, y = project(camera, middle)
    edge = project(camera, middle + np.array([0.0, HEAD_RADIUS_M, 0.0]))
    radius = float(np.hypot(*(edge - np.array([x, y]))))
    if np.isfinite(radius):
        blur_regions(image, [BlurRegion.around(float(x), float(y), radius)])
