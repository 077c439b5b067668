"""The networks that lift points of a picture to three dimensions, at a small size.

`MHFormer` follows Li et al. (2022) and `MixSTE` (the denoiser of D3DP) Zhang et al. (2022) and
Shan et al. (2023); `ResidualMLP` (Martinez et al. 2017) and `TemporalConvolution` (after Pavllo et
al. 2019) are the baselines. All take points (B, T, 17, 3) (x, y, confidence) and give joints
(B, T, 17, 3). Shapes are fixed by T, as positions are parameters. Other than published, the last
layer gives the difference from `flat_joints`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

__all__ = ["MHFormer", "MixSTE", "ResidualMLP", "TemporalConvolution", "build_network"]

N_JOINTS = 17
N_IN = 3


def flat_joints(points: Tensor) -> Tensor:
    """Return the joints (B, T, 17, 3) as if all were as far away as the pelvis.

    What is left for a network to learn are depths and the errors of the points.
    """
    flat = points[..., :2] - points[:, :, :1, :2]
    return torch.cat([flat, torch.zeros_like(flat[..., :1])], dim=-1)


class Attention(nn.Module):
    """Scaled dot-product attention whose queries, keys and values may come from elsewhere."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value = (nn.Linear(dim, dim) for _ in range(3))
        self.out = nn.Linear(dim, dim)

    def forward(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        batch, length, dim = query.shape
        split = (batch, -1, self.heads, dim // self.heads)
        q = self.query(query).reshape(split).transpose(1, 2)
        k = self.key(key).reshape(split).transpose(1, 2)
        v = self.value(value).reshape(split).transpose(1, 2)
        mixed = nn.functional.scaled_dot_product_attention(q, k, v)
        return self.out(mixed.transpose(1, 2).reshape(batch, length, dim))


class MLP(nn.Module):
    """Two layers with GELU."""

    def __init__(self, dim: int, hidden: int, out: int | None = None, dropout: float = 0.1) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(dim, hidden),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(hidden, out or dim),
            nn.Dropout(dropout),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.layers(x)


class Block(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, dim: int, heads: int, hidden: int, dropout: float = 0.1) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.attention = Attention(dim, heads)
        self.mlp = MLP(dim, hidden, dropout=dropout)

    def forward(self, x: Tensor) -> Tensor:
        y = self.norm1(x)
        x = x + self.attention(y, y, y)
        return x + self.mlp(self.norm2(x))


class HypothesisMixing(nn.Module):
    """One layer over three hypotheses: attention within each or across them, then mixing."""

    def __init__(self, dim: int, heads: int, hidden: int, *, is_crossed: bool) -> None:
        super().__init__()
        self.is_crossed = is_crossed
        self.norms = nn.ModuleList(nn.LayerNorm(dim) for _ in range(9 if is_crossed else 3))
        self.attention = nn.ModuleList(Attention(dim, heads) for _ in range(3))
        self.norm = nn.LayerNorm(3 * dim)
        self.mlp = MLP(3 * dim, hidden)

    def forward(self, hypotheses: list[Tensor]) -> list[Tensor]:
        h = list(hypotheses)
        if self.is_crossed:
            # Queries and keys come from the other two, values from its own; one after another.
            for own, query, key in ((0, 1, 2), (1, 0, 2), (2, 0, 1)):
                a, b, c = self.norms[3 * own : 3 * own + 3]
                h[own] = h[own] + self.attention[own](a(h[query]), b(h[key]), c(h[own]))
        else:
            for i in range(3):
                y = self.norms[i](h[i])
                h[i] = h[i] + self.attention[i](y, y, y)
        joined = torch.cat(h, dim=2)
        joined = joined + self.mlp(self.norm(joined))
        return list(joined.chunk(3, dim=2))


class MHFormer(nn.Module):
    """Multi-hypothesis transformer: tokens are coordinates first, then frames."""

    def __init__(self, frames: int = 81, dim: int = 128, layers: int = 3, depth: int = 2) -> None:
        super().__init__()
        tokens = N_IN * N_JOINTS
        self.position = nn.Parameter(torch.zeros(3, 1, tokens, frames))
        # The trajectory is the embedding; its length must be a multiple of the heads.
        heads = 9 if frames % 9 == 0 else 1
        self.generators = nn.ModuleList(
            nn.Sequential(*(Block(frames, heads, 2 * frames) for _ in range(depth)))
            for _ in range(3)
        )
        self.norms = nn.ModuleList(nn.LayerNorm(frames) for _ in range(3))
        self.embeddings = nn.ModuleList(nn.Linear(tokens, dim) for _ in range(3))
        self.frame_position = nn.Parameter(torch.zeros(3, 1, frames, dim))
        self.mixers = nn.ModuleList(
            HypothesisMixing(dim, 8, 4 * dim, is_crossed=i == layers - 1) for i in range(layers)
        )
        self.norm = nn.LayerNorm(3 * dim)
        self.head = nn.Linear(3 * dim, 3 * N_JOINTS)

    def forward(self, points: Tensor) -> Tensor:
        """Return joints (B, T, 17, 3) of points of that shape."""
        batch, frames = points.shape[:2]
        trajectories = points.reshape(batch, frames, -1).transpose(1, 2)
        x, hypotheses = trajectories, []
        for i in range(3):
            x = x + self.generators[i](self.norms[i](x) + self.position[i])
            h = self.embeddings[i](x.transpose(1, 2))
            hypotheses.append(h + self.frame_position[i])
        for mixer in self.mixers:
            hypotheses = mixer(hypotheses)
        joints = self.head(self.norm(torch.cat(hypotheses, dim=2)))
        return flat_joints(points) + joints.reshape(batch, frames, N_JOINTS, 3)


class MixSTE(nn.Module):
    """D3DP's denoiser: alternating attention over joints and over frames, told the noise's step.

    Takes points and noisy joints, gives the joints without noise.
    """

    def __init__(self, frames: int = 81, dim: int = 64, depth: int = 4) -> None:
        super().__init__()
        self.dim = dim
        self.embedding = nn.Linear(N_IN + 3, dim)
        self.joint_position = nn.Parameter(torch.zeros(1, N_JOINTS, dim))
        self.frame_position = nn.Parameter(torch.zeros(1, frames, dim))
        self.step = nn.Sequential(nn.Linear(dim, 2 * dim), nn.GELU(), nn.Linear(2 * dim, dim))
        self.spatial = nn.ModuleList(Block(dim, 4, 2 * dim, 0.0) for _ in range(depth))
        self.temporal = nn.ModuleList(Block(dim, 4, 2 * dim, 0.0) for _ in range(depth))
        self.spatial_norm, self.temporal_norm = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.head = nn.Sequential(nn.LayerNorm(dim), nn.Linear(dim, 3))

    def forward(self, points: Tensor, noisy: Tensor, step: Tensor) -> Tensor:
        """Return joints (B, T, 17, 3) of points and noisy joints of that shape, at a step (B,)."""
        batch, frames = points.shape[:2]
        x = self.embedding(torch.cat([points, noisy], dim=-1))
        x = x + self.joint_position + self.step(self._encode(step))[:, None, None]
        for i, (spatial, temporal) in enumerate(zip(self.spatial, self.temporal, strict=True)):
            x = self.spatial_norm(spatial(x.reshape(batch * frames, N_JOINTS, self.dim)))
            x = x.reshape(batch, frames, N_JOINTS, self.dim).transpose(1, 2)
            x = x.reshape(batch * N_JOINTS, frames, self.dim)
            if i == 0:
                x = x + self.frame_position
            x = self.temporal_norm(temporal(x))
            x = x.reshape(batch, N_JOINTS, frames, self.dim).transpose(1, 2)
        return flat_joints(points) + self.head(x)

    def _encode(self, step: Tensor) -> Tensor:
        half = self.dim // 2
        rate = torch.exp(-math.log(10000.0) / (half - 1) * torch.arange(half, device=step.device))
        angle = step.float()[:, None] * rate[None]
        return torch.cat([angle.sin(), angle.cos()], dim=1)


class ResidualMLP(nn.Module):
    """Every frame by itself (Martinez et al. 2017)."""

    def __init__(self, dim: int = 512, blocks: int = 2) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Linear(N_IN * N_JOINTS, dim), nn.LayerNorm(dim), nn.ReLU())
        self.blocks = nn.ModuleList(
            nn.Sequential(
                *(
                    layer
                    for _ in range(2)
                    for layer in (
                        nn.Linear(dim, dim),
                        nn.LayerNorm(dim),
                        nn.ReLU(),
                        nn.Dropout(0.2),
                    )
                )
            )
            for _ in range(blocks)
        )
        self.head = nn.Linear(dim, 3 * N_JOINTS)

    def forward(self, points: Tensor) -> Tensor:
        """Return joints (B, T, 17, 3) of points of that shape."""
        x = self.first(points.flatten(2))
        for block in self.blocks:
            x = x + block(x)
        return flat_joints(points) + self.head(x).reshape(*points.shape[:2], N_JOINTS, 3)


class TemporalConvolution(nn.Module):
    """Dilated convolutions over 27 frames (after Pavllo et al. 2019), same length in and out."""

    def __init__(self, dim: int = 256) -> None:
        super().__init__()
        self.first = nn.Conv1d(N_IN * N_JOINTS, dim, 3, padding=1)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.ReLU(),
                nn.Conv1d(dim, dim, 3, padding=d, dilation=d),
                nn.ReLU(),
                nn.Dropout(0.2),
                nn.Conv1d(dim, dim, 1),
            )
            for d in (3, 9)
        )
        self.head = nn.Conv1d(dim, 3 * N_JOINTS, 1)

    def forward(self, points: Tensor) -> Tensor:
        """Return joints (B, T, 17, 3) of points of that shape."""
        x = self.first(points.flatten(2).transpose(1, 2))
        for block in self.blocks:
            x = x + block(x)
        joints = self.head(x).transpose(1, 2)
        return flat_joints(points) + joints.reshape(*points.shape[:2], N_JOINTS, 3)


def build_network(name: str, frames: int, dim: int) -> nn.Module:
    """Make the network `mhformer`, `mixste`, `mlp` or `tcn`."""
    if name == "mhformer":
        return MHFormer(frames, dim)
    if name == "mixste":
        return MixSTE(frames, dim)
    if name == "mlp":
        return ResidualMLP(dim)
    if name == "tcn":
        return TemporalConvolution(dim)
    raise ValueError(f"Unknown network {name!r}; known: mhformer, mixste, mlp, tcn.")
