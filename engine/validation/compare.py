"""The join: a result and its reference become one comparison of a trial.

Like is compared with like. Markers are turned into angles by the solver that made the result's own
(by the caller: this package knows no solver), so that both follow one definition and a constant
difference is an error. Angles that a recording brings along follow the definitions of another
body model: their constant difference is a matter of convention, shown apart and taken out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from engine.datatypes import Array, JointAngles, PoseTrack
from engine.errors import ConfigError, DataError
from engine.skeletons import get_skeleton
from engine.validation.agreement import PairedTrial
from engine.validation.alignment import PairedAngles, TimeAlignment, estimate_lag, pair_angles
from engine.validation.curves import CurveAgreement, compare_curves
from engine.validation.majae import MAJAE_GROUPS, MAJAE_GROUPS_TRUNK, Majae, compute_majae
from engine.validation.metrics import PositionAgreement, compare_poses
from engine.validation.reference.base import Finding, Reference
from engine.validation.resampling import resample_positions, shift_positions
from engine.validation.spatial import SpatialAlignment, align_positions, compare_segment_lengths

__all__ = [
    "AngleComparison",
    "AngleSource",
    "Estimate",
    "OffsetRule",
    "ReferenceFacts",
    "ReferenceMovement",
    "TrialComparison",
    "compare_trial",
    "thin_track",
]

AngleSource = Literal["computed", "recorded"]
"""Angles computed from joint centres by the result's own solver, or taken from the recording."""
OffsetRule = Literal["auto", "keep", "remove"]
"""`auto` removes the constant difference where the recording brings its own angles."""

MIN_SAMPLES = 10
"""An angle seen together in fewer frames is not compared."""
ROOT = ("left_hip", "right_hip")
GOOD_CORRELATION = 0.9
COVERED = 0.9
"""A reference that covers less of the result is worth a note."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a result brings to a comparison; `track` is in world metres, None without 3D."""

    subject: str
    label: str
    task: str
    angles: JointAngles
    track: PoseTrack | None = None
    solver: str = ""


@dataclass(frozen=True, eq=False)
class ReferenceMovement:
    """Angles and joint centres of a reference, and where its angles come from."""

    facts: ReferenceFacts
    angles: JointAngles
    source: AngleSource
    track: PoseTrack | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ReferenceFacts:
    """What a reference file turned out to be."""

    name: str
    format: str
    rate_hz: float
    duration_s: float
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    joint_centres: Mapping[str, str]

    @classmethod
    def of(cls, reference: Reference, track: PoseTrack | None = None) -> ReferenceFacts:
        """Return the facts of a reference; `track` says how its joint centres came to be."""
        recorded = reference.markers if reference.markers is not None else reference.angles
        time = np.empty(0) if recorded is None else recorded.time_s
        return cls(
            name=reference.name,
            format=reference.format,
            rate_hz=_rate_hz(time),
            duration_s=float(time[-1] - time[0]) if time.size else float("nan"),
            findings=reference.findings,
            notes=reference.notes,
            joint_centres={} if track is None else dict(track.provenance.get("sources", {})),
        )

    @property
    def to_confirm(self) -> tuple[Finding, ...]:
        """What a person should confirm before the comparison counts."""
        return tuple(finding for finding in self.findings if not finding.is_sure)


@dataclass(frozen=True)
class AngleComparison:
    """One angle in one trial: as measured, and without the constant difference.

    `offset_deg` is the median difference, result minus reference.
    """

    name: str
    offset_deg: float
    measured: CurveAgreement
    without_offset: CurveAgreement


