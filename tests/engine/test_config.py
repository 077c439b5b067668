"""Settings: every key, type and range is checked, and a file gives what it says."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine import config as config_module
from engine.config import (
    CameraConfig,
    Config,
    CorrectionConfig,
    EventsConfig,
    PoseConfig,
    SubjectConfig,
    VideoConfig,
    build_config,
    build_section,
    read_config,
)
from engine.errors import ConfigError


def settings() -> Iterator[tuple[str, str, Any]]:
    for table, values in Config().as_dict().items():
        for key, value in values.items():
            yield table, key, value


class TestReading:
    def test_a_file_becomes_tables(self, tmp_path: Path) -> None:
        path = tmp_path / "c.toml"
        path.write_text('[pose]\nbackend = "stored"\n[video]\nstop_s = 3\n', encoding="utf-8")
        config = build_config(read_config(path))
        assert config.pose.backend == "stored"
        assert config.video.stop_s == 3.0
        assert isinstance(config.video.stop_s, float)
        assert config.correction == CorrectionConfig()

    @pytest.mark.parametrize("content", [b"[pose", b"\xff\xfe", b"a = ", b"[a]\n[a]\n"])
    def test_what_is_no_toml(self, tmp_path: Path, content: bytes) -> None:
        path = tmp_path / "c.toml"
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=r"c\.toml is not valid TOML"):
            read_config(path)

    def test_a_missing_file_and_a_folder(self, tmp_path: Path) -> None:
        for path in (tmp_path / "none.toml", tmp_path):
            with pytest.raises(ConfigError, match="can't be read"):
                read_config(path)


class TestBuilding:
    def test_no_tables_give_the_defaults(self) -> None:
        assert build_config({}) == Config()

    @pytest.mark.parametrize(("table", "key", "value"), list(settings()))
    def test_every_default_is_accepted_and_stays(self, table: str, key: str, value: Any) -> None:
        assert build_config({table: {key: value}}) == Config()

    def test_the_stored_settings_give_the_same_settings(self) -> None:
        config = build_config(
            {
                "subject": {"box": [1, 2, 3.5, 4], "score": "literal"},
                "risk": {"methods": ["rnle", "reba"], "experimental": True},
                "output": {"overlay": False},
                "video": {"start_s": 1, "stop_s": None},
            }
        )
        assert config.subject.box == (1.0, 2.0, 3.5, 4.0)
        assert config.risk.methods == ("rnle", "reba")
        assert build_config(json.loads(json.dumps(config.as_dict()))) == config

    @pytest.mark.parametrize(("table", "key", "value"), list(settings()))
    def test_a_value_of_another_type_names_its_key(self, table: str, key: str, value: Any) -> None:
        wrong: Any = {} if value is None or isinstance(value, bool | int | float) else 3
        with pytest.raises(ConfigError, match=rf"{table}\.{key} must be"):
            build_config({table: {key: wrong}})
        if not isinstance(value, bool):
            with pytest.raises(ConfigError, match=rf"{table}\.{key}"):
                build_config({table: {key: True}})

    @pytest.mark.parametrize(
        ("tables", "words"),
        [
            ({"poses": {}}, r"Unknown table \[poses\]; known|Unknown table \[poses\] in"),
            ({"pose": 3}, r"\[pose\] must be a table"),
            ({"pose": {"name": "x"}}, r"Unknown key 'name' in \[pose\]; known: backend"),
            ({"pose": {"variant": "light"}}, "one of heavy, full; got 'light'"),
            ({"pose": {"threads": 1.5}}, "must be a whole number, got 1.5"),
            ({"subject": {"box": [1, 2, 3]}}, "needs 4 values, got 3"),
            ({"subject": {"box": "1,2,3,4"}}, "must be a list"),
            ({"subject": {"box": [1, 2, "x", 4]}}, "must be a number, got 'x'"),
            ({"risk": {"methods": "rnle"}}, "must be a list, got 'rnle'"),
            ({"risk": {"methods": [1]}}, "must be text, got 1"),
        ],
    )
    def test_what_is_wrong_is_named(self, tables: dict[str, Any], words: str) -> None:
        with pytest.raises(ConfigError, match=words):
            build_config(tables)

    def test_a_section_leaves_its_table_alone(self) -> None:
        table = {"stop_s": 3}
        assert build_section("video", VideoConfig, table).stop_s == 3.0
        assert table == {"stop_s": 3}

    @given(
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
            lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(), inner),
            max_leaves=5,
        ),
        st.sampled_from([(table, key) for table, key, _ in settings()]),
    )
    def test_any_value_taken_can_be_stored(self, value: Any, place: tuple[str, str]) -> None:
        table, key = place
        with contextlib.suppress(ConfigError):
            config = build_config({table: {key: value}})
            stored = json.dumps(config.as_dict(), allow_nan=False)
            assert build_config(json.loads(stored)) == config


RANGES = [
    (VideoConfig, "start_s", [-0.1, float("nan"), float("inf")], [0.0, 1e6]),
    (SubjectConfig, "first_threshold", [-0.1, 1.1, float("nan")], [0.0, 1.0]),
    (SubjectConfig, "threshold_step", [0.0, -0.1, float("nan")], [0.01, 1.0]),
    (SubjectConfig, "threshold_floor", [-0.1, 1.1], [0.0, 1.0]),
    (SubjectConfig, "track_threshold", [-0.1, 1.1], [0.0, 1.0]),
    (SubjectConfig, "iou_weight", [-1.0, float("inf")], [0.0, 2.0]),
    (SubjectConfig, "hold_frames", [-1], [0, 100]),
    (SubjectConfig, "detect_every", [0], [1, 100]),
    (SubjectConfig, "box_margin", [0.9, 10.0], [1.0, 3.0]),
    (PoseConfig, "threads", [-1, 1000], [0, 64]),
    (PoseConfig, "min_person_confidence", [-0.1, 1.1], [0.0, 1.0]),
    (PoseConfig, "hypotheses", [0, 101], [1, 20]),
    (PoseConfig, "steps", [0, 101], [1, 10]),
    (PoseConfig, "seed", [-1, 2**32], [0, 2**32 - 1]),
    (CameraConfig, "horizontal_fov_deg", [0.0, 180.0, float("nan")], [30.0, 120.0]),
    (CameraConfig, "fov_sigma_deg", [-1.0, float("inf")], [0.0, 20.0]),
    (CameraConfig, "pitch_sigma_deg", [-1.0, float("nan")], [0.0, 20.0]),
    (CameraConfig, "roll_sigma_deg", [-1.0, 100.0], [0.0, 20.0]),
    (CorrectionConfig, "min_confidence", [-0.1, 1.1], [0.0, 1.0]),
    (CorrectionConfig, "max_gap_s", [-0.1, float("nan"), float("inf")], [0.0, 10.0]),
    (CorrectionConfig, "cutoff_hz", [0.0, -6.0, float("inf")], [0.5, 20.0]),
    (CorrectionConfig, "window_s", [-0.1, 61.0, float("nan")], [0.0, 0.5]),
    (CorrectionConfig, "jerk", [0.0, -1.0, float("inf")], [1.0, 300.0]),
    (CorrectionConfig, "gate_probability", [0.4, 1.1, float("nan")], [0.5, 0.999, 1.0]),
    (CorrectionConfig, "min_cutoff_hz", [0.0, -1.0, float("nan")], [0.1, 10.0]),
    (CorrectionConfig, "beta", [-0.1, float("inf")], [0.0, 5.0]),
    (EventsConfig, "min_rise_m", [0.0, 3.0], [0.05, 1.0]),
    (EventsConfig, "min_duration_s", [-0.1], [0.0, 5.0]),
    (EventsConfig, "max_duration_s", [0.2, float("nan")], [0.3, 60.0]),
    (EventsConfig, "speed_floor_m_s", [-0.1], [0.0, 1.0]),
    (EventsConfig, "speed_share", [-0.1, 1.1], [0.0, 1.0]),
    (EventsConfig, "max_hand_separation_m", [-0.1, 5.0], [0.1, 2.0]),
]


class TestRanges:
    @pytest.mark.parametrize(
        ("section", "key", "bad", "good"), RANGES, ids=[f"{r[0].__name__}.{r[1]}" for r in RANGES]
    )
    def test_both_sides_of_the_bounds(
        self, section: type[Any], key: str, bad: list[Any], good: list[Any]
    ) -> None:
        for value in good:
            assert getattr(section(**{key: value}), key) == value
        for value in bad:
            with pytest.raises(ConfigError, match=key):
                section(**{key: value})

    def test_every_number_has_a_range(self) -> None:
        numbers = {(t, k) for t, k, v in settings() if type(v) in (int, float)}
        hints = {f.name: type(getattr(Config(), f.name)) for f in dataclasses.fields(Config)}
        tested = {(t, row[1]) for t, kind in hints.items() for row in RANGES if row[0] is kind}
        assert numbers == tested

    def test_a_part_that_stops_before_it_starts(self) -> None:
        assert VideoConfig(start_s=1.0, stop_s=1.5).stop_s == 1.5
        for stop_s in (1.0, 0.5, float("nan"), float("inf")):
            with pytest.raises(ConfigError, match="must stop after it starts"):
                VideoConfig(start_s=1.0, stop_s=stop_s)

    @pytest.mark.parametrize(
        "box", [(3, 2, 1, 4), (1, 4, 3, 2), (1, 2, 1, 4), (1, 2, float("nan"), 4)]
    )
    def test_a_box_inside_out(self, box: tuple[float, float, float, float]) -> None:
        with pytest.raises(ConfigError, match="left < right"):
            SubjectConfig(box=box)


def test_the_public_names_exist() -> None:
    assert all(hasattr(config_module, name) for name in config_module.__all__)


def test_every_section_says_what_its_settings_mean() -> None:
    for field in dataclasses.fields(Config):
        assert type(getattr(Config(), field.name)).__doc__


def test_defaults_survive_toml() -> None:
    text = "\n".join(
        f"[{table}]\n"
        + "\n".join(f"{k} = {json.dumps(v)}" for k, v in values.items() if v is not None)
        for table, values in Config().as_dict().items()
    )
    assert build_config(tomllib.loads(text)) == Config()
