"""Reading and writing TRC files of a known marker set.

A laboratory may name its markers otherwise, lose some of them, or write metres under a header that
says millimetres; all of that is found out here, so that what follows can trust its input.
"""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from engine.datatypes import Array
from engine.errors import DataError, UnitError
from engine.kinematics.markers.recording import MarkerRecording, fill_short_gaps
from engine.skeletons import MARKER_SETS, MarkerSet

__all__ = ["MAX_FILLED_GAP_S", "MIN_MARKERS", "read_marker_trc", "write_marker_trc"]

logger = logging.getLogger(__name__)

MIN_MARKERS = 27
"""Below this many of the 45 (three in five) the pose of some segment is a guess."""
MAX_FILLED_GAP_S = 0.2
"""The longest gap that a spline bridges; a limb can turn round within more."""
BODY_EXTENT_M = (0.9, 3.0)
"""Greatest distance across all markers of a person, in any frame of a trial with some standing."""
UNITS_M: Mapping[str, float] = {
    "m": 1.0,
    "meter": 1.0,
    "meters": 1.0,
    "metre": 1.0,
    "metres": 1.0,
    "cm": 0.01,
    "mm": 0.001,
    "millimeters": 0.001,
    "millimetres": 0.001,
}
HEADER_LINES = 5
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

OTHER_NAMES: Mapping[str, tuple[str, ...]] = {
    "vertex": ("ARIEL", "TopHead", "Head"),
    "forehead": ("FHEAD", "Forehead"),
    "notch": ("SJN", "JN", "Sternum"),
    "xiphoid": ("XP", "XIPH", "STRN"),
    "front_head": ("*FH",),
    "back_head": ("*BH",),
    "asis": ("*.ASIS", "*ASIS_study", "*IAS"),
    "psis": ("*.PSIS", "*PSIS_study", "*IPS"),
    "acromion": ("*ACR", "*SAE", "*_Shoulder", "*Acromion"),
    "upper_arm": ("*UPPERARM",),
    "lateral_elbow": ("*EL", "*HLE", "*_elbow_lat", "*ELB", "*LELB"),
    "medial_elbow": ("*EM", "*HME", "*_elbow_med", "*ELBM", "*MELB", "*MEL"),
    "radial_wrist": ("*RSP", "*_wrist_radius", "*WRA"),
    "ulnar_wrist": ("*USP", "*_wrist_ulna", "*WRB"),
    "knuckle": ("*HM3", "*HAND", "*3MC"),
    "trochanter": ("*FTC", "*TROC", "*GTROC"),
    "lateral_knee": ("*FLE", "*LFE", "*_knee", "*KNE", "*LKNE", "*LEK"),
    "medial_knee": ("*FME", "*MFE", "*_mknee", "*KNM", "*KNEM", "*MKNE", "*MEK"),
    "fibula_head": ("*FAX", "*FIB"),
    "tibial_tuberosity": ("*TTC", "*TIB"),
    "lateral_ankle": ("*FAL", "*_ankle", "*ANK", "*LANK"),
    "medial_ankle": ("*TAM", "*_mankle", "*ANKM", "*MED", "*MANK"),
    "heel": ("*FCC", "*_calc", "*HEE", "*HEEL"),
    "first_metatarsal": ("*FM1", "*1MT", "*TOE"),
    "fifth_metatarsal": ("*FM5", "*5MT", "*_5meta"),
}
"""Names that other conventions give to the landmarks of our sets; ``*`` stands for L or R."""


def read_marker_trc(path: str | Path, *, marker_set: str | None = None) -> MarkerRecording:
    """Read the markers of a person from a TRC file.

    Markers are found by the names of `LIFTING_45` or `SYNTHETIC_45`, or by those that other
    conventions give to the same landmark, whatever their order, case, separators and prefix
    (``Subject1:``). The recording is turned to metres and Y up; gaps of at most 0.2 s are filled
    by a cubic spline and marked as `is_filled`, longer ones stay NaN.

    Parameters
    ----------
    path
        The TRC file.
    marker_set
        Name of the set to expect; by default the one that fits best.

    Returns
    -------
    MarkerRecording
        Columns in the order of the set. `notes` (also logged as warnings) say what was odd.

    Raises
    ------
    DataError
        If the file is no TRC file, is damaged, or has fewer than 27 of the 45 markers.
    UnitError
        If the person would not have a human size in the unit that the header states.
    """
    path = Path(path)
    rate_hz, unit, labels, time_s, raw = _parse(path)
    chosen, found = _match(labels, path.name, marker_set)
    notes: list[str] = []
    position = np.full((time_s.size, len(chosen.keypoints), 3), np.nan)
    for column, marker in enumerate(chosen.keypoints):
        if marker in found:
            position[:, column] = raw[:, labels.index(found[marker])]
    missing = [m for m in chosen.keypoints if m not in found]
    if missing:
        notes.append(f"{path.name} has no marker {', '.join(missing)}; they stay missing.")
    renamed = [f"{found[m]} as {m}" for m in chosen.keypoints if m in found and found[m] != m]
    if renamed:
        notes.append(f"Markers were taken by their landmark: {', '.join(renamed)}.")
    position *= _metres_per_unit(unit, position, path.name)
    position, turned = _turn_upright(position, chosen)
    notes += [turned] if turned else []
    filled = fill_short_gaps(time_s, position, max_gap_s=MAX_FILLED_GAP_S)
    for note in notes:
        logger.warning(note)
    return MarkerRecording(
        time_s=time_s,
        position_m=filled,
        names=chosen.keypoints,
        rate_hz=rate_hz,
        marker_set=chosen.name,
        is_filled=np.asarray(np.isfinite(filled).all(axis=2) & np.isnan(position).any(axis=2)),
        notes=tuple(notes),
    )


