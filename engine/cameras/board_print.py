"""Boards to print: drawn in millimetres, so that a print at 100 % has the stated squares."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from engine.cameras._board_views import BoardSpec, make_aruco_board
from engine.errors import ConfigError

__all__ = ["BoardPrint", "draw_board", "paper_board"]

PAPERS_MM = {"a4": (297.0, 210.0), "a3": (420.0, 297.0), "letter": (279.4, 215.9)}
"""Landscape: width and height."""
PAPER_BOARDS = {"a4": (6, 4, 43.0), "a3": (6, 4, 64.0), "letter": (6, 4, 42.0)}
"""Columns, rows and squares in mm: few and large, to be read from across a room."""
MARGIN_MM = 5.0
RULER_MM = 100.0
DOTS_PER_MM = 300 / 25.4
_POINTS_PER_MM = 72 / 25.4


@dataclass(frozen=True)
class BoardPrint:
    """A sheet in mm.

    `black` are rectangles (left, top, width, height), `texts` lines (left, base, text).
    """

    size_mm: tuple[float, float]
    black: tuple[tuple[float, float, float, float], ...]
    texts: tuple[tuple[float, float, str], ...]


def paper_board(paper: str, kind: str = "charuco") -> BoardSpec:
    """Return the board that fits a paper best.

    Raises
    ------
    ConfigError
        If the paper is unknown.
    """
    key = _require_paper(paper)
    columns, rows, square_mm = PAPER_BOARDS[key]
    if kind == "checkerboard":
        # An odd and an even number tell which way round the board lies.
        columns, square_mm = columns + 1, np.floor(square_mm * columns / (columns + 1))
    return BoardSpec(
        kind="checkerboard" if kind == "checkerboard" else "charuco",
        columns=columns,
        rows=rows,
        square_m=float(square_mm) / 1000.0,
    )


def draw_board(board: BoardSpec, path: Path, *, paper: str = "a3") -> bytes:
    """Draw a board for printing.

    Parameters
    ----------
    board
        What to draw.
    path
        Where it will be written: its ending chooses `.pdf`, `.svg` or `.png` (300 dots an inch).
    paper
        `a4`, `a3` or `letter`, landscape.

    Returns
    -------
    bytes
        The file's content.

    Raises
    ------
    ConfigError
        If the board is larger than the paper, or the ending is another.
    """
    sheet = lay_out(board, paper)
    writers = {".pdf": _to_pdf, ".svg": _to_svg, ".png": _to_png}
    if path.suffix.lower() not in writers:
        raise ConfigError(f"A board is drawn as .pdf, .svg or .png, got {path.name!r}.")
    return writers[path.suffix.lower()](sheet)


def lay_out(board: BoardSpec, paper: str) -> BoardPrint:
    """Place the board in the middle of a sheet, with a ruler and its description below."""
    width, height = PAPERS_MM[_require_paper(paper)]
    square = board.square_m * 1000.0
    size = (board.columns * square, board.rows * square)
    text_mm = 12.0
    if size[0] > width - 2 * MARGIN_MM or size[1] > height - 2 * MARGIN_MM - text_mm:
        raise ConfigError(
            f"A board of {size[0]:g} x {size[1]:g} mm does not fit {paper} "
            f"({width:g} x {height:g} mm with margins); use fewer or smaller squares."
        )
    left, top = (width - size[0]) / 2, (height - text_mm - size[1]) / 2
    black = [(left + x, top + y, w, h) for x, y, w, h in _black_parts(board, square)]
    line = top + size[1] + 7.0
    black.append((left, line, RULER_MM, 0.6))
    black += [(left + x, line - 1.5, 0.4, 3.6) for x in (0.0, RULER_MM - 0.4)]
    what = f"{board.kind}, {board.columns} x {board.rows} squares of {square:g} mm"
    if board.kind == "charuco":
        what += f", markers {board.marker_side_m * 1000:g} mm, {board.dictionary}"
    texts = (
        (left + RULER_MM + 4.0, line - 1.0, f"The line is {RULER_MM:g} mm. Print at 100 %."),
        (left + RULER_MM + 4.0, line + 3.0, what),
    )
    return BoardPrint((width, height), tuple(black), texts)


def _require_paper(paper: str) -> str:
    key = paper.lower()
    if key not in PAPERS_MM:
        raise ConfigError(f"The paper must be one of {', '.join(PAPERS_MM)}, got {paper!r}.")
    return key


def _black_parts(board: BoardSpec, square: float) -> Iterator[tuple[float, float, float, float]]:
    for row in range(board.rows):
        for column in range(board.columns):
            if (row + column) % 2 == 0:
                yield column * square, row * square, square, square
    if board.kind == "charuco":
        yield from _marker_parts(board)


def _marker_parts(board: BoardSpec) -> Iterator[tuple[float, float, float, float]]:
    aruco = make_aruco_board(board)
    dictionary = aruco.getDictionary()
    bits = dictionary.markerSize + 2
    for corners, number in zip(aruco.getObjPoints(), aruco.getIds().ravel(), strict=True):
        left, top = np.asarray(corners, dtype=np.float64)[0, :2] * 1000.0
        module = board.marker_side_m * 1000.0 / bits
        picture = cv2.aruco.generateImageMarker(dictionary, int(number), bits, borderBits=1)
        for row, column in np.argwhere(np.asarray(picture) == 0):
            yield left + column * module, top + row * module, module, module


def _to_svg(sheet: BoardPrint) -> bytes:
    width, height = sheet.size_mm
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="0 0 {width:g} {height:g}" shape-rendering="crispEdges">'
    )
    lines = [
        head,
        f'<rect width="{width:g}" height="{height:g}" fill="white"/>',
        *(
            f'<rect x="{x:.4f}" y="{y:.4f}" width="{w:.4f}" height="{h:.4f}"/>'
            for x, y, w, h in sheet.black
        ),
        *(
            f'<text x="{x:.2f}" y="{y:.2f}" font-family="sans-serif" font-size="3">{text}</text>'
            for x, y, text in sheet.texts
        ),
        "</svg>",
    ]
    return ("\n".join(lines) + "\n").encode()


def _to_pdf(sheet: BoardPrint) -> bytes:
    # Takes long to import.
    from reportlab.pdfgen.canvas import Canvas

    width, height = (side * _POINTS_PER_MM for side in sheet.size_mm)
    buffer = io.BytesIO()
    canvas = Canvas(buffer, pagesize=(width, height), invariant=1)
    canvas.setTitle("Calibration board")
    # Viewers must not shrink the sheet to their printer's margins.
    canvas.setViewerPreference("PrintScaling", "None")
    canvas.scale(_POINTS_PER_MM, _POINTS_PER_MM)
    for x, y, w, h in sheet.black:
        canvas.rect(x, sheet.size_mm[1] - y - h, w, h, stroke=0, fill=1)
    canvas.setFont("Helvetica", 3)
    for x, y, text in sheet.texts:
        canvas.drawString(x, sheet.size_mm[1] - y, text)
    canvas.showPage()
    canvas.save()
    return buffer.getvalue()


def _to_png(sheet: BoardPrint) -> bytes:
    from PIL import Image, ImageDraw, ImageFont

    size = (round(sheet.size_mm[0] * DOTS_PER_MM), round(sheet.size_mm[1] * DOTS_PER_MM))
    image = Image.new("L", size, 255)
    draw = ImageDraw.Draw(image)
    for x, y, w, h in sheet.black:
        edges = [round(v * DOTS_PER_MM) for v in (x, y, x + w, y + h)]
        draw.rectangle((edges[0], edges[1], edges[2] - 1, edges[3] - 1), fill=0)
    font = ImageFont.load_default(size=3 * DOTS_PER_MM)
    for x, y, text in sheet.texts:
        draw.text((x * DOTS_PER_MM, y * DOTS_PER_MM), text, fill=0, font=font, anchor="ls")
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", dpi=(300, 300))
    return buffer.getvalue()
