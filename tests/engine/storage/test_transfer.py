"""Trials travel whole; a file that would do harm takes nothing in."""

from __future__ import annotations

import dataclasses
import json
import math
import zipfile
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from engine.datatypes import FlagLevel
from engine.errors import ConfigError, DataError, OutputError
from engine.storage import transfer
from engine.storage.library import Library
from engine.storage.results import read_result, write_result
from tests.builders import make_flag, make_trial_result
from tests.engine.storage.trials import add

Make = Callable[[], Library]


def stock(library: Library) -> None:
    """Make a trial with everything that can belong to one, and two plain ones."""
    add(library, "a", person="P01", lis=(math.inf,))
    add(library, "b", person="P01", job="Loading")
    add(library, "c", person="P02", site="Hall 9")
    write_result(make_trial_result(n_frames=2, lis=(3.0,)), library.folder("a"))
    library.entries()
    version = library.edit("a", version=1, label="Größe 📦", tags=("x", "y"))
    library.review("a", make_flag(FlagLevel.HIGH), "rejected", version=version, reason="why")
    library.add_note("a", "a note", author="AB", at_s=0.5)
    library.set_reference("Good", "a", lift_index=0)
    library.set_agreement("P01", keep_until=date(2030, 1, 1))
    calibration = library.root.parent / "cal.toml"
    calibration.write_text("focal = 1")
    for name in ("a", "b"):
        library.attach(name, calibration, role="calibration")
    (library.folder("a") / "reference").mkdir()
    (library.folder("a") / "reference" / "markers.trc").write_text("markers")


def test_all_that_belongs_to_a_trial_travels(
    any_library: Library, other_library: Make, tmp_path: Path
) -> None:
    stock(any_library)
    archive = any_library.export(tmp_path / "out.zip", trials=["a"])
    before = any_library.record("a")
    there = other_library()
    assert there.import_archive(archive).imported == {"a": "a"}
    assert there.record("a") == dataclasses.replace(before, version=1)
    assert [r.li for r in before.results] == [math.inf, 3.0]
    assert read_result(there.folder("a")).risk["rnle"].value == 3.0
    assert (there.folder("a") / "reference" / "markers.trc").read_text() == "markers"
    assert there.attachments("a")[0].path.read_text() == "focal = 1"
    assert there.references() == any_library.references()
    assert there.people()[0].keep_until == date(2030, 1, 1)
    (entry,) = there.query(search="größe x").entries
    assert (entry.li, entry.worst_level) == (3.0, FlagLevel.HIGH)


@pytest.mark.parametrize(
    ("choice", "expected"),
    [({"person": "P01"}, "ab"), ({"job": "Packing", "site": "Hall 3"}, "a"), ({}, "abc")],
    ids=str,
)
def test_a_person_or_a_job_can_be_taken_out(
    library: Library, other_library: Make, tmp_path: Path, choice: dict[str, str], expected: str
) -> None:
    stock(library)
    report = other_library().import_archive(library.export(tmp_path / "out.zip", **choice))  # type: ignore[arg-type]
    assert "".join(sorted(report.imported)) == expected


def test_a_taken_id_is_changed_and_the_same_result_stays(library: Library, tmp_path: Path) -> None:
    stock(library)
    archive = library.export(tmp_path / "out.zip", person="P01")
    library.delete("a")
    add(library, "a", label="Another")
    report = library.import_archive(archive)
    assert report.already_there == ("b",)
    assert report.imported["a"] != "a"
    assert library.record("a").names.label == "Another"
    assert library.record(report.imported["a"]).names.label == "Größe 📦"


