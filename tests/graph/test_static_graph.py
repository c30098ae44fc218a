import pytest
import torch

from vpd_lightning.graph.hierarchical import EdgeSet, HierarchicalGraph, build_graph, draw_priorities
from vpd_lightning.graph.static_graph import StaticGraph, build_static_graph
from vpd_lightning.types import Particles

OPTIONS = {"num_abstract_nodes": 20, "max_abstract_neighbors": 2, "r_s": 0.4, "r_a_s": 0.9}
NAMES = ("previous_to_abstract", "current_to_abstract", "abstract_to_abstract", "abstract_to_current")


def particles(batch: int, count: int, seed: int, share_valid: float = 1.0) -> Particles:
    """Random particles with padding anywhere; the padding holds NaN."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(batch, count, generator=generator) < share_valid
    positions = torch.rand(batch, count, 3, generator=generator) * 2 - 1
    positions[~mask] = torch.nan
    return Particles(positions, torch.rand(batch, count, 4, generator=generator), mask)


def both(
    previous: Particles, current: Particles, capacity: int = 2000, **changes: object
) -> tuple[HierarchicalGraph, StaticGraph]:
    def generators() -> list[torch.Generator]:
        return [torch.Generator().manual_seed(seed) for seed in range(len(current.mask))]

    options = OPTIONS | changes
    exact = build_graph(previous, current, generators(), backend="torch", **options)
    priorities = draw_priorities(generators(), current.num_particles)
    return exact, build_static_graph(previous, current, priorities, edge_capacity=capacity, **options)


def by_particle(edges: EdgeSet, name: str, graph: HierarchicalGraph) -> list[tuple[int, int]]:
    """Edges with abstract nodes named by the particle they sit on: slots without particle do not count as nodes."""
    senders, receivers = edges.pairs()
    sender_type, receiver_type = name.split("_to_")
    senders = graph.abstract_index[senders] if sender_type == "abstract" else senders
    receivers = graph.abstract_index[receivers] if receiver_type == "abstract" else receivers
    return sorted(zip(senders.tolist(), receivers.tolist(), strict=True))


# 12 valid particles on average are fewer than the 20 abstract nodes asked for; 15 slots are, too.
@pytest.mark.parametrize(("count", "share_valid"), [(70, 1.0), (70, 0.7), (70, 0.17), (15, 1.0), (1, 1.0), (30, 0.0)])
@pytest.mark.parametrize("changes", [{}, {"max_abstract_neighbors": 6}, {"max_abstract_edges_per_node": 3}])
def test_the_static_graph_is_the_exact_graph(count: int, share_valid: float, changes: dict[str, int]) -> None:
    previous, current = particles(2, 60, 0, 0.8), particles(2, count, 1, share_valid)
    exact, built = both(previous, current, **changes)
    assert int(built.dropped_edges) == int(built.non_finite) == 0
    assert torch.equal(built.graph.is_covered, exact.is_covered)
    for name in NAMES:
        assert by_particle(getattr(built.graph, name), name, built.graph) == by_particle(
            getattr(exact, name), name, exact
        ), name


def test_both_ends_know_the_edges_of_each_node() -> None:
    _, built = both(particles(2, 70, 0), particles(2, 60, 1, 0.5))
    for name in NAMES:
        edges = getattr(built.graph, name)
        for end, ends in zip((edges.senders, edges.receivers), edges.pairs(), strict=True):
            ones = torch.ones(len(end.index), 1)
            assert torch.equal(end.summed(ones)[:, 0].long(), ends.bincount(minlength=end.num_nodes)), name


def test_the_edge_that_runs_the_other_way_is_found_without_a_sort() -> None:
    _, built = both(particles(2, 70, 0), particles(2, 60, 1))
    edges = built.graph.abstract_to_abstract
    senders, receivers = edges.pairs()
    backward = edges.senders.order[: len(senders)]
    assert torch.equal(senders[backward], receivers) and torch.equal(receivers[backward], senders)


def test_shapes_do_not_depend_on_where_particles_are() -> None:
    def shapes(current: Particles) -> list[torch.Size]:
        graph = both(current, current, capacity=500)[1].graph
        ends = [end for name in NAMES for end in (getattr(graph, name).senders, getattr(graph, name).receivers)]
        return [end.index.shape for end in ends] + [graph.abstract_index.shape]

    spread, together = particles(2, 40, 0), particles(2, 40, 0, 0.4)
    assert shapes(spread) == shapes(Particles(spread.positions * 100, spread.features)) == shapes(together)


@pytest.mark.parametrize("capacity", [1, 50])
def test_edges_that_do_not_fit_are_counted_and_point_nowhere_else(capacity: int) -> None:
    current = particles(1, 70, 0)
    exact, built = both(current, current, capacity)
    num_edges = len(exact.abstract_to_abstract.senders.index)
    assert int(built.dropped_edges) == num_edges - capacity > 0
    assert len(built.graph.abstract_to_abstract.pairs()[0]) == capacity


def test_particles_that_are_not_finite_are_counted() -> None:
    previous, current = particles(2, 60, 0, 0.8), particles(2, 60, 1, 0.8)
    current.positions[1, int(current.mask[1].nonzero()[0])] = torch.inf
    options = OPTIONS | {"edge_capacity": 500}
    priorities = draw_priorities([torch.Generator(), torch.Generator()], 60)
    assert int(build_static_graph(previous, current, priorities, **options).non_finite) == 1


@pytest.mark.gpu
def test_the_static_graph_never_waits_for_the_device() -> None:
    previous, current = particles(2, 500, 0, 0.8).to("cuda"), particles(2, 500, 1, 0.8).to("cuda")
    priorities = draw_priorities([torch.Generator(), torch.Generator()], 500).to("cuda")
    torch.cuda.set_sync_debug_mode("error")
    try:
        build_static_graph(previous, current, priorities, edge_capacity=2000, **OPTIONS)
    finally:
        torch.cuda.set_sync_debug_mode("default")
