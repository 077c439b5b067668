"""What the page of validation studies asks of the engine, behind Streamlit's caches."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import streamlit as st

from dashboard import cache
from engine.protocol_stored import StoredStudy, list_studies, read_study

STUDIES_FOLDER = "studies"
"""Inside the library; nothing else on the computer is opened."""


def studies_folder() -> Path:
    """Return where studies are looked for."""
    return cache.library().root / STUDIES_FOLDER


def studies() -> dict[str, bool]:
    """Return the studies by name, and whether each is finished."""
    return list_studies(studies_folder())


def study(name: str) -> StoredStudy:
    """Return a finished study.

    Raises
    ------
    DataError
        If it is not finished or damaged.
    """
    folder = studies_folder() / name
    path = folder / "study.json"
    stamp = path.stat().st_mtime_ns if path.is_file() else 0
    return _read(str(folder), stamp)


@st.cache_resource(max_entries=4, show_spinner=False)
def _read(folder: str, stamp: int) -> StoredStudy:
    return read_study(Path(folder))


def zip_study(name: str) -> bytes:
    """Return report, tables and figures as one archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, content in study(name).files().items():
            archive.writestr(f"{name}/{path}", content)
    return buffer.getvalue()
