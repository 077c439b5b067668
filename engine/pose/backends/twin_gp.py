"""A trained model of one person and two fixed cameras: markers, and joints from them."""

from __future__ import annotations

from pathlib import Path

from engine.config import PoseConfig
from engine.datatypes import ProgressCallback, TrackedStream, ViewInfo, ViewPose
from engine.errors import ConfigError
from engine.pose.backends import mediapipe
from engine.pose.base import BackendInfo
from engine.skeletons import MEDIAPIPE_33

BACKEND_INFO = BackendInfo(
    name="twin-gp",
    title="Twin Gaussian process of one person (two views)",
    skeleton=MEDIAPIPE_33.name,
    licence="Apache-2.0; the model is the user's own",
    description=(
        "45 markers in the laboratory's axes, from a model trained on that person in front of "
        "those two cameras (Mehrizi et al. 2018): --model FILE, made by `python -m "
        "engine.training.twin_gp`. BlazePose follows the person in each view; joint centres come "
        "from the markers."
    ),
    requires=("onnxruntime", "cv2"),
    takes_model=True,
)


class Backend:
    """BlazePose in each view; the model takes over where both views are joined.

    Raises
    ------
    ConfigError
        If no model file is named, or it does not exist.
    """

    info = BACKEND_INFO

    def __init__(self, config: PoseConfig) -> None:
        if not config.model:
            raise ConfigError(
                "The estimator 'twin-gp' needs the model of the person filmed: name its file with "
                "--model, or train one with `python -m engine.training.twin_gp`."
            )
        if not Path(config.model).is_file():
            raise ConfigError(f"There is no model file {config.model}; check its path.")
        self._landmarks = mediapipe.Backend(config)

    def estimate(
        self, frames: TrackedStream, view: ViewInfo, progress: ProgressCallback
    ) -> ViewPose:
        """Estimate the landmarks of the followed person in one view; see `mediapipe.Backend`."""
        return self._landmarks.estimate(frames, view, progress)
