from __future__ import annotations

import ezc3d
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from engine.errors import DataError
from engine.validation.reference.files import read_recording
from engine.validation.reference.vicon import is_vicon_csv
from tests.engine.validation.recordings import moving_markers, write_mot, write_trc

# --------------------------------------------------------------------------- TRC


def test_trc_keeps_numbers_names_unit_and_times(tmp_path):
    labels, position = moving_markers(5)
    recording = read_recording(write_trc(tmp_path / "a.trc", labels, position * 1000))
    assert recording.labels == labels
    np.testing.assert_allclose(recording.position, position * 1000, atol=1e-5)
    np.testing.assert_allclose(recording.time_s, [0.0, 0.01, 0.02, 0.03, 0.04])
    assert recording.length_unit == "mm"


def test_trc_blank_and_zero_points_are_missing(tmp_path):
    labels, position = moving_markers(4)
    position[1, 0] = np.nan
    position[2, 3] = 0.0
    recording = read_recording(write_trc(tmp_path / "a.trc", labels, position, unit="m"))
    expected = np.zeros((4, len(labels)), dtype=bool)
    expected[1, 0] = expected[2, 3] = True
    np.testing.assert_array_equal(np.isnan(recording.position).all(axis=2), expected)


def test_trc_missing_last_marker_may_shorten_the_line(tmp_path):
    labels, position = moving_markers(3)
    path = write_trc(tmp_path / "a.trc", labels, position, unit="m")
    lines = path.read_text().splitlines()
    lines[7] = lines[7].rsplit("\t", 3)[0]
    path.write_text("\n".join(lines))
    missing = np.isnan(read_recording(path).position)
    assert missing[1, -1].all()
    assert missing.sum() == 3


def test_trc_decimal_commas(tmp_path):
    labels, position = moving_markers(3)
    path = write_trc(tmp_path / "a.trc", labels, position, unit="m")
    path.write_text(path.read_text().replace(".", ","))
    np.testing.assert_allclose(read_recording(path).position, position, atol=1e-5)


def test_trc_with_one_separator_per_label_and_times_heading(tmp_path):
    """As some exporters write the label row."""
    labels, position = moving_markers(3)
    path = write_trc(tmp_path / "a.trc", labels, position, unit="m")
    lines = path.read_text().splitlines()
    lines[3] = "Frame#\tTimes\t\t" + "\t\t".join(labels)
    path.write_text("\r\n".join(lines))
    recording = read_recording(path)
    assert recording.labels == labels
    np.testing.assert_allclose(recording.position, position, atol=1e-5)


def test_trc_repeated_times_are_rebuilt_from_the_rate(tmp_path):
    labels, position = moving_markers(9)
    time = np.round(np.arange(9) / 240.0, 2)
    path = write_trc(tmp_path / "a.trc", labels, position, unit="m", rate_hz=240.0, time_s=time)
    recording = read_recording(path)
    np.testing.assert_allclose(recording.time_s, np.arange(9) / 240.0)
    assert "rebuilt from 240 Hz" in recording.notes[0]


def test_trc_jump_in_time_is_reported_and_kept(tmp_path):
    labels, position = moving_markers(10)
    time = np.arange(10) / 100.0 + np.where(np.arange(10) > 5, 0.5, 0.0)
    path = write_trc(tmp_path / "a.trc", labels, position, unit="m", time_s=time)
    recording = read_recording(path)
    np.testing.assert_allclose(recording.time_s, time)
    assert "0.51 s after 0.05 s" in recording.notes[0]


def test_trc_cut_off_is_reported(tmp_path):
    labels, position = moving_markers(4)
    path = write_trc(tmp_path / "a.trc", labels, position, unit="m", n_announced=90)
    assert read_recording(path).notes == ("The header announces 90 frames, the file has 4.",)


# --------------------------------------------------------------------------- MOT


def test_mot_short_names_and_unit(tmp_path):
    curve = np.radians(np.linspace(0, 90, 7))
    path = write_mot(tmp_path / "a.mot", {"knee_angle_r": curve}, in_degrees="no")
    recording = read_recording(path)
    assert recording.curves == ("knee_angle_r",)
    assert recording.angle_unit == "rad"
    np.testing.assert_allclose(recording.value[:, 0], curve, rtol=1e-8)


