"""A measured lift, posed anew for other places of the hands.

A redesigned workplace was not filmed, so its posture is an assumption. Here it follows the person
as closely as the video allows. In every frame the posture is taken from the moment of the same
lift (of the same reach, of the same return) when the hands were nearest to where they would be;
what is left is shared out between arms, trunk and hips, each giving way in proportion to how
readily it does (least weighted change, a damped inverse kinematics). Feet stay where they are, and
no limb changes its length. How well this foretells what a person really does is measured by
`benchmarks/what_if.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, JointAngles, Lift, PoseTrack, Status
from engine.skeletons import Skeleton, get_skeleton

__all__ = ["HandShift", "Reposed", "repose_lift"]

# How readily each part gives way: standard deviations of a change of posture. Chosen on the
# training persons of the synthetic lifts, benchmarks/what_if.py.
LEAN_SIGMA_DEG = 20.0
HIPS_SIGMA_M = (0.04, 0.04)
"""Of the hips, forward and up."""
ARM_SIGMA_M = 0.05
"""Of the hands relative to the shoulders, per direction."""

LEAN_LIMITS_DEG = (-10.0, 110.0)
MAX_STRETCH = 0.99
"""Share of a limb's length that hip to ankle, or shoulder to wrist, may reach."""
MIN_LEG = 0.35
BALANCE_M = 0.10
"""How much further forward or back the hips may go than they ever do in the clip."""
N_STEPS, CLOSE_M = 8, 0.0005
LEAD_S = 1.0
"""Length of the reach and of the return where they are not known."""
FORWARD_COST, TIME_COST_M = 0.5, 0.02
"""How much a difference forward, and one in time (per share of the phase), counts against one in
height when the moment with the nearest hands is looked for."""
MIN_SHIFT_M = 0.002

# How far a posed posture may be off, beside the error of what was filmed; chosen in the same way.
POSED_SIGMA_M, POSED_SIGMA_DEG = 0.03, 8.0
"""Of any point and angle of a posed frame: nobody repeats a lift exactly."""
SHIFT_SIGMA = 0.12
"""More, as a share of how far a point or angle moved from where it was filmed."""
LUMBAR_SHARE = 0.6
"""Share of a lean that the lumbar spine takes, as the solvers assume it."""

HIPS, KNEES = ("left_hip", "right_hip"), ("left_knee", "right_knee")
FIXED = ("ankle", "heel", "big_toe")
ARM = ("elbow", "wrist", "pinky", "index", "thumb")


@dataclass(frozen=True)
class HandShift:
    """By how much the hands move at one end of a lift: away from the ankles, and up (m)."""

    away_m: float = 0.0
    up_m: float = 0.0

    @property
    def is_none(self) -> bool:
        """Whether nothing moves."""
        return max(abs(self.away_m), abs(self.up_m)) < MIN_SHIFT_M


@dataclass(frozen=True, eq=False)
class Reposed:
    """A lift in its new posture.

    `unreached_m` is how far the hands stay from where they should be, at the worst: more than a
    few centimetres cannot be reached by this person from where the feet are. `is_posed` (T,) marks
    the frames that are no longer as filmed.
    """

    track: PoseTrack
    angles: JointAngles
    unreached_m: float
    is_posed: NDArray[np.bool_]


def repose_lift(
    track: PoseTrack,
    angles: JointAngles,
    lift: Lift,
    *,
    origin: HandShift,
    destination: HandShift,
) -> Reposed:
    """Pose a lift anew with the hands shifted at its ends, and in proportion between them.

    Parameters
    ----------
    track
        World metres, as the methods judge it.
    angles
        Of the same frames.
    lift
        Its reach, lift and return are posed; all other frames stay as filmed.
    origin, destination
        Shift of the hands.

    Returns
    -------
    Reposed
        Frames without hands, hips or shoulders stay as filmed. Standard errors grow with the
        distance a point moved; trunk, hips, knees, shoulders and elbows of `angles` follow, the
        pelvis becomes NaN.
    """
    body = _Body(track)
    steps = [
        (frames, shift)
        for frames, shift in _phases(body, lift, origin, destination)
        if frames.size and np.abs(shift).max(initial=0.0) >= MIN_SHIFT_M
    ]
    if not steps:
        return Reposed(track, angles, 0.0, np.zeros(track.n_frames, dtype=bool))
    position = np.array(track.position)
    source = np.arange(track.n_frames)
    unreached, is_posed = 0.0, np.zeros(track.n_frames, dtype=bool)
    for frames, shift in steps:
        moved = np.abs(shift).max(axis=1) >= MIN_SHIFT_M
        target = body.hands[frames] + shift
        source[frames] = np.where(moved, _find_nearest(body, frames, target), frames)
        chain = _Chain(body, source[frames], target)
        left = chain.reach()
        position[frames] = np.where(
            moved[:, None, None], chain.place(body, frames), position[frames]
        )
        unreached = max(unreached, float(np.max(left[moved], initial=0.0)))
        is_posed[frames] = moved
    new_track = _build_track(track, position, source, is_posed)
    return Reposed(
        new_track, _build_angles(angles, body, new_track, source, is_posed), unreached, is_posed
    )


