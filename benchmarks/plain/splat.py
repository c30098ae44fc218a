"""The splat renderer's candidates by explicit differences to all particles."""

import torch
from torch import Tensor

from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.types import Particles


def splat_candidates(self: SplatRenderer, particles: Particles, origins: Tensor, directions: Tensor) -> Tensor:
    """Choose a ray's candidates from explicit differences to all particles by one big selection; -1 for none."""
    offsets = particles.positions[:, None] - origins[:, :, None]
    along = (offsets * directions[:, :, None]).sum(dim=-1)
    square = (offsets - along[..., None] * directions[:, :, None]).square().sum(dim=-1)
    square = square.masked_fill(~particles.mask[:, None] | (along < self.near), torch.inf)
    half_width = 0.5 * self.kernel_scales[-1]
    beside = (square - half_width**2).clamp(min=0)
    first = (along + 500 / half_width * beside).amin(dim=-1, keepdim=True)
    score = square + 0.04 * (along - first - 3 * self.layer_depth).clamp(min=0).square()
    best = score.topk(min(self.num_candidates, particles.num_particles), dim=-1, largest=False)
    return torch.where(best.values < torch.inf, best.indices, -1)
