"""A user's own copy of the published network, as an ONNX file.

Nothing of it is shipped: its weights were trained on pictures licensed for research only. The file
is checked against the contract below before it is used, and its checksum goes into every result.

Contract
--------
input
    One, 32-bit float, (1, 3, 256, 256): red, green, blue from 0 to 1 of the square around the
    person; the network's own normalisation of colours is part of the file.
`joints_xyz` or `joints_uvd`
    (1, 29, 3). xyz: metres, x right, y down, z away, any origin. uvd: u and v as shares of the crop
    from its middle, d as a share of a depth of 2.2 m.
`twist`
    (1, 23, 2), cosine and sine for every joint but the pelvis.
`shape`
    (1, 10), if there is one; it is not used.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, PersonBox
from engine.errors import ConfigError
from engine.pose.swing_twist.skeleton29 import N_JOINTS, N_TURNING
from engine.timing import NETWORK_CLOCK

__all__ = ["OfficialNetwork", "crop_person"]

CROP_PX: Final = 256
CROP_MARGIN: Final = 1.25
DEPTH_BOX_M: Final = 2.2
INPUT_SHAPE: Final = (1, 3, CROP_PX, CROP_PX)
OUTPUT_SHAPES: Final = {
    "joints_xyz": (1, N_JOINTS, 3),
    "joints_uvd": (1, N_JOINTS, 3),
    "twist": (1, N_TURNING - 1, 2),
    "shape": (1, 10),
}
_HELP: Final = "Convert your copy of the network as docs/estimators.md describes."


def crop_person(image: NDArray[np.uint8], box: PersonBox) -> NDArray[np.float32]:
    """Cut the square around a person, shape (1, 3, 256, 256), from 0 to 1.

    What lies outside the picture is black. Box edges are px from the picture's border.
    """
    side = max(box.size_px) * CROP_MARGIN
    step = side / CROP_PX
    left, top = (box.left + box.right - side) / 2, (box.top + box.bottom - side) / 2
    # Pixel centres of the crop to pixel centres of the picture.
    matrix = np.array([[step, 0.0, left + (step - 1) / 2], [0.0, step, top + (step - 1) / 2]])
    crop = cv2.warpAffine(
        image,
        matrix,
        (CROP_PX, CROP_PX),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
    )
    scaled = crop.astype(np.float32) / np.float32(255.0)
    return np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])


class OfficialNetwork:
    """The network in the file a user names.

    Parameters
    ----------
    path
        An ONNX file. If `<file>.sha256` lies beside it, the checksum must be the one in there.
    threads
        Of inference; 0 = one per core.

    Raises
    ------
    ConfigError
        If the file is missing, can't be read, is not the one its checksum names, or does not keep
        the contract.
    """

    def __init__(self, path: Path, *, threads: int = 0) -> None:
        if not path.is_file():
            raise ConfigError(f"There is no network file {path}; check its path.")
        content = path.read_bytes()
        self.sha256 = hashlib.sha256(content).hexdigest()
        _check_sum(path, self.sha256)
        self._name = path.name
        self._session = _open(path.name, content, threads)
        self._input, self._joints = self._check_contract()
        self._check_outputs()

    @property
    def gives_metres(self) -> bool:
        """Whether the joints come in metres, and not as places in the crop with a depth."""
        return self._joints == "joints_xyz"

    def estimate(self, crop: NDArray[np.float32]) -> tuple[Array, Array]:
        """Run the network on one crop.

        Returns
        -------
        tuple of array
            Joints (29, 3): metres, or with `gives_metres` False shares of the crop in x and y and
            metres along the line of sight. Twists (23,), radians.
        """
        with NETWORK_CLOCK:
            joints, twist = self._session.run([self._joints, "twist"], {self._input: crop})
        place = np.asarray(joints[0], dtype=np.float64)
        if not self.gives_metres:
            place = place * (1.0, 1.0, DEPTH_BOX_M)
        return place, np.arctan2(twist[0, :, 1], twist[0, :, 0]).astype(np.float64)

    def _check_contract(self) -> tuple[str, str]:
        inputs = self._session.get_inputs()
        found = {output.name: tuple(output.shape) for output in self._session.get_outputs()}
        taken = [(i.type, tuple(i.shape)) for i in inputs]
        if (
            len(inputs) != 1
            or taken[0][0] != "tensor(float)"
            or not _fits(taken[0][1], INPUT_SHAPE)
        ):
            raise ConfigError(
                f"Expected one input of 32-bit floats {INPUT_SHAPE} in {self._name}, got "
                f"{', '.join(f'{kind} {shape}' for kind, shape in taken)}. {_HELP}"
            )
        joints = next((name for name in ("joints_xyz", "joints_uvd") if name in found), None)
        if joints is None or "twist" not in found:
            raise ConfigError(
                f"Expected outputs 'joints_xyz' or 'joints_uvd', and 'twist', in {self._name}, got "
                f"{', '.join(found)}. {_HELP}"
            )
        for name, shape in OUTPUT_SHAPES.items():
            if name in found and not _fits(found[name], shape):
                raise ConfigError(
                    f"Expected the output {name!r} of {self._name} with shape {shape}, got "
                    f"{found[name]}. {_HELP}"
                )
        return inputs[0].name, joints

    def _check_outputs(self) -> None:
        """Run a grey picture: a file can announce what it does not give."""
        grey = np.full(INPUT_SHAPE, 0.5, dtype=np.float32)
        for name, values in zip(
            (self._joints, "twist"),
            self._session.run([self._joints, "twist"], {self._input: grey}),
            strict=True,
        ):
            if values.shape != OUTPUT_SHAPES[name] or not np.isfinite(values).all():
                raise ConfigError(
                    f"Expected finite numbers with shape {OUTPUT_SHAPES[name]} in {name!r} of "
                    f"{self._name}, got shape {values.shape}"
                    f"{'' if np.isfinite(values).all() else ' with NaN or infinity'}. {_HELP}"
                )


def _fits(shape: tuple[Any, ...], wanted: tuple[int, ...]) -> bool:
    """Whether a shape is the one wanted; dimensions with a name or none may be anything."""
    return len(shape) == len(wanted) and all(
        not isinstance(a, int) or a == b for a, b in zip(shape, wanted, strict=True)
    )


def _check_sum(path: Path, found: str) -> None:
    note = path.with_name(path.name + ".sha256")
    if not note.is_file():
        return
    wanted = note.read_text(encoding="utf-8", errors="replace").split()
    if not wanted or wanted[0].lower() != found:
        raise ConfigError(
            f"Expected the checksum that {note.name} tells ({wanted[0] if wanted else 'none'}), "
            f"but {path.name} has {found}; copy or convert the file again, or remove {note.name}."
        )


def _open(name: str, content: bytes, threads: int) -> Any:
    import onnxruntime
    from onnxruntime.capi import onnxruntime_pybind11_state as reasons

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except (
        reasons.Fail,
        reasons.InvalidArgument,
        reasons.InvalidGraph,
        reasons.InvalidProtobuf,
        reasons.NotImplemented,
        reasons.RuntimeException,
    ) as error:
        raise ConfigError(
            f"{name} can't be used as a network (ONNX, opset 17 is sure to work): "
            f"{str(error).splitlines()[0]} {_HELP}"
        ) from error
