"""What users do wrong and what goes wrong around them, through the command line.

Every refusal is an exit code and one last sentence on stderr, and leaves nothing behind.
"""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from engine import pipeline
from engine.cli import app
from engine.pose.backends import mediapipe
from engine.pose.base import create_backend
from engine.skeletons import MEDIAPIPE_33
from engine.storage.results import StoredResult, read_result
from engine.subject.detector import PersonDetector
from engine.video.reader import read_frames
from tests.engine.video.clips import (
    noise_clip,
    set_display_matrix,
    write_clip,
    write_sound,
)

pytestmark = pytest.mark.model

ROOT = Path(__file__).parents[2]
Images = list[np.ndarray]
STATURE = ("--stature", "1.725", "--load", "10")
BENT = slice(33, 51)
"""Of the 15 pictures/s below: from the bent person with still hands to the load on its way."""


@pytest.fixture(scope="module")
def lift() -> Images:
    """A whole lift, 15 pictures/s."""
    frames = read_frames(ROOT / "sample_data" / "floor_to_knuckle" / "cam90.mp4")
    return [np.array(f.image) for f in frames if f.index % 2 == 0]


@pytest.fixture(scope="module")
def room(lift: Images) -> np.ndarray:
    """The same place with nobody in it: its left edge, drawn out."""
    return np.repeat(lift[0][:, :1], lift[0].shape[1], axis=1)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory, lift: Images) -> Path:
    """Half a second of a person who stands."""
    return write_clip(tmp_path_factory.mktemp("clip") / "lift.mp4", lift[:8], rate=15)


@pytest.fixture(scope="module")
def networks() -> tuple[functools.partial[Any], PersonDetector]:
    return functools.cache(create_backend), PersonDetector()


