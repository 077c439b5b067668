"""Finding and undoing exchanged sides: left labels on right joints and the reverse.

Estimators mix up left and right for a while, in the whole body, the arms or the legs, and some
turn the body back to front with it. Link lengths hardly show it, positions do. Exchanging the
labels back keeps the measurement, where deleting the frames would lose it.

A state per frame says what is exchanged. The cheapest sequence of states is found over the
whole clip (Viterbi, with costs in nats): continuing must put every joint near its last place or
where its motion was heading, the hip line must not be twisted against the shoulder line, and
knees, toes and nose must point forward.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from engine.correction.gaps import find_runs
from engine.correction.robust import frame_interval_s, last_known, mad_sigma
from engine.datatypes import Array
from engine.skeletons import Skeleton

__all__ = ["SwapFindings", "SwapInterval", "exchange_sides", "find_swaps", "turn_round"]

Number = TypeVar("Number", bound=np.generic)

LOWER_PARTS = ("hip", "knee", "ankle", "heel", "big_toe", "small_toe", "foot")
HIPS = ("left_hip", "right_hip")
HEAD_PARTS = ("eye", "eye_inner", "eye_outer", "ear", "mouth")

SPREAD_M = 0.05
"""Least SD of the way between a joint and its predicted place, per frame at 30 frames/s."""
SPREAD_M_PER_S = 1.0
"""By how much that SD grows over longer steps."""
LONGEST_WAY_M = 0.30
"""A joint further away than this has jumped for another reason and counts no more."""
CHANGE_COST = 6.0
PARTIAL_COST = 2.0
REFLECTION_COST = 12.0
"""Nats for any change of state; more for a part of the body, or a body turned back to front."""
KEEP_GAIN = 3.0
FACING_GAIN = 6.0
TWIST_GAIN = 9.0
"""Nats per second: labels are usually right, bodies face forward and are not wrung."""
CLEAR_MARGIN = 3.0
"""Nats by which a repair must beat leaving the frames alone (odds of 20 to 1). In a picture that is
one second more of the usual labels than of the others."""


class _State(NamedTuple):
    """What is exchanged: per group, and whether the body is turned back to front."""

    exchanged: tuple[bool, ...]
    reflected: bool


@dataclass(frozen=True)
class SwapInterval:
    """A stretch of frames with exchanged sides.

    `parts` is `all` or names of `upper`, `lower`, `head`; `margin` tells by how many nats the
    exchange is likelier than none; `is_repaired` is false where that is too little.
    """

    start: int
    stop: int
    parts: tuple[str, ...]
    reflected: bool
    margin: float
    is_repaired: bool


@dataclass(frozen=True, eq=False)
class SwapFindings:
    """Which frames have exchanged sides.

    Parameters
    ----------
    is_exchanged
        Shape (T, K): this sample carries the label of the other side and is to be repaired.
    is_reflected
        Shape (T,): the body is also turned back to front.
    intervals
        All findings in order of time, repaired or not.
    """

    is_exchanged: NDArray[np.bool_]
    is_reflected: NDArray[np.bool_]
    intervals: tuple[SwapInterval, ...] = field(default=())


def exchange_sides(
    values: NDArray[Number], is_exchanged: NDArray[np.bool_], mirror_order: tuple[int, ...]
) -> NDArray[Number]:
    """Return values (T, K) or (T, K, D) with left and right exchanged where marked (T, K)."""
    mark = is_exchanged if values.ndim == 2 else is_exchanged[:, :, None]
    return np.asarray(np.where(mark, values[:, list(mirror_order)], values))


def turn_round(
    position: Array, is_reflected: NDArray[np.bool_], skeleton: Skeleton, depth_axis: int
) -> Array:
    """Return positions (T, K, D) with the marked frames (T,) reflected in depth at the mid-hip."""
    turned = position.copy()
    middle = skeleton.point(position, "pelvis")[is_reflected, None, depth_axis]
    turned[is_reflected, :, depth_axis] = 2.0 * middle - position[is_reflected, :, depth_axis]
    return turned


def find_swaps(
    time_s: Array,
    position_m: Array,
    skeleton: Skeleton,
    *,
    depth_axis: int | None = None,
) -> SwapFindings:
    """Find the frames in which left and right are exchanged.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    position_m
        Shape (T, K, D), about metres (a picture scaled to the size of the body will do); NaN
        where there is no trustworthy position.
    skeleton
        Names and pairs of the keypoints.
    depth_axis
        Axis of a 3D track that a camera can't see. If given, bodies that are turned back to
        front along it are found too.

    Returns
    -------
    SwapFindings
        A finding whose margin is too small is listed, but not marked for repair.

    Notes
    -----
    The steps are compared by the difference left - right of every pair, which no movement of the
    whole body changes. Without an absolute sign (a picture, or a body whose front is not seen)
    the state held for most of the time counts as right.
    """
    groups = _group_pairs(skeleton)
    nothing = SwapFindings(
        np.zeros(position_m.shape[:2], dtype=bool), np.zeros(len(time_s), dtype=bool)
    )
    if not groups or len(time_s) < 2:
        return nothing
    states = _list_states(len(groups), can_reflect=depth_axis is not None)
    step_cost = _step_costs(time_s, position_m, skeleton, groups, depth_axis)
    change = _change_costs(states)
    still = _state_costs(time_s, position_m, skeleton, groups, states)
    path, margin = _cheapest_path(_move_costs(step_cost, states) + change, still)
    intervals = tuple(
        _describe(start, stop, states[state], groups, float(margin[start:stop].max()))
        for start, stop, state in _stretches(path)
        if state != 0
    )
    return _mark(nothing, intervals, groups)


def _mark(
    empty: SwapFindings, intervals: tuple[SwapInterval, ...], groups: dict[str, NDArray[np.intp]]
) -> SwapFindings:
    exchanged, reflected = empty.is_exchanged.copy(), empty.is_reflected.copy()
    for found in intervals:
        if found.is_repaired:
            parts = tuple(groups) if found.parts == ("all",) else found.parts
            for part in parts:
                exchanged[found.start : found.stop, groups[part].ravel()] = True
            reflected[found.start : found.stop] = found.reflected
    return SwapFindings(exchanged, reflected, intervals)


def _group_pairs(skeleton: Skeleton) -> dict[str, NDArray[np.intp]]:
    """Return the columns (P, 2) of left and right per part of the body that has any."""
    columns: dict[str, list[tuple[int, int]]] = {"upper": [], "lower": [], "head": []}
    for left, right in skeleton.pairs:
        part = skeleton.keypoints[left].removeprefix("left_")
        name = "lower" if part in LOWER_PARTS else "head" if part in HEAD_PARTS else "upper"
        columns[name].append((left, right))
    return {name: np.array(pairs, dtype=np.intp) for name, pairs in columns.items() if pairs}


def _list_states(n_groups: int, *, can_reflect: bool) -> list[_State]:
    """List every combination of exchanged groups; the first is none."""
    states = [_State(flags, False) for flags in product((False, True), repeat=n_groups)]
    if can_reflect:
        states.append(_State((True,) * n_groups, True))
    return states


def _step_costs(
    time_s: Array,
    position: Array,
    skeleton: Skeleton,
    groups: dict[str, NDArray[np.intp]],
    depth_axis: int | None,
) -> Array:
    """Return the cost of every step per group, exchanged or not, reflected or not.

    Shape (T, groups, 2, 2), nats; row t is the step from the last known frame to t.
    """
    # The body's centre: no exchange of sides moves it.
    hips = [skeleton.index(name) for name in HIPS if name in skeleton.keypoints]
    centre = position[:, hips].mean(axis=1, keepdims=True) if hips else 0.0 * position[:, :1]
    costs = [_pair_costs(time_s, position, p, centre, depth_axis) for p in groups.values()]
    return np.stack(costs, axis=1)


def _pair_costs(
    time_s: Array,
    position: Array,
    pairs: NDArray[np.intp],
    centre: Array,
    depth_axis: int | None,
) -> Array:
    """Return the summed cost of the pairs of one group; shape (T, 2, 2) as in `_step_costs`."""
    left, right = position[:, pairs[:, 0]], position[:, pairs[:, 1]]
    apart = left - right
    known = np.asarray(np.isfinite(apart).all(axis=2))
    before = last_known(known)
    usable = known & (before >= 0)
    at = np.maximum(before, 0)
    earlier = np.take_along_axis(apart, at[:, :, None], axis=0)
    heading = _extrapolate(time_s, apart, known, before)
    limit = 2.0 * _variance(time_s, apart, earlier, usable, at)
    costs = np.zeros((len(time_s), 2, 2))
    for reflected, flip in enumerate(_reflections(apart.shape[2], depth_axis)):
        moved = np.zeros(known.shape)
        if depth_axis is not None:
            # Where the pair's middle is tells front from back; an exchange leaves it alone.
            middle = (left + right) / 2.0 - centre
            way = middle * flip - np.take_along_axis(middle, at[:, :, None], axis=0)
            moved = 2.0 * np.nan_to_num((way**2).sum(2))
        for exchanged, sign in enumerate((1.0, -1.0)):
            now = sign * flip * apart
            way = np.minimum(((now - earlier) ** 2).sum(2), ((now - heading) ** 2).sum(2)) / 2.0
            cost = np.minimum(way + moved, LONGEST_WAY_M**2) / limit
            costs[:, exchanged, reflected] = np.where(usable, cost, 0.0).sum(axis=1)
    return costs


def _reflections(n_axes: int, depth_axis: int | None) -> list[Array]:
    flips = [np.ones(n_axes)]
    if depth_axis is not None:
        flips.append(np.where(np.arange(n_axes) == depth_axis, -1.0, 1.0))
    return flips


def _extrapolate(
    time_s: Array, apart: Array, known: NDArray[np.bool_], before: NDArray[np.intp]
) -> Array:
    """Return where each difference was heading; its last value where that is unknown."""
    at = np.maximum(before, 0)
    second = np.take_along_axis(before, at, axis=0)
    has_two = (before >= 0) & (second >= 0)
    second = np.maximum(second, 0)
    last = np.take_along_axis(apart, at[:, :, None], axis=0)
    older = np.take_along_axis(apart, second[:, :, None], axis=0)
    span = np.where(has_two, time_s[at] - time_s[second], 1.0)
    ahead = time_s[:, None] - time_s[at]
    # Twice as far ahead as looked back is a guess no more.
    share = np.where(has_two & known, np.minimum(ahead / span, 1.5), 0.0)
    motion = np.where(has_two[:, :, None], last - older, 0.0)
    return np.asarray(last + share[:, :, None] * motion)


def _variance(
    time_s: Array,
    apart: Array,
    earlier: Array,
    usable: NDArray[np.bool_],
    at: NDArray[np.intp],
) -> Array:
    """Return the variance of a joint about its predicted place, from the clip itself, m^2."""
    way = np.where(usable[:, :, None], apart - earlier, np.nan)
    n_pairs, n_axes = apart.shape[1:]
    jitter = mad_sigma(way.reshape(len(way), -1)).reshape(n_pairs, n_axes)
    jitter = np.nan_to_num(jitter).max(axis=1)
    longer = np.maximum(time_s[:, None] - time_s[at] - frame_interval_s(time_s), 0.0)
    return np.asarray(SPREAD_M**2 + jitter**2 + (SPREAD_M_PER_S * longer) ** 2)


def _change_costs(states: list[_State]) -> Array:
    """Return the cost of going from one state to another whatever is seen; shape (S, S)."""
    cost = np.zeros((len(states), len(states)))
    for i, j in product(range(len(states)), repeat=2):
        changed = [a != b for a, b in zip(states[i].exchanged, states[j].exchanged, strict=True)]
        if i != j:
            cost[i, j] = CHANGE_COST
            cost[i, j] += PARTIAL_COST * (not all(changed))
            cost[i, j] += REFLECTION_COST * (states[i].reflected != states[j].reflected)
    return cost


def _move_costs(step: Array, states: list[_State]) -> Array:
    """Return what each change of state says about the step into frame t; shape (T, S, S)."""
    n_frames, n_groups = step.shape[:2]
    cost = np.zeros((n_frames, len(states), len(states)))
    for i, j in product(range(len(states)), repeat=2):
        reflected = int(states[i].reflected != states[j].reflected)
        for g in range(n_groups):
            exchanged = int(states[i].exchanged[g] != states[j].exchanged[g])
            cost[:, i, j] += step[:, g, exchanged, reflected]
    return cost


def _state_costs(
    time_s: Array,
    position: Array,
    skeleton: Skeleton,
    groups: dict[str, NDArray[np.intp]],
    states: list[_State],
) -> Array:
    """Return what each frame by itself says about the states; shape (T, S), nats."""
    # A second of evidence weighs the same at every frame rate, and a gap is not evidence.
    seconds = np.minimum(np.gradient(time_s), 0.2)
    facing = _facing_scores(position, skeleton)
    twist = _twist_score(position, skeleton)
    names = list(groups)
    cost = np.zeros((len(time_s), len(states)))
    for s, state in enumerate(states):
        flags = dict(zip(names, state.exchanged, strict=True))
        cost[:, s] += KEEP_GAIN * sum(state.exchanged) / len(names)
        if not state.reflected:
            for name, score in facing.items():
                # Turning a body back to front keeps its knees in front of its own hips.
                cost[:, s] += FACING_GAIN * np.where(flags.get(name, False), score, -score)
        if flags.get("upper", False) != flags.get("lower", False):
            cost[:, s] += TWIST_GAIN * twist
    return cost * seconds[:, None]


def _line(position: Array, skeleton: Skeleton, part: str) -> Array:
    """Return the line right to left of a pair, shape (T, D); NaN if there is none."""
    names = (f"left_{part}", f"right_{part}")
    if not all(name in skeleton.keypoints for name in names):
        return np.full((position.shape[0], position.shape[2]), np.nan)
    left, right = (position[:, skeleton.index(name)] for name in names)
    return np.asarray(left - right)


def _twist_score(position: Array, skeleton: Skeleton) -> Array:
    """Return +1 where shoulder and hip line point to the same side, -1 where they oppose."""
    upper, lower = (_line(position, skeleton, part) for part in ("shoulder", "hip"))
    agreement = (upper * lower).sum(axis=1) / 0.15**2
    return np.asarray(np.nan_to_num(np.clip(agreement, -1.0, 1.0)))


def _facing_scores(position: Array, skeleton: Skeleton) -> dict[str, Array]:
    """Return, per part of a 3D body, +1 where it points forward and -1 where backward.

    Forward is left x up of a right-handed frame, with up along the trunk; the legs are judged by
    knees and toes with the hips' left, the arms by the nose with the shoulders' left.
    """
    needed = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
    if position.shape[2] != 3 or not all(k in skeleton.keypoints for k in needed):
        return {}
    trunk = skeleton.point(position, "thorax") - skeleton.point(position, "pelvis")
    scores = {}
    for name, part, cues in (
        ("lower", "hip", (*_knee_cues(position, skeleton), *_toe_cues(position, skeleton))),
        ("upper", "shoulder", _nose_cues(position, skeleton)),
    ):
        forward = np.cross(_line(position, skeleton, part), trunk)
        size = np.linalg.norm(forward, axis=1, keepdims=True)
        forward = np.divide(forward, size, out=np.full_like(forward, np.nan), where=size > 0.01)
        parts = [np.clip((cue * forward).sum(axis=1) / 0.05, -1.0, 1.0) for cue in cues]
        if parts:
            scores[name] = np.nan_to_num(np.array(parts)).mean(axis=0)
    return scores


def _knee_cues(position: Array, skeleton: Skeleton) -> list[Array]:
    """Return how far each knee lies beside its line hip to ankle: knees bend forward only."""
    cues = []
    for side in ("left", "right"):
        names = [f"{side}_{part}" for part in ("hip", "knee", "ankle")]
        if all(name in skeleton.keypoints for name in names):
            hip, knee, ankle = (position[:, skeleton.index(name)] for name in names)
            cues.append(_beside(knee, hip, ankle))
    return cues


def _beside(point: Array, start: Array, end: Array) -> Array:
    """Return the way from the line through `start` and `end` to a point; shape (T, D)."""
    line = end - start
    square = (line**2).sum(axis=1, keepdims=True)
    along = ((point - start) * line).sum(axis=1, keepdims=True)
    share = np.divide(along, square, out=np.full_like(along, np.nan), where=square > 1e-6)
    return np.asarray(point - start - share * line)


def _toe_cues(position: Array, skeleton: Skeleton) -> list[Array]:
    return [
        position[:, skeleton.index(f"{side}_big_toe")] - position[:, skeleton.index(f"{side}_heel")]
        for side in ("left", "right")
        if {f"{side}_big_toe", f"{side}_heel"} <= set(skeleton.keypoints)
    ]


def _nose_cues(position: Array, skeleton: Skeleton) -> list[Array]:
    if "nose" not in skeleton.keypoints:
        return []
    nose = position[:, skeleton.index("nose")]
    if skeleton.has("mid_ear"):
        return [nose - skeleton.point(position, "mid_ear")]
    if "head" in skeleton.keypoints and skeleton.has("thorax"):
        top = position[:, skeleton.index("head")]
        return [_beside(nose, skeleton.point(position, "thorax"), top)]
    return []


def _cheapest_path(move: Array, still: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the cheapest sequence of states, and how much dearer it is not to exchange.

    Parameters
    ----------
    move
        Shape (T, S, S): cost of being in state j at t after state i at t - 1; row 0 is not used.
    still
        Shape (T, S): cost of being in state j at t.

    Returns
    -------
    path
        Shape (T,).
    margin
        Shape (T,): cost of the cheapest sequence that has state 0 at t, minus the lowest of all.
    """
    forward, backward = still.copy(), np.zeros_like(still)
    n_frames = len(still)
    for t in range(1, n_frames):
        forward[t] += (forward[t - 1][:, None] + move[t]).min(axis=0)
    for t in range(n_frames - 2, -1, -1):
        backward[t] = (move[t + 1] + (still[t + 1] + backward[t + 1])[None, :]).min(axis=1)
    total = forward + backward
    path = np.empty(n_frames, dtype=np.intp)
    path[-1] = int(forward[-1].argmin())
    for t in range(n_frames - 1, 0, -1):
        path[t - 1] = int((forward[t - 1] + move[t][:, path[t]]).argmin())
    return path, np.asarray(total[:, 0] - total.min(axis=1))


def _stretches(path: NDArray[np.intp]) -> list[tuple[int, int, int]]:
    """Return (start, stop, state) of every run of one state, in order of time."""
    return sorted(
        (start, stop, int(state))
        for state in np.unique(path)
        for start, stop in find_runs(np.asarray(path == state))
    )


def _describe(
    start: int, stop: int, state: _State, groups: dict[str, NDArray[np.intp]], margin: float
) -> SwapInterval:
    parts = tuple(name for name, flag in zip(groups, state.exchanged, strict=True) if flag)
    if len(parts) == len(groups) and len(groups) > 1:
        parts = ("all",)
    return SwapInterval(
        start=start,
        stop=stop,
        parts=parts,
        reflected=state.reflected,
        margin=margin,
        is_repaired=margin >= CLEAR_MARGIN,
    )
