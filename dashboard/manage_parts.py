"""The parts of the overview for who decides what to change."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from html import escape

import streamlit as st

from dashboard import cache, manage_cache, pages, state
from dashboard.labels import count, format_index, format_number
from dashboard.manage_charts import plot_shares, plot_trend
from dashboard.widgets import is_dark, table_html
from engine.report import ReportOptions
from engine.sample_results import SAMPLES_SITE, leave_out
from engine.storage.overview import LiftCounts, Overview, PlaceOverview

CHART = {"displayModeBar": False}
PERIODS: dict[str, int | None] = {
    "All time": None,
    "Last 30 days": 30,
    "Last 90 days": 90,
    "Last 12 months": 365,
}
MOST_BARS = 15
UNNAMED_SITE, UNNAMED_JOB = "No site named", "No job named"
TRIAL, JOB, SITE = "One trial", "A job", "A site"
SHARE_HELP = (
    "High-risk lifts among all lifts that were judged, with its 95 % interval (Wilson): few lifts "
    "say little. Lifts count as independent, so the truth is a little wider still."
)


@dataclass(frozen=True)
class Scope:
    """What is looked at; None: everything. `since` is the first moment that counts."""

    site: str | None
    job: str | None
    since: datetime | None


def choose_scope() -> Scope:
    """Ask for site, job and period; the answers stand in the address."""
    choices = manage_cache.choices()
    site, job, period = st.columns(3)
    chosen_site = site.selectbox(
        "Site",
        list(choices.sites),
        index=None,
        placeholder="All sites",
        key=state.SITE_KEY,
        bind="query-params",
    )
    chosen_job = job.selectbox(
        "Job",
        list(choices.jobs),
        index=None,
        placeholder="All jobs",
        key=state.WORK_KEY,
        bind="query-params",
    )
    chosen = period.selectbox("Period", list(PERIODS), key=state.PERIOD_KEY, bind="query-params")
    days = PERIODS[chosen or "All time"]
    since = (
        None
        if days is None
        else _midnight(datetime.now().astimezone().date() - timedelta(days=days))
    )
    return Scope(chosen_site, chosen_job, since)


def _midnight(day: date) -> datetime:
    """Return the start of a day where the user is."""
    return datetime(day.year, day.month, day.day).astimezone()


def read_overview(scope: Scope) -> Overview:
    """Return the library in numbers; samples count only where there is nothing else."""
    found = manage_cache.overview(site=scope.site, job=scope.job, since=scope.since)
    if scope.site is not None:
        return found
    samples = manage_cache.overview(site=SAMPLES_SITE, job=scope.job, since=scope.since)
    return leave_out(found, samples)


def say_if_samples(overview: Overview) -> None:
    """Say so where all that is shown are the bundled samples."""
    if {place.site for place in overview.sites} == {SAMPLES_SITE}:
        st.info(
            "These are the bundled samples, to show what this page does. With the first trial of "
            "your own they count no longer; Settings, Data removes them.",
            icon=":material/science:",
        )


def show_empty(*, is_library_empty: bool) -> None:
    """Say why there is nothing to see, and what to do."""
    if not is_library_empty:
        st.info(
            "No trial fits this choice. Choose another site, job or period.",
            icon=":material/filter_alt_off:",
        )
        return
    with st.container(border=True):
        st.html(
            '<div class="ll-empty"><h2>Nothing to sum up yet</h2><p>Once trials are in the list, '
            "this page shows how many lifts are at each level, where the worst jobs are, and "
            "whether it gets better.</p></div>"
        )
        with st.container(horizontal=True, horizontal_alignment="center"):
            if st.button("Start with the samples or a video", type="primary", key="manage-start"):
                st.switch_page(pages.TRIALS)
        st.space("small")


# --------------------------------------------------------------------------- overview


def show_numbers(overview: Overview) -> None:
    """Show the main counts, and how much of the lifts they rest on."""
    lifts = overview.lifts
    judged = lifts.n_lifts - lifts.n_unjudged
    tiles = (
        ("Trials", format_number(lifts.n_trials), f"at {count(_named_jobs(overview), 'job')}"),
        ("Lifts", format_number(lifts.n_lifts), f"{judged} judged, {lifts.n_unjudged} not"),
        ("High risk", _share(lifts), f"of the judged lifts, {_interval(lifts)}"),
    )
    body = "".join(
        f'<div class="ll-tile"><span class="ll-quiet ll-small">{escape(name)}</span><br>'
        f'<b style="font-size:1.9rem">{escape(value)}</b><br>'
        f'<span class="ll-quiet ll-small">{escape(under)}</span></div>'
        for name, value, under in tiles
    )
    st.html(f'<div class="ll-tiles" title="{escape(SHARE_HELP)}">{body}</div>')
    if overview.n_damaged:
        st.warning(
            f"{count(overview.n_damaged, 'damaged result')} not counted; see the list of trials.",
            icon=":material/warning:",
        )


def _named_jobs(overview: Overview) -> int:
    return sum(bool(place.job) for place in overview.jobs)


def _share(lifts: LiftCounts) -> str:
    return "–" if math.isnan(lifts.share_high) else f"{lifts.share_high:.0%}"


def _interval(lifts: LiftCounts) -> str:
    low, high = lifts.share_high_interval
    return "none yet" if math.isnan(low) else f"95 %: {low:.0%} to {high:.0%}"


def _place_name(place: PlaceOverview, *, with_site: bool = True) -> str:
    site = place.site or UNNAMED_SITE
    if place.job is None:
        return site
    job = place.job or UNNAMED_JOB
    return f"{site} · {job}" if with_site else job


def show_places(overview: Overview, scope: Scope) -> None:
    """Show how the lifts of every site and job are spread over the levels."""
    sites, jobs = st.columns(2, gap="large")
    with sites:
        _show_bars("By site", overview.sites, with_site=True)
    with jobs:
        _show_bars("By job", overview.jobs, with_site=scope.site is None)


def _show_bars(title: str, places: Sequence[PlaceOverview], *, with_site: bool) -> None:
    st.subheader(title, anchor=False)
    places = [place for place in places if place.lifts.n_lifts]
    if not places:
        st.caption("No lift was found in these trials.")
        return
    shown = sorted(places, key=lambda place: place.lifts.n_lifts, reverse=True)[:MOST_BARS]
    rows = [(_place_name(place, with_site=with_site), place.lifts) for place in shown]
    _chart(plot_shares(rows, dark=is_dark()), key=title, alt=_describe(title, rows))
    if len(places) > len(shown):
        st.caption(f"The {MOST_BARS} with the most lifts, of {len(places)}.")


def _describe(title: str, rows: Sequence[tuple[str, LiftCounts]]) -> str:
    parts = "; ".join(
        f"{name}: {lifts.n_high} high risk, {lifts.n_review} to review, {lifts.n_ok} no concern, "
        f"{lifts.n_unjudged} not judged"
        for name, lifts in rows
    )
    return f"Lifts at each level. {title}: {parts}."


def _chart(figure: object, *, key: str, alt: str) -> None:
    st.plotly_chart(figure, config=CHART, key=f"chart-{key}", alt=alt)


def show_trend(overview: Overview) -> None:
    """Show the levels month by month."""
    st.subheader("Month by month", anchor=False)
    months = [month for month in overview.months if month.lifts.n_lifts]
    if not months:
        st.caption("No lift was found in these trials.")
        return
    rows = [(f"{month.month}/{month.year}", month.lifts) for month in months]
    _chart(plot_trend(months, dark=is_dark()), key="trend", alt=_describe("By month", rows))
    st.caption("Months are those of the assessment (UTC). Few lifts swing widely by chance alone.")


def show_worst_jobs(overview: Overview) -> None:
    """List the jobs that most surely have many high-risk lifts."""
    st.subheader("The worst jobs", anchor=False)
    worst = overview.worst_jobs()
    if not worst:
        st.success("No job here has a high-risk lift.", icon=":material/check_circle:")
        return
    head = (
        ("Job", ""),
        ("High risk", SHARE_HELP),
        ("Lifts", "All lifts that were found."),
        ("Highest index", "Highest lifting index of its trials."),
        ("Last filmed", ""),
    )
    rows = (
        (
            _place_name(place),
            f"{_share(place.lifts)} ({_interval(place.lifts)})",
            str(place.lifts.n_lifts),
            "–" if place.worst_li is None else format_index(place.worst_li),
            f"{place.latest.astimezone():%d %b %Y}".lstrip("0"),
        )
        for place in worst
    )
    st.html(table_html(head, rows))
    st.caption(
        "Sorted by the lower end of the interval: one bad lift out of one weighs less than "
        "nineteen out of twenty."
    )


# --------------------------------------------------------------------------- before and after


def show_before_after(overview: Overview) -> None:
    """Show how a job's lifts were spread before and after a day."""
    st.subheader("Before and after a change", anchor=False)
    named = {_place_name(place): place for place in overview.jobs if place.job}
    if not named:
        st.caption("Name the job of your trials first: the pencil in the list of trials.")
        return
    job, day = st.columns([2, 1])
    name = job.selectbox("Which job", list(named), key=state.CHANGED_JOB_KEY)
    changed = day.date_input("Changed on", value=None, key=state.CHANGED_DAY_KEY)
    if name is None or not isinstance(changed, date):
        st.caption("Choose the first day of the changed work.")
        return
    place, cut = named[name], _midnight(changed)
    before = manage_cache.overview(site=place.site, job=place.job, until=cut)
    after = manage_cache.overview(site=place.site, job=place.job, since=cut)
    rows = [("Before", before.lifts), ("After", after.lifts)]
    if not all(lifts.n_lifts for _, lifts in rows):
        side = "before" if not before.lifts.n_lifts else "since"
        st.info(f"No lift of this job was filmed {side} that day.", icon=":material/event_busy:")
        return
    _chart(plot_shares(rows, dark=is_dark()), key="change", alt=_describe("Change", rows))
    st.caption(
        " ".join(
            f"{side}: {count(lifts.n_trials, 'trial')}, {_share(lifts)} of the judged lifts at "
            f"high risk ({_interval(lifts)})."
            for side, lifts in rows
        )
        + " Different people or loads make a difference too; the page Improve compares trials "
        "with their errors."
    )
    _offer_comparison(place, cut)


