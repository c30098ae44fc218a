"""What only the compiled backend of the CPU promises, and the choice among backends."""

import numpy as np
import pytest
import torch

from vpd_lightning.errors import ConfigError
from vpd_lightning.graph.neighbors import Neighbors, knn
from vpd_lightning.renderer.features.point_features import annular_features
from vpd_lightning.renderer.kernels.fused_features import FEATURE_BACKENDS, fused_annular_features
from vpd_lightning.types import Particles

KERNELS = [0.0, 0.05, 0.1, 0.5], [0.05, 0.05, 0.05, 0.5]


def scene(num_queries: int, count: int, k: int = 16) -> tuple[torch.Tensor, Particles, Neighbors]:
    positions = torch.rand(count, 3, requires_grad=True)
    queries = torch.rand(num_queries, 3, requires_grad=True)
    found = knn(positions.detach(), queries.detach(), k, backend="torch")
    return queries, Particles(positions, torch.randn(count, 16, requires_grad=True)), found


def test_the_number_of_threads_changes_no_bit():
    pytest.importorskip("numba")
    # More than one slice of queries in the forward pass, and several buffers in the backward pass.
    queries, particles, found = scene(10_000, 500)
    results = []
    for threads in (1, 2, 3, 8):
        torch.set_num_threads(threads)
        try:
            result = fused_annular_features(queries, particles, found, *KERNELS, "numba")
            inputs = (queries, particles.positions, particles.features)
            results.append((result, *torch.autograd.grad(result.square().sum(), inputs)))
        finally:
            torch.set_num_threads(1)
    for other in results[1:]:
        assert all(torch.equal(one, same) for one, same in zip(results[0], other, strict=True))


def test_the_exponential_is_exact_to_two_units_in_the_last_place():
    pytest.importorskip("numba")
    # One particle in the origin with feature 1 under a kernel of radius 0 and bandwidth 1: the weight itself.
    distance = torch.cat([torch.linspace(0, 11, 100_000), torch.logspace(-6, 6, 1000)])
    queries = torch.stack([distance, torch.zeros_like(distance), torch.zeros_like(distance)], dim=-1)
    none = torch.zeros(len(queries), 1)
    found = Neighbors(none.long(), none, torch.ones_like(none, dtype=torch.bool))
    particles = Particles(torch.zeros(1, 3), torch.ones(1, 1))
    weights = fused_annular_features(queries, particles, found, [0.0], [1.0], "numba")[:, 0].numpy()
    # The same roundings up to the exponent, the exponential in float64.
    x = distance.numpy()
    exponent = np.square(np.sqrt(x * x, dtype=np.float32), dtype=np.float32)
    exact = np.exp(-exponent.astype(np.float64))
    is_normal = exact >= 1.2e-38
    assert is_normal.any() and not is_normal.all()
    units = np.spacing(exact[is_normal].astype(np.float32))
    assert np.all(np.abs(weights[is_normal] - exact[is_normal]) <= 2 * units)
    # Below the normal numbers: zero, or the smallest normal number where the border is rounded.
    assert np.all((weights[~is_normal] == 0) | (np.abs(weights[~is_normal] - exact[~is_normal]) < 1.2e-38))


def test_an_index_of_no_particle_is_refused_before_anything_is_read():
    pytest.importorskip("numba")
    queries, particles, found = scene(5, 10, 3)
    for wrong in (10, -1, 2**40):
        index = found.index.clone()
        index[2, 1] = wrong
        with pytest.raises(IndexError, match="10 particles"):
            fused_annular_features(queries, particles, Neighbors(index, found.distance, found.mask), *KERNELS, "numba")
        masked = found.mask.clone()
        masked[2, 1] = False
        result = fused_annular_features(queries, particles, Neighbors(index, found.distance, masked), *KERNELS, "numba")
        assert bool(torch.isfinite(result).all())


@pytest.mark.parametrize("backend", ["auto", *FEATURE_BACKENDS])
def test_every_backend_that_works_here_gives_the_definitions_numbers(backend: str):
    queries, particles, found = scene(30, 20)
    try:
        ours = fused_annular_features(queries, particles, found, *KERNELS, backend)
    except ConfigError as error:
        # Triton without a GPU, or a package that is missing; "auto" and "torch" work everywhere.
        assert backend in ("numba", "triton") and "features_backend=auto" in str(error)
        return
    theirs = annular_features(queries, particles, found, *KERNELS)
    # Sums of 16 terms of about 1, each within 20 roundings of 6e-8.
    torch.testing.assert_close(ours, theirs, rtol=0, atol=2e-5)


def test_an_unknown_backend_is_refused_by_name():
    queries, particles, found = scene(3, 4, 2)
    with pytest.raises(ValueError, match="auto or one of .*'cuda'"):
        fused_annular_features(queries, particles, found, *KERNELS, "cuda")


def test_kernels_that_want_gradients_get_them_from_the_definition():
    queries, particles, found = scene(6, 9, 4)
    radii = torch.tensor(KERNELS[0], requires_grad=True)
    result = fused_annular_features(queries, particles, found, radii, KERNELS[1], "auto")
    assert bool(torch.autograd.grad(result.square().sum(), radii)[0].any())
    pytest.importorskip("numba")
    with pytest.raises(ValueError, match="torch has"):
        fused_annular_features(queries, particles, found, radii, KERNELS[1], "numba")
    # Without gradients tensors are kernels like any other.
    ours = fused_annular_features(queries, particles, found, radii.detach(), torch.tensor(KERNELS[1]), "numba")
    torch.testing.assert_close(ours, result, rtol=0, atol=2e-5)


def test_gradients_of_gradients_are_refused():
    pytest.importorskip("numba")
    queries, particles, found = scene(6, 9, 4)
    result = fused_annular_features(queries, particles, found, *KERNELS, "numba")
    first = torch.autograd.grad(result.square().sum(), queries, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()