@dataclass(frozen=True, eq=False)
class TrialComparison:
    """One trial beside its reference.

    Parameters
    ----------
    subject, label, task
        Subject and label together tell trials apart.
    solver
        What made the result's angles.
    reference, source, is_offset_removed
        The file, where its angles come from, and whether constant differences count as
        convention and are taken out.
    alignment, result_rate_hz
        How the reference was shifted in time; frames per second of the result.
    pairs
        Both sets of curves at the result's times.
    angles, missing
        Every angle compared, and the names of those that could not be.
    majae, majae_without_offset, majae_torso
        Errors in the groups of Choi et al. (2024), and by which angles the torso is judged.
    positions, spatial
        Distances of the joints under several alignments, and the transform of the whole trial;
        empty and None where the reference has no joint centres.
    body_size_ratio
        Size of the reference's body divided by the result's, by the best similarity transform.
    notes
        What makes the comparison less certain.
    """

    subject: str
    label: str
    task: str
    solver: str
    reference: ReferenceFacts
    source: AngleSource
    is_offset_removed: bool
    alignment: TimeAlignment
    result_rate_hz: float
    pairs: PairedAngles
    angles: tuple[AngleComparison, ...]
    missing: tuple[str, ...]
    majae: Majae
    majae_without_offset: Majae
    majae_torso: Literal["lumbar", "trunk"]
    positions: tuple[PositionAgreement, ...] = ()
    spatial: SpatialAlignment | None = None
    body_size_ratio: float = math.nan
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The angles that were compared."""
        return self.pairs.names

    @cached_property
    def estimated_deg(self) -> Array:
        """Curves of the result (T, A) as they are judged: without the offset where it is removed.

        The offset is that of conventions, so that the reference keeps its own definition.
        """
        return np.asarray(self.pairs.estimated_deg - self._removed_deg)

    @cached_property
    def difference_deg(self) -> Array:
        """Result minus reference as it is judged, -180 to 180, shape (T, A)."""
        return self.pairs.error_deg if self.is_offset_removed else self.pairs.difference_deg

    @property
    def _removed_deg(self) -> Array:
        offset = self.pairs.offset_deg
        return offset if self.is_offset_removed else np.zeros_like(offset)

    def judged(self, angle: AngleComparison) -> CurveAgreement:
        """Return the figures of an angle as it is judged."""
        return angle.without_offset if self.is_offset_removed else angle.measured

    def as_paired_trial(self) -> PairedTrial:
        """Return both sets of curves for the statistics over several trials."""
        return PairedTrial(
            subject=self.subject,
            label=self.label,
            time_s=self.pairs.time_s,
            names=self.names,
            estimated_deg=self.estimated_deg,
            reference_deg=self.pairs.reference_deg,
            task=self.task,
        )


def thin_track(track: PoseTrack, rate_hz: float) -> PoseTrack:
    """Leave frames out of a track as long as its rate stays at `rate_hz` or more.

    A laboratory records faster than a camera; angles between the camera's frames are not needed,
    and angles in all of its frames would take their time. Nothing is averaged.
    """
    step = int(_rate_hz(track.time_s) / rate_hz + 1e-6) if rate_hz > 0 else 1
    if step < 2:
        return track
    return replace(
        track,
        time_s=track.time_s[::step],
        position=track.position[::step],
        confidence=track.confidence[::step],
        sigma=track.sigma[::step],
        status=track.status[::step],
    )


def compare_trial(
    estimate: Estimate,
    reference: ReferenceMovement,
    *,
    offset: OffsetRule = "auto",
    max_lag_s: float | None = None,
) -> TrialComparison:
    """Compare one trial with its reference.

    Parameters
    ----------
    estimate, reference
        What the video gave, and the recording.
    offset
        Whether constant differences are taken out as convention.
    max_lag_s
        Lags to try to either side; by default all that leave enough overlap.

    Raises
    ------
    ConfigError
        If `offset` is none of the rules.
    DataError
        If the two don't fit: no common angle, another movement, sides exchanged, no overlap.
    UnitError
        If a unit must be wrong.
    """
    if offset not in get_args(OffsetRule):
        raise ConfigError(f"offset must be one of {', '.join(get_args(OffsetRule))}: {offset!r}.")
    _require_angles(estimate)
    alignment = estimate_lag(estimate.angles, reference.angles, max_lag_s=max_lag_s)
    everything = pair_angles(
        estimate.angles, reference.angles, lag_s=alignment.lag_s, offset="median"
    )
    pairs = _keep_seen(everything)
    positions, spatial, size = _compare_positions(estimate.track, reference.track, alignment.lag_s)
    majae, majae_free, torso = _group_errors(pairs)
    return TrialComparison(
        subject=estimate.subject,
        label=estimate.label,
        task=estimate.task,
        solver=estimate.solver,
        reference=reference.facts,
        source=reference.source,
        is_offset_removed=offset == "remove" or (offset == "auto" and _is_recorded(reference)),
        alignment=alignment,
        result_rate_hz=_rate_hz(estimate.angles.time_s),
        pairs=pairs,
        angles=tuple(_compare_angle(pairs, i) for i in range(len(pairs.names))),
        missing=tuple(n for n in estimate.angles.names if n not in pairs.names),
        majae=majae,
        majae_without_offset=majae_free,
        majae_torso=torso,
        positions=positions,
        spatial=spatial,
        body_size_ratio=size,
        notes=(
            *reference.notes,
            *alignment.notes,
            *_note_overlap(estimate, pairs),
            *_note_doubts(alignment, estimate.track, reference.track),
        ),
    )


def _is_recorded(reference: ReferenceMovement) -> bool:
    return reference.source == "recorded"


def _rate_hz(time_s: Array) -> float:
    return float(1.0 / np.median(np.diff(time_s))) if time_s.size > 1 else float("nan")


def _require_angles(estimate: Estimate) -> None:
    if not np.isfinite(estimate.angles.value_deg).any():
        raise DataError(
            f"The result {estimate.label!r} holds no joint angle in any frame (2D has none), so "
            "there is nothing to compare; assess the video with 3D keypoints."
        )


def _keep_seen(pairs: PairedAngles) -> PairedAngles:
    """Leave out angles that are hardly ever there on both sides."""
    kept = np.flatnonzero(np.isfinite(pairs.difference_deg).sum(axis=0) >= MIN_SAMPLES)
    if not kept.size:
        raise DataError(
            f"No angle exists on both sides in {MIN_SAMPLES} frames or more (common names: "
            f"{', '.join(pairs.names[:4])}); the recordings have gaps at different times."
        )
    return replace(
        pairs,
        names=tuple(pairs.names[i] for i in kept),
        estimated_deg=pairs.estimated_deg[:, kept],
        reference_deg=pairs.reference_deg[:, kept],
        offset_deg=pairs.offset_deg[kept],
        sigma_deg=pairs.sigma_deg[:, kept],
    )


def _compare_angle(pairs: PairedAngles, column: int) -> AngleComparison:
    own, other = pairs.estimated_deg[:, column], pairs.reference_deg[:, column]
    offset = float(pairs.offset_deg[column])
    return AngleComparison(
        name=pairs.names[column],
        offset_deg=offset,
        measured=compare_curves(pairs.time_s, own, other),
        without_offset=compare_curves(pairs.time_s, own - offset, other),
    )


def _group_errors(pairs: PairedAngles) -> tuple[Majae, Majae, Literal["lumbar", "trunk"]]:
    """Return MAJAE with and without the offsets, the torso by the waist where that was fitted."""
    has_waist = all(name in pairs.names for name in MAJAE_GROUPS["torso"])
    groups = MAJAE_GROUPS if has_waist else MAJAE_GROUPS_TRUNK
    measured, free = (
        compute_majae(pairs.time_s, pairs.names, own, pairs.reference_deg, groups=groups)
        for own in (pairs.estimated_deg, pairs.estimated_deg - pairs.offset_deg)
    )
    return measured, free, "lumbar" if has_waist else "trunk"


def _compare_positions(
    track: PoseTrack | None, reference: PoseTrack | None, lag_s: float
) -> tuple[tuple[PositionAgreement, ...], SpatialAlignment | None, float]:
    """Return the distances of the common joints under three alignments, the transform, and size.

    The size is that of the reference's body divided by the result's.
    """
    if track is None or reference is None or track.unit != "m" or track.position.shape[2] != 3:
        return (), None, math.nan
    own, other = get_skeleton(track.skeleton), get_skeleton(reference.skeleton)
    present = np.any(np.isfinite(reference.position).all(axis=2), axis=0).tolist()
    names = tuple(
        n for n in own.keypoints if n in other.keypoints and present[other.keypoints.index(n)]
    )
    if len(names) < 3:
        return (), None, math.nan
    moved = resample_positions(shift_positions(reference, lag_s), track.time_s)
    transform = align_positions(track, moved, mode="rigid", keypoints=names)
    size = align_positions(track, moved, mode="similarity", keypoints=names).scale
    estimated = track.position[:, [own.index(n) for n in names]]
    truth = moved.position[:, [other.index(n) for n in names]]
    root = [names.index(n) for n in ROOT if n in names]
    # After the one transform of the whole trial, the plain distance says what is left.
    agreements = [
        compare_poses(
            track.time_s, transform.apply(estimated), truth, names=names, alignment="none"
        )
    ]
    if len(root) == len(ROOT):
        agreements.append(
            compare_poses(
                track.time_s,
                transform.apply(estimated),
                truth,
                names=names,
                alignment="root",
                root=root,
            )
        )
    agreements.append(
        compare_poses(track.time_s, estimated, truth, names=names, alignment="procrustes")
    )
    return tuple(agreements), transform, size


def _note_overlap(estimate: Estimate, pairs: PairedAngles) -> tuple[str, ...]:
    whole = float(np.ptp(estimate.angles.time_s))
    common = float(np.ptp(pairs.time_s))
    note = (
        f"The reference covers {common:.1f} s of the result's {whole:.1f} s; nothing is said about "
        "the rest."
    )
    return () if common >= COVERED * whole else (note,)


def _note_doubts(
    alignment: TimeAlignment, track: PoseTrack | None, reference: PoseTrack | None
) -> tuple[str, ...]:
    """Say what hints at another repetition or another person."""
    notes: list[str] = []
    if alignment.correlation < GOOD_CORRELATION:
        notes.append(
            f"The curves fit only moderately (correlation {alignment.correlation:.2f}); make sure "
            "that both recordings show the same person and the same repetition."
        )
    if track is not None and reference is not None and track.position.shape[2] == 3:
        notes += compare_segment_lengths(track, reference).notes
    return tuple(notes)
