"""Finished results of the bundled samples: what a first launch shows before anything is assessed.

::

    sample_data/results/<key>/   trial.json, tracks.npz, overlay.mp4, thumbnail.jpg
                                 (two views: overlay2.mp4 and calibration.toml as well)

They are ordinary results in a smaller form: videos encoded anew, curves kept to about four digits,
and without the tables that can be written again from the curves. In the library they are ordinary
trials at the site `SAMPLES_SITE`, tagged `SAMPLE_TAG`. A library gets them once, while it is empty;
what a user removes does not come back by itself.

``python -m engine.sample_results`` makes them anew from a library in which `liftlens demo` ran.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from engine import cli_demo
from engine.storage.atomic import explain_os_errors
from engine.storage.overview import LiftCounts, MonthOverview, Overview

if TYPE_CHECKING:
    from engine.storage.library import Library

__all__ = [
    "SAMPLES_SITE",
    "SAMPLE_TAG",
    "add_samples",
    "find_samples",
    "leave_out",
    "remove_samples",
    "retire_samples",
    "shrink_result",
    "welcome",
]

SAMPLES_SITE = cli_demo.SAMPLES_SITE
SAMPLE_TAG = "sample"
LABEL_PREFIX = "Sample: "
ID_PREFIX = "bundled-"
"""Not that of `liftlens demo`, which assesses the same clips for real and replaces these."""
RESULTS_NAME = "results"
WELCOMED_NAME = ".samples-added"
"""In the library's folder: it got the samples once."""

KEPT_FILES = ("calibration.toml", "thumbnail.jpg")
VIDEO_NAMES = ("overlay.mp4", "overlay2.mp4")
VIDEO_CRF = 28
SIGNIFICANT_BITS = 14
"""Of every kept number but times: 0.03 px of 500 px, 0.1 mm of 2 m."""


def welcome(library: Library) -> int:
    """Add the samples to a library that nobody has used yet; return how many came.

    Raises
    ------
    EngineError
        If the library can't be read or written.
    """
    mark = library.root / WELCOMED_NAME
    if mark.exists() or library.is_read_only or not library.is_empty:
        return 0
    n_added = add_samples(library)
    with explain_os_errors(mark, "The library"):
        mark.touch()
    return n_added


def add_samples(library: Library) -> int:
    """Add the samples that are not in the library; return how many came.

    Raises
    ------
    EngineError
        If a sample can't be read, or the library can't be written.
    """
    missing = {name: place for name, place in _shipped().items() if not library.has(name)}
    for trial_id, folder in missing.items():
        with (
            explain_os_errors(library.root, "The sample"),
            tempfile.TemporaryDirectory(dir=library.root, prefix=".sample-") as work,
        ):
            library.adopt(_unpack(folder, Path(work) / folder.name), trial_id)
        library.edit(trial_id, version=library.record(trial_id).version, tags=[SAMPLE_TAG])
    return len(missing)


def find_samples(library: Library) -> tuple[str, ...]:
    """Return the ids of the samples that are in the library."""
    return tuple(trial_id for trial_id in _shipped() if library.has(trial_id))


def remove_samples(library: Library) -> int:
    """Delete the samples from the library; return how many went.

    Raises
    ------
    OutputError
        If something can't be deleted.
    """
    present = find_samples(library)
    for trial_id in present:
        library.delete(trial_id)
    return len(present)


def retire_samples(library: Library) -> int:
    """Delete samples whose clip was assessed for real since; return how many went.

    Raises
    ------
    OutputError
        If something can't be deleted.
    """
    present = find_samples(library)
    if not present:
        return 0
    real = {f"{ID_PREFIX}{s.key}" for s in cli_demo.read_samples() if library.has(s.trial_id)}
    doomed = [trial_id for trial_id in present if trial_id in real]
    for trial_id in doomed:
        library.delete(trial_id)
    return len(doomed)


