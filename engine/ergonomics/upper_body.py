"""The body above L5/S1, the load in the hands, and what they ask of the low back, frame by frame.

From a track of keypoints; every number comes with its standard error. An arm hidden behind the
body is taken as the mirror image of the other one: a stated assumption for two-handed lifts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Lift, Measurement, PoseTrack, Provenance, Subject
from engine.ergonomics.base import Exposure
from engine.ergonomics.low_pass import filter_zero_lag
from engine.ergonomics.segments import UpperBodyShares, share_above_l5s1
from engine.ergonomics.spine import (
    EXTENSOR_LEVER_M,
    EXTENSOR_LEVER_SIGMA_M,
    GRAVITY_M_S2,
    SpineForces,
    build_trunk_axes,
    compute_top_down,
    resolve_forces,
)
from engine.skeletons import Skeleton, get_skeleton

__all__ = [
    "BackLoad",
    "UpperBody",
    "compute_back_load",
    "differentiate_twice",
    "find_held",
    "measure_load_lever",
    "measure_upper_body",
    "read_mass",
]

ARM = ("elbow", "wrist", "knuckle")
KNUCKLE_RATIO = {"male": 0.32, "female": 0.30, None: 0.31}
"""Wrist to third knuckle over elbow to wrist: hand and forearm lengths of de Leva (1996)."""
MIRROR_SIGMA_M = 0.05
"""Standard error of a mirrored elbow, wrist or hand, beside that of the arm it is taken from."""

L5S1_SIGMA_M = 0.025
"""Standard error, per coordinate, of L5/S1 placed on the trunk's line: half a disc's distance."""
STATED_MASS_SIGMA = 0.03
"""Relative standard error of a stated body mass: clothes, and the day it was weighed."""
ASSUMED_BMI = Measurement(25.0, 4.0)
"""Body mass index of adults (kg/m2), used where the body mass is not known."""
LOAD_SIGMA = 0.03
"""Relative standard error of a stated load."""
ACCELERATION_CUTOFF_HZ = 3.0
MIN_FRAME_RATE_HZ = 25.0
"""Below this frame rate no acceleration is derived."""


# --------------------------------------------------------------------------- points


@dataclass(frozen=True, eq=False)
class UpperBody:
    """Points of the upper body in world metres, with their standard errors.

    `points` and `sigma` hold, by name, shape (T, 3) and (T,): `hips`, `shoulders`, `head` and for
    both sides `shoulder`, `elbow`, `wrist`, `knuckle` (``left_elbow``). `right` (T, 3) points to
    the subject's right. `is_mirrored` (T,) tells where an arm was taken from the other side.
    """

    time_s: Array
    points: Mapping[str, Array]
    sigma: Mapping[str, Array]
    right: Array
    is_mirrored: NDArray[np.bool_]

    def l5s1(self, share: float) -> Array:
        """Return L5/S1 on the line from the hips to the shoulders, shape (T, 3)."""
        hips, shoulders = self.points["hips"], self.points["shoulders"]
        return np.asarray(hips + share * (shoulders - hips))

    def hands(self, lift: Lift) -> Array:
        """Return the point that carries the load: between the hands, or the one that lifts."""
        return np.asarray(
            sum(weight * self.points[name] for name, weight in self.grip(lift).items())
        )

    def grip(self, lift: Lift) -> Mapping[str, float]:
        """Return each hand's share of the load."""
        if lift.hands == 2:
            return {"left_knuckle": 0.5, "right_knuckle": 0.5}
        return {f"{self._lifting_side(lift)}_knuckle": 1.0}

    def _lifting_side(self, lift: Lift) -> str:
        part = (self.time_s >= lift.start_s) & (self.time_s <= lift.end_s)

        def rise(side: str) -> float:
            height = self.points[f"{side}_knuckle"][part, 1]
            known = height[np.isfinite(height)]
            return float(np.ptp(known)) if known.size else 0.0

        return max(("right", "left"), key=rise)