class _Body:
    """A track seen in the plane of the lift: away from the ankles, and up, both in metres.

    Positions in the plane are relative to the ankles' middle, shape (T, 2).
    """

    def __init__(self, track: PoseTrack) -> None:
        self.skeleton: Skeleton = get_skeleton(track.skeleton)
        self.time_s = np.asarray(track.time_s)
        self.position = np.asarray(track.position)
        self.ankle = self._mean("left_ankle", "right_ankle")
        self.forward = self._find_forward()
        self.hands = self.plane(self._mean(*self._hand_names()))
        self.hips = self.plane(self._mean(*HIPS))
        self.shoulders = self.plane(self._mean("left_shoulder", "right_shoulder"))

    def _hand_names(self) -> tuple[str, ...]:
        fingers = [n for n in self.skeleton.keypoints if n.endswith(("_index", "_pinky"))]
        return tuple(fingers) or ("left_wrist", "right_wrist")

    def column(self, name: str) -> Array:
        """Return a keypoint, shape (T, 3); NaN if the skeleton has it not."""
        if name not in self.skeleton.keypoints:
            return np.full((self.time_s.size, 3), np.nan)
        return np.asarray(self.position[:, self.skeleton.index(name)])

    def _mean(self, *names: str) -> Array:
        """Return the mean of the points that are seen, shape (T, 3); NaN where none is."""
        points = np.stack([self.column(name) for name in names])
        seen = np.isfinite(points).all(axis=2, keepdims=True)
        count = seen.sum(axis=0)
        total = np.where(seen, points, 0.0).sum(axis=0)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def _find_forward(self) -> Array:
        """Return the horizontal unit vector from the ankles to the hands at work, shape (3,)."""
        offset = self._mean(*self._hand_names()) - self.ankle
        offset[:, 1] = 0.0
        reach = np.linalg.norm(offset, axis=1)
        far = reach >= np.nanmax(reach, initial=0.0) / 2
        total = np.where(far[:, None], offset, 0.0).sum(axis=0)
        length = float(np.linalg.norm(total))
        return np.asarray(total / length) if length > 0 else np.array([1.0, 0.0, 0.0])

    def plane(self, point: Array) -> Array:
        """Return points (T, 3) in the plane, shape (T, 2)."""
        offset = point - self.ankle
        return np.stack([offset @ self.forward, offset[:, 1]], axis=1)

    def lift_out(self, shift: Array) -> Array:
        """Return shifts in the plane (N, 2) as shifts in the world (N, 3)."""
        return np.asarray(shift[:, :1] * self.forward + shift[:, 1:] * np.array([0.0, 1.0, 0.0]))


def _phases(
    body: _Body, lift: Lift, origin: HandShift, destination: HandShift
) -> Iterator[tuple[NDArray[np.intp], Array]]:
    """Yield the frames of reach, lift and return, each with the shift of the hands (N, 2)."""
    time_s = body.time_s
    ends = np.array([[s.away_m, s.up_m] for s in (origin, destination)])
    reach_s = lift.reach_start_s if math.isfinite(lift.reach_start_s) else lift.start_s - LEAD_S
    back_s = lift.return_end_s if math.isfinite(lift.return_end_s) else lift.end_s + LEAD_S
    known = (
        np.isfinite(body.hands).all(axis=1)
        & np.isfinite(body.hips).all(axis=1)
        & np.isfinite(body.shoulders).all(axis=1)
    )
    reach = np.flatnonzero((time_s >= reach_s) & (time_s < lift.start_s) & known)
    yield reach, _ease(time_s[reach], reach_s, lift.start_s)[:, None] * ends[0]
    held = np.flatnonzero((time_s >= lift.start_s) & (time_s <= lift.end_s) & known)
    share = _progress(body.hands[held, 1], time_s[held])[:, None]
    yield held, (1.0 - share) * ends[0] + share * ends[1]
    back = np.flatnonzero((time_s > lift.end_s) & (time_s <= back_s) & known)
    yield back, _ease(time_s[back], back_s, lift.end_s)[:, None] * ends[1]


