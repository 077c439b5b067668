"""Blocks that know their height before they are drawn, so that a page never overflows.

Every block measures itself for a width (`height`) and draws itself below a given top (`draw`);
all lengths are points. Text wraps by words; where lines are limited, the last one ends with an
ellipsis instead of being clipped.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

from engine.report.fonts import BOLD, REGULAR, clean_text, text_width
from engine.report.sheet import Sheet

__all__ = [
    "BODY",
    "BRAND",
    "INK",
    "LINE",
    "QUIET",
    "SMALL",
    "SOFT",
    "Block",
    "Cell",
    "Columns",
    "Panel",
    "Paragraph",
    "Stack",
    "Style",
    "Table",
    "TableRow",
]

INK, QUIET, LINE, SOFT, BRAND = "#17212b", "#526170", "#d6dee6", "#f3f6f9", "#0b5d8f"
ELLIPSIS = "…"
ASCENT = 0.76
"""Height of capitals and accents above the base line, as a share of the font's size."""


class Block(Protocol):
    """Something with a height, to be drawn in a column."""

    def height(self, width: float) -> float:
        """Return the height it takes in a column of that width."""

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw it with its upper left corner at (x, top)."""


@dataclass(frozen=True)
class Style:
    """How text looks; `lead` is the distance of base lines, `lead_bold` makes bold."""

    size: float = 7.5
    lead: float = 10.0
    colour: str = INK
    is_bold: bool = False

    @property
    def font(self) -> str:
        """The name of the font."""
        return BOLD if self.is_bold else REGULAR

    @property
    def bold(self) -> Style:
        """The same in bold."""
        return replace(self, is_bold=True)

    @property
    def quiet(self) -> Style:
        """The same in grey."""
        return replace(self, colour=QUIET)


BODY = Style()
SMALL = Style(size=6.7, lead=8.7)

Run = tuple[str, Style]
_Line = tuple[tuple[str, Style], ...]


# --------------------------------------------------------------------------- text


@dataclass(frozen=True)
class Paragraph:
    """Text that wraps; `runs` may differ in weight and colour but share a size.

    Parameters
    ----------
    runs
        Text and style, one after the other.
    max_lines
        At most so many lines; None for all.
    role
        What it is in the structure tree; empty for none of its own (a cell of a table has one).
    align
        `right` for numbers.
    """

    runs: tuple[Run, ...]
    max_lines: int | None = None
    role: str = "P"
    align: Literal["left", "right"] = "left"

    @classmethod
    def of(cls, text: str, style: Style = BODY, **options: object) -> Paragraph:
        """Make a paragraph of one run."""
        return cls(((text, style),), **options)  # type: ignore[arg-type]

    def height(self, width: float) -> float:
        """Return the height of its lines."""
        return len(self._lines(width)) * self._lead

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Write the lines."""
        if not self.role:
            self._write(sheet, x, top, width)
            return
        with sheet.tag(self.role):
            self._write(sheet, x, top, width)

    def _write(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        size = self.runs[0][1].size
        y = top - 0.5 * (self._lead - size) - ASCENT * size - 0.06 * size
        for line in self._lines(width):
            length = sum(text_width(text, style.font, style.size) for text, style in line)
            start = x + (width - length if self.align == "right" else 0.0)
            for text, style in line:
                sheet.text(start, y, text, font=style.font, size=style.size, colour=style.colour)
                start += text_width(text, style.font, style.size)
            y -= self._lead

    @property
    def _lead(self) -> float:
        return self.runs[0][1].lead

    def _lines(self, width: float) -> tuple[_Line, ...]:
        return _wrap(self.runs, round(width, 2), self.max_lines)


@functools.lru_cache(maxsize=4096)
def _wrap(runs: tuple[Run, ...], width: float, max_lines: int | None) -> tuple[_Line, ...]:
    """Break runs into lines; a word wider than the column is broken anywhere."""
    words = [word for text, style in runs for word in _split(clean_text(text), style, width)]
    lines: list[list[Run]] = [[]]
    used = 0.0
    for text, style in words:
        gap = text_width(" ", style.font, style.size) if lines[-1] else 0.0
        length = text_width(text, style.font, style.size)
        if lines[-1] and used + gap + length > width:
            lines.append([])
            used = gap = 0.0
        lines[-1].append((" " + text if gap else text, style))
        used += gap + length
    if max_lines is not None and len(lines) > max_lines:
        lines = lines[:max_lines]
        lines[-1] = _shorten(lines[-1], width)
    return tuple(_join(line) for line in lines)


def _split(text: str, style: Style, width: float) -> list[Run]:
    pieces: list[Run] = []
    for word in text.split(" "):
        rest = word
        while rest and text_width(rest, style.font, style.size) > width:
            fits = _count_fitting(rest, style, width)
            pieces.append((rest[:fits], style))
            rest = rest[fits:]
        if rest:
            pieces.append((rest, style))
    return pieces


def _count_fitting(text: str, style: Style, width: float) -> int:
    """Return how many characters fit; at least one, so that the work ends."""
    low, high = 1, len(text)
    while low < high:
        middle = (low + high + 1) // 2
        if text_width(text[:middle], style.font, style.size) <= width:
            low = middle
        else:
            high = middle - 1
    return low


def _shorten(line: list[Run], width: float) -> list[Run]:
    """End a line with an ellipsis, dropping what stands in its place."""
    while line:
        text, style = line[-1]
        others = sum(text_width(t, s.font, s.size) for t, s in line[:-1])
        room = width - others - text_width(ELLIPSIS, style.font, style.size)
        if text_width(text, style.font, style.size) <= room:
            return [*line[:-1], (text.rstrip(" ,;:.") + ELLIPSIS, style)]
        if len(line) == 1:
            kept = text[: _count_fitting(text, style, max(room, 0.0))]
            if text_width(kept, style.font, style.size) > room:
                kept = ""  # not even one character fits beside it
            return [(kept + ELLIPSIS, style)]
        line = line[:-1]
    return line


def _join(line: list[Run]) -> _Line:
    """Put neighbours of one style together: fewer and longer pieces are better to select."""
    joined: list[Run] = []
    for text, style in line:
        if joined and joined[-1][1] == style:
            joined[-1] = (joined[-1][0] + text, style)
        else:
            joined.append((text, style))
    return tuple(joined)


# --------------------------------------------------------------------------- arrangement


@dataclass(frozen=True)
class Stack:
    """Blocks below each other; `role` groups them in the structure tree."""

    blocks: tuple[Block, ...]
    gap: float = 0.0
    role: str = ""

    def height(self, width: float) -> float:
        """Return the sum of the heights and gaps."""
        heights = [block.height(width) for block in self.blocks]
        return sum(heights) + self.gap * max(0, len(heights) - 1)

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw one after the other."""
        if self.role:
            with sheet.group(self.role):
                self._draw(sheet, x, top, width)
        else:
            self._draw(sheet, x, top, width)

    def _draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        for block in self.blocks:
            block.draw(sheet, x, top, width)
            top -= block.height(width) + self.gap


@dataclass(frozen=True)
class Columns:
    """Blocks beside each other; `shares` are relative widths, negative ones fixed points."""

    blocks: tuple[Block, ...]
    shares: tuple[float, ...]
    gap: float = 14.0

    def height(self, width: float) -> float:
        """Return the height of the highest."""
        pairs = zip(self.blocks, self._widths(width), strict=True)
        return max(block.height(own) for block, own in pairs)

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw them from left to right, tops aligned."""
        for block, own in zip(self.blocks, self._widths(width), strict=True):
            block.draw(sheet, x, top, own)
            x += own + self.gap

    def _widths(self, width: float) -> list[float]:
        fixed = -sum(share for share in self.shares if share < 0)
        free = width - fixed - self.gap * (len(self.shares) - 1)
        total = sum(share for share in self.shares if share > 0)
        return [-share if share < 0 else free * share / total for share in self.shares]


@dataclass(frozen=True)
class Panel:
    """A block in a frame, with a bar of colour on its left where `tone` is given."""

    block: Block
    tone: str | None = None
    fill: str | None = None
    padding: float = 9.0
    bar: float = 4.0

    def height(self, width: float) -> float:
        """Return the height with the padding."""
        return self.block.height(self._inner(width)) + 2 * self.padding

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw frame, bar and content."""
        height = self.height(width)
        sheet.rectangle(x, top - height, width, height, fill=self.fill, stroke=LINE, radius=3)
        if self.tone:
            sheet.rectangle(x, top - height, self.bar, height, fill=self.tone)
        left = x + self.padding + (self.bar if self.tone else 0.0)
        self.block.draw(sheet, left, top - self.padding, self._inner(width))

    def _inner(self, width: float) -> float:
        return width - 2 * self.padding - (self.bar if self.tone else 0.0)


# --------------------------------------------------------------------------- tables

Cell = Paragraph
"""A cell is a paragraph without a role of its own, or any block that tags nothing."""


@dataclass(frozen=True)
class TableRow:
    """One row; a `fill` sets it off, `shares` of its own let a cell span columns."""

    cells: tuple[Block, ...]
    fill: str | None = None
    shares: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Table:
    """Rows under a head; each row is as high as its highest cell.

    Parameters
    ----------
    head
        Titles of the columns.
    rows
        The cells, as blocks without a role.
    shares
        Relative widths of the columns; negative ones are fixed points.
    head_shares
        Widths of the titles where they span columns; None for those of the columns.
    """

    head: tuple[str, ...]
    rows: tuple[TableRow, ...]
    shares: tuple[float, ...]
    head_shares: tuple[float, ...] | None = None
    gap: float = 8.0
    padding: float = 1.5
    head_style: Style = field(default_factory=lambda: SMALL.quiet.bold)

    def height(self, width: float) -> float:
        """Return the height of head and rows."""
        return self.head_height(width) + sum(self.row_height(row, width) for row in self.rows)

    def head_height(self, width: float) -> float:
        """Return the height of the head, its line included."""
        return self.row_height(self._head_row(), width)

    def row_height(self, row: TableRow, width: float) -> float:
        """Return the height of one row."""
        return self._columns(row).height(width) + 2 * self.padding

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw head, lines and rows."""
        with sheet.group("Table"):
            self._draw_row(sheet, self._head_row(), x, top, width, role="TH")
            top -= self.head_height(width)
            for row in self.rows:
                height = self.row_height(row, width)
                if row.fill:
                    sheet.rectangle(x - 4, top - height, width + 8, height, fill=row.fill)
                sheet.polyline([(x, top), (x + width, top)], stroke=LINE, line=0.5)
                self._draw_row(sheet, row, x, top, width, role="TD")
                top -= height

    def _draw_row(
        self, sheet: Sheet, row: TableRow, x: float, top: float, width: float, role: str
    ) -> None:
        with sheet.group("TR"):
            tagged = replace(row, cells=tuple(_Tagged(cell, role) for cell in row.cells))
            self._columns(tagged).draw(sheet, x, top - self.padding, width)

    def _columns(self, row: TableRow) -> Columns:
        return Columns(row.cells, row.shares or self.shares, gap=self.gap)

    def _head_row(self) -> TableRow:
        cells = (Paragraph.of(title, self.head_style, role="") for title in self.head)
        return TableRow(tuple(cells), shares=self.head_shares)


@dataclass(frozen=True)
class _Tagged:
    """A block under a tag of its own."""

    block: Block
    role: str

    def height(self, width: float) -> float:
        return self.block.height(width)

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        with sheet.tag(self.role):
            self.block.draw(sheet, x, top, width)
