"""The bounds of max_radius, against what really changes."""

import math

import pytest
import torch

from tests.renderer.small_renderer import SMALL, rays_of, renderer_of, scene
from vpd_lightning.graph.neighbors import knn
from vpd_lightning.renderer import bounds
from vpd_lightning.renderer.features.point_features import annular_features
from vpd_lightning.renderer.field.radiance_field import RadianceField
from vpd_lightning.renderer.point_nerf import PointNeRFRenderer
from vpd_lightning.types import Particles

RADII, BANDWIDTHS, K = (0.0, 0.1, 0.3), (0.05, 0.1, 0.2), 5
NEAR, FAR = SMALL["near"], SMALL["far"]


def field_of(seed: int, **changes: object) -> RadianceField:
    torch.manual_seed(seed)
    settings = {"input_dim": 6, "net_depth": 6, "net_width": 16, "skip_layer": 2, "net_width_condition": 8}
    settings |= {"view_degree": 2, "density_activation": "relu", "initial_density": 0.3}
    field = RadianceField(**(settings | changes)).double()
    torch.nn.init.normal_(field.density.weight)
    torch.nn.init.normal_(field.density.bias, mean=1.0)
    return field


@pytest.mark.slow
def test_features_of_a_thousand_scenes_change_by_less_than_the_bound() -> None:
    closest = 0.0
    for seed in range(1000):
        generator = torch.Generator().manual_seed(seed)
        particles = Particles(
            torch.rand(12, 3, generator=generator, dtype=torch.float64),
            torch.randn(12, 2, generator=generator, dtype=torch.float64),
        )
        queries = torch.rand(8, 3, generator=generator, dtype=torch.float64)
        max_radius = 0.7 * float(torch.rand((), generator=generator))
        whole, cut = (
            annular_features(queries, particles, knn(particles.positions, queries, K, radius), RADII, BANDWIDTHS)
            for radius in (None, max_radius)
        )
        bound = bounds.feature_error_bound(max_radius, K, RADII, BANDWIDTHS, float(particles.features.abs().max()))
        errors = (whole - cut).abs().view(8, 3, 2).amax(dim=(0, 2)).tolist()
        assert all(error <= least for error, least in zip(errors, bound, strict=True))
        closest = max(closest, *(error / least for error, least in zip(errors, bound, strict=True)))
    assert closest > 0.1  # the bound is not far from what happens


def test_the_feature_bound_is_reached_by_the_worst_scene() -> None:
    """All neighbours just beyond the radius, all with the largest feature."""
    max_radius = 0.45
    directions = torch.nn.functional.normalize(torch.randn(K, 3, dtype=torch.float64), dim=-1)
    particles = Particles(directions * max_radius * (1 + 1e-9), torch.full((K, 1), 2.0, dtype=torch.float64))
    query = torch.zeros(1, 3, dtype=torch.float64)
    whole, cut = (
        annular_features(query, particles, knn(particles.positions, query, K, radius), RADII, BANDWIDTHS)
        for radius in (None, max_radius)
    )
    assert not bool(cut.any())
    bound = bounds.feature_error_bound(max_radius, K, RADII, BANDWIDTHS, 2.0)
    assert whole[0].tolist() == pytest.approx(bound, rel=1e-5)
    assert bounds.feature_error_bound(0.2, K, RADII, BANDWIDTHS, 2.0)[2] == 2.0 * K  # inside the widest annulus


@pytest.mark.parametrize("tolerance", [1e-9, 1e-3, 1.0, 30.0])
def test_the_radius_for_a_tolerance_keeps_it_and_is_the_smallest(tolerance: float) -> None:
    radius = bounds.radius_for(tolerance, K, RADII, BANDWIDTHS, 2.5)
    assert max(bounds.feature_error_bound(radius, K, RADII, BANDWIDTHS, 2.5)) <= tolerance * (1 + 1e-9)
    if radius > 0:
        assert max(bounds.feature_error_bound(radius * 0.99, K, RADII, BANDWIDTHS, 2.5)) > tolerance
    # The paper's table for MuJoCo: 16 neighbours, the widest kernel decides.
    paper = bounds.radius_for(1e-3, 16, (0.0, 0.05, 0.1, 0.5), (0.05, 0.05, 0.05, 0.5), 1.0)
    assert paper == pytest.approx(0.5 + 0.5 * math.sqrt(math.log(16e3)))
    with pytest.raises(ValueError, match="tolerance"):
        bounds.radius_for(0.0, K, RADII, BANDWIDTHS, 1.0)


