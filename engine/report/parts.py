"""The parts that reports share: headings, the verdict, lists of flags, tables, the footer."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from engine.datatypes import Flag, FlagLevel
from engine.report.facts import (
    ChangeFacts,
    EndFacts,
    EquationFacts,
    MethodFacts,
    TrialFacts,
    choose_index_digits,
    fingerprint,
    typeset,
)
from engine.report.layout import (
    BODY,
    BRAND,
    QUIET,
    SMALL,
    SOFT,
    Block,
    Columns,
    Panel,
    Paragraph,
    Stack,
    Style,
    Table,
    TableRow,
)
from engine.report.levels import LEVEL_COLOURS, Chip
from engine.report.sheet import Sheet
from engine.report.wording import Words

__all__ = [
    "CHIP",
    "FOOT",
    "HEADING",
    "LEVEL_WIDTH",
    "TITLE",
    "VERDICT",
    "Chipped",
    "changes_part",
    "choose_number_style",
    "describe_index",
    "equation_part",
    "flags_part",
    "group_methods",
    "header_part",
    "list_part",
    "methods_part",
    "more_line",
    "provenance_line",
    "section",
    "sentence",
    "verdict_part",
]

TITLE = Style(size=15, lead=19, is_bold=True)
KICKER = Style(size=7, lead=9, is_bold=True, colour=BRAND)
VERDICT = Style(size=10.5, lead=13.5, is_bold=True)
HEADING = Style(size=8.6, lead=12, is_bold=True, colour=BRAND)
FOOT = Style(size=6.1, lead=8.0, colour=QUIET)
NUMBER = Style(size=22, lead=25, is_bold=True)
CHIP = Style(size=9.5, lead=13)
LEVEL_WIDTH = -62.0
"""Points that a level takes in a column: shape and the longest word."""


def section(title: str, *blocks: Block, gap: float = 2.0) -> Stack:
    """Put blocks under a heading."""
    return Stack((Paragraph.of(title, HEADING, role="H2", max_lines=1), *blocks), gap=gap)


def header_part(kicker: str, date: str, title: str, facts: Sequence[str]) -> Stack:
    """Say what this is, of what, and of whom."""
    return Stack(
        (
            Columns(
                (
                    Paragraph.of(kicker, KICKER, max_lines=1),
                    Paragraph.of(date, SMALL.quiet, max_lines=1, align="right"),
                ),
                (1.0, 1.0),
            ),
            Paragraph.of(title, TITLE, role="H1", max_lines=2),
            Paragraph.of(" · ".join(fact for fact in facts if fact), BODY.quiet, max_lines=2),
        ),
        gap=1.0,
    )


def verdict_part(facts: TrialFacts, words: Words, *, why_lines: int = 3) -> Panel:
    """State the level in words, why, and the lifting index with its range."""
    lead = facts.flags[0] if facts.flags else None
    counts = words["counts"].format(
        high=facts.count(FlagLevel.HIGH),
        review=facts.count(FlagLevel.REVIEW),
        ok=facts.count(FlagLevel.OK),
    )
    texts: list[Block] = [
        Chipped(Chip(facts.level, words.level(facts.level), CHIP)),
        Paragraph.of(words.meaning(facts.level), VERDICT, max_lines=2, role="P"),
    ]
    if lead is None:
        texts.append(Paragraph.of(words["no_flags"]))
    else:
        runs = ((typeset(lead.what) + ".", BODY.bold), (typeset(lead.why), BODY))
        texts += [
            Paragraph(runs, max_lines=why_lines),
            Paragraph.of(counts, SMALL.quiet, max_lines=1),
        ]
    return Panel(
        Columns((Stack(tuple(texts), gap=1.5), _index_part(facts, words)), (1.0, -136.0)),
        tone=LEVEL_COLOURS[facts.level],
        fill=SOFT,
    )


@dataclass(frozen=True)
class Chipped:
    """A chip as a paragraph of its own."""

    chip: Chip

    def height(self, width: float) -> float:
        """Return the height of one line."""
        return self.chip.height(width)

    def draw(self, sheet: Sheet, x: float, top: float, width: float) -> None:
        """Draw the chip under a tag."""
        with sheet.tag("P"):
            self.chip.draw(sheet, x, top, width)


def _index_part(facts: TrialFacts, words: Words) -> Stack:
    """Return the number at the right of the verdict: index, else limit, else that there is none."""
    digits = choose_index_digits(facts.index)
    if math.isfinite(facts.index):
        value = words.number(facts.index, digits)
        lines = [words["range"].format(range=words.interval(facts.index_interval, digits))]
        lines.append(words["index_word"].format(category=facts.index_category))
        title = words["index"]
    elif math.isinf(facts.index):
        title, value = words["index"], words["infinite"]
        lines = [words["index_infinite"], words["index_goal"]]
    elif math.isfinite(facts.limit_kg):
        title, value = words["limit"], words.quantity(facts.limit_kg, "kg", 1)
        interval = words.interval(facts.limit_interval_kg, 1)
        lines = [words["range"].format(range=f"{interval} kg"), words["no_load"]]
    else:
        title, value = words["index"], words["not_judged"]
        lines = [words["index_refused" if facts.refused else "index_absent"]]
    return Stack(
        (
            Paragraph.of(title, SMALL.bold.quiet, align="right", max_lines=1),
            Paragraph.of(value, choose_number_style(value), align="right", max_lines=1),
            *(Paragraph.of(line, SMALL, align="right", max_lines=2) for line in lines if line),
        )
    )


def choose_number_style(value: str) -> Style:
    """Return large type for numbers, smaller for words."""
    return NUMBER if len(value) < 8 else Style(size=12, lead=17, is_bold=True)


def flags_part(
    flags: Sequence[Flag], words: Words, *, shown: int, why_lines: int = 2
) -> Stack | None:
    """List flags: level, what, when and why; None where there is none to show."""
    if not flags or not shown:
        return None
    rows: list[Block] = [_flag_row(flag, words, why_lines) for flag in flags[:shown]]
    return section(words["flags"], *rows, *more_line(len(flags) - shown, words), gap=3.0)


def _flag_row(flag: Flag, words: Words, why_lines: int) -> Columns:
    lead: tuple[tuple[str, Style], ...] = ((typeset(flag.what), BODY.bold),)
    when = words.window(flag.start_s, flag.end_s)
    if when:
        lead += ((f"· {when}", SMALL.quiet),)
    texts = (
        Paragraph(lead, max_lines=2),
        Paragraph.of(typeset(flag.why), SMALL, max_lines=why_lines),
    )
    chip = Chipped(Chip(flag.level, words.level(flag.level)))
    return Columns((chip, Stack(texts)), (LEVEL_WIDTH, 1.0), gap=6.0)


def more_line(n: int, words: Words, key: str = "and_more") -> tuple[Block, ...]:
    """Say how many are left out; nothing where none are."""
    if n <= 0:
        return ()
    return (Paragraph.of(words[key].format(n=n), SMALL.quiet, max_lines=1),)


def changes_part(
    changes: Sequence[ChangeFacts],
    words: Words,
    *,
    shown: int,
    n_lifts: int = 1,
    max_lines: int = 5,
) -> Stack:
    """List what to change, most urgent first."""
    if not changes:
        return section(words["changes"], Paragraph.of(words["no_changes"], BODY.quiet))
    rows: list[Block] = []
    for number, change in enumerate(changes[:shown], start=1):
        runs: tuple[tuple[str, Style], ...] = ((typeset(change.text), BODY),)
        if change.methods:
            runs += ((f"({_name_askers(change, words)})", SMALL.quiet),)
        if n_lifts > 1 and change.lift_number is not None:
            lift = words["lift_n"].format(n=change.lift_number)
            runs = ((f"{lift}:", BODY.bold), *runs)
        mark = Paragraph.of(f"{number}.", BODY.bold)
        rows.append(Columns((mark, Paragraph(runs, max_lines=max_lines)), (-10.0, 1.0), gap=3.0))
    if any(not change.methods for change in changes[:shown]):
        rows.append(Paragraph.of(words["tried"], SMALL.quiet, max_lines=2))
    return section(words["changes"], *rows, *more_line(len(changes) - shown, words), gap=4.0)


def _name_askers(change: ChangeFacts, words: Words) -> str:
    first, *others = map(words.method, change.methods)
    return words["also"].format(first=first, others=", ".join(others)) if others else first


def list_part(
    title: str, lines: Sequence[str], words: Words, *, shown: int, max_lines: int = 4
) -> Stack:
    """List sentences under a heading."""
    rows: list[Block] = [
        Paragraph.of(sentence(typeset(line)), SMALL, max_lines=max_lines) for line in lines[:shown]
    ]
    return section(title, *rows, *more_line(len(lines) - shown, words), gap=1.5)


def sentence(text: str) -> str:
    """Return a reason as a sentence."""
    text = text.strip()
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith((".", "!", "?", "…")) else ".")


# --------------------------------------------------------------------------- tables


def equation_part(facts: TrialFacts, words: Words) -> Stack:
    """Show the lifting equation of the worst lift, both ends side by side."""
    equation = facts.equation
    if equation is None:
        if facts.refused:
            why = words["equation_refused"].format(why=" ".join(map(sentence, facts.refused)))
        else:
            why = words["no_equation"]
        return section(words["equation"], Paragraph.of(why, BODY, max_lines=6))
    title = words["equation"]
    if len(facts.lifts) > 1:
        title = words["equation_lift"].format(lift=equation.lift_number, n=len(facts.lifts))
    ends = (equation.origin, equation.destination)
    head = ("", *(_end_title(end, name, words) for end, name in zip(ends, ENDS, strict=True)))
    rows = [
        TableRow(tuple(Paragraph.of(cell, SMALL, role="") for cell in row))
        for row in _factor_rows(equation, ends, words)
    ]
    rows += [_limit_row(equation, ends, words), _index_row(equation, ends, words)]
    table = Table(
        head,
        tuple(rows),
        (NAME_WIDTH, 1.0, FACTOR_WIDTH, 1.0, FACTOR_WIDTH),
        head_shares=WIDE,
        gap=4.0,
        padding=1.5,
    )
    return section(title, table, *_all_lifts(facts, words))


NAME_WIDTH, FACTOR_WIDTH = -56.0, -25.0
WIDE = (NAME_WIDTH, 1.0, 1.0)
"""Both columns of an end, value and multiplier, under one title."""
ENDS = ("origin", "destination")


def _end_title(end: EndFacts, name: str, words: Words) -> str:
    note = words["governs"] if end.governs else "" if end.is_counted else words["not_counted"]
    return f"{words[name]} {note}".strip()


def _factor_rows(
    equation: EquationFacts, ends: tuple[EndFacts, EndFacts], words: Words
) -> list[tuple[str, ...]]:
    """Return the inputs with their ranges, and the multiplier of each."""
    frequency = equation.frequency_per_min
    work = words["per_min"].format(
        frequency=words["unknown"] if math.isnan(frequency) else f"{frequency:g}",
        duration=equation.duration_class or words["unknown"],
    )
    shown: tuple[tuple[str, str, Callable[[EndFacts], str]], ...] = (
        ("reach", "HM", lambda end: words.measurement(end.H_cm, "cm")),
        ("height", "VM", lambda end: words.measurement(end.V_cm, "cm")),
        ("travel", "DM", lambda _: words.measurement(equation.D_cm, "cm")),
        ("side", "AM", lambda end: words.measurement(end.A_deg, "°")),
        ("frequency", "FM", lambda _: work),
        ("grip", "CM", lambda _: equation.coupling or words["unknown"]),
    )
    return [
        (words[key], *(c for end in ends for c in (value(end), _factor(end.multipliers[name]))))
        for key, name, value in shown
    ]


def _factor(value: float) -> str:
    return "× –" if math.isnan(value) else f"× {value:.2f}"


def _limit_row(equation: EquationFacts, ends: tuple[EndFacts, EndFacts], words: Words) -> TableRow:
    """Return the limits; the range is known for the end that decides."""
    return _sum_row(
        words["rwl"],
        [
            (words.quantity(end.rwl_kg, "kg", 1), equation.rwl_interval_kg if end.governs else None)
            for end in ends
        ],
        1,
        words,
    )


def _index_row(equation: EquationFacts, ends: tuple[EndFacts, EndFacts], words: Words) -> TableRow:
    digits = choose_index_digits(equation.value)
    return _sum_row(
        words["li"],
        [
            (
                words.number(end.lifting_index, choose_index_digits(end.lifting_index)),
                equation.interval if end.governs else None,
            )
            for end in ends
        ],
        digits,
        words,
    )


def _sum_row(
    title: str,
    values: Sequence[tuple[str, tuple[float, float] | None]],
    digits: int,
    words: Words,
) -> TableRow:
    cells: list[Block] = [Paragraph.of(title, SMALL.bold, role="")]
    for shown, interval in values:
        runs: tuple[tuple[str, Style], ...] = ((shown, SMALL.bold),)
        if interval is not None and not math.isnan(interval[0]):
            runs += ((f"({words.interval(interval, digits)})", SMALL),)
        cells.append(Paragraph(runs, role=""))
    return TableRow(tuple(cells), fill=SOFT, shares=WIDE)


MAX_LIFTS_NAMED = 8


def _all_lifts(facts: TrialFacts, words: Words) -> tuple[Block, ...]:
    """Name the index of every lift in one line."""
    if len(facts.lifts) < 2:
        return ()
    named = facts.lifts[:MAX_LIFTS_NAMED]
    parts = [
        words["lift_index"].format(n=lift.number, index=describe_index(lift.lifting_index, words))
        for lift in named
    ]
    line = words["other_lifts"].format(lifts=", ".join(parts))
    if len(facts.lifts) > len(named):
        line += f" {words['and_more'].format(n=len(facts.lifts) - len(named))}"
    return (Paragraph.of(line, SMALL.quiet, max_lines=3),)


def describe_index(value: float, words: Words) -> str:
    """Return a lifting index with the decimals that keep it on its side of the limits."""
    return words.number(value, choose_index_digits(value))


def group_methods(methods: Sequence[MethodFacts]) -> tuple[tuple[MethodFacts, ...], ...]:
    """Return the rows of the table: methods that can't be used for one reason share a row."""
    rows: dict[object, list[MethodFacts]] = {}
    for method in methods:
        key = method.name if method.is_applicable else method.reasons
        rows.setdefault(key, []).append(method)
    return tuple(map(tuple, rows.values()))


