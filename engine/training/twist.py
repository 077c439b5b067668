"""Train the network that tells how limbs are turned about their own length.

Run from the project folder, with the extra `train` installed::

    python -m engine.training.twist --data ../shared/data --out .training/twist

It takes some minutes on one core. The best weights by the validation persons are kept and written
as `twist_s.onnx`; `log.csv` beside it tells every epoch.
"""

from __future__ import annotations

import argparse
import csv
import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.pose.swing_twist.skeleton29 import JOINTS
from engine.pose.swing_twist.twist import INPUT_SIZE, OUTPUT_SIZE, normalise_joints
from engine.training.corpus import TRAINING_PERSONS
from engine.training.twist_postures import (
    TwistExamples,
    draw_segments,
    make_examples,
    read_lift_segments,
    read_mocap_segments,
    read_seen_examples,
)

__all__ = ["build_network", "main", "read_examples", "twist_errors"]

logger = logging.getLogger(__name__)

Floats = NDArray[np.float64]

WIDTH = 256
VALIDATION_PERSON = "P06"
"""Of the training persons of the lifts; with the validation split of the recordings it decides
which epoch is kept."""
NOISE = 0.022
"""Largest standard deviation of a joint's error along the worst direction, in statures."""
SOURCE_SHARES = {"seen": 0.25, "lifts": 0.2, "mocap": 0.25, "drawn": 0.3}


@dataclass(frozen=True)
class Settings:
    """What a run is told."""

    epochs: int = 24
    steps: int = 300
    batch: int = 512
    rate: float = 2e-3
    seed: int = 5


def read_examples(
    data: Path, keypoints: Path, seed: int
) -> tuple[dict[str, TwistExamples], dict[str, TwistExamples]]:
    """Read or draw the examples to train on and those to validate with, by source.

    Parameters
    ----------
    data
        Folder of `synthetic_lifts` and `mocap`.
    keypoints
        Folder of what BlazePose saw of the lifts, `<trial>_<camera>.npz` each.
    seed
        Of everything random.
    """
    rng = np.random.default_rng(seed)
    lifts, corpus = data / "synthetic_lifts", data / "mocap" / "cmu_h36m17_30fps.npz"

    def of_persons(persons: tuple[str, ...]) -> TwistExamples:
        files = [f for p in persons for f in sorted((lifts / p).glob("*/truth.npz"))]
        return TwistExamples.join(make_examples(read_lift_segments(f), rng) for f in files)

    def as_seen(persons: tuple[str, ...]) -> TwistExamples:
        return TwistExamples.join(
            read_seen_examples(lifts / person / trial / "truth.npz", file, camera)
            for person in persons
            for file in sorted(keypoints.glob(f"{person}_*.npz"))
            for trial, camera in [file.stem.rsplit("_", 1)]
        )

    fitted = tuple(p for p in TRAINING_PERSONS if p != VALIDATION_PERSON)
    train = {
        "seen": as_seen(fitted),
        "lifts": of_persons(fitted),
        "mocap": make_examples(read_mocap_segments(corpus, "train", every=3), rng),
        "drawn": make_examples(draw_segments(60_000, rng), rng),
    }
    validate = {
        "seen": as_seen((VALIDATION_PERSON,)),
        "lifts": of_persons((VALIDATION_PERSON,)),
        "mocap": make_examples(read_mocap_segments(corpus, "val"), rng),
        "drawn": make_examples(draw_segments(4_000, rng), rng),
    }
    return train, validate


def disturb(joints: Floats, rng: np.random.Generator) -> Floats:
    """Let joints (N, 29, 3) err as a single camera lets them: most in one direction per frame."""
    depth = rng.normal(size=(len(joints), 1, 3))
    depth /= np.linalg.norm(depth, axis=-1, keepdims=True)
    size = NOISE * rng.uniform(0.0, 1.0, (len(joints), 1, 1))
    across = 0.4 * size * rng.normal(size=joints.shape)
    return joints + across + size * depth * rng.normal(size=(*joints.shape[:2], 1))


def sample_batches(
    train: dict[str, TwistExamples], settings: Settings
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]]:
    """Give inputs (B, 51), cosines and sines (B, 46) and weights (B, 23) without end."""
    rng = np.random.default_rng(settings.seed)
    while True:
        parts = []
        for name, share in SOURCE_SHARES.items():
            source = train[name]
            rows = rng.integers(0, len(source.joints), round(share * settings.batch))
            parts.append(
                TwistExamples(source.joints[rows], source.twist[rows], source.is_known[rows])
            )
        batch = TwistExamples.join(parts)
        seen = normalise_joints(disturb(batch.joints, rng), 1.0)
        wanted = np.stack([np.cos(batch.twist), np.sin(batch.twist)], axis=-1)
        flat = wanted.reshape(len(seen), -1).astype(np.float32)
        yield seen, flat, batch.is_known.astype(np.float32)


