"""What all methods that score every frame keep to."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.ergonomics.flags import raise_flags
from engine.ergonomics.methods import owas, posture_zones, reba, rula
from engine.ergonomics.posture_scores import decode_runs
from engine.storage.document import encode_plain
from tests.engine.ergonomics.exposures import build_lift
from tests.engine.ergonomics.postures import NEUTRAL, build_posture

METHODS = {m.METHOD.info.name: m.METHOD for m in (reba, rula, owas, posture_zones)}


def random_curves(seed, n_frames, missing):
    rng = np.random.default_rng(seed)
    curves = {}
    for name in NEUTRAL:
        curve = rng.normal(rng.uniform(-40, 90), rng.uniform(0, 40), n_frames)
        curve[rng.random(n_frames) < missing] = np.nan
        curves[name] = curve
    return curves


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_frames=st.sampled_from([1, 2, 5, 6, 7, 40]),
    missing=st.sampled_from([0.0, 0.2, 0.6, 1.0]),
    sigma=st.sampled_from([0.0, 5.0, 60.0, None]),
    load=st.sampled_from([None, 0.0, 12.0]),
)
def test_any_posture_gives_a_consistent_answer(seed, n_frames, missing, sigma, load):
    lift = build_lift(start_s=0.5)
    curves = random_curves(seed, n_frames, missing)
    exposure = build_posture(lift, n_frames=n_frames, sigma=sigma, load_kg=load, **curves)
    results = {name: method.assess(exposure) for name, method in METHODS.items()}
    for result in results.values():
        json.dumps(encode_plain(result.details), allow_nan=False)
        assert result.steps
        if not result.is_applicable:
            assert result.reasons
            continue
        low, high = result.interval
        assert math.isnan(low) == (sigma is None)
        assert math.isnan(low) or low <= result.value <= high
        assert sum(level["share"] for level in result.details["levels"]) == pytest.approx(
            1, abs=0.01
        )
        score = decode_runs(result.details["series"]["score"])
        assert score.size == n_frames
        assert (score > 0).any()
    assert all("safe" not in flag.why.lower() for flag in raise_flags(results, (lift,), {}))


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_left_and_right_exchanged_score_the_same(method):
    curves = random_curves(3, 60, 0.05)
    mirrored = dict(curves)
    for name in curves:
        if name.endswith("_l"):
            mirrored[name], mirrored[f"{name[:-1]}r"] = curves[f"{name[:-1]}r"], curves[name]
    for name in ("trunk_twist", "trunk_lateral_bend"):
        mirrored[name] = -curves[name]
    one, other = (method.assess(build_posture(load_kg=8.0, **c)) for c in (curves, mirrored))
    series = [decode_runs(r.details["series"]["score"]).tolist() for r in (one, other)]
    assert series[0] == series[1]
    assert one.value == other.value


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_equal_inputs_give_equal_results(method):
    exposure = build_posture(sigma=8.0, **random_curves(5, 60, 0.0))
    one, two = method.assess(exposure), method.assess(exposure)
    assert (one.interval, one.steps) == (two.interval, two.steps)
    assert encode_plain(one.details) == encode_plain(two.details)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_more_bend_is_never_better(method):
    values = [
        method.assess(build_posture(trunk_flexion=angle, frequency_per_min=1.0)).value
        for angle in (0.0, 15.0, 40.0, 70.0)
    ]
    assert values == sorted(values)
    assert values[-1] > values[0]


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_a_moved_camera_is_a_doubt(method):
    result = method.assess(build_posture(conditions=("camera_moved",)))
    assert any("the camera moved" in doubt for doubt in result.details["doubts"])


@pytest.mark.parametrize(
    ("angles", "words"),
    [
        ({"trunk_flexion": 40.0}, "trunk 40 deg forward"),
        ({"trunk_flexion": -30.0}, "trunk 30 deg backward"),
        ({"trunk_twist": -25.0}, "trunk 0 deg forward, twisted 25 deg"),
        ({"knees": 50.0, "shoulder_flexion_r": 80.0}, "knees 50 deg, upper arm 80 deg raised"),
        ({"knees": math.nan, "arms": math.nan}, "trunk 0 deg forward"),
    ],
)
def test_the_worst_posture_is_told_in_words(angles, words):
    (moment,) = METHODS["reba"].assess(build_posture(**angles)).details["worst_moments"]
    assert moment["posture"].endswith(words)


def test_details_of_ten_seconds_stay_small():
    t = np.arange(300) / 30
    exposure = build_posture(
        build_lift(start_s=2.0), n_frames=300, sigma=10.0, load_kg=12.0,
        trunk_flexion=40 + 40 * np.sin(3 * t), knees=30 + 30 * np.sin(2 * t),
    )  # fmt: skip
    documents = [encode_plain(m.assess(exposure).details) for m in METHODS.values()]
    assert len(json.dumps(documents, indent=2)) < 60_000
