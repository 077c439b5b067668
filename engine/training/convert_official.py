"""Turn a published network into a file that LiftLens runs: your copy of the code, your weights.

LiftLens ships no published weights: the data they were trained on (Human3.6M and others) are
licensed for research. Whoever may use them runs this with a copy of the official code and a
checkpoint (extra `train`, and what the official code imports: `einops`, for D3DP also `timm`)::

    python -m engine.training.convert_official mhformer --repository ../MHFormer \
        --checkpoint ../MHFormer/checkpoint/pretrained/351/mhformer_351.pth --frames 351 \
        --out mhformer_351.onnx
    python -m engine.training.convert_official d3dp --repository ../D3DP \
        --checkpoint ../D3DP/checkpoint/h36m_best_epoch.bin --frames 243 --out d3dp_243.onnx
    liftlens assess lift.mp4 --backend mhformer --model mhformer_351.onnx

Nothing is downloaded. The hash of the file is printed and written beside it; LiftLens checks it
whenever the file is used, and keeps it in the provenance of every result.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from engine.pose.lifting.network import open_network
from engine.training.networks import N_JOINTS

__all__ = ["DenoiserStep", "load_d3dp", "load_mhformer", "main", "write_official"]

OPSET = 17


class DenoiserStep(nn.Module):
    """One step of D3DP's denoiser with as many axes as the other networks have."""

    def __init__(self, estimator: nn.Module) -> None:
        super().__init__()
        self.estimator = estimator

    def forward(self, points: Tensor, noisy: Tensor, step: Tensor) -> Tensor:
        """Return joints (B, F, 17, 3) of points (B, F, 17, 2), noisy joints and steps (B,)."""
        joints: Tensor = self.estimator(points, noisy, step)
        return joints


def main() -> None:
    """Convert as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("network", choices=("mhformer", "d3dp"))
    parser.add_argument("--repository", type=Path, required=True, help="your copy of the code")
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--frames", type=int, required=True, help="of a window, as trained")
    parser.add_argument("--channels", type=int, default=512)
    parser.add_argument("--depth", type=int, help="layers; 3 for mhformer, 8 for d3dp if left out")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    load = load_mhformer if options.network == "mhformer" else load_d3dp
    network = load(
        options.repository,
        options.checkpoint,
        frames=options.frames,
        channels=options.channels,
        depth=options.depth,
    )
    sha256 = write_official(network, options.frames, options.out)
    sys.stdout.write(f"{options.out}: SHA-256 {sha256}\n")


def load_mhformer(
    repository: Path,
    checkpoint: Path,
    *,
    frames: int,
    channels: int = 512,
    depth: int | None = None,
) -> nn.Module:
    """Load the official MHFormer with its weights."""
    settings = SimpleNamespace(
        frames=frames,
        channel=channels,
        d_hid=2 * channels,
        layers=depth or 3,
        n_joints=N_JOINTS,
        out_joints=N_JOINTS,
    )
    network: nn.Module = _import(repository, "model.mhformer").Model(settings)
    return _fill(network, torch.load(checkpoint, map_location="cpu", weights_only=True))


def load_d3dp(
    repository: Path,
    checkpoint: Path,
    *,
    frames: int,
    channels: int = 512,
    depth: int | None = None,
) -> nn.Module:
    """Load the official denoiser of D3DP with its weights, as a single step."""
    # With is_train the network takes points and joints with the same axes; eval() below still
    # switches everything off that is for training only.
    estimator: nn.Module = _import(repository, "common.mixste").MixSTE2(
        num_frame=frames,
        num_joints=N_JOINTS,
        in_chans=2,
        embed_dim_ratio=channels,
        depth=depth or 8,
        num_heads=8,
        mlp_ratio=2.0,
        qkv_bias=True,
        qk_scale=None,
        drop_path_rate=0.0,
        is_train=True,
    )
    kept = torch.load(checkpoint, map_location="cpu", weights_only=True)
    weights = {k.removeprefix("module."): v for k, v in kept.get("model_pos", kept).items()}
    own = {
        k.removeprefix("pose_estimator."): v
        for k, v in weights.items()
        if k.startswith("pose_estimator.")
    }
    return DenoiserStep(_fill(estimator, own or weights)).eval()


def _import(repository: Path, name: str) -> Any:
    """Import a module of the official code."""
    sys.path.insert(0, str(repository.resolve()))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.pop(0)


def _fill(network: nn.Module, weights: dict[str, Tensor]) -> nn.Module:
    network.load_state_dict({k.removeprefix("module."): v for k, v in weights.items()})
    return network.eval()


def write_official(network: nn.Module, frames: int, out: Path) -> str:
    """Write a network as ONNX and its hash beside it, and check that LiftLens can use it.

    Returns
    -------
    str
        The SHA-256 of the file.

    Raises
    ------
    DataError
        If the written network takes or gives something else than it should.
    """
    is_denoiser = isinstance(network, DenoiserStep)
    shape = (2, frames, N_JOINTS)
    examples: tuple[Tensor, ...] = (torch.zeros(*shape, 2),)
    if is_denoiser:
        examples = (*examples, torch.zeros(*shape, 3), torch.zeros(2, dtype=torch.int64))
    names = ["points", "noisy", "step"][: len(examples)]
    with warnings.catch_warnings():
        # The tracer warns of every shape that it keeps; the check below runs the file.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            examples,
            str(out),
            input_names=names,
            output_names=["joints"],
            dynamic_axes={name: {0: "batch"} for name in [*names, "joints"]},
            opset_version=OPSET,
            dynamo=False,
        )
    sha256 = hashlib.sha256(out.read_bytes()).hexdigest()
    out.with_name(out.name + ".sha256").write_text(f"{sha256}  {out.name}\n", encoding="utf-8")
    opened = open_network(out, "denoiser" if is_denoiser else "lifter")
    points = torch.randn(3, *shape[1:], 2)
    noisy = torch.randn(3, *shape[1:], 3).numpy() if is_denoiser else None
    opened.run(points.numpy(), noisy, 500)
    return sha256


if __name__ == "__main__":
    main()
