"""The dynamics' graph: previous and current particles around a sparse layer of abstract nodes (paper, figure 2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from vpd_lightning.graph.neighbors import PointIndex
from vpd_lightning.types import Particles


@dataclass(frozen=True)
class EdgeSet:
    """Directed edges of one type, sorted by receiver; node indices are flat, counted over the whole batch."""

    senders: Int64[Tensor, " edge"]
    receivers: Int64[Tensor, " edge"]
    receiver_offsets: Int64[Tensor, " node_plus_one"]

    @classmethod
    def of(cls, senders: Int64[Tensor, " edge"], receivers: Int64[Tensor, " edge"], num_receivers: int) -> "EdgeSet":
        """Sort edges by receiver (edges of one receiver keep their order) and find where each receiver starts."""
        receivers, order = receivers.sort(stable=True)
        bounds = torch.arange(num_receivers + 1, device=receivers.device)
        return cls(senders.index_select(0, order), receivers, torch.searchsorted(receivers, bounds))


@dataclass(frozen=True)
class HierarchicalGraph:
    """Edge sets between particles and abstract nodes; abstract node j sits on current particle ``abstract_index[j]``.

    ``is_covered`` tells which current particles have an abstract node within reach.
    """

    abstract_index: Int64[Tensor, " abstract_node"]
    previous_to_abstract: EdgeSet
    current_to_abstract: EdgeSet
    abstract_to_abstract: EdgeSet
    abstract_to_current: EdgeSet
    is_covered: Bool[Tensor, "batch particle"]


@torch.no_grad()
def build_graph(
    previous: Particles,
    current: Particles,
    generators: list[torch.Generator],
    *,
    num_abstract_nodes: int,
    max_abstract_neighbors: int,
    r_s: float,
    r_a_s: float,
    backend: str,
) -> HierarchicalGraph:
    """Build the graph of each batch member and put them side by side (paper section 3.2, Graph construction).

    ``num_abstract_nodes`` of the valid current particles (all, where there are fewer) are chosen uniformly without
    replacement. Each valid particle of both times is tied to its nearest abstract nodes, at most
    ``max_abstract_neighbors`` and within ``r_s`` metres; current particles get the same ties backwards. Abstract
    nodes within ``r_a_s`` metres of each other are tied in both directions, all of them, without self loops.
    Indices into particles count ``batch * particle``; padding has no edges.

    Raises:
        NonFiniteError: when a valid particle is not finite.
        ValueError: when there is not one generator per batch member.
    """
    batch_size, num_current = current.mask.shape
    num_previous = previous.mask.shape[1]
    if len(generators) != batch_size:
        raise ValueError(f"One generator per batch member is needed: got {len(generators)} for {batch_size}.")
    device = current.positions.device
    covered = torch.zeros_like(current.mask)
    parts: dict[str, list[tuple[Tensor, Tensor]]] = {"previous": [], "current": [], "abstract": []}
    chosen, num_abstract = [], 0
    for member, generator in enumerate(generators):
        valid_current = current.mask[member].nonzero()[:, 0]
        order = torch.randperm(len(valid_current), generator=generator)[:num_abstract_nodes]
        members_choice = valid_current.index_select(0, order.to(device))
        centers = current.positions[member].index_select(0, members_choice)
        index = PointIndex(centers, backend, is_graph=True)
        valid_previous = previous.mask[member].nonzero()[:, 0]
        for name, particles, valid, size in (
            ("previous", previous, valid_previous, num_previous),
            ("current", current, valid_current, num_current),
        ):
            positions = particles.positions[member].index_select(0, valid)
            near = index.knn(positions, max_abstract_neighbors, r_s)
            particle = (valid + member * size)[:, None].expand_as(near.index)[near.mask]
            parts[name].append((particle, near.index[near.mask] + num_abstract))
            if name == "current":
                covered[member, valid] = near.mask.any(dim=1)
        senders, receivers = PointIndex(centers, backend, is_radius=True, is_graph=True).radius(centers, r_a_s)
        is_other = senders != receivers
        parts["abstract"].append((senders[is_other] + num_abstract, receivers[is_other] + num_abstract))
        chosen.append(members_choice + member * num_current)
        num_abstract += len(members_choice)

    def joined(name: str) -> tuple[Tensor, Tensor]:
        return tuple(torch.cat(column) for column in zip(*parts[name], strict=True))  # type: ignore[return-value]

    previous_particle, previous_abstract = joined("previous")
    current_particle, current_abstract = joined("current")
    return HierarchicalGraph(
        abstract_index=torch.cat(chosen),
        previous_to_abstract=EdgeSet.of(previous_particle, previous_abstract, num_abstract),
        current_to_abstract=EdgeSet.of(current_particle, current_abstract, num_abstract),
        abstract_to_abstract=EdgeSet.of(*joined("abstract"), num_abstract),
        abstract_to_current=EdgeSet.of(current_abstract, current_particle, batch_size * num_current),
        is_covered=covered,
    )
