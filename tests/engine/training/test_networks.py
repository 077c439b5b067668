"""The networks and their training; needs the extra `train`."""

from __future__ import annotations

import dataclasses
import json
import sys

import numpy as np
import pytest
import torch

from engine.pose.lifting.diffusion import cosine_schedule
from engine.training.corpus import MIRRORED
from engine.training.detected import Detected
from engine.training.diffusion import DiffusionSchedule
from engine.training.fit import Material, Settings, train
from engine.training.networks import build_network, flat_joints
from engine.training.simulated import simulate_clips
from engine.training.views import project_windows

pytestmark = pytest.mark.extra("torch")

NAMES = ("mhformer", "mixste", "mlp", "tcn")


def ask(network, points):
    if type(network).__name__ == "MixSTE":
        steps = torch.zeros(len(points), dtype=torch.int64)
        return network(points, torch.zeros_like(points), steps)
    return network(points)


@pytest.mark.parametrize("name", NAMES)
def test_every_network_gives_joints_of_every_frame(name):
    network = build_network(name, 9, 16).eval()
    assert ask(network, torch.zeros(2, 9, 17, 3)).shape == (2, 9, 17, 3)


@pytest.mark.parametrize("name", NAMES)
def test_windows_of_a_batch_do_not_touch(name):
    network = build_network(name, 9, 16).eval()
    points = torch.randn(3, 9, 17, 3)
    alone = torch.cat([ask(network, points[i : i + 1]) for i in range(3)])
    assert torch.allclose(ask(network, points), alone, atol=1e-5)


def test_only_the_single_frame_network_looks_at_one_frame():
    points = torch.randn(1, 9, 17, 3)
    other = points.clone()
    other[0, 0] += 1.0
    for name in NAMES:
        network = build_network(name, 9, 16).eval()
        is_same = torch.allclose(ask(network, points)[0, 4], ask(network, other)[0, 4], atol=1e-6)
        assert is_same == (name == "mlp"), name


def test_flat_joints_are_around_the_pelvis():
    points = torch.randn(2, 3, 17, 3)
    joints = flat_joints(points)
    assert torch.all(joints[:, :, 0] == 0)
    assert torch.all(joints[..., 2] == 0)


def test_unknown_network():
    with pytest.raises(ValueError, match="Unknown network 'gru'; known: mhformer"):
        build_network("gru", 9, 16)


def test_training_and_use_have_the_same_noise():
    assert np.allclose(DiffusionSchedule().kept.numpy(), cosine_schedule(), rtol=1e-6)


@pytest.fixture(scope="module")
def material():
    clips = simulate_clips(4, seed=1)
    checks = [_as(clip, source) for clip, source in zip(clips, ("mocap", "lifts"), strict=False)]
    joints = project_windows(clips[0].position[None].astype(float), np.random.default_rng(0))[0]
    video = Detected("P06", joints / joints[..., 2:], np.ones(joints.shape[:2]), joints, 1.75)
    return Material(clips, [video]), Material(checks, [video])


def _as(clip, source):
    return type(clip)(clip.name, clip.subject, source, clip.position)


SMALL = Settings(
    network="tcn", frames=9, dim=16, batch_size=8, total_steps=40, warmup_steps=5,
    validate_every=20, reuse=1,
)  # fmt: skip


@pytest.mark.slow
def test_a_minute_of_training_learns_something(material, tmp_path):
    train(SMALL, *material, tmp_path / "run", budget_s=60)
    rows = (tmp_path / "run" / "log.csv").read_text().splitlines()
    assert len(rows) == 3
    first, last = (float(row.split(",")[2]) for row in (rows[1], rows[2]))
    assert last < first
    assert (tmp_path / "run" / "best.pt").is_file()


@pytest.mark.slow
def test_training_goes_on_where_it_stopped(material, tmp_path):
    run = tmp_path / "run"
    train(SMALL, *material, run, budget_s=0.0)
    assert torch.load(run / "checkpoint.pt", weights_only=True)["step"] == 0
    train(SMALL, *material, run, budget_s=60)
    assert torch.load(run / "checkpoint.pt", weights_only=True)["step"] == 40
    longer = dataclasses.replace(SMALL, total_steps=60)
    train(longer, *material, run, budget_s=60)
    assert torch.load(run / "checkpoint.pt", weights_only=True)["step"] == 60
    assert json.loads((run / "settings.json").read_text())["total_steps"] == 60


