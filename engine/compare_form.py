"""Compare stored results by form; used by the command line and the dashboard.

The one place that knows both `engine.storage` and `engine.form`. No video is needed.
"""

from __future__ import annotations

from engine.form import Performance, make_performance
from engine.storage.results import StoredResult

__all__ = ["read_performance"]


def read_performance(stored: StoredResult) -> Performance:
    """Return the movement of a stored result.

    Raises
    ------
    DataError
        If the clip is too short to hold a movement.
    """
    document = stored.document
    return make_performance(
        stored.angles,
        stored.corrected,
        label=document.get("label") or stored.folder.name,
        lifts=stored.lifts,
        person=stored.subject.label,
        solver=document["solver"],
        n_views=len(stored.views),
        view_azimuth_deg=stored.scene.view_azimuth_deg,
    )
