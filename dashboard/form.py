"""The form of a new assessment: its fields, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import streamlit as st

from dashboard import cache, state
from dashboard.labels import COUPLINGS, HELP, format_span
from dashboard.widgets import show_problem
from engine.datatypes import Coupling, Subject, Task
from engine.errors import ConfigError, EngineError
from engine.jobs.local import JobRequest

WIDTH_PX = 860
VIDEO_TYPES = ["mp4", "mov", "m4v", "avi", "mkv", "webm"]
FILMING = (
    "Stand to the side of the person, or half to the side and half in front.",
    "Keep the whole body and the load in the picture, feet included, from start to end.",
    "Hold the phone still and level at hip height, or use a stand.",
    "Start before the person bends down; stop after the load is let go.",
)

_CHECKS: dict[str, Callable[[Any], object]] = {
    "stature_m": lambda v: Subject(stature_m=v),
    "mass_kg": lambda v: Subject(mass_kg=v),
    "load_kg": lambda v: Task(load_kg=v),
    "frequency_per_min": lambda v: Task(frequency_per_min=v),
    "duration_h": lambda v: Task(duration_h=v),
    "recovery_h": lambda v: Task(recovery_h=v),
}


def find_problem(field: str) -> str | None:
    """Return what is wrong with a field, in the engine's words."""
    try:
        _CHECKS[field](state.field_value(field))
    except ConfigError as error:
        return str(error)
    return None


def is_complete() -> bool:
    """Whether every field holds a value the engine takes."""
    return not any(find_problem(field) for field in _CHECKS)


def read_request(video: Path) -> JobRequest:
    """Return the request the form describes."""
    value = state.field_value
    return JobRequest(
        videos=(video,),
        label=(value("label") or "").strip() or video.stem.replace("_", " "),
        subject=Subject(
            label=(value("subject") or "").strip() or "subject",
            stature_m=value("stature_m"),
            sex=value("sex"),
            mass_kg=value("mass_kg"),
        ),
        task=Task(
            load_kg=value("load_kg"),
            hands=value("hands"),
            coupling=value("coupling"),
            frequency_per_min=value("frequency_per_min"),
            duration_h=value("duration_h"),
            recovery_h=value("recovery_h"),
            destination_control=value("destination_control"),
        ),
    )


def ask_video() -> Path | None:
    """Ask for a video, uploaded or bundled; return where it lies once it is usable."""
    samples = cache.samples()
    source = st.segmented_control(
        "Where is the video?",
        [state.UPLOAD_SOURCE, *([state.SAMPLE_SOURCE] if samples else [])],
        default=state.UPLOAD_SOURCE,
        required=True,
        key=state.SOURCE_KEY,
        label_visibility="collapsed",
    )
    return _ask_sample(samples) if samples and source == state.SAMPLE_SOURCE else _ask_upload()


def _ask_sample(samples: tuple[cache.Sample, ...]) -> Path:
    titles = {sample.key: sample.title for sample in samples}
    notes = {sample.key: sample for sample in samples}
    key = st.radio(
        "Sample",
        list(titles),
        format_func=titles.__getitem__,
        captions=[sample.note for sample in samples],
        key=state.SAMPLE_KEY,
        on_change=_take_sample,
        label_visibility="collapsed",
    )
    if state.initial_value("sample") != key:
        _take_sample()
    st.caption(f"What is known of the sample is filled in below. Licence: {notes[key].licence}.")
    return notes[key].path


def _take_sample() -> None:
    state.fill_from_sample(next(s for s in cache.samples() if s.key == state.chosen_sample()))


def _ask_upload() -> Path | None:
    arrived = st.file_uploader(
        "Video of the lift",
        type=VIDEO_TYPES,
        key=state.field_key("uploader"),
        help="One person who lifts, filmed from the side; a few seconds to a few minutes.",
    )
    if arrived is not None and not state.is_known_transfer(arrived.file_id):
        _receive(arrived)
    if arrived is None and state.upload_transfer():
        _discard()  # the user took it back
    rejected = state.rejected_upload()
    if arrived is not None and rejected and rejected[0] == arrived.file_id:
        st.error(rejected[1], icon=":material/error:")
        return None
    upload = state.upload()
    if upload is None:
        with st.expander("How to film a lift", icon=":material/videocam:"):
            st.markdown("\n".join(f"- {line}" for line in FILMING))
        return None
    st.success(f"{upload.path.name}: {upload.facts}", icon=":material/check_circle:")
    return upload.path


