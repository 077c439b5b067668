"""What `liftlens protocol` does."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

from engine.datatypes import ProgressCallback
from engine.errors import Cancelled, ConfigError
from engine.pose.twin_gp import FEATURES, REGRESSORS
from engine.protocol import ProtocolRequest, run_protocol
from engine.protocol_features import Observe
from engine.validation.protocol.dataset import parse_views
from engine.validation.protocol.folds import parse_fold_kind
from engine.validation.protocol.report import REPORT_NAME, STUDY_NAME

__all__ = ["build_request", "run_study"]

Say = Callable[[str], None]
ALL = "all"


def build_request(
    dataset: Path,
    out: Path,
    *,
    estimator: str,
    features: str,
    folds: str,
    persons: str | None,
    views: str,
    **others: Any,
) -> ProtocolRequest:
    """Turn the command's options into a request; `others` are taken as they are.

    Raises
    ------
    ConfigError
        If one of them is unknown or makes no sense.
    """
    return ProtocolRequest(
        dataset=dataset,
        out=out,
        estimators=_split(estimator, tuple(REGRESSORS)),
        features=_split(features, tuple(FEATURES)),
        folds=parse_fold_kind(folds),
        persons=_split(persons or "", ()),
        views=parse_views(views),
        **others,
    )


def _split(text: str, known: Sequence[str]) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    return tuple(known) if names == (ALL,) and known else names


def run_study(
    request: ProtocolRequest, *, observe: Observe, progress: ProgressCallback, say: Say
) -> None:
    """Run the protocol and say what was found.

    Raises
    ------
    Cancelled
        If it was stopped; the sentence says that finished folds are kept.
    """
    try:
        folder = run_protocol(request, observe=observe, progress=progress)
    except Cancelled as error:
        raise Cancelled(
            f"The study was stopped; its finished folds are kept in {request.out}. Run the same "
            "command again to go on."
        ) from error
    for line in summarise_study(folder):
        say(line)
    say(f"\nWritten: {folder} (open {REPORT_NAME})")


def summarise_study(folder: Path) -> list[str]:
    """Return what a finished study found, and the table of its methods.

    Raises
    ------
    ConfigError
        If there is no finished study in the folder.
    """
    from engine.cli_output import format_columns

    path = folder / STUDY_NAME
    if not path.is_file():
        raise ConfigError(f"{folder} holds no finished study; run `liftlens protocol` to the end.")
    study = json.loads(path.read_text(encoding="utf-8"))
    methods = study["tables"]["methods"]
    rows = cast("list[list[str]]", methods["rows"])
    return [*study["statements"], "", *format_columns(methods["head"], rows)]
