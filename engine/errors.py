"""Every error the engine raises on purpose.

::

    EngineError
    ├── VideoError              a video can't be used
    ├── PoseError
    │   ├── BackendUnavailable  an estimator or one of its parts is missing
    │   └── NoPersonFound       nobody to measure in the video
    ├── DataError (ValueError)  values that can't be right
    │   ├── ShapeError
    │   └── UnitError
    ├── ConfigError (ValueError)  a setting, option or task value is wrong
    ├── CalibrationError        cameras can't be calibrated, or their calibration is wrong
    ├── SyncError               it can't be told how the clocks of two videos belong together
    ├── OutputError             a result can't be written
    ├── AssessmentError         the steps ran, but no assessment is possible
    └── Cancelled               the user stopped the work

Messages are one sentence or two: what was expected, what came, what to do.
`exit_code` is what the command line returns for the error.
"""

from __future__ import annotations


class EngineError(Exception):
    """Base of all errors the engine raises on purpose."""

    exit_code = 3


class VideoError(EngineError):
    """A video can't be read or written."""


class PoseError(EngineError):
    """Pose estimation failed."""


class BackendUnavailable(PoseError):  # noqa: N818 - reads as a state, as in the field's libraries
    """An estimator, or a part it needs, is not installed."""

    exit_code = 4


class NoPersonFound(PoseError):  # noqa: N818
    """No person could be found where one was expected."""


class DataError(EngineError, ValueError):
    """Values that can't be right."""


class ShapeError(DataError):
    """An array has another shape than its neighbours need."""


class UnitError(DataError):
    """Values come in another unit than the call needs."""


class ConfigError(EngineError, ValueError):
    """A setting, an option or a task value is wrong."""

    exit_code = 2


class CalibrationError(EngineError):
    """Cameras can't be calibrated, or a calibration does not fit the videos."""


class SyncError(EngineError):
    """It can't be told how the clocks of two videos belong together."""


class OutputError(EngineError):
    """A result can't be written where it was asked for."""

    exit_code = 2


class AssessmentError(EngineError):
    """The steps ran, but what they found can't be assessed."""


class Cancelled(EngineError):  # noqa: N818 - not a failure
    """The user stopped the work; nothing was kept."""

    exit_code = 130
