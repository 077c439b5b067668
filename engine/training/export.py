"""Write a trained network as ONNX, with what is known of it, and check that it says the same.

Run from the project folder (extra `train`)::

    python -m engine.training.export --run .training/mhformer --data ../shared/data \
        --out engine/pose/models/mhformer_s.onnx

A denoiser is exported as one step: points, noisy joints and the step in, joints out; noise, steps
and mirroring stay outside.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from torch import nn

from engine.pose.lifting.diffusion import sample_postures
from engine.training.fit import Material, Settings, read_material
from engine.training.keypoint_noise import KeypointNoise
from engine.training.measure_blazepose import NOISE_FILE
from engine.training.networks import N_IN, N_JOINTS, build_network
from engine.training.views import sample_batches

__all__ = ["export_network", "main", "measure_errors"]

logger = logging.getLogger(__name__)

OPSET = 17
TOLERANCE = 2e-4
"""Largest difference between both runtimes, statures."""
N_DRAWN, N_STEPS = 5, 3
"""Hypotheses and steps with which a denoiser's errors are measured: the defaults in use."""


def main() -> None:
    """Export as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, required=True, help="folder of a training run")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--keypoints", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    settings = Settings(**json.loads((options.run / "settings.json").read_text(encoding="utf-8")))
    network = build_network(settings.network, settings.frames, settings.dim)
    network.load_state_dict(torch.load(options.run / "best.pt", weights_only=True))
    network.eval()
    _, checking = read_material(options.data, options.keypoints, settings.seed, n_simulated=0)
    facts = {
        "network": settings.network,
        "settings": vars(settings),
        "steps_trained": _steps_trained(options.run),
        **measure_errors(network, settings, checking),
    }
    export_network(network, settings, facts, options.out)
    update_card(options.out)
    logger.info("%s: %s", options.out, json.dumps(facts))


def _steps_trained(run: Path) -> int:
    """Return the step whose weights were best."""
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    return int(state["best_step"])


def update_card(model: Path) -> None:
    """Put size and hash of a network into its row of the card beside it, if there is one."""
    card = model.with_name("LIFTING.md")
    if not card.is_file():
        return
    content = model.read_bytes()
    facts = rf"| {len(content):,} | \g<1> | `{hashlib.sha256(content).hexdigest()}` |"
    row = r"\| [^|]* \| ([^|]*) \| `[^`]*` \|"
    text = card.read_text(encoding="utf-8")
    text = re.sub(rf"(?<=\| `{re.escape(model.name)}` ){row}", facts, text)
    card.write_text(text, encoding="utf-8")


@torch.no_grad()
def measure_errors(network: nn.Module, settings: Settings, checking: Material) -> dict[str, Any]:
    """Measure the standard error per joint on what BlazePose saw of the person left out.

    Returns
    -------
    dict
        `sigma` (17): root mean square error per coordinate, statures; for a denoiser `spread` (17),
        the usual standard deviation of the hypotheses.
    """
    stream = sample_batches(
        checking.clips,
        n_frames=settings.frames,
        batch_size=48,
        noise=KeypointNoise.read(NOISE_FILE),
        seed=5,
        detected=checking.detected,
        detected_share=1.0,
    )
    square, spread = [], []
    for _ in range(3):
        batch = next(stream)
        points = torch.from_numpy(batch.points)
        if settings.network == "mixste":
            drawn = _draw(network, points)
            found = drawn.mean(axis=0)
            spread.append(np.sqrt(drawn.var(axis=0, ddof=1).mean(axis=-1)).mean(axis=(0, 1)))
        else:
            found = network(points).numpy()
        off = found - found[:, :, :1] - batch.joints
        square.append(np.square(off).mean(axis=(0, 1, 3)))
    facts = {"sigma": _plain(np.sqrt(np.mean(square, axis=0)))}
    return facts | ({"spread": _plain(np.mean(spread, axis=0))} if spread else {})


def _draw(network: nn.Module, points: torch.Tensor) -> np.ndarray:
    def denoise(noisy: np.ndarray, step: int) -> np.ndarray:
        steps = torch.full((len(points),), step)
        return network(points, torch.from_numpy(noisy).float(), steps).numpy()

    shape, rng = (*points.shape[:3], 3), np.random.default_rng(0)
    drawn = [sample_postures(denoise, shape, steps=N_STEPS, rng=rng) for _ in range(N_DRAWN)]
    return np.stack([d - d[:, :, :1] for d in drawn])


def _plain(values: np.ndarray) -> list[float]:
    return [round(float(max(v, 1e-4)), 5) for v in values]


def export_network(
    network: nn.Module, settings: Settings, facts: dict[str, Any], out: Path
) -> None:
    """Write the network, with the facts in it, and compare both runtimes.

    Raises
    ------
    ValueError
        If ONNX Runtime says something else than PyTorch, for one of two batch sizes.
    """
    names = ["points", "noisy", "step"] if settings.network == "mixste" else ["points"]
    part = out.with_suffix(".part")
    with warnings.catch_warnings():
        # The tracer warns of every shape that it keeps; the batch sizes below are the proof.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            _examples(settings, 2),
            str(part),
            input_names=names,
            output_names=["joints"],
            dynamic_axes={name: {0: "batch"} for name in [*names, "joints"]},
            opset_version=OPSET,
            dynamo=False,
        )
    model = onnx.load(str(part))
    part.unlink()
    entry = model.metadata_props.add()
    entry.key, entry.value = "liftlens", json.dumps(facts)
    onnx.checker.check_model(model)
    content = model.SerializeToString()
    for batch in (1, 3):
        examples = _examples(settings, batch)
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        feed = {n: e.numpy() for n, e in zip(names, examples, strict=True)}
        with torch.no_grad():
            off = np.abs(session.run(None, feed)[0] - network(*examples).numpy()).max()
        if not off < TOLERANCE:
            raise ValueError(f"ONNX Runtime differs from PyTorch by {off:.2g} at batch {batch}.")
    out.write_bytes(content)


def _examples(settings: Settings, batch: int) -> tuple[torch.Tensor, ...]:
    shape = (batch, settings.frames, N_JOINTS)
    points = torch.randn(*shape, N_IN)
    if settings.network != "mixste":
        return (points,)
    return points, torch.randn(*shape, 3), torch.randint(0, 1000, (batch,))


if __name__ == "__main__":
    main()
