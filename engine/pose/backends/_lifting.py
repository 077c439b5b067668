"""What the estimators share that lift BlazePose's joints by a network."""

from __future__ import annotations

from typing import Any

from engine.config import PoseConfig
from engine.datatypes import ProgressCallback, TrackedStream, ViewInfo, ViewPose
from engine.pose.backends import mediapipe
from engine.pose.lifting.lifter import Lifter


class LiftingNetworkBackend:
    """A lifting network on top of BlazePose.

    Parameters
    ----------
    config
        What `mediapipe` uses.
    lifter
        The network, ready to lift.
    provenance
        Which network it is, for the results.
    """

    def __init__(self, config: PoseConfig, lifter: Lifter, provenance: dict[str, Any]) -> None:
        self._config = config
        self._lifter = lifter
        self._provenance = provenance

    def estimate(
        self, frames: TrackedStream, view: ViewInfo, progress: ProgressCallback
    ) -> ViewPose:
        """Find the joints in the pictures with BlazePose, and lift them."""
        return self.lift(mediapipe.Backend(self._config).estimate(frames, view, progress))

    def lift(self, pose: ViewPose) -> ViewPose:
        """Return the pose with lifted joints as its body track; see `Lifter.lift`."""
        return self._lifter.lift(pose, self._provenance)
