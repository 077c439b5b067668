"""What the programs of others read from LiftLens's exports, and how far it is from the result.

Run from the project folder::

    python -m benchmarks.exports --opensim PYTHON

A bundled clip is assessed once (kept in ``.benchmark_cache/report``) and exported in every format.
Each file is then read by a program that knows nothing of LiftLens: TRC and MOT by OpenSim, C3D by
ezc3d, CSV by pandas, BVH by the package `bvh` and SciPy's rotations. Compared are the number of
rows, the names, the times, every value, and whether a missing value is missing there too. A BVH
file is a figure of rigid bones without gaps: what it can keep is the direction of each bone in the
frames in which its ends were seen, and that is compared.

``--opensim`` names a Python that has the package `opensim`; without one these rows say so.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.report import assess_samples
from engine.skeletons import get_skeleton
from engine.storage.exports import EXPORT_FORMATS, export_result
from engine.storage.results import StoredResult, read_result

RESULTS = Path(__file__).with_name("results") / "exports.txt"
LIMITS = {"trc": 0.001, "mot": 0.0001, "csv": 0.0001, "c3d": 0.001, "bvh": 0.01}
"""Largest difference: mm of keypoints, degrees of angles and bones; written digits decide."""
TIME_LIMIT_S = 1e-6
OPENSIM = """
import json, sys, opensim
opensim.Logger.setLevelString("error")
path = sys.argv[1]
if path.endswith(".trc"):
    table = opensim.TimeSeriesTableVec3(path)
    rows = [[[v.get(k) for k in range(3)] for v in
             (table.getRowAtIndex(i).getElt(0, j) for j in range(table.getNumColumns()))]
            for i in range(table.getNumRows())]
else:
    table = opensim.TimeSeriesTable(path)
    rows = [[table.getRowAtIndex(i).getElt(0, j) for j in range(table.getNumColumns())]
            for i in range(table.getNumRows())]
meta = {key: table.getTableMetaDataString(key) for key in ("Units", "inDegrees")
        if table.hasTableMetaDataKey(key)}
print("READ" + json.dumps({"times": list(table.getIndependentColumn()), "rows": rows,
      "names": list(table.getColumnLabels()), "meta": meta, "version": opensim.GetVersion()}))
