"""The descriptor must be scikit-image's, number for number, whatever the picture."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.feature import hog

from engine.errors import ConfigError, ShapeError
from engine.pose.twin_gp import HogSettings, compute_hog


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
