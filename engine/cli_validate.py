"""What `liftlens validate` does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

from engine.errors import ConfigError
from engine.storage.atomic import explain_os_errors, write_aside
from engine.storage.results import StoredResult, read_result
from engine.validate import check_agreement_target, compare_results, write_agreement
from engine.validation.compare import OffsetRule, TrialComparison
from engine.validation.outcome import AGREEMENT_NAME, SUMMARY_NAME
from engine.validation.pooled import Agreement, describe_agreement, describe_offsets
from engine.validation.profiles import ImportProfile, format_profile, read_profile
from engine.validation.reference.base import Reference
from engine.validation.reference.files import describe_profile, read_reference

__all__ = ["ValidateRequest", "run_validate"]

Say = Callable[[str], None]
SHOWN_STATEMENTS = 10
"""The first is about all angles, the next about those that lifting is judged by."""


@dataclass(frozen=True)
class ValidateRequest:
    """The options of the command; `references` has one file per result."""

    results: tuple[Path, ...]
    references: tuple[Path, ...]
    profile: Path | None = None
    out: Path | None = None
    offset: str = "auto"
    max_lag_s: float | None = None
    save_profile: Path | None = None
    is_quiet: bool = False

    def __post_init__(self) -> None:
        if len(self.results) != len(self.references):
            raise ConfigError(
                f"Expected one --reference per result folder, in the same order; got "
                f"{len(self.results)} folders and {len(self.references)} references."
            )
        both = zip(self.results, self.references, strict=True)
        pairs = [(a.resolve(), b.resolve()) for a, b in both]
        twice = next((pair for i, pair in enumerate(pairs) if pair in pairs[:i]), None)
        if twice:
            raise ConfigError(
                f"{twice[0].name} and {twice[1].name} are given twice; the same trial may count "
                "only once."
            )
        if self.offset not in get_args(OffsetRule):
            raise ConfigError(
                f"--offset must be one of {', '.join(get_args(OffsetRule))}, got {self.offset!r}."
            )
        if self.max_lag_s is not None and not self.max_lag_s > 0:
            raise ConfigError(f"--max-lag must be positive, got {self.max_lag_s:g} s.")

    @property
    def target(self) -> Path:
        """Where the comparison goes."""
        if self.out is not None:
            return self.out
        if len(self.results) > 1:
            return Path("liftlens_agreement")
        folder = self.results[0].resolve()
        return folder.with_name(f"{folder.name}_agreement")


def run_validate(request: ValidateRequest, *, say: Say, warn: Say) -> None:
    """Compare, write, and print what was found; `warn` gets what is in doubt and the progress."""
    target = check_agreement_target(request.target)
    profile = None if request.profile is None else read_profile(request.profile)
    pairs = list(_read_pairs(request, profile))
    if request.save_profile is not None:
        _write_profile(request.save_profile, pairs[0][1])
    agreement = compare_results(
        pairs, offset=cast("OffsetRule", request.offset), max_lag_s=request.max_lag_s
    )
    for line in _list_doubts(agreement):
        warn(f"Note: {line}")
    if not request.is_quiet:
        warn("Drawing the figures ...")
    folder = write_agreement(agreement, target)
    for line in _summarise(agreement):
        say(line)
    say(f"\nWritten: {folder} (open {SUMMARY_NAME})")


def _read_pairs(
    request: ValidateRequest, profile: ImportProfile | None
) -> Iterator[tuple[StoredResult, Reference]]:
    for result, reference in zip(request.results, request.references, strict=True):
        yield read_result(result), read_reference(reference, profile)


def _write_profile(path: Path, reference: Reference) -> None:
    with explain_os_errors(path, "The profile"), write_aside(path) as aside:
        aside.write_text(format_profile(describe_profile(reference)), encoding="utf-8")


def _list_doubts(agreement: Agreement) -> tuple[str, ...]:
    """Return what makes the comparison less certain; each sentence once."""
    lines: list[str] = []
    for trial in agreement.trials:
        lines += [
            f"please confirm {f.what} = {f.value} of {trial.reference.name} ({f.why}); set it in "
            "an import profile."
            for f in trial.reference.to_confirm
        ]
        lines += [*trial.reference.notes, *trial.notes]
    return tuple(dict.fromkeys(lines))


def _summarise(agreement: Agreement) -> Iterator[str]:
    for trial in agreement.trials:
        yield _describe_trial(trial)
    yield ""
    statements = describe_agreement(agreement)
    yield from statements[:SHOWN_STATEMENTS]
    if (more := len(statements) - SHOWN_STATEMENTS) > 0:
        yield f"... and {more} more angles in {AGREEMENT_NAME}."
    yield ""
    yield describe_offsets(agreement)


def _describe_trial(trial: TrialComparison) -> str:
    time = trial.alignment
    distance = f", joints {trial.positions[0].mpjpe_mm:.0f} mm apart" if trial.positions else ""
    return (
        f"{trial.label} and {trial.reference.name}: {len(trial.angles)} angles, shifted by "
        f"{time.lag_s:+.3f} s (correlation {time.correlation:.2f}){distance}"
    )