def methods_part(methods: Sequence[MethodFacts], words: Words, *, shown: int) -> Stack:
    """Show value, range and level of every further method, or why it can't be used."""
    if not methods:
        return section(words["methods_title"], Paragraph.of(words["no_methods"], SMALL))
    groups = group_methods(methods)
    head = tuple(words[k] for k in ("method", "level", "result", "range_title", "in_words"))
    rows = (_method_row(g[0], words) if g[0].is_applicable else _refused_row(g, words)
            for g in groups[:shown])  # fmt: skip
    table = Table(head, tuple(rows), METHOD_SHARES, gap=5.0, padding=1.3)
    more = sum(map(len, groups[shown:]))
    return section(words["methods_title"], table, *more_line(more, words))


METHOD_SHARES = (-90.0, LEVEL_WIDTH, -44.0, -66.0, 1.0)


def _refused_row(methods: Sequence[MethodFacts], words: Words) -> TableRow:
    names = ", ".join(words.method(method.name) for method in methods)
    why = " ".join(sentence(typeset(reason)) for reason in methods[0].reasons)
    lead = (
        words["not_applicable"] if len(methods) == 1 else words["all_refused"].format(names=names)
    )
    runs = ((f"{lead}:", SMALL), (why or words["unknown"], SMALL.quiet))
    title = names if len(methods) == 1 else words.count(len(methods), "method_noun")
    name = Paragraph.of(title, SMALL.bold, role="", max_lines=2)
    chip = Chip(None, words.level(None))
    return TableRow(
        (name, chip, Paragraph(runs, role="", max_lines=4)), shares=(*METHOD_SHARES[:2], 1.0)
    )


