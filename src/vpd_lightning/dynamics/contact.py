"""Where moving particles are in relation to what stands still: signed distance to the nearest static surface."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Contacts:
    """For each probe: signed distance (metres, positive outside), surface normal, and lateral offset (metres)."""

    distances: Float[Tensor, "batch probe"]
    normals: Float[Tensor, "batch probe 3"]
    lateral: Float[Tensor, "batch probe"]


def nearest_static_contacts(
    probes: Float[Tensor, "batch probe 3"],
    static_positions: Float[Tensor, "batch particle 3"],
    static_normals: Float[Tensor, "batch particle 3"],
    static_mask: Bool[Tensor, "batch particle"],
    far: float,
) -> Contacts:
    """Measure each probe against the tangent plane of its nearest static particle.

    The point-to-plane distance is exact on flat surfaces however sparse the particles are. Without any static
    particle, or beyond ``far`` metres, the distance is ``far`` and the normal zero: no contact.
    """
    with torch.no_grad():
        square = (probes[:, :, None] - static_positions[:, None]).square().sum(dim=-1)
        nearest_square, index = square.masked_fill(~static_mask[:, None], float("inf")).min(dim=-1)
    batch = torch.arange(len(probes), device=probes.device)[:, None]
    normals = static_normals[batch, index]
    offsets = probes - static_positions[batch, index]
    distances = (offsets * normals).sum(dim=-1)
    lateral = (offsets - distances[..., None] * normals).square().sum(dim=-1).clamp(min=1e-12).sqrt()
    known = (normals.square().sum(dim=-1) > 0.5) & torch.isfinite(nearest_square) & (nearest_square < far**2)
    return Contacts(
        distances=torch.where(known, distances, torch.full_like(distances, far)),
        normals=normals * known[..., None],
        lateral=torch.where(known, lateral, torch.full_like(lateral, far)),
    )
