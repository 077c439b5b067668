"""C3D files say, to an independent reader, what the result says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pytest

from engine.datatypes import JointAngles, PoseTrack
from engine.errors import DataError, UnitError
from engine.skeletons import get_skeleton
from engine.storage.c3d_writer import write_c3d
from tests.builders import make_angles, make_pose_track

N = 40


@pytest.fixture
def track() -> PoseTrack:
    """A track with a missing sample."""
    made = make_pose_track(n_frames=N)
    position = made.position.copy()
    position[7, 3] = np.nan
    return replace(made, position=position, status=None)


@pytest.fixture
def angles(track: PoseTrack) -> JointAngles:
    return make_angles(time_s=track.time_s, missing=((4, "trunk_flexion"),), sigma_deg=3.0)


def read(path: Path) -> Any:
    return ezc3d.c3d(str(path))


def value(file: Any, group: str, name: str) -> Any:
    return file["parameters"][group][name]["value"]


def test_points_labels_units_and_rate_are_read_back(
    track: PoseTrack, angles: JointAngles, tmp_path: Path
) -> None:
    write_c3d(track, angles, tmp_path / "a.c3d")
    file = read(tmp_path / "a.c3d")
    names = get_skeleton(track.skeleton).keypoints
    assert value(file, "POINT", "LABELS") == [*names, *angles.names]
    assert value(file, "POINT", "UNITS") == ["mm"]
    assert value(file, "POINT", "ANGLES") == list(angles.names)
    assert "Y up" in value(file, "MANUFACTURER", "AXES")[0]
    assert value(file, "POINT", "RATE")[0] == pytest.approx(30.0)
    found = file["data"]["points"][:3, : len(names)].transpose(2, 1, 0)
    expected = track.position * 1000
    there = np.isfinite(expected).all(axis=2)
    assert there.sum() == there.size - 1
    np.testing.assert_allclose(found[there], expected[there], atol=1e-3)


def test_angles_are_points_in_degrees(
    track: PoseTrack, angles: JointAngles, tmp_path: Path
) -> None:
    write_c3d(track, angles, tmp_path / "a.c3d")
    points = read(tmp_path / "a.c3d")["data"]["points"]
    first = len(get_skeleton(track.skeleton).keypoints)
    found = points[0, first:].T
    there = np.isfinite(angles.value_deg)
    np.testing.assert_allclose(found[there], angles.value_deg[there], atol=1e-4)


def test_residuals_tell_missing_from_measured(
    track: PoseTrack, angles: JointAngles, tmp_path: Path
) -> None:
    write_c3d(track, angles, tmp_path / "a.c3d")
    residual = read(tmp_path / "a.c3d")["data"]["meta_points"]["residuals"][0]
    n_keypoints = track.position.shape[1]
    missing = ~np.isfinite(track.position).all(axis=2)
    assert np.array_equal(residual[:n_keypoints].T < 0, missing)
    assert not residual[:n_keypoints].T[~missing].any()
    assert residual[n_keypoints + angles.names.index("trunk_flexion"), 4] == -1


def test_true_times_are_kept_where_the_rate_varies(tmp_path: Path) -> None:
    time_s = np.cumsum(np.tile([0.03, 0.04], 10))
    track = replace(make_pose_track(n_frames=20), time_s=time_s)
    write_c3d(track, make_angles(time_s=time_s), tmp_path / "a.c3d")
    file = read(tmp_path / "a.c3d")
    assert value(file, "ANALOG", "LABELS") == ["time"]
    np.testing.assert_allclose(file["data"]["analogs"][0, 0], time_s, atol=1e-5)


def test_a_track_without_a_world_or_of_other_frames_is_refused(
    angles: JointAngles, tmp_path: Path
) -> None:
    with pytest.raises(UnitError, match="world frame, got the body"):
        write_c3d(
            make_pose_track(n_frames=N, frame_of_reference="body"), angles, tmp_path / "a.c3d"
        )
    with pytest.raises(DataError, match="different frames"):
        write_c3d(make_pose_track(n_frames=N - 1), angles, tmp_path / "a.c3d")
    assert not list(tmp_path.iterdir())


def test_more_frames_than_programs_agree_about_are_refused(tmp_path: Path) -> None:
    n = 65_536
    time_s = np.arange(n) / 100
    track = PoseTrack(time_s, np.zeros((n, 17, 3)), "m", "world", "h36m_17")
    with pytest.raises(DataError, match="1 to 65535 frames, got 17 points and 65536"):
        write_c3d(track, JointAngles(time_s, np.empty((n, 0)), ()), tmp_path / "a.c3d")
