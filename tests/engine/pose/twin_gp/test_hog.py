"""The descriptor must be scikit-image's, number for number, whatever the picture."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.feature import hog

from engine.errors import ConfigError, ShapeError
from engine.pose.twin_gp import HogSettings, compute_hog
from engine.pose.twin_gp.hog import compute_soft_hog


def reference(grey, cell_px=8):
    cells = (cell_px, cell_px)
    return hog(grey, 9, cells, (2, 2), block_norm="L2-Hys", transform_sqrt=False)


def smooth_picture(rng, shape):
    """A picture with soft shapes, whose gradients fall on all orientations."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    waves = sum(np.sin(a * x + b * y + c) for a, b, c in rng.uniform(-0.3, 0.3, (6, 3)))
    return np.clip(128 + 40 * waves, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shape", [(256, 128), (250, 131), (64, 64), (33, 17)], ids=str)
@pytest.mark.parametrize("kind", ["noise", "smooth", "edge", "even"])
def test_equals_scikit_image(shape, kind):
    rng = np.random.default_rng(3)
    grey = {
        "noise": lambda: rng.integers(0, 256, shape).astype(np.uint8),
        "smooth": lambda: smooth_picture(rng, shape),
        "edge": lambda: np.kron([[0, 255], [255, 7]], np.ones((shape[0], shape[1])))[
            : shape[0], : shape[1]
        ].astype(np.uint8),
        "even": lambda: np.full(shape, 90, np.uint8),
    }[kind]()
    np.testing.assert_allclose(compute_hog(grey), reference(grey), atol=3e-7)


def test_other_cells_equal_scikit_image():
    grey = smooth_picture(np.random.default_rng(0), (120, 160))
    np.testing.assert_allclose(compute_hog(grey, cell_px=16), reference(grey, 16), atol=3e-7)


def test_length_is_that_of_the_paper():
    assert HogSettings(size_px=None).length((720, 480)) == 189_036
    assert HogSettings().length((128, 256)) == compute_hog(np.zeros((256, 128), np.uint8)).size


@pytest.mark.parametrize("bad", [np.zeros((64, 64)), np.zeros((64, 64, 3), np.uint8)], ids=str)
def test_only_grey_pictures_of_8_bits(bad):
    with pytest.raises(ShapeError, match="grey picture"):
        compute_hog(bad)


def test_a_picture_too_small_says_so():
    with pytest.raises(ConfigError, match="too small"):
        compute_hog(np.zeros((15, 40), np.uint8))
    with pytest.raises(ConfigError, match="at least 2 px"):
        HogSettings(cell_px=1)


class TestSoft:
    def test_length_and_order_are_those_of_the_plain_kind(self):
        # A picture that lights up in one corner: the same blocks are filled.
        grey = np.zeros((64, 64), np.uint8)
        grey[8:24, 8:24] = smooth_picture(np.random.default_rng(1), (16, 16))
        soft = compute_soft_hog(grey, cell_px=8, noise_floor=1.0).reshape(7, 7, 36)
        plain = compute_hog(grey).reshape(7, 7, 36)
        filled = plain.max(axis=2) > 0.05
        assert soft.shape == plain.shape
        assert (soft.max(axis=2)[filled] > 0.01).all()
        assert soft[5:, 5:].max() == 0.0

    def test_moves_less_than_the_plain_kind_when_the_picture_moves_by_a_pixel(self):
        picture = smooth_picture(np.random.default_rng(2), (129, 129))
        here, there = picture[:128, :128], picture[1:, 1:]

        def change(describe):
            one, other = describe(here), describe(there)
            return np.linalg.norm(one - other) / np.linalg.norm(one)

        assert change(compute_soft_hog) < 0.5 * change(lambda g: compute_hog(g, cell_px=16))

    def test_codec_noise_on_an_even_wall_counts_for_little(self):
        rng = np.random.default_rng(3)
        one, other = (
            np.full((128, 64), 90 + rng.integers(0, 3, (128, 64)), np.uint8) for _ in "ab"
        )
        assert np.linalg.norm(compute_hog(one) - compute_hog(other)) > 3.0
        assert np.linalg.norm(compute_soft_hog(one) - compute_soft_hog(other)) < 0.3

    def test_an_edge_votes_for_both_orientations_it_lies_between(self):
        # A vertical edge has orientation 0, between the last bin and the first.
        grey = np.zeros((32, 32), np.uint8)
        grey[:, 16:] = 200
        cells = compute_soft_hog(grey, cell_px=16, noise_floor=1.0).reshape(4, 9)
        np.testing.assert_allclose(cells[:, 0], cells[:, 8], rtol=1e-6)
        assert cells[:, 1:8].max() == 0.0

    def test_settings_that_make_no_sense(self):
        with pytest.raises(ConfigError, match="multiple of 4 px and a noise floor above 0"):
            HogSettings(cell_px=10, noise_floor=5.0)
        with pytest.raises(ConfigError, match="noise floor"):
            HogSettings(cell_px=16, noise_floor=0.0)
