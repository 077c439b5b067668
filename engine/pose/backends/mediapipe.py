"""MediaPipe's BlazePose, run by ONNX Runtime: 33 landmarks in px and in metres."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from engine.config import PoseConfig
from engine.datatypes import (
    Array,
    PersonBox,
    PoseTrack,
    ProgressCallback,
    SubjectState,
    TrackedFrame,
    TrackedStream,
    ViewInfo,
    ViewPose,
)
from engine.errors import NoPersonFound
from engine.pose.association import (
    agrees_with_box,
    bound_landmarks,
    compute_box_iou,
    interpolate_box,
)
from engine.pose.base import BackendInfo
from engine.pose.blazepose import (
    MAX_AHEAD,
    N_LANDMARKS,
    BlazePoseNetworks,
    Landmarks,
    PoseFollower,
    PoseGlance,
    Region,
    estimate_sigma_px,
)
from engine.skeletons import MEDIAPIPE_33

BACKEND_INFO = BackendInfo(
    name="mediapipe",
    title="MediaPipe Pose (BlazePose)",
    skeleton=MEDIAPIPE_33.name,
    licence="Apache-2.0",
    description=(
        "33 landmarks in the picture and in metres around the hips. The networks are Google's, "
        "run on the CPU by ONNX Runtime; variants heavy (default) and full (faster, less exact)."
    ),
    requires=("onnxruntime", "cv2"),
)

SEARCH_MARGIN: Final = 1.25
"""How much larger than the person's box the square is in which BlazePose starts."""
BOX_MARGIN: Final = 0.06
"""What the landmarks leave out of a body (hair, hands, soles), as a share of its larger side."""
MAX_AHEAD_S: Final = 0.1
"""People move too far in more time to be sought where they were."""
EXCHANGE_IOU: Final = 0.2
"""A box that jumps further from one frame to the next is another person's."""
DOUBTFUL_SHARE: Final = 0.85
"""Of the usual mean confidence. Most pictures below it are seen in a region that slipped off the
body, as happens when people rise fast; some are of people who turn away."""
USUAL_GAIN: Final = 0.1
DOUBTFUL_GAIN: Final = 0.02
"""How fast the usual confidence follows that of sure and of doubtful pictures."""
DOUBTFUL_EVERY: Final = 3
"""Pictures between new looks for a person of whom the landmarks are doubtful."""
LEFT_HIP, RIGHT_HIP = MEDIAPIPE_33.index("left_hip"), MEDIAPIPE_33.index("right_hip")


class Backend:
    """BlazePose on one followed person.

    Parameters
    ----------
    config
        `variant`, `threads` and `min_person_confidence` are used.
    """

    info = BACKEND_INFO

    def __init__(self, config: PoseConfig) -> None:
        self._variant = config.variant
        self._min_confidence = config.min_person_confidence
        self._networks = BlazePoseNetworks(config.variant, threads=config.threads)

    def estimate(
        self, frames: TrackedStream, view: ViewInfo, progress: ProgressCallback
    ) -> ViewPose:
        """Estimate the landmarks of the followed person.

        The landmarks are those the network saw, neither smoothed nor filled. A keypoint's
        confidence is the smaller of its visibility and its presence. Where the landmarks turn
        out to be somebody else's they are NaN. The body track has its origin in the middle
        between the hips.

        Parameters
        ----------
        frames
            Pictures with the person's box.
        view
            What is known of the video.
        progress
            Called as ``progress("pose", done, view.n_frames)`` for every frame.

        Returns
        -------
        ViewPose
            `model_time_s` is the time inside the two BlazePose networks; the person
            detector counts its own (`PersonDetector.model_time_s`).

        Raises
        ------
        NoPersonFound
            If no frame shows a person whose landmarks can be found.
        """
        model_time_s = self._networks.model_time_s
        record = _Record()
        with self._networks.make_executor() as executor:
            follower = _AssociatedFollower(
                PoseFollower(self._networks, min_confidence=self._min_confidence, executor=executor)
            )
            for glance in look_ahead(frames, follower.begin):
                record.reject(follower.finish(glance, record))
                progress("pose", len(record.time_s), view.n_frames)
        if not record.has_landmarks:
            raise NoPersonFound(
                "Expected a person whose posture can be seen, but found none in "
                f"{len(record.time_s)} pictures; film the whole body from the side, in good light."
            )
        provenance = {"estimator": self.info.name, "variant": self._variant}
        return record.as_view_pose(view, provenance, self._networks.model_time_s - model_time_s)


