from __future__ import annotations

import itertools
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.errors import DataError, UnitError
from engine.kinematics.angles import ANGLE_NAMES, compute_trunk_angles, get_external_angle
from engine.validation.profiles import AngleRule, ImportProfile, parse_axes
from engine.validation.reference.angle_names import ANGLE_SYSTEMS, OUR_ANGLES, match_angles
from engine.validation.reference.base import Recording
from engine.validation.reference.files import describe_profile, read_reference
from engine.validation.reference.interpret import interpret
from engine.validation.reference.naming import LABEL_SETS, match_labels, strip_prefixes
from tests.engine.validation.recordings import moving_markers, upright_markers, write_mot, write_trc


def record(position, labels, **changes):
    time = np.arange(len(position)) / 100.0
    options = {"length_unit": "m", **changes}
    return Recording("a.trc", "trc", time, tuple(labels), position, **options)


# --------------------------------------------------------------------------- unit


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000.0), ("cm", 100.0), ("m", 1.0)])
@pytest.mark.parametrize("is_stated", [True, False], ids=["stated", "detected"])
def test_every_unit_becomes_metres(unit, factor, is_stated):
    labels, position = moving_markers()
    recording = record(position * factor, labels, length_unit=unit if is_stated else None)
    reference = interpret(recording)
    np.testing.assert_allclose(reference.markers.position, position, atol=1e-12)
    assert reference.finding("unit").value == unit
    assert (reference.finding("unit").score == 1.0) is is_stated


def test_a_wrong_unit_is_refused_and_the_right_one_named():
    labels, position = moving_markers()
    with pytest.raises(UnitError, match=r"stated by the file.*they look like mm"):
        interpret(record(position * 1000, labels, length_unit="m"))


def test_a_profile_sets_the_unit_but_not_against_the_data():
    labels, position = moving_markers()
    recording = record(position * 1000, labels, length_unit="m")
    reference = interpret(recording, ImportProfile(length_unit="mm"))
    np.testing.assert_allclose(reference.markers.position, position)
    with pytest.raises(UnitError, match="set by the profile"):
        interpret(recording, ImportProfile(length_unit="cm"))


# --------------------------------------------------------------------------- axes

RIGHT_HANDED = [
    tuple(
        ("-" if sign < 0 else "") + "xyz"[column] for column, sign in zip(order, signs, strict=True)
    )
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1, -1), repeat=3)
    if np.isclose(np.linalg.det(np.eye(3)[list(order)] * np.array(signs)[:, None]), 1.0)
]


def write_in_axes(position, axes):
    """Return positions as a file with these axes holds them."""
    stored = np.empty_like(position)
    for ours, (column, sign) in enumerate(parse_axes(axes)):
        stored[..., column] = sign * position[..., ours]
    return stored


@pytest.mark.parametrize("axes", RIGHT_HANDED, ids=" ".join)
def test_any_axes_are_found(axes):
    assert len(RIGHT_HANDED) == 24
    labels, position = moving_markers()
    reference = interpret(record(write_in_axes(position, axes), labels))
    assert reference.settings["axes"] == axes
    np.testing.assert_allclose(reference.markers.position, position, atol=1e-12)
    assert reference.finding("axes").is_sure


def test_up_is_found_without_any_known_label_but_not_for_sure():
    labels, position = moving_markers()
    names = tuple(f"M{i}" for i in range(len(labels)))
    stored = write_in_axes(position, ("x", "z", "-y"))
    reference = interpret(record(stored, names))
    assert reference.settings["axes"][1] == "z"
    assert not reference.finding("axes").is_sure
    assert reference.finding("labels").value == "unknown"
    assert reference.landmarks == {}


