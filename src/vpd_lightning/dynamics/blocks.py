"""Building blocks of graph networks: plain MLPs, a factored first edge layer, updaters with layer norm and residual."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from vpd_lightning.graph.hierarchical import EdgeSet
from vpd_lightning.graph.incidence import EdgeGather, gather_to_edges

_ROWS_PER_CHUNK = 4096
"""Edges at a time on a CPU without gradients: 128 wide they fill 2 MiB, which stays in the cache of a core."""


class MLP(nn.Module):
    """Linear layers of the given widths with ReLU between them and nothing behind the last.

    ``MLP(3, (128, 128))`` has (3 * 128 + 128) + (128 * 128 + 128) parameters. Weights start as truncated normals of
    variance 1 / fan-in, biases at zero (Haiku's MLP, which the mesh-based simulators behind the paper use).
    """

    def __init__(self, input_dim: int, widths: Sequence[int]) -> None:
        super().__init__()
        if not widths or min(widths) < 1 or input_dim < 1:
            raise ValueError(f"An MLP needs widths of at least 1, got {input_dim} -> {list(widths)}.")
        sizes = [input_dim, *widths]
        self.layers = nn.ModuleList(nn.Linear(before, after) for before, after in zip(sizes, widths, strict=False))
        for layer in self.layers:
            deviation = layer.in_features**-0.5
            nn.init.trunc_normal_(layer.weight, std=deviation, a=-2 * deviation, b=2 * deviation)
            nn.init.zeros_(layer.bias)

    def forward(self, inputs: Float[Tensor, "*shape input"]) -> Float[Tensor, "*shape output"]:
        """Apply all layers."""
        return self.after_first(self.layers[0](inputs))

    def after_first(self, hidden: Float[Tensor, "*shape hidden"]) -> Float[Tensor, "*shape output"]:
        """Continue behind the first linear layer, which a caller may have computed in parts; overwrites ``hidden``."""
        for layer in self.layers[1:]:
            # In place: a linear layer does not need its own output again, and ReLU's gradient reads its result.
            hidden = layer(functional.relu(hidden, inplace=True))
        return hidden


class FullPrecisionLayerNorm(nn.LayerNorm):
    """Layer norm computed in at least float32, also under autocast; the result is in the inputs' precision.

    PyTorch's autocast would return float32, and all latents, which are sums of such results, would be float32, too:
    products in bfloat16 then read and write twice the bytes.
    """

    def forward(self, inputs: Float[Tensor, "*shape feature"]) -> Float[Tensor, "*shape feature"]:
        """Normalise over the last axis."""
        is_half = inputs.dtype in (torch.float16, torch.bfloat16)
        with torch.autocast(inputs.device.type, enabled=False):
            if is_half and inputs.device.type != "cpu":  # on a CPU one kernel computes so by itself
                return super().forward(inputs.float()).to(inputs.dtype)
            return super().forward(inputs)


class EdgeUpdater(nn.Module):
    """``edge <- edge + LayerNorm(MLP(edge, sender, receiver))``; inputs are concatenated in this order.

    The first layer is one weight over the concatenation, but it is applied in parts, ``W_e edge + (W_s senders)[edge's
    sender] + (W_r receivers)[edge's receiver] + b``: the same sum, with the node parts multiplied once per node and no
    concatenation in memory. ``num_node_inputs`` is 1 where receivers have no features yet.

    Without gradients on a CPU the edges are updated in place, some thousand at a time: every pass over them but the
    first then happens in the cache.
    """

    def __init__(self, hidden_dim: int, num_node_inputs: int) -> None:
        super().__init__()
        if num_node_inputs not in (1, 2):
            raise ValueError(f"num_node_inputs must be 1 (senders) or 2 (and receivers), got {num_node_inputs}.")
        self.num_node_inputs = num_node_inputs
        self.mlp = MLP((1 + num_node_inputs) * hidden_dim, (hidden_dim, hidden_dim))
        self.norm = FullPrecisionLayerNorm(hidden_dim)

    def forward(
        self,
        edges: Float[Tensor, "edge feature"],
        sender_nodes: Float[Tensor, "sender_node feature"],
        receiver_nodes: Float[Tensor, "receiver_node feature"] | None,
        edge_set: EdgeSet,
    ) -> Float[Tensor, "edge feature"]:
        """Return the updated edges; ``receiver_nodes`` is ``None`` exactly where ``num_node_inputs`` is 1."""
        if (receiver_nodes is None) != (self.num_node_inputs == 1):
            raise ValueError(f"This updater was built for {self.num_node_inputs} node inputs.")
        first = self.mlp.layers[0]
        weight, *node_weights = first.weight.split(edges.shape[-1], dim=1)
        # The bias joins the rows of the senders, which are fewer than the edges.
        sent = functional.linear(sender_nodes, node_weights[0], first.bias)
        received = None if receiver_nodes is None else functional.linear(receiver_nodes, node_weights[1])
        if self._is_chunked(edges):
            return self._updated_in_place(edges, weight, sent, received, edge_set)
        hidden = gather_to_edges(sent, edge_set.senders, received, edge_set.receivers)
        return self._behind_nodes(edges, weight, hidden).add_(edges)

    def _behind_nodes(self, edges: Tensor, weight: Tensor, hidden: Tensor) -> Tensor:
        """Return what is added to the edges, given the nodes' part of the first layer, which is overwritten."""
        if torch.is_autocast_enabled(edges.device.type):  # which does not know the form in place
            hidden = torch.addmm(hidden, edges, weight.t())
        else:
            hidden = hidden.addmm_(edges, weight.t())
        return self.norm(self.mlp.after_first(hidden))

    def _is_chunked(self, edges: Tensor) -> bool:
        if torch.is_grad_enabled() or torch.compiler.is_compiling() or edges.device.type != "cpu":
            return False
        return not torch.is_autocast_enabled("cpu")

    def _updated_in_place(
        self, edges: Tensor, weight: Tensor, sent: Tensor, received: Tensor | None, edge_set: EdgeSet
    ) -> Tensor:
        tables = [sent] if received is None else [sent, received]
        gather = EdgeGather(tables, [edge_set.senders.index, edge_set.receivers.index][: len(tables)])
        for start in range(0, len(edges), _ROWS_PER_CHUNK):
            chunk = edges[start : start + _ROWS_PER_CHUNK]
            chunk += self._behind_nodes(chunk, weight, gather.rows(start, start + _ROWS_PER_CHUNK))
        return edges


class NodeUpdater(nn.Module):
    """``node <- node + LayerNorm(MLP(node, sum of incoming edges))``; inputs are concatenated in this order.

    With ``has_nodes`` false the nodes have no features yet: they are not concatenated, and there is no residual.
    """

    def __init__(self, hidden_dim: int, has_nodes: bool) -> None:
        super().__init__()
        self.has_nodes = has_nodes
        self.mlp = MLP((2 if has_nodes else 1) * hidden_dim, (hidden_dim, hidden_dim))
        self.norm = FullPrecisionLayerNorm(hidden_dim)

    def forward(
        self, nodes: Float[Tensor, "node feature"] | None, messages: Float[Tensor, "node feature"]
    ) -> Float[Tensor, "node feature"]:
        """Return the updated nodes; ``nodes`` is ``None`` exactly where ``has_nodes`` is false."""
        if (nodes is None) == self.has_nodes:
            raise ValueError(f"This updater was built for nodes {'with' if self.has_nodes else 'without'} features.")
        if nodes is None:
            return self.norm(self.mlp(messages))
        return nodes + self.norm(self.mlp(torch.cat([nodes, messages], dim=-1)))
