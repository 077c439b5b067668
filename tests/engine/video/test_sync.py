"""Offsets from the movement, their confidence, refusals, and the user's own offset."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.datatypes import CheckLevel, SyncEstimate, ViewPose
from engine.errors import DataError, SyncError
from engine.video.sync import check_offset, estimate_offset, refine_offset, require_sure
from tests.engine.video import clips
from tests.engine.video.sync_scenes import film, frames, look_from, make_lift, stand_still

SIDE, OBLIQUE = look_from(90.0), look_from(130.0, height_m=1.5)


def film_both(seed: int, late_s: float, **kwargs) -> tuple[ViewPose, ViewPose]:
    """Film one lift twice, the second camera started so much later."""
    world = make_lift(seed)
    first = film(world, SIDE, frames(0.0, 7.0), seed=1)
    return first, film(world, OBLIQUE, frames(late_s, 7.5), seed=2, **kwargs)


def lose(view: ViewPose, start_s: float, stop_s: float) -> ViewPose:
    """Lose the person for a while."""
    gone = (view.image.time_s >= start_s) & (view.image.time_s < stop_s)
    position, box = np.array(view.image.position), np.array(view.box)
    position[gone], box[gone] = np.nan, np.nan
    return clips.replace_arrays(view, position, box)


def turn_picture(view: ViewPose) -> ViewPose:
    """Turn the picture clockwise by a quarter, as a phone held upright without saying so."""
    x, y = np.moveaxis(np.array(view.image.position), 2, 0)
    left, top, right, bottom = view.box.T
    box = np.stack([720 - bottom, left, 720 - top, right], axis=1)
    return clips.replace_arrays(view, np.stack([720 - y, x], axis=2), box)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("rate", [24.0, 25.0, 30.0, 59.94])
def test_offset_is_found_within_a_third_of_a_picture_at_any_rate(seed: int, rate: float) -> None:
    world = make_lift(seed)
    first = film(world, SIDE, frames(0.0, 7.0), seed=1)
    second = film(world, OBLIQUE, frames(1.2345, 7.5, rate), seed=2)
    estimate = estimate_offset(first, second)
    assert estimate.level is CheckLevel.GREEN
    assert estimate.method == "motion"
    assert estimate.offset_s == pytest.approx(1.2345, abs=0.01)
    assert abs(estimate.offset_s - 1.2345) < 4.0 * estimate.sigma_s < 0.1


def test_uneven_steps_are_taken_as_they_are() -> None:
    world = make_lift(5)
    rng = np.random.default_rng(0)
    seen = np.sort(frames(0.8, 7.0) + rng.uniform(-0.012, 0.012, 186))
    estimate = estimate_offset(film(world, SIDE, frames(0.0, 7.0)), film(world, OBLIQUE, seen))
    assert estimate.level is CheckLevel.GREEN
    assert estimate.offset_s == pytest.approx(seen[0], abs=0.01)


def test_a_person_lost_for_a_second_does_not_harm() -> None:
    first, second = film_both(1, 0.9)
    estimate = estimate_offset(lose(first, 2.0, 3.0), lose(second, 3.5, 4.5))
    assert estimate.level is CheckLevel.GREEN
    assert estimate.offset_s == pytest.approx(0.9, abs=0.015)


def test_a_picture_turned_by_a_quarter_gives_the_same_offset() -> None:
    first, second = film_both(2, 1.1)
    turned = estimate_offset(first, turn_picture(second))
    assert turned.offset_s == pytest.approx(estimate_offset(first, second).offset_s, abs=1e-6)
    assert turned.level is CheckLevel.GREEN


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), late_s=st.floats(0.0, 3.0))
def test_exchanging_the_videos_turns_the_sign(seed: int, late_s: float) -> None:
    first, second = film_both(seed, late_s)
    there, back = estimate_offset(first, second), estimate_offset(second, first)
    assert there.offset_s == pytest.approx(-back.offset_s, abs=0.004)


def test_clocks_that_do_not_start_at_zero_are_respected() -> None:
    first, second = film_both(3, 1.0)
    image = dataclasses.replace(second.image, time_s=second.image.time_s + 12.5)
    moved = estimate_offset(first, dataclasses.replace(second, image=image))
    assert moved.offset_s == pytest.approx(1.0 - 12.5, abs=0.01)


def test_clocks_of_different_rate() -> None:
    world, ppm = make_lift(7, length_s=150.0), 200.0
    seen = frames(3.0, 140.0)
    clock = (seen - 3.0) / (1.0 + 1e-6 * ppm)
    first = film(world, SIDE, frames(0.0, 140.0), seed=1)
    estimate = estimate_offset(first, film(world, OBLIQUE, seen, clock_s=clock, seed=2))
    assert 1e6 * estimate.drift == pytest.approx(ppm, abs=30.0)
    assert estimate.offset_s == pytest.approx(3.0, abs=0.006)
    same = estimate_offset(first, film(world, OBLIQUE, seen, seed=2))
    assert abs(same.drift) < 60e-6


def test_ten_seconds_are_found_in_ten_minutes() -> None:
    world = make_lift(8, length_s=610.0)
    first = film(world, SIDE, frames(0.0, 600.0), seed=1)
    estimate = estimate_offset(first, film(world, OBLIQUE, frames(371.3, 381.3), seed=2))
    assert estimate.level is CheckLevel.GREEN
    assert estimate.offset_s == pytest.approx(371.3, abs=0.01)


def test_two_lifts_are_refused() -> None:
    levels = []
    for seed in range(12):
        first = film(make_lift(seed), SIDE, frames(0.0, 7.0))
        second = film(make_lift(seed + 100), OBLIQUE, frames(0.0, 7.0), seed=2)
        estimate = estimate_offset(first, second)
        levels.append(estimate.level)
        if estimate.level is CheckLevel.RED:
            with pytest.raises(SyncError, match="--sync"):
                require_sure(estimate)
    assert CheckLevel.GREEN not in levels
    assert levels.count(CheckLevel.RED) >= 10


def test_parts_without_overlap_are_refused() -> None:
    world = make_lift(4)
    first, second = film(world, SIDE, frames(0.0, 3.5)), film(world, OBLIQUE, frames(4.0, 8.0))
    assert estimate_offset(first, second).level is CheckLevel.RED


def test_a_standing_person_tells_no_offset() -> None:
    lift = film(make_lift(0), SIDE, frames(0.0, 6.0))
    still = film(stand_still, OBLIQUE, frames(0.0, 6.0), seed=2)
    estimate = estimate_offset(lift, still)
    assert estimate.level is CheckLevel.RED
    assert np.isnan(estimate.offset_s)
    assert "hardly moves in the second video" in estimate.sentence


def test_nobody_in_a_video() -> None:
    first, second = film_both(0, 1.0)
    estimate = estimate_offset(first, lose(second, 0.0, 100.0))
    assert (estimate.level, estimate.confidence) == (CheckLevel.RED, 0.0)
    assert "second video shows nobody" in estimate.sentence


def test_too_short_a_clip() -> None:
    world = make_lift(0)
    first = film(world, SIDE, frames(0.0, 6.0))
    estimate = estimate_offset(first, film(world, OBLIQUE, frames(2.0, 2.7)))
    assert estimate.level is CheckLevel.RED
    assert "lasts 0.7 s" in estimate.sentence


@pytest.mark.parametrize("start_s", [0.0, 0.5])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_one_clip_twice_is_told(start_s: float, scale: float) -> None:
    world = make_lift(6)
    first = film(world, SIDE, frames(0.0, 7.0), seed=1)
    # Cut, coded again at another size: the same camera, with keypoints that differ a little.
    copy = film(world, SIDE, frames(start_s, 7.0), seed=1)
    shaken = np.random.default_rng(3).normal(copy.image.position, 0.5) * scale
    copy = clips.replace_arrays(copy, shaken, copy.box * scale)
    estimate = estimate_offset(first, copy)
    assert estimate.level is CheckLevel.RED
    assert "one clip twice" in estimate.sentence
    assert check_offset(first, copy, start_s).level is CheckLevel.RED


def test_one_file_twice_is_told_by_its_hash() -> None:
    first, second = film_both(0, 1.0)
    info = dataclasses.replace(first.info, sha256="ab" * 32)
    views = [dataclasses.replace(view, info=info) for view in (first, second)]
    assert "one clip twice" in estimate_offset(*views).sentence


def test_lifts_that_repeat_exactly_are_ambiguous() -> None:
    lift = make_lift(9)
    first = film(lambda t: lift(t % 4.0), SIDE, frames(0.0, 11.9), seed=1)
    second = film(lambda t: lift(t % 4.0), OBLIQUE, frames(4.2, 7.8), seed=2)
    estimate = estimate_offset(first, second)
    assert estimate.level is not CheckLevel.GREEN
    assert estimate.confidence < 0.7
    assert "repeats so alike" in estimate.sentence
    assert "--sync" in estimate.sentence


def test_the_interval_holds_the_truth() -> None:
    """Of 24 lifts the stated 95 % intervals hold at least 20 (fewer has a chance of 1 in 160)."""
    inside = 0
    for seed in range(24):
        estimate = estimate_offset(*film_both(200 + seed, 0.7))
        inside += abs(estimate.offset_s - 0.7) <= 1.96 * estimate.sigma_s
    assert inside >= 20


def test_known_cameras_sharpen_the_offset() -> None:
    plain, sharp = [], []
    for seed in range(8):
        first, second = film_both(300 + seed, 1.0)
        estimate = estimate_offset(first, second)
        refined = refine_offset(first, second, (SIDE, OBLIQUE), estimate)
        assert refined.sigma_s < 0.008
        plain.append(abs(estimate.offset_s - 1.0))
        sharp.append(abs(refined.offset_s - 1.0))
    assert np.mean(sharp) < np.mean(plain)
    assert max(sharp) < 0.004


def test_cameras_that_contradict_the_movement_are_told() -> None:
    first, second = film_both(1, 1.0)
    estimate = estimate_offset(first, second)
    off = dataclasses.replace(estimate, offset_s=1.1, sigma_s=0.005)
    refined = refine_offset(first, second, (SIDE, OBLIQUE), off)
    assert (refined.level, refined.offset_s) == (CheckLevel.AMBER, 1.1)
    assert "lines of sight" in refined.sentence


def test_red_and_given_offsets_are_not_refined() -> None:
    first, second = film_both(1, 1.0)
    for estimate in (SyncEstimate(1.03), SyncEstimate(1.0, level=CheckLevel.RED, method="motion")):
        assert refine_offset(first, second, (SIDE, OBLIQUE), estimate) is estimate
    with pytest.raises(DataError, match="cameras of both views"):
        refine_offset(first, second, (SIDE,), SyncEstimate(1.0))


@pytest.mark.parametrize(
    ("given_s", "level", "words"),
    [
        (1.0, CheckLevel.GREEN, "the movement says"),
        (1.03, CheckLevel.GREEN, "the movement says"),
        (1.5, CheckLevel.AMBER, "but the movement says"),
        (-1.0, CheckLevel.AMBER, "but the movement says"),
        (60.0, CheckLevel.RED, "do not overlap"),
    ],
)
def test_a_given_offset_is_kept_and_checked(given_s: float, level: CheckLevel, words: str) -> None:
    first, second = film_both(1, 1.0)
    estimate = check_offset(first, second, given_s)
    assert (estimate.offset_s, estimate.method, estimate.level) == (given_s, "user", level)
    assert words in estimate.sentence


def test_a_given_offset_between_two_lifts_is_doubted() -> None:
    first = film(make_lift(0), SIDE, frames(0.0, 7.0))
    second = film(make_lift(100), OBLIQUE, frames(0.0, 7.0), seed=2)
    estimate = check_offset(first, second, 0.0)
    assert estimate.level is CheckLevel.AMBER
    assert "do not agree" in estimate.sentence


def test_a_given_offset_is_taken_where_nobody_moves() -> None:
    still = [film(stand_still, camera, frames(0.0, 5.0)) for camera in (SIDE, OBLIQUE)]
    assert check_offset(*still, 0.5).level is CheckLevel.GREEN


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_an_offset_that_is_no_number(wrong: float) -> None:
    with pytest.raises(DataError, match="number of seconds"):
        check_offset(*film_both(1, 1.0), wrong)


def test_sure_estimates_pass() -> None:
    estimate = SyncEstimate(0.5)
    assert require_sure(estimate) is estimate