def test_nothing_to_export_is_said(library: Library, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nothing to export"):
        library.export(tmp_path / "out.zip", person="P99")
    assert not (tmp_path / "out.zip").exists()


def rewrite(archive: Path, change: Callable[[dict[str, Any], dict[str, bytes]], None]) -> None:
    """Change the list and the files of an export."""
    with zipfile.ZipFile(archive) as packed:
        files = {name: packed.read(name) for name in packed.namelist()}
    manifest = json.loads(files.pop("manifest.json"))
    change(manifest, files)
    with zipfile.ZipFile(archive, "w") as packed:
        packed.writestr("manifest.json", json.dumps(manifest))
        for name, content in files.items():
            packed.writestr(name, content)


def _climb(path: str) -> Callable[[dict[str, Any], dict[str, bytes]], None]:
    def change(manifest: dict[str, Any], files: dict[str, bytes]) -> None:
        file = manifest["trials"][0]["files"][0]
        files[f"trials/a/{path}"] = files.pop(f"trials/a/{file['path']}")
        file["path"] = path

    return change


def _climb_by_hash(manifest: dict[str, Any], files: dict[str, bytes]) -> None:
    kept = manifest["artefacts"][0]
    path = "../../../../evil"
    files[f"artefacts/{path}"] = files.pop(f"artefacts/{kept['sha256']}")
    kept["sha256"] = path


def _tamper(manifest: dict[str, Any], files: dict[str, bytes]) -> None:
    files["trials/a/tracks.npz"] = files["trials/a/tracks.npz"][:-1] + b"?"


def _shrink(manifest: dict[str, Any], files: dict[str, bytes]) -> None:
    manifest["trials"][0]["files"][0]["size"] -= 1


HARM: dict[str, tuple[Callable[[dict[str, Any], dict[str, bytes]], Any], str]] = {
    "up": (_climb("../../evil"), "leads out"),
    "absolute": (_climb("/tmp/evil"), "leads out"),
    "backslash": (_climb("..\\evil"), "leads out"),
    "drive": (_climb("C:evil"), "leads out"),
    "hidden": (_climb(".bashrc"), "leads out"),
    "id": (lambda m, _: m["trials"][0].update(id="../x"), "can't be the id"),
    "hash": (_climb_by_hash, "is no SHA-256"),
    "tampered": (_tamper, "not what was exported"),
    "larger": (_shrink, "larger than announced"),
    "stranger": (lambda _, f: f.update({"trials/a/evil.sh": b""}), "its list does not"),
    "missing": (lambda _, f: f.pop("trials/a/tracks.npz"), "lacks"),
    "newer": (lambda m, _: m.update(version=99), "newer LiftLens"),
    "other": (lambda m, _: m.update(format="x"), "another program"),
    "no trials": (lambda m, _: m.pop("trials"), "not as expected"),
    "bad rows": (lambda m, _: m["trials"][0]["notes"][0].update(text=None), "contradict"),
    "bad column": (lambda m, _: m["trials"][0]["notes"][0].update(evil=1), "not as expected"),
    "bad time": (lambda m, _: m["trials"][0]["notes"][0].update(created_at="x"), "not as expect"),
    "verdict": (lambda m, _: m["trials"][0]["reviews"][0].update(verdict="x"), "A flag is"),
    "twice": (lambda m, _: m["trials"].append(m["trials"][0]), "twice"),
}


def test_what_would_do_harm_takes_nothing_in(
    library: Library, other_library: Make, tmp_path: Path
) -> None:
    stock(library)
    there = other_library()
    good = library.export(tmp_path / "good.zip", trials=["a"]).read_bytes()
    for name, (change, message) in HARM.items():
        bad = tmp_path / "bad.zip"
        bad.write_bytes(good)
        rewrite(bad, change)
        with pytest.raises((DataError, ConfigError), match=message):
            there.import_archive(bad)
        assert there.entries() == (), name
        assert list(there.trials.iterdir()) == [], name
        assert there.people() == (), name
    assert not list(tmp_path.rglob("evil*"))


@pytest.mark.parametrize("content", [b"", b"PK\x05\x06", b"no zip", None], ids=str)
def test_what_is_no_export_is_one_sentence(
    library: Library, tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "x.zip"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"no usable export|can't be opened"):
        library.import_archive(path)


def test_a_cut_off_export_takes_nothing_in(
    library: Library, other_library: Make, tmp_path: Path
) -> None:
    stock(library)
    path = library.export(tmp_path / "out.zip")
    whole = path.read_bytes()
    for share in (0.1, 0.5, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(DataError):
            other_library().import_archive(path)
    assert other_library().is_empty


def test_a_full_disk_is_said_before_anything_is_written(
    library: Library, other_library: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stock(library)
    path = library.export(tmp_path / "out.zip")
    usage = type("Usage", (), {"free": 10})
    monkeypatch.setattr(transfer.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(OutputError, match="0 MB are free"):
        other_library().import_archive(path)


def test_an_import_that_fails_late_takes_nothing_in(
    library: Library, other_library: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stock(library)
    path = library.export(tmp_path / "out.zip")
    there = other_library()
    monkeypatch.setattr(transfer, "_keep_agreements", lambda *_: 1 / 0)
    with pytest.raises(DataError):
        there.import_archive(path)
    assert there.entries() == ()
    assert list(there.trials.iterdir()) == []