def _method_row(method: MethodFacts, words: Words) -> TableRow:
    name = Paragraph.of(words.method(method.name), SMALL.bold, role="", max_lines=2)
    has_value = not math.isnan(method.value)
    why = " ".join(sentence(typeset(reason)) for reason in method.reasons)
    cells = (
        words.quantity(method.value, method.unit, method.digits)
        if has_value
        else words["no_value"],
        words.interval(method.interval, method.digits),
        method.category if has_value else why,
    )
    texts = (Paragraph.of(cell, SMALL, role="", max_lines=2) for cell in cells)
    return TableRow((name, Chip(method.level, words.level(method.level)), *texts))


# --------------------------------------------------------------------------- provenance


def provenance_line(facts: TrialFacts, words: Words, *, with_file_names: bool) -> str:
    """Say how a result was made, so that it can be made again."""
    document = facts.stored.document
    views = [view.info for view in facts.stored.views]
    config = document.get("config")
    correction = config.get("correction", {}) if isinstance(config, dict) else {}
    preset = correction.get("preset") if isinstance(correction, dict) else None
    line = words["provenance"].format(
        version=document.get("liftlens_version") or words["unknown"],
        backend=document.get("backend") or words["unknown"],
        solver=document.get("solver") or words["unknown"],
        correction=preset or words["unknown"],
        video=", ".join(view.sha256[:12] for view in views) or words["unknown"],
        config=fingerprint(config),
        date=words.date(facts.created, with_time=True),
    )
    if with_file_names and views:
        names = ", ".join(view.file_name for view in views)
        line += f" · {words['file_name'].format(name=names)}"
    return line
