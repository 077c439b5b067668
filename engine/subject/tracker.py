"""Follows one person's box through a video: the rules of Choi et al. (2024), Eqs 1-5, with guards.

The first frame chooses the largest confident person (Eqs 1-3), later frames the box with
the best sum of confidence and overlap (Eqs 4, 5). The paper looks at every frame and has one
person in the picture; the guards are for what it leaves open: frames without a detection,
passers-by, crossings, and frames that are not looked at to save time.

The rules are functions of boxes; no picture and no network is needed to test them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Frame, PersonBox, SubjectState, TrackedFrame
from engine.errors import ConfigError, NoPersonFound
from engine.subject.appearance import compare_appearance, describe_appearance

__all__ = [
    "PersonTracker",
    "compute_iou",
    "follow_person",
    "select_first",
    "select_next",
]

logger = logging.getLogger(__name__)

Detector = Callable[[NDArray[np.uint8]], Sequence[PersonBox]]
Describer = Callable[[PersonBox], Array]
"""Returns what the person in a box of the current frame looks like."""

GATE_IOU: Final = 0.1
GATE_AREA_RATIO: Final = 2.0
NEAR_GATE_IOU: Final = 0.7
NEAR_GATE_DECAY: Final = 0.02
"""With somebody near, the next box must overlap the expected one this much (less by so much per
frame on hold): boxes around both persons or around the other one overlap it too."""
WEAK_IOU: Final = 0.7
"""A box that lies where it is expected counts with less confidence too."""
SURE_CONFIDENCE: Final = 0.5
SURE_IOU: Final = 0.5
OTHER_THRESHOLD: Final = 0.3
"""Least confidence of a new bystander; weaker boxes are mostly furniture."""
PART_SHARE: Final = 0.7
"""A box that lies this much inside the followed one is taken for a part of it."""
CLAIM_IOU: Final = 0.3
NEAR_MARGIN: Final = 1.5
COVERED_IOU: Final = 0.2
"""Overlap from which one person may hide the other, so that their boxes may be exchanged."""
APART_IOU: Final = 0.05
MAX_MISSED: Final = 4
"""Looks without a bystander whom the followed person can't hide."""
LOOKS_MARGIN: Final = 0.06
"""By how much an exchange must fit the looks of both persons better than none."""
MAX_CHECKS: Final = 10
"""Looks after people came apart, until who is who is taken as settled."""
LOOKS_GAIN: Final = 0.3
SAME_LOOKS: Final = 0.85
"""Below this somebody else may have come into the box unseen; nothing is learnt from it."""
DAMPING: Final = 0.95
"""Of the velocity per frame that is predicted: nobody keeps going for long."""
VELOCITY_GAIN: Final = 0.5
NEAR_VELOCITY_GAIN: Final = 0.1
"""Boxes of people who cover each other jump; how people went before tells where they come out."""
LOST_GROWTH: Final = 0.02
"""Growth per frame of the neighbourhood in which a lost person is sought, in box diagonals."""
SEARCH_EVERY: Final = 3
"""Frames between looks while nobody is followed."""
NEAR_EVERY: Final = 1
UNSURE_EVERY: Final = 2
MAX_REST_S: Final = 0.5
"""Longest time between looks, however few frames a second there are."""
COMPANY_EVERY: Final = 4
"""Frames between looks while somebody else is in the picture, who may come nearer."""


def compute_iou(a: PersonBox, b: PersonBox) -> float:
    """Return the intersection over union of two boxes (Eq 4), 0 to 1."""
    inter = _intersection(a, b)
    union = _area(a) + _area(b) - inter
    return inter / union if union > 0 else 0.0


def select_first(
    persons: Sequence[PersonBox], *, threshold: float, step: float, floor: float
) -> PersonBox | None:
    """Choose the largest person above a threshold that is lowered until there is one (Eqs 1-3).

    Parameters
    ----------
    persons
        Boxes of persons (Eq 2 is the detector's).
    threshold, step, floor
        Where the confidence threshold starts, by how much it is lowered, and where it ends.

    Returns
    -------
    PersonBox or None
        None if nobody reaches the floor.
    """
    n_steps = max(0, math.ceil((threshold - floor) / step - 1e-9))
    levels = [max(threshold - i * step, floor) for i in range(n_steps + 1)]
    for level in levels:
        # Steps of 0.1 don't add up exactly; a confidence on the threshold counts.
        confident = [p for p in persons if p.confidence >= level - 1e-9]
        if confident:
            return max(confident, key=_area)
    return None


