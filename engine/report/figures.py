"""Vector charts: angles over time, and lifting indices over days."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, FlagLevel, JointAngles, Lift
from engine.report.fonts import REGULAR, text_width
from engine.report.layout import INK, LINE, QUIET, SMALL
from engine.report.levels import LEFT, RIGHT, TICK, draw_level_shape, write_line
from engine.report.sheet import Point, Sheet
from engine.report.wording import Words

__all__ = ["Curve", "CurveChart", "TrendChart", "TrendPoint", "list_trunk_and_knees"]

LOAD_SHADE = "#e3e9ef"
BAND_FACTOR = 1.96
MAX_BINS = 260
"""A curve is drawn by the extremes of so many stretches: peaks stay, the file stays small."""


@dataclass(frozen=True, eq=False)
class Curve:
    """One angle over time with its standard error; (T,) each, degrees and s, NaN for gaps."""

    name: str
    time_s: Array
    value_deg: Array
    sigma_deg: Array
    colour: str
    dash: tuple[float, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether nothing was measured."""
        return not bool(np.isfinite(self.value_deg).any())


@dataclass(frozen=True, eq=False)
class CurveChart:
    """Curves over time, with their bands of about 95 %, the lifts and the worst moment."""

    title: str
    curves: tuple[Curve, ...]
    lifts: tuple[Lift, ...]
    span_s: tuple[float, float]
    moment_s: float
    words: Words
    height_pt: float = 70.0
    has_time_axis: bool = True

    def height(self, width: float) -> float:
        """Return its fixed height."""
        return self.height_pt

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw title, axes, lifts, bands and curves."""
        with sheet.tag("Figure", alt=self.describe()):
            self._draw_title(sheet, x, top, width)
            bottom = top - self.height_pt + (19 if self.has_time_axis else 3)
            area = _Area.over(x + 19, bottom, width - 20, top - 13 - bottom, self.span_s)
            if all(curve.is_empty for curve in self.curves):
                write_line(sheet, area.x + 4, area.y + area.height / 2, self.words["missing"], TICK)
                return
            area = area.covering(self._extent())
            self._shade_lifts(sheet, area)
            _draw_y_axis(sheet, area)
            for curve in self.curves:
                _draw_curve(sheet, area, curve)
            self._name_lifts(sheet, area)
            if math.isfinite(self.moment_s):
                at = area.at(self.moment_s, 0.0)[0]
                line = [(at, area.y), (at, area.y + area.height)]
                sheet.polyline(line, stroke=INK, line=0.8, dash=(0.1, 2.0))
            if self.has_time_axis:
                _draw_time_axis(sheet, area, self.words["seconds"])

    def describe(self) -> str:
        """Return in words what the chart shows."""
        sentences = []
        for curve in self.curves:
            name = f"{self.title}, {curve.name}" if curve.name else self.title
            if curve.is_empty:
                sentences.append(self.words["alt_curve_missing"].format(title=name))
                continue
            i = int(np.nanargmax(curve.value_deg))
            sentences.append(
                self.words["alt_curve"].format(
                    title=name,
                    peak=self.words.number(float(curve.value_deg[i])),
                    time=self.words.number(float(curve.time_s[i]), 1),
                )
            )
        return " ".join(sentences)

    def _draw_title(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        style = SMALL.bold
        write_line(sheet, x, top - 7, self.title, style)
        at = x + text_width(self.title, style.font, style.size) + 8
        named = [curve for curve in self.curves if curve.name]
        for curve in named:
            line = [(at, top - 4.7), (at + 14, top - 4.7)]
            sheet.polyline(line, stroke=curve.colour, line=1.4, dash=curve.dash)
            missing = f" ({self.words['missing']})" if curve.is_empty else ""
            label = curve.name + missing
            write_line(sheet, at + 17, top - 7, label, TICK)
            at += 17 + text_width(label, TICK.font, TICK.size) + 8

    def _extent(self) -> tuple[float, float]:
        """Return the axis: all of the curves, and of a very wide band a part."""
        low, high = 0.0, 10.0
        for curve in self.curves:
            if not curve.is_empty:
                half = BAND_FACTOR * np.nan_to_num(curve.sigma_deg)
                peak = float(np.nanmax(curve.value_deg))
                high = max(high, peak, min(float(np.nanmax(curve.value_deg + half)), 1.3 * peak))
                low = min(low, float(np.nanmin(curve.value_deg)))
        return low, high

    def _shade_lifts(self, sheet: Sheet, area: _Area) -> None:
        for lift in self.lifts:
            if math.isfinite(lift.start_s) and math.isfinite(lift.end_s):
                left, right = area.at(lift.start_s, 0)[0], area.at(lift.end_s, 0)[0]
                sheet.rectangle(left, area.y, max(right - left, 0.5), area.height, fill=LOAD_SHADE)

    def _name_lifts(self, sheet: Sheet, area: _Area) -> None:
        """Name every lift at the top right of its shade, as far as names don't touch."""
        free_from = -math.inf
        for number, lift in enumerate(self.lifts, start=1):
            if not (math.isfinite(lift.start_s) and math.isfinite(lift.end_s)):
                continue
            label = self.words["lift_n"].format(n=number)
            length = text_width(label, TICK.font, TICK.size)
            at = max(area.x, area.at(lift.end_s, 0)[0] - length - 2)
            if at > free_from:
                write_line(sheet, at, area.y + area.height - 6.5, label, TICK)
                free_from = at + length + 4


