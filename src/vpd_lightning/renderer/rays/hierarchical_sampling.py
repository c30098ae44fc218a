"""Where the two tiers of a volume renderer look along each ray, and how samples become one colour per ray."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.geometry.ray_sampling import even_quantiles, sample_pdf, stratified_samples
from vpd_lightning.renderer.field.precision import full_precision
from vpd_lightning.renderer.rays.volumetric import ray_weights
from vpd_lightning.types import RenderedRays


def coarse_samples(
    origins: Float[Tensor, "batch ray 3"],
    near: float,
    far: float,
    num_samples: int,
    noise: Float[Tensor, "batch ray coarse"] | None,
) -> Float[Tensor, "batch ray coarse"]:
    """Return ascending distances (metres), one per stratum; see ``stratified_samples``."""
    batch_size, num_rays = origins.shape[:2]
    flat = None if noise is None else noise.flatten(0, 1)
    t = stratified_samples(near, far, num_samples, batch_size * num_rays, flat)
    return t.to(origins).view(batch_size, num_rays, num_samples)


def fine_samples(
    t_coarse: Float[Tensor, "batch ray coarse"],
    weights: Float[Tensor, "batch ray coarse"],
    num_samples: int,
    quantiles: Float[Tensor, "batch ray fine"] | None,
) -> Float[Tensor, "batch ray fine"]:
    """Return distances (metres) drawn from the coarse tier's ``weights``; at even quantiles without ``quantiles``."""
    # As jaxnerf: bins between the midpoints of coarse samples, so the first and last weight have none.
    middles = ((t_coarse[..., 1:] + t_coarse[..., :-1]) / 2).flatten(0, 1)
    u = even_quantiles(num_samples, len(middles), middles.device) if quantiles is None else quantiles.flatten(0, 1)
    t_fine = sample_pdf(middles, weights[..., 1:-1].flatten(0, 1), u)
    return t_fine.view(*t_coarse.shape[:-1], num_samples)


def points_along(
    origins: Float[Tensor, "batch ray 3"],
    directions: Float[Tensor, "batch ray 3"],
    t: Float[Tensor, "batch ray sample"],
) -> Float[Tensor, "batch ray sample 3"]:
    """Return the points (metres, world) at distances ``t`` along the rays."""
    with full_precision(t):
        return origins[..., None, :] + t[..., None] * directions[..., None, :]


def interval_ends(t: Float[Tensor, "batch ray sample"], far: float) -> Float[Tensor, "batch ray sample"]:
    """Each sample stands for the way to the next one, the last for the way to the far plane."""
    return torch.cat([t[..., 1:], torch.full_like(t[..., :1], far)], dim=-1)


def closed_color(
    weights: Float[Tensor, "batch ray sample"],
    transmittance: Float[Tensor, "batch ray"],
    rgbs: Float[Tensor, "batch ray sample 3"],
) -> Float[Tensor, "batch ray 3"]:
    """Return the colour of each ray, with the left-over light going to the last sample's colour."""
    with full_precision(weights):
        return (weights[..., None] * rgbs).sum(dim=-2) + transmittance[..., None] * rgbs[..., -1, :]


def composited_rays(
    sigmas: Float[Tensor, "batch ray sample"],
    rgbs: Float[Tensor, "batch ray sample 3"],
    t: Float[Tensor, "batch ray sample"],
    far: float,
    coarse_rgbs: Float[Tensor, "batch ray 3"] | None,
) -> RenderedRays:
    """Return colour, expected distance (metres) and opacity of rays whose samples at ascending ``t`` are known."""
    weights, transmittance = ray_weights(sigmas, t, interval_ends(t, far))
    with full_precision(t):
        depths = (weights * t).sum(dim=-1) + transmittance * t[..., -1]
    return RenderedRays(closed_color(weights, transmittance, rgbs), depths, 1.0 - transmittance, coarse_rgbs)
