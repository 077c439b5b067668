"""Trials for a library, in one line."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path

from engine.datatypes import FlagLevel, Subject
from engine.storage.library import Library
from engine.storage.results import write_result
from tests.builders import make_flag, make_trial, make_trial_result


def add(
    library: Library,
    trial_id: str | None = None,
    *,
    created: datetime | None = None,
    person: str = "P01",
    levels: tuple[FlagLevel, ...] | None = None,
    label: str = "Crate to shelf",
    site: str = "Hall 3",
    job: str = "Packing",
    **changes: object,
) -> str:
    """Put a trial into a library; `levels` are those of its lifts, in order."""
    trial = make_trial(
        label=label, site=site, job=job, subject=Subject(label=person, stature_m=1.75)
    )
    if levels is not None:
        changes["lis"] = (1.0,) * len(levels)
        changes["flags"] = tuple(make_flag(level, lift_index=i) for i, level in enumerate(levels))
    folder = library.root.parent / f"work-{library.new_id()}"
    result = make_trial_result(n_frames=2, trial=trial, **changes)  # type: ignore[arg-type]
    write_result(result, folder)
    if created is not None:
        rewrite(folder, created=created.isoformat())
    return library.adopt(folder, trial_id)


def rewrite(folder: Path, **changes: object) -> None:
    """Change keys of a result's document in place, as another program would."""
    path = folder / "trial.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**document, **changes}), encoding="utf-8")
