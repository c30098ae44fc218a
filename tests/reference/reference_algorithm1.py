"""Algorithm 1 of the paper, one edge and node at a time in float64, with its graph found by brute force.

Read from the paper's text: an MLP of shape (128, 128) is two linear layers with a ReLU between them; an updater ends
in a layer norm and adds the result to what it updates (``x + LayerNorm(MLP(...))``), where there is something to add
to; a node sums the messages of all edges that arrive (Algorithm 1 prints one edge set from the particles of both times
to the abstract nodes); every node and edge type has its own weights.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Edge = tuple[int, int]


@dataclass(frozen=True)
class Mlp:
    """Linear layers with ReLU between them; ``norm`` is the gain, bias and epsilon of an output layer norm."""

    layers: Sequence[tuple[Array, Array]]
    norm: tuple[Array, Array, float] | None = None

    def __call__(self, *inputs: Array) -> Array:
        values = [float(value) for part in inputs for value in part]
        for number, (weight, bias) in enumerate(self.layers):
            values = [
                sum(float(w) * x for w, x in zip(row, values, strict=True)) + float(offset)
                for row, offset in zip(weight, bias, strict=True)
            ]
            if number < len(self.layers) - 1:
                values = [max(value, 0.0) for value in values]
        if self.norm is not None:
            gain, bias, epsilon = self.norm
            mean = sum(values) / len(values)
            variance = sum((value - mean) ** 2 for value in values) / len(values)
            scale = 1.0 / math.sqrt(variance + epsilon)
            values = [(v - mean) * scale * float(g) + float(b) for v, g, b in zip(values, gain, bias, strict=True)]
        return np.array(values)


@dataclass(frozen=True)
class Weights:
    """One set of weights per node and edge type; the processor has one pair per message passing step."""

    encode_previous: Mlp
    encode_current: Mlp
    encode_previous_to_abstract: Mlp
    encode_current_to_abstract: Mlp
    encode_abstract_to_abstract: Mlp
    encode_abstract_to_current: Mlp
    update_previous_to_abstract: Mlp
    update_current_to_abstract: Mlp
    update_abstract: Mlp
    process_edges: Sequence[Mlp]
    process_nodes: Sequence[Mlp]
    update_abstract_to_current: Mlp
    update_current: Mlp
    decode_location: Mlp
    decode_feature: Mlp


@dataclass(frozen=True)
class Graph:
    """Edges as (sender, receiver), by brute force."""

    previous_to_abstract: list[Edge]
    current_to_abstract: list[Edge]
    abstract_to_abstract: list[Edge]
    abstract_to_current: list[Edge]


def _to_nearest_abstract(
    positions: Array, valid: Sequence[bool], abstract: Array, count: int, r_s: float
) -> list[Edge]:
    edges = []
    for particle, position in enumerate(positions):
        if not valid[particle]:
            continue
        ordered = sorted((math.dist(position, node), number) for number, node in enumerate(abstract))
        edges += [(particle, number) for distance, number in ordered[:count] if distance <= r_s]
    return edges


def build_graph(
    previous: Array,
    previous_valid: Sequence[bool],
    current: Array,
    current_valid: Sequence[bool],
    abstract: Array,
    max_abstract_neighbors: int,
    r_s: float,
    r_a_s: float,
) -> Graph:
    """Connect every particle to its (at most two) nearest abstract nodes within r_s, abstract nodes within r_s^a.

    The edges back to the current particles are the reverse of the edges from them; nothing is connected to itself.
    """
    current_to_abstract = _to_nearest_abstract(current, current_valid, abstract, max_abstract_neighbors, r_s)
    among = [
        (sender, receiver)
        for receiver in range(len(abstract))
        for sender in range(len(abstract))
        if sender != receiver and math.dist(abstract[sender], abstract[receiver]) <= r_a_s
    ]
    return Graph(
        _to_nearest_abstract(previous, previous_valid, abstract, max_abstract_neighbors, r_s),
        current_to_abstract,
        among,
        [(node, particle) for particle, node in current_to_abstract],
    )


def _gather_messages(edges: list[Edge], messages: list[Array], num_receivers: int, width: int, is_mean: bool) -> Array:
    """Sum the messages that arrive at each receiver, or average them (zero where none arrives)."""
    totals = np.zeros((num_receivers, width))
    for (_, receiver), message in zip(edges, messages, strict=True):
        for channel in range(width):
            totals[receiver, channel] += message[channel]
    for receiver in range(num_receivers if is_mean else 0):
        totals[receiver] /= max(1, sum(1 for edge in edges if edge[1] == receiver))
    return totals


def _encode_edges(encoder: Mlp, edges: list[Edge], senders: Array, receivers: Array, unit: float) -> list[Array]:
    """The initial edge feature is the position of the sender relative to the receiver, in a unit of length."""
    return [encoder((senders[sender] - receivers[receiver]) / unit) for sender, receiver in edges]


def apply(
    weights: Weights,
    graph: Graph,
    previous: tuple[Array, Array],
    current: tuple[Array, Array],
    abstract: Array,
    location_scale: float,
    units: tuple[float, float] = (1.0, 1.0),
    is_mean: bool = False,
) -> tuple[Array, Array]:
    """Run Algorithm 1 once: (positions, features) of two times -> positions and features of the next.

    ``units`` are those of the edges at particles and of those among abstract nodes (metres in the paper). With
    ``is_mean`` the messages at a node are averaged, each edge set by itself, instead of summed.

    A particle that no abstract node covers gets the zero message; padding rows come back like any uncovered particle.
    """
    (previous_x, previous_z), (current_x, current_z) = previous, current
    # Encode particle nodes and edges.
    previous_nodes = [weights.encode_previous(feature) for feature in previous_z]
    current_nodes = [weights.encode_current(feature) for feature in current_z]
    width = len(weights.encode_current.layers[-1][1])
    from_previous = _encode_edges(
        weights.encode_previous_to_abstract, graph.previous_to_abstract, previous_x, abstract, units[0]
    )
    from_current = _encode_edges(
        weights.encode_current_to_abstract, graph.current_to_abstract, current_x, abstract, units[0]
    )
    among = _encode_edges(weights.encode_abstract_to_abstract, graph.abstract_to_abstract, abstract, abstract, units[1])
    back = _encode_edges(weights.encode_abstract_to_current, graph.abstract_to_current, abstract, current_x, units[0])

    # Update particle -> abstract edges; the receiving abstract nodes have no features yet.
    from_previous = [
        edge + weights.update_previous_to_abstract(edge, previous_nodes[sender])
        for edge, (sender, _) in zip(from_previous, graph.previous_to_abstract, strict=True)
    ]
    from_current = [
        edge + weights.update_current_to_abstract(edge, current_nodes[sender])
        for edge, (sender, _) in zip(from_current, graph.current_to_abstract, strict=True)
    ]
    # Update abstract nodes: nothing to add the result to.
    sums = _gather_messages(graph.previous_to_abstract, from_previous, len(abstract), width, is_mean)
    sums = sums + _gather_messages(graph.current_to_abstract, from_current, len(abstract), width, is_mean)
    nodes = [weights.update_abstract(sums[number]) for number in range(len(abstract))]

    # Message passing among abstract nodes.
    for update_edge, update_node in zip(weights.process_edges, weights.process_nodes, strict=True):
        among = [
            edge + update_edge(edge, nodes[sender], nodes[receiver])
            for edge, (sender, receiver) in zip(among, graph.abstract_to_abstract, strict=True)
        ]
        sums = _gather_messages(graph.abstract_to_abstract, among, len(abstract), width, is_mean)
        nodes = [node + update_node(node, sums[number]) for number, node in enumerate(nodes)]

    # Back to the current particles.
    back = [
        edge + weights.update_abstract_to_current(edge, nodes[sender], current_nodes[receiver])
        for edge, (sender, receiver) in zip(back, graph.abstract_to_current, strict=True)
    ]
    sums = _gather_messages(graph.abstract_to_current, back, len(current_x), width, is_mean)
    current_nodes = [node + weights.update_current(node, sums[number]) for number, node in enumerate(current_nodes)]

    # Decode and apply.
    next_x, next_z = np.zeros_like(current_x), np.zeros_like(current_z)
    for particle, node in enumerate(current_nodes):
        next_x[particle] = current_x[particle] + location_scale * np.tanh(weights.decode_location(node))
        next_z[particle] = current_z[particle] + weights.decode_feature(node)
    return next_x, next_z
