"""Compile the static step without a graph break and compare it with the exact one; argument: torch.compile's backend.

A script and not a test, because the shape checks that run under pytest break torch.compile.
"""

import sys
import time
from typing import Any

import torch

from vpd_lightning.dynamics import hierarchical_gnn
from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles

SMALL = {
    "feature_dim": 4,
    "hidden_dim": 16,
    "message_passing_steps": 1,
    "num_abstract_nodes": 12,
    "max_abstract_neighbors": 2,
    "r_s": 0.4,
    "r_a_s": 0.9,
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
    "neighbors_backend": "torch",
}


def particles(count: int, seed: int) -> Particles:
    """Two members with padding that holds NaN."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(2, count, generator=generator) < 0.8
    padding = torch.where(mask, 0.0, torch.nan)[..., None].double()
    positions = torch.rand(2, count, 3, generator=generator, dtype=torch.float64) + padding
    features = torch.rand(2, count, 4, generator=generator, dtype=torch.float64) + padding
    return Particles(positions.requires_grad_(), features.requires_grad_(), mask)


def outcome(**changes: Any) -> list[torch.Tensor]:
    """Return what a step predicts for valid particles, and all gradients."""
    torch.manual_seed(0)
    dynamics = HierarchicalGNNDynamics(**(SMALL | changes)).double()
    start = previous, current = particles(40, 0), particles(50, 1)
    following, _ = dynamics(previous, current, None, RandomKeys(0, 0, [0, 1]), 0)
    results = [following.positions[following.mask], following.features[following.mask]]
    given = [tensor for one in start for tensor in (one.positions, one.features)]
    gradients = torch.autograd.grad(sum(one.square().sum() for one in results), [*dynamics.parameters(), *given])
    return [*results, *gradients]


def main(backend: str) -> None:
    """Exit with an error where the compiled step breaks or differs."""
    start = time.process_time()
    compiled = torch.compile(hierarchical_gnn.static_step, fullgraph=True, dynamic=False, backend=backend)
    hierarchical_gnn.compiled_step = lambda device_type: compiled  # the same step for a backend of choice
    exact = outcome()
    for found, expected in zip(outcome(edge_capacity=300, compile=True), exact, strict=True):
        # float64; sums of tens of terms in another order.
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] >= 1, "nothing was compiled"
    print(f"{backend}: the same in one graph, {time.process_time() - start:.0f} s")


if __name__ == "__main__":
    main(sys.argv[1])