def _offer_comparison(place: PlaceOverview, cut: datetime) -> None:
    options = _options()

    def make() -> bytes:
        before = manage_cache.find_ids(site=place.site, job=place.job, until=cut)
        after = manage_cache.find_ids(site=place.site, job=place.job, since=cut)
        return manage_cache.group_report(after, options, before=before)

    _pdf_button("Before and after as PDF", make, _file_name(place, "change"), key="pdf-change")


# --------------------------------------------------------------------------- reports


def show_reports(overview: Overview, scope: Scope) -> None:
    """Offer a trial, a job or a site as PDF."""
    st.subheader("Take it to the meeting", anchor=False)
    kind = st.segmented_control(
        "What", [TRIAL, JOB, SITE], default=JOB, required=True, key=state.REPORT_KIND_KEY
    )
    st.checkbox(
        "Without pseudonyms, names of trials and pictures",
        key=state.ANONYMOUS_KEY,
        help="A drawn figure takes the place of the picture. Site, job and date stay.",
    )
    if kind == TRIAL:
        _offer_trial(scope)
        return
    places = overview.jobs if kind == JOB else overview.sites
    named = {_place_name(place): place for place in places}
    name = st.selectbox("Which one", list(named), key=f"{state.REPORT_KIND_KEY}-{kind}")
    if name is not None:
        _offer_group(named[name], scope)


