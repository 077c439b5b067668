"""Stored results as a real assessment leaves them, and what a report's PDF says."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from pypdf import PdfReader

from engine.config import Config
from engine.datatypes import Lift, Task, TrialResult
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.base import Exposure
from engine.ergonomics.flags import raise_flags
from engine.report.fonts import text_width
from engine.report.sheet import Sheet
from engine.storage.results import StoredResult, read_result, write_result
from engine.video.writer import VideoWriter
from tests.builders import (
    make_angles,
    make_end,
    make_lift,
    make_pose_track,
    make_trial,
    make_trial_result,
    make_view_pose,
)

N_FRAMES = 180
CREATED = "2026-03-05T14:30:00+00:00"
LIFTS = (
    make_lift(1.0, 2.2, peak_hand_speed_m_s=0.7),
    make_lift(4.0, 5.1, origin=make_end(4.0, H_cm=58.0, V_cm=22.0, A_deg=32.0)),
)


def make_assessed(
    lifts: Sequence[Lift] = LIFTS, *, task: Task | None = None, **changes: Any
) -> TrialResult:
    """Make a result judged by every method."""
    task = task or Task(load_kg=12.0, coupling="fair", frequency_per_min=2.0, duration_h=1.0)
    trial = make_trial(task=task, **changes)
    track, angles = make_pose_track(n_frames=N_FRAMES), make_angles(n_frames=N_FRAMES)
    exposure = Exposure(track, angles, tuple(lifts), trial.subject, trial.task, observed_s=6.0)
    risk = assess_risk(exposure, methods=(), experimental=False)
    coverage = {"measured": 0.9, "repaired": 0.01, "filled": 0.04, "missing": 0.05}
    return make_trial_result(
        n_frames=N_FRAMES,
        trial=trial,
        lifts=tuple(lifts),
        angles=angles,
        corrected=track,
        views=(make_view_pose(n_frames=N_FRAMES),),
        risk=risk,
        flags=raise_flags(risk, lifts, coverage),
        coverage=coverage,
        warnings=(),
    )


def store(
    result: TrialResult,
    folder: Path,
    *,
    overlay: Path | None = None,
    created: str = CREATED,
    edit: Callable[[dict[str, Any]], None] | None = None,
) -> StoredResult:
    """Write a result, at a fixed date, and read it back; `edit` changes its document."""
    write_result(result, folder, overlay=overlay)
    path = folder / "trial.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    document["created"] = created
    if edit is not None:
        edit(document)
    path.write_text(json.dumps(document), encoding="utf-8")
    return read_result(folder)


def with_blur(result: TrialResult, *, is_on: bool) -> TrialResult:
    """Return a result whose annotated video has heads covered, or not."""
    config = Config()
    output = dataclasses.replace(config.output, blur_heads=is_on)
    return dataclasses.replace(result, config=dataclasses.replace(config, output=output).as_dict())


def write_grey_video(path: Path, n_frames: int = N_FRAMES, fps: float = 30.0) -> Path:
    """Write a video whose grey rises by one level a frame: a picture tells its time."""
    with VideoWriter(path) as writer:
        for i in range(n_frames):
            writer.write(np.full((90, 160, 3), 20 + i, np.uint8), i / fps)
    return path


def read_pdf(pdf: bytes) -> PdfReader:
    """Open a report."""
    return PdfReader(BytesIO(pdf))


def read_text(pdf: bytes) -> str:
    """Return all text, with single spaces."""
    pages = (page.extract_text() for page in read_pdf(pdf).pages)
    return " ".join(" ".join(pages).split())


@dataclasses.dataclass(frozen=True)
class Written:
    """One piece of text on a page: its box in points."""

    page: int
    text: str
    left: float
    right: float
    bottom: float
    top: float

    def overlaps(self, other: Written) -> bool:
        """Whether two pieces of text touch."""
        return (
            self.page == other.page
            and self.left < other.right - 0.3
            and other.left < self.right - 0.3
            and self.bottom < other.top - 0.3
            and other.bottom < self.top - 0.3
        )


def record_text(monkeypatch: Any) -> list[Written]:
    """Record whatever reports write from now on, with its place."""
    written: list[Written] = []
    original = Sheet.text

    def text(self: Sheet, x: float, y: float, shown: str, **style: Any) -> None:
        width = text_width(shown, style["font"], style["size"])
        size = style["size"]
        written.append(
            Written(self.page_number, shown, x, x + width, y - 0.2 * size, y + 0.72 * size)
        )
        original(self, x, y, shown, **style)

    monkeypatch.setattr(Sheet, "text", text)
    return written


def find_overlaps(written: Sequence[Written]) -> list[tuple[str, str]]:
    """Return the texts that touch each other."""
    return [
        (a.text, b.text) for i, a in enumerate(written) for b in written[i + 1 :] if a.overlaps(b)
    ]


def find_outside(written: Sequence[Written], size: tuple[float, float], margin: float) -> list[str]:
    """Return the texts that leave the margins of the page."""
    width, height = size
    return [
        w.text
        for w in written
        if w.left < margin - 0.5
        or w.right > width - margin + 0.5
        or w.bottom < margin - 10
        or w.top > height - margin + 0.5
    ]


def list_tags(pdf: bytes) -> list[tuple[str, str]]:
    """Return role and description of every node of the structure tree, in reading order."""
    root = read_pdf(pdf).trailer["/Root"]["/StructTreeRoot"]["/K"].get_object()
    found: list[tuple[str, str]] = []

    def walk(node: Any) -> None:
        found.append((node["/S"], node.get("/Alt", "")))
        for kid in node.get("/K", ()):
            if not isinstance(kid, int):
                walk(kid.get_object())

    walk(root)
    return found
