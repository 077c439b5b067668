"""Boards: drawn through exact cameras and found again, or given as exact corners with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from engine.cameras import board as board_module
from engine.cameras._board_timing import find_offset
from engine.cameras._board_views import BoardView, Sightings, _goes_on, collect_views
from engine.cameras.board import BoardSpec, calibrate_board
from engine.datatypes import Frame
from engine.errors import CalibrationError, ConfigError
from engine.optics import camera_centre, project
from tests.engine.cameras.board_scenes import (
    CHARUCO,
    CHECKER,
    draw_board,
    filmed,
    lay_board,
    near_poses,
    pair_of_cameras,
    random_poses,
)


def errors_of(calibration):
    """Return the error vectors of the relative rotation, degrees, and place, m."""
    truth = pair_of_cameras()
    turns, places = [], []
    for one, two in (truth, calibration.cameras):
        turns.append(one.rotation @ two.rotation.T)
        places.append(one.rotation @ camera_centre(two) + one.translation)
    miss = Rotation.from_matrix(turns[1] @ turns[0].T).as_rotvec()
    return np.degrees(miss), places[1] - places[0]


def triangulation_error_m(calibration):
    """Return how far apart true points and points from both exact pictures lie, after aligning."""
    points = np.random.default_rng(4).uniform([-0.5, 0.1, -0.5], [0.5, 1.5, 0.5], (60, 3))
    truth = pair_of_cameras()
    rays = []
    from engine.optics import compute_directions

    for camera, seen in zip(calibration.cameras, truth, strict=True):
        rays.append((camera_centre(camera), compute_directions(camera, project(seen, points))))
    found = []
    for i in range(len(points)):
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for centre, directions in rays:
            across = np.eye(3) - np.outer(directions[i], directions[i])
            normal, right = normal + across, right + across @ centre
        found.append(np.linalg.solve(normal, right))
    found = np.array(found)
    one, two = found - found.mean(axis=0), points - points.mean(axis=0)
    left, _, turned = np.linalg.svd(one.T @ two)
    turned = np.diag([1, 1, np.sign(np.linalg.det(left @ turned))]) @ turned
    return float(np.sqrt(np.mean(np.sum((one @ left @ turned - two) ** 2, axis=1))))


@pytest.mark.parametrize("board", [CHARUCO, CHECKER], ids=lambda b: b.kind)
def test_filmed_boards_give_the_cameras_back(board):
    calibration = calibrate_board(*filmed(board), board, names=("left", "right"), floor_at_s=20.0)
    rotation_deg, place_m = errors_of(calibration)
    assert np.sqrt(np.mean(rotation_deg**2)) < 3.0 * calibration.rotation_sigma_deg < 3.0
    assert np.sqrt(np.mean(place_m**2)) < 3.0 * calibration.translation_sigma_m < 0.06
    assert triangulation_error_m(calibration) < 0.004
    for found, true in zip(calibration.cameras, pair_of_cameras(), strict=True):
        assert found.matrix[0, 0] == pytest.approx(true.matrix[0, 0], rel=0.01)
        assert found.name == true.name
    assert calibration.provenance["reprojection_px"] < 0.3
    assert calibration.source == "board"


def test_a_board_on_the_floor_tells_up_and_floor():
    calibration = calibrate_board(*filmed(CHARUCO), CHARUCO, floor_at_s=20.0)
    first = pair_of_cameras()[0]
    up = first.rotation @ [0.0, 1.0, 0.0]
    tilt_deg = np.degrees(np.arccos(min(1.0, up @ calibration.up)))
    assert tilt_deg < 3.0 * calibration.tilt_sigma_deg < 3.0
    height_m = camera_centre(first)[1] - 0.35
    assert -calibration.floor_m == pytest.approx(height_m, abs=4 * calibration.floor_sigma_m)
    assert calibration.floor_sigma_m < 0.02


def test_the_stated_error_of_lengths_is_that_of_a_ruler_along_the_board():
    assert CHARUCO.size_sigma == pytest.approx(0.0005 / 0.49)
    assert replace(CHARUCO, scale_sigma=0.01).size_sigma == 0.01


def test_given_lenses_are_kept():
    cameras = pair_of_cameras()
    calibration = calibrate_board(*filmed(CHARUCO), CHARUCO, lenses=cameras)
    for found, true in zip(calibration.cameras, cameras, strict=True):
        assert np.array_equal(found.matrix, true.matrix)
    assert np.abs(errors_of(calibration)[0]).max() < 0.2
    wrong = replace(cameras[0], size_px=(640, 360))
    with pytest.raises(CalibrationError, match="is for 640 x 360 px"):
        calibrate_board(*filmed(CHARUCO), CHARUCO, lenses=(wrong, None))


# --- refusals with pictures ------------------------------------------------------------------


def one_picture(board, pose=None):
    camera = pair_of_cameras()[1]
    pose = lay_board((0.0, 0.85, 0.3), camera_centre(camera)) if pose is None else pose
    return draw_board(camera, board, pose)


def as_frames(*images):
    return [Frame(i, float(i), np.ascontiguousarray(image)) for i, image in enumerate(images)]


@pytest.mark.parametrize(
    ("filmed_board", "stated", "said"),
    [
        (CHARUCO, BoardSpec("charuco", 5, 7, 0.07), "columns and rows are exchanged"),
        (CHARUCO, BoardSpec("charuco", 9, 6, 0.07), "count the columns and rows"),
        (CHARUCO, replace(CHARUCO, dictionary="DICT_5X5_50"), "of the set DICT_4X4"),
        (CHECKER, BoardSpec("checkerboard", 7, 4, 0.06), "show 8 x 5 squares"),
        (CHECKER, BoardSpec("checkerboard", 9, 6, 0.06), "show 8 x 5 squares"),
        (CHECKER, CHARUCO, "is in none of 1 pictures"),
    ],
)
def test_a_wrongly_described_board_is_named(filmed_board, stated, said):
    with pytest.raises(CalibrationError, match=said):
        collect_views(as_frames(one_picture(filmed_board)), stated, "left")


def test_a_part_of_a_larger_checkerboard_is_not_taken_for_it():
    """A finder may return a part of a board; then squares follow beyond it."""
    picture = one_picture(CHECKER)
    grid = collect_views(as_frames(picture), CHECKER, "x").views[0].pixels.reshape(4, 7, 2)
    gray = np.ascontiguousarray(picture[..., 0])
    assert not _goes_on(gray, grid.reshape(-1, 2), (7, 4))
    for part in (grid[:, :-1], grid[:-1], grid[1:], grid[:, 1:]):
        assert _goes_on(gray, part.reshape(-1, 2), part.shape[1::-1])


def test_mirrored_pictures_of_markers_are_named():
    with pytest.raises(CalibrationError, match="mirrored"):
        collect_views(as_frames(one_picture(CHARUCO)[:, ::-1]), CHARUCO, "left")


def test_pictures_of_changing_size_are_refused():
    picture = one_picture(CHARUCO)
    with pytest.raises(CalibrationError, match="different sizes"):
        collect_views(as_frames(picture, picture[:-2]), CHARUCO, "left")


def test_no_pictures_are_refused():
    with pytest.raises(CalibrationError, match="no pictures of camera left"):
        collect_views([], CHARUCO, "left")


@pytest.mark.parametrize("board", [CHARUCO, CHECKER], ids=lambda b: b.kind)
def test_corners_are_found_to_a_tenth_of_a_pixel(board):
    camera = pair_of_cameras()[1]
    pose = lay_board((0.05, 0.85, 0.2), (0.3, 1.3, 2.0), 10.0)
    view = collect_views(as_frames(draw_board(camera, board, pose)), board, "right").views[0]
    middle = np.array([board.columns, board.rows, 0.0]) * board.square_m / 2
    truth = project(camera, (board.corners - middle) @ pose[:, :3].T + pose[:, 3])
    miss = np.linalg.norm(view.pixels - truth[view.rows], axis=1)
    assert np.median(miss) < 0.12
    assert len(view.rows) >= 0.7 * len(board.corners)


@pytest.mark.parametrize("turn", [0, 2])
def test_a_checkerboard_upside_down_keeps_its_numbers(turn):
    picture = one_picture(CHECKER)
    turned = np.rot90(picture, turn)
    views = [collect_views(as_frames(p), CHECKER, "x").views[0].pixels for p in (picture, turned)]
    back = views[1] if turn == 0 else [picture.shape[1] - 1, picture.shape[0] - 1] - views[1]
    assert np.abs(back - views[0]).max() < 0.2


# --- exact corners with noise ----------------------------------------------------------------


def corners_seen(camera, board, poses, *, noise_px=0.05, seed=0, step_s=1.0, start_s=0.0):
    """Return the views of a perfect finder; poses of which a corner leaves the picture are not."""
    rng = np.random.default_rng(seed)
    middle = np.array([board.columns, board.rows, 0.0]) * board.square_m / 2
    views = []
    for index, pose in enumerate(poses):
        if pose is None:
            continue
        pixels = project(camera, (board.corners - middle) @ pose[:, :3].T + pose[:, 3])
        pixels = pixels + rng.normal(0, noise_px, pixels.shape)
        inside = (pixels > 0).all() and (pixels < camera.size_px).all()
        if inside:
            time_s = start_s + index * step_s
            views.append(BoardView(time_s, np.arange(len(pixels)), pixels))
    return Sightings(camera.name, camera.size_px, tuple(views), len(poses))


@pytest.fixture
def calibrate(monkeypatch):
    """Calibrate from given sightings instead of pictures."""

    def run(first, second, board, **options):
        given = {"first": first, "second": second}
        monkeypatch.setattr(board_module, "collect_views", lambda _frames, name, **_: given[name])
        return calibrate_board([], [], board, **options)

    return run


def both_see(board, poses, **options):
    cameras = pair_of_cameras()
    return [
        corners_seen(c, board, p, seed=i, **options)
        for i, (c, p) in enumerate(zip(cameras, poses, strict=True))
    ]


def rich_plan(n_pairs=14, n_near=12, seed=5):
    cameras = pair_of_cameras()
    pairs = random_poses(n_pairs, seed)
    near = [near_poses(camera, n_near, seed + i) for i, camera in enumerate(cameras)]
    gap = [None] * n_near
    return [*pairs, *near[0], *gap], [*pairs, *gap, *near[1]]


@pytest.mark.parametrize(
    "board", [CHARUCO, CHECKER, BoardSpec("checkerboard", 7, 5, 0.06)], ids=["a", "b", "symmetric"]
)
def test_exact_corners_give_the_cameras_back(calibrate, board):
    first, second = both_see(board, rich_plan())
    if board.is_symmetric:
        # The finder can't tell which way round: turn every other view of one camera.
        turned = [
            replace(v, pixels=v.pixels[::-1]) if i % 2 else v for i, v in enumerate(second.views)
        ]
        second = replace(second, views=tuple(turned))
    calibration = calibrate(first, second, board)
    rotation_deg, place_m = errors_of(calibration)
    assert np.sqrt(np.mean(rotation_deg**2)) < 2.5 * calibration.rotation_sigma_deg < 1.0
    assert np.sqrt(np.mean(place_m**2)) < 2.5 * calibration.translation_sigma_m < 0.02


def test_stated_errors_hold_over_many_films(calibrate):
    ratios = []
    for seed in range(5):
        plan_of_seed = rich_plan(10, 9, seed * 7)
        cameras = pair_of_cameras()
        seen = [
            corners_seen(c, CHECKER, p, noise_px=0.2, seed=seed * 2 + i)
            for i, (c, p) in enumerate(zip(cameras, plan_of_seed, strict=True))
        ]
        calibration = calibrate(*seen, CHECKER)
        rotation_deg, place_m = errors_of(calibration)
        ratios.append(
            [
                np.sqrt(np.mean(rotation_deg**2)) / calibration.rotation_sigma_deg,
                np.sqrt(np.mean(place_m**2)) / calibration.translation_sigma_m,
            ]
        )
    rms = np.sqrt(np.mean(np.square(ratios), axis=0))
    assert np.all((rms > 0.4) & (rms < 1.6))


def test_a_few_mistaken_views_are_left_out(calibrate):
    first, second = both_see(CHECKER, rich_plan())
    views = list(second.views)
    views[2] = replace(views[2], pixels=views[2].pixels + np.array([40.0, -25.0]))
    calibration = calibrate(first, replace(second, views=tuple(views)), CHECKER)
    assert np.abs(errors_of(calibration)[0]).max() < 0.6


def test_a_mirrored_checkerboard_video_is_named(calibrate):
    first, second = both_see(CHECKER, rich_plan())
    width = second.size_px[0]
    board = CHECKER
    rows = np.arange(len(board.corners)).reshape(board.rows - 1, board.columns - 1)
    # A finder numbers a mirrored board from the other end, columns odd: from below.
    order = rows[:, ::-1].ravel() if board.columns % 2 else rows[::-1].ravel()
    views = [
        replace(v, pixels=(v.pixels * [-1.0, 1.0] + [width - 1.0, 0.0])[order])
        for v in second.views
    ]
    with pytest.raises(CalibrationError, match="one of first and second were not mirrored"):
        calibrate(first, replace(second, views=tuple(views)), board)


def test_videos_that_do_not_belong_together_are_refused(calibrate):
    first, second = both_see(CHARUCO, rich_plan())
    views = [replace(v, time_s=first.views[i].time_s) for i, v in enumerate(second.views[::-1])]
    with pytest.raises(CalibrationError, match="differs from one board pose to the next"):
        calibrate(first, replace(second, views=tuple(views[: len(first.views)])), CHARUCO)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda v: [], "only 0 times"),
        (lambda v: [replace(w, speed_px_s=900.0) for w in v], "at rest in both"),
    ],
)
def test_too_few_common_views_are_refused(calibrate, change, said):
    first, second = both_see(CHARUCO, rich_plan())
    common = [v for v in second.views if v.time_s < 14]
    rest = [v for v in second.views if v.time_s >= 14]
    views = (*change(common), *rest)
    with pytest.raises(CalibrationError, match=said):
        calibrate(first, replace(second, views=views), CHARUCO)


def test_a_board_only_in_the_middle_is_refused(calibrate):
    poses = [lay_board((0, 0.82, 0), (x, 1.2, 2.0)) for x in np.linspace(-0.3, 0.3, 9)]
    first, second = both_see(CHARUCO, (poses, poses))
    with pytest.raises(CalibrationError, match=r"The board was in .* expected 35%"):
        calibrate(first, second, CHARUCO)


def test_squares_of_a_wrong_unit_are_noticed(calibrate):
    first, second = both_see(CHARUCO, rich_plan())
    with pytest.raises(CalibrationError, match=r"0\.\d\d m apart.*Measure the squares"):
        calibrate(first, second, replace(CHARUCO, square_m=0.0085))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"square_m": 0.004}, r"centimetres: did you mean 40 mm"),
        ({"square_m": 70.0}, "must be 8 to 500 mm"),
        ({"kind": "grid"}, "charuco or checkerboard"),
        ({"columns": 2}, "3 to 30"),
        ({"kind": "checkerboard", "columns": 5, "rows": 5}, "same from four sides"),
        ({"marker_m": 0.08}, "smaller than squares"),
        ({"dictionary": "DICT_9X9"}, "Unknown set"),
    ],
)
def test_impossible_boards_are_refused(options, said):
    with pytest.raises(ConfigError, match=said):
        BoardSpec(**options)


# --- time between videos ---------------------------------------------------------------------


def moving(name, shift_s, *, seed=0, n=400, scale=1.0):
    """Return views whose board moves and rests in turn, as a person carries it."""
    rng = np.random.default_rng(3)
    times = np.arange(n) * 0.1
    rhythm = np.repeat(rng.uniform(0, 1, n // 8 + 20) > 0.5, 8)[: n + 100].astype(float)
    grid = np.random.default_rng(seed)
    views = []
    for time_s in times:
        at = int((time_s + shift_s) / 0.1)
        speed = scale * 120 * rhythm[at] * grid.uniform(0.7, 1.3) + 2.0
        views.append(
            BoardView(time_s, np.arange(4), np.array([[0, 0], [80, 0], [0, 60], [80, 60.0]]), speed)
        )
    return Sightings(name, (960, 540), tuple(views), n)


@pytest.mark.parametrize("offset_s", [-4.2, 0.0, 3.7])
def test_the_movement_of_the_board_tells_the_time_between_videos(offset_s):
    first = moving("a", 5.0, seed=1)
    second = moving("b", 5.0 + offset_s, seed=2, scale=0.6)
    assert find_offset((first, second)) == pytest.approx(offset_s, abs=0.11)


def test_a_board_that_never_moves_tells_no_time():
    still = [replace(v, speed_px_s=1.0) for v in moving("a", 0).views]
    seen = replace(moving("a", 0), views=tuple(still))
    with pytest.raises(CalibrationError, match="does not tell the time"):
        find_offset((seen, seen))
