"""Composite, variable and sequential indices: the document's vectors and their properties."""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from engine.ergonomics.lifting_equation import Duration, compute_frequency_multiplier
from engine.ergonomics.lifting_job import (
    LiftingTask,
    TaskSet,
    compute_cli,
    compute_sli,
    compute_vli,
)
from engine.errors import DataError

SHORT, MODERATE, LONG = Duration.SHORT, Duration.MODERATE, Duration.LONG


def build_task(load, frequency, firwl=20.0, V=60.0, name="task", mean=None):
    return LiftingTask(name, firwl, V, frequency, load if mean is None else mean, load)


class TestCli:
    THREE = (
        build_task(20, 2, name="1"),
        build_task(30, 1, name="2"),
        build_task(10, 4, firwl=15, name="3"),
    )

    def test_three_tasks_of_the_manual(self):
        found = compute_cli(self.THREE, SHORT)
        assert [index.task.name for index in found.tasks] == ["2", "1", "3"]
        for index, (fm, strwl, fili, stli) in zip(
            found.tasks,
            [
                (0.94, 18.8, 1.50, 1.596),
                (0.91, 18.2, 1.00, 1.099),
                (0.84, 12.6, 0.667, 0.794),
            ],
            strict=True,
        ):
            assert pytest.approx(fm) == index.FM
            assert pytest.approx(strwl) == index.STRWL_kg
            assert pytest.approx(fili, abs=1e-3) == index.FILI
            assert pytest.approx(stli, abs=1e-3) == index.STLI
        assert found.value == pytest.approx(1.863, abs=1e-3)
        assert found.value == pytest.approx(sum(index.increment for index in found.tasks))

    def test_order_of_entry_does_not_matter(self):
        assert compute_cli(self.THREE[::-1], SHORT).value == compute_cli(self.THREE, SHORT).value

    def test_largest_load_sets_fili_and_mean_load_stli(self):
        index = compute_cli([build_task(30, 1, mean=15)], SHORT).tasks[0]
        assert pytest.approx(1.5) == index.FILI
        assert pytest.approx(15 / 18.8) == index.STLI

    def test_ties_put_the_higher_frequency_first(self):
        tasks = [
            build_task(9.4, 1, firwl=10, name="slow"),
            build_task(8.4, 4, firwl=10, name="fast"),
        ]
        found = compute_cli(tasks, SHORT)
        assert pytest.approx(found.tasks[1].STLI) == found.tasks[0].STLI
        assert [index.task.name for index in found.tasks] == ["fast", "slow"]

    def test_too_many_lifts_together_are_infinite(self):
        found = compute_cli([build_task(5, 7), build_task(5, 7)], SHORT)
        assert found.value == math.inf

    def test_nothing_may_be_lifted_is_infinite(self):
        assert compute_cli([build_task(5, 1, firwl=0.0)], SHORT).value == math.inf

    def test_zero_frequency_counts_as_rare(self):
        found = compute_cli([build_task(20, 0.0), build_task(10, 0.0)], LONG)
        assert found.value == pytest.approx(1 / 0.85)

    def test_unknown_load_is_unknown(self):
        assert math.isnan(compute_cli([build_task(math.nan, 1)], SHORT).value)

    @given(
        n=st.integers(1, 9),
        frequency=st.floats(0.2, 8.0),
        duration=st.sampled_from(list(Duration)),
        V=st.sampled_from([30.0, 90.0]),
    )
    def test_splitting_one_task_into_equal_parts_changes_nothing(self, n, frequency, duration, V):
        """The terms telescope: FILI / FM of the whole frequency."""
        # Rates below 0.2 count as 0.2, so parts must not be rarer than that.
        assume(frequency / n >= 0.2)
        parts = [build_task(10, frequency / n, V=V) for _ in range(n)]
        expected = 0.5 / float(compute_frequency_multiplier(frequency, duration, V))
        assert compute_cli(parts, duration).value == pytest.approx(expected)

    @given(st.lists(st.tuples(st.floats(1, 30), st.floats(0.2, 3)), min_size=1, max_size=6))
    def test_a_job_is_never_better_than_its_worst_task(self, rows):
        tasks = [build_task(load, rate) for load, rate in rows]
        found = compute_cli(tasks, LONG)
        assert found.value >= max(index.STLI for index in found.tasks) - 1e-9

    def test_wrong_input_is_named(self):
        with pytest.raises(DataError, match="at least one"):
            compute_cli([], SHORT)
        with pytest.raises(DataError, match="can't be negative"):
            build_task(-1.0, 1)
        with pytest.raises(DataError, match="above the largest"):
            build_task(10.0, 1, mean=11.0)


class TestVli:
    @pytest.mark.parametrize(
        ("fili", "frequency", "duration", "expected"),
        [
            ((1.0,) * 6, 3, LONG, 1.8182),
            ((0.4, 0.6, 0.8, 1.0, 1.2, 1.5), 3, LONG, 2.2910),
            ((0.4, 0.6, 0.8, 1.0, 1.2, 1.5), 6, MODERATE, 2.2433),
            ((0.4, 0.6, 0.8, 1.0, 1.2, 1.5), 12, LONG, math.inf),
            ((0.5, 0.5, 0.7, 0.9, 1.1, 2.0), 1.2, LONG, 2.4957),
        ],
    )
    def test_vectors(self, fili, frequency, duration, expected):
        assert compute_vli(fili, frequency, duration) == pytest.approx(expected, abs=1e-4)

    @given(st.floats(0.1, 3.0), st.integers(1, 40))
    def test_equal_lifts_are_one_over_the_multiplier(self, fili, n):
        found = compute_vli([fili] * n, 3.0, SHORT)
        assert found == pytest.approx(fili / 0.88)

    def test_a_lift_that_must_not_be_is_infinite(self):
        assert compute_vli([0.5, math.inf], 1.0, SHORT) == math.inf

    def test_no_lift_is_an_error(self):
        with pytest.raises(DataError, match="at least one lift"):
            compute_vli([], 1.0, SHORT)


class TestSli:
    @pytest.mark.parametrize(
        ("sets", "expected"),
        [
            ([(1.0, 2.0, 240), (0.8, 1.5, 240)], 1.875),
            ([(1.2, 2.0, 480)], 2.0),
            ([(1.0, 2.0, 120), (0.5, 0.5, 120)], 1.3125),
            ([(1.5, 3.0, 60), (1.0, 2.0, 180), (0.5, 1.0, 240)], 2.3125),
            ([(2.0, 2.0, 100)], 2.0),
        ],
    )
    def test_vectors(self, sets, expected):
        assert compute_sli([TaskSet(*row) for row in sets]) == pytest.approx(expected)

    @given(
        st.lists(
            st.tuples(st.floats(0.1, 2), st.floats(1, 2), st.floats(0, 120)),
            min_size=1,
            max_size=4,
        )
    )
    def test_lies_between_the_worst_sets_indices(self, rows):
        sets = [TaskSet(own, own * factor, minutes) for own, factor, minutes in rows]
        worst = max(sets, key=lambda s: s.shift_index)
        found = compute_sli(sets)
        assert worst.own_index - 1e-9 <= found <= worst.shift_index + 1e-9

    def test_more_than_a_shift_is_an_error(self):
        with pytest.raises(DataError, match="480 min together, got 500"):
            compute_sli([TaskSet(1, 2, 500)])
        with pytest.raises(DataError, match="at least one set"):
            compute_sli([])
