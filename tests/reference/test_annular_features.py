"""annular_features against equations 2 and 3 in float64 loops, and its gradients against finite differences."""

import numpy as np
import pytest
import torch

from tests.reference import reference_features as reference
from vpd_lightning.graph.neighbors import Neighbors
from vpd_lightning.renderer.features.point_features import annular_features
from vpd_lightning.types import Particles

RADII, BANDWIDTHS = [0.0, 0.05, 0.1, 0.5], [0.05, 0.05, 0.05, 0.5]  # the paper's MuJoCo row
NUM_PARTICLES, NUM_QUERIES, NUM_NEIGHBORS, NUM_FEATURES = 40, 12, 16, 3


def _scene(seed: int, num_particles: int = NUM_PARTICLES) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    positions = generator.uniform(-0.15, 0.15, (num_particles, 3))
    features = generator.normal(size=(num_particles, NUM_FEATURES))
    return positions, features, generator.uniform(-0.15, 0.15, (NUM_QUERIES, 3))


def _neighbors(positions: np.ndarray, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    index = np.zeros((len(queries), NUM_NEIGHBORS), dtype=np.int64)
    mask = np.zeros((len(queries), NUM_NEIGHBORS), dtype=bool)
    for number, query in enumerate(queries):
        found = reference.nearest(positions, query, NUM_NEIGHBORS)
        index[number, : len(found)], mask[number, : len(found)] = found, True
    return index, mask


def _frozen(index: np.ndarray, mask: np.ndarray, dtype: torch.dtype = torch.float64) -> Neighbors:
    """The distances are nonsense on purpose: they must be recomputed from the positions."""
    distance = torch.full(index.shape, float("nan"), dtype=dtype)
    return Neighbors(index=torch.from_numpy(index), distance=distance, mask=torch.from_numpy(mask))


# float32: a distance carries an error of about 3 * 2^-24 * 0.3 m = 5e-8 m; the steepest kernel (bandwidth 0.05) turns
# it into 0.86 / 0.05 * 5e-8 = 1e-6, times sixteen neighbours with features of size up to 3: 5e-5.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 5e-5)])
@pytest.mark.parametrize("num_particles", [NUM_PARTICLES, NUM_NEIGHBORS - 1, 1])
def test_features_match_the_loops(dtype: torch.dtype, tolerance: float, num_particles: int) -> None:
    positions, features, queries = _scene(0, num_particles)
    index, mask = _neighbors(positions, queries)
    expected = reference.annular_features(queries, positions, features, index, mask, RADII, BANDWIDTHS)
    found = annular_features(
        torch.from_numpy(queries).to(dtype),
        Particles(torch.from_numpy(positions).to(dtype), torch.from_numpy(features).to(dtype)),
        _frozen(index, mask, dtype),
        RADII,
        BANDWIDTHS,
    )
    assert found.dtype == dtype
    np.testing.assert_allclose(found.numpy(), expected, rtol=tolerance, atol=tolerance)


def test_every_masked_neighbour_counts_as_absent() -> None:
    positions, features, queries = _scene(1)
    index, mask = _neighbors(positions, queries)
    mask &= np.random.default_rng(2).uniform(size=mask.shape) < 0.5
    mask[0] = False
    index[~mask] = 0  # padding may point anywhere that exists
    expected = reference.annular_features(queries, positions, features, index, mask, RADII, BANDWIDTHS)
    particles = Particles(torch.from_numpy(positions), torch.from_numpy(features))
    found = annular_features(torch.from_numpy(queries), particles, _frozen(index, mask), RADII, BANDWIDTHS)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6, atol=1e-6)
    assert not found[0].any()


def test_radii_and_bandwidths_may_be_tensors() -> None:
    positions, features, queries = _scene(1)
    index, mask = _neighbors(positions, queries)
    particles = Particles(torch.from_numpy(positions), torch.from_numpy(features))
    arguments = (torch.from_numpy(queries), particles, _frozen(index, mask))
    listed = annular_features(*arguments, RADII, BANDWIDTHS)
    tensors = annular_features(*arguments, torch.tensor(RADII).double(), torch.tensor(BANDWIDTHS).double())
    torch.testing.assert_close(listed, tensors, rtol=1e-6, atol=1e-6)


def test_gradients_match_finite_differences_with_frozen_neighbours() -> None:
    # Off the kink: no query closer than 1e-3 to any particle, a thousand finite difference steps.
    positions, features, queries = _scene(3, 6)
    queries = queries[:4]
    assert min(np.linalg.norm(q - p) for q in queries for p in positions) > 1e-3
    index, mask = _neighbors(positions, queries)
    neighbors = _frozen(index, mask)

    def function(x: torch.Tensor, z: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        return annular_features(q, Particles(x, z), neighbors, RADII, BANDWIDTHS)

    inputs = [torch.from_numpy(array).requires_grad_() for array in (positions, features, queries)]
    assert torch.autograd.gradcheck(function, inputs, eps=1e-6, atol=1e-6, rtol=1e-4)


def test_gradient_at_zero_distance_is_finite_and_zero() -> None:
    # At the particle itself the distance has a kink unless the radius is 0; its subgradient 0 is the one to use.
    point = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    positions, queries = point.clone().requires_grad_(), point.clone().requires_grad_()
    features = torch.tensor([[1.0, 2.0, -1.0]], dtype=torch.float64, requires_grad=True)
    neighbors = _frozen(np.zeros((1, 2), dtype=np.int64), np.array([[True, False]]))
    found = annular_features(queries, Particles(positions, features), neighbors, RADII, BANDWIDTHS)
    found.sum().backward()
    expected = reference.annular_features(
        point.numpy(), point.numpy(), features.detach().numpy(), np.zeros((1, 1), np.int64), np.ones((1, 1), bool),
        RADII, BANDWIDTHS,
    )  # fmt: skip
    np.testing.assert_allclose(found.detach().numpy(), expected, rtol=1e-6, atol=1e-6)
    assert positions.grad is not None and queries.grad is not None and features.grad is not None
    assert not positions.grad.any() and not queries.grad.any()
    weights = sum(np.exp(-((radius / bandwidth) ** 2)) for radius, bandwidth in zip(RADII, BANDWIDTHS, strict=True))
    np.testing.assert_allclose(features.grad.numpy(), np.full((1, 3), weights), rtol=1e-6)
