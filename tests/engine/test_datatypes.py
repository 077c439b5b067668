"""The core types: checked, frozen, and the same after a pickle."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine import datatypes
from engine.datatypes import (
    ASSUMED_STATURE_M,
    Camera,
    Coupling,
    JointAngles,
    Measurement,
    PersonBox,
    PoseTrack,
    Provenance,
    Status,
    Subject,
    Task,
    Trial,
    View,
    parse_coupling,
)
from engine.errors import ConfigError, DataError, ShapeError, UnitError
from tests.builders import (
    make_angles,
    make_camera,
    make_end,
    make_flag,
    make_lift,
    make_pose_track,
    make_risk,
    make_scene,
    make_trial_result,
    make_view_pose,
)


def test_the_public_names_exist() -> None:
    assert all(hasattr(datatypes, name) for name in datatypes.__all__)


class TestSubject:
    def test_a_stated_stature_is_the_users(self) -> None:
        subject = Subject(stature_m=1.8)
        assert subject.stature == Measurement(1.8, 0.01)
        assert subject.provenance["stature_m"] is Provenance.USER
        assert subject.provenance["mass_kg"] is None

    def test_a_missing_stature_is_assumed_with_a_wide_error(self) -> None:
        stature = Subject().stature
        assert stature.value == ASSUMED_STATURE_M
        assert stature.sigma > 5 * Subject(stature_m=1.8).stature.sigma
        assert Subject().provenance["stature_m"] is Provenance.ASSUMED

    @pytest.mark.parametrize("stature_m", [1.0, 1.5, 2.3])
    def test_statures_of_people_are_taken(self, stature_m: float) -> None:
        assert Subject(stature_m=stature_m).stature_m == stature_m

    @pytest.mark.parametrize(
        ("stature_m", "hint"),
        [
            (175.0, "It looks like centimetres: did you mean 1.75 metres?"),
            (1750.0, "It looks like millimetres: did you mean 1.75 metres?"),
            (17.5, "did you mean 1.75 metres?"),
            (5.9, "It looks like feet: did you mean 1.80 metres?"),
            (0.0, "Give the stature in metres, for example 1.75."),
            (0.99, "Give the stature in metres"),
            (2.31, "Give the stature in metres"),
            (-1.75, "Give the stature in metres"),
            (math.nan, "Give the stature in metres"),
            (math.inf, "Give the stature in metres"),
        ],
    )
    def test_others_are_refused_with_what_to_do(self, stature_m: float, hint: str) -> None:
        with pytest.raises(ConfigError) as caught:
            Subject(stature_m=stature_m)
        assert "between 1 and 2.3 m" in str(caught.value)
        assert hint in str(caught.value)

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"mass_kg": 24.9}, "Body mass must lie between 25 and 300 kg, got 24.9."),
            ({"mass_kg": 301.0}, "Body mass"),
            ({"age_y": 9.0}, "Age must lie between 10 and 100 years, got 9."),
            ({"sex": "x"}, "Sex must be 'female' or 'male', or left out; got 'x'."),
        ],
    )
    def test_other_properties(self, changes: dict[str, Any], words: str) -> None:
        with pytest.raises(ConfigError, match=words):
            Subject(**changes)


class TestTask:
    @pytest.mark.parametrize("text", ["good", " Good ", "GOOD", Coupling.GOOD])
    def test_coupling_by_word(self, text: str) -> None:
        assert Task(coupling=text).coupling is Coupling.GOOD  # type: ignore[arg-type]

    @pytest.mark.parametrize("text", ["", "strong", "goo", None, 3])
    def test_unknown_couplings(self, text: Any) -> None:
        with pytest.raises(ConfigError, match="Coupling must be good, fair or poor"):
            parse_coupling(text)

    @pytest.mark.parametrize(
        ("name", "low", "high"),
        [
            ("load_kg", 0.0, 500.0),
            ("frequency_per_min", 0.0, 60.0),
            ("duration_h", 0.0, 24.0),
            ("recovery_h", 0.0, 24.0),
        ],
    )
    def test_both_sides_of_each_bound(self, name: str, low: float, high: float) -> None:
        for value in (low, high):
            assert getattr(Task(**{name: value}), name) == value
        for value in (low - 0.1, high + 0.1, math.nan, math.inf):
            with pytest.raises(ConfigError, match="must lie between"):
                Task(**{name: value})

    @pytest.mark.parametrize("hands", [0, 3, "2", 1.5])
    def test_hands(self, hands: Any) -> None:
        with pytest.raises(ConfigError, match="Hands must be 1 or 2"):
            Task(hands=hands)

    def test_nothing_said_stays_unknown(self) -> None:
        values = dataclasses.asdict(Task())
        assert values.pop("notes") == ""
        assert set(values.values()) == {None}


class TestTrial:
    @pytest.mark.parametrize("count", [0, 3])
    def test_one_or_two_views(self, count: int) -> None:
        with pytest.raises(ConfigError, match=f"one or two views, got {count}"):
            Trial(views=(View(Path("a.mp4")),) * count)

    def test_a_path_may_be_text(self) -> None:
        assert View("a.mp4").path == Path("a.mp4")  # type: ignore[arg-type]


class TestMeasurement:
    def test_missing(self) -> None:
        assert Measurement(math.nan).is_missing
        assert not Measurement(0.0).is_missing

    @given(st.floats(-1e6, 1e6), st.floats(0, 1e3))
    def test_the_interval_is_centred_and_1_96_wide(self, value: float, sigma: float) -> None:
        low, high = Measurement(value, sigma).interval()
        assert (low + high) / 2 == pytest.approx(value, abs=1e-6)
        assert high - low == pytest.approx(2 * 1.96 * sigma, abs=1e-6)


class TestPoseTrack:
    def test_defaults_follow_the_positions(self) -> None:
        position = np.zeros((2, 33, 3))
        position[1, 4, 2] = np.nan
        track = PoseTrack(
            time_s=[0.0, 0.1],  # type: ignore[arg-type]
            position=position,
            unit="m",
            frame_of_reference="world",
            skeleton="mediapipe_33",
        )
        assert track.n_frames == 2
        assert track.status[1, 4] == Status.MISSING
        assert (track.status == Status.MEASURED).sum() == 65
        assert np.isnan(track.sigma).all()
        assert np.isnan(track.confidence).all()
        assert not track.is_present[1, 4]
        assert track.is_present.sum() == 65

    def test_arrays_are_copied_and_frozen(self) -> None:
        position = np.zeros((1, 33, 3))
        track = dataclasses.replace(make_pose_track(n_frames=1), position=position)
        position[:] = 9.0
        assert track.position.max() == 0.0
        for name in ("time_s", "position", "confidence", "sigma", "status"):
            with pytest.raises(ValueError, match="read-only"):
                getattr(track, name)[0] = 1
        with pytest.raises(TypeError):
            track.provenance["x"] = 1  # type: ignore[index]
        with pytest.raises(dataclasses.FrozenInstanceError):
            track.unit = "px"  # type: ignore[misc]

    @pytest.mark.parametrize(
        ("changes", "error", "words"),
        [
            ({"position": np.zeros((4, 33))}, ShapeError, "position needs shape"),
            ({"position": np.zeros((4, 33, 4))}, ShapeError, "position needs shape"),
            ({"position": np.zeros((3, 33, 3))}, ShapeError, "3 frames, time_s has 4"),
            ({"time_s": np.zeros((4, 1))}, ShapeError, "one dimension"),
            ({"time_s": np.array([0.0, 0.1, 0.1, 0.2])}, DataError, "must increase"),
            ({"time_s": np.array([0.0, np.nan, 0.1, 0.2])}, DataError, "must increase"),
            ({"sigma": np.zeros((4, 32))}, ShapeError, r"sigma needs shape \(4, 33\)"),
            ({"confidence": np.zeros(4)}, ShapeError, "confidence needs shape"),
            ({"status": np.zeros((33, 4))}, ShapeError, "status needs shape"),
            ({"unit": "px"}, UnitError, "px does not go with the world frame"),
            ({"frame_of_reference": "image"}, UnitError, "m does not go with the image"),
        ],
    )
    def test_what_does_not_fit(
        self, changes: dict[str, Any], error: type[Exception], words: str
    ) -> None:
        with pytest.raises(error, match=words):
            dataclasses.replace(make_pose_track(n_frames=4), **changes)


class TestJointAngles:
    def test_curves_by_name(self) -> None:
        angles = make_angles()
        np.testing.assert_array_equal(angles["trunk_flexion"], angles.value_deg[:, 1])
        assert angles.sigma("trunk_flexion")[0] == 4.0
        with pytest.raises(DataError, match="no angle 'hip'"):
            angles["hip"]

    def test_defaults_follow_the_values(self) -> None:
        angles = JointAngles(
            time_s=np.array([0.0, 1.0]), value_deg=np.array([[1.0], [np.nan]]), names=("a",)
        )
        assert angles.status.tolist() == [[Status.MEASURED], [Status.MISSING]]
        assert np.isnan(angles.sigma_deg).all()

    @pytest.mark.parametrize("name", ["value_deg", "sigma_deg", "status"])
    def test_shapes(self, name: str) -> None:
        with pytest.raises(ShapeError, match=name):
            dataclasses.replace(make_angles(n_frames=3), **{name: np.zeros((3, 2))})


class TestCamera:
    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"matrix": np.eye(2)}, "Camera matrix"),
            ({"rotation": np.eye(4)}, "Camera rotation"),
            ({"translation": np.zeros(2)}, "Camera translation"),
            ({"distortion": np.zeros(4)}, "Distortion"),
        ],
    )
    def test_shapes(self, changes: dict[str, Any], words: str) -> None:
        with pytest.raises(ShapeError, match=words):
            dataclasses.replace(make_camera(), **changes)

    def test_a_rotation_must_be_one(self) -> None:
        with pytest.raises(DataError, match="not a rotation matrix"):
            Camera("a", (10, 10), np.eye(3), rotation=2 * np.eye(3))


def test_views_need_a_box_and_a_state_per_frame() -> None:
    view = make_view_pose(n_frames=3)
    with pytest.raises(ShapeError, match="box"):
        dataclasses.replace(view, box=np.zeros((2, 4)))
    with pytest.raises(ShapeError, match="state needs 3 entries, got 1"):
        dataclasses.replace(view, state=view.state[:1])


def test_a_box_has_a_size() -> None:
    assert PersonBox(10.0, 20.0, 40.0, 80.0).size_px == (30.0, 60.0)


def test_a_lift_has_a_duration() -> None:
    assert make_lift(1.0, 2.5).duration_s == 1.5


@pytest.mark.parametrize("turn", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy])
@pytest.mark.parametrize(
    "value",
    [
        make_pose_track(n_frames=3),
        make_angles(n_frames=3),
        make_camera(),
        make_view_pose(n_frames=3),
        make_trial_result(n_frames=3),
        make_scene(),
        make_risk(),
        make_flag(),
        make_end(),
        Subject(stature_m=1.8),
        Task(coupling=Coupling.FAIR),
    ],
    ids=lambda value: type(value).__name__,
)
def test_values_survive_a_copy_still_frozen(value: Any, turn: Any) -> None:
    again = turn(value)
    assert type(again) is type(value)
    for field in dataclasses.fields(value):
        left, right = getattr(value, field.name), getattr(again, field.name)
        assert type(left) is type(right)
        if isinstance(left, np.ndarray):
            np.testing.assert_array_equal(left, right)
            assert not right.flags.writeable
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(again, dataclasses.fields(again)[0].name, None)
