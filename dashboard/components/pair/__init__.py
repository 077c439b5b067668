"""Two videos side by side on one time cursor: the warping tells which moments belong together.

Plain JavaScript in `frontend/`, served as it is; videos come from Streamlit's media server.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import streamlit.components.v1 as components
from streamlit import runtime

__all__ = ["build_pair", "show_pair"]

FRONTEND = Path(__file__).with_name("frontend")
_component = components.declare_component("liftlens_pair", path=str(FRONTEND))


def build_pair(
    reference_s: Sequence[float],
    attempt_s: Sequence[float],
    phases: Sequence[tuple[str, float]],
) -> dict[str, Any]:
    """Return what the component needs: moments that belong together, and named moments.

    Parameters
    ----------
    reference_s, attempt_s
        Seconds in both videos, in the same order and of the same length.
    phases
        Name and moment in the reference, seconds.
    """
    return {
        "reference": [round(float(t), 3) for t in reference_s],
        "attempt": [round(float(t), 3) for t in attempt_s],
        "phases": [{"name": name, "at": round(float(t), 3)} for name, t in phases],
    }


def show_pair(
    data: Mapping[str, Any], videos: Sequence[Path], titles: Sequence[str], *, key: str
) -> None:
    """Show both videos; the reference runs at its own speed and leads."""
    _component(
        **data,
        videos=[_serve(path, f"{key}-{number}") for number, path in enumerate(videos)],
        titles=list(titles),
        key=key,
        default=None,
    )


def _serve(path: Path, coordinates: str) -> str:
    """Return the address of a video on this server; empty where no server runs (in tests)."""
    if not runtime.exists():
        return ""
    return runtime.get_instance().media_file_mgr.add(str(path), "video/mp4", coordinates)
