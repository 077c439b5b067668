"""Several trials in one summary: counts, worst lifts, comparison, pages."""

from __future__ import annotations

import dataclasses
import math

import pytest

from engine.datatypes import FlagLevel
from engine.errors import ConfigError
from engine.improve import compare_results
from engine.report import ReportOptions, render_job_report
from engine.report.facts import read_facts, typeset
from engine.report.job_facts import list_jobs, summarise_trials
from engine.report.sheet import PAPERS
from tests.builders import make_flag, make_risk, make_trial, make_trial_result
from tests.engine.report.results import (
    find_outside,
    find_overlaps,
    list_tags,
    read_pdf,
    read_text,
    record_text,
    store,
)

HIGH, REVIEW, OK = FlagLevel.HIGH, FlagLevel.REVIEW, FlagLevel.OK


def make_stored(folder, li=1.4, *, day="2026-03-01", level=REVIEW, label="Crate", **trial):
    """Store a trial of one lift with a lifting index ± 10 %."""
    part = make_risk(li, lift_index=0, interval=(0.9 * li, 1.1 * li))
    flags = () if level is None else (make_flag(level, change="Bring it closer: it falls."),)
    result = make_trial_result(
        lis=(li,),
        risk={"rnle": dataclasses.replace(part, lift_index=None, per_lift=(part,))},
        flags=flags,
        trial=make_trial(label=label, **trial),
    )
    return store(result, folder, created=f"{day}T10:00:00+00:00")


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    root = tmp_path_factory.mktemp("job")
    rows = [
        ("2026-02-01", 2.6, HIGH, "Packing"),
        ("2026-01-01", 1.4, REVIEW, "Packing"),
        ("2026-03-01", 0.8, OK, "Stacking"),
        ("2026-04-01", math.nan, None, "Stacking"),
    ]
    return [
        make_stored(root / str(i), li, day=day, level=level, job=job, label=f"Trial {day}")
        for i, (day, li, level, job) in enumerate(rows)
    ]


@pytest.fixture(scope="module")
def group(trials):
    return summarise_trials(map(read_facts, trials))


# --------------------------------------------------------------------------- facts


def test_trials_come_in_order_of_time(group):
    assert [trial.created.month for trial in group.trials] == [1, 2, 3, 4]


def test_lifts_and_trials_are_counted_by_level(group):
    expected = ((HIGH, 1), (REVIEW, 1), (OK, 1), (None, 1))
    assert group.trial_levels == group.lift_levels == expected
    assert group.level is HIGH
    assert group.n_high_lifts == 1


def test_the_worst_lifts_come_first_and_only_those_with_an_index(group):
    assert [entry.lift.lifting_index for entry in group.worst] == [2.6, 1.4, 0.8]
    assert [entry.number for entry in group.worst] == [2, 1, 3]


def test_changes_are_counted_by_trial(group):
    assert group.changes == (("Bring it closer", 2),)  # not of trials without concern


def test_the_most_urgent_job_comes_first(group):
    assert [job.name for job in list_jobs(group)] == ["Packing", "Stacking"]
    assert [len(job.group.trials) for job in list_jobs(group)] == [2, 2]


# --------------------------------------------------------------------------- document


def test_the_first_page_is_the_summary(trials):
    text = read_text(render_job_report(trials))
    for part in (
        "1 Jan 2026 to 1 Apr 2026",
        "4 trials · 4 lifts · 1 person",
        "Change before the work goes on: 1 of 4 trials.",
        "Trials that could not be judged: 1 of 4.",
        "Highest lifting index 2.6 95 % range 2.3 to 2.9",
        "High risk: 1 lift (25 %)",
        "Not judged: 1 lift (25 %)",
        "Packing High risk 2 2 1 of 2 (50 %) 2.6 (2.3 to 2.9)",
        "2. Trial 2026-02-01 1 2.6 (2.3 to 2.9) 1 Feb 2026",
        "1. Bring it closer · in 2 of 4 trials",
        "Page 1 of 1",
    ):
        assert part in text, part


