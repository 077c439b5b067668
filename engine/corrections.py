"""What a person corrects in a trial, before it is assessed anew.

A correction never touches the stored result: lifts get other times, keypoints change sides, another
person is followed, and the trial is assessed as if it had been seen so. Everything corrected is
written into the new result, with who said it and when, so that it can be shown, and taken back.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, PoseTrack, ViewPose
from engine.errors import ConfigError, DataError
from engine.skeletons import get_skeleton

__all__ = [
    "CONFIG_TABLE",
    "LIMBS",
    "NO_CORRECTIONS",
    "PROVENANCE_KEY",
    "Correction",
    "Corrections",
    "LiftCorrection",
    "PersonChoice",
    "SideSwap",
    "Span",
    "apply_corrections",
    "check_lift",
    "check_pictures",
    "describe_correction",
    "find_limb",
    "read_corrections",
    "restore_sides",
]

PROVENANCE_KEY = "user_corrections"
"""Under this key the image track's provenance lists which sides were exchanged."""
CONFIG_TABLE = "corrections"
"""Under this key a result's settings hold what was corrected."""
SAME_MOMENT_S = 1e-3
SHOWN_S = 0.0051
"""Times are shown and typed to a hundredth of a second."""
ROOM_S = 0.02
"""Times are shown to a hundredth of a second, and pictures come every few of them."""

LIMBS: Mapping[str, tuple[str, ...]] = {
    "body": (),
    "arms": ("shoulder", "elbow", "wrist", "index", "pinky", "thumb"),
    "forearms": ("elbow", "wrist", "index", "pinky", "thumb"),
    "legs": ("hip", "knee", "ankle", "heel", "big_toe"),
    "shins": ("knee", "ankle", "heel", "big_toe"),
}
"""What can be exchanged together: the names of its keypoints without their side; none for all."""

Span = tuple[float, float]
"""Start and end, s."""


@dataclass(frozen=True)
class LiftCorrection:
    """A lift at other times than it was found, one that was missed, or one that is none.

    Parameters
    ----------
    found
        Start and end as they were found, in the trial's time; None for a lift that was missed.
    actual
        Start and end as a person saw them; None where there is no lift.
    by, on
        Who said so, and when (ISO 8601).
    """

    found: Span | None
    actual: Span | None
    by: str = field(default="", compare=False)
    on: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if self.found is None and self.actual is None:
            raise ConfigError("A correction of a lift needs times: those found, or the right ones.")
        for span in (self.found, self.actual):
            if span is not None:
                _require_order("A lift", *span, is_moment_enough=False)


@dataclass(frozen=True)
class SideSwap:
    """Left and right were exchanged by the estimator over a stretch of one video.

    Parameters
    ----------
    start_s, end_s
        In the view's own time; both ends are part of it.
    view
        Number of the view, from 0.
    keypoints
        Which keypoints, by the names of either side; empty for all, the whole body.
    by, on
        Who said so, and when (ISO 8601).
    """

    start_s: float
    end_s: float
    view: int = 0
    keypoints: tuple[str, ...] = ()
    by: str = field(default="", compare=False)
    on: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        _require_order("A stretch to correct", self.start_s, self.end_s, is_moment_enough=True)


@dataclass(frozen=True)
class PersonChoice:
    """Whom to follow in one video, from a moment on.

    Parameters
    ----------
    at_s
        In the view's own time.
    box
        Left, top, right, bottom of the person in that picture, px.
    view
        Number of the view, from 0.
    by, on
        Who said so, and when (ISO 8601).
    """

    at_s: float
    box: tuple[float, float, float, float]
    view: int = 0
    by: str = field(default="", compare=False)
    on: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        left, top, right, bottom = self.box
        if not (math.isfinite(sum(self.box)) and left < right and top < bottom):
            raise ConfigError(
                "The person's box needs left < right and top < bottom, in px, got "
                f"{', '.join(f'{n:g}' for n in self.box)}; draw it anew."
            )
        if not (math.isfinite(self.at_s) and self.at_s >= 0.0):
            raise ConfigError(
                f"The person is chosen at a moment of the video, got {self.at_s:g} s; choose one."
            )


