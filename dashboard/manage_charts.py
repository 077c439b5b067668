"""Figures of lifts by level. No Streamlit here."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import date

import plotly.graph_objects as go

from dashboard.labels import LEVELS, NOT_JUDGED, count
from engine.datatypes import FlagLevel
from engine.storage.overview import LiftCounts, MonthOverview

__all__ = ["plot_shares", "plot_trend"]

ROW_PX, FRAME_PX, TREND_PX = 44, 104, 350
MOST_TICKS = 14
LEAST_LABELLED = 0.07
"""A part of a bar this small has no room for its number."""
FILLS: tuple[tuple[FlagLevel | None, str, str, str], ...] = (
    (FlagLevel.HIGH, "#b3350a", "#ff8f66", ""),
    (FlagLevel.REVIEW, "#b57a10", "#f2bd4b", "/"),
    (FlagLevel.OK, "#00704f", "#45cf9f", "."),
    (None, "#8794a1", "#6d7d8b", "x"),
)
"""Level, colour by day and by night, pattern: parts are told apart by pattern and place too."""


def plot_shares(rows: Sequence[tuple[str, LiftCounts]], *, dark: bool = False) -> go.Figure:
    """Plot the share of lifts at each level, one bar a row.

    Parameters
    ----------
    rows
        Names and counts, the first on top.
    dark
        Whether the page is dark.
    """
    figure = go.Figure()
    names = [f"{_shorten(name)} " for name, _ in rows]
    for word, color, pattern, numbers in _parts([lifts for _, lifts in rows], dark=dark):
        shares = _shares(numbers, [lifts for _, lifts in rows])
        figure.add_bar(
            y=names,
            x=shares,
            orientation="h",
            name=word,
            marker=_marker(color, pattern, dark=dark),
            text=[_number(n, share) for n, share in zip(numbers, shares, strict=True)],
            customdata=[count(n, "lift") for n in numbers],
            hovertemplate="%{y}: %{x:.0%}, %{customdata}<extra>" + word + "</extra>",
        )
    _lay_out(figure, height=FRAME_PX + ROW_PX * len(rows), dark=dark)
    figure.update_xaxes(range=[0, 1], tickformat=".0%", title="Share of the lifts")
    figure.update_yaxes(autorange="reversed", automargin=True, type="category")
    return figure


def plot_trend(months: Sequence[MonthOverview], *, dark: bool = False) -> go.Figure:
    """Plot the share of lifts at each level, one bar a month; months without any stay empty."""
    filled = list(_fill_months(months))
    counts = [lifts for _, lifts in filled]
    names = [f"{day:%b %Y}" for day, _ in filled]
    figure = go.Figure()
    for word, color, pattern, numbers in _parts(counts, dark=dark):
        shares = _shares(numbers, counts)
        figure.add_bar(
            x=names,
            y=shares,
            name=word,
            marker=_marker(color, pattern, dark=dark),
            text=[_number(n, share) for n, share in zip(numbers, shares, strict=True)],
            customdata=[count(n, "lift") for n in numbers],
            hovertemplate="%{y:.0%}, %{customdata}<extra>" + word + "</extra>",
        )
    _lay_out(figure, height=TREND_PX, dark=dark)
    figure.update_yaxes(range=[0, 1], tickformat=".0%", title="Share of the lifts")
    step = -(-len(filled) // MOST_TICKS)
    figure.update_xaxes(
        type="category",
        tickvals=names[::step],
        ticktext=[_month(day, lifts, i) for i, (day, lifts) in enumerate(filled)][::step],
        tickangle=0,
        title="Month, with its number of lifts",
    )
    return figure


def _month(day: date, lifts: LiftCounts, number: int) -> str:
    """Return a month with its number of lifts; the first one and each January with the year."""
    year = f"<br>{day:%Y}" if not number or day.month == 1 else ""
    return f"{day:%b}<br>{lifts.n_lifts or '–'}{year}"


def _parts(
    counts: Sequence[LiftCounts], *, dark: bool
) -> Iterator[tuple[str, str, str, list[int]]]:
    """Yield word, colour, pattern and the number of lifts in every bar, level by level."""
    for level, light, night, pattern in FILLS:
        word = NOT_JUDGED.word if level is None else LEVELS[level].word
        numbers = [_lifts_at(lifts, level) for lifts in counts]
        if any(numbers):
            yield word, night if dark else light, pattern, numbers


def _lifts_at(lifts: LiftCounts, level: FlagLevel | None) -> int:
    return {
        FlagLevel.HIGH: lifts.n_high,
        FlagLevel.REVIEW: lifts.n_review,
        FlagLevel.OK: lifts.n_ok,
        None: lifts.n_unjudged,
    }[level]


def _shares(numbers: Sequence[int], counts: Sequence[LiftCounts]) -> list[float]:
    return [
        n / lifts.n_lifts if lifts.n_lifts else 0.0
        for n, lifts in zip(numbers, counts, strict=True)
    ]


def _number(number: int, share: float) -> str:
    return str(number) if share >= LEAST_LABELLED else ""


def _shorten(name: str) -> str:
    return name if len(name) <= 34 else f"{name[:33]}…"


def _fill_months(months: Sequence[MonthOverview]) -> Iterator[tuple[date, LiftCounts]]:
    for before, month in zip((None, *months), months, strict=False):
        if before is not None:
            first = before.year * 12 + before.month
            for number in range(first, month.year * 12 + month.month - 1):
                yield date(number // 12, number % 12 + 1, 1), LiftCounts()
        yield date(month.year, month.month, 1), month.lifts


def _marker(color: str, pattern: str, *, dark: bool) -> dict[str, object]:
    shade = "rgba(15,22,29,0.5)" if dark else "rgba(255,255,255,0.55)"
    return {
        "color": color,
        "line": {"width": 1, "color": "#0f161d" if dark else "#ffffff"},
        "pattern": {
            "shape": pattern,
            "fillmode": "overlay",
            "fgcolor": shade,
            "size": 7,
            "solidity": 0.25,
        },
    }


def _lay_out(figure: go.Figure, *, height: int, dark: bool) -> None:
    ink = "#0f161d" if dark else "#ffffff"
    figure.update_traces(
        textposition="inside", insidetextanchor="middle", textangle=0, textfont={"color": ink}
    )
    figure.update_layout(
        barmode="stack",
        height=height,
        bargap=0.32,
        margin={"l": 8, "r": 12, "t": 34, "b": 48},
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0, "traceorder": "normal"},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
    )