def _ease(time_s: Array, start_s: float, end_s: float) -> Array:
    """Return a smooth ramp from 0 at `start_s` to 1 at `end_s`, which may lie before it."""
    share = np.clip((time_s - start_s) / (end_s - start_s), 0.0, 1.0)
    return np.asarray(share * share * (3.0 - 2.0 * share))


def _progress(height_m: Array, time_s: Array) -> Array:
    """Return how far a lift has come, 0 to 1: by height, or by time where it hardly rises."""
    if height_m.size < 2:
        return np.zeros(height_m.size)
    travel = float(height_m[-1] - height_m[0])
    if abs(travel) < 0.1:
        return np.asarray((time_s - time_s[0]) / (time_s[-1] - time_s[0]))
    return np.asarray(np.clip((height_m - height_m[0]) / travel, 0.0, 1.0))


def _find_nearest(body: _Body, frames: NDArray[np.intp], target: Array) -> NDArray[np.intp]:
    """Return for every frame the moment of its phase when the hands were nearest to the target."""
    gap = body.hands[frames][None] - target[:, None]
    share = np.linspace(0.0, 1.0, frames.size)
    late = TIME_COST_M * (share[None] - share[:, None])
    cost = gap[..., 1] ** 2 + (FORWARD_COST * gap[..., 0]) ** 2 + late**2
    return np.asarray(frames[np.argmin(cost, axis=1)])


class _Chain:
    """Hips, trunk and arms of N postures, moved until the hands are at their targets.

    All in the plane, relative to the ankles: `hips`, `trunk` (hips to shoulders) and `arm`
    (shoulders to hands), shape (N, 2) each.
    """

    def __init__(self, body: _Body, source: NDArray[np.intp], target: Array) -> None:
        self.source, self.target = source, target
        self.hips = np.array(body.hips[source])
        self.trunk = body.shoulders[source] - self.hips
        self.arm = body.hands[source] - self.hips - self.trunk
        self.start = (self.hips.copy(), self.trunk.copy(), self.arm.copy())
        # A mean of both arms is shorter than either where they are apart: it is held to the length
        # it reaches anywhere, or to that it has here.
        longest = np.linalg.norm(body.hands - body.shoulders, axis=1)
        self.arm_max = max(float(np.nanmax(longest)), float(np.linalg.norm(self.arm, axis=1).max()))
        self.leg_max = float(np.nanmax(np.linalg.norm(body.hips, axis=1)))
        ground = body.hips[:, 0]
        self.balance = float(np.nanmin(ground)) - BALANCE_M, float(np.nanmax(ground)) + BALANCE_M

    def reach(self) -> Array:
        """Move the parts; return how far the hands stay from their targets, shape (N,), m."""
        for _ in range(N_STEPS):
            missing = self.target - self._hands()
            if np.abs(missing).max(initial=0.0) < CLOSE_M:
                break
            self._step(missing)
        return np.asarray(np.linalg.norm(self.target - self._hands(), axis=1))

    def _hands(self) -> Array:
        return self.hips + self.trunk + self.arm

    def _step(self, missing: Array) -> None:
        """Share out what is missing: the closed form of the least weighted change."""
        lean_gain = np.stack([self.trunk[:, 1], -self.trunk[:, 0]], axis=1)
        lean_variance = math.radians(LEAN_SIGMA_DEG) ** 2
        own = np.diag(np.square(HIPS_SIGMA_M) + ARM_SIGMA_M**2)
        total = lean_variance * lean_gain[:, :, None] * lean_gain[:, None, :] + own
        solved = np.linalg.solve(total, missing[:, :, None])[..., 0]
        lean = lean_variance * np.sum(lean_gain * solved, axis=1)
        self.trunk = _rotate(self.trunk, lean)
        self._limit_trunk()
        hips = self.hips + np.square(HIPS_SIGMA_M) * solved
        hips[:, 0] = np.clip(hips[:, 0], *self.balance)
        self.hips = _limit_length(hips, MIN_LEG * self.leg_max, self.leg_max)
        self.arm = _limit_length(self.arm + ARM_SIGMA_M**2 * solved, 0.0, self.arm_max)

    def _limit_trunk(self) -> None:
        low, high = np.radians(LEAN_LIMITS_DEG)
        now = np.arctan2(self.trunk[:, 0], self.trunk[:, 1])
        before = np.arctan2(self.start[1][:, 0], self.start[1][:, 1])
        allowed = np.clip(now, np.minimum(low, before), np.maximum(high, before))
        self.trunk = _rotate(self.trunk, allowed - now)

    @property
    def lean(self) -> Array:
        """How far the trunk leans forward more than in the source, radians, shape (N,)."""
        now, before = (np.arctan2(t[:, 0], t[:, 1]) for t in (self.trunk, self.start[1]))
        return np.asarray(now - before)

    def place(self, body: _Body, frames: NDArray[np.intp]) -> Array:
        """Return all keypoints in the new posture, shape (N, K, 3)."""
        names = body.skeleton.keypoints
        # The posture of the source, standing where the feet are.
        offset = (body.ankle[frames] - body.ankle[self.source])[:, None]
        places = body.position[self.source] + offset
        ankle = body.ankle[frames]
        hips_shift = body.lift_out(self.hips - self.start[0])
        centre = ankle + body.lift_out(self.hips)
        arm_shift = body.lift_out(self.arm - self.start[2])
        parts = np.array([name.split("_", 1)[-1] for name in names])
        fixed, hips = np.isin(parts, FIXED), np.isin(parts, ("hip", "pelvis"))
        # Knees and arms are placed by their own segments, below.
        trunk = ~(fixed | hips | (parts == "knee"))
        result = places + hips_shift[:, None]
        result[:, fixed] = body.position[frames][:, fixed]
        result[:, trunk] = _rotate_about(result[:, trunk], centre, self.lean, body.forward)
        _place_arms(result, names, places, arm_shift)
        _place_knees(result, names, places)
        return result


