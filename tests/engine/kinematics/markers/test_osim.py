"""Reading an OpenSim model, and its functions and frames."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from engine.errors import DataError
from engine.kinematics.markers.functions import simm_spline
from engine.kinematics.markers.model import DEFAULT_MODEL, build_marker_model
from engine.kinematics.markers.osim import read_osim
from engine.kinematics.markers.osim_writer import write_osim
from engine.kinematics.markers.tree import KinematicTree


@pytest.fixture(scope="module")
def model():
    return read_osim(DEFAULT_MODEL)


def test_the_model_has_the_bodies_and_coordinates_it_is_known_for(model):
    assert len(model.bodies) == 22
    assert len(model.coordinates) == 40
    knee = model.coordinate("knee_angle_r")
    assert (knee.low, np.degrees(knee.high)) == (0.0, pytest.approx(155.0))
    assert knee.is_clamped
    assert not model.coordinate("pelvis_tilt").is_clamped
    with pytest.raises(DataError, match="no coordinate 'elbow'"):
        model.coordinate("elbow")


def test_left_mirrors_right(model):
    tree = KinematicTree(model)
    rng = np.random.default_rng(5)
    pose = tree.default_coordinates()
    for name, column in tree.column.items():
        if name.endswith("_r"):
            angle = rng.uniform(0.1, 0.5)
            pose[column] = pose[tree.column[name[:-1] + "l"]] = angle
    poses = tree.pose(pose[None])
    for body, column in tree.body_column.items():
        if body.endswith("_r"):
            other = tree.body_column[body[:-1] + "l"]
            np.testing.assert_allclose(
                poses.origin[column, :, 0], poses.origin[other, :, 0] * [1, 1, -1], atol=1e-6
            )


SIGNS = [
    ("hip_flexion_r", "tibia_r", 0, 1),  # the knee goes forward
    ("hip_adduction_r", "tibia_r", 2, -1),  # a right knee goes left
    ("hip_adduction_l", "tibia_l", 2, 1),
    ("knee_angle_r", "talus_r", 0, -1),  # the ankle goes back
    ("knee_angle_l", "talus_l", 0, -1),
    ("L5_S1_Flex_Ext", "head", 0, -1),  # extension leans back
    ("L5_S1_Lat_Bending", "head", 2, 1),  # to the right
    ("pelvis_tilt", "head", 0, -1),  # posterior tilt leans the trunk back
    ("pelvis_list", "femur_r", 1, -1),  # right side down
    ("pelvis_rotation", "femur_r", 0, 1),  # turning left brings the right hip forward
    ("elbow_flex_r", "hand_r", 0, 1),
    ("elbow_flex_l", "hand_l", 0, 1),
]


@pytest.mark.parametrize(("coordinate", "body", "axis", "sign"), SIGNS, ids=str)
def test_signs_are_anatomical(model, coordinate, body, axis, sign):
    tree = KinematicTree(model)
    rest = tree.default_coordinates()
    for side in "lr":
        rest[tree.column[f"arm_add_{side}"]] = 0.0
    moved = rest.copy()
    moved[tree.column[coordinate]] += 0.5
    at = tree.body_column[body]
    shift = tree.pose(moved[None]).origin[at, :, 0] - tree.pose(rest[None]).origin[at, :, 0]
    assert np.sign(shift[axis]) == sign
    assert abs(shift[axis]) > 0.02


@pytest.mark.parametrize("side", ["l", "r"])
@pytest.mark.parametrize(
    ("coordinate", "landmark"), [("arm_rot", "lateral_elbow"), ("pro_sup", "radial_wrist")]
)
def test_internal_rotation_and_pronation_bring_the_outer_side_forward(side, coordinate, landmark):
    unscaled = build_marker_model("lifting_45")
    tree = unscaled.tree
    rest = tree.default_coordinates()
    for name in ("arm_add", "pro_sup"):
        rest[tree.column[f"{name}_{side}"]] = 0.0
    moved = rest.copy()
    moved[tree.column[f"{coordinate}_{side}"]] += 0.5
    marker_set = {"l": "left", "r": "right"}[side] + "_" + landmark
    from engine.skeletons import LIFTING_45

    marker = unscaled.model.markers[LIFTING_45.landmarks.index(marker_set)]
    body = np.array([tree.body_column[marker.body]])
    before, after = (tree.pose(q[None]).place(body, marker.local[None])[0] for q in (rest, moved))
    assert (after - before).item() > 0.01


def test_the_spline_goes_through_its_points_and_on_straight():
    x, y = np.array([0.0, 1.0, 2.0, 4.0, 5.0]), np.array([0.0, 2.0, 1.0, 3.0, 3.5])
    curve = simm_spline(x, y)
    np.testing.assert_allclose(curve(x)[0], y, atol=1e-12)
    beyond, slope = curve(np.array([6.0, 7.0]))
    assert slope[0] == slope[1] == pytest.approx(beyond[1] - beyond[0])
    # A cubic is its own spline, whatever the ends.
    cubic = CubicSpline(x, x**3 - 2 * x)
    at = np.linspace(0, 5, 41)
    np.testing.assert_allclose(simm_spline(x, x**3 - 2 * x)(at)[0], cubic(at), atol=1e-9)
    step = 1e-6
    numeric = (curve(at[1:-1] + step)[0] - curve(at[1:-1] - step)[0]) / (2 * step)
    np.testing.assert_allclose(curve(at[1:-1])[1], numeric, atol=1e-5)


def test_a_scaled_model_is_written_and_read_back_alike(model, tmp_path):
    from engine.kinematics.markers.tree import scale_model

    factors = {"femur_r": 1.2, "torso": 0.9, "pelvis": 1.1, "calcn_l": 0.8}
    unscaled = build_marker_model("lifting_45")
    scaled = scale_model(unscaled.model, factors)
    write_osim(
        DEFAULT_MODEL,
        tmp_path / "scaled.osim",
        markers=scaled.markers,
        scale=factors,
        defaults={"arm_add_r": 0.25},
        locked=["wrist_flex_r"],
    )
    back = read_osim(tmp_path / "scaled.osim")
    assert back.coordinate("arm_add_r").default == 0.25
    assert back.coordinate("wrist_flex_r").is_locked
    rng = np.random.default_rng(1)
    pose = rng.uniform(0.0, 0.5, (3, 40))
    one, two = (KinematicTree(m).pose(pose) for m in (scaled, back))
    np.testing.assert_allclose(one.origin, two.origin, atol=1e-12)
    np.testing.assert_allclose(one.rotation, two.rotation, atol=1e-12)
    for a, b in zip(scaled.markers, back.markers, strict=True):
        assert (a.name, a.body) == (b.name, b.body)
        np.testing.assert_allclose(a.local, b.local, atol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not xml", "can't be read"),
        ("<OpenSimDocument Version='30000'><Model name='x'/></OpenSimDocument>", "OpenSim 3"),
        ("<Other/>", "no OpenSim model"),
    ],
)
def test_other_files_are_refused(tmp_path, text, message):
    path = tmp_path / "model.osim"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=message):
        read_osim(path)
    with pytest.raises(DataError, match="no model file"):
        read_osim(tmp_path / "absent.osim")
