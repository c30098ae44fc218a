"""The colour of each particle, rendered from nearby."""

import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.types import Particles, Rays

STAND_OFF = 0.05


@torch.inference_mode()
def particle_colors(renderer: AbstractRenderer, particles: Particles, viewpoint: Float[Tensor, " 3"]) -> NDArray:
    """Return uint8 sRGB colours (particle, 3) of the particles that are there (batch axis of 1).

    Each particle is looked at from ``STAND_OFF`` metres in front of it, in the direction from ``viewpoint`` (metres,
    world) to the particle: what stands farther in front does not hide it, and the colour is that of the scene where the
    particle is. Rays start ``near`` before that point, because renderers see nothing closer than their near bound.
    """
    # Paper: "applying the VPD renderer to each particle location"; the direction is ours.
    positions = particles.positions
    offset = positions - viewpoint.to(positions)
    directions = offset / offset.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    near = float(getattr(renderer, "near", 0.0))
    origins = positions - (near + STAND_OFF) * directions
    rgbs = renderer(particles, Rays(origins, directions), None).rgbs[0][particles.mask[0]]
    return (rgbs.nan_to_num(0.0).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