def _rotate(vector: Array, lean: Array) -> Array:
    """Lean vectors of the plane (N, 2) forward by angles in radians."""
    cosine, sine = np.cos(lean), np.sin(lean)
    away, up = vector[:, 0], vector[:, 1]
    return np.stack([cosine * away + sine * up, cosine * up - sine * away], axis=1)


def _rotate_about(points: Array, centre: Array, lean: Array, forward: Array) -> Array:
    """Lean points (N, K, 3) forward about centres (N, 3); what lies across the plane stays."""
    offset = points - centre[:, None]
    away, up = offset @ forward, offset[..., 1]
    cosine, sine = np.cos(lean)[:, None], np.sin(lean)[:, None]
    change = (cosine - 1.0) * away + sine * up, (cosine - 1.0) * up - sine * away
    result = points + change[0][..., None] * forward
    result[..., 1] += change[1]
    return np.asarray(result)


def _limit_length(vector: Array, low: float, high: float) -> Array:
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    return np.asarray(vector * np.clip(length, low, high) / np.maximum(length, 1e-9))


def _place_arms(result: Array, names: tuple[str, ...], places: Array, arm_shift: Array) -> None:
    """Put the arms between the leant shoulders and the hands, which keep their direction."""
    for side in ("left", "right"):
        parts = [part for part in ("shoulder", *ARM) if f"{side}_{part}" in names]
        columns = {part: names.index(f"{side}_{part}") for part in parts}
        if "wrist" not in columns or "shoulder" not in columns:
            continue
        shoulder, wrist = columns["shoulder"], columns["wrist"]
        carried = result[:, shoulder] - places[:, shoulder]
        moved = places[:, wrist] + carried + arm_shift
        for part, k in columns.items():
            if part not in ("shoulder", "elbow"):
                result[:, k] = places[:, k] + carried + arm_shift
        if "elbow" in columns:
            elbow = places[:, columns["elbow"]]
            result[:, columns["elbow"]] = _place_joint(
                result[:, shoulder],
                moved,
                elbow + carried,
                np.linalg.norm(elbow - places[:, shoulder], axis=1),
                np.linalg.norm(places[:, wrist] - elbow, axis=1),
            )


def _place_knees(result: Array, names: tuple[str, ...], places: Array) -> None:
    for side in ("left", "right"):
        hip, knee, ankle = (names.index(f"{side}_{part}") for part in ("hip", "knee", "ankle"))
        result[:, knee] = _place_joint(
            result[:, hip],
            result[:, ankle],
            places[:, knee],
            np.linalg.norm(places[:, knee] - places[:, hip], axis=1),
            np.linalg.norm(places[:, ankle] - places[:, knee], axis=1),
        )


