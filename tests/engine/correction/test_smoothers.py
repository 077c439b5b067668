import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.correction.kalman import KalmanSmoother, estimate_noise
from engine.correction.smoothers import (
    Butterworth,
    Hampel,
    Median,
    OneEuro,
    SavitzkyGolay,
    Unsmoothed,
    smooth_runs,
)

TIME_S = np.arange(180) / 30
SMOOTHERS = [Butterworth(), SavitzkyGolay(), Median(), Hampel(), OneEuro(), Unsmoothed()]
IDS = [type(s).__name__ for s in SMOOTHERS]


def swing(hz=0.5):
    return np.stack([np.sin(2 * np.pi * hz * TIME_S), np.cos(2 * np.pi * hz * TIME_S)], axis=1)


@pytest.mark.parametrize("smoother", SMOOTHERS, ids=IDS)
class TestAll:
    def test_a_constant_stays(self, smoother):
        for n in (1, 2, 3, 5, 30):
            values = np.full((n, 2), 3.0)
            assert np.allclose(smoother.smooth(TIME_S[:n], values), values)

    def test_slow_motion_passes(self, smoother):
        lag_free = 0.02 if not isinstance(smoother, OneEuro) else 0.15
        assert np.abs(smoother.smooth(TIME_S, swing(0.3)) - swing(0.3)).max() < lag_free

    def test_moving_and_scaling_commute(self, smoother):
        # The one-Euro filter's cut-off rises with the speed in m/s: it may move, but not scale.
        factor = 1.0 if isinstance(smoother, OneEuro) else 3.0
        noisy = swing() + 0.05 * np.random.default_rng(0).standard_normal((180, 2))
        once = smoother.smooth(TIME_S, noisy)
        again = smoother.smooth(TIME_S, factor * noisy + 7.0)
        assert np.allclose(again, factor * once + 7.0)

    def test_uneven_times(self, smoother):
        time_s = np.cumsum(np.random.default_rng(1).uniform(0.02, 0.05, 180))
        values = np.sin(2 * np.pi * 0.3 * time_s)[:, None]
        limit = 0.15 if isinstance(smoother, OneEuro) else 0.03
        assert np.abs(smoother.smooth(time_s, values) - values).max() < limit

    def test_gaps_stay_gaps(self, smoother):
        position = np.repeat(swing()[:, None], 3, axis=1)
        position[20:30, 1] = np.nan
        position[:, 2] = np.nan
        smoothed = smooth_runs(smoother, TIME_S, position)
        assert np.array_equal(np.isnan(smoothed), np.isnan(position))


@pytest.mark.parametrize("smoother", SMOOTHERS[:3], ids=IDS[:3])
def test_noise_becomes_less(smoother):
    noise = 0.05 * np.random.default_rng(0).standard_normal((180, 2))
    left = smoother.smooth(TIME_S, swing() + noise) - swing()
    assert left[10:-10].std() < 0.85 * noise.std()


def test_savitzky_golay_keeps_a_cubic_exactly():
    cubic = (TIME_S**3 - 4 * TIME_S**2 + TIME_S)[:, None]
    assert np.allclose(SavitzkyGolay().smooth(TIME_S, cubic), cubic)


def test_the_median_has_an_odd_window_that_keeps_its_duration():
    spike = np.zeros((180, 1))
    spike[50:52] = 1.0
    assert not Median(5 / 30).smooth(TIME_S, spike).any()
    spike[50:53] = 1.0
    assert Median(5 / 30).smooth(TIME_S, spike).any()
    fast_s = np.arange(180) / 120
    wide = np.zeros((180, 1))
    wide[50:58] = 1.0
    assert not Median(5 / 30).smooth(fast_s, wide).any()


def test_hampel_replaces_the_outlier_alone():
    values = swing() + 0.01 * np.random.default_rng(0).standard_normal((180, 2))
    spoilt = values.copy()
    spoilt[90] += 1.0
    smoothed = Hampel().smooth(TIME_S, spoilt)
    assert np.abs(smoothed[90] - values[90]).max() < 0.15
    assert (smoothed[60:85] == spoilt[60:85]).mean() > 0.9


def test_one_euro_uses_only_the_past():
    values = swing() + 0.05 * np.random.default_rng(0).standard_normal((180, 2))
    later = values.copy()
    later[100:] += 9.0
    smoothed = OneEuro().smooth(TIME_S, values)
    assert np.array_equal(OneEuro().smooth(TIME_S, later)[:100], smoothed[:100])


def test_one_euro_agrees_with_its_published_recursion():
    # By hand: cut-off 1 Hz, no speed term, steps of 0.1 s: alpha = 1 / (1 + 1 / (2 pi 0.1)).
    alpha = 1.0 / (1.0 + 1.0 / (2.0 * np.pi * 0.1))
    smoothed = OneEuro(min_cutoff_hz=1.0, beta=0.0).smooth(
        np.arange(3) / 10, np.array([[0.0], [1.0], [1.0]])
    )
    assert np.allclose(smoothed[:, 0], [0.0, alpha, alpha + alpha * (1 - alpha)])


