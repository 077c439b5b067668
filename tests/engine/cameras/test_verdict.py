"""Calibrations made wrong in known ways, and whether the person gives them away."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from engine.cameras._bundle import rotation_from
from engine.cameras.verdict import check_calibration, summarise_checks
from engine.datatypes import (
    Calibration,
    CalibrationCheck,
    Camera,
    CheckLevel,
    Measurement,
    ViewPose,
)
from engine.errors import CalibrationError
from tests.engine.cameras.truth import Truth, place_camera, read_truth, see

GREEN, AMBER, RED = CheckLevel.GREEN, CheckLevel.AMBER, CheckLevel.RED
CAMERAS = (place_camera(azimuth_deg=50.0), place_camera(azimuth_deg=140.0, distance_m=3.5))


@cache
def clip() -> Truth:
    return read_truth("floor_to_knuckle")


@cache
def views() -> tuple[ViewPose, ...]:
    return tuple(
        see(clip().points, c, clip().time_s, noise_px=1.5, seed=i) for i, c in enumerate(CAMERAS)
    )


def right(*cameras: Camera) -> Calibration:
    return Calibration(cameras or CAMERAS, "file", up=np.array([0.0, 1.0, 0.0]), floor_m=0.0)


def check(calibration: Calibration, seen: tuple[ViewPose, ...] = ()) -> dict[str, CalibrationCheck]:
    """Return the worst check of each key."""
    found: dict[str, CalibrationCheck] = {}
    for one in check_calibration(seen or views(), calibration, Measurement(clip().stature_m, 0.01)):
        known = found.get(one.key)
        if known is None or known.level is GREEN:
            found[one.key] = one
    return found


def turned(camera: Camera, *degrees: float) -> Camera:
    turn = rotation_from(np.radians(degrees))
    return replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)


def scaled(factor: float) -> Calibration:
    return right(*(replace(c, translation=factor * c.translation) for c in CAMERAS))


def zoomed(factor: float) -> Calibration:
    matrices = [np.array(c.matrix) for c in CAMERAS]
    for matrix in matrices:
        matrix[[0, 1], [0, 1]] *= factor
    return right(*(replace(c, matrix=m) for c, m in zip(CAMERAS, matrices, strict=True)))


def mirrored() -> Calibration:
    """Return cameras that see the same pictures of a world turned inside out."""
    return right(CAMERAS[1], CAMERAS[0])


def leaning(degrees: float) -> Calibration:
    return replace(right(), up=rotation_from(np.radians([degrees, 0, 0])) @ [0.0, 1.0, 0.0])


def test_a_right_calibration_is_green_throughout():
    found = check(right())
    assert {key for key, one in found.items() if one.level is not GREEN} == set()
    assert {"reprojection", "mirror", "stature", "gravity", "floor", "sides", "time"} <= set(found)
    summary = summarise_checks(tuple(found.values()))
    assert (summary.key, summary.level, summary.action) == ("summary", GREEN, "")
    assert found["stature"].value == pytest.approx(0.0, abs=3.0)
    assert found["ray_angle"].value == pytest.approx(90.0, abs=4.0)


WRONG: dict[str, tuple[Callable[[], Calibration], str, CheckLevel, str]] = {
    "5 % too small": (lambda: scaled(0.95), "stature", AMBER, "m tall"),
    "12 % too large": (lambda: scaled(1.12), "stature", RED, "Lengths are off by"),
    "in millimetres": (lambda: scaled(1000.0), "camera_height", RED, "unit of length"),
    "cameras exchanged": (mirrored, "mirror", RED, "exchange them"),
    "turned 1 degree": (
        lambda: right(CAMERAS[0], turned(CAMERAS[1], 1.0, 0.0, 0.0)),
        "reprojection",
        AMBER,
        "moved",
    ),
    "turned 8 degrees": (
        lambda: right(CAMERAS[0], turned(CAMERAS[1], 8.0, 0.0, 0.0)),
        "reprojection",
        RED,
        "miss each other",
    ),
    "looks the other way": (
        lambda: right(CAMERAS[0], turned(CAMERAS[1], 0.0, 180.0, 0.0)),
        "in_front",
        RED,
        "behind a camera",
    ),
    "focal length 1.25 times": (lambda: zoomed(1.25), "stature", RED, "focal length"),
    "focal length in mm": (lambda: zoomed(0.006), "field_of_view", RED, "unit (px)"),
    "floor 6 cm high": (lambda: replace(right(), floor_m=0.06), "floor", AMBER, "above"),
    "floor 20 cm low": (lambda: replace(right(), floor_m=-0.20), "floor", RED, "below"),
    "up 8 degrees off": (lambda: leaning(8.0), "gravity", AMBER, "leans 8 degrees"),
    "up sideways": (lambda: leaning(90.0), "gravity", RED, "which axis"),
    "floor above a camera": (
        lambda: replace(right(), floor_m=2.0),
        "camera_height",
        RED,
        "below the floor",
    ),
}


@pytest.mark.parametrize(("make", "key", "level", "words"), WRONG.values(), ids=WRONG)
def test_names_what_is_wrong(make, key, level, words):
    found = check(make())
    assert found[key].level is level
    assert words in f"{found[key].sentence} {found[key].action}"
    assert summarise_checks(tuple(found.values())).level in (level, RED)


@pytest.mark.parametrize(("frames", "level"), [(-3, RED), (2, AMBER)])
def test_names_a_wrong_synchronisation(frames, level):
    first, second = views()
    size = clip().time_s.size - 3
    early, late = slice(0, size), slice(abs(frames), abs(frames) + size)
    parts = (early, late) if frames < 0 else (late, early)
    shifted = tuple(
        see(clip().points[part], camera, clip().time_s[:size], noise_px=1.5)
        for part, camera in zip(parts, CAMERAS, strict=True)
    )
    found = check(right(), shifted)["time"]
    assert found.value == frames
    assert found.level is level
    assert f"{abs(frames)} frames {'late' if frames > 0 else 'early'}" in found.sentence
    assert {first.image.n_frames, second.image.n_frames} == {clip().time_s.size}


def test_another_resolution_is_all_that_is_said():
    small = replace(CAMERAS[0], size_px=(1280, 720))
    (found,) = check(right(small, CAMERAS[1])).values()
    assert (found.key, found.level) == ("picture_size", RED)
    assert "720 x 480" in found.sentence
    assert "1280 x 720" in found.sentence


@pytest.mark.parametrize(("azimuth_deg", "level"), [(100.0, GREEN), (84.0, AMBER), (70.0, RED)])
def test_cameras_close_together_are_named(azimuth_deg, level):
    near = place_camera(azimuth_deg=azimuth_deg)
    seen = tuple(see(clip().points, c, clip().time_s) for c in (CAMERAS[0], near))
    assert check(right(CAMERAS[0], near), seen)["ray_angle"].level is level


def test_without_gravity_only_the_rest_is_checked():
    found = check(Calibration(CAMERAS, "board"))
    assert "floor" not in found
    assert found["gravity"].level is GREEN
    assert "taken from the standing person" in found["gravity"].sentence


def test_an_assumed_stature_proves_nothing_wrong():
    checks = check_calibration(views(), scaled(1.08), Measurement(clip().stature_m, 0.10))
    assert {c.key: c.level for c in checks}["stature"] is GREEN


def test_advice_fits_where_the_calibration_comes_from():
    turned_away = right(CAMERAS[0], turned(CAMERAS[1], 8.0, 0.0, 0.0))
    assert "found from the moving person" in check(turned_away)["reprojection"].action
    from_person = check(replace(turned_away, source="person"))["reprojection"].action
    assert "found from the moving person" not in from_person
    assert "larger movement" in from_person


def test_a_person_seen_by_one_camera_only_is_named():
    first, second = views()
    hidden = replace(second.image, confidence=np.zeros_like(second.image.confidence))
    (found,) = check(right(), (first, replace(second, image=hidden))).values()
    assert (found.key, found.level) == ("person", RED)


def test_a_summary_takes_the_worst_and_counts_its_like():
    checks = [
        CalibrationCheck("a", GREEN, "Fine."),
        CalibrationCheck("b", AMBER, "Doubtful.", "Look."),
        CalibrationCheck("c", RED, "Wrong.", "Repair."),
        CalibrationCheck("d", RED, "Also wrong.", "Repair that."),
    ]
    summary = summarise_checks(checks)
    assert (summary.level, summary.action) == (RED, "Repair.")
    assert summary.sentence == "Wrong. (1 more check is like that.)"
    assert summarise_checks(checks[:2]).sentence == "Doubtful."


def test_wrong_calls_are_refused():
    with pytest.raises(CalibrationError, match="two views and two cameras, got 2 and 1"):
        check_calibration(views(), right(CAMERAS[0]), Measurement(1.7))
    with pytest.raises(CalibrationError, match="no check"):
        summarise_checks([])
