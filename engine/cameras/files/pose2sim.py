"""Camera files of Pose2Sim and anipose (TOML).

One table a camera: name, size, matrix, distortions, rotation (a rotation vector) and translation,
from the world to the camera. Pose2Sim's world has metres and Z up, the floor at 0; anipose's is
that of its first camera, in the unit of the board.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from engine.cameras.files._build import (
    build_calibration,
    build_camera,
    read_array,
    read_size,
    rotation_from,
)
from engine.datatypes import Calibration, Camera
from engine.errors import CalibrationError

__all__ = ["is_pose2sim", "parse_pose2sim"]

KEYS = ("matrix", "rotation", "translation")


def is_pose2sim(tables: Mapping[str, Any]) -> bool:
    """Return whether a TOML file has the tables of such a calibration."""
    return any(
        isinstance(table, Mapping) and any(key in table for key in KEYS)
        for table in tables.values()
    )


def parse_pose2sim(tables: Mapping[str, Any], file_name: str) -> Calibration:
    """Build a calibration from the tables of such a file.

    Raises
    ------
    CalibrationError
        If what they say can't be right.
    """
    cameras = [
        _read_camera(key, table)
        for key, table in tables.items()
        if isinstance(table, Mapping) and key != "metadata" and any(k in table for k in KEYS)
    ]
    metadata = tables.get("metadata")
    error = metadata.get("error") if isinstance(metadata, Mapping) else None
    return build_calibration(
        cameras,
        file_name=file_name,
        format_name="Pose2Sim",
        up=(0.0, 0.0, 1.0),
        floor_m=0.0,
        provenance={"error": float(error)} if isinstance(error, int | float) else {},
    )


def _read_camera(key: str, table: Mapping[str, Any]) -> Camera:
    name = str(table.get("name", key))
    if table.get("fisheye"):
        raise CalibrationError(
            f"Camera {name!r} has a fisheye lens model; LiftLens knows OpenCV's pin-hole model. "
            "Calibrate it again without fisheye, or film with the normal lens."
        )
    owner = f"of camera {name!r}"
    distortions = table.get("distortions", ())
    n_coefficients = len(distortions) if isinstance(distortions, list | tuple) else 0
    return build_camera(
        name,
        read_size(table.get("size"), f"The size {owner}"),
        read_array(table.get("matrix"), (3, 3), f"The matrix {owner}"),
        rotation_from(_require(table, "rotation", owner), f"The rotation {owner}"),
        read_array(table.get("translation"), (3,), f"The translation {owner}"),
        read_array(distortions, (n_coefficients,), f"The distortions {owner}"),
    )


def _require(table: Mapping[str, Any], key: str, owner: str) -> Any:
    if table.get(key) is None:
        raise CalibrationError(f"The {key} {owner} is missing; export the calibration again.")
    return table[key]
