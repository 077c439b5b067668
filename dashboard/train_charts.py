"""Figures of a comparison of form. No Streamlit here."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import plotly.graph_objects as go

from dashboard.charts import BAND_FACTOR, DARK, LIGHT
from dashboard.labels import PHASES, name_angle
from engine.datatypes import Array
from engine.form import Comparison, Score
from engine.form.phases import phase_bounds

__all__ = ["ScorePoint", "plot_aligned", "plot_progress"]

GRID = "rgba(140,155,170,0.25)"
BEYOND = "rgba(120,130,140,0.35)"
CLEAR = "rgba(0,0,0,0)"


@dataclass(frozen=True)
class ScorePoint:
    """One trial's score in the course of training; `title` is what a reader sees on it."""

    when: datetime
    score: Score
    title: str
    is_shown_now: bool = False


def plot_aligned(comparison: Comparison, name: str, *, dark: bool = False) -> go.Figure:
    """Plot one angle of both performances over the reference's movement.

    Bands are about 95 % of that part of the errors which does not repeat from clip to clip; where
    the difference goes beyond its error, the space between the curves is filled.

    Parameters
    ----------
    comparison
        The aligned curves.
    name
        One of its angles.
    dark
        Whether the page is dark.
    """
    figure = go.Figure()
    i = comparison.names.index(name)
    difference = comparison.difference_deg[:, i]
    is_beyond = np.abs(difference) > BAND_FACTOR * comparison.difference_sigma_deg[:, i]
    for part in _runs(is_beyond):
        _fill(
            figure,
            comparison.percent[part],
            comparison.reference_deg[part, i],
            comparison.attempt_deg[part, i],
            BEYOND,
        )
    colors = DARK if dark else LIGHT
    for title, value, sigma, color, dash in (
        (
            "Reference", comparison.reference_deg, comparison.reference_sigma_deg,
            colors[0], "solid",
        ),
        ("Attempt", comparison.attempt_deg, comparison.attempt_sigma_deg, colors[1], "dash"),
    ):  # fmt: skip
        half = BAND_FACTOR * comparison.own_error_share * sigma[:, i]
        _fill(figure, comparison.percent, value[:, i] - half, value[:, i] + half, _faint(color))
        figure.add_scatter(
            x=comparison.percent,
            y=value[:, i],
            name=title,
            mode="lines",
            line={"color": color, "width": 2.6, "dash": dash},
            hovertemplate="%{y:.0f}°",
        )
    figure.add_scatter(
        x=[None],
        y=[None],
        name="Beyond the error",
        mode="markers",
        marker={"symbol": "square", "size": 12, "color": BEYOND},
    )
    _add_phases(figure, comparison)
    _lay_out(figure, height=330)
    figure.update_layout(
        title={"text": name_angle(name), "font": {"size": 15}, "x": 0, "xanchor": "left"},
        hovermode="x unified",
    )
    figure.update_xaxes(
        title="Share of the movement (%)", range=[0, 100], gridcolor=GRID, zeroline=False
    )
    figure.update_yaxes(title="Angle (°)", gridcolor=GRID, zeroline=False, automargin=True)
    return figure


def _runs(flags: Array) -> Iterator[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(int)))
    for start, stop in edges.reshape(-1, 2):
        yield slice(int(start), int(stop))


def _fill(figure: go.Figure, x: Array, low: Array, high: Array, color: str) -> None:
    figure.add_scatter(
        x=np.concatenate([x, x[::-1]]),
        y=np.concatenate([low, high[::-1]]),
        fill="toself",
        mode="lines",
        line={"width": 0},
        fillcolor=color,
        hoverinfo="skip",
        showlegend=False,
    )


def _faint(color: str) -> str:
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.15)"


def _add_phases(figure: go.Figure, comparison: Comparison) -> None:
    """Part the phases by dotted lines, and name them above."""
    bounds = phase_bounds(comparison.phases)
    names = [PHASES[p.key] for p in comparison.phases if not p.is_moment]
    for at in bounds[1:-1]:
        figure.add_vline(x=at, line={"width": 1, "dash": "dot", "color": "rgba(140,155,170,0.9)"})
    for name, low, high in zip(names, bounds[:-1], bounds[1:], strict=True):
        if high - low > 8:
            figure.add_annotation(
                x=0.5 * (low + high), y=1.0, yref="paper", yanchor="bottom",
                text=name, showarrow=False, font={"size": 12},
            )  # fmt: skip


def _lay_out(figure: go.Figure, *, height: int) -> None:
    figure.update_layout(
        height=height,
        margin={"l": 8, "r": 12, "t": 62, "b": 84},
        legend={"orientation": "h", "y": 0, "yref": "container", "yanchor": "bottom", "x": 0},
        paper_bgcolor=CLEAR,
        plot_bgcolor=CLEAR,
        hoverlabel={"namelength": -1},
    )


def plot_progress(points: Sequence[ScorePoint], *, dark: bool = False) -> go.Figure:
    """Plot scores over time with their intervals; a diamond marks the trial shown above.

    Parameters
    ----------
    points
        In any order.
    dark
        Whether the page is dark.
    """
    points = sorted(points, key=lambda p: p.when)
    color = (DARK if dark else LIGHT)[0]
    figure = go.Figure()
    figure.add_scatter(
        x=[p.when for p in points],
        y=[p.score.value for p in points],
        error_y={
            "array": [p.score.interval[1] - p.score.value for p in points],
            "arrayminus": [p.score.value - p.score.interval[0] for p in points],
            "color": color,
            "thickness": 1.4,
            "width": 5,
        },
        mode="lines+markers",
        line={"color": color, "width": 1.6, "dash": "dot"},
        marker={
            "symbol": ["diamond" if p.is_shown_now else "circle-open" for p in points],
            "size": [14 if p.is_shown_now else 10 for p in points],
            "color": color,
            "line": {"color": color, "width": 2},
        },
        text=[p.title for p in points],
        hovertemplate="%{text}: %{y:.0f}<extra></extra>",
        showlegend=False,
    )
    _lay_out(figure, height=280)
    low = min((p.score.interval[0] for p in points), default=0.0)
    figure.update_layout(margin={"l": 8, "r": 12, "t": 12, "b": 40})
    figure.update_yaxes(
        title="Score", range=[10 * math.floor(max(low - 5, 0) / 10), 103], gridcolor=GRID
    )
    figure.update_xaxes(gridcolor=GRID, nticks=4, tickangle=0, tickformat="%d %b %Y<br>%H:%M")
    return figure
