"""Annular features on hard point sets: values and gradients are finite and those of a dense float64 sum."""

from importlib.util import find_spec

import pytest
import torch
from torch import Tensor

from tests.stability.backends import IS_INTERPRETED, require_route, routes
from tests.stability.hard_scenes import MODES, SCENES, HardScene, Mode, is_finite, rotation
from vpd_lightning.graph.neighbors import Neighbors, knn
from vpd_lightning.renderer.features.point_features import annular_features, check_kernels
from vpd_lightning.types import Particles

FEATURE_DIM = 5
# Without the fused module there is the plain one alone.
if find_spec("vpd_lightning.renderer.kernels.fused_features") is not None:
    from vpd_lightning.renderer.kernels.fused_features import FEATURE_BACKENDS, fused_annular_features

    ROUTES = ("plain", "auto", *FEATURE_BACKENDS)
else:
    ROUTES = ("plain",)


@pytest.fixture(params=routes(*ROUTES))
def pair(request: pytest.FixtureRequest) -> tuple[str, str]:
    require_route(request.param[0])
    return request.param


@pytest.fixture
def route(pair: tuple[str, str]) -> str:
    return pair[0]


@pytest.fixture
def device(pair: tuple[str, str]) -> torch.device:
    return torch.device(pair[1])


# The interpreter is slow, and test_autocast_changes_nothing says that the third mode is the first one.
@pytest.fixture(
    params=[mode for mode in MODES if not (IS_INTERPRETED and mode.is_autocast)], ids=lambda mode: mode.name
)
def mode(request: pytest.FixtureRequest) -> Mode:
    return request.param


def features_of(route: str, queries: Tensor, particles: Particles, neighbors: Neighbors, spacing: float) -> Tensor:
    kernels = kernels_of(spacing)
    if route == "plain":
        return annular_features(queries, particles, neighbors, *kernels)
    return fused_annular_features(queries, particles, neighbors, *kernels, route)


def kernels_of(spacing: float) -> tuple[list[float], list[float]]:
    return [0.0, spacing, 2 * spacing], [spacing, 0.5 * spacing, 0.5 * spacing]


def latents(count: int, mode: Mode, device: torch.device) -> Tensor:
    generator = torch.Generator().manual_seed(4)
    return torch.randn(count, FEATURE_DIM, generator=generator, dtype=torch.float64).to(device, mode.dtype)


def dense(queries: Tensor, positions: Tensor, features: Tensor, neighbors: Neighbors, spacing: float) -> Tensor:
    """Return the same sums over all pairs in float64; written for clarity, with no route in common."""
    used = torch.zeros(len(queries), len(positions), dtype=queries.dtype, device=queries.device)
    if len(positions):
        used.scatter_add_(1, neighbors.index, neighbors.mask.to(queries.dtype))
    offset = queries[:, None] - positions
    # The square root has no gradient at zero; by definition it is zero there.
    square = offset.square().sum(dim=-1)
    distance = torch.where(square > 0, square, 1.0).sqrt() * (square > 0)
    parts = []
    for radius, bandwidth in zip(*kernels_of(spacing), strict=True):
        parts.append((torch.exp(-(((distance - radius) / bandwidth) ** 2)) * used) @ features)
    return torch.cat(parts, dim=-1)


def uneven_sum(features: Tensor) -> Tensor:
    weights = torch.linspace(0.5, 1.5, max(features.numel(), 1), dtype=features.dtype, device=features.device)
    return (features.flatten() * weights[: features.numel()]).sum()


def gradients_of(features: Tensor, inputs: list[Tensor]) -> list[Tensor]:
    if not features.requires_grad:  # without particles the features are constant
        return [torch.zeros_like(value) for value in inputs]
    return list(torch.autograd.grad(uneven_sum(features), inputs, materialize_grads=True))


def test_values_and_gradients_are_finite_and_those_of_float64(
    scene: HardScene, mode: Mode, route: str, device: torch.device
):
    scene = scene.to(mode, device)
    neighbors = knn(scene.points, scene.queries, 16, backend="torch")
    inputs = [scene.queries, scene.points, latents(len(scene.points), mode, device)]
    inputs = [value.clone().requires_grad_() for value in inputs]
    twins = [value.detach().double().requires_grad_() for value in inputs]

    with mode.context(device):
        features = features_of(route, inputs[0], Particles(*inputs[1:]), neighbors, scene.spacing)
    # As in training, the backward pass is outside autocast, which would lower its products, too.
    gradients = gradients_of(features, inputs)
    expected = dense(*twins, neighbors, scene.spacing)
    expected_gradients = gradients_of(expected, twins)

    assert features.dtype == mode.dtype and is_finite(features, *gradients)
    # A weight is exp(-s^2) with s = (d - r) / b: it errs by 2 s exp(-s^2) < 1 times the error of s, which is a few eps
    # of d / b, and d / b < 13 wherever exp is not zero. Up to 16 terms of size 4 are summed: 2000 eps is ample.
    torch.testing.assert_close(features.double(), expected, rtol=0.0, atol=2000 * mode.eps)
    nearest = (scene.queries.double()[:, None] - scene.points.double()).norm(dim=-1)
    if bool(((nearest > 0) & (nearest < mode.smallest_distance)).any()):
        return  # The squares of these distances vanish, so their directions are lost: only finite can be asked for.
    # Gradients to places have another factor 2 / b; those of duplicates add up over all queries.
    for ours, exact, size in zip(
        gradients, expected_gradients, (2 / scene.spacing, 2 / scene.spacing, 1.0), strict=True
    ):
        torch.testing.assert_close(ours.double(), exact, rtol=1e4 * mode.eps, atol=1e4 * mode.eps * size)


