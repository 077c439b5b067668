"""A printed board must have the stated squares, and be found again."""

from __future__ import annotations

import io
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from pypdf import PdfReader

from engine.cameras._board_views import BoardSpec, collect_views
from engine.cameras.board_print import DOTS_PER_MM, PAPERS_MM, draw_board, lay_out, paper_board
from engine.datatypes import Frame
from engine.errors import ConfigError


@pytest.mark.parametrize("kind", ["charuco", "checkerboard"])
@pytest.mark.parametrize("paper", list(PAPERS_MM))
def test_the_board_of_each_paper_fits_it_and_tells_which_way_round_it_lies(paper, kind):
    board = paper_board(paper, kind)
    sheet = lay_out(board, paper)
    right = max(x + w for x, _, w, _ in sheet.black)
    bottom = max(y + h for _, y, _, h in sheet.black)
    assert min(x for x, *_ in sheet.black) >= 5.0
    assert right <= sheet.size_mm[0] - 5.0
    assert bottom <= sheet.size_mm[1] - 3.0
    assert not board.is_symmetric


@pytest.mark.parametrize("kind", ["charuco", "checkerboard"])
def test_a_drawn_board_is_found_with_squares_of_the_stated_size(kind):
    board = paper_board("a3", kind)
    picture = Image.open(io.BytesIO(draw_board(board, Path("board.png"), paper="a3")))
    assert picture.info["dpi"] == pytest.approx((300, 300), abs=0.1)
    image = np.asarray(picture)
    small = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    frame = Frame(0, 0.0, np.repeat(small[..., None], 3, axis=2))
    view = collect_views([frame], board, "scan").views[0]
    assert len(view.rows) == len(board.corners)
    across = (
        view.pixels[view.rows.argsort()][board.columns - 2] - view.pixels[view.rows.argsort()][0]
    )
    square_mm = np.linalg.norm(across) / (board.columns - 2) / (0.25 * DOTS_PER_MM)
    assert square_mm == pytest.approx(board.square_m * 1000, rel=0.002)


def test_pdf_and_svg_have_the_size_of_the_paper_and_the_same_rectangles():
    board = paper_board("a4")
    page = PdfReader(io.BytesIO(draw_board(board, Path("b.pdf"), paper="a4"))).pages[0]
    assert float(page.mediabox.width) * 25.4 / 72 == pytest.approx(297.0)
    assert "Print at 100 %" in page.extract_text()
    svg = draw_board(board, Path("b.SVG"), paper="a4").decode()
    assert 'width="297mm" height="210mm"' in svg
    drawn = len(re.findall(r"<rect x=", svg))
    assert drawn == len(lay_out(board, "a4").black)


@pytest.mark.parametrize(
    ("board", "name", "paper", "said"),
    [
        (BoardSpec(square_m=0.1), "b.pdf", "a4", "does not fit a4"),
        (BoardSpec(square_m=0.04), "b.docx", "a4", "as .pdf, .svg or .png"),
        (BoardSpec(square_m=0.04), "b.pdf", "a9", "one of a4, a3, letter"),
    ],
)
def test_what_cannot_be_drawn_is_refused(board, name, paper, said):
    with pytest.raises(ConfigError, match=said):
        draw_board(board, Path(name), paper=paper)
