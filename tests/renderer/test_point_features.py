import math

import pytest
import torch

from vpd_lightning.graph.neighbors import Neighbors, knn
from vpd_lightning.renderer.features.point_features import annular_features, check_kernels
from vpd_lightning.types import Particles

RADII, BANDWIDTHS = (0.0, 0.05, 0.1, 0.5), (0.05, 0.05, 0.05, 0.5)


def scene(count: int, dtype: torch.dtype = torch.float64) -> Particles:
    return Particles(torch.rand(count, 3, dtype=dtype), torch.rand(count, 5, dtype=dtype))


def test_features_are_the_kernel_major_sum_of_the_papers_formula() -> None:
    particles, queries = scene(30), torch.rand(7, 3, dtype=torch.float64)
    neighbors = knn(particles.positions, queries, 6)
    features = annular_features(queries, particles, neighbors, RADII, BANDWIDTHS)
    assert features.shape == (7, 4 * 5)
    for row, query in enumerate(queries):
        for kernel, (radius, bandwidth) in enumerate(zip(RADII, BANDWIDTHS, strict=True)):
            total = torch.zeros(5, dtype=torch.float64)
            for particle in neighbors.index[row].tolist():
                distance = math.dist(query.tolist(), particles.positions[particle].tolist())
                total += math.exp(-(((distance - radius) / bandwidth) ** 2)) * particles.features[particle]
            torch.testing.assert_close(features[row, 5 * kernel : 5 * kernel + 5], total, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_missing_neighbors_add_nothing(count: int) -> None:
    particles, queries = scene(count), torch.rand(4, 3, dtype=torch.float64)
    many = annular_features(queries, particles, knn(particles.positions, queries, 16), RADII, BANDWIDTHS)
    few = annular_features(queries, particles, knn(particles.positions, queries, count), RADII, BANDWIDTHS)
    assert many.shape == (4, 20)
    torch.testing.assert_close(many, few, rtol=0, atol=1e-14)
    if count == 0:
        assert not bool(many.any())


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_a_masked_entry_points_at_does_not_get_through(bad: float) -> None:
    positions, features = torch.rand(5, 3), torch.rand(5, 2)
    positions[0], features[0] = bad, bad
    index, mask = torch.tensor([[3, 0, 4]]), torch.tensor([[True, False, True]])
    masked = Neighbors(index, torch.zeros(1, 3), mask)
    shorter = Neighbors(index[:, ::2], torch.zeros(1, 2), mask[:, ::2])
    queries, particles = torch.rand(1, 3), Particles(positions, features)
    found = annular_features(queries, particles, masked, RADII, BANDWIDTHS)
    assert bool(torch.isfinite(found).all())
    # Adding zeros changes nothing; the product may sum in another order.
    torch.testing.assert_close(found, annular_features(queries, particles, shorter, RADII, BANDWIDTHS))


def test_a_batch_equals_its_members() -> None:
    positions, features = torch.rand(3, 20, 3), torch.rand(3, 20, 5)
    queries = torch.rand(3, 8, 3)
    tables = [knn(positions[member], queries[member], 4) for member in range(3)]
    together = annular_features(
        queries,
        Particles(positions, features),
        Neighbors(*(torch.stack([getattr(t, name) for t in tables]) for name in ("index", "distance", "mask"))),
        RADII,
        BANDWIDTHS,
    )
    for member in range(3):
        alone = annular_features(
            queries[member], Particles(positions[member], features[member]), tables[member], RADII, BANDWIDTHS
        )
        torch.testing.assert_close(together[member], alone, rtol=1e-6, atol=1e-6)


def test_moving_queries_and_particles_together_changes_nothing() -> None:
    particles, queries = scene(30), torch.rand(7, 3, dtype=torch.float64)
    neighbors = knn(particles.positions, queries, 6)
    moved = Particles(particles.positions + 10, particles.features)
    torch.testing.assert_close(
        annular_features(queries + 10, moved, neighbors, RADII, BANDWIDTHS),
        annular_features(queries, particles, neighbors, RADII, BANDWIDTHS),
        # Coordinates near 10 are rounded to 1e-15; the narrow kernels' slope is at most 20 per metre.
        rtol=0,
        atol=1e-12,
    )


def test_gradients_pass_finite_differences() -> None:
    particles, queries = scene(10), torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    neighbors = knn(particles.positions, queries, 5, max_radius=0.6)
    positions, features = particles.positions.requires_grad_(), particles.features.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda q, x, z: annular_features(q, Particles(x, z), neighbors, (0.0, 0.3), (0.3, 0.4)),
        (queries, positions, features),
    )


def test_a_query_on_a_particle_has_a_zero_gradient_there() -> None:
    positions = torch.tensor([[0.2, 0.3, 0.4]] * 3, requires_grad=True)
    features = torch.ones(3, 5, requires_grad=True)
    queries = torch.tensor([[0.2, 0.3, 0.4]], requires_grad=True)
    neighbors = knn(positions, queries, 3)
    annular_features(queries, Particles(positions, features), neighbors, RADII, BANDWIDTHS).sum().backward()
    assert torch.equal(queries.grad, torch.zeros(1, 3)) and torch.equal(positions.grad, torch.zeros(3, 3))
    assert bool(torch.isfinite(features.grad).all()) and bool((features.grad > 0).all())


def test_radii_and_bandwidths_may_be_tensors() -> None:
    particles, queries = scene(10), torch.rand(4, 3, dtype=torch.float64)
    neighbors = knn(particles.positions, queries, 5)
    given = torch.tensor(RADII), torch.tensor(BANDWIDTHS)
    # float32 kernels of float64 positions: the parameters themselves are rounded to 1e-7.
    torch.testing.assert_close(
        annular_features(queries, particles, neighbors, *given),
        annular_features(queries, particles, neighbors, RADII, BANDWIDTHS),
        rtol=1e-4,
        atol=1e-6,
    )


def test_kernels_stay_in_float32_under_autocast() -> None:
    particles, queries = scene(10, torch.float32), torch.rand(4, 3)
    neighbors = knn(particles.positions, queries, 5)
    exact = annular_features(queries, particles, neighbors, RADII, BANDWIDTHS)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(annular_features(queries, particles, neighbors, RADII, BANDWIDTHS), exact)
        half = Particles(particles.positions, particles.features.bfloat16())
        assert annular_features(queries, half, neighbors, RADII, BANDWIDTHS).dtype == torch.float32


def test_impossible_kernels_are_refused_by_name() -> None:
    for radii, bandwidths, name in (
        ((0.1,), (0.1, 0.2), "as long as"),
        ((), (), "not empty"),
        ((-0.1,), (0.1,), "kernel_radii"),
        ((0.1,), (0.0,), "kernel_bandwidths"),
        ((math.inf,), (0.1,), "kernel_radii"),
        ((0.1,), (math.inf,), "kernel_bandwidths"),
    ):
        with pytest.raises(ValueError, match=name):
            check_kernels(radii, bandwidths)
