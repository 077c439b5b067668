"""Lifts in a clip: when the load moves, and where the hands are at both ends.

The hands tell: they come to rest on the load, carry it, stop to let it go. A camera
does not see whether the hands hold something, so the
movement between two stops away from the body's side is taken for the loaded one; reaching out
from hanging arms and returning to them are not. Where that is not certain, the lift says so. What
could be a lift but was not seen well enough, or is faster than loads are lifted, is left
out with a warning. A person who knows better says when a lift was, or that there was none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import (
    Array,
    JointAngles,
    Lift,
    LiftEnd,
    Measurement,
    PoseTrack,
    Sex,
    WorldScene,
)
from engine.errors import ConfigError
from engine.skeletons import Skeleton, get_skeleton

__all__ = [
    "SET_BY_USER",
    "Hands",
    "LiftFindings",
    "Move",
    "Span",
    "compute_hands",
    "detect_lifts",
    "find_conditions",
    "measure_end",
]

KNUCKLE_RATIO = {"male": 0.32, "female": 0.30, None: 0.31}
"""Wrist to third knuckle over elbow to wrist: hand and forearm lengths of de Leva (1996)."""
MIN_PEAK_SPEED_M_S = 0.25
MIN_FRAME_RATE_HZ = 15.0
MIN_PEAK_RATE_HZ = 25.0
MAX_HAND_SPEED_M_S = 4.0
"""Far above the speed at which loads are lifted; what is faster is a swing, a throw or an error."""
MIN_CERTAINTY = 0.3
"""Below this the estimator says that both hands are hidden, and their path is a guess."""
STOP_SPEED_M_S = 0.08
STOP_SHARE = 0.10
TURN_COSINE = -0.5
TURN_DEPTH_M = 0.10
ARM_LENGTH_SHARE = 0.387
"""Shoulder to knuckle as a share of stature (upper arm, forearm, half a hand; Winter 2009)."""
REST_DISTANCE_SHARE = 0.14
REST_INCLINATION_DEG = 22.0
WINDOW_S = 0.1
WALK_M = 0.35
PIVOT_DEG = 20.0
KNEELING_SHARE = 0.12
SEATED_SHARE = 0.36
UNLOADED_RISE_M = 0.25
IQR_TO_SIGMA = 1.349
SET_SIGMA_S = 0.05
"""Standard error of a moment that a person picked in the video: a picture or two."""
SET_BY_USER = "set_by_user"
"""Note of a lift whose times a person set."""

Span = tuple[float, float]
"""Start and end in the track's time, s."""


@dataclass(frozen=True, eq=False)
class Hands:
    """The hands over time, world metres.

    `mid` (T, 3): height and forward position from both hands by their visibility (both hold
    one load), sideways position their plain middle. `left`, `right` (T, 3) knuckles;
    `certainty` (T,) of the better seen hand, 0 to 1; `speed` (T,) m/s of `mid`, with the
    part along the line of sight weighted down by its larger error (the ratio of variances).
    """

    mid: Array
    left: Array
    right: Array
    certainty: Array
    speed: Array
    velocity: Array


@dataclass(frozen=True)
class Move:
    """One movement of the hands between two stops; frame indices, `peak` of its highest speed."""

    start: int
    peak: int
    end: int


@dataclass(frozen=True)
class LiftFindings:
    """The lifts of a clip, and conditions of the whole clip that touch validity."""

    lifts: tuple[Lift, ...]
    conditions: tuple[str, ...]
    warnings: tuple[str, ...]


ALIKE = 1.5
"""Up to this ratio errors along and across the line of sight count as alike: two views."""


def compute_knuckles(
    track_position: Array, skeleton: Skeleton, side: str, *, sex: Sex | None = None
) -> Array:
    """Return the third knuckle of one hand, shape (T, 3).

    The middle of the index and little-finger knuckles where the skeleton has them, otherwise
    beyond the wrist along the forearm.
    """
    if skeleton.has(f"{side}_index") and skeleton.has(f"{side}_pinky"):
        return np.asarray(
            0.5
            * (
                skeleton.point(track_position, f"{side}_index")
                + skeleton.point(track_position, f"{side}_pinky")
            )
        )
    wrist = skeleton.point(track_position, f"{side}_wrist")
    elbow = skeleton.point(track_position, f"{side}_elbow")
    return np.asarray(wrist + KNUCKLE_RATIO[sex] * (wrist - elbow))


