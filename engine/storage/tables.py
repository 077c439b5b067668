"""Text tables other tools read: TRC keypoints, OpenSim motion files, CSV."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, JointAngles, PoseTrack
from engine.errors import ShapeError, UnitError
from engine.skeletons import get_skeleton

__all__ = ["write_angles_csv", "write_angles_mot", "write_keypoints_trc"]

MM_PER_M = 1000.0
TRC_FIELDS = (
    "DataRate",
    "CameraRate",
    "NumFrames",
    "NumMarkers",
    "Units",
    "OrigDataRate",
    "OrigDataStartFrame",
    "OrigNumFrames",
)


def write_keypoints_trc(track: PoseTrack, path: Path, *, title: str = "") -> None:
    """Write a world track as TRC: millimetres, Y up, one marker per keypoint.

    A missing sample is written as `nan`, which OpenSim and most readers take as missing.
    The rate in the header is the mean rate; the `Time` column has the true times. `title` is the
    file name in the header, by default that of `path`.

    Raises
    ------
    UnitError
        If the track is not in metres in the world frame.
    ShapeError
        If the skeleton and the track differ in their number of keypoints.
    """
    if track.frame_of_reference != "world":
        raise UnitError(
            f"A TRC file needs a track in the world frame, got the {track.frame_of_reference} "
            "frame; give the world track of the result."
        )
    names = get_skeleton(track.skeleton).keypoints
    n_frames, n_keypoints, n_axes = track.position.shape
    if (n_keypoints, n_axes) != (len(names), 3):
        raise ShapeError(
            f"{track.skeleton} needs positions of shape (T, {len(names)}, 3), "
            f"got {track.position.shape}."
        )
    position_mm = track.position.reshape(n_frames, -1) * MM_PER_M
    numbered = np.column_stack([np.arange(1, n_frames + 1), track.time_s, position_mm])
    path.write_text(
        _trc_header(title or path.name, names, track.time_s)
        + _rows(numbered, formats=["%d", "%.6f", *["%.4f"] * position_mm.shape[1]]),
        encoding="utf-8",
    )


def _trc_header(file_name: str, names: tuple[str, ...], time_s: Array) -> str:
    rate = _mean_rate_hz(time_s)
    axes = "\t".join(f"{axis}{n}" for n in range(1, len(names) + 1) for axis in "XYZ")
    lines = (
        f"PathFileType\t4\t(X/Y/Z)\t{file_name}",
        "\t".join(TRC_FIELDS),
        f"{rate:.6g}\t{rate:.6g}\t{time_s.size}\t{len(names)}\tmm\t{rate:.6g}\t1\t{time_s.size}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        f"\t\t{axes}",
        "",
    )
    return "\n".join(lines) + "\n"


def _mean_rate_hz(time_s: Array) -> float:
    """Return the mean frame rate; 1 where a single frame has none."""
    if time_s.size < 2:
        return 1.0
    return float((time_s.size - 1) / (time_s[-1] - time_s[0]))


def write_angles_mot(angles: JointAngles, path: Path) -> None:
    """Write joint angles as an OpenSim motion file, in degrees, under LiftLens's names.

    A missing value is `nan`. OpenSim's `TimeSeriesTable` reads that as missing; its older `Storage`
    stops at the first one, so look at the number of rows it found.
    """
    columns = ("time", *angles.names)
    header = (
        "Coordinates",
        "version=1",
        f"nRows={angles.time_s.size}",
        f"nColumns={len(columns)}",
        "inDegrees=yes",
        f"# LiftLens angle convention: {angles.convention}; nan where not measured",
        "endheader",
        "\t".join(columns),
    )
    values = np.column_stack([angles.time_s, angles.value_deg])
    formats = ["%.6f", *["%.5f"] * len(angles.names)]
    path.write_text("\n".join(header) + "\n" + _rows(values, formats=formats), encoding="utf-8")


def write_angles_csv(angles: JointAngles, path: Path) -> None:
    """Write joint angles as CSV: `time_s`, then `<name>_deg` and `<name>_sigma_deg`.

    A missing value is an empty cell.
    """
    columns = ["time_s"]
    data: list[NDArray[np.float64]] = [angles.time_s]
    for column, name in enumerate(angles.names):
        columns += [f"{name}_deg", f"{name}_sigma_deg"]
        data += [angles.value_deg[:, column], angles.sigma_deg[:, column]]
    formats = ["%.6f", *["%.5f"] * (len(columns) - 1)]
    rows = _rows(np.column_stack(data), formats=formats, separator=",").replace("nan", "")
    path.write_text(",".join(columns) + "\n" + rows, encoding="utf-8")


def _rows(values: Array, *, formats: list[str], separator: str = "\t") -> str:
    text = io.StringIO()
    np.savetxt(text, values, fmt=formats, delimiter=separator, newline="\n")
    return text.getvalue()
