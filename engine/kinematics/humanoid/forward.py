"""Forward kinematics of the 21 variables, for thousands of candidates a call.

Everything is written out by component over arrays of candidates: products of small matrices
would cost several times as much.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.errors import ShapeError
from engine.kinematics.humanoid.lengths import SegmentLengths
from engine.kinematics.humanoid.model import FITTED_JOINTS, VARIABLES

__all__ = ["compute_joints", "fit_residual"]

Floats = NDArray[np.floating[Any]]

# Places in the vector of the 20 angles; the limbs as (left, right).
_BODY, _WAIST = slice(0, 3), slice(3, 6)
_HIP, _KNEE = [6, 8], [7, 9]
_SHOULDER, _ELBOW = [10, 12], [11, 13]
_HIP_OUT, _SHOULDER_OUT, _SHOULDER_TURN = slice(14, 16), slice(16, 18), slice(18, 20)
_SIDE = np.array([[1.0], [-1.0]])


def compute_joints(values: ArrayLike, lengths: SegmentLengths) -> Floats:
    """Compute the twelve joints for every set of values.

    Parameters
    ----------
    values
        Shape (..., 21): the size factor, then radians, in the order of `VARIABLES`. 32-bit
        input is computed in 32 bits, in about half the time.
    lengths
        Segment lengths, metres; the size factor multiplies them all.

    Returns
    -------
    NDArray
        Shape (..., 12, 3), metres, in the order of `FITTED_JOINTS`: around the mid-hip, X
        forward, Y left, Z up.

    Raises
    ------
    ShapeError
        If the last dimension is not 21.
    """
    given = _as_floats(values)
    joints = _joints_by_component(given, lengths)
    return np.moveaxis(joints, -1, 0).reshape(*given.shape[:-1], len(FITTED_JOINTS), 3)


def fit_residual(
    values: ArrayLike,
    lengths: SegmentLengths,
    targets: ArrayLike,
    weights: ArrayLike | None = None,
) -> Floats:
    """Compute the cost of Choi et al. (2024), Eq 8: the mean distance of model and seen joints.

    Parameters
    ----------
    values
        Shape (..., 21), as in `compute_joints`.
    lengths
        Segment lengths, metres.
    targets
        Shape (12, 3), or (..., 12, 3) with the leading dimensions of `values`: the joints seen,
        around the mid-hip, in the figure's axes (see `centre_on_pelvis`); NaN where missing.
    weights
        Shape (12,) or (..., 12), not negative; all alike if None.

    Returns
    -------
    NDArray
        Shape (...), metres: the weighted mean Euclidean distance over the joints that were seen;
        NaN where there is none.

    References
    ----------
    .. [1] Choi et al. (2024), Eq 8.
    """
    given = _as_floats(values)
    joints = _joints_by_component(given, lengths)
    seen = np.asarray(targets, dtype=given.dtype)
    if seen.shape[-2:] != (len(FITTED_JOINTS), 3):
        raise ShapeError(f"Targets need shape (..., 12, 3), got {seen.shape}.")
    if seen.ndim == 2:
        seen = seen[..., None]
    else:
        shape = (*given.shape[:-1], *seen.shape[-2:])
        seen = np.moveaxis(np.broadcast_to(seen, shape).reshape(-1, *shape[-2:]), 0, -1)
    joints -= seen
    np.multiply(joints, joints, out=joints)
    distance = np.sqrt(joints[:, 0] + joints[:, 1] + joints[:, 2])
    return _mean_over_seen(distance, weights, given.shape[:-1])


def _mean_over_seen(
    distance: Floats, weights: ArrayLike | None, leading: tuple[int, ...]
) -> Floats:
    """Return the weighted mean over the first axis of (12, N), leaving out NaN."""
    is_seen = np.isfinite(distance)
    if weights is None and is_seen.all():
        return np.asarray(distance.mean(axis=0).reshape(leading))
    weight = np.ones(len(FITTED_JOINTS)) if weights is None else np.asarray(weights)
    shape = (*leading, len(FITTED_JOINTS))
    each = np.broadcast_to(weight, shape).reshape(-1, len(FITTED_JOINTS)).T * is_seen
    total = each.sum(axis=0)
    cost = (each * np.where(is_seen, distance, 0.0)).sum(axis=0)
    mean = np.divide(cost, total, out=np.full(total.shape, np.nan), where=total > 0)
    return np.asarray(mean.astype(distance.dtype).reshape(leading))


def _as_floats(values: ArrayLike) -> Floats:
    given = np.asarray(values)
    if given.dtype not in (np.float32, np.float64):
        given = given.astype(np.float64)
    if given.ndim == 0 or given.shape[-1] != len(VARIABLES):
        raise ShapeError(f"Values need shape (..., {len(VARIABLES)}), got {given.shape}.")
    return given


def _joints_by_component(given: Floats, lengths: SegmentLengths) -> Floats:
    """Return the joints as (12, 3, N)."""
    flat = np.ascontiguousarray(given.reshape(-1, given.shape[-1]).T)
    sine, cosine = np.sin(flat[1:]), np.cos(flat[1:])
    size = flat[0]
    side = _SIDE.astype(flat.dtype)
    scale = {name: size * flat.dtype.type(value) for name, value in lengths.as_dict().items()}
    body = body_axes(sine[_BODY], cosine[_BODY])
    trunk = trunk_axes(body, sine[_WAIST], cosine[_WAIST])
    joints = np.empty((len(FITTED_JOINTS), 3, flat.shape[1]), dtype=flat.dtype)
    joints[6:8] = side[..., None] * (scale["pelvis_half_width"] * body[1])
    joints[0:2] = side[..., None] * (scale["shoulder_half_width"] * trunk[1])
    joints[0:2] += scale["trunk"] * trunk[2]
    legs = _leg_directions(sine, cosine, side)
    arms = _arm_directions(sine, cosine, side)
    for start, parts, axes, names in (
        (6, legs, body, ("thigh", "shank")),
        (0, arms, trunk, ("upper_arm", "forearm")),
    ):
        for i, (direction, name) in enumerate(zip(parts, names, strict=True)):
            above = joints[start + 2 * i : start + 2 * i + 2]
            below = joints[start + 2 * i + 2 : start + 2 * i + 4]
            np.add(above, scale[name] * _turn(axes, direction), out=below)
    return joints


def _turn(axes: Floats, direction: tuple[Floats, Floats, Floats]) -> Floats:
    """Return directions of the two sides in the axes (3, 3, N) of their parent: (2, 3, N)."""
    x, y, z = (part[:, None] for part in direction)
    return np.asarray(x * axes[0] + y * axes[1] + z * axes[2])


def body_axes(sine: Floats, cosine: Floats) -> Floats:
    """Return the axes of Rz(psi) Ry(theta) Rx(phi), one a row, shape (3, 3, N)."""
    st, sp, ss = sine
    ct, cp, cs = cosine
    axes = np.empty((3, 3, st.size), dtype=st.dtype)
    axes[0] = ct * cs, ct * ss, -st
    axes[1] = st * sp * cs - cp * ss, st * sp * ss + cp * cs, ct * sp
    axes[2] = st * cp * cs + sp * ss, st * cp * ss - sp * cs, ct * cp
    return axes


def trunk_axes(body: Floats, sine: Floats, cosine: Floats) -> Floats:
    """Return the axes of the trunk: those of the body times Ry(theta) Rx(phi) Rz(psi)."""
    st, sp, ss = sine
    ct, cp, cs = cosine
    columns = (
        (ct * cs + st * sp * ss, cp * ss, -st * cs + ct * sp * ss),
        (-ct * ss + st * sp * cs, cp * cs, st * ss + ct * sp * cs),
        (st * cp, -sp, ct * cp),
    )
    axes = np.empty_like(body)
    for i, (x, y, z) in enumerate(columns):
        axes[i] = x * body[0] + y * body[1] + z * body[2]
    return axes


def _leg_directions(
    sine: Floats, cosine: Floats, side: Floats
) -> tuple[tuple[Floats, Floats, Floats], ...]:
    """Return the downward directions of thighs and shanks in the pelvis, (2, N) a component."""
    st, ct = sine[_HIP], cosine[_HIP]
    so, co = side * sine[_HIP_OUT], cosine[_HIP_OUT]
    sk, ck = sine[_KNEE], cosine[_KNEE]
    down = co * ck
    thigh = (co * st, so, -co * ct)
    shank = (down * st - sk * ct, so * ck, -sk * st - down * ct)
    return thigh, shank


def _arm_directions(
    sine: Floats, cosine: Floats, side: Floats
) -> tuple[tuple[Floats, Floats, Floats], ...]:
    """Return the downward directions of upper arms and forearms in the trunk."""
    st, ct = sine[_SHOULDER], cosine[_SHOULDER]
    so, co = sine[_SHOULDER_OUT], cosine[_SHOULDER_OUT]
    sw, cw = sine[_SHOULDER_TURN], cosine[_SHOULDER_TURN]
    se, ce = sine[_ELBOW], cosine[_ELBOW]
    upper_arm = (co * st, side * so, -co * ct)
    forward, inward = se * cw, se * sw
    up = -(inward * so + ce * co)
    forearm = (forward * ct - up * st, side * (ce * so - inward * co), forward * st + up * ct)
    return upper_arm, forearm
