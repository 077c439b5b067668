"""The parts of the page that compares a trial with a reference recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import streamlit as st

from dashboard import cache, labels, pages, reference_charts, state
from dashboard.labels import format_interval, format_number
from dashboard.widgets import facts_html, is_dark, list_html, table_html, when
from engine.errors import EngineError
from engine.storage.library import TrialEntry
from engine.validation.agreement import AngleSummary
from engine.validation.compare import TrialComparison
from engine.validation.pooled import Agreement, describe_agreement, describe_offsets, find_sides
from engine.validation.profiles import ImportProfile
from engine.validation.reference.base import Reference
from engine.validation.reference.files import REFERENCE_SUFFIXES, describe_profile

CHART = {"displaylogo": False, "displayModeBar": False}
SHOWN_STATEMENTS = 4


def choose_trial(entries: Sequence[TrialEntry]) -> str | None:
    """Let the user choose a trial; the address may name one already."""
    usable = {entry.id: entry for entry in entries if not entry.is_damaged}
    if not usable:
        st.info(
            "There is no trial yet. Assess a video first, then compare it with a recording of the "
            "same movement from a motion laboratory.",
            icon=":material/list:",
        )
        if st.button("Add a video", type="primary", icon=":material/add:"):
            st.switch_page(pages.NEW_ASSESSMENT)
        return None
    named = state.trial_id()
    ids = list(usable)
    chosen = st.selectbox(
        "Trial",
        ids,
        index=ids.index(named) if named in usable else None,
        format_func=lambda one: _name_entry(usable[one]),
        placeholder="Choose a trial",
    )
    if chosen is None:
        st.caption("Choose the trial that was recorded with another system at the same time.")
        return None
    if chosen != named:
        state.set_trial_id(chosen)
    return chosen


def _name_entry(entry: TrialEntry) -> str:
    name = entry.label or entry.job or "Untitled trial"
    return " · ".join(part for part in (name, entry.subject, when(entry.created)) if part)


def show_subject(trial_id: str) -> None:
    """Show what is known of the trial, and the way to its page."""
    stored = cache.result(trial_id)
    seconds = float(stored.angles.time_s[-1] - stored.angles.time_s[0])
    facts = (
        f"Person {stored.subject.label}",
        f"{seconds:.1f} s",
        f"Joint angles by {stored.document['solver']}",
    )
    st.html(facts_html(facts))


# --------------------------------------------------------------------------- the recording


def ask_reference(trial_id: str) -> None:
    """Ask for a recording; a bundled trial offers its own."""
    with st.container(border=True):
        st.subheader("The reference recording", anchor=False)
        st.caption(
            "Markers or joint angles of the same movement: TRC, C3D, OpenSim MOT or STO, Plug-in "
            "Gait CSV, or a plain table. Unit, axes and names are found out, and you can correct "
            "them. The two recordings need not start at the same time."
        )
        given = st.file_uploader(
            "Recording",
            type=[suffix.removeprefix(".") for suffix in REFERENCE_SUFFIXES],
            key=state.reference_upload_key(),
            label_visibility="collapsed",
        )
        if given is not None:
            cache.save_reference(trial_id, given.name, given)
            state.renew_reference_upload()
            st.rerun()
        sample = cache.sample_reference(trial_id)
        if sample is not None and st.button(
            "Use the markers bundled with this sample",
            type="primary",
            icon=":material/directions_walk:",
            key="sample-reference",
        ):
            with sample.open("rb") as source:
                cache.save_reference(trial_id, sample.name, source)
            st.rerun()


def show_reference(trial_id: str) -> None:
    """Show what was found out about the recording, to confirm or correct; or to remove it."""
    path = cache.reference_file(trial_id)
    name = path.name if path else ""
    try:
        reference = cache.reference(trial_id)
    except EngineError as error:
        with st.container(border=True):
            st.error(str(error), icon=":material/error:", title=f"{name} can't be used as it is")
            _correct(trial_id, None)
        return
    unsure = reference.to_confirm
    words = "please confirm what was found out" if unsure else "what was found out about it"
    with st.expander(f"{name}: {words}", expanded=bool(unsure), icon=":material/fact_check:"):
        head = (("What", ""), ("Found", ""), ("Sure?", ""), ("Because", ""))
        rows = [
            (labels.sentence(f.what).rstrip("."), f.value, "yes" if f.is_sure else "confirm", f.why)
            for f in reference.findings
        ]
        st.html(table_html(head, rows, css="ll-plain"))
        if reference.notes:
            st.html(list_html(reference.notes))
        _correct(trial_id, reference)


def _correct(trial_id: str, reference: Reference | None) -> None:
    """Let the user correct unit, axes and sides, load a profile, or take another file."""
    kept = cache.reference_profile(trial_id) or ImportProfile()
    units, angle_units = [None, "mm", "cm", "m"], [None, "deg", "rad"]
    axes = [None, *labels.AXES]
    with st.form(f"profile-{trial_id}", border=False):
        first, second, third = st.columns(3)
        length = first.selectbox(
            "Unit of length", units, index=_at(units, kept.length_unit), format_func=_or_detected
        )
        angle = second.selectbox(
            "Unit of angles",
            angle_units,
            index=_at(angle_units, kept.angle_unit),
            format_func=_or_detected,
        )
        turned = third.selectbox(
            "Axes to the front, up, right",
            axes,
            index=_at(axes, kept.axes),
            format_func=lambda a: (
                "as detected" if a is None else f"{', '.join(a)} {labels.AXES[a]}"
            ),
        )
        swapped = st.checkbox("Exchange left and right in all names", value=kept.swap_sides)
        with st.container(horizontal=True):
            if st.form_submit_button("Confirm and compare", type="primary"):
                base = describe_profile(reference) if reference else kept
                profile = replace(
                    base,
                    length_unit=length or base.length_unit,
                    angle_unit=angle or base.angle_unit,
                    # Where the front is was found out from left and right.
                    axes=turned or (base.axes if swapped == kept.swap_sides else None),
                    swap_sides=swapped,
                )
                cache.save_reference_profile(trial_id, profile)
                st.rerun()
            if st.form_submit_button("Detect anew"):
                cache.save_reference_profile(trial_id, None)
                st.rerun()
            if st.form_submit_button("Remove this recording", icon=":material/delete:"):
                cache.remove_reference(trial_id)
                st.rerun()


def _at(options: Sequence[object], value: object) -> int:
    return list(options).index(value) if value in options else 0


def _or_detected(value: str | None) -> str:
    return value or "as detected"


def compute(trial_id: str) -> Agreement | None:
    """Compare; a sentence in place of the comparison if that is impossible."""
    try:
        with st.spinner("Comparing …"):
            return cache.agreement(trial_id)
    except EngineError as error:
        if not cache.is_reference_readable(trial_id):
            return None  # said above
        st.error(str(error), icon=":material/error:", title="The two can't be compared")
        st.caption("Correct what was found out above, or remove the recording and choose another.")
        return None


# --------------------------------------------------------------------------- the outcome


def show_statements(agreement: Agreement) -> None:
    """Say in plain words how far the trial is off, and what makes that doubtful."""
    lead, *others = describe_agreement(agreement)
    doubts = [note for trial in agreement.trials for note in trial.notes]
    with st.container(border=True):
        st.markdown(f"#### {labels.typeset(lead)}")
        st.html(list_html(map(labels.typeset, others[:SHOWN_STATEMENTS])))
        if others[SHOWN_STATEMENTS:]:
            with st.expander(f"{len(others) - SHOWN_STATEMENTS} more angles in words"):
                st.html(list_html(map(labels.typeset, others[SHOWN_STATEMENTS:])))
        st.caption(describe_offsets(agreement))
    for note in doubts:
        st.warning(note, icon=":material/warning:")


def _choose_angle(agreement: Agreement, key: str) -> str:
    names = [s.name for s in _seen(agreement.angles)]
    return st.selectbox(
        "Angle",
        names,
        index=_at(names, "trunk_flexion"),
        format_func=labels.name_angle,
        key=key,
        width=360,
    )


def show_curves(agreement: Agreement) -> None:
    """Show both curves of one angle, and their difference with its band."""
    trial = agreement.trials[0]
    name = _choose_angle(agreement, "angle-curves")
    figure = reference_charts.plot_pair(trial, name, dark=is_dark())
    st.plotly_chart(figure, config=CHART, alt=f"{labels.name_angle(name)}: video and reference")
    angle = next(a for a in trial.angles if a.name == name)
    offset = f"{format_number(angle.offset_deg, 1)}°"
    removed = " It was taken out here." if trial.is_offset_removed else ""
    st.caption(
        f"Constant difference (median) {offset}.{removed} The band is the mean difference ± 1.96 "
        "SD. Gaps stay open."
    )


def show_errors(agreement: Agreement) -> None:
    """Show the error of every angle as bars."""
    st.caption("Error of each angle")
    figure = reference_charts.plot_errors(agreement, dark=is_dark())
    st.plotly_chart(figure, config=CHART, alt="Error of each angle")


def show_sides(agreement: Agreement) -> None:
    """Show left beside right; the side away from the camera is usually worse."""
    st.caption("Left beside right: the side that the camera sees worse has larger errors")
    if not find_sides(agreement):
        st.info("No angle was compared on both sides.", icon=":material/search_off:")
        return
    figure = reference_charts.plot_sides(agreement, dark=is_dark())
    st.plotly_chart(figure, config=CHART, alt="Errors of left and right")


def show_spread(agreement: Agreement) -> None:
    """Show box plots of all angles, and difference against mean for one."""
    boxes, limits = st.columns(2, gap="large")
    with boxes:
        st.caption("Half of the frames lie in the box, 95 % between the whiskers")
        figure = reference_charts.plot_boxes(agreement, dark=is_dark())
        st.plotly_chart(figure, config=CHART, alt="Box plots of the differences")
    with limits:
        name = _choose_angle(agreement, "angle-limits")
        figure = reference_charts.plot_bland_altman(agreement, name, dark=is_dark())
        st.plotly_chart(figure, config=CHART, alt="Bland-Altman plot")
        st.caption(
            "Bland-Altman plot: about 95 % of the frames lie between the dashed limits of "
            "agreement. A slope means that the error depends on the angle."
        )


def show_tables(agreement: Agreement) -> None:
    """Show the main figures of every angle, and the rest of the statistics below."""
    seen = _seen(agreement.angles)
    st.html(table_html(labels.MAIN_STATISTICS, [_main_cells(s) for s in seen]))
    with st.expander("All statistics"):
        st.html(table_html(labels.CURVE_STATISTICS, [_curve_cells(s) for s in seen]))
        st.caption(
            "Tests of the mean, equivalence, ICC and minimal detectable change rest on persons, or "
            "on several trials of one person: one trial gives none. Several are pooled "
            "below. A large p is no proof of agreement."
        )


def _main_cells(s: AngleSummary) -> tuple[str, ...]:
    p, limits = s.pooled, s.bland_altman
    return (
        labels.name_angle(s.name),
        _degrees(p.bias_deg),
        _degrees(p.mae_deg),
        _degrees(p.rmse_deg),
        _degrees(p.centred_rmse_deg),
        f"{format_number(limits.lower, 1)} to {format_number(limits.upper, 1)}°",
        _degrees(p.p95_deg),
        f"{p.n_samples}",
        format_number(p.n_effective, 1),
    )


def _curve_cells(s: AngleSummary) -> tuple[str, ...]:
    c = s.trials[0].curve
    return (
        labels.name_angle(s.name),
        format_number(c.r, 2),
        format_number(s.pooled.cmc, 2),
        f"{format_number(c.linear_fit.slope, 2)} · {format_number(c.linear_fit.r2, 2)}",
        _degrees(s.pooled.max_deg),
        _degrees(c.rom_error_deg),
        _degrees(c.maximum.error_deg),
        _seconds(c.maximum.lag_s),
        f"{format_number(c.percent_of_excursion)} %",
        format_number(s.proportional_bias.slope, 3),
    )


def _test_cells(s: AngleSummary) -> tuple[str, ...]:
    motion = next(q for q in s.scalars if q.quantity == "range_of_motion")
    strict, usual = (e.p for e in s.equivalence)
    return (
        labels.name_angle(s.name),
        format_interval(s.bias.interval) or "–",
        _p(s.per_unit.p),
        _p(s.p_holm),
        _p(s.per_frame.corrected.p),
        f"{_p(strict)} · {_p(usual)}",
        format_number(motion.icc.icc_2_1, 2),
        _degrees(motion.mdc_deg),
        _p(s.curve_test.p),
    )


def _degrees(value: float) -> str:
    text = format_number(value, 1)
    return text if text == "–" else f"{text}°"


def _seconds(value: float) -> str:
    text = format_number(value, 2)
    return text if text == "–" else f"{text} s"


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else format_number(value, 3)


def show_method(agreement: Agreement) -> None:
    """Show alignment in time and space, rates, and where joint centres come from."""
    trial = agreement.trials[0]
    st.html(table_html((("How", ""), ("", "")), _method_rows(trial), css="ll-plain"))


def _method_rows(trial: TrialComparison) -> list[tuple[str, str]]:
    time, facts = trial.alignment, trial.reference
    shift = (
        f"{format_number(time.lag_s, 3)} ± {format_number(time.lag_sigma_s, 3)} s, by "
        f"cross-correlation of {len(time.correlations)} angles: correlation "
        f"{time.correlation:.2f}, confidence {time.confidence:.2f}"
    )
    rows = [
        ("Reference", f"{facts.name}, {facts.duration_s:.1f} s at {facts.rate_hz:.4g} Hz"),
        ("Video", f"{trial.result_rate_hz:.4g} pictures a second"),
        ("Angles compared", labels.ANGLE_SOURCES[trial.source].format(solver=trial.solver)),
        ("Shift in time", shift),
    ]
    for found in trial.positions:
        words = labels.POSITION_ALIGNMENTS[found.alignment]
        rows.append(("Joint distance", f"{found.mpjpe_mm:.0f} mm on average {words}"))
    if facts.joint_centres:
        sources = dict.fromkeys(facts.joint_centres.values())
        rows.append(("Joint centres", "; ".join(sources)))
    if trial.missing:
        rows.append(("Not compared", ", ".join(map(labels.name_angle, trial.missing))))
    return rows


def show_pool(trial_id: str, entries: Sequence[TrialEntry]) -> None:
    """Pool this trial with others that have a reference, by person and by task."""
    others = {
        entry.id: _name_entry(entry)
        for entry in entries
        if entry.id != trial_id and cache.reference_file(entry.id) is not None
    }
    if not others:
        st.info(
            "No other trial has a reference yet. One trial says nothing about others: add "
            "references to further trials, and they can be pooled here.",
            icon=":material/group_work:",
        )
        return
    chosen = st.multiselect(
        "Trials to pool with this one", list(others), format_func=others.__getitem__
    )
    pooled = _pool((trial_id, *chosen)) if chosen else None
    if pooled is None:
        return
    show_statements(pooled)
    st.html(table_html(labels.MAIN_STATISTICS, [_main_cells(s) for s in _seen(pooled.angles)]))
    with st.expander("Tests of the difference"):
        st.html(table_html(labels.TEST_STATISTICS, [_test_cells(s) for s in _seen(pooled.angles)]))
    for task, summaries in pooled.tasks.items():
        with st.expander(f"Task: {task or 'none given'}"):
            st.html(table_html(labels.MAIN_STATISTICS, [_main_cells(s) for s in _seen(summaries)]))
    st.download_button(
        "Pooled comparison (zip)",
        lambda: cache.zip_agreement(trial_id, *chosen),
        key="download-pooled",
        file_name="pooled_agreement.zip",
        mime="application/zip",
        icon=":material/folder_zip:",
        on_click="ignore",
    )


def _pool(trial_ids: tuple[str, ...]) -> Agreement | None:
    try:
        with st.spinner("Pooling the trials …"):
            return cache.pooled_agreement(trial_ids)
    except EngineError as error:
        st.error(str(error), icon=":material/error:", title="These trials can't be pooled")
        return None


def _seen(summaries: Sequence[AngleSummary]) -> list[AngleSummary]:
    return [s for s in summaries if s.pooled.n_samples]


def show_downloads(trial_id: str) -> None:
    """Offer everything that `liftlens validate` writes."""
    with st.container(horizontal=True):
        st.download_button(
            "Whole comparison (zip)",
            lambda: cache.zip_agreement(trial_id),
            key="download-agreement",
            file_name=f"{trial_id}_agreement.zip",
            mime="application/zip",
            type="primary",
            icon=":material/folder_zip:",
            on_click="ignore",
            help="agreement.json, tables (CSV), figures (PNG) and a one-page summary (HTML).",
        )
        st.download_button(
            "Import profile",
            cache.reference_profile_text(trial_id),
            key="download-profile",
            file_name="import_profile.toml",
            mime="application/toml",
            icon=":material/download:",
            on_click="ignore",
            help="What was found out about the recording, for `liftlens validate --profile`.",
        )