@pytest.mark.slow
def test_another_setting_needs_another_folder(material, tmp_path):
    train(SMALL, *material, tmp_path, budget_s=0.0)
    other = Settings(network="tcn", frames=9, dim=24)
    with pytest.raises(ValueError, match=r"other settings .*choose another folder"):
        train(other, *material, tmp_path, budget_s=0.0)


def test_exported_network_says_the_same(tmp_path):
    pytest.importorskip("onnx")
    from engine.pose.lifting.network import open_network
    from engine.training.export import export_network

    for name, kind in (("mhformer", "lifter"), ("mixste", "denoiser")):
        settings = Settings(network=name, frames=9, dim=16)
        network = build_network(name, 9, 16).eval()
        export_network(network, settings, {"sigma": [0.02] * 17}, tmp_path / f"{name}.onnx")
        opened = open_network(tmp_path / f"{name}.onnx", kind)
        assert opened.facts["sigma"] == [0.02] * 17
        points = np.random.default_rng(0).normal(size=(2, 9, 17, 3))
        noisy = points[..., MIRRORED, :] if kind == "denoiser" else None
        found = opened.run(points, noisy, 0)
        given = torch.from_numpy(points).float()
        with torch.no_grad():
            said = (
                network(given)
                if noisy is None
                else network(given, torch.from_numpy(noisy).float(), torch.zeros(2).long())
            )
        assert np.allclose(found, said.numpy(), atol=1e-4)


FAKE_MHFORMER = """
import torch
from torch import nn
class Model(nn.Module):
    def __init__(self, args):
        super().__init__()
        self.args = args
        self.layer = nn.Linear(2, 3)
    def forward(self, x):
        return self.layer(x)
"""
FAKE_MIXSTE = """
import torch
from torch import nn
class MixSTE2(nn.Module):
    def __init__(self, num_frame, embed_dim_ratio, is_train, **_):
        super().__init__()
        assert is_train
        self.layer = nn.Linear(5, 3)
    def forward(self, x_2d, x_3d, t):
        x = torch.cat((x_2d, x_3d), dim=-1)
        return self.layer(x) + 0.001 * t[:, None, None, None]
"""


@pytest.fixture
def official(tmp_path, monkeypatch):
    """Stand-ins with the interface of the published code, and checkpoints as they are saved."""
    from torch import nn

    for name in ("model", "model.mhformer", "common", "common.mixste"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    for file, text in (("model/mhformer.py", FAKE_MHFORMER), ("common/mixste.py", FAKE_MIXSTE)):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
    torch.manual_seed(0)
    first, second = nn.Linear(2, 3).state_dict(), nn.Linear(5, 3).state_dict()
    torch.save({f"module.layer.{k}": v for k, v in first.items()}, tmp_path / "m.pth")
    kept = {f"module.pose_estimator.layer.{k}": v for k, v in second.items()}
    kept["module.betas"] = torch.zeros(3)
    torch.save({"model_pos": kept}, tmp_path / "d.bin")
    return tmp_path


def test_published_networks_are_converted(official):
    pytest.importorskip("onnx")
    from engine.pose.lifting.network import describe_network, open_network
    from engine.training import convert_official as convert

    for name, file, load in (
        ("mhformer", "m.pth", convert.load_mhformer),
        ("d3dp", "d.bin", convert.load_d3dp),
    ):
        out = official / f"{name}.onnx"
        network = load(official, official / file, frames=9, channels=8)
        sha256 = convert.write_official(network, 9, out)
        kind = "lifter" if name == "mhformer" else "denoiser"
        opened = open_network(out, kind)
        assert describe_network(opened, name)["weights"] == f"{name}-official"
        assert describe_network(opened, name)["sha256"] == sha256
        assert (out.parent / f"{name}.onnx.sha256").read_text().startswith(sha256)
        points = np.random.default_rng(0).normal(size=(3, 9, 17, 2))
        if kind == "lifter":
            weights = torch.load(official / file)
            wanted = points @ weights["module.layer.weight"].numpy().T
            wanted = wanted + weights["module.layer.bias"].numpy()
            assert np.allclose(opened.run(points), wanted, atol=1e-5)
        else:
            noisy = np.zeros((3, 9, 17, 3))
            off = opened.run(points, noisy, 100) - opened.run(points, noisy, 0)
            assert np.allclose(off, 0.1, atol=1e-5)