def test_sto_paths_lose_speeds_and_muscles(tmp_path):
    curve = np.linspace(0, 1, 4)
    path = write_mot(
        tmp_path / "a.sto",
        {
            "/jointset/walker_knee_r/knee_angle_r/value": curve,
            "/jointset/walker_knee_r/knee_angle_r/speed": curve * 9,
            "/forceset/soleus_r/activation": curve * 5,
        },
        in_degrees="no",
    )
    recording = read_recording(path)
    assert recording.curves == ("knee_angle_r",)
    np.testing.assert_allclose(recording.value[:, 0], curve, atol=1e-8)


# --------------------------------------------------------------------------- C3D


def write_c3d(path, labels, position, *, unit="mm", missing=(), angles=()):
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    c3d["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = list(labels)
    if angles:
        c3d.add_parameter("POINT", "ANGLES", list(angles))
    points = np.ones((4, len(labels), len(position)))
    points[:3] = position.transpose(2, 1, 0)
    residuals = np.zeros((1, len(labels), len(position)))
    for frame, column in missing:
        residuals[0, column, frame] = -1.0
    c3d["data"]["points"] = points
    c3d["data"]["meta_points"]["residuals"] = residuals
    c3d.write(str(path))
    return path


def test_c3d_markers_gaps_and_unit(tmp_path):
    labels, position = moving_markers(6)
    path = write_c3d(tmp_path / "a.c3d", labels, position * 1000, missing=[(2, 1)])
    recording = read_recording(path)
    assert recording.labels == labels
    assert recording.length_unit == "mm"
    np.testing.assert_allclose(recording.time_s, np.arange(6) / 100.0)
    assert np.isnan(recording.position[2, 1]).all()
    keep = np.isfinite(recording.position)
    assert keep.sum() == keep.size - 3
    np.testing.assert_allclose(recording.position[keep], (position * 1000)[keep], rtol=1e-6)


def test_c3d_angles_are_no_markers_and_moments_are_dropped(tmp_path):
    labels, position = moving_markers(6)
    extra = np.tile([[[40.0, 5.0, -3.0], [1.0, 2.0, 3.0]]], (6, 1, 1))
    path = write_c3d(
        tmp_path / "a.c3d",
        (*labels, "LKneeAngles", "LKneeMoment"),
        np.concatenate([position * 1000, extra], axis=1),
        angles=["LKneeAngles"],
    )
    recording = read_recording(path)
    assert recording.labels == labels
    assert recording.curves == ("LKneeAngles.x", "LKneeAngles.y", "LKneeAngles.z")
    np.testing.assert_allclose(recording.value[3], [40.0, 5.0, -3.0], rtol=1e-6)


# --------------------------------------------------------------------------- Vicon CSV

NEXUS = """\
Model Outputs
100
,,Anna:LKneeAngles,,,Anna:LKneeMoment,,,
Frame,Sub Frame,X,Y,Z,X,Y,Z
,,deg,deg,deg,N.mm/kg,N.mm/kg,N.mm/kg
3,0,10.5,1,2,9,9,9
4,0,11.5,1,2,9,9,9
5,0,,,,9,9,9

Trajectories
100
,,Anna:LASI,,,Anna:RASI,,
Frame,Sub Frame,X,Y,Z,X,Y,Z
,,mm,mm,mm,mm,mm,mm
3,0,1,2,3,4,5,6
4,0,1,2,3,,,
5,0,1,2,3,4,5,7
"""


def test_vicon_blocks(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(NEXUS)
    recording = read_recording(path)
    assert recording.format == "vicon-csv"
    np.testing.assert_allclose(recording.time_s, [0.02, 0.03, 0.04])
    assert recording.labels == ("Anna:LASI", "Anna:RASI")
    assert recording.length_unit == "mm"
    np.testing.assert_array_equal(recording.position[2], [[1, 2, 3], [4, 5, 7]])
    assert np.isnan(recording.position[1, 1]).all()
    assert recording.curves[0] == "Anna:LKneeAngles.x"
    assert len(recording.curves) == 3
    np.testing.assert_array_equal(recording.value[:, 0], [10.5, 11.5, np.nan])


def test_vicon_with_semicolons_commas_and_no_unit_row(tmp_path):
    text = NEXUS.replace(",,deg,deg,deg,N.mm/kg,N.mm/kg,N.mm/kg\n", "")
    text = text.replace(",,mm,mm,mm,mm,mm,mm\n", "").replace(",", ";").replace("10.5", "10,5")
    path = tmp_path / "a.csv"
    path.write_text(text.replace("11.5", "11,5"), encoding="utf-16")
    recording = read_recording(path)
    assert recording.length_unit is None
    assert recording.curves == tuple(f"Anna:LKneeAngles.{a}" for a in "xyz")
    np.testing.assert_array_equal(recording.value[:2, 0], [10.5, 11.5])


def test_only_vicon_blocks_are_taken_for_vicon():
    assert is_vicon_csv(["", "Trajectories;;", "100"])
    assert not is_vicon_csv(["time,LASI_x,LASI_y,LASI_z", "0,1,2,3"])


# --------------------------------------------------------------------------- plain CSV


def test_plain_markers_with_units_in_the_headings(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("Time (ms),LASI_x (mm),LASI_y (mm),LASI_z (mm)\n0,1,2,3\n10,1,2,4\n")
    recording = read_recording(path)
    np.testing.assert_allclose(recording.time_s, [0.0, 0.01])
    assert recording.labels == ("LASI",)
    assert recording.length_unit == "mm"
    np.testing.assert_array_equal(recording.position[:, 0], [[1, 2, 3], [1, 2, 4]])


def test_plain_markers_with_two_rows_of_headings(tmp_path):
    path = tmp_path / "a.tsv"
    path.write_text("\tLASI\t\t\tRASI\t\t\ntime\tX\tY\tZ\tX\tY\tZ\n0\t1\t2\t3\t4\t5\t6\n")
    recording = read_recording(path)
    assert recording.labels == ("LASI", "RASI")
    np.testing.assert_array_equal(recording.position[0], [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    "body",
    ["0;1,5;-2,25\n0,01;2,5;-3\n", '0;"1,5";"-2,25"\n"0,01";"2,5";-3\n'],
    ids=["bare", "quoted"],
)
def test_plain_angles_with_decimal_commas(tmp_path, body):
    path = tmp_path / "a.csv"
    path.write_text("time_s;knee_flexion_l_deg;trunk_flexion_deg\n" + body)
    recording = read_recording(path)
    assert recording.curves == ("knee_flexion_l", "trunk_flexion")
    assert recording.angle_unit == "deg"
    np.testing.assert_allclose(recording.value, [[1.5, -2.25], [2.5, -3.0]])


def test_our_own_angle_table_keeps_its_errors(tmp_path):
    path = tmp_path / "angles.csv"
    path.write_text("time_s,knee_flexion_l_deg,knee_flexion_l_sigma_deg\n0,10,2.5\n0.1,,\n")
    recording = read_recording(path)
    assert recording.curves == ("knee_flexion_l",)
    np.testing.assert_array_equal(recording.value[:, 0], [10.0, np.nan])
    np.testing.assert_array_equal(recording.sigma[:, 0], [2.5, np.nan])


# --------------------------------------------------------------------------- bad input

GOOD_HEAD = "PathFileType\t4\nDataRate\tUnits\n100\tmm\nFrame#\tTime\tA\nx\n"
BAD = {
    "missing.trc": (None, "There is no file"),
    "empty.trc": ("", "is empty"),
    "word.trc": (GOOD_HEAD + "1\t0\t1\t2\tabc\n", r"line 6, column 5.*'abc'"),
    "notrc.trc": ("hello\n", "is no TRC file"),
    "back.trc": (
        GOOD_HEAD + "1\t0\t1\t2\t3\n2\t0.5\t1\t2\t3\n3\t0.2\t1\t2\t3\n",
        "line 8: the time does not increase",
    ),
    "inch.trc": (GOOD_HEAD.replace("mm", "inch") + "1\t0\t1\t2\t3\n", "unit 'inch'"),
    "noframes.trc": (GOOD_HEAD, "holds no frames"),
    "long.trc": (GOOD_HEAD + "1\t0\t1\t2\t3\t4\n", "expected 5 columns"),
    "nohead.mot": ("time\tknee\n0\t1\n", "no line 'endheader'"),
    "end.mot": ("x\nendheader\n", "ends after its header"),
    "notime.mot": ("x\nendheader\nknee\thip\n1\t2\n", "'time' as first column"),
    "vec.sto": ("DataType=Vec3\nendheader\ntime\ta\n0\t1,2,3\n", "save the markers as TRC"),
    "fake.c3d": ("no c3d at all", "is no C3D file"),
    "notime.csv": ("a,b\n1,2\n", "has no time column"),
    "nohead.csv": ("0,1,2\n1,2,3\n", "has no headings"),
    "words.csv": ("a,b\nc,d\n", "no table of numbers"),
    "commas.csv": ("time,a,b\n0,1,2\n0,5,1,7,3\n", "Decimal commas"),
    "mixed.csv": ("time;a;b\n0.5;1,234.5;2\n", "mixes points and commas"),
    "norate.csv": (
        "Trajectories\nfast\n,,A\nFrame,Sub Frame,X\n1,0,2\n",
        "expected the frame rate",
    ),
    "noframe.csv": ("Trajectories\n100\n1,0,2\n", "starts with 'Frame'"),
    "devices.csv": ("Devices\n1000\n,,F\nFrame,Sub Frame,Fx\n1,0,2\n", "has no block"),
    "what.xyz": ("1", "ending that is not known"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_one_plain_sentence(tmp_path, name):
    content, message = BAD[name]
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=message):
        read_recording(path)


def test_a_c3d_without_points_is_one_plain_sentence(tmp_path):
    c3d = ezc3d.c3d()
    c3d["data"]["points"] = np.ones((4, 0, 5))
    del c3d["data"]["rotations"]
    c3d.write(str(tmp_path / "a.c3d"))
    with pytest.raises(DataError, match="holds no points"):
        read_recording(tmp_path / "a.c3d")


def test_a_damaged_c3d_is_one_plain_sentence(tmp_path):
    labels, position = moving_markers(6)
    path = write_c3d(tmp_path / "a.c3d", labels, position)
    whole = path.read_bytes()
    for size, reason in ((700, "damaged C3D file"), (len(whole) - 1500, "cut off")):
        path.write_bytes(whole[:size])
        with pytest.raises(DataError, match=reason):
            read_recording(path)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"LABELS", b"LABELX", "lacks the parameter POINT:LABELS"),
        (b"POINT", b"PAINT", "lacks the parameter POINT"),
        (b"\x02\x54", b"\x02\x63", "unknown processor 99"),
    ],
    ids=["labels", "group", "processor"],
)
def test_a_c3d_with_damaged_parameters_is_one_plain_sentence(tmp_path, old, new, reason):
    path = tmp_path / "a.c3d"
    data = build_c3d(np.ones((2, 3, 3)), ("A", "B", "C"), processor=84, scale=-1.0)
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    with pytest.raises(DataError, match=reason):
        read_recording(path)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seed=st.integers(0, 2**32 - 1))
def test_any_damage_to_a_c3d_is_one_plain_sentence_or_still_readable(tmp_path, seed):
    rng = np.random.default_rng(seed)
    labels, position = moving_markers(6)
    path = tmp_path / "whole.c3d"
    if not path.exists():
        write_c3d(path, labels, position)
    data = bytearray(path.read_bytes())
    for _ in range(rng.integers(1, 8)):
        data[rng.integers(0, min(len(data), 4000))] = rng.integers(0, 256)
    damaged = tmp_path / "damaged.c3d"
    damaged.write_bytes(data[: rng.integers(2, len(data))] if seed % 3 == 0 else data)
    try:
        recording = read_recording(damaged)
    except DataError:
        return
    assert recording.time_s.size == recording.position.shape[0]


def build_c3d(position, labels, *, processor, scale, first_frame=1, n_analog=0):
    """Build a C3D file by hand, in any byte order, as floats or scaled integers."""
    order = ">" if processor == 86 else "<"

    def floats(values):
        values = np.asarray(values, dtype=np.float32)
        if processor != 85:
            return values.astype(f"{order}f4").tobytes()
        halves = (values * 4).astype("<f4").view("<u2").reshape(-1, 2)[:, ::-1]
        return halves.tobytes()

    def integer(value):
        return np.array(value, f"{order}u2").tobytes()

    def record(group, key, kind, dimensions, content):
        body = bytes([kind & 0xFF, len(dimensions), *dimensions]) + content + b"\0"
        head = bytes([len(key), group & 0xFF]) + key.encode()
        return head + np.array(len(body) + 2, f"{order}u2").tobytes() + body

    width = max(map(len, labels))
    names = "".join(label.ljust(width) for label in labels).encode()
    group = bytes([5, 0xFF]) + b"POINT" + np.array(3, f"{order}u2").tobytes() + b"\0"
    parameters = (
        bytes([1, 0x50, 2, processor])
        + group
        + record(1, "SCALE", 4, (), floats([scale]))
        + record(1, "RATE", 4, (), floats([50.0]))
        + record(1, "LABELS", -1, (width, len(labels)), names)
        + record(1, "UNITS", -1, (2,), b"mm")
        + record(1, "USED", 2, (), integer(len(labels)))
        + record(1, "FRAMES", 2, (), integer(len(position)))
        + record(1, "DATA_START", 2, (), integer(4))
    ).ljust(1024, b"\0")
    n_frames = len(position)
    words = [0, len(labels), n_analog, first_frame, first_frame + n_frames - 1, 0, 0, 0, 4, 0]
    header = bytearray(np.array(words, f"{order}u2").tobytes().ljust(512, b"\0"))
    header[:2] = bytes([2, 0x50])
    residual = np.where(np.isnan(position).any(axis=2), -1.0, 0.0)[..., None]
    stored = np.nan_to_num(position) / (1.0 if scale < 0 else scale)
    points = np.concatenate([stored, residual], axis=2).reshape(n_frames, -1)
    table = np.column_stack([points, np.full((n_frames, n_analog), 7.0)])
    if scale < 0:
        return bytes(header) + parameters + floats(table.ravel())
    return bytes(header) + parameters + np.round(table).astype(f"{order}i2").tobytes()


@pytest.mark.parametrize("processor", [84, 85, 86], ids=["intel", "dec", "mips"])
@pytest.mark.parametrize("scale", [-1.0, 0.1], ids=["floats", "integers"])
def test_c3d_of_every_processor_and_number_type(tmp_path, processor, scale):
    position = np.random.default_rng(4).uniform(-2000, 2000, (7, 3, 3))
    position[2, 1] = np.nan
    path = tmp_path / "a.c3d"
    path.write_bytes(
        build_c3d(
            position,
            ("A", "LONG", "C"),
            processor=processor,
            scale=scale,
            first_frame=6,
            n_analog=5,
        )
    )
    recording = read_recording(path)
    assert recording.labels == ("A", "LONG", "C")
    assert recording.length_unit == "mm"
    np.testing.assert_allclose(recording.time_s, np.arange(5, 12) / 50.0)
    np.testing.assert_allclose(recording.position, position, atol=0.051 if scale > 0 else 1e-3)


def test_the_hand_built_c3d_is_what_the_library_reads_too(tmp_path):
    """Else the test above would only compare two readings of the format by the same person."""
    position = np.random.default_rng(4).uniform(-2000, 2000, (7, 3, 3))
    path = tmp_path / "a.c3d"
    for processor, scale in ((84, -1.0), (84, 0.1), (85, -1.0)):
        path.write_bytes(build_c3d(position, ("A", "B", "C"), processor=processor, scale=scale))
        points = ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0)
        np.testing.assert_allclose(points, position, atol=0.051)


