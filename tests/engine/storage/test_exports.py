"""Exports are whole files in the formats offered, and honest about the others."""

from __future__ import annotations

from pathlib import Path

import pytest

from engine.errors import ConfigError, DataError, OutputError
from engine.storage import exports
from engine.storage.exports import EXPORT_FORMATS, export_result
from engine.storage.results import write_result
from tests.builders import make_trial_result


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_result(make_trial_result(), tmp_path / "crate")


@pytest.mark.parametrize(
    ("format_", "name"),
    [
        ("trc", "keypoints.trc"),
        ("mot", "angles.mot"),
        ("CSV", "angles.csv"),
        (".csv", "angles.csv"),
    ],
)
def test_an_export_equals_the_file_of_the_result(
    folder: Path, tmp_path: Path, format_: str, name: str
) -> None:
    out = export_result(folder, format_, tmp_path / "new" / "file.out")
    assert out == tmp_path / "new" / "file.out"
    assert out.read_text() == (folder / name).read_text()
    assert [p.name for p in out.parent.iterdir()] == ["file.out"]


def test_the_file_is_named_after_the_result(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert export_result(folder, "mot", tmp_path).name == "crate_angles.mot"
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert export_result(folder, "trc") == tmp_path / "here" / "crate_keypoints.trc"


@pytest.mark.parametrize(("format_", "start"), [("c3d", b"\x02P"), ("bvh", b"HIERARCHY")])
def test_formats_made_on_demand_are_written(
    folder: Path, tmp_path: Path, format_: str, start: bytes
) -> None:
    assert export_result(folder, format_, tmp_path).name == f"crate_motion.{format_}"
    assert (tmp_path / f"crate_motion.{format_}").read_bytes().startswith(start)


def test_unknown_formats_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'xlsx'"):
        export_result(folder, "xlsx", tmp_path / "x")
    assert EXPORT_FORMATS == ("trc", "mot", "csv", "c3d", "bvh")


def test_what_is_no_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no LiftLens result"):
        export_result(tmp_path, "csv", tmp_path / "x.csv")


def test_a_failure_leaves_the_earlier_file(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out" / "x.csv"
    export_result(folder, "csv", out)
    before = out.read_text()

    def half(_: object, path: Path) -> None:
        path.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(exports, "write_angles_csv", half)
    with pytest.raises(OutputError, match="the disk is full"):
        export_result(folder, "csv", out)
    assert out.read_text() == before
    assert [p.name for p in out.parent.iterdir()] == ["x.csv"]
