"""One trial on one page: what it shows is what was stored, and it always fits."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest

from engine.datatypes import FlagLevel, Measurement, Task
from engine.ergonomics.improvements import rank_changes
from engine.errors import ConfigError
from engine.improve import read_exposure
from engine.report import ReportOptions, render_trial_report, trial_report
from engine.report.facts import read_facts, typeset
from engine.report.sheet import PAPERS
from tests.builders import make_end, make_flag, make_lift, make_pose_track, make_trial_result
from tests.engine.report.results import (
    LIFTS,
    find_outside,
    find_overlaps,
    list_tags,
    make_assessed,
    read_pdf,
    read_text,
    record_text,
    store,
    with_blur,
    write_grey_video,
)

LONG = "An endlessly long explanation that goes on about the lift and never comes to a point; " * 6


@pytest.fixture(autouse=True)
def no_ranking(monkeypatch, request):
    """Leave out the trying of changes, which has tests of its own, unless a test is about it."""
    if "ranked_page" not in request.fixturenames:
        monkeypatch.setattr(trial_report, "list_best_changes", lambda facts: facts.changes)


@pytest.fixture(scope="module")
def ranked_page(stored):
    return render_trial_report(stored)


@pytest.fixture(scope="module")
def assessed():
    return make_assessed()


@pytest.fixture(scope="module")
def stored(assessed, tmp_path_factory):
    return store(assessed, tmp_path_factory.mktemp("report") / "lift")


@pytest.fixture(scope="module")
def page(stored):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trial_report, "list_best_changes", lambda facts: facts.changes)
        return render_trial_report(stored)


# --------------------------------------------------------------------------- what it shows


def test_it_is_one_page_of_the_paper_asked_for(stored):
    for paper, size in PAPERS.items():
        pages = read_pdf(render_trial_report(stored, ReportOptions(paper=paper))).pages
        assert len(pages) == 1
        assert [float(x) for x in pages[0].mediabox[2:]] == pytest.approx(size, abs=0.01)


def test_the_head_names_trial_person_work_and_date(page):
    text = read_text(page)
    for part in ("Crate to shelf", "Person P01", "Hall 3", "Packing", "load 12 kg", "2 lifts"):
        assert part in text
    assert "5 Mar 2026" in text


def test_the_lifting_index_is_the_stored_one_with_its_range(stored, page):
    risk = stored.risk["rnle"]
    low, high = risk.interval
    text = read_text(page)
    assert f"Lifting index {risk.value:.1f}" in text
    assert math.isinf(high)
    assert f"95 % range {low:.1f} or more" in text


def test_the_equation_shows_every_input_with_range_and_multiplier(stored, page):
    part = max(stored.risk["rnle"].per_lift, key=lambda risk: risk.value)
    lift, details, text = stored.lifts[part.lift_index], part.details, read_text(page)
    assert f"lift {part.lift_index + 1} (the worst of 2)" in text
    for name, end in (("origin", lift.origin), ("destination", lift.destination)):
        for measured, unit in ((end.H_cm, " cm"), (end.V_cm, " cm"), (end.A_deg, "°")):
            low, high = (max(0.0, x) for x in measured.interval())
            assert f"{measured.value:.0f}{unit} ({low:.0f} to {high:.0f})" in text
        for factor in ("HM", "VM", "DM", "AM", "FM", "CM"):
            assert f"× {details[name][factor]:.2f}" in text
        assert f"{details[name]['RWL_kg']:.1f} kg" in text
    low, high = details["rwl_interval_kg"]
    assert f"{part.details['rwl_kg']:.1f} kg ({low:.1f} to {high:.1f})" in text
    assert "2/min, short" in text
    assert "fair" in text


def test_every_method_is_there_with_value_unit_and_range(stored, page):
    text = read_text(page)
    shown = {method.name: method for method in read_facts(stored).methods}
    assert len(shown) > 8
    for name, method in shown.items():
        risk = stored.risk[name]
        assert method.value == risk.value or math.isnan(risk.value)
        if risk.is_applicable and math.isfinite(risk.value):
            unit = f" {risk.unit}" if risk.unit else ""
            low, high = risk.interval
            digits = method.digits
            assert f"{risk.value:.{digits}f}{unit} " in text
            if math.isfinite(high):
                assert f"{low:.{digits}f} to {high:.{digits}f}" in text


def test_levels_are_words_and_the_verdict_is_the_worst(stored, page):
    text = read_text(page)
    worst = min((f.level for f in stored.flags), key=list(FlagLevel)[::-1].index)
    assert worst is FlagLevel.HIGH
    assert "High risk Change the work before it goes on." in text


def test_provenance_identifies_video_settings_and_version(stored, page):
    text = read_text(page)
    assert stored.views[0].info.sha256[:12] in text
    assert f"LiftLens {stored.document['liftlens_version']}" in text
    for part in ("estimator mediapipe", "solver geometric", "correction default"):
        assert part in text
    assert "5 Mar 2026, 14:30 UTC" in text
    assert re.search(r"settings [0-9a-f]{12}", text)


def test_nothing_touches_and_nothing_leaves_the_margins(stored, monkeypatch):
    for paper, size in PAPERS.items():
        written = record_text(monkeypatch)
        render_trial_report(stored, ReportOptions(paper=paper))
        assert len(written) > 100
        assert not find_overlaps(written)
        assert not find_outside(written, size, 36.0)


def test_what_to_change_begins_with_what_helps_most(stored, ranked_page):
    ranking = rank_changes(read_exposure(stored))
    text = read_text(ranked_page)
    best = " ".join(typeset(ranking.singles[0].sentence).split())
    assert f"What to change 1. Lift {ranking.lift_index + 1}: {best}" in text
    assert "Bring the work higher and closer, so that the trunk stays upright" in text


def test_coverage_adds_up_to_the_stored_shares(page):
    assert "90 % seen" in read_text(page)
    assert "5 % not seen" in read_text(page)


# --------------------------------------------------------------------------- what may be missing


def test_a_trial_without_lifts_says_so(tmp_path):
    text = read_text(render_trial_report(store(make_assessed(()), tmp_path / "r")))
    assert "No lift was found" in text
    assert "0 lifts" in text
    assert "the equation can't be used here" in text
    assert " nan" not in text.lower()


def test_an_unknown_load_gives_the_limit_instead_of_the_index(tmp_path):
    stored = store(make_assessed(task=Task(coupling="good")), tmp_path / "r")
    limit = stored.risk["rnle"].details["rwl_kg"]
    text = read_text(render_trial_report(stored))
    assert f"Recommended limit {limit:.1f} kg" in text
    assert "load not given" in text


def test_an_infinite_index_is_said_in_words(tmp_path):
    far = make_lift(1.0, 2.2, origin=make_end(1.0, H_cm=90.0))
    stored = store(make_assessed((far,)), tmp_path / "r")
    assert math.isinf(stored.risk["rnle"].value)
    text = read_text(render_trial_report(stored))
    assert "Lifting index infinite" in text
    assert "no weight is acceptable here" in text
    assert " inf " not in text


def test_what_was_not_measured_is_called_so(tmp_path):
    unseen = dataclasses.replace(make_end(1.0), A_deg=Measurement(math.nan))
    lifts = (make_lift(1.0, 2.2, origin=unseen),)
    result = dataclasses.replace(make_assessed(), lifts=(*lifts, LIFTS[1]))
    result = dataclasses.replace(
        result, risk={"rnle": dataclasses.replace(result.risk["rnle"].per_lift[0], lift_index=0)}
    )
    text = read_text(render_trial_report(store(result, tmp_path / "r")))
    assert "To the side (A) not measured" in text


def test_curves_that_were_not_measured_are_called_so(tmp_path, assessed):
    angles = dataclasses.replace(
        assessed.angles, value_deg=np.full_like(assessed.angles.value_deg, np.nan)
    )
    result = dataclasses.replace(assessed, angles=angles)
    stored = store(result, tmp_path / "r")
    page = render_trial_report(stored)
    assert "Knee flexion left (not measured)" in read_text(page)
    assert ("/Figure", "Trunk against the vertical was not measured.") in list_tags(page)


def test_a_result_of_nothing_still_makes_a_page(tmp_path):
    nothing = np.full_like(make_pose_track(n_frames=30).position, np.nan)
    track = dataclasses.replace(make_pose_track(n_frames=30), position=nothing, status=None)
    result = make_trial_result(lis=(), corrected=track, risk={}, flags=(), coverage={})
    text = read_text(render_trial_report(store(result, tmp_path / "r")))
    for part in (
        "Not judged",
        "No check could be made",
        "How much of the body was seen is not known.",
        "No picture: the joints were not measured.",
        "The lifting equation was not part of this assessment.",
        "No other method was part of this assessment.",
    ):
        assert part in text


def test_free_form_details_of_another_kind_do_no_harm(stored, tmp_path, assessed):
    def damage(document):
        for part in (document["risk"]["rnle"], *document["risk"]["rnle"]["per_lift"]):
            part["details"] = {
                "origin": "?", "destination": {"HM": "far", "RWL_kg": None}, "counted_ends": 3,
                "rwl_interval_kg": [1], "governing_lift": "x",
            }  # fmt: skip
        document["risk"]["reba"]["details"]["worst_moments"] = [5]
        document["created"] = "yesterday"
        document["label"] = None

    text = read_text(render_trial_report(store(assessed, tmp_path / "r", edit=damage)))
    assert "date not known" in text
    assert "Untitled trial" in text
    assert "Limit (RWL) not measured not measured" in text


# --------------------------------------------------------------------------- what is too much


@pytest.mark.parametrize("paper", PAPERS)
def test_forty_long_flags_stay_on_one_page(tmp_path, assessed, paper, monkeypatch):
    levels = [FlagLevel.REVIEW, FlagLevel.HIGH, FlagLevel.OK] * 14
    flags = [
        make_flag(level, what=f"Flag {i:02d} {LONG}", why=LONG, change=f"Change {i}: {LONG}")
        for i, level in enumerate(levels[:40])
    ]
    trial = dataclasses.replace(assessed.trial, label=LONG, site=LONG, job=LONG)
    result = dataclasses.replace(assessed, trial=trial, flags=tuple(flags), warnings=(LONG,) * 9)
    stored = store(result, tmp_path / "r")
    written = record_text(monkeypatch)
    page = render_trial_report(stored, ReportOptions(paper=paper))
    assert len(read_pdf(page).pages) == 1
    assert not find_overlaps(written)
    assert not find_outside(written, PAPERS[paper], 36.0)
    text = read_text(page)
    shown = len(set(re.findall(r"Flag \d\d", text)))
    assert "Flag 01" in text  # the first of the high ones leads
    assert f"and {40 - shown} more in the full result" in text


def test_many_lifts_are_counted_where_they_are_not_named(tmp_path):
    lifts = tuple(make_lift(0.1 + 0.4 * i, 0.3 + 0.4 * i) for i in range(14))
    text = read_text(render_trial_report(store(make_assessed(lifts), tmp_path / "r")))
    assert "14 lifts" in text
    assert "Index of each lift: " in text
    assert "and 6 more in the full result" in text


def test_names_of_many_scripts_print(tmp_path):
    result = make_assessed(label="Łukasz Żółć ≤ 5 📦", site="Ωμέγα", job="Жук\u202e\n")
    page = render_trial_report(store(result, tmp_path / "r"))
    text = read_text(page)
    assert "Łukasz Żółć ≤ 5 ▯" in text
    assert "Ωμέγα · Жук" in text
    assert "▯ stands for a character" in text
    assert "Łukasz" in read_pdf(page).metadata.title


# --------------------------------------------------------------------------- picture and privacy


def test_the_picture_is_taken_from_the_annotated_video(tmp_path, assessed):
    video = write_grey_video(tmp_path / "v.mp4")
    stored = store(with_blur(assessed, is_on=True), tmp_path / "r", overlay=video)
    page = render_trial_report(stored)
    (image,) = read_pdf(page).pages[0].images
    moment = read_facts(stored).moment
    grey = np.asarray(image.image.convert("L")).mean()
    assert grey == pytest.approx(20 + 30 * moment.time_s, abs=3)
    assert any(role == "/Figure" and "Picture" in alt for role, alt in list_tags(page))


def test_a_video_with_uncovered_heads_is_never_shown(tmp_path, assessed):
    video = write_grey_video(tmp_path / "v.mp4")
    stored = store(with_blur(assessed, is_on=False), tmp_path / "r", overlay=video)
    page = render_trial_report(stored)
    assert not read_pdf(page).pages[0].images
    assert "heads are not covered in the video" in read_text(page)


def test_settings_that_do_not_say_count_as_uncovered(tmp_path, assessed):
    video = write_grey_video(tmp_path / "v.mp4")
    stored = store(
        with_blur(assessed, is_on=True), tmp_path / "r", overlay=video,
        edit=lambda document: document.update(config={}),
    )  # fmt: skip
    assert not read_pdf(render_trial_report(stored)).pages[0].images


def test_a_video_that_can_not_be_read_is_replaced_by_a_drawing(tmp_path, assessed):
    video = tmp_path / "v.mp4"
    video.write_bytes(b"no video at all")
    stored = store(with_blur(assessed, is_on=True), tmp_path / "r", overlay=video)
    text = read_text(render_trial_report(stored))
    assert "the annotated video can't be read" in text


def test_without_video_the_joints_are_drawn(page):
    assert "the result holds no annotated video" in read_text(page)
    assert any("Stick figure" in alt for _, alt in list_tags(page))


def test_anonymous_leaves_out_person_name_and_picture(tmp_path, assessed):
    video = write_grey_video(tmp_path / "v.mp4")
    stored = store(with_blur(assessed, is_on=True), tmp_path / "r", overlay=video)
    options = ReportOptions(is_anonymous=True, with_file_names=True)
    page = render_trial_report(stored, options)
    assert not read_pdf(page).pages[0].images
    everything = read_text(page) + str(read_pdf(page).metadata)
    for hidden in ("P01", "Crate to shelf", "lift.mp4"):
        assert hidden not in everything
    assert "Packing" in everything


def test_names_of_video_files_are_shown_on_request_only(stored, page):
    assert "lift.mp4" not in read_text(page)
    shown = render_trial_report(stored, ReportOptions(with_file_names=True))
    assert "lift.mp4" in read_text(shown)


# --------------------------------------------------------------------------- the document


def test_metadata_and_structure(stored, page):
    reader = read_pdf(page)
    assert reader.metadata.title == "Lifting assessment: Crate to shelf"
    assert reader.metadata.creation_date.isoformat() == stored.document["created"]
    assert reader.trailer["/Root"]["/Lang"] == "en"
    roles = [role for role, _ in list_tags(page)]
    assert roles.count("/H1") == 1
    assert roles.count("/H2") >= 6
    assert roles.count("/Table") == 2
    figures = [alt for role, alt in list_tags(page) if role == "/Figure"]
    assert len(figures) == 4  # person, coverage, two charts
    assert all(figures)


def test_the_same_result_gives_the_same_bytes_and_little_of_them(stored, page):
    assert render_trial_report(stored) == page
    assert len(page) < 1_000_000


def test_a_title_can_be_given(stored):
    page = render_trial_report(stored, ReportOptions(title="Ramp 4, new table"))
    assert "Ramp 4, new table" in read_text(page)
    assert "Ramp 4" in read_pdf(page).metadata.title


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ReportOptions(paper="a5"), "paper must be one of a4, letter, got 'a5'"),
        (ReportOptions(language="xx"), "language must be one of en, got 'xx'"),
    ],
)
def test_wrong_options_are_named(stored, options, message):
    with pytest.raises(ConfigError, match=message):
        render_trial_report(stored, options)
