"""Blocks take the height they say, and text is never clipped or lost."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.report.fonts import REGULAR, text_width
from engine.report.layout import BODY, SMALL, Columns, Paragraph, Stack, Table, TableRow, _wrap

SENTENCE = "The load is far from the body at the origin and low above the floor"


def lines_of(text, width, max_lines=None):
    wrapped = _wrap(((text, BODY),), width, max_lines)
    return ["".join(piece for piece, _ in line) for line in wrapped]


@given(
    st.lists(st.text("abcdefghiWM.,-äß", min_size=1, max_size=30), min_size=1, max_size=30),
    st.floats(30, 300),
)
def test_wrapped_lines_fit_and_hold_every_letter(words, width):
    lines = lines_of(" ".join(words), width)
    assert all(text_width(line, REGULAR, BODY.size) <= width + 1e-6 for line in lines)
    assert "".join(lines).replace(" ", "") == "".join(words)


@pytest.mark.parametrize("max_lines", [1, 2, 3])
@pytest.mark.parametrize("width", [12.0, 40.0, 70.0])
def test_what_is_cut_ends_with_an_ellipsis_and_fits(width, max_lines):
    lines = lines_of(SENTENCE, width, max_lines)
    assert len(lines) == max_lines
    assert lines[-1].endswith("…")
    assert all(text_width(line, REGULAR, BODY.size) <= width + 1e-6 for line in lines)


def test_text_that_fits_is_not_cut():
    assert lines_of("two words", 100.0, 1) == ["two words"]


def test_runs_share_lines():
    lines = _wrap((("bold", BODY.bold), ("and quiet", BODY.quiet)), 200.0, None)
    assert [[text for text, _ in line] for line in lines] == [["bold", " and quiet"]]


def test_an_empty_text_takes_one_line():
    assert Paragraph.of("").height(100.0) == BODY.lead


def test_a_stack_is_the_sum_and_columns_the_highest():
    one, two = Paragraph.of("a"), Paragraph.of("a b", max_lines=None)
    assert Stack((one, one), gap=3.0).height(50.0) == 2 * BODY.lead + 3.0
    assert Columns((one, two), (1.0, -5.0), gap=0.0).height(100.0) == 2 * BODY.lead


def test_a_table_is_as_high_as_its_rows():
    cells = (Paragraph.of("x", SMALL, role=""), Paragraph.of("y " * 40, SMALL, role=""))
    table = Table(("A", "B"), (TableRow(cells), TableRow(cells)), (1.0, 1.0))
    rows = sum(table.row_height(row, 100.0) for row in table.rows)
    assert table.height(100.0) == pytest.approx(table.head_height(100.0) + rows)
    assert table.row_height(table.rows[0], 100.0) > 2 * SMALL.lead