def compute_hands(track: PoseTrack, scene: WorldScene, *, sex: Sex | None = None) -> Hands:
    """Follow both hands and the middle between them.

    Parameters
    ----------
    track
        World metres, corrected.
    scene
        Tells along which direction depths are uncertain.
    sex
        For the hand's length where only wrists are known.

    Returns
    -------
    Hands
        NaN where neither hand was found.
    """
    skeleton = get_skeleton(track.skeleton)
    position = np.asarray(track.position)
    sides = {s: compute_knuckles(position, skeleton, s, sex=sex) for s in ("left", "right")}
    certainty = {
        s: _smooth(
            np.nan_to_num(track.confidence[:, skeleton.index(f"{s}_wrist")], nan=1.0), track.time_s
        )
        for s in sides
    }
    trust = _compare_errors(track, skeleton, scene)
    # A hidden hand's place is a guess; a small floor keeps it in when both are hidden.
    weight = {
        s: np.where(np.isfinite(sides[s]).all(axis=1), trust[s] * (certainty[s] ** 2 + 0.02), 0.0)
        for s in sides
    }
    total = weight["left"] + weight["right"]
    total = np.where(total > 0, total, np.nan)
    left, right = np.nan_to_num(sides["left"]), np.nan_to_num(sides["right"])
    mid = (weight["left"][:, None] * left + weight["right"][:, None] * right) / total[:, None]
    path = mid.copy()
    both = (weight["left"] > 0) & (weight["right"] > 0)
    mid[both, 2] = 0.5 * (left[both, 2] + right[both, 2])
    # One weight for all directions: what a single hand does along its line of sight then stays
    # along it, and can be told from real motion.
    velocity = np.gradient(path, track.time_s, axis=0) if len(path) > 1 else np.zeros_like(path)
    return Hands(
        mid=mid,
        left=sides["left"],
        right=sides["right"],
        certainty=np.maximum(certainty["left"], certainty["right"]),
        speed=_weighted_speed(velocity, scene),
        velocity=velocity,
    )


def _compare_errors(track: PoseTrack, skeleton: Skeleton, scene: WorldScene) -> dict[str, Array]:
    """Return by how much less each hand counts for a standard error larger than the other's.

    One view knows neither hand along its line of sight, so there its errors don't tell which
    hand is the better one.
    """
    trust = {s: np.ones(track.n_frames) for s in ("left", "right")}
    if not scene.depth_sigma_m <= ALIKE * scene.plane_sigma_m:
        return trust
    sigma = {s: np.asarray(track.sigma[:, skeleton.index(f"{s}_wrist")]) for s in trust}
    for own, other in (("left", "right"), ("right", "left")):
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.minimum(1.0, sigma[other] / sigma[own]) ** 2
        trust[own] = np.where(np.isfinite(share), share, 1.0)
    return trust


def _smooth(values: Array, time_s: Array) -> Array:
    """Return the running mean over half a second; flicker would look like motion."""
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    half = max(1, round(0.25 / step_s))
    padded = np.pad(values, half, mode="edge")
    return np.asarray(np.convolve(padded, np.ones(2 * half + 1) / (2 * half + 1), mode="valid"))


def _view_direction(scene: WorldScene) -> Array:
    """Return the camera's viewing direction in the world, shape (3,)."""
    return np.asarray(scene.camera.rotation[2])


def _weighted_speed(velocity: Array, scene: WorldScene) -> Array:
    along = _view_direction(scene)
    is_deep = scene.depth_sigma_m > scene.plane_sigma_m  # False where unknown or without error
    share = (scene.plane_sigma_m / scene.depth_sigma_m) ** 2 if is_deep else 1.0
    depth = velocity @ along
    across = velocity - depth[:, None] * along
    return np.asarray(np.sqrt((across**2).sum(axis=1) + (share * depth) ** 2))


