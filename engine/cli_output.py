"""What the command line shows: progress, one-sentence errors, plain tables."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from types import FrameType
from typing import Any

from engine.cli_start import is_own_handler
from engine.datatypes import Lift, LiftEnd, Measurement, ProgressCallback, RiskResult
from engine.errors import Cancelled
from engine.storage.results import StoredResult
from engine.wording import ENGLISH

__all__ = [
    "STAGES",
    "format_columns",
    "format_index",
    "name_stage",
    "show_progress",
    "stop_on_signal",
    "summarise",
]

STAGES: Mapping[str, str] = ENGLISH.stages
CLEAN_UP_S = 3.0
"""So long further presses of Ctrl-C are ignored while the work is undone."""
CANCELLED_TEXT = "The assessment was stopped; nothing was kept."


def name_stage(stage: str) -> str:
    """Return a stage in plain words."""
    return ENGLISH.name_stage(stage)


@contextlib.contextmanager
def stop_on_signal(progress: ProgressCallback) -> Iterator[ProgressCallback]:
    """Turn Ctrl-C into `Cancelled` at the next report of progress; a second one stops at once.

    A flag rather than an exception from nowhere: native code is never interrupted half way.
    While the work is being undone, further ones are ignored; if that takes long, they end the
    process the hard way.
    """
    asked = 0
    undoing_since_s = math.inf

    def ask(number: int, _frame: FrameType | None) -> None:
        nonlocal asked, undoing_since_s
        asked += 1
        if asked == 1:
            # Not sys.stderr, which may be in the middle of a write of its own.
            os.write(2, b"\nStopping ... (press Ctrl-C again to stop at once)\n")
        elif math.isinf(undoing_since_s):
            undoing_since_s = time.monotonic()
            raise KeyboardInterrupt
        elif time.monotonic() - undoing_since_s > CLEAN_UP_S:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)

    def report(stage: str, done: int, total: int) -> None:
        nonlocal undoing_since_s
        if asked:
            undoing_since_s = time.monotonic()
            raise Cancelled(CANCELLED_TEXT)
        progress(stage, done, total)

    if threading.current_thread() is not threading.main_thread():
        yield report  # only the main thread may handle signals
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    earlier = [signal.signal(number, ask) for number in numbers]
    try:
        yield report
        if asked:
            os.write(2, b"It was already done; the result is kept.\n")
    finally:
        for number, handler in zip(numbers, earlier, strict=True):
            is_ending = math.isfinite(undoing_since_s) and is_own_handler(handler)
            signal.signal(number, signal.SIG_IGN if is_ending else handler)


@contextlib.contextmanager
def show_progress(*, is_quiet: bool) -> Iterator[ProgressCallback]:
    """Give a callback that draws a bar on stderr; plain lines where stderr is no terminal."""
    if is_quiet:
        yield lambda _stage, _done, _total: None
    elif sys.stderr.isatty():
        with _draw_bar() as report:
            yield report
    else:
        yield _make_line_report()


def _make_line_report() -> ProgressCallback:
    shown = ""

    def report(stage: str, _done: int, _total: int) -> None:
        nonlocal shown
        if (name := name_stage(stage)) != shown:
            shown = name
            sys.stderr.write(f"{name} ...\n")
            sys.stderr.flush()

    return report


@contextlib.contextmanager
def _draw_bar() -> Iterator[ProgressCallback]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name_stage("start"), total=None)
        shown = ""

        def report(stage: str, done: int, total: int) -> None:
            nonlocal shown
            if (name := name_stage(stage)) != shown:
                shown = name
                bar.reset(task, description=name, total=None)
            bar.update(task, completed=done, total=total or None)

        yield report


def summarise(stored: StoredResult) -> str:
    """Return the result as plain text: lifts, what the methods say, flags, notes."""
    methods = [f"{name}: {_describe_risk(risk)}" for name, risk in stored.risk.items()]
    flags = [_describe_flag(flag) for flag in stored.document["flags"]]
    sections = (
        ("", _list_lifts(stored.lifts, stored.risk.get("rnle"))),
        ("Methods", methods),
        ("Flags", flags),
        ("Notes", list(stored.warnings)),
    )
    parts = [
        "\n".join([title, *(f"  {line}" for line in lines)] if title else lines)
        for title, lines in sections
        if lines
    ]
    return "\n\n".join(parts)


LIFT_COLUMNS = (
    "Lift",
    "Time (s)",
    "End",
    "H (cm)",
    "V (cm)",
    "A (deg)",
    "D (cm)",
    "RWL (kg)",
    "LI",
)


def _list_lifts(lifts: Sequence[Lift], rnle: RiskResult | None) -> list[str]:
    if not lifts:
        return ["No lift was found."]
    risks = {} if rnle is None else {part.lift_index: part for part in rnle.per_lift}
    rows = [row for n, lift in enumerate(lifts) for row in _lift_rows(n, lift, risks.get(n))]
    note = "± is one standard error; LI: lifting index with its interval of about 95 %."
    return [*format_columns(LIFT_COLUMNS, rows), note]


def _lift_rows(index: int, lift: Lift, risk: RiskResult | None) -> list[tuple[str, ...]]:
    times = f"{lift.start_s:.2f}-{lift.end_s:.2f}"
    return [
        (
            str(index + 1),
            times,
            "origin",
            *_describe_end(lift.origin),
            _with_sigma(lift.D_cm),
            _end_rwl(risk, "origin"),
            "-" if risk is None else format_index(risk.value, risk.interval),
        ),
        (
            "",
            "",
            "set-down",
            *_describe_end(lift.destination),
            "",
            _end_rwl(risk, "destination"),
            "",
        ),
    ]


def _describe_end(end: LiftEnd) -> tuple[str, str, str]:
    return _with_sigma(end.H_cm), _with_sigma(end.V_cm), _with_sigma(end.A_deg)


def _with_sigma(measurement: Measurement) -> str:
    if measurement.is_missing:
        return "-"
    sigma = "?" if math.isnan(measurement.sigma) else f"{measurement.sigma:.0f}"
    return f"{measurement.value:.0f} ± {sigma}"


def _end_rwl(risk: RiskResult | None, end: str) -> str:
    details: Any = {} if risk is None else risk.details.get(end)
    value = details.get("RWL_kg") if isinstance(details, Mapping) else None
    return "-" if value is None else f"{value:.1f}"


def format_index(value: float | None, interval: Sequence[float | None]) -> str:
    """Return an index with its interval, `-` where there is none."""
    if value is None or math.isnan(value):
        return "-"
    low, high = (math.nan if end is None else end for end in interval)
    if math.isnan(low) or math.isnan(high):
        return _number(value)
    return f"{_number(value)} ({_number(low)} to {_number(high)})"


def _number(value: float) -> str:
    return "infinite" if math.isinf(value) else f"{value:.2f}"


def _describe_risk(risk: RiskResult) -> str:
    index = format_index(risk.value, risk.interval)
    words = [risk.category] if index == "-" else [index, risk.category]
    reasons = f" ({'; '.join(risk.reasons)})" if risk.reasons and not risk.is_applicable else ""
    return ", ".join(word for word in words if word) + reasons


def _describe_flag(flag: Mapping[str, Any]) -> str:
    return f"{flag['level'].upper()}: {flag['what']} - {flag['why']}"


def format_columns(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return lines with aligned columns, never cut or wrapped."""
    table = [tuple(titles), *map(tuple, rows)]
    widths = [max(len(row[column]) for row in table) for column in range(len(titles))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table
    ]
