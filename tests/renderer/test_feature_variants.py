"""A network on each neighbour's feature, and kernels normalised over neighbours: against formulas, and in renderers."""

import math

import pytest
import torch

from tests.renderer.small_renderer import SMALL, rays_of, renderer_of
from tests.renderer.test_surface import SMALL as SMALL_SURFACE
from vpd_lightning.graph.neighbors import Neighbors, knn
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.features.feature_network import FeatureNetwork
from vpd_lightning.renderer.features.neighbor_features import NeighborFeatures, gathered_neighbors
from vpd_lightning.renderer.features.point_features import annular_features
from vpd_lightning.renderer.point_nerf import PointNeRFRenderer
from vpd_lightning.renderer.surface import SurfaceRenderer
from vpd_lightning.types import Particles, Rays

RADII, BANDWIDTHS = (0.0, 0.05, 0.1, 0.5), (0.05, 0.05, 0.05, 0.5)
VARIANTS = [
    {"kernel_normalization": "eps"},
    {"kernel_normalization": "softmax"},
    {"feature_network": "network"},
    {"feature_network": "inverse"},
    {"kernel_normalization": "eps", "feature_network": "network"},
    {"kernel_normalization": "softmax", "feature_network": "inverse"},
]


def network_of(feature_dim: int = 16, *, is_inverse_distance: bool = False) -> FeatureNetwork:
    return FeatureNetwork(
        feature_dim=feature_dim, width=64, num_hidden_layers=2, offset_degree=5, is_inverse_distance=is_inverse_distance
    ).double()


def variant_of(feature_dim: int = 16, **changes: object) -> NeighborFeatures:
    settings = {"kernel_normalization": None, "normalization_epsilon": 1e-6, "feature_network": None, **changes}
    if isinstance(settings["feature_network"], str):
        settings["feature_network"] = network_of(
            feature_dim, is_inverse_distance=changes["feature_network"] == "inverse"
        )
    return NeighborFeatures(feature_dim=feature_dim, kernel_radii=RADII, kernel_bandwidths=BANDWIDTHS, **settings)


def scene(count: int = 40, width: int = 16) -> Particles:
    return Particles(torch.rand(count, 3, dtype=torch.float64), torch.rand(count, width, dtype=torch.float64))


def features_of(
    variant: NeighborFeatures, queries: torch.Tensor, particles: Particles, count: int = 16
) -> torch.Tensor:
    return variant(*gathered_neighbors(queries, particles, knn(particles.positions, queries, count)))


def queries_of(count: int = 9) -> torch.Tensor:
    return torch.rand(count, 3, dtype=torch.float64)


def kernels_at(distance: float) -> list[float]:
    return [math.exp(-(((distance - r) / b) ** 2)) for r, b in zip(RADII, BANDWIDTHS, strict=True)]


def test_network_has_the_size_that_its_documentation_says() -> None:
    assert sum(parameter.numel() for parameter in network_of().parameters()) == 8400


