"""Which of the moving particles cast shadows: a bounded number of them, spread over all."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.types import Driven, Occluders, Particles

MOST_OCCLUDERS = 2048
"""That an encoder keeps of what moved when it saw the scenery."""


def occluders_of(particles: Particles) -> Occluders:
    """Return what casts shadows, at most ``MOST_OCCLUDERS`` points (metres); evenly spread over their slots.

    Those are the particles' ``occluders`` where they have some, otherwise the moving ones and what is driven. Slots are
    in random order but after edits, where what was added comes last and casts shadows as well.
    """
    if particles.occluders is not None:
        return thinned(particles.occluders, MOST_OCCLUDERS)
    mask = particles.mask if particles.moving is None else particles.mask & particles.moving
    return thinned(with_driven(Occluders(particles.positions, mask), particles.driven), MOST_OCCLUDERS)


def with_driven(occluders: Occluders, driven: Driven | None) -> Occluders:
    """Return the points with those of what is driven behind them."""
    if driven is None:
        return occluders
    return Occluders(
        torch.cat([occluders.positions, driven.positions], dim=1), torch.cat([occluders.mask, driven.mask], dim=1)
    )


def thinned(occluders: Occluders, most: int) -> Occluders:
    """Return at most ``most`` of the points, evenly spread over their slots, without places for more."""
    positions, mask = occluders.positions, occluders.mask
    counts = mask.sum(dim=1)
    num = min(most, int(counts.max()) if mask.numel() else 0)
    ordinal = torch.arange(num, device=mask.device)
    ranks = torch.where(counts[:, None] > num, ordinal * counts[:, None] // max(num, 1), ordinal)
    index = torch.sort((~mask).to(torch.uint8), dim=1, stable=True).indices.gather(
        1, ranks.clamp(max=mask.shape[1] - 1)
    )
    places = torch.gather(positions, 1, index[..., None].expand(-1, -1, 3))
    there: Bool[Tensor, "batch occluder"] = torch.gather(mask, 1, index) & (ordinal < counts[:, None])
    kept: Float[Tensor, "batch occluder 3"] = torch.where(there[..., None], places, 0.0)
    return Occluders(kept, there)
