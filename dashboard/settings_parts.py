"""The parts of the settings: choices, data, people, models."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any

import streamlit as st

from dashboard import cache, manage_cache, state
from dashboard.labels import count, format_bytes
from dashboard.widgets import facts_html, table_html
from engine.ergonomics.base import list_methods
from engine.errors import ConfigError
from engine.pose.base import list_backends
from engine.preferences import (
    LANGUAGES,
    MAX_DAYS,
    PAPERS,
    PREFERENCES_NAME,
    SOLVERS,
    UNITS,
    Preferences,
)
from engine.sample_results import SAMPLES_SITE, add_samples, find_samples, remove_samples
from engine.storage.database.connection import URL_VARIABLE
from engine.storage.library import HOME_VARIABLE

WORDS: dict[str, str] = {
    "metric": "Metric (kg, cm)",
    "us": "Metric, with pounds and inches beside it",
    "en": "English",
    "a4": "A4",
    "letter": "US Letter",
    "geometric": "Geometric (default)",
    "least-squares": "Jointed figure (least squares)",
}
EVERYTHING, OF_SITE, OF_JOB, OF_PERSON, OF_TRIAL = (
    "Everything",
    "A site",
    "A job",
    "A person",
    "A trial",
)
MOST_LISTED = 8


def read_preferences() -> Preferences:
    """Return the preferences; if their file is damaged, say so and offer the defaults."""
    try:
        return manage_cache.preferences()
    except ConfigError as error:
        st.error(str(error), icon=":material/error:")
        if st.button("Use the defaults again", key="reset-preferences"):
            manage_cache.save_preferences(Preferences())
            st.rerun()
        return Preferences()


def show_notice() -> None:
    """Say what was done just now."""
    if notice := state.take_notice():
        st.success(notice, icon=":material/check_circle:")


# --------------------------------------------------------------------------- choices


def ask_display(chosen: Preferences) -> None:
    """Ask for units, language and paper; every answer is kept at once."""
    st.subheader("Units and language", anchor=False)
    units, language, paper = st.columns(3)
    with units:
        _ask_one("Units", "units", UNITS, chosen)
    with language:
        _ask_one("Language", "language", LANGUAGES, chosen)
    with paper:
        _ask_one("Paper of reports", "paper", PAPERS, chosen)
    st.caption(
        "Values are stored and exported in metric units always. Weights and lengths to enter are "
        "in kg and m."
    )


def _ask_one(title: str, field: str, options: tuple[str, ...], chosen: Preferences) -> None:
    key = state.settings_key(field)
    st.selectbox(
        title,
        options,
        index=options.index(getattr(chosen, field)),
        format_func=WORDS.__getitem__,
        key=key,
        on_change=_keep,
        args=(chosen, field),
    )


def _keep(chosen: Preferences, field: str) -> None:
    """Keep an answer; it runs before the page does, so all of the page shows it."""
    manage_cache.save_preferences(replace(chosen, **{field: state.settings_value(field)}))


def ask_methods(chosen: Preferences) -> None:
    """Ask how new trials are assessed, and list the methods with their sources."""
    st.subheader("Methods", anchor=False)
    solver, experimental = st.columns(2)
    with solver:
        _ask_one("Joint angles of new assessments", "solver", SOLVERS, chosen)
    experimental.toggle(
        "Experimental methods too",
        chosen.experimental_methods,
        key=state.settings_key("experimental_methods"),
        on_change=_keep,
        args=(chosen, "experimental_methods"),
        help="Methods whose tables were not checked against the publication itself.",
    )
    with st.expander("All methods and their sources"):
        rows = (
            (
                method.info.title,
                "experimental" if method.info.is_experimental else "always",
                method.info.reference,
            )
            for method in list_methods()
        )
        head = (("Method", ""), ("Runs", ""), ("Source", ""))
        st.html(table_html(head, rows, css="ll-wraps"))
    st.caption("Trials that were assessed already stay as they are.")


# --------------------------------------------------------------------------- data


def show_place() -> None:
    """Say where the data is, how much there is, and how much space is left."""
    st.subheader("Where your data is", anchor=False)
    library = cache.library()
    sizes = manage_cache.folder_sizes()
    free = shutil.disk_usage(library.root).free
    rows = (
        ("Data folder", str(library.root)),
        ("Database", library.database.where),
        (
            "Trials",
            f"{count(library.query(limit=1).total, 'trial')}, {format_bytes(sizes['trials'])}",
        ),
        ("Uploads and work", format_bytes(sizes["uploads"] + sizes["jobs"])),
        ("Everything", format_bytes(sum(sizes.values()))),
        ("Free space", format_bytes(free)),
    )
    st.html(table_html((("", ""), ("", "")), rows, css="ll-plain"))
    st.caption(
        f"All of it stays on this computer. Another folder: set {HOME_VARIABLE} before the start; "
        f"PostgreSQL in the place of the file: {URL_VARIABLE}. The choices of this page are in "
        f"{PREFERENCES_NAME} in the data folder."
    )
    if library.is_read_only:
        st.warning("This library may only be read here; nothing can be changed.")


def ask_retention(chosen: Preferences) -> None:
    """Ask how long trials are kept, show what would go, and delete it on a second word."""
    st.subheader("How long data is kept", anchor=False)
    st.number_input(
        "Delete trials older than (days)",
        min_value=1,
        max_value=MAX_DAYS,
        value=chosen.keep_days,
        step=1,
        placeholder="never",
        key=state.settings_key("keep_days"),
        on_change=_keep,
        args=(chosen, "keep_days"),
        width=320,
        help="Counted from the assessment. Nothing is deleted without a look at this page.",
    )
    st.caption("Uploaded videos are deleted when their assessment is done, at the latest in a day.")
    _warn_overdue()
    if chosen.keep_days is None:
        return
    cutoff = datetime.now().astimezone() - timedelta(days=chosen.keep_days)
    found = cache.library().query(until=cutoff, order="oldest")
    if not found.total:
        st.caption(f"No trial is older than {count(chosen.keep_days, 'day')}.")
        return
    names = [f"{entry.label or entry.id} ({entry.created[:10]})" for entry in found.entries]
    more = f" … and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
    st.warning(
        f"{count(found.total, 'trial')} would go: {', '.join(names[:MOST_LISTED])}{more}.",
        icon=":material/auto_delete:",
    )
    ids = tuple(entry.id for entry in found.entries)
    _confirm(
        f"Delete {count(found.total, 'trial')} with all videos, measurements and notes for good",
        "Delete now",
        "retention",
        lambda: _delete_trials(ids),
    )


def _delete_trials(ids: tuple[str, ...]) -> str:
    library = cache.library()
    for trial_id in ids:
        library.delete(trial_id)
    return f"{count(len(ids), 'trial')} deleted."


def _warn_overdue() -> None:
    today = datetime.now().astimezone().date()
    for person in cache.library().overdue(today):
        st.warning(
            f"The data of {person.pseudonym} were to be deleted after {person.keep_until}; "
            "do it under People.",
            icon=":material/event_busy:",
        )


def _confirm(question: str, word: str, key: str, do: Callable[[], str]) -> None:
    """Do something that can't be undone, after a tick and a click."""
    is_sure = st.checkbox(question, key=state.settings_key(f"sure-{key}"))
    if st.button(
        word,
        key=f"do-{key}",
        type="primary",
        disabled=not is_sure,
        icon=":material/delete_forever:",
    ):
        notice = do()
        manage_cache.forget_summaries()
        state.finish_setting(notice)
        st.rerun()


