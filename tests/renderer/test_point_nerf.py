from collections.abc import Callable

import pytest
import torch

from tests.renderer.small_renderer import SMALL, assert_same, gradients_of, loss_of, rays_of, renderer_of, scene
from vpd_lightning.errors import NonFiniteError
from vpd_lightning.graph.neighbors import knn
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.features.point_features import annular_features
from vpd_lightning.renderer.point_nerf import PointNeRFRenderer
from vpd_lightning.types import Particles, Rays


@pytest.mark.parametrize("ray_chunk_size", [1, 3, 4, 14, None])
def test_the_chunk_size_changes_nothing(ray_chunk_size: int | None) -> None:
    particles, rays, keys = scene(), rays_of(), RandomKeys(0, 3, [0, 1])
    whole = renderer_of()(particles, rays, keys)
    assert_same(whole, renderer_of(ray_chunk_size=ray_chunk_size)(particles, rays, keys))


@pytest.mark.parametrize("ray_chunk_size", [4, 1000])
def test_checkpointed_gradients_are_exact(ray_chunk_size: int) -> None:
    particles, rays, keys = scene(), rays_of(), RandomKeys(0, 3, [0, 1])
    plain = gradients_of(renderer_of(), particles, rays, keys)
    kept = gradients_of(renderer_of(ray_chunk_size=ray_chunk_size, checkpoint_chunks=True), particles, rays, keys)
    for one, other in zip(plain, kept, strict=True):
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


def test_the_two_tiers_draw_independently() -> None:
    num_rays, num_samples = 300, 8
    renderer = renderer_of(
        feature_dim=1, num_neighbors=1, kernel_radii=(0.0,), kernel_bandwidths=(2.0,), density_activation="relu",
        num_coarse_samples=num_samples, num_fine_samples=num_samples,
    )  # fmt: skip
    for field in (renderer.coarse, renderer.fine):  # nothing stops light: fine samples are spread over the whole ray
        torch.nn.init.zeros_(field.density.weight)
        torch.nn.init.constant_(field.density.bias, -1.0)
    # One particle where the rays begin, whose feature tells how far away it is.
    camera = torch.zeros(1, 1, 3, dtype=torch.float64)
    directions = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(1, num_rays, 3)
    seen = {}

    def note(name: str) -> Callable[..., None]:
        return lambda module, inputs: seen.__setitem__(name, 2.0 * (-inputs[0].log()).sqrt().view(num_rays, -1))

    renderer.coarse.register_forward_pre_hook(note("coarse"))
    renderer.fine.register_forward_pre_hook(note("both"))
    particles = Particles(camera, torch.ones(1, 1, 1, dtype=torch.float64))
    renderer(particles, Rays(camera.expand_as(directions), directions), RandomKeys(0, 3, [0]))

    coarse = seen["coarse"].sum(dim=1)
    fine = seen["both"].sum(dim=1) - coarse
    assert seen["both"].shape == (num_rays, 2 * num_samples) and float(fine.std() / num_samples) > 0.2
    # Fine samples lie between coarse ones, which are a seventh of the ray apart, and so move by a seventh as much with
    # those as by their own draws. From the same numbers it would be nearly 1.
    assert abs(float(torch.corrcoef(torch.stack([coarse, fine]))[0, 1])) < 0.4


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
        ("features_backend", "faiss"),
        ("max_radius", -0.1),
        ("max_radius", float("nan")),
        ("kernel_bandwidths", (0.1,)),
    ],
)
def test_values_out_of_range_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        PointNeRFRenderer(**(SMALL | {name: value}))
