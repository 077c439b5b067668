"""The immutable types that flow from step to step.

Every array is copied in, checked and made read-only; a change is a new object
(`dataclasses.replace`). NaN means missing. World coordinates are right-handed,
in metres, Y up, floor at y = 0, X to the subject's front and Z to the subject's
right at the start of the trial. Angles are degrees, times seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum, StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from engine.errors import ConfigError, DataError, ShapeError, UnitError

__all__ = [
    "Array",
    "BodyFit",
    "Calibration",
    "CalibrationCheck",
    "Camera",
    "CheckLevel",
    "Coupling",
    "Flag",
    "FlagLevel",
    "Frame",
    "JointAngles",
    "KinematicFit",
    "Lift",
    "LiftEnd",
    "Measurement",
    "PersonBox",
    "PoseTrack",
    "ProgressCallback",
    "Provenance",
    "RiskInput",
    "RiskResult",
    "Sex",
    "Status",
    "Subject",
    "SubjectState",
    "SyncEstimate",
    "Task",
    "TrackedFrame",
    "Trial",
    "TrialResult",
    "View",
    "ViewInfo",
    "ViewPose",
    "WorldScene",
    "ignore_progress",
]

Array = NDArray[np.float64]
ProgressCallback = Callable[[str, int, int], None]
"""Called as ``progress(stage, done, total)``; may raise `Cancelled`. A total of 0 means unknown."""

Sex = Literal["female", "male"]
PositionUnit = Literal["px", "m"]
FrameOfReference = Literal["image", "body", "camera", "world"]

STATURE_M = (1.0, 2.3)
"""Statures accepted, in metres."""
ASSUMED_STATURE_M = 1.70
"""Used when the stature is unknown; the SD below is that of adults of both sexes together."""
ASSUMED_STATURE_SIGMA_M = 0.10
STATED_STATURE_SIGMA_M = 0.01


def ignore_progress(_stage: str, _done: int, _total: int) -> None:
    """Report progress to nobody."""


class Provenance(StrEnum):
    """Where a value comes from, best first."""

    MEASURED = "measured"
    USER = "user"
    DERIVED = "derived"
    ASSUMED = "assumed"


class Coupling(StrEnum):
    """Quality of the grip, as in the Revised NIOSH Lifting Equation."""

    GOOD = "good"
    FAIR = "fair"
    POOR = "poor"


class Status(IntEnum):
    """What happened to one sample."""

    MISSING = 0
    MEASURED = 1
    REPAIRED = 2
    REJECTED = 3
    FILLED = 4
    SMOOTHED = 5


class SubjectState(StrEnum):
    """How the box of the followed person was found in a frame."""

    INIT = "init"
    TRACKED = "tracked"
    HELD = "held"
    LOST = "lost"


class CheckLevel(StrEnum):
    """Whether something may be trusted: as it is, with care, or not at all."""

    GREEN = "green"
    AMBER = "amber"
    RED = "red"


class FlagLevel(StrEnum):
    """How urgently a person should look at something."""

    OK = "ok"
    REVIEW = "review"
    HIGH = "high"


def frozen_array(values: ArrayLike, dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Copy `values` into a read-only array."""
    array = np.array(values, dtype=dtype, copy=True)
    array.setflags(write=False)
    return array