def find_moves(
    hands: Hands, *, speed_floor_m_s: float = 0.10, speed_share: float = 0.12
) -> list[Move]:
    """Split the hands' path into movements from stop to stop.

    Parameters
    ----------
    hands
        The hands' speed and velocity.
    speed_floor_m_s, speed_share
        A movement begins and ends where the speed falls to the larger of the floor and this share
        of its peak.

    Returns
    -------
    list of Move
        In order of time. One that is under way at the clip's first or last frame starts or ends
        there, above the threshold.
    """
    # Loads for a second and a half; reports and pages that read stored lifts never get here.
    from scipy.signal import find_peaks

    speed = np.nan_to_num(hands.speed)
    # Stillness is put before and after the clip, so that a movement cut off there is seen too.
    peaks, _ = find_peaks(np.pad(speed, 1), height=MIN_PEAK_SPEED_M_S, prominence=0.08)
    peaks = peaks - 1
    groups: list[list[int]] = []
    for peak in map(int, peaks):
        if groups and _is_same_move(hands, groups[-1][-1], peak):
            groups[-1].append(peak)
        else:
            groups.append([peak])
    moves = []
    for i, group in enumerate(groups):
        low = _valley(speed, groups[i - 1][-1], group[0]) if i else 0
        high = (
            _valley(speed, group[-1], groups[i + 1][0]) if i + 1 < len(groups) else len(speed) - 1
        )
        first = _last_below(
            speed, low, group[0], max(speed_floor_m_s, speed_share * speed[group[0]])
        )
        last = _first_below(
            speed, group[-1], high, max(speed_floor_m_s, speed_share * speed[group[-1]])
        )
        highest = max(group, key=lambda k: speed[k])
        moves += _split_at_turns(Move(first, highest, last), hands)
    return moves


def _split_at_turns(move: Move, hands: Hands) -> list[Move]:
    """Cut a movement where the hands turn from down to up or back; the stop there was too short."""
    height = hands.mid[move.start : move.end + 1, 1]
    if not np.isfinite(height).all():
        return [move]
    for sign in (1.0, -1.0):
        turn = int(np.argmin(sign * height))
        if (sign * (height[[0, -1]] - height[turn])).min() > TURN_DEPTH_M:
            cut = move.start + turn
            parts = [(move.start, cut), (cut, move.end)]
            speed = np.nan_to_num(hands.speed)
            return [Move(a, a + int(np.argmax(speed[a : b + 1])), b) for a, b in parts]
    return [move]


def _is_same_move(hands: Hands, first: int, second: int) -> bool:
    """Whether two speed peaks belong to one movement: no real stop and no turning back between.

    A lift onto a shelf goes up, slows down and goes forward; that is one movement.
    """
    speed = np.nan_to_num(hands.speed)
    a, b = hands.velocity[first], hands.velocity[second]
    cosine = float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-9))
    stop = max(STOP_SPEED_M_S, STOP_SHARE * min(speed[first], speed[second]))
    return bool(cosine > TURN_COSINE and speed[_valley(speed, first, second)] > stop)


def _valley(speed: Array, first: int, second: int) -> int:
    return first + int(np.argmin(speed[first : second + 1]))


def _last_below(speed: Array, low: int, peak: int, threshold: float) -> int:
    below = np.flatnonzero(speed[low : peak + 1] < threshold)
    return low + (int(below[-1]) if below.size else int(np.argmin(speed[low : peak + 1])))


def _first_below(speed: Array, peak: int, high: int, threshold: float) -> int:
    below = np.flatnonzero(speed[peak : high + 1] < threshold)
    return peak + (int(below[0]) if below.size else int(np.argmin(speed[peak : high + 1])))


def find_rest(
    track: PoseTrack, hands: Hands, scene: WorldScene, *, stature_m: float
) -> NDArray[np.bool_]:
    """Return the frames in which the person stands with hanging arms, shape (T,)."""
    skeleton = get_skeleton(track.skeleton)
    position = np.asarray(track.position)
    shoulders, hips = skeleton.point(position, "thorax"), skeleton.point(position, "pelvis")
    trunk = shoulders - hips
    upright = trunk[:, 1] / np.linalg.norm(trunk, axis=1) > np.cos(np.radians(REST_INCLINATION_DEG))
    hanging = shoulders - [0.0, ARM_LENGTH_SHARE * stature_m, 0.0]
    along = _view_direction(scene)
    off = hands.mid - hanging
    # Depth is too uncertain to call a hand away from the side.
    off = off - 0.5 * (off @ along)[:, None] * along
    distance = np.linalg.norm(off, axis=1)
    return np.asarray(np.nan_to_num(upright) & (distance < REST_DISTANCE_SHARE * stature_m))


