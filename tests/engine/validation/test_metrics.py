import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import procrustes
from scipy.spatial.transform import Rotation

from engine.errors import ConfigError, DataError, ShapeError
from engine.validation.metrics import ALIGNMENTS, align_poses, compare_poses

NAMES = tuple(f"joint_{k}" for k in range(12))
TIME = np.arange(30) / 30


def poses(seed=0, n_frames=30, n_joints=12):
    return np.random.default_rng(seed).normal(0, 0.4, (n_frames, n_joints, 3))


def compare(estimated, reference, alignment="none", **options):
    return compare_poses(
        TIME[: len(estimated)],
        estimated,
        reference,
        names=NAMES[: np.shape(estimated)[1]],
        alignment=alignment,
        root=(0, 1),
        **options,
    )


def transform(points, seed):
    """A different similarity transform in every frame."""
    rng = np.random.default_rng(seed)
    n = len(points)
    turn = Rotation.random(n, random_state=seed).as_matrix()
    scale, shift = rng.uniform(0.5, 2, (n, 1, 1)), rng.normal(size=(n, 1, 3))
    return scale * points @ np.swapaxes(turn, 1, 2) + shift


def test_a_known_shift_is_the_error_without_alignment():
    found = compare(poses() + np.array([0.03, 0.04, 0.0]), poses())
    assert (found.mpjpe_mm, found.frame_mean_mm) == pytest.approx((50, 50))
    assert found.frame_sd_mm == pytest.approx(0, abs=1e-9)
    assert (found.n_samples, found.n_frames) == (360, 30)
    assert found.mpjve_mm_s == pytest.approx(0, abs=1e-9)
    assert {joint.name for joint in found.joints} == set(NAMES)
    assert all(joint.mean_mm == pytest.approx(50) for joint in found.joints)


def test_root_alignment_removes_a_shift_and_scale_alignment_a_size():
    assert compare(poses() + 0.3, poses(), "root").mpjpe_mm == pytest.approx(0, abs=1e-9)
    assert compare(1.3 * poses() + 0.3, poses(), "root").mpjpe_mm > 50
    assert compare(1.3 * poses() + 0.3, poses(), "scale").mpjpe_mm == pytest.approx(0, abs=1e-9)


def test_the_scale_is_the_best_one():
    estimated, reference = poses(1) * 0.7 + 0.1, poses(1) + 0.05 * poses(2)
    centred = estimated - estimated[:, :2].mean(axis=1, keepdims=True)
    target = reference - reference[:, :2].mean(axis=1, keepdims=True)
    residual = np.square(best_fit(centred, target) - target).sum()
    for factor in (0.98, 1.02):
        assert np.square(factor * best_fit(centred, target) - target).sum() > residual
    aligned = align_poses(estimated, reference, "scale", root=(0, 1))
    root = reference[:, :2].mean(axis=1, keepdims=True)
    assert aligned - root == pytest.approx(best_fit(centred, target))


def best_fit(centred, target):
    return np.stack(
        [np.linalg.lstsq(c.reshape(-1, 1), t.ravel(), rcond=None)[0] * c
         for c, t in zip(centred, target, strict=True)]
    )  # fmt: skip


@given(st.integers(0, 500))
def test_procrustes_removes_any_similarity(seed):
    found = compare(transform(poses(seed), seed), poses(seed), "procrustes")
    assert found.mpjpe_mm == pytest.approx(0, abs=1e-6)


@given(st.integers(0, 500))
def test_procrustes_does_not_see_how_the_estimate_lies(seed):
    estimated = poses(seed) + 0.1 * poses(seed + 1000)
    plain = compare(estimated, poses(seed), "procrustes").mpjpe_mm
    assert compare(transform(estimated, seed), poses(seed), "procrustes").mpjpe_mm == (
        pytest.approx(plain)
    )


def test_procrustes_agrees_with_scipy():
    """SciPy's disparity is the residual of the same fit, relative to the reference's size."""
    reference, estimated = poses(3), poses(3) + 0.05 * poses(4)
    aligned = align_poses(estimated, reference, "procrustes")
    for a, e, r in zip(aligned, estimated, reference, strict=True):
        size = np.square(r - r.mean(axis=0)).sum()
        assert np.square(a - r).sum() / size == pytest.approx(procrustes(r, e)[2])


def test_procrustes_does_not_mirror():
    """A swap of left and right is an error: the mirror image must not fit."""
    reference = poses(5)
    mirrored = reference * [1, 1, -1]
    found = compare(mirrored, reference, "procrustes")
    assert found.mpjpe_mm > 50
    aligned = align_poses(mirrored, reference, "procrustes")
    brute = [
        procrustes_by_rotations(m, r) for m, r in zip(mirrored[:3], reference[:3], strict=True)
    ]
    for a, r, expected in zip(aligned[:3], reference[:3], brute, strict=True):
        assert np.square(a - r).sum() <= expected + 1e-9


