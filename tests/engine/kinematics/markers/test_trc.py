"""Reading TRC files as laboratories write them, and writing them back."""

import numpy as np
import pytest

from engine.datatypes import Status
from engine.errors import DataError, UnitError
from engine.kinematics.markers import read_marker_trc, write_marker_trc
from engine.skeletons import LIFTING_45, SYNTHETIC_45
from tests.engine.kinematics.markers.builders import make_lift


@pytest.fixture(scope="module")
def recording():
    return make_lift(n_frames=40).recording


@pytest.fixture
def path(recording, tmp_path):
    target = tmp_path / "markers.trc"
    write_marker_trc(recording, target)
    return target


def edit(path, old, new, *, line=None):
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = range(len(lines)) if line is None else [line]
    for row in rows:
        lines[row] = lines[row].replace(old, new)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def scale_numbers(path, factor):
    lines = path.read_text(encoding="utf-8").splitlines()
    for i in range(6, len(lines)):
        cells = lines[i].split("\t")
        cells[2:] = [f"{float(c) * factor:.8f}" for c in cells[2:]]
        lines[i] = "\t".join(cells)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def test_what_is_written_is_read_back(recording, path):
    back = read_marker_trc(path)
    assert back.names == SYNTHETIC_45.keypoints
    assert back.rate_hz == pytest.approx(30.0, rel=1e-4)
    np.testing.assert_allclose(back.position_m, recording.position_m, atol=1e-8)
    np.testing.assert_allclose(back.time_s, recording.time_s, atol=1e-6)
    assert back.notes == ()


def test_metres_are_read_as_metres(recording, path):
    scale_numbers(path, 0.001)
    edit(path, "\tmm\t", "\tm\t", line=2)
    np.testing.assert_allclose(read_marker_trc(path).position_m, recording.position_m, atol=1e-6)


def test_a_person_of_a_kilometre_is_refused(path):
    edit(path, "\tmm\t", "\tm\t", line=2)
    with pytest.raises(UnitError, match=r"1\.\d+ km tall.*look like mm"):
        read_marker_trc(path)


def test_a_person_of_a_millimetre_is_refused(path):
    scale_numbers(path, 0.001)
    with pytest.raises(UnitError, match="look like m; correct Units"):
        read_marker_trc(path)


def test_an_unknown_unit_is_refused(path):
    edit(path, "\tmm\t", "\tfurlong\t", line=2)
    with pytest.raises(UnitError, match="furlong"):
        read_marker_trc(path)


def test_names_of_other_conventions_and_subject_prefixes_are_understood(recording, path, caplog):
    for old, new in (("RASI", "Anna:R.ASIS"), ("LLEP", "Anna:LFLE"), ("CLAV", "Anna:IJ")):
        edit(path, f"\t{old}\t", f"\t{new}\t", line=3)
    back = read_marker_trc(path)
    np.testing.assert_allclose(back.position_m, recording.position_m, atol=1e-8)
    assert "Anna:R.ASIS as RASI" in back.notes[0]
    assert back.notes[0] in caplog.text


def test_any_order_of_columns(recording, path, tmp_path):
    order = np.random.default_rng(0).permutation(len(recording.names))
    from dataclasses import replace

    shuffled = replace(
        recording,
        position_m=recording.position_m[:, order],
        names=tuple(recording.names[i] for i in order),
    )
    target = tmp_path / "shuffled.trc"
    write_marker_trc(shuffled, target)
    np.testing.assert_allclose(read_marker_trc(target).position_m, recording.position_m, atol=1e-8)


def test_missing_markers_are_nan_columns_and_too_many_are_refused(path):
    for name in ("HTOP", "RUPA"):
        edit(path, f"\t{name}\t", f"\tunknown_{name}\t", line=3)
    back = read_marker_trc(path)
    lost = [back.names.index(n) for n in ("HTOP", "RUPA")]
    assert np.isnan(back.position_m[:, lost]).all()
    assert np.isfinite(np.delete(back.position_m, lost, axis=1)).all()
    assert "HTOP, RUPA" in back.notes[0]
    for name in SYNTHETIC_45.keypoints[:20]:
        edit(path, f"\t{name}\t", f"\tx{name}\t", line=3)
    with pytest.raises(DataError, match="of the 45 markers"):
        read_marker_trc(path)


def test_short_gaps_are_filled_and_said_so_long_ones_stay(path, recording):
    lines = path.read_text(encoding="utf-8").splitlines()
    for i in range(6 + 10, 6 + 15):  # 5 frames at 30 Hz: 0.17 s
        cells = lines[i].split("\t")
        cells[2:5] = ["", "", ""]
        lines[i] = "\t".join(cells)
    for i in range(6 + 10, 6 + 20):  # 10 frames: 0.33 s, as zeros
        cells = lines[i].split("\t")
        cells[5:8] = ["0.0", "0.0", "0.0"]
        lines[i] = "\t".join(cells)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    back = read_marker_trc(path)
    assert back.is_filled[10:15, 0].all()
    assert back.is_filled.sum() == 5
    # The head moves at 3 m/s there.
    assert np.abs(back.position_m[10:15, 0] - recording.position_m[10:15, 0]).max() < 0.03
    assert np.isnan(back.position_m[10:20, 1]).all()
    track = back.as_track()
    assert set(track.status[10:15, 0]) == {Status.FILLED}
    assert set(track.status[10:20, 1]) == {Status.MISSING}


def test_z_up_is_turned(recording, path, tmp_path):
    from dataclasses import replace

    p = recording.position_m
    lying = replace(recording, position_m=np.stack([p[..., 0], -p[..., 2], p[..., 1]], axis=-1))
    target = tmp_path / "z_up.trc"
    write_marker_trc(lying, target)
    back = read_marker_trc(target)
    np.testing.assert_allclose(back.position_m, p, atol=1e-8)
    assert "Z up" in back.notes[0]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: p.write_text("hello\n"), "no TRC file"),
        (lambda p: p.unlink(), "no file"),
        (lambda p: edit(p, "\t0.100000\t", "\t0.000000\t"), "must increase"),
        (lambda p: edit(p, "\t0.100000\t", "\t0.100000\tabc\t"), "columns|number"),
    ],
    ids=["text", "absent", "time", "cell"],
)
def test_damage_is_told_plainly(path, damage, message):
    damage(path)
    with pytest.raises(DataError, match=message):
        read_marker_trc(path)


def test_the_two_sets_are_the_same_body():
    shared = LIFTING_45.columns_in(SYNTHETIC_45)
    assert len(shared) == 40
    for own, other in shared.items():
        assert LIFTING_45.landmarks[own] == SYNTHETIC_45.landmarks[other]


@pytest.mark.parametrize("marker_set", [LIFTING_45, SYNTHETIC_45], ids=lambda s: s.name)
def test_a_set_has_45_markers_and_mirrors_onto_itself(marker_set):
    assert len(set(marker_set.keypoints)) == len(set(marker_set.landmarks)) == 45
    order = marker_set.mirror_order
    for i, j in enumerate(order):
        mirrored = marker_set.landmarks[i].translate({})
        swapped = (
            mirrored.replace("left_", "right_")
            if mirrored.startswith("left_")
            else mirrored.replace("right_", "left_")
        )
        assert marker_set.landmarks[j] == swapped
