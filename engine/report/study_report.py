"""A validation study as PDF: what was found, Tables 1 to 3, Figures 2 to 5, and how it was done."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

from engine.report.fonts import clean_text
from engine.report.layout import BODY, SMALL, Block, Paragraph, Stack, Style, Table, TableRow
from engine.report.parts import FOOT, HEADING, TITLE, VERDICT
from engine.report.sheet import Paper, Properties, Sheet
from engine.validation.protocol.figures import FIGURE_WORDS
from engine.validation.protocol.report import FIGURE_ORDER, StudyReport
from engine.validation.protocol.tables import PrintedTable

__all__ = ["render_study_pdf"]

MARGIN, BOTTOM, GAP = 36.0, 26.0, 12.0
MAX_ROWS = 40
"""A longer table goes on under a head of its own."""
CELL = Style(size=6.4, lead=8.2)
HEAD = Style(size=6.2, lead=8.0, is_bold=True)
FIRST_SHARE = 1.3
"""The first column of a table has names, which are longer than numbers."""


@dataclass(frozen=True)
class _Picture:
    """A PNG over the whole width, with a description."""

    png: bytes
    words: str

    def height(self, width: float) -> float:
        columns, rows = struct.unpack(">II", self.png[16:24])
        return float(width * rows / columns)

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        height = self.height(width)
        with sheet.tag("Figure", alt=self.words):
            sheet.image(self.png, x, top - height, width, height)


def render_study_pdf(report: StudyReport, *, paper: Paper = "a4") -> bytes:
    """Return a study as PDF; the same study gives the same bytes.

    Parameters
    ----------
    report
        What page and PDF show.
    paper
        `a4` or `letter`.
    """
    moment = datetime.fromisoformat(report.created) if report.created else None
    sheet = Sheet(
        paper=paper,
        properties=Properties(
            title=clean_text(report.title),
            subject=clean_text(report.lead[0][:200]),
            language="en",
            moment=moment,
            keywords=("validation", "marker-based motion capture", "manual lifting"),
        ),
    )
    width = sheet.width - 2 * MARGIN
    top = sheet.height - MARGIN
    pages = list(_fill(_blocks(report), top - BOTTOM - 14.0, width))
    for number, page in enumerate(pages, start=1):
        page.draw(sheet, MARGIN, top, width)
        words = f"{clean_text(report.title)} · {report.made} · page {number} of {len(pages)}"
        foot = Paragraph.of(words, FOOT, max_lines=1)
        foot.draw(sheet, MARGIN, BOTTOM + foot.height(width), width)
        sheet.end_page()
    return sheet.to_bytes()


def _fill(blocks: Iterator[Block], room: float, width: float) -> Iterator[Stack]:
    """Put as many blocks on each page as it holds."""
    page: list[Block] = []
    used = 0.0
    for block in blocks:
        height = block.height(width)
        if page and used + GAP + height > room:
            yield Stack(tuple(page), gap=GAP)
            page, used = [], 0.0
        used += height + (GAP if page else 0.0)
        page.append(block)
    if page:
        yield Stack(tuple(page), gap=GAP)


def _blocks(report: StudyReport) -> Iterator[Block]:
    lead, *others = report.lead
    yield Stack(
        (
            Paragraph.of(report.title, TITLE, role="H1"),
            Paragraph.of(report.made, BODY.quiet),
            Paragraph.of(lead, VERDICT),
            *(Paragraph.of(sentence) for sentence in others),
        ),
        gap=5.0,
    )
    figures = [name for name in FIGURE_ORDER if name in report.figures]
    yield from _tables(report, ("table1", "table2", "table3"))
    yield from (_figure(report, name) for name in figures[:4])
    yield from _tables(report, [n for n in report.tables if not n.startswith("table")])
    yield from (_figure(report, name) for name in figures[4:])
    notes = tuple(Paragraph.of(note, SMALL) for note in report.notes)
    yield Stack((Paragraph.of("How it was done", HEADING, role="H2"), *notes), gap=4.0)


def _tables(report: StudyReport, names: Sequence[str]) -> Iterator[Block]:
    for name in names:
        table = report.tables[name]
        for start in range(0, max(len(table.rows), 1), MAX_ROWS):
            rows = table.rows[start : start + MAX_ROWS]
            is_last = start + MAX_ROWS >= len(table.rows)
            yield _table(table, rows, "" if start == 0 else " (continued)", is_last=is_last)


def _table(
    table: PrintedTable, rows: Sequence[tuple[str, ...]], tail: str, *, is_last: bool
) -> Stack:
    cells = tuple(TableRow(tuple(_cell(text) for text in row)) for row in rows)
    shares = (FIRST_SHARE, *[1.0] * (len(table.head) - 1))
    notes = [Paragraph.of(note, SMALL.quiet) for note in table.notes] if is_last else []
    return Stack(
        (
            Paragraph.of(table.title + tail, HEADING, role="H2"),
            Table(table.head, cells, shares, head_style=HEAD.quiet),
            *notes,
        ),
        gap=3.0,
    )


def _cell(text: str) -> Paragraph:
    return Paragraph.of(text, CELL, role="")


def _figure(report: StudyReport, name: str) -> Stack:
    words = FIGURE_WORDS[name]
    return Stack(
        (Paragraph.of(words, HEADING, role="H2"), _Picture(report.figures[name], words)), gap=3.0
    )
