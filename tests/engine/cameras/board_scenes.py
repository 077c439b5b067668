"""Pictures of boards as exact cameras see them, lens distortion included."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from engine.cameras._board_views import BoardSpec, make_aruco_board
from engine.datatypes import Array, Camera, Frame

Picture = NDArray[np.uint8]

SIZE_PX = (960, 540)
GREY = 110
FINER = 2
"""Pictures are drawn this much finer and averaged, as a sensor does."""
TEXTURE_PX_PER_SQUARE = 60


def make_camera(
    name: str,
    centre: Sequence[float],
    target: Sequence[float] = (0.0, 0.8, 0.0),
    *,
    focal_px: float = 800.0,
    distortion: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0),
    size_px: tuple[int, int] = SIZE_PX,
    roll_deg: float = 0.0,
) -> Camera:
    """Place a camera in a world with Y up, looking at a point."""
    forward = np.asarray(target, dtype=float) - np.asarray(centre, dtype=float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward])
    rotation = Rotation.from_euler("z", roll_deg, degrees=True).as_matrix() @ level
    matrix = np.array(
        [
            [focal_px, 0.0, size_px[0] / 2 + 4.0],
            [0.0, focal_px, size_px[1] / 2 - 6.0],
            [0.0, 0.0, 1.0],
        ]
    )
    return Camera(name, size_px, matrix, rotation, -rotation @ np.asarray(centre), distortion)


def pair_of_cameras() -> tuple[Camera, Camera]:
    """Two phones at nearly right angles, 2 m from the middle, with lenses of their own."""
    return (
        make_camera("left", (-1.3, 1.3, 1.5), distortion=(0.08, -0.15, 0.001, -0.0005, 0.0)),
        make_camera(
            "right", (1.2, 1.1, 1.6), focal_px=760.0, distortion=(-0.06, 0.05, -0.0004, 0.0008, 0.0)
        ),
    )


def lay_board(place: Sequence[float], facing: Sequence[float], turn_deg: float = 0.0) -> Array:
    """Return a board's pose in the world, shape (3, 4): its middle at a place, facing a point."""
    normal = np.asarray(facing, dtype=float) - np.asarray(place, dtype=float)
    normal /= np.linalg.norm(normal)
    # The board's z axis goes into the board, its y axis down.
    down = np.array([0.0, -1.0, 1e-6]) - normal * (np.array([0.0, -1.0, 1e-6]) @ normal)
    down /= np.linalg.norm(down)
    axes = np.stack([np.cross(down, -normal), down, -normal], axis=1)
    axes = axes @ Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    return np.column_stack([axes, place])


