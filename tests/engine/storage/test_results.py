"""Result folders: whole or not there, exact when read back, and honest about damage."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from engine.datatypes import (
    Calibration,
    CalibrationCheck,
    Flag,
    Lift,
    LiftEnd,
    Measurement,
    RiskInput,
    RiskResult,
    Status,
    Subject,
    SyncEstimate,
    Task,
    ViewInfo,
    WorldScene,
)
from engine.errors import ConfigError, DataError, OutputError, UnitError
from engine.storage import results as results_module
from engine.storage.document import (
    SCENE_NUMBERS,
    SCHEMA_PATH,
    decode_number,
    decode_plain,
    encode_plain,
    to_json,
)
from engine.storage.results import RESULT_FILES, check_target, read_result, write_result
from engine.storage.tables import write_keypoints_trc
from tests.builders import (
    make_angles,
    make_body_fit,
    make_calibration,
    make_flag,
    make_lift,
    make_pose_track,
    make_risk,
    make_scene,
    make_trial,
    make_trial_result,
    make_two_views,
    make_view_pose,
)

SCHEMA = json.loads(SCHEMA_PATH.read_text(encoding="utf-8"))
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
RESULTS = {
    "one lift": {},
    "no lift": {"lis": ()},
    "infinite index": {"lis": (math.inf, 1.2)},
    "not applicable": {"lis": (math.nan,)},
    "one frame": {"n_frames": 1},
    "assumed stature": {"trial": make_trial(subject=Subject(), task=Task())},
    "two views": make_two_views(),
    "two views of unknown floor": make_two_views(
        calibration=make_calibration(up=(math.nan,) * 3, floor_m=math.nan), checks=()
    ),
    "no uncertainty": {"scene": make_scene(scale_sigma=math.nan), "warnings": ()},
    "no angles": {"angles": make_angles(names=())},
    "body model": {"body": make_body_fit(missing=[0, 3])},
    "body model never fitted": {"body": make_body_fit(missing=range(30))},
}


def read_json(folder: Path) -> dict[str, Any]:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    return json.loads((folder / "trial.json").read_text("utf-8"), parse_constant=refuse)


def assert_same_track(left: Any, right: Any) -> None:
    for name in ("time_s", "position", "confidence", "sigma", "status"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name), strict=True)
    for name in ("unit", "frame_of_reference", "skeleton"):
        assert getattr(left, name) == getattr(right, name)
    assert dict(left.provenance) == dict(right.provenance)


def snapshot(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


class TestSchema:
    def test_it_is_a_valid_schema(self) -> None:
        jsonschema.Draft202012Validator.check_schema(SCHEMA)

    @pytest.mark.parametrize("changes", RESULTS.values(), ids=RESULTS.keys())
    def test_results_fit_it(self, tmp_path: Path, changes: dict[str, Any]) -> None:
        folder = write_result(make_trial_result(**changes), tmp_path / "result")
        VALIDATOR.validate(read_json(folder))

    @pytest.mark.parametrize("key", SCHEMA["required"])
    def test_every_key_is_required(self, tmp_path: Path, key: str) -> None:
        document = read_json(write_result(make_trial_result(), tmp_path / "result"))
        del document[key]
        assert not VALIDATOR.is_valid(document)

    @pytest.mark.parametrize(
        ("part", "kind", "own"),
        [
            ("view", ViewInfo, set()),
            ("scene", WorldScene, set()),
            ("lift", Lift, set()),
            ("end", LiftEnd, set()),
            ("measurement", Measurement, set()),
            ("risk", RiskResult, {"is_infinite", "interval_is_infinite"}),
            ("input", RiskInput, {"is_infinite"}),
            ("flag", Flag, set()),
            ("calibration", Calibration, set()),
            ("check", CalibrationCheck, set()),
            ("sync", SyncEstimate, set()),
            ("subject", Subject, {"provenance", "stature_sigma_m"}),
            ("task", Task, {"provenance"}),
        ],
    )
    def test_no_field_of_a_type_is_forgotten(
        self, part: str, kind: type[Any], own: set[str]
    ) -> None:
        fields = {field.name for field in dataclasses.fields(kind)}
        assert set(SCHEMA["$defs"][part]["required"]) == fields | own

    def test_it_has_the_keys_of_the_contract(self) -> None:
        contract = "schema_version liftlens_version views subject task config backend solver"
        contract += " timings_s coverage lifts risk flags warnings"
        assert set(contract.split()) <= set(SCHEMA["required"])
        assert {"file_name", "sha256", "fps", "n_frames", "size_px"} <= set(
            SCHEMA["$defs"]["view"]["required"]
        )

    @pytest.mark.parametrize(
        ("path", "value"),
        [
            (("lifts", 0, "origin", "H_cm", "value"), "45"),
            (("lifts", 0, "D_cm", "sigma"), -1.0),
            (("lifts", 0, "hands"), 3),
            (("flags", 0, "level"), "fine"),
            (("views", 0, "size_px"), [1280]),
            (("risk", "rnle", "value"), "high"),
            (("subject", "name"), "Jane"),
            (("coverage", "measured"), 1.5),
            (("body",), {"residual_cm": {"median": 2.0, "p95": 3.0}}),
            (("schema_version",), 2),
        ],
        ids=lambda v: ".".join(map(str, v)) if isinstance(v, tuple) else None,
    )
    def test_it_refuses_what_is_wrong(
        self, tmp_path: Path, path: tuple[Any, ...], value: Any
    ) -> None:
        document = read_json(write_result(make_trial_result(), tmp_path / "result"))
        part = document
        for key in path[:-1]:
            part = part[key]
        part[path[-1]] = value
        assert not VALIDATOR.is_valid(document)


class TestDocument:
    def test_values_stand_where_the_contract_says(self, tmp_path: Path) -> None:
        document = read_json(write_result(make_trial_result(), tmp_path / "result"))
        assert document["views"][0]["file_name"] == "lift.mp4"
        assert document["lifts"][0]["origin"]["V_cm"] == {"value": 35.0, "sigma": 3.0}
        assert document["lifts"][0]["D_cm"]["value"] == 55.0
        assert document["risk"]["rnle"]["per_lift"][0]["value"] == 1.4
        assert document["task"]["coupling"] == "fair"
        assert document["task"]["provenance"]["hands"] is None
        assert (document["label"], document["site"], document["job"]) == (
            "Crate to shelf",
            "Hall 3",
            "Packing",
        )

    def test_an_assumed_stature_says_so(self, tmp_path: Path) -> None:
        result = make_trial_result(trial=make_trial(subject=Subject()))
        folder = write_result(result, tmp_path / "result")
        subject = read_json(folder)["subject"]
        assert (subject["stature_m"], subject["stature_sigma_m"]) == (1.70, 0.10)
        assert subject["provenance"]["stature_m"] == "assumed"
        assert read_result(folder).subject.stature_m is None

    def test_no_folder_of_the_user_is_written(self, tmp_path: Path) -> None:
        folder = write_result(make_trial_result(), tmp_path / "secret_place")
        assert "secret_place" not in (folder / "trial.json").read_text("utf-8")

    def test_infinity_is_null_with_its_reason(self, tmp_path: Path) -> None:
        folder = write_result(make_trial_result(lis=(math.inf,)), tmp_path / "result")
        risk = read_json(folder)["risk"]["rnle"]
        assert (risk["value"], risk["is_infinite"]) == (None, True)
        assert (risk["interval"], risk["interval_is_infinite"]) == ([None, None], [True, True])
        assert read_result(folder).risk["rnle"].value == math.inf

    def test_a_file_name_that_is_no_text_survives(self, tmp_path: Path) -> None:
        name = b"lift\xff.mp4".decode("utf-8", "surrogateescape")
        result = make_trial_result(views=(make_view_pose(file_name=name),))
        assert (
            read_result(write_result(result, tmp_path / "result")).views[0].info.file_name == name
        )

    @given(st.floats())
    def test_every_float_becomes_json_and_back(self, value: float) -> None:
        text = to_json({"value": encode_plain(value)})
        assert "NaN" not in text
        assert "Infinity" not in text
        back = decode_plain(json.loads(text))["value"]
        assert back == value or (back is None and math.isnan(value))

    @given(st.floats())
    def test_a_headline_value_survives(self, value: float) -> None:
        document = json.loads(
            to_json(results_module.build_document(make_trial_result(n_frames=1, lis=(value,))))
        )
        VALIDATOR.validate(document)
        part = document["risk"]["rnle"]["per_lift"][0]
        back = decode_number(part["value"], is_infinite=part["is_infinite"])
        expected = math.nan if value == -math.inf else value
        assert back == expected or (math.isnan(back) and math.isnan(expected))

    @given(
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
            lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
            max_leaves=10,
        )
    )
    def test_free_form_values_are_strict_json(self, value: Any) -> None:
        encoded = encode_plain({"details": value})
        assert json.loads(to_json(encoded)) == encoded
        assert encode_plain(decode_plain(encoded)) == encoded

    def test_numpy_and_enum_values_become_plain(self) -> None:
        values = {
            Status.FILLED: np.float32(0.5),
            "array": np.array([[1.0, np.nan]]),
            "path": Path("a/b"),
            "flag": np.bool_(True),
            "lift": make_lift().D_cm,
            "set": {3},
        }
        assert encode_plain(values) == {
            "4": 0.5,
            "array": [[1.0, None]],
            "path": str(Path("a/b")),
            "flag": True,
            "lift": {"value": 55.0, "sigma": pytest.approx(math.hypot(3, 3))},
            "set": [3],
        }


class TestRoundTrip:
    def test_a_body_model_comes_back(self, tmp_path: Path) -> None:
        body = make_body_fit(missing=[0, 3])
        folder = write_result(make_trial_result(body=body), tmp_path / "result")
        stored = read_result(folder).body
        assert_same_track(stored.joints, body.joints)
        np.testing.assert_array_equal(stored.residual_m, body.residual_m)
        assert stored.segment_lengths_m == body.segment_lengths_m
        written = read_json(folder)["body"]
        assert written["residual_cm"] == {"median": pytest.approx(2.0), "p95": pytest.approx(2.0)}
        assert written["fitted"] == pytest.approx(28 / 30)

    @pytest.mark.parametrize("changes", RESULTS.values(), ids=RESULTS.keys())
    def test_everything_comes_back(self, tmp_path: Path, changes: dict[str, Any]) -> None:
        result = make_trial_result(**changes)
        stored = read_result(write_result(result, tmp_path / "result"))
        assert_same_track(stored.raw, result.raw)
        assert_same_track(stored.corrected, result.corrected)
        assert len(stored.views) == len(result.views)
        for left, right in zip(stored.views, result.views, strict=True):
            assert_same_track(left.image, right.image)
            assert (left.body is None) == (right.body is None)
            if right.body is not None:
                assert_same_track(left.body, right.body)
            np.testing.assert_array_equal(left.box, right.box)
            assert (left.state, left.info) == (right.state, right.info)
            assert [len(o) for o in left.others] == [len(o) for o in right.others]
        for name in ("time_s", "value_deg", "sigma_deg", "status"):
            np.testing.assert_array_equal(
                getattr(stored.angles, name), getattr(result.angles, name), strict=True
            )
        assert stored.angles.names == result.angles.names
        assert repr(stored.lifts) == repr(result.lifts)
        assert repr(stored.risk) == repr(dict(result.risk))
        assert stored.flags == result.flags
        assert stored.warnings == result.warnings
        assert stored.subject == result.trial.subject
        assert stored.task == result.trial.task
        np.testing.assert_array_equal(stored.scene.camera.matrix, result.scene.camera.matrix)
        for name in SCENE_NUMBERS:
            assert repr(getattr(stored.scene, name)) == repr(getattr(result.scene, name))
        assert repr(stored.checks) == repr(result.checks)
        assert stored.sync == result.sync
        assert repr(stored.calibration) == repr(result.calibration)

    def test_both_annotated_videos_and_the_cameras_come_along(self, tmp_path: Path) -> None:
        for name in ("first.mp4", "second.mp4"):
            (tmp_path / name).write_bytes(name.encode())
        folder = write_result(
            make_trial_result(**make_two_views()),
            tmp_path / "result",
            overlay=tmp_path / "first.mp4",
            second_overlay=tmp_path / "second.mp4",
            calibration_text="up = [0, 1, 0]\n",
        )
        stored = read_result(folder)
        assert stored.overlay_path
        assert stored.overlay_path.read_bytes() == b"first.mp4"
        assert stored.second_overlay_path
        assert stored.second_overlay_path.read_bytes() == b"second.mp4"
        assert (folder / "calibration.toml").read_text() == "up = [0, 1, 0]\n"

    def test_a_result_from_before_two_views_were_possible_is_still_read(
        self, tmp_path: Path
    ) -> None:
        folder = write_result(make_trial_result(), tmp_path / "result")
        document = read_json(folder)
        del document["two_view"]
        (folder / "trial.json").write_text(json.dumps(document))
        stored = read_result(folder)
        assert (stored.calibration, stored.checks, stored.sync) == (None, (), None)

    @settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
    @given(data=st.data(), n_frames=st.integers(1, 4))
    def test_any_position_and_error_comes_back_exactly(
        self, tmp_path: Path, data: st.DataObject, n_frames: int
    ) -> None:
        floats = st.floats(-1e6, 1e6) | st.just(math.nan)
        track = dataclasses.replace(
            make_pose_track(n_frames=n_frames, skeleton="h36m_17"),
            position=data.draw(hnp.arrays(np.float64, (n_frames, 17, 3), elements=floats)),
            sigma=data.draw(hnp.arrays(np.float64, (n_frames, 17), elements=floats)),
            status=data.draw(hnp.arrays(np.uint8, (n_frames, 17), elements=st.integers(0, 5))),
        )
        stored = read_result(
            write_result(make_trial_result(raw=track, corrected=track), tmp_path / "result")
        )
        assert_same_track(stored.raw, track)
        assert_same_track(stored.corrected, track)

    @given(
        start=st.floats(0, 1e4),
        nan_or_number=st.floats(allow_infinity=False),
        text=st.text(),
        hands=st.sampled_from([1, 2]),
    )
    def test_any_lift_and_flag_comes_back(
        self, start: float, nan_or_number: float, text: str, hands: int
    ) -> None:
        lift = make_lift(start, start + 1, hands=hands, notes=(text,), return_end_s=nan_or_number)
        flag = make_flag(why=text, start_s=nan_or_number)
        result = make_trial_result(n_frames=1, lifts=(lift,), flags=(flag,))
        document = json.loads(to_json(results_module.build_document(result)))
        assert repr(results_module.decode_lift(document["lifts"][0])) == repr(lift)
        assert repr(results_module.decode_flag(document["flags"][0])) == repr(flag)

    def test_arrays_read_back_are_read_only(self, tmp_path: Path) -> None:
        stored = read_result(write_result(make_trial_result(), tmp_path / "result"))
        with pytest.raises(ValueError, match="read-only"):
            stored.raw.position[0] = 0


class TestTables:
    def read_trc(self, path: Path) -> tuple[dict[str, str], list[str], np.ndarray]:
        lines = path.read_text("utf-8").splitlines()
        header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
        names = [name for name in lines[3].split("\t")[2:] if name]
        assert lines[5] == ""
        rows = [[float(cell) for cell in line.split("\t")] for line in lines[6:]]
        return header, names, np.array(rows)

    def test_trc_has_the_world_keypoints_in_mm(self, tmp_path: Path) -> None:
        result = make_trial_result()
        folder = write_result(result, tmp_path / "result")
        header, names, rows = self.read_trc(folder / "keypoints.trc")
        assert header["Units"] == "mm"
        assert float(header["DataRate"]) == pytest.approx(30.0)
        assert (int(header["NumFrames"]), int(header["NumMarkers"])) == (30, 33)
        np.testing.assert_array_equal(rows[:, 0], np.arange(1, 31))
        np.testing.assert_allclose(rows[:, 1], result.corrected.time_s, atol=1e-6)
        heel = names.index("left_heel")
        np.testing.assert_allclose(
            rows[:, 2 + 3 * heel : 5 + 3 * heel], 1000 * result.corrected.position[:, 29], atol=1e-3
        )
        assert names[29] == "left_heel"

    def test_trc_has_as_many_axis_labels_as_columns(self, tmp_path: Path) -> None:
        folder = write_result(make_trial_result(), tmp_path / "result")
        lines = (folder / "keypoints.trc").read_text("utf-8").splitlines()
        assert len(lines[3].split("\t")) == len(lines[4].split("\t")) == 2 + 33 * 3
        assert lines[4].split("\t")[2:5] == ["X1", "Y1", "Z1"]

    def test_trc_keeps_true_times_of_a_variable_rate(self, tmp_path: Path) -> None:
        times = np.array([0.0, 0.03, 0.1, 0.11])
        write_keypoints_trc(make_pose_track(time_s=times), tmp_path / "k.trc")
        header, _, rows = self.read_trc(tmp_path / "k.trc")
        np.testing.assert_allclose(rows[:, 1], times)
        assert float(header["DataRate"]) == pytest.approx(3 / 0.11, rel=1e-5)

    def test_trc_says_where_a_sample_is_missing(self, tmp_path: Path) -> None:
        write_keypoints_trc(make_pose_track(missing=[(2, "nose")]), tmp_path / "k.trc")
        _, _, rows = self.read_trc(tmp_path / "k.trc")
        assert np.isnan(rows[2, 2:5]).all()
        assert np.isfinite(np.delete(rows, [2, 3, 4], axis=1)).all()

    @pytest.mark.parametrize("frame", ["image", "body", "camera"])
    def test_trc_refuses_other_frames(self, tmp_path: Path, frame: str) -> None:
        with pytest.raises(UnitError, match="world"):
            write_keypoints_trc(make_pose_track(frame_of_reference=frame), tmp_path / "k.trc")

    def test_mot_is_an_opensim_table_in_degrees(self, tmp_path: Path) -> None:
        result = make_trial_result()
        lines = (write_result(result, tmp_path / "result") / "angles.mot").read_text().splitlines()
        end = lines.index("endheader")
        assert "inDegrees=yes" in lines[:end]
        assert f"nRows={result.angles.time_s.size}" in lines[:end]
        columns = lines[end + 1].split("\t")
        assert columns == ["time", *result.angles.names]
        assert f"nColumns={len(columns)}" in lines[:end]
        rows = np.array([[float(c) for c in line.split("\t")] for line in lines[end + 2 :]])
        np.testing.assert_allclose(rows[:, 1:], result.angles.value_deg, atol=1e-5)

    def test_csv_has_value_and_error_of_every_angle(self, tmp_path: Path) -> None:
        result = make_trial_result()
        table = pd.read_csv(write_result(result, tmp_path / "result") / "angles.csv")
        names = result.angles.names
        assert list(table) == [
            "time_s",
            *(f"{n}{end}" for n in names for end in ("_deg", "_sigma_deg")),
        ]
        np.testing.assert_allclose(
            table[[f"{n}_deg" for n in names]], result.angles.value_deg, atol=1e-5
        )
        np.testing.assert_allclose(
            table[[f"{n}_sigma_deg" for n in names]], result.angles.sigma_deg, atol=1e-5
        )


class TestWriting:
    def test_a_folder_has_the_files_of_the_contract(self, tmp_path: Path) -> None:
        overlay, thumbnail = tmp_path / "o.mp4", tmp_path / "t.JPG"
        overlay.write_bytes(b"video")
        thumbnail.write_bytes(b"picture")
        folder = write_result(
            make_trial_result(), tmp_path / "new" / "result", overlay=overlay, thumbnail=thumbnail
        )
        assert {p.name for p in folder.iterdir()} == {
            "trial.json",
            "tracks.npz",
            "keypoints.trc",
            "angles.mot",
            "angles.csv",
            "overlay.mp4",
            "thumbnail.jpg",
        }
        assert {p.name for p in folder.iterdir()} <= set(RESULT_FILES)
        assert not overlay.exists()
        stored = read_result(folder)
        assert stored.overlay_path == folder / "overlay.mp4"
        assert stored.thumbnail_path == folder / "thumbnail.jpg"

    def test_without_pictures_the_paths_are_none(self, tmp_path: Path) -> None:
        stored = read_result(write_result(make_trial_result(), tmp_path / "result"))
        assert stored.overlay_path is None
        assert stored.thumbnail_path is None

    def test_an_earlier_result_is_replaced_whole(self, tmp_path: Path) -> None:
        overlay = tmp_path / "o.mp4"
        overlay.write_bytes(b"video")
        folder = write_result(make_trial_result(), tmp_path / "result", overlay=overlay)
        write_result(make_trial_result(lis=(2.5,)), folder)
        assert read_result(folder).risk["rnle"].value == 2.5
        assert read_result(folder).overlay_path is None
        assert [p.name for p in tmp_path.iterdir()] == ["result"]

    def test_an_empty_folder_is_filled(self, tmp_path: Path) -> None:
        (tmp_path / "result").mkdir()
        read_result(write_result(make_trial_result(), tmp_path / "result"))

    @pytest.mark.parametrize("stranger", ["notes.txt", "thesis.docx"])
    def test_a_folder_with_other_files_is_refused(self, tmp_path: Path, stranger: str) -> None:
        folder = write_result(make_trial_result(), tmp_path / "result")
        (folder / stranger).write_text("mine")
        before = snapshot(folder)
        with pytest.raises(ConfigError, match=stranger):
            write_result(make_trial_result(), folder)
        assert snapshot(folder) == before

    def test_a_folder_that_is_no_result_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "overlay.mp4").write_text("mine")
        with pytest.raises(ConfigError, match="no LiftLens result"):
            write_result(make_trial_result(), tmp_path)

    def test_a_file_in_the_way_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "result").write_text("mine")
        with pytest.raises(ConfigError, match="is a file"):
            write_result(make_trial_result(), tmp_path / "result")

    def test_a_file_among_the_parents_is_explained(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("mine")
        with pytest.raises(OutputError, match="a part of its path is a file"):
            write_result(make_trial_result(), tmp_path / "file" / "result")

    @pytest.mark.parametrize(
        ("number", "words"),
        [
            (errno.ENOSPC, "the disk is full; free some space"),
            (errno.EACCES, "you may not write there"),
            (errno.EROFS, "the disk is read-only"),
            (errno.EIO, "choose another folder"),
        ],
    )
    @pytest.mark.parametrize("step", ["write_tracks", "write_angles_csv", "_replace"])
    def test_a_failure_leaves_nothing_behind(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, number: int, words: str
    ) -> None:
        def fail(*_: Any, **__: Any) -> None:
            raise OSError(number, "said the system")

        monkeypatch.setattr(results_module, step, fail)
        with pytest.raises(OutputError, match=words):
            write_result(make_trial_result(), tmp_path / "new" / "result")
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
    def test_an_interruption_keeps_the_earlier_result(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
    ) -> None:
        folder = write_result(make_trial_result(), tmp_path / "result")
        before = snapshot(folder)

        def fail(*_: Any, **__: Any) -> None:
            raise error

        monkeypatch.setattr(results_module, "build_document", fail)
        with pytest.raises(error):
            write_result(make_trial_result(lis=(9.0,)), folder)
        assert snapshot(folder) == before
        assert [p.name for p in tmp_path.iterdir()] == ["result"]

    def test_a_failing_last_rename_restores_the_earlier_result(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        folder = write_result(make_trial_result(), tmp_path / "result")
        before = snapshot(folder)
        rename = Path.rename
        calls: list[Path] = []

        def fail_second(self: Path, target: Path) -> Path:
            calls.append(self)
            if len(calls) == 2:
                raise PermissionError(errno.EACCES, "denied")
            return rename(self, target)

        monkeypatch.setattr(Path, "rename", fail_second)
        with pytest.raises(OutputError):
            write_result(make_trial_result(lis=(9.0,)), folder)
        assert snapshot(folder) == before
        assert [p.name for p in tmp_path.iterdir()] == ["result"]

    @pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX file size limits")
    def test_a_disk_that_really_runs_out_is_one_sentence(self, tmp_path: Path) -> None:
        script = (
            "import resource, sys\n"
            "from pathlib import Path\n"
            "from engine.errors import OutputError\n"
            "from engine.storage.results import write_result\n"
            "from tests.builders import make_trial_result\n"
            "result = make_trial_result()\n"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
            "try:\n"
            "    write_result(result, Path(sys.argv[1]))\n"
            "except OutputError as error:\n"
            "    print(error)\n"
        )
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", script, str(tmp_path / "result")],
            capture_output=True,
            text=True,
            check=False,
            cwd=Path(__file__).parents[3],
        )
        assert "larger than allowed" in done.stdout, done.stderr
        assert done.returncode == 0
        assert list(tmp_path.iterdir()) == []

    def test_check_target_refuses_a_place_without_permission(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(results_module.os, "access", lambda *_: False)
        with pytest.raises(OutputError, match="you may not write there"):
            check_target(tmp_path / "result")

    def test_check_target_says_yes_without_making_anything(self, tmp_path: Path) -> None:
        assert check_target(tmp_path / "x" / "y") == tmp_path.resolve() / "x" / "y"
        assert list(tmp_path.iterdir()) == []


class TestDamage:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        return write_result(make_trial_result(n_frames=4), tmp_path / "result")

    @pytest.mark.parametrize("name", ["trial.json", "tracks.npz"])
    def test_a_missing_file(self, folder: Path, name: str) -> None:
        (folder / name).unlink()
        with pytest.raises(DataError):
            read_result(folder)

    def test_a_folder_that_is_no_result(self, tmp_path: Path) -> None:
        with pytest.raises(DataError, match="no LiftLens result"):
            read_result(tmp_path / "nothing")

    @pytest.mark.parametrize("version", [2, 0, "1", None])
    def test_an_unknown_version(self, folder: Path, version: Any) -> None:
        document = read_json(folder)
        document["schema_version"] = version
        (folder / "trial.json").write_text(json.dumps(document))
        with pytest.raises(DataError, match="schema version"):
            read_result(folder)

    @pytest.mark.parametrize(
        "text", ["", "{", "[]", "null", "{}", '{"schema_version": 1}', "\x00", "[" * 100_000]
    )
    def test_text_that_is_no_document(self, folder: Path, text: str) -> None:
        (folder / "trial.json").write_text(text)
        with pytest.raises(DataError):
            read_result(folder)

    @pytest.mark.parametrize("key", ["lifts", "risk", "flags", "scene", "task", "views"])
    def test_parts_of_the_wrong_kind(self, folder: Path, key: str) -> None:
        document = read_json(folder)
        document[key] = [{"nonsense": 1}]
        (folder / "trial.json").write_text(json.dumps(document))
        with pytest.raises(DataError, match="damaged"):
            read_result(folder)

    def test_a_number_too_large_for_a_float(self, folder: Path) -> None:
        document = read_json(folder)
        document["lifts"][0]["start_s"] = 10**400
        (folder / "trial.json").write_text(json.dumps(document))
        with pytest.raises(DataError, match="damaged"):
            read_result(folder)

    @settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
    @given(data=st.data())
    def test_changed_bytes_never_raise_anything_else(
        self, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
    ) -> None:
        folder = tmp_path_factory.mktemp("fuzz") / "result"
        write_result(make_trial_result(n_frames=2), folder)
        path = folder / data.draw(st.sampled_from(["trial.json", "tracks.npz"]))
        content = bytearray(path.read_bytes())
        if data.draw(st.booleans()):
            content = content[: data.draw(st.integers(0, len(content) - 1))]
        else:
            for place in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1)):
                content[place] = data.draw(st.integers(0, 255))
        path.write_bytes(content)
        # A change may go unseen (a label, a digit); anything but a DataError fails the test.
        with contextlib.suppress(DataError):
            assert read_result(folder).folder == folder

    def test_no_pickle_is_ever_loaded(self, folder: Path) -> None:
        with np.load(folder / "tracks.npz", allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        arrays["raw_time_s"] = np.array([print], dtype=object)
        np.savez(folder / "tracks.npz", **arrays)
        with pytest.raises(DataError):
            read_result(folder)


def test_a_risk_result_decodes_to_what_it_was() -> None:
    risk = make_risk(1.4, per_lift=(make_risk(math.inf, lift_index=0),))
    result = make_trial_result(n_frames=1, risk={"rnle": risk})
    document = json.loads(to_json(results_module.build_document(result)))
    assert results_module.decode_risk(document["risk"]["rnle"]).per_lift[0].value == math.inf
