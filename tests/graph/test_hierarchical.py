import pytest
import torch

from vpd_lightning.graph.hierarchical import HierarchicalGraph, build_graph
from vpd_lightning.types import Particles


def particles(batch: int, count: int, seed: int, mask: torch.Tensor | None = None) -> Particles:
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(batch, count, 3, generator=generator, dtype=torch.float64) * 2 - 1
    features = torch.rand(batch, count, 4, generator=generator, dtype=torch.float64)
    return Particles(positions, features, torch.ones(batch, count, dtype=torch.bool) if mask is None else mask)


def graph_of(previous: Particles, current: Particles, **changes: object) -> HierarchicalGraph:
    options = {"num_abstract_nodes": 20, "max_abstract_neighbors": 2, "r_s": 0.4, "r_a_s": 0.9, "backend": "torch"}
    generators = [torch.Generator().manual_seed(7) for _ in range(len(current.mask))]
    return build_graph(previous, current, generators, **(options | changes))


def test_particles_are_tied_to_their_two_nearest_abstract_nodes_within_reach() -> None:
    previous, current = particles(1, 70, 0), particles(1, 60, 1)
    graph = graph_of(previous, current)
    centers = current.positions[0, graph.abstract_index]
    assert len(set(graph.abstract_index.tolist())) == 20
    for given, edges in ((previous, graph.previous_to_abstract), (current, graph.current_to_abstract)):
        distances = (given.positions[0][:, None] - centers[None]).norm(dim=-1)
        expected = {
            (particle, int(node))
            for particle, row in enumerate(distances)
            for node in row.argsort()[:2]
            if row[node] <= 0.4
        }
        assert set(zip(edges.senders.tolist(), edges.receivers.tolist(), strict=True)) == expected
        assert len(edges.senders) == len(expected)
    backwards = graph.abstract_to_current
    assert set(zip(backwards.receivers.tolist(), backwards.senders.tolist(), strict=True)) == set(
        zip(graph.current_to_abstract.senders.tolist(), graph.current_to_abstract.receivers.tolist(), strict=True)
    )
    covered = set(backwards.receivers.tolist())
    assert graph.is_covered[0].nonzero()[:, 0].tolist() == sorted(covered)


def test_abstract_nodes_within_reach_are_tied_both_ways_without_loops_or_cap() -> None:
    current = particles(1, 200, 3)
    graph = graph_of(current, current, num_abstract_nodes=150, r_a_s=5.0)
    edges = graph.abstract_to_abstract
    assert len(edges.senders) == 150 * 149
    assert not bool((edges.senders == edges.receivers).any())


def test_edges_are_sorted_by_receiver_and_offsets_cut_them() -> None:
    graph = graph_of(particles(2, 70, 0), particles(2, 60, 1))
    for name in ("previous_to_abstract", "current_to_abstract", "abstract_to_abstract", "abstract_to_current"):
        edges = getattr(graph, name)
        assert bool((edges.receivers.diff() >= 0).all())
        counts = edges.receivers.bincount(minlength=len(edges.receiver_offsets) - 1)
        assert torch.equal(edges.receiver_offsets.diff(), counts)


def test_a_batch_is_its_members_side_by_side() -> None:
    previous, current = particles(3, 50, 0), particles(3, 40, 1)
    graph = graph_of(previous, current)
    for member in range(3):
        alone = graph_of(
            Particles(previous.positions[member : member + 1], previous.features[member : member + 1]),
            Particles(current.positions[member : member + 1], current.features[member : member + 1]),
        )
        part = slice(20 * member, 20 * (member + 1))
        assert torch.equal(graph.abstract_index[part] - 40 * member, alone.abstract_index)
        inside = (graph.previous_to_abstract.receivers // 20) == member
        assert torch.equal(graph.previous_to_abstract.senders[inside] - 50 * member, alone.previous_to_abstract.senders)
        inside = (graph.abstract_to_abstract.receivers // 20) == member
        assert torch.equal(graph.abstract_to_abstract.senders[inside] - 20 * member, alone.abstract_to_abstract.senders)


def test_padding_has_no_edges_and_is_never_an_abstract_node() -> None:
    mask = torch.ones(1, 60, dtype=torch.bool)
    mask[0, 5:] = False
    current = particles(1, 60, 1, mask)
    current.positions[~mask] = torch.nan
    graph = graph_of(current, current)
    assert sorted(graph.abstract_index.tolist()) == [0, 1, 2, 3, 4]
    assert set(graph.current_to_abstract.senders.tolist()) <= {0, 1, 2, 3, 4}


def test_an_empty_scene_gives_an_empty_graph() -> None:
    current = particles(1, 6, 1, torch.zeros(1, 6, dtype=torch.bool))
    graph = graph_of(current, current)
    assert len(graph.abstract_index) == len(graph.abstract_to_abstract.senders) == 0
    assert graph.abstract_to_current.receiver_offsets.tolist() == [0] * 7


def test_abstract_nodes_depend_on_the_generator_alone() -> None:
    current = particles(1, 60, 1)
    first, second = graph_of(current, current), graph_of(current, current)
    assert torch.equal(first.abstract_index, second.abstract_index)


@pytest.mark.parametrize("backend", ["scipy", pytest.param("torch_cluster", marks=pytest.mark.cluster), "auto"])
def test_backends_build_the_same_graph(backend: str) -> None:
    previous, current = particles(1, 300, 0), particles(1, 300, 1)
    reference, other = graph_of(previous, current), graph_of(previous, current, backend=backend)
    for name in ("previous_to_abstract", "current_to_abstract", "abstract_to_abstract", "abstract_to_current"):
        assert torch.equal(getattr(reference, name).receivers, getattr(other, name).receivers)
        assert set(getattr(reference, name).senders.tolist()) == set(getattr(other, name).senders.tolist())
