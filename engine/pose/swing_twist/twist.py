"""The small network that tells how limbs are turned about their own length.

Positions of joints leave that open. The network has seen many postures with known rotations and
gives the likely twist of every joint as cosine and sine; the shorter that pair, the less it knows.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import BackendUnavailable
from engine.pose.swing_twist.inverse_kinematics import fit_rotation
from engine.pose.swing_twist.landmarks import body_size
from engine.pose.swing_twist.skeleton29 import CHILDREN, JOINTS, N_TURNING, RestSkeleton

__all__ = ["INPUT_JOINTS", "MODEL_PATH", "TwistNetwork", "normalise_joints"]

INPUT_JOINTS: Final[tuple[str, ...]] = (
    "pelvis",
    "right_hip",
    "right_knee",
    "right_ankle",
    "left_hip",
    "left_knee",
    "left_ankle",
    "spine_mid",
    "neck",
    "head",
    "head_top",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
)
"""The 17 joints the network sees, in the order of Human3.6M."""

MODEL_PATH: Final = Path(__file__).parents[1] / "models" / "twist_s.onnx"
MODEL_SHA256: Final = "14b878412fd182fafa4120bc6dc03e7f58c936db732407ddf1859ab671baaa86"
INPUT_SIZE: Final = 3 * len(INPUT_JOINTS)
OUTPUT_SIZE: Final = 2 * (N_TURNING - 1)
_COLUMNS: Final = [JOINTS.index(name) for name in INPUT_JOINTS]
_ROOT_OFFSETS: Final = RestSkeleton.from_stature(1.0).offsets[list(CHILDREN[0])]


def normalise_joints(joints: Array, size: float | Array | None = None) -> NDArray[np.float32]:
    """Turn joints into what the network sees: around the pelvis, in its axes, in statures.

    Parameters
    ----------
    joints
        Shape (T, 29, 3), any axes and unit; NaN where missing.
    size
        The stature in that unit, constant or (T,); found from the joints if left out.

    Returns
    -------
    array
        Shape (T, 51); NaN where a joint is missing.
    """
    scale = body_size(joints) if size is None else size
    around = joints - joints[:, :1]
    axes = fit_rotation(_ROOT_OFFSETS, around[:, list(CHILDREN[0])])
    turned = np.einsum("tji,tkj->tki", axes, around[:, _COLUMNS])
    flat = turned.reshape(len(joints), -1) / np.broadcast_to(scale, len(joints))[:, None]
    return np.asarray(flat, dtype=np.float32)


class TwistNetwork:
    """The shipped network.

    Parameters
    ----------
    path
        Its ONNX file.

    Raises
    ------
    BackendUnavailable
        If the file is missing or is not the one that was shipped.
    """

    def __init__(self, path: Path = MODEL_PATH) -> None:
        content = path.read_bytes() if path.is_file() else b""
        found = hashlib.sha256(content).hexdigest()
        if not content or (path == MODEL_PATH and found != MODEL_SHA256):
            state = "is not the one that was shipped" if content else "is missing"
            raise BackendUnavailable(
                f"The network file {path.name} {state}; install LiftLens again to get it."
            )
        self._session = _open(content)

    def estimate(self, joints: Array) -> tuple[Array, Array]:
        """Estimate the twists of postures.

        Parameters
        ----------
        joints
            Shape (T, 29, 3), any axes and unit; NaN where missing.

        Returns
        -------
        tuple of array
            Twist (T, 23), radians, and how sure it is (T, 23), 0 to 1. NaN and 0 where a joint is
            missing.
        """
        seen = normalise_joints(joints)
        is_whole = np.isfinite(seen).all(axis=1)
        raw = np.full((len(joints), OUTPUT_SIZE), np.nan)
        if is_whole.any():
            raw[is_whole] = self._session.run(None, {"joints": seen[is_whole]})[0]
        cosine, sine = np.moveaxis(raw.reshape(len(joints), -1, 2), -1, 0)
        sure = np.nan_to_num(np.minimum(np.hypot(cosine, sine), 1.0))
        return np.arctan2(sine, cosine), sure


def _open(content: bytes) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # a matrix this small is slower on two
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
