"""`liftlens validate`: the whole way on bundled markers, and what is refused."""

from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from engine import validate
from engine.cli import app
from engine.errors import OutputError
from engine.storage.results import read_result
from engine.validate import compare_results, write_agreement
from engine.validation.reference.files import read_reference
from tests.engine.validation.pairs import (
    KNEE_BIAS_DEG,
    LAG_S,
    MARKERS,
    OTHER_MARKERS,
    store_lift,
)
from tests.engine.validation.recordings import write_mot


@pytest.fixture(scope="module")
def lift(tmp_path_factory):
    return store_lift(tmp_path_factory.mktemp("results") / "lift")


@pytest.fixture(scope="module")
def other_lift(tmp_path_factory):
    return store_lift(
        tmp_path_factory.mktemp("results") / "other",
        subject="P02",
        label="Other",
        job="Stacking",
        markers=OTHER_MARKERS,
        lag_s=-0.1,
    )


@pytest.fixture(autouse=True)
def no_figures(monkeypatch, request):
    """Leave the figures out, which have tests of their own, unless a test is about them."""
    if not request.node.get_closest_marker("slow"):
        monkeypatch.setattr("engine.validation.figures.draw_figures", lambda _: {})


def run(*arguments):
    return CliRunner().invoke(app, ["validate", *map(str, arguments)])


def last_line(result):
    return result.stderr.strip().splitlines()[-1]


@pytest.mark.slow
def test_the_whole_way_finds_what_was_put_in(lift, tmp_path):
    out = tmp_path / "out"
    result = run(lift, "--reference", MARKERS, "--out", out)
    assert result.exit_code == 0, result.stderr
    document = json.loads((out / "agreement.json").read_text())
    trial = document["trials"][0]
    assert trial["source"] == "computed"
    assert trial["solver"] == "geometric"
    assert trial["time_alignment"]["lag_s"] == pytest.approx(LAG_S, abs=0.003)
    angles = {a["name"]: a for a in trial["angles"]}
    knee = angles.pop("knee_flexion_r")
    assert knee["measured"]["bias_deg"] == pytest.approx(KNEE_BIAS_DEG, abs=0.1)
    assert knee["without_offset"]["mae_deg"] < 0.5
    # Angles against the line of the hips are undefined in a deep bend; all others are exact.
    assert max(a["measured"]["rmse_deg"] for a in angles.values()) < 1.0
    assert {p.name for p in out.iterdir()} == {
        "agreement.json",
        "summary.html",
        "tables",
        "figures",
    }
    assert (out / "figures" / "curves_01.png").stat().st_size > 10_000
    assert "most knee flexion (right) with 6.0°" in result.stdout


