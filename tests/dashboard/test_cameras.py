"""Trials filmed from two sides, and the calibrations a user keeps."""

import math

import numpy as np
import plotly.graph_objects as go
import pytest

from dashboard import cache, camera_charts
from engine.cameras.files.own import format_calibration
from engine.datatypes import Camera
from engine.optics import camera_centre
from engine.storage.results import write_result
from tests.builders import make_calibration, make_pose_track, make_trial_result, make_two_views
from tests.dashboard.test_app import html
from tests.dashboard.test_trial import open_trial


def make_camera(azimuth_deg: float, *, away_m: float = 4.0, height_m: float = 1.2) -> Camera:
    """Make a level camera that looks at the axis above the origin."""
    a = math.radians(azimuth_deg)
    centre = np.array([away_m * math.cos(a), height_m, away_m * math.sin(a)])
    forward = np.array([-math.cos(a), 0.0, -math.sin(a)])
    down = np.array([0.0, -1.0, 0.0])
    rotation = np.stack([np.cross(down, forward), down, forward])
    return Camera(
        name=f"{azimuth_deg:.0f}",
        size_px=(1920, 1080),
        matrix=np.array([[1600.0, 0, 960], [0, 1600.0, 540], [0, 0, 1]]),
        rotation=rotation,
        translation=-rotation @ centre,
    )


@pytest.fixture
def calibration():
    return make_calibration(cameras=(make_camera(90.0), make_camera(170.0, height_m=1.0)))


@pytest.fixture
def two_view_trial(library, calibration, tmp_path):
    result = make_trial_result(**make_two_views(calibration=calibration))
    folder = library.folder("two")
    write_result(result, folder, calibration_text=format_calibration(calibration))
    return "two"


def test_the_angle_between_cameras_is_that_at_the_person(calibration):
    assert camera_charts.angle_between(calibration) == pytest.approx(80.0)


def test_the_figure_shows_every_camera_where_it_stands(calibration):
    figure = camera_charts.plot_cameras(calibration, make_pose_track(n_frames=2))
    names = {trace.name for trace in figure.data}
    assert {"Floor", "Person", "Camera 1", "Camera 2"} <= names
    marks = [t for t in figure.data if t.name == "Camera 2" and t.mode == "markers"]
    x, y, z = camera_centre(calibration.cameras[1])
    assert (marks[0].x[0], marks[0].y[0], marks[0].z[0]) == pytest.approx((x, -z, y))
    (label,) = (t for t in figure.data if t.name == "Camera 2" and t.mode == "text")
    away = [np.hypot(t.x[0], t.y[0]) for t in (label, marks[0])]
    assert away[0] > away[1], "the name stands behind the camera, off its lines"


def test_a_figure_without_a_person_can_be_drawn(calibration):
    assert isinstance(camera_charts.plot_cameras(calibration), go.Figure)
    words = camera_charts.describe_cameras(calibration)
    assert "camera 2 stands 4.0 m from the person, 1.0 m high" in words
    assert "80 degrees between them" in words


def test_a_trial_from_two_sides_says_whether_its_cameras_may_be_trusted(app, two_view_trial):
    shown = html(open_trial(app, two_view_trial))
    assert "With care" in shown
    assert "The cameras look alike. Move one." in shown
    assert "The feet stand on the floor." in shown
    assert "+0.350 ± 0.004 s" in shown
    assert "by the movement" in shown


def test_a_trial_of_one_camera_says_nothing_of_two(app, trial_id):
    opened = open_trial(app, trial_id)
    assert not any("cameras stood" in s.value for s in opened.subheader)


def test_cameras_of_a_trial_can_be_kept_and_chosen_again(app, two_view_trial):
    opened = open_trial(app, two_view_trial)
    next(t for t in opened.text_input if t.label == "Name").set_value("Hall 2").run()
    next(b for b in opened.button if b.label == "Keep").click().run()
    assert list(cache.calibrations().values()) == ["Hall_2"]
    opened.switch_page("views/cameras.py").run()
    assert not opened.exception
    assert "from the moving person" in html(opened)
    next(b for b in opened.button if b.label.startswith("Delete")).click().run()
    assert cache.calibrations() == {}
    assert any("No calibration is kept yet" in i.value for i in opened.info)


def test_a_file_of_another_program_is_taken(app, library):
    page = app.run().switch_page("views/cameras.py").run()
    rows = "\n".join(
        f'[cam_{i}]\nname = "cam_{i}"\nsize = [1920.0, 1080.0]\n'
        "matrix = [[1600.0, 0.0, 960.0], [0.0, 1600.0, 540.0], [0.0, 0.0, 1.0]]\n"
        "distortions = [0.0, 0.0, 0.0, 0.0]\n"
        f"rotation = [1.2, {0.4 * i}, 0.1]\ntranslation = [{0.5 * i}, 0.2, 4.0]\n"
        for i in (1, 2)
    )
    page.file_uploader[0].set_value(("hall.toml", rows.encode(), "application/toml")).run()
    assert not page.exception
    assert any("hall.toml: 2 cameras" in s.value for s in page.success)
    next(b for b in page.button if b.label == "Keep").click().run()
    assert list(cache.calibrations().values()) == ["hall"]


def test_a_file_that_is_none_is_refused_in_one_sentence(app, library):
    page = app.run().switch_page("views/cameras.py").run()
    page.file_uploader[0].set_value(("x.toml", b"a = 1", "application/toml")).run()
    assert not page.exception
    assert "ll-problem" in html(page)
    assert cache.calibrations() == {}
