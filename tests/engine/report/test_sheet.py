"""The document carries title, language, date and a structure tree that is whole."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import pytest

from engine.errors import ConfigError
from engine.report.fonts import REGULAR
from engine.report.sheet import PAPERS, Properties, Sheet, select_paper
from tests.engine.report.results import list_tags, read_pdf

MOMENT = datetime(2026, 3, 5, 15, 30, tzinfo=timezone(timedelta(hours=1)))
PROPERTIES = Properties("Żółć ≤ 1", "subject", "en", MOMENT, ("a", "b"))


def make_document():
    sheet = Sheet(paper="a4", properties=PROPERTIES)
    for page in range(2):
        with sheet.tag("H1"):
            sheet.text(50, 700, f"title {page}", font=REGULAR, size=10, colour="#000000")
        sheet.rectangle(50, 600, 40, 20, fill="#ff0000")
        with sheet.group("Table"), sheet.group("TR"), sheet.tag("TH"):
            sheet.text(50, 500, "head", font=REGULAR, size=10, colour="#000000")
        with sheet.tag("Figure", alt="a line"):
            sheet.polyline([(0, 0), (10, 10)], stroke="#000000")
        sheet.end_page()
    return sheet.to_bytes()


def test_the_document_says_what_it_is():
    reader = read_pdf(make_document())
    root = reader.trailer["/Root"]
    assert reader.metadata.title == "Żółć ≤ 1"
    assert reader.metadata.subject == "subject"
    assert reader.metadata.author.startswith("LiftLens")
    assert reader.metadata.creation_date == datetime(2026, 3, 5, 14, 30, tzinfo=UTC)
    assert root["/Lang"] == "en"
    assert root["/ViewerPreferences"]["/DisplayDocTitle"] is not False
    assert root["/MarkInfo"]["/Marked"]


def test_the_same_content_gives_the_same_bytes():
    assert make_document() == make_document()


def test_every_mark_on_a_page_belongs_to_one_node():
    reader = read_pdf(make_document())
    numbers = reader.trailer["/Root"]["/StructTreeRoot"]["/ParentTree"]["/Nums"]
    for page, key, owners in zip(reader.pages, numbers[::2], numbers[1::2], strict=True):
        assert page["/StructParents"] == key
        marks = page.get_contents().get_data().count(b"/MCID")
        assert len(owners.get_object()) == marks == 3
        for number, owner in enumerate(owners.get_object()):
            node = owner.get_object()
            assert node["/K"] == [number]
            assert node["/Pg"].indirect_reference == page.indirect_reference


def test_marks_open_and_close_in_pairs():
    for page in read_pdf(make_document()).pages:
        content = page.get_contents().get_data()
        assert content.count(b"BDC") + content.count(b"BMC") == content.count(b"EMC")


def test_tags_are_read_in_order():
    one_page = [("/H1", ""), ("/Table", ""), ("/TR", ""), ("/TH", ""), ("/Figure", "a line")]
    assert list_tags(make_document()) == [("/Document", ""), *one_page, *one_page]


def test_paper_is_chosen_by_name():
    assert select_paper(" A4 ") == "a4"
    assert PAPERS["letter"] == (612.0, 792.0)
    with pytest.raises(ConfigError, match="a4, letter, got 'a5'"):
        select_paper("a5")
