"""A stored trial is assessed anew with what a person corrected, and as it was without."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import engine.pipeline as pipeline
from engine.config import Config, SubjectConfig
from engine.corrections import (
    NO_CORRECTIONS,
    PROVENANCE_KEY,
    Corrections,
    LiftCorrection,
    PersonChoice,
    SideSwap,
    read_corrections,
)
from engine.datatypes import Frame, PersonBox, TrialResult, ViewPose
from engine.errors import ConfigError, NoPersonFound, VideoError
from engine.kinematics.events import SET_BY_USER
from engine.pipeline import assess_poses
from engine.reassess import reassess, reassess_to_folder
from engine.storage.results import StoredResult, read_result, write_result
from tests.dashboard.results import write_clip
from tests.engine.cameras.truth import Truth, read_truth, see
from tests.engine.test_pipeline import (
    assert_same_result,
    make_trial,
    make_two_view_trial,
)

WHO = {"by": "AB", "on": "2026-11-22T14:05:00+00:00"}


@pytest.fixture(scope="module")
def lift() -> Truth:
    return read_truth("floor_to_knuckle")


@pytest.fixture(scope="module")
def first(lift: Truth) -> TrialResult:
    seen = see(lift.points, lift.cameras["cam90"], lift.time_s)
    return assess_poses(make_trial(round(lift.stature_m, 3)), [seen], Config())


@pytest.fixture(scope="module")
def stored(first: TrialResult, tmp_path_factory: pytest.TempPathFactory) -> StoredResult:
    folder = tmp_path_factory.mktemp("stored")
    overlay = write_clip(folder / "drawn.mp4", seconds=0.2)
    return read_result(write_result(first, folder / "result", overlay=overlay))


def span(result: TrialResult | StoredResult) -> tuple[float, float]:
    return result.lifts[0].start_s, result.lifts[0].end_s


def test_nothing_corrected_changes_nothing(stored, first):
    assert_same_result(reassess(stored, NO_CORRECTIONS), first)


def test_a_lift_is_measured_where_it_was_put_and_judged_again(stored, first, lift):
    start_s, end_s = span(first)
    later_s = start_s + 0.4
    fix = NO_CORRECTIONS.correct_lift((start_s, end_s), (later_s, end_s), **WHO)
    result = reassess(stored, fix)
    (moved,) = result.lifts
    assert moved.start_s == pytest.approx(later_s, abs=1 / 60)
    assert SET_BY_USER in moved.notes
    true_V = 100 * lift.knuckles[lift.at(later_s), 1]
    assert moved.origin.V_cm.value == pytest.approx(true_V, abs=5.0)
    assert moved.origin.V_cm.value > first.lifts[0].origin.V_cm.value + 3.0
    assert result.risk["rnle"].value != first.risk["rnle"].value
    assert any(
        "by AB on 22 Nov 2026, 14:05 UTC" in text and f"-> {later_s:.2f} s" in text
        for text in result.warnings
    )
    np.testing.assert_array_equal(result.angles.value_deg, first.angles.value_deg)


def test_a_false_lift_is_gone_and_so_is_what_was_said_of_it(stored, first):
    result = reassess(stored, Corrections((LiftCorrection(span(first), None),)))
    assert result.lifts == ()
    assert not result.risk["rnle"].is_applicable
    assert any(flag.what == "No lift was found" for flag in result.flags)


def test_a_lift_outside_the_clip_is_refused(stored):
    with pytest.raises(ConfigError, match="within the clip"):
        reassess(stored, Corrections((LiftCorrection(None, (50.0, 51.0)),)))


def test_corrections_are_kept_and_can_be_taken_back(stored, first, tmp_path):
    fix = Corrections((LiftCorrection(span(first), (1.0, 2.0)),), (SideSwap(0.5, 3.0, **WHO),))
    again = read_result(reassess_to_folder(stored, fix, tmp_path / "again"))
    assert read_corrections(again.document) == fix
    assert len(again.views[0].image.provenance[PROVENANCE_KEY]) == 1
    assert not np.array_equal(again.raw.position, stored.raw.position)
    assert again.overlay_path is not None
    assert stored.overlay_path is not None
    assert again.overlay_path.read_bytes() == stored.overlay_path.read_bytes()
    assert any("not drawn again" in text for text in again.warnings)
    assert_same_result(reassess(again, NO_CORRECTIONS), first)
    half = reassess(again, fix.remove(fix.swaps[0]))
    np.testing.assert_array_equal(half.raw.position, first.raw.position)
    assert half.lifts[0].start_s == pytest.approx(1.0, abs=1 / 60)


def test_another_person_needs_the_video_that_was_assessed(stored, tmp_path):
    fix = Corrections(persons=(PersonChoice(0.0, (0.0, 0.0, 50.0, 100.0)),))
    with pytest.raises(VideoError, match="needs the video again; add the file"):
        reassess(stored, fix)
    other = write_clip(tmp_path / "other.mp4")
    with pytest.raises(VideoError, match="not the video that was assessed"):
        reassess(stored, fix, [other])
    with pytest.raises(ConfigError, match="1 videos, but 2"):
        reassess(stored, fix, [other, other])


def test_two_views_are_joined_as_they_were(lift, tmp_path):
    seen = [see(lift.points, lift.cameras[name], lift.time_s) for name in ("cam90", "cam135")]
    poses = [
        dataclasses.replace(view, info=dataclasses.replace(view.info, sha256=name))
        for view, name in zip(seen, "ab", strict=True)
    ]
    first = assess_poses(make_two_view_trial(stature_m=round(lift.stature_m, 3)), poses, Config())
    stored = read_result(write_result(first, tmp_path / "result"))
    assert_same_result(reassess(stored, NO_CORRECTIONS), first)


# --------------------------------------------------------------------------- the person

LEFT, RIGHT = (20.0, 20.0, 100.0, 220.0), (200.0, 30.0, 270.0, 210.0)


def make_frames(n_frames: int = 12) -> Iterator[Frame]:
    for i in range(n_frames):
        yield Frame(i, i / 10, np.zeros((240, 320, 3), dtype=np.uint8))


def detect(_image: object) -> list[PersonBox]:
    return [PersonBox(*LEFT, confidence=0.9), PersonBox(*RIGHT, confidence=0.8)]


def follow(*persons: PersonChoice, detector=detect) -> list[float | None]:
    """Return the left end of the followed person's box, frame by frame."""
    tracked = pipeline._follow(make_frames(), detector, SubjectConfig(), persons)
    return [None if t.box is None else t.box.left for t in tracked]


