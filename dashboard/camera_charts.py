"""Where the cameras stood, as a figure. No Streamlit here, so that reports and tests can use it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from dashboard.charts import DARK, LIGHT
from engine.datatypes import Array, Calibration, Camera, PoseTrack
from engine.optics import camera_centre
from engine.skeletons import get_skeleton

FRUSTUM_M = 0.45
"""How far the drawn pyramid of a camera reaches."""
LABEL_M = 0.3
"""How far behind a camera its name stands."""
FLOOR_M = 0.5
"""Size of the floor's tiles."""


def plot_cameras(
    calibration: Calibration, track: PoseTrack | None = None, *, dark: bool = False
) -> go.Figure:
    """Draw cameras, floor and person.

    Parameters
    ----------
    calibration
        Cameras in a world with Y up and the floor at 0, m.
    track
        The person's joints in the same world; drawn where most of them were seen first.
    dark
        Whether the page is dark.
    """
    figure = go.Figure()
    person = _clearest(track)
    # A dark figure on a light floor, or the reverse.
    ink = "#d7dee6" if dark else "#35424e"
    _add_floor(figure, *_extent(calibration, person), dark=dark)
    if person is not None and track is not None:
        _add_person(figure, person, track.skeleton, color=ink)
    colors = DARK if dark else LIGHT
    for number, camera in enumerate(calibration.cameras):
        _add_camera(figure, camera, f"Camera {number + 1}", color=colors[number % len(colors)])
    hidden = {"visible": False, "showspikes": False}
    figure.update_layout(
        height=420,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        paper_bgcolor="rgba(0,0,0,0)",
        showlegend=False,
        scene={
            "xaxis": hidden,
            "yaxis": hidden,
            "zaxis": hidden,
            "aspectmode": "data",
            "camera": {"eye": {"x": 0.75, "y": -1.1, "z": 0.8}, "center": {"z": -0.15}},
        },
    )
    return figure


def describe_cameras(calibration: Calibration) -> str:
    """Say in words what the figure shows."""
    places = []
    for number, camera in enumerate(calibration.cameras):
        x, y, z = camera_centre(camera)
        away = float(np.hypot(x, z))
        places.append(f"camera {number + 1} stands {away:.1f} m from the person, {y:.1f} m high")
    angle = angle_between(calibration)
    return f"Cameras, floor and person: {'; '.join(places)}; {angle:.0f} degrees between them."


def angle_between(calibration: Calibration) -> float:
    """Return the angle at the person between the directions to two cameras, degrees."""
    first, second = (camera_centre(camera)[[0, 2]] for camera in calibration.cameras[:2])
    cosine = first @ second / max(float(np.linalg.norm(first) * np.linalg.norm(second)), 1e-9)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _clearest(track: PoseTrack | None) -> Array | None:
    """Return the joints (K, 3) of the first frame in which most of them were seen."""
    if track is None or not track.n_frames:
        return None
    frame = int(np.argmax(track.is_present.sum(axis=1)))
    return track.position[frame]


def _extent(calibration: Calibration, person: Array | None) -> tuple[Array, Array]:
    """Return the lower and upper corner (x, z) of the floor to draw, m, on whole tiles."""
    points = [camera_centre(camera)[[0, 2]] for camera in calibration.cameras]
    points += [np.array([-0.8, -0.8]), np.array([0.8, 0.8])]
    if person is not None:
        points += list(person[np.isfinite(person).all(axis=1)][:, [0, 2]])
    lower, upper = np.min(points, axis=0), np.max(points, axis=0)
    return (
        FLOOR_M * np.floor((lower - 0.2) / FLOOR_M),
        FLOOR_M * np.ceil((upper + 0.2) / FLOOR_M),
    )


def _upright(points: Array) -> tuple[Array, Array, Array]:
    """Return points (N, 3) in the figure's axes, whose third points up."""
    return points[:, 0], -points[:, 2], points[:, 1]


def _add_lines(figure: go.Figure, pairs: Sequence[Array], name: str, **line: object) -> None:
    gap = np.full((1, 3), np.nan)
    joined = np.concatenate([part for pair in pairs for part in (pair, gap)])
    x, y, z = _upright(joined)
    figure.add_scatter3d(x=x, y=y, z=z, mode="lines", name=name, line=line, hoverinfo="skip")


def _add_floor(figure: go.Figure, lower: Array, upper: Array, *, dark: bool) -> None:
    (x0, z0), (x1, z1) = lower, upper
    lines = [np.array([[x, 0, z0], [x, 0, z1]]) for x in np.arange(x0, x1 + FLOOR_M / 2, FLOOR_M)]
    lines += [np.array([[x0, 0, z], [x1, 0, z]]) for z in np.arange(z0, z1 + FLOOR_M / 2, FLOOR_M)]
    x, y, z = _upright(np.array([[x0, 0, z0], [x1, 0, z0], [x1, 0, z1], [x0, 0, z1]]))
    figure.add_mesh3d(
        x=x,
        y=y,
        z=z - 0.005,
        i=[0, 0],
        j=[1, 2],
        k=[2, 3],
        color="#1d2833" if dark else "#eef2f5",
        flatshading=True,
        lighting={"ambient": 1.0, "diffuse": 0.0, "specular": 0.0},
        hoverinfo="skip",
        name="Floor",
    )
    _add_lines(figure, lines, "Floor", color="#46525e" if dark else "#b6c2cd", width=1.5)


def _add_person(figure: go.Figure, person: Array, skeleton: str, *, color: str) -> None:
    known = get_skeleton(skeleton)
    bones = [person[[known.index(a), known.index(b)]] for a, b in known.edges]
    seen = [bone for bone in bones if np.isfinite(bone).all()]
    if seen:
        _add_lines(figure, seen, "Person", color=color, width=6)


def _add_camera(figure: go.Figure, camera: Camera, name: str, *, color: str) -> None:
    centre = camera_centre(camera)
    width, height = camera.size_px
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    flat = (corners - camera.matrix[:2, 2]) / np.diag(camera.matrix)[:2]
    rays = np.concatenate([flat, np.ones((4, 1))], axis=1) @ camera.rotation
    tips = centre + FRUSTUM_M * rays
    edges = [np.stack([centre, tip]) for tip in tips]
    edges += [tips[[i, (i + 1) % 4]] for i in range(4)]
    _add_lines(figure, edges, name, color=color, width=4)
    x, y, z = _upright(centre[None])
    figure.add_scatter3d(
        x=x,
        y=y,
        z=z,
        mode="markers",
        marker={"size": 5, "color": color},
        name=name,
        hovertemplate=f"{name}<br>%{{z:.2f}} m above the floor<extra></extra>",
    )
    # Behind the camera, where none of its lines is.
    x, y, z = _upright((centre - LABEL_M * camera.rotation[2])[None])
    figure.add_scatter3d(
        x=x,
        y=y,
        z=z,
        mode="text",
        text=[name],
        textfont={"color": color, "size": 13},
        name=name,
        hoverinfo="skip",
    )
