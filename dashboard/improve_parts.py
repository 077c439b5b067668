"""The parts of the page that asks what a change of the work would do."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from html import escape
from typing import Any

import streamlit as st

from dashboard import improve_cache, improve_charts, labels, state
from dashboard.labels import format_interval, format_measurement, format_number
from dashboard.widgets import chip_html, is_dark, level_label, list_html, table_html
from engine.datatypes import Coupling, FlagLevel, Lift, Measurement, RiskResult, Task
from engine.ergonomics.base import Exposure, MethodInfo, list_methods
from engine.ergonomics.improvements import LOCKS, Effect, RankedChange, Ranking
from engine.ergonomics.spine import ACTION_LIMIT_N
from engine.ergonomics.what_if import Change

CHART = {"displaylogo": False, "displayModeBar": False}
WHAT_IF, BEFORE_AFTER, JOB = "What if", "Before and after", "A whole job"
PARTS = {
    WHAT_IF: "What a change of this lift would do, and which change helps most.",
    BEFORE_AFTER: "Whether a change that was made has worked.",
    JOB: "Several filmed tasks together: how hard the job is.",
}
LOCK_NAMES: Mapping[str, str] = {
    "origin height": "Height at the start",
    "origin distance": "Reach at the start",
    "origin angle": "Side at the start",
    "destination height": "Height at the end",
    "destination distance": "Reach at the end",
    "destination angle": "Side at the end",
    "load": "Load",
    "frequency": "How often",
    "duration": "How long",
    "grip": "Grip",
}
GRIPS = {Coupling.GOOD: "Good", Coupling.FAIR: "Fair", Coupling.POOR: "Poor"}
FRAME_METHODS = ("reba", "rula", "owas", "posture_zones")
MARGIN = 0.005
"""Differences below this share of a value are no difference to a reader."""


@dataclass(frozen=True)
class _Slider:
    """One place of the hands that can be moved."""

    end: str
    place: str
    name: str
    unit: str
    high: float

    @property
    def field(self) -> str:
        return f"{self.end}_{self.place}"


SLIDERS = tuple(
    _Slider(end, place, name, unit, high)
    for end in ("origin", "destination")
    for place, name, unit, high in (
        ("H_cm", "Reach (H)", "cm", 90.0),
        ("V_cm", "Height (V)", "cm", 200.0),
        ("A_deg", "To the side (A)", "°", 135.0),
    )
)
LOCK_OF = {field: lock for lock, fields in LOCKS.items() for field in fields}


def choose_part() -> str:
    """Let the user choose what to ask."""
    chosen = st.segmented_control(
        "What to ask", list(PARTS), default=WHAT_IF, required=True, label_visibility="collapsed"
    )
    part = str(chosen or WHAT_IF)
    st.caption(PARTS[part])
    return part


def choose_lift(trial_id: str) -> int | None:
    """Let the user choose a lift, the worst one first; None where there is none."""
    exposure = improve_cache.exposure(trial_id)
    if not exposure.lifts:
        st.info(
            "No lift was found in this trial, so that no change can be tried on it.",
            icon=":material/search_off:",
        )
        return None
    worst = improve_cache.worst_lift(trial_id)
    if len(exposure.lifts) == 1:
        return worst
    names = {
        k: f"Lift {k + 1}{' (the hardest)' if k == worst else ''}"
        for k in range(len(exposure.lifts))
    }
    chosen = st.pills(
        "Lift",
        list(names),
        default=worst,
        format_func=names.__getitem__,
        required=True,
        key=f"lift_{trial_id}",
    )
    return worst if chosen is None else int(chosen)


@st.fragment
def show_what_if(trial_id: str, lift: int) -> None:
    """Show the inputs, what they do, and what would help most; only this part runs anew."""
    scope = f"{trial_id}_{lift}"
    exposure = improve_cache.exposure(trial_id)
    locks = _ask_locks(scope, exposure.task)
    numbers = st.container()
    inputs, outcome = st.columns([5, 6], gap="large")
    with inputs:
        change = _ask_change(scope, exposure, lift, locks)
    answer = improve_cache.answer(trial_id, lift, change)
    with numbers:
        _show_numbers(answer)
    with outcome:
        _show_outcome(answer, change)
    st.subheader("What would help most", anchor=False)
    _show_ranking(scope, improve_cache.ranking(trial_id, lift, locks))
    st.subheader("Every method, as filmed and as changed", anchor=False)
    _show_methods(trial_id, lift, change, answer)


# --------------------------------------------------------------------------- inputs


def _ask_locks(scope: str, task: Task) -> frozenset[str]:
    """Ask what the workplace can't change."""
    known = [lock for lock in LOCK_NAMES if lock != "load" or task.load_kg is not None]
    chosen = st.pills(
        "What can't be changed here?",
        known,
        selection_mode="multi",
        format_func=LOCK_NAMES.__getitem__,
        key=f"locks_{scope}",
        help="For example a shelf that is fixed. What is locked is left out of the proposals.",
    )
    return frozenset(chosen or ())


