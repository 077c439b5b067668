"""`liftlens library`: what it lists, takes out, takes in and deletes, and what it refuses."""

from __future__ import annotations

import json
import math
import zipfile

import pytest
from typer.testing import CliRunner

from engine import cli_library
from engine.cli import app
from engine.datatypes import FlagLevel
from engine.storage.library import HOME_VARIABLE, Library
from engine.storage.results import write_result
from tests.builders import make_flag, make_trial_result


@pytest.fixture
def library(tmp_path, monkeypatch):
    """Two trials: `a` of P01 in Hall 1 (high), `b` of P02 without a verdict."""
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "home"))
    found = Library.open()
    high = make_trial_result(lis=(2.2,), flags=(make_flag(FlagLevel.HIGH),))
    write_result(high, found.folder("a"))
    write_result(make_trial_result(lis=(math.inf,), flags=()), found.folder("b"))
    found.query()
    found.edit("a", version=1, label="Crate", site="Hall 1", job="Packing", person="P01")
    found.edit("b", version=1, label="Sack", site="Hall 2", job="Loading", person="P02")
    return found


def run(*words, answer=None):
    return CliRunner().invoke(app, ["library", *map(str, words)], input=answer)


def listed(*words):
    done = run("list", "--json", *words)
    assert done.exit_code == 0, done.output
    return [json.loads(line)["id"] for line in done.stdout.splitlines()]


def test_the_list_is_a_table(library):
    lines = run("list", "--order", "label").stdout.splitlines()
    assert lines[0].split()[0] == "Trial"
    assert lines[1].split()[0] == "a"
    for word in ("Crate", "P01", "Hall 1", "Packing", "2.2", "high"):
        assert word in lines[1]
    assert len(lines) == 3


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--search", "crate hall"), ["a"]),
        (("--site", "Hall 2"), ["b"]),
        (("--job", "Loading"), ["b"]),
        (("--person", "P01"), ["a"]),
        (("--level", "high"), ["a"]),
        (("--level", "none"), ["b"]),
        (("--order", "label"), ["a", "b"]),
        (("--order", "label", "--limit", "1"), ["a"]),
        (("--search", "nothing like it"), []),
    ],
)
def test_the_list_is_narrowed_and_sorted(library, words, expected):
    assert listed(*words) == expected


def test_an_index_without_bound_is_no_number_in_json(library):
    lines = run("list", "--json", "--person", "P02").stdout.splitlines()
    assert json.loads(lines[0])["lifting_index"] is None


def test_a_damaged_trial_is_listed(library):
    library.folder("bad").mkdir()
    (library.folder("bad") / "trial.json").write_text("{")
    assert "(damaged)" in run("list").stdout


def test_an_empty_library_and_no_match_are_said(library):
    assert "No trial matches" in run("list", "--search", "zzz").stdout
    run("delete", "a", "b", "--yes")
    assert "The library is empty" in run("list").stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("list", "--level", "red"), "high"),
        (("list", "--order", "size"), "newest"),
        (("list", "--limit", "0"), "1 or more"),
        (("export", "out.zip", "zz"), "no trial 'zz'"),
        (("export", "out.tar"), "zip file"),
        (("export", "out.zip", "a", "--site", "Hall 1"), "not both"),
        (("export", "out.zip", "--site", "Hall 9"), "nothing to export"),
        (("delete",), "Name the trials"),
        (("delete", "a", "--person", "P01", "--yes"), "Name the trials"),
        (("delete", "zz", "--yes"), "no trial 'zz'"),
        (("delete", "../a", "--yes"), "trial id"),
        (("delete", "--person", "P09", "--yes"), "P09"),
    ],
)
def test_wrong_use_is_exit_2_and_one_sentence(library, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    done = run(*words)
    assert done.exit_code == 2
    assert done.stderr.startswith("Error: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert {entry.id for entry in library.entries()} == {"a", "b"}
    assert not list(tmp_path.glob("out.*"))


def test_an_export_comes_in_elsewhere_with_all_that_people_added(library, tmp_path, monkeypatch):
    library.add_note("a", "Mind the pallet")
    out = tmp_path / "all.zip"
    assert run("export", out).exit_code == 0
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "elsewhere"))
    done = run("import", out)
    assert done.exit_code == 0
    assert sorted(done.stdout.splitlines()) == ["Imported: a", "Imported: b"]
    assert [note.text for note in Library.open().record("a").notes] == ["Mind the pallet"]
    assert run("import", out).stdout.splitlines() == ["Already there: a", "Already there: b"]


def test_an_export_holds_what_was_named(library, tmp_path):
    out = tmp_path / "one.zip"
    run("export", out, "b")
    tops = {name.split("/")[1] for name in zipfile.ZipFile(out).namelist() if "/" in name}
    assert tops == {"b"}


def test_a_file_is_replaced_only_on_yes(library, tmp_path):
    out = tmp_path / "mine.zip"
    out.write_bytes(b"mine")
    done = run("export", out)
    assert done.exit_code == 2
    assert "--yes" in done.stderr
    assert out.read_bytes() == b"mine"
    assert run("export", out, "--yes").exit_code == 0
    assert zipfile.is_zipfile(out)


@pytest.mark.parametrize("content", [None, b"", b"no zip"], ids=["missing", "empty", "other"])
def test_what_is_no_export_is_exit_3_and_changes_nothing(library, tmp_path, content):
    path = tmp_path / "in.zip"
    if content is not None:
        path.write_bytes(content)
    done = run("import", path)
    assert done.exit_code == 3
    assert "in.zip" in done.stderr
    assert len(library.entries()) == 2


def test_a_deletion_takes_all_that_belongs_to_it(library):
    (library.upload_folder("a") / "clip.mp4").write_bytes(b"video")
    done = run("delete", "a", "--yes")
    assert (done.exit_code, done.stdout) == (0, "Deleted: a\n")
    assert [entry.id for entry in library.entries()] == ["b"]
    assert not list(library.root.rglob("clip.mp4"))


def test_a_person_goes_with_all_trials(library):
    assert run("delete", "--person", "P02", "--yes").stdout == "Deleted: 1 trial of P02\n"
    assert [entry.id for entry in library.entries()] == ["a"]


def test_without_a_terminal_nothing_is_deleted_unasked(library):
    done = run("delete", "a", answer="y\n")
    assert done.exit_code == 2
    assert "--yes" in done.stderr
    assert library.has("a")


@pytest.mark.parametrize(("answer", "code", "is_left"), [("y\n", 0, False), ("n\n", 130, True)])
def test_at_a_terminal_the_answer_counts(library, monkeypatch, answer, code, is_left):
    monkeypatch.setattr(cli_library, "_ask", lambda: lambda _question: answer == "y\n")
    done = run("delete", "a")
    assert done.exit_code == code
    assert library.has("a") is is_left


def test_help_says_what_there_is():
    shown = run("--help").output
    assert all(word in shown for word in ("list", "export", "import", "delete"))
