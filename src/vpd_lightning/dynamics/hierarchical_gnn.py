"""The paper's dynamics: hierarchical message passing through abstract nodes (Algorithm 1)."""

import functools
import importlib.util
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.blocks import MLP, EdgeUpdater, NodeUpdater
from vpd_lightning.dynamics.delayed_faults import DelayedFaults
from vpd_lightning.dynamics.graph_inputs import driven_of, driven_tensors, rows_in_use, usable
from vpd_lightning.errors import ConfigError
from vpd_lightning.finite import require_finite
from vpd_lightning.graph.hierarchical import EdgeSet, HierarchicalGraph, build_graph, draw_priorities
from vpd_lightning.graph.incidence import Incidence, gather_to_edges
from vpd_lightning.graph.neighbors import BACKENDS
from vpd_lightning.graph.static_graph import build_static_graph
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Driven, Particles


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
    # Paper: features are kept within +-feature_limit. Nothing in Algorithm 1 bounds what is added to them step after
    # step, and over hundreds of steps trained networks were seen to overflow; a limit far above what they learn changes
    # nothing before that.
    # Paper: not printed and chosen here: 1024 abstract nodes, sum aggregation, no self loops. A current particle
    # without abstract node in reach gets a zero message and is decoded from its own encoding.

    Parameters at the paper's size (features 16, hidden 128, 10 steps; a layer norm has 256): node encoders
    2 * 18,688; edge encoders 4 * 17,024; particle -> abstract edge updaters 2 * 49,664; first abstract node updater
    33,280; message passing 10 * (66,048 + 49,664); abstract -> current edge updater 66,048; particle updater 49,664;
    location decoder 49,923; feature decoder 51,600. Together 1,612,435.

    With ``edge_capacity`` the graph is built with fixed shapes and without asking the device for a number (see
    ``static_graph``): room for that many edges among the abstract nodes of the whole batch. What does not fit is
    dropped and counted in ``last_dropped_edges``, and the next call (or ``check_faults``) raises. ``compile`` hands
    that step to torch.compile; on a GPU it is replayed as a CUDA graph. ``null`` builds exactly the edges there are.

    ``max_abstract_edges_per_node`` is an approximation, off in the paper: an abstract node receives from that many
    nearest ones only, so that edges grow with the abstract nodes and not with their square.

    ``zero_init_decoders`` starts the last layers of both decoders at zero, so that before training nothing moves and no
    feature changes. ``normalized_edges`` divides relative positions by the radius within which edges are drawn (``r_s``
    or ``r_a_s``): the same functions, from inputs of order one whatever the scene's unit of length. ``edge_gain``
    multiplies those between particles and abstract nodes: velocity shows as a shift by a fraction of ``r_s``.

    ``aggregation`` reduces the edges at a node: ``sum``, or ``mean``, which does not grow with their number.

    Without ``update_features`` there is no feature decoder, and particles keep the features that they were encoded
    with: only their positions change. With it, a network that has not learned the motion yet lowers the image error by
    fading bodies out, and then does not learn how they move.

    # Paper: features are updated.
    # Paper: neither zero_init_decoders nor normalized_edges; relative positions of a few centimetres are a hundredth of
    # what the layers are initialised for. Its aggregation is not printed.

    With ``has_driven`` the driven points of the current particles are senders of a fourth kind, connected to abstract
    nodes as particles are: their initial feature is the displacement that they are given in this step (in location
    scales) and their normal. They are not updated. (The paper has no actions.)

    ``last_uncovered_share`` is the share of current particles without abstract node in reach in the last call.
    """

    last_uncovered_share: Tensor | None
    last_dropped_edges: Tensor | None

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
        feature_limit: float,
        neighbors_backend: str,
        edge_capacity: int | None,
        max_abstract_edges_per_node: int | None,
        compile: bool,
        zero_init_decoders: bool,
        normalized_edges: bool,
        edge_gain: float,
        aggregation: str,
        update_features: bool,
        has_driven: bool,
    ) -> None:
        super().__init__()
        counts = {
            "feature_dim": feature_dim,
            "hidden_dim": hidden_dim,
            "num_abstract_nodes": num_abstract_nodes,
            "max_abstract_neighbors": max_abstract_neighbors,
            "edge_capacity": 1 if edge_capacity is None else edge_capacity,
            "max_abstract_edges_per_node": 1 if max_abstract_edges_per_node is None else max_abstract_edges_per_node,
        }
        for name, count in counts.items():
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count}.")
        if message_passing_steps < 0:
            raise ValueError(f"message_passing_steps must be at least 0, got {message_passing_steps}.")
        positive = {
            "r_s": r_s,
            "r_a_s": r_a_s,
            "location_scale": location_scale,
            "feature_limit": feature_limit,
            "edge_gain": edge_gain,
        }
        for name, value in positive.items():
            if not value > 0:
                raise ValueError(f"{name} must be greater than 0, got {value}.")
        if neighbors_backend not in ("auto", *BACKENDS):
            raise ValueError(f"neighbors_backend must be auto or one of {BACKENDS}, got {neighbors_backend!r}.")
        if edge_gain != 1 and not normalized_edges:
            raise ValueError(f"edge_gain={edge_gain} multiplies normalised edges: set normalized_edges=true.")
        if aggregation not in ("sum", "mean"):
            raise ValueError(f"aggregation must be sum or mean, got {aggregation!r}.")
        if compile and edge_capacity is None:
            raise ValueError("compile=true needs fixed shapes: set edge_capacity, the most edges among abstract nodes.")
        self.num_abstract_nodes = num_abstract_nodes
        self.max_abstract_neighbors = max_abstract_neighbors
        self.r_s, self.r_a_s = float(r_s), float(r_a_s)
        self.location_scale, self.feature_limit = float(location_scale), float(feature_limit)
        self.neighbors_backend = neighbors_backend
        self.edge_capacity, self.max_abstract_edges_per_node = edge_capacity, max_abstract_edges_per_node
        self.is_compiled = compile
        self.normalized_edges, self.edge_gain, self.aggregation = normalized_edges, float(edge_gain), aggregation
        self.last_uncovered_share = self.last_dropped_edges = None
        self._faults = DelayedFaults()
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
        self.decode_feature = (
            MLP(hidden_dim, (hidden_dim, hidden_dim, hidden_dim, feature_dim)) if update_features else None
        )
        self.has_driven = has_driven
        if has_driven:  # behind all others, whose random weights are then those of a model without
            self.encode_node["driven"] = MLP(6, widths)
            self.encode_edge["driven_to_abstract"] = MLP(3, widths)
            self.update_edge["driven_to_abstract"] = EdgeUpdater(hidden_dim, num_node_inputs=1)
        if zero_init_decoders:
            for decoder in (self.decode_location, self.decode_feature):
                if decoder is not None:
                    nn.init.zeros_(decoder.layers[-1].weight)

    def forward(
        self, previous: Particles, current: Particles, memory: Any, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, Any]:
        """Return the particles of the next step; there is no memory.

        Raises:
            NonFiniteError: when a valid particle is not finite.
            ConfigError: when edges did not fit into ``edge_capacity`` in an earlier call.
        """
        return self.advance(previous, current, keys, rollout_step, self.num_abstract_nodes), memory

    def advance(
        self, previous: Particles, current: Particles, keys: RandomKeys, rollout_step: int, num_abstract_nodes: int
    ) -> Particles:
        """Take one step with another number of abstract nodes than the configured one; the weights allow any.

        Raises:
            NonFiniteError: when a valid particle is not finite.
            ConfigError: when edges did not fit into ``edge_capacity`` in an earlier call.
        """
        if num_abstract_nodes < 1:
            raise ValueError(f"num_abstract_nodes must be at least 1, got {num_abstract_nodes}.")
        generators = keys.generators(f"abstract/{rollout_step}")
        if self.edge_capacity is not None and current.num_particles:
            return self._static_advance(previous, current, generators, num_abstract_nodes)
        previous, whole = previous.without_padding(), current.without_padding()
        driven = current.driven if self.has_driven else None
        require_finite(
            "Dynamics",
            positions=torch.cat([previous.positions, whole.positions], dim=1),
            features=torch.cat([previous.features, whole.features], dim=1),
        )
        # Rows that are padding in all members would cost as much as particles: encoders leave a third where the
        # workspace holds fewer pixels than num_particles.
        previous, current = rows_in_use(previous), replace(rows_in_use(whole), driven=driven)
        graph = build_graph(
            previous,
            current,
            generators,
            num_abstract_nodes=num_abstract_nodes,
            max_abstract_neighbors=self.max_abstract_neighbors,
            r_s=self.r_s,
            r_a_s=self.r_a_s,
            backend=self.neighbors_backend,
            max_abstract_edges_per_node=self.max_abstract_edges_per_node,
        )
        self.last_uncovered_share = _uncovered_share(current, graph)
        positions, features = self._following(previous, current, graph)
        if rest := whole.num_particles - current.num_particles:
            positions = torch.cat([positions, whole.positions[:, -rest:]], dim=1)
            features = torch.cat([features, whole.features[:, -rest:]], dim=1)
        return replace(whole, positions=positions, features=features)

    def _static_advance(
        self, previous: Particles, current: Particles, generators: list[torch.Generator], num_abstract_nodes: int
    ) -> Particles:
        self._faults.raise_if_known()
        priorities = draw_priorities(generators, current.num_particles)
        device = current.positions.device
        if device.type == "cuda":
            priorities = priorities.pin_memory().to(device, non_blocking=True)
        step = compiled_step(device.type) if self.is_compiled else static_step
        positions, features, uncovered, dropped, non_finite = step(
            self,
            num_abstract_nodes,
            priorities,
            (previous.positions, previous.features, previous.mask),
            (current.positions, current.features, current.mask),
            driven_tensors(current.driven) if self.has_driven else None,
        )
        if self.is_compiled and device.type == "cuda":
            # A CUDA graph writes its next results over these.
            positions, features, uncovered = positions.clone(), features.clone(), uncovered.clone()
        self.last_uncovered_share, self.last_dropped_edges = uncovered, dropped.clone()
        self._faults.watch(dropped, non_finite, self.edge_capacity or 0)
        return replace(current, positions=positions, features=features)

    def check_faults(self) -> None:
        """Wait for the device, and raise if the last static step dropped edges or met what is not finite.

        Raises:
            NonFiniteError: when a valid particle is not finite.
            ConfigError: when edges did not fit into ``edge_capacity``.
        """
        self._faults.raise_if_any()

    def _following(
        self, previous: Particles, current: Particles, graph: HierarchicalGraph
    ) -> tuple[Float[Tensor, "batch particle 3"], Float[Tensor, "batch particle feature"]]:
        """Return the next positions and features."""
        nodes = self._message_passing(previous, current, graph)
        delta_location = self.decode_location(nodes).view(*current.positions.shape)
        delta_feature = None if self.decode_feature is None else self.decode_feature(nodes)
        with torch.autocast(current.positions.device.type, enabled=False):
            delta_location = self.location_scale * torch.tanh(delta_location.to(current.positions.dtype))
            valid = current.mask[..., None]
            positions = torch.where(valid, current.positions + delta_location, current.positions)
            if delta_feature is None:
                return positions, current.features
            features = current.features + delta_feature.view(*current.features.shape).to(current.features.dtype)
            features = features.clamp(-self.feature_limit, self.feature_limit)
            features = torch.where(valid, features, current.features)
        return positions, features

    def _message_passing(
        self, previous: Particles, current: Particles, graph: HierarchicalGraph
    ) -> Float[Tensor, "node feature"]:
        """Return the updated latents of all current particles: Algorithm 1 from the encoders to the decoders."""
        has_driven = graph.driven_to_abstract is not None
        positions = {"previous": usable(previous, "positions"), "current": usable(current, "positions")}
        positions["abstract"] = positions["current"].index_select(0, graph.abstract_index)
        names = [name for name in self.encode_edge if name != "driven_to_abstract" or has_driven]
        edge_sets: dict[str, EdgeSet] = {name: getattr(graph, name) for name in names}

        # Encode particle nodes and edges.
        nodes = {
            "previous": self.encode_node["previous"](usable(previous, "features")),
            "current": self.encode_node["current"](usable(current, "features")),
        }
        if has_driven:
            assert current.driven is not None
            positions["driven"] = usable(current.driven, "positions")
            nodes["driven"] = self.encode_node["driven"](self._driven_inputs(current.driven))
        edges = {}
        for name, edge_set in edge_sets.items():
            sender_type, receiver_type = name.split("_to_")
            relative = gather_to_edges(
                positions[sender_type], edge_set.senders, -positions[receiver_type], edge_set.receivers
            )
            if self.normalized_edges:
                relative = relative / (self.r_a_s if sender_type == receiver_type else self.r_s / self.edge_gain)
            edges[name] = self.encode_edge[name](relative)

        # Update particle -> abstract edges, then abstract nodes.
        total: Tensor | None = None
        gathered = Incidence.mean if self.aggregation == "mean" else Incidence.summed
        for sender_type in nodes:
            name = f"{sender_type}_to_abstract"
            updated = self.update_edge[name](edges.pop(name), nodes[sender_type], None, edge_sets[name])
            message = gathered(edge_sets[name].receivers, updated)
            total = message if total is None else total + message
        assert total is not None
        abstract = self.update_node["abstract_first"](None, total)

        # Perform message passing among abstract nodes.
        edge_set, among = edge_sets["abstract_to_abstract"], edges.pop("abstract_to_abstract")
        for update_edge, update_node in zip(
            self.update_edge["abstract_to_abstract"], self.update_node["abstract"], strict=True
        ):
            among = update_edge(among, abstract, abstract, edge_set)
            abstract = update_node(abstract, gathered(edge_set.receivers, among))

        # Update abstract -> current edges, then current particles.
        edge_set = edge_sets["abstract_to_current"]
        updated = self.update_edge["abstract_to_current"](
            edges.pop("abstract_to_current"), abstract, nodes["current"], edge_set
        )
        return self.update_node["current"](nodes["current"], gathered(edge_set.receivers, updated))

    def _driven_inputs(self, driven: Driven) -> Float[Tensor, "node 6"]:
        """Return the displacement of this step (in location scales) and the normal of each driven point."""
        step = (driven.advanced().positions - driven.positions) / self.location_scale
        inputs = torch.cat([step, driven.normals], dim=-1)
        return torch.where(driven.mask[..., None], inputs, 0.0).flatten(0, 1)


def _uncovered_share(current: Particles, graph: HierarchicalGraph) -> Float[Tensor, ""]:
    return (current.mask & ~graph.is_covered).sum() / current.mask.sum().clamp(min=1)


def static_step(
    dynamics: HierarchicalGNNDynamics,
    num_abstract_nodes: int,
    priorities: Float64[Tensor, "batch particle"],
    previous_tensors: tuple[Tensor, Tensor, Tensor],
    current_tensors: tuple[Tensor, Tensor, Tensor],
    given_motion: tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Take one step with fixed shapes; positions, features and masks in, because compilers trace tensors alone.

    Returns positions, features, the share of uncovered particles, the edges dropped and the particles not finite.
    """
    previous = Particles(*previous_tensors)
    current = replace(Particles(*current_tensors), driven=driven_of(given_motion))
    built = build_static_graph(
        previous,
        current,
        priorities,
        num_abstract_nodes=num_abstract_nodes,
        max_abstract_neighbors=dynamics.max_abstract_neighbors,
        r_s=dynamics.r_s,
        r_a_s=dynamics.r_a_s,
        edge_capacity=dynamics.edge_capacity,
        max_abstract_edges_per_node=dynamics.max_abstract_edges_per_node,
    )
    positions, features = dynamics._following(previous, current, built.graph)
    return positions, features, _uncovered_share(current, built.graph), built.dropped_edges, built.non_finite


@functools.cache
def compiled_step(device_type: str) -> Callable[..., tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]:
    """Return ``static_step`` for torch.compile; it is compiled again for every new size, so keep these few.

    Raises:
        ConfigError: when the compiler that torch.compile needs is not installed.
    """
    if device_type == "cpu" and not any(map(shutil.which, (os.environ.get("CXX", "g++"), "g++", "clang++"))):
        raise ConfigError("dynamics.compile=true needs a C++ compiler on a CPU.\nInstall g++, or set compile to false.")
    if device_type == "cuda" and importlib.util.find_spec("triton") is None:
        raise ConfigError("dynamics.compile=true needs triton on a GPU.\npip install triton, or set compile to false.")
    mode = "reduce-overhead" if device_type == "cuda" else "default"
    return torch.compile(static_step, fullgraph=True, dynamic=False, mode=mode)