def random_poses(n: int, seed: int, *, middle: Sequence[float] = (0.0, 0.85, 0.0)) -> list[Array]:
    """Return board poses about a middle that both cameras of `pair_of_cameras` can read."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(n):
        place = np.asarray(middle) + rng.uniform(-0.3, 0.3, 3)
        facing = np.array([0.0, 1.2, 2.5]) + rng.uniform(-0.8, 0.8, 3)
        poses.append(lay_board(place, facing, float(rng.uniform(-25, 25))))
    return poses


def near_poses(camera: Camera, n: int, seed: int) -> list[Array]:
    """Return board poses close to one camera, all over its picture."""
    rng = np.random.default_rng(seed)
    poses = []
    for index in range(n):
        depth = rng.uniform(1.1, 1.4)
        across = ((index % 3) - 1) * 0.3 + rng.uniform(-0.03, 0.03)
        down = ((index // 3) % 3 - 1) * 0.16 + rng.uniform(-0.02, 0.02)
        local = np.array([across, down, 1.0]) * depth
        turn = Rotation.from_euler("xyz", rng.uniform(-35, 35, 3) * [1, 1, 0.5], degrees=True)
        rotation = camera.rotation.T @ turn.as_matrix()
        place = camera.rotation.T @ (local - camera.translation)
        poses.append(np.column_stack([rotation, place]))
    return poses


@cache
def draw_texture(board: BoardSpec) -> NDArray[np.uint8]:
    """Draw a board with a white margin of one square."""
    step = TEXTURE_PX_PER_SQUARE
    size = (board.columns * step, board.rows * step)
    if board.kind == "charuco":
        inner = make_aruco_board(board).generateImage(size, None, 0, 1)
    else:
        row, column = np.indices(size[::-1]) // step
        inner = np.where((row + column) % 2 == 0, 0, 255).astype(np.uint8)
    return cv2.copyMakeBorder(inner, step, step, step, step, cv2.BORDER_CONSTANT, value=255)


_MAPS: dict[tuple[bytes, bytes, tuple[int, int]], NDArray[np.float32]] = {}


def _lens_map(camera: Camera) -> NDArray[np.float32]:
    """Return where each point of the fine picture lies in that of a lens without distortion."""
    key = (camera.matrix.tobytes(), camera.distortion.tobytes(), camera.size_px)
    if key not in _MAPS:
        width, height = (FINER * side for side in camera.size_px)
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        pixels = (np.stack([x, y], axis=-1) + 0.5) / FINER - 0.5
        straight = cv2.undistortPointsIter(
            pixels.reshape(-1, 1, 2),
            camera.matrix,
            camera.distortion,
            np.eye(3),
            camera.matrix,
            (cv2.TERM_CRITERIA_COUNT, 12, 0.0),
        ).reshape(pixels.shape)
        _MAPS[key] = ((straight + 0.5) * FINER - 0.5).astype(np.float32)
    return _MAPS[key]


def draw_board(camera: Camera, board: BoardSpec, pose: Array, *, blur_px: float = 0.6) -> Picture:
    """Return the picture (H, W, 3) of a board at a pose in the world."""
    rotation = camera.rotation @ pose[:, :3]
    middle = np.array([board.columns, board.rows, 0.0]) * board.square_m / 2
    corner = camera.rotation @ pose[:, 3] + camera.translation - rotation @ middle
    to_pixels = camera.matrix @ np.column_stack([rotation[:, :2], corner])
    texel = board.square_m / TEXTURE_PX_PER_SQUARE
    shift = 0.5 * texel - board.square_m
    to_metres = np.array([[texel, 0.0, shift], [0.0, texel, shift], [0.0, 0.0, 1.0]])
    finer = np.array([[FINER, 0, FINER / 2 - 0.5], [0, FINER, FINER / 2 - 0.5], [0, 0, 1.0]])
    size = (FINER * camera.size_px[0], FINER * camera.size_px[1])
    homography = finer @ to_pixels @ to_metres
    straight = cv2.warpPerspective(draw_texture(board), homography, size, borderValue=GREY)
    bent = cv2.remap(straight, _lens_map(camera), None, cv2.INTER_LINEAR, borderValue=GREY)
    gray = cv2.resize(bent, camera.size_px, interpolation=cv2.INTER_AREA)
    gray = cv2.GaussianBlur(gray, (0, 0), blur_px)
    return np.repeat(gray[..., None], 3, axis=2)


def film(
    camera: Camera,
    board: BoardSpec,
    poses: Sequence[Array | None],
    *,
    step_s: float = 1.0,
    noise: float = 2.0,
) -> Iterator[Frame]:
    """Yield one picture a pose; grey where there is no board."""
    rng = np.random.default_rng(7)
    for index, pose in enumerate(poses):
        if pose is None:
            image = np.full((camera.size_px[1], camera.size_px[0], 3), GREY, np.uint8)
        else:
            image = draw_board(camera, board, pose)
        grain = rng.normal(0, noise, image.shape[:2])[..., None]
        yield Frame(index, index * step_s, np.clip(image + grain, 0, 255).astype(np.uint8))


CHARUCO = BoardSpec("charuco", 7, 5, 0.07)
CHECKER = BoardSpec("checkerboard", 8, 5, 0.06)
ON_FLOOR = lay_board((0.0, 0.35, 0.15), (0.0, 9.0, 0.15))
N_PAIRS, N_NEAR = 8, 6


def plan() -> tuple[list[Array | None], list[Array | None]]:
    """Return what each camera sees in turn: pairs, one camera near the board, the other, floor."""
    cameras = pair_of_cameras()
    pairs = random_poses(N_PAIRS, 1)
    near = [near_poses(camera, N_NEAR, 2 + i) for i, camera in enumerate(cameras)]
    gap = [None] * N_NEAR
    return ([*pairs, *near[0], *gap, ON_FLOOR], [*pairs, *gap, *near[1], ON_FLOOR])


@cache
def filmed(board: BoardSpec) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    """Return the pictures of both cameras, one a second, drawn once."""
    (left, right), (seen_left, seen_right) = pair_of_cameras(), plan()
    return tuple(film(left, board, seen_left)), tuple(film(right, board, seen_right))
