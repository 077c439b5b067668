"""The parts of the page that compares how two movements were performed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from html import escape

import streamlit as st

from dashboard import cache, labels, pages, state, train_charts
from dashboard.components.pair import build_pair, show_pair
from dashboard.labels import PHASES, count, format_number, name_angle
from dashboard.widgets import is_dark, list_html, table_html, when
from engine.datatypes import Measurement
from engine.errors import DataError, EngineError
from engine.form import Comparison, Repetition, advise
from engine.form.compare import order_angles
from engine.storage.library import TrialEntry

CHART = {"displaylogo": False, "displayModeBar": False}
INTRODUCTION = (
    "How an attempt was performed beside a reference: yours from another day, or your trainer's. "
    "Movements are aligned in time first, so that postures at the same point are compared."
)
MOST_SESSIONS = 40
"""Trials of one person in the progress chart; the latest ones."""
SHOWN_ANGLES = 2


@dataclass(frozen=True)
class Pair:
    """What is compared: trials by id, repetitions from 0."""

    reference: str
    attempt: str
    reference_repetition: int = 0
    attempt_repetition: int = 0


def choose_pair(entries: Sequence[TrialEntry]) -> Pair | None:
    """Let the user choose reference and attempt, and their repetitions."""
    usable = {entry.id: entry for entry in entries if not entry.is_damaged}
    if not usable:
        st.info("There is no trial yet. Assess a video first.", icon=":material/list:")
        if st.button("Add a video", type="primary", icon=":material/add:"):
            st.switch_page(pages.NEW_ASSESSMENT)
        return None
    first, second = _defaults(usable)
    left, right = st.columns(2, gap="large")
    with left:
        reference = _choose_trial("Reference: as it should be", usable, first)
        one = _choose_repetition(reference, "reference")
    with right:
        attempt = _choose_trial("Attempt", usable, second)
        two = _choose_repetition(attempt, "attempt")
    state.set_compared(reference, attempt)
    if len(usable) == 1:
        st.info(
            "There is only one trial, so that it is compared with itself. Assess a second "
            "video of the same lift or exercise.",
            icon=":material/info:",
        )
    return Pair(reference, attempt, one, two)


def _defaults(usable: dict[str, TrialEntry]) -> tuple[str, str]:
    """Return what is compared at first: as the address says, or the two latest with lifts."""
    named_reference, named_attempt = state.compared()
    lifted = [e.id for e in usable.values() if e.n_lifts] or list(usable)
    attempt = named_attempt if named_attempt in usable else lifted[0]
    assert attempt is not None  # one of the usable
    same = [i for i in lifted if i != attempt and usable[i].subject == usable[attempt].subject]
    others = [*same, *(i for i in lifted if i != attempt), attempt]
    reference = named_reference if named_reference in usable else others[0]
    assert reference is not None
    return reference, attempt


def _choose_trial(title: str, usable: dict[str, TrialEntry], chosen: str) -> str:
    # Without a key, so that another trial in the address is shown at once.
    ids = list(usable)
    found = st.selectbox(
        title,
        ids,
        index=ids.index(chosen),
        format_func=lambda one: _name_entry(usable[one]),
    )
    return str(found)


def _name_entry(entry: TrialEntry) -> str:
    name = entry.label or entry.job or "Untitled trial"
    return " · ".join(part for part in (name, entry.subject, when(entry.created)) if part)


def _choose_repetition(trial_id: str, role: str) -> int:
    try:
        found = cache.repetitions(trial_id)
    except EngineError as error:
        st.caption(str(error))
        return 0
    if len(found) < 2:
        st.caption(_describe_repetition(found[0]) if found else "No whole movement was found.")
        return 0
    word = "Lift" if found[0].kind == "lift" else "Repetition"
    chosen = st.pills(
        f"{word} of the {role}",
        range(len(found)),
        default=0,
        format_func=lambda k: f"{word} {k + 1}",
        required=True,
        key=state.train_key(f"{role}_{trial_id}_repetition"),
    )
    return int(chosen or 0)


def _describe_repetition(one: Repetition) -> str:
    word = "One lift" if one.kind == "lift" else "One repetition"
    return f"{word}, {one.start_s:.1f} s to {one.end_s:.1f} s"


def compute(pair: Pair) -> Comparison | None:
    """Return the comparison; where it is refused, say why and what to do."""
    try:
        found = cache.form_comparisons(pair.reference, pair.attempt, pair.reference_repetition)
    except EngineError as error:
        st.warning(str(error), icon=":material/compare_arrows:")
        return None
    return found[min(pair.attempt_repetition, len(found) - 1)]


# --------------------------------------------------------------------------- words


def show_score(comparison: Comparison) -> None:
    """Show the score, and three sentences of advice."""
    low, high = comparison.score.interval
    under = (
        "the same within the measurement error"
        if comparison.score.value >= 99.5
        else (f"{comparison.score.difference_deg:.0f}° beyond the measurement error, on average")
    )
    tile = (
        f'<div class="ll-tile" title="{escape(labels.HELP["form_score"])}">'
        '<div class="ll-name">Score</div>'
        f'<div class="ll-number">{comparison.score.value:.0f}</div>'
        f'<div class="ll-small">of 100, between {low:.0f} and {high:.0f}</div>'
        f'<div class="ll-quiet ll-small">{escape(under)}</div></div>'
    )
    score, words = st.columns([1, 3], gap="large", vertical_alignment="center")
    with score:
        st.html(tile)
    with words:
        st.html(list_html(map(labels.typeset, advise(comparison)), tag="ol"))
    for note in comparison.notes:
        st.caption(f":material/info: {labels.typeset(note)}")


def show_videos(pair: Pair, comparison: Comparison) -> None:
    """Show both annotated videos on one cursor."""
    paths = [cache.result(name).overlay_path for name in (pair.reference, pair.attempt)]
    if None in paths:
        st.info(
            "One of the trials has no annotated video, so that they can't be shown together.",
            icon=":material/videocam_off:",
        )
        return
    moments = [(PHASES[p.key], p.start_s) for p in comparison.phases if not p.is_moment]
    show_pair(
        build_pair(comparison.reference_time_s, comparison.attempt_time_s, moments),
        [path for path in paths if path is not None],
        (f"Reference: {comparison.reference}", f"Attempt: {comparison.attempt}"),
        key=f"pair-{pair.reference}-{pair.attempt}-{pair.reference_repetition}"
        f"-{pair.attempt_repetition}",
    )
    st.caption(
        "The reference runs at its own speed; the attempt is slowed or hastened so that both are "
        "at the same point of the movement."
    )


# --------------------------------------------------------------------------- curves and tables


@st.fragment
def show_curves(comparison: Comparison) -> None:
    """Show the aligned curves; those that differ most first."""
    ordered = order_angles(comparison)
    chosen = st.multiselect(
        "Joint angles",
        ordered,
        default=ordered[:SHOWN_ANGLES],
        format_func=name_angle,
        help="In the order of how clearly they differ.",
        key=state.train_key(f"angles_{'_'.join(ordered)}"),
    )
    if not chosen:
        st.caption("Choose at least one angle.")
    for row in range(0, len(chosen), 2):
        for column, name in zip(st.columns(2, gap="large"), chosen[row : row + 2], strict=False):
            with column:
                st.plotly_chart(
                    train_charts.plot_aligned(comparison, name, dark=is_dark()),
                    config=CHART,
                    key=state.train_key(f"chart_{name}"),
                    alt=f"{name_angle(name)} of reference and attempt over the movement",
                )
    st.caption(
        "Grey: the difference goes beyond the measurement error (95 %). Bands hold that part of "
        "the error which does not repeat from clip to clip."
    )


def show_phases(comparison: Comparison) -> None:
    """Show the mean difference of every angle in every phase, and how long each took."""
    head = [("Angle", ""), *((PHASES[p.key], labels.PHASE_HELP[p.key]) for p in comparison.phases)]
    by_key = {(d.angle, d.phase): d for d in comparison.differences}
    rows = []
    for name in comparison.names:
        found = [by_key[name, p.key] for p in comparison.phases]
        cells = [_format_difference(d.mean, is_clear=d.is_beyond_error) for d in found]
        rows.append((name_angle(name), *cells))
    timed = {t.phase: t for t in comparison.timings}
    seconds = [
        _format_seconds(timed[p.key].difference_s, is_clear=timed[p.key].is_beyond_error)
        if p.key in timed
        else "–"
        for p in comparison.phases
    ]
    rows.append(("Time taken", *seconds))
    st.html(table_html(head, rows, "ll-wide"))
    st.caption(
        "Attempt minus reference, ± 95 %. ● marks differences beyond the measurement error; the "
        "others can't be told from none."
    )


def _format_difference(value: Measurement, *, is_clear: bool) -> str:
    mark = "● " if is_clear else ""
    return f"{mark}{_signed(value.value, 0)}° ± {1.96 * value.sigma:.0f}°"


def _format_seconds(value: Measurement, *, is_clear: bool) -> str:
    mark = "● " if is_clear else ""
    sure = "" if value.sigma != value.sigma else f" ± {1.96 * value.sigma:.1f} s"
    return f"{mark}{_signed(value.value, 1)} s{sure}"


def _signed(value: float, digits: int) -> str:
    text = format_number(value, digits)
    return f"+{text}" if value > 0 and text.strip("0.") else text


def show_repetitions(pair: Pair) -> None:
    """Show every repetition of the attempt with its score, tempo, range and symmetry."""
    found = cache.form_comparisons(pair.reference, pair.attempt, pair.reference_repetition)
    measured = {r.number: r for r in cache.repetitions(pair.attempt)}
    phases = [t.phase for t in found[0].timings]
    head = [
        ("Repetition", ""),
        ("Score", labels.HELP["form_score"]),
        ("Whole", "Length of the whole movement"),
        *((PHASES[p], labels.PHASE_HELP[p]) for p in phases),
        ("Range of forward bend", "Largest minus smallest angle of the trunk"),
        ("Left and right", "The largest mean difference between the sides beyond the error"),
    ]
    rows = []
    for one in found:
        low, high = one.score.interval
        span = one.attempt_time_s[-1] - one.attempt_time_s[0]
        repetition = measured.get(one.attempt_repetition)
        rows.append(
            (
                f"{one.attempt_repetition + 1}, from {one.attempt_time_s[0]:.1f} s",
                f"{one.score.value:.0f} ({low:.0f} to {high:.0f})",
                f"{span:.1f} s",
                *(f"{t.attempt_s.value:.1f} s" for t in one.timings),
                _bend_range(repetition),
                _symmetry(repetition),
            )
        )
    st.html(table_html(head, rows, "ll-wide"))


def _bend_range(one: Repetition | None) -> str:
    found = None if one is None else one.range_of_motion_deg.get("trunk_flexion")
    if found is None or found.is_missing:
        return labels.MISSING
    return f"{found.value:.0f}° ± {1.96 * found.sigma:.0f}°"


def _symmetry(one: Repetition | None) -> str:
    if one is None or not one.asymmetry_deg:
        return "only one side seen"
    name, worst = max(
        one.asymmetry_deg.items(), key=lambda item: abs(item[1].value) / item[1].sigma
    )
    low, high = worst.interval()
    if low <= 0 <= high:
        return "no difference beyond the error"
    title = name_angle(f"{name}_l").split(",")[0]
    side = "left" if worst.value > 0 else "right"
    return f"{title}: {side} {abs(worst.value):.0f}° more"


# --------------------------------------------------------------------------- progress


def show_progress(pair: Pair, entries: Sequence[TrialEntry]) -> None:
    """Show the scores of the same person's trials against the same reference, over time."""
    subject = next(entry.subject for entry in entries if entry.id == pair.attempt)
    same = [e for e in entries if e.subject == subject and not e.is_damaged][:MOST_SESSIONS]
    points, left_out = [], 0
    for entry in same:
        point = _score_entry(pair, entry)
        if point is None:
            left_out += 1
        else:
            points.append(point)
    if len(points) > 1:
        st.plotly_chart(
            train_charts.plot_progress(points, dark=is_dark()),
            config=CHART,
            key=state.train_key("progress"),
            alt=f"Scores of person {subject} over time, against the chosen reference",
        )
    else:
        st.info(
            f"There is one session of person {subject} so far. Film the same movement again, and "
            "its score appears here.",
            icon=":material/trending_up:",
        )
    notes = "Scores against the chosen reference, with 95 % intervals; ◆ is the attempt above. "
    if left_out:
        notes += (
            f"{count(left_out, 'trial')} of this person left out: another movement, or a lift "
            "between other heights."
        )
    st.caption(notes)


