"""All session state and query parameters, as typed functions; keys stand nowhere else."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import streamlit as st

from dashboard.cache import Sample
from engine.jobs.local import JobRequest

_UPLOAD = "upload"
_REJECTED = "rejected_upload"
_FORM = "form"
_DELETION = "deletion"
_ROUND = "form_round"
_TRIAL = "trial"
_JOB = "job"
_REFERENCE_ROUND = "reference_round"
_IMPROVE = "improve"
_AGAINST = "against"
_PLAYER_NUMBER = "player_number"
_PLAYER_TIME = "player_time"
_REVIEW_PROBLEM = "review_problem"

SAMPLE_KEY = "sample"
SOURCE_KEY = "source"
UPLOAD_SOURCE, SAMPLE_SOURCE = "Upload a video", "Use a sample"

FIELDS = (
    "label", "subject", "stature_m", "sex", "mass_kg", "load_kg", "hands", "coupling",
    "frequency_per_min", "duration_h", "recovery_h", "destination_control", "sample",
    "two_cameras", "calibration", "offset_s", "site", "job",
)  # fmt: skip


@dataclass(frozen=True)
class Upload:
    """A video that arrived: where it lies now, and which transfer it came by."""

    path: Path
    transfer_id: str
    facts: str


def trial_id() -> str | None:
    """Return the trial the address names."""
    return st.query_params.get(_TRIAL)


def set_trial_id(identifier: str) -> None:
    """Put a trial into the address, so that a reload shows it again."""
    st.query_params[_TRIAL] = identifier


def reference_upload_key() -> str:
    """Return the widget key of the reference's upload; a new one shows it empty."""
    return f"reference_upload_{st.session_state.get(_REFERENCE_ROUND, 0)}"


def renew_reference_upload() -> None:
    """Empty the upload of a reference, once its file was kept."""
    st.session_state[_REFERENCE_ROUND] = st.session_state.get(_REFERENCE_ROUND, 0) + 1


def trial_parameters(identifier: str) -> dict[str, str]:
    """Return the address parameters of a trial's page."""
    return {_TRIAL: identifier}


def job_id() -> str | None:
    """Return the job the address names."""
    return st.query_params.get(_JOB)


def set_job_id(identifier: str | None) -> None:
    """Put a job into the address, so that a reload shows it again."""
    if identifier is None:
        st.query_params.clear()
    else:
        st.query_params[_JOB] = identifier


def job_parameters(identifier: str) -> dict[str, str]:
    """Return the address parameters of a job's page."""
    return {_JOB: identifier}


def _slot(key: str, slot: int) -> str:
    return f"{key}_{slot}"


def upload(slot: int = 0) -> Upload | None:
    """Return an uploaded video of this session: the first or, with slot 1, the second."""
    found: Upload | None = st.session_state.get(_slot(_UPLOAD, slot))
    return found if found is None or found.path.exists() else None


def set_upload(value: Upload | None, slot: int = 0) -> None:
    """Remember an uploaded video."""
    st.session_state[_slot(_UPLOAD, slot)] = value


def rejected_upload(slot: int = 0) -> tuple[str, str] | None:
    """Return the transfer that was refused, and why."""
    found: tuple[str, str] | None = st.session_state.get(_slot(_REJECTED, slot))
    return found


def set_rejected_upload(transfer_id: str, why: str, slot: int = 0) -> None:
    """Remember a refused upload."""
    st.session_state[_slot(_REJECTED, slot)] = (transfer_id, why)


def is_known_transfer(transfer_id: str, slot: int = 0) -> bool:
    """Whether an upload was dealt with already: saved, handed to a job, or refused."""
    refused = rejected_upload(slot)
    return transfer_id == upload_transfer(slot) or (
        refused is not None and refused[0] == transfer_id
    )


def upload_transfer(slot: int = 0) -> str | None:
    """Return by which transfer the present upload came; empty for one an ended job gave back."""
    found: Upload | None = st.session_state.get(_slot(_UPLOAD, slot))
    return None if found is None else found.transfer_id


def choose_sample_source() -> None:
    """Let the form start at the bundled samples."""
    st.session_state[SOURCE_KEY] = SAMPLE_SOURCE


def chosen_sample() -> str | None:
    """Return the key of the chosen sample."""
    found: str | None = st.session_state.get(SAMPLE_KEY)
    return found