# --------------------------------------------------------------------------- people


def ask_people() -> None:
    """Show who was filmed; give or delete all that belongs to a person."""
    st.subheader("People", anchor=False)
    people = {person.pseudonym: person for person in cache.library().people()}
    if not people:
        st.caption("Nobody was filmed yet.")
        return
    name = st.selectbox(
        "Person",
        list(people),
        index=None,
        placeholder="Choose a pseudonym",
        key=state.settings_key("person"),
    )
    if name is None:
        st.caption(f"{count(len(people), 'person')} in the library.".replace("persons", "people"))
        return
    person = people[name]
    facts = (
        count(person.n_trials, "trial"),
        f"agreed on {person.consent_on}" if person.consent_on else "",
        f"keep until {person.keep_until}" if person.keep_until else "",
    )
    st.html(facts_html(facts))
    if person.n_trials:
        _zip_button("All data of this person", f"{name}.zip", "export-person", person=name)
    _confirm(
        f"Delete {name} with {count(person.n_trials, 'trial')}, all videos, notes and files",
        "Delete this person",
        "person",
        lambda: _delete_person(name),
    )


def _delete_person(name: str) -> str:
    n_trials = cache.library().delete_person(name)
    return f"{name} was deleted, with {count(n_trials, 'trial')}."