@dataclass(eq=False)
class _Record:
    """What is kept of every frame."""

    time_s: list[float] = field(default_factory=list)
    image: list[Array] = field(default_factory=list)
    body: list[Array] = field(default_factory=list)
    confidence: list[Array] = field(default_factory=list)
    sigma_px: list[Array] = field(default_factory=list)
    box: list[PersonBox | None] = field(default_factory=list)
    others: list[tuple[PersonBox, ...]] = field(default_factory=list)

    def add(self, tracked: TrackedFrame, landmarks: Landmarks | None) -> None:
        self.time_s.append(tracked.frame.time_s)
        self.box.append(tracked.box)
        self.others.append(tracked.others)
        if landmarks is None:
            self.image.append(np.full((N_LANDMARKS, 2), np.nan))
            self.body.append(np.full((N_LANDMARKS, 3), np.nan))
            self.confidence.append(np.full(N_LANDMARKS, np.nan))
            self.sigma_px.append(np.full(N_LANDMARKS, np.nan))
            return
        self.image.append(landmarks.image)
        self.body.append(landmarks.world - landmarks.world[[LEFT_HIP, RIGHT_HIP]].mean(axis=0))
        confidence = landmark_confidence(landmarks)
        self.confidence.append(confidence)
        self.sigma_px.append(estimate_sigma_px(confidence, landmarks.region))

    def reject(self, rows: Sequence[int]) -> None:
        for row in rows:
            self.image[row] = np.full((N_LANDMARKS, 2), np.nan)
            self.body[row] = np.full((N_LANDMARKS, 3), np.nan)
            self.sigma_px[row] = np.full(N_LANDMARKS, np.nan)

    def rows_of_overlap(self, row: int) -> list[int]:
        """Return the rows before `row` since the followed person last met somebody."""
        rows: list[int] = []
        has_met = False
        for before in range(row - 1, -1, -1):
            box = self.box[before]
            is_together = box is not None and any(
                compute_box_iou(box, other) > 0 for other in self.others[before]
            )
            if has_met and not is_together:
                return rows
            has_met = has_met or is_together
            rows.append(before)
        return rows if has_met else []

    @property
    def has_landmarks(self) -> bool:
        return any(np.isfinite(points).any() for points in self.image)

    def as_view_pose(
        self, view: ViewInfo, provenance: dict[str, str], model_time_s: float
    ) -> ViewPose:
        """Return the tracks."""
        time_s, confidence = np.array(self.time_s), np.array(self.confidence)
        image = PoseTrack(
            time_s=time_s,
            position=np.array(self.image),
            unit="px",
            frame_of_reference="image",
            skeleton=MEDIAPIPE_33.name,
            confidence=confidence,
            sigma=np.array(self.sigma_px),
            provenance=provenance,
        )
        body = PoseTrack(
            time_s=time_s,
            position=np.array(self.body),
            unit="m",
            frame_of_reference="body",
            skeleton=MEDIAPIPE_33.name,
            confidence=confidence,
            provenance=provenance,
        )
        rows = zip(self.box, self.image, self.confidence, strict=True)
        return ViewPose(
            image=image,
            body=body,
            box=np.array([_shown_box(*row) for row in rows]),
            state=tuple(SubjectState.LOST if b is None else b.state for b in self.box),
            info=view,
            others=tuple(self.others),
            model_time_s=model_time_s,
        )


@dataclass(frozen=True, eq=False)
class _Glance:
    """A frame that is being looked at; no pose is sought while the person is lost."""

    tracked: TrackedFrame
    pose: PoseGlance | None


def look_ahead(
    frames: TrackedStream,
    begin: Callable[[TrackedFrame], _Glance],
    *,
    n_ahead: int = MAX_AHEAD,
    max_ahead_s: float = MAX_AHEAD_S,
) -> Iterator[_Glance]:
    """Begin frames before the ones before them are finished, and return them in order.

    While a frame waits to be finished the next one is read and begun. How far ahead does not depend
    on the machine, so neither does the outcome.

    Parameters
    ----------
    frames
        Pictures with the person's box.
    begin
        Starts the work on a frame.
    n_ahead, max_ahead_s
        A frame is begun when fewer than this many others wait, none of them longer ago than this.
    """
    waiting: deque[_Glance] = deque()
    for tracked in frames:
        while waiting and (
            len(waiting) >= n_ahead
            or tracked.frame.time_s - waiting[0].tracked.frame.time_s > max_ahead_s
        ):
            yield waiting.popleft()
        waiting.append(begin(tracked))
    yield from waiting