def test_from_the_chosen_moment_on_the_chosen_person_is_followed():
    assert set(follow()) == {LEFT[0]}
    rough = (190.0, 25.0, 280.0, 220.0)
    assert follow(PersonChoice(0.5, rough)) == [LEFT[0]] * 5 + [RIGHT[0]] * 7
    assert set(follow(PersonChoice(0.0, rough))) == {RIGHT[0]}
    both = follow(PersonChoice(0.3, rough), PersonChoice(0.8, LEFT))
    assert both == [LEFT[0]] * 3 + [RIGHT[0]] * 5 + [LEFT[0]] * 4


def test_whom_nobody_saw_is_followed_where_the_user_drew_the_box():
    found = follow(PersonChoice(0.5, RIGHT), detector=lambda _image: [])
    assert found[:5] == [None] * 5
    assert found[5] == RIGHT[0]
    with pytest.raises(NoPersonFound):
        follow(detector=lambda _image: [])


def test_a_choice_after_the_end_is_refused():
    with pytest.raises(ConfigError, match=r"chosen at 9\.00 s, but the video ends at 1\.10 s"):
        follow(PersonChoice(9.0, LEFT))


def test_a_box_outside_the_picture_is_refused():
    with pytest.raises(ConfigError, match="outside the picture"):
        follow(PersonChoice(0.5, (900.0, 0.0, 950.0, 50.0)))


@pytest.mark.model
def test_another_person_in_a_real_video(sample_folder: Path, tmp_path: Path) -> None:
    """The whole way: a box that a person drew, and the same person without one."""
    path = sample_folder / "floor_to_knuckle" / "cam90.mp4"
    config = dataclasses.replace(
        Config(),
        video=dataclasses.replace(Config().video, start_s=1.0, stop_s=1.6),
        pose=dataclasses.replace(Config().pose, variant="full"),
    )
    folder = pipeline.assess_to_folder(make_trial(1.725, path), config, tmp_path / "one")
    stored = read_result(folder)
    box = tuple(float(x) for x in stored.views[0].box[3])
    fix = Corrections(persons=(PersonChoice(1.2, box, **WHO),))
    again = read_result(reassess_to_folder(stored, fix, tmp_path / "two", [path]))
    assert read_corrections(again.document) == fix
    assert_near(again.views[0], stored.views[0])
    assert any("another person is followed from 1.20 s" in text for text in again.warnings)


def assert_near(here: ViewPose, there: ViewPose) -> None:
    apart = np.linalg.norm(here.image.position - there.image.position, axis=2)
    assert np.nanmedian(apart) < 6.0
