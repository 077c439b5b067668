"""What a user puts right in a trial: lifts, sides, the person; and the recomputation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import streamlit as st

from dashboard import cache, labels, state
from dashboard.widgets import show_job_status, show_problem
from engine.corrections import (
    LIMBS,
    Correction,
    Corrections,
    PersonChoice,
    SideSwap,
    Span,
    check_lift,
    check_pictures,
    describe_correction,
    find_limb,
    read_corrections,
)
from engine.errors import EngineError
from engine.jobs.local import JobQueue, JobState
from engine.jobs.renewal import ask_again
from engine.people_picture import Box, draw_boxes, find_people, read_clocks, read_moment
from engine.storage.curation import TrialRecord
from engine.storage.results import StoredResult

C = TypeVar("C", bound=Correction)

POLL_S = 0.7
MARKS = {"from": "from_s", "to": "to_s"}
"""What the player's actions of these names fill in."""
MISSED = -1
"""The choice of a lift that was not found."""
ANOTHER_PLACE = -1
"""The choice of a person who was not seen."""


# --------------------------------------------------------------------------- the recomputation


def show_renewal(trial_id: str) -> None:
    """Show the assessment that is being made anew, if there is one, and how it ended."""
    queue = cache.job_queue()
    jobs = queue.renewals(trial_id)
    if any(not job.state.is_over for job in jobs):
        _poll(queue, trial_id)
    elif jobs and jobs[-1].state is JobState.FAILED:
        failed = jobs[-1]
        st.error(failed.message, icon=":material/error:", title="The correction was not computed")
        st.button("Dismiss", key="dismiss-renewal", on_click=queue.forget, args=(failed.id,))


@st.fragment(run_every=POLL_S)
def _poll(queue: JobQueue, trial_id: str) -> None:
    running = [job for job in queue.renewals(trial_id) if not job.state.is_over]
    if not running:
        st.rerun()
    with st.container(border=True):
        st.markdown("**This trial is being assessed anew**")
        show_job_status(running[-1])
        st.button(
            "Cancel",
            key="cancel-renewal",
            icon=":material/close:",
            on_click=queue.cancel,
            args=(running[-1].id,),
        )


# --------------------------------------------------------------------------- the form


def mark_moment(trial_id: str, action: str, time_s: float) -> None:
    """Take the moment of the player's cursor as the start or end of what is corrected."""
    state.set_review_value(trial_id, MARKS[action], round(time_s, 2))
    state.set_review_value(trial_id, "is_correcting", True)
    if action == "from":
        state.set_review_value(trial_id, "at_s", round(time_s, 2))


def show_corrections(trial_id: str, result: StoredResult, record: TrialRecord) -> None:
    """Let the user correct a trial; what is not computed yet is kept for the visit."""
    stored = read_corrections(result.document)
    draft: Corrections = state.review_value(trial_id, "draft", stored)
    if state.review_value(trial_id, "draft_of") != result.document["created"]:
        draft = stored
        state.set_review_value(trial_id, "draft", draft)
        state.set_review_value(trial_id, "draft_of", result.document["created"])
        cache.uncorrected_angles.clear()  # of an earlier version, maybe
    number = f": {labels.count(len(stored.all), 'correction')}" if stored.all else ""
    is_open = bool(state.review_value(trial_id, "is_correcting", False)) or draft != stored
    with st.expander(f"Put something right{number}", icon=":material/edit_note:", expanded=is_open):
        st.caption(
            "Move the player's cursor, press “Correct from here” and “Correct to here” below it, "
            "and say what is wrong. What was seen in the video stays as it is; every correction "
            "can be taken back."
        )
        kind = st.segmented_control(
            "What is wrong?",
            list(labels.CORRECTIONS),
            format_func=labels.CORRECTIONS.__getitem__,
            default="lift",
            required=True,
            key=state.review_key(trial_id, "kind"),
        )
        ask = {"lift": _ask_lift, "sides": _ask_sides, "person": _ask_person}[kind or "lift"]
        try:
            ask(trial_id, result)
        except EngineError as error:
            show_problem(str(error))
        show_problem(state.review_value(trial_id, "wrong"))
        state.set_review_value(trial_id, "wrong", "")
        _list_corrections(trial_id, stored, draft)
        _offer_renewal(trial_id, result, record, stored, draft)
    if state.review_value(trial_id, "is_started"):
        state.set_review_value(trial_id, "is_started", False)
        st.rerun()