def test_several_pairs_are_pooled_by_person_and_task(lift, other_lift, tmp_path):
    result = run(
        lift, other_lift, "--reference", MARKERS, "--reference", OTHER_MARKERS,
        "--out", tmp_path / "out",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    document = json.loads((tmp_path / "out" / "agreement.json").read_text())
    assert document["subjects"] == ["P01", "P02"]
    assert set(document["tasks"]) == {"Packing", "Stacking"}
    knee = next(a for a in document["angles"] if a["name"] == "knee_flexion_r")
    assert (knee["unit"], knee["n_subjects"]) == ("subject", 2)
    assert knee["pooled"]["bias_deg"] == pytest.approx(KNEE_BIAS_DEG, abs=0.1)
    with (tmp_path / "out" / "tables" / "angles.csv").open() as file:
        tasks = {row["task"] for row in csv.DictReader(file)}
    assert tasks == {"all", "Packing", "Stacking"}


def test_recorded_angles_lose_their_offset_which_is_listed(lift, tmp_path):
    stored = read_result(lift)
    time, names = stored.angles.time_s, ("knee_flexion_l", "hip_flexion_l", "hip_flexion_r")
    columns = {
        "knee_angle_l": stored.angles["knee_flexion_l"] - 9.0,
        "hip_flexion_l": stored.angles["hip_flexion_l"],
        "hip_flexion_r": stored.angles["hip_flexion_r"],
    }
    rate_hz = (time.size - 1) / (time[-1] - time[0])
    path = write_mot(tmp_path / "ik.mot", columns, rate_hz=rate_hz)
    result = run(lift, "--reference", path, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    trial = json.loads((tmp_path / "out" / "agreement.json").read_text())["trials"][0]
    assert (trial["source"], trial["is_offset_removed"]) == ("recorded", True)
    knee = next(a for a in trial["angles"] if a["name"] == names[0])
    assert knee["offset_deg"] == pytest.approx(9.0, abs=0.1)
    assert knee["without_offset"]["rmse_deg"] < 0.2
    assert "taken out first" in result.stdout


def test_the_default_folder_lies_beside_the_result(lift, tmp_path):
    own = tmp_path / "mine"
    shutil.copytree(lift, own)
    assert run(own, "--reference", MARKERS, "--quiet").exit_code == 0
    assert (tmp_path / "mine_agreement" / "agreement.json").is_file()


def test_an_earlier_comparison_is_replaced_and_nothing_else(lift, tmp_path):
    out = tmp_path / "out"
    assert run(lift, "--reference", MARKERS, "--out", out).exit_code == 0
    (out / "old.txt").write_text("left over")
    assert run(lift, "--reference", MARKERS, "--out", out).exit_code == 0
    assert not (out / "old.txt").exists()
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.txt").write_text("do not lose")
    result = run(lift, "--reference", MARKERS, "--out", precious)
    assert result.exit_code == 2
    assert "holds other files" in last_line(result)
    assert [p.name for p in precious.iterdir()] == ["thesis.txt"]


def test_a_failure_while_writing_leaves_the_earlier_comparison(lift, tmp_path, monkeypatch):
    agreement = compare_results([(read_result(lift), read_reference(MARKERS))])
    out = write_agreement(agreement, tmp_path / "out")
    before = (out / "agreement.json").read_bytes()

    def fail(_whole, _folder):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(validate, "_put_in_place", fail)
    with pytest.raises(OutputError, match="disk is full"):
        write_agreement(agreement, out)
    assert (out / "agreement.json").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_profile_is_written_and_read_back(lift, tmp_path):
    profile = tmp_path / "lab.toml"
    first = run(
        lift, "--reference", MARKERS, "--out", tmp_path / "a", "--save-profile", profile
    )  # fmt: skip
    assert first.exit_code == 0, first.stderr
    second = run(lift, "--reference", MARKERS, "--out", tmp_path / "b", "--profile", profile)
    assert second.exit_code == 0, second.stderr
    a, b = (json.loads((tmp_path / x / "agreement.json").read_text()) for x in "ab")
    assert a["angles"] == b["angles"]
    findings = {f["what"]: f for f in b["trials"][0]["reference"]["findings"]}
    assert findings["labels"]["value"] == "profile"


def refused(sentence, exit_code, *arguments):
    result = run(*arguments)
    assert result.exit_code == exit_code
    line = last_line(result)
    assert line.startswith("Error: ")
    assert sentence in line


def test_wrong_use_ends_with_2(lift, tmp_path):
    out = ("--out", tmp_path / "out")
    refused("one --reference per result", 2, lift, lift, "--reference", MARKERS, *out)
    refused("given twice", 2, lift, lift, "--reference", MARKERS, "--reference", MARKERS, *out)
    refused("auto, keep, remove", 2, lift, "--reference", MARKERS, "--offset", "some", *out)
    refused("must be positive", 2, lift, "--reference", MARKERS, "--max-lag", "-1", *out)
    refused("profile", 2, lift, "--reference", MARKERS, "--profile", tmp_path / "no.toml", *out)
    assert not (tmp_path / "out").exists()


def test_unusable_input_ends_with_3(lift, tmp_path):
    out = ("--out", tmp_path / "out")
    text = tmp_path / "notes.docx"
    text.write_text("nothing")
    refused("no LiftLens result", 3, tmp_path, "--reference", MARKERS, *out)
    refused("There is no file", 3, lift, "--reference", tmp_path / "no.trc", *out)
    refused("ending that is not known", 3, lift, "--reference", text, *out)
    assert not (tmp_path / "out").exists()


def test_exchanged_sides_are_refused(lift, tmp_path):
    swapped = tmp_path / "swapped.trc"
    lines = MARKERS.read_text().splitlines()
    other = {"L": "R", "R": "L"}
    labels = [
        other[name[0]] + name[1:] if name[:1] in other else name for name in lines[3].split("\t")
    ]
    lines[3] = "\t".join(labels)
    swapped.write_text("\n".join(lines) + "\n")
    refused("exchanged", 3, lift, "--reference", swapped, "--out", tmp_path / "out")


def test_another_movement_is_refused(lift, tmp_path):
    time = np.arange(0, 6, 0.01)
    path = write_mot(
        tmp_path / "jump.mot",
        {"knee_angle_l": 40 * np.sin(9 * time), "hip_flexion_l": 30 * np.cos(13 * time)},
    )
    refused("does not fit", 3, lift, "--reference", path, "--out", tmp_path / "out")
