from __future__ import annotations

import numpy as np
import pytest

from engine.pose.twin_gp.kernels import (
    compute_kernel,
    compute_square_distances,
    find_median_square,
)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("width", [7, 5000], ids=["narrow", "wide"])
def test_distances_are_those_of_all_pairs(dtype, width):
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=(n, width)).astype(dtype) + 3 for n in (5, 6))
    brute = ((a[:, None].astype(float) - b[None].astype(float)) ** 2).sum(axis=2)
    np.testing.assert_allclose(compute_square_distances(a, b), brute, rtol=1e-5)
    assert (np.diagonal(compute_square_distances(a)) == 0).all()


def test_the_kernel_of_near_equal_rows_stays_positive():
    """A standing person: hundreds of frames that differ in the fifth digit."""
    rng = np.random.default_rng(1)
    rows = (1 + 1e-5 * rng.normal(size=(300, 80))).astype(np.float32)
    kernel = compute_kernel(compute_square_distances(rows), 0.01)
    assert np.linalg.eigvalsh(kernel).min() > -1e-9


def test_the_median_leaves_out_the_diagonal():
    points = np.array([[0.0], [1.0], [3.0]])
    assert find_median_square(compute_square_distances(points)) == pytest.approx(4.0)
