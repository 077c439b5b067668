"""What a network's file must be, and what is said when it is something else."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest

from engine.errors import BackendUnavailable, ConfigError, DataError
from engine.pose.lifting.network import MODEL_DIR, describe_network, open_network

DATA = Path(__file__).with_name("data")


def test_our_lifter_is_read():
    network = open_network(DATA / "lifter.onnx", "lifter")
    assert (network.n_frames, network.n_out, network.n_numbers) == (9, 9, 3)
    assert network.is_ours
    points = np.random.default_rng(0).normal(size=(2, 9, 17, 3))
    joints = network.run(points)
    assert np.allclose(joints[..., :2], points[..., :2], atol=1e-6)
    assert np.all(joints[..., 2] == 0)


def test_many_windows_are_handed_over_in_parts():
    network = open_network(DATA / "lifter.onnx", "lifter")
    points = np.random.default_rng(0).normal(size=(75, 9, 17, 3))
    assert np.allclose(network.run(points)[..., :2], points[..., :2], atol=1e-6)


def test_published_networks_are_told_apart():
    network = open_network(DATA / "official_middle.onnx", "lifter")
    assert (network.n_frames, network.n_out, network.is_ours) == (9, 1, False)
    assert describe_network(network, "mhformer")["weights"] == "mhformer-official"
    ours = open_network(DATA / "denoiser.onnx", "denoiser")
    assert describe_network(ours, "d3dp")["weights"] == "d3dp-custom"


def test_the_hash_is_that_of_the_file():
    network = open_network(DATA / "lifter.onnx", "lifter")
    known = hashlib.sha256((DATA / "lifter.onnx").read_bytes()).hexdigest()
    assert describe_network(network, "mhformer")["sha256"] == known


def test_hash_beside_the_file_is_checked(tmp_path):
    copy = tmp_path / "net.onnx"
    shutil.copy(DATA / "lifter.onnx", copy)
    beside = tmp_path / "net.onnx.sha256"
    beside.write_text(f"{hashlib.sha256(copy.read_bytes()).hexdigest().upper()}  net.onnx\n")
    assert open_network(copy, "lifter").n_frames == 9
    beside.write_text("f" * 64)
    with pytest.raises(DataError, match=r"should have the SHA-256 f{16}.*convert or copy it again"):
        open_network(copy, "lifter")
    beside.write_text("")
    with pytest.raises(DataError, match=r"\(none\)"):
        open_network(copy, "lifter")


@pytest.mark.parametrize(
    ("name", "kind", "found"),
    [
        ("sixteen_joints", "lifter", r"points of shape \['batch', 9, 16, 3\]"),
        ("one_clip_only", "lifter", r"points of shape \[1, 9, 17, 3\]"),
        ("denoiser", "lifter", r"inputs \['noisy', 'points', 'step'\]"),
        ("lifter", "denoiser", r"inputs \['points'\]"),
    ],
)
def test_another_contract_is_refused_with_both_shapes(name, kind, found):
    with pytest.raises(DataError, match=rf"Expected in {name}.onnx a {kind}.*17.*{found}"):
        open_network(DATA / f"{name}.onnx", kind)


def test_another_opset_is_refused():
    with pytest.raises(DataError, match=r"too_new\.onnx .*opset 17 is right.*docs/estimators\.md"):
        open_network(DATA / "too_new.onnx", "lifter")


def test_no_network_at_all(tmp_path):
    file = tmp_path / "weights.onnx"
    file.write_bytes(b"a checkpoint of something else")
    with pytest.raises(DataError, match=r"Expected an ONNX network in weights\.onnx"):
        open_network(file, "lifter")
    with pytest.raises(ConfigError, match=r"no network .*missing\.onnx; check the path"):
        open_network(tmp_path / "missing.onnx", "lifter")


def test_a_missing_network_of_the_product_is_no_fault_of_the_user():
    with pytest.raises(BackendUnavailable, match="install LiftLens again"):
        open_network(MODEL_DIR / "no_such.onnx", "lifter")
