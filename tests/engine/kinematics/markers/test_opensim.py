"""OpenSim as a worker: missing, failing, hanging, and the same angles as the built-in fit."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from engine.datatypes import Subject
from engine.errors import AssessmentError, BackendUnavailable, DataError
from engine.kinematics.fitting.base import list_solvers, select_solver
from engine.kinematics.markers import fit_markers, table3_angles
from engine.kinematics.markers._opensim import run_opensim
from tests.builders import make_pose_track
from tests.engine.kinematics.markers.builders import make_lift

has_opensim = importlib.util.find_spec("opensim") is not None
needs_opensim = pytest.mark.extra("opensim")


@pytest.fixture(scope="module")
def lift():
    return make_lift(n_frames=12)


def logs(message):
    return Path(str(message).split("its log is ")[1].split(".log")[0] + ".log")


@pytest.mark.skipif(has_opensim, reason="opensim is installed")
def test_without_opensim_the_command_to_install_it_is_named(lift):
    rec = lift.recording
    with pytest.raises(BackendUnavailable, match=r"pip install 'liftlens\[opensim\]'") as caught:
        fit_markers(rec.time_s, rec.position_m, rec.names, ik="opensim")
    assert caught.value.exit_code == 4
    with pytest.raises(BackendUnavailable):
        select_solver("opensim").fit(rec.as_track(), Subject())


def worker(tmp_path, source):
    script = tmp_path / "worker.py"
    script.write_text(source, encoding="utf-8")
    return sys.executable, str(script)


def test_a_failing_worker_is_told_with_its_log(lift, tmp_path):
    command = worker(tmp_path, "import sys; print('no such marker'); sys.exit(3)")
    with pytest.raises(AssessmentError, match=r"code 3.*no such marker") as caught:
        run_opensim(lift.recording, lift.model, command=command)
    assert "no such marker" in logs(caught.value).read_text()


def test_a_hanging_worker_is_stopped(lift, tmp_path):
    command = worker(tmp_path, "import time; print('busy', flush=True); time.sleep(60)")
    with pytest.raises(AssessmentError, match="did not end within 2 s") as caught:
        run_opensim(lift.recording, lift.model, command=command, time_limit_s=2.0)
    assert logs(caught.value).exists()


def test_a_worker_that_ends_without_a_result_is_a_failure(lift, tmp_path):
    with pytest.raises(AssessmentError, match="OpenSim failed"):
        run_opensim(lift.recording, lift.model, command=worker(tmp_path, ""))


def test_the_set_up_files_say_what_opensim_needs(lift, tmp_path):
    """The worker's stand-in keeps the folder's files and gives a plausible answer."""
    source = f"""
import json, pathlib, shutil, sys
folder = pathlib.Path(sys.argv[1])
shutil.copytree(folder, {str(tmp_path / "seen")!r})
names = {lift.model.tree.coordinate_names!r}
rows = [[i / 30.0] + [10.0] * len(names) for i in range(12)]
text = "Coordinates\\ninDegrees=yes\\nendheader\\ntime " + " ".join(names) + "\\n"
text += "\\n".join(" ".join(map(str, row)) for row in rows)
(folder / "ik.mot").write_text(text)
(folder / "done.json").write_text(json.dumps({{"ik": 1.0, "ik_cpu": 0.5}}))
"""
    run = run_opensim(lift.recording, lift.model, command=worker(tmp_path, source))
    columns = lift.model.tree.column
    assert run.coordinates[3, columns["hip_flexion_r"]] == pytest.approx(np.radians(10.0))
    assert run.coordinates[3, columns["pelvis_ty"]] == 10.0
    setup = (tmp_path / "seen" / "ik.xml").read_text()
    assert f"<accuracy>{1e-6}</accuracy>" in setup
    assert "/scaled.osim</model_file>" in setup
    osim = (tmp_path / "seen" / "scaled.osim").read_text(encoding="utf-8")
    assert "mesh_file" not in osim
    assert osim.count("<Marker name=") == 45


def test_a_coarse_accuracy_is_refused(lift):
    with pytest.raises(DataError, match="1e-4"):
        run_opensim(lift.recording, lift.model, accuracy=1e-2, command=("true",))


@pytest.mark.parametrize("name", ["markers", "opensim"])
def test_keypoints_are_no_markers(name):
    with pytest.raises(DataError, match="need skin markers"):
        # Said before anything that may not be installed is looked for.
        {s.info.name: s for s in list_solvers()}[name].fit(make_pose_track(), Subject())


def test_the_solver_gives_angles_and_body():
    track = make_lift(n_frames=40).recording.as_track()
    found = select_solver("markers").fit(track, Subject(stature_m=1.8))
    assert found.angles["knee_flexion_l"].max() > 60
    assert found.body is not None
    assert found.body.residual_m.max() < 0.002
    assert found.body.joints.skeleton == "synthetic_45"
    assert 0.3 < found.body.segment_lengths_m["left_thigh"] < 0.5


@needs_opensim
@pytest.mark.slow
def test_opensim_agrees_on_the_same_model(lift):
    rec = lift.recording
    run = run_opensim(rec, lift.model, time_limit_s=600.0)
    ours = fit_markers(rec.time_s, rec.position_m, rec.names, model=lift.model)
    from dataclasses import replace

    factor = np.where(lift.model.tree.is_translation, 1.0, np.degrees(1.0))
    theirs = replace(ours, coordinates=run.coordinates * factor)
    difference = table3_angles(ours)[1] - table3_angles(theirs)[1]
    assert np.abs(difference).mean(axis=0).max() < 0.5
