"""Which node each edge touches: node features are gathered to edges, and edges are summed at nodes.

The two are adjoint, so each one's gradient is the other: both directions are gathers and sums over sorted lists, which
repeat bit for bit with any number of threads and on every device. Nothing here is an atomic scatter.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class Incidence:
    """The node at one end of every edge.

    ``index[e]`` is the node of edge e, or ``num_nodes`` where there is no edge (padding of a fixed shape): such an edge
    reads zeros from its node and is summed nowhere, so that not even NaN gets out of it.

    Node i owns the edges ``order[offsets[i]]`` up to ``order[offsets[i + 1]]``; ``order`` is ``None`` where the edges
    lie in this order already. With ``width`` the edges are a table instead, ``width`` of them for each node in turn,
    and need neither.
    """

    index: Int64[Tensor, " edge"]
    num_nodes: int
    order: Int64[Tensor, " edge"] | None = None
    offsets: Int64[Tensor, " node_plus_one"] | None = None
    width: int | None = None

    @classmethod
    def of(cls, index: Int64[Tensor, " edge"], num_nodes: int, is_sorted: bool = False) -> "Incidence":
        """Find the edges of each node; edges of one node keep their order, edges without node come last."""
        ordered, order = (index, None) if is_sorted else index.sort(stable=True)
        bounds = torch.arange(num_nodes + 1, device=index.device)
        return cls(index, num_nodes, order, torch.searchsorted(ordered, bounds))

    @classmethod
    def of_table(cls, mask: Bool[Tensor, "node width"]) -> "Incidence":
        """Node i has the edges of row i of a table; where ``mask`` is false there is no edge."""
        num_nodes, width = mask.shape
        nodes = torch.arange(num_nodes, device=mask.device)[:, None]
        return cls(torch.where(mask, nodes, num_nodes).flatten(), num_nodes, width=width)

    def summed(self, edges: Float[Tensor, "edge feature"]) -> Float[Tensor, "node feature"]:
        """Sum the edges of each node, one after the other in their order."""
        return _Sum.apply(edges, self.index, self.num_nodes, self.order, self.offsets, self.width)

    def mean(self, edges: Float[Tensor, "edge feature"]) -> Float[Tensor, "node feature"]:
        """Average the edges of each node; a node without edges gets zero."""
        return self.summed(edges) / self.counts().clamp(min=1)[:, None].to(edges.dtype)

    def counts(self) -> Int64[Tensor, " node"]:
        """Return how many edges each node has."""
        if self.offsets is not None:
            return self.offsets.diff()
        assert self.width is not None
        return (self.index < self.num_nodes).view(self.num_nodes, self.width).sum(dim=1)


def gather_to_edges(
    rows: Float[Tensor, "node feature"],
    incidence: Incidence,
    more: Float[Tensor, "other_node feature"] | None = None,
    more_incidence: Incidence | None = None,
) -> Float[Tensor, "edge feature"]:
    """Return for each edge the row of its node, plus the row of the node at its other end where one is given."""
    one = (incidence.index, incidence.order, incidence.offsets, incidence.width)
    if more is None or more_incidence is None:
        return _Gather.apply(rows, None, *one, None, None, None, None)
    other = (more_incidence.index, more_incidence.order, more_incidence.offsets, more_incidence.width)
    return _Gather.apply(rows, more, *one, *other)


class EdgeGather:
    """``gather_to_edges`` for some of the edges at a time, without gradients: what they read is laid out once."""

    def __init__(self, tables: list[Float[Tensor, "_ feature"]], indices: list[Int64[Tensor, " edge"]]) -> None:
        # Padding reads the zeros behind each table.
        self._tables = [functional.pad(table, (0, 0, 0, 1)) for table in tables]
        self._indices = indices
        # One pass that reads and adds; a compiler makes one of the plain form by itself.
        self._is_bag = tables[0].device.type == "cpu" and tables[0].dtype == torch.float32 and not _is_compiling()
        if self._is_bag:
            shifts = [0, len(self._tables[0])]
            self._pairs = torch.stack([index + shift for index, shift in zip(indices, shifts, strict=False)], dim=1)
            self._tables = [torch.cat(self._tables)]

    def rows(self, start: int = 0, stop: int | None = None) -> Float[Tensor, "edge feature"]:
        """Return the new rows of edges ``start`` to ``stop``."""
        if self._is_bag:
            return functional.embedding_bag(self._pairs[start:stop], self._tables[0], mode="sum")
        first, *others = [
            table.index_select(0, index[start:stop]) for table, index in zip(self._tables, self._indices, strict=True)
        ]
        return first + others[0] if others else first


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rows, more, index, order, offsets, width, more_index, more_order, more_offsets, more_width):  # type: ignore[no-untyped-def]
        ctx.save_for_backward(index, order, offsets, more_index, more_order, more_offsets)
        ctx.sizes = len(rows), width, None if more is None else len(more), more_width
        if more is None:
            return EdgeGather([rows], [index]).rows()
        return EdgeGather([rows, more], [index, more_index]).rows()

    @staticmethod
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]
        index, order, offsets, more_index, more_order, more_offsets = ctx.saved_tensors
        num_rows, width, num_more, more_width = ctx.sizes
        rows = more = None
        if ctx.needs_input_grad[0]:
            rows = _sums(gradient, index, num_rows, order, offsets, width)
        if num_more is not None and ctx.needs_input_grad[1]:
            more = _sums(gradient, more_index, num_more, more_order, more_offsets, more_width)
        return rows, more, None, None, None, None, None, None, None, None


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(ctx, edges, index, num_nodes, order, offsets, width):  # type: ignore[no-untyped-def]
        ctx.save_for_backward(index)
        return _sums(edges, index, num_nodes, order, offsets, width)

    @staticmethod
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]
        (index,) = ctx.saved_tensors
        return EdgeGather([gradient], [index]).rows(), None, None, None, None, None


def _sums(
    edges: Tensor, index: Tensor, num_nodes: int, order: Tensor | None, offsets: Tensor | None, width: int | None
) -> Tensor:
    """Sum edges at nodes in at least float32 and in a fixed order."""
    values = edges.float() if edges.dtype in (torch.float16, torch.bfloat16) else edges
    if width is not None:
        if values.device.type == "cpu" and not _is_compiling():  # few rows are padding: a look at them is cheaper
            padding = (index == num_nodes).nonzero().flatten()
            values = values.index_fill(0, padding, 0.0) if len(padding) else values
        else:
            values = torch.where((index < num_nodes)[:, None], values, 0.0)
        table = values.view(num_nodes, width, values.shape[1])
        # Of two rows one sum of halves, which is much faster than a reduction over so short an axis.
        return (table[:, 0] + table[:, 1] if width == 2 else table.sum(dim=1)).to(edges.dtype)
    if len(edges) == 0:
        return values.new_zeros(num_nodes, values.shape[1]).to(edges.dtype)
    if values.device.type == "cpu" and values.dtype == torch.float32 and not _is_compiling():
        # Three to ten times faster than segment sums there, with threads, and in the same order.
        ordered = torch.arange(len(edges)) if order is None else order
        return functional.embedding_bag(ordered, values, offsets, mode="sum", include_last_offset=True).to(edges.dtype)
    from torch_geometric.utils import segment  # takes seconds to import, and is not needed above

    return segment(values if order is None else values.index_select(0, order), offsets, reduce="sum").to(edges.dtype)


def _is_compiling() -> bool:
    return torch.compiler.is_compiling()
