from collections.abc import Callable

import pytest
import torch

from tests.renderer.small_renderer import assert_same, loss_of, rays_of
from vpd_lightning.errors import NonFiniteError
from vpd_lightning.geometry.ray_sampling import even_quantiles, sample_pdf
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.field.positional_encoding import positional_encoding
from vpd_lightning.renderer.field.radiance_field import RadianceField
from vpd_lightning.renderer.global_nerf import GlobalNeRFRenderer
from vpd_lightning.types import Particles, Rays, RenderedRays

SMALL = {
    "feature_dim": 5,
    "workspace_min": [-1.0, -2.0, -0.5],
    "workspace_max": [1.0, 1.0, 0.5],
    "near": 0.5,
    "far": 4.0,
    "num_coarse_samples": 8,
    "num_fine_samples": 12,
    "net_depth": 4,
    "net_width": 16,
    "skip_layer": 2,
    "net_width_condition": 8,
    "position_degree": 3,
    "view_degree": 2,
    "density_activation": "softplus",
    "ray_chunk_size": 1000,
    "checkpoint_chunks": False,
}
KEYS = RandomKeys(0, 3, [0, 1])


def renderer_of(seed: int = 0, **changes: object) -> GlobalNeRFRenderer:
    torch.manual_seed(seed)
    renderer = GlobalNeRFRenderer(**(SMALL | changes)).double()
    for field in (renderer.coarse, renderer.fine):
        torch.nn.init.normal_(field.density.weight)
    return renderer


def scene_of(seed: int = 0, count: int = 1) -> Particles:
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(2, count, 5, generator=generator, dtype=torch.float64)
    return Particles(torch.zeros(2, count, 3, dtype=torch.float64), torch.nn.functional.normalize(features, dim=-1))


def literal(field: RadianceField, points: torch.Tensor, scene: torch.Tensor, direction: torch.Tensor | None):
    """jaxnerf's network on the concatenation of the encoded place and the scene vector, for one scene and one ray."""
    places = (points - torch.tensor([0.0, -0.5, 0.0])) / torch.tensor([1.0, 1.5, 0.5])
    inputs = torch.cat([positional_encoding(places, 3), 5**0.5 * scene.expand(len(points), -1)], dim=-1)
    hidden = inputs
    for index, layer in enumerate(field.trunk):
        hidden = layer(hidden).relu()
        if index == 2:
            hidden = torch.cat([hidden, inputs], dim=-1)
    density = torch.nn.functional.softplus(field.density(hidden)[:, 0])
    if direction is None:
        return density, field.color(hidden).sigmoid()
    encoded = positional_encoding(direction, 2).expand(len(points), -1)
    hidden = torch.cat([field.bottleneck(hidden), encoded], dim=-1)
    return density, field.color(field.condition(hidden).relu()).sigmoid()