def fill_from_sample(sample: Sample) -> None:
    """Start the form anew with what is known of a sample."""
    st.session_state[_ROUND] = st.session_state.get(_ROUND, 0) + 1
    st.session_state[_FORM] = {**sample.values, "label": sample.title, "sample": sample.key}


def order_deletion(identifier: str) -> None:
    """Remember a trial the user has confirmed to delete."""
    st.session_state[_DELETION] = identifier


def take_deletion() -> str | None:
    """Return the trial to delete, once."""
    ordered: str | None = st.session_state.pop(_DELETION, None)
    return ordered


def field_key(field: str) -> str:
    """Return the widget key of a form field; it changes when the form is filled anew."""
    return f"field_{field}_{st.session_state.get(_ROUND, 0)}"


def field_value(field: str) -> Any:
    """Return what a form field holds now."""
    return st.session_state.get(field_key(field))


def initial_value(field: str, otherwise: Any = None) -> Any:
    """Return what a form field starts with."""
    return st.session_state.get(_FORM, {}).get(field, otherwise)


def fill_form(request: JobRequest | None) -> None:
    """Start the form anew: empty, or with the values of an earlier request."""
    st.session_state[_ROUND] = st.session_state.get(_ROUND, 0) + 1
    st.session_state[_FORM] = {} if request is None else _form_values(request)


def _form_values(request: JobRequest) -> dict[str, Any]:
    known = {f: getattr(request.task, f) for f in FIELDS if hasattr(request.task, f)}
    known |= {f: getattr(request.subject, f) for f in FIELDS if hasattr(request.subject, f)}
    two_view = request.settings.two_view
    return {
        **known,
        "label": request.label,
        "site": request.site,
        "job": request.job,
        "subject": request.subject.label,
        "two_cameras": len(request.videos) == 2,
        "calibration": two_view.calibration,
        "offset_s": two_view.given_offset_s,
    }


# --------------------------------------------------------------------------- player and review

REVIEWER_KEY = "reviewer"
"""The reviewer's name is kept for the whole visit."""


def review_key(trial: str, field: str) -> str:
    """Return the widget key of a field of the review of a trial."""
    return f"review_{trial}_{field}"


def review_value(trial: str, field: str, otherwise: Any = None) -> Any:
    """Return what a field of the review holds."""
    return st.session_state.get(review_key(trial, field), otherwise)


def set_review_value(trial: str, field: str, value: Any) -> None:
    """Fill a field of the review; only before it is shown, or in a callback."""
    st.session_state[review_key(trial, field)] = value


def take_player_event(trial: str, number: int) -> bool:
    """Whether a request of the player is new; it counts as taken from then on."""
    key = f"{_PLAYER_NUMBER}_{trial}"
    is_new = number > st.session_state.get(key, 0)
    if is_new:
        st.session_state[key] = number
    return is_new


def note_time(trial: str) -> float | None:
    """Return the moment that the next note is about; None for the whole trial."""
    found: float | None = st.session_state.get(f"{_PLAYER_TIME}_{trial}")
    return found


def set_note_time(trial: str, at_s: float | None) -> None:
    """Choose the moment that the next note is about."""
    st.session_state[f"{_PLAYER_TIME}_{trial}"] = at_s


def reviewer() -> str:
    """Return the name that the user gave as a reviewer."""
    return str(st.session_state.get(REVIEWER_KEY, "") or "")


def set_review_problem(message: str) -> None:
    """Remember why a review or a note was not kept."""
    st.session_state[_REVIEW_PROBLEM] = message


def take_review_problem() -> str:
    """Return why the last review or note was not kept, once."""
    return str(st.session_state.pop(_REVIEW_PROBLEM, ""))


# --------------------------------------------------------------------------- improve


def improve_key(scope: str, field: str) -> str:
    """Return the widget key of an input of what-if; it changes when the inputs are filled anew."""
    return f"improve_{scope}_{field}_{_improve_fill(scope)[0]}"


def improve_start(scope: str, field: str, otherwise: Any) -> Any:
    """Return what an input of what-if starts with: the proposal that is tried, or as filmed."""
    return _improve_fill(scope)[1].get(field, otherwise)


def fill_improve(scope: str, values: dict[str, Any]) -> None:
    """Start the inputs of what-if anew: as filmed, but for the values given."""
    st.session_state[f"{_IMPROVE}_{scope}"] = (_improve_fill(scope)[0] + 1, values)


