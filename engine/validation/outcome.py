"""Everything a comparison leaves behind, as named files in memory; the caller writes them."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from engine.validation.compare import TrialComparison
from engine.validation.pooled import Agreement, describe_agreement, describe_offsets
from engine.validation.statistics import DEPENDENCE_WARNING
from engine.validation.summary import render_summary
from engine.validation.tables import build_tables, format_csv

__all__ = [
    "AGREEMENT_NAME",
    "SCHEMA_PATH",
    "SCHEMA_VERSION",
    "SUMMARY_NAME",
    "build_agreement_document",
    "render_outcome",
]

AGREEMENT_NAME = "agreement.json"
SUMMARY_NAME = "summary.html"
SCHEMA_VERSION = 1
"""Raised whenever a key of `agreement.json` changes its name, type or meaning."""
SCHEMA_PATH = Path(__file__).with_name("agreement.schema.json")


def render_outcome(agreement: Agreement, *, version: str = "") -> dict[str, bytes]:
    """Return every file of a comparison: JSON, tables, figures and the one-page summary.

    Parameters
    ----------
    agreement
        What was found.
    version
        Of the program, for the document.

    Returns
    -------
    dict
        Path inside the folder to content.
    """
    # Matplotlib takes a second to load, which only this needs.
    from engine.validation.figures import draw_figures

    created = datetime.now(UTC).isoformat(timespec="seconds")
    document = build_agreement_document(agreement, version=version, created=created)
    figures = draw_figures(agreement)
    files = {AGREEMENT_NAME: _to_json(document)}
    files |= {f"tables/{t.name}.csv": format_csv(t) for t in build_tables(agreement)}
    files |= {f"figures/{name}.png": content for name, content in figures.items()}
    files[SUMMARY_NAME] = render_summary(
        agreement, figures, version=version, created=created
    ).encode()
    return files


def build_agreement_document(
    agreement: Agreement, *, version: str = "", created: str = ""
) -> dict[str, Any]:
    """Return the content of `agreement.json`; NaN and infinity are None."""
    summaries = [_encode_summary(s) for s in agreement.angles]
    document = {
        "schema_version": SCHEMA_VERSION,
        "liftlens_version": version,
        "created": created,
        "statements": describe_agreement(agreement),
        "offset_statement": describe_offsets(agreement),
        "dependence_warning": DEPENDENCE_WARNING,
        "mean_absolute_error_deg": agreement.mae_deg,
        "subjects": agreement.subjects,
        "resampling": {
            "seed": agreement.seed,
            "n_resamples": agreement.n_resamples,
            "n_flips": agreement.n_flips,
        },
        "trials": [_encode_trial(trial) for trial in agreement.trials],
        "angles": summaries,
        "tasks": {
            task: [_encode_summary(s) for s in found] for task, found in agreement.tasks.items()
        },
    }
    plain: dict[str, Any] = _plain(document)
    return plain


def _encode_trial(trial: TrialComparison) -> dict[str, Any]:
    time, facts = trial.alignment, trial.reference
    return {
        "subject": trial.subject,
        "label": trial.label,
        "task": trial.task,
        "solver": trial.solver,
        "reference": {**_fields(facts), "to_confirm": [f.what for f in facts.to_confirm]},
        "source": trial.source,
        "is_offset_removed": trial.is_offset_removed,
        "result_rate_hz": trial.result_rate_hz,
        "time_alignment": {**_fields(time), "confidence": time.confidence},
        "spatial_alignment": trial.spatial,
        "body_size_ratio": trial.body_size_ratio,
        "start_s": float(trial.pairs.time_s[0]),
        "end_s": float(trial.pairs.time_s[-1]),
        "n_frames": trial.pairs.time_s.size,
        "angles": trial.angles,
        "missing_angles": trial.missing,
        "majae": {
            "torso": trial.majae_torso,
            "measured": trial.majae,
            "without_offset": trial.majae_without_offset,
        },
        "positions": [_encode_positions(found) for found in trial.positions],
        "notes": trial.notes,
    }


def _encode_positions(found: Any) -> dict[str, Any]:
    name = "rigid" if found.alignment == "none" else found.alignment
    return {**_fields(found), "alignment": name}


def _encode_summary(summary: Any) -> dict[str, Any]:
    # Trials stand in a list of their own.
    return {name: value for name, value in _fields(summary).items() if name != "trials"}


def _fields(value: Any) -> dict[str, Any]:
    return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}


def _plain(value: Any) -> Any:
    """Turn dataclasses, arrays and mappings into what JSON has."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = _fields(value)
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value


def _to_json(document: Mapping[str, Any]) -> bytes:
    text = json.dumps(document, allow_nan=False, ensure_ascii=False, indent=1)
    # A label may hold what is no valid text; JSON has escapes for that.
    return f"{text}\n".encode("utf-8", errors="backslashreplace")
