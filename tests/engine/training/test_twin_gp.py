"""The command that trains a person's model, with the networks replaced by exact keypoints."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest

import engine.training.twin_gp as command
from engine.pose.twin_gp import load_model
from tests.engine.cameras.truth import SAMPLES, read_truth, see


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    """One person with the bundled clip as two repetitions; landmarks are exact."""
    source = SAMPLES / "floor_to_knuckle"
    person = tmp_path / "data" / "S1"
    for repetition in ("01", "02"):
        trial = person / f"S1_FK_{repetition}"
        trial.mkdir(parents=True)
        for name in ("cam90.mp4", "cam135.mp4", "markers.trc"):
            shutil.copy(source / name, trial / name)
        facts = json.loads((source / "trial.json").read_text())
        facts |= {"subject": "S1", "repetition": int(repetition), "task": "FK"}
        (trial / "trial.json").write_text(json.dumps(facts))
    facts = json.loads((source / "subject.json").read_text()) | {"subject": "S1"}
    (person / "subject.json").write_text(json.dumps(facts))
    truth = read_truth("floor_to_knuckle")

    def look(path, _config):
        pose = see(truth.points, truth.cameras[path.stem], truth.time_s)
        noise = np.random.default_rng(len(str(path))).normal(scale=0.5, size=(1, 33, 2))
        image = dataclasses.replace(pose.image, position=pose.image.position + noise)
        return dataclasses.replace(pose, image=image)

    monkeypatch.setattr(command, "_see_view", look)
    return tmp_path / "data"


def test_a_trained_model_knows_what_it_was_trained_on(dataset, tmp_path):
    out = tmp_path / "s1.npz"
    assert command.main([str(dataset), "--person", "S1", "--out", str(out)]) == 0
    model = load_model(out)
    assert model.source.subject == "S1"
    assert model.source.views == ("cam90", "cam135")
    assert model.source.picture_px == ((720, 480), (720, 480))
    assert model.source.rate_hz == pytest.approx(30, abs=0.1)
    assert len(model.marker_names) == 45
    # The second repetition is the first one: left out, it is predicted all but exactly.
    assert model.inner_error_m < 0.005
    assert 0.2 < model.lengths_m["right_forearm"] < 0.3


def test_wrong_names_are_refused(dataset, tmp_path, capsys):
    arguments = [str(dataset), "--person", "S1", "--out", str(tmp_path / "x.npz")]
    assert command.main([*arguments, "--features", "sift"]) == 2
    assert "Unknown name 'sift'; known: hog" in capsys.readouterr().err
    assert command.main([*arguments, "--regressor", "svm"]) == 2
    assert command.main([str(dataset), "--person", "S9", "--out", "x.npz"]) in (2, 3)
    assert not (tmp_path / "x.npz").exists()
