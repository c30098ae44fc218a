import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from vpd_lightning.config import build
from vpd_lightning.config.migrations import upgraded
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.delayed_faults import DelayedFaults
from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.errors import ConfigError, NonFiniteError
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.testing import FEATURE_DIM, DynamicsContract
from vpd_lightning.types import Particles

ROOT = Path(__file__).resolve().parents[2]
SMALL = {
    "feature_dim": FEATURE_DIM,
    "hidden_dim": 12,
    "message_passing_steps": 2,
    "num_abstract_nodes": 64,
    "max_abstract_neighbors": 2,
    "r_s": 0.1,
    "r_a_s": 0.3,
    "location_scale": 0.1,
    "edge_capacity": None,
    "max_abstract_edges_per_node": None,
    "feature_limit": 1e4,
    "zero_init_decoders": False,
    "normalized_edges": False,
    "edge_gain": 1.0,
    "aggregation": "sum",
    "update_features": True,
    "has_driven": False,
    "compile": False,
    "neighbors_backend": "auto",
}


def dynamics_of(**changes: object) -> HierarchicalGNNDynamics:
    torch.manual_seed(0)
    return HierarchicalGNNDynamics(**(SMALL | changes))


def particles(batch: int, count: int, seed: int) -> Particles:
    """Random particles in half a metre with padding that holds NaN."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(batch, count, generator=generator) < 0.8
    padding = torch.where(mask, 0.0, torch.nan)[..., None].double()
    positions = torch.rand(batch, count, 3, generator=generator, dtype=torch.float64) / 2 + padding
    features = torch.rand(batch, count, FEATURE_DIM, generator=generator, dtype=torch.float64) + padding
    return Particles(positions.requires_grad_(), features.requires_grad_(), mask)


class TestStaticShapes(DynamicsContract):
    def build(self) -> HierarchicalGNNDynamics:
        # Room for every pair of the largest scene of these checks, as many as a member has particles.
        return dynamics_of(edge_capacity=3 * 64 * 63)


class TestCappedEdges(DynamicsContract):
    def build(self) -> HierarchicalGNNDynamics:
        return dynamics_of(max_abstract_edges_per_node=4)


@pytest.mark.parametrize("num_abstract_nodes", [12, 64])
@pytest.mark.parametrize("cap", [None, 3])
def test_static_steps_and_their_gradients_are_those_of_exact_steps(num_abstract_nodes: int, cap: int | None) -> None:
    outcomes = []
    for capacity in (None, 6000):
        changes = {"num_abstract_nodes": num_abstract_nodes, "max_abstract_edges_per_node": cap}
        dynamics = dynamics_of(edge_capacity=capacity, **changes).double()
        first, second = start = particles(2, 40, 0), particles(2, 50, 1)
        for rollout_step in range(2):
            following, _ = dynamics(first, second, None, RandomKeys(0, 0, [0, 1]), rollout_step)
            first, second = second, following
        results = [second.positions[second.mask], second.features[second.mask]]
        given = [tensor for one in start for tensor in (one.positions, one.features)]
        loss = sum(one.square().sum() for one in results)
        outcomes.append([*results, *torch.autograd.grad(loss, [*dynamics.parameters(), *given])])
        assert dynamics.last_uncovered_share.item() < 1
    for exact, static in zip(*outcomes, strict=True):
        # float64; sums of tens of terms in another order.
        torch.testing.assert_close(static, exact, rtol=1e-9, atol=1e-9)
    dynamics.check_faults()


def test_another_number_of_abstract_nodes_is_what_a_dynamics_of_that_number_does() -> None:
    previous, current, keys = particles(1, 40, 0), particles(1, 50, 1), RandomKeys(0, 0, [3])
    for capacity in (None, 6000):
        expected = dynamics_of(num_abstract_nodes=9, edge_capacity=capacity).double()(previous, current, None, keys, 2)[
            0
        ]
        found = dynamics_of(edge_capacity=capacity).double().advance(previous, current, keys, 2, num_abstract_nodes=9)
        mask = current.mask
        assert torch.equal(found.positions[mask], expected.positions[mask])
        assert torch.equal(found.features[mask], expected.features[mask])
    with pytest.raises(ValueError, match="num_abstract_nodes"):
        dynamics_of().double().advance(previous, current, keys, 2, num_abstract_nodes=0)


def test_edges_that_do_not_fit_are_an_error_that_names_the_room_they_need() -> None:
    previous, current, keys = particles(1, 40, 0), particles(1, 50, 1), RandomKeys(0, 0, [0])
    dynamics = dynamics_of(edge_capacity=10).double()
    with pytest.raises(ConfigError, match="edge_capacity=10") as caught:
        dynamics(previous, current, None, keys, 0)
    needed = 10 + int(dynamics.last_dropped_edges)
    assert f"edge_capacity={needed}" in str(caught.value)
    enough = dynamics_of(edge_capacity=needed).double()
    enough(previous, current, None, keys, 0)
    assert int(enough.last_dropped_edges) == 0


def test_a_particle_that_is_not_a_number_is_an_error() -> None:
    previous, current = particles(1, 40, 0), particles(1, 50, 1)
    positions = current.positions.detach().clone()
    positions[0, int(current.mask[0].nonzero()[0]), 1] = torch.nan
    with pytest.raises(NonFiniteError, match="1 particles"):
        dynamics_of(edge_capacity=6000).double()(
            previous, Particles(positions, current.features, current.mask), None, RandomKeys(0, 0, [0]), 0
        )


def test_counts_that_are_on_their_way_are_not_waited_for() -> None:
    faults = DelayedFaults()
    on_its_way = torch.tensor([-1, -1])
    faults._pending.append((on_its_way, 7))
    faults.raise_if_known()
    on_its_way.copy_(torch.tensor([3, 0]))
    with pytest.raises(ConfigError, match="3 edges"):
        faults.raise_if_known()
    faults.raise_if_any()


def test_compiling_without_fixed_shapes_is_refused() -> None:
    with pytest.raises(ValueError, match="edge_capacity"):
        dynamics_of(compile=True)
    with pytest.raises(ValueError, match="edge_capacity"):
        dynamics_of(edge_capacity=0)


def test_new_arguments_leave_the_names_of_the_weights_alone() -> None:
    plain, other = dynamics_of(), dynamics_of(edge_capacity=100, compile=True, max_abstract_edges_per_node=3)
    assert list(plain.state_dict()) == list(other.state_dict())


def test_a_configuration_from_before_the_new_arguments_means_what_it_meant() -> None:
    target = "vpd_lightning.dynamics.hierarchical_gnn.HierarchicalGNNDynamics"
    names = ("edge_capacity", "max_abstract_edges_per_node", "compile")
    old = {name: value for name, value in SMALL.items() if name not in names}
    section = upgraded({"dynamics": {"_target_": target, **old}})["dynamics"]
    dynamics = build(section, AbstractDynamics, "dynamics")
    assert dynamics.edge_capacity is None and dynamics.max_abstract_edges_per_node is None
    assert not dynamics.is_compiled


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, {"edge_capacity": 40_000}])
def test_two_runs_on_several_threads_are_equal_bit_for_bit(changes: dict[str, int]) -> None:
    runs = []
    torch.set_num_threads(4)
    try:
        for _ in range(2):
            dynamics = dynamics_of(num_abstract_nodes=200, hidden_dim=64, **changes)
            previous, current = particles(1, 3000, 0).to(torch.float32), particles(1, 3000, 1).to(torch.float32)
            positions, features = (
                current.positions.detach().requires_grad_(),
                current.features.detach().requires_grad_(),
            )
            following, _ = dynamics(
                previous, Particles(positions, features, current.mask), None, RandomKeys(0, 0, [0]), 0
            )
            mask = current.mask
            (following.positions[mask].square().sum() + following.features[mask].square().sum()).backward()
            gradients = [parameter.grad for parameter in dynamics.parameters()]
            runs.append(
                [following.positions[mask], following.features[mask], positions.grad, features.grad, *gradients]
            )
    finally:
        torch.set_num_threads(1)
    assert all(torch.equal(one, other) for one, other in zip(*runs, strict=True))


def compile_with(backend: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).with_name("compile_static_step.py")), backend]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.exhaustive
def test_the_static_step_compiles_in_one_graph_and_gives_the_same() -> None:
    result = compile_with("aot_eager")
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.slow
@pytest.mark.gpu
def test_the_static_step_compiles_to_kernels() -> None:
    result = compile_with("inductor")
    assert result.returncode == 0, result.stdout + result.stderr
