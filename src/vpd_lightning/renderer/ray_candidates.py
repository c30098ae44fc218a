"""For each ray, the particles that lie closest to it, where along the ray they are, and what a sample sees of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.errors import NonFiniteError
from vpd_lightning.renderer.point_features import kernel_weights, safe_norm
from vpd_lightning.renderer.precision import at_least_float32, full_precision
from vpd_lightning.types import Particles, Rays

_PAIRS_PER_CHUNK = {"cpu": 1 << 20, "cuda": 1 << 26}


@dataclass(frozen=True)
class RayCandidates:
    """A few particles per ray in ray coordinates, with gradients to positions and features (metres)."""

    along: Float[Tensor, "batch ray candidate"]
    across: Float[Tensor, "batch ray candidate"]
    features: Float[Tensor, "batch ray candidate feature"]
    mask: Bool[Tensor, "batch ray candidate"]


def ray_candidates(particles: Particles, rays: Rays, num_candidates: int, near: float, far: float) -> RayCandidates:
    """Return the ``num_candidates`` valid particles nearest to each ray among those between ``near`` and ``far``.

    The choice uses matrix products (class "approximate": ranks of almost equal distances may swap); what is returned is
    computed again by differences. Rays with fewer such particles have the rest masked.

    Raises:
        NonFiniteError: when a valid particle or a ray is not finite.
    """
    with full_precision(rays.origins):
        positions = at_least_float32(particles.positions)
        origins = at_least_float32(rays.origins).to(positions.dtype)
        directions = at_least_float32(rays.directions).to(positions.dtype)
        batch_size, num_particles = positions.shape[:2]
        num_rays = origins.shape[1]
        index, mask = _closest(positions.detach(), particles.mask, origins, directions, num_candidates, near, far)
        flat = index + num_particles * torch.arange(batch_size, device=index.device)[:, None, None]
        table = torch.cat([positions, at_least_float32(particles.features).to(positions.dtype)], dim=-1).flatten(0, 1)
        if num_particles == 0:
            table = table.new_zeros(1, table.shape[1])
        gathered = table.index_select(0, flat.reshape(-1)).view(batch_size, num_rays, num_candidates, table.shape[1])
        offset = gathered[..., :3] - origins[:, :, None]
        along = (offset * directions[:, :, None]).sum(dim=-1)
        across = safe_norm(offset - along[..., None] * directions[:, :, None])
        return RayCandidates(along, across, gathered[..., 3:], mask)


def require_finite(*tensors: Tensor) -> None:
    """Raise NonFiniteError unless positions and rays are finite; one pass over each, no copy of a mask."""
    if not bool(torch.isfinite(sum(tensor.sum() for tensor in tensors))):  # type: ignore[arg-type]
        raise NonFiniteError(
            "Rendering: a particle position or a ray is NaN or infinite.\n"
            "A model that diverged, or damaged poses; lower the learning rate or check the data with vpd-data validate."
        )


@torch.no_grad()
def _closest(
    positions: Float[Tensor, "batch particle 3"],
    valid: Bool[Tensor, "batch particle"],
    origins: Float[Tensor, "batch ray 3"],
    directions: Float[Tensor, "batch ray 3"],
    num_candidates: int,
    near: float,
    far: float,
) -> tuple[Tensor, Bool[Tensor, "batch ray candidate"]]:
    positions = torch.where(valid[..., None], positions, 0.0)
    require_finite(positions, origins, directions)
    batch_size, num_particles = positions.shape[:2]
    num_rays = origins.shape[1]
    index = torch.zeros((batch_size, num_rays, num_candidates), dtype=torch.int64, device=positions.device)
    mask = torch.zeros_like(index, dtype=torch.bool)
    count = min(num_candidates, num_particles)
    if count == 0:
        return index, mask
    # |p - o|^2 - ((p - o) . d)^2, both as products of [p, |p|^2, 1]; centred, so that little cancels.
    center = positions.mean(dim=1, keepdim=True)
    p, o = positions - center, origins - center
    one = torch.ones_like(p[..., :1])
    lifted = torch.cat([p, p.square().sum(-1, keepdim=True), one], dim=-1).transpose(1, 2)
    distance = torch.cat([-2 * o, torch.ones_like(o[..., :1]), o.square().sum(-1, keepdim=True)], dim=-1)
    along_ray = -(o * directions).sum(-1, keepdim=True)
    depth = torch.cat([directions, torch.zeros_like(along_ray), along_ray], dim=-1)
    step = max(1, _PAIRS_PER_CHUNK.get(positions.device.type, 1 << 22) // (batch_size * num_particles))
    for start in range(0, num_rays, step):
        chunk = slice(start, start + step)
        along = depth[:, chunk] @ lifted
        squared = torch.baddbmm(along.square(), distance[:, chunk], lifted, beta=-1)
        squared.masked_fill_((along < near) | (along > far) | ~valid[:, None], torch.inf)
        best, index[:, chunk, :count] = squared.topk(count, dim=-1, largest=False, sorted=False)
        mask[:, chunk, :count] = best < torch.inf
    return index.masked_fill_(~mask, 0), mask


def ray_features(
    candidates: RayCandidates,
    t: Float[Tensor, "batch ray sample"],
    num_neighbors: int,
    kernel_radii: Sequence[float],
    kernel_bandwidths: Sequence[float],
) -> Float[Tensor, "batch ray sample kernel_feature"]:
    """Return annular features of samples at ``t`` from the ``num_neighbors`` nearest candidates of their ray.

    The same sums as ``annular_features``. The distance is taken in ray coordinates,
    ``sqrt(across^2 + (t - along)^2)``, so that candidates are gathered once per ray and not once per sample.
    """
    with full_precision(t):
        behind = t[..., None] - candidates.along[..., None, :]
        squared = candidates.across.square()[..., None, :] + behind.square()
        mask = candidates.mask[..., None, :].expand_as(squared)
        if num_neighbors < squared.shape[-1]:
            with torch.no_grad():
                masked = squared.masked_fill(~mask, torch.inf)
                mask = mask & (masked <= masked.kthvalue(num_neighbors, dim=-1, keepdim=True).values)
        is_positive = squared > 0
        distance = torch.where(is_positive, torch.where(is_positive, squared, 1.0).sqrt(), 0.0)
        weights = kernel_weights(distance, mask, kernel_radii, kernel_bandwidths)
        rows = weights.transpose(-1, -2).flatten(2, 3).flatten(0, 1)
        summed = torch.bmm(rows, candidates.features.flatten(0, 1))
        return summed.view(*t.shape, len(kernel_radii) * candidates.features.shape[-1])


@torch.no_grad()
def depth_hints(
    candidates: RayCandidates, quantiles: Float[Tensor, "batch ray sample"], footprint: float
) -> Float[Tensor, "batch ray sample"]:
    """Return distances (metres) at which a ray probably meets a surface, one for each quantile in [0, 1).

    Each candidate stops the share ``exp(-across^2 / (2 footprint^2))`` of the light that reaches it; the hint is the
    quantile of the depth at which light is stopped. A ray that runs by the edge of an object gets hints on the object
    and on what lies behind it. A ray without candidates gets hints of 0.
    """
    alphas = torch.exp(-candidates.across.square() / (2 * footprint**2)).clamp(max=0.99) * candidates.mask
    along = candidates.along.masked_fill(~candidates.mask, torch.inf)
    along, order = along.sort(dim=-1)
    alphas = alphas.gather(-1, order)
    reached = torch.nn.functional.pad(torch.log1p(-alphas).cumsum(dim=-1)[..., :-1], (1, 0)).exp()
    # A little weight for every candidate, for rays that pass all of them at a distance.
    stopped = alphas * reached + 1e-6 * candidates.mask.gather(-1, order)
    cumulated = stopped.cumsum(dim=-1)
    position = torch.searchsorted(cumulated, quantiles * cumulated[..., -1:], right=True)
    last = candidates.mask.sum(dim=-1, keepdim=True).sub(1).clamp(min=0)
    hints = along.gather(-1, position.minimum(last))
    return hints.masked_fill(~torch.isfinite(hints), 0.0)
