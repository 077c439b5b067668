"""Train a lifting network; stop and go on as you like.

Run from the project folder (extra `train`)::

    python -m engine.training.fit --network mhformer --data ../shared/data \
        --out .training/mhformer --minutes 60

The run's folder keeps `checkpoint.pt` (everything needed to go on), `best.pt` (the weights
with the lowest validation error), `log.csv` and `settings.json`. Started again with the same
folder, training goes on where it stopped.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Queue
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from engine.training.corpus import BONES, Clip, read_lifts, read_mocap
from engine.training.detected import Detected, mirror_detected, read_detected
from engine.training.diffusion import DiffusionSchedule
from engine.training.keypoint_noise import KeypointNoise
from engine.training.measure_blazepose import NOISE_FILE
from engine.training.networks import build_network
from engine.training.simulated import simulate_clips
from engine.training.views import Batch, sample_batches

__all__ = ["Settings", "main", "train"]

logger = logging.getLogger(__name__)

CHECK_PERSON = "P06"
CHANGEABLE = {"total_steps", "patience", "validate_every"}
"""Settings with which a run may go on differently: how long it takes and how it is watched."""
N_SIMULATED = 600
"""Movements of the jointed figure, besides the recorded ones."""


@dataclass(frozen=True)
class Settings:
    """What is trained and how; kept with the run."""

    network: str = "mhformer"
    frames: int = 81
    dim: int = 128
    batch_size: int = 64
    learning_rate: float = 1e-3
    total_steps: int = 16000
    warmup_steps: int = 300
    validate_every: int = 500
    patience: int = 10
    bone_weight: float = 0.05
    velocity_weight: float = 0.5
    detected_share: float = 0.2
    reuse: int = 3
    seed: int = 7


@dataclass(frozen=True, eq=False)
class Material:
    """What is learnt from, or what the learning is checked on."""

    clips: Sequence[Clip]
    detected: Sequence[Detected]


def main() -> None:
    """Train as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--data", type=Path, required=True, help="folder with mocap, synthetic_lifts"
    )
    parser.add_argument("--keypoints", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--out", type=Path, required=True, help="the run's folder")
    parser.add_argument("--minutes", type=float, default=60.0, help="stop after this time")
    parser.add_argument("--threads", type=int, default=2)
    for name, value in asdict(Settings()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    options = vars(parser.parse_args())
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(options["threads"])
    settings = Settings(**{name: options[name] for name in asdict(Settings())})
    training, held_out = read_material(options["data"], options["keypoints"], settings.seed)
    train(settings, training, held_out, options["out"], budget_s=60 * options["minutes"])


def read_material(
    data: Path, keypoints: Path, seed: int, *, n_simulated: int = N_SIMULATED
) -> tuple[Material, Material]:
    """Read what to train on and what to check on.

    The lifts of one training person tell whether bending is learnt, and are not trained on.
    """
    corpus = data / "mocap" / "cmu_h36m17_30fps.npz"
    lifts = read_lifts(data / "synthetic_lifts")
    videos = read_detected(data / "synthetic_lifts", keypoints)
    seen = [video for video in videos if video.person != CHECK_PERSON]
    training = Material(
        clips=[
            *read_mocap(corpus, "train"),
            *(clip for clip in lifts if clip.subject != CHECK_PERSON),
            *simulate_clips(n_simulated, seed),
        ],
        detected=[*seen, *map(mirror_detected, seen)],
    )
    checking = Material(
        clips=[*read_mocap(corpus, "val"), *(c for c in lifts if c.subject == CHECK_PERSON)],
        detected=[video for video in videos if video.person == CHECK_PERSON],
    )
    return training, checking


def train(
    settings: Settings,
    training: Material,
    checking: Material,
    out: Path,
    *,
    budget_s: float,
) -> float:
    """Train until the steps are done, the patience or the time is over.

    Returns
    -------
    float
        The lowest validation error (mean distance of joints, in thousandths of stature).
    """
    out.mkdir(parents=True, exist_ok=True)
    run = _Run(settings, out)
    noise = KeypointNoise.read(NOISE_FILE)
    checks = _validation_batches(settings, checking, noise)
    batches = _in_background(settings, training, noise, seed=settings.seed + run.step)
    start = time.monotonic()
    while not run.is_over and time.monotonic() - start < budget_s:
        run.learn(next(batches))
        if run.step % settings.validate_every == 0:
            run.validate(checks)
            run.save()
    run.save()
    return run.best


class _Run:
    """The state of one training."""

    def __init__(self, settings: Settings, out: Path) -> None:
        torch.manual_seed(settings.seed)
        self.settings, self.out = settings, out
        self.network = build_network(settings.network, settings.frames, settings.dim)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=settings.learning_rate, weight_decay=0.01
        )
        self.average = {k: v.clone() for k, v in self.network.state_dict().items()}
        self.diffusion = DiffusionSchedule() if settings.network == "mixste" else None
        self.step, self.best, self.best_step = 0, float("inf"), 0
        self.losses: list[float] = []
        self._resume()

    @property
    def is_over(self) -> bool:
        """Whether all steps are done, or nothing got better for long."""
        waited = (self.step - self.best_step) / self.settings.validate_every
        return self.step >= self.settings.total_steps or waited > self.settings.patience

    def learn(self, batch: Batch) -> None:
        """Take one step."""
        for group in self.optimiser.param_groups:
            group["lr"] = self._rate()
        self.network.train()
        points, joints = torch.from_numpy(batch.points), torch.from_numpy(batch.joints)
        loss = _loss(self._predict(self.network, points, joints), joints, self.settings)
        self.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.step += 1
        self.losses.append(float(loss.detach()))
        # A moving average of the weights is smoother than the weights themselves.
        keep = min(0.999, self.step / (self.step + 10.0))
        with torch.no_grad():
            for name, value in self.network.state_dict().items():
                self.average[name].mul_(keep).add_(value, alpha=1.0 - keep)

    def _rate(self) -> float:
        s = self.settings
        warm = min(1.0, (self.step + 1) / s.warmup_steps)
        share = min(1.0, self.step / s.total_steps)
        return float(s.learning_rate * warm * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * share))))

    def _predict(self, network: nn.Module, points: Tensor, joints: Tensor) -> Tensor:
        if self.diffusion is None:
            prediction: Tensor = network(points)
            return prediction
        step = torch.randint(0, self.diffusion.n_steps, (len(points),))
        noisy = self.diffusion.add_noise(joints, step)
        denoised: Tensor = network(points, noisy, step)
        return denoised

    @torch.no_grad()
    def validate(self, checks: dict[str, list[Batch]]) -> None:
        """Measure the averaged weights; keep them where they are the best so far."""
        network = build_network(self.settings.network, self.settings.frames, self.settings.dim)
        network.load_state_dict(self.average)
        network.eval()
        errors = {}
        for name, batches in checks.items():
            off = []
            # The same noise each time, without touching the training's own.
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(0)
                for batch in batches:
                    joints = torch.from_numpy(batch.joints)
                    found = self._predict(network, torch.from_numpy(batch.points), joints)
                    off.append(float((found - joints).norm(dim=-1).mean()))
            errors[name] = 1000 * float(np.mean(off))
        score = float(np.mean(list(errors.values())))
        if score < self.best:
            self.best, self.best_step = score, self.step
            torch.save(self.average, self.out / "best.pt")
        row = {"step": self.step, "loss": float(np.mean(self.losses)), **errors}
        self.losses = []
        logger.info("%s", ", ".join(f"{k} {v:.4g}" for k, v in row.items()))
        _append_row(self.out / "log.csv", row)

    def save(self) -> None:
        """Keep everything needed to go on."""
        part = self.out / "checkpoint.part"
        state = {
            "network": self.network.state_dict(),
            "average": self.average,
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "best": self.best,
            "best_step": self.best_step,
        }
        torch.save(state, part)
        part.rename(self.out / "checkpoint.pt")

    def _resume(self) -> None:
        kept, path = self.out / "settings.json", self.out / "checkpoint.pt"
        if path.exists():
            earlier = json.loads(kept.read_text(encoding="utf-8"))
            changed = {k for k, v in asdict(self.settings).items() if earlier.get(k) != v}
            if changed - CHANGEABLE:
                raise ValueError(
                    f"{self.out} holds a run with other settings ({earlier}); choose another "
                    "folder."
                )
            state = torch.load(path, weights_only=True)
            self.network.load_state_dict(state["network"])
            self.average = state["average"]
            self.optimiser.load_state_dict(state["optimiser"])
            self.step, self.best, self.best_step = (
                state[key] for key in ("step", "best", "best_step")
            )
            logger.info("Going on at step %d", self.step)
        kept.write_text(json.dumps(asdict(self.settings), indent=1) + "\n", encoding="utf-8")


