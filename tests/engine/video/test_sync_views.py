"""Two views at common times: what is interpolated, what stays missing, and whose times count."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.datatypes import PersonBox, PoseTrack, Status, SubjectState, SyncEstimate, ViewPose
from engine.errors import DataError, SyncError
from engine.video.sync import SyncedViews, resample_views
from tests.engine.video import clips


def make_view(time_s: np.ndarray, moment_s: np.ndarray) -> ViewPose:
    """Every keypoint moves evenly: 100 px/s in x and -50 px/s in y from its own start."""
    start = 10.0 * np.arange(33)
    position = np.stack(
        [start + 100.0 * moment_s[:, None], start - 50.0 * moment_s[:, None]], axis=2
    )
    samples = position.shape[:2]
    image = PoseTrack(
        time_s, position, "px", "image", "mediapipe_33",
        confidence=np.full(samples, 0.8), sigma=np.full(samples, 2.0),
    )  # fmt: skip
    body = PoseTrack(
        time_s,
        np.concatenate([position, position[..., :1]], axis=2) / 1000.0,
        "m",
        "body",
        "mediapipe_33",
    )
    box = np.stack([moment_s, moment_s + 1, moment_s + 10, moment_s + 20], axis=1) * 10.0
    state = (SubjectState.INIT,) + (SubjectState.TRACKED,) * (len(time_s) - 1)
    return ViewPose(image, body, box, state, clips.make_info(n_frames=len(time_s)))


def moments_of(view: ViewPose) -> np.ndarray:
    """When the picture shows what it shows."""
    return view.image.position[:, 0, 0] / 100.0


def make_pair(
    offset_s: float, *, rates=(30.0, 30.0), drift: float = 0.0, seconds: float = 4.0
) -> tuple[ViewPose, ViewPose]:
    times = [np.arange(0.0, seconds, 1.0 / rate) for rate in rates]
    first = make_view(times[0], times[0])
    return first, make_view(times[1], times[1] * (1.0 + drift) + offset_s)


def synced(views: tuple[ViewPose, ViewPose], offset_s: float, drift: float = 0.0) -> SyncedViews:
    return resample_views(views, SyncEstimate(offset_s, drift=drift))


@settings(max_examples=40)
@given(
    offset_s=st.floats(-3.0, 3.0),
    drift=st.floats(-5e-4, 5e-4),
    rates=st.tuples(st.sampled_from([24.0, 30.0, 59.94]), st.sampled_from([25.0, 30.0, 60.0])),
)
def test_both_views_show_the_same_moments(offset_s: float, drift: float, rates) -> None:
    views = make_pair(offset_s, rates=rates, drift=drift)
    result = synced(views, offset_s, drift)
    first, second = result.views
    assert np.array_equal(first.image.time_s, second.image.time_s)
    assert first.image.time_s[0] == 0.0
    np.testing.assert_allclose(moments_of(first), moments_of(second), atol=1e-7)
    np.testing.assert_allclose(
        moments_of(first), first.image.time_s + result.start_in_first_s, atol=1e-7
    )
    in_second = result.start_in_second_s + result.rate_in_second * second.image.time_s
    np.testing.assert_allclose(in_second * (1.0 + drift) + offset_s, moments_of(second), atol=1e-7)
    np.testing.assert_allclose(second.box[:, 0], 10.0 * moments_of(second), atol=1e-6)
    np.testing.assert_allclose(second.body.position[:, 0, 0], moments_of(second) / 10, atol=1e-7)


def test_the_slower_views_samples_stay_as_they_are() -> None:
    first, second = make_pair(0.51, rates=(59.94, 30.0))
    result = synced((first, second), 0.51)
    assert result.base == 1
    kept = result.views[1].image.position
    assert np.array_equal(kept, second.image.position[: len(kept)])
    assert synced(make_pair(0.5), 0.5).base == 0


def test_nothing_is_invented_next_to_a_missing_sample() -> None:
    first, second = make_pair(0.01)
    position = np.array(second.image.position)
    position[50, 3] = np.nan
    box = np.array(second.box)
    box[60] = np.nan
    second = clips.replace_arrays(second, position, box)
    found = synced((first, second), 0.01).views[1]
    gone = ~np.isfinite(found.image.position[:, 3]).all(axis=1)
    # Sample i lies between frames i and i + 1 of the second; the first sample is frame 1's time.
    assert np.flatnonzero(gone).tolist() == [49, 50]
    assert (found.image.status[gone, 3] == Status.MISSING).all()
    assert np.isfinite(found.image.position[:, 4]).all()
    assert np.flatnonzero(np.isnan(found.box[:, 0])).tolist() == [59, 60]


def test_a_moment_on_a_picture_needs_no_neighbour() -> None:
    first, second = make_pair(0.0)
    position = np.array(second.image.position)
    position[50] = np.nan
    found = synced((first, clips.replace_arrays(second, position, second.box)), 0.0).views[1]
    assert np.flatnonzero(np.isnan(found.image.position[:, 0, 0])).tolist() == [50]
    assert np.array_equal(found.image.position[49], second.image.position[49])


def test_nothing_is_interpolated_over_a_hole_between_pictures() -> None:
    first, _ = make_pair(0.0)
    times = np.arange(0.0, 4.0, 1.0 / 30.0)
    times = times[(times < 1.0) | (times > 1.5)] + 0.004
    result = synced((first, make_view(times, times)), 0.0)
    missing = np.isnan(moments_of(result.views[1]))
    asked = result.views[0].image.time_s + result.start_in_first_s
    last, following = times[times < 1.2][-1], times[times > 1.2][0]
    assert np.array_equal(missing, (asked > last) & (asked < following))
    assert missing.sum() == 17


def test_errors_confidence_and_status_of_neighbours_are_kept() -> None:
    first, second = make_pair(0.01)
    status = np.array(second.image.status)
    status[20:, 5] = Status.FILLED
    image = dataclasses.replace(second.image, status=status)
    found = synced((first, dataclasses.replace(second, image=image)), 0.01).views[1].image
    np.testing.assert_allclose(found.sigma, 2.0)
    np.testing.assert_allclose(found.confidence, 0.8)
    assert found.status[18, 5] == Status.MEASURED
    assert (found.status[19:, 5] == Status.FILLED).all()
    assert (found.status[:, 4] == Status.MEASURED).all()


def test_states_and_bystanders_come_from_the_nearest_picture() -> None:
    first, second = make_pair(0.01)
    others = tuple((PersonBox(i, 0, i + 1, 1),) for i in range(second.image.n_frames))
    second = dataclasses.replace(second, others=others)
    found = synced((first, second), 0.01).views[1]
    assert [o[0].left for o in found.others[:3]] == [1, 2, 3]
    assert found.state[0] is SubjectState.TRACKED
    assert len(found.state) == found.image.n_frames


@pytest.mark.parametrize("offset_s", [50.0, -50.0, 3.97])
def test_without_two_common_pictures_it_is_an_error(offset_s: float) -> None:
    with pytest.raises(SyncError, match="no two pictures in common"):
        synced(make_pair(0.0), offset_s)


def test_wrong_calls() -> None:
    views = make_pair(0.0)
    with pytest.raises(DataError, match="two views"):
        resample_views(views[:1], SyncEstimate(0.0))
    with pytest.raises(DataError, match="known offset"):
        resample_views(views, SyncEstimate(float("nan")))