def procrustes_by_rotations(source, target, n=3000):
    """The best of many random rotations, each with its own best scale."""
    x, y = source - source.mean(axis=0), target - target.mean(axis=0)
    turned = x @ Rotation.random(n, random_state=0).as_matrix()
    # A negative scale would mirror.
    scale = np.maximum(np.einsum("nij,ij->n", turned, y), 0) / np.square(x).sum()
    return np.square(scale[:, None, None] * turned - y).sum(axis=(1, 2)).min()


def test_procrustes_leaves_out_missing_joints():
    reference = poses(6)
    estimated = transform(reference, 1)
    estimated[4, 3] = np.nan
    estimated[5, :10] = np.nan
    reference[7, 2, 1] = np.nan
    found = compare(estimated, reference, "procrustes")
    assert found.mpjpe_mm == pytest.approx(0, abs=1e-6)
    assert found.n_frames == 29
    assert found.n_samples == 29 * 12 - 2


def test_alignments_can_only_lower_the_squared_error():
    reference, estimated = poses(8), poses(8) * 1.1 + 0.04 * poses(9) + 0.2
    squares = [
        np.square(align_poses(estimated, reference, a, root=range(12)) - reference).sum()
        for a in ALIGNMENTS
    ]
    assert squares == sorted(squares, reverse=True)


def test_velocity_error_is_per_second_by_the_true_times():
    reference = poses(0)
    drift = np.zeros_like(reference)
    times = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.1, 30))
    drift[..., 0] = 0.12 * times[:, None]
    found = compare_poses(times, reference + drift, reference, names=NAMES, alignment="none")
    assert found.mpjve_mm_s == pytest.approx(120)
    assert found.n_velocities == 29 * 12


def test_velocity_needs_both_frames():
    estimated = poses(0)
    estimated[10] = np.nan
    assert compare(estimated, poses(0)).n_velocities == 27 * 12


def test_pck_and_auc_of_known_distances():
    """Distances 1, 2, ... 300 mm: half within 150, and a quarter on average over the steps."""
    reference = np.zeros((300, 1, 3))
    estimated = reference.copy()
    estimated[:, 0, 1] = np.arange(1, 301) / 1000
    found = compare_poses(np.arange(300.0), estimated, reference, names=["a"], alignment="none")
    assert found.pck_percent == pytest.approx(50)
    assert found.auc_percent == pytest.approx(25)
    assert (found.median_mm, found.joints[0].max_mm) == pytest.approx((150.5, 300))
    same = compare(poses(), poses())
    assert (same.pck_percent, same.auc_percent) == (100, 100)


def test_frame_mean_weights_frames_and_mpjpe_samples():
    reference, estimated = np.zeros((2, 2, 3)), np.zeros((2, 2, 3))
    estimated[0, :, 0] = 0.1
    estimated[1, 0, 0] = 0.04
    estimated[1, 1] = np.nan
    found = compare(estimated, reference)
    assert found.mpjpe_mm == pytest.approx(80)
    assert found.frame_mean_mm == pytest.approx(70)
    assert found.frame_sd_mm == pytest.approx(np.std([100, 40], ddof=1))


def test_two_dimensions_work_as_well():
    reference = poses()[..., :2]
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()[:2, :2]
    assert compare(2 * reference @ turn + 1, reference, "procrustes").mpjpe_mm < 1e-6


def test_nothing_in_common_is_nan():
    found = compare(np.full((30, 12, 3), np.nan), poses(), "procrustes")
    assert (found.n_samples, found.n_frames) == (0, 0)
    assert math.isnan(found.mpjpe_mm)
    assert math.isnan(found.auc_percent)


def test_the_alignment_is_named():
    assert "Procrustes" in compare(poses(), poses(), "procrustes").description


def test_wrong_calls_are_refused():
    with pytest.raises(ShapeError, match="order of joints"):
        compare(poses(), poses(n_joints=11))
    with pytest.raises(ShapeError, match="2 or 3"):
        align_poses(np.zeros((3, 4)), np.zeros((3, 4)), "none")
    with pytest.raises(ConfigError, match="known: none, root"):
        align_poses(poses(), poses(), "affine")
    with pytest.raises(ConfigError, match="root"):
        align_poses(poses(), poses(), "root")
    with pytest.raises(DataError, match="increase"):
        compare_poses(np.zeros(30), poses(), poses(), names=NAMES, alignment="none")
    with pytest.raises(ShapeError, match="12 names"):
        compare_poses(TIME, poses(), poses(), names=["a"], alignment="none")
