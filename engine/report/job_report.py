"""Several trials in one document: the summary on the first page, then every trial in a table."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING

from engine.errors import ConfigError
from engine.report.facts import TrialFacts, fingerprint, read_facts
from engine.report.fonts import REPLACEMENT, clean_text
from engine.report.job_facts import GroupFacts, list_jobs, summarise_trials
from engine.report.job_parts import (
    comparison_part,
    frequent_changes_part,
    group_verdict_part,
    jobs_part,
    shares_part,
    trend_part,
    worst_lifts_part,
)
from engine.report.job_tables import TrialTable, name_trial
from engine.report.layout import SMALL, Block, Columns, Paragraph, Stack
from engine.report.options import ReportOptions
from engine.report.parts import FOOT, header_part
from engine.report.sheet import Properties, Sheet
from engine.report.wording import Words, select_words
from engine.storage.results import StoredResult
from engine.version import __version__

if TYPE_CHECKING:
    from engine.ergonomics.before_after import BeforeAfter

__all__ = ["render_job_report"]

MARGIN = 36.0
BOTTOM = 30.0
GAP = 11.0
MAX_WORST = 5
MAX_CHANGES = 5
MAX_JOBS = 8
MAX_MEASURES = 8


def render_job_report(
    results: Sequence[StoredResult],
    options: ReportOptions | None = None,
    *,
    before: Sequence[StoredResult] = (),
) -> bytes:
    """Return the summary of several trials as PDF; the same results give the same bytes.

    Parameters
    ----------
    results
        The trials of a job or of a department, in any order.
    options
        Paper, language, title, and what to leave out.
    before
        Trials from before a change of the work, to compare with.

    Raises
    ------
    ConfigError
        If there is no trial, or paper or language are unknown.
    """
    if not results:
        raise ConfigError("A summary needs at least one result, got none; name result folders.")
    options = options or ReportOptions()
    words = select_words(options.language)
    group = summarise_trials(map(read_facts, results))
    earlier = summarise_trials(map(read_facts, before)) if before else None
    report = _JobReport(group, earlier, words, options)
    sheet = Sheet(paper=options.checked_paper, properties=report.properties())
    report.draw(sheet)
    return sheet.to_bytes()


def _compare(before: GroupFacts, after: GroupFacts) -> BeforeAfter:
    # It loads signal processing, which takes longer than a summary without comparison.
    from engine.improve import compare_results

    return compare_results(
        [trial.stored for trial in before.trials], [trial.stored for trial in after.trials]
    )


@dataclass(frozen=True)
class _Plan:
    """How much of each list the first page shows."""

    jobs: int = MAX_JOBS
    measures: int = MAX_MEASURES
    worst: int = MAX_WORST
    changes: int = MAX_CHANGES
    chart_pt: float = 105.0


SHRINK = (
    ("measures", 5, 1),
    ("chart_pt", 80, 5),
    ("jobs", 4, 1),
    ("changes", 3, 1),
    ("worst", 3, 1),
    ("measures", 3, 1),
    ("jobs", 2, 1),
    ("changes", 1, 1),
    ("worst", 1, 1),
    ("chart_pt", 60, 5),
    ("measures", 1, 1),
)
"""What gives way, in this order: the list or height, down to what, in which steps."""


class _JobReport:
    """Composes the pages of a summary."""

    def __init__(
        self, group: GroupFacts, earlier: GroupFacts | None, words: Words, options: ReportOptions
    ) -> None:
        self._group = group
        self._earlier = earlier
        self._outcome = _compare(earlier, group) if earlier is not None else None
        self._words = words
        self._options = options

    # ----------------------------------------------------------------------- the whole

    def properties(self) -> Properties:
        """Return what the document says of itself."""
        words, moments = self._words, self._moments()
        n_trials = words.count(len(self._group.trials), "trial")
        return Properties(
            title=clean_text(f"{words['summary_kind']}: {self._title()}"),
            subject=clean_text(f"{n_trials} · {words.level(self._group.level)}"),
            language=words.language,
            moment=max(moments) if moments else None,
            keywords=("ergonomics", "manual lifting", "NIOSH", "summary"),
        )

    def draw(self, sheet: Sheet) -> None:
        """Draw the summary and the table of trials, each page with its number."""
        width = sheet.width - 2 * MARGIN
        top = sheet.height - MARGIN
        room = top - BOTTOM - self._footer(1, 1).height(width) - GAP
        pages = self._list_pages(room, width)
        for number, page in enumerate(pages, start=1):
            page.draw(sheet, MARGIN, top, width)
            footer = self._footer(number, len(pages))
            footer.draw(sheet, MARGIN, BOTTOM + footer.height(width), width)
            sheet.end_page()

    def _list_pages(self, room: float, width: float) -> list[Stack]:
        """Return the pages; a table begins on the page before it if that has room."""
        pages = [self._fit(room, width)]
        for table in self._tables():
            left = room - pages[-1].height(width) - GAP
            begun, *more = table.paginate(width, itertools.chain([left], itertools.repeat(room)))
            if begun is not None:
                pages[-1] = replace(pages[-1], blocks=(*pages[-1].blocks, begun))
            pages += [Stack((part,), gap=GAP) for part in more if part is not None]
        return [self._spread(page, room, width) for page in pages]

    def _tables(self) -> Iterator[TrialTable]:
        words, hidden = self._words, self._options.is_anonymous
        trials = self._group.trials
        yield TrialTable(words["all_trials"], trials, 1, words, hidden)
        if self._earlier is not None:
            first = len(trials) + 1
            yield TrialTable(words["all_before"], self._earlier.trials, first, words, hidden)

    def _fit(self, room: float, width: float) -> Stack:
        plan = _Plan()
        content = self._compose(plan)
        for name, lowest, step in SHRINK:
            while content.height(width) > room and getattr(plan, name) > lowest:
                plan = replace(plan, **{name: getattr(plan, name) - step})
                content = self._compose(plan)
        return content

    def _spread(self, content: Stack, room: float, width: float) -> Stack:
        """Give room that is left to the gaps."""
        spare = max(0.0, room - content.height(width))
        return replace(content, gap=GAP + min(8.0, 0.5 * spare / len(content.blocks)))

    def _compose(self, plan: _Plan) -> Stack:
        group, words = self._group, self._words
        trend = trend_part(self._all_trials(), words, height_pt=plan.chart_pt)
        rows: list[Block] = [
            self._header(),
            group_verdict_part(group, words),
            Columns((shares_part(group, words), trend), (0.75, 1.0)),
        ]
        if self._earlier is not None:
            assert self._outcome is not None  # compared where there is something earlier
            rows.append(
                comparison_part(
                    self._earlier, group, self._outcome, words, shown=int(plan.measures)
                )
            )
        jobs = list_jobs(group)
        if len(jobs) > 1:
            rows.append(jobs_part(jobs, words, shown=int(plan.jobs)))
        rows += [
            worst_lifts_part(group, words, name_trial=self._name, shown=int(plan.worst)),
            frequent_changes_part(group, words, shown=int(plan.changes)),
        ]
        return Stack(tuple(rows), gap=GAP)

    # ----------------------------------------------------------------------- head and foot

    def _all_trials(self) -> tuple[TrialFacts, ...]:
        return (*(self._earlier.trials if self._earlier else ()), *self._group.trials)

    def _name(self, trial: TrialFacts, number: int) -> str:
        return name_trial(trial, number, self._words, is_anonymous=self._options.is_anonymous)

    def _title(self) -> str:
        if self._options.title:
            return self._options.title
        jobs = {trial.job for trial in self._group.trials}
        return (jobs.pop() if len(jobs) == 1 else "") or self._words["summary_title"]

    def _moments(self) -> list[datetime]:
        return [trial.created for trial in self._group.trials if trial.created is not None]

    def _header(self) -> Stack:
        words, group = self._words, self._group
        sites = sorted({trial.site for trial in group.trials if trial.site})
        return header_part(
            f"LiftLens · {words['summary_kind']}",
            self._period(),
            self._title(),
            (
                ", ".join(sites) or words["site_unknown"],
                words.count(len(group.trials), "trial"),
                words.count(group.n_lifts, "lift"),
                words.count(len(group.persons), "person_noun"),
            ),
        )

    def _period(self) -> str:
        words, moments = self._words, self._moments()
        if not moments:
            return words.date(None)
        first, last = words.date(min(moments)), words.date(max(moments))
        return first if first == last else words["date_range"].format(first=first, last=last)

    def _footer(self, page: int, pages: int) -> Stack:
        words, trials = self._words, self._all_trials()
        closing = words["closing"]
        names = "".join(f"{t.label}{t.person}{t.site}{t.job}" for t in trials)
        if REPLACEMENT in clean_text(names + self._title()):
            closing += f" {words['note_glyphs']}"
        number = Paragraph.of(words["page"].format(page=page, pages=pages), FOOT, align="right")
        return Stack(
            (
                Paragraph.of(closing, SMALL, max_lines=1),
                Columns(
                    (Paragraph.of(self._provenance(), FOOT, max_lines=1), number), (1.0, -60.0)
                ),
            )
        )

    def _provenance(self) -> str:
        words, documents = self._words, [t.stored.document for t in self._all_trials()]
        versions = sorted({str(d.get("liftlens_version") or words["unknown"]) for d in documents})
        return words["summary_provenance"].format(
            version=__version__,
            results=", ".join(f"LiftLens {version}" for version in versions),
            hash=fingerprint(sorted(map(fingerprint, documents))),
        )
