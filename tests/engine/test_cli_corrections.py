"""When the lifts were, told to `liftlens assess`."""

from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from engine.cli import app
from engine.corrections import NO_CORRECTIONS, Corrections
from engine.datatypes import Trial
from engine.storage.results import write_result
from tests.builders import make_trial_result


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Corrections]:
    """What the pipeline was told to correct, call by call."""
    told: list[Corrections] = []

    def assess_to_folder(
        trial: Trial, _config: Any, folder: Path, _progress: Any, corrections: Any = NO_CORRECTIONS
    ) -> Path:
        told.append(corrections)
        return write_result(make_trial_result(n_frames=3, trial=trial), folder)

    fake = types.ModuleType("engine.pipeline")
    fake.assess_to_folder = assess_to_folder  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "engine.pipeline", fake)
    monkeypatch.chdir(tmp_path)
    Path("crate.mp4").write_bytes(b"not decoded here")
    return told


def assess(*options: str) -> Any:
    return CliRunner().invoke(app, ["assess", "crate.mp4", *options])


def test_lifts_are_given_by_options_in_any_number(told):
    assert assess("--lift", "2.1,3.4", "--lift", "6, 7.25").exit_code == 0
    assert told == [Corrections.of_lifts([(2.1, 3.4), (6.0, 7.25)])]


def test_without_options_lifts_are_found(told):
    assert assess().exit_code == 0
    assert told == [NO_CORRECTIONS]


def test_a_file_gives_them_too_and_options_win(told):
    Path("c.toml").write_text("[corrections]\nlifts = [[1, 2], [3.0, 4.5]]\n")
    assert assess("--config", "c.toml").exit_code == 0
    assert assess("--config", "c.toml", "--lift", "5,6").exit_code == 0
    assert told == [Corrections.of_lifts([(1, 2), (3, 4.5)]), Corrections.of_lifts([(5, 6)])]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--lift 2.1", "--lift needs two numbers, start,end in s"),
        ("--lift a,b", "--lift needs two numbers"),
        ("--lift 3,2", "start before its end, got 3 s to 2 s"),
        ("--lift 1,nan", "start before its end"),
        ("--lift 1,3 --lift 2,4", "Two lifts can't overlap"),
    ],
)
def test_absurd_times_are_refused_in_one_sentence(told, options, says):
    result = assess(*options.split())
    assert result.exit_code == 2
    assert says in result.stderr.rstrip().splitlines()[-1]
    assert not told


def test_a_file_with_wrong_keys_is_refused(told):
    Path("c.toml").write_text("[corrections]\nlifts = [[1, 2, 3]]\n")
    assert "needs 2 values, got 3" in assess("--config", "c.toml").stderr
    Path("c.toml").write_text("[corrections]\nlift = [[1, 2]]\n")
    assert "Unknown key 'lift' in [corrections]" in assess("--config", "c.toml").stderr
