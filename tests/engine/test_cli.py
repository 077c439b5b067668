"""The command line: options, exit codes, the last line on stderr, nothing half written."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from engine import cli_demo, cli_serve
from engine.cli import app
from engine.cli_output import (
    STAGES,
    format_columns,
    format_index,
    name_stage,
    show_progress,
    stop_on_signal,
    summarise,
)
from engine.cli_settings import OPTION_KEYS, build_settings
from engine.config import Config
from engine.datatypes import Coupling, Trial
from engine.errors import (
    AssessmentError,
    BackendUnavailable,
    Cancelled,
    ConfigError,
    DataError,
    EngineError,
    NoPersonFound,
    OutputError,
    VideoError,
)
from engine.storage.library import Library
from engine.storage.results import read_result, write_result
from tests.builders import make_trial_result

ROOT = Path(__file__).parents[2]

Pipeline = Callable[..., Path]


class Calls(list[tuple[Trial, Config, Path]]):
    """What the pipeline was called with; `error` is raised when set."""

    error: BaseException | None = None
    changes: dict[str, Any]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Replace the pipeline by one that writes a small result at once."""
    calls = Calls()
    calls.changes = {}

    def assess_to_folder(trial: Trial, config: Config, folder: Path, progress: Any) -> Path:
        calls.append((trial, config, folder))
        for stage in ("pose", "kinematics"):
            progress(stage, 1, 2)
        if calls.error is not None:
            raise calls.error
        result = make_trial_result(
            n_frames=3, trial=trial, config=config.as_dict(), **calls.changes
        )
        return write_result(result, folder)

    fake = types.ModuleType("engine.pipeline")
    fake.assess_to_folder = assess_to_folder  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "engine.pipeline", fake)
    return calls


@pytest.fixture
def video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "crate.mp4"
    path.write_bytes(b"not decoded here")
    return path


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def last_line(result: Any) -> str:
    return str(result.stderr.rstrip().splitlines()[-1])