def _change(trial_id: str, change: Callable[[Corrections], Corrections]) -> None:
    """Change what is to be corrected, or say why not."""
    try:
        draft = change(_draft(trial_id))
    except EngineError as error:
        state.set_review_value(trial_id, "wrong", str(error))
        return
    state.set_review_value(trial_id, "draft", draft)
    state.set_review_value(trial_id, "is_correcting", True)


def _draft(trial_id: str) -> Corrections:
    found: Corrections = state.review_value(trial_id, "draft", Corrections())
    return found


def _ask_stretch(trial_id: str, result: StoredResult, start: str, end: str) -> None:
    """Ask for a start and an end, in the trial's time; the player's cursor fills both."""
    time_s = result.corrected.time_s
    low, high = float(time_s[0]), float(time_s[-1])
    step = round(1 / max(result.views[0].info.fps, 1.0), 3)
    for column, title, field, otherwise in zip(
        st.columns(2), (start, end), ("from_s", "to_s"), (low, high), strict=True
    ):
        if state.review_value(trial_id, field) is None:
            state.set_review_value(trial_id, field, round(otherwise, 2))
        column.number_input(
            title, step=step, format="%.2f", key=state.review_key(trial_id, field),
            help=f"The video runs from {low:.2f} to {high:.2f} s.",
        )  # fmt: skip


def _stretch(trial_id: str) -> Span:
    return (
        float(state.review_value(trial_id, "from_s", 0.0)),
        float(state.review_value(trial_id, "to_s", 0.0)),
    )


# --------------------------------------------------------------------------- lifts


def _ask_lift(trial_id: str, result: StoredResult) -> None:
    spans = [(lift.start_s, lift.end_s) for lift in result.lifts]
    options = [*range(len(spans)), MISSED]
    if state.review_value(trial_id, "lift") not in options:
        state.set_review_value(trial_id, "lift", options[0])
        _take_lift_times(trial_id, spans)
    chosen = st.selectbox(
        "Which lift",
        options,
        format_func=lambda n: (
            "A lift that was missed"
            if n == MISSED
            else f"Lift {n + 1}, {labels.format_window(*spans[n])}"
        ),
        key=state.review_key(trial_id, "lift"),
        on_change=_take_lift_times,
        args=(trial_id, spans),
    )
    _ask_stretch(trial_id, result, "The load leaves its place (s)", "The load is down (s)")
    shown = None if chosen == MISSED else spans[chosen]
    with st.container(horizontal=True):
        st.button(
            "Add this lift" if shown is None else "Set these times",
            icon=":material/check:",
            key="correct-lift",
            on_click=_correct_lift,
            args=(trial_id, result, shown),
            kwargs={"is_lift": True},
        )
        if shown is not None:
            st.button(
                "This is no lift",
                icon=":material/delete:",
                key="no-lift",
                on_click=_correct_lift,
                args=(trial_id, result, shown),
                kwargs={"is_lift": False},
            )


def _take_lift_times(trial_id: str, spans: Sequence[Span]) -> None:
    chosen = state.review_value(trial_id, "lift")
    if chosen is not None and chosen != MISSED:
        for field, moment in zip(("from_s", "to_s"), spans[chosen], strict=True):
            state.set_review_value(trial_id, field, round(moment, 2))


