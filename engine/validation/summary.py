"""The one-page summary of a comparison: a single HTML file that prints well."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping
from html import escape

from engine.validation.agreement import AngleSummary
from engine.validation.compare import TrialComparison
from engine.validation.pooled import Agreement, describe_agreement, describe_offsets
from engine.validation.wording import title_angle

__all__ = ["render_summary"]

MAX_SENTENCES = 5
SOURCES = {
    "computed": "angles computed from the markers' joint centres, as the video's were",
    "recorded": "angles as recorded, signs converted",
}
STYLE = """
:root { color-scheme: light; }
body { font: 13px/1.45 system-ui, sans-serif; color: #16212c; margin: 24px auto; max-width: 960px;
  padding: 0 16px; }
h1 { font-size: 21px; margin: 0 0 2px; } h2 { font-size: 15px; margin: 18px 0 6px; }
.quiet { color: #526170; } ul { margin: 6px 0; padding-left: 18px; }
.lead { font-size: 16px; font-weight: 600; margin: 10px 0 4px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th { text-align: left; color: #526170; font-weight: 600; }
th, td { padding: 3px 8px 3px 0; border-bottom: 1px solid #d6dee6; }
td.n, th.n { text-align: right; } .scroll { overflow-x: auto; }
img { max-width: 100%; height: auto; } figure { margin: 0; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(320px, 1fr)); gap: 12px; }
@media print { body { margin: 0; font-size: 10px; } h2 { break-after: avoid; }
  figure, tr { break-inside: avoid; } }
"""


def render_summary(
    agreement: Agreement, figures: Mapping[str, bytes], *, version: str = "", created: str = ""
) -> str:
    """Return the summary as HTML with its figures inside.

    Parameters
    ----------
    agreement
        What was found.
    figures
        From `engine.validation.figures.draw_figures`.
    version, created
        Of the program, and when.
    """
    lead, *others = describe_agreement(agreement)
    made = " · ".join(part for part in (f"LiftLens {version}".strip(), created) if part)
    body = (
        f"<h1>Comparison with a reference</h1><p class='quiet'>{escape(made)}</p>"
        f"<p class='lead'>{escape(lead)}</p>{_list(others[:MAX_SENTENCES])}"
        f"<p class='quiet'>{escape(describe_offsets(agreement))}</p>"
        f"<h2>Angle by angle</h2>{_angle_table(agreement)}"
        f"<div class='pair'>{_figure(figures, 'errors', 'Errors of every angle')}"
        f"{_figure(figures, 'boxes', 'Differences of all frames')}</div>"
        f"<h2>Curves</h2>{_figure(figures, 'curves_01', 'Both curves, and their difference')}"
        f"<h2>How it was compared</h2>{_trial_table(agreement.trials)}"
        f"{_list(dict.fromkeys(note for t in agreement.trials for note in _doubts(t)))}"
        "<p class='quiet'>Differences are the video's angle minus the reference's. SD: standard "
        "deviation. Limits of agreement hold about 95 % of the frames of a trial like these. "
        "Every figure, with the tests: tables/ and agreement.json beside this file.</p>"
    )
    return (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width'>"
        f"<title>Comparison with a reference</title><style>{STYLE}</style></head>"
        f"<body>{body}</body></html>\n"
    )


def _list(sentences: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(s)}</li>" for s in sentences)
    return f"<ul>{items}</ul>" if items else ""


def _figure(figures: Mapping[str, bytes], name: str, words: str) -> str:
    if name not in figures:
        return ""
    content = base64.b64encode(figures[name]).decode()
    return f"<figure><img alt='{escape(words)}' src='data:image/png;base64,{content}'></figure>"


def _angle_table(agreement: Agreement) -> str:
    head = ("Angle", "Mean difference", "Mean absolute", "RMSE", "RMSE without offset",
            "Limits of agreement", "95 % within")  # fmt: skip
    rows = [_angle_cells(s) for s in agreement.angles if s.pooled.n_samples]
    return _table(head, rows)


def _angle_cells(s: AngleSummary) -> tuple[str, ...]:
    p, limits = s.pooled, s.bland_altman
    return (
        title_angle(s.name),
        f"{_number(p.bias_deg, signed=True)}°",
        f"{_number(p.mae_deg)}°",
        f"{_number(p.rmse_deg)}°",
        f"{_number(p.centred_rmse_deg)}°",
        f"{_number(limits.lower, signed=True)} to {_number(limits.upper, signed=True)}°",
        f"{_number(p.p95_deg)}°",
    )


def _trial_table(trials: Iterable[TrialComparison]) -> str:
    head = ("Trial", "Person", "Reference", "Compared", "Rates", "Shift in time", "Correlation",
            "Joint distance")  # fmt: skip
    return _table(head, [_trial_cells(t) for t in trials])


def _trial_cells(t: TrialComparison) -> tuple[str, ...]:
    time = t.alignment
    distance = t.positions[0].mpjpe_mm if t.positions else math.nan
    return (
        t.label,
        t.subject,
        t.reference.name,
        SOURCES[t.source],
        f"{t.result_rate_hz:.4g} and {t.reference.rate_hz:.4g} Hz",
        f"{_number(time.lag_s, 3, signed=True)} ± {_number(time.lag_sigma_s, 3)} s",
        f"{_number(time.correlation, 3)} (confidence {_number(time.confidence, 2)})",
        "none" if math.isnan(distance) else f"{distance:.0f} mm after one rigid move",
    )


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    titles = "".join(f"<th{_right(i)}>{escape(title)}</th>" for i, title in enumerate(head))
    body = "".join(
        f"<tr>{''.join(f'<td{_right(i)}>{escape(c)}</td>' for i, c in enumerate(row))}</tr>"
        for row in rows
    )
    return (
        f"<div class='scroll'><table><thead><tr>{titles}</tr></thead>"
        f"<tbody>{body}</tbody></table></div>"
    )


def _right(column: int) -> str:
    return " class='n'" if column else ""


def _doubts(t: TrialComparison) -> list[str]:
    """Return what makes a comparison less certain, in sentences."""
    unsure = [
        f"Not confirmed: {f.what} = {f.value} ({f.why}). Set it in an import profile."
        for f in t.reference.to_confirm
    ]
    return [*unsure, *t.reference.notes, *t.notes]


def _number(value: float, digits: int = 1, *, signed: bool = False) -> str:
    if math.isnan(value):
        return "–"
    text = f"{value:{'+' if signed else ''}.{digits}f}"
    return text.replace("-", "−")