@pytest.mark.parametrize("changes", [{}, {"view_degree": None}, {"density_activation": "softplus"}, {"net_depth": 1}])
def test_no_network_changes_faster_than_its_bound(changes: dict) -> None:
    steepest = 0.0
    for seed in range(30):
        field = field_of(seed, **changes)
        slope = bounds.field_lipschitz(field)
        features = torch.randn(1, 64, 6, dtype=torch.float64, requires_grad=True)
        directions = None if field.view_degree is None else torch.randn(1, 3, dtype=torch.float64)
        sigmas, rgbs = field(features, directions)
        for values, bound in ((sigmas, slope.density), *((rgbs[..., channel], slope.color) for channel in range(3))):
            (gradient,) = torch.autograd.grad(values.sum(), features, retain_graph=True)
            share = float(gradient.norm(dim=-1).max()) / bound
            assert share <= 1
            steepest = max(steepest, share)
    assert steepest > 0.02


def test_the_bound_of_a_network_without_bends_is_exact() -> None:
    """With all ReLUs open the density is linear, and one layer's weights along the worst direction reach the bound."""
    field = field_of(0, net_depth=1, net_width=1)
    torch.nn.init.constant_(field.trunk[0].bias, 100.0)
    torch.nn.init.constant_(field.density.weight, -3.0)
    torch.nn.init.constant_(field.density.bias, 1e4)
    worst = torch.nn.functional.normalize(field.trunk[0].weight, dim=1)[:, None]
    change = field(worst, torch.zeros(1, 3).double())[0] - field(-worst, torch.zeros(1, 3).double())[0]
    assert abs(float(change.detach())) / 2 == pytest.approx(bounds.field_lipschitz(field).density, rel=1e-9)


def test_errors_of_densities_and_colors_add_up_to_less_than_the_bound() -> None:
    """Random ones, and the worst: in one direction everywhere."""
    renderer = renderer_of()
    t = (torch.rand(1000, 1, 30, dtype=torch.float64) * (FAR - NEAR) + NEAR).sort(dim=-1).values
    sigmas = torch.rand_like(t) * torch.logspace(-2, 1, 1000, dtype=torch.float64)[:, None, None]
    rgbs = torch.rand(*t.shape, 3, dtype=torch.float64).round()  # the largest contrasts
    plain = renderer._composited(sigmas, rgbs, t)
    for density_error, color_error in ((0.1, 0.0), (0.0, 0.1), (0.02, 0.05), (10.0, 1.0)):
        bound = bounds.rendering_error(density_error, color_error, NEAR, FAR)
        for signs in (torch.ones_like(t), torch.rand_like(t) * 2 - 1, torch.sign(torch.randn_like(t))):
            off_sigmas = (sigmas + density_error * signs).clamp(min=0)
            off = renderer._composited(off_sigmas, (rgbs + color_error * signs[..., None]).clamp(0, 1), t)
            assert float((off.rgbs - plain.rgbs).abs().max()) <= bound.color
            assert float((off.depths - plain.depths).abs().max()) <= bound.depth
            assert float((off.opacities - plain.opacities).abs().max()) <= bound.opacity


def gentle(renderer: PointNeRFRenderer) -> PointNeRFRenderer:
    """With smaller weights the product of norms stays small enough to say something."""
    with torch.no_grad():
        renderer.fine.density.weight.mul_(0.1)
        for layer in renderer.fine.trunk:
            layer.weight.mul_(0.6)
    return renderer.eval()


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_pictures_of_a_thousand_scenes_change_by_less_than_the_bound(dtype: torch.dtype) -> None:
    """For given places of the samples."""
    shares, num_useful = [], 0
    for seed in range(20):
        particles, rays = scene(50, 20).to(dtype), rays_of(50, 3).to(dtype)
        t = (torch.rand(50, 3, 10, dtype=dtype) * (FAR - NEAR) + NEAR).sort(dim=-1).values
        kernels = SMALL["num_neighbors"], SMALL["kernel_radii"], SMALL["kernel_bandwidths"]
        radius = (0.9, 1.1, 1.3)[seed % 3]
        norm = bounds.cut_norm(bounds.feature_error_bound(radius, *kernels, 1.0), SMALL["feature_dim"])
        exact = gentle(renderer_of(seed).to(dtype))
        bounded = gentle(renderer_of(seed, max_radius=radius).to(dtype))
        with torch.no_grad():
            whole, some = exact.render_at(particles, rays, t), bounded.render_at(particles, rays, t)
        bound = bounds.feature_noise_error(exact.fine, norm, NEAR, FAR)
        rounding = 1e-12 if dtype == torch.float64 else 1e-5  # of colours near 1 and of distances up to 4
        assert float((whole.rgbs - some.rgbs).abs().max()) <= bound.color + rounding
        assert float((whole.depths - some.depths).abs().max()) <= bound.depth + rounding
        assert float((whole.opacities - some.opacities).abs().max()) <= bound.opacity + rounding
        if bound.color < 1:  # else the bound says nothing
            num_useful += 1
            shares.append(float((whole.rgbs - some.rgbs).abs().max()) / bound.color)
    # Something changed, by a few thousandths of the bound: products of norms are for the worst of all networks.
    assert num_useful >= 10 and max(shares) > 1e-3
