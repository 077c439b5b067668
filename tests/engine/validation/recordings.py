"""Small reference recordings whose content is known, as files and as objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

RATE_HZ = 100.0

# Plug-in Gait markers of an upright person who faces +X: forward, up, to the right (m).
_RIGHT = {
    "ASI": (0.10, 1.00, 0.12),
    "PSI": (-0.08, 1.02, 0.05),
    "SHO": (0.00, 1.50, 0.18),
    "ELB": (0.00, 1.20, 0.24),
    "MEL": (0.00, 1.20, 0.16),
    "WRA": (0.07, 0.96, 0.20),
    "WRB": (0.03, 0.96, 0.22),
    "KNE": (0.02, 0.52, 0.15),
    "MKNE": (0.02, 0.52, 0.05),
    "ANK": (0.00, 0.10, 0.14),
    "MED": (0.00, 0.10, 0.06),
    "HEE": (-0.06, 0.04, 0.10),
    "TOE": (0.16, 0.03, 0.11),
}
_MIDDLE = {"C7": (-0.06, 1.52, 0.0), "CLAV": (0.07, 1.45, 0.0)}


def upright_markers() -> dict[str, tuple[float, float, float]]:
    """Return markers of both sides, standing, in metres, X forward, Y up, Z right."""
    markers = dict(_MIDDLE)
    for name, (x, y, z) in _RIGHT.items():
        markers[f"R{name}"] = (x, y, z)
        markers[f"L{name}"] = (x, y, -z)
    return markers


def moving_markers(
    n_frames: int = 40, markers: Mapping[str, Sequence[float]] | None = None
) -> tuple[tuple[str, ...], np.ndarray]:
    """Return labels and positions (T, M, 3) of a body that sways forward by 20 cm and back."""
    points = dict(markers or upright_markers())
    sway = 0.2 * np.sin(np.linspace(0.0, np.pi, n_frames))
    still = np.array(list(points.values()), dtype=np.float64)
    return tuple(points), still[None] + sway[:, None, None] * np.array([1.0, 0.0, 0.0])


def write_trc(
    path: Path,
    labels: Sequence[str],
    position: np.ndarray,
    *,
    unit: str = "mm",
    rate_hz: float = RATE_HZ,
    time_s: np.ndarray | None = None,
    cell: str = "{:.5f}",
    n_announced: int | None = None,
) -> Path:
    """Write positions as they are; NaN becomes a blank cell."""
    time = np.arange(len(position)) / rate_hz if time_s is None else time_s
    n = len(position) if n_announced is None else n_announced
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate",
        f"{rate_hz:g}\t{rate_hz:g}\t{n}\t{len(labels)}\t{unit}\t{rate_hz:g}",
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + "\t".join(f"{a}{i + 1}" for i in range(len(labels)) for a in "XYZ"),
        "",
    ]
    for i, frame in enumerate(position):
        numbers = ["" if np.isnan(v) else cell.format(v) for v in frame.ravel()]
        lines.append("\t".join([str(i + 1), f"{time[i]:.5f}", *numbers]))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_mot(
    path: Path,
    columns: Mapping[str, np.ndarray],
    *,
    in_degrees: str | None = "yes",
    rate_hz: float = RATE_HZ,
) -> Path:
    """Write an OpenSim motion file; without `in_degrees` the header is silent."""
    values = np.column_stack(list(columns.values()))
    time = np.arange(len(values)) / rate_hz
    header = ["Coordinates", "version=1", f"nRows={len(values)}", f"nColumns={len(columns) + 1}"]
    header += [] if in_degrees is None else [f"inDegrees={in_degrees}"]
    lines = [*header, "", "endheader", "\t".join(["time", *columns])]
    lines += ["\t".join(f"{v:.9g}" for v in [t, *row]) for t, row in zip(time, values, strict=True)]
    path.write_text("\n".join(lines) + "\n")
    return path