class TestAssess:
    def test_a_run_writes_the_result_and_says_where(self, video: Path, calls: Calls) -> None:
        result = run("assess", video)
        assert result.exit_code == 0, result.output
        folder = video.parent / "liftlens_crate"
        assert read_result(folder).document["label"] == "crate"
        assert str(folder) in result.stdout
        assert "Following the person's joints ..." in result.stderr

    def test_the_summary_has_lifts_index_and_flags(self, video: Path, calls: Calls) -> None:
        calls.changes = {"lis": (1.4, math.inf, math.nan)}
        text = run("assess", video).stdout
        assert "1.40 (1.12 to 1.82)" in text
        assert "infinite" in text
        assert "45 ± 4" in text
        assert "0.20-0.80" in text
        assert "HIGH: Lifting index above 1 - The load is far" in text
        assert "Traceback" not in text

    def test_quiet_silences_stderr(self, video: Path, calls: Calls) -> None:
        assert run("assess", video, "--quiet").stderr == ""

    def test_every_option_reaches_the_pipeline(self, video: Path, calls: Calls) -> None:
        options = (
            "--stature 1.62 --mass 61 --sex female --age 41 --load 9.5 --hands 2 --coupling Good "
            "--frequency 2.5 --duration 1.5 --recovery 2 --destination-control --backend mediapipe "
            "--solver geometric --correction none --methods rnle,reba --start 1 --stop 4.5 "
            "--box 10,20,110,220 --no-overlay --no-blur --label Crate --out there"
        )
        assert run("assess", video, *options.split()).exit_code == 0
        ((trial, config, folder),) = calls
        subject, task = trial.subject, trial.task
        assert [view.path for view in trial.views] == [video]
        assert (subject.stature_m, subject.mass_kg, subject.sex, subject.age_y) == (
            1.62,
            61.0,
            "female",
            41.0,
        )
        assert (task.load_kg, task.hands, task.coupling) == (9.5, 2, Coupling.GOOD)
        assert (task.frequency_per_min, task.duration_h, task.recovery_h) == (2.5, 1.5, 2.0)
        assert task.destination_control is True
        assert (config.pose.backend, config.kinematics.solver) == ("mediapipe", "geometric")
        assert (config.correction.preset, config.risk.methods) == ("none", ("rnle", "reba"))
        assert (config.video.start_s, config.video.stop_s) == (1.0, 4.5)
        assert config.subject.box == (10.0, 20.0, 110.0, 220.0)
        assert (config.output.overlay, config.output.blur_heads) == (False, False)
        assert trial.label == "Crate"
        assert folder == video.parent / "there"

    def test_without_options_nothing_is_invented(self, video: Path, calls: Calls) -> None:
        run("assess", video)
        ((trial, config, _),) = calls
        assert trial.subject.stature_m is None
        assert (trial.task.load_kg, trial.task.coupling, trial.task.hands) == (None, None, None)
        assert trial.task.destination_control is None
        assert config == Config()

    def test_a_file_gives_what_options_give(self, video: Path, calls: Calls) -> None:
        Path("c.toml").write_text(
            """
            [person]
            stature_m = 1.62
            label = "P07"
            [task]
            load_kg = 9
            coupling = "poor"
            destination_control = true
            notes = "wet floor"
            [trial]
            label = "Crate"
            site = "Hall 3"
            [run]
            out = "there"
            quiet = true
            [risk]
            methods = ["rnle"]
            [subject]
            box = [1, 2, 3, 4]
            [output]
            overlay = false
            """
        )
        result = run("assess", video, "--config", "c.toml", "--overlay", "--load", 12)
        assert (result.exit_code, result.stderr) == (0, "")
        ((trial, config, folder),) = calls
        assert (trial.subject.stature_m, trial.subject.label) == (1.62, "P07")
        assert (trial.task.coupling, trial.task.notes) == (Coupling.POOR, "wet floor")
        assert (trial.label, trial.site, folder.name) == ("Crate", "Hall 3", "there")
        assert config.subject.box == (1.0, 2.0, 3.0, 4.0)
        assert trial.task.load_kg == 12.0
        assert config.output.overlay is True

    def test_every_option_has_a_key_in_the_file(self) -> None:
        command = typer.main.get_command(app).commands["assess"]  # type: ignore[attr-defined]
        options = {p.name for p in command.params if p.param_type_name == "option"}
        assert options - {"config", "debug", "help"} == set(OPTION_KEYS)

    def test_help_documents_every_table(self) -> None:
        text = run("assess", "--help").stdout
        for table in {table for table, _ in OPTION_KEYS.values()}:
            assert f"[{table}]" in text
        for option in (o.replace("_", "-") for o in OPTION_KEYS):
            assert f"--{option}" in text


