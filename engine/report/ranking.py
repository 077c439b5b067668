"""The changes of the work that help most, tried out on the stored lift itself."""

from __future__ import annotations

from engine.report.facts import EQUATION, ChangeFacts, TrialFacts

__all__ = ["list_best_changes"]

MAX_RANKED = 3
TOLD_BY_RANKING = (EQUATION, "disagreement")
"""Flags of these say nothing about what to change that the ranking does not say better."""


def list_best_changes(facts: TrialFacts) -> tuple[ChangeFacts, ...]:
    """Return what to change: first what was ranked for the worst lift, then what flags ask for.

    Without lifts, or where neither equation nor back model may be used, only the flags remain.
    """
    stored = facts.stored
    if not stored.lifts:
        return facts.changes
    # They load signal processing, which takes longer than a page without lifts.
    from engine.ergonomics.improvements import rank_changes
    from engine.improve import read_exposure

    ranking = rank_changes(read_exposure(stored))
    best = ranking.singles[:MAX_RANKED]
    if ranking.pairs and not any(change.meets_goals for change in best):
        # Where no single change is enough, the best two together replace the third.
        best = (*best[: MAX_RANKED - 1], ranking.pairs[0])
    if not best:
        return facts.changes
    lift_number = ranking.lift_index + 1
    ranked = [ChangeFacts(change.sentence, (), lift_number) for change in best]
    rest = [change for change in facts.changes if change.methods[0] not in TOLD_BY_RANKING]
    return (*ranked, *rest)