@dataclass(frozen=True)
class _Area:
    """A rectangle with axes: time and values to points."""

    x: float
    y: float
    width: float
    height: float
    span: tuple[float, float]
    low: float = 0.0
    high: float = 1.0

    @classmethod
    def over(
        cls, x: float, y: float, width: float, height: float, span: tuple[float, float]
    ) -> _Area:
        begin, end = span
        return cls(x, y, width, height, (begin, end if end > begin else begin + 1.0))

    def covering(self, extent: tuple[float, float]) -> _Area:
        """Return the same with values from the one to the other, and a little air above."""
        low, high = extent
        span = max(high - low, 1e-9)
        return _Area(self.x, self.y, self.width, self.height, self.span, low, high + 0.1 * span)

    def at(self, time: float, value: float) -> Point:
        """Return where a sample lies; times outside are moved to the border, values too."""
        share = (time - self.span[0]) / (self.span[1] - self.span[0])
        up = (value - self.low) / (self.high - self.low)
        return (
            self.x + self.width * min(1.0, max(0.0, share)),
            self.y + self.height * min(1.0, max(0.0, up)),
        )


def _draw_y_axis(sheet: Sheet, area: _Area) -> None:
    for tick in _nice_ticks(area.low, area.high, 3):
        y = area.at(area.span[0], tick)[1]
        sheet.polyline([(area.x, y), (area.x + area.width, y)], stroke=LINE, line=0.5)
        label = f"{tick:g}°".replace("-", "−")
        write_line(sheet, area.x - 3 - text_width(label, REGULAR, TICK.size), y - 2, label, TICK)


def _draw_time_axis(sheet: Sheet, area: _Area, title: str) -> None:
    end = area.x + area.width
    title_at = end - text_width(title, REGULAR, TICK.size)
    sheet.polyline([(area.x, area.y), (end, area.y)], stroke=QUIET, line=0.5)
    for tick in _nice_ticks(*area.span, 6):
        at = area.at(tick, 0.0)[0]
        label = f"{tick:g}"
        half = text_width(label, REGULAR, TICK.size) / 2
        sheet.polyline([(at, area.y), (at, area.y - 2)], stroke=QUIET, line=0.5)
        write_line(sheet, min(at - half, end - 2 * half), area.y - 9, label, TICK)
    write_line(sheet, title_at, area.y - 17, title, TICK)


def _nice_ticks(low: float, high: float, wanted: int) -> list[float]:
    """Return round numbers within a range, about so many steps."""
    rough = (high - low) / wanted
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 3, 5, 10) if m * power >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _draw_curve(sheet: Sheet, area: _Area, curve: Curve) -> None:
    is_there = np.isfinite(curve.value_deg)
    for run in _runs(is_there):
        time, value = curve.time_s[run], curve.value_deg[run]
        half = BAND_FACTOR * curve.sigma_deg[run]
        kept = _thin(value, max(2, round(MAX_BINS * value.size / max(is_there.size, 1))))
        for stretch in _runs(np.isfinite(half)):
            part = kept[(kept >= stretch.start) & (kept < stretch.stop)]
            upper = [area.at(time[i], value[i] + half[i]) for i in part]
            lower = [area.at(time[i], value[i] - half[i]) for i in part[::-1]]
            sheet.polygon([*upper, *lower], fill=curve.colour, alpha=0.16)
        line = [area.at(time[i], value[i]) for i in kept]
        if len(line) == 1:
            sheet.circle(*line[0], 0.8, fill=curve.colour)
        sheet.polyline(line, stroke=curve.colour, line=1.2, dash=curve.dash)