def _parse(path: Path) -> tuple[float, str, tuple[str, ...], Array, Array]:
    """Return rate, unit, labels, times (T,) and positions (T, M, 3) as the file has them."""
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except FileNotFoundError:
        raise DataError(f"There is no file {path}; check the path.") from None
    except OSError as error:
        raise DataError(f"{path} can't be read: {error.strerror or error}.") from error
    if len(lines) <= HEADER_LINES or not lines[0].lower().startswith("pathfiletype"):
        raise DataError(
            f"{path.name} is no TRC file: expected a first line that starts with PathFileType and "
            "at least one frame; export the markers again."
        )
    header = dict(zip(lines[1].lower().split(), lines[2].split(), strict=False))
    labels = tuple(name.strip() for name in lines[3].split("\t") if name.strip())[2:]
    rows = [line for line in lines[HEADER_LINES:] if line.strip()]
    table = _numbers(rows, 2 + 3 * len(labels), path.name)
    time_s = table[:, 1]
    if not np.isfinite(time_s).all() or (np.diff(time_s) <= 0).any():
        raise DataError(f"The times of {path.name} must increase from frame to frame; they do not.")
    position = table[:, 2:].reshape(len(rows), len(labels), 3)
    # Exporters write a lost marker as a point at exactly the origin.
    position[(position == 0.0).all(axis=2)] = np.nan
    return (
        _rate_hz(header.get("datarate", ""), time_s),
        header.get("units", ""),
        labels,
        *(
            time_s,
            position,
        ),
    )


def _numbers(rows: Sequence[str], n_columns: int, name: str) -> Array:
    """Turn tab-separated cells into numbers; blank or absent ones are NaN."""
    try:
        table = np.loadtxt(
            io.StringIO("\n".join(r.rstrip() for r in rows)), delimiter="\t", ndmin=2
        )
        if table.shape == (len(rows), n_columns):
            return np.asarray(table, dtype=np.float64)
    except ValueError:
        pass  # blanks or damage: look at every cell
    table = np.full((len(rows), n_columns), np.nan)
    for i, row in enumerate(rows):
        cells = row.split("\t")
        if any(cell.strip() for cell in cells[n_columns:]):
            raise DataError(
                f"{name}, frame {i + 1}: expected {n_columns} columns as in the header, got "
                f"{len(cells)}; export the markers again."
            )
        for j, cell in enumerate(cells[:n_columns]):
            table[i, j] = _number(cell, f"{name}, frame {i + 1}, column {j + 1}")
    return table


def _number(cell: str, where: str) -> float:
    try:
        return float(cell) if cell.strip() else np.nan
    except ValueError:
        raise DataError(f"{where}: expected a number, got {cell!r}; correct the cell.") from None


def _rate_hz(stated: str, time_s: Array) -> float:
    """Return the true rate: that of the time column, or the stated one of a single frame."""
    if time_s.size > 1:
        return float(1.0 / np.median(np.diff(time_s)))
    try:
        return float(stated)
    except ValueError:
        return float("nan")


# --------------------------------------------------------------------------- names


def _normalise(label: str) -> str:
    return re.sub(r"[\s._\-]", "", label.rpartition(":")[2]).lower()


def _names_of(landmark: str) -> tuple[str, ...]:
    """Return every name of a landmark: those of our sets, then other conventions'."""
    own = [s.of_landmark[landmark] for s in MARKER_SETS.values() if landmark in s.landmarks]
    side, _, part = landmark.partition("_")
    if side not in {"left", "right"}:
        return (*own, *OTHER_NAMES.get(landmark, ()))
    return (*own, *(n.replace("*", side[0].upper()) for n in OTHER_NAMES.get(part, ())))


def _match(
    labels: Sequence[str], name: str, marker_set: str | None
) -> tuple[MarkerSet, dict[str, str]]:
    """Return the marker set, and its markers found in the file: marker -> label."""
    if marker_set is not None and marker_set not in MARKER_SETS:
        raise DataError(f"Unknown marker set {marker_set!r}; known: {', '.join(MARKER_SETS)}.")
    candidates = [MARKER_SETS[marker_set]] if marker_set else list(MARKER_SETS.values())
    best = max(
        ((s, _find(s, labels)) for s in candidates),
        key=lambda pair: (len(pair[1]), sum(k == v for k, v in pair[1].items())),
    )
    if len(best[1]) < MIN_MARKERS:
        missing = [m for m in best[0].keypoints if m not in best[1]]
        raise DataError(
            f"{name} has {len(best[1])} of the {len(best[0].keypoints)} markers of "
            f"{best[0].name}, expected at least {MIN_MARKERS}; missing: {', '.join(missing)}. "
            f"Its markers are {', '.join(labels[:8])} and so on: rename them to those of the set."
        )
    return best


