"""`liftlens calibrate`: what its work prints, writes and refuses."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from engine.cameras.files import format_calibration, read_calibration
from engine.cli_calibrate import CalibrateRequest, run_calibrate
from engine.datatypes import Calibration, CalibrationCheck, Camera, CheckLevel
from engine.errors import CalibrationError, ConfigError, OutputError
from engine.optics import project
from tests.engine.cameras.board_scenes import CHARUCO, filmed, pair_of_cameras

CHARUCO_OPTIONS = {"columns": CHARUCO.columns, "rows": CHARUCO.rows, "square_mm": 70.0}


def run(request, observe=None):
    """Return what was said, what was warned of, and which videos were observed."""
    said, warned, observed = [], [], []

    def look(paths):
        observed.append(tuple(paths))
        return observe

    run_calibrate(request, say=said.append, warn=warned.append, observe=look)
    return "\n".join(said), "\n".join(warned), observed


@pytest.fixture(scope="module")
def stills(tmp_path_factory):
    folders = []
    for camera, frames in zip(pair_of_cameras(), filmed(CHARUCO), strict=True):
        folder = tmp_path_factory.mktemp("stills") / camera.name
        folder.mkdir()
        folders.append(folder)
        for frame in frames:
            cv2.imwrite(str(folder / f"{frame.index:03d}.png"), frame.image)
    return tuple(folders)


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / "cams.toml"
    path.write_text(format_calibration(Calibration(pair_of_cameras(), "board")), encoding="utf-8")
    return path


def judge(sentence, level=CheckLevel.GREEN):
    """Stand in for the verdict, which has tests of its own."""
    check = CalibrationCheck("floor", level, sentence, "Do this.")
    return SimpleNamespace(
        check_calibration=lambda views, calibration, stature: (check,),
        summarise_checks=lambda checks: replace(checks[0], key="verdict", sentence="In short."),
    )


def test_a_board_in_photographs_gives_a_calibration_file(stills, tmp_path):
    out = tmp_path / "cams.toml"
    request = CalibrateRequest(
        videos=stills, method="board", out=out, floor_at_s=20.0, **CHARUCO_OPTIONS
    )
    said, _, observed = run(request)
    read = read_calibration(out)
    assert [c.name for c in read.cameras] == ["left", "right"]
    assert read.cameras[0].matrix[0, 0] == pytest.approx(800, rel=0.01)
    assert "left and right: 2.5" in said
    assert "m above the floor" in said
    assert "Standard errors: the cameras may be turned by" in said
    assert str(out) in said
    assert not observed


def test_lenses_of_an_earlier_calibration_are_kept(stills, stored, tmp_path):
    out = tmp_path / "new.toml"
    run(CalibrateRequest(videos=stills, method="board", out=out, lenses=stored, **CHARUCO_OPTIONS))
    for found, true in zip(read_calibration(out).cameras, pair_of_cameras(), strict=True):
        assert np.array_equal(found.matrix, true.matrix)


def test_clicked_points_in_photographs_give_a_calibration_file(stills, tmp_path):
    world = np.array([[x, y, z] for x in (0.0, 0.5) for y in (0.4, 0.9) for z in (0.0, 0.4)])
    lines = ["[points]", *(f"p{i} = {w.tolist()}" for i, w in enumerate(world))]
    for camera in pair_of_cameras():
        clicks = [f"p{i} = {p.tolist()}" for i, p in enumerate(project(camera, world))]
        lines += ["[[view]]", f'video = "{camera.name}"', f"pixels = {{ {', '.join(clicks)} }}"]
    points = tmp_path / "points.toml"
    points.write_text("\n".join(lines))
    out = tmp_path / "cams.toml"
    said, _, _ = run(CalibrateRequest(videos=stills, method="points", out=out, points=points))
    assert read_calibration(out).source == "points"
    assert "all lengths off by" in said
    with pytest.raises(CalibrationError, match="expects left where right is given"):
        run(CalibrateRequest(videos=stills[::-1], method="points", out=out, points=points))


def test_the_walking_person_is_judged_at_once(stills, tmp_path, monkeypatch):
    calibration = Calibration(pair_of_cameras(), "person", scale_sigma=0.01)
    asked = []
    module = SimpleNamespace(
        calibrate_from_person=lambda views, stature: asked.append((views, stature)) or calibration
    )
    monkeypatch.setitem(sys.modules, "engine.cameras.self_calibration", module)
    monkeypatch.setitem(sys.modules, "engine.cameras.verdict", judge("The floor fits."))
    out = tmp_path / "cams.toml"
    request = CalibrateRequest(videos=stills, method="person", out=out, stature_m=1.8)
    said, _, observed = run(request, observe="views")
    assert observed == [stills]
    assert asked[0][0] == "views"
    assert asked[0][1].value == 1.8
    assert "[green] In short. Do this." in said
    assert "[green] The floor fits." in said
    assert read_calibration(out).source == "person"


def test_a_file_is_checked_without_videos(stored):
    said, _, observed = run(CalibrateRequest(check=stored))
    assert "left: 960 x 540 px, field of view 62 degrees" in said
    assert "Up and floor are not in it" in said
    assert not observed


def test_a_file_is_checked_against_the_person_in_videos(stored, stills, monkeypatch):
    monkeypatch.setitem(sys.modules, "engine.cameras.verdict", judge("Off.", CheckLevel.AMBER))
    said, _, observed = run(CalibrateRequest(check=stored, videos=stills))
    assert observed == [stills]
    assert "Filmed by name: left by camera left" in said
    assert "[amber] Off." in said


def test_what_the_world_contradicts_is_said_and_refused(stored, stills, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "engine.cameras.verdict", judge("Off.", CheckLevel.RED))
    with pytest.raises(CalibrationError, match=r"can't be trusted, so nothing was written"):
        run(CalibrateRequest(check=stored, videos=stills))


def write_pose2sim(path, cameras):
    lines = []
    for camera in cameras:
        vector = cv2.Rodrigues(camera.rotation)[0].ravel().tolist()
        lines += [
            f"[{camera.name}]",
            f'name = "{camera.name}"',
            f"size = {list(camera.size_px)}",
            f"matrix = {camera.matrix.tolist()}",
            f"rotation = {vector}",
            f"translation = {(camera.translation * 1000).tolist()}",
        ]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_other_formats_are_converted_and_what_was_assumed_is_said(tmp_path):
    source = write_pose2sim(tmp_path / "calib.toml", pair_of_cameras())
    out = tmp_path / "own.toml"
    said, _, _ = run(CalibrateRequest(convert=source, out=out))
    assert "millimetres" in said
    assert np.allclose(
        read_calibration(out).cameras[1].translation, pair_of_cameras()[1].translation
    )


def test_a_calibration_of_the_phone_held_otherwise_is_not_converted(tmp_path, stills):
    matrix = np.array([[800.0, 0, 270], [0, 800, 480], [0, 0, 1]])
    turned = [
        Camera(c.name, c.size_px[::-1], matrix, c.rotation, c.translation)
        for c in pair_of_cameras()
    ]
    source = write_pose2sim(tmp_path / "calib.toml", turned)
    with pytest.raises(CalibrationError, match="held the other way"):
        run(CalibrateRequest(convert=source, out=tmp_path / "own.toml", videos=stills))
    assert not (tmp_path / "own.toml").exists()


@pytest.mark.parametrize("board", ["charuco", "checkerboard"])
def test_the_printed_board_is_named_with_the_options_to_use(tmp_path, board):
    path = tmp_path / "board.pdf"
    said, _, _ = run(CalibrateRequest(print_board=path, board=board, paper="a4"))
    assert path.read_bytes().startswith(b"%PDF")
    assert f"--board {board} --columns" in said
    assert "100 %" in said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "Expected one of --method"),
        ({"check": "a.toml", "convert": "b.toml"}, "--check and --convert"),
        ({"convert": "a.toml"}, "--out"),
        ({"method": "magic", "videos": ("a", "b"), "out": "c.toml"}, "board, points, person"),
        ({"method": "board", "videos": ("a",), "out": "c.toml"}, "two videos, got 1"),
        ({"method": "board", "videos": ("a", "a"), "out": "c.toml"}, "given twice"),
        ({"method": "board", "videos": ("a", "b")}, "Expected --out"),
        ({"method": "points", "videos": ("a", "b"), "out": "c.toml"}, "Expected --points"),
        (
            {"method": "board", "videos": ("a", "b"), "out": "c.toml", "sync": "soon"},
            "auto or a number",
        ),
        ({"print_board": "b.pdf", "videos": ("a",)}, "two videos or none"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options, said, tmp_path):
    paths = {"check", "convert", "out", "print_board"}
    options = {k: tmp_path / v if k in paths else v for k, v in options.items()}
    if "videos" in options:
        options["videos"] = tuple(tmp_path / v for v in options["videos"])
    with pytest.raises(ConfigError, match=said):
        CalibrateRequest(**options)


def test_stills_and_videos_do_not_mix_and_empty_folders_are_named(stills, tmp_path):
    out = tmp_path / "c.toml"
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(CalibrationError, match="empty holds 0 photographs"):
        run(CalibrateRequest(videos=(empty, stills[1]), method="board", out=out))
    with pytest.raises(ConfigError, match="not one of each"):
        run(CalibrateRequest(videos=(tmp_path / "a.mp4", stills[1]), method="board", out=out))
    broken = empty / "a.png"
    broken.write_bytes(b"no picture")
    with pytest.raises(CalibrationError, match=r"a\.png can't be read"):
        run(CalibrateRequest(videos=(empty, stills[1]), method="board", out=out))


def test_a_calibration_is_never_half_written(stored, tmp_path):
    with pytest.raises(OutputError, match="can't be written"):
        run(CalibrateRequest(convert=stored, out=tmp_path / "none" / "c.toml"))
    with pytest.raises(ConfigError, match=r"as \.toml"):
        run(CalibrateRequest(convert=stored, out=tmp_path / "c.json"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cams.toml"]