def _correct_lift(
    trial_id: str, result: StoredResult, shown: Span | None, *, is_lift: bool
) -> None:
    actual = _stretch(trial_id) if is_lift else None
    spans = [(lift.start_s, lift.end_s) for lift in result.lifts]
    time_s = result.corrected.time_s

    def change(draft: Corrections) -> Corrections:
        if actual is not None:
            gone = (shown, *draft.not_lifts)
            others = [span for span in spans if span not in gone]
            check_lift(actual, clip=(float(time_s[0]), float(time_s[-1])), others=others)
        return draft.correct_lift(shown, actual)

    _change(trial_id, change)


# --------------------------------------------------------------------------- sides


def _ask_sides(trial_id: str, result: StoredResult) -> None:
    limb, video = st.columns(2)
    limb.selectbox(
        "What is exchanged",
        list(LIMBS),
        format_func=labels.LIMBS.__getitem__,
        key=state.review_key(trial_id, "limb"),
        help=(
            "The annotated video draws the person's left side blue and the right side orange. "
            "Left and right are the person's own."
        ),
    )
    with video:
        _ask_view(trial_id, result)
    _ask_stretch(trial_id, result, "From (s)", "To (s)")
    st.button(
        "Exchange left and right",
        icon=":material/swap_horiz:",
        key="correct-sides",
        on_click=_correct_sides,
        args=(trial_id, result),
    )


def _ask_view(trial_id: str, result: StoredResult) -> int:
    views = range(len(result.views))
    if len(views) == 1:
        return 0
    return st.selectbox(
        "In which video",
        views,
        format_func=lambda n: f"Video {n + 1}: {result.views[n].info.file_name}",
        key=state.review_key(trial_id, "view"),
    )


def _correct_sides(trial_id: str, result: StoredResult) -> None:
    view = int(state.review_value(trial_id, "view", 0) or 0)
    clock = read_clocks(result)[view]
    limb = state.review_value(trial_id, "limb", "body")
    start_s, end_s = (clock.to_view(moment) for moment in _stretch(trial_id))
    keypoints = find_limb(result.views[view].image.skeleton, limb)
    _add(trial_id, result, lambda: SideSwap(start_s, end_s, view, keypoints))


def _add(trial_id: str, result: StoredResult, make: Callable[[], SideSwap | PersonChoice]) -> None:
    def change(draft: Corrections) -> Corrections:
        one = make()
        check_pictures(one, [view.image.time_s for view in result.views])
        return draft.add(one)

    _change(trial_id, change)


# --------------------------------------------------------------------------- the person


def _ask_person(trial_id: str, result: StoredResult) -> None:
    if result.overlay_path is None:
        st.info("This trial was saved without its annotated video, so nobody can be shown.")
        return
    view = _ask_view(trial_id, result)
    time_s = result.corrected.time_s
    low, high = round(float(time_s[0]), 2), round(float(time_s[-1]), 2)
    if not low < high:
        st.info("There is a single picture, so there is nothing to follow.")
        return
    start = state.review_value(trial_id, "at_s", low)
    state.set_review_value(trial_id, "at_s", min(max(start, low), high))
    at_s = st.slider(
        "From this moment on (s)", low, high, step=0.02, key=state.review_key(trial_id, "at_s"),
        help="Choose the first picture in which the wrong person is marked.",
    )  # fmt: skip
    clock = read_clocks(result)[view]
    people = find_people(result, view, clock.to_view(at_s))
    options = [*range(len(people.boxes)), ANOTHER_PLACE]
    chosen = st.radio(
        "Whom to follow",
        options,
        index=1 if len(people.boxes) > 1 and people.is_followed else 0,
        format_func=lambda n: _name_person(n, is_followed=people.is_followed),
        horizontal=True,
        key=state.review_key(trial_id, f"person-{view}-{people.time_s:.3f}"),
    )
    width, height = result.views[view].info.size_px
    box = _ask_box(trial_id, width, height) if chosen == ANOTHER_PLACE else people.boxes[chosen]
    boxes = (*people.boxes, box) if chosen == ANOTHER_PLACE else people.boxes
    picture = read_moment(result, view, at_s)
    shown = draw_boxes(picture, boxes, width_px=width, chosen=boxes.index(box))
    st.image(shown, caption=f"{at_s:.2f} s: the thick box is followed from here on.")
    st.button(
        "Follow this person",
        icon=":material/person_search:",
        key="correct-person",
        on_click=_add,
        args=(trial_id, result, lambda: PersonChoice(people.time_s, box, view)),
    )