def _receive(arrived: Any) -> None:
    """Put an upload on disk at once and look whether it is a usable video."""
    path = cache.save_upload(arrived, arrived.name)
    try:
        info = cache.video_facts(path)
    except EngineError as error:
        path.unlink()
        state.set_upload(None)
        state.set_rejected_upload(arrived.file_id, str(error))
        return
    width, height = info.size_px
    facts = f"{format_span(info.duration_s)}, {width} × {height}, {info.fps:.0f} pictures a second"
    state.set_upload(state.Upload(path, arrived.file_id, facts))


def _discard() -> None:
    upload = state.upload()
    if upload is not None:
        upload.path.unlink(missing_ok=True)
    state.set_upload(None)


def clear() -> None:
    """Start over: the video now belongs to a job."""
    state.set_upload(None)
    state.fill_form(None)


def take_back(request: JobRequest) -> None:
    """Fill the form with the request of an ended job, its video included."""
    state.fill_form(request)
    video = request.videos[0]
    if cache.library().uploads in video.parents and video.exists():
        state.set_upload(state.Upload(video, "", "kept from the last try"))


def ask_person() -> None:
    """Ask who was filmed."""
    first, second = st.columns(2)
    with first:
        _text("subject", "Pseudonym of the person", placeholder="for example P01")
    with second:
        _number(
            "stature_m",
            "Body height (m)",
            step=0.01,
            placeholder="for example 1.75",
            help_key="stature",
        )
    first, second = st.columns(2)
    with first:
        _choice("sex", "Sex", {"female": "Female", "male": "Male"})
    with second:
        _number("mass_kg", "Body mass (kg)", step=1.0, placeholder="optional", help_key="mass")


def ask_task() -> None:
    """Ask what the camera can't see of the work."""
    _text("label", "Name of the trial", placeholder="for example crate to shelf")
    first, second = st.columns(2)
    with first:
        _number("load_kg", "Load (kg)", step=0.5, placeholder="for example 12", help_key="load")
    with second:
        _choice("hands", "Hands on the load", {2: "Both", 1: "One"})
    _coupling()
    first, second, third = st.columns(3)
    with first:
        _number("frequency_per_min", "Lifts per minute", 0.5, "for example 1", "frequency")
    with second:
        _number("duration_h", "Lifting lasts (h)", 0.5, "for example 2", "duration")
    with third:
        _number("recovery_h", "Light work after it (h)", 0.5, "for example 1", "recovery")
    _choice(
        "destination_control",
        "Must the load be placed with care?",
        {False: "No, just put down", True: "Yes, with care"},
        help_key="control",
    )


def _text(field: str, label: str, placeholder: str) -> None:
    st.text_input(
        label,
        value=state.initial_value(field, ""),
        placeholder=placeholder,
        max_chars=80,
        key=state.field_key(field),
        help=HELP[field],
    )


def _number(
    field: str,
    label: str,
    step: float,
    placeholder: str,
    help_key: str,
) -> None:
    start = state.initial_value(field)
    st.number_input(
        label,
        value=None if start is None else float(start),
        step=step,
        format="%.4g",
        placeholder=placeholder,
        key=state.field_key(field),
        help=HELP[help_key],
    )
    show_problem(find_problem(field))


def _choice(field: str, label: str, options: dict[Any, str], help_key: str = "") -> None:
    st.segmented_control(
        label,
        list(options),
        format_func=options.__getitem__,
        default=state.initial_value(field),
        key=state.field_key(field),
        help=HELP[help_key or field],
    )


def _coupling() -> None:
    options: list[Coupling | None] = [*COUPLINGS, None]
    start = state.initial_value("coupling")
    st.radio(
        "How good is the grip?",
        options,
        index=options.index(Coupling(start) if start else None),
        format_func=lambda c: "Not sure (fair is assumed)" if c is None else COUPLINGS[c],
        key=state.field_key("coupling"),
        help=HELP["coupling"],
    )