def build_network() -> Any:
    """Return the untrained network: 51 -> 256 -> 256 -> 46."""
    from torch import nn

    return nn.Sequential(
        nn.Linear(INPUT_SIZE, WIDTH),
        nn.GELU(),
        nn.Linear(WIDTH, WIDTH),
        nn.GELU(),
        nn.Linear(WIDTH, OUTPUT_SIZE),
    )


def twist_errors(twist: Floats, examples: TwistExamples) -> Floats:
    """Return the mean absolute error of each joint's twist (23,), degrees; NaN if unknown."""
    off = np.degrees(np.abs(np.angle(np.exp(1j * (twist - examples.twist)))))
    known = examples.is_known
    count = known.sum(axis=0)
    total = np.where(known, off, 0.0).sum(axis=0)
    mean = np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0)
    return np.asarray(mean)


def run_network(network: Any, joints: Floats) -> Floats:
    """Return the twists (N, 23), radians, the network gives."""
    import torch

    with torch.inference_mode():
        raw = network(torch.from_numpy(normalise_joints(joints, 1.0))).numpy()
    pair = raw.reshape(len(joints), -1, 2)
    return np.asarray(np.arctan2(pair[..., 1], pair[..., 0]), dtype=np.float64)


def fit(
    train: dict[str, TwistExamples],
    validate: dict[str, TwistExamples],
    out: Path,
    settings: Settings,
) -> Any:
    """Train, and return the network of the epoch with the smallest validation error."""
    import torch

    torch.manual_seed(settings.seed)
    torch.set_num_threads(1)
    network = build_network()
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.epochs)
    batches, best, kept = sample_batches(train, settings), np.inf, None
    checked = _disturbed(validate)
    with (out / "log.csv").open("w", newline="") as file:
        log = csv.writer(file)
        log.writerow(["epoch", "loss", *(f"{name}_deg" for name in checked)])
        for epoch in range(settings.epochs):
            losses = [_step(network, optimizer, next(batches)) for _ in range(settings.steps)]
            schedule.step()
            error = {name: limb_error(network, examples) for name, examples in checked.items()}
            log.writerow([epoch, np.mean(losses), *error.values()])
            file.flush()
            logger.info("epoch %d: %s", epoch, {k: round(v, 2) for k, v in error.items()})
            if (score := float(np.mean(list(error.values())))) < best:
                best, kept = score, {k: v.clone() for k, v in network.state_dict().items()}
    network.load_state_dict(kept)
    return network.eval()


def _step(network: Any, optimizer: Any, batch: tuple[NDArray[np.float32], ...]) -> float:
    """Take one step, and return the loss: the mean squared distance of the known pairs."""
    import torch

    seen, wanted, weight = (torch.from_numpy(a) for a in batch)
    off = (network(seen) - wanted).reshape(len(seen), -1, 2).square().sum(dim=-1)
    loss = (off * weight).sum() / weight.sum()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return float(loss.detach())


def _disturbed(validate: dict[str, TwistExamples]) -> dict[str, TwistExamples]:
    """Let the joints err, always in the same way; those that were seen do so by themselves."""
    return {
        name: e
        if name == "seen"
        else replace(e, joints=disturb(e.joints, np.random.default_rng(1)))
        for name, e in validate.items()
    }


def limb_error(network: Any, examples: TwistExamples) -> float:
    """Return the mean error of the limbs' twists, degrees."""
    return float(np.nanmean(twist_errors(run_network(network, examples.joints), examples)[LIMBS]))


LIMBS = [
    JOINTS.index(f"{side}_{part}") - 1
    for part in ("hip", "shoulder", "elbow")
    for side in ("left", "right")
]
"""Rows of the joints whose twist varies most: thigh, upper arm, forearm."""


def export(network: Any, path: Path) -> None:
    """Write the network as ONNX (opset 17, any number of postures)."""
    import torch

    torch.onnx.export(
        network,
        (torch.zeros(2, INPUT_SIZE),),
        str(path),
        input_names=["joints"],
        output_names=["twist"],
        dynamic_axes={"joints": {0: "postures"}, "twist": {0: "postures"}},
        opset_version=17,
        dynamo=False,
    )


def main() -> None:
    """Train and export."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--keypoints", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--out", type=Path, default=Path(".training/twist"))
    parser.add_argument("--epochs", type=int, default=Settings.epochs)
    parser.add_argument("--steps", type=int, default=Settings.steps)
    parser.add_argument("--seed", type=int, default=Settings.seed)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    options.out.mkdir(parents=True, exist_ok=True)
    settings = Settings(epochs=options.epochs, steps=options.steps, seed=options.seed)
    train, validate = read_examples(options.data, options.keypoints, settings.seed)
    logger.info("examples: %s", {k: len(v.joints) for k, v in train.items()})
    export(fit(train, validate, options.out, settings), options.out / "twist_s.onnx")


if __name__ == "__main__":
    main()