def test_every_trial_is_in_the_table(trials):
    text = read_text(render_job_report(trials))
    table = text[text.index("All trials") :]
    for number, index in ((1, "1.4 (1.3 to 1.5)"), (2, "2.6 (2.3 to 2.9)"), (4, "not judged")):
        assert f"{number}. Trial 2026-0{number}-01" in table
        assert index in table


def test_before_and_after_are_compared(trials):
    after, before = [trials[2]], [trials[0]]
    outcome = compare_results(before, after)
    text = read_text(render_job_report(after, before=before))
    assert " ".join(typeset(outcome.sentence).split()) in text
    assert "Lifts at high risk 1 of 1 (100 %) 0 of 1 (0 %)" in text
    index = outcome.changes[0]
    low, high = index.interval
    assert (index.before, index.after) == (2.6, 0.8)
    shown = f"Lifting index 2.6 0.8 {index.difference:.1f} ({low:.1f} to {high:.1f}) improved"
    assert shown.replace("-", "−") in text
    assert "Trials before the change" in text


def test_what_must_not_be_compared_is_refused_in_words(trials, tmp_path):
    subject = dataclasses.replace(make_trial().subject, label="P02")
    other = make_stored(tmp_path / "r", 0.8, subject=subject)
    text = read_text(render_job_report([other], before=[trials[0]]))
    assert "with different people, a difference may be theirs" in text
    assert "improved" not in text


@pytest.mark.parametrize("paper", PAPERS)
def test_many_trials_flow_over_numbered_pages(trials, paper, monkeypatch):
    written = record_text(monkeypatch)
    pdf = render_job_report(trials * 25, ReportOptions(paper=paper))
    pages = read_pdf(pdf).pages
    n = len(pages)
    assert n > 2
    for number, page in enumerate(pages, start=1):
        assert f"Page {number} of {n}" in page.extract_text()
        assert "Most urgent finding" in page.extract_text()
    assert read_text(pdf).count("Trial 2026-02-01") >= 25
    for number in range(1, n + 1):
        on_page = [w for w in written if w.page == number]
        assert not find_overlaps(on_page)
    assert not find_outside(written, PAPERS[paper], 36.0)
    assert len(pdf) < 1_000_000


def test_many_jobs_with_long_names_keep_the_summary_on_one_page(trials, tmp_path, monkeypatch):
    many = [
        make_stored(
            tmp_path / str(i), 1 + i / 10, job=f"Job {i} " + "long name " * 9, site="S" * 90
        )
        for i in range(14)
    ]
    written = record_text(monkeypatch)
    pdf = render_job_report(many, ReportOptions(paper="letter"), before=trials)
    assert "What to change most often" in read_pdf(pdf).pages[0].extract_text()
    assert not find_overlaps(written)
    assert not find_outside(written, PAPERS["letter"], 36.0)


def test_trials_without_any_index_say_so(tmp_path):
    text = read_text(render_job_report([make_stored(tmp_path / "r", math.nan, level=None)]))
    assert "Nothing could be judged" in text
    assert "No lifting index is known" in text
    assert " nan" not in text


def test_anonymous_names_nobody(trials):
    pdf = render_job_report(trials, ReportOptions(is_anonymous=True))
    text = read_text(pdf)
    assert "P01" not in text
    assert "2026-02-01" not in text  # the labels
    assert "Trial 2" in text


def test_the_order_of_results_does_not_matter(trials):
    assert render_job_report(trials) == render_job_report(trials[::-1])


def test_metadata_and_structure(trials):
    pdf = render_job_report(trials)
    metadata = read_pdf(pdf).metadata
    assert metadata.title == "Summary of lifting assessments: Lifting at work"
    assert metadata.creation_date.isoformat() == "2026-04-01T10:00:00+00:00"
    figures = [alt for role, alt in list_tags(pdf) if role == "/Figure"]
    assert figures[0].startswith("Lifts at each level: High risk 1")
    assert figures[1] == "Lifting index over time, 3 trials from 1 Jan 2026 to 1 Mar 2026."


def test_one_job_gives_the_title(trials):
    assert "Packing" in read_pdf(render_job_report(trials[:2])).metadata.title


def test_no_result_is_refused():
    with pytest.raises(ConfigError, match="at least one result"):
        render_job_report([])
