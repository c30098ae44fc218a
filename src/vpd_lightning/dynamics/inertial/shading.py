"""Appearance changes caused by motion: a surface turns in the light, a shadow moves over what stands still."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vpd_lightning.geometry.decay import decay


class MovingShading(nn.Module):
    """What a moving particle's features gain from its normal.

    What is added to them is the change since its first normal: zero while nothing turned.
    """

    def __init__(self, *, feature_dim: int, hidden_dim: int):
        super().__init__()
        self.network = _network(feature_dim + 3, hidden_dim, feature_dim)

    def forward(
        self, features: Float[Tensor, "batch particle feature"], normals: Float[Tensor, "batch particle 3"]
    ) -> Float[Tensor, "batch particle feature"]:
        """Return the shade that a normal gives."""
        return self.network(torch.cat([features, normals], dim=-1))


class StaticShading(nn.Module):
    """What a static particle's features gain from where the moving ones are; they get the change since the first frame.

    Each static particle sees the moving ones through Gaussian kernels of several scales (metres): their density and
    their mean offset. It can cast a shadow, and take away the one in the first image.
    """

    num_casters = 48  # enough to outline a body; the cost is static particles x casters

    def __init__(self, *, feature_dim: int, hidden_dim: int, scales: Sequence[float]):
        super().__init__()
        if min(scales) <= 0:
            raise ValueError(f"shadow scales must be positive, got {list(scales)}")
        self.scales = list(scales)
        self.network = _network(feature_dim + 4 * len(self.scales), hidden_dim, feature_dim)

    def forward(
        self,
        features: Float[Tensor, "batch particle feature"],
        positions: Float[Tensor, "batch particle 3"],
        moving: Float[Tensor, "batch moving 3"],
        mask: Bool[Tensor, "batch moving"],
    ) -> Float[Tensor, "batch particle feature"]:
        """Return the shade that the moving particles give; positions are measured from near them, for their digits."""
        return self.network(torch.cat([features, self._surroundings(positions, moving, mask)], dim=-1))

    def _surroundings(self, positions: Tensor, moving: Tensor, mask: Tensor) -> Float[Tensor, "batch particle channel"]:
        """Return density and mean offset (over the scale) of the moving particles around each static one."""
        moving, mask = moving[:, : self.num_casters], mask[:, : self.num_casters]
        # Products of matrices in place of a difference for every pair: a third of the time.
        square = positions.square().sum(dim=-1, keepdim=True) + moving.square().sum(dim=-1)[:, None]
        square = torch.baddbmm(square, positions, moving.mT, alpha=-2).clamp(min=0)
        share = mask / mask.sum(dim=1, keepdim=True).clamp(min=1)
        # The fourth column counts.
        counted = nn.functional.pad(moving, (0, 1), value=1.0) * share[..., None]
        seen = []
        for scale in self.scales:
            total, density = (decay(square * (-0.5 / scale**2)) @ counted).split([3, 1], dim=-1)
            seen += [density, (total - density * positions) / scale]
        return torch.cat(seen, dim=-1)


def _network(input_dim: int, hidden_dim: int, output_dim: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(input_dim, hidden_dim), nn.SiLU(), nn.Linear(hidden_dim, output_dim, bias=False))