def test_up_is_found_in_a_deep_bend():
    """Shoulders in front of the hips at their height: pelvis above feet still tells."""
    markers = upright_markers()
    bent = {k: (y - 1.0, 1.0 - x, z) if y > 1.05 else (x, y, z) for k, (x, y, z) in markers.items()}
    labels, position = moving_markers(markers=bent)
    reference = interpret(record(position, labels))
    assert reference.settings["axes"] == ("x", "y", "z")
    assert reference.finding("axes").is_sure


def test_profile_axes_win():
    labels, position = moving_markers()
    reference = interpret(record(position, labels), ImportProfile(axes=("z", "y", "-x")))
    np.testing.assert_allclose(reference.markers.position[..., 0], position[..., 2])
    np.testing.assert_allclose(reference.markers.position[..., 2], -position[..., 0])


# --------------------------------------------------------------------------- sides


def exchange_labels(labels):
    other = {"L": "R", "R": "L"}
    return tuple(f"{other[x[0]]}{x[1:]}" if x[1:] in _SIDED else x for x in labels)


_SIDED = {name[1:] for name in upright_markers() if name not in ("C7", "CLAV")}


def test_exchanged_sides_are_seen_and_a_profile_repairs_them():
    labels, position = moving_markers()
    recording = record(position, exchange_labels(labels))
    reference = interpret(recording)
    assert reference.are_sides_swapped
    assert reference.finding("sides") in reference.to_confirm
    repaired = interpret(recording, ImportProfile(swap_sides=True))
    assert not repaired.are_sides_swapped
    assert repaired.settings["axes"] == ("x", "y", "z")
    right_knee = repaired.markers[repaired.landmarks["right_lateral_knee"]]
    np.testing.assert_allclose(right_knee, position[:, labels.index("RKNE")])


def test_right_sides_are_confirmed():
    labels, position = moving_markers()
    finding = interpret(record(position, labels)).finding("sides")
    assert finding.value == "as labelled"
    assert finding.is_sure


# --------------------------------------------------------------------------- labels


@pytest.mark.parametrize("label_set", LABEL_SETS, ids=lambda s: s.name)
def test_every_label_set_recognises_itself(label_set):
    match = match_labels(label_set.labels)
    assert match.label_set == label_set.name
    assert match.unknown == ()
    assert set(match.landmarks) == set(label_set.labels.values())


def test_label_sets_mirror_left_and_right():
    for label_set in LABEL_SETS:
        landmarks = set(label_set.labels.values())
        if label_set.name == "shoulder_arm":
            continue  # one arm only
        for landmark in landmarks:
            if landmark.startswith("left_"):
                assert landmark.replace("left_", "right_") in landmarks


def test_labels_of_one_subject_are_taken():
    labels, columns, note = strip_prefixes(("Anna:LASI", "Ben:LASI", "Anna:RASI", "box"))
    assert labels == ("LASI", "RASI", "box")
    assert columns == (0, 2, 3)
    assert "'Anna'" in note


def test_a_profile_names_labels():
    labels, position = moving_markers()
    odd = tuple("outer_knee" if x == "LKNE" else x for x in labels)
    rules = ImportProfile(labels={"outer_knee": "left_lateral_knee"})
    assert "left_lateral_knee" not in interpret(record(position, odd)).landmarks
    reference = interpret(record(position, odd), rules)
    assert reference.landmarks["left_lateral_knee"] == "outer_knee"
    with pytest.raises(DataError, match=r"names the label 'outer_knee'"):
        interpret(record(position, labels), rules)


# --------------------------------------------------------------------------- angles