def test_network_that_returns_the_latent_gives_exactly_the_plain_features() -> None:
    class Latents(FeatureNetwork):
        def forward(self, latents: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
            return latents

    identity = Latents(feature_dim=16, width=1, num_hidden_layers=1, offset_degree=0, is_inverse_distance=False)
    particles, queries = scene(), queries_of()
    found = features_of(variant_of(feature_network=identity), queries, particles)

    plain = annular_features(queries, particles, knn(particles.positions, queries, 16), RADII, BANDWIDTHS)
    assert found.shape == (9, 64)
    assert torch.equal(found, plain)
    assert torch.equal(features_of(variant_of(), queries, particles), plain)


@pytest.mark.parametrize("changes", VARIANTS, ids=str)
def test_features_are_those_of_the_formula_written_out(changes: dict[str, object]) -> None:
    particles, queries = scene(), queries_of(3)
    variant = variant_of(**changes)
    found = features_of(variant, queries, particles, 5)

    network = variant.network
    for row, query in enumerate(queries):
        offsets = query - particles.positions
        distances = offsets.norm(dim=-1)
        nearest = distances.argsort()[:5].tolist()
        shares = [1 / float(distances[i]) / sum(1 / float(distances[j]) for j in nearest) for i in nearest]
        for kernel in range(4):
            weights = [kernels_at(float(distances[i]))[kernel] for i in nearest]
            if network is not None and network.is_inverse_distance:
                weights = [weight * share for weight, share in zip(weights, shares, strict=True)]
            if variant.kernel_normalization is not None:
                epsilon = 1e-6 if variant.kernel_normalization == "eps" else 0.0
                weights = [weight / (sum(weights) + epsilon) for weight in weights]
            total = torch.zeros(16, dtype=torch.float64)
            for i, weight in zip(nearest, weights, strict=True):
                latent = particles.features[i]
                total += weight * (latent if network is None else network(latent, offsets[i] / 0.5))
            torch.testing.assert_close(found[row, 16 * kernel : 16 * (kernel + 1)], total, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("changes", VARIANTS, ids=str)
def test_order_of_neighbors_and_place_of_the_scene_do_not_matter(changes: dict[str, object]) -> None:
    particles, queries = scene(), queries_of()
    variant = variant_of(**changes)
    neighbors = knn(particles.positions, queries, 16)
    found = variant(*gathered_neighbors(queries, particles, neighbors))

    order = torch.randperm(16)
    shuffled = Neighbors(neighbors.index[:, order], neighbors.distance[:, order], neighbors.mask[:, order])
    torch.testing.assert_close(variant(*gathered_neighbors(queries, particles, shuffled)), found)
    shift = torch.tensor([3.0, -7.0, 0.4], dtype=torch.float64)
    moved = Particles(particles.positions + shift, particles.features)
    torch.testing.assert_close(features_of(variant, queries + shift, moved), found, rtol=1e-8, atol=1e-10)


def test_network_sees_on_which_side_of_a_particle_the_location_is() -> None:
    particles = scene(1)
    step = torch.tensor([[0.02, 0.01, -0.03]], dtype=torch.float64)
    one, other = particles.positions + step, particles.positions - step

    network = variant_of(feature_network="network")
    assert not torch.allclose(features_of(network, one, particles), features_of(network, other, particles), rtol=1e-3)
    torch.testing.assert_close(
        features_of(variant_of(), one, particles), features_of(variant_of(), other, particles), rtol=1e-9, atol=1e-12
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("distance", [0.0, 0.3, 20.0, 1000.0])
@pytest.mark.parametrize("changes", VARIANTS, ids=str)
def test_features_and_gradients_are_finite_on_a_particle_and_far_from_all(
    changes: dict[str, object], distance: float, dtype: torch.dtype
) -> None:
    particles = scene(3)
    positions = particles.positions.to(dtype).requires_grad_()
    latents = particles.features.to(dtype).requires_grad_()
    queries = positions.detach()[:1] + torch.tensor([distance, 0.0, 0.0], dtype=dtype)
    variant = variant_of(**changes).to(dtype)

    found = features_of(variant, queries, Particles(positions, latents))  # 13 of 16 neighbours are not there

    gradients = torch.autograd.grad(found.sum(), [positions, latents, *variant.parameters()])
    for tensor in (found, *gradients):
        assert bool(torch.isfinite(tensor).all())
    if distance >= 20.0:  # where the kernels are exactly zero in float32
        assert bool(found.any()) == (changes.get("kernel_normalization") == "softmax")


@pytest.mark.parametrize("changes", VARIANTS, ids=str)
def test_location_without_any_neighbor_has_no_features(changes: dict[str, object]) -> None:
    variant = variant_of(**changes)
    offsets = torch.zeros(2, 3, 3, dtype=torch.float64)
    latents = torch.rand(2, 3, 16, dtype=torch.float64).requires_grad_()

    found = variant(offsets, latents, torch.zeros(2, 3, dtype=torch.bool))

    assert not bool(found.any())
    assert not bool(torch.autograd.grad(found.sum(), latents)[0].any())
    assert variant(offsets[:, :0], latents[:, :0], torch.zeros(2, 0, dtype=torch.bool)).shape == (2, 64)


@pytest.mark.parametrize("mode", ["eps", "softmax"])
def test_normalised_weights_sum_to_one_where_kernels_reach(mode: str) -> None:
    variant = variant_of(kernel_normalization=mode)
    distance, mask = torch.rand(50, 16, dtype=torch.float64) * 0.15, torch.rand(50, 16) > 0.2

    sums = variant.weights(distance, mask).sum(dim=-2)

    mass = variant_of().weights(distance, mask).sum(dim=-2)
    assert bool((mass > 1e-3).float().mean() > 0.9)
    torch.testing.assert_close(sums[mass > 1e-3], torch.ones_like(sums[mass > 1e-3]), rtol=0, atol=1.1e-3)
    if mode == "softmax":
        torch.testing.assert_close(sums, torch.ones_like(sums))
    else:
        torch.testing.assert_close(sums, mass / (mass + 1e-6))


@pytest.mark.parametrize("mode", ["eps", "softmax"])
def test_neighbors_listed_twice_change_plain_features_only(mode: str) -> None:
    particles, queries = scene(), queries_of()
    neighbors = knn(particles.positions, queries, 8)
    twice = Neighbors(
        *(torch.cat([part, part], dim=1) for part in (neighbors.index, neighbors.distance, neighbors.mask))
    )

    def change(variant: NeighborFeatures) -> torch.Tensor:
        once = variant(*gathered_neighbors(queries, particles, neighbors))
        return variant(*gathered_neighbors(queries, particles, twice)) / once

    wide = slice(48, 64)  # the kernel that reaches all of these neighbours
    torch.testing.assert_close(change(variant_of())[:, wide], torch.full((9, 16), 2.0, dtype=torch.float64))
    ones = torch.ones(9, 16, dtype=torch.float64)
    torch.testing.assert_close(change(variant_of(kernel_normalization=mode))[:, wide], ones, rtol=1e-5, atol=0)


@pytest.mark.parametrize("mode", ["eps", "softmax"])
def test_constant_features_give_that_constant(mode: str) -> None:
    particles, queries = scene(), queries_of()
    constant = Particles(particles.positions, torch.full_like(particles.features, 0.7))

    found = features_of(variant_of(kernel_normalization=mode), queries, constant)

    torch.testing.assert_close(found[:, 48:], torch.full((9, 16), 0.7, dtype=torch.float64), rtol=1e-5, atol=0)
    if mode == "softmax":
        torch.testing.assert_close(found, torch.full((9, 64), 0.7, dtype=torch.float64))


@pytest.mark.parametrize("changes", VARIANTS[:3], ids=str)
def test_gradients_are_those_of_finite_differences(changes: dict[str, object]) -> None:
    particles, queries = scene(6, 3), queries_of(2)
    neighbors = knn(particles.positions, queries, 4)
    variant = variant_of(3, **changes)

    def function(positions: torch.Tensor, latents: torch.Tensor) -> torch.Tensor:
        return variant(*gathered_neighbors(queries, Particles(positions, latents), neighbors))

    inputs = (particles.positions.requires_grad_(), particles.features.requires_grad_())
    assert torch.autograd.gradcheck(function, inputs, eps=1e-7, atol=1e-4)


def small_network(*, is_inverse_distance: bool = False) -> FeatureNetwork:
    return FeatureNetwork(
        feature_dim=3, width=8, num_hidden_layers=2, offset_degree=2, is_inverse_distance=is_inverse_distance
    )


def surface_of(**changes: object) -> SurfaceRenderer:
    torch.manual_seed(0)
    return SurfaceRenderer(**(SMALL_SURFACE | changes)).double()


def batch_of_particles() -> Particles:
    return Particles(torch.rand(2, 50, 3, dtype=torch.float64) * 2 - 1, torch.rand(2, 50, 3, dtype=torch.float64))


@pytest.mark.parametrize("make", [renderer_of, surface_of])
@pytest.mark.parametrize("mode", [None, "eps", "softmax"])
def test_renderers_use_the_variant_recompute_it_exactly_and_train_its_network(make: object, mode: str | None) -> None:
    particles, rays = batch_of_particles(), rays_of()
    results = []
    for changes in ({}, {"checkpoint_chunks": True, "ray_chunk_size": 4}):
        torch.manual_seed(1)
        renderer = make(kernel_normalization=mode, feature_network=small_network(), **changes)  # type: ignore[operator]
        inputs = [particles.positions.clone().requires_grad_(), particles.features.clone().requires_grad_()]
        rendered = renderer(Particles(*inputs, particles.mask), rays, RandomKeys(0, 3, [0, 1]))
        sources = [*inputs, *renderer.variant.parameters()]
        results.append([rendered.rgbs, *torch.autograd.grad(rendered.rgbs.square().sum(), sources)])
    plain = make()(particles, rays, RandomKeys(0, 3, [0, 1]))  # type: ignore[operator]

    assert not torch.allclose(results[0][0], plain.rgbs, rtol=1e-3)
    for once, again in zip(*results, strict=True):
        assert bool(torch.isfinite(once).all()) and bool(once.any())
        torch.testing.assert_close(again, once, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("changes", [{"kernel_normalization": "eps"}, {"kernel_normalization": "softmax"}, {}])
def test_surface_renderer_gives_its_samples_the_features_of_all_particles(changes: dict[str, object]) -> None:
    """Where all particles are candidates, the field is given what ``point_features`` says of the same places."""
    particles = Particles(torch.rand(1, 8, 3, dtype=torch.float64), torch.rand(1, 8, 3, dtype=torch.float64))
    rays = Rays(torch.tensor([[[0.4, 0.5, -1.0]]]).double(), torch.tensor([[[0.0, 0.0, 1.0]]]).double())
    renderer = surface_of(feature_network=small_network(is_inverse_distance=True), **changes)
    seen: list[torch.Tensor] = []
    renderer.field.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    renderer._samples = lambda candidates, noise: torch.linspace(1.0, 2.0, 8).double()[None, None]  # type: ignore[method-assign]

    renderer(particles, rays, None)

    points = rays.origins[:, 0, None] + torch.linspace(1.0, 2.0, 8).double()[None, :, None] * rays.directions
    torch.testing.assert_close(seen[0][:, 0], renderer.point_features(particles, points), rtol=1e-8, atol=1e-10)


def test_compiled_backend_is_refused_for_what_it_does_not_know() -> None:
    for changes in ({"kernel_normalization": "eps"}, {"feature_network": small_network()}):
        with pytest.raises(ValueError, match=r"features_backend must be auto or torch .* numba supports the plain"):
            PointNeRFRenderer(**(SMALL | {"features_backend": "numba"} | changes))
        PointNeRFRenderer(**(SMALL | {"features_backend": "torch"} | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kernel_normalization": "mean"}, "kernel_normalization must be null or one of"),
        ({"normalization_epsilon": 0.0}, "normalization_epsilon must be greater than 0"),
        ({"feature_network": network_of(5)}, "feature_network.feature_dim must be feature_dim=3, got 5"),
        ({"feature_network": small_network(), "kernel_radii": [0, 0]}, "needs a kernel with a radius above 0"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, object], message: str) -> None:
    for make, settings in ((PointNeRFRenderer, SMALL), (SurfaceRenderer, SMALL_SURFACE)):
        with pytest.raises(ValueError, match=message):
            make(**(settings | changes))


def test_network_refuses_sizes_that_are_none() -> None:
    sizes = {"feature_dim": 3, "width": 8, "num_hidden_layers": 2, "offset_degree": 5, "is_inverse_distance": False}
    for name in ("feature_dim", "width", "num_hidden_layers"):
        with pytest.raises(ValueError, match=name):
            FeatureNetwork(**(sizes | {name: 0}))
    with pytest.raises(ValueError, match="offset_degree"):
        FeatureNetwork(**(sizes | {"offset_degree": -1}))