def select_next(
    persons: Sequence[PersonBox],
    previous: PersonBox,
    *,
    threshold: float,
    iou_weight: float = 1.0,
    score: Literal["sum", "literal"] = "sum",
) -> PersonBox | None:
    """Choose the person that continues a track (Eqs 4, 5).

    Parameters
    ----------
    persons
        Boxes of persons.
    previous
        Where the person was, or is expected.
    threshold
        Boxes with less confidence are dropped.
    iou_weight
        Weight of the overlap against the confidence.
    score
        `sum` takes the argument of the maximum of confidence + weight x IoU, as the paper's prose
        says; `literal` its Eq 5 as printed, which adds the same largest IoU to every box, so that
        the most confident box wins wherever it is.

    Returns
    -------
    PersonBox or None
        The chosen box with its `iou`; None if there is no candidate.
    """
    rated = [replace(p, iou=compute_iou(previous, p)) for p in persons if p.confidence >= threshold]
    if not rated:
        return None
    if score == "literal":
        best_iou = max(p.iou for p in rated)
        return max(rated, key=lambda p: p.confidence + iou_weight * best_iou)
    return max(rated, key=lambda p: p.confidence + iou_weight * p.iou)


@dataclass(eq=False)
class _Motion:
    """A box that moves with a damped constant velocity between looks."""

    box: PersonBox
    velocity: tuple[float, float] = (0.0, 0.0)
    age: int = 0
    """Frames since the last observation."""
    n_missed: int = 0
    """Looks since the last observation."""
    may_be_subject: bool = False
    """Whether this bystander appeared while the followed person was out of sight."""
    looks: Array | None = None
    """Appearance, learnt while nobody was near."""
    has_met: bool = False
    """Whether this bystander and the followed person overlapped since they were told apart."""
    observed: PersonBox = field(init=False)

    def __post_init__(self) -> None:
        self.observed = self.box

    def advance(self) -> None:
        """Go one frame on without an observation."""
        slowing = DAMPING**self.age
        vx, vy = (v * slowing for v in self.velocity)
        self.box = replace(
            self.box,
            left=self.box.left + vx,
            right=self.box.right + vx,
            top=self.box.top + vy,
            bottom=self.box.bottom + vy,
        )
        self.age += 1

    def observe(self, box: PersonBox, *, gain: float = VELOCITY_GAIN) -> None:
        """Take an observation of the current frame (after `advance`).

        `gain` is the weight of the newest displacement in the velocity.
        """
        frames = max(self.age, 1)
        (x0, y0), (x1, y1) = _centre(self.observed), _centre(box)
        self.velocity = (
            (1 - gain) * self.velocity[0] + gain * (x1 - x0) / frames,
            (1 - gain) * self.velocity[1] + gain * (y1 - y0) / frames,
        )
        self.box = self.observed = box
        self.age = self.n_missed = 0

    def move_to(self, box: PersonBox) -> None:
        """Take another box without a change of velocity."""
        self.box = self.observed = box
        self.age = self.n_missed = 0

    def learn(self, looks: Array) -> None:
        """Take the appearance of the box just observed."""
        if not np.isfinite(looks).all():
            return
        old = looks if self.looks is None else self.looks
        if compare_appearance(old, looks) < SAME_LOOKS:
            return
        self.looks = (1 - LOOKS_GAIN) * old + LOOKS_GAIN * looks