def choose_loaded(
    moves: list[Move], hands: Hands, at_rest: NDArray[np.bool_], *, min_rise_m: float
) -> tuple[list[Move], list[str]]:
    """Choose the movements in which a load is carried.

    Returns
    -------
    list of Move
        The loaded movements.
    list of str
        Doubts about the choice.
    """
    rise = {m: float(hands.mid[m.end, 1] - hands.mid[m.start, 1]) for m in moves}
    tall = [m for m in moves if abs(rise[m]) >= min_rise_m]
    between = [m for m in tall if not at_rest[m.start] and not at_rest[m.end]]
    if not between:
        # A load may also be lifted until the arms hang; an empty rise looks the same.
        to_rest = [m for m in tall if rise[m] >= UNLOADED_RISE_M and not at_rest[m.start]]
        return to_rest, ["ends_at_rest"] if to_rest else []
    up = [m for m in between if rise[m] > 0]
    down = [m for m in between if rise[m] < 0]
    if up and down:
        # Pick-and-place work: one direction carries the load, the other returns for the next.
        return (up if len(up) >= len(down) else down), ["one_direction"]
    return between, []


def _rise(move: Move, hands: Hands) -> float:
    """Return how high the hands travel within a movement, m; 0 where they were not seen."""
    height = hands.mid[move.start : move.end + 1, 1]
    known = height[np.isfinite(height)]
    return float(np.ptp(known)) if known.size else 0.0


def measure_end(
    track: PoseTrack,
    hands: Hands,
    scene: WorldScene,
    *,
    at_s: float,
    forward: Array | None = None,
) -> LiftEnd:
    """Measure H, V and A at one instant, as medians over 0.1 s on both sides.

    Standard errors join the scatter over that time with what is not known of the scene: errors
    across and along the line of sight, scale, floor, tilt and heading. A small distance
    sideways is inflated by noise (it has no sign in A), so its expected noise is taken off, in
    squares.

    Parameters
    ----------
    track
        World metres.
    hands
        Of the same track.
    scene
        Where the camera is and how well that is known.
    at_s
        Instant, s.
    forward
        Horizontal unit vector (3,) of the feet; the world's X axis if None.

    Returns
    -------
    LiftEnd
        NaN where feet or hands were not found.
    """
    skeleton = get_skeleton(track.skeleton)
    forward = np.array([1.0, 0.0, 0.0]) if forward is None else forward
    right = np.cross(forward, [0.0, 1.0, 0.0])
    near = np.abs(track.time_s - at_s) <= WINDOW_S + 1e-9
    if not near.any():
        near = np.abs(track.time_s - at_s) == np.abs(track.time_s - at_s).min()
    mid = hands.mid[near]
    offset = mid - skeleton.point(np.asarray(track.position), "mid_ankle")[near]
    known = np.isfinite(offset).all(axis=1)
    if not known.any():
        missing = Measurement(np.nan)
        return LiftEnd(at_s, missing, missing, missing)
    mid, offset = mid[known], offset[known]
    flat = np.array([np.median(offset @ forward), np.median(offset @ right)])
    doubt = 1.0 + 2.0 * (1.0 - float(np.median(hands.certainty[near])))
    covariance = _offset_covariance(scene, forward, right, doubt)
    H, A = _distance_and_angle(flat, covariance, scene)
    scatter = _scatter(np.linalg.norm(offset[:, [0, 2]], axis=1))
    H = replace(H, sigma=float(np.hypot(H.sigma, scatter)))
    V = float(np.median(mid[:, 1]))
    plane = np.nan_to_num(scene.plane_sigma_m) * doubt
    depth_offset = float(np.median(offset @ _view_direction(scene)))
    V_sigma = np.sqrt(
        plane**2
        + scene.floor_sigma_m**2
        + (scene.scale_sigma * V) ** 2
        + (np.radians(scene.tilt_sigma_deg) * depth_offset) ** 2
        + _scatter(mid[:, 1]) ** 2
    )
    return LiftEnd(
        time_s=at_s,
        H_cm=Measurement(100 * H.value, 100 * H.sigma),
        V_cm=Measurement(100 * max(V, 0.0), 100 * float(V_sigma)),
        A_deg=A,
    )


