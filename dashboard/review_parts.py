"""The player of a trial's page, with what people say to its flags and their notes."""

from __future__ import annotations

import math

import streamlit as st

from dashboard import cache, correct_parts, labels, state
from dashboard.components.player import PlayerEvent, show_player
from dashboard.components.player.payload import describe_flags, order_flags
from dashboard.widgets import show_problem
from engine.datatypes import Flag
from engine.errors import EngineError
from engine.storage.curation import FlagReview, NoteEntry, TrialRecord, flag_key
from engine.storage.results import StoredResult


@st.fragment
def show_review(trial_id: str) -> None:
    """Show the player and, below it, reviews and notes; a change runs only this part again."""
    result, record = cache.result(trial_id), cache.record(trial_id)
    videos = [p for p in (result.overlay_path, result.second_overlay_path) if p is not None]
    if not videos:
        st.info("This trial was saved without its annotated video.", icon=":material/videocam_off:")
    event = show_player(
        cache.player_payload(trial_id),
        describe_flags(result, record),
        videos=videos,
        notes=[{"time": note.at_s, "text": note.text} for note in record.notes],
        actions=labels.PLAYER_ACTIONS,
        key=f"player-{trial_id}-{result.document['created']}",
    )
    if event is not None and state.take_player_event(trial_id, event.number):
        _follow(trial_id, event)
    show_problem(state.take_review_problem())
    review, notes = st.columns([6, 5], gap="large")
    with review:
        _show_flag_review(trial_id, result, record)
    with notes:
        _show_notes(trial_id, record)
    correct_parts.show_corrections(trial_id, result, record)


def _follow(trial_id: str, event: PlayerEvent) -> None:
    if event.flag:
        state.set_review_value(trial_id, "flag", event.flag)
    if event.action == "note":
        state.set_note_time(trial_id, round(event.time_s, 2))
    elif event.action in correct_parts.MARKS:
        correct_parts.mark_moment(trial_id, event.action, event.time_s)


# --------------------------------------------------------------------------- flags


def _show_flag_review(trial_id: str, result: StoredResult, record: TrialRecord) -> None:
    st.subheader("Do you agree with the flags?", anchor=False)
    flags = {flag_key(flag): flag for flag in order_flags(result.flags)}
    if not flags:
        st.caption("No flag was raised.")
        return
    if state.review_value(trial_id, "flag") not in flags:
        state.set_review_value(trial_id, "flag", next(iter(flags)))
    chosen = st.selectbox(
        "Flag",
        list(flags),
        format_func=lambda key: _flag_title(flags[key], record),
        key=state.review_key(trial_id, "flag"),
    )
    flag = flags[chosen]
    said = record.verdict(flag)
    if said is not None:
        st.caption(_said(said))
    with st.form(f"review-{trial_id}", border=True):
        st.segmented_control(
            "Your answer",
            list(labels.ANSWERS),
            format_func=labels.ANSWERS.__getitem__,
            key=state.review_key(trial_id, "verdict"),
            required=True,
            default="accepted",
        )
        st.text_input(
            "Why (needed to reject)",
            key=state.review_key(trial_id, "reason"),
            placeholder="For example: the load was pushed, not carried",
        )
        st.text_input("Your name or initials", key=state.REVIEWER_KEY)
        st.form_submit_button(
            "Save the answer",
            icon=":material/rate_review:",
            # Bound to what is on the screen: a change by somebody else meanwhile is noticed.
            on_click=_keep_review,
            args=(trial_id, flag, record.version),
        )


def _flag_title(flag: Flag, record: TrialRecord) -> str:
    said = record.verdict(flag)
    when = "" if math.isnan(flag.start_s) else f" ({flag.start_s:.1f} s)"
    answer = f" – {labels.REVIEWS[said.verdict]}" if said else ""
    return f"{labels.LEVELS[flag.level].word}: {labels.typeset(flag.what)}{when}{answer}"


def _said(said: FlagReview) -> str:
    who = f" by {said.reviewer}" if said.reviewer else ""
    why = f": “{said.reason}”" if said.reason else "."
    answer = labels.REVIEWS[said.verdict].capitalize()
    return f"{answer}{who}, {labels.format_time(said.created)}{why}"


def _keep_review(trial_id: str, flag: Flag, version: int) -> None:
    try:
        cache.library().review(
            trial_id,
            flag,
            state.review_value(trial_id, "verdict", "accepted"),
            version=version,
            reason=state.review_value(trial_id, "reason", ""),
            reviewer=state.reviewer(),
        )
    except EngineError as error:
        state.set_review_problem(str(error))
        return
    state.set_review_value(trial_id, "reason", "")


# --------------------------------------------------------------------------- notes


def _show_notes(trial_id: str, record: TrialRecord) -> None:
    st.subheader("Notes", anchor=False)
    for note in record.notes:
        _show_note(trial_id, note)
    if not record.notes:
        st.caption("No notes yet.")
    at_s = state.note_time(trial_id)
    with st.form(f"note-{trial_id}", border=True):
        st.text_area(
            "Note on the whole video" if at_s is None else f"Note at {at_s:.2f} s",
            key=state.review_key(trial_id, "note"),
            height=80,
        )
        st.form_submit_button(
            "Add the note", icon=":material/note_add:", on_click=_keep_note, args=(trial_id, at_s)
        )
    if at_s is not None:
        st.button(
            "About the whole video instead",
            type="tertiary",
            on_click=state.set_note_time,
            args=(trial_id, None),
        )


def _show_note(trial_id: str, note: NoteEntry) -> None:
    when = "" if note.at_s is None else f"at {note.at_s:.2f} s"
    facts = (when, note.author, labels.format_time(note.created))
    with st.container(border=True):
        words, delete = st.columns([9, 1], vertical_alignment="center")
        words.text(note.text)
        words.caption(" · ".join(fact for fact in facts if fact))
        delete.button(
            "",
            icon=":material/delete:",
            type="tertiary",
            key=state.review_key(trial_id, f"delete-{note.id}"),
            help="Delete this note",
            on_click=_drop_note,
            args=(trial_id, note.id),
        )


def _keep_note(trial_id: str, at_s: float | None) -> None:
    try:
        cache.library().add_note(
            trial_id, state.review_value(trial_id, "note", ""), author=state.reviewer(), at_s=at_s
        )
    except EngineError as error:
        state.set_review_problem(str(error))
        return
    state.set_review_value(trial_id, "note", "")
    state.set_note_time(trial_id, None)


def _drop_note(trial_id: str, note_id: int) -> None:
    try:
        cache.library().delete_note(trial_id, note_id)
    except EngineError as error:
        state.set_review_problem(str(error))
