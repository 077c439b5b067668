"""Figures 2 to 5 of the lifting paper, and three more that it lacks, as PNG.

Drawn without Matplotlib's global state, so that they can be made anywhere, also in a thread.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.validation.agreement import AngleSummary
from engine.validation.protocol.statistics import (
    MethodResult,
    MethodTrial,
    Study,
    find_columns,
    summarise_differences,
    summarise_distances,
)
from engine.validation.protocol.tables import PUBLISHED, ROW_TITLES, list_angles

__all__ = [
    "FIGURE_WORDS",
    "Overlay",
    "choose_example",
    "draw_boxes",
    "draw_curves",
    "draw_equivalence",
    "draw_limits",
    "draw_methods",
    "draw_overlays",
    "draw_sides",
    "draw_study",
]

ESTIMATED, MEASURED, QUIET, GRID = "#0072b2", "#c24e00", "#3d4b58", "#d6dee6"
DPI = 120
WHISKERS = (2, 98)
"""Percentiles, as in Figure 5 of the paper."""
MARGIN_COLOURS = {2.0: "#dcebf5", 5.0: "#eef4f8"}

FIGURE_WORDS: Mapping[str, str] = {
    "figure2": "Figure 2. Estimated (blue) and measured (orange) markers in the pictures",
    "figure3": "Figure 3. Joint angles over time, from the video and from the measured markers",
    "figure4": "Figure 4. Left and right: mean absolute difference with its SD",
    "figure5": "Figure 5. Signed differences: quartiles, whiskers at the 2nd and 98th percentile",
    "limits": "Difference against mean (Bland and Altman), limits with repeated measures",
    "equivalence": "Mean difference with its 90 % interval, against margins of 2° and 5°",
    "methods": "Marker error of every method, person by person",
}


@dataclass(frozen=True, eq=False)
class Overlay:
    """One picture of Figure 2: its RGB pixels, both sets of markers (M, 2) in px, and words."""

    image: NDArray[np.uint8]
    estimated_px: Array
    measured_px: Array
    title: str


def draw_study(
    study: Study, rows: Sequence[AngleSummary], overlays: Sequence[Sequence[Overlay]] = ()
) -> dict[str, bytes]:
    """Draw every figure of the method that the printed tables are about; name to PNG."""
    method = study.main
    figures = {
        "figure3": draw_curves(study, choose_example(method)),
        "figure4": draw_sides(study, method),
        "figure5": draw_boxes(study, method),
        "limits": draw_limits(study, method, rows),
        "equivalence": draw_equivalence(study, method, rows),
        "methods": draw_methods(study),
    }
    if overlays:
        figures["figure2"] = draw_overlays(study, overlays)
    return {name: _to_png(figures[name]) for name in sorted(figures)}


def choose_example(method: MethodResult) -> MethodTrial:
    """Return the trial of Figures 2 and 3: FK where there is one, neither best nor worst."""
    trials = method.select(task="FK") or list(method.trials)
    ranked = sorted(trials, key=lambda one: summarise_distances([one]).mean_mm)
    return ranked[len(ranked) // 2]


def _to_png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def _style(axes: Axes) -> None:
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8, length=2, color=GRID)
    for spine in axes.spines.values():
        spine.set_color(GRID)


def _head(figure: Figure, study: Study, text: str) -> None:
    """Write what is shown; synthetic data are called so on every figure."""
    tail = " · synthetic data" if study.is_synthetic else ""
    # Matplotlib reads dollar signs as formulas.
    figure.text(0.012, 0.985, f"{text}{tail}".replace("$", r"\$"), va="top", fontsize=10)


def _title_column(name: str) -> str:
    """Turn an angle with its side into words."""
    side = {"_r": ", right", "_l": ", left"}.get(name[-2:], "")
    return ROW_TITLES[name[:-2] if side else name] + side


# --------------------------------------------------------------------------- figure 2


def draw_overlays(study: Study, overlays: Sequence[Sequence[Overlay]]) -> Figure:
    """Draw pictures with both sets of markers, a row per view, a column per moment."""
    n_rows, n_columns = len(overlays), max(len(row) for row in overlays)
    height_px, width_px = overlays[0][0].image.shape[:2]
    width = 3.4 * n_columns
    height = 3.4 * n_rows * height_px / width_px + 0.5 + 0.25 * n_rows
    figure = Figure(figsize=(width, height), dpi=DPI)
    grid = figure.add_gridspec(
        n_rows, n_columns, left=0.008, right=0.992, bottom=0.01, top=1 - 0.58 / height,
        wspace=0.02, hspace=0.1,
    )  # fmt: skip
    for i, row in enumerate(overlays):
        for j, overlay in enumerate(row):
            _draw_overlay(figure.add_subplot(grid[i, j]), overlay)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="upper right", ncols=2,
                  fontsize=9, frameon=False)  # fmt: skip
    _head(figure, study, "Estimated and measured markers")
    return figure


def _draw_overlay(axes: Axes, overlay: Overlay) -> None:
    axes.imshow(overlay.image, interpolation="bilinear")
    both = np.stack([overlay.measured_px, overlay.estimated_px], axis=1)
    axes.plot(*both.transpose(2, 1, 0), color="white", linewidth=0.7)
    (x, y), (u, v) = overlay.measured_px.T, overlay.estimated_px.T
    axes.scatter(x, y, s=15, facecolor="none", edgecolor=MEASURED, linewidth=1.0, label="measured")
    axes.scatter(u, v, s=8, color=ESTIMATED, linewidth=0, label="estimated")
    height, width = overlay.image.shape[:2]
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    axes.set_title(overlay.title, fontsize=8.5, loc="left", pad=2)


# --------------------------------------------------------------------------- figure 3


def draw_curves(study: Study, one: MethodTrial) -> Figure:
    """Draw the 13 angles of one trial, right side where there are two."""
    names = [one.trial.angle_names[find_columns(one.trial.angle_names, row)[-1]]
             for row in list_angles(study)]  # fmt: skip
    names = [name[:-2] + "_r" if name.endswith("_l") else name for name in names]
    columns = 4
    n_rows = -(-(len(names) + 1) // columns)
    height = 1.95 * n_rows + 0.6
    figure = Figure(figsize=(11.5, height), dpi=DPI)
    grid = figure.add_gridspec(
        n_rows, columns, left=0.045, right=0.99, top=1 - 0.72 / height, bottom=0.45 / height,
        wspace=0.22, hspace=0.5,
    )  # fmt: skip
    for i, name in enumerate(names):
        axes = figure.add_subplot(grid[i // columns, i % columns])
        column = one.trial.angle_names.index(name)
        axes.plot(one.trial.time_s, one.trial.reference_deg[:, column], color=MEASURED,
                  linewidth=1.6, dashes=(4, 2), label="measured markers")  # fmt: skip
        axes.plot(one.trial.time_s, one.estimated_deg[:, column], color=ESTIMATED, linewidth=1.4,
                  label="from the videos")  # fmt: skip
        axes.set_title(f"{_title_column(name)} (°)", fontsize=9, loc="left", pad=3)
        _style(axes)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(4))
        if i + columns >= len(names):
            axes.set_xlabel("Time (s)", fontsize=8)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="upper right", ncols=2,
                  fontsize=9, frameon=False)  # fmt: skip
    _head(figure, study, f"{one.trial.label}, a trial of middling error")
    return figure


# --------------------------------------------------------------------------- figures 4 and 5


def draw_sides(study: Study, method: MethodResult) -> Figure:
    """Draw the mean absolute difference of left and right side by side, with SDs."""
    names = method.trials[0].trial.angle_names
    rows = [row for row in list_angles(study) if len(find_columns(names, row)) == 2]
    figure = Figure(figsize=(8.6, 4.2), dpi=DPI)
    axes = figure.add_axes((0.07, 0.24, 0.92, 0.64))
    _style(axes)
    x = np.arange(len(rows))
    for shift, word, color, side in ((-0.19, "right", ESTIMATED, "_r"), (0.19, "left", MEASURED,
                                                                         "_l")):  # fmt: skip
        found = [summarise_differences(method.trials, [f"{row}{side}"]) for row in rows]
        axes.bar(
            x + shift, [s.mae_deg for s in found], width=0.36, color=color, label=word,
            hatch="///" if side == "_l" else "", edgecolor="white", linewidth=0.4,
            yerr=np.array([s.sd_absolute_deg for s in found]),
            error_kw={"elinewidth": 0.9, "ecolor": QUIET, "capsize": 2},
        )  # fmt: skip
    axes.set_xticks(x, [ROW_TITLES[row] for row in rows], fontsize=8.5, rotation=30, ha="right")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("Absolute difference (°)", fontsize=9)
    figure.legend(*axes.get_legend_handles_labels(), loc="upper right", ncols=2, fontsize=9,
                  frameon=False)  # fmt: skip
    _head(figure, study, f"Left and right, {method.name}: mean and SD")
    return figure


def draw_boxes(study: Study, method: MethodResult) -> Figure:
    """Draw the signed differences of the 13 angles; sides are pooled."""
    rows = list_angles(study)
    figure, axes = _lying_axes(len(rows))
    axes.axvline(0.0, color="#566472", linewidth=0.9)
    boxes: list[dict[str, Any]] = []
    for row in rows:
        d = _pool(method, row)
        low, q1, median, q3, high = np.percentile(d, [WHISKERS[0], 25, 50, 75, WHISKERS[1]])
        boxes.append(
            {"whislo": low, "q1": q1, "med": median, "q3": q3, "whishi": high, "fliers": []}
        )
    axes.bxp(
        boxes, positions=list(range(len(boxes))), orientation="horizontal", widths=0.55,
        showfliers=False, patch_artist=True,
        boxprops={"facecolor": "#cfe3f1", "edgecolor": ESTIMATED},
        medianprops={"color": MEASURED, "linewidth": 1.6},
        whiskerprops={"color": ESTIMATED}, capprops={"color": ESTIMATED},
    )  # fmt: skip
    _name_rows(axes, [ROW_TITLES[row] for row in rows])
    axes.set_xlabel("Video minus measured markers (°)", fontsize=9)
    _head(figure, study, f"Signed differences of {method.name}")
    return figure


def _pool(method: MethodResult, row: str) -> Array:
    """Return the differences of a row of Table 3, both sides, without gaps."""
    columns = find_columns(method.trials[0].trial.angle_names, row)
    values = np.concatenate([one.difference_deg[:, columns].ravel() for one in method.trials])
    known = values[np.isfinite(values)]
    return known if known.size else np.array([np.nan])


def _lying_axes(n_rows: int) -> tuple[Figure, Axes]:
    height = 0.3 * max(n_rows, 3) + 1.15
    figure = Figure(figsize=(8.6, height), dpi=DPI)
    axes = figure.add_axes((0.2, 0.55 / height, 0.77, 1 - 1.0 / height))
    _style(axes)
    return figure, axes


def _name_rows(axes: Axes, names: Sequence[str]) -> None:
    axes.set_yticks(range(len(names)), names, fontsize=9)
    axes.invert_yaxis()


# --------------------------------------------------------------------------- more than the paper


def draw_limits(study: Study, method: MethodResult, rows: Sequence[AngleSummary]) -> Figure:
    """Draw difference against mean with bias and limits of agreement, one plot per angle."""
    columns = 4
    n_rows = -(-len(rows) // columns)
    height = 2.1 * n_rows + 0.7
    figure = Figure(figsize=(11.5, height), dpi=DPI)
    grid = figure.add_gridspec(
        n_rows, columns, left=0.05, right=0.99, top=1 - 0.7 / height, bottom=0.45 / height,
        hspace=0.42, wspace=0.22,
    )  # fmt: skip
    pairs = [one.pair_rows() for one in method.trials]
    for i, summary in enumerate(rows):
        axes = figure.add_subplot(grid[i // columns, i % columns])
        both = [pair.curves(summary.name) for pair in pairs]
        estimated, reference = (np.concatenate(part) for part in zip(*both, strict=True))
        step = max(1, estimated.size // 1500)
        axes.scatter((estimated + reference)[::step] / 2, (estimated - reference)[::step], s=3,
                     color=ESTIMATED, alpha=0.3, linewidth=0)  # fmt: skip
        limits = summary.bland_altman
        axes.axhline(limits.bias, color=QUIET, linewidth=1.1)
        for value in (limits.lower, limits.upper):
            axes.axhline(value, color=MEASURED, linewidth=1.1, linestyle="--")
        axes.set_title(f"{ROW_TITLES[summary.name]} (°)", fontsize=9, loc="left", pad=3)
        _style(axes)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(4))
        if i + columns >= len(rows):
            axes.set_xlabel("Mean of both (°)", fontsize=8)
        if i % columns == 0:
            axes.set_ylabel("Difference (°)", fontsize=8)
    _head(figure, study, f"Difference against mean, {method.name}, with limits of agreement")
    return figure


def draw_equivalence(study: Study, method: MethodResult, rows: Sequence[AngleSummary]) -> Figure:
    """Draw the mean difference of each angle with its 90 % interval over the margins."""
    figure, axes = _lying_axes(len(rows))
    for margin in sorted(MARGIN_COLOURS, reverse=True):
        axes.axvspan(-margin, margin, color=MARGIN_COLOURS[margin], linewidth=0)
    axes.axvline(0.0, color="#566472", linewidth=0.9)
    for i, s in enumerate(rows):
        test = s.equivalence[0]
        if test.interval.is_known:
            axes.plot(test.interval, [i, i], color=ESTIMATED, linewidth=2.2, solid_capstyle="butt")
        axes.scatter([test.mean], [i], color="white", edgecolor=ESTIMATED, s=26, zorder=3)
    _name_rows(axes, [ROW_TITLES[s.name] for s in rows])
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, -5.5), max(high, 5.5))
    unit = rows[0].unit if rows else "trial"
    axes.set_xlabel(f"Mean difference (°), one value per {unit}; shaded: ±2° and ±5°", fontsize=9)
    _head(figure, study, f"Equivalence of {method.name} with the measured markers")
    return figure


def draw_methods(study: Study) -> Figure:
    """Draw every person's marker error for every method, with the paper's figure for scale."""
    methods = study.methods
    figure, axes = _lying_axes(len(methods))
    # The paper's figure belongs to other people, filmed elsewhere: a line, not a row.
    axes.axvline(PUBLISHED.marker_mm[0], color=MEASURED, linewidth=1.2, linestyle="--",
                 label="printed by Mehrizi et al. (2018), other people")  # fmt: skip
    for i, method in enumerate(methods):
        persons = [summarise_distances(method.select(s)).mean_mm for s in method.subjects]
        axes.scatter(persons, [i] * len(persons), s=22, color=ESTIMATED, alpha=0.75, linewidth=0,
                     label="one person" if i == 0 else None, zorder=3)  # fmt: skip
        mean = float(np.mean(persons))
        axes.plot([mean, mean], [i - 0.3, i + 0.3], color=QUIET, linewidth=1.8,
                  label="mean of the persons" if i == 0 else None)  # fmt: skip
    _name_rows(axes, [method.name for method in methods])
    axes.set_ylim(len(methods) - 0.4, -0.6)
    axes.set_xlim(left=0)
    axes.set_xlabel("Marker error (mm)", fontsize=9)
    figure.legend(*axes.get_legend_handles_labels(), loc="upper right", ncols=3, fontsize=8,
                  frameon=False, bbox_to_anchor=(0.99, 0.94))  # fmt: skip
    _head(figure, study, "All methods")
    return figure