def literal_color(density: torch.Tensor, rgbs: torch.Tensor, t: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Volume rendering by a loop; what light is left takes the last colour."""
    light, color, weights = torch.tensor(1.0, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), []
    for index in range(len(t)):
        end = t[index + 1] if index + 1 < len(t) else torch.tensor(4.0)
        alpha = 1 - torch.exp(-density[index] * (end - t[index]))
        weights.append(light * alpha)
        color = color + light * alpha * rgbs[index]
        light = light * (1 - alpha)
    return color + light * rgbs[-1], torch.stack(weights)


def test_it_equals_nerf_with_the_scene_vector_concatenated_at_every_sample() -> None:
    renderer, particles, rays = renderer_of(), scene_of(), rays_of(count=3)
    got = renderer(particles, rays, None)
    for member in range(2):
        for ray in range(3):
            scene = particles.features[member, 0]
            origin, direction = rays.origins[member, ray], rays.directions[member, ray]
            t = torch.linspace(0.5, 4.0, 8, dtype=torch.float64)
            field = renderer.coarse
            coarse, weights = literal_color(*literal(field, origin + t[:, None] * direction, scene, None), t)
            middles = (t[1:] + t[:-1]) / 2
            fine = sample_pdf(middles[None], weights[None, 1:-1], even_quantiles(12, 1, torch.device("cpu")))[0]
            t = torch.cat([t, fine]).sort().values
            outputs = literal(renderer.fine, origin + t[:, None] * direction, scene, direction)
            # The sampler spreads single-precision quantiles; everything else differs by the order of sums.
            torch.testing.assert_close(got.coarse_rgbs[member, ray], coarse, rtol=1e-5, atol=1e-6)
            torch.testing.assert_close(got.rgbs[member, ray], literal_color(*outputs, t)[0], rtol=1e-5, atol=1e-6)


def test_parameter_counts_and_the_skip_at_full_size() -> None:
    size = {"feature_dim": 256, "net_depth": 8, "net_width": 256, "skip_layer": 4, "net_width_condition": 128}
    renderer = GlobalNeRFRenderer(**(SMALL | size | {"position_degree": 10, "view_degree": 4}))
    coarse, fine = (sum(p.numel() for p in part.parameters()) for part in (renderer.coarse, renderer.fine))
    assert (coarse, fine) == (625_156, 726_916)
    for field in (renderer.coarse, renderer.fine):
        # 63 numbers of the place and 256 of the scene; again behind the layer of index 4, and only there
        assert [layer.in_features for layer in field.trunk] == [319, 256, 256, 256, 256, 256 + 319, 256, 256]


def test_another_scene_gives_another_picture_and_the_same_scene_the_same() -> None:
    renderer, rays = renderer_of(), rays_of()
    first = renderer(scene_of(), rays, None).rgbs
    assert torch.equal(first, renderer(scene_of(), rays, None).rgbs)
    assert (first - renderer(scene_of(1), rays, None).rgbs).abs().max() > 1e-3


def test_of_several_particles_the_mean_feature_counts_and_positions_do_not() -> None:
    renderer, rays, many = renderer_of(), rays_of(), scene_of(count=4)
    mean = Particles(torch.full((2, 1, 3), 9.0, dtype=torch.float64), many.features.mean(dim=1, keepdim=True))
    assert_same(renderer(many, rays, None), renderer(mean, rays, None))


def test_places_outside_the_workspace_are_not_clamped() -> None:
    renderer = renderer_of()
    inside, far_off, farther = renderer._encoded(torch.tensor([[0.5, 0.0, 0.0], [3.0, 0.0, 0.0], [5.0, 0.0, 0.0]]))
    torch.testing.assert_close(torch.stack([inside, far_off, farther])[:, 0], torch.tensor([0.5, 3.0, 5.0]))
    assert not torch.allclose(far_off, farther)


@pytest.mark.parametrize("ray_chunk_size", [1, 3, 4, None])
def test_the_chunk_size_changes_nothing(ray_chunk_size: int | None) -> None:
    whole = renderer_of()(scene_of(), rays_of_seed(), KEYS)
    assert_same(whole, renderer_of(ray_chunk_size=ray_chunk_size)(scene_of(), rays_of_seed(), KEYS))


def rays_of_seed() -> Rays:
    torch.manual_seed(5)
    return rays_of()


@pytest.mark.parametrize("ray_chunk_size", [4, 1000])
def test_checkpointed_gradients_are_exact(ray_chunk_size: int) -> None:
    def gradients(renderer: GlobalNeRFRenderer) -> list[torch.Tensor]:
        particles, rays = scene_of(), rays_of_seed()
        particles.features.requires_grad_()
        loss = loss_of(renderer(particles, rays, KEYS))
        return list(torch.autograd.grad(loss, [particles.features, *renderer.parameters()]))

    plain = gradients(renderer_of())
    kept = gradients(renderer_of(ray_chunk_size=ray_chunk_size, checkpoint_chunks=True))
    for one, other in zip(plain, kept, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-10)


def test_gradients_reach_every_parameter_and_the_scene() -> None:
    renderer, particles = renderer_of(), scene_of()
    particles.features.requires_grad_()
    loss_of(renderer(particles, rays_of(), KEYS)).backward()
    for name, parameter in renderer.named_parameters():
        assert parameter.grad is not None and bool(parameter.grad.abs().sum() > 0), name
    assert bool(particles.features.grad.abs().sum() > 0)


def test_the_coarse_color_is_left_out_at_inference() -> None:
    renderer, particles, rays = renderer_of().eval(), scene_of(), rays_of()
    with torch.no_grad():
        without = renderer(particles, rays, None)
    assert without.coarse_rgbs is None
    torch.testing.assert_close(renderer(particles, rays, None).rgbs, without.rgbs, rtol=1e-9, atol=1e-10)


def test_randomness_comes_from_the_keys_alone() -> None:
    renderer, particles, rays = renderer_of(), scene_of(), rays_of()
    first = renderer(particles, rays, KEYS).rgbs
    torch.rand(1)
    assert torch.equal(first, renderer(particles, rays, KEYS).rgbs)
    assert not torch.equal(first, renderer(particles, rays, RandomKeys(0, 4, [0, 1])).rgbs)
    with pytest.raises(ValueError, match="one sample per member"):
        renderer(particles, rays, RandomKeys.fixed(3))


def test_a_scene_that_is_not_a_number_is_refused() -> None:
    particles = scene_of()
    particles.features[1, 0, 2] = torch.nan
    with pytest.raises(NonFiniteError, match="features"):
        renderer_of()(particles, rays_of(), None)


def test_places_and_light_stay_in_float32_under_autocast() -> None:
    def in_single(function: Callable[[Particles, Rays, None], RenderedRays]) -> RenderedRays:
        return function(scene_of().to(torch.float32), rays_of_seed().to(torch.float32), None)

    renderer = renderer_of().float()
    exact = in_single(renderer)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = in_single(renderer)
    assert rounded.rgbs.dtype == rounded.depths.dtype == torch.float32
    torch.testing.assert_close(rounded.rgbs, exact.rgbs, rtol=0, atol=0.1)  # two to three digits per product in bf16


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("near", 5.0),
        ("num_coarse_samples", 2),
        ("num_fine_samples", 0),
        ("feature_dim", 0),
        ("position_degree", -1),
        ("ray_chunk_size", 0),
        ("workspace_min", [1.0, -2.0, -0.5]),
        ("net_width_condition", 0),
    ],
)
def test_values_out_of_range_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        GlobalNeRFRenderer(**(SMALL | {name: value}))