class TestWrongUse:
    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ("--stature 17.5", "did you mean 1.75"),
            ("--stature 175", "It looks like centimetres: did you mean 1.75 metres?"),
            ("--stature 0", "Give the stature in metres"),
            ("--stature nan", "Stature must lie between 1 and 2.3 m"),
            ("--load=-3", "Load must lie between 0 and 500 kg, got -3"),
            ("--load inf", "Load must lie between"),
            ("--coupling strong", "Coupling must be good, fair or poor, got 'strong'"),
            ("--hands 3", "hands must be one of 1, 2"),
            ("--sex x", "sex must be one of female, male"),
            ("--mass 5", "Body mass"),
            ("--age 3", "Age"),
            ("--frequency=-1", "Lifting frequency"),
            ("--duration 30", "Duration"),
            ("--correction best", "correction.preset must be one of"),
            ("--correction magic", "must be one of default, paper, none"),
            ("--box 1,2,3", "--box needs four numbers"),
            ("--box 9,2,3,4", "left < right"),
            ("--box a,b,c,d", "--box needs four numbers"),
            ("--start=-1", "start_s must be at least 0"),
            ("--start 5 --stop 4", "must stop after it starts (5 s), got stop_s = 4"),
            ("--calibration c.toml", "--calibration is for two videos of one movement"),
            ("--fusion triangulate", "--fusion is for two videos of one movement"),
            ("--sync auto", "--sync is for two videos of one movement"),
            ("second.mp4", "second.mp4 does not exist"),
            ("crate.mp4", "both are crate.mp4"),
            ("--config none.toml", "can't be read"),
            ("--out crate.mp4", "is a file"),
            ("--out crate.mp4/x", "a part of its path is a file"),
            ("--unknown", "--unknown"),
            ("--load heavy", "'--load'"),
        ],
    )
    def test_it_is_one_sentence_and_exit_2(
        self, video: Path, calls: Calls, options: str, words: str
    ) -> None:
        result = run("assess", video, *options.split())
        assert result.exit_code == 2, result.output
        assert words in last_line(result)
        assert "Traceback" not in result.output
        assert calls == []
        assert [p.name for p in video.parent.iterdir()] == ["crate.mp4"]

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("stature_m = 1.75", "'stature_m' stands outside every table"),
            ("[persons]", "Unknown table [persons]"),
            ("[person]\nheight = 1.75", "Unknown key 'height' in [person]"),
            ('[person]\nstature_m = "1.75"', "person.stature_m must be a number, got '1.75'"),
            ("[task]\ncoupling = 3", "Coupling must be good, fair or poor"),
            ("[task]\nhands = true", "task.hands must be one of 1, 2"),
            ("[trial]\nsync = 'auto'", "Unknown key 'sync' in [trial]"),
            ("[two_view]\nsync = 'soon'", "must be auto or a number of seconds"),
            ("[two_view]\nfusion = 'best'", "must be one of triangulate, model"),
            ("[pose]\nthreads = 1.5", "pose.threads must be a whole number"),
            ("[correction]\ncutoff_hz = nan", "cutoff_hz must lie between"),
            ("[run]\nquiet = 1", "run.quiet must be true or false"),
            ("[person", "is not valid TOML"),
        ],
    )
    def test_a_wrong_file(self, video: Path, calls: Calls, text: str, words: str) -> None:
        Path("c.toml").write_text(text)
        result = run("assess", video, "--config", "c.toml")
        assert result.exit_code == 2
        assert words in last_line(result)
        assert calls == []

    def test_a_file_that_is_no_text(self, video: Path, calls: Calls) -> None:
        Path("c.toml").write_bytes(b"\xff\xfe\x00")
        result = run("assess", video, "--config", "c.toml")
        assert (result.exit_code, calls) == (2, [])
        assert "is not valid TOML" in last_line(result)

    @pytest.mark.parametrize(
        ("name", "words"), [("no.mp4", "does not exist"), (".", "is a folder")]
    )
    def test_a_video_that_is_none(self, video: Path, calls: Calls, name: str, words: str) -> None:
        result = run("assess", name)
        assert result.exit_code == 2
        assert words in last_line(result)

    def test_a_folder_of_the_user_is_kept(self, video: Path, calls: Calls) -> None:
        Path("mine").mkdir()
        Path("mine/thesis.docx").write_text("years of work")
        result = run("assess", video, "--out", "mine")
        assert result.exit_code == 2
        assert "thesis.docx" in last_line(result)
        assert calls == []
        assert Path("mine/thesis.docx").read_text() == "years of work"

    def test_no_video_and_no_command(self) -> None:
        for arguments in ((), ("assess",), ("nonsense",), ("export", ".")):
            assert run(*arguments).exit_code == 2

    def test_two_views_and_what_belongs_to_them_reach_the_pipeline(
        self, video: Path, calls: Calls
    ) -> None:
        Path("front.mp4").write_bytes(b"another")
        options = ["--calibration", "cameras.toml", "--sync", "0.35", "--fusion", "model"]
        run("assess", video, "front.mp4", *options)
        trial, config, _ = calls[0][:3]
        assert [view.path.name for view in trial.views] == ["crate.mp4", "front.mp4"]
        assert config.two_view.calibration == "cameras.toml"
        assert config.two_view.given_offset_s == 0.35
        assert config.two_view.fusion == "model"


