"""Calibration with clicked points of something whose measures are known: a door, a pallet, a table.

A few points tell each camera's place once its lens is known, and the lens is known roughly from
what phones have. All views are adjusted together, with the clicks' and the measures' errors; what
stays open is stated as standard errors. Four points in one plane can be explained by two places of
the camera: both are tried.
"""

from __future__ import annotations

import itertools
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from engine.cameras._adjust import Adjusted, Bundle, Lens, LensPrior, Sighting, adjust
from engine.datatypes import Array, Calibration, Camera
from engine.errors import CalibrationError, ShapeError

__all__ = [
    "TEMPLATES",
    "KnownPoints",
    "Template",
    "calibrate_known_points",
    "calibrate_points",
    "read_points",
]

LEAST_PLANAR = 4
LEAST_GENERAL = 6
FLAT_SHARE = 0.02
"""Points count as lying in a plane if none leaves it by more than this share of their extent."""
SIGMA_CLICK_SHARE = 0.001
"""People click a visible corner to about 2 px in a picture of 1920."""
POINT_SIGMA_M = 0.005
UNCONFIRMED_SCALE_SIGMA = 0.03
PLUMB_SIGMA_DEG = 0.5
"""How far floors, walls and doors are off level and plumb."""
FOCAL_STEPS = (-1.6, -0.8, 0.0, 0.8, 1.6)
MOST_STARTS = 3
TWIN_DEG = 8.0
"""Poses nearer to each other than this are one solution."""
DECISIVE = 9.0
"""Chi-square by which the better of two solutions must win: three standard errors."""
MISCLICK_SHARE = 0.01
UPRIGHT_COSINE = 0.5


@dataclass(frozen=True)
class Template:
    """A thing with known measures: their usual values in m, and the names of its points."""

    title: str
    dimensions: Mapping[str, float]

    def place(self, dimensions: Mapping[str, float]) -> dict[str, Array]:
        """Return the named points, m: x to the right, y up, z to the front, floor at y = 0.

        Raises
        ------
        CalibrationError
            If a measure is unknown or can't be right.
        """
        sizes = {**self.dimensions, **dimensions}
        unknown = sorted(set(sizes) - set(self.dimensions))
        if unknown:
            raise CalibrationError(
                f"A {self.title} has no {unknown[0]}; its measures are "
                f"{', '.join(self.dimensions)}."
            )
        for name, value in sizes.items():
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            if not is_number or not 0.02 <= value <= 20.0:
                raise CalibrationError(
                    f"{name} of the {self.title} must be 0.02 to 20 m, got {value!r}."
                )
        width, height, depth = (sizes.get(k, 0.0) for k in ("width_m", "height_m", "depth_m"))
        if self.title == "door":
            return _rectangle(width, height)
        if self.title == "table":
            return {k: v for k, v in _box(width, height, depth).items() if k.startswith("top")}
        return _box(width, height, depth)


def _rectangle(width: float, height: float) -> dict[str, Array]:
    return {
        f"{level} {side}": np.array([x, y, 0.0])
        for level, y in (("bottom", 0.0), ("top", height))
        for side, x in (("left", 0.0), ("right", width))
    }


def _box(width: float, height: float, depth: float) -> dict[str, Array]:
    return {
        f"{level} {end} {side}": np.array([x, y, z])
        for level, y in (("bottom", 0.0), ("top", height))
        for end, z in (("back", 0.0), ("front", depth))
        for side, x in (("left", 0.0), ("right", width))
    }


TEMPLATES: Mapping[str, Template] = {
    "door": Template("door", {"width_m": 0.86, "height_m": 2.01}),
    "pallet": Template("pallet", {"width_m": 1.2, "height_m": 0.144, "depth_m": 0.8}),
    "table": Template("table", {"width_m": 1.6, "height_m": 0.72, "depth_m": 0.8}),
    "crate": Template("crate", {"width_m": 0.6, "height_m": 0.32, "depth_m": 0.4}),
}
"""Usual measures: door opening, EUR pallet (EN 13698-1), desk, large lifting crate."""


@dataclass(frozen=True, eq=False)
class KnownPoints:
    """Points of known places, and where they were clicked in each video.

    `world` (P, 3) m, `pixels` one array (P, 2) a view, NaN where not clicked. `up` is NaN where
    the axes don't tell; `is_confirmed` whether somebody measured the thing.
    """

    names: tuple[str, ...]
    world: Array
    pixels: tuple[Array, ...]
    videos: tuple[str, ...] = ()
    up: Array = field(default_factory=lambda: np.array([0.0, 1.0, 0.0]))
    floor_m: float = 0.0
    point_sigma_m: float = POINT_SIGMA_M
    is_confirmed: bool = True


