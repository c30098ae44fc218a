"""Which bodies fly: far from everything that they could touch."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.dynamics.inertial.contact_search import ContactPoints

_FADE = 0.6
"""Of the reach: up to there forces act fully."""
_BETWEEN_BODIES = 0.5
"""Of the reach: where a body's foot is unseen it is a guess; facing sides are seen."""


@torch.no_grad()
def flight(
    points: ContactPoints,
    clearances: Float[Tensor, "batch point"],
    centers: Float[Tensor, "batch body 3"],
    reach: float,
) -> Float[Tensor, "batch body 1"]:
    """Return 1 for bodies in free flight, 0 for those that are near something, and what lies between.

    Args:
        points: of the bodies, what is guessed of their hidden sides included: seen from above, the lowest particle of
            a ball is half a radius above its foot.
        clearances: their distances from static surfaces (metres).
        centers: of the bodies (metres).
        reach: distance from a static surface, in root mean square radii of the body, from which on it flies. From other
            bodies, taken for spheres of such radii, half of it.
    """
    belongs = points.members > 0
    there = belongs.any(dim=-1)
    squares = (points.positions[:, None] - centers[:, :, None]).square().sum(dim=-1) * belongs
    radii = (squares.sum(dim=-1) / belongs.sum(dim=-1).clamp(min=1)).sqrt().clamp(min=1e-9)
    lowest = clearances[:, None].expand_as(squares).masked_fill(~belongs, torch.inf).amin(dim=-1)
    between = (centers[:, :, None] - centers[:, None]).square().sum(dim=-1).sqrt() - radii[:, :, None] - radii[:, None]
    itself = torch.eye(len(between[0]), dtype=torch.bool, device=between.device)
    nearest = between.masked_fill(itself | ~there[:, None], torch.inf).amin(dim=-1)
    gap = torch.minimum(lowest, nearest / _BETWEEN_BODIES) / (reach * radii)
    return ((gap - _FADE) / (1 - _FADE)).clamp(0, 1)[..., None] * there[..., None]
