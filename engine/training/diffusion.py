"""The noise of D3DP's diffusion: cosine schedule, 1000 steps (Shan et al. 2023)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["DiffusionSchedule"]


class DiffusionSchedule:
    """How much noise each step holds.

    Attributes
    ----------
    kept
        Shape (n_steps,): share of the signal's variance that is left.
    """

    n_steps = 1000
    offset = 0.008

    def __init__(self) -> None:
        time = torch.linspace(0, 1, self.n_steps + 1, dtype=torch.float64)
        curve = torch.cos((time + self.offset) / (1 + self.offset) * math.pi / 2) ** 2
        fall = (1 - curve[1:] / curve[:-1]).clamp(max=0.999)
        self.kept = torch.cumprod(1 - fall, dim=0)

    def add_noise(self, joints: Tensor, step: Tensor) -> Tensor:
        """Return joints (B, T, 17, 3) with the noise of a step (B,)."""
        kept = self.kept[step].to(joints.dtype).reshape(-1, 1, 1, 1)
        return kept.sqrt() * joints + (1 - kept).sqrt() * torch.randn_like(joints)
