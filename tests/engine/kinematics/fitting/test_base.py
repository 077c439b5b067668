"""How solvers are found, and how the error of the vertical reaches the angles against it."""

import dataclasses

import numpy as np
import pytest

from engine.datatypes import JointAngles
from engine.errors import ConfigError
from engine.kinematics.angles import ANGLES
from engine.kinematics.fitting.base import add_scene_errors, list_solvers, select_solver
from tests.builders import make_scene


def test_every_solver_is_found_by_its_name():
    for solver in list_solvers():
        if not solver.info.missing:
            assert select_solver(solver.info.name) is solver
    assert {"geometric", "least-squares", "udeas"} <= {s.info.name for s in list_solvers()}


def test_an_unknown_solver_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"'magic'; known: geometric, least-squares, markers"):
        select_solver("magic")


def test_only_angles_against_the_vertical_take_its_error():
    names = tuple(name for row in ANGLES for name in row.names)
    angles = JointAngles(
        np.arange(2.0), np.zeros((2, len(names))), names, np.full((2, len(names)), 3.0)
    )
    widened = add_scene_errors(angles, dataclasses.replace(make_scene(), tilt_sigma_deg=4.0))
    against_vertical = {row.name for row in ANGLES if row.relative_to == "world"}
    # The turn of the pelvis is against the heading at the start.
    against_vertical -= {"pelvis_rotation"}
    for name in names:
        expected = 5.0 if name in against_vertical else 3.0
        np.testing.assert_allclose(widened.sigma(name), expected, err_msg=name)
