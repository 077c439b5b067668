"""Figures of a comparison with a reference. No Streamlit here."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from dashboard.charts import DARK, LIGHT, frame_figure
from dashboard.labels import name_angle
from engine.validation.agreement import AngleSummary
from engine.validation.compare import TrialComparison
from engine.validation.pooled import (
    Agreement,
    bland_altman_points,
    find_sides,
    pooled_differences,
)
from engine.validation.statistics import Interval

__all__ = ["plot_bland_altman", "plot_boxes", "plot_errors", "plot_pair", "plot_sides"]

ZERO = "rgba(140,155,170,0.8)"
BAND_FACTOR = 1.96
ROW_PX, FRAME_PX = 30, 90


def plot_pair(trial: TrialComparison, name: str, *, dark: bool = False) -> go.Figure:
    """Plot both curves of an angle on one time axis, the difference with its band below.

    The band holds the mean difference ± 1.96 SD over the trial.
    """
    video, reference, _ = DARK if dark else LIGHT
    ink = _ink(dark=dark)
    column = trial.names.index(name)
    time, difference = trial.pairs.time_s, trial.difference_deg[:, column]
    figure = make_subplots(
        rows=2, cols=1, shared_xaxes=True, row_heights=[0.62, 0.38], vertical_spacing=0.06
    )
    for values, title, color, dash in (
        (trial.estimated_deg[:, column], "From the video", video, "solid"),
        (trial.pairs.reference_deg[:, column], "Reference", reference, "dash"),
    ):
        figure.add_scatter(
            x=time, y=values, mode="lines", line={"color": color, "width": 2.4, "dash": dash},
            name=title, hovertemplate="%{y:.1f}°", row=1, col=1,
        )  # fmt: skip
    figure.add_scatter(
        x=time, y=difference, mode="lines", line={"color": ink, "width": 1.8}, name="Difference",
        hovertemplate="%{y:+.1f}°", row=2, col=1,
    )  # fmt: skip
    known = difference[np.isfinite(difference)]
    mean, half = float(known.mean()), BAND_FACTOR * float(known.std(ddof=1))
    figure.add_hrect(
        y0=mean - half, y1=mean + half, fillcolor=ink, opacity=0.13, line_width=0, row=2, col=1
    )
    figure.add_hline(y=mean, line={"color": ink, "width": 1, "dash": "dot"}, row=2, col=1)
    frame_figure(figure, height=430)
    figure.update_layout(hovermode="x unified")
    figure.update_xaxes(title="Time (s)", row=2, col=1)
    figure.update_yaxes(title="Angle (°)", row=1, col=1)
    figure.update_yaxes(title="Difference (°)", row=2, col=1, zerolinecolor=ZERO)
    return figure


def plot_errors(agreement: Agreement, *, dark: bool = False) -> go.Figure:
    """Plot the root mean square error of every angle, with its interval over several units."""
    summaries = _seen(agreement)
    color, warm, _ = DARK if dark else LIGHT
    names = [name_angle(s.name) for s in summaries]
    rmse = [s.rmse.estimate for s in summaries]
    figure = go.Figure()
    figure.add_bar(
        x=rmse, y=names, orientation="h", marker={"color": color}, name="Root mean square (RMSE)",
        error_x=_arms([(s.rmse.estimate, s.rmse.interval) for s in summaries], dark=dark),
        hovertemplate="%{x:.1f}°",
    )  # fmt: skip
    figure.add_scatter(
        x=[s.pooled.mae_deg for s in summaries], y=names, mode="markers", name="Mean absolute",
        marker={"symbol": "diamond", "size": 9, "color": warm,
                "line": {"width": 1, "color": "#fff"}},
        hovertemplate="%{x:.1f}°",
    )  # fmt: skip
    _lay_down(figure, len(names), "Error (°)")
    return figure


def plot_sides(agreement: Agreement, *, dark: bool = False) -> go.Figure:
    """Plot the root mean square error of left and right side by side."""
    sides = find_sides(agreement)
    names = [name_angle(f"{name}_l").removesuffix(", left") for name, _, _ in sides]
    left, right, _ = DARK if dark else LIGHT
    figure = go.Figure()
    for title, color, shape, values in (
        ("Left", left, "", [one.pooled.rmse_deg for _, one, _ in sides]),
        ("Right", right, "/", [other.pooled.rmse_deg for _, _, other in sides]),
    ):
        figure.add_bar(
            x=values, y=names, orientation="h", name=title, hovertemplate="%{x:.1f}°",
            marker={
                "color": color,
                "pattern": {"shape": shape, "bgcolor": color, "fgcolor": "#ffffff", "size": 7},
            },
        )  # fmt: skip
    _lay_down(figure, 2 * len(names), "Root mean square error (°)")
    return figure


def plot_boxes(agreement: Agreement, *, dark: bool = False) -> go.Figure:
    """Plot the differences of all frames: median, quartiles, whiskers at 2.5 and 97.5 %."""
    summaries = _seen(agreement)
    color = (DARK if dark else LIGHT)[0]
    found = [
        np.percentile(pooled_differences(agreement.trials, s.name), [2.5, 25, 50, 75, 97.5])
        for s in summaries
    ]
    low, q1, median, q3, high = (list(column) for column in zip(*found, strict=True))
    figure = go.Figure()
    figure.add_box(
        y=[name_angle(s.name) for s in summaries], q1=q1, median=median, q3=q3, lowerfence=low,
        upperfence=high, orientation="h", marker={"color": color}, line={"width": 1.6},
        showlegend=False, name="",
    )  # fmt: skip
    figure.add_vline(x=0.0, line={"color": ZERO, "width": 1.4})
    _lay_down(figure, len(summaries), "Video minus reference (°)")
    return figure


def plot_bland_altman(agreement: Agreement, name: str, *, dark: bool = False) -> go.Figure:
    """Plot difference against mean of one angle, with bias and limits of agreement."""
    summary = next(s for s in agreement.angles if s.name == name)
    color, warm, _ = DARK if dark else LIGHT
    mean, difference = bland_altman_points(agreement.trials, name)
    limits = summary.bland_altman
    figure = go.Figure()
    figure.add_scatter(
        x=mean, y=difference, mode="markers", marker={"color": color, "size": 5, "opacity": 0.45},
        showlegend=False, hovertemplate="mean %{x:.0f}°, difference %{y:+.1f}°<extra></extra>",
    )  # fmt: skip
    ink = _ink(dark=dark)
    for value, word, line, dash in (
        (limits.lower, "lower limit", warm, "dash"),
        (limits.bias, "mean", ink, "solid"),
        (limits.upper, "upper limit", warm, "dash"),
    ):
        figure.add_hline(
            y=value, line={"color": line, "width": 1.6, "dash": dash},
            annotation={"text": f"{word} {value:+.1f}°".replace("-", "−"),
                        "font": {"size": 12, "color": ink}},
            annotation_position="top right",
        )  # fmt: skip
    frame_figure(figure, height=360)
    figure.update_xaxes(title="Mean of video and reference (°)")
    figure.update_yaxes(title="Video minus reference (°)", zerolinecolor=ZERO)
    return figure


def _seen(agreement: Agreement) -> tuple[AngleSummary, ...]:
    return tuple(s for s in agreement.angles if s.pooled.n_samples)


def _ink(*, dark: bool) -> str:
    return "#c9d4de" if dark else "#3d4b58"


def _arms(found: list[tuple[float, Interval]], *, dark: bool) -> dict[str, object]:
    """Return error bars; none where an interval is unknown."""
    up = [i.high - value if i.is_known else None for value, i in found]
    down = [value - i.low if i.is_known else None for value, i in found]
    return {
        "type": "data",
        "symmetric": False,
        "array": up,
        "arrayminus": down,
        "color": _ink(dark=dark),
        "thickness": 1.4,
        "visible": any(arm is not None for arm in up),
    }


def _lay_down(figure: go.Figure, n_rows: int, title: str) -> None:
    frame_figure(figure, height=FRAME_PX + ROW_PX * max(n_rows, 3))
    figure.update_layout(barmode="group", bargap=0.32)
    figure.update_xaxes(title=title)
    figure.update_yaxes(autorange="reversed")