class _AssociatedFollower:
    """A pose follower that stays on the tracked person."""

    def __init__(self, follower: PoseFollower) -> None:
        self._follower = follower
        self._last_good: tuple[int, PersonBox] | None = None
        self._last_box: PersonBox | None = None
        self._usual_confidence: float | None = None
        self._last_retry = -DOUBTFUL_EVERY

    def begin(self, tracked: TrackedFrame) -> _Glance:
        """Begin to look at the next frame."""
        if tracked.box is None:
            return _Glance(tracked, None)
        return _Glance(tracked, self._follower.begin(tracked.frame.image))

    def finish(self, glance: _Glance, record: _Record) -> list[int]:
        """Estimate a frame that was begun and record it.

        Returns
        -------
        list of int
            Rows of the record that turned out to show somebody else.
        """
        row, tracked = len(record.time_s), glance.tracked
        box, before = tracked.box, self._last_box
        self._last_box = box
        if box is None or glance.pose is None:
            self._follower.restart()
            self._last_good = None
            record.add(tracked, None)
            return []
        is_observed = tracked.is_anchor and box.state is not SubjectState.HELD
        landmarks = self._follower.finish(glance.pose, search_region(box))
        had_slipped = landmarks is not None and not _fits(landmarks, tracked, is_observed)
        if had_slipped:
            landmarks = self._start_again(tracked, box, is_observed)
        elif landmarks is not None and self._is_doubtful(landmarks, row):
            self._last_retry = row
            landmarks = self._look_anew(landmarks, tracked, box, is_observed)
        record.add(tracked, landmarks)
        suspects: list[int] = []
        if before is not None and compute_box_iou(before, box) < EXCHANGE_IOU:
            suspects = record.rows_of_overlap(row)
        elif had_slipped and is_observed:
            suspects = self._find_suspects(record, row, box)
        if is_observed:
            self._last_good = None if landmarks is None else (row, box)
        return suspects

    def _start_again(
        self, tracked: TrackedFrame, box: PersonBox, is_observed: bool
    ) -> Landmarks | None:
        self._follower.restart()
        landmarks = self._follower.update(tracked.frame.image, search_region(box))
        if landmarks is None or _fits(landmarks, tracked, is_observed):
            return landmarks
        self._follower.restart()
        return None

    def _is_doubtful(self, landmarks: Landmarks, row: int) -> bool:
        """Whether the region may have slipped off the body, and it is time to see."""
        confidence = _mean_confidence(landmarks)
        usual = confidence if self._usual_confidence is None else self._usual_confidence
        is_low = confidence < DOUBTFUL_SHARE * usual
        gain = DOUBTFUL_GAIN if is_low else USUAL_GAIN
        self._usual_confidence = usual + gain * (confidence - usual)
        return is_low and row - self._last_retry >= DOUBTFUL_EVERY

    def _look_anew(
        self, landmarks: Landmarks, tracked: TrackedFrame, box: PersonBox, is_observed: bool
    ) -> Landmarks:
        """Return the surer of the landmarks and of those in a region that is found afresh."""
        region = self._follower.region
        self._follower.restart()
        again = self._follower.update(tracked.frame.image, search_region(box))
        if (
            again is not None
            and _mean_confidence(again) > _mean_confidence(landmarks)
            and _fits(again, tracked, is_observed)
        ):
            return again
        self._follower.resume(region)
        return landmarks

    def _find_suspects(self, record: _Record, row: int, box: PersonBox) -> list[int]:
        """Return the rows since the last agreement that don't fit where the person went."""
        if self._last_good is None:
            return []
        first, before = self._last_good
        return [
            r
            for r in range(first + 1, row)
            if not agrees_with_box(
                record.image[r],
                record.confidence[r],
                interpolate_box(before, box, (r - first) / (row - first)),
            )
        ]


def search_region(box: PersonBox, *, margin: float = SEARCH_MARGIN) -> Region:
    """Return the upright square around a person's box in which BlazePose starts.

    Box edges are px from the picture's border; the region counts from pixel centres.
    """
    return Region(
        (box.left + box.right - 1) / 2,
        (box.top + box.bottom - 1) / 2,
        max(box.size_px) * margin,
    )


def landmark_confidence(landmarks: Landmarks) -> Array:
    """Return the smaller of visibility and presence, shape (33,).

    Both must hold for a measured position; their product would count what they share twice.
    """
    return np.minimum(landmarks.visibility, landmarks.presence)


def _mean_confidence(landmarks: Landmarks) -> float:
    return float(landmark_confidence(landmarks).mean())


def _fits(landmarks: Landmarks, tracked: TrackedFrame, is_observed: bool) -> bool:
    assert tracked.box is not None
    return agrees_with_box(
        landmarks.image,
        landmark_confidence(landmarks),
        tracked.box,
        tracked.others,
        is_observed=is_observed,
    )


def _shown_box(box: PersonBox | None, points: Array, confidence: Array) -> Array:
    """Return the box of a frame: around the landmarks, which are newer than a predicted box."""
    if box is None:
        return np.full(4, np.nan)
    hull = bound_landmarks(points, confidence)
    if hull is None:
        return np.array([box.left, box.top, box.right, box.bottom])
    margin = BOX_MARGIN * float(max(hull[2:] - hull[:2]))
    return hull + margin * np.array([-1.0, -1.0, 1.0, 1.0])