def _loss(found: Tensor, joints: Tensor, settings: Settings) -> Tensor:
    """Distance of joints, direction of bones and velocity: it is angles that count."""
    distance = (found - joints).norm(dim=-1).mean()
    parent, child = (torch.from_numpy(BONES[:, i]) for i in (0, 1))
    a, b = found[:, :, child] - found[:, :, parent], joints[:, :, child] - joints[:, :, parent]
    unit_a = a / a.norm(dim=-1, keepdim=True).clamp_min(1e-4)
    unit_b = b / b.norm(dim=-1, keepdim=True).clamp_min(1e-4)
    direction = (unit_a - unit_b).norm(dim=-1).mean()
    moved = (found.diff(dim=1) - joints.diff(dim=1)).norm(dim=-1).mean()
    return distance + settings.bone_weight * direction + settings.velocity_weight * moved


def _validation_batches(
    settings: Settings, material: Material, noise: KeypointNoise
) -> dict[str, list[Batch]]:
    """Give fixed batches by source."""
    checks = {}
    for source in ("mocap", "lifts", "detected"):
        stream = sample_batches(
            [c for c in material.clips if source in (c.source, "detected")],
            n_frames=settings.frames,
            batch_size=64,
            noise=noise,
            seed=11,
            detected=material.detected,
            detected_share=1.0 if source == "detected" else 0.0,
        )
        checks[source] = [next(stream) for _ in range(4)]
    return checks


def _in_background(
    settings: Settings, material: Material, noise: KeypointNoise, *, seed: int
) -> Iterator[Batch]:
    """Give batches made by another thread; each is used a few times, far apart."""
    queue: Queue[Batch] = Queue(maxsize=4)
    stream = sample_batches(
        material.clips,
        n_frames=settings.frames,
        batch_size=settings.batch_size,
        noise=noise,
        seed=seed,
        detected=material.detected,
        detected_share=settings.detected_share,
    )

    def produce() -> None:
        while True:
            queue.put(next(stream))

    threading.Thread(target=produce, daemon=True).start()
    rng = np.random.default_rng(seed)
    pool: list[Batch] = []
    while True:
        pool.append(queue.get())
        yield pool[-1]
        for _ in range(settings.reuse - 1):
            yield pool[rng.integers(len(pool))]
        del pool[:-200]


def _append_row(path: Path, row: dict[str, Any]) -> None:
    is_new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(row))
        if is_new:
            writer.writeheader()
        writer.writerow({k: f"{v:.5g}" for k, v in row.items()})


if __name__ == "__main__":
    main()