def calibrate_points(
    pixels: Sequence[Array],
    world: Array,
    sizes_px: Sequence[tuple[int, int]],
    *,
    names: Sequence[str] | None = None,
    lenses: Sequence[Camera | None] | None = None,
    horizontal_fov_deg: float = 58.0,
    fov_sigma_deg: float = 9.0,
    click_sigma_px: float | None = None,
    point_sigma_m: float = POINT_SIGMA_M,
    scale_sigma: float | None = None,
    up: Sequence[float] | Array = (0.0, 1.0, 0.0),
    floor_m: float = 0.0,
) -> Calibration:
    """Calibrate cameras from points whose places are known.

    Parameters
    ----------
    pixels
        One array (P, 2) a view, px; NaN where a point was not clicked.
    world
        Shape (P, 3), m.
    sizes_px
        Width and height of each view's pictures.
    names
        Of the cameras.
    lenses
        Cameras whose matrix and lens are known; None for a phone of unknown field of view.
    horizontal_fov_deg, fov_sigma_deg
        Usual field of view along the longer side, and its standard error.
    click_sigma_px
        Standard error of a click; by default a thousandth of the picture's longer side.
    point_sigma_m
        Standard error of each coordinate of the points.
    scale_sigma
        Relative standard error of all measures together; by default from `point_sigma_m`.
    up, floor_m
        The world's vertical and the floor's height along it; NaN where the points don't tell.

    Returns
    -------
    Calibration
        In the world of the points.

    Raises
    ------
    CalibrationError
        If the points are too few, in a line, clicked wrongly, or allow two answers.
    ShapeError
        If the arrays don't fit together.
    """
    world = np.asarray(world, dtype=np.float64)
    clicked = [np.asarray(p, dtype=np.float64) for p in pixels]
    cameras = [f"camera {i + 1}" for i in range(len(clicked))] if names is None else list(names)
    _require_points(clicked, world, sizes_px, cameras)
    known = [None] * len(clicked) if lenses is None else list(lenses)
    priors = [
        _usual_lens(size, horizontal_fov_deg, fov_sigma_deg) if lens is None else _exact_lens(lens)
        for lens, size in zip(known, sizes_px, strict=True)
    ]
    sigmas = [
        SIGMA_CLICK_SHARE * max(s) if click_sigma_px is None else click_sigma_px for s in sizes_px
    ]
    up = np.asarray(up, dtype=np.float64)
    options = [
        _list_starts(points, world, prior, fov_sigma_deg, horizontal_fov_deg)
        for points, prior in zip(clicked, priors, strict=True)
    ]
    solutions = [
        adjust(_build_problem(clicked, world, priors, starts, sigmas, point_sigma_m))
        for starts in itertools.product(*options)
    ]
    solutions = [s for s in solutions if math.isfinite(s.cost)]
    best = _choose(solutions, up, floor_m)
    _require_fit(best, clicked, cameras, sizes_px)
    extent = float(np.linalg.norm(np.ptp(world, axis=0)))
    scale = math.sqrt(2.0) * point_sigma_m / extent if scale_sigma is None else scale_sigma
    rotation_sigma_deg, translation_sigma_m = best.relative_sigmas(0, 1)
    has_up = bool(np.isfinite(up).all())
    return Calibration(
        cameras=tuple(
            Camera(
                name,
                (size[0], size[1]),
                best.bundle.lenses[i].matrix,
                best.bundle.camera_rotation[i],
                best.bundle.camera_translation[i],
                best.bundle.lenses[i].distortion,
            )
            for i, (name, size) in enumerate(zip(cameras, sizes_px, strict=True))
        ),
        source="points",
        up=up,
        floor_m=floor_m if has_up else math.nan,
        scale_sigma=scale,
        rotation_sigma_deg=rotation_sigma_deg,
        translation_sigma_m=translation_sigma_m,
        tilt_sigma_deg=math.hypot(PLUMB_SIGMA_DEG, math.degrees(point_sigma_m / extent))
        if has_up
        else math.nan,
        floor_sigma_m=math.hypot(point_sigma_m, 0.005) if has_up else math.nan,
        provenance={
            "reprojection_px": round(best.rms_px, 2),
            "points": [int(np.isfinite(p).all(axis=1).sum()) for p in clicked],
            "focal_sigma_px": [round(float(best.lens_sigma(i)[0]), 1) for i in range(len(clicked))],
            "notes": [],
        },
    )


