"""From markers to joint angles: scaling, placing, names, gaps, and other ways to be wrong."""

from dataclasses import replace

import numpy as np
import pytest

from engine.errors import ConfigError, DataError, ShapeError
from engine.kinematics.markers import (
    fit_markers,
    read_marker_model,
    table3_angles,
    write_coordinates_mot,
)
from engine.kinematics.markers._opensim import read_coordinates_mot
from engine.kinematics.markers.fit import find_standing
from engine.kinematics.markers.model import DEFAULT_MODEL
from engine.kinematics.markers.osim_writer import write_osim
from tests.engine.kinematics.markers.builders import SIZES, make_lift


@pytest.fixture(scope="module")
def lift():
    return make_lift(n_frames=60)


@pytest.fixture(scope="module")
def fit(lift):
    rec = lift.recording
    return fit_markers(rec.time_s, rec.position_m, rec.names)


def angles_of(coordinates, lift):
    return np.degrees(coordinates) * np.where(lift.model.tree.is_translation, np.nan, 1.0)


def test_the_size_of_every_body_is_found(fit):
    # Those of the pairs that were used; a pair across a joint would be off in another pose.
    for body, size in SIZES.items():
        assert fit.scale[body] == pytest.approx(size, rel=0.003), body


def test_a_model_scaled_while_standing_gives_the_angles_back(fit, lift):
    known = angles_of(lift.coordinates, lift)[:, lift.model.free]
    found = fit.coordinates[:, lift.model.free]
    difference = np.abs(found - known)[:, ~np.isnan(known[0])]
    assert difference.mean() < 0.1
    assert difference.max() < 0.6


def test_the_person_may_face_anywhere():
    turned = make_lift(n_frames=40, heading_deg=155.0)
    rec = turned.recording
    fit = fit_markers(rec.time_s, rec.position_m, rec.names)
    known = angles_of(turned.coordinates, turned)[:, turned.model.free]
    difference = fit.coordinates[:, turned.model.free] - known
    difference = difference[:, np.isfinite(known[0])]
    assert np.abs((difference + 180) % 360 - 180).max() < 0.6


def test_the_other_marker_set_gives_the_same_angles(fit):
    other = make_lift(n_frames=60, marker_set="lifting_45").recording
    found = fit_markers(other.time_s, other.position_m, other.names)
    names, curves = table3_angles(found)
    np.testing.assert_allclose(curves, table3_angles(fit)[1], atol=0.6)
    assert len(names) == 23


def test_our_names_and_signs(fit):
    np.testing.assert_allclose(fit.angles["lumbar_flexion"], -fit["L5_S1_Flex_Ext"])
    np.testing.assert_allclose(fit.angles["knee_flexion_l"], fit["knee_angle_l"])
    np.testing.assert_allclose(fit.angles["shoulder_rotation_r"], fit["arm_rot_r"])
    names, curves = table3_angles(fit)
    assert names[:2] == ("hip flexion (left)", "hip flexion (right)")
    assert curves[:, names.index("hip flexion (left)")].max() > 80
    assert curves[:, names.index("lumbar extension")].min() < -30
    assert fit.angles["trunk_inclination"].max() > 60
    assert np.nanmin(fit.angles["trunk_flexion"]) > -10


def test_standard_errors_are_those_of_repeated_noise(lift):
    """Coordinates scatter over repetitions of the noise as `sigma` says."""
    rec, rng = lift.recording, np.random.default_rng(8)
    frames = np.repeat(np.arange(20, 24), 60)
    position = rec.position_m[frames] + 0.005 * rng.standard_normal((240, 45, 3))
    found = fit_markers(np.arange(240) / 30.0, position, rec.names, model=lift.model)
    for name in ("hip_flexion_r", "L5_S1_Flex_Ext", "elbow_flex_l", "arm_rot_r", "knee_angle_l"):
        column = found.coordinate_names.index(name)
        scatter = found.coordinates[:, column].reshape(4, 60).std(axis=1, ddof=1)
        stated = found.sigma[:, column].reshape(4, 60).mean(axis=1)
        assert 0.6 < np.mean(scatter / stated) < 1.4, name


def test_missing_markers_leave_the_rest_and_hide_what_can_not_be_known(lift):
    rec = lift.recording
    position = np.array(rec.position_m)
    arm = [i for i, n in enumerate(rec.names) if n in ("RELL", "RELM", "RWRR", "RWRU", "RFIN")]
    position[10:20, arm] = np.nan
    position[30:33] = np.nan
    position[40, rec.names.index("RASI")] = np.nan
    found = fit_markers(rec.time_s, position, rec.names, model=lift.model)
    # Without forearm and hand nothing tells pronation; the legs do not care.
    assert np.isnan(found["pro_sup_r"][10:20]).all()
    assert np.isnan(found["elbow_flex_r"][10:20]).all()
    known = angles_of(lift.coordinates, lift)
    column = found.coordinate_names.index("knee_angle_r")
    assert np.abs(found.coordinates[10:20, column] - known[10:20, column]).max() < 0.01
    assert np.isnan(found.coordinates[30:33]).all()
    assert np.isnan(found.residual_m[30:33]).all()
    assert np.abs(found["pelvis_tilt"][40] - known[40, 0]) < 0.01
    assert "3 frames" in found.warnings[0]


