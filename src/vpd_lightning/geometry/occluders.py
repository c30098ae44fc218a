"""Which of the moving particles cast shadows: a fixed number of them, spread over all."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.types import Particles

_NUM_OCCLUDERS = 512
"""As many as outline a few bodies: with 128 the learned shadow of a tossed block lacked a quarter of its depth."""


def occluders_of(particles: Particles) -> tuple[Float[Tensor, "batch occluder 3"], Bool[Tensor, "batch occluder"]]:
    """Return places (metres) of what casts shadows, and which of them there are; evenly spread over their slots.

    Those are the particles' ``occluders`` where they have some, otherwise the moving ones. Slots are in random order
    but after edits, where what was added comes last and casts shadows as well.
    """
    positions, mask = particles.positions, particles.mask
    if particles.occluders is not None:
        positions, mask = particles.occluders.positions, particles.occluders.mask
    elif particles.moving is not None:
        mask = mask & particles.moving
    counts = mask.sum(dim=1)
    num = min(_NUM_OCCLUDERS, int(counts.max()) if mask.numel() else 0)
    ordinal = torch.arange(num, device=mask.device)
    ranks = torch.where(counts[:, None] > num, ordinal * counts[:, None] // max(num, 1), ordinal)
    index = torch.sort((~mask).to(torch.uint8), dim=1, stable=True).indices.gather(
        1, ranks.clamp(max=mask.shape[1] - 1)
    )
    places = torch.gather(positions, 1, index[..., None].expand(-1, -1, 3))
    there = torch.gather(mask, 1, index) & (ordinal < counts[:, None])
    return torch.where(there[..., None], places, 0.0), there
