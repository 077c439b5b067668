"""The font of the reports, and which characters it can show.

PDF's own fonts lack common characters (≤, Ł, Greek, Cyrillic), so DejaVu Sans, which ships
with Matplotlib, is embedded: only the glyphs that are used.
"""

from __future__ import annotations

import functools
import importlib.util
import unicodedata
from pathlib import Path

from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont

from engine.errors import OutputError

__all__ = ["BOLD", "REGULAR", "REPLACEMENT", "clean_text", "register_fonts", "text_width"]

REGULAR, BOLD = "DejaVuSans", "DejaVuSans-Bold"
REPLACEMENT = "▯"
"""Stands, open and visible, for a character that the font lacks or that needs shaping."""

NEEDS_SHAPING = ("R", "AL")
"""Right-to-left scripts: without a shaping engine their letters come in the wrong order."""


@functools.cache
def register_fonts() -> None:
    """Make the fonts known to ReportLab; further calls cost nothing.

    Raises
    ------
    OutputError
        If the font files are not where Matplotlib should have put them.
    """
    for name in (REGULAR, BOLD):
        pdfmetrics.registerFont(TTFont(name, str(_font_folder() / f"{name}.ttf")))


@functools.cache
def _font_folder() -> Path:
    # Importing Matplotlib takes longer than a whole report; only its files are needed.
    spec = importlib.util.find_spec("matplotlib")
    places = list(spec.submodule_search_locations or ()) if spec else []
    for place in places:
        folder = Path(place) / "mpl-data" / "fonts" / "ttf"
        if (folder / f"{REGULAR}.ttf").is_file():
            return folder
    return _ask_matplotlib()


def _ask_matplotlib() -> Path:
    """Return the folder where a system package keeps the data apart from the code."""
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise OutputError(_no_font()) from error
    folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    if not (folder / f"{REGULAR}.ttf").is_file():
        raise OutputError(_no_font())
    return folder


def _no_font() -> str:
    return (
        f"The report can't be written: its font {REGULAR}.ttf, which ships with Matplotlib, "
        "was not found; install Matplotlib again."
    )


@functools.lru_cache(maxsize=4096)
def clean_text(text: str) -> str:
    """Return `text` as the font can show it.

    Parameters
    ----------
    text
        Anything: names may hold line breaks, emoji, control or bidirectional characters.

    Returns
    -------
    str
        One line in composed form (NFC). Characters without a glyph, and scripts that need
        shaping, become `REPLACEMENT`; invisible ones are dropped.
    """
    register_fonts()
    known = pdfmetrics.getFont(REGULAR).face.charToGlyph
    shown = []
    for character in unicodedata.normalize("NFC", text):
        category = unicodedata.category(character)
        if character.isspace() and character != "\u00a0":
            shown.append(" ")
        elif category in ("Cc", "Cf"):
            continue
        elif unicodedata.combining(character) or 0xFE00 <= ord(character) <= 0xFE0F:
            # No composed form: the font would set the mark beside its letter.
            continue
        elif ord(character) not in known or _needs_shaping(character):
            shown.append(REPLACEMENT)
        else:
            shown.append(character)
    return "".join(shown).strip()


def _needs_shaping(character: str) -> bool:
    return unicodedata.bidirectional(character) in NEEDS_SHAPING


@functools.lru_cache(maxsize=65536)
def text_width(text: str, font: str, size: float) -> float:
    """Return the width of cleaned text in points."""
    register_fonts()
    return float(pdfmetrics.stringWidth(text, font, size))
