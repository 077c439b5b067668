"""What `liftlens report` does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from engine.errors import ConfigError
from engine.report import ReportOptions, render_job_report, render_trial_report
from engine.report.sheet import select_paper
from engine.report.wording import select_words
from engine.storage.atomic import explain_os_errors, write_aside
from engine.storage.results import StoredResult, read_result

__all__ = ["ReportRequest", "check_report_target", "run_report", "write_report"]

Say = Callable[[str], None]
PDF_MAGIC = b"%PDF-"
SUFFIX = ".pdf"


@dataclass(frozen=True)
class ReportRequest:
    """The options of the command.

    One result gives the page of that trial, several the summary of a job or department;
    `before` are results from before a change of the work, to compare with.
    """

    results: tuple[Path, ...]
    out: Path
    before: tuple[Path, ...] = ()
    options: ReportOptions = field(default_factory=ReportOptions)

    def __post_init__(self) -> None:
        if not self.results:
            raise ConfigError("A report needs at least one result folder, got none.")
        # Wrong names fail before any work.
        select_paper(self.options.paper)
        select_words(self.options.language)
        folders = [folder.resolve() for folder in (*self.results, *self.before)]
        twice = next((f for i, f in enumerate(folders) if f in folders[:i]), None)
        if twice is not None:
            raise ConfigError(
                f"{twice.name} is given twice; the same trial may count only once in a report."
            )


def run_report(request: ReportRequest, *, say: Say) -> None:
    """Write the report and say where.

    Raises
    ------
    ConfigError
        If an option is wrong, or `out` is something that must not be replaced.
    DataError
        If a result can't be read.
    OutputError
        If the file can't be written.
    """
    target = check_report_target(request.out)
    results = [read_result(folder) for folder in request.results]
    before = [read_result(folder) for folder in request.before]
    write_report(_render(results, before, request.options), target)
    n = len(results) + len(before)
    say(f"Written: {target} ({'1 trial' if n == 1 else f'{n} trials'})")


def _render(
    results: list[StoredResult], before: list[StoredResult], options: ReportOptions
) -> bytes:
    if len(results) == 1 and not before:
        return render_trial_report(results[0], options)
    return render_job_report(results, options, before=before)


def check_report_target(path: Path) -> Path:
    """Return `path` as an absolute path if a report may be written there.

    Raises
    ------
    ConfigError
        If its name does not end in .pdf, its folder is missing, or it is anything but a PDF.
    OutputError
        If it can't be looked at.
    """
    path = Path(path).expanduser().absolute()
    if path.suffix.lower() != SUFFIX:
        raise ConfigError(f"The report is a PDF: expected a name like report.pdf, got {path.name}.")
    with explain_os_errors(path, "The report"):
        if path.is_dir():
            raise ConfigError(f"The report needs a file, but {path} is a folder; choose another.")
        if not path.parent.is_dir():
            raise ConfigError(
                f"The report can't be written to {path}: there is no folder {path.parent}; "
                "make it first or choose another."
            )
        if path.exists() and not _is_pdf(path):
            raise ConfigError(
                f"{path} exists and is no PDF, so it is not overwritten; choose another name."
            )
    return path


def _is_pdf(path: Path) -> bool:
    """Whether a file is a PDF; an empty one may be replaced too."""
    with path.open("rb") as file:
        start = file.read(len(PDF_MAGIC))
    return start in (PDF_MAGIC, b"")


def write_report(pdf: bytes, path: Path) -> Path:
    """Write a report: aside first, then renamed, so that nobody sees half of it.

    Raises
    ------
    ConfigError
        If `path` is something that must not be replaced.
    OutputError
        If it can't be written.
    """
    path = check_report_target(path)
    with explain_os_errors(path, "The report"), write_aside(path) as aside:
        aside.write_bytes(pdf)
    return path
