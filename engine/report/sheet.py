"""A PDF document with a structure tree: what is drawn carries what it is.

Screen readers and text search follow the tree: headings, paragraphs, lists, tables,
and figures with a description. Everything outside of a tag is marked as decoration. The same
content gives the same bytes: times come from the caller, never from the clock.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

from reportlab.lib.colors import HexColor
from reportlab.lib.utils import ImageReader
from reportlab.pdfbase import pdfdoc
from reportlab.pdfgen.canvas import Canvas

from engine.errors import ConfigError
from engine.report.fonts import clean_text, register_fonts
from engine.version import __version__

__all__ = ["PAPERS", "Paper", "Point", "Properties", "Sheet", "select_paper"]

Point = tuple[float, float]
Paper = Literal["a4", "letter"]

PAPERS: Mapping[str, Point] = {"a4": (595.276, 841.890), "letter": (612.0, 792.0)}
"""Width and height in points (1/72 inch)."""


def select_paper(name: str) -> Paper:
    """Return the paper of that name.

    Raises
    ------
    ConfigError
        If there is none.
    """
    papers: tuple[Paper, ...] = ("a4", "letter")
    for paper in papers:
        if name.strip().lower() == paper:
            return paper
    raise ConfigError(f"The paper must be one of {', '.join(PAPERS)}, got {name!r}.")


@dataclass(frozen=True)
class Properties:
    """What the document says of itself; `moment` (UTC) is written as its date."""

    title: str
    subject: str
    language: str
    moment: datetime | None = None
    keywords: tuple[str, ...] = ()


@dataclass
class _Element:
    """A node of the structure tree: its own marks on the pages, or further nodes."""

    role: str
    parent: _Element | None
    alt: str = ""
    attributes: Mapping[str, str] = field(default_factory=dict)
    children: list[_Element] = field(default_factory=list)
    marks: list[tuple[int, int]] = field(default_factory=list)  # page, number on the page


class Sheet:
    """Draws on the pages of one document; y grows upward, in points.

    Parameters
    ----------
    paper
        Size of the pages.
    properties
        Title, subject, language and date.
    """

    def __init__(self, *, paper: Paper, properties: Properties) -> None:
        register_fonts()
        self.width, self.height = PAPERS[paper]
        self._buffer = io.BytesIO()
        self._canvas = Canvas(
            self._buffer,
            pagesize=(self.width, self.height),
            invariant=1,
            pageCompression=1,
            pdfVersion=(1, 7),
            lang=properties.language,
        )
        self._describe(properties)
        self._root = _Element("Document", None)
        self._open = self._root
        self._is_marked = False
        self._page = 0
        self._n_marks = 0

    def _describe(self, properties: Properties) -> None:
        canvas = self._canvas
        canvas.setTitle(properties.title)
        canvas.setSubject(properties.subject)
        canvas.setAuthor(f"LiftLens {__version__}")
        canvas.setCreator(f"LiftLens {__version__}")
        canvas.setProducer("ReportLab")
        canvas.setKeywords(list(properties.keywords))
        canvas.setViewerPreference("DisplayDocTitle", "true")
        if properties.moment is not None:
            stamp = canvas._doc._timeStamp  # ReportLab has no public way to set the date
            moment = properties.moment.astimezone(UTC)
            stamp.YMDhms = moment.timetuple()[:6]
            stamp.dhh = stamp.dmm = 0

    # ----------------------------------------------------------------------- structure

    @contextlib.contextmanager
    def group(self, role: str) -> Iterator[None]:
        """Put what is tagged inside under one node, such as `Table`, `TR` or `L`."""
        outer = self._open
        element = _Element(role, outer)
        outer.children.append(element)
        self._open = element
        try:
            yield
        finally:
            self._open = outer

    @contextlib.contextmanager
    def tag(self, role: str, *, alt: str = "") -> Iterator[None]:
        """Say what is drawn inside: `H1`, `P`, `TD`, or `Figure` with its description."""
        attributes = {"O": "Table", "Scope": "Column"} if role == "TH" else {}
        element = _Element(role, self._open, clean_text(alt), attributes)
        self._open.children.append(element)
        element.marks.append((self._page, self._n_marks))
        self._canvas._code.append(f"/{role} <</MCID {self._n_marks}>> BDC")
        self._n_marks += 1
        self._is_marked = True
        try:
            yield
        finally:
            self._is_marked = False
            self._canvas._code.append("EMC")

    @contextlib.contextmanager
    def _marked(self) -> Iterator[None]:
        """Mark what is drawn outside of any tag as decoration."""
        if self._is_marked:
            yield
            return
        self._canvas._code.append("/Artifact BMC")
        yield
        self._canvas._code.append("EMC")

    # ----------------------------------------------------------------------- drawing

    def text(self, x: float, y: float, text: str, *, font: str, size: float, colour: str) -> None:
        """Write cleaned text from `x` on, its base line at `y`."""
        with self._marked():
            self._canvas.setFillColor(HexColor(colour))
            self._canvas.setFont(font, size)
            self._canvas.drawString(x, y, text)

    def rectangle(
        self,
        x: float,
        y: float,
        width: float,
        height: float,
        *,
        fill: str | None = None,
        stroke: str | None = None,
        radius: float = 0.0,
        line: float = 0.6,
        dash: Sequence[float] = (),
    ) -> None:
        """Draw a rectangle with its lower left corner at (x, y)."""
        with self._marked(), self._state(fill, stroke, line, dash):
            shape = (x, y, width, height)
            flags = {"fill": int(fill is not None), "stroke": int(stroke is not None)}
            if radius:
                self._canvas.roundRect(*shape, radius, **flags)
            else:
                self._canvas.rect(*shape, **flags)

    def polygon(
        self,
        points: Sequence[Point],
        *,
        fill: str | None = None,
        stroke: str | None = None,
        line: float = 0.6,
        alpha: float = 1.0,
    ) -> None:
        """Draw a closed outline."""
        with self._marked(), self._state(fill, stroke, line, (), alpha):
            self._path(points, is_closed=True, fill=fill is not None, stroke=stroke is not None)

    def polyline(
        self,
        points: Sequence[Point],
        *,
        stroke: str,
        line: float = 0.6,
        dash: Sequence[float] = (),
    ) -> None:
        """Draw lines from point to point."""
        with self._marked(), self._state(None, stroke, line, dash):
            self._path(points, is_closed=False, fill=False, stroke=True)

    def circle(
        self,
        x: float,
        y: float,
        radius: float,
        *,
        fill: str | None = None,
        stroke: str | None = None,
        line: float = 0.6,
    ) -> None:
        """Draw a circle."""
        with self._marked(), self._state(fill, stroke, line, ()):
            self._canvas.circle(x, y, radius, fill=int(fill is not None), stroke=int(bool(stroke)))

    def image(self, jpeg: bytes, x: float, y: float, width: float, height: float) -> None:
        """Place a JPEG with its lower left corner at (x, y)."""
        with self._marked():
            self._canvas.drawImage(ImageReader(io.BytesIO(jpeg)), x, y, width, height)

    @contextlib.contextmanager
    def _state(
        self,
        fill: str | None,
        stroke: str | None,
        line: float,
        dash: Sequence[float],
        alpha: float = 1.0,
    ) -> Iterator[None]:
        canvas = self._canvas
        canvas.saveState()
        canvas.setLineWidth(line)
        canvas.setLineJoin(1)
        canvas.setLineCap(1)
        if dash:
            canvas.setDash(list(dash))
        if fill is not None:
            canvas.setFillColor(HexColor(fill), alpha=alpha if alpha < 1 else None)
        if stroke is not None:
            canvas.setStrokeColor(HexColor(stroke))
        yield
        canvas.restoreState()

    def _path(self, points: Sequence[Point], *, is_closed: bool, fill: bool, stroke: bool) -> None:
        if len(points) < 2:
            return
        path = self._canvas.beginPath()
        path.moveTo(*points[0])
        for point in points[1:]:
            path.lineTo(*point)
        if is_closed:
            path.close()
        self._canvas.drawPath(path, fill=int(fill), stroke=int(stroke))

    # ----------------------------------------------------------------------- pages

    @property
    def page_number(self) -> int:
        """The number of the open page, from 1."""
        return self._page + 1

    def end_page(self) -> None:
        """Close the open page; what follows goes on the next one."""
        self._canvas.showPage()
        page = self._canvas._doc.Pages.pages[-1]
        page.__NoDefault__ = [*page.__NoDefault__, "StructParents", "Tabs"]
        page.StructParents = self._page
        page.Tabs = pdfdoc.PDFName("S")
        self._page += 1
        self._n_marks = 0

    def to_bytes(self) -> bytes:
        """Return the document; the last page must have been ended."""
        self._write_structure()
        self._canvas.save()
        return self._buffer.getvalue()

    def _write_structure(self) -> None:
        document = self._canvas._doc
        root = pdfdoc.PDFDictionary({"Type": pdfdoc.PDFName("StructTreeRoot")})
        root_reference = document.Reference(root)
        parents: dict[int, dict[int, Any]] = {page: {} for page in range(self._page)}
        root["K"] = self._write_element(self._root, root_reference, parents)
        numbers: list[Any] = []
        for page, marks in parents.items():
            owners = pdfdoc.PDFArray([marks[n] for n in range(len(marks))])
            numbers += [page, document.Reference(owners)]
        tree = pdfdoc.PDFDictionary({"Nums": pdfdoc.PDFArray(numbers)})
        root["ParentTree"] = document.Reference(tree)
        root["ParentTreeNextKey"] = self._page
        document.Catalog.StructTreeRoot = root
        document.Catalog.MarkInfo = pdfdoc.PDFDictionary({"Marked": "true"})

    def _write_element(
        self, element: _Element, parent: Any, parents: dict[int, dict[int, Any]]
    ) -> Any:
        document = self._canvas._doc
        node = pdfdoc.PDFDictionary(
            {
                "Type": pdfdoc.PDFName("StructElem"),
                "S": pdfdoc.PDFName(element.role),
                "P": parent,
            }
        )
        reference = document.Reference(node)
        if element.alt:
            node["Alt"] = pdfdoc.PDFString(element.alt)
        if element.attributes:
            names = {key: pdfdoc.PDFName(value) for key, value in element.attributes.items()}
            node["A"] = pdfdoc.PDFDictionary(names)
        kids: list[Any] = [self._write_element(kid, reference, parents) for kid in element.children]
        for page, number in element.marks:
            node["Pg"] = document.Reference(document.Pages.pages[page])
            parents[page][number] = reference
            kids.append(number)
        node["K"] = pdfdoc.PDFArray(kids)
        return reference
