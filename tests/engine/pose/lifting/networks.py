"""Networks that need no training, to test what is around them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from engine.pose.lifting.network import LiftingNetwork


class FakeSession:
    """Answers as a function does."""

    def __init__(self, answer):
        self.answer = answer
        self.calls = 0

    def run(self, _names, feed):
        self.calls += 1
        return [np.asarray(self.answer(**feed), dtype=np.float32)]


def fake_network(answer, *, kind="lifter", n_frames=9, n_out=None, n_numbers=3, facts=None):
    """Return a network that answers as a function of `points` (and `noisy`, `step`)."""
    return LiftingNetwork(
        path=Path("fake.onnx"),
        sha256="0" * 64,
        kind=kind,
        n_frames=n_frames,
        n_out=n_out or n_frames,
        n_numbers=n_numbers,
        facts=facts or {},
        session=FakeSession(answer),
    )


def flat(points, **_):
    """Put every joint as far away as the pelvis."""
    joints = points[..., :2] - points[:, :, :1, :2]
    return np.concatenate([joints, np.zeros_like(joints[..., :1])], axis=-1)


def random_answer(seed, n_frames=9, n_numbers=3):
    """Return a function with no symmetry at all: every output depends on every input."""
    rng = np.random.default_rng(seed)
    size = n_frames * 17 * n_numbers
    first = rng.normal(0, size**-0.5, (size, 24))
    last = rng.normal(0, 0.2, (24, n_frames * 17 * 3))

    def answer(points, **_):
        hidden = np.tanh(points.reshape(len(points), -1) @ first)
        return (hidden @ last).reshape(len(points), n_frames, 17, 3)

    return answer