def test_autocast_changes_nothing(scene: HardScene, route: str, device: torch.device):
    scene = HardScene(scene.points.float().to(device), scene.queries.float().to(device), scene.spacing)
    neighbors = knn(scene.points, scene.queries, 16, backend="torch")
    particles = Particles(scene.points, torch.ones(len(scene.points), FEATURE_DIM, device=device))

    plain = features_of(route, scene.queries, particles, neighbors, scene.spacing)
    with torch.autocast(device.type, dtype=torch.bfloat16):
        under_autocast = features_of(route, scene.queries, particles, neighbors, scene.spacing)

    assert torch.equal(plain, under_autocast)


def test_the_gradient_on_a_particle_is_zero_by_definition(mode: Mode, route: str, device: torch.device):
    scene = SCENES["all_the_same"]().to(mode, device)
    neighbors = knn(scene.points, scene.queries[:1], 16, backend="torch")
    query = scene.queries[:1].clone().requires_grad_()
    particles = Particles(scene.points.clone().requires_grad_(), latents(len(scene.points), mode, device))

    uneven_sum(features_of(route, query, particles, neighbors, scene.spacing)).backward()

    assert query.grad is not None and particles.positions.grad is not None
    assert not query.grad.any() and not particles.positions.grad.any()


@pytest.mark.parametrize("shift", [1e3, 1e6])
def test_a_translated_world_has_the_same_features(mode: Mode, route: str, device: torch.device, shift: float):
    # On a grid of 1/8 m coordinates and differences are exact in float32 up to 2^21 m.
    generator = torch.Generator().manual_seed(5)
    points = (torch.randint(-8, 8, (40, 3), generator=generator) / 8).to(device, mode.dtype)
    queries = (torch.randint(-8, 8, (30, 3), generator=generator) / 8).to(device, mode.dtype)
    neighbors = knn(points, queries, 16, backend="torch")
    values = latents(40, mode, device)

    here = features_of(route, queries, Particles(points, values), neighbors, 0.3)
    there = features_of(route, queries + shift, Particles(points + shift, values), neighbors, 0.3)

    assert torch.equal(here, there)


def test_a_rotated_world_has_the_same_features(mode: Mode, route: str, device: torch.device):
    scene, turn = SCENES["ordinary"](), rotation()
    turned = HardScene(scene.points @ turn.T, scene.queries @ turn.T).to(mode, device)
    scene = scene.to(mode, device)
    neighbors = knn(scene.points, scene.queries, 16, backend="torch")
    values = latents(len(scene.points), mode, device)

    here = features_of(route, scene.queries, Particles(scene.points, values), neighbors, scene.spacing)
    there = features_of(route, turned.queries, Particles(turned.points, values), neighbors, scene.spacing)

    # Rotated coordinates are rounded to eps of 1 m: over a bandwidth of 0.05 m that is 20 eps, times 16 terms of 4.
    torch.testing.assert_close(there, here, rtol=0.0, atol=5000 * mode.eps)


def test_the_order_of_particles_does_not_matter(mode: Mode, route: str, device: torch.device):
    scene = SCENES["ordinary"]().to(mode, device)
    order = torch.randperm(len(scene.points), generator=torch.Generator().manual_seed(6)).to(device)
    values = latents(len(scene.points), mode, device)
    tables = [knn(points, scene.queries, 16, backend="torch") for points in (scene.points, scene.points[order])]

    here = features_of(route, scene.queries, Particles(scene.points, values), tables[0], scene.spacing)
    there = features_of(route, scene.queries, Particles(scene.points[order], values[order]), tables[1], scene.spacing)

    # Neighbours come by distance, so even the order of the sums is the same; ties alone could change the last bit.
    torch.testing.assert_close(there, here, rtol=0.0, atol=100 * mode.eps)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_nothing_of_a_masked_neighbor_gets_through(mode: Mode, route: str, device: torch.device, value: float):
    """A table's masked entries point at row 0; whatever stands there must not reach a sum, not even as 0 times NaN."""
    points, values = torch.full((3, 3), value), torch.full((3, FEATURE_DIM), value)
    particles = Particles(
        points.to(device, mode.dtype), values.to(device, mode.dtype), torch.zeros(3, dtype=torch.bool)
    )
    none = torch.zeros(4, 2, dtype=torch.bool, device=device)
    neighbors = Neighbors(none.long(), torch.zeros(4, 2, device=device), none)

    features = features_of(route, torch.zeros(4, 3, device=device, dtype=mode.dtype), particles, neighbors, 0.1)

    assert not features.any() and is_finite(features)


@pytest.mark.parametrize("bad", [torch.nan, -torch.inf])
def test_kernels_that_are_not_numbers_are_refused(bad: float):
    with pytest.raises(ValueError, match="kernel_radii"):
        check_kernels([bad], [0.1])
    with pytest.raises(ValueError, match="kernel_bandwidths"):
        check_kernels([0.1], [bad])


@pytest.mark.parametrize("name", ["kernel_radii", "kernel_bandwidths"])
def test_infinite_kernels_are_refused(name: str):
    kernels = {"kernel_radii": [0.1], "kernel_bandwidths": [0.1]} | {name: [torch.inf]}
    with pytest.raises(ValueError, match=name):
        check_kernels(**kernels)
