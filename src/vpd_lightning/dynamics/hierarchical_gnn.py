"""The paper's dynamics: hierarchical message passing through abstract nodes (Algorithm 1)."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.blocks import MLP, EdgeUpdater, NodeUpdater, summed_at_receivers
from vpd_lightning.graph.hierarchical import EdgeSet, HierarchicalGraph, build_graph
from vpd_lightning.graph.neighbors import BACKENDS
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles


class HierarchicalGNNDynamics(AbstractDynamics):
    """Algorithm 1 of the paper with one set of weights per node type and edge type.

    Node types: previous particles, current particles, abstract nodes. Edge types: previous -> abstract, current ->
    abstract, abstract -> abstract, abstract -> current. Message passing among abstract nodes has its own weights in
    each of ``message_passing_steps`` steps. All latents are ``hidden_dim`` wide. Where the algorithm prints the empty
    set, nothing is concatenated and nothing is added. An abstract node sums all edges that arrive, of both times. The
    initial feature of an edge is the sender's position minus the receiver's (metres), so that only relative positions
    are seen.

    # Paper: Algorithm 1 prints no encoder for abstract -> abstract and abstract -> current edges, which its updaters
    # read; the appendix says that the initial feature of "the edges" is the relative position, so those have one too.
    # Paper: Algorithm 1 prints one edge set from the particles of both times to the abstract nodes, so both are added
    # up; MeshGraphNets, which the paper follows, would concatenate one sum per edge type (16,384 parameters more).
    # Paper: not printed and chosen here: 1024 abstract nodes, sum aggregation, no self loops. A current particle
    # without abstract node in reach gets a zero message and is decoded from its own encoding.

    Parameters at the paper's size (features 16, hidden 128, 10 steps; a layer norm has 256): node encoders
    2 * 18,688; edge encoders 4 * 17,024; particle -> abstract edge updaters 2 * 49,664; first abstract node updater
    33,280; message passing 10 * (66,048 + 49,664); abstract -> current edge updater 66,048; particle updater 49,664;
    location decoder 49,923; feature decoder 51,600. Together 1,612,435.

    ``last_uncovered_share`` is the share of current particles without abstract node in reach in the last call.
    """

    last_uncovered_share: Tensor | None

    def __init__(
        self,
        *,
        feature_dim: int,
        hidden_dim: int,
        message_passing_steps: int,
        num_abstract_nodes: int,
        max_abstract_neighbors: int,
        r_s: float,
        r_a_s: float,
        location_scale: float,
        neighbors_backend: str,
    ) -> None:
        super().__init__()
        counts = {
            "feature_dim": feature_dim,
            "hidden_dim": hidden_dim,
            "num_abstract_nodes": num_abstract_nodes,
            "max_abstract_neighbors": max_abstract_neighbors,
        }
        for name, count in counts.items():
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count}.")
        if message_passing_steps < 0:
            raise ValueError(f"message_passing_steps must be at least 0, got {message_passing_steps}.")
        for name, value in {"r_s": r_s, "r_a_s": r_a_s, "location_scale": location_scale}.items():
            if not value > 0:
                raise ValueError(f"{name} must be greater than 0 metres, got {value}.")
        if neighbors_backend not in ("auto", *BACKENDS):
            raise ValueError(f"neighbors_backend must be auto or one of {BACKENDS}, got {neighbors_backend!r}.")
        self.num_abstract_nodes = num_abstract_nodes
        self.max_abstract_neighbors = max_abstract_neighbors
        self.r_s, self.r_a_s = float(r_s), float(r_a_s)
        self.location_scale = float(location_scale)
        self.neighbors_backend = neighbors_backend
        self.last_uncovered_share = None
        widths = (hidden_dim, hidden_dim)
        self.encode_node = nn.ModuleDict({name: MLP(feature_dim, widths) for name in ("previous", "current")})
        edge_types = ("previous_to_abstract", "current_to_abstract", "abstract_to_abstract", "abstract_to_current")
        self.encode_edge = nn.ModuleDict({name: MLP(3, widths) for name in edge_types})
        self.update_edge = nn.ModuleDict(
            {
                "previous_to_abstract": EdgeUpdater(hidden_dim, num_node_inputs=1),
                "current_to_abstract": EdgeUpdater(hidden_dim, num_node_inputs=1),
                "abstract_to_abstract": nn.ModuleList(
                    EdgeUpdater(hidden_dim, num_node_inputs=2) for _ in range(message_passing_steps)
                ),
                "abstract_to_current": EdgeUpdater(hidden_dim, num_node_inputs=2),
            }
        )
        self.update_node = nn.ModuleDict(
            {
                "abstract_first": NodeUpdater(hidden_dim, has_nodes=False),
                "abstract": nn.ModuleList(
                    NodeUpdater(hidden_dim, has_nodes=True) for _ in range(message_passing_steps)
                ),
                "current": NodeUpdater(hidden_dim, has_nodes=True),
            }
        )
        self.decode_location = MLP(hidden_dim, (hidden_dim, hidden_dim, hidden_dim, 3))
        self.decode_feature = MLP(hidden_dim, (hidden_dim, hidden_dim, hidden_dim, feature_dim))

    def forward(
        self, previous: Particles, current: Particles, memory: Any, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, Any]:
        """Return the particles of the next step; there is no memory.

        Raises:
            NonFiniteError: when a valid particle is not finite.
        """
        graph = build_graph(
            previous,
            current,
            keys.generators(f"abstract/{rollout_step}"),
            num_abstract_nodes=self.num_abstract_nodes,
            max_abstract_neighbors=self.max_abstract_neighbors,
            r_s=self.r_s,
            r_a_s=self.r_a_s,
            backend=self.neighbors_backend,
        )
        num_valid = current.mask.sum().clamp(min=1)
        self.last_uncovered_share = (current.mask & ~graph.is_covered).sum() / num_valid
        nodes = self._message_passing(previous, current, graph)
        delta_location = self.decode_location(nodes).view(*current.positions.shape)
        delta_feature = self.decode_feature(nodes).view(*current.features.shape)
        with torch.autocast(current.positions.device.type, enabled=False):
            delta_location = self.location_scale * torch.tanh(delta_location.to(current.positions.dtype))
            valid = current.mask[..., None]
            positions = torch.where(valid, current.positions + delta_location, current.positions)
            features = current.features + delta_feature.to(current.features.dtype)
            features = torch.where(valid, features, current.features)
        return replace(current, positions=positions, features=features), memory

    def _message_passing(
        self, previous: Particles, current: Particles, graph: HierarchicalGraph
    ) -> Float[Tensor, "node feature"]:
        """Return the updated latents of all current particles: Algorithm 1 from the encoders to the decoders."""
        positions = {"previous": previous.positions.flatten(0, 1), "current": current.positions.flatten(0, 1)}
        positions["abstract"] = positions["current"].index_select(0, graph.abstract_index)
        edge_sets: dict[str, EdgeSet] = {name: getattr(graph, name) for name in self.encode_edge}

        # Encode particle nodes and edges.
        nodes = {
            "previous": self.encode_node["previous"](_usable(previous)),
            "current": self.encode_node["current"](_usable(current)),
        }
        edges = {}
        for name, edge_set in edge_sets.items():
            sender_type, receiver_type = name.split("_to_")
            relative = positions[sender_type].index_select(0, edge_set.senders)
            relative = relative - positions[receiver_type].index_select(0, edge_set.receivers)
            edges[name] = self.encode_edge[name](relative)

        # Update particle -> abstract edges, then abstract nodes.
        messages = []
        for sender_type in ("previous", "current"):
            name = f"{sender_type}_to_abstract"
            edge_set = edge_sets[name]
            updated = self.update_edge[name](
                edges[name], nodes[sender_type], None, edge_set.senders, edge_set.receivers
            )
            messages.append(summed_at_receivers(updated, edge_set.receiver_offsets))
        abstract = self.update_node["abstract_first"](None, messages[0] + messages[1])

        # Perform message passing among abstract nodes.
        edge_set, among = edge_sets["abstract_to_abstract"], edges["abstract_to_abstract"]
        for update_edge, update_node in zip(
            self.update_edge["abstract_to_abstract"], self.update_node["abstract"], strict=True
        ):
            among = update_edge(among, abstract, abstract, edge_set.senders, edge_set.receivers)
            abstract = update_node(abstract, summed_at_receivers(among, edge_set.receiver_offsets))

        # Update abstract -> current edges, then current particles.
        edge_set = edge_sets["abstract_to_current"]
        updated = self.update_edge["abstract_to_current"](
            edges["abstract_to_current"], abstract, nodes["current"], edge_set.senders, edge_set.receivers
        )
        message = summed_at_receivers(updated, edge_set.receiver_offsets)
        return self.update_node["current"](nodes["current"], message)


def _usable(particles: Particles) -> Float[Tensor, "node feature"]:
    """Return flat features with zeros for padding, whose numbers must not reach anything, not even as NaN times 0."""
    return torch.where(particles.mask[..., None], particles.features, 0.0).flatten(0, 1)
