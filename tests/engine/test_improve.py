"""Stored results as the input of what-if, before/after and jobs."""

import dataclasses

import numpy as np
import pytest

from engine import improve, pipeline
from engine.datatypes import Task
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.base import Exposure
from engine.ergonomics.before_after import Verdict
from engine.ergonomics.what_if import Change, what_if
from engine.errors import DataError
from engine.storage.results import read_result, write_result
from tests.builders import make_angles, make_pose_track, make_scene, make_trial, make_trial_result
from tests.engine.ergonomics.bending import build_bending


def make_bending_result(*, upright=True, travel=0.0, label="Crate", **task):
    """Make a result whose methods really judged its track."""
    exposure = build_bending(recovery_h=1.0, **task)
    provenance = {"camera_travel": travel}
    track = dataclasses.replace(exposure.track, provenance=provenance)
    conditions = [*(["camera_moved"] if travel > 0.005 else [])]
    conditions += [] if upright else ["never_upright"]
    judged = dataclasses.replace(exposure, track=track, conditions=tuple(conditions))
    return make_trial_result(
        n_frames=track.n_frames,
        trial=make_trial(subject=exposure.subject, task=exposure.task, label=label),
        raw=track,
        corrected=track,
        angles=exposure.angles,
        lifts=exposure.lifts,
        scene=make_scene(provenance={"upright_frames": 12} if upright else {}),
        risk=assess_risk(judged, methods=("rnle", "l5s1", "lifft")),
    )


def store(folder, **kwargs):
    return read_result(write_result(make_bending_result(**kwargs), folder))


@pytest.mark.parametrize(
    ("kwargs", "conditions"),
    [
        ({}, ()),
        ({"travel": 0.02}, ("camera_moved",)),
        ({"upright": False}, ("never_upright",)),
    ],
    ids=["steady", "camera moved", "never upright"],
)
def test_a_stored_result_is_judged_as_it_was(tmp_path, kwargs, conditions):
    stored = store(tmp_path / "one", **kwargs)
    exposure = improve.read_exposure(stored)
    assert exposure.conditions == conditions
    again = what_if(exposure, Change(), methods=("rnle", "l5s1", "lifft"))
    for name, result in again.items():
        assert result.value == pytest.approx(stored.risk[name].value, rel=1e-4), name
        assert result.reasons == stored.risk[name].reasons


def test_a_seated_person_is_recognised_again():
    time_s = np.arange(30) / 30.0
    track = make_pose_track(n_frames=30)
    low = np.array(track.position)
    low[..., 1] *= 0.6
    seated = dataclasses.replace(track, position=low)
    stored = type("Stored", (), {})()
    stored.corrected, stored.angles = seated, make_angles(time_s=time_s)
    stored.lifts, stored.subject, stored.task = (), make_trial().subject, Task()
    stored.scene = make_scene(provenance={"upright_frames": 1})
    found = improve.read_exposure(stored)
    assert isinstance(found, Exposure)
    assert found.conditions == ("seated",)


def test_the_rule_for_a_moved_camera_is_that_of_the_assessment():
    assert improve.CAMERA_TRAVEL == pipeline.CAMERA_TRAVEL
    assert improve.STEADY_TRAVEL == pipeline.STEADY_TRAVEL


def test_stored_trials_are_compared_before_and_after(tmp_path):
    before = [store(tmp_path / f"b{k}", load_kg=14.0 + 0.1 * k) for k in range(3)]
    after = [store(tmp_path / f"a{k}", load_kg=6.0 + 0.1 * k) for k in range(3)]
    found = improve.compare_results(before, after)
    assert found.verdict is Verdict.IMPROVED
    assert any("the load differs" in reason for reason in found.reasons)
    assert found.n == (3, 3)


def test_one_trial_cannot_be_on_both_sides(tmp_path):
    stored = store(tmp_path / "one")
    with pytest.raises(DataError, match="before and after at once"):
        improve.compare_results([stored], [stored])
