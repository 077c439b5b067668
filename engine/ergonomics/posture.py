"""What the posture methods look at: signals with errors, and states of the body, per frame.

The published sheets are filled in by an observer who says "twisted" or "abducted" without a
number. The numbers that stand for those words here are `THRESHOLDS`; they are kept with every
result. What no camera of this kind can see (wrists, a supported arm, a raised shoulder) is not in
the signals at all, and the methods say what they assume instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Literal

import numpy as np

from engine.datatypes import Array, JointAngles, PoseTrack, Task
from engine.ergonomics.base import Exposure
from engine.ergonomics.posture_bands import (
    BandRows,
    BoolArray,
    IntArray,
    exceeds,
    find_holds,
    score_bands,
)
from engine.skeletons import Skeleton, get_skeleton

__all__ = ["MIN_FRAMES_S", "THRESHOLDS", "Posture", "Signal", "Thresholds", "read_posture"]

Unit = Literal["deg", "m"]
SIDES = ("l", "r")
SIDE_NAMES: Mapping[str, str] = {"l": "left", "r": "right"}
MIN_FRAMES_S = 0.2
"""The trunk must be seen for this long altogether before any posture is scored."""


@dataclass(frozen=True)
class Thresholds:
    """Numbers for words that the published sheets leave to the observer's eye.

    Twist and side-bend follow what EN 1005-4 and ISO 11226 call clearly visible.
    """

    twist_deg: float = 10.0
    side_bend_deg: float = 10.0
    upright_deg: float = 5.0
    abduction_deg: float = 20.0
    one_leg_m: float = 0.10
    static_range_deg: float = 5.0
    static_s: float = 60.0
    repeated_per_min: float = 4.0
    hysteresis_deg: float = 2.0
    hysteresis_m: float = 0.02
    dwell_s: float = 0.2


THRESHOLDS = Thresholds()

STANDING_HIP_SHARE = 0.53
"""Height of the hips above the floor in standing, as a share of the stature (Winter 2009)."""
SEATED_HIP_SHARE = 0.75
"""Hips below this share of their standing height may be seated."""
SEATED_THIGH_DEG = 30.0
SEATED_SHANK_DEG = 20.0
SEATED_SPEED_M_S = 0.1
SEATED_S = 1.0
KNEELING_HEIGHT_M = 0.15
KNEELING_FLEXION_DEG = 70.0
WALKING_M_S = 0.35
WALKING_S = 0.5


@dataclass(frozen=True, eq=False)
class Signal:
    """One measured curve: value and standard error, shape (T,) each; NaN where missing.

    `is_unsigned` marks magnitudes: their error can't make them negative.
    """

    title: str
    value: Array
    sigma: Array
    unit: Unit = "deg"
    is_unsigned: bool = False

    @property
    def is_seen(self) -> BoolArray:
        """Shape (T,): whether there is a value."""
        return np.asarray(np.isfinite(self.value))

    def draw(self, normal: Array) -> Array:
        """Return the curve moved by its error as a whole, shape (T, N), for N normal deviates.

        The errors of a camera's scale, view and keypoints last for a whole clip; independent noise
        from frame to frame would average out of shares and pile up in maxima, both wrongly.
        """
        drawn = self.value[:, None] + np.nan_to_num(self.sigma)[:, None] * normal[None, :]
        return np.abs(drawn) if self.is_unsigned else drawn


@dataclass(frozen=True, eq=False)
class Posture:
    """A person's posture in every frame, and the work it belongs to.

    `time_s`, `step_s` (T,): when, and how long each frame stands for. States are (T,) each:
    `is_static` means that trunk, neck or an upper arm was held still for over a minute,
    `has_load` that the load is in the hands. `is_steady` asks for bands without flicker; drawn
    curves are read plainly, many times faster.
    """

    time_s: Array
    step_s: Array
    signals: Mapping[str, Signal]
    is_seated: BoolArray
    is_kneeling: BoolArray
    is_walking: BoolArray
    is_static: BoolArray
    has_load: BoolArray
    task: Task
    repeated_per_min: float
    notes: tuple[str, ...] = ()
    is_steady: bool = True

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return int(self.time_s.size)

    @property
    def duration_s(self) -> float:
        """How long the frames last together."""
        return float(self.step_s.sum())

    @property
    def is_repeated(self) -> bool:
        """Whether the work repeats itself more than four times a minute, as far as is known."""
        return self.repeated_per_min > THRESHOLDS.repeated_per_min

    def at(self, frame: int) -> Posture:
        """Return the posture of one frame alone."""
        part = slice(frame, frame + 1)
        signals = {
            name: replace(s, value=s.value[part], sigma=s.sigma[part])
            for name, s in self.signals.items()
        }
        states = ("is_seated", "is_kneeling", "is_walking", "is_static", "has_load")
        cut = {name: getattr(self, name)[part] for name in (*states, "time_s", "step_s")}
        return replace(self, signals=MappingProxyType(signals), **cut)

    def score_bands(self, value: Array, rows: BandRows) -> IntArray:
        """Look scores of an angle up in bands, shape (T, N); 0 where it is missing."""
        return score_bands(value, rows, self.time_s, **self._calming(THRESHOLDS.hysteresis_deg))

    def exceeds(self, value: Array, limit: float) -> BoolArray:
        """Tell where an angle lies above a limit, shape (T, N); false where it is missing."""
        return exceeds(value, limit, self.time_s, **self._calming(THRESHOLDS.hysteresis_deg))

    def exceeds_m(self, value: Array, limit_m: float) -> BoolArray:
        """Tell where a length lies above a limit, shape (T, N); false where it is missing."""
        return exceeds(value, limit_m, self.time_s, **self._calming(THRESHOLDS.hysteresis_m))

    def _calming(self, hysteresis: float) -> dict[str, float]:
        if not self.is_steady:
            return {}
        return {"hysteresis": hysteresis, "dwell_s": THRESHOLDS.dwell_s}

    def values(self) -> dict[str, Array]:
        """Return every signal as measured, shape (T, 1)."""
        return {name: signal.value[:, None] for name, signal in self.signals.items()}

    def draw(self, normal: Array) -> dict[str, Array]:
        """Return every signal moved by its error; `normal` is (N, number of signals)."""
        return {
            name: signal.draw(normal[:, k]) for k, (name, signal) in enumerate(self.signals.items())
        }


@lru_cache(maxsize=1)  # four methods ask for the same exposure, one after another
def read_posture(exposure: Exposure) -> Posture | None:
    """Collect what the posture methods need.

    Returns
    -------
    Posture or None
        None where the trunk was seen for less than `MIN_FRAMES_S`: nothing can be scored.
    """
    angles, track = exposure.angles, exposure.track
    time_s = angles.time_s
    step_s = _frame_steps(time_s)
    signals = {**_angle_signals(angles), **_track_signals(track, time_s)}
    if float(step_s[signals["trunk_flexion"].is_seen].sum()) < MIN_FRAMES_S - 1e-9:
        return None
    notes: list[str] = []
    points = _Points(track, time_s)
    is_seated = points.find_seated(exposure.subject.stature.value)
    if "seated" in exposure.conditions:
        is_seated = np.ones(time_s.size, dtype=bool)
    return Posture(
        time_s=time_s,
        step_s=step_s,
        signals=MappingProxyType(signals),
        is_seated=is_seated,
        is_kneeling=points.find_kneeling(signals),
        is_walking=points.find_walking(),
        is_static=_find_static(signals, time_s),
        has_load=_find_load(exposure, time_s, notes),
        task=exposure.task,
        repeated_per_min=_read_repetition(exposure),
        notes=tuple(notes),
    )


def _frame_steps(time_s: Array) -> Array:
    """Return how long each frame stands for, s; the last as long as usual."""
    if time_s.size < 2:
        return np.zeros(time_s.size)
    steps = np.diff(time_s)
    return np.append(steps, np.median(steps))


# --------------------------------------------------------------------------- signals


def _curve(angles: JointAngles, name: str) -> tuple[Array, Array]:
    if name not in angles.names:
        missing = np.full(angles.time_s.size, np.nan)
        return missing, missing
    return np.array(angles[name]), np.array(angles.sigma(name))


def _fill_sigma(sigma: Array, value: Array) -> Array:
    """Give samples without a known error the usual one of their curve."""
    known = sigma[np.isfinite(sigma) & np.isfinite(value)]
    usual = float(np.median(known)) if known.size else math.nan
    return np.where(np.isfinite(sigma), sigma, usual)


def _signal(title: str, value: Array, sigma: Array, *, is_unsigned: bool = False) -> Signal:
    return Signal(title, value, _fill_sigma(sigma, value), is_unsigned=is_unsigned)


def _angle_signals(angles: JointAngles) -> dict[str, Signal]:
    flexion, flexion_sigma = _curve(angles, "trunk_flexion")
    inclination, inclination_sigma = _curve(angles, "trunk_inclination")
    # Without a heading the direction of the bend is unknown; forward is taken, its usual one.
    is_open = np.isnan(flexion)
    flexion = np.where(is_open, inclination, flexion)
    flexion_sigma = np.where(is_open, inclination_sigma, flexion_sigma)
    neck, neck_sigma = _curve(angles, "neck_flexion")
    found = {
        "trunk_flexion": _signal("trunk flexion", flexion, flexion_sigma),
        "trunk_lateral_bend": _signal("trunk side-bend", *_curve(angles, "trunk_lateral_bend")),
        "trunk_twist": _signal("trunk twist", *_curve(angles, "trunk_twist")),
        "neck_flexion": _signal("neck flexion", neck, neck_sigma),
        "head_inclination": _signal(
            "head inclination", flexion + neck, np.hypot(flexion_sigma, neck_sigma)
        ),
    }
    for side in SIDES:
        found |= _limb_signals(angles, side)
    return found


def _limb_signals(angles: JointAngles, side: str) -> dict[str, Signal]:
    where = SIDE_NAMES[side]
    flexion, sigma = _curve(angles, f"shoulder_flexion_{side}")
    adduction, adduction_sigma = _curve(angles, f"shoulder_adduction_{side}")
    # Straight out to the side an arm has no flexion, yet it is raised: its elevation stands in.
    is_open = np.isnan(flexion) & np.isfinite(adduction)
    flexion = np.where(is_open, np.abs(adduction), flexion)
    sigma = np.where(is_open, adduction_sigma, sigma)
    knee, elbow = (_curve(angles, f"{part}_flexion_{side}") for part in ("knee", "elbow"))
    return {
        f"knee_flexion_{side}": _signal(f"{where} knee flexion", *knee, is_unsigned=True),
        f"shoulder_flexion_{side}": _signal(f"{where} upper-arm flexion", flexion, sigma),
        f"shoulder_abduction_{side}": _signal(
            f"{where} upper-arm abduction", -adduction, adduction_sigma
        ),
        f"elbow_flexion_{side}": _signal(f"{where} elbow flexion", *elbow, is_unsigned=True),
    }


def _track_signals(track: PoseTrack, time_s: Array) -> dict[str, Signal]:
    points = _Points(track, time_s)
    found = {}
    for side, where in SIDE_NAMES.items():
        arm, sigma_m = points.segment(f"{where}_shoulder", f"{where}_elbow")
        length = np.linalg.norm(arm, axis=1)
        horizontal = np.hypot(arm[:, 0], arm[:, 2])
        elevation = np.where(length > 0, np.degrees(np.arctan2(horizontal, -arm[:, 1])), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma_deg = np.degrees(np.minimum(sigma_m / length, 1.0))
        found[f"arm_elevation_{side}"] = _signal(
            f"{where} upper-arm elevation", elevation, sigma_deg, is_unsigned=True
        )
        found[f"elbow_height_{side}"] = Signal(
            f"{where} elbow above the shoulder", arm[:, 1], _fill_sigma(sigma_m, arm[:, 1]), "m"
        )
    lift, lift_sigma = points.segment("right_ankle", "left_ankle")
    found["ankle_difference"] = Signal(
        "left ankle above the right", lift[:, 1], _fill_sigma(lift_sigma, lift[:, 1]), "m"
    )
    return found


# --------------------------------------------------------------------------- states


class _Points:
    """Keypoints of a track by name, at the times of the angles."""

    def __init__(self, track: PoseTrack, time_s: Array) -> None:
        self.skeleton: Skeleton = get_skeleton(track.skeleton)
        self.time_s = time_s
        # Angles of one trial come from its track, frame by frame.
        fits = track.position.shape[0] == time_s.size and track.position.shape[2] == 3
        shape = (time_s.size, len(self.skeleton.keypoints))
        self.position = np.asarray(track.position) if fits else np.full((*shape, 3), np.nan)
        self.sigma = np.asarray(track.sigma) if fits else np.full(shape, np.nan)

    def point(self, name: str) -> Array:
        """Return one point, shape (T, 3); NaN if the skeleton has it not."""
        if not self.skeleton.has(name):
            return np.full((self.time_s.size, 3), np.nan)
        return self.skeleton.point(self.position, name)

    def segment(self, start: str, end: str) -> tuple[Array, Array]:
        """Return the vector between two keypoints and its standard error per coordinate, m."""
        vector = self.point(end) - self.point(start)
        sigma = [
            self.sigma[:, self.skeleton.index(name)]
            if name in self.skeleton.keypoints
            else np.full(self.time_s.size, np.nan)
            for name in (start, end)
        ]
        return vector, np.hypot(*sigma)

    def speed(self, name: str, span_s: float) -> Array:
        """Return the mean horizontal speed over `span_s` around each frame, m/s."""
        ground = self.point(name)[:, [0, 2]]
        if self.time_s.size < 2:
            return np.full(self.time_s.size, np.nan)
        half = max(1, round(span_s / 2 / float(np.median(np.diff(self.time_s)))))
        frames = np.arange(self.time_s.size)
        before, after = np.maximum(frames - half, 0), np.minimum(frames + half, frames[-1])
        way = np.linalg.norm(ground[after] - ground[before], axis=1)
        return np.asarray(way / (self.time_s[after] - self.time_s[before]))

    def find_walking(self) -> BoolArray:
        """Mark frames in which hips and feet travel; hips alone travel in every bend."""
        speeds = [self.speed(name, WALKING_S) for name in ("pelvis", "mid_ankle")]
        return np.asarray(np.nan_to_num(np.min(speeds, axis=0)) > WALKING_M_S)

    def find_kneeling(self, signals: Mapping[str, Signal]) -> BoolArray:
        """Mark frames with a bent knee on the floor."""
        found = np.zeros(self.time_s.size, dtype=bool)
        for side, where in SIDE_NAMES.items():
            height = np.nan_to_num(self.point(f"{where}_knee")[:, 1], nan=np.inf)
            bent = np.nan_to_num(signals[f"knee_flexion_{side}"].value) > KNEELING_FLEXION_DEG
            found |= (height < KNEELING_HEIGHT_M) & bent
        return found

    def find_seated(self, stature_m: float) -> BoolArray:
        """Mark frames of sitting: hips low, thighs level, ankles under the knees, hips at rest."""
        pelvis = self.point("pelvis")
        low = pelvis[:, 1] < SEATED_HIP_SHARE * STANDING_HIP_SHARE * stature_m
        sits = low & (self.speed("pelvis", SEATED_S) < SEATED_SPEED_M_S)
        for where in SIDE_NAMES.values():
            thigh, _ = self.segment(f"{where}_hip", f"{where}_knee")
            shank, _ = self.segment(f"{where}_knee", f"{where}_ankle")
            sits &= _tilt_deg(thigh) > 90.0 - SEATED_THIGH_DEG
            sits &= _tilt_deg(shank) < SEATED_SHANK_DEG
        return _keep_long(sits, self.time_s, SEATED_S)


def _tilt_deg(vector: Array) -> Array:
    """Return the angle of a vector with the vertical, 0 to 90 degrees."""
    return np.asarray(
        np.degrees(np.arctan2(np.hypot(vector[:, 0], vector[:, 2]), np.abs(vector[:, 1])))
    )


def _keep_long(state: BoolArray, time_s: Array, least_s: float) -> BoolArray:
    """Keep the stretches of a state, shape (T,), that last at least so long."""
    return find_holds(np.where(state, 0.0, np.nan), time_s, half_width=1.0, hold_s=least_s)


def _find_static(signals: Mapping[str, Signal], time_s: Array) -> BoolArray:
    names = ("trunk_flexion", "neck_flexion", "shoulder_flexion_l", "shoulder_flexion_r")
    held = [
        find_holds(
            signals[name].value,
            time_s,
            half_width=THRESHOLDS.static_range_deg,
            hold_s=THRESHOLDS.static_s,
        )
        for name in names
    ]
    return np.asarray(np.any(held, axis=0))


def _find_load(exposure: Exposure, time_s: Array, notes: list[str]) -> BoolArray:
    """Mark frames with the load in the hands: from lift-off to set-down of every lift."""
    if exposure.lifts:
        held = [(lift.start_s <= time_s) & (time_s <= lift.end_s) for lift in exposure.lifts]
        return np.asarray(np.any(held, axis=0))
    if exposure.task.load_kg:
        notes.append("No lift was found, so the load counts as held all the time.")
        return np.ones(time_s.size, dtype=bool)
    return np.zeros(time_s.size, dtype=bool)


COUNTED_AFTER_S = 60.0
"""A rate is counted in the video only if it shows at least so much of the work."""


def _read_repetition(exposure: Exposure) -> float:
    """Return how often a minute the work repeats itself; NaN where nobody knows."""
    given = exposure.task.frequency_per_min
    if given is not None:
        return given
    if exposure.observed_s >= COUNTED_AFTER_S and exposure.lifts:
        return 60.0 * len(exposure.lifts) / exposure.observed_s
    return math.nan
