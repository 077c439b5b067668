"""Clicks are exact projections with noise of the stated size."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from engine.cameras.known_points import (
    TEMPLATES,
    calibrate_known_points,
    calibrate_points,
    read_points,
)
from engine.errors import CalibrationError, ShapeError
from engine.optics import camera_centre, project
from tests.engine.cameras.board_scenes import make_camera

SIZE = (1920, 1080)
FOCAL = 1500.0
FOV_DEG = 2 * math.degrees(math.atan(960 / FOCAL))


def two_cameras(middle=(0.0, 0.9, 0.0), *, focal_px=(FOCAL, FOCAL)):
    x, y, z = middle
    places = [(x - 2.4, 1.3, z + 3.2), (x + 2.6, 1.1, z + 2.9)]
    return [
        make_camera(name, place, (x, y, z), focal_px=focal, size_px=SIZE)
        for name, place, focal in zip(("left", "right"), places, focal_px, strict=True)
    ]


def places_of(template, **dimensions):
    return np.stack(list(TEMPLATES[template].place(dimensions).values()))


def click(cameras, world, *, noise_px=0.0, seed=0):
    rng = np.random.default_rng(seed)
    return [project(c, world) + rng.normal(0, noise_px, (len(world), 2)) for c in cameras]


def errors_of(calibration, cameras):
    turns, places = [], []
    for one, two in (cameras, calibration.cameras):
        turns.append(one.rotation @ two.rotation.T)
        places.append(one.rotation @ camera_centre(two) + one.translation)
    miss = np.degrees(Rotation.from_matrix(turns[1] @ turns[0].T).as_rotvec())
    return np.sqrt(np.mean(miss**2)), np.sqrt(np.mean((places[1] - places[0]) ** 2))


@pytest.mark.parametrize("template", list(TEMPLATES))
def test_exact_clicks_give_the_exact_places(template):
    world = places_of(template)
    cameras = two_cameras(world.mean(axis=0))
    calibration = calibrate_points(
        click(cameras, world), world, [SIZE] * 2, lenses=cameras, names=["left", "right"]
    )
    for found, true in zip(calibration.cameras, cameras, strict=True):
        assert np.allclose(camera_centre(found), camera_centre(true), atol=1e-3)
        assert found.name == true.name
    assert calibration.up.tolist() == [0, 1, 0]
    assert calibration.floor_m == 0.0
    assert calibration.source == "points"


@pytest.mark.parametrize("template", ["pallet", "table"])
def test_stated_errors_hold(template):
    """Lens, clicks and measures are all off by what is stated; errors must be as large as said."""
    rng = np.random.default_rng(1)
    world = places_of(template)
    ratios = []
    for seed in range(8 if template == "pallet" else 4):
        focal = FOCAL * np.exp(rng.normal(0, 0.12, 2))
        cameras = two_cameras(world.mean(axis=0), focal_px=focal)
        real = world + rng.normal(0, 0.005, world.shape)
        calibration = calibrate_points(
            click(cameras, real, noise_px=1.9, seed=seed),
            world,
            [SIZE] * 2,
            horizontal_fov_deg=FOV_DEG,
            fov_sigma_deg=7.0,
        )
        rotation_deg, place_m = errors_of(calibration, cameras)
        ratios.append(
            [
                rotation_deg / calibration.rotation_sigma_deg,
                place_m / calibration.translation_sigma_m,
            ]
        )
    rms = np.sqrt(np.mean(np.square(ratios), axis=0))
    assert np.all((rms > 0.35) & (rms < 1.5))


def test_more_points_in_more_places_say_more():
    few, many = places_of("pallet"), places_of("pallet")
    many = np.vstack(
        [many, [[-0.8, 1.5, -0.6], [1.8, 1.5, -0.6], [0.5, 1.0, 1.0], [1.6, 0.0, 0.3]]]
    )
    cameras = two_cameras((0.6, 0.6, 0.2))
    sigmas = [
        calibrate_points(click(cameras, w, noise_px=1.0), w, [SIZE] * 2).translation_sigma_m
        for w in (few, many)
    ]
    assert sigmas[1] < 0.6 * sigmas[0]


def test_points_not_clicked_in_a_view_are_left_out():
    world = places_of("crate")
    cameras = two_cameras(world.mean(axis=0))
    pixels = click(cameras, world)
    pixels[0][2] = pixels[1][5] = np.nan
    calibration = calibrate_points(pixels, world, [SIZE] * 2, lenses=cameras)
    assert errors_of(calibration, cameras)[1] < 1e-3
    assert calibration.provenance["points"] == [7, 7]


def test_the_world_need_not_tell_up():
    world = places_of("crate")
    cameras = two_cameras(world.mean(axis=0))
    calibration = calibrate_points(
        click(cameras, world), world, [SIZE] * 2, up=[np.nan] * 3, floor_m=np.nan
    )
    assert np.isnan(calibration.up).all()
    assert math.isnan(calibration.floor_m)
    assert math.isnan(calibration.tilt_sigma_deg)


def test_a_far_flat_thing_that_allows_two_places_is_refused():
    """Seen from far away, a plane turned to the left looks like one turned to the right."""
    world = places_of("door", width_m=0.2, height_m=0.3)
    cameras = [
        make_camera(n, (x, 0.15, 9.0), (0.1, 0.15, 0.0), focal_px=FOCAL, size_px=SIZE)
        for n, x in (("left", -4.0), ("right", 4.0))
    ]
    with pytest.raises(CalibrationError, match="allow two different places"):
        calibrate_points(
            click(cameras, world, noise_px=1.0), world, [SIZE] * 2, lenses=cameras, up=[np.nan] * 3
        )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda w, p: (w, [q[[1, 0, 2, 3, 4, 5, 6, 7]] for q in p]), "off by|below the floor"),
        (lambda w, p: (w[:5], [q[:5] for q in p]), "5 clicked points not in one plane; expected 6"),
        (lambda w, p: (w[:3], [q[:3] for q in p]), "3 clicked points in one plane; expected 4"),
        (lambda w, p: (w, [q + np.array([3000.0, 0.0]) for q in p]), "outside its 1920 x 1080"),
        (
            lambda w, p: (np.outer(range(8), [1.0, 0.1, 0.0]), p),
            "lie nearly in one line",
        ),
    ],
)
def test_clicks_that_cannot_be_right_are_refused(change, said):
    world = places_of("crate")
    cameras = two_cameras(world.mean(axis=0))
    world, pixels = change(world, click(cameras, world))
    with pytest.raises(CalibrationError, match=said):
        calibrate_points(pixels, world, [SIZE] * 2)


def test_wrong_shapes_are_refused():
    world = places_of("crate")
    with pytest.raises(ShapeError, match="Two or more views"):
        calibrate_points([np.zeros((8, 2))], world, [SIZE])
    with pytest.raises(ShapeError, match=r"shape \(8, 2\)"):
        calibrate_points([np.zeros((7, 2))] * 2, world, [SIZE] * 2)
    with pytest.raises(ShapeError, match="finite"):
        calibrate_points([np.zeros((8, 2))] * 2, world * np.nan, [SIZE] * 2)


# --- points files ----------------------------------------------------------------------------


def write(tmp_path, text):
    path = tmp_path / "points.toml"
    path.write_text(text, encoding="utf-8")
    return path


def points_file(cameras, world, names, head):
    lines = [head]
    for camera in cameras:
        pixels = project(camera, world)
        pairs = [f'"{n}" = [{x}, {y}]' for n, (x, y) in zip(names, pixels.tolist(), strict=True)]
        lines += ["[[view]]", f'video = "{camera.name}.mp4"', f"pixels = {{ {', '.join(pairs)} }}"]
    return "\n".join(lines)


@pytest.mark.parametrize("confirmed", [True, False])
def test_a_points_file_is_read_and_used(tmp_path, confirmed):
    named = TEMPLATES["pallet"].place({"width_m": 1.0}) | {"shelf": np.array([0.2, 1.5, -0.4])}
    world = np.stack(list(named.values()))
    cameras = two_cameras(world.mean(axis=0))
    head = (
        f'template = "pallet"\nconfirmed = {str(confirmed).lower()}\n[dimensions]\nwidth_m = 1.0\n'
    )
    head += "[points]\nshelf = [0.2, 1.5, -0.4]"
    known = read_points(write(tmp_path, points_file(cameras, world, named, head)))
    assert known.names == tuple(named)
    assert np.array_equal(known.world, world)
    assert known.videos == ("left.mp4", "right.mp4")
    calibration = calibrate_known_points(known, [SIZE] * 2, ["left", "right"])
    assert errors_of(calibration, cameras)[1] < 0.1
    assert (calibration.scale_sigma > 0.03) is not confirmed
    assert bool(calibration.provenance["notes"]) is not confirmed


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[view]]\n[[view]]", "neither a template nor"),
        ('template = "sofa"\n[[view]]', "one of door, pallet, table, crate"),
        ('template = "door"\n[dimensions]\ndepth_m = 1', "has no depth_m"),
        ('template = "door"\n[dimensions]\nwidth_m = 86', "0.02 to 20 m, got 86"),
        ('template = "door"', r"needs a \[\[view\]\] table"),
        ('template = "door"\n[[view]]\n[[view]]', "needs pixels"),
        ('template = "door"\n[[view]]\npixels = {knob = [1, 2]}\n[[view]]', "unknown point 'knob'"),
        (
            'template = "door"\n[[view]]\npixels = {"top left" = [1]}\n[[view]]',
            "'top left' .* 2 finite numbers",
        ),
        ("colour = 1", "unknown key 'colour'"),
        ("not toml", "is not TOML"),
        ('template = "door"\npoint_sigma_m = 0\n[[view]]\n[[view]]', "point_sigma_m"),
    ],
)
def test_faults_of_a_points_file_are_named(tmp_path, text, said):
    with pytest.raises(CalibrationError, match=said):
        read_points(write(tmp_path, text))


def test_a_missing_points_file_is_named(tmp_path):
    with pytest.raises(CalibrationError, match="can't be read"):
        read_points(tmp_path / "none.toml")