Correction = LiftCorrection | SideSwap | PersonChoice


def _require_order(what: str, start_s: float, end_s: float, *, is_moment_enough: bool) -> None:
    in_order = start_s <= end_s if is_moment_enough else start_s < end_s
    if not (in_order and math.isfinite(start_s) and math.isfinite(end_s)):
        raise ConfigError(
            f"{what} needs a start before its end, got {start_s:g} s to {end_s:g} s; exchange "
            "them or choose others."
        )


@dataclass(frozen=True)
class Corrections:
    """All that people corrected in one trial; each can be taken back alone.

    `only_these_lifts`: what else looks like a lift counts as none.
    """

    lifts: tuple[LiftCorrection, ...] = ()
    swaps: tuple[SideSwap, ...] = ()
    persons: tuple[PersonChoice, ...] = ()
    only_these_lifts: bool = False

    def __post_init__(self) -> None:
        spans = sorted(c.actual for c in self.lifts if c.actual is not None)
        for one, two in pairwise(spans):
            if two[0] < one[1]:
                raise ConfigError(
                    f"Two lifts can't overlap: {_name_span(one)} and {_name_span(two)}; correct "
                    "one of them."
                )
        moments = [(c.view, c.at_s) for c in self.persons]
        if len(set(moments)) < len(moments):
            raise ConfigError("Two persons are chosen at one moment; take one of them back.")

    @classmethod
    def of_lifts(cls, spans: Sequence[Span]) -> Corrections:
        """Return what says that these are the lifts of a trial, and no others."""
        lifts = tuple(LiftCorrection(None, (float(a), float(b))) for a, b in spans)
        return cls(lifts=lifts, only_these_lifts=bool(lifts))

    @property
    def all(self) -> tuple[Correction, ...]:
        """Every correction: lifts, sides, persons."""
        return (*self.lifts, *self.swaps, *self.persons)

    @property
    def set_lifts(self) -> tuple[Span, ...]:
        """The lifts whose times a person set."""
        return tuple(c.actual for c in self.lifts if c.actual is not None)

    @property
    def not_lifts(self) -> tuple[Span, ...]:
        """Where what was found is not what was there."""
        if self.only_these_lifts:
            return ((-math.inf, math.inf),)
        return tuple(c.found for c in self.lifts if c.found is not None)

    def persons_in(self, view: int) -> tuple[PersonChoice, ...]:
        """Return whom to follow in one view, in order of time."""
        return tuple(sorted((c for c in self.persons if c.view == view), key=lambda c: c.at_s))

    def add(self, correction: SideSwap | PersonChoice) -> Corrections:
        """Return these and one more; a person chosen again at one moment replaces the earlier.

        Raises
        ------
        ConfigError
            If they contradict each other.
        """
        if isinstance(correction, SideSwap):
            return dataclasses.replace(self, swaps=(*self.swaps, correction))
        place = (correction.view, correction.at_s)
        others = tuple(c for c in self.persons if (c.view, c.at_s) != place)
        return dataclasses.replace(self, persons=(*others, correction))

    def correct_lift(
        self, shown: Span | None, actual: Span | None, *, by: str = "", on: str = ""
    ) -> Corrections:
        """Return these with one lift put right.

        Parameters
        ----------
        shown
            The lift as the present result shows it, be it found or corrected already; None for
            one that is missing there.
        actual
            As it was; None where there is no lift.
        by, on
            Who says so, and when.

        Returns
        -------
        Corrections
            A lift corrected once more keeps how it was found; one back at its place, or added
            and removed again, needs no correction.

        Raises
        ------
        ConfigError
            If the times are wrong, or overlap another corrected lift.
        """
        earlier = None if shown is None else self._find_lift(shown)
        rest = tuple(c for c in self.lifts if c is not earlier)
        found = shown if earlier is None else earlier.found
        if actual is not None:
            _require_order("A lift", *actual, is_moment_enough=False)
            actual = _keep_unchanged(actual, shown, found)
        is_back = actual is None if found is None else _is_same_span(found, actual)
        if not is_back:
            rest = (*rest, LiftCorrection(found, actual, by=by, on=on))
        return dataclasses.replace(self, lifts=rest)

    def _find_lift(self, shown: Span) -> LiftCorrection | None:
        near = [c for c in self.lifts if c.actual is not None and _overlap_s(c.actual, shown) > 0]
        return max(near, key=lambda c: _overlap_s(c.actual or shown, shown), default=None)

    def remove(self, correction: Correction) -> Corrections:
        """Return these without one."""
        return dataclasses.replace(
            self,
            lifts=tuple(c for c in self.lifts if c is not correction),
            swaps=tuple(c for c in self.swaps if c is not correction),
            persons=tuple(c for c in self.persons if c is not correction),
        )

    def describe(self) -> tuple[str, ...]:
        """Say in one sentence each what was corrected, by whom and when."""
        said = [f"Corrected by hand{_credit(c)}: {describe_correction(c)}." for c in self.all]
        if self.only_these_lifts:
            said.append("Only lifts whose times were given count as lifts.")
        return tuple(said)

    def as_plain(self) -> dict[str, Any]:
        """Return plain values, as written to `trial.json` and requests."""
        return {
            "lifts": [dataclasses.asdict(c) for c in self.lifts],
            "swaps": [_describe(c) for c in self.swaps],
            "persons": [dataclasses.asdict(c) for c in self.persons],
            "only_these_lifts": self.only_these_lifts,
        }

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Corrections:
        """Undo `as_plain`.

        Raises
        ------
        DataError
            If the values are none.
        """
        try:
            return cls(
                lifts=tuple(_build(LiftCorrection, v) for v in plain.get("lifts", ())),
                swaps=tuple(_build(SideSwap, v) for v in plain.get("swaps", ())),
                persons=tuple(_build(PersonChoice, v) for v in plain.get("persons", ())),
                only_these_lifts=bool(plain.get("only_these_lifts", False)),
            )
        except (TypeError, ValueError, AttributeError) as error:
            raise DataError(
                f"What was corrected by hand can't be read ({error}); assess the video again."
            ) from error