def _ask_change(scope: str, exposure: Exposure, lift: int, locks: frozenset[str]) -> Change:
    """Ask for the values; they start as measured or told."""
    values: dict[str, Any] = {}
    with st.container(border=True):
        for end, title in (("origin", "At the start"), ("destination", "At the end")):
            st.markdown(f"**{title}**")
            for slider in (s for s in SLIDERS if s.end == end):
                values |= _ask_place(scope, slider, exposure.lifts[lift], locks)
        st.markdown("**The work**")
        values |= _ask_work(scope, exposure.task, locks)
        st.button(
            "Back to as filmed",
            icon=":material/restart_alt:",
            on_click=state.fill_improve,
            args=(scope, {}),
            disabled=not values,
        )
    return Change(**values)


def _ask_place(scope: str, slider: _Slider, lift: Lift, locks: frozenset[str]) -> dict[str, float]:
    measured: Measurement = getattr(getattr(lift, slider.end), slider.place)
    if measured.is_missing:
        st.caption(f"{slider.name}: not seen in the video, so that it can't be changed here.")
        return {}
    start = float(round(min(max(measured.value, 0.0), slider.high)))
    key = state.improve_key(scope, slider.field)
    is_locked = LOCK_OF[slider.field] in locks
    label = f"{slider.name}, {slider.unit}: filmed {format_measurement(measured, slider.unit)}"
    shown = start if is_locked else state.improve_start(scope, slider.field, start)
    value = st.slider(
        label, 0.0, slider.high, shown, 1.0, format="%.0f", key=key, disabled=is_locked
    )
    return {} if is_locked or value == start else {slider.field: float(value)}


def _ask_work(scope: str, task: Task, locks: frozenset[str]) -> dict[str, Any]:
    asked: dict[str, Any] = {}
    first, second = st.columns(2)
    ask = partial(_ask_number, scope, task, locks)
    with first:
        asked |= ask("load_kg", "Load (kg)", 0.5, 200.0)
        asked |= ask("frequency_per_min", "Lifts per minute", 0.1, 60.0)
    with second:
        asked |= _ask_grip(scope, task, locks)
        asked |= ask("duration_h", "Hours at a stretch", 0.5, 24.0)
    return asked | ask("recovery_h", "Hours of light work after it", 0.5, 24.0)


def _ask_number(
    scope: str,
    task: Task,
    locks: frozenset[str],
    field: str,
    name: str,
    step: float,
    high: float,
) -> dict[str, float]:
    given = getattr(task, field)
    told = None if given is None else float(given)
    is_locked = LOCK_OF[field] in locks
    value = st.number_input(
        name,
        0.0,
        high,
        told if is_locked else state.improve_start(scope, field, told),
        step,
        format="%g",
        placeholder="not given",
        key=state.improve_key(scope, field),
        disabled=is_locked,
    )
    return {} if is_locked or value is None or value == told else {field: float(value)}


def _ask_grip(scope: str, task: Task, locks: frozenset[str]) -> dict[str, Coupling]:
    options: list[Coupling | None] = [*GRIPS]
    if task.coupling is None:
        options.insert(0, None)
    is_locked = LOCK_OF["coupling"] in locks
    chosen = st.selectbox(
        "Grip",
        options,
        index=options.index(
            task.coupling if is_locked else state.improve_start(scope, "coupling", task.coupling)
        ),
        format_func=lambda grip: "Not given" if grip is None else GRIPS[grip],
        key=state.improve_key(scope, "coupling"),
        help=labels.HELP["coupling"],
        disabled=is_locked,
    )
    return {} if is_locked or chosen is None or chosen == task.coupling else {"coupling": chosen}


# --------------------------------------------------------------------------- outcome


def _show_numbers(answer: improve_cache.Answer) -> None:
    """Show index, compression and weight limit beside those as filmed."""
    gain = answer.gain
    filmed, changed = answer.filmed["rnle"], answer.changed["rnle"]
    tiles = (
        _index_tile(gain.lifting_index, filmed, changed),
        _back_tile(gain.compression, answer.filmed["l5s1"], answer.changed["l5s1"]),
        _limit_tile(gain.rwl, changed),
    )
    st.html(f'<div class="ll-tiles" aria-live="polite">{"".join(tiles)}</div>')


