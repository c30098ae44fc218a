"""For each ray, the particles that lie closest to it, where along the ray they are, and what a sample sees of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.renderer.features.neighbor_features import NeighborFeatures
from vpd_lightning.renderer.features.point_features import kernel_weights, safe_norm
from vpd_lightning.renderer.field.precision import at_least_float32, full_precision
from vpd_lightning.renderer.kernels.ray_search import Candidates, RaySearch, resolved_backend
from vpd_lightning.renderer.rays.ray_scores import BesideRay
from vpd_lightning.types import Particles, Rays


@dataclass(frozen=True)
class RayCandidates:
    """A few particles per ray in ray coordinates, with gradients to positions and features (metres)."""

    along: Float[Tensor, "batch ray candidate"]
    across: Float[Tensor, "batch ray candidate"]
    features: Float[Tensor, "batch ray candidate feature"]
    mask: Bool[Tensor, "batch ray candidate"]
    offsets: Float[Tensor, "batch ray candidate 3"]  # from the ray's origin


class CandidateTable:
    """The particles of a batch, prepared once, from which chunks of rays take their candidates."""

    def __init__(self, particles: Particles, backend: str) -> None:
        """Prepare the search and one table of positions and features.

        Raises:
            NonFiniteError: when a valid particle is not finite.
            ValueError: when the backend is unknown.
        """
        with full_precision(particles.positions):
            positions = at_least_float32(particles.positions)
            self.search = RaySearch(positions, particles.mask, backend)
            self.num_particles = particles.num_particles
            features = at_least_float32(particles.features).to(positions.dtype)
            self.rows = torch.cat([positions, features], dim=-1).flatten(0, 1)
            if self.num_particles == 0:
                self.rows = self.rows.new_zeros(1, self.rows.shape[1])

    def closest(self, rays: Rays, num_candidates: int, near: float, far: float) -> Candidates:
        """Return the ``num_candidates`` valid particles nearest to each ray among those between ``near`` and ``far``.

        Rays with fewer such particles have the rest masked.

        Raises:
            NonFiniteError: when a ray is not finite.
        """
        origins, directions = at_least_float32(rays.origins), at_least_float32(rays.directions)
        return self.search.closest(origins, directions, num_candidates, BesideRay(near, far))

    def seen_from(self, rays: Rays, found: Candidates) -> RayCandidates:
        """Return where candidates are as seen from their rays: differences, whatever the backend that chose them."""
        with full_precision(rays.origins):
            origins = at_least_float32(rays.origins).to(self.rows.dtype)[:, :, None]
            directions = at_least_float32(rays.directions).to(self.rows.dtype)[:, :, None]
            index = found.index
            if len(index) > 1:
                index = index + self.num_particles * torch.arange(len(index), device=index.device)[:, None, None]
            gathered = self.rows.index_select(0, index.reshape(-1)).view(*index.shape, self.rows.shape[1])
            offset = gathered[..., :3] - origins
            along = (offset * directions).sum(dim=-1)
            across = safe_norm(offset - along[..., None] * directions)
            return RayCandidates(along, across, gathered[..., 3:], found.mask, offset)


def ray_features(
    candidates: RayCandidates,
    t: Float[Tensor, "batch ray sample"],
    num_neighbors: int,
    kernel_radii: Sequence[float],
    kernel_bandwidths: Sequence[float],
    backend: str,
) -> Float[Tensor, "batch ray sample kernel_feature"]:
    """Return annular features of samples at ``t`` from the ``num_neighbors`` nearest candidates of their ray.

    The same sums as ``annular_features``. The distance is taken in ray coordinates,
    ``sqrt(across^2 + (t - along)^2)``, so that candidates are gathered once per ray and not once per sample.
    Backend ``numba`` is for float32 and for ``t`` without gradient; else, the sums are the plain ones.
    """
    tensors = (candidates.along, candidates.across, candidates.features, candidates.mask, t)
    is_compiled = resolved_backend(backend, t.device) == "numba" and not t.requires_grad
    if is_compiled and all(tensor.dtype in (torch.float32, torch.bool) for tensor in tensors):
        from vpd_lightning.renderer.kernels.ray_features_numba import RayFeatures

        flat = [tensor.flatten(0, 1) for tensor in tensors]
        return RayFeatures.apply(*flat, num_neighbors, kernel_radii, kernel_bandwidths).unflatten(0, t.shape[:2])
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


def ray_neighbor_features(
    candidates: RayCandidates,
    t: Float[Tensor, "batch ray sample"],
    directions: Float[Tensor, "batch ray 3"],
    num_neighbors: int,
    variant: NeighborFeatures,
) -> Float[Tensor, "batch ray sample kernel_feature"]:
    """Return other features than the plain ones, of the same neighbours as ``ray_features`` takes."""
    with full_precision(t):
        behind = (t[..., None] - candidates.along[..., None, :]).detach()
        squared = candidates.across.detach().square()[..., None, :] + behind.square()
        squared = squared.masked_fill(~candidates.mask[..., None, :], torch.inf)
        nearest, index = squared.topk(min(num_neighbors, squared.shape[-1]), dim=-1, largest=False)
        num_candidates = candidates.along.shape[-1]
        rays = torch.arange(len(index.flatten(0, 1)), device=t.device).view(*t.shape[:2], 1, 1)
        row = (rays * num_candidates + index).flatten(0, 2)
        offsets = candidates.offsets.flatten(0, 2).index_select(0, row.flatten()).view(*row.shape, 3)
        latents = candidates.features.flatten(0, 2).index_select(0, row.flatten()).unflatten(0, row.shape)
        along = (t[..., None] * directions.to(t.dtype)[:, :, None]).flatten(0, 2)
        offsets = along[:, None] - offsets
    found = variant(offsets, latents, torch.isfinite(nearest).flatten(0, 2))
    return found.unflatten(0, t.shape)


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
