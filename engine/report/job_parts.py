"""The parts of a summary's first page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from engine.datatypes import FlagLevel
from engine.report.facts import URGENCY, TrialFacts, choose_index_digits, typeset
from engine.report.figures import TrendChart, TrendPoint
from engine.report.job_facts import GroupFacts, JobFacts
from engine.report.layout import (
    BODY,
    SMALL,
    SOFT,
    Block,
    Columns,
    Panel,
    Paragraph,
    Stack,
    Table,
    TableRow,
)
from engine.report.levels import LEVEL_COLOURS, Chip, LevelBar
from engine.report.parts import (
    CHIP,
    LEVEL_WIDTH,
    VERDICT,
    Chipped,
    choose_number_style,
    describe_index,
    more_line,
    section,
    sentence,
)
from engine.report.wording import Words

if TYPE_CHECKING:
    from engine.ergonomics.before_after import BeforeAfter, MeasureChange

__all__ = [
    "comparison_part",
    "describe_interval_of",
    "frequent_changes_part",
    "group_verdict_part",
    "jobs_part",
    "shares_part",
    "trend_part",
    "worst_lifts_part",
]

NameTrial = Callable[[TrialFacts, int], str]


def group_verdict_part(group: GroupFacts, words: Words) -> Panel:
    """State how many trials call for what, and the highest lifting index."""
    counts, total, level = dict(group.trial_levels), len(group.trials), group.level
    key = "none" if level is None else str(level.value)
    texts: list[Block] = [
        Chipped(Chip(level, words.level(level), CHIP)),
        Paragraph.of(
            words[f"verdict_{key}"].format(n=counts[level], total=total), VERDICT, max_lines=2
        ),
        Paragraph.of(words["counts"].format(**{str(k): counts[FlagLevel(k)] for k in URGENCY})),
    ]
    if level is not None and counts[None]:
        note = words["not_judged_trials"].format(n=counts[None], total=total)
        texts.append(Paragraph.of(note, SMALL.quiet, max_lines=1))
    return Panel(
        Columns((Stack(tuple(texts), gap=2.0), _highest_part(group, words)), (1.0, -150.0)),
        tone=LEVEL_COLOURS[level],
        fill=SOFT,
    )


def _highest_part(group: GroupFacts, words: Words) -> Stack:
    value, under = words["not_judged"], words["no_indices"]
    if group.worst:
        lift = group.worst[0].lift
        value = describe_index(lift.lifting_index, words)
        digits = choose_index_digits(lift.lifting_index)
        under = words["range"].format(range=words.interval(lift.interval, digits))
        if math.isinf(lift.lifting_index):
            under = words["index_infinite"]
    return Stack(
        (
            Paragraph.of(words["worst_index"], SMALL.bold.quiet, align="right", max_lines=1),
            Paragraph.of(value, choose_number_style(value), align="right", max_lines=1),
            Paragraph.of(under, SMALL, align="right", max_lines=3),
            Paragraph.of(words["index_goal"], SMALL, align="right", max_lines=1),
        )
    )


def shares_part(group: GroupFacts, words: Words) -> Stack:
    """Show how many lifts have each level."""
    if not group.n_lifts:
        return section(words["shares"], Paragraph.of(words["no_lifts"], BODY.quiet))
    note = Paragraph.of(words["shares_note"], SMALL.quiet, max_lines=3)
    return section(words["shares"], LevelBar(group.lift_levels, words), note, gap=4.0)


def trend_part(trials: Sequence[TrialFacts], words: Words, *, height_pt: float) -> Stack:
    """Show the lifting indices over the dates; they need two days at least."""
    points = [
        TrendPoint(trial.created, trial.index, trial.index_interval, trial.level)
        for trial in trials
        if trial.created is not None and not math.isnan(trial.index)
    ]
    points.sort(key=lambda point: point.moment)
    if len({point.moment.date() for point in points}) < 2:
        return section(words["trend"], Paragraph.of(words["no_trend"], BODY.quiet))
    note = Paragraph.of(words["trend_note"], SMALL.quiet, max_lines=2)
    return section(words["trend"], TrendChart(tuple(points), words, height_pt), note)


def jobs_part(jobs: Sequence[JobFacts], words: Words, *, shown: int) -> Stack:
    """Compare the jobs of a department, the most urgent first."""
    keys = ("job_title", "level", "trials_title", "lifts_title", "share_high", "highest_index")
    rows = tuple(_job_row(job, words) for job in jobs[:shown])
    shares = (1.0, LEVEL_WIDTH, -36.0, -30.0, -82.0, -110.0)
    table = Table(tuple(words[key] for key in keys), rows, shares)
    return section(words["jobs"], table, *more_line(len(jobs) - shown, words, "not_shown"))


def _job_row(job: JobFacts, words: Words) -> TableRow:
    group = job.group
    return TableRow(
        (
            Paragraph.of(job.name or words["no_job"], SMALL.bold, role="", max_lines=2),
            Chip(group.level, words.level(group.level)),
            Paragraph.of(str(len(group.trials)), SMALL, role=""),
            Paragraph.of(str(group.n_lifts), SMALL, role=""),
            Paragraph.of(_share_high(group, words), SMALL, role=""),
            Paragraph.of(_highest_text(group, words), SMALL, role="", max_lines=2),
        )
    )


def _share_high(group: GroupFacts, words: Words) -> str:
    if not group.n_lifts:
        return words["no_lifts_short"]
    share = f"{group.n_high_lifts / group.n_lifts:.0%}".replace("%", "\u00a0%")
    return words["share_of"].format(n=group.n_high_lifts, total=group.n_lifts, share=share)


def _highest_text(group: GroupFacts, words: Words) -> str:
    if not group.worst:
        return words["not_judged"]
    lift = group.worst[0].lift
    return describe_interval_of(lift.lifting_index, lift.interval, words)


def describe_interval_of(value: float, interval: tuple[float, float], words: Words) -> str:
    """Return a lifting index with its range, or that there is none."""
    if math.isnan(value):
        return words["not_judged"]
    if math.isinf(value) or math.isnan(interval[0]):
        return words.number(value, 1)
    shown = words.interval(interval, choose_index_digits(value))
    return f"{describe_index(value, words)} ({shown})"


def worst_lifts_part(
    group: GroupFacts, words: Words, *, name_trial: NameTrial, shown: int
) -> Stack:
    """List the lifts with the highest lifting indices."""
    if not group.worst:
        return section(words["worst"], Paragraph.of(words["no_indices"], BODY.quiet))
    keys = ("level", "trial_title", "lift_title", "index_title", "date_title")
    rows = []
    for entry in group.worst[:shown]:
        lift = entry.lift
        cells = (
            str(lift.number),
            describe_interval_of(lift.lifting_index, lift.interval, words),
            words.date(entry.trial.created),
        )
        name = name_trial(entry.trial, entry.number)
        rows.append(
            TableRow(
                (
                    Chip(lift.level, words.level(lift.level)),
                    Paragraph.of(name, SMALL.bold, role="", max_lines=2),
                    *(Paragraph.of(cell, SMALL, role="") for cell in cells),
                )
            )
        )
    shares = (LEVEL_WIDTH, 1.0, -30.0, -118.0, -74.0)
    return section(words["worst"], Table(tuple(words[key] for key in keys), tuple(rows), shares))


def frequent_changes_part(group: GroupFacts, words: Words, *, shown: int) -> Stack:
    """List what is asked for in most trials."""
    changes, total = group.changes, len(group.trials)
    if not changes:
        return section(words["common_changes"], Paragraph.of(words["no_changes"], BODY.quiet))
    rows: list[Block] = []
    for number, (action, n) in enumerate(changes[:shown], start=1):
        often = words["in_trials"].format(n=n, total=total)
        runs = ((typeset(action), BODY), (f"· {often}", SMALL.quiet))
        mark = Paragraph.of(f"{number}.", BODY.bold)
        rows.append(Columns((mark, Paragraph(runs, max_lines=3)), (-10.0, 1.0), gap=3.0))
    more = more_line(len(changes) - shown, words, "not_shown")
    return section(words["common_changes"], *rows, *more, gap=3.0)


def comparison_part(
    before: GroupFacts, after: GroupFacts, outcome: BeforeAfter, words: Words, *, shown: int
) -> Stack:
    """Put before beside after, with the differences and what may be said of them."""
    blank = (words["not_compared"], words["not_compared"])
    both = (before, after)
    lines = [
        (words["trials_title"], *(str(len(group.trials)) for group in both), *blank),
        (words["lifts_title"], *(str(group.n_lifts) for group in both), *blank),
        (words["share_high"], *(_share_high(group, words) for group in both), *blank),
        *(_describe_change(change, words) for change in outcome.changes[:shown]),
    ]
    rows = tuple(
        TableRow(
            (
                Paragraph.of(name, SMALL.bold, role="", max_lines=2),
                *(Paragraph.of(cell, SMALL, role="") for cell in cells),
            )
        )
        for name, *cells in lines
    )
    keys = ("measure", "before", "after", "difference", "outcome")
    table = Table(tuple(words[key] for key in keys), rows, (1.0, -66.0, -66.0, -110.0, -86.0))
    said: list[Block] = [Paragraph.of(sentence(typeset(outcome.sentence)), BODY, max_lines=3)]
    if outcome.reasons:
        reasons = " ".join(_join_reasons(outcome.reasons, words))
        said.append(Paragraph.of(reasons, SMALL.quiet, max_lines=4))
    more = more_line(len(outcome.changes) - shown, words, "not_shown")
    return section(words["comparison"], *said, table, *more, gap=3.0)


NOT_KNOWN = " is not known of all trials, and not compared"
"""How a comparison says so of one measure; of several it is said once."""


def _join_reasons(reasons: Sequence[str], words: Words) -> list[str]:
    unknown = [r.removesuffix(NOT_KNOWN) for r in reasons if r.endswith(NOT_KNOWN)]
    others = [sentence(typeset(reason)) for reason in reasons if not reason.endswith(NOT_KNOWN)]
    if unknown:
        others.append(words["unknown_measures"].format(names=", ".join(unknown)))
    return others


def _describe_change(change: MeasureChange, words: Words) -> tuple[str, ...]:
    """Return measure, before, after, difference and outcome in words."""
    measure, (low, high) = change.measure, change.interval
    digits, unit = measure.decimals, "°" if measure.unit == "deg" else measure.unit
    difference = words.number(change.difference, digits)
    if not math.isnan(low):
        difference = words["difference_of"].format(
            difference=difference, low=words.number(low, digits), high=words.number(high, digits)
        )
    return (
        measure.name[:1].upper() + measure.name[1:],
        words.quantity(change.before, unit, digits),
        words.quantity(change.after, unit, digits),
        difference,
        words[change.verdict.value],
    )