def test_exchanged_markers_are_noticed(lift):
    rec = lift.recording
    names = list(rec.names)
    order = list(range(45))
    for a, b in (("RASI", "LASI"), ("RPSI", "LPSI"), ("RLEP", "LLEP"), ("RMEP", "LMEP")):
        i, j = names.index(a), names.index(b)
        order[i], order[j] = j, i
    found = fit_markers(rec.time_s, rec.position_m[:, order], rec.names, model=lift.model)
    assert "names of the markers" in found.warnings[0]


def test_nobody_standing_is_refused_unless_frames_or_a_model_are_given(lift):
    rec = lift.recording
    # The deepest frames only.
    low = slice(25, 36)
    args = rec.time_s[low], rec.position_m[low], rec.names
    with pytest.raises(DataError, match="Nobody stands upright"):
        fit_markers(*args)
    assert np.isfinite(fit_markers(*args, model=lift.model)["knee_angle_l"]).all()


def test_standing_is_looked_for_at_the_start_first(lift):
    rec = lift.recording
    found = find_standing(rec.time_s, rec.position_m, rec.names)
    assert rec.time_s[found.stop - 1] <= 1.5
    late = np.concatenate([rec.position_m[25:36], rec.position_m[40:]])
    times = np.arange(len(late)) / 30.0
    assert find_standing(times, late, rec.names).start > 11


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"names": ("A", "B")}, ShapeError),
        ({"ik": "magic"}, ConfigError),
        ({"static_frames": []}, DataError),
    ],
)
def test_wrong_calls_are_refused(lift, change, error):
    rec = lift.recording
    arguments = {"time_s": rec.time_s, "position_m": rec.position_m, "names": rec.names}
    with pytest.raises(error):
        fit_markers(**{**arguments, **change})


def test_unknown_markers_are_refused(lift):
    rec = lift.recording
    names = tuple(f"X{i}" for i in range(45))
    with pytest.raises(DataError, match="of no known set"):
        fit_markers(rec.time_s, rec.position_m, names)


def test_a_giant_is_refused(lift):
    rec = lift.recording
    with pytest.raises(DataError, match="times as large"):
        fit_markers(rec.time_s, 2.5 * rec.position_m, rec.names)


def test_the_motion_file_has_opensims_names_in_degrees(fit, tmp_path):
    path = tmp_path / "coordinates.mot"
    write_coordinates_mot(fit, path)
    times, values = read_coordinates_mot(path, fit.coordinate_names)
    np.testing.assert_allclose(times, fit.time_s, atol=1e-7)
    np.testing.assert_allclose(
        np.degrees(values[:, fit.coordinate_names.index("knee_angle_r")]),
        fit["knee_angle_r"],
        atol=1e-6,
    )
    is_height = fit.coordinate_names.index("pelvis_ty")
    np.testing.assert_allclose(values[:, is_height], fit["pelvis_ty"], atol=1e-7)


def test_motion_files_in_radians_with_paths_are_read(tmp_path):
    path = tmp_path / "static.mot"
    path.write_text(
        "Coordinates\ninDegrees=no\nendheader\n"
        "time\t/jointset/hip_r/hip_flexion_r/value\t/jointset/hip_r/hip_flexion_r/speed\n"
        "0\t0.5\t9\n",
        encoding="utf-8",
    )
    _, values = read_coordinates_mot(path, ("hip_flexion_r", "knee_angle_r"))
    assert values[0, 0] == 0.5
    assert np.isnan(values[0, 1])
    path.write_text("Coordinates\nendheader\ntime\ta\n0\t1\n", encoding="utf-8")
    with pytest.raises(DataError, match="inDegrees"):
        read_coordinates_mot(path, ("a",))


def test_a_scaled_model_of_ones_own_needs_no_scaling(lift, tmp_path):
    path = tmp_path / "mine.osim"
    write_osim(DEFAULT_MODEL, path, markers=lift.model.model.markers, scale=SIZES)
    rec = lift.recording
    found = fit_markers(rec.time_s, rec.position_m, rec.names, model=read_marker_model(path))
    known = angles_of(lift.coordinates, lift)[:, lift.model.free]
    difference = found.coordinates[:, lift.model.free] - known
    assert np.nanmax(np.abs(difference)) < 1e-3
    write_osim(DEFAULT_MODEL, path, markers=())
    with pytest.raises(DataError, match="has no markers"):
        read_marker_model(path)


def test_results_can_not_be_changed(fit):
    with pytest.raises(ValueError, match="read-only"):
        fit.coordinates[0] = 0.0
    assert replace(fit, solver="x").solver == "x"
