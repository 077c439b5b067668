"""Figures of what a change does. No Streamlit here."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import plotly.graph_objects as go

from dashboard.charts import BAND_FACTOR, DARK, GRID, LIGHT
from dashboard.labels import format_number
from engine.datatypes import RiskResult
from engine.ergonomics.base import MethodInfo
from engine.ergonomics.before_after import MeasureChange, TrialMeasures

__all__ = ["plot_limits", "plot_trials"]

ROW_PX, FRAME_PX = 46, 96
MOST = 3.5
"""Values beyond so many times the limit are drawn at the edge, with an arrow."""
CLEAR = "rgba(0,0,0,0)"


@dataclass(frozen=True)
class _Point:
    """A value over its limit, with its interval, and what a reader sees on it."""

    x: float
    low: float
    high: float
    text: str


def plot_limits(
    filmed: Mapping[str, RiskResult],
    changed: Mapping[str, RiskResult],
    infos: Mapping[str, MethodInfo],
    names: Mapping[str, str],
    *,
    dark: bool = False,
) -> go.Figure | None:
    """Plot every method's value over its first limit, as filmed and as changed.

    Parameters
    ----------
    filmed, changed
        Results by method.
    infos
        Levels of the methods; those without a first limit above 0 are left out.
    names
        What the methods are called.
    dark
        Whether the page is dark.

    Returns
    -------
    Figure or None
        None where no method gave a value.
    """
    rows = [
        (names[name], one, two)
        for name in names
        if (one := _point(filmed.get(name), infos.get(name)))
        and (two := _point(changed.get(name), infos.get(name)))
    ]
    if not rows:
        return None
    colors = DARK if dark else LIGHT
    figure = go.Figure()
    labels = [name for name, _, _ in rows]
    for name, one, two in rows:
        figure.add_scatter(
            x=[_inside(one.x), _inside(two.x)],
            y=[name, name],
            mode="lines",
            line={"color": "rgba(140,155,170,0.8)", "width": 2},
            hoverinfo="skip",
            showlegend=False,
        )
    filmed_points, changed_points = ([row[k] for row in rows] for k in (1, 2))
    _add_points(figure, "As filmed", labels, filmed_points, "circle-open", colors[1])
    _add_points(figure, "As changed", labels, changed_points, "diamond", colors[0])
    figure.add_vline(x=1.0, line={"width": 1.5, "dash": "dash", "color": "rgba(140,155,170,0.9)"})
    _lay_out(figure, height=FRAME_PX + ROW_PX * len(rows))
    figure.update_xaxes(
        title="Value over the limit (1 = at the limit)", range=[0, MOST + 0.1], gridcolor=GRID
    )
    figure.update_yaxes(autorange="reversed", automargin=True)
    return figure


def _add_points(
    figure: go.Figure,
    title: str,
    labels: Sequence[str],
    points: Sequence[_Point],
    symbol: str,
    color: str,
) -> None:
    symbols = ["triangle-right" if point.x > MOST else symbol for point in points]
    figure.add_scatter(
        x=[_inside(point.x) for point in points],
        y=labels,
        name=title,
        mode="markers",
        marker=_marker(symbols, color),
        error_x={
            "array": [max(0.0, _inside(p.high) - _inside(p.x)) for p in points],
            "arrayminus": [max(0.0, _inside(p.x) - _inside(p.low)) for p in points],
            "color": color,
            "thickness": 1.2,
            "width": 4,
        },
        customdata=[point.text for point in points],
        hovertemplate="%{y}: %{customdata}<extra>" + title + "</extra>",
    )


def _marker(symbol: str | Sequence[str], color: str) -> dict[str, object]:
    return {"symbol": symbol, "size": 12, "color": color, "line": {"color": color, "width": 2}}


def _point(result: RiskResult | None, info: MethodInfo | None) -> _Point | None:
    if result is None or info is None or not result.is_applicable or math.isnan(result.value):
        return None
    limit = info.levels[0].upper if info.levels else math.nan
    if not (math.isfinite(limit) and limit > 0):
        return None
    low, high = (result.value if math.isnan(x) else x for x in result.interval)
    digits = 1 if info.decimals is None else info.decimals
    unit = f" {result.unit}" if result.unit else ""
    text = f"{format_number(result.value, digits)}{unit}, {result.category}"
    return _Point(result.value / limit, low / limit, high / limit, text)


def _inside(value: float) -> float:
    return min(value, MOST)


def _lay_out(figure: go.Figure, *, height: int) -> None:
    figure.update_layout(
        height=height,
        margin={"l": 8, "r": 12, "t": 12, "b": 82},
        legend={"orientation": "h", "y": 0, "yref": "container", "yanchor": "bottom", "x": 0},
        paper_bgcolor=CLEAR,
        plot_bgcolor=CLEAR,
        hoverlabel={"namelength": -1},
    )


def plot_trials(
    change: MeasureChange,
    before: Sequence[TrialMeasures],
    after: Sequence[TrialMeasures],
    *,
    dark: bool = False,
) -> go.Figure:
    """Plot one measure of every trial of both sets, with the means.

    Parameters
    ----------
    change
        The measure, and how it changed.
    before, after
        The trials.
    dark
        Whether the page is dark.
    """
    figure = go.Figure()
    colors = DARK if dark else LIGHT
    key = change.measure.key
    _add_trials(figure, "Before", key, before, "circle-open", colors[1])
    _add_trials(figure, "After", key, after, "diamond", colors[0])
    figure.add_scatter(
        x=["Before", "After"],
        y=[change.before, change.after],
        mode="lines",
        line={"color": "rgba(140,155,170,0.9)", "width": 2, "dash": "dot"},
        hovertemplate="mean %{y:.3g}<extra></extra>",
    )
    _lay_out(figure, height=280)
    figure.update_layout(
        title={"text": _title(change.measure.name, change.measure.unit), "font": {"size": 14}},
        margin={"l": 8, "r": 8, "t": 40, "b": 24},
        showlegend=False,
    )
    figure.update_yaxes(gridcolor=GRID, zeroline=False, automargin=True, rangemode="tozero")
    figure.update_xaxes(type="category", range=[-0.5, 1.5])
    return figure


def _add_trials(
    figure: go.Figure,
    place: str,
    key: str,
    trials: Sequence[TrialMeasures],
    symbol: str,
    color: str,
) -> None:
    known = [one for one in trials if key in one.values]
    items = [one.values[key] for one in known]
    figure.add_scatter(
        x=[place] * len(items),
        y=[item.value for item in items],
        error_y={
            "array": [0 if math.isnan(i.sigma) else BAND_FACTOR * i.sigma for i in items],
            "color": color,
            "thickness": 1,
            "width": 3,
        },
        mode="markers",
        marker=_marker(symbol, color),
        text=[f"{one.label}, person {one.person}" for one in known],
        hovertemplate="%{y:.3g}<extra>%{text}</extra>",
    )


def _title(name: str, unit: str) -> str:
    short = name.replace(" of the trunk", "").replace(" at L5/S1", "")
    return f"{short[:1].upper()}{short[1:]}{f' ({unit})' if unit else ''}".replace("(deg)", "(°)")
