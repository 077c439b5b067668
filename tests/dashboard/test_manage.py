from datetime import UTC, datetime, timedelta

import pytest

from dashboard import manage_cache
from dashboard.manage_charts import plot_shares, plot_trend
from dashboard.manage_parts import MOST_BARS
from engine.datatypes import FlagLevel
from engine.report import ReportOptions
from engine.sample_results import SAMPLES_SITE
from engine.storage.overview import LiftCounts, MonthOverview
from engine.storage.results import write_result
from tests.builders import make_flag, make_lift, make_trial, make_trial_result
from tests.dashboard.test_app import html


@pytest.fixture
def page(app):
    """The overview, once it is run."""
    app.switch_page("views/manage.py")
    return app


def add(library, name, *, site="Hall 3", job="Packing", levels=(FlagLevel.HIGH,)):
    """Put a trial with one lift for each level into the library."""
    result = make_trial_result(
        trial=make_trial(label=name, site=site, job=job),
        lifts=tuple(make_lift(0.2 + 0.1 * i, 0.25 + 0.1 * i) for i in range(len(levels))),
        flags=tuple(make_flag(level, lift_index=i) for i, level in enumerate(levels)),
    )
    write_result(result, library.folder(name))


def test_an_empty_library_says_what_to_do(page):
    page.run()
    assert "Nothing to sum up yet" in html(page)
    page.button(key="manage-start").click().run()
    assert page.title[0].value == "Trials"


def test_counts_shares_and_worst_jobs_are_shown(page, library):
    add(library, "a", levels=(FlagLevel.HIGH, FlagLevel.HIGH, FlagLevel.OK, FlagLevel.REVIEW))
    add(library, "b", job="Loading", levels=(FlagLevel.OK, FlagLevel.OK))
    page.run()
    assert not page.exception
    shown = html(page)
    assert "33%" in shown  # 2 of 6
    assert "6 judged, 0 not" in shown
    assert "95 %: 10% to 70%" in shown  # Wilson (1927)
    table = shown[shown.index("<table") :]
    assert "Hall 3 · Packing" in table
    assert "Loading" not in table  # no high-risk lift there


def test_filters_narrow_and_stand_in_the_address(page, library):
    add(library, "a")
    add(library, "b", site="Yard", levels=(FlagLevel.OK,))
    page.query_params["site"] = "Yard"
    page.run()
    assert "No job here has a high-risk lift" in page.success[0].value
    page.selectbox(key="site").set_value("Hall 3").run()
    assert "100%" in html(page)


def test_a_choice_that_fits_nothing_says_so(page, library):
    add(library, "a", site="Yard", job="Loading")
    add(library, "b")
    page.run()
    page.selectbox(key="site").set_value("Yard")
    page.selectbox(key="work").set_value("Packing").run()
    assert "No trial fits" in page.info[0].value


def test_samples_count_only_as_long_as_there_is_nothing_else(page, library):
    add(library, "sample", site=SAMPLES_SITE, job="Floor to knuckle")
    page.run()
    assert "bundled samples" in page.info[0].value
    assert "100%" in html(page)
    add(library, "own", levels=(FlagLevel.OK,))
    manage_cache.forget_summaries()
    page.run()
    assert not page.info
    assert "0%" in html(page)
    assert "100%" not in html(page).split("95 %")[0]
    page.selectbox(key="site").set_value(SAMPLES_SITE).run()
    assert "100%" in html(page)


def test_before_and_after_split_at_the_day(page, library):
    add(library, "a")
    page.run()
    assert "first day of the changed work" in page.caption[-1].value or any(
        "first day of the changed work" in caption.value for caption in page.caption
    )
    page.date_input(key="changed_day").set_value(datetime.now(UTC).date() + timedelta(days=2))
    page.run()
    assert "since that day" in page.info[0].value


def test_reports_are_pdfs_of_what_was_chosen(library):
    add(library, "a")
    add(library, "b")
    add(library, "c", job="Loading")
    ids = manage_cache.find_ids(site="Hall 3", job="Packing")
    assert set(ids) == {"a", "b"}
    pdf = manage_cache.group_report(ids, ReportOptions(), before=("c",))
    assert pdf.startswith(b"%PDF")
    assert manage_cache.trial_report("a", ReportOptions(paper="letter")).startswith(b"%PDF")


def test_damaged_trials_are_named_not_counted(page, library):
    add(library, "a")
    broken = library.folder("broken")
    broken.mkdir()
    (broken / "trial.json").write_text("{")
    page.run()
    assert "1 damaged result" in page.warning[0].value
    assert manage_cache.find_ids() == ("a",)


# --------------------------------------------------------------------------- figures


def counts(high, review, ok, unjudged=0):
    return LiftCounts(1, high + review + ok + unjudged, high, review, ok)


def test_shares_add_up_to_one_and_levels_differ_by_pattern():
    figure = plot_shares([("A", counts(1, 2, 3, 2)), ("B", counts(0, 0, 4))])
    assert [bar.name for bar in figure.data] == [
        "High risk",
        "Needs review",
        "No concern",
        "Not judged",
    ]
    assert sum(bar.x[0] for bar in figure.data) == pytest.approx(1)
    assert sum(bar.x[1] for bar in figure.data) == pytest.approx(1)
    assert len({bar.marker.pattern.shape for bar in figure.data}) == 4


def test_a_level_nobody_has_is_left_out():
    figure = plot_shares([("A", counts(0, 2, 3))])
    assert [bar.name for bar in figure.data] == ["Needs review", "No concern"]


def test_months_without_trials_stay_empty():
    months = [
        MonthOverview(2025, 11, counts(1, 0, 1)),
        MonthOverview(2026, 2, counts(0, 0, 1)),
    ]
    figure = plot_trend(months)
    assert list(figure.data[0].x) == ["Nov 2025", "Dec 2025", "Jan 2026", "Feb 2026"]
    assert list(figure.layout.xaxis.ticktext) == [
        "Nov<br>2<br>2025",
        "Dec<br>–",
        "Jan<br>–<br>2026",
        "Feb<br>1",
    ]
    assert list(figure.data[0].y) == [0.5, 0, 0, 0]


def test_only_the_jobs_with_most_lifts_are_drawn(page, library):
    for number in range(MOST_BARS + 1):
        add(library, f"t{number}", job=f"Job {number}")
    page.run()
    assert any(
        f"The {MOST_BARS} with the most lifts, of {MOST_BARS + 1}" in c.value for c in page.caption
    )