class TestKalman:
    def smooth(self, position, **settings):
        known = np.full(position.shape[:2], np.nan)
        return KalmanSmoother(**settings).smooth(TIME_S[: len(position)], position, known)

    def test_agrees_with_the_least_squares_solution(self):
        # The smoother is the minimum of a sum of squares, here solved all at once by hand.
        rng = np.random.default_rng(4)
        n, h, q = 12, 1.0 / 30, 15.0**2
        measured = rng.standard_normal((n, 1, 2)) * 0.01
        noise = estimate_noise(measured)[0, 0] ** 2
        move = np.array([[1, h, h * h / 2], [0, 1, h], [0, 0, 1]])
        drive = q * np.array(
            [
                [h**5 / 20, h**4 / 8, h**3 / 6],
                [h**4 / 8, h**3 / 3, h**2 / 2],
                [h**3 / 6, h**2 / 2, h],
            ]
        )
        rows, goals = [], []
        start = np.diag(1.0 / np.array([1.0, 3.0, 30.0]))
        rows.append(np.hstack([start, np.zeros((3, 3 * n - 3))]))
        first = np.zeros((3, 2))
        first[0] = measured[0, 0]
        goals.append(start @ first)
        root = np.linalg.cholesky(np.linalg.inv(drive)).T
        for t in range(n):
            row = np.zeros((1, 3 * n))
            row[0, 3 * t] = 1.0 / np.sqrt(noise)
            rows.append(row)
            goals.append(measured[t] / np.sqrt(noise))
            if t:
                step = np.zeros((3, 3 * n))
                step[:, 3 * t : 3 * t + 3], step[:, 3 * t - 3 : 3 * t] = root, -root @ move
                rows.append(step)
                goals.append(np.zeros((3, 2)))
        a = np.vstack(rows)
        expected = np.linalg.lstsq(a, np.vstack(goals), rcond=None)[0][::3]
        variance = np.linalg.inv(a.T @ a).diagonal()[::3]
        path = self.smooth(measured)
        np.testing.assert_allclose(path.position[:, 0], expected, atol=1e-9)
        np.testing.assert_allclose(path.sigma[:, 0], np.sqrt(variance), rtol=1e-6)

    def test_the_noise_is_found_in_spite_of_the_motion(self):
        rng = np.random.default_rng(0)
        time_s = np.arange(900) / 30
        motion = 0.3 * np.sin(2 * np.pi * 1.0 * time_s)[:, None, None]
        noise = rng.standard_normal((900, 3, 3)) * np.array([0.002, 0.01, 0.03])[None, :, None]
        assert np.allclose(estimate_noise(motion + noise)[0], [0.002, 0.01, 0.03], rtol=0.15)

    def test_a_noisy_keypoint_is_smoothed_more(self):
        rng = np.random.default_rng(0)
        noise = rng.standard_normal((180, 2, 2)) * np.array([0.001, 0.02])[None, :, None]
        left = self.smooth(swing()[:, None] * 0.2 + noise).position - swing()[:, None] * 0.2
        share = left.std(axis=(0, 2)) / np.array([0.001, 0.02])
        assert share[1] < 0.5 < share[0] + 0.3

    def test_a_gap_is_bridged_along_the_motion_with_a_wider_error(self):
        position = 0.2 * swing()[:, None]
        broken = position.copy()
        broken[80:90] = np.nan
        path = self.smooth(broken)
        assert np.abs(path.position - position)[80:90].max() < 0.01
        assert path.sigma[85, 0] > 5 * path.sigma[40, 0]
        assert (path.sigma[85] > path.sigma[81]).all()

    def test_a_gate_leaves_out_a_wild_sample_only(self):
        position = 0.2 * swing()[:, None] + 0.005 * np.random.default_rng(1).standard_normal(
            (180, 1, 2)
        )
        spoilt = position.copy()
        spoilt[100] += 0.5
        path = self.smooth(spoilt, gate_probability=0.999)
        assert np.flatnonzero(path.is_gated).tolist() == [100]
        assert np.abs(path.position[100] - position[100]).max() < 0.05
        assert not self.smooth(spoilt).is_gated.any()

    def test_a_sudden_start_passes_the_gate(self):
        position = np.zeros((120, 1, 2))
        position[60:, 0, 0] = 3.0 * np.arange(60) / 30
        position += 0.003 * np.random.default_rng(1).standard_normal(position.shape)
        assert not self.smooth(position, gate_probability=0.999).is_gated.any()

    def test_never_seen_stays_unknown(self):
        position = np.repeat(0.2 * swing()[:, None], 2, axis=1)
        position[:, 1] = np.nan
        path = self.smooth(position)
        assert np.isnan(path.position[:, 1]).all()
        assert np.isfinite(path.position[:, 0]).all()

    @given(st.integers(1, 8))
    def test_few_frames(self, n):
        path = self.smooth(np.full((n, 2, 3), 1.5))
        assert np.allclose(path.position, 1.5)