# --------------------------------------------------------------------------- transfer


def ask_transfer() -> None:
    """Take trials to another computer, and take in what comes from one."""
    st.subheader("Move trials between computers", anchor=False)
    out, into = st.columns(2, gap="large")
    with out:
        _ask_export()
    with into:
        _ask_import()


def _ask_export() -> None:
    choices = manage_cache.choices()
    options: dict[str, tuple[str, list[str]]] = {
        EVERYTHING: ("", []),
        OF_SITE: ("site", list(choices.sites)),
        OF_JOB: ("job", list(choices.jobs)),
        OF_PERSON: ("person", list(choices.people)),
        OF_TRIAL: ("trials", []),
    }
    kind = st.selectbox("Export", list(options), key=state.settings_key("export")) or EVERYTHING
    field, names = options[kind]
    if kind == EVERYTHING:
        if not cache.library().is_empty:
            _zip_button("Export as zip", "liftlens.zip", "export")
        return
    labels: dict[str, str] = {name: name for name in names}
    if kind == OF_TRIAL:
        found = cache.library().query(limit=manage_cache.MOST_REPORTED).entries
        labels = {entry.id: f"{entry.label or entry.id} · {entry.created[:10]}" for entry in found}
    chosen = st.selectbox(
        kind,
        list(labels),
        format_func=labels.__getitem__,
        index=None,
        placeholder="Which one",
        label_visibility="collapsed",
        key=state.settings_key(f"export-{field}"),
    )
    if chosen is not None:
        which: Any = [chosen] if kind == OF_TRIAL else chosen
        _zip_button("Export as zip", f"{chosen}.zip", "export", **{field: which})


def _zip_button(label: str, name: str, key: str, **which: Any) -> None:
    st.download_button(
        label,
        lambda: manage_cache.export_library(**which),
        file_name=cache.sanitise_name(name),
        mime="application/zip",
        icon=":material/folder_zip:",
        on_click="ignore",
        key=key,
        help="Results, annotated videos, names, notes, reviews and attached files.",
    )


def _ask_import() -> None:
    given = st.file_uploader(
        "Import a zip that LiftLens exported", type=["zip"], key=state.settings_key("import")
    )
    if given is None or not st.button("Import", key="import", type="primary"):
        return
    report = manage_cache.import_library(given)
    manage_cache.forget_summaries()
    known = len(report.already_there)
    extra = f" {count(known, 'trial')} was there already." if known == 1 else ""
    extra = f" {count(known, 'trial')} were there already." if known > 1 else extra
    state.finish_setting(f"{count(len(report.imported), 'trial')} imported.{extra}")
    st.rerun()


# --------------------------------------------------------------------------- samples


def ask_samples() -> None:
    """Let the user remove the bundled samples, or bring them back."""
    st.subheader("Sample trials", anchor=False)
    library = cache.library()
    n_present = len(find_samples(library))
    st.caption(
        "Finished trials that come with LiftLens, to look around in. They are at the site "
        f"“{SAMPLES_SITE}” and count in the overview only as long as there is nothing else."
    )
    if n_present:
        label, icon, change = "Remove the samples", ":material/delete:", remove_samples
        word = "removed"
    else:
        label, icon, change, word = "Add the samples", ":material/add:", add_samples, "added"
    if not st.button(label, key="samples", icon=icon):
        return
    with st.spinner("A moment …"):
        n_changed = change(library)
    manage_cache.forget_summaries()
    state.finish_setting(f"{count(n_changed, 'sample')} {word}.")
    st.rerun()


# --------------------------------------------------------------------------- models


def show_models() -> None:
    """List the estimators and the models with their licences."""
    st.subheader("Models and licences", anchor=False)
    head = (("Estimator", ""), ("Licence", ""), ("Available", ""), ("What it is", ""))
    rows = (
        (
            info.title,
            info.licence,
            f"no: {info.install_hint}" if info.missing else "yes",
            info.description,
        )
        for info in list_backends()
    )
    st.html(table_html(head, rows, css="ll-wraps"))
    files = manage_cache.model_files()
    with st.expander(f"Model cards ({count(len(files), 'bundled file')})"):
        st.html(
            table_html(
                (("File", ""), ("Size", "")),
                ((path.name, format_bytes(path.stat().st_size)) for path in files),
            )
        )
        st.markdown(manage_cache.model_card())