def _scatter(values: Array) -> float:
    low, high = np.percentile(values, [25, 75])
    return float((high - low) / IQR_TO_SIGMA)


def _offset_covariance(scene: WorldScene, forward: Array, right: Array, doubt: float) -> Array:
    """Return the covariance (2, 2) of the horizontal offset feet to hands: forward, right; m2."""
    view = _view_direction(scene)
    along = np.array([view @ forward, view @ right])
    along /= max(float(np.linalg.norm(along)), 1e-9)
    across = np.array([-along[1], along[0]])
    plane = np.nan_to_num(scene.plane_sigma_m) * doubt
    depth = np.nan_to_num(scene.depth_sigma_m) * doubt
    return np.asarray(plane**2 * np.outer(across, across) + depth**2 * np.outer(along, along))


def _distance_and_angle(
    flat: Array, covariance: Array, scene: WorldScene
) -> tuple[Measurement, Measurement]:
    """Return H (m) and A (degrees) from the horizontal offset (forward, right)."""
    forward, side = float(flat[0]), float(flat[1])
    heading = np.radians(scene.heading_sigma_deg)
    side_variance = float(covariance[1, 1]) + (heading * forward) ** 2
    side = np.sign(side) * np.sqrt(max(side**2 - side_variance, 0.0))
    H = float(np.hypot(forward, side))
    unit = np.array([forward, side]) / max(H, 1e-9)
    normal = np.array([-unit[1], unit[0]])
    H_sigma = np.sqrt(unit @ covariance @ unit + (scene.scale_sigma * H) ** 2)
    A = float(np.degrees(np.arctan2(abs(side), forward)))
    A_sigma = np.degrees(np.sqrt(normal @ covariance @ normal / max(H, 0.1) ** 2 + heading**2))
    return Measurement(H, float(H_sigma)), Measurement(A, float(min(A_sigma, 90.0)))


def detect_lifts(
    track: PoseTrack,
    angles: JointAngles,
    scene: WorldScene,
    *,
    stature_m: float,
    sex: Sex | None = None,
    min_rise_m: float = 0.10,
    min_duration_s: float = 0.3,
    max_duration_s: float = 5.0,
    speed_floor_m_s: float = 0.10,
    speed_share: float = 0.12,
    max_hand_separation_m: float = 0.60,
    set_lifts: Sequence[Span] = (),
    not_lifts: Sequence[Span] = (),
) -> LiftFindings:
    """Find the lifts of a clip and measure them.

    Parameters
    ----------
    track
        World metres, corrected, at least 15 frames per second.
    angles
        For the speed of the trunk.
    scene
        Where the camera is and how well that is known.
    stature_m
        Metres.
    sex
        For the hand's length where only wrists are known.
    min_rise_m, min_duration_s, max_duration_s
        What counts as a lift.
    speed_floor_m_s, speed_share
        See `find_moves`.
    max_hand_separation_m
        Hands further apart do not hold one load.
    set_lifts
        Lifts whose times a person set: measured at those times, whatever the hands do. What was
        found and overlaps one of them gives way to it.
    not_lifts
        Where a person saw no lift: what was found there and shares more than half of the shorter
        time is left out.

    Returns
    -------
    LiftFindings
        Lifts in order of time; notes and conditions are the keys the risk methods know. A movement
        that rises far enough but can't be a lift that was seen whole (hands faster than 4 m/s, not
        seen all the time, both hidden, cut off by the clip's ends, too short or too long) is named
        in the warnings instead.

    Raises
    ------
    ConfigError
        If a lift that a person set lies outside the clip or between two pictures.
    """
    time_s = np.asarray(track.time_s)
    if len(time_s) < 3:
        return LiftFindings((), (), ("The clip is too short to find lifts in it.",))
    rate_hz = 1.0 / float(np.median(np.diff(time_s)))
    hands = compute_hands(track, scene, sex=sex)
    given = [_place(span, hands, time_s) for span in set_lifts]
    if rate_hz < MIN_FRAME_RATE_HZ:
        choice = _Choice([], [], [], [_describe_low_rate(rate_hz)])
    else:
        moves = find_moves(hands, speed_floor_m_s=speed_floor_m_s, speed_share=speed_share)
        at_rest = find_rest(track, hands, scene, stature_m=stature_m)
        choice = _choose(
            moves,
            hands,
            at_rest,
            time_s,
            min_rise_m=min_rise_m,
            duration_s=(min_duration_s, max_duration_s),
            stop=(speed_floor_m_s, speed_share),
            refused=(*set_lifts, *not_lifts),
        )
    found = [m for m in choice.loaded if not _is_refused(m, time_s, given, not_lifts)]
    doubts = choice.doubts if found else []
    lifts = []
    for move in sorted((*found, *given), key=lambda m: m.start):
        own = (SET_BY_USER,) if move in given else tuple(doubts)
        notes = (*own, *_notes(track, hands, move, scene, stature_m, max_hand_separation_m))
        lifts.append(_measure_lift(track, angles, hands, scene, move, choice.moves, notes, rate_hz))
    warnings = (*choice.warnings, *_explain(doubts, rate_hz))
    if rate_hz < MIN_FRAME_RATE_HZ and not lifts:
        return LiftFindings((), (), warnings[:1])
    return LiftFindings(tuple(lifts), find_conditions(track, stature_m), warnings)


