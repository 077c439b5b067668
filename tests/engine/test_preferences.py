"""Preferences survive a restart, and a damaged file says what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from engine.config import build_config
from engine.errors import ConfigError, OutputError
from engine.preferences import PREFERENCES_NAME, Preferences, read_preferences, write_preferences


def test_nothing_chosen_means_the_defaults(tmp_path: Path) -> None:
    assert read_preferences(tmp_path) == Preferences()


@pytest.mark.parametrize(
    "chosen",
    [
        Preferences(),
        Preferences(
            units="us",
            paper="letter",
            keep_days=90,
            solver="least-squares",
            experimental_methods=True,
        ),
    ],
)
def test_what_is_written_is_read_back(tmp_path: Path, chosen: Preferences) -> None:
    assert write_preferences(chosen, tmp_path) == tmp_path / PREFERENCES_NAME
    assert read_preferences(tmp_path) == chosen
    assert [path.name for path in tmp_path.iterdir()] == [PREFERENCES_NAME]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("units = 'imperial'", "units must be metric or us, got 'imperial'"),
        ("keep_days = 0", "whole number from 1"),
        ("keep_days = 1.5", "whole number from 1"),
        ("keep_days = true", "whole number from 1"),
        ("experimental_methods = 1", "must be true or false"),
        ("colour = 'red'", "unknown preference 'colour'; known: experimental_methods"),
        ("units = ", "can't be read .* correct or delete it"),
    ],
)
def test_a_wrong_file_is_explained(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / PREFERENCES_NAME).write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_preferences(tmp_path)


def test_a_file_of_other_bytes_is_explained(tmp_path: Path) -> None:
    (tmp_path / PREFERENCES_NAME).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="correct or delete it"):
        read_preferences(tmp_path)


def test_a_folder_that_is_gone_is_explained(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="The preferences can't be written"):
        write_preferences(Preferences(), tmp_path / "gone")


def test_an_assessment_takes_them_over() -> None:
    made = Preferences(solver="least-squares", experimental_methods=True).assessment
    config = build_config(made)
    assert config.kinematics.solver == "least-squares"
    assert config.risk.experimental
    assert build_config(Preferences().assessment) == build_config({})
