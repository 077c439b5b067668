"""Studies on disk: what is in their folders, and reading them again."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from engine.datatypes import Array
from engine.errors import DataError
from engine.validation.protocol.report import REPORT_NAME, SCHEMA_VERSION, STUDY_NAME

__all__ = [
    "PDF_NAME",
    "PREDICTIONS_FOLDER",
    "REFERENCE_FOLDER",
    "RUN_NAME",
    "StoredStudy",
    "TrialCurves",
    "list_studies",
    "name_method_folder",
    "read_study",
]

RUN_NAME = "run.json"
PDF_NAME = "report.pdf"
PREDICTIONS_FOLDER = "predictions"
REFERENCE_FOLDER = "reference"


@dataclass(frozen=True, eq=False)
class TrialCurves:
    """Angles of one trial: those of a method, and of the measured markers; (T, A), degrees."""

    time_s: Array
    names: tuple[str, ...]
    estimated_deg: Array
    reference_deg: Array


@dataclass(frozen=True, eq=False)
class StoredStudy:
    """A finished study; `document` is the content of its study.json."""

    folder: Path
    document: Mapping[str, Any]

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods, as ``features/regressor``."""
        return tuple(row["method"] for row in self.document["methods"])

    def table(self, name: str) -> list[dict[str, str]]:
        """Return the rows of a table, as text by column; empty cells are unknown.

        Raises
        ------
        DataError
            If it is not there.
        """
        path = self.folder / "tables" / f"{name}.csv"
        if not path.is_file():
            raise _incomplete(self.folder, f"tables/{name}.csv")
        with path.open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))

    def figure(self, name: str) -> Path | None:
        """Return the PNG of a figure, None where it was not drawn."""
        path = self.folder / "figures" / f"{name}.png"
        return path if path.is_file() else None

    def trials(self) -> tuple[tuple[str, str], ...]:
        """Return subject and label of every trial."""
        first = self.methods[0]
        rows = [row for row in self.table("trials") if row["method"] == first]
        return tuple((row["subject"], row["trial"]) for row in rows)

    def curves(self, method: str, subject: str, label: str) -> TrialCurves:
        """Return the angles of a trial.

        Raises
        ------
        DataError
            If they are not there.
        """
        name = f"{subject}_{label}.npz"
        estimated = _read(self.folder, f"{PREDICTIONS_FOLDER}/{name_method_folder(method)}/{name}")
        reference = _read(self.folder, f"{REFERENCE_FOLDER}/{name}")
        return TrialCurves(
            time_s=reference["time_s"],
            names=tuple(map(str, reference["angle_names"])),
            estimated_deg=estimated["angles_deg"],
            reference_deg=reference["angles_deg"],
        )

    def files(self) -> dict[str, bytes]:
        """Return report, tables and figures, by their place in the folder."""
        names = [STUDY_NAME, REPORT_NAME, PDF_NAME]
        paths = [self.folder / name for name in names]
        paths += sorted((self.folder / "tables").glob("*"))
        paths += sorted((self.folder / "figures").glob("*.png"))
        return {
            path.relative_to(self.folder).as_posix(): path.read_bytes()
            for path in paths
            if path.is_file()
        }


def name_method_folder(method: str) -> str:
    """Return the name of a method's folder."""
    return method.replace("/", "__")


def list_studies(folder: Path) -> dict[str, bool]:
    """Return the studies in a folder by name, and whether each is finished."""
    if not folder.is_dir():
        return {}
    return {
        path.name: (path / STUDY_NAME).is_file()
        for path in sorted(folder.iterdir())
        if (path / RUN_NAME).is_file() or (path / STUDY_NAME).is_file()
    }


def read_study(folder: Path) -> StoredStudy:
    """Read a finished study.

    Raises
    ------
    DataError
        If it is not finished, damaged, or of a newer program.
    """
    path = folder / STUDY_NAME
    if not path.is_file():
        raise DataError(
            f"The study {folder.name} is not finished: it has no {STUDY_NAME}. Run the same "
            "`liftlens protocol` command again; it goes on where it stopped."
        )
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        version = int(document["schema_version"])
        is_whole = bool(document["methods"]) and bool(document["tables"]["table1"]["rows"])
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{STUDY_NAME} of {folder.name} is damaged ({error}); run the same `liftlens protocol` "
            "command again, finished folds are kept."
        ) from error
    if version > SCHEMA_VERSION:
        raise DataError(
            f"The study {folder.name} was written by a newer LiftLens (version {version} of its "
            f"file, this program reads {SCHEMA_VERSION}); update LiftLens."
        )
    if not is_whole:
        raise _incomplete(folder, "its tables")
    return StoredStudy(folder, document)


def _read(folder: Path, name: str) -> dict[str, Any]:
    path = folder / name
    if not path.is_file():
        raise _incomplete(folder, name)
    with np.load(path, allow_pickle=False) as data:
        return {key: data[key] for key in data.files}


def _incomplete(folder: Path, name: str) -> DataError:
    return DataError(
        f"The study {folder.name} lacks {name}; run the same `liftlens protocol` command again, "
        "finished folds are kept."
    )
