"""Small studies with known differences, for the tests of the protocol."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from engine.validation.protocol.folds import TrialFrames
from engine.validation.protocol.leak import LeakCheck
from engine.validation.protocol.statistics import (
    TABLE3_ROWS,
    MethodResult,
    MethodTrial,
    Study,
    StudyTrial,
)

MARKERS = ("HTOP", "C7", "RASI", "LASI")
ANGLES = tuple(
    name
    for row in TABLE3_ROWS
    for name in ((row,) if row.startswith("lumbar") else (f"{row}_r", f"{row}_l"))
)
N_FRAMES = 40


def make_frames(
    subject: str = "S1",
    task: str = "FK",
    repetition: int = 1,
    *,
    n: int = 8,
    rate_hz: float = 10.0,
    unusable: Sequence[int] = (),
) -> TrialFrames:
    """Return the frames of one recording."""
    usable = np.ones(n, dtype=bool)
    usable[list(unusable)] = False
    label = f"{subject}_{task}_{repetition:02d}"
    return TrialFrames(subject, label, task, repetition, np.arange(n) / rate_hz, usable)


def make_trial(subject: str = "S1", task: str = "FK", repetition: int = 1) -> StudyTrial:
    """Return a trial whose angles are slow sines."""
    time = np.arange(N_FRAMES) / 30.0
    phase = np.linspace(0, np.pi, N_FRAMES)
    markers = np.zeros((N_FRAMES, len(MARKERS), 3))
    markers[..., 1] = 1.0 + 0.1 * np.sin(phase)[:, None]
    markers[..., 0] = np.arange(len(MARKERS))
    angles = 60.0 * np.sin(phase)[:, None] * np.linspace(0.2, 1.0, len(ANGLES))
    return StudyTrial(
        subject, f"{subject}_{task}_{repetition:02d}", task, repetition, time, MARKERS, markers,
        ANGLES, angles, np.full_like(angles, np.nan),
    )  # fmt: skip


def make_method(
    name: str = "hog/gp",
    *,
    subjects: Sequence[str] = ("S1", "S2"),
    tasks: Sequence[str] = ("FK", "KS"),
    repetitions: int = 2,
    off_mm: float = 10.0,
    off_deg: float = 1.0,
    spread: float = 0.0,
    seed: int = 0,
) -> MethodResult:
    """Return a method that is off by a known distance and angle, plus noise of `spread` shares."""
    noise = np.random.default_rng(seed)
    trials = []
    for subject in subjects:
        for task in tasks:
            for repetition in range(1, repetitions + 1):
                trial = make_trial(subject, task, repetition)
                factor = 1.0 + spread * noise.standard_normal(N_FRAMES)
                shift = np.zeros_like(trial.measured_m)
                shift[..., 2] = off_mm / 1000.0 * factor[:, None]
                angle = off_deg + spread * off_deg * noise.standard_normal(
                    trial.reference_deg.shape
                )
                trials.append(
                    MethodTrial(trial, trial.measured_m + shift, trial.reference_deg + angle)
                )
    return MethodResult(name, tuple(trials), fit_s=1.0, predict_ms=0.5, settings={"fold": {}})


def make_study(*methods: MethodResult, is_synthetic: bool = True) -> Study:
    """Return a study without a leak."""
    leak = LeakCheck(100, 30.0, 0.0, float("nan"), 5.0, is_raised=False)
    return Study(
        title="small lifts",
        kind="trial",
        is_synthetic=is_synthetic,
        methods=methods or (make_method(spread=0.2),),
        leaks={"hog": leak},
        settings={"seed": 0},
    )


def write_dataset(
    folder: Path,
    *,
    persons: Sequence[str] = ("S1", "S2"),
    tasks: Sequence[str] = ("FK",),
    repetitions: int = 2,
    with_cameras: bool = True,
) -> Path:
    """Write the layout of a data set; videos and markers are empty files."""
    for person in persons:
        home = folder / person
        home.mkdir(parents=True)
        facts: dict[str, object] = {"sex": "F", "height_m": 1.7, "mass_kg": 70}
        if with_cameras:
            facts["calibration"] = [make_camera("cam90"), make_camera("cam135")]
        (home / "subject.json").write_text(json.dumps(facts))
        for task in tasks:
            for repetition in range(1, repetitions + 1):
                trial = home / f"{person}_{task}_{repetition:02d}"
                trial.mkdir()
                for name in ("cam135.mp4", "cam90.mp4", "markers.trc"):
                    (trial / name).touch()
                (trial / "trial.json").write_text(
                    json.dumps({"task": task, "repetition": repetition, "events_s": {"place": 1.0}})
                )
    return folder


def make_camera(name: str) -> dict[str, object]:
    """Return a camera as subject.json holds it."""
    return {
        "name": name,
        "K": [[700, 0, 360], [0, 700, 240], [0, 0, 1]],
        "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
        "t": [0, 1, 4],
        "dist": [0, 0, 0, 0, 0],
        "width": 720,
        "height": 480,
    }
