"""The font shows what users write, and says so where it can't."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from reportlab.pdfbase import pdfmetrics

from engine.report.fonts import REGULAR, REPLACEMENT, clean_text, register_fonts


@pytest.mark.parametrize(
    "text",
    ["Łukasz Żółć", "≤ ≥ ± ° µ × − – … ∞ →", "Ωμέγα Ψηφίο", "Жук Їжак", "São Ünïcödé ß ő", "½ € ©"],
)
def test_common_scripts_stay_as_they_are(text):
    assert clean_text(text) == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("crate 📦 up", f"crate {REPLACEMENT} up"),
        ("田中", REPLACEMENT * 2),
        ("שלום", REPLACEMENT * 4),
        ("\udcff.mp4", f"{REPLACEMENT}.mp4"),
        ("❤\ufe0f", "❤"),
    ],
    ids=["emoji", "chinese", "right-to-left", "surrogate", "variation-selector"],
)
def test_what_the_font_lacks_is_replaced_visibly(text, shown):
    assert clean_text(text) == shown


def test_a_letter_and_its_accent_become_one():
    assert clean_text("Z\u0307o\u0301\u0142w") == "Żółw"


def test_hidden_characters_are_dropped_and_lines_joined():
    assert clean_text("a\u202eb\x00c\nd\te") == "abc d e"


@given(st.text(max_size=40))
def test_every_shown_character_has_a_glyph(text):
    register_fonts()
    glyphs = pdfmetrics.getFont(REGULAR).face.charToGlyph
    assert all(ord(character) in glyphs for character in clean_text(text))
