from importlib.util import find_spec

import pytest
import torch

from vpd_lightning.errors import NonFiniteError
from vpd_lightning.graph.neighbors import knn
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.features.point_features import annular_features
from vpd_lightning.renderer.rays.ray_candidates import CandidateTable, RayCandidates, depth_hints, ray_features
from vpd_lightning.renderer.surface import SurfaceRenderer
from vpd_lightning.types import Particles, Rays, RenderedRays

RADII, BANDWIDTHS = (0.0, 0.3), (0.2, 0.4)
SMALL = {
    "feature_dim": 3,
    "num_neighbors": 4,
    "kernel_radii": RADII,
    "kernel_bandwidths": BANDWIDTHS,
    "near": 0.5,
    "far": 6.0,
    "num_samples": 8,
    "num_uniform_samples": 2,
    "num_candidates": 8,
    "footprint": None,
    "hint_spread": 1.5,
    "net_depth": 3,
    "net_width": 16,
    "skip_layer": 4,
    "net_width_condition": 8,
    "view_degree": 2,
    "density_activation": "softplus",
    "kernel_normalization": None,
    "normalization_epsilon": 1e-6,
    "feature_network": None,
    "background_width": 8,
    "ray_chunk_size": 1000,
    "checkpoint_chunks": False,
    "candidate_backend": "auto",
}
BACKENDS = ["torch", pytest.param("numba", marks=pytest.mark.skipif(not find_spec("numba"), reason="needs numba"))]


def renderer_of(**changes: object) -> SurfaceRenderer:
    torch.manual_seed(0)
    renderer = SurfaceRenderer(**(SMALL | changes)).double()
    torch.nn.init.normal_(renderer.field.density.weight)
    return renderer


def scene(batch: int = 2, count: int = 50) -> Particles:
    return Particles(
        torch.rand(batch, count, 3, dtype=torch.float64) * 2 - 1, torch.rand(batch, count, 3, dtype=torch.float64)
    )


def rays_of(batch: int = 2, count: int = 7) -> Rays:
    origins = torch.nn.functional.normalize(torch.randn(batch, count, 3, dtype=torch.float64), dim=-1) * 3
    targets = torch.rand(batch, count, 3, dtype=torch.float64) - 0.5
    return Rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1))


def ray_candidates(
    particles: Particles, rays: Rays, count: int, near: float, far: float, backend: str = "torch"
) -> RayCandidates:
    table = CandidateTable(particles, backend)
    return table.seen_from(rays, table.closest(rays, count, near, far))


