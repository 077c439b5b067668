"""The table of all trials of a summary, over as many pages as it needs."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

from engine.report.facts import TrialFacts, typeset
from engine.report.job_parts import describe_interval_of
from engine.report.layout import SMALL, Block, Paragraph, Stack, Style, Table, TableRow
from engine.report.levels import Chip
from engine.report.parts import LEVEL_WIDTH, section
from engine.report.wording import NO_BREAK, Words

__all__ = ["TrialTable", "name_trial"]

MIN_ROWS = 4
"""Fewer rows than this don't begin at the foot of a page, unless they are all."""


def name_trial(trial: TrialFacts, number: int, words: Words, *, is_anonymous: bool) -> str:
    """Return a name that is unique in the report: labels alone may repeat."""
    if is_anonymous or not trial.label:
        return words["trial_n"].format(n=number)
    return f"{number}. {trial.label}"


@dataclass(frozen=True, eq=False)
class TrialTable:
    """One row per trial, numbered from `first_number` on."""

    title: str
    trials: tuple[TrialFacts, ...]
    first_number: int
    words: Words
    is_anonymous: bool

    def paginate(self, width: float, rooms: Iterator[float]) -> Iterator[Stack | None]:
        """Yield the parts of the table, one per page, each under its head.

        `rooms` are the heights free on the pages; None is yielded for a page without room for
        a few rows.
        """
        empty = self._empty()
        rows = [
            self._row(trial, number)
            for number, trial in enumerate(self.trials, start=self.first_number)
        ]
        head = section(self.title, empty).height(width)
        while rows:
            heights = (empty.row_height(row, width) for row in rows)
            ends = list(itertools.accumulate(heights, initial=head))[1:]
            room = next(rooms)
            fitting = sum(end <= room for end in ends)
            if fitting < min(MIN_ROWS, len(rows)):
                yield None
                continue
            yield section(self.title, replace(empty, rows=tuple(rows[:fitting])))
            rows = rows[fitting:]

    @property
    def _has_jobs(self) -> bool:
        return len({trial.job for trial in self.trials}) > 1

    def _empty(self) -> Table:
        keys = ["trial_title", "date_title", "lifts_title", "level", "index_range", "finding"]
        shares = [1.0, -56.0, -24.0, LEVEL_WIDTH, -84.0, 1.1]
        if self._has_jobs:
            keys.insert(1, "job_title")
            shares.insert(1, 0.6)
        return Table(tuple(self.words[key] for key in keys), (), tuple(shares), gap=6.0)

    def _row(self, trial: TrialFacts, number: int) -> TableRow:
        words = self.words
        finding = typeset(trial.flags[0].what) if trial.flags else words["no_finding"]
        index = describe_interval_of(trial.index, trial.index_interval, words)
        cells: list[Block] = [
            Paragraph(self._name(trial, number), role="", max_lines=3),
            Paragraph.of(words.date(trial.created), SMALL, role="", max_lines=2),
            Paragraph.of(str(len(trial.lifts)), SMALL, role=""),
            Chip(trial.level, words.level(trial.level)),
            Paragraph.of(index, SMALL, role="", max_lines=2),
            Paragraph.of(finding, SMALL, role="", max_lines=3),
        ]
        if self._has_jobs:
            job = trial.job or words["no_job"]
            cells.insert(1, Paragraph.of(job, SMALL, role="", max_lines=2))
        return TableRow(tuple(cells))

    def _name(self, trial: TrialFacts, number: int) -> tuple[tuple[str, Style], ...]:
        name = name_trial(trial, number, self.words, is_anonymous=self.is_anonymous)
        if self.is_anonymous:
            return ((name, SMALL.bold),)
        person = f"· {self.words['person'].format(label=trial.person)}"
        return (name, SMALL.bold), (person.replace(" ", NO_BREAK), SMALL.quiet)