def _require_points(
    clicked: Sequence[Array],
    world: Array,
    sizes_px: Sequence[tuple[int, int]],
    names: Sequence[str],
) -> None:
    if world.ndim != 2 or world.shape[1] != 3 or not np.isfinite(world).all():
        raise ShapeError(f"Points need finite numbers of shape (P, 3), got {world.shape}.")
    if len(clicked) < 2 or len(sizes_px) != len(clicked) or len(names) != len(clicked):
        raise ShapeError(
            f"Two or more views need a size and a name each, got {len(clicked)} views, "
            f"{len(sizes_px)} sizes and {len(names)} names."
        )
    for points, size, name in zip(clicked, sizes_px, names, strict=True):
        if points.shape != (len(world), 2):
            raise ShapeError(f"Clicks need shape ({len(world)}, 2), got {points.shape} in {name}.")
        seen = np.isfinite(points).all(axis=1)
        inside = (points[seen] > -1.0).all() and (points[seen] < np.array(size)).all()
        if not inside:
            raise CalibrationError(
                f"A point clicked in {name} lies outside its {size[0]} x {size[1]} px picture; "
                "click in the video's own size."
            )
        _require_spread(world[seen], points[seen], name)


def _require_spread(world: Array, pixels: Array, name: str) -> None:
    least = LEAST_PLANAR if _is_flat(world) else LEAST_GENERAL
    if len(world) < least:
        kind = "in one plane" if least == LEAST_PLANAR else "not in one plane"
        raise CalibrationError(
            f"{name} has {len(world)} clicked points {kind}; expected {least} or more."
        )
    for values, what in ((world, "lie"), (pixels, "appear")):
        spread = np.linalg.svd(values - values.mean(axis=0), compute_uv=False)
        if spread[1] < 0.03 * spread[0]:
            raise CalibrationError(
                f"The points clicked in {name} {what} nearly in one line; click points farther "
                "apart, to both sides."
            )


def _is_flat(world: Array) -> bool:
    if len(world) < 4:
        return True
    spread = np.linalg.svd(world - world.mean(axis=0), compute_uv=False)
    return bool(spread[2] <= FLAT_SHARE * spread[0])


def _usual_lens(size_px: tuple[int, int], fov_deg: float, sigma_deg: float) -> LensPrior:
    """Return what is known of a phone's lens: field of view, axis near the middle, little bend."""
    half = math.radians(fov_deg) / 2
    focal = 0.5 * max(size_px) / math.tan(half)
    # d(ln f) = -d(fov) / sin(fov)
    focal_sigma = focal * math.radians(sigma_deg) / math.sin(2 * half)
    off_centre = 0.01 * max(size_px)
    mean = np.r_[focal, focal, (np.array(size_px) - 1) / 2, np.zeros(5)]
    sigma = np.array(
        [focal_sigma * math.sqrt(2), focal_sigma * math.sqrt(2), off_centre, off_centre, 0.03]
        + [0.0] * 4
    )
    return LensPrior(mean, sigma)


def _exact_lens(camera: Camera) -> LensPrior:
    return LensPrior.exact(Lens.of(camera))


@dataclass(frozen=True, eq=False)
class _Start:
    lens: Lens
    rotation: Array
    translation: Array
    cost: float


def _list_starts(
    pixels: Array, world: Array, prior: LensPrior, fov_sigma_deg: float, fov_deg: float
) -> list[_Start]:
    """Return the few places of a camera that explain its clicks, over usual lenses."""
    seen = np.isfinite(pixels).all(axis=1)
    starts = []
    relative = math.radians(fov_sigma_deg) / math.sin(math.radians(fov_deg))
    steps = FOCAL_STEPS if prior.sigma[0] > 0 else (0.0,)
    for step in steps:
        values = np.array(prior.mean)
        values[:2] *= math.exp(step * relative)
        starts += _solve(pixels[seen], world[seen], Lens(values), step)
    starts.sort(key=lambda start: start.cost)
    distinct: list[_Start] = []
    for start in starts:
        if all(_angle(start.rotation, other.rotation) > TWIN_DEG for other in distinct):
            distinct.append(start)
    return distinct[:MOST_STARTS]


