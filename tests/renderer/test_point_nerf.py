import pytest
import torch

from vpd_lightning.errors import NonFiniteError
from vpd_lightning.graph.neighbors import knn
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.point_features import annular_features
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
    "neighbors_backend": "auto",
    "ray_chunk_size": 1000,
    "checkpoint_chunks": False,
}


def renderer_of(**changes: object) -> PointNeRFRenderer:
    torch.manual_seed(0)
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


@pytest.mark.parametrize("ray_chunk_size", [1, 3, 4, 14])
def test_the_chunk_size_changes_nothing(ray_chunk_size: int) -> None:
    particles, rays, keys = scene(), rays_of(), RandomKeys(0, 3, [0, 1])
    whole = renderer_of()(particles, rays, keys)
    assert_same(whole, renderer_of(ray_chunk_size=ray_chunk_size)(particles, rays, keys))


@pytest.mark.parametrize("ray_chunk_size", [4, 1000])
def test_checkpointed_gradients_are_exact(ray_chunk_size: int) -> None:
    rays, keys = rays_of(), RandomKeys(0, 3, [0, 1])
    plain, particles = renderer_of(), scene()
    kept = renderer_of(ray_chunk_size=ray_chunk_size, checkpoint_chunks=True)
    again = Particles(particles.positions.clone(), particles.features.clone())
    gradients = []
    for renderer, given in ((plain, particles), (kept, again)):
        inputs = [given.positions.requires_grad_(), given.features.requires_grad_()]
        rendered = renderer(given, rays, keys)
        gradients.append(torch.autograd.grad(loss_of(rendered), [*inputs, *renderer.parameters()]))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-10)


def test_a_batch_equals_its_members() -> None:
    particles, rays, renderer = scene(), rays_of(), renderer_of()
    together = renderer(particles, rays, RandomKeys(0, 3, [5, 9]))
    for member, index in enumerate((5, 9)):
        part = slice(member, member + 1)
        alone = renderer(
            Particles(particles.positions[part], particles.features[part]),
            Rays(rays.origins[part], rays.directions[part]),
            RandomKeys(0, 3, [index]),
        )
        torch.testing.assert_close(together.rgbs[part], alone.rgbs, rtol=1e-9, atol=1e-10)


def test_moving_the_world_leaves_the_picture_alone() -> None:
    particles, rays, renderer = scene(), rays_of(), renderer_of()
    shift = torch.tensor([5.0, -3.0, 2.0], dtype=torch.float64)
    moved = renderer(
        Particles(particles.positions + shift, particles.features), Rays(rays.origins + shift, rays.directions), None
    )
    assert_same(renderer(particles, rays, None), moved)


def test_the_order_of_particles_does_not_matter() -> None:
    particles, rays, renderer = scene(), rays_of(), renderer_of()
    order = torch.randperm(50)
    shuffled = Particles(particles.positions[:, order], particles.features[:, order])
    assert_same(renderer(particles, rays, None), renderer(shuffled, rays, None))


def test_padding_is_never_seen() -> None:
    particles, rays, renderer = scene(), rays_of(), renderer_of()
    nothing = torch.full((2, 9, 3), torch.nan, dtype=torch.float64)
    padded = Particles(
        torch.cat([nothing, particles.positions], dim=1),
        torch.cat([nothing.nan_to_num(7.0), particles.features], dim=1),
        (torch.arange(59) >= 9).expand(2, 59),
    )
    assert_same(renderer(particles, rays, None), renderer(padded, rays, None))


@pytest.mark.parametrize("count", [0, 1, 3])
def test_scenes_with_fewer_particles_than_neighbors_are_rendered(count: int) -> None:
    rendered = renderer_of()(scene(count=count), rays_of(), RandomKeys.fixed(2))
    assert bool(torch.isfinite(rendered.rgbs).all()) and rendered.rgbs.shape == (2, 7, 3)
    loss_of(rendered).backward()


def test_left_over_light_takes_the_color_of_the_last_sample() -> None:
    renderer, particles, rays = renderer_of(density_activation="relu"), scene(), rays_of()
    for field in (renderer.coarse, renderer.fine):
        torch.nn.init.zeros_(field.density.weight)
        torch.nn.init.constant_(field.density.bias, -1.0)
    rendered = renderer(particles, rays, None)
    assert not bool(rendered.opacities.any())
    torch.testing.assert_close(rendered.depths, torch.full_like(rendered.depths, 4.0))
    points = rays.origins + 4.0 * rays.directions
    for member in range(2):
        one = Particles(particles.positions[member], particles.features[member])
        neighbors = knn(one.positions, points[member], 4)
        features = annular_features(points[member], one, neighbors, (0.0, 0.3), (0.2, 0.4))
        expected = renderer.fine(features[:, None], rays.directions[member])[1][:, 0]
        torch.testing.assert_close(rendered.rgbs[member], expected, rtol=1e-9, atol=1e-9)


def test_gradients_reach_every_parameter_and_particle() -> None:
    renderer, particles = renderer_of(), scene()
    particles.positions.requires_grad_()
    particles.features.requires_grad_()
    loss_of(renderer(particles, rays_of(), RandomKeys.fixed(2))).backward()
    for name, parameter in renderer.named_parameters():
        assert parameter.grad is not None and bool(parameter.grad.abs().sum() > 0), name
    assert bool(particles.positions.grad.abs().sum() > 0) and bool(particles.features.grad.abs().sum() > 0)


def test_the_coarse_color_is_left_out_at_inference() -> None:
    renderer, particles, rays = renderer_of().eval(), scene(), rays_of()
    with_gradients = renderer(particles, rays, None)
    with torch.no_grad():
        without = renderer(particles, rays, None)
    assert with_gradients.coarse_rgbs is not None and without.coarse_rgbs is None
    torch.testing.assert_close(with_gradients.rgbs, without.rgbs, rtol=1e-9, atol=1e-10)


def test_randomness_comes_from_the_keys_alone() -> None:
    renderer, particles, rays = renderer_of(), scene(), rays_of()
    keys = RandomKeys(1, 2, [3, 4])
    first = renderer(particles, rays, keys).rgbs
    torch.rand(1)
    assert torch.equal(first, renderer(particles, rays, keys).rgbs)
    assert not torch.equal(first, renderer(particles, rays, RandomKeys(1, 3, [3, 4])).rgbs)
    with pytest.raises(ValueError, match="one sample per member"):
        renderer(particles, rays, RandomKeys.fixed(3))


def test_a_particle_that_is_not_a_number_is_refused() -> None:
    particles = scene()
    particles.positions[1, 4, 2] = torch.nan
    with pytest.raises(NonFiniteError):
        renderer_of()(particles, rays_of(), None)


def test_geometry_stays_in_float32_under_autocast() -> None:
    renderer, particles, rays = renderer_of().float(), scene().to(torch.float32), rays_of().to(torch.float32)
    exact = renderer(particles, rays, None)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = renderer(particles, rays, None)
    assert rounded.rgbs.dtype == rounded.depths.dtype == torch.float32
    # Two to three digits per product in bf16.
    torch.testing.assert_close(rounded.rgbs, exact.rgbs, rtol=0, atol=0.1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("near", 5.0),
        ("num_coarse_samples", 2),
        ("num_neighbors", 0),
        ("ray_chunk_size", 0),
        ("neighbors_backend", "faiss"),
        ("kernel_bandwidths", (0.1,)),
    ],
)
def test_values_out_of_range_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        PointNeRFRenderer(**(SMALL | {name: value}))
