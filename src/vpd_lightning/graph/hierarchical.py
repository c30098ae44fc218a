"""The dynamics' graph: previous and current particles around a sparse layer of abstract nodes (paper, figure 2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from vpd_lightning.graph.incidence import Incidence
from vpd_lightning.graph.neighbors import PointIndex
from vpd_lightning.types import Driven, Particles


@dataclass(frozen=True)
class EdgeSet:
    """Directed edges of one type, by their two ends; nodes are counted over the whole batch."""

    senders: Incidence
    receivers: Incidence

    def reversed(self) -> "EdgeSet":
        """Return the same edges the other way round."""
        return EdgeSet(self.receivers, self.senders)

    def pairs(self) -> tuple[Int64[Tensor, " edge"], Int64[Tensor, " edge"]]:
        """Return sender and receiver of every edge that is none of the padding."""
        is_edge = (self.senders.index < self.senders.num_nodes) & (self.receivers.index < self.receivers.num_nodes)
        return self.senders.index[is_edge], self.receivers.index[is_edge]


@dataclass(frozen=True)
class HierarchicalGraph:
    """Edge sets between particles and abstract nodes; abstract node j sits on current particle ``abstract_index[j]``.

    The edges at particles are a table, a fixed number for each particle with padding where there is no abstract node
    in reach; both directions between current particles and abstract nodes share one. The edges among abstract nodes
    are sorted by receiver. ``is_covered`` tells which current particles have an abstract node within reach. Driven
    points, where the current particles have some, send to abstract nodes and receive nothing.
    """

    abstract_index: Int64[Tensor, " abstract_node"]
    previous_to_abstract: EdgeSet
    current_to_abstract: EdgeSet
    abstract_to_abstract: EdgeSet
    is_covered: Bool[Tensor, "batch particle"]
    driven_to_abstract: EdgeSet | None = None

    @property
    def abstract_to_current(self) -> EdgeSet:
        return self.current_to_abstract.reversed()


def draw_priorities(generators: list[torch.Generator], num_particles: int) -> Float64[Tensor, "batch particle"]:
    """Draw what decides who becomes an abstract node: the valid particles with the smallest numbers do.

    The i-th valid particle of a member gets the i-th number, so that padding changes no choice.
    """
    draws = [torch.rand(num_particles, generator=generator, dtype=torch.float64) for generator in generators]
    return torch.stack(draws) if draws else torch.zeros(0, num_particles, dtype=torch.float64)


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
    max_abstract_edges_per_node: int | None = None,
) -> HierarchicalGraph:
    """Build the graph of each batch member and put them side by side (paper section 3.2, Graph construction).

    ``num_abstract_nodes`` of the valid current particles (all, where there are fewer) are chosen uniformly without
    replacement. Each valid particle of both times is connected to its nearest abstract nodes, at most
    ``max_abstract_neighbors`` and within ``r_s`` metres; current particles get the reverse edges, too. Abstract
    nodes within ``r_a_s`` metres of each other are connected in both directions, all of them, without self loops; with
    ``max_abstract_edges_per_node`` each receives from that many nearest ones only.
    Indices into particles count ``batch * particle``; padding has no edges.

    Raises:
        NonFiniteError: when a valid particle is not finite.
        ValueError: when there is not one generator per batch member.
    """
    batch_size, num_current = current.mask.shape
    if len(generators) != batch_size:
        raise ValueError(f"One generator per batch member is needed: got {len(generators)} for {batch_size}.")
    # -1 stands for "no abstract node" until their number is known.
    nodes: dict[str, Particles | Driven] = {"previous": previous, "current": current}
    if current.driven is not None:
        nodes["driven"] = current.driven
    abstract_neighbors = {
        name: torch.full((*particles.mask.shape, max_abstract_neighbors), -1, device=particles.mask.device)
        for name, particles in nodes.items()
    }
    among: list[tuple[Tensor, Tensor]] = []
    chosen: list[Tensor] = []
    num_abstract = 0
    priorities = draw_priorities(generators, num_current)
    for member in range(batch_size):
        valid = current.mask[member].nonzero()[:, 0]
        order = priorities[member, : len(valid)].argsort(stable=True)[:num_abstract_nodes]
        members_choice = valid.index_select(0, order.to(valid.device))
        centers = current.positions[member].index_select(0, members_choice)
        index = PointIndex(centers, backend, is_graph=True)
        for name, particles in nodes.items():
            rows = particles.mask[member].nonzero()[:, 0]
            near = index.knn(particles.positions[member].index_select(0, rows), max_abstract_neighbors, r_s)
            abstract_neighbors[name][member, rows] = torch.where(near.mask, near.index + num_abstract, -1)
        if max_abstract_edges_per_node is None:
            senders, receivers = PointIndex(centers, backend, is_radius=True, is_graph=True).radius(centers, r_a_s)
            is_other = senders != receivers
            among.append((senders[is_other] + num_abstract, receivers[is_other] + num_abstract))
        else:
            near = index.knn(centers, max_abstract_edges_per_node + 1, r_a_s)
            mask = without_self(near.index, near.mask)
            among.append((near.index + num_abstract, mask))
        chosen.append(members_choice + member * num_current)
        num_abstract += len(members_choice)

    joined = tuple(torch.cat(column) for column in zip(*among, strict=True))
    return HierarchicalGraph(
        abstract_index=torch.cat(chosen),
        previous_to_abstract=edges_to_abstract(abstract_neighbors["previous"].flatten(0, 1), num_abstract),
        current_to_abstract=edges_to_abstract(abstract_neighbors["current"].flatten(0, 1), num_abstract),
        abstract_to_abstract=(
            EdgeSet(Incidence.of(joined[0], num_abstract), Incidence.of(joined[1], num_abstract, is_sorted=True))
            if max_abstract_edges_per_node is None
            else edges_from_table(*joined)
        ),
        is_covered=(abstract_neighbors["current"] >= 0).any(dim=2),
        driven_to_abstract=(
            edges_to_abstract(abstract_neighbors["driven"].flatten(0, 1), num_abstract) if "driven" in nodes else None
        ),
    )


def edges_to_abstract(table: Int64[Tensor, "particle neighbor"], num_abstract: int) -> EdgeSet:
    """Return the edges from particles to the abstract nodes of a table that holds -1 where there is none."""
    mask = table >= 0
    receivers = torch.where(mask, table, num_abstract).flatten()
    return EdgeSet(Incidence.of_table(mask), Incidence.of(receivers, num_abstract))


def edges_from_table(index: Int64[Tensor, "node neighbor"], mask: Bool[Tensor, "node neighbor"]) -> EdgeSet:
    """Return the edges to each node from its row of a table."""
    senders = torch.where(mask, index, len(index)).flatten()
    return EdgeSet(Incidence.of(senders, len(index)), Incidence.of_table(mask))


def without_self(
    index: Int64[Tensor, "*batch node neighbor"], mask: Bool[Tensor, "*batch node neighbor"]
) -> Bool[Tensor, "*batch node neighbor"]:
    """Mask each point out of its own list of neighbours, or the farthest where duplicates pushed it out."""
    is_self = index == torch.arange(index.shape[-2], device=index.device)[:, None]
    is_self = is_self & mask
    is_last = torch.arange(index.shape[-1], device=index.device) == index.shape[-1] - 1
    return mask & ~is_self & ~(is_last & ~is_self.any(dim=-1, keepdim=True))