def _solve(pixels: Array, world: Array, lens: Lens, step: float) -> list[_Start]:
    matrix, distortion = lens.matrix, lens.distortion
    if _is_flat(world):
        # IPPE wants the plane to be z = 0.
        middle, axes = world.mean(axis=0), np.linalg.svd(world - world.mean(axis=0))[2]
        axes[2] = np.cross(axes[0], axes[1])
        local, flag = (world - middle) @ axes.T, cv2.SOLVEPNP_IPPE
        local[:, 2] = 0.0
    else:
        middle, axes, local, flag = np.zeros(3), np.eye(3), world, cv2.SOLVEPNP_SQPNP
    count, turns, places, errors = cv2.solvePnPGeneric(
        local, pixels, matrix, distortion, flags=flag
    )
    found = []
    for i in range(int(count)):
        rotation = np.asarray(cv2.Rodrigues(turns[i])[0], dtype=np.float64) @ axes
        place = np.asarray(places[i], dtype=np.float64).ravel() - rotation @ middle
        if ((world @ rotation.T + place)[:, 2] > 0).all():
            error = float(np.ravel(errors[i])[0])
            cost = error**2 + step**2
            found.append(_Start(lens, rotation, place, cost))
    return found


def _angle(one: Array, two: Array) -> float:
    return float(np.degrees(np.linalg.norm(Rotation.from_matrix(one @ two.T).as_rotvec())))


def _build_problem(
    clicked: Sequence[Array],
    world: Array,
    priors: Sequence[LensPrior],
    starts: Sequence[_Start],
    sigmas: Sequence[float],
    point_sigma_m: float,
) -> Bundle:
    rows = [np.flatnonzero(np.isfinite(points).all(axis=1)) for points in clicked]
    return Bundle(
        lenses=tuple(start.lens for start in starts),
        lens_priors=tuple(priors),
        camera_rotation=np.stack([start.rotation for start in starts]),
        camera_translation=np.stack([start.translation for start in starts]),
        body_rotation=np.eye(3)[None],
        body_translation=np.zeros((1, 3)),
        points=world,
        sightings=tuple(
            Sighting(i, 0, row, points[row], sigma)
            for i, (row, points, sigma) in enumerate(zip(rows, clicked, sigmas, strict=True))
        ),
        is_camera_held=np.zeros(len(clicked), dtype=bool),
        is_body_held=np.ones(1, dtype=bool),
        point_sigma_m=point_sigma_m,
        least_noise=1.0,
    )


def _choose(solutions: Sequence[Adjusted], up: Array, floor_m: float) -> Adjusted:
    """Return the best solution in which the cameras stand in the room as cameras do."""
    standing = [s for s in solutions if _stands(s, up, floor_m)]
    if not standing:
        raise CalibrationError(
            "By the clicked points a camera would lie below the floor or on its head; check that "
            "every click belongs to the point of its name."
        )
    ranked = sorted(standing, key=lambda s: s.cost)
    best = ranked[0]
    for other in ranked[1:]:
        if other.cost - best.cost < DECISIVE and _differ(best, other):
            raise CalibrationError(
                "The clicked points allow two different places of the cameras; add points outside "
                "their plane, such as both ends of something that stands before it."
            )
    return best


def _stands(solution: Adjusted, up: Array, floor_m: float) -> bool:
    if not np.isfinite(up).all():
        return True
    bundle = solution.bundle
    for rotation, translation in zip(
        bundle.camera_rotation, bundle.camera_translation, strict=True
    ):
        _, downwards, forward = rotation @ up
        level = math.sqrt(max(1.0 - forward**2, 1e-9))
        if -downwards / level < UPRIGHT_COSINE:
            return False
        if math.isfinite(floor_m) and float(-rotation.T @ translation @ up) < floor_m:
            return False
    return True


def _differ(one: Adjusted, two: Adjusted) -> bool:
    pairs = zip(one.bundle.camera_rotation, two.bundle.camera_rotation, strict=True)
    return any(_angle(a, b) > TWIN_DEG / 2 for a, b in pairs)


def _require_fit(
    solution: Adjusted,
    clicked: Sequence[Array],
    names: Sequence[str],
    sizes_px: Sequence[tuple[int, int]],
) -> None:
    for residual, sighting in zip(solution.residual_px, solution.bundle.sightings, strict=True):
        miss = np.linalg.norm(residual, axis=1)
        limit = max(MISCLICK_SHARE * max(sizes_px[sighting.camera]), 4.0 * sighting.sigma_px)
        if miss.max() > limit:
            x, y = clicked[sighting.camera][sighting.rows[int(np.argmax(miss))]]
            raise CalibrationError(
                f"The point clicked in {names[sighting.camera]} at {x:.0f}, {y:.0f} px is off by "
                f"{miss.max():.0f} px, expected less than {limit:.0f}; check which point it is, "
                "and the measures."
            )