class PersonTracker:
    """The state of following one person.

    Call `step` for every frame in order, with the persons seen in it, or with None for a frame that
    was not looked at.

    Parameters
    ----------
    first_threshold, threshold_step, threshold_floor
        See `select_first`.
    track_threshold, iou_weight, score
        See `select_next`.
    hold_frames
        Frames for which an unseen person's box is kept moving before the person counts as lost.
    detect_every
        Most frames between two looks.
    box_margin
        Size of the neighbourhood in which a lost person is sought again, in boxes.
    box
        Left, top, right, bottom (px) of the person in the first frame, if a user named one.
    """

    def __init__(
        self,
        *,
        first_threshold: float = 0.7,
        threshold_step: float = 0.1,
        threshold_floor: float = 0.2,
        track_threshold: float = 0.3,
        iou_weight: float = 1.0,
        score: Literal["sum", "literal"] = "sum",
        hold_frames: int = 15,
        detect_every: int = 15,
        box_margin: float = 1.25,
        box: tuple[float, float, float, float] | None = None,
    ) -> None:
        self._first = {
            "threshold": first_threshold,
            "step": threshold_step,
            "floor": threshold_floor,
        }
        self._track_threshold = track_threshold
        self._iou_weight = iou_weight
        self._score: Literal["sum", "literal"] = score
        self._hold_frames = hold_frames
        self._detect_every = detect_every
        self._box_margin = box_margin
        self._user_box = None if box is None else PersonBox(*box)
        self._motion: _Motion | None = None
        self._others: list[_Motion] = []
        self._state = SubjectState.LOST
        self._is_tentative = False
        self._interval = 1
        self._until_look = 0
        self._frames_held = 0
        self._is_meeting = False
        self._met_looks: list[Array] = []
        self._n_checks = 0

    @property
    def was_found(self) -> bool:
        """Whether the person was ever seen."""
        return self._motion is not None

    @property
    def wants_look(self) -> bool:
        """Whether the next frame should be looked at by the detector."""
        return self._until_look <= 0

    @property
    def others(self) -> tuple[PersonBox, ...]:
        """Boxes of the other persons in the current frame; held ones are predictions."""
        return tuple(
            m.box if m.age == 0 else replace(m.box, state=SubjectState.HELD) for m in self._others
        )

    def step(
        self, persons: Sequence[PersonBox] | None, describe: Describer | None = None
    ) -> PersonBox | None:
        """Go one frame on.

        Parameters
        ----------
        persons
            Everybody the detector saw in this frame; None if it did not look.
        describe
            Tells what a person looks like; without it, only places tell persons apart.

        Returns
        -------
        PersonBox or None
            The followed person's box; None while lost.
        """
        for motion in (*self._others, *([self._motion] if self._motion else [])):
            motion.advance()
        self._until_look -= 1
        if persons is not None:
            self._look(persons)
            if describe is not None:
                self._tell_apart(describe)
            self._plan_next_look()
        elif self._state is SubjectState.INIT:
            self._state = SubjectState.TRACKED
        if self._state is SubjectState.HELD:
            self._frames_held += 1
        self._forget_others()
        return self._current_box()

    def _current_box(self) -> PersonBox | None:
        if self._motion is None or self._state is SubjectState.LOST:
            return None
        return replace(self._motion.box, state=self._state)

    def _look(self, persons: Sequence[PersonBox]) -> None:
        persons = [p for p in persons if _area(p) > 0]
        if self._motion is None:
            self._start(persons)
        elif self._state is SubjectState.LOST:
            free = self._claim_others(persons)
            self._restart([p for p in free if self._is_in_neighbourhood(p)])
        else:
            self._continue(self._claim_others(persons), persons)
        self._welcome_others(persons)

    def _start(self, persons: Sequence[PersonBox]) -> None:
        if self._user_box is not None:
            self._follow_named(persons, self._user_box)
            return
        chosen = select_first(persons, **self._first)
        if chosen is not None:
            self._begin(chosen)

    def _follow_named(self, persons: Sequence[PersonBox], named: PersonBox) -> None:
        """Start at the person in the user's box; trust the user where nobody was seen."""
        overlapping = [p for p in persons if compute_iou(named, p) >= CLAIM_IOU]
        best = max(overlapping, key=lambda p: compute_iou(named, p), default=named)
        self._begin(best)
        self._is_tentative = False

    def _restart(self, persons: Sequence[PersonBox]) -> None:
        chosen = select_first(persons, **self._first)
        if chosen is not None:
            self._begin(chosen)

    def _begin(self, box: PersonBox) -> None:
        self._motion = _Motion(box)
        self._state = SubjectState.INIT
        self._is_tentative = not box.confidence >= SURE_CONFIDENCE
        self._interval = 1
        self._others = [m for m in self._others if m.observed is not box]
        for other in self._others:
            other.may_be_subject = False

    def _continue(self, free: Sequence[PersonBox], persons: Sequence[PersonBox]) -> None:
        motion = self._motion
        assert motion is not None
        is_literal = self._score == "literal"
        chosen = select_next(
            persons if is_literal else [p for p in free if self._passes_gate(p)],
            motion.box,
            threshold=self._track_threshold,
            iou_weight=self._iou_weight,
            score=self._score,
        )
        if chosen is None and not is_literal:
            chosen = self._select_weak(free)
        if chosen is not None and self._passes_gate(chosen):
            motion.observe(chosen, gain=self._velocity_gain)
            self._state = SubjectState.TRACKED
            self._is_tentative = self._is_tentative and chosen.confidence < SURE_CONFIDENCE
        else:
            self._hold()
        if self._is_tentative:
            self._prefer_certain(persons)

    def _select_weak(self, free: Sequence[PersonBox]) -> PersonBox | None:
        assert self._motion is not None
        expected = self._motion.box
        in_place = [p for p in free if compute_iou(expected, p) >= WEAK_IOU]
        return select_next(in_place, expected, threshold=self._first["floor"])

    def _hold(self) -> None:
        """Keep the unseen person's box moving, for a while."""
        if self._state is not SubjectState.HELD:
            self._frames_held = 0
        self._state = SubjectState.HELD
        if self._frames_held >= self._hold_frames:
            self._state = SubjectState.LOST
            logger.info("The followed person was lost.")

    def _prefer_certain(self, persons: Sequence[PersonBox]) -> None:
        """Leave a start that never became convincing for somebody who is."""
        certain = [p for p in persons if p.confidence >= self._first["threshold"]]
        if certain:
            self._begin(max(certain, key=_area))

    def _passes_gate(self, box: PersonBox) -> bool:
        """Whether a box can be the followed person after the time that passed."""
        assert self._motion is not None
        iou = compute_iou(self._motion.box, box)
        if self._is_somebody_near():
            held = self._frames_held if self._state is SubjectState.HELD else 0
            return iou >= NEAR_GATE_IOU - NEAR_GATE_DECAY * held
        if iou >= GATE_IOU:
            return True
        ratio = _area(box) / max(_area(self._motion.observed), 1e-9)
        is_alike = 1 / GATE_AREA_RATIO <= ratio <= GATE_AREA_RATIO
        return is_alike and self._is_in_neighbourhood(box)

    def _is_in_neighbourhood(self, box: PersonBox) -> bool:
        assert self._motion is not None
        last = self._motion.box
        (x0, y0), (x1, y1) = _centre(last), _centre(box)
        overtime = max(0, self._motion.age - self._hold_frames)
        reach = self._box_margin / 2 + LOST_GROWTH * overtime
        return math.hypot(x1 - x0, y1 - y0) <= reach * math.hypot(*last.size_px)

    def _claim_others(self, persons: Sequence[PersonBox]) -> list[PersonBox]:
        """Give the bystanders their boxes; return the boxes that are left.

        Every box goes to the track it overlaps most, one box a track. Parts of a bystander's box
        are not left either.
        """
        assert self._motion is not None
        is_lost = self._state is SubjectState.LOST
        tracks = [*self._others, *([] if is_lost else [self._motion])]
        pairs = sorted(
            (
                (compute_iou(track.box, p), t, i)
                for t, track in enumerate(tracks)
                for i, p in enumerate(persons)
            ),
            reverse=True,
        )
        owner: dict[int, _Motion] = {}
        for iou, t, i in pairs:
            if iou >= CLAIM_IOU and i not in owner and tracks[t] not in owner.values():
                owner[i] = tracks[t]
        for track in self._others:
            track.n_missed += 1
        for i, track in owner.items():
            if track is not self._motion:
                track.observe(persons[i], gain=self._velocity_gain)
        strangers = [
            persons[i]
            for i, track in owner.items()
            if track is not self._motion and not track.may_be_subject
        ]
        own = [persons[i] for i, track in owner.items() if track is self._motion]
        return [
            p
            for p in persons
            if p in own or not any(_is_part_of(p, stranger) for stranger in strangers)
        ]

    def _welcome_others(self, persons: Sequence[PersonBox]) -> None:
        """Start tracks of bystanders that were not known."""
        if self._motion is None:
            return
        is_lost = self._state is SubjectState.LOST
        is_hidden = not self._is_seen or self._is_meeting
        known = [m.observed for m in self._others]
        if not is_lost:
            known.append(self._motion.box)
        for person in persons:
            is_new = person.confidence >= OTHER_THRESHOLD and all(
                _intersection(person, k) < PART_SHARE * min(_area(person), _area(k)) for k in known
            )
            if is_new:
                self._others.append(_Motion(person, may_be_subject=is_hidden))
                known.append(person)

    def _tell_apart(self, describe: Describer) -> None:
        """Learn what everybody looks like; after people covered each other, check who is who."""
        own = self._motion
        if own is None:
            return
        covering = [m for m in self._others if compute_iou(own.box, m.box) > COVERED_IOU]
        self._meet(covering)
        if self._is_meeting:
            self._check_looks(describe)
        elif self._is_seen:
            for motion in (own, *(m for m in self._others if m.age == 0)):
                motion.learn(describe(motion.box))

    def _meet(self, covering: Sequence[_Motion]) -> None:
        for other in covering:
            self._is_meeting = True
            if not other.has_met and other.looks is not None:
                self._met_looks.append(other.looks)
            other.has_met = True
            if other.age == 0:
                self._n_checks = 0

    def _check_looks(self, describe: Describer) -> None:
        """Follow whom looks most like the person did before the meeting."""
        own = self._motion
        assert own is not None
        if own.looks is None or (self._is_seen and not self._is_clear(own)):
            return
        if not self._is_seen and not self._met_looks:
            return
        candidates = [
            m for m in self._others if (m.has_met or m.may_be_subject) and self._is_clear(m)
        ]
        kept = self._compare_with_own(own, describe) if self._is_seen else 0.0
        gains = [self._compare_with_own(c, describe) - kept for c in candidates]
        if gains and max(gains) > LOOKS_MARGIN:
            self._exchange(candidates[gains.index(max(gains))])
            return
        self._n_checks += self._is_seen
        if self._n_checks >= MAX_CHECKS:
            self._end_meeting()

    def _is_clear(self, motion: _Motion) -> bool:
        """Whether somebody is seen in the current frame, and nobody before or behind them."""
        assert self._motion is not None
        seen = [m for m in self._others if m.age == 0]
        if self._is_seen:
            seen.append(self._motion)
        return motion in seen and all(
            m is motion or compute_iou(motion.box, m.box) <= APART_IOU for m in seen
        )

    def _compare_with_own(self, motion: _Motion, describe: Describer) -> float:
        """Return how much more somebody looks like the followed person than like who was met."""
        assert self._motion is not None
        own_looks = self._motion.looks
        now = describe(motion.box)
        if own_looks is None or not np.isfinite(now).all():
            return 0.0
        like_others = max((compare_appearance(m, now) for m in self._met_looks), default=0.0)
        return compare_appearance(own_looks, now) - like_others

    def _exchange(self, other: _Motion) -> None:
        """Follow the person in a bystander's box."""
        own = self._motion
        assert own is not None
        logger.info("The followed person's box was taken back from somebody who passed.")
        if self._is_seen:
            own.looks, other.looks = next(iter(self._met_looks), None), own.looks
            self._others = [own if m is other else m for m in self._others]
            self._motion = other
            self._end_meeting()
        else:
            # The other one must be hidden now, and comes out where they were going.
            own.move_to(other.box)
            other.n_missed = 0
            self._state = SubjectState.TRACKED

    def _end_meeting(self) -> None:
        self._is_meeting = False
        self._met_looks = []
        for other in self._others:
            other.has_met = other.may_be_subject = False

    @property
    def _is_seen(self) -> bool:
        """Whether the followed person was observed in the current frame."""
        is_followed = self._state in {SubjectState.INIT, SubjectState.TRACKED}
        return is_followed and self._motion is not None and self._motion.age == 0

    def _forget_others(self) -> None:
        """Drop bystanders who were not seen for long, sooner where nothing can hide them."""
        limit = self._hold_frames + self._detect_every
        own = None if self._motion is None else self._motion.box
        self._others = [
            m
            for m in self._others
            if m.age <= limit
            and (m.n_missed <= MAX_MISSED or (own and compute_iou(own, m.box) > APART_IOU))
        ]

    def _plan_next_look(self) -> None:
        if self._motion is None or self._state is SubjectState.LOST:
            self._interval = SEARCH_EVERY
        elif self._is_somebody_near():
            self._interval = NEAR_EVERY
        elif not self._is_sure():
            self._interval = UNSURE_EVERY
        else:
            self._interval *= 2
        most = min(COMPANY_EVERY, self._detect_every) if self._others else self._detect_every
        self._interval = min(self._interval, most)
        self._until_look = self._interval - 1

    def _is_sure(self) -> bool:
        """Whether the last look left no doubt.

        A person alone who is where they should be is no doubt, however faint; the first look
        after a start counts as in place.
        """
        assert self._motion is not None
        box = self._motion.observed
        if self._motion.age > 0:
            return False
        is_in_place = self._state is SubjectState.INIT or box.iou >= SURE_IOU
        return is_in_place and (box.confidence >= SURE_CONFIDENCE or not self._others)

    @property
    def _velocity_gain(self) -> float:
        return NEAR_VELOCITY_GAIN if self._is_somebody_near() else VELOCITY_GAIN

    def _is_somebody_near(self) -> bool:
        assert self._motion is not None
        own = _grown(self._motion.box, NEAR_MARGIN)
        return any(_intersection(own, other.box) > 0 for other in self._others)


