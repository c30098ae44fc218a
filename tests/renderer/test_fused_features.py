"""Every fused backend against the definition in float64 and against a loop over neighbours, kernels and channels.

Run with TRITON_INTERPRET=1 this file tests Triton's kernels on the CPU; ``test_fused_features_triton.py`` does so.
"""

import os
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.reference import reference_features
from vpd_lightning.graph.neighbors import Neighbors, knn
from vpd_lightning.renderer.features.point_features import annular_features
from vpd_lightning.renderer.kernels.fused_features import fused_annular_features
from vpd_lightning.types import Particles

IS_INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
ROUTES = [
    pytest.param(("triton", "cuda"), marks=pytest.mark.gpu, id="triton-cuda"),
    pytest.param(("triton", "cpu"), id="triton-cpu") if IS_INTERPRETED else pytest.param(("numba", "cpu"), id="numba"),
]
RADII, BANDWIDTHS = [0.0, 0.05, 0.1, 0.5, 0.2], [0.05, 0.05, 0.05, 0.5, 0.1]
# queries, particles, neighbours, kernels, features: around the sizes of tiles and vectors, and the paper's.
SIZES = [
    (33, 17, 16, 4, 16),
    (17, 16, 17, 1, 17),
    (15, 40, 15, 5, 3),
    (16, 33, 1, 2, 1),
    (1, 1, 16, 3, 16),
    (1, 15, 0, 4, 2),
    (0, 5, 3, 2, 3),
    (4, 0, 3, 2, 3),
    (20, 17, 5, 5, 33),
]


class Inputs(NamedTuple):
    queries: Tensor
    positions: Tensor
    features: Tensor


class Route(NamedTuple):
    backend: str
    device: torch.device

    def __call__(self, inputs: Inputs, neighbors: Neighbors, count: int = 4) -> Tensor:
        particles = Particles(inputs.positions, inputs.features)
        kernels = RADII[:count], BANDWIDTHS[:count]
        return fused_annular_features(inputs.queries, particles, neighbors, *kernels, self.backend)


@pytest.fixture(params=ROUTES)
def route(request: pytest.FixtureRequest) -> Route:
    backend, device = request.param
    pytest.importorskip(backend)
    return Route(backend, torch.device(device))


