"""Appearance changes caused by motion: a surface turns in the light, a shadow moves over what stands still."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn


class MovingShading(nn.Module):
    """Change of a moving particle's features from its first normal to its present one; zero while nothing turned."""

    def __init__(self, *, feature_dim: int, hidden_dim: int):
        super().__init__()
        self.network = nn.Sequential(
            nn.Linear(feature_dim + 3, hidden_dim), nn.SiLU(), nn.Linear(hidden_dim, feature_dim, bias=False)
        )

    def forward(
        self,
        features: Float[Tensor, "batch particle feature"],
        first_normals: Float[Tensor, "batch particle 3"],
        normals: Float[Tensor, "batch particle 3"],
    ) -> Float[Tensor, "batch particle feature"]:
        """Return the change to add to the first features."""
        now = self.network(torch.cat([features, normals], dim=-1))
        return now - self.network(torch.cat([features, first_normals], dim=-1))


class StaticShading(nn.Module):
    """Change of a static particle's features from where the moving ones were first to where they are now.

    Each static particle sees the moving ones through Gaussian kernels of several scales (metres): their density and
    their mean offset. It can cast a shadow, and take away the one in the first image.
    """

    num_casters = 48  # enough to outline a body; the cost is static particles x casters

    def __init__(self, *, feature_dim: int, hidden_dim: int, scales: Sequence[float]):
        super().__init__()
        if min(scales) <= 0:
            raise ValueError(f"shadow scales must be positive, got {list(scales)}")
        self.scales = list(scales)
        self.network = nn.Sequential(
            nn.Linear(feature_dim + 4 * len(self.scales), hidden_dim),
            nn.SiLU(),
            nn.Linear(hidden_dim, feature_dim, bias=False),
        )

    def forward(
        self,
        features: Float[Tensor, "batch particle feature"],
        first_surroundings: Float[Tensor, "batch particle channel"],
        surroundings: Float[Tensor, "batch particle channel"],
    ) -> Float[Tensor, "batch particle feature"]:
        """Return the change to add to the first features, from the surroundings then and now."""
        now = self.network(torch.cat([features, surroundings], dim=-1))
        return now - self.network(torch.cat([features, first_surroundings], dim=-1))

    def surroundings(
        self,
        positions: Float[Tensor, "batch particle 3"],
        moving: Float[Tensor, "batch moving 3"],
        mask: Bool[Tensor, "batch moving"],
    ) -> Float[Tensor, "batch particle channel"]:
        """Return density and mean offset (over the scale) of the moving particles around each static one."""
        moving, mask = moving[:, : self.num_casters], mask[:, : self.num_casters]
        offsets = moving[:, None] - positions[:, :, None]  # batch particle caster 3
        square = offsets.square().sum(dim=-1)
        share = mask / mask.sum(dim=1, keepdim=True).clamp(min=1)
        seen = []
        for scale in self.scales:
            kernel = torch.exp(square * (-0.5 / scale**2)) * share[:, None]
            seen.append(kernel.sum(dim=-1, keepdim=True))
            seen.append((kernel[:, :, None] @ offsets).squeeze(2) / scale)
        return torch.cat(seen, dim=-1)
