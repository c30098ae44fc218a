"""The paper's renderer at a size for tests, with scenes and rays to look at, all in float64."""

import torch

from vpd_lightning.renderer.point_nerf import PointNeRFRenderer
from vpd_lightning.types import Particles, Rays, RenderedRays

SMALL = {
    "feature_dim": 3,
    "num_neighbors": 4,
    "kernel_radii": (0.0, 0.3),
    "kernel_bandwidths": (0.2, 0.4),
    "near": 0.5,
    "far": 4.0,
    "num_coarse_samples": 8,
    "num_fine_samples": 12,
    "net_depth": 4,
    "net_width": 16,
    "skip_layer": 2,
    "net_width_condition": 8,
    "view_degree": 2,
    "density_activation": "softplus",
    "kernel_normalization": None,
    "normalization_epsilon": 1e-6,
    "feature_network": None,
    "neighbors_backend": "auto",
    "features_backend": "auto",
    "sort_particles": True,
    "reuse_coarse": True,
    "max_radius": None,
    "ray_chunk_size": 1000,
    "checkpoint_chunks": False,
}


def renderer_of(seed: int = 0, **changes: object) -> PointNeRFRenderer:
    torch.manual_seed(seed)
    renderer = PointNeRFRenderer(**(SMALL | changes)).double()
    for field in (renderer.coarse, renderer.fine):
        torch.nn.init.normal_(field.density.weight)
    return renderer


def scene(batch: int = 2, count: int = 50) -> Particles:
    return Particles(
        torch.rand(batch, count, 3, dtype=torch.float64) * 2 - 1, torch.rand(batch, count, 3, dtype=torch.float64)
    )


def rays_of(batch: int = 2, count: int = 7) -> Rays:
    origins = torch.nn.functional.normalize(torch.randn(batch, count, 3, dtype=torch.float64), dim=-1) * 2
    targets = torch.rand(batch, count, 3, dtype=torch.float64) - 0.5
    return Rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1))


def assert_same(first: RenderedRays, second: RenderedRays) -> None:
    # Matrix products of another size may be summed in another order.
    for name in ("rgbs", "depths", "opacities", "coarse_rgbs"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=1e-9, atol=1e-10)


def loss_of(rendered: RenderedRays) -> torch.Tensor:
    return rendered.rgbs.square().sum() + rendered.coarse_rgbs.square().sum() + rendered.depths.sum()


def gradients_of(renderer: PointNeRFRenderer, particles: Particles, rays: Rays, keys: object) -> list[torch.Tensor]:
    """Gradients of particles' positions and features, then of all parameters."""
    inputs = [particles.positions.clone().requires_grad_(), particles.features.clone().requires_grad_()]
    rendered = renderer(Particles(*inputs, particles.mask), rays, keys)
    return list(torch.autograd.grad(loss_of(rendered), [*inputs, *renderer.parameters()]))