@pytest.fixture
def deterministic() -> Iterator[None]:
    """Deterministic sums; PyTorch then also fills new memory with NaN, so that what is never written is seen."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


def scene(route: Route, num_queries: int, count: int, width: int, dtype: torch.dtype = torch.float32) -> Inputs:
    values = torch.rand(num_queries, 3), torch.rand(count, 3), torch.randn(count, width)
    return Inputs(*(value.to(route.device, dtype).requires_grad_() for value in values))


def table(inputs: Inputs, k: int, max_radius: float | None = None) -> Neighbors:
    return knn(inputs.positions.detach(), inputs.queries.detach(), k, max_radius=max_radius, backend="torch")


def gradients(result: Tensor, inputs: Inputs) -> tuple[Tensor, ...]:
    weights = torch.linspace(-1, 2, result.numel(), dtype=torch.float64).view(result.shape)
    return torch.autograd.grad((result * weights.to(result)).sum(), inputs, materialize_grads=True)


def exact(inputs: Inputs, neighbors: Neighbors, count: int = 4) -> tuple[Tensor, ...]:
    """Values and gradients of the definition in float64."""
    doubles = Inputs(*(value.detach().double().requires_grad_() for value in inputs))
    particles = Particles(doubles.positions, doubles.features)
    result = annular_features(doubles.queries, particles, neighbors, RADII[:count], BANDWIDTHS[:count])
    return (result, *gradients(result, doubles))


def assert_close(ours: tuple[Tensor, ...], theirs: tuple[Tensor, ...]) -> None:
    for one, other in zip(ours, theirs, strict=True):
        # Arguments d / b of up to 20 carry that many roundings of 6e-8; some 16 of them are summed.
        size = float(other.detach().abs().max()) if other.numel() else 0.0
        torch.testing.assert_close(one.double(), other, rtol=0, atol=2e-5 * size + 1e-12)


def all_of(route: Route, inputs: Inputs, neighbors: Neighbors, count: int = 4) -> tuple[Tensor, ...]:
    result = route(inputs, neighbors, count)
    return (result, *gradients(result, inputs))


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_values_and_gradients_are_those_of_the_definition(route: Route, sizes: tuple[int, ...]):
    num_queries, count, k, num_kernels, width = sizes
    inputs = scene(route, num_queries, count, width)
    neighbors = table(inputs, k, max_radius=0.6)
    assert_close(all_of(route, inputs, neighbors, num_kernels), exact(inputs, neighbors, num_kernels))


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_everything_is_written_and_deterministic_sums_are_right(
    route: Route, sizes: tuple[int, ...], deterministic: None
):
    num_queries, count, k, num_kernels, width = sizes
    inputs = scene(route, num_queries, count, width)
    neighbors = table(inputs, k, max_radius=0.6)
    ours = all_of(route, inputs, neighbors, num_kernels)
    assert_close(ours, exact(inputs, neighbors, num_kernels))
    if IS_INTERPRETED:
        return  # One program after another, slowly: the order cannot change.
    again = all_of(route, inputs, neighbors, num_kernels)
    assert all(torch.equal(one, other) for one, other in zip(ours, again, strict=True))


def test_values_are_those_of_a_loop(route: Route):
    inputs = scene(route, 9, 25, 5, torch.float64)
    neighbors = table(inputs, 6, max_radius=0.5)
    queries, positions, features = (value.detach().cpu().numpy() for value in inputs)
    index, mask = neighbors.index.cpu().numpy(), neighbors.mask.cpu().numpy()
    loop = reference_features.annular_features(queries, positions, features, index, mask, RADII, BANDWIDTHS)
    ours = route(inputs, neighbors, 5)
    assert ours.dtype == torch.float64
    np.testing.assert_allclose(ours.detach().cpu().numpy(), loop, rtol=1e-12, atol=1e-13)


def test_gradients_pass_finite_differences(route: Route):
    inputs = scene(route, 3, 8, 2, torch.float64)
    neighbors = table(inputs, 4, max_radius=0.6)
    # The interpreter takes 0.1 s per call; its fast mode compares along one random direction.
    assert torch.autograd.gradcheck(
        lambda *values: route(Inputs(*values), neighbors, 3), tuple(inputs), fast_mode=route.backend == "triton"
    )


def test_a_query_on_duplicated_particles_has_a_zero_gradient(route: Route):
    place = torch.tensor([[0.2, 0.3, 0.4]], device=route.device)
    features = torch.randn(300, 5, device=route.device)
    inputs = Inputs(*(v.clone().requires_grad_() for v in (place.expand(20, 3), place.expand(300, 3), features)))
    neighbors = table(inputs, 16)
    result, to_queries, to_positions, to_features = all_of(route, inputs, neighbors)
    assert not to_queries.any() and not to_positions.any()
    expected = exact(inputs, neighbors)
    assert_close((result, to_features), (expected[0], expected[3]))


def test_masked_neighbors_anywhere_in_a_row_contribute_nothing(route: Route):
    inputs = scene(route, 20, 10, 3)
    found = table(inputs, 8)
    mask = torch.rand(20, 8, device=route.device) < 0.5
    mask[3], mask[4] = False, True
    with torch.no_grad():  # What masked entries point at is never read.
        inputs.positions[0], inputs.features[0] = torch.nan, torch.inf
    index = found.index.clamp(min=1)
    result, *grads = all_of(route, inputs, Neighbors(index * mask, found.distance, mask))
    # The same table with a row of its own for masked entries: finite, far away and of weight zero.
    with torch.no_grad():
        inputs.positions[0], inputs.features[0] = 100.0, 0.0
    assert_close((result, *grads), exact(inputs, Neighbors(index * mask, found.distance, mask)))
    assert not result[3].any() and not grads[1][0].any() and not grads[2][0].any()


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_tiny_and_huge_distances_are_finite_and_right(route: Route, scale: float):
    inputs = scene(route, 17, 9, 3)
    inputs = Inputs(*((v.detach() * s).requires_grad_() for v, s in zip(inputs, (scale, scale, 1.0), strict=True)))
    neighbors = table(inputs, 5)
    ours = all_of(route, inputs, neighbors)
    assert all(bool(torch.isfinite(value).all()) for value in ours)
    assert_close(ours, exact(inputs, neighbors))


def test_strided_inputs_are_read_right(route: Route):
    inputs = scene(route, 12, 10, 4)
    strided = Inputs(*(value.detach().t().contiguous().t().requires_grad_() for value in inputs))
    neighbors = table(inputs, 6)
    turned = Neighbors(*(v.t().contiguous().t() for v in (neighbors.index, neighbors.distance, neighbors.mask)))
    assert not any(value.is_contiguous() for value in (*strided, turned.index, turned.mask))
    result = route(strided, turned)
    # The gradient of a slice is not contiguous either.
    ours = torch.autograd.grad(result[:, ::2].sum(), strided)
    plain = route(inputs, neighbors)
    theirs = torch.autograd.grad(plain[:, ::2].sum(), inputs)
    torch.testing.assert_close(result, plain, rtol=0, atol=0)
    # Atomic additions on a GPU come in any order.
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("batch", [(2,), (2, 3), (0,), (1, 1)], ids=str)
def test_a_batch_equals_its_members(route: Route, batch: tuple[int, ...]):
    shapes = ((*batch, 7, 3), (*batch, 9, 3), (*batch, 9, 5))
    inputs = Inputs(*(torch.randn(shape, device=route.device, requires_grad=True) for shape in shapes))
    index = torch.randint(9, (*batch, 7, 4), device=route.device)
    neighbors = Neighbors(
        index, torch.zeros(index.shape, device=route.device), torch.rand(index.shape, device=route.device) < 0.8
    )
    result, *grads = all_of(route, inputs, neighbors)
    assert result.shape == (*batch, 7, 20)
    assert_close((result, *grads), exact(inputs, neighbors))


def test_half_precision_is_summed_in_float32_and_gets_its_gradients(route: Route):
    inputs = scene(route, 8, 9, 4)
    halves = Inputs(inputs.queries, inputs.positions, inputs.features.detach().bfloat16().requires_grad_())
    neighbors = table(inputs, 5)
    with torch.autocast(route.device.type, dtype=torch.bfloat16):
        result = route(halves, neighbors)
    assert result.dtype == torch.float32
    same = Inputs(inputs.queries, inputs.positions, halves.features.detach().float().requires_grad_())
    assert torch.equal(result, route(same, neighbors))
    to_features = torch.autograd.grad(result.sum(), halves.features)[0]
    assert to_features.dtype == torch.bfloat16 and bool(to_features.any())


@pytest.mark.parametrize("wanted", [0, 1, 2])
def test_one_input_alone_may_want_a_gradient(route: Route, wanted: int):
    inputs = scene(route, 10, 12, 3)
    neighbors = table(inputs, 4)
    expected = gradients(route(inputs, neighbors), inputs)[wanted]
    alone = Inputs(*(value.detach().requires_grad_(number == wanted) for number, value in enumerate(inputs)))
    result = route(alone, neighbors)
    weights = torch.linspace(-1, 2, result.numel(), dtype=torch.float64).view(result.shape)
    (result * weights.to(result)).sum().backward()
    torch.testing.assert_close(alone[wanted].grad, expected, rtol=1e-5, atol=1e-5)


def test_nothing_is_recorded_without_gradients(route: Route):
    inputs = scene(route, 10, 12, 3)
    neighbors = table(inputs, 4)
    with torch.no_grad():
        quiet = route(inputs, neighbors)
    assert quiet.grad_fn is None and torch.equal(quiet, route(inputs, neighbors))


def test_the_backward_pass_keeps_the_inputs_and_four_bytes_per_neighbor(route: Route):
    inputs = scene(route, 50, 12, 16)
    neighbors = table(inputs, 16)
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        route(inputs, neighbors)
    given = {value.untyped_storage().data_ptr() for value in inputs}
    assert sum(size for place, size in kept.items() if place not in given) == 4 * 50 * 16