@dataclass(frozen=True)
class _Choice:
    """All movements, those with a load, doubts about that choice, and what was left out."""

    moves: list[Move]
    loaded: list[Move]
    doubts: list[str]
    warnings: list[str]


def _choose(
    moves: list[Move],
    hands: Hands,
    at_rest: NDArray[np.bool_],
    time_s: Array,
    *,
    min_rise_m: float,
    duration_s: Span,
    stop: tuple[float, float],
    refused: Sequence[Span],
) -> _Choice:
    """Choose the movements that are lifts; say why others that rise as far are none.

    Where a person said what is there (`refused`), there is nothing to explain.
    """
    clear, left_out = [], []
    for move in moves:
        objection = _find_objection(move, hands, speed_floor_m_s=stop[0], speed_share=stop[1])
        if objection is None:
            clear.append(move)
        elif _rise(move, hands) >= min_rise_m:
            left_out.append((move, objection))
    loaded, doubts = choose_loaded(clear, hands, at_rest, min_rise_m=min_rise_m)
    low, high = duration_s
    odd = [m for m in loaded if not low <= time_s[m.end] - time_s[m.start] <= high]
    left_out += [(move, f"a lift lasts {low:g} to {high:g} s") for move in odd]
    warnings = [
        _left_out(time_s, move, reason)
        for move, reason in left_out
        if not any(_overlap_s(_span(move, time_s), span) > 0.0 for span in refused)
    ]
    return _Choice(moves, [m for m in loaded if m not in odd], doubts, warnings)


def _place(span: Span, hands: Hands, time_s: Array) -> Move:
    """Return the pictures nearest to the times that a person set.

    Raises
    ------
    ConfigError
        If they lie outside the clip, or both at one picture.
    """
    start_s, end_s = span
    room = 0.5 * float(np.median(np.diff(time_s)))
    if not time_s[0] - room <= start_s <= end_s <= time_s[-1] + room:
        raise ConfigError(
            f"A lift must lie within the clip, {time_s[0]:.2f} to {time_s[-1]:.2f} s, got "
            f"{start_s:.2f} to {end_s:.2f} s; correct its times."
        )
    first, last = (int(np.argmin(np.abs(time_s - moment))) for moment in span)
    if first == last:
        raise ConfigError(
            f"A lift must last longer than one picture, got {start_s:.2f} to {end_s:.2f} s; "
            "correct its times."
        )
    speed = np.nan_to_num(hands.speed[first : last + 1])
    return Move(first, first + int(np.argmax(speed)), last)


def _is_refused(
    move: Move, time_s: Array, given: Sequence[Move], not_lifts: Sequence[Span]
) -> bool:
    """Whether a person said otherwise of the time in which a lift was found."""
    own = _span(move, time_s)
    if any(_overlap_s(own, _span(other, time_s)) > 0.0 for other in given):
        return True
    return any(_overlap_s(own, s) > 0.5 * min(own[1] - own[0], s[1] - s[0]) for s in not_lifts)


def _span(move: Move, time_s: Array) -> Span:
    return float(time_s[move.start]), float(time_s[move.end])


def _overlap_s(one: Span, two: Span) -> float:
    return min(one[1], two[1]) - max(one[0], two[0])


