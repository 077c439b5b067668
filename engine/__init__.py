"""Video of a person lifting becomes posture, joint angles and a lifting-risk assessment.

Importing does no work: what needs heavy libraries is loaded when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from engine.version import __version__

if TYPE_CHECKING:
    from engine.config import Config
    from engine.datatypes import (
        Camera,
        Coupling,
        Flag,
        FlagLevel,
        JointAngles,
        Lift,
        Measurement,
        PoseTrack,
        RiskResult,
        Subject,
        Task,
        Trial,
        TrialResult,
        View,
    )
    from engine.errors import EngineError
    from engine.pipeline import assess, assess_to_folder
    from engine.storage.results import read_result, write_result

_HOMES = {
    "Camera": "datatypes",
    "Config": "config",
    "Coupling": "datatypes",
    "EngineError": "errors",
    "Flag": "datatypes",
    "FlagLevel": "datatypes",
    "JointAngles": "datatypes",
    "Lift": "datatypes",
    "Measurement": "datatypes",
    "PoseTrack": "datatypes",
    "RiskResult": "datatypes",
    "Subject": "datatypes",
    "Task": "datatypes",
    "Trial": "datatypes",
    "TrialResult": "datatypes",
    "View": "datatypes",
    "assess": "pipeline",
    "assess_to_folder": "pipeline",
    "read_result": "storage.results",
    "write_result": "storage.results",
}

__all__ = [
    "Camera",
    "Config",
    "Coupling",
    "EngineError",
    "Flag",
    "FlagLevel",
    "JointAngles",
    "Lift",
    "Measurement",
    "PoseTrack",
    "RiskResult",
    "Subject",
    "Task",
    "Trial",
    "TrialResult",
    "View",
    "__version__",
    "assess",
    "assess_to_folder",
    "read_result",
    "write_result",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"engine.{_HOMES[name]}"), name)