def test_the_tables_of_angles_agree():
    """The one table is in engine.kinematics.angles; this one repeats what reading needs."""
    assert set(OUR_ANGLES) == set(ANGLE_NAMES)
    for system, ours in (("opensim_pose2sim", "opensim"), ("plug_in_gait", "plug_in_gait")):
        listed = {s.ours: [] for s in ANGLE_SYSTEMS[ours]}
        for source in ANGLE_SYSTEMS[ours]:
            listed[source.ours].append((source.column, source.sign))
        expected = {n: e for n in ANGLE_NAMES if (e := get_external_angle(n, system))}
        assert set(listed) == set(expected)
        for name, external in expected.items():
            assert (external.name, external.sign) in listed[name]
    for name in ANGLE_NAMES:
        hamner = get_external_angle(name, "opensim_hamner")
        if hamner and not name.startswith("knee"):  # the knee's sign is told from the data
            assert any(
                (s.ours, s.column, s.sign) == (name, hamner.name, hamner.sign)
                for s in ANGLE_SYSTEMS["opensim"]
            )


def read_angles(tmp_path, columns, **options):
    return read_reference(write_mot(tmp_path / "a.mot", columns, **options))


@pytest.mark.parametrize(("stated", "factor"), [("yes", 1.0), ("no", np.pi / 180)])
def test_opensim_angles_get_our_names_signs_and_degrees(tmp_path, stated, factor):
    curve = np.linspace(0.0, 40.0, 9)
    reference = read_angles(
        tmp_path,
        {"knee_angle_r": curve * factor, "lumbar_extension": -curve * factor, "x_tx": curve},
        in_degrees=stated,
    )
    np.testing.assert_allclose(reference.angles["knee_flexion_r"], curve, atol=1e-6)
    np.testing.assert_allclose(reference.angles["lumbar_flexion"], curve, atol=1e-6)
    assert "x_tx" in reference.notes[-1]
    assert reference.finding("angle unit").is_sure


def test_a_knee_that_counts_flexion_as_negative_is_turned(tmp_path):
    curve = np.linspace(0.0, 90.0, 9)
    reference = read_angles(tmp_path, {"knee_angle_r": -curve, "knee_angle_l": 0.05 * curve})
    np.testing.assert_allclose(reference.angles["knee_flexion_r"], curve, atol=1e-6)
    np.testing.assert_allclose(reference.angles["knee_flexion_l"], 0.05 * curve, atol=1e-6)
    assert reference.finding("knee sign")


def test_radians_are_suspected_where_the_header_is_silent_or_wrong(tmp_path):
    curve = np.radians(np.linspace(0.0, 90.0, 9))
    silent = read_angles(tmp_path, {"knee_angle_r": curve}, in_degrees=None)
    np.testing.assert_allclose(silent.angles["knee_flexion_r"][-1], 90.0, atol=1e-6)
    assert silent.finding("angle unit") in silent.to_confirm
    wrong = read_angles(tmp_path, {"knee_angle_r": curve}, in_degrees="yes")
    assert wrong.finding("angle unit") in wrong.to_confirm
    profile = ImportProfile(angle_unit="rad")
    repaired = read_reference(tmp_path / "a.mot", profile)
    np.testing.assert_allclose(repaired.angles["knee_flexion_r"][-1], 90.0, atol=1e-6)


def test_plug_in_gait_angles(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "time_s,LKneeAngles.x,LShoulderAngles.y,LKneeAngles.y\n0,10,20,1\n0.1,11,20,1\n"
    )
    reference = read_reference(path)
    assert reference.angles.names == ("knee_flexion_l", "shoulder_adduction_l")
    np.testing.assert_array_equal(reference.angles["shoulder_adduction_l"], [-20, -20])
    assert reference.markers is None


def test_unknown_angle_columns_are_one_plain_sentence(tmp_path):
    with pytest.raises(DataError, match=r"no angle with a known name \(found: foo, bar\)"):
        read_angles(tmp_path, {"foo": np.arange(3.0), "bar": np.arange(3.0)})


def test_a_profile_names_angles(tmp_path):
    path = write_mot(tmp_path / "a.mot", {"kneeL": np.linspace(0, -50, 5)})
    profile = ImportProfile(angles={"knee_flexion_l": AngleRule("kneeL", -1)})
    reference = read_reference(path, profile)
    np.testing.assert_allclose(reference.angles["knee_flexion_l"][-1], 50.0)
    with pytest.raises(DataError, match="names the column 'nothing'"):
        read_reference(path, ImportProfile(angles={"knee_flexion_l": AngleRule("nothing")}))