def follow_person(
    frames: Iterable[Frame],
    detector: Detector,
    *,
    first_threshold: float = 0.7,
    threshold_step: float = 0.1,
    threshold_floor: float = 0.2,
    track_threshold: float = 0.3,
    iou_weight: float = 1.0,
    score: Literal["sum", "literal"] = "sum",
    hold_frames: int = 15,
    detect_every: int = 15,
    box_margin: float = 1.25,
    box: tuple[float, float, float, float] | None = None,
) -> Iterator[TrackedFrame]:
    """Follow one person through a video, in a single pass.

    The detector looks at every `detect_every`-th frame while there is no doubt, at every fourth
    one while somebody else is in the picture, at every one while somebody is near, and at every
    second or third one while the person is uncertain or lost; twice a second at least. Between
    looks the box is predicted.

    Parameters
    ----------
    frames
        Pictures in order; consumed as they are needed.
    detector
        Returns the persons in a picture (H, W, 3) RGB.
    first_threshold, threshold_step, threshold_floor, track_threshold, iou_weight, score,
    hold_frames, detect_every, box_margin, box
        See `PersonTracker`; the names are those of `engine.config.SubjectConfig`.

    Yields
    ------
    TrackedFrame
        One per frame; without a box while the person is lost.

    Raises
    ------
    ConfigError
        If `box` lies outside the picture.
    NoPersonFound
        At the end, if the person was never seen.

    References
    ----------
    .. [1] Choi et al. (2024), monocular 3D pose with a humanoid fit, Eqs 1-5.
    """
    tracker = PersonTracker(
        first_threshold=first_threshold,
        threshold_step=threshold_step,
        threshold_floor=threshold_floor,
        track_threshold=track_threshold,
        iou_weight=iou_weight,
        score=score,
        hold_frames=hold_frames,
        detect_every=detect_every,
        box_margin=box_margin,
        box=box,
    )
    n_frames, last_look_s = 0, -math.inf
    for frame in frames:
        if n_frames == 0 and box is not None:
            _require_inside(box, frame.image)
        n_frames += 1
        is_anchor = tracker.wants_look or frame.time_s - last_look_s >= MAX_REST_S
        followed = tracker.step(
            detector(frame.image) if is_anchor else None,
            partial(describe_appearance, frame.image),
        )
        last_look_s = frame.time_s if is_anchor else last_look_s
        yield TrackedFrame(frame=frame, box=followed, is_anchor=is_anchor, others=tracker.others)
    if not tracker.was_found:
        raise NoPersonFound(
            f"Expected a person in the video, but none was seen in {n_frames} pictures; film the "
            "whole body, in good light, and let it fill at least a third of the picture's height."
        )


