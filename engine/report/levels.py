"""Levels and shares: shapes that never rely on colour alone, and bars of counts."""

from __future__ import annotations

import math
from dataclasses import dataclass

from engine.datatypes import FlagLevel
from engine.report.fonts import BOLD, text_width
from engine.report.layout import BRAND, QUIET, SMALL, Style
from engine.report.sheet import Sheet
from engine.report.wording import Words
from engine.wording import LEVEL_COLOURS

__all__ = [
    "LEFT",
    "LEVEL_COLOURS",
    "RIGHT",
    "TICK",
    "Chip",
    "CoverageBar",
    "LevelBar",
    "draw_level_shape",
    "write_line",
]

LEFT, RIGHT = "#0072b2", "#c24e00"
"""The subject's sides, in Okabe and Ito's colours."""
TICK = Style(size=6.0, lead=7.5, colour=QUIET)


def write_line(sheet: Sheet, x: float, y: float, text: str, style: Style) -> None:
    """Write one line from `x` on, its base line at `y`."""
    sheet.text(x, y, text, font=style.font, size=style.size, colour=style.colour)


def draw_level_shape(
    sheet: Sheet, x: float, y: float, size: float, level: FlagLevel | None
) -> None:
    """Draw the shape of a level with its lower left corner at (x, y): never colour alone."""
    colour = LEVEL_COLOURS[level]
    half = size / 2
    cx, cy = x + half, y + half
    if level is FlagLevel.HIGH:
        turns = [math.pi * (2 * k + 1) / 8 for k in range(8)]
        octagon = [(cx + 1.06 * half * math.cos(a), cy + 1.06 * half * math.sin(a)) for a in turns]
        sheet.polygon(octagon, fill=colour)
        _draw_exclamation(sheet, cx, cy, size)
    elif level is FlagLevel.REVIEW:
        triangle = [(x - 0.04 * size, y), (x + 1.04 * size, y), (cx, y + size)]
        sheet.polygon(triangle, fill=colour)
        _draw_exclamation(sheet, cx, cy - 0.12 * size, 0.8 * size)
    elif level is FlagLevel.OK:
        sheet.circle(cx, cy, half, fill=colour)
        check = [
            (cx - 0.26 * size, cy + 0.01 * size),
            (cx - 0.08 * size, cy - 0.19 * size),
            (cx + 0.27 * size, cy + 0.2 * size),
        ]
        sheet.polyline(check, stroke="#ffffff", line=0.12 * size)
    else:
        sheet.circle(cx, cy, 0.44 * size, stroke=colour, line=0.1 * size)
        bar = [(cx - 0.2 * size, cy), (cx + 0.2 * size, cy)]
        sheet.polyline(bar, stroke=colour, line=0.1 * size)


def _draw_exclamation(sheet: Sheet, cx: float, cy: float, size: float) -> None:
    stem = [(cx, cy + 0.28 * size), (cx, cy - 0.05 * size)]
    sheet.polyline(stem, stroke="#ffffff", line=0.12 * size)
    sheet.circle(cx, cy - 0.25 * size, 0.07 * size, fill="#ffffff")


@dataclass(frozen=True)
class Chip:
    """A level as shape and word; tags nothing, so that it may stand in a cell."""

    level: FlagLevel | None
    word: str
    style: Style = SMALL

    def height(self, width: float) -> float:
        """Return the height of one line."""
        return self.style.lead

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw shape and word on one base line."""
        size = self.style.size
        baseline = top - 0.5 * (self.style.lead - size) - 0.82 * size
        draw_level_shape(sheet, x, baseline - 0.14 * size, 1.05 * size, self.level)
        sheet.text(
            x + 1.5 * size, baseline, self.word, font=BOLD, size=size,
            colour=LEVEL_COLOURS[self.level],
        )  # fmt: skip


# --------------------------------------------------------------------------- shares


@dataclass(frozen=True)
class CoverageBar:
    """How much of the body was seen: a bar with the shares in words below it."""

    shares: tuple[tuple[str, str, float], ...]  # key, word, share 0 to 1
    words: Words

    def height(self, width: float) -> float:
        """Return its fixed height."""
        return 19.0

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw the bar, each part with a pattern of its own."""
        shown = ", ".join(f"{word} {share:.0%}" for _, word, share in self.shares)
        with sheet.tag("Figure", alt=self.words["alt_coverage"].format(shares=shown)):
            at, total = x, sum(share for *_, share in self.shares) or 1.0
            for key, _, share in self.shares:
                part = width * share / total
                _fill_share(sheet, key, at, top - 7, part, 7)
                at += part
            at = x
            for key, word, share in self.shares:
                label = f"{share:.0%} {word}".replace("%", "\u00a0%")
                _fill_share(sheet, key, at, top - 16.5, 6, 6)
                write_line(sheet, at + 9, top - 16, label, TICK)
                at += 9 + text_width(label, TICK.font, TICK.size) + 9


def _fill_share(sheet: Sheet, key: str, x: float, y: float, width: float, height: float) -> None:
    if width <= 0:
        return
    fills = {"measured": BRAND, "repaired": "#7fb2d1", "filled": "#e0a070"}
    sheet.rectangle(x, y, width, height, fill=fills.get(key, "#ffffff"), stroke=QUIET, line=0.4)
    if key == "filled":
        for k in range(int(width // 3) + 1):
            left = x + 3 * k
            right = min(left + 3, x + width)
            rise = height * (right - left) / 3
            sheet.polyline([(left, y), (right, y + rise)], stroke="#ffffff", line=0.7)


@dataclass(frozen=True)
class LevelBar:
    """Counts per level as one bar, with shape, word and number below."""

    counts: tuple[tuple[FlagLevel | None, int], ...]
    words: Words
    noun: str = "lift"
    """Key of the noun in the wording: what is counted."""

    def height(self, width: float) -> float:
        """Return its fixed height."""
        return 15.0 + 12.0 * len(self.counts)

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw the bar and its legend."""
        total = sum(count for _, count in self.counts)
        with sheet.tag("Figure", alt=self.describe()):
            at = x
            for level, count in self.counts:
                part = width * count / total if total else 0.0
                if part:
                    sheet.rectangle(
                        at, top - 11, part, 11, fill=LEVEL_COLOURS[level], stroke="#ffffff"
                    )
                at += part
            y = top - 24
            for level, count in self.counts:
                draw_level_shape(sheet, x, y - 1.4, 8, level)
                share = f" ({count / total:.0%})".replace("%", "\u00a0%") if total else ""
                label = f"{self.words.level(level)}: {self.words.count(count, self.noun)}{share}"
                write_line(sheet, x + 12, y, label, SMALL)
                y -= 12

    def describe(self) -> str:
        """Return in words what the bar shows."""
        parts = (f"{self.words.level(level)} {count}" for level, count in self.counts)
        return self.words["alt_shares"].format(shares=", ".join(parts))
