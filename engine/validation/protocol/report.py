"""Everything a study leaves behind, as named files in memory: tables, figures, JSON and one page.

The caller writes them. What is said in words is said here once, for page, PDF and dashboard.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from engine.validation.agreement import AngleSummary
from engine.validation.protocol.figures import FIGURE_WORDS
from engine.validation.protocol.folds import FOLD_WORDS
from engine.validation.protocol.statistics import (
    MethodComparison,
    Study,
    summarise_differences,
    summarise_distances,
)
from engine.validation.protocol.tables import (
    PAPER_NOTE,
    PrintedTable,
    build_study_tables,
    format_number,
    format_p,
    print_comparisons,
    print_methods,
    print_table1,
    print_table2,
    print_table3,
    print_tests,
)
from engine.validation.statistics import DEPENDENCE_WARNING
from engine.validation.summary import STYLE
from engine.validation.tables import Table, format_csv

__all__ = [
    "FIGURE_ORDER",
    "REPORT_NAME",
    "STUDY_NAME",
    "StudyReport",
    "build_report",
    "describe_study",
    "render_study",
]

STUDY_NAME = "study.json"
REPORT_NAME = "report.html"
SCHEMA_VERSION = 1
"""Raised whenever a key of `study.json` changes its name, type or meaning."""
FIGURE_ORDER = ("figure2", "figure3", "figure4", "figure5", "limits", "equivalence", "methods")
PRINTED_TABLES = ("table1", "table2", "table3")
SYNTHETIC_NOTE = (
    "The data are computer-generated: nobody was filmed, and the figures do not replace a "
    "validation on people."
)


@dataclass(frozen=True, eq=False)
class StudyReport:
    """What page, PDF and dashboard show: words, printed tables, figures.

    Parameters
    ----------
    title, made, created
        What it is, by which version and when, and the time alone (ISO, UTC; may be empty).
    lead
        The outcome in sentences, most important first.
    tables
        By name: table1 to table3, agreement, methods and, where there are several, comparisons.
    figures
        PNG by name.
    notes
        How it was done, and what makes it less certain.
    """

    title: str
    made: str
    lead: tuple[str, ...]
    tables: Mapping[str, PrintedTable]
    figures: Mapping[str, bytes]
    notes: tuple[str, ...]
    created: str = ""


def build_report(
    study: Study,
    rows: Mapping[str, Sequence[AngleSummary]],
    comparisons: Sequence[MethodComparison],
    figures: Mapping[str, bytes],
    *,
    version: str = "",
    created: str = "",
) -> StudyReport:
    """Gather what is shown of a study; `rows` are the tests of the 13 angles by method."""
    main = study.main
    tables = {
        "table1": print_table1(study, main),
        "table2": print_table2(study, main),
        "table3": print_table3(study, main, rows[main.name]),
        "agreement": print_tests(study, main, rows[main.name]),
        "methods": print_methods(study),
    }
    if comparisons:
        tables["comparisons"] = print_comparisons(study, comparisons)
    return StudyReport(
        title=f"Validation study: {study.title}",
        made=" · ".join(part for part in (f"LiftLens {version}".strip(), created) if part),
        lead=describe_study(study, rows[main.name], comparisons),
        tables=tables,
        figures={name: figures[name] for name in FIGURE_ORDER if name in figures},
        notes=_list_notes(study),
        created=created,
    )


def render_study(
    study: Study,
    rows: Mapping[str, Sequence[AngleSummary]],
    comparisons: Sequence[MethodComparison],
    report: StudyReport,
    *,
    version: str = "",
    created: str = "",
) -> dict[str, bytes]:
    """Return every file of a study but its PDF and its predictions; path to content."""
    tables = build_study_tables(study, rows, comparisons)
    files = {f"tables/{table.name}.csv": format_csv(table) for table in tables}
    for name, printed in report.tables.items():
        files[f"tables/{name}.html"] = _page(printed.title, table_html(printed)).encode()
    files |= {f"figures/{name}.png": content for name, content in report.figures.items()}
    files[REPORT_NAME] = _render_page(report).encode()
    document = _build_document(study, report, tables, version=version, created=created)
    text = json.dumps(document, allow_nan=False, ensure_ascii=False, indent=1)
    files[STUDY_NAME] = f"{text}\n".encode("utf-8", errors="backslashreplace")
    return files


# --------------------------------------------------------------------------- in words


def describe_study(
    study: Study, rows: Sequence[AngleSummary], comparisons: Sequence[MethodComparison]
) -> tuple[str, ...]:
    """Say what was found: never more than the numbers, and the worse methods as well."""
    return tuple(
        sentence
        for sentence in (
            _say_main(study),
            _say_equivalence(rows),
            _say_best(study),
            *_say_constraint(comparisons),
            *(f"{features}: {leak.sentence}" for features, leak in study.leaks.items()),
            SYNTHETIC_NOTE if study.is_synthetic else "",
        )
        if sentence
    )


def _say_main(study: Study) -> str:
    method = study.main
    s, angle = summarise_distances(method.trials), summarise_differences(method.trials)
    persons = f"{len(method.subjects)} persons" if len(method.subjects) > 1 else "one person"
    return (
        f"{method.name}: markers {format_number(s.mean_mm)} ± {format_number(s.sd_mm)} mm from "
        f"where they were measured; joint angles off by {format_number(angle.mae_deg)} ± "
        f"{format_number(angle.sd_absolute_deg)}° (absolute), {format_number(angle.mean_deg)} ± "
        f"{format_number(angle.sd_deg)}° (signed). {s.n_frames} frames of {s.n_trials} trials of "
        f"{persons}; {FOLD_WORDS[study.kind]}."
    )


def _say_equivalence(rows: Sequence[AngleSummary]) -> str:
    if not rows:
        return ""
    shown = {
        test.margin: sum(s.equivalence[i].is_equivalent for s in rows)
        for i, test in enumerate(rows[0].equivalence)
    }
    words = ", ".join(f"{n} within ±{margin:g}°" for margin, n in shown.items())
    scope = (
        "" if rows[0].unit == "subject" else " The trials are of one person, so for that one only."
    )
    return f"Of {len(rows)} angles the mean difference was shown to lie: {words}.{scope}"


def _say_best(study: Study) -> str:
    if len(study.methods) < 2:
        return ""
    means = {m.name: summarise_distances(m.trials).mean_mm for m in study.methods}
    known = {name: mean for name, mean in means.items() if math.isfinite(mean)}
    if not known:
        return ""
    best, worst = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
    return (
        f"Smallest marker error of {len(known)} methods: {best} with "
        f"{format_number(known[best])} mm; largest: {worst} with {format_number(known[worst])} mm. "
        "Found after the fact, so the smallest is a little flattered."
    )


def _say_constraint(comparisons: Sequence[MethodComparison]) -> Iterable[str]:
    """Say whether holding the upper-limb lengths helped, wherever both were run."""
    for c in comparisons:
        features, _, first = c.first.rpartition("/")
        other, _, second = c.second.rpartition("/")
        if features == other and (first, second) == ("tgp", "tgp-constrained"):
            low, high = (format_number(end, signed=True) for end in c.test.interval)
            helped = "helped" if c.test.mean < 0 else "did not help"
            if not c.p_holm < 0.05:
                helped = "was not shown to change anything"
            yield (
                f"{features}: holding the upper-limb lengths {helped}: marker error "
                f"{format_number(c.test.mean, signed=True)} mm (95 % interval {low} to {high} mm, "
                f"p {format_p(c.p_holm)})."
            )


def _list_notes(study: Study) -> tuple[str, ...]:
    lines = [
        f"Folds: {FOLD_WORDS[study.kind]}.",
        (
            "Markers: low-pass filtered (Butterworth, 4th order, 8 Hz, without delay) and brought "
            "to the times of the pictures by cubic splines. No alignment: laboratory axes."
        ),
        (
            "Reference angles: inverse kinematics of the measured markers; the same scaled body "
            "and the same weights for measured and estimated markers."
        ),
        DEPENDENCE_WARNING,
        PAPER_NOTE,
    ]
    settings = ", ".join(f"{key} {value}" for key, value in study.settings.items())
    return (*lines, *study.notes, f"Settings: {settings}.")


# --------------------------------------------------------------------------- the page


def _render_page(report: StudyReport) -> str:
    lead, *others = report.lead
    body = (
        f"<h1>{escape(report.title)}</h1><p class='quiet'>{escape(report.made)}</p>"
        f"<p class='lead'>{escape(lead)}</p>{_list(others)}"
        + "".join(table_html(report.tables[name], is_titled=True) for name in PRINTED_TABLES)
        + _figures(report, FIGURE_ORDER[:4])
        + "".join(
            table_html(table, is_titled=True)
            for name, table in report.tables.items()
            if name not in PRINTED_TABLES
        )
        + _figures(report, FIGURE_ORDER[4:])
        + f"<h2>How it was done</h2>{_list(report.notes)}"
        "<p class='quiet'>Every figure as data: tables/ and study.json beside this file.</p>"
    )
    return _page(report.title, body)


def _page(title: str, body: str) -> str:
    return (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width'>"
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>"
        f"<body>{body}</body></html>\n"
    )


def table_html(table: PrintedTable, *, is_titled: bool = True) -> str:
    """Return a printed table as HTML."""
    titles = "".join(f"<th{_right(i)}>{escape(t)}</th>" for i, t in enumerate(table.head))
    body = "".join(
        f"<tr>{''.join(f'<td{_right(i)}>{escape(cell)}</td>' for i, cell in enumerate(row))}</tr>"
        for row in table.rows
    )
    title = f"<h2>{escape(table.title)}</h2>" if is_titled else ""
    notes = "".join(f"<p class='quiet'>{escape(note)}</p>" for note in table.notes)
    return (
        f"{title}<div class='scroll'><table><thead><tr>{titles}</tr></thead>"
        f"<tbody>{body}</tbody></table></div>{notes}"
    )


def _right(column: int) -> str:
    return " class='n'" if column else ""


def _figures(report: StudyReport, names: Iterable[str]) -> str:
    return "".join(
        f"<h2>{escape(FIGURE_WORDS[name])}</h2><figure><img alt='{escape(FIGURE_WORDS[name])}' "
        f"src='data:image/png;base64,{base64.b64encode(report.figures[name]).decode()}'></figure>"
        for name in names
        if name in report.figures
    )


def _list(sentences: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(s)}</li>' for s in sentences)}</ul>"


# --------------------------------------------------------------------------- study.json


def _build_document(
    study: Study,
    report: StudyReport,
    tables: Sequence[Table],
    *,
    version: str,
    created: str,
) -> dict[str, Any]:
    """Return the content of `study.json`; NaN is None."""
    kept = {table.name: table for table in tables}
    return {
        "schema_version": SCHEMA_VERSION,
        "liftlens_version": version,
        "created": created,
        "title": study.title,
        "folds": study.kind,
        "is_synthetic": study.is_synthetic,
        "main_method": study.main.name,
        "statements": list(report.lead),
        "notes": list(report.notes),
        "settings": _plain(study.settings),
        "leaks": {
            name: {**{k: _plain(v) for k, v in vars(leak).items()}, "sentence": leak.sentence}
            for name, leak in study.leaks.items()
        },
        "methods": _records(kept["methods"]),
        "comparisons": _records(kept["comparisons"]),
        "table3": _records(kept["table3"]),
        "hyperparameters": {method.name: _plain(method.settings) for method in study.methods},
        "tables": {name: _plain(vars(printed)) for name, printed in report.tables.items()},
        "figures": {name: FIGURE_WORDS[name] for name in report.figures},
        "subjects": list(study.main.subjects),
        "tasks": list(study.main.tasks),
        "angles": list(study.main.trials[0].trial.angle_names),
    }


def _records(table: Table) -> list[dict[str, Any]]:
    return [dict(zip(table.columns, _plain(row), strict=True)) for row in table.rows]


def _plain(value: Any) -> Any:
    """Turn tuples, mappings and numbers into what JSON has."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
