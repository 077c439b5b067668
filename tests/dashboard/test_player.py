"""What the player is given and what it sends back; how it moves is tested in a browser."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from dashboard import cache, labels
from dashboard.components.player import FRONTEND, PlayerEvent, read_event
from dashboard.components.player.payload import (
    DOUBTFUL,
    FILLED,
    FRUSTUM_M,
    SEEN,
    build_payload,
    describe_flags,
    order_flags,
)
from engine.datatypes import FlagLevel, Status
from engine.optics import project
from engine.skeletons import H36M_17, MEDIAPIPE_33
from engine.storage.curation import flag_key
from engine.storage.results import read_result, write_result
from tests.builders import make_flag, make_pose_track, make_two_views
from tests.dashboard.results import make_shown_result


def stored(library, made):
    return read_result(write_result(made, library.folder("shown")))


@pytest.fixture
def shown(library):
    return stored(library, make_shown_result())


def floats(payload, name, *shape):
    return np.frombuffer(payload.arrays[name], "<f4").reshape(shape)


def test_samples_arrive_as_they_are(shown):
    payload = build_payload(shown)
    names, n_frames = payload.meta["points"], payload.meta["n_frames"]
    points = floats(payload, "points", n_frames, len(names), 3)
    for name in ("left_wrist", "right_knee"):
        truth = shown.corrected.position[:, MEDIAPIPE_33.index(name)]
        np.testing.assert_allclose(points[:, names.index(name)], truth, atol=1e-6)
    np.testing.assert_allclose(floats(payload, "time", n_frames), shown.corrected.time_s, atol=1e-6)
    columns = [curve for group in payload.meta["groups"] for curve in group["curves"]]
    assert [c["column"] for c in columns] == list(range(len(columns)))
    values = floats(payload, "values", n_frames, len(columns))
    halves = floats(payload, "halves", n_frames, len(columns))
    at = next(c["column"] for c in columns if c["label"] == labels.name_angle("knee_flexion_r"))
    np.testing.assert_allclose(values[:, at], shown.angles["knee_flexion_r"], atol=1e-4)
    np.testing.assert_allclose(
        halves[:, at], 1.96 * shown.angles.sigma("knee_flexion_r"), atol=1e-4
    )


def test_gaps_stay_gaps(shown):
    payload = build_payload(shown)
    names, n_frames = payload.meta["points"], payload.meta["n_frames"]
    states = np.frombuffer(payload.arrays["states"], np.uint8).reshape(n_frames, -1)
    wrist = names.index("left_wrist")
    assert states[0, wrist] == 0, "the builder leaves out the left wrist of the first frame"
    assert np.isnan(floats(payload, "points", n_frames, len(names), 3)[0, wrist]).all()
    assert (states[1:, wrist] == SEEN).all()
    values = floats(payload, "values", n_frames, -1)
    assert np.isnan(values[70:88]).all()
    marks = np.frombuffer(payload.arrays["marks"], np.uint8).reshape(n_frames, -1)
    assert marks[120:128].all()
    assert marks.sum() == 8 * marks.shape[1]


def test_doubtful_and_filled_joints_are_told_apart(library):
    track = make_pose_track(n_frames=180)
    confidence, status = track.confidence.copy(), track.status.copy()
    confidence[5, MEDIAPIPE_33.index("right_knee")] = 0.3
    status[9, MEDIAPIPE_33.index("left_hip")] = Status.FILLED
    track = replace(track, confidence=confidence, status=status)
    payload = build_payload(stored(library, replace(make_shown_result(), corrected=track)))
    names = payload.meta["points"]
    states = np.frombuffer(payload.arrays["states"], np.uint8).reshape(180, -1)
    assert states[5, names.index("right_knee")] == DOUBTFUL
    assert states[9, names.index("left_hip")] == FILLED
    assert states[9, names.index("pelvis")] == FILLED, "as unsure as the worst of its parts"
    assert states[9, names.index("thorax")] == SEEN


@pytest.mark.parametrize("skeleton", [MEDIAPIPE_33.name, H36M_17.name])
def test_bones_join_points_of_one_side(library, skeleton):
    track = make_pose_track(n_frames=180, skeleton=skeleton)
    payload = build_payload(
        stored(library, replace(make_shown_result(), raw=track, corrected=track))
    )
    names = payload.meta["points"]
    for a, b, side in payload.meta["bones"]:
        ends = {names[a].partition("_")[0], names[b].partition("_")[0]}
        assert (side in ("left", "right")) == (ends in ({"left"}, {"right"}))
        assert side == "middle" or ends == {side}
    assert len({frozenset(bone[:2]) for bone in payload.meta["bones"]}) == len(
        payload.meta["bones"]
    )


def test_cameras_stand_where_they_were_calibrated(library):
    both = stored(library, replace(make_shown_result(), **make_two_views()))
    pyramids = build_payload(both).meta["cameras"]
    assert len(pyramids) == 2
    for camera, pyramid in zip(both.calibration.cameras, pyramids, strict=True):
        width, height = camera.size_px
        corners = np.array(pyramid["corners"])
        np.testing.assert_allclose(
            project(camera, corners),
            [[0, 0], [width, 0], [width, height], [0, height]],
            atol=1e-6,
        )
        depth = (corners @ camera.rotation.T + camera.translation)[:, 2]
        np.testing.assert_allclose(depth, FRUSTUM_M)


def test_a_single_view_shows_no_camera(shown):
    assert build_payload(shown).meta["cameras"] == []


def test_everything_but_samples_is_json_without_nan(shown):
    payload = build_payload(shown)
    flags = describe_flags(shown, None)
    json.dumps([payload.meta, flags, labels.PLAYER, labels.PLAYER_ACTIONS], allow_nan=False)


def test_flags_come_in_the_order_of_their_keys():
    late = make_flag(FlagLevel.HIGH, what="late", start_s=5.0)
    early = make_flag(FlagLevel.HIGH, what="early", start_s=1.0)
    whole = make_flag(FlagLevel.HIGH, what="whole", start_s=math.nan, end_s=math.nan)
    fine = make_flag(FlagLevel.OK, what="fine", start_s=0.0)
    ordered = order_flags((fine, whole, late, early))
    assert [flag.what for flag in ordered] == ["early", "late", "whole", "fine"]


def test_a_flag_says_what_was_answered(library, trial_id):
    result, record = cache.result(trial_id), cache.record(trial_id)
    flag = result.flags[1]
    library.review(trial_id, flag, "rejected", version=record.version, reason="pushed")
    shown = {f["key"]: f for f in describe_flags(result, cache.record(trial_id))}
    assert shown[flag_key(flag)]["review"] == "rejected"
    assert shown[flag_key(result.flags[0])]["review"] == ""


def test_what_the_browser_sends_is_read():
    sent = {"action": "note", "time_s": 1.5, "flag": "", "number": 7}
    assert read_event(sent) == PlayerEvent("note", 1.5, "", 7)


@pytest.mark.parametrize(
    "sent",
    [
        None,
        "note",
        [],
        {},
        {"action": "note", "time_s": "soon", "number": 1},
        {"action": "note", "time_s": math.inf, "number": 1},
        {"action": 3, "time_s": 1.0, "number": 1},
        {"action": "note", "time_s": 1.0, "number": "1"},
    ],
)
def test_anything_else_the_browser_sends_is_no_event(sent):
    assert read_event(sent) is None


def test_the_frontend_asks_for_nothing_from_elsewhere():
    own = [p for p in FRONTEND.iterdir() if not p.name.startswith(("three", "LICENSE"))]
    assert {"index.html", "player.js", "player.css"} <= {p.name for p in own}
    for path in own:
        text = path.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert "http:" not in text, path.name
        assert "https:" not in text, path.name
    assert "MIT" in (FRONTEND / "LICENSE.three").read_text(encoding="utf-8")


def test_every_word_the_frontend_uses_exists():
    used = set()
    for path in FRONTEND.glob("*.js"):
        if not path.name.startswith("three"):
            used |= words_in(path.read_text(encoding="utf-8"))
    assert used
    missing = {word for word in used if word not in labels.PLAYER}
    assert not missing


def words_in(source):
    return set(re.findall(r"\bwords\.(\w+)", source))
