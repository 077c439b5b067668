"""The synchronised player: video, skeleton in 3D, curves, lifts and flags on one time cursor.

The frontend is plain JavaScript modules in `frontend/`, served by Streamlit as they are: nothing is
built and nothing is loaded from elsewhere. Samples travel as bytes, videos by Streamlit's media
server, which answers requests for parts of a file and shares one copy among sessions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import streamlit.components.v1 as components
from streamlit import runtime

from dashboard.components.player.payload import Payload
from dashboard.labels import PLAYER

__all__ = ["PlayerEvent", "read_event", "show_player"]

FRONTEND = Path(__file__).with_name("frontend")
_component = components.declare_component("liftlens_player", path=str(FRONTEND))


@dataclass(frozen=True)
class PlayerEvent:
    """What the user asked for in the player.

    Parameters
    ----------
    action
        `flag` where a flag was chosen, or the key of one of the actions offered.
    time_s
        Where the time cursor stood, in the trial's time.
    flag
        Key of the chosen flag, if any.
    number
        Counts up, so that the same request twice is two requests.
    """

    action: str
    time_s: float
    flag: str = ""
    number: int = 0


def show_player(
    payload: Payload,
    flags: Sequence[Mapping[str, Any]],
    *,
    videos: Sequence[Path] = (),
    notes: Sequence[Mapping[str, Any]] = (),
    actions: Mapping[str, str] | None = None,
    key: str,
) -> PlayerEvent | None:
    """Show the player.

    Parameters
    ----------
    payload
        What does not change while the trial is looked at.
    flags, notes
        Marks on the timeline, see `describe_flags`; a note is `time` in s and `text`.
    videos
        None, one or two annotated videos that start with the trial's first sample.
    actions
        What the user may ask for at the time of the cursor: key and words of its button.
    key
        Differs from trial to trial and from version to version of a result.

    Returns
    -------
    PlayerEvent or None
        What was asked for last; None before anything was.
    """
    value = _component(
        stamp=key,
        meta=dict(payload.meta),
        flags=list(flags),
        notes=list(notes),
        videos=[_serve(path, f"{key}-{number}") for number, path in enumerate(videos)],
        actions=[{"key": name, "label": label} for name, label in (actions or {}).items()],
        words=PLAYER,
        key=key,
        default=None,
        **payload.arrays,
    )
    return read_event(value)


def _serve(path: Path, coordinates: str) -> str:
    """Return the address of a video on this server; empty where no server runs (in tests)."""
    if not runtime.exists():
        return ""
    manager = runtime.get_instance().media_file_mgr
    return manager.add(str(path), "video/mp4", coordinates)


def read_event(value: Any) -> PlayerEvent | None:
    """Return what a browser sent as an event; None for anything that is none."""
    if not isinstance(value, Mapping):
        return None
    action, time_s, flag = (value.get(name) for name in ("action", "time_s", "flag"))
    number = value.get("number")
    is_sound = (
        isinstance(action, str)
        and isinstance(time_s, int | float)
        and math.isfinite(time_s)
        and isinstance(number, int)
    )
    if not is_sound:
        return None
    return PlayerEvent(
        action=str(action),
        time_s=float(time_s or 0.0),
        flag=flag if isinstance(flag, str) else "",
        number=int(number or 0),
    )
