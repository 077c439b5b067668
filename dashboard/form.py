"""The form of a new assessment: its fields, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import streamlit as st

from dashboard import cache, state
from dashboard.labels import COUPLINGS, HELP, format_span
from dashboard.widgets import ASSETS, show_problem
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


def find_obstacle(videos: tuple[Path, ...]) -> str:
    """Return what is to be done before the assessment can start; empty if nothing."""
    if not videos:
        return "Add the second video too." if state.upload(0) else "Add a video first."
    return "" if is_complete() else "Correct the marked fields."


def read_request(videos: tuple[Path, ...]) -> JobRequest:
    """Return the request the form describes."""
    value = state.field_value
    return JobRequest(
        videos=videos,
        label=(value("label") or "").strip() or videos[0].stem.replace("_", " "),
        site=(value("site") or "").strip(),
        job=(value("job") or "").strip(),
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
        config={"two_view": _two_view_settings()} if len(videos) == 2 else {},
    )


def _two_view_settings() -> dict[str, str]:
    offset_s, cameras = state.field_value("offset_s"), state.field_value("calibration")
    if cameras is None:  # a sample brings its own, without a field
        cameras = state.initial_value("calibration", "")
    return {
        "sync": "auto" if offset_s is None else f"{offset_s:g}",
        "calibration": cameras,
    }


def ask_videos() -> tuple[Path, ...]:
    """Ask for one video or two, uploaded or bundled; return where they lie once all are usable."""
    samples = cache.samples()
    source = st.segmented_control(
        "Where is the video?",
        [state.UPLOAD_SOURCE, *([state.SAMPLE_SOURCE] if samples else [])],
        default=state.UPLOAD_SOURCE,
        required=True,
        key=state.SOURCE_KEY,
        label_visibility="collapsed",
    )
    if samples and source == state.SAMPLE_SOURCE:
        return _ask_sample(samples)
    first = _ask_upload(0, "Video of the lift")
    if not _wants_second():
        return () if first is None else (first,)
    second = _ask_second()
    return (first, second) if first and second else ()


def _wants_second() -> bool:
    wanted = st.toggle(
        "Filmed by a second camera too",
        value=bool(state.initial_value("two_cameras", otherwise=False)),
        key=state.field_key("two_cameras"),
        help=HELP["two_cameras"],
    )
    if not wanted and state.upload_transfer(1) is not None:
        _discard(1)
    return wanted


def _ask_second() -> Path | None:
    st.image(str(ASSETS / "two-cameras.svg"), width="stretch")
    second = _ask_upload(1, "The same lift from the other camera")
    kept = cache.calibrations()
    start = state.initial_value("calibration") or ""
    cameras, clock = st.columns(2)
    with cameras:
        st.selectbox(
            "Where the cameras stand",
            ["", *kept],
            index=["", *kept].index(start) if start in kept else 0,
            format_func=lambda path: kept[path] if path else "Found from the moving person",
            key=state.field_key("calibration"),
            help=HELP["calibration"],
        )
    with clock:
        st.number_input(
            "Time between the videos (s)",
            value=state.initial_value("offset_s"),
            step=0.01,
            format="%.3f",
            placeholder="found from the movement",
            key=state.field_key("offset_s"),
            help=HELP["offset_s"],
        )
    return second


def _ask_sample(samples: tuple[cache.Sample, ...]) -> tuple[Path, ...]:
    titles = {sample.key: sample.title for sample in samples}
    known = {sample.key: sample for sample in samples}
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
    st.caption(f"What is known of the sample is filled in below. Licence: {known[key].licence}.")
    return known[key].videos


def _take_sample() -> None:
    state.fill_from_sample(next(s for s in cache.samples() if s.key == state.chosen_sample()))


def _ask_upload(slot: int, title: str) -> Path | None:
    arrived = st.file_uploader(
        title,
        type=VIDEO_TYPES,
        key=state.field_key(f"uploader_{slot}"),
        help="One person who lifts, a few seconds to a few minutes." if slot else HELP["video"],
    )
    if arrived is not None and not state.is_known_transfer(arrived.file_id, slot):
        _receive(arrived, slot)
    if arrived is None and state.upload_transfer(slot):
        _discard(slot)  # the user took it back
    rejected = state.rejected_upload(slot)
    if arrived is not None and rejected and rejected[0] == arrived.file_id:
        st.error(rejected[1], icon=":material/error:")
        return None
    upload = state.upload(slot)
    if upload is None:
        if slot == 0:
            with st.expander("How to film a lift", icon=":material/videocam:"):
                st.markdown("\n".join(f"- {line}" for line in FILMING))
        return None
    st.success(f"{upload.path.name}: {upload.facts}", icon=":material/check_circle:")
    return upload.path


def _receive(arrived: Any, slot: int) -> None:
    """Put an upload on disk at once and look whether it is a usable video."""
    path = None
    try:
        path = cache.save_upload(arrived, arrived.name)
        info = cache.video_facts(path)
    except EngineError as error:
        if path is not None:
            path.unlink()
        state.set_upload(None, slot)
        state.set_rejected_upload(arrived.file_id, str(error), slot)
        return
    width, height = info.size_px
    facts = f"{format_span(info.duration_s)}, {width} × {height}, {info.fps:.0f} pictures a second"
    state.set_upload(state.Upload(path, arrived.file_id, facts), slot)


def _discard(slot: int) -> None:
    upload = state.upload(slot)
    if upload is not None:
        upload.path.unlink(missing_ok=True)
    state.set_upload(None, slot)


def clear() -> None:
    """Start over: the videos now belong to a job."""
    for slot in (0, 1):
        state.set_upload(None, slot)
    state.fill_form(None)


def take_back(request: JobRequest) -> None:
    """Fill the form with the request of an ended job, its videos included."""
    state.fill_form(request)
    for slot, video in enumerate(request.videos):
        if cache.library().uploads in video.parents and video.exists():
            state.set_upload(state.Upload(video, "", "kept from the last try"), slot)


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
        _text("site", "Site", placeholder="for example Hall 2")
    with second:
        _text("job", "Job", placeholder="for example packing")
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
