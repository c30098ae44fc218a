"""The same graph with shapes that depend on sizes alone and without asking the device for a number.

This is what torch.compile and CUDA graphs can hold. Everything is compared with everything, which a GPU does in no
time at a thousand abstract nodes: 17 million pairs for the particles of one time, one million among abstract nodes.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from vpd_lightning.graph.hierarchical import (
    EdgeSet,
    HierarchicalGraph,
    edges_from_table,
    edges_to_abstract,
    without_self,
)
from vpd_lightning.graph.incidence import Incidence
from vpd_lightning.types import Driven, Particles

_PAIRS_PER_CHUNK = {"cpu": 1 << 20, "cuda": 1 << 26}
"""How many distances live at once; a compiler cuts its own pieces."""

_FEW = 4
"""Up to here repeated argmin is faster than topk."""


@dataclass(frozen=True)
class StaticGraph:
    """A graph and what could not be refused while it was built: check both numbers when the device has them.

    ``dropped_edges`` counts edges among abstract nodes that did not fit, ``non_finite`` valid particles that hold NaN
    or infinity. Where one is not zero, nothing computed from the graph may be used.
    """

    graph: HierarchicalGraph
    dropped_edges: Int64[Tensor, ""]
    non_finite: Int64[Tensor, ""]


@torch.no_grad()
def build_static_graph(
    previous: Particles,
    current: Particles,
    priorities: Float64[Tensor, "batch particle"],
    *,
    num_abstract_nodes: int,
    max_abstract_neighbors: int,
    r_s: float,
    r_a_s: float,
    edge_capacity: int,
    max_abstract_edges_per_node: int | None = None,
) -> StaticGraph:
    """Build the graph of ``build_graph`` with room for ``edge_capacity`` edges among the abstract nodes of the batch.

    ``priorities`` (see ``draw_priorities``) choose the abstract nodes: the same ones as there. There are as many in
    every member; where fewer particles are valid, the rest have no edges. With ``max_abstract_edges_per_node`` these
    edges are a table of fixed width and the capacity has no meaning.
    """
    batch_size, num_current = current.mask.shape
    num_abstract = min(num_abstract_nodes, num_current)
    first = torch.arange(batch_size, device=current.mask.device)[:, None]
    ordinal = (current.mask.long().cumsum(dim=1) - 1).clamp(min=0)
    drawn = torch.where(current.mask, priorities.gather(1, ordinal), torch.inf)
    chosen = drawn.argsort(dim=1, stable=True)[:, :num_abstract]
    is_node = current.mask.gather(1, chosen)
    centers = _usable(current.positions.gather(1, chosen[..., None].expand(-1, -1, 3)), is_node)

    abstract_neighbors = []
    nodes: list[Particles | Driven] = [previous, current]
    if current.driven is not None:
        nodes.append(current.driven)
    for particles in nodes:
        queries = _usable(particles.positions, particles.mask)
        index, mask = _nearest(queries, centers, is_node, max_abstract_neighbors, r_s)
        mask = mask & particles.mask[..., None]
        abstract_neighbors.append(torch.where(mask, index + first[..., None] * num_abstract, -1))
    if max_abstract_edges_per_node is None:
        among, dropped = _edges_within(centers, is_node, r_a_s, edge_capacity)
    else:
        index, mask = _nearest(centers, centers, is_node, max_abstract_edges_per_node + 1, r_a_s)
        mask = without_self(index, mask) & is_node[..., None]
        index = index + first[..., None] * num_abstract
        among, dropped = edges_from_table(index.flatten(0, 1), mask.flatten(0, 1)), first.new_zeros(())
    graph = HierarchicalGraph(
        abstract_index=(chosen + first * num_current).flatten(),
        previous_to_abstract=edges_to_abstract(abstract_neighbors[0].flatten(0, 1), batch_size * num_abstract),
        current_to_abstract=edges_to_abstract(abstract_neighbors[1].flatten(0, 1), batch_size * num_abstract),
        abstract_to_abstract=among,
        is_covered=(abstract_neighbors[1] >= 0).any(dim=2),
        driven_to_abstract=(
            None
            if current.driven is None
            else edges_to_abstract(abstract_neighbors[2].flatten(0, 1), batch_size * num_abstract)
        ),
    )
    return StaticGraph(graph, dropped, _non_finite(previous) + _non_finite(current))


def _usable(positions: Float[Tensor, "batch any 3"], mask: Bool[Tensor, "batch any"]) -> Float[Tensor, "batch any 3"]:
    return torch.where(mask[..., None], positions, 0.0)


def _non_finite(particles: Particles) -> Int64[Tensor, ""]:
    return (particles.mask & ~torch.isfinite(particles.positions).all(dim=-1)).sum()


def _squared_distances(
    queries: Float[Tensor, "batch query 3"], points: Float[Tensor, "batch point 3"]
) -> Float[Tensor, "batch query point"]:
    """Return all squared distances by differences, x^2 + y^2 + z^2 in this order; symmetric to the last digit."""
    x, y, z = ((queries[:, :, None, axis] - points[:, None, :, axis]).square() for axis in range(3))
    return x + y + z


def _nearest(
    queries: Float[Tensor, "batch query 3"],
    points: Float[Tensor, "batch point 3"],
    is_point: Bool[Tensor, "batch point"],
    count: int,
    max_radius: float,
) -> tuple[Int64[Tensor, "batch query neighbor"], Bool[Tensor, "batch query neighbor"]]:
    """Return the nearest points of each query as a table, nearest first, with a mask of those within ``max_radius``."""
    batch_size, num_points = is_point.shape
    rows = queries.shape[1]
    if not torch.compiler.is_compiling():
        rows = max(1, _PAIRS_PER_CHUNK.get(queries.device.type, 1 << 22) // (batch_size * num_points))
    tables = []
    for chunk in queries.split(max(1, rows), dim=1):
        squared = torch.where(is_point[:, None], _squared_distances(chunk, points), torch.inf)
        if count <= min(_FEW, num_points):
            columns = []
            for _ in range(count):
                columns.append(squared.argmin(dim=2, keepdim=True))
                squared = squared.scatter(2, columns[-1], torch.inf)
            tables.append(torch.cat(columns, dim=2))
        else:
            tables.append(squared.topk(min(count, num_points), dim=2, largest=False).indices)
    index = torch.cat(tables, dim=1)
    found = points.gather(1, index.flatten(1)[..., None].expand(-1, -1, 3)).unflatten(1, index.shape[1:])
    x, y, z = (queries[:, :, None] - found).square().unbind(dim=-1)
    mask = ((x + y + z).sqrt() <= max_radius) & is_point.gather(1, index.flatten(1)).unflatten(1, index.shape[1:])
    missing = count - index.shape[2]
    if missing:
        index, mask = (torch.nn.functional.pad(values, (0, missing)) for values in (index, mask))
    return index, mask


def _edges_within(
    nodes: Float[Tensor, "batch node 3"], is_node: Bool[Tensor, "batch node"], max_radius: float, capacity: int
) -> tuple[EdgeSet, Int64[Tensor, ""]]:
    """Return all edges between nodes of one member within ``max_radius`` and how many did not fit into ``capacity``.

    Running counts over the dense matrix of pairs number the edges by receiver, then sender, as ``build_graph`` does.
    The matrix is symmetric, so the count at the transposed place is the number of the edge that runs the other way:
    this gives the edges by sender without a sort.
    """
    batch_size, num_nodes = is_node.shape
    is_other = ~torch.eye(num_nodes, dtype=torch.bool, device=nodes.device)
    is_tied = (_squared_distances(nodes, nodes).sqrt() <= max_radius) & is_other
    is_tied = is_tied & is_node[:, None] & is_node[:, :, None]
    total = batch_size * num_nodes
    running = is_tied.flatten().cumsum(dim=0)
    number = torch.arange(capacity, device=nodes.device)
    pair = torch.searchsorted(running, number + 1).clamp(max=max(0, total * num_nodes - 1))
    receivers = pair // num_nodes
    member = receivers // num_nodes
    senders = member * num_nodes + pair % num_nodes
    backward = (running[senders * num_nodes + receivers % num_nodes] - 1).clamp(min=0, max=capacity - 1)
    is_edge = number < running[-1]
    starts = torch.nn.functional.pad(running[num_nodes - 1 :: num_nodes], (1, 0)).clamp(max=capacity)
    edges = EdgeSet(
        # A clone: torch.compile refuses to see one tensor twice among the inputs of an autograd function.
        Incidence(torch.where(is_edge, senders, total), total, torch.where(is_edge, backward, number), starts.clone()),
        Incidence(torch.where(is_edge, receivers, total), total, None, starts),
    )
    return edges, (running[-1] - capacity).clamp(min=0)
