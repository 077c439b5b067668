"""uDEAS: the lock-step search is the literal algorithm, and it finds known minima."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.errors import ConfigError, ShapeError
from engine.kinematics.fitting._dynamic_encoding import (
    FunctionCost,
    decode,
    draw_codes,
    minimise,
    search,
)


def literal_search(cost, lower, upper, codes, first_bits, last_bits, *, by_sensitivity):
    """The pseudo-code of the paper, one search, one evaluation at a time."""
    codes = [int(k) for k in codes]
    length = [first_bits] * len(codes)
    order = list(range(len(codes)))
    visited = []

    def value(i, code, bits):
        return lower[i] + (upper[i] - lower[i]) * code / (2**bits - 1)

    def evaluate(i, code, bits):
        point = [value(j, codes[j], length[j]) for j in range(len(codes))]
        point[i] = value(i, code, bits)
        visited.append(point)
        return cost(point)

    level = math.nan
    for bits in range(first_bits, last_bits):
        sensitivity = [0.0] * len(codes)
        for i in order:
            zero, one = 2 * codes[i], 2 * codes[i] + 1
            cost_zero, cost_one = evaluate(i, zero, bits + 1), evaluate(i, one, bits + 1)
            width = (upper[i] - lower[i]) / (2 ** (bits + 1) - 1)
            total, successes = abs(cost_one - cost_zero) / width, 0
            if cost_one < cost_zero:
                code, level, direction = one, cost_one, 1
            else:
                code, level, direction = zero, cost_zero, -1
            while 0 <= code + direction <= 2 ** (bits + 1) - 1:
                trial = evaluate(i, code + direction, bits + 1)
                if not trial < level:
                    break
                total += abs(level - trial) / width
                successes += 1
                code, level = code + direction, trial
            codes[i], length[i] = code, bits + 1
            sensitivity[i] = total / (successes + 1)
        if by_sensitivity:
            order = sorted(order, key=lambda i: (-sensitivity[i], i))
    return codes, level, visited


def valley(points):
    """A narrow bent valley in four variables; the minimum 0 is at (1, 1, 1, 1)."""
    points = np.atleast_2d(points)
    a, b = points[:, :-1], points[:, 1:]
    return (20 * (b - a**2) ** 2 + (1 - a) ** 2).sum(axis=1)


LOWER, UPPER = np.array([-2.0, -1.5, -2.0, -1.0]), np.array([2.0, 2.5, 1.8, 3.0])


class TestAgainstTheLiteralAlgorithm:
    @pytest.mark.parametrize("by_sensitivity", [False, True], ids=["natural", "sensitivity"])
    @given(seed=st.integers(0, 2**32 - 1))
    @settings(max_examples=25, deadline=None)
    def test_one_search_asks_for_the_same_points_in_the_same_order(self, by_sensitivity, seed):
        start = draw_codes(np.random.default_rng(seed), 1, 4, bits=3)
        asked = []

        def record(points, _owner):
            asked.extend(points)
            return valley(points)

        found = search(
            FunctionCost(record), LOWER, UPPER, start, last_bits=8, by_sensitivity=by_sensitivity
        )
        codes, level, visited = literal_search(
            lambda p: float(valley(p)[0]),
            LOWER,
            UPPER,
            start[0],
            3,
            8,
            by_sensitivity=by_sensitivity,
        )
        assert np.allclose(asked, visited, rtol=0, atol=1e-12)
        assert found.codes[0].tolist() == codes
        assert found.cost[0] == pytest.approx(level, abs=1e-12)
        assert found.n_evaluations[0] == len(visited)

    @pytest.mark.parametrize("by_sensitivity", [False, True], ids=["natural", "sensitivity"])
    def test_searches_in_lock_step_end_where_each_would_alone(self, by_sensitivity):
        start = draw_codes(np.random.default_rng(3), 60, 4, bits=2)
        lower = LOWER + np.linspace(0, 0.5, 60)[:, None]
        options = {"first_bits": 2, "last_bits": 9, "by_sensitivity": by_sensitivity}
        found = search(
            FunctionCost(lambda p, _: valley(p)), lower, np.tile(UPPER, (60, 1)), start, **options
        )
        for i in range(60):
            codes, level, visited = literal_search(
                lambda p: float(valley(p)[0]),
                lower[i],
                UPPER,
                start[i],
                2,
                9,
                by_sensitivity=by_sensitivity,
            )
            assert found.codes[i].tolist() == codes
            assert found.cost[i] == pytest.approx(level, abs=1e-12)
            assert found.n_evaluations[i] == len(visited)

    def test_the_order_matters(self):
        """Otherwise the two tests above would not tell the orderings apart."""
        start = draw_codes(np.random.default_rng(0), 40, 4)
        cost = FunctionCost(lambda p, _: valley(p))
        natural = search(cost, LOWER, UPPER, start)
        sensitive = search(cost, LOWER, UPPER, start, by_sensitivity=True)
        assert (natural.codes != sensitive.codes).any()

    def test_every_search_knows_its_own_cost(self):
        """Each search has another target: its number must travel with its points."""
        targets = np.linspace(-0.9, 0.9, 7)

        def distance(points, owner):
            return np.abs(points - targets[owner][:, None]).sum(axis=1)

        start = draw_codes(np.random.default_rng(1), 7, 3)
        for by_sensitivity in (False, True):
            found = search(
                FunctionCost(distance),
                -np.ones(3),
                np.ones(3),
                start,
                by_sensitivity=by_sensitivity,
            )
            half_step = 1 / (2**10 - 1)
            assert np.abs(found.values - targets[:, None]).max() <= half_step + 1e-12


class TestEncoding:
    @given(bits=st.integers(1, 20), data=st.data())
    def test_appending_a_bit_moves_the_value_down_or_up(self, bits, data):
        code = np.int64(data.draw(st.integers(0, 2**bits - 1)))
        parent = decode(code, -1.0, 3.0, bits)
        assert decode(2 * code, -1.0, 3.0, bits + 1) <= parent + 1e-12
        assert decode(2 * code + 1, -1.0, 3.0, bits + 1) >= parent - 1e-12

    def test_the_ends_of_a_row_are_the_bounds(self):
        assert decode(np.array([0, 7]), -2.0, 5.0, 3).tolist() == [-2.0, 5.0]


class TestMinima:
    @given(
        st.lists(st.floats(-0.99, 0.99), min_size=1, max_size=6),
        st.integers(0, 2**32 - 1),
    )
    @settings(max_examples=40, deadline=None)
    def test_a_separable_bowl_is_found_to_half_a_step_from_any_start(self, centre, seed):
        centre = np.array(centre)
        start = draw_codes(np.random.default_rng(seed), 3, centre.size)
        bowl = FunctionCost(lambda p, _: ((p - centre) ** 2).sum(axis=1))
        ones = np.ones(centre.size)
        found = search(bowl, -ones, ones, start, last_bits=12)
        assert np.abs(found.values - centre).max() <= 1 / (2**12 - 1) + 1e-9

    @pytest.mark.parametrize("by_sensitivity", [False, True])
    def test_many_local_minima(self, by_sensitivity):
        """Rastrigin's function: 11 minima a variable, the best at 0.3."""

        def rastrigin(points):
            shifted = points - 0.3
            return (shifted**2 + 10 * (1 - np.cos(2 * np.pi * shifted))).sum(axis=1)

        low, high = np.full(3, -5.12), np.full(3, 5.12)
        best, cost = minimise(
            rastrigin, low, high, restarts=300, last_bits=14, by_sensitivity=by_sensitivity
        )
        assert np.abs(best - 0.3).max() < 2e-3
        assert cost < 1e-3

    def test_the_best_restart_wins_and_a_seed_repeats(self):
        options = {"restarts": 50, "seed": 4}
        best, cost = minimise(valley, LOWER, UPPER, **options)
        again, same = minimise(valley, LOWER, UPPER, **options)
        few = minimise(valley, LOWER, UPPER, restarts=1, seed=4)
        assert cost == same == pytest.approx(valley(best)[0])
        assert np.array_equal(best, again)
        assert cost <= few[1]

    def test_a_minimum_outside_the_range_ends_at_the_bound(self):
        best, _ = minimise(lambda p: ((p - 9) ** 2).sum(axis=1), -np.ones(2), np.ones(2))
        assert best.tolist() == [1.0, 1.0]

    def test_a_variable_without_a_range_stays(self):
        low = np.array([-1.0, 0.25])
        high = np.array([1.0, 0.25])
        best, _ = minimise(lambda p: ((p - 0.5) ** 2).sum(axis=1), low, high, by_sensitivity=True)
        assert best[1] == 0.25
        assert best[0] == pytest.approx(0.5, abs=1e-3)

    def test_a_cost_that_is_not_a_number_never_wins(self):
        def broken(points):
            return np.where(points[:, 0] > 0, np.nan, points[:, 0] ** 2)

        best, cost = minimise(broken, np.array([-1.0]), np.array([1.0]), restarts=30)
        assert best[0] <= 0
        assert math.isfinite(cost)


class TestWrongCalls:
    @pytest.mark.parametrize(("first", "last"), [(0, 5), (5, 5), (6, 5), (3, 99)])
    def test_lengths_of_rows(self, first, last):
        with pytest.raises(ConfigError, match="Rows must grow"):
            minimise(valley, LOWER, UPPER, first_bits=first, last_bits=last)

    def test_bounds_of_another_shape(self):
        start = draw_codes(np.random.default_rng(0), 2, 4)
        with pytest.raises(ShapeError, match=r"upper bounds need shape \(4,\)"):
            search(FunctionCost(lambda p, _: valley(p)), LOWER, UPPER[:3], start)

    def test_bounds_the_wrong_way_round(self):
        with pytest.raises(ConfigError, match="at most its upper bound"):
            minimise(valley, UPPER, LOWER)