def _show_outcome(answer: improve_cache.Answer, change: Change) -> None:
    """Show which limits are crossed, and how far every method is from its own."""
    gain = answer.gain
    if change.is_none:
        st.caption("As filmed. Move a slider, or try one of the changes below.")
    elif gain.limits:
        st.html(list_html(map(labels.sentence, gain.limits)))
    for note in gain.notes:
        st.warning(labels.sentence(note), icon=":material/pan_tool_alt:")
    figure = improve_charts.plot_limits(
        answer.filmed, answer.changed, _infos(), _lift_methods(), dark=is_dark()
    )
    if figure is not None:
        st.plotly_chart(
            figure, config=CHART, alt="Values of the methods over their limits, before and after"
        )
    st.caption(
        "Bars are about 95 %. Errors that are the same before and after (camera, person) are in "
        "both bars, but not in the difference stated above."
    )


def _infos() -> dict[str, MethodInfo]:
    return {method.info.name: method.info for method in list_methods()}


def _lift_methods() -> dict[str, str]:
    shown = ("rnle", "l5s1", "iso11228", "lm_mmh", "lifft", "acgih", "shoulder_tool", "kim_lhc")
    return {name: labels.name_method(name) for name in shown}


def _index_tile(effect: Effect | None, filmed: RiskResult, changed: RiskResult) -> str:
    if effect is None:
        why = "load not given" if changed.is_applicable else "the equation can't be used here"
        return _tile("Lifting index", "–", why, "")
    words = _level_words(filmed.category, changed.category)
    return _tile(
        "Lifting index",
        _pair(effect, lambda x: format_number(x, 1)),
        f"{words} · goal: 1.0 or less",
        _delta(effect, 1, lower_is_better=True),
        tip=labels.HELP["lifting_index"],
    )


def _limit_tile(effect: Effect | None, changed: RiskResult) -> str:
    if effect is None:
        why = changed.reasons[-1] if changed.reasons else ""
        return _tile("Weight limit", "–", why, "")
    return _tile(
        "Weight limit",
        _pair(effect, lambda x: format_number(x, 1), " kg"),
        "what the lifting equation allows this way and this often (RWL)",
        "",
    )


def _back_tile(effect: Effect | None, filmed: RiskResult, changed: RiskResult) -> str:
    if effect is None:
        return _tile("Low back", "–", "the body was not seen well enough", "")
    words = _level_words(filmed.category, changed.category)
    return _tile(
        "Compression of the low back",
        _pair(effect, lambda x: format_number(x / 1000, 1), " kN"),
        f"{words} · limit: {format_number(ACTION_LIMIT_N / 1000, 1)} kN",
        _delta(effect, 1, lower_is_better=True, scale=1000.0),
    )


def _tile(name: str, value: str, under: str, delta: str, *, tip: str = "") -> str:
    title = f' title="{escape(tip)}"' if tip else ""
    return (
        f'<div class="ll-tile"{title}><div class="ll-name">{escape(name)}</div>'
        f'<div class="ll-number">{escape(value)}</div>{delta}'
        f'<div class="ll-quiet ll-small">{escape(under)}</div></div>'
    )


def _is_same(effect: Effect) -> bool:
    if effect.before == effect.after:
        return True
    return abs(effect.difference) <= MARGIN * abs(effect.before)


def _pair(effect: Effect, write: Callable[[float], str], unit: str = "") -> str:
    if _is_same(effect):
        return f"{write(effect.after)}{unit}"
    return f"{write(effect.before)} → {write(effect.after)}{unit}"


def _level_words(before: str, after: str) -> str:
    return after if before == after else f"{before} → {after}"


def _delta(effect: Effect, digits: int, *, lower_is_better: bool, scale: float = 1.0) -> str:
    """Return the difference with an arrow and a word; never told by its colour alone."""
    if _is_same(effect):
        return '<div class="ll-delta ll-none">no change</div>'
    falls = effect.difference < 0
    good = falls is lower_is_better
    word = ("better" if good else "worse") if effect.is_sure else "not told from no change"
    size = format_number(abs(effect.difference) / scale, digits)
    low, high = effect.difference_interval
    span = format_interval((low / scale, high / scale), digits)
    sure = f" ({span})" if span and math.isfinite(low) and math.isfinite(high) else ""
    css = ("ok" if good else "high") if effect.is_sure else "review"
    arrow, way = ("▼", "lower") if falls else ("▲", "higher")
    return (
        f'<div class="ll-delta ll-{css}"><span aria-hidden="true">{arrow}</span> '
        f"{escape(f'{size} {way}{sure}: {word}')}</div>"
    )


# --------------------------------------------------------------------------- proposals