NO_CORRECTIONS = Corrections()


def check_lift(actual: Span, *, clip: Span, others: Sequence[Span]) -> None:
    """See to it that a lift can be where a person puts it, before anything is computed.

    Parameters
    ----------
    actual
        Its start and end, in the trial's time.
    clip
        First and last moment of the trial.
    others
        The other lifts.

    Raises
    ------
    ConfigError
        If it lies outside the clip, ends before it starts, or overlaps another one.
    """
    _require_order("A lift", *actual, is_moment_enough=False)
    if actual[0] < clip[0] - ROOM_S or actual[1] > clip[1] + ROOM_S:
        raise ConfigError(
            f"A lift must lie within the clip, {clip[0]:.2f} to {clip[1]:.2f} s, got "
            f"{actual[0]:.2f} to {actual[1]:.2f} s; correct its times."
        )
    for other in others:
        if _overlap_s(actual, other) > ROOM_S:
            raise ConfigError(
                f"It would overlap the lift {_name_span(other)}; correct that one, or say that it "
                "is none."
            )


def check_pictures(correction: SideSwap | PersonChoice, times: Sequence[Array]) -> None:
    """See to it that there are pictures where a person corrects something.

    Parameters
    ----------
    correction
        Sides or a person.
    times
        The times of every view's pictures, each in its own time.

    Raises
    ------
    ConfigError
        If there are none.
    """
    if isinstance(correction, SideSwap):
        start_s, end_s = correction.start_s, correction.end_s
    else:
        start_s, end_s = correction.at_s - SAME_MOMENT_S, correction.at_s + ROOM_S
    if not 0 <= correction.view < len(times):
        raise ConfigError(
            f"There is no view {correction.view + 1} to correct; the trial has {len(times)}."
        )
    _find_rows(times[correction.view], start_s, end_s)


