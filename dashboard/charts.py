"""Figures from engine types. No Streamlit here, so that reports and tests can use them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from dashboard.labels import name_angle
from engine.datatypes import Array, JointAngles, Lift, Status

BAND_FACTOR = 1.96
"""The band is about 95 %: this many standard errors to either side."""

GRID = "rgba(140,155,170,0.25)"
LIGHT = ("#0072b2", "#c24e00", "#007a59")
DARK = ("#6bc0f0", "#ff9e5e", "#4fd3a8")
DASHES = ("solid", "dash", "dot")
"""Curves differ by dash too, never by colour alone."""

MARKS = {Status.FILLED: ("Filled in", "circle-open"), Status.REPAIRED: ("Sides put right", "x")}
"""Samples that are not as they were seen: what the legend says, and the symbol."""


def plot_angles(
    angles: JointAngles,
    names: Sequence[str],
    lifts: Sequence[Lift],
    *,
    before: JointAngles | None = None,
    dark: bool = False,
) -> go.Figure:
    """Plot joint angles over time with their errors, gaps and the lifts.

    Parameters
    ----------
    angles
        The curves; NaN stays an open gap.
    names
        Which of them.
    lifts
        Shaded from lift-off to set-down.
    before
        The same angles before the correction, drawn thin beneath; names it lacks are left out.
    dark
        Whether the page is dark.
    """
    figure = go.Figure()
    for name, color, dash in zip(names, DARK if dark else LIGHT, DASHES, strict=False):
        if before is not None and name in before.names:
            _add_uncorrected(figure, before, name, color=color)
        column = angles.names.index(name)
        _add_curve(figure, angles, column, color=color, dash=dash)
    _add_lifts(figure, lifts, dark=dark)
    figure.update_layout(
        height=390,
        margin={"l": 8, "r": 8, "t": 28, "b": 86},
        hovermode="x unified",
        legend={"orientation": "h", "y": 0, "yref": "container", "yanchor": "bottom", "x": 0},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        hoverlabel={"namelength": -1},
    )
    figure.update_xaxes(
        title="Time (s)", gridcolor=GRID, zeroline=False, fixedrange=False, automargin=True
    )
    figure.update_yaxes(
        title="Angle (°)", gridcolor=GRID, zerolinecolor="rgba(140,155,170,0.6)", automargin=True
    )
    return figure


def frame_figure(figure: go.Figure, *, height: int) -> None:
    """Give a figure of a comparison its height, margins, legend and grid."""
    figure.update_layout(
        height=height,
        margin={"l": 8, "r": 8, "t": 34, "b": 8},
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        hoverlabel={"namelength": -1},
    )
    figure.update_xaxes(gridcolor=GRID, zeroline=False, automargin=True)
    figure.update_yaxes(gridcolor=GRID, zerolinecolor=GRID, automargin=True)


def _add_curve(
    figure: go.Figure, angles: JointAngles, column: int, *, color: str, dash: str
) -> None:
    name = angles.names[column]
    title, time_s = name_angle(name), angles.time_s
    value, sigma = angles[name], angles.sigma(name)
    band_x, band_y = _band(time_s, value, BAND_FACTOR * sigma)
    figure.add_scatter(
        x=band_x,
        y=band_y,
        fill="toself",
        mode="lines",
        line={"width": 0},
        fillcolor=_translucent(color),
        hoverinfo="skip",
        showlegend=False,
        legendgroup=name,
    )
    figure.add_scatter(
        x=time_s,
        y=value,
        mode="lines",
        line={"color": color, "width": 2.4, "dash": dash},
        name=title,
        legendgroup=name,
        connectgaps=False,
        customdata=np.round(sigma, 1),
        hovertemplate="%{y:.0f}° ± %{customdata:.0f}°",
    )
    assert angles.status is not None  # set by JointAngles itself
    for status, (title, symbol) in MARKS.items():
        is_marked = (angles.status[:, column] == status) & np.isfinite(value)
        if is_marked.any():
            figure.add_scatter(
                x=time_s[is_marked],
                y=value[is_marked],
                mode="markers",
                marker={"symbol": symbol, "size": 6, "color": color, "line": {"width": 1.4}},
                name=title,
                legendgroup=title,
                legendrank=2000,
                showlegend=_is_new(figure, title),
                hoverinfo="skip",
            )


def _add_uncorrected(figure: go.Figure, before: JointAngles, name: str, *, color: str) -> None:
    title = "Before correction"
    figure.add_scatter(
        x=before.time_s,
        y=before[name],
        mode="lines",
        line={"color": color, "width": 1},
        opacity=0.6,
        name=title,
        legendgroup=title,
        legendrank=3000,
        showlegend=_is_new(figure, title),
        connectgaps=False,
        hoverinfo="skip",
    )


def _is_new(figure: go.Figure, group: str) -> bool:
    """Whether the legend has no entry of this group yet."""
    return all(trace.legendgroup != group for trace in figure.data)


def _add_lifts(figure: go.Figure, lifts: Sequence[Lift], *, dark: bool) -> None:
    ink = "#c9d4de" if dark else "#3d4b58"
    for number, lift in enumerate(lifts, start=1):
        figure.add_vrect(
            x0=lift.start_s,
            x1=lift.end_s,
            fillcolor="rgba(120,140,160,0.16)",
            line={"width": 1, "color": "rgba(120,140,160,0.55)", "dash": "dot"},
            layer="below",
            annotation={
                "text": f"Lift {number}",
                "font": {"size": 12, "color": ink},
                "yanchor": "bottom",
            },
            annotation_position="top left",
        )


def _band(time_s: Array, value: Array, half: Array) -> tuple[list[float], list[float]]:
    """Return closed outlines, one for each stretch without a gap, parted by NaN."""
    xs: list[float] = []
    ys: list[float] = []
    for run in _runs(np.isfinite(value) & np.isfinite(half)):
        t, low, high = time_s[run], value[run] - half[run], value[run] + half[run]
        xs += [*t, *t[::-1], float("nan")]
        ys += [*high, *low[::-1], float("nan")]
    return xs, ys


def _runs(is_there: NDArray[np.bool_]) -> Iterator[slice]:
    """Yield the stretches where `is_there` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], is_there, [False])).astype(int)))
    for start, stop in edges.reshape(-1, 2):
        yield slice(int(start), int(stop))


def _translucent(color: str, share: float = 0.17) -> str:
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{share})"


def share_missing(angles: JointAngles, names: Sequence[str]) -> float:
    """Return the share of samples of these curves that are missing, 0 to 1."""
    columns = [angles.names.index(name) for name in names]
    values = angles.value_deg[:, columns]
    return float(np.mean(~np.isfinite(values))) if values.size else 1.0