def test_a_folder_is_one_plain_sentence(tmp_path):
    folder = tmp_path / "a.trc"
    folder.mkdir()
    with pytest.raises(DataError, match="is a folder"):
        read_recording(folder)


def test_binary_text_is_one_plain_sentence(tmp_path):
    path = tmp_path / "a.trc"
    path.write_bytes(bytes(range(256)) * 4)
    with pytest.raises(DataError, match="no text file"):
        read_recording(path)


def good_files(folder):
    """Return one small good file of every text format."""
    labels, position = moving_markers(4)
    write_trc(folder / "a.trc", labels, position * 1000)
    write_mot(folder / "a.mot", {"knee_angle_r": np.arange(4.0), "hip_flexion_r": np.ones(4)})
    (folder / "vicon.csv").write_text(NEXUS)
    (folder / "plain.csv").write_text("time_s,LASI_x,LASI_y,LASI_z\n0,1,2,3\n0.1,1,2,4\n")
    return ("a.trc", "a.mot", "vicon.csv", "plain.csv")


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_any_damage_to_a_text_file_is_one_plain_sentence_or_still_readable(tmp_path, data):
    name = data.draw(st.sampled_from(good_files(tmp_path)))
    lines = (tmp_path / name).read_text().splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        if not lines:
            break
        at = data.draw(st.integers(0, len(lines) - 1))
        what = data.draw(st.sampled_from(["drop", "twice", "cut", "word", "comma", "blank"]))
        cut = data.draw(st.integers(0, max(len(lines[at]) - 1, 0)))
        new = {
            "drop": [],
            "twice": [lines[at]] * 2,
            "cut": [lines[at][:cut]],
            "word": [lines[at][:cut] + "x" + lines[at][cut:]],
            "comma": [lines[at][:cut] + "," + lines[at][cut:]],
            "blank": ["\t"],
        }[what]
        lines[at : at + 1] = new
    damaged = tmp_path / f"damaged_{name}"
    damaged.write_text("\n".join(lines))
    try:
        recording = read_recording(damaged)
    except DataError:
        return
    assert recording.time_s.size
    assert (np.diff(recording.time_s) > 0).all()