_C = TypeVar("_C", LiftCorrection, SideSwap, PersonChoice)


def _build(kind: type[_C], values: Mapping[str, Any]) -> _C:
    own: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if k != "kind"
    }
    return kind(**own)


def read_corrections(document: Mapping[str, Any]) -> Corrections:
    """Return what was corrected in a stored result, from its `trial.json`.

    Raises
    ------
    DataError
        If that is damaged.
    """
    return Corrections.from_plain(document.get("config", {}).get(CONFIG_TABLE) or {})


# --------------------------------------------------------------------------- in words


def describe_correction(correction: Correction) -> str:
    """Return what was corrected, in words."""
    if isinstance(correction, LiftCorrection):
        return _describe_lift(correction)
    video = f" in video {correction.view + 1}" if correction.view else ""
    if isinstance(correction, PersonChoice):
        return f"another person is followed from {correction.at_s:.2f} s on{video}"
    when = _name_span((correction.start_s, correction.end_s))
    return f"left and right {name_limb(correction.keypoints)} exchanged {when}{video}"


def _describe_lift(correction: LiftCorrection) -> str:
    found, actual = correction.found, correction.actual
    if found is None:
        assert actual is not None  # one of both is there
        return f"a lift added {_name_span(actual)}"
    if actual is None:
        return f"no lift {_name_span(found)}"
    changes = [
        f"{name} {before:.2f} -> {after:.2f} s"
        for name, before, after in zip(("start", "end"), found, actual, strict=True)
        if abs(before - after) > SAME_MOMENT_S
    ]
    return f"lift {_name_span(found)}: {', '.join(changes) or 'confirmed'}"


def name_limb(keypoints: Sequence[str]) -> str:
    """Return in words what a few keypoints are."""
    plain = {name.split("_", 1)[-1] for name in keypoints}
    words = {"body": "of the whole body", "arms": "arms", "legs": "legs"}
    words |= {"forearms": "forearms and hands", "shins": "lower legs and feet"}
    for limb, parts in LIMBS.items():
        if (plain <= set(parts) and parts[0] in plain) if plain else limb == "body":
            return words[limb]
    return ", ".join(sorted(plain)).replace("_", " ")


def _credit(correction: Correction) -> str:
    who = f" by {correction.by}" if correction.by else ""
    if not correction.on:
        return who
    moment = datetime.fromisoformat(correction.on)
    return f"{who} on {moment.day} {moment:%b %Y, %H:%M}" + (" UTC" if moment.tzinfo else "")


def _name_span(span: Span) -> str:
    return f"from {span[0]:.2f} to {span[1]:.2f} s"


def _is_same_span(one: Span, two: Span | None) -> bool:
    return two is not None and all(
        abs(a - b) <= SAME_MOMENT_S for a, b in zip(one, two, strict=True)
    )


def _keep_unchanged(actual: Span, *known: Span | None) -> Span:
    """Return times with what is a known one but for the rounding of the screen as it was."""
    ends = []
    for number, moment in enumerate(actual):
        near = [span[number] for span in known if span is not None]
        ends.append(next((m for m in near if abs(m - moment) <= SHOWN_S), moment))
    return ends[0], ends[1]


def _overlap_s(one: Span, two: Span) -> float:
    return min(one[1], two[1]) - max(one[0], two[0])


# --------------------------------------------------------------------------- sides


def find_limb(skeleton: str, limb: str) -> tuple[str, ...]:
    """Return the keypoints of a limb of `LIMBS` that a skeleton has; none for the whole body."""
    known = get_skeleton(skeleton)
    names = [f"left_{part}" for part in LIMBS[limb]]
    return tuple(name for name in names if name in known.keypoints)