def leave_out(overview: Overview, samples: Overview) -> Overview:
    """Return an overview without the trials of another one, which must be a part of it.

    Parameters
    ----------
    overview
        Of all trials in question.
    samples
        Of those at `SAMPLES_SITE` among them.

    Returns
    -------
    Overview
        The first as it is if nothing else is in it: samples are better than an empty page.
    """
    if not samples.lifts.n_trials or samples.lifts.n_trials == overview.lifts.n_trials:
        return overview
    less = {(month.year, month.month): month.lifts for month in samples.months}
    months = [
        MonthOverview(m.year, m.month, _subtract(m.lifts, less.get((m.year, m.month))))
        for m in overview.months
    ]
    return replace(
        overview,
        lifts=_subtract(overview.lifts, samples.lifts),
        sites=tuple(place for place in overview.sites if place.site != SAMPLES_SITE),
        jobs=tuple(place for place in overview.jobs if place.site != SAMPLES_SITE),
        months=tuple(month for month in months if month.lifts.n_trials),
    )


def _subtract(whole: LiftCounts, part: LiftCounts | None) -> LiftCounts:
    if part is None:
        return whole
    return LiftCounts(
        n_trials=whole.n_trials - part.n_trials,
        n_lifts=whole.n_lifts - part.n_lifts,
        n_high=whole.n_high - part.n_high,
        n_review=whole.n_review - part.n_review,
        n_ok=whole.n_ok - part.n_ok,
    )


def _shipped() -> dict[str, Path]:
    """Return the folders of the shipped results by the ids they get; empty without any."""
    found = sorted((cli_demo.SAMPLE_FOLDER / RESULTS_NAME).glob("*/trial.json"))
    return {f"{ID_PREFIX}{path.parent.name}": path.parent for path in found}


def _unpack(source: Path, target: Path) -> Path:
    """Copy a shipped result and write the tables that were left out."""
    from engine.storage.results import read_result
    from engine.storage.tables import write_angles_csv, write_angles_mot, write_keypoints_trc

    shutil.copytree(source, target)
    stored = read_result(target)
    write_keypoints_trc(stored.corrected, target / "keypoints.trc")
    write_angles_mot(stored.angles, target / "angles.mot")
    write_angles_csv(stored.angles, target / "angles.csv")
    return target


# --------------------------------------------------------------------------- making them


def shrink_result(source: Path, target: Path) -> Path:
    """Write the small form of a result folder; an earlier one there is replaced.

    Raises
    ------
    DataError
        If the source is no whole result.
    """
    from engine.storage.results import read_document, read_result

    read_result(source)
    document = read_document(source)
    document["label"] = LABEL_PREFIX + document["label"].removeprefix(LABEL_PREFIX)
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    (target / "trial.json").write_text(text + "\n", encoding="utf-8")
    with np.load(source / "tracks.npz", allow_pickle=False) as stored:
        arrays = {name: _round(name, stored[name]) for name in stored.files}
    np.savez_compressed(target / "tracks.npz", allow_pickle=False, **arrays)
    for name in KEPT_FILES:
        if (source / name).is_file():
            shutil.copyfile(source / name, target / name)
    for name in VIDEO_NAMES:
        if (source / name).is_file():
            _encode(source / name, target / name)
    return target


def _round(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Keep `SIGNIFICANT_BITS` of each number; times and whole numbers stay exact."""
    if values.dtype.kind != "f" or name.endswith("time_s"):
        return values
    mantissa, exponent = np.frexp(values)
    scale = float(2**SIGNIFICANT_BITS)
    kept: NDArray[Any] = np.ldexp(np.round(mantissa * scale) / scale, exponent)
    return kept.astype(np.float32)


def _encode(source: Path, target: Path) -> None:
    from engine.video.reader import read_frames
    from engine.video.writer import VideoWriter

    with VideoWriter(target, crf=VIDEO_CRF, preset="veryslow") as writer:
        for frame in read_frames(source):
            writer.write(frame.image, frame.time_s)


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the shipped results anew from the trials that `liftlens demo` made."""
    from engine.storage.library import Library

    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--home", type=Path, required=True, help="the library of `liftlens demo`")
    given = parser.parse_args(arguments)
    library = Library(given.home)
    for sample in cli_demo.read_samples():
        target = cli_demo.SAMPLE_FOLDER / RESULTS_NAME / sample.key
        shrink_result(library.folder(sample.trial_id), target)


if __name__ == "__main__":
    main()