"""


class MissingReaderError(Exception):
    """A reader is not installed here."""


@dataclass(frozen=True)
class Found:
    """What a reader made of a file: times (T,), values (T, N) or (T, N, 3), names."""

    reader: str
    times: np.ndarray
    values: np.ndarray
    names: list[str]


@dataclass(frozen=True)
class Row:
    """The comparison of one format."""

    format: str
    reader: str
    n_rows: int
    n_columns: int
    time_s: float
    difference: float
    unit: str
    n_missing: int
    is_kept: bool


def read_opensim(path: Path, python: str | None) -> Found:
    """Read TRC or MOT by OpenSim, in a Python that has it."""
    done = subprocess.run(
        [python or sys.executable, "-c", OPENSIM, str(path)],
        capture_output=True,
        text=True,
        check=False,
    )
    line = next((x for x in done.stdout.splitlines() if x.startswith("READ")), None)
    if line is None:
        if "No module named 'opensim'" in done.stderr:
            raise MissingReaderError("opensim")
        raise SystemExit(f"OpenSim can't read {path.name}: {done.stderr[-500:]}")
    read = json.loads(line[4:])
    expected = {"Units": "mm"} if path.suffix == ".trc" else {"inDegrees": "yes"}
    if not expected.items() <= read["meta"].items():
        raise SystemExit(f"OpenSim takes {path.name} for {read['meta']}, expected {expected}.")
    return Found(
        f"opensim {read['version'].split('-')[0]}",
        np.array(read["times"]),
        np.array(read["rows"], dtype=float),
        read["names"],
    )


def read_ezc3d(path: Path, _python: str | None) -> Found:
    """Read the points of a C3D file; a negative residual is a missing one."""
    import ezc3d

    file = ezc3d.c3d(str(path))
    points = file["data"]["points"][:3].transpose(2, 1, 0).copy()
    points[file["data"]["meta_points"]["residuals"][0].T < 0] = np.nan
    point = file["parameters"]["POINT"]
    rate = point["RATE"]["value"][0]
    return Found(_name("ezc3d"), np.arange(len(points)) / rate, points, point["LABELS"]["value"])


def read_pandas(path: Path, _python: str | None) -> Found:
    """Read the angles of a CSV file."""
    import pandas as pd

    table = pd.read_csv(path)
    names = [n for n in table if n.endswith("_deg") and not n.endswith("_sigma_deg")]
    return Found(
        _name("pandas"),
        table["time_s"].to_numpy(),
        table[names].to_numpy(float),
        [name.removesuffix("_deg") for name in names],
    )


def read_bvh(path: Path, _python: str | None) -> Found:
    """Read a BVH file and walk down its bones: joints in mm of the world."""
    from bvh import Bvh
    from scipy.spatial.transform import Rotation

    file = Bvh(path.read_text(encoding="ascii"))
    found = {}
    for name in file.get_joints_names():
        turns = np.array(file.frames_joint_channels(name, ["Zrotation", "Xrotation", "Yrotation"]))
        turn = Rotation.from_euler("ZXY", turns, degrees=True)
        parent = file.joint_parent(name)
        if parent is None:
            channels = ["Xposition", "Yposition", "Zposition"]
            found[name] = np.array(file.frames_joint_channels(name, channels)), turn
        else:
            place, above = found[parent.name]
            found[name] = place + above.apply(np.array(file.joint_offset(name))), above * turn
    to_world = np.array([[0, 0, 10], [0, 10, 0], [-10, 0, 0]])
    values = np.stack([place @ to_world.T for place, _ in found.values()], axis=1)
    times = np.arange(file.nframes) * file.frame_time
    return Found(_name("bvh"), times, values, list(found))


READERS: dict[str, Callable[[Path, str | None], Found]] = {
    "trc": read_opensim,
    "mot": read_opensim,
    "csv": read_pandas,
    "c3d": read_ezc3d,
    "bvh": read_bvh,
}
BVH_JOINTS = {"UpLeg": "hip", "Leg": "knee", "Foot": "ankle"} | {
    "Arm": "shoulder",
    "ForeArm": "elbow",
    "Hand": "wrist",
}
BVH_BONES = [
    (f"{side}{start}", f"{side}{end}")
    for side in ("Left", "Right")
    for start, end in (("UpLeg", "Leg"), ("Leg", "Foot"), ("Arm", "ForeArm"), ("ForeArm", "Hand"))
]
"""Bones of the figure between joints that are keypoints too."""


def _name(package: str) -> str:
    return f"{package} {importlib.metadata.version(package)}"


def expect(stored: StoredResult, format_: str, found: Found) -> tuple[np.ndarray, np.ndarray, str]:
    """Return what the file should hold, what was found in the same order, and the unit."""
    names = list(get_skeleton(stored.corrected.skeleton).keypoints)
    points = 1000 * stored.corrected.position
    if format_ == "trc":
        _require(found.names == names, "names of keypoints", found.names)
        return points, found.values, "mm"
    if format_ in ("mot", "csv"):
        _require(found.names == list(stored.angles.names), "names of angles", found.names)
        return stored.angles.value_deg, found.values, "deg"
    if format_ == "c3d":
        _require(found.names == [*names, *stored.angles.names], "labels", found.names)
        return points, found.values[:, : len(names)], "mm"
    return _expect_bones(stored, names, found)


def _expect_bones(
    stored: StoredResult, names: list[str], found: Found
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return how far each bone is turned from the measured segment, beside zeros."""
    bones = [bone for bone in BVH_BONES if set(bone) <= set(found.names)]
    _require(len(bones) >= 4, "bones of arms and legs", found.names)
    source = stored.corrected if stored.body is None else stored.body.joints
    there = np.isfinite(source.position).any(axis=(0, 2))
    position = np.where(there[None, :, None], source.position, stored.corrected.position)

    def place(joint: str) -> np.ndarray:
        side = "left" if joint.startswith("Left") else "right"
        keypoint = f"{side}_{BVH_JOINTS[joint.removeprefix('Left').removeprefix('Right')]}"
        return np.asarray(position[:, names.index(keypoint)])

    turned = []
    for start, end in bones:
        measured = place(end) - place(start)
        shown = found.values[:, found.names.index(end)] - found.values[:, found.names.index(start)]
        across = np.linalg.norm(np.cross(measured, shown), axis=1)
        turned.append(np.degrees(np.arctan2(across, np.sum(measured * shown, axis=1))))
    angles = np.column_stack(turned)
    return np.where(np.isfinite(angles), 0.0, np.nan), angles, "deg"


