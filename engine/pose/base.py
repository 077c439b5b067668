"""What a pose estimator is, and how estimators are found.

An estimator is one file in `engine/pose/backends/` with a class `Backend` and a
`BACKEND_INFO`; the folder is listed, so nothing else is edited to add one.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import engine.pose.backends as backends_package
from engine.config import PoseConfig
from engine.datatypes import ProgressCallback, TrackedStream, ViewInfo, ViewPose
from engine.errors import BackendUnavailable, ConfigError

__all__ = ["BackendInfo", "LiftingBackend", "PoseBackend", "create_backend", "list_backends"]


@dataclass(frozen=True)
class BackendInfo:
    """What a user should know of an estimator.

    `requires` are the modules it imports when used; `extra` the optional extra that installs
    them. `takes_model` says whether it reads the file that `PoseConfig.model` names; `lifts`
    whether it starts from keypoints that MediaPipe found in the picture (`LiftingBackend`).
    """

    name: str
    title: str
    skeleton: str
    licence: str
    description: str
    requires: tuple[str, ...] = ()
    extra: str = ""
    needs_video: bool = True
    takes_model: bool = False
    lifts: bool = False

    @property
    def missing(self) -> tuple[str, ...]:
        """Modules that are needed but not installed."""
        return tuple(m for m in self.requires if importlib.util.find_spec(m) is None)

    @property
    def install_hint(self) -> str:
        """The command that installs what is missing."""
        return f"pip install 'liftlens[{self.extra}]'" if self.extra else "pip install liftlens"


class PoseBackend(Protocol):
    """An estimator: frames of one followed person in, keypoints out."""

    info: BackendInfo

    def estimate(
        self, frames: TrackedStream, view: ViewInfo, progress: ProgressCallback
    ) -> ViewPose:
        """Estimate the keypoints of the person in `box` of every frame."""


@runtime_checkable
class LiftingBackend(PoseBackend, Protocol):
    """An estimator that needs no picture once the keypoints in it are known."""

    def lift(self, pose: ViewPose) -> ViewPose:
        """Return what was seen with a new body track: the image track lifted to metres.

        Parameters
        ----------
        pose
            Keypoints of another estimator, with MediaPipe's 33 landmarks in the picture.
        """


def list_backends() -> tuple[BackendInfo, ...]:
    """Describe every estimator, without importing what it needs."""
    names = sorted(m.name for m in pkgutil.iter_modules(backends_package.__path__))
    return tuple(
        importlib.import_module(f"{backends_package.__name__}.{name}").BACKEND_INFO
        for name in names
        if not name.startswith("_")
    )


def create_backend(config: PoseConfig) -> PoseBackend:
    """Make the estimator the configuration names.

    Raises
    ------
    ConfigError
        If there is no estimator of that name, or a model file is given that it can't use.
    BackendUnavailable
        If something it needs is not installed.
    """
    known = {info.name: info for info in list_backends()}
    if config.backend not in known:
        raise ConfigError(
            f"Unknown estimator {config.backend!r}; known: {', '.join(known)}. "
            "`liftlens backends` describes them."
        )
    info = known[config.backend]
    if info.missing:
        raise BackendUnavailable(
            f"The estimator {info.name!r} needs {', '.join(info.missing)}, which is not installed; "
            f"run: {info.install_hint}."
        )
    if config.model and not info.takes_model:
        able = [other.name for other in known.values() if other.takes_model]
        raise ConfigError(
            f"The estimator {info.name!r} takes no model file, got {config.model!r}; leave --model "
            f"out, or choose one that does with --backend: {', '.join(able)}."
        )
    module = importlib.import_module(f"{backends_package.__name__}.{info.name.replace('-', '_')}")
    backend: PoseBackend = module.Backend(config)
    return backend