def _offer_trial(scope: Scope) -> None:
    found = cache.library().query(
        site=scope.site, job=scope.job, since=scope.since, limit=manage_cache.MOST_REPORTED
    )
    entries = {entry.id: entry for entry in found.entries if not entry.is_damaged}
    chosen = st.selectbox(
        "Which one",
        list(entries),
        format_func=lambda one: f"{entries[one].label or one} · {entries[one].created[:10]}",
        key=f"{state.REPORT_KIND_KEY}-trial",
    )
    if found.total > len(found.entries):
        st.caption(f"The newest {len(found.entries)} of {found.total}; narrow the choice above.")
    if chosen:
        options = _options()
        _pdf_button(
            "Trial as PDF",
            lambda: manage_cache.trial_report(chosen, options),
            f"{chosen}.pdf",
            key="pdf-trial",
        )


def _offer_group(place: PlaceOverview, scope: Scope) -> None:
    options, n_trials = _options(), place.lifts.n_trials

    def make() -> bytes:
        ids = manage_cache.find_ids(site=place.site, job=place.job, since=scope.since)
        return manage_cache.group_report(ids, options)

    if n_trials > manage_cache.MOST_REPORTED:
        st.caption(
            f"The report holds the newest {manage_cache.MOST_REPORTED} of {n_trials} trials; "
            "choose a shorter period for others."
        )
    _pdf_button("Summary as PDF", make, _file_name(place, "summary"), key="pdf-group")


def _options() -> ReportOptions:
    chosen = manage_cache.preferences()
    return ReportOptions(
        paper=chosen.paper,
        language=chosen.language,
        is_anonymous=state.is_anonymous(),
    )


def _pdf_button(label: str, make: Callable[[], bytes], file_name: str, *, key: str) -> None:
    st.download_button(
        label,
        make,  # made on the click only
        file_name=file_name,
        mime="application/pdf",
        icon=":material/picture_as_pdf:",
        on_click="ignore",
        key=key,
    )


def _file_name(place: PlaceOverview, what: str) -> str:
    today = datetime.now(UTC).strftime("%Y-%m-%d")
    return cache.sanitise_name(f"{_place_name(place)} {what} {today}.pdf")