def _name_person(number: int, *, is_followed: bool) -> str:
    if number == ANOTHER_PLACE:
        return "Somebody else: draw a box"
    return f"{number + 1}: followed now" if is_followed and number == 0 else f"{number + 1}"


def _ask_box(trial_id: str, width: int, height: int) -> Box:
    across, down = st.columns(2)
    left, right = across.slider(
        "From left to right (px)", 0, width, (width // 3, 2 * width // 3),
        key=state.review_key(trial_id, "box-x"),
    )  # fmt: skip
    top, bottom = down.slider(
        "From top to bottom (px)", 0, height, (height // 6, height),
        key=state.review_key(trial_id, "box-y"),
    )  # fmt: skip
    return float(left), float(top), float(right), float(bottom)


# --------------------------------------------------------------------------- what is corrected


def _list_corrections(trial_id: str, stored: Corrections, draft: Corrections) -> None:
    if draft.all:
        st.markdown("**Corrections**")
    for number, one in enumerate(draft.all):
        is_new = one not in stored.all
        with st.container(border=True):
            words, back = st.columns([8, 3], vertical_alignment="center")
            words.text(labels.sentence(labels.typeset(describe_correction(one))))
            words.caption("Not computed yet" if is_new else _credit(one))
            back.button(
                "Take back",
                icon=":material/undo:",
                type="tertiary",
                key=f"take-back-{number}",
                on_click=_take_back,
                args=(trial_id, one),
            )
    gone = [one for one in stored.all if one not in draft.all]
    if gone:
        said = "; ".join(labels.typeset(describe_correction(one)) for one in gone)
        st.caption(f"Taken back, not computed yet: {said}.")


def _credit(one: Correction) -> str:
    who = f"by {one.by}" if one.by else "by hand"
    when = labels.format_time(datetime.fromisoformat(one.on)) if one.on else ""
    return f"Corrected {who}" + (f", {when}" if when else "")


def _take_back(trial_id: str, one: Correction) -> None:
    state.set_review_value(trial_id, "draft", _draft(trial_id).remove(one))


def _offer_renewal(
    trial_id: str,
    result: StoredResult,
    record: TrialRecord,
    stored: Corrections,
    draft: Corrections,
) -> None:
    """Offer to compute what was corrected; another person needs the video again."""
    if draft == stored:
        return
    videos = _find_videos(trial_id, result)
    is_ready = set(draft.persons) == set(stored.persons) or bool(videos)
    if not is_ready:
        videos = _ask_videos(trial_id, result)
        is_ready = bool(videos)
    name, compute = st.columns([3, 2], vertical_alignment="bottom")
    name.text_input(
        "Corrected by", state.reviewer(), key=state.review_key(trial_id, "corrector"),
        placeholder="Your name or initials",
    )  # fmt: skip
    with compute.container(horizontal=True):
        st.button(
            "Compute anew",
            type="primary",
            icon=":material/refresh:",
            key="renew",
            disabled=not is_ready,
            # Bound to what is on the screen: a change by somebody else meanwhile is noticed.
            on_click=_start,
            args=(trial_id, record.version, stored, videos),
        )
        st.button(
            "Discard",
            key="discard-corrections",
            on_click=_discard,
            args=(trial_id, stored),
        )


def _discard(trial_id: str, stored: Corrections) -> None:
    state.set_review_value(trial_id, "draft", stored)
    state.set_review_value(trial_id, "is_correcting", False)


def _start(trial_id: str, version: int, stored: Corrections, videos: Sequence[Path]) -> None:
    """Put the recomputation into the queue, or say why not."""
    by = str(state.review_value(trial_id, "corrector", "") or "").strip()
    on = datetime.now(UTC).isoformat(timespec="seconds")
    draft = _draft(trial_id)
    signed = Corrections(
        lifts=tuple(_sign(c, stored.lifts, by, on) for c in draft.lifts),
        swaps=tuple(_sign(c, stored.swaps, by, on) for c in draft.swaps),
        persons=tuple(_sign(c, stored.persons, by, on) for c in draft.persons),
        only_these_lifts=draft.only_these_lifts,
    )
    try:
        request = ask_again(cache.library(), trial_id, signed, version=version, videos=videos)
        cache.job_queue().submit(request)
    except EngineError as error:
        state.set_review_value(trial_id, "wrong", str(error))
        return
    state.set_review_value(trial_id, "is_correcting", False)
    state.set_review_value(trial_id, "is_started", True)


def _sign(one: C, stored: Sequence[C], by: str, on: str) -> C:
    """Return a correction with who made it, and when; an earlier one as it was signed."""
    earlier = next((c for c in stored if c == one), None)
    return dataclasses.replace(one, by=by, on=on) if earlier is None else earlier


# --------------------------------------------------------------------------- the video again


def _find_videos(trial_id: str, result: StoredResult) -> tuple[Path, ...]:
    """Return the videos of a trial where they are still there: of samples, or given again."""
    given = [state.review_value(trial_id, f"video-{n}") for n in range(len(result.views))]
    if all(path is not None and path.is_file() for path in given):
        return tuple(given)
    wanted = [view.info.sha256 for view in result.views]
    for sample in cache.samples():
        if len(sample.videos) >= len(wanted):
            known = {_find_fingerprint(str(path)): path for path in sample.videos}
            if set(wanted) <= set(known):
                return tuple(known[one] for one in wanted)
    return ()


@st.cache_data(show_spinner=False)
def _find_fingerprint(path: str) -> str:
    return cache.video_facts(Path(path)).sha256


def _ask_videos(trial_id: str, result: StoredResult) -> tuple[Path, ...]:
    """Ask for the videos that were assessed; recognise them by their fingerprints."""
    st.info(
        "To follow another person, LiftLens has to look at the video again, and it keeps no "
        "original: uploaded videos are deleted once they were assessed. Add the same file again; "
        "it is recognised by its fingerprint, and deleted afterwards.",
        icon=":material/videocam:",
    )
    for number, view in enumerate(result.views):
        arrived = st.file_uploader(
            f"The video that was assessed: {view.info.file_name}",
            key=state.review_key(trial_id, f"upload-{number}"),
        )
        if arrived is None:
            continue
        seen = state.review_value(trial_id, f"transfer-{number}")
        if seen != arrived.file_id:
            state.set_review_value(trial_id, f"transfer-{number}", arrived.file_id)
            path, problem = _receive(arrived, view.info.sha256)
            state.set_review_value(trial_id, f"video-{number}", path)
            state.set_review_value(trial_id, f"mismatch-{number}", problem)
        show_problem(state.review_value(trial_id, f"mismatch-{number}"))
    return _find_videos(trial_id, result)


def _receive(arrived: Any, sha256: str) -> tuple[Path | None, str]:
    """Put an upload on disk; return where it lies, or why it is not the video that is wanted."""
    try:
        path = cache.save_upload(arrived, arrived.name)
    except EngineError as error:
        return None, str(error)
    try:
        found = cache.video_facts(path).sha256
    except EngineError as error:
        path.unlink()
        return None, str(error)
    if found == sha256:
        return path, ""
    path.unlink()
    return None, (
        f"This is another video than the one that was assessed: expected the fingerprint "
        f"{sha256[:16]}, got {found[:16]}. Choose the original file, as it was uploaded."
    )
