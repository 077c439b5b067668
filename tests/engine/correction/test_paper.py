import dataclasses

import numpy as np
import pytest

from engine.correction.chain import correct_track
from engine.correction.gaps import fill_by_mean
from engine.datatypes import Status
from engine.skeletons import H36M_17

from .figures import make_walker


def test_a_gap_takes_the_mean_of_both_sides():
    values = np.array([[1.0], [np.nan], [np.nan], [5.0], [np.nan]])
    assert fill_by_mean(values).ravel().tolist() == [1.0, 3.0, 3.0, 5.0, 5.0]


def test_the_ends_are_held_and_nothing_stays_nothing():
    values = np.array([[np.nan], [2.0], [np.nan]])
    assert fill_by_mean(values).ravel().tolist() == [2.0, 2.0, 2.0]
    assert np.isnan(fill_by_mean(np.full((3, 2), np.nan))).all()


def test_outliers_are_removed_filled_and_say_so():
    track = make_walker()
    wrist = H36M_17.index("left_wrist")
    position = np.array(track.position)
    position[50:56, wrist] += [0.0, 0.4, 0.2]
    corrected = correct_track(dataclasses.replace(track, position=position), preset="paper")
    error = np.linalg.norm(corrected.position - track.position, axis=2)
    # Held at a mean for a fifth of a second while the person walks at 1.2 m/s.
    assert error[50:56, wrist].max() < 0.25
    assert (corrected.status[50:56, wrist] == Status.FILLED).all()
    assert (corrected.sigma[50:56, wrist] > 0.02).all()
    assert corrected.provenance["correction"]["rejected"] >= 6


def test_gaps_of_any_length_are_filled_but_nobody_is_invented():
    track = make_walker()
    position = np.array(track.position)
    position[10:80, 3] = np.nan
    position[-20:, 6] = np.nan
    position[:, 9] = np.nan
    corrected = correct_track(dataclasses.replace(track, position=position), preset="paper")
    assert np.isfinite(corrected.position[:, [3, 6]]).all()
    assert np.isnan(corrected.position[:, 9]).all()
    assert np.allclose(np.diff(corrected.position[-18:, 6], axis=0), 0.0)


def test_exchanged_sides_are_not_recognised_as_such():
    track = make_walker()
    position = np.array(track.position)
    position[40:60] = position[40:60][:, list(H36M_17.mirror_order)]
    corrected = correct_track(dataclasses.replace(track, position=position), preset="paper")
    middle = np.linalg.norm(corrected.position - track.position, axis=2)[48:52]
    assert middle[:, H36M_17.index("left_hip")].max() == pytest.approx(0.2, abs=0.01)
    assert not (corrected.status == Status.REPAIRED).any()