def _runs(is_there: NDArray[np.bool_]) -> list[slice]:
    """Return the stretches where `is_there` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], is_there, [False])).astype(int)))
    return [slice(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _thin(value: Array, n_bins: int) -> NDArray[np.intp]:
    """Return the samples to draw: ends, and lowest and highest of every bin; (N,) rising."""
    n = value.size
    if n <= 2 * n_bins:
        return np.arange(n)
    bounds = np.linspace(0, n, n_bins + 1).astype(int)
    kept = {0, n - 1}
    for start, stop in pairwise(bounds.tolist()):
        kept.add(start + int(np.argmin(value[start:stop])))
        kept.add(start + int(np.argmax(value[start:stop])))
    return np.array(sorted(kept))


def list_trunk_and_knees(
    angles: JointAngles, words: Words
) -> tuple[tuple[str, tuple[Curve, ...]], ...]:
    """Return the two charts of a trial: title and curves; what was not measured is empty."""
    trunk = _take_curve(angles, "trunk_inclination", "", LEFT)
    left = _take_curve(angles, "knee_flexion_l", words["left"], LEFT)
    right = _take_curve(angles, "knee_flexion_r", words["right"], RIGHT, (4.0, 2.0))
    return (words["trunk"], (trunk,)), (words["knees"], (left, right))


def _take_curve(
    angles: JointAngles, name: str, title: str, colour: str, dash: tuple[float, ...] = ()
) -> Curve:
    nothing = np.full(angles.time_s.shape, np.nan)
    is_known = name in angles.names
    value, sigma = (angles[name], angles.sigma(name)) if is_known else (nothing, nothing)
    return Curve(title, angles.time_s, value, sigma, colour, dash)


# --------------------------------------------------------------------------- trend


@dataclass(frozen=True)
class TrendPoint:
    """A lifting index with its interval at a date."""

    moment: datetime
    value: float
    interval: tuple[float, float]
    level: FlagLevel | None


@dataclass(frozen=True)
class TrendChart:
    """Lifting indices over time; what exceeds the axis ends in an arrow."""

    points: tuple[TrendPoint, ...]
    words: Words
    height_pt: float = 110.0

    def height(self, width: float) -> float:
        """Return its fixed height."""
        return self.height_pt

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw axes, the goal and one mark per trial."""
        times = [point.moment.timestamp() for point in self.points]
        area = _Area.over(
            x + 14, top - self.height_pt + 14, width - 14, self.height_pt - 18,
            _widen(min(times), max(times)),
        ).covering((0.0, self._highest()))  # fmt: skip
        with sheet.tag("Figure", alt=self._describe()):
            for tick in _nice_ticks(area.low, area.high, 4):
                y = area.at(times[0], tick)[1]
                sheet.polyline([(area.x, y), (area.x + area.width, y)], stroke=LINE, line=0.5)
                label = f"{tick:g}"
                write_line(
                    sheet, area.x - 4 - text_width(label, REGULAR, TICK.size), y - 2, label, TICK
                )
            goal = area.at(times[0], 1.0)[1]
            sheet.polyline(
                [(area.x, goal), (area.x + area.width, goal)], stroke=INK, line=0.8, dash=(3, 2)
            )
            for point, time in zip(self.points, times, strict=True):
                _draw_trend_point(sheet, area, point, time)
            self._draw_dates(sheet, area)

    def _highest(self) -> float:
        """Return the top of the axis: every value, and of wide ranges a part."""
        finite = [p.value for p in self.points if math.isfinite(p.value)]
        ends = [p.interval[1] for p in self.points if math.isfinite(p.interval[1])]
        peak = max(finite, default=2.0)
        return max(1.5, 1.05 * peak, min(max(ends, default=0.0), 1.5 * peak))

    def _describe(self) -> str:
        return self.words["alt_trend"].format(
            n=len(self.points),
            first=self.words.date(self.points[0].moment),
            last=self.words.date(self.points[-1].moment),
        )

    def _draw_dates(self, sheet: Sheet, area: _Area) -> None:
        first, last = (self.words.date(self.points[i].moment) for i in (0, -1))
        write_line(sheet, area.x, area.y - 10, first, TICK)
        if last != first:
            end = area.x + area.width - text_width(last, REGULAR, TICK.size)
            write_line(sheet, end, area.y - 10, last, TICK)


def _widen(first: float, last: float) -> tuple[float, float]:
    """Return a span with a little air on both sides, so that marks stay off the borders."""
    air = 0.03 * (last - first)
    return first - air, last + air


def _draw_trend_point(sheet: Sheet, area: _Area, point: TrendPoint, time: float) -> None:
    x, y = area.at(time, point.value if math.isfinite(point.value) else area.high)
    low, high = point.interval
    if math.isfinite(low):
        bottom = area.at(time, low)[1]
        reach = area.at(time, min(high, area.high))[1]
        sheet.polyline([(x, bottom), (x, reach)], stroke=QUIET, line=0.9)
        if high > area.high:
            tip = [(x - 2, reach - 3), (x, reach), (x + 2, reach - 3)]
            sheet.polyline(tip, stroke=QUIET, line=0.9)
    draw_level_shape(sheet, x - 3.5, y - 3.5, 7, point.level)