def _describe_low_rate(rate_hz: float) -> str:
    return (
        f"Lifts need at least {MIN_FRAME_RATE_HZ:g} frames per second, this video has "
        f"{rate_hz:.1f}; no lift was looked for. Film at 25 frames per second or more."
    )


def _left_out(time_s: Array, move: Move, reason: str) -> str:
    return (
        f"A movement of the hands from {time_s[move.start]:.1f} to {time_s[move.end]:.1f} s was "
        f"left out: {reason}."
    )


def _find_objection(
    move: Move, hands: Hands, *, speed_floor_m_s: float, speed_share: float
) -> str | None:
    """Say why a movement can't be a lift that was seen from stop to stop; None if it can."""
    part = slice(move.start, move.end + 1)
    around = slice(max(move.start - 1, 0), move.end + 2)
    fastest = float(np.nanmax(hands.speed[part]))
    if fastest > MAX_HAND_SPEED_M_S:
        return (
            f"the hands reach {fastest:.1f} m/s there, and loads are lifted at less than "
            f"{MAX_HAND_SPEED_M_S:g} m/s"
        )
    if not np.isfinite(hands.speed[around]).all():
        return "the hands were not seen all the time"
    if float(np.median(hands.certainty[part])) < MIN_CERTAINTY:
        return "both hands are hidden most of the time, so that their path is a guess"
    stop = max(speed_floor_m_s, speed_share * fastest)
    if move.start == 0 and hands.speed[0] > 2 * stop:
        return "it is under way when the video starts; film the lift from before it begins"
    if move.end == len(hands.speed) - 1 and hands.speed[-1] > 2 * stop:
        return "it goes on when the video ends; film until the load is down"
    return None


def _explain(doubts: list[str], rate_hz: float) -> list[str]:
    texts = {
        "ends_at_rest": "A lift ends with hanging arms; rising without a load looks the same, so "
        "check that the hands carried something.",
        "one_direction": "Hands moved both up and down between two places; only the more frequent "
        "direction (upwards when equal) is counted as loaded.",
    }
    found = [texts[d] for d in doubts]
    if rate_hz < MIN_PEAK_RATE_HZ:
        found.append(
            f"Peak speeds need {MIN_PEAK_RATE_HZ:g} frames per second, this video has "
            f"{rate_hz:.1f}; they are likely too low."
        )
    return found


def find_conditions(track: PoseTrack, stature_m: float) -> tuple[str, ...]:
    """Return the conditions of a whole clip that touch the validity of risk methods."""
    skeleton = get_skeleton(track.skeleton)
    hips = skeleton.point(np.asarray(track.position), "pelvis")[:, 1]
    known = hips[np.isfinite(hips)]
    if known.size and np.percentile(known, 90) < SEATED_SHARE * stature_m:
        return ("seated",)
    return ()


def _notes(
    track: PoseTrack,
    hands: Hands,
    move: Move,
    scene: WorldScene,
    stature_m: float,
    max_hand_separation_m: float,
) -> list[str]:
    """Return the conditions of one lift that touch the validity of risk methods."""
    skeleton = get_skeleton(track.skeleton)
    position = np.asarray(track.position)
    part = slice(move.start, move.end + 1)
    along = _view_direction(scene)
    notes = []
    ankle = skeleton.point(position, "mid_ankle")[part]
    if _across(ankle[-1] - ankle[0], along) > WALK_M:
        notes.append("walking")
    knees = [skeleton.point(position, f"{s}_knee")[part, 1] for s in ("left", "right")]
    if _largest(-np.array(knees)) > -KNEELING_SHARE * stature_m:
        notes.append("kneeling")
    apart = np.array([_across(v, along) for v in hands.left[part] - hands.right[part]])
    if np.isfinite(apart).any() and np.nanmedian(apart) > max_hand_separation_m:
        notes.append("one_handed")
    turn = _foot_turn_deg(track, move)
    if turn > PIVOT_DEG + 2 * scene.heading_sigma_deg:
        notes.append("pivot")
    return notes


def _across(vector: Array, along: Array) -> float:
    """Return the length of a vector without its part along the line of sight."""
    return float(np.linalg.norm(vector - (vector @ along) * along))


