"""Sentences that say what to do differently: only what was measured, with its error.

Every sentence states one measured difference (or that there is none). What to try is plain
coaching of posture towards the chosen reference, no statement about health.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from engine.form.compare import Comparison, PhaseDifference, PhaseTiming
from engine.form.performance import side_of

__all__ = ["N_SENTENCES", "PHASE_WORDS", "advise", "describe_difference"]

N_SENTENCES = 3
LEAST_DIFFERENCE_DEG = 5.0
"""Smaller differences are not worth a change of how one moves, even where they are certain."""
COVERAGE_FACTOR = 1.96

PHASE_WORDS: Mapping[str, str] = {
    "reach": "While reaching down",
    "lift_off": "At lift-off",
    "rise": "While lifting",
    "set_down": "At set-down",
    "return": "While straightening up afterwards",
    "descent": "On the way into the movement",
    "bottom": "At the deepest point",
    "ascent": "On the way back",
}


@dataclass(frozen=True)
class _Words:
    """How a difference of one angle is said: more and less, and what to try against each."""

    subject: str
    more: str
    less: str
    against_more: str
    against_less: str


WORDS: Mapping[str, _Words] = {
    "trunk_flexion": _Words(
        "your trunk leans",
        "further forward",
        "less far forward",
        "keep it more upright and let hips and knees do more",
        "lean further forward",
    ),
    "trunk_lateral_bend": _Words(
        "your trunk bends",
        "further to the right",
        "further to the left",
        "keep the shoulders level",
        "keep the shoulders level",
    ),
    "trunk_twist": _Words(
        "your shoulders are turned",
        "further to the left",
        "further to the right",
        "turn with the feet, not with the trunk",
        "turn with the feet, not with the trunk",
    ),
    "hip_flexion": _Words(
        "{side} bent",
        "more",
        "less",
        "bend less at the hips",
        "push the hips further back",
    ),
    "knee_flexion": _Words(
        "{side} bent",
        "more",
        "less",
        "bend the knees less",
        "bend the knees more",
    ),
    "shoulder_flexion": _Words(
        "{side} raised",
        "further forward",
        "less far forward",
        "keep the arms closer to the body",
        "reach further forward",
    ),
    "elbow_flexion": _Words(
        "{side} bent",
        "more",
        "less",
        "straighten the arms more",
        "bend the arms more",
    ),
}
JOINTS: Mapping[str, tuple[str, str]] = {
    "hip_flexion": ("hip is", "hips are"),
    "knee_flexion": ("knee is", "knees are"),
    "shoulder_flexion": ("arm is", "arms are"),
    "elbow_flexion": ("elbow is", "elbows are"),
}


@dataclass(frozen=True)
class _Finding:
    """A difference to be named; `side` is empty for the trunk or where both sides agree."""

    base: str
    side: str
    difference: PhaseDifference

    @property
    def weight(self) -> float:
        """How clear and large it is."""
        mean = self.difference.mean
        return abs(mean.value) * min(abs(mean.value) / mean.sigma, 4.0)


def advise(comparison: Comparison) -> tuple[str, ...]:
    """Return three sentences, the most important first.

    The largest differences beyond the measurement error, one per joint and at most three; then
    the phase whose length differs most; then what was found to be alike. Never more than
    was measured: without any difference the sentences say so.
    """
    sentences = [describe_difference(f) for f in _rank(comparison)][:N_SENTENCES]
    if len(sentences) < N_SENTENCES:
        sentences += list(_describe_timing(comparison.timings))
    if len(sentences) < N_SENTENCES:
        sentences.append(_describe_rest(comparison, bool(_rank(comparison))))
    if len(sentences) < N_SENTENCES:
        sentences.append(_describe_score(comparison))
    return tuple(sentences[:N_SENTENCES])


def _rank(comparison: Comparison) -> list[_Finding]:
    """Return the clearest finding of every joint, clearest first."""
    named = [
        d
        for d in comparison.differences
        if d.is_beyond_error
        and abs(d.mean.value) >= LEAST_DIFFERENCE_DEG
        and side_of(d.angle)["base"] in WORDS
    ]
    best: dict[str, _Finding] = {}
    for finding in _merge_sides(named):
        known = best.get(finding.base)
        if known is None or finding.weight > known.weight:
            best[finding.base] = finding
    return sorted(best.values(), key=lambda f: -f.weight)


def _merge_sides(named: Sequence[PhaseDifference]) -> Iterator[_Finding]:
    by_key = {(d.phase, d.angle): d for d in named}
    for d in named:
        base, side = side_of(d.angle)["base"], side_of(d.angle)["side"]
        other = by_key.get((d.phase, base + ("_r" if side == "left" else "_l")))
        alike = side and other is not None and (other.mean.value > 0) == (d.mean.value > 0)
        yield _Finding(base, "both" if alike else side, d)


def describe_difference(finding: _Finding) -> str:
    """Return one difference as a sentence with its error and what to try."""
    words, mean = WORDS[finding.base], finding.difference.mean
    singular, plural = JOINTS.get(finding.base, ("", ""))
    side = f"your {plural}" if finding.side == "both" else f"your {finding.side} {singular}"
    subject = words.subject.format(side=side)
    is_more = mean.value > 0
    way, action = (words.more, words.against_more) if is_more else (words.less, words.against_less)
    half = COVERAGE_FACTOR * mean.sigma
    return (
        f"{PHASE_WORDS[finding.difference.phase]} {subject} {abs(mean.value):.0f} deg "
        f"(\N{PLUS-MINUS SIGN}{half:.0f}) {way} than in the reference: to match it, {action}."
    )


def _describe_timing(timings: Sequence[PhaseTiming]) -> Iterator[str]:
    clear = [t for t in timings if t.is_beyond_error and t.reference_s.value > 0]
    if not clear:
        return
    most = max(clear, key=lambda t: abs(t.difference_s.value))
    by = most.difference_s
    way, action = ("longer", "move faster") if by.value > 0 else ("shorter", "take more time")
    phase = PHASE_WORDS[most.phase]
    yield (
        f"{phase} you take {abs(by.value):.1f} s (\N{PLUS-MINUS SIGN}"
        f"{COVERAGE_FACTOR * by.sigma:.1f}) {way} than the reference: {action} there."
    )


def _describe_rest(comparison: Comparison, has_findings: bool) -> str:
    trunk = [d for d in comparison.differences if d.angle == "trunk_flexion"] or list(
        comparison.differences
    )
    limit = max(COVERAGE_FACTOR * d.mean.sigma for d in trunk)
    what = "forward bend" if trunk[0].angle == "trunk_flexion" else "posture"
    if has_findings:
        return (
            f"No other joint differs by {LEAST_DIFFERENCE_DEG:.0f} deg or more beyond the "
            "measurement error (differences of "
            f"the {what} below {limit:.0f} deg can't be told)."
        )
    return (
        f"No joint differs by {LEAST_DIFFERENCE_DEG:.0f} deg or more beyond the measurement "
        "error: keep your posture "
        f"(differences of the {what} below {limit:.0f} deg can't be told)."
    )


def _describe_score(comparison: Comparison) -> str:
    low, high = comparison.score.interval
    return (
        f"Your score is {comparison.score.value:.0f} of 100, between {low:.0f} and {high:.0f} with "
        "the measurement error."
    )
