"""Which bodies fly: far from everything that they could touch."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_FADE = 0.6
"""Of the reach: up to there forces act fully."""
_BETWEEN_BODIES = 0.5
"""Of the reach: a body's foot is unseen and may be half a radius below its lowest particle; facing sides are seen."""


@torch.no_grad()
def flight(
    positions: Float[Tensor, "batch probe 3"],
    clearances: Float[Tensor, "batch probe"],
    mask: Bool[Tensor, "batch probe"],
    shares: Float[Tensor, "batch body probe"],
    centers: Float[Tensor, "batch body 3"],
    reach: float,
) -> Float[Tensor, "batch body 1"]:
    """Return 1 for bodies in free flight, 0 for those that are near something, and what lies between.

    Args:
        positions: particles that stand for the bodies (metres).
        clearances: their distances from static surfaces (metres).
        mask: which of them count.
        shares: of which body each is a part; every body's sum to one, or to zero where there is none.
        centers: of the bodies (metres).
        reach: distance from a static surface, in root mean square radii of the body, from which on it flies. From other
            bodies, taken for spheres of such radii, half of it.
    """
    there = shares.sum(dim=-1) > 0
    offsets = positions[:, None] - centers[:, :, None]
    radii = (shares * offsets.square().sum(dim=-1)).sum(dim=-1).sqrt().clamp(min=1e-9)
    belongs = mask[:, None] & (shares > 1e-3 * shares.amax(dim=-1, keepdim=True))
    lowest = clearances[:, None].expand_as(shares).masked_fill(~belongs, torch.inf).amin(dim=-1)
    between = (centers[:, :, None] - centers[:, None]).square().sum(dim=-1).sqrt() - radii[:, :, None] - radii[:, None]
    itself = torch.eye(len(between[0]), dtype=torch.bool, device=between.device)
    nearest = between.masked_fill(itself | ~there[:, None], torch.inf).amin(dim=-1)
    gap = torch.minimum(lowest, nearest / _BETWEEN_BODIES) / (reach * radii)
    return ((gap - _FADE) / (1 - _FADE)).clamp(0, 1)[..., None] * there[..., None]