def apply_corrections(
    poses: Sequence[ViewPose], corrections: Sequence[SideSwap]
) -> tuple[ViewPose, ...]:
    """Return keypoints with every exchange of sides applied, in the order given.

    Parameters
    ----------
    poses
        What an estimator saw in each view; stays as it is.
    corrections
        What a person put right. The same one twice cancels itself.

    Returns
    -------
    tuple of ViewPose
        Positions, confidences, errors and states travel with their keypoints; missing samples stay
        missing.

    Raises
    ------
    ConfigError
        If a correction names a view or keypoint that is not there, or no picture lies in it.
    """
    corrected = list(poses)
    for correction in corrections:
        check_pictures(correction, [pose.image.time_s for pose in corrected])
        corrected[correction.view] = _swap_sides(corrected[correction.view], correction)
    return tuple(corrected)


def restore_sides(poses: Sequence[ViewPose]) -> tuple[ViewPose, ...]:
    """Return keypoints as the estimator saw them, every exchange by hand taken back.

    Exchanging only moves samples, so what comes back is the same to the last bit.
    """
    return tuple(map(_restore, poses))


def _restore(pose: ViewPose) -> ViewPose:
    done = pose.image.provenance.get(PROVENANCE_KEY, ())
    for plain in reversed(done):
        pose = _swap_sides(pose, _build(SideSwap, plain))
    provenance = {k: v for k, v in pose.image.provenance.items() if k != PROVENANCE_KEY}
    return dataclasses.replace(pose, image=dataclasses.replace(pose.image, provenance=provenance))


def _swap_sides(pose: ViewPose, swap: SideSwap) -> ViewPose:
    image = _swap_track(pose.image, swap)
    done = [*pose.image.provenance.get(PROVENANCE_KEY, ()), _describe(swap)]
    image = dataclasses.replace(image, provenance={**pose.image.provenance, PROVENANCE_KEY: done})
    return dataclasses.replace(pose, image=image, body=_swap_body(pose.body, swap))


def _swap_body(body: PoseTrack | None, swap: SideSwap) -> PoseTrack | None:
    if body is None:
        return None
    # Some estimators give fewer joints in space than in the picture.
    known = tuple(k for k in swap.keypoints if k in get_skeleton(body.skeleton).keypoints)
    if swap.keypoints and not known:
        return body
    return _swap_track(body, dataclasses.replace(swap, keypoints=known))


def _describe(swap: SideSwap) -> dict[str, object]:
    return {"kind": "side_swap", **dataclasses.asdict(swap), "keypoints": list(swap.keypoints)}


def _swap_track(track: PoseTrack, swap: SideSwap) -> PoseTrack:
    rows = _find_rows(track.time_s, swap.start_s, swap.end_s)
    order = _swapped_order(track.skeleton, swap.keypoints)
    at = np.ix_(rows, order)
    changes = {}
    for name in ("position", "confidence", "sigma", "status"):
        values = getattr(track, name)
        if values is not None:
            changes[name] = values.copy()
            changes[name][rows] = values[at]
    return dataclasses.replace(track, **changes)


def _find_rows(time_s: Array, start_s: float, end_s: float) -> NDArray[np.bool_]:
    rows = (time_s >= start_s) & (time_s <= end_s)
    if not rows.any():
        raise ConfigError(
            f"No picture lies between {start_s:g} s and {end_s:g} s; the video runs from "
            f"{time_s[0]:.2f} s to {time_s[-1]:.2f} s."
        )
    return np.asarray(rows)


def _swapped_order(skeleton: str, keypoints: Sequence[str]) -> NDArray[np.int64]:
    """Return the column order that exchanges both sides of some keypoints, or of all."""
    known = get_skeleton(skeleton)
    strangers = sorted(set(keypoints) - set(known.keypoints))
    if strangers:
        raise ConfigError(f"The skeleton {skeleton!r} has no keypoint {', '.join(strangers)}.")
    chosen = {known.index(name) for name in keypoints}
    order = np.arange(len(known.keypoints))
    for left, right in known.pairs:
        if not keypoints or {left, right} & chosen:
            order[left], order[right] = right, left
    return order
