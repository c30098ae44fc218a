"""The candidates of the splat renderer by explicit differences to all particles."""

from torch import Tensor

from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.types import Particles


def splat_candidates(self: SplatRenderer, particles: Particles, origins: Tensor, directions: Tensor) -> Tensor:
    """Choose a ray's candidates from explicit differences to all particles, and sort them by one big selection."""
    offsets = particles.positions[:, None] - origins[:, :, None]
    along = (offsets * directions[:, :, None]).sum(dim=-1)
    square = (offsets - along[..., None] * directions[:, :, None]).square().sum(dim=-1)
    square = square + 1e6 * ~particles.mask[:, None]
    along = along + 1e4 * (self.near - along).clamp(min=0)
    beside = (square - (0.5 * self.kernel_scales[-1]) ** 2).clamp(min=0)
    first = (along + 1e4 * beside).amin(dim=-1, keepdim=True)
    score = square + 0.04 * (along - first - 3 * self.layer_depth).clamp(min=0).square()
    return score.topk(min(self.num_candidates, particles.num_particles), dim=-1, largest=False).indices
