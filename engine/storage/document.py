"""`trial.json`: a `TrialResult` as plain values, and plain values as typed objects again.

JSON has neither NaN nor infinity. A missing number is null. An infinite headline value
(a lifting index whose limit is zero) is null with `is_infinite` true beside it; an
infinite number inside free-form values is the object
``{"value": null, "is_infinite": true, "is_negative": false}``. The shipped schema,
`trial.schema.json`, says the same key by key.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from enum import Enum
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from engine.datatypes import (
    BodyFit,
    Calibration,
    CalibrationCheck,
    Camera,
    CheckLevel,
    Coupling,
    Flag,
    FlagLevel,
    Lift,
    LiftEnd,
    Measurement,
    Provenance,
    RiskInput,
    RiskResult,
    Subject,
    SyncEstimate,
    Task,
    TrialResult,
    ViewInfo,
    WorldScene,
)

__all__ = [
    "SCHEMA_PATH",
    "SCHEMA_VERSION",
    "build_document",
    "decode_calibration",
    "decode_check",
    "decode_flag",
    "decode_lift",
    "decode_number",
    "decode_plain",
    "decode_risk",
    "decode_scene",
    "decode_subject",
    "decode_sync",
    "decode_task",
    "decode_view",
    "encode_number",
    "encode_plain",
    "find_version",
    "to_json",
]

SCHEMA_VERSION = 1
"""Raised whenever a key of `trial.json` changes its name, type or meaning."""

SCHEMA_PATH = Path(__file__).with_name("trial.schema.json")

TASK_KEYS = tuple(f.name for f in dataclasses.fields(Task) if f.name != "notes")
"""What was told of the work, but for free words."""


def encode_number(value: float) -> float | None:
    """Return `value`, or None where JSON has no word for it (NaN, infinity)."""
    number = float(value)
    return number if math.isfinite(number) else None


def decode_number(value: float | None, *, is_infinite: bool = False) -> float:
    """Return the number that `encode_number` wrote; None becomes NaN, or infinity if so marked."""
    if value is None:
        return math.inf if is_infinite else math.nan
    return float(value)


def encode_plain(value: Any) -> Any:
    """Turn free-form values into values JSON has.

    Parameters
    ----------
    value
        Numbers, text, arrays, enumerations, paths, mappings, sequences, dataclasses.

    Returns
    -------
    Any
        Only dict, list, str, int, float, bool and None; NaN is None, an infinite number an
        object (see the module's text).
    """
    if isinstance(value, Enum):
        value = value.value
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(_key(k)): encode_plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [encode_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return _encode_not_finite(value)
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _key(key: Any) -> Any:
    return key.value if isinstance(key, Enum) else key


def _encode_not_finite(value: float) -> dict[str, Any] | None:
    if math.isnan(value):
        return None
    return {"value": None, "is_infinite": True, "is_negative": value < 0}


def decode_plain(value: Any) -> Any:
    """Undo `encode_plain` for infinite numbers; a missing number stays None."""
    if isinstance(value, dict):
        if set(value) == {"value", "is_infinite", "is_negative"} and value["value"] is None:
            return -math.inf if value["is_negative"] else math.inf
        return {k: decode_plain(v) for k, v in value.items()}
    if isinstance(value, list):
        return [decode_plain(v) for v in value]
    return value


def to_json(values: Mapping[str, Any]) -> str:
    """Return strict JSON text (no NaN, no Infinity)."""
    return json.dumps(values, allow_nan=False, ensure_ascii=False, indent=2) + "\n"


def build_document(result: TrialResult) -> dict[str, Any]:
    """Return the content of `trial.json`, as the shipped schema describes it."""
    trial = result.trial
    return {
        "schema_version": SCHEMA_VERSION,
        "liftlens_version": result.versions.get("liftlens") or find_version(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "label": trial.label,
        "site": trial.site,
        "job": trial.job,
        "views": [_encode_view(view.info) for view in result.views],
        "subject": _encode_subject(trial.subject),
        "task": _encode_task(trial.task),
        "config": encode_plain(result.config),
        "backend": result.backend,
        "solver": result.solver,
        "versions": encode_plain(result.versions),
        "timings_s": _encode_numbers(result.timings_s),
        "coverage": _encode_numbers(result.coverage),
        "scene": _encode_scene(result.scene),
        "two_view": _encode_two_view(result),
        "body": None if result.body is None else _encode_body(result.body),
        "lifts": [_encode_lift(lift) for lift in result.lifts],
        "risk": {name: _encode_risk(risk) for name, risk in result.risk.items()},
        "flags": [_encode_flag(flag) for flag in result.flags],
        "warnings": list(result.warnings),
    }


def find_version() -> str:
    """Return the version of the installed package; `unknown` in a bare checkout."""
    try:
        return metadata.version("liftlens")
    except metadata.PackageNotFoundError:
        return "unknown"


def _encode_numbers(numbers: Mapping[str, float]) -> dict[str, float | None]:
    return {str(key): encode_number(value) for key, value in numbers.items()}


def _encode_view(info: ViewInfo) -> dict[str, Any]:
    return {
        "file_name": info.file_name,
        "sha256": info.sha256,
        "fps": encode_number(info.fps),
        "n_frames": int(info.n_frames),
        "size_px": [int(n) for n in info.size_px],
        "duration_s": encode_number(info.duration_s),
        "codec": info.codec,
        "rotation_deg": int(info.rotation_deg),
        "is_variable_rate": bool(info.is_variable_rate),
        "n_missing_frames": int(info.n_missing_frames),
    }


def decode_view(values: Mapping[str, Any]) -> ViewInfo:
    """Return the facts about one video file."""
    numbers = {key: decode_number(values[key]) for key in ("fps", "duration_s")}
    width, height = values["size_px"]
    return ViewInfo(**{**values, **numbers, "size_px": (int(width), int(height))})


def _encode_subject(subject: Subject) -> dict[str, Any]:
    stature = subject.stature
    return {
        "label": subject.label,
        "stature_m": stature.value,
        "stature_sigma_m": stature.sigma,
        "mass_kg": subject.mass_kg,
        "sex": subject.sex,
        "age_y": subject.age_y,
        "provenance": encode_plain(subject.provenance),
    }


def decode_subject(values: Mapping[str, Any]) -> Subject:
    """Return the subject; an assumed stature is None again."""
    is_assumed = values["provenance"]["stature_m"] == Provenance.ASSUMED
    return Subject(
        label=values["label"],
        stature_m=None if is_assumed else values["stature_m"],
        mass_kg=values["mass_kg"],
        sex=values["sex"],
        age_y=values["age_y"],
    )


def _encode_task(task: Task) -> dict[str, Any]:
    values = {key: encode_plain(getattr(task, key)) for key in TASK_KEYS}
    given = {key: None if v is None else Provenance.USER.value for key, v in values.items()}
    return {**values, "notes": task.notes, "provenance": given}


def decode_task(values: Mapping[str, Any]) -> Task:
    """Return the task."""
    coupling = None if values["coupling"] is None else Coupling(values["coupling"])
    return Task(
        **{**{key: values[key] for key in TASK_KEYS}, "coupling": coupling}, notes=values["notes"]
    )


SCENE_NUMBERS = (
    "scale_sigma",
    "tilt_sigma_deg",
    "heading_sigma_deg",
    "floor_sigma_m",
    "view_azimuth_deg",
    "plane_sigma_m",
    "depth_sigma_m",
)


def _encode_camera(camera: Camera) -> dict[str, Any]:
    return {
        "name": camera.name,
        "size_px": [int(n) for n in camera.size_px],
        "matrix": encode_plain(camera.matrix),
        "distortion": encode_plain(camera.distortion),
        "rotation": encode_plain(camera.rotation),
        "translation_m": encode_plain(camera.translation),
    }


def _decode_camera(values: Mapping[str, Any]) -> Camera:
    width, height = values["size_px"]
    return Camera(
        name=values["name"],
        size_px=(int(width), int(height)),
        matrix=values["matrix"],
        distortion=values["distortion"],
        rotation=values["rotation"],
        translation=values["translation_m"],
    )


def _encode_scene(scene: WorldScene) -> dict[str, Any]:
    return {
        "camera": _encode_camera(scene.camera),
        **{key: encode_number(getattr(scene, key)) for key in SCENE_NUMBERS},
        "provenance": encode_plain(scene.provenance),
    }


def decode_scene(values: Mapping[str, Any]) -> WorldScene:
    """Return the camera in the world with its errors."""
    return WorldScene(
        camera=_decode_camera(values["camera"]),
        provenance=decode_plain(values["provenance"]),
        **{key: decode_number(values[key]) for key in SCENE_NUMBERS},
    )


CALIBRATION_NUMBERS = (
    "floor_m",
    "scale_sigma",
    "rotation_sigma_deg",
    "translation_sigma_m",
    "tilt_sigma_deg",
    "floor_sigma_m",
)


def _encode_calibration(calibration: Calibration) -> dict[str, Any]:
    return {
        "cameras": [_encode_camera(camera) for camera in calibration.cameras],
        "source": calibration.source,
        "up": [encode_number(value) for value in calibration.up],
        **{key: encode_number(getattr(calibration, key)) for key in CALIBRATION_NUMBERS},
        "provenance": encode_plain(calibration.provenance),
    }


def decode_calibration(values: Mapping[str, Any]) -> Calibration:
    """Return the cameras of a trial filmed from two sides."""
    return Calibration(
        cameras=tuple(_decode_camera(camera) for camera in values["cameras"]),
        source=values["source"],
        up=np.array([decode_number(value) for value in values["up"]]),
        provenance=decode_plain(values["provenance"]),
        **{key: decode_number(values[key]) for key in CALIBRATION_NUMBERS},
    )


def _encode_check(check: CalibrationCheck) -> dict[str, Any]:
    return {
        "key": check.key,
        "level": check.level.value,
        "sentence": check.sentence,
        "action": check.action,
        "value": encode_number(check.value),
        "unit": check.unit,
    }


def decode_check(values: Mapping[str, Any]) -> CalibrationCheck:
    """Return one comparison of a calibration with the world."""
    numbers = {"value": decode_number(values["value"]), "level": CheckLevel(values["level"])}
    return CalibrationCheck(**{**values, **numbers})


SYNC_NUMBERS = ("offset_s", "sigma_s", "drift", "confidence")


def _encode_sync(sync: SyncEstimate) -> dict[str, Any]:
    return {
        **{key: encode_number(getattr(sync, key)) for key in SYNC_NUMBERS},
        "method": sync.method,
        "level": sync.level.value,
        "sentence": sync.sentence,
    }


def decode_sync(values: Mapping[str, Any]) -> SyncEstimate:
    """Return how the clocks of two videos belong together."""
    numbers = {key: decode_number(values[key]) for key in SYNC_NUMBERS}
    return SyncEstimate(**{**values, **numbers, "level": CheckLevel(values["level"])})


def _encode_two_view(result: TrialResult) -> dict[str, Any] | None:
    if result.calibration is None or result.sync is None:
        return None
    return {
        "calibration": _encode_calibration(result.calibration),
        "checks": [_encode_check(check) for check in result.checks],
        "sync": _encode_sync(result.sync),
    }


def _encode_body(body: BodyFit) -> dict[str, Any]:
    fitted = body.residual_m[np.isfinite(body.residual_m)]
    quantiles = np.quantile(fitted, (0.5, 0.95)) if fitted.size else (math.nan, math.nan)
    return {
        "segment_lengths_m": _encode_numbers(body.segment_lengths_m),
        "residual_cm": {
            "median": encode_number(100 * quantiles[0]),
            "p95": encode_number(100 * quantiles[1]),
        },
        "fitted": fitted.size / max(body.residual_m.size, 1),
    }


def _encode_measurement(measurement: Measurement) -> dict[str, float | None]:
    return {"value": encode_number(measurement.value), "sigma": encode_number(measurement.sigma)}


def _decode_measurement(values: Mapping[str, Any]) -> Measurement:
    return Measurement(decode_number(values["value"]), decode_number(values["sigma"]))


def _encode_end(end: LiftEnd) -> dict[str, Any]:
    return {
        "time_s": encode_number(end.time_s),
        "H_cm": _encode_measurement(end.H_cm),
        "V_cm": _encode_measurement(end.V_cm),
        "A_deg": _encode_measurement(end.A_deg),
    }


def _decode_end(values: Mapping[str, Any]) -> LiftEnd:
    measured = {key: _decode_measurement(values[key]) for key in ("H_cm", "V_cm", "A_deg")}
    return LiftEnd(time_s=decode_number(values["time_s"]), **measured)


LIFT_NUMBERS = (
    "start_s",
    "end_s",
    "start_sigma_s",
    "end_sigma_s",
    "reach_start_s",
    "return_end_s",
    "peak_hand_speed_m_s",
    "peak_trunk_velocity_deg_s",
)


def _encode_lift(lift: Lift) -> dict[str, Any]:
    return {
        **{key: encode_number(getattr(lift, key)) for key in LIFT_NUMBERS},
        "origin": _encode_end(lift.origin),
        "destination": _encode_end(lift.destination),
        "D_cm": _encode_measurement(lift.D_cm),
        "hands": int(lift.hands),
        "notes": list(lift.notes),
    }


def decode_lift(values: Mapping[str, Any]) -> Lift:
    """Return one lift."""
    return Lift(
        origin=_decode_end(values["origin"]),
        destination=_decode_end(values["destination"]),
        D_cm=_decode_measurement(values["D_cm"]),
        hands=values["hands"],
        notes=tuple(values["notes"]),
        **{key: decode_number(values[key]) for key in LIFT_NUMBERS},
    )


def _encode_risk(risk: RiskResult) -> dict[str, Any]:
    return {
        "method": risk.method,
        "value": encode_number(risk.value),
        "is_infinite": risk.value == math.inf,
        "category": risk.category,
        "unit": risk.unit,
        "interval": [encode_number(end) for end in risk.interval],
        "interval_is_infinite": [end == math.inf for end in risk.interval],
        "inputs": [_encode_input(item) for item in risk.inputs],
        "steps": list(risk.steps),
        "reference": risk.reference,
        "is_applicable": bool(risk.is_applicable),
        "reasons": list(risk.reasons),
        "details": encode_plain(risk.details),
        "lift_index": risk.lift_index,
        "per_lift": [_encode_risk(part) for part in risk.per_lift],
    }


def decode_risk(values: Mapping[str, Any]) -> RiskResult:
    """Return what one method says, with the results of every lift."""
    low, high = (
        decode_number(end, is_infinite=infinite)
        for end, infinite in zip(values["interval"], values["interval_is_infinite"], strict=True)
    )
    return RiskResult(
        method=values["method"],
        value=decode_number(values["value"], is_infinite=values["is_infinite"]),
        category=values["category"],
        unit=values["unit"],
        inputs=tuple(_decode_input(item) for item in values["inputs"]),
        steps=tuple(values["steps"]),
        interval=(low, high),
        reference=values["reference"],
        is_applicable=values["is_applicable"],
        reasons=tuple(values["reasons"]),
        details=decode_plain(values["details"]),
        lift_index=values["lift_index"],
        per_lift=tuple(decode_risk(part) for part in values["per_lift"]),
    )


def _encode_input(item: RiskInput) -> dict[str, Any]:
    value = encode_plain(item.value)
    is_infinite = item.value == math.inf
    return {
        "name": item.name,
        "value": None if isinstance(value, dict) else value,
        "is_infinite": is_infinite,
        "sigma": encode_number(item.sigma),
        "unit": item.unit,
        "provenance": item.provenance.value,
    }


def _decode_input(values: Mapping[str, Any]) -> RiskInput:
    return RiskInput(
        name=values["name"],
        value=math.inf if values["is_infinite"] else values["value"],
        unit=values["unit"],
        provenance=Provenance(values["provenance"]),
        sigma=decode_number(values["sigma"]),
    )


def _encode_flag(flag: Flag) -> dict[str, Any]:
    return {
        "level": flag.level.value,
        "what": flag.what,
        "why": flag.why,
        "method": flag.method,
        "start_s": encode_number(flag.start_s),
        "end_s": encode_number(flag.end_s),
        "change": flag.change,
        "lift_index": flag.lift_index,
    }


def decode_flag(values: Mapping[str, Any]) -> Flag:
    """Return one flag."""
    times = {key: decode_number(values[key]) for key in ("start_s", "end_s")}
    return Flag(**{**values, **times, "level": FlagLevel(values["level"])})