def _show_ranking(scope: str, ranking: Ranking) -> None:
    for reason in ranking.reasons:
        st.caption(labels.sentence(reason))
    if ranking.meets_goals and ranking.singles:
        st.caption("The lift already keeps to both goals; these changes would ease it further.")
    if not ranking.singles:
        text = (
            "Nothing that may be changed lowers index or compression by 2 % or more."
            if not ranking.reasons
            else "No change can be ranked."
        )
        st.info(text, icon=":material/search_off:")
        return
    with st.container(border=True):
        for number, one in enumerate(ranking.singles, start=1):
            _show_proposal(scope, f"single{number}", one, number)
    if ranking.pairs:
        st.markdown("**No single change reaches both goals. Two together:**")
        with st.container(border=True):
            for number, one in enumerate(ranking.pairs, start=1):
                _show_proposal(scope, f"pair{number}", one, number)
    st.caption(
        "Ordered by the lifting index, then by the load on the back. Goals: index 1.0 or less, "
        "compression 3.4 kN or less. The list knows the equation and the body, not your workplace."
    )


def _show_proposal(scope: str, key: str, one: RankedChange, number: int) -> None:
    words, button = st.columns([8, 1.4], vertical_alignment="center")
    with words:
        st.html(_proposal_html(one, number))
    with button:
        st.button(
            "Try",
            key=f"try_{scope}_{key}",
            on_click=state.fill_improve,
            args=(scope, _values_of(one.change)),
            width="stretch",
            help="Set the inputs above to this change.",
        )


def _values_of(change: Change) -> dict[str, Any]:
    fields = (*(slider.field for slider in SLIDERS), "load_kg", "coupling", "frequency_per_min")
    fields = (*fields, "duration_h", "recovery_h")
    known = {f: value for f in fields if (value := getattr(change, f)) is not None}
    return {f: v if isinstance(v, Coupling) else float(v) for f, v in known.items()}


def _proposal_html(one: RankedChange, number: int) -> str:
    goal = chip_html(level_label(FlagLevel.OK), "Meets the goals") if one.meets_goals else ""
    facts = []
    if one.lifting_index is not None:
        facts.append(f"Lifting index {_pair(one.lifting_index, lambda x: format_number(x, 1))}")
    elif one.rwl is not None:
        facts.append(f"Weight limit {_pair(one.rwl, lambda x: format_number(x, 1), ' kg')}")
    if one.compression is not None:
        pair = _pair(one.compression, lambda x: format_number(x / 1000, 1), " kN")
        facts.append(f"compression {pair}")
    tail = [labels.sentence(text) for text in one.notes]
    if not one.is_distinguishable:
        tail.append("Not told apart from the next one.")
    quiet = f'<p class="ll-quiet ll-small">{escape(" ".join(tail))}</p>' if tail else ""
    return (
        f'<div class="ll-proposal"><div class="ll-rank">{number}</div>'
        f"<div><b>{escape(one.action)}</b> {goal}"
        f"<p>{escape(', '.join(facts))}</p>{quiet}</div></div>"
    )


# --------------------------------------------------------------------------- every method


def _show_methods(trial_id: str, lift: int, change: Change, answer: improve_cache.Answer) -> None:
    filmed, changed = dict(answer.filmed), dict(answer.changed)
    if st.toggle(
        "Posture scores too (REBA, RULA, OWAS, posture zones)",
        key=f"frames_{trial_id}",
        help="They score every moment of the video, which takes a little longer.",
    ):
        filmed |= improve_cache.posture_scores(trial_id, lift, Change())
        changed |= improve_cache.posture_scores(trial_id, lift, change)
    infos = _infos()
    rows = [
        (
            labels.name_method(name),
            _describe(filmed[name], infos.get(name)),
            _describe(changed[name], infos.get(name)),
        )
        for name in (*_lift_methods(), *FRAME_METHODS)
        if name in filmed and name in changed
    ]
    st.html(table_html((("Method", ""), ("As filmed", ""), ("As changed", "")), rows, "ll-wide"))
    if change.is_none:
        return
    steps = answer.changed["rnle"].steps
    if steps:
        with st.expander("The changed calculation, line by line", icon=":material/calculate:"):
            st.html(list_html(map(labels.typeset, steps), "ll-steps", "ol"))
    notes = dict.fromkeys(reason for name in ("l5s1", "rnle") for reason in changed[name].reasons)
    with st.expander("What is assumed", icon=":material/info:"):
        st.html(list_html(map(labels.sentence, notes)))


def _describe(risk: RiskResult, info: MethodInfo | None) -> str:
    if not risk.is_applicable:
        why = risk.reasons[-1] if risk.reasons else ""
        return f"Can't be used: {why}"
    if math.isnan(risk.value):
        return labels.sentence(risk.category)
    digits = 1 if info is None or info.decimals is None else info.decimals
    unit = f" {risk.unit}" if risk.unit else ""
    span = format_interval(risk.interval, digits)
    sure = f" ({span})" if span else ""
    return f"{format_number(risk.value, digits)}{unit}{sure}, {risk.category}"
