"""The sampler draws from the distribution that its denoiser knows."""

from __future__ import annotations

import numpy as np
import pytest

from engine.pose.lifting.diffusion import N_STEPS, cosine_schedule, sample_postures, step_times


def test_schedule_falls_from_signal_to_noise():
    kept = cosine_schedule()
    assert kept.shape == (N_STEPS,)
    assert np.all(np.diff(kept) < 0)
    assert kept[0] > 0.999
    assert kept[-1] < 1e-4
    # Half of the variance is left in the middle (Nichol and Dhariwal 2021, Fig. 5).
    assert kept[N_STEPS // 2] == pytest.approx(0.5, abs=0.02)


def test_steps_go_from_the_noisiest_to_none():
    assert step_times(1000, 3).tolist() == [999, 665, 332, -1]
    assert step_times(1000, 1).tolist() == [999, -1]


def test_a_sure_denoiser_is_believed():
    truth = np.random.default_rng(0).uniform(-1, 1, (4, 9, 17, 3))
    found = sample_postures(lambda *_: truth, truth.shape, steps=3, rng=np.random.default_rng(1))
    assert np.array_equal(found, truth)


def test_impossible_places_are_cut_off():
    far = np.full((1, 2, 17, 3), 7.0)
    found = sample_postures(lambda *_: far, far.shape, steps=2, rng=np.random.default_rng(1))
    assert np.all(found == 1.1)


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_normal_distribution_is_drawn_with_its_mean_and_spread(eta):
    """For normal data the best denoiser is known in closed form (Wiener filter)."""
    mean, sd, kept = 0.3, 0.15, cosine_schedule()

    def denoise(noisy, step):
        a = kept[step]
        gain = np.sqrt(a) * sd**2 / (a * sd**2 + 1 - a)
        return mean + gain * (noisy - np.sqrt(a) * mean)

    found = sample_postures(denoise, (8000, 3), steps=400, rng=np.random.default_rng(2), eta=eta)
    assert found.mean() == pytest.approx(mean, abs=0.005)
    assert found.std() == pytest.approx(sd, rel=0.06)


def test_same_seed_same_postures():
    def denoise(noisy, step):
        return 0.5 * np.tanh(noisy) + step * 1e-4

    draws = [
        sample_postures(denoise, (2, 3, 17, 3), steps=4, rng=np.random.default_rng(seed))
        for seed in (5, 5, 6)
    ]
    assert np.array_equal(draws[0], draws[1])
    assert not np.allclose(draws[0], draws[2])
