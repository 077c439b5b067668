"""What `liftlens compare` does."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.compare_form import read_performance
from engine.datatypes import Measurement
from engine.errors import ConfigError
from engine.form import Comparison, PhaseDifference, Repetition, advise, find_repetitions
from engine.form.compare import compare_every_repetition
from engine.form.performance import Performance
from engine.form.repetitions import Kind
from engine.storage.atomic import explain_os_errors, write_aside
from engine.storage.results import is_result_folder, read_result
from engine.version import __version__

__all__ = ["CompareRequest", "encode_comparison", "run_compare"]

Say = Callable[[str], None]
JSON_NAME, TABLE_NAME, CURVES_NAME = "comparison.json", "differences.csv", "curves.csv"
PLUS_MINUS = "\N{PLUS-MINUS SIGN}"


@dataclass(frozen=True)
class CompareRequest:
    """The options of the command: two result folders, and which repetitions (from 1).

    With `attempt_repetition` None every repetition of the attempt is scored, and the first
    one is described.
    """

    reference: Path
    attempt: Path
    out: Path | None = None
    reference_repetition: int = 1
    attempt_repetition: int | None = None
    is_quiet: bool = False

    def __post_init__(self) -> None:
        for name, value in (
            ("--reference-repetition", self.reference_repetition),
            ("--attempt-repetition", self.attempt_repetition),
        ):
            if value is not None and value < 1:
                raise ConfigError(f"{name} counts from 1, got {value}.")
        for folder in (self.reference, self.attempt):
            if not is_result_folder(folder):
                raise ConfigError(
                    f"Expected a result folder of `liftlens assess`, but {folder} holds no result."
                )
        self._check_out()

    def _check_out(self) -> None:
        out = self.out
        if out is None:
            return
        if out.is_file():
            raise ConfigError(f"The comparison needs a folder, but {out} is a file.")
        if out.is_dir() and any(out.iterdir()) and not (out / JSON_NAME).is_file():
            raise ConfigError(
                f"The comparison needs a new or empty folder or one with an earlier comparison, "
                f"but {out} holds other files; choose another folder."
            )


def run_compare(request: CompareRequest, *, say: Say, warn: Say) -> None:
    """Compare, print, and write where asked; `warn` gets what is in doubt.

    Raises
    ------
    DataError
        If a result is damaged, or has no such repetition.
    AssessmentError
        If the movements can't be compared.
    OutputError
        If the comparison can't be written.
    """
    reference, attempt = (
        read_performance(read_result(folder)) for folder in (request.reference, request.attempt)
    )
    found = compare_every_repetition(
        reference, attempt, reference_repetition=request.reference_repetition - 1
    )
    shown = _choose(found, request.attempt_repetition, attempt)
    if not request.is_quiet:
        for note in shown.notes:
            warn(f"Note: {note}")
    for line in _summarise(shown, found):
        say(line)
    if request.out is not None:
        _write(request.out, shown, found, reference, attempt)
        say(f"\nWritten: {request.out}")


def _choose(found: Sequence[Comparison], wanted: int | None, attempt: Performance) -> Comparison:
    if wanted is None:
        return found[0]
    if wanted > len(found):
        raise ConfigError(
            f"{attempt.label} has {len(found)} repetition(s); expected --attempt-repetition from "
            f"1 to {len(found)}, got {wanted}."
        )
    return found[wanted - 1]


# --------------------------------------------------------------------------- text


def _summarise(shown: Comparison, found: Sequence[Comparison]) -> Iterator[str]:
    low, high = shown.score.interval
    yield f"{shown.attempt} against {shown.reference}"
    yield (
        f"Score {shown.score.value:.0f} of 100 ({low:.0f} to {high:.0f}); 100 = the same within "
        "the measurement error"
    )
    yield ""
    yield from advise(shown)
    yield ""
    yield from _list_differences(shown)
    yield ""
    yield from _list_timings(shown)
    if len(found) > 1:
        yield ""
        yield from _list_repetitions(found)


def _list_differences(shown: Comparison) -> Iterator[str]:
    phases = [p.key for p in shown.phases]
    yield (
        f"Mean difference, attempt minus reference, deg ({PLUS_MINUS} 95 %; * = beyond the error)"
    )
    yield f"{'':26}" + "".join(f"{p.replace('_', '-'):>13}" for p in phases)
    by_key = {(d.angle, d.phase): d for d in shown.differences}
    for name in shown.names:
        cells = "".join(f"{_cell(by_key[name, phase]):>13}" for phase in phases)
        yield f"{name:26}{cells}"


def _cell(difference: PhaseDifference) -> str:
    mark = "*" if difference.is_beyond_error else " "
    half = 1.96 * difference.mean.sigma
    return f"{difference.mean.value:+.0f} {PLUS_MINUS}{half:.0f}{mark}"


def _list_timings(shown: Comparison) -> Iterator[str]:
    yield "Time, s            reference      attempt   difference"
    for t in shown.timings:
        mark = "*" if t.is_beyond_error else " "
        error = 1.96 * t.difference_s.sigma
        sure = "" if math.isnan(error) else f" {PLUS_MINUS}{error:.2f}{mark}"
        yield (
            f"{t.phase:16}{t.reference_s.value:12.2f}{t.attempt_s.value:13.2f}"
            f"{t.difference_s.value:+13.2f}{sure}"
        )


def _list_repetitions(found: Sequence[Comparison]) -> Iterator[str]:
    yield "Repetition   starts   lasts   score (95 %)"
    for one in found:
        low, high = one.score.interval
        start, end = one.attempt_time_s[0], one.attempt_time_s[-1]
        yield (
            f"{one.attempt_repetition + 1:10d}{start:7.1f} s{end - start:6.1f} s"
            f"{one.score.value:8.0f} ({low:.0f} to {high:.0f})"
        )


# --------------------------------------------------------------------------- files


def encode_comparison(
    shown: Comparison,
    found: Sequence[Comparison],
    reference: Sequence[Repetition],
    attempt: Sequence[Repetition],
) -> dict[str, Any]:
    """Return a comparison as plain values; what is missing is None."""
    return {
        "liftlens": __version__,
        "reference": shown.reference,
        "attempt": shown.attempt,
        "reference_repetition": shown.reference_repetition + 1,
        "attempt_repetition": shown.attempt_repetition + 1,
        "score": _score(shown),
        "likeness": _number(shown.likeness),
        "advice": list(advise(shown)),
        "notes": list(shown.notes),
        "differences_deg": [
            {
                "phase": d.phase,
                "angle": d.angle,
                "mean": _measured(d.mean),
                "peak": _measured(d.peak),
                "is_beyond_error": d.is_beyond_error,
            }
            for d in shown.differences
        ],
        "timings_s": [
            {
                "phase": t.phase,
                "reference": _measured(t.reference_s),
                "attempt": _measured(t.attempt_s),
                "difference": _measured(t.difference_s),
                "is_beyond_error": t.is_beyond_error,
            }
            for t in shown.timings
        ],
        "repetitions": [{"number": c.attempt_repetition + 1, "score": _score(c)} for c in found],
        "reference_movements": [_repetition(r) for r in reference],
        "attempt_movements": [_repetition(r) for r in attempt],
    }


def _score(one: Comparison) -> dict[str, float | None]:
    low, high = one.score.interval
    return {
        "value": _number(one.score.value),
        "low": _number(low),
        "high": _number(high),
        "difference_deg": _number(one.score.difference_deg),
        "error_deg": _number(one.score.error_deg),
    }


def _repetition(one: Repetition) -> dict[str, Any]:
    return {
        "number": one.number + 1,
        "kind": one.kind,
        "start_s": _number(one.start_s),
        "end_s": _number(one.end_s),
        "phases": [
            {"phase": p.key, "start_s": _number(p.start_s), "end_s": _number(p.end_s)}
            for p in one.phases
        ],
        "range_of_motion_deg": {k: _measured(v) for k, v in one.range_of_motion_deg.items()},
        "asymmetry_deg": {k: _measured(v) for k, v in one.asymmetry_deg.items()},
    }


def _measured(value: Measurement) -> dict[str, float | None]:
    return {"value": _number(value.value), "sigma": _number(value.sigma)}


def _number(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None


def _write(
    out: Path,
    shown: Comparison,
    found: Sequence[Comparison],
    reference: Performance,
    attempt: Performance,
) -> None:
    from engine.form.figures import plot_comparison  # Matplotlib only where it draws

    kind: Kind = "lift" if shown.phases[0].key == "reach" else "exercise"
    movements = [find_repetitions(p, kind) for p in (reference, attempt)]
    document = encode_comparison(shown, found, *movements)
    files = {
        JSON_NAME: (json.dumps(document, indent=2, ensure_ascii=False) + "\n").encode(),
        TABLE_NAME: _table(shown).encode(),
        CURVES_NAME: _curves(shown).encode(),
        "curves.png": plot_comparison(shown),
    }
    with explain_os_errors(out, "The comparison"):
        out.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            with write_aside(out / name) as aside:
                aside.write_bytes(content)


def _table(shown: Comparison) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    head = ("phase", "angle", "reference_deg", "attempt_deg", "difference_deg", "sigma_deg")
    writer.writerow((*head, "peak_difference_deg", "peak_sigma_deg", "is_beyond_error"))
    for d in shown.differences:
        numbers = (d.reference_deg, d.attempt_deg, d.mean.value, d.mean.sigma)
        peaks = (d.peak.value, d.peak.sigma)
        cells = (f"{x:.2f}" for x in (*numbers, *peaks))
        writer.writerow((d.phase, d.angle, *cells, str(d.is_beyond_error).lower()))
    return buffer.getvalue()


def _curves(shown: Comparison) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    kinds = ("reference", "attempt", "reference_sigma", "attempt_sigma", "difference_sigma")
    head = [f"{name}_{kind}_deg" for name in shown.names for kind in kinds]
    writer.writerow(("percent", "reference_time_s", "attempt_time_s", *head))
    blocks = (
        shown.reference_deg,
        shown.attempt_deg,
        shown.reference_sigma_deg,
        shown.attempt_sigma_deg,
        shown.difference_sigma_deg,
    )
    for k, percent in enumerate(shown.percent):
        times = (shown.reference_time_s[k], shown.attempt_time_s[k])
        values = [block[k, i] for i in range(len(shown.names)) for block in blocks]
        writer.writerow((f"{percent:g}", *(f"{x:.3f}" for x in (*times, *values))))
    return buffer.getvalue()