def _place_joint(start: Array, end: Array, near: Array, upper: Array, lower: Array) -> Array:
    """Place the joint between two segments of known length, bent to the side where it was.

    Parameters
    ----------
    start, end
        Shape (N, 3), the ends of the limb.
    near
        Shape (N, 3), where the joint was.
    upper, lower
        Shape (N,), lengths of the segments; a limb that is too short is straight.
    """
    axis = end - start
    length = np.maximum(np.linalg.norm(axis, axis=1), 1e-6)
    axis = axis / length[:, None]
    reach = np.minimum(length, MAX_STRETCH * (upper + lower))
    along = (upper**2 - lower**2 + reach**2) / (2 * np.maximum(reach, 1e-6))
    height = np.sqrt(np.maximum(upper**2 - along**2, 0.0))
    side = near - start
    side = side - np.sum(side * axis, axis=1, keepdims=True) * axis
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-6)
    along = along * length / np.maximum(reach, 1e-6)
    return np.asarray(start + along[:, None] * axis + height[:, None] * side)


# --------------------------------------------------------------------------- tracks and angles


def _build_track(
    track: PoseTrack, position: Array, source: NDArray[np.intp], is_posed: NDArray[np.bool_]
) -> PoseTrack:
    moved = np.linalg.norm(position - track.position, axis=2)
    doubt = np.hypot(POSED_SIGMA_M, SHIFT_SIGMA * np.nan_to_num(moved))
    sigma = np.hypot(track.sigma[source], doubt)
    status = np.array(track.status[source])
    is_moved = is_posed[:, None] & np.isfinite(position).all(axis=2)
    status[is_moved] = Status.FILLED
    # Feet and whatever else stayed keep their own error and status.
    stayed = ~is_posed[:, None] | (moved < 1e-9)
    return replace(
        track,
        position=position,
        sigma=np.where(stayed, track.sigma, sigma),
        confidence=np.where(stayed, track.confidence, track.confidence[source]),
        status=np.where(stayed, track.status, status),
        provenance={**track.provenance, "posed": "for other places of the hands, not filmed"},
    )


def _build_angles(
    angles: JointAngles,
    body: _Body,
    posed: PoseTrack,
    source: NDArray[np.intp],
    is_posed: NDArray[np.bool_],
) -> JointAngles:
    """Add to the angles of the source what the posed points changed."""
    value = np.array(angles.value_deg[source])
    sigma = np.array(angles.sigma_deg[source])
    status = np.array(angles.status[source])
    before, after = _measure_angles(body), _measure_angles(_Body(posed))
    for k, name in enumerate(angles.names):
        key = name.removesuffix("_l").removesuffix("_r")
        if key.startswith("pelvis"):
            continue
        known = name if name in before else key
        if known in before:
            change = after[known] - before[known][source]
            value[:, k] += change
            sigma[:, k] = np.hypot(sigma[:, k], SHIFT_SIGMA * np.abs(value[:, k] - angles[name]))
            sigma[is_posed, k] = np.hypot(sigma[is_posed, k], POSED_SIGMA_DEG)
    for k, name in enumerate(angles.names):
        if name.startswith("pelvis"):
            value[is_posed, k] = sigma[is_posed, k] = np.nan
            status[is_posed, k] = Status.MISSING
        if name == "trunk_inclination":
            value[:, k] = np.abs(value[:, k])
    return replace(angles, value_deg=value, sigma_deg=sigma, status=status)


def _measure_angles(body: _Body) -> Mapping[str, Array]:
    """Return angles in the plane of the lift, degrees, shape (T,); only their changes are used."""
    trunk = body.shoulders - body.hips
    lean = np.degrees(np.arctan2(trunk[:, 0], trunk[:, 1]))
    found = {
        "trunk_flexion": lean,
        "trunk_inclination": np.abs(lean),
        "lumbar_flexion": LUMBAR_SHARE * lean,
    }
    for side, word in (("l", "left"), ("r", "right")):
        points = {
            part: body.plane(body.column(f"{word}_{part}"))
            for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        }
        found[f"hip_flexion_{side}"] = lean + _angle(points["hip"], points["knee"])
        found[f"shoulder_flexion_{side}"] = lean + _angle(points["shoulder"], points["elbow"])
        found[f"knee_flexion_{side}"] = _bend(body, word, "hip", "knee", "ankle")
        found[f"elbow_flexion_{side}"] = _bend(body, word, "shoulder", "elbow", "wrist")
    return found


def _angle(start: Array, end: Array) -> Array:
    """Return how far a hanging segment swings forward from straight down, degrees."""
    return np.asarray(np.degrees(np.arctan2(end[:, 0] - start[:, 0], start[:, 1] - end[:, 1])))


def _bend(body: _Body, side: str, first: str, middle: str, last: str) -> Array:
    """Return 180 degrees minus the included angle at a joint."""
    a, b, c = (body.column(f"{side}_{part}") for part in (first, middle, last))
    one, two = b - a, c - b
    size = np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.sum(one * two, axis=1) / size
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
