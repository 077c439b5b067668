"""The parts of the dashboard that need no page."""

import ast
import io
import math
from pathlib import Path

import numpy as np
import pytest

import dashboard
from dashboard import labels
from dashboard.cache import sanitise_name
from dashboard.charts import plot_angles, share_missing
from engine.datatypes import FlagLevel, JointAngles, Measurement, Provenance, Status
from engine.jobs.local import JobState
from tests.builders import make_angles, make_lift

ROOT = Path(dashboard.__file__).parent
NAMES = ("knee_flexion_l", "knee_flexion_r")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("lift.mp4", "lift.mp4"),
        ("C:\\Users\\me\\lift.MOV", "lift.mov"),
        ("../../etc/passwd", "passwd"),
        ("hebt Kiste – Täglich.mp4", "hebt_Kiste_Täglich.mp4"),
        (".mp4", "video.mp4"),
        ("", "video"),
        ("a" * 300 + ".mp4", "a" * 60 + ".mp4"),
        ("x.m;p\n4", "x.mp4"),
    ],
)
def test_upload_names_are_safe(name, expected):
    assert sanitise_name(name) == expected


@pytest.mark.parametrize(
    ("measured", "unit", "expected"),
    [
        (Measurement(45.2, 3.6), "cm", "45 ± 4 cm"),
        (Measurement(-12.4, 5.0), "°", "−12 ± 5°"),
        (Measurement(45.2), "cm", "45 cm"),
        (Measurement(math.nan), "cm", "not seen"),
        (Measurement(-0.2, 1.0), "°", "0 ± 1°"),
    ],
)
def test_measurements_are_shown_with_error_and_unit(measured, unit, expected):
    assert labels.format_measurement(measured, unit) == expected


@pytest.mark.parametrize(
    ("interval", "expected"),
    [
        ((1.12, 1.88), "1.1 to 1.9"),
        ((1.9, math.inf), "1.9 or more"),
        ((math.inf, math.inf), "no limit left"),
        ((math.nan, 2.0), ""),
    ],
)
def test_intervals_are_shown_in_words(interval, expected):
    assert labels.format_interval(interval) == expected


@pytest.mark.parametrize(
    ("azimuth", "start"),
    [(0, "the front"), (90, "the right"), (-90, "the left"), (180, "the back"), (-135, "half the")],
)
def test_the_side_a_person_was_filmed_from_is_named(azimuth, start):
    assert labels.name_view(azimuth).startswith(start)
    assert labels.name_view(math.nan) == "unknown"


def test_arithmetic_is_typeset():
    assert labels.typeset("23 x 0.5 - 1 -> 4 deg (x 0.7)") == "23 × 0.5 − 1 → 4° (×\u00a00.7)"
    assert labels.typeset("turned by 30 degrees") == "turned by 30°"
    assert labels.sentence("a doubt") == "A doubt."


def test_every_level_state_and_source_has_words_and_its_own_shape():
    assert set(labels.LEVELS) == set(FlagLevel)
    assert set(labels.PROVENANCE) == set(Provenance)
    assert set(labels.JOB_STATES) == set(JobState)
    shown = [*labels.LEVELS.values(), labels.NOT_JUDGED]
    assert len({label.word for label in shown}) == len(shown)
    style = (ROOT / "assets" / "style.css").read_text(encoding="utf-8")
    assert all(f".ll-shape-{label.css}" in style for label in shown)
    assert all(f".ll-tone-{label.css}" in style for label in shown)


def test_curves_stay_open_where_nothing_was_seen():
    angles = make_angles(missing=[(frame, NAMES[0]) for frame in range(10, 15)])
    figure = plot_angles(angles, NAMES, [])
    band, curve = figure.data[0], figure.data[1]
    assert np.isnan(np.asarray(curve.y)[10:15]).all()
    assert curve.connectgaps is False
    outlines = np.isnan(np.asarray(band.y)).sum()
    assert outlines == 2, "one closed outline on each side of the gap"
    assert share_missing(angles, NAMES) == pytest.approx(5 / 60)


def test_the_band_is_two_standard_errors_to_either_side():
    angles = make_angles(n_frames=2, sigma_deg=5.0)
    band = plot_angles(angles, NAMES[:1], []).data[0]
    assert band.y[0] - angles[NAMES[0]][0] == pytest.approx(9.8)


@pytest.mark.parametrize(
    ("changed", "word"), [(Status.FILLED, "Filled in"), (Status.REPAIRED, "Sides put right")]
)
def test_changed_samples_are_marked_once_in_the_legend(changed, word):
    made = make_angles()
    status = np.array(made.status)
    status[5:8] = changed
    angles = JointAngles(made.time_s, made.value_deg, made.names, made.sigma_deg, status)
    marked = [t for t in plot_angles(angles, NAMES, []).data if t.name == word]
    assert [len(t.x) for t in marked] == [3, 3]
    assert [t.showlegend for t in marked] == [True, False]


def test_curves_before_correction_are_thin_and_keep_their_gaps():
    before = make_angles(missing=[(4, NAMES[0])], names=NAMES[:1])
    figure = plot_angles(make_angles(), NAMES, [], before=before)
    thin = [t for t in figure.data if t.name == "Before correction"]
    assert len(thin) == 1
    assert np.isnan(thin[0].y[4])
    thick = [t for t in figure.data if t.name == "Knee flexion, left"]
    assert thin[0].line.width < thick[0].line.width


def test_left_and_right_differ_by_more_than_colour():
    lines = [t for t in plot_angles(make_angles(), NAMES, []).data if t.name]
    assert len({t.line.dash for t in lines}) == len({t.line.color for t in lines}) == 2
    assert [t.name for t in lines] == ["Knee flexion, left", "Knee flexion, right"]


def test_every_lift_is_shaded():
    figure = plot_angles(
        make_angles(), NAMES, [make_lift(0.2, 0.5), make_lift(0.6, 0.8)], dark=True
    )
    assert [(s.x0, s.x1) for s in figure.layout.shapes] == [(0.2, 0.5), (0.6, 0.8)]
    assert [a.text for a in figure.layout.annotations] == ["Lift 1", "Lift 2"]


@pytest.mark.parametrize("path", sorted((ROOT / "views").glob("*.py")), ids=lambda p: p.stem)
def test_pages_are_thin(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) < 60
    imported = {
        n.name for x in ast.walk(ast.parse(text)) if isinstance(x, ast.Import) for n in x.names
    }
    assert "numpy" not in imported
    assert "session_state" not in text


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda p: p.stem)
def test_session_state_lives_in_one_file(path):
    if path.name != "state.py":
        text = path.read_text(encoding="utf-8")
        assert "session_state" not in text
        assert "query_params[" not in text


def test_charts_need_no_streamlit():
    tree = ast.parse((ROOT / "charts.py").read_text(encoding="utf-8"))
    names = {n.name for x in ast.walk(tree) if isinstance(x, ast.Import) for n in x.names}
    assert "streamlit" not in names
    assert "streamlit" not in (ROOT / "labels.py").read_text(encoding="utf-8")


def test_the_upload_is_written_piece_by_piece(monkeypatch, tmp_path):
    from dashboard import cache
    from engine.storage.library import HOME_VARIABLE

    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path))
    monkeypatch.setattr(cache, "CHUNK_BYTES", 4)
    path = cache.save_upload(io.BytesIO(b"0123456789"), "a.mp4")
    assert path.read_bytes() == b"0123456789"