def _score_entry(pair: Pair, entry: TrialEntry) -> train_charts.ScorePoint | None:
    try:
        found = cache.form_comparisons(pair.reference, entry.id, pair.reference_repetition)
    except EngineError:
        return None
    is_shown = entry.id == pair.attempt
    number = min(pair.attempt_repetition, len(found) - 1) if is_shown else 0
    if not (found[number].is_same_work or is_shown):
        return None
    return train_charts.ScorePoint(
        when=_read_time(entry.created),
        score=found[number].score,
        title=entry.label or entry.id,
        is_shown_now=is_shown,
    )


def _read_time(created: str) -> datetime:
    try:
        return datetime.fromisoformat(created)
    except ValueError:
        raise DataError(f"A trial has no readable date ({created!r}).") from None


def show_method(comparison: Comparison) -> None:
    """Say how the numbers came about, in short."""
    st.html(list_html(_describe_method(comparison)))


def _describe_method(comparison: Comparison) -> Iterator[str]:
    yield (
        "Movements are aligned by dynamic time warping of all angles and the hands' height; no "
        "moment is stretched or squeezed more than threefold. Speed is reported apart."
    )
    share = comparison.own_error_share
    if share < 1:
        yield (
            "Both clips were measured in the same way, so that most of an angle's error is the "
            f"same in both and cancels in the difference: {share:.0%} of it is taken to differ, "
            "more than was found on synthetic lifts with known truth."
        )
    else:
        yield (
            "The clips were measured in different ways, so that the whole stated errors count in "
            "the differences."
        )
    yield (
        "The score halves with every 15° (root mean square over angles and time) beyond the "
        "measurement error. It says how alike two movements are, not how healthy one is."
    )
    yield f"Likeness of the two movements: {comparison.likeness:.2f} (1 = the same course)."