def measure_upper_body(exposure: Exposure) -> UpperBody:
    """Gather the points of the upper body from a world track of any skeleton."""
    track = exposure.track
    skeleton = get_skeleton(track.skeleton)
    points: dict[str, Array] = {}
    sigma: dict[str, Array] = {}
    for name, parts in _parts(skeleton, exposure.subject).items():
        points[name], sigma[name] = _combine(track, skeleton, parts)
    right = points["right_hip"] - points["left_hip"]
    right = right + points["right_shoulder"] - points["left_shoulder"]
    mirrored = np.zeros(track.n_frames, dtype=bool)
    for side, other in (("left", "right"), ("right", "left")):
        mirrored |= _mirror_arm(points, sigma, right, side=side, other=other)
    return UpperBody(np.asarray(track.time_s), points, sigma, right, mirrored)


def _parts(skeleton: Skeleton, subject: Subject) -> dict[str, Mapping[str, float]]:
    """Return every point as weights of keypoints."""
    parts: dict[str, Mapping[str, float]] = {
        "hips": {"left_hip": 0.5, "right_hip": 0.5},
        "shoulders": {"left_shoulder": 0.5, "right_shoulder": 0.5},
        # Without ears: the head's mass lies half-way from its top to the base of the neck.
        "head": {"left_ear": 0.5, "right_ear": 0.5}
        if skeleton.has("left_ear")
        else {"head": 0.5, "thorax": 0.5},
    }
    for side in ("left", "right"):
        for joint in ("hip", "shoulder", "elbow", "wrist"):
            parts[f"{side}_{joint}"] = {f"{side}_{joint}": 1.0}
        parts[f"{side}_knuckle"] = _knuckle(skeleton, side, subject)
    return parts


def _knuckle(skeleton: Skeleton, side: str, subject: Subject) -> Mapping[str, float]:
    if skeleton.has(f"{side}_index") and skeleton.has(f"{side}_pinky"):
        return {f"{side}_index": 0.5, f"{side}_pinky": 0.5}
    ratio = KNUCKLE_RATIO[subject.sex]
    return {f"{side}_wrist": 1.0 + ratio, f"{side}_elbow": -ratio}


def _combine(
    track: PoseTrack, skeleton: Skeleton, parts: Mapping[str, float]
) -> tuple[Array, Array]:
    columns = [skeleton.index(name) for name in parts]
    weights = np.array(list(parts.values()))
    position = np.einsum("k,tkd->td", weights, track.position[:, columns])
    variance = np.einsum("k,tk->t", weights**2, track.sigma[:, columns] ** 2)
    return position, np.sqrt(variance)


def _mirror_arm(
    points: dict[str, Array], sigma: dict[str, Array], right: Array, *, side: str, other: str
) -> NDArray[np.bool_]:
    """Fill one arm's hidden joints with the mirror image of the other; return where."""
    normal = np.array(right, copy=True)
    normal[:, 1] = 0.0
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, np.where(length > 1e-9, length, np.nan))
    middle = points["shoulders"]
    filled = np.zeros(len(right), dtype=bool)
    for joint in ARM:
        own, twin = f"{side}_{joint}", f"{other}_{joint}"
        across = np.sum((points[twin] - middle) * normal, axis=1, keepdims=True)
        image = points[twin] - 2.0 * across * normal
        hidden = ~np.isfinite(points[own]).all(axis=1) & np.isfinite(image).all(axis=1)
        points[own] = np.where(hidden[:, None], image, points[own])
        wider = np.hypot(sigma[twin], MIRROR_SIGMA_M)
        sigma[own] = np.where(hidden, wider, sigma[own])
        filled |= hidden
    return filled


def find_held(time_s: Array, lift: Lift) -> NDArray[np.bool_]:
    """Tell in which frames a lift's load is in the hands, shape (T,)."""
    return np.asarray((time_s >= lift.start_s) & (time_s <= lift.end_s))


# --------------------------------------------------------------------------- accelerations


