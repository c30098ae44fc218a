"""Every dynamics of conf/ on hard scenes, in long rollouts, and in moved worlds."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.stability.hard_scenes import SCENES, SPACING, HardScene, Mode, cloud, is_finite
from tests.stability.known_faults import known_fault
from tests.stability.stages import matrix, options, particles_at, stage, variant
from vpd_lightning.dynamics.blocks import FullPrecisionLayerNorm
from vpd_lightning.graph.incidence import Incidence, gather_to_edges
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.testing.particle_sets import reordered
from vpd_lightning.types import Particles

KEYS = RandomKeys(seed=1, step=2, sample_index=[0])
FLOAT64 = Mode("float64", torch.float64)


@pytest.fixture(params=options("dynamics"))
def option(request: pytest.FixtureRequest) -> str:
    return request.param


def pair_at(
    positions: Tensor, mode: Mode, device: torch.device, spacing: float = SPACING
) -> tuple[Particles, Particles]:
    """Return two observed states: the earlier one a tenth of a spacing to the side, without correspondences."""
    current = particles_at(positions, mode, device)
    earlier = particles_at((positions - 0.1 * spacing).flip(0), mode, device, seed=1)
    return replace(earlier, moving=earlier.moving.flip(1)), current


def rolled(
    dynamics: nn.Module, pair: tuple[Particles, Particles], mode: Mode, device: torch.device, num_steps: int = 2
) -> list[Particles]:
    previous, current = pair
    states = [current]
    with mode.context(device):
        memory: Any = dynamics.initialize(previous, current, KEYS)
        for step in range(num_steps):
            following, memory = dynamics(previous, current, memory, KEYS, step)
            previous, current = current, following
            states.append(following)
    return states


@pytest.mark.filterwarnings("ignore:.*does not require grad")
@pytest.mark.parametrize("choice, mode", matrix("dynamics"))
def test_states_and_gradients_are_finite(
    choice: tuple[str, str], scene: HardScene, mode: Mode, device: torch.device, request: pytest.FixtureRequest
):
    # Bodies 1e6 m wide beside details of 0.1 m: products of float32 coordinates are off by 1e5 square metres.
    is_wide = request.node.callspec.params["scene"] in ("all_scales_at_once", "clusters_1e6_apart")
    known_fault(request, "negative_squares", is_wide and choice[0] == "inertial" and mode.dtype == torch.float32)
    dynamics = variant("dynamics", choice, mode, device, scale=scene.spacing / SPACING)
    previous, current = pair_at(scene.points, mode, device, scene.spacing)
    inputs = [value.clone().requires_grad_() for value in (current.positions, current.features)]
    current = replace(current, positions=inputs[0], features=inputs[1])

    states = rolled(dynamics, (previous, current), mode, device)
    total = sum(((state.positions.diff(dim=1) / scene.spacing).sum() + state.features.sum()) for state in states)
    weights = [p for p in dynamics.parameters() if p.requires_grad]
    gradients = torch.autograd.grad(total, [*inputs, *weights], materialize_grads=True)

    assert all(state.positions.dtype == state.features.dtype == mode.dtype for state in states)
    assert all(is_finite(state.positions, state.features) for state in states)
    assert is_finite(*gradients)


@pytest.mark.parametrize("name", ["ordinary", "one_particle", "k_plus_1_particles", "on_a_line"])
def test_float32_steps_are_those_of_float64(
    option: str, name: str, device: torch.device, request: pytest.FixtureRequest
):
    known_fault(request, "equally_near", (option, name) == ("inertial", "on_a_line"))
    single, points = Mode("float32", torch.float32), SCENES[name]().points.float().double()
    first, second = (stage("dynamics", option, mode, device).eval() for mode in (single, FLOAT64))
    second.load_state_dict(first.state_dict())
    pair = pair_at(points, single, device)
    twin = tuple(replace(p.to(torch.float64)) for p in pair)

    ours, exact = rolled(first, pair, single, device)[-1], rolled(second, twin, FLOAT64, device)[-1]

    # Networks of gain about one: a hundred eps of the metre that the scene is wide.
    torch.testing.assert_close(ours.positions.double(), exact.positions, rtol=0, atol=1e-4)
    torch.testing.assert_close(ours.features.double(), exact.features, rtol=0, atol=1e-3)


@pytest.mark.parametrize("shift", [10.0, 1e3])
def test_a_translated_world_moves_in_the_same_way(option: str, shift: float, mode: Mode, device: torch.device):
    # Multiples of 2^-10 m up to 1024 m are exact in float32, so both worlds are the same but for where they are.
    offset = torch.tensor([1.0, -0.5, 0.25], dtype=torch.float64).to(device, mode.dtype) * round(shift)
    dynamics = stage("dynamics", option, mode, device).eval()
    pair = tuple(replace(p, positions=(p.positions * 1024).round() / 1024) for p in pair_at(cloud(), mode, device))

    here = rolled(dynamics, pair, mode, device, 1)[-1]
    there = rolled(dynamics, tuple(replace(p, positions=p.positions + offset) for p in pair), mode, device, 1)[-1]

    # The answer itself is rounded to the spacing of numbers there (1e3 m in float32: 6e-5 m). Only relative places are
    # seen, so before that nothing more than a few such roundings is lost.
    tolerance = max(1e-5, 32 * mode.eps * shift)
    torch.testing.assert_close(there.positions - offset, here.positions, rtol=0, atol=tolerance)
    torch.testing.assert_close(there.features, here.features, rtol=0, atol=max(1e-4, 320 * mode.eps * shift))


@pytest.mark.parametrize("size", [1e4, 1e30])
def test_a_saturated_tanh_moves_by_the_location_scale(size: float, mode: Mode, device: torch.device):
    dynamics = stage("dynamics", "hierarchical_gnn", mode, device)
    with torch.no_grad():
        dynamics.decode_location.layers[-1].bias.copy_(torch.tensor([size, -size, size]))
    previous, current = pair_at(cloud(), mode, device)

    _, following = rolled(dynamics, (previous, current), mode, device, 1)
    gradients = torch.autograd.grad(following.positions.sum(), list(dynamics.parameters()), materialize_grads=True)

    step = (following.positions - current.positions).abs()
    expected = torch.full_like(step, dynamics.location_scale)
    torch.testing.assert_close(step, expected, rtol=0, atol=4 * mode.eps)  # positions of about a metre are rounded
    assert is_finite(following.features, *gradients)


@pytest.mark.parametrize("size", [0.0, 1e-40, 1e-20, 1e3, 1e6])
def test_features_of_any_size(option: str, size: float, mode: Mode, device: torch.device):
    dynamics = stage("dynamics", option, mode, device)
    pair = tuple(replace(p, features=p.features * size) for p in pair_at(cloud(), mode, device))

    following = rolled(dynamics, pair, mode, device, 1)[-1]
    weights = [p for p in dynamics.parameters() if p.requires_grad]
    total = following.positions.sum() + following.features.sum() / max(1.0, size)

    assert is_finite(following.positions, following.features)
    if total.requires_grad:
        assert is_finite(*torch.autograd.grad(total, weights, materialize_grads=True))


def test_isolated_particles_and_lonely_abstract_nodes(mode: Mode, device: torch.device):
    """Kilometres apart: no particle but the chosen ones reaches an abstract node, no two abstract nodes are tied."""
    dynamics = stage("dynamics", "hierarchical_gnn", mode, device, num_abstract_nodes=3)
    previous, current = pair_at(cloud() * 1e4, mode, device)

    _, following = rolled(dynamics, (previous, current), mode, device, 1)
    gradients = torch.autograd.grad(
        (following.positions - current.positions).sum() + following.features.sum(),
        list(dynamics.parameters()),
        materialize_grads=True,
    )

    assert dynamics.last_uncovered_share is not None and dynamics.last_uncovered_share > 0.9
    assert is_finite(following.positions, following.features, *gradients)


@pytest.mark.parametrize("size", [0.0, 1e-45, 1e-30, 1.0, 1e10])
@pytest.mark.parametrize("is_constant", [False, True])
def test_layer_norm_of_rows_without_variance(size: float, is_constant: bool, mode: Mode, device: torch.device):
    norm = FullPrecisionLayerNorm(16).to(device, mode.dtype)
    row = torch.ones(16, dtype=torch.float64) if is_constant else torch.linspace(-1, 1, 16, dtype=torch.float64)
    inputs = (size * row).expand(4, 16).to(device, mode.dtype).clone().requires_grad_()

    with mode.context(device):
        outputs = norm(inputs)
    (gradient,) = torch.autograd.grad((outputs * torch.linspace(0, 1, 16, device=device)).sum(), inputs)

    assert outputs.dtype == mode.dtype and is_finite(outputs, gradient)
    # The variance's floor bounds what a gradient can grow by: 1 / sqrt(eps), and eps is at least 1e-5.
    assert norm.eps >= 1e-5 and gradient.abs().max() <= norm.eps**-0.5
    if is_constant or size == 0.0:
        # A constant row has no deviation but the rounding of its mean, measured by the floor of the variance.
        assert outputs.abs().max() <= max(1e-6, 4 * mode.eps * size / norm.eps**0.5)


@pytest.mark.parametrize("num_nodes, num_edges", [(0, 0), (5, 0), (5, 1), (1, 7)])
def test_sums_over_nodes_without_edges(num_nodes: int, num_edges: int, mode: Mode, device: torch.device):
    edges = torch.ones(num_edges, 4, device=device, dtype=mode.dtype).requires_grad_()
    receivers = torch.full((num_edges,), max(0, num_nodes - 1), device=device)

    with mode.context(device):
        sums = Incidence.of(receivers, num_nodes).summed(edges)

    assert sums.shape == (num_nodes, 4) and sums.sum() == 4 * num_edges and is_finite(sums)
    if num_edges:
        assert (torch.autograd.grad(sums.sum(), edges)[0] == 1).all()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("is_table", [False, True])
def test_nothing_of_an_edge_that_is_padding_gets_out(is_table: bool, value: float, mode: Mode, device: torch.device):
    mask = torch.tensor([[True, False], [False, False], [True, True]], device=device)
    index = torch.where(mask, torch.arange(3, device=device)[:, None], 3).flatten()
    edges = torch.where(mask.flatten()[:, None], 1.0, value).to(mode.dtype).expand(6, 4).clone().requires_grad_()
    incidence = Incidence.of_table(mask) if is_table else Incidence.of(index, 3)

    with mode.context(device):
        sums = incidence.summed(edges)
        rows = gather_to_edges(torch.ones(3, 4, device=device, dtype=mode.dtype), incidence)
    (gradient,) = torch.autograd.grad(sums.sum(), edges)

    assert sums[:, 0].tolist() == [1.0, 0.0, 2.0]
    assert torch.equal(gradient[:, 0].bool(), mask.flatten()) and torch.equal(rows[:, 0].bool(), mask.flatten())


def test_a_step_repeats_bit_for_bit(option: str, mode: Mode, device: torch.device):
    dynamics = stage("dynamics", option, mode, device).eval()
    pair = pair_at(cloud(), mode, device)

    first, second = (rolled(dynamics, pair, mode, device)[-1] for _ in range(2))

    assert torch.equal(first.positions, second.positions) and torch.equal(first.features, second.features)


def test_the_order_of_particles_does_not_matter(option: str, mode: Mode, device: torch.device):
    """With an abstract node on each particle nothing is drawn; probes and matches are more than there are particles."""
    dynamics = stage("dynamics", option, mode, device, num_abstract_nodes=1000).eval()
    previous, current = pair_at(cloud(), mode, device)
    order = torch.randperm(current.num_particles, generator=torch.Generator().manual_seed(8)).to(device)

    here = rolled(dynamics, (previous, current), mode, device, 1)[-1]
    there = rolled(dynamics, (previous, reordered(current, order)), mode, device, 1)[-1]

    # Sums in another order; bfloat16 factors may fall on the other side of a rounding (2^-9).
    share = 2e-2 if mode.is_autocast else 1e-4
    torch.testing.assert_close(there.positions, here.positions[:, order], rtol=0, atol=share)
    torch.testing.assert_close(there.features, here.features[:, order], rtol=0, atol=5 * share)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [100, 300, pytest.param(1000, marks=pytest.mark.exhaustive)])
def test_many_steps_stay_finite_and_drift_no_faster_than_the_tanh_allows(
    option: str, steps: int, mode: Mode, device: torch.device
):
    dynamics = stage("dynamics", option, mode, device).eval()
    with torch.no_grad():
        states = rolled(dynamics, pair_at(cloud(40), mode, device), mode, device, steps)

    positions = torch.stack([state.positions for state in states])
    assert is_finite(positions, states[-1].features)
    scale = getattr(getattr(dynamics, "dynamics", dynamics), "location_scale", None)  # of what sleeping wraps, too
    if scale is not None:
        # Each step adds scale * tanh: at most the scale, plus the rounding of the sum.
        limit = scale + 2 * mode.eps * positions.abs().max()
        assert (positions.diff(dim=0).abs() <= limit).all()


def test_features_that_feed_on_themselves_stay_finite(mode: Mode, device: torch.device, request: pytest.FixtureRequest):
    """The next features are these plus a function of them, which may be larger: what trained weights do late."""
    known_fault(request, "features_unbounded")
    dynamics = stage("dynamics", "hierarchical_gnn", mode, device).eval()
    with torch.no_grad():
        dynamics.decode_feature.layers[-1].weight.mul_(1e6)  # float64 overflows within sixty steps, too

        states = rolled(dynamics, pair_at(cloud(30), mode, device), mode, device, 100)

    assert all(is_finite(state.positions, state.features) for state in states)