@pytest.fixture
def assess(
    networks: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[functools.partial[Any]]:
    """Run `liftlens assess` here with networks that are loaded once; check what stays behind."""
    load, detector = networks
    monkeypatch.setattr(pipeline, "create_backend", load)
    monkeypatch.setattr(pipeline, "PersonDetector", lambda **_: detector)
    settings = tmp_path / "settings.toml"
    settings.write_text('[pose]\nvariant = "full"\n')
    out = tmp_path / "out" / "new" / "result"

    def run(*arguments: object) -> Any:
        words = [str(a) for a in arguments]
        settled = [] if "--config" in words else ["--config", str(settings)]
        chosen = [] if "--out" in words else ["--out", str(out)]
        return CliRunner().invoke(app, ["assess", *words, *settled, *chosen])

    yield run
    hidden = [p for p in tmp_path.rglob("*") if p.name.startswith(".")]
    assert hidden == []
    if out.exists():
        assert (out / "trial.json").is_file()
    else:
        assert not (tmp_path / "out").exists()


def refuse(result: Any, code: int, *words: str) -> None:
    """Check one clear sentence, and nothing else that could pass for a result."""
    last = result.stderr.rstrip().splitlines()[-1]
    assert result.exit_code == code, result.stderr
    assert last.startswith("Error: ")
    for word in words:
        assert word in last
    assert "Traceback" not in result.stderr
    assert "made a mistake" not in last
    assert result.stdout == ""


def accept(result: Any) -> StoredResult:
    assert result.exit_code == 0, result.stderr
    return read_result(Path(result.stdout.rstrip().splitlines()[-1].removeprefix("Result: ")))


def notes(stored: StoredResult) -> str:
    return " ".join(stored.warnings)


class TestNoVideo:
    """Files that are no video, or hold nothing to assess."""

    def test_a_text_with_the_name_of_a_video(self, assess: Any, tmp_path: Path) -> None:
        path = tmp_path / "lift.mp4"
        path.write_text("To whom it may concern\n" * 100)
        refuse(assess(path), 3, "lift.mp4 can't be read as a video", "Export or copy it again")

    def test_an_empty_file(self, assess: Any, tmp_path: Path) -> None:
        path = tmp_path / "lift.mp4"
        path.touch()
        refuse(assess(path), 3, "is empty (0 bytes)", "Copy it again")

    @pytest.mark.parametrize("name", ["memo.mp4", "memo.m4a"])
    def test_sound_only(self, assess: Any, tmp_path: Path, name: str) -> None:
        refuse(assess(write_sound(tmp_path / name)), 3, "no moving picture", "Choose the video")

    def test_a_copy_that_lacks_the_index_at_its_end(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        path = write_clip(tmp_path / "lift.mp4", lift[:20])
        path.write_bytes(path.read_bytes()[:-2000])
        refuse(assess(path), 3, "a file that was cut off", "copy it again")

    def test_a_copy_without_a_whole_picture(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        options = {"movflags": "+faststart"}
        path = write_clip(tmp_path / "lift.mp4", lift[:20], container_options=options)
        data = path.read_bytes()
        path.write_bytes(data[: data.index(b"mdat") + 900])
        refuse(assess(path), 3, "can be decoded", "Copy it again from the camera")

    def test_a_photo(self, assess: Any, tmp_path: Path, lift: Images) -> None:
        import cv2

        path = tmp_path / "lift.jpg"
        cv2.imwrite(str(path), lift[0])
        refuse(assess(path), 3, "can't be read as a video")

    def test_a_single_picture(self, assess: Any, tmp_path: Path, lift: Images) -> None:
        path = write_clip(tmp_path / "lift.mp4", lift[:1])
        refuse(assess(path), 3, "single picture", "film the whole lift")

    def test_nobody_in_the_room(self, assess: Any, tmp_path: Path, room: np.ndarray) -> None:
        path = write_clip(tmp_path / "lift.mp4", [room] * 12)
        refuse(assess(path), 3, "Expected a person", "12 pictures", "film the whole body")

    def test_noise(self, assess: Any, tmp_path: Path) -> None:
        refuse(assess(noise_clip(tmp_path / "lift.mp4", 12)), 3, "Expected a person")


class TestOddVideos:
    """Videos that are unusual but can be assessed; the result says what is amiss."""

    def test_a_file_cut_off_in_its_data_says_how_much_is_missing(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        options = {"movflags": "+faststart"}
        path = write_clip(tmp_path / "lift.mp4", lift[:24], rate=15, container_options=options)
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 7 // 10])
        stored = accept(assess(path, *STATURE))
        n_read = stored.raw.n_frames
        assert 2 <= n_read < 24
        assert "The video is cut off" in notes(stored)
        missing = stored.views[0].info.n_missing_frames
        assert f"{missing} pictures that it announces are not in it" in notes(stored)
        assert abs(n_read + missing - 24) <= 1  # the picture at the cut is announced and half there

    def test_one_picture_a_second_finds_no_lift_and_says_why(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        stored = accept(assess(write_clip(tmp_path / "lift.mp4", lift[::15], rate=1), *STATURE))
        assert stored.lifts == ()
        assert "15 frames per second, this video has 1.0" in notes(stored)

    def test_less_than_half_a_second_says_that_it_is_too_short(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        path = write_clip(tmp_path / "lift.mp4", lift[:6], rate=15)
        stored = accept(assess(path, *STATURE))
        assert stored.lifts == ()
        assert "Only 0.3 s (6 pictures) were assessed" in notes(stored)

    def test_a_turned_phone_gives_the_same_keypoints(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        images = lift[:10]
        upright = write_clip(tmp_path / "up.mp4", images, options={"crf": "12"})
        expected = accept(assess(upright, *STATURE, "--out", tmp_path / "up"))
        turns = {90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}
        for quarter, (degrees, matrix) in enumerate(turns.items(), start=1):
            stored_images = [np.ascontiguousarray(np.rot90(i, quarter)) for i in images]
            path = tmp_path / f"{degrees}.mp4"
            set_display_matrix(write_clip(path, stored_images, options={"crf": "12"}), *matrix)
            turned = accept(assess(path, *STATURE, "--out", tmp_path / str(degrees)))
            assert turned.views[0].info.rotation_deg == degrees
            assert turned.views[0].info.size_px == (720, 480)
            seen = expected.views[0].image.confidence > 0.8
            apart = np.linalg.norm(
                turned.views[0].image.position - expected.views[0].image.position, axis=2
            )
            assert np.median(apart[seen]) < 2.0
            sigma = expected.angles.sigma("trunk_inclination").max()
            difference = turned.angles["trunk_inclination"] - expected.angles["trunk_inclination"]
            assert np.abs(difference).max() < sigma

    def test_a_variable_frame_rate_keeps_the_true_times(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        times_ms = [0, 66, 133, 333, 400, 466, 900, 966, 1033, 1100]
        images = [lift[round(t / 1000 * 15)] for t in times_ms]
        stored = accept(
            assess(write_clip(tmp_path / "lift.mp4", images, times_ms=times_ms), *STATURE)
        )
        assert stored.views[0].info.is_variable_rate
        assert stored.raw.time_s == pytest.approx(np.array(times_ms) / 1000, abs=0.002)

    @pytest.mark.parametrize("has_sound", [True, False])
    def test_sound_does_not_matter(
        self, assess: Any, tmp_path: Path, lift: Images, has_sound: bool
    ) -> None:
        path = write_clip(tmp_path / "lift.mp4", lift[:5], rate=15, sound=has_sound)
        assert accept(assess(path, *STATURE)).raw.n_frames == 5

    def test_a_person_who_leaves_is_not_made_up(
        self, assess: Any, tmp_path: Path, lift: Images, room: np.ndarray
    ) -> None:
        path = write_clip(tmp_path / "lift.mp4", [*lift[:12], *[room] * 40], rate=15)
        stored = accept(assess(path, *STATURE))
        image = stored.views[0].image
        assert image.is_present[:12].any(axis=1).all()
        assert not image.is_present[-20:].any()
        assert np.isnan(stored.corrected.position[-20:]).all()
        assert np.isnan(stored.angles["trunk_inclination"][-20:]).all()
        assert "The person was not seen in" in notes(stored)
        assert stored.lifts == ()

    def test_somebody_who_walks_past_is_not_measured(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        other = ROOT / "sample_data" / "floor_to_shoulder" / "cam90.mp4"
        walker = next(read_frames(other)).image[60:425, 250:365]
        box = ("--box", "270,60,370,425")
        path = write_clip(tmp_path / "lift.mp4", cross(lift[:36], walker), rate=15)
        alone = write_clip(tmp_path / "alone.mp4", lift[:36], rate=15)
        crossed = accept(assess(path, *STATURE, *box)).views[0]
        expected = accept(assess(alone, *STATURE, *box, "--out", tmp_path / "alone")).views[0]
        hips = [MEDIAPIPE_33.index(f"{side}_hip") for side in ("left", "right")]
        apart = np.linalg.norm(crossed.image.position - expected.image.position, axis=2)[:, hips]
        measured = np.isfinite(apart).all(axis=1)
        assert measured[:8].all()
        assert measured[-6:].all()
        # The two are 300 px apart at both ends; while one hides the other nobody need be measured.
        assert apart[:8].max() < 20.0
        assert apart[-6:].max() < 20.0

    def test_a_hand_held_camera_is_warned_of(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        swayed = [
            np.roll(image, (round(5 * np.sin(i / 4)), round(7 * np.sin(i / 5))), axis=(0, 1))
            for i, image in enumerate(lift[:30])
        ]
        stored = accept(assess(write_clip(tmp_path / "lift.mp4", swayed, rate=15), *STATURE))
        assert "The camera moved" in notes(stored)

    def test_a_fixed_camera_is_not_warned_of(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        stored = accept(assess(write_clip(tmp_path / "lift.mp4", lift[:20], rate=15), *STATURE))
        assert "camera" not in notes(stored).lower()

    def test_a_person_who_never_stands_upright_has_wider_errors(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        standing = write_clip(tmp_path / "up.mp4", lift[:18], rate=15)
        bent = write_clip(tmp_path / "bent.mp4", lift[BENT], rate=15)
        upright = accept(assess(standing, *STATURE, "--out", tmp_path / "up"))
        stored = accept(assess(bent, *STATURE))
        assert "never stands upright" in notes(stored)
        assert stored.views[0].image.is_present.any(axis=1).all()
        assert stored.scene.scale_sigma > 2 * upright.scene.scale_sigma
        trunk = stored.angles["trunk_inclination"]
        assert np.nanmin(trunk) > 40.0

    def test_a_person_seen_from_the_waist_up_gets_no_index(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        images = [np.ascontiguousarray(image[:246]) for image in lift[:70:3]]
        result = assess(write_clip(tmp_path / "lift.mp4", images, rate=15), *STATURE)
        stored = accept(result)
        assert "Parts of the body were often not seen" in result.stdout
        assert not stored.risk["rnle"].is_applicable

    def test_names_and_labels_of_every_kind(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        path = write_clip(tmp_path / "Łagerhaus – Heben ☃ 'Nr. 1'.mp4", lift[:4], rate=15)
        label = "Größe Ä ☃ \n" * 300
        stored = accept(assess(path, *STATURE, "--label", label))
        assert stored.document["label"] == label
        assert stored.views[0].info.file_name == path.name

    @pytest.mark.slow
    @pytest.mark.skipif(sys.platform != "linux", reason="reads the peak from Linux's /proc")
    def test_8k_fits_into_memory(self, tmp_path: Path, lift: Images) -> None:
        import cv2

        images = (cv2.resize(image[:405], (7680, 4320)) for image in lift[:8])
        options = {"preset": "ultrafast", "crf": "30"}
        path = write_clip(tmp_path / "lift.mp4", images, rate=15, options=options)
        script = (
            "import pathlib, runpy\n"
            "try:\n"
            "    runpy.run_module('engine.cli_start', run_name='__main__')\n"
            "finally:\n"
            # Not getrusage: a child begins with the peak of its parent there.
            "    status = pathlib.Path('/proc/self/status').read_text().split()\n"
            "    print(status[status.index('VmHWM:') + 1])\n"
        )
        arguments = ["assess", str(path), *STATURE, "--out", str(tmp_path / "r")]
        done = subprocess.run(
            [sys.executable, "-c", script, *arguments],
            capture_output=True,
            text=True,
            check=True,
            cwd=ROOT,
            timeout=170,
        )
        peak_kb = int(done.stdout.rstrip().splitlines()[-1])
        assert peak_kb < 1.2e6
        assert read_result(tmp_path / "r").views[0].info.size_px == (7680, 4320)


def cross(images: Images, walker: np.ndarray) -> Iterator[np.ndarray]:
    """Let a cut-out person pass from left to right in front of the one filmed."""
    height, width = walker.shape[:2]
    for index, image in enumerate(images):
        at = round((image.shape[1] - width) * index / (len(images) - 1))
        shown = image.copy()
        shown[60 : 60 + height, at : at + width] = walker
        yield shown


class TestWrongWords:
    """Numbers and names that can't be right; the file is looked at only afterwards."""

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (("--stature", "0"), ("between 1 and 2.3 m", "for example 1.75")),
            (("--stature", "17.5"), ("did you mean 1.75 metres?",)),
            (("--stature", "175"), ("centimetres", "did you mean 1.75 metres?")),
            (("--stature", "-1.75"), ("got -1.75",)),
            (("--stature", "nan"), ("got nan",)),
            (("--stature", "1,75"), ("write 1.75, with a point",)),
            (("--stature", "tall"), ("expected a number, got 'tall'",)),
            (("--load", "-5"), ("Load must lie between 0 and 500 kg, got -5", "Correct it")),
            (("--load", "nan"), ("Load", "got nan", "leave it out if unknown")),
            (("--load", "inf"), ("Load", "got inf")),
            (("--frequency", "-1"), ("Lifting frequency", "lifts per minute")),
            (("--coupling", "great"), ("good, fair or poor", "'great'")),
            (("--backend", "magic"), ("Unknown estimator 'magic'", "liftlens backends")),
            (("--solver", "magic"), ("Unknown solver 'magic'", "geometric")),
            (("--methods", "rnle,magic"), ("Unknown risk method 'magic'", "liftlens methods")),
            (("--correction", "magic"), ("default", "'magic'")),
            (("--start", "-1"), ("at least 0",)),
            (("--start", "nan"), ("got nan",)),
            (("--start", "3", "--stop", "2"), ("must stop after it starts",)),
            (("--box", "1,2,3"), ("four numbers", "left,top,right,bottom")),
            (("--box", "90,90,10,10"), ("left < right",)),
            (("--box", "2000,2000,2100,2200"), ("outside the picture", "720 x 480 px")),
            (("--box=-90,-90,-10,-10",), ("outside the picture",)),
        ],
        ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
    )
    def test_a_wrong_option(
        self, assess: Any, clip: Path, arguments: tuple[str, ...], words: tuple[str, ...]
    ) -> None:
        refuse(assess(clip, *arguments), 2, *words)

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            (b"x = [", ("is not valid TOML", "correct that place")),
            (b"\xff\xfe\x00", ("is not valid TOML",)),
            (b"[pose]\nvarient = 'full'\n", ("Unknown key 'varient' in [pose]", "variant")),
            (b"[poze]\n", ("Unknown table [poze]", "pose")),
            (b"[person]\nstature_m = '1.75'\n", ("person.stature_m must be a number",)),
            (b"stature = 1.75\n", ("outside every table",)),
        ],
    )
    def test_a_wrong_settings_file(
        self, assess: Any, clip: Path, tmp_path: Path, text: bytes, words: tuple[str, ...]
    ) -> None:
        path = tmp_path / "mine.toml"
        path.write_bytes(text)
        refuse(assess(clip, "--config", path), 2, *words)

    def test_a_part_behind_the_end(self, assess: Any, clip: Path) -> None:
        refuse(assess(clip, "--start", 60), 3, "from 60 s on", "its last one is at 0.47 s")
        refuse(assess(clip, "--start", 60, "--stop", 70), 3, "60 to 70 s")

    def test_one_video_given_twice(self, assess: Any, clip: Path) -> None:
        refuse(assess(clip, clip), 2, "two videos from different sides", "give one video only")

    def test_a_missing_network_is_exit_4(
        self, assess: Any, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(pipeline, "create_backend", create_backend)
        empty = functools.partial(mediapipe.BlazePoseNetworks, model_dir=tmp_path)
        monkeypatch.setattr(mediapipe, "BlazePoseNetworks", empty)
        refuse(assess(clip), 4, "is missing", "install LiftLens again")

    def test_a_damaged_network_is_exit_4(
        self, assess: Any, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        damaged = tmp_path / "coco_nanodet_g_416.onnx"
        damaged.write_bytes(b"half")
        monkeypatch.setattr(
            pipeline, "PersonDetector", functools.partial(PersonDetector, model_path=damaged)
        )
        refuse(assess(clip), 4, "has 4 bytes instead of", "install LiftLens again")


class TestPlaces:
    """Result folders that can't be written; found out before the long work."""

    @pytest.fixture
    def idle(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def work(*_: object, **__: object) -> None:
            pytest.fail("The work began although its result can't be kept.")

        monkeypatch.setattr(pipeline, "assess", work)

    @pytest.fixture
    def clip(self, tmp_path: Path) -> Path:
        path = tmp_path / "lift.mp4"
        path.write_bytes(b"not looked at")
        return path

    @pytest.mark.usefixtures("idle")
    def test_below_a_file(self, assess: Any, clip: Path) -> None:
        refuse(assess(clip, "--out", clip / "result"), 2, "a part of its path is a file")

    @pytest.mark.usefixtures("idle")
    def test_a_file(self, assess: Any, clip: Path) -> None:
        refuse(assess(clip, "--out", clip), 2, "is a file; choose another name")

    @pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")
    @pytest.mark.usefixtures("idle")
    @pytest.mark.parametrize("out", ["/proc/result", "/proc/new/result"])
    def test_where_not_even_root_may_write(self, assess: Any, clip: Path, out: str) -> None:
        refuse(assess(clip, "--out", out), 2, f"can't be written to {out}", "choose")

    @pytest.mark.usefixtures("idle")
    def test_a_name_that_is_too_long(self, assess: Any, clip: Path, tmp_path: Path) -> None:
        refuse(assess(clip, "--out", tmp_path / ("x" * 300)), 2, "name is too long")

    @pytest.mark.usefixtures("idle")
    def test_a_folder_with_the_user_s_files(self, assess: Any, clip: Path, tmp_path: Path) -> None:
        mine = tmp_path / "mine"
        mine.mkdir()
        (mine / "thesis.docx").write_text("years of work")
        refuse(assess(clip, "--out", mine), 2, "other files (thesis.docx)", "choose another")
        assert [p.name for p in mine.iterdir()] == ["thesis.docx"]

    def test_folders_that_are_not_there_yet_are_made(
        self, assess: Any, tmp_path: Path, lift: Images
    ) -> None:
        path = write_clip(tmp_path / "real.mp4", lift[:4], rate=15)
        stored = accept(assess(path, *STATURE, "--out", tmp_path / "a" / "b" / "c"))
        assert stored.folder == tmp_path / "a" / "b" / "c"
        assert [p.name for p in (tmp_path / "a" / "b").iterdir()] == ["c"]

    @pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX limits")
    @pytest.mark.parametrize("limit_bytes", [100, 25_000])
    def test_no_room_for_the_files(
        self, assess: Any, tmp_path: Path, lift: Images, limit_bytes: int
    ) -> None:
        import resource

        path = write_clip(tmp_path / "real.mp4", lift[:6], rate=15)
        earlier = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, earlier[1]))
        try:
            result = assess(path, *STATURE)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, earlier)
        refuse(result, 2, "can't be written", str(tmp_path / "out" / "new" / "result"))
        assert ".partial" not in result.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
class TestCtrlC:
    """A real process, stopped at several moments."""

    def stop(
        self, tmp_path: Path, clip: Path, *, at: str, presses: int = 1
    ) -> tuple[int, float, str]:
        """Run until a line on stderr begins with `at`, press, and wait for the end."""
        arguments = ["assess", str(clip), *STATURE, "--out", str(tmp_path / "new" / "result")]
        with subprocess.Popen(
            [sys.executable, "-m", "engine.cli_start", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        ) as process:
            assert process.stderr is not None
            seen = ""
            while not (line := process.stderr.readline()).startswith(at):
                assert line, f"It ended before {at!r}: {seen}"
                seen += line
            start = time.monotonic()
            for _ in range(presses):
                process.send_signal(signal.SIGINT)
                time.sleep(0.05)
            stdout, stderr = process.communicate(timeout=60)
            took_s = time.monotonic() - start
        assert stdout == ""
        assert "Traceback" not in stderr
        assert [p.name for p in tmp_path.iterdir()] == [clip.name]
        return process.returncode, took_s, stderr.rstrip().splitlines()[-1]

    @pytest.fixture
    def clip(self, tmp_path: Path, lift: Images) -> Path:
        return write_clip(tmp_path / "lift.mp4", lift[:10] * 2, rate=15)

    @pytest.mark.parametrize(
        ("at", "presses"),
        [
            ("Starting", 1),
            ("Looking", 1),
            ("Finding", 1),
            ("Following", 1),
            ("Drawing", 1),
            ("Drawing", 4),
        ],
    )
    def test_it_ends_soon_and_leaves_nothing(
        self, tmp_path: Path, clip: Path, at: str, presses: int
    ) -> None:
        code, took_s, last = self.stop(tmp_path, clip, at=at, presses=presses)
        assert code == 130
        assert last.startswith("Error: ")
        assert "nothing was kept" in last
        assert took_s < 4.0  # one to two where nothing else runs

    def test_before_the_command_begins(self) -> None:
        script = (
            "import sys, time\n"
            "from engine.cli_start import guard_start\n"
            "guard_start()\n"
            "print('typer' in sys.modules, flush=True)\n"
            "time.sleep(30)\n"
        )
        with subprocess.Popen(
            [sys.executable, "-c", script],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "False\n"
            process.send_signal(signal.SIGINT)
            _, stderr = process.communicate(timeout=20)
        assert process.returncode == 130
        assert stderr.split("\n") == [
            "",
            "Error: Stopped before anything was done; nothing was kept.",
            "",
        ]


@pytest.mark.slow
def test_a_whole_run_as_a_shell_sees_it(tmp_path: Path, lift: Images) -> None:
    clip = write_clip(tmp_path / "lift.mp4", lift[:8], rate=15)
    done = subprocess.run(
        [sys.executable, "-m", "engine.cli_start", "assess", str(clip), *STATURE, "--quiet"],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=120,
    )
    assert done.returncode == 0
    assert done.stderr == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lift.mp4", "liftlens_lift"]
    document = json.loads((tmp_path / "liftlens_lift" / "trial.json").read_text(encoding="utf-8"))
    assert document["task"]["load_kg"] == 10
