"""`liftlens protocol`: the whole way on small drawn lifts, going on after a stop, bad input."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from engine import protocol, protocol_inputs
from engine.cli import app
from engine.cli_protocol import build_request
from engine.datatypes import Camera
from engine.errors import BackendUnavailable, Cancelled, ConfigError, DataError
from engine.kinematics.markers import write_marker_trc
from engine.optics import project
from engine.protocol import run_protocol
from engine.protocol_features import span_features
from engine.video.writer import VideoWriter
from tests.engine.kinematics.markers.builders import make_lift

SIZE = (96, 64)
N_FRAMES = 36
FOCAL = 90.0


def make_cameras():
    """Return a view from the right and one from behind, 3.5 m away."""
    right = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    behind = np.array([[0, 0, 1.0], [0, -1, 0], [1, 0, 0]])
    matrix = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    return tuple(
        Camera(name, SIZE, matrix, rotation, np.array([0.0, 1.0, 3.5]))
        for name, rotation in (("right", right), ("rear", behind))
    )


def draw_video(path, camera, marker_m, *, size=SIZE):
    pictures = project(camera, marker_m)
    with VideoWriter(path, crf=10) as writer:
        for index, points in enumerate(pictures):
            image = np.full((size[1], size[0], 3), 200, np.uint8)
            for x, y in points:
                cv2.circle(image, (round(x), round(y)), 3, (30, 40, 90), -1)
            writer.write(image, index / 30.0)


def write_trial(folder, task, repetition):
    """Write one lift: repetitions differ in how far the person leans over, tasks in tempo."""
    lift = make_lift(n_frames=N_FRAMES if task == "FK" else N_FRAMES + 6)
    sway = 0.01 * repetition * np.linspace(0, 1, lift.recording.time_s.size)
    markers = lift.recording.position_m + np.array([1.0, 0, 0]) * sway[:, None, None]
    path = folder / f"{folder.name}_{task}_{repetition:02d}"
    path.mkdir(parents=True)
    # A little longer than the pictures, as a recording of its own would be.
    recording = replace(lift.recording, position_m=markers)
    write_marker_trc(recording, path / "markers.trc")
    for camera in make_cameras():
        draw_video(path / f"{camera.name}.mp4", camera, markers)
    facts = {"task": task, "repetition": repetition, "events_s": {"place": 0.8}}
    (path / "trial.json").write_text(json.dumps(facts))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "lab"
    for task in ("FK", "KS"):
        for repetition in (1, 2):
            write_trial(folder / "S1", task, repetition)
    cameras = [
        {"name": c.name, "K": c.matrix.tolist(), "R": c.rotation.tolist(),
         "t": c.translation.tolist(), "width": SIZE[0], "height": SIZE[1]}
        for c in make_cameras()
    ]  # fmt: skip
    (folder / "S1" / "subject.json").write_text(json.dumps({"calibration": cameras}))
    return folder


@pytest.fixture
def spoilt(dataset, tmp_path):
    """A copy that may be damaged, and its first trial."""
    copy = tmp_path / "lab"
    shutil.copytree(dataset, copy)
    return copy, copy / "S1" / "S1_FK_01"


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Features and angles, which do not depend on what a test is about."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def nobody_is_found(monkeypatch):
    """The drawn lifts are no pictures of people; the whole picture is described instead."""

    class Blind:
        def __init__(self, **_options):
            pass

        def __call__(self, _image):
            return []

    monkeypatch.setattr(protocol_inputs, "PersonDetector", Blind)


def run(dataset, out, *options):
    arguments = ["protocol", dataset, "--out", out, "--n-folds", 2, "--quiet", *options]
    return CliRunner().invoke(app, [str(a) for a in arguments])


def last_line(result):
    return result.stderr.strip().splitlines()[-1]


def request(dataset, out, **options):
    chosen = {"estimator": "gp", "features": "hog-paper", "folds": "trial", "persons": None,
              "views": "2", "n_folds": 2}  # fmt: skip
    return build_request(dataset, out, **{**chosen, **options})


def never(*_):
    pytest.fail("landmarks are not needed here")


@pytest.fixture(scope="module")
def study(dataset, cache, tmp_path_factory):
    """One whole run through the command line."""
    out = tmp_path_factory.mktemp("study") / "out"

    class Blind:
        def __init__(self, **_options):
            pass

        def __call__(self, _image):
            return []

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol_inputs, "PersonDetector", Blind)
        result = run(dataset, out, "--estimator", "nn,gp", "--features", "hog-paper",
                     "--cache", cache)  # fmt: skip
    assert result.exit_code == 0, result.output
    return out, result


def test_the_whole_way_writes_all_that_is_promised(study):
    out, result = study
    written = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    promised = {"study.json", "report.html", "report.pdf", "run.json"}
    promised |= {f"tables/table{n}.{kind}" for n in (1, 2, 3) for kind in ("csv", "html")}
    promised |= {f"figures/figure{n}.png" for n in (2, 3, 4, 5)}
    assert promised <= written
    assert (out / "report.pdf").read_bytes().startswith(b"%PDF-1.7")
    assert "hog-paper/gp: markers" in result.stdout
    # The drawn repetitions differ by a centimetre at most: as good as one recording twice.
    assert "Leak suspected" in result.stdout
    assert not list(out.rglob("*.partial"))


def test_the_estimate_follows_the_movement(study):
    out, _ = study
    with (out / "tables" / "methods.csv").open() as file:
        methods = {row["method"]: row for row in csv.DictReader(file)}
    assert float(methods["hog-paper/gp"]["mean_mm"]) < 40.0
    with (out / "tables" / "table1.csv").open() as file:
        rows = [r for r in csv.DictReader(file) if r["method"] == "hog-paper/gp"]
    everything = next(r for r in rows if (r["subject"], r["task"]) == ("all", "all"))
    assert int(everything["n_frames"]) == 2 * (N_FRAMES + N_FRAMES + 6)


def test_predictions_are_kept_with_their_errors(study):
    out, _ = study
    with np.load(out / "predictions/hog-paper__gp/S1_S1_FK_01.npz", allow_pickle=False) as kept:
        assert kept["markers_m"].shape == (N_FRAMES, 45, 3)
        assert (kept["sigma_m"] > 0).all()
        assert len(kept["angle_names"]) == 23


def test_a_second_run_takes_up_what_is_finished(study, dataset, cache, monkeypatch):
    out, _ = study
    monkeypatch.setattr(protocol, "train_model", never)
    monkeypatch.setattr(protocol, "fit_markers", never)
    result = run(dataset, out, "--estimator", "nn,gp", "--features", "hog-paper", "--cache", cache)
    assert result.exit_code == 0, result.output


def test_a_folder_with_another_run_is_refused(study, dataset, cache):
    out, _ = study
    result = run(dataset, out, "--folds", "random", "--cache", cache)
    assert result.exit_code == 2
    assert "another folds ('trial', now 'random')" in last_line(result)


def test_a_stop_keeps_finished_folds_and_the_next_run_goes_on(dataset, cache, tmp_path):
    out = tmp_path / "out"
    seen = []

    def stop(stage, _done, _total):
        seen.append(stage)
        if stage.startswith("S1, repetition 2: hog-paper/gp"):
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        run_protocol(request(dataset, out, cache=cache), observe=never, progress=stop)
    folds = out / "predictions" / "hog-paper__gp" / "folds"
    (first,) = folds.iterdir()
    before = first.stat().st_mtime_ns
    assert not (out / "study.json").exists()
    with pytest.raises(Cancelled):  # stops again at the same place, without training anew
        run_protocol(request(dataset, out, cache=cache), observe=never, progress=stop)
    assert first.stat().st_mtime_ns == before


# --------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--estimator", "svm"), "--estimator must be among nn, wknn"),
        (("--features", "sift"), "--features must be among hog"),
        (("--folds", "person"), "--folds must be one of trial, block, random, subject"),
        (("--views", "3"), "--views must be one of 2, first, second"),
        (("--ik", "magic"), "--ik must be builtin or opensim"),
        (("--folds", "block", "--train-repetitions", "1"), "--train-repetitions is for trial"),
        (("--persons", "S9"), "no person 'S9'; it has S1"),
    ],
    ids=["estimator", "features", "folds", "views", "ik", "repetitions", "person"],
)
def test_wrong_options_end_with_exit_code_2(dataset, tmp_path, options, words):
    result = run(dataset, tmp_path / "out", *options)
    assert result.exit_code == 2
    assert words in last_line(result)


def test_all_means_every_one(dataset, tmp_path):
    chosen = request(dataset, tmp_path, estimator="all", features="all")
    assert "tgp-constrained" in chosen.estimators
    assert "landmarks" in chosen.features


def test_a_folder_with_other_files_is_left_alone(dataset, tmp_path):
    (tmp_path / "thesis.doc").touch()
    result = run(dataset, tmp_path)
    assert result.exit_code == 2
    assert "holds other files" in last_line(result)


def lose_view(trial):
    (trial / "rear.mp4").unlink()


def resize(trial):
    markers = make_lift(n_frames=N_FRAMES).recording.position_m
    draw_video(trial / "right.mp4", make_cameras()[0], markers, size=(112, 64))


def cut_view(trial):
    markers = make_lift(n_frames=N_FRAMES).recording.position_m[:20]
    draw_video(trial / "rear.mp4", make_cameras()[1], markers)


def cut_markers(trial):
    recording = make_lift(n_frames=N_FRAMES).recording
    part = replace(recording, time_s=recording.time_s[:15], position_m=recording.position_m[:15],
                   is_filled=recording.is_filled[:15])  # fmt: skip
    write_marker_trc(part, trial / "markers.trc")


def lose_marker(trial):
    recording = make_lift(n_frames=N_FRAMES).recording
    position = recording.position_m.copy()
    position[:20, recording.names.index("RELL")] = np.nan
    write_marker_trc(replace(recording, position_m=position), trial / "markers.trc")


def rename_unit(trial):
    path = trial / "markers.trc"
    path.write_text(path.read_text().replace("\tmm\t", "\tm\t"))


def rename_markers(trial):
    path = trial / "markers.trc"
    lines = path.read_text().splitlines()
    lines[3] = "Frame#\tTime\t" + "\t\t\t".join(f"M{n}" for n in range(45))
    path.write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lose_view, "no video rear: one view is missing"),
        (resize, "The pictures of S1/S1_FK_02 have 96 x 64 px"),
        (cut_view, "The two videos of S1/S1_FK_01 have 36 and 20 frames"),
        (cut_markers, "The markers of S1/S1_FK_01 cover 0.00 to 0.47 s"),
        (lose_marker, "RELL (58% missing)"),
        (rename_unit, "S1/S1_FK_01: "),
        (rename_markers, "S1/S1_FK_01: "),
    ],
    ids=["view", "size", "lengths", "mocap", "gap", "unit", "names"],
)
def test_data_that_can_t_be_used_end_with_exit_code_3(spoilt, tmp_path, spoil, words):
    folder, trial = spoilt
    spoil(trial)
    result = run(folder, tmp_path / "out", "--features", "hog-paper")
    assert result.exit_code == 3, result.output
    assert words in last_line(result)
    assert not (tmp_path / "out" / "study.json").exists()


def test_fewer_trials_than_folds_are_said(dataset, tmp_path, cache):
    result = run(dataset, tmp_path / "out", "--n-folds", 4, "--cache", cache)
    assert result.exit_code == 3
    assert "2 usable trials of FK, fewer than the 4 folds" in last_line(result)


def test_without_opensim_the_exit_code_is_4(dataset, tmp_path, cache, monkeypatch):
    def missing(*_args, ik="builtin", model=None, **_options):
        if ik == "opensim":
            raise BackendUnavailable("OpenSim is missing; run: pip install 'liftlens[opensim]'")
        return real(*_args, ik=ik, model=model, **_options)

    real = protocol_inputs.fit_markers
    monkeypatch.setattr(protocol_inputs, "fit_markers", missing)
    result = run(dataset, tmp_path / "out", "--ik", "opensim", "--cache", cache)
    assert result.exit_code == 4
    assert "pip install" in last_line(result)


def test_nobody_in_the_videos_is_said(dataset, tmp_path, cache):
    result = run(dataset, tmp_path / "out", "--features", "hog", "--cache", cache)
    assert result.exit_code == 3
    assert "Nobody was found in the videos of S1" in last_line(result)


def test_one_person_can_t_be_left_out(dataset, tmp_path, cache):
    result = run(dataset, tmp_path / "out", "--folds", "subject", "--cache", cache)
    assert result.exit_code == 3
    assert "at least 2 persons" in last_line(result)


def test_a_damaged_run_is_said(dataset, tmp_path):
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(ConfigError, match="is damaged"):
        run_protocol(request(dataset, tmp_path), observe=never)


# --------------------------------------------------------------------------- features


def test_the_span_keeps_all_distances():
    noise = np.random.default_rng(0)
    raw = [noise.normal(size=(n, 900)).astype(np.float32) for n in (7, 12)]
    wide = np.concatenate(raw)
    found = span_features(raw)
    assert found.shape == (19, 19)
    np.testing.assert_allclose(found @ found.T, wide @ wide.T, rtol=1e-4, atol=1e-2)


def test_a_basis_keeps_what_lies_in_its_span():
    noise = np.random.default_rng(1)
    few = noise.normal(size=(5, 900))
    wide = (noise.normal(size=(40, 5)) @ few).astype(np.float32)
    found = span_features([wide], basis=20)
    assert found.shape[1] == 5
    scale = np.abs(wide @ wide.T).max()
    np.testing.assert_allclose(found @ found.T / scale, wide @ wide.T / scale, atol=1e-4)


def test_truth_without_markers_is_no_marker_file(tmp_path):
    np.savez(tmp_path / "truth.npz", time=np.arange(3.0))
    with pytest.raises(DataError, match=r"holds no marker_names; add markers\.trc"):
        protocol_inputs._read_true_markers(Path(tmp_path / "truth.npz"))