def test_our_own_names_are_taken_for_ours():
    system, sources = match_angles(OUR_ANGLES)
    assert system == "liftlens"
    assert all(s.sign == 1 and s.ours == s.column for s in sources)


def rotation(axis, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


@pytest.mark.parametrize(
    ("pelvis", "lumbar"),
    [((0, 0, 0), (0, 0, 0)), ((-40, 0, 0), (-30, 0, 0)), ((-20, 5, 30), (-25, 10, -15))],
    ids=["upright", "forward", "all"],
)
def test_trunk_angles_follow_from_pelvis_and_lumbar_angles(tmp_path, pelvis, lumbar):
    """Against the geometry that defines our trunk angles, on a body turned by hand."""
    columns = {
        name: np.full(3, float(value))
        for name, value in zip(
            ("pelvis_tilt", "pelvis_list", "pelvis_rotation"), pelvis, strict=True
        )
    } | {
        name: np.full(3, float(value))
        for name, value in zip(
            ("lumbar_extension", "lumbar_bending", "lumbar_rotation"), lumbar, strict=True
        )
    }
    reference = read_angles(tmp_path, columns)
    hips = rotation("z", pelvis[0]) @ rotation("x", pelvis[1]) @ rotation("y", pelvis[2])
    chest = hips @ rotation("z", lumbar[0]) @ rotation("x", lumbar[1]) @ rotation("y", lumbar[2])
    z, up = np.array([0, 0, 0.1]), np.array([0, 0.5, 0])
    points = [chest @ (up - z), chest @ (up + z), hips @ -z, hips @ z]
    expected = compute_trunk_angles(*(p[None] for p in points))
    got = reference.angles
    np.testing.assert_allclose(got["trunk_inclination"][0], expected.inclination[0], atol=1e-6)
    np.testing.assert_allclose(got["trunk_flexion"][0], expected.flexion[0], atol=1e-6)
    np.testing.assert_allclose(got["trunk_lateral_bend"][0], expected.lateral_bend[0], atol=1e-6)


# --------------------------------------------------------------------------- as a whole


def test_a_confirmed_profile_reads_the_file_alike_and_for_sure(tmp_path):
    labels, position = moving_markers()
    stored = write_in_axes(position, ("-y", "z", "-x")) * 1000
    path = write_trc(tmp_path / "a.trc", exchange_labels(labels), stored)
    first = read_reference(path, ImportProfile(swap_sides=True))
    again = read_reference(path, describe_profile(first))
    np.testing.assert_allclose(again.markers.position, first.markers.position)
    assert again.landmarks == first.landmarks
    assert again.to_confirm == ()


def test_a_reference_survives_pickling_read_only():
    labels, position = moving_markers()
    reference = pickle.loads(pickle.dumps(interpret(record(position, labels))))
    assert not reference.markers.position.flags.writeable


def test_a_recording_without_anything_is_refused():
    empty = Recording("a.csv", "csv", np.arange(3.0))
    with pytest.raises(DataError, match="holds no markers and no angle"):
        interpret(empty)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_gaps_of_any_kind_lead_to_findings_or_one_plain_sentence(seed, gap_share, lost_share):
    """Samples, coordinates and whole markers may be missing; nothing may be invented."""
    rng = np.random.default_rng(seed)
    labels, position = moving_markers(6)
    position[rng.random(position.shape) < gap_share] = np.nan
    position[:, rng.random(len(labels)) < lost_share] = np.nan
    try:
        reference = interpret(record(position, labels))
    except DataError:
        return
    seen = np.isfinite(reference.markers.position).all(axis=2)
    np.testing.assert_array_equal(seen, np.isfinite(position).all(axis=2))