def differentiate_twice(
    position: Array, time_s: Array, *, cutoff_hz: float = ACCELERATION_CUTOFF_HZ
) -> Array:
    """Return accelerations after a zero-lag low-pass.

    Parameters
    ----------
    position
        Shape (T, ...); NaN where missing.
    time_s
        Shape (T,).
    cutoff_hz
        Of a Butterworth filter, second order per pass, fourth in total; after both passes.

    Returns
    -------
    Array
        Shape of `position`, per s squared; NaN where the frame rate is below 25 per second, in gaps
        and in stretches of fewer than 16 frames. Each stretch between gaps is filtered on its own,
        its ends padded by odd reflection.
    """
    columns = position.reshape(len(time_s), -1)
    result = np.full_like(columns, np.nan)
    if len(time_s) < MIN_STRETCH:
        return result.reshape(position.shape)
    rate_hz = 1.0 / float(np.median(np.diff(time_s)))
    if rate_hz < MIN_FRAME_RATE_HZ:
        return result.reshape(position.shape)
    # Columns that are seen in the same frames go through the filter together.
    patterns, group = np.unique(np.isfinite(columns), axis=1, return_inverse=True)
    for k in range(patterns.shape[1]):
        chosen = np.flatnonzero(group.reshape(-1) == k)
        known = np.flatnonzero(patterns[:, k])
        for stretch in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
            if len(stretch) >= MIN_STRETCH:
                part = np.ix_(stretch, chosen)
                result[part] = _accelerate(columns[part], time_s[stretch], rate_hz, cutoff_hz)
    return result.reshape(position.shape)


MIN_STRETCH = 16


def _accelerate(values: Array, time_s: Array, rate_hz: float, cutoff_hz: float) -> Array:
    """Return the second derivative of filtered columns, shape (T, N), without gaps."""
    smooth = filter_zero_lag(values, rate_hz=rate_hz, cutoff_hz=cutoff_hz)
    speed = np.gradient(smooth, time_s, axis=0, edge_order=2)
    return np.asarray(np.gradient(speed, time_s, axis=0, edge_order=2))


# --------------------------------------------------------------------------- the load on the back


def read_mass(subject: Subject) -> tuple[Measurement, Provenance, tuple[str, ...]]:
    """Return the body mass (kg), where it comes from, and what was assumed."""
    if subject.mass_kg is not None:
        stated = Measurement(subject.mass_kg, STATED_MASS_SIGMA * subject.mass_kg)
        return stated, Provenance.USER, ()
    square = subject.stature.value**2
    share = np.hypot(
        ASSUMED_BMI.sigma / ASSUMED_BMI.value, 2 * subject.stature.sigma / subject.stature.value
    )
    value = ASSUMED_BMI.value * square
    note = (
        f"Body mass not given: {value:.0f} kg assumed, a body mass index of "
        f"{ASSUMED_BMI.value:g}; the interval is wide for it."
    )
    return Measurement(value, float(share * value)), Provenance.ASSUMED, (note,)


@dataclass(frozen=True, eq=False)
class BackLoad:
    """Moments and forces at L5/S1 over time, with standard errors (N m, N; shape (T,)).

    `static` leaves accelerations out, `dynamic` counts them (NaN where they can't be derived).
    `variances_n2` splits the variance of the compression by its cause. `load_kg` (T,) is what the
    hands hold, `load_lever_m` (T,) its horizontal distance from L5/S1.
    """

    time_s: Array
    static: SpineForces
    dynamic: SpineForces
    flexion_sigma_nm: Array
    compression_sigma_n: Array
    variances_n2: Mapping[str, Array]
    load_kg: Array
    load_lever_m: Array
    load_lever_sigma_m: Array