def _require(is_there: bool, what: str, got: object) -> None:
    if not is_there:
        raise SystemExit(f"The file has other {what} than the result: {got}")


def compare(stored: StoredResult, format_: str, folder: Path, python: str | None) -> Row:
    """Export, read by another program, and compare."""
    path = export_result(stored.folder, format_, folder)
    found = READERS[format_](path, python)
    expected, values, unit = expect(stored, format_, found)
    times = stored.corrected.time_s - (stored.corrected.time_s[0] if format_ == "bvh" else 0)
    if format_ == "c3d":
        times = times - times[0]
    is_same_length = len(times) == len(found.times)
    time_s = float(np.abs(times - found.times).max()) if is_same_length else np.inf
    missing = ~np.isfinite(expected)
    is_kept = is_same_length and values.shape == expected.shape
    difference = float(np.nanmax(np.abs(values - expected))) if is_kept else np.inf
    is_kept = is_kept and np.array_equal(~np.isfinite(values), missing)
    # C3D and BVH have one rate for all frames; the others true times.
    limit_s = 0.5 * float(np.median(np.diff(times))) if format_ in ("c3d", "bvh") else TIME_LIMIT_S
    is_kept = is_kept and difference <= LIMITS[format_] and time_s <= limit_s
    return Row(
        format_,
        found.reader,
        len(found.times),
        len(found.names),
        time_s,
        difference,
        unit,
        int(missing.sum()),
        is_kept,
    )


def render(rows: list[Row | str], command: str, clip: str) -> str:
    """Return the table."""
    machine = f"{platform.machine()}, Python {platform.python_version()}, {os.cpu_count()} cores"
    head = f"{'format':<8}{'read by':<18}{'rows':>6}{'columns':>9}{'time s':>10}"
    lines = [
        f"# {command}",
        f"# {machine}; clip {clip}; nothing is random",
        f"{head}{'largest difference':>21}{'missing':>9}",
    ]
    for row in rows:
        if isinstance(row, str):
            lines.append(row)
            continue
        difference = f"{row.difference:.6f} {row.unit}"
        lines.append(
            f"{row.format:<8}{row.reader:<18}{row.n_rows:>6}{row.n_columns:>9}{row.time_s:>10.6f}"
            f"{difference:>21}{row.n_missing:>9}  {'ok' if row.is_kept else 'MISSED'}"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Read every export by another program, print the table and keep it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--opensim", metavar="PYTHON", help="a Python that has opensim")
    parser.add_argument("--clip", type=int, default=0, help="number of the bundled clip")
    given = parser.parse_args()
    source = assess_samples()[given.clip]
    stored = read_result(source)
    rows: list[Row | str] = []
    with tempfile.TemporaryDirectory() as folder:
        for format_ in EXPORT_FORMATS:
            try:
                rows.append(compare(stored, format_, Path(folder), given.opensim))
            except MissingReaderError as missing:
                rows.append(f"{format_:<8}not read: {missing} is not installed (see --opensim)")
    command = "python -m benchmarks.exports" + (" --opensim PYTHON" if given.opensim else "")
    text = render(rows, command, source.name)
    RESULTS.write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
