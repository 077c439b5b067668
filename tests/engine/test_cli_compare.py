"""`liftlens compare`, behind the command line."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from engine.cli_compare import CompareRequest, run_compare
from engine.datatypes import JointAngles
from engine.errors import AssessmentError, ConfigError, EngineError
from engine.storage.results import write_result
from tests.builders import make_pose_track, make_trial, make_trial_result
from tests.engine.form.performances import DEPTH_DEG, make_lift_clip, make_squats


def store(folder, clip, **changes):
    """Write a result that moves like `clip`; its track is another one, of the same length."""
    n = len(clip.time_s)
    result = make_trial_result(
        n_frames=n,
        trial=make_trial(label=folder.name),
        angles=clip.angles,
        lifts=clip.lifts,
        raw=make_pose_track(time_s=clip.time_s, n_frames=n),
        corrected=make_pose_track(time_s=clip.time_s, n_frames=n),
        **changes,
    )
    return write_result(result, folder)


def run(*args, **options):
    lines, notes = [], []
    run_compare(CompareRequest(*args, **options), say=lines.append, warn=notes.append)
    return "\n".join(lines), "\n".join(notes)


@pytest.fixture
def reference(tmp_path):
    return store(tmp_path / "reference", make_lift_clip())


def test_a_result_beside_itself_scores_100(reference):
    said, notes = run(reference, reference)
    assert "Score 100 of 100" in said
    assert "*" not in said.split("deg (")[1].split("\n", 1)[1]
    assert notes == ""


def test_a_difference_is_printed_and_written(reference, tmp_path):
    attempt = store(tmp_path / "attempt", make_lift_clip(depth={**DEPTH_DEG, "trunk_flexion": 75}))
    said, _ = run(reference, attempt, out=tmp_path / "out")
    assert "your trunk leans" in said
    assert "reach" in said
    assert "set-down" in said
    document = json.loads((tmp_path / "out/comparison.json").read_text())
    assert document["score"]["value"] < 100
    assert document["score"]["low"] <= document["score"]["value"] <= document["score"]["high"]
    beyond = {d["angle"] for d in document["differences_deg"] if d["is_beyond_error"]}
    assert beyond == {"trunk_flexion"}
    assert len(document["advice"]) == 3
    with (tmp_path / "out/curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 101
    apart = [
        float(r["trunk_flexion_attempt_deg"]) - float(r["trunk_flexion_reference_deg"])
        for r in rows
    ]
    assert max(apart) == pytest.approx(22, abs=3)
    assert (tmp_path / "out/curves.png").read_bytes().startswith(b"\x89PNG")
    run(reference, attempt, out=tmp_path / "out")  # an earlier comparison is replaced


def test_every_repetition_is_listed(tmp_path):
    one = store(tmp_path / "one", make_squats(1))
    many = store(tmp_path / "many", make_squats(3))
    said, _ = run(one, many)
    assert "Repetition" in said
    assert len(said.split("Repetition ")[1].splitlines()) == 4
    run(one, many, attempt_repetition=3)
    with pytest.raises(ConfigError, match="from 1 to 3, got 4") as refused:
        run(one, many, attempt_repetition=4)
    assert refused.value.exit_code == 2


def test_another_solver_is_noted(reference, tmp_path):
    other = store(tmp_path / "other", make_lift_clip(), solver="least-squares")
    _, notes = run(reference, other)
    assert "found in different ways" in notes
    assert run(reference, other, is_quiet=True)[1] == ""


def test_different_movements_are_refused(tmp_path):
    raise_arms = {**dict.fromkeys(DEPTH_DEG, 0.0), "shoulder_flexion_l": 120.0}
    raise_arms |= {"shoulder_flexion_r": 120.0}
    squat, arms = make_squats(1), make_squats(1, depth=raise_arms)
    with pytest.raises(AssessmentError, match="different movements") as refused:
        run(store(tmp_path / "a", squat), store(tmp_path / "b", arms))
    assert refused.value.exit_code == 3


def test_wrong_calls_are_refused_in_one_sentence(reference, tmp_path):
    with pytest.raises(ConfigError, match="holds no result"):
        run(reference, tmp_path / "nothing")
    with pytest.raises(ConfigError, match="counts from 1, got 0"):
        run(reference, reference, reference_repetition=0)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("keep")
    with pytest.raises(ConfigError, match="holds other files"):
        run(reference, reference, out=tmp_path / "full")


def test_a_clip_without_movement_is_refused(reference, tmp_path):
    clip = make_lift_clip()
    angles = JointAngles(clip.time_s, np.zeros_like(clip.angles.value_deg), clip.angles.names)
    still = store(tmp_path / "still", dataclasses.replace(clip, angles=angles, lifts=()))
    with pytest.raises(EngineError, match="Neither a lift nor a repeated movement") as refused:
        run(still, reference)
    assert refused.value.exit_code == 3