def compute_back_load(
    body: UpperBody,
    lifts: Sequence[Lift],
    *,
    subject: Subject,
    load_kg: float,
    joint: Array | None = None,
    normal: Array | None = None,
) -> BackLoad:
    """Compute what acts at L5/S1 in every frame.

    Parameters
    ----------
    body
        The points above L5/S1.
    lifts
        When the load is in the hands, and in how many.
    subject
        Sex selects the masses; body mass and stature with their errors.
    load_kg
        What is lifted; 0 for the body's own part.
    joint, normal
        Shape (T, 3) each: place of L5/S1 and unit vector across its disc. By default on the
        trunk's line, and along it.

    Returns
    -------
    BackLoad
        Standard errors follow from those of the keypoints (taken as independent of each other), of
        the length scale, the place of L5/S1, the body mass, the load and the muscle's lever arm.
        The simplicity of the model itself is not in them.
    """
    shares = share_above_l5s1(subject.sex)
    mass, _, _ = read_mass(subject)
    grip = _grip_over_time(body, lifts)
    held = grip.sum(axis=1)
    names = list(body.points)
    weights, kg = _mass_points(shares, mass.value, names)
    kg_all = np.concatenate([np.broadcast_to(kg, (len(held), len(kg))), load_kg * grip], axis=1)
    stack = np.stack([body.points[name] for name in names], axis=1)
    joint = body.l5s1(shares.l5s1_height) if joint is None else joint
    hands = stack[:, [names.index(f"{side}_knuckle") for side in ("left", "right")]]
    places = np.concatenate([np.einsum("bk,tkd->tbd", weights, stack), hands], axis=1)
    axes = build_trunk_axes(body.points["hips"], body.points["shoulders"], body.right)
    lever = places - joint[:, None]
    static = resolve_forces(*compute_top_down(lever, kg_all), axes, normal=normal)
    acceleration = differentiate_twice(places, body.time_s)
    moving = compute_top_down(lever, kg_all, acceleration)
    dynamic = resolve_forces(*moving, axes, normal=normal)
    coefficients = _sensitivity(weights, kg, grip * load_kg, shares, names)
    # Points that nothing hangs on may be unseen.
    sigma = np.where(
        coefficients == 0.0, 0.0, np.stack([body.sigma[name] for name in names], axis=1)
    )
    load_moment = _load_moment(hands - joint[:, None], grip * load_kg, axes.right)
    total_n = GRAVITY_M_S2 * (kg.sum() + held * load_kg)
    of_moment = _moment_variances(
        static.flexion_nm, coefficients * sigma, total_n, load_moment, mass, subject
    )
    of_compression = _compression_variances(static.flexion_nm, of_moment)
    load_lever, load_lever_sigma = measure_load_lever(body, lifts, subject)
    return BackLoad(
        time_s=body.time_s,
        static=static,
        dynamic=dynamic,
        flexion_sigma_nm=np.sqrt(sum(of_moment.values())),
        compression_sigma_n=np.sqrt(sum(of_compression.values())),
        variances_n2=of_compression,
        load_kg=held * load_kg,
        load_lever_m=load_lever,
        load_lever_sigma_m=load_lever_sigma,
    )


def measure_load_lever(
    body: UpperBody, lifts: Sequence[Lift], subject: Subject
) -> tuple[Array, Array]:
    """Measure how far the load is from L5/S1.

    Returns
    -------
    lever, sigma
        Shape (T,) each: horizontal distance (m), NaN while nothing is held, and its standard
        error.
    """
    grip = _grip_over_time(body, lifts)
    held = grip.sum(axis=1)
    hands = np.stack([body.points[f"{side}_knuckle"] for side in ("left", "right")], axis=1)
    at_hands = _known_sum(grip[..., None] / np.maximum(held, 1e-9)[:, None, None], hands)
    joint = body.l5s1(share_above_l5s1(subject.sex).l5s1_height)
    horizontal = np.linalg.norm((at_hands - joint)[:, [0, 2]], axis=1)
    return np.where(held > 0, horizontal, np.nan), _lever_sigma(body, grip, subject)


def _grip_over_time(body: UpperBody, lifts: Sequence[Lift]) -> Array:
    """Return how much of a load each hand holds, shape (T, 2), left then right."""
    grip = np.zeros((len(body.time_s), 2))
    for lift in lifts:
        shares = body.grip(lift)
        row = [shares.get(f"{side}_knuckle", 0.0) for side in ("left", "right")]
        grip[find_held(body.time_s, lift)] = row
    return grip


