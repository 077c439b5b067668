"""The lifting estimators with the networks that are shipped."""

from __future__ import annotations

import numpy as np
import pytest

from engine.config import PoseConfig
from engine.pose.base import LiftingBackend, create_backend, list_backends
from engine.pose.lifting.joints import LIFTED_KEYPOINTS
from engine.pose.lifting.network import MODEL_DIR
from engine.skeletons import MEDIAPIPE_33
from tests.engine.cameras.truth import read_truth, see

LIFTED = [MEDIAPIPE_33.index(name) for name in LIFTED_KEYPOINTS]
NAMES = ("mhformer", "d3dp")

pytestmark = pytest.mark.model


@pytest.fixture(scope="module")
def lift():
    truth = read_truth("floor_to_knuckle")
    return see(truth.points, truth.cameras["cam135"], truth.time_s)


@pytest.mark.parametrize("name", NAMES)
def test_lifted_joints_are_near_the_true_ones(name, lift):
    """`see` gives true points and a true body, so this shows that all axes and units are right."""
    backend = create_backend(PoseConfig(backend=name))
    assert isinstance(backend, LiftingBackend)
    found = backend.lift(lift)
    body, true = (
        np.asarray(found.body.position)[:, LIFTED],
        np.asarray(lift.body.position)[:, LIFTED],
    )
    off = np.linalg.norm(body - true, axis=-1)
    flat = np.linalg.norm((true * [1, 1, 0] - true), axis=-1)
    assert off.mean() < 0.14
    assert off.mean() < flat.mean()
    assert found.body.provenance["weights"] == f"{name}-s"


def test_hypotheses_options_are_used(lift):
    bodies = [
        create_backend(PoseConfig(backend="d3dp", **options)).lift(lift).body
        for options in (
            {"hypotheses": 2, "steps": 1},
            {"hypotheses": 2, "steps": 1},
            {"hypotheses": 2, "steps": 1, "seed": 1},
            {"hypotheses": 2, "steps": 1, "aggregation": "mean"},
        )
    ]
    assert np.array_equal(bodies[0].position, bodies[1].position, equal_nan=True)
    for other in bodies[2:]:
        assert not np.array_equal(bodies[0].position, other.position, equal_nan=True)
    assert bodies[3].provenance["aggregation"] == "mean"


def test_both_networks_together_stay_small():
    files = [MODEL_DIR / "mhformer_s.onnx", MODEL_DIR / "d3dp_s.onnx"]
    assert sum(file.stat().st_size for file in files) < 25e6


def test_estimators_are_listed_as_lifting():
    lifting = {info.name for info in list_backends() if info.lifts}
    assert set(NAMES) <= lifting
