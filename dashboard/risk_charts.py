"""Figures of risk over time. No Streamlit here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from dashboard.charts import DARK, LIGHT
from dashboard.labels import name_method
from engine.datatypes import Array, Lift, RiskResult
from engine.ergonomics.posture_scores import decode_runs

__all__ = ["has_frames", "plot_scores"]

ROW_PX, FRAME_PX, LABELS_PX = 165, 70, 112
GRID = "rgba(140,155,170,0.25)"
LEVEL_INK = {False: (38, 52, 66), True: (214, 226, 238)}
DEEPEST_SHADE = 0.24
"""Levels are told apart by place, name and line; the shade only helps the eye."""


def has_frames(risk: RiskResult) -> bool:
    """Whether a method scored every frame."""
    return risk.is_applicable and "score" in risk.details.get("series", {})


def plot_scores(
    results: Sequence[RiskResult],
    time_s: Array,
    lifts: Sequence[Lift],
    *,
    dark: bool = False,
) -> go.Figure:
    """Plot the scores of every frame, one row a method, over the method's levels.

    Parameters
    ----------
    results
        Methods that score every frame.
    time_s
        Shape (T,): the frames' times.
    lifts
        Marked from lift-off to set-down.
    dark
        Whether the page is dark.
    """
    figure = make_subplots(
        rows=len(results),
        cols=1,
        shared_xaxes=True,
        vertical_spacing=0.34 / len(results) ** 1.2,
        subplot_titles=[name_method(risk.method) for risk in results],
    )
    for row, risk in enumerate(results, start=1):
        # Shades only go where there is a curve already.
        _add_scores(figure, risk, time_s, row, dark=dark)
        _add_levels(figure, risk, row, dark=dark)
    _add_lifts(figure, lifts, len(results), dark=dark)
    figure.update_layout(
        height=ROW_PX * len(results) + FRAME_PX,
        margin={"l": 8, "r": LABELS_PX, "t": 30, "b": 40},
        showlegend=False,
        hovermode="x unified",
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
    )
    figure.update_annotations(font_size=13)
    figure.update_xaxes(gridcolor=GRID, zeroline=False, range=[time_s[0], time_s[-1]])
    figure.update_xaxes(title="Time (s)", row=len(results), col=1)
    return figure


def _series(risk: RiskResult, name: str) -> Array | None:
    """Return one series with gaps where nothing was scored."""
    runs: Mapping[str, Sequence[int]] | None = risk.details["series"].get(name)
    if runs is None:
        return None
    values = decode_runs(runs).astype(float)
    return np.where(values > 0, values, np.nan)


def _add_scores(
    figure: go.Figure, risk: RiskResult, time_s: Array, row: int, *, dark: bool
) -> None:
    color = (DARK if dark else LIGHT)[0]
    score, low, high = (_series(risk, name) for name in ("score", "low", "high"))
    if low is not None and high is not None:
        red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
        for edge, fill in ((low, None), (high, "tonexty")):
            figure.add_scatter(
                x=time_s,
                y=edge,
                mode="lines",
                line={"width": 0, "shape": "hv"},
                fill=fill,
                fillcolor=f"rgba({red},{green},{blue},0.22)",
                hoverinfo="skip",
                row=row,
                col=1,
            )
    span = (
        [f" ({a:.0f} to {b:.0f})" if a < b else "" for a, b in zip(low, high, strict=True)]
        if low is not None and high is not None
        else [""] * len(time_s)
    )
    figure.add_scatter(
        x=time_s,
        y=score,
        mode="lines",
        line={"color": color, "width": 2.6, "shape": "hv"},
        connectgaps=False,
        customdata=span,
        name=name_method(risk.method),
        hovertemplate="%{y:.0f}%{customdata}",
        row=row,
        col=1,
    )


def _add_levels(figure: go.Figure, risk: RiskResult, row: int, *, dark: bool) -> None:
    """Shade the levels and write their names into them."""
    levels: Sequence[Mapping[str, Any]] = risk.details["levels"]
    tops = [_series(risk, name) for name in ("score", "high")]
    seen = max(float(np.nanmax(top)) for top in tops if top is not None)
    below = 0.5
    top = max(seen, levels[-2]["upper"] + 1) + 0.5
    ink = LEVEL_INK[dark]
    for k, level in enumerate(levels):
        upper = min(float(level["upper"]) + 0.5, top)
        if below >= top:
            break
        shade = DEEPEST_SHADE * k / (len(levels) - 1)
        figure.add_hrect(
            y0=below,
            y1=upper,
            fillcolor=f"rgba({ink[0]},{ink[1]},{ink[2]},{shade:.3f})",
            line={"width": 1, "color": f"rgba({ink[0]},{ink[1]},{ink[2]},0.28)", "dash": "dot"},
            layer="below",
            row=row,
            col=1,
        )
        figure.add_annotation(
            text=level["name"],
            x=1.01,
            xref="x domain" if row == 1 else f"x{row} domain",
            y=(below + upper) / 2,
            yref="y" if row == 1 else f"y{row}",
            xanchor="left",
            showarrow=False,
            font={"size": 11, "color": f"rgb({ink[0]},{ink[1]},{ink[2]})"},
            opacity=0.85,
        )
        below = upper
    figure.update_yaxes(
        range=[0.5, top],
        tickmode="linear",
        tick0=1,
        dtick=1 if top < 9 else 3,
        showgrid=False,
        zeroline=False,
        automargin=True,
        row=row,
        col=1,
    )


def _add_lifts(figure: go.Figure, lifts: Sequence[Lift], n_rows: int, *, dark: bool) -> None:
    ink = "rgba(255,158,94,0.9)" if dark else "rgba(194,78,0,0.9)"
    for row in range(1, n_rows + 1):
        for lift in lifts:
            for at_s in (lift.start_s, lift.end_s):
                figure.add_vline(
                    x=at_s, line={"width": 1.4, "color": ink, "dash": "dash"}, row=row, col=1
                )