def assert_same(first: RenderedRays, second: RenderedRays) -> None:
    # Matrix products of another size may be summed in another order.
    for name in ("rgbs", "depths", "opacities"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_candidates_are_the_particles_nearest_to_the_ray(backend: str) -> None:
    particles, rays = scene(), rays_of()
    found = ray_candidates(particles, rays, 8, 0.5, 6.0, backend)
    offset = particles.positions[:, None] - rays.origins[:, :, None]
    along = (offset * rays.directions[:, :, None]).sum(dim=-1)
    across = torch.linalg.cross(offset, rays.directions[:, :, None].expand_as(offset)).norm(dim=-1)
    across = across.masked_fill((along < 0.5) | (along > 6.0), torch.inf)
    expected, index = across.sort(dim=-1)
    torch.testing.assert_close(found.across.sort(dim=-1).values, expected[..., :8], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(
        found.along.sort(dim=-1).values, along.gather(-1, index[..., :8]).sort(dim=-1).values, rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_particles_behind_the_camera_are_no_candidates(backend: str) -> None:
    particles = Particles(torch.tensor([[[-1.0, 0, 0], [1.0, 0, 0]]]), torch.rand(1, 2, 3))
    rays = Rays(torch.zeros(1, 1, 3), torch.tensor([[[1.0, 0, 0]]]))
    found = ray_candidates(particles, rays, 2, 0.1, 5.0, backend)
    assert found.mask.sum() == 1 and found.along[found.mask].item() == pytest.approx(1.0)


def test_ray_features_equal_annular_features_of_the_same_particles() -> None:
    particles, rays = scene(batch=1, count=12), rays_of(batch=1)
    t = torch.linspace(2.0, 4.0, 5, dtype=torch.float64).expand(1, 7, 5)
    found = ray_candidates(particles, rays, 12, 0.0, 100.0)
    assert bool(found.mask.all())
    features = ray_features(found, t, 4, RADII, BANDWIDTHS, "torch")
    points = (rays.origins[0, :, None] + t[0, ..., None] * rays.directions[0, :, None]).flatten(0, 1)
    one = Particles(particles.positions[0], particles.features[0])
    expected = annular_features(points, one, knn(one.positions, points, 4), RADII, BANDWIDTHS)
    torch.testing.assert_close(features.flatten(0, 2), expected, rtol=1e-8, atol=1e-9)


@pytest.mark.skipif(not find_spec("numba"), reason="needs numba")
@pytest.mark.parametrize(("count", "num_neighbors", "width"), [(1, 1, 1), (7, 3, 5), (12, 12, 16), (24, 16, 16)])
def test_compiled_features_and_gradients_equal_the_plain_ones(count: int, num_neighbors: int, width: int) -> None:
    values = [torch.rand(2, 9, count) + 1, torch.rand(2, 9, count) * 0.5, torch.rand(2, 9, count, width)]
    mask, t = torch.rand(2, 9, count) > 0.2, torch.rand(2, 9, 5) + 1
    mask[0, 0] = False
    values[1][0, 1, 0], t[0, 1, 0], mask[0, 1, 0] = 0.0, values[0][0, 1, 0], True  # a sample on a particle
    results = []
    # Against the plain sums in float64, so that the difference is the compiled twin's own rounding.
    for dtype, backend in ((torch.float64, "torch"), (torch.float32, "numba")):
        inputs = [value.to(dtype).requires_grad_() for value in values]
        radii, bandwidths = (0.0, 0.05, 0.3), (0.05, 0.02, 0.4)  # exp(-(0.5 / 0.02)^2) is below float32's range
        candidates = RayCandidates(*inputs, mask, torch.zeros(2, 9, count, 3, dtype=dtype))
        features = ray_features(candidates, t.to(dtype), num_neighbors, radii, bandwidths, backend)
        assert features.dtype == dtype
        weights = torch.linspace(-1, 1, features.numel(), dtype=dtype).view(features.shape)
        results.append(
            (features.float(), *(g.float() for g in torch.autograd.grad((weights * features).sum(), inputs)))
        )
    # Distances of about 1 carry 1e-7; a bandwidth of 0.02 makes 2e-5 of it, its gradient 1e-3 of 50.
    for plain, compiled, tolerance in zip(*results, (1e-5, 2e-3, 2e-3, 1e-4), strict=True):
        torch.testing.assert_close(compiled, plain, rtol=1e-4, atol=tolerance)


@pytest.mark.skipif(not find_spec("numba"), reason="needs numba")
def test_backends_draw_the_same_picture_and_give_the_same_gradients() -> None:
    particles, rays, keys = scene(count=300).to(torch.float32), rays_of(count=60).to(torch.float32), RandomKeys.fixed(2)
    results = []
    for backend in ("torch", "numba"):
        in_parts = {"checkpoint_chunks": True, "ray_chunk_size": 50} if backend == "numba" else {}
        renderer = renderer_of(candidate_backend=backend, **in_parts).float()
        positions = particles.positions.clone().requires_grad_()
        features = particles.features.clone().requires_grad_()
        rendered = renderer(Particles(positions, features), rays, keys)
        loss = rendered.rgbs.square().sum() + rendered.depths.sum()
        results.append((rendered, torch.autograd.grad(loss, [positions, features, *renderer.parameters()])))
    # float32: hints are differences of distances of 3, densities are per 0.2.
    torch.testing.assert_close(results[1][0].rgbs, results[0][0].rgbs, rtol=0, atol=1e-4)
    torch.testing.assert_close(results[1][0].depths, results[0][0].depths, rtol=0, atol=1e-3)
    for one, other in zip(results[0][1], results[1][1], strict=True):
        assert float((one - other).norm()) <= 1e-3 * float(one.norm())


def test_hints_lie_on_the_nearest_surface_and_beside_an_edge_on_both() -> None:
    near_wall = torch.cartesian_prod(torch.tensor([1.0]), torch.linspace(0, 1, 41), torch.linspace(-1, 1, 81))
    far_wall = torch.cartesian_prod(torch.tensor([3.0]), torch.linspace(-1, 1, 81), torch.linspace(-1, 1, 81))
    particles = Particles(torch.cat([near_wall, far_wall])[None], torch.rand(1, 41 * 81 + 81 * 81, 3))
    forward = torch.tensor([[1.0, 0, 0]])
    origins = torch.tensor([[0, 0.5, 0], [0, -0.5, 0], [0, -0.03, 0]])
    rays = Rays(origins[None], forward.expand(3, 3)[None])
    hints = depth_hints(
        ray_candidates(particles, rays, 24, 0.1, 5.0), torch.linspace(0.05, 0.95, 10).expand(1, 3, 10), 0.03
    )[0]
    assert hints[0].unique().tolist() == pytest.approx([1.0])
    assert hints[1].unique().tolist() == pytest.approx([3.0])
    assert hints[2].unique().tolist() == pytest.approx([1.0, 3.0])


def test_all_but_the_uniform_samples_lie_near_the_surface() -> None:
    wall = torch.cartesian_prod(torch.tensor([2.0]), torch.linspace(-1, 1, 41), torch.linspace(-1, 1, 41))
    particles = Particles(wall[None], torch.rand(1, len(wall), 3))
    rays = Rays(torch.zeros(1, 1, 3), torch.tensor([[[1.0, 0, 0]]]))
    renderer = renderer_of(footprint=0.1).float()
    t = renderer._samples(ray_candidates(particles, rays, 8, 0.5, 6.0), torch.full((1, 1, 9), 0.5))
    assert bool((t.diff(dim=-1) >= 0).all())
    # Six around the hint; one of the two uniform ones happens to be there as well.
    assert int(((t - 2.0).abs() <= 0.15 + 1e-6).sum()) >= 6
    starts, ends = renderer._intervals(t)
    assert bool((starts <= t).all()) and bool((t <= ends).all())
    assert bool((ends[..., :-1] <= starts[..., 1:] + 1e-6).all())


def test_an_invisible_scene_shows_the_background_of_the_direction() -> None:
    renderer, rays = renderer_of(density_activation="relu"), rays_of()
    torch.nn.init.zeros_(renderer.field.density.weight)
    torch.nn.init.constant_(renderer.field.density.bias, -1.0)
    rendered, other = renderer(scene(), rays, None), renderer(scene(count=0), rays, None)
    assert_same(rendered, other)
    assert not bool(rendered.opacities.any())
    torch.testing.assert_close(rendered.depths, torch.full_like(rendered.depths, 6.0))


@pytest.mark.parametrize("ray_chunk_size", [1, 4, 14])
@pytest.mark.parametrize("checkpoint_chunks", [False, True])
def test_chunks_and_checkpoints_change_neither_picture_nor_gradients(
    ray_chunk_size: int, checkpoint_chunks: bool
) -> None:
    particles, rays, keys = scene(), rays_of(), RandomKeys(0, 3, [0, 1])
    results = []
    for renderer in (
        renderer_of(),
        renderer_of(ray_chunk_size=ray_chunk_size, checkpoint_chunks=checkpoint_chunks),
    ):
        positions = particles.positions.clone().requires_grad_()
        features = particles.features.clone().requires_grad_()
        rendered = renderer(Particles(positions, features), rays, keys)
        loss = rendered.rgbs.square().sum() + rendered.depths.sum()
        results.append((rendered, torch.autograd.grad(loss, [positions, features, *renderer.parameters()])))
    assert_same(results[0][0], results[1][0])
    for one, other in zip(results[0][1], results[1][1], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-9)


def test_a_batch_equals_its_members_and_moving_the_world_changes_nothing() -> None:
    particles, rays, renderer = scene(), rays_of(), renderer_of()
    together = renderer(particles, rays, RandomKeys(0, 3, [5, 9]))
    shift = torch.tensor([5.0, -3.0, 2.0], dtype=torch.float64)
    for member, index in enumerate((5, 9)):
        part = slice(member, member + 1)
        alone = renderer(
            Particles(particles.positions[part] + shift, particles.features[part]),
            Rays(rays.origins[part] + shift, rays.directions[part]),
            RandomKeys(0, 3, [index]),
        )
        torch.testing.assert_close(together.rgbs[part], alone.rgbs, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_scenes_with_fewer_particles_than_candidates_are_rendered(count: int) -> None:
    renderer = renderer_of()
    rendered = renderer(scene(count=count), rays_of(), RandomKeys.fixed(2))
    assert bool(torch.isfinite(rendered.rgbs).all())
    rendered.rgbs.sum().backward()
    assert all(parameter.grad is not None for parameter in renderer.parameters())


def test_padding_is_never_seen() -> None:
    particles, rays, renderer = scene(), rays_of(), renderer_of()
    nothing = torch.full((2, 9, 3), torch.nan, dtype=torch.float64)
    padded = Particles(
        torch.cat([nothing, particles.positions], dim=1),
        torch.cat([nothing.nan_to_num(7.0), particles.features], dim=1),
        (torch.arange(59) >= 9).expand(2, 59),
    )
    assert_same(renderer(particles, rays, None), renderer(padded, rays, None))


def test_gradients_reach_every_parameter_and_particle_position() -> None:
    renderer, particles = renderer_of(), scene()
    particles.positions.requires_grad_()
    particles.features.requires_grad_()
    renderer(particles, rays_of(), RandomKeys.fixed(2)).rgbs.square().sum().backward()
    for name, parameter in renderer.named_parameters():
        assert parameter.grad is not None and bool(parameter.grad.abs().sum() > 0), name
    assert bool(particles.positions.grad.abs().sum() > 0) and bool(particles.features.grad.abs().sum() > 0)


def test_a_particle_that_is_not_a_number_is_refused() -> None:
    particles = scene()
    particles.positions[1, 4, 2] = torch.nan
    with pytest.raises(NonFiniteError):
        renderer_of()(particles, rays_of(), None)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("near", 7.0),
        ("num_uniform_samples", 8),
        ("num_neighbors", 9),
        ("footprint", 0.0),
        ("background_width", 0),
        ("candidate_backend", "fast"),
    ],
)
def test_values_out_of_range_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        SurfaceRenderer(**(SMALL | {name: value}))
