"""The cards of a list with their buttons, as one component.

Fifteen cards of Streamlit's own widgets are 135 elements, which the browser takes several times
as long to draw as the list itself; here they are one. Nothing is loaded from elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import streamlit as st

__all__ = ["Asked", "Card", "CardButton", "read_asked", "show_cards"]

SCRIPT = Path(__file__).with_name("cards.js").read_text(encoding="utf-8")
# In the page's own style, so that light, dark and narrow need no second style sheet.
_component = st.components.v2.component("liftlens_cards", js=SCRIPT, isolate_styles=False)


@dataclass(frozen=True)
class CardButton:
    """A button of a card.

    Parameters
    ----------
    action
        What it asks for.
    label
        Its word; only read out if there is an icon.
    icon
        Name of a Material symbol to show in its place.
    tip
        What it does, shown when the mouse rests on it.
    """

    action: str
    label: str
    icon: str = ""
    tip: str = ""


@dataclass(frozen=True)
class Card:
    """One entry: its HTML, made safe already, and its buttons."""

    id: str
    html: str
    buttons: tuple[CardButton, ...]


@dataclass(frozen=True)
class Asked:
    """The button that was pressed, and on which card."""

    action: str
    id: str


def show_cards(cards: Iterable[Card], *, key: str) -> Asked | None:
    """Show cards below each other.

    Parameters
    ----------
    cards
        From top to bottom.
    key
        Of the list within its page.

    Returns
    -------
    Asked or None
        The button that was pressed just now.
    """
    html = "".join(map(_card_html, cards))
    result = _component(key=key, data={"html": html}, on_asked_change=_take_notice)
    return read_asked(result.asked)


def _take_notice() -> None:
    """Let Streamlit hand over what was asked; it does so for values with a callback only."""


def read_asked(value: Any) -> Asked | None:
    """Return what a browser sent as a pressed button; None for anything that is none."""
    if not isinstance(value, Mapping):
        return None
    action, name = value.get("action"), value.get("id")
    return Asked(action, name) if isinstance(action, str) and isinstance(name, str) else None


def _card_html(card: Card) -> str:
    buttons = "".join(_button_html(card.id, button) for button in card.buttons)
    return f'<li class="ll-item">{card.html}<div class="ll-actions">{buttons}</div></li>'


def _button_html(card: str, button: CardButton) -> str:
    label = escape(button.label)
    named, content = "", label
    if button.icon:
        named = f' aria-label="{label}"'
        content = f'<span class="ll-icon" aria-hidden="true">{escape(button.icon)}</span>'
    tip = f' title="{escape(button.tip)}"' if button.tip else ""
    css = "ll-button ll-plain-button" if button.icon else "ll-button"
    return (
        f'<button type="button" class="{css}" data-action="{escape(button.action)}" '
        f'data-id="{escape(card)}"{named}{tip}>{content}</button>'
    )