def _find(marker_set: MarkerSet, labels: Sequence[str]) -> dict[str, str]:
    """Return marker -> label; a label counts once, the set's own names first."""
    free = {_normalise(label): label for label in reversed(labels)}
    found: dict[str, str] = {}
    for marker in marker_set.keypoints:
        if _normalise(marker) in free:
            found[marker] = free.pop(_normalise(marker))
    for marker, landmark in zip(marker_set.keypoints, marker_set.landmarks, strict=True):
        names = [] if marker in found else [_normalise(n) for n in _names_of(landmark)]
        known = next((n for n in names if n in free), None)
        if known is not None:
            found[marker] = free.pop(known)
    return found


# --------------------------------------------------------------------------- unit and axes


def _metres_per_unit(unit: str, position: Array, name: str) -> float:
    """Return the factor to metres that the header states, if the person has a human size then."""
    extent = _extent(position)
    fits = {
        word: factor
        for word, factor in (("mm", 0.001), ("cm", 0.01), ("m", 1.0))
        if BODY_EXTENT_M[0] <= extent * factor <= BODY_EXTENT_M[1]
    }
    hint = (
        f"The numbers look like {' or '.join(fits)}; correct Units."
        if fits
        else ("No length unit makes this a person; check which markers were exported.")
    )
    word = unit.strip().lower()
    if word not in UNITS_M and not (word == "" and fits):
        raise UnitError(f"{name} states the unit {unit!r}; expected mm, cm or m. {hint}")
    factor = UNITS_M[word] if word else next(iter(fits.values()))
    size = extent * factor
    if np.isfinite(size) and not BODY_EXTENT_M[0] <= size <= BODY_EXTENT_M[1]:
        shown = f"{size / 1000:.3g} km" if size >= 1000 else f"{size:.3g} m"
        raise UnitError(
            f"{name} states the unit {unit!r}, which makes the person {shown} tall; expected "
            f"{BODY_EXTENT_M[0]:g} to {BODY_EXTENT_M[1]:g} m. {hint}"
        )
    return factor


def _extent(position: Array) -> float:
    """Return the greatest size of a box around a frame's markers, in the file's unit."""
    seen = np.where(np.isfinite(position), position, np.nan)
    is_usable = np.isfinite(seen).all(axis=2).sum(axis=1) >= MIN_MARKERS // 2
    if not is_usable.any():
        return float("nan")
    span = np.nanmax(seen[is_usable], axis=1) - np.nanmin(seen[is_usable], axis=1)
    # A marker that flickers far away for a moment must not decide.
    return float(np.percentile(span.max(axis=1), 90))


def _turn_upright(position: Array, marker_set: MarkerSet) -> tuple[Array, str]:
    """Turn Z up to Y up; the body above the heels tells which it is."""
    of = {landmark: i for i, landmark in enumerate(marker_set.landmarks)}
    heels = position[:, [of["left_heel"], of["right_heel"]]]
    trunk = position[:, [of[k] for k in ("c7", "notch", "left_acromion", "right_acromion")]]
    up = np.nanmedian(trunk.reshape(-1, 3), axis=0) - np.nanmedian(heels.reshape(-1, 3), axis=0)
    if not np.isfinite(up).all() or np.argmax(np.abs(up)) == 1:
        return position, ""
    if np.argmax(np.abs(up)) == 2 and up[2] > 0:
        turned = np.stack([position[..., 0], position[..., 2], -position[..., 1]], axis=-1)
        return turned, "The recording has Z up; it was turned to Y up."
    raise DataError(
        "The body must stand along Y (or Z) of the recording, but it lies along X; export it with "
        "Y up."
    )


# --------------------------------------------------------------------------- writing


def write_marker_trc(recording: MarkerRecording, path: Path) -> None:
    """Write a recording as TRC: millimetres, Y up; a missing marker is a blank cell.

    OpenSim, Mokka and the importers of LiftLens read the file back.
    """
    rate, n_frames = recording.rate_hz, recording.time_s.size
    names = recording.names
    axes = "\t".join(f"{axis}{n}" for n in range(1, len(names) + 1) for axis in "XYZ")
    head = (
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "\t".join(TRC_FIELDS),
        f"{rate:.6g}\t{rate:.6g}\t{n_frames}\t{len(names)}\tmm\t{rate:.6g}\t1\t{n_frames}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        f"\t\t{axes}",
        "",
    )
    values = recording.position_m.reshape(n_frames, -1) * 1000.0
    text = io.StringIO()
    table = np.column_stack([np.arange(1, n_frames + 1), recording.time_s, values])
    np.savetxt(text, table, fmt=["%d", "%.6f", *["%.5f"] * values.shape[1]], delimiter="\t")
    path.write_text("\n".join(head) + "\n" + text.getvalue().replace("nan", ""), encoding="utf-8")