class _FrozenArrays:
    """Keeps the arrays of a frozen dataclass read-only, through pickling too."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Unpickling rebuilds arrays writeable and can't rebuild mapping proxies.
        for name, value in state.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, name, _proxy(value) if isinstance(value, dict) else value)

    def __getstate__(self) -> dict[str, Any]:
        own = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return {k: dict(v) if isinstance(v, MappingProxyType) else v for k, v in own.items()}

    def _freeze(self, name: str, values: ArrayLike, dtype: DTypeLike = np.float64) -> NDArray[Any]:
        array = frozen_array(values, dtype)
        object.__setattr__(self, name, array)
        return array


def _proxy(mapping: Mapping[str, Any]) -> Mapping[str, Any]:
    return MappingProxyType(dict(mapping))


def _require_shape(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ShapeError(f"{name} needs shape {shape}, got {array.shape}.")


def _require_times(time_s: Array) -> None:
    if time_s.ndim != 1:
        raise ShapeError(f"time_s needs one dimension, got shape {time_s.shape}.")
    if time_s.size > 1 and not np.all(np.diff(time_s) > 0):
        raise DataError("time_s must increase from frame to frame, but it does not.")


def _hint_stature(stature: float | None) -> str:
    """Return what to do about a stature in the wrong unit or with a slipped point."""
    units = {"centimetres": 0.01, "millimetres": 0.001, "decimetres": 0.1, "feet": 0.3048}
    for unit, in_metres in units.items():
        if stature is not None and STATURE_M[0] <= stature * in_metres <= STATURE_M[1]:
            return f"It looks like {unit}: did you mean {stature * in_metres:.2f} metres?"
    return "Give the stature in metres, for example 1.75."


def _require_range(
    name: str, value: float | None, low: float, high: float, unit: str, hint: str = ""
) -> None:
    if value is None:
        return
    if not math.isfinite(value) or not low <= value <= high:
        tail = f" {hint}" if hint else ""
        raise ConfigError(
            f"{name} must lie between {low:g} and {high:g} {unit}, got {value:g}.{tail}".replace(
                " .", "."
            )
        )


@dataclass(frozen=True)
class Measurement:
    """A value with its standard error.

    `value` is NaN when it could not be measured; `sigma` is one standard error
    in the same unit.
    """

    value: float
    sigma: float = math.nan

    @property
    def is_missing(self) -> bool:
        """Whether there is no value."""
        return math.isnan(self.value)

    def interval(self, coverage_factor: float = 1.96) -> tuple[float, float]:
        """Return the interval of about 95 % (by default) around the value."""
        half = coverage_factor * self.sigma
        return self.value - half, self.value + half


@dataclass(frozen=True)
class Subject:
    """The person filmed, under a pseudonym.

    Anything but the stature is optional. A missing stature is replaced by
    `ASSUMED_STATURE_M` in `stature`, with a wide error and provenance `assumed`.
    """

    label: str = "subject"
    stature_m: float | None = None
    mass_kg: float | None = None
    sex: Sex | None = None
    age_y: float | None = None

    def __post_init__(self) -> None:
        _require_range("Stature", self.stature_m, *STATURE_M, "m", _hint_stature(self.stature_m))
        _require_range("Body mass", self.mass_kg, 25.0, 300.0, "kg", "Leave it out if unknown.")
        _require_range("Age", self.age_y, 10.0, 100.0, "years", "Leave it out if unknown.")
        if self.sex not in (None, "female", "male"):
            raise ConfigError(f"Sex must be 'female' or 'male', or left out; got {self.sex!r}.")

    @property
    def stature(self) -> Measurement:
        """Stature in metres with its standard error."""
        if self.stature_m is None:
            return Measurement(ASSUMED_STATURE_M, ASSUMED_STATURE_SIGMA_M)
        return Measurement(self.stature_m, STATED_STATURE_SIGMA_M)

    @property
    def provenance(self) -> Mapping[str, Provenance | None]:
        """Where each property comes from; None where it is neither given nor assumed."""
        given = {
            name: None if getattr(self, name) is None else Provenance.USER
            for name in ("stature_m", "mass_kg", "sex", "age_y")
        }
        given["stature_m"] = given["stature_m"] or Provenance.ASSUMED
        return given


@dataclass(frozen=True)
class Task:
    """What a camera can't see about the work.

    `coupling`, `frequency_per_min` and `duration_h` may be None: the methods then use a
    stated assumption and say so. `recovery_h` is the time of light work that
    follows the lifting. `destination_control` says whether the load must be placed with
    care (significant control); None means unknown.
    """

    load_kg: float | None = None
    hands: Literal[1, 2] | None = None
    coupling: Coupling | None = None
    frequency_per_min: float | None = None
    duration_h: float | None = None
    recovery_h: float | None = None
    destination_control: bool | None = None
    notes: str = ""

    def __post_init__(self) -> None:
        hint = "Correct it, or leave it out if unknown."
        _require_range("Load", self.load_kg, 0.0, 500.0, "kg", hint)
        _require_range(
            "Lifting frequency", self.frequency_per_min, 0.0, 60.0, "lifts per minute", hint
        )
        _require_range("Duration", self.duration_h, 0.0, 24.0, "hours", hint)
        _require_range("Recovery", self.recovery_h, 0.0, 24.0, "hours", hint)
        if self.hands not in (None, 1, 2):
            raise ConfigError(f"Hands must be 1 or 2, got {self.hands!r}.")
        if self.coupling is not None:
            object.__setattr__(self, "coupling", parse_coupling(self.coupling))


def parse_coupling(text: str) -> Coupling:
    """Turn a word into a `Coupling`.

    Raises
    ------
    ConfigError
        If the word is none of good, fair, poor.
    """
    try:
        return Coupling(str(text).strip().lower())
    except ValueError:
        raise ConfigError(f"Coupling must be good, fair or poor, got {text!r}.") from None


@dataclass(frozen=True, eq=False)
class Camera(_FrozenArrays):
    """A pin-hole camera with lens distortion.

    ``x = matrix @ (rotation @ X + translation)``, OpenCV's axes (x right, y down,
    z forward) and distortion coefficients (k1, k2, p1, p2, k3); translation in metres.
    """

    name: str
    size_px: tuple[int, int]
    matrix: Array
    rotation: Array = field(default_factory=lambda: np.eye(3))
    translation: Array = field(default_factory=lambda: np.zeros(3))
    distortion: Array = field(default_factory=lambda: np.zeros(5))

    def __post_init__(self) -> None:
        _require_shape("Camera matrix", self._freeze("matrix", self.matrix), (3, 3))
        _require_shape("Camera rotation", self._freeze("rotation", self.rotation), (3, 3))
        _require_shape("Camera translation", self._freeze("translation", self.translation), (3,))
        _require_shape("Distortion", self._freeze("distortion", self.distortion), (5,))
        if np.linalg.norm(self.rotation @ self.rotation.T - np.eye(3)) > 1e-3:
            raise DataError(f"The rotation of camera {self.name!r} is not a rotation matrix.")


@dataclass(frozen=True, eq=False)
class Calibration(_FrozenArrays):
    """Cameras in one world in metres, with what is not known of them.

    Parameters
    ----------
    cameras
        In the order of the views.
    source
        Where they come from: `board`, `points`, `person`, or `file`.
    up
        Shape (3,), the unit vector against gravity in the world of the cameras; NaN where the
        source does not tell.
    floor_m
        Height of the floor along `up` from the world's origin; NaN where unknown.
    scale_sigma
        Relative standard error of all lengths.
    rotation_sigma_deg, translation_sigma_m
        Standard errors of the cameras relative to each other, root mean square over the axes.
    tilt_sigma_deg, floor_sigma_m
        Standard errors of `up` and of the floor.
    provenance
        How it was found, in words or plain values (reprojection error in px, samples, file).
    """

    cameras: tuple[Camera, ...]
    source: str
    up: Array = field(default_factory=lambda: np.full(3, np.nan))
    floor_m: float = math.nan
    scale_sigma: float = math.nan
    rotation_sigma_deg: float = math.nan
    translation_sigma_m: float = math.nan
    tilt_sigma_deg: float = math.nan
    floor_sigma_m: float = math.nan
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _require_shape("up", self._freeze("up", self.up), (3,))
        object.__setattr__(self, "cameras", tuple(self.cameras))
        object.__setattr__(self, "provenance", _proxy(self.provenance))


@dataclass(frozen=True)
class CalibrationCheck:
    """One comparison of a calibration with the world.

    `key` names it (for example `floor`), `sentence` says what was found in plain words with
    numbers and units, `action` what to do about it. `value` is in `unit`.
    """

    key: str
    level: CheckLevel
    sentence: str
    action: str = ""
    value: float = math.nan
    unit: str = ""


@dataclass(frozen=True)
class SyncEstimate:
    """How the clocks of two videos belong together.

    A moment at `t` seconds in the second video is at ``t * (1 + drift) + offset_s`` in the first.
    `method` is `motion`, `audio`, `both` or `user`; `confidence` runs from 0 to 1. `level` is red
    where the estimate must not be used, and `sentence` says why and what to do.
    """

    offset_s: float
    sigma_s: float = math.nan
    drift: float = 0.0
    confidence: float = math.nan
    method: str = "user"
    level: CheckLevel = CheckLevel.GREEN
    sentence: str = ""


@dataclass(frozen=True, eq=False)
class View:
    """One video of a trial."""

    path: Path
    camera: Camera | None = None
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))


@dataclass(frozen=True)
class ViewInfo:
    """What a video file says about itself.

    `size_px` is (width, height) as shown, after rotation. `fps` is the mean rate of
    the true time stamps; `n_frames` is exact once the file was read to its end.
    `n_missing_frames` were announced but are not in the file: it was cut off.
    """

    file_name: str
    sha256: str
    fps: float
    n_frames: int
    size_px: tuple[int, int]
    duration_s: float
    codec: str = ""
    rotation_deg: int = 0
    is_variable_rate: bool = False
    n_missing_frames: int = 0


@dataclass(frozen=True, eq=False)
class Trial:
    """One or two views of one person at one task."""

    views: tuple[View, ...]
    subject: Subject = field(default_factory=Subject)
    task: Task = field(default_factory=Task)
    label: str = ""
    site: str = ""
    job: str = ""

    def __post_init__(self) -> None:
        if len(self.views) not in (1, 2):
            raise ConfigError(f"A trial has one or two views, got {len(self.views)}.")


@dataclass(frozen=True, eq=False)
class Frame:
    """One decoded picture: `image` (H, W, 3) uint8 RGB, upright, at `time_s`.

    The image array is not copied; treat it as read-only.
    """

    index: int
    time_s: float
    image: NDArray[np.uint8]


@dataclass(frozen=True)
class PersonBox:
    """The followed person's box in one frame: left, top, right, bottom in px."""

    left: float
    top: float
    right: float
    bottom: float
    confidence: float = math.nan
    iou: float = math.nan
    state: SubjectState = SubjectState.TRACKED

    @property
    def size_px(self) -> tuple[float, float]:
        """Width and height."""
        return self.right - self.left, self.bottom - self.top


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame with the box of the person to measure; no box while the person is lost.

    `is_anchor` is true when the person detector looked at this very frame (the box is
    then an observation, not a prediction); `others` are the other persons it saw.
    """

    frame: Frame
    box: PersonBox | None
    is_anchor: bool = False
    others: tuple[PersonBox, ...] = ()


FrameStream = Iterator[Frame]
TrackedStream = Iterator[TrackedFrame]


@dataclass(frozen=True, eq=False)
class PoseTrack(_FrozenArrays):
    """Keypoints of one person over time.

    Parameters
    ----------
    time_s
        Shape (T,), increasing.
    position
        Shape (T, K, D) with D = 2 or 3; NaN where missing.
    unit, frame_of_reference
        `px` in the image, or `m` in the body (origin mid-hip, camera axes), camera or world frame.
    skeleton
        Name of a skeleton in `engine.skeletons`.
    confidence
        Shape (T, K), 0 to 1; NaN where unknown.
    sigma
        Shape (T, K), standard error per coordinate in the same unit; NaN where unknown.
    status
        Shape (T, K), values of `Status`; by default measured where a position exists.
    provenance
        How the track came to be, in words or plain values.
    """

    time_s: Array
    position: Array
    unit: PositionUnit
    frame_of_reference: FrameOfReference
    skeleton: str
    # None means "not given"; __post_init__ replaces it, so readers always find an array.
    confidence: Array = None  # type: ignore[assignment]
    sigma: Array = None  # type: ignore[assignment]
    status: NDArray[np.uint8] = None  # type: ignore[assignment]
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _require_times(self._freeze("time_s", self.time_s))
        position = self._freeze("position", self.position)
        if position.ndim != 3 or position.shape[2] not in (2, 3):
            raise ShapeError(f"position needs shape (T, K, 2 or 3), got {position.shape}.")
        if position.shape[0] != self.time_s.shape[0]:
            raise ShapeError(
                f"position has {position.shape[0]} frames, time_s has {self.time_s.shape[0]}."
            )
        if (self.unit == "px") != (self.frame_of_reference == "image"):
            raise UnitError(
                f"Unit {self.unit} does not go with the {self.frame_of_reference} frame."
            )
        samples = position.shape[:2]
        present = np.isfinite(position).all(axis=2)
        default_status = np.where(present, Status.MEASURED, Status.MISSING)
        for name, default, dtype in (
            ("confidence", np.full(samples, np.nan), np.float64),
            ("sigma", np.full(samples, np.nan), np.float64),
            ("status", default_status, np.uint8),
        ):
            given = getattr(self, name)
            _require_shape(
                name, self._freeze(name, default if given is None else given, dtype), samples
            )
        object.__setattr__(self, "provenance", _proxy(self.provenance))

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return int(self.time_s.shape[0])

    @property
    def is_present(self) -> NDArray[np.bool_]:
        """Shape (T, K): whether a position exists."""
        return np.asarray(np.isfinite(self.position).all(axis=2))


@dataclass(frozen=True, eq=False)
class ViewPose(_FrozenArrays):
    """What an estimator saw in one view.

    `image` is the track in px; `body` the same keypoints in metres around the mid-hip,
    in the camera's axes (x right, y down, z away), where the estimator gives it.
    `box` is (T, 4) left, top, right, bottom in px, NaN while lost; `state` one
    `SubjectState` per frame. `others` are the boxes of other persons, per frame (needed
    to blur their heads; empty where nobody looked). `model_time_s` is the time spent inside
    the neural networks.
    """

    image: PoseTrack
    body: PoseTrack | None
    box: Array
    state: tuple[SubjectState, ...]
    info: ViewInfo
    others: tuple[tuple[PersonBox, ...], ...] = ()
    model_time_s: float = 0.0

    def __post_init__(self) -> None:
        _require_shape("box", self._freeze("box", self.box), (self.image.n_frames, 4))
        if len(self.state) != self.image.n_frames:
            raise ShapeError(f"state needs {self.image.n_frames} entries, got {len(self.state)}.")


@dataclass(frozen=True, eq=False)
class WorldScene:
    """How a view was placed in the world, with what is not known about it.

    `camera` is the (assumed or calibrated) camera in world coordinates. Standard errors:
    `scale` relative (0.02 = 2 %), `tilt_deg` of the gravity direction, `heading_deg` of the
    forward direction, `floor_m` of the floor height; `plane_m` and `depth_m` of a well visible
    keypoint across and along the line of sight.
    """

    camera: Camera
    scale_sigma: float
    tilt_sigma_deg: float
    heading_sigma_deg: float
    floor_sigma_m: float
    view_azimuth_deg: float
    plane_sigma_m: float = math.nan
    depth_sigma_m: float = math.nan
    provenance: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class JointAngles(_FrozenArrays):
    """Joint angles over time, in degrees, named as in `engine.kinematics.angles`.

    `value_deg`, `sigma_deg`, `status`: shape (T, A); NaN where an angle is missing or can't be
    observed.
    """

    time_s: Array
    value_deg: Array
    names: tuple[str, ...]
    # As in PoseTrack: never None once built.
    sigma_deg: Array = None  # type: ignore[assignment]
    status: NDArray[np.uint8] = None  # type: ignore[assignment]
    convention: str = "liftlens-1"

    def __post_init__(self) -> None:
        _require_times(self._freeze("time_s", self.time_s))
        shape = (self.time_s.shape[0], len(self.names))
        value = self._freeze("value_deg", self.value_deg)
        _require_shape("value_deg", value, shape)
        sigma = np.full(shape, np.nan) if self.sigma_deg is None else self.sigma_deg
        _require_shape("sigma_deg", self._freeze("sigma_deg", sigma), shape)
        found = np.where(np.isfinite(value), Status.MEASURED, Status.MISSING)
        status = found if self.status is None else self.status
        _require_shape("status", self._freeze("status", status, np.uint8), shape)

    def __getitem__(self, name: str) -> Array:
        """Return the curve of one angle, shape (T,), degrees."""
        return self.value_deg[:, self._column(name)]

    def sigma(self, name: str) -> Array:
        """Return the standard error of one angle, shape (T,), degrees."""
        return self.sigma_deg[:, self._column(name)]

    def _column(self, name: str) -> int:
        if name not in self.names:
            raise DataError(f"There is no angle {name!r} here; known: {', '.join(self.names)}.")
        return self.names.index(name)


@dataclass(frozen=True, eq=False)
class BodyFit(_FrozenArrays):
    """A body model of constant segment lengths, fitted to a track.

    `joints` are the model's joints in world metres, with the track's times and skeleton; NaN for
    keypoints the model has not, and in frames that were not fitted. `residual_m` (T,) is
    the mean distance of the track's keypoints from them, NaN where nothing was fitted.
    """

    joints: PoseTrack
    residual_m: Array
    segment_lengths_m: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        residual = self._freeze("residual_m", self.residual_m)
        _require_shape("residual_m", residual, (self.joints.n_frames,))
        object.__setattr__(self, "segment_lengths_m", _proxy(self.segment_lengths_m))


@dataclass(frozen=True, eq=False)
class KinematicFit:
    """What a solver makes of a track: the joint angles, and the body model where it uses one.

    `warnings` say in plain words what makes the angles less certain or why some are missing.
    """

    angles: JointAngles
    body: BodyFit | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class LiftEnd:
    """Where the hands are at one end of a lift, relative to the feet.

    `H_cm` horizontal distance mid-ankle to mid-hands, `V_cm` height of the hands above the
    floor, `A_deg` asymmetry angle (0 = straight ahead, unsigned).
    """

    time_s: float
    H_cm: Measurement
    V_cm: Measurement
    A_deg: Measurement


@dataclass(frozen=True)
class Lift:
    """One lift (or lowering) from lift-off to set-down.

    `start_s` is the lift-off (the load starts to move), `end_s` the set-down (it stops).
    `reach_start_s` and `return_end_s` bound the whole movement, bending and rising included.
    """

    start_s: float
    end_s: float
    origin: LiftEnd
    destination: LiftEnd
    D_cm: Measurement
    peak_hand_speed_m_s: float = math.nan
    peak_trunk_velocity_deg_s: float = math.nan
    hands: Literal[1, 2] = 2
    reach_start_s: float = math.nan
    return_end_s: float = math.nan
    start_sigma_s: float = math.nan
    end_sigma_s: float = math.nan
    notes: tuple[str, ...] = ()

    @property
    def duration_s(self) -> float:
        """Time from lift-off to set-down."""
        return self.end_s - self.start_s


@dataclass(frozen=True)
class RiskInput:
    """One input of a risk method, with unit and provenance."""

    name: str
    value: float | str | bool | None
    unit: str
    provenance: Provenance
    sigma: float = math.nan


@dataclass(frozen=True)
class RiskResult:
    """What one risk method says about one lift or one trial.

    Parameters
    ----------
    method
        Key of the method, for example `rnle`.
    value
        The headline number (for RNLE the lifting index); NaN when not applicable, may be infinite.
    category
        The method's own word for the level, or `not applicable`.
    inputs
        What went in.
    steps
        The worked calculation, one line a step.
    interval
        About 95 % interval of the value from the errors of the inputs.
    reference
        The publication, with table or section.
    is_applicable
        Whether the method may be used here at all.
    reasons
        Why it may not, or what to keep in mind.
    details
        Further numbers of the method (for RNLE: RWL and multipliers at both ends).
    lift_index
        Which lift of the trial, from 0; None for the whole trial.
    per_lift
        The result of every lift, where the method looks at lifts; the headline is then the worst.
    """

    method: str
    value: float
    category: str
    unit: str = ""
    inputs: tuple[RiskInput, ...] = ()
    steps: tuple[str, ...] = ()
    interval: tuple[float, float] = (math.nan, math.nan)
    reference: str = ""
    is_applicable: bool = True
    reasons: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    lift_index: int | None = None
    per_lift: tuple[RiskResult, ...] = ()


@dataclass(frozen=True)
class Flag:
    """One thing a person should look at, or the statement that a check found nothing."""

    level: FlagLevel
    what: str
    why: str
    method: str
    start_s: float = math.nan
    end_s: float = math.nan
    change: str = ""
    lift_index: int | None = None


@dataclass(frozen=True, eq=False)
class TrialResult:
    """Everything that was found out about one trial.

    `raw` and `corrected` hold the world track before and after correction; `views` what
    the estimator saw, in each video's own time. `risk` maps a method's key to its result. `body` is
    the fitted body model, None where the solver uses none. With two views, `calibration` are
    the cameras in the trial's world, `checks` what the world says of them, and `sync` the time
    between the videos.
    """

    trial: Trial
    views: tuple[ViewPose, ...]
    raw: PoseTrack
    corrected: PoseTrack
    scene: WorldScene
    angles: JointAngles
    lifts: tuple[Lift, ...]
    risk: Mapping[str, RiskResult]
    flags: tuple[Flag, ...]
    warnings: tuple[str, ...]
    config: Mapping[str, Any]
    backend: str
    solver: str
    versions: Mapping[str, str]
    timings_s: Mapping[str, float]
    coverage: Mapping[str, float]
    body: BodyFit | None = None
    calibration: Calibration | None = None
    checks: tuple[CalibrationCheck, ...] = ()
    sync: SyncEstimate | None = None
