"""One trial on exactly one page.

What does not fit is left out in a fixed order, least important first, and counted ("and 3 more
in the full result"); nothing overlaps and nothing is clipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

from engine.report.body import PhotoBox, StickFigure, pose_at
from engine.report.facts import TrialFacts, read_facts, typeset
from engine.report.figures import CurveChart, list_trunk_and_knees
from engine.report.fonts import REPLACEMENT, clean_text
from engine.report.layout import SMALL, Block, Columns, Paragraph, Stack
from engine.report.levels import CoverageBar
from engine.report.options import ReportOptions
from engine.report.parts import (
    FOOT,
    changes_part,
    equation_part,
    flags_part,
    group_methods,
    header_part,
    list_part,
    methods_part,
    provenance_line,
    section,
    sentence,
    verdict_part,
)
from engine.report.picture import NoPicture, Photo, take_photo
from engine.report.ranking import list_best_changes
from engine.report.sheet import Properties, Sheet
from engine.report.wording import Words, select_words
from engine.storage.results import StoredResult

__all__ = ["render_trial_report"]

MARGIN = 36.0
BOTTOM = 30.0
GAP = 9.0
MIN_PICTURE, MAX_PICTURE = 90.0, 250.0
FIGURE_ASPECT = 1.05
CURVE_SHARES = (1.0, 0.82)
METHODS_SHARE = 0.7


def render_trial_report(stored: StoredResult, options: ReportOptions | None = None) -> bytes:
    """Return the page of one trial as PDF; the same result gives the same bytes.

    Parameters
    ----------
    stored
        The result, with or without its annotated video.
    options
        Paper, language, title, and what to leave out.

    Raises
    ------
    ConfigError
        If paper or language are unknown.
    """
    options = options or ReportOptions()
    words = select_words(options.language)
    facts = read_facts(stored)
    page = _TrialPage(facts, words, options)
    sheet = Sheet(paper=options.checked_paper, properties=page.properties())
    page.draw(sheet)
    return sheet.to_bytes()


@dataclass(frozen=True)
class _Plan:
    """How much of each list is shown, and how high the picture is (points)."""

    flags: int
    methods: int
    changes: int = 4
    warnings: int = 4
    notes: int = 4
    why_lines: int = 2
    picture_pt: float = 168.0
    chart_pt: float = 60.0


SHRINK: tuple[tuple[str, float, float], ...] = (
    ("notes", 3, 1),
    ("flags", 6, 1),
    ("warnings", 2, 1),
    ("flags", 4, 1),
    ("why_lines", 1, 1),
    ("notes", 1, 1),
    ("picture_pt", 140, 7),
    ("flags", 2, 1),
    ("warnings", 1, 1),
    ("chart_pt", 52, 4),
    ("changes", 3, 1),
    ("methods", 8, 1),
    ("picture_pt", 119, 7),
    ("methods", 5, 1),
    ("changes", 2, 1),
    ("methods", 3, 1),
    ("picture_pt", 98, 7),
    ("changes", 1, 1),
    ("flags", 1, 1),
    ("notes", 0, 1),
    ("warnings", 0, 1),
    ("picture_pt", 70, 7),
)
"""What gives way, in this order: the list or height, down to what, in which steps."""

REGROW = (("changes", 1), ("methods", 1), ("warnings", 1), ("flags", 1), ("why_lines", 1),
          ("notes", 1))  # fmt: skip
"""What may grow again afterwards: a list beside a longer one costs no room."""


class _TrialPage:
    """Composes the page of one trial."""

    def __init__(self, facts: TrialFacts, words: Words, options: ReportOptions) -> None:
        self._facts = facts
        self._words = words
        self._options = options
        self._photo = self._take_photo()
        self._changes = list_best_changes(facts)
        self._notes = tuple(self._list_notes())

    # ----------------------------------------------------------------------- the whole

    def properties(self) -> Properties:
        """Return what the document says of itself."""
        facts, words = self._facts, self._words
        parts = (self._title(), facts.site, facts.job, words.level(facts.level))
        return Properties(
            title=clean_text(f"{words['kind']}: {self._title()}"),
            subject=clean_text(" · ".join(part for part in parts if part)),
            language=words.language,
            moment=facts.created,
            keywords=("ergonomics", "manual lifting", "NIOSH"),
        )

    def draw(self, sheet: Sheet) -> None:
        """Draw the one page."""
        width = sheet.width - 2 * MARGIN
        footer = self._footer()
        room = sheet.height - MARGIN - BOTTOM - footer.height(width) - GAP
        content = self._fit(room, width)
        content.draw(sheet, MARGIN, sheet.height - MARGIN, width)
        footer.draw(sheet, MARGIN, BOTTOM + footer.height(width), width)
        sheet.end_page()

    def _fit(self, room: float, width: float) -> Stack:
        """Return as much as fits, most important first."""

        def height(plan: _Plan) -> float:
            return self._compose(plan).height(width)

        *_, plan = takewhile_including(lambda plan: height(plan) > room, self._plans())
        full = self._full_plan()
        for name, step in REGROW:
            while getattr(plan, name) < getattr(full, name):
                larger = replace(plan, **{name: getattr(plan, name) + step})
                if height(larger) > room:
                    break
                plan = larger
        return self._spread(plan, room - height(plan))

    def _full_plan(self) -> _Plan:
        facts = self._facts
        return _Plan(
            flags=max(0, len(facts.flags) - 1),
            methods=len(group_methods(facts.methods)),
            warnings=len(facts.warnings),
            notes=len(self._notes),
        )

    def _plans(self) -> Iterator[_Plan]:
        """Yield plans from everything to the least."""
        plan = self._full_plan()
        yield plan
        for name, lowest, step in SHRINK:
            while getattr(plan, name) > lowest:
                plan = replace(plan, **{name: max(lowest, getattr(plan, name) - step)})
                yield plan

    def _spread(self, plan: _Plan, spare: float) -> Stack:
        """Give room that is left to the charts and the gaps."""
        grown = self._compose(replace(plan, chart_pt=plan.chart_pt + min(20.0, 0.2 * spare)))
        return replace(grown, gap=GAP + min(7.0, 0.6 * spare / max(1, len(grown.blocks))))

    # ----------------------------------------------------------------------- the parts

    def _compose(self, plan: _Plan) -> Stack:
        facts, words = self._facts, self._words
        rows: list[Block | None] = [
            self._header(),
            verdict_part(facts, words),
            Columns(
                (
                    self._picture(plan),
                    Stack(
                        (
                            changes_part(
                                self._changes,
                                words,
                                shown=int(plan.changes),
                                n_lifts=len(facts.lifts),
                            ),
                            self._coverage(),
                        ),
                        gap=GAP,
                    ),
                ),
                self._picture_shares(plan),
            ),
            flags_part(
                facts.flags[1:], words, shown=int(plan.flags), why_lines=int(plan.why_lines)
            ),
            *self._numbers(plan),
        ]
        return Stack(tuple(row for row in rows if row is not None), gap=GAP)

    def _numbers(self, plan: _Plan) -> tuple[Block, Block]:
        """Return equation, curves, methods and notes; notes take the place of an empty equation."""
        facts, words = self._facts, self._words
        equation, notes = equation_part(facts, words), self._side_notes(plan)
        methods = methods_part(facts.methods, words, shown=int(plan.methods))
        if facts.equation is None:
            left = Stack((equation, notes), gap=GAP)
            return Columns((left, self._curves(plan)), CURVE_SHARES), methods
        return (
            Columns((equation, self._curves(plan)), CURVE_SHARES),
            Columns((methods, notes), (METHODS_SHARE, 1 - METHODS_SHARE)),
        )

    def _picture_shares(self, plan: _Plan) -> tuple[float, float]:
        """Return the widths of picture and changes: no wider than the picture needs."""
        photo = self._photo
        wide = FIGURE_ASPECT * plan.picture_pt
        if isinstance(photo, Photo):
            wide = plan.picture_pt * photo.width_px / photo.height_px
        return -min(MAX_PICTURE, max(MIN_PICTURE, wide)), 1.0

    def _title(self) -> str:
        if self._options.title:
            return self._options.title
        if self._options.is_anonymous:
            return self._words["kind"]
        return self._facts.label or self._words["untitled"]

    def _header(self) -> Stack:
        facts, words = self._facts, self._words
        task = facts.stored.task
        load = (
            words["no_load"]
            if task.load_kg is None
            else words["load"].format(load=f"{task.load_kg:g}")
        )
        length = sum(view.info.duration_s for view in facts.stored.views[:1])
        known = math.isfinite(length) and length > 0
        return header_part(
            f"LiftLens · {words['kind']}",
            words.date(facts.created),
            self._title(),
            (
                "" if self._options.is_anonymous else words["person"].format(label=facts.person),
                facts.site or words["site_unknown"],
                facts.job or words["job_unknown"],
                load,
                words.count(len(facts.lifts), "lift"),
                words["video_length"].format(seconds=words.number(length, 1)) if known else "",
            ),
        )

    def _take_photo(self) -> Photo | NoPicture:
        moment = self._facts.moment
        if self._options.is_anonymous:
            return NoPicture("anonymous")
        if moment is None:
            return NoPicture("unreadable_video")
        return take_photo(self._facts.stored, moment.time_s)

    def _picture(self, plan: _Plan) -> Stack:
        words, moment = self._words, self._facts.moment
        title = words["picture"]
        if moment is None:
            return section(title, Paragraph.of(words["no_figure"], SMALL.quiet))
        caption = words["picture_caption"].format(
            time=words.number(moment.time_s, 1), what=moment.what
        )
        captions: list[Block] = [Paragraph.of(caption, SMALL.quiet, max_lines=3)]
        photo = self._photo
        figure: Block
        if isinstance(photo, Photo):
            figure = PhotoBox(photo, f"{words['alt_picture']} {caption}", plan.picture_pt)
        else:
            points = pose_at(self._facts.stored, moment.time_s)
            if points is None:
                return section(title, Paragraph.of(words["no_figure"], SMALL.quiet))
            skeleton = self._facts.stored.corrected.skeleton
            figure = StickFigure(points, skeleton, words, plan.picture_pt)
            why = words["picture_no_video"].format(why=words[photo.reason])
            captions.append(Paragraph.of(why, SMALL.quiet, max_lines=2))
        return section(title, figure, *captions)

    def _curves(self, plan: _Plan) -> Stack:
        stored, words, moment = self._facts.stored, self._words, self._facts.moment
        times = stored.angles.time_s
        span = (float(times[0]), float(times[-1])) if times.size else (0.0, 1.0)
        charts = list_trunk_and_knees(stored.angles, words)
        blocks = [
            CurveChart(
                title,
                curves,
                stored.lifts,
                span,
                math.nan if moment is None else moment.time_s,
                words,
                plan.chart_pt + (16.0 if title is charts[-1][0] else 0.0),
                has_time_axis=title is charts[-1][0],
            )
            for title, curves in charts
        ]
        band = Paragraph.of(words["band"], SMALL.quiet, max_lines=2)
        return section(words["curves"], *blocks, band)

    def _coverage(self) -> Stack:
        facts, words = self._facts, self._words
        shares = tuple(
            (key, word, facts.coverage[key])
            for key, word in words.vocabulary.coverage.items()
            if not math.isnan(facts.coverage[key])
        )
        bar: Block = Paragraph.of(words["coverage_unknown"], SMALL)
        if shares:
            bar = CoverageBar(shares, words)
        return section(words["coverage"], bar)

    def _list_notes(self) -> Iterator[str]:
        """Yield what a reader must keep in mind, most important first."""
        facts, words = self._facts, self._words
        yield words["note_range"]
        if facts.equation is not None:
            yield from (sentence(typeset(reason)) for reason in facts.equation.reasons)
            if facts.equation.reference:
                yield words["note_reference"].format(reference=facts.equation.reference)

    def _side_notes(self, plan: _Plan) -> Stack:
        """Return warnings and notes, in the narrow column."""
        words, warnings = self._words, self._facts.warnings
        parts = []
        if warnings and plan.warnings:
            parts.append(list_part(words["warnings"], warnings, words, shown=int(plan.warnings)))
        if plan.notes:
            parts.append(list_part(words["notes"], self._notes, words, shown=int(plan.notes)))
        return Stack(tuple(parts), gap=GAP)

    def _footer(self) -> Stack:
        words, options = self._words, self._options
        line = provenance_line(
            self._facts, words, with_file_names=options.with_file_names and not options.is_anonymous
        )
        closing = words["closing"]
        facts = self._facts
        names = f"{self._title()}{facts.person}{facts.site}{facts.job}"
        if REPLACEMENT in clean_text(names):
            closing += f" {words['note_glyphs']}"
        return Stack(
            (
                Paragraph.of(closing, SMALL, max_lines=1),
                Paragraph.of(line, FOOT, max_lines=3),
            )
        )


def takewhile_including(
    is_too_large: Callable[[_Plan], bool], plans: Iterable[_Plan]
) -> Iterator[_Plan]:
    """Yield plans up to the first that is not too large, that one included."""
    for plan in plans:
        yield plan
        if not is_too_large(plan):
            return