def _require_inside(box: tuple[float, float, float, float], image: NDArray[np.uint8]) -> None:
    height, width = image.shape[:2]
    left, top, right, bottom = box
    if right <= 0 or bottom <= 0 or left >= width or top >= height:
        raise ConfigError(
            f"The person's box ({left:g}, {top:g}, {right:g}, {bottom:g}) lies outside the picture "
            f"of {width} x {height} px; give left, top, right, bottom in px."
        )


def _area(box: PersonBox) -> float:
    width, height = box.size_px
    return max(width, 0.0) * max(height, 0.0)


def _centre(box: PersonBox) -> tuple[float, float]:
    return (box.left + box.right) / 2, (box.top + box.bottom) / 2


def _intersection(a: PersonBox, b: PersonBox) -> float:
    width = min(a.right, b.right) - max(a.left, b.left)
    height = min(a.bottom, b.bottom) - max(a.top, b.top)
    return max(width, 0.0) * max(height, 0.0)


def _is_part_of(part: PersonBox, whole: PersonBox) -> bool:
    """Whether a box is another, or lies inside it."""
    is_inside = _intersection(part, whole) >= PART_SHARE * _area(part)
    return part == whole or (is_inside and _area(part) < _area(whole))


def _grown(box: PersonBox, factor: float) -> PersonBox:
    (x, y), (width, height) = _centre(box), box.size_px
    half_width, half_height = width / 2 * factor, height / 2 * factor
    return replace(
        box, left=x - half_width, top=y - half_height, right=x + half_width, bottom=y + half_height
    )
