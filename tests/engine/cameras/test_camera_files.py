"""Camera files are built here from known cameras, and must give these cameras back."""

from __future__ import annotations

import contextlib
import io
import json
import math
import pickle
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from engine.cameras.files import format_calibration, match_cameras, read_calibration
from engine.datatypes import Calibration, Camera, CheckLevel
from engine.errors import CalibrationError
from engine.optics import camera_centre, project
from tests.engine.cameras.board_scenes import pair_of_cameras

TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
POINTS = np.array([[0.1, 0.2, 0.9], [-0.5, 0.3, 1.7], [0.4, -0.6, 0.0]])


def look(name, centre, *, size_px=(1280, 720), focal_px=1100.0, distortion=(0, 0, 0, 0, 0)):
    """Place a camera in a world with Z up, looking at a point 1 m above its origin."""
    forward = np.array([0.0, 0.0, 1.0]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.array([[focal_px, 0, 650.0], [0, focal_px + 2, 352.0], [0, 0, 1.0]])
    return Camera(name, size_px, matrix, rotation, -rotation @ centre, np.array(distortion, float))


def two_cameras():
    return (
        look("left", np.array([-2.0, -3.0, 1.2]), distortion=(-0.05, 0.14, 0.0006, -0.0007, 0)),
        look("right", np.array([2.5, -2.5, 1.5]), focal_px=1050.0),
    )


def assert_same(read, cameras, *, atol_px=1e-3):
    for one, two in zip(read.cameras, cameras, strict=True):
        assert one.size_px == two.size_px
        assert np.allclose(project(one, POINTS), project(two, POINTS), atol=atol_px)
        assert np.allclose(camera_centre(one), camera_centre(two), atol=1e-5)


def write_qualisys(cameras, *, left=0, top=0):
    parts = ['<?xml version="1.0"?><calibration><cameras>']
    for camera in cameras:
        rows = np.diag([1.0, -1.0, -1.0]) @ camera.rotation
        x, y, z = camera_centre(camera) * 1000
        width, height = camera.size_px
        turned = " ".join(
            f'r{i + 1}{j + 1}="{rows[i, j]:.12f}"' for i in range(3) for j in range(3)
        )
        k1, k2, p1, p2, k3 = camera.distortion
        parts.append(
            f'<camera active="1" serial="{camera.name}" avg-residual="0.4">'
            f'<fov_video left="{left}" top="{top}" right="{left + width - 1}" '
            f'bottom="{top + height - 1}"/><transform x="{x}" y="{y}" z="{z}" {turned}/>'
            f'<intrinsic focalLengthU="{camera.matrix[0, 0] * 64}" '
            f'focalLengthV="{camera.matrix[1, 1] * 64}" '
            f'centerPointU="{(camera.matrix[0, 2] + left) * 64}" '
            f'centerPointV="{(camera.matrix[1, 2] + top) * 64}" radialDistortion1="{k1}" '
            f'radialDistortion2="{k2}" radialDistortion3="{k3}" tangentalDistortion1="{p1}" '
            f'tangentalDistortion2="{p2}"/></camera>'
        )
    return "".join(parts) + "</cameras></calibration>"


def write_pose2sim(cameras, *, scale=1.0, extra=""):
    lines = []
    for index, camera in enumerate(cameras):
        lines += [
            f"[cam_{index}]",
            f'name = "{camera.name}"',
            f"size = [{camera.size_px[0]}.0, {camera.size_px[1]}.0]",
            f"matrix = {camera.matrix.tolist()}",
            f"distortions = {camera.distortion[:4].tolist()}",
            f"rotation = {cv2.Rodrigues(camera.rotation)[0].ravel().tolist()}",
            f"translation = {(camera.translation * scale).tolist()}",
            extra,
        ]
    return "\n".join([*lines, "[metadata]", "adjusted = false", "error = 0.21"])


def opencap_table(camera):
    return {
        "distortion": camera.distortion[None],
        "intrinsicMat": camera.matrix,
        "imageSize": np.array([[camera.size_px[1]], [camera.size_px[0]]]),
        "rotation": camera.rotation,
        "translation": camera.translation[:, None] * 1000,
        "rotation_EulerAngles": Rotation.from_matrix(camera.rotation).as_euler("xyz"),
    }


def write(tmp_path, text, name="calib.toml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


class TestQualisys:
    def test_cameras_come_in_metres_with_z_up(self, tmp_path):
        cameras = two_cameras()
        path = write(tmp_path, write_qualisys(cameras), "Calib.qca.txt")
        read = read_calibration(path)
        assert_same(read, cameras)
        assert read.source == "file"
        assert read.up.tolist() == [0, 0, 1]
        assert read.floor_m == 0.0
        assert read.provenance["residual_mm"] == pytest.approx(0.4)

    def test_the_shown_part_of_the_sensor_shifts_the_centre(self, tmp_path):
        path = write(tmp_path, write_qualisys(two_cameras(), left=40, top=16), "a.qca.txt")
        assert_same(read_calibration(path), two_cameras())

    def test_inactive_cameras_are_left_out(self, tmp_path):
        off = look("off", np.array([0.0, -3.0, 1.0]))
        text = write_qualisys([*two_cameras(), off])
        text = text.replace('active="1" serial="off"', 'active="0" serial="off"')
        assert [c.name for c in read_calibration(write(tmp_path, text)).cameras] == [
            "left",
            "right",
        ]

    @pytest.mark.parametrize(
        ("old", "new", "said"),
        [
            ('focalLengthU="', 'focalLengthX="', "lacks focalLengthU"),
            ('r11="', 'r11="9', "not a rotation matrix"),
            ('x="', 'x="nan', "finite number"),
            ("</camera>", "", "cut off"),
            ('<?xml version="1.0"?>', '<!DOCTYPE a [<!ENTITY b "c">]>', "entities"),
            ("<intrinsic", "<other", "lacks its intrinsic"),
        ],
    )
    def test_what_is_wrong_is_said(self, tmp_path, old, new, said):
        text = write_qualisys(two_cameras()).replace(old, new, 1)
        with pytest.raises(CalibrationError, match=said):
            read_calibration(write(tmp_path, text))

    def test_one_camera_is_not_enough(self, tmp_path):
        with pytest.raises(CalibrationError, match="has 1 cameras; expected 2"):
            read_calibration(write(tmp_path, write_qualisys(two_cameras()[:1])))


class TestPose2Sim:
    def test_cameras_come_back(self, tmp_path):
        read = read_calibration(write(tmp_path, write_pose2sim(two_cameras())))
        assert_same(read, two_cameras())
        assert read.up.tolist() == [0, 0, 1]
        assert read.provenance["error"] == 0.21

    def test_millimetres_are_noticed_and_said(self, tmp_path):
        read = read_calibration(write(tmp_path, write_pose2sim(two_cameras(), scale=1000.0)))
        assert_same(read, two_cameras())
        assert "millimetres" in read.provenance["notes"][0]

    def test_centimetres_are_refused(self, tmp_path):
        with pytest.raises(CalibrationError, match=r"unit .* is unclear.*4\.\d m if centimetres"):
            read_calibration(write(tmp_path, write_pose2sim(two_cameras(), scale=100.0)))

    def test_a_world_of_the_first_camera_has_no_up(self, tmp_path):
        one, two = two_cameras()
        relative = two.rotation @ one.rotation.T
        first = Camera("a", one.size_px, one.matrix)
        second = Camera(
            "b", two.size_px, two.matrix, relative, two.translation - relative @ one.translation
        )
        read = read_calibration(write(tmp_path, write_pose2sim([first, second])))
        assert np.isnan(read.up).all()
        assert math.isnan(read.floor_m)
        assert "person tells where up is" in read.provenance["notes"][0]

    def test_a_world_with_y_up_is_not_taken_for_one_with_z_up(self, tmp_path):
        """Seen slantwise, level cameras could be tilted ones lying on their side."""
        level = pair_of_cameras()
        read = read_calibration(write(tmp_path, write_pose2sim(level)))
        assert np.isnan(read.up).all()

    @pytest.mark.parametrize(
        ("old", "new", "said"),
        [
            ("[metadata]", "fisheye = true\n[metadata]", "fisheye"),
            ("matrix = [[1100.0,", "matrix = [[0.0,", "singular"),
            ("matrix = [[1100.0,", "matrix = [[nan,", "not finite"),
            ("matrix = [[1100.0,", 'matrix = [["x",', "finite numbers, got"),
            ("matrix = [[1100.0,", "matrix = [[11.0,", "field of view"),
            ("size = [1280.0, 720.0]", "size = [1280.5, 720]", "whole numbers"),
            ("size = [1280.0, 720.0]", "size = [720, 300]", "leaves its 720 x 300"),
            ("rotation = [", "rotatoin = [", "rotation of camera 'left' is missing"),
            ("translation = [", "translation = [1, ", "3 finite numbers"),
            ('name = "right"', 'name = "left"', "more than one camera named 'left'"),
        ],
    )
    def test_what_is_wrong_is_said(self, tmp_path, old, new, said):
        text = write_pose2sim(two_cameras())
        assert old in text
        with pytest.raises(CalibrationError, match=said):
            read_calibration(write(tmp_path, text.replace(old, new, 1)))

    def test_cameras_at_one_place_are_refused(self, tmp_path):
        one = two_cameras()[0]
        other = Camera("b", one.size_px, one.matrix, one.rotation, one.translation)
        with pytest.raises(CalibrationError, match="at the same place"):
            read_calibration(write(tmp_path, write_pose2sim([one, other])))

    def test_a_mirrored_rotation_is_refused(self, tmp_path):
        mirrored = np.diag([1.0, 1.0, -1.0]).ravel().tolist()
        text = write_pose2sim(two_cameras())
        start = text.index("rotation = ")
        text = text[:start] + f"rotation = {mirrored}" + text[text.index("\n", start) :]
        with pytest.raises(CalibrationError, match="a mirror"):
            read_calibration(write(tmp_path, text))


class TestOpenCap:
    def save(self, tmp_path, protocol=4, change=lambda table: table):
        for camera in two_cameras():
            folder = tmp_path / "session" / "Videos" / camera.name
            folder.mkdir(parents=True)
            data = pickle.dumps(change(opencap_table(camera)), protocol=protocol)
            (folder / "cameraIntrinsicsExtrinsics.pickle").write_bytes(data)
        return tmp_path / "session"

    @pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4])
    def test_a_session_is_read_whatever_the_protocol(self, tmp_path, protocol):
        read = read_calibration(self.save(tmp_path, protocol))
        assert_same(read, two_cameras())
        assert read.up.tolist() == [0, 0, 1]
        assert math.isnan(read.floor_m)
        assert read.tilt_sigma_deg == 2.0

    def test_single_precision_columns_and_numpy_numbers_are_read(self, tmp_path):
        def change(table):
            table["rotation"] = np.asfortranarray(table["rotation"].astype(">f8"))
            table["translation"] = table["translation"].astype("f4")
            table["error"] = np.float64(0.5)
            return table

        assert_same(read_calibration(self.save(tmp_path, 4, change)), two_cameras(), atol_px=0.01)

    def test_json_is_read_too(self, tmp_path):
        tables = {
            camera.name: {k: np.asarray(v).tolist() for k, v in opencap_table(camera).items()}
            for camera in two_cameras()
        }
        assert_same(read_calibration(write(tmp_path, json.dumps(tables), "c.json")), two_cameras())

    def test_a_single_pickle_asks_for_the_folder(self, tmp_path):
        with pytest.raises(CalibrationError, match="folder of the OpenCap session"):
            read_calibration(write(tmp_path, "", "cameraIntrinsicsExtrinsics.pickle"))

    def test_an_empty_folder_says_what_is_expected(self, tmp_path):
        with pytest.raises(CalibrationError, match="holds no camera"):
            read_calibration(tmp_path)