class TestFailures:
    @pytest.mark.parametrize(
        ("error", "code"),
        [
            (VideoError("Expected a video, got text; choose another file."), 3),
            (NoPersonFound("Nobody was found."), 3),
            (DataError("Values can't be right."), 3),
            (AssessmentError("Nothing to assess."), 3),
            (BackendUnavailable("The estimator needs x; run: pip install x."), 4),
            (ConfigError("Unknown estimator."), 2),
            (OutputError("The disk is full."), 2),
            (Cancelled("The assessment was stopped; nothing was kept."), 130),
            (MemoryError(), 3),
        ],
        ids=lambda value: type(value).__name__,
    )
    def test_each_error_has_its_code_and_sentence(
        self, video: Path, calls: Calls, error: Exception, code: int
    ) -> None:
        calls.error = error
        result = run("assess", video)
        assert result.exit_code == code
        expected = str(error) if isinstance(error, EngineError) else "ran out of memory"
        assert expected in last_line(result)
        assert last_line(result).startswith("Error: ")
        assert result.stdout == ""
        assert not Path("liftlens_crate").exists()

    def test_a_long_message_stays_one_line(self, video: Path, calls: Calls) -> None:
        calls.error = VideoError("Expected a video,\n  got text.")
        assert last_line(run("assess", video)) == "Error: Expected a video, got text."

    def test_a_fault_is_admitted_without_a_traceback(self, video: Path, calls: Calls) -> None:
        calls.error = ZeroDivisionError("division by zero")
        result = run("assess", video)
        assert result.exit_code == 1
        assert "ZeroDivisionError: division by zero" in last_line(result)
        assert "--debug" in last_line(result)
        assert "Traceback" not in result.output

    @pytest.mark.parametrize("how", ["option", "variable"])
    def test_debug_shows_the_traceback(self, video: Path, how: str) -> None:
        script = (
            "import sys, types\n"
            "fake = types.ModuleType('engine.pipeline')\n"
            "def assess_to_folder(*_):\n"
            "    raise ZeroDivisionError('division by zero')\n"
            "fake.assess_to_folder = assess_to_folder\n"
            "sys.modules['engine.pipeline'] = fake\n"
            "from engine.cli import main\n"
            "main()\n"
        )
        arguments = ["assess", str(video), *(["--debug"] if how == "option" else [])]
        environment = {**os.environ, "LIFTLENS_DEBUG": "1" if how == "variable" else ""}
        done = run_python(script, *arguments, env=environment)
        assert done.returncode == 1
        assert "Traceback" in done.stderr
        assert done.stderr.rstrip().splitlines()[-1].startswith("Error: LiftLens made a mistake")


def run_python(
    script: str, *arguments: str, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", script, *arguments],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env=env,
        timeout=60,
    )


def run_cli(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "engine.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env={**os.environ, **environment},
        timeout=60,
    )


