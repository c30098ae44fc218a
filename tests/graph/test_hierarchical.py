import pytest
import torch

from vpd_lightning.graph.hierarchical import EdgeSet, HierarchicalGraph, build_graph
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


def pairs(edges: EdgeSet) -> list[tuple[int, int]]:
    return list(zip(*(ends.tolist() for ends in edges.pairs()), strict=True))


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
        assert sorted(pairs(edges)) == sorted(expected)
        assert edges.senders.width == 2 and len(edges.senders.index) == 2 * given.num_particles
    backwards = graph.abstract_to_current
    assert sorted(pairs(backwards)) == sorted((node, particle) for particle, node in pairs(graph.current_to_abstract))
    covered = {particle for _, particle in pairs(backwards)}
    assert graph.is_covered[0].nonzero()[:, 0].tolist() == sorted(covered)


def test_abstract_nodes_within_reach_are_tied_both_ways_without_loops_or_cap() -> None:
    current = particles(1, 200, 3)
    graph = graph_of(current, current, num_abstract_nodes=150, r_a_s=5.0)
    among = pairs(graph.abstract_to_abstract)
    assert len(among) == len(set(among)) == 150 * 149
    assert all(sender != receiver for sender, receiver in among)


def test_with_a_cap_an_abstract_node_receives_from_its_nearest_only() -> None:
    current = particles(2, 200, 3)
    everything = graph_of(current, current, num_abstract_nodes=90, r_a_s=0.9)
    capped = graph_of(current, current, num_abstract_nodes=90, r_a_s=0.9, max_abstract_edges_per_node=5)
    assert torch.equal(everything.abstract_index, capped.abstract_index)
    centers = current.positions.flatten(0, 1)[everything.abstract_index]
    expected: list[tuple[int, int]] = []
    for node in range(180):
        senders = [sender for sender, receiver in pairs(everything.abstract_to_abstract) if receiver == node]
        senders.sort(key=lambda sender, node=node: float((centers[sender] - centers[node]).norm()))
        expected += [(sender, node) for sender in senders[:5]]
    assert sorted(pairs(capped.abstract_to_abstract)) == sorted(expected)


def test_a_cap_holds_among_duplicates() -> None:
    current = particles(1, 30, 3)
    current.positions[:] = 0.25
    among = pairs(graph_of(current, current, max_abstract_edges_per_node=4).abstract_to_abstract)
    assert all(sender != receiver for sender, receiver in among)
    assert all(sum(1 for _, receiver in among if receiver == node) == 4 for node in range(20))


@pytest.mark.parametrize("changes", [{}, {"max_abstract_edges_per_node": 4}])
def test_both_ends_know_the_edges_of_each_node(changes: dict[str, int]) -> None:
    graph = graph_of(particles(2, 70, 0), particles(2, 60, 1), **changes)
    for name in ("previous_to_abstract", "current_to_abstract", "abstract_to_abstract", "abstract_to_current"):
        edges = getattr(graph, name)
        for end, ends in zip((edges.senders, edges.receivers), edges.pairs(), strict=True):
            ones = torch.ones(len(end.index), 1)
            assert torch.equal(end.summed(ones)[:, 0].long(), ends.bincount(minlength=end.num_nodes)), name


def test_edges_among_abstract_nodes_are_sorted_by_receiver() -> None:
    graph = graph_of(particles(2, 70, 0), particles(2, 60, 1))
    assert bool((graph.abstract_to_abstract.receivers.index.diff() >= 0).all())
    assert graph.abstract_to_abstract.receivers.order is None


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
        for name, before in (("previous_to_abstract", 50 * member), ("abstract_to_abstract", 20 * member)):
            here = [(sender - before, node - 20 * member) for sender, node in pairs(getattr(graph, name))]
            assert [edge for edge in here if 0 <= edge[1] < 20] == pairs(getattr(alone, name))


def test_padding_has_no_edges_and_is_never_an_abstract_node() -> None:
    mask = torch.ones(1, 60, dtype=torch.bool)
    mask[0, 5:] = False
    current = particles(1, 60, 1, mask)
    current.positions[~mask] = torch.nan
    graph = graph_of(current, current)
    assert sorted(graph.abstract_index.tolist()) == [0, 1, 2, 3, 4]
    assert {particle for particle, _ in pairs(graph.current_to_abstract)} <= {0, 1, 2, 3, 4}


def test_padding_does_not_change_which_particles_become_abstract_nodes() -> None:
    current = particles(1, 60, 1)
    padded = Particles(
        torch.cat([torch.zeros(1, 7, 3).double(), current.positions], dim=1),
        torch.cat([torch.zeros(1, 7, 4).double(), current.features], dim=1),
        torch.arange(67)[None] >= 7,
    )
    assert torch.equal(graph_of(padded, padded).abstract_index - 7, graph_of(current, current).abstract_index)


def test_every_particle_becomes_an_abstract_node_equally_often() -> None:
    current = particles(1, 40, 1)
    counts = torch.zeros(40)
    for seed in range(400):
        graph = build_graph(
            current, current, [torch.Generator().manual_seed(seed)], num_abstract_nodes=10,
            max_abstract_neighbors=2, r_s=0.4, r_a_s=0.1, backend="torch",
        )  # fmt: skip
        counts[graph.abstract_index] += 1
    # Binomial with p = 1 / 4: 100 +- 8.7; five standard deviations for forty particles.
    assert bool(((counts - 100).abs() < 5 * 8.7).all())


def test_an_empty_scene_gives_an_empty_graph() -> None:
    current = particles(1, 6, 1, torch.zeros(1, 6, dtype=torch.bool))
    graph = graph_of(current, current)
    assert len(graph.abstract_index) == len(graph.abstract_to_abstract.senders.index) == 0
    assert pairs(graph.abstract_to_current) == []
    assert torch.equal(graph.abstract_to_current.receivers.summed(torch.ones(12, 3)), torch.zeros(6, 3))


def test_abstract_nodes_depend_on_the_generator_alone() -> None:
    current = particles(1, 60, 1)
    first, second = graph_of(current, current), graph_of(current, current)
    assert torch.equal(first.abstract_index, second.abstract_index)


@pytest.mark.parametrize("backend", ["scipy", pytest.param("torch_cluster", marks=pytest.mark.cluster), "auto"])
def test_backends_build_the_same_graph(backend: str) -> None:
    previous, current = particles(1, 300, 0), particles(1, 300, 1)
    reference, other = graph_of(previous, current), graph_of(previous, current, backend=backend)
    for name in ("previous_to_abstract", "current_to_abstract", "abstract_to_abstract", "abstract_to_current"):
        assert sorted(pairs(getattr(reference, name))) == sorted(pairs(getattr(other, name)))
