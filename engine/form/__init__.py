"""Compare how two movements were performed: phases, repetitions, differences, score, advice."""

from engine.form.advice import advise
from engine.form.compare import (
    Comparison,
    PhaseDifference,
    PhaseTiming,
    compare_every_repetition,
    compare_performances,
)
from engine.form.performance import Performance, make_performance
from engine.form.phases import Phase
from engine.form.repetitions import Repetition, find_repetitions
from engine.form.score import Score

__all__ = [
    "Comparison",
    "Performance",
    "Phase",
    "PhaseDifference",
    "PhaseTiming",
    "Repetition",
    "Score",
    "advise",
    "compare_every_repetition",
    "compare_performances",
    "find_repetitions",
    "make_performance",
]
