"""MHFormer: BlazePose's joints in the picture, lifted by a transformer of several hypotheses."""

from __future__ import annotations

from pathlib import Path

from engine.config import PoseConfig
from engine.pose.backends._lifting import LiftingNetworkBackend
from engine.pose.base import BackendInfo
from engine.pose.lifting.lifter import DirectLifter
from engine.pose.lifting.network import MODEL_DIR, describe_network, open_network
from engine.skeletons import MEDIAPIPE_33

BACKEND_INFO = BackendInfo(
    name="mhformer",
    title="MHFormer (small, own weights)",
    skeleton=MEDIAPIPE_33.name,
    licence="Apache-2.0",
    description=(
        "MediaPipe's joints in the picture, lifted to metres over 27 frames by a small network of "
        "MHFormer's design (Li et al. 2022), trained by LiftLens on open motion capture. Published "
        "accuracies don't hold for it. --model runs your own network, for example the official one."
    ),
    requires=("onnxruntime", "cv2"),
    takes_model=True,
    lifts=True,
)
NETWORK = MODEL_DIR / "mhformer_s.onnx"


class Backend(LiftingNetworkBackend):
    """MHFormer on top of BlazePose.

    Parameters
    ----------
    config
        `model` and what `mediapipe` uses.

    Raises
    ------
    ConfigError, DataError, BackendUnavailable
        If the network can't be used; see `open_network`.
    """

    info = BACKEND_INFO

    def __init__(self, config: PoseConfig) -> None:
        network = open_network(Path(config.model) if config.model else NETWORK, "lifter")
        super().__init__(config, DirectLifter(network), describe_network(network, self.info.name))