def _mass_points(
    shares: UpperBodyShares, mass_kg: float, names: Sequence[str]
) -> tuple[Array, Array]:
    """Return each body part's centre as weights of the points (B, K), and its mass in kg (B,)."""

    def between(first: str, second: str, share: float) -> Array:
        row = np.zeros(len(names))
        row[names.index(first)] += 1.0 - share
        row[names.index(second)] += share
        return row

    rows = [between("hips", "shoulders", shares.trunk_centre), between("head", "head", 0.0)]
    kg = [shares.trunk, shares.head]
    for side in ("left", "right"):
        for first, second, centre, share in (
            ("shoulder", "elbow", shares.upper_arm_centre, shares.upper_arm),
            ("elbow", "wrist", shares.forearm_centre, shares.forearm),
            ("wrist", "knuckle", shares.hand_centre, shares.hand),
        ):
            rows.append(between(f"{side}_{first}", f"{side}_{second}", centre))
            kg.append(share)
    return np.array(rows), mass_kg * np.array(kg)


def _known_sum(weights: Array, points: Array) -> Array:
    """Sum weighted points over axis 1; points of weight 0 may be missing."""
    return np.asarray(np.where(weights > 0, weights * points, 0.0).sum(axis=1))


def _load_moment(lever: Array, kg: Array, right: Array) -> Array:
    """Return the flexion moment of the load alone, shape (T,)."""
    moment, _ = compute_top_down(lever, kg)
    return np.asarray(-np.sum(moment * right, axis=1))


def _sensitivity(
    weights: Array, kg: Array, load_kg: Array, shares: UpperBodyShares, names: Sequence[str]
) -> Array:
    """Return how much weight hangs on each point, N, shape (T, K): moment per metre of its error.

    An arm joint's own error moves what hangs on it; errors of hips and shoulders move L5/S1 as
    well.
    """
    body = kg @ weights
    table = np.broadcast_to(body, (len(load_kg), len(names))).copy()
    for k, side in enumerate(("left", "right")):
        table[:, names.index(f"{side}_knuckle")] += load_kg[:, k]
    total = kg.sum() + load_kg.sum(axis=1)
    table[:, names.index("hips")] -= (1.0 - shares.l5s1_height) * total
    table[:, names.index("shoulders")] -= shares.l5s1_height * total
    return np.asarray(GRAVITY_M_S2 * table)


def _moment_variances(
    flexion: Array,
    of_points: Array,
    total_n: Array,
    load_moment: Array,
    mass: Measurement,
    subject: Subject,
) -> dict[str, Array]:
    """Return the variance of the flexion moment by what causes it, (N m)^2, shape (T,) each."""
    return {
        "the keypoints": np.sum(of_points**2, axis=1),
        "the place of L5/S1": (total_n * L5S1_SIGMA_M) ** 2,
        "the stature": (flexion * subject.stature.sigma / subject.stature.value) ** 2,
        "the body mass": ((flexion - load_moment) * mass.sigma / mass.value) ** 2,
        "the load": (load_moment * LOAD_SIGMA) ** 2,
    }


def _compression_variances(flexion: Array, of_moment: Mapping[str, Array]) -> dict[str, Array]:
    """Return the variance of the compression by what causes it, N^2."""
    muscle = np.maximum(flexion, 0.0) / EXTENSOR_LEVER_M
    lever = (muscle * EXTENSOR_LEVER_SIGMA_M / EXTENSOR_LEVER_M) ** 2
    parts = {name: variance / EXTENSOR_LEVER_M**2 for name, variance in of_moment.items()}
    return {**parts, "the muscle's lever arm": lever}


def _lever_sigma(body: UpperBody, grip: Array, subject: Subject) -> Array:
    """Return the standard error of the load's horizontal distance from L5/S1, shape (T,)."""
    share = share_above_l5s1(subject.sex).l5s1_height
    hands = np.stack([body.sigma[f"{side}_knuckle"] for side in ("left", "right")], axis=1)
    held = np.maximum(grip.sum(axis=1, keepdims=True), 1e-9)
    parts = (
        *np.where(grip > 0, grip / held * hands, 0.0).T,
        (1.0 - share) * body.sigma["hips"],
        share * body.sigma["shoulders"],
        np.full(len(grip), L5S1_SIGMA_M),
    )
    return np.asarray(np.sqrt(np.sum(np.square(parts), axis=0)))