def _foot_turn_deg(track: PoseTrack, move: Move) -> float:
    """Return by how much the feet turned from lift-off to set-down, degrees."""
    directions = [_foot_direction(track, k) for k in (move.start, move.end)]
    if not all(np.isfinite(d).all() for d in directions):
        return 0.0
    cosine = float(np.clip(directions[0] @ directions[1], -1.0, 1.0))
    return float(np.degrees(np.arccos(cosine)))


def _foot_direction(track: PoseTrack, frame: int) -> Array:
    """Return the mean heel-to-toe direction within a quarter of a second, horizontal, (3,)."""
    skeleton = get_skeleton(track.skeleton)
    near = np.abs(track.time_s - track.time_s[frame]) <= 0.25
    position = np.asarray(track.position)[near]
    total = np.zeros(3)
    for side in ("left", "right"):
        foot = skeleton.point(position, f"{side}_big_toe") - skeleton.point(
            position, f"{side}_heel"
        )
        known = foot[np.isfinite(foot).all(axis=1)]
        if len(known):
            total += np.median(known, axis=0) * [1.0, 0.0, 1.0]
    length = np.linalg.norm(total)
    return total / length if length > 1e-6 else np.full(3, np.nan)


def _measure_lift(
    track: PoseTrack,
    angles: JointAngles,
    hands: Hands,
    scene: WorldScene,
    move: Move,
    moves: list[Move],
    notes: tuple[str, ...],
    rate_hz: float,
) -> Lift:
    time_s = np.asarray(track.time_s)
    forward = None
    if "pivot" in notes:
        forward = _foot_direction(track, move.end)
    origin = measure_end(track, hands, scene, at_s=float(time_s[move.start]))
    destination = measure_end(track, hands, scene, at_s=float(time_s[move.end]), forward=forward)
    # What both ends share (floor, scale) cancels in the difference.
    travel = abs(destination.V_cm.value - origin.V_cm.value)
    travel_sigma = np.hypot(
        100 * np.sqrt(2) * np.nan_to_num(scene.plane_sigma_m), scene.scale_sigma * travel
    )
    part = slice(move.start, move.end + 1)
    # By their peaks too: a lift that a person set may reach into the movements around it.
    before = [m for m in moves if m.end <= move.start or m.peak < move.start]
    after = [m for m in moves if m.start >= move.end or m.peak > move.end]
    start_sigma, end_sigma = (
        SET_SIGMA_S
        if SET_BY_USER in notes
        else _crossing_sigma(time_s, hands.speed, crossing, move.peak, rate_hz)
        for crossing in (move.start, move.end)
    )
    return Lift(
        start_s=float(time_s[move.start]),
        end_s=float(time_s[move.end]),
        origin=origin,
        destination=destination,
        D_cm=Measurement(travel, float(travel_sigma)),
        peak_hand_speed_m_s=_largest(hands.speed[part]),
        peak_trunk_velocity_deg_s=_peak_trunk_velocity(angles, part),
        hands=1 if "one_handed" in notes else 2,
        reach_start_s=float(time_s[before[-1].start]) if before else float("nan"),
        return_end_s=float(time_s[after[0].end]) if after else float("nan"),
        start_sigma_s=start_sigma,
        end_sigma_s=end_sigma,
        notes=tuple(notes),
    )


def _peak_trunk_velocity(angles: JointAngles, part: slice) -> float:
    flexion = angles["trunk_flexion"]
    if len(flexion) < 2:
        return float("nan")
    return _largest(np.abs(np.gradient(flexion, angles.time_s))[part])


def _largest(values: Array) -> float:
    """Return the largest known value; NaN where none is known."""
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")


def _crossing_sigma(time_s: Array, speed: Array, crossing: int, peak: int, rate_hz: float) -> float:
    """Return the standard error of a threshold crossing: speed noise over slope, and the frame."""
    noise = float(np.nanpercentile(speed, 10))
    toward = crossing + (3 if peak > crossing else -3)
    toward = int(np.clip(toward, 0, len(speed) - 1))
    step = abs(time_s[toward] - time_s[crossing]) or 1.0 / rate_hz
    slope = abs(speed[toward] - speed[crossing]) / step
    crossing_error = noise / slope if slope > 1e-6 else 0.5
    return float(min(np.hypot(crossing_error, 1.0 / (rate_hz * np.sqrt(12))), 0.5))