class TestProcess:
    """The same through a real process: exit code and last line as a shell sees them."""

    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            (("assess", "missing.mp4"), 2, "does not exist"),
            (("assess", __file__, "--stature", "17.5"), 2, "did you mean 1.75"),
            (("assess", __file__, __file__), 2, "both are test_cli.py"),
            (("assess", __file__, "--nonsense"), 2, "--nonsense"),
            (("assess",), 2, "VIDEO"),
            (("export", ".", "--format", "csv"), 3, "no LiftLens result"),
            (("export", ".", "--format", "bvh"), 3, "no LiftLens result"),
            (("report", ".", "--out", "r.pdf"), 3, "no LiftLens result"),
            (("compare", ".", "."), 2, "holds no result"),
            (("calibrate",), 2, "Expected one of --method"),
            (("calibrate", "--check", "none.toml"), 3, "none.toml"),
            (("report", ".", "--out", "r.pdf", "--paper", "a5"), 2, "a5"),
        ],
    )
    def test_exit_code_and_last_line(
        self, arguments: tuple[str, ...], code: int, words: str
    ) -> None:
        done = run_cli(*arguments)
        assert done.returncode == code
        last = done.stderr.rstrip().splitlines()[-1]
        assert words.lower() in last.lower()
        assert last.startswith("Error: ")
        assert "Traceback" not in done.stderr
        assert done.stdout == ""

    def test_help_is_fast_because_nothing_heavy_is_imported(self) -> None:
        script = (
            "import sys\nfrom engine.cli import app\n"
            "heavy = {'numpy', 'cv2', 'av', 'onnxruntime', 'scipy', 'pandas', 'streamlit'}\n"
            "print(sorted(heavy & set(sys.modules)))\n"
        )
        assert run_python(script).stdout.strip() == "[]"

    def test_version(self) -> None:
        assert re.fullmatch(r"liftlens \S+", run_cli("--version").stdout.strip())

    @pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
    @pytest.mark.parametrize(
        ("stubborn", "presses", "number"),
        [(False, 1, signal.SIGINT), (True, 2, signal.SIGINT), (False, 1, signal.SIGTERM)],
        ids=["between steps", "second press, inside a step", "asked to end"],
    )
    def test_ctrl_c_is_130_and_leaves_nothing(
        self, tmp_path: Path, stubborn: bool, presses: int, number: int
    ) -> None:
        script = f"""
import sys, time, types
fake = types.ModuleType('engine.pipeline')
def assess_to_folder(trial, config, folder, progress):
    from engine.storage import results
    from tests.builders import make_trial_result
    def slow(*_, **__):
        print('ready', flush=True)
        end = time.monotonic() + 30
        while time.monotonic() < end:
            time.sleep(0.05)
            if not {stubborn}:
                progress('write', 0, 0)
    results.build_document = slow
    return results.write_result(make_trial_result(), folder)
fake.assess_to_folder = assess_to_folder
sys.modules['engine.pipeline'] = fake
from engine.cli import main
main()
"""
        video = tmp_path / "crate.mp4"
        video.write_bytes(b"x")
        with subprocess.Popen(
            [
                sys.executable,
                "-c",
                script,
                "assess",
                str(video),
                "--out",
                str(tmp_path / "r" / "s"),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            for _ in range(presses):
                process.send_signal(number)
                time.sleep(0.3)
            _, stderr = process.communicate(timeout=20)
        assert process.returncode == 130
        assert stderr.rstrip().splitlines()[-1].startswith("Error: ")
        assert "nothing was kept" in stderr.rstrip().splitlines()[-1]
        assert "Traceback" not in stderr
        assert [p.name for p in tmp_path.iterdir()] == ["crate.mp4"]


class TestProgress:
    def test_stages_have_plain_words(self) -> None:
        assert name_stage("pose") == STAGES["pose"]
        assert name_stage("some_new_step") == "Some new step"

    def test_without_a_terminal_each_stage_is_one_line(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with show_progress(is_quiet=False) as report:
            for done in range(50):
                report("pose", done, 50)
            report("write", 0, 0)
        assert capsys.readouterr().err.splitlines() == [
            "Following the person's joints ...",
            "Saving the result ...",
        ]

    def test_on_a_terminal_a_bar_is_drawn(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
        monkeypatch.setenv("TERM", "xterm")
        with show_progress(is_quiet=False) as report:
            report("pose", 25, 50)
            report("video", 0, 0)
            report("pose", 50, 50)
        assert "Following the person's joints" in capsys.readouterr().err

    def test_a_failure_takes_the_bar_away(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True)

        def fail() -> None:
            with show_progress(is_quiet=False) as report:
                report("pose", 1, 2)
                raise VideoError("broken")

        with pytest.raises(VideoError):
            fail()
        assert capsys.readouterr().err.endswith("\x1b[2K")

    @pytest.fixture
    def handlers(self) -> Iterator[None]:
        numbers = (signal.SIGINT, signal.SIGTERM)
        before = [signal.getsignal(n) for n in numbers]
        yield
        assert [signal.getsignal(n) for n in numbers] == before

    @pytest.mark.usefixtures("handlers")
    def test_the_first_press_is_a_flag_the_second_an_interrupt(self) -> None:
        seen: list[str] = []
        with stop_on_signal(lambda stage, _done, _total: seen.append(stage)) as report:
            report("pose", 0, 1)
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert seen == ["pose"]

    @pytest.mark.usefixtures("handlers")
    def test_what_is_being_undone_is_not_disturbed(self) -> None:
        with stop_on_signal(lambda *_: None) as report:
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(Cancelled):
                report("video", 0, 1)
            for _ in range(3):
                signal.raise_signal(signal.SIGINT)

    @pytest.mark.usefixtures("handlers")
    def test_a_press_when_all_is_done_says_that_the_result_stays(
        self, capfd: pytest.CaptureFixture[str]
    ) -> None:
        with stop_on_signal(lambda *_: None):
            signal.raise_signal(signal.SIGINT)
        assert capfd.readouterr().err.endswith("It was already done; the result is kept.\n")


class TestText:
    @pytest.mark.parametrize(
        ("value", "interval", "text"),
        [
            (1.404, (1.1, 1.8), "1.40 (1.10 to 1.80)"),
            (1.4, (math.nan, math.nan), "1.40"),
            (1.4, (None, None), "1.40"),
            (math.inf, (2.0, math.inf), "infinite (2.00 to infinite)"),
            (math.nan, (1.0, 2.0), "-"),
            (None, (None, None), "-"),
        ],
    )
    def test_an_index(self, value: float | None, interval: Any, text: str) -> None:
        assert format_index(value, interval) == text

    def test_columns_line_up(self) -> None:
        assert format_columns(("a", "bb"), [("ccc", "d"), ("", "e")]) == [
            "a    bb",
            "ccc  d",
            "     e",
        ]

    def test_a_result_without_lifts(self, tmp_path: Path) -> None:
        folder = write_result(make_trial_result(lis=()), tmp_path / "r")
        assert summarise(read_result(folder)).startswith("No lift was found.")

    def test_a_result_without_methods(self, tmp_path: Path) -> None:
        folder = write_result(make_trial_result(risk={}, flags=(), warnings=()), tmp_path / "r")
        text = summarise(read_result(folder))
        assert "0.20-0.80" in text
        assert "Methods" not in text

    def test_a_refused_method_says_why(self, tmp_path: Path) -> None:
        folder = write_result(make_trial_result(lis=(math.nan,)), tmp_path / "r")
        assert "rnle: not applicable (The grip was" in summarise(read_result(folder))


class TestLists:
    def test_methods_shows_names_and_references(self) -> None:
        result = run("methods")
        assert result.exit_code == 0
        assert "rnle" in result.stdout
        assert "Waters" in result.stdout

    def test_backends_shows_what_is_missing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from engine.pose import base

        infos = (
            base.BackendInfo(
                "ready", "Ready", "mediapipe_33", "Apache-2.0", "", requires=("json",)
            ),
            base.BackendInfo(
                "later", "Later", "h36m_17", "MIT", "", requires=("no_such_module",), extra="train"
            ),
        )
        monkeypatch.setattr(base, "list_backends", lambda: infos)
        lines = run("backends").stdout.splitlines()
        (ready,) = [line for line in lines if "ready" in line]
        (later,) = [line for line in lines if "later" in line]
        assert "yes" in ready
        assert "Apache-2.0" in ready
        assert "missing: no_such_module; run: pip install 'liftlens[train]'" in later

    def test_no_backend_says_so(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from engine.pose import base

        monkeypatch.setattr(base, "list_backends", tuple)
        assert run("backends").stdout == "No estimator is installed.\n"


class TestExport:
    def test_it_says_where(self, tmp_path: Path) -> None:
        folder = write_result(make_trial_result(), tmp_path / "r")
        result = run("export", folder, "--format", "csv", "--out", tmp_path / "a.csv")
        assert (result.exit_code, result.stdout) == (0, f"Written: {tmp_path / 'a.csv'}\n")
        assert (tmp_path / "a.csv").read_text() == (folder / "angles.csv").read_text()

    def test_other_formats_are_refused(self, tmp_path: Path) -> None:
        result = run("export", tmp_path, "--format", "xlsx")
        assert result.exit_code == 2
        assert "available: trc, mot, csv, c3d, bvh" in last_line(result)


SAMPLES = """
[[sample]]
key = "side"
title = "Crate from the floor"
file = "side.mp4"
stature_m = 1.8
sex = "male"
load_kg = 12
coupling = "fair"
frequency_per_min = 1
duration_h = 1
licence = "CC0"
note = "synthetic"

[[sample]]
key = "real"
title = "Two-handed lift"
file = "real.mp4"
stature_m = 1.7
load_kg = 5
"""


class TestDemo:
    @pytest.fixture
    def samples(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        folder = tmp_path / "sample_data"
        folder.mkdir()
        (folder / "samples.toml").write_text(SAMPLES)
        for name in ("side.mp4", "real.mp4"):
            (folder / name).write_bytes(b"video")
        monkeypatch.setattr(cli_demo, "SAMPLE_FOLDER", folder)
        monkeypatch.setenv("LIFTLENS_HOME", str(tmp_path / "home"))
        return folder

    def test_it_assesses_every_sample_once(
        self, samples: Path, calls: Calls, tmp_path: Path
    ) -> None:
        result = run("demo", "--no-serve")
        assert result.exit_code == 0, result.output
        assert [trial.views[0].path.name for trial, _, _ in calls] == ["side.mp4", "real.mp4"]
        trial = calls[0][0]
        assert (trial.subject.stature_m, trial.subject.sex) == (1.8, "male")
        assert (trial.task.load_kg, trial.task.coupling) == (12.0, Coupling.FAIR)
        lines = result.stdout.splitlines()
        (line,) = [line for line in lines if line.startswith("Crate from the floor")]
        assert "0.20-0.80" in line
        assert "1.40 (1.12 to 1.82)" in line
        assert "high" in line
        assert str(tmp_path / "home") in result.stdout
        ids = {entry.id for entry in Library.open().entries()}
        assert ids == {"sample-side", "sample-real"}

        again = run("demo", "--no-serve")
        assert len(calls) == 2
        assert again.stdout == result.stdout

    def test_a_damaged_sample_is_assessed_again(self, samples: Path, calls: Calls) -> None:
        run("demo", "--no-serve", "--quiet")
        (Library.open().folder("sample-side") / "tracks.npz").write_bytes(b"")
        assert run("demo", "--no-serve").exit_code == 0
        assert len(calls) == 3

    def test_then_it_serves(
        self, samples: Path, calls: Calls, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        served: list[dict[str, Any]] = []
        monkeypatch.setattr(cli_serve, "serve_dashboard", lambda **k: served.append(k) or 0)
        assert run("demo", "--port", "9000").exit_code == 0
        assert [(s["host"], s["port"]) for s in served] == [("localhost", 9000)]

    def test_missing_samples_say_so(
        self, tmp_path: Path, calls: Calls, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(cli_demo, "SAMPLE_FOLDER", tmp_path)
        result = run("demo", "--no-serve")
        assert result.exit_code == 4
        assert "bundled samples" in last_line(result)

    def test_a_missing_clip_says_so(self, samples: Path, calls: Calls) -> None:
        (samples / "real.mp4").unlink()
        result = run("demo", "--no-serve")
        assert result.exit_code == 4
        assert "real.mp4" in last_line(result)
        assert calls == []

    @pytest.mark.parametrize("text", ["[[sample]]", "x = 1", "nonsense", "sample = 3"])
    def test_a_broken_list_says_so(self, samples: Path, calls: Calls, text: str) -> None:
        (samples / "samples.toml").write_text(text)
        result = run("demo", "--no-serve")
        assert result.exit_code == 2
        assert "list of samples" in last_line(result)

    def test_the_samples_shipped_are_readable(self) -> None:
        samples = cli_demo.read_samples()
        assert len({sample.key for sample in samples}) == len(samples) >= 1
        assert all(sample.licence for sample in samples)
        assert any(sample.subject.stature_m for sample in samples)


class TestServe:
    def test_the_command_keeps_to_itself(self) -> None:
        command = cli_serve.build_command(host="localhost", port=8600, is_headless=True)
        assert command[:4] == [sys.executable, "-m", "streamlit", "run"]
        assert Path(command[4]).parts[-2:] == ("dashboard", "app.py")
        options = dict(zip(command[5::2], command[6::2], strict=True))
        assert options == {
            "--server.address": "localhost",
            "--server.port": "8600",
            "--server.headless": "true",
            "--browser.gatherUsageStats": "false",
        }

    @pytest.mark.parametrize(
        ("environment", "expected"),
        [
            ({}, False),
            ({"DISPLAY": ":0"}, True),
            ({"WAYLAND_DISPLAY": "wayland-0"}, True),
            ({"DISPLAY": ":0", "CI": "true"}, False),
            ({"DISPLAY": ":0", "SSH_CONNECTION": "x"}, False),
        ],
    )
    def test_a_browser_opens_only_where_one_can(
        self, monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], expected: bool
    ) -> None:
        monkeypatch.setattr(cli_serve.sys, "platform", "linux")
        assert cli_serve.has_display(environment) is expected

    def test_a_missing_dashboard_is_exit_4(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(cli_serve, "APP_PATH", tmp_path / "dashboard" / "app.py")
        result = run("serve")
        assert result.exit_code == 4
        assert "dashboard" in last_line(result)

    def test_a_taken_port_is_exit_2(self, app_path: Path) -> None:
        import socket

        with socket.create_server(("127.0.0.1", 0)) as server:
            port = server.getsockname()[1]
            result = run("serve", "--host", "127.0.0.1", "--port", port)
        assert result.exit_code == 2
        assert f"127.0.0.1:{port}" in last_line(result)

    @pytest.fixture
    def app_path(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        path = tmp_path / "dashboard" / "app.py"
        path.parent.mkdir()
        path.write_text("")
        monkeypatch.setattr(cli_serve, "APP_PATH", path)
        return path

    @pytest.mark.parametrize(("code", "expected"), [(0, 0), (3, 3)])
    def test_it_passes_on_the_exit_code_and_where_the_engine_is(
        self,
        app_path: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        code: int,
        expected: int,
    ) -> None:
        script = (
            "import os, pathlib, sys; "
            "pathlib.Path(sys.argv[1]).write_text(os.environ['PYTHONPATH']); "
            f"sys.exit({code})"
        )
        note = tmp_path / "note"
        monkeypatch.setattr(
            cli_serve,
            "build_command",
            lambda **_: [sys.executable, "-c", script, str(note)],
        )
        monkeypatch.setenv("PYTHONPATH", "elsewhere")
        result = run("serve", "--host", "127.0.0.1", "--port", free_port())
        assert result.exit_code == expected
        assert "http://127.0.0.1:" in result.stdout
        assert note.read_text().split(os.pathsep) == [str(tmp_path), "elsewhere"]

    def test_ctrl_c_ends_it_as_done(self, app_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        class Process:
            waits = 0
            ended = False

            def wait(self) -> int:
                self.waits += 1
                if self.waits == 1:
                    raise KeyboardInterrupt
                return -signal.SIGTERM

            def terminate(self) -> None:
                self.ended = True

        process = Process()
        monkeypatch.setattr(cli_serve.subprocess, "Popen", lambda *_, **__: process)
        result = run("serve", "--host", "127.0.0.1", "--port", free_port())
        assert result.exit_code == 0
        assert process.ended


def free_port() -> int:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def test_a_full_disk_is_one_sentence(
    video: Path, calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    from engine.storage import results

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(results, "write_tracks", full)
    result = run("assess", video)
    assert result.exit_code == 2
    assert last_line(result).endswith("the disk is full; free some space.")
    assert [p.name for p in video.parent.iterdir()] == ["crate.mp4"]


def test_settings_are_kept_with_the_result(video: Path, calls: Calls) -> None:
    run("assess", video, "--start", "1", "--methods", "rnle")
    document = json.loads(Path("liftlens_crate/trial.json").read_text())
    assert document["config"]["video"]["start_s"] == 1.0
    assert document["config"]["risk"]["methods"] == ["rnle"]


def test_settings_can_be_built_without_the_command_line(video: Path) -> None:
    settings = build_settings(video, options={"load": 7.0})
    assert settings.trial.task.load_kg == 7.0
    assert settings.out == Path("liftlens_crate")
