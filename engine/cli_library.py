"""`liftlens library`: list, export, import and delete what was assessed.

Everything heavy is imported inside the commands, so that `--help` answers at once.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast, get_args

import typer

if TYPE_CHECKING:
    from engine.datatypes import FlagLevel
    from engine.storage.entries import Order
    from engine.storage.library import Library, TrialEntry

__all__ = ["build_app", "confirm", "delete_trials", "export_trials", "import_trials", "list_trials"]

Say = Callable[[str], None]
Guard = Callable[[Callable[..., None]], Callable[..., None]]
NOT_JUDGED = "none"
MOST_LISTED = 50
SUFFIX = ".zip"

Debug = Annotated[
    bool, typer.Option("--debug", envvar="LIFTLENS_DEBUG", help="Show tracebacks and log messages.")
]
Yes = Annotated[bool, typer.Option("--yes", help="Don't ask.")]
Site = Annotated[str | None, typer.Option(help="Only of this site.")]
Job = Annotated[str | None, typer.Option(help="Only of this job.")]
Person = Annotated[str | None, typer.Option(help="Only of this person, by pseudonym.")]


@dataclass(frozen=True)
class ListRequest:
    """Which trials to list, and how."""

    search: str = ""
    site: str | None = None
    job: str | None = None
    person: str | None = None
    level: str | None = None
    order: str = "newest"
    limit: int = MOST_LISTED
    is_json: bool = False


# --------------------------------------------------------------------------- what they do


def list_trials(library: Library, request: ListRequest, *, say: Say) -> None:
    """Say which trials there are.

    Raises
    ------
    ConfigError
        If a level, an order or the limit is none.
    """
    from engine.errors import ConfigError

    if request.limit < 1:
        raise ConfigError(f"--limit must be 1 or more, got {request.limit}.")
    found = library.query(
        search=request.search,
        site=request.site,
        job=request.job,
        person=request.person,
        level=_read_level(request.level),
        order=cast("Order", _read_order(request.order)),
        limit=request.limit,
    )
    if request.is_json:
        for entry in found.entries:
            say(json.dumps(_to_plain(entry), allow_nan=False))
        return
    if not found.total:
        where = "The library is empty" if library.is_empty else "No trial matches"
        say(f"{where} ({library.root}).")
        return
    for line in _format_entries(found.entries):
        say(line)
    if found.total > len(found.entries):
        say(f"{len(found.entries)} of {found.total} trials; --limit shows more.")


def export_trials(
    library: Library,
    target: Path,
    *,
    trials: Sequence[str] = (),
    site: str | None = None,
    job: str | None = None,
    person: str | None = None,
    say: Say,
) -> None:
    """Write trials into a zip file: those named, those that fit, or all.

    Raises
    ------
    ConfigError
        If a trial is not there, none fits, or both names and filters are given.
    OutputError
        If the file can't be written.
    """
    from engine.errors import ConfigError

    if target.suffix.lower() != SUFFIX:
        raise ConfigError(f"The export is a zip file; name it {target.name}{SUFFIX}.")
    if trials and (site or job or person):
        raise ConfigError("Name trials, or say --site, --job or --person; not both.")
    for name in trials:
        _require(library, name)
    written = library.export(target, trials=trials or None, site=site, job=job, person=person)
    say(f"Written: {written} ({written.stat().st_size / 1e6:.1f} MB)")


def import_trials(library: Library, source: Path, *, say: Say) -> None:
    """Take in what an export wrote: all of it, or nothing.

    Raises
    ------
    DataError
        If it is no such file, or damaged.
    OutputError
        If there is no space.
    """
    report = library.import_archive(source)
    for before, now in report.imported.items():
        say(f"Imported: {now}" + ("" if now == before else f" (was {before}, which is taken)"))
    for name in report.already_there:
        say(f"Already there: {name}")
    if not report.imported and not report.already_there:
        say("The file holds no trial.")


def delete_trials(
    library: Library,
    trials: Sequence[str] = (),
    *,
    person: str | None = None,
    is_sure: bool = False,
    ask: Callable[[str], bool] | None = None,
    say: Say,
) -> None:
    """Delete trials, or a person, with all that belongs to them.

    Raises
    ------
    ConfigError
        If nothing or something unknown is named, or nobody can be asked.
    Cancelled
        If the answer is no.
    OutputError
        If something can't be deleted.
    """
    from engine.errors import ConfigError

    if bool(trials) == bool(person):
        raise ConfigError(
            "Name the trials to delete, or one --person; see `liftlens library list`."
        )
    for name in trials:
        _require(library, name)
    names = list(dict.fromkeys(trials))
    what = f"everything about the person {person!r}" if person else _count(len(names))
    confirm(f"Delete {what} for good?", is_sure=is_sure, ask=ask)
    if person:
        say(f"Deleted: {_count(library.delete_person(person))} of {person}")
    for name in names:
        library.delete(name)
        say(f"Deleted: {name}")


def confirm(question: str, *, is_sure: bool, ask: Callable[[str], bool] | None = None) -> None:
    """Ask before something is lost.

    Parameters
    ----------
    question
        With what will be lost.
    is_sure
        No question then.
    ask
        Puts the question; None where nobody can answer.

    Raises
    ------
    ConfigError
        If nobody can answer.
    Cancelled
        If the answer is no.
    """
    from engine.errors import Cancelled, ConfigError

    if is_sure:
        return
    if ask is None:
        raise ConfigError(f"{question} Nobody can answer here; say --yes if you are sure.")
    if not ask(question):
        raise Cancelled("Nothing was changed.")


def _require(library: Library, trial_id: str) -> None:
    from engine.errors import ConfigError

    known = library.query(limit=1).total
    if not library.has(trial_id):
        raise ConfigError(
            f"There is no trial {trial_id!r} among the {_count(known)} of {library.root}; "
            "`liftlens library list` says which there are."
        )


def _read_level(text: str | None) -> FlagLevel | set[FlagLevel | None] | None:
    from engine.datatypes import FlagLevel
    from engine.errors import ConfigError

    if text is None:
        return None
    if text == NOT_JUDGED:
        return {None}
    words = [level.value for level in FlagLevel]
    if text not in words:
        raise ConfigError(f"--level is {', '.join(words)} or {NOT_JUDGED}, got {text!r}.")
    return FlagLevel(text)


def _read_order(text: str) -> str:
    from engine.errors import ConfigError
    from engine.storage.entries import Order

    if text not in get_args(Order):
        raise ConfigError(f"--order is one of {', '.join(get_args(Order))}, got {text!r}.")
    return text


def _count(number: int) -> str:
    return f"{number} trial{'' if number == 1 else 's'}"


def _format_entries(entries: Sequence[TrialEntry]) -> list[str]:
    from engine.cli_output import format_columns, format_index

    rows = []
    for entry in entries:
        if entry.is_damaged:
            rows.append((entry.id, "", "(damaged)", "", "", "", "-", "-"))
            continue
        rows.append(
            (
                entry.id,
                entry.created[:16].replace("T", " "),
                entry.label,
                entry.subject,
                entry.site,
                entry.job,
                "-" if entry.li is None else format_index(entry.li, entry.li_interval),
                "-" if entry.worst_level is None else entry.worst_level.value,
            )
        )
    titles = ("Trial", "Made (UTC)", "Name", "Person", "Site", "Job", "Lifting index", "Flag")
    return format_columns(titles, rows)


def _to_plain(entry: TrialEntry) -> dict[str, Any]:
    """Return what a script wants to know; a lifting index without bound is null, and said so."""
    is_bounded = entry.li is not None and entry.li != float("inf")
    return {
        "id": entry.id,
        "is_damaged": entry.is_damaged,
        "created": entry.created,
        "label": entry.label,
        "person": entry.subject,
        "site": entry.site,
        "job": entry.job,
        "tags": list(entry.tags),
        "lifting_index": entry.li if is_bounded else None,
        "category": entry.category,
        "level": None if entry.worst_level is None else entry.worst_level.value,
    }


# --------------------------------------------------------------------------- the commands


def build_app(guard: Guard) -> typer.Typer:
    """Return the sub-commands; `guard` turns their failures into one sentence and an exit code."""
    library = typer.Typer(
        help="List, export, import or delete what was assessed.",
        no_args_is_help=True,
        rich_markup_mode=None,
    )
    library.command("list", short_help="List the trials.")(guard(_list))
    library.command("export", short_help="Write trials into one zip file.")(guard(_export))
    library.command("import", short_help="Take in what an export wrote.")(guard(_import))
    library.command("delete", short_help="Delete trials, or a person.")(guard(_delete))
    return library


def _open() -> Library:
    from engine.storage.library import Library

    return Library.open()


def _ask() -> Callable[[str], bool] | None:
    """Return what asks the user; None where nobody sits in front of it."""
    return typer.confirm if sys.stdin.isatty() else None


def _list(
    search: Annotated[str, typer.Option(help="Words of the name, person, site, job or tags.")] = "",
    site: Site = None,
    job: Job = None,
    person: Person = None,
    level: Annotated[str | None, typer.Option(help="high, review, ok or none.")] = None,
    order: Annotated[str, typer.Option(help="newest, oldest, level, index or label.")] = "newest",
    limit: Annotated[int, typer.Option(help="How many at most.")] = MOST_LISTED,
    is_json: Annotated[bool, typer.Option("--json", help="One JSON object a line.")] = False,
    debug: Debug = False,
) -> None:
    """List the trials, newest first."""
    request = ListRequest(search, site, job, person, level, order, limit, is_json)
    list_trials(_open(), request, say=typer.echo)


def _export(
    out: Annotated[Path, typer.Argument(metavar="FILE.zip", help="The file to write.")],
    trials: Annotated[
        list[str] | None, typer.Argument(metavar="[TRIAL]...", help="Which ones; all by default.")
    ] = None,
    site: Site = None,
    job: Job = None,
    person: Person = None,
    yes: Yes = False,
    debug: Debug = False,
) -> None:
    """Write trials with notes, tags and reviews into one zip file.

    It may show persons: keep it as safe as the library itself.
    """
    if out.exists():
        confirm(f"{out} is there already; replace it?", is_sure=yes, ask=_ask())
    export_trials(
        _open(), out, trials=trials or (), site=site, job=job, person=person, say=typer.echo
    )


def _import(
    source: Annotated[Path, typer.Argument(metavar="FILE.zip", help="From `library export`.")],
    debug: Debug = False,
) -> None:
    """Take in what `library export` wrote, here or on another computer: all of it or nothing."""
    import_trials(_open(), source, say=typer.echo)


def _delete(
    trials: Annotated[
        list[str] | None, typer.Argument(metavar="[TRIAL]...", help="Ids, as `list` shows them.")
    ] = None,
    person: Annotated[
        str | None, typer.Option(help="A person's pseudonym: all their trials and files go.")
    ] = None,
    yes: Yes = False,
    debug: Debug = False,
) -> None:
    """Delete trials, or a person, with videos, measurements, notes and uploads."""
    delete_trials(_open(), trials or (), person=person, is_sure=yes, ask=_ask(), say=typer.echo)
