"""Rotations by a vector: about its direction, by its length.

A ball joint that can point anywhere, like the shoulder, has no singular posture in these
coordinates within a full turn; flexion, abduction and rotation have one with the arm straight out
to the side. For small angles both are the same.
"""

from __future__ import annotations

import numpy as np

from engine.datatypes import Array

__all__ = ["compute_rotation", "compute_slope", "compute_vectors"]

SMALL = 1e-4


def _coefficients(vector: Array) -> tuple[Array, Array, Array]:
    """Return sin(a)/a, (1-cos(a))/a^2 and (a-sin(a))/a^3 for vectors (3, T) of length a."""
    angle = np.sqrt(np.einsum("it,it->t", vector, vector))
    safe = np.where(angle < SMALL, 1.0, angle)
    first = np.where(angle < SMALL, 1.0, np.sin(safe) / safe)
    second = np.where(angle < SMALL, 0.5, (1.0 - np.cos(safe)) / safe**2)
    third = np.where(angle < SMALL, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    return first, second, third


def _combine(vector: Array, diagonal: Array, cross: Array, outer: Array) -> Array:
    """Return diagonal*1 + cross*[v] + outer*v v^T, shape (3, 3, T)."""
    matrix = np.asarray(outer * vector[:, None] * vector[None])
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        matrix[i, i] += diagonal
        matrix[k, j] += cross * vector[i]
        matrix[j, k] -= cross * vector[i]
    return matrix


def compute_rotation(vector: Array) -> Array:
    """Return the rotation matrices (3, 3, T) of vectors (3, T), radians (Rodrigues)."""
    first, second, _ = _coefficients(vector)
    length2 = np.einsum("it,it->t", vector, vector)
    return _combine(vector, 1.0 - second * length2, first, second)


def compute_slope(vector: Array) -> Array:
    """Return by which small turn a small change of the vector shows, shape (3, 3, T).

    Column k is the turn, a vector in the parent's axes, for a change of component k.
    """
    first, second, third = _coefficients(vector)
    return _combine(vector, first, second, third)


def compute_vectors(matrix: Array) -> Array:
    """Return vectors (T, 3) of rotation matrices (T, 3, 3), without jumps from one to the next.

    At least half of them are shorter than half a turn. The matrices must hold no NaN.
    """
    quaternion = _quaternions(matrix)
    agree = np.sign(np.einsum("ti,ti->t", quaternion[1:], quaternion[:-1]))
    sign = np.cumprod(np.concatenate([[1.0], np.where(agree == 0, 1.0, agree)]))
    quaternion *= sign[:, None]
    if np.median(quaternion[:, 0]) < 0:
        quaternion = -quaternion
    length = np.linalg.norm(quaternion[:, 1:], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(length, quaternion[:, :1])
    share = np.divide(angle, length, out=np.full_like(angle, 2.0), where=length > SMALL)
    return np.asarray(share * quaternion[:, 1:])


def _quaternions(matrix: Array) -> Array:
    """Return unit quaternions (T, 4), real part first."""
    m = matrix
    # The four ways to start from one component; the largest loses no digits.
    trace = np.stack(
        [
            1.0 + m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2],
            1.0 + m[:, 0, 0] - m[:, 1, 1] - m[:, 2, 2],
            1.0 - m[:, 0, 0] + m[:, 1, 1] - m[:, 2, 2],
            1.0 - m[:, 0, 0] - m[:, 1, 1] + m[:, 2, 2],
        ]
    )
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    d, e, f = m[:, 1, 0] + m[:, 0, 1], m[:, 2, 0] + m[:, 0, 2], m[:, 2, 1] + m[:, 1, 2]
    rows = np.array(
        [[trace[0], a, b, c], [a, trace[1], d, e], [b, d, trace[2], f], [c, e, f, trace[3]]]
    )
    chosen = rows[trace.argmax(axis=0), :, np.arange(len(m))]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=1, keepdims=True))
