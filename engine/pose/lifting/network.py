"""Lifting networks as files: what they take and give, checked before they are used.

Two kinds are read, told apart by how many numbers a point has:

- 3 (x, y, confidence): made by `engine.training.export`. Points and joints are in units of the
  person (`engine.pose.lifting.normalise`).
- 2 (x, y): the published networks. Points are in units of the picture, ``2 x / W - 1`` and
  ``2 y / W - H / W``, joints in metres around the pelvis in the camera's axes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from engine.datatypes import Array
from engine.errors import BackendUnavailable, ConfigError, DataError
from engine.timing import NETWORK_CLOCK

__all__ = ["MODEL_DIR", "LiftingNetwork", "NetworkKind", "describe_network", "open_network"]

NetworkKind = Literal["lifter", "denoiser"]
MODEL_DIR: Final = Path(__file__).parent.parent / "models"
N_JOINTS: Final = 17
MAX_BATCH: Final = 32
"""Windows handed over at once; more only take memory."""
_INPUTS: Final[Mapping[str, tuple[str, ...]]] = {
    "lifter": ("points",),
    "denoiser": ("points", "noisy", "step"),
}
_TYPES: Final = {"points": "tensor(float)", "noisy": "tensor(float)", "step": "tensor(int64)"}


@dataclass(frozen=True, eq=False)
class LiftingNetwork:
    """A network that was opened and checked.

    Parameters
    ----------
    path, sha256
        Its file, and the hash of it.
    kind
        `lifter` (points to joints) or `denoiser` (one step of diffusion).
    n_frames, n_out, n_numbers
        Frames taken, frames given (as many, or 1: the middle one), and numbers of a point.
    facts
        What the file says of itself.
    """

    path: Path
    sha256: str
    kind: NetworkKind
    n_frames: int
    n_out: int
    n_numbers: int
    facts: Mapping[str, Any]
    session: Any = field(repr=False)

    @property
    def is_ours(self) -> bool:
        """Whether it takes points in units of the person, with confidence."""
        return self.n_numbers == 3

    def run(self, points: Array, noisy: Array | None = None, step: int = 0) -> Array:
        """Ask the network.

        Parameters
        ----------
        points
            Shape (B, F, 17, 2 or 3).
        noisy
            Shape (B, F, 17, 3), for a denoiser.
        step
            Of the noise.

        Returns
        -------
        Array
            Shape (B, F or 1, 17, 3).
        """
        parts = []
        for start in range(0, len(points), MAX_BATCH):
            rows = slice(start, start + MAX_BATCH)
            feed = {"points": points[rows].astype(np.float32)}
            if noisy is not None:
                feed["noisy"] = noisy[rows].astype(np.float32)
                feed["step"] = np.full(len(feed["points"]), step, dtype=np.int64)
            with NETWORK_CLOCK:
                parts.append(self.session.run(["joints"], feed)[0])
        return np.concatenate(parts).astype(np.float64)


def open_network(path: Path, kind: NetworkKind, *, threads: int = 1) -> LiftingNetwork:
    """Open a network and check what it takes and gives.

    Parameters
    ----------
    path
        An ONNX file. A file of the same name with `.sha256` behind it, if there is one, holds the
        hash that it must have.
    kind
        What it must be.
    threads
        Of inference; 0 is one per core.

    Raises
    ------
    ConfigError
        If there is no such file.
    DataError
        If the hash is another, the file is no ONNX network that can be run here, or takes or gives
        something else.
    BackendUnavailable
        If a network of the product is missing.
    """
    if not path.is_file():
        if path.parent == MODEL_DIR:
            raise BackendUnavailable(f"The network {path.name} is missing; install LiftLens again.")
        raise ConfigError(f"There is no network {path}; check the path given with --model.")
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    _check_hash(path, sha256)
    session = _open_session(path, threads)
    n_frames, n_out, n_numbers = _check_contract(path, session, kind)
    facts = json.loads(session.get_modelmeta().custom_metadata_map.get("liftlens", "{}"))
    return LiftingNetwork(path, sha256, kind, n_frames, n_out, n_numbers, facts, session)


def _check_hash(path: Path, sha256: str) -> None:
    beside = path.with_name(path.name + ".sha256")
    if not beside.is_file():
        return
    words = beside.read_text(encoding="utf-8", errors="replace").split()
    if not words or words[0].lower() != sha256:
        raise DataError(
            f"{path.name} should have the SHA-256 {words[0][:16] if words else '(none)'}... of "
            f"{beside.name}, but has {sha256[:16]}...; convert or copy it again, or remove "
            f"{beside.name} if you changed the network on purpose."
        )


def _open_session(path: Path, threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime's own errors share no class but Exception
        reason = str(error).strip().splitlines()[0][:200]
        raise DataError(
            f"Expected an ONNX network in {path.name} that ONNX Runtime {onnxruntime.__version__} "
            f"can run (opset 17 is right), but: {reason}. Convert it again; docs/estimators.md "
            "says how."
        ) from error


def _check_contract(path: Path, session: Any, kind: NetworkKind) -> tuple[int, int, int]:
    """Return frames in, frames out and numbers per point of a network that keeps the contract."""
    inputs = {i.name: i for i in session.get_inputs()}
    outputs = {o.name: o for o in session.get_outputs()}
    wanted = _INPUTS[kind]
    if set(inputs) != set(wanted) or "joints" not in outputs:
        raise _broken(path, kind, f"inputs {sorted(inputs)} and outputs {sorted(outputs)}")
    for name in wanted:
        if inputs[name].type != _TYPES[name]:
            raise _broken(path, kind, f"{name} of type {inputs[name].type}")
    shape, given = inputs["points"].shape, outputs["joints"].shape
    n_frames, n_numbers = _check_points(path, kind, shape)
    if "noisy" in inputs and inputs["noisy"].shape[1:] != [n_frames, N_JOINTS, 3]:
        raise _broken(path, kind, f"noisy of shape {inputs['noisy'].shape}")
    # A tracer often leaves the frames of the output open; then there are as many as come in.
    n_out = given[1] if len(given) == 4 and isinstance(given[1], int) else n_frames
    may_give = (n_frames,) if kind == "denoiser" else (n_frames, 1)
    if len(given) != 4 or given[2:] != [N_JOINTS, 3] or n_out not in may_give:
        raise _broken(path, kind, f"joints of shape {given}")
    return n_frames, n_out, n_numbers


def _check_points(path: Path, kind: NetworkKind, shape: list[Any]) -> tuple[int, int]:
    is_right = (
        len(shape) == 4
        and not isinstance(shape[0], int)
        and isinstance(shape[1], int)
        and shape[2] == N_JOINTS
        and shape[3] in (2, 3)
    )
    if not is_right:
        raise _broken(path, kind, f"points of shape {shape}")
    return int(shape[1]), int(shape[3])


def _broken(path: Path, kind: NetworkKind, found: str) -> DataError:
    more = ", noisy (batch, F, 17, 3) float32 and step (batch,) int64" if kind == "denoiser" else ""
    return DataError(
        f"Expected in {path.name} a {kind} with the inputs points (batch, F, 17, 2 or 3) float32"
        f"{more}, with any batch and one fixed number F of frames, and the output joints "
        f"(batch, F{'' if kind == 'denoiser' else ' or 1'}, 17, 3), but found {found}. Convert it "
        "as docs/estimators.md says."
    )


def describe_network(network: LiftingNetwork, estimator: str) -> dict[str, str]:
    """Return the provenance of joints lifted by a network: whose weights, and their hash."""
    is_shipped = network.path.parent == MODEL_DIR
    if is_shipped:
        weights = f"{estimator}-s"
    else:
        weights = f"{estimator}-{'custom' if network.is_ours else 'official'}"
    return {
        "estimator": estimator,
        "weights": weights,
        "network": network.path.name,
        "sha256": network.sha256,
    }
