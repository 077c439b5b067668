"""The contract of a user's own network."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from engine.datatypes import PersonBox
from engine.errors import ConfigError
from engine.pose.swing_twist.official import OfficialNetwork, crop_person

from .builders import REST
from .onnx_files import DOUBLE, write_network

GREY = np.full((1, 3, 256, 256), 0.5, np.float32)
TWIST = np.tile([np.cos(0.4), np.sin(0.4)], (1, 23, 1))
XYZ = REST.position[None]


def good() -> dict[str, np.ndarray]:
    return {"joints_xyz": XYZ, "twist": TWIST, "shape": np.zeros((1, 10))}


def test_joints_in_metres_and_twists(tmp_path):
    network = OfficialNetwork(write_network(tmp_path / "a.onnx", good()), threads=1)
    joints, twist = network.estimate(GREY)
    assert network.gives_metres
    np.testing.assert_allclose(joints, REST.position, atol=1e-6)
    np.testing.assert_allclose(twist, 0.4, atol=1e-6)
    assert network.sha256 == hashlib.sha256((tmp_path / "a.onnx").read_bytes()).hexdigest()


def test_joints_in_the_crop_with_depth(tmp_path):
    uvd = np.full((1, 29, 3), 0.25)
    file = write_network(tmp_path / "a.onnx", {"joints_uvd": uvd, "twist": TWIST})
    network = OfficialNetwork(file, threads=1)
    assert not network.gives_metres
    np.testing.assert_allclose(network.estimate(GREY)[0], np.tile([0.25, 0.25, 0.55], (29, 1)))


def test_a_free_number_of_pictures_is_fine(tmp_path):
    file = write_network(tmp_path / "a.onnx", good(), input_shape=("n", 3, 256, 256))
    assert OfficialNetwork(file, threads=1).gives_metres


@pytest.mark.parametrize(
    ("outputs", "options", "message"),
    [
        (good(), {"input_shape": (1, 3, 224, 224)}, r"\(1, 3, 256, 256\).*got.*224"),
        (good(), {"input_shape": (1, 256, 256, 3)}, r"got.*256, 256, 3"),
        (good(), {"input_kind": DOUBLE}, r"32-bit floats.*double"),
        ({"joints_xyz": XYZ}, {}, r"and 'twist'.*got joints_xyz"),
        ({"pose": XYZ, "twist": TWIST}, {}, r"'joints_xyz' or 'joints_uvd'.*got pose, twist"),
        ({**good(), "joints_xyz": XYZ[:, :24]}, {}, r"'joints_xyz'.*\(1, 29, 3\).*\(1, 24, 3\)"),
        ({**good(), "shape": np.zeros((1, 11))}, {}, r"'shape'.*\(1, 10\).*\(1, 11\)"),
        ({**good(), "joints_xyz": XYZ * np.nan}, {}, r"finite numbers.*with NaN"),
        (good(), {"opset": 999}, r"opset 17"),
    ],
    ids=[
        "smaller crop",
        "colours last",
        "64-bit",
        "no twist",
        "no joints",
        "24 joints",
        "other shape",
        "NaN",
        "opset",
    ],
)
def test_what_breaks_the_contract_is_named(tmp_path, outputs, options, message):
    file = write_network(tmp_path / "mine.onnx", outputs, **options)
    with pytest.raises(ConfigError, match=message) as caught:
        OfficialNetwork(file, threads=1)
    assert "mine.onnx" in str(caught.value)
    assert "docs/estimators.md" in str(caught.value)


def test_files_that_are_no_network(tmp_path):
    with pytest.raises(ConfigError, match="no network file"):
        OfficialNetwork(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("not a network")
    with pytest.raises(ConfigError, match=r"text\.onnx can't be used"):
        OfficialNetwork(tmp_path / "text.onnx")


def test_a_checksum_beside_the_file_is_held_to(tmp_path):
    file = write_network(tmp_path / "a.onnx", good())
    note = tmp_path / "a.onnx.sha256"
    note.write_text(f"{hashlib.sha256(file.read_bytes()).hexdigest().upper()}  a.onnx\n")
    OfficialNetwork(file, threads=1)
    for wrong in ("0" * 64, ""):
        note.write_text(wrong)
        with pytest.raises(ConfigError, match=r"checksum that a\.onnx\.sha256"):
            OfficialNetwork(file, threads=1)


def test_the_crop_is_the_square_around_the_person():
    picture = np.zeros((400, 600, 3), np.uint8)
    picture[100:300, 250:350] = (255, 0, 51)
    crop = crop_person(picture, PersonBox(250.0, 100.0, 350.0, 300.0))
    assert crop.shape == (1, 3, 256, 256)
    assert crop.dtype == np.float32
    np.testing.assert_allclose(crop[0, :, 128, 128], [1.0, 0.0, 0.2], atol=1e-6)
    # A side of 1.25 x 200 px: the person fills 0.8 of its height and 0.4 of its width.
    red = crop[0, 0]
    assert red.mean() == pytest.approx(0.8 * 0.4, rel=0.01)
    np.testing.assert_allclose(red, red[::-1, ::-1], atol=1e-5)


def test_the_crop_of_a_person_at_the_edge_is_black_outside():
    picture = np.full((100, 100, 3), 255, np.uint8)
    crop = crop_person(picture, PersonBox(-50.0, 0.0, 50.0, 100.0))
    assert (crop[0, :, :, :60] == 0).all()
    assert crop[0, :, 128, 200].min() == 1.0