def read_points(path: Path) -> KnownPoints:
    """Read clicked points from TOML.

    ::

        template = "pallet"            # door, pallet, table, crate; or [points] of your own
        confirmed = true               # the measures below were taken with a tape
        point_sigma_m = 0.005

        [dimensions]
        width_m = 1.2
        height_m = 0.144
        depth_m = 0.8

        [points]                       # further points: x right, y up, z front, m, floor at y = 0
        "shelf left" = [0.0, 1.52, -0.4]

        [[view]]
        video = "left.mp4"
        pixels = { "top front left" = [612, 804], "shelf left" = [420.5, 377] }

    Raises
    ------
    CalibrationError
        If there is no such file, or what it says can't be right.
    """
    path = Path(path)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"The points file {path} can't be read ({error}).") from None
    except tomllib.TOMLDecodeError as error:
        raise CalibrationError(f"{path.name} is not TOML ({error}).") from None
    allowed = {"template", "confirmed", "point_sigma_m", "dimensions", "points", "view"}
    unknown = sorted(set(tables) - allowed)
    if unknown:
        raise CalibrationError(
            f"{path.name} has the unknown key {unknown[0]!r}; known: {', '.join(sorted(allowed))}."
        )
    places = _read_places(tables, path.name)
    names = tuple(places)
    views = tables.get("view", [])
    if not isinstance(views, list) or len(views) < 2:
        raise CalibrationError(f"{path.name} needs a [[view]] table for each of the videos.")
    sigma = tables.get("point_sigma_m", POINT_SIGMA_M)
    if isinstance(sigma, bool) or not isinstance(sigma, int | float) or not 0 < sigma <= 0.2:
        raise CalibrationError(f"point_sigma_m of {path.name} must be 0 to 0.2 m, got {sigma!r}.")
    return KnownPoints(
        names=names,
        world=np.stack(list(places.values())),
        pixels=tuple(_read_clicks(view, names, path.name) for view in views),
        videos=tuple(str(view.get("video", "")) for view in views),
        point_sigma_m=float(sigma),
        is_confirmed=tables.get("confirmed", "template" not in tables) is True,
    )


def _read_places(tables: Mapping[str, Any], file_name: str) -> dict[str, Array]:
    places: dict[str, Array] = {}
    if "template" in tables:
        template = TEMPLATES.get(str(tables["template"]))
        if template is None:
            raise CalibrationError(
                f"The template must be one of {', '.join(TEMPLATES)}, got {tables['template']!r}."
            )
        dimensions = tables.get("dimensions", {})
        if not isinstance(dimensions, Mapping):
            raise CalibrationError(f"dimensions of {file_name} must be a table.")
        places |= template.place(dimensions)
    own = tables.get("points", {})
    if not isinstance(own, Mapping):
        raise CalibrationError(f"points of {file_name} must be a table of names and places.")
    places |= {name: _read_numbers(value, 3, name, file_name) for name, value in own.items()}
    if not places:
        raise CalibrationError(f"{file_name} has neither a template nor [points].")
    return places


def _read_clicks(view: Any, names: Sequence[str], file_name: str) -> Array:
    clicks = view.get("pixels") if isinstance(view, Mapping) else None
    if not isinstance(clicks, Mapping):
        raise CalibrationError(f"Each [[view]] of {file_name} needs pixels = {{ name = [x, y] }}.")
    pixels = np.full((len(names), 2), np.nan)
    for name, value in clicks.items():
        if name not in names:
            raise CalibrationError(
                f"{file_name} clicks the unknown point {name!r}; known: {', '.join(names)}."
            )
        pixels[names.index(name)] = _read_numbers(value, 2, name, file_name)
    return pixels


def _read_numbers(value: Any, count: int, name: str, file_name: str) -> Array:
    is_list = isinstance(value, list) and len(value) == count
    if not is_list or not all(type(v) in (int, float) and math.isfinite(v) for v in value):
        raise CalibrationError(
            f"{name!r} of {file_name} must be {count} finite numbers, got {value!r}."
        )
    return np.array(value, dtype=np.float64)


def calibrate_known_points(
    known: KnownPoints, sizes_px: Sequence[tuple[int, int]], names: Sequence[str]
) -> Calibration:
    """Calibrate from a points file; see `calibrate_points`.

    Measures that nobody confirmed get a scale error of a few per cent, and a note.

    Raises
    ------
    CalibrationError
        As `calibrate_points`.
    """
    calibration = calibrate_points(
        known.pixels,
        known.world,
        sizes_px,
        names=names,
        point_sigma_m=known.point_sigma_m,
        up=known.up,
        floor_m=known.floor_m,
    )
    if known.is_confirmed:
        return calibration
    note = "The measures are the usual ones, nobody confirmed them: lengths may be off by 3 %."
    return replace(
        calibration,
        scale_sigma=math.hypot(calibration.scale_sigma, UNCONFIRMED_SCALE_SIGMA),
        provenance={**calibration.provenance, "notes": [note]},
    )
