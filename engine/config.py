"""Settings: one frozen dataclass per step, read from TOML.

Defaults live here and nowhere else. An unknown key is a `ConfigError`. The whole
configuration is stored with every result.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from engine.errors import ConfigError

__all__ = [
    "CameraConfig",
    "Config",
    "CorrectionConfig",
    "EventsConfig",
    "OutputConfig",
    "PoseConfig",
    "RiskConfig",
    "SubjectConfig",
    "TwoViewConfig",
    "VideoConfig",
    "build_config",
    "build_section",
    "read_config",
]


T = TypeVar("T")
_WORDS = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}


def _require_between(low: float, high: float, **values: float) -> None:
    """Refuse settings outside their range; NaN and infinity are outside every range."""
    for name, value in values.items():
        if not (math.isfinite(value) and low <= value <= high):
            upper = f"lie between {low:g} and {high:g}" if math.isfinite(high) else ""
            raise ConfigError(
                f"The setting {name} must {upper or f'be at least {low:g}'}, got {value:g}."
            )


@dataclass(frozen=True)
class VideoConfig:
    """Which part of the video is read.

    `start_s` and `stop_s` select a part; None means to the end.
    """

    start_s: float = 0.0
    stop_s: float | None = None

    def __post_init__(self) -> None:
        _require_between(0.0, math.inf, start_s=self.start_s)
        if self.stop_s is not None and not self.start_s < self.stop_s < math.inf:
            raise ConfigError(
                f"The part of the video must stop after it starts ({self.start_s:g} s), "
                f"got stop_s = {self.stop_s:g}."
            )


@dataclass(frozen=True)
class SubjectConfig:
    """Who is followed and how: Choi et al. (2024), Eqs 1-5, with guards.

    `box` is left, top, right, bottom in px in the first frame, when a user names the person.
    `score` is how confidence and overlap are joined: `sum` (argmax of c + IoU, the prose of the
    paper) or `literal` (its Eq 5 as printed, which ignores the overlap).
    """

    first_threshold: float = 0.7
    threshold_step: float = 0.1
    threshold_floor: float = 0.2
    track_threshold: float = 0.3
    iou_weight: float = 1.0
    score: Literal["sum", "literal"] = "sum"
    hold_frames: int = 15
    detect_every: int = 15
    box_margin: float = 1.25
    box: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        _require_between(
            0.0,
            1.0,
            first_threshold=self.first_threshold,
            threshold_floor=self.threshold_floor,
            track_threshold=self.track_threshold,
        )
        _require_between(0.01, 1.0, threshold_step=self.threshold_step)
        _require_between(0.0, 100.0, iou_weight=self.iou_weight)
        _require_between(0, math.inf, hold_frames=self.hold_frames)
        _require_between(1, math.inf, detect_every=self.detect_every)
        _require_between(1.0, 3.0, box_margin=self.box_margin)
        if self.box is not None:
            left, top, right, bottom = self.box
            if not (math.isfinite(sum(self.box)) and left < right and top < bottom):
                raise ConfigError(
                    "The person's box must be left, top, right, bottom in px with left < right "
                    f"and top < bottom, got {', '.join(f'{n:g}' for n in self.box)}."
                )


@dataclass(frozen=True)
class PoseConfig:
    """Which estimator, and its options.

    `variant` is `heavy` (default, for measurement) or `full` (faster, less exact);
    `threads` the number of inference threads, 0 = one per core; `model` the file of keypoints that
    the estimator `stored` reads, or the network that `mhformer`, `d3dp` and `hybrik` run instead of
    their own. `ik` is how the estimator `hybrik` turns joints into rotations: `adaptive` aims every
    bone from where the bones before it ended, `naive` along the joints seen. `d3dp` draws
    `hypotheses` postures in `steps` steps each, from the noise of `seed`, and joins them by
    `aggregation`: `jpma` (joint by joint the one nearest to the picture) or `mean`.
    """

    backend: str = "mediapipe"
    variant: Literal["heavy", "full"] = "heavy"
    threads: int = 0
    min_person_confidence: float = 0.5
    model: str = ""
    ik: Literal["adaptive", "naive"] = "adaptive"
    hypotheses: int = 5
    steps: int = 3
    seed: int = 0
    aggregation: Literal["jpma", "mean"] = "jpma"

    def __post_init__(self) -> None:
        _require_between(0, 256, threads=self.threads)
        _require_between(0.0, 1.0, min_person_confidence=self.min_person_confidence)
        _require_between(1, 100, hypotheses=self.hypotheses, steps=self.steps)
        _require_between(0, 2**32 - 1, seed=self.seed)


@dataclass(frozen=True)
class CameraConfig:
    """What is assumed of an uncalibrated camera.

    `horizontal_fov_deg` along the longer side of the picture; its standard error and that of the
    camera's pitch and roll reach the result.
    """

    horizontal_fov_deg: float = 58.0
    fov_sigma_deg: float = 9.0
    pitch_sigma_deg: float = 8.0
    roll_sigma_deg: float = 2.0

    def __post_init__(self) -> None:
        _require_between(10.0, 170.0, horizontal_fov_deg=self.horizontal_fov_deg)
        _require_between(
            0.0,
            90.0,
            fov_sigma_deg=self.fov_sigma_deg,
            pitch_sigma_deg=self.pitch_sigma_deg,
            roll_sigma_deg=self.roll_sigma_deg,
        )


@dataclass(frozen=True)
class TwoViewConfig:
    """How two videos of one movement are joined.

    `calibration` is the file of the two cameras; without it they are calibrated from the
    moving person. `sync` is `auto`, or the seconds to add to the times of the second video to get
    those of the first. `fusion` is `model` (a body fitted to both pictures) or `triangulate` (each
    joint by itself, where the lines of sight meet).
    """

    calibration: str = ""
    sync: str = "auto"
    fusion: Literal["triangulate", "model"] = "model"

    def __post_init__(self) -> None:
        if self.sync != "auto":
            _require_number("sync", self.sync)

    @property
    def given_offset_s(self) -> float | None:
        """The offset the user gave, None for auto."""
        return None if self.sync == "auto" else float(self.sync)


def _require_number(name: str, text: str) -> None:
    try:
        is_number = math.isfinite(float(text))
    except ValueError:
        is_number = False
    if not is_number:
        raise ConfigError(
            f"The setting {name} must be auto or a number of seconds such as 0.35, got {text!r}."
        )


@dataclass(frozen=True)
class CorrectionConfig:
    """How keypoints are cleaned.

    `preset` is `default`, `paper` (Choi et al. 2024) or `none`; gaps longer than `max_gap_s` stay
    missing. `smoother` names the filter and the others are its parameters: `cutoff_hz` that of
    the zero-lag `butterworth` after both passes; `window_s` of `savitzky_golay`, `median` and
    `hampel`; `jerk` (m/s^2.5) and `gate_probability` (1: none) of `kalman`; `min_cutoff_hz` and
    `beta` (Hz per m/s) of `one_euro`.
    `repair_swaps` exchanges mixed-up sides back, `reject_outliers` tests link lengths.
    """

    preset: Literal["default", "paper", "none"] = "default"
    min_confidence: float = 0.3
    max_gap_s: float = 0.5
    smoother: Literal[
        "kalman", "butterworth", "savitzky_golay", "median", "hampel", "one_euro", "none"
    ] = "kalman"
    cutoff_hz: float = 6.0
    window_s: float = 0.3
    jerk: float = 15.0
    gate_probability: float = 1.0
    min_cutoff_hz: float = 3.0
    beta: float = 4.0
    repair_swaps: bool = True
    reject_outliers: bool = True

    def __post_init__(self) -> None:
        _require_between(0.0, 1.0, min_confidence=self.min_confidence)
        _require_between(0.0, math.inf, max_gap_s=self.max_gap_s)
        _require_between(0.1, 1000.0, cutoff_hz=self.cutoff_hz)
        _require_between(0.0, 60.0, window_s=self.window_s)
        _require_between(0.1, 10000.0, jerk=self.jerk)
        _require_between(0.5, 1.0, gate_probability=self.gate_probability)
        _require_between(0.01, 1000.0, min_cutoff_hz=self.min_cutoff_hz)
        _require_between(0.0, 1000.0, beta=self.beta)


@dataclass(frozen=True)
class EventsConfig:
    """What counts as a lift.

    A lift begins and ends where the hands' speed crosses the larger of `speed_floor_m_s` and
    `speed_share` of its peak. Motion capture allows 0.05 m/s and 5 %; keypoints from video are
    never that still.
    """

    min_rise_m: float = 0.10
    min_duration_s: float = 0.3
    max_duration_s: float = 5.0
    speed_floor_m_s: float = 0.10
    speed_share: float = 0.12
    max_hand_separation_m: float = 0.60

    def __post_init__(self) -> None:
        _require_between(0.01, 2.0, min_rise_m=self.min_rise_m)
        _require_between(0.0, math.inf, min_duration_s=self.min_duration_s)
        _require_between(self.min_duration_s, math.inf, max_duration_s=self.max_duration_s)
        _require_between(0.0, 10.0, speed_floor_m_s=self.speed_floor_m_s)
        _require_between(0.0, 1.0, speed_share=self.speed_share)
        _require_between(0.0, 3.0, max_hand_separation_m=self.max_hand_separation_m)


@dataclass(frozen=True)
class KinematicsConfig:
    """Which solver turns keypoints into joint angles."""

    solver: str = "geometric"


@dataclass(frozen=True)
class RiskConfig:
    """Which risk methods run; empty means all that need no switch."""

    methods: tuple[str, ...] = ()
    experimental: bool = False


@dataclass(frozen=True)
class OutputConfig:
    """What is written beside `trial.json`.

    `surface` draws a body surface over the person instead of the skeleton (extra `anny`).
    """

    overlay: bool = True
    blur_heads: bool = True
    surface: bool = False


@dataclass(frozen=True)
class Config:
    """All settings of one assessment."""

    video: VideoConfig = field(default_factory=VideoConfig)
    subject: SubjectConfig = field(default_factory=SubjectConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    two_view: TwoViewConfig = field(default_factory=TwoViewConfig)
    correction: CorrectionConfig = field(default_factory=CorrectionConfig)
    kinematics: KinematicsConfig = field(default_factory=KinematicsConfig)
    events: EventsConfig = field(default_factory=EventsConfig)
    risk: RiskConfig = field(default_factory=RiskConfig)
    output: OutputConfig = field(default_factory=OutputConfig)

    def as_dict(self) -> dict[str, Any]:
        """Return plain nested values, as written to `trial.json`."""
        return dataclasses.asdict(self)


def read_config(path: Path) -> dict[str, dict[str, Any]]:
    """Read a TOML file into nested tables.

    Raises
    ------
    ConfigError
        If the file is missing or is not TOML.
    """
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise ConfigError(
            f"The configuration file {path} can't be read ({error.strerror}); check its path."
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{path} is not valid TOML: {error}. Expected tables such as [person] with lines such "
            "as stature_m = 1.75 below them; correct that place."
        ) from error


def build_config(tables: dict[str, Any]) -> Config:
    """Build a `Config` from nested tables, checking every key and type.

    Raises
    ------
    ConfigError
        If a table or key is unknown, or a value has the wrong type.
    """
    sections = {f.name: f for f in dataclasses.fields(Config)}
    built = {}
    for name, table in tables.items():
        if name not in sections:
            raise ConfigError(
                f"Unknown table [{name}] in the configuration; known: {', '.join(sections)}."
            )
        if not isinstance(table, dict):
            raise ConfigError(f"[{name}] must be a table of settings, got {table!r}.")
        section_type = typing.get_type_hints(Config)[name]
        built[name] = build_section(name, section_type, table)
    return Config(**built)


def build_section(name: str, section: type[T], table: dict[str, Any]) -> T:
    """Build one settings dataclass from the table `name`, checking every key and type.

    Raises
    ------
    ConfigError
        If a key is unknown, or a value has the wrong type or is out of range.
    """
    hints = typing.get_type_hints(section)
    for key, value in table.items():
        if key not in hints:
            raise ConfigError(f"Unknown key {key!r} in [{name}]; known: {', '.join(hints)}.")
        table = {**table, key: _check_value(f"{name}.{key}", hints[key], value)}
    return section(**table)


def _check_value(key: str, hint: Any, value: Any) -> Any:
    """Return `value` in the type `hint` asks for."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        if not any(value == a and type(value) is type(a) for a in args):
            raise ConfigError(f"{key} must be one of {', '.join(map(str, args))}; got {value!r}.")
        return value
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _check_value(key, next(a for a in args if a is not type(None)), value)
    if origin is tuple:
        return _check_tuple(key, args, value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (hint is not bool and isinstance(value, bool)):
        raise ConfigError(f"{key} must be {_WORDS.get(hint, hint.__name__)}, got {value!r}.")
    return value


def _check_tuple(key: str, args: tuple[Any, ...], value: Any) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{key} must be a list, got {value!r}.")
    if len(args) == 2 and args[1] is Ellipsis:
        return tuple(_check_value(key, args[0], item) for item in value)
    if len(value) != len(args):
        raise ConfigError(f"{key} needs {len(args)} values, got {len(value)}.")
    return tuple(_check_value(key, a, item) for a, item in zip(args, value, strict=True))