def _improve_fill(scope: str) -> tuple[int, dict[str, Any]]:
    found: tuple[int, dict[str, Any]] = st.session_state.get(f"{_IMPROVE}_{scope}", (0, {}))
    return found


# --------------------------------------------------------------------------- lists and overview

SEARCH_KEY, SITE_KEY, WORK_KEY, PERSON_KEY = "search", "site", "work", "person"
LEVEL_KEY, TAGS_KEY, PERIOD_KEY, ORDER_KEY, PAGE_KEY = "level", "tags", "period", "order", "page"
"""Of filters; they stand in the address under these names."""
CHANGED_JOB_KEY, CHANGED_DAY_KEY = "changed_job", "changed_day"
REPORT_KIND_KEY, ANONYMOUS_KEY = "report_kind", "report_anonymous"


def is_anonymous() -> bool:
    """Whether reports leave out names and pictures."""
    return bool(st.session_state.get(ANONYMOUS_KEY))


def list_page() -> int:
    """Return which page of the list is shown, counted from 1."""
    found = st.query_params.get(PAGE_KEY, "1")
    return max(1, int(found)) if found.isdecimal() else 1


def turn_to_page(number: int) -> None:
    """Show another page of the list; a reload shows it again."""
    st.query_params[PAGE_KEY] = str(number)


def turn_to_first_page() -> None:
    """Go back to the start of the list, since another choice makes another list."""
    st.query_params.pop(PAGE_KEY, None)


_EDIT, _EDIT_PROBLEM = "edit", "edit_problem"


def edit_key(identifier: str, field: str) -> str:
    """Return the widget key of what a trial is called."""
    return f"{_EDIT}_{field}_{identifier}"


def edit_value(identifier: str, field: str) -> Any:
    """Return what was typed as a trial's name, site, job, person or tags."""
    return st.session_state[edit_key(identifier, field)]


def set_edit_problem(message: str) -> None:
    """Remember why a trial could not be named so."""
    st.session_state[_EDIT_PROBLEM] = message


def take_edit_problem() -> str | None:
    """Return why a trial could not be named so, once."""
    found: str | None = st.session_state.pop(_EDIT_PROBLEM, None)
    return found


# --------------------------------------------------------------------------- settings

_SETTINGS_ROUND, _NOTICE = "settings_round", "notice"


def settings_key(field: str) -> str:
    """Return the widget key of a question that is asked anew once something was done."""
    return f"settings_{field}_{st.session_state.get(_SETTINGS_ROUND, 0)}"


def settings_value(field: str) -> Any:
    """Return what a question on the page of settings holds now."""
    return st.session_state.get(settings_key(field))


def finish_setting(notice: str) -> None:
    """Ask all questions anew, and say what was done."""
    st.session_state[_SETTINGS_ROUND] = st.session_state.get(_SETTINGS_ROUND, 0) + 1
    st.session_state[_NOTICE] = notice


def take_notice() -> str | None:
    """Return what was done, once."""
    found: str | None = st.session_state.pop(_NOTICE, None)
    return found


# --------------------------------------------------------------------------- form


def compared() -> tuple[str | None, str | None]:
    """Return the reference and the attempt the address names."""
    return st.query_params.get(_AGAINST), st.query_params.get(_TRIAL)


def set_compared(reference: str, attempt: str) -> None:
    """Put reference and attempt into the address, so that a reload shows them again."""
    if compared() != (reference, attempt):
        st.query_params.update({_AGAINST: reference, _TRIAL: attempt})


def train_key(name: str) -> str:
    """Return the widget key of an input of the page that compares form."""
    return f"train_{name}"


# --------------------------------------------------------------------------- estimators


def estimator_key(name: str) -> str:
    """Return the widget key of an input of the page that compares estimators."""
    return f"estimators_{name}"


# --------------------------------------------------------------------------- validation studies

_STUDY = "study"


def study_name() -> str | None:
    """Return the study the address names."""
    return st.query_params.get(_STUDY)


def set_study_name(name: str) -> None:
    """Put a study into the address, so that a reload shows it again."""
    if study_name() != name:
        st.query_params[_STUDY] = name


def study_key(name: str) -> str:
    """Return the widget key of an input of the page of validation studies."""
    return f"study_{name}"
