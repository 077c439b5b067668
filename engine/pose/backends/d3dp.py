"""D3DP: BlazePose's joints in the picture, lifted by diffusion to several hypotheses."""

from __future__ import annotations

from pathlib import Path

from engine.config import PoseConfig
from engine.pose.backends._lifting import LiftingNetworkBackend
from engine.pose.base import BackendInfo
from engine.pose.lifting.lifter import DiffusionLifter
from engine.pose.lifting.network import MODEL_DIR, describe_network, open_network
from engine.skeletons import MEDIAPIPE_33

BACKEND_INFO = BackendInfo(
    name="d3dp",
    title="D3DP (small, own weights)",
    skeleton=MEDIAPIPE_33.name,
    licence="Apache-2.0",
    description=(
        "MediaPipe's joints in the picture, lifted to metres over 27 frames by diffusion as in "
        "D3DP (Shan et al. 2023): several hypotheses, joined by how well they fit the picture, "
        "with their spread as uncertainty. The network is small and trained by LiftLens on open "
        "motion capture; published accuracies don't hold for it. --model runs your own, for "
        "example the official one."
    ),
    requires=("onnxruntime", "cv2"),
    takes_model=True,
    lifts=True,
)
NETWORK = MODEL_DIR / "d3dp_s.onnx"


class Backend(LiftingNetworkBackend):
    """D3DP on top of BlazePose.

    Parameters
    ----------
    config
        `model`, `hypotheses`, `steps`, `seed`, `aggregation` and what `mediapipe` uses.

    Raises
    ------
    ConfigError, DataError, BackendUnavailable
        If the network can't be used; see `open_network`.
    """

    info = BACKEND_INFO

    def __init__(self, config: PoseConfig) -> None:
        network = open_network(Path(config.model) if config.model else NETWORK, "denoiser")
        lifter = DiffusionLifter(
            network,
            hypotheses=config.hypotheses,
            steps=config.steps,
            seed=config.seed,
            aggregation=config.aggregation,
        )
        drawn = {
            "hypotheses": config.hypotheses,
            "steps": config.steps,
            "seed": config.seed,
            "aggregation": config.aggregation,
        }
        super().__init__(config, lifter, describe_network(network, self.info.name) | drawn)