class Runs:
    """Unpickles by calling a function."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def leave_a_trace(path):
    path.write_text("a program ran")


def hostile_pickles(trace):
    array = pickle.dumps(np.zeros(3), protocol=2)
    reconstruct = b"cnumpy.core.multiarray\n_reconstruct\n"
    return {
        "calls a function": pickle.dumps({"a": Runs(leave_a_trace, trace)}),
        "evaluates text": pickle.dumps({"a": Runs(eval, f"open({str(trace)!r}, 'w')")}),
        "opens a file": pickle.dumps({"a": Runs(open, str(trace), "w")}),
        "array of objects": pickle.dumps({"a": np.array([Runs(leave_a_trace, trace)])}),
        "loads by numpy": pickle.dumps({"a": Runs(np.load, str(trace))}),
        "old instance": b"(i__builtin__\neval\n.",
        "huge memo slot": b"\x80\x02}r\xff\xff\xff\x7f.",
        "huge bytes": b"\x80\x05\x96" + struct.pack("<Q", 1 << 40) + b".",
        "shape without data": array.replace(b"K\x03\x85", b"J\xff\xff\xff\x7f\x85"),
        "state of a function": reconstruct + b"}U\x08__name__U\x01xsb.",
        "not a dictionary": pickle.dumps([1, 2]),
        "keys of numbers": pickle.dumps({1: 2}),
        "a set": pickle.dumps({"a": {1}}),
        "extension": b"\x80\x02\x82\x01.",
        "persistent": b"Pabc\n.",
        "too many steps": b"(" + b"K\x01" * 30_000 + b"l.",
    }


@pytest.mark.parametrize("name", list(hostile_pickles(None)))
def test_hostile_pickles_are_refused_and_run_nothing(tmp_path, name):
    trace = tmp_path / "trace"
    folder = tmp_path / "session" / "cam"
    folder.mkdir(parents=True)
    data = hostile_pickles(trace)[name]
    (folder / "cameraIntrinsicsExtrinsics.pickle").write_bytes(data)
    with pytest.raises(CalibrationError, match=r"could run a program|cut off"):
        read_calibration(tmp_path / "session")
    assert not trace.exists()


@given(st.binary(max_size=200), st.integers(0, 400))
@settings(max_examples=150, deadline=None)
def test_damaged_pickles_are_refused_in_one_sentence(noise, at):
    from engine.cameras.files._plain_pickle import read_plain_pickle

    good = pickle.dumps(opencap_table(two_cameras()[0]))
    data = good[:at] + noise + good[at + len(noise) :]
    # Any other exception fails the test.
    with contextlib.suppress(CalibrationError):
        assert isinstance(read_plain_pickle(data, "a.pickle"), dict)


finite = st.floats(-1e6, 1e6, allow_nan=False)
plain = st.recursive(
    st.text(max_size=20) | finite | st.integers(-(2**62), 2**62) | st.booleans(),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=6,
)


@st.composite
def calibrations(draw):
    def camera(name, x):
        rotation = Rotation.from_euler("xyz", draw(st.tuples(*[st.floats(-3, 3)] * 3))).as_matrix()
        focal = draw(st.floats(500, 3000))
        matrix = np.array([[focal, 0.0, 633.3], [0.0, focal * 1.01, 371.7], [0.0, 0.0, 1.0]])
        distortion = draw(st.lists(st.floats(-0.3, 0.3), min_size=5, max_size=5))
        centre = np.array([x, draw(st.floats(-4, 4)), draw(st.floats(-2, 2))])
        return Camera(name, (1280, 720), matrix, rotation, -rotation @ centre, np.array(distortion))

    name = draw(st.text(min_size=1, max_size=12).filter(lambda t: t.isprintable()))
    sigma = st.one_of(st.just(math.nan), st.floats(0, 10))
    angle = draw(st.floats(-3, 3))
    up = draw(
        st.sampled_from([np.full(3, np.nan), np.array([math.sin(angle), math.cos(angle), 0])])
    )
    return Calibration(
        cameras=(camera(name, 0.0), camera(name + "2", 3.0)),
        source=draw(st.sampled_from(["board", "points", "person", "file"])),
        up=up,
        floor_m=draw(st.one_of(st.just(math.nan), st.floats(-5, 5))),
        scale_sigma=draw(sigma),
        rotation_sigma_deg=draw(sigma),
        translation_sigma_m=draw(sigma),
        tilt_sigma_deg=draw(sigma),
        floor_sigma_m=draw(sigma),
        provenance=draw(st.dictionaries(st.text(max_size=8), plain, max_size=4)),
    )


class TestOwnFormat:
    @given(calibrations())
    @settings(max_examples=80, deadline=None)
    def test_everything_comes_back_exactly(self, tmp_path_factory, calibration):
        path = tmp_path_factory.getbasetemp() / "round_trip.toml"
        path.write_text(format_calibration(calibration), encoding="utf-8", newline="")
        read = read_calibration(path)
        for one, two in zip(read.cameras, calibration.cameras, strict=True):
            assert (one.name, one.size_px) == (two.name, two.size_px)
            for key in ("matrix", "distortion", "rotation", "translation"):
                assert np.array_equal(getattr(one, key), getattr(two, key))
        assert np.array_equal(read.up, calibration.up, equal_nan=True)
        for key in ("floor_m", "scale_sigma", "rotation_sigma_deg", "translation_sigma_m"):
            assert np.array_equal(getattr(read, key), getattr(calibration, key), equal_nan=True)
        assert read.provenance == calibration.provenance

    def test_values_that_toml_has_not_become_plain(self, tmp_path):
        calibration = Calibration(
            two_cameras(),
            "board",
            provenance={"a": np.float64(1.5), "b": (1, None), "c": None, "d": tmp_path, "e": {}},
        )
        read = read_calibration(write(tmp_path, format_calibration(calibration)))
        assert read.provenance == {"a": 1.5, "b": [1], "d": str(tmp_path), "e": {}}

    @pytest.mark.parametrize(
        ("old", "new", "said"),
        [
            ("version = 1", "version = 2", "install the current LiftLens"),
            ('source = "board"', "source = 3", "source .* must be text"),
            ("scale_sigma = nan", "scale_sigma = -1.0", "must not be negative"),
            ("up = [nan, nan, nan]", "up = [0, 0, 2]", "must have length 1"),
            ("[[camera]]", "[[camera]]\ncolour = 1", "unknown key 'colour'"),
            ("floor_m = nan", "floor = 1", "unknown key 'floor'"),
            ("rotation = [[", "rotation = [[1,", "3 x 3 finite numbers"),
            ("size_px = [1280, 720]", "size_px = 3", "size_px of camera 'left'"),
        ],
    )
    def test_what_is_wrong_is_said(self, tmp_path, old, new, said):
        text = format_calibration(Calibration(two_cameras(), "board"))
        assert old in text
        with pytest.raises(CalibrationError, match=said):
            read_calibration(write(tmp_path, text.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("a = 1", "holds no cameras"),
        ("this is no TOML", "is not TOML"),
        ("{}", "holds no cameras"),
        ("{", "is not JSON"),
        ("<a/>", "has 0 cameras"),
    ],
)
def test_other_files_are_refused_with_what_is_expected(tmp_path, content, said):
    with pytest.raises(CalibrationError, match=said):
        read_calibration(write(tmp_path, content))


def test_files_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(CalibrationError, match="There is no calibration file"):
        read_calibration(tmp_path / "none.toml")
    binary = tmp_path / "a.toml"
    binary.write_bytes(io.BytesIO(b"\xff\xfe\x00\x80").getvalue())
    with pytest.raises(CalibrationError, match="is not text"):
        read_calibration(binary)


class TestMatching:
    def named(self, *names):
        cameras = [look(n, np.array([2.0 * i, -3.0, 1.0])) for i, n in enumerate(names)]
        return Calibration(tuple(cameras), "file")

    def test_videos_get_the_camera_of_their_name(self):
        chosen, check = match_cameras(
            self.named("cam1", "cam2", "cam12"), ["lift_CAM12.mp4", "lift_cam1.mp4"]
        )
        assert [c.name for c in chosen.cameras] == ["cam12", "cam1"]
        assert check.level is CheckLevel.GREEN
        assert "by name" in check.sentence

    def test_without_names_the_order_tells_and_is_said(self):
        chosen, check = match_cameras(self.named("a_1", "b_2"), ["one.mp4", "two.mp4"])
        assert [c.name for c in chosen.cameras] == ["a_1", "b_2"]
        assert check.level is CheckLevel.AMBER
        assert "one.mp4 by camera a_1" in check.sentence

    @pytest.mark.parametrize(
        ("names", "videos", "said"),
        [
            (("left", "right"), ["left.mp4", "other.mp4"], "other.mp4; rename"),
            (("a", "b", "c"), ["1.mp4", "2.mp4"], "can't be told which camera filmed 1.mp4"),
            (("left", "right"), ["left_1.mp4", "left_2.mp4"], "Both videos .* 'left'"),
            (("left", "right"), ["1", "2", "3"], "2 cameras for 3 videos"),
        ],
    )
    def test_doubt_is_an_error(self, names, videos, said):
        with pytest.raises(CalibrationError, match=said):
            match_cameras(self.named(*names), videos)

    def test_reading_for_videos_chooses_and_adapts(self, tmp_path):
        path = write(tmp_path, write_pose2sim(two_cameras()))
        read = read_calibration(
            path, names=["x_right.mp4", "x_left.mp4"], sizes_px=[(640, 360)] * 2
        )
        assert [c.name for c in read.cameras] == ["right", "left"]
        assert read.cameras[0].size_px == (640, 360)
        assert len(read.provenance["notes"]) == 3

    def test_reading_for_a_turned_phone_is_refused(self, tmp_path):
        path = write(tmp_path, write_pose2sim(two_cameras()))
        with pytest.raises(CalibrationError, match="held the other way"):
            read_calibration(path, sizes_px=[(720, 1280), (1280, 720)])
