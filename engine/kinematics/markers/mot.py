"""Coordinates of a marker fit as an OpenSim motion file."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from engine.kinematics.markers.fit import MarkerFit

__all__ = ["write_coordinates_mot"]


def write_coordinates_mot(fit: MarkerFit, path: Path) -> None:
    """Write a fit under OpenSim's own coordinate names: degrees and metres.

    Open it in OpenSim with the model to see the motion. Frames that could not be fitted are left
    out, as OpenSim's tools stop at a missing value; a single missing coordinate is written as 0.
    """
    is_fitted = np.isfinite(fit.coordinates).any(axis=1)
    values = np.nan_to_num(fit.coordinates[is_fitted])
    columns = ("time", *fit.coordinate_names)
    header = (
        "Coordinates",
        "version=1",
        f"nRows={len(values)}",
        f"nColumns={len(columns)}",
        "inDegrees=yes",
        "endheader",
        "\t".join(columns),
    )
    text = io.StringIO()
    np.savetxt(text, np.column_stack([fit.time_s[is_fitted], values]), fmt="%.8f", delimiter="\t")
    path.write_text("\n".join(header) + "\n" + text.getvalue(), encoding="utf-8")
