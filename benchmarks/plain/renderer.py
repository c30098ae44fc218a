"""The paper's renderer written plainly: neighbours gathered for each sample, kernels summed by ``einsum``, no reuse."""

import torch
from torch import Tensor

from benchmarks.plain.neighbors import nearest
from vpd_lightning.geometry.ray_sampling import even_quantiles, sample_pdf, stratified_samples
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.field.positional_encoding import positional_encoding
from vpd_lightning.renderer.field.radiance_field import RadianceField
from vpd_lightning.renderer.point_nerf import PointNeRFRenderer
from vpd_lightning.renderer.rays.chunked_rays import uniform_draws
from vpd_lightning.types import Particles, Rays, RenderedRays


def render(
    model: PointNeRFRenderer, particles: Particles, rays: Rays, keys: RandomKeys | None, ray_chunk_size: int = 1 << 30
) -> RenderedRays:
    """Render from the weights and the random draws of ``model``; the fine tier evaluates all its samples anew.

    ``ray_chunk_size`` is for whole pictures, which dense products of all rays at once would not let into memory.
    """
    batch_size, num_rays = rays.origins.shape[:2]
    coarse, fine = (num_rays, model.num_coarse_samples), (num_rays, model.num_fine_samples)
    noise = quantiles = None
    if keys is not None:
        noise = uniform_draws(keys, "render/stratified", batch_size, coarse, rays.origins)
        quantiles = uniform_draws(keys, "render/importance", batch_size, fine, rays.origins)
    outputs = []
    for member in range(batch_size):
        mask = particles.mask[member]
        positions, features = particles.positions[member][mask], particles.features[member][mask]
        parts = []
        for start in range(0, num_rays, ray_chunk_size):
            some = slice(start, start + ray_chunk_size)
            draws = (None if d is None else d[member, some] for d in (noise, quantiles))
            ray = rays.origins[member, some], rays.directions[member, some]
            parts.append(_member(model, positions, features, *ray, *draws))
        outputs.append([torch.cat(values) for values in zip(*parts, strict=True)])
    rgb, depth, opacity, coarse_rgb = (torch.stack(values) for values in zip(*outputs, strict=True))
    return RenderedRays(rgb, depth, opacity, coarse_rgb)


def _member(
    model: PointNeRFRenderer,
    positions: Tensor,
    features: Tensor,
    origins: Tensor,
    directions: Tensor,
    noise: Tensor | None,
    quantiles: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    num_rays = len(origins)
    t = stratified_samples(model.near, model.far, model.num_coarse_samples, num_rays, noise).to(origins)
    seen = _features(model, positions, features, origins, directions, t)
    coarse_rgb, _, _, weights = _composited(model, t, *_field(model.coarse, seen, None))

    middles = (t[:, 1:] + t[:, :-1]) / 2
    u = even_quantiles(model.num_fine_samples, num_rays, origins.device) if quantiles is None else quantiles
    more = sample_pdf(middles, weights[:, 1:-1].detach(), u)
    t = torch.cat([t, more], dim=-1).sort(dim=-1).values
    seen = _features(model, positions, features, origins, directions, t)
    rgb, depth, opacity, _ = _composited(model, t, *_field(model.fine, seen, directions))
    return rgb, depth, opacity, coarse_rgb


def _features(
    model: PointNeRFRenderer, positions: Tensor, features: Tensor, origins: Tensor, directions: Tensor, t: Tensor
) -> Tensor:
    """Concatenation over kernels of sum_i exp(-((|x - p_i| - r) / b)^2) z_i (paper section 3.3)."""
    points = (origins[:, None] + t[..., None] * directions[:, None]).flatten(0, 1)
    index, _ = nearest(positions, points, model.num_neighbors)
    offset = points[:, None] - positions[index]
    distance = torch.sqrt(offset.square().sum(dim=-1) + 1e-30)  # the gradient at zero distance is zero, not NaN
    radii, bandwidths = (
        torch.tensor(values, dtype=distance.dtype, device=distance.device)
        for values in (model.kernel_radii, model.kernel_bandwidths)
    )
    kernels = torch.exp(-(((distance[..., None] - radii) / bandwidths) ** 2))
    summed = torch.einsum("qnk,qnf->qkf", kernels, features[index])  # query, neighbour, kernel, feature
    return summed.flatten(1).unflatten(0, t.shape)


def _field(net: RadianceField, features: Tensor, directions: Tensor | None) -> tuple[Tensor, Tensor]:
    """Jaxnerf's network with its concatenations written down; the viewing direction is repeated for every sample."""
    hidden = features
    for layer in net.trunk:
        if layer.in_features != hidden.shape[-1]:  # the layer behind a skip connection
            hidden = torch.cat([hidden, features], dim=-1)
        hidden = torch.relu(layer(hidden))
    raw = net.density(hidden).squeeze(-1)
    density = torch.relu(raw) if net.density_activation == "relu" else torch.nn.functional.softplus(raw)
    if directions is not None:
        encoded = positional_encoding(directions, net.view_degree)
        hidden = torch.cat([net.bottleneck(hidden), encoded[:, None].expand(*hidden.shape[:-1], -1)], dim=-1)
    return density, torch.sigmoid(net.color(torch.relu(net.condition(hidden))))


def _composited(
    model: PointNeRFRenderer, t: Tensor, density: Tensor, colors: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return colour, depth, opacity and weights; left-over light takes the colour of the last sample."""
    ends = torch.cat([t[:, 1:], torch.full_like(t[:, :1], model.far)], dim=-1)
    depth = density * (ends - t)
    passed = torch.cumsum(torch.cat([torch.zeros_like(depth[:, :1]), depth], dim=-1), dim=-1)
    weights = torch.exp(-passed[:, :-1]) * (1 - torch.exp(-depth))
    left = torch.exp(-passed[:, -1])
    rgb = (weights[..., None] * colors).sum(dim=1) + left[:, None] * colors[:, -1]
    return rgb, (weights * t).sum(dim=1) + left * t[:, -1], 1 - left, weights
