import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.correction.links import (
    ADULT_STATURE_M,
    LINK_SHARES,
    find_edges,
    find_excursions,
    measure_links,
)

from .figures import make_walker, photograph

TIME_S = np.arange(120) / 30


def make_lengths(*, noise_cm=0.2, seed=0):
    return 30.0 + noise_cm * np.random.default_rng(seed).standard_normal((120, 1))


class TestScale:
    def test_the_links_add_up_to_those_of_the_stature(self):
        links = measure_links(make_walker(), stature_m=1.80)
        assert len(links.names) == 10
        shares = sum(
            LINK_SHARES[n.removeprefix("left_").removeprefix("right_")] for n in links.names
        )
        assert np.median(links.length_cm, axis=0).sum() == pytest.approx(180.0 * shares)

    def test_bones_of_constant_length_measure_the_same_in_every_frame(self):
        assert measure_links(make_walker()).length_cm.std(axis=0).max() < 1e-9

    @given(st.floats(0.001, 1000.0))
    def test_the_unit_of_the_track_does_not_matter(self, factor):
        track = make_walker(n_frames=20)
        scaled = dataclasses.replace(track, position=factor * track.position)
        np.testing.assert_allclose(
            measure_links(scaled).length_cm, measure_links(track).length_cm, rtol=1e-9
        )

    def test_an_unknown_stature_is_that_of_an_adult(self):
        track = make_walker()
        known = measure_links(track, stature_m=ADULT_STATURE_M)
        assert np.array_equal(measure_links(track).length_cm, known.length_cm)

    def test_a_picture_follows_the_distance_to_the_camera(self):
        front = photograph(make_walker(n_frames=300), azimuth_deg=0.0)
        nearer = np.linspace(1.0, 2.0, 300)[:, None, None]
        links = measure_links(dataclasses.replace(front, position=front.position * nearer))
        width = links.length_cm[30:-30, links.names.index("shoulder_width")]
        assert width.std() / width.mean() < 0.03
        growth = nearer[-60, 0, 0] / nearer[60, 0, 0]
        assert links.scale_cm[60] / links.scale_cm[-60] == pytest.approx(growth, rel=0.05)

    def test_nothing_seen_gives_no_scale(self):
        track = make_walker()
        unseen = dataclasses.replace(track, position=np.full(track.position.shape, np.nan))
        assert np.isnan(measure_links(unseen).scale_cm).all()


class TestDerivative:
    def test_a_jump_is_an_edge_where_it_begins_and_ends(self):
        length = make_lengths()
        length[50:58] += 8.0
        edges = find_edges(TIME_S, length)
        assert np.flatnonzero(edges.is_edge).tolist() == [50, 58]
        assert edges.change_cm[50, 0] == pytest.approx(8.0, abs=1.0)
        assert edges.change_cm[58, 0] == pytest.approx(-8.0, abs=1.0)

    def test_less_than_two_centimetres_is_no_edge(self):
        length = np.full((120, 1), 30.0)
        length[50:58] += 1.9
        assert not find_edges(TIME_S, length).is_edge.any()
        length[50:58] += 0.2
        assert find_edges(TIME_S, length).is_edge.any()

    def test_the_lower_threshold_continues_a_run_but_never_starts_one(self):
        length = np.full((120, 1), 30.0)
        length[50:] += 2.5
        length[51:] += 1.5
        length[80:] += 1.5
        assert np.flatnonzero(find_edges(TIME_S, length).is_edge).tolist() == [50, 51]

    def test_the_change_is_per_thirtieth_of_a_second_at_every_rate(self):
        time_s = np.arange(60) / 60
        length = np.full((60, 1), 30.0)
        length[30] += 1.0
        edges = find_edges(time_s, length)
        assert edges.change_cm[30, 0] == pytest.approx(2.0)

    def test_a_gap_spreads_the_change(self):
        length = np.full((120, 1), 30.0)
        length[50:60] = np.nan
        length[60:] = 35.0
        edges = find_edges(TIME_S, length)
        assert edges.change_cm[60, 0] == pytest.approx(5.0 / 11)
        assert np.isnan(edges.change_cm[50:60]).all()

    def test_mostly_bad_frames_use_fixed_thresholds_and_say_so(self):
        rng = np.random.default_rng(3)
        length = 30.0 + np.where(rng.random((120, 1)) < 0.8, 10.0, 0.1) * rng.standard_normal(
            (120, 1)
        )
        edges = find_edges(TIME_S, length)
        assert edges.is_unsteady.tolist() == [True]
        assert edges.is_edge[np.nan_to_num(np.abs(edges.change_cm)) > 2.0].all()


class TestLevel:
    def test_all_frames_between_the_jumps_are_found(self):
        length = make_lengths()
        length[50:58] += 8.0
        found, level = find_excursions(TIME_S, length, find_edges(TIME_S, length))
        assert np.flatnonzero(found).tolist() == list(range(50, 58))
        assert level[50:58].min() > 7.0

    def test_a_slow_change_is_no_excursion(self):
        length = 30.0 + 6.0 * np.sin(2 * np.pi * 0.3 * TIME_S)[:, None]
        assert not find_excursions(TIME_S, length, find_edges(TIME_S, length))[0].any()

    def test_excursions_close_together_are_one(self):
        length = make_lengths()
        length[50:54] += 8.0
        length[56:60] += 8.0
        found, _ = find_excursions(TIME_S, length, find_edges(TIME_S, length))
        assert np.flatnonzero(found).tolist() == list(range(50, 60))

    @pytest.mark.parametrize("value", [np.nan, 30.0])
    def test_nothing_or_nothing_new(self, value):
        length = np.full((120, 1), value)
        assert not find_excursions(TIME_S, length, find_edges(TIME_S, length))[0].any()
